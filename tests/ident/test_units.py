"""Units in headers, columns found by them, logs in different ones: recognised, refused, kept to the bit."""

import re
import subprocess
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

import flexlink
from ident.data.finding import FindingKind
from ident.data.foreign_files import path_as_typed
from ident.data.record import Record, in_one_unit
from ident.data.roles import Roles, is_position, roles_of, time_of
from ident.data.table import Table
from ident.data.units import TimeColumn, contradicted_by_loop, kind_of, per, says_time, size_of, written_unit
from workflow.engine.errors import cut_inside, one_line

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
        *[(gain, ("rad", "rad"), None) for gain in (1.0, 0.3, 20.0, 100.0)],
        *[(-gain, ("rad", "rad"), "--scale y=-1 --unit y=rad") for gain in (1.0, 0.3, 180 / np.pi)],
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


def table(*names: str, **units: str) -> Table:
    return Table("a.csv", {name: np.sin(np.arange(5.0) + k) for k, name in enumerate(names)}, units=units)


def test_units_beside_the_names():
    log = table("hub", "motor", "clock", hub="rad", motor="Nm", clock="s")
    assert roles_of(log, "a.csv") == Roles("clock", "motor", "hub")


def test_what_is_stated_decides():
    three = table("t_s", "u_V", "hub_rad", "tip_m")
    assert roles_of(three, "a.csv", output="tip_m") == Roles("t_s", "u_V", "tip_m")
    with pytest.raises(ValueError) as caught:
        roles_of(three, "'my log.csv'")
    question, _, command = str(caught.value).partition("; type: ")
    assert question.startswith("a.csv: ")
    assert "output, hub_rad or tip_m" in question
    assert command == "flexlink identify 'my log.csv' --input u_V --output hub_rad --time t_s"


def test_of_two_columns_without_a_known_name_the_follower_is_the_output():
    wave = np.cumsum(np.random.default_rng(3).standard_normal(400))
    columns = {"t_s": np.arange(400) * 0.01, "a_deg": wave[5:], "b_deg": wave[:-5], "i_A": np.sin(wave)}
    shortest = min(column.size for column in columns.values())
    log = Table("a.csv", {name: column[:shortest] for name, column in columns.items()}, units={})
    with pytest.raises(ValueError, match=r"--input i_A --output b_deg --reference a_deg --time t_s$"):
        roles_of(log, "a.csv", "init")


def servo(*names):
    """Reference, measured position and command of a motor under proportional control, by name."""
    rng = np.random.default_rng(5)
    reference = rng.uniform(-5, 5, 12).repeat(50)
    position = speed = 0.0
    rows = []
    for wished in reference:
        reading = position + 1e-4 * rng.standard_normal()
        command = 0.4 * (wished - reading) - 0.2 * speed
        rows.append((wished, reading, command))
        speed += 0.3 * command - 0.05 * speed
        position += speed
    columns = dict(zip(names, np.array(rows).T, strict=True))
    return Table("a.csv", {"t": 0.01 * np.arange(len(rows)), **columns})


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("names", ["xr_mm x1_mm u_V", "yr y u", "qg qm vir", "theta_r theta torque"])
def test_of_twins_in_a_loop_the_reference_is_what_the_command_does_not_move(names, turned):
    log = servo(*names.split())
    if turned:
        log = Table("a.csv", dict(reversed(log.raw.items())))
    reference, output, command = names.split()
    assert roles_of(log, "a.csv") == Roles("t", command, output, reference)


def test_two_measured_positions_in_open_loop_have_no_reference():
    rng = np.random.default_rng(6)
    command = rng.choice([-3.0, 3.0], 60).repeat(10)
    motor = np.concatenate([[0.0], np.cumsum(np.convolve(command, 0.9 ** np.arange(40))[:599])])
    load = np.convolve(motor, [0, 0, 0.1, 0.2, 0.3, 0.4])[:600] + rng.standard_normal(600)
    for first, second in (("motor_rad", "load_rad"), ("x1_mm", "xr_mm"), ("x1_mm", "x2_mm")):
        log = Table("a.csv", {"t_s": 0.01 * np.arange(600), "u_V": command, first: motor, second: load})
        with pytest.raises(ValueError, match=rf"--input u_V --output {first} --time t_s$"):
            roles_of(log, "a.csv")


@pytest.mark.parametrize(
    "name",
    [
        "arm controller/joint state.positions[0] (measured)",
        "a  b",
        "drive's",
        "tab\there",
        "Winkel\u00a0x",
        "-x",
    ],
)
def test_a_command_to_type_has_names_in_full(name):
    """As a shell reads it back, in whatever way it is quoted."""
    log = table("t_s", "i_meas_A", "i_cmd_A", name + "_rad")
    with pytest.raises(ValueError) as caught:
        roles_of(log, path_as_typed("my log.csv"))
    command = cut_inside(one_line(str(caught.value))).partition("type: ")[2]
    shell = subprocess.run(
        ["bash", "-c", f"printf '%s\\0' {command}"],
        capture_output=True,
        check=True,
        env={"LC_ALL": "C.UTF-8"},
    )
    words = shell.stdout.decode().split("\0")[:-1]
    assert words[:3] == ["flexlink", "identify", "my log.csv"]
    assert words[words.index("--output") + 1] == name + "_rad"


def test_a_first_column_that_rises_may_be_time_but_a_rows_number_is_none():
    for dt, typed in ((0.002, "--time a$"), (1.0, "--dt-s SECONDS$")):
        log = Table(
            "a.csv", {"a": np.arange(9) * dt, "u_V": np.arange(9) % 3, "b": np.arange(9) % 4}, units={}
        )
        with pytest.raises(ValueError, match=typed):
            roles_of(log, "a.csv")


def test_nothing_is_guessed():
    with pytest.raises(ValueError, match="--input NAME --output NAME --dt-s SECONDS"):
        roles_of(table("a", "b", "c"), "a.csv")


def test_many_long_names_stay_on_a_line():
    with pytest.raises(ValueError) as caught:
        roles_of(table(*(f"channel {k} " + "x" * 500 for k in range(300))), "a.csv")
    assert len(str(caught.value)) <= 300


# Time, input, output and reference, and what else is there.
FOUND = """
t_ms,i_cmd_A,enc_rad,ref_rad|t_s,torque_Nm,pos_mm,cmd_pos|t_s,v_drive_counts,theta_rad,u_ref_rad|t_s,u,y,r,e
t_s,tau_Nm,q_rad,q_des_rad,err_rad|t_s,u_V,pos_rad,pos_ref_rad,vel_rad_s|t_s,u_ref_V,hub_rad,|t_s,u_V,pos_rad,posRef_rad
t_s,Commanded_PWM,Motor_Speed(RPM),|t_s,Strom Soll [A],Istwinkel [deg],Sollwinkel [deg]|t_s,i_A,PV_mm,SP_mm
t_s,current_A,angle_deg,set_deg|t_s,Courant [A],Mesure [deg],Consigne [deg]
t_s,电流(A),实际角度(deg),给定角度(deg)
t,/cmd/voltage,/joint_states/motor/position,,bus.count|t,PLC_PRG.rVoltage,PLC_PRG.rAngle,|t,bus.command,bus.theta,
t,MAIN.fTorque,MAIN.lrPosition,|t_ms,torque_cmd_%,x_mm,x_ref_mm|t_us,dac_cnt,enc_cnt,ref_cnt|t_s,foo,pv_deg,sp,note
t_us,out_cnt,pv_cnt,sp_cnt|t_s,output_%,position_mm,setpoint_mm
t_s,u,current_position,target,v_est|t_s,cmd,pos,ref,vel_est|t_s,pid_out,y_deg,r_deg
t_s,y_axis_torque,y_axis_rpm,|ms_today,q_axis_current,erpm,|t_s,pwm,v_wheel,|t_s,voltage,v_wheel_speed,|t_s,q_current,speed,
t_ms,current_A,pos_cnt,pos_ref_cnt,vel_ref_cnt_s|t_ms,pwm,vel_cnt_s,vel_ref_cnt_s,pos_ref_cnt|t_s,pwm,pos,pos_ref,vel_ref
t_s,y_motor_current,y_position,|t_s,q_voltage,u_angle,|t_s,v,y,
t_s,u_V,meas,ref_deg,temp|t_s,i_A,alpha,alpha_cmd,alpha_err,index
Zeit [ms],Spannung [V],Winkel [°],|,voltage,angle,,temperature"""
ASKED = """
t_s,i_meas_A,i_cmd_A,pos_rad>--input i_cmd_A --output pos_rad|t_s,u_ref_rad,u_cmd>--input u_cmd --output NAME
t_s,temperature,angle_rad>name it: flexlink init a.csv --input NAME
t_s,foo,angle_rad>--input foo --output angle_rad
t_s,accel_counts>no column looks like an input|t_s,cmd_deg,pos_deg>--input cmd_deg --output pos_deg
t_s,ref_rad,foo,bar,y_rad>--input NAME --output y_rad --reference ref_rad
t_s,ref_rad,temp_°C,y_rad>--input NAME"""


@pytest.mark.parametrize("case", re.split(r"[|\n]", (FOUND + ASKED).strip()))
@pytest.mark.parametrize("turned", [False, True])
def test_roles_by_name_and_unit_in_any_order(case, turned):
    """A reference is in the unit of the output; of a name the last word counts."""
    names, _, asked = case.partition(">")
    order = [name for name in names.split(",")[:: -1 if turned else 1] if name]
    columns = {name: np.sin(k + np.arange(50.0)) for k, name in enumerate(order)}
    columns |= {name: np.arange(50.0) for name in order if re.fullmatch(r"t(_m?u?s)?|Zeit.*", name)}
    log = Table("a.csv", columns | ({"note": ("ok",) * 50} if "note" in order else {}), units={})
    if asked:
        with pytest.raises(ValueError, match=asked):
            roles_of(log, "a.csv", "init")
        return
    time, input_, output, reference, *_ = names.split(",")
    assert roles_of(log, "a.csv", "init") == Roles(time or None, input_, output, reference or None)


def test_two_references_are_asked_for_with_all_that_was_said():
    two = table("t_s", "i_A", "a_ref_rad", "b_ref_rad", "a_rad", "b_rad")
    with pytest.raises(
        ValueError, match=r"a_ref_rad and b_ref_rad may be .* --output a_rad --reference a_ref_rad$"
    ):
        roles_of(two, "a.csv", "init", output="a_rad")
    assert roles_of(two, "a.csv", "init", output="a_rad", reference="b_ref_rad").reference == "b_ref_rad"


@pytest.mark.parametrize("case", ["q rad 1", "q rad/s ", "speed  ", "angle  1", "n rpm "])
def test_speeds_are_no_positions(case):
    name, unit, position = case.split(" ")
    assert is_position(name, unit) == bool(position)


N, DT_S = 400, 0.005
U = np.repeat(np.random.default_rng(3).choice([-2.0, 2.0], N // 4), 4)
Y = 0.05 * np.convolve(U, np.r_[0, 0.3 * 0.7 ** np.arange(N)])[:N] + 1e-4 * np.random.default_rng(
    4
).standard_normal(N)


def written(folder, name, units=("V", "rad"), sizes=(1.0, 1.0), reference=None):
    """Where a file has a reference it is in its own unit: (unit, size)."""
    unit, size = reference or ("", 1.0)
    rows = (
        f"{DT_S * k:.3f},{u / sizes[0]:.9g},{y / sizes[1]:.9g},{u / size:.9g}"
        for k, (u, y) in enumerate(zip(U, Y, strict=True))
    )
    path = folder / name
    path.write_text("\n".join(["time,voltage,angle,wish", ",".join(["s", *units, unit]), *rows]) + "\n")
    return path


def read(path, **more):
    return Record.from_file(path, ["voltage"], ["angle"], time="time", **more)


@pytest.mark.parametrize(
    ("units", "sizes", "said"),
    [
        (("V", "deg"), (1, np.pi / 180), {"angle"}),
        (("mV", "rad"), (1e-3, 1), {"voltage"}),
        (("kV", "rev"), (1e3, 2 * np.pi), {"angle", "voltage"}),
        (("Volts", "mrad"), (1, 1e-3), {"angle"}),
        (("V", ""), (1, 1), set()),
        (("", "deg"), (1, np.pi / 180), {"angle"}),
        (("V", "radians"), (1, 1), set()),
    ],
)
def test_records_of_one_set_are_in_the_unit_of_the_first(tmp_path, units, sizes, said):
    first = read(written(tmp_path, "a.csv"))
    one, other = in_one_unit([first, read(written(tmp_path, "b.csv", units, sizes))])
    assert one is first
    np.testing.assert_allclose(other.input, one.input, rtol=1e-7)
    np.testing.assert_allclose(other.output, one.output, rtol=1e-7, atol=1e-12)
    notes = [note for note in other.notes if note.kind is FindingKind.UNIT_CONVERTED]
    assert {note.values["name"] for note in notes} == said
    assert in_one_unit([one, other]) == [one, other]


def test_a_reference_is_converted_with_its_output(tmp_path):
    loop = {"references": ["wish"]}
    first = read(written(tmp_path, "a.csv", reference=("rad", 1.0)), **loop)
    turned = written(tmp_path, "b.csv", ("V", "deg"), (1, np.pi / 180), ("deg", np.pi / 180))
    other = in_one_unit([first, read(turned, **loop)])[1]
    np.testing.assert_allclose(other.reference, first.reference, rtol=1e-7)
    assert other.output_units == ("rad",)


@pytest.mark.parametrize(("unit", "more"), [("counts", {}), ("ell", {}), ("deg", {"scale": {"angle": 2.0}})])
def test_units_of_two_quantities_or_one_scale_for_two_are_refused(tmp_path, unit, more):
    records = [read(written(tmp_path, f"{own}.csv", ("V", own)), **more) for own in ("rad", unit)]
    with pytest.raises(ValueError, match=rf"{unit}.csv: 'angle' is in .*{unit}, in \S*rad.csv in .*rad"):
        in_one_unit(records)
    with pytest.raises(ValueError, match="'angle' is in"):
        flexlink.identify(records, n_pairs=0, n_real=1)
    stated = [
        read(written(tmp_path, f"{own}.csv", ("V", own)), units={"angle": "rad"}) for own in ("rad", unit)
    ]
    assert in_one_unit(stated) == stated


def test_commands_read_all_logs_in_one_unit(tmp_path, flexlink, refused):
    """Also those for validation, and the limit of the input is in the unit of the first."""
    a, b = written(tmp_path, "a.csv"), written(tmp_path, "b.csv", ("mV", "deg"), (1e-3, np.pi / 180))
    c = written(tmp_path, "c.csv", ("V", "counts"))
    named = ("--input", "voltage", "--output", "angle", "--time", "time", "--real", "1", "--pairs", "0")
    answer = flexlink("identify", a, "--validation", b, *named, "--input-limit", "1.5", "--json")
    assert "b.csv: 'voltage' is in mV, in the first log in V" in answer.out
    assert answer.out.count('"input_cut_samples": 400') == 2
    assert "'angle' is in counts" in refused("identify", a, "--validation", c, *named)
    assert "'angle' is in counts" in refused("init", a, c, "--out", tmp_path / "new.toml")
    configuration = tmp_path / "run.toml"
    records = "".join(
        f'[[source.records]]\npath = "{log.name}"\nrole = "{role}"\n'
        for log, role in ((a, "estimation"), (c, "validation"))
    )
    configuration.write_text(
        f'[source]\nkind = "files"\ntime = "time"\n{records}'
        '[[channels]]\ninput = "voltage"\noutput = "angle"\n'
        "[specification]\nbandwidth_rad_s = 4.0\n"
    )
    assert "'angle' is in counts" in refused("run", "--config", configuration, "--out", tmp_path / "out")
