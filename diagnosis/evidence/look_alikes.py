"""Causes beyond the list that look like an effect of it, so that nobody is too sure of the effect.

At small angles the torque of gravity on a hanging link is that of a linear spring to ground, a cable or a
hose. The list has no such spring; what it explains as well as gravity does is unknown with some probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.evidence.hypotheses import STILL_POSSIBLE, Hypothesis, log_prior, log_prior_unknown
from diagnosis.evidence.search import weighed
from diagnosis.fit.fit import Fit, fit
from diagnosis.fit.residual import ResidualModel
from diagnosis.machine.candidates import Axis, Candidate
from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import Dependence, Real
from plant.effects import GroundSpring
from plant.modal import static_moment_kg_m

IMITATED = "gravity"
# Of unknown causes this share is a spring to ground: a third as probable as gravity.
_SHARE = 0.06
_ITERATIONS = 15


@dataclass(frozen=True)
class _Spring(Candidate):
    """A spring to ground as a search space."""

    @property
    def dependence(self) -> Dependence:
        return GroundSpring.dependence

    def effect_at(self, x: Real) -> GroundSpring:
        return GroundSpring(**self.parameters(x))


def imitations(model: ResidualModel, hypotheses: Sequence[Hypothesis], base: Fit) -> tuple[Hypothesis, ...]:
    """Hypotheses with a spring to ground in place of gravity, wherever gravity may be an answer.

    They are no answers themselves (their log weight is -inf) but part of what is unknown. Only a flexible
    link hangs: other machines have none.
    """
    if not isinstance(model.case, Case):
        return ()
    best = max(h.largest_weight for h in hypotheses)
    # As probable as a set with gravity would be, times what an unknown cause is beside a listed one.
    unlisted = log_prior_unknown() + float(np.log(_SHARE)) - log_prior((IMITATED,))
    springs = [
        weighed(model, _with_spring(model, h.fit), base)
        for h in hypotheses
        if IMITATED in h.names and h.largest_weight > best - STILL_POSSIBLE
    ]
    return tuple(Hypothesis(s.fit, -np.inf, s.log_weight + unlisted) for s in springs)


def _with_spring(model: ResidualModel, end: Fit) -> Fit:
    k = end.names.index(IMITATED)
    moment = static_moment_kg_m(model.nominal.at(end.deviations).description)
    axis = end.candidates[k].axes[0]
    spring = _Spring(
        "ground_spring",
        (Axis("stiffness_Nm_rad", "log", axis.low * moment, axis.high * moment, axis.step),),
        (),
    )
    candidates = (*end.candidates[:k], spring, *end.candidates[k + 1 :])
    x = (*end.coordinates[:k], end.coordinates[k] + np.log(moment), *end.coordinates[k + 1 :])
    return fit(model, candidates, x, end.deviations, iterations=_ITERATIONS)
