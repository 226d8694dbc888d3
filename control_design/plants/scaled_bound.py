"""Worst-case gain over complex matrix blocks of uncertainty: the D-scaled bound at every frequency.

The plant is G + sum_i B_i Delta_i L_i with |Delta_i| <= 1. With v at the plant's output, x = S v and y = K x,

    A(t) = S^H (K^H (V_u + sum_i L_i^H L_i / t_i) K + V_y) S,   C(t) = sum_i t_i B_i B_i^H,

the weighted gain is at most gamma where A <= (C + I / gamma^2)^-1, for any t_i > 0: gamma^2 = largest
eigenvalue of (A^-1 - C)^-1, whose logarithm is convex in log t. The smallest bound is the worst case itself
for one or two blocks (with the performance three), an upper bound beyond (Packard and Doyle, Automatica 29,
1993).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from control_design.plants.ellipses import Boolean, Integer
from ident.data.arrays import COMPILED, INSIDE

Array = npt.NDArray[Any]  # real or complex

_STEPS = 40  # of Newton's method in log t; 3 to 8 are usual
_FINE = 1e-4  # shift of log t in the difference quotient of the slope
_LONGEST = 2.0  # step in log t


def conjugate(matrix: Array) -> Array:
    """Conjugate transpose of the last two axes."""
    return np.asarray(np.conj(np.swapaxes(matrix, -1, -2)))


def apply(matrix: Array, vector: Array) -> Array:
    """Matrices (..., M, N) times vectors (..., N)."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class BoundRows:
    """R weighted requirements at one frequency each: nominal response G (R, Y, U); seen (R, N, U, U) =
    L_i^H L_i and entering (R, N, Y, Y) = B_i B_i^H of N blocks; V_y (R, Y, Y) and V_u (R, U, U), Gram
    matrices of the weights on S and K S. together: the blocks grow with 1/gamma as the performance does (mu)
    instead of keeping their size (worst-case gain)."""

    G: Array
    seen: Array
    entering: Array
    V_y: Array
    V_u: Array
    together: bool
    base: Array | None = None  # (R, Y, Y): Gram matrix of how the performance input enters, None = identity

    def part(self, index: Integer | Boolean) -> BoundRows:
        """Some of them."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return BoundRows(**{k: v if k == "together" or v is None else v[index] for k, v in values.items()})


@dataclass(frozen=True, eq=False)
class Bound:
    """gamma (R,), inf where no scaling shows stability; log_t (R, N) of the scalings; right (R, Y): the worst
    output, which the controller answers with K right."""

    gamma: Array
    log_t: Array
    right: Array


def stability_bound(rows: BoundRows, K: Array) -> Array:
    """mu of the blocks alone (R,): the loop is stable for all blocks of size one where it stays below 1, and
    tolerates them enlarged by its inverse. The last block stands for the performance."""
    last = rows.entering[:, -1]
    jitter = 1e-12 * np.trace(last, axis1=1, axis2=2).real[:, None, None] * np.eye(last.shape[1])
    alone = BoundRows(
        rows.G, rows.seen[:, :-1], rows.entering[:, :-1], 0 * rows.V_y, rows.seen[:, -1], True, last + jitter
    )  # fmt: skip
    return scaled_bound(alone, K).gamma


def structured_norm(M: Array) -> Array:
    """min over diagonal D of the largest singular value of D M D^-1, (F,) for M (F, n, n): mu up to n = 3."""
    count, n = M.shape[0], M.shape[1]
    each = np.broadcast_to(np.eye(n)[:, :, None] * np.eye(n)[:, None, :], (count, n, n, n)).astype(
        np.complex128
    )
    rows = BoundRows(np.zeros_like(M), each, each, np.zeros((count, n, n)), np.zeros((count, n, n)), True)
    return stability_bound(rows, M)


def scaled_bound(rows: BoundRows, K: Array, log_t: Array | None = None, *, accuracy: float = 1e-9) -> Bound:
    """Smallest bound over the scalings for controller values K (R, U, Y), to a relative accuracy of gamma.

    log_t (R, N): where to begin; None: from the sizes of the blocks. Neglected: rounding.
    """
    eye = np.eye(K.shape[2])
    S = np.linalg.inv(eye + rows.G @ K)
    KS = K @ S
    seen = conjugate(KS)[:, None] @ rows.seen @ KS[:, None]  # (R, N, Y, Y)
    own = conjugate(KS) @ rows.V_u @ KS + conjugate(S) @ rows.V_y @ S
    base = np.broadcast_to(eye, S.shape) if rows.base is None else rows.base
    given = (np.ascontiguousarray(each, dtype=np.complex128) for each in (own, seen, rows.entering, base))
    t = np.full(seen.shape[:2], np.nan) if log_t is None else np.array(log_t, dtype=np.float64)
    value, s = _lowest(*given, rows.together, accuracy, t)
    return Bound(np.sqrt(np.exp(value)), t, apply(S, s))


def largest_channel(rows: BoundRows, K: Array, right: Array) -> Integer:
    """Output (weight on S) or actuator (weight on K S) that carries most of each worst case (R,); right: of
    its `Bound`."""
    shares = [
        np.diagonal(weight, axis1=1, axis2=2).real * np.abs(signal) ** 2
        for weight, signal in ((rows.V_y, right), (rows.V_u, apply(K, right)))
    ]
    of_y, of_u = (np.argmax(share, axis=1) for share in shares)
    return np.asarray(np.where(np.any(rows.V_u, axis=(1, 2)), of_u, of_y))


@dataclass(frozen=True, eq=False)
class Expansion:
    """The matrix H = (A^-1 - C)^-1 (R, Y, Y), whose largest eigenvalue is gamma^2, to first order:
    dH = left^H dK right + (.)^H + sum_i in_t_i d log t_i; left (R, U, Y), right (R, Y, Y), in_t (R, N, Y,
    Y)."""

    H: Array
    left: Array
    right: Array
    in_t: Array


def expansion(rows: BoundRows, K: Array, log_t: Array) -> Expansion:
    """Around controller values K (R, U, Y) and scalings log_t (R, N); worst-case gain only."""
    eye = np.eye(K.shape[2])
    S = np.linalg.inv(eye + rows.G @ K)
    t = np.exp(log_t)[:, :, None, None]
    V, C = rows.V_u + np.sum(rows.seen / t, axis=1), np.sum(t * rows.entering, axis=1)
    KS = K @ S
    A = conjugate(KS) @ V @ KS + conjugate(S) @ rows.V_y @ S
    Z = np.linalg.inv(eye - C @ A)
    H, right = A @ Z, S @ Z
    y = K @ right
    pulled = V @ y
    left = pulled - conjugate(S @ rows.G) @ (conjugate(K) @ pulled + rows.V_y @ right)
    falls = conjugate(y)[:, None] @ rows.seen @ y[:, None] / t
    rises = t * (conjugate(H)[:, None] @ rows.entering @ H[:, None])
    return Expansion(0.5 * (H + conjugate(H)), left, right, rises - falls)


@numba.njit(**COMPILED)
def _lowest(
    own: Array, seen: Array, entering: Array, base: Array, together: bool, accuracy: float, log_t: Array
) -> tuple[Array, Array]:
    """log gamma^2 (R,) at the best scalings, which log_t (R, N) holds afterwards (nan: look for a start), and
    s (R, Y) with d gamma^2 = s^H dA s. Row by row: numpy's calls would cost more than the arithmetic."""
    count, n = log_t.shape
    value, s = np.full(count, np.inf), np.zeros((count, own.shape[1]), dtype=np.complex128)
    work = np.empty((7, own.shape[1], own.shape[1]), dtype=np.complex128)
    p, slope = np.empty(own.shape[1], dtype=np.complex128), np.empty(n)
    for r in range(count):
        of = own[r], seen[r], entering[r], base[r], together
        value[r] = _at(log_t[r], *of, work, s[r], p, slope)
        if n and not np.isfinite(value[r]):
            _begin(*of, log_t[r])
            value[r] = _at(log_t[r], *of, work, s[r], p, slope)
            for _ in range(12):  # towards small t, where robust stability alone counts
                if together or np.isfinite(value[r]):
                    break
                log_t[r] -= 3.0
                value[r] = _at(log_t[r], *of, work, s[r], p, slope)
        if not np.isfinite(value[r]):
            continue
        if n == 1:
            value[r] = _bracketed(log_t[r], value[r], slope, accuracy, of, work, s[r], p)
        elif n:
            value[r] = _newton(log_t[r], value[r], slope, accuracy, of, work, s[r], p)
    return value, s


@numba.njit(**INSIDE)
def _begin(own: Array, seen: Array, entering: Array, base: Array, together: bool, log_t: Array) -> None:
    """Scalings of stationarity for blocks and performance that have one direction each."""
    whole, total = _trace(own), 0.0
    for i in range(log_t.size):
        sees, enters = np.sqrt(_trace(seen[i])), np.sqrt(_trace(entering[i]))
        total += sees * enters
        log_t[i] = np.log(max(sees, 1e-150) / max(enters * whole, 1e-150))
    if not together:
        log_t += np.log(max(1.0 - total, 0.05))


@numba.njit(**INSIDE)
def _bracketed(
    log_t: Array, least: float, slope: Array, accuracy: float, of: Any, work: Array, s: Array, p: Array
) -> float:
    """One scaling: steps of the secant of the slope, within a bracket of its sign: kinks (two eigenvalues
    that cross) do no harm."""
    low, high, here, bend, rise = -np.inf, np.inf, log_t[0], 0.5, slope[0]
    trial, tried = log_t.copy(), s.copy()
    for _ in range(_STEPS):
        if rise < 0:
            low = here
        else:
            high = here
        width = high - low
        step = min(max(-rise / bend, -3.0), 3.0) if np.isfinite(rise) else -1.0
        edge = 0.05 * min(width, 1.0)
        trial[0] = here + step
        if np.isfinite(width) and not (low + edge < trial[0] < high - edge):
            trial[0] = 0.5 * (low + high)
        gain = (abs(rise) if np.isfinite(rise) else 1.0) * min(abs(trial[0] - here), width)
        if gain <= accuracy:
            break
        value = _at(trial, *of, work, tried, p, slope)
        new = slope[0] if np.isfinite(value) else np.inf
        bent = (new - rise) / (trial[0] - here)
        bend = min(max(bent, 0.02), 1e6) if np.isfinite(bent) else bend
        here, rise = trial[0], new
        if value < least:
            least, log_t[0] = value, here
            s[:] = tried
    return least


@numba.njit(**INSIDE)
def _newton(
    log_t: Array, least: float, slope: Array, accuracy: float, of: Any, work: Array, s: Array, p: Array
) -> float:
    """Several scalings: Newton's method with a curvature from differences of slopes."""
    n = log_t.size
    bent, axes = np.empty((n, n), dtype=np.complex128), np.empty((n, n), dtype=np.complex128)
    moved, step, trial, tried = np.empty(n), np.empty(n), log_t.copy(), s.copy()
    for _ in range(_STEPS):
        for i in range(n):
            trial[:] = log_t
            trial[i] -= _FINE
            near = _at(trial, *of, work, tried, p, moved)
            for j in range(n):
                bent[j, i] = (slope[j] - moved[j]) / _FINE if np.isfinite(near) else 0.0
        for i in range(n):
            for j in range(i):
                bent[i, j] = bent[j, i] = 0.5 * (bent[i, j] + bent[j, i])
        _diagonalise(bent, axes)
        step[:] = 0.0
        for i in range(n):
            axis = axes[:, i].real
            step -= axis * np.sum(axis * slope) / max(abs(bent[i, i].real), 1e-3)
        step *= min(1.0, _LONGEST / max(np.max(np.abs(step)), 1e-300))
        promised = -np.sum(step * slope)
        better = False
        for _ in range(8):
            trial[:] = log_t + step
            value = _at(trial, *of, work, tried, p, moved)
            if value < least:
                least, better = value, True
                log_t[:], slope[:], s[:] = trial, moved, tried
                break
            step *= 0.3
            promised *= 0.3
            if promised <= accuracy:
                break
        if not better or promised <= accuracy:
            break
    return least


@numba.njit(**INSIDE)
def _at(
    log_t: Array, own: Array, seen: Array, entering: Array, base: Array, together: bool,
    work: Array, s: Array, p: Array, slope: Array,
) -> float:  # fmt: skip
    """log gamma^2 at scalings log_t (N,), its slope there (N,), and s (Y,); inf where they show no stability
    (nan among them: too)."""
    size = own.shape[0]
    A, C, root, inside, other, H, axes = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    A[:], C[:] = own, 0.0
    for i in range(log_t.size):
        if not np.isfinite(log_t[i]):
            return np.inf
        t = np.exp(min(max(log_t[i], -300.0), 300.0))
        for j in range(size):
            for k in range(size):
                A[j, k] += seen[i, j, k] / t
                C[j, k] += t * entering[i, j, k]
    if together:
        inside[:] = C + base
        if not _factored(inside, root, 0.0):
            return np.inf
        _congruence(root, A, other, H)
    else:
        inside[:] = A
        jitter = 1e-14 * _trace(A) + 1e-290
        for j in range(size):
            inside[j, j] += jitter
        if not _factored(inside, root, 0.0):
            return np.inf
        # I - R^H C R > 0: the loop is stable for all blocks of size one.
        _congruence(root, C, other, inside)
        for j in range(size):
            for k in range(size):
                inside[j, k] = (1.0 if j == k else 0.0) - inside[j, k]
        if not _factored(inside, other, 1e-12):
            return np.inf
        # H = R (I - R^H C R)^-1 R^H, by T = M^-1 R^H.
        for k in range(size):
            for j in range(size):
                total = np.conj(root[k, j])
                for m in range(j):
                    total -= other[j, m] * axes[m, k]
                axes[j, k] = total / other[j, j]
        for j in range(size):
            for k in range(size):
                H[j, k] = 0.0
                for m in range(size):
                    H[j, k] += np.conj(axes[m, j]) * axes[m, k]
    _diagonalise(H, axes)
    best = np.argmax(np.diag(H).real)
    top = max(H[best, best].real, 1e-300)
    if together:
        for j in range(size - 1, -1, -1):
            s[j] = np.sum(root[j] * axes[:, best])
            p[j] = axes[j, best] * np.sqrt(top)
            for k in range(j + 1, size):
                p[j] -= np.conj(root[k, j]) * p[k]
            p[j] /= root[j, j]
    else:
        p[:] = top * axes[:, best]
        for j in range(size):
            s[j] = axes[j, best] + np.sum(C[j] * p)
    for i in range(log_t.size):
        t = np.exp(min(max(log_t[i], -300.0), 300.0))
        slope[i] = (t * _form(entering[i], p) - _form(seen[i], s) / t) / top
    return float(np.log(top))


@numba.njit(**INSIDE)
def _trace(matrix: Array) -> float:
    total = 0.0
    for j in range(matrix.shape[0]):
        total += matrix[j, j].real
    return total


@numba.njit(**INSIDE)
def _form(matrix: Array, vector: Array) -> float:
    """vector^H matrix vector, matrix Hermitian."""
    total = 0.0
    for j in range(vector.size):
        for k in range(vector.size):
            total += (np.conj(vector[j]) * matrix[j, k] * vector[k]).real
    return total


@numba.njit(**INSIDE)
def _congruence(root: Array, matrix: Array, product: Array, found: Array) -> None:
    """found = root^H matrix root, root lower triangular."""
    size = root.shape[0]
    for j in range(size):
        for k in range(size):
            product[j, k] = 0.0
            for m in range(k, size):
                product[j, k] += matrix[j, m] * root[m, k]
    for j in range(size):
        for k in range(size):
            found[j, k] = 0.0
            for m in range(j, size):
                found[j, k] += np.conj(root[m, j]) * product[m, k]


@numba.njit(**INSIDE)
def _factored(matrix: Array, root: Array, least: float) -> bool:
    """Cholesky's factor, lower triangular; false where a pivot is not above `least`."""
    size = matrix.shape[0]
    for j in range(size):
        for k in range(j + 1):
            total = matrix[j, k]
            for m in range(k):
                total -= root[j, m] * np.conj(root[k, m])
            if k < j:
                root[j, k], root[k, j] = total / root[k, k], 0.0
            elif not total.real > least:
                return False
            else:
                root[j, j] = np.sqrt(total.real)
    return True


@numba.njit(**INSIDE)
def _diagonalise(matrix: Array, axes: Array) -> None:
    """Jacobi's rotations of a Hermitian matrix, in place to its eigenvalues, and axes (columns) to them."""
    size = matrix.shape[0]
    for j in range(size):
        for k in range(size):
            axes[j, k] = 1.0 if j == k else 0.0
    for _ in range(30):  # sweeps; three to six are usual
        off = 0.0
        for j in range(size):
            for k in range(j + 1, size):
                part = abs(matrix[j, k])
                sizes = abs(matrix[j, j].real) + abs(matrix[k, k].real)
                if part <= 1e-16 * sizes or part < 1e-290:
                    continue
                off = max(off, part / sizes)
                phase = matrix[j, k] / part
                lean = (matrix[k, k].real - matrix[j, j].real) / (2 * part)
                tangent = (1.0 if lean >= 0 else -1.0) / (abs(lean) + np.sqrt(1 + lean * lean))
                c = 1 / np.sqrt(1 + tangent * tangent)
                turn = tangent * c * phase
                for m in range(size):
                    first, second = matrix[m, j], matrix[m, k]
                    matrix[m, j], matrix[m, k] = c * first - np.conj(turn) * second, turn * first + c * second
                    first, second = axes[m, j], axes[m, k]
                    axes[m, j], axes[m, k] = c * first - np.conj(turn) * second, turn * first + c * second
                for m in range(size):
                    first, second = matrix[j, m], matrix[k, m]
                    matrix[j, m], matrix[k, m] = c * first - turn * second, np.conj(turn) * first + c * second
                matrix[j, k] = matrix[k, j] = 0.0
        if off < 1e-15:
            break
