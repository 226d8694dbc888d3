"""Logs of all kinds with their truth: sampling time, values and units as numpy, scipy, h5py, pyarrow,
openpyxl and json put them there. No line is shared with the reader; `benchmarks/log_oracle.py` reads a
thousand of them."""

import contextlib
import io
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import h5py
import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.io

PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1 / 60}
TIMES = {
    "s": "t_s|time_s|Time [s]|time (s)|Zeit in s|elapsed_s|t/s|time_sec|seconds|timeSeconds|t|time",
    "ms": "t_ms|Time [ms]|time (ms)|timeMs|time_millis|ms since start|millis|Zeit/ms|time ms|timestamp_ms|"
    "t [msec]|time［ms］|time [ms] rel|TIME_MS|time_milliseconds",
    "us": "t_us|Time [µs]|time (us)|timeUs|micros|time_micros|Zeit [μs]|timestamp_us|t [usec]|us since start",
    "ns": "t_ns|Time [ns]|timestamp_ns|timeNs|nanos|time_nanoseconds|time (ns)",
    "min": "t_min|Time [min]|minutes|time (minutes)|time_minutes",
}
SIGNALS = (
    "u_V y_rad V rad|voltage_V angle_deg V deg|Spannung~[V] Winkel~[°] V °|torque~(Nm) position~(mm) Nm mm|"
)
SIGNALS += "Strom~in~A Weg~in~mm A mm|cmd~[mV] ω~[rad/s] mV rad/s|u y  |"
# The last word of a name decides, not a letter at its front; long names are typed whole.
SIGNALS += "q_current y_position  |y_axis_torque y_axis_speed  |pwm v_wheel  |u_voltage x_angle  |"
SIGNALS += "Plant/Drive_Subsystem/Motor_Command_Left_V Plant/Sensor_Subsystem/Encoder_Angle_Left_rad V rad"
START = np.datetime64("2024-02-29T23:59:58.500", "ns")  # passes midnight, in a leap year
ANSWERS = ("read", "ask", "refuse")
MATLAB_MARK = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"  # before HDF5


class UnfitError(Exception):
    """A blemish that this table cannot have."""


@dataclass(eq=False)
class Log:
    """A file and what is in it. answer: "read"; "ask", where the file alone does not tell; "refuse". told: a
    word that `look` has to say. NaN in u or y: what a repair fills in. clock: unit of the first part of a
    clock time."""

    rng: np.random.Generator
    dt_s: float
    u: Any
    y: Any
    unit: str
    names: list[str]
    units: list[str]
    answer: str = "read"
    told: str = ""
    clock: str = ""
    reference: str = ""
    kind: str = ""
    file: str = ""
    content: bytes = b""
    # Of a text table.
    separator: str = ","
    decimal: str = "."
    header: list[str] = field(default_factory=list)
    rows: list[list[str]] = field(default_factory=list)
    above: list[str] = field(default_factory=list)
    between: dict[int, str] = field(default_factory=dict)
    below: list[str] = field(default_factory=list)
    under: list[str] = field(default_factory=list)
    last: str = ""
    end: str = "\n"

    @classmethod
    def of(cls, rng: np.random.Generator) -> Self:
        n, dt_s = int(rng.integers(60, 300)), float(rng.choice([5e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.1]))
        u, y = rng.choice([-2.5, 1.5, 3.0], n).repeat(3)[:n], np.round(np.cumsum(rng.normal(0, 0.3, n)), 6)
        unit = str(rng.choice(["s", "s", "ms", "ms", "us", "ns", "min"]))
        *names, first, second = str(rng.choice(SIGNALS.split("|"))).split(" ")
        named = [str(rng.choice(TIMES[unit].split("|"))), *(name.replace("~", " ") for name in names)]
        return cls(rng, dt_s, u, y, unit, named, [first, second])

    def needs(self, answer: str) -> None:
        self.answer = max(self.answer, answer, key=ANSWERS.index)

    @property
    def t(self) -> Any:
        return np.arange(len(self.u)) * self.dt_s

    @property
    def ns(self) -> Any:
        return np.round(1e9 * self.t).astype(np.int64)

    @property
    def stamps(self) -> Any:
        """In the unit of the time column, without the noise of binary fractions."""
        return np.round(self.t * PER_SECOND[self.unit], 9)

    @property
    def columns(self) -> dict[str, Any]:
        return dict(zip(self.names, (self.stamps, self.u, self.y), strict=True))

    def line(self, cells: Sequence[str]) -> str:
        quoted = [f'"{c}"' if self.separator in c else c for c in cells]
        return self.separator.join(quoted) + self.last

    def text(self) -> str:
        lines = [*self.above, *([self.line(self.header)] if self.header else []), *self.below]
        for k, row in enumerate(self.rows):
            lines += [*([self.between[k]] if k in self.between else []), self.line(row)]
        return self.end.join([*lines, *self.under]) + self.end


# Times of text tables.
def clock(log: Log, form: str) -> list[str]:
    log.names[0], log.unit = str(log.rng.choice(["time", "Uhrzeit", "timestamp", "Date"])), "s"
    if form == "mm:ss":
        log.clock = "min"
        return [f"{k // 60_000_000_000:02d}:{k // 1000 / 1e6 % 60:09.6f}" for k in log.ns.tolist()]
    log.clock = "h"
    return [moment.strftime(form) for moment in (START + log.ns).astype("M8[us]").astype(object)]


def epoch(log: Log, unit: str, names: str) -> list[str]:
    log.unit, log.names[0] = unit, str(log.rng.choice(names.split("|")))
    ns = (1_700_000_000_123_000_000 + log.ns).tolist()
    if unit == "s":
        return [f"{k // 10**9}.{k % 10**9 // 1000:06d}" for k in ns]
    log.dt_s = max(log.dt_s, 1 / PER_SECOND[unit])
    log.needs("ask" if log.names[0] in ("time", "timestamp") else "read")
    ns = (1_700_000_000_123_000_000 + log.ns).tolist()
    return [str(k // (10**9 // int(PER_SECOND[unit]))) for k in ns]


def with_unit(log: Log) -> list[str]:
    """The unit behind each number, as MATLAB writes a timetable."""
    words = {"s": "sec|s|seconds", "ms": "ms|msec", "us": "us|µs", "ns": "ns", "min": "min"}
    log.names[0] = str(log.rng.choice(["Time", "t", "elapsed"]))
    blank = "" if log.separator == " " else " "
    word = str(log.rng.choice(words[log.unit].split("|")))
    return [f"{x:.12g}{blank}{word}" for x in log.stamps]


def passed(log: Log) -> list[str]:
    """Timedeltas of pandas, or ISO 8601 durations."""
    log.names[0], log.unit, log.clock = "time", "s", "h"
    seconds = [(k // 10**9 % 60, k // 1000 % 10**6, k // (60 * 10**9)) for k in log.ns.tolist()]
    if log.rng.random() < 0.3:
        return [f"P0DT0H{m}M{s}.{us:06d}S" for s, us, m in seconds]
    return [f"0 days 00:{m:02d}:{s:02d}.{us:06d}" for s, us, m in seconds]


def timer(log: Log) -> list[str]:
    """A timer of 16 or 32 bits that starts again in the middle of the log."""
    bits, unit = (16, "ms") if log.rng.random() < 0.5 else (32, "us")
    log.unit, log.names[0] = unit, {"ms": "t_ms", "us": "micros"}[unit]
    log.dt_s = max(log.dt_s, 1 / PER_SECOND[unit])
    counts = np.round(log.t * PER_SECOND[unit]).astype(np.int64)
    log.told = "starts again"
    return [str(k) for k in (counts - counts[len(counts) // 2] + 2**bits) % 2**bits]


def unknown(log: Log) -> list[str]:
    """Milliseconds that nothing says are some."""
    log.unit, log.names[0] = "ms", str(log.rng.choice(["t", "time", "timestamp", "Zeit", "elapsed", "tick"]))
    log.dt_s = max(log.dt_s, 1e-3)
    log.needs("ask")
    return [f"{x:.0f}" for x in log.stamps]


STAMPS: dict[str, Callable[[Log], list[str]]] = {
    "numbers": lambda log: [f"{x:.12g}" for x in log.stamps],
    "unknown unit": unknown,
    "ISO": lambda log: clock(log, "%Y-%m-%dT%H:%M:%S.%f"),
    "ISO with a blank": lambda log: clock(log, "%Y-%m-%d %H:%M:%S.%f"),
    "day.month": lambda log: clock(log, "%d.%m.%Y %H:%M:%S.%f"),
    "hh:mm:ss": lambda log: clock(log, "%H:%M:%S.%f"),
    "mm:ss": lambda log: clock(log, "mm:ss"),
    "epoch s": lambda log: epoch(log, "s", "time|timestamp|__time|t_s"),
    "epoch ms": lambda log: epoch(log, "ms", "time_ms|timestamp|Time [ms]|time"),
    "epoch us": lambda log: epoch(log, "us", "timestamp_us|timestamp|time (us)"),
    "datetime of MATLAB": lambda log: clock(log, "%d-%b-%Y %H:%M:%S.%f"),
    "ctime": lambda log: clock(log, "%a %b %d %H:%M:%S.%f %Y"),
    "JavaScript": lambda log: clock(log, "%d/%m/%Y, %H:%M:%S.%f"),
    **{way.__name__: way for way in (with_unit, passed, timer)},
    "epoch ns": lambda log: epoch(log, "ns", "timestamp_ns|timestamp|time|Time [ns]"),
}


# Blemishes of text tables.
def comment(log: Log, *words: str) -> list[str]:
    sign = str(log.rng.choice(["#", "# ", "%", "% ", "// "]))
    return [sign + word for word in words]


def preamble(log: Log) -> None:
    log.above = ["Logger 3000", f"Operator{log.separator}M. Huber", "Sample rate 100 Hz", ""]


def comment_above(log: Log) -> None:
    log.above = comment(log, "made by a script", "arm 3, run 7")


def comment_names(log: Log) -> None:
    log.header[0] = comment(log, log.header[0])[0]


def comment_between(log: Log) -> None:
    words = str(log.rng.choice(["gripper closed", "restarted", "ok"]))
    (log.between[len(log.rows) // 2],) = comment(log, words)


def rows_out(log: Log) -> None:
    """Samples that somebody commented out, and wrote anew."""
    for k in range(5, len(log.rows), 40):
        (log.between[k],) = comment(log, log.line([log.rows[k][0], *("9" for _ in log.rows[k][1:])]))


def units_below(log: Log) -> None:
    if (
        log.answer != "read"
        or log.clock
        or not log.units[0]
        or (log.separator == " " and len(log.header) > 3)
    ):
        raise UnfitError  # clock times have none
    log.names = log.header[:3] = ["Time", "Drive", "Hub"]
    units = [log.unit, *log.units, *([""] * (len(log.header) - 3))]
    bracket = "[{}]" if log.rng.random() < 0.5 else "{}"
    log.below = [log.line([bracket.format(unit) if unit else "" for unit in units])]


def units_above(log: Log) -> None:
    units_below(log)
    log.above, log.below = [*log.above, *log.below], []


def thousands(log: Log) -> None:
    if log.separator in ", ":
        raise UnfitError
    digits = int(log.rng.choice([0, 2]))
    log.y = np.round(log.y * 400.0 + 1000.0, digits)
    for row, value in zip(log.rows, log.y, strict=True):
        row[2] = f"{value:,.{digits}f}".translate({} if log.decimal == "." else str.maketrans(",.", ".,"))
    log.needs("ask" if digits == 0 else "read")  # of 1,020 alone nobody knows what the comma is


def wrapped(log: Log) -> None:
    counts = np.cumsum(log.rng.integers(20, 90, len(log.y))) % 4096
    log.y, log.told = counts.astype(float), "wrap" if np.any(np.diff(counts) < 0) else ""
    log.names[2] = log.header[2] = "encoder_counts"
    log.units[1] = "counts"
    for row, value in zip(log.rows, counts, strict=True):
        row[2] = str(value)


def column(log: Log, name: str, cell: Callable[[int], str], answer: str = "read") -> None:
    if log.separator == " " and not cell(1):
        raise UnfitError
    log.header.append(name)
    for k, row in enumerate(log.rows):
        row.append(cell(k))
    log.needs(answer)


def hole(log: Log) -> None:
    words = ["", "nan", "NaN"] if log.separator != " " else ["nan"]
    log.rows[len(log.rows) // 3][2] = str(log.rng.choice(words))
    log.needs("refuse")


def lost_row(log: Log) -> None:
    k = len(log.rows) // 2
    del log.rows[k]
    log.u[k] = log.y[k] = np.nan
    log.needs("ask")


def later(log: Log, cell: str, share: float) -> str:
    if not cell[-1].isdigit():  # a unit
        raise UnfitError
    passed = share * log.dt_s * PER_SECOND[log.unit] + float(cell.replace(log.decimal, "."))
    return f"{passed:.9f}".replace(".", log.decimal)


def jitter(log: Log) -> None:
    if log.clock or len(log.rows[-1][0]) > 15:
        raise UnfitError
    for row, share in zip(log.rows, log.rng.uniform(0, 0.1, len(log.rows)), strict=True):
        row[0] = later(log, row[0], share)
    log.needs("ask")
    log.y = np.full(len(log.y), np.nan)  # read between the samples


def sparse(log: Log) -> None:
    """Input and output in rows of their own, as a recorder of messages writes them."""
    if (
        log.separator == " "
        or log.answer == "ask"
        or len(log.header) > 3
        or log.clock
        or len(log.rows[-1][0]) > 15
    ):
        raise UnfitError
    log.rows = [new for t, u, y in log.rows for new in ([t, u, ""], [later(log, t, 0.1), "", y])]
    log.u, log.y = np.empty(0), np.empty(0)
    log.needs("ask")


def outputs_only(log: Log) -> None:
    for row in (log.header, *log.rows):
        del row[1]
    log.needs("refuse")


def whole(log: Log) -> None:
    """Rows have to be those of the truth, and nothing to be said of them but of their timer."""
    if (
        log.answer == "refuse"
        or len(log.header) < 3
        or len(log.rows) != len(log.y)
        or np.any(np.isnan(log.y))
        or log.told not in ("", "starts again")
    ):
        raise UnfitError


def typeset_minus(log: Log) -> None:
    for row in log.rows:
        row[1:3] = [cell.replace("-", "\u2212") for cell in row[1:3]]


def bookkept(log: Log) -> None:
    """Negative numbers in brackets, or with the sign behind."""
    whole(log)
    form = str(log.rng.choice(["({})", "{}-"])) if log.units[0] != "%" else "({})"
    for row in log.rows:
        if any(cell.startswith("-") for cell in row[1:3]):
            log.told = "bookkeeping"
        row[1:3] = [form.format(cell[1:]) if cell.startswith("-") else cell for cell in row[1:3]]


def fortran(log: Log) -> None:
    whole(log)
    for row, value in zip(log.rows, log.y, strict=True):
        row[2] = f"{value:.9e}".replace("e", "D").replace(".", log.decimal)


def units_in_cells(log: Log) -> None:
    whole(log)
    if log.separator == " " or not log.units[0] or "/" in log.units[1]:
        raise UnfitError
    log.names[1:] = log.header[1:3] = ["drive", "hub"]
    for row in log.rows:
        row[1:3] = [f"{cell} {unit}" for cell, unit in zip(row[1:3], log.units, strict=True)]


def per_cent(log: Log) -> None:
    whole(log)
    log.names[1] = log.header[1] = "drive [%]"
    log.units[0] = "%"
    blank = str(log.rng.choice(["", " "])) if log.separator != " " else ""
    for row in log.rows:
        row[1] = f"{row[1]}{blank}%"


def none_there(log: Log) -> None:
    """A number for no reading, in the command or in the output."""
    whole(log)
    if any(not row[1][-1:].isdigit() for row in log.rows):  # a unit, or bookkeeping
        raise UnfitError
    code = float(log.rng.choice([-9999.0, 65535.0, 9999.0, 9.9e37]))
    column = int(log.rng.integers(1, 3))
    values = [log.u, log.y][column - 1]
    for k in log.rng.choice(np.arange(2, len(log.rows) - 2), 2, replace=False):
        values[k] = code
        log.rows[k][column] = f"{code:.12g}".replace(".", log.decimal)
    log.told = "reading?"


def grouped_counts(log: Log) -> None:
    """Whole numbers of four digits in groups, beside whole numbers: 1.500 may be one and a half."""
    if len(log.header) > 3 or any(re.search(r"[.,]", row[0]) for row in log.rows):
        raise UnfitError
    whole(log)
    log.u = np.round(2 * log.u)
    log.y = np.round(5000 + 100 * log.y).clip(1100, 9900)
    log.names[1:] = log.header[1:3] = ["drive", "encoder_counts"]
    log.units, log.decimal = ["", "counts"], ","
    for row, u, y in zip(log.rows, log.u, log.y, strict=True):
        row[1:3] = [f"{u:.0f}", f"{y:,.0f}".replace(",", ".")]
    log.needs("ask")


def words_under(log: Log) -> None:
    log.under = [str(log.rng.choice(["End of file", "stopped by operator", "ok"]))]


def units_under(log: Log) -> None:
    units_below(log)
    log.under, log.below = log.below, []
    log.told = log.told or "under the rows"


def loop(log: Log) -> None:
    """A closed loop with names that say nothing of which is the reference."""
    whole(log)
    if len(log.rows) < 150 or len(log.header) > 3:
        raise UnfitError
    n = len(log.rows)
    reference = np.round(log.rng.uniform(-5, 5, n // 25 + 1).repeat(25)[:n], 3)
    position = speed = 0.0
    for k in range(n):
        log.y[k] = round(position + 1e-4 * log.rng.normal(), 6)
        log.u[k] = round(0.4 * (reference[k] - log.y[k]) - 0.2 * speed, 6)
        speed += 0.3 * log.u[k] - 0.05 * speed
        position += speed
    names = str(log.rng.choice(["u y yr", "vir qm qg", "u_V x1_mm xr_mm", "torque theta theta_r"])).split(" ")
    *log.names[1:], log.reference = names
    log.header = [log.header[0], *names]
    log.units = ["V", "mm"] if names[0] == "u_V" else ["", ""]
    for row, *values in zip(log.rows, log.u, log.y, reference, strict=True):
        row[1:] = [f"{value:.9g}".replace(".", log.decimal) for value in values]


def sentence(log: Log) -> None:
    """A commented sentence above the rows and no names."""
    said = ["open loop, wheels free, battery full again", "Rig (12)", "pendulum rig, third run by hand"]
    words = str(log.rng.choice(said))
    sizes = {len(words.split(sign)) for sign in (" ", ",", ";", "\t", "|")}
    if (
        log.unit != "s"
        or len(log.header) in sizes
        or log.below
        or log.above
        or log.under
        or log.answer == "refuse"
    ):
        raise UnfitError
    log.above, log.header = comment(log, words), []
    log.names, log.reference = ["column 1", "column 2", "column 3"], ""
    log.needs("ask")


BLEMISHES: dict[str, Callable[[Log], object]] = {
    **{f.__name__: f for f in (preamble, comment_above, thousands, wrapped)},
    "words beside": lambda log: column(log, "note", lambda k: "ok"),
    "gaps beside": lambda log: column(log, "temperature [°C]", lambda k: "" if k % 5 else str(20 + k % 7)),
    "twice beside": lambda log: [column(log, "status", lambda k: str(k % 2)) for _ in "ab"],
    **{f.__name__: f for f in (units_below, units_above)},
    "twice": lambda log: column(log, log.header[2], lambda k: str(k % 3), "refuse"),
    **{f.__name__: f for f in (hole, lost_row, comment_names, jitter, comment_between, rows_out, sparse)},
    "outputs_only": outputs_only,
    **{f.__name__: f for f in (typeset_minus, fortran, units_in_cells, per_cent, none_there)},
    **{f.__name__: f for f in (bookkept, grouped_counts, words_under, units_under, loop, sentence)},
    "separators at the ends": lambda log: setattr(log, "last", log.separator.strip(" ")),
    "lines of Windows": lambda log: setattr(log, "end", "\r\n"),
}


def text_log(log: Log) -> None:
    rng = log.rng
    log.separator, log.decimal = str(rng.choice([",.", ";.", ";,", "\t.", "\t,", " .", "|."]))
    way = str(rng.choice(list(STAMPS), p=[0.55, *([0.45 / (len(STAMPS) - 1)] * (len(STAMPS) - 1))]))
    times = STAMPS[way](log)
    cells = ([time, *(f"{x:.9g}" for x in pair)] for time, *pair in zip(times, log.u, log.y, strict=True))
    log.rows = [[cell if ":" in cell else cell.replace(".", log.decimal) for cell in row] for row in cells]
    log.header = list(log.names)
    chosen = sorted(rng.permutation(len(BLEMISHES))[: int(rng.integers(0, 3))])
    said = [way]
    for name in (list(BLEMISHES)[k] for k in chosen):
        with contextlib.suppress(UnfitError):
            BLEMISHES[name](log)
            said.append(name)
    said.append(str(rng.choice(["utf-8", "utf-8", "utf-8-sig", "utf-16", "cp1252"])))
    try:
        log.content = log.text().encode(said[-1])
    except UnicodeEncodeError:
        log.content = log.text().encode()
    log.file = f"a.{rng.choice(['csv', 'txt', {'	': 'tsv'}.get(log.separator, 'dat')])}"
    log.kind = f"text {log.separator!r} {log.decimal} {log.names[0]!r} {' + '.join(said)}"


# Files that are no text.
def written(write: Callable[..., object], *arrays: object, **named: object) -> bytes:
    stream = io.BytesIO()
    write(stream, *arrays, **named)
    return stream.getvalue()


def renamed(log: Log, *names: str, units: Sequence[str] = ("V", "rad")) -> dict[str, Any]:
    log.names, log.units = list(names), list(units)
    return log.columns


def plain(log: Log) -> dict[str, Any]:
    return log.columns


def float32(log: Log) -> dict[str, Any]:
    log.u, log.y = log.u.astype("f4").astype(float), log.y.astype("f4").astype(float)
    return log.columns | {name: log.columns[name].astype("f4") for name in log.names[1:]}


def epoch_ns(log: Log) -> dict[str, Any]:
    log.unit, log.names[0] = "ns", str(log.rng.choice(["timestamp_ns", "t_ns", "stamp [ns]"]))
    stamps = (1_700_000_000_123_000_000 + log.ns).astype(str(log.rng.choice(["int64", "uint64"])))
    return {**log.columns, log.names[0]: stamps}


def instants(log: Log) -> dict[str, Any]:
    log.names[0] = "when"
    return {**log.columns, "when": START + log.ns.astype("m8[ns]")}


def months(log: Log) -> dict[str, Any]:
    """A calendar, no clock."""
    log.needs("refuse")
    log.names[0] = "when"
    return {**log.columns, "when": np.datetime64("2020-01") + np.arange(len(log.u))}


def complex_numbers(log: Log) -> dict[str, Any]:
    log.needs("refuse")
    name = log.names[int(log.rng.integers(1, 3))]
    return log.columns | {name: log.columns[name] + 0.5j}


def matrix(log: Log) -> dict[str, Any]:
    """(T, 3), or (3, T) as Simulink writes it; in seconds."""
    log.needs("ask")
    log.unit = "s"
    whole = np.column_stack(list(renamed(log, "ans[0]", "ans[1]", "ans[2]", units=("", "")).values()))
    return {"ans": whole if log.rng.random() < 0.5 else whole.T}


def fields(log: Log) -> dict[str, Any]:
    log.needs("ask")
    columns = log.columns
    rows = np.array(list(zip(*columns.values(), strict=True)), dtype=[(name, "f8") for name in columns])
    log.names = [f"log.{name}" for name in log.names]
    return {"log": rows}


def large_ids(log: Log) -> dict[str, Any]:
    return log.columns | {"id": 2**60 + 7919 * np.arange(len(log.u))}


def gaps(log: Log) -> dict[str, Any]:
    return log.columns | {"temperature": np.where(np.arange(len(log.u)) % 5, np.nan, 20.5)}


Columns = Callable[[Log], dict[str, Any]]


def npz(log: Log, columns: Columns) -> bytes:
    return written(np.savez, **columns(log))


def mat(log: Log, columns: Columns) -> bytes:
    renamed(log, f"t_{log.unit}", "u_V", "y_rad")
    found = columns(log)
    if columns is plain and log.rng.random() < 0.5:
        found, log.names = {"log": found}, [f"log.{name}" for name in log.names]
    way = str(log.rng.choice(["row", "column"]))
    return written(scipy.io.savemat, found, do_compression=bool(log.rng.random() < 0.5), oned_as=way)


def mat73(log: Log, columns: Columns) -> bytes:
    renamed(log, f"t_{log.unit}", "u_V", "y_rad")
    stream = io.BytesIO()
    with h5py.File(stream, "w", userblock_size=512) as file:
        for name, values in columns(log).items():
            file[name] = np.atleast_2d(values).T if log.rng.random() < 0.5 else np.atleast_2d(values)
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    return MATLAB_MARK + stream.getvalue()[len(MATLAB_MARK) :]


def hdf5(log: Log, columns: Columns) -> bytes:
    renamed(log, f"t_{log.unit}", "u_V", "y_rad")  # in a path / is a group
    found, stream, name = columns(log), io.BytesIO(), log.names[2]
    attributes: dict[str, Any] = {}
    match int(log.rng.integers(3)) if columns is plain else 0:
        case 1:
            found[name] = np.round(log.y / 0.01).astype("i2")
            log.y, attributes = found[name] * 0.01 + 2.5, {"scale_factor": 0.01, "add_offset": 2.5}
        case 2:
            found[name] = np.where(np.arange(len(log.y)) == 7, -9999.0, log.y)
            attributes = {"_FillValue": -9999.0}
            log.needs("refuse")
    with h5py.File(stream, "w") as file:
        for key, values in found.items():
            file[key] = values
        file[name].attrs.update(attributes)
    return stream.getvalue()


def parquet(log: Log, columns: Columns) -> bytes:
    table = pa.table(columns(log))
    if columns is plain and log.rng.random() < 0.3:
        table = table.append_column(log.names[2], pa.array(log.y[::-1]))
        log.needs("refuse")
    return written(lambda stream: pq.write_table(table, stream))


def xlsx(log: Log, columns: Columns) -> bytes:
    found = columns(log)
    rows = [list(found), *zip(*(values.tolist() for values in found.values()), strict=True)]
    other = [rows[0], *([3 * x + 1 for x in row] for row in rows[1:])]
    book, more = openpyxl.Workbook(), int(log.rng.integers(8))
    form = {5: "0.0 %", 7: "0.000,"}.get(more, "General")
    if more == 5:
        rows[0][1], log.names[1], log.units[0] = "drive [%]", "drive [%]", "%"
        log.u = np.array([float(f"{100 * x:.9g}") for x in log.u])
    if more == 6:  # by a program that computes nothing
        rows[1:] = [[t, f"=3*A{k}", y] for k, (t, _, y) in enumerate(rows[1:], 2)]
        log.needs("refuse")
    if more == 7:
        rows[0][1], log.names[1], log.units[0] = "force [kN]", "force [kN]", "kN"
        log.u = log.u / 1000.0
    if more == 1:
        book.active.sheet_state = "hidden"
    if more == 2:
        log.needs("refuse")  # which of two sheets nobody can tell
    if more == 3:
        book.create_chartsheet("figure")
    for row in other if more in (1, 2) else []:
        book.active.append(row)
    sheet = book.create_sheet("Data")
    for row in [*([["Logger", 3000], ["operator", "M. Huber"], []] if more == 4 else []), *rows]:
        sheet.append(row)
    for (cell,) in sheet.iter_rows(min_row=2, min_col=2, max_col=2):
        cell.number_format = form
    return written(book.save)


def json_text(log: Log, columns: Columns) -> bytes:
    table = {name: values.tolist() for name, values in columns(log).items()}
    return json.dumps(table if log.rng.random() < 0.5 else json_rows(table)).encode()


def json_rows(table: dict[str, Any]) -> list[dict[str, Any]]:
    return [dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)]


def json_lines(log: Log, columns: Columns) -> bytes:
    lines = [json.dumps(row) for row in json_rows({k: v.tolist() for k, v in columns(log).items()})]
    match int(log.rng.integers(5)):
        case 0:
            lines = [f'{line[:-1]}, "{log.names[2]}": 7.0}}' for line in lines]
            log.needs("refuse")  # two values of one name
        case 1:
            lines[4] = re.sub(r": [^:]*$", ": true}", lines[4])
            log.needs("refuse")
    return "\n".join(lines).encode()


WAYS: dict[str, tuple[Callable[[Log, Columns], bytes], tuple[Columns, ...]]] = {
    "npz": (npz, (plain, float32, epoch_ns, instants, months, complex_numbers, matrix, fields, large_ids)),
    "mat": (mat, (plain, matrix, complex_numbers)),
    "7.3.mat": (mat73, (plain,)),
    "h5": (hdf5, (plain, plain, float32, epoch_ns, large_ids)),
    "parquet": (parquet, (plain, float32, epoch_ns, instants, large_ids, gaps)),
    "xlsx": (xlsx, (plain,)),
    "json": (json_text, (plain, epoch_ns, large_ids)),
    "jsonl": (json_lines, (plain,)),
}


def other_log(log: Log) -> None:
    ending = str(log.rng.choice(list(WAYS)))
    write, columns = WAYS[ending]
    way = columns[int(log.rng.integers(len(columns)))]
    log.file, log.content = f"a.{ending}", write(log, way)
    log.kind = f"{ending} {way.__name__} {log.names[0]!r} {log.answer}"


def generated(seed: int, number: int, text_share: float = 0.65) -> Log:
    log = Log.of(np.random.default_rng([seed, number]))
    (text_log if log.rng.random() < text_share else other_log)(log)
    return log
