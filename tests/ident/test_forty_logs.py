"""Forty logs as laboratories send them: each is read rightly, or refused with the hint that helps.

All hold the same experiment: 60 samples, u = +-1.5 V, y = 0.125 k rad, every 0.01 s unless said otherwise.
"""

import gzip
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import mcap.writer
import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from ident.data.record import Record
from tests.ident.generated_logs import MATLAB_MARK, written

N, DT_S = 60, 0.01
K = np.arange(N)
T_S, U, Y = DT_S * K, 1.5 * (-1.0) ** (K // 3), 0.125 * K
START = datetime(2024, 2, 29, 23, 59, 59, 800_000)  # passes midnight, in a leap year


@dataclass(frozen=True)
class Log:
    """name of the file, its bytes, how it is read, and what comes out: a sampling time, or words."""

    file: str
    content: bytes | Callable[[], bytes]
    columns: tuple[str, str, str] = ("t_s", "u_V", "y_rad")
    options: dict[str, Any] = field(default_factory=dict)
    dt_s: float = DT_S
    dt_error_s: float = 1e-12
    refused: tuple[str, ...] = ()
    units: tuple[str, str] = ("V", "rad")


def text(
    separator=",",
    decimal=".",
    header=("t_s", "u_V", "y_rad"),
    time=lambda t: f"{t:.3f}",
    *,
    y=Y,
    above=(),
    below=(),
    end="\n",
    last="",
    keep=K,
    cells=lambda row: row,
    encoding="utf-8",
) -> bytes:
    """A table of the experiment; cells changes the words of a row."""
    rows = [[time(T_S[k]), f"{U[k]:.1f}", f"{y[k]:.9g}"] for k in keep]
    numbers = [[cell if "24 " in cell else cell.replace(".", decimal) for cell in row] for row in rows]
    lines = [*above, separator.join(header) + last] if header else list(above)
    lines += [*below, *(separator.join(cells(row)) + last for row in numbers)]
    return (end.join(lines) + end).encode(encoding)


def clock(form: str) -> Callable[[float], str]:
    return lambda t: (START + timedelta(seconds=round(t, 6))).strftime(form)[:-3]


def npz(**arrays) -> bytes:
    return written(np.savez, **arrays)


def mat(**variables) -> bytes:
    return written(scipy.io.savemat, variables, do_compression=True)


def sheet(*rows) -> bytes:
    book = openpyxl.Workbook()
    book.create_sheet("Data")
    for row in rows:
        book.worksheets[1].append(row)
    return written(book.save)


def parquet(units=("", "", ""), **columns) -> bytes:
    arrays = [pa.array(values) for values in columns.values()]
    fields = [
        pa.field(name, array.type, metadata={"unit": unit})
        for name, array, unit in zip(columns, arrays, units, strict=False)
    ]
    return written(lambda stream: pq.write_table(pa.table(arrays, pa.schema(fields)), stream))


def hdf5(matlab=False, **datasets) -> bytes:
    """Datasets, in the way of MATLAB 7.3 if asked: behind a block of text, transposed, with their class."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=512 if matlab else 0) as file:
        for name, values in datasets.items():
            data = file.create_dataset(
                name.replace("__", "/"), data=np.atleast_2d(values) if matlab else values
            )
            if matlab:
                data.attrs["MATLAB_class"] = np.bytes_("double")
            elif name.endswith("tip"):
                data.attrs["unit"] = "mm"
    mark = MATLAB_MARK if matlab else b""
    return mark + buffer.getvalue()[len(mark) :]


def bag(kind: str, delay_s: float = 0.0) -> Callable[[], bytes]:
    """Joint states at 100 Hz, and voltages sent `delay_s` before every third, as a recorder writes them."""

    def write() -> bytes:
        store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
        types = store.types
        state, number = types["sensor_msgs/msg/JointState"], types["std_msgs/msg/Float64"]
        stamp, head = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
        with TemporaryDirectory() as folder:
            path, ros1 = Path(folder) / "run.bag", kind == "bag"
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            with (
                rosbag1.Writer(path)
                if ros1
                else rosbag2.Writer(path, version=9, storage_plugin=plugin) as out
            ):
                states = out.add_connection("/arm/joint_states", state.__msgtype__, typestore=store)
                voltages = out.add_connection("/voltage", number.__msgtype__, typestore=store)
                write = store.serialize_ros1 if ros1 else store.serialize_cdr
                for k in K:
                    at_ns = 1_700_000_000_000_000_000 + round(1e9 * T_S[k])
                    if k % 3 == 0:
                        sent_ns = at_ns - round(1e9 * delay_s)
                        out.write(voltages, sent_ns, write(number(U[k]), number.__msgtype__))
                    when = stamp(sec=at_ns // 10**9, nanosec=at_ns % 10**9)
                    header = head(k, when, "") if ros1 else head(when, "")
                    angle, none = np.array([1.0, Y[k]]), np.zeros(0)
                    message = state(header, ["fixed", "hub"], angle, none, none)
                    # What comes over the network comes late, by up to 4 ms.
                    out.write(states, at_ns + int(1e6 * (k % 5)), write(message, state.__msgtype__))
            return (path if ros1 else next(path.glob(f"*.{kind}"))).read_bytes()

    return write


def mcap_of(encoding="json", schema="jsonschema") -> bytes:
    stream = io.BytesIO()
    writer = mcap.writer.Writer(stream)
    writer.start()
    about = writer.register_schema("Arm", schema, b"{}")
    topic = writer.register_channel("/arm", encoding, about)
    for t, u, y in zip(T_S, U, Y, strict=True):
        at_ns = round(1e9 * t)
        data = json.dumps({"drive": {"u_V": u}, "pose": [y, 0.0], "note": "ok"}).encode()
        writer.add_message(topic, at_ns, data, at_ns)
    writer.finish()
    return stream.getvalue()


def monitor(line: Callable[[int], str], *above: str) -> bytes:
    return "\n".join([*above, *map(line, K), ""]).encode()


def plc(stamp: Callable[[int], str], other: Callable[[int], str] | None = None) -> bytes:
    said = {"Name": ("fTorqueSet", "fActPos"), "SampleTime[ms]": ("10", "10"), "Unit": ("(Nm)", "(rad)")}
    head = [f"{key}\t{one}\t{key}\t{two}" for key, (one, two) in said.items()]
    rows = [f"{stamp(k)}\t{U[k]}\t{(other or stamp)(k)}\t{Y[k]}" for k in K]
    return "\r\n".join(["Name\tA project", "", *head, "", *rows, ""]).encode()


def recorder(data: str) -> bytes:
    signals = [{"Name": "voltage_V", data: U}, {"Name": "hub", data: Y, "Unit": "rad"}]
    return mat(rec={"X": {"Name": "time", data: T_S}, "Y": np.array(signals, dtype=object), "n": 60.0})


SERIAL, NAMED = ("time", "column 1", "column 2"), ("millis", "volt", "angle")
STATES = ("arm/joint_states.time", "voltage.data", "arm/joint_states.position[1]")
PREAMBLE = ("Logger 3000;v1.2", "Operator;M. Huber", "Sample rate;100", "")
LOST = np.delete(K, [20])
JITTER = 1e-3 * np.random.default_rng(4).uniform(-0.5, 0.5, N)
LOGS = {
    # Separators and numbers.
    "commas": Log("a.csv", text()),
    "semicolons, decimal commas": Log("a.csv", text(";", ",")),
    "semicolons, decimal points": Log("a.csv", text(";")),
    "tabs": Log("a.txt", text("\t")),
    "tabs, decimal commas": Log("a.tsv", text("\t", ",")),
    "blanks": Log("a.dat", text("   ")),
    "bars": Log("a.txt", text("|")),
    "exponents": Log("a.csv", text(time=lambda t: f"{t:.4E}")),
    "separators at the ends of lines": Log("a.csv", text(";", ",", last=";")),
    "blanks around commas": Log("a.csv", text(" , ")),
    # Characters.
    "UTF-8 with its mark": Log("a.csv", b"\xef\xbb\xbf" + text()),
    "UTF-16": Log("a.csv", text("\t", encoding="utf-16")),
    "code page of Windows": Log(
        "a.csv",
        text(
            ";", header=("Zeit [µs]", "u_V", "Winkel [°]"), time=lambda t: f"{1e6 * t:.0f}", encoding="cp1252"
        ),
        ("Zeit [µs]", "u_V", "Winkel [°]"),
        units=("V", "°"),
    ),
    "lines of Windows, blank ones at the end": Log("a.csv", text(end="\r\n") + b"\r\n\r\n"),
    # What stands above the numbers.
    "preamble": Log("a.csv", text(";", ",", above=PREAMBLE)),
    "sep=; of a spreadsheet": Log("a.csv", text(";", ",", above=("sep=;",))),
    "line of units": Log(
        "a.csv",
        text(header=("Time", "Drive", "Hub"), below=("ms,V,rad",), time=lambda t: f"{1e3 * t:.0f}"),
        ("Time", "Drive", "Hub"),
    ),
    "preamble, line of units in brackets, blank line": Log(
        "a.txt",
        text("\t", header=("Time", "Drive", "Hub"), above=("Channels: 3", ""), below=("[s]\t[V]\t[rad]", "")),
        ("Time", "Drive", "Hub"),
    ),
    "line of units, none of the last columns": Log(
        "a.csv",
        text(
            header=("Time", "Drive", "Hub", "n", "ok"),
            below=("s,V,rad,,",),
            cells=lambda row: [*row, "3", "1"],
        ),
        ("Time", "Drive", "Hub"),
    ),
    "names and numbers in quotation marks": Log(
        "a.csv",
        text(",", ",", ('"t, s"', '"u_V"', '"y_rad"'), cells=lambda row: [f'"{cell}"' for cell in row]),
        ("t, s", "u_V", "y_rad"),
        {"time_unit": "s"},
    ),
    "names behind a comment sign": Log(
        "a.txt", text(" ", above=("# made by a script",), header=("# t_s", "u_V", "y_rad"))
    ),
    "names of several words over blanks": Log(
        "a.dat",
        text("   ", header=("Elapsed time [s]", "Motor voltage [V]", "Hub angle [rad]")),
        ("Elapsed time [s]", "Motor voltage [V]", "Hub angle [rad]"),
    ),
    "words in another column": Log(
        "a.csv", text(header=("t_s", "u_V", "y_rad", "note"), cells=lambda row: [*row, "ok"])
    ),
    # Time.
    "ISO 8601 with a zone": Log("a.csv", text(time=clock("%Y-%m-%dT%H:%M:%S.%f0Z+"))),
    "day.month.year": Log("a.csv", text(";", ",", time=clock("%d.%m.%Y %H:%M:%S.%f"))),
    "month/day/year with PM": Log(
        "a.csv", text(time=lambda t: f"{clock('%m/%d/%Y %I:%M:%S.%f')(t)} {clock('%p+++')(t)}")
    ),
    "clock times through midnight": Log("a.csv", text(time=clock("%H:%M:%S.%f"))),
    "128 Hz rounded to milliseconds": Log(
        "a.csv", text(time=lambda t: f"{t / DT_S / 128:.3f}"), dt_s=1 / 128, dt_error_s=1e-3 / (N - 1)
    ),
    "a lost row": Log(
        "a.csv",
        text(keep=LOST),
        refused=("line 22", "steps by 0.02 s", "rows missing: 1 of 60: --repair (repair = true)"),
    ),
    "a lost row, repaired": Log("a.csv", text(keep=LOST), options={"repair": True}),
    "jitter, repaired": Log(
        "a.csv",
        text(time=lambda t: f"{t + JITTER[round(t / DT_S)]:.6f}", y=12.5 * (T_S + JITTER)),
        dt_error_s=1e-3 / (N - 1),
        options={"repair": True},
    ),
    # What cannot be told, and is said so.
    "no names": Log(
        "a.csv", text(header=()), refused=("column 1, column 2, column 3", "expected column names in line 1")
    ),
    "decimal commas between commas": Log(
        "a.csv",
        text(",", ","),
        refused=("line 2: 5 cells where line 1 has 3", "separate the columns by semicolons"),
    ),
    "a word among the numbers": Log(
        "a.csv",
        text(
            cells=lambda row: [*row[:2], row[2].replace("0.25", "overflow") if row[2] == "0.25" else row[2]]
        ),
        refused=("line 4: column 'y_rad' is 'overflow'; expected a finite number",),
    ),
    "day or month": Log(
        "a.csv",
        text(time=lambda t: f"{'02/03/2024' if t < 0.2 else '03/03/2024'} 12:00:00"),
        refused=("day/month or month/day",),
    ),
    # Packed and binary files.
    "packed by gzip": Log("a.csv.gz", gzip.compress(text(";", ","))),
    "npz, a matrix": Log(
        "a.npz", npz(t_s=T_S, log=np.column_stack([U, Y])), ("t_s", "log[0]", "log[1]"), units=("", "")
    ),
    "npz with Python objects": Log(
        "a.npz",
        npz(t_s=T_S, u_V=U, y_rad=np.array([{}] * N)),
        refused=("'y_rad' holds Python objects; expected arrays of numbers",),
    ),
    "MATLAB 5": Log("a.mat", mat(t_s=T_S, u_V=U, y_rad=Y)),
    "MATLAB 5, structs, offset and scale": Log(
        "a.mat",
        mat(log={"time": T_S, "signals": {"u_V": U, "deg": np.rad2deg(Y) - 3.0}}),
        ("log.time", "log.signals.u_V", "log.signals.deg"),
        {
            "scale": {"log.signals.deg": np.pi / 180},
            "offset": {"log.signals.deg": np.pi / 60},
            "units": {"log.signals.deg": "rad"},
        },
    ),
    "a spreadsheet": Log(
        "a.xlsx",
        sheet(["t_s", "u_V", "y_rad"], *([float(t), u, y] for t, u, y in zip(T_S, U, Y, strict=True))),
    ),
    "a spreadsheet with preamble, units and dates": Log(
        "a.xlsx",
        sheet(
            ["Logger", 3000],
            [],
            ["Date", "Drive", "Hub"],
            ["", "[V]", "[rad]"],
            *([START + timedelta(seconds=t), u, y] for t, u, y in zip(T_S, U, Y, strict=True)),
        ),
        ("Date", "Drive", "Hub"),
        dt_error_s=1e-4,  # a spreadsheet keeps days as doubles, and shows milliseconds
    ),
    "parquet": Log(
        "a.parquet",
        parquet(("", "V", ""), t_s=T_S, drive=U, y_rad=Y.astype(np.float32)),
        ("t_s", "drive", "y_rad"),
    ),
    "HDF5 with groups and attributes": Log(
        "a.h5",
        hdf5(arm__t_s=T_S, arm__u_V=U, arm__tip=Y),
        ("arm/t_s", "arm/u_V", "arm/tip"),
        units=("V", "mm"),
    ),
    "MATLAB 7.3": Log(
        "a.mat",
        hdf5(True, log__t_s=T_S, log__uy=np.stack([U, Y])),
        ("log.t_s", "log.uy[0]", "log.uy[1]"),
        units=("", ""),
    ),
    "MCAP of ROS 2, two topics": Log("a.mcap", bag("mcap", 1e-4), STATES, dt_error_s=1e-9, units=("", "")),
    "ROS 2 bag": Log("a.db3", bag("db3", 1e-4), STATES, dt_error_s=1e-9, units=("", "")),
    "ROS 1 bag": Log("a.bag", bag("bag", 1e-4), STATES, dt_error_s=1e-9, units=("", "")),
    "MCAP of JSON": Log("a.mcap", mcap_of(), ("arm.time", "arm.drive.u_V", "arm.pose[0]"), units=("V",)),
    "MCAP nobody can read": Log(
        "a.mcap", mcap_of("protobuf", "protobuf"), refused=("no messages that can be read; expected CDR",)
    ),
    "a cut ROS 1 bag": Log(
        "a.bag", lambda: bag("bag")()[:3000], refused=("a.bag: not a bag file, or a damaged one",)
    ),
    "a spreadsheet that is none": Log(
        "a.xlsx", text(), refused=("a.xlsx: not a xlsx file, or a damaged one",)
    ),
    "a spreadsheet of 1997": Log(
        "a.xls", b"\xd0\xcf\x11\xe0" + bytes(600), refused=("unknown kind of file '.xls'", ".csv")
    ),
}


# What tools for boards, PLCs and rapid prototyping write; lists in cells; tables that lie on their side.
PLC, NONE = ("time", "fTorqueSet", "fActPos"), ("", "")
LOGS |= {
    "serial monitor": Log("a.txt", monitor(
        lambda k: f"{clock('%H:%M:%S.%f')(T_S[k])} -> {U[k]:.2f},{Y[k]:.6f}"), SERIAL, units=NONE),
    "serial monitor, a word first, brackets, blanks": Log("a.txt", monitor(
        lambda k: f"[2024-03-01 12:00:{T_S[k]:06.3f}] {U[k]:.2f} {Y[k]:.6f}", "Ready"), SERIAL, units=NONE),
    "serial monitor, names, decimal commas": Log("a.txt", monitor(
        lambda k: f"12:00:{T_S[k]:06.3f} -> " + f"{U[k]:.2f};{Y[k]:.6f}".replace(".", ","),
        "12:00:00.000 -> u_V;y_rad"), ("time", "u_V", "y_rad")),
    "serial plotter": Log("a.txt", monitor(
        lambda k: f"millis:{1e3 * T_S[k]:.0f}\tvolt:{U[k]:.2f}\tangle:{Y[k]:.6f}"), NAMED, units=NONE),
    "serial plotter behind a monitor": Log("a.txt", monitor(
        lambda k: f"12:00:{T_S[k]:06.3f} -> volt:{U[k]:.2f} angle:{Y[k]:.6f}", "12:00:00.000 -> boot ok"),
        ("time", "volt", "angle"), units=NONE),
    "names and equal signs": Log("a.txt", monitor(
        lambda k: f"millis={10 * k}, volt = {U[k]:.2f}, angle = {Y[k]:.6f}", "a b", "c"), NAMED, units=NONE),
    "scope of a PLC": Log("a.txt", plc(lambda k: f"{10 * k}"), PLC, units=("Nm", "rad")),
    "scope of a PLC in seconds": Log("a.csv", plc(lambda k: f"{T_S[k]:.2f}"), PLC, units=("Nm", "rad")),
    "scope of a PLC, times apart": Log("a.txt", plc(lambda k: f"{10 * k}", lambda k: f"{10 * k + 1}"),
        refused=("'#1 time' and '#2 time' differ",)),
    "recorder": Log("a.mat", recorder("Data"), ("time", "voltage_V", "hub")),
    "recorder, in other words": Log("a.mat", recorder("values"), ("time", "voltage_V", "hub")),
    "Octave text": Log("a.mat", b"# Created by Octave 8.4.0\n# name: t\n# type: matrix\n 0 1\n",
        refused=("save -v7",)),
    "Octave text, cut": Log("a.txt", b"# name: t\r\n# type: matrix\r\n 0 1\r\n", refused=("save -v7",)),
    "parquet with instants": Log("a.parquet", parquet(
        when=np.datetime64("2024-02-29T23:59:59.9") + (1e9 * T_S).round().astype("m8[ns]"), u_V=U, y_rad=Y),
        ("when", "u_V", "y_rad")),
    "tabs, blanks in the dates, comments of as many words": Log("a.tsv", text(
        "\t", above=("# made by a script",), time=lambda t: clock("%Y-%m-%d %H:%M:%S.%f")(t))),
    "parquet with lists": Log("a.parquet", parquet(
        t_s=T_S, action=list(zip(U, Y, strict=True)), image=[[1.0] * (k % 3) for k in K]),
        ("t_s", "action[0]", "action[1]"), units=NONE),
    "parquet with structs of lists": Log("a.parquet", parquet(
        t_s=T_S, arm=[{"u_V": u, "q": [[0.0, y]]} for u, y in zip(U, Y, strict=True)]),
        ("t_s", "arm.u_V", "arm.q[0][1]"), units=("V",)),
    "parquet, lists of several lengths": Log("a.parquet", parquet(
        t_s=T_S, u_V=U, y_rad=[[1.0] * (1 + k % 3) for k in K]),
        refused=("column 'y_rad' holds lists of 1 to 3 entries; expected one length",)),
    "lists in cells": Log("a.csv", text(
        header=("t_s", "u_V", "q"), cells=lambda row: [row[0], row[1], f'"[ 0.5, {row[2]}]"']),
        ("t_s", "u_V", "q[1]"), units=("V",)),
    "lists of several lengths in cells": Log("a.csv", text(
        cells=lambda row: [row[0], row[1], f'"[{row[2]}{" 1" if row[2] == "0" else ""}]"']),
        refused=("'y_rad' holds lists of 1 to 2 entries",)),
    "columns for rows": Log("a.csv", b",".join([b"x"] * 10**5) + b"\n" + b",".join([b"1"] * 10**5),
        refused=("line 1: 100000 cells; expected at most 4096",)),
    "a line of a million numbers": Log("a.dat", b"1 " * 10**6, refused=("1000000 cells; expected at most",)),
    "a million commas": Log("a.csv", text(below=("," * 10**6,))),
    "arrays of too many names": Log("a.npz", npz(**{f"c{k}": T_S[:2] for k in range(5000)}),
        refused=("5000 columns; expected at most 4096",)),
}  # fmt: skip


# A process each for what other logs of their kind hold too, test_other_logs.py (times of parquet) and
# test_hostile_logs.py (damaged files).
FURTHER = (
    "parquet with instants",
    "parquet with lists",
    "parquet, lists of several lengths",
    "a cut ROS 1 bag",
    "a spreadsheet that is none",
    "recorder, in other words",
)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long) if name in FURTHER else name for name in LOGS]
)
def test_forty_logs(name, tmp_path: Path):
    log, path = LOGS[name], tmp_path / LOGS[name].file
    path.write_bytes(log.content if isinstance(log.content, bytes) else log.content())
    time, input_, output = log.columns

    def read():
        return Record.from_file(path, [input_], [output], time=time, **log.options)

    if log.refused:
        with pytest.raises(ValueError) as caught:
            read()
        line = str(caught.value)
        assert line.startswith(str(path))
        assert "\n" not in line
        assert len(line) - len(str(path.parent)) <= 300
        for words in log.refused:
            assert words in line
        return
    record = read()
    assert record.dt_s == pytest.approx(log.dt_s, rel=0, abs=log.dt_error_s)
    if record.repair:
        # A spline leaves a line as it is. The phase of the grid is that of the mean stamp, at the ends known
        # to twice its deviation: 1 ms / sqrt(12 N), times three; 12.5 rad/s.
        np.testing.assert_allclose(record.output[:, 0], Y, rtol=0, atol=12.5 * 6e-3 / np.sqrt(12 * N))
    else:
        np.testing.assert_allclose(record.input[:, 0], U, rtol=1e-12)
        np.testing.assert_allclose(record.output[:, 0], Y, rtol=1e-12, atol=1e-12)
    found = (*record.input_units, *record.output_units) or ("", "")
    assert found == log.units
