"""Surviving explanations of a diagnosis as hypotheses for the next experiment, with what their fits know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from diagnosis.fit.fit import Fit
from diagnosis.fit.nominal import NominalParameters
from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import Real
from diagnosis.next_experiment.discrimination import CompetingHypothesis
from plant.effects import Effect
from plant.simulate import simulate

# In tolerances: small against one, large against the wobble of friction.
_DEVIATION_STEP = 0.02
# A set less probable than this is only kept when there would be none at all without it.
_SURVIVES = 0.01


class Weighed(Protocol):
    """A fit and the log of its weight, as `diagnosis.evidence.hypotheses.Hypothesis` has them."""

    @property
    def fit(self) -> Fit: ...

    @property
    def log_weight(self) -> float: ...


def competing_hypotheses(
    case: Case, hypotheses: Sequence[Weighed], sets: Mapping[tuple[str, ...], float], at_most: int = 3
) -> tuple[CompetingHypothesis, ...]:
    """The most probable fitted sets of effects that contradict each other; two at least if there are two.

    A set that contains a more probable one, or lies within it, names the same cause and more or less beside
    it: they do not compete.

    Parameters
    ----------
    hypotheses
        Of `search`; the best of every set counts.
    sets
        Sorted effect names -> probability, as `probabilities` gives them; names without a fit ("unknown") are
        passed over.
    """
    if not at_most >= 2:
        raise ValueError(f"competing hypotheses come in pairs at least; got at_most = {at_most}")
    best: dict[tuple[str, ...], Weighed] = {}
    for hypothesis in hypotheses:
        key = tuple(sorted(hypothesis.fit.names))
        if key not in best or hypothesis.log_weight > best[key].log_weight:
            best[key] = hypothesis
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
    nominal = NominalParameters(case.rig)
    noise = case.noise

    def outputs(deviations: Real, effects: Sequence[Effect], voltage: Real) -> Real:
        return np.asarray((simulate(nominal.at(deviations), voltage, effects).output / noise).ravel())

    def directions(voltage: Real) -> Real:
        # Contacts say little about a small change of a nominal parameter and cost most of the time.
        calm = tuple(e for e in fit.effects if type(e).dependence != "non-smooth")
        start = outputs(fit.deviations, calm, voltage)
        columns = []
        for k in range(nominal.count):
            moved = fit.deviations.copy()
            moved[k] += _DEVIATION_STEP
            columns.append((outputs(moved, calm, voltage) - start) / _DEVIATION_STEP)
        if len(calm) < len(fit.effects):
            start = outputs(fit.deviations, fit.effects, voltage)
        for i, (candidate, x) in enumerate(zip(fit.candidates, fit.coordinates, strict=True)):
            high = candidate.box[1]
            for a, axis in enumerate(candidate.axes):
                step = axis.step if x[a] + axis.step <= high[a] else -axis.step
                moved = x.copy()
                moved[a] += step
                effects = list(fit.effects)
                effects[i] = candidate.effect_at(moved)
                columns.append((outputs(fit.deviations, tuple(effects), voltage) - start) / step)
        return np.column_stack(columns) if columns else np.zeros((start.size, 0))

    return CompetingHypothesis(probability, nominal.at(fit.deviations), fit.effects, directions, fit.hessian)
