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

# Records are written with so many significant digits at least; rounding in the file is not significant.
_DIGITS = 6
# A grid is believed when its step is this much coarser than what the file resolves.
_COARSER = 20.0
# Few values are a grid only where each of them is read again and again.
_MANY, _READINGS = 10, 20
# And when it widens the noise: step / sqrt(12) against this share of it.
_NOTICEABLE = 0.1


def grid_step(signals: Sequence[Real], noise: float) -> float:
    """Common step of all values of these records of one sensor, 0 where there is none.

    Raises ValueError if the noise level is not above zero.
    """
    if not noise > 0:
        raise ValueError(f"the noise level must be above zero; got {noise}")
    values = np.unique(np.concatenate(list(signals)))
    values = values[values != 0]
    if values.size == 0 or (values.size < _MANY and sum(map(len, signals)) < _READINGS * values.size):
        return 0.0
    # Of the outermost value: a column with an offset resolves those near zero no better.
    coarse = 0.5 * 10.0 ** (np.floor(np.log10(np.max(np.abs(values)))) + 1 - _DIGITS)
    gaps = np.diff(np.union1d(values, 0.0))
    gaps = gaps[gaps > 4 * coarse]
    if gaps.size == 0 or np.min(gaps) < _COARSER * coarse:
        # Values nearer than any believable step: only a grid finer than the file resolves could hold them.
        return 0.0
    step = float(np.min(gaps))
    # Least squares over growing multiples: a step off by 1e-4 slips a cell only beyond 5000 of them.
    reach = 8.0
    while True:
        near = np.abs(values) <= reach * step
        if np.count_nonzero(near) >= 2:
            count = np.round(values[near] / step)
            if np.any(count != 0):
                step = float(count @ values[near] / (count @ count))
        if np.all(near):
            break
        reach *= 2
    off = np.abs(values - step * np.round(values / step))
    # The step carries an error of its own, which grows with the count.
    return 0.0 if np.any(off > 2 * coarse) or step / np.sqrt(12) < _NOTICEABLE * noise else step


def cell_residual(measured: Real, model: Real, step: float, noise: float) -> Real:
    """Signed root of the deviance of rounded values, the shape of `measured`.

    r^2 = -2 log(P(cell | model) / P(cell | model in its middle)), P(cell | y) = Phi((m + h - y)/sigma) -
    Phi((m - h - y)/sigma) with h half the step; for small steps r becomes (m - y)/sigma.
    """
    e = (measured - model) / noise
    half = 0.5 * step / noise
    # Mirrored so that both ends lie left of the far tail.
    a, b = -np.abs(e) - half, -np.abs(e) + half
    log_cell = _log_difference(a, b)
    log_best = float(_log_difference(np.array([-half]), np.array([half]))[0])
    return np.asarray(np.sign(e) * np.sqrt(np.maximum(2 * (log_best - log_cell), 0.0)))


def _log_difference(a: Real, b: Real) -> Real:
    """log(Phi(b) - Phi(a)) for a < b, a below zero."""
    upper, lower = scipy.special.log_ndtr(b), scipy.special.log_ndtr(a)
    return np.asarray(upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-300))))
