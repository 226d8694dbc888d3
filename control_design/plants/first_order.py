"""First-order expansions with a proved remainder, on intervals of frequency (Taylor models of order one).

A certificate that holds between grid points needs bounds of responses on whole intervals. On |x| <=
half_width around omega_k a function is written f(omega_k + x) = value + slope x + r with |r| <= remainder
(`FirstOrder`). `FrequencyIntervals` gives the expansions of the simplest factors, z - q, 1/(z - p) and z^n,
whose remainder comes from a bound of the second derivative. Sums and products of expansions are expansions
again, and so is every rational response (`RationalResponse`), factor by factor. Roots are kept as their
distance from z = 1, so that slow poles keep their digits. Neglected: rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy.linalg

from control_design.plants.ellipses import Boolean, Complex, Real
from control_design.plants.weights import RationalWeight

if TYPE_CHECKING:
    import control


# The remainder of 1/(z - p) goes with the third power of 1/distance; a pole inside of an interval gets this
# distance: a bound so large that the interval is split.
_SMALLEST_DISTANCE = 1e-100

# A product of state-space matrices below this share of their norms is zero but for rounding (a thousand units
# of the last digit): the direct term, and the Markov parameters before the first that does not vanish.
_ROUNDING_SHARE = 1e-12

# Singular values below this share of the largest belong to the null space of rows of norm one.
_NULL_SPACE_SHARE = 1e-13


@dataclass(frozen=True, eq=False)
class FrequencyIntervals:
    """Frequency intervals centre_k +- half_width_k, F of them; they may reach below 0 or above pi/dt.

    Parameters
    ----------
    centre, half_width : (F,) array
        rad/s.
    dt_s : float
        Sampling period in seconds.

    Notes
    -----
    Nothing is checked: who cuts the intervals gives half widths that are not negative. Expansions that it
    makes have slopes in 1/(rad/s).
    """

    centre: Real
    half_width: Real
    dt_s: float

    @cached_property
    def z_minus_1(self) -> Complex:
        """e^{j omega dt} - 1 at the centres, (F,) complex, without the cancellation near omega = 0.

        No unit. Nan where a centre is not finite.
        """
        theta = self.centre * self.dt_s
        return np.asarray(-2.0 * np.sin(theta / 2) ** 2 + 1j * np.sin(theta), dtype=np.complex128)

    def distance_to(self, root_minus_1: complex) -> Real:
        """Smallest |e^{j omega dt} - p| over each arc of the unit circle, (F,), with p = 1 + root_minus_1.

        No unit. root_minus_1: one complex number; p = 0 is as far as 1.
        """
        size = abs(1.0 + root_minus_1)
        # 1 - |p| without cancellation for p near 1.
        radial = -(2.0 * root_minus_1.real + abs(root_minus_1) ** 2) / (1.0 + size)
        # Angle between p and the middle of the arc, in (-pi, pi]; beyond the end of the arc it adds to the
        # distance as a chord.
        offset = np.angle(np.exp(1j * (np.angle(1.0 + root_minus_1) - self.centre * self.dt_s)))
        beyond_arc = np.maximum(np.abs(offset) - self.half_width * self.dt_s, 0.0)
        chord = 2.0 * np.sqrt(size) * np.sin(beyond_arc / 2)
        return np.asarray(np.hypot(radial, chord), dtype=np.float64)

    def part(self, index: Boolean) -> FrequencyIntervals:
        """The intervals that a mask (F,) chooses.

        Of another length IndexError, by numpy.
        """
        return replace(self, centre=self.centre[index], half_width=self.half_width[index])

    def constant(self, value: complex) -> FirstOrder:
        """Expansion (F,) of a constant.

        value: one number; what is not finite stays so.
        """
        size = self.centre.size
        return FirstOrder(
            np.full(size, complex(value)), np.zeros(size, complex), np.zeros(size), self.half_width
        )

    def zero(self, root_minus_1: complex) -> FirstOrder:
        """Expansion (F,) of z - q with q = 1 + root_minus_1. Its second derivative in omega has modulus
        dt^2.

        root_minus_1: one complex number, not checked.
        """
        z_minus_1 = self.z_minus_1
        slope = 1j * self.dt_s * (1.0 + z_minus_1)
        remainder = 0.5 * (self.half_width * self.dt_s) ** 2
        return FirstOrder(z_minus_1 - root_minus_1, slope, remainder, self.half_width)

    def pole(self, root_minus_1: complex) -> FirstOrder:
        """Expansion (F,) of 1/(z - p) with p = 1 + root_minus_1. Its second derivative in omega has modulus
        dt^2 |z + p|/|z - p|^3, which is bounded on the arc by the smallest distance from p.

        root_minus_1: one complex number. A pole at the middle gives inf or nan with numpy's warning; one
        elsewhere in the interval a huge remainder.
        """
        z_minus_1 = self.z_minus_1
        value = 1.0 / (z_minus_1 - root_minus_1)
        slope = -1j * self.dt_s * (1.0 + z_minus_1) * value**2
        nearest = np.maximum(self.distance_to(root_minus_1), _SMALLEST_DISTANCE)
        second_derivative = self.dt_s**2 * (1.0 + abs(1.0 + root_minus_1)) / nearest**3
        return FirstOrder(value, slope, 0.5 * self.half_width**2 * second_derivative, self.half_width)

    def shift(self, samples: int) -> FirstOrder:
        """Expansion (F,) of z^samples. Its second derivative in omega has modulus (samples dt)^2.

        samples: a delay if negative.
        """
        rate = samples * self.dt_s
        value = np.exp(1j * rate * self.centre)
        remainder = 0.5 * (rate * self.half_width) ** 2
        return FirstOrder(value, 1j * rate * value, remainder, self.half_width)

    def cleared(self, count: int) -> FirstOrder:
        """Expansion (F,) of (z - 1)^count; a negative count gives 1/(z - 1)^|count|.

        A negative count needs intervals away from zero frequency, see `pole`.
        """
        factor = self.zero(0.0) if count > 0 else self.pole(0.0)
        result = self.constant(1.0)
        for _ in range(abs(count)):
            result = result.times(factor)
        return result


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """Value, slope and bound of the remainder of one function, or of Q functions at once, on F intervals.

    Parameters
    ----------
    value, slope : (F,) or (F, Q) complex array
        At the middle of each interval; the slope in 1/(rad/s).
    remainder : (F,) array
        Bound of the Euclidean norm over the Q functions of what the linear part leaves.
    half_width : (F,) array
        Half the interval in rad/s.
    """

    value: Complex
    slope: Complex
    remainder: Real
    half_width: Real

    def __add__(self, other: FirstOrder) -> FirstOrder:
        """Sum of two expansions of one shape on the same intervals.

        Of other shapes numpy raises ValueError or broadcasts; not checked.
        """
        return FirstOrder(
            self.value + other.value,
            self.slope + other.slope,
            self.remainder + other.remainder,
            self.half_width,
        )

    def times(self, other: FirstOrder) -> FirstOrder:
        """Product of this expansion, which must be (F,), and another one, (F,) or (F, Q).

        The remainder holds the product of the two changes, and each remainder times the largest the other
        linear part can be.

        Intervals of both must be the same, not checked.
        """
        value = self.value
        slope = self.slope
        if other.value.ndim == 2:
            value = value[:, None]
            slope = slope[:, None]
        size = np.abs(self.value)
        change = np.abs(self.slope) * self.half_width
        other_size = _norm(other.value)
        other_change = _norm(other.slope) * self.half_width
        remainder = (
            change * other_change
            + (size + change) * other.remainder
            + (other_size + other_change) * self.remainder
            + self.remainder * other.remainder
        )
        product_slope = value * other.slope + slope * other.value
        return FirstOrder(value * other.value, product_slope, remainder, self.half_width)

    def scaled(self, factor: complex) -> FirstOrder:
        """Expansion times a constant.

        Shapes stay. Nothing is checked.
        """
        return FirstOrder(
            self.value * factor, self.slope * factor, self.remainder * abs(factor), self.half_width
        )

    def end(self, side: int) -> Complex:
        """Linear part, (F,) or (F, Q), at the upper (side = 1) or lower (side = -1) end of the intervals; at
        the middle for side = 0.

        Another side is not refused: it extrapolates.
        """
        half_width = self.half_width if self.value.ndim == 1 else self.half_width[:, None]
        return np.asarray(self.value + side * half_width * self.slope, dtype=np.complex128)

    def change(self) -> Real:
        """Upper bound (F,) of the distance from the value at the middle, over the interval.

        In the unit of the value. Nan where value or slope is nan.
        """
        return _norm(self.slope) * self.half_width + self.remainder

    def largest(self) -> Real:
        """Upper bound (F,) of the modulus over the interval. The modulus of a linear function is convex, so
        that it is largest at one of the ends.

        In the unit of the value; of Q functions it is their Euclidean norm.
        """
        return np.maximum(_norm(self.end(1)), _norm(self.end(-1))) + self.remainder


def _norm(value: Complex) -> Real:
    """Modulus (F,) of values (F,), or Euclidean norm (F,) of values (F, Q).

    Real and imaginary parts are squared by themselves: faster than a modulus of each. Nan gives nan.
    """
    if value.ndim == 1:
        return np.abs(value)
    real_square = np.einsum("fq,fq->f", value.real, value.real)
    imag_square = np.einsum("fq,fq->f", value.imag, value.imag)
    return np.asarray(np.sqrt(real_square + imag_square))


@dataclass(frozen=True, eq=False)
class RationalResponse:
    """A rational response by its factors: gain z^-delay_samples prod (z - q)/prod (z - p)/(z -
    1)^integrators.

    Parameters
    ----------
    gain : float
        Factor of the products.
    zeros_minus_1, poles_minus_1 : (N,), (M,) complex array
        q - 1 and p - 1, so that slow roots keep their digits; without integrators.
    integrators : int
        Poles at z = 1.
    dt_s : float
        Sampling period in seconds.
    delay_samples : int
        Whole samples.
    """

    gain: float
    zeros_minus_1: Complex
    poles_minus_1: Complex
    integrators: int
    dt_s: float
    delay_samples: int = 0

    @classmethod
    def from_state_space(cls, system: control.StateSpace, integrators: int) -> RationalResponse:
        """Gain, zeros and poles of a discrete system with one input and one output.

        Parameters
        ----------
        system : control.StateSpace
            n states.
        integrators : int
            Number of its poles at z = 1, as `count_integrators` says: those nearest to it are put exactly
            there, however far away they are (not checked). Of more inputs or outputs the first of D counts
            and numpy raises where B and C do not fit.

        Notes
        -----
        With relative degree r the zeros are the eigenvalues of A + B F, F = -C A^r/(C A^(r-1) B), on the
        subspace where C, CA, ..., C A^(r-1) vanish: exactly n - r of them, none spurious.
        """
        a, b, c = (np.asarray(getattr(system, name), dtype=np.float64) for name in "ABC")
        d = float(np.asarray(system.D)[0, 0])
        dt_s = float(system.dt)
        n = a.shape[0]
        identity = np.eye(n)
        poles = _eigenvalues(a - identity)
        by_distance = np.argsort(np.abs(poles), kind="stable")
        poles = poles[by_distance][integrators:]
        no_zeros = np.zeros(0, complex)
        # With a direct term there are as many zeros as poles.
        if n == 0 or abs(d) > _ROUNDING_SHARE * np.linalg.norm(b) * np.linalg.norm(c):
            zeros = _eigenvalues(a - b @ c / d - identity) if d else no_zeros
            return cls(d, zeros, poles, integrators, dt_s)
        # Rows C, CA, ... up to the first Markov parameter C A^(r-1) B that does not vanish.
        rows: list[npt.NDArray[np.float64]] = []
        row = c
        markov = 0.0
        while len(rows) < n:
            size = float(np.linalg.norm(row))
            rows.append(row / (size or 1.0))
            markov = float((row @ b)[0, 0])
            if abs(markov) > _ROUNDING_SHARE * size * float(np.linalg.norm(b)):
                break
            row = row @ a
        else:
            # The input does not reach the output.
            return cls(0.0, no_zeros, poles, integrators, dt_s)
        subspace = scipy.linalg.null_space(np.vstack(rows), rcond=_NULL_SPACE_SHARE)
        zero_dynamics = a - b @ (row @ a) / markov - identity
        zeros = _eigenvalues(subspace.T @ zero_dynamics @ subspace)
        return cls(markov, zeros, poles, integrators, dt_s)

    @classmethod
    def from_weight(cls, weight: RationalWeight, dt_s: float) -> RationalResponse:
        """Weight W(s), up to its sign, seen through s = (2/dt) (z - 1)/(z + 1).

        A root r becomes q = (1 + r dt/2)/(1 - r dt/2): s - r = (2/dt - r) (z - q)/(z + 1). Where the weight
        has fewer zeros than poles the factors z + 1 remain as zeros at z = -1.

        dt_s in seconds. A `RationalWeight` has checked itself: proper, stable, no first coefficient of zero.
        """
        gain = abs(weight.numerator[0] / weight.denominator[0])
        roots_minus_1: list[list[complex]] = []
        for coefficients, sign in ((weight.numerator, 1), (weight.denominator, -1)):
            mapped: list[complex] = []
            for root in np.roots(coefficients):
                scale = 2.0 / dt_s - root
                # q at infinity: s - 2/dt = -(4/dt)/(z + 1). Equal to rounding is equal here.
                if abs(scale) < _ROUNDING_SHARE / dt_s:
                    gain *= (4.0 / dt_s) ** sign
                    continue
                gain *= float(abs(scale)) ** sign
                mapped.append(complex(2.0 * root / scale))
            roots_minus_1.append(mapped)
        zeros_minus_1, poles_minus_1 = roots_minus_1
        n_missing_zeros = len(weight.denominator) - len(weight.numerator)
        zeros_minus_1 = zeros_minus_1 + [complex(-2.0)] * n_missing_zeros
        # Integrators of a weight are roots at s = 0.
        moving_poles = [root for root in poles_minus_1 if root != 0]
        return cls(
            gain,
            np.array(zeros_minus_1, dtype=np.complex128),
            np.array(moving_poles, dtype=np.complex128),
            len(poles_minus_1) - len(moving_poles),
            dt_s,
        )

    def delayed(self, samples: int) -> RationalResponse:
        """Response times z^-samples.

        A negative number takes delay away; nothing is checked.
        """
        return replace(self, delay_samples=self.delay_samples + samples)

    def expand(self, intervals: FrequencyIntervals, cleared: int = 0) -> FirstOrder:
        """Expansion (F,) of the response times (z - 1)^cleared on F intervals; cleared takes integrators
        away.

        A pole at the middle of an interval gives inf or nan (`FrequencyIntervals.pole`), a zero there a value
        of 0.
        """
        result = intervals.constant(self.gain)
        zero_order = np.argsort(np.abs(self.zeros_minus_1), kind="stable")
        pole_order = np.argsort(np.abs(self.poles_minus_1), kind="stable")
        zeros = self.zeros_minus_1[zero_order]
        poles = self.poles_minus_1[pole_order]
        # One pole and one zero in turn: partial products keep the size of the whole.
        for index in range(max(zeros.size, poles.size)):
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
        """Values (F,) complex at omega (F,) in rad/s.

        Inf or nan, with numpy's warning, at a pole on the circle.
        """
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        points = FrequencyIntervals(omega, np.zeros(omega.size), self.dt_s)
        return self.expand(points).value


def _eigenvalues(matrix: npt.NDArray[np.float64]) -> Complex:
    """Eigenvalues (n,) of a real matrix (n, n), complex also where all of them are real.

    LinAlgError, by numpy, where a number is not finite.
    """
    return np.asarray(np.linalg.eigvals(matrix), dtype=np.complex128)
