"""One step of a nonlinear minimax: the smallest largest linear row plus a common curvature, within a box.

    minimise  s + d' H d / 2   over (d, s)
    with      f + F d <= s,  A d <= b,  low <= d <= high.

`minimax_step` solves it by a primal-dual interior point (Mehrotra's predictor and corrector, SIAM Journal
on Optimization 2, 1992) in n + 1 unknowns: the rows enter only through an (n + 1) x (n + 1) matrix. H = 0
makes it a linear programme. The iterations are compiled: for so few rows a call of numpy would cost more
than the arithmetic. A QP solver that begins anew each time costs more still; one that begins at the last
problem makes the result depend on it.

`adapted_box` says how large the next box is. Both descents, of one joint (`descent`) and of several
(`multivariable_descent`), use the box in natural units of the parameters, so its sizes stand here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from control_design.plants.ellipses import Real
from ident.data.arrays import COMPILED, INSIDE

# Half width of the first box, in natural units: a third of a substantial change of every parameter. Chosen;
# `adapted_box` corrects it within a few steps.
FIRST_BOX = 0.3
# Largest half width: beyond a natural unit no linear row says anything.
LARGEST_BOX = 1.0
# Half width below which a descent ends: it changes no worst case that is stated to four digits.
SMALLEST_BOX = 1e-4
# Share of its predicted gain that a step has to reach to be accepted; any small number proves convergence
# (Nocedal and Wright, Numerical Optimization, 2nd ed., algorithm 4.1).
ACCEPTED_SHARE = 0.02
# Shares of the predicted gain above which the box doubles, and below which it shrinks: those of the algorithm
# named above are 3/4 and 1/4.
_ENLARGED_ABOVE = 0.7

# Share of the predicted gain below which the box shrinks: that of the algorithm named above.
_SHRUNK_BELOW = 0.25

# Factor by which it grows, that of the algorithm named above.
_ENLARGEMENT = 2.0

# Factor by which it shrinks; the algorithm named above takes 1/4. Chosen.
_SHRINKAGE = 0.35

# Iterations of the interior point, at most; 8 to 15 are usual, so one that takes 40 will not come to its end.
_MOST_ITERATIONS = 40
# Complementarity and row residuals at the end, in the logarithm of the worst case: a tenth of the least gain
# that a descent takes a step for.
_ACCURACY = 1e-8
# Residual of the stationarity at the end, where multipliers add up to one; rounding leaves 1e-7.
_STATIONARY = 1e-5
# Complementarity with which an end counts although the iterations ran out or stopped at rounding: the level
# then is too high by at most this, a tenth of the fourth digit of a worst case.
_USABLE_GAP = 1e-5
# Excess over the box that is rounding, and clipped: a hundredth of the smallest box.
_ROUNDING = 1e-6
# Room of a bound that is met exactly: the interior point needs an interior. A thousandth of what is clipped
# as rounding, so no bound moves.
_LEAST_ROOM = 1e-9
# Height of the first s above the largest row, in logarithms, so that every row has slack: of the size of what
# a step gains. Chosen; the iterations move s anyway.
_FIRST_SLACK = 0.1


@dataclass(frozen=True, eq=False)
class MinimaxStep:
    """Solution of one programme.

    Attributes
    ----------
    step : ndarray, shape (n,)
        d, within the box.
    level : float
        Largest row f + F d of the linear model there, without the curvature.
    multipliers : ndarray, shape (R,)
        Of the rows f + F d <= s; they add up to one. Rows that are not active have about 0.
    """

    step: Real
    level: float
    multipliers: Real


def adapted_box(box: float, actual: float, predicted: float) -> float:
    """Half width of the box of the next step.

    Parameters
    ----------
    box : float
        Half width of the step before, in natural units.
    actual : float
        What that step gained; -inf: it left stability. nan leaves the box as it is.
    predicted : float
        What its model promised, in the same unit; positive, as a descent ends before a step that gains
        nothing (not checked).

    Returns
    -------
    float
        Doubled, to at most `LARGEST_BOX`, where the model was right; shrunk where it was wrong.
    """
    if actual > _ENLARGED_ABOVE * predicted:
        return min(_ENLARGEMENT * box, LARGEST_BOX)
    if actual < _SHRUNK_BELOW * predicted:
        return box * _SHRINKAGE
    return box


def minimax_step(
    value: Real, slope: Real, curvature: Real, low: Real, high: Real, a: Real, b: Real
) -> MinimaxStep | None:
    """Step with the smallest largest row plus curvature.

    Parameters
    ----------
    value : ndarray, shape (R,)
        Rows f at d = 0, logarithms of weighted worst cases (log gamma, or log gamma^2 of several joints);
        R >= 1, else numpy's ValueError of an empty maximum.
    slope : ndarray, shape (R, n)
        Their slopes F, in natural units of the n parameters.
    curvature : ndarray, shape (n, n)
        H, positive semi-definite (not checked).
    low, high : ndarray, shape (n,)
        Box in natural units; low <= 0 <= high, where a 0 gets the room `_LEAST_ROOM` (not checked).
    a : ndarray, shape (L, n)
        Side conditions a d <= b; L may be 0.
    b : ndarray, shape (L,)

    Returns
    -------
    MinimaxStep or None
        None where the interior point fails: no d of the box meets a d <= b, a value is nan, or rounding
        spoils the solution. `level` is that of d before it is clipped to the box by at most `_ROUNDING`.

    Raises
    ------
    ValueError
        Shapes that do not fit, from numpy.
    """
    n = slope.shape[1]
    rows = value.size
    constraints = rows + 2 * n + a.shape[0]

    # All inequalities as matrix v <= limit for v = (d, s): rows, upper and lower bounds, side conditions.
    of_rows = slice(0, rows)
    of_high = slice(rows, rows + n)
    of_low = slice(rows + n, rows + 2 * n)
    of_sides = slice(rows + 2 * n, constraints)
    matrix = np.zeros((constraints, n + 1))
    matrix[of_rows, :n] = slope
    matrix[of_rows, n] = -1.0
    matrix[of_high, :n] = np.eye(n)
    matrix[of_low, :n] = -np.eye(n)
    matrix[of_sides, :n] = a
    limit = np.empty(constraints)
    limit[of_rows] = -value
    limit[of_high] = np.maximum(high, _LEAST_ROOM)
    limit[of_low] = np.maximum(-low, _LEAST_ROOM)
    limit[of_sides] = b + _LEAST_ROOM
    hessian = np.zeros((n + 1, n + 1))
    hessian[:n, :n] = curvature

    first_level = float(np.max(value)) + _FIRST_SLACK
    v = np.append(np.zeros(n), first_level)
    try:
        z, gap = _interior_point(matrix, limit, hessian, v, rows)
    except np.linalg.LinAlgError:
        # Slacks so near their bounds that rounding takes the last of the diagonal.
        return None
    d = v[:n]
    solved = gap < _USABLE_GAP and np.all(np.isfinite(v))
    not_above = np.all(d <= high + _ROUNDING)
    not_below = np.all(d >= low - _ROUNDING)
    if not (solved and not_above and not_below):
        return None
    level = float(np.max(value + slope @ d))
    multipliers = z[:rows] / np.sum(z[:rows])
    return MinimaxStep(np.clip(d, low, high), level, multipliers)


@numba.njit(**COMPILED)
def _interior_point(matrix: Real, limit: Real, hessian: Real, v: Real, rows: int) -> tuple[Real, float]:
    """Multipliers (m,) of matrix v <= limit at the optimum, and the complementarity reached.

    matrix (m, n + 1), limit (m,), hessian (n + 1, n + 1); v (n + 1,) is where it begins, and is moved to the
    optimum in place. The first `rows` inequalities are those of the rows, whose multipliers add up to one.
    Neither the iterations running out nor rounding is an error here: the caller sees the complementarity.
    """
    # Slacks of at least 1e-3, far enough from 0 for a first step, and multipliers whose products with them
    # are alike, 0.1 each (the rows' own are scaled to the sum 1, which stationarity asks). Both chosen.
    slack = np.maximum(limit - matrix @ v, 1e-3)
    z = 0.1 / slack
    z[:rows] /= np.sum(z[:rows])
    for _ in range(_MOST_ITERATIONS):
        # Residuals of the optimality conditions; the last unknown, s, has slope 1 in the objective.
        dual = hessian @ v + z @ matrix
        dual[-1] += 1.0
        primal = matrix @ v + slack - limit
        missed = max(np.sum(slack * z), np.max(np.abs(primal)))
        if missed < _ACCURACY and np.max(np.abs(dual)) < _STATIONARY:
            break
        # Normal equations, with a trace of 1e-12, some thousand times rounding, on the diagonal where rows
        # leave a direction free: without it the solution would raise LinAlgError, as it still may at the end.
        ratio = z / slack
        centre = slack * z
        normal = hessian + (matrix.T * ratio) @ matrix
        for j in range(v.size):
            normal[j, j] += 1e-12 * (1.0 + normal[j, j])
        if not np.all(np.isfinite(normal)):
            # A slack has run to its bound: no step from here.
            break
        gap = np.mean(centre)
        # Predictor: Newton's direction towards complementarity 0. Corrector: towards a smaller gap than now
        # (the cube of what the predictor reached, after Mehrotra), with the predictor's second-order term.
        for corrector in range(2):
            pull = (z * primal - centre) / slack
            step = -np.linalg.solve(normal, dual + pull @ matrix)
            moved = primal + matrix @ step
            dz = ratio * moved - centre / slack
            # Longest steps of slacks and of multipliers, each by itself.
            first = _longest(slack, -moved)
            second = _longest(z, dz)
            if corrector == 0:
                after = np.mean((slack - first * moved) * (z + second * dz))
                centre = centre - moved * dz - gap * min(1.0, after / gap) ** 3
        # 0.995: not quite to the boundary, where the next step would have no room (usual: .99 to .9995).
        v += 0.995 * first * step
        slack -= 0.995 * first * moved
        z += 0.995 * second * dz
    return z, np.sum(slack * z)


@numba.njit(**INSIDE)
def _longest(value: Real, step: Real) -> float:
    """Longest length in [0, 1] for which value + length * step (m,) does not become negative.

    value (m,) > 0, which every iteration keeps (not checked); a nan in step is passed over.
    """
    length = 1.0
    for i in range(value.size):
        if length * step[i] < -value[i]:
            length = -value[i] / step[i]
    return length
