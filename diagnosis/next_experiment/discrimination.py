"""Explanations that are left of a diagnosis, and how far an experiment parts them.

Two hypotheses i and j predict outputs y_i, y_j for an input. Their difference in noise deviations, D, is what
an experiment has to show, less what the free parameters of both absorb: with derivatives J by them and the
precision L of what the records know about them,

    d^2 = D' (I + J L^-1 J')^-1 D = D'D - D'J (J'J + L)^-1 J'D,

the expected log Bayes factor is about d^2 / 2, and d reads as standard deviations between the two. To first
order in the free parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from diagnosis.evidence.explanation import best_of_sets
from diagnosis.evidence.hypotheses import Hypothesis
from diagnosis.fit.coordinates import bounds_of, difference_quotients, effects_at
from diagnosis.fit.descent import Fit
from diagnosis.fit.nominal import NominalParameters
from diagnosis.machine.case import Case
from diagnosis.machine.flexible_arm import FlexibleArm
from diagnosis.machine.machine_protocol import Real
from plant.effects.search_space import Candidate
from plant.rig import Rig
from plant.simulation import simulate

# In tolerances: small against one, large against the wobble of friction.
_DEVIATION_STEP = 0.02
# At most so many explanations are told apart by the next experiment.
MOST_COMPETING = 3
# A set less probable than this is only kept when there would be none at all without it.
_SURVIVES = 0.01


def simulated(machine: Any, effects: Sequence[Any], inputs: Real) -> Real:
    """(T, Y) of a Rig for a voltage (T,), of a Plant for inputs (T, U)."""
    if isinstance(machine, Rig):
        return simulate(machine, inputs, effects).output
    return np.asarray(machine.simulator(effects)(inputs))


@dataclass(frozen=True, eq=False)
class CompetingHypothesis:
    """One explanation that is left.

    probability : float
    rig : Rig, or Plant of one's own. With its fitted nominal parameters.
    effects : tuple of Effect, or of Change of an own plant
    directions : callable. Voltage (T,), or inputs (T, U) of an own plant -> derivatives (Y T, P) of the
        outputs in noise deviations, sample by sample, by the hypothesis' free parameters; None: none is free.
    precision : (P, P). What is known about the free parameters: the Gauss-Newton Hessian of the fit to the
        records, prior included.
    causes : tuple of str. Effects that it names; by default all of them.
    name : str. In sentences; by default the causes.
    noise : (Y,). Standard deviations of the outputs, of a rig those of hub angle and tip position; by default
        those of the rig's sensors. Infinite where nobody measures.
    """

    probability: float
    rig: Any
    effects: tuple[Any, ...] = ()
    directions: Callable[[Real], Real] | None = None
    precision: Real = field(default_factory=lambda: np.zeros((0, 0)))
    causes: tuple[str, ...] = ()
    name: str = ""
    noise: Real = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= 1 + 1e-9:  # a sum of shares may round above one
            raise ValueError(f"a hypothesis' probability lies between 0 and 1; got {self.probability}")
        object.__setattr__(self, "effects", tuple(self.effects))
        if not self.noise.size:
            object.__setattr__(self, "noise", FlexibleArm(self.rig).noise)
        if not self.causes:
            object.__setattr__(self, "causes", tuple(effect.id for effect in self.effects))
        if not self.name:
            object.__setattr__(self, "name", " with ".join(self.causes) or "no effect")

    def outputs(self, inputs: Real) -> Real:
        """(T, Y) for a voltage (T,), or inputs (T, U) of an own plant, from rest."""
        return simulated(self.rig, self.effects, inputs)


def competing_hypotheses(
    case: Case, hypotheses: Sequence[Hypothesis], sets: Mapping[tuple[str, ...], float], at_most: int = 3
) -> tuple[CompetingHypothesis, ...]:
    """The most probable fitted sets of effects that contradict each other; two at least if there are two.

    A set that contains a more probable one, or lies within it, names the same cause and more or less beside
    it: they do not compete.

    hypotheses : Of `search`; the best of every set counts.
    sets : Sorted effect names -> probability, as `probabilities` gives them; names without a fit ("unknown")
        are passed over.
    """
    best = best_of_sets(hypotheses, lambda h: h.log_weight)
    # Equally hopeless sets have probabilities of zero alike: their weight orders them.
    kept: list[tuple[str, ...]] = []
    for key in sorted(best, key=lambda k: (sets.get(k, 0.0), best[k].log_weight), reverse=True):
        if len(kept) == at_most or (len(kept) >= 2 and sets.get(key, 0.0) < _SURVIVES):
            break
        # No effect at all competes with everything, though it is contained in every set.
        if not any(key and other and (set(key) <= set(other) or set(other) <= set(key)) for other in kept):
            kept.append(key)
    return tuple(competing_hypothesis(case, best[key].fit, sets.get(key, 0.0)) for key in kept)


def competing_hypothesis(case: Case, fit: Fit, probability: float) -> CompetingHypothesis:
    """A fit as a hypothesis: rig and effects, its free parameters (d, x) and their Gauss-Newton precision."""
    nominal = NominalParameters(case.machine)
    return fitted_hypothesis(
        nominal, fit.candidates, fit.deviations, fit.coordinates, fit.hessian, probability, case.noise
    )


def fitted_hypothesis(
    nominal: NominalParameters,
    candidates: Sequence[Candidate],
    deviations: Real,
    coordinates: Real,
    precision: Real,
    probability: float,
    noise: Real,
    causes: tuple[str, ...] = (),
) -> CompetingHypothesis:
    """The same of deviations (P,) and coordinates (A,) of the candidates, which `precision` (P + A, P + A)
    belongs to; noise (Y,), causes: as in `CompetingHypothesis`."""
    fitted = effects_at(candidates, coordinates)

    def outputs(deviations: Real, effects: Sequence[Any], voltage: Real) -> Real:
        return np.asarray((simulated(nominal.at(deviations).description, effects, voltage) / noise).ravel())

    axes = np.array([c.dependence != "non-smooth" for c in candidates for _ in c.axes], dtype=bool)
    calm_coordinates = coordinates[axes]

    def directions(voltage: Real) -> Real:
        # Contacts say little about a small change of a nominal parameter and cost most of the time.
        calm = effects_at([c for c in candidates if c.dependence != "non-smooth"], calm_coordinates)
        start = outputs(deviations, calm, voltage)
        by_d = difference_quotients(
            lambda d: outputs(d, calm, voltage),
            deviations,
            start,
            np.full(nominal.count, _DEVIATION_STEP),
        )
        if len(calm) < len(fitted):
            start = outputs(deviations, fitted, voltage)
        by_x = difference_quotients(
            lambda x: outputs(deviations, effects_at(candidates, x), voltage),
            coordinates,
            start,
            np.array([axis.step for candidate in candidates for axis in candidate.axes]),
            bounds_of(candidates)[1],
        )
        return np.hstack([by_d, by_x])

    rig = nominal.at(deviations).description
    return CompetingHypothesis(probability, rig, fitted, directions, precision, causes, noise=noise)


def distances(
    competing: Sequence[CompetingHypothesis],
    voltage: Real,
    whitened: Sequence[Real],
    scale: Real | None = None,
) -> tuple[Real, list[Real]]:
    """d of every pair in standard deviations, and what parameters leave of its difference (Y T,).

    whitened: every hypothesis' outputs (Y T,) in noise deviations for the voltage (T,), sample by sample.
    scale (Y T,): noise of the hypotheses over the one that these are whitened by; by default the same.
    """
    free = [
        np.zeros((whitened[0].size, 0)) if one.directions is None else one.directions(voltage)
        for one in competing
    ]
    if scale is not None:
        free = [scale[:, None] * derivatives for derivatives in free]
    found, remains = [], []
    for i, j in combinations(range(len(competing)), 2):
        D, J = whitened[i] - whitened[j], np.hstack([free[i], free[j]])
        L = block_diag(competing[i].precision, competing[j].precision)
        moment = J.T @ D
        absorbed = np.linalg.lstsq(J.T @ J + L, moment, rcond=1e-13)[0]
        found.append(np.sqrt(max(float(D @ D - moment @ absorbed), 0.0)))
        remains.append(np.asarray(D - J @ absorbed))
    return np.array(found), remains
