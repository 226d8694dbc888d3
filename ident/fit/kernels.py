"""Compiled inner loops of the pole search: the cost of a candidate and the linearisation of a fit.

Signals of several records lie one after the other in arrays (N,), record i in starts[i]:starts[i + 1].
Matrices are kept as rows (columns of the regression), so that every inner loop runs over contiguous memory.

Here and in the other compiled modules a function whose products and sums may be fused or reordered is always
compiled into its callers (forceinline): left as a call, the copy of whichever kernel was loaded first would
be taken, and copies round differently.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from ident.basis.functions import run_cascade, run_cascade_free

# A column whose part outside the columns before it is below this fraction of its length carries no
# information.
_RANK_TOLERANCE = 1e-11


@numba.njit(cache=True, forceinline=True, fastmath={"reassoc", "contract"})
def _dot(a: Any, b: Any, lo: int, hi: int) -> float:
    # Slices counted from 0: with a[k], lo <= k < hi, the compiler has to allow for negative k and does not
    # vectorise (ten times slower).
    x, y = a[lo:hi], b[lo:hi]
    total = 0.0
    for k in range(x.size):
        total += x[k] * y[k]
    return total


@numba.njit(cache=True)
def _subtract(target: Any, factor: float, row: Any, lo: int, hi: int) -> None:
    x, y = target[lo:hi], row[lo:hi]
    for k in range(x.size):
        x[k] -= factor * y[k]


@numba.njit(cache=True)
def _copy(target: Any, source: Any) -> None:
    # Array assignments would do, but each makes numba compile seconds of broadcasting code.
    for k in range(source.size):
        target[k] = source[k]


@numba.njit(cache=True, forceinline=True)
def _dots(rows: Any, others: Any, lo: int, hi: int) -> Any:
    """Inner products (A, B) of rows (A, N) and others (B, N) over lo..hi."""
    products = np.empty((rows.shape[0], others.shape[0]))
    for i in range(rows.shape[0]):
        for j in range(others.shape[0]):
            products[i, j] = _dot(rows[i], others[j], lo, hi)
    return products


@numba.njit(cache=True)
def _place(target: Any, part: Any, row: int, column: int) -> None:
    for i in range(part.shape[0]):
        for j in range(part.shape[1]):
            target[row + i, column + j] = part[i, j]


@numba.njit(cache=True)
def _subtract_products(target: Any, a: Any, b: Any, row: int, column: int) -> None:
    """target[row:, column:] -= a b^T."""
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            total = 0.0
            for q in range(a.shape[1]):
                total += a[i, q] * b[j, q]
            target[row + i, column + j] -= total


@numba.njit(cache=True)
def _schur_drop(gram: Any, b: Any) -> float:
    """b^T gram^-1 b by Cholesky; dependent columns are left out."""
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


@numba.njit(cache=True, forceinline=True)
def candidate_rss(
    blocks: Any, n_real: int, w: Any, residual: Any, starts: Any, local_q: Any, shared_q: Any, free: bool
) -> float:
    """Residual sum of squares when the given blocks join what is already fitted.

    w (N,) drives the candidate blocks (the input, or the all-pass output of the frozen poles); residual
    (N,) is what the frozen columns leave of y; local_q (Ql, N) and shared_q (Qs, N) are those columns made
    orthonormal, within each record and over all. With `free` the candidate poles also get their free
    responses per record. Works on the Gram matrix: good to about 1e-10 of |residual|^2, enough to rank
    candidates.
    """
    n_records = starts.size - 1
    n_total = residual.size
    m = 0
    for i in range(blocks.shape[0]):
        m += 1 if i < n_real else 2
    phi = np.empty((m, n_total))
    signal = np.empty((1, n_total))
    _copy(signal[0], w)
    for r in range(n_records):
        run_cascade(blocks, n_real, signal[0], phi, 0, starts[r], starts[r + 1])
    _copy(signal[0], residual)
    # Free responses first: unknown i of record r has the index r m + i, the shared columns follow.
    first = m * n_records if free else 0
    size = first + m
    gram = np.zeros((size, size))
    b = np.zeros(size)
    on_shared = np.zeros((size, shared_q.shape[0]))
    for i in range(m):
        for j in range(i + 1):  # the factorisation looks at the lower triangle only
            gram[first + i, first + j] = _dot(phi[i], phi[j], 0, n_total)
    _place(on_shared, _dots(phi, shared_q, 0, n_total), first, 0)
    along = _dots(phi, signal, 0, n_total)
    for i in range(m):
        b[first + i] = along[i, 0]
    response = np.empty((m, n_total))
    if free:
        longest = 0
        for r in range(n_records):
            longest = max(longest, starts[r + 1] - starts[r])
        run_cascade_free(blocks, n_real, response, 0, longest)
    placed = np.empty((m, n_total))
    for r in range(n_records):
        lo, hi = starts[r], starts[r + 1]
        on_local = _dots(phi, local_q, lo, hi)
        _subtract_products(gram, on_local, on_local, first, first)
        if free:
            for i in range(m):
                _copy(placed[i, lo:hi], response[i, : hi - lo])
            free_on_local = _dots(placed, local_q, lo, hi)
            _place(gram, _dots(placed, placed, lo, hi), r * m, r * m)
            _subtract_products(gram, free_on_local, free_on_local, r * m, r * m)
            _place(gram, _dots(phi, placed, lo, hi), first, r * m)
            _subtract_products(gram, on_local, free_on_local, first, r * m)
            _place(on_shared, _dots(placed, shared_q, lo, hi), r * m, 0)
            along = _dots(placed, signal, lo, hi)
            for i in range(m):
                b[r * m + i] = along[i, 0]
    _subtract_products(gram, on_shared, on_shared, 0, 0)
    return _dot(residual, residual, 0, n_total) - _schur_drop(gram, b)


@numba.njit(cache=True, forceinline=True)
def linearise(
    blocks: Any,
    n_real: int,
    u: Any,
    y: Any,
    starts: Any,
    polynomials: Any,
    feedthrough: bool,
    free: bool,
    residual: Any,
    normal: Any,
    gradient: Any,
) -> float:
    """Residual sum of squares J of the fit with all blocks, and its Kaufman linearisation.

    Fills residual (N,), normal (n, n) = S^T S and gradient (n,) = S^T r, where S are the states of each block
    driven by the fitted output, projected off the regression (see `ident.fit.refinement`). Modified
    Gram-Schmidt on [columns | y], which is backward stable for least squares; nothing is squared before it is
    projected.
    """
    n_records = starts.size - 1
    n_total = y.size
    n = normal.shape[0]
    n_poly = polynomials.shape[0]
    n_local = n_poly + (n if free else 0)
    n_shared = n + (1 if feedthrough else 0)
    rows = np.empty((n_local + n_shared, n_total))
    for i in range(n_poly):
        _copy(rows[i], polynomials[i])
    signal = np.empty(n_total)
    _copy(signal, u)
    for r in range(n_records):
        run_cascade(blocks, n_real, signal, rows, n_local, starts[r], starts[r + 1])
    if feedthrough:
        _copy(rows[n_local + n], u)
    if free:
        longest = 0
        for r in range(n_records):
            longest = max(longest, starts[r + 1] - starts[r])
        response = np.empty((n, longest))
        run_cascade_free(blocks, n_real, response, 0, longest)
        for r in range(n_records):
            for i in range(n):
                for k in range(starts[r + 1] - starts[r]):
                    rows[n_poly + i, starts[r] + k] = response[i, k]
    raw = np.empty((n_shared, n_total))
    for i in range(n_shared):
        _copy(raw[i], rows[n_local + i])
    _copy(residual, y)
    for r in range(n_records):
        lo, hi = starts[r], starts[r + 1]
        for j in range(n_local):
            size = _dot(rows[j], rows[j], lo, hi)
            for i in range(j):
                _subtract(rows[j], _dot(rows[i], rows[j], lo, hi), rows[i], lo, hi)
            _normalise(rows[j], size, lo, hi)
            for i in range(n_local, n_local + n_shared):
                _subtract(rows[i], _dot(rows[j], rows[i], lo, hi), rows[j], lo, hi)
            _subtract(residual, _dot(rows[j], residual, lo, hi), rows[j], lo, hi)
    triangle = np.zeros((n_shared, n_shared))
    theta = np.zeros(n_shared)
    for j in range(n_shared):
        row = rows[n_local + j]
        size = _dot(raw[j], raw[j], 0, n_total)
        for i in range(j):
            triangle[i, j] = _dot(rows[n_local + i], row, 0, n_total)
            _subtract(row, triangle[i, j], rows[n_local + i], 0, n_total)
        triangle[j, j] = _normalise(row, size, 0, n_total)
        theta[j] = _dot(row, residual, 0, n_total)
        _subtract(residual, theta[j], row, 0, n_total)
    # The fitted output that the poles make. With free responses among the columns a polynomial part does no
    # harm (filtered, it stays in the span of the columns); without them it has to be left out.
    fitted = np.empty(n_total)
    _copy(fitted, y)
    _subtract(fitted, 1.0, residual, 0, n_total)
    if not free:
        for j in range(n_shared - 1, -1, -1):
            for i in range(j + 1, n_shared):
                theta[j] -= triangle[j, i] * theta[i]
            theta[j] = theta[j] / triangle[j, j] if triangle[j, j] > 0 else 0.0
        for k in range(n_total):
            fitted[k] = 0.0
        for j in range(n_shared):
            _subtract(fitted, -theta[j], raw[j], 0, n_total)
    states = np.empty((n, n_total))
    at = 0
    for i in range(blocks.shape[0]):
        single = blocks[i : i + 1]
        _copy(signal, fitted)
        for r in range(n_records):
            run_cascade(single, 1 if i < n_real else 0, signal, states, at, starts[r], starts[r + 1])
        at += 1 if i < n_real else 2
    for i in range(n):
        for r in range(n_records):
            lo, hi = starts[r], starts[r + 1]
            for j in range(n_local):
                _subtract(states[i], _dot(rows[j], states[i], lo, hi), rows[j], lo, hi)
        for j in range(n_local, n_local + n_shared):
            _subtract(states[i], _dot(rows[j], states[i], 0, n_total), rows[j], 0, n_total)
        gradient[i] = _dot(states[i], residual, 0, n_total)
        for j in range(i + 1):
            normal[i, j] = _dot(states[i], states[j], 0, n_total)
            normal[j, i] = normal[i, j]
    return _dot(residual, residual, 0, n_total)


@numba.njit(cache=True, forceinline=True)
def _normalise(row: Any, size_before: float, lo: int, hi: int) -> float:
    """Scale row[lo:hi] to length 1 and return the length it had, or set it to zero if nothing of it is
    left."""
    size = _dot(row, row, lo, hi)
    if not size > _RANK_TOLERANCE**2 * size_before:
        for k in range(lo, hi):
            row[k] = 0.0
        return 0.0
    length = np.sqrt(size)
    part = row[lo:hi]
    for k in range(part.size):
        part[k] /= length
    return float(length)
