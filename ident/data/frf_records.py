"""Repeated measurements of one frequency response, point by point: reading, choosing, opening the loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np

from ident.data.arrays import BoolArray, ComplexArray, IntArray, RealArray, factor_matrices, lock
from ident.data.ellipses import hotelling_widening
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record_files import read_table
from ident.data.response_columns import has_response, read_response

# Neighbours on either side that a hint may propose to pool.
_MOST_NEIGHBOURS = 50


@dataclass(frozen=True, eq=False)
class FrfRepeats:
    """Measured points of a frequency response: omega_rad_s (K,), response (K,), label (K,) or none.

    Points of equal frequency are repeats; the label is their condition (date, amplitude). Raises ValueError
    for other shapes or numbers that are not finite.
    """

    omega_rad_s: RealArray
    response: ComplexArray
    label: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        lock(self, "omega_rad_s")
        lock(self, "response", dtype=np.complex128)
        size = self.omega_rad_s.size
        object.__setattr__(self, "label", tuple(self.label) or ("",) * size)
        if self.omega_rad_s.shape != (size,) or self.response.shape != (size,) or len(self.label) != size:
            raise ValueError(
                f"need omega, response and label of one length; got {self.omega_rad_s.shape}, "
                f"{self.response.shape} and {len(self.label)}"
            )
        if not (size > 0 and np.all(np.isfinite(self.omega_rad_s)) and np.all(np.isfinite(self.response))):
            raise ValueError("need at least one point, and finite frequencies and responses")

    @classmethod
    def from_csv(cls, path: str | Path, *, label: str | None = None) -> Self:
        """One row per measured point: a frequency (Hz, rad/s), real and imaginary part or gain (factor, dB)
        and phase (rad, degrees), under any usual names that say their units, and the column named by `label`.

        Raises ValueError in one line naming file, line and column; where a unit is not said, it asks for it.
        """
        table = read_table(path)
        if label is not None and label not in table.names:
            raise ValueError(f"{table.path}, line 1: missing column {label}; found {list(table.names)}")
        omega, response = read_response(table)
        labels = [""] * response.size if label is None else [str(cell).strip() for cell in table.raw[label]]
        return cls(omega, response, tuple(labels))

    @property
    def labels(self) -> tuple[str, ...]:
        """The different labels, in the order they come."""
        return tuple(dict.fromkeys(self.label))

    def only(self, *labels: str) -> FrfRepeats:
        """Points of the given conditions. Raises ValueError if one does not occur."""
        for wanted in labels:
            if wanted not in self.label:
                raise ValueError(f"no point is labelled {wanted!r}; there are {list(self.labels)}")
        return self._chosen(np.array([name in labels for name in self.label]))

    def band(self, omega_min_rad_s: float, omega_max_rad_s: float) -> FrfRepeats:
        """Points with omega_min <= omega <= omega_max."""
        return self._chosen((self.omega_rad_s >= omega_min_rad_s) & (self.omega_rad_s <= omega_max_rad_s))

    def open_loop(self, reference_gain: float, feedback_gain: float) -> FrfRepeats:
        """Plant responses from those of the closed loop r -> y under u = reference_gain r - feedback_gain y:
        G = T / (a - g T) point by point. Raises ValueError where a - g T is zero."""
        rest = reference_gain - feedback_gain * self.response
        if np.any(rest == 0):
            at = self.omega_rad_s[int(np.argmax(rest == 0))]
            raise ValueError(f"at omega = {at:.6g} rad/s a point of the closed loop is exactly a / g")
        return FrfRepeats(self.omega_rad_s, self.response / rest, self.label)

    def mean(
        self,
        dt_s: float,
        *,
        level: float = 0.95,
        pool_neighbours: int = 0,
        outlier_threshold: float | None = None,
        of: Literal["mean", "next run"] = "mean",
    ) -> FrequencyUncertainty:
        """Centre and covariance of the mean over all points of each frequency.

        The covariance is widened until the ellipse of the chi-square quantile at `level` equals Hotelling's
        (variance x 1.7 with 10 repeats, x 9.5 with 4, x 133 with 3). pool_neighbours = m averages relative
        covariances over m frequencies on either side first. outlier_threshold = t drops points farther than t
        robust standard deviations from the median of their frequency. of = "next run": the region of one more
        run (Hotelling's prediction region). Raises ValueError where a frequency is left with too few repeats.
        """
        if pool_neighbours < 0:
            raise ValueError(f"pool_neighbours must not be negative; got {pool_neighbours}")
        if outlier_threshold is not None and not outlier_threshold > 0:
            raise ValueError(f"outlier_threshold must be positive; got {outlier_threshold}")
        grid, group = np.unique(self.omega_rad_s, return_inverse=True)
        centre = np.empty(grid.size, dtype=np.complex128)
        scatter = np.empty((grid.size, 2, 2))
        count = np.empty(grid.size, dtype=np.int64)
        for index in range(grid.size):
            points = self.response[group == index]
            if outlier_threshold is not None:
                points = inliers(points, outlier_threshold)
            centre[index] = points.mean()
            deviation = points - centre[index]
            pair = np.stack([deviation.real, deviation.imag])
            scatter[index], count[index] = pair @ pair.T, points.size
        freedom = count - 1
        if pool_neighbours:
            scatter, freedom = _pooled(scatter, freedom, centre, pool_neighbours)
        if np.any(freedom < 2):
            raise ValueError(_too_few(grid, count, freedom))
        share = 1 / count if of == "mean" else 1 + 1 / count
        covariance = scatter * (hotelling_widening(freedom, level) * share / freedom)[:, None, None]
        method = "repeated measurements" if of == "mean" else "one more run"
        return FrequencyUncertainty(grid, centre, covariance, dt_s, level, method)

    def _chosen(self, keep: BoolArray) -> FrfRepeats:
        if not np.any(keep):
            raise ValueError("no measured point is left")
        return FrfRepeats(
            self.omega_rad_s[keep],
            self.response[keep],
            tuple(name for name, kept in zip(self.label, keep, strict=True) if kept),
        )


def is_response(*paths: Path) -> bool:
    """Whether the files are frequency responses; one that cannot be read is left to others."""
    try:
        return all(has_response(read_table(path)) for path in paths)
    except ValueError:
        return False


def measured_response(
    paths: Sequence[Path],
    dt_s: float,
    *,
    level: float = 0.95,
    pool_neighbours: int = 0,
    outlier_threshold: float | None = None,
) -> FrequencyUncertainty | FrfRepeats:
    """Of a table with variances, or the mean of repeated sweeps in one file or several (`FrfRepeats.mean`);
    the points themselves where each frequency is measured once. Raises ValueError naming the file."""
    if len(paths) == 1 and "variance_real" in (names := read_table(paths[0]).names):
        known = {"variance_real", "variance_imag", "covariance_real_imag"}
        for column in names:
            # A covariance under another name would be left out in silence, and the ellipses be wrong.
            if column not in known and ("covar" in column.lower() or "varian" in column.lower()):
                raise ValueError(
                    f"{paths[0]}, line 1: unknown column {column!r}; the spread stands in "
                    f"{', '.join(sorted(known))}"
                )
        return FrequencyUncertainty.from_csv(paths[0], dt_s, level=level)
    sweeps = [FrfRepeats.from_csv(path) for path in paths]
    omega, response = (
        np.concatenate([getattr(one, name) for one in sweeps]) for name in ("omega_rad_s", "response")
    )
    found = FrfRepeats(omega, response)
    if np.unique(omega).size == omega.size:
        return found
    return found.mean(dt_s, level=level, pool_neighbours=pool_neighbours, outlier_threshold=outlier_threshold)


def _too_few(grid: RealArray, count: IntArray, freedom: IntArray) -> str:
    """What is missing for a covariance, and only what mends it."""
    spread = "give variance_real, variance_imag or a stated uncertainty"
    if np.all(count == 1):
        return f"one sweep: every frequency is measured once, so its spread is not known; {spread}"
    at = int(np.argmax(freedom < 2))
    times = "is 1 measurement" if count[at] == 1 else f"are {count[at]} repeats"
    text = f"at omega = {grid[at]:.6g} rad/s there {times}: a 2x2 covariance needs at least 3"
    # The fewest neighbours whose repeats suffice everywhere, each frequency giving one less than it has.
    for m in range(1, _MOST_NEIGHBOURS + 1):
        sums = np.convolve(count - 1, np.ones(2 * m + 1, dtype=np.int64))[m:-m]
        if np.all(sums >= 2):
            return f"{text}, or pool_neighbours = {m}"
    return f"{text}; {spread}"


def inliers(points: ComplexArray, threshold: float) -> ComplexArray:
    """Points within `threshold` robust standard deviations of the median, in one pass: repeated, it shrinks
    by chance."""
    distance = np.abs(points - (np.median(points.real) + 1j * np.median(points.imag)))
    # The median distance of a circular Gaussian cloud (Rayleigh) is 1.1774 standard deviations.
    spread = float(np.median(distance)) / 1.1774
    return points[distance <= threshold * spread] if spread > 0 else points


def _pooled(
    scatter: RealArray, freedom: IntArray, centre: ComplexArray, m: int
) -> tuple[RealArray, IntArray]:
    """Sums over m neighbours on either side of scatter relative to the centre, turned back to each centre."""
    if np.any(centre == 0):
        raise ValueError("pooling uses relative scatter, but a mean response is exactly zero")
    rotation = factor_matrices(centre)
    inverse = np.linalg.inv(rotation)
    relative = inverse @ scatter @ inverse.transpose(0, 2, 1)
    totals, degrees = np.empty_like(relative), np.empty_like(freedom)
    for index in range(centre.size):
        window = slice(max(0, index - m), index + m + 1)
        totals[index], degrees[index] = relative[window].sum(axis=0), freedom[window].sum()
    return rotation @ totals @ rotation.transpose(0, 2, 1), degrees
