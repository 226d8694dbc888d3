"""How much a residual is worth: its autocorrelation, and the number of independent samples."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.fft import next_fast_len
from scipy.special import chdtri

from ident.data.arrays import RealArray

_LAGS_OF_WHITENESS = 25
_LEVEL = 0.99


@dataclass(frozen=True)
class ResidualColour:
    """What the autocorrelation of a residual says.

    effective_samples: number of independent samples it is worth, N / (1 + 2 sum rho_k^2) over lags to 200 or
    a tenth. Bartlett: that factor is by how much colour widens the scatter of quadratic forms such as J. With
    N itself a criterion goes on adding poles that describe noise, friction and the like, without end on long
    records. white: autocorrelations at lags 1 .. 25 no larger, all together, than those of white noise are 99
    times in 100 (Box and Pierce).
    """

    effective_samples: float
    white: bool


def residual_colour(residual: RealArray, starts: npt.NDArray[np.int64]) -> ResidualColour:
    """Colour of a residual (N,) of records that begin at `starts` (K + 1,)."""
    n = residual.size
    lags = min(200, int(np.min(np.diff(starts))) // 10)
    covariance = np.zeros(lags + 1)
    for lo, hi in pairwise(starts):
        part = residual[lo:hi]
        size = next_fast_len(part.size + lags, real=True)  # no lag up to there wraps around
        covariance += np.fft.irfft(np.abs(np.fft.rfft(part, size)) ** 2, size)[: lags + 1]
    if not covariance[0] > 0:
        return ResidualColour(float(n), False)
    squares = (covariance[1:] / covariance[0]) ** 2
    few = squares[:_LAGS_OF_WHITENESS]
    return ResidualColour(
        # What white noise shows by chance, 1/N per lag, is no colour.
        effective_samples=float(n / (1 + 2 * np.sum(np.maximum(squares - 1 / n, 0.0)))),
        white=few.size == _LAGS_OF_WHITENESS and bool(n * np.sum(few) < chdtri(few.size, 1 - _LEVEL)),
    )
