"""Units in headers: what is recognised, what is refused, and that seconds come back with their very bits."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ident.data.record import Record
from ident.data.roles import roles_of, time_of
from ident.data.table import Table
from ident.data.units import TimeColumn, contradicted_by_loop, kind_of, per, says_time, size_of, written_unit

PER_SECOND = {"s": 1, "ms": 1000, "us": 10**6, "ns": 10**9, "min": Fraction(1, 60), "h": Fraction(1, 3600)}


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        *[("Angle [deg]", "deg"), ("voltage_mV", "mV"), ("u in mV", "mV"), ("hub_angle_rad", "rad")],
        *[
            ("acc_m_s2", "m/s2"),
            ("v_m/s", "m/s"),
            ("v in m/s", "m/s"),
            ("F/N", "N"),
            ("tip (furlong)", "furlong"),
        ],
        *[("u", ""), ("u_reaction_torque", ""), ("y[1]", ""), ("motor_command", ""), ("set_point", "")],
        *[
            ("speed_rev_s", "rev/s"),
            ("counts_s", "counts/s"),
            ("velocity_rot_per_s", "rot/s"),
            ("u_step", ""),
        ],
        *[
            ("gyro_dps", "dps"),
            ("wheel_rev_min", "rev/min"),
            ("x_per_s", "1/s"),
            ("n_turns", ""),
            ("t_s", "s"),
        ],
        *[("flow_pulses_s", "pulses/s"), ("acc_deg_s2", "deg/s2"), ("slide_inch_s", "inch/s")],
    ],
)
def test_units_of_signals_are_carried_along(header, unit):
    assert written_unit(header) == unit


@pytest.mark.parametrize(
    "unit",
    ["rev", "rot", "turn", "counts", "step", "tick", "pulse", "inch", "per", "x_per", "inc", "imp_per"],
)
def test_what_is_per_second_is_a_speed_and_no_time(unit):
    """Neither alone nor behind a word, nor beside a column of time."""
    k = np.arange(9.0)
    for name in (f"{unit}_s", f"speed_{unit}_s"):
        table = Table(Path("a.csv"), {"t_s": 0.01 * k, "u_V": k % 2, name: k % 3})
        assert not says_time(name)
        assert (time_of(table), kind_of(table.unit(name))[-2:]) == ("t_s", "/s")
        if unit not in ("per", "x_per"):
            assert roles_of(table, "a.csv").output == name


def test_a_rate_is_its_quantity_over_its_time():
    for over in ("rad", "deg", "rev", "mm", "counts"):
        for under, seconds in (("s", 1), ("ms", 1e-3), ("min", 60), ("h", 3600)):
            kind, size = size_of(over)
            assert size_of(f"{over}/{under}") == (f"{kind}/s", pytest.approx(size / seconds))
    assert per("rpm", "deg/s") == pytest.approx(6)
    assert per("dps", "rad/s") == pytest.approx(np.pi / 180)
    assert per("counts", "rad") is None
    assert size_of("angle_deg_min") is None


@pytest.mark.parametrize(
    ("gain", "units", "options"),
    [
        (180 / np.pi, ("rad", "rad"), "--scale y=0.01745329252 --unit y=rad"),
        (180 / np.pi, ("deg/s", "deg/s"), "--scale r=57.29577951"),
        (np.pi / 180, ("rad", "rad"), "--scale r=0.01745329252"),
        (np.pi / 180, ("", ""), "--scale r=0.01745329252"),
        (0.9 * 1e3, ("m", "m"), "--scale y=0.001 --unit y=m"),
        (1e-3, ("mm", "mm"), "--scale y=1000 --unit y=mm"),
        (1e-3, ("mm", "m"), "--scale r=0.001"),
        *[(gain, ("rad", "rad"), None) for gain in (1.0, 0.3, 20.0, 100.0, -180 / np.pi)],
    ],
)
def test_an_output_that_follows_but_for_a_unit(gain, units, options):
    """First order at 36 rad/s, sampled at 100 Hz, behind a reference that is white up to 50 Hz."""
    reference, noise = np.random.default_rng(4).standard_normal((2, 4000)) * [[1.0], [0.01]]
    output = np.convolve(reference, np.r_[0, 0.3 * 0.7 ** np.arange(60)])[:4000]
    output, names, units = gain * (output + noise) + 7, ("r", "y", "u"), (*units, "N m")
    found = contradicted_by_loop(reference, output, noise, names, units, {})
    assert [item.values["options"] for item in found] == ([options] if options else [])
    assert contradicted_by_loop(reference, gain * noise[::-1], noise, names, units, {}) == ()
    found = contradicted_by_loop(reference, 50 * noise, output / gain, names, units, {})
    assert [item.kind.name for item in found] == ["EXCHANGED"] * (units[0] != "")


@given(st.sampled_from(sorted(PER_SECOND)), st.lists(st.integers(0, 10**6), min_size=1, max_size=9))
def test_seconds_are_the_doubles_nearest_to_the_decimals_in_the_file(unit, ticks):
    """Whole numbers of any unit up to 1e6 are exact doubles, and one exact operation is rounded once."""
    seconds = TimeColumn.of(f"t [{unit}]").seconds(np.array(ticks, dtype=np.float64))
    assert seconds.tolist() == [float(Fraction(k) / PER_SECOND[unit]) for k in ticks]


@given(st.sampled_from(["s", "ms", "us", "ns"]), st.integers(1, 10**6), st.integers(3, 50))
def test_a_written_log_reads_back_with_its_sampling_time(tmp_path_factory, unit, step_us, n):
    path = tmp_path_factory.mktemp("log") / "log.npz"
    stamps = np.array([float(Fraction(k * step_us, 10**6) * PER_SECOND[unit]) for k in range(n)])
    np.savez(path, **{f"t_{unit}": stamps, "u_V": np.ones(n), "y": np.ones(n)})
    record = Record.from_file(path, ["u_V"], ["y"], time=f"t_{unit}")
    assert record.dt_s == step_us / 10**6
    assert (record.input_units, record.output_units) == (("V",), ())


@pytest.mark.parametrize(
    ("name", "stated", "stamps", "doubtful"),
    [
        ("t", None, 5.0 * np.arange(10), True),
        ("time_s", None, np.arange(1.0, 10.0), True),
        ("t", None, 0.5 + 2.5 * np.arange(1200), True),
        ("t", None, 0.25 + 0.5 * np.arange(900), False),
        ("t", None, 0.002 * np.arange(4000), False),
        ("t", "s", 5.0 * np.arange(10), False),
        *[("t_ms", None, 5.0 * np.arange(10), False), ("t_ms", None, 0.002 * np.arange(10), True)],
        *[("t_us", None, 0.01 * np.arange(10) + 1, True), ("t_ms", None, 0.02 * np.arange(10), False)],
        *[("t_us", None, 5.0 * np.arange(10), False), ("t_ms", "ms", 0.002 * np.arange(10), False)],
    ],
)
def test_steps_of_another_unit_are_doubted(name, stated, stamps, doubtful):
    assert TimeColumn.of(name, stated).doubtful_for(stamps) is doubtful


def test_what_is_stated_counts_more_than_the_header():
    column = TimeColumn.of("t_ms", "s")
    assert (column.unit, column.in_header, column.stated) == ("s", "ms", True)


def test_a_unit_without_a_time_column_is_refused(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("u,y\n1,2\n3,4\n")
    with pytest.raises(ValueError, match="without a time column"):
        Record.from_file(path, ["u"], ["y"], dt_s=0.1, time_unit="ms")
