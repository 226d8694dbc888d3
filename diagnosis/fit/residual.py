"""Measured minus model over the noise: the one thing every fit and every verdict looks at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from diagnosis.fit.nominal import NominalParameters
from diagnosis.machine.machine_protocol import CaseOfMachine, Real, RecordOfMachine
from diagnosis.machine.quantisation_grid import cell_residual

Simulator = Callable[[Real], Real]


class ResidualModel:
    """Whitened residuals of a case for any deviations of its nominal parameters and any effects.

    Counts its simulations, which is what a diagnosis spends its time on.
    """

    def __init__(self, case: CaseOfMachine) -> None:
        self.case = case
        self.nominal = NominalParameters(case.machine)
        self.simulations = 0
        self.steps = case.steps

    def of(
        self, deviations: Real, effects: Sequence[Any], experiments: Sequence[RecordOfMachine] | None = None
    ) -> Real:
        """Residuals (N,) of the given experiments (default: estimation): sample by sample, all outputs.

        Rounded outputs enter by the chance of their cells (`diagnosis.machine.quantisation_grid`).
        """
        experiments = self.case.estimation if experiments is None else experiments
        simulator = self.nominal.at(deviations).simulator(effects)
        return np.concatenate([self._weighed(simulator, experiment).ravel() for experiment in experiments])

    def by_experiment(
        self, deviations: Real, effects: Sequence[Any], experiments: Sequence[RecordOfMachine] | None = None
    ) -> dict[str, Real]:
        """(measured - model)/noise (T, Y) of the given experiments (default: all), whatever they weigh in a
        fit."""
        simulator = self.nominal.at(deviations).simulator(effects)
        experiments = self.case.experiments if experiments is None else experiments
        return {e.name: self._one(simulator, e) for e in experiments}

    def _weighed(self, simulator: Simulator, experiment: RecordOfMachine) -> Real:
        e = self._one(simulator, experiment)
        for k in np.flatnonzero(self.steps):
            noise = float(self.case.noise[k])
            e[:, k] = cell_residual(e[:, k] * noise, np.zeros(len(e)), float(self.steps[k]), noise)
        return e

    def _one(self, simulator: Simulator, experiment: RecordOfMachine) -> Real:
        self.simulations += 1
        model = simulator(experiment.input)
        return np.asarray((experiment.output - model) / self.case.noise)


def pooled_rms(residuals: Real) -> float:
    """Root mean square; 1 is the noise floor."""
    return float(np.sqrt(np.mean(np.square(residuals))))
