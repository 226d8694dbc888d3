"""What the measured position itself tells of the friction: direction, and level by inverse dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numba
import numpy as np

from ident.data.arrays import COMPILED, ComplexArray, IntArray, RealArray
from ident.data.nonparametric import over_lines
from ident.data.record import Record
from ident.friction.arm import less_friction

_BEYOND = 1.5  # over the median of a smoothed spectrum: as much as lines of white noise may have
# A position is well above its noise where its power is so many times the noise's.
_WELL = 10.0
_LEAST_NOISE = 1e-6  # of the motion: a sensor of 20 bits
# Bands, the lowest with so many periods in the shortest record; steepness of their edge.
_BANDS, _PERIODS, _STEEP = 8, 8, 8
# Deflection before slipping, as a share of the rms motion; the start takes more.
_PRESLIDING, _COARSE = 1e-5, 10.0
# Classes of the rows by speed, where errors of a law of friction show; with twice as many they widen less.
_CLASSES = 8
_DERIVATIVES = 3  # stiffness, damping, inertia, and the lag of a drive behind them


class _Spectrum(NamedTuple):
    """Line (T,) through the ends of a position, spectrum of rest and mirror image, its power over the
    noise."""

    line: RealArray
    values: ComplexArray
    over_noise: RealArray

    @property
    def kept(self) -> RealArray:
        """Wiener filter of the position in its noise."""
        return np.asarray(np.maximum(0.0, 1 - 1 / np.maximum(self.over_noise, 1e-9)))


def _spectrum(y: RealArray) -> _Spectrum:
    line = np.linspace(y[0], y[-1], y.size)
    values = np.fft.rfft(np.concatenate([y - line, -(y - line)[::-1]]))
    power = over_lines(np.abs(values) ** 2)
    floor = _BEYOND * np.median(power[power.size // 2 :])
    return _Spectrum(line, values, power / max(floor, np.finfo(np.float64).tiny))


def smoothed(y: RealArray) -> RealArray:
    """A position (T,) without what does not rise above its noise."""
    spectrum = _spectrum(y)
    return np.asarray(np.fft.irfft(spectrum.values * spectrum.kept, 2 * y.size)[: y.size] + spectrum.line)


def noise_of(y: RealArray) -> float:
    """Standard deviation of the noise of a position (T,), from the upper half of its band, floored."""
    power = np.abs(_spectrum(y).values) ** 2
    white = np.sqrt(np.median(power[power.size // 2 :]) / np.log(2) / (2 * y.size))
    return float(max(white, _LEAST_NOISE * np.std(y)))


def speed_classes(record: Record) -> IntArray:
    """(T,) of eight classes of as many rows, by the speed of the position, in either direction."""
    speed = np.abs(np.gradient(smoothed(record.output[:, 0])))
    return np.asarray(np.argsort(np.argsort(speed)) * _CLASSES // speed.size)


def rms_speed(records: Sequence[Record]) -> float:
    """Root mean square speed of the position, its noise taken off, in its units per second."""
    moved = [np.mean(np.diff(smoothed(record.output[:, 0])) ** 2) for record in records]
    return float(np.sqrt(np.mean(moved))) / records[0].dt_s


def highest_Hz(records: Sequence[Record]) -> float:
    """Highest frequency at which the position is well above its noise in some record."""
    found = []
    for record in records:
        above = np.flatnonzero(_spectrum(record.output[:, 0]).over_noise > _WELL)
        found.append(
            max(above[-1], 1) / (2 * record.n_samples * record.dt_s) if above.size else 0.5 / record.dt_s
        )
    return float(max(found))


def direction_of(position: RealArray, presliding: float) -> RealArray:
    """(T,) friction of unit level for a motion (T,), held over each sample: elastic, slipping after a
    deflection."""
    found = np.diff(position, prepend=position[0]) / presliding
    _slip(found)
    return np.asarray(0.5 * (found + np.append(found[1:], found[-1])))


@numba.njit(**COMPILED)
def _slip(moved: Any) -> None:
    """Sum of moved (T,), in place, that never leaves -1 .. 1."""
    state = 0.0
    for k in range(moved.size):
        state = min(max(state + moved[k], -1.0), 1.0)
        moved[k] = state


def presliding_of(records: Sequence[Record]) -> float:
    """Deflection before slipping that is expected, within a factor of twenty, in units of the position."""
    return _PRESLIDING * float(np.sqrt(np.mean([np.var(record.output) for record in records])))


def with_measured_direction(
    records: Sequence[Record], presliding: float, delay_samples: int, *, stiff: bool
) -> tuple[float, list[Record]]:
    """Where a fit begins: the level by inverse dynamics (`level_of`), and the records with that friction, in
    the direction of the measured motion, taken off."""
    ways = [direction_of(smoothed(record.output[:, 0]), _COARSE * presliding) for record in records]
    level = level_of(records, ways, stiff=stiff)
    both = zip(records, ways, strict=True)
    return level, [less_friction(record, level * way, delay_samples) for record, way in both]


def level_of(records: Sequence[Record], directions: Sequence[RealArray], *, stiff: bool) -> float:
    """Level, not below zero, from the inverse dynamics u = sum d_k y^(k) + level * direction + bias below a
    frequency, all signals filtered alike (Gautier, IEEE ICRA 1997): the frequency at which they explain most
    of the command. stiff: a position takes a force. Neglected: dead time, modes beyond the first."""
    seconds, top_Hz = min(record.n_samples for record in records) * records[0].dt_s, highest_Hz(records)
    best, explained = 0.0, -np.inf
    for low_Hz in np.geomspace(min(_PERIODS / seconds, 0.5 * top_Hz), top_Hz, _BANDS).tolist():
        rows = np.vstack(
            [_inverse_rows(r, way, low_Hz, stiff) for r, way in zip(records, directions, strict=True)]
        )
        size = np.linalg.norm(rows[:, :-1], axis=0)
        size[size == 0] = 1.0
        solution, *_ = np.linalg.lstsq(rows[:, :-1] / size, rows[:, -1], rcond=1e-12)
        left = rows[:, -1] - rows[:, :-1] / size @ solution
        share = 1 - float(np.var(left) / max(np.var(rows[:, -1]), np.finfo(np.float64).tiny))
        if share > explained:
            best, explained = float((solution / size)[0]), share
    return max(best, 0.0)


def _inverse_rows(record: Record, direction: RealArray, low_Hz: float, stiff: bool) -> RealArray:
    """Rows of the inverse dynamics below a frequency: direction, 1, derivatives of the position, command."""
    y, n = record.output[:, 0], record.n_samples
    spectrum, frequency_Hz = _spectrum(y), np.fft.rfftfreq(2 * n, record.dt_s)
    below = 1 / (1 + (frequency_Hz / low_Hz) ** _STEEP)

    def low(signal: RealArray) -> RealArray:
        mirrored = np.fft.rfft(np.concatenate([signal, signal[::-1]]))
        return np.asarray(np.fft.irfft(mirrored * below, 2 * n)[:n])

    moved = [
        np.fft.irfft(spectrum.values * (2j * np.pi * frequency_Hz) ** k * spectrum.kept * below, 2 * n)[:n]
        for k in range(_DERIVATIVES + 1)
    ]
    moved[0] = moved[0] + spectrum.line
    moved[1] = moved[1] + (y[-1] - y[0]) / ((n - 1) * record.dt_s)
    columns = [low(direction), np.ones(n), *moved[0 if stiff else 1 :], low(record.input[:, 0])]
    ends, step = n // 20, max(1, int(0.25 / (low_Hz * record.dt_s)))
    return np.column_stack(columns)[ends : n - ends : step]
