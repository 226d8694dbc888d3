"""Local descent in the poles: Levenberg-Marquardt on Kaufman's Jacobian (design 4.2).

Modulo the columns of the regression, moving a pole changes the fitted output y_hat by -(dD_b/dp)/D_b y_hat,
D_b(z) being the denominator of its block: the numerator is re-fitted anyway. So the sensitivities are
combinations of the block's own states driven by y_hat, and dJ/dp = -2 r^T s_p holds exactly because r is
orthogonal to the columns.

The unknowns are decay rates and angles, linear, so that a pole can reach the circle: 1 - a for a real pole,
(s, f) with p = exp(-s +- j f) for a pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import RealArray
from ident.basis import block_parameters
from ident.coordinates import ZETA_LEAST, ZETA_LIMIT
from ident.least_squares import Linearisation, linearisation
from ident.options import IdentOptions
from ident.poles import Poles
from ident.regression import Regression


@dataclass(frozen=True)
class Bounds:
    """Sides that a polished pole keeps: user bounds, and the circle itself.

    decay: 1 - a of real poles; omega: |log p|, zeta; s_min: least decay per sample of a pair.
    """

    distance_min: float
    distance_max: float
    omega_min: float
    omega_max: float
    zeta_min: float
    zeta_max: float
    s_min: float

    @classmethod
    def from_options(cls, options: IdentOptions, longest: int, dt_s: float) -> Bounds:
        """User bounds where given; else only what keeps a pole usable over `longest` samples."""
        # A pole that decays by 0.1 % over the record cannot be told from one on the circle.
        still = 1e-3 / longest

        def distance(decay_per_s: float | None, default: float) -> float:
            return default if decay_per_s is None else float(-np.expm1(-decay_per_s * dt_s))

        def angle(omega_rad_s: float | None, default: float) -> float:
            return default if omega_rad_s is None else omega_rad_s * dt_s

        return cls(
            distance_min=max(distance(options.decay_min_per_s, still), still),
            # Negative poles down to -0.95 are reached by descent only; they have no continuous counterpart.
            distance_max=distance(options.decay_max_per_s, 1.95),
            omega_min=angle(options.omega_min_rad_s, 0.1 / longest),
            omega_max=min(angle(options.omega_max_rad_s, 0.995 * np.pi), 0.995 * np.pi),
            zeta_min=ZETA_LEAST if options.zeta_min is None else options.zeta_min,
            zeta_max=ZETA_LIMIT if options.zeta_max is None else options.zeta_max,
            s_min=still,
        )

    def clip(self, poles: Poles, n_fixed_real: int = 0, n_fixed_pairs: int = 0) -> Poles:
        """The nearest poles inside the bounds; the first n_fixed ones of each type are left alone."""
        x = _free_parameters(poles, n_fixed_real, n_fixed_pairs)
        return _poles_of(
            poles, n_fixed_real, n_fixed_pairs, self.clip_parameters(x, poles.real.size - n_fixed_real)
        )

    def clip_parameters(self, x: RealArray, n_free_real: int) -> RealArray:
        x = x.copy()
        x[:n_free_real] = np.clip(x[:n_free_real], self.distance_min, self.distance_max)
        s = np.maximum(x[n_free_real::2], self.s_min)
        f = np.maximum(x[n_free_real + 1 :: 2], 1e-12)
        omega = np.hypot(s, f)
        zeta = np.clip(s / omega, self.zeta_min, self.zeta_max)
        omega = np.clip(omega, self.omega_min, self.omega_max)
        s = np.maximum(zeta * omega, self.s_min)
        x[n_free_real::2] = s
        x[n_free_real + 1 :: 2] = np.minimum(omega * np.sqrt(1 - zeta**2), 0.995 * np.pi)
        return x


@dataclass(frozen=True, eq=False)
class Polished:
    """End of a descent: poles, residual sum of squares, iterations; `converged` if a stationary point was
    reached."""

    poles: Poles
    rss: float
    iterations: int
    converged: bool


def polish(
    data: Regression,
    poles: Poles,
    bounds: Bounds,
    *,
    n_fixed_real: int = 0,
    n_fixed_pairs: int = 0,
    max_iterations: int = 60,
    tolerance: float = 1e-9,
) -> Polished:
    """Descend from the given poles; the first n_fixed ones of each type stay where they are.

    Stops when the decrease that the linearisation still promises is below `tolerance` of J.
    """
    n_free_real = poles.real.size - n_fixed_real
    x = bounds.clip_parameters(_free_parameters(poles, n_fixed_real, n_fixed_pairs), n_free_real)
    current = _poles_of(poles, n_fixed_real, n_fixed_pairs, x)
    here = linearisation(data, current)
    if x.size == 0:
        return Polished(current, here.rss, 0, True)
    # Residuals at rounding level relative to the output: nothing left to gain.
    floor = 1e-26 * float(data.y @ data.y)
    damping, growth = 1e-3, 2.0
    for iteration in range(max_iterations):
        normal, gradient = pole_system(here, current, n_fixed_real, n_fixed_pairs)
        active = _blocked(x, gradient, bounds, n_free_real)
        free = np.flatnonzero(~active)
        if here.rss <= floor or free.size == 0:
            return Polished(current, here.rss, iteration, True)
        scale = np.sqrt(np.maximum(np.diag(normal)[free], 1e-300))
        scaled = normal[np.ix_(free, free)] / np.outer(scale, scale)
        slope = gradient[free] / scale
        newton = np.linalg.lstsq(scaled, slope, rcond=1e-12)[0]
        if slope @ newton <= tolerance * here.rss:
            return Polished(current, here.rss, iteration, True)
        while True:
            step = np.linalg.solve(scaled + damping * np.eye(free.size), slope)
            trial_x = x.copy()
            trial_x[free] += step / scale
            trial_x = bounds.clip_parameters(trial_x, n_free_real)
            trial_poles = _poles_of(poles, n_fixed_real, n_fixed_pairs, trial_x)
            trial = linearisation(data, trial_poles)
            promised = step @ (2 * slope - scaled @ step)
            ratio = (here.rss - trial.rss) / promised if promised > 0 else 0.0
            if ratio > 1e-4:
                break
            damping *= growth
            growth *= 2
            if damping > 1e12:
                # No step of any length gains: the linearisation's promise is rounding, or a bound's corner.
                return Polished(current, here.rss, iteration, False)
        x, current, here = trial_x, trial_poles, trial
        damping *= max(1 / 5, 1 - (2 * ratio - 1) ** 3)
        growth = 2.0
    return Polished(current, here.rss, max_iterations, False)


def pole_system(
    here: Linearisation, poles: Poles, n_fixed_real: int = 0, n_fixed_pairs: int = 0
) -> tuple[RealArray, RealArray]:
    """Normal matrix (P, P) and S^T r (P,) of the free unknowns (1 - a; s, f); the gradient of J is -2 S^T
    r."""
    chain = _chain_rule(poles, n_fixed_real, n_fixed_pairs)
    return chain.T @ here.normal @ chain, chain.T @ here.gradient


def free_optimality(
    here: Linearisation, poles: Poles, bounds: Bounds, n_fixed_real: int = 0, n_fixed_pairs: int = 0
) -> float:
    """|P r|/|r| over the tangent directions of the poles that are neither fixed nor held by a bound.

    0 at an optimum. With records from rest, nothing fixed and no bound active this is |Phi2^T r|/|r| with
    orthonormal Phi2 (the basis with every pole doubled), by the tangent identity of design 4.2.
    """
    x = _free_parameters(poles, n_fixed_real, n_fixed_pairs)
    if x.size == 0 or here.rss <= 0:
        return 0.0
    normal, gradient = pole_system(here, poles, n_fixed_real, n_fixed_pairs)
    free = np.flatnonzero(~_blocked(x, gradient, bounds, poles.real.size - n_fixed_real))
    scale = np.sqrt(np.maximum(np.diag(normal)[free], 1e-300))
    slope = gradient[free] / scale
    share = (
        slope @ np.linalg.lstsq(normal[np.ix_(free, free)] / np.outer(scale, scale), slope, rcond=1e-12)[0]
    )
    return float(np.sqrt(max(share, 0.0) / here.rss))


def _chain_rule(poles: Poles, n_fixed_real: int, n_fixed_pairs: int) -> RealArray:
    """(B, P): sensitivity to each free unknown as a combination of the block states driven by the fitted
    output.

    States of a real block: b/(z - a) y_hat; of a pair: sg (z - beta)/D y_hat and sg sb/D y_hat, with
    D = z^2 - t z + g, t = 2 exp(-s) cos f, g = exp(-2 s).
    """
    blocks = block_parameters(poles)
    n_real = poles.real.size
    n_free_real = n_real - n_fixed_real
    chain = np.zeros((poles.order, n_free_real + 2 * (poles.pairs.size - n_fixed_pairs)))
    for i in range(n_fixed_real, n_real):
        chain[i, i - n_fixed_real] = -1 / blocks[i, 1]  # minus: the unknown is 1 - a
    for j in range(n_fixed_pairs, poles.pairs.size):
        gamma, beta, sg, sb = blocks[n_real + j]
        pole = poles.pairs[j]
        dt, dg = np.array([-2 * pole.real, -2 * pole.imag]), np.array([-2 * gamma, 0.0])  # by s, by f
        row, column = n_real + 2 * j, n_free_real + 2 * (j - n_fixed_pairs)
        chain[row, column : column + 2] = dt / sg
        chain[row + 1, column : column + 2] = (dt * beta - dg) / (sg * sb)
    return chain


def _free_parameters(poles: Poles, n_fixed_real: int, n_fixed_pairs: int) -> RealArray:
    log = np.log(poles.pairs[n_fixed_pairs:])
    pairs = np.column_stack([-log.real, log.imag]).ravel()
    return np.concatenate([1 - poles.real[n_fixed_real:], pairs])


def _poles_of(poles: Poles, n_fixed_real: int, n_fixed_pairs: int, x: RealArray) -> Poles:
    n_free_real = poles.real.size - n_fixed_real
    pairs = np.exp(-x[n_free_real::2] + 1j * x[n_free_real + 1 :: 2])
    return Poles(
        np.concatenate([poles.real[:n_fixed_real], 1 - x[:n_free_real]]),
        np.concatenate([poles.pairs[:n_fixed_pairs], pairs]),
    )


def _blocked(
    x: RealArray, gradient: RealArray, bounds: Bounds, n_free_real: int
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Unknowns that sit on a bound and would be driven out of it (a step goes along +gradient = S^T r)."""
    blocked = np.zeros(x.size, dtype=np.bool_)
    close = 1e-7  # poles pass through exp and log on the way here
    real, down = x[:n_free_real], gradient[:n_free_real] < 0
    blocked[:n_free_real] = (down & (real <= bounds.distance_min * (1 + close))) | (
        ~down & (real >= bounds.distance_max * (1 - close))
    )
    s, f = x[n_free_real::2], x[n_free_real + 1 :: 2]
    by_s, by_f = gradient[n_free_real::2], gradient[n_free_real + 1 :: 2]
    omega = np.hypot(s, f)
    zeta = s / omega
    least = (s <= bounds.s_min * (1 + close)) | (zeta <= bounds.zeta_min * (1 + close))
    blocked[n_free_real::2] = (least & (by_s < 0)) | ((zeta >= bounds.zeta_max * (1 - close)) & (by_s > 0))
    blocked[n_free_real + 1 :: 2] = ((omega <= bounds.omega_min * (1 + close)) & (by_f < 0)) | (
        (omega >= bounds.omega_max * (1 - close)) & (by_f > 0)
    )
    return blocked
