"""How sure are frequency and damping? Intervals of the poles from the posterior of the response.

The tangent posterior has every pole p twice, so near p its response is q/(z - p)^2 + r/(z - p) + analytic, q
and r linear in the coefficients: to first order the simple pole moved to p + q/r. Delay and integrators
change nothing to first order. Intervals are symmetric in the logarithms of frequency, damping and decay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from ident.basis.functions import all_pass_response, basis_response
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.basis.structure import front_response
from ident.data.arrays import ComplexArray, RealArray, lock

# 16 points determine a Laurent series to 1/3^15 = 7e-8 when the next pole is three radii away.
_POINTS = 16
_SHARE_OF_DISTANCE = 1 / 3  # see `_POINTS`
# Poles nearer than this in z are one pole but for rounding: no circle of doubles lies between them.
_SAME_POLE = 1e-12
_NOTHING = np.array([np.inf + 1j * np.inf])  # deviation of what records do not tell


@dataclass(frozen=True, eq=False)
class PoleIntervals:
    """Ends (low, high) of confidence intervals, in the order of the poles.

    omega_rad_s (P,2), zeta (P,2) of the pairs, decay_per_s (R,2) of the real poles; each holds the truth with
    probability `level`, taken alone. (0, inf) where the records do not tell, as of a pair that adds nothing
    outside the ellipses; NaN for a real pole a <= 0.
    """

    level: float
    omega_rad_s: RealArray
    zeta: RealArray
    decay_per_s: RealArray

    def __post_init__(self) -> None:
        lock(self, "omega_rad_s", "zeta", "decay_per_s")


def pole_intervals(posterior: ResponsePosterior, poles: Poles, level: float = 0.95) -> PoleIntervals:
    """Intervals around the poles of a model, from the tangent posterior made with them.

    The posterior may have further poles. Raises ValueError unless it has each of these twice, and
    0 < level < 1.
    """
    everything = posterior.poles.values
    if any(np.count_nonzero(everything == pole) < 2 for pole in (*poles.real, *poles.pairs)):
        raise ValueError("the posterior does not hold every one of these poles twice (method 'tangent')")
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1; got {level}")
    width = float(norm.ppf(0.5 + level / 2))
    omega, zeta = poles.omega_rad_s(posterior.dt_s), poles.zeta()
    ends_omega, ends_zeta = np.empty((omega.size, 2)), np.empty((omega.size, 2))
    for i, pole in enumerate(poles.pairs):
        # d log p = d p / p; omega = |log p|, and d log(omega) = Re(d log p / log p).
        told = _carried(posterior, pole, level) > 1
        slope = _pole_rows(posterior, pole, everything) / (pole * np.log(pole)) if told else _NOTHING
        by_omega = slope.real
        # zeta = -Re(log p)/|log p|: with log p = -zeta w + j w sqrt(1 - zeta^2),
        # d zeta = Im(d log p / log p) sqrt(1 - zeta^2).
        by_zeta = slope.imag * np.sqrt(1 - zeta[i] ** 2) / zeta[i]
        ends_omega[i] = _interval(float(omega[i]), float(np.linalg.norm(by_omega)), width)
        ends_zeta[i] = _interval(float(zeta[i]), float(np.linalg.norm(by_zeta)), width)
    ends_decay = np.full((poles.real.size, 2), np.nan)
    for i, a in enumerate(poles.real):
        if a > 0:
            decay = -float(np.log(a))
            by_decay = _pole_rows(posterior, complex(a), everything).real / (a * decay)
            ends_decay[i] = _interval(decay / posterior.dt_s, float(np.linalg.norm(by_decay)), width)
    return PoleIntervals(level, ends_omega, np.minimum(ends_zeta, 1.0), ends_decay)


def growth_intervals(posterior: ResponsePosterior, level: float = 0.95) -> RealArray:
    """(U, 2) ends of the growth rate log|p| / dt_s, 1/s, of each unstable pole, real ones before pairs."""
    unstable, n = posterior.unstable, posterior.unstable.real.size
    poles = np.array([*unstable.real, *unstable.pairs], dtype=np.complex128)
    # log|p| = -log|a|, a the mirror image.
    slopes = np.zeros((poles.size, unstable.order))
    slopes[np.arange(n), np.arange(n)] = -1 / unstable.real
    for i, pole in enumerate(unstable.pairs):
        slopes[n + i, n + 2 * i : n + 2 * i + 2] = -np.array([pole.real, pole.imag]) / abs(pole) ** 2
    own = slice(posterior.mean.size - unstable.order, None)
    centre = -np.log(np.abs(poles)) + slopes @ posterior.mean[own]
    half = norm.ppf(0.5 + level / 2) * np.linalg.norm(slopes @ posterior.covariance_factor[own], axis=1)
    return np.column_stack([centre - half, centre + half]) / posterior.dt_s


def _pole_rows(posterior: ResponsePosterior, pole: complex, everything: ComplexArray) -> ComplexArray:
    """Deviation of the pole as a complex row (P',) on the columns of the covariance factor."""
    # A pole that the basis has more often than twice has no displacement of its own.
    if np.count_nonzero(everything == pole) > 2:
        return np.full(posterior.covariance_factor.shape[1], np.inf + 0j)
    simple, double = laurent_rows(posterior.poles, pole)
    n = posterior.poles.order
    mean, factor = posterior.mean[:n], posterior.covariance_factor[:n]
    r, q = simple @ mean, double @ mean
    if abs(r) == 0:
        return np.full(factor.shape[1], np.inf + 0j)
    # Derivative of q/r; q itself is zero at the optimum, up to what the kernel took over.
    return np.asarray((double @ factor) / r - (simple @ factor) * q / r**2)


def _carried(posterior: ResponsePosterior, pole: complex, level: float) -> float:
    """What a pair adds to the response at its own frequency, in radii of the ellipse there: up to one it need
    not exist."""
    omega, z = np.array([np.angle(pole) / posterior.dt_s]), pole / np.array([abs(pole)])
    r = laurent_rows(posterior.poles, pole)[0] @ posterior.mean[: posterior.poles.order]
    front = front_response(omega, posterior.dt_s, posterior.integrators, posterior.input_delay_samples)
    own = (
        front / all_pass_response(posterior.unstable, z) * (r / (z - pole) + np.conj(r) / (z - np.conj(pole)))
    )
    return float(np.abs(own[0]) / max(posterior.at(omega, level).ellipse().semi_major[0], 1e-300))


def laurent_rows(poles: Poles, pole: complex) -> tuple[ComplexArray, ComplexArray]:
    """(P,) rows on the coefficients of poles taken twice: what stands before 1/(z - pole) and 1/(z - pole)^2;
    to first order the pole has moved by their ratio."""
    away = np.abs(poles.values - pole)
    radius = _SHARE_OF_DISTANCE * float(away[away > _SAME_POLE].min(initial=1.0))
    turn = np.exp(2j * np.pi * np.arange(_POINTS) / _POINTS)
    rows = basis_response(poles, pole + radius * turn)
    return (
        np.mean(rows * (radius * turn)[:, None], axis=0),
        np.mean(rows * ((radius * turn) ** 2)[:, None], axis=0),
    )


def _interval(value: float, deviation: float, width: float) -> tuple[float, float]:
    """value times exp(-+ width deviation); a deviation beyond a factor 20 is no knowledge at all."""
    if not width * deviation < np.log(20):
        return 0.0, float("inf")
    factor = float(np.exp(width * deviation))
    return value / factor, value * factor
