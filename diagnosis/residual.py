"""Measured minus model over the noise: the one thing every fit and every verdict looks at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diagnosis.case import Case, Experiment, Real
from diagnosis.nominal import NominalParameters
from plant.effects import Effect
from plant.rig import Rig
from plant.simulate import simulate


class ResidualModel:
    """Whitened residuals of a case for any deviations of its nominal parameters and any effects.

    Counts its simulations, which is what a diagnosis spends its time on.
    """

    def __init__(self, case: Case) -> None:
        self.case = case
        self.nominal = NominalParameters(case.rig)
        self.simulations = 0

    def of(
        self, deviations: Real, effects: Sequence[Effect], experiments: Sequence[Experiment] | None = None
    ) -> Real:
        """Residuals (N,) of the given experiments (default: estimation), sample by sample, hub before tip."""
        experiments = self.case.estimation if experiments is None else experiments
        rig = self.nominal.at(deviations)
        return np.concatenate([self._one(rig, effects, experiment).ravel() for experiment in experiments])

    def by_experiment(self, deviations: Real, effects: Sequence[Effect]) -> dict[str, Real]:
        """Residuals (T, 2) of every experiment."""
        rig = self.nominal.at(deviations)
        return {experiment.name: self._one(rig, effects, experiment) for experiment in self.case.experiments}

    def _one(self, rig: Rig, effects: Sequence[Effect], experiment: Experiment) -> Real:
        self.simulations += 1
        model = simulate(rig, experiment.voltage_V, effects).output
        return np.asarray((experiment.output - model) / self.case.noise)


def pooled_rms(residuals: Real) -> float:
    """Root mean square; 1 is the noise floor."""
    return float(np.sqrt(np.mean(np.square(residuals))))
