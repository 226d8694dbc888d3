"""Confidence ellipses in the complex plane: axes of 2x2 covariances, distances; and how much wider they
have to be where the covariance is itself estimated, from little data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg.blas import dtrmm
from scipy.special import fdtri

from ident.data.arrays import ComplexArray, RealArray, real_rows

# Below this multiple of the centre's magnitude a semi-axis is rounding, not knowledge.
_ROUNDING = 16 * np.finfo(np.float64).eps


@dataclass(frozen=True, eq=False)
class EllipseAxes:
    """{centre + s1 d1 u1 + s2 d2 (j u1), d1^2 + d2^2 <= 1}, one ellipse per frequency: semi_major s1 >=
    semi_minor s2 >= 0 (F,) in units of the response, direction u1 (F,) of modulus 1, up to its sign."""

    semi_major: RealArray
    semi_minor: RealArray
    direction: ComplexArray

    def __post_init__(self) -> None:
        if not (self.semi_major.shape == self.semi_minor.shape == self.direction.shape):
            raise ValueError(
                f"need three (F,) arrays; got {self.semi_major.shape}, {self.semi_minor.shape}, "
                f"{self.direction.shape}"
            )
        if not np.all((self.semi_major >= self.semi_minor) & (self.semi_minor >= 0)):
            raise ValueError("need semi_major >= semi_minor >= 0 at every frequency")
        for array in (self.semi_major, self.semi_minor, self.direction):
            array.setflags(write=False)

    def boundary(self, n_points: int = 64) -> ComplexArray:
        """Offsets from the centre of (F, n_points) points on the boundary, counted anticlockwise from u1."""
        angle = np.linspace(0.0, 2 * np.pi, n_points, endpoint=False)
        shape = self.semi_major[:, None] * np.cos(angle) + 1j * self.semi_minor[:, None] * np.sin(angle)
        return np.asarray(self.direction[:, None] * shape, dtype=np.complex128)


LEVEL = 0.95  # of ellipses and intervals where nobody says another


def chi2_radius(level: float) -> float:
    """sqrt of the chi-square quantile with two degrees of freedom: 2.4477 at 0.95."""
    if not 0 < level < 1:
        raise ValueError(f"a confidence level lies between 0 and 1; got {level}")
    return float(np.sqrt(-2 * np.log1p(-level)))


def standard_axes(covariance: RealArray) -> tuple[RealArray, RealArray, ComplexArray]:
    """Standard deviations along the principal axes of (F,2,2) covariances, major first, and its direction.
    The smaller eigenvalue is det / larger, no difference of nearly equal ones; below zero it is zero."""
    vr, vi, c = covariance[:, 0, 0], covariance[:, 1, 1], 0.5 * (covariance[:, 0, 1] + covariance[:, 1, 0])
    # Scaling by the trace keeps squares of tiny (1e-200) and huge variances inside the range of doubles.
    trace = vr + vi
    unit = np.where(trace > 0, trace, 1.0)
    r, i, k = vr / unit, vi / unit, c / unit
    major = 0.5 * (r + i) + np.hypot(0.5 * (r - i), k)
    minor = np.divide(r * i - k * k, major, out=np.zeros_like(major), where=major > 0)
    angle = 0.5 * np.arctan2(2 * k, r - i)
    scale = np.sqrt(unit)
    s1 = scale * np.sqrt(major)
    return s1, np.minimum(scale * np.sqrt(np.maximum(minor, 0.0)), s1), np.exp(1j * angle)


def spread_covariance(rows: ComplexArray, triangle: RealArray) -> RealArray:
    """Covariances (F,2,2) of (Re, Im) of rows (F,P) times numbers whose covariance is L L^T, L the lower
    triangle (P,P)."""
    # In real numbers, as the triangle is: half the products.
    spread = dtrmm(1.0, triangle, real_rows(rows).T, lower=1, trans_a=1, overwrite_b=1).T
    parts = spread[: len(rows)], spread[len(rows) :]
    covariance = np.empty((len(rows), 2, 2))
    for i, j in ((0, 0), (1, 1), (0, 1)):
        covariance[:, i, j] = covariance[:, j, i] = np.einsum("fk,fk->f", parts[i], parts[j])
    return covariance


def relative_deficit(covariance: RealArray) -> RealArray:
    """-(smallest eigenvalue) / largest entry of symmetric (F,2,2); positive where it is not a covariance."""
    trace = covariance[:, 0, 0] + covariance[:, 1, 1]
    k = 0.5 * (covariance[:, 0, 1] + covariance[:, 1, 0])
    smallest = 0.5 * trace - np.hypot(0.5 * (covariance[:, 0, 0] - covariance[:, 1, 1]), k)
    size = np.abs(covariance).max(axis=(1, 2))
    return np.asarray(np.divide(-smallest, size, out=np.zeros_like(size), where=size > 0))


def ellipse_distance(offset: ComplexArray, ellipses: EllipseAxes, magnitude: RealArray) -> RealArray:
    """Length of an offset (F,) in units of the ellipse: 0 at the centre, 1 on the boundary. Axes below the
    rounding of numbers of size magnitude (F,) count as that rounding."""
    aligned = offset * np.conj(ellipses.direction)
    floor = np.maximum(_ROUNDING * magnitude, np.finfo(np.float64).tiny)
    across = aligned.imag / np.maximum(ellipses.semi_minor, floor)
    return np.asarray(np.hypot(aligned.real / np.maximum(ellipses.semi_major, floor), across))


def hotelling_widening(freedom: npt.ArrayLike, level: float) -> npt.NDArray[np.float64]:
    """Factor on a 2x2 covariance estimated with so many degrees of freedom f > 1, so that its chi-square
    ellipse at `level` is Hotelling's: 2 f / (f - 1) F(2, f - 1) / chi2(2)."""
    f = np.asarray(freedom, dtype=np.float64)
    return np.asarray(2 * f / (f - 1) * fdtri(2, f - 1, level) / chi2_radius(level) ** 2)


def circular_widening(freedom: int, level: float) -> float:
    """The same of a variance alike in all directions of the plane, estimated with so many complex degrees of
    freedom f > 0: 2 F(2, 2 f) / chi2(2)."""
    return float(2 * fdtri(2, 2 * freedom, level) / chi2_radius(level) ** 2)
