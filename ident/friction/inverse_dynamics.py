"""What the measured position itself tells of the friction: direction, and level by inverse dynamics.

A fit of friction needs a start. The spectrum of the position is set against its noise, which is white and
read from the upper half of the band; a Wiener filter leaves the motion. The motion gives the direction of an
elastic friction that slips, and the inverse dynamics below some frequency, a regression of the command on
derivatives of the position, its level. Also here: noise, rms speed and highest visible frequency of a record.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numba
import numpy as np

from ident.data.arrays import COMPILED, ComplexArray, IntArray, RealArray
from ident.data.nonparametric import over_lines
from ident.data.record import Record
from ident.friction.arm import less_friction

# Noise floor over the median of a smoothed spectrum: as much as lines of white noise may have. Doubled, weak
# motion would be filtered away as noise.
_NOISE_OVER_MEDIAN = 1.5
# A position is well above its noise where its power is so many times the noise's. Chosen.
_WELL_ABOVE = 10.0
# Smallest power over noise for the Wiener filter: a division by zero is avoided, the gain is zero there.
_TINY_OVER_NOISE = 1e-9
# Least standard deviation of the noise, as a share of the motion's: a sensor of 20 bits.
_LEAST_NOISE = 1e-6
# Frequencies below which inverse dynamics are tried. Chosen.
_BANDS = 8
# Periods of the lowest of them in the shortest record. Chosen.
_PERIODS = 8
# Exponent of the edge of a band, 1 / (1 + (f / f0)^8). Chosen: steep, but with little ringing.
_STEEPNESS = 8
# Deflection before slipping that is expected, as a share of the rms motion: ten microradians of a radian.
_PRESLIDING = 1e-5
# The start takes a deflection so many times larger. Chosen: noise that the filter leaves moves the direction
# less then.
_COARSE = 10.0
# Classes of the rows by speed, where errors of a law of friction show; with twice as many they widen less.
_CLASSES = 8
# Derivatives of the position in the inverse dynamics: 0 stiffness, 1 damping, 2 inertia, 3 the lag of a drive
# behind them.
_DERIVATIVES = 3
# Smallest singular value of the regression that counts, as a share of the largest. Rounding of doubles.
_RANK = 1e-12
# Part (one in so many) of a record at either end that the regression leaves out: the filters ring there.
_ENDS = 20
# Rows of the regression in a period of its band: four, more would repeat each other.
_ROW_STEP_IN_PERIODS = 0.25


class _Spectrum(NamedTuple):
    """Spectrum of a position of T samples, made periodic.

    line (T,): straight line through both ends; values (T + 1,): discrete Fourier transform of what the
    position is above it, followed by its mirror image with the opposite sign; over_noise (T + 1,): power of
    the values, smoothed over lines, over that of the noise.
    """

    line: RealArray
    values: ComplexArray
    over_noise: RealArray

    @property
    def wiener_gain(self) -> RealArray:
        """Gain (T + 1,) of the Wiener filter of the position in its noise, 0 to 1."""
        return np.asarray(np.maximum(0.0, 1 - 1 / np.maximum(self.over_noise, _TINY_OVER_NOISE)))


def _spectrum(position: RealArray) -> _Spectrum:
    """Spectrum of a position (T,), and its power over the noise that the upper half of the band shows."""
    line = np.linspace(position[0], position[-1], position.size)
    mirrored = np.concatenate([position - line, -(position - line)[::-1]])
    values = np.fft.rfft(mirrored)
    power = over_lines(np.abs(values) ** 2)
    floor = _NOISE_OVER_MEDIAN * np.median(power[power.size // 2 :])
    return _Spectrum(line, values, power / max(floor, np.finfo(np.float64).tiny))


def smoothed(position: RealArray) -> RealArray:
    """A position (T,), in its own units, without what does not rise above its noise."""
    spectrum = _spectrum(position)
    filtered = np.fft.irfft(spectrum.values * spectrum.wiener_gain, 2 * position.size)
    return np.asarray(filtered[: position.size] + spectrum.line)


def noise_of(position: RealArray) -> float:
    """Standard deviation of the noise of a position (T,), in its units; at least that of 20 bits.

    The upper half of the band is taken as noise. The median of the power of a line of white noise is log 2
    times its mean.
    """
    power = np.abs(_spectrum(position).values) ** 2
    median = np.median(power[power.size // 2 :])
    white = np.sqrt(median / np.log(2) / (2 * position.size))
    return float(max(white, _LEAST_NOISE * np.std(position)))


def speed_classes(record: Record) -> IntArray:
    """Class (T,), 0 to 7, of each row by the speed of the position, in either direction; as many in each."""
    speed = np.abs(np.gradient(smoothed(record.output[:, 0])))
    rank = np.argsort(np.argsort(speed))
    return np.asarray(rank * _CLASSES // speed.size)


def rms_speed(records: Sequence[Record]) -> float:
    """Root mean square speed of the position, its noise taken off, in its units per second."""
    mean_squares = [np.mean(np.diff(smoothed(record.output[:, 0])) ** 2) for record in records]
    return float(np.sqrt(np.mean(mean_squares))) / records[0].dt_s


def highest_Hz(records: Sequence[Record]) -> float:
    """Highest frequency, Hz, at which the position is well above its noise in some record.

    A record whose position is nowhere above its noise counts up to its Nyquist frequency.
    """
    highest = []
    for record in records:
        lines = np.flatnonzero(_spectrum(record.output[:, 0]).over_noise > _WELL_ABOVE)
        if lines.size:
            highest.append(max(lines[-1], 1) / (2 * record.n_samples * record.dt_s))
        else:
            highest.append(0.5 / record.dt_s)
    return float(max(highest))


def direction_of(position: RealArray, presliding: float) -> RealArray:
    """Friction (T,) of unit level, -1 to 1, for a motion (T,), held over each sample.

    The friction is elastic and slips after a deflection by `presliding`, in units of the position.
    """
    friction = np.diff(position, prepend=position[0]) / presliding
    _slip(friction)
    # Over a sample the friction is between what it is at both of its ends.
    after = np.append(friction[1:], friction[-1])
    return np.asarray(0.5 * (friction + after))


@numba.njit(**COMPILED)
def _slip(moved: Any) -> None:
    """Sum of the motions `moved` (T,), in place, that never leaves -1 .. 1."""
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
    """Where a fit of friction begins: its level, and the records with that friction taken off.

    Parameters
    ----------
    records : sequence of Record
        One input, and the position of the shaft as the one output.
    presliding : float
        Deflection before slipping, in units of the position.
    delay_samples : int
        Dead time of the input, which does not delay the friction.
    stiff : bool
        A position takes a force: the arm has no integrator.

    Returns
    -------
    tuple of float and list of Record
        Level by inverse dynamics (`level_of`), units of the input; the records, whose input is smaller by the
        friction in the direction of the measured motion.
    """
    directions = [direction_of(smoothed(record.output[:, 0]), _COARSE * presliding) for record in records]
    level = level_of(records, directions, stiff=stiff)
    frictionless = []
    for record, direction in zip(records, directions, strict=True):
        frictionless.append(less_friction(record, level * direction, delay_samples))
    return level, frictionless


def level_of(records: Sequence[Record], directions: Sequence[RealArray], *, stiff: bool) -> float:
    """Level of the friction by inverse dynamics, in units of the input, not below zero.

    Parameters
    ----------
    records : sequence of Record
        One input, and the position of the shaft as the one output.
    directions : sequence of ndarray, shape (T,)
        Friction of unit level of each record.
    stiff : bool
        A position takes a force: the arm has no integrator.

    Returns
    -------
    float

    Notes
    -----
    u = sum d_k y^(k) + level * direction + bias below a frequency, all signals filtered alike (Gautier, IEEE
    ICRA 1997). Of several frequencies the one counts at which the right side explains most of the command.
    Neglected: dead time, modes beyond the first.
    """
    shortest_s = min(record.n_samples for record in records) * records[0].dt_s
    top_Hz = highest_Hz(records)
    bottom_Hz = min(_PERIODS / shortest_s, 0.5 * top_Hz)
    level = 0.0
    largest_share = -np.inf
    for low_Hz in np.geomspace(bottom_Hz, top_Hz, _BANDS).tolist():
        blocks = []
        for record, direction in zip(records, directions, strict=True):
            blocks.append(_inverse_rows(record, direction, low_Hz, stiff))
        rows = np.vstack(blocks)
        # Columns of length one: derivatives differ by many decades.
        size = np.linalg.norm(rows[:, :-1], axis=0)
        is_empty = size == 0
        size[is_empty] = 1.0
        solution, *_ = np.linalg.lstsq(rows[:, :-1] / size, rows[:, -1], rcond=_RANK)
        residual = rows[:, -1] - rows[:, :-1] / size @ solution
        variance = max(np.var(rows[:, -1]), np.finfo(np.float64).tiny)
        explained_share = 1 - float(np.var(residual) / variance)
        if explained_share > largest_share:
            level = float((solution / size)[0])
            largest_share = explained_share
    return max(level, 0.0)


def _inverse_rows(record: Record, direction: RealArray, low_Hz: float, stiff: bool) -> RealArray:
    """Rows (M, C) of the inverse dynamics of a record below a frequency.

    Columns: direction (T,) of the friction, 1, derivatives of the position from the zeroth (stiff) or first
    one on, and last the command in units of the input; all through one low-pass at `low_Hz`, thinned to four
    rows in a period, without both ends.
    """
    position = record.output[:, 0]
    n = record.n_samples
    spectrum = _spectrum(position)
    frequency_Hz = np.fft.rfftfreq(2 * n, record.dt_s)
    low_pass = 1 / (1 + (frequency_Hz / low_Hz) ** _STEEPNESS)

    def low(signal: RealArray) -> RealArray:
        """A signal (T,) through the low-pass, without phase, mirrored at its end."""
        mirrored = np.fft.rfft(np.concatenate([signal, signal[::-1]]))
        return np.asarray(np.fft.irfft(mirrored * low_pass, 2 * n)[:n])

    derivatives = []
    for order in range(_DERIVATIVES + 1):
        derivative = spectrum.values * (2j * np.pi * frequency_Hz) ** order
        filtered = derivative * spectrum.wiener_gain * low_pass
        derivatives.append(np.fft.irfft(filtered, 2 * n)[:n])
    # The spectrum is that above a straight line, whose height and slope are put back.
    duration_s = (n - 1) * record.dt_s
    derivatives[0] = derivatives[0] + spectrum.line
    derivatives[1] = derivatives[1] + (position[-1] - position[0]) / duration_s
    if not stiff:
        derivatives = derivatives[1:]
    rows = np.column_stack([low(direction), np.ones(n), *derivatives, low(record.input[:, 0])])

    ends = n // _ENDS
    step = max(1, int(_ROW_STEP_IN_PERIODS / (low_Hz * record.dt_s)))
    return rows[ends : n - ends : step]
