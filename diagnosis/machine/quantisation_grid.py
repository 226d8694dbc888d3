"""Outputs on a quantisation grid: the step is read off the values, and fits use the chance of each cell.

Rounding is no effect to be fitted: a model whose output is rounded differs from the record as much as one
whose output is not. But values on a quantisation grid are plain, and each of them only says in which cell
the unrounded one lay.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from ident.data.arrays import RealArray as Real

# Significant digits with which records are written at least; rounding in the file is not significant.
_DIGITS = 6
# A grid is believed when its step is so many times what the file resolves, half a unit of its last digit:
# one unit of the digit before. Finer grids are those of the file itself.
_COARSER = 20.0
# Values that differ by less than this many of the file's resolutions are the same value: each may be off by
# one, and an offset doubles that.
_SAME_VALUE = 4.0
# A value lies on the grid within this many of the file's resolutions: its own rounding and that of an offset.
_ON_GRID = 2.0
# Fewer distinct values than this are a grid only where each of them is read again and again: ten values at
# the multiples of one step are no chance. Chosen.
_MANY_VALUES = 10
# Readings of each distinct value on average, where there are few of these. Chosen.
_READINGS_OF_EACH = 20
# Least standard deviation of rounding, step / sqrt(12), over the noise: less widens it by half a per cent.
_NOTICEABLE = 0.1
# First reach of the fit of a step, in steps: one that is off by 1e-4 slips a cell only beyond 5000 of them.
_FIRST_REACH = 8.0
# Factor by which the reach grows: each fit is exact enough for the next.
_REACH_GROWS = 2.0
# Largest log of a ratio of probabilities that is taken as below one, so that log(1 - ratio) is a number.
_JUST_BELOW_ONE = -1e-300


def grid_step(signals: Sequence[Real], noise: float) -> float:
    """Common step of all values of these records of one sensor, in their unit; 0 where there is none.

    Parameters
    ----------
    signals : sequence of (T,)
        One for each record, finite.
    noise : float
        Standard deviation of the sensor's noise. A grid that hardly widens it is none.

    Raises
    ------
    ValueError
        The noise level is not above zero.

    Notes
    -----
    The grid passes through zero. Its step is the smallest gap between values, made more exact by least
    squares over their counts of steps n: step = sum(n y) / sum(n^2), from values near zero outwards.
    """
    if not noise > 0:
        raise ValueError(f"the noise level must be above zero; got {noise}")
    values = np.unique(np.concatenate(list(signals)))
    values = values[values != 0]
    if values.size == 0:
        return 0.0
    n_readings = sum(map(len, signals))
    if values.size < _MANY_VALUES and n_readings < _READINGS_OF_EACH * values.size:
        return 0.0

    # Half a unit of the last digit of the outermost value: a column with an offset resolves values near zero
    # no better.
    digits_before_point = np.floor(np.log10(np.max(np.abs(values)))) + 1
    resolution = 0.5 * 10.0 ** (digits_before_point - _DIGITS)
    gaps = np.diff(np.union1d(values, 0.0))
    gaps = gaps[gaps > _SAME_VALUE * resolution]
    if gaps.size == 0 or np.min(gaps) < _COARSER * resolution:
        # Values nearer than any believable step: only a grid finer than the file resolves could hold them.
        return 0.0

    step = float(np.min(gaps))
    reach = _FIRST_REACH
    while True:
        near = np.abs(values) <= reach * step
        if np.count_nonzero(near) >= 2:
            count = np.round(values[near] / step)
            if np.any(count != 0):
                step = float(count @ values[near] / (count @ count))
        if np.all(near):
            break
        reach *= _REACH_GROWS

    off_grid = np.abs(values - step * np.round(values / step))
    if np.any(off_grid > _ON_GRID * resolution) or step / np.sqrt(12) < _NOTICEABLE * noise:
        return 0.0
    return step


def cell_residual(measured: Real, model: Real, step: float, noise: float) -> Real:
    """Signed root of the deviance of rounded values, in the shape of `measured`.

    Parameters
    ----------
    measured, model : arrays of one shape
        Rounded readings, and the unrounded outputs of a model.
    step, noise : float
        Of the grid, and standard deviation of the noise before rounding; both above zero.

    Notes
    -----
    r^2 = -2 log(P(cell | model) / P(cell | model in its middle)), P(cell | y) = Phi((m + h - y)/sigma) -
    Phi((m - h - y)/sigma) with h half the step; for small steps r becomes (m - y)/sigma. A step or noise of
    zero gives values that are not finite.
    """
    deviation = (measured - model) / noise
    half = 0.5 * step / noise
    # Mirrored so that both ends of the cell lie left of the far tail, where Phi is small and exact.
    near_end = -np.abs(deviation) + half
    far_end = -np.abs(deviation) - half
    log_cell = _log_difference(far_end, near_end)
    log_best = float(_log_difference(np.array([-half]), np.array([half]))[0])
    deviance = np.maximum(2 * (log_best - log_cell), 0.0)
    return np.asarray(np.sign(deviation) * np.sqrt(deviance))


def _log_difference(a: Real, b: Real) -> Real:
    """log(Phi(b) - Phi(a)) for a < b, a below zero, without a difference of nearly equal numbers."""
    upper = scipy.special.log_ndtr(b)
    lower = scipy.special.log_ndtr(a)
    return np.asarray(upper + np.log1p(-np.exp(np.minimum(lower - upper, _JUST_BELOW_ONE))))
