"""One step of a nonlinear minimax: the smallest largest linear row plus a common curvature, within a box.

    minimise  s + d' H d / 2   over (d, s)
    with      f + F d <= s,  A d <= b,  low <= d <= high.

A primal-dual interior point (Mehrotra's predictor and corrector) in n + 1 unknowns: the rows enter only
through an (n + 1) x (n + 1) matrix. H = 0 makes it a linear programme. Compiled: for so few rows a call of
numpy would cost more than the arithmetic. A QP solver that begins anew each time costs more still; one that
begins at the last problem makes the result depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from control_design.plants.ellipses import Real
from ident.data.arrays import COMPILED, INSIDE

_MOST = 40  # iterations; 8 to 15 are usual
_ACCURACY = 1e-8  # complementarity and row residuals, in the logarithm of the worst case
_STATIONARY = 1e-5  # residual of the stationarity, of a step of natural size; rounding leaves 1e-7
_LEAST_ROOM = 1e-9  # a bound met exactly still leaves the interior point an interior


@dataclass(frozen=True, eq=False)
class MinimaxStep:
    """d (n,), the smallest largest row s of the linear model there, multipliers (R,) of f + F d <= s."""

    step: Real
    level: float
    multipliers: Real


def minimax_step(
    value: Real, slope: Real, curvature: Real, low: Real, high: Real, a: Real, b: Real
) -> MinimaxStep | None:
    """Solve it for value (R,), slope (R, n), curvature (n, n) positive semi-definite, low < 0 < high (n,), a
    (L, n), b (L,); None where the interior point fails (no d with a d <= b in the box, or rounding)."""
    n, rows, bounds = slope.shape[1], value.size, 2 * slope.shape[1]
    matrix, limit = np.zeros((rows + bounds + a.shape[0], n + 1)), np.empty(rows + bounds + a.shape[0])
    matrix[:rows, :n], matrix[:rows, n] = slope, -1.0
    matrix[rows : rows + n, :n], matrix[rows + n : rows + bounds, :n] = np.eye(n), -np.eye(n)
    matrix[rows + bounds :, :n] = a
    limit[:rows], limit[rows + bounds :] = -value, b + _LEAST_ROOM
    limit[rows : rows + n], limit[rows + n : rows + bounds] = (
        np.maximum(high, _LEAST_ROOM),
        np.maximum(-low, _LEAST_ROOM),
    )
    hessian = np.zeros((n + 1, n + 1))
    hessian[:n, :n] = curvature
    v = np.append(np.zeros(n), float(np.max(value)) + 0.1)
    z, gap = _interior_point(matrix, limit, hessian, v, rows)
    d = v[:n]
    done = gap < 1e-5 and np.all(np.isfinite(v))
    if not (done and np.all(d <= high + 1e-6) and np.all(d >= low - 1e-6)):
        return None
    return MinimaxStep(np.clip(d, low, high), float(np.max(value + slope @ d)), z[:rows] / np.sum(z[:rows]))


@numba.njit(**COMPILED)
def _interior_point(matrix: Real, limit: Real, hessian: Real, v: Real, rows: int) -> tuple[Real, float]:
    """From v (n + 1,) in place to the optimum: multipliers (rows of the matrix,) and complementarity."""
    slack = np.maximum(limit - matrix @ v, 1e-3)
    z = 0.1 / slack
    z[:rows] /= np.sum(z[:rows])
    for _ in range(_MOST):
        dual = hessian @ v + z @ matrix
        dual[-1] += 1.0
        primal = matrix @ v + slack - limit
        missed = max(np.sum(slack * z), np.max(np.abs(primal)))
        if missed < _ACCURACY and np.max(np.abs(dual)) < _STATIONARY:
            break
        ratio, centre = z / slack, slack * z
        normal = hessian + (matrix.T * ratio) @ matrix
        for j in range(v.size):
            normal[j, j] += 1e-12 * (1.0 + normal[j, j])
        if not np.all(np.isfinite(normal)):
            break  # a slack has run to its bound: no step from here
        gap = np.mean(centre)
        for corrector in range(2):
            # Newton's direction of the perturbed optimality conditions.
            pull = (z * primal - centre) / slack
            step = -np.linalg.solve(normal, dual + pull @ matrix)
            moved = primal + matrix @ step
            dz = ratio * moved - centre / slack
            first, second = _longest(slack, -moved), _longest(z, dz)
            if corrector == 0:
                after = np.mean((slack - first * moved) * (z + second * dz))
                centre = centre - moved * dz - gap * min(1.0, after / gap) ** 3
        v += 0.995 * first * step
        slack -= 0.995 * first * moved
        z += 0.995 * second * dz
    return z, np.sum(slack * z)


@numba.njit(**INSIDE)
def _longest(value: Real, step: Real) -> float:
    """The longest step in [0, 1] that keeps all values positive."""
    length = 1.0
    for i in range(value.size):
        if length * step[i] < -value[i]:
            length = -value[i] / step[i]
    return length
