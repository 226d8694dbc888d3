"""First-order expansions with a proved remainder, on intervals of frequency (Taylor models of order one).

On |x| <= half_width around omega_k: f(omega_k + x) = value + slope x + r with |r| <= remainder. Sums and
products are such expansions again, and so is every rational response (`RationalResponse`). Neglected:
rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy.linalg

from control_design.plants.ellipses import Boolean, Complex, Real
from control_design.plants.weights import RationalWeight

if TYPE_CHECKING:
    import control


@dataclass(frozen=True, eq=False)
class FrequencyIntervals:
    """Frequency intervals centre_k +- half_width_k [rad/s], (F,) each, at dt_s; also below 0 or above
    pi/dt."""

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

    def part(self, index: Boolean) -> FrequencyIntervals:
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
        """1/(z - p), p = 1 + root_minus_1: |d2/d omega2| = dt^2 |z + p|/|z - p|^3, bounded on the arc."""
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
    """value, slope: (F,) or, for Q functions at once, (F, Q); remainder (F,), of their Euclidean norm;
    half_width (F,)."""

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
        return FirstOrder(
            self.value * factor, self.slope * factor, self.remainder * abs(factor), self.half_width
        )

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


@dataclass(frozen=True, eq=False)
class RationalResponse:
    """gain z^-delay_samples prod (z - q)/prod (z - p)/(z - 1)^integrators; zeros_minus_1 and poles_minus_1
    hold q - 1 and p - 1, so that slow poles keep their digits."""

    gain: float
    zeros_minus_1: Complex
    poles_minus_1: Complex
    integrators: int
    dt_s: float
    delay_samples: int = 0

    @classmethod
    def from_state_space(cls, system: control.StateSpace, integrators: int) -> RationalResponse:
        """Zeros and poles of a SISO discrete system; its `integrators` poles nearest z = 1 are put exactly
        there.

        With relative degree r the zeros are the eigenvalues of A + B F, F = -C A^r/(C A^(r-1) B), on the
        subspace where C, CA, ..., C A^(r-1) vanish: exactly n - r of them, none spurious.
        """
        a, b, c = (np.asarray(getattr(system, name), dtype=np.float64) for name in "ABC")
        d = float(np.asarray(system.D)[0, 0])
        n = a.shape[0]
        identity = np.eye(n)
        poles = _eigenvalues(a - identity)
        poles = poles[np.argsort(np.abs(poles), kind="stable")][integrators:]
        if n == 0 or abs(d) > 1e-12 * np.linalg.norm(b) * np.linalg.norm(c):
            zeros = _eigenvalues(a - b @ c / d - identity) if d else np.zeros(0, complex)
            return cls(d, zeros, poles, integrators, float(system.dt))
        rows: list[npt.NDArray[np.float64]] = []
        row, markov = c, 0.0
        while len(rows) < n:
            size = float(np.linalg.norm(row))
            rows.append(row / (size or 1.0))
            markov = float((row @ b)[0, 0])
            if abs(markov) > 1e-12 * size * float(np.linalg.norm(b)):
                break
            row = row @ a
        else:
            return cls(0.0, np.zeros(0, complex), poles, integrators, float(system.dt))
        inside = scipy.linalg.null_space(np.vstack(rows), rcond=1e-13)
        zeros = _eigenvalues(inside.T @ (a - b @ (row @ a) / markov - identity) @ inside)
        return cls(markov, zeros, poles, integrators, float(system.dt))

    @classmethod
    def from_weight(cls, weight: RationalWeight, dt_s: float) -> RationalResponse:
        """A weight in s (up to its sign) seen through s = (2/dt) (z - 1)/(z + 1), in which s - r = (2/dt - r)
        (z - q)/(z + 1) with q = (1 + r dt/2)/(1 - r dt/2)."""
        gain = abs(weight.numerator[0] / weight.denominator[0])
        roots: list[list[complex]] = []
        for coefficients, sign in ((weight.numerator, 1), (weight.denominator, -1)):
            found: list[complex] = []
            for root in np.roots(coefficients):
                scale = 2.0 / dt_s - root
                if abs(scale) < 1e-12 / dt_s:  # q at infinity: s - 2/dt = -(4/dt)/(z + 1)
                    gain *= (4.0 / dt_s) ** sign
                    continue
                gain *= float(abs(scale)) ** sign
                found.append(complex(2.0 * root / scale))
            roots.append(found)
        missing = len(weight.denominator) - len(weight.numerator)
        # Integrators of a weight are roots at s = 0.
        at_one = sum(1 for root in roots[1] if root == 0)
        return cls(
            gain,
            np.array([*roots[0], *([-2.0] * missing)], dtype=np.complex128),
            np.array([root for root in roots[1] if root != 0], dtype=np.complex128),
            at_one,
            dt_s,
        )

    def delayed(self, samples: int) -> RationalResponse:
        """Times z^-samples."""
        return replace(self, delay_samples=self.delay_samples + samples)

    def expand(self, intervals: FrequencyIntervals, cleared: int = 0) -> FirstOrder:
        """(z - 1)^cleared times the response, to first order on the intervals."""
        result = intervals.constant(self.gain)
        zeros = self.zeros_minus_1[np.argsort(np.abs(self.zeros_minus_1), kind="stable")]
        poles = self.poles_minus_1[np.argsort(np.abs(self.poles_minus_1), kind="stable")]
        for index in range(max(zeros.size, poles.size)):
            # One pole, one zero in turn: partial products keep the size of the whole.
            if index < poles.size:
                result = result.times(intervals.pole(complex(poles[index])))
            if index < zeros.size:
                result = result.times(intervals.zero(complex(zeros[index])))
        if self.delay_samples:
            result = result.times(intervals.shift(-self.delay_samples))
        if cleared != self.integrators:
            result = result.times(intervals.cleared(cleared - self.integrators))
        return result

    def at(self, omega_rad_s: Real) -> Complex:
        """Values at omega (F,)."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        return self.expand(FrequencyIntervals(omega, np.zeros(omega.size), self.dt_s)).value


def _eigenvalues(matrix: npt.NDArray[np.float64]) -> Complex:
    return np.asarray(np.linalg.eigvals(matrix), dtype=np.complex128)
