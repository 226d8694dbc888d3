"""What residuals cost: white noise of known size here, levels that nobody knows in `diagnosis.fit.levels`.

A fit sees residuals as coefficients e (N,), record after record; all the rest of it is the same for both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.quantisation_grid import cell_residual

# Log odds that are worth a look (7 to 1), that pay for a further effect, and that decide (3 million to 1):
# before a fit has ended its loss may be off by several.
SUBSTANTIAL, WORTH_IT, DECISIVE = 2.0, 5.0, 15.0


class Likelihood(Protocol):
    """Of coefficients e (N,) of all records together."""

    def to_coefficients(self, residuals: Real) -> Real:
        """measured - model (T, Y) of one record, in the outputs' units -> its coefficients (T Y,)."""

    def to_residuals(self, e: Real, outputs: int) -> Real:
        """The inverse, (T Y,) -> (T, Y); rounded outputs by the chance of their cells."""

    def linearised(self, outputs: Real) -> Real:
        """Changes of outputs (..., T, Y) -> those of coefficients, the same shape, to first order."""

    def loss(self, e: Real) -> float:
        """-log likelihood, up to a constant of the records."""

    def weights(self, e: Real) -> Real:
        """(N,) w with grad(loss) = w e."""


@dataclass(frozen=True, eq=False)
class White:
    """White noise of the stated size; outputs on a quantisation grid by the chance of their cells.

    noise : (Y,) standard deviations. steps : (Y,) of the grids, 0 for none.
    """

    noise: Real
    steps: Real

    def to_coefficients(self, residuals: Real) -> Real:
        e = residuals / self.noise
        for k in np.flatnonzero(self.steps):
            noise = float(self.noise[k])
            e[:, k] = cell_residual(residuals[:, k], np.zeros(len(e)), float(self.steps[k]), noise)
        return np.asarray(e.ravel())

    def to_residuals(self, e: Real, outputs: int) -> Real:
        return np.asarray(e.reshape(-1, outputs) * self.noise)

    def linearised(self, outputs: Real) -> Real:
        return np.asarray(outputs / self.noise)

    def loss(self, e: Real) -> float:
        return 0.5 * float(e @ e)

    def weights(self, e: Real) -> Real:
        return np.ones(e.size)
