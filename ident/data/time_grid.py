"""The uniform grid under a log's time stamps: its step, or why there is none (`sampling_time`); stamps that
stray a little and single lost rows made good (`TimeGrid`), or a coarser grid (`CoarseGrid`) on request."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from ident.data.arrays import IntArray, RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.table import Table

# Of an interval from the mean one: at the Nyquist frequency a phase wrong by 0.03 rad; above a clock's
# jitter.
TIME_TOLERANCE = 0.01
# Stamps this far off a multiple (in samples) are no jitter that an interpolation makes good.
LARGEST_JITTER = 0.2
# Below this they count as on it: an output changes by a thousandth of its step from row to row.
_ON_GRID = 1e-3
_MOST_LOST_ROWS = 5  # a spline over such a gap is right to 1 % up to a twentieth of the Nyquist frequency
_MOST_LOST_SHARE = 0.05  # ellipses come out too narrow by 2.6 % at most: 1 / sqrt(0.95)

# Angular frequency times spacing at which a cubic spline is wrong by 1 % of a sine: 5/384 (omega h)^4.
_FAITHFUL = (0.01 * 384 / 5) ** 0.25
# The same of a straight line between readings, (omega h)^2 / 8, and of an input that is averaged over a step
# and held for the next: 1 - sinc(omega h / 2)^2 = (omega h)^2 / 12.
_FAITHFUL_LINE = (0.01 * 8) ** 0.5
_FAITHFUL_MEAN = (0.01 * 12) ** 0.5  # of 1 - sinc^2, see above
# In so many parts of a log the mean step is compared with that of the whole.
_PARTS = 10
# A coarser grid that is proposed has about as many readings in each of its steps.
_READINGS = 3


def sampling_time(table: Table, stamps: RealArray | None, name: str | None, dt_s: float | None) -> float:
    """dt in seconds from time stamps [s] (mean interval), or the given one; both must agree. Raises
    ValueError if neither is given, dt_s is not positive, or the stamps are not increasing and uniform to
    `TIME_TOLERANCE`, rounding aside."""
    if dt_s is not None and not (np.isfinite(dt_s) and dt_s > 0):
        raise ValueError(f"{table.path}: dt_s must be a positive number of seconds; got {dt_s}")
    if stamps is None:
        if dt_s is None:
            raise ValueError(
                f"{table.path}: give the time column or dt_s (--time NAME or --dt-s SECONDS); the file has "
                f"{table.listed()}"
            )
        return float(dt_s)
    table.increasing(stamps, name)
    interval = np.diff(stamps)
    # The median holds where samples are lost; the mean is the better estimate after.
    median = float(np.median(interval))
    uneven = np.flatnonzero(~(np.abs(interval - median) <= TIME_TOLERANCE * median))
    if uneven.size and not only_rounded(stamps):
        row, lost = int(uneven[0]), _counts(interval) - 1
        if (stray := jitter_of(stamps)) > LARGEST_JITTER:
            what = f"the stamps keep to no grid, steps are {np.min(interval):.4g} to {np.max(interval):.4g} s"
        elif np.any(lost > 0):
            row = int(np.argmax(lost > 0))
            missing = int(np.sum(np.maximum(lost, 0)))
            what = f"rows missing: {missing} of {stamps.size + missing}"
        else:
            what = f"no row is missing, the clock jitters by up to {stray:.1%} of a step"
        raise ValueError(
            f"{table.path}, {table.place(row + 1)}: time '{name}' steps by {interval[row]:.6g} s where most "
            f"steps are {median:.6g} s; expected uniform sampling (each step within {TIME_TOLERANCE:.0%}); "
            f"{what}: {_advice(stamps)}"
        )
    mean = float((stamps[-1] - stamps[0]) / interval.size)
    if dt_s is None:
        # Rounding noise of decimal stamps: 0.0020000000000000005 is 0.002.
        return float(f"{mean:.12g}")
    if not abs(dt_s - mean) <= TIME_TOLERANCE * mean:
        raise ValueError(
            f"{table.path}: dt_s = {dt_s:.6g} s, but the time column '{name}' steps by {mean:.6g} s"
        )
    return float(dt_s)


def only_rounded(stamps: RealArray) -> bool:
    """Whether stamps (T,) [s] are a uniform clock's, rounded: 0.008, 0.016, 0.023 for steps of 1/128 s."""
    since = stamps - stamps[0]
    digit = next((10.0**-k for k in range(10) if np.allclose(since, np.round(since, k), 0, 1e-10)), 0.0)
    uniform = np.polyval(np.polyfit(np.arange(since.size), since, 1), np.arange(since.size))
    # A line through rounded stamps is itself off by part of the digit.
    return bool(
        0 < digit <= 0.5 * np.median(np.diff(stamps)) and np.max(np.abs(since - uniform)) <= 0.75 * digit
    )


def clock_doubts(stamps: RealArray, record: str) -> tuple[Finding, ...]:
    """The finding on uniform stamps (T,) [s] whose small deviations add up: no frequency is better known."""
    interval = np.diff(stamps)
    if interval.size < 2 * _PARTS or only_rounded(stamps):
        return ()
    stray = float(np.max(np.abs(_fitted(stamps)[1])))
    if stray <= LARGEST_JITTER:
        return ()
    mean = float(np.mean(interval))
    share = max(abs(float(np.mean(part)) / mean - 1) for part in np.array_split(interval, _PARTS))
    coarse = _coarser(interval)
    return (finding(FindingKind.CLOCK_DRIFTS, record=record, samples=stray, share=share, dt_s=coarse),)


def jitter_of(stamps: RealArray) -> float:
    """Largest distance of a step from a whole number of usual ones, as a share of one."""
    interval = np.diff(stamps)
    step = float(np.median(interval))
    return float(np.max(np.abs(interval / step - np.maximum(np.rint(interval / step), 1))))


def option_for(stamps: RealArray) -> str:
    """The option that takes increasing stamps (T,) [s]: '', '--repair', '--resample-s SECONDS', or
    'split'."""
    interval = np.diff(stamps)
    median = float(np.median(interval))
    if np.max(np.abs(interval - median)) <= TIME_TOLERANCE * median or only_rounded(stamps):
        return ""
    if np.max(interval) > (_MOST_LOST_ROWS + 1.5) * median:
        return "split"
    rows, late, _ = _fitted(stamps)
    close = np.all(np.diff(rows) > 0) and np.max(np.abs(late)) <= LARGEST_JITTER
    if close and stamps.size >= (1 - _MOST_LOST_SHARE) * (rows[-1] + 1):
        return "--repair"
    return f"--resample-s {_coarser(interval):g}"


def _advice(stamps: RealArray, options: bool = True) -> str:
    found = option_for(stamps)
    if found == "split":
        return "split the file there"
    if not options:
        return "resample it to a uniform step"
    name, _, number = found.removeprefix("--").partition(" ")
    return f"{found} ({name.replace('-', '_')} = {number or 'true'})"


def _coarser(interval: RealArray) -> float:
    """A step of 1, 2, 3 or 5 times a power of ten that takes a few readings and bridges the largest gap."""
    least = max(_READINGS * float(np.median(interval)), float(np.max(interval)) / (_MOST_LOST_ROWS + 1))
    decade = 10.0 ** np.floor(np.log10(least))
    return float(f"{next(m for m in (1, 2, 3, 5, 10) if m * decade >= least) * decade:.6g}")


def _counts(interval: RealArray) -> IntArray:
    return np.rint(interval / np.median(interval)).astype(np.int64)


def _fitted(stamps: RealArray) -> tuple[IntArray, RealArray, float]:
    """The sample each stamp is, how far it is from it (in samples), and the step, by least squares."""
    rows = np.concatenate([[0], np.cumsum(_counts(np.diff(stamps)))])
    slope, start = np.polyfit(rows, stamps - stamps[0], 1)
    return rows, (stamps - stamps[0] - start) / slope - rows, float(slope)


@dataclass(frozen=True)
class Repair:
    """What was done to the rows of a log to have them on a uniform grid: missing of samples rows were filled
    in; jitter: largest distance of a stamp from its instant, in samples.

    Of a coarser grid: own_s, the usual step of the log itself [s], of which jitter is then (0 on the log's
    own grid); largest_s: the largest step not longer than one of the grid.
    """

    samples: int
    missing: int
    jitter: float
    own_s: float = 0.0
    largest_s: float = 0.0

    def finding(self, record: str, dt_s: float) -> Finding:
        """too_narrow: share by which ellipses shrink if every filled row counts as one more measurement;
        above faithful_rad_s what stands between the readings is wrong by more than 1 % of the motion."""
        told = {
            "record": record,
            "samples": self.samples,
            "missing": self.missing,
            "jitter": self.jitter,
            "too_narrow": (self.samples / max(self.samples - self.missing, 1)) ** 0.5 - 1,
        }
        if self.own_s:
            faithful = min(_FAITHFUL_LINE / self.largest_s, _FAITHFUL_MEAN / dt_s)
            coarse = {"dt_s": dt_s, "own_s": self.own_s, "faithful_rad_s": faithful}
            return finding(FindingKind.RESAMPLED, **told, **coarse)
        return finding(
            FindingKind.REPAIRED, **told, faithful_rad_s=_FAITHFUL / ((1 + 2 * self.jitter) * dt_s)
        )


@dataclass(frozen=True, eq=False)
class TimeGrid:
    """Rows of a log on multiples of the sampling period dt_s (least squares over all stamps). rows (R,): the
    sample each row is, increasing from 0. late (R,): stamp minus instant of that sample, in samples."""

    dt_s: float
    rows: IntArray
    late: RealArray

    @classmethod
    def of(cls, table: Table, name: str, stamps: RealArray, *, options: bool = True) -> TimeGrid:
        """The grid under the stamps (R,) [s] of the column `name`; its phase is their mean. options: whether
        who reads the complaint can give --repair and --resample-s. Raises ValueError, one line with file and
        row: time that does not increase, too many rows lost, a stamp too far off the grid."""
        table.increasing(stamps, name)
        interval = np.diff(stamps)
        step, counts = float(np.median(interval)), _counts(interval)
        if np.any(counts > _MOST_LOST_ROWS + 1):
            row = int(np.argmax(counts > _MOST_LOST_ROWS + 1))
            raise ValueError(
                f"{table.path}, {table.place(row + 1)}: time '{name}' steps by {interval[row]:.6g} s where "
                f"most steps are {step:.6g} s; at most {_MOST_LOST_ROWS} rows may be missing at a place: "
                "split the file"
            )
        rows, late, slope = _fitted(stamps)
        if np.any(counts == 0) or np.max(np.abs(late)) > LARGEST_JITTER:
            row = int(np.argmax(np.abs(late)))
            raise ValueError(
                f"{table.path}, {table.place(row)}: time '{name}' is {abs(late[row]):.2f} of a step of "
                f"{step:.6g} s off a uniform grid (steps: {np.min(interval):.4g} to {np.max(interval):.4g} "
                f"s; their deviations add up); --repair takes {LARGEST_JITTER:g}: {_advice(stamps, options)}"
            )
        if len(stamps) < (1 - _MOST_LOST_SHARE) * (rows[-1] + 1):
            raise ValueError(
                f"{table.path}: {rows[-1] + 1 - len(rows)} of {rows[-1] + 1} rows are missing by the time "
                f"column '{name}'; expected at most {_MOST_LOST_SHARE:.0%}: {_advice(stamps, options)}"
            )
        on_grid = np.max(np.abs(late)) <= _ON_GRID
        # Rounding noise of decimal stamps: 0.0020000000000000005 is 0.002.
        return cls(float(f"{slope:.12g}"), rows, np.zeros(len(rows)) if on_grid else late)

    @property
    def n_samples(self) -> int:
        return int(self.rows[-1]) + 1

    @property
    def repair(self) -> Repair | None:
        """What `sampled` changes; None where the log is on the grid as it is."""
        jitter = float(np.max(np.abs(self.late)))
        return Repair(int(self.rows[-1]) + 1, len(self.missing), jitter) if self.missing or jitter else None

    @property
    def missing(self) -> tuple[int, ...]:
        """Samples that the log lacks."""
        return tuple(int(k) for k in np.setdiff1d(np.arange(self.rows[-1] + 1), self.rows))

    def sampled(self, values: RealArray) -> RealArray:
        """Outputs (R, Y) read at the stamps -> (T, Y) at the grid's instants, by a cubic spline. Neglected:
        the fourth derivative over a sample; noise of the readings next to a missing row."""
        from scipy.interpolate import CubicSpline  # here: a log that is refused never waits for it

        grid = np.arange(self.rows[-1] + 1)
        if len(grid) == len(values) and not self.late.any():
            return values
        filled = np.asarray(CubicSpline(self.rows + self.late, values)(grid))
        if not self.late.any():
            filled[self.rows] = values
        return filled

    def held(self, values: RealArray) -> RealArray:
        """Inputs (R,), each held from its grid instant on -> (T,); half-way between neighbours of a missing
        row."""
        return np.interp(np.arange(self.rows[-1] + 1), self.rows, values)


@dataclass(frozen=True, eq=False)
class CoarseGrid:
    """Rows of a log with stamps (R,) [s], increasing, on a coarser grid of step dt_s from the first row
    on."""

    stamps: RealArray
    dt_s: float

    @classmethod
    def of(cls, table: Table, name: str, stamps: RealArray, dt_s: float) -> Self:
        """Raises ValueError: time that does not increase, a step that does not fit, five steps without a
        reading."""
        table.increasing(stamps, name)
        interval = np.diff(stamps)
        own, span, row = float(np.median(interval)), float(stamps[-1] - stamps[0]), int(np.argmax(interval))
        if not (1 - TIME_TOLERANCE) * own <= dt_s <= span:
            raise ValueError(
                f"{table.path}: resample_s = {dt_s:.6g} s; expected {own:.6g} s, the usual step of '{name}', "
                f"to {span:.6g} s; try --resample-s {min(_coarser(interval), span):g}"
            )
        if interval[row] > (_MOST_LOST_ROWS + 1) * max(dt_s, own * (1 + TIME_TOLERANCE)):
            raise ValueError(
                f"{table.path}, {table.place(row + 1)}: time '{name}' steps by {interval[row]:.6g} s; at "
                f"most {_MOST_LOST_ROWS} steps of the grid (resample_s = {dt_s:.6g} s) may be without a "
                "reading: split the file there"
            )
        return cls(stamps - stamps[0], dt_s)

    @property
    def _instants(self) -> RealArray:
        # Rounding of the stamps must not cost the last one.
        count = int(np.floor(self.stamps[-1] / self.dt_s + 1e-6)) + 1
        return np.asarray(self.dt_s * np.arange(count), dtype=np.float64)

    @property
    def n_samples(self) -> int:
        return int(self._instants.size)

    @property
    def repair(self) -> Repair:
        interval, instants = np.diff(self.stamps), self._instants
        edges = np.append(instants - self.dt_s / 2, instants[-1] + self.dt_s / 2)
        empty = int(np.sum(np.histogram(self.stamps, edges)[0] == 0))
        own = float(np.median(interval))
        near = interval[interval <= max(self.dt_s, own)]
        return Repair(instants.size, empty, jitter_of(self.stamps), own, float(np.max(near)))

    def sampled(self, values: RealArray) -> RealArray:
        """Outputs (R,) -> (T,) on straight lines between the readings, which never make noise larger."""
        return np.interp(self._instants, self.stamps, values)

    def held(self, values: RealArray) -> RealArray:
        """Inputs (R,), each held from its stamp to the next -> (T,) means over the steps: the same push."""
        edges = np.append(self._instants, self._instants[-1] + self.dt_s)
        stamps = np.append(self.stamps, max(self.stamps[-1], edges[-1]) + self.dt_s)
        pushed = np.concatenate([[0.0], np.cumsum(values * np.diff(stamps))])
        return np.asarray(np.diff(np.interp(edges, stamps, pushed)) / self.dt_s, dtype=np.float64)
