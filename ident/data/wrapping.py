"""Readings that wrap: an encoder's counts after a turn, an angle at 180 degrees, a counter of 16 bits."""

from __future__ import annotations

import numpy as np

from ident.data.arrays import IntArray, RealArray

# Where readings start again: powers of two, turns in several units, round numbers of an encoder's lines.
_PERIODS = tuple(
    sorted(
        {
            *(2.0**k for k in range(8, 33)),
            *(360.0, 3600.0, 21600.0, 36000.0, 400.0, 6400.0, np.pi, 2 * np.pi, 1.0),
            *(
                float(f"{digit}e{k}")
                for digit in (1, 1.2, 1.44, 1.8, 2, 2.4, 2.5, 3, 4, 5, 6, 7.2, 8)
                for k in (2, 3, 4, 5)
            ),
        }
    )
)
# Steps from .4 to .6 of the range over longer ones: few where it wraps; a sine near Nyquist has .25.
_VALLEY = 0.15
# A signal that switches between two levels, or a spike, is seldom in between.
_BETWEEN = 0.1
# A spike, or a reading that drops out, stands at one level or a few.
_LEVELS = 5
# Noise spans 7 of its median steps in some thousand samples, a motion many more.
_MOTION = 12.0
# Unwrapped, its second differences are smaller by this factor.
_SMOOTHER = 0.5
# Steps this close to half a period may go either way.
_NEARLY_HALF = 0.4
# A speed that changes by less than this share of a period per sample leaves no doubt: half would.
_SAME_SPEED = 0.25
# Timers start again after 16 to 32 bits of seconds, milliseconds or microseconds, or at midnight.
_TIMERS = tuple(
    sorted(
        {2.0**bits * unit for bits in (16, 24, 31, 32) for unit in (1.0, 1e-3, 1e-6)}
        | {86_400.0 * unit for unit in (1.0, 1e3, 1e6)}
    )
)
# Across a restart of a timer passes a usual step, or as many as may be missing at a place elsewhere.
_LONGEST_SEAM = 6.0
# Numbers that stand for no reading: the ends of 16, 32 and 64 bits, and what meters take for infinite.
_ENDS_OF_INTEGERS = frozenset(
    sign * value
    for bits in (15, 16, 31, 32, 63)
    for sign in (-1.0, 1.0)
    for value in (2.0**bits, 2.0**bits - 1)
)
_INFINITE = 1e30  # 9.9e37 of meters, 1e30 and 3.4e38 of simulators; no quantity of a machine is larger
# Such a number counts where it is so many times larger than all others.
_FAR = 10.0
# A command may be a single pulse; one so many times the range of the others is none.
_FAR_OF_COMMAND = 100.0
# Spikes: this share of the samples at most, and steps so many times longer than any other.
_FEW, _JUMPS = 0.05, 10.0


def wraps_at(values: RealArray) -> float:
    """The period at which readings (T,) seem to wrap, else 0: they jump by nearly their whole range, and go
    on smoothly once unwrapped. So does a sawtooth; readings that never came near both ends are not seen."""
    span = float(np.ptp(values)) if values.size >= 20 else 0.0
    if not span > 0 or counts_rows(values):
        return 0.0
    share = np.abs(np.diff(values)) / span
    jumps = share > 0.6
    low = float(values.min())
    between = float(np.mean((values > low + 0.2 * span) & (values < low + 0.8 * span)))
    if not jumps.any() or np.sum((share > 0.4) & ~jumps) > _VALLEY * jumps.sum():
        return 0.0
    # The readings next to a jump are within a step of both ends.
    step = float(np.quantile(share[~jumps], 0.9)) if not jumps.all() else 0.0
    whole = bool(np.all(values == np.round(values)))
    usual = [p for p in _PERIODS if span < p * (1 + 1e-9) <= (1 + 2 * max(step, 1e-3)) * span]
    period = usual[0] if usual else float(f"{span + 1 if whole else span:.6g}")
    going_on = np.unwrap(values, period=period)
    if between < _BETWEEN:
        # It switches, drops out, or swings about a usual place of wrapping, moves on both sides, and is no
        # noise.
        sides = (values[values < low + 0.5 * span], values[values > low + 0.5 * span])
        moves = min(np.unique(side).size for side in sides) >= _LEVELS
        usual_place = min(abs(low), abs(low + period / 2)) <= 2 * max(step * span, 1e-3 * period)
        usual_step = float(np.median(np.abs(np.diff(going_on))))
        if not (
            usual and usual_place and moves and np.ptp(going_on) > _MOTION * usual_step and usual_step > 0
        ):
            return 0.0
    return period if np.std(np.diff(going_on, 2)) <= _SMOOTHER * np.std(np.diff(values, 2)) else 0.0


def timer_period(stamps: RealArray) -> float:
    """The period at which a timer with these stamps (T,) starts again, in their unit, else 0.

    Every step back has to be a usual step once the period is added.
    """
    steps = np.diff(stamps)
    back = steps < 0
    if not back.any() or back.all() or not np.all(np.isfinite(stamps)):
        return 0.0
    usual = float(np.median(steps[~back]))
    longest = max(1.5 * usual, float(np.max(steps[~back])))
    span = float(np.ptp(stamps))
    for period in _TIMERS:
        seams = steps[back] + period
        if span < period and np.all(seams > 0) and np.all(seams <= min(longest, _LONGEST_SEAM * usual)):
            return period
    return 0.0


def no_reading(values: RealArray, *, command: bool = False) -> IntArray:
    """The samples (of T) that hold a number for no reading: -9999, 65535, 9.91e37, far from all others.

    command: of a command also single values that are a hundred times beyond the range of all others; a
    smaller pulse may be meant.
    """
    nothing = np.zeros(0, dtype=np.int64)
    for code in (float(np.min(values, initial=0.0)), float(np.max(values, initial=0.0))):
        rows = np.flatnonzero(values == code)
        others = values[values != code]
        if 2 * rows.size > values.size or not others.size:
            continue
        if _stands_for_nothing(code) and abs(code) > _FAR * float(np.max(np.abs(others))):
            return rows
    spikes = spikes_in(values) if command else nothing
    if spikes.size:
        others = np.delete(values, spikes)
        distance = float(np.min(np.abs(values[spikes] - np.median(others))))
        if distance > _FAR_OF_COMMAND * float(np.ptp(others)):
            return spikes
    return nothing


def _stands_for_nothing(value: float) -> bool:
    """Whether programs write this number where there is no reading: three nines and more, another digit four
    times and more, the largest of an integer, more than any meter shows."""
    digits = f"{abs(value):.10g}".replace(".", "").rstrip("0")
    repeated = len(set(digits)) == 1 and len(digits) >= (3 if digits[:1] == "9" else 4)
    return repeated or value in _ENDS_OF_INTEGERS or abs(value) >= _INFINITE


def counts_rows(values: RealArray) -> bool:
    """Whether readings (T,) only count: they go on by one, but for where they start again."""
    steps = np.diff(values)
    return (
        bool(np.all((steps == 1) | (steps < 0)) and np.mean(steps == 1) > 1 - _FEW) if steps.size else False
    )


def spikes_in(values: RealArray) -> IntArray:
    """The samples (of T) to which a signal jumps, and from which it comes back or where it ends: around them
    are steps many times longer than all others. What goes on moving there, as in a shock, is none."""
    nothing, most, size = np.zeros(0, dtype=np.int64), int(_FEW * values.size), np.abs(np.diff(values))
    longest = np.sort(size)[::-1][: most + 1]
    larger = np.flatnonzero(longest[:-1] > _JUMPS * longest[1:]) if most and longest[-1] > 0 else nothing
    if not larger.size:
        return nothing
    other = longest[larger[-1] + 1]
    parts = np.split(np.arange(values.size), np.flatnonzero(size > other) + 1)
    # Every other part, beside the longest.
    away = parts[(1 + int(np.argmax([part.size for part in parts]))) % 2 :: 2]
    # At an end, where nothing tells whether it comes back, a single sample.
    ends = {0, values.size - 1}
    comes_back = (
        part.size == 1
        if {part[0], part[-1]} & ends
        else abs(values[part[-1] + 1] - values[part[0] - 1]) <= (part.size + 1) * other
        for part in away
    )
    return np.concatenate(away) if sum(map(len, away)) <= most and all(comes_back) else nothing


def unwrapped(values: RealArray, period: float) -> tuple[RealArray, float]:
    """Readings (T,) that wrap at this period, going on instead; and their longest step as a share of the
    period where it is so near to half of it that some may go the wrong way, else 0. Near half a period the
    turn is taken that changes the speed least, if by less than a quarter of a period per sample: a guess."""
    found = np.unwrap(values, period=period)
    longest = float(np.max(np.abs(np.diff(found)), initial=0.0)) / period
    if longest <= _NEARLY_HALF:
        return found, 0.0
    going_on = values[0] + np.concatenate([[0.0], np.cumsum(np.unwrap(np.diff(found), period=period))])
    # Whole turns onto the readings, so that sums do not round these.
    going_on = values + period * np.round((going_on - values) / period)
    changes = float(np.max(np.abs(np.diff(going_on, 2)), initial=0.0))
    found = going_on if changes <= _SAME_SPEED * period else found
    return found, float(np.max(np.abs(np.diff(found)))) / period
