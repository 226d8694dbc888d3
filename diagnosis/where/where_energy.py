"""Gap energy beyond the noise, by sensor, experiment and frequency band.

With e = gap + white noise of unit variance, the sum of squares of n values (samples, or coefficients of an
orthonormal transform) is noncentral chi-square with n degrees of freedom and the gap's energy as
noncentrality. Bands use the cosine transform (DCT-II), in which a drift does not leak over all frequencies.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import dct
from scipy.stats import chi2, norm

from diagnosis.machine.machine_protocol import Real
from diagnosis.where.findings import BandGap, ExperimentGap, PartGap, SensorGap

# Standard deviations of a two-sided interval of 95 %.
_Z95 = float(norm.ppf(0.975))
# Band edges, two a decade: 1, 3, 10, ... Hz, rounded for reading aloud. Chosen; with half as many a mode and
# a drift share a band, with twice as many each holds half the energy to be found by.
_EDGES_HZ = tuple(m * 10.0**k for k in range(-4, 6) for m in (1.0, 3.0))
# Lines of the cosine transform in the lowest band: fewer are filled by an offset and a drift alone.
_LEAST_LINES = 3
# Standard deviations below its noise from which on a part counts as without a gap in shares: no band of noise
# comes there. Chosen; doubled, a part of two hundred values with no energy at all is still taken off.
_BELOW_NOISE = 4.0
# The highest band begins at this share of the Nyquist frequency at the latest, so that it is wide enough for
# a comparison. Chosen; with half of it three pages of five have one band less.
_HIGHEST_BAND_BEGINS = 0.6


@dataclass(frozen=True)
class Energy:
    """Sum of squares over a number of values that have unit variance under noise alone."""

    squares: float
    count: int

    @classmethod
    def of(cls, signals: Iterable[Real]) -> Energy:
        """Energy of all values of some arrays of any shape; zero of none."""
        squares = 0.0
        count = 0
        for signal in signals:
            squares += float(np.sum(signal**2))
            count += signal.size
        return cls(squares, count)

    @property
    def gap(self) -> float:
        """Energy beyond that of the noise, below zero where there is less: its estimate without bias."""
        return self.squares - self.count

    @property
    def variance(self) -> float:
        """Variance of the sum of squares: 2 n + 4 lambda, the noncentrality lambda estimated by the gap."""
        return 2.0 * self.count + 4.0 * max(self.gap, 0.0)

    @property
    def p_value(self) -> float:
        """Chance of as much energy from noise alone."""
        return float(chi2.sf(self.squares, self.count))


def total(parts: Sequence[Energy]) -> Energy:
    """Energy of parts that share no value."""
    return Energy(sum(p.squares for p in parts), sum(p.count for p in parts))


def total_gap(parts: Sequence[Energy]) -> Energy:
    """Energy of parts whose gaps add up, for shares of their gap.

    A part below its noise beyond chance has more noise stated than it shows, or none of what a model may
    miss: it counts as one without a gap. Its missing energy would otherwise be taken off the gap of the
    others, whose shares grow above one without a bound.
    """
    counted = []
    for part in parts:
        below_noise = part.gap < -_BELOW_NOISE * np.sqrt(2.0 * part.count)
        counted.append(Energy(float(part.count), part.count) if below_noise else part)
    return total(counted)


def part_gap(part: Energy, whole: Energy, level: float) -> PartGap:
    """The gap of a part of the whole, found if its p-value lies below `level`.

    Parameters
    ----------
    part, whole : Energy
        The whole holds the part, and at least one value.
    level : float
        Chance of a false finding in noise.

    Notes
    -----
    The interval of the share is by the delta method for two independent energies, the part and what is
    beside it; share and interval are cut to 0 and 1.
    """
    half = _Z95 * np.sqrt(part.variance)

    def rms(energy: float) -> float:
        return float(np.sqrt(max(energy, 0.0) / part.count))

    # Without a gap beyond chance there is nothing to take a share of.
    share = 0.0
    deviation = 0.0
    if whole.gap > _Z95 * np.sqrt(2.0 * whole.count):
        share = part.gap / whole.gap
        variance_beside = max(whole.variance - part.variance, 0.0)
        deviation = np.sqrt((1 - share) ** 2 * part.variance + share**2 * variance_beside) / whole.gap
    return PartGap(
        gap_rms=rms(part.gap),
        interval=(rms(part.gap - half), rms(part.gap + half)),
        share=_cut(share),
        share_interval=(_cut(share - _Z95 * deviation), _cut(share + _Z95 * deviation)),
        p_value=part.p_value,
        found=bool(part.p_value < level),
        share_deviation=float(deviation),
    )


def _cut(share: float) -> float:
    """A share between 0 and 1."""
    return float(np.clip(share, 0.0, 1.0))


def sensor_gaps(residuals: Mapping[str, Real], sensors: Sequence[str], level: float) -> tuple[SensorGap, ...]:
    """Gap of every sensor over all experiments; residuals (T, Y) by experiment, one level for all sensors."""
    energies = [Energy.of(e[:, s] for e in residuals.values()) for s in range(len(sensors))]
    whole = total_gap(energies)
    return tuple(
        SensorGap(sensor, part_gap(energy, whole, level / len(sensors)))
        for sensor, energy in zip(sensors, energies, strict=True)
    )


def experiment_gaps(residuals: Mapping[str, Real], level: float) -> tuple[ExperimentGap, ...]:
    """Gap of every experiment, all sensors together and each; residuals (T, Y), one level for all tests."""
    energies = {name: [Energy.of([column]) for column in e.T] for name, e in residuals.items()}
    whole = total_gap([energy for parts in energies.values() for energy in parts])
    tests = sum(1 + len(parts) for parts in energies.values())
    gaps = []
    for name, parts in energies.items():
        together = part_gap(total(parts), whole, level / tests)
        by_sensor = tuple(part_gap(part, whole, level / tests) for part in parts)
        gaps.append(ExperimentGap(name, together, by_sensor))
    return tuple(gaps)


def band_edges_Hz(shortest_s: float, dt_s: float) -> tuple[float, ...]:
    """Edges from 0 to the Nyquist frequency, about half a decade apart.

    The lowest band holds at least 3 lines of the shortest record (line spacing 1/(2 T) for a cosine
    transform) and the highest reaches from no later than 60 % of Nyquist.
    """
    nyquist = 0.5 / dt_s
    lowest = _LEAST_LINES / (2 * shortest_s)
    inner = [f for f in _EDGES_HZ if lowest <= f <= _HIGHEST_BAND_BEGINS * nyquist]
    return (0.0, *inner, nyquist)


def band_gaps(
    residuals: Mapping[str, Real], sensors: Sequence[str], dt_s: float, level: float
) -> tuple[BandGap, ...]:
    """Gap of every sensor in every band, all experiments added up.

    Parameters
    ----------
    residuals : experiment -> (T, Y) array
        Over the noise; one experiment at least.
    sensors : sequence of str, length Y
    dt_s : float
        Sampling period [s].
    level : float
        Chance of a false finding in all bands and sensors together.
    """
    shortest = min(e.shape[0] for e in residuals.values())
    edges = band_edges_Hz(shortest * dt_s, dt_s)
    squares = np.zeros((len(sensors), len(edges) - 1))
    counts = np.zeros(len(edges) - 1, dtype=int)
    for e in residuals.values():
        spectrum = dct(e, axis=0, norm="ortho") ** 2
        frequencies_Hz = np.arange(e.shape[0]) / (2 * e.shape[0] * dt_s)
        band = np.searchsorted(edges, frequencies_Hz, side="right") - 1
        counts += np.bincount(band, minlength=counts.size)
        for s in range(len(sensors)):
            squares[s] += np.bincount(band, weights=spectrum[:, s], minlength=counts.size)

    energies = [[Energy(float(v), int(n)) for v, n in zip(row, counts, strict=True)] for row in squares]
    whole = total_gap([energy for row in energies for energy in row])
    return tuple(
        BandGap(sensor, edges[b], edges[b + 1], part_gap(energy, whole, level / squares.size))
        for sensor, row in zip(sensors, energies, strict=True)
        for b, energy in enumerate(row)
    )
