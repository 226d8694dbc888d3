"""Time stamps that jitter about a uniform grid, or leave rows out: outputs are put on the grid.

Identification asks for uniform rows (`Table.sampling_time`). Where the sampling period is known and the input
switches on its multiples, stamps that stray a little, and single rows that a log lost, can be made good.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.data.arrays import IntArray, RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.table import Table

# Stamps this far off a multiple (in samples) are no jitter that an interpolation makes good.
_LARGEST_JITTER = 0.2
# Below this they count as on it: an output changes by a thousandth of its step from row to row.
_ON_GRID = 1e-3
_MOST_LOST_ROWS = 5
_MOST_LOST_SHARE = 0.05


# Angular frequency times spacing at which a cubic spline is wrong by 1 % of a sine: 5/384 (omega h)^4.
_FAITHFUL = (0.01 * 384 / 5) ** 0.25


@dataclass(frozen=True)
class Repair:
    """What was done to the rows of a log to have them on a uniform grid.

    missing of samples rows were filled in; jitter: largest distance of a stamp from its instant, in samples.
    """

    samples: int
    missing: int
    jitter: float

    def finding(self, record: str, dt_s: float) -> Finding:
        """too_narrow: share by which ellipses shrink if every filled row counts as one more measurement;
        above faithful_rad_s the spline is wrong by more than 1 % of the motion."""
        return finding(
            FindingKind.REPAIRED,
            record=record,
            samples=self.samples,
            missing=self.missing,
            jitter=self.jitter,
            too_narrow=(self.samples / (self.samples - self.missing)) ** 0.5 - 1,
            faithful_rad_s=_FAITHFUL / ((1 + 2 * self.jitter) * dt_s),
        )


@dataclass(frozen=True, eq=False)
class TimeGrid:
    """Rows of a log on multiples of the sampling period.

    dt_s : float. Sampling period, by least squares over all stamps.
    rows : (R,) integers, increasing from 0: the sample each row of the log is.
    late : (R,). Stamp minus instant of that sample, in samples; 0 where all are on the grid.
    """

    dt_s: float
    rows: IntArray
    late: RealArray

    @classmethod
    def uniform(cls, n_rows: int, dt_s: float) -> TimeGrid:
        """A log without time stamps."""
        return cls(dt_s, np.arange(n_rows), np.zeros(n_rows))

    @classmethod
    def of(cls, table: Table, name: str, stamps: RealArray) -> TimeGrid:
        """The grid under the stamps (R,) [s] of the column `name`; its phase is their mean.

        Raises ValueError, one line with file and row: time that does not increase, more than five rows lost
        at a place or one in twenty of all, a stamp further off the grid than a fifth of a sample.
        """
        table.increasing(stamps, name)
        interval = np.diff(stamps)
        step = float(np.median(interval))
        counts = np.rint(interval / step).astype(np.int64)
        where = f"time '{name}' steps by"
        if np.any(counts > _MOST_LOST_ROWS + 1):
            row = int(np.argmax(counts > _MOST_LOST_ROWS + 1))
            raise ValueError(
                f"{table.path}, {table.place(row + 1)}: {where} {interval[row]:.6g} s where most steps are "
                f"{step:.6g} s; at most {_MOST_LOST_ROWS} rows may be missing at a place: split the file"
            )
        rows = np.concatenate([[0], np.cumsum(counts)])
        slope, start = np.polyfit(rows, stamps - stamps[0], 1)
        late = (stamps - stamps[0] - start) / slope - rows
        if np.any(counts == 0) or np.max(np.abs(late)) > _LARGEST_JITTER:
            row = int(np.argmin(counts)) if np.any(counts == 0) else max(int(np.argmax(np.abs(late))) - 1, 0)
            raise ValueError(
                f"{table.path}, {table.place(row + 1)}: {where} {interval[row]:.6g} s where most steps are "
                f"{step:.6g} s; expected stamps within {_LARGEST_JITTER:.0%} of a step of a uniform grid"
            )
        if len(stamps) < (1 - _MOST_LOST_SHARE) * (rows[-1] + 1):
            raise ValueError(
                f"{table.path}: {rows[-1] + 1 - len(rows)} of {rows[-1] + 1} rows are missing by the time "
                f"column '{name}'; expected at most {_MOST_LOST_SHARE:.0%}"
            )
        on_grid = np.max(np.abs(late)) <= _ON_GRID
        # Rounding noise of decimal stamps: 0.0020000000000000005 is 0.002.
        return cls(float(f"{slope:.12g}"), rows, np.zeros(len(rows)) if on_grid else late)

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
        """Outputs (R, Y) read at the stamps -> (T, Y) at the grid's instants.

        A cubic spline through the readings: neglected are the fourth derivative over a sample, and that the
        noise of the readings next to a missing row goes into it. Readings that are on the grid stay as they
        are.
        """
        from scipy.interpolate import CubicSpline  # here: a log that is refused never waits for it

        grid = np.arange(self.rows[-1] + 1)
        if len(grid) == len(values) and not self.late.any():
            return values
        filled = np.asarray(CubicSpline(self.rows + self.late, values)(grid))
        if not self.late.any():
            filled[self.rows] = values
        return filled

    def held(self, values: RealArray) -> RealArray:
        """Inputs (R,), each held from its grid instant on -> (T,); half-way between their neighbours where
        a row is missing, which is wrong by no more than half of what the input changes there."""
        return np.interp(np.arange(self.rows[-1] + 1), self.rows, values)
