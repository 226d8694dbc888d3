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

_Z95 = float(norm.ppf(0.975))
# Half a decade a band: edges 1, 3.2, 10, ... Hz, rounded for reading aloud.
_EDGES_HZ = tuple(m * 10.0**k for k in range(-4, 6) for m in (1.0, 3.0))
_LEAST_LINES = 3  # fewer make no band: offset and drift fill them


@dataclass(frozen=True)
class Energy:
    """Sum of squares over a number of values that have unit variance under noise alone."""

    squares: float
    count: int

    @classmethod
    def of(cls, signals: Iterable[Real]) -> Energy:
        parts = [(float(np.sum(signal**2)), signal.size) for signal in signals]
        return cls(sum(squares for squares, _ in parts), sum(size for _, size in parts))

    @property
    def gap(self) -> float:
        return self.squares - self.count

    @property
    def variance(self) -> float:
        """Of the sum of squares: 2 n + 4 lambda, the noncentrality lambda estimated."""
        return 2.0 * self.count + 4.0 * max(self.gap, 0.0)

    @property
    def p_value(self) -> float:
        return float(chi2.sf(self.squares, self.count))


def total(parts: Sequence[Energy]) -> Energy:
    return Energy(sum(p.squares for p in parts), sum(p.count for p in parts))


def part_gap(part: Energy, whole: Energy, level: float) -> PartGap:
    """The gap of a part of the whole; found if its p-value lies below `level`.

    The share's interval is by the delta method for two independent energies, the part and the rest.
    """
    half = _Z95 * np.sqrt(part.variance)
    rms = [float(np.sqrt(max(part.gap + shift, 0.0) / part.count)) for shift in (0.0, -half, half)]
    if whole.gap <= _Z95 * np.sqrt(2.0 * whole.count):
        # No gap beyond chance to take a share of.
        share, interval = 0.0, (0.0, 0.0)
    else:
        share = part.gap / whole.gap
        rest = max(whole.variance - part.variance, 0.0)
        sd = np.sqrt((1 - share) ** 2 * part.variance + share**2 * rest) / whole.gap
        interval = (float(share - _Z95 * sd), float(share + _Z95 * sd))
    return PartGap(rms[0], (rms[1], rms[2]), float(share), interval, part.p_value, bool(part.p_value < level))


def sensor_gaps(residuals: Mapping[str, Real], sensors: Sequence[str], level: float) -> tuple[SensorGap, ...]:
    energies = [Energy.of(e[:, s] for e in residuals.values()) for s in range(len(sensors))]
    whole = total(energies)
    return tuple(
        SensorGap(sensor, part_gap(energy, whole, level / len(sensors)))
        for sensor, energy in zip(sensors, energies, strict=True)
    )


def experiment_gaps(residuals: Mapping[str, Real], level: float) -> tuple[ExperimentGap, ...]:
    """Every experiment: all sensors together and each; one level for all these tests."""
    energies = {name: [Energy.of([column]) for column in e.T] for name, e in residuals.items()}
    whole = total([energy for parts in energies.values() for energy in parts])
    each = level / sum(1 + len(parts) for parts in energies.values())
    return tuple(
        ExperimentGap(
            name, part_gap(total(parts), whole, each), tuple(part_gap(part, whole, each) for part in parts)
        )
        for name, parts in energies.items()
    )


def band_edges_Hz(shortest_s: float, dt_s: float) -> tuple[float, ...]:
    """Edges from 0 to the Nyquist frequency, about half a decade apart.

    The lowest band holds at least 3 lines of the shortest record (line spacing 1/(2 T) for a cosine
    transform) and the highest reaches from no later than 60 % of Nyquist.
    """
    nyquist = 0.5 / dt_s
    return (0.0, *[f for f in _EDGES_HZ if _LEAST_LINES / (2 * shortest_s) <= f <= 0.6 * nyquist], nyquist)


def band_gaps(
    residuals: Mapping[str, Real], sensors: Sequence[str], dt_s: float, level: float
) -> tuple[BandGap, ...]:
    """Energy per sensor and band, all experiments added up."""
    edges = band_edges_Hz(min(e.shape[0] for e in residuals.values()) * dt_s, dt_s)
    squares = np.zeros((len(sensors), len(edges) - 1))
    counts = np.zeros(len(edges) - 1, dtype=int)
    for e in residuals.values():
        spectrum = dct(e, axis=0, norm="ortho") ** 2
        band = np.searchsorted(edges, np.arange(e.shape[0]) / (2 * e.shape[0] * dt_s), side="right") - 1
        counts += np.bincount(band, minlength=counts.size)
        for s in range(len(sensors)):
            squares[s] += np.bincount(band, weights=spectrum[:, s], minlength=counts.size)
    energies = [[Energy(float(v), int(n)) for v, n in zip(row, counts, strict=True)] for row in squares]
    whole = total([energy for row in energies for energy in row])
    return tuple(
        BandGap(sensor, edges[b], edges[b + 1], part_gap(energy, whole, level / squares.size))
        for sensor, row in zip(sensors, energies, strict=True)
        for b, energy in enumerate(row)
    )
