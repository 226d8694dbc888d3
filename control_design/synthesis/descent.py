"""Descent on the worst case itself: from any stable controller to a local minimum, stable at every step.

The worst case gamma(x) of parameters x is a maximum of smooth functions, one per frequency and requirement.
Each step models their logarithms at the worst member of the ellipse (`rows`): slopes, and one common
curvature, that of the sum weighted by the multipliers of the step before. It solves "smallest largest row
within a box" (`minimax_step`) and accepts the answer only where the true value falls and all nominal loops
stay stable. With curvature, convergence near the end is that of Newton's method also where fewer rows are
active than there are parameters (sequential quadratic programming of a minimax; trust region as in Nocedal
and Wright, Numerical Optimization, 2nd ed., chapters 4 and 18).

Steps are measured in natural units of the parameters (`natural_units`), in which the box is a cube.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from control_design.controllers.biquads import Cascade, SectionKind
from control_design.controllers.parts import Part
from control_design.plants.ellipses import Real
from control_design.synthesis.minimax_step import (
    ACCEPTED_SHARE,
    FIRST_BOX,
    SMALLEST_BOX,
    MinimaxStep,
    adapted_box,
    minimax_step,
)
from control_design.synthesis.rows import LoopRows, Rows

# A descent ends where so many steps .. (chosen: a box that has shrunk needs some ten to grow back)
_PATIENCE = 15
# .. gain less than this in the logarithm of the worst case: a tenth of a per cent.
_SLOW = 1e-3
# Predicted gain of a step, in the logarithm, that is not worth taking: a hundredth of the digits that count.
_LEAST_GAIN = 1e-7
# Rows this far below the worst, in the logarithm (a twelfth of it), are left out of a step: they cannot
# become it within one. Chosen.
_FAR_BELOW = 2.5
# A step that gains less than this share of what it promised is corrected to second order: the share below
# which the box shrinks.
_CORRECTED_BELOW = 0.25
# Least logarithms of a section's denominator, in units of the scale: e^a is a
# corner or a damping term, e^b a corner squared. Their negatives are the largest. So corners stay within
# e^12 or e^10 of the scale, four to five decades, and exp() never overflows in a wild step.
_LEAST_LOG = -12.0

# Least logarithm of a corner squared: e^-20 is a corner of e^-10.
_LEAST_LOG_OF_SQUARE = -20.0
# Least gain of a section in its natural units: one whose numerator vanishes can still move. No gain that is
# used comes near.
_LEAST_GAIN_OF_SECTION = 1e-9


class MinimaxDescent:
    """Descents of one cascade on one set of rows.

    Parameters
    ----------
    cascade : Cascade
        Sections of the controller, of n parameters.
    plants : sequence of Rows
        Ellipses and weights of every plant on its grid; at least one weight above 0 (`LoopRows`).
    stable : callable
        Whether all nominal loops are stable under parameters (n,).
    controller_damping : float, optional
        Least damping ratio of the controller's own pairs of poles, positive; None: none asked.
    """

    def __init__(
        self,
        cascade: Cascade,
        plants: Sequence[Rows],
        stable: Callable[[Real], bool],
        *,
        controller_damping: float | None = None,
    ) -> None:
        """Build the rows, the bounds of all parameters, and the side conditions on damping, of which there
        are none without pairs of poles or a damping asked."""
        self.cascade = cascade
        self.stable = stable
        self.rows = LoopRows(cascade, plants)

        # Numerators are free, logarithms are bounded.
        free = -np.inf
        least: dict[SectionKind, list[float]] = {
            "integrator": [free, free],
            "first_order": [free, free, _LEAST_LOG],
            "second_order": [free, free, free, _LEAST_LOG, _LEAST_LOG_OF_SQUARE],
        }
        low: list[float] = []
        high: list[float] = []
        for section in cascade.sections:
            if isinstance(section, Part):
                low += [least_value for least_value, _ in section.bounds()]
                high += [largest_value for _, largest_value in section.bounds()]
            else:
                low += least[section]
                high += [-value for value in least[section]]
        self._low = np.array(low)
        self._high = np.array(high)

        # log zeta >= log zeta_0 is -row x <= -log(factor zeta_0), linear in the parameters.
        rows, factors = cascade.damping_rows()
        if controller_damping is None:
            rows = rows[:0]
            factors = factors[:0]
        self._damping_rows = -rows
        self._damping_limit = np.zeros(0)
        if controller_damping is not None:
            self._damping_limit = -np.log(factors * controller_damping)

    def value(self, parameters: Real) -> float:
        """Worst case on the grid of the rows.

        Parameters
        ----------
        parameters : ndarray, shape (n,)

        Returns
        -------
        float
            Over boundary points of the ellipses; inf for an unstable nominal loop or an ellipse over -1.
            `Cascade` raises ValueError for another number of parameters.
        """
        logs = self._logs(parameters)
        return float("inf") if logs is None else float(np.exp(np.max(logs)))

    def run(self, start: Real, steps: int) -> tuple[Real, float, int]:
        """Descend from a start with stable nominal loops.

        Parameters
        ----------
        start : ndarray, shape (n,)
            Clipped to the bounds of the parameters first.
        steps : int
            At most; steps that are not accepted count.

        Returns
        -------
        x : ndarray, shape (n,)
            Parameters where it ended.
        gamma : float
            Worst case there, as `value`; inf: the start is unstable, and x is the clipped start.
        taken : int
            Steps taken.
        """
        x = np.clip(np.asarray(start, dtype=np.float64), self._low, self._high)
        logs = self._logs(x)
        if logs is None:
            return x, float("inf"), 0
        best = float(np.max(logs))
        best_before = best
        box = FIRST_BOX
        taken = 0
        local: _Local | None = None
        multipliers: Real | None = None
        for number in range(steps):
            if number % _PATIENCE == 0 and number > 0:
                if best > best_before - _SLOW:
                    break
                best_before = best
            # The model of a point serves all steps from it, in smaller and smaller boxes.
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
            trial = x + move
            after = self._logs(trial)
            if after is not None and best - float(np.max(after)) < _CORRECTED_BELOW * predicted:
                # The rows bend more than their common curvature says: once more, with the rows as they are
                # at the trial point (second-order correction).
                second_step = self._step(x, local, after - local.slope @ move, box)
                if second_step is not None:
                    second_trial = x + second_step.step * local.unit
                    second_after = self._logs(second_trial)
                    if second_after is not None and np.max(second_after) < np.max(after):
                        step = second_step
                        trial = second_trial
                        after = second_after
            actual = -np.inf if after is None else best - float(np.max(after))
            if after is not None and actual > ACCEPTED_SHARE * predicted:
                x = trial
                best = float(np.max(after))
                local = None
                multipliers = step.multipliers
            box = adapted_box(box, actual, predicted)
            if box < SMALLEST_BOX:
                break
        return x, float(np.exp(best)), taken

    def _logs(self, x: Real) -> Real | None:
        """Logarithms (R,) of all weighted values at x (n,); None: an unstable loop or an ellipse over -1."""
        inside = self.stable(x) and not self.rows.covers_minus_one(x)
        return self.rows.rows(x) if inside else None

    def _local(self, x: Real, multipliers: Real | None) -> _Local:
        """Model of the rows at x (n,): values, slopes, and their curvature weighted by multipliers (R,).

        The curvature is made positive semi-definite in natural units, so that the programme of a step is
        convex; without multipliers, in the first step, it is zero. Raises LinAlgError where slopes are not
        finite, which a stable loop with bounded parameters does not show.
        """
        curvature = np.zeros((x.size, x.size))
        unit = natural_units(self.cascade, x)
        if multipliers is not None:
            scales = np.outer(unit, unit)
            size, axes = np.linalg.eigh(self.rows.curvature(x, multipliers) * scales)
            curvature = (axes * np.maximum(size, 0.0)) @ axes.T / scales
        return _Local(self.rows.rows(x), self.rows.slopes(x), curvature, unit)

    def _step(self, x: Real, local: _Local, log: Real, box: float) -> MinimaxStep | None:
        """Step d (n,) in natural units with the smallest largest row, |d| <= box; None where that fails.

        log (R,): values of the rows, which a second-order correction changes. Bounds of the parameters and
        the damping asked are kept. The multipliers returned are those of all rows (R,), 0 of those left out.
        It fails where `minimax_step` does: mostly by rounding, or by a damping that x misses beyond the box.
        """
        unit = local.unit
        near = log > np.max(log) - _FAR_BELOW
        slope = local.slope[near] * unit
        curvature = local.curvature * np.outer(unit, unit)
        low = np.maximum(-box, (self._low - x) / unit)
        high = np.minimum(box, (self._high - x) / unit)
        damping_rows = self._damping_rows * unit
        damping_room = self._damping_limit - self._damping_rows @ x
        step = minimax_step(log[near], slope, curvature, low, high, damping_rows, damping_room)
        if step is None:
            return None
        multipliers = np.zeros(log.size)
        multipliers[near] = step.multipliers
        return replace(step, multipliers=multipliers)


class _Local(NamedTuple):
    """Model at a point: log (R,) of the weighted values, slope (R, n) and curvature (n, n) in the parameters
    themselves, natural unit of each parameter (n,)."""

    log: Real
    slope: Real
    curvature: Real
    unit: Real


def natural_units(cascade: Cascade, x: Real) -> Real:
    """A substantial change of each parameter of a cascade.

    Parameters
    ----------
    cascade : Cascade
    x : ndarray, shape (n,)
        Where the change starts from.

    Returns
    -------
    ndarray, shape (n,)
        Of logarithms: 1. Of numerators: the section's gain times its corner to the power that the
        coefficient's p lacks, so that each changes the section by about its gain at its corner. All positive.

    Raises
    ------
    ValueError
        Another number of parameters, from `Cascade.split`.
    """
    units: list[float] = []
    for (kind, start), (numerator, denominator) in zip(cascade.starts(), cascade.split(x), strict=True):
        if isinstance(kind, Part):
            units += kind.units(np.asarray(x)[start : start + kind.parameters])
            continue
        degree = numerator.size - 1
        # An integrator has no corner of its own: the scale.
        corner = 1.0 if kind == "integrator" else float(denominator[-1] ** (1.0 / degree))
        powers = corner ** np.arange(degree + 1)
        gain = max(float(np.max(np.abs(numerator) / powers)), _LEAST_GAIN_OF_SECTION)
        units += (gain * powers).tolist()
        if kind != "integrator":
            units += [1.0] * degree
    return np.array(units)
