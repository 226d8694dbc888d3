"""Compiled inner loops of a fit to records: cost of candidate poles, and linearisation at given poles.

A search asks thousands of times what residual sum of squares some poles leave, and a refinement asks how it
changes with them (Kaufman, BIT 15, 1975). Both are answered here from inner products of columns and Cholesky
factors, never from an orthogonal factorisation of the columns, which costs several times as much; where the
columns are too dependent for products, `linearise` says so and its caller factorises. `cost_of_point` and
`linearise` are the two ways in; the functions before them are their parts.

Signals of several records lie one after the other in arrays (N,), record i in starts[i]:starts[i + 1], starts
(K + 1,) beginning with 0; matrices are kept as rows, so that a column of the regression lies in one piece. A
function whose products and sums may be fused or reordered is always compiled into its callers (forceinline):
copies round differently. Nothing is checked in this file: compiled code reads and writes beyond an array
without a word, so shapes, numbers of rows and lo <= hi <= N are the callers' care. A NaN in signals or points
comes out in sums; what a factorisation makes of it is said there.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from ident.basis.coordinates import blocks_of_point
from ident.basis.functions import run_cascade, run_cascade_free
from ident.data.arrays import COMPILED, INSIDE

# Least square of a column's part outside the columns before it, as a share of its own square, that counts in
# the cost of a candidate. Products are rounded to about 1e-15 of it, so what is above has four digits.
# Chosen; doubled, halved, 1e-15 or 1e-8, no test moves: it matters where candidates of a search coincide.
_LEAST_SQUARE_OF_CANDIDATE = 1e-11
# Least length of a free response outside the rows before it, as a share of its length: one that is a sum of
# others to that share is left out. Two passes of Gram-Schmidt leave 1e-16. Chosen; 1e-15 or 1e-6, no test
# moves.
_LEAST_LENGTH_OF_FREE_ROW = 1e-11
# Least square of a column's part outside the ones before, as a share of its own, that `linearise` accepts.
# The inverse of the products is wrong by 1e-16 over this, 1e-8, and one step of refinement squares that to
# rounding. Doubled or halved, no test moves; at 1e-12 a test of nearly dependent columns fails.
_LEAST_PIVOT = 1e-8
# First sample or row, and the two values of `lower` of `_products`. numpy's scalars: of Python's own numba
# compiles a version of the called function for each value.
_START: Any = np.int64(0)
# Only the lower triangle.
_LOWER: Any = np.bool_(True)
# All products.
_ALL: Any = np.bool_(False)
# Compiled for calls from compiled code alone: `INSIDE` leaves out the wrapper for calls from Python.
_called = numba.njit(**INSIDE)


@numba.njit(**INSIDE, forceinline=True, fastmath={"reassoc", "contract"})
def _dot(a: Any, b: Any, lo: int, hi: int) -> float:
    """Inner product of a (N,) and b (N,) over the samples lo..hi; 0 where there are none.

    Its sum may be taken in any order (reassoc), so that the last digits depend on where it is inlined.
    """
    # Slices counted from 0: a[k], lo <= k < hi, allows for negative k and is not vectorised (ten times
    # slower).
    x = a[lo:hi]
    y = b[lo:hi]
    total = 0.0
    for k in range(x.size):
        total += x[k] * y[k]
    return total


@numba.njit(**INSIDE, forceinline=True, fastmath={"reassoc", "contract"})
def _eight_dots(a: Any, b: Any, rows: Any, j: int, last: int, lo: int, hi: int) -> Any:
    """Inner products over lo..hi of a (N,) with rows j .. j + 3, and those of b (N,) with them: two 4-tuples.

    rows (n, N), j <= last < n. Row `last` stands in for rows beyond it, so that the caller need not count.
    Eight at a time, because each number that is read from memory is then used more than once: that is what
    the loop waits for. Not more: eight sums, four rows and two vectors are 14 of the 16 registers that x86
    has.
    """
    x = a[lo:hi]
    z = b[lo:hi]
    y0 = rows[j, lo:hi]
    y1 = rows[min(j + 1, last), lo:hi]
    y2 = rows[min(j + 2, last), lo:hi]
    y3 = rows[min(j + 3, last), lo:hi]
    s0 = s1 = s2 = s3 = 0.0
    t0 = t1 = t2 = t3 = 0.0
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
    """Fill target[i, j] with the inner product over lo..hi of rows[i] and others[j], from row `first` on.

    rows (R, N), others (S, N), target (R, S); with `lower` only j <= i (of two rows together: up to the
    second one's diagonal), and then others has at least R rows. Targets are always slices of both axes: one
    type, one compilation. Rows before `first`, and the rest of the target, stay as they are.
    """
    for i in range(first, rows.shape[0], 2):
        # Two rows at a time; an odd last one is paired with itself.
        second = min(i + 1, rows.shape[0] - 1)
        last = second if lower else others.shape[0] - 1
        # Four others at a time, as `_eight_dots` takes them.
        for j in range(0, last + 1, 4):
            of_first, of_second = _eight_dots(rows[i], rows[second], others, j, last, lo, hi)
            for q in range(min(4, last + 1 - j)):
                target[i, j + q] = of_first[q]
                target[second, j + q] = of_second[q]


@_called
def _subtract(target: Any, factor: float, row: Any, lo: int, hi: int) -> None:
    """Take factor times row (N,) out of target (N,), in place, over the samples lo..hi."""
    x = target[lo:hi]
    y = row[lo:hi]
    for k in range(x.size):
        x[k] -= factor * y[k]


@_called
def _copy(target: Any, source: Any) -> None:
    """Copy source (n,) into the first n numbers of target, which has at least n."""
    # Array assignments would do, but each makes numba compile seconds of broadcasting code.
    for k in range(source.size):
        target[k] = source[k]


@_called
def _subtract_squares(target: Any, a: Any, first: int) -> None:
    """Take a a^T out of the lower triangle of target (R, R), from row `first` on, in place; a (R, Q).

    What stands above the diagonal stays.
    """
    for i in range(first, a.shape[0]):
        for j in range(i + 1):
            total = 0.0
            for q in range(a.shape[1]):
                total += a[i, q] * a[j, q]
            target[i, j] -= total


@_called
def schur_drop(gram: Any, b: Any) -> float:
    """Fall b^T gram^-1 b of the residual sum of squares when columns with these products join a fit.

    Parameters
    ----------
    gram : ndarray, shape (n, n)
        Inner products of the new columns, those before taken out: lower triangle. Overwritten.
    b : ndarray, shape (n,)
        Inner products of the new columns with the residual. Overwritten.

    Returns
    -------
    float
        At least 0, in the unit of b squared over that of gram. A column that depends on those before it to
        within `_LEAST_SQUARE_OF_CANDIDATE` is left out, and so is one whose products are NaN.
    """
    n = b.size
    drop = 0.0
    for j in range(n):
        diagonal = gram[j, j]
        pivot = diagonal
        for i in range(j):
            pivot -= gram[j, i] ** 2
        if not pivot > _LEAST_SQUARE_OF_CANDIDATE * diagonal:
            # A column of zeros in the factor: those after it do not see this one.
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
    """Whether gram[:n, :n] has a Cholesky factor L L^T, which then stands in its lower triangle.

    False, with the triangle half overwritten, if the square of a column's part outside the ones before is
    not above `least_pivot` (a share, no unit) times its own square; so for a column of zeros or NaN. gram has
    n rows or more, and only its lower triangle is read.
    """
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
    """Replace b[:n] by L^-1 b[:n], L the lower triangle of factor[:n, :n], its diagonal not zero."""
    for i in range(n):
        for j in range(i):
            b[i] -= factor[i, j] * b[j]
        b[i] /= factor[i, i]


@_called
def backward(factor: Any, n: int, b: Any) -> None:
    """Replace b[:n] by L^-T b[:n], L the lower triangle of factor[:n, :n], its diagonal not zero."""
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            b[i] -= factor[j, i] * b[j]
        b[i] /= factor[i, i]


@numba.njit(**COMPILED)
def driven_rows(blocks: Any, n_real: int, signals: Any, starts: Any, rows: Any) -> None:
    """Fill rows (U B, N) with the states of a cascade driven by each of the signals (U, N).

    Parameters
    ----------
    blocks : ndarray, shape (R + P, 4)
        Cascade of R = n_real real poles and P pairs, as `ident.basis.functions.block_parameters` makes them;
        B = R + 2 P.
    n_real : int
        How many of the blocks are real poles; they come first.
    signals : ndarray, shape (U, N)
        Each record starts from rest. Overwritten by what the all-pass of the cascade makes of them.
    starts : ndarray of int, shape (K + 1,)
        Where the records begin, and N.
    rows : ndarray, shape (U B, N) or more
        Filled: states of the first signal, then of the second.
    """
    order = 2 * blocks.shape[0] - n_real
    for i in range(signals.shape[0]):
        for r in range(starts.size - 1):
            run_cascade(blocks, n_real, signals[i], rows, i * order, starts[r], starts[r + 1])


@numba.njit(**COMPILED, inline="always")
def _free_rows(blocks: Any, n_real: int, starts: Any) -> Any:
    """Free responses (B, T) of a cascade over the longest record, T samples; shorter ones use their start.

    blocks (R + P, 4) of R = n_real real poles and P pairs, B = R + 2 P; starts (K + 1,). No unit: they are
    states after a unit impulse.
    """
    # starts[0] is 0; Python's own 0 would make numba compile `run_cascade_free` once more.
    longest = starts[0]
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
    """Residual sum of squares when the blocks of a point of the unit cube join what is fitted.

    Parameters
    ----------
    unit : ndarray, shape (D,)
        Point of the search: D = R + 2 P numbers from 0 to 1; beyond them poles leave the circle.
    n_real, low, high, raw
        Search space: number R of real poles, ends (3,) of its box, whether its coordinates are the paper's
        (`ident.basis.coordinates.SearchSpace`).
    drive : ndarray, shape (U, N)
        Signals that drive the candidate blocks: each input behind the all-pass of the frozen poles.
    frozen : ndarray, shape (Q + 1, N)
        Columns common to all records made orthonormal, then the residual that they leave.
    starts : ndarray of int, shape (K + 1,)
        Where the records begin, and N.
    local_q : ndarray, shape (L, N)
        Columns of single records (polynomials, free responses), orthonormal in each.
    free : bool
        The candidate poles get their free responses in each record, too.

    Returns
    -------
    float
        Square of the unit of the output. For a point with NaN: what the frozen columns leave.

    Notes
    -----
    J = |r|^2 - b^T G^-1 b with products G of what the new columns add, b those with r: good to about 1e-10 of
    |r|^2. What a column adds has products x^T y - (Q x)^T (Q y), Q the orthonormal rows before it, so that
    no column need be projected.
    """
    blocks = blocks_of_point(unit, n_real, low, high, raw)
    n_records = starts.size - 1
    n_inputs = drive.shape[0]
    n_total = drive.shape[1]
    order = 2 * blocks.shape[0] - n_real
    n_frozen = frozen.shape[0] - 1
    # Free responses first: that of record r and state i is row r * order + i.
    first = order * n_records if free else 0
    m = first + n_inputs * order

    # Driven columns: products among them, and with the frozen columns and the residual.
    phi = np.empty((n_inputs * order, n_total))
    driven_rows(blocks, n_real, drive.copy(), starts, phi)
    gram = np.zeros((m, m))
    on_frozen = np.empty((m, n_frozen + 1))
    _products(phi, phi, _START, n_total, _LOWER, _START, gram[first:, first:])
    _products(phi, frozen, _START, n_total, _ALL, _START, on_frozen[first:, :])
    on_local = np.empty((phi.shape[0], local_q.shape[0]))
    if free:
        response = _free_rows(blocks, n_real, starts)
        placed = np.empty((order, n_total))
        free_on_local = np.empty((order, local_q.shape[0]))

    # Columns of single records: take out the local part, record by record.
    for r in range(n_records):
        lo = starts[r]
        hi = starts[r + 1]
        _products(phi, local_q, lo, hi, _ALL, _START, on_local[:, :])
        _subtract_squares(gram[first:, first:], on_local[:, :], _START)
        if free:
            # Free responses of this record are zero in all others: their products are a block of their own.
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

    # What is left of all products without the frozen columns, and what the new columns so explain.
    _subtract_squares(gram[:, :], on_frozen[:, :n_frozen], _START)
    on_residual = on_frozen[:, n_frozen].copy()
    residual = frozen[n_frozen]
    return float(_dot(residual, residual, _START, n_total) - schur_drop(gram, on_residual))


@numba.njit(**COMPILED, inline="always")
def _local_rows(blocks: Any, n_real: int, polynomials_q: Any, starts: Any) -> Any:
    """Polynomials and free responses (Q + B, N), orthonormal in each record.

    blocks (R + P, 4) of R = n_real real poles and P pairs, B = R + 2 P. polynomials_q (Q, N) are orthonormal
    already; starts (K + 1,). Modified Gram-Schmidt, twice, which is as exact as a factorisation. A free
    response that depends on the rows before it becomes zero, as some do in a record of fewer than Q + B
    samples.
    """
    n_known = polynomials_q.shape[0]
    response = _free_rows(blocks, n_real, starts)
    rows = np.zeros((n_known + response.shape[0], polynomials_q.shape[1]))
    for i in range(n_known):
        _copy(rows[i], polynomials_q[i])
    for r in range(starts.size - 1):
        lo = starts[r]
        hi = starts[r + 1]
        for i in range(n_known, rows.shape[0]):
            part = rows[i, lo:hi]
            _copy(part, response[i - n_known, : hi - lo])
            square_before = _dot(part, part, _START, part.size)
            # Twice is enough: the second pass takes off what rounding left of the first.
            for _ in range(2):
                for j in range(i):
                    _subtract(rows[i], _dot(rows[j], rows[i], lo, hi), rows[j], lo, hi)
            square = _dot(part, part, _START, part.size)
            is_independent = square > _LEAST_LENGTH_OF_FREE_ROW**2 * square_before
            factor = 1 / np.sqrt(square) if is_independent else 0.0
            for k in range(part.size):
                part[k] *= factor
    return rows


@_called
def _take_out_local(target: Any, local_q: Any, starts: Any) -> None:
    """Take the local columns local_q (L, N), orthonormal in each record, out of target (N,), in place.

    starts (K + 1,). Columns that are not orthonormal are taken out by another amount than projection would.
    """
    for r in range(starts.size - 1):
        lo = starts[r]
        hi = starts[r + 1]
        for i in range(local_q.shape[0]):
            _subtract(target, _dot(local_q[i], target, lo, hi), local_q[i], lo, hi)


@_called
def _off_local_products(rows: Any, first: int, local_q: Any, starts: Any, on_local: Any, gram: Any) -> None:
    """Fill gram (R, R) with products of rows `first` .. with all rows before them, local columns taken out.

    rows (R, N); local_q (L, N), orthonormal in each record; starts (K + 1,). on_local (R or more, L K)
    receives the products with local_q, record after record; its first `first` rows are read, from an earlier
    call. Only the lower triangle of gram is right.
    """
    n_local = local_q.shape[0]
    _products(rows, rows, _START, rows.shape[1], _LOWER, first, gram[:, :])
    for r in range(starts.size - 1):
        of_record = on_local[:, r * n_local : (r + 1) * n_local]
        _products(rows, local_q, starts[r], starts[r + 1], _ALL, first, of_record)
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
    """Residual sum of squares J of the fit with all blocks, and its Kaufman linearisation.

    Parameters
    ----------
    blocks : ndarray, shape (R + P, 4)
        Cascade of R = n_real real poles and P pairs; B = R + 2 P.
    n_real : int
        How many of the blocks are real poles; they come first.
    u : ndarray, shape (U, N)
        Inputs.
    y : ndarray, shape (N,)
        Output without its part in polynomials_q.
    starts : ndarray of int, shape (K + 1,)
        Where the records begin, and N.
    polynomials_q : ndarray, shape (Q, N)
        Polynomial columns, orthonormal in each record.
    feedthrough, free : bool
        The fit has a direct term for each input; free responses of all poles in each record.
    below : float
        Only where J is below this, normal and gradient are filled.
    normal, gradient : ndarray, shapes (B, B) and (B,)
        Filled with S^T S and S^T r: S (N, B) the states of each block driven by the fitted output, projected
        off the regression; r (N,) the residual.

    Returns
    -------
    float
        J, square of the unit of the output; -1 if the columns are too dependent for products, one of them is
        zero, or NaN is among them. NaN of y alone gives NaN.

    Notes
    -----
    With the columns Phi as rows, G = Phi Phi^T and e = y - Phi^T G^-1 Phi y,
    r^T r = e^T e - (Phi e)^T G^-1 (Phi e), and

        S P S^T = S S^T - (S Phi^T) G^-1 (Phi S^T),   S r = S e - (S Phi^T) G^-1 (Phi e).

    The terms in Phi e, zero but for rounding, are a step of iterative refinement: with the condition of G
    bounded (`_LEAST_PIVOT`) they bring the precision of an orthogonal factorisation.
    """
    n = normal.shape[0]
    n_inputs = u.shape[0]
    n_total = y.size
    n_columns = n_inputs * (n + (1 if feedthrough else 0))

    # Rows: the columns of the regression, and room below for the directions S of its change.
    rows = np.empty((n_columns + n, n_total))
    local_q = _local_rows(blocks, n_real, polynomials_q, starts) if free else polynomials_q
    output = y.copy()
    if free:
        _take_out_local(output, local_q, starts)
    driven_rows(blocks, n_real, u.copy(), starts, rows)
    if feedthrough:
        for i in range(n_inputs):
            _copy(rows[n_inputs * n + i], u[i])

    # Cholesky factor of their products, in the first rows of gram.
    gram = np.empty((rows.shape[0], rows.shape[0]))
    on_local = np.empty((rows.shape[0], local_q.shape[0] * (starts.size - 1)))
    _off_local_products(rows[:n_columns], _START, local_q, starts, on_local, gram)
    if not factorise(gram, n_columns, _LEAST_PIVOT):
        return -1.0

    # Coefficients theta, and what they leave of the output: e of the text.
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

    # L^-1 Phi e, and J with its step of refinement.
    on_residual = np.empty(rows.shape[0])
    for i in range(n_columns):
        on_residual[i] = _dot(rows[i], residual, _START, n_total)
    forward(gram, n_columns, on_residual)
    rss = _dot(residual, residual, _START, n_total)
    for q in range(n_columns):
        rss -= on_residual[q] ** 2
    if not rss < below:
        return float(rss)

    # Directions S: each block by itself, driven by the fitted output.
    signal = np.empty((1, n_total))
    at = n_columns
    for i in range(blocks.shape[0]):
        is_real = i < n_real
        _copy(signal[0], fitted[0])
        driven_rows(blocks[i : i + 1], 1 if is_real else 0, signal, starts, rows[at:])
        at += 1 if is_real else 2

    # Their products among each other and with the residual, the regression taken out of both.
    _off_local_products(rows, n_columns, local_q, starts, on_local, gram)
    for i in range(n):
        row = gram[n_columns + i]
        forward(gram, n_columns, row)
        gradient[i] = _dot(rows[n_columns + i], residual, _START, n_total)
        for q in range(n_columns):
            gradient[i] -= row[q] * on_residual[q]
        for j in range(i + 1):
            product = row[n_columns + j]
            for q in range(n_columns):
                product -= row[q] * gram[n_columns + j, q]
            normal[i, j] = product
            normal[j, i] = product
    return float(rss)
