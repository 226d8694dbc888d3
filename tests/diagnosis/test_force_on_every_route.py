"""A force on a body is one row, and acts by its equation on every route.

Around a simulation (an FMU is one as any other), in a measured motion, on a joint of a MuJoCo model and,
by its law, on a rig.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from diagnosis import (
    Body,
    Change,
    MeasuredBody,
    Plant,
    PlantCase,
    PlantExperiment,
    diagnose,
    with_effects,
)
from diagnosis.machine.body_forces import SmoothLaw
from diagnosis.machine.listed_effects import KINDS
from plant.effects import Effect
from plant.machine import SmoothTorque
from plant.presets import paper_link
from plant.simulation import Simulator
from tests.diagnosis.machines import rubbing

DT_S, INERTIA = 0.01, 0.17
# Row -> values of its parameters, and the force against positive motion at a position and a speed.
FORCES = {
    "viscous_friction": ({"coefficient": 0.1}, lambda x, v: 0.1 * v),
    "viscous_asymmetry": ({"coefficient": 0.05}, lambda x, v: 0.05 * np.abs(v)),
    "quadratic_drag": ({"coefficient": 0.05}, lambda x, v: 0.05 * v * np.abs(v)),
    "spring": ({"stiffness": 0.8}, lambda x, v: 0.8 * x),
    "hardening_spring": ({"cubic": 0.5}, lambda x, v: 0.5 * x**3),
    "cogging": (
        {"amplitude": 0.3, "wave_number": 7.0, "phase_rad": 0.4},
        lambda x, v: -0.3 * np.sin(7 * x + 0.4),
    ),
    "eccentric_mass": ({"torque": 0.4, "angle_rad": 0.7}, lambda x, v: 0.4 * (np.sin(x + 0.7) - np.sin(0.7))),
}
# What MJCF itself has is called as there.
IN_MJCF = {"viscous_friction": "damping", "quadratic_drag": "drag", "spring": "stiffness"}
ROD = f"""<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/><worldbody><body>
<joint name="hinge" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
</body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""


def moved(command, force):
    """Angle and speed (T, 2) of a rod from rest under held commands (T,), by Runge-Kutta steps."""
    state, motion, h = np.zeros(2), np.zeros((command.size, 2)), DT_S / 4
    for k, u in enumerate(command):
        motion[k] = state
        for _ in range(4):

            def rates(s, u=u):
                return np.array([s[1], (u - force(s[0], s[1])) / INERTIA])

            a = rates(state)
            b = rates(state + h / 2 * a)
            c = rates(state + h / 2 * b)
            d = rates(state + h * c)
            state = state + h / 6 * (a + 2 * b + 2 * c + d)
    return motion


COMMAND = np.random.default_rng(2).uniform(-1, 1, 15).repeat(20)
FREE = moved(COMMAND, lambda x, v: 0.0)


def test_every_row_with_a_smooth_law_has_its_equation_here():
    assert {name for name, kind in KINDS.items() if isinstance(kind.law.change, SmoothLaw)} == {*FORCES}


@pytest.mark.parametrize("name", FORCES)
def test_around_a_simulation_that_does_not_know_it(name):
    """Its own position: measured up to 1e-5 of what it changes. Another output feels no more of a force than
    its mean and moment over a sample."""
    values, force = FORCES[name]
    truth = moved(COMMAND, force)
    record = PlantExperiment("a", "estimation", COMMAND[:, None], truth)
    plant = Plant(
        lambda p, e, u: moved(u[:, 0], lambda x, v: 0.0), {}, {}, ("x_rad", "v_rad_s"), np.full(2, 1e-4)
    )
    plant = with_effects(plant, [name], [record], dt_s=DT_S, body=Body("x_rad"))
    found = plant.simulated([Change(name, values)])(COMMAND[:, None])
    missed = np.linalg.norm(found - truth, axis=0) / np.linalg.norm(FREE - truth, axis=0)
    assert np.all(missed < [1e-4, 1e-3])


@pytest.mark.parametrize("name", FORCES)
def test_in_the_force_that_a_measured_motion_takes(name):
    values, force = FORCES[name]
    motion = moved(COMMAND, force)
    rest = INERTIA * np.gradient(motion[:, 1], DT_S)
    record = PlantExperiment("a", "estimation", motion, rest)
    plant = Plant(
        lambda p, e, u: INERTIA * np.gradient(u[:, 1:], DT_S, axis=0), {}, {}, ("torque_Nm",), np.ones(1)
    )
    plant = with_effects(plant, [name], [record], dt_s=DT_S, body=MeasuredBody(0, 1))
    taken = plant.simulated([Change(name, values)])(motion)[:, 0] - rest
    moving = ~plant.body.resting(motion)
    assert np.count_nonzero(moving) > 200
    np.testing.assert_allclose(taken[moving], force(*motion[moving].T), rtol=1e-9, atol=1e-12)


# One that MJCF has a word for, one that it has not; the laws themselves are those of the other routes.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks={"spring": (), "cogging": pytest.mark.slow}.get(name, pytest.mark.long))
        for name in FORCES
    ],
)
def test_on_a_joint_of_a_mujoco_model(name):
    """Held over steps of a fifth of a sample. Measured up to 1.3e-3 of what it changes."""
    mujoco = pytest.importorskip("mujoco")
    from diagnosis.machine.mujoco_plant import MujocoArm

    values, force = FORCES[name]
    truth = moved(COMMAND, force)[:, :1]
    log = np.column_stack([COMMAND, truth])
    record = PlantExperiment("a", "estimation", log, truth)
    arm = MujocoArm(mujoco.MjSpec.from_string(ROD), ("hinge",), DT_S)
    called = f"hinge.{IN_MJCF.get(name, name)}"
    plant = arm.plant([record], np.array([1e-4]), named=[called])
    change = Change(called, values)
    # The repaired text says it, too.
    text = arm.repaired(plant, plant, [change])
    again = MujocoArm(mujoco.MjSpec.from_string(text), ("hinge",), DT_S)
    read_back = again.plant([record], np.array([1e-4]))
    free = plant.simulator([])(log)
    for found in (plant.simulator([change])(log), read_back.simulator([])(log)):
        assert np.linalg.norm(found - truth) < 4e-3 * np.linalg.norm(free - truth)


@pytest.mark.parametrize("name", FORCES)
def test_on_the_hub_of_a_rig(name):
    """As the same torque on the hub, held over samples, does. Measured up to 8e-4 of what it changes."""
    values, force = FORCES[name]
    law = KINDS[name].law.change

    class ByRow(Effect):
        id = "by_row"
        words = "a row"

        def modify(self, machine):
            torque = SmoothTorque(law.law, tuple(values[p] for p in law.parameters), "motor", _OF[law.of])
            return replace(machine, joint=replace(machine.joint, torques=(torque,)))

    rig, voltage = paper_link(), 2 * COMMAND
    angle = Simulator(rig, [ByRow()]).measured(["hub_angle_rad"], voltage)[:, 0]
    free = Simulator(rig).measured(["hub_angle_rad"], voltage)[:, 0]
    middle, speed = 0.5 * (angle[1:] + angle[:-1]), np.diff(angle) / rig.sampling.dt_s
    torque = np.append(-force(middle, speed), 0.0)
    pushed = Simulator(rig).measured(["hub_angle_rad"], voltage, hub_torque_Nm=torque)[:, 0]
    assert np.linalg.norm(pushed - angle) < 3e-3 * np.linalg.norm(free - angle)


@pytest.mark.parametrize("turning", [1.0, -1.0])
def test_friction_in_proportion_to_load_on_a_joint_of_a_mujoco_model(turning):
    """Its row too; a load is a step late. Measured 1.2e-3 of what it changes."""
    mujoco = pytest.importorskip("mujoco")
    from diagnosis.machine.mujoco_plant import MujocoArm

    command, now = turning * COMMAND, 0.0

    def acceleration(x, v, u):
        nonlocal now
        now = abs(u)
        return u / INERTIA

    truth = rubbing(acceleration, command, DT_S, lambda v: 0.15 * now / INERTIA)[:, :1]
    log = np.column_stack([command, truth])
    record = PlantExperiment("a", "estimation", log, truth)
    arm = MujocoArm(mujoco.MjSpec.from_string(ROD), ("hinge",), DT_S)
    plant = arm.plant([record], np.array([1e-4]), named=["*.load_friction"])
    found = plant.simulator([Change("hinge.load_friction", {"share": 0.15})])(log)
    assert np.linalg.norm(found - truth) < 4e-3 * np.linalg.norm(plant.simulator([])(log) - truth)


def cogging_records(measured):
    """Records of a rod with a cogging torque of 0.15 sin(7 x + 0.4) N m and damping."""
    records = []
    for k, role in enumerate(("estimation", "estimation", "held_out")):
        command = np.random.default_rng(k).uniform(-1, 1, 15).repeat(20)
        motion = moved(command, lambda x, v: 0.1 * v - 0.15 * np.sin(7 * x + 0.4))
        records.append(
            PlantExperiment(f"{k}", role, *measured(command, motion, np.random.default_rng(9 + k)))
        )
    return records


def around_python():
    def simulate(p, e, u):
        """Of held commands the exact angle."""
        time_constant = INERTIA / p["damper"]
        pole = np.exp(-DT_S / time_constant)
        speed = lfilter([0, (1 - pole) / p["damper"]], [1, -pole], u[:, 0])
        slowed = time_constant * (1 - pole)
        steps = slowed * speed + (DT_S - slowed) / p["damper"] * u[:, 0]
        return np.cumsum(np.append(0.0, steps[:-1]))[:, None]

    records = cogging_records(lambda u, m, rng: (u[:, None], m[:, :1] + 1e-4 * rng.standard_normal((300, 1))))
    plant = Plant(simulate, {"damper": 0.1}, {"damper": 0.2}, ("x_rad",), np.array([1e-4]), model_error=0.05)
    names = ["cogging", "viscous_friction", "coulomb_friction", "spring"]
    return with_effects(plant, names, records, dt_s=DT_S, body=Body("x_rad")), records


def in_a_measured_motion():
    def simulate(p, e, u):
        return INERTIA * np.gradient(u[:, 1:], DT_S, axis=0) + p["damper"] * u[:, 1:]

    def measured(u, m, rng):
        x, v = m.T
        torque = INERTIA * np.gradient(v, DT_S) + 0.1 * v - 0.15 * np.sin(7 * x + 0.4)
        return m, torque[:, None] + 0.01 * rng.standard_normal((300, 1))

    records = cogging_records(measured)
    plant = Plant(simulate, {"damper": 0.1}, {"damper": 0.2}, ("T_Nm",), np.array([0.01]), model_error=0.02)
    names = ["cogging", "viscous_friction", "coulomb_friction", "spring"]
    return with_effects(plant, names, records, dt_s=DT_S, body=MeasuredBody(0, 1)), records


def on_a_mujoco_joint():
    mujoco = pytest.importorskip("mujoco")
    from diagnosis.machine.mujoco_plant import MujocoArm

    def measured(u, m, rng):
        angle = m[:, :1] + 1e-4 * rng.standard_normal((300, 1))
        return np.column_stack([u, angle]), angle

    records = cogging_records(measured)
    damped = ROD.replace('axis="0 0 1"', 'axis="0 0 1" damping="0.1"')
    arm = MujocoArm(mujoco.MjSpec.from_string(damped), ("hinge",), DT_S)
    return arm.plant(records, np.array([1e-4]), model_error=0.02, named=["hinge.cogging"]), records


@pytest.mark.parametrize(
    "route",
    [
        pytest.param(around_python, marks=pytest.mark.slow),
        in_a_measured_motion,
        pytest.param(on_a_mujoco_joint, marks=pytest.mark.long),
    ],
)
def test_cogging_is_diagnosed_with_its_size(route):
    plant, records = route()
    found = diagnose(PlantCase("rod", plant, tuple(records)))
    (name,) = found.combination
    assert name.rpartition(".")[2] == "cogging"
    amplitude, wave_number, phase = found.repair[0].values.values()
    assert amplitude == pytest.approx(0.15, rel=0.05)
    assert wave_number == pytest.approx(7.0, rel=0.01)
    assert phase == pytest.approx(0.4, abs=0.05)


_OF = {"position": "angle", "speed": "speed"}
