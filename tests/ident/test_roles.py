"""Columns found by names and units, or a command to type."""

import re

import numpy as np
import pytest

from ident.data.roles import Roles, is_position, roles_of
from ident.data.table import Table


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
    assert str(caught.value) == (
        "a.csv: which is the output, hub_rad or tip_m? It has t_s, u_V, hub_rad, tip_m; type: flexlink "
        "identify 'my log.csv' --input u_V --output hub_rad --time t_s"
    )


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
