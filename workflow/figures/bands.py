"""Numbers behind the pictures: gain and phase of ellipses, outlines of long signals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from control_design.plants.ellipses import farthest_distance, nearest_distance
from ident.uncertainty import FrequencyUncertainty

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
_SEEN = 0.1  # half a band's height over the gain: two pixels of two hundred on an axis of six decades


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
    s1, s2, u1 = ellipse.semi_major[keep], ellipse.semi_minor[keep], ellipse.direction[keep]
    origin = -centre * np.conj(u1)
    low = nearest_distance(origin, s1, s2)
    phase = unwrapped_degrees(centre)
    turn = ellipse.boundary(128)[keep] / np.where(centre == 0, 1.0, centre)[:, None]
    swing = np.degrees(np.angle(1.0 + turn))
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


def outline(time_s: Real, signal: Real, bins: int = 700) -> tuple[Real, Real]:
    """A long signal as the smallest and largest sample of each of `bins` equal parts, in order of time.

    Drawn as a line it covers the same pixels as the whole signal. Short signals come back as they are.
    """
    if signal.size <= 3 * bins:
        return time_s, signal
    length = -(-signal.size // bins)
    first = np.arange(0, signal.size, length)
    # The last part may be shorter: it is filled up with its last sample, which is no new extreme.
    parts = np.pad(signal, (0, first.size * length - signal.size), mode="edge").reshape(-1, length)
    both = np.concatenate([first + parts.argmin(axis=1), first + parts.argmax(axis=1), [0, signal.size - 1]])
    index = np.unique(np.minimum(both, signal.size - 1))
    return time_s[index], signal[index]


def liveliest(signal: Real, length: int) -> slice:
    """The `length` samples in which a signal moves most."""
    energy = np.concatenate([[0.0], np.cumsum((signal - signal.mean()) ** 2)])
    start = int(np.argmax(energy[length:] - energy[:-length]))
    return slice(start, start + length)


def envelope(time_s: Real, signals: Real, bins: int = 250) -> tuple[Real, Real, Real]:
    """Time, smallest and largest value of signals (R, T); of `bins` equal parts where T is much larger."""
    low, high = signals.min(axis=0), signals.max(axis=0)
    length = time_s.size // bins
    if length < 2:
        return time_s, low, high
    at = np.arange(0, time_s.size, length)
    # Each value holds for a part: drawn from its middle, but for the ends: the band spans all of the time.
    middle = np.minimum(at + length // 2, time_s.size - 1)
    middle[0], middle[-1] = 0, time_s.size - 1
    return time_s[middle], np.minimum.reduceat(low, at), np.maximum.reduceat(high, at)
