"""The descent of `ident.fit.refinement`, compiled: Levenberg-Marquardt steps on a linearisation from inner
products.

The linearisation is that of `ident.fit.kernels.linearise` by another road. With the columns Phi (basis driven
by the input) as rows, G = Phi Phi^T and e = y - Phi^T G^-1 Phi y, all that is needed of the projection P off
the columns are products: r^T r = e^T e - (Phi e)^T G^-1 (Phi e), and for the states S of the blocks driven by
Phi^T theta

    S P S^T = S S^T - (S Phi^T) G^-1 (Phi S^T),   S r = S e - (S Phi^T) G^-1 (Phi e).

The terms in Phi e, zero but for rounding, are a step of iterative refinement: with the condition of G bounded
(`_LEAST_PIVOT`) they bring J and its gradient to the precision of an orthogonal factorisation. Where the
columns are nearer to dependence, and where free responses are among them, the orthogonal factorisation itself
is used.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from ident.basis.functions import _blocks, run_cascade_free
from ident.fit.kernels import _dot, _schur_drop, _subtract, linearise
from ident.fit.lane_signals import cascade_states, combine, pitch_of, products, row_products, single_states

# Least square of a column's part outside the columns before it, relative to its own: the error of G^-1 is
# about 1e-16 over this, before refinement.
_LEAST_PIVOT = 1e-8
# Order of the numbers in an array of bounds (see `ident.fit.refinement.Bounds`).
_DISTANCE_MIN, _DISTANCE_MAX, _OMEGA_MIN, _OMEGA_MAX, _ZETA_MIN, _ZETA_MAX, _S_MIN = range(7)
# Steps that do not gain multiply the damping by this, by its square next, and so on.
GROWTH = 4.0
_CLOSE = 1e-7  # poles pass through exp and log on their way to a bound


@numba.njit(cache=True)
def clip_parameters(x: Any, n_free_real: int, bounds: Any) -> Any:
    """The unknowns (1 - a; s, f) inside the bounds; frequency and damping are clipped, then s and f
    formed."""
    inside = np.empty_like(x)
    for i in range(n_free_real):
        inside[i] = min(max(x[i], bounds[_DISTANCE_MIN]), bounds[_DISTANCE_MAX])
    for i in range(n_free_real, x.size, 2):
        s, f = max(x[i], bounds[_S_MIN]), max(x[i + 1], 1e-12)
        omega = np.hypot(s, f)
        zeta = min(max(s / omega, bounds[_ZETA_MIN]), bounds[_ZETA_MAX])
        omega = min(max(omega, bounds[_OMEGA_MIN]), bounds[_OMEGA_MAX])
        inside[i] = max(zeta * omega, bounds[_S_MIN])
        inside[i + 1] = min(omega * np.sqrt(1 - zeta * zeta), 0.995 * np.pi)
    return inside


@numba.njit(cache=True)
def blocked(x: Any, gradient: Any, n_free_real: int, bounds: Any) -> Any:
    """Unknowns on a bound that would be driven out of it (a step goes along +gradient = S^T r)."""
    held = np.zeros(x.size, dtype=np.bool_)
    low, high = 1 + _CLOSE, 1 - _CLOSE
    for i in range(n_free_real):
        if gradient[i] < 0:
            held[i] = x[i] <= bounds[_DISTANCE_MIN] * low
        else:
            held[i] = x[i] >= bounds[_DISTANCE_MAX] * high
    for i in range(n_free_real, x.size, 2):
        omega = np.hypot(x[i], x[i + 1])
        zeta = x[i] / omega
        if gradient[i] < 0:
            held[i] = x[i] <= bounds[_S_MIN] * low or zeta <= bounds[_ZETA_MIN] * low
        elif gradient[i] > 0:
            held[i] = zeta >= bounds[_ZETA_MAX] * high
        if gradient[i + 1] < 0:
            held[i + 1] = omega <= bounds[_OMEGA_MIN] * low
        elif gradient[i + 1] > 0:
            held[i + 1] = omega >= bounds[_OMEGA_MAX] * high
    return held


@numba.njit(cache=True)
def chain_rule(real: Any, pairs: Any, n_fixed_real: int, n_fixed_pairs: int) -> Any:
    """(B, P): sensitivity to each free unknown as a combination of the block states driven by the fitted
    output.

    States of a real block: b/(z - a) y_hat; of a pair: sg (z - beta)/D y_hat and sg sb/D y_hat, with
    D = z^2 - t z + g, t = 2 exp(-s) cos f, g = exp(-2 s).
    """
    blocks = _blocks(real, pairs)
    n_real, n_free_real = real.size, real.size - n_fixed_real
    chain = np.zeros((n_real + 2 * pairs.size, n_free_real + 2 * (pairs.size - n_fixed_pairs)))
    for i in range(n_fixed_real, n_real):
        chain[i, i - n_fixed_real] = -1 / blocks[i, 1]  # minus: the unknown is 1 - a
    for j in range(n_fixed_pairs, pairs.size):
        block = blocks[n_real + j]
        gamma, beta, sg, sb = block[0], block[1], block[2], block[3]
        row, column = n_real + 2 * j, n_free_real + 2 * (j - n_fixed_pairs)
        dt_ds, dt_df, dg_ds = -2 * pairs[j].real, -2 * pairs[j].imag, -2 * gamma
        chain[row, column] = dt_ds / sg
        chain[row, column + 1] = dt_df / sg
        chain[row + 1, column] = (dt_ds * beta - dg_ds) / (sg * sb)
        chain[row + 1, column + 1] = dt_df * beta / (sg * sb)
    return chain


@numba.njit(cache=True)
def by_unknowns(chain: Any, normal: Any, gradient: Any) -> tuple[Any, Any]:
    """Normal matrix (P, P) and S^T r (P,) of the free unknowns."""
    n, m = chain.shape
    system, slope = np.zeros((m, m)), np.zeros(m)
    turned = np.zeros((n, m))
    for p in range(m):
        for i in range(n):
            if chain[i, p] != 0:
                slope[p] += chain[i, p] * gradient[i]
                for j in range(n):
                    turned[j, p] += normal[j, i] * chain[i, p]
    for p in range(m):
        for i in range(n):
            if chain[i, p] != 0:
                for q in range(m):
                    system[p, q] += chain[i, p] * turned[i, q]
    return system, slope


@numba.njit(cache=True)
def free_parameters(real: Any, pairs: Any, n_fixed_real: int, n_fixed_pairs: int) -> Any:
    """1 - a of the free real poles, then s, f of each free pair."""
    n_free_real = real.size - n_fixed_real
    x = np.empty(n_free_real + 2 * (pairs.size - n_fixed_pairs))
    for i in range(n_free_real):
        x[i] = 1 - real[n_fixed_real + i]
    for j in range(n_fixed_pairs, pairs.size):
        log = np.log(pairs[j])
        x[n_free_real + 2 * (j - n_fixed_pairs)] = -log.real
        x[n_free_real + 2 * (j - n_fixed_pairs) + 1] = log.imag
    return x


@numba.njit(cache=True)
def _set_poles(x: Any, real: Any, pairs: Any, n_fixed_real: int, n_fixed_pairs: int) -> None:
    n_free_real = real.size - n_fixed_real
    for i in range(n_free_real):
        real[n_fixed_real + i] = 1 - x[i]
    for j in range(n_fixed_pairs, pairs.size):
        s = x[n_free_real + 2 * (j - n_fixed_pairs)]
        f = x[n_free_real + 2 * (j - n_fixed_pairs) + 1]
        pairs[j] = np.exp(-s) * complex(np.cos(f), np.sin(f))


@numba.njit(cache=True)
def _factorise(gram: Any, n: int, least_pivot: float) -> bool:
    """Cholesky factor into the lower triangle of gram[:n, :n]; False if a pivot is below its least share."""
    for j in range(n):
        diagonal = gram[j, j]
        pivot = diagonal
        for i in range(j):
            pivot -= gram[j, i] ** 2
        if not pivot > least_pivot * diagonal:
            return False
        gram[j, j] = np.sqrt(pivot)
        for row in range(j + 1, n):
            entry = gram[row, j]
            for i in range(j):
                entry -= gram[row, i] * gram[j, i]
            gram[row, j] = entry / gram[j, j]
    return True


@numba.njit(cache=True)
def _forward(factor: Any, n: int, b: Any) -> None:
    for i in range(n):
        for j in range(i):
            b[i] -= factor[i, j] * b[j]
        b[i] /= factor[i, i]


@numba.njit(cache=True)
def _backward(factor: Any, n: int, b: Any) -> None:
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            b[i] -= factor[j, i] * b[j]
        b[i] /= factor[i, i]


@numba.njit(cache=True)
def _fours(count: int) -> int:
    return -(-count // 4) * 4


@numba.njit(cache=True)
def room_for_rows(order: int, n_samples: int, feedthrough: bool, free: bool) -> int:
    """Length of the scratch array of `linearise_by_products`."""
    n_columns = _n_columns(order, feedthrough, free)
    return int((_fours(n_columns) + _fours(order) + 3) * pitch_of(n_samples))


@numba.njit(cache=True)
def linearise_by_products(
    blocks: Any,
    n_real: int,
    u: Any,
    y: Any,
    starts: Any,
    local_q: Any,
    feedthrough: bool,
    free: bool,
    rows: Any,
    normal: Any,
    gradient: Any,
) -> float:
    """J with its Kaufman linearisation as `ident.fit.kernels.linearise`, or -1 if the columns are too
    dependent.

    y (N,) without its part in local_q (Q, N), the polynomial nuisance columns made orthonormal within each
    record; free only with a single record; rows is zeros (`room_for_rows`), or what an earlier call with
    poles of the same number left there.
    """
    n = normal.shape[0]
    gram, on_local, on_residual = _room_for_products(n, local_q.shape[0], starts, feedthrough, free)
    rss = _fit_by_products(
        blocks, n_real, u, y, starts, local_q, feedthrough, free, rows, gram, on_local, on_residual
    )
    if rss >= 0:
        _sensitivities_by_products(
            blocks, n_real, y.size, starts, local_q, feedthrough, free, rows, gram, on_local, on_residual,
            normal, gradient,
        )  # fmt: skip
    return float(rss)


@numba.njit(cache=True)
def _room_for_products(order: int, n_local: int, starts: Any, feedthrough: bool, free: bool) -> Any:
    """Products of the rows with each other, with the nuisance columns of each record, with the residual."""
    n_rows = _fours(_n_columns(order, feedthrough, free)) + _fours(order)
    return np.empty((n_rows, n_rows)), np.zeros((n_rows, n_local * (starts.size - 1))), np.empty(n_rows)


@numba.njit(cache=True)
def _n_columns(order: int, feedthrough: bool, free: bool) -> int:
    return order * (2 if free else 1) + (1 if feedthrough else 0)


@numba.njit(cache=True, forceinline=True)
def _fit_by_products(
    blocks: Any,
    n_real: int,
    u: Any,
    y: Any,
    starts: Any,
    local_q: Any,
    feedthrough: bool,
    free: bool,
    rows: Any,
    gram: Any,
    on_local: Any,
    on_residual: Any,
) -> float:
    """J of `linearise_by_products`: all that a step which does not gain needs."""
    n_total, n = y.size, 2 * blocks.shape[0] - n_real
    n_columns = _n_columns(n, feedthrough, free)
    first = _fours(n_columns)  # the row of the first state
    n_rows = first + _fours(n)
    pitch = pitch_of(n_total)
    fitted = rows[n_rows * pitch : (n_rows + 1) * pitch]
    output = rows[(n_rows + 1) * pitch : (n_rows + 2) * pitch]
    residual = rows[(n_rows + 2) * pitch : (n_rows + 3) * pitch]
    _put(output, y)
    for r in range(starts.size - 1):
        cascade_states(blocks, n_real, u, starts[r], starts[r + 1], rows, 0, pitch)
    if free:
        run_cascade_free(blocks, n_real, rows.reshape((-1, pitch)), n, n_total)
    if feedthrough:
        _put(rows[(n_columns - 1) * pitch :], u)
    products(rows, pitch, 0, first, gram)
    _project_products(rows, pitch, 0, n_columns, local_q, starts, on_local, gram)
    theta = np.zeros(n_rows)
    row_products(rows, pitch, first, output, theta)
    if not _factorise(gram, n_columns, _LEAST_PIVOT):
        return -1.0
    _forward(gram, n_columns, theta)
    _backward(gram, n_columns, theta)
    combine(rows, pitch, first, theta, fitted)
    # The residual before refinement.
    for k in range(n_total):
        residual[k] = output[k] - fitted[k]
    for r in range(starts.size - 1):
        lo, hi = starts[r], starts[r + 1]
        for i in range(local_q.shape[0]):
            _subtract(residual, _dot(local_q[i], residual, lo, hi), local_q[i], lo, hi)
    row_products(rows, pitch, first, residual, on_residual)
    # Multiplied with L^-1 on the side of the columns: what of the residual lies in them.
    _forward(gram, n_columns, on_residual)
    rss = _dot(residual, residual, 0, n_total)
    for q in range(n_columns):
        rss -= on_residual[q] ** 2
    return float(rss)


@numba.njit(cache=True, forceinline=True)
def _sensitivities_by_products(
    blocks: Any,
    n_real: int,
    n_total: int,
    starts: Any,
    local_q: Any,
    feedthrough: bool,
    free: bool,
    rows: Any,
    gram: Any,
    on_local: Any,
    on_residual: Any,
    normal: Any,
    gradient: Any,
) -> None:
    """The rest of `linearise_by_products`, from what `_fit_by_products` left in the same arrays."""
    n = normal.shape[0]
    n_columns = _n_columns(n, feedthrough, free)
    first = _fours(n_columns)
    n_rows = first + _fours(n)
    pitch = pitch_of(n_total)
    fitted = rows[n_rows * pitch : (n_rows + 1) * pitch]
    residual = rows[(n_rows + 2) * pitch : (n_rows + 3) * pitch]
    for r in range(starts.size - 1):
        single_states(blocks, n_real, fitted, starts[r], starts[r + 1], rows, first, pitch)
    products(rows, pitch, first, n_rows, gram)
    _project_products(rows, pitch, first, first + n, local_q, starts, on_local, gram)
    row_products(rows[first * pitch :], pitch, n_rows - first, residual, on_residual[first:])
    for i in range(first, first + n):
        _forward(gram, n_columns, gram[i])
    for i in range(n):
        for j in range(i + 1):
            left = gram[first + i, first + j]
            for q in range(n_columns):
                left -= gram[first + i, q] * gram[first + j, q]
            normal[i, j] = left
            normal[j, i] = left
        gradient[i] = on_residual[first + i]
        for q in range(n_columns):
            gradient[i] -= gram[first + i, q] * on_residual[q]


@numba.njit(cache=True)
def _put(target: Any, values: Any) -> None:
    for k in range(values.size):
        target[k] = values[k]


@numba.njit(cache=True, forceinline=True)
def _project_products(
    rows: Any, pitch: int, first: int, last: int, local_q: Any, starts: Any, on_local: Any, gram: Any
) -> None:
    """Take the nuisance columns out of the products of rows first .. last - 1 with all rows before them."""
    n_local = local_q.shape[0]
    for i in range(first, last):
        row = rows[i * pitch : (i + 1) * pitch]
        for r in range(starts.size - 1):
            for q in range(n_local):
                on_local[i, r * n_local + q] = _dot(row, local_q[q], starts[r], starts[r + 1])
        for j in range(i + 1):
            for q in range(on_local.shape[1]):
                gram[i, j] -= on_local[i, q] * on_local[j, q]


@numba.njit(cache=True)
def descend(
    real: Any,
    pairs: Any,
    n_fixed_real: int,
    n_fixed_pairs: int,
    bounds: Any,
    u: Any,
    y: Any,
    y_clear: Any,
    starts: Any,
    polynomials: Any,
    local_q: Any,
    feedthrough: bool,
    free: bool,
    tolerance: float,
    max_iterations: int,
    damping: float,
) -> tuple[float, int, bool]:
    """Levenberg-Marquardt from the poles given in real and pairs, which receive the end; see
    `ident.fit.refinement.polish`.

    y_clear is y without its part in local_q; damping is that of the first step.
    Returns J, the number of iterations and whether the end is
    stationary.
    """
    n, n_free_real = real.size + 2 * pairs.size, real.size - n_fixed_real
    rows = np.zeros(room_for_rows(n, y.size, feedthrough, free))
    gram, on_local, on_residual = _room_for_products(n, local_q.shape[0], starts, feedthrough, free)
    residual = np.empty(y.size)
    # With free responses of several records the orthogonal factorisation alone.
    by_products = not free or starts.size == 2
    x = clip_parameters(free_parameters(real, pairs, n_fixed_real, n_fixed_pairs), n_free_real, bounds)
    _set_poles(x, real, pairs, n_fixed_real, n_fixed_pairs)
    normal, gradient = np.empty((n, n)), np.empty(n)
    trial_normal, trial_gradient = np.empty((n, n)), np.empty(n)
    trial_real, trial_pairs = real.copy(), pairs.copy()
    here, fast = -1.0, False
    blocks = _blocks(real, pairs)
    if by_products:
        here = _fit_by_products(
            blocks,
            real.size,
            u,
            y_clear,
            starts,
            local_q,
            feedthrough,
            free,
            rows,
            gram,
            on_local,
            on_residual,
        )
        fast = here >= 0
    if fast:
        _sensitivities_by_products(
            blocks, real.size, y.size, starts, local_q, feedthrough, free, rows, gram, on_local, on_residual,
            normal, gradient,
        )  # fmt: skip
    else:
        here = linearise(
            blocks, real.size, u, y, starts, polynomials, feedthrough, free, residual, normal, gradient
        )
    if x.size == 0:
        return here, 0, True
    # Residuals at rounding level relative to the output: nothing left to gain.
    floor = 1e-26 * _dot(y, y, 0, y.size)
    growth = GROWTH
    system, factor = np.empty((x.size, x.size)), np.empty((x.size, x.size))
    for iteration in range(max_iterations):
        if here <= floor:
            return here, iteration, True
        chain = chain_rule(real, pairs, n_fixed_real, n_fixed_pairs)
        full_system, full_slope = by_unknowns(chain, normal, gradient)
        free_ones = np.flatnonzero(~blocked(x, full_slope, n_free_real, bounds))
        m = free_ones.size
        if m == 0:
            return here, iteration, True
        scale, slope = np.empty(m), np.empty(m)
        for i in range(m):
            scale[i] = np.sqrt(max(full_system[free_ones[i], free_ones[i]], 1e-300))
            slope[i] = full_slope[free_ones[i]] / scale[i]
            for j in range(i + 1):
                system[i, j] = full_system[free_ones[i], free_ones[j]] / (scale[i] * scale[j])
                system[j, i] = system[i, j]
                factor[i, j] = system[i, j]
        if _schur_drop(factor[:m, :m], slope.copy()) <= tolerance * here:
            return here, iteration, True
        while True:
            for i in range(m):
                for j in range(i + 1):
                    factor[i, j] = system[i, j]
                factor[i, i] += damping
            ratio = 0.0
            if _factorise(factor, m, 1e-14):
                step = slope.copy()
                _forward(factor, m, step)
                _backward(factor, m, step)
                trial_x = x.copy()
                for i in range(m):
                    trial_x[free_ones[i]] += step[i] / scale[i]
                trial_x = clip_parameters(trial_x, n_free_real, bounds)
                _set_poles(trial_x, trial_real, trial_pairs, n_fixed_real, n_fixed_pairs)
                blocks = _blocks(trial_real, trial_pairs)
                there = -1.0
                if by_products:
                    there = _fit_by_products(
                        blocks, real.size, u, y_clear, starts, local_q, feedthrough, free, rows, gram,
                        on_local, on_residual,
                    )  # fmt: skip
                fast = there >= 0
                if not fast:
                    there = linearise(
                        blocks, real.size, u, y, starts, polynomials, feedthrough, free, residual,
                        trial_normal, trial_gradient,
                    )  # fmt: skip
                promised = 0.0
                for i in range(m):
                    along = 2 * slope[i]
                    for j in range(m):
                        along -= system[i, j] * step[j]
                    promised += step[i] * along
                if promised > 0:
                    ratio = (here - there) / promised
                if ratio > 1e-4:
                    break
            damping *= growth
            growth *= GROWTH
            if damping > 1e12:
                # No step of any length gains: the linearisation's promise is rounding, or a bound's corner.
                return here, iteration, False
        if fast:
            _sensitivities_by_products(
                blocks, real.size, y.size, starts, local_q, feedthrough, free, rows, gram, on_local,
                on_residual, trial_normal, trial_gradient,
            )  # fmt: skip
        x, here = trial_x, there
        _set_poles(x, real, pairs, n_fixed_real, n_fixed_pairs)
        normal, trial_normal = trial_normal, normal
        gradient, trial_gradient = trial_gradient, gradient
        damping *= max(1 / 5, 1 - (2 * ratio - 1) ** 3)
        growth = GROWTH
    return here, max_iterations, False
