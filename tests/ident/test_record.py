"""Records from files: what is read, and that every kind of bad input gets one line that names the place.

Formats and layouts of files: `test_forty_logs.py`.
"""

import numpy as np
import pytest

from ident.data import record_files
from ident.data.record import Record
from ident.data.table import Table

T, U, Y = "t_s", "u_V", "y_rad"


def write(path, lines):
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def rows(n=6, dt=0.01, start=0):
    return [f"{dt * k:.6f},{(-1) ** k},{0.5 * k}" for k in range(start, start + n)]


@pytest.fixture
def good(tmp_path):
    return write(tmp_path / "log.csv", [f"{T},{U},{Y}", *rows()])


def read(path, **kwargs):
    return Record.from_file(path, [U], [Y], **({"time": T} | kwargs))


def complaint(path, **kwargs):
    with pytest.raises(ValueError) as caught:
        read(path, **kwargs)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_time_need_not_start_at_zero_and_may_jitter(tmp_path):
    rng = np.random.default_rng(0)
    stamps = 5.0 + 1e-3 * np.arange(50) + rng.uniform(-5e-8, 5e-8, 50)
    path = write(
        tmp_path / "log.csv", [f"{T},{U},{Y}", *(f"{t:.9f},{k % 3},{k}" for k, t in enumerate(stamps))]
    )
    # The mean interval of 49 steps with end stamps off by 5e-8 s at most: 2e-9 s.
    assert read(path).dt_s == pytest.approx(1e-3, abs=2.1e-9)


def test_dt_can_be_given_instead_of_or_beside_time(good):
    assert read(good, time=None, dt_s=0.5).dt_s == 0.5
    assert read(good, dt_s=0.01).dt_s == 0.01
    assert "dt_s = 0.02 s, but the time column 't_s' steps by 0.01 s" in complaint(good, dt_s=0.02)
    assert "give the time column or dt_s" in complaint(good, time=None)


@pytest.mark.parametrize("dt_s", [0.0, -1.0, np.nan, np.inf])
def test_dt_must_be_positive(good, dt_s):
    assert f"{good}: dt_s must be a positive number of seconds" in complaint(good, time=None, dt_s=dt_s)


HEAD = f"{T},{U},{Y}"
# What is wrong with the lines of a log, and what the one line of the complaint must say.
FAULTS = {
    **{
        f"{text or 'empty'} for a number": (
            [HEAD, *rows(3), f"0.03,{text},1.5", *rows(2, start=4)],
            [f"log.csv, line 5: column 'u_V' is {shown}; expected a finite number"],
        )
        for text, shown in (
            *(("nan", "'nan'"), ("inf", "'inf'"), ("-Infinity", "'-Infinity'")),
            ("", "empty"),
        )
    },
    "blank line": ([HEAD, *rows(3), "", *rows(3, start=3)], ["log.csv, line 5: column 't_s' is empty"]),
    "short row": ([HEAD, *rows(3), "0.03,1", *rows(2, start=4)], ["line 5: column 'y_rad' is empty"]),
    "long row": ([HEAD, *rows(3), "0.03,1,2,3", *rows(2, start=4)], ["line 5: 4 cells where line 1 has 3"]),
    "time stands still": (
        [HEAD, *rows(4), "0.030000,1,2", *rows(1, start=5)],
        ["log.csv, line 6: time 't_s' goes from 0.03 to 0.03 s", "expected increasing time"],
    ),
    "repeated name": (
        [f"{T},{U},{U},{Y}", "0,1,2,3", "1,2,3,4"],
        ["several columns 'u_V'; the file has #1 u_V, #2 u_V"],
    ),
    "nothing": ([""], []),
    "blank lines only": (["", ""], []),
    "header only": ([HEAD], []),
    "binary": ([bytes(range(256)).decode("latin-1") * 4], []),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_log_is_one_line_with_file_and_place(tmp_path, fault):
    lines, words = FAULTS[fault]
    message = complaint(write(tmp_path / "log.csv", lines))
    for word in (str(tmp_path / "log.csv"), *words):
        assert word in message


def test_one_column_is_not_two_things(good):
    with pytest.raises(ValueError, match="as input and output"):
        Record.from_file(good, [U], [U], time=T)
    with pytest.raises(ValueError, match="as time and as a signal"):
        Record.from_file(good, [T], [Y], time=T)


def test_paths_that_are_not_there(tmp_path):
    assert complaint(tmp_path / "no.csv") == f"{tmp_path / 'no.csv'}: no such file"
    assert complaint(tmp_path) == f"{tmp_path}: not a file"


def test_one_string_is_not_a_list_of_columns(good):
    with pytest.raises(ValueError, match="must be a list of column names"):
        Record.from_file(good, U, [Y], time=T)


def arrays():
    return {T: 0.01 * np.arange(6), U: np.array([1, -1, 1, -1, 1, -1]), Y: 0.5 * np.arange(6)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({U: np.array([1, -1, np.nan, 1, 2, 3])}, "index 2: column 'u_V' is nan; expected a finite number"),
        ({U: np.arange(6) + 1j}, "'u_V' holds complex128; expected real numbers"),
        ({U: np.array(list("abcdef"))}, "expected real numbers"),
        ({U: np.ones((6, 2))}, r"no column 'u_V'; the file has u_V\[0\], u_V\[1\]"),
        ({U: np.arange(5.0)}, "equally long"),
    ],
)
def test_bad_npz_content(tmp_path, change, message):
    path = tmp_path / "log.npz"
    np.savez(path, **(arrays() | change))
    with pytest.raises(ValueError, match=message):
        Record.from_file(path, [U], [Y], time=T)


def test_files_of_another_kind(tmp_path, good):
    np.save(tmp_path / "one.npy", np.arange(3.0))
    for source, name, message in (
        (good, "csv.npz", "not a numpy .npz archive"),
        (good, "csv.mat", "not a MATLAB .mat file"),
        (tmp_path / "one.npy", "npy.npz", "not a numpy .npz archive"),
        (good, "log.docx", "unknown kind of file '.docx'; expected one of .csv"),
    ):
        path = tmp_path / name
        path.write_bytes(source.read_bytes())
        with pytest.raises(ValueError, match=message):
            Record.from_file(path, [U], [Y], time=T)


def test_a_format_of_ones_own_is_one_registered_reader(tmp_path, good, monkeypatch):
    monkeypatch.setattr(record_files, "READERS", dict(record_files.READERS))

    @record_files.reads(".rows")
    def _read_rows(file, content):
        values = np.loadtxt(content.decode().splitlines())
        return Table(file, dict(zip((T, U, Y), values.T, strict=True)))

    path = write(tmp_path / "log.rows", [row.replace(",", " ") for row in rows()])
    np.testing.assert_array_equal(read(path).output, read(good).output)


def two_by_two(**change):
    fields = {
        "name": "r", "input": np.arange(8.0).reshape(4, 2), "output": np.arange(12.0).reshape(4, 3),
        "dt_s": 0.1, "input_names": ("a", "b"), "output_names": ("c", "d", "e"), "reference": np.ones((4, 1)),
        "reference_names": ("ref",), "output_units": ("rad", "m", "m/s^2"),
    }  # fmt: skip
    return Record(**(fields | change))


def test_siso_and_slice():
    record = two_by_two().siso("b", "e")
    np.testing.assert_array_equal(record.input[:, 0], [1, 3, 5, 7])
    np.testing.assert_array_equal(record.output[:, 0], [2, 5, 8, 11])
    assert record.output_units == ("m/s^2",)
    part = record.slice(1, 3)
    np.testing.assert_array_equal(part.input[:, 0], [3, 5])
    assert part.reference.shape == (2, 1)
    with pytest.raises(ValueError, match="no input column 'z'; there is"):
        two_by_two().siso("z", "e")
    with pytest.raises(ValueError, match="0 <= start < stop <= 4"):
        record.slice(2, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt_s": 0.0}, "dt_s must be a positive"),
        ({"input": np.arange(8.0)}, r"input must be \(T, 2\)"),
        ({"output": np.zeros((3, 3))}, "equally long"),
        ({"output": np.full((4, 3), np.inf)}, "output column 'c' is inf at index 0"),
        ({"output": np.full((4, 3), -1e200)}, r"output column 'c' is -1e\+200 at index 0; .*unit"),
        ({"input_names": ("a", "a")}, "distinct"),
        ({"reference": None}, "without a reference"),
        ({"output_units": ("rad",)}, "one per column"),
    ],
)
def test_bad_records_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        two_by_two(**change)
