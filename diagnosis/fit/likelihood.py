"""What residuals cost: white noise of known size here, levels that nobody knows in `diagnosis.fit.levels`.

A fit sees residuals as coefficients e (N,), record after record; all the rest of it is the same for both.

The log odds below are steps on the usual scales, far apart on purpose: each of them doubled moved a
probability of six cases by 0.012 at most (`python -m benchmarks.frozen_answers --change`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.quantisation_grid import cell_residual

# Log odds that are worth a look: 7 to 1, "substantial" on the usual scales of Bayes factors.
SUBSTANTIAL = 2.0
# Log odds that pay for a further effect, 150 to 1: "very strong" on these scales.
WORTH_IT = 5.0
# Log odds that decide, 3 million to 1: before a fit has ended its loss may be off by several.
DECISIVE = 15.0


class Likelihood(Protocol):
    """Likelihood of the residuals of some records, as a function of coefficients e (N,) of all of them."""

    def to_coefficients(self, residuals: Real) -> Real:
        """(T Y,) coefficients of measured - model (T, Y) of one record, in the outputs' units."""

    def to_residuals(self, e: Real, outputs: int) -> Real:
        """(T, Y) residuals of the coefficients (T Y,) of one record, in the outputs' units.

        The inverse of `to_coefficients`, as far as that has one.
        """

    def linearised(self, outputs: Real) -> Real:
        """(..., T, Y) changes of the coefficients by changes (..., T, Y) of a record's residuals.

        To first order, so that derivatives of outputs become derivatives of coefficients.
        """

    def loss(self, e: Real) -> float:
        """-log likelihood of the coefficients (N,), up to a constant of the records."""

    def weights(self, e: Real) -> Real:
        """(N,) w with the gradient of the loss w e: the squares w e^2 / 2 have the same slope at e."""


@dataclass(frozen=True, eq=False)
class White:
    """White noise of the stated size; outputs on a quantisation grid by the chance of their cells.

    Attributes
    ----------
    noise : (Y,) array
        Standard deviations in the outputs' units, all above 0.
    steps : (Y,) array
        Steps of the quantisation grids, 0 for an output without one.
    """

    noise: Real
    steps: Real

    def to_coefficients(self, residuals: Real) -> Real:
        """(T Y,) residuals in noise deviations, sample by sample.

        The square of one of a quantised output is the deviance of the cell that was read
        (`diagnosis.machine.quantisation_grid.cell_residual`).
        """
        e = residuals / self.noise
        for k in np.flatnonzero(self.steps):
            no_offset = np.zeros(len(e))
            e[:, k] = cell_residual(residuals[:, k], no_offset, float(self.steps[k]), float(self.noise[k]))
        return np.asarray(e.ravel())

    def to_residuals(self, e: Real, outputs: int) -> Real:
        """(T, Y) residuals; of a quantised output the chance of a cell in noise deviations."""
        return np.asarray(e.reshape(-1, outputs) * self.noise)

    def linearised(self, outputs: Real) -> Real:
        """(..., T, Y) changes in noise deviations; a quantisation grid is neglected."""
        return np.asarray(outputs / self.noise)

    def loss(self, e: Real) -> float:
        """Half the sum of squares: -log of the normal density up to its constant."""
        return 0.5 * float(e @ e)

    def weights(self, e: Real) -> Real:
        """(N,) ones."""
        return np.ones(e.size)
