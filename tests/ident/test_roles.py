"""Columns found by names and units, or a command to type."""

from __future__ import annotations

import numpy as np
import pytest

from ident.data.roles import Roles, roles_of
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


LOOP = table("t_s", "u_ref_rad", "v_drive_counts", "theta_rad", drive="counts")


def test_a_reference_is_neither_input_nor_output():
    """Columns of a measured arm in closed loop."""
    assert roles_of(LOOP, "a.csv", reference="u_ref_rad") == Roles("t_s", "v_drive_counts", "theta_rad")
    with pytest.raises(
        ValueError, match=r"--input v_drive_counts --output theta_rad --reference u_ref_rad --time t_s$"
    ):
        roles_of(LOOP, "a.csv")
    named = {"input": "v_drive_counts", "output": "theta_rad"}
    assert roles_of(LOOP, "a.csv", **named) == Roles("t_s", "v_drive_counts", "theta_rad")


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
