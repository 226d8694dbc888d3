"""A MuJoCo model as a plant: against closed forms, and its repaired file against MuJoCo itself."""

from __future__ import annotations

import os

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from benchmarks import mujoco_cases as cases  # noqa: E402
from diagnosis import PlantExperiment  # noqa: E402
from diagnosis.machine.mujoco_plant import MujocoArm  # noqa: E402
from diagnosis.machine.plant_effect import Change, EffectParameter, PlantEffect  # noqa: E402

DT_S = 0.01
# A rod on a hinge that lies flat; the force on it does all that moves it.
ROD = """<mujoco><option timestep="0.001"/><worldbody><body name="rod">
<joint name="hinge" axis="0 0 1" damping="0.2" armature="0.01"/>
<inertial pos="0.5 0 0" mass="1" diaginertia="0.001 0.05 0.05"/><site name="tip" pos="1 0 0"/>
</body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator>
<custom><numeric name="tolerance.rod.mass" data="0.07"/></custom></mujoco>"""
INERTIA = 0.05 + 0.25 + 0.01


def rod(**settings: float) -> MujocoArm:
    return MujocoArm(mujoco.MjSpec.from_string(ROD), ("hinge",), DT_S, **settings)


def steps(seed: int = 0, count: int = 200) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, count // 20).repeat(20)


def turned(torque: np.ndarray, inertia: float = INERTIA, damping: float = 0.2) -> np.ndarray:
    """Angles (T,) of inertia and damper under held torques, exact."""
    from scipy.signal import cont2discrete

    parts = (
        np.array([[0, 1], [0, -damping / inertia]]),
        np.array([[0], [1 / inertia]]),
        np.eye(2),
        np.zeros((2, 1)),
    )
    A, B, *_ = cont2discrete(parts, DT_S)
    x, found = np.zeros(2), []
    for u in torque:
        found.append(x[0])
        x = A @ x + B[:, 0] * u
    return np.array(found)


def plant_of(arm: MujocoArm, torque: np.ndarray, angle: np.ndarray):
    measured = PlantExperiment("one", "estimation", np.column_stack([torque, angle]), angle[:, None])
    return arm.plant((measured,), np.array([1e-4])), measured.input


@pytest.mark.parametrize("tracking_rad_s", [0.0, 3.0, 12.0])
def test_tracking_leaves_a_machine_that_is_the_model_where_it_is(tracking_rad_s):
    """Half a step of a millisecond earlier than the torque acts: MuJoCo's integrator."""
    torque = steps()
    angle = turned(torque)
    plant, inputs = plant_of(rod(tracking_rad_s=tracking_rad_s), torque, angle)
    found = plant.simulated(())(inputs)[:, 0]
    assert np.std(angle) > 0.1
    np.testing.assert_allclose(found, angle, rtol=0, atol=0.01 * np.std(angle))


@pytest.mark.parametrize(
    ("effect", "value", "inertia", "damping"),
    [
        ("wrong_hinge.damping", 2.0, INERTIA, 0.4),
        ("wrong_hinge.armature", 5.0, INERTIA + 0.04, 0.2),
        ("wrong_rod.mass", 1.5, 0.01 + 1.5 * 0.3, 0.2),
        ("rod.payload", 0.2, INERTIA + 0.2, 0.2),
    ],
)
def test_an_effect_is_what_its_name_says(effect, value, inertia, damping):
    torque = steps()
    plant, inputs = plant_of(rod(), torque, turned(torque))
    found = plant.simulated((Change(effect, {"ratio": value} if "wrong" in effect else {"mass_kg": value}),))
    expected = turned(torque, inertia, damping)
    assert np.std(expected - turned(torque)) > 0.05 * np.std(expected)
    np.testing.assert_allclose(found(inputs)[:, 0], expected, rtol=0, atol=0.01 * np.std(expected))


def test_delay_and_lag_of_the_actuator_and_the_sensor_s_zero():
    torque = steps()
    plant, inputs = plant_of(rod(), torque, turned(torque))
    late = plant.simulated((Change("motor.delay", {"delay_s": 0.03}),))(inputs)[:, 0]
    torque_later = np.concatenate([np.full(3, torque[0]), torque[:-3]])
    np.testing.assert_allclose(late, turned(torque_later), rtol=0, atol=5e-3)
    slow = plant.simulated((Change("motor.lag", {"time_constant_s": 0.2}),))(inputs)[:, 0]
    fine = np.repeat(torque, 10)
    lagged, held = [], fine[0]
    for u in fine:
        held += (u - held) * (1 - np.exp(-0.001 / 0.2))
        lagged.append(held)
    mean = np.array(lagged).reshape(-1, 10).mean(axis=1)
    np.testing.assert_allclose(slow, turned(mean), rtol=0, atol=5e-3)


def test_values_of_the_file_are_parameters_with_tolerances_and_the_rest_effects():
    torque = steps()
    plant, _ = plant_of(rod(), torque, turned(torque))
    assert plant.parameters["rod.mass"] == 1.0
    assert plant.tolerances["rod.mass"] == 0.07
    assert plant.tolerances["hinge.damping"] == 0.2
    names = {effect.name for effect in plant.effects}
    assert {"hinge.frictionloss", "hinge.stiffness", "hinge.backlash", "motor.lag", "motor.delay"} <= names
    assert {"rod.payload", "gravity.x", "gravity.y"} <= names
    # A hinge that stands upright feels neither gravity nor where its zero is.
    assert not {"gravity.z", "hinge.sensor_offset"} & names
    little = {effect.name for effect in plant.effects if effect.everywhere}
    assert little == {"hinge.frictionloss", "motor.lag", "gravity.x", "gravity.y"}


@pytest.mark.parametrize(
    ("name", "little"), [("arm.coulomb_friction", True), ("tip_payload", False), ("mine", False)]
)
def test_an_effect_of_one_s_own_is_as_common_as_the_listed_one_of_its_name(name, little):
    size = EffectParameter("size", 0.1, 1.0)
    assert PlantEffect(name, (size,)).everywhere is little
    assert PlantEffect(name, (size,), everywhere=not little).everywhere is not little


def test_the_repaired_file_does_in_mujoco_what_the_diagnosis_simulated():
    torque = steps()
    torque[:20] = 0.0
    arm = rod()
    plant, inputs = plant_of(arm, torque, turned(torque))
    changes = (
        Change("hinge.frictionloss", {"level_Nm": 0.1}),
        Change("motor.lag", {"time_constant_s": 0.05}),
        Change("motor.delay", {"delay_s": 0.02}),
        Change("rod.payload", {"mass_kg": 0.2}),
        Change("hinge.backlash", {"gap_rad": 0.02}),
        Change("wrong_motor.gain", {"ratio": 0.8}),
        Change("hinge.sensor_offset", {"offset": 0.1}),
    )
    repaired = plant.scaled({"hinge.damping": 1.5})
    text = arm.repaired(plant, repaired, changes)
    known = [c for c in changes if c.id != "hinge.sensor_offset"]
    expected = repaired.simulated(known)(inputs)[:, 0]
    # MuJoCo alone, from the text alone; commands were as in the first row before it.
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.act[:] = torque[0]
    n = model.actuator_history[0, 0]
    mujoco.mj_initCtrlHistory(model, data, 0, None, np.full((n, 1), torque[0]))
    found = []
    for u in torque:
        found.append(data.joint("hinge").qpos[0])
        data.ctrl[0] = u
        mujoco.mj_step(model, data, 10)
    assert np.std(expected) > 0.03
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3 * np.std(expected))
    # What MJCF has no word for is read back from the file.
    again = MujocoArm(mujoco.MjSpec.from_string(text), ("hinge",), DT_S)
    assert again.number("hinge.offset", 0.0) == pytest.approx(0.1)


def test_the_equations_of_the_benchmark_are_those_of_mujoco():
    """Both truths of the same two-joint arm under the same torques; they share no line."""
    masses, damping, armature = np.array([1.2, 0.8]), np.array([0.25, 0.12]), np.array([0.03, 0.015])
    for effect, flat in (("payload", False), ("tilt", True), ("stiffness", False)):
        truth = cases.Truth(2, masses, damping, armature, effect, 1, 0.2, flat)
        one, other = cases.InMujoco(truth), cases.ByEquations(truth)
        for k in range(100):
            torque = np.array([np.sin(0.1 * k), 0.4 * np.cos(0.13 * k)])
            one.step(torque)
            other.step(torque)
        assert np.ptp(one.angle - cases.at_rest(truth)) > 0.02
        np.testing.assert_allclose(one.angle, other.angle, rtol=0, atol=5e-3)


@pytest.mark.parametrize(
    ("xml", "outputs", "complaint"),
    [
        (ROD, ("elbow",), "no joint or sensor is called 'elbow'; there are hinge"),
        ("<mujoco><worldbody/></mujoco>", (), "the model has no actuator"),
    ],
)
def test_what_is_not_there_is_refused_in_one_line(xml, outputs, complaint):
    with pytest.raises(ValueError, match=f"^{complaint}$"):
        MujocoArm(mujoco.MjSpec.from_string(xml), outputs, DT_S)


NAMED = {
    "an included model": '<include file="{}"/>',
    "in an included model": '<include file="part.xml"/>',
    "a mesh": '<asset><mesh name="m" file="{}"/></asset>',
    "a mesh in its folder": '<compiler meshdir="parts"/><asset><mesh name="m" file="../{}"/></asset>',
    "a height field": '<asset><hfield name="h" file="{}" size="1 1 1 1"/></asset>',
}


@pytest.mark.parametrize("named", NAMED)
def test_a_pipe_in_a_model_is_refused_and_not_waited_for(tmp_path, named):
    pipe, model = tmp_path / "pipe", tmp_path / "arm.xml"
    os.mkfifo(pipe)
    (tmp_path / "parts").mkdir()
    (tmp_path / "part.xml").write_text(f'<mujoco><include file="{pipe}"/><include file="arm.xml"/></mujoco>')
    text = NAMED[named].format("pipe")
    model.write_text(ROD.replace("<worldbody>", f"{text}<worldbody>", 1))
    for path in (model, pipe, tmp_path / "parts"):
        with pytest.raises(ValueError, match="is no file, but a folder, pipe or device"):
            MujocoArm.from_file(str(path), outputs=("hinge",), dt_s=DT_S)
