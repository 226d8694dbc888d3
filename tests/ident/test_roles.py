"""Columns found by names and units, or a command to type."""

from __future__ import annotations

import numpy as np
import pytest

from ident.data.roles import Roles, is_position, roles_of
from ident.data.table import Table


def table(*names: str, **units: str) -> Table:
    return Table("a.csv", {name: np.arange(5.0) + k for k, name in enumerate(names)}, units=units)


@pytest.mark.parametrize(
    ("names", "units", "found"),
    [
        (("t_s", "u_V", "y_rad"), {}, Roles("t_s", "u_V", "y_rad")),
        (("Zeit [ms]", "Spannung [V]", "Winkel [°]"), {}, Roles("Zeit [ms]", "Spannung [V]", "Winkel [°]")),
        (
            ("hub", "motor", "clock"),
            {"hub": "rad", "motor": "Nm", "clock": "s"},
            Roles("clock", "motor", "hub"),
        ),
        (("voltage", "angle", "temperature"), {}, Roles(None, "voltage", "angle")),
    ],
)
def test_roles(names, units, found):
    assert roles_of(table(*names, **units), "a.csv") == found


def test_what_is_stated_decides():
    three = table("t_s", "u_V", "hub_rad", "tip_m")
    assert roles_of(three, "a.csv", output="tip_m") == Roles("t_s", "u_V", "tip_m")
    with pytest.raises(ValueError) as caught:
        roles_of(three, "'my log.csv'")
    assert str(caught.value) == (
        "a.csv: which columns? It has t_s, u_V, hub_rad, tip_m; type: flexlink identify 'my log.csv' "
        "--input u_V --output hub_rad --time t_s"
    )


@pytest.mark.parametrize(
    ("wished", "drive", "moved"),
    [
        ("Sollwinkel [deg]", "Strom Soll [A]", "Istwinkel [deg]"),
        ("set_deg", "current_A", "angle_deg"),
        ("Consigne [deg]", "Courant [A]", "Mesure [deg]"),
        ("给定角度(deg)", "电流(A)", "实际角度(deg)"),
        ("posRef_rad", "u_V", "pos_rad"),
        ("SP_mm", "i_A", "PV_mm"),
    ],
)
def test_set_points_by_other_names(wished, drive, moved):
    names = ("t_s", moved, wished, drive)
    roles = roles_of(table(*names), "a.csv", "init")
    assert roles == Roles("t_s", drive, moved, wished)


def test_of_two_columns_without_a_known_name_the_follower_is_the_output():
    wave = np.cumsum(np.random.default_rng(3).standard_normal(400))
    columns = {"t_s": np.arange(400) * 0.01, "a_deg": wave[5:], "b_deg": wave[:-5], "i_A": np.sin(wave)}
    shortest = min(column.size for column in columns.values())
    log = Table("a.csv", {name: column[:shortest] for name, column in columns.items()}, units={})
    with pytest.raises(ValueError, match=r"--input i_A --output b_deg --reference a_deg --time t_s$"):
        roles_of(log, "a.csv", "init")


def test_a_first_column_that_rises_may_be_time_but_a_rows_number_is_none():
    for dt, typed in ((0.002, "--time a$"), (1.0, "--dt-s SECONDS$")):
        log = Table(
            "a.csv", {"a": np.arange(9) * dt, "u_V": np.arange(9) % 3, "b": np.arange(9) % 4}, units={}
        )
        with pytest.raises(ValueError, match=typed):
            roles_of(log, "a.csv")


def test_the_reference_of_a_voltage_may_be_what_drives_the_arm():
    assert roles_of(table("t_s", "u_ref_V", "hub_rad"), "a.csv") == Roles("t_s", "u_ref_V", "hub_rad")


def test_nothing_is_guessed():
    with pytest.raises(ValueError, match="--input NAME --output NAME --dt-s SECONDS"):
        roles_of(table("a", "b", "c"), "a.csv")


def test_many_long_names_stay_on_a_line():
    with pytest.raises(ValueError) as caught:
        roles_of(table(*(f"channel {k} " + "x" * 500 for k in range(300))), "a.csv")
    assert len(str(caught.value)) <= 300


@pytest.mark.parametrize(
    ("input_", "output"),
    [
        ("/cmd/voltage", "/joint_states/motor/position"),
        ("PLC_PRG.rVoltage", "PLC_PRG.rAngle"),
        ("MAIN.fTorque", "MAIN.lrPosition"),
        ("bus.command", "bus.theta"),
    ],
)
def test_the_last_word_of_a_path_counts(input_, output):
    k = np.arange(50.0)
    table = Table("a.npz", {"t": 0.01 * k, input_: np.sin(k), output: np.cos(k), "bus.count": k})
    assert roles_of(table, "a.npz") == Roles("t", input_, output)


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (("t_ms", "ref_rad", "i_cmd_A", "enc_rad"), ("i_cmd_A", "enc_rad", "ref_rad")),
        (("t_s", "cmd_pos", "torque_Nm", "pos_mm"), ("torque_Nm", "pos_mm", "cmd_pos")),
        (("t_s", "u_ref_rad", "v_drive_counts", "theta_rad"), ("v_drive_counts", "theta_rad", "u_ref_rad")),
        (("t_s", "r", "u", "y", "e"), ("u", "y", "r")),
        (("t_s", "q_des_rad", "q_rad", "err_rad", "tau_Nm"), ("tau_Nm", "q_rad", "q_des_rad")),
        (("t_s", "pos_ref_rad", "pos_rad", "vel_rad_s", "u_V"), ("u_V", "pos_rad", "pos_ref_rad")),
        (("t_s", "u_ref_V", "hub_rad"), ("u_ref_V", "hub_rad", None)),
        (("t_s", "Commanded_PWM", "Motor_Speed(RPM)"), ("Commanded_PWM", "Motor_Speed(RPM)", None)),
        (("t_ms", "x_ref_mm", "torque_cmd_%", "x_mm"), ("torque_cmd_%", "x_mm", "x_ref_mm")),
        (("t_us", "ref_cnt", "dac_cnt", "enc_cnt"), ("dac_cnt", "enc_cnt", "ref_cnt")),
        (("t_s", "setpoint_mm", "output_%", "position_mm"), ("output_%", "position_mm", "setpoint_mm")),
        (("t_s", "v_est", "u", "current_position", "target"), ("u", "current_position", "target")),
    ],
)
def test_a_reference_is_recognised_by_its_name_in_the_unit_of_the_output(names, found):
    got = roles_of(table(*names), "a.csv", "init")
    assert (got.input, got.output, got.reference) == found


def test_two_references_are_asked_for_with_all_that_was_said():
    two = table("t_s", "i_A", "a_ref_rad", "b_ref_rad", "a_rad", "b_rad")
    with pytest.raises(
        ValueError, match=r"a_ref_rad and b_ref_rad may be .* --output a_rad --reference a_ref_rad$"
    ):
        roles_of(two, "a.csv", "init", output="a_rad")
    assert roles_of(two, "a.csv", "init", output="a_rad", reference="b_ref_rad").reference == "b_ref_rad"


@pytest.mark.parametrize(
    ("name", "unit", "position"),
    [
        ("q", "rad", True),
        ("q", "rad/s", False),
        ("speed", "", False),
        ("angle", "", True),
        ("n", "rpm", False),
    ],
)
def test_speeds_are_no_positions(name, unit, position):
    assert is_position(name, unit) == position
