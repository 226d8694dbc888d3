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

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from control_design.controllers.biquads import Cascade, tustin_frequency
from control_design.plants.ellipses import Complex, Integer, Real, quotient
from control_design.specification.requirement import LoopFunction
from control_design.synthesis.angle_program import Rows, parameter_bounds
from control_design.synthesis.minimax_step import MinimaxStep, minimax_step

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


class _Boundary:
    """Members of every ellipse of one plant, fixed once."""

    def __init__(self, cascade: Cascade, rows: Rows) -> None:
        e = rows.ellipses
        self._cascade, self._ellipses = cascade, e
        self._omega, self._delay = e.omega_rad_s, rows.delay
        angle = 2 * np.pi * np.arange(_BOUNDARY) / _BOUNDARY
        self._members = (
            e.centre[:, None]
            + e.direction[:, None] * e.semi_major[:, None] * np.cos(angle)
            + 1j * e.direction[:, None] * e.semi_minor[:, None] * np.sin(angle)
        )
        self._powers = 1j * tustin_frequency(self._omega, cascade.dt_s) / cascade.scale_rad_s
        self._powers = np.where(np.abs(self._powers) > 1e6, 1e6j, self._powers)
        # Of one closed-loop function each: positions of its frequencies and weights there, (D,).
        self._blocks: list[tuple[LoopFunction, Integer, Real]] = []
        for function in LoopFunction:
            sizes = [size for of, size in rows.weights if of is function]
            weight = np.max(sizes, axis=0) if sizes else np.zeros(0)
            if np.any(weight > 0):
                index = np.flatnonzero(weight > 0)
                self._blocks.append((function, index, weight[index]))

    def covers_minus_one(self, x: Real) -> bool:
        """Whether some ellipse contains -1/K; its boundary alone would not show it."""
        e = self._ellipses
        k = self._cascade.response(x, self._omega) * self._delay
        turned = (1.0 + k * e.centre) * np.conj(k * e.direction)
        size = np.abs(k) ** 2
        major, minor = turned.real * e.semi_minor, turned.imag * e.semi_major
        return bool(np.any(np.hypot(major, minor) < size * e.semi_major * e.semi_minor))

    def rows(self, x: Real, *, gradient: bool) -> tuple[Real, Real]:
        """Logarithms (R,) of all weighted values, block by block, and, if asked, their slopes (R, n)."""
        bare = self._cascade.response(x, self._omega)
        k = bare * self._delay
        nearest, _, _ = self._worst(k, np.arange(k.size), 0.0)
        back = 1.0 + nearest * k
        distance = -np.log(np.maximum(np.abs(back), 1e-300))
        size = np.log(np.maximum(np.abs(bare), 1e-300))
        relative = self._relative_slope(x) if gradient else np.zeros((k.size, 0))  # dK/K
        turned = -(nearest * k / back)[:, None] * relative
        logs, slopes = [], []
        for function, at, weight in self._blocks:
            of_k = size[at] if function.of_controller else 0.0
            if function.of_plant:
                worst, _, _ = self._worst(k[at], at, 1.0)
                here = 1.0 + worst * k[at]
                gain = np.abs(worst) / np.maximum(np.abs(here), 1e-300)
                log = np.log(weight * gain) + of_k
                slope = -(worst * k[at] / here)[:, None] * relative[at]
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
        k = self._cascade.response(x, self._omega) * self._delay
        relative = self._relative_slope(x)
        shared, of_controller = np.zeros(k.size), np.zeros(k.size)
        total, second = np.zeros((x.size, x.size)), np.zeros(k.size, dtype=np.complex128)
        start = 0
        for function, at, _ in self._blocks:
            own = multipliers[start : start + at.size]
            start += at.size
            if function.of_controller:
                of_controller[at] += own
            if function.of_plant:
                member = self._worst(k[at], at, 1.0)
                more, factor = self._bent(relative[at], k[at], own, member, 1.0)
                total, second[at] = total + more, second[at] + factor
            else:
                shared[at] += own
        member = self._worst(k, np.arange(k.size), 0.0)
        more, factor = self._bent(relative, k, shared, member, 0.0)
        return total + more + self._section_curvature(x, second + factor + of_controller)

    @staticmethod
    def _bent(
        relative: Complex, k: Complex, share: Real, member: tuple[Complex, Complex, Complex], open_loop: float
    ) -> tuple[Real, Complex]:
        """Curvature of sum share log|g^open_loop/(1 + g K)| but for that of log K, and the factor of the
        latter, (F,)."""
        g, g1, _ = member
        back = _not_zero(1.0 + g * k)
        w = g * k / back
        total = -np.real((relative * (share * (w - w**2))[:, None]).T @ relative)
        mixed = -np.real((g1 * k / back**2)[:, None] * relative)
        bend = _along_boundary(member, k, open_loop)[1]
        use = (bend < -1e-12) & (share > 0)
        total = total + (mixed[use] * (share[use] / -bend[use])[:, None]).T @ mixed[use]
        return total, np.asarray(-share * w, dtype=np.complex128)

    def _worst(self, k: Complex, index: Integer, open_loop: float) -> tuple[Complex, Complex, Complex]:
        """Members (D,) with the largest |g^open_loop/(1 + g K)| at some of the frequencies, and their first
        and second derivative along the boundary; k (D,).

        Best boundary point, vertex of the parabola through it, Newton from there. A point that does not gain
        on the boundary's best is not taken.
        """
        e = self._ellipses
        centre, turn = e.centre[index], e.direction[index]
        major, minor = e.semi_major[index], e.semi_minor[index]

        def member(angle: Real) -> tuple[Complex, Complex, Complex]:
            cos, sin = np.cos(angle), np.sin(angle)
            away = turn * (major * cos + 1j * minor * sin)
            return centre + away, turn * (-major * sin + 1j * minor * cos), -away

        def size(g: Complex, k: Complex) -> Real:
            return np.asarray(np.abs(g) ** open_loop / np.maximum(np.abs(1.0 + g * k), 1e-300))

        value = size(self._members[index], k[:, None])
        row = np.arange(index.size)
        top = np.argmax(value, axis=1)
        here, before, after = (value[row, (top + step) % _BOUNDARY] for step in (0, -1, 1))
        bend = before - 2 * here + after
        width = 2 * np.pi / _BOUNDARY
        best = width * top
        angle = best + width * np.clip(_newton(0.5 * (after - before), bend), -0.5, 0.5)
        for _ in range(_REFINEMENTS + 1):
            found = member(angle)
            value = size(found[0], k)
            better = value > here
            best, here = np.where(better, angle, best), np.where(better, value, here)
            change = _newton(*_along_boundary(found, k, open_loop))
            angle = angle + np.clip(change, -0.5 * width, 0.5 * width)
        return member(best)

    def _sections(self, x: Real) -> list[tuple[Complex, Complex, Complex]]:
        """Of every section, for its own parameters (F, m): derivatives of its numerator over the numerator,
        of its denominator over the denominator, and second derivatives of log K but for products of those."""
        p = self._powers
        found, at = [], 0
        for kind, (numerator, denominator) in zip(
            self._cascade.sections, self._cascade.split(x), strict=True
        ):
            top, bottom = np.polyval(numerator, p), np.polyval(denominator, p)
            top = np.where(np.abs(top) < 1e-300, 1e-300, top)
            zero = np.zeros(p.size, dtype=np.complex128)
            degree = numerator.size - 1
            if kind == "notch":
                above = [np.exp(x[at]) * p / top, zero, denominator[2] / top]
                below = [zero, denominator[1] * p / bottom, denominator[2] / bottom]
                linear = 0
            else:
                above = [p ** (degree - power) / top for power in range(degree + 1)]
                logs = range(0 if kind == "integrator" else degree)
                below = [denominator[1 + j] * p ** (degree - 1 - j) / bottom for j in logs]
                linear = len(above)
                above, below = above + [zero] * len(below), [zero] * len(above) + below
            tops, bottoms = np.stack(above, axis=1), np.stack(below, axis=1)
            bend = tops - bottoms  # parameters are logarithms: exp is its own derivative
            bend[:, :linear] = 0
            found.append((tops, bottoms, bend))
            at += tops.shape[1]
        return found

    def _section_curvature(self, x: Real, factor: Complex) -> Real:
        """Real part of sum factor (F,) times the second derivative of log K, (n, n): block by section."""
        blocks = []
        for tops, bottoms, bend in self._sections(x):
            product = (bottoms * factor[:, None]).T @ bottoms - (tops * factor[:, None]).T @ tops
            blocks.append(np.real(product) + np.diag(np.real(factor @ bend)))
        return np.asarray(block_diag(*blocks))

    def _relative_slope(self, x: Real) -> Complex:
        """(dK/dx)/K, (F, n)."""
        return np.concatenate([tops - bottoms for tops, bottoms, _ in self._sections(x)], axis=1)


def _not_zero(value: Complex) -> Complex:
    return np.where(np.abs(value) < 1e-300, 1e-300, value)


def _along_boundary(
    member: tuple[Complex, Complex, Complex], k: Complex, open_loop: float
) -> tuple[Real, Real]:
    """Slope and bend of log|g^open_loop/(1 + g K)| along the boundary, from a member and its derivatives."""
    g, g1, g2 = member
    back, own = _not_zero(1.0 + g * k), open_loop / _not_zero(g)
    first = (own * g1 - g1 * k / back).real
    return first, (own * g2 - own**2 * g1**2 - g2 * k / back + (g1 * k / back) ** 2).real


def _newton(slope: Real, bend: Real) -> Real:
    """Step to the maximum of a parabola; 0 where it has none."""
    return np.asarray(quotient(slope, -bend), dtype=np.float64)


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
