"""Autoregressive models of residuals: the whitening filter for coloured noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy.linalg import cholesky, solve_toeplitz, solve_triangular, toeplitz
from scipy.signal import lfilter

from ident.arrays import RealArray


class LagSums(Protocol):
    """Part of the noise that a fit has taken up, see `ident.residual_noise.Absorbed`."""

    def lag_sums(self, max_lag: int) -> RealArray: ...


def fit_autoregression(
    residuals: Sequence[RealArray],
    max_order: int,
    weights: RealArray | None = None,
    absorbed: LagSums | None = None,
) -> RealArray:
    """[1, a_1, ..., a_n] of A(q) e = white, order n <= max_order by BIC, from all records together.

    Conditional least squares on the rows that have max_order predecessors, so that all orders are judged on
    the same rows; a model with a root on or outside the unit circle has its roots reflected inside. Raises
    ValueError when no record is longer than twice max_order.

    With the whitening filter `weights` that the fit behind the residuals used, and what it `absorbed`, the
    coefficients are moved by as much as that fit would have moved those of noise with this very filter: the
    bias is removed to first order, and when the filter no longer changes, exactly in the expected moments.
    """
    usable = [np.asarray(e, dtype=np.float64) for e in residuals if e.size > 2 * max_order]
    if not usable:
        raise ValueError(
            f"an AR model up to order {max_order} needs a record of more than {2 * max_order} samples"
        )
    rows = np.vstack([toeplitz(e[max_order - 1 :], e[max_order - 1 :: -1])[:-1] for e in usable])
    target = np.concatenate([e[max_order:] for e in usable])
    n = target.size
    floor = np.finfo(np.float64).tiny
    best, best_cost = np.ones(1), n * np.log(max(float(target @ target) / n, floor))
    for order in range(1, max_order + 1):
        coefficients, *_ = np.linalg.lstsq(rows[:, :order], target, rcond=None)
        error = target - rows[:, :order] @ coefficients
        cost = n * np.log(max(float(error @ error) / n, floor)) + order * np.log(n)
        if cost < best_cost:
            best, best_cost = np.concatenate([[1.0], -coefficients]), cost
    if weights is None or absorbed is None or best.size == 1 or weights.size == 1:
        return _stable(best)
    order = best.size - 1
    sizes = np.array([e.size for e in residuals], dtype=np.float64)
    counts = np.array([np.sum(np.maximum(sizes - k, 1.0)) for k in range(order + 1)])
    noise = autocovariance(weights, order)
    seen = noise - absorbed.lag_sums(order) / counts
    best[1:] += _from_moments(noise) - _from_moments(seen)
    return _stable(best)


def first_rows(whitening: RealArray) -> RealArray:
    """(n,n) lower triangle that whitens the first n samples of stationary noise with A(q) of order n.

    The inverse Cholesky factor of their covariance: with it on top of A(q) no sample is lost. Dropping the
    first rows instead would leave any transient that A(q) annuls free, such as that of a pole of the plant
    which the noise happens to share.
    """
    order = whitening.size - 1
    if order == 0:
        return np.zeros((0, 0))
    factor = cholesky(toeplitz(autocovariance(whitening, order - 1)), lower=True)
    return np.asarray(solve_triangular(factor, np.eye(order), lower=True), dtype=np.float64)


def whitened(signals: RealArray, whitening: RealArray) -> RealArray:
    """White unit-variance version of noise with A(q) v = e, along the first axis; (T,) or (T,n)."""
    order = whitening.size - 1
    if order == 0 or signals.size == 0:
        return signals
    out = np.asarray(lfilter(whitening, np.ones(1), signals, axis=0), dtype=np.float64)
    out[:order] = first_rows(whitening) @ signals[:order]
    return out


def autocovariance(whitening: RealArray, max_lag: int) -> RealArray:
    """gamma_k, k = 0 .. max_lag, of e with A(q) e white of unit variance; A stable.

    The Yule-Walker equations sum_i a_i gamma_|k - i| = (k == 0) for k = 0 .. n, then the recursion.
    """
    order = whitening.size - 1
    equations = np.zeros((order + 1, order + 1))
    for k in range(order + 1):
        for i in range(order + 1):
            equations[k, abs(k - i)] += whitening[i]
    gamma = np.linalg.solve(equations, np.eye(order + 1)[0]).tolist()
    for k in range(order + 1, max_lag + 1):
        gamma.append(-sum(float(whitening[i]) * gamma[k - i] for i in range(1, order + 1)))
    return np.array(gamma[: max_lag + 1], dtype=np.float64)


def _from_moments(covariance: RealArray) -> RealArray:
    """a_1 .. a_n of the AR model with these autocovariances 0 .. n."""
    return -np.asarray(solve_toeplitz(covariance[:-1], covariance[1:]), dtype=np.float64)


def _stable(whitening: RealArray) -> RealArray:
    """Roots reflected into the unit circle: the same spectrum, an invertible filter."""
    roots = np.asarray(np.roots(whitening), dtype=np.complex128)
    outside = np.abs(roots) >= 1
    if not np.any(outside):
        return whitening
    # On the circle itself reflection changes nothing; a root there is pulled in by a millionth.
    roots[outside] = np.minimum(1.0 / np.abs(roots[outside]), 1 - 1e-6) * np.exp(
        1j * np.angle(roots[outside])
    )
    return np.asarray(np.real(np.poly(roots)), dtype=np.float64)
