"""Worst-case gain over complex matrix blocks of uncertainty: the D-scaled bound at every frequency.

`BoundRows` holds R requirements, each at one frequency, on a plant with N uncertain blocks; `scaled_bound`
gives the bound of each for the values of a controller. Its scalings are found by Newton's method on a convex
function, row by row in compiled loops. `stability_bound` and `structured_norm` are the same bound without a
performance (mu); `expansion` linearises it for a descent over the controller.

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

# Most steps of Newton's method, or of the secant, in log t. Usual are 3 to 8; whatever the last one, the
# bound holds, so more would only make it tighter where it is flat.
_MOST_STEPS = 40

# Shift of log t in the difference quotient of the slope: about the fourth root of the rounding error, at
# which the errors of rounding and of curvature balance.
_DIFFERENCE_STEP = 1e-4

# Longest step of each log t: a factor of 7 in a scaling. A quadratic model holds no further.
_LONGEST_STEP = 2.0

# Longest step of the secant of a single scaling, a factor of 20; it is bracketed, so it may be longer.
_LONGEST_SECANT_STEP = 3.0

# Shortenings of a step that promised a decrease and had none, and the factor of each: 0.3^8 = 6e-5.
_MOST_SHORTENINGS = 8

# Factor of each of them. Chosen: between the usual half, which needs twice as many, and a tenth.
_SHORTENING = 0.3

# Where no scaling shows stability, all are made e^3 = 20 times smaller, up to so many times, towards scalings
# at which robust stability alone counts.
_MOST_SHRINKINGS = 12

# Step in log t of each of them.
_SHRINKING = 3.0

# Smallest curvature that a step divides by, relative to the logarithm of gamma^2: flatter ones are rounding.
_SMALLEST_CURVATURE = 1e-3

# Scalings stay within e^+-300, so that no product of two overflows.
_LARGEST_LOG_T = 300.0

# Diagonal of a Gram matrix that is nearly singular, relative to its trace: lets Cholesky's factor exist.
_JITTER_SHARE = 1e-14

# The same share for a block that stands for the performance: of rank one, whose inverse enters the bound.
_BLOCK_JITTER_SHARE = 1e-12

# A pivot of I - R^H C R below this is no proof of stability: some thousand times the rounding of a number
# near one.
_LEAST_PIVOT = 1e-12

# Most sweeps of Jacobi's rotations; three to six are usual.
_MOST_SWEEPS = 30


def conjugate(matrix: Array) -> Array:
    """Conjugate transpose of the last two axes.

    Of a vector numpy raises an error.
    """
    return np.asarray(np.conj(np.swapaxes(matrix, -1, -2)))


def apply(matrix: Array, vector: Array) -> Array:
    """Matrices (..., M, N) times vectors (..., N).

    Shapes that do not fit are numpy's ValueError.
    """
    return np.asarray((matrix @ vector[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class BoundRows:
    """R weighted requirements, each at one frequency, on a plant with U inputs, Y outputs and N uncertain
    blocks.

    Parameters
    ----------
    G : (R, Y, U) complex array
        Nominal response.
    seen : (R, N, U, U) complex array
        L_i^H L_i: what each block sees of the input.
    entering : (R, N, Y, Y) complex array
        B_i B_i^H: how each block enters the output.
    V_y, V_u : (R, Y, Y), (R, U, U) array
        Gram matrices of the weights on S and on K S.
    together : bool
        The blocks grow with 1/gamma as the performance does (mu), instead of keeping their size (worst-case
        gain).
    base : (R, Y, Y) array or None
        Gram matrix of how the performance input enters; None: identity.

    Notes
    -----
    Shapes are not checked: who makes the rows takes them from one plant (`MultivariablePlant.blocks`).
    """

    G: Array
    seen: Array
    entering: Array
    V_y: Array
    V_u: Array
    together: bool
    base: Array | None = None

    def part(self, index: Integer | Boolean) -> BoundRows:
        """The rows at the given positions, integers or a mask (R,).

        IndexError for a position that is not there.
        """
        chosen = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "together" and value is not None:
                value = value[index]
            chosen[field.name] = value
        return BoundRows(**chosen)


@dataclass(frozen=True, eq=False)
class Bound:
    """Bounds of R requirements and what attains them.

    Parameters
    ----------
    gamma : (R,) array
        Bound of the weighted gain; inf where no scaling shows stability.
    log_t : (R, N) array
        Logarithms of the scalings that give it.
    right : (R, Y) complex array
        Worst output, which the controller answers with K right.
    """

    gamma: Array
    log_t: Array
    right: Array


def stability_bound(rows: BoundRows, K: Array) -> Array:
    """Structured singular value mu of the blocks alone, (R,), for controller values K (R, U, Y).

    Where it stays below 1 the loop is stable for all blocks of size one, and it tolerates them enlarged by
    its inverse. The last block takes the place of the performance, whose weights are not used.

    No unit. IndexError without any block.
    """
    last = rows.entering[:, -1]
    trace = np.trace(last, axis1=1, axis2=2).real[:, None, None]
    jitter = _BLOCK_JITTER_SHARE * trace * np.eye(last.shape[1])
    blocks_only = BoundRows(
        G=rows.G,
        seen=rows.seen[:, :-1],
        entering=rows.entering[:, :-1],
        V_y=0 * rows.V_y,
        V_u=rows.seen[:, -1],
        together=True,
        base=last + jitter,
    )
    return scaled_bound(blocks_only, K).gamma


def structured_norm(M: Array) -> Array:
    """Smallest largest singular value of D M D^-1 over diagonal D, (F,), for M (F, n, n) complex.

    It is the structured singular value of M for n scalar blocks up to n = 3, and an upper bound of it beyond.

    Not checked: nan gives inf.
    """
    count = M.shape[0]
    n = M.shape[1]
    # Block i sees and enters channel i alone: e_i e_i^T.
    axes = np.eye(n)[:, :, None] * np.eye(n)[:, None, :]
    blocks = np.broadcast_to(axes, (count, n, n, n)).astype(np.complex128)
    no_weight = np.zeros((count, n, n))
    rows = BoundRows(np.zeros_like(M), blocks, blocks, no_weight, no_weight, True)
    return stability_bound(rows, M)


def scaled_bound(rows: BoundRows, K: Array, log_t: Array | None = None, *, accuracy: float = 1e-9) -> Bound:
    """Smallest bound of each requirement over the scalings.

    Parameters
    ----------
    rows : BoundRows
        R requirements.
    K : (R, U, Y) complex array
        Values of the controller at their frequencies.
    log_t : (R, N) array or None
        Where to begin; None: from the sizes of the blocks.
    accuracy : float
        Of log gamma^2, hence relative of gamma: 1e-9 is beyond what anybody reads. Chosen.

    Returns
    -------
    Bound
        Every gamma is a bound, whatever the scalings; inf where no scaling shows stability, or a value is not
        finite.

    Raises
    ------
    LinAlgError
        By numpy, where I + G K is singular exactly. Shapes are not checked.

    Notes
    -----
    The formula stands at the head of this file. Neglected: rounding.
    """
    identity = np.eye(K.shape[2])
    S = np.linalg.inv(identity + rows.G @ K)
    KS = K @ S
    seen = conjugate(KS)[:, None] @ rows.seen @ KS[:, None]
    performance = conjugate(KS) @ rows.V_u @ KS + conjugate(S) @ rows.V_y @ S
    base = np.broadcast_to(identity, S.shape) if rows.base is None else rows.base
    scalings = np.full(seen.shape[:2], np.nan) if log_t is None else np.array(log_t, dtype=np.float64)
    log_gamma_square, s = _lowest(
        np.ascontiguousarray(performance, dtype=np.complex128),
        np.ascontiguousarray(seen, dtype=np.complex128),
        np.ascontiguousarray(rows.entering, dtype=np.complex128),
        np.ascontiguousarray(base, dtype=np.complex128),
        rows.together,
        accuracy,
        scalings,
    )
    return Bound(np.sqrt(np.exp(log_gamma_square)), scalings, apply(S, s))


def largest_channel(rows: BoundRows, K: Array, right: Array) -> Integer:
    """Number (R,) of the output (of a weight on S) or actuator (of one on K S) that carries most of a worst
    case.

    K : (R, U, Y) controller values. right : (R, Y) worst outputs of a `Bound`.

    Shapes are not checked; nan counts as the largest.
    """
    output_weight = np.diagonal(rows.V_y, axis1=1, axis2=2).real
    actuator_weight = np.diagonal(rows.V_u, axis1=1, axis2=2).real
    output = np.argmax(output_weight * np.abs(right) ** 2, axis=1)
    actuator = np.argmax(actuator_weight * np.abs(apply(K, right)) ** 2, axis=1)
    weighs_actuators = np.any(rows.V_u, axis=(1, 2))
    return np.asarray(np.where(weighs_actuators, actuator, output))


@dataclass(frozen=True, eq=False)
class Expansion:
    """The matrix H = (A^-1 - C)^-1, whose largest eigenvalue is gamma^2, and its change to first order.

    dH = left^H dK right + (left^H dK right)^H + sum_i in_t_i d log t_i.

    Parameters
    ----------
    H : (R, Y, Y) complex array
        Hermitian.
    left, right : (R, U, Y), (R, Y, Y) complex array
        Factors of a change dK (R, U, Y) of the controller.
    in_t : (R, N, Y, Y) complex array
        Derivatives by the logarithms of the scalings.
    """

    H: Array
    left: Array
    right: Array
    in_t: Array


def expansion(rows: BoundRows, K: Array, log_t: Array) -> Expansion:
    """Linearisation of the bound around controller values K (R, U, Y) and scalings log_t (R, N).

    For worst-case gain only: rows.together is false and rows.base None (not checked). LinAlgError of numpy
    where the loop is singular; scalings that show no stability give matrices that mean nothing.
    """
    identity = np.eye(K.shape[2])
    S = np.linalg.inv(identity + rows.G @ K)
    t = np.exp(log_t)[:, :, None, None]
    V = rows.V_u + np.sum(rows.seen / t, axis=1)
    C = np.sum(t * rows.entering, axis=1)
    KS = K @ S
    A = conjugate(KS) @ V @ KS + conjugate(S) @ rows.V_y @ S
    Z = np.linalg.inv(identity - C @ A)
    H = A @ Z
    right = S @ Z
    # Actuator signals of the worst outputs, and what the weights and blocks make of them.
    y = K @ right
    pulled = V @ y
    left = pulled - conjugate(S @ rows.G) @ (conjugate(K) @ pulled + rows.V_y @ right)
    falls = conjugate(y)[:, None] @ rows.seen @ y[:, None] / t
    rises = t * (conjugate(H)[:, None] @ rows.entering @ H[:, None])
    return Expansion(0.5 * (H + conjugate(H)), left, right, rises - falls)


@numba.njit(**COMPILED)
def _lowest(
    performance: Array,
    seen: Array,
    entering: Array,
    base: Array,
    together: bool,
    accuracy: float,
    log_t: Array,
) -> tuple[Array, Array]:
    """log gamma^2 (R,) at the best scalings, and s (R, Y) with d gamma^2 = s^H dA s.

    performance (R, Y, Y) is A without the blocks; seen and entering (R, N, Y, Y) are the blocks through the
    loop; base (R, Y, Y). log_t (R, N) holds the best scalings afterwards; nan in it: a start is looked for.
    Row by row: numpy's calls would cost more than the arithmetic. Inf, and s without meaning, where no
    scaling shows stability. Shapes are not checked, and indices not bounded.
    """
    count, n = log_t.shape
    size = performance.shape[1]
    value = np.full(count, np.inf)
    s = np.zeros((count, size), dtype=np.complex128)
    # Seven matrices and two vectors that every evaluation writes over.
    work = np.empty((7, size, size), dtype=np.complex128)
    p = np.empty(size, dtype=np.complex128)
    slope = np.empty(n)
    for r in range(count):
        problem = performance[r], seen[r], entering[r], base[r], together
        value[r] = _at(log_t[r], *problem, work, s[r], p, slope)
        if n and not np.isfinite(value[r]):
            _begin(*problem, log_t[r])
            value[r] = _at(log_t[r], *problem, work, s[r], p, slope)
            for _ in range(_MOST_SHRINKINGS):
                if together or np.isfinite(value[r]):
                    break
                log_t[r] -= _SHRINKING
                value[r] = _at(log_t[r], *problem, work, s[r], p, slope)
        if not np.isfinite(value[r]):
            continue
        if n == 1:
            value[r] = _bracketed(log_t[r], value[r], slope, accuracy, problem, work, s[r], p)
        elif n:
            value[r] = _newton(log_t[r], value[r], slope, accuracy, problem, work, s[r], p)
    return value, s


@numba.njit(**INSIDE)
def _begin(
    performance: Array, seen: Array, entering: Array, base: Array, together: bool, log_t: Array
) -> None:
    """Write scalings to begin with into log_t (N,): the stationary ones for blocks and a performance that
    have one direction each. base is not used; it is here so that all functions of a problem take the same
    parts.

    performance (Y, Y), seen and entering (N, Y, Y). A nan in them shows no stability in `_at`.
    """
    whole = _trace(performance)
    total = 0.0
    for i in range(log_t.size):
        sees = np.sqrt(_trace(seen[i]))
        enters = np.sqrt(_trace(entering[i]))
        total += sees * enters
        # Both above 1e-150, so that the quotient and its square stay in the range of doubles.
        log_t[i] = np.log(max(sees, 1e-150) / max(enters * whole, 1e-150))
    # Blocks of fixed size leave 1 - total to the performance. Where that is nothing a twentieth (chosen) is
    # tried; smaller scalings follow if stability does not show.
    if not together:
        log_t += np.log(max(1.0 - total, 0.05))


@numba.njit(**INSIDE)
def _bracketed(
    log_t: Array, lowest: float, slope: Array, accuracy: float, problem: Any, work: Array, s: Array, p: Array
) -> float:
    """Lowest log gamma^2 over one scaling; log_t (1,) and s (Y,) hold what attains it.

    lowest and slope (1,) are value and derivative at log_t; problem: performance, seen, entering, base,
    together of one row; work, p: memory. Steps of the secant of the slope, within a bracket of its sign:
    kinks (two eigenvalues that cross) do no harm.

    Nothing is checked: value and slope at the start are finite.
    """
    low = -np.inf
    high = np.inf
    here = log_t[0]
    rise = slope[0]
    # Curvature of the logarithm of a sum of t and 1/t is between 0 and 1: their middle, until a secant tells
    # it.
    curvature = 0.5
    trial = log_t.copy()
    trial_s = s.copy()
    for _ in range(_MOST_STEPS):
        # An infinite slope, no stability, says that the scaling is too large.
        if rise < 0:
            low = here
        else:
            high = here
        width = high - low
        # Without a slope: towards smaller scalings, by a factor of e.
        step = -1.0
        promised_slope = 1.0
        if np.isfinite(rise):
            step = min(max(-rise / curvature, -_LONGEST_SECANT_STEP), _LONGEST_SECANT_STEP)
            promised_slope = abs(rise)
        # Next to an end of the bracket, within a twentieth of it (chosen), a step would shorten it by
        # nothing: its middle instead.
        edge = 0.05 * min(width, 1.0)
        trial[0] = here + step
        if np.isfinite(width) and not (low + edge < trial[0] < high - edge):
            trial[0] = 0.5 * (low + high)
        promised = promised_slope * min(abs(trial[0] - here), width)
        if promised <= accuracy:
            break
        value = _at(trial, *problem, work, trial_s, p, slope)
        trial_rise = slope[0] if np.isfinite(value) else np.inf
        secant = (trial_rise - rise) / (trial[0] - here)
        # Between a nearly flat function and a kink; the limits are chosen, steps are bounded anyway.
        if np.isfinite(secant):
            curvature = min(max(secant, 0.02), 1e6)
        here = trial[0]
        rise = trial_rise
        if value < lowest:
            lowest = value
            log_t[0] = here
            s[:] = trial_s
    return lowest


@numba.njit(**INSIDE)
def _newton(
    log_t: Array, lowest: float, slope: Array, accuracy: float, problem: Any, work: Array, s: Array, p: Array
) -> float:
    """Lowest log gamma^2 over N scalings; log_t (N,), slope (N,) and s (Y,) hold what attains it.

    The arguments are those of `_bracketed`. Newton's method with a curvature from differences of slopes.

    Nothing is checked: value and slope at the start are finite.
    """
    n = log_t.size
    curvature = np.empty((n, n), dtype=np.complex128)
    axes = np.empty((n, n), dtype=np.complex128)
    trial_slope = np.empty(n)
    step = np.empty(n)
    trial = log_t.copy()
    trial_s = s.copy()
    for _ in range(_MOST_STEPS):
        # Curvature, towards smaller scalings, where stability shows; zero where it does not even there.
        for i in range(n):
            trial[:] = log_t
            trial[i] -= _DIFFERENCE_STEP
            value = _at(trial, *problem, work, trial_s, p, trial_slope)
            for j in range(n):
                curvature[j, i] = 0.0
                if np.isfinite(value):
                    curvature[j, i] = (slope[j] - trial_slope[j]) / _DIFFERENCE_STEP
        for i in range(n):
            for j in range(i):
                mean = 0.5 * (curvature[i, j] + curvature[j, i])
                curvature[i, j] = mean
                curvature[j, i] = mean
        # The step along each axis of curvature, whose sign does not matter: the function is convex but for
        # rounding and kinks. 1e-300 below keeps a step of zero from dividing by it.
        _diagonalise(curvature, axes)
        step[:] = 0.0
        for i in range(n):
            axis = axes[:, i].real
            step -= axis * np.sum(axis * slope) / max(abs(curvature[i, i].real), _SMALLEST_CURVATURE)
        step *= min(1.0, _LONGEST_STEP / max(np.max(np.abs(step)), 1e-300))
        promised = -np.sum(step * slope)
        improved = False
        for _ in range(_MOST_SHORTENINGS):
            trial[:] = log_t + step
            value = _at(trial, *problem, work, trial_s, p, trial_slope)
            if value < lowest:
                lowest = value
                improved = True
                log_t[:] = trial
                slope[:] = trial_slope
                s[:] = trial_s
                break
            step *= _SHORTENING
            promised *= _SHORTENING
            if promised <= accuracy:
                break
        if not improved or promised <= accuracy:
            break
    return lowest


@numba.njit(**INSIDE)
def _at(
    log_t: Array,
    performance: Array,
    seen: Array,
    entering: Array,
    base: Array,
    together: bool,
    work: Array,
    s: Array,
    p: Array,
    slope: Array,
) -> float:
    """log gamma^2 at scalings log_t (N,); inf where they show no stability, or where one of them is nan.

    Written into: slope (N,), its derivative by log_t, and s (Y,), with d gamma^2 = s^H dA s. work (7, Y, Y)
    and p (Y,) are memory. With R the Cholesky factor of A, gamma^2 is the largest eigenvalue of H = R (I -
    R^H C R)^-1 R^H; for blocks that grow together with the performance it is that of R^H A R with R the
    factor of C + base.
    """
    size = performance.shape[0]
    A = work[0]
    C = work[1]
    root = work[2]
    inside = work[3]
    product = work[4]
    H = work[5]
    axes = work[6]
    A[:] = performance
    C[:] = 0.0
    for i in range(log_t.size):
        if not np.isfinite(log_t[i]):
            return np.inf
        t = np.exp(min(max(log_t[i], -_LARGEST_LOG_T), _LARGEST_LOG_T))
        for j in range(size):
            for k in range(size):
                A[j, k] += seen[i, j, k] / t
                C[j, k] += t * entering[i, j, k]
    if together:
        inside[:] = C + base
        if not _factored(inside, root, 0.0):
            return np.inf
        _congruence(root, A, product, H)
    else:
        inside[:] = A
        # 1e-290 where nothing is asked and A is zero.
        jitter = _JITTER_SHARE * _trace(A) + 1e-290
        for j in range(size):
            inside[j, j] += jitter
        if not _factored(inside, root, 0.0):
            return np.inf
        # I - R^H C R > 0: the loop is stable for all blocks of size one.
        _congruence(root, C, product, inside)
        for j in range(size):
            for k in range(size):
                identity = 1.0 if j == k else 0.0
                inside[j, k] = identity - inside[j, k]
        if not _factored(inside, product, _LEAST_PIVOT):
            return np.inf
        # H = R (I - R^H C R)^-1 R^H = T^H T, with T = M^-1 R^H and M the factor in `product`.
        for k in range(size):
            for j in range(size):
                total = np.conj(root[k, j])
                for m in range(j):
                    total -= product[j, m] * axes[m, k]
                axes[j, k] = total / product[j, j]
        for j in range(size):
            for k in range(size):
                H[j, k] = 0.0
                for m in range(size):
                    H[j, k] += np.conj(axes[m, j]) * axes[m, k]
    _diagonalise(H, axes)
    best = np.argmax(np.diag(H).real)
    # Above zero for its logarithm, where nothing is asked.
    gamma_square = max(H[best, best].real, 1e-300)
    # Vectors of the largest eigenvalue: s, in which A acts, and p, in which the blocks enter.
    if together:
        for j in range(size - 1, -1, -1):
            s[j] = np.sum(root[j] * axes[:, best])
            p[j] = axes[j, best] * np.sqrt(gamma_square)
            for k in range(j + 1, size):
                p[j] -= np.conj(root[k, j]) * p[k]
            p[j] /= root[j, j]
    else:
        p[:] = gamma_square * axes[:, best]
        for j in range(size):
            s[j] = axes[j, best] + np.sum(C[j] * p)
    for i in range(log_t.size):
        t = np.exp(min(max(log_t[i], -_LARGEST_LOG_T), _LARGEST_LOG_T))
        slope[i] = (t * _form(entering[i], p) - _form(seen[i], s) / t) / gamma_square
    return float(np.log(gamma_square))


@numba.njit(**INSIDE)
def _trace(matrix: Array) -> float:
    """Sum of the real parts of the diagonal of a matrix (n, n).

    Not checked: square; indices are not bounded.
    """
    total = 0.0
    for j in range(matrix.shape[0]):
        total += matrix[j, j].real
    return total


@numba.njit(**INSIDE)
def _form(matrix: Array, vector: Array) -> float:
    """vector^H matrix vector, a real number for a Hermitian matrix (n, n) and a vector (n,).

    Nothing is checked; of a matrix that is not Hermitian it is the real part.
    """
    total = 0.0
    for j in range(vector.size):
        for k in range(vector.size):
            total += (np.conj(vector[j]) * matrix[j, k] * vector[k]).real
    return total


@numba.njit(**INSIDE)
def _congruence(root: Array, matrix: Array, product: Array, result: Array) -> None:
    """Write root^H matrix root into `result` (n, n), root lower triangular; `product` (n, n) is memory.

    Nothing is checked, and indices are not bounded.
    """
    size = root.shape[0]
    for j in range(size):
        for k in range(size):
            product[j, k] = 0.0
            for m in range(k, size):
                product[j, k] += matrix[j, m] * root[m, k]
    for j in range(size):
        for k in range(size):
            result[j, k] = 0.0
            for m in range(j, size):
                result[j, k] += np.conj(root[m, j]) * product[m, k]


@numba.njit(**INSIDE)
def _factored(matrix: Array, root: Array, least: float) -> bool:
    """Whether a Hermitian matrix (n, n) has Cholesky's factor, written into `root` (n, n) as a lower
    triangle; false where a pivot is not above `least`.

    Only the lower triangle of the matrix is read. False for nan; of what is written before a pivot fails
    nothing is used.
    """
    size = matrix.shape[0]
    for j in range(size):
        for k in range(j + 1):
            total = matrix[j, k]
            for m in range(k):
                total -= root[j, m] * np.conj(root[k, m])
            if k < j:
                root[j, k] = total / root[k, k]
                root[k, j] = 0.0
            elif not total.real > least:
                return False
            else:
                root[j, j] = np.sqrt(total.real)
    return True


@numba.njit(**INSIDE)
def _diagonalise(matrix: Array, axes: Array) -> None:
    """Turn a Hermitian matrix (n, n) in place into the diagonal of its eigenvalues, by Jacobi's rotations,
    and write the eigenvectors into the columns of `axes` (n, n).

    After `_MOST_SWEEPS` it is left as it is. Nothing is checked: nan stays nan.
    """
    size = matrix.shape[0]
    for j in range(size):
        for k in range(size):
            axes[j, k] = 1.0 if j == k else 0.0
    for _ in range(_MOST_SWEEPS):
        # Largest entry beside the diagonal, relative to the diagonal entries that it couples.
        off = 0.0
        for j in range(size):
            for k in range(j + 1, size):
                part = abs(matrix[j, k])
                sizes = abs(matrix[j, j].real) + abs(matrix[k, k].real)
                # Below rounding of the diagonal, or too small to divide by.
                if part <= 1e-16 * sizes or part < 1e-290:
                    continue
                off = max(off, part / sizes)
                phase = matrix[j, k] / part
                # Tangent of the smaller angle that takes the entry (j, k) to zero (Golub and Van Loan, Matrix
                # Computations, section 8.5).
                cotangent_of_double = (matrix[k, k].real - matrix[j, j].real) / (2 * part)
                sign = 1.0 if cotangent_of_double >= 0 else -1.0
                tangent = sign / (
                    abs(cotangent_of_double) + np.sqrt(1 + cotangent_of_double * cotangent_of_double)
                )
                cosine = 1 / np.sqrt(1 + tangent * tangent)
                sine = tangent * cosine * phase
                for m in range(size):
                    first = matrix[m, j]
                    second = matrix[m, k]
                    matrix[m, j] = cosine * first - np.conj(sine) * second
                    matrix[m, k] = sine * first + cosine * second
                    first = axes[m, j]
                    second = axes[m, k]
                    axes[m, j] = cosine * first - np.conj(sine) * second
                    axes[m, k] = sine * first + cosine * second
                for m in range(size):
                    first = matrix[j, m]
                    second = matrix[k, m]
                    matrix[j, m] = cosine * first - sine * second
                    matrix[k, m] = np.conj(sine) * first + cosine * second
                matrix[j, k] = 0.0
                matrix[k, j] = 0.0
        # Some roundings of the diagonal: the next sweep would change nothing.
        if off < 1e-15:
            break
