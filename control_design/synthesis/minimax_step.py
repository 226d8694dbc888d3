"""One step of a nonlinear minimax: the smallest largest linear row plus a common curvature, within a box.

    minimise  s + d' H d / 2   over (d, s)
    with      f + F d <= s,  A d <= b,  low <= d <= high.

A primal-dual interior point (Mehrotra's predictor and corrector) in n + 1 unknowns: the rows enter only
through an (n + 1) x (n + 1) matrix, so hundreds of rows cost microseconds. H = 0 makes it a linear programme.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs  # without the checks that cost more than the work

from control_design.plants.ellipses import Real

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
    n, rows = slope.shape[1], value.size
    eye = np.eye(n)
    side = np.zeros((a.shape[0] + 2 * n, 1))
    matrix = np.block([[slope, -np.ones((rows, 1))], [np.vstack([eye, -eye, a]), side]])
    limit = np.concatenate(
        [-value, np.maximum(high, _LEAST_ROOM), np.maximum(-low, _LEAST_ROOM), b + _LEAST_ROOM]
    )
    hessian = np.zeros((n + 1, n + 1))
    hessian[:n, :n] = curvature
    linear = np.append(np.zeros(n), 1.0)
    v = np.append(np.zeros(n), float(np.max(value)) + 0.1)
    slack = np.maximum(limit - matrix @ v, 1e-3)
    z = 0.1 / slack
    z[:rows] /= np.sum(z[:rows])
    count = limit.size
    for _ in range(_MOST):
        dual = hessian @ v + linear + z @ matrix
        primal = matrix @ v + slack - limit
        gap = float(slack @ z) / count
        if gap * count < _ACCURACY and np.abs(dual).max() < _STATIONARY and np.abs(primal).max() < _ACCURACY:
            break
        with np.errstate(over="ignore"):
            ratio = z / slack
        if not np.all(np.isfinite(ratio)):
            break  # a slack has run to its bound: no step from here
        normal = hessian + (matrix * ratio[:, None]).T @ matrix
        normal.flat[:: n + 2] += 1e-12 * (1.0 + np.diag(normal))
        factor, failed = dpotrf(normal)
        if failed:
            break
        centre = slack * z
        change = _direction(factor, matrix, dual, primal, centre, slack, z, ratio)
        length = _longest(slack, change[1]), _longest(z, change[2])
        after = float((slack + length[0] * change[1]) @ (z + length[1] * change[2])) / count
        aim = gap * min(1.0, after / gap) ** 3
        centre = centre + change[1] * change[2] - aim
        change = _direction(factor, matrix, dual, primal, centre, slack, z, ratio)
        first, second = 0.995 * _longest(slack, change[1]), 0.995 * _longest(z, change[2])
        v = v + first * change[0]
        slack = slack + first * change[1]
        z = z + second * change[2]
    d = v[:n]
    done = float(slack @ z) < 1e-5 and np.all(np.isfinite(v))
    if not (done and np.all(d <= high + 1e-6) and np.all(d >= low - 1e-6)):
        return None
    return MinimaxStep(np.clip(d, low, high), float(np.max(value + slope @ d)), z[:rows] / np.sum(z[:rows]))


def _direction(
    factor: Real, matrix: Real, dual: Real, primal: Real, centre: Real, slack: Real, z: Real, ratio: Real
) -> tuple[Real, Real, Real]:
    """Newton direction (dv, dslack, dz) of the perturbed optimality conditions."""
    right = -dual - ((z * primal - centre) / slack) @ matrix
    dv = dpotrs(factor, right)[0]
    moved = matrix @ dv
    return dv, -primal - moved, ratio * (moved + primal) - centre / slack


def _longest(value: Real, change: Real) -> float:
    """Largest step in [0, 1] that keeps value + step change >= 0."""
    steepest = float((change / value).min())
    return 1.0 if steepest >= -1.0 else -1.0 / steepest
