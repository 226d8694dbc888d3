"""An integrating axis whose slow rate is hardly known, as a few posteriors that hold it together.

An axis G = k / (s (s + p)) answers a force 1 / G that is linear in its rate p. Where the data tell p to a
factor of eighty only, or no lower end of it at all, one ellipse that holds every gain holds zero, too, and
no controller can be certified. The rate is positive, so its interval has two ends; `rate_members` parts it so
that the ellipses of each part keep zero outside. What is certified for all of them is certified for the axis.

The force at a frequency is a segment, F (1 + e eta), e from -1 to 1, about the force F in the middle. Its
gain is an arc of a circle, A (e + eta) / (1 + e eta) about the middle of its ends, A its half chord; a disc
holds it that is |eta| of its centre wide.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import ndtri_exp
from scipy.stats import norm

from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.checks.plausible_modes import LARGEST_DAMPING
from ident.data.arrays import BoolArray, ComplexArray, RealArray
from ident.data.ellipses import LEVEL, chi2_radius
from ident.friction.further_poles import frequencies_of, on_further_poles

# Probability of a rate beyond either end of the interval that the members share: half of the 5 % that
# ellipses leave out; the other half is for everything else that is not known. Halved, a rate that may be none
# is held down to half of the lowest one.
_TAIL = 0.0125
# Size of an ellipse to first order, over the gain, from which on a negative damping counts: it would hold the
# opposite of the response. Chosen: where it is smaller, a lag of the drive looks like a negative damping.
_AS_MUCH = 2
# Half width of a member's force over the middle, at most: a rate known to a factor of seven. Where the arc
# bows most its ellipse then is .84 of its centre wide. Zero is held from 1 on, and the rest that is not known
# adds a tenth. With .85, a factor of twelve, ellipses hold zero.
_WIDEST = 0.75
# Members at most: a normal that is cut off at zero has no more than a factor of 350 between its ends.
_MOST_MEMBERS = 4
# Factor on the width across an arc. Three columns, a quarter turn or more of the all-pass apart, are at their
# narrowest 5 % less than the arc bows (tests/ident/test_rate_members.py; to a half width of .3).
_ACROSS = 1.05
# From this many times the frequency where an arc bows most its ellipse gets 1.4 times as long, so that rates
# at the arc's ends have nearly the width across that the others have. Chosen: gains are far from zero there.
# Doubled, draws of the highest rates lie outside over an octave more.
_LONGER_FROM = 4
# Factor by which the gain is known less again, over itself, where slow motions end. Chosen: towards a zero it
# grows without end, and a decade of slow motion does not let it grow at all.
_KNOWN_LESS_AGAIN = 2
# Octaves over which a change of the force turns into one of the gain, from three below the first light mode
# to one. Chosen: over one octave the poles of the arm follow it less well.
_TURNS_OVER = 2


@dataclass(frozen=True, eq=False)
class RateMember:
    """Posterior of an axis whose slow rate lies in a part of its interval.

    Attributes
    ----------
    response : ResponsePosterior
    poles : Poles
        Of the arm, the slowest real one at the member's rate.
    from_rad_s, to_rad_s : float or None
        Ends of the part, as the frequency above which the axis is an inertia: 1 / s^2. None: that of the
        whole interval.
    """

    response: ResponsePosterior
    poles: Poles
    from_rad_s: float | None
    to_rad_s: float | None


def rate_members(response: ResponsePosterior, poles: Poles, longest_s: float) -> tuple[RateMember, ...]:
    """Posteriors that together hold an axis whose slow rate is hardly known.

    Parameters
    ----------
    response : ResponsePosterior
        Whose covariance is that of the response, to first order, on P' unit normals.
    poles : Poles
        Of the arm, which the response has twice.
    longest_s : float
        Length of the longest record, s.

    Returns
    -------
    tuple of RateMember
        The one that holds the mean response first, else the nearest, the others by their rate. Empty where
        ellipses to first order do not hold zero, of an arm that does not integrate or is unstable, where the
        data deny every damping, and where parts of a rate do not keep zero outside.

    Notes
    -----
    The response is linear, G = G0 (1 + x t) with normals t: to first order a force (1 - x t) / G0. One normal
    moves the force at rest. Its values are those at which the damping Re(force / jw) is nowhere negative
    where an ellipse to first order would hold the opposite of the response; what is left is a normal that is
    cut off there. Its interval without `_TAIL` on either side is parted at equal ratios. A relative change by
    another normal is the same of every member. Neglected: bends above the first light mode, and lags of a
    drive in the damping.
    """
    if response.integrators != 1 or response.unstable.order:
        return ()
    omega = frequencies_of(response, longest_s)
    rows = response.frequency_rows(omega)
    gain = rows @ response.mean
    change = (rows @ response.covariance_factor) / gain[:, None]
    low = below_modes(omega, change, poles, response.dt_s)
    at_rest = change[0].real
    deviation = float(np.linalg.norm(at_rest))
    if not (low.any() and deviation > 0):
        return ()

    # Where an ellipse to first order would hold zero. Above, or where one does so least, the sign of the
    # inertia is known.
    x = change @ (at_rest / deviation)
    size = chi2_radius(LEVEL) * np.abs(x)
    if size[0] < 1:
        return ()
    # The first of the least sizes, those below one taken alike.
    known_at = int(np.argmin(np.where(low, np.maximum(size, 1), np.inf)))
    # Force over speed, without the delay of the input and of the hold.
    delay_s = (response.input_delay_samples + 0.5) * response.dt_s
    force = np.exp(-1j * omega * delay_s) / (1j * omega * gain)
    # An inertia is positive.
    force = force * np.copysign(1.0, force[known_at].imag)

    # A unit normal whose growth takes force away, and its values that leave a damping.
    turn = np.copysign(1.0, force[0].real)
    direction = turn * at_rest / deviation
    x = turn * x
    by_normal = (x * force).real
    counts = low & (size >= min(_AS_MUCH, size[0])) & (by_normal > 0)
    undamped = float(np.min(force.real[counts] / by_normal[counts]))
    # A damping that the data deny is not taken for granted.
    if undamped < -chi2_radius(LEVEL):
        return ()
    edges = _edges(undamped, x[low])
    if edges.size == 0:
        return ()

    others = change - np.outer(x, direction)
    corners = [_corner(omega, force * (1 - x * (undamped - edge))) for edge in edges]
    corners_between = [None, *corners[1:-1], None]
    members = list[RateMember]()
    for k, (slowest, fastest) in enumerate(pairwise(edges.tolist())):
        normal = undamped - (slowest + fastest) / 2
        between = 1 - x * normal
        half = x * (fastest - slowest) / 2 / between
        wanted = _covering(omega, x, normal, half, others, low)
        weight = 1 / np.linalg.norm(wanted, axis=1)
        bent = on_further_poles(response, poles, omega, wanted, weight)
        own_poles = _with_rate(poles, _corner(omega, force * between), response.dt_s)
        members.append(RateMember(bent, own_poles, corners_between[k], corners_between[k + 1]))

    # The mean response has the damping `undamped`, in deviations.
    nearest = int(np.count_nonzero(edges[1:-1] < undamped))
    return (members.pop(nearest), *members)


def _edges(undamped: float, x: ComplexArray) -> RealArray:
    """Ends (M + 1,) of the parts of an interval, as dampings in deviations above none; (0,) for too many.

    undamped: the mean; x (F,): relative change of the force by one deviation, where a change is one of force.
    """
    for n_members in range(1, _MOST_MEMBERS + 1):
        edges = np.geomspace(*_positive_interval(undamped), n_members + 1)
        middles = (edges[1:] + edges[:-1]) / 2
        between = 1 - np.outer(x, undamped - middles)
        half = np.outer(x, np.diff(edges) / 2) / between
        if np.max(np.abs(half)) <= _WIDEST:
            return edges
    return np.zeros(0)


def below_modes(omega: RealArray, change: ComplexArray, poles: Poles, dt_s: float) -> BoolArray:
    """Mask (F,) of the frequencies omega, rad/s, at which a change of the gain is one of the force of a slow
    motion.

    They end where the gain is known best, the first time: towards a light zero it is known less again, over
    the gain, and at the latest at the first light mode. change (F, P'): of the gain by unit normals,
    relative.
    """
    unknown = np.linalg.norm(change, axis=1)
    least_so_far = np.minimum.accumulate(unknown)
    rises = unknown > _KNOWN_LESS_AGAIN * least_so_far
    first_rise = int(np.argmax(rises)) if rises.any() else omega.size
    best_known = omega[np.argmin(unknown[:first_rise])]
    is_mode = poles.zeta() < LARGEST_DAMPING
    modes_rad_s = poles.omega_rad_s(dt_s)[is_mode]
    return np.asarray(omega < np.min(modes_rad_s, initial=best_known))


def _positive_interval(mean: float) -> tuple[float, float]:
    """Ends of the interval of a normal of unit variance that is positive, without `_TAIL` on either side."""
    log_positive = norm.logsf(-mean)
    ends = []
    for log_above in (np.log1p(-_TAIL), np.log(_TAIL)):
        # Number above which a unit normal lies with this probability, however small.
        ends.append(mean - float(ndtri_exp(log_above + log_positive)))
    least, most = ends
    return least, most


def _covering(
    omega: RealArray,
    x: ComplexArray,
    normal: float,
    half: ComplexArray,
    others: ComplexArray,
    low: BoolArray,
) -> ComplexArray:
    """Centre and columns (F, 1 + N), over the gain, of ellipses at the level that hold a member's arcs.

    omega (F,), rad/s; x (F,): change by the normal that moves the force at rest, `normal` its value in the
    middle; half (F,): half width of the force over the middle; others (F, P'): change by the other normals;
    low (F,): where a change is one of the force.

    An ellipse as long as the chord that is as wide across as the arc bows holds the arc. For a rate this
    width is at most `slope` in units of half the chord, |Im half| / (1 - |half|^2), which goes with frequency
    w like 2 X / (1 + X^2), X = w / (w where it is largest): a column with two equal poles. Its phase turns
    from across to along the chord; behind an all-pass it turns faster, so that three of them are wide enough
    everywhere.
    """
    # Half the chord, and the middle of the ends.
    middle = 1 / ((1 - x * normal) * (1 - half**2))
    chord = half * middle
    slope = np.where(low, np.abs(half.imag) / (1 - np.abs(half) ** 2), 0.0)
    most_bowed = omega[np.argmax(slope)]
    ratio = 1j * omega / most_bowed
    band = 2 * ratio / (1 + ratio) ** 2
    bow = _ACROSS * np.max(slope) * band * chord
    behind = (1 - ratio) / (1 + ratio)
    longer = chord * ratio / (_LONGER_FROM + ratio)
    parts = np.column_stack([chord, bow, bow * behind, bow * behind**2, longer])
    of_others = others * middle[:, None]

    # Near the first light mode a change is one of the gain.
    octaves_below = np.log2(omega[low][-1] / omega)
    share = np.clip((octaves_below - 1) / _TURNS_OVER, 0, 1)[:, None]
    straight = half * (1 - x * normal)
    straight_parts = np.zeros_like(parts)
    straight_parts[:, 0] = straight_parts[:, -1] = straight
    centre = share[:, 0] * middle + (1 - share[:, 0]) * (1 + x * normal)
    parts = share * parts + (1 - share) * straight_parts
    of_others = share * of_others + (1 - share) * others
    return np.column_stack([centre, parts / chi2_radius(LEVEL), of_others])


def _corner(omega: RealArray, force: ComplexArray) -> float:
    """Frequency, rad/s, from which on a force over speed (F,) at omega (F,) is more inertia than damping."""
    return float(omega[np.argmax(force.imag > force.real)])


def _with_rate(poles: Poles, rate_per_s: float, dt_s: float) -> Poles:
    """Poles whose slowest real one decays at a rate, 1/s; with one more where none decays."""
    real = poles.real.copy()
    decaying = np.flatnonzero(real > 0)
    pole = np.exp(-rate_per_s * dt_s)
    if decaying.size == 0:
        return poles.appended(Poles(np.array([pole])))
    real[decaying[np.argmax(real[decaying])]] = pole
    return Poles(real, poles.pairs)
