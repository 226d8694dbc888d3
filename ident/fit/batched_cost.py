"""The cost of many candidate poles, eight at a time: one pass over the samples, nothing of length N kept.

J = |r|^2 - |P r|^2, P the projection on what the columns x_1 .. x_m of the candidate poles add to the frozen
columns Q (orthonormal rows): with G = X X^T - (X Q^T)(X Q^T)^T and b = X r, |P r|^2 = b^T G^-1 b. Only the
products X X^T, X Q^T and X r are needed, and they are summed over pieces of `_PIECE` samples while the states
are still in the processor's first cache. Memory does not grow with the number of samples.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from ident.basis.coordinates import blocks_of_point
from ident.fit.kernels import _schur_drop
from ident.fit.lanes import WIDTH, load, splat, store

_PIECE = 64
# Frozen columns are met two at a time.
COLUMNS = 2


@numba.njit(cache=True, forceinline=True)
def batched_rss(
    units: Any,
    n_real: int,
    low: Any,
    high: Any,
    raw: bool,
    drive: Any,
    against: Any,
    n_shared: int,
    residual_power: float,
    starts: Any,
    free: bool,
) -> Any:
    """Residual sums of squares (E,) at points (E, D) of the unit cube of a search space.

    drive (N,) is the input of the candidate blocks; against (N, Q) holds the residual of the frozen columns,
    then n_shared columns orthonormal over all records, then columns orthonormal within each record, then
    zeros up to a multiple of `COLUMNS`. With `free`, which takes a single record, the candidate poles also
    get their free responses: the same cascades without input from the state that an impulse leaves.
    """
    n_points = units.shape[0]
    n_blocks = n_real + (units.shape[1] - n_real) // 2
    order = units.shape[1]
    m = 2 * order if free else order
    driven = m - order  # the first row of the driven responses
    n_rows = m + m % 2  # an odd number is filled up with a row of zeros: products are taken two by two
    n_against = against.shape[1]
    values = np.empty(n_points)
    blocks = np.zeros(n_blocks * 4 * WIDTH)
    state, free_state = np.zeros(order * WIDTH), np.zeros(order * WIDTH)
    silence = np.zeros(_PIECE)
    signal = np.zeros(_PIECE * WIDTH)
    rows = np.zeros(n_rows * _PIECE * WIDTH)
    gram_lanes = np.zeros(n_rows * n_rows * WIDTH)
    cross_lanes = np.zeros(n_rows * n_against * WIDTH)
    gram, b = np.empty((m, m)), np.empty(m)
    cross = np.empty((WIDTH, m, n_shared + 1))
    local = np.empty((WIDTH, m, m))
    for first in range(0, n_points, WIDTH):
        for lane in range(WIDTH):
            point = blocks_of_point(units[min(first + lane, n_points - 1)], n_real, low, high, raw)
            for i in range(n_blocks):
                for j in range(4):
                    blocks[(i * 4 + j) * WIDTH + lane] = point[i, j]
            _strike(point, n_real, free_state, lane)
        gram_lanes[:] = 0.0
        cross[:] = 0.0
        local[:] = 0.0
        for record in range(starts.size - 1):
            state[:] = 0.0
            cross_lanes[:] = 0.0
            for at in range(starts[record], starts[record + 1], _PIECE):
                length = min(_PIECE, starts[record + 1] - at)
                _advance(blocks, n_real, n_blocks, state, drive[at : at + length], signal, rows, driven)
                if free:
                    _advance(blocks, n_real, n_blocks, free_state, silence[:length], signal, rows, 0)
                for i in range(0, n_rows, 2):
                    for j in range(0, i + 2, 2):
                        _add_products(rows, i, j, length, gram_lanes, n_rows)
                    for j in range(0, n_against - 2, 4):
                        _add_four_cross_products(rows, i, against, at, j, length, cross_lanes)
                    if n_against % 4:
                        _add_cross_products(rows, i, against, at, n_against - 2, length, cross_lanes)
            for lane in range(WIDTH):
                for i in range(m):
                    for j in range(n_shared + 1):
                        cross[lane, i, j] += cross_lanes[(i * n_against + j) * WIDTH + lane]
                    for j in range(i + 1):
                        total = 0.0
                        for q in range(n_shared + 1, n_against):
                            total += (
                                cross_lanes[(i * n_against + q) * WIDTH + lane]
                                * cross_lanes[(j * n_against + q) * WIDTH + lane]
                            )
                        local[lane, i, j] += total
        for lane in range(min(WIDTH, n_points - first)):
            for i in range(m):
                b[i] = cross[lane, i, 0]
                for j in range(i + 1):
                    total = gram_lanes[(i * n_rows + j) * WIDTH + lane] - local[lane, i, j]
                    for q in range(1, n_shared + 1):
                        total -= cross[lane, i, q] * cross[lane, j, q]
                    gram[i, j] = total
            values[first + lane] = residual_power - _schur_drop(gram, b)
    return values


@numba.njit(cache=True)
def _strike(point: Any, n_real: int, state: Any, lane: int) -> None:
    """State of the cascade after an impulse, in one lane: what each block gets has passed the direct terms
    before."""
    impulse = 1.0
    row = 0
    for i in range(point.shape[0]):
        if i < n_real:
            state[row * WIDTH + lane] = point[i, 1] * impulse
            impulse *= -point[i, 0]
            row += 1
        else:
            state[row * WIDTH + lane] = point[i, 2] * impulse
            state[(row + 1) * WIDTH + lane] = 0.0
            impulse *= point[i, 0]
            row += 2


@numba.njit(cache=True, forceinline=True)
def _advance(
    blocks: Any, n_real: int, n_blocks: int, state: Any, drive: Any, signal: Any, rows: Any, first_row: int
) -> None:
    """`ident.basis.functions.run_cascade` for eight cascades over one piece: states into rows from first_row
    on; signal is room for what one block hands to the next."""
    row = 0
    for i in range(n_blocks):
        first, last = i == 0, i == n_blocks - 1
        p = i * 4 * WIDTH
        out1 = (first_row + row) * _PIECE * WIDTH
        x1 = load(state, row * WIDTH)
        if i < n_real:
            a, c = load(blocks, p), load(blocks, p + WIDTH)
            for k in range(drive.size):
                at = k * WIDTH
                v = splat(drive[k]) if first else load(signal, at)
                store(rows, out1 + at, x1)
                if not last:
                    store(signal, at, c * x1 - a * v)
                x1 = a * x1 + c * v
            store(state, row * WIDTH, x1)
            row += 1
        else:
            gamma, beta = load(blocks, p), load(blocks, p + WIDTH)
            sg, sb = load(blocks, p + 2 * WIDTH), load(blocks, p + 3 * WIDTH)
            gb, gs, c1, c2 = gamma * beta, gamma * sb, beta * sg, sb * sg
            out2 = out1 + _PIECE * WIDTH
            x2 = load(state, (row + 1) * WIDTH)
            for k in range(drive.size):
                at = k * WIDTH
                v = splat(drive[k]) if first else load(signal, at)
                store(rows, out1 + at, x1)
                store(rows, out2 + at, x2)
                if not last:
                    store(signal, at, c2 * x2 - c1 * x1 + gamma * v)
                following = (sg * v - gs * x2) + gb * x1
                x2 = sb * x1 + beta * x2
                x1 = following
            store(state, row * WIDTH, x1)
            store(state, (row + 1) * WIDTH, x2)
            row += 2


@numba.njit(cache=True, forceinline=True)
def _add_products(rows: Any, i: int, j: int, length: int, gram: Any, n_rows: int) -> None:
    """gram[i : i + 2, j : j + 2] += products of rows i, i + 1 with rows j, j + 1."""
    a, b = i * _PIECE * WIDTH, j * _PIECE * WIDTH
    at = (i * n_rows + j) * WIDTH
    below = at + n_rows * WIDTH
    g00, g01 = load(gram, at), load(gram, at + WIDTH)
    g10, g11 = load(gram, below), load(gram, below + WIDTH)
    for k in range(0, length * WIDTH, WIDTH):
        a0, a1 = load(rows, a + k), load(rows, a + k + _PIECE * WIDTH)
        b0, b1 = load(rows, b + k), load(rows, b + k + _PIECE * WIDTH)
        g00 = g00 + a0 * b0
        g01 = g01 + a0 * b1
        g10 = g10 + a1 * b0
        g11 = g11 + a1 * b1
    store(gram, at, g00)
    store(gram, at + WIDTH, g01)
    store(gram, below, g10)
    store(gram, below + WIDTH, g11)


@numba.njit(cache=True, forceinline=True)
def _add_cross_products(rows: Any, i: int, against: Any, start: int, j: int, length: int, cross: Any) -> None:
    """cross[i : i + 2, j : j + 2] += products of rows i, i + 1 with columns j, j + 1 of against."""
    a, n = i * _PIECE * WIDTH, against.shape[1] * WIDTH
    at = i * n + j * WIDTH
    c00, c01 = load(cross, at), load(cross, at + WIDTH)
    c10, c11 = load(cross, at + n), load(cross, at + n + WIDTH)
    for k in range(length):
        a0, a1 = load(rows, a + k * WIDTH), load(rows, a + (k + _PIECE) * WIDTH)
        q0, q1 = splat(against[start + k, j]), splat(against[start + k, j + 1])
        c00 = c00 + a0 * q0
        c01 = c01 + a0 * q1
        c10 = c10 + a1 * q0
        c11 = c11 + a1 * q1
    store(cross, at, c00)
    store(cross, at + WIDTH, c01)
    store(cross, at + n, c10)
    store(cross, at + n + WIDTH, c11)


@numba.njit(cache=True, forceinline=True)
def _add_four_cross_products(
    rows: Any, i: int, against: Any, start: int, j: int, length: int, cross: Any
) -> None:
    """cross[i : i + 2, j : j + 4] += products of rows i, i + 1 with columns j .. j + 3 of against."""
    a, n = i * _PIECE * WIDTH, against.shape[1] * WIDTH
    at = i * n + j * WIDTH
    c00, c01, c02, c03 = (
        load(cross, at), load(cross, at + WIDTH), load(cross, at + 2 * WIDTH), load(cross, at + 3 * WIDTH)
    )  # fmt: skip
    at1 = at + n
    c10, c11, c12, c13 = (
        load(cross, at1), load(cross, at1 + WIDTH), load(cross, at1 + 2 * WIDTH), load(cross, at1 + 3 * WIDTH)
    )  # fmt: skip
    for k in range(length):
        a0, a1 = load(rows, a + k * WIDTH), load(rows, a + (k + _PIECE) * WIDTH)
        q = splat(against[start + k, j])
        c00 = c00 + a0 * q
        c10 = c10 + a1 * q
        q = splat(against[start + k, j + 1])
        c01 = c01 + a0 * q
        c11 = c11 + a1 * q
        q = splat(against[start + k, j + 2])
        c02 = c02 + a0 * q
        c12 = c12 + a1 * q
        q = splat(against[start + k, j + 3])
        c03 = c03 + a0 * q
        c13 = c13 + a1 * q
    store(cross, at, c00)
    store(cross, at + WIDTH, c01)
    store(cross, at + 2 * WIDTH, c02)
    store(cross, at + 3 * WIDTH, c03)
    store(cross, at1, c10)
    store(cross, at1 + WIDTH, c11)
    store(cross, at1 + 2 * WIDTH, c12)
    store(cross, at1 + 3 * WIDTH, c13)
