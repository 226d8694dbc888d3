"""How sure are frequency and damping? Intervals of the poles from the posterior of the response.

The tangent posterior has every pole p twice, so near p its response is q/(z - p)^2 + r/(z - p) + analytic, q
and r linear in the coefficients (`laurent_rows`): to first order the simple pole moved to p + q/r. Its
covariance is carried over to frequency, damping and decay by their derivatives with respect to log p. Delay
and integrators change nothing to first order. Intervals are symmetric in the logarithms of frequency, damping
and decay, and each holds by itself.
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

# Points of the circle on which a Laurent series is taken: they determine it to 1/3^15 = 7e-8 when the next
# pole is three radii away. Twice as many would be exact to rounding, which no interval needs.
_POINTS = 16
# Radius of that circle as a share of the distance to the next pole; see `_POINTS`.
_SHARE_OF_DISTANCE = 1 / 3
# Poles nearer than this in z are one pole but for rounding: no circle of doubles lies between them.
_SAME_POLE = 1e-12
# Factor on frequency, damping or decay beyond which an interval says nothing: (0, inf) is given in its place.
# Chosen: first order holds for changes far below it, so that any factor between 10 and 100 would say the
# same.
_NO_KNOWLEDGE = 20
# Least semi-axis of an ellipse, in units of the response, by which the contribution of a pair is divided: in
# place of zero, near the smallest double, so that it decides nothing else.
_SMALLEST_RADIUS = 1e-300


@dataclass(frozen=True, eq=False)
class PoleIntervals:
    """Ends (low, high) of confidence intervals, in the order of the poles.

    (0, inf) where the records do not tell, as of a pair that adds nothing outside the ellipses.

    Attributes
    ----------
    level : float
        Probability with which each interval holds the truth, taken by itself.
    omega_rad_s : ndarray, shape (P, 2)
        Natural frequency of the pairs, rad/s.
    zeta : ndarray, shape (P, 2)
        Damping ratio of the pairs, up to 1.
    decay_per_s : ndarray, shape (R, 2)
        Decay rate of the real poles, 1/s; NaN for a real pole a <= 0, which has none.
    """

    level: float
    omega_rad_s: RealArray
    zeta: RealArray
    decay_per_s: RealArray

    def __post_init__(self) -> None:
        """Lock the arrays; shapes are not checked, `pole_intervals` makes them."""
        lock(self, "omega_rad_s", "zeta", "decay_per_s")


def pole_intervals(posterior: ResponsePosterior, poles: Poles, level: float = 0.95) -> PoleIntervals:
    """Intervals around the poles of a model, from the tangent posterior made with them.

    Parameters
    ----------
    posterior : ResponsePosterior
        Its poles, mean, covariance factor and dt_s. It may have further poles.
    poles : Poles
        Of the model, in z, bit by bit those of the posterior: P pairs and R real ones.
    level : float
        Probability of each interval, between 0 and 1; also that of the ellipse beyond which a pair has to
        stand out. 0.95 is what all reports use.

    Returns
    -------
    PoleIntervals
        (0, inf), of zeta (0, 1), for a pair that stays inside the ellipse at its own frequency, and for a
        pole that the posterior has more often than twice.

    Raises
    ------
    ValueError
        Unless the posterior has each of these poles twice, and 0 < level < 1.

    Examples
    --------
    >>> found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    >>> intervals = flexlink.pole_intervals(flexlink.uncertainty(found), found.model.poles)
    >>> low, high = intervals.omega_rad_s[0]
    >>> bool(low < 20.0 < high)
    True
    """
    everything = posterior.poles.values
    for pole in (*poles.real, *poles.pairs):
        if np.count_nonzero(everything == pole) < 2:
            raise ValueError("the posterior does not hold every one of these poles twice (method 'tangent')")
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1; got {level}")
    width = float(norm.ppf(0.5 + level / 2))

    omega = poles.omega_rad_s(posterior.dt_s)
    zeta = poles.zeta()
    ends_omega = np.empty((omega.size, 2))
    ends_zeta = np.empty((omega.size, 2))
    for i, pole in enumerate(poles.pairs):
        deviation_omega = np.inf
        deviation_zeta = np.inf
        if _carried(posterior, pole, level) > 1:
            # d log p = d p / p; omega = |log p|, and d log(omega) = Re(d log p / log p).
            slope = _pole_rows(posterior, pole, everything) / (pole * np.log(pole))
            deviation_omega = float(np.linalg.norm(slope.real))
            # zeta = -Re(log p)/|log p|: with log p = -zeta w + j w sqrt(1 - zeta^2),
            # d zeta = Im(d log p / log p) sqrt(1 - zeta^2).
            by_zeta = slope.imag * np.sqrt(1 - zeta[i] ** 2) / zeta[i]
            deviation_zeta = float(np.linalg.norm(by_zeta))
        ends_omega[i] = _interval(float(omega[i]), deviation_omega, width)
        ends_zeta[i] = _interval(float(zeta[i]), deviation_zeta, width)

    ends_decay = np.full((poles.real.size, 2), np.nan)
    for i, a in enumerate(poles.real):
        if a > 0:
            # Decay -log a in units of the sampling time; d log(decay) = d a / (a log a).
            decay = -float(np.log(a))
            by_decay = _pole_rows(posterior, complex(a), everything).real / (a * decay)
            deviation = float(np.linalg.norm(by_decay))
            ends_decay[i] = _interval(decay / posterior.dt_s, deviation, width)
    return PoleIntervals(level, ends_omega, np.minimum(ends_zeta, 1.0), ends_decay)


def growth_intervals(posterior: ResponsePosterior, level: float = 0.95) -> RealArray:
    """Ends (U, 2) of the growth rate log|p| / dt_s, 1/s, of each unstable pole, real ones before pairs.

    Parameters
    ----------
    posterior : ResponsePosterior
        Of an arm with U unstable real poles and pairs (`ResponsePosterior.unstable`, which holds their mirror
        images a; how far each image is off are its last coefficients).
    level : float
        Probability of each interval by itself, between 0 and 1; not checked: outside, the ends are NaN. 0.95
        is what all reports use.

    Returns
    -------
    ndarray, shape (U, 2)
        Symmetric around the estimate, to first order; (0, 2) for a stable plant.
    """
    unstable = posterior.unstable
    n_real = unstable.real.size
    poles = np.array([*unstable.real, *unstable.pairs], dtype=np.complex128)
    # log|p| = -log|a|, a the mirror image: its derivatives with respect to a, or to Re a and Im a of a pair.
    slopes = np.zeros((poles.size, unstable.order))
    slopes[np.arange(n_real), np.arange(n_real)] = -1 / unstable.real
    for i, pole in enumerate(unstable.pairs):
        first = n_real + 2 * i
        re_and_im = np.array([pole.real, pole.imag])
        slopes[n_real + i, first : first + 2] = -re_and_im / abs(pole) ** 2
    off = slice(posterior.mean.size - unstable.order, None)
    centre = -np.log(np.abs(poles)) + slopes @ posterior.mean[off]
    deviation = np.linalg.norm(slopes @ posterior.covariance_factor[off], axis=1)
    half = norm.ppf(0.5 + level / 2) * deviation
    return np.column_stack([centre - half, centre + half]) / posterior.dt_s


def _pole_rows(posterior: ResponsePosterior, pole: complex, everything: ComplexArray) -> ComplexArray:
    """Deviation of the pole, in z, as a complex row (P',) on the unit normals of the covariance factor.

    everything (P,): all poles of the posterior, `pole` at least twice among them (its caller has checked).
    P' is the number of columns of its covariance factor. Infinite where the posterior does not tell the
    pole's place: it has the pole three times, or its residue is zero.
    """
    n_normals = posterior.covariance_factor.shape[1]
    # A pole that the basis has more often than twice has no displacement of its own.
    if np.count_nonzero(everything == pole) > 2:
        return np.full(n_normals, np.inf + 0j)
    simple, double = laurent_rows(posterior.poles, pole)
    n = posterior.poles.order
    mean = posterior.mean[:n]
    factor = posterior.covariance_factor[:n]
    r = simple @ mean
    q = double @ mean
    if abs(r) == 0:
        return np.full(n_normals, np.inf + 0j)
    # Derivative of q/r; q itself is zero at the optimum, up to what the kernel took over.
    by_double = (double @ factor) / r
    by_simple = (simple @ factor) * q / r**2
    return np.asarray(by_double - by_simple)


def _carried(posterior: ResponsePosterior, pole: complex, level: float) -> float:
    """What a pair adds to the response at its own frequency, in radii of the ellipse there.

    No unit; up to one the pair need not exist. pole: upper one of a pair of the posterior, in z. level: of
    the ellipse, between 0 and 1; its radius is the larger semi-axis.
    """
    omega = np.array([np.angle(pole) / posterior.dt_s])
    z = pole / np.array([abs(pole)])
    simple, _ = laurent_rows(posterior.poles, pole)
    r = simple @ posterior.mean[: posterior.poles.order]
    front = front_response(omega, posterior.dt_s, posterior.integrators, posterior.input_delay_samples)
    partial_fractions = r / (z - pole) + np.conj(r) / (z - np.conj(pole))
    contribution = front / all_pass_response(posterior.unstable, z) * partial_fractions
    radius = posterior.at(omega, level).ellipse().semi_major[0]
    return float(np.abs(contribution[0]) / max(radius, _SMALLEST_RADIUS))


def laurent_rows(poles: Poles, pole: complex) -> tuple[ComplexArray, ComplexArray]:
    """Rows (P,) on the coefficients of poles taken twice: what stands before 1/(z - pole) and 1/(z - pole)^2.

    To first order the pole has moved by the ratio of the second to the first.

    Parameters
    ----------
    poles : Poles
        Of the basis, P in all, `pole` twice among them.
    pole : complex
        In z. Not checked: of a point that is no pole of the basis both rows are zero but for rounding, and of
        one that is there three times the terms of third order are left out.

    Notes
    -----
    By Cauchy's integral over a circle around the pole, that no other pole is in.
    """
    distance = np.abs(poles.values - pole)
    # Of a basis of one pole alone nothing limits the circle: 1 stands in for a distance.
    other_poles = distance > _SAME_POLE
    next_pole = float(distance[other_poles].min(initial=1.0))
    radius = _SHARE_OF_DISTANCE * next_pole
    angles = 2j * np.pi * np.arange(_POINTS) / _POINTS
    away = radius * np.exp(angles)
    rows = basis_response(poles, pole + away)
    simple = np.mean(rows * away[:, None], axis=0)
    double = np.mean(rows * (away**2)[:, None], axis=0)
    return simple, double


def _interval(value: float, deviation: float, width: float) -> tuple[float, float]:
    """Ends: value times exp(-width deviation) and exp(width deviation).

    value: the estimate, positive, in the unit of the ends. deviation: standard deviation of its logarithm;
    width: half of the interval, in such deviations. (0, inf) for a factor of `_NO_KNOWLEDGE` or more, and for
    a deviation that is infinite or NaN.
    """
    if not width * deviation < np.log(_NO_KNOWLEDGE):
        return 0.0, float("inf")
    factor = float(np.exp(width * deviation))
    return value / factor, value * factor
