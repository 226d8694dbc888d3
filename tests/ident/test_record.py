"""Records from files: what is read, and that every kind of bad input gets one line that names the place.

Formats and layouts of files: `test_forty_logs.py`.
"""

import numpy as np
import pytest

from ident.data.record import Record
from ident.data.record_files import READERS, reads
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
    """The one line of the error, which names the file."""
    with pytest.raises(ValueError) as caught:
        read(path, **kwargs)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def names_all(message, *facts) -> bool:
    return all(str(fact) in message for fact in facts)


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
    assert names_all(complaint(good, dt_s=0.02), "dt_s", "'t_s'", 0.01, 0.02)
    assert names_all(complaint(good, time=None), "--time", "--dt-s", U, Y)


@pytest.mark.parametrize("dt_s", [0.0, -1.0, np.nan, np.inf])
def test_dt_must_be_positive(good, dt_s):
    assert names_all(complaint(good, time=None, dt_s=dt_s), "dt_s", dt_s)


HEAD = f"{T},{U},{Y}"
# What is wrong with the lines of a log, and the place and the facts that the complaint must name.
FAULTS = {
    **{
        f"{text or 'empty'} for a number": (
            [HEAD, *rows(3), f"0.03,{text},1.5", *rows(2, start=4)],
            ["line 5", "'u_V'", shown],
        )
        for text, shown in (
            *(("nan", "'nan'"), ("inf", "'inf'"), ("-Infinity", "'-Infinity'")),
            ("", "empty"),
        )
    },
    "blank line": ([HEAD, *rows(3), "", *rows(3, start=3)], ["line 5", "'t_s'", "empty"]),
    "short row": ([HEAD, *rows(3), "0.03,1", *rows(2, start=4)], ["line 5", "'y_rad'", "empty"]),
    "long row": ([HEAD, *rows(3), "0.03,1,2,3", *rows(2, start=4)], ["line 5", "4 cells", "line 1 has 3"]),
    "time stands still": (
        [HEAD, *rows(4), "0.030000,1,2", *rows(1, start=5)],
        ["line 6", "'t_s'", "from 0.03 to 0.03 s"],
    ),
    "repeated name": (
        [f"{T},{U},{U},{Y}", "0,1,2,3", "1,2,3,4"],
        ["'u_V'", "#1 u_V, #2 u_V"],
    ),
    "nothing": ([""], []),
    "blank lines only": (["", ""], []),
    "header only": ([HEAD], []),
    "binary": ([bytes(range(256)).decode("latin-1") * 4], []),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_log_is_one_line_with_file_and_place(tmp_path, fault):
    lines, facts = FAULTS[fault]
    assert names_all(complaint(write(tmp_path / "log.csv", lines)), *facts)


def test_one_column_is_not_two_things(good):
    with pytest.raises(ValueError, match=f"'{U}' .*input.*output"):
        Record.from_file(good, [U], [U], time=T)
    with pytest.raises(ValueError, match=f"'{T}' .*time.*signal"):
        Record.from_file(good, [T], [Y], time=T)


def test_paths_that_are_not_there(tmp_path):
    assert "no such file" in complaint(tmp_path / "no.csv")
    assert "not a file" in complaint(tmp_path)


def test_one_column_may_be_named_by_itself(good):
    record = Record.from_file(good, U, Y, time=T)
    assert (record.input_names, record.output_names) == ((U,), (Y,))


def test_a_statement_about_a_column_that_is_not_used_is_refused(good):
    for statement in ("scale", "offset", "units", "unwrap"):
        assert "'u_v'" in complaint(good, **{statement: {"u_v": 1.0}})


def test_a_table_of_several_runs_asks_for_one_of_them(tmp_path):
    lines = [f"{T},{U},{Y},run", *(f"{row},{run}" for run in (3, 4) for row in rows())]
    path = write(tmp_path / "log.csv", lines)
    assert names_all(complaint(path), "2 runs", "run 3", "run 4", "run = 0 to 1")
    assert "run = 0 to 1" in complaint(path, run=2)
    second = read(path, run=1)
    assert (second.n_samples, second.name) == (6, "log, run 4")


def arrays():
    return {T: 0.01 * np.arange(6), U: np.array([1, -1, 1, -1, 1, -1]), Y: 0.5 * np.arange(6)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({U: np.array([1, -1, np.nan, 1, 2, 3])}, "index 2: .*'u_V' .*nan"),
        ({U: np.arange(6) + 1j}, "'u_V' .*complex128"),
        ({U: np.array(list("abcdef"))}, "'u_V' .*text"),
        ({U: np.ones((6, 2))}, r"'u_V'.* u_V\[0\], u_V\[1\]"),
        ({U: np.arange(5.0)}, "'u_V': 5"),
    ],
)
def test_an_archive_names_the_array_that_does_not_fit(tmp_path, change, message):
    path = tmp_path / "log.npz"
    np.savez(path, **(arrays() | change))
    with pytest.raises(ValueError, match=message):
        Record.from_file(path, [U], [Y], time=T)


def test_files_of_another_kind(tmp_path, good):
    np.save(tmp_path / "one.npy", np.arange(3.0))
    for source, name, message in (
        (good, "csv.npz", r"csv\.npz: .*\.npz"),
        (good, "csv.mat", r"csv\.mat: .*\.mat"),
        (tmp_path / "one.npy", "npy.npz", r"npy\.npz: .*\.npz"),
        (good, "log.docx", r"'\.docx'.* \.csv"),
    ):
        path = tmp_path / name
        path.write_bytes(source.read_bytes())
        with pytest.raises(ValueError, match=message):
            Record.from_file(path, [U], [Y], time=T)


@pytest.fixture
def rows_reader():
    """A reader of files that end in '.rows', registered for one test."""

    @reads(".rows")
    def read_rows(file, content):
        values = np.loadtxt(content.decode().splitlines())
        return Table(file, dict(zip((T, U, Y), values.T, strict=True)))

    yield read_rows
    READERS.pop(".rows")


@pytest.mark.usefixtures("rows_reader")
def test_a_format_of_ones_own_is_one_registered_reader(tmp_path, good):
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
    with pytest.raises(ValueError, match=r"input .*'z'.*'a', 'b'"):
        two_by_two().siso("z", "e")
    with pytest.raises(ValueError, match=r"2 to 2: .*4"):
        record.slice(2, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt_s": 0.0}, "dt_s .*0.0"),
        ({"input": np.arange(8.0)}, r"input .*\(T, 2\).*\(8, 1\)"),
        ({"output": np.zeros((3, 3))}, "output has 3 samples .*4"),
        ({"output": np.full((4, 3), np.inf)}, "output .*'c' is inf at index 0"),
        ({"output": np.full((4, 3), -1e200)}, r"output .*'c' is -1e\+200 at index 0"),
        ({"input_names": ("a", "a")}, r"input .*\['a', 'a'\]"),
        ({"reference": None}, "reference_names"),
        ({"output_units": ("rad",)}, r"output_units .*\('rad',\)"),
    ],
)
def test_a_record_names_what_does_not_fit(change, message):
    with pytest.raises(ValueError, match=message):
        two_by_two(**change)
