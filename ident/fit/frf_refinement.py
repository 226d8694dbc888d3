"""Local descent of the poles on a measured frequency response: Levenberg-Marquardt in log coordinates.

The unknowns are ln(1 - a) of each real pole and (ln omega, ln zeta) of each pair, in rad/sample: a box, so
that a bound is a plain clip. Nothing is lost against linear decay rates as in the time domain: a response
measured at finitely many frequencies cannot ask for a pole on the circle without a zero error there.
"""

from __future__ import annotations

import numpy as np

from ident.basis.poles import Poles
from ident.data.arrays import RealArray
from ident.fit.frf_regression import FrfRegression, fit_response, pole_directions
from ident.fit.refinement import Bounds, Polished


def to_log(poles: Poles, n_fixed_real: int, n_fixed_pairs: int) -> RealArray:
    """(P,) unknowns of the poles that are free."""
    log = np.log(poles.pairs[n_fixed_pairs:])
    omega = np.abs(log)
    pairs = np.column_stack([np.log(omega), np.log(-log.real / omega)]).ravel()
    return np.concatenate([np.log1p(-poles.real[n_fixed_real:]), pairs])


def from_log(x: RealArray, poles: Poles, n_fixed_real: int, n_fixed_pairs: int) -> Poles:
    """The poles with their free ones replaced by those of the unknowns x (P,)."""
    n_free = poles.real.size - n_fixed_real
    omega, zeta = np.exp(x[n_free::2]), np.exp(x[n_free + 1 :: 2])
    pairs = np.exp(omega * (-zeta + 1j * np.sqrt((1 - zeta) * (1 + zeta))))
    return Poles(
        np.concatenate([poles.real[:n_fixed_real], -np.expm1(x[:n_free])]),
        np.concatenate([poles.pairs[:n_fixed_pairs], pairs]),
    )


def box(bounds: Bounds, n_real: int, n_pairs: int) -> tuple[RealArray, RealArray]:
    """Lowest and highest unknowns (P,) for n_real real poles and n_pairs pairs that are free."""
    low = [np.log(bounds.distance_min)] * n_real + [
        np.log(bounds.omega_min),
        np.log(bounds.zeta_min),
    ] * n_pairs
    high = [np.log(bounds.distance_max)] * n_real
    high += [np.log(bounds.omega_max), np.log(bounds.zeta_max)] * n_pairs
    return np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)


def polish_response(
    data: FrfRegression,
    poles: Poles,
    bounds: Bounds,
    *,
    n_fixed_real: int = 0,
    n_fixed_pairs: int = 0,
    tolerance: float = 1e-9,
    max_iterations: int = 80,
) -> Polished:
    """Descend from the given poles; the first n_fixed ones of each type stay where they are.

    Ends when the decrease that the linearisation still promises is below `tolerance` of J.
    """
    low, high = box(bounds, poles.real.size - n_fixed_real, poles.pairs.size - n_fixed_pairs)
    x = np.clip(to_log(poles, n_fixed_real, n_fixed_pairs), low, high)
    current = from_log(x, poles, n_fixed_real, n_fixed_pairs)
    here = fit_response(data, current)
    floor = 1e-26 * float(data.y @ data.y)
    damping, growth = 1e-3, 2.0
    for iteration in range(max_iterations):
        directions = pole_directions(data, current, here, n_fixed_real, n_fixed_pairs)
        slope = directions.T @ here.residual
        free = np.flatnonzero(~(((x <= low) & (slope < 0)) | ((x >= high) & (slope > 0))))
        if here.rss <= floor or free.size == 0:
            return Polished(current, here.rss, iteration, True)
        scale = np.maximum(np.linalg.norm(directions[:, free], axis=0), 1e-150)
        left, values, right = np.linalg.svd(directions[:, free] / scale, full_matrices=False)
        target = left.T @ here.residual
        if target @ target <= tolerance * here.rss:
            return Polished(current, here.rss, iteration, True)
        while True:
            gain = values / (values**2 + damping)
            trial_x = x.copy()
            # A step of more than a factor of e in one unknown has left the linearisation.
            trial_x[free] += np.clip(right.T @ (gain * target) / scale, -1.0, 1.0)
            trial_x = np.clip(trial_x, low, high)
            trial_poles = from_log(trial_x, poles, n_fixed_real, n_fixed_pairs)
            trial = fit_response(data, trial_poles)
            promised = float(np.sum(target**2 * (2 * values * gain - (values * gain) ** 2)))
            ratio = (here.rss - trial.rss) / promised if promised > 0 else 0.0
            if ratio > 1e-4:
                break
            damping *= growth
            growth *= 2
            if damping > 1e12:
                return Polished(current, here.rss, iteration, False)
        x, current, here = trial_x, trial_poles, trial
        damping *= max(1 / 5, 1 - (2 * ratio - 1) ** 3)
        growth = 2.0
    return Polished(current, here.rss, max_iterations, False)
