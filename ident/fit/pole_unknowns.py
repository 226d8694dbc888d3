"""The unknowns of a local refinement, compiled, and one damped step in them.

A refinement moves 1 - a of each free real pole and (s, f) of each free pair p = exp(-s +- j f), s its decay
and f its angle per sample: in these a pole reaches the unit circle at a finite distance, and a resonance
keeps its shape. The first functions keep unknowns inside their bounds and tell which a bound holds;
`chain_rule` turns sensitivities to block states into sensitivities to unknowns; `scaled_system` and
`damped_step` are the two halves of a Levenberg-Marquardt step (More, 1978), called by
`ident.fit.refinement.refine`.

Fixed poles come first of each type, and have no unknowns: with n_free_real = R - n_fixed_real, an array x
(P,) holds 1 - a of the free real poles and then s, f of each free pair. `bounds` is `Bounds.array` of
`ident.fit.refinement` everywhere, in the order of the constants below. Nothing is checked in this file:
compiled code reads beyond an array without a word, so numbers of poles and shapes are the callers' care.
"""

from __future__ import annotations

import cmath
import math
from typing import Any

import numba
import numpy as np

from ident.basis.functions import blocks_of_poles
from ident.data.arrays import COMPILED
from ident.fit.kernels import backward, factorise, forward, schur_drop

# Order of the numbers in an array of bounds (see `ident.fit.refinement.Bounds`).
_DISTANCE_MIN = 0

# Largest 1 - a of a real pole a.
_DISTANCE_MAX = 1

# Lowest frequency of a pair [rad/sample].
_OMEGA_MIN = 2

# Highest frequency of a pair [rad/sample].
_OMEGA_MAX = 3

# Least damping ratio of a pair.
_ZETA_MIN = 4

# Largest damping ratio of a pair.
_ZETA_MAX = 5

# Least decay s = zeta omega of a pair [rad/sample]: below it a record shows no decay.
_S_MIN = 6
# Whatever follows these seven are measured bands [rad/sample], low and high in turn; `narrowest` reads them.
_FIRST_BAND = 7
# An unknown is on a bound when it is this near to it, as a share. Poles pass through exp and log on their way
# there, which rounds 1 - a by 1e-16; at the least distance to the circle, 1e-8 in a record of 100 000
# samples, that is a share of 1e-8.
_CLOSE = 1e-7
# Least angle of a pair per sample, rad: a pair has to lie above the axis, and no record shows one so slow.
_LEAST_ANGLE_RAD = 1e-12
# Largest angle of a pair per sample, over pi: beyond pi a mode is folded back, and at pi its pair is a real
# pole. Chosen; bounds of a refinement end there, too.
LARGEST_ANGLE_SHARE = 0.995
# Least square of a direction's length, in place of zero: a pole that moves nothing has a scale to divide by.
_TINY = 1e-300
# Least pivot of the damped normal matrix of unit diagonal, whose products are rounded to 1e-16: a step is
# only taken if its factor has two digits. Else `refine` adds damping.
_LEAST_PIVOT_OF_STEP = 1e-14
# Pieces of the two compiled functions at the end: as functions of their own they would be compiled twice.
_inlined = numba.njit(**COMPILED, inline="always")


@_inlined
def narrowest(f: float, bounds: Any) -> float:
    """Least decay per sample of a pair at angle f [rad/sample]: its distance to the nearest measured band.

    A resonance is 2 s wide at half its power, so something measured then lies within that width. 0 where the
    bounds list no measured bands, inside one, and for an angle of NaN.
    """
    if bounds.size <= _FIRST_BAND:
        return 0.0
    distance = np.inf
    for i in range(_FIRST_BAND, bounds.size, 2):
        distance = min(distance, max(bounds[i] - f, f - bounds[i + 1], 0.0))
    return distance


@_inlined
def clip_parameters(x: Any, n_free_real: int, bounds: Any) -> Any:
    """Unknowns (P,) that x (P,) becomes inside the bounds.

    n_free_real: how many of them are 1 - a. Of a pair frequency |log p| and damping ratio are clipped, then s
    and f formed again. A pair that is narrower than its distance to the data is widened, but never beyond the
    largest damping, which is below 1. Unknowns of NaN may stay NaN.
    """
    inside = np.empty_like(x)
    for i in range(n_free_real):
        inside[i] = min(max(x[i], bounds[_DISTANCE_MIN]), bounds[_DISTANCE_MAX])
    for i in range(n_free_real, x.size, 2):
        s = max(x[i], bounds[_S_MIN])
        f = max(x[i + 1], _LEAST_ANGLE_RAD)
        omega = math.hypot(s, f)
        zeta = min(max(s / omega, bounds[_ZETA_MIN]), bounds[_ZETA_MAX])
        omega = min(max(omega, bounds[_OMEGA_MIN]), bounds[_OMEGA_MAX])
        decay = max(zeta * omega, bounds[_S_MIN])
        angle = min(omega * math.sqrt(1 - zeta * zeta), LARGEST_ANGLE_SHARE * np.pi)
        # Decay at which the damping ratio is the largest: s = f zeta / sqrt(1 - zeta^2).
        widest = angle * bounds[_ZETA_MAX] / math.sqrt(1 - bounds[_ZETA_MAX] ** 2)
        inside[i] = max(decay, min(narrowest(angle, bounds), widest))
        inside[i + 1] = angle
    return inside


@_inlined
def blocked(x: Any, gradient: Any, n_free_real: int, bounds: Any) -> Any:
    """Which unknowns x (P,) stand on a bound and would be driven out of it, (P,): 1 for yes, 0 for no.

    gradient (P,) = S^T r by unknowns: a step goes along it. x lies inside the bounds; an unknown counts as on
    one to `_CLOSE`. Real poles with a gradient of zero or NaN count as driven upwards.
    """
    # Floats, not booleans: zeros of another type would be compiled for this alone.
    held = np.zeros(x.size)
    low = 1 + _CLOSE
    high = 1 - _CLOSE
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
    """Sensitivity of the output to each free unknown as a combination of block states, (B, P).

    real (R,) and pairs (P',) are all poles, the fixed ones first. The states are those of each block by
    itself, driven by the fitted output y_hat. Of a real block: b/(z - a) y_hat; of a pair: sg (z - beta)/D
    y_hat and sg sb/D y_hat, with D = z^2 - t z + g, t = 2 exp(-s) cos f, g = exp(-2 s). Moving a pole changes
    y_hat by -(dD/dp)/D y_hat; here dD = -z dt + dg is written in the two states. B = R + 2 P'; P unknowns of
    the free poles. Poles lie inside the circle: on it the numbers divided by are zero.
    """
    blocks = blocks_of_poles(real, pairs)
    n_real = real.size
    n_free_real = real.size - n_fixed_real
    chain = np.zeros((n_real + 2 * pairs.size, n_free_real + 2 * (pairs.size - n_fixed_pairs)))
    for i in range(n_fixed_real, n_real):
        # Minus: the unknown is 1 - a.
        chain[i, i - n_fixed_real] = -1 / blocks[i, 1]
    for j in range(n_fixed_pairs, pairs.size):
        block = blocks[n_real + j]
        gamma = block[0]
        beta = block[1]
        sg = block[2]
        sb = block[3]
        row = n_real + 2 * j
        column = n_free_real + 2 * (j - n_fixed_pairs)
        dt_ds = -2 * pairs[j].real
        dt_df = -2 * pairs[j].imag
        dg_ds = -2 * gamma
        chain[row, column] = dt_ds / sg
        chain[row, column + 1] = dt_df / sg
        chain[row + 1, column] = (dt_ds * beta - dg_ds) / (sg * sb)
        chain[row + 1, column + 1] = dt_df * beta / (sg * sb)
    return chain


@_inlined
def _by_unknowns(chain: Any, normal: Any, gradient: Any) -> tuple[Any, Any]:
    """Normal matrix (P, P) and S^T r (P,) of the free unknowns.

    chain (B, P) from `chain_rule`; normal (B, B) and gradient (B,) by block states; they are not changed. The
    chain has one or two numbers a column, so zeros are skipped instead of multiplied; NaN of a block stays
    with its unknowns.
    """
    n, m = chain.shape
    system = np.zeros((m, m))
    slope = np.zeros(m)
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
    """Unknowns (P,) of poles: 1 - a of the free real poles, then s, f of each free pair.

    real (R,) and pairs (P',) are all poles, the fixed ones first; a pair at 0 has no logarithm (ValueError).
    Not
    compiled; ValueError or IndexError of numpy where more are fixed than there are.
    """
    n_free_real = real.size - n_fixed_real
    x = np.empty(n_free_real + 2 * (pairs.size - n_fixed_pairs))
    for i in range(n_free_real):
        x[i] = 1 - real[n_fixed_real + i]
    for j in range(n_fixed_pairs, pairs.size):
        log = cmath.log(pairs[j])
        at = n_free_real + 2 * (j - n_fixed_pairs)
        x[at] = -log.real
        x[at + 1] = log.imag
    return x


@_inlined
def set_poles(x: Any, real: Any, pairs: Any, n_fixed_real: int, n_fixed_pairs: int) -> None:
    """Put the unknowns x (P,) into the free poles of real (R,) and pairs (P',), in place.

    Unknowns inside the bounds give poles inside the circle; others are not refused.
    """
    n_free_real = real.size - n_fixed_real
    for i in range(n_free_real):
        real[n_fixed_real + i] = 1 - x[i]
    for j in range(n_fixed_pairs, pairs.size):
        at = n_free_real + 2 * (j - n_fixed_pairs)
        s = x[at]
        f = x[at + 1]
        pairs[j] = math.exp(-s) * complex(math.cos(f), math.sin(f))


def start(real: Any, pairs: Any, n_fixed_real: int, n_fixed_pairs: int, bounds: Any) -> Any:
    """Unknowns (P,) of the poles, brought inside the bounds; the free poles are changed to match, in place.

    real (R,) and pairs (P',) are writable, the fixed ones first of each type. bounds: `Bounds.array`. Called
    too seldom to be compiled. More fixed poles than there are: IndexError.
    """
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
    """Linearised problem of the unknowns that no bound holds, each scaled to move the output by unit length.

    Parameters
    ----------
    x : ndarray, shape (P,)
        Unknowns of the free poles.
    real, pairs : ndarray, shapes (R,) and (P',)
        All poles, the fixed ones first.
    n_fixed_real, n_fixed_pairs : int
        Numbers of fixed poles.
    bounds : ndarray
        `Bounds.array`.
    normal, gradient : ndarray, shapes (B, B) and (B,)
        S^T S and S^T r by block states (`ident.fit.problem.Linearisation`).

    Returns
    -------
    system : ndarray, shape (m, m)
        Normal matrix of the m unknowns that are not held, unit diagonal.
    slope : ndarray, shape (m,)
        Their S^T r.
    scale : ndarray, shape (m,)
        Length of each direction; a step in an unknown is one in the scaled unknown over its scale.
    free : ndarray of int, shape (m,)
        Which of the unknowns they are.
    promised : float
        Fall of J that the linearisation promises, in the unit of J; 0 where every unknown is held.
        Unknowns whose column of normal has NaN promise nothing.
    """
    # From block states to unknowns, and which of these are free to move.
    chain = chain_rule(real, pairs, n_fixed_real, n_fixed_pairs)
    full_system, full_slope = _by_unknowns(chain, normal, gradient)
    held = blocked(x, full_slope, real.size - n_fixed_real, bounds)
    free = np.empty(x.size, dtype=np.int64)
    m = 0
    for i in range(x.size):
        if not held[i]:
            free[m] = i
            m += 1

    # Of unit length, so that one damping is right for all: a slow pole moves the output by decades more.
    system = np.empty((m, m))
    scale = np.empty(m)
    slope = np.empty(m)
    for i in range(m):
        scale[i] = math.sqrt(max(full_system[free[i], free[i]], _TINY))
        slope[i] = full_slope[free[i]] / scale[i]
        for j in range(i + 1):
            system[i, j] = full_system[free[i], free[j]] / (scale[i] * scale[j])
            system[j, i] = system[i, j]
    promised = schur_drop(system.copy(), slope.copy())
    return system, slope, scale, free[:m], promised


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
    """Unknowns (P,) after one step, inside the bounds, and the fall of J it promises (0: no step possible).

    Parameters
    ----------
    x, n_fixed_real, n_fixed_pairs, bounds, system, slope, scale, free
        Those of `scaled_system`: unknowns (P,), numbers of fixed poles, `Bounds.array`; and what it returned
        for the m unknowns that no bound holds: (m, m), (m,), (m,), (m,).
    damping : float
        Added to the unit diagonal of the system: 0 is a Gauss-Newton step, large numbers are short steps
        downhill. Negative ones are not checked.
    real, pairs : ndarray, shapes (R,) and (P',)
        Their free poles are filled with those of the step; left alone where none is possible, because the
        damped system is too nearly singular (`_LEAST_PIVOT_OF_STEP`) or has NaN.

    Notes
    -----
    The promise, 2 slope^T step - step^T system step, is of the step before the bounds cut it.
    """
    m = free.size
    # (system + damping) step = slope.
    factor = system.copy()
    for i in range(m):
        factor[i, i] += damping
    trial = x.copy()
    if not factorise(factor, m, _LEAST_PIVOT_OF_STEP):
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
