"""Autoregressive noise fitted to the residuals of a fit, without the bias that the fit itself gives them.

`fit_autoregression` fits A(q) e = white to residuals e by least squares and chooses the order by BIC (Ljung,
System Identification, 2nd ed., sections 10.1 and 16.4). Residuals of a fit are poorer in slow noise than the
noise was: offset, initial states and slow poles take it up. For residuals e = (I - P) v of a generalised
least squares fit that whitens v with A(q), E (A e)_t e_s for s < t is minus (A Z)_t . Z_s with
Z Z^T = K (K^T S^-1 K)^-1 K^T, S the covariance of v and K all columns of the fit (`absorbed_gradient`). The
normal equations are set to these values in place of zero, to first order.

Neglected: what the choice of the order from the same residuals does to the coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import toeplitz

from ident.basis.autoregressive_noise import WHITE_NOISE, AutoregressiveNoise
from ident.basis.noise_model import NoiseModel, reflected_inside
from ident.data.arrays import RealArray
from ident.uncertainty.embedding_algebra import triangle_of

# Largest relative change of A(q) on the unit circle by a correction: |1 + x|^2 >= 1/2, so that the spectrum
# is nowhere more than doubled. A correction that is larger is no small one, and first order does not hold.
_LARGEST_MOVE = 1.0 - 1.0 / np.sqrt(2.0)
# Frequencies at which that change is looked at, rad/sample: evenly, and on a scale of ratios below .01, where
# drift has its power. The angles of the roots of A(q) are added. Numbers and ends chosen: 1e-4 is a period of
# 60 000 samples, and steps of pi / 2047 miss no peak, as those of sharp peaks are added.
_FREQUENCIES = np.concatenate([np.geomspace(1e-4, 1e-2, 128), np.linspace(0.0, np.pi, 2048)])


def absorbed_gradient(absorbed: Sequence[RealArray], noise: NoiseModel, order: int, start: int) -> RealArray:
    """Expected sums over t >= start of -(A e)_t e_(t-i), i = 1 .. order, (order,), of residuals e of a fit.

    Parameters
    ----------
    absorbed : sequence of ndarray, shape (T, r)
        Of each record, the columns Z that the fit took off it, for innovations of unit variance. Where the
        fit left the first rows out, Z is what the noise model makes of its whitened rows from rest.
    noise : NoiseModel
        Its whitening filter is A(q), by which the fit weighted its rows.
    order : int
        Largest lag; at most `start`, not checked (numpy's ValueError of shapes for more).
    start : int
        First row that counts. Records of 2 start rows or fewer are left out: the rows that count should
        outnumber those that only begin them.

    Returns
    -------
    ndarray, shape (order,)
        In units of the noise's variance. Zeros where every record was left out.
    """
    sums = np.zeros(order)
    for z in absorbed:
        n_rows = z.shape[0]
        if n_rows <= 2 * start:
            continue
        innovations = noise.filtered(z)[start:]
        for lag in range(1, order + 1):
            earlier = z[start - lag : n_rows - lag]
            sums[lag - 1] += float(np.vdot(innovations, earlier))
    return sums


def fit_autoregression(
    residuals: Sequence[RealArray],
    max_order: int,
    weights: NoiseModel = WHITE_NOISE,
    absorbed: Sequence[RealArray] | None = None,
) -> AutoregressiveNoise:
    """Autoregressive noise model of residuals, its order chosen by BIC, from all records together.

    Parameters
    ----------
    residuals : sequence of ndarray, shape (T,)
        One per record, in units of the output. Records of 2 max_order rows or fewer are left out: half of
        their rows would only begin the regression.
    max_order : int
        Largest order that is tried; 0 gives white noise.
    weights : NoiseModel
        The one that whitened the fit behind the residuals. White, or without `absorbed`, the bias of the fit
        stays.
    absorbed : sequence of ndarray, shape (T, r), optional
        What that fit took off each record (`absorbed_gradient`).

    Returns
    -------
    AutoregressiveNoise
        Its roots lie inside the unit circle. Of residuals that are all zero: white noise.

    Raises
    ------
    ValueError
        If no record is long enough.
    numpy.linalg.LinAlgError
        If a residual is not finite.

    Notes
    -----
    Conditional least squares on the rows that have max_order predecessors; roots on or outside the unit
    circle are reflected inside. The sums of (A e)_t e_(t-i) are set to what the fit would have made of them
    for noise with the filter of `weights`, to first order in its change. A correction that moves the spectrum
    by more than a factor of two is shrunk, and leaves all roots inside (Rouche).
    """
    usable = [np.asarray(e, dtype=np.float64) for e in residuals if e.size > 2 * max_order]
    if not usable:
        raise ValueError(
            f"an AR model up to order {max_order} needs a record of more than {2 * max_order} samples"
        )
    # Row t holds e_(t-1) .. e_(t-max_order).
    lagged_rows = []
    targets = []
    for e in usable:
        lagged_rows.append(toeplitz(e[max_order - 1 :], e[max_order - 1 :: -1])[:-1])
        targets.append(e[max_order:])
    rows = np.vstack(lagged_rows)
    target = np.concatenate(targets)
    n = target.size

    # Of every order the coefficients and errors follow from one triangle: its first columns are those of
    # fewer lags.
    triangle = triangle_of(np.column_stack([rows, target]))
    of_target = triangle[:, -1]
    rounding = np.finfo(np.float64).eps * n

    # The order of least BIC, n log variance + order log n. Residuals of zero have a logarithm, too.
    smallest = np.finfo(np.float64).tiny
    best = np.ones(1)
    best_cost = n * np.log(max(float(target @ target) / n, smallest))
    variance = 0.0
    for order in range(1, max_order + 1):
        of_lags = triangle[:order, :order]
        coefficients, *_ = np.linalg.lstsq(of_lags, of_target[:order], rcond=rounding)
        error = of_target - triangle[:, :order] @ coefficients
        error_sum = float(error @ error)
        cost = n * np.log(max(error_sum / n, smallest)) + order * np.log(n)
        if cost < best_cost:
            best = np.concatenate([[1.0], -coefficients])
            best_cost = cost
            variance = error_sum / (n - order)
    stable = reflected_inside(best)
    order = best.size - 1
    if absorbed is None or order == 0 or weights.is_white:
        return AutoregressiveNoise(stable)

    # Step of the coefficients that sets the normal equations to what the fit has absorbed. (X^T X)^-1 through
    # the singular values of X, less those that are rounding: X^T X may be beyond the reach of double
    # precision.
    gradient = absorbed_gradient(absorbed, weights, order, max_order)
    _, singular, axes = np.linalg.svd(triangle[:order, :order])
    certain = singular > rounding * singular[0]
    certain_axes = axes[certain]
    scaled_axes = certain_axes.T / singular[certain] ** 2
    step = variance * scaled_axes @ (certain_axes @ gradient)

    # A(q) - s B(q), b_1 .. b_n = step, with the largest s <= 1 for which s |B / A| <= _LARGEST_MOVE where it
    # matters most: next to the roots, however sharp their peaks.
    frequencies = np.concatenate([_FREQUENCIES, np.angle(np.roots(stable))])
    delays = np.exp(-1j * frequencies)
    change = np.polyval(np.concatenate([step[::-1], [0.0]]), delays)
    relative_change = change / np.polyval(stable[::-1], delays)
    largest_change = float(np.abs(relative_change).max())
    share = min(1.0, _LARGEST_MOVE / max(largest_change, _LARGEST_MOVE))
    return AutoregressiveNoise(stable - share * np.concatenate([[0.0], step]))
