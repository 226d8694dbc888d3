"""How far a model is off in logs that it was not fitted to, and whether another one is farther off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.machine.machine_protocol import Real

# Blocks of all logs together: a standard error from so many is itself known to 18 %, 1 / sqrt(2 (16 - 1)).
# Twice as many would be shorter than the slow part of most residuals, and then no independent witnesses.
FEWEST_BLOCKS = 16
# Stands for a residual that is no number, in noise deviations: beyond any record, and its square is a number.
_RAN_AWAY = 1e9


@dataclass(frozen=True, eq=False)
class PredictionError:
    """What a model leaves of logs that it was not fitted to, block by block.

    Attributes
    ----------
    energy : (B,) array
        Sum of squares of (measured - model) / noise in every block, all outputs together.
    values : (B,) array
        Numbers that were summed in every block: samples times outputs.
    """

    energy: Real
    values: Real

    @classmethod
    def of(cls, residuals: Sequence[Real]) -> PredictionError:
        """The error of a model in some logs, in the order given.

        Every log is cut into the same number of blocks of equal length, the smallest number that makes
        `FEWEST_BLOCKS` of all logs together. Many logs are one block each.

        Parameters
        ----------
        residuals : sequence of (T, Y) arrays
            (measured - model) / noise of every log. What is no number counts as far beyond any record.

        Returns
        -------
        PredictionError
            Of models that are to be compared, from the same logs in the same order.
        """
        blocks_per_log = -(-FEWEST_BLOCKS // len(residuals))
        energy = []
        values = []
        for residual in residuals:
            known = np.where(np.isfinite(residual), residual, _RAN_AWAY)
            for block in np.array_split(known, min(blocks_per_log, len(known))):
                energy.append(float(np.sum(block**2)))
                values.append(float(block.size))
        return cls(np.array(energy), np.array(values))

    @property
    def rms(self) -> float:
        """Root mean square over all values, in noise deviations; 1 is what a perfect model leaves."""
        return float(np.sqrt(np.sum(self.energy) / np.sum(self.values)))

    def beyond(self, other: PredictionError) -> tuple[float, float]:
        """How much more energy is left than by another model in the same blocks, and its standard error.

        Returns
        -------
        difference, standard_error : float
            Sum over blocks, and sqrt(B) times the standard deviation of the differences between blocks.

        Notes
        -----
        Blocks are compared in pairs, so that what both models miss in the same way does not count. Neglected:
        that neighbouring blocks of a log are correlated.
        """
        differences = self.energy - other.energy
        blocks = differences.size
        standard_error = float(np.sqrt(blocks) * np.std(differences, ddof=1))
        return float(np.sum(differences)), standard_error

    @property
    def standard_error(self) -> float:
        """Standard error of the energy itself: sqrt(B) times the standard deviation between blocks."""
        return float(np.sqrt(self.energy.size) * np.std(self.energy, ddof=1))

    def as_good_as(self, best: PredictionError, uninteresting: float = 0.0) -> bool:
        """Whether this model predicts as well as the one that leaves least.

        It does where it leaves no more by one standard error of the difference. What is more than that and
        yet does not interest is no reason for a larger model either, as long as it is within one standard
        error of what the best one leaves.

        Parameters
        ----------
        best : PredictionError
            Of the model that leaves least.
        uninteresting : float
            Energy that a good model may miss; 0 where it is to be as good as the sensors.
        """
        difference, standard_error = self.beyond(best)
        return difference <= max(standard_error, min(uninteresting, best.standard_error))
