"""The unknowns of a local refinement, compiled: 1 - a of each free real pole, (s, f) of each free pair p =
exp(-s +- j f); their bounds, the chain rule from block states to unknowns, and a Levenberg-Marquardt step.
"""

from __future__ import annotations

import cmath
import math
from typing import Any

import numba
import numpy as np

from ident.basis.functions import _blocks
from ident.data.arrays import COMPILED
from ident.fit.kernels import backward, factorise, forward, schur_drop

# Order of the numbers in an array of bounds (see `ident.fit.refinement.Bounds`).
_DISTANCE_MIN, _DISTANCE_MAX, _OMEGA_MIN, _OMEGA_MAX, _ZETA_MIN, _ZETA_MAX, _S_MIN = range(7)
# Whatever follows these seven are measured bands [rad/sample], low and high in turn; `narrowest` reads them.
_FIRST_BAND = 7
# Pieces of the two compiled functions at the end: as functions of their own they would be compiled twice.
_inlined = numba.njit(**COMPILED, inline="always")
_CLOSE = 1e-7  # poles pass through exp and log on their way to a bound


@_inlined
def narrowest(f: float, bounds: Any) -> float:
    """Least decay per sample of a pair at angle f [rad/sample]: its distance to the nearest measured band.

    A resonance is 2 s wide at half its power, so something measured then lies within that width. 0 where the
    bounds list no measured bands.
    """
    if bounds.size <= _FIRST_BAND:
        return 0.0
    distance = np.inf
    for i in range(_FIRST_BAND, bounds.size, 2):
        distance = min(distance, max(bounds[i] - f, f - bounds[i + 1], 0.0))
    return distance


@_inlined
def clip_parameters(x: Any, n_free_real: int, bounds: Any) -> Any:
    """The unknowns (1 - a; s, f) inside the bounds; frequency and damping are clipped, then s and f formed.

    A pair that is narrower than its distance to the data is widened, but never beyond the largest damping.
    """
    inside = np.empty_like(x)
    for i in range(n_free_real):
        inside[i] = min(max(x[i], bounds[_DISTANCE_MIN]), bounds[_DISTANCE_MAX])
    for i in range(n_free_real, x.size, 2):
        s, f = max(x[i], bounds[_S_MIN]), max(x[i + 1], 1e-12)
        omega = math.hypot(s, f)
        zeta = min(max(s / omega, bounds[_ZETA_MIN]), bounds[_ZETA_MAX])
        omega = min(max(omega, bounds[_OMEGA_MIN]), bounds[_OMEGA_MAX])
        inside[i] = max(zeta * omega, bounds[_S_MIN])
        inside[i + 1] = min(omega * math.sqrt(1 - zeta * zeta), 0.995 * np.pi)
        widest = inside[i + 1] * bounds[_ZETA_MAX] / math.sqrt(1 - bounds[_ZETA_MAX] ** 2)
        inside[i] = max(inside[i], min(narrowest(inside[i + 1], bounds), widest))
    return inside


@_inlined
def blocked(x: Any, gradient: Any, n_free_real: int, bounds: Any) -> Any:
    """Unknowns on a bound that would be driven out of it (a step goes along +gradient = S^T r)."""
    held = np.zeros(x.size)  # 1: held; zeros of another type would be compiled for this alone
    low, high = 1 + _CLOSE, 1 - _CLOSE
    for i in range(n_free_real):
        if gradient[i] < 0:
            held[i] = x[i] <= bounds[_DISTANCE_MIN] * low
        else:
            held[i] = x[i] >= bounds[_DISTANCE_MAX] * high
    for i in range(n_free_real, x.size, 2):
        omega = math.hypot(x[i], x[i + 1])
        zeta = x[i] / omega
        if gradient[i] < 0:
            least = max(bounds[_S_MIN], narrowest(x[i + 1], bounds))
            held[i] = x[i] <= least * low or zeta <= bounds[_ZETA_MIN] * low
        elif gradient[i] > 0:
            held[i] = zeta >= bounds[_ZETA_MAX] * high
        if gradient[i + 1] < 0:
            held[i + 1] = omega <= bounds[_OMEGA_MIN] * low
        elif gradient[i + 1] > 0:
            held[i + 1] = omega >= bounds[_OMEGA_MAX] * high
    return held


@_inlined
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


@_inlined
def _by_unknowns(chain: Any, normal: Any, gradient: Any) -> tuple[Any, Any]:
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


def free_parameters(real: Any, pairs: Any, n_fixed_real: int, n_fixed_pairs: int) -> Any:
    """1 - a of the free real poles, then s, f of each free pair."""
    n_free_real = real.size - n_fixed_real
    x = np.empty(n_free_real + 2 * (pairs.size - n_fixed_pairs))
    for i in range(n_free_real):
        x[i] = 1 - real[n_fixed_real + i]
    for j in range(n_fixed_pairs, pairs.size):
        log = cmath.log(pairs[j])
        x[n_free_real + 2 * (j - n_fixed_pairs)] = -log.real
        x[n_free_real + 2 * (j - n_fixed_pairs) + 1] = log.imag
    return x


@_inlined
def set_poles(x: Any, real: Any, pairs: Any, n_fixed_real: int, n_fixed_pairs: int) -> None:
    n_free_real = real.size - n_fixed_real
    for i in range(n_free_real):
        real[n_fixed_real + i] = 1 - x[i]
    for j in range(n_fixed_pairs, pairs.size):
        s = x[n_free_real + 2 * (j - n_fixed_pairs)]
        f = x[n_free_real + 2 * (j - n_fixed_pairs) + 1]
        pairs[j] = math.exp(-s) * complex(math.cos(f), math.sin(f))


def start(real: Any, pairs: Any, n_fixed_real: int, n_fixed_pairs: int, bounds: Any) -> Any:
    """The unknowns of the poles, brought inside the bounds, and the poles with them. Too seldom to be
    compiled."""
    x = free_parameters(real, pairs, n_fixed_real, n_fixed_pairs)
    x = clip_parameters.py_func(x, real.size - n_fixed_real, bounds)
    set_poles.py_func(x, real, pairs, n_fixed_real, n_fixed_pairs)
    return x


@numba.njit(**COMPILED)
def scaled_system(
    x: Any,
    real: Any,
    pairs: Any,
    n_fixed_real: int,
    n_fixed_pairs: int,
    bounds: Any,
    normal: Any,
    gradient: Any,
) -> Any:
    """Normal matrix and S^T r of the unknowns x that no bound holds, each unknown scaled to unit length.

    Also the scales, the indices of these unknowns and the fall of J that the linearisation promises.
    """
    chain = chain_rule(real, pairs, n_fixed_real, n_fixed_pairs)
    full_system, full_slope = _by_unknowns(chain, normal, gradient)
    held = blocked(x, full_slope, real.size - n_fixed_real, bounds)
    free = np.empty(x.size, dtype=np.int64)
    m = 0
    for i in range(x.size):
        if not held[i]:
            free[m] = i
            m += 1
    system, scale, slope = np.empty((m, m)), np.empty(m), np.empty(m)
    for i in range(m):
        scale[i] = math.sqrt(max(full_system[free[i], free[i]], 1e-300))
        slope[i] = full_slope[free[i]] / scale[i]
        for j in range(i + 1):
            system[i, j] = full_system[free[i], free[j]] / (scale[i] * scale[j])
            system[j, i] = system[i, j]
    return system, slope, scale, free[:m], schur_drop(system.copy(), slope.copy())


@numba.njit(**COMPILED)
def damped_step(
    x: Any,
    n_fixed_real: int,
    n_fixed_pairs: int,
    bounds: Any,
    system: Any,
    slope: Any,
    scale: Any,
    free: Any,
    damping: float,
    real: Any,
    pairs: Any,
) -> Any:
    """The unknowns after one step, inside the bounds, and the fall of J it promises (0: no step possible).

    Fills the free ones of the poles real and pairs.
    """
    m = free.size
    factor = system.copy()
    for i in range(m):
        factor[i, i] += damping
    trial = x.copy()
    if not factorise(factor, m, 1e-14):
        return trial, 0.0
    step = slope.copy()
    forward(factor, m, step)
    backward(factor, m, step)
    promised = 0.0
    for i in range(m):
        trial[free[i]] += step[i] / scale[i]
        along = 2 * slope[i]
        for j in range(m):
            along -= system[i, j] * step[j]
        promised += step[i] * along
    trial = clip_parameters(trial, real.size - n_fixed_real, bounds)
    set_poles(trial, real, pairs, n_fixed_real, n_fixed_pairs)
    return trial, promised
