"""Numbers, stamps and cells as people, spreadsheets and other programs write them; what is none is named."""

import io

import numpy as np
import openpyxl
import pytest

from ident.data.finding import FindingKind
from ident.data.record import Record
from ident.data.record_files import read_table
from ident.data.text_numbers import is_number, number, quantity
from ident.data.time_stamps import is_stamp, seconds_since_first
from ident.data.wrapping import no_reading, timer_period

N = 60
DT_S = 0.005
U = np.random.default_rng(7).choice([-2.5, 3.25], N)
Y = np.round(np.cumsum(U) / 8, 4)


def log(tmp_path, times, u, y, head="Time,u_V,y_rad", under=()):
    lines = [head, *(",".join(map(str, row)) for row in zip(times, u, y, strict=True)), *under]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def record_of(path, names=("u_V", "y_rad"), time="Time", **stated):
    return Record.from_file(path, names[:1], names[1:], time=time, **stated)


def agrees(record):
    assert record.dt_s == pytest.approx(DT_S, rel=1e-9)
    np.testing.assert_allclose(record.input[:, 0], U)
    np.testing.assert_allclose(record.output[:, 0], Y)


@pytest.mark.parametrize(
    ("cell", "value"),
    [("(3.25)", -3.25), ("3.25-", -3.25), ("(1,250.5)", -1250.5), ("1.5D-03", 1.5e-3), ("12 345.5", 12345.5)],
)
def test_one_number_in_several_forms(cell, value):
    assert is_number(cell, ".")
    assert number(cell, ".") == value
    turned = cell.translate(str.maketrans(".,", ",."))
    assert number(turned, ",") == value


@pytest.mark.parametrize("cell", ["(V)", "()", "(3", "3)", "-", "1-2", "1 23", "1d5", "", "(-3)-"])
def test_what_is_no_number(cell):
    assert not is_number(cell, ".")


@pytest.mark.parametrize(
    ("cell", "found"),
    [
        *[("0.005 sec", ("0.005", "sec")), ("5ms", ("5", "ms")), ("30 %", ("30", "%")), ("30%", ("30", "%"))],
        *[
            ("-1.5 V", ("-1.5", "V")),
            ("(2.5) Nm", ("(2.5)", "Nm")),
            ("(2.5%)", ("(2.5)", "%")),
            ("3A", None),
            ("5 apples", None),
        ],
        *[("V", None), ("1.5", None), ("2 3 V", None)],
    ],
)
def test_a_number_and_its_unit_in_one_cell(cell, found):
    assert quantity(cell, ".") == found


STAMPS = {
    "timetable of MATLAB": lambda s: f"{s:.3f} sec",
    "datetime of MATLAB": lambda s: f"01-Mar-2024 10:00:{s:06.3f}",
    "timedelta of pandas": lambda s: f"0 days 00:00:{s:09.6f}",
    "ISO duration": lambda s: f"PT{s:.3f}S",
    "ctime": lambda s: f"Fri Mar  1 10:00:{s:06.3f} 2024",
    "a browser": lambda s: f'"01/03/2024, 10:00:{s:06.3f}"',
    "basic ISO": lambda s: f"20240301T100000.{1000 * s:03.0f}",
    "a colon before milliseconds": lambda s: f"10:00:00:{1000 * s:03.0f}",
    "German": lambda s: f"1. März 2024 10:00:{s:06.3f}",
    "two digits of the year": lambda s: f"01.03.24 10:00:{s:06.3f}",
}


@pytest.mark.parametrize("kind", STAMPS)
def test_times_as_programs_write_them(tmp_path, kind):
    agrees(record_of(log(tmp_path, [STAMPS[kind](k * DT_S) for k in range(N)], U, Y)))


@pytest.mark.parametrize("word", ["May 3", "march", "1.2.3", "3-4", "T1", "20240301", "5 days", "sat 1"])
def test_words_are_no_stamps(word):
    assert not is_stamp(word)


def test_days_that_passed_count():
    assert tuple(seconds_since_first(["1 days 23:59:59", "2 days 00:00:01"])) == (0.0, 2.0)


def test_other_minus_signs_and_bookkeeping(tmp_path):
    times = [f"{k * DT_S:.3f}" for k in range(N)]
    agrees(record_of(log(tmp_path, times, [f"{u}".replace("-", "\u2212") for u in U], Y)))
    bookkept = [f"({-u})" if u < 0 else f"{u}" for u in U]
    record = record_of(log(tmp_path, times, bookkept, Y))
    agrees(record)
    (note,) = record.notes
    assert (note.kind, note.values["cell"], note.values["value"]) == (FindingKind.BOOKKEPT, "(2.5)", -2.5)
    assert note.values["rows"] == np.sum(U < 0)


@pytest.mark.parametrize(
    ("unit", "counts", "per_s"),
    [("ms", 2**16, 1e3), ("us", 2**32, 1e6), ("us", 2**16, 1e6), ("ms", 86_400_000, 1e3)],
)
def test_a_timer_that_starts_again_goes_on_and_it_is_said(tmp_path, unit, counts, per_s):
    stamps = (counts - 7 + np.round(np.arange(N) * DT_S * per_s).astype(int)) % counts
    record = record_of(log(tmp_path, stamps, U, Y, f"t_{unit},u_V,y_rad"), time=f"t_{unit}")
    agrees(record)
    (note,) = record.doubts
    assert (note.kind, note.values["period"]) == (FindingKind.TIMER_WRAPS, counts)
    assert note.values["count"] == np.sum(np.diff(stamps) < 0)


@pytest.mark.parametrize("last", [0.995, 0.5, 65.0])
def test_runs_that_start_again_are_no_timer(last):
    run = np.arange(0, last, DT_S)
    assert timer_period(np.concatenate([run, run])) == 0
    assert timer_period(run) == 0


def test_a_stamp_that_is_none_is_named(tmp_path):
    stamps = [f"{k * DT_S:.3f}" for k in range(N)]
    stamps[20] = "-9999"
    with pytest.raises(ValueError, match=r"line 22: .* -9999 s; expected increasing time \(delete this row"):
        record_of(log(tmp_path, stamps, U, Y))
    stamps[20] = "99999"
    with pytest.raises(ValueError, match="delete the row before, which has no time"):
        record_of(log(tmp_path, stamps, U, Y))


@pytest.mark.parametrize("code", [-9999.0, 65535.0, 999.0, -32768.0, 9.91e37, -777.7])
@pytest.mark.parametrize("rows", [[7], [0, 1, 2], list(range(3, N, 7))])
def test_a_code_for_no_reading_is_found_wherever_it_is(code, rows):
    values = U.copy()
    values[rows] = code
    assert no_reading(values).tolist() == rows


@pytest.mark.parametrize(
    "values",
    [
        U,
        4 * (np.arange(N) == 9),
        np.where(np.arange(N) == 9, 999.0, 300 + 20 * U),
        np.where(np.arange(N) < 40, 99999, 0),
    ],
)
def test_pulses_and_large_levels_are_readings(values):
    assert no_reading(np.asarray(values, dtype=float), command=True).size == 0


def test_a_value_of_a_command_far_beyond_all_others_is_named(tmp_path):
    u = U.copy()
    u[12] = 12_345.0
    (note,) = record_of(log(tmp_path, np.arange(N) * DT_S, u, Y)).notes
    assert (note.kind, note.values["name"], note.values["rows"]) == (FindingKind.NO_READING, "u_V", 1)
    assert note.values["place"] == "line 14"


@pytest.mark.parametrize("under", [("ms",), ("ms,V,rad",), ("End of file", "60 rows")])
def test_words_under_the_table_are_left_out_or_are_its_units(tmp_path, under):
    times = np.arange(N) * 5 if under[0].startswith("ms") else np.arange(N) * DT_S
    record = record_of(log(tmp_path, times, U, Y, "Time,u,y", under), ("u", "y"))
    agrees(record)
    assert record.input_units == (("V",) if "V" in under[0] else ())
    (note,) = (note for note in record.notes if note.kind is FindingKind.FOOTER)
    assert note.values["line"] == N + 2


@pytest.mark.parametrize("separator", [";", ",", "\t"])
def test_whole_numbers_in_groups_are_asked_about(tmp_path, separator):
    """1.500 beside whole numbers: one and a half, or fifteen hundred?"""
    counts = np.round(1400 + 20 * Y)
    cells = [(str(5 * k), str(k % 3), f"{count:,.0f}".replace(",", ".")) for k, count in enumerate(counts)]
    text = "\n".join(separator.join(row) for row in [("t_ms", "drive", "encoder_counts"), *cells])
    path = tmp_path / "a.csv"
    path.write_text(text + "\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"does the '\.' separate decimals or thousands\?"):
        read_table(path).columns(["encoder_counts"])
    found = read_table(path).with_decimal("comma").columns(["encoder_counts"])["encoder_counts"]
    np.testing.assert_array_equal(found, counts)


def sheet(tmp_path, name, cell, form="General"):
    book = openpyxl.Workbook()
    book.active.append(["t_s", name, "y_rad"])
    for k, (u, y) in enumerate(zip(U, Y, strict=True)):
        book.active.append([k * DT_S, cell(k, u), float(y)])
        book.active.cell(k + 2, 2).number_format = form
    stream = io.BytesIO()
    book.save(stream)
    path = tmp_path / "a.xlsx"
    path.write_bytes(stream.getvalue())
    return path


@pytest.mark.parametrize(
    ("name", "form", "factor", "unit"),
    [
        ("drive [%]", "0.0 %", 100.0, "%"),
        ("drive", "0%", 100.0, "%"),
        ("drive_V", "0.00", 1.0, "V"),
        ("drive_V", '0.0" %"', 1.0, "V"),
        ("force_kN", "#,##0.0,", 1e-3, "kN"),
        ("force_N", "#,##0.0", 1.0, "N"),
        ("drive [%]", "0.0 %;[Red]-0.0 %", 100.0, "%"),
    ],
)
def test_cells_of_a_sheet_are_read_as_they_are_shown(tmp_path, name, form, factor, unit):
    table = read_table(sheet(tmp_path, name, lambda _, u: float(u), form))
    np.testing.assert_allclose(table.columns([name])[name], factor * U, rtol=1e-14)
    assert table.unit(name) == unit


def test_formulas_without_values_say_what_to_do(tmp_path):
    path = sheet(tmp_path, "u_V", lambda k, _: f"=2*A{k + 2}")
    with pytest.raises(ValueError, match=r"line 2: .*a formula without its value; open the file in Excel"):
        read_table(path).columns(["u_V"])
