"""What text logs say of units, rows, numbers and time: read rightly, or asked for; never guessed in silence.

The files are written here, as instruments and loggers write them; u = +-1.5 V, y = 0.125 k, every 5 ms.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import flexlink
from ident.data.finding import FindingKind
from ident.data.record import Record
from ident.data.record_files import read_table
from ident.data.roles import roles_of, time_of
from ident.data.text_tables import read_text
from ident.data.units import unit_of_time

N, DT_S = 80, 0.005
K = np.arange(N)
T_S, U, Y = DT_S * K, 1.5 * (-1.0) ** (K // 3), 0.125 * K


KNOWN = {
    "ms": "time_millis|timeMs|tms|ms since start|time [ms] rel|time［ms］|time_milliseconds|t0_ms|"
    "时间（毫秒）|time {ms}|t/ms|time msec|elapsedms|time_milli|Time (mS)|t [m s]|zeitms|uptimems|"
    "time milli sec|time_1 [ms]|Time (m.s.)|t@[ms]|t_ms@ms",
    "us": "TimeUS|us since boot|host_time_us|t μs|time_micros|clockus|t micro",
    "ns": "timeNs|nanos|stamp_ns|time (nsec)",
    "s": "timeSeconds|in s|t, s|Zeit in Sekunden|elapsed sec|Time (Sec)|Time@Second",
    "": "t|time|__time|t[0]|Time (UTC)|time_stamp|Uhrzeit|times|'time'|rec.X.Data",
    "min": "t [min]", "h": "elapsedh", "d": "Time [d]",
}  # fmt: skip
STRANGE = (
    "t_m|t_cs|time_ps|ticks|frame index|Time [foo]|t [0.1 ms]|time_100us|sec/1000|"
    "t (1/100 s)|time [ns]/1000|time'|t [m/s]|t_m_s|10*t [ms]|t″|t@fortnights"
)


@pytest.mark.parametrize(
    ("name", "unit"), [(n, unit) for unit, names in KNOWN.items() for n in names.split("|")]
)
def test_units_that_are_known(name, unit):
    assert unit_of_time(*name.split("@")) == (unit, "")


@pytest.mark.parametrize(
    ("name", "words"),
    [(name, "unknown unit") for name in STRANGE.split("|")]
    + [(name, "contradicting units") for name in ("t_ms@s", "time_ms [s]", "ms since start (s)")],
)
def test_units_that_are_asked_for(tmp_path, name, words):
    name, _, beside = name.partition("@")
    assert words in unit_of_time(name, beside)[1]
    below = [f"{beside};V;rad"] if beside else []
    path = written(tmp_path, ";", [name, "u_V", "y_rad"], below=below)
    with pytest.raises(ValueError, match=words) as caught:
        Record.from_file(path, ["u_V"], ["y_rad"], time=name)
    assert "--time-unit" in str(caught.value)
    assert Record.from_file(path, ["u_V"], ["y_rad"], time=name, time_unit="s").dt_s == DT_S


def rows(separator=",", time=T_S, u=U, y=Y) -> list[str]:
    return [separator.join((f"{t:.9g}", f"{a:.9g}", f"{b:.9g}")) for t, a, b in zip(time, u, y, strict=True)]


def written(folder: Path, separator, names, *, above=(), below=(), lines=None, file="a.csv") -> Path:
    path, body = folder / file, rows(separator) if lines is None else lines
    text = [*above, *([separator.join(names)] if names else []), *below, *body]
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return path


def test_units_above_the_names(tmp_path):
    path = written(tmp_path, ";", ["Time", "Drive", "Hub"], above=["ms;V;rad"], lines=rows(";", 1e3 * T_S))
    record = Record.from_file(path, ["Drive"], ["Hub"], time="Time")
    assert (record.dt_s, record.input_units, record.output_units) == (DT_S, ("V",), ("rad",))


@pytest.mark.parametrize("above", ["# a comment line here", "% four words of it", "// names t u y"])
def test_words_of_a_comment_are_no_names(tmp_path, above):
    """A date and a clock time are two cells between blanks, so that four words fit as well."""
    lines = [f"05.03.2024 12:00:{t:06.3f}\t{u}\t{y}" for t, u, y in zip(T_S, U, Y, strict=True)]
    path = written(tmp_path, "\t", ["timestamp", "u_V", "y_rad"], above=[above], lines=lines)
    assert read_table(path).names == ("timestamp", "u_V", "y_rad")


def test_signals_whose_units_contradict_each_other_are_told(tmp_path):
    path = written(tmp_path, ";", ["t_s", "u_V", "hub_deg"], below=["s;V;rad"])
    (note,) = Record.from_file(path, ["u_V"], ["hub_deg"], time="t_s").doubts
    assert (note.kind, note.values["name"]) == (FindingKind.UNIT_CONTRADICTED, "hub_deg")


@pytest.mark.parametrize("sign", ["#", "# ", "%", "//", "!", "-- ", "* ", "REM "])
@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(0, N), min_size=1, max_size=9), st.booleans())
def test_rows_behind_a_comment_sign_are_left_out(tmp_path_factory, sign, places, words):
    """Wherever they stand, before, between and behind the rows; and how many is said."""
    lines = rows(";")
    for place in sorted(places, reverse=True):
        lines.insert(place, sign + ("restarted; by hand" if words else "0.1;9;9"))
    path = written(tmp_path_factory.mktemp("log"), ";", ["t_s", "u_V", "y_rad"], lines=lines)
    record = Record.from_file(path, ["u_V"], ["y_rad"], time="t_s")
    np.testing.assert_array_equal(record.output[:, 0], Y)
    (note,) = record.doubts
    assert (note.kind, note.values["rows"]) == (FindingKind.SKIPPED_ROWS, len(places))
    assert note.values["line"] == 2 + min(places)


def test_lines_are_counted_with_comments(tmp_path):
    lines = rows()
    lines[7] = "0.035,1.5,overflow"
    lines[3:3] = ["# a", "#0,0,0"]
    path = written(tmp_path, ",", ["t_s", "u_V", "y_rad"], lines=lines)
    with pytest.raises(ValueError, match="line 11: column 'y_rad' is 'overflow'"):
        read_table(path).columns(["y_rad"])


def test_line_ends_written_twice_make_no_rows(tmp_path):
    (tmp_path / "a.csv").write_bytes(("\r\r\n".join(["t_s,u_V,y_rad", *rows()]) + "\r\r\n").encode())
    record = Record.from_file(tmp_path / "a.csv", ["u_V"], ["y_rad"], time="t_s")
    np.testing.assert_array_equal(record.output[:, 0], Y)


@pytest.mark.parametrize("lost", [*range(1, 12), 15])
@pytest.mark.parametrize("form", ["{:.6f}", "{:.5e}", "{:+.4f}"])
def test_a_row_in_which_the_file_ends_is_left_out(tmp_path, lost, form):
    """However much of it is there; whole rows stay, with a line end or without."""
    path = tmp_path / "a.csv"
    lines = [f"{T_S[k]:.3f};{U[k]:.1f};{form.format(Y[k] - 3)}" for k in K]
    text = "\n".join(["t_s;u_V;y_rad", *lines])
    for written, n in ((text, N), (text + "\n", N), (text[:-lost], N - 1)):
        path.write_text(written)
        record = Record.from_file(path, ["u_V"], ["y_rad"], time="t_s")
        assert record.n_samples == n
        assert [(note.kind, note.values["line"]) for note in record.doubts] == [
            (FindingKind.CUT_ROW, N + 1)
        ] * (N - n)


def test_an_integer_in_which_the_file_ends_is_left_out(tmp_path):
    (tmp_path / "a.csv").write_text(
        "t_s,u_V,y_counts\n" + "\n".join(f"{t:.3f},1,{1000 + k}" for k, t in zip(K, T_S, strict=True))[:-1]
    )
    assert len(read_table(tmp_path / "a.csv").columns(["y_counts"])["y_counts"]) == N - 1


WHOLE = 127 * K + 898.0  # to 10931


@pytest.mark.parametrize(
    ("form", "decimal"),
    [
        *[("{:,.2f}", None), ("{:,.0f}", "point"), ("{:.0f}", None)],
        *[("{:,.1f} swiss", None), ("{:,.2f} german", None), ("{:,.0f} german", "comma")],
    ],
)
@pytest.mark.parametrize("separator", [";", "\t", "|"])
def test_thousands_are_read_or_asked_for(tmp_path, form, decimal, separator):
    def cell(value):
        text = form.split()[0].format(value)
        text = text.replace(",", "'") if "swiss" in form else text
        return text.translate(str.maketrans(",.", ".,")) if "german" in form else text

    names = ["t_ms", "u_V", "y_counts"]
    lines = [separator.join([f"{5 * k}", f"{2 * (k % 2)}", cell(WHOLE[k])]) for k in K[:70]]
    path = written(tmp_path, separator, names, lines=lines)
    if decimal:
        with pytest.raises(ValueError, match=r"decimals or thousands.*--decimal"):
            Record.from_file(path, ["u_V"], ["y_counts"], time="t_ms")
    record = Record.from_file(path, ["u_V"], ["y_counts"], time="t_ms", decimal=decimal)
    np.testing.assert_array_equal(record.output[:, 0], WHOLE[:70])


@pytest.mark.parametrize("sign", [",", "."])
def test_decimals_of_three_digits_are_no_thousands(tmp_path, sign):
    """Levels 0 and 1.125: '1,125' beside '0', where the time says what the comma is."""
    lines = [f"{0.005 * k:.3f};{(1.125 if k % 4 > 1 else 0):.9g};{Y[k]:.9g}".replace(".", sign) for k in K]
    path = written(tmp_path, ";", ["t_s", "u_V", "y_rad"], lines=lines)
    values = Record.from_file(path, ["u_V"], ["y_rad"], time="t_s").input[:, 0]
    np.testing.assert_array_equal(values, np.where(K % 4 > 1, 1.125, 0))


@pytest.mark.parametrize(
    ("cell", "asked", "dt_s"),
    [
        (lambda k: f"{k // 60:02d}:{k % 60:02d}", True, 1.0),
        (lambda k: f"00:{0.1 * k:04.1f}", False, 0.1),
        (lambda k: f"{30 + k // 60:02d}:{k % 60:02d}", False, 1.0),
        (lambda k: f"{(59 + k // 60) % 60:02d}:{k % 60:02d}", False, 1.0),
        (lambda k: f"26:00:{k // 2:02d}.{5 * (k % 2)}", False, 0.5),
    ],
)
def test_minutes_and_seconds_are_no_hours_and_minutes(tmp_path, cell, asked, dt_s):
    lines = [f"{cell(int(k))};{U[k]};{Y[k]}" for k in K]
    path = written(tmp_path, ";", ["Zeit", "u_V", "y_rad"], lines=lines)
    if asked:
        with pytest.raises(
            ValueError, match=r"hours:minutes or minutes:seconds.*--time-unit h, or --time-unit min"
        ):
            Record.from_file(path, ["u_V"], ["y_rad"], time="Zeit")
        assert Record.from_file(path, ["u_V"], ["y_rad"], time="Zeit", time_unit="h").dt_s == 60 * dt_s
    record = Record.from_file(path, ["u_V"], ["y_rad"], time="Zeit", time_unit="min" if asked else None)
    assert record.dt_s == pytest.approx(dt_s, rel=1e-12)


@pytest.mark.parametrize(("unit", "digits"), [("ms", 3), ("us", 6), ("ns", 9)])
@pytest.mark.parametrize("name", ["time", "timestamp", "time_s"])
def test_dates_counted_in_another_unit_are_asked_for(tmp_path, name, unit, digits):
    # Whole numbers: doubles do not hold nanoseconds since 1970.
    stamps = [1_700_000_000 * 10**digits + 5 * 10 ** (digits - 3) * int(k) for k in K]
    lines = [f"{stamp},{u},{y}" for stamp, u, y in zip(stamps, U, Y, strict=True)]
    path = written(tmp_path, ",", [name, "u_V", "y_rad"], lines=lines)
    with pytest.raises(ValueError, match=f"since 1970: state --time-unit {unit}"):
        Record.from_file(path, ["u_V"], ["y_rad"], time=name)
    assert Record.from_file(path, ["u_V"], ["y_rad"], time=name, time_unit=unit).dt_s == DT_S


@pytest.mark.parametrize(
    ("name", "stamp", "unit"),
    [
        ("time", lambda k: 45987.5 + DT_S * k / 86400, "d"),
        ("time", lambda k: 0.25 + DT_S * k / 86400, "d"),
        *[("Datum", lambda k: 45987.5 + 0.1 * k / 86400, "d"), ("t", lambda k: 0.5 + k / 86400, "d")],
        *[("t", lambda k: DT_S * k / 3600, "h"), ("t [us]", lambda k: DT_S * k, "s")],
        *[("time", lambda k: 0.371 + 5 * k + 0.011 * (k % 3), "ms"), ("time_s", lambda k: 5e3 * k, "us")],
        ("t", lambda k: 2.5 * k, "ms"),
    ],
)
def test_steps_that_no_machine_has_are_asked_for(tmp_path, name, stamp, unit):
    """Days, hours and milliseconds taken for seconds: a step is a microsecond at least, a second at most."""
    path = written(tmp_path, ";", [name, "u_V", "y_rad"], lines=[f"{stamp(k):.14g};{U[k]};{Y[k]}" for k in K])
    with pytest.raises(ValueError, match=rf"no machine .*--time-unit {unit}\b"):
        Record.from_file(path, ["u_V"], ["y_rad"], time=name)
    read = Record.from_file(path, ["u_V"], ["y_rad"], time=name, time_unit=unit, repair=True)
    assert 1e-3 < read.dt_s < 1.001


def test_slow_samples_of_a_motion_are_asked_for_and_others_taken():
    """Of white noise, or of what stands still, nobody can say that the samples are too close."""
    seen, unseen = np.sin(0.1 * K), np.random.default_rng(0).standard_normal(N)
    for dt_s, words in ((200.0, "of a rate of 200 Hz it is 0.005"), (1e-7, "logged that fast")):
        with pytest.raises(ValueError, match=words):
            flexlink.Record(u=U, y=seen, dt_s=dt_s)
    for dt_s, y in ((1.0, seen), (10.0, unseen), (1e-6, seen)):
        assert flexlink.Record(u=U, y=y, dt_s=dt_s).dt_s == dt_s


SEVEN = (T_S - 0.2).round(9)
# Lines above the numbers, with bars between them; the numbers; the names of time, input and output.
SCOPES = {
    "Rigol": (
        "X,CH1,CH2,Start,Increment,|Sequence,Volt,Volt,-2.000000e-01,5.000000e-03",
        [f"{k},{U[k]:.3e},{Y[k]:.6e},," for k in K],
        ("X", "CH1", "CH2"),
    ),
    "Rigol, start and step in the head alone": (
        "X,CH1,CH2,Start,Increment|Sequence,VOLT,VOLT,-5.000000e-01,5.000000e-03",
        [f"{k},{U[k]:.3e},{Y[k]:.6e}" for k in K],
        ("X", "CH1", "CH2"),
    ),
    "Infiniium": (
        "Revision:,1|Type:,raw|Points:,80|XInc:,5.0E-3|XOrg:,-5.0E-1|YUnits:,Volt|Data:,",
        [f"{U[k]:.3e},{Y[k]:.6e}" for k in K],
        ("time", "column 1", "column 2"),
    ),
    "Rohde & Schwarz, semicolons": ("Time;Ch1Wfm1;Ch2Wfm1", rows(";", SEVEN), ("Time", "Ch1Wfm1", "Ch2Wfm1")),
    "Rigol without stamps": (
        "CH1V,CH2V,t0 =-0.2, tInc = 0.005,",
        [f"{U[k]:.3e},{Y[k]:.6e},," for k in K],
        ("time", "CH1V", "CH2V"),
    ),
    "Tektronix": (
        "Model,MDO3024|Firmware Version,1.26||Point Format,Y,|Horizontal Units,S,|Sample Interval,5e-03|"
        "Record Length,80|Probe Attenuation,1,10|Vertical Units,V,V|Label,,|TIME,CH1,CH2",
        rows(",", SEVEN),
        ("TIME", "CH1", "CH2"),
    ),
    "Keysight": ("x-axis,1,2|second,Volt,Volt", rows(",", SEVEN), ("x-axis", "1", "2")),
    "Siglent": (
        "Record Length,Analog:80|Sample Interval,0.005|Vertical Units,V,V|Source,CH1,CH2|Second,Volt,Volt",
        rows(",", SEVEN),
        ("Source", "CH1", "CH2"),
    ),
    "LeCroy": (
        "LECROYHDO4034,12345,Waveform|Segments,1,SegmentSize,80|Segment,TrigTime,TimeSinceSegment1|"
        "#1,01-Mar-2024 12:00:00,0|Time,Ampl,Ampl2",
        rows(",", SEVEN),
        ("Time", "Ampl", "Ampl2"),
    ),
    "Rohde & Schwarz": ("in s,CH1 in V,CH2 in V", rows(",", SEVEN), ("in s", "CH1 in V", "CH2 in V")),
    "PicoScope": (
        "Time,Channel A,Channel B|(ms),(V),(V)|",
        rows(",", 1e3 * SEVEN),
        ("Time", "Channel A", "Channel B"),
    ),
    "LabVIEW": (
        "LabVIEW Measurement\t|Writer_Version\t2|Separator\tTab|X_Columns\tOne|Date\t2024/03/01|"
        "***End_of_Header***\t|\t|Channels\t2\t\t|Samples\t80\t80\t|Date\t2024/03/01\t2024/03/01\t|"
        "Time\t12:00:00.5\t12:00:00.5\t|Y_Unit_Label\tVolts\tVolts\t|X_Dimension\tTime\tTime\t|"
        "X0\t0.0E+0\t0.0E+0\t|Delta_X\t0.005\t0.005\t|***End_of_Header***\t\t\t|"
        "X_Value\tDrive\tHub\tComment",
        rows("\t"),
        ("X_Value", "Drive", "Hub"),
    ),
    "LabVIEW without stamps": (
        "LabVIEW Measurement\t|X_Columns\tNo|***End_of_Header***\t||Channels\t2\t\t|Samples\t80\t80\t|"
        "X_Dimension\tTime\tTime\t|X0\t0.0E+0\t0.0E+0\t|Delta_X\t0.005\t0.005\t|"
        "***End_of_Header***\t\t\t|X_Value\tDrive\tHub\tComment",
        [f"\t{U[k]}\t{Y[k]}" for k in K],
        ("X_Value", "Drive", "Hub"),
    ),
    "CODESYS": (
        "Trace;MyTrace|Task;MainTask||Time [us];PLC_PRG.rDrive;PLC_PRG.rHub",
        rows(";", 1e6 * T_S),
        ("Time [us]", "PLC_PRG.rDrive", "PLC_PRG.rHub"),
    ),
    "a data logger": (
        "Logger,5.2,0.1|Channels,1,2|Gain,1,10|Offset,0,0|Elapsed,Drive,Hub|s,V,mm",
        rows(),
        ("Elapsed", "Drive", "Hub"),
    ),
}


@pytest.mark.parametrize("name", SCOPES)
def test_instruments(name, tmp_path):
    above, lines, (time, drive, hub) = SCOPES[name]
    file = "a.lvm" if "LabVIEW" in name else "a.csv"
    path = written(tmp_path, ",", [], above=above.split("|"), lines=lines, file=file)
    table = read_table(path)
    assert time_of(table) == time
    record = Record.from_file(table, [drive], [hub], time=time)
    assert record.dt_s == pytest.approx(DT_S, rel=1e-9)
    np.testing.assert_allclose(record.input[:, 0], U, rtol=1e-6)
    np.testing.assert_allclose(record.output[:, 0], Y, rtol=1e-6)
    if "Volt" in above and "Infiniium" not in name:
        assert record.input_units == ("V",)


def test_a_single_column_named_like_a_step_of_sampling_is_read():
    layout, columns = read_text("Sampling [ms]\n1\n2\n3\n4\n")
    assert columns == {"Sampling [ms]": ("1", "2", "3", "4")}
    assert (layout.header, layout.first) == (1, 2)


@pytest.mark.parametrize("share", [1, 3])
def test_topics_at_rows_of_their_own(tmp_path, share):
    """The input is sent before every `share`-th reading; the rows are those of the output, the input held."""
    lines, sent = [], np.repeat(U[::share], share)[:N]
    for k in K:
        if k % share == 0:
            lines.append(f"{1.7e9 + T_S[k] - 1e-3:.6f},{U[k]},")
        lines.append(f"{1.7e9 + T_S[k]:.6f},,{Y[k]}")
    path = written(tmp_path, ",", ["__time", "/cmd/voltage", "/arm/position"], lines=lines)
    roles = roles_of(read_table(path), "a.csv")
    assert (roles.time, roles.input, roles.output) == ("__time", "/cmd/voltage", "/arm/position")
    record = Record.from_file(path, ["/cmd/voltage"], ["/arm/position"], time="__time")
    np.testing.assert_array_equal(record.output[:, 0], Y)
    np.testing.assert_array_equal(record.input[:, 0], sent)
    assert [note.kind for note in record.doubts] == [FindingKind.HELD]


def test_what_is_missing_is_no_topic(tmp_path):
    """A reading that is not there, and a vector that ends before the others."""
    names, lines = ["t_s", "u_V", "y_rad"], rows()
    lines[20] = f"{T_S[20]:.9g},,{Y[20]:.9g}"
    with pytest.raises(ValueError, match="line 22: column 'u_V' is empty"):
        Record.from_file(written(tmp_path, ",", names, lines=lines), ["u_V"], ["y_rad"], time="t_s")
    lines = [line if k < 40 else line.rpartition(",")[0] + "," for k, line in enumerate(rows())]
    with pytest.raises(ValueError, match=r"column 'y_rad' ends at line 41, others at line 81; .* cut the"):
        Record.from_file(written(tmp_path, ",", names, lines=lines), ["u_V"], ["y_rad"], time="t_s")
