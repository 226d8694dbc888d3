"""Named columns of one log file, checked where they are asked for; complaints name file, place,
expectation."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ident.data.arrays import RealArray
from ident.data.foreign_files import MOST_COLUMNS, as_numbers, shown
from ident.data.json_columns import columns_in
from ident.data.text_numbers import doubtful_groups, is_number, number
from ident.data.text_tables import Layout
from ident.data.time_stamps import StampError, is_stamp, may_be_minutes, seconds_since_first
from ident.data.units import COUNTED, SIGNAL_WORDS, TimeColumn, kind_of, says_counts, size_of, written_unit
from ident.data.wrapping import timer_period

# Sums of squares of larger samples, and products of those with coefficients, leave the range of doubles.
LARGEST = 1e100
_LIST = re.compile(r"(?:array\()?\[[\s\[]*(?:np\.\w+\()?[-+.\d]")
# Larger stamps, as those since 1970, lose digits where they are divided by a unit.
_LONG_STAMP = 1e9


@dataclass(frozen=True, eq=False)
class Table:
    """Named columns of one file.

    raw: by name, an array, or text cells (a tuple of str) as `layout` says. A matrix (T, C) is offered as C
    columns name[0], name[1], ... first_line: file line of row 0, None where rows have no lines (npz, mat).
    units: by name, where the file states them apart from the names. begin, run: row of the file at which a
    run of it begins, and what it is called. parsed: columns of text that were read as numbers, by name.
    """

    path: Path
    raw: Mapping[str, Any]
    first_line: int | None = None
    layout: Layout | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    clocks: Mapping[str, RealArray] = field(default_factory=dict)
    begin: int = 0
    run: str = ""
    parsed: dict[str, RealArray] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        columns: dict[str, Any] = {}
        for name, values in self.raw.items():
            columns |= _split(name, values)
        if len(columns) > MOST_COLUMNS:
            raise ValueError(f"{self.path}: {len(columns)} columns; expected at most {MOST_COLUMNS}")
        object.__setattr__(self, "raw", columns)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.raw)

    def place(self, row: int, name: str | None = None) -> str:
        if self.first_line is None:
            return f"index {row + self.begin}"
        if name is not None and name in self.clocks:
            row = int(self.clocks[name][row])
        row += self.begin
        return f"line {self.layout.line(row) if self.layout else row + self.first_line}"

    def runs(self, time: str | None) -> list[Table]:
        """The parts of a table in which time starts again where another column changes, and only there: its
        number or name of the run; else the table alone."""
        if time is None or self.clocks or time not in self.raw:
            return [self]
        try:
            falls = np.flatnonzero(np.diff(self.columns([time])[time]) < 0) + 1
        except ValueError:  # who takes the stamps is told what is wrong with them
            return [self]
        size = np.shape(self.raw[time]) if falls.size else ()
        alike = (
            [name for name, values in self.raw.items() if np.shape(values)[:1] == size] if falls.size else []
        )
        columns, ends = {name: np.asarray(self.raw[name]) for name in alike}, [0, *falls.tolist(), *size]
        changes = {name: np.flatnonzero(values[1:] != values[:-1]) + 1 for name, values in columns.items()}
        of = next((name for name, rows in changes.items() if np.array_equal(rows, falls)), None)
        if of is None or min(np.diff(ends)) < 2:
            return [self]
        return [
            replace(
                self,
                raw={**self.raw, **{name: self.raw[name][start:stop] for name in alike}},
                begin=start,
                run=f"{of} {columns[of][start]}",
            )
            for start, stop in pairwise(ends)
        ]

    @property
    def sparse(self) -> bool:
        """Whether it is a table of text whose columns have rows of their own."""
        return bool(self.clocks) and self.layout is not None

    def with_decimal(self, sign: str | None) -> Table:
        """The same text with this decimal sign, then not asked for. Raises ValueError for another."""
        if sign is None:
            return self
        sign = {"point": ".", "comma": ","}.get(sign, sign)
        if sign not in (".", ","):
            raise ValueError(f"{self.path}: unknown decimal sign '{shown(sign)}'; expected point or comma")
        if self.layout is None:
            raise ValueError(f"{self.path}: a decimal sign is of text; this file holds numbers")
        return replace(self, layout=replace(self.layout, decimal=sign, stated=True))

    def unit(self, name: str) -> str:
        """The unit of a column as the file has it, beside the name or in it; empty if there is none."""
        unit = self.units.get(name, "") or written_unit(name)
        return SIGNAL_WORDS.get(unit.lower(), unit)

    def contradiction(self, name: str) -> str:
        """The two units of a signal whose name says another one than the file does beside it, else empty."""
        beside, written = self.units.get(name, ""), written_unit(name)
        both = size_of(beside), size_of(written)
        return f"{written} and {beside}" if all(both) and both[0] != both[1] else ""

    def columns(self, wanted: Sequence[str], rows_of: str | None = None) -> dict[str, RealArray]:
        """The wanted columns as equally long finite vectors; dates and clock times in seconds. With clocks,
        on the rows of the first, or of `rows_of`: the others hold what came last, from where all have come.

        Raises ValueError if one is missing (lists those there are), not numeric, not finite or of another
        length.
        """
        for name in wanted:
            if name not in self.raw:
                there = "several" if self._alike(name) else "no"
                columns = f"{there} column{'s' if there == 'several' else ''} '{shown(name)}'"
                raise ValueError(f"{self.path}: {columns}; the file has {self.listed(name)}")
        found = {name: self._numbers(name) for name in dict.fromkeys(wanted)}
        if self.clocks:
            base = self.clocks[rows_of or next(iter(found))]
            rows = base[base >= max(self.clocks[name][0] for name in found)]
            held = {name: np.searchsorted(self.clocks[name], rows, side="right") - 1 for name in found}
            found = {name: values[held[name]] for name, values in found.items()}
        sizes = {name: column.size for name, column in found.items()}
        if len(set(sizes.values())) > 1:
            raise ValueError(
                f"{self.path}: columns must be equally long; got {shown(str(sizes), 160)}: cut them to the "
                "samples of one time"
            )
        return found

    def _alike(self, wanted: str) -> list[str]:
        """Columns of one name, as `distinct` tells them apart."""
        return [name for name in self.names if wanted and re.fullmatch(rf"#\d+ {re.escape(wanted)}", name)]

    def listed(self, wanted: str = "") -> str:
        """Names in a line: all, or the columns of a matrix or struct that was asked for by its own name."""
        parts = [name for name in self.names if wanted and name.startswith((f"{wanted}[", f"{wanted}."))]
        items = self._alike(wanted) or parts or list(self.names)
        more = f", ... ({len(items)} in all)" if len(items) > 20 else ""
        hint = (
            " (numbers?); expected column names in line 1" if self.layout and not self.layout.header else ""
        )
        return shown(f"{', '.join(map(shown, items[:20])) or 'no columns'}{more}", 160) + hint

    def is_clock(self, name: str) -> bool:
        """Whether a column holds dates or clock times, which need no unit."""
        values = self.raw[name]
        if isinstance(values, tuple):
            return is_stamp(next((cell for cell in values if cell), ""))
        return getattr(values, "dtype", np.dtype(float)).kind in "Mm"

    def _numbers(self, name: str) -> RealArray:
        column = self.raw[name]
        if isinstance(column, tuple):
            return self._finite(name, self._parsed(name, column), column)
        try:
            values = as_numbers(column)
        except ValueError as error:
            raise ValueError(f"{self.path}: column '{shown(name)}' {error}") from None
        if values.ndim != 1:
            raise ValueError(
                f"{self.path}: column '{shown(name)}' has shape {values.shape}; expected a vector"
            )
        if values.dtype.kind in "Mm":
            if np.isnat(values).any():
                row = int(np.argmax(np.isnat(values)))
                raise ValueError(f"{self.path}, {self.place(row, name)}: column '{shown(name)}' is empty")
            values = (values - values[:1]) / np.timedelta64(1, "ns") / 1e9
        return self._finite(name, values.astype(np.float64), values)

    def _parsed(self, name: str, cells: tuple[str, ...]) -> RealArray:
        """Text as numbers; NaN for what is none."""
        if name in self.parsed:
            return self.parsed[name].copy()
        decimal = self.layout.decimal if self.layout else "."
        try:
            if self.is_clock(name):
                return seconds_since_first(cells)
        except StampError as error:
            what = f"{self.path}, {self.place(error.row, name)}: column '{shown(name)}' {error}"
            raise ValueError(what) from None
        self._refuse_doubtful_groups(name, cells)

        # Python reads most columns as they stand, and faster. It takes _ for a separator of digits; with a
        # decimal comma a point is no decimal sign.
        text = "\n".join(cells)
        numbers = None
        if "_" not in text and not (decimal == "," and "." in text):
            with suppress(ValueError):
                plain = text.replace(",", ".").split("\n") if decimal == "," else cells
                numbers = np.array(list(map(float, plain)))
        if numbers is None:
            numbers = np.array(
                [number(cell, decimal) if is_number(cell, decimal) else np.nan for cell in cells]
            )
        self.parsed[name] = numbers
        return numbers.copy()

    def _refuse_doubtful_groups(self, name: str, cells: tuple[str, ...]) -> None:
        """Raise ValueError where '1.500' in a column may be one and a half, or fifteen hundred."""
        if self.layout is None or self.layout.stated:
            return
        # Between commas a point is a decimal sign, but in a column of counts, which are whole.
        counted = says_counts(name) or kind_of(self.unit(name)) in COUNTED - {"%"}
        proven = self.layout.plain or (self.layout.separator == "," and not counted)
        row = doubtful_groups(cells, self.layout.decimal, proven=proven)
        if row is not None:
            sign = "," if "," in cells[row] else "."
            raise ValueError(
                f"{self.path}, {self.place(row, name)}: column '{shown(name, 40)}' is "
                f"'{shown(cells[row], 20)}': does the '{sign}' separate decimals or thousands? "
                "State the decimal sign: --decimal point, or --decimal comma"
            )

    def _finite(self, name: str, numbers: RealArray, cells: Any) -> RealArray:
        """The numbers if all are finite; else a complaint that quotes the first that is not."""
        bad = np.flatnonzero(~(np.abs(numbers) <= LARGEST))
        if not bad.size:
            return numbers
        row = int(bad[0])
        found = str(cells[row])
        if isinstance(cells, tuple):
            found = f"'{shown(found, 40)}'" if found else "empty"
            if row and not any(cells[row:]):
                raise ValueError(
                    f"{self.path}: column '{shown(name)}' ends at {self.place(row - 1, name)}, others at "
                    f"{self.place(len(cells) - 1, name)}; expected equal lengths: cut the rows behind it"
                )
        sign = " with a decimal comma" if self.layout and self.layout.decimal == "," else ""
        remedy = ""
        if isinstance(cells, tuple) and str(cells[row]).startswith("="):
            raise ValueError(
                f"{self.path}, {self.place(row, name)}: column '{shown(name)}' is {found}, a formula without "
                "its value; open the file in Excel or LibreOffice and save it again, or write values"
            )
        if 2 * bad.size < numbers.size and not np.isfinite(numbers[row]):  # else it is no column of numbers
            remedy = (
                f"; delete such rows ({bad.size} here): with a time column, flexlink init fills the gap that "
                "this leaves, other commands with --repair"
            )
        raise ValueError(
            f"{self.path}, {self.place(row, name)}: column '{shown(name)}' is {found}; "
            f"expected a finite number{sign}{' up to 1e100' if np.isfinite(numbers[row]) else ''}"
            f"{remedy}"
        )

    def seconds(self, name: str, stamps: RealArray, unit: str | None) -> tuple[RealArray, TimeColumn]:
        """Time stamps in seconds, and what was taken for which. Raises ValueError for an unknown unit."""
        if self.is_clock(name):
            return self._clock_seconds(name, stamps, unit)
        # A timer that starts again goes on, so that a long log is one.
        period = timer_period(stamps)
        wraps = int(np.sum(np.diff(stamps) < 0)) if period else 0
        if period:
            stamps = stamps + period * np.concatenate([[0], np.cumsum(np.diff(stamps) < 0)])
        try:
            column = TimeColumn.of(name, unit, self.units.get(name, ""))
            column.refuse_stamps(stamps)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from None
        doubtful = column.doubtful_for(stamps)
        passed = stamps - stamps[0] if period else self._since_first(name, stamps)
        return column.seconds(passed), replace(column, doubtful=doubtful, wraps_at=period, wraps=wraps)

    def _clock_seconds(self, name: str, stamps: RealArray, unit: str | None) -> tuple[RealArray, TimeColumn]:
        cells = self.raw[name]
        doubt = isinstance(cells, tuple) and may_be_minutes(cells)
        if doubt and unit is None:
            raise ValueError(
                f"{self.path}: time '{shown(name, 40)}' like '{shown(cells[0], 20)}' may be hours:minutes or "
                "minutes:seconds; state what comes first: --time-unit h, or --time-unit min"
            )
        if unit is not None and not (doubt and unit in ("h", "min")):
            raise ValueError(f"{self.path}: '{shown(name)}' holds clock times; they have no unit")
        return (stamps / 60 if unit == "min" else stamps), TimeColumn(name, "s", "s", stated=True)

    def _since_first(self, name: str, stamps: RealArray) -> RealArray:
        """Stamps; of integers and text with more digits than doubles keep what passed since the first."""
        values = self.raw[name]
        if not stamps.size or abs(stamps[0]) < _LONG_STAMP:
            return stamps
        if self.clocks:
            return np.asarray(stamps - stamps[0])
        if isinstance(values, tuple):
            decimal = self.layout.decimal if self.layout else "."
            try:
                exact = [Decimal(cell.replace(decimal, ".")) for cell in values]
                return np.array([float(value - exact[0]) for value in exact])
            except InvalidOperation:
                return np.asarray(stamps - stamps[0])
        if getattr(values, "dtype", np.dtype(float)).kind not in "iu":
            return np.asarray(stamps - stamps[0])
        # The difference of unsigned integers, taken as signed ones, is right whichever is larger.
        return np.asarray((values - values[0]).astype(np.int64), dtype=np.float64)

    def stamps(self, name: str, rows_of: str | None, unit: str | None) -> tuple[RealArray, TimeColumn]:
        """Time stamps [s] that increase, of a column; rows_of: whose rows count where columns have rows of
        their own. Raises ValueError."""
        columns = self.columns([name] if rows_of is None else [name, rows_of], rows_of)
        stamps, column = self.seconds(name, columns[name], unit)
        self.increasing(stamps, name)
        return stamps, column

    def increasing(self, stamps: RealArray, name: str | None) -> None:
        """Raises ValueError unless there are two time stamps at least, each later than the one before."""
        if stamps.size < 2:
            raise ValueError(
                f"{self.path}: a single row of numbers; expected at least 2 to find the sampling time"
            )
        backwards = np.flatnonzero(~(np.diff(stamps) > 0))
        if backwards.size:
            row = int(backwards[0]) + 1
            what = "split the file there, or number its runs in a column"
            if stamps[row] == stamps[row - 1]:
                what = "take the repeated row out"
            elif backwards.size == 1 and 1 < row < stamps.size - 1 and stamps[row - 2] < stamps[row]:
                what = "delete the row before, which has no time, and give --repair"
            elif backwards.size == 1 and row < stamps.size - 1 and stamps[row - 1] < stamps[row + 1]:
                what = "delete this row, which has no time, and give --repair"
            raise ValueError(
                f"{self.path}, {self.place(row)}: time '{name}' goes from {stamps[row - 1]:.9g} to "
                f"{stamps[row]:.9g} s; expected increasing time ({what})"
            )


def _split(name: str, values: Any) -> dict[str, Any]:
    """A matrix (T, C), or (C, T) as of Simulink, as C columns; (T, 1), (1, T) as vectors; records by
    field; lists in cells of text, '[0.1, 0.2]', as `columns_in`."""
    if isinstance(values, tuple) and values and _LIST.match(values[0]):
        plain = (re.sub(r"np\.\w+|array", "", cell) for cell in values)
        return columns_in(name, [re.findall(r"[^][()\s,;]+", cell) or None for cell in plain])
    if isinstance(values, np.ndarray) and values.dtype.names and values.ndim == 1:
        return {f"{name}.{field}": values[field] for field in values.dtype.names}
    if not isinstance(values, np.ndarray) or values.ndim != 2:
        return {name: values}
    if 1 in values.shape or values.size == 0:
        return {name: values.ravel()}
    if min(values.shape) > MOST_COLUMNS:
        return {name: values}
    columns = values if values.shape[0] >= values.shape[1] else values.T
    return {f"{name}[{k}]": column for k, column in enumerate(columns.T)}
