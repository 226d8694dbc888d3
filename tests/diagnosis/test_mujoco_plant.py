"""A MuJoCo model as a plant: against closed forms, and its repaired file against MuJoCo itself."""

import os
import re
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from benchmarks import mujoco_cases as cases  # noqa: E402
from diagnosis import Change, PlantCase, PlantExperiment, diagnose  # noqa: E402
from diagnosis.machine import mujoco_quantities  # noqa: E402
from diagnosis.machine.mujoco_plant import MujocoArm  # noqa: E402

DT_S = 0.01
# A rod on a hinge that lies flat; the force on it does all that moves it.
ROD = """<mujoco><option timestep="0.001"/><worldbody><body name="rod">
<joint name="hinge" axis="0 0 1" damping="0.2" armature="0.01"/>
<inertial pos="0.5 0 0" mass="1" diaginertia="0.001 0.05 0.05"/><site name="tip" pos="1 0 0"/>
</body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator>
<custom><numeric name="tolerance.rod.mass" data="0.07"/></custom></mujoco>"""
INERTIA = 0.05 + 0.25 + 0.01


def arm_of(text: str, outputs: tuple[str, ...] = ("hinge",), **settings: float) -> MujocoArm:
    return MujocoArm(mujoco.MjSpec.from_string(text), outputs, DT_S, **settings)


def rod(**settings: float) -> MujocoArm:
    return arm_of(ROD, **settings)


def test_outputs_have_the_units_of_their_joints_and_sensors():
    text = ROD.replace(
        '<site name="tip"', '<body><joint name="slide" type="slide"/><geom size=".1"/></body><site name="tip"'
    ).replace(
        "<custom>",
        '<sensor><jointvel name="rate" joint="slide"/>'
        '<jointactuatorfrc name="push" joint="hinge"/></sensor><custom>',
    )
    arm = arm_of(text, ("hinge", "slide", "rate", "push"))
    assert arm.units == {"hinge": "rad", "slide": "m", "rate": "m/s", "push": "N m"}
    assert plant_of(rod())[0].units == {"hinge": "rad"}


def test_a_stick_figure_stands_where_its_joint_says():
    plant, _ = plant_of(rod())
    angles = np.array([0.0, 0.4, -1.2])
    lines = plant.untracked.stick_figure(angles[:, None])
    tips = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    np.testing.assert_allclose(lines[:, -1, 1], tips, atol=1e-12)
    np.testing.assert_allclose(lines[:, -1, 0], 0 * tips, atol=1e-12)


@pytest.mark.parametrize("sensor", [(1.0, 0.0), (1000.0, 0.0), (1.0, 0.7), (-180 / np.pi, 30.0)])
def test_a_joint_is_where_its_sensor_says_whatever_the_sensor_s_gain_and_offset(sensor):
    """What is made of its motion: ranges of effects, the tracking, a stick figure, the reach of a reading."""
    gain, offset = sensor
    numbers = (
        f'<custom><numeric name="hinge.gain" data="{gain}"/><numeric name="hinge.offset" data="{offset}"/>'
    )
    text = ROD.replace("<custom>", numbers).replace('damping="0.2"', 'damping="0.2" range="-90 170"')
    arm = arm_of(text)
    plain = arm_of(text.replace(numbers, "<custom>"))
    torque = steps()
    angle = turned(torque)[:, None]
    reading = gain * angle + offset

    def recorded(y):
        return [PlantExperiment("one", "estimation", np.column_stack([torque, y]), y)]

    np.testing.assert_allclose(
        mujoco_quantities.Quantities(arm, recorded(reading)).motions["hinge"],
        mujoco_quantities.Quantities(plain, recorded(angle)).motions["hinge"],
        rtol=1e-9,
    )
    assert arm.tracking(recorded(reading)) == pytest.approx(plain.tracking(recorded(angle)))
    noise = np.array([1e-4])
    lines, expected = (
        one.plant(recorded(y), abs(y[-1] - y[0]) / abs(angle[-1] - angle[0]) * noise).untracked.stick_figure(
            y[:9]
        )
        for one, y in ((arm, reading), (plain, angle))
    )
    np.testing.assert_allclose(lines, expected, atol=1e-9)
    ends = gain * np.deg2rad([-90, 170]) + offset
    assert arm.reaches["hinge"][0] == pytest.approx(np.max(np.abs(ends)))


@pytest.mark.parametrize(
    ("joint", "servo", "command", "reading"),
    [
        ("hinge", 'kp="5"', 2 * np.pi, np.inf),
        ("hinge", 'kp="5" gear="3"', 6 * np.pi, np.inf),
        ("hinge", 'kp="5" gear="3"', 1.5, 0.5),
        ("slide", 'kp="5"', np.inf, np.inf),
    ],
)
def test_a_servo_reaches_through_its_gear_and_only_a_hinge_goes_once_round(joint, servo, command, reading):
    limits = f'type="{joint}"' if joint == "slide" else ""
    if reading < np.inf:
        limits += f' range="0 {np.rad2deg(reading)}"'
    text = ROD.replace("<motor", f"<position {servo}").replace('damping="0.2"', f'{limits} damping="0.2"')
    reaches = arm_of(text).reaches
    assert reaches["motor"][0] == pytest.approx(command)
    # A reading without a range is that of a servo's joint: once round where that turns.
    once_round = 2 * np.pi if joint == "hinge" else np.inf
    assert reaches["hinge"][0] == pytest.approx(min(reading, once_round))


@pytest.mark.parametrize("force", ["", '<numeric name="hinge.cogging" data="0.01 20 0"/>'])
def test_a_trial_that_runs_away_is_not_finite_from_there_on(force):
    """MuJoCo sets it back and goes on, with and without a force of ours that is held over a step."""
    soft = '<joint name="hinge" stiffness="1"'
    text = ROD.replace('<joint name="hinge"', soft).replace("<custom>", f"<custom>{force}")
    plant, inputs = plant_of(arm_of(text))
    outputs = plant.untracked({**plant.parameters, "hinge.stiffness": -1e5}, {}, inputs)[:, 0]
    first_bad = int(np.argmin(np.isfinite(outputs)))
    assert 0 < first_bad < 20
    assert not np.any(np.isfinite(outputs[first_bad:]))


def test_a_value_with_which_a_trial_runs_away_shows():
    """A servo that is stable as stated, and not with three times its gain at this timestep (a hundredth of a
    second, 139 rad/s as stated)."""
    servo = ROD.replace('<motor name="motor"', '<position name="motor" kp="6000" kv="1"')
    text = servo.replace('timestep="0.001"', 'timestep="0.01"')
    command = 0.1 * steps()
    plant, _ = plant_of(arm_of(text), command, command)
    assert "motor.kp" in plant.tolerances


@pytest.mark.parametrize("model_error", [0.0, 0.05])
def test_a_model_that_runs_away_as_stated_is_refused(model_error):
    arm = arm_of(ROD.replace('damping="0.2"', 'damping="0.2" stiffness="-1e5"'))
    torque = steps()
    measured = PlantExperiment("push", "estimation", np.column_stack([torque, torque]), torque[:, None])
    with pytest.raises(ValueError, match="experiment push: the model as stated runs away"):
        arm.plant((measured,), np.array([1e-4]), model_error=model_error)


@pytest.mark.long
def test_a_force_limit_that_is_stated_wrong_is_named():
    limit, stated = 0.7, 0.35
    arm = arm_of(ROD.replace('"hinge"/></actuator>', f'"hinge" forcerange="-{stated} {stated}"/></actuator>'))
    records = []
    for seed, role in enumerate(("estimation", "held_out")):
        torque = steps(seed)
        angle = turned(np.clip(torque, -limit, limit)) + 1e-4 * np.random.default_rng(9).standard_normal(200)
        records.append(PlantExperiment(role, role, np.column_stack([torque, angle]), angle[:, None]))
    plant = arm.plant(records, np.array([1e-4]), model_error=0.01)
    found = diagnose(PlantCase("rod", plant, tuple(records)))
    assert found.combination == ("wrong_motor.forcerange",)
    (change,) = found.repair
    assert change.values["ratio"] * stated == pytest.approx(limit, rel=0.03)


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


def plant_of(arm: MujocoArm, torque: np.ndarray | None = None, angle: np.ndarray | None = None):
    """As the model itself moves where nothing else is said."""
    torque = steps() if torque is None else torque
    angle = turned(torque) if angle is None else angle
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


def test_a_log_that_begins_with_its_step_begins_at_rest():
    """Of a machine three times as heavy: what remains is the noise, and is no start."""
    torque = np.repeat([0.8, -0.9, 0.3, -0.2], 50)
    angle = turned(torque, 3 * INERTIA) + 1e-4 * np.random.default_rng(3).standard_normal(200)
    plant, inputs = plant_of(rod(tracking_rad_s=3.0), torque, angle)
    heavy = plant.scaled({"rod.mass": 3.0, "rod.inertia": 3.0, "hinge.armature": 3.0})
    assert np.std(heavy.simulator(())(inputs)[:, 0] - angle) < 2e-4
    model = heavy.untracked.edited(dict(heavy.parameters)).compile()
    assert heavy.untracked.began(model, inputs).qvel == [0.0]


def test_an_effect_that_changes_as_much_at_no_size_is_not_offered():
    """Damping that stops a motor without load within a step: what is simulated are the steps."""
    servo = ROD.replace('<motor name="motor"', '<position name="motor" kp="80" kv="5.5"')
    for step, tried in (("0.0005", True), ("0.01", False)):
        plant, _ = plant_of(arm_of(servo.replace("0.001", step, 1)), 0.5 * steps(), turned(steps(), 0.05))
        assert ("hinge.backlash" in [effect.name for effect in plant.effects]) == tried
        assert ("smaller steps" in plant.inactive.get("hinge.backlash", "")) != tried


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
def test_a_lag_is_tried_whatever_integrates_it(integrator):
    """At its least it is next to nothing: no more than a lag of a step of the simulation is."""
    stepped = ROD.replace('timestep="0.001"', f'timestep="0.005" integrator="{integrator}"')
    plant, inputs = plant_of(arm_of(stepped))
    (lag,) = (effect for effect in plant.effects if effect.name == "motor.lag")
    least, whole = (Change("motor.lag", {"time_constant_s": s}) for s in (lag.parameters[0].low, 0.1))
    stated, least, whole = (plant.simulated(effects)(inputs) for effects in ((), (least,), (whole,)))
    assert np.std(least - stated) < 0.075 * np.std(whole - stated)


@pytest.mark.parametrize("simulated_before", ["as stated", "by a free run", "after a hundred records"])
@pytest.mark.parametrize("name", ["hinge.backlash", "hinge.sensor_delay", "rod.payload"])
def test_a_simulation_depends_on_its_arguments_alone(simulated_before, name):
    """And not on what was simulated before with the same plant, on this record or on others."""
    servo = ROD.replace('<motor name="motor"', '<position name="motor" kp="80" kv="5.5"')
    arm = arm_of(servo.replace("0.001", "0.005", 1), tracking_rad_s=9.0)
    plant, _ = plant_of(arm, 0.5 * steps(), turned(steps(), 0.05))
    torque = steps(3)
    angle = turned(torque, 2 * INERTIA)
    other = np.column_stack([torque, angle])[30:]
    (effect,) = (effect for effect in arm.quantities(MEASURED).values() if effect.name == name)
    size = {effect.parameters[0].name: 0.02}

    def simulated(simulation):
        return simulation(plant.parameters, {name: size}, other)

    def fresh():
        return replace(plant.simulation, _models={}, _paths={}, _starts={})

    expected = simulated(fresh())
    again = fresh()
    if simulated_before == "as stated":
        again(plant.parameters, {}, other)
    elif simulated_before == "by a free run":
        plant.untracked(plant.parameters, {}, other)
        again = plant.simulation
    else:
        simulated(again)
        for shift in range(100):
            again(plant.parameters, {}, other[:40] + 1e-3 * shift)
    assert np.std(expected - again(plant.parameters, {}, other)) > 1e-5
    np.testing.assert_array_equal(simulated(again), expected)


def test_an_integrator_that_an_edit_changes_meets_the_path_in_its_own_way():
    """Behind a stiff servo the backlash changes Euler's integrator, which holds the speed of the step before,
    for one that solves for that of the next."""
    servo = ROD.replace('<motor name="motor"', '<position name="motor" kp="80" kv="5.5"')
    arm = arm_of(servo.replace("0.001", "0.005", 1), tracking_rad_s=9.0)
    simulation = plant_of(arm, 0.5 * steps(), turned(steps(), 0.05))[0].simulation
    time_s = DT_S * np.arange(50)
    slopes = []
    for values in ({}, {"hinge.backlash": 0.02}):
        option = simulation.edited(values).option
        _, slope = simulation._path(time_s**2, option.timestep, 0.0, int(option.integrator))
        slopes.append(slope[10])
    begin_s = 10 * 0.005
    np.testing.assert_allclose(slopes, [2 * (begin_s - 0.0025), 2 * (begin_s + 0.0025)], rtol=1e-9)


def as_begun(plant):
    """Without a fit of what was before the first row: the commands were as in that."""
    return replace(plant, simulation=replace(plant.simulation, settles=False))


def two_links(integrator: str, step_s: float, kind: str = "motor") -> str:
    """An arm that hangs, or a cart with a pendulum."""
    joint = 'type="slide" axis="1 0 0"' if kind == "cart" else 'axis="0 1 0"'
    drive = {"lag": "general", "servo": "position"}.get(kind, "motor")
    more = {"lag": 'dyntype="filter" dynprm="0.05"', "servo": 'kp="20" kv="1"'}.get(kind, "")
    return f"""<mujoco><option timestep="{step_s}" integrator="{integrator}"/><worldbody><body>
    <joint name="one" {joint} damping="0.3" armature="0.02"/>
    <inertial pos="0.1 0 -0.1" mass="1.2" diaginertia="0.01 0.01 0.01"/><body pos="0 0 -0.3">
    <joint name="two" axis="0 1 0" damping="0.1" armature="0.01"/>
    <inertial pos="0 0 -0.12" mass="0.8" diaginertia="0.004 0.004 0.004"/></body></body></worldbody>
    <actuator><{drive} name="m1" joint="one" {more}/><{drive} name="m2" joint="two" {more}/></actuator>
    </mujoco>"""


def in_motion(xml: str, noise: float, seed: int, servo: bool = False) -> PlantExperiment:
    """Recorded from somewhere in a motion on, under a controller that feels the true speeds."""
    model, rng = mujoco.MjModel.from_xml_string(xml), np.random.default_rng(seed)
    data, rows = mujoco.MjData(model), []
    goal = rng.uniform(-0.8, 0.8, (7, 2)).repeat(50, axis=0)
    for k in range(350):
        push = np.array([20.0, 8.0]) * (goal[k] - data.qpos) - np.array([3.0, 0.8]) * data.qvel
        data.ctrl[:] = goal[k] if servo else push
        rows.append([*data.ctrl, *data.qpos])
        mujoco.mj_step(model, data, round(DT_S / model.opt.timestep))
    log = np.array(rows)[55:]
    log[:, 2:] += noise * rng.standard_normal((len(log), 2))
    return PlantExperiment(f"log {seed}", "held_out" if seed else "estimation", log, log[:, 2:])


@pytest.mark.parametrize(
    ("integrator", "kind", "tracking_rad_s"),
    [
        ("Euler", "cart", 20.0),
        ("RK4", "servo", 20.0),
        ("implicit", "motor", 20.0),
        # The same machines with the other integrators.
        pytest.param("Euler", "motor", 9.0, marks=pytest.mark.long),
        pytest.param("RK4", "cart", 9.0, marks=pytest.mark.long),
        pytest.param("implicitfast", "servo", 9.0, marks=pytest.mark.long),
    ],
)
def test_the_true_model_leaves_the_noise_of_a_log_that_begins_in_motion(integrator, kind, tracking_rad_s):
    noise, xml = 2e-4, two_links(integrator, 0.005, kind)
    logs = [in_motion(xml, noise, seed, kind == "servo") for seed in range(2)]
    plant = arm_of(xml, ("one", "two"), tracking_rad_s=tracking_rad_s).plant(logs, np.full(2, noise))
    for log in logs:
        left = plant.simulator(())(log.input) - log.output
        # What the tracking makes of the noise of the path: more, the faster it is.
        most = 1.5 if tracking_rad_s < 10 else 2.0
        assert np.max(np.sqrt(np.mean(left**2, axis=0))) < most * noise
        assert np.std(log.output, axis=0).min() > 200 * noise


@pytest.mark.parametrize(
    ("integrator", "name", "stated", "factor"),
    [
        pytest.param("RK4", "one.armature", 'armature="0.02"', 4.0, marks=pytest.mark.slow),
        pytest.param("implicitfast", "one.damping", 'damping="0.3"', 4.0, marks=pytest.mark.long),
        ("implicitfast", "body1.mass", 'mass="1.2" diaginertia="0.01 0.01 0.01"', 1.5),
    ],
)
def test_a_start_in_motion_is_fitted_with_the_values_that_are_tried(integrator, name, stated, factor):
    """Far from the stated model, whose slopes alone leave up to 1.4 times the noise."""
    noise, xml = 2e-4, two_links(integrator, 0.005)
    true = re.sub(r"[\d.]+", lambda number: str(float(number[0]) * factor), stated)
    logs = [in_motion(xml.replace(stated, true), noise, seed) for seed in range(2)]
    plant = arm_of(xml, ("one", "two"), tracking_rad_s=9.0).plant(logs, np.full(2, noise))
    for log in logs:
        stated_left, left = (
            np.max(np.sqrt(np.mean((one.simulator(())(log.input) - log.output) ** 2, axis=0)))
            for one in (plant, plant.scaled({name: factor}))
        )
        assert left < 1.2 * noise < 20 * noise < stated_left


@pytest.mark.parametrize(
    ("integrator", "kind"),
    [
        ("Euler", "lag"),
        pytest.param("implicitfast", "lag", marks=pytest.mark.long),
        ("implicitfast", "delay"),
        pytest.param("Euler", "servo delay", marks=pytest.mark.long),
    ],
)
def test_commands_before_a_record_are_fitted(integrator, kind):
    """What a lag or delay that the model lacks still feels of them, where the log begins in motion."""
    noise, late_s, drive = 2e-4, 0.05, kind.split()[0] if "servo" in kind else "motor"
    true = two_links(integrator, 0.005, "lag" if kind == "lag" else drive)
    true = true.replace('dyntype="filter"', 'dyntype="filterexact" actearly="true"')
    log = in_motion(true, noise, 0, drive == "servo").input
    if kind != "lag":
        rows = round(late_s / DT_S)
        log = np.column_stack([log[rows:, :2], log[:-rows, 2:]])
    e = PlantExperiment("log", "estimation", log, log[:, 2:])
    arm = arm_of(two_links(integrator, 0.005, drive), ("one", "two"), tracking_rad_s=9.0)
    plant = arm.plant([e], np.full(2, noise))
    name, size = ("lag", "time_constant_s") if kind == "lag" else ("delay", "delay_s")
    late = [Change(f"m{k}.{name}", {size: late_s}) for k in (1, 2)]
    left = plant.simulator(late)(log) - log[:, 2:]
    assert np.max(np.sqrt(np.mean(left**2, axis=0))) < 2 * noise
    without = plant.simulator(())(log) - log[:, 2:]
    assert np.max(np.sqrt(np.mean(without**2, axis=0))) > 20 * noise


@pytest.mark.parametrize("load_kg", [pytest.param(0.0, marks=pytest.mark.long), 1.0])
def test_a_stiff_servo_that_saturates_under_steps_is_followed(load_kg):
    """An arm with the gains of a public model and a force limit that every step meets."""
    servo = 'kp="4500" kv="450" forcerange="-87 87"'
    xml = f"""<mujoco><option integrator="implicitfast"/>
    <default><joint axis="0 0 1" armature="0.1" damping="1"/></default>
    <worldbody><body pos="0 0 0.3"><joint name="one"/><inertial pos="0 0 0" mass="5"
    diaginertia="0.7 0.7 0.01"/><body name="arm" quat="1 -1 0 0"><joint name="two"/><inertial
    pos="0 -0.03 0" mass="0.65" diaginertia="0.02 0.03 0.03"/><site pos="0 -0.3 0"/>LOAD</body></body>
    </worldbody><actuator><position joint="one" {servo}/><position joint="two" {servo}/></actuator>
    </mujoco>"""
    load = (
        f'<body pos="0 -0.3 0"><inertial pos="0 0 0" mass="{load_kg}" diaginertia="1e-9 1e-9 1e-9"/></body>'
    )
    true = mujoco.MjModel.from_xml_string(xml.replace("LOAD", load if load_kg else ""))
    noise, rng, data = 1e-4, np.random.default_rng(0), mujoco.MjData(true)
    rows, limited = [], 0
    for goal in rng.uniform(-0.6, 0.6, (6, 2)).repeat(60, axis=0):
        rows.append([*goal, *(data.qpos + noise * rng.standard_normal(2))])
        data.ctrl[:] = goal
        mujoco.mj_step(true, data, 5)
        limited += int(np.any(np.abs(data.actuator_force) > 86.9))
    assert limited > 30
    log = np.array(rows)[30:]
    e = PlantExperiment("log", "estimation", log, log[:, 2:])
    arm = arm_of(xml.replace("LOAD", ""), ("one", "two"))
    plant = replace(arm, tracking_rad_s=arm.tracking([e])).plant([e], np.full(2, noise), model_error=0.05)
    interests = plant.model_error * np.std(e.output, axis=0)

    def left(*changes):
        return np.sqrt(np.mean((plant.simulator(changes)(log) - e.output) ** 2, axis=0))

    assert np.all(
        left(*([Change("arm.payload", {"mass_kg": load_kg})] if load_kg else [])) < 0.15 * interests
    )
    assert not load_kg or np.any(left() > interests)


@pytest.mark.parametrize(
    "kind", [pytest.param("cart", marks=pytest.mark.slow), pytest.param("lag", marks=pytest.mark.long)]
)
def test_steps_that_are_coarser_than_the_machine_leave_little_of_it(kind):
    """The machine at a twentieth of the model's steps: classical Runge-Kutta leaves nothing."""
    logs = [in_motion(two_links("RK4", 0.00025, kind), 0.0, seed) for seed in range(2)]
    arm = arm_of(two_links("RK4", 0.005, kind), ("one", "two"), tracking_rad_s=9.0)
    plant = arm.plant(logs, np.full(2, 1e-5))
    for log in logs:
        left = plant.simulator(())(log.input) - log.output
        assert np.max(np.std(left, axis=0) / np.std(log.output, axis=0)) < 1e-3


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
    plant, inputs = plant_of(rod())
    plant = as_begun(plant)
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
    plant, _ = plant_of(rod())
    assert plant.parameters["rod.mass"] == 1.0
    assert plant.tolerances["rod.mass"] == 0.07
    assert plant.tolerances["hinge.damping"] == 0.2
    names = {effect.name for effect in plant.effects}
    assert {"hinge.frictionloss", "hinge.stiffness", "hinge.backlash", "motor.lag", "motor.delay"} <= names
    assert {"rod.payload", "gravity.x", "gravity.y"} <= names
    # A hinge that stands upright feels neither gravity nor where its zero is.
    assert not {"gravity.z", "hinge.sensor_offset"} & names


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
    record = PlantExperiment("one", "held_out", inputs, turned(torque)[:, None])
    text = arm.repaired(plant, repaired, changes, (record,))
    assert "  hinge.damping: 0.2 to 0.3\n" in text
    expected = as_begun(repaired).simulated(changes)(inputs)[:, 0]
    # MuJoCo alone, from the text alone; commands were as in the first row before it.
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start of one").id)
    assert data.act[0] == torque[0]
    n = model.actuator_history[0, 0]
    mujoco.mj_initCtrlHistory(model, data, 0, None, np.full((n, 1), torque[0]))
    found = []
    for u in torque:
        found.append(data.joint("hinge").qpos[0] + 0.1)
        data.ctrl[0] = u
        mujoco.mj_step(model, data, 10)
    assert np.std(expected) > 0.03
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3 * np.std(expected))
    # What MJCF has no word for is read back from the file.
    assert arm_of(text).number("hinge.offset", 0.0) == pytest.approx(0.1)


REPAIRS = {
    "backlash": Change("hinge.backlash", {"gap_rad": 0.02}),
    "spring": Change("hinge.elastic", {"stiffness_Nm_rad": 60.0, "damping_ratio": 0.1}),
    "payload": Change("rod.payload", {"mass_kg": 0.2}),
    "lag": Change("motor.lag", {"time_constant_s": 0.05}),
    "offset": Change("hinge.sensor_offset", {"offset": 0.1}),
}


# `make test`: one that adds a joint. CI: one that adds a body.
@pytest.mark.parametrize(
    "first",
    [
        "backlash",
        pytest.param("payload", marks=pytest.mark.slow),
        *(pytest.param(name, marks=pytest.mark.long) for name in ("spring", "lag", "offset")),
    ],
)
def test_a_repaired_file_can_be_diagnosed_and_repaired_again_with_the_same_logs(first):
    torque = steps()
    angle = turned(torque)
    record = PlantExperiment("one", "held_out", np.column_stack([torque, angle]), angle[:, None])
    plant = rod().plant((record,), np.array([1e-4]), named=["*"])
    again = arm_of(rod().repaired(plant, plant, (REPAIRS[first],), (record,)))
    plant = again.plant((record,), np.array([1e-4]), named=["*"])
    for second in ("backlash", "spring", "payload"):
        text = again.repaired(plant, plant, (REPAIRS[second],), (record,))
        model = mujoco.MjModel.from_xml_string(text)
        kept = again.nominal
        assert model.nkey == 1
        assert (model.njnt - kept.njnt, model.nbody - kept.nbody) == (
            (0, 1) if second == "payload" else (1, 0)
        )


@pytest.mark.parametrize(
    ("number", "value", "complaint"),
    [
        ("hinge.gain", "0", "is 0; it must be not zero"),
        ("motor.dead_zone", "-0.1", "is -0.1; it must be zero or more"),
        ("tolerance.hinge.damping", "-0.2", "is -0.2; it must be zero or more"),
        ("hinge.stribeck", "0.3", "is 0.3; it must be a force and a speed above zero"),
        ("hinge.stribeck", "0.3 0", "is 0.3 0; it must be a force and a speed above zero"),
    ],
)
def test_a_number_of_the_file_that_cannot_be_so_is_refused_in_one_line(number, value, complaint):
    """It was read, divided by or taken for less than nothing, and the answer was of another machine."""
    text = ROD.replace("<custom>", f'<custom><numeric name="{number}" data="{value}"/>')
    said = f'the model\'s <numeric name="{number}"> {complaint}'
    with pytest.raises(ValueError, match=f"^{re.escape(said)}$"):
        arm_of(text)


FIXED = '<body name="body2"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
TURNS = '<joint name="joint1" axis="0 1 0" armature="0.1"/>'


@pytest.mark.parametrize(
    ("named", "unnamed"),
    [
        ('<body name="rod">', f"{FIXED}<body>"),
        ('<joint name="hinge"', f"{TURNS}<joint"),
        ('<motor name="motor"', '<motor name="actuator1" joint="hinge"/><motor'),
    ],
)
def test_parts_without_a_name_get_one_that_no_other_has(named, unnamed):
    text = ROD.replace(named, unnamed)
    if "joint1" in unnamed:
        text = text.replace('joint="hinge"', 'joint="joint1"')
    arm = arm_of(text, ())
    names = [part.name for part in (*arm.spec.bodies, *arm.spec.joints, *arm.spec.actuators)]
    assert all(names)
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("xml", "outputs", "complaint"),
    [
        (ROD, ("elbow",), "no joint or sensor is called 'elbow'; there are hinge"),
        ("<mujoco><worldbody/></mujoco>", (), "the model has no actuator"),
    ],
)
def test_what_is_not_there_is_refused_in_one_line(xml, outputs, complaint):
    with pytest.raises(ValueError, match=f"^{complaint}$"):
        arm_of(xml, outputs)


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


def link(inertial: str, *, rest: str = "", joint: str = "", motor: str = '<motor name="m" joint="hinge"/>'):
    text = f"""<mujoco>{rest}<option timestep="0.001"/><worldbody><body name="rod">
    <joint name="hinge" axis="0 0 1" {joint}/>{inertial}</body></worldbody>
    <actuator>{motor}</actuator></mujoco>"""
    return arm_of(text), mujoco.MjModel.from_xml_string(text)


PLAIN = '<inertial pos="0.5 0 0" mass="1" diaginertia="0.01 0.05 0.05"/>'
FLANGE = (
    '<body name="flange" pos="1 0 0"><inertial pos="0 0 0" mass="0.5" diaginertia="0.01 0.01 0.01"/></body>'
)


@pytest.mark.parametrize(
    ("inertial", "rest"),
    [
        ('<inertial pos="0.5 0 0.1" mass="1" fullinertia="0.02 0.05 0.06 1e-3 2e-3 3e-3"/>', ""),
        ('<inertial pos="0.5 0 0" mass="1" diaginertia="0.03 0.05 0.06" euler="30 20 10"/>', ""),
        ('<geom type="box" size=".5 .1 .2" pos="0.5 0 0" euler="0 30 0"/>', '<compiler settotalmass="3"/>'),
        (f"{PLAIN}{FLANGE}", '<compiler fusestatic="true"/>'),
        (PLAIN, '<compiler boundmass="2" boundinertia="0.04"/>'),
    ],
)
def test_an_inertia_is_read_as_mujoco_reads_it_however_it_is_written(inertial, rest):
    """Principal axes may come back in another order: compared as the inertia about the joint."""
    arm, given = link(inertial, rest=rest)
    mass = np.zeros(2)
    for k, model in enumerate((given, arm.nominal)):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        mass[k] = data.qM[0]
    np.testing.assert_allclose(arm.nominal.body_mass, given.body_mass, rtol=1e-12)
    np.testing.assert_allclose(mass[1], mass[0], rtol=1e-9)


MEASURED = (PlantExperiment("one", "estimation", np.column_stack([steps()] * 2), steps()[:, None]),)


def edited(arm: MujocoArm, name: str, value: float):
    """(the model with one value, compiled as the diagnosis simulates it; the quantity)"""
    simulation = arm.plant(MEASURED, np.array([1e-4])).simulation
    return simulation._compiled(simulation.edited({name: value}))[0], arm.quantities(MEASURED)[name]


@pytest.mark.parametrize(
    ("joint", "motor", "name", "value"),
    [
        ('springdamper="0.1 1"', "", "hinge.damping", "dof_damping"),
        ('springdamper="0.1 1"', "", "hinge.stiffness", "jnt_stiffness"),
        ('class="stiff"', "", "hinge.stiffness", "jnt_stiffness"),
        ('class="stiff"', "", "hinge.armature", "dof_armature"),
    ],
)
def test_a_value_that_the_compiler_or_a_class_gives_is_nominal_and_can_be_changed(joint, motor, name, value):
    rest = '<default><default class="stiff"><joint stiffness="4" armature="0.3"/></default></default>'
    arm, given = link(PLAIN, rest=rest, joint=joint)
    model, quantity = edited(arm, name, 0.5)
    assert quantity.stated == pytest.approx(getattr(given, value)[0], rel=1e-12) != 0
    assert getattr(model, value)[0] == 0.5


def test_a_row_of_the_table_of_joints_is_an_effect_of_each(monkeypatch):
    row = mujoco_quantities.JointNumber("margin", "margin", 0, "margin_{x}", "position", 1.0, "smooth")
    monkeypatch.setattr(mujoco_quantities, "_JOINT_NUMBERS", (*mujoco_quantities._JOINT_NUMBERS, row))
    model, effect = edited(rod(), "hinge.margin", 0.3)
    assert model.jnt_margin[0] == 0.3
    assert [(p.name, p.high > p.low > 0) for p in effect.parameters] == [("margin_rad", True)]


@pytest.mark.parametrize("damping", ['dampratio="1"', 'kv="3"', ""])
def test_the_gain_of_a_servo_is_its_stiffness_and_its_damping(damping):
    """The ratio of damping stands for a number that the compiler makes of stiffness and inertia."""
    arm, given = link(PLAIN, motor=f'<position name="m" joint="hinge" kp="40" {damping}/>')
    model, _ = edited(arm, "m.gain", 0.25)
    np.testing.assert_allclose(model.actuator_gainprm[0], 0.25 * given.actuator_gainprm[0])
    np.testing.assert_allclose(model.actuator_biasprm[0], 0.25 * given.actuator_biasprm[0], rtol=1e-12)


def test_the_gain_of_a_muscle_is_its_force():
    """Its other numbers are lengths and speeds."""
    arm, given = link(PLAIN, motor='<muscle name="m" joint="hinge" lengthrange="-1 1" force="30"/>')
    model, _ = edited(arm, "m.gain", 0.5)
    expected = np.array(given.actuator_gainprm[0])
    expected[2] *= 0.5
    np.testing.assert_allclose(model.actuator_gainprm[0][[0, 1, 2, 4]], expected[[0, 1, 2, 4]])


@pytest.mark.parametrize("dyntype", ["integrator", "user"])
def test_a_lag_is_not_tried_where_an_actuator_has_other_dynamics(dyntype):
    motor = f'<general name="m" joint="hinge" dyntype="{dyntype}" dynprm="1" actdim="1"/>'
    plant, _ = plant_of(link(PLAIN, motor=motor)[0])
    assert "m.lag" not in {effect.name for effect in plant.effects} | set(plant.parameters)
    assert "m.lag" in plant.inactive


def test_what_an_edit_adds_takes_nothing_from_the_default_class():
    """Neither the tracking nor the joint of the backlash: limits, gears and friction are the arm's."""
    rest = """<default><joint damping="2" armature="0.1" frictionloss="1" stiffness="3"/>
    <general gear="7" ctrlrange="-1 1" forcerange="-2 2"/></default>"""
    arm = replace(link(PLAIN, rest=rest)[0], tracking_rad_s=3.0)
    model, _ = edited(arm, "hinge.backlash", 0.02)
    assert model.actuator("tracking hinge spring").gear[0] == 1.0
    assert not model.actuator("tracking hinge spring").ctrllimited[0]
    assert not model.actuator("tracking hinge spring").forcelimited[0]
    joint = model.joint("hinge backlash")
    assert joint.damping[0] == joint.armature[0] == joint.frictionloss[0] == joint.stiffness[0] == 0
    np.testing.assert_allclose(joint.range, [-0.01, 0.01])


@pytest.mark.parametrize("angle", ["", 'angle="degree"', 'angle="radian"'])
def test_a_gap_is_as_wide_in_the_repaired_file_as_it_was_found(angle):
    arm, _ = link(PLAIN, rest=f"<compiler {angle}/>", joint='armature="0.1"')
    plant, _ = plant_of(arm)
    text = arm.repaired(plant, plant, (Change("hinge.backlash", {"gap_rad": 0.02}),))
    np.testing.assert_allclose(
        mujoco.MjModel.from_xml_string(text).joint("hinge backlash").range, [-0.01, 0.01]
    )


TIP = (
    '<body name="tip" pos="1 0 0">{}<joint name="wrist" axis="0 0 1"/><geom size="0.1" pos="0.4 0 0"/></body>'
)


@pytest.mark.parametrize(
    ("inertial", "at"),
    [
        ('<geom type="capsule" fromto="0 0 0 0.8 0 0" size="0.02"/>', {"rod": (0.82, 0, 0)}),
        (f"{PLAIN}{FLANGE}", {"rod": (1.0, 0, 0)}),
        (f'{PLAIN}<body pos="0.9 0 0"><site pos="0 0 0.1"/></body>', {"rod": (0.9, 0, 0.1)}),
        (f"{PLAIN}{TIP.format('')}", {"tip": (1.5, 0, 0)}),
        (f'{PLAIN}<site pos="0.3 0 0"/>{TIP.format("")}', {"rod": (0.3, 0, 0), "tip": (1.5, 0, 0)}),
    ],
)
def test_a_payload_is_tried_at_a_site_or_the_far_end_of_a_last_link(inertial, at):
    """A link with what is fixed to it; a link between others without a site is listed as not tried."""
    arm, _ = link(inertial)
    plant, _ = plant_of(arm)
    moving = {"rod", "tip"} if "wrist" in inertial else {"rod"}
    assert {name for name in plant.inactive if "payload" in name} == {
        f"{n}.payload" for n in moving - set(at)
    }
    for name, place in at.items():
        model, _ = edited(arm, f"{name}.payload", 0.5)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        (load,) = (k for k in range(model.nbody) if model.body(k).name.endswith("payload"))
        np.testing.assert_allclose(data.xpos[load], place, atol=1e-9)


@pytest.mark.parametrize(
    "drive",
    [
        ('<motor name="m" joint="hinge" gear="4"/>', ""),
        (
            '<motor name="m" tendon="t" gear="2"/>',
            '<tendon><fixed name="t"><joint joint="hinge" coef="2"/></fixed></tendon>',
        ),
        ('<general name="m" joint="hinge" gainprm="4" dyntype="filter" dynprm="0.1"/>', ""),
        ('<motor name="m" joint="hinge" gear="4" delay="0.02" nsample="30"/>', ""),
    ],
)
def test_the_force_on_a_joint_is_what_its_actuators_do_whatever_lies_between(drive):
    motor, tendon = drive
    arm, _ = link(PLAIN, motor=f"{motor}</actuator>{tendon}<actuator>")
    found = mujoco_quantities.Quantities(arm, MEASURED).motions["hinge"].force
    assert found == pytest.approx(4 * np.max(np.abs(steps())), rel=1e-9)


@pytest.mark.parametrize(
    ("gravity", "free", "tilted"),
    [
        ("0 0 -9.81", {"gravity.x", "gravity.y"}, {"gravity.x": (3.0, 0.0, -np.sqrt(9.81**2 - 9.0))}),
        ("0 -9.81 0", {"gravity.x", "gravity.z"}, {"gravity.z": (0.0, -np.sqrt(9.81**2 - 9.0), 3.0)}),
        ("1 0 -9.7", {"gravity.x", "gravity.y"}, {"gravity.x": (3.0, 0.0, -np.sqrt(9.7**2 + 1 - 9.0))}),
        ("0 0 0", {"gravity.x", "gravity.y", "gravity.z"}, {"gravity.y": (0.0, 3.0, 0.0)}),
    ],
)
def test_only_the_direction_of_gravity_is_open(gravity, free, tilted):
    for released in (False, True):
        rest = f'<option gravity="{gravity}"/>'
        if released:
            rest += '<custom><numeric name="tolerance.gravity.z" data="0.02"/></custom>'
        arm, _ = link(PLAIN, rest=rest)
        found = {name for name in arm.quantities(MEASURED) if "gravity" in name}
        assert found == free | ({"gravity.z"} if released else set())
        for name, expected in tilted.items():
            np.testing.assert_allclose(edited(arm, name, 3.0)[0].opt.gravity, expected, atol=1e-12)
    if gravity == "0 0 -9.81":
        np.testing.assert_allclose(edited(arm, "gravity.z", -9.0)[0].opt.gravity, (0, 0, -9.0))


@pytest.mark.parametrize(
    "kp", [50.0, pytest.param(500.0, marks=pytest.mark.long), pytest.param(5000.0, marks=pytest.mark.slow)]
)
def test_a_servo_is_judged_by_what_it_strays_from_its_command(kp):
    """Behind a stiff servo with damping kv the joint lags the command by about kv/kp: the share of the motion
    that its forces make falls as that does. Of a motor it is what its commands make."""
    goal = np.sin(2 * np.pi * 0.5 * DT_S * np.arange(400)) * np.linspace(0, 1, 400)
    drive = f'<position name="m" joint="hinge" kp="{kp}" kv="{2 * np.sqrt(kp)}"/>'
    arm, model = link(PLAIN, motor=drive)
    data, angle = mujoco.MjData(model), []
    for u in goal:
        angle.append(data.qpos[0])
        data.ctrl[0] = u
        mujoco.mj_step(model, data, round(DT_S / model.opt.timestep))
    angle = np.array(angle)

    def share(arm, command):
        measured = PlantExperiment("one", "estimation", np.column_stack([command, angle]), angle[:, None])
        return arm.plant((measured,), np.array([1e-4]), model_error=1.0).model_error

    of_servo = share(replace(arm, tracking_rad_s=2.0), goal)
    assert of_servo == pytest.approx(np.std(goal - angle) / np.std(angle), rel=0.6)
    assert share(link(PLAIN)[0], kp * (goal - angle)) > max(of_servo, 0.9)


def test_a_payload_may_be_as_heavy_as_all_that_carries_it():
    arm, _ = link(f'{PLAIN}<site pos="1 0 0"/>{TIP.format("")}')
    plant, _ = plant_of(arm)
    (tip,) = [e for e in plant.effects if e.name == "tip.payload"]
    assert tip.parameters[0].high > 10 * arm.nominal.body_mass.sum() * 0.99


CORNERS = """v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1 2 4
f 2 3 4
f 1 4 3
"""
MESHED = """<mujoco model="m"><compiler {compiler}/><option timestep="0.001"/>{include}
<default><default class="look"><geom contype="0" conaffinity="0" {density}/></default></default>
<asset>{asset}</asset><worldbody><body name="rod">
<joint name="hinge" axis="0 0 1" ref="30" range="-170 170" armature="0.1"/>
<geom type="mesh" mesh="box" class="look"/><geom size="0.1" mass="1" pos="0.5 0 0"/>{hit}
<body name="hand" pos="1 0 0">
<joint name="wrist" axis="0 0 1"/><geom size="0.1" mass="1" pos="0.2 0 0"/></body></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator>
<keyframe><key name="home" qpos="0.2 0.3" ctrl="0.5"/></keyframe></mujoco>"""
BOX = '<mesh name="box" file="box.obj" scale=".1 .1 .1"/>'


@pytest.mark.parametrize(
    ("compiler", "include", "asset", "density", "hit"),
    [
        # The last one has this directory, too.
        pytest.param('meshdir="parts"', "", BOX, "", "", marks=pytest.mark.long),
        ('assetdir="parts"', "", BOX, 'mass="0"', '<geom type="mesh" mesh="box"/>'),
        ("", '<include file="parts/inc.xml"/>', "", "", ""),
        (
            'meshdir="parts" texturedir="looks"',
            "",
            f'{BOX}<texture name="t" type="2d" file="t.png"/>',
            "",
            "",
        ),
    ],
)
def test_the_repaired_file_loads_where_it_is_written(tmp_path, compiler, include, asset, density, hit):
    """Meshes and textures of folders, includes; a zero in degrees; a pose with a joint more."""
    for folder in ("arm/parts", "arm/looks", "out"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "arm/parts/box.obj").write_text(CORNERS)
    here = BOX.replace("box.obj", "parts/box.obj")
    (tmp_path / "arm/parts/inc.xml").write_text(f"<mujoco><asset>{here}</asset></mujoco>")
    import matplotlib.image

    matplotlib.image.imsave(tmp_path / "arm/looks/t.png", np.zeros((4, 4)))
    model = tmp_path / "arm" / "arm.xml"
    model.write_text(MESHED.format(compiler=compiler, include=include, asset=asset, density=density, hit=hit))
    arm = MujocoArm.from_file(str(model), outputs=("hinge",), dt_s=DT_S)
    plant, _ = plant_of(arm, steps(), turned(steps()) + 0.5)
    repaired = plant.scaled({"rod.mass": 1.2})
    text = arm.repaired(
        plant, repaired, (Change("hinge.backlash", {"gap_rad": 0.02}),), folder=tmp_path / "out"
    )
    assert str(tmp_path) not in text
    assert ("texturedir" in text) == ("texturedir" in compiler)
    (tmp_path / "out" / "arm.xml").write_text(text)
    given = mujoco.MjModel.from_xml_path(str(model))
    again = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "arm.xml"))
    assert (again.nmesh, again.ntex, again.ngeom) == (given.nmesh, given.ntex, given.ngeom)
    np.testing.assert_allclose(again.body_mass[1:], given.body_mass[1:] * (1.2, 1), rtol=1e-5)
    np.testing.assert_allclose(again.qpos0, (given.qpos0[0], 0, 0), atol=1e-5)
    np.testing.assert_allclose(again.key_qpos, [[0.2, 0, 0.3]])
    # What is simulated has no mesh but those that may hit something, and moves alike.
    light = arm.moving.compile()
    assert light.nmesh == (1 if hit else 0)
    np.testing.assert_allclose(light.body_inertia, arm.nominal.body_inertia)


@pytest.mark.parametrize(
    ("base", "refused"), [("<freejoint/>", True), ("", False), ('<joint name="rail" type="slide"/>', False)]
)
def test_a_joint_on_a_base_that_flies_is_refused_in_one_line(base, refused):
    text = f"""<mujoco><worldbody><body name="ball"><freejoint/><geom size="0.1"/></body>
    <body name="trunk">{base}
    <geom size="0.2"/><body><joint name="hip" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.3"/></body></body>
    </worldbody><actuator><motor joint="hip"/></actuator></mujoco>"""
    said = r"^the base 'trunk' moves freely, and no log says where it is"
    with pytest.raises(ValueError, match=said) if refused else nullcontext():
        arm_of(text, ("hip",))


@pytest.mark.slow
def test_the_equations_of_the_benchmark_are_those_of_mujoco():
    """Both truths of the same two-joint arm under the same torques; they share no line."""
    masses, damping, armature = np.array([1.2, 0.8]), np.array([0.25, 0.12]), np.array([0.03, 0.015])
    for effect, flat in (("payload", False), ("tilt", True)):
        truth = cases.Truth(2, masses, damping, armature, effect, 1, 0.2, flat)
        one, other = cases.InMujoco(truth), cases.ByEquations(truth)
        for k in range(100):
            torque = np.array([np.sin(0.1 * k), 0.4 * np.cos(0.13 * k)])
            one.step(torque)
            other.step(torque)
        assert np.ptp(one.angle - cases.at_rest(truth)) > 0.02
        np.testing.assert_allclose(one.angle, other.angle, rtol=0, atol=5e-3)
