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
    """The estimation records of a case under white noise; starts of records are known.

    Attributes
    ----------
    start : FittedStart
        Of the estimation records, as their first samples say; without states where a machine has none.
    """

    def __init__(self, case: CaseOfMachine) -> None:
        likelihood = White(case.noise, case.steps)
        super().__init__(case, case.estimation, likelihood, NominalParameters(case.machine))
        self.start = self.guessed_start()

    def of(
        self, deviations: Real, effects: Sequence[Any], experiments: Sequence[RecordOfMachine] | None = None
    ) -> Real:
        """Residuals (N,) in noise deviations, record after record, sample by sample, all outputs.

        Parameters
        ----------
        deviations : (P,) array
            Nominal values, in tolerances off.
        effects : sequence
            With their sizes.
        experiments : sequence, optional
            Records; by default those of estimation.

        Returns
        -------
        (N,) array
            Rounded outputs enter by the chance of their cells (`diagnosis.machine.quantisation_grid`).
        """
        if experiments is None:
            return self.coefficients(deviations, effects, self.start)
        residuals = self.by_experiment(deviations, effects, experiments)
        return np.concatenate(
            [self.likelihood.to_coefficients(e * self.case.noise) for e in residuals.values()]
        )

    def by_experiment(
        self, deviations: Real, effects: Sequence[Any], experiments: Sequence[RecordOfMachine] | None = None
    ) -> dict[str, Real]:
        """Name of the record -> (measured - model) / noise (T, Y), whatever it weighs in a fit.

        Arguments are those of `of`, but that by default all records of the case are simulated.
        """
        simulate = self.nominal.at(deviations).simulator(effects)
        if experiments is None:
            experiments = self.case.experiments
        self.simulations += len(experiments)
        return {e.name: np.asarray((e.output - simulate(e.input)) / self.case.noise) for e in experiments}


def pooled_rms(residuals: Real) -> float:
    """Root mean square of all values; of whitened residuals 1 is the noise floor."""
    return float(np.sqrt(np.mean(np.square(residuals))))
