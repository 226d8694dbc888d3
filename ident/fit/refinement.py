"""Local refinement of the poles: Levenberg-Marquardt on Kaufman's Jacobian (BIT 15, 1975).

Modulo the columns of the regression, moving a pole changes the fitted output y_hat by -(dD_b/dp)/D_b y_hat,
D_b(z) the denominator of its block: sensitivities are combinations of the block's states driven by y_hat, and
dJ/dp = -2 r^T s_p is exact. Unknowns, so that a pole can reach the circle: 1 - a of a real pole, (s, f) with
p = exp(-s +- j f) of a pair.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ident.basis.coordinates import ZETA_LEAST, ZETA_LIMIT
from ident.basis.options import IdentOptions
from ident.basis.poles import NO_POLES, Poles
from ident.data.arrays import RealArray
from ident.fit.pole_unknowns import chain_rule, damped_step, free_parameters, scaled_system, start
from ident.fit.problem import Linearisation, Linearised

# Damping of the first step, in units of the scaled normal matrix: from afar a full step leads too far.
NEAR, FAR = 1e-3, 1.0
# Steps that do not gain multiply the damping by this, by its square next, and so on.
_GROWTH = 4.0


@dataclass(frozen=True)
class Bounds:
    """Sides that a refined pole keeps: user bounds, and the circle itself.

    distance: 1 - a of real poles; omega: |log p|, zeta; s_min: least decay per sample of a pair.
    measured_rad: bands (low, high) [rad/sample] of which one has to come within the half-power width of every
    pole; none: poles may be as narrow as the other bounds allow. Compiled code takes all of them in this
    order (`ident.fit.pole_unknowns`).
    """

    distance_min: float
    distance_max: float
    omega_min: float
    omega_max: float
    zeta_min: float
    zeta_max: float
    s_min: float
    measured_rad: tuple[tuple[float, float], ...] = ()

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
            # Negative poles down to -0.95 are reached by refinement only: no continuous counterpart.
            distance_max=distance(options.decay_max_per_s, 1.95),
            omega_min=angle(options.omega_min_rad_s, 0.1 / longest),
            omega_max=min(angle(options.omega_max_rad_s, 0.995 * np.pi), 0.995 * np.pi),
            zeta_min=ZETA_LEAST if options.zeta_min is None else options.zeta_min,
            zeta_max=ZETA_LIMIT if options.zeta_max is None else options.zeta_max,
            s_min=still,
        )

    def shown_by(self, measured_rad: RealArray) -> Bounds:
        """These bounds for poles that have a measured band within their half-power width.

        measured_rad: (K, 2) low and high end of each band, ascending, from 0 to pi rad/sample. A real pole
        a > 0 is a resonance at 0 whose half-power width is -ln a, one with a < 0 is a resonance at pi of
        width -ln |a|.
        """
        slowest = float(measured_rad[0, 0])
        fastest = np.pi - float(measured_rad[-1, 1])
        return replace(
            self,
            distance_min=max(self.distance_min, -float(np.expm1(-slowest))),
            distance_max=min(self.distance_max, 1 + float(np.exp(-fastest))),
            measured_rad=tuple((float(low), float(high)) for low, high in measured_rad),
        )

    @cached_property
    def array(self) -> RealArray:
        """In the order of the fields, the measured bands one by one."""
        scalars = [
            self.distance_min,
            self.distance_max,
            self.omega_min,
            self.omega_max,
            self.zeta_min,
            self.zeta_max,
            self.s_min,
        ]
        return np.array([*scalars, *(end for band in self.measured_rad for end in band)])


@dataclass(frozen=True, eq=False)
class Refined:
    """End of a refinement: poles, residual sum of squares, iterations; `converged` if a stationary point was
    reached."""

    poles: Poles
    rss: float
    iterations: int
    converged: bool


def refine(
    problem: Linearised,
    poles: Poles,
    bounds: Bounds,
    fixed: Poles = NO_POLES,
    *,
    max_iterations: int = 60,
    tolerance: float = 1e-9,
    damping: float = NEAR,
) -> Refined:
    """Go downhill from the given poles, fixed ones first of each type, until the linearisation promises a
    decrease below `tolerance` of J. damping: of the first step, `NEAR` an optimum or `FAR` from one."""
    real, pairs = poles.writable()
    n_fixed, limits = fixed.counts, bounds.array
    x = start(real, pairs, *n_fixed, limits)
    here = problem.linearise(real, pairs)
    trial_real, trial_pairs = real.copy(), pairs.copy()
    # Residuals at rounding level relative to the output: nothing left to gain.
    floor = 1e-26 * problem.power
    growth = _GROWTH
    for iteration in range(max_iterations):
        system, slope, scale, free, promised = scaled_system(
            x, real, pairs, *n_fixed, limits, here.normal, here.gradient
        )
        if here.rss <= floor or promised <= tolerance * here.rss:
            return Refined(Poles(real, pairs), here.rss, iteration, True)
        while True:
            trial_x, gain = damped_step(
                x, *n_fixed, limits, system, slope, scale, free, damping, trial_real, trial_pairs
            )
            ratio = 0.0
            if gain > 0:
                trial = problem.linearise(trial_real, trial_pairs, here.rss)
                ratio = (here.rss - trial.rss) / gain
                if ratio > 1e-4:
                    break
            damping *= growth
            growth *= _GROWTH
            if damping > 1e12:
                # No step of any length gains: the linearisation's promise is rounding, or a bound's corner.
                return Refined(Poles(real, pairs), here.rss, iteration, False)
        x, here = trial_x, trial
        real, trial_real, pairs, trial_pairs = trial_real, real, trial_pairs, pairs
        damping *= max(1 / 5, 1 - (2 * ratio - 1) ** 3)
        growth = _GROWTH
    return Refined(Poles(real, pairs), here.rss, max_iterations, False)


def pole_system(here: Linearisation, poles: Poles, fixed: Poles = NO_POLES) -> tuple[RealArray, RealArray]:
    """Normal matrix (P, P) and S^T r (P,) of the free unknowns (1 - a; s, f); the gradient of J is -2 S^T
    r."""
    chain = chain_rule.py_func(*poles.writable(), *fixed.counts)  # too seldom to be compiled by itself
    return chain.T @ here.normal @ chain, chain.T @ here.gradient


def free_optimality(here: Linearisation, poles: Poles, bounds: Bounds, fixed: Poles = NO_POLES) -> float:
    """|P r|/|r| over the tangent directions of the poles that are neither fixed nor held by a bound: 0 at an
    optimum. With records from rest and nothing held it is |Phi2^T r|/|r|, Phi2 the orthonormal doubled
    basis."""
    known = (*poles.writable(), *fixed.counts)
    promised = scaled_system(free_parameters(*known), *known, bounds.array, here.normal, here.gradient)[-1]
    return float(np.sqrt(max(promised, 0.0) / here.rss)) if here.rss > 0 else 0.0
