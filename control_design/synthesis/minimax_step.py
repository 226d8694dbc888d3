"""One step of a nonlinear minimax: the smallest largest linear row plus a common curvature, within a box.

    minimise  s + d' H d / 2   over (d, s)
    with      f + F d <= s,  A d <= b,  low <= d <= high.

A primal-dual interior point (Mehrotra's predictor and corrector) in n + 1 unknowns: the rows enter only
through an (n + 1) x (n + 1) matrix, so hundreds of rows cost microseconds; compiled, since for so few
numpy's calls would cost more than the arithmetic. H = 0 makes it a linear programme.
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
    """From v (n + 1,) in place to the optimum: multipliers (rows of the matrix,) and complementarity.

    Written out where numpy is short: of an array expression or a product numba compiles for a second.
    """
    count, n = matrix.shape
    slack, z, ratio, centre = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    dslack, dz, primal, moved = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    normal, dual, right = np.empty((n, n)), np.empty(n), np.empty(n)
    _along(matrix, v, primal)
    share = 0.0
    for i in range(count):
        slack[i] = max(limit[i] - primal[i], 1e-3)
        z[i] = 0.1 / slack[i]
        share += z[i] if i < rows else 0.0
    for i in range(rows):
        z[i] /= share
    for _ in range(_MOST):
        _along(hessian, v, dual)
        dual[n - 1] += 1.0
        _add_rows(matrix, z, dual)
        _along(matrix, v, primal)
        total, missed = 0.0, 0.0
        for i in range(count):
            primal[i] += slack[i] - limit[i]
            total += slack[i] * z[i]
            missed = max(missed, abs(primal[i]))
        steepest = 0.0
        for j in range(n):
            steepest = max(steepest, abs(dual[j]))
        if total < _ACCURACY and steepest < _STATIONARY and missed < _ACCURACY:
            break
        for j in range(n):
            for k in range(n):
                normal[j, k] = hessian[j, k]
        finite = True
        for i in range(count):
            ratio[i] = z[i] / slack[i]
            finite &= np.isfinite(ratio[i])
            for j in range(n):
                factor = ratio[i] * matrix[i, j]
                for k in range(j + 1):
                    normal[j, k] += factor * matrix[i, k]
        if not finite:
            break  # a slack has run to its bound: no step from here
        for j in range(n):
            normal[j, j] += 1e-12 * (1.0 + normal[j, j])
        if not _factored(normal):
            break
        gap = total / count
        for i in range(count):
            centre[i] = slack[i] * z[i]
        first, second = 0.0, 0.0
        for corrector in range(2):
            # Newton's direction of the perturbed optimality conditions.
            for i in range(count):
                dz[i] = (z[i] * primal[i] - centre[i]) / slack[i]
            for j in range(n):
                right[j] = 0.0
            _add_rows(matrix, dz, right)
            for j in range(n):
                right[j] = -dual[j] - right[j]
            _substituted(normal, right)
            _along(matrix, right, moved)
            first, second = 1.0, 1.0
            for i in range(count):
                dslack[i] = -primal[i] - moved[i]
                dz[i] = ratio[i] * (moved[i] + primal[i]) - centre[i] / slack[i]
                # The longest step in [0, 1] that keeps both positive.
                if first * dslack[i] < -slack[i]:
                    first = -slack[i] / dslack[i]
                if second * dz[i] < -z[i]:
                    second = -z[i] / dz[i]
            if corrector == 0:
                after = 0.0
                for i in range(count):
                    after += (slack[i] + first * dslack[i]) * (z[i] + second * dz[i])
                aim = gap * min(1.0, after / count / gap) ** 3
                for i in range(count):
                    centre[i] += dslack[i] * dz[i] - aim
        for j in range(n):
            v[j] += 0.995 * first * right[j]
        for i in range(count):
            slack[i] += 0.995 * first * dslack[i]
            z[i] += 0.995 * second * dz[i]
    total = 0.0
    for i in range(count):
        total += slack[i] * z[i]
    return z, total


@numba.njit(**INSIDE)
def _along(matrix: Real, v: Real, product: Real) -> None:
    for i in range(matrix.shape[0]):
        total = 0.0
        for j in range(v.size):
            total += matrix[i, j] * v[j]
        product[i] = total


@numba.njit(**INSIDE)
def _add_rows(matrix: Real, weight: Real, total: Real) -> None:
    for i in range(weight.size):
        for j in range(total.size):
            total[j] += weight[i] * matrix[i, j]


@numba.njit(**INSIDE)
def _factored(matrix: Real) -> bool:
    """Cholesky's factor in place of the lower triangle; false where the matrix has none."""
    for j in range(matrix.shape[0]):
        for i in range(j, matrix.shape[0]):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = value / matrix[j, j]
            elif value > 0:
                matrix[j, j] = np.sqrt(value)
            else:
                return False
    return True


@numba.njit(**INSIDE)
def _substituted(factor: Real, right: Real) -> None:
    """Solution in place of the right side (n,), from the factor of `_factored`."""
    n = right.size
    for i in range(n):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]
