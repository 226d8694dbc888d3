"""Autoregressive models of residuals: the whitening filter for coloured noise.

Residuals of a fit are poorer in slow noise than the noise was: offset, initial states and slow poles take it
up. For residuals e = (I - P) v of a generalised least squares fit that whitens v with A(q), E (A e)_t e_s for
s < t is minus (A Z)_t . Z_s with Z Z^T = K (K^T S^-1 K)^-1 K^T, S the covariance of v and K all columns of
the fit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import toeplitz

from ident.basis.autoregressive_noise import WHITE_NOISE, AutoregressiveNoise
from ident.basis.noise_model import NoiseModel, reflected_inside
from ident.data.arrays import RealArray

# Largest relative change of A(q) by a correction: |1 + x|^2 >= 1/2, the spectrum is nowhere doubled.
_LARGEST_MOVE = 1.0 - 1.0 / np.sqrt(2.0)
_FREQUENCIES = np.concatenate([np.geomspace(1e-4, 1e-2, 128), np.linspace(0.0, np.pi, 2048)])


def absorbed_gradient(absorbed: Sequence[RealArray], noise: NoiseModel, order: int, start: int) -> RealArray:
    """-E sum over t >= start of (A e)_t e_(t-i), i = 1 .. order, over records longer than 2 start, whose fit
    has `absorbed` the columns Z (T,r) for innovations of unit variance. Where it leaves the first rows out, Z
    is what the noise filter makes of its whitened rows from rest."""
    sums = np.zeros(order)
    for z in absorbed:
        if z.shape[0] <= 2 * start:
            continue
        innovations = noise.filtered(z)[start:]
        for i in range(1, order + 1):
            sums[i - 1] += float(np.sum(innovations * z[start - i : z.shape[0] - i]))
    return sums


def fit_autoregression(
    residuals: Sequence[RealArray],
    max_order: int,
    weights: NoiseModel = WHITE_NOISE,
    absorbed: Sequence[RealArray] | None = None,
) -> AutoregressiveNoise:
    """A(q) e = white, order n <= max_order by BIC, from all records together.

    Conditional least squares on the rows that have max_order predecessors; roots on or outside the unit
    circle are reflected inside. With the noise model `weights` of the fit behind the residuals, and what
    it `absorbed`, the sums of (A e)_t e_(t-i) are set to what the fit would have made of them for noise with
    that filter, to first order in its change. A correction that moves the spectrum by more than a factor of
    two is shrunk, and leaves all roots inside (Rouche). Raises ValueError when no record is longer than twice
    max_order.
    """
    long_enough = [i for i, e in enumerate(residuals) if e.size > 2 * max_order]
    usable = [np.asarray(residuals[i], dtype=np.float64) for i in long_enough]
    if not usable:
        raise ValueError(
            f"an AR model up to order {max_order} needs a record of more than {2 * max_order} samples"
        )
    rows = np.vstack([toeplitz(e[max_order - 1 :], e[max_order - 1 :: -1])[:-1] for e in usable])
    target = np.concatenate([e[max_order:] for e in usable])
    n = target.size
    floor = np.finfo(np.float64).tiny
    best, best_cost, variance = np.ones(1), n * np.log(max(float(target @ target) / n, floor)), 0.0
    for order in range(1, max_order + 1):
        coefficients, *_ = np.linalg.lstsq(rows[:, :order], target, rcond=None)
        error = target - rows[:, :order] @ coefficients
        cost = n * np.log(max(float(error @ error) / n, floor)) + order * np.log(n)
        if cost < best_cost:
            best, best_cost = np.concatenate([[1.0], -coefficients]), cost
            variance = float(error @ error) / (n - order)
    if absorbed is None or best.size == 1 or weights.is_white:
        return AutoregressiveNoise(reflected_inside(best))
    order = best.size - 1
    gradient = absorbed_gradient(absorbed, weights, order, max_order)
    # (X^T X)^-1 through the singular values of X: its square may be beyond the reach of double precision.
    _, d, vt = np.linalg.svd(rows[:, :order], full_matrices=False)
    kept = d > np.finfo(np.float64).eps * n * d[0]
    step = variance * (vt[kept].T / d[kept] ** 2) @ (vt[kept] @ gradient)
    # A(q) - s B(q), b_1 .. b_n = step, with the largest s <= 1 for which s |B / A| <= _LARGEST_MOVE where it
    # matters most: next to the roots, however sharp their peaks.
    stable = reflected_inside(best)
    delays = np.exp(-1j * np.concatenate([_FREQUENCIES, np.angle(np.roots(stable))]))
    moved = np.polyval(np.concatenate([step[::-1], [0.0]]), delays) / np.polyval(stable[::-1], delays)
    share = min(1.0, _LARGEST_MOVE / max(float(np.abs(moved).max()), _LARGEST_MOVE))
    return AutoregressiveNoise(stable - share * np.concatenate([[0.0], step]))
