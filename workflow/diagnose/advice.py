"""What to do next, in sentences: the one advice that page, terminal and JSON answer give alike.

`following` decides which advice that is, and computes the experiment that it names; `advice_words` says it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from diagnosis.answer import Diagnosis
from diagnosis.machine.own_plant import Plant
from diagnosis.next_experiment.next_experiment import NextExperiment, Separation
from diagnosis.next_experiment.repeat import Repeat
from plant.effects import EFFECTS, in_words
from workflow.describe.diagnosis_words import names_words, probability_words, setting_words, with_sizes
from workflow.diagnose.following import Following
from workflow.text.formats import interval, listing, number, si
from workflow.text.names import stated_name

# Effects whose check at the machine is told. Chosen: whoever reads on has the list of effects.
_MOST_CHECKED = 4
# Times the noise or the threshold from which on a separation is no longer told as a number: beyond that it
# says how small the noise is, not how different the answers are.
_CLEARLY = 20.0
# How a record is repeated, by `Repeat.change`.
_AGAIN = {
    "same": "as it was",
    "third": "at a third of its size",
    "reversed": "with the sign of its inputs changed",
    "slower": "half as fast",
}


def advice_words(diagnosis: Diagnosis, coming: Following) -> tuple[str, ...]:
    """The advice in sentences, the decision first; never empty.

    Parameters
    ----------
    diagnosis : Diagnosis
    coming : Following
        What `following` decided for it.
    """
    return tuple(_ADVICES[coming.advice](diagnosis, coming))


def _time(diagnosis: Diagnosis, coming: Following) -> Iterator[str]:
    if diagnosis.nothing_tried:
        yield "Give the diagnosis more time (--time-limit) before you record again: nothing was tried."
    else:
        yield (
            "Check units, columns and nominal values before you record again, or give the diagnosis more time"
            " (--time-limit): its fit did not converge."
        )


def _confirm(diagnosis: Diagnosis, coming: Following) -> Iterator[str]:
    yield f"Look at the machine for {with_sizes(diagnosis.unlisted)}: one run without it would confirm it."


def _repeat_worst(diagnosis: Diagnosis, coming: Following) -> Iterator[str]:
    yield _of_worst(diagnosis, "Repeat")


def _of_worst(diagnosis: Diagnosis, begin: str) -> str:
    """A sentence on the record in which most is left: of its motion, or over the noise."""
    worst = diagnosis.worst_experiment[0]
    if diagnosis.completeness.threshold > 0:
        worst = diagnosis.completeness.in_record or worst
    return (
        f"{begin} {worst}, the worst record, at half and twice its amplitude and at another speed. What the"
        " residual follows shows where to look."
    )


def _repeat_all(diagnosis: Diagnosis, coming: Following) -> Iterator[str]:
    yield (
        "No other candidate effect is left. Repeat the experiments: what two runs have in common beyond noise"
        " would be another cause."
    )


def _none(diagnosis: Diagnosis, coming: Following) -> Iterator[str]:
    if diagnosis.untried:
        yield "These candidates that were tried need no further experiment; others were not tried."
    else:
        yield (
            "No further experiment is needed for this answer: every other candidate of a significant size is"
            " ruled out."
        )


def _look(diagnosis: Diagnosis, coming: Following) -> Iterator[str]:
    open_answers = _open_answers(diagnosis)
    left_open = f"These records leave {names_words(open_answers)} open."
    repeat = coming.repeat
    if repeat is not None and repeat.separates:
        yield f"{_of_repeat(repeat)} {left_open}"
        begin = "Without a record, check the machine"
    else:
        nothing = ""
        if repeat is not None:
            largest = max(pair.standard_deviations for pair in repeat.separations)
            nothing = (
                " No record repeated, as it was or changed, separates them: by"
                f" {number(largest, 2)} times the threshold at most."
            )
        yield f"Check the machine before you record again. {left_open}{nothing}"
        begin = "Check"
    yield from _checks(diagnosis, begin)
    if diagnosis.verdict == "unknown" and not diagnosis.unlisted:
        yield _of_worst(diagnosis, "If none of these is the cause, repeat")


def _open_answers(diagnosis: Diagnosis) -> list[str]:
    """Answers that the records leave open: the accepted effects and what may stand for or beside them."""
    return [*diagnosis.combination, *diagnosis.instead, *diagnosis.perhaps]


def _checks(diagnosis: Diagnosis, begin: str) -> Iterator[str]:
    """How each of the first effects that are open is checked at the machine, where that is known."""
    known = checks(diagnosis)
    effects = [name for name in _open_answers(diagnosis) if name not in ("none", "unknown")]
    for name in effects[:_MOST_CHECKED]:
        if name in known:
            yield f"{begin} for {in_words(name)}: {known[name]}."
        elif name.startswith("wrong_"):
            value = stated_name(name.removeprefix("wrong_"))
            yield f"{begin} for {in_words(name)}: measure {value} by itself."


def checks(diagnosis: Diagnosis) -> dict[str, str]:
    """Effect -> what to do to see whether it is there, as its class says."""
    machine = diagnosis.case.machine
    kinds = machine.effects if isinstance(machine, Plant) else EFFECTS.values()
    return {kind.id: kind.check for kind in kinds if kind.check}


def _of_repeat(repeat: Repeat) -> str:
    """A record to repeat, which pairs of answers it separates, and by how much the record as it was does."""
    pairs = "; ".join(_apart(pair, "times the threshold") for pair in repeat.separations if pair.separated)
    as_it_was = ""
    if repeat.change != "same":
        largest = max(pair.standard_deviations for pair in repeat.same)
        as_it_was = f", as it was by {_size(largest)} at most"
    return f"Repeat {repeat.record} {_AGAIN[repeat.change]}: it would {pairs}{as_it_was}."


def _separate(diagnosis: Diagnosis, coming: Following) -> Iterator[str]:
    proposal = coming.proposal
    assert proposal is not None
    first = coming.competing[0].name
    left_open = ""
    if not diagnosis.instead and not diagnosis.perhaps:
        answers = [f"{answer.name} ({probability_words(answer.probability)})" for answer in coming.competing]
        left_open = f" Still possible: {listing(answers)}."
    best = _of_excitation(proposal)
    if not proposal.separates:
        largest = max(pair.standard_deviations for pair in proposal.separations)
        count = len(proposal.considered)
        at_most = f"the best, {best}, does by {number(largest, 2)} standard deviations at most."
        if proposal.decided:
            rivals = listing([rival.name for rival in coming.competing[1:]])
            yield (
                f"No further experiment is needed: the records already decide for {first}. Of {count}"
                f" simulated experiments none would set it apart from {rivals}: {at_most}"
            )
        else:
            nothing = f"None of {count} simulated experiments separates these answers: {at_most}"
            yield f"Check the machine before you record again. {nothing}{left_open}"
            yield from _checks(diagnosis, "Check")
        return

    separated = [_apart(pair, "standard deviations") for pair in proposal.separations if pair.separated]
    not_separated = [
        f"not separate {' from '.join(pair.hypotheses)} ({number(pair.standard_deviations, 2)})"
        for pair in proposal.separations
        if not pair.separated
    ]
    would = "; it would ".join([*separated, *not_separated])
    if proposal.decided:
        yield (
            f"No further experiment is needed: the records already decide for {first}. To confirm it, run"
            f" {diagnosis.case.name}.next.csv, a {best}: it would {would}."
        )
    else:
        yield f"Run {diagnosis.case.name}.next.csv, a {best}: it would {would}.{left_open}"
    low, high = (1000 * end for end in proposal.deflection_range_m)
    yield (
        f"In it the hub stays within {interval(proposal.hub_angle_range_rad, 2)} rad, the deflection within"
        f" {number(low, 2)} to {number(high, 2)} mm."
    )


def _of_excitation(proposal: NextExperiment) -> str:
    """Kind, largest voltage, settings and length of a proposed experiment."""
    settings = [setting_words(key, value) for key, value in proposal.parameters.items()]
    words = f" ({', '.join(settings)})" if settings else ""
    return f"{proposal.kind} of {number(proposal.amplitude_V)} V{words} over {si(proposal.duration_s, 's')}"


def _apart(pair: Separation, unit: str) -> str:
    """How far a pair comes apart."""
    first, second = pair.hypotheses
    return f"separate {first} from {second} by {_size(pair.standard_deviations)} {unit}"


def _size(times: float) -> str:
    """A number of standard deviations, of which many are all alike."""
    return f"more than {number(_CLEARLY)}" if times > _CLEARLY else number(times, 2)


_ADVICES: Mapping[str, Any] = {
    "time": _time,
    "confirm": _confirm,
    "repeat_worst": _repeat_worst,
    "repeat_all": _repeat_all,
    "none": _none,
    "separate": _separate,
    "look": _look,
}
