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

# Step of a difference quotient, in tolerances: small against one, large against the wobble of friction.
_DEVIATION_STEP = 0.02
# At most so many explanations are told apart by the next experiment: three make three pairs, which a page can
# name.
MOST_COMPETING = 3
# A set less probable than this is only kept when there would be none at all without it.
_SURVIVES = 0.01
# Relative size of singular values of normal equations that are rounding.
_ROUNDING = 1e-13


def simulated(machine: Any, effects: Sequence[Any], inputs: Real) -> Real:
    """(T, Y) of a Rig for a voltage (T,), of a Plant for inputs (T, U)."""
    if isinstance(machine, Rig):
        return simulate(machine, inputs, effects).output
    return np.asarray(machine.simulator(effects)(inputs))


@dataclass(frozen=True, eq=False)
class CompetingHypothesis:
    """One explanation that is left.

    probability : float. 0 to 1; a ValueError else.
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
        # A sum of shares may round above one.
        if not 0 <= self.probability <= 1 + 1e-9:
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
    case: Case,
    hypotheses: Sequence[Hypothesis],
    sets: Mapping[tuple[str, ...], float],
    at_most: int = MOST_COMPETING,
) -> tuple[CompetingHypothesis, ...]:
    """The most probable fitted sets of effects that contradict each other; two at least if there are two.

    A set that contains a more probable one, or lies within it, names the same cause and more or less beside
    it: they do not compete.

    Parameters
    ----------
    case : Case
    hypotheses : sequence of Hypothesis
        Of a search; the best of every set counts.
    sets : tuple of str -> float
        Sorted effect names -> probability, as `probabilities` gives them; names without a fit ("unknown") are
        passed over.
    at_most : int
    """
    best = best_of_sets(hypotheses, lambda hypothesis: hypothesis.log_weight)
    # Equally hopeless sets have probabilities of zero alike: their weight orders them.
    most_probable_first = sorted(
        best, key=lambda key: (sets.get(key, 0.0), best[key].log_weight), reverse=True
    )
    kept_hypotheses: list[tuple[str, ...]] = []
    for key in most_probable_first:
        if len(kept_hypotheses) == at_most or (len(kept_hypotheses) >= 2 and sets.get(key, 0.0) < _SURVIVES):
            break
        if not any(_name_the_same(key, other) for other in kept_hypotheses):
            kept_hypotheses.append(key)
    return tuple(competing_hypothesis(case, best[key].fit, sets.get(key, 0.0)) for key in kept_hypotheses)


def _name_the_same(key: tuple[str, ...], other: tuple[str, ...]) -> bool:
    """Whether one set of effects holds the other. The empty one competes with all, though all hold it."""
    if not key or not other:
        return False
    return set(key) <= set(other) or set(other) <= set(key)


def competing_hypothesis(case: Case, fit: Fit, probability: float) -> CompetingHypothesis:
    """A fit as a hypothesis: rig and effects, its free parameters (d, x) and their Gauss-Newton precision."""
    return fitted_hypothesis(
        NominalParameters(case.machine),
        fit.candidates,
        fit.deviations,
        fit.coordinates,
        fit.hessian,
        probability,
        case.noise,
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
    """A fitted model as a hypothesis whose nominal values and effect sizes may still follow new records.

    Parameters
    ----------
    nominal : NominalParameters
        What makes a machine of deviations.
    candidates : sequence of Candidate
        Effects of the model.
    deviations : (P,) array
        Of the nominal values, in tolerances.
    coordinates : (A,) array
        Of the candidates' sizes, all axes.
    precision : (P + A, P + A) array
        What the records know about both, deviations first.
    probability : float
        0 to 1.
    noise : (Y,) array
        In the outputs' units.
    causes : tuple of str, optional
        As in `CompetingHypothesis`.
    """
    fitted = effects_at(candidates, coordinates)

    def outputs(deviations: Real, effects: Sequence[Any], voltage: Real) -> Real:
        return np.asarray((simulated(nominal.at(deviations).description, effects, voltage) / noise).ravel())

    # Contacts say little about a small change of a nominal parameter and cost most of the time: derivatives
    # by nominal values are taken without them.
    smooth = [candidate for candidate in candidates if candidate.dependence != "non-smooth"]
    is_smooth = np.array(
        [candidate.dependence != "non-smooth" for candidate in candidates for _ in candidate.axes],
        dtype=bool,
    )
    smooth_coordinates = coordinates[is_smooth]
    steps = np.array([axis.step for candidate in candidates for axis in candidate.axes])
    highest = bounds_of(candidates)[1]

    def directions(voltage: Real) -> Real:
        smooth_effects = effects_at(smooth, smooth_coordinates)
        start = outputs(deviations, smooth_effects, voltage)
        by_deviation = difference_quotients(
            lambda d: outputs(d, smooth_effects, voltage),
            deviations,
            start,
            np.full(nominal.count, _DEVIATION_STEP),
        )
        if len(smooth_effects) < len(fitted):
            start = outputs(deviations, fitted, voltage)
        by_coordinate = difference_quotients(
            lambda x: outputs(deviations, effects_at(candidates, x), voltage),
            coordinates,
            start,
            steps,
            highest,
        )
        return np.hstack([by_deviation, by_coordinate])

    rig = nominal.at(deviations).description
    return CompetingHypothesis(probability, rig, fitted, directions, precision, causes, noise=noise)


def distances(
    competing: Sequence[CompetingHypothesis],
    voltage: Real,
    whitened: Sequence[Real],
    scale: Real | None = None,
) -> tuple[Real, list[Real]]:
    """How far every pair comes apart by one experiment.

    Parameters
    ----------
    competing : sequence of CompetingHypothesis
    voltage : (T,) array, or inputs (T, U) of an own plant
    whitened : sequence of (Y T,) arrays
        Every hypothesis' outputs for it in noise deviations, sample by sample.
    scale : (Y T,) array, optional
        Noise of the hypotheses over the one that these are whitened by; by default the same.

    Returns
    -------
    apart : (pairs,) array
        d of the module's first lines, in standard deviations.
    remains : list of (Y T,) arrays
        What free parameters leave of each pair's difference.
    """
    derivatives = []
    for hypothesis in competing:
        if hypothesis.directions is None:
            of_hypothesis = np.zeros((whitened[0].size, 0))
        else:
            of_hypothesis = hypothesis.directions(voltage)
        derivatives.append(of_hypothesis if scale is None else scale[:, None] * of_hypothesis)

    apart = []
    remains = []
    for i, j in combinations(range(len(competing)), 2):
        D = whitened[i] - whitened[j]
        J = np.hstack([derivatives[i], derivatives[j]])
        L = block_diag(competing[i].precision, competing[j].precision)
        moment = J.T @ D
        absorbed = np.linalg.lstsq(J.T @ J + L, moment, rcond=_ROUNDING)[0]
        apart.append(np.sqrt(max(float(D @ D - moment @ absorbed), 0.0)))
        remains.append(np.asarray(D - J @ absorbed))
    return np.array(apart), remains
