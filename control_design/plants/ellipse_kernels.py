"""Compiled geometry of `ellipses`, element by element. A module of its own, because numba takes a second to
import and most who name an ellipse compute with none."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from ident.data.arrays import INSIDE

_elementwise: Any = numba.vectorize  # which numba leaves untyped


@numba.njit(**INSIDE)
def _secular_root(p: float, q: float, c: float, d: float) -> Any:
    """Convex and decreasing: Newton from the left never overshoots."""
    # Lower bounds of the root: each term alone <= 1. Both make the sum >= 1, where Newton is monotone.
    t = max(max(p - c, q - d), 0.0)
    tiny = 1e-300
    for _ in range(60):
        dc, dd = c + t + tiny, d + t + tiny
        pc, qd = (p / dc) ** 2, (q / dd) ** 2
        value, slope = pc + qd - 1.0, -2.0 * (pc / dc + qd / dd)
        step = -value / slope if value > 0 and slope < 0 else 0.0
        t += step
        if not step > 1e-15 * (t + 1e-16):
            break
    return t


@numba.njit(**INSIDE)
def _nearest(point: complex, semi_major: float, semi_minor: float) -> Any:
    x, y = abs(point.real), abs(point.imag)
    scale = max(max(x, y), max(semi_major, 1e-300))
    x, y, a, b = x / scale, y / scale, semi_major / scale, semi_minor / scale
    beside = (a == 0 and x > 0) or (b == 0 and y > 0)
    if not beside and (x / a if a > 0 else 0.0) ** 2 + (y / b if b > 0 else 0.0) ** 2 <= 1.0:
        return 0.0
    t = _secular_root(a * x, b * y, a * a, b * b)
    da, db = a * a + t, b * b + t
    # t = 0 on a degenerate axis: the point projects onto the segment itself.
    nx = a * a * x / da if da > 0 else 0.0
    ny = b * b * y / db if db > 0 else 0.0
    return np.hypot(x - nx, y - ny) * scale


@numba.njit(**INSIDE)
def _farthest(point: complex, semi_major: float, semi_minor: float) -> Any:
    x, y = abs(point.real), abs(point.imag)
    scale = max(max(x, y), max(semi_major, 1e-300))
    x, y, a, b = x / scale, y / scale, semi_major / scale, semi_minor / scale
    by, gap = b * y, a * a - b * b
    n = _secular_root(a * x, by, 0.0, gap)
    sin_f = min(max(by / (n + gap) if n + gap > 0 else 0.0, 0.0), 1.0)
    # cos from sin: when x = 0 the cosine term of the secular equation degenerates (n -> 0).
    distance = np.hypot(x + a * np.sqrt(1.0 - sin_f**2), y + b * sin_f)
    # The vertices are members too: they guard the degenerate circles and segments.
    return max(distance, max(np.hypot(x + a, y), np.hypot(x, y + b))) * scale


@_elementwise(cache=True)
def root_of_each(p: float, q: float, c: float, d: float) -> Any:
    return _secular_root(p, q, c, d)


@_elementwise(cache=True)
def nearest_of_each(point: complex, semi_major: float, semi_minor: float) -> Any:
    return _nearest(point, semi_major, semi_minor)


@_elementwise(cache=True)
def farthest_of_each(point: complex, semi_major: float, semi_minor: float) -> Any:
    return _farthest(point, semi_major, semi_minor)


@_elementwise(cache=True)
def bisected(
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
    """Upper end of the bisection of `largest_ratio`."""
    for _ in range(60):
        mid = 0.5 * (low + high)
        a, part = abs(alpha) ** 2, (mid * abs(k)) ** 2
        tiny = 1e-13 * (a + part) + 1e-300
        gap = a - part
        if abs(gap) < tiny:  # a half-plane is the limit of both cases
            gap = tiny
        middle = (mid**2 * np.conj(k) - np.conj(alpha) * beta) / gap
        radius = mid * abs(alpha - k * beta) / abs(gap)
        turned = (middle - centre) * np.conj(direction)
        if gap > 0:
            inside = _farthest(turned, semi_major, semi_minor) <= radius
        else:
            inside = _nearest(turned, semi_major, semi_minor) >= radius
        if inside:
            high = mid
        else:
            low = mid
        if high - low <= accuracy * high:
            break
    return high
