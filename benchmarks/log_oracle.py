"""Logs of all kinds against who wrote them: sampling time, values and units as numpy, pandas, scipy, h5py and
openpyxl put them there, and what `flexlink look` and `flexlink identify` make of the file.

No line is shared with the reader. Each log is given as a user gives it, without options; a refusal that names
a command or options is followed as it is printed. A log whose unit, columns or rows nobody can tell has to be
asked about; all others have to be read. What counts is what is read wrongly without a word.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.harness import Print, main
from ident.data.record import Record
from workflow.cli import main as flexlink

Rng = np.random.Generator
PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1 / 60}
TIMES = {
    "s": "t_s|time_s|Time [s]|time (s)|Zeit in s|elapsed_s|t/s|time_sec|seconds|timeSeconds|t|time|"
    "Zeit [Sekunden]",
    "ms": "t_ms|Time [ms]|time (ms)|timeMs|time_millis|ms since start|millis|Zeit/ms|time ms|timestamp_ms|"
    "t [msec]|time［ms］|time [ms] rel|TIME_MS|time_milliseconds",
    "us": "t_us|Time [µs]|time (us)|timeUs|micros|time_micros|Zeit [μs]|timestamp_us|t [usec]|us since start",
    "ns": "t_ns|Time [ns]|timestamp_ns|timeNs|nanos|time_nanoseconds|time (ns)",
    "min": "t_min|Time [min]|minutes|time (minutes)|time_minutes",
}
SIGNALS = (
    (("u_V", "V"), ("y_rad", "rad")),
    (("voltage_V", "V"), ("angle_deg", "deg")),
    (("Spannung [V]", "V"), ("Winkel [°]", "°")),
    (("torque (Nm)", "Nm"), ("position (mm)", "mm")),
    (("Strom in A", "A"), ("Weg in mm", "mm")),
    (("cmd [mV]", "mV"), ("ω [rad/s]", "rad/s")),
    (("u", ""), ("y", "")),
)
ENDINGS = {",": "csv", ";": "csv", "\t": "tsv", " ": "dat", "|": "txt"}
START = np.datetime64("2024-02-29T23:59:58.500", "ns")  # passes midnight, in a leap year


@dataclass(frozen=True, eq=False)
class Log:
    """A file and what is in it. answer: "read"; "ask", where the file alone does not tell; "refuse". told: a
    word that `look` has to say."""

    kind: str
    file: str
    content: bytes
    dt_s: float
    names: tuple[str, str, str]
    units: tuple[str, str]
    u: Any
    y: Any
    answer: str = "read"
    told: str = ""
    unit: str = "s"


@dataclass
class Draft:
    """An experiment on its way into a file."""

    rng: Rng
    dt_s: float
    t: Any
    u: Any
    y: Any
    signals: tuple[tuple[str, str], tuple[str, str]]
    unit: str = "s"
    time: str = "t_s"
    answer: str = "read"
    told: str = ""

    def needs(self, answer: str) -> None:
        """What nobody can tell is not told by another blemish."""
        self.answer = max(self.answer, answer, key=("read", "ask", "refuse").index)

    @classmethod
    def of(cls, rng: Rng) -> Draft:
        n, dt_s = int(rng.integers(60, 300)), float(rng.choice([5e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.1]))
        u = rng.choice([-2.5, 1.5, 3.0], n).repeat(3)[:n]
        y = np.round(np.cumsum(rng.normal(0, 0.3, n)), 6)
        draft = cls(rng, dt_s, np.arange(n) * dt_s, u, y, SIGNALS[int(rng.integers(len(SIGNALS)))])
        draft.unit = str(rng.choice(["s", "s", "ms", "ms", "us", "ns", "min"]))
        draft.time = str(rng.choice(TIMES[draft.unit].split("|")))
        return draft

    def stamps(self) -> Any:
        """Numbers in the unit of the time column, without the noise of binary fractions."""
        return np.round(self.t * PER_SECOND[self.unit], 9)

    def log(self, kind: str, file: str, content: bytes) -> Log:
        (u, u_unit), (y, y_unit) = self.signals
        names, units = (self.time, u, y), (u_unit, y_unit)
        return Log(
            kind,
            file,
            content,
            self.dt_s,
            names,
            units,
            self.u,
            self.y,
            self.answer,
            self.told,
            self.unit,
        )


# Times of text tables: a way to write them, and its name in the tally.
def clock(form: str) -> Callable[[Draft], list[str]]:
    def cells(draft: Draft) -> list[str]:
        passed_ns = np.round(1e9 * draft.t).astype(np.int64)
        draft.time, draft.unit = str(draft.rng.choice(["time", "Uhrzeit", "timestamp", "Date"])), "s"
        if form == "mm:ss":
            ms = passed_ns // 1_000_000
            draft.dt_s, draft.t = max(draft.dt_s, 1e-3), draft.t
            return [
                f"{k // 60000:02d}:{k // 1000 % 60:02d}.{passed_ns[i] // 1000 % 10**6:06d}"
                for i, k in enumerate(ms)
            ]
        when = (START + passed_ns).astype("M8[us]").astype(object)
        return [moment.strftime(form) for moment in when]

    return cells


def epoch(unit: str, names: str) -> Callable[[Draft], list[str]]:
    def cells(draft: Draft) -> list[str]:
        draft.unit, draft.time = unit, str(draft.rng.choice(names.split("|")))
        ns = 1_700_000_000_123_000_000 + np.round(1e9 * draft.t).astype(np.int64)
        if unit == "s":
            return [f"{k // 10**9}.{k % 10**9 // 1000:06d}" for k in ns.tolist()]
        return [str(k // (10**9 // int(PER_SECOND[unit]))) for k in ns.tolist()]

    return cells


def numbers(draft: Draft) -> list[str]:
    return [f"{x:.9g}" if draft.unit != "min" else f"{x:.12g}" for x in draft.stamps()]


def unknown(draft: Draft) -> list[str]:
    """Milliseconds that nothing says are some."""
    draft.unit, draft.time = (
        "ms",
        str(draft.rng.choice(["t", "time", "timestamp", "Zeit", "elapsed", "tick"])),
    )
    draft.dt_s = float(draft.rng.choice([1e-3, 2e-3, 5e-3, 0.01]))
    draft.t = np.arange(len(draft.u)) * draft.dt_s
    draft.needs("ask")
    return [f"{x:.0f}" for x in draft.stamps()]


STAMPS: dict[str, Callable[[Draft], list[str]]] = {
    "numbers": numbers,
    "unknown unit": unknown,
    "ISO": clock("%Y-%m-%dT%H:%M:%S.%f"),
    "ISO, blank": clock("%Y-%m-%d %H:%M:%S.%f"),
    "day.month": clock("%d.%m.%Y %H:%M:%S.%f"),
    "hh:mm:ss": clock("%H:%M:%S.%f"),
    "mm:ss": clock("mm:ss"),
    "epoch s": epoch("s", "time|timestamp|__time|t_s"),
    "epoch ms": epoch("ms", "time_ms|timestamp|Time [ms]|time"),
    "epoch us": epoch("us", "timestamp_us|timestamp|time (us)"),
    "epoch ns": epoch("ns", "timestamp_ns|timestamp|time|Time [ns]"),
}


@dataclass
class Text:
    """A text table on its way into a file: lines above, names, rows of cells; between: lines by row."""

    draft: Draft
    header: list[str]
    rows: list[list[str]]
    separator: str
    decimal: str
    above: list[str]
    between: dict[int, str]
    below: list[str]
    end: str = "\n"
    last: str = ""
    encoding: str = "utf-8"

    def line(self, cells: Sequence[str]) -> str:
        quoted = [f'"{c}"' if self.separator in c and self.separator != " " else c for c in cells]
        return self.separator.join(quoted) + self.last

    def bytes(self) -> bytes:
        lines = [*self.above, self.line(self.header), *self.below]
        for k, row in enumerate(self.rows):
            lines += [self.between[k]] if k in self.between else []
            lines.append(self.line(row))
        return (self.end.join(lines) + self.end).encode(self.encoding)


def preamble(text: Text) -> None:
    lines = ["Logger 3000", f"Operator{text.separator}M. Huber", "Sample rate 100 Hz", ""]
    text.above = lines[: int(text.draft.rng.integers(1, 5))]


def comment_above(text: Text) -> None:
    sign = str(text.draft.rng.choice(["# ", "% ", "// "]))
    text.above = [f"{sign}made by a script", f"{sign}arm 3, run 7"]


def comment_names(text: Text) -> None:
    text.header[0] = f"{text.draft.rng.choice(['# ', '#', '% '])}{text.header[0]}"


def comment_between(text: Text) -> None:
    text.between[len(text.rows) // 2] = str(
        text.draft.rng.choice(["# gripper closed", "% restarted", "// ok"])
    )


def rows_out(text: Text) -> None:
    """Samples that somebody commented out, and wrote anew."""
    sign = str(text.draft.rng.choice(["#", "# ", "%", "//"]))
    for k in range(5, len(text.rows), 40):
        text.between[k] = sign + text.line([text.rows[k][0], *("9" for _ in text.rows[k][1:])])


def units_below(text: Text) -> None:
    _line_of_units(text)


def units_above(text: Text) -> None:
    _line_of_units(text)
    text.above, text.below = [*text.above, text.below.pop()], text.below


def _line_of_units(text: Text) -> None:
    draft, brackets = text.draft, text.draft.rng.random() < 0.5
    if draft.answer != "read" or draft.told or not draft.signals[0][1] or ":" in text.rows[0][0]:
        raise UnfitError  # clock times have none
    draft.signals = (("Drive", draft.signals[0][1]), ("Hub", draft.signals[1][1]))
    draft.time = "Time"
    text.header[:3] = ["Time", "Drive", "Hub"]
    units = [draft.unit, draft.signals[0][1], draft.signals[1][1], *([""] * (len(text.header) - 3))]
    text.below.append(text.line([f"[{unit}]" if brackets and unit else unit for unit in units]))


def thousands(text: Text) -> None:
    """An output beyond a thousand, with the sign that groups its digits."""
    if text.separator == "," or (text.separator == " "):
        raise UnfitError
    draft, digits = text.draft, int(text.draft.rng.choice([0, 2]))
    draft.y = np.round(draft.y * 400.0 + 1000.0, digits)
    for row, value in zip(text.rows, draft.y, strict=True):
        cell = f"{value:,.{digits}f}"
        row[2] = cell if text.decimal == "." else cell.translate(str.maketrans(",.", ".,"))
    if digits == 0:
        text.draft.needs("ask")  # of 1,020 alone nobody knows what the comma is


def encoded(text: Text) -> None:
    text.encoding = str(text.draft.rng.choice(["utf-8-sig", "utf-16", "cp1252"]))
    try:
        text.bytes()
    except UnicodeEncodeError:
        text.encoding = "utf-8"


def windows(text: Text) -> None:
    text.end = "\r\n"


def trailing(text: Text) -> None:
    if text.separator == " ":
        raise UnfitError
    text.last = text.separator


def words_beside(text: Text) -> None:
    text.header.append("note")
    for row in text.rows:
        row.append("ok")


def gaps_beside(text: Text) -> None:
    if text.separator == " ":
        raise UnfitError
    text.header.append("temperature [°C]")
    for k, row in enumerate(text.rows):
        row.append(f"{20 + k % 7}".replace(".", text.decimal) if k % 5 == 0 else "")


def twice_beside(text: Text) -> None:
    text.header += ["status", "status"]
    for k, row in enumerate(text.rows):
        row += [str(k % 2), "1"]


def twice(text: Text) -> None:
    """The output's name is there twice: which is meant nobody can tell."""
    text.header.append(text.header[2])
    for k, row in enumerate(text.rows):
        row.append(str(k % 3))
    text.draft.needs("refuse")


def outputs_only(text: Text) -> None:
    text.header = [name for k, name in enumerate(text.header) if k != 1]
    for row in text.rows:
        del row[1]
    text.draft.needs("refuse")


def hole(text: Text) -> None:
    if text.separator == " ":
        raise UnfitError
    text.rows[len(text.rows) // 3][2] = str(text.draft.rng.choice(["", "nan", "NaN"]))
    text.draft.needs("refuse")


def lost_row(text: Text) -> None:
    k = len(text.rows) // 2
    del text.rows[k]
    text.draft.needs("ask")
    text.draft.u[k] = text.draft.y[k] = np.nan  # what --repair fills in


def jitter(text: Text) -> None:
    draft = text.draft
    if ":" in text.rows[0][0] or "." not in text.rows[-1][0].replace(",", "."):
        raise UnfitError
    late = draft.dt_s * PER_SECOND[draft.unit] * draft.rng.uniform(0, 0.1, len(text.rows))
    for row, more in zip(text.rows, late, strict=True):
        row[0] = f"{float(row[0].replace(text.decimal, '.')) + more:.9f}".replace(".", text.decimal)
    draft.needs("ask")
    draft.y = np.full(len(draft.y), np.nan)  # read between the samples


def wrapped(text: Text) -> None:
    draft = text.draft
    counts = np.cumsum(draft.rng.integers(20, 90, len(draft.y))) % 4096
    if np.all(np.diff(counts) > 0):
        raise UnfitError
    draft.y, draft.told = counts.astype(float), "wrap"
    draft.signals = (draft.signals[0], ("encoder [counts]", "counts"))
    text.header[2] = "encoder [counts]" if text.separator != " " else '"encoder [counts]"'
    for row, value in zip(text.rows, counts, strict=True):
        row[2] = str(value)


def sparse(text: Text) -> None:
    """Input and output in rows of their own, as a recorder of messages writes them."""
    if text.separator == " " or text.draft.answer == "ask" or len(text.header) > 3:
        raise UnfitError
    draft, rows = text.draft, []
    for row in text.rows:
        rows += [[row[0], row[1], ""], [row[0], "", row[2]]]
    if draft.unit in ("s", "ms") and "." in rows[-1][0].replace(",", ".") and ":" not in rows[-1][0]:
        later = 0.1 * draft.dt_s * PER_SECOND[draft.unit]
        for row in rows[1::2]:
            row[0] = f"{float(row[0].replace(',', '.')) + later:.7f}".replace(".", text.decimal)
    text.rows, draft.u, draft.y = rows, np.empty(0), np.empty(0)
    draft.needs("ask")


class UnfitError(Exception):
    """A blemish that this table cannot have."""


BLEMISHES: tuple[Callable[[Text], None], ...] = (
    *(preamble, comment_above, units_below, units_above, thousands, wrapped, comment_names, windows),
    *(trailing, words_beside, gaps_beside, twice_beside, twice, hole, lost_row, jitter, comment_between),
    *(rows_out, sparse, outputs_only, encoded),
)


def text_log(rng: Rng) -> Log:
    draft = Draft.of(rng)
    separator, decimal = (
        (",", "."),
        (";", "."),
        (";", ","),
        ("\t", "."),
        ("\t", ","),
        (" ", "."),
        ("|", "."),
    )[int(rng.integers(7))]
    way = str(rng.choice(list(STAMPS), p=[0.55, *([0.45 / (len(STAMPS) - 1)] * (len(STAMPS) - 1))]))
    times = STAMPS[way](draft)
    if separator == " " and " " in times[0]:
        separator = ";"
    rows = [
        [
            time if ":" in time else time.replace(".", decimal),
            *(f"{x:.9g}".replace(".", decimal) for x in pair),
        ]
        for time, *pair in zip(times, draft.u, draft.y, strict=True)
    ]
    header = [draft.time, draft.signals[0][0], draft.signals[1][0]]
    if separator == " ":
        header = [name if " " not in name else f'"{name}"' for name in header]
    text = Text(draft, header, rows, separator, decimal, [], {}, [])
    said = []
    for k in sorted(rng.permutation(len(BLEMISHES))[: int(rng.integers(0, 3))]):
        with contextlib.suppress(UnfitError):
            BLEMISHES[k](text)
            said.append(BLEMISHES[k].__name__)
    name = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks", "|": "bars"}[separator]
    ending = str(rng.choice([ENDINGS[separator], "csv", "txt"]))
    kind = " + ".join([f"{name} {decimal}", f"{way} {draft.time!r}" if way != "ISO" else way, *sorted(said)])
    return draft.log(f"text: {kind}", f"a.{ending}", text.bytes())


# Files that are no text: a way to write them by name, from a draft whose time is in the unit of its name.
def packed(write: Callable[..., object], *arrays: object, **named: object) -> bytes:
    stream = io.BytesIO()
    write(stream, *arrays, **named)
    return stream.getvalue()


def frame(draft: Draft) -> Any:
    import pandas as pd

    (u, _), (y, _) = draft.signals
    return pd.DataFrame({draft.time: draft.stamps(), u: draft.u, y: draft.y})


def integer_stamps(draft: Draft, dtype: str = "int64") -> Any:
    draft.unit, draft.time = "ns", str(draft.rng.choice(["timestamp_ns", "t_ns", "stamp [ns]"]))
    return (1_700_000_000_123_000_000 + np.round(1e9 * draft.t).astype(np.int64)).astype(dtype)


def npz(draft: Draft, how: str) -> bytes:
    columns = {name: values.to_numpy() for name, values in frame(draft).items()}
    time, u, y = columns
    if how == "epoch":
        del columns[time]
        stamps = integer_stamps(draft, str(draft.rng.choice(["int64", "uint64"])))
        columns = {draft.time: stamps, **columns}
    elif how == "instants":
        draft.time = "when"
        columns = {"when": START + np.round(1e9 * draft.t).astype("m8[ns]"), u: draft.u, y: draft.y}
    elif how == "months":  # a calendar, no clock
        draft.needs("refuse")
        columns = {"when": np.datetime64("2020-01") + np.arange(len(draft.u)), u: draft.u, y: draft.y}
    elif how == "complex":
        draft.needs("refuse")
        columns[u] = columns[u] * (1 + 0.5j)
    elif how == "float32":
        draft.u, draft.y = draft.u.astype("f4").astype(float), draft.y.astype("f4").astype(float)
        columns |= {u: draft.u.astype("f4"), y: draft.y.astype("f4")}
    elif how in ("columns", "rows"):
        draft.needs("ask")
        whole = np.column_stack([draft.t, draft.u, draft.y])
        draft.unit, columns = "s", {"log": whole if how == "columns" else whole.T}
        draft.time, draft.signals = "log[0]", (("log[1]", ""), ("log[2]", ""))
    elif how == "fields":
        kind = [(name, "f8") for name in columns]
        columns = {"log": np.array(list(zip(*columns.values(), strict=True)), dtype=kind)}
        draft.time, draft.signals = f"log.{time}", tuple((f"log.{n}", unit) for n, unit in draft.signals)  # type: ignore[assignment]
        draft.needs("ask")
    return packed(np.savez, **columns)


def mat(draft: Draft, how: str) -> bytes:
    import scipy.io

    draft.signals = (("u_V", "V"), ("y_rad", "rad"))
    draft.time = {"s": "t_s", "ms": "t_ms", "us": "time_us", "ns": "t_ns", "min": "t_min"}[draft.unit]
    columns = {draft.time: draft.stamps(), "u_V": draft.u, "y_rad": draft.y}
    if how == "struct":
        columns = {"log": columns}
        draft.time, draft.signals = f"log.{draft.time}", (("log.u_V", "V"), ("log.y_rad", "rad"))
    elif how == "rows":
        draft.unit, draft.time = "s", "ans[0]"
        draft.needs("ask")
        columns, draft.signals = (
            {"ans": np.stack([draft.t, draft.u, draft.y])},
            (("ans[1]", ""), ("ans[2]", "")),
        )
    elif how == "complex":
        columns["y_rad"] = draft.y + 1j
        draft.needs("refuse")
    return packed(
        scipy.io.savemat, columns, do_compression=True, oned_as=str(draft.rng.choice(["row", "column"]))
    )


def hdf5(draft: Draft, how: str) -> bytes:
    import h5py

    (u, _), (y, _) = draft.signals = (("u_V", "V"), ("y_rad", "rad"))
    draft.time = {"s": "t_s", "ms": "t_ms", "us": "time_us", "ns": "t_ns", "min": "t_min"}[draft.unit]
    stream = io.BytesIO()
    with h5py.File(stream, "w", userblock_size=512 if how == "matlab" else 0) as file:
        columns = {draft.time: draft.stamps(), u: draft.u, y: draft.y}
        if how == "packed":
            raw = np.round(draft.y / 0.01).astype("i2")
            draft.y = raw * 0.01 + 2.5
            columns[y] = raw
        elif how == "filled":
            columns[y] = np.where(np.arange(len(draft.y)) == 7, -9999.0, draft.y)
            draft.needs("refuse")
        elif how == "epoch":
            columns = {"t_ns": integer_stamps(draft), u: draft.u, y: draft.y}
            draft.time = "t_ns"
        for name, values in columns.items():
            data = file.create_dataset(name, data=np.atleast_2d(values).T if how == "matlab" else values)
            if how == "matlab":
                data.attrs["MATLAB_class"] = np.bytes_("double")
        if how == "packed":
            file[y].attrs.update({"scale_factor": 0.01, "add_offset": 2.5})
        elif how == "filled":
            file[y].attrs["_FillValue"] = -9999.0
    mark = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" if how == "matlab" else b""
    return mark + stream.getvalue()[len(mark) :]


def parquet(draft: Draft, how: str) -> bytes:
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = frame(draft)
    if how == "ids":
        table["id"] = (2**60 + np.arange(len(table)) * 7919).astype(np.int64)
    elif how == "epoch":
        table.insert(0, "new", integer_stamps(draft, str(draft.rng.choice(["int64", "uint64"]))))
        table = table.drop(columns=table.columns[1]).rename(columns={"new": draft.time})
    elif how == "instants":
        draft.time = "when"
        when = pd.to_datetime(START + np.round(1e9 * draft.t).astype("m8[ns]"))
        table.insert(0, "when", when.tz_localize("UTC") if draft.rng.random() < 0.5 else when)
        table = table.drop(columns=table.columns[1])
    elif how == "gaps":
        table["temperature"] = np.where(np.arange(len(table)) % 5 == 0, 20.5, None)
    found = pa.Table.from_pandas(table, preserve_index=False)
    if how == "twice":
        found = found.append_column(draft.signals[1][0], pa.array(draft.y[::-1]))
        draft.needs("refuse")
    return packed(lambda stream: pq.write_table(found, stream))


def xlsx(draft: Draft, how: str) -> bytes:
    import openpyxl

    book = openpyxl.Workbook()
    sheet, table = book.active, frame(draft)
    if how == "hidden":
        sheet.sheet_state, rows = "hidden", frame(draft).to_numpy() * 3 + 1
        for row in [list(table.columns), *rows.tolist()]:
            sheet.append(row)
        sheet = book.create_sheet("Data")
    elif how == "preamble":
        for row in (["Logger", 3000], ["operator", "M. Huber"], []):
            sheet.append(row)
    elif how == "two sheets":
        draft.needs("refuse")
        other = book.create_sheet("run 2")
        for row in [list(table.columns), *(table.to_numpy() * [1, -1, 2]).tolist()]:
            other.append(row)
    rows = table.to_numpy().tolist()
    if how == "instants":
        draft.time, draft.dt_s = "when", max(draft.dt_s, 0.01)
        table = table.rename(columns={table.columns[0]: "when"})
        moments = (
            (START + np.round(1e9 * draft.dt_s * np.arange(len(rows))).astype("m8[ns]"))
            .astype("M8[us]")
            .astype(object)
        )
        rows = [[moment, *row[1:]] for moment, row in zip(moments, rows, strict=True)]
    for row in [list(table.columns), *rows]:
        sheet.append(row)
    if how == "a picture":
        book.create_chartsheet("figure")
    return packed(book.save)


def json_of(draft: Draft, how: str) -> bytes:
    table = frame(draft)
    if how == "columns":
        return json.dumps({name: list(values) for name, values in table.items()}).encode()
    if how == "rows":
        return table.to_json(orient="records").encode()
    lines = table.to_json(orient="records", lines=True)
    if how == "key twice":
        draft.needs("refuse")
        lines = re.sub(r"\}", lambda _: f', "{draft.signals[1][0]}": 7.0}}', lines)
    elif how == "true":
        draft.needs("refuse")
        lines = "\n".join(
            re.sub(r":[-\d.e]+\}", ":true}", x) if k % 9 == 4 else x for k, x in enumerate(lines.split("\n"))
        )
    return lines.encode()


WAYS: dict[str, tuple[Callable[[Draft, str], bytes], tuple[str, ...]]] = {
    "npz": (npz, ("plain", "epoch", "instants", "months", "complex", "float32", "columns", "rows", "fields")),
    "mat": (mat, ("plain", "struct", "rows", "complex")),
    "h5": (hdf5, ("plain", "packed", "filled", "epoch")),
    "parquet": (parquet, ("plain", "ids", "epoch", "instants", "gaps", "twice")),
    "xlsx": (xlsx, ("plain", "hidden", "preamble", "two sheets", "instants", "a picture")),
    "json": (json_of, ("columns", "rows")),
    "jsonl": (json_of, ("lines", "key twice", "true")),
}


def other_log(rng: Rng) -> Log:
    ending = str(rng.choice(list(WAYS)))
    write, hows = WAYS[ending]
    how = str(rng.choice(hows))
    if ending == "h5" and rng.random() < 0.3:
        ending, how = "mat", "matlab"
    draft = Draft.of(rng)
    content = write(draft, how)
    return draft.log(f"{ending}: {how}, {draft.time!r}", f"a.{ending}", content)


class Read(BaseException):
    """A command has read its log: here it would compute."""

    def __init__(self, record: Record) -> None:
        self.record = record


def _stop(logs: Any, **_: object) -> None:
    raise Read(logs.measured[0])


def told_by(arguments: Sequence[str]) -> tuple[Record | None, str]:
    """The record that a command goes on with, if it gets so far, and what it prints."""
    said = io.StringIO()
    with (
        mock.patch("workflow.commands.identify.identify_logs", _stop),
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("error")
        try:
            flexlink(list(arguments))
        except Read as read:
            return read.record, said.getvalue()
    return None, said.getvalue()


def pasted(said: str, log: Log, path: Path) -> list[str] | None:
    """The command that a refusal names, places to fill in filled; None where it names none."""
    truth = {"SECONDS": f"{log.dt_s!r}", "UNIT": log.unit, "TIME": log.names[0]}
    command = re.search(r"flexlink (identify .*)", said)
    words = shlex.split(command[1]) if command else []
    if not command:
        for option in re.findall(r"--[a-z][a-z-]+(?:[ =][A-Z_]+)?", said):
            words += option.split()
    if not words:
        return None
    fill = {
        "--input": log.names[1],
        "--output": log.names[2],
        "--time-unit": log.unit,
        "--dt-s": truth["SECONDS"],
    }
    done: list[str] = []
    for k, word in enumerate(words):
        if word in fill and (k + 1 == len(words) or words[k + 1].startswith("-")):
            done += [word, fill[word]]
        elif word in ("NAME", *truth) and done and done[-1] in fill:
            done.append(fill[done[-1]])
        else:
            done.append(truth.get(word, word))
    return done if command else ["identify", str(path), *done]


def same(record: Record, log: Log) -> str:
    """What differs from the truth; empty if nothing does."""
    if abs(record.dt_s - log.dt_s) > 2e-3 * log.dt_s:
        return f"dt {record.dt_s:g} s for {log.dt_s:g} s"
    for what, found, true in (("input", record.input, log.u), ("output", record.output, log.y)):
        if len(true) and (
            len(found) != len(true) or np.any(np.abs(found[:, 0] - true) > 1e-6 * (1 + np.abs(true)))
        ):
            return f"{what} {found[:3, 0]} for {true[:3]}"
    for found, true in zip((*record.input_units, *record.output_units), log.units, strict=False):
        if found not in ("", true):
            return f"unit {found} for {true}"
    return ""


def outcome(log: Log, folder: Path) -> tuple[str, str]:
    """What became of a log, and the words that say why."""
    path = folder / log.file
    path.write_bytes(log.content)
    record, said = told_by(["identify", str(path)])
    _, looked = told_by(["look", str(path)])
    first, followed = said, 0
    options: list[str] = []
    while record is None and followed < 3:
        again = pasted(said, log, path)
        if again is None:
            break
        options = [*options, *(word for word in again if word != "identify" and word != str(path))]
        record, said = told_by(["identify", str(path), *options])
        followed += 1
    first = first.strip().removeprefix("flexlink: 0 s: starting\n").replace(str(path), log.file)
    if record is None:
        if log.answer == "refuse":
            return "right", first
        return f"refused{', its hint does not help' if followed else ''}", first + (
            f" -> {' '.join(options)} -> {said}" if followed else ""
        )
    wrong = same(record, log)
    doubts = record.doubts
    if log.told and log.told not in looked:
        return "read wrongly without a word", f"`look` says nothing of '{log.told}'"
    if log.answer == "refuse" and not followed:
        return "read wrongly without a word", "read, though nobody can tell"
    if wrong and log.answer == "ask" and doubts:
        return "asked", ""
    if wrong:
        return (
            "read wrongly, doubt told" if doubts or followed else "read wrongly without a word"
        ), f"{wrong} {' '.join(options)} {first if followed else doubts}"
    if followed:
        return ("asked" if log.answer != "read" else "refused, the hint works"), first
    return "right", ""


def logs(seed: int, count: int) -> Iterator[Log]:
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        yield text_log(rng) if rng.random() < 0.65 else other_log(rng)


def run(
    out: Print, *, seed: int = 47, count: int = 1000, examples: int = 200, folder: str | None = None
) -> None:
    found: Counter[str] = Counter()
    shown: list[str] = []
    with tempfile.TemporaryDirectory(prefix="flexlink-") as name:
        for number, log in enumerate(logs(seed, count)):
            what, why = outcome(log, Path(name))
            found[what] += 1
            if what not in ("right", "asked"):
                shown.append(f"{what}: [{number}] {log.kind}: {why}")
                if folder:
                    (Path(folder) / f"{number}_{log.file}").write_bytes(log.content)
    out(f"{count} logs")
    for what, many in found.most_common():
        out(f"{what:<40}{many:6d}{many / count:9.1%}")
    for line in shown[:examples]:
        out(f"    {line[:600]}")


if __name__ == "__main__":
    main(run)
