"""Local descent in the poles: Levenberg-Marquardt on Kaufman's Jacobian (design 4.2).

Modulo the columns of the regression, moving a pole changes the fitted output y_hat by -(dD_b/dp)/D_b y_hat,
D_b(z) being the denominator of its block: the numerator is re-fitted anyway. So the sensitivities are
combinations of the block's own states driven by y_hat, and dJ/dp = -2 r^T s_p holds exactly because r is
orthogonal to the columns.

The unknowns are decay rates and angles, linear, so that a pole can reach the circle: 1 - a for a real pole,
(s, f) with p = exp(-s +- j f) for a pair.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from ident.basis.coordinates import ZETA_LEAST, ZETA_LIMIT
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.data.arrays import RealArray, kernel_array
from ident.fit.descent import blocked, chain_rule, clip_parameters, descend, free_parameters
from ident.fit.kernels import _schur_drop
from ident.fit.least_squares import Linearisation
from ident.fit.regression import Regression

# Damping of the first step in units of the scaled normal matrix. From afar a full step mostly leads too far:
# half the evaluations of a descent that starts boldly are steps taken back.
NEAR, FAR = 1e-3, 1.0


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
        x = free_parameters(*poles.writable(), n_fixed_real, n_fixed_pairs)
        n_free_real = poles.real.size - n_fixed_real
        x = self.clip_parameters(x, n_free_real)
        pairs = np.exp(-x[n_free_real::2] + 1j * x[n_free_real + 1 :: 2])
        return Poles(
            np.concatenate([poles.real[:n_fixed_real], 1 - x[:n_free_real]]),
            np.concatenate([poles.pairs[:n_fixed_pairs], pairs]),
        )

    def clip_parameters(self, x: RealArray, n_free_real: int) -> RealArray:
        """Unknowns (1 - a; s, f) inside the bounds."""
        return np.asarray(clip_parameters(x, n_free_real, self.array))

    @cached_property
    def array(self) -> RealArray:
        """In the order of the fields, as `ident.fit.descent` takes them."""
        return np.array([getattr(self, field.name) for field in fields(self)])


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
    damping: float = NEAR,
) -> Polished:
    """Descend from the given poles; the first n_fixed ones of each type stay where they are.

    Stops when the decrease that the linearisation still promises is below `tolerance` of J. damping is that
    of the first step: `NEAR` an optimum, or `FAR` from one.
    """
    real, pairs = poles.writable()
    rss, iterations, converged = descend(
        real,
        pairs,
        n_fixed_real,
        n_fixed_pairs,
        bounds.array,
        data.u,
        data.y,
        data.y_clear,
        data.starts,
        data.polynomials,
        data.polynomials_q,
        data.structure.feedthrough,
        data.structure.estimate_initial_state,
        tolerance,
        max_iterations,
        damping,
    )
    return Polished(Poles(real, pairs), rss, iterations, converged)


def pole_system(
    here: Linearisation, poles: Poles, n_fixed_real: int = 0, n_fixed_pairs: int = 0
) -> tuple[RealArray, RealArray]:
    """Normal matrix (P, P) and S^T r (P,) of the free unknowns (1 - a; s, f); the gradient of J is -2 S^T
    r."""
    chain = chain_rule(*poles.writable(), n_fixed_real, n_fixed_pairs)
    return chain.T @ here.normal @ chain, chain.T @ here.gradient


def free_optimality(
    here: Linearisation, poles: Poles, bounds: Bounds, n_fixed_real: int = 0, n_fixed_pairs: int = 0
) -> float:
    """|P r|/|r| over the tangent directions of the poles that are neither fixed nor held by a bound.

    0 at an optimum. With records from rest, nothing fixed and no bound active this is |Phi2^T r|/|r| with
    orthonormal Phi2 (the basis with every pole doubled), by the tangent identity of design 4.2.
    """
    x = free_parameters(*poles.writable(), n_fixed_real, n_fixed_pairs)
    if x.size == 0 or here.rss <= 0:
        return 0.0
    normal, gradient = pole_system(here, poles, n_fixed_real, n_fixed_pairs)
    free = np.flatnonzero(~blocked(x, gradient, poles.real.size - n_fixed_real, bounds.array))
    scale = np.sqrt(np.maximum(np.diag(normal)[free], 1e-300))
    slope = gradient[free] / scale
    scaled = kernel_array(normal[np.ix_(free, free)] / (scale[:, None] * scale))
    share = float(_schur_drop(scaled, slope))
    return float(np.sqrt(max(share, 0.0) / here.rss))
