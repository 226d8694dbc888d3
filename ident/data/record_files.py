"""Reading columns of numbers from log files: one registered reader per format (`reads`)."""

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

Reader = Callable[[Path, bytes], Table]
READERS: dict[str, Reader] = {}
"""Readers by the ending of a file's name."""


def reads(*endings: str) -> Callable[[Reader], Reader]:
    """Registers a reader for these endings: from the path (for complaints) and the bytes of a file to a
    `Table`. What it raises as ValueError is put behind the path, so it begins with ':' or ', line 3:'."""

    def register(reader: Reader) -> Reader:
        READERS.update(dict.fromkeys(endings, reader))
        return reader

    return register


def read_table(path: str | PathLike[str]) -> Table:
    """The columns of a log file; also of one packed by gzip (log.csv.gz). ValueError: one line."""
    file = Path(path)
    if not file.is_file():  # a pipe would be waited for
        raise ValueError(f"{file}: {'not a file' if file.exists() else 'no such file'}")
    ending, packed = _ending(file), file.suffix.lower() == ".gz"
    if ending not in READERS:
        known = ", ".join(READERS)
        raise ValueError(f"{file}: unknown kind of file '{shown(ending)}'; expected one of {known} (or .gz)")
    try:
        content = _unpacked(content_of(file)) if packed else content_of(file)
        if re.match(rb"\s*# (Created by Octave|name: .*\r?\n# type: )", content):
            raise ValueError("Octave text; expected numbers as MATLAB has them: save -v7 FILE.mat NAMES")
        return READERS[ending](file, content)
    except ValueError as error:
        text = str(error)
        between = "" if text.startswith((":", ",")) else ": "
        raise ValueError(text if text.startswith(str(file)) else f"{file}{between}{text}") from None


def _ending(file: Path) -> str:
    return Path(file.name.lower().removesuffix(".gz")).suffix


def _unpacked(content: bytes) -> bytes:
    try:
        with gzip.open(io.BytesIO(content)) as stream:
            unpacked = stream.read(LARGEST_BYTES + 1)
    except (OSError, EOFError, zlib.error):
        raise ValueError(": not packed by gzip, or damaged") from None
    if len(unpacked) > LARGEST_BYTES:
        raise ValueError(f": unpacks to more than {LARGEST_BYTES >> 20} MiB: split the file")
    return unpacked


# A column with values in fewer of the rows has rows of its own.
_OWN_ROWS = 0.8


@reads(".csv", ".tsv", ".txt", ".dat", ".asc", ".lvm")
def _read_text(file: Path, content: bytes) -> Table:
    """A text table; its layout is found from the lines (`text_tables`)."""
    return _text_table(file, *read_text(text_of(content)))


def _text_table(file: Path, layout: Layout, columns: Mapping[str, tuple[str, ...]]) -> Table:
    """Stamps made from a stated start and step, where a scope writes these instead, and columns that have
    rows of their own."""
    raw, units = dict[str, Any](columns), dict(layout.units)
    n_rows = len(next(iter(columns.values())))
    if layout.increment is not None:
        start, step = layout.increment
        counted = next((name for name, unit in units.items() if unit.lower() == "sequence"), None)
        given = [
            name
            for name, cells in raw.items()
            if any(cells) and (says_time(name) or units.get(name, "").lower() in TIME_UNITS)
        ]
        name = counted or next((n for n in raw if units.get(n) == "s" and not any(raw[n])), "time")
        # Rows that were skipped would be missing in it: then nobody knows the time.
        if (counted is not None or not given) and not layout.skipped:
            raw[name], units[name] = start + step * np.arange(n_rows), "s"
    raw = {name: cells for name, cells in raw.items() if not isinstance(cells, tuple) or any(cells)}
    # Some write a time for each signal.
    times = [name for name in raw if name.startswith("#") and says_time(name.partition(" ")[2])]
    if len(times) > 1 and len({raw[name] for name in times}) > 1:
        raise ValueError(f": '{times[0]}' and '{times[1]}' differ; expected one time for all signals")
    raw = {name.partition(" ")[2] if name in times else name: cells for name, cells in raw.items()}
    units |= {name.partition(" ")[2]: units.get(name, "") for name in times}
    table = Table(file, raw, layout.first, layout, units)
    filled = {name: [k for k, cell in enumerate(cells) if cell] for name, cells in columns.items()}
    ends = {name: rows for name, rows in filled.items() if rows and len(rows) < n_rows}
    # An empty cell now and then is a reading that is missing; empty cells at the end are of a shorter vector.
    own = any(len(rows) <= _OWN_ROWS * n_rows and rows[-1] - rows[0] >= len(rows) for rows in ends.values())
    if not own or n_rows < 10:
        return table
    kept = {name: rows for name, rows in filled.items() if rows}
    raw = {name: tuple(columns[name][k] for k in rows) for name, rows in kept.items()}
    clocks = {name: np.array(rows, dtype=np.float64) for name, rows in kept.items()}
    return replace(table, raw=raw, clocks=clocks)


@reads(".npz")
def _read_npz(file: Path, content: bytes) -> Table:
    """A numpy archive of named vectors; object arrays (pickles) are not read."""
    return Table(file, npz_arrays(content))


@reads(".mat")
def _read_mat(file: Path, content: bytes) -> Table:
    """A MATLAB file; what stands in structs is called log.signals[0].values."""
    if b"\x89HDF\r\n" in content[:1024]:  # version 7.3
        return _read_columns(file, content)
    return _table_of(file, _flat("", mat_variables(content, file)))


@reads(".xlsx")
def _read_xlsx(file: Path, content: bytes) -> Table:
    """The visible sheet with a table, laid out as in a text file; rows are called lines. Where there are
    several, their columns under the names of the sheets."""
    texts: dict[str, str] = json.loads(read_in_child("xlsx", "openpyxl", content))
    found, refused = {}, ValueError()
    for title, text in texts.items():
        try:
            found[title] = read_text(text)
        except ValueError as error:
            refused = refused if refused.args else error
    if not found and any("\t=" in text or text.startswith("=") for text in texts.values()):
        raise ValueError(
            ": formulas without their values; open the file in Excel or LibreOffice and save it again"
        )
    if not found:
        raise refused
    rows = {title: len(next(iter(columns.values()))) for title, (_, columns) in found.items()}
    # Some settings in a few rows are no second log.
    found = {title: one for title, one in found.items() if 10 * rows[title] >= max(rows.values())}
    if len(found) == 1:
        ((layout, columns),) = found.values()
        return _text_table(file, layout, columns)
    named = {
        f"{title}/{name}": column for title, (_, table) in found.items() for name, column in table.items()
    }
    units = {f"{title}/{name}": u for title, (layout, _) in found.items() for name, u in layout.units.items()}
    return Table(file, named, units=units)


@reads(".json", ".jsonl", ".ndjson")
def _read_json(file: Path, content: bytes) -> Table:
    """Rows or columns as `json_columns` finds them; of `.jsonl` and `.ndjson` a row in each line."""
    return Table(file, json_columns(text_of(content), in_lines=_ending(file) != ".json"))


@reads(".mcap", ".bag", ".db3")
def _read_bag(file: Path, content: bytes) -> Table:
    """MCAP, ROS 1 and ROS 2 bags: topic.field; signals of several topics hold their last message."""
    table = _read_columns(file, content)
    recorded = {name[:-1]: table.raw[name] for name in table.names if name.endswith("\t")}
    raw = {name: values for name, values in table.raw.items() if not name.endswith("\t")}
    # A topic's name may be the beginning of another's: the longest that fits comes last.
    topics = sorted(recorded, key=len)
    clocks = {name: recorded[topic] for topic in topics for name in raw if name.startswith(f"{topic}.")}
    return replace(table, raw=raw, clocks=clocks)


@reads(".h5", ".hdf5", ".parquet")
def _read_columns(file: Path, content: bytes) -> Table:
    """What the child makes of a file: of HDF5 datasets by their path, group/signal, and group/table.field."""
    kinds = dict.fromkeys((".h5", ".hdf5", ".mat"), ("HDF5", "h5py")) | {".parquet": ("parquet", "pyarrow")}
    kind, libraries = kinds.get(_ending(file), (_ending(file)[1:], "mcap rosbags"))
    arrays = npz_arrays(read_in_child(kind, libraries, content))
    about = json.loads(arrays.pop("about").tobytes())
    found = [
        (name, Unread(why) if why else arrays[str(k)], unit) for k, (name, unit, why) in enumerate(about)
    ]
    return _table_of(file, found)


def _table_of(file: Path, columns: Sequence[tuple[str, Any, str]]) -> Table:
    """Of names, columns and units; a name may be there several times."""
    names = distinct([name for name, _, _ in columns])
    units = {name: unit for name, (_, _, unit) in zip(names, columns, strict=True) if unit}
    return Table(file, {name: column[1] for name, column in zip(names, columns, strict=True)}, units=units)


def _flat(name: str, value: Any, unit: str = "") -> list[tuple[str, Any, str]]:
    """Nested fields and lists under the names by which a program would call them, with their units; text is
    no column. What says its name beside its data, as recorders do, has that."""
    if isinstance(value, Mapping):
        said = {key.lower(): text.strip() for key, text in value.items() if isinstance(text, str)}
        data = ("data", "values") if said.get("name") else ()
        unit = said.get("unit", "")
        parts = [
            (said["name"] if key.lower() in data else f"{name}.{key}" if name else key, item)
            for key, item in value.items()
        ]
    elif isinstance(value, list):
        parts = [(f"{name}[{k}]", item) for k, item in enumerate(value)]
    else:
        return [] if isinstance(value, str) else [(name, value, unit)]
    return [item for part in parts for item in _flat(*part, unit)]
