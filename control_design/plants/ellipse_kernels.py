"""Compiled geometry of ellipses in the plane, element by element.

An ellipse has half axes a >= b >= 0, stands at the origin and has its axes parallel to the coordinate axes;
callers (`control_design.plants.ellipses`) turn and shift points so that this holds. The nearest and the
farthest member seen from a point both come to the root of one secular equation (`_secular_root`). `_bisected`
finds the largest gain of a linear fractional map over an ellipse with them. The functions ending in `of_each`
take contiguous arrays (F,) of one length. They are no ufuncs of numba, which are linked anew in every process
(0.05 s each). A module of its own, because numba takes a second to import
and most who name an ellipse compute with none.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from ident.data.arrays import COMPILED, INSIDE, ComplexArray, RealArray

# Newton steps of the secular equation, and halvings of the bisection. Newton converges quadratically from a
# bound within a factor of two (5 to 8 steps); 60 halvings of a positive interval reach double precision.
_MOST_STEPS = 60

# A Newton step below this share of the root is rounding: a few units of the last digit.
_ROUNDING_SHARE = 1e-15

# Keeps divisions by a size that may be zero finite; far below any size that matters.
_TINY = 1e-300


@numba.njit(**INSIDE)
def _secular_root(p: float, q: float, c: float, d: float) -> Any:
    """Root t >= 0 of (p/(c + t))^2 + (q/(d + t))^2 = 1 for p, q, c, d >= 0; 0 where the left side is below 1
    at t = 0. The left side is convex and decreasing, so Newton's method from the left never overshoots.

    All are of one unit, that of a square of lengths. Nothing is checked: of a nan the root means nothing.
    """
    # Lower bounds of the root: each term alone <= 1. Both make the sum >= 1, where Newton is monotone.
    t = max(max(p - c, q - d), 0.0)
    for _ in range(_MOST_STEPS):
        first_denominator = c + t + _TINY
        second_denominator = d + t + _TINY
        first_term = (p / first_denominator) ** 2
        second_term = (q / second_denominator) ** 2
        value = first_term + second_term - 1.0
        slope = -2.0 * (first_term / first_denominator + second_term / second_denominator)
        step = 0.0
        if value > 0 and slope < 0:
            step = -value / slope
        t += step
        # Relative, but not below the rounding of lengths, which callers scale to 1 at most.
        if not step > _ROUNDING_SHARE * (t + 1e-16):
            break
    return t


@numba.njit(**INSIDE)
def _nearest(point: complex, semi_major: float, semi_minor: float) -> Any:
    """Distance from `point` to the filled ellipse; 0 inside. By symmetry the point is taken to the first
    quadrant, and everything is divided by the largest size, so that squares neither overflow nor vanish.

    In the unit of the point. Not checked: semi_major >= semi_minor >= 0, and that all are finite.
    """
    scale = max(max(abs(point.real), abs(point.imag)), max(semi_major, _TINY))
    x = abs(point.real) / scale
    y = abs(point.imag) / scale
    a = semi_major / scale
    b = semi_minor / scale
    # An axis of length zero leaves a segment or a point: whatever is off it is outside.
    off_segment = (a == 0 and x > 0) or (b == 0 and y > 0)
    x_share = 0.0
    y_share = 0.0
    if a > 0:
        x_share = x / a
    if b > 0:
        y_share = y / b
    if not off_segment and x_share**2 + y_share**2 <= 1.0:
        return 0.0
    t = _secular_root(a * x, b * y, a * a, b * b)
    x_denominator = a * a + t
    y_denominator = b * b + t
    # t = 0 on a degenerate axis: the point projects onto the segment itself.
    nearest_x = 0.0
    nearest_y = 0.0
    if x_denominator > 0:
        nearest_x = a * a * x / x_denominator
    if y_denominator > 0:
        nearest_y = b * b * y / y_denominator
    return np.hypot(x - nearest_x, y - nearest_y) * scale


@numba.njit(**INSIDE)
def _farthest(point: complex, semi_major: float, semi_minor: float) -> Any:
    """Distance from `point` to the farthest member of the ellipse, which lies in the quadrant opposite to the
    point at (-a cos f, -b sin f). Scaled as in `_nearest`.

    In the unit of the point; nothing is checked either.
    """
    scale = max(max(abs(point.real), abs(point.imag)), max(semi_major, _TINY))
    x = abs(point.real) / scale
    y = abs(point.imag) / scale
    a = semi_major / scale
    b = semi_minor / scale
    gap = a * a - b * b
    n = _secular_root(a * x, b * y, 0.0, gap)
    sin_f = 0.0
    if n + gap > 0:
        sin_f = b * y / (n + gap)
    sin_f = min(max(sin_f, 0.0), 1.0)
    # The cosine from the sine: when x = 0 the cosine's own term of the secular equation degenerates (n -> 0).
    cos_f = np.sqrt(1.0 - sin_f**2)
    distance = np.hypot(x + a * cos_f, y + b * sin_f)
    # The vertices are members too: they guard the degenerate circles and segments.
    vertex_distance = max(np.hypot(x + a, y), np.hypot(x, y + b))
    return max(distance, vertex_distance) * scale


@numba.njit(**COMPILED)
def root_of_each(p: RealArray, q: RealArray, c: RealArray, d: RealArray) -> Any:
    """Root t >= 0 (F,) of (p/(c + t))^2 + (q/(d + t))^2 = 1; see `_secular_root`.

    Arrays (F,); nothing is checked.
    """
    found = np.empty(p.size)
    for k in range(p.size):
        found[k] = _secular_root(p[k], q[k], c[k], d[k])
    return found


@numba.njit(**COMPILED)
def nearest_of_each(point: ComplexArray, semi_major: RealArray, semi_minor: RealArray) -> Any:
    """Distance (F,) from each point to the nearest member of its ellipse; 0 inside.

    point complex (F,), half axes real (F,), all of one unit; nothing is checked.
    """
    found = np.empty(point.size)
    for k in range(point.size):
        found[k] = _nearest(point[k], semi_major[k], semi_minor[k])
    return found


@numba.njit(**COMPILED)
def farthest_of_each(point: ComplexArray, semi_major: RealArray, semi_minor: RealArray) -> Any:
    """Distance (F,) from each point to the farthest member of its ellipse.

    point complex (F,), half axes real (F,), all of one unit; nothing is checked.
    """
    found = np.empty(point.size)
    for k in range(point.size):
        found[k] = _farthest(point[k], semi_major[k], semi_minor[k])
    return found


@numba.njit(**INSIDE)
def _bisected(
    low: float,
    high: float,
    alpha: complex,
    beta: complex,
    k: complex,
    centre: complex,
    direction: complex,
    semi_major: float,
    semi_minor: float,
    accuracy: float,
) -> Any:
    """Upper bound h of |alpha G + beta|/|1 + k G| over the ellipse of members G, within the relative
    accuracy.

    low, high: a value that some member has, and a bound of all. centre, direction (of modulus one),
    semi_major, semi_minor: the ellipse. For h = mid the members with a ratio of at most h are a disc around
    g0, or everything outside of one where h |k| > |alpha| (an Apollonius circle; the formulas stand in
    `largest_ratio`).

    Nothing is checked: of a nan, or of ends in the wrong order, the result means nothing.
    """
    for _ in range(_MOST_STEPS):
        mid = 0.5 * (low + high)
        alpha_square = abs(alpha) ** 2
        k_square = (mid * abs(k)) ** 2
        # A half-plane is the limit of disc and outside of a disc: a gap of rounding size (some hundred
        # roundings of the squares that it is the difference of) stands for it.
        smallest_gap = 1e-13 * (alpha_square + k_square) + _TINY
        gap = alpha_square - k_square
        if abs(gap) < smallest_gap:
            gap = smallest_gap
        g0 = (mid**2 * np.conj(k) - np.conj(alpha) * beta) / gap
        radius = mid * abs(alpha - k * beta) / abs(gap)
        turned = (g0 - centre) * np.conj(direction)
        if gap > 0:
            holds = _farthest(turned, semi_major, semi_minor) <= radius
        else:
            holds = _nearest(turned, semi_major, semi_minor) >= radius
        if holds:
            high = mid
        else:
            low = mid
        if high - low <= accuracy * high:
            break
    return high


@numba.njit(**COMPILED)
def bisected_of_each(
    low: RealArray,
    high: RealArray,
    alpha: ComplexArray,
    beta: ComplexArray,
    k: ComplexArray,
    centre: ComplexArray,
    direction: ComplexArray,
    semi_major: RealArray,
    semi_minor: RealArray,
    accuracy: float,
) -> Any:
    """Upper bound (F,) of |alpha G + beta|/|1 + k G| over each ellipse; see `_bisected`.

    Arrays (F,); nothing is checked.
    """
    found = np.empty(low.size)
    for f in range(low.size):
        found[f] = _bisected(
            low[f], high[f], alpha[f], beta[f], k[f],
            centre[f], direction[f], semi_major[f], semi_minor[f], accuracy,
        )  # fmt: skip
    return found
