"""Named columns of one log file, checked where they are asked for; complaints name file, place, expectation.

A `Table` is what every reader of files makes: the columns as the file has them, text or arrays, and what is
known of their lines and units. Nothing is converted before it is asked for, so that a column that nobody
needs may hold anything. `Table.columns` gives equally long vectors of finite numbers, `Table.stamps` times
that increase, in seconds; a cell that cannot be taken is quoted with its line. Where nobody can tell what a
cell means, as of '1.500', the user is asked.

A number in `shown(text, 40)` is how many characters of a name or cell a complaint quotes: enough to find it
in the file, few enough that the complaint stays below 300 characters. It decides nothing.
"""

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

# Largest size of a sample: sums of squares of larger ones, and products of those with coefficients, leave the
# range of doubles (1e308).
LARGEST = 1e100
# A list in a cell of text, as Python and numpy print it: '[0.1, 0.2]', 'array([0.1, ...'.
_LIST = re.compile(r"(?:array\()?\[[\s\[]*(?:np\.\w+\()?[-+.\d]")
_NUMPY_WORDS = re.compile(r"np\.\w+|array")
_LIST_ENTRY = re.compile(r"[^][()\s,;]+")
# Size of a stamp, in any unit, from which on what passed since the first is taken before the stamp is divided
# by its unit: doubles hold a second since 1970 (above 1e9) to .2 microseconds only. Smaller stamps lose less.
_LONG_STAMP = 1e9
# Names that a complaint lists at most: as many of eight characters as fit into the list below.
_MOST_LISTED = 20
# Characters of such a list: with the rest of the complaint it stays below the 300 of any message.
_LONGEST_LIST = 160


@dataclass(frozen=True, eq=False)
class Table:
    """Named columns of one file.

    Attributes
    ----------
    path : Path
        The file, for complaints.
    raw : mapping
        By name an array (T,), or text cells (a tuple of T str) as `layout` says, or `Unread`. A matrix (T, C)
        is offered as C columns name[0], name[1], ...
    first_line : int or None
        Line of the file (from 1) of row 0; None where rows have no lines (npz, mat).
    layout : Layout or None
        How a table of text is written.
    units : mapping of str to str
        By name, where the file states them apart from the names.
    clocks : mapping of str to ndarray
        By name the times (T,) at which values of a column came, increasing, where columns have rows of their
        own; empty for most files. Of text: the row in the file.
    begin : int
        Row of the file at which this run of it begins.
    run : str
        What the run is called.
    parsed : dict
        Columns of text that were read as numbers, by name: what was asked for before.
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
        """Take matrices and lists apart. Raises ValueError for more than `MOST_COLUMNS` columns."""
        columns: dict[str, Any] = {}
        for name, values in self.raw.items():
            columns |= _split(name, values)
        if len(columns) > MOST_COLUMNS:
            raise ValueError(f"{self.path}: {len(columns)} columns; expected at most {MOST_COLUMNS}")
        object.__setattr__(self, "raw", columns)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, in the order of the file. Empty for a file without columns."""
        return tuple(self.raw)

    def place(self, row: int, name: str | None = None) -> str:
        """Where a row (from 0) of this run stands in the file: 'line 12', or 'index 11' without lines.

        name: the column, where columns may have rows of their own. A row beyond the file is not refused here,
        except with clocks, where the lookup ends in IndexError.
        """
        if self.first_line is None:
            return f"index {row + self.begin}"
        # Of a column with rows of its own the clock is the row in the file.
        if name is not None and name in self.clocks:
            row = int(self.clocks[name][row])
        row_of_file = row + self.begin
        line = self.layout.line(row_of_file) if self.layout else row_of_file + self.first_line
        return f"line {line}"

    def runs(self, time: str | None) -> list[Table]:
        """The runs in a table: its parts, where time starts again and another column says so.

        Nothing is refused: the table alone comes back, too, where there is no such column, its cells are no
        finite times, or columns have rows of their own.

        Parameters
        ----------
        time : str or None
            Column of time.

        Returns
        -------
        list of Table
            The parts between the rows at which time falls, if another column changes there and only there,
            as the number or name of a run does; each two rows long at least. Else the table alone.
        """
        if time is None or self.clocks or time not in self.raw:
            return [self]
        try:
            stamps = self.columns([time])[time]
        except ValueError:  # who takes the stamps is told what is wrong with them
            return [self]
        starts = np.flatnonzero(np.diff(stamps) < 0) + 1
        if not starts.size:
            return [self]

        # The first column, of those as long as time, that changes at the same rows.
        length = np.shape(self.raw[time])
        alike = [name for name, values in self.raw.items() if np.shape(values)[:1] == length]
        columns = {name: np.asarray(self.raw[name]) for name in alike}
        run_name = None
        for name, values in columns.items():
            changes = np.flatnonzero(values[1:] != values[:-1]) + 1
            if np.array_equal(changes, starts):
                run_name = name
                break
        # A run of a single row has no sampling time.
        bounds = [0, *starts.tolist(), *length]
        if run_name is None or min(np.diff(bounds)) < 2:
            return [self]
        runs = list[Table]()
        for start, stop in pairwise(bounds):
            parts = {name: self.raw[name][start:stop] for name in alike}
            run = f"{run_name} {columns[run_name][start]}"
            runs.append(replace(self, raw={**self.raw, **parts}, begin=start, run=run))
        return runs

    @property
    def sparse(self) -> bool:
        """Whether it is a table of text whose columns have rows of their own.

        A bag, whose columns have clocks but no lines of text, is not.
        """
        return bool(self.clocks) and self.layout is not None

    def with_decimal(self, sign: str | None) -> Table:
        """The table with its text read with this decimal sign, which is then not asked for; None: as it is.

        sign: 'point', 'comma', or the sign itself. Raises ValueError for another, or where there is no text.
        """
        if sign is None:
            return self
        sign = {"point": ".", "comma": ","}.get(sign, sign)
        if sign not in (".", ","):
            raise ValueError(f"{self.path}: unknown decimal sign '{shown(sign)}'; expected point or comma")
        if self.layout is None:
            raise ValueError(f"{self.path}: a decimal sign is of text; this file holds numbers")
        return replace(self, layout=replace(self.layout, decimal=sign, stated=True))

    def unit(self, name: str) -> str:
        """The unit of a column as the file has it, beside the name or in it; empty if there is none.

        Of a name that is no column only the name is read. A unit that nobody knows comes back as it is
        written.
        """
        unit = self.units.get(name, "") or written_unit(name)
        return SIGNAL_WORDS.get(unit.lower(), unit)

    def contradiction(self, name: str) -> str:
        """The two units of a signal, 'deg and rad', whose name says another one than the file does beside it.

        Empty where they agree, or one of them is not known.
        """
        beside = self.units.get(name, "")
        written = written_unit(name)
        size_beside = size_of(beside)
        size_written = size_of(written)
        if size_beside is None or size_written is None or size_beside == size_written:
            return ""
        return f"{written} and {beside}"

    def columns(self, wanted: Sequence[str], rows_of: str | None = None) -> dict[str, RealArray]:
        """The wanted columns as equally long vectors of finite numbers, by name.

        Parameters
        ----------
        wanted : sequence of str
            Names; one that is there twice counts once. None give {}, but with clocks StopIteration.
        rows_of : str, optional
            Column whose rows count, where columns have rows of their own (KeyError for one without); default:
            the first wanted one. Ignored in a table without clocks.

        Returns
        -------
        dict of str to ndarray, shape (T,)
            Dates and clock times are in seconds since the first. Where columns have rows of their own, the
            others hold what came last, from the row on at which all have come; without such a row, T = 0.

        Raises
        ------
        ValueError
            A column is missing (the message lists those there are), not numeric, not finite, or of another
            length.
        """
        for name in wanted:
            if name not in self.raw:
                count = "several columns" if self._alike(name) else "no column"
                raise ValueError(f"{self.path}: {count} '{shown(name)}'; the file has {self.listed(name)}")
        columns = {name: self._numbers(name) for name in dict.fromkeys(wanted)}
        # Columns with rows of their own: what each of them held at the times of one.
        if self.clocks:
            base_times = self.clocks[rows_of or next(iter(columns))]
            all_have_come = max(self.clocks[name][0] for name in columns)
            times = base_times[base_times >= all_have_come]
            for name, values in columns.items():
                last_rows = np.searchsorted(self.clocks[name], times, side="right") - 1
                columns[name] = values[last_rows]
        sizes = {name: column.size for name, column in columns.items()}
        if len(set(sizes.values())) > 1:
            raise ValueError(
                f"{self.path}: columns must be equally long; got {shown(str(sizes), _LONGEST_LIST)}: cut "
                "them to the samples of one time"
            )
        return columns

    def _alike(self, wanted: str) -> list[str]:
        """Columns of one name, as `distinct` tells them apart: '#1 angle', '#2 angle'.

        Empty where no column or a single one has the name.
        """
        if not wanted:
            return []
        return [name for name in self.names if re.fullmatch(rf"#\d+ {re.escape(wanted)}", name)]

    def listed(self, wanted: str = "") -> str:
        """Names of columns in a line for a complaint: all, or those that are meant by a name.

        wanted: the name of a matrix or struct, whose columns are listed, or one that several columns have. A
        name that nothing begins with lists all. Names beyond `_MOST_LISTED` are counted, not listed. 'no
        columns' where there is none.
        """
        names = self._alike(wanted)
        if not names and wanted:
            names = [name for name in self.names if name.startswith((f"{wanted}[", f"{wanted}."))]
        if not names:
            names = list(self.names)
        listed = ", ".join(map(shown, names[:_MOST_LISTED])) or "no columns"
        if len(names) > _MOST_LISTED:
            listed += f", ... ({len(names)} in all)"
        hint = ""
        if self.layout and not self.layout.header:
            hint = " (numbers?); expected column names in line 1"
        return shown(listed, _LONGEST_LIST) + hint

    def is_clock(self, name: str) -> bool:
        """Whether a column holds dates or clock times, which need no unit.

        Of text the first filled cell decides; a column without a filled cell is none. KeyError for a name
        that is no column.
        """
        values = self.raw[name]
        if isinstance(values, tuple):
            first_filled = next((cell for cell in values if cell), "")
            return is_stamp(first_filled)
        dtype = getattr(values, "dtype", np.dtype(float))
        return dtype.kind in "Mm"

    def _numbers(self, name: str) -> RealArray:
        """A column as finite numbers (T,); dates and clock times in seconds since the first.

        Raises ValueError that quotes what cannot be taken: text, complex numbers or objects in an array
        (`as_numbers`), another shape than (T,), an instant that is missing, a number that `_finite` refuses.
        KeyError for a name that is no column.
        """
        column = self.raw[name]
        if isinstance(column, tuple):
            return self._finite(name, self._parsed(name, column), column)
        try:
            values = as_numbers(column)
        except ValueError as error:
            raise ValueError(f"{self.path}: column '{shown(name)}' {error}") from None
        # What `_split` could not take apart, as an array of three dimensions.
        if values.ndim != 1:
            raise ValueError(
                f"{self.path}: column '{shown(name)}' has shape {values.shape}; expected a vector"
            )
        if values.dtype.kind in "Mm":
            if np.isnat(values).any():
                row = int(np.argmax(np.isnat(values)))
                raise ValueError(f"{self.path}, {self.place(row, name)}: column '{shown(name)}' is empty")
            # The difference first: instants are exact, doubles of them are not. 1e9 ns are a second.
            since_first = values - values[:1]
            values = since_first / np.timedelta64(1, "ns") / 1e9
        return self._finite(name, values.astype(np.float64), values)

    def _parsed(self, name: str, cells: tuple[str, ...]) -> RealArray:
        """Numbers (T,) of a column of text, NaN for what is none; stamps in seconds since the first.

        Raises ValueError for a stamp that is none, and where a sign may separate decimals or thousands. An
        empty cell is NaN as well, which `_finite` then refuses.
        """
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
                with_points = text.replace(",", ".").split("\n") if decimal == "," else cells
                numbers = np.array(list(map(float, with_points)))
        if numbers is None:
            values = [number(cell, decimal) if is_number(cell, decimal) else np.nan for cell in cells]
            numbers = np.array(values)
        self.parsed[name] = numbers
        return numbers.copy()

    def _refuse_doubtful_groups(self, name: str, cells: tuple[str, ...]) -> None:
        """Raise ValueError where '1.500' in a column may be one and a half, or fifteen hundred.

        cells: the column as text, (T,). Doubtful is a column in which every cell with a point or comma has
        exactly three digits behind it (`doubtful_groups`, which says the first such row). The table's own
        decimal sign counts as proven, and only the other one is doubted, where some cell of the table leaves
        no doubt of it ('0.5': `Layout.plain`). Nothing is refused where the user stated the decimal sign, or
        where the table is no text.
        """
        if self.layout is None or self.layout.stated:
            return
        # In a table separated by commas a comma cannot separate decimals, so that a point does: proven, too.
        # Not so in a column of counts: these are whole, and a point in them rather groups thousands. Per cent
        # are in `COUNTED` as a unit of unknown size, but they need not be whole.
        is_counted = says_counts(name) or kind_of(self.unit(name)) in COUNTED - {"%"}
        is_proven = self.layout.plain or (self.layout.separator == "," and not is_counted)
        row = doubtful_groups(cells, self.layout.decimal, proven=is_proven)
        if row is not None:
            sign = "," if "," in cells[row] else "."
            raise ValueError(
                f"{self.path}, {self.place(row, name)}: column '{shown(name, 40)}' is "
                f"'{shown(cells[row], 20)}': does the '{sign}' separate decimals or thousands? "
                "State the decimal sign: --decimal point, or --decimal comma"
            )

    def _finite(self, name: str, numbers: RealArray, cells: Any) -> RealArray:
        """The numbers (T,) of a column, where all are finite and `LARGEST` at most.

        cells: what they were read from. Raises ValueError that quotes the first that is not, and says what to
        do. numbers: NaN where a cell is no number. An empty column comes back as it is.
        """
        bad_rows = np.flatnonzero(~(np.abs(numbers) <= LARGEST))
        if not bad_rows.size:
            return numbers
        row = int(bad_rows[0])
        is_text = isinstance(cells, tuple)
        content = str(cells[row])
        quoted = content
        if is_text:
            quoted = f"'{shown(content, 40)}'" if content else "empty"
        place = f"{self.path}, {self.place(row, name)}: column '{shown(name)}' is {quoted}"

        # Nothing but empty cells from there on: a vector that is shorter than the others.
        if is_text and row > 0 and not any(cells[row:]):
            raise ValueError(
                f"{self.path}: column '{shown(name)}' ends at {self.place(row - 1, name)}, others at "
                f"{self.place(len(cells) - 1, name)}; expected equal lengths: cut the rows behind it"
            )
        if is_text and content.startswith("="):
            raise ValueError(
                f"{place}, a formula without its value; open the file in Excel or LibreOffice and save it "
                "again, or write values"
            )

        # Where fewer than half of the rows are bad they may be left out; of more it is no column of numbers.
        # "1e100" below is `LARGEST`.
        is_too_large = bool(np.isfinite(numbers[row]))
        sign = " with a decimal comma" if self.layout and self.layout.decimal == "," else ""
        limit = " up to 1e100" if is_too_large else ""
        remedy = ""
        if 2 * bad_rows.size < numbers.size and not is_too_large:
            remedy = (
                f"; delete such rows ({bad_rows.size} here): with a time column, flexlink init fills the gap "
                "that this leaves, other commands with --repair"
            )
        raise ValueError(f"{place}; expected a finite number{sign}{limit}{remedy}")

    def seconds(self, name: str, stamps: RealArray, unit: str | None) -> tuple[RealArray, TimeColumn]:
        """Time stamps in seconds, and what was taken for which.

        Parameters
        ----------
        name : str
            Column of time.
        stamps : ndarray, shape (T,)
            Its numbers, as of `columns`: finite, in the unit of the column. None, or a single one, pass.
        unit : str or None
            Unit that the user states.

        Returns
        -------
        seconds : ndarray, shape (T,)
            Since the first where stamps are long or a timer starts again, which then goes on; else as they
            are.
        column : TimeColumn
            The unit that was taken, whether that is doubtful, and how often a timer starts again.

        Raises
        ------
        ValueError
            The unit is not known, has to be asked for, or makes no time of any clock or machine; a unit is
            stated of clock times that need none.
        """
        if self.is_clock(name):
            return self._clock_seconds(name, stamps, unit)
        # A timer that starts again goes on, so that a long log is one.
        period = timer_period(stamps)
        n_wraps = 0
        if period:
            wraps_before = np.cumsum(np.diff(stamps) < 0)
            n_wraps = int(wraps_before[-1])
            stamps = stamps + period * np.concatenate([[0], wraps_before])
        try:
            column = TimeColumn.of(name, unit, self.units.get(name, ""))
            column.refuse_stamps(stamps)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from None
        is_doubtful = column.doubtful_for(stamps)
        passed = stamps - stamps[0] if period else self._since_first(name, stamps)
        column = replace(column, doubtful=is_doubtful, wraps_at=period, wraps=n_wraps)
        return column.seconds(passed), column

    def _clock_seconds(self, name: str, stamps: RealArray, unit: str | None) -> tuple[RealArray, TimeColumn]:
        """Clock times (T,) in seconds, with the column they are from.

        stamps: in seconds, where '12:30' was taken for hours and minutes. unit: stated by the user, 'h' or
        'min' for what stands first in such a stamp. Raises ValueError where it has to be stated, and where
        another unit is. The column comes back as stated in seconds, never doubtful; NaN cannot come here.
        """
        cells = self.raw[name]
        is_unclear = isinstance(cells, tuple) and may_be_minutes(cells)
        if is_unclear and unit is None:
            raise ValueError(
                f"{self.path}: time '{shown(name, 40)}' like '{shown(cells[0], 20)}' may be hours:minutes or "
                "minutes:seconds; state what comes first: --time-unit h, or --time-unit min"
            )
        if unit is not None and not (is_unclear and unit in ("h", "min")):
            raise ValueError(f"{self.path}: '{shown(name)}' holds clock times; they have no unit")
        # '12:30' was taken for hours and minutes; as minutes and seconds it is a sixtieth of that.
        seconds = stamps / 60 if unit == "min" else stamps
        return seconds, TimeColumn(name, "s", "s", stated=True)

    def _since_first(self, name: str, stamps: RealArray) -> RealArray:
        """Stamps (T,) of a column, in its unit; since the first one where they are long (`_LONG_STAMP`).

        Integers and text with more digits than doubles keep them in the difference. Cells of text that are no
        plain decimals (with groups, brackets or a Fortran exponent) are not refused: the difference is then
        one of doubles.
        """
        values = self.raw[name]
        if not stamps.size or abs(stamps[0]) < _LONG_STAMP:
            return stamps
        if self.clocks:
            return np.asarray(stamps - stamps[0])
        if isinstance(values, tuple):
            decimal = self.layout.decimal if self.layout else "."
            # Decimals keep every digit of the text.
            try:
                exact = [Decimal(cell.replace(decimal, ".")) for cell in values]
                return np.array([float(value - exact[0]) for value in exact])
            except InvalidOperation:
                return np.asarray(stamps - stamps[0])
        dtype = getattr(values, "dtype", np.dtype(float))
        if dtype.kind not in "iu":
            return np.asarray(stamps - stamps[0])
        # The difference of unsigned integers, taken as signed ones, is right whichever is larger.
        differences = (values - values[0]).astype(np.int64)
        return np.asarray(differences, dtype=np.float64)

    def stamps(self, name: str, rows_of: str | None, unit: str | None) -> tuple[RealArray, TimeColumn]:
        """Time stamps of a column in seconds, which increase, and what was taken for which.

        Parameters
        ----------
        name : str
            Column of time.
        rows_of : str or None
            Column whose rows count, where columns have rows of their own.
        unit : str or None
            Unit that the user states.

        Returns
        -------
        seconds : ndarray, shape (T,)
        column : TimeColumn
            Its `unit` is what the stamps were taken for, `doubtful` whether that looks wrong.

        Raises
        ------
        ValueError
            No such column, cells that are no finite numbers, or columns of different length (`columns`); a
            unit that is not known or makes no time (`seconds`); fewer than two stamps, or a stamp that is not
            later than the one before (`increasing`).
        """
        wanted = [name] if rows_of is None else [name, rows_of]
        numbers = self.columns(wanted, rows_of)[name]
        seconds, column = self.seconds(name, numbers, unit)
        self.increasing(seconds, name)
        return seconds, column

    def increasing(self, stamps: RealArray, name: str | None) -> None:
        """Raise ValueError unless there are two time stamps (T,) at least, each later than the one before.

        stamps: in seconds; name: of their column. The message says what to do: of a repeated row, a single
        row without a time, or a log that starts again. A stamp that is NaN counts as not later.
        """
        if stamps.size < 2:
            raise ValueError(
                f"{self.path}: a single row of numbers; expected at least 2 to find the sampling time"
            )
        backwards = np.flatnonzero(~(np.diff(stamps) > 0))
        if not backwards.size:
            return
        row = int(backwards[0]) + 1
        # A single stamp that is none: without it, or without the one before, time goes on.
        is_only = backwards.size == 1
        has_next = row < stamps.size - 1
        if stamps[row] == stamps[row - 1]:
            what = "take the repeated row out"
        elif is_only and has_next and row > 1 and stamps[row - 2] < stamps[row]:
            what = "delete the row before, which has no time, and give --repair"
        elif is_only and has_next and stamps[row - 1] < stamps[row + 1]:
            what = "delete this row, which has no time, and give --repair"
        else:
            what = "split the file there, or number its runs in a column"
        raise ValueError(
            f"{self.path}, {self.place(row)}: time '{name}' goes from {stamps[row - 1]:.9g} to "
            f"{stamps[row]:.9g} s; expected increasing time ({what})"
        )


def _split(name: str, values: Any) -> dict[str, Any]:
    """The columns, by name, that one named thing of a file is: itself, or several name[0], name[1], ...

    A matrix (T, C), or (C, T) as of Simulink, is C columns; (T, 1) and (1, T) are vectors. An array of
    records is a column for each field, name.field; lists in cells of text, '[0.1, 0.2]', are as of
    `columns_in`. Nothing is refused here: an array of three dimensions, or one with more than `MOST_COLUMNS`
    on both sides, stays one thing, which `Table._numbers` refuses when it is asked for; cells of text that
    are no list make no entry in that row.
    """
    if isinstance(values, tuple) and values and _LIST.match(values[0]):
        lists = list[list[str] | None]()
        for cell in values:
            entries = _LIST_ENTRY.findall(_NUMPY_WORDS.sub("", cell))
            lists.append(entries or None)
        return columns_in(name, lists)
    if not isinstance(values, np.ndarray):
        return {name: values}
    if values.dtype.names and values.ndim == 1:
        return {f"{name}.{entry}": values[entry] for entry in values.dtype.names}
    if values.ndim != 2:
        return {name: values}
    if 1 in values.shape or values.size == 0:
        return {name: values.ravel()}
    if min(values.shape) > MOST_COLUMNS:
        return {name: values}
    # There are more samples than signals.
    matrix = values if values.shape[0] >= values.shape[1] else values.T
    return {f"{name}[{k}]": column for k, column in enumerate(matrix.T)}
