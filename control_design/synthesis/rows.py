"""Rows of the synthesis: logarithms of the weighted worst cases, as CasADi states and differentiates them.

A row is log |w F(K, G)| of one requirement at one frequency, with the member G of the ellipse for which it is
largest:

    G = c + cos(a) major + sin(a) minor,   F = G^i K^j / (1 + G K z^-d),   i, j in {0, 1}.

Members are looked for in compiled code, on `_BOUNDARY` points of each ellipse's boundary, refined by a
parabola and Newton's method: good for a direction, not for a certificate. There the angle a is one more
unknown: a row is the largest psi(x, a), its slope psi_x (envelope theorem), its second derivative psi_xx -
psi_xa psi_xa' / psi_aa, for a long ellipse bends the row although its worst member moves only along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numba
import numpy as np

from control_design.controllers.biquads import Cascade, SectionKind, tustin_frequency
from control_design.plants.ellipses import Complex, Ellipses, Integer, Real
from control_design.specification.requirement import LoopFunction
from ident.data.arrays import COMPILED, INSIDE

_BOUNDARY = 40  # every 9 degrees; parabola and Newton steps go on from the worst
_REFINEMENTS = 2  # Newton steps from the vertex of the parabola to the worst member
_NOTHING = 1e-9  # bend along a boundary, or share of the largest multiplier, that bends no row
_AT_ONCE = 8  # rows whose curvature is taken in one call: more are not often active


@dataclass(frozen=True, eq=False)
class Rows:
    """What is asked of one plant (or delayed copy) on its grid; all arrays (F,).

    delay : z^-d times a delay copy, multiplies K. weights : magnitude (F,) of the weights on functions of the
    members, 0 = no row.
    """

    ellipses: Ellipses
    delay: Complex
    weights: tuple[tuple[LoopFunction, Real], ...]


@lru_cache(maxsize=64)
def row_functions(sections: tuple[SectionKind, ...]) -> tuple[Any, Any, Any]:
    """Of controllers with these sections: K at one frequency; the slope of a row; its second derivative times
    a multiplier. CasADi functions of the parameters, the angle, p and the plant (`LoopRows`)."""
    cascade = Cascade(sections, 1.0, 1.0)
    x, angle, share = ca.SX.sym("x", cascade.parameters), ca.SX.sym("angle"), ca.SX.sym("share")
    # p = jv as far and near: v and 1, both over the larger; 1e16 at Nyquist stays exact.
    p, plant = ca.SX.sym("p", 2), ca.SX.sym("plant", 10)
    far, near = p[0], p[1]
    re, im = ca.SX(1.0), ca.SX(0.0)
    for parts in cascade.split_with(x, ca.exp):
        (n_re, n_im), (d_re, d_im) = (
            (z * near, o * far) if not t else (z * near**2 - t[0] * far**2, o * near * far)
            for *t, o, z in parts
        )
        square = d_re**2 + d_im**2
        f_re, f_im = (n_re * d_re + n_im * d_im) / square, (n_im * d_re - n_re * d_im) / square
        re, im = re * f_re - im * f_im, re * f_im + im * f_re
    centre, major, minor, late = (plant[i : i + 2] for i in range(0, 8, 2))
    k_re, k_im = re * late[0] - im * late[1], re * late[1] + im * late[0]
    g = centre + ca.cos(angle) * major + ca.sin(angle) * minor
    back = ca.vertcat(1 + g[0] * k_re - g[1] * k_im, g[0] * k_im + g[1] * k_re)
    squares = ca.sumsqr(g), re**2 + im**2, ca.sumsqr(back)
    of_g, of_k, whole = (ca.log(square + np.finfo(np.float64).tiny) for square in squares)
    value = 0.5 * (plant[8] * of_g + plant[9] * of_k - whole)
    full = ca.hessian(value, ca.vertcat(x, angle))[0]
    along, across = ca.fmin(full[-1, -1], -_NOTHING), full[:-1, -1]
    bend = full[:-1, :-1] - ca.if_else(full[-1, -1] < -_NOTHING, 1 / along, 0) * across @ across.T
    given = [x, angle, p, plant]
    return (
        ca.Function("response", [x, p], [re, im]),
        ca.Function("slope", given, [ca.densify(ca.gradient(value, x))]),
        ca.Function("bend", [*given, share], [ca.densify(share * bend)]),
    )


class _Mapped:
    """A function at n columns at once, between arrays of its own: no conversion takes longer than the
    function. Inputs but the first have a row a column; summed: so has no output, they are added."""

    def __init__(self, function: Any, n: int, *, summed: bool = False) -> None:
        mapped = function.map(function.name(), "serial", n, [0], [0] if summed else [])
        self.given = [np.zeros(mapped.size_in(i)[::-1]) for i in range(mapped.n_in())]
        self.found = [np.zeros(mapped.size_out(i)[::-1]) for i in range(mapped.n_out())]
        self._buffer, self._run = mapped.buffer()
        for number, array in enumerate(self.given):
            self._buffer.set_arg(number, array.data)
        for number, array in enumerate(self.found):
            self._buffer.set_res(number, array.data)

    def __call__(self, *given: Real) -> list[Real]:
        """Outputs, as they are until the next call; inputs that are not given stay."""
        for own, value in zip(self.given, given, strict=False):
            own[...] = value
        self._run()
        return self.found


class LoopRows:
    """Rows of one cascade for all plants, on grids that stay."""

    def __init__(self, cascade: Cascade, plants: Sequence[Rows]) -> None:
        every = [rows.ellipses for rows in plants]
        names = "centre", "direction", "semi_major", "semi_minor"
        self._ellipses = tuple(np.concatenate([getattr(e, name) for e in every]) for name in names)
        self._delay = np.concatenate([rows.delay for rows in plants])
        v = tustin_frequency(np.concatenate([e.omega_rad_s for e in every]), cascade.dt_s)
        v, self._of_plant, parts = v / cascade.scale_rad_s, list[slice](), list[tuple[Any, ...]]()
        start = 0
        for function in LoopFunction:
            sizes = []
            for rows in plants:
                own = [size for of, size in rows.weights if of is function]
                sizes.append(np.max(own, axis=0) if own else np.zeros(rows.delay.size))
            weight = np.concatenate(sizes)
            at = np.flatnonzero(weight > 0)
            if at.size:
                flags = np.tile([[float(function.of_plant)], [float(function.of_controller)]], at.size)
                parts.append((at, np.log(weight[at]), flags))
                self._of_plant += [slice(start, start + at.size)] if function.of_plant else []
                start += at.size
        self._index, self._weight, flags = (
            np.concatenate(each, axis=-1) for each in zip(*parts, strict=True)
        )
        centre, direction, major, minor = self._ellipses
        turned = centre, direction * major, 1j * direction * minor, self._delay
        pairs = np.concatenate([[each.real, each.imag] for each in turned])
        p = np.stack([v, np.ones(v.size)], axis=1) / np.maximum(v, 1.0)[:, None]
        self._of_k = flags[1] > 0
        self._fixed = p[self._index], np.hstack([pairs.T[self._index], flags.T])
        response, slope, bend = row_functions(cascade.sections)
        self._response, self._slope = _Mapped(response, v.size), _Mapped(slope, self._index.size)
        self._bend = _Mapped(bend, _AT_ONCE, summed=True)
        self._response.given[1][...] = p
        self._slope.given[2][...], self._slope.given[3][...] = self._fixed
        self._last: tuple[Real, Complex, Real, Real] | None = None

    def covers_minus_one(self, x: Real) -> bool:
        """Whether some ellipse contains -1/K; its boundary alone would not show it."""
        centre, direction, semi_major, semi_minor = self._ellipses
        k = self._at(x)[0]
        turned = (1.0 + k * centre) * np.conj(k * direction)
        size = np.abs(k) ** 2
        major, minor = turned.real * semi_minor, turned.imag * semi_major
        return bool(np.any(np.hypot(major, minor) < size * semi_major * semi_minor))

    def rows(self, x: Real) -> Real:
        """Logarithms (R,) of all weighted values."""
        return self._at(x)[2]

    def slopes(self, x: Real) -> Real:
        """Their slopes (R, n)."""
        (slope,) = self._slope(x, self._at(x)[1][:, None])
        return slope.reshape(-1, x.size).copy()

    def curvature(self, x: Real, multipliers: Real) -> Real:
        """Second derivative (n, n) of the rows' sum weighted by multipliers (R,)."""
        angles, total = self._at(x)[1], np.zeros((x.size, x.size))
        active = np.flatnonzero(multipliers > _NOTHING * np.max(multipliers))
        for start in range(0, active.size, _AT_ONCE):
            use = active[start : start + _AT_ONCE]
            share = np.append(multipliers[use], np.zeros(_AT_ONCE - use.size))
            use = np.append(use, np.repeat(use[:1], _AT_ONCE - use.size))
            at = angles[use, None], *(each[use] for each in self._fixed), share[:, None]
            total += self._bend(x, *at)[0]
        return total

    def _at(self, x: Real) -> tuple[Complex, Real, Real]:
        """K with its delay (F,), angles (R,) of the worst members and the rows (R,)."""
        if self._last is None or not np.array_equal(self._last[0], x):
            re, im = self._response(x)
            bare = (re + 1j * im)[:, 0]
            k = bare * self._delay
            worst = _worst_members(k, np.arange(k.size), *self._ellipses, False)[:, self._index]
            for rows in self._of_plant:
                worst[:, rows] = _worst_members(k, self._index[rows], *self._ellipses, True)
            sizes = worst[1] * np.where(self._of_k, np.abs(bare[self._index]), 1.0)
            self._last = x.copy(), k, worst[0], self._weight + np.log(np.maximum(sizes, 1e-300))
        return self._last[1:]


@numba.njit(**COMPILED)
def _worst_members(
    k: Complex,
    index: Integer,
    centre: Complex,
    direction: Complex,
    semi_major: Real,
    semi_minor: Real,
    of_plant: bool,
) -> Real:
    """Angles of the members with the largest |1/(1 + G K)|, or |G/(1 + G K)|, at some of the frequencies, and
    that value, (2, D); k (F,).

    Best boundary point, vertex of the parabola through it, Newton from there. A point that does not gain on
    the boundary's best is not taken.
    """
    width = 2 * np.pi / _BOUNDARY
    cos, sin = np.empty(_BOUNDARY), np.empty(_BOUNDARY)
    for j in range(_BOUNDARY):
        cos[j], sin[j] = np.cos(j * width), np.sin(j * width)
    found, values = np.empty((2, index.size)), np.empty(_BOUNDARY)
    for number in range(index.size):
        i = index[number]
        major, minor = direction[i] * semi_major[i], 1j * direction[i] * semi_minor[i]
        top = 0
        for j in range(_BOUNDARY):
            values[j] = _size(centre[i] + cos[j] * major + sin[j] * minor, k[i], of_plant)
            if values[j] > values[top]:
                top = j
        here, before, after = values[top], values[top - 1], values[(top + 1) % _BOUNDARY]
        best = top * width
        change = _vertex(0.5 * (after - before), before - 2 * here + after)
        angle = best + width * min(max(change, -0.5), 0.5)
        for _ in range(_REFINEMENTS + 1):
            g1 = np.cos(angle) * minor - np.sin(angle) * major
            g2 = -np.cos(angle) * major - np.sin(angle) * minor
            g = centre[i] - g2
            value = _size(g, k[i], of_plant)
            if value > here:
                here, best = value, angle
            # Slope and bend of the logarithm along the boundary.
            back = 1.0 + g * k[i]
            if back == 0:
                break
            first, second = -g1 * k[i] / back, -g2 * k[i] / back
            second += first * first
            if of_plant and g != 0:
                first, second = first + g1 / g, second + g2 / g - (g1 / g) ** 2
            change = _vertex(first.real, second.real)
            angle += min(max(change, -0.5 * width), 0.5 * width)
        found[0, number], found[1, number] = best, here
    return found


@numba.njit(**INSIDE)
def _size(g: complex, k: complex, of_plant: bool) -> Any:
    """|1/(1 + g k)|, or |g/(1 + g k)|; in squares, since a modulus costs more than all the rest."""
    back = 1.0 + g * k
    above = g.real * g.real + g.imag * g.imag if of_plant else 1.0
    return np.sqrt(above / max(back.real * back.real + back.imag * back.imag, 1e-300))


@numba.njit(**INSIDE)
def _vertex(slope: float, bend: float) -> float:
    """Step to the maximum of a parabola; 0 where it has none."""
    return slope / -bend if bend < 0 else 0.0
