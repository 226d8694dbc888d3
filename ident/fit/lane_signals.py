"""Long rows in compiled code: the cascade of a basis with all its blocks at work at the same time, and inner
products.

Rows lie in one flat array, row i from i * pitch on; the pitch is a multiple of the lane width, and what a row
does not use is zero, so that inner products run over whole lanes.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from ident.fit.lanes import WIDTH, load, shifted, splat, store, total

_PIECE = 64


@numba.njit(cache=True)
def pitch_of(n_samples: int) -> int:
    """Room for a row of n_samples."""
    return -(-n_samples // WIDTH) * WIDTH


@numba.njit(cache=True)
def _coefficients(blocks: Any, n_real: int, first: int) -> Any:
    """Recursions of up to eight blocks (8, WIDTH) flat: x1' = c0 x1 - c1 x2 + c2 v, x2' = c3 x1 + c4 x2,
    all-pass output c5 x2 - c6 x1 + c7 v. A real block is one with x2 = 0; lanes without a block stay at 0."""
    c = np.zeros(8 * WIDTH)
    for lane in range(min(WIDTH, blocks.shape[0] - first)):
        p = blocks[first + lane]
        if first + lane < n_real:
            values = (p[0], 0.0, p[1], 0.0, 0.0, 0.0, -p[1], -p[0])
        else:
            gamma, beta, sg, sb = p[0], p[1], p[2], p[3]
            values = (gamma * beta, gamma * sb, sg, sb, beta, sb * sg, beta * sg, gamma)
        for i in range(8):
            c[i * WIDTH + lane] = values[i]
    return c


@numba.njit(cache=True, forceinline=True)
def cascade_states(
    blocks: Any, n_real: int, signal: Any, lo: int, hi: int, rows: Any, row: int, pitch: int
) -> None:
    """States of the cascade driven by signal[lo:hi] from rest, into rows row, row + 1, ... at lo:hi.

    As `ident.basis.functions.run_cascade`, but block i works on sample k - i while the first one works on
    sample k, its input being what the block before gave one step earlier: the chain of dependent operations
    is one block's and not the sum of all.
    """
    length = hi - lo
    inputs = np.empty(length)
    for k in range(length):
        inputs[k] = signal[lo + k]
    x1s, x2s = np.empty(_PIECE * WIDTH), np.empty(_PIECE * WIDTH)
    last = np.empty(WIDTH)
    for first in range(0, blocks.shape[0], WIDTH):
        c = _coefficients(blocks, n_real, first)
        n_lanes = min(WIDTH, blocks.shape[0] - first)
        c0, c1, c2, c3 = load(c, 0), load(c, WIDTH), load(c, 2 * WIDTH), load(c, 3 * WIDTH)
        c4, c5, c6, c7 = load(c, 4 * WIDTH), load(c, 5 * WIDTH), load(c, 6 * WIDTH), load(c, 7 * WIDTH)
        x1, x2, out = splat(0.0), splat(0.0), splat(0.0)
        more = first + WIDTH < blocks.shape[0]
        n_ticks = length + n_lanes - 1
        for at in range(0, n_ticks, _PIECE):
            count = min(_PIECE, n_ticks - at)
            for k in range(count):
                v = shifted(out, inputs[at + k] if at + k < length else 0.0)
                store(x1s, k * WIDTH, x1)
                store(x2s, k * WIDTH, x2)
                out = (c5 * x2 - c6 * x1) + c7 * v
                following = (c2 * v - c1 * x2) + c0 * x1
                x2 = c3 * x1 + c4 * x2
                x1 = following
                if more and at + k >= WIDTH - 1:
                    # What leaves the last of eight blocks drives the next eight; its place was read long ago.
                    store(last, 0, out)
                    inputs[at + k - (WIDTH - 1)] = last[WIDTH - 1]
            _spread(x1s, x2s, at, count, n_lanes, n_real - first, True, rows, row, pitch, lo, length)
        row += 2 * n_lanes - min(max(n_real - first, 0), n_lanes)


@numba.njit(cache=True, forceinline=True)
def single_states(
    blocks: Any, n_real: int, signal: Any, lo: int, hi: int, rows: Any, row: int, pitch: int
) -> None:
    """States of each block by itself, all driven by signal[lo:hi] from rest, into rows row, row + 1, ..."""
    length = hi - lo
    x1s, x2s = np.empty(_PIECE * WIDTH), np.empty(_PIECE * WIDTH)
    for first in range(0, blocks.shape[0], WIDTH):
        c = _coefficients(blocks, n_real, first)
        n_lanes = min(WIDTH, blocks.shape[0] - first)
        c0, c1, c2, c3, c4 = (
            load(c, 0), load(c, WIDTH), load(c, 2 * WIDTH), load(c, 3 * WIDTH), load(c, 4 * WIDTH)
        )  # fmt: skip
        x1, x2 = splat(0.0), splat(0.0)
        for at in range(0, length, _PIECE):
            count = min(_PIECE, length - at)
            for k in range(count):
                store(x1s, k * WIDTH, x1)
                store(x2s, k * WIDTH, x2)
                following = (c2 * splat(signal[lo + at + k]) - c1 * x2) + c0 * x1
                x2 = c3 * x1 + c4 * x2
                x1 = following
            _spread(x1s, x2s, at, count, n_lanes, n_real - first, False, rows, row, pitch, lo, length)
        row += 2 * n_lanes - min(max(n_real - first, 0), n_lanes)


@numba.njit(cache=True)
def _spread(
    x1s: Any,
    x2s: Any,
    at: int,
    count: int,
    n_lanes: int,
    n_real: int,
    skewed: bool,
    rows: Any,
    row: int,
    pitch: int,
    lo: int,
    length: int,
) -> None:
    """Lanes of one piece into rows; skewed: lane i is i samples behind."""
    for lane in range(n_lanes):
        start = at - lane if skewed else at
        begin, end = max(0, -start), min(count, length - start)
        target = rows[row * pitch + lo + start + begin : row * pitch + lo + start + max(end, begin)]
        for k in range(target.size):
            target[k] = x1s[(begin + k) * WIDTH + lane]
        row += 1
        if lane >= n_real:
            target = rows[row * pitch + lo + start + begin : row * pitch + lo + start + max(end, begin)]
            for k in range(target.size):
                target[k] = x2s[(begin + k) * WIDTH + lane]
            row += 1


@numba.njit(cache=True, forceinline=True)
def products(rows: Any, pitch: int, first: int, n_rows: int, gram: Any) -> None:
    """gram[i, j] = row i times row j for first <= i < n_rows, j <= i; both multiples of four."""
    for i in range(first, n_rows, 4):
        for j in range(0, i + 4, 4):
            _sixteen_products(rows, i * pitch, j * pitch, pitch, gram[i : i + 4, j : j + 4])


@numba.njit(cache=True, forceinline=True)
def _sixteen_products(rows: Any, a: int, b: int, pitch: int, target: Any) -> None:
    g00, g01, g02, g03 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
    g10, g11, g12, g13 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
    g20, g21, g22, g23 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
    g30, g31, g32, g33 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
    for k in range(0, pitch, WIDTH):
        b0, b1 = load(rows, b + k), load(rows, b + pitch + k)
        b2, b3 = load(rows, b + 2 * pitch + k), load(rows, b + 3 * pitch + k)
        a0 = load(rows, a + k)
        g00 = g00 + a0 * b0
        g01 = g01 + a0 * b1
        g02 = g02 + a0 * b2
        g03 = g03 + a0 * b3
        a0 = load(rows, a + pitch + k)
        g10 = g10 + a0 * b0
        g11 = g11 + a0 * b1
        g12 = g12 + a0 * b2
        g13 = g13 + a0 * b3
        a0 = load(rows, a + 2 * pitch + k)
        g20 = g20 + a0 * b0
        g21 = g21 + a0 * b1
        g22 = g22 + a0 * b2
        g23 = g23 + a0 * b3
        a0 = load(rows, a + 3 * pitch + k)
        g30 = g30 + a0 * b0
        g31 = g31 + a0 * b1
        g32 = g32 + a0 * b2
        g33 = g33 + a0 * b3
    target[0, 0], target[0, 1], target[0, 2], target[0, 3] = total(g00), total(g01), total(g02), total(g03)
    target[1, 0], target[1, 1], target[1, 2], target[1, 3] = total(g10), total(g11), total(g12), total(g13)
    target[2, 0], target[2, 1], target[2, 2], target[2, 3] = total(g20), total(g21), total(g22), total(g23)
    target[3, 0], target[3, 1], target[3, 2], target[3, 3] = total(g30), total(g31), total(g32), total(g33)


@numba.njit(cache=True, forceinline=True)
def row_products(rows: Any, pitch: int, n_rows: int, vector: Any, target: Any) -> None:
    """target[i] = row i times vector (pitch,), for i < n_rows, a multiple of four."""
    for i in range(0, n_rows, 4):
        a = i * pitch
        g0, g1, g2, g3 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        for k in range(0, pitch, WIDTH):
            v = load(vector, k)
            g0 = g0 + load(rows, a + k) * v
            g1 = g1 + load(rows, a + pitch + k) * v
            g2 = g2 + load(rows, a + 2 * pitch + k) * v
            g3 = g3 + load(rows, a + 3 * pitch + k) * v
        target[i], target[i + 1], target[i + 2], target[i + 3] = total(g0), total(g1), total(g2), total(g3)


@numba.njit(cache=True, forceinline=True)
def combine(rows: Any, pitch: int, n_rows: int, factors: Any, target: Any) -> None:
    """target (pitch,) = sum of factors[i] times row i over i < n_rows, a multiple of four."""
    for k in range(0, pitch, WIDTH):
        store(target, k, splat(0.0))
    for i in range(0, n_rows, 4):
        a = i * pitch
        f0, f1, f2, f3 = (
            splat(factors[i]),
            splat(factors[i + 1]),
            splat(factors[i + 2]),
            splat(factors[i + 3]),
        )
        for k in range(0, pitch, WIDTH):
            sum01 = f0 * load(rows, a + k) + f1 * load(rows, a + pitch + k)
            sum23 = f2 * load(rows, a + 2 * pitch + k) + f3 * load(rows, a + 3 * pitch + k)
            store(target, k, load(target, k) + (sum01 + sum23))
