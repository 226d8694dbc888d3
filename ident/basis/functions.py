"""Generalised orthonormal basis functions as a lossless cascade (Ziaei and Wang, 2006, (5)).

L_m(z) = sqrt(1 - |x_m|^2)/(z - x_m) * prod_{i<m} (1 - conj(x_i) z)/(z - x_i), strictly proper; real poles
first. A conjugate pair gets the real two-column Kautz form after the all-pass of the poles before it: sg (z -
beta)/D and sg sb/D with D = z^2 - beta (1 + gamma) z + gamma, gamma = |x|^2, beta = 2 Re x/(1 + |x|^2), sg =
sqrt(1 - gamma^2), sb = sqrt(1 - beta^2). FIR, Laguerre and two-parameter Kautz are particular poles.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from scipy.signal import lfilter

from ident.basis.poles import Poles
from ident.data.arrays import COMPILED, ComplexArray, RealArray, one_signal


class LosslessCascade(NamedTuple):
    """State space x(k+1) = A x + B u, w = C x + D u; the states x are the basis functions, w is the
    all-pass output.

    A (B, B), B (B, 1), C (1, B), D (1, 1); the matrix [[A, B], [C, D]] is orthogonal, so A A^T + B B^T = I.
    """

    A: RealArray
    B: RealArray
    C: RealArray
    D: RealArray


def block_parameters(poles: Poles) -> RealArray:
    """Numbers of each block of the cascade, (R + P, 4): real [a, sqrt(1 - a^2), 0, 0], pair [gamma, beta, sg,
    sb], without cancellation: beta^2 + sb^2 = 1 and gamma^2 + sg^2 = 1 hold to rounding."""
    return np.asarray(_blocks(*poles.writable()))


@numba.njit(**COMPILED)
def _blocks(real: Any, pairs: Any) -> Any:
    blocks = np.zeros((real.size + pairs.size, 4))
    for i in range(real.size):
        blocks[i, 0] = real[i]
        blocks[i, 1] = math.sqrt((1 - real[i]) * (1 + real[i]))
    for i in range(pairs.size):
        re, im = pairs[i].real, pairs[i].imag
        gamma = re**2 + im**2
        # |p| < 1 can round to 1 - gamma = 0; a block without input would be no basis function.
        one_minus_gamma = max((1 - abs(re)) * (1 + abs(re)) - im**2, 5e-17)
        blocks[real.size + i, 0] = gamma
        blocks[real.size + i, 1] = 2 * re / (1 + gamma)
        blocks[real.size + i, 2] = math.sqrt(one_minus_gamma * (1 + gamma))
        blocks[real.size + i, 3] = math.sqrt(one_minus_gamma**2 + 4 * im**2) / (1 + gamma)
    return blocks


def basis_state_space(poles: Poles) -> LosslessCascade:
    """Lossless cascade whose states are the basis functions (replaces inverting E in (24)).

    Real block A = a, B = C = sqrt(1 - a^2), D = -a; pair block A = [[gamma beta, -gamma sb], [sb, beta]], B =
    [sg, 0], C = [-beta sg, sb sg], D = gamma; each is driven by the all-pass output of the one before.
    """
    n = poles.order
    A, B = np.zeros((n, n)), np.zeros((n, 1))
    C, D = np.zeros((1, n)), np.ones((1, 1))
    at = 0
    for i, (p0, p1, p2, p3) in enumerate(block_parameters(poles)):
        if i < poles.real.size:
            block_a, block_b, block_c, block_d = np.array([[p0]]), np.array([[p1]]), np.array([[p1]]), -p0
        else:
            gamma, beta, sg, sb = p0, p1, p2, p3
            block_a = np.array([[gamma * beta, -gamma * sb], [sb, beta]])
            block_b = np.array([[sg], [0.0]])
            block_c = np.array([[-beta * sg, sb * sg]])
            block_d = gamma
        here = slice(at, at + block_a.shape[0])
        A[here, :] = block_b @ C
        A[here, here] = block_a
        B[here] = block_b @ D
        C = block_d * C
        C[:, here] = block_c
        D = block_d * D
        at = here.stop
    return LosslessCascade(A, B, C, D)


def inverse_all_pass(poles: Poles) -> tuple[RealArray, RealArray, RealArray, RealArray]:
    """State space (A, B, C, D) of 1/B, whose poles lie outside the circle; no pole may be zero."""
    A, B, C, D = basis_state_space(poles)
    return A - B @ C / D, B / D, -C / D, 1 / D


def basis_response(poles: Poles, z: ComplexArray) -> ComplexArray:
    """Values (F, B) of the basis functions at the points z (F,); z must not be a pole."""
    return _response_and_all_pass(poles, z)[0]


def block_responses(poles: Poles, z: ComplexArray) -> ComplexArray:
    """Responses (F, B) of the states of each block by itself to the signal that enters it."""
    parts = [basis_response(block, z) for block in poles.blocks()]
    return np.hstack([np.zeros((z.size, 0), dtype=np.complex128), *parts])


def all_pass_response(poles: Poles, z: ComplexArray) -> ComplexArray:
    """B(z) = prod (1 - conj(x) z)/(z - x) at the points z (F,); modulus 1 on the unit circle."""
    return _response_and_all_pass(poles, z)[1]


def _response_and_all_pass(poles: Poles, z: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    z = np.asarray(z, dtype=np.complex128)
    if z.ndim != 1:
        raise ValueError(f"z must be a 1-d array; got shape {z.shape}")
    columns = np.empty((z.size, poles.order), dtype=np.complex128)
    all_pass = np.ones(z.size, dtype=np.complex128)
    blocks = block_parameters(poles)
    n_real = poles.real.size
    for i, a in enumerate(poles.real):
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
    """d log B / d pole at z (F,), (F, B): by each real pole, then by real and imaginary part of each pair."""

    def slope(p: ComplexArray) -> ComplexArray:
        return np.asarray(1 / (z[:, None] - p) - z[:, None] / (1 - p * z[:, None]))

    upper, lower = slope(poles.pairs), slope(poles.pairs.conj())
    pairs = np.stack([upper + lower, 1j * (upper - lower)], axis=2).reshape(z.size, -1)
    return np.hstack([slope(poles.real.astype(np.complex128)), pairs])


def all_pass_slopes(poles: Poles, y: RealArray) -> RealArray:
    """(dB / d pole)(q) y for y (T,), from rest, (T, B): columns as in `log_all_pass_slopes`."""
    blocks, columns = poles.blocks(), list[RealArray]()
    for i, block in enumerate(blocks):
        entering = y
        for other in (*blocks[:i], *blocks[i + 1 :]):
            entering = all_pass_signal(other, entering)
        p = block.values[0]
        slopes: tuple[tuple[list[float], list[float]], ...]
        if block.real.size:
            denominator, slopes = [1.0, -p.real], (([-1.0, 0.0], [0.0, -1.0]),)
        else:
            re, im = p.real, p.imag
            denominator = [1.0, -2 * re, re**2 + im**2]
            slopes = ([2 * re, -2.0, 0.0], [0.0, -2.0, 2 * re]), ([2 * im, 0.0, 0.0], [0.0, 0.0, 2 * im])
        # B = N / D: N' / D - (D' / D) B.
        through = all_pass_signal(block, entering)
        columns += [
            lfilter(above, denominator, entering) - lfilter(below, denominator, through)
            for above, below in slopes
        ]
    return np.column_stack(columns) if columns else np.zeros((y.size, 0))


def regressor(poles: Poles, u: RealArray) -> RealArray:
    """Basis functions driven by u (T,) or (T, 1) from rest.

    Phi (T, B) with Phi[k, i] = [L_i(q) u](k); Phi[0] = 0.
    """
    return _through(poles, u)[0].T


def all_pass_signal(poles: Poles, u: RealArray) -> RealArray:
    """u (T,) sent through the all-pass of the poles, from rest, (T,)."""
    return _through(poles, u)[1]


def _through(poles: Poles, u: RealArray) -> tuple[RealArray, RealArray]:
    signal = np.array(one_signal(u))
    if signal.ndim != 1:
        raise ValueError(f"u must be (T,), one input; got shape {signal.shape}")
    rows = np.empty((poles.order, signal.size))
    run_cascade(block_parameters(poles), poles.real.size, signal, rows, 0, 0, signal.size)
    return rows, signal


def free_response(poles: Poles, n_samples: int) -> RealArray:
    """Free responses of the cascade (T, B), h_i(k + 1), k = 0..T-1: columns of an unknown initial state."""
    rows = np.empty((poles.order, n_samples))
    run_cascade_free(block_parameters(poles), poles.real.size, rows, 0, n_samples)
    return rows.T


def nuisance_columns(poles: Poles, n_samples: int, n_polynomials: int, free: bool) -> RealArray:
    """Powers 0 .. n_polynomials - 1 of a ramp from -1 to 1 and, if `free`, the free responses, (T, n)."""
    powers = np.vander(np.linspace(-1.0, 1.0, n_samples), n_polynomials, increasing=True)
    return np.hstack([powers, free_response(poles, n_samples)]) if free else powers


@numba.njit(**COMPILED, forceinline=True, fastmath={"contract"})
def run_cascade(blocks: Any, n_real: int, w: Any, rows: Any, row: int, lo: int, hi: int) -> None:
    """Drive the cascade with w[lo:hi] from rest; rows[row:, lo:hi] receives the states, w the all-pass
    output. Two samples at a time, x(k+2) = A^2 x(k) + A B v(k) + B v(k+1): a chain of dependent operations
    half as long."""
    signal = w[lo:hi]
    even = signal.size - signal.size % 2
    for i in range(blocks.shape[0]):
        out1 = rows[row, lo:hi]
        if i < n_real:
            a, b = blocks[i, 0], blocks[i, 1]
            aa, ab = a * a, a * b
            x = 0.0
            for k in range(0, even, 2):
                v, v_next = signal[k], signal[k + 1]
                x_next = b * v + a * x
                out1[k], out1[k + 1] = x, x_next
                signal[k], signal[k + 1] = b * x - a * v, b * x_next - a * v_next
                x = (ab * v + b * v_next) + aa * x
            if even < signal.size:
                out1[even] = x
                signal[even] = b * x - a * signal[even]
            row += 1
        else:
            gamma, beta, sg, sb = blocks[i, 0], blocks[i, 1], blocks[i, 2], blocks[i, 3]
            gb, gs = gamma * beta, gamma * sb
            c1, c2 = -beta * sg, sb * sg
            # A = [[gb, -gs], [sb, beta]], B = [sg, 0]: A^2 and A B.
            a11, a12 = gb * gb - gs * sb, -gs * (gb + beta)
            a21, a22 = sb * (gb + beta), beta * beta - gs * sb
            b1, b2 = gb * sg, sb * sg
            x1 = 0.0
            x2 = 0.0
            out2 = rows[row + 1, lo:hi]
            for k in range(0, even, 2):
                v, v_next = signal[k], signal[k + 1]
                x1_next = (sg * v - gs * x2) + gb * x1
                x2_next = sb * x1 + beta * x2
                out1[k], out1[k + 1] = x1, x1_next
                out2[k], out2[k + 1] = x2, x2_next
                signal[k] = c1 * x1 + c2 * x2 + gamma * v
                signal[k + 1] = c1 * x1_next + c2 * x2_next + gamma * v_next
                x1_next = ((b1 * v + sg * v_next) + a12 * x2) + a11 * x1
                x2 = (b2 * v + a22 * x2) + a21 * x1
                x1 = x1_next
            if even < signal.size:
                out1[even], out2[even] = x1, x2
                signal[even] = c1 * x1 + c2 * x2 + gamma * signal[even]
            row += 2


@numba.njit(**COMPILED)
def run_cascade_free(blocks: Any, n_real: int, rows: Any, row: int, length: int) -> None:
    """Free responses A^k B of the whole cascade into rows[row:, :length]: the states after an impulse at k =
    -1. Zero once a block and its input are below 1e-30, which keeps (slow) denormal numbers away."""
    # The all-pass response to the impulse: its value at k = -1, the signal w from k = 0 on.
    impulse = 1.0
    w = np.zeros(length)
    alive = 0  # w is zero from here on
    for i in range(blocks.shape[0]):
        out1 = rows[row]
        stop = 0
        if i < n_real:
            a, b = blocks[i, 0], blocks[i, 1]
            x = b * impulse
            impulse = -a * impulse
            while stop < length and (stop < alive or abs(x) > 1e-30):
                start, stop = stop, min(stop + 32, length)
                for k in range(start, stop):
                    v = w[k]
                    out1[k] = x
                    w[k] = b * x - a * v
                    x = a * x + b * v
            row += 1
        else:
            gamma, beta, sg, sb = blocks[i, 0], blocks[i, 1], blocks[i, 2], blocks[i, 3]
            gb, gs = gamma * beta, gamma * sb
            c1, c2 = -beta * sg, sb * sg
            x1 = sg * impulse
            x2 = 0.0
            impulse = gamma * impulse
            out2 = rows[row + 1]
            while stop < length and (stop < alive or abs(x1) + abs(x2) > 1e-30):
                start, stop = stop, min(stop + 32, length)
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
