"""Measured frequency responses from files and from repeated points, as arrays."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.stats import f as f_distribution

from ident.data.arrays import ComplexArray, RealArray
from ident.data.ellipses import chi2_radius

FREQUENCY_COLUMNS = {"omega_rad_s": 1.0, "omega_rad_per_s": 1.0, "frequency_Hz": 2 * np.pi}
"""Names a frequency column may have, and the factor to rad/s."""
_COLUMNS = ("real", "imag", "variance_real", "variance_imag")
_CROSS = "covariance_real_imag"


def read_frequency_table(path: Path) -> tuple[RealArray, ComplexArray, RealArray]:
    """omega (F,), response (F,), covariance (F,2,2) from the columns of `FrequencyUncertainty.from_csv`."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise ValueError(f"{path}: there is no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read as text ({error})") from error
    rows = csv.reader(text.splitlines())
    header = [name.strip() for name in next(rows, [])]
    frequency = [name for name in FREQUENCY_COLUMNS if name in header]
    if len(frequency) != 1:
        raise ValueError(
            f"{path}, line 1: need exactly one of the columns {', '.join(FREQUENCY_COLUMNS)}; found {header}"
        )
    missing = [name for name in _COLUMNS if name not in header]
    if missing:
        raise ValueError(f"{path}, line 1: missing column {', '.join(missing)}; found {header}")
    wanted = [frequency[0], *_COLUMNS, *([_CROSS] if _CROSS in header else [])]
    values: list[list[float]] = []
    for row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(header):
            raise ValueError(
                f"{path}, line {rows.line_num}: {len(row)} cells where the header has {len(header)}"
            )
        values.append([number_of_cell(row[header.index(name)], path, rows.line_num, name) for name in wanted])
        if values[-1][3] < 0 or values[-1][4] < 0:
            raise ValueError(f"{path}, line {rows.line_num}: a variance is negative")
    if not values:
        raise ValueError(f"{path}: no rows under the header")
    table = np.array(values)
    cross = table[:, 5] if table.shape[1] > 5 else np.zeros(len(table))
    covariance = np.stack([np.stack([table[:, 3], cross], -1), np.stack([cross, table[:, 4]], -1)], -2)
    return table[:, 0] * FREQUENCY_COLUMNS[frequency[0]], table[:, 1] + 1j * table[:, 2], covariance


def write_frequency_table(
    path: Path, omega_rad_s: RealArray, centre: ComplexArray, covariance: RealArray
) -> None:
    """The columns `read_frequency_table` reads, every number with all its digits."""
    lines = [",".join(("omega_rad_s", *_COLUMNS, _CROSS))]
    for omega, g, c in zip(omega_rad_s, centre, covariance, strict=True):
        numbers = (omega, g.real, g.imag, c[0, 0], c[1, 1], c[0, 1])
        lines.append(",".join(repr(float(number)) for number in numbers))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


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


def number_of_cell(cell: str, path: Path, line: int, column: str) -> float:
    try:
        value = float(cell)
    except ValueError as error:
        raise ValueError(
            f"{path}, line {line}, column {column}: expected a number, found {cell!r}"
        ) from error
    if not np.isfinite(value):
        raise ValueError(f"{path}, line {line}, column {column}: expected a finite number, found {cell!r}")
    return value


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
