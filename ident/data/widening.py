"""How much wider a region has to be because its covariance is itself estimated, from little data."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.stats import f as fisher

from ident.data.ellipses import chi2_radius


def hotelling_widening(freedom: npt.ArrayLike, level: float) -> npt.NDArray[np.float64]:
    """Factor on a 2x2 covariance estimated with so many degrees of freedom f > 1, so that its chi-square
    ellipse at `level` is Hotelling's: 2 f / (f - 1) F(2, f - 1) / chi2(2)."""
    f = np.asarray(freedom, dtype=np.float64)
    return np.asarray(2 * f / (f - 1) * fisher.ppf(level, 2, f - 1) / chi2_radius(level) ** 2)


def circular_widening(freedom: int, level: float) -> float:
    """The same of a variance alike in all directions of the plane, estimated with so many complex degrees of
    freedom f > 0: 2 F(2, 2 f) / chi2(2)."""
    return float(2 * fisher.ppf(level, 2, 2 * freedom) / chi2_radius(level) ** 2)
