"""Generalised orthonormal basis functions as a lossless cascade (Ziaei and Wang, 2006, (5)).

L_m(z) = sqrt(1 - |x_m|^2)/(z - x_m) * prod_{i<m} (1 - conj(x_i) z)/(z - x_i), strictly proper; real poles
first. A conjugate pair gets the real two-column Kautz form after the all-pass of the poles before it: sg (z -
beta)/D and sg sb/D with D = z^2 - beta (1 + gamma) z + gamma, gamma = |x|^2, beta = 2 Re x/(1 + |x|^2), sg =
sqrt(1 - gamma^2), sb = sqrt(1 - beta^2). FIR, Laguerre and two-parameter Kautz are particular poles.

Every pole or pair is a block of the cascade, given by four numbers (`block_parameters`); its states are its
basis functions, and its all-pass output drives the next block. From the blocks follow the state space, the
responses at points z, and, in compiled loops, the signals of the basis for an input or an initial state.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from scipy.signal import lfilter

from ident.basis.poles import Poles
from ident.data.arrays import COMPILED, ComplexArray, RealArray, one_signal

# Least 1 - gamma of a pair: |p| < 1 can round to 1 - gamma = 0, and a block without input would be no basis
# function. Half the distance of 1 to the double below it, so that it stands for "less than one digit".
_LEAST_ONE_MINUS_GAMMA = 5e-17
# Size of a state below which a free response is zero from there on, in units of the unit impulse: far below
# its rounding, 1e-16, and far above the denormal numbers from 1e-308 on, which are slow. 1e-20 or 1e-100
# would do.
_DEAD = 1e-30
# Samples between two looks at whether a free response is dead, so that the inner loop has no condition: so
# many are the most that a dead one is followed for nothing. Chosen; it decides time, and digits below
# `_DEAD`.
_LOOK_EVERY = 32


class LosslessCascade(NamedTuple):
    """State space x(k+1) = A x + B u, w = C x + D u; the states x are the basis functions, w is the
    all-pass output.

    A (B, B), B (B, 1), C (1, B), D (1, 1), B the number of poles; the matrix [[A, B], [C, D]] is orthogonal,
    so A A^T + B B^T = I. No units.
    """

    A: RealArray
    B: RealArray
    C: RealArray
    D: RealArray


def block_parameters(poles: Poles) -> RealArray:
    """Numbers of each block of the cascade, (R + P, 4), real poles first.

    A real pole a has [a, sqrt(1 - a^2), 0, 0], a pair [gamma, beta, sg, sb] as in the module text, without
    cancellation: beta^2 + sb^2 = 1 and gamma^2 + sg^2 = 1 hold to rounding. (0, 4) without poles; bad ones
    are refused by `Poles`.
    """
    return np.asarray(blocks_of_poles(*poles.writable()))


@numba.njit(**COMPILED)
def blocks_of_poles(real: Any, pairs: Any) -> Any:
    """Blocks (R + P, 4) of real poles (R,) and pairs (P,) as `block_parameters` gives them, for compiled
    code.

    real and pairs are writable arrays, pairs complex with the poles above the axis, all inside the circle;
    nothing is checked: of a pole outside the numbers are NaN or wrong.
    """
    blocks = np.zeros((real.size + pairs.size, 4))
    for i in range(real.size):
        blocks[i, 0] = real[i]
        blocks[i, 1] = math.sqrt((1 - real[i]) * (1 + real[i]))
    for i in range(pairs.size):
        re = pairs[i].real
        im = pairs[i].imag
        gamma = re**2 + im**2
        # 1 - re^2 - im^2 from factors: near the circle the plain difference has no digits.
        one_minus_gamma = max((1 - abs(re)) * (1 + abs(re)) - im**2, _LEAST_ONE_MINUS_GAMMA)
        row = real.size + i
        blocks[row, 0] = gamma
        blocks[row, 1] = 2 * re / (1 + gamma)
        blocks[row, 2] = math.sqrt(one_minus_gamma * (1 + gamma))
        blocks[row, 3] = math.sqrt(one_minus_gamma**2 + 4 * im**2) / (1 + gamma)
    return blocks


def basis_state_space(poles: Poles) -> LosslessCascade:
    """Lossless cascade whose states are the basis functions.

    Parameters
    ----------
    poles : Poles
        B poles, both of each pair counted.

    Returns
    -------
    LosslessCascade
        A (B, B), B (B, 1), C (1, B), D (1, 1); D = 1 without poles.

    Notes
    -----
    It replaces inverting E in the paper's (24). Real block A = a, B = C = sqrt(1 - a^2), D = -a; pair block A
    = [[gamma beta, -gamma sb], [sb, beta]], B = [sg, 0], C = [-beta sg, sb sg], D = gamma; each is driven by
    the all-pass output of the one before.
    """
    n = poles.order
    A = np.zeros((n, n))
    B = np.zeros((n, 1))
    # C and D: the all-pass output of the blocks so far; before the first it is the input.
    C = np.zeros((1, n))
    D = np.ones((1, 1))
    at = 0
    for i, (p0, p1, p2, p3) in enumerate(block_parameters(poles)):
        if i < poles.real.size:
            block_a = np.array([[p0]])
            block_b = np.array([[p1]])
            block_c = np.array([[p1]])
            block_d = -p0
        else:
            gamma, beta, sg, sb = p0, p1, p2, p3
            block_a = np.array([[gamma * beta, -gamma * sb], [sb, beta]])
            block_b = np.array([[sg], [0.0]])
            block_c = np.array([[-beta * sg, sb * sg]])
            block_d = gamma
        # Driven by what the blocks before make of the input and of their states.
        states = slice(at, at + block_a.shape[0])
        A[states, :] = block_b @ C
        A[states, states] = block_a
        B[states] = block_b @ D
        C = block_d * C
        C[:, states] = block_c
        D = block_d * D
        at = states.stop
    return LosslessCascade(A, B, C, D)


def inverse_all_pass(poles: Poles) -> tuple[RealArray, RealArray, RealArray, RealArray]:
    """State space (A, B, C, D) of the inverse of the all-pass of these poles; none of them may be zero.

    Shapes as of `basis_state_space`. Its poles are 1 / conj(p), outside the circle. A pole at zero is not
    refused: numbers are infinite or NaN.
    """
    A, B, C, D = basis_state_space(poles)
    return A - B @ C / D, B / D, -C / D, 1 / D


def basis_response(poles: Poles, z: ComplexArray) -> ComplexArray:
    r"""Values of the basis functions.

    Parameters
    ----------
    poles : Poles
        Of the B basis functions.
    z : (F,) complex array
        Points, e^{j omega dt} on the unit circle.

    Returns
    -------
    (F, B) complex array
        NaN or infinite at a pole.

    Raises
    ------
    ValueError
        For z of another number of dimensions.

    Notes
    -----
    For poles p_k, one after the other,

    .. math::

        L_k(z) = \frac{\sqrt{1 - |p_k|^2}}{z - p_k} \prod_{i < k} \frac{1 - \bar p_i z}{z - p_i},

    in the real form that has two functions for a pair (Ninness and Gustafsson, IEEE TAC 42(4), 1997).

    Examples
    --------
    >>> flexlink.basis_response(flexlink.Poles(real=[0.5]), np.array([1.0 + 0.0j])).round(4)
    array([[1.7321+0.j]])
    """
    return _response_and_all_pass(poles, z)[0]


def block_responses(poles: Poles, z: ComplexArray) -> ComplexArray:
    """Responses (F, B) at the points z (F,) of the states of each block by itself, driven by the input.

    Real poles first, two columns per pair; (F, 0) without poles. Raises ValueError as `basis_response`.
    """
    parts = [basis_response(block, z) for block in poles.blocks()]
    return np.hstack([np.zeros((z.size, 0), dtype=np.complex128), *parts])


def all_pass_response(poles: Poles, z: ComplexArray) -> ComplexArray:
    """B(z) = prod (1 - conj(x) z)/(z - x) at the points z (F,), (F,); modulus 1 on the unit circle.

    1 without poles; NaN or infinite at a pole x. Raises ValueError as `basis_response`.
    """
    return _response_and_all_pass(poles, z)[1]


def _response_and_all_pass(poles: Poles, z: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Basis functions (F, B) and all-pass (F,) at the points z (F,); NaN or infinite at a pole.

    Raises ValueError for z of another number of dimensions.
    """
    z = np.asarray(z, dtype=np.complex128)
    if z.ndim != 1:
        raise ValueError(f"z must be a 1-d array; got shape {z.shape}")
    columns = np.empty((z.size, poles.order), dtype=np.complex128)
    all_pass = np.ones(z.size, dtype=np.complex128)
    blocks = block_parameters(poles)
    n_real = poles.real.size
    for i, a in enumerate(poles.real):
        # Behind the all-pass of the poles before this one, so that the functions are orthogonal.
        columns[:, i] = blocks[i, 1] / (z - a) * all_pass
        all_pass *= (1 - a * z) / (z - a)
    for i, p in enumerate(poles.pairs):
        _, beta, sg, sb = blocks[n_real + i]
        # Factored, not expanded: z^2 - beta (1 + gamma) z + gamma cancels when z is near the pole.
        driven = all_pass / ((z - p) * (z - p.conjugate()))
        columns[:, n_real + 2 * i] = sg * (z - beta) * driven
        columns[:, n_real + 2 * i + 1] = sg * sb * driven
        all_pass = (1 - p.conjugate() * z) * (1 - p * z) * driven
    return columns, all_pass


def log_all_pass_slopes(poles: Poles, z: ComplexArray) -> ComplexArray:
    """Derivatives d log B / d pole of the all-pass at z (F,), (F, B).

    Columns: by each real pole, then by real and imaginary part of each pair; (F, 0) without poles. z is no
    pole and no inverse of one, which is not checked: infinite or NaN there.
    """

    def slope(p: ComplexArray) -> ComplexArray:
        """d/dp log((1 - p z)/(z - p)) at all points z and poles p (n,), (F, n); infinite at z = p."""
        points = z[:, None]
        return np.asarray(1 / (points - p) - points / (1 - p * points))

    # p and its conjugate move together: along the real part alike, along the imaginary part against each
    # other.
    upper = slope(poles.pairs)
    lower = slope(poles.pairs.conj())
    by_part = np.stack([upper + lower, 1j * (upper - lower)], axis=2)
    by_pairs = by_part.reshape(z.size, -1)
    by_real = slope(poles.real.astype(np.complex128))
    return np.hstack([by_real, by_pairs])


def all_pass_slopes(poles: Poles, y: RealArray) -> RealArray:
    """Derivatives (dB / d pole)(q) y of the all-pass output for y (T,), from rest, (T, B).

    Columns as in `log_all_pass_slopes`: by each real pole, then by real and imaginary part of each pair, in
    the unit of y; (T, 0) without poles. Raises ValueError, by `all_pass_signal`, for y of another shape,
    where there are poles; from a NaN on all is NaN.
    """
    # One all-pass after the other is as good as all at once, and no polynomial of high degree is formed.
    blocks = poles.blocks()
    columns: list[RealArray] = []
    for i, block in enumerate(blocks):
        # The blocks commute: send y through all others first.
        entering = y
        for other in (*blocks[:i], *blocks[i + 1 :]):
            entering = all_pass_signal(other, entering)

        # Each slope: derivatives of numerator N and denominator D of the block by one of its unknowns.
        p = block.values[0]
        slopes: list[tuple[list[float], list[float]]]
        if block.real.size:
            # N = 1 - a z, D = z - a.
            denominator = [1.0, -p.real]
            slopes = [([-1.0, 0.0], [0.0, -1.0])]
        else:
            # N = 1 - 2 re z + |p|^2 z^2, D = z^2 - 2 re z + |p|^2.
            re = p.real
            im = p.imag
            denominator = [1.0, -2 * re, re**2 + im**2]
            by_re = ([2 * re, -2.0, 0.0], [0.0, -2.0, 2 * re])
            by_im = ([2 * im, 0.0, 0.0], [0.0, 0.0, 2 * im])
            slopes = [by_re, by_im]

        # B = N / D: N' / D - (D' / D) B.
        through = all_pass_signal(block, entering)
        for above, below in slopes:
            of_numerator = lfilter(above, denominator, entering)
            of_denominator = lfilter(below, denominator, through)
            columns.append(of_numerator - of_denominator)
    return np.column_stack(columns) if columns else np.zeros((y.size, 0))


def regressor(poles: Poles, u: RealArray) -> RealArray:
    """Basis functions driven by a signal from rest: the columns of a regression.

    Parameters
    ----------
    poles : Poles
        Of the B basis functions L_i.
    u : (T,) or (T, 1) array
        The signal.

    Returns
    -------
    (T, B) array
        Phi[k, i] = [L_i(q) u](k), in the unit of u; Phi[0] = 0. From a NaN on all is NaN.

    Raises
    ------
    ValueError
        For another shape of u.

    Examples
    --------
    >>> flexlink.regressor(flexlink.Poles(real=[0.5]), np.array([1.0, 0.0, 0.0])).round(3)
    array([[0.   ],
           [0.866],
           [0.433]])
    """
    return _through(poles, u)[0].T


def all_pass_signal(poles: Poles, u: RealArray) -> RealArray:
    """Output (T,) of the all-pass of the poles for u (T,) or (T, 1), from rest, in the unit of u.

    A copy of u without poles. Raises ValueError for another shape of u.
    """
    return _through(poles, u)[1]


def _through(poles: Poles, u: RealArray) -> tuple[RealArray, RealArray]:
    """States (B, T) of the cascade for u (T,) or (T, 1), from rest, and its all-pass output (T,).

    Raises ValueError for another shape of u.
    """
    signal = np.array(one_signal(u))
    if signal.ndim != 1:
        raise ValueError(f"u must be (T,), one input; got shape {signal.shape}")
    rows = np.empty((poles.order, signal.size))
    run_cascade(block_parameters(poles), poles.real.size, signal, rows, 0, 0, signal.size)
    return rows, signal


def free_response(poles: Poles, n_samples: int) -> RealArray:
    """Free responses of the cascade (T, B): columns of an unknown initial state.

    Column i is the impulse response of basis function i from its first sample on, h_i(k + 1), k = 0..T-1:
    together they span what any initial state of the poles leaves. No unit. n_samples: T, at least 0 (numpy's
    ValueError else).
    """
    rows = np.empty((poles.order, n_samples))
    run_cascade_free(block_parameters(poles), poles.real.size, rows, 0, n_samples)
    return rows.T


def nuisance_columns(poles: Poles, n_samples: int, n_polynomials: int, free: bool) -> RealArray:
    """Nuisance columns (T, n) of one record of T = n_samples samples.

    Powers 0 .. n_polynomials - 1 of a ramp from -1 to 1 and, if `free`, the free responses of the poles (B
    columns). n may be 0, or exceed T: columns then depend on each other, which nothing refuses here. Negative
    numbers: ValueError of numpy.
    """
    ramp = np.linspace(-1.0, 1.0, n_samples)
    powers = np.vander(ramp, n_polynomials, increasing=True)
    return np.hstack([powers, free_response(poles, n_samples)]) if free else powers


@numba.njit(**COMPILED, forceinline=True, fastmath={"contract"})
def run_cascade(blocks: Any, n_real: int, w: Any, rows: Any, row: int, lo: int, hi: int) -> None:
    """Drive the cascade with w[lo:hi] from rest; rows[row:, lo:hi] receives the states.

    Parameters
    ----------
    blocks : ndarray, shape (R + P, 4)
        As `block_parameters` makes them, n_real = R real poles first.
    n_real : int
        How many of the blocks are real poles.
    w : ndarray, shape (N,)
        Input; overwritten by the all-pass output over lo..hi.
    rows : ndarray, shape (row + R + 2 P or more, N)
        Filled from `row` on over lo..hi.
    row, lo, hi : int
        First row, first sample, and the sample after the last; 0 <= lo <= hi <= N. Nothing is checked:
        compiled code reads and writes beyond an array without a word.

    Notes
    -----
    Two samples at a time, x(k+2) = A^2 x(k) + A B v(k) + B v(k+1): a chain of dependent operations half as
    long, which is what the loop waits for. That is why the formulae stand in the order they do: others round
    differently or run slower.
    """
    signal = w[lo:hi]
    even = signal.size - signal.size % 2
    for i in range(blocks.shape[0]):
        out1 = rows[row, lo:hi]
        if i < n_real:
            a = blocks[i, 0]
            b = blocks[i, 1]
            aa = a * a
            ab = a * b
            x = 0.0
            for k in range(0, even, 2):
                v = signal[k]
                v_next = signal[k + 1]
                x_next = b * v + a * x
                out1[k] = x
                out1[k + 1] = x_next
                signal[k] = b * x - a * v
                signal[k + 1] = b * x_next - a * v_next
                x = (ab * v + b * v_next) + aa * x
            if even < signal.size:
                out1[even] = x
                signal[even] = b * x - a * signal[even]
            row += 1
        else:
            gamma = blocks[i, 0]
            beta = blocks[i, 1]
            sg = blocks[i, 2]
            sb = blocks[i, 3]
            gb = gamma * beta
            gs = gamma * sb
            c1 = -beta * sg
            c2 = sb * sg
            # A = [[gb, -gs], [sb, beta]], B = [sg, 0]: A^2 and A B.
            a11 = gb * gb - gs * sb
            a12 = -gs * (gb + beta)
            a21 = sb * (gb + beta)
            a22 = beta * beta - gs * sb
            b1 = gb * sg
            b2 = sb * sg
            x1 = 0.0
            x2 = 0.0
            out2 = rows[row + 1, lo:hi]
            for k in range(0, even, 2):
                v = signal[k]
                v_next = signal[k + 1]
                x1_next = (sg * v - gs * x2) + gb * x1
                x2_next = sb * x1 + beta * x2
                out1[k] = x1
                out1[k + 1] = x1_next
                out2[k] = x2
                out2[k + 1] = x2_next
                signal[k] = c1 * x1 + c2 * x2 + gamma * v
                signal[k + 1] = c1 * x1_next + c2 * x2_next + gamma * v_next
                x1_next = ((b1 * v + sg * v_next) + a12 * x2) + a11 * x1
                x2 = (b2 * v + a22 * x2) + a21 * x1
                x1 = x1_next
            if even < signal.size:
                out1[even] = x1
                out2[even] = x2
                signal[even] = c1 * x1 + c2 * x2 + gamma * signal[even]
            row += 2


@numba.njit(**COMPILED)
def run_cascade_free(blocks: Any, n_real: int, rows: Any, row: int, length: int) -> None:
    """Fill rows[row:, :length] with the free responses A^k B of the whole cascade.

    They are the states after a unit impulse at k = -1. blocks (R + P, 4), n_real = R of them real poles; rows
    have R + 2 P rows from `row` on, and at least `length` columns, which is not checked. Zero once a block
    and its input are below `_DEAD`.
    """
    # The all-pass response to the impulse: its value at k = -1, the signal w from k = 0 on.
    impulse = 1.0
    w = np.zeros(length)
    # w is zero from this sample on.
    alive = 0
    for i in range(blocks.shape[0]):
        out1 = rows[row]
        stop = 0
        if i < n_real:
            a = blocks[i, 0]
            b = blocks[i, 1]
            x = b * impulse
            impulse = -a * impulse
            while stop < length and (stop < alive or abs(x) > _DEAD):
                start = stop
                stop = min(stop + _LOOK_EVERY, length)
                for k in range(start, stop):
                    v = w[k]
                    out1[k] = x
                    w[k] = b * x - a * v
                    x = a * x + b * v
            row += 1
        else:
            gamma = blocks[i, 0]
            beta = blocks[i, 1]
            sg = blocks[i, 2]
            sb = blocks[i, 3]
            gb = gamma * beta
            gs = gamma * sb
            c1 = -beta * sg
            c2 = sb * sg
            x1 = sg * impulse
            x2 = 0.0
            impulse = gamma * impulse
            out2 = rows[row + 1]
            while stop < length and (stop < alive or abs(x1) + abs(x2) > _DEAD):
                start = stop
                stop = min(stop + _LOOK_EVERY, length)
                for k in range(start, stop):
                    v = w[k]
                    out1[k] = x1
                    out2[k] = x2
                    w[k] = c1 * x1 + c2 * x2 + gamma * v
                    x1_next = gb * x1 - gs * x2 + sg * v
                    x2 = sb * x1 + beta * x2
                    x1 = x1_next
            for k in range(stop, length):
                out2[k] = 0.0
            row += 2
        for k in range(stop, length):
            out1[k] = 0.0
        alive = max(alive, stop)
