"""What an error depends on, in words, as a picture, and from columns that a model does not use."""

from dataclasses import replace

import pytest

from diagnosis.where.findings import Alternative, Dependence, PartGap, Where
from workflow.engine import codec
from workflow.figures.gap_where import draw_dependences
from workflow.text.dependence import alternatives_words, dependence_line, dependence_words

SPRING = Dependence(
    place="elbow", acts="force", quantity="position", of="elbow", unit="rad", own=True, value_unit="N m",
    centres=(-1.0, 0.0, 1.0), values=(7.8, 0.0, -7.8), standard_errors=(0.1, 0.1, 0.1), share=0.55,
    constant_share=0.0, judged_on="logs", shape="line", slope=-7.8, slope_error=0.1, beside=False, also=(),
)  # fmt: skip
PART = PartGap(5.0, (4.0, 6.0), 1.0, (0.9, 1.0), 0.0, True)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({}, "the angle of elbow: missing torque at elbow, 55 % of the error on logs not used; a spring"),
        ({}, "a spring of 7.8 N m/rad"),
        ({"slope": 7.8}, "grows by 7.8 N m/rad"),
        ({"own": False, "of": "shoulder"}, "the angle of shoulder: missing torque at elbow"),
        ({"quantity": "speed", "unit": "rad/s", "slope": -0.2}, "viscous friction of 0.2 N m s/rad"),
        ({"quantity": "speed", "unit": "rad/s", "slope": 0.2}, "less friction, by 0.2 N m s/rad"),
        ({"quantity": "speed", "unit": "rad/s", "slope": -0.2, "shape": "jump"}, "dry friction of 0.2 N m"),
        ({"quantity": "acceleration", "unit": "rad/s²", "slope": -0.03}, "more inertia of 0.03 kg m²"),
        ({"quantity": "time", "of": "", "unit": "s", "own": False}, "falls by 7.8 N m/s"),
        ({"quantity": "beside", "of": "load_kg", "unit": "kg", "own": False}, "load: missing torque"),
        ({"quantity": "command", "of": "motor_V", "unit": "V", "own": False}, "the command motor: missing"),
        ({"place": "motor_V", "value_unit": "V"}, "missing part of the command motor"),
        ({"place": "tip_m", "acts": "reading", "value_unit": "m"}, "error of the reading of tip"),
        ({"of": "hub_angle_rad", "place": "hub"}, "the hub angle: missing torque at hub"),
        ({"shape": "curve", "slope": None}, "-7.8 N m at 1 rad, 7.8 N m at -1 rad"),
        ({"of": "angle_rad", "place": "torque_Nm"}, "the angle: missing torque, 55 %"),
        ({"of": "angle_rad", "quantity": "speed", "unit": "rad/s", "slope": -0.2}, "the speed: missing"),
        ({"of": "cart_speed_m_s", "unit": "m"}, "the position of cart: missing"),
        ({"judged_on": "blocks"}, "on blocks not used"),
    ],
)  # fmt: skip
def test_a_dependence_is_said_with_its_size_and_unit(changed, said):
    assert said in dependence_line(codec.plain(replace(SPRING, **changed)))


def test_a_sentence_says_what_a_constant_does_and_what_else_it_may_be():
    also = Alternative("elbow", "command", "motor2", "", 0.52)
    told = replace(SPRING, constant_share=0.2, also=(also,), beside=True)
    said = dependence_words(codec.plain(told))
    assert said.startswith("beside that, the error depends on the angle of elbow: a missing torque at elbow")
    assert "(what is constant in it alone: 20 %)" in said
    assert "sensor" not in said
    assert "the command motor2 (52 %, at elbow)" in alternatives_words(codec.plain(told))
    assert alternatives_words(codec.plain(SPRING)) == ""


def test_each_dependence_has_a_panel_with_units():
    nothing = Where(PART, (), (), (), level=0.01)
    assert draw_dependences(nothing) is None
    picture = draw_dependences(
        replace(nothing, dependences=(SPRING, replace(SPRING, quantity="time", unit="s")))
    )
    assert [panel.labels for panel in picture.panels] == [
        ["angle of elbow [rad]", "missing torque at elbow [N m]"],
        ["time since the start [s]", "missing torque at elbow [N m]"],
    ]
    assert picture.panels[0].title.startswith("55 % of the error on logs not used")
