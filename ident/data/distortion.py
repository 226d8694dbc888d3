"""Response, noise and nonlinear distortion of periodic records, frequency by frequency and without a model.

The robust method of Pintelon and Schoukens (System Identification: A Frequency Domain Approach, 2nd ed., ch.
4) on M realisations of a random-phase signal, P whole periods each. The mean of G = Y / U over realisations
is the best linear approximation at this amplitude and spectrum. Between the periods of a realisation there is
noise, M (P - 1) complex degrees of freedom a line; between realisations noise / P and stochastic distortion,
M - 1; at lines without excitation noise / P and distortion, M: its even part at even lines, as long as only
odd lines are excited.

What lies before the last whole periods is dropped as transient. The mean advance of an integrating output
from a period to the next is taken off as a straight line, which adds a tenth of the noise power at the first
line for P = 2, falling with the line's square. The input is taken as known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from ident.data.arrays import BoolArray, ComplexArray, IntArray, RealArray
from ident.data.ellipses import circular_widening
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record import Record, in_groups

# A period repeats the input to this share of its power (40 dB: an input as commanded, or well measured).
_REPEATS = 1e-4
# Power of a line over the strongest: excited above the first, without excitation below the second.
EXCITED, _SILENT = 1e-2, 1e-4
# Records whose input differs by less in rms are of one amplitude, in itself of one realisation.
SAME = 0.02
# Noise is averaged over this many harmonics to each side, fewer next to zero.
_SMOOTHING = 10
_ROUNDS = 6  # of weights and distortion in turns: more move it by less than 2 % of its interval


@dataclass(frozen=True, eq=False)
class LineLevels:
    """Power of what is no response to the input, at lines omega_rad_s (K,), in units of |G|^2.

    of_each (M, K): of the mean of each realisation's periods; their mean has `freedom` complex degrees of
    freedom a line. noise (K,): its share, known with noise_freedom, None with one period. gain (K,): |G|
    there.
    """

    omega_rad_s: RealArray
    of_each: RealArray
    freedom: int
    noise: RealArray | None
    noise_freedom: int
    gain: RealArray

    def __post_init__(self) -> None:
        for entry in fields(self):
            if isinstance(array := getattr(self, entry.name), np.ndarray):
                array.setflags(write=False)

    @property
    def power(self) -> RealArray:
        """Mean (K,) over the realisations."""
        return np.asarray(self.of_each.mean(axis=0))

    def within(self, low_rad_s: float, high_rad_s: float, level: float = 0.95) -> BandLevel | None:
        """Distortion over gain between two frequencies, taken as one number there; None without a line.

        Most likely for powers that are chi-square around (distortion + noise). The interval has the degrees
        of freedom of their weighted sum (Satterthwaite), or of its scatter between realisations where that is
        wider.
        """
        at = (self.omega_rad_s >= low_rad_s) & (self.omega_rad_s < high_rad_s) & (self.gain > 0)
        if not at.any() or not self.freedom:
            return None
        size = self.gain[at] ** 2
        of_each = self.of_each[:, at] / size
        power = of_each.mean(axis=0)
        noise = np.zeros_like(power) if self.noise is None else self.noise[at] / size
        distortion, weight = 0.0, np.ones_like(power)
        for _ in range(_ROUNDS):
            expected = np.maximum(distortion + noise, 1e-12 * power.max() + np.finfo(np.float64).tiny)
            weight = expected**-2 / np.sum(expected**-2)
            distortion = max(float(weight @ (power - noise)), 0.0)
        total, of_noise = float(weight @ power), float(weight @ noise)
        variance = np.sum((weight * expected) ** 2) / self.freedom
        if len(of_each) > 1:
            variance = max(variance, np.var(of_each @ weight, ddof=1) / len(of_each))
        if self.noise is not None:
            variance += np.sum((weight * noise) ** 2) / self.noise_freedom
        freedom = 2 * (weight @ expected) ** 2 / variance
        tail = 0.5 * (1 - level)
        low = freedom * total / chi2.ppf(1 - tail, freedom) - of_noise
        # Where less than the noise came, no less is promised than where just the noise comes.
        high = freedom * max(total, of_noise) / chi2.ppf(tail, freedom) - of_noise
        return BandLevel(
            low_rad_s,
            high_rad_s,
            float(np.sqrt(max(total - of_noise, 0.0))),
            (float(np.sqrt(max(low, 0.0))), float(np.sqrt(max(high, 0.0)))),
            float(np.sqrt(of_noise)),
        )


@dataclass(frozen=True)
class BandLevel:
    """Root mean square over the gain, in a band: distortion with its interval, and noise in a mean of
    periods."""

    from_rad_s: float
    to_rad_s: float
    distortion: float
    interval: tuple[float, float]
    noise: float

    @property
    def significant(self) -> bool:
        """Its interval begins above zero."""
        return self.interval[0] > 0


@dataclass(frozen=True, eq=False)
class Distortion:
    """One channel at one amplitude rms of the input.

    gain (F,) at omega_rad_s (F,): best linear approximation. excited: scatter between realisations, None with
    one; odd, even: lines without excitation, None where there are none. noise_std (F,): of G in one period,
    None with one period. drift: largest mean advance of the output from a period to the next, taken off.
    """

    rms: float
    names: tuple[str, ...]
    dt_s: float
    period_samples: int
    realisations: int
    periods: int
    omega_rad_s: RealArray
    gain: ComplexArray
    noise_std: RealArray | None
    excited: LineLevels | None
    odd: LineLevels | None
    even: LineLevels | None
    drift: float

    def response(self, level: float = 0.95) -> FrequencyUncertainty | None:
        """Best linear approximation with its scatter between realisations (None with one), widened to the
        quantile of F(2, 2 (M - 1)) because they are few."""
        if self.excited is None:
            return None
        variance = self.excited.power / self.realisations
        widening = circular_widening(self.realisations - 1, level)
        covariance = 0.5 * widening * variance[:, None, None] * np.eye(2)
        return FrequencyUncertainty(
            self.omega_rad_s, self.gain, covariance, self.dt_s, level, "empirical, whole periods"
        )

    @cached_property
    def bands_rad_s(self) -> tuple[tuple[float, float], ...]:
        """Half decades from the lowest line up to the highest."""
        low, high = self.omega_rad_s[0] * (1 - 1e-9), self.omega_rad_s[-1] * (1 + 1e-9)
        edges = np.geomspace(low, high, max(round(2 * np.log10(high / low)), 1) + 1)
        return tuple(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


def period_of(signal: RealArray) -> int | None:
    """Samples after which a signal (T,) repeats, at least once in full; None where it does not."""
    n = signal.size
    x = signal - signal.mean()
    correlation = np.fft.irfft(np.abs(np.fft.rfft(x, 2 * n)) ** 2, 2 * n)[: n // 2 + 1]
    energy = np.concatenate([[0.0], np.cumsum(x**2)])
    lags = np.arange(n // 2 + 1)
    both = (energy[n] - energy[lags]) + energy[n - lags]
    differs = 1 - 2 * correlation / np.where(both > 0, both, np.inf)
    # A smooth signal resembles itself at short lags: the period comes after it has once differed.
    apart = np.flatnonzero(differs > 0.5)
    if not apart.size:
        return None
    found = np.flatnonzero(differs[apart[0] :] < _REPEATS)
    return int(apart[0] + found[0]) if found.size else None


def distortion_of(records: Sequence[Record], *, period_samples: int | None = None) -> tuple[Distortion, ...]:
    """Levels at every amplitude, lowest first, of the periodic ones among records with one input and output.

    Realisations of one amplitude share period and lines; records of the same input are further periods of
    one. period_samples: stated, else found in the input. Raises ValueError where a record is shorter than the
    stated period or does not repeat after it, periods differ between records, or an output stands still.
    """
    steady: list[_Steady] = []
    for record in records:
        record.refuse_several()
        period = _period(record, period_samples)
        if period is None:
            continue
        steady.append(_Steady.of(record, period))
        if period != steady[0].period:
            raise ValueError(
                f"{record.label}: its input repeats after {period} samples, that of "
                f"{steady[0].record.label} after {steady[0].period}; analyse them one by one"
            )
    return tuple(sorted(map(_levels, in_groups(steady, _Steady.alike)), key=lambda found: found.rms))


def _period(record: Record, stated: int | None) -> int | None:
    u = record.input[:, 0]
    if stated is None:
        return period_of(u)
    if record.n_samples < stated:
        raise ValueError(f"{record.label}: {record.n_samples} samples are no period of {stated}")
    change = u[stated:] - u[:-stated]
    if np.sum(change**2) > 2 * _REPEATS * np.sum((u[stated:] - u.mean()) ** 2):
        raise ValueError(f"{record.label}: the input does not repeat after {stated} samples")
    return stated


@dataclass(frozen=True, eq=False)
class _Steady:
    """Spectra of the whole periods of a record: input (F,), output (P, F), harmonics from 1 on."""

    record: Record
    period: int
    input: ComplexArray
    output: ComplexArray
    excited: BoolArray
    silent: BoolArray
    drift: float

    @classmethod
    def of(cls, record: Record, period: int) -> _Steady:
        n = record.n_samples
        count = n // period
        if count * period == n and count > 1:
            count -= 1  # nothing else lies before the whole periods: the first is the transient
        u = record.input[n - count * period :, 0].reshape(count, period)
        y = record.output[n - count * period :, 0].reshape(count, period)
        if not np.ptp(y) > 0:
            raise ValueError(
                f"{record.label}: output column '{record.output_names[0]}' stands still at {y[0, 0]:.6g}; "
                "expected a response to the input"
            )
        advance = float((y[-1].mean() - y[0].mean()) / (count - 1)) if count > 1 else 0.0
        line = advance * np.arange(count * period).reshape(count, period) / period
        spectrum = np.fft.rfft(u, axis=1)[:, 1:].mean(axis=0)
        power = np.abs(spectrum) ** 2 / np.max(np.abs(spectrum) ** 2)
        return cls(
            record,
            period,
            spectrum,
            np.fft.rfft(y - line, axis=1)[:, 1:],
            power > EXCITED,
            power < _SILENT,
            advance,
        )

    @property
    def rms(self) -> float:
        return float(np.sqrt(2 * np.sum(np.abs(self.input) ** 2)) / self.period)

    def alike(self, other: _Steady) -> bool:
        """Of the same amplitude, period and lines."""
        return (
            self.period == other.period
            and np.array_equal(self.excited, other.excited)
            and abs(self.rms / other.rms - 1) < SAME
        )


def _levels(group: Sequence[_Steady]) -> Distortion:
    first = group[0]
    realisations = in_groups(
        group,
        lambda one, its: bool(np.linalg.norm(one.input - its.input) < SAME * np.linalg.norm(one.input)),
    )
    outputs = [np.vstack([steady.output for steady in same]) for same in realisations]
    inputs = np.stack([same[0].input for same in realisations])
    periods = min(output.shape[0] for output in outputs)
    harmonics = np.arange(1, inputs.shape[1] + 1)
    omega = 2 * np.pi * harmonics / (first.period * first.record.dt_s)
    means = np.stack([output.mean(axis=0) for output in outputs])
    # Noise of one period, smoothed over neighbouring harmonics, and its share in the mean of the periods.
    freedom = sum(output.shape[0] - 1 for output in outputs)
    noise = None
    if freedom:
        squares = sum(np.sum(np.abs(o - o.mean(axis=0)) ** 2, axis=0) for o in outputs)
        # Moving mean over harmonics, narrower next to zero, where drift makes noise steep.
        total = np.concatenate([[0.0], np.cumsum(np.asarray(squares, dtype=np.float64) / freedom)])
        index = np.arange(total.size - 1)
        reach = np.minimum(np.minimum(index, index[::-1]), _SMOOTHING)
        noise = (total[index + reach + 1] - total[index - reach]) / (2 * reach + 1)
    share = float(np.mean([1 / output.shape[0] for output in outputs]))
    at = np.flatnonzero(first.excited)
    g = means[:, at] / inputs[:, at]
    gain = g.mean(axis=0)
    drive = np.mean(np.abs(inputs[:, at]) ** 2, axis=0)

    def levels(lines: IntArray) -> LineLevels | None:
        """At lines without excitation, as if they had that of their neighbours."""
        if not lines.size:
            return None
        size = np.interp(np.log(omega[lines]), np.log(omega[at]), np.log(drive))
        of_each = np.abs(means[:, lines]) ** 2 / np.exp(size)
        there = np.interp(np.log(omega[lines]), np.log(omega[at]), np.log(np.abs(gain) + 1e-300))
        of_noise = None if noise is None else share * noise[lines] / np.exp(size)
        return LineLevels(omega[lines], of_each, len(outputs), of_noise, freedom, np.exp(there))

    inside = first.silent & (harmonics > harmonics[at[0]]) & (harmonics < harmonics[at[-1]])
    scatter = None
    if len(outputs) > 1:
        scatter = LineLevels(
            omega[at],
            np.abs(g - gain) ** 2 * len(outputs) / (len(outputs) - 1),
            len(outputs) - 1,
            None if noise is None else share * noise[at] / drive,
            freedom,
            np.abs(gain),
        )
    return Distortion(
        rms=float(np.mean([steady.rms for steady in group])),
        names=tuple(steady.record.name for steady in group),
        dt_s=first.record.dt_s,
        period_samples=first.period,
        realisations=len(outputs),
        periods=periods,
        omega_rad_s=omega[at],
        gain=gain,
        noise_std=None if noise is None else np.sqrt(noise[at] / drive),
        excited=scatter,
        odd=levels(np.flatnonzero(inside & (harmonics % 2 == 1))),
        even=levels(np.flatnonzero(inside & (harmonics % 2 == 0))),
        drift=max((steady.drift for steady in group), key=abs),
    )
