"""Descent on the worst case itself: from any stable controller to a local minimum, stable at every step.

gamma(x) is a maximum of smooth functions, one per frequency and requirement. Each step models their
logarithms at the worst member of the ellipse (`rows`): slopes, and one common curvature, that of the sum
weighted by the multipliers of the step before. It solves
"smallest largest row within a box" (`minimax_step`) and accepts only where the true value falls and all
nominal loops stay stable. With curvature, convergence near the end is that of Newton's method also where
fewer rows are active than there are parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from control_design.controllers.biquads import Cascade
from control_design.plants.ellipses import Real
from control_design.synthesis.minimax_step import MinimaxStep, minimax_step
from control_design.synthesis.rows import LoopRows, Rows

_FIRST_BOX, _LARGEST_BOX, _SMALLEST_BOX = 0.3, 1.0, 1e-4  # of a step, in natural units
_PATIENCE, _SLOW = 15, 1e-3  # give up where so many steps gain less than this share
_LEAST_GAIN = 1e-7  # predicted gain of a step, in the logarithm, not worth taking
_FAR_BELOW = 2.5  # rows this far (in log) below the worst cannot become it within one step and are left out


class MinimaxDescent:
    """Descent for one cascade and one set of rows ."""

    def __init__(
        self,
        cascade: Cascade,
        plants: Sequence[Rows],
        stable: Callable[[Real], bool],
        *,
        controller_damping: float | None = None,
    ) -> None:
        self.cascade, self.stable = cascade, stable
        self.rows = LoopRows(cascade, plants)
        # Logarithms kept within a few decades of the scale: exp() never overflows in a wild step.
        low: list[float] = []
        for kind in cascade.sections:
            low += {
                "integrator": [-np.inf] * 2,
                "first_order": [-np.inf] * 2 + [-12.0],
                "second_order": [-np.inf] * 3 + [-12.0, -20.0],
                "notch": [-12.0, -12.0, -20.0],
            }[kind]
        self._low, self._high = np.array(low), -np.array(low)
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
        inside = self.stable(x) and not self.rows.covers_minus_one(x)
        return self.rows.rows(x) if inside else None

    def _local(self, x: Real, multipliers: Real | None) -> _Local:
        """Rows, slopes and (with multipliers of the rows) their common curvature, made semi-definite."""
        curvature, unit = np.zeros((x.size, x.size)), natural_units(self.cascade, x)
        if multipliers is not None:
            scales = np.outer(unit, unit)
            size, axes = np.linalg.eigh(self.rows.curvature(x, multipliers) * scales)
            curvature = (axes * np.maximum(size, 0.0)) @ axes.T / scales
        return _Local(self.rows.rows(x), self.rows.slopes(x), curvature, unit)

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
