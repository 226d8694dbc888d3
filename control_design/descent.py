"""Descent on the worst case itself: from any stable controller to near a local minimum, stable at every
step.

gamma(x) is a maximum of smooth functions, one per frequency and requirement. Each step linearises their
logarithms at the worst member of the ellipse (by the envelope theorem that member may be held fixed), solves
the linear programme "smallest largest value within a box" and accepts the step only where the true value
falls and all nominal loops stay stable. The interior-point programme converges faster at the end but may
leave a good start for good; this does not.

Worst members are looked for on `_BOUNDARY` points of each ellipse's boundary and refined by a parabola: good
for a direction, not for a certificate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from control_design.angle_program import Rows, parameter_bounds
from control_design.biquads import Cascade, tustin_frequency
from control_design.ellipses import Complex, Real

_BOUNDARY = 40
_FIRST_BOX, _LARGEST_BOX, _SMALLEST_BOX = 0.3, 1.0, 1e-4
_PATIENCE, _SLOW = 15, 1e-3  # give up where so many steps gain less than this share
_FAR_BELOW = 2.5  # rows this far (in log) below the worst cannot become it within one step and are left out


@dataclass(frozen=True, eq=False)
class Descended:
    """Where the descent ended: parameters, the worst case it saw (boundary points, its grid), steps taken."""

    parameters: Real
    gamma: float
    steps: int


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
        self._damping_limit = 0.0 if controller_damping is None else -float(np.log(2 * controller_damping))

    def value(self, parameters: Real) -> float:
        """Worst case on the boundary points; inf for an unstable nominal loop or an ellipse over -1."""
        if not self.stable(parameters) or any(plant.covers_minus_one(parameters) for plant in self._plants):
            return float("inf")
        logs = [plant.rows(parameters, gradient=False)[0] for plant in self._plants]
        return float(np.exp(max(float(np.max(log)) for log in logs)))

    def run(self, start: Real, steps: int) -> Descended:
        """At most `steps` linear programmes from a start with stable nominal loops."""
        x = np.clip(np.asarray(start, dtype=np.float64), self._low, self._high)
        best, box, taken = self.value(x), _FIRST_BOX, 0
        if not np.isfinite(best):
            return Descended(x, best, 0)
        model: tuple[Real, Real] | None = None
        earlier = best
        for number in range(steps):
            if number % _PATIENCE == 0 and number > 0:
                if best > earlier * (1 - _SLOW):
                    break
                earlier = best
            if model is None:
                parts = [plant.rows(x, gradient=True) for plant in self._plants]
                model = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
            taken += 1
            step, predicted = self._step(x, model[0], model[1], box)
            gain = np.log(best) - predicted
            if step is None or gain < 1e-7:
                break
            trial = x + step
            value = self.value(trial)
            actual = np.log(best) - np.log(value) if np.isfinite(value) else -np.inf
            if actual > 0.02 * gain:
                x, best, model = trial, value, None
            if actual > 0.7 * gain:
                box = min(2.0 * box, _LARGEST_BOX)
            elif actual < 0.25 * gain:
                box *= 0.35
            if box < _SMALLEST_BOX:
                break
        return Descended(x, best, taken)

    def _step(self, x: Real, log: Real, slope: Real, box: float) -> tuple[Real | None, float]:
        """d of min s, log + slope d <= s, |d| <= box in natural units; (None, worst) where it fails."""
        unit = natural_units(self.cascade, x)
        worst = float(np.max(log))
        near = log > worst - _FAR_BELOW
        n = x.size
        a = np.column_stack([slope[near] * unit, -np.ones(int(np.sum(near)))])
        b = worst - log[near]
        if self._damping_rows.shape[0]:
            a = np.vstack(
                [a, np.column_stack([self._damping_rows * unit, np.zeros(len(self._damping_rows))])]
            )
            b = np.concatenate([b, self._damping_limit - self._damping_rows @ x])
        low = np.maximum(-box, (self._low - x) / unit)
        high = np.minimum(box, (self._high - x) / unit)
        answer = linprog(
            np.append(np.zeros(n), 1.0),
            A_ub=a,
            b_ub=b,
            bounds=[*zip(low.tolist(), high.tolist(), strict=True), (-20.0, 0.0)],
            method="highs-ds",
        )
        if answer.x is None:
            return None, worst
        return np.asarray(answer.x[:n] * unit, dtype=np.float64), worst + float(answer.x[n])


class _Boundary:
    """Members of every ellipse of one plant, fixed once."""

    def __init__(self, cascade: Cascade, rows: Rows) -> None:
        e = rows.ellipses
        self._cascade, self._rows, self._ellipses = cascade, rows, e
        self._omega, self._delay = e.omega_rad_s, rows.delay
        angle = 2 * np.pi * np.arange(_BOUNDARY) / _BOUNDARY
        self._members = (
            e.centre[:, None]
            + e.direction[:, None] * e.semi_major[:, None] * np.cos(angle)
            + 1j * e.direction[:, None] * e.semi_minor[:, None] * np.sin(angle)
        )
        self._powers = 1j * tustin_frequency(self._omega, cascade.dt_s) / cascade.scale_rad_s
        self._powers = np.where(np.abs(self._powers) > 1e6, 1e6j, self._powers)
        joint = rows.w1
        if rows.gp_max is not None:
            joint = np.maximum(joint, rows.w4 * rows.gp_max)
        with np.errstate(divide="ignore"):
            self._log_joint, self._log_w3 = np.log(joint), np.log(rows.w3)
        self._effort = np.flatnonzero(rows.w3 > 0)
        self._damped = np.flatnonzero(rows.w4 > 0) if rows.gp_max is None else np.zeros(0, dtype=np.int64)

    def covers_minus_one(self, x: Real) -> bool:
        """Whether some ellipse contains -1/K; its boundary alone would not show it."""
        e = self._ellipses
        k = self._cascade.response(x, self._omega) * self._delay
        turned = (1.0 + k * e.centre) * np.conj(k * e.direction)
        size = np.abs(k) ** 2
        major, minor = turned.real * e.semi_minor, turned.imag * e.semi_major
        return bool(np.any(np.hypot(major, minor) < size * e.semi_major * e.semi_minor))

    def rows(self, x: Real, *, gradient: bool) -> tuple[Real, Real]:
        """Logarithms (R,) of all weighted values and, if asked, their slopes (R, n)."""
        bare = self._cascade.response(x, self._omega)
        k = bare * self._delay
        everywhere = np.arange(k.size)
        at = self._worst(k, everywhere, -np.abs(1.0 + self._members * k[:, None]))
        back = 1.0 + at * k
        distance = -np.log(np.maximum(np.abs(back), 1e-300))
        effort = self._effort
        size = np.log(np.maximum(np.abs(bare[effort]), 1e-300))
        logs = [self._log_joint + distance, self._log_w3[effort] + size + distance[effort]]
        damped = self._damped
        worst = np.zeros(0, dtype=np.complex128)
        if damped.size:
            members = self._members[damped]
            ratio = np.abs(members) / np.maximum(np.abs(1.0 + members * k[damped, None]), 1e-300)
            worst = self._worst(k, damped, ratio, disturbance=True)
            gain = np.abs(worst) / np.maximum(np.abs(1.0 + worst * k[damped]), 1e-300)
            logs.append(np.log(self._rows.w4[damped] * gain))
        if not gradient:
            return np.concatenate(logs), np.zeros((0, 0))
        relative = self._relative_slope(x)  # dK/K
        turned = -(at * k / back)[:, None] * relative
        slopes = [turned.real, (turned[effort] + relative[effort]).real]
        if damped.size:
            slopes.append((-(worst * k[damped] / (1.0 + worst * k[damped]))[:, None] * relative[damped]).real)
        return np.concatenate(logs), np.concatenate(slopes)

    def _worst(self, k: Complex, index: np.ndarray, value: Real, *, disturbance: bool = False) -> Complex:
        """Member with the largest value: best boundary point, then the vertex of the parabola through it."""
        row = np.arange(index.size)
        top = np.argmax(value, axis=1)
        here, before, after = (value[row, (top + step) % _BOUNDARY] for step in (0, -1, 1))
        bend = before - 2 * here + after
        with np.errstate(divide="ignore", invalid="ignore"):
            shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
        angle = 2 * np.pi * (top + np.clip(shift, -0.5, 0.5)) / _BOUNDARY
        e = self._ellipses
        refined = e.centre[index] + e.direction[index] * (
            e.semi_major[index] * np.cos(angle) + 1j * e.semi_minor[index] * np.sin(angle)
        )
        found = np.abs(1.0 + refined * k[index])
        better = np.abs(refined) / np.maximum(found, 1e-300) > here if disturbance else -found > here
        return np.asarray(np.where(better, refined, self._members[index, top]), dtype=np.complex128)

    def _relative_slope(self, x: Real) -> Complex:
        """(dK/dx)/K, (F, n)."""
        p = self._powers
        columns: list[Complex] = []
        at = 0
        for kind, (numerator, denominator) in zip(
            self._cascade.sections, self._cascade.split(x), strict=True
        ):
            top, bottom = np.polyval(numerator, p), np.polyval(denominator, p)
            top = np.where(np.abs(top) < 1e-300, 1e-300, top)
            if kind == "notch":
                columns.append(np.exp(x[at]) * p / top)
                columns.append(-denominator[1] * p / bottom)
                columns.append(denominator[2] * (1.0 / top - 1.0 / bottom))
                at += 3
                continue
            degree = numerator.size - 1
            columns += [p ** (degree - power) / top for power in range(degree + 1)]
            at += degree + 1
            if kind != "integrator":
                columns += [-denominator[1 + j] * p ** (degree - 1 - j) / bottom for j in range(degree)]
                at += degree
        return np.stack(columns, axis=1)


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
