"""Second-order expansions with a proved remainder, of functions that are summed with large coefficients.

On |x| <= half_width around omega_k a function is written f(omega_k + x) = value + slope x + curvature x^2/2 +
r with |r| <= remainder (`SecondOrder`). A sum of functions whose values nearly cancel has a small curvature,
which is added up as exactly as its value is; the remainders add up by their sizes, but go with the third
power of the width. To first order (`plants.first_order`) everything beyond the slopes adds up by its size,
and intervals have to be ten times as narrow. The factors are those of `first_order.FrequencyIntervals`: z -
q, 1/(z - p), z^n, a constant. Neglected: rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from control_design.plants.ellipses import Complex, Real
from control_design.plants.first_order import FrequencyIntervals

# A pole inside of an interval gets this distance: a bound so large that the interval is split, and so small
# that its fourth power, by which the remainder of 1/(z - p) is divided, is still a double.
_SMALLEST_DISTANCE = 1e-70


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """Value, slope, curvature and bound of the remainder of one function on F intervals.

    Parameters
    ----------
    value, slope, curvature : (F,) complex array
        At the middle of each interval; slope in 1/(rad/s), curvature in 1/(rad/s)^2.
    remainder : (F,) array
        Bound of the modulus of what the three leave.
    half_width : (F,) array
        Half the interval in rad/s.
    """

    value: Complex
    slope: Complex
    curvature: Complex
    remainder: Real
    half_width: Real

    def __add__(self, other: SecondOrder) -> SecondOrder:
        """Sum of two expansions on the same intervals.

        Of other shapes numpy raises ValueError or broadcasts; not checked.
        """
        return SecondOrder(
            self.value + other.value,
            self.slope + other.slope,
            self.curvature + other.curvature,
            self.remainder + other.remainder,
            self.half_width,
        )

    def times(self, other: SecondOrder) -> SecondOrder:
        """Product of two expansions on the same intervals, which is not checked.

        The remainder holds the terms of third and fourth order of the product of both polynomials, and each
        remainder times the largest the other polynomial can be.
        """
        size, change, bend = self._sizes()
        other_size, other_change, other_bend = other._sizes()
        remainder = (
            change * other_bend
            + bend * other_change
            + bend * other_bend
            + (size + change + bend) * other.remainder
            + (other_size + other_change + other_bend) * self.remainder
            + self.remainder * other.remainder
        )
        return SecondOrder(
            self.value * other.value,
            self.value * other.slope + self.slope * other.value,
            self.value * other.curvature + 2.0 * self.slope * other.slope + self.curvature * other.value,
            remainder,
            self.half_width,
        )

    def scaled(self, factor: complex) -> SecondOrder:
        """Expansion times a constant.

        Shapes stay. Nothing is checked.
        """
        return SecondOrder(
            self.value * factor,
            self.slope * factor,
            self.curvature * factor,
            self.remainder * abs(factor),
            self.half_width,
        )

    def _sizes(self) -> tuple[Real, Real, Real]:
        """Largest moduli (F,) over the interval of the three terms of the polynomial, in the function's unit.

        Nan gives nan.
        """
        half_width = self.half_width
        return (
            np.abs(self.value),
            np.abs(self.slope) * half_width,
            0.5 * np.abs(self.curvature) * half_width**2,
        )


def constant(intervals: FrequencyIntervals, value: complex) -> SecondOrder:
    """Expansion (F,) of a constant.

    value: one number; what is not finite stays so.
    """
    size = intervals.centre.size
    nothing = np.zeros(size, complex)
    return SecondOrder(np.full(size, complex(value)), nothing, nothing, np.zeros(size), intervals.half_width)


def linear(intervals: FrequencyIntervals, at_one: complex, factor: complex) -> SecondOrder:
    """Expansion (F,) of at_one + factor (z - 1), whose third derivative in omega has modulus |factor| dt^3.

    at_one, factor: the value at z = 1 and what multiplies z; nothing is checked. z - q is
    `linear(intervals, 1 - q, 1)`, with the digits of 1 - q that the caller has.
    """
    dt_s = intervals.dt_s
    z = 1.0 + intervals.z_minus_1
    return SecondOrder(
        factor * intervals.z_minus_1 + at_one,
        1j * dt_s * factor * z,
        -(dt_s**2) * factor * z,
        abs(factor) * (intervals.half_width * dt_s) ** 3 / 6.0,
        intervals.half_width,
    )


def pole(intervals: FrequencyIntervals, root_minus_1: complex) -> SecondOrder:
    """Expansion (F,) of f = 1/(z - p) with p = 1 + root_minus_1.

    f' = -j dt z f^2, f'' = -dt^2 z (z + p) f^3, f''' = j dt^3 z (z^2 + 4 p z + p^2) f^4, of which the last is
    bounded on the arc by the smallest distance from p.

    root_minus_1: one complex number. A pole at the middle gives inf or nan with numpy's warning; one
    elsewhere in the interval a huge remainder.
    """
    dt_s = intervals.dt_s
    p = 1.0 + root_minus_1
    z = 1.0 + intervals.z_minus_1
    value = 1.0 / (intervals.z_minus_1 - root_minus_1)
    slope = -1j * dt_s * z * value**2
    curvature = -(dt_s**2) * z * (z + p) * value**3
    nearest = np.maximum(intervals.distance_to(root_minus_1), _SMALLEST_DISTANCE)
    largest_numerator = dt_s**3 * (1.0 + 4.0 * abs(p) + abs(p) ** 2)
    remainder = intervals.half_width**3 * largest_numerator / nearest**4 / 6.0
    return SecondOrder(value, slope, curvature, remainder, intervals.half_width)


def shift(intervals: FrequencyIntervals, samples: int) -> SecondOrder:
    """Expansion (F,) of z^samples. Its third derivative in omega has modulus |samples dt|^3.

    samples: a delay if negative.
    """
    rate = samples * intervals.dt_s
    value = np.exp(1j * rate * intervals.centre)
    remainder = (abs(rate) * intervals.half_width) ** 3 / 6.0
    return SecondOrder(value, 1j * rate * value, -(rate**2) * value, remainder, intervals.half_width)
