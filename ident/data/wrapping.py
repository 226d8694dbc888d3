"""Readings that are not what they seem: they wrap, stand for no reading, or spike.

An encoder's count starts again after a turn, an angle at 180 degrees, a counter or a timer after 16 bits:
`wraps_at` and `timer_period` find the period, `unwrapped` lets the readings go on. Instruments write numbers
such as -9999 or 9.9e37 where they have no reading (`no_reading`), and single samples are damaged on their way
(`spikes_in`). All of it is found by the numbers alone: jumps against usual steps, and numbers that programs
are known to use. Assumed: a moving machine changes little from sample to sample against its whole range. A
sawtooth that was meant looks like a reading that wraps; what is found is therefore reported, not corrected.
Functions take finite numbers (T,), as `Table.columns` gives them; unless they say so NaN is not checked, and
compares as false.
"""

from __future__ import annotations

import numpy as np

from ident.data.arrays import BoolArray, IntArray, RealArray


def _usual_periods() -> tuple[float, ...]:
    """Return the periods at which readings of sensors wrap, ascending, in units of the reading."""
    counters = [2.0**bits for bits in range(8, 33)]  # encoders and counters of 8 to 32 bits
    degrees = [360.0, 3600.0, 36000.0, 21600.0]  # and their tenths and hundredths; minutes of arc
    other_turns = [400.0, 6400.0, np.pi, 2 * np.pi, 1.0]  # gon, artillery mils, rad, turns
    encoder_lines = []
    # Lines or counts a turn that makers of encoders list, 100 to 800,000.
    for digits in (1, 1.2, 1.44, 1.8, 2, 2.4, 2.5, 3, 4, 5, 6, 7.2, 8):
        for exponent in (2, 3, 4, 5):
            encoder_lines.append(float(f"{digits}e{exponent}"))
    return tuple(sorted({*counters, *degrees, *other_turns, *encoder_lines}))


def _timer_periods() -> tuple[float, ...]:
    """Return the periods at which timers start again, ascending, in s, ms or us: 16, 24, 31 or 32 bits of
    ticks, or midnight."""
    # A day has 86,400 s; in s, ms and us.
    midnights = [86_400.0 * ticks_per_s for ticks_per_s in (1.0, 1e3, 1e6)]
    overflows = []
    for bits in (16, 24, 31, 32):
        for unit in (1.0, 1e-3, 1e-6):
            overflows.append(2.0**bits * unit)
    return tuple(sorted({*overflows, *midnights}))


def _ends_of_integers() -> frozenset[float]:
    """Return the largest and smallest signed integers of 16, 32 and 64 bits, the largest unsigned ones of 16
    and 32, and their neighbours, which programs write for no reading."""
    ends = []
    # A signed integer of n bits ends at 2^(n - 1).
    for bits in (15, 16, 31, 32, 63):
        ends += [2.0**bits, 2.0**bits - 1, -(2.0**bits), -(2.0**bits - 1)]
    return frozenset(ends)


# Where readings start again: powers of two, turns in several units, round numbers of an encoder's lines. A
# period of this list is believed on weaker evidence than any other number.
USUAL_PERIODS = _usual_periods()
# Periods of timers in s, ms or us, by which a column of time that starts again is read on.
TIMER_PERIODS = _timer_periods()
# Numbers that are taken for no reading where nothing else in the signal is as large (`FAR`).
ENDS_OF_INTEGERS = _ends_of_integers()

# Samples below which nothing is said of wrapping: a range and a usual step are hardly known from fewer.
# Chosen: every sensor of the tests has thousands.
FEWEST_READINGS = 20
# A step of more than this share of the range is a jump: at a wrap it is nearly 1.
JUMP_SHARE = 0.6
# A step between this share and `JUMP_SHARE` is neither usual nor a jump.
LONG_SHARE = 0.4
# Long steps per jump, at most: few where it wraps. A sine near the Nyquist frequency, which jumps at every
# sample, has .25; with twice the number it would be left to the test of smoothness.
LONG_STEPS_PER_JUMP = 0.15
# Share of the readings in the middle 60 % of the range below which they hardly are in between: a signal that
# switches between two levels, or a spike. A motion over whole turns has .6. Half and double this share, and
# of the next two numbers, judge no signal of the tests differently.
SELDOM_BETWEEN = 0.1
# Levels that readings have on each side of the range, where they wrap: a spike, or a reading that drops out,
# stands at one level or a few.
FEWEST_LEVELS = 5
# Range over median step of a motion, at least. Noise spans 7 of its median steps in some thousand samples, a
# motion many more.
MOTION_STEPS = 12.0
# Unwrapped, the standard deviation of the second differences is smaller by this factor, at least. Of a true
# wrap it is smaller by far more, of a jump that is no wrap it grows. Twice this, no gain at all, takes steps
# with a single outlier for wraps.
SMOOTHER = 0.5
# Across a wrap the unwrapped readings go on with a step of at most so many times the longest usual one: the
# period may be wrong by two steps where it is read off the range, and one more is the motion's own. An
# outlier leaves what it is away from its neighbours, less the range. Twice this judges no signal of the tests
# differently.
SEAM_STEPS = 3.0
# A step of more than this share of a period may go either way: half is the limit, where both are as long.
NEARLY_HALF = 0.4
# A speed that changes by less than this share of a period per sample leaves little doubt: a turn taken the
# wrong way changes it by a whole period less that, three times as much. At .5 both ways change it alike.
SAME_SPEED = 0.25
# Usual steps that may pass while a timer starts again: as many as may be missing at one place elsewhere
# (`time_grid`: five rows).
LONGEST_SEAM = 6.0
# A number beyond this is none: meters write 9.9e37, simulators 1e30 and 3.4e38; no quantity of a machine is
# as large.
INFINITE = 1e30
# A number that programs write for no reading counts as one where it is so many times larger than the largest
# of all others: a motion that happens to end at 9999 has readings near it. At 20, 65535 beside a signal of
# 0 to 4095, as a converter of 12 bits has it, would be a reading.
FAR = 10.0
# A command may be a single pulse, which is meant. One that is so many times the range of the others away
# from their median is none. Chosen: in the tests half of it takes out a pulse of 66 times the range, and
# twice it leaves one of 199 times in.
FAR_OF_COMMAND = 100.0
# Samples that may be spikes, as a share of all: more are a motion. Chosen; half and double judge no signal of
# the tests differently.
SPIKES_SHARE = 0.05
# The steps around a spike are so many times longer than any other step. At 20 nothing changes in the tests;
# at 5 the swings of a shock beside a spike pass for spikes.
SPIKE_STEPS = 10.0
# Share of the steps of a row counter that are 1, at least; at the others it starts again.
COUNTING_SHARE = 0.95


def wraps_at(values: RealArray) -> float:
    """Return the period at which readings seem to wrap, in their unit, or 0 where they do not.

    Parameters
    ----------
    values : ndarray, shape (T,)
        Readings of one sensor. Of fewer than 20 nothing is said.

    Returns
    -------
    float
        A usual period (`USUAL_PERIODS`) that the range fits, else the range itself (plus one for whole
        numbers, since 0 to 4095 are 4096 counts).

    Notes
    -----
    Readings that wrap jump by nearly their whole range, seldom by part of it, and go on smoothly once
    unwrapped; a single sample that jumps and comes back is an outlier. Signals that are seldom between their
    ends (switching, dropping out, or a swing about the place where the readings wrap) have to pass a stricter
    test. A sawtooth passes as well; readings that never come near both ends are not seen.
    """
    span = float(np.ptp(values)) if values.size >= FEWEST_READINGS else 0.0
    if not span > 0 or counts_rows(values):
        return 0.0

    # Steps jump, or they are usual; those in between are few.
    step_share = np.abs(np.diff(values)) / span
    jumps = step_share > JUMP_SHARE
    long_steps = (step_share > LONG_SHARE) & ~jumps
    if not jumps.any() or np.sum(long_steps) > LONG_STEPS_PER_JUMP * jumps.sum():
        return 0.0

    # The readings next to a jump are within a step of both ends, so the period is at most two steps more
    # than the range. The usual step is one that nine in ten do not exceed, as the fastest motion leaves the
    # largest gap; at least a thousandth of the range, for readings that hardly move. 1e-9: rounding.
    usual_share = float(np.quantile(step_share[~jumps], 0.9)) if not jumps.all() else 0.0
    largest_period = (1 + 2 * max(usual_share, 1e-3)) * span
    fitting_periods = [period for period in USUAL_PERIODS if span < period * (1 + 1e-9) <= largest_period]
    holds_whole_numbers = bool(np.all(values == np.round(values)))
    if fitting_periods:
        period = fitting_periods[0]
    elif holds_whole_numbers:
        # Six digits: the range is not known to more, and a user reads it.
        period = float(f"{span + 1:.6g}")
    else:
        period = float(f"{span:.6g}")
    going_on = np.unwrap(values, period=period)
    longest_usual = float(step_share[~jumps].max(initial=0.0)) * span
    longest_seam = float(np.abs(np.diff(going_on))[jumps].max())
    if _only_single_samples(jumps) or longest_seam > SEAM_STEPS * max(longest_usual, 1e-3 * span):
        return 0.0

    # The middle 60 % of the range (`SELDOM_BETWEEN`).
    low = float(values.min())
    is_between = (values > low + 0.2 * span) & (values < low + 0.8 * span)
    if float(np.mean(is_between)) < SELDOM_BETWEEN:
        # Only a swing about a usual place of wrapping, 0 or half a period, passes: it moves on both sides of
        # the range, and it is no noise. The range begins at that place but for two usual steps, or a
        # thousandth of the period, as above.
        if not fitting_periods:
            return 0.0
        distance_to_usual_place = min(abs(low), abs(low + period / 2))
        if distance_to_usual_place > 2 * max(usual_share * span, 1e-3 * period):
            return 0.0
        in_lower_half = values < low + 0.5 * span
        in_upper_half = values > low + 0.5 * span
        lower_levels = np.unique(values[in_lower_half])
        upper_levels = np.unique(values[in_upper_half])
        if min(lower_levels.size, upper_levels.size) < FEWEST_LEVELS:
            return 0.0
        usual_step = float(np.median(np.abs(np.diff(going_on))))
        if not usual_step > 0 or np.ptp(going_on) <= MOTION_STEPS * usual_step:
            return 0.0

    roughness = np.std(np.diff(values, 2))
    roughness_unwrapped = np.std(np.diff(going_on, 2))
    return period if roughness_unwrapped <= SMOOTHER * roughness else 0.0


def _only_single_samples(jumps: BoolArray) -> bool:
    """Whether a signal is away from its longest stretch for single samples only: outliers, no wraps.

    jumps (T - 1,): the steps that divide it into stretches, which are alternately usual and away.
    """
    stretches = np.split(np.arange(jumps.size + 1), np.flatnonzero(jumps) + 1)
    sizes = np.array([stretch.size for stretch in stretches])
    away = sizes[(1 + int(sizes.argmax())) % 2 :: 2]
    return bool(np.all(away == 1))


def timer_period(stamps: RealArray) -> float:
    """Return the period at which a timer with these stamps starts again, in their unit, or 0.

    Parameters
    ----------
    stamps : ndarray, shape (T,)
        Time stamps as they stand in the log.

    Returns
    -------
    float
        One of `TIMER_PERIODS` that is longer than the range of the stamps, and with which every step back is
        a usual step once the period is added. 0 where no step goes back, all do, or a stamp is not finite.
    """
    steps = np.diff(stamps)
    goes_back = steps < 0
    if not goes_back.any() or goes_back.all() or not np.all(np.isfinite(stamps)):
        return 0.0
    forward = steps[~goes_back]
    usual_step = float(np.median(forward))
    # Half a step more than usual is jitter: from there on a row would be missing.
    longest_step = max(1.5 * usual_step, float(np.max(forward)))
    longest_seam = min(longest_step, LONGEST_SEAM * usual_step)
    span = float(np.ptp(stamps))
    for period in TIMER_PERIODS:
        seams = steps[goes_back] + period
        if span < period and np.all(seams > 0) and np.all(seams <= longest_seam):
            return period
    return 0.0


def no_reading(values: RealArray, *, command: bool = False) -> IntArray:
    """Return the samples, as indices, that hold a number for no reading: -9999, 65535, 9.91e37.

    Parameters
    ----------
    values : ndarray, shape (T,)
        Finite; none of no samples.
    command : bool
        The signal is a command. Then single values that are a hundred times beyond the range of all others
        count as well; a smaller pulse may be meant.

    Returns
    -------
    ndarray of int
        Empty where there are none. Such a number is the smallest or the largest of all, at most half of the
        samples have it, and it is ten times as large as the largest of all others.
    """
    smallest = float(np.min(values, initial=0.0))
    largest = float(np.max(values, initial=0.0))
    for code in (smallest, largest):
        has_code = values == code
        rows = np.flatnonzero(has_code)
        readings = values[~has_code]
        if 2 * rows.size > values.size or not readings.size:
            continue
        largest_reading = float(np.max(np.abs(readings)))
        if _stands_for_nothing(code) and abs(code) > FAR * largest_reading:
            return rows
    if command:
        spikes = spikes_in(values)
        if spikes.size:
            readings = np.delete(values, spikes)
            distance = float(np.min(np.abs(values[spikes] - np.median(readings))))
            if distance > FAR_OF_COMMAND * float(np.ptp(readings)):
                return spikes
    return np.zeros(0, dtype=np.int64)


def _stands_for_nothing(value: float) -> bool:
    """Whether programs write this number where there is no reading.

    Such numbers are three to ten nines, another digit four to ten times, either with zeros behind it or a
    decimal point within (9.99, 7777000), an end of an integer's range (`ENDS_OF_INTEGERS`), and what is
    larger than any meter shows (`INFINITE`). False for 0; infinity counts.
    """
    # 999 is written more often than 777: the other digits have to come four times. Ten digits are what an
    # integer of 32 bits has; a reading of floating point repeats no digit as often by chance.
    digits = f"{abs(value):.10g}".replace(".", "").rstrip("0")
    fewest_digits = 3 if digits.startswith("9") else 4
    repeats_one_digit = len(set(digits)) == 1 and len(digits) >= fewest_digits
    return repeats_one_digit or value in ENDS_OF_INTEGERS or abs(value) >= INFINITE


def counts_rows(values: RealArray) -> bool:
    """Whether readings (T,) only count: they go on by one, but for a few places where they start again.

    False for a single reading. False, too, where a step is NaN.
    """
    steps = np.diff(values)
    if not steps.size:
        return False
    counts_or_restarts = (steps == 1) | (steps < 0)
    return bool(np.all(counts_or_restarts) and np.mean(steps == 1) > COUNTING_SHARE)


def spikes_in(values: RealArray) -> IntArray:
    """Return the samples, as indices, to which a signal jumps and from which it comes back.

    Parameters
    ----------
    values : ndarray, shape (T,)

    Returns
    -------
    ndarray of int
        Ascending; empty where there are none. At most 5 % of the samples (`SPIKES_SHARE`), so that signals
        of fewer than 20 have none. A single sample at either end counts, too, where nothing tells whether it
        comes back.

    Notes
    -----
    The steps around spikes are ten times longer than all others. They divide the signal into stretches that
    are alternately usual and away; the longest one is usual. From a stretch away the signal comes back to
    where it would have got by usual steps. What goes on moving there, as in a shock, is no spike, since then
    longer and shorter steps leave no gap between them.
    """
    nothing = np.zeros(0, dtype=np.int64)
    most_spikes = int(SPIKES_SHARE * values.size)
    if most_spikes == 0:
        return nothing

    # The last gap among the longest steps, in descending order, divides jumps from other steps.
    sizes = np.abs(np.diff(values))
    longest_sizes = np.sort(sizes)[::-1][: most_spikes + 1]
    if not longest_sizes[-1] > 0:
        return nothing
    before_gap = np.flatnonzero(longest_sizes[:-1] > SPIKE_STEPS * longest_sizes[1:])
    if not before_gap.size:
        return nothing
    longest_usual = longest_sizes[before_gap[-1] + 1]

    # Every other stretch, beside the longest.
    stretches = np.split(np.arange(values.size), np.flatnonzero(sizes > longest_usual) + 1)
    longest_stretch = int(np.argmax([stretch.size for stretch in stretches]))
    away = stretches[(1 + longest_stretch) % 2 :: 2]
    if sum(map(len, away)) > most_spikes:
        return nothing

    for stretch in away:
        first = stretch[0]
        last = stretch[-1]
        if first == 0 or last == values.size - 1:
            if stretch.size > 1:
                return nothing
            continue
        gap = abs(values[last + 1] - values[first - 1])
        if not gap <= (stretch.size + 1) * longest_usual:
            return nothing
    return np.concatenate(away)


def unwrapped(values: RealArray, period: float) -> tuple[RealArray, float]:
    """Return readings that wrap, going on instead, and how doubtful the direction of their longest step is.

    Parameters
    ----------
    values : ndarray, shape (T,)
        Readings, in their unit; none or one come back as they are.
    period : float
        At which they wrap, in the same unit. Positive and finite; not checked, `Record.from_file` does.

    Returns
    -------
    going_on : ndarray, shape (T,)
        The readings plus whole periods.
    longest_share : float
        Longest step as a share of the period, where it is so near to half of it (`NEARLY_HALF`) that some
        steps may go the wrong way; else 0.

    Notes
    -----
    Each step is taken the shorter way. Where one is near half a period, the turn is taken that changes the
    speed least, provided that the speed then changes by less than a quarter of a period per sample: a guess.
    """
    shorter_way = np.unwrap(values, period=period)
    longest_share = float(np.max(np.abs(np.diff(shorter_way)), initial=0.0)) / period
    if longest_share <= NEARLY_HALF:
        return shorter_way, 0.0

    # The steps are unwrapped as the readings were, and added up.
    steadiest_steps = np.unwrap(np.diff(shorter_way), period=period)
    steadiest_way = values[0] + np.concatenate([[0.0], np.cumsum(steadiest_steps)])
    # Whole turns onto the readings, so that sums do not round these.
    steadiest_way = values + period * np.round((steadiest_way - values) / period)
    largest_change = float(np.max(np.abs(np.diff(steadiest_way, 2)), initial=0.0))
    going_on = steadiest_way if largest_change <= SAME_SPEED * period else shorter_way
    return going_on, float(np.max(np.abs(np.diff(going_on)))) / period
