"""Causes beyond the list that look like an effect of it, so that nobody is too sure of the effect.

At small angles the torque of gravity on a hanging link is that of a linear spring to ground, a cable or a
hose; at one speed a drag is viscous friction; below its resonance a body that a spring holds to the hub is
inertia of the hub. The list has none of these; what they explain as well is unknown with some probability.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diagnosis.evidence.hypotheses import PRIOR_UNKNOWN, STILL_POSSIBLE, Hypothesis, log_prior
from diagnosis.evidence.search import fitted_to, weighed
from diagnosis.fit.descent import Descent, best_following
from diagnosis.fit.residual import ResidualModel
from diagnosis.machine.case import Case
from plant.effects import LOOK_ALIKES, Effect

# Of unknown causes this share is a look-alike of an effect: a third as probable as the effect itself.
_SHARE = 0.06


def look_alikes(
    model: ResidualModel, hypotheses: Sequence[Hypothesis], base: Descent
) -> tuple[Hypothesis, ...]:
    """Hypotheses with a look-alike in place of an effect, wherever that effect may be an answer.

    They are no answers themselves (their log weight is -inf) but part of what is unknown. Only a flexible
    link has effects with look-alikes.
    """
    if not isinstance(model.case, Case):
        return ()
    best = max(h.largest_weight for h in hypotheses)
    found = []
    for kind in LOOK_ALIKES.values():
        name = str(kind.look_alike_of)
        # As probable as a set with the effect would be, times what an unknown cause is beside a listed one.
        unlisted = float(np.log(PRIOR_UNKNOWN) + np.log(_SHARE)) - log_prior((name,))
        for h in hypotheses:
            if name in h.names and h.largest_weight > best - STILL_POSSIBLE:
                other = weighed(model, _with(model, h.fit, name, kind), base)
                found.append(Hypothesis(other.fit, -np.inf, other.log_weight + unlisted))
    return tuple(found)


def _with(model: ResidualModel, end: Descent, name: str, kind: type[Effect]) -> Descent:
    """The fit with the look-alike in place of the effect of this name, from the best of its starts."""
    k = end.names.index(name)
    other = kind.in_place_of(
        end.candidates[k], end.coordinates_of(k), model.nominal.at(end.deviations).description
    )
    first = sum(len(c.axes) for c in end.candidates[:k])
    rest = end.coordinates[:first], end.coordinates[first + len(end.candidates[k].axes) :]
    candidates = (*end.candidates[:k], other, *end.candidates[k + 1 :])
    trials = [np.concatenate([rest[0], start, rest[1]]) for start in other.starts]
    _, deviations, x = best_following(model, end, candidates, trials)
    return fitted_to(model, candidates, x, deviations)
