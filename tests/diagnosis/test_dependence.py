"""What an error depends on: forces made by hand, by the test's own steps, are read off as what they are."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment
from diagnosis.machine.around import MeasuredBody
from diagnosis.machine.with_effects import with_effects
from diagnosis.where.dependence import dependences
from diagnosis.where.missing_force import missing_forces

DT_S, ROWS, NOISE_M = 0.01, 300, 1e-5
MASSES_KG, DAMPING = np.array([1.0, 0.5]), 1.5
LISTED = (PlantEffect("nothing", (EffectParameter("size", 1e-3, 1.0),)),)
LEVEL = 0.01


def stepped(forces, missing=lambda x, v, k: 0.0):
    """(T, 2) positions of two damped carts on springs of 20 N/m, ten steps to a sample.

    missing : positions (2,), speeds (2,), row -> (2,) further forces.
    """
    x, v, found = np.zeros(2), np.zeros(2), np.zeros((len(forces), 2))
    h = DT_S / 10
    for k, force in enumerate(forces):
        found[k] = x
        for _ in range(10):
            v = v + h / MASSES_KG * (force - DAMPING * v - 20.0 * x + missing(x, v, k))
            x = x + h * v
    return found


def simulate(parameters, effects, inputs):
    return stepped(inputs)


PLANT = Plant(
    simulate, {}, {}, ("cart_m", "table_m"), np.full(2, NOISE_M), LISTED, 0.0, DT_S,
    input_names=("cart_N", "table_N"),
)  # fmt: skip


def case_of(missing, logs=2, seed=0, with_load=False):
    """Two logs, or one in two parts, and what the model misses of them."""
    rng, records = np.random.default_rng(seed), []
    for number in range(logs):
        forces = 3 * rng.uniform(-1, 1, (ROWS // 20, 2)).repeat(20, axis=0)
        load = rng.uniform(-1, 1, ROWS // 15).repeat(15)
        measured = stepped(forces, lambda x, v, k, load=load: missing(x, v, k, load))
        measured += NOISE_M * rng.standard_normal(measured.shape)
        role = "estimation" if number < logs - 1 else "held_out"
        beside = {"load_N": load} if with_load else {}
        records.append(PlantExperiment(f"log {number}", role, forces, measured, beside=beside))
    if logs == 1:
        (whole,) = records
        cut = ROWS // 2
        # The simulation begins at rest; how the second part begins is what nobody knows.
        records = [
            replace(
                whole, name="first", role="estimation", input=whole.input[:cut], output=whole.output[:cut]
            ),
            replace(whole, name="last", input=whole.input[cut:], output=whole.output[cut:], first_row=cut),
        ]
    case = PlantCase("carts", PLANT, tuple(records))
    left = {e.name: (e.output - stepped(e.input)) / NOISE_M for e in records}
    return case, left


def found_of(missing, **settings):
    case, left = case_of(missing, **settings)
    return dependences(case, left, DT_S, LEVEL)


@dataclass(frozen=True)
class Expected:
    place: str
    quantity: str
    of: str
    own: bool
    shape: str
    slope: float


@pytest.mark.parametrize(
    ("missing", "expected"),
    [
        pytest.param(
            lambda x, v, k, load: np.array([-8.0 * x[0], 0.0]),
            Expected("cart_N", "position", "cart_m", True, "line", -8.0),
            marks=pytest.mark.long,
        ),
        (
            lambda x, v, k, load: np.array([-8.0 * x[1], 0.0]),
            Expected("cart_N", "position", "table_m", False, "line", -8.0),
        ),
        (
            lambda x, v, k, load: np.array([0.0, -0.4 * np.tanh(v[1] / 1e-3)]),
            Expected("table_N", "speed", "table_m", True, "jump", -0.4),
        ),
        pytest.param(
            lambda x, v, k, load: np.array([0.0, -0.7 * v[1]]),
            Expected("table_N", "speed", "table_m", True, "line", -0.7),
            marks=pytest.mark.long,
        ),
        pytest.param(
            lambda x, v, k, load: np.array([0.3 * k * DT_S, 0.0]),
            Expected("cart_N", "time", "", False, "line", 0.3),
            marks=pytest.mark.long,
        ),
        (
            lambda x, v, k, load: np.array([-0.5 * load[k], 0.0]),
            Expected("cart_N", "beside", "load_N", False, "line", -0.5),
        ),
    ],
)
def test_a_missing_force_is_read_off_with_its_variable_and_size(missing, expected):
    first, *_ = found_of(missing, with_load=True)
    assert (first.acts, first.judged_on) == ("force", "logs")
    assert Expected(first.place, first.quantity, first.of, first.own, first.shape, expected.slope) == expected
    # Within a tenth: dry friction is smoothed over some rows about each turn.
    assert first.slope == pytest.approx(expected.slope, rel=0.1)
    assert 0.9 < first.share <= 1.0


def test_a_curve_is_read_off_where_no_line_is_one():
    first, *_ = found_of(lambda x, v, k, load: np.array([0.0, -20.0 * max(x[1] - 0.05, 0.0)]))
    assert (first.place, first.quantity, first.shape, first.slope) == ("table_N", "position", "curve", None)
    x, force = np.array(first.centres), np.array(first.values)
    true = -20.0 * np.maximum(x - 0.05, 0.0)
    assert np.max(np.abs(force - true)) < 0.15 * np.max(np.abs(true))


@pytest.mark.slow
def test_a_second_cause_is_read_off_beside_the_first():
    first, second = found_of(lambda x, v, k, load: np.array([-8.0 * x[0], -0.5 * v[1]]))
    found = {(one.place, one.quantity) for one in (first, second)}
    assert found == {("cart_N", "position"), ("table_N", "speed")}
    assert (first.beside, second.beside) == (False, True)
    assert first.share + second.share <= 1.01


@pytest.mark.slow
def test_of_one_log_blocks_judge():
    first, *_ = found_of(lambda x, v, k, load: np.array([-8.0 * x[0], 0.0]), logs=1)
    assert (first.quantity, first.of, first.judged_on) == ("position", "cart_m", "blocks")
    assert first.slope == pytest.approx(-8.0, rel=0.1)


@pytest.mark.slow
def test_noise_and_a_force_that_follows_nothing_depend_on_nothing():
    """The second is another one in each log, and as large as the forces above."""
    assert found_of(lambda x, v, k, load: np.zeros(2)) == ()
    assert found_of(lambda x, v, k, load: np.array([0.5 * load[k], 0.0]), seed=3) == ()


def test_an_error_of_a_reading_is_told_from_a_force():
    case, left = case_of(lambda x, v, k, load: np.zeros(2))
    # Of a linear machine a gain of the reading is one of the command: the error is quadratic.
    bent = 0.3

    def wrong(e):
        return np.column_stack([bent * e.output[:, 0] ** 2, np.zeros(ROWS)])

    records = tuple(replace(e, output=e.output + wrong(e)) for e in case.experiments)
    moved = {e.name: left[e.name] + wrong(e) / NOISE_M for e in case.experiments}
    (found,) = dependences(replace(case, experiments=records), moved, DT_S, LEVEL)
    told = (found.acts, found.place, found.quantity, found.of, found.value_unit, found.shape)
    assert told == ("reading", "cart_m", "position", "cart_m", "m", "curve")
    x, error = np.array(found.centres), np.array(found.values)
    # The curve is over what lies between the true position and the reading, 5 % apart at most.
    assert np.max(np.abs(error - bent * x**2)) < 0.15 * bent * np.max(x**2)


def test_of_a_torque_from_motion_the_output_is_the_force():
    """Friction of a measured motion: nothing is simulated, and the motion is an input."""
    rng, records, time = np.random.default_rng(4), [], 0.02 * np.arange(500)
    for role, rate in (("estimation", 2.0), ("held_out", 2.7)):
        angle, speed = np.sin(rate * time), rate * np.cos(rate * time)
        torque = (
            0.5 * np.gradient(speed, 0.02) + 0.3 * np.tanh(speed / 1e-3) + 1e-3 * rng.standard_normal(500)
        )
        records.append(PlantExperiment(role, role, np.column_stack([angle, speed]), torque))

    def inverse(parameters, effects, inputs):
        return 0.5 * np.gradient(inputs[:, 1], 0.02)

    plant = Plant(
        inverse,
        {},
        {},
        ("torque_Nm",),
        np.array([1e-3]),
        model_error=0.0,
        input_names=("angle_rad", "speed_rad_s"),
    )
    plant = with_effects(plant, ["coulomb_friction"], records, dt_s=0.02, body=MeasuredBody(0, 1))
    case = PlantCase("joint", plant, tuple(records))
    left = {e.name: (e.output - inverse({}, {}, e.input)[:, None]) / 1e-3 for e in records}
    first, *_ = dependences(case, left, 0.02, LEVEL)
    assert (first.acts, first.place, first.quantity, first.shape) == ("force", "torque_Nm", "speed", "jump")
    # What friction takes is asked of the drive: with the motion.
    assert first.slope == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyError("far")])
def test_a_simulation_that_fails_when_pushed_leaves_its_readings(error):
    case, left = case_of(lambda x, v, k, load: np.array([-8.0 * x[0], 0.0]))

    def fragile(parameters, effects, inputs):
        if not any(np.array_equal(inputs, e.input) for e in case.experiments):
            raise error
        return stepped(inputs)

    plant = replace(PLANT, simulation=fragile)
    broken = PlantCase("fragile", plant, case.experiments)
    forced = missing_forces(broken, left)
    assert forced.places == ()
    assert all(one.acts == "reading" for one in dependences(broken, left, DT_S, LEVEL))


def test_pushed_at_its_joint_a_mujoco_arm_moves_as_under_its_motor():
    mujoco = pytest.importorskip("mujoco")
    from diagnosis.machine.mujoco_plant import MujocoArm

    text = """<mujoco><option timestep="0.005"/><worldbody><body name="rod">
    <joint name="hinge" axis="0 0 1" damping="0.2" armature="0.01"/>
    <inertial pos="0.5 0 0" mass="1" diaginertia="0.001 0.05 0.05"/></body></worldbody>
    <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
    rng = np.random.default_rng(1)
    torque, more = (rng.uniform(-1, 1, 10).repeat(10) for _ in range(2))
    angle = 0.1 * np.sin(0.05 * np.arange(100))
    records = [
        PlantExperiment(role, role, np.column_stack([torque, angle]), angle)
        for role in ("estimation", "held_out")
    ]
    for rate in (0.0, 3.0):
        arm = MujocoArm(mujoco.MjSpec.from_string(text), ("hinge",), DT_S, rate)
        plant = arm.plant(records, np.array([1e-4]))
        (place,) = plant.force_places(2)
        assert (place.name, place.unit, place.motion, place.command) == ("hinge", "N m", 0, 0)
        held = records[0].input
        by_force = plant.pushed(held, more[:, None]) - plant.pushed(held, np.zeros((100, 1)))
        # From the same start: that of the record.
        plant.simulation._starts[(held + np.outer(more, [1.0, 0.0])).tobytes()] = plant.simulation._start(
            held
        )
        by_motor = plant.pushed(held + np.outer(more, [1.0, 0.0]), np.zeros((100, 1)))
        by_motor -= plant.pushed(held, np.zeros((100, 1)))
        np.testing.assert_allclose(by_force, by_motor, atol=1e-12)
        assert np.max(np.abs(by_force)) > 1e-3


@pytest.mark.slow
def test_commands_that_nobody_named_are_no_readings():
    """As many inputs as outputs, without names: the simulation does not read what was measured."""
    case, left = case_of(lambda x, v, k, load: np.array([-8.0 * x[0], 0.0]))
    unnamed = replace(case, plant=replace(case.plant, input_names=()))
    expected, found = (missing_forces(one, left).reading_responses for one in (case, unnamed))
    np.testing.assert_array_equal(found, expected)
    # A wrong reading shows in its own row and output alone.
    assert np.count_nonzero(found) == 2
