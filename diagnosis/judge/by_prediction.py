"""What the prediction of logs that were not fitted says about a name.

Evidence asks whether a set of effects is all that is missing. Where something beyond the list is missing too
no set is, and all probability goes to "unknown", also that of an effect which plainly makes the simulation
better. Such an effect is there, or a cause acts like it; "unknown" is about what it leaves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from diagnosis.evidence.hypotheses import Probabilities

_UNKNOWN = ("unknown",)


def presence_by_prediction(in_repairs: float, genuine: float, listed: float) -> float:
    """Probability that an effect of the repair is there, from prediction alone.

    Parameters
    ----------
    in_repairs : float
        Share of the repairs that hold it, when logs are drawn anew (`repair.stability`).
    genuine : float
        Probability that an effect which explains so much beside what is left does not stand in for that.
    listed : float
        Prior probability that what acts like an effect of the list is one: prediction cannot tell it from a
        cause beyond the list that acts alike, so that no more than this can come of it.
    """
    return in_repairs * min(genuine, listed)


def raised(
    probabilities: Probabilities, presence: Mapping[str, float], carried: Mapping[str, float]
) -> Probabilities:
    """Probabilities in which no effect of the repair is less probable than prediction says.

    What an effect gains is taken from "unknown": from the probability that nothing of the list is there.

    Parameters
    ----------
    probabilities : Probabilities
        As evidence has them.
    presence : mapping
        Effect of the repair -> probability that it is there by prediction.
    carried : mapping
        Effect of the repair -> share of the error that it explains; the largest is the main cause.

    Returns
    -------
    Probabilities
        As they were where no effect gains, or "unknown" has nothing to give.
    """
    gains = {
        name: min(there - probabilities.presence.get(name, 0.0), probabilities.sets[_UNKNOWN])
        for name, there in presence.items()
    }
    gaining = sorted((name for name in gains if gains[name] > 0), key=lambda name: -gains[name])
    cause = dict(probabilities.cause)
    sets = dict(probabilities.sets)
    present = dict(probabilities.presence)
    # An effect that gains more is there without one that gains less, as far as their gains differ.
    for count, name in enumerate(gaining, start=1):
        smaller_gain = gains[gaining[count]] if count < len(gaining) else 0.0
        moved = gains[name] - smaller_gain
        together = gaining[:count]
        key = tuple(sorted(together))
        main = max(together, key=lambda effect: carried.get(effect, 0.0))
        sets[key] = sets.get(key, 0.0) + moved
        sets[_UNKNOWN] -= moved
        cause[main] += moved
        cause["unknown"] -= moved
        for effect in together:
            present[effect] += moved
    return replace(probabilities, cause=cause, sets=sets, presence=present)
