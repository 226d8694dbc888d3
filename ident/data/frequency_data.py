"""Measured frequency responses from files and from repeated points, as arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from scipy.stats import f as f_distribution

from ident.data.arrays import ComplexArray, RealArray
from ident.data.ellipses import chi2_radius
from ident.data.record_files import Table, read_table

FREQUENCY_COLUMNS = {"omega_rad_s": 1.0, "omega_rad_per_s": 1.0, "frequency_Hz": 2 * np.pi}
"""Names a frequency column may have, and the factor to rad/s."""
_COLUMNS = ("real", "imag", "variance_real", "variance_imag")
_CROSS = "covariance_real_imag"


def frequencies(table: Table) -> RealArray:
    """omega (K,) in rad/s from the one column of `FREQUENCY_COLUMNS` that a table has; else ValueError."""
    found = [name for name in FREQUENCY_COLUMNS if name in table.names]
    if len(found) != 1:
        raise ValueError(
            f"{table.path}, line 1: need exactly one of the columns {', '.join(FREQUENCY_COLUMNS)}; found "
            f"{list(table.names)}"
        )
    return table.columns(found)[found[0]] * FREQUENCY_COLUMNS[found[0]]


def read_frequency_table(path: Path) -> tuple[RealArray, ComplexArray, RealArray]:
    """omega (F,), response (F,), covariance (F,2,2) from the columns of `FrequencyUncertainty.from_csv`."""
    table = read_table(path)
    omega = frequencies(table)
    real, imag, variance_real, variance_imag = table.columns(_COLUMNS).values()
    negative = np.flatnonzero((variance_real < 0) | (variance_imag < 0))
    if negative.size:
        raise ValueError(f"{path}, {table.place(int(negative[0]))}: a variance is negative")
    cross = table.columns([_CROSS])[_CROSS] if _CROSS in table.names else np.zeros_like(omega)
    covariance = np.stack([np.stack([variance_real, cross], -1), np.stack([cross, variance_imag], -1)], -2)
    return omega, real + 1j * imag, covariance


def write_frequency_table(
    path: Path, omega_rad_s: RealArray, centre: ComplexArray, covariance: RealArray
) -> None:
    """The columns `read_frequency_table` reads, every number with all its digits."""
    columns = (omega_rad_s, centre.real, centre.imag, covariance[:, 0, 0], covariance[:, 1, 1])
    names = ("omega_rad_s", *_COLUMNS, _CROSS)
    table = pd.DataFrame(dict(zip(names, (*columns, covariance[:, 0, 1]), strict=True)))
    table.to_csv(path, index=False, lineterminator="\n")


def mean_of_repeats(
    omega_rad_s: RealArray,
    response: ComplexArray,
    *,
    level: float,
    pool_neighbours: int = 0,
    outlier_threshold: float | None = None,
    of: Literal["mean", "next run"] = "mean",
) -> tuple[RealArray, ComplexArray, RealArray]:
    """Frequencies (F,), means (F,), widened covariances (F,2,2) of points grouped by frequency.

    Covariances are those of the mean, or of one more run around it. Contract as
    `FrequencyUncertainty.from_frf_repeats`.
    """
    if omega_rad_s.ndim != 1 or response.shape != omega_rad_s.shape or omega_rad_s.size == 0:
        raise ValueError(f"need omega (K,) and response (K,); got {omega_rad_s.shape} and {response.shape}")
    if not (np.all(np.isfinite(omega_rad_s)) and np.all(np.isfinite(response))):
        raise ValueError("frequencies and responses must be finite")
    if pool_neighbours < 0:
        raise ValueError(f"pool_neighbours must not be negative; got {pool_neighbours}")
    if outlier_threshold is not None and not outlier_threshold > 0:
        raise ValueError(f"outlier_threshold must be positive; got {outlier_threshold}")
    grid, group = np.unique(omega_rad_s, return_inverse=True)
    centre = np.empty(grid.size, dtype=np.complex128)
    scatter = np.empty((grid.size, 2, 2))
    count = np.empty(grid.size, dtype=np.int64)
    for index in range(grid.size):
        points = response[group == index]
        if outlier_threshold is not None:
            points = _inliers(points, outlier_threshold)
        centre[index] = points.mean()
        deviation = points - centre[index]
        pair = np.stack([deviation.real, deviation.imag])
        scatter[index], count[index] = pair @ pair.T, points.size
    freedom = count - 1
    if pool_neighbours:
        scatter, freedom = _pooled(scatter, freedom, centre, pool_neighbours)
    short = freedom < 2
    if np.any(short):
        at = int(np.argmax(short))
        raise ValueError(
            f"at omega = {grid[at]:.6g} rad/s there are {count[at]} repeats: a 2x2 covariance needs "
            "at least 3 (or pool_neighbours > 0)"
        )
    # Hotelling: n (mean - G)^T S^-1 (mean - G) ~ 2 f / (f - 1) F(2, f - 1) with f degrees of freedom in S.
    hotelling = 2 * freedom / (freedom - 1) * f_distribution.ppf(level, 2, freedom - 1)
    widening = hotelling / chi2_radius(level) ** 2
    share = 1 / count if of == "mean" else 1 + 1 / count
    return grid, centre, scatter * (widening * share / freedom)[:, None, None]


def _inliers(points: ComplexArray, threshold: float) -> ComplexArray:
    """Points within `threshold` robust standard deviations of the median.

    In one pass: repeated on ten points or so, the spread shrinks by chance until good points fall.
    """
    distance = np.abs(points - (np.median(points.real) + 1j * np.median(points.imag)))
    # The median distance of a circular Gaussian cloud (Rayleigh) is 1.1774 standard deviations.
    spread = float(np.median(distance)) / 1.1774
    return points[distance <= threshold * spread] if spread > 0 else points


def _pooled(
    scatter: RealArray, freedom: np.ndarray[tuple[int], np.dtype[np.int64]], centre: ComplexArray, m: int
) -> tuple[RealArray, np.ndarray[tuple[int], np.dtype[np.int64]]]:
    """Sums over m neighbours on either side of scatter relative to the centre, turned back to each centre."""
    if np.any(centre == 0):
        raise ValueError("pooling uses relative scatter, but a mean response is exactly zero")
    rotation = np.stack(
        [np.stack([centre.real, -centre.imag], -1), np.stack([centre.imag, centre.real], -1)], -2
    )
    inverse = np.linalg.inv(rotation)
    relative = inverse @ scatter @ inverse.transpose(0, 2, 1)
    totals, degrees = np.empty_like(relative), np.empty_like(freedom)
    for index in range(centre.size):
        window = slice(max(0, index - m), index + m + 1)
        totals[index], degrees[index] = relative[window].sum(axis=0), freedom[window].sum()
    return rotation @ totals @ rotation.transpose(0, 2, 1), degrees
