"""Autoregressive models of residuals: the whitening filter for coloured noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import toeplitz

from ident.arrays import RealArray


def fit_autoregression(residuals: Sequence[RealArray], max_order: int) -> RealArray:
    """[1, a_1, ..., a_n] of A(q) e = white, order n <= max_order by BIC, from all records together.

    Conditional least squares on the rows that have max_order predecessors, so that all orders are judged on
    the same rows; a model with a root on or outside the unit circle has its roots reflected inside. Raises
    ValueError when no record is longer than twice max_order.
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
    return _stable(best)


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
