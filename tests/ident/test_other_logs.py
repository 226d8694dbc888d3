"""Logs that are no text: values that numpy, h5py, pyarrow, openpyxl, json or scipy wrote, or a refusal."""

import io
import json
import resource
import struct
import subprocess
import sys

import h5py
import numpy as np
import openpyxl
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io

import flexlink
from ident.data import foreign_files
from ident.data.mat_files import mat_variables
from ident.data.record import Record
from ident.data.record_files import read_table

N = 40
K = np.arange(N)
U, Y = (-1.0) ** (K // 4), 0.25 * K - 3.0
EPOCH_NS = 1_700_000_000_123_456_789


def written(path, write, *arrays, **named):
    stream = io.BytesIO()
    write(stream, *arrays, **named)
    path.write_bytes(stream.getvalue())
    return path


def as_hdf5(path, columns, **attributes):
    """Columns, and by their names the attributes of some."""
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name] = values
        for name, of_column in attributes.items():
            file[name].attrs.update(of_column)
    return path


def as_parquet(path, names, *columns):
    return written(path, lambda stream: pq.write_table(pa.table(list(columns), names=names), stream))


def as_sheets(path, *sheets):
    """(title, state, rows)"""
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, state, rows in sheets:
        sheet = book.create_sheet(title)
        sheet.sheet_state = state
        for row in rows:
            sheet.append(row)
    return book, written(path, book.save)


def record(path, u="u_V", y="y_rad", time="t_s", **options):
    return Record.from_file(path, [u], [y], time=time, **options)


def holds(path, *, u=U, y=Y, dt_s=0.01, names=("t_s", "u_V", "y_rad")):
    time, first, second = names
    found = record(path, first, second, time)
    assert found.dt_s == pytest.approx(dt_s, rel=1e-9)
    np.testing.assert_allclose(found.input[:, 0], u, rtol=1e-12)
    np.testing.assert_allclose(found.output[:, 0], y, rtol=1e-12)


@pytest.mark.parametrize("shape", [(3, 1000), (3, 100), (1000, 3)])
def test_a_matrix_is_offered_by_its_signals(tmp_path, shape):
    """Simulink's "To File" writes time, input and output as three rows."""
    rows = np.vstack([0.01 * np.arange(max(shape)), np.ones(max(shape)), np.sin(np.arange(max(shape)))])
    path = written(tmp_path / "a.npz", np.savez, ans=rows if shape[0] == 3 else rows.T)
    assert read_table(path).names == ("ans[0]", "ans[1]", "ans[2]")
    holds(path, u=rows[1], y=rows[2], names=("ans[0]", "ans[1]", "ans[2]"))


@pytest.mark.parametrize(
    ("dtype", "step_ns"), [("int64", 1_000), pytest.param("uint64", 250_000, marks=pytest.mark.long)]
)
def test_nanoseconds_since_1970_keep_their_digits(tmp_path, dtype, step_ns):
    """As doubles they are multiples of 256."""
    stamps = (EPOCH_NS + step_ns * K).astype(dtype)
    names, path = ("t_ns", "u_V", "y_rad"), tmp_path / "a.parquet"
    holds(as_parquet(path, [*names], stamps, U, Y), dt_s=1e-9 * step_ns, names=names)
    path = written(tmp_path / "a.npz", np.savez, t_ns=stamps, u_V=U, y_rad=Y)
    holds(path, dt_s=1e-9 * step_ns, names=names)
    with pytest.raises(ValueError, match="expected increasing time"):
        record(written(tmp_path / "b.npz", np.savez, t_ns=stamps[::-1], u_V=U, y_rad=Y), time="t_ns")


def test_parquet_has_many_times_and_numbers(tmp_path):
    """Beside them a number that no double holds."""
    times = {
        "durations": pa.array((10_000_000 * K).astype("m8[ns]")),
        "times of day": pa.array((10 * K).astype("i4")).cast(pa.time32("ms")),
        "instants": pa.array((EPOCH_NS + 10_000_000 * K).astype("M8[ns]")).cast(pa.timestamp("ns", "UTC")),
    }
    signals = {
        "u_V": pa.array(U).dictionary_encode(),
        "y_rad": pa.array((4 * Y).astype("i8")).cast(pa.decimal128(25, 2)),
        "id": 2**60 + 7919 * K,
    }
    columns = times | signals
    table = read_table(as_parquet(tmp_path / "a.parquet", [*columns], *columns.values()))
    for name in times:
        holds(table, y=4 * Y, names=(name, "u_V", "y_rad"))


def test_columns_of_one_name_are_told_apart(tmp_path):
    path = read_table(
        as_parquet(tmp_path / "a.parquet", ["t_s", "u_V", "y_rad", "y_rad"], 0.01 * K, U, Y, -Y)
    )
    with pytest.raises(ValueError, match=r"several columns 'y_rad'; the file has #1 y_rad, #2 y_rad"):
        record(path)
    np.testing.assert_array_equal(record(path, y="#2 y_rad").output[:, 0], -Y)
    assert record(path, y="#2 y_rad").output_units == ("rad",)
    text = "t_s,u_V,y_rad,note,note\n" + "".join(f"{k},{k % 2},{k},a,b\n" for k in K)
    (tmp_path / "a.csv").write_text(text)
    assert record(tmp_path / "a.csv").n_samples == N


def test_packed_numbers_of_netcdf(tmp_path):
    packed = np.round(100 * Y).astype("i2")
    attributes = {
        "both": {"scale_factor": 0.01, "add_offset": 2.5},
        "scaled": {"scale_factor": np.array([0.5], "f4")},
        "moved": {"add_offset": -7},
        "filled": {"_FillValue": np.int16(-32768), "scale_factor": 0.01},
    }
    true = {"both": 0.01 * packed + 2.5, "scaled": 0.5 * packed, "moved": packed - 7, "filled": 0.01 * packed}
    columns = {"t_s": 0.01 * K, "u_V": U} | dict.fromkeys(attributes, packed)
    table = read_table(as_hdf5(tmp_path / "a.h5", columns, **attributes))
    for name, values in true.items():
        holds(table, y=values, names=("t_s", "u_V", name))


def test_what_netcdf_calls_missing_is_no_number(tmp_path):
    y = np.where(K == 7, -9999.0, Y)
    attributes = {"filled": {"_FillValue": -9999.0}, "missing": {"missing_value": -9999.0}}
    columns = {"t_s": 0.01 * K, "u_V": U} | dict.fromkeys(attributes, y)
    table = read_table(as_hdf5(tmp_path / "a.h5", columns, **attributes))
    for name in attributes:
        with pytest.raises(ValueError, match=f"index 7: column '{name}' is nan"):
            record(table, y=name)
    with pytest.raises(ValueError, match="'filled': its scale_factor is no number"):
        read_table(as_hdf5(tmp_path / "b.h5", columns, filled={"scale_factor": "ten"}))


TABLE = [["t_s", "u_V", "y_rad"], *zip((0.01 * K).tolist(), U.tolist(), Y.tolist(), strict=True)]
OTHER = [["t_s", "u_V", "y_rad"], *zip((0.02 * K).tolist(), U.tolist(), (-Y).tolist(), strict=True)]


def test_the_sheet_that_is_meant(tmp_path):
    """Neither a hidden one nor one of settings."""
    beside = (
        ("old", "hidden", OTHER),
        ("older", "veryHidden", OTHER),
        ("gains", "visible", [["Kp", "Ki"], [3.0, 1.0]]),
    )
    holds(as_sheets(tmp_path / "a.xlsx", *beside, ("Data", "visible", TABLE))[1])


def test_sheets_beside_a_chart_and_beside_each_other(tmp_path):
    book, path = as_sheets(tmp_path / "a.xlsx", ("Data", "visible", TABLE), ("run 2", "visible", OTHER))
    holds(path, y=-Y, dt_s=0.02, names=("run 2/t_s", "run 2/u_V", "run 2/y_rad"))
    with pytest.raises(ValueError, match="no column 't_s'; the file has Data/t_s"):
        record(path)
    book.remove(book["run 2"])
    book.create_chartsheet("figure")
    holds(written(path, book.save))


@pytest.mark.parametrize("unit", ["M", "Y"])
def test_a_calendar_is_no_clock(tmp_path, unit):
    when = np.datetime64("2020", unit) + K
    with pytest.raises(ValueError, match=r"steps of no fixed length; expected instants"):
        record(written(tmp_path / "a.npz", np.savez, t_s=when, u_V=U, y_rad=Y))


def test_complex_columns_are_refused_and_records_read(tmp_path):
    with pytest.raises(ValueError, match="holds complex128; expected real numbers"):
        record(written(tmp_path / "a.npz", np.savez, t_s=0.01 * K, u_V=U + 1j, y_rad=Y))
    rows = np.array(
        list(zip(0.01 * K, U, Y, strict=True)), dtype=[(n, "f8") for n in ("t_s", "u_V", "y_rad")]
    )
    holds(written(tmp_path / "b.npz", np.savez, log=rows), names=("log.t_s", "log.u_V", "log.y_rad"))


ROWS = [
    {"t_s": 0.01 * k, "u_V": u, "y_rad": y}
    for k, u, y in zip(K.tolist(), U.tolist(), Y.tolist(), strict=True)
]
JSON = {
    "rows": json.dumps(ROWS),
    "columns": json.dumps({key: [row[key] for row in ROWS] for key in ROWS[0]}),
    "columns by row": json.dumps({key: {str(k): row[key] for k, row in enumerate(ROWS)} for key in ROWS[0]}),
    "lines": "\n".join(map(json.dumps, ROWS)) + "\n",
}


@pytest.mark.parametrize("form", JSON)
def test_json_in_rows_columns_and_lines(tmp_path, form):
    path = tmp_path / ("a.jsonl" if form == "lines" else "a.json")
    path.write_text(JSON[form])
    holds(path)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('{"t_s": 0.02, "u_V": 1, "y_rad": 1, "y_rad": 2}', "line 3: 'y_rad' is there twice in one object"),
        ('{"t_s": 0.02, "u_V": true, "y_rad": 1}', "'u_V' holds numbers and true or false in one column"),
        ('{"t_s": 0.02, "u_V": "1", "y_rad": 1}', "'u_V' holds numbers and text in one column"),
        ('{"t_s": 0.02, "u_V": null, "y_rad": 1}', "index 2: column 'u_V' is nan; expected a finite number"),
        ('{"t_s": 0.02, "u_V": NaN, "y_rad": 1}', "index 2: column 'u_V' is nan; expected a finite number"),
        ('{"t_s": 0.02, "y_rad": 1}', "index 2: column 'u_V' is nan; expected a finite number"),
        ('{"t_s": 0.02, "u_V": 1, "y_rad": 1', "line 3: not valid JSON"),
        ("[" * 100_000, "line 3: nested deeper than 40 levels"),
        (
            '{"t_s": 0.02, "u_V": ' + "9" * 400 + ', "y_rad": 1}',
            "column 'u_V' is inf; expected a finite number",
        ),
    ],
)
def test_json_that_is_not_numbers(tmp_path, line, words):
    lines = JSON["lines"].splitlines()
    lines[2] = line
    (tmp_path / "a.jsonl").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=f"^{tmp_path}") as caught:
        record(tmp_path / "a.jsonl")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_nested_rows_and_switches(tmp_path):
    rows = [
        {"t": 0.01 * k, "drive": {"u_V": k % 3}, "pose": [0.5 * k, 1.0], "on": k % 2 == 0} for k in K.tolist()
    ]
    (tmp_path / "a.json").write_text(json.dumps(rows))
    holds(tmp_path / "a.json", u=K % 3, y=0.5 * K, names=("t", "drive.u_V", "pose[0]"))
    np.testing.assert_array_equal(read_table(tmp_path / "a.json").columns(["on"])["on"], (K + 1) % 2)


SERIES = pd.Series(U, index=0.01 * K)
IN_MEMORY = {
    "masked": (np.ma.masked_array(U, K == 7), Y, "u has no value at index 7"),
    "complex": (U, Y + 1j, "y holds complex numbers"),
    "complex objects": (U, np.array([1j] * N, dtype=object), "y holds what is no number"),
    "instants": (np.datetime64(0, "s") + K, Y, r"u holds datetime64\[s\]; expected real numbers"),
    "text": (U.astype(str), Y, "u holds <U.*; expected real numbers"),
    "missing": (pd.array([1, None] * (N // 2), dtype="Int64"), Y, "u has no value at index 1"),
    "other rows": (SERIES, pd.Series(Y, index=0.01 * K + 0.005), "rows of different index.*u.align"),
    "a row later": (SERIES.iloc[:-1], pd.Series(Y, index=0.01 * K).iloc[1:], "rows of different index"),
    "sorted otherwise": (SERIES, pd.Series(Y, index=0.01 * K)[::-1], "rows of different index"),
}


@pytest.mark.parametrize("kind", IN_MEMORY)
def test_arrays_that_would_lose_something_are_refused(kind):
    u, y, words = IN_MEMORY[kind]
    with pytest.raises(ValueError, match=words):
        flexlink.Record(u=u, y=y, dt_s=0.01)


def test_arrays_that_lose_nothing_are_taken():
    for u in (
        SERIES,
        np.ma.masked_array(U, False),
        pd.DataFrame({"u": SERIES}),
        U.astype(int),
        U > 0,
        list(U),
    ):
        found = flexlink.Record(u=u, y=pd.Series(Y, index=0.01 * K), dt_s=0.01)
        np.testing.assert_array_equal(found.input[:, 0], U > 0 if np.asarray(u).dtype == bool else U)
    table = pd.DataFrame(np.column_stack([U, Y, -Y]), columns=["u_V", "y_rad", "y_rad"])
    with pytest.raises(ValueError, match="several columns 'y_rad'"):
        flexlink.Record.from_table(table, "u_V", "y_rad", dt_s=0.01)
    found = flexlink.Record.from_table(table, "u_V", "#2 y_rad", dt_s=0.01)
    np.testing.assert_array_equal(found.output[:, 0], -Y)


RNG = np.random.default_rng(14)
CELLS = np.array([1.0, "a"], dtype=object)
VALUES = {
    "real": RNG.normal(size=(7, 3)),
    "row": RNG.normal(size=(1, 9)),
    "whole": np.arange(12, dtype=np.int16).reshape(3, 4),
    "single": RNG.normal(size=(2, 2, 3)).astype(np.float32),
    "complex": RNG.normal(size=(4, 1)) + 1j * RNG.normal(size=(4, 1)),
    "logical": np.array([[True, False]]),
    "none": np.zeros((0, 0)),
}


def saved(variables, **options):
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, variables, **options)
    return buffer.getvalue()


@pytest.mark.parametrize("packed", [pytest.param(False, marks=pytest.mark.long), True])
def test_everything_that_scipy_writes_comes_back(packed):
    nested = {"t": np.arange(3.0), "inner": {"y": np.ones(2)}, "label": "Größe [µm]", "cells": CELLS}
    found = mat_variables(saved(VALUES | {"log": nested, "rows": ["ab", "cde"]}, do_compression=packed), "f")
    for name, value in VALUES.items():
        np.testing.assert_array_equal(found[name], value)
    log = found["log"]
    np.testing.assert_array_equal(log["t"].ravel(), nested["t"])
    np.testing.assert_array_equal(log["inner"]["y"].ravel(), [1, 1])
    assert log["label"] == nested["label"]
    assert (log["cells"][0].item(), log["cells"][1]) == (1.0, "a")
    assert found["rows"] == ["ab", "cde"]


def test_what_is_no_array_is_told_when_it_is_asked_for():
    found = mat_variables(saved({"s": scipy.sparse.eye_array(3).tocsc(), "x": 1.0}), "f")
    assert found["x"].item() == 1.0
    assert "sparse matrix" in found["s"].why


def opaque(name):
    """An object of MATLAB's own, as of `string`: a variable of class 17 without a name where scipy looks."""

    def element(kind, content):
        return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)

    flags, sizes = (struct.pack("<II", kind, 0) for kind in (17, 13)), struct.pack("<ii", 6, 1)
    place = np.array([0xDD000000, 2, 1, 1, 1, 1], "<u4").tobytes()
    own, of_array = flags
    array = element(6, of_array) + element(5, sizes) + element(1, b"") + element(6, place)
    return element(
        14,
        element(6, own)
        + b"".join(element(1, text) for text in (name, b"MCOS", b"string"))
        + element(14, array),
    )


def test_objects_of_matlab_do_not_hide_the_vectors_beside_them():
    content = saved({"t": np.arange(4.0)}) + opaque(b"s1") + opaque(b"s2") + opaque(b"s3")
    found = mat_variables(content, "f")
    np.testing.assert_array_equal(found.pop("t"), [[0, 1, 2, 3]])
    assert all("a MATLAB object" in other.why for other in found.values())


def test_a_reader_keeps_to_limits_that_are_there():
    """Of time and memory: an allowance of its own that is larger cannot be had."""

    def less():
        resource.setrlimit(resource.RLIMIT_CPU, (100, 100))
        resource.setrlimit(resource.RLIMIT_AS, (2**32, 2**32))

    done = subprocess.run(
        [sys.executable, "-I", str(foreign_files.CHILD_SCRIPT), "mat"],
        input=saved({"t": 1.0}), capture_output=True, preexec_fn=less, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout


@pytest.mark.slow
def test_names_that_crash_compiled_readers_are_refused():
    once = saved({"ab": 1.0})
    # The name of two letters stands beside its tag.
    tag = struct.pack("<HH", 1, 2) + b"ab"
    assert tag in once
    for content in (once + once[128:], once.replace(tag, tag[:4] + b"a\0")):
        with pytest.raises(ValueError, match=r"^f: .*damaged"):
            mat_variables(content, "f")


@pytest.mark.slow
def test_lengths_are_believed_no_further_than_the_bytes_go():
    content = saved({"x": np.arange(4.0)})
    dimensions = struct.pack("<ii", 1, 4)
    assert content.count(dimensions) == 1
    too_many = content.replace(dimensions, struct.pack("<ii", 1, 2**31 - 1))
    for one in (too_many, content[:-8]):
        with pytest.raises(ValueError, match=r"^f: not a MATLAB .mat file"):
            mat_variables(one, "f")
