"""The uniform grid under a log's time stamps: its step, or why there is none and what helps.

Models of records take samples at a uniform step. `sampling_time` takes the step from stamps that are uniform
to 1 %, and otherwise says what is wrong and which option makes it good. `TimeGrid` puts rows whose stamps
jitter, or of which single ones were lost, on the grid that fits all stamps best, by a cubic spline.
`CoarseGrid` makes a coarser grid of stamps that keep to none, with straight lines between readings and means
of the input. `Repair` says what either did, and up to which frequency the result is faithful to 1 % (of a
cubic spline: Hall and Meyer, Journal of Approximation Theory 16, 1976). Assumed: stamps say when rows were
taken. A usual step is the median one, which lost rows do not move. Of a `Table` only its path and the place
of a row, in words, matter here: complaints name them. Functions that say "increasing" do not check it, nor
that there are two stamps: their callers have asked `Table.increasing`, which raises ValueError.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from ident.data.arrays import IntArray, RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.table import Table

# How far a step may be from the usual one, as a share of it, where stamps count as uniform: at the Nyquist
# frequency it is a phase wrong by 0.03 rad, and it is above the jitter of a controller's clock.
TIME_TOLERANCE = 0.01
# How far a stamp may be off its instant, in samples, for an interpolation to make it good. Steps between two
# such stamps are then up to 1.4 samples (`jitter_of` up to 0.4; `sampling_time` compares a step's distance
# with this number only to choose its words), and the error of a cubic spline, which grows with their fourth
# power, 3.8 times that of even ones. From half a sample on nobody knows which sample a stamp is.
LARGEST_JITTER = 0.2
# Stamps closer than this to their instants, in samples, count as on them: an output changes by a thousandth
# of its step from row to row.
ON_GRID = 1e-3
# Rows that may be missing at one place: a spline over such a gap is right to 1 % up to a twentieth of the
# Nyquist frequency.
MOST_LOST_ROWS = 5
# Share of all rows that may be missing: ellipses come out too narrow by 2.6 % at most, 1 / sqrt(0.95).
MOST_LOST_SHARE = 0.05
# Error of an interpolation, as a share of a sine's amplitude, up to which it counts as faithful.
FAITHFUL_SHARE = 0.01
# Frequency times spacing h, rad, at which a cubic spline has that error: 5/384 (omega h)^4.
FAITHFUL_SPLINE_RAD = (FAITHFUL_SHARE * 384 / 5) ** 0.25
# Frequency times spacing, rad, at which a straight line between readings has it: (omega h)^2 / 8.
FAITHFUL_LINE_RAD = (FAITHFUL_SHARE * 8) ** 0.5
# Frequency times step, rad, at which an input that is averaged over a step and held for the next has it:
# 1 - sinc(omega h / 2)^2 = (omega h)^2 / 12.
FAITHFUL_MEAN_RAD = (FAITHFUL_SHARE * 12) ** 0.5
# Parts of a log whose mean step is compared with that of the whole, to show how a clock drifts: enough for a
# clock that warms up, and of two steps each at least. Chosen; it moves no grid, only
# whether and with which number a drift is reported.
CLOCK_PARTS = 10
# Usual steps of the log in each step of a coarser grid that is proposed: none is without a reading unless two
# readings in a row are missing.
READINGS_PER_STEP = 3
# Multiples of a power of ten that a proposed step is, ascending up to the next power: numbers that one types.
ROUND_MULTIPLES = (1, 2, 3, 5, 10)


def sampling_time(table: Table, stamps: RealArray | None, name: str | None, dt_s: float | None) -> float:
    """Return the sampling time of a log, s: the mean step of its stamps, or the stated one.

    Parameters
    ----------
    table : Table
        For complaints: the path, the place of a row, the names of columns.
    stamps : ndarray, shape (T,), or None
        Time stamps, s; None where the log has no time column. Fewer than two are refused.
    name : str or None
        Of the time column, for complaints.
    dt_s : float or None
        Stated sampling time, s. Where there are stamps as well, they have to agree to 1 %.

    Raises
    ------
    ValueError
        Neither stamps nor a sampling time, one that is not positive, or stamps that are not increasing or not
        uniform to `TIME_TOLERANCE`, unless they are a uniform clock's that were rounded. The message names
        the first place, the cause and the option that helps.
    """
    if dt_s is not None and not (np.isfinite(dt_s) and dt_s > 0):
        raise ValueError(f"{table.path}: dt_s must be a positive number of seconds; got {dt_s}")
    if stamps is None:
        if dt_s is None:
            raise ValueError(
                f"{table.path}: give the time column or dt_s (--time NAME or --dt-s SECONDS); the file has "
                f"{table.listed()}"
            )
        return float(dt_s)

    # Lost samples move the mean step, but not the median.
    table.increasing(stamps, name)
    steps = np.diff(stamps)
    median = float(np.median(steps))
    uneven = np.flatnonzero(~(np.abs(steps - median) <= TIME_TOLERANCE * median))
    if uneven.size and not only_rounded(stamps):
        row = int(uneven[0])
        n_lost = _usual_steps_in(steps) - 1
        jitter = jitter_of(stamps)
        if jitter > LARGEST_JITTER:
            cause = f"the stamps keep to no grid, steps are {np.min(steps):.4g} to {np.max(steps):.4g} s"
        elif np.any(n_lost > 0):
            row = int(np.argmax(n_lost > 0))
            missing = int(np.sum(np.maximum(n_lost, 0)))
            cause = f"rows missing: {missing} of {stamps.size + missing}"
        else:
            cause = f"no row is missing, the clock jitters by up to {jitter:.1%} of a step"
        raise ValueError(
            f"{table.path}, {table.place(row + 1)}: time '{name}' steps by {steps[row]:.6g} s where most "
            f"steps are {median:.6g} s; expected uniform sampling (each step within {TIME_TOLERANCE:.0%}); "
            f"{cause}: {_advice(stamps)}"
        )

    # Of uniform stamps the mean is the better estimate.
    mean = float((stamps[-1] - stamps[0]) / steps.size)
    if dt_s is None:
        # Rounding noise of decimal stamps: 0.0020000000000000005 is 0.002. Twelve digits are ten more than
        # the stamps are uniform to, and four less than rounding reaches.
        return float(f"{mean:.12g}")
    if not abs(dt_s - mean) <= TIME_TOLERANCE * mean:
        raise ValueError(
            f"{table.path}: dt_s = {dt_s:.6g} s, but the time column '{name}' steps by {mean:.6g} s"
        )
    return float(dt_s)


def only_rounded(stamps: RealArray) -> bool:
    """Whether stamps (T,) [s], increasing, are a uniform clock's, rounded: 0.008, 0.016, 0.023 of 1/128 s.

    They have a last decimal of at most half a usual step, and lie on a straight line but for rounding: half
    of that decimal, and a quarter more, as a line through rounded stamps is itself off by part of it. False
    where no decimal up to the ninth is the last one. False, too, for a single stamp.
    """
    since_first = stamps - stamps[0]
    # The last decimal: a power of ten of which all stamps are multiples; 0 where there is none down to
    # nanoseconds (1e-9 s), the finest that clocks write. 1e-10 s: a tenth of that, above the rounding of
    # doubles.
    digit = 0.0
    for decimals in range(10):
        if np.allclose(since_first, np.round(since_first, decimals), 0, 1e-10):
            digit = 10.0**-decimals
            break
    # Of coarser decimals two rows would have one stamp, or nearly.
    if not 0 < digit <= 0.5 * np.median(np.diff(stamps)):
        return False
    rows = np.arange(since_first.size)
    uniform = np.polyval(np.polyfit(rows, since_first, 1), rows)
    # Half of the last decimal, and a quarter more.
    return bool(np.max(np.abs(since_first - uniform)) <= 0.75 * digit)


def clock_doubts(stamps: RealArray, record: str) -> tuple[Finding, ...]:
    """Return the finding on stamps that are uniform from row to row, but whose small deviations add up.

    Parameters
    ----------
    stamps : ndarray, shape (T,)
        Increasing, s; uniform to `TIME_TOLERANCE`.
    record : str
        How the finding calls the log.

    Returns
    -------
    tuple of Finding
        Empty where the stamps stay within `LARGEST_JITTER` of one grid, are only rounded, or are fewer than
        21. `share`: largest difference between the mean step of a tenth of the log and that of all, relative;
        no frequency is known better. `dt_s`: a step to which the log could be resampled.
    """
    steps = np.diff(stamps)
    # Two steps in each part.
    if steps.size < 2 * CLOCK_PARTS or only_rounded(stamps):
        return ()
    largest_lateness = float(np.max(np.abs(_best_grid(stamps).late)))
    if largest_lateness <= LARGEST_JITTER:
        return ()
    mean = float(np.mean(steps))
    share = 0.0
    for part in np.array_split(steps, CLOCK_PARTS):
        share = max(share, abs(float(np.mean(part)) / mean - 1))
    drift = finding(
        FindingKind.CLOCK_DRIFTS,
        record=record,
        samples=largest_lateness,
        share=share,
        dt_s=_coarser_step(steps),
    )
    return (drift,)


def jitter_of(stamps: RealArray) -> float:
    """Return the largest distance of a step from a whole number of usual ones, at least one, in usual steps.

    stamps: (T,) [s], increasing; the usual step is the median. A step shorter than half a usual one is
    compared with one, as no step is of no row. Not checked: fewer than two stamps raise ValueError (largest
    of nothing), repeated ones give NaN or infinity.
    """
    steps = np.diff(stamps)
    in_usual_steps = steps / float(np.median(steps))
    whole = np.maximum(np.rint(in_usual_steps), 1)
    return float(np.max(np.abs(in_usual_steps - whole)))


def option_for(stamps: RealArray) -> str:
    """Return the option that takes increasing stamps (T,) [s].

    '' where they are uniform; 'split' where more rows are missing at a place than can be filled in;
    '--repair' where all are close to one grid and few rows are missing; else '--resample-s SECONDS'. Two
    stamps at least; not checked.
    """
    steps = np.diff(stamps)
    median = float(np.median(steps))
    if np.max(np.abs(steps - median)) <= TIME_TOLERANCE * median or only_rounded(stamps):
        return ""
    # Five lost rows are a step of six; half a step more is the border between six and seven.
    if np.max(steps) > (MOST_LOST_ROWS + 1.5) * median:
        return "split"
    grid = _best_grid(stamps)
    each_row_has_a_sample = np.all(np.diff(grid.rows) > 0)
    is_close = np.max(np.abs(grid.late)) <= LARGEST_JITTER
    n_samples = grid.rows[-1] + 1
    if each_row_has_a_sample and is_close and stamps.size >= (1 - MOST_LOST_SHARE) * n_samples:
        return "--repair"
    return f"--resample-s {_coarser_step(steps):g}"


def _advice(stamps: RealArray, options: bool = True) -> str:
    """Return what to do about stamps (T,) [s] that are not uniform, in words.

    options: whether who reads it can give options; they are named as on the command line and in Python.
    Stamps that are uniform would give words without an option: callers ask of refused ones alone.
    """
    option = option_for(stamps)
    if option == "split":
        return "split the file there"
    if not options:
        return "resample it to a uniform step"
    name, _, number = option.removeprefix("--").partition(" ")
    return f"{option} ({name.replace('-', '_')} = {number or 'true'})"


def _coarser_step(steps: RealArray) -> float:
    """Return a step, s, of a coarser grid for a log with these steps (T - 1,) [s].

    It is 1, 2, 3 or 5 times a power of ten, holds three usual steps, and bridges the largest gap with no more
    steps than may be without a reading. steps: positive and finite; not checked (the logarithm of 0 is none).
    """
    for_readings = READINGS_PER_STEP * float(np.median(steps))
    for_gap = float(np.max(steps)) / (MOST_LOST_ROWS + 1)
    shortest = max(for_readings, for_gap)
    decade = 10.0 ** np.floor(np.log10(shortest))
    multiple = next(multiple for multiple in ROUND_MULTIPLES if multiple * decade >= shortest)
    return float(f"{multiple * decade:.6g}")


def _usual_steps_in(steps: RealArray) -> IntArray:
    """Return how many usual (median) steps each step (T - 1,) [s] is, rounded to whole numbers, (T - 1,).

    0 for a step below half a usual one. steps: at least one, the median positive; not checked.
    """
    return np.rint(steps / np.median(steps)).astype(np.int64)


class _BestGrid(NamedTuple):
    """A uniform grid that fits stamps by least squares.

    rows: (T,) the sample each stamp is, from 0; late: (T,) stamp minus instant of that sample, in samples;
    step_s: the grid's step.
    """

    rows: IntArray
    late: RealArray
    step_s: float


def _best_grid(stamps: RealArray) -> _BestGrid:
    """Return the grid that fits increasing stamps (T,) [s] best, by least squares over all of them.

    A step counts as the nearest whole number of usual ones, 0 where it is below half: then two rows have one
    sample, which callers refuse. Two stamps at least, of which `polyfit` makes a line; not checked.
    """
    steps = _usual_steps_in(np.diff(stamps))
    rows = np.concatenate([[0], np.cumsum(steps)])
    step_s, start_s = np.polyfit(rows, stamps - stamps[0], 1)
    late = (stamps - stamps[0] - start_s) / step_s - rows
    return _BestGrid(rows, late, float(step_s))


@dataclass(frozen=True)
class Repair:
    """What was done to the rows of a log to have them on a uniform grid.

    Attributes
    ----------
    samples : int
        Samples of the grid.
    missing : int
        Samples without a row of the log (of a coarser grid: without a reading near), which were filled in.
    jitter : float
        Largest distance of a stamp from its instant, in samples; of a coarser grid, of a step of the log from
        whole usual ones, in these.
    own_s : float
        Of a coarser grid: the usual step of the log itself, s; 0 on the log's own grid.
    largest_s : float
        Of a coarser grid: the largest step of the log that is not longer than one of the grid, s.
    """

    samples: int
    missing: int
    jitter: float
    own_s: float = 0.0
    largest_s: float = 0.0

    def finding(self, record: str, dt_s: float) -> Finding:
        """Return what a user should know of the repair.

        Parameters
        ----------
        record : str
            How the finding calls the log.
        dt_s : float
            Step of the grid, s; positive, not checked.

        Returns
        -------
        Finding
            RESAMPLED on a coarser grid, REPAIRED on the log's own.
            `too_narrow`: share by which ellipses shrink if every filled row counts as one more measurement.
            `faithful_rad_s`: above this frequency what stands between the readings is wrong by more than 1 %
            of the motion.
        """
        n_measured = max(self.samples - self.missing, 1)
        too_narrow = (self.samples / n_measured) ** 0.5 - 1
        if self.own_s:
            return finding(
                FindingKind.RESAMPLED,
                record=record,
                samples=self.samples,
                missing=self.missing,
                jitter=self.jitter,
                too_narrow=too_narrow,
                dt_s=dt_s,
                own_s=self.own_s,
                faithful_rad_s=min(FAITHFUL_LINE_RAD / self.largest_s, FAITHFUL_MEAN_RAD / dt_s),
            )
        # Two neighbours that stray apart, each by the jitter, leave a longer step.
        longest_s = (1 + 2 * self.jitter) * dt_s
        return finding(
            FindingKind.REPAIRED,
            record=record,
            samples=self.samples,
            missing=self.missing,
            jitter=self.jitter,
            too_narrow=too_narrow,
            faithful_rad_s=FAITHFUL_SPLINE_RAD / longest_s,
        )


@dataclass(frozen=True, eq=False)
class TimeGrid:
    """A log of R rows on multiples of its sampling period, T samples, some of which may have no row.

    Attributes
    ----------
    dt_s : float
        Sampling period, s, by least squares over all stamps.
    rows : ndarray of int, shape (R,)
        The sample each row is, increasing from 0.
    late : ndarray, shape (R,)
        Stamp minus instant of that sample, in samples; all 0 where the log is on the grid as it is.
    """

    dt_s: float
    rows: IntArray
    late: RealArray

    @classmethod
    def of(cls, table: Table, name: str, stamps: RealArray, *, options: bool = True) -> TimeGrid:
        """Return the grid under the stamps of a log; its phase is their mean.

        Parameters
        ----------
        table : Table
            For complaints: the path and the place of a row.
        name : str
            Of the time column, for complaints.
        stamps : ndarray, shape (R,)
            Time stamps, s.
        options : bool
            Whether who reads a complaint can give --repair and --resample-s.

        Raises
        ------
        ValueError
            One line with file and row: time that does not increase, more than five rows lost at a place or
            5 % of all, or a stamp more than `LARGEST_JITTER` off the grid.
        """
        table.increasing(stamps, name)
        steps = np.diff(stamps)
        usual_step = float(np.median(steps))
        counts = _usual_steps_in(steps)
        is_long_gap = counts > MOST_LOST_ROWS + 1
        if np.any(is_long_gap):
            row = int(np.argmax(is_long_gap))
            raise ValueError(
                f"{table.path}, {table.place(row + 1)}: time '{name}' steps by {steps[row]:.6g} s where "
                f"most steps are {usual_step:.6g} s; at most {MOST_LOST_ROWS} rows may be missing at a "
                "place: split the file"
            )

        grid = _best_grid(stamps)
        lateness = np.abs(grid.late)
        if np.any(counts == 0) or np.max(lateness) > LARGEST_JITTER:
            row = int(np.argmax(lateness))
            raise ValueError(
                f"{table.path}, {table.place(row)}: time '{name}' is {lateness[row]:.2f} of a step of "
                f"{usual_step:.6g} s off a uniform grid (steps: {np.min(steps):.4g} to {np.max(steps):.4g} "
                f"s; their deviations add up); --repair takes {LARGEST_JITTER:g}: {_advice(stamps, options)}"
            )
        n_samples = grid.rows[-1] + 1
        if len(stamps) < (1 - MOST_LOST_SHARE) * n_samples:
            raise ValueError(
                f"{table.path}: {n_samples - len(grid.rows)} of {n_samples} rows are missing by the time "
                f"column '{name}'; expected at most {MOST_LOST_SHARE:.0%}: {_advice(stamps, options)}"
            )
        late = np.zeros(len(grid.rows)) if np.max(lateness) <= ON_GRID else grid.late
        # Rounding noise of decimal stamps: 0.0020000000000000005 is 0.002.
        return cls(float(f"{grid.step_s:.12g}"), grid.rows, late)

    @property
    def n_samples(self) -> int:
        """T, samples of the grid from the first to the last row. At least 2, as `of` refuses less."""
        return int(self.rows[-1]) + 1

    @property
    def repair(self) -> Repair | None:
        """What `sampled` changes; None where the log is on the grid as it is.

        Its samples, how many are missing, and the largest lateness in samples.
        """
        jitter = float(np.max(np.abs(self.late)))
        if not self.missing and not jitter:
            return None
        return Repair(self.n_samples, len(self.missing), jitter)

    @property
    def missing(self) -> tuple[int, ...]:
        """Samples that the log has no row for, ascending. Empty where each has one."""
        samples = np.arange(self.rows[-1] + 1)
        return tuple(int(sample) for sample in np.setdiff1d(samples, self.rows))

    def sampled(self, values: RealArray) -> RealArray:
        """Return outputs at the instants of the grid.

        Parameters
        ----------
        values : ndarray, shape (R,) or (R, Y)
            As they were read at the stamps, finite; scipy raises ValueError for another length or NaN.

        Returns
        -------
        ndarray, shape (T,) or (T, Y)
            By a cubic spline through the readings; readings on the grid stay as they are.

        Notes
        -----
        Neglected: the fourth derivative over a sample; noise of the readings next to a missing row.
        """
        from scipy.interpolate import CubicSpline  # here: a log that is refused never waits for it

        samples = np.arange(self.rows[-1] + 1)
        is_on_grid = not self.late.any()
        if len(samples) == len(values) and is_on_grid:
            return values
        filled = np.asarray(CubicSpline(self.rows + self.late, values)(samples))
        # Readings on the grid are exact, the spline through them but for rounding.
        if is_on_grid:
            filled[self.rows] = values
        return filled

    def held(self, values: RealArray) -> RealArray:
        """Return inputs (T,) at the instants of the grid, from those of the rows (R,).

        Each is held from the instant of its sample on, whatever its stamp; on a line between its neighbours
        where the row is missing. numpy raises ValueError for another length; NaN spreads to the samples
        beside it.
        """
        return np.interp(np.arange(self.rows[-1] + 1), self.rows, values)


@dataclass(frozen=True, eq=False)
class CoarseGrid:
    """A log of R rows on a coarser grid that begins at the first row.

    Attributes
    ----------
    stamps : ndarray, shape (R,)
        Time stamps since the first, s, increasing.
    dt_s : float
        Step of the grid, s.
    """

    stamps: RealArray
    dt_s: float

    @classmethod
    def of(cls, table: Table, name: str, stamps: RealArray, dt_s: float) -> Self:
        """Return the grid of a step for the stamps of a log.

        Parameters
        ----------
        table : Table
            For complaints: the path and the place of a row.
        name : str
            Of the time column, for complaints.
        stamps : ndarray, shape (R,)
            Time stamps, s.
        dt_s : float
            Step of the grid, s: at least the usual step of the log, at most its length.

        Raises
        ------
        ValueError
            Time that does not increase, a step that does not fit, or more than five steps of the grid without
            a reading.
        """
        table.increasing(stamps, name)
        steps = np.diff(stamps)
        usual_step = float(np.median(steps))
        length_s = float(stamps[-1] - stamps[0])
        if not (1 - TIME_TOLERANCE) * usual_step <= dt_s <= length_s:
            proposed_step = min(_coarser_step(steps), length_s)
            raise ValueError(
                f"{table.path}: resample_s = {dt_s:.6g} s; expected {usual_step:.6g} s, the usual step of "
                f"'{name}', to {length_s:.6g} s; try --resample-s {proposed_step:g}"
            )
        row = int(np.argmax(steps))
        if steps[row] > (MOST_LOST_ROWS + 1) * max(dt_s, usual_step * (1 + TIME_TOLERANCE)):
            raise ValueError(
                f"{table.path}, {table.place(row + 1)}: time '{name}' steps by {steps[row]:.6g} s; at "
                f"most {MOST_LOST_ROWS} steps of the grid (resample_s = {dt_s:.6g} s) may be without a "
                "reading: split the file there"
            )
        return cls(stamps - stamps[0], dt_s)

    @property
    def _instants(self) -> RealArray:
        """Instants (T,) of the grid, s, from 0 to the last stamp.

        The last one is at or before the last stamp. Positive step and increasing stamps, as `of` has checked.
        """
        # Rounding of the stamps must not cost the last one: a millionth of a step is far above rounding, and
        # far below what a stamp is off.
        n_samples = int(np.floor(self.stamps[-1] / self.dt_s + 1e-6)) + 1
        return np.asarray(self.dt_s * np.arange(n_samples), dtype=np.float64)

    @property
    def n_samples(self) -> int:
        """T, instants of the grid. At least 2, as a step is at most the length of the log."""
        return int(self._instants.size)

    @property
    def repair(self) -> Repair:
        """What became of the log: instants without a reading within half a step, and its own steps.

        Not asked of a grid that `of` would refuse: without a step inside one of the grid the largest is none.
        """
        instants = self._instants
        edges = np.append(instants - self.dt_s / 2, instants[-1] + self.dt_s / 2)
        readings_per_instant = np.histogram(self.stamps, edges)[0]
        steps = np.diff(self.stamps)
        usual_step = float(np.median(steps))
        is_inside_a_step = steps <= max(self.dt_s, usual_step)
        return Repair(
            samples=instants.size,
            missing=int(np.sum(readings_per_instant == 0)),
            jitter=jitter_of(self.stamps),
            own_s=usual_step,
            largest_s=float(np.max(steps[is_inside_a_step])),
        )

    def sampled(self, values: RealArray) -> RealArray:
        """Return outputs (T,) at the instants of the grid, from those of the rows (R,).

        They lie on straight lines between the readings, which never make noise larger. numpy raises
        ValueError for another length than R.
        """
        return np.interp(self._instants, self.stamps, values)

    def held(self, values: RealArray) -> RealArray:
        """Return inputs (T,), means over the steps of the grid, from those of the rows (R,).

        Each row's input is held from its stamp to the next, the last one to the end of the grid: a mean over
        a step pushes a machine as far as what was held in it. numpy raises ValueError for another length than
        R.
        """
        instants = self._instants
        edges = np.append(instants, instants[-1] + self.dt_s)
        # A stamp beyond the grid, up to which the last input is held.
        end_s = max(self.stamps[-1], edges[-1]) + self.dt_s
        stamps = np.append(self.stamps, end_s)
        # Integral of the input up to each stamp; its differences over the steps are the means.
        integral = np.concatenate([[0.0], np.cumsum(values * np.diff(stamps))])
        integral_at_edges = np.interp(edges, stamps, integral)
        return np.asarray(np.diff(integral_at_edges) / self.dt_s, dtype=np.float64)
