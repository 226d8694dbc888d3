"""Measured minus model over the noise, of a machine whose simulation is as good as its sensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from diagnosis.fit.likelihood import White
from diagnosis.fit.nominal import NominalParameters
from diagnosis.fit.records import RecordsToFit
from diagnosis.machine.machine_protocol import CaseOfMachine, Real, RecordOfMachine


class ResidualModel(RecordsToFit):
    """The estimation records of a case under white noise."""

    def __init__(self, case: CaseOfMachine) -> None:
        noise = White(case.noise, case.steps)
        super().__init__(case, case.estimation, noise, NominalParameters(case.machine))
        self.start = self.guessed_start()

    def of(
        self, deviations: Real, effects: Sequence[Any], experiments: Sequence[RecordOfMachine] | None = None
    ) -> Real:
        """Residuals (N,) of the given experiments (default: estimation): sample by sample, all outputs.

        Rounded outputs enter by the chance of their cells (`diagnosis.machine.quantisation_grid`).
        """
        if experiments is None:
            return self.coefficients(deviations, effects, self.start)
        left = self.by_experiment(deviations, effects, experiments)
        return np.concatenate([self.likelihood.to_coefficients(e * self.case.noise) for e in left.values()])

    def by_experiment(
        self, deviations: Real, effects: Sequence[Any], experiments: Sequence[RecordOfMachine] | None = None
    ) -> dict[str, Real]:
        """(measured - model)/noise (T, Y) of the given experiments (default: all), whatever they weigh in a
        fit."""
        simulator = self.nominal.at(deviations).simulator(effects)
        experiments = self.case.experiments if experiments is None else experiments
        self.simulations += len(experiments)
        return {e.name: np.asarray((e.output - simulator(e.input)) / self.case.noise) for e in experiments}


def pooled_rms(residuals: Real) -> float:
    """Root mean square; 1 is the noise floor."""
    return float(np.sqrt(np.mean(np.square(residuals))))
