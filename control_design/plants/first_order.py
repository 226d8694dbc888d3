"""First-order expansions with a proved remainder, on intervals of frequency (Taylor models of order one).

On |x| <= half_width around omega_k: f(omega_k + x) = value + slope x + r with |r| <= remainder. Sums and
products of such expansions are such expansions, so a bound that holds for z - p and 1/(z - p) on an arc of
the circle carries over to every rational response. Rounding of double precision is neglected.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from control_design.plants.ellipses import Complex, Real


@dataclass(frozen=True, eq=False)
class Intervals:
    """Frequency intervals centre_k +- half_width_k [rad/s], (F,) each, for a sampling time dt_s.

    An interval may reach below 0 or above pi/dt: responses are analytic on the whole circle.
    """

    centre: Real
    half_width: Real
    dt_s: float

    @property
    def z_minus_1(self) -> Complex:
        """e^{j omega dt} - 1 at the centres, without the cancellation near omega = 0; (F,)."""
        theta = self.centre * self.dt_s
        return np.asarray(-2.0 * np.sin(theta / 2) ** 2 + 1j * np.sin(theta), dtype=np.complex128)

    def distance_to(self, root_minus_1: complex) -> Real:
        """Smallest |e^{j omega dt} - p| over each arc, (F,), p = 1 + root_minus_1."""
        size = abs(1.0 + root_minus_1)
        # 1 - |p| without cancellation for p near 1.
        inward = -(2.0 * root_minus_1.real + abs(root_minus_1) ** 2) / (1.0 + size)
        offset = np.angle(np.exp(1j * (np.angle(1.0 + root_minus_1) - self.centre * self.dt_s)))
        beyond = np.maximum(np.abs(offset) - self.half_width * self.dt_s, 0.0)
        return np.asarray(np.hypot(inward, 2.0 * np.sqrt(size) * np.sin(beyond / 2)), dtype=np.float64)

    def part(self, index: npt.NDArray[np.bool_]) -> Intervals:
        """Some of them."""
        return replace(self, centre=self.centre[index], half_width=self.half_width[index])

    def constant(self, value: complex) -> FirstOrder:
        """A constant."""
        size, h = self.centre.size, self.half_width
        return FirstOrder(np.full(size, complex(value)), np.zeros(size, complex), np.zeros(size), h)

    def zero(self, root_minus_1: complex) -> FirstOrder:
        """z - q, q = 1 + root_minus_1. Its second derivative in omega has modulus dt^2."""
        shift, dt, h = self.z_minus_1, self.dt_s, self.half_width
        return FirstOrder(shift - root_minus_1, 1j * dt * (1.0 + shift), 0.5 * (h * dt) ** 2, h)

    def pole(self, root_minus_1: complex) -> FirstOrder:
        """1/(z - p), p = 1 + root_minus_1: |d2/d omega2| = dt^2 |z + p|/|z - p|^3, bounded by the distance of
        the arc."""
        shift, dt, h = self.z_minus_1, self.dt_s, self.half_width
        value = 1.0 / (shift - root_minus_1)
        nearest = np.maximum(self.distance_to(root_minus_1), 1e-100)
        bound = dt**2 * (1.0 + abs(1.0 + root_minus_1)) / nearest**3
        return FirstOrder(value, -1j * dt * (1.0 + shift) * value**2, 0.5 * h**2 * bound, h)

    def shift(self, samples: int) -> FirstOrder:
        """z^samples: |d2/d omega2| = (samples dt)^2."""
        rate, h = samples * self.dt_s, self.half_width
        value = np.exp(1j * rate * self.centre)
        return FirstOrder(value, 1j * rate * value, 0.5 * (rate * h) ** 2, h)

    def cleared(self, count: int) -> FirstOrder:
        """(z - 1)^count for positive, 1/(z - 1)^|count| for negative count."""
        result = self.constant(1.0)
        for _ in range(abs(count)):
            result = result.times(self.zero(0.0) if count > 0 else self.pole(0.0))
        return result


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """value, slope: (F,) or, for Q functions at once, (F, Q); remainder, half_width: (F,).

    With Q functions the remainder bounds the Euclidean norm of their Q remainders.
    """

    value: Complex
    slope: Complex
    remainder: Real
    half_width: Real

    def __add__(self, other: FirstOrder) -> FirstOrder:
        return FirstOrder(
            self.value + other.value,
            self.slope + other.slope,
            self.remainder + other.remainder,
            self.half_width,
        )

    def times(self, other: FirstOrder) -> FirstOrder:
        """Product; `self` must be (F,), `other` may hold Q functions."""
        a0, a1 = self.value, self.slope
        if other.value.ndim == 2:
            a0, a1 = a0[:, None], a1[:, None]
        h = self.half_width
        size, change = np.abs(self.value), np.abs(self.slope) * h
        size_b, change_b = _norm(other.value), _norm(other.slope) * h
        remainder = (
            change * change_b
            + (size + change) * other.remainder
            + (size_b + change_b) * self.remainder
            + self.remainder * other.remainder
        )
        return FirstOrder(a0 * other.value, a0 * other.slope + a1 * other.value, remainder, h)

    def scaled(self, factor: complex) -> FirstOrder:
        """Times a constant."""
        size = abs(factor)
        return FirstOrder(self.value * factor, self.slope * factor, self.remainder * size, self.half_width)

    def end(self, side: int) -> Complex:
        """The linear part at the upper (side = 1) or lower (side = -1) end of the interval."""
        h = self.half_width if self.value.ndim == 1 else self.half_width[:, None]
        return np.asarray(self.value + side * h * self.slope, dtype=np.complex128)

    def change(self) -> Real:
        """Upper bound of the distance from the value at the middle, (F,)."""
        return _norm(self.slope) * self.half_width + self.remainder

    def largest(self) -> Real:
        """Upper bound of the modulus over the interval, (F,). The modulus of a linear function is convex."""
        return np.maximum(_norm(self.end(1)), _norm(self.end(-1))) + self.remainder


def _norm(value: Complex) -> Real:
    if value.ndim == 1:
        return np.abs(value)
    squares = (np.einsum("fq,fq->f", part, part) for part in (value.real, value.imag))
    return np.asarray(np.sqrt(sum(squares)))
