"""Descent on the worst case itself: from any stable controller to a local minimum, stable at every step.

gamma(x) is a maximum of smooth functions, one per frequency and requirement. Each step models their
logarithms at the worst member of the ellipse: slopes by the envelope theorem (that member may be held
fixed), one common curvature, that of the sum weighted by the multipliers of the step before. It solves
"smallest largest row within a box" (`minimax_step`) and accepts only where the true value falls and all
nominal loops stay stable. With curvature, convergence near the end is that of Newton's method also where
fewer rows are active than there are parameters.

Worst members are looked for on `_BOUNDARY` points of each ellipse's boundary, refined by a parabola and
Newton's method: good for a direction, not for a certificate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numba
import numpy as np

from control_design.controllers.biquads import Cascade, tustin_frequency
from control_design.plants.ellipses import Complex, Integer, Real
from control_design.specification.requirement import LoopFunction
from control_design.synthesis.angle_program import Rows, parameter_bounds
from control_design.synthesis.minimax_step import MinimaxStep, minimax_step
from ident.data.arrays import COMPILED, INSIDE

_BOUNDARY = 40  # every 9 degrees; parabola and Newton steps go on from the worst
_FIRST_BOX, _LARGEST_BOX, _SMALLEST_BOX = 0.3, 1.0, 1e-4
_PATIENCE, _SLOW = 15, 1e-3  # give up where so many steps gain less than this share
_LEAST_GAIN = 1e-7  # predicted gain of a step, in the logarithm, not worth taking
_FAR_BELOW = 2.5  # rows this far (in log) below the worst cannot become it within one step and are left out
_REFINEMENTS = 2  # Newton steps from the vertex of the parabola to the worst member


class MinimaxDescent:
    """Descent for one cascade and one set of rows (as the angle programme has them)."""

    def __init__(
        self,
        cascade: Cascade,
        plants: Sequence[Rows],
        stable: Callable[[Real], bool],
        *,
        controller_damping: float | None = None,
    ) -> None:
        self.cascade, self.stable = cascade, stable
        self._plants = [_Boundary(cascade, rows) for rows in plants]
        self._low, self._high = parameter_bounds(cascade)
        slack = [] if controller_damping is None else list(cascade.pair_positions)
        self._damping_rows = np.zeros((len(slack), cascade.parameters))
        for row, at in enumerate(slack):
            self._damping_rows[row, at], self._damping_rows[row, at + 1] = -1.0, 0.5
        limit = 0.0 if controller_damping is None else -float(np.log(2 * controller_damping))
        self._damping_limit = np.full(len(slack), limit)

    def value(self, parameters: Real) -> float:
        """Worst case on the boundary points; inf for an unstable nominal loop or an ellipse over -1."""
        logs = self._logs(parameters)
        return float("inf") if logs is None else float(np.exp(np.max(logs)))

    def run(self, start: Real, steps: int) -> tuple[Real, float, int]:
        """At most `steps` steps from a start with stable nominal loops: parameters where it ended, the worst
        case seen there (boundary points, own grid; inf: the start is unstable), steps taken."""
        x = np.clip(np.asarray(start, dtype=np.float64), self._low, self._high)
        logs = self._logs(x)
        if logs is None:
            return x, float("inf"), 0
        best, box, taken = float(np.max(logs)), _FIRST_BOX, 0
        local: _Local | None = None
        multipliers: Real | None = None
        earlier = best
        for number in range(steps):
            if number % _PATIENCE == 0 and number > 0:
                if best > earlier - _SLOW:
                    break
                earlier = best
            if local is None:
                local = self._local(x, multipliers)
            taken += 1
            step = self._step(x, local, local.log, box)
            if step is None:
                break
            move = step.step * local.unit
            predicted = best - step.level - 0.5 * float(move @ local.curvature @ move)
            if predicted < _LEAST_GAIN:
                break
            trial, after = x + move, self._logs(x + move)
            if after is not None and best - float(np.max(after)) < 0.25 * predicted:
                # The rows bend more than their common curvature says: once more, with the rows as they are
                # at the trial point (second-order correction).
                again = self._step(x, local, after - local.slope @ move, box)
                if again is not None:
                    second = x + again.step * local.unit
                    corrected = self._logs(second)
                    if corrected is not None and np.max(corrected) < np.max(after):
                        step, trial, after = again, second, corrected
            actual = -np.inf if after is None else best - float(np.max(after))
            if after is not None and actual > 0.02 * predicted:
                x, best, local, multipliers = trial, float(np.max(after)), None, step.multipliers
            if actual > 0.7 * predicted:
                box = min(2.0 * box, _LARGEST_BOX)
            elif actual < 0.25 * predicted:
                box *= 0.35
            if box < _SMALLEST_BOX:
                break
        return x, float(np.exp(best)), taken

    def _logs(self, x: Real) -> Real | None:
        """Logarithms (R,) of all weighted values; None for an unstable loop or an ellipse over -1."""
        if not self.stable(x) or any(plant.covers_minus_one(x) for plant in self._plants):
            return None
        return np.concatenate([plant.rows(x, gradient=False)[0] for plant in self._plants])

    def _local(self, x: Real, multipliers: Real | None) -> _Local:
        """Rows, slopes and (with multipliers of the rows) their common curvature, made semi-definite."""
        log, slope, curvature, at = [], [], np.zeros((x.size, x.size)), 0
        for plant in self._plants:
            part = plant.rows(x, gradient=True)
            log.append(part[0])
            slope.append(part[1])
            if multipliers is not None:
                curvature += plant.curvature(x, multipliers[at : at + part[0].size])
            at += part[0].size
        unit = natural_units(self.cascade, x)
        if multipliers is not None:
            size, axes = np.linalg.eigh(curvature * np.outer(unit, unit))
            curvature = (axes * np.maximum(size, 0.0)) @ axes.T / np.outer(unit, unit)
        return _Local(np.concatenate(log), np.concatenate(slope), curvature, unit)

    def _step(self, x: Real, local: _Local, log: Real, box: float) -> MinimaxStep | None:
        """Smallest largest row, |d| <= box in natural units; multipliers of all rows; None where it fails."""
        unit = local.unit
        near = log > np.max(log) - _FAR_BELOW
        step = minimax_step(
            log[near],
            local.slope[near] * unit,
            local.curvature * np.outer(unit, unit),
            np.maximum(-box, (self._low - x) / unit),
            np.minimum(box, (self._high - x) / unit),
            self._damping_rows * unit,
            self._damping_limit - self._damping_rows @ x,
        )
        if step is None:
            return None
        multipliers = np.zeros(log.size)
        multipliers[near] = step.multipliers
        return replace(step, multipliers=multipliers)


class _Local(NamedTuple):
    """Model at a point: log (R,), slope (R, n), curvature (n, n), natural unit of each parameter (n,)."""

    log: Real
    slope: Real
    curvature: Real
    unit: Real


class _At(NamedTuple):
    """One plant's loop at one x: K without its delay and with it, (F,), sections' numerators and denominators
    (F, S), and members (3, D) with the largest |G^b/(1 + G K)|: G, and its derivatives along the boundary."""

    x: Real
    bare: Complex
    k: Complex
    tops: Complex
    bottoms: Complex
    nearest: Complex
    of_plant: list[Complex]


class _Boundary:
    """Members of every ellipse of one plant, fixed once."""

    def __init__(self, cascade: Cascade, rows: Rows) -> None:
        e = rows.ellipses
        self._cascade, self._delay = cascade, rows.delay
        self._ellipses = e.centre.copy(), e.direction.copy(), e.semi_major.copy(), e.semi_minor.copy()
        # Of a section over the square of the larger of |p| and 1: 1e16 at Nyquist stays exact.
        p = 1j * tustin_frequency(e.omega_rad_s, cascade.dt_s) / cascade.scale_rad_s
        big = np.abs(p) > 1.0
        q = np.where(big, 1.0 / np.where(big, p, 1.0), p)
        powers = [np.where(big, 1.0, q**2), q, np.where(big, q**2, 1.0)]
        self._powers = np.stack(powers, axis=1, dtype=np.complex128)
        self._pattern = _Pattern(cascade)
        # Of one closed-loop function each: positions of its frequencies and weights there, (D,).
        self._blocks: list[tuple[LoopFunction, Integer, Real]] = []
        for function in LoopFunction:
            sizes = [size for of, size in rows.weights if of is function]
            weight = np.max(sizes, axis=0) if sizes else np.zeros(0)
            if np.any(weight > 0):
                index = np.flatnonzero(weight > 0)
                self._blocks.append((function, index, weight[index]))
        self._every = np.arange(p.size)
        self._last: _At | None = None

    def covers_minus_one(self, x: Real) -> bool:
        """Whether some ellipse contains -1/K; its boundary alone would not show it."""
        centre, direction, semi_major, semi_minor = self._ellipses
        k = self._response(x)[0] * self._delay
        turned = (1.0 + k * centre) * np.conj(k * direction)
        size = np.abs(k) ** 2
        major, minor = turned.real * semi_minor, turned.imag * semi_major
        return bool(np.any(np.hypot(major, minor) < size * semi_major * semi_minor))

    def rows(self, x: Real, *, gradient: bool) -> tuple[Real, Real]:
        """Logarithms (R,) of all weighted values, block by block, and, if asked, their slopes (R, n)."""
        here = self._at(x)
        k, nearest = here.k, here.nearest[0]
        back = 1.0 + nearest * k
        distance = -np.log(np.maximum(np.abs(back), 1e-300))
        size = np.log(np.maximum(np.abs(here.bare), 1e-300))
        relative = np.subtract(*self._terms(here)) if gradient else np.zeros((k.size, 0))  # dK/K
        turned = -(nearest * k / back)[:, None] * relative
        logs, slopes, members = [], [], iter(here.of_plant)
        for function, at, weight in self._blocks:
            of_k = size[at] if function.of_controller else 0.0
            if function.of_plant:
                worst = next(members)[0]
                away = 1.0 + worst * k[at]
                log = np.log(weight * (np.abs(worst) / np.maximum(np.abs(away), 1e-300))) + of_k
                slope = -(worst * k[at] / away)[:, None] * relative[at]
            else:
                log, slope = np.log(weight) + of_k + distance[at], turned[at]
            if function.of_controller:
                slope = slope + relative[at]
            logs.append(log)
            slopes.append(slope.real)
        return np.concatenate(logs), np.concatenate(slopes)

    def curvature(self, x: Real, multipliers: Real) -> Real:
        """Second derivative (n, n) of the rows' sum weighted by multipliers (R,).

        A row is the largest over the boundary angle of psi(x, angle), so its second derivative is psi_xx -
        psi_xa psi_xa' / psi_aa: a long ellipse bends the row although its worst member moves only along it.
        """
        here = self._at(x)
        k, (tops, bottoms) = here.k, self._terms(here)
        relative = tops - bottoms
        shared, of_controller = np.zeros(k.size), np.zeros(k.size)
        total, factor = np.zeros((x.size, x.size)), np.zeros(k.size, dtype=np.complex128)
        start, members = 0, iter(here.of_plant)
        for function, at, _ in self._blocks:
            own = multipliers[start : start + at.size]
            start += at.size
            if function.of_controller:
                of_controller[at] += own
            if function.of_plant:
                more, second = self._bent(relative[at], k[at], own, next(members), 1.0)
                total, factor[at] = total + more, factor[at] + second
            else:
                shared[at] += own
        more, second = self._bent(relative, k, shared, here.nearest, 0.0)
        factor += second + of_controller
        # Of log K itself: products of one section's terms, and of the logarithms, whose exponential is its
        # own derivative, the terms themselves.
        product = (bottoms * factor[:, None]).T @ bottoms - (tops * factor[:, None]).T @ tops
        own_bend = np.diag(np.real(factor @ relative) * self._pattern.logarithm)
        return np.asarray(total + more + np.real(product) * self._pattern.together + own_bend)

    @staticmethod
    def _bent(
        relative: Complex, k: Complex, share: Real, member: Complex, open_loop: float
    ) -> tuple[Real, Complex]:
        """Curvature of sum share log|g^open_loop/(1 + g K)| but for that of log K, and the factor of the
        latter, (F,)."""
        g, g1, g2 = member
        back = _not_zero(1.0 + g * k)
        w = g * k / back
        total = -np.real((relative * (share * (w - w**2))[:, None]).T @ relative)
        mixed = -np.real((g1 * k / back**2)[:, None] * relative)
        # Of log|g^open_loop/(1 + g K)| along the boundary.
        own = open_loop / _not_zero(g)
        bend = np.real(own * g2 - own**2 * g1**2 - g2 * k / back + (g1 * k / back) ** 2)
        use = (bend < -1e-12) & (share > 0)
        total = total + (mixed[use] * (share[use] / -bend[use])[:, None]).T @ mixed[use]
        return total, np.asarray(-share * w, dtype=np.complex128)

    def _response(self, x: Real) -> tuple[Complex, Complex, Complex]:
        """K without delay (F,), and every section's numerator and denominator (F, S)."""
        above, below = self._pattern.coefficients(x)
        tops, bottoms = self._powers @ above, self._powers @ below
        return np.prod(tops / bottoms, axis=1, dtype=np.complex128), tops, bottoms

    def _at(self, x: Real) -> _At:
        if self._last is None or not np.array_equal(self._last.x, x):
            blocks = [at for function, at, _ in self._blocks if function.of_plant]
            bare, tops, bottoms = self._response(x)
            k = bare * self._delay
            of_plant = [self._worst(k, at, of_plant=True) for at in blocks]
            nearest = self._worst(k, self._every, of_plant=False)
            self._last = _At(x.copy(), bare, k, tops, bottoms, nearest, of_plant)
        return self._last

    def _worst(self, k: Complex, index: Integer, *, of_plant: bool) -> Complex:
        return np.asarray(_worst_members(k, index, *self._ellipses, of_plant))

    def _terms(self, here: _At) -> tuple[Complex, Complex]:
        """Derivatives (F, n) of every parameter's section: of its numerator over the numerator, of its
        denominator over the denominator."""
        section = self._pattern.section
        above, below = self._pattern.slopes(here.x)
        return (
            (self._powers @ above) / _not_zero(here.tops)[:, section],
            (self._powers @ below) / here.bottoms[:, section],
        )


class _Pattern:
    """How the coefficients of all sections, each as one of second order, depend on the parameters.

    Of every parameter: its section, whether it is a logarithm, (n,); which coefficients of the numerator and
    of the denominator it moves, (3, n), highest power first; with which others it shares a section, (n, n).
    """

    def __init__(self, cascade: Cascade) -> None:
        self._cascade = cascade
        entries: list[tuple[int, bool, list[int], list[int]]] = []
        for number, kind in enumerate(cascade.sections):
            if kind == "notch":
                entries += [(number, True, [1], []), (number, True, [], [1]), (number, True, [2], [2])]
                continue
            first = 0 if kind == "second_order" else 1
            entries += [(number, False, [power], []) for power in range(first, 3)]
            logs = range(first + 1, 3) if kind != "integrator" else ()
            entries += [(number, True, [], [power]) for power in logs]
        self.section = np.array([number for number, *_ in entries])
        self.logarithm = np.array([logarithm for _, logarithm, *_ in entries])
        self.together = self.section[:, None] == self.section
        self._above, self._below = np.zeros((2, 3, len(entries)))
        for at, (_, _, above, below) in enumerate(entries):
            self._above[above, at], self._below[below, at] = 1.0, 1.0

    def coefficients(self, x: Real) -> tuple[Real, Real]:
        """Of numerators and denominators, (3, S) each."""
        pairs = self._cascade.split_with(x.tolist(), math.exp)
        both = [[[0.0] * (3 - len(part)) + part for part in parts] for parts in zip(*pairs, strict=True)]
        tops, bottoms = np.array(both).transpose(0, 2, 1)
        return tops, bottoms

    def slopes(self, x: Real) -> tuple[Real, Real]:
        """Derivatives of the coefficients of each parameter's section, (3, n) each."""
        tops, bottoms = self.coefficients(x)
        return (
            self._above * np.where(self.logarithm, tops[:, self.section], 1.0),
            self._below * bottoms[:, self.section],
        )


@numba.njit(**COMPILED)
def _worst_members(
    k: Complex,
    index: Integer,
    centre: Complex,
    direction: Complex,
    semi_major: Real,
    semi_minor: Real,
    of_plant: bool,
) -> Complex:
    """Members (3, D) with the largest |1/(1 + G K)|, or |G/(1 + G K)|, at some of the frequencies, and their
    first and second derivatives along the boundary; k (F,).

    Best boundary point, vertex of the parabola through it, Newton from there. A point that does not gain on
    the boundary's best is not taken.
    """
    width = 2 * np.pi / _BOUNDARY
    cos, sin = np.empty(_BOUNDARY), np.empty(_BOUNDARY)
    for j in range(_BOUNDARY):
        cos[j], sin[j] = np.cos(j * width), np.sin(j * width)
    found, values = np.empty((3, index.size), dtype=np.complex128), np.empty(_BOUNDARY)
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
        found[1, number] = np.cos(best) * minor - np.sin(best) * major
        found[2, number] = -np.cos(best) * major - np.sin(best) * minor
        found[0, number] = centre[i] - found[2, number]
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


def _not_zero(value: Complex) -> Complex:
    return np.where(np.abs(value) < 1e-300, 1e-300, value)


def natural_units(cascade: Cascade, x: Real) -> Real:
    """A substantial change of each parameter: numerators relative to their section's gain and corner."""
    units: list[float] = []
    for kind, (numerator, denominator) in zip(cascade.sections, cascade.split(x), strict=True):
        degree = numerator.size - 1
        corner = 1.0 if kind == "integrator" else float(denominator[-1] ** (1.0 / degree))
        powers = corner ** np.arange(degree + 1)
        if kind == "notch":
            units += [1.0, 1.0, 1.0]
            continue
        gain = max(float(np.max(np.abs(numerator) / powers)), 1e-9)
        units += (gain * powers).tolist()
        units += [] if kind == "integrator" else [1.0] * degree
    return np.array(units)
