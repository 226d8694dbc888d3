"""Confidence ellipses in the complex plane: their axes, distances in their units, and their widening.

A complex response that is known with a 2x2 covariance of its real and imaginary part lies, at each frequency
and with a given probability, in an ellipse: axes from the covariance (`standard_axes`), size from the
chi-square quantile with two degrees of freedom (`chi2_radius`). Where the covariance is itself estimated from
little data the ellipse has to be wider, by Hotelling's T-squared (`hotelling_widening`, `circular_widening`;
T. W. Anderson, An Introduction to Multivariate Statistical Analysis, chapter 5). Assumed: Gaussian errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg.blas import dtrmm
from scipy.special import fdtri

from ident.data.arrays import ComplexArray, RealArray, real_rows

# Confidence level of ellipses and intervals where nobody says another: convention, 1 in 20 outside.
LEVEL = 0.95
# A semi-axis below this multiple of the centre's magnitude is rounding, not knowledge: the sixteenfold
# precision of doubles is what a few operations leave, each half of it at most. Chosen.
ROUNDING = 16 * np.finfo(np.float64).eps


@dataclass(frozen=True, eq=False)
class EllipseAxes:
    """One ellipse per frequency: centre + s1 d1 u1 + s2 d2 (j u1) for all d1^2 + d2^2 <= 1.

    Attributes
    ----------
    semi_major, semi_minor : ndarray, shape (F,)
        s1 >= s2 >= 0, in units of the response.
    direction : ndarray, shape (F,)
        u1, complex of modulus 1, up to its sign.

    Raises
    ------
    ValueError
        Other shapes, or axes in the wrong order.
    """

    semi_major: RealArray
    semi_minor: RealArray
    direction: ComplexArray

    def __post_init__(self) -> None:
        """Check shapes and order, and lock the arrays.

        Raises ValueError for other shapes, or axes that are NaN, negative or in the wrong order. The arrays
        themselves are locked, no copies.
        """
        if not (self.semi_major.shape == self.semi_minor.shape == self.direction.shape):
            raise ValueError(
                f"need three (F,) arrays; got {self.semi_major.shape}, {self.semi_minor.shape}, "
                f"{self.direction.shape}"
            )
        if not (np.all(self.semi_major >= self.semi_minor) and np.all(self.semi_minor >= 0)):
            raise ValueError("need semi_major >= semi_minor >= 0 at every frequency")
        for array in (self.semi_major, self.semi_minor, self.direction):
            array.setflags(write=False)

    def boundary(self, n_points: int = 64) -> ComplexArray:
        """Return complex offsets (F, n_points) of points on the boundary from the centre, anticlockwise from
        u1.

        In units of the response. 64 points, the default, are a polygon that lies inside of the ellipse by .1
        % of an axis, which no drawing shows. 0 points give none; a negative number is numpy's ValueError.
        """
        angle = np.linspace(0.0, 2 * np.pi, n_points, endpoint=False)
        along_major = self.semi_major[:, None] * np.cos(angle)
        along_minor = 1j * self.semi_minor[:, None] * np.sin(angle)
        offsets = self.direction[:, None] * (along_major + along_minor)
        return np.asarray(offsets, dtype=np.complex128)


def chi2_radius(level: float) -> float:
    """Return the square root of the chi-square quantile with two degrees of freedom: 2.4477 at 0.95.

    It is the size of an ellipse at a confidence level, in standard deviations. Raises ValueError unless the
    level lies between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"a confidence level lies between 0 and 1; got {level}")
    # With two degrees of freedom the distribution is exponential, and its quantile -2 ln(1 - level).
    return float(np.sqrt(-2 * np.log1p(-level)))


class StandardAxes(NamedTuple):
    """Principal axes of F covariances.

    Attributes
    ----------
    major, minor : ndarray, shape (F,)
        Standard deviations along the axes, major >= minor >= 0.
    direction : ndarray, shape (F,)
        Of the major axis, complex of modulus 1.
    """

    major: RealArray
    minor: RealArray
    direction: ComplexArray


def standard_axes(covariance: RealArray) -> StandardAxes:
    """Return the standard deviations along the principal axes of covariances, and their direction.

    Parameters
    ----------
    covariance : ndarray, shape (F, 2, 2)
        Of (Re, Im); the mean of the two entries beside the diagonal counts. Not checked: matrices that are no
        covariances have axes cut off at zero, or NaN (`relative_deficit` tells).

    Notes
    -----
    Eigenvalues in closed form. The smaller one is determinant / larger, no difference of nearly equal ones;
    below zero, which is rounding, it is zero.
    """
    variance_re = covariance[:, 0, 0]
    variance_im = covariance[:, 1, 1]
    cross = 0.5 * (covariance[:, 0, 1] + covariance[:, 1, 0])

    # Scaling by the trace keeps squares of tiny (1e-200) and huge variances inside the range of doubles.
    trace = variance_re + variance_im
    unit = np.where(trace > 0, trace, 1.0)
    r = variance_re / unit
    i = variance_im / unit
    c = cross / unit
    # Eigenvalues lie on either side of their mean; the determinant is their product.
    larger = 0.5 * (r + i) + np.hypot(0.5 * (r - i), c)
    smaller = np.divide(r * i - c * c, larger, out=np.zeros_like(larger), where=larger > 0)
    angle = 0.5 * np.arctan2(2 * c, r - i)

    scale = np.sqrt(unit)
    major = scale * np.sqrt(larger)
    minor = scale * np.sqrt(np.maximum(smaller, 0.0))
    return StandardAxes(major, np.minimum(minor, major), np.exp(1j * angle))


def spread_covariance(rows: ComplexArray, triangle: RealArray) -> RealArray:
    """Return the covariances (F, 2, 2) of the real and imaginary part of rows times uncertain numbers.

    Parameters
    ----------
    rows : ndarray, shape (F, P)
        Complex; row f times the P real numbers is the response at frequency f.
    triangle : ndarray, shape (P, P)
        Lower triangle L, where L L^T is the covariance of the numbers. What stands above it is not read.
        Shapes that do not fit raise an error of BLAS or numpy; NaN spreads.
    """
    # In real numbers, as the triangle is: half the products. dtrmm leaves the zeros of the triangle out.
    spread = dtrmm(1.0, triangle, real_rows(rows).T, lower=1, trans_a=1, overwrite_b=1).T
    real_part = spread[: len(rows)]
    imaginary_part = spread[len(rows) :]
    covariance = np.empty((len(rows), 2, 2))
    covariance[:, 0, 0] = np.einsum("fk,fk->f", real_part, real_part)
    covariance[:, 1, 1] = np.einsum("fk,fk->f", imaginary_part, imaginary_part)
    cross = np.einsum("fk,fk->f", real_part, imaginary_part)
    covariance[:, 0, 1] = cross
    covariance[:, 1, 0] = cross
    return covariance


def relative_deficit(covariance: RealArray) -> RealArray:
    """Return by how much symmetric (F, 2, 2) matrices fail to be covariances, (F,); positive where they do.

    It is the smallest eigenvalue with its sign turned, over the largest entry; 0 for a matrix of zeros. Only
    the mean of the entries beside the diagonal counts; NaN gives 0, so that the caller has to ask whether
    numbers are finite.
    """
    trace = covariance[:, 0, 0] + covariance[:, 1, 1]
    cross = 0.5 * (covariance[:, 0, 1] + covariance[:, 1, 0])
    half_difference = 0.5 * (covariance[:, 0, 0] - covariance[:, 1, 1])
    smallest = 0.5 * trace - np.hypot(half_difference, cross)
    size = np.abs(covariance).max(axis=(1, 2))
    return np.asarray(np.divide(-smallest, size, out=np.zeros_like(size), where=size > 0))


def ellipse_distance(offset: ComplexArray, ellipses: EllipseAxes, magnitude: RealArray) -> RealArray:
    """Return the length of offsets from the centre in units of the ellipse: 1 on the boundary.

    Parameters
    ----------
    offset : ndarray, shape (F,)
        Complex, response less centre. Finite; not checked.
    ellipses : EllipseAxes
        F of them: half-axes in units of the response, and the direction of the major one.
    magnitude : ndarray, shape (F,)
        Size of the numbers whose difference the offset is. Axes below their rounding count as that rounding,
        so that an exact point holds itself.

    Returns
    -------
    ndarray, shape (F,)
    """
    # Turned so that the major axis is the real one.
    in_axes = offset * np.conj(ellipses.direction)
    shortest = np.maximum(ROUNDING * magnitude, np.finfo(np.float64).tiny)
    along_major = in_axes.real / np.maximum(ellipses.semi_major, shortest)
    along_minor = in_axes.imag / np.maximum(ellipses.semi_minor, shortest)
    return np.asarray(np.hypot(along_major, along_minor))


def hotelling_widening(freedom: npt.ArrayLike, level: float) -> npt.NDArray[np.float64]:
    """Return the factor on a 2x2 covariance that was estimated with few degrees of freedom.

    Parameters
    ----------
    freedom : array-like
        Degrees of freedom f > 1 of the estimate, of any shape. Not checked: f = 1 or less gives NaN.
    level : float
        Confidence level; ValueError outside of 0 to 1.

    Returns
    -------
    ndarray
        Of the shape of `freedom`: 2 f / (f - 1) F(2, f - 1) / chi2(2), quantiles at `level`. With it the
        chi-square ellipse of the covariance is Hotelling's.
    """
    # T^2 of a mean with f degrees of freedom is 2 f / (f - 1) F(2, f - 1).
    f = np.asarray(freedom, dtype=np.float64)
    f_quantile = fdtri(2, f - 1, level)
    return np.asarray(2 * f / (f - 1) * f_quantile / chi2_radius(level) ** 2)


def circular_widening(freedom: int, level: float) -> float:
    """Return the factor on a variance alike in all directions of the plane, estimated from few data.

    Parameters
    ----------
    freedom : int
        Complex degrees of freedom f > 0 of the estimate. Not checked: 0 gives NaN.
    level : float
        Confidence level; ValueError outside of 0 to 1.

    Returns
    -------
    float
        2 F(2, 2 f) / chi2(2), quantiles at `level`. It is smaller than Hotelling's, as one variance is
        estimated in place of three numbers.
    """
    f_quantile = fdtri(2, 2 * freedom, level)
    return float(2 * f_quantile / chi2_radius(level) ** 2)
