"""Columns of log files of any known format, as a `Table`: one registered reader per format.

`read_table` finds the reader by the ending of the file's name and puts the file's name before every
complaint. Readers stand below it and are registered with `reads`; a program adds a format of its own in the
same way. Text and npz are read here, formats that need a compiled library by a process of its own
(`foreign_files.read_in_child`), so that a damaged file ends that process and not this one. Readers only find
columns and their units; what the columns mean is for `table`, `units` and `record` to say.
"""

from __future__ import annotations

import gzip
import io
import json
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ident.data.foreign_files import (
    LARGEST_BYTES,
    Unread,
    content_of,
    distinct,
    npz_arrays,
    read_in_child,
    shown,
)
from ident.data.json_columns import json_columns
from ident.data.mat_files import mat_variables
from ident.data.table import Table
from ident.data.text_tables import Layout, read_text, text_of
from ident.data.units import TIME_UNITS, says_time

# A file's path, for complaints, and its bytes; the columns.
Reader = Callable[[Path, bytes], Table]
READERS: dict[str, Reader] = {}
"""Readers by the ending of a file's name, in lower case: '.csv'."""

# What a text file of GNU Octave begins with (its default format, which is no table).
OCTAVE_TEXT = re.compile(rb"\s*# (Created by Octave|name: .*\r?\n# type: )")
# A MATLAB file of version 7.3 is an HDF5 file, which begins with this.
HDF5_SIGNATURE = b"\x89HDF\r\n"
# First bytes of a MATLAB file in which the signature is looked for: text of 512 bytes may stand before it.
SIGNATURE_WITHIN_BYTES = 1024

# A column of text that is filled in at most this share of the rows may have rows of its own: signals logged
# at half the rate of others have .5, a column in which readings are missing now and then has nearly 1. Chosen
# between.
OWN_ROWS_SHARE = 0.8
# Rows below which no column has rows of its own: a few empty cells are readings that are missing. Chosen.
FEWEST_ROWS = 10
# A sheet that the longest one exceeds by more than this factor, in rows, is no log: some settings in a few
# rows. Logs of one experiment on several sheets are of like length. Chosen.
LOG_OVER_SETTINGS = 10


def reads(*endings: str) -> Callable[[Reader], Reader]:
    """Return a decorator that registers a reader for files of these endings.

    An ending that is registered already is taken over; endings in capitals are never found. Neither is
    refused.

    Parameters
    ----------
    *endings : str
        Endings of file names in lower case, with their point: '.csv'.

    Returns
    -------
    callable
        Takes and returns a function from the path and the bytes of a file to a `Table`. What that function
        raises as ValueError is put behind the path, so it begins with ':' or ', line 3:', or with words.
    """

    def register(reader: Reader) -> Reader:
        """Register the reader and return it as it is. It is not called here, nor checked."""
        READERS.update(dict.fromkeys(endings, reader))
        return reader

    return register


def read_table(path: str | PathLike[str], *, largest_bytes: int = LARGEST_BYTES) -> Table:
    """Return the columns of a log file, which may be packed by gzip (log.csv.gz).

    Parameters
    ----------
    path : path-like
        Its ending says the format (`READERS`).
    largest_bytes : int
        Size above which the file, and what it unpacks to, is refused.

    Returns
    -------
    Table

    Raises
    ------
    ValueError
        One line that begins with the path: no such file, a pipe or a folder, an unknown format, text of
        Octave, too large, damaged, or whatever the reader complains of.
    """
    file = Path(path)
    if not file.is_file():  # a pipe would be waited for
        raise ValueError(f"{file}: {'not a file' if file.exists() else 'no such file'}")
    ending = _ending(file)
    if ending not in READERS:
        known = ", ".join(READERS)
        raise ValueError(f"{file}: unknown kind of file '{shown(ending)}'; expected one of {known} (or .gz)")

    try:
        content = content_of(file, largest_bytes)
        if file.suffix.lower() == ".gz":
            content = _unpacked(content, largest_bytes)
        if OCTAVE_TEXT.match(content):
            raise ValueError("Octave text; expected numbers as MATLAB has them: save -v7 FILE.mat NAMES")
        return READERS[ending](file, content)
    except ValueError as error:
        # Readers that were given the path have it in their complaint already.
        complaint = str(error)
        if not complaint.startswith(str(file)):
            between = "" if complaint.startswith((":", ",")) else ": "
            complaint = f"{file}{between}{complaint}"
        raise ValueError(complaint) from None


def _ending(file: Path) -> str:
    """Return the ending of a file's name in lower case, with its point, '.gz' left out: '.csv'.

    Empty for a name without one.
    """
    return Path(file.name.lower().removesuffix(".gz")).suffix


def _unpacked(content: bytes, largest_bytes: int) -> bytes:
    """Return what gzip packed. Raises ValueError where it is damaged, or unpacks to more than the largest
    size, of which no more is unpacked.

    content: all of the file; largest_bytes: of what it unpacks to.
    """
    try:
        with gzip.open(io.BytesIO(content)) as stream:
            unpacked = stream.read(largest_bytes + 1)
    except (OSError, EOFError, zlib.error):
        raise ValueError(": not packed by gzip, or damaged") from None
    if len(unpacked) > largest_bytes:
        raise ValueError(f": unpacks to more than {largest_bytes >> 20} MiB: split the file")
    return unpacked


@reads(".csv", ".tsv", ".txt", ".dat", ".asc", ".lvm")
def _read_text(file: Path, content: bytes) -> Table:
    """Return a text table, whose layout is found from its lines (`text_tables`). Raises ValueError without
    the path where it has none.

    content: the bytes, unpacked.
    """
    layout, columns = read_text(text_of(content))
    return text_table(file, layout, columns)


def text_table(file: Path, layout: Layout, columns: Mapping[str, tuple[str, ...]]) -> Table:
    """Return the table of a text file, with what a layout says beside the cells put into columns.

    Parameters
    ----------
    file : Path
        Named in complaints.
    layout : Layout
        Of it matter here: the units by name, the stated start and step of the rows, whether lines between the
        rows were skipped, and the line of the first row.
    columns : mapping of str to tuple of str
        Cells by name, equally long; empty where a cell holds nothing. At least one column (StopIteration
        else), as `read_text` gives them.

    Returns
    -------
    Table
        Stamps are made where a scope writes a start and a step instead. Of several equal times, one for each
        signal, each is called time. Columns without any cell are left out. Where columns have rows of their
        own, each has its filled cells alone, and `clocks` says of which rows they are.

    Raises
    ------
    ValueError
        Without the path: two signals have different times.
    """
    raw = dict[str, Any](columns)
    units = dict(layout.units)
    n_rows = len(next(iter(columns.values())))

    # Stamps from a stated start and step: in a column that counts samples, else in an empty one of seconds,
    # else in one of their own. Rows that were skipped would be missing in it: then nobody knows the time.
    if layout.increment is not None and not layout.skipped:
        counting_names = [name for name, unit in units.items() if unit.lower() == "sequence"]
        empty_names = [name for name in raw if units.get(name) == "s" and not any(raw[name])]
        has_time = False
        for name, cells in raw.items():
            is_time = says_time(name) or units.get(name, "").lower() in TIME_UNITS
            if any(cells) and is_time:
                has_time = True
        if counting_names or not has_time:
            time_name = [*counting_names, *empty_names, "time"][0]
            start_s, step_s = layout.increment
            raw[time_name] = start_s + step_s * np.arange(n_rows)
            units[time_name] = "s"
    raw = {name: cells for name, cells in raw.items() if not isinstance(cells, tuple) or any(cells)}

    # Some programs write a time for each signal: '#1 time', '#2 time' once equal names are numbered.
    times = [name for name in raw if name.startswith("#") and says_time(name.partition(" ")[2])]
    if len(times) > 1 and len({raw[name] for name in times}) > 1:
        raise ValueError(f": '{times[0]}' and '{times[1]}' differ; expected one time for all signals")
    plain_names = {name: name.partition(" ")[2] for name in times}
    raw = {plain_names.get(name, name): cells for name, cells in raw.items()}
    units |= {plain: units.get(name, "") for name, plain in plain_names.items()}
    table = Table(file, raw, layout.first, layout, units)

    # An empty cell now and then is a reading that is missing; empty cells at the end are of a shorter vector.
    rows_of = {name: [row for row, cell in enumerate(cells) if cell] for name, cells in columns.items()}
    has_own_rows = False
    for rows in rows_of.values():
        if not rows:
            continue
        is_sparse = len(rows) <= OWN_ROWS_SHARE * n_rows
        has_gaps = rows[-1] - rows[0] >= len(rows)
        if is_sparse and has_gaps:
            has_own_rows = True
    if not has_own_rows or n_rows < FEWEST_ROWS:
        return table
    filled = {name: rows for name, rows in rows_of.items() if rows}
    own_cells = {name: tuple(columns[name][row] for row in rows) for name, rows in filled.items()}
    clocks = {name: np.array(rows, dtype=np.float64) for name, rows in filled.items()}
    return replace(table, raw=own_cells, clocks=clocks)


@reads(".npz")
def _read_npz(file: Path, content: bytes) -> Table:
    """Return the named arrays of a numpy archive; object arrays (pickles) are not read, and named as such.
    Raises ValueError without the path for a damaged archive."""
    return Table(file, npz_arrays(content))


@reads(".mat")
def _read_mat(file: Path, content: bytes) -> Table:
    """Return the variables of a MATLAB file; what stands in structs is called log.signals[0].values.

    Raises ValueError for a damaged file.
    """
    if HDF5_SIGNATURE in content[:SIGNATURE_WITHIN_BYTES]:
        return _read_columns(file, content)
    return _table_of(file, _flat("", mat_variables(content, file)))


@reads(".xlsx")
def _read_xlsx(file: Path, content: bytes) -> Table:
    """Return the visible sheet with a table, laid out as in a text file; rows are called lines.

    Where several sheets have one, their columns are called sheet/column, and sheets with less than a tenth of
    the rows of the longest are left out. Raises ValueError without the path where no sheet has a table.
    """
    texts: dict[str, str] = json.loads(read_in_child("xlsx", "openpyxl", content))
    sheets: dict[str, tuple[Layout, dict[str, tuple[str, ...]]]] = {}
    refusals: list[ValueError] = []
    for title, text in texts.items():
        try:
            sheets[title] = read_text(text)
        except ValueError as error:
            refusals.append(error)
    if not sheets:
        if any("\t=" in text or text.startswith("=") for text in texts.values()):
            raise ValueError(
                ": formulas without their values; open the file in Excel or LibreOffice and save it again"
            )
        raise refusals[0]

    n_rows = {}
    for title, (_, columns) in sheets.items():
        first_column = next(iter(columns.values()))
        n_rows[title] = len(first_column)
    longest = max(n_rows.values())
    logs = {title: sheet for title, sheet in sheets.items() if LOG_OVER_SETTINGS * n_rows[title] >= longest}
    if len(logs) == 1:
        ((layout, columns),) = logs.values()
        return text_table(file, layout, columns)

    raw = {}
    units = {}
    for title, (layout, columns) in logs.items():
        for name, cells in columns.items():
            raw[f"{title}/{name}"] = cells
        for name, unit in layout.units.items():
            units[f"{title}/{name}"] = unit
    return Table(file, raw, units=units)


@reads(".json", ".jsonl", ".ndjson")
def _read_json(file: Path, content: bytes) -> Table:
    """Return the rows or columns that `json_columns` finds; of '.jsonl' and '.ndjson' a row in each line.

    Raises ValueError without the path where it is no JSON or holds no columns.
    """
    return Table(file, json_columns(text_of(content), in_lines=_ending(file) != ".json"))


@reads(".mcap", ".bag", ".db3")
def _read_bag(file: Path, content: bytes) -> Table:
    """Return the numbers of an MCAP, ROS 1 or ROS 2 bag, called topic.field, each topic with its own clock.

    Signals of several topics hold their last message. Raises ValueError without the path: damaged, no message
    that can be read, too large, too slow, or a library is not installed.
    """
    # The child writes when a topic's messages were recorded under its name and a tab.
    table = _read_columns(file, content)
    recorded_s = {name[:-1]: table.raw[name] for name in table.names if name.endswith("\t")}
    raw = {name: values for name, values in table.raw.items() if not name.endswith("\t")}

    # A topic's name may be the beginning of another's: the longest that fits comes last, and counts.
    clocks = {}
    for topic in sorted(recorded_s, key=len):
        for name in raw:
            if name.startswith(f"{topic}."):
                clocks[name] = recorded_s[topic]
    return replace(table, raw=raw, clocks=clocks)


@reads(".h5", ".hdf5", ".parquet")
def _read_columns(file: Path, content: bytes) -> Table:
    """Return what the child process makes of a file: of HDF5 the datasets by their path, group/signal, and
    the fields of tables, group/table.field; also of parquet, MATLAB 7.3 and bags.

    Raises ValueError without the path: damaged, too large, too slow, or the library is not installed.
    """
    ending = _ending(file)
    if ending in (".h5", ".hdf5", ".mat"):
        kind = "HDF5"
        libraries = "h5py"
    elif ending == ".parquet":
        kind = "parquet"
        libraries = "pyarrow"
    else:
        kind = ending[1:]
        libraries = "mcap rosbags"
    arrays = npz_arrays(read_in_child(kind, libraries, content))
    about = json.loads(arrays.pop("about").tobytes())
    columns = []
    for number, (name, unit, why_unread) in enumerate(about):
        values = Unread(why_unread) if why_unread else arrays[str(number)]
        columns.append((name, values, unit))
    return _table_of(file, columns)


def _table_of(file: Path, columns: Sequence[tuple[str, Any, str]]) -> Table:
    """Return the table of columns, each a name, values and a unit ('' for none); equal names are numbered.

    Raises ValueError with the path for more columns than a table may have; no columns make a table of none.
    """
    names = distinct([name for name, _, _ in columns])
    raw = {}
    units = {}
    for name, (_, values, unit) in zip(names, columns, strict=True):
        raw[name] = values
        if unit:
            units[name] = unit
    return Table(file, raw, units=units)


def _flat(name: str, value: Any, unit: str = "") -> list[tuple[str, Any, str]]:
    """Return the columns in nested fields and lists: name, values and unit ('' for none) of each.

    Names are those by which a program would call them, log.signals[0].values. An object that says its name
    beside its data, as recorders write it, gives that name to them; one that says its unit, gives that. Text
    is no column. An empty list or object has none. How deep it is nested is for the reader of the file to
    limit.
    """
    if isinstance(value, str):
        return []
    if isinstance(value, Mapping):
        texts = {key.lower(): text.strip() for key, text in value.items() if isinstance(text, str)}
        recorded_name = texts.get("name", "")
        unit = texts.get("unit", "")
        parts = []
        for key, item in value.items():
            if recorded_name and key.lower() in ("data", "values"):
                parts.append((recorded_name, item))
            else:
                parts.append((f"{name}.{key}" if name else key, item))
    elif isinstance(value, list):
        parts = [(f"{name}[{number}]", item) for number, item in enumerate(value)]
    else:
        return [(name, value, unit)]

    columns = []
    for part_name, part in parts:
        columns += _flat(part_name, part, unit)
    return columns
