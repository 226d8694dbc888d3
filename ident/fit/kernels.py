"""Compiled inner loops: the cost of candidate poles and the linearisation of a fit, for one or more inputs.

Signals of several records lie one after the other in arrays (N,), record i in starts[i]:starts[i + 1];
matrices are kept as rows. A function whose products and sums may be fused or reordered is always compiled
into its callers (forceinline): copies round differently.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from ident.basis.coordinates import blocks_of_point
from ident.basis.functions import run_cascade, run_cascade_free
from ident.data.arrays import COMPILED, INSIDE

# A column whose part outside the columns before it is below this share of its length says nothing.
_RANK_TOLERANCE = 1e-11
# Least square of a column's part outside the ones before: the inverse is wrong by 1e-16 over this.
_LEAST_PIVOT = 1e-8
# numpy's scalars: of Python's own numba compiles a version of the called function for each value.
_START: Any = np.int64(0)
_LOWER: Any = np.bool_(True)
_ALL: Any = np.bool_(False)
_called = numba.njit(**INSIDE)


@numba.njit(**INSIDE, forceinline=True, fastmath={"reassoc", "contract"})
def _dot(a: Any, b: Any, lo: int, hi: int) -> float:
    # Slices counted from 0: a[k], lo <= k < hi, allows for negative k and is not vectorised (ten times
    # slower).
    x, y = a[lo:hi], b[lo:hi]
    total = 0.0
    for k in range(x.size):
        total += x[k] * y[k]
    return total


@numba.njit(**INSIDE, forceinline=True, fastmath={"reassoc", "contract"})
def _eight_dots(a: Any, b: Any, rows: Any, j: int, last: int, lo: int, hi: int) -> Any:
    """Products of a with rows j .. j + 3, or `last` in place of what lies beyond it, then those of b: each
    number read from memory is used more than once."""
    x, z = a[lo:hi], b[lo:hi]
    y0, y1 = rows[j, lo:hi], rows[min(j + 1, last), lo:hi]
    y2, y3 = rows[min(j + 2, last), lo:hi], rows[min(j + 3, last), lo:hi]
    s0 = s1 = s2 = s3 = t0 = t1 = t2 = t3 = 0.0
    for k in range(x.size):
        s0 += x[k] * y0[k]
        s1 += x[k] * y1[k]
        s2 += x[k] * y2[k]
        s3 += x[k] * y3[k]
        t0 += z[k] * y0[k]
        t1 += z[k] * y1[k]
        t2 += z[k] * y2[k]
        t3 += z[k] * y3[k]
    return (s0, s1, s2, s3), (t0, t1, t2, t3)


@_called
def _products(rows: Any, others: Any, lo: int, hi: int, lower: bool, first: int, target: Any) -> None:
    """target[i, j] = row i times other row j over lo..hi, from row `first` on; `lower`: for j <= i. Targets
    are always slices of both axes: one type, one compilation."""
    for i in range(first, rows.shape[0], 2):
        second = min(i + 1, rows.shape[0] - 1)
        last = second if lower else others.shape[0] - 1
        for j in range(0, last + 1, 4):
            ours, theirs = _eight_dots(rows[i], rows[second], others, j, last, lo, hi)
            for q in range(min(4, last + 1 - j)):
                target[i, j + q] = ours[q]
                target[second, j + q] = theirs[q]


@_called
def _subtract(target: Any, factor: float, row: Any, lo: int, hi: int) -> None:
    x, y = target[lo:hi], row[lo:hi]
    for k in range(x.size):
        x[k] -= factor * y[k]


@_called
def _copy(target: Any, source: Any) -> None:
    # Array assignments would do, but each makes numba compile seconds of broadcasting code.
    for k in range(source.size):
        target[k] = source[k]


@_called
def _subtract_squares(target: Any, a: Any, first: int) -> None:
    """target[i, j] -= a[i] a[j]^T, lower triangle from row `first` on."""
    for i in range(first, a.shape[0]):
        for j in range(i + 1):
            total = 0.0
            for q in range(a.shape[1]):
                total += a[i, q] * a[j, q]
            target[i, j] -= total


@_called
def schur_drop(gram: Any, b: Any) -> float:
    """b^T gram^-1 b by Cholesky in place; dependent columns are left out."""
    n = b.size
    drop = 0.0
    for j in range(n):
        diagonal = gram[j, j]
        pivot = diagonal
        for i in range(j):
            pivot -= gram[j, i] ** 2
        if not pivot > _RANK_TOLERANCE * diagonal:
            for i in range(j, n):
                gram[i, j] = 0.0
            continue
        root = np.sqrt(pivot)
        gram[j, j] = root
        value = b[j]
        for i in range(j):
            value -= gram[j, i] * b[i]
        b[j] = value / root
        drop += b[j] ** 2
        for row in range(j + 1, n):
            entry = gram[row, j]
            for i in range(j):
                entry -= gram[row, i] * gram[j, i]
            gram[row, j] = entry / root
    return drop


@_called
def factorise(gram: Any, n: int, least_pivot: float) -> bool:
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


@_called
def forward(factor: Any, n: int, b: Any) -> None:
    """b[:n] = L^-1 b[:n]."""
    for i in range(n):
        for j in range(i):
            b[i] -= factor[i, j] * b[j]
        b[i] /= factor[i, i]


@_called
def backward(factor: Any, n: int, b: Any) -> None:
    """b[:n] = L^-T b[:n]."""
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            b[i] -= factor[j, i] * b[j]
        b[i] /= factor[i, i]


@numba.njit(**COMPILED)
def driven_rows(blocks: Any, n_real: int, signals: Any, starts: Any, rows: Any) -> None:
    """States of a cascade driven by each of the signals (U, N), record by record from rest, into rows
    (U B, N); signals become what its all-pass makes of them."""
    order = 2 * blocks.shape[0] - n_real
    for i in range(signals.shape[0]):
        for r in range(starts.size - 1):
            run_cascade(blocks, n_real, signals[i], rows, i * order, starts[r], starts[r + 1])


@numba.njit(**COMPILED, inline="always")
def _free_rows(blocks: Any, n_real: int, starts: Any) -> Any:
    """Free responses of a cascade over the longest record (B, T)."""
    longest = starts[0]  # 0; of Python's own numba would compile `run_cascade_free` once more
    for r in range(starts.size - 1):
        longest = max(longest, starts[r + 1] - starts[r])
    rows = np.empty((2 * blocks.shape[0] - n_real, longest))
    run_cascade_free(blocks, n_real, rows, _START, longest)
    return rows


@numba.njit(**COMPILED)
def cost_of_point(
    unit: Any,
    n_real: int,
    low: Any,
    high: Any,
    raw: bool,
    drive: Any,
    frozen: Any,
    starts: Any,
    local_q: Any,
    free: bool,
) -> float:
    """Residual sum of squares when the blocks of a point (D,) of the unit cube (box low, high) join what is
    fitted.

    drive (U, N): signals that drive the candidate blocks; frozen (Q + 1, N): columns common to all records
    made orthonormal, then the residual; local_q (L, N): columns of single records made orthonormal in each.
    free: the candidate poles get their free responses per record, too. J = |r|^2 - b^T G^-1 b with products G
    of what the new columns add, b those with r: good to about 1e-10 of |r|^2.
    """
    blocks = blocks_of_point(unit, n_real, low, high, raw)
    n_records, n_inputs, n_total = starts.size - 1, drive.shape[0], drive.shape[1]
    order, n_frozen = 2 * blocks.shape[0] - n_real, frozen.shape[0] - 1
    # Free responses first: that of record r and state i is row r * order + i.
    first = order * n_records if free else 0
    m = first + n_inputs * order
    phi = np.empty((n_inputs * order, n_total))
    driven_rows(blocks, n_real, drive.copy(), starts, phi)
    gram, on_frozen = np.zeros((m, m)), np.empty((m, n_frozen + 1))
    _products(phi, phi, _START, n_total, _LOWER, _START, gram[first:, first:])
    _products(phi, frozen, _START, n_total, _ALL, _START, on_frozen[first:, :])
    on_local = np.empty((phi.shape[0], local_q.shape[0]))
    if free:
        response = _free_rows(blocks, n_real, starts)
        placed = np.empty((order, n_total))
        free_on_local = np.empty((order, local_q.shape[0]))
    for r in range(n_records):
        lo, hi = starts[r], starts[r + 1]
        _products(phi, local_q, lo, hi, _ALL, _START, on_local[:, :])
        _subtract_squares(gram[first:, first:], on_local[:, :], _START)
        if free:
            at = r * order
            for i in range(order):
                _copy(placed[i, lo:hi], response[i, : hi - lo])
            _products(placed, local_q, lo, hi, _ALL, _START, free_on_local[:, :])
            _products(placed, placed, lo, hi, _LOWER, _START, gram[at : at + order, at : at + order])
            _subtract_squares(gram[at : at + order, at : at + order], free_on_local[:, :], _START)
            _products(placed, frozen, lo, hi, _ALL, _START, on_frozen[at : at + order, :])
            _products(phi, placed, lo, hi, _ALL, _START, gram[first:, at : at + order])
            for i in range(phi.shape[0]):
                for j in range(order):
                    for q in range(local_q.shape[0]):
                        gram[first + i, at + j] -= on_local[i, q] * free_on_local[j, q]
    _subtract_squares(gram[:, :], on_frozen[:, :n_frozen], _START)
    residual = frozen[n_frozen]
    return float(_dot(residual, residual, _START, n_total) - schur_drop(gram, on_frozen[:, n_frozen].copy()))


@numba.njit(**COMPILED, inline="always")
def _local_rows(blocks: Any, n_real: int, polynomials_q: Any, starts: Any) -> Any:
    """Polynomials and free responses (L, N), orthonormal in each record (modified Gram-Schmidt, twice)."""
    n_known = polynomials_q.shape[0]
    response = _free_rows(blocks, n_real, starts)
    rows = np.zeros((n_known + response.shape[0], polynomials_q.shape[1]))
    for i in range(n_known):
        _copy(rows[i], polynomials_q[i])
    for r in range(starts.size - 1):
        lo, hi = starts[r], starts[r + 1]
        for i in range(n_known, rows.shape[0]):
            part = rows[i, lo:hi]
            _copy(part, response[i - n_known, : hi - lo])
            before = _dot(part, part, _START, part.size)
            for _ in range(2):
                for j in range(i):
                    _subtract(rows[i], _dot(rows[j], rows[i], lo, hi), rows[j], lo, hi)
            size = _dot(part, part, _START, part.size)
            factor = 1 / np.sqrt(size) if size > _RANK_TOLERANCE**2 * before else 0.0
            for k in range(part.size):
                part[k] *= factor
    return rows


@_called
def _take_out_local(target: Any, local_q: Any, starts: Any) -> None:
    for r in range(starts.size - 1):
        lo, hi = starts[r], starts[r + 1]
        for i in range(local_q.shape[0]):
            _subtract(target, _dot(local_q[i], target, lo, hi), local_q[i], lo, hi)


@_called
def _off_local_products(rows: Any, first: int, local_q: Any, starts: Any, on_local: Any, gram: Any) -> None:
    """Products of rows first .. with all rows before them, local columns taken out of both."""
    n_local = local_q.shape[0]
    _products(rows, rows, _START, rows.shape[1], _LOWER, first, gram[:, :])
    for r in range(starts.size - 1):
        here = on_local[:, r * n_local : (r + 1) * n_local]
        _products(rows, local_q, starts[r], starts[r + 1], _ALL, first, here)
    _subtract_squares(gram[:, :], on_local[: rows.shape[0], :], first)


@numba.njit(**COMPILED)
def linearise(
    blocks: Any,
    n_real: int,
    u: Any,
    y: Any,
    starts: Any,
    polynomials_q: Any,
    feedthrough: bool,
    free: bool,
    below: float,
    normal: Any,
    gradient: Any,
) -> float:
    """Residual sum of squares J of the fit with all blocks, and its Kaufman linearisation; or -1 if the
    columns are too dependent for products.

    u (U, N); y (N,) without its part in polynomials_q (Q, N), orthonormal in each record. If J < below, fills
    normal (B, B) = S^T S and gradient (B,) = S^T r, S the states of each block driven by the fitted output,
    projected off the regression. With the columns Phi as rows, G = Phi Phi^T and e = y - Phi^T G^-1 Phi y,
    r^T r = e^T e - (Phi e)^T G^-1 (Phi e), and

        S P S^T = S S^T - (S Phi^T) G^-1 (Phi S^T),   S r = S e - (S Phi^T) G^-1 (Phi e).

    The terms in Phi e, zero but for rounding, are a step of iterative refinement: with the condition of G
    bounded (`_LEAST_PIVOT`) they bring the precision of an orthogonal factorisation.
    """
    n, n_inputs, n_total = normal.shape[0], u.shape[0], y.size
    n_columns = n_inputs * (n + (1 if feedthrough else 0))
    rows = np.empty((n_columns + n, n_total))
    local_q = _local_rows(blocks, n_real, polynomials_q, starts) if free else polynomials_q
    output = y.copy()
    if free:
        _take_out_local(output, local_q, starts)
    driven_rows(blocks, n_real, u.copy(), starts, rows)
    if feedthrough:
        for i in range(n_inputs):
            _copy(rows[n_inputs * n + i], u[i])
    gram = np.empty((rows.shape[0], rows.shape[0]))
    on_local = np.empty((rows.shape[0], local_q.shape[0] * (starts.size - 1)))
    _off_local_products(rows[:n_columns], _START, local_q, starts, on_local, gram)
    if not factorise(gram, n_columns, _LEAST_PIVOT):
        return -1.0
    theta = np.empty(n_columns)
    for i in range(n_columns):
        theta[i] = _dot(rows[i], output, _START, n_total)
    forward(gram, n_columns, theta)
    backward(gram, n_columns, theta)
    residual = output.copy()
    for i in range(n_columns):
        _subtract(residual, theta[i], rows[i], _START, n_total)
    fitted = np.empty((1, n_total))
    for k in range(n_total):
        fitted[0, k] = output[k] - residual[k]
    _take_out_local(residual, local_q, starts)
    if free:
        # Free responses are part of the output that the poles make; a polynomial part stays in their span.
        for k in range(n_total):
            fitted[0, k] = y[k] - residual[k]
    on_residual = np.empty(rows.shape[0])
    for i in range(n_columns):
        on_residual[i] = _dot(rows[i], residual, _START, n_total)
    forward(gram, n_columns, on_residual)
    rss = _dot(residual, residual, _START, n_total)
    for q in range(n_columns):
        rss -= on_residual[q] ** 2
    if not rss < below:
        return float(rss)
    signal = np.empty((1, n_total))
    at = n_columns
    for i in range(blocks.shape[0]):
        _copy(signal[0], fitted[0])
        driven_rows(blocks[i : i + 1], 1 if i < n_real else 0, signal, starts, rows[at:])
        at += 1 if i < n_real else 2
    _off_local_products(rows, n_columns, local_q, starts, on_local, gram)
    for i in range(n):
        row = gram[n_columns + i]
        forward(gram, n_columns, row)
        gradient[i] = _dot(rows[n_columns + i], residual, _START, n_total)
        for q in range(n_columns):
            gradient[i] -= row[q] * on_residual[q]
        for j in range(i + 1):
            left = row[n_columns + j]
            for q in range(n_columns):
                left -= row[q] * gram[n_columns + j, q]
            normal[i, j] = left
            normal[j, i] = left
    return float(rss)
