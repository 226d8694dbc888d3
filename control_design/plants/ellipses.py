"""Ellipses of frequency-response uncertainty and the exact geometry control needs of them.

At every frequency the plant's response G is known up to one filled ellipse in the complex plane, E = {centre
+ u1 s1 d1 + j u1 s2 d2 : d1^2 + d2^2 <= 1}, with |u1| = 1 and s1 >= s2 >= 0. `Ellipses` holds F of them. The
functions below it answer what a certificate asks of an ellipse and a controller value k: how near the loop
comes to -1 (`distance_to_minus_one`), by how much the ellipse may grow until it does (`scale_to_minus_one`),
and the largest closed-loop gain (`largest_ratio`). All are exact up to rounding: no sampling of the boundary,
no enclosing disc. The loops over elements are compiled (`ellipse_kernels`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from ident.data.arrays import lock

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Integer = npt.NDArray[np.int64]
Boolean = npt.NDArray[np.bool_]

# A covariance may be off symmetry or definiteness by this share of its larger eigenvalue: products of factors
# of a few hundred coefficients leave 1e-13, stored files of nine digits 1e-9. Larger errors are mistakes.
_ROUNDING_SHARE = 1e-9


def radius_of(level: float) -> float:
    """Radius, in standard deviations, of the ellipse that holds a Gaussian of the plane with probability
    `level` in (0, 1): the root of the chi-square quantile with two degrees of freedom, 2.45 for .95.

    Not checked: inf at 1 and nan beyond, with numpy's warning.
    """
    return float(np.sqrt(-2.0 * np.log1p(-level)))


def quotient(above: Any, below: Real, otherwise: float = 0.0) -> Any:
    """above/below where below is positive, `otherwise` elsewhere.

    above is real or complex, below real; their shapes broadcast and no warning is given.

    Nan below counts as not positive. Shapes that do not broadcast are numpy's ValueError.
    """
    positive = below > 0
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        ratio = above / np.where(positive, below, 1.0)
        return np.where(positive, ratio, otherwise)


class ResponseSet(Protocol):
    """Uncertain responses on frequencies of their own, as a record of `ident` holds them."""

    @property
    def omega_rad_s(self) -> Real:
        """Ascending frequencies (F,) in rad/s."""
        ...

    @property
    def centre(self) -> Complex:
        """Middle of the response (F,), units of output per input."""
        ...

    @property
    def covariance(self) -> Real:
        """Covariance (F, 2, 2) of real and imaginary part."""
        ...

    @property
    def level(self) -> float:
        """Probability in (0, 1) that an ellipse of the record holds the response."""
        ...


@runtime_checkable
class EvaluableUncertainty(Protocol):
    """Uncertainty known at any frequency; `ident.uncertainty.ResponsePosterior` is one."""

    def at(self, omega_rad_s: Real, level: float) -> ResponseSet:
        """Responses and covariances at omega (F,) in rad/s, for ellipses of that level.

        Nothing is promised for a bad level: `Ellipses.from_covariance` checks it, and shapes and values.
        """
        ...


@dataclass(frozen=True, eq=False)
class Ellipses:
    """Filled uncertainty ellipses, one at each of F frequencies.

    Parameters
    ----------
    omega_rad_s : (F,) array
        Ascending, not negative.
    centre : (F,) complex array
        Middle of the response, units of output per input.
    semi_major, semi_minor : (F,) array
        Lengths of the half axes, semi_major >= semi_minor >= 0.
    direction : (F,) complex array
        Direction of the major axis, of modulus one (not checked); the minor axis is 1j * direction.

    Raises
    ------
    ValueError
        For arrays of different shapes, frequencies that do not ascend, a centre that is not finite, or axes
        that are negative or exchanged.
    """

    omega_rad_s: Real
    centre: Complex
    semi_major: Real
    semi_minor: Real
    direction: Complex

    def __post_init__(self) -> None:
        """Lock the arrays and check them.

        Raises the ValueError that the class names; directions are not checked.
        """
        lock(self, "omega_rad_s", "semi_major", "semi_minor")
        lock(self, "centre", "direction", dtype=np.complex128)
        shapes = {field.name: getattr(self, field.name).shape for field in fields(self)}
        if self.omega_rad_s.ndim != 1 or len(set(shapes.values())) != 1:
            raise ValueError(f"ellipses need arrays of one shape (F,); got {shapes}")
        if self.omega_rad_s.size and not (
            np.all(self.omega_rad_s >= 0) and np.all(np.diff(self.omega_rad_s) > 0)
        ):
            raise ValueError("ellipses need non-negative, strictly ascending omega_rad_s")
        if not np.all(np.isfinite(self.centre)):
            raise ValueError("ellipse centres must be finite; the plant may have a pole at a grid frequency")
        if not (np.all(self.semi_minor >= 0) and np.all(self.semi_major >= self.semi_minor)):
            raise ValueError("ellipse semi-axes need semi_major >= semi_minor >= 0")

    @classmethod
    def from_covariance(cls, omega_rad_s: Real, centre: Complex, covariance: Real, level: float) -> Ellipses:
        """Ellipses that hold a Gaussian response with probability `level`.

        Parameters
        ----------
        omega_rad_s : (F,) array
            Ascending frequencies.
        centre : (F,) complex array
            Mean of the response.
        covariance : (F, 2, 2) array
            P, of real and imaginary part.
        level : float
            Probability in (0, 1).

        Returns
        -------
        Ellipses
            e^T P^-1 e <= -2 ln(1 - level).

        Raises
        ------
        ValueError
            For a level outside (0, 1), or a covariance that is not symmetric positive semi-definite within
            rounding (the line names the frequency).
        """
        if not 0 < level < 1:
            raise ValueError(f"uncertainty: level must lie in (0, 1); got {level}")
        covariance = np.asarray(covariance, dtype=np.float64)
        if covariance.shape != (np.size(omega_rad_s), 2, 2):
            raise ValueError(f"uncertainty: covariance must be (F, 2, 2); got {covariance.shape}")
        real_variance = covariance[:, 0, 0]
        cross = covariance[:, 0, 1]
        cross_below = covariance[:, 1, 0]
        imag_variance = covariance[:, 1, 1]
        trace = real_variance + imag_variance
        difference = real_variance - imag_variance
        # Eigenvalues of the 2 x 2 matrix. The smaller one as determinant over the larger one keeps its
        # relative accuracy for thin ellipses, where a difference would leave rounding only.
        large = trace / 2 + np.hypot(difference / 2, cross)
        determinant = real_variance * imag_variance - cross * cross_below
        small = quotient(determinant, large)
        # Above zero, so that an ellipse of no size passes.
        tolerance = _ROUNDING_SHARE * np.abs(large) + 1e-300
        symmetric = np.abs(cross - cross_below) <= tolerance
        good = np.isfinite(trace) & (large >= 0) & (small >= -tolerance) & symmetric
        if not np.all(good):
            worst = float(np.asarray(omega_rad_s)[np.argmin(good)])
            raise ValueError(
                f"uncertainty: covariance at {worst:.4g} rad/s is not symmetric positive semi-definite"
            )
        quantile = radius_of(level) ** 2
        angle = 0.5 * np.arctan2(2 * cross, difference)
        semi_major = np.sqrt(quantile * large)
        semi_minor = np.sqrt(quantile * np.maximum(small, 0.0))
        # A circle's axes may come out exchanged by a rounding error.
        semi_minor = np.minimum(semi_minor, semi_major)
        return cls(np.asarray(omega_rad_s), centre, semi_major, semi_minor, np.exp(1j * angle))

    @classmethod
    def of_no_size(cls, omega_rad_s: Real, response: Complex) -> Ellipses:
        """Ellipses of size zero around a response (F,) that is known exactly at omega (F,) in rad/s.

        ValueError where the response is not finite or shapes differ.
        """
        zero = np.zeros(omega_rad_s.size)
        return cls(omega_rad_s, response, zero, zero, np.ones(zero.size, np.complex128))

    def scaled(self, factor: float) -> Ellipses:
        """Ellipses with both axes times a factor >= 0, their centres where they are.

        A negative factor is the constructor's ValueError.
        """
        return replace(self, semi_major=factor * self.semi_major, semi_minor=factor * self.semi_minor)

    def subset(self, index: Integer | Boolean) -> Ellipses:
        """The ellipses at the given positions (N,), integers or a mask (F,).

        IndexError for a position that is not there; ValueError where integers do not ascend.
        """
        return Ellipses(*(getattr(self, field.name)[index] for field in fields(self)))

    def joined(self, other: Ellipses) -> Ellipses:
        """Ellipses of both objects in ascending order of frequency; ValueError where they have one in
        common."""
        order = np.argsort(np.concatenate([self.omega_rad_s, other.omega_rad_s]))
        values = []
        for field in fields(self):
            both_values = np.concatenate([getattr(self, field.name), getattr(other, field.name)])
            values.append(both_values[order])
        return Ellipses(*values)

    def points(self, d1: Real, d2: Real) -> Complex:
        """Members centre + u1 s1 d1 + j u1 s2 d2, (..., F) complex.

        d1, d2 : (..., F) arrays
            Coordinates along major and minor axis in units of the half axes; in the ellipse for
            d1^2 + d2^2 <= 1.

        Not checked: that d1, d2 lie inside; shapes must broadcast with (F,).
        """
        offset = self.semi_major * d1 + 1j * self.semi_minor * d2
        return np.asarray(self.centre + self.direction * offset, dtype=np.complex128)

    def farthest(self) -> Real:
        """Largest |G| over each ellipse, (F,).

        In units of output per input.
        """
        origin_seen_from_ellipse = -self.centre * np.conj(self.direction)
        return farthest_distance(origin_seen_from_ellipse, self.semi_major, self.semi_minor)


def _of_each(name: str, *arrays: npt.ArrayLike, after: tuple[float, ...] = ()) -> Real:
    """What a function of `ellipse_kernels` gives for arrays that broadcast, of their common shape. after: its
    arguments that are no arrays.

    The module is imported where one is called, because numba takes a second. Real arrays of any kind are
    taken as doubles, complex ones as they are. ImportError where numba is not there; shapes that do not
    broadcast are numpy's ValueError.
    """
    from control_design.plants import ellipse_kernels

    together = np.broadcast_arrays(*arrays)
    flat = [
        np.ascontiguousarray(each, dtype=np.complex128 if np.iscomplexobj(each) else np.float64).ravel()
        for each in together
    ]
    found = getattr(ellipse_kernels, name)(*flat, *after)
    return np.asarray(found, dtype=np.float64).reshape(together[0].shape)


def secular_root(p: Real, q: Real, c: Real, d: Real) -> Real:
    """Root t >= 0 (F,) of (p/(c + t))^2 + (q/(d + t))^2 = 1 for p, q, c, d (F,), none negative; 0 where the
    left side is below 1 at t = 0. The condition of a nearest or farthest point of an ellipse comes to it.

    Shapes broadcast. Nothing is checked.
    """
    return _of_each("root_of_each", p, q, c, d)


def nearest_distance(point: Complex, semi_major: Real, semi_minor: Real) -> Real:
    """Distance (F,) from complex points (F,) to filled ellipses at the origin whose axes are parallel to the
    coordinate axes; 0 inside.

    With half axes a, b and the point (x, y), the nearest member is (a^2 x/(a^2 + t), b^2 y/(b^2 + t)), where
    t is the `secular_root` for p = a x, q = b y, c = a^2, d = b^2.

    All of one unit. Not checked: a >= b >= 0, and that all are finite.
    """
    return _of_each("nearest_of_each", np.asarray(point, dtype=np.complex128), semi_major, semi_minor)


def farthest_distance(point: Complex, semi_major: Real, semi_minor: Real) -> Real:
    """Distance (F,) from complex points (F,) to the farthest members of ellipses at the origin whose axes are
    parallel to the coordinate axes.

    With half axes a >= b and the point (x, y) in the first quadrant, the multiplier m is the largest root of
    (a x/(m - a^2))^2 + (b y/(m - b^2))^2 = 1, so n = m - a^2 is a `secular_root` for c = 0, d = a^2 - b^2.

    All of one unit. Not checked: a >= b >= 0.
    """
    return _of_each("farthest_of_each", np.asarray(point, dtype=np.complex128), semi_major, semi_minor)


def distance_to_minus_one(k: Complex, ellipses: Ellipses) -> Real:
    """Smallest |1 + G k| over G in each ellipse, (F,), exact; 0 where some member puts the loop on -1.

    k : (F,) complex array
        The controller's response with its delay, at the frequencies of the ellipses.

    No unit. Not checked: k is finite; of another length numpy raises ValueError.
    """
    size = np.abs(k)
    # 1 + G k = k u1 (conj(u1) (centre + 1/k) + s1 d1 + j s2 d2). With k (centre + 1/k) = 1 + k centre the
    # formula holds for k = 0 too, where the distance is one.
    turned = quotient((1.0 + k * ellipses.centre) * np.conj(k * ellipses.direction), size, 1.0)
    return nearest_distance(turned, size * ellipses.semi_major, size * ellipses.semi_minor)


def scale_to_minus_one(k: Complex, ellipses: Ellipses) -> Real:
    """Factor (F,) on the axes of each ellipse with which the loop of its members just reaches -1.

    k : (F,) complex array
        The controller's response with its delay.

    Below 1 the ellipse covers -1, the deeper the smaller; inf where no size of it does (k = 0, or an axis of
    length zero in the way).

    Not checked: a k that is not finite gives inf or nan.
    """
    # -1/k seen from the ellipse: its coordinates along the axes, in units of the half axes.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        turned = (1.0 + k * ellipses.centre) * np.conj(ellipses.direction) / k
        # An axis of length zero is no obstacle where nothing is to be reached along it.
        along_major = np.where(turned.real == 0, 0.0, np.abs(turned.real) / ellipses.semi_major)
        along_minor = np.where(turned.imag == 0, 0.0, np.abs(turned.imag) / ellipses.semi_minor)
    scale = np.hypot(along_major, along_minor)
    unreachable = (k == 0) | np.isnan(scale)
    return np.asarray(np.where(unreachable, np.inf, scale), dtype=np.float64)


def largest_disturbance_gain(k: Complex, ellipses: Ellipses) -> Real:
    """Largest |G / (1 + G k)| over G in each ellipse, (F,): `largest_ratio` with alpha = 1, beta = 0.

    In units of output per input; inf where a member puts the loop on -1.
    """
    return largest_ratio(np.ones_like(k), np.zeros_like(k), k, ellipses)


def largest_ratio(
    alpha: Complex, beta: Complex, k: Complex, ellipses: Ellipses, *, accuracy: float = 1e-13
) -> Real:
    """Largest |alpha G + beta| / |1 + k G| over G in each ellipse.

    Parameters
    ----------
    alpha, beta : (F,) complex array
        Linear numerator: 1 and 0 for the gain from a disturbance, 0 and 1 for the sensitivity.
    k : (F,) complex array
        The controller's response with its delay.
    ellipses : Ellipses
        Of the plant at F frequencies.
    accuracy : float
        Relative; the bisection ends there. 1e-13 is some five hundred roundings of doubles.

    Returns
    -------
    (F,) array
        Rounded up by at most the accuracy; inf where some member has 1 + k G = 0. Values that are not finite
        are not checked; shapes that do not broadcast are numpy's ValueError.

    Notes
    -----
    |alpha G + beta| <= h |1 + k G| is an Apollonius set. With A = |alpha|^2 - h^2 |k|^2,
    g0 = (h^2 conj(k) - conj(alpha) beta)/A and r = h |alpha - k beta|/|A| it is |G - g0| <= r for A > 0 and
    |G - g0| >= r for A < 0. Whether the ellipse lies in it is told by its exact farthest or nearest distance
    from g0. The smallest such h is found by bisection, from the value at the centre up to
    (|alpha centre + beta| + |alpha| semi_major)/min|1 + k G|.
    """
    distance = distance_to_minus_one(k, ellipses)
    blocked = distance <= 0.0
    centre_numerator = np.abs(alpha * ellipses.centre + beta)
    centre_denominator = np.abs(1.0 + k * ellipses.centre)
    largest_numerator = centre_numerator + np.abs(alpha) * ellipses.semi_major
    upper = largest_numerator / np.where(blocked, 1.0, distance)
    # Where the centre itself is on -1 the quotient is not used: it only has to be a number.
    low = centre_numerator / np.maximum(centre_denominator, 1e-300)
    # A little above, so that rounding of the two ends does not begin the bisection with an empty interval.
    high = np.maximum(upper, low) * (1 + 1e-12) + 1e-300
    low = np.minimum(low, high)
    complex_ones = (np.asarray(each, dtype=np.complex128) for each in (alpha, beta, k))
    shape = (ellipses.centre, ellipses.direction, ellipses.semi_major, ellipses.semi_minor)
    high = _of_each("bisected_of_each", low, high, *complex_ones, *shape, after=(accuracy,))
    return np.asarray(np.where(blocked, np.inf, high), dtype=np.float64)
