"""Ellipses of frequency-response uncertainty and the exact geometry control needs of them.

One frequency, one filled ellipse E = {centre + u1 s1 d1 + j u1 s2 d2 : d1^2 + d2^2 <= 1} in the complex
plane, |u1| = 1, s1 >= s2 >= 0. Exact up to rounding: no sampling of the boundary, no enclosing disc.
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


def radius_of(level: float) -> float:
    """Radius, in standard deviations, of the ellipse that holds a plane Gaussian with probability level."""
    return float(np.sqrt(-2.0 * np.log1p(-level)))


def quotient(above: Any, below: Real, otherwise: float = 0.0) -> Any:
    """above/below where below is positive, `otherwise` elsewhere; real or complex, shapes broadcast."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        return np.where(below > 0, above / np.where(below > 0, below, 1.0), otherwise)


class ResponseSet(Protocol):
    """omega_rad_s (F,), centre (F,) complex, covariance (F, 2, 2) of (real, imaginary), level in (0, 1)."""

    @property
    def omega_rad_s(self) -> Real: ...
    @property
    def centre(self) -> Complex: ...
    @property
    def covariance(self) -> Real: ...
    @property
    def level(self) -> float: ...


@runtime_checkable
class EvaluableUncertainty(Protocol):
    """Uncertainty known at any frequency; `ident.uncertainty.ResponsePosterior` is one."""

    def at(self, omega_rad_s: Real, level: float) -> ResponseSet: ...


@dataclass(frozen=True, eq=False)
class Ellipses:
    """Filled uncertainty ellipses: omega_rad_s (F,) ascending, centre (F,), semi_major >= semi_minor >= 0
    (F,), direction (F,) of the major axis, of modulus one; the minor axis is 1j * direction."""

    omega_rad_s: Real
    centre: Complex
    semi_major: Real
    semi_minor: Real
    direction: Complex

    def __post_init__(self) -> None:
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
        """Ellipse e^T P^-1 e <= -2 ln(1 - level) of covariance P (F, 2, 2). Raises ValueError if level is
        outside (0, 1) or a covariance is not symmetric positive semi-definite (names the frequency)."""
        if not 0 < level < 1:
            raise ValueError(f"uncertainty: level must lie in (0, 1); got {level}")
        covariance = np.asarray(covariance, dtype=np.float64)
        if covariance.shape != (np.size(omega_rad_s), 2, 2):
            raise ValueError(f"uncertainty: covariance must be (F, 2, 2); got {covariance.shape}")
        a, b, d = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
        trace = a + d
        large = trace / 2 + np.hypot((a - d) / 2, b)
        # small = determinant / large keeps the relative accuracy of thin ellipses.
        determinant = a * d - b * covariance[:, 1, 0]
        small = quotient(determinant, large)
        tolerance = 1e-9 * np.abs(large) + 1e-300
        good = (
            np.isfinite(trace)
            & (large >= 0)
            & (small >= -tolerance)
            & (np.abs(b - covariance[:, 1, 0]) <= tolerance)
        )
        if not np.all(good):
            worst = float(np.asarray(omega_rad_s)[np.argmin(good)])
            raise ValueError(
                f"uncertainty: covariance at {worst:.4g} rad/s is not symmetric positive semi-definite"
            )
        quantile, angle = radius_of(level) ** 2, 0.5 * np.arctan2(2 * b, a - d)
        semi_major = np.sqrt(quantile * large)
        semi_minor = np.minimum(np.sqrt(quantile * np.maximum(small, 0.0)), semi_major)
        return cls(np.asarray(omega_rad_s), centre, semi_major, semi_minor, np.exp(1j * angle))

    @classmethod
    def of_no_size(cls, omega_rad_s: Real, response: Complex) -> Ellipses:
        """A response that is known exactly, (F,)."""
        zero = np.zeros(omega_rad_s.size)
        return cls(omega_rad_s, response, zero, zero, np.ones(zero.size, np.complex128))

    def scaled(self, factor: float) -> Ellipses:
        """Axes times a factor."""
        return replace(self, semi_major=factor * self.semi_major, semi_minor=factor * self.semi_minor)

    def subset(self, index: Integer | Boolean) -> Ellipses:
        """The ellipses at the given positions."""
        return Ellipses(*(getattr(self, field.name)[index] for field in fields(self)))

    def joined(self, other: Ellipses) -> Ellipses:
        """These and others, at other frequencies, in ascending order."""
        order = np.argsort(np.concatenate([self.omega_rad_s, other.omega_rad_s]))
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return Ellipses(*(np.concatenate(pair)[order] for pair in pairs))

    def points(self, d1: Real, d2: Real) -> Complex:
        """Members centre + u1 s1 d1 + j u1 s2 d2; d1, d2 broadcast against (F,) on the last axis."""
        return np.asarray(
            self.centre + self.direction * (self.semi_major * d1 + 1j * self.semi_minor * d2),
            dtype=np.complex128,
        )

    def farthest(self) -> Real:
        """max |G| over each ellipse, (F,)."""
        return farthest_distance(-self.centre * np.conj(self.direction), self.semi_major, self.semi_minor)


def _compiled() -> Any:
    """The compiled functions, imported where one is called."""
    from control_design.plants import ellipse_kernels

    return ellipse_kernels


def secular_root(p: Real, q: Real, c: Real, d: Real) -> Real:
    """Root t >= 0 (F,) of (p/(c + t))^2 + (q/(d + t))^2 = 1 for p, q, c, d >= 0; 0 where the sum is below 1
    there."""
    with np.errstate(all="ignore"):  # compiled loops divide first and choose then
        return np.asarray(_compiled().root_of_each(p, q, c, d), dtype=np.float64)


def nearest_distance(point: Complex, semi_major: Real, semi_minor: Real) -> Real:
    """Distance (F,) from `point` to the filled axis-parallel ellipse at the origin; 0 inside. The nearest
    point is (a^2 x/(a^2 + t), b^2 y/(b^2 + t)), t the `secular_root`."""
    with np.errstate(all="ignore"):
        return np.asarray(_compiled().nearest_of_each(point, semi_major, semi_minor), dtype=np.float64)


def farthest_distance(point: Complex, semi_major: Real, semi_minor: Real) -> Real:
    """Distance (F,) from `point` to the farthest point of the axis-parallel ellipse at the origin: with x, y
    >= 0 the multiplier m is the largest root of (a x/(m - a^2))^2 + (b y/(m - b^2))^2 = 1, n = m - a^2 a
    `secular_root`."""
    with np.errstate(all="ignore"):
        return np.asarray(_compiled().farthest_of_each(point, semi_major, semi_minor), dtype=np.float64)


def distance_to_minus_one(k: Complex, ellipses: Ellipses) -> Real:
    """min |1 + G k| over G in E, (F,), exact; 0 where some member puts the loop on -1. k (F,): the controller
    with its delay."""
    size = np.abs(k)
    # 1 + G k = k u1 (conj(u1) (centre + 1/k) + s1 d1 + j s2 d2); work with k (centre + 1/k) = 1 + k centre.
    turned = quotient((1.0 + k * ellipses.centre) * np.conj(k * ellipses.direction), size, 1.0)
    return nearest_distance(turned, size * ellipses.semi_major, size * ellipses.semi_minor)


def scale_to_minus_one(k: Complex, ellipses: Ellipses) -> Real:
    """Factor (F,) on each ellipse's axes with which it just reaches -1 with K: below 1 it covers -1, the
    deeper the smaller; inf where no size of it does (K = 0, or an axis of no length in the way)."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        turned = (1.0 + k * ellipses.centre) * np.conj(ellipses.direction) / k
        sides = [
            np.where(part == 0, 0.0, np.abs(part) / axis)
            for part, axis in ((turned.real, ellipses.semi_major), (turned.imag, ellipses.semi_minor))
        ]
    scale = np.hypot(*sides)
    return np.asarray(np.where((k == 0) | np.isnan(scale), np.inf, scale), dtype=np.float64)


def largest_disturbance_gain(k: Complex, ellipses: Ellipses) -> Real:
    """max |G / (1 + G k)| over G in E at every frequency, (F,); see `largest_ratio`."""
    return largest_ratio(np.ones_like(k), np.zeros_like(k), k, ellipses)


def largest_ratio(
    alpha: Complex, beta: Complex, k: Complex, ellipses: Ellipses, *, accuracy: float = 1e-13
) -> Real:
    """max |alpha G + beta| / |1 + k G| over G in E at every frequency, (F,), rounded up by at most the
    relative accuracy; inf where some member has 1 + k G = 0.

    With A = |alpha|^2 - h^2 |k|^2, |alpha G + beta| <= h |1 + k G| is an Apollonius set: |G - g0| <= r for A
    > 0, >= r for A < 0, with g0 = (h^2 conj(k) - conj(alpha) beta)/A and r = h |alpha - k beta|/|A|. The
    ellipse lies in it or not by its exact nearest/farthest distance from g0; h by bisection from the centre's
    value to (|alpha centre + beta| + |alpha| semi_major)/min|1 + k G|.
    """
    e = ellipses
    distance = distance_to_minus_one(k, e)
    blocked = distance <= 0.0
    centre_value = np.abs(alpha * e.centre + beta)
    upper = (centre_value + np.abs(alpha) * e.semi_major) / np.where(blocked, 1.0, distance)
    low = centre_value / np.maximum(np.abs(1.0 + k * e.centre), 1e-300)
    high = np.maximum(upper, low) * (1 + 1e-12) + 1e-300
    low = np.minimum(low, high)
    shape = e.centre, e.direction, e.semi_major, e.semi_minor
    with np.errstate(all="ignore"):
        high = _compiled().bisected(low, high, alpha, beta, k, *shape, accuracy)
    return np.asarray(np.where(blocked, np.inf, high), dtype=np.float64)
