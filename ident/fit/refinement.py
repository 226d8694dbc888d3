"""Local refinement of the poles: Levenberg-Marquardt on Kaufman's Jacobian (BIT 15, 1975).

Modulo the columns of the regression, moving a pole changes the fitted output y_hat by -(dD_b/dp)/D_b y_hat,
D_b(z) the denominator of its block: sensitivities are combinations of the block's states driven by y_hat, and
dJ/dp = -2 r^T s_p is exact. Unknowns, so that a pole can reach the circle: 1 - a of a real pole, (s, f) with
p = exp(-s +- j f) of a pair (`ident.fit.pole_unknowns`). `Bounds` says where poles may go, `refine` goes
downhill from given poles, `free_optimality` says how far from an optimum some poles are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ident.basis.coordinates import ZETA_LEAST, ZETA_LIMIT
from ident.basis.options import IdentOptions
from ident.basis.poles import NO_POLES, Poles
from ident.data.arrays import RealArray
from ident.fit.pole_unknowns import (
    LARGEST_ANGLE_SHARE,
    chain_rule,
    damped_step,
    free_parameters,
    scaled_system,
    start,
)
from ident.fit.problem import Linearisation, Linearised

# Damping of the first step near an optimum, in units of the scaled normal matrix: practically a full step.
NEAR = 1e-3
# Damping of the first step from afar: half a step where directions are orthogonal. From there a full step
# leads too far: half the evaluations of a refinement that starts so boldly are steps taken back.
FAR = 1.0
# A step that does not gain multiplies the damping by this, the next one by its square, and so on: a start
# that is too bold is brought back in few steps. Chosen; Nielsen (1999) has 2. With 2 or 8 no test of fits
# fails.
_GROWTH = 4.0
# Least fall of J, as a share of what the linearisation promised, with which a step is taken. The usual small
# number of trust regions (More, 1978): any true fall counts.
_LEAST_GAIN = 1e-4
# Damping, in units of the scaled normal matrix, above which a refinement gives up: a step is then 1e-12 of a
# full one, and what it could gain is rounding.
_LARGEST_DAMPING = 1e12
# Least factor of the damping after a step that gains as promised (Nielsen, 1999, has 1/3). Chosen; a
# refinement that starts `FAR` so takes practically full steps (`NEAR`) after four that gain.
_LEAST_RELIEF = 1 / 5
# Share of |y|^2 below which J is rounding: residuals of 1e-13 of the output.
_EXPLAINED = 1e-26
# Decay over the longest record below which a pole cannot be told from one on the circle: it loses a
# thousandth there. Chosen.
_STILL = 1e-3
# Largest 1 - a of a real pole: those down to -.95 are reached by refinement only; they have no continuous
# counterpart, so no search starts there.
_LARGEST_DISTANCE = 1.95
# Lowest frequency of a pair, rad in the longest record: 1/63 of a period there looks like a straight line.
# Chosen.
_LEAST_ANGLE_PER_RECORD = 0.1


@dataclass(frozen=True)
class Bounds:
    """Sides that a refined pole keeps: user bounds, and the circle itself.

    Compiled code takes all of them in this order (`ident.fit.pole_unknowns`). Nothing is checked: where a
    lower bound is above its upper one, the upper one holds (of s_min: the lower).

    Attributes
    ----------
    distance_min, distance_max : float
        1 - a of real poles.
    omega_min, omega_max : float
        |log p| of pairs, rad/sample.
    zeta_min, zeta_max : float
        Damping ratio of pairs.
    s_min : float
        Least decay per sample of a pair.
    measured_rad : tuple of (low, high)
        Bands, rad/sample, of which one has to come within the half-power width of every pole; none: poles may
        be as narrow as the other bounds allow.
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
        """Bounds stated by the user; else only what keeps a pole usable over a record of `longest` samples.

        options : IdentOptions: decay_min_per_s to zeta_max, None where nothing was stated, checked there
        against each other. longest: at least 1 (ZeroDivisionError for 0). dt_s: sampling time, s, positive. A
        stated bound beyond what a record shows can leave a side empty, which is not refused here.
        """
        still = _STILL / longest
        largest_angle = LARGEST_ANGLE_SHARE * np.pi

        def distance(decay_per_s: float | None, default: float) -> float:
            """1 - a of a stated decay, 1/s, or the default (of 1 - a) where it is None."""
            return default if decay_per_s is None else -float(np.expm1(-decay_per_s * dt_s))

        def angle(omega_rad_s: float | None, default: float) -> float:
            """Angle per sample of a stated frequency, rad/s, or the default (rad/sample) where it is None."""
            return default if omega_rad_s is None else omega_rad_s * dt_s

        return cls(
            distance_min=max(distance(options.decay_min_per_s, still), still),
            distance_max=distance(options.decay_max_per_s, _LARGEST_DISTANCE),
            omega_min=angle(options.omega_min_rad_s, _LEAST_ANGLE_PER_RECORD / longest),
            omega_max=min(angle(options.omega_max_rad_s, largest_angle), largest_angle),
            zeta_min=ZETA_LEAST if options.zeta_min is None else options.zeta_min,
            zeta_max=ZETA_LIMIT if options.zeta_max is None else options.zeta_max,
            s_min=still,
        )

    def shown_by(self, measured_rad: RealArray) -> Bounds:
        """Bounds for poles that have a measured band within their half-power width.

        Parameters
        ----------
        measured_rad : ndarray, shape (K, 2)
            Low and high end of each band, ascending, from 0 to pi rad/sample; at least one (IndexError else).
            Order and range are not checked.

        Returns
        -------
        Bounds
            Never wider than this one.

        Notes
        -----
        A real pole a > 0 is a resonance at 0 whose half-power width is -ln a, one with a < 0 is a resonance
        at pi of width -ln |a|. So the first must decay as fast as the lowest band is high, and the second as
        fast as the highest band is below pi.
        """
        slowest = float(measured_rad[0, 0])
        fastest = np.pi - float(measured_rad[-1, 1])
        least_distance = -float(np.expm1(-slowest))
        largest_distance = 1 + float(np.exp(-fastest))
        return replace(
            self,
            distance_min=max(self.distance_min, least_distance),
            distance_max=min(self.distance_max, largest_distance),
            measured_rad=tuple((float(low), float(high)) for low, high in measured_rad),
        )

    @cached_property
    def array(self) -> RealArray:
        """Bounds as compiled code takes them, (7 + 2 K,): in the order of the fields, K bands low and
        high."""
        scalars = [
            self.distance_min,
            self.distance_max,
            self.omega_min,
            self.omega_max,
            self.zeta_min,
            self.zeta_max,
            self.s_min,
        ]
        band_ends = [end for band in self.measured_rad for end in band]
        return np.array([*scalars, *band_ends])


@dataclass(frozen=True, eq=False)
class Refined:
    """End of a refinement.

    Attributes
    ----------
    poles : Poles
        Best poles, the fixed ones first of each type.
    rss : float
        Their residual sum of squares J, square of the unit of the data; NaN where theirs is.
    iterations : int
        Steps that gained.
    converged : bool
        A stationary point was reached, within the tolerance.
    """

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
    """Poles downhill from the given ones, where the linearisation promises no further fall.

    Parameters
    ----------
    problem : Linearised
        Cost and linearisation at given poles; `power` is |y|^2.
    poles : Poles
        Where to start; the fixed ones first of each type.
    bounds : Bounds
        Where poles may go; a start outside is brought inside.
    fixed : Poles
        Poles that do not move.
    max_iterations : int
        Most steps that gain. 60 is chosen; a refinement that ends there has not converged.
    tolerance : float
        Promised fall of J, as a share of it, below which a point counts as stationary. d standard
        deviations of a pole cost about d^2 / N of J, so that at 1e-9 poles are off by .003 of theirs for
        N = 10 000 samples.
    damping : float
        Of the first step, `NEAR` an optimum or `FAR` from one.

    Returns
    -------
    Refined
        Not converged: steps ran out, or no step gained (also where J is NaN: the start comes back, inside the
        bounds). Without free poles: the start, converged.

    Notes
    -----
    Damping after Nielsen (IMM-REP-1999-05): a step that gains multiplies it by 1 - (2 ratio - 1)^3, ratio
    the fall over the promised one, 1/5 at least; a step that does not gain is shortened ever faster. That
    `fixed` come first of each type is not checked; more fixed poles than there are: IndexError.
    """
    real, pairs = poles.writable()
    n_fixed = fixed.counts
    limits = bounds.array
    x = start(real, pairs, *n_fixed, limits)
    current = problem.linearise(real, pairs)
    trial_real = real.copy()
    trial_pairs = pairs.copy()
    # Residuals at rounding level relative to the output: nothing left to gain.
    floor = _EXPLAINED * problem.power
    growth = _GROWTH
    for iteration in range(max_iterations):
        system, slope, scale, free, promised = scaled_system(
            x, real, pairs, *n_fixed, limits, current.normal, current.gradient
        )
        if current.rss <= floor or promised <= tolerance * current.rss:
            return Refined(Poles(real, pairs), current.rss, iteration, True)

        # Shorten the step until it gains.
        while True:
            trial_x, promised_by_step = damped_step(
                x, *n_fixed, limits, system, slope, scale, free, damping, trial_real, trial_pairs
            )
            ratio = 0.0
            if promised_by_step > 0:
                trial = problem.linearise(trial_real, trial_pairs, current.rss)
                ratio = (current.rss - trial.rss) / promised_by_step
                if ratio > _LEAST_GAIN:
                    break
            damping *= growth
            growth *= _GROWTH
            if damping > _LARGEST_DAMPING:
                # No step of any length gains: the linearisation's promise is rounding, or a bound's corner.
                return Refined(Poles(real, pairs), current.rss, iteration, False)

        # Take it; the arrays of the old poles are those of the next trial.
        x = trial_x
        current = trial
        real, trial_real = trial_real, real
        pairs, trial_pairs = trial_pairs, pairs
        # Nielsen's cubic: 2 for a ratio of 0, 1 at 1/2, `_LEAST_RELIEF` from about .96 on.
        damping *= max(_LEAST_RELIEF, 1 - (2 * ratio - 1) ** 3)
        growth = _GROWTH
    return Refined(Poles(real, pairs), current.rss, max_iterations, False)


def pole_system(here: Linearisation, poles: Poles, fixed: Poles = NO_POLES) -> tuple[RealArray, RealArray]:
    """Normal matrix (P, P) and S^T r (P,) of the free unknowns (1 - a; s, f); the gradient of J is -2 S^T r.

    here : Linearisation: normal (B, B) and gradient (B,) at these poles, B their order (ValueError of numpy
    for another); fixed: first of each type, not checked. P: numbers of the poles that are not fixed. Bounds
    play no part. Unit: that of J over that of the unknowns, which have none.
    """
    # Too seldom to be compiled by itself.
    chain = chain_rule.py_func(*poles.writable(), *fixed.counts)
    return chain.T @ here.normal @ chain, chain.T @ here.gradient


def free_optimality(here: Linearisation, poles: Poles, bounds: Bounds, fixed: Poles = NO_POLES) -> float:
    """Share |P r|/|r| of the residual that moving poles could explain, to first order: 0 at an optimum, at
    most 1.

    P projects on the tangent directions of the poles that are neither fixed nor held by a bound. With records
    from rest and nothing held it is |Phi2^T r|/|r|, Phi2 the orthonormal doubled basis.

    here : Linearisation: rss, normal (B, B) and gradient (B,) at these poles, of which bounds.array tells
    those that stand on a bound. No unit; 0 where rss is 0 or NaN. Compiled: that B fits the poles is not
    checked.
    """
    known = (*poles.writable(), *fixed.counts)
    x = free_parameters(*known)
    promised = scaled_system(x, *known, bounds.array, here.normal, here.gradient)[-1]
    return float(np.sqrt(max(promised, 0.0) / here.rss)) if here.rss > 0 else 0.0
