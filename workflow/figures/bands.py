"""Numbers behind the pictures: gain and phase of ellipses, outlines of long signals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from control_design.plants.ellipses import farthest_distance, nearest_distance
from ident.uncertainty import FrequencyUncertainty

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
# Parts of a long signal: the widest panel has some 600 pixels for them, and a line covers more than one.
_COLUMNS = 500
# Of a signal's range: a tenth of a pixel of a panel of two inches, where a bend is not seen either.
_STRAIGHT = 1 / 2000
# A locus is smooth where it turns by no more than this [rad] from point to point: a hundred points a circle.
_TURN_RAD = 0.06
# Steps of a locus that are seen: three pixels of a plane that is four units wide.
_SEEN_STEP = 0.02
# Steps of a locus in a Nichols chart that are seen, in nepers and rad: three pixels, too.
_SEEN_LOG_STEP = 0.05
# Gains that are in a picture: what is below -30 dB, or far from the origin, is in neither.
_SEEN_GAINS = (0.03, 10.0)
# Refinements of a grid at most. Each halves the steps: of a grid of 81 points for a mode one is enough, as
# a rule.
_REFINEMENTS = 12
# Half a band's height over the gain that is seen: two pixels of two hundred on an axis of six decades.
_SEEN = 0.1


@dataclass(frozen=True, eq=False)
class ResponseBand:
    """Gain and phase [deg] of an uncertain response over its ellipses, all (F,).

    The gain's range is exact; the phase's is taken from 128 boundary points and is the whole circle where the
    ellipse holds the origin.
    """

    omega_rad_s: Real
    gain: Real
    gain_low: Real
    gain_high: Real
    phase_deg: Real
    phase_low_deg: Real
    phase_high_deg: Real


def response_band(uncertainty: FrequencyUncertainty) -> ResponseBand:
    """Band of a response; frequency 0 is left out, it has no place on a log axis."""
    keep = uncertainty.omega_rad_s > 0
    ellipse = uncertainty.ellipse()
    centre = uncertainty.centre[keep]
    s1 = ellipse.semi_major[keep]
    s2 = ellipse.semi_minor[keep]
    u1 = ellipse.direction[keep]
    origin = -centre * np.conj(u1)
    low = nearest_distance(origin, s1, s2)
    phase = unwrapped_degrees(centre)
    # Seen from its centre the edge turns the phase by little; from the origin it would jump by whole turns.
    turn = ellipse.boundary(128)[keep] / np.where(centre == 0, 1.0, centre)[:, None]
    swing = np.degrees(np.angle(1.0 + turn))
    # An ellipse that holds the origin has members of every phase.
    holds_origin = low <= 0
    return ResponseBand(
        omega_rad_s=uncertainty.omega_rad_s[keep],
        gain=np.abs(centre),
        gain_low=low,
        gain_high=farthest_distance(origin, s1, s2),
        phase_deg=phase,
        phase_low_deg=phase + np.where(holds_origin, -180.0, swing.min(axis=1)),
        phase_high_deg=phase + np.where(holds_origin, 180.0, swing.max(axis=1)),
    )


def times(response: FrequencyUncertainty, gain: Complex) -> FrequencyUncertainty:
    """A response multiplied by an exactly known one (F,): its ellipses turned and scaled."""
    gain = np.asarray(gain, dtype=np.complex128)
    turn = np.moveaxis(np.array([[gain.real, -gain.imag], [gain.imag, gain.real]]), 2, 0)
    covariance = turn @ response.covariance @ turn.transpose(0, 2, 1)
    return replace(response, centre=gain * response.centre, covariance=covariance)


def enlargement(band: ResponseBand) -> int:
    """1, 10, 100 or 1000: how much larger a band has to be drawn to be seen on a log axis of some decades."""
    half = float(np.median((band.gain_high - band.gain_low) / (2 * band.gain)))
    return next((factor for factor in (1, 10, 100) if factor * half >= _SEEN), 1000)


def unwrapped_degrees(response: Complex) -> Real:
    """Phase without jumps, started in (-270, 90]."""
    phase = np.degrees(np.unwrap(np.angle(response)))
    return np.asarray(phase - 360.0 * np.ceil((phase[0] - 90.0) / 360.0))


def degrees_near(response: Complex, target_deg: Real) -> Real:
    """Phase of each point on the turn that is nearest to `target_deg`."""
    phase = np.degrees(np.angle(response))
    return np.asarray(phase + 360.0 * np.round((target_deg - phase) / 360.0))


def outline(time_s: Real, signal: Real, columns: int = _COLUMNS, *, hold: bool = False) -> tuple[Real, Real]:
    """The samples of a signal (T,) that draw the same curve as all of them.

    Parameters
    ----------
    time_s, signal : (T,) arrays
    columns : int
        Equal parts of the samples, at least as many as the panel has pixels.
    hold : bool
        Each value is drawn held until the next (`steps-post`), not joined to it by a straight line.

    Returns
    -------
    time_s, signal : (N,) arrays
        At most four samples of each part, with the first and the last of all.

    Notes
    -----
    Of a part that is narrower than a line the first, the smallest, the largest and the last sample cover the
    same pixels as all of it (M4: Jugel et al., Proc. VLDB 7(10), 2014). Samples that the curve meets without
    them within `_STRAIGHT` of its range are left out.
    """
    index = np.arange(signal.size)
    if signal.size > 4 * columns:
        length = -(-signal.size // columns)
        first = np.arange(0, signal.size, length)
        last = np.minimum(first + length, signal.size) - 1
        # The last part may be shorter: it is filled up with its last sample, which is no new extreme.
        parts = np.pad(signal, (0, first.size * length - signal.size), mode="edge").reshape(-1, length)
        extremes = [first + parts.argmin(axis=1), first + parts.argmax(axis=1)]
        index = np.unique(np.minimum(np.concatenate([first, last, *extremes]), signal.size - 1))
    joined = _held if hold else _straight
    places = joined(time_s[index], signal[index], _STRAIGHT * float(np.ptp(signal)))
    return time_s[index[places]], signal[index[places]]


def extremes(x: Real, y: Real, edges: Real) -> npt.NDArray[np.int64]:
    """Places of the smallest and the largest of values (N,) at x (N,) in every part between edges (E,)."""
    part = np.digitize(x, edges)
    order = np.lexsort((y, part))
    # Sorted by part, then by value: a part begins with its smallest and ends with its largest.
    begins = np.flatnonzero(np.diff(part[order], prepend=-1))
    ends = np.append(begins[1:], x.size) - 1
    return np.unique(order[np.concatenate([begins, ends])])


def _straight(x: Real, y: Real, tolerance: float) -> list[int]:
    """Places of points (N,) whose joining lines pass all points within a vertical tolerance, in one walk: a
    line from the last kept point goes on as long as its slope suits all points it passes."""
    places = [0]
    steepest = np.inf
    flattest = -np.inf
    for place in range(1, x.size):
        run = x[place] - x[places[-1]]
        rise = y[place] - y[places[-1]]
        if not flattest <= rise / run <= steepest:
            places.append(place - 1)
            run = x[place] - x[place - 1]
            rise = y[place] - y[place - 1]
            steepest = np.inf
            flattest = -np.inf
        steepest = min(steepest, (rise + tolerance) / run)
        flattest = max(flattest, (rise - tolerance) / run)
    if x.size > 1:
        places.append(x.size - 1)
    return places


def _held(x: Real, y: Real, tolerance: float) -> list[int]:
    """Places of points (N,) whose held values differ from all values by no more than a tolerance."""
    places = [0]
    for place in range(1, x.size):
        if abs(y[place] - y[places[-1]]) > tolerance:
            places.append(place)
    if places[-1] < x.size - 1:
        places.append(x.size - 1)
    return places


def smooth_grid(omega_rad_s: Real, locus: Callable[[Real], Complex]) -> Real:
    """A grid on which a locus, joined by straight lines, looks smooth: on the complex plane and on a Nichols
    chart.

    Parameters
    ----------
    omega_rad_s : (F,) array
        Rising and positive; fine enough that no resonance lies unseen between two of its points.
    locus : callable
        The response (N,) at frequencies (N,).

    Returns
    -------
    omega_rad_s : (N,) array
        The grid with the middles of steps, on a logarithmic scale, in which the locus turns by more than
        `_TURN_RAD`, where a picture shows it.
    """
    omega = np.asarray(omega_rad_s, dtype=np.float64)
    value = locus(omega)
    # Steps that were not looked into.
    fresh = np.ones(omega.size - 1, dtype=np.bool_)
    for _ in range(_REFINEMENTS):
        start = np.flatnonzero(fresh)
        middle = np.sqrt(omega[start] * omega[start + 1])
        between = locus(middle)
        first = value[start]
        last = value[start + 1]

        size = np.abs(between)
        seen = (size > _SEEN_GAINS[0]) & (size < _SEEN_GAINS[1])
        bent = _bent(between - first, last - between, _SEEN_STEP)
        with np.errstate(divide="ignore", invalid="ignore"):
            bent |= _bent(np.log(between / first), np.log(last / between), _SEEN_LOG_STEP)
        split = seen & bent
        if not split.any():
            break

        at = start[split] + 1
        omega = np.insert(omega, at, middle[split])
        value = np.insert(value, at, between[split])
        # Both halves of every split step are looked into next.
        where = at + np.arange(at.size)
        fresh = np.zeros(omega.size - 1, dtype=np.bool_)
        fresh[where - 1] = True
        fresh[where] = True
    return omega


def _bent(before: Complex, after: Complex, seen: float) -> npt.NDArray[np.bool_]:
    """Where two steps (N,) that follow each other differ in direction, and are long enough to be seen."""
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.abs(np.angle(after / before))
    return (turn > _TURN_RAD) & (np.abs(before) + np.abs(after) > seen)


def liveliest(signal: Real, length: int) -> slice:
    """The `length` samples in which a signal moves most."""
    energy = np.concatenate([[0.0], np.cumsum((signal - signal.mean()) ** 2)])
    start = int(np.argmax(energy[length:] - energy[:-length]))
    return slice(start, start + length)


def envelope(time_s: Real, signals: Real, columns: int = _COLUMNS) -> tuple[Real, Real, Real]:
    """Time, lower and upper edge of a band that holds signals (R, T).

    Of many samples the edges stand at the ends of `columns` equal parts, each the extreme of both parts that
    meet there: no sample lies outside of the straight lines between them, and the band is by no more than a
    part too wide.
    """
    low = signals.min(axis=0)
    high = signals.max(axis=0)
    if time_s.size <= 2 * columns:
        return time_s, low, high
    length = -(-time_s.size // columns)
    first = np.arange(0, time_s.size, length)
    ends = np.append(first, time_s.size - 1)
    lowest = np.minimum.reduceat(low, first)
    highest = np.maximum.reduceat(high, first)
    lower = np.minimum(np.append(lowest[:1], lowest), np.append(lowest, lowest[-1:]))
    upper = np.maximum(np.append(highest[:1], highest), np.append(highest, highest[-1:]))
    # A last part of one sample ends where it begins.
    keep = np.append(True, np.diff(ends) > 0)
    return time_s[ends[keep]], lower[keep], upper[keep]
