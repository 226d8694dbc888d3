"""Reading columns of numbers from log files: one registered reader per format (`reads`).

Every complaint is one line that names file, place and expectation.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ident.data.arrays import RealArray
from ident.data.foreign_files import as_numbers, content_of, shown
from ident.data.mat_files import mat_variables
from ident.data.npz_files import npz_arrays
from ident.data.units import TimeColumn

# Each sampling interval may differ from the mean one by this fraction: at the Nyquist frequency the phase
# of a sample is then wrong by at most 0.03 rad. A clock's jitter is far below it, a lost sample far above.
TIME_TOLERANCE = 0.01


@dataclass(frozen=True, eq=False)
class Table:
    """Named columns of one file. `first_line` is the file line of row 0, or None where rows have no lines
    (npz, mat)."""

    path: Path
    names: tuple[str, ...]
    raw: dict[str, Any]
    first_line: int | None

    def place(self, row: int) -> str:
        return f"index {row}" if self.first_line is None else f"line {row + self.first_line}"

    def columns(self, wanted: Sequence[str]) -> dict[str, RealArray]:
        """The wanted columns as equally long finite vectors.

        Raises ValueError if one is missing (lists those there are), not numeric, not finite or of another
        length.
        """
        for name in wanted:
            if name not in self.names:
                raise ValueError(
                    f"{self.path}: no column '{name}'; the file has {_listed(self.names)}{self._hint()}"
                )
        found = {name: self._numbers(name) for name in dict.fromkeys(wanted)}
        sizes = {name: column.size for name, column in found.items()}
        if len(set(sizes.values())) > 1:
            raise ValueError(f"{self.path}: columns must be equally long; got {sizes}")
        return found

    def _hint(self) -> str:
        """What the header looks like when it is no header of ours: another separator, or numbers."""
        if self.first_line is None:
            return ""
        if len(self.names) == 1:
            for separator, word in ((";", "semicolons"), ("\t", "tabs")):
                if separator in self.names[0]:
                    return f" (one column separated by {word}?); expected commas and decimal points"
        if all(_is_number(name) for name in self.names):
            return " (numbers?); expected column names in line 1"
        return ""

    def _numbers(self, name: str) -> RealArray:
        column = self.raw[name]
        if isinstance(column, pd.Series):
            return self._finite(name, pd.to_numeric(column, errors="coerce").to_numpy(np.float64), column)
        try:
            values = as_numbers(column)
        except ValueError as error:
            raise ValueError(f"{self.path}: column '{shown(name)}' {error}") from None
        # MATLAB has no 1-d arrays: (T, 1) and (1, T) are its vectors.
        if values.ndim == 2 and 1 in values.shape:
            values = values.ravel()
        if values.ndim != 1:
            raise ValueError(f"{self.path}: column '{name}' has shape {values.shape}; expected a vector")
        return self._finite(name, values.astype(np.float64), values)

    def _finite(self, name: str, numbers: RealArray, shown: Any) -> RealArray:
        """The numbers if all are finite; else a complaint that quotes the first that is not."""
        bad = np.flatnonzero(~np.isfinite(numbers))
        if not bad.size:
            return numbers
        row = int(bad[0])
        found = shown.iloc[row] if isinstance(shown, pd.Series) else shown[row]
        if isinstance(shown, pd.Series):
            text = found.strip()[:40] if isinstance(found, str) else ""
            found = f"'{text}'" if text else "empty"
        raise ValueError(
            f"{self.path}, {self.place(row)}: column '{name}' is {found}; expected a finite number"
        )

    def seconds(self, name: str, stamps: RealArray, unit: str | None) -> tuple[RealArray, TimeColumn]:
        """Time stamps in seconds, from the unit stated or written in the header, and what was taken for
        which. Raises ValueError for an unknown unit."""
        try:
            column = TimeColumn.of(name, unit)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from None
        return column.seconds(stamps), replace(column, doubtful=column.doubtful_for(stamps))

    def increasing(self, stamps: RealArray, name: str | None) -> None:
        """Raises ValueError unless there are two time stamps at least, each later than the one before."""
        if stamps.size < 2:
            raise ValueError(
                f"{self.path}: a single row of numbers; expected at least 2 to find the sampling time"
            )
        backwards = np.flatnonzero(~(np.diff(stamps) > 0))
        if backwards.size:
            row = int(backwards[0]) + 1
            what = "take the repeated row out" if stamps[row] == stamps[row - 1] else "split the file there"
            raise ValueError(
                f"{self.path}, {self.place(row)}: time '{name}' goes from {stamps[row - 1]:.9g} to "
                f"{stamps[row]:.9g} s; expected increasing time ({what})"
            )

    def sampling_time(self, stamps: RealArray | None, name: str | None, dt_s: float | None) -> float:
        """dt in seconds from the time stamps (mean interval), or the given one; both must agree where both
        are there.

        Raises ValueError if neither is given, dt_s is not positive, or the stamps are not increasing and
        uniform to `TIME_TOLERANCE`.
        """
        if dt_s is not None and not (np.isfinite(dt_s) and dt_s > 0):
            raise ValueError(f"{self.path}: dt_s must be a positive number of seconds; got {dt_s}")
        if stamps is None:
            if dt_s is None:
                raise ValueError(
                    f"{self.path}: give the time column or dt_s; the file has {_listed(self.names)}"
                )
            return float(dt_s)
        self.increasing(stamps, name)
        interval = np.diff(stamps)
        # The median says what the step is even where samples are lost; the mean over all is the better
        # estimate after.
        median = float(np.median(interval))
        uneven = np.flatnonzero(~(np.abs(interval - median) <= TIME_TOLERANCE * median))
        if uneven.size:
            row = int(uneven[0]) + 1
            # A few wide steps are lost samples; many uneven ones are a clock that was read late now and then.
            few = uneven.size <= 0.05 * interval.size
            what = "samples are missing: split the file there" if few else "resample it to a uniform step"
            raise ValueError(
                f"{self.path}, {self.place(row)}: time '{name}' steps by {interval[row - 1]:.6g} s "
                f"where most steps are {median:.6g} s; expected uniform sampling (each step within "
                f"{TIME_TOLERANCE:.0%}; {uneven.size} of {interval.size} are not: {what})"
            )
        mean = float((stamps[-1] - stamps[0]) / interval.size)
        if dt_s is None:
            # Rounding noise of decimal stamps: 0.0020000000000000005 is 0.002.
            return float(f"{mean:.12g}")
        if not abs(dt_s - mean) <= TIME_TOLERANCE * mean:
            raise ValueError(
                f"{self.path}: dt_s = {dt_s:.6g} s, but the time column '{name}' steps by {mean:.6g} s"
            )
        return float(dt_s)


Reader = Callable[..., Table]
READERS: dict[str, Reader] = {}
"""Readers by the ending of a file's name."""


def reads(*endings: str) -> Callable[[Reader], Reader]:
    """Registers a reader for these endings; it takes a path (and options of its own) and gives a `Table`."""

    def register(reader: Reader) -> Reader:
        READERS.update(dict.fromkeys(endings, reader))
        return reader

    return register


def read_table(path: str | PathLike[str], **options: Any) -> Table:
    """The columns of a log file; `options` are those of its reader. ValueError: one line."""
    file = Path(path)
    if not file.is_file():
        raise ValueError(f"{file}: {'not a file' if file.exists() else 'no such file'}")
    if file.suffix.lower() not in READERS:
        raise ValueError(
            f"{file}: unknown kind of file {file.suffix!r}; expected one of {', '.join(READERS)}"
        )
    return READERS[file.suffix.lower()](file, **options)


@reads(".csv", ".txt")
def _read_csv(file: Path, separator: str = ",") -> Table:
    """A text table with one header line. Numbers use a decimal point."""
    try:
        # As text: only so can a complaint quote what stands at the place. Blank lines stay, to keep the
        # line numbers.
        frame = pd.read_csv(
            file,
            sep=separator,
            header=None,  # pandas would silently rename repeated columns
            dtype=str,
            keep_default_na=False,
            skip_blank_lines=False,
            skipinitialspace=True,
            encoding="utf-8-sig",
            index_col=False,
        )
    except pd.errors.EmptyDataError:
        raise ValueError(f"{file}: the file is empty; expected a header line and rows of numbers") from None
    except pd.errors.ParserError as error:
        raise ValueError(f"{file}{_ragged(str(error), separator)}") from None
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{file}: not a UTF-8 text file (byte {error.start}); expected CSV in UTF-8"
        ) from None
    names = tuple(str(item).strip() for item in frame.iloc[0])
    if len(set(names)) != len(names):
        raise ValueError(f"{file}, line 1: column names repeat; got {_listed(names)}")
    frame = frame.iloc[1:].set_axis(list(names), axis="columns")
    # Blank lines at the very end are no samples.
    filled = np.flatnonzero((frame.fillna("") != "").any(axis="columns"))
    if filled.size == 0:
        raise ValueError(f"{file}: no rows under the header line; expected numbers")
    frame = frame.iloc[: filled[-1] + 1]
    return Table(file, names, {item: frame[item] for item in names}, first_line=2)


@reads(".npz")
def _read_npz(file: Path) -> Table:
    """A numpy archive of named vectors; object arrays (pickles) are refused."""
    try:
        raw = npz_arrays(file)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    return Table(file, tuple(raw), raw, first_line=None)


@reads(".mat")
def _read_mat(file: Path) -> Table:
    """A MATLAB file up to version 7.2 (version 7.3 is HDF5: save with '-v7')."""
    raw = mat_variables(content_of(file), file)
    return Table(file, tuple(raw), raw, first_line=None)


def _ragged(reason: str, separator: str) -> str:
    """pandas' complaint about a row that is too long, in our words."""
    found = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", reason)
    if found is None:
        return f": not a table separated by {separator!r} ({' '.join(reason.split())})"
    header, line, cells = found.groups()
    return (
        f", line {line}: {cells} cells where line 1 has {header}; expected one per column, separated by "
        f"{separator!r}, and a decimal point"
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _listed(names: Iterable[str], limit: int = 20) -> str:
    items = list(names)
    shown = ", ".join(items[:limit]) or "no columns"
    return shown if len(items) <= limit else f"{shown}, ... ({len(items)} in all)"
