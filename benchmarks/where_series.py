"""On which variable does the error depend? Seventy-five machines with a force that no model knows.

A force that depends on one variable acts on a machine: on the angle of its joint (a cable, a ripple, a stop
of rubber), on its speed (dry, viscous or quadratic friction), on the time (warming up, a slow swell), on a
load that is logged beside, or on the angle of another joint. Three routes, five machines of each variable: a
MuJoCo model of a planar arm of two joints (the machine is MuJoCo at a fifth of the model's step, with a
torque of our own on the joint), a Python simulation of the same arm (the machine is its equations of motion,
by the classical Runge-Kutta method; the simulation takes half the steps, by the midpoint rule), and a
flexible link on a motor (the machine is stepped with a torque of our own, five to a sample; its other joint
is a wrist that is logged beside). Masses, damping and armature are off by their usual tolerances. Three logs
of four seconds under a controller, with noise; the last validates. Residuals are those of the model as
stated.

Right: the first dependence is of that variable, of that output or column. Place: it is at the right joint.
Size: RMS difference of the curve and the true force, each about its mean, over the RMS of the true force.
Eight machines of each route have no such force and are as stated, and five are shaken by a random torque that
no log holds: what is found there is a false alarm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import mujoco
import numpy as np
from numba import njit
from scipy.signal import butter, sosfilt

from benchmarks.harness import Print, main, timed
from benchmarks.mujoco_cases import ARMATURE, DAMPING, GRAVITY, LENGTHS_M, MASSES_KG, xml_of
from diagnosis import Case, Experiment, Plant, PlantCase, PlantExperiment, ResidualModel
from diagnosis.machine.mujoco_plant import MujocoArm
from diagnosis.machine.plant_effect import EffectParameter, PlantEffect
from diagnosis.where.where import where, where_in_records
from plant import SampledArm, paper_link

ROUTES = ("mujoco", "python", "rig")
VARIABLES = ("angle", "speed", "time", "load", "other")
# Sampling period of the logs.
DT_S = 0.01
# Step of the simulation.
STEP_S = 0.0025
# Rows of a log.
SAMPLES = 400
# Noise of an angle, standard deviation.
NOISE_RAD = 2e-4
LOGS = (("first", "estimation"), ("second", "estimation"), ("third", "held_out"))
JOINTS = ("shoulder", "elbow")
OUTPUTS = ("shoulder_rad", "elbow_rad")
# Proportional gains of the joints' controllers.
KP = np.array([25.0, 10.0])
# Derivative gains.
KD = np.array([2.5, 0.8])
# Stated masses are off by so much (relative standard deviation).
MASS_OFF = 0.01
# Stated damping.
DAMPING_OFF = 0.1
# Stated armature inertia.
ARMATURE_OFF = 0.05
# ... a rig's values by this part of their tolerances, which records without a controller show tenfold.
RIG_OFF = 0.2
# RMS of the force over that of the torques of its joint.
SHARES = (0.05, 0.2)
NONE = 8
# Steps of a rig's simulation a sample.
RIG_STEPS = 5
# Size of its voltage.
RIG_VOLTS = 1.0


@dataclass(frozen=True)
class Force:
    """A force of one variable x that moves over about a radian: `law` 0 to 2 of the variable, with a size."""

    variable: str
    law: int
    size: float
    middle: float

    def of(self, x: Any) -> Any:
        """Value at a variable in units of its usual size (speeds: 1 rad/s; time: the length of a log)."""
        z = x - self.middle
        laws = {
            "angle": (lambda: -z, lambda: -np.maximum(z, 0.0) * 2, lambda: -np.sin(6 * z)),
            "speed": (lambda: -np.tanh(x / 0.02), lambda: -x, lambda: -x * np.abs(x)),
            "time": (lambda: -x, lambda: 1 - np.exp(-4 * x), lambda: np.sin(5 * x)),
            "load": (lambda: -x, lambda: -np.maximum(x, 0.0) * 2, lambda: -np.tanh(2 * x)),
            "shaken": (lambda: x,) * 3,
            "other": (lambda: -z, lambda: -np.maximum(z, 0.0) * 2, lambda: -np.sin(3 * z)),
        }
        return self.size * laws[self.variable][self.law]()


@dataclass(frozen=True)
class Machine:
    route: str
    force: Force | None
    joint: int
    masses: Any
    damping: Any
    armature: Any
    seed: int = 0

    @property
    def answer(self) -> tuple[str, str]:
        """Quantity and what it is of, as the finding has them; a joint's angle and speed are of its
        output."""
        moved_output = self.outputs[self.joint]
        other = self.outputs[1 - self.joint]
        assert self.force is not None
        return {
            "angle": ("position", moved_output),
            "speed": ("speed", moved_output),
            "time": ("time", ""),
            "load": ("beside", "load_N"),
            "other": ("beside", other) if self.route == "rig" else ("position", other),
        }[self.force.variable]

    @property
    def outputs(self) -> tuple[str, str]:
        return {"mujoco": JOINTS, "python": OUTPUTS, "rig": ("hub_angle_rad", "wrist_rad")}[self.route]

    def torque(self, angles: Any, speeds: Any, time_s: float, load: float) -> float:
        """On the joint, at angles (2,), speeds (2,), a time and a load."""
        if self.force is None:
            return 0.0
        x = {
            "angle": angles[self.joint],
            "speed": speeds[self.joint],
            "time": time_s / (SAMPLES * DT_S),
            "load": load,
            "other": angles[1 - self.joint],
            "shaken": shaken(self.seed, time_s),
        }[self.force.variable]
        return float(self.force.of(x))


@cache
def shaking(seed: int) -> Any:
    """(3, 20) sizes, frequencies [Hz] and phases of a random torque in a log."""
    rng = np.random.default_rng(seed)
    return np.array([rng.normal(size=20), rng.uniform(0.3, 5.0, 20), rng.uniform(0, 2 * np.pi, 20)])


def shaken(seed: int, time_s: float) -> float:
    """A torque that is another in every log."""
    size, frequency, phase = shaking(seed)
    return float(np.sum(size * np.sin(2 * np.pi * frequency * time_s + phase)) / np.sqrt(10))


def smooth(rng: np.random.Generator, count: int, bandwidth_Hz: float, hold: int, rows: int) -> Any:
    """(rows, count) random steps behind a filter, from zero."""
    steps = np.repeat(rng.uniform(-1.0, 1.0, (rows // hold + 1, count)), hold, axis=0)[:rows]
    steps[:20] = 0.0
    return sosfilt(butter(2, bandwidth_Hz, fs=1 / DT_S, output="sos"), steps, axis=0)


def controlled(
    advance: Callable[[Any, float, float], None],
    angles_of: Callable[[], Any],
    rest: Any,
    rng: np.random.Generator,
) -> tuple[Any, Any, Any]:
    """Torques (T, 2), readings (T, 2) and load (T,) of an arm that follows random steps.

    advance : torques (2,), time and load -> None, over one sample.
    """
    reference = rest + smooth(rng, 2, 2.5, 60, SAMPLES)
    load = smooth(rng, 1, 1.5, 45, SAMPLES)[:, 0]
    U = np.zeros((SAMPLES, 2))
    Y = np.zeros((SAMPLES, 2))
    last = rest
    for k in range(SAMPLES):
        q = angles_of() + NOISE_RAD * rng.standard_normal(2)
        U[k] = KP * (reference[k] - q) - KD * (q - last) / DT_S * (k > 0)
        advance(U[k], k * DT_S, load[k])
        Y[k] = q
        last = q
    return U, Y, load


REST = np.array([np.pi / 2, 0.0])


def in_mujoco(machine: Machine, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """One log of the arm in MuJoCo."""
    fine = STEP_S / 5
    xml = xml_of(2, False, machine.masses, machine.damping, machine.armature, fine)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:] = REST

    def advance(torque: Any, time_s: float, load: float) -> None:
        data.ctrl[:] = torque
        for k in range(round(DT_S / fine)):
            of = machine.torque(data.qpos, data.qvel, time_s + k * fine, load)
            data.qfrc_applied[machine.joint] = of
            mujoco.mj_step(model, data)

    return controlled(advance, lambda: data.qpos.copy(), REST, rng)


@njit(cache=True)
def accelerations(q, v, torque, m, d, a):  # type: ignore[no-untyped-def]
    """(2,) of two rods of square section 2 cm that hang, q2 relative to q1: M(q) a + c(q, v) = torque +
    g(q)."""
    l1, l2 = LENGTHS_M
    i1 = m[0] * (l1 * l1 / 3 + 0.02 * 0.02 / 12)
    i2 = m[1] * (l2 * l2 / 3 + 0.02 * 0.02 / 12)
    s1 = m[0] * l1 / 2
    s2 = m[1] * l2 / 2
    h = l1 * s2
    c = np.cos(q[1])
    s = np.sin(q[1])
    j11 = i1 + i2 + m[1] * l1 * l1 + 2 * h * c + a[0]
    j12 = i2 + h * c
    j22 = i2 + a[1]
    g2 = s2 * np.cos(q[0] + q[1]) * GRAVITY
    g1 = (s1 + m[1] * l1) * np.cos(q[0]) * GRAVITY + g2
    f1 = torque[0] - d[0] * v[0] + g1 + h * s * (2 * v[0] * v[1] + v[1] * v[1])
    f2 = torque[1] - d[1] * v[1] + g2 - h * s * v[0] * v[0]
    det = j11 * j22 - j12 * j12
    return np.array([(j22 * f1 - j12 * f2) / det, (j11 * f2 - j12 * f1) / det])


def by_equations(machine: Machine, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """One log of the arm as its equations of motion."""
    state = np.concatenate([REST, np.zeros(2)])
    count = 20

    def slope(y: Any, torque: Any, time_s: float, load: float) -> Any:
        total = np.array(torque)
        total[machine.joint] += machine.torque(y[:2], y[2:], time_s, load)
        a = accelerations(y[:2], y[2:], total, machine.masses, machine.damping, machine.armature)
        return np.concatenate([y[2:], a])

    def advance(torque: Any, time_s: float, load: float) -> None:
        nonlocal state
        h = DT_S / count
        for k in range(count):
            t = time_s + k * h
            k1 = slope(state, torque, t, load)
            k2 = slope(state + h / 2 * k1, torque, t + h / 2, load)
            k3 = slope(state + h / 2 * k2, torque, t + h / 2, load)
            k4 = slope(state + h * k3, torque, t + h, load)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    return controlled(advance, lambda: state[:2].copy(), REST, rng)


@njit(cache=True)
def _two_steps(inputs, m, d, a):  # type: ignore[no-untyped-def]
    """(T, 2) angles of the arm under torques (T, 2), from rest."""
    angles = np.zeros((len(inputs), 2))
    count = 10
    h = DT_S / count
    q = np.array([np.pi / 2, 0.0])
    v = np.zeros(2)
    for k in range(len(inputs)):
        angles[k] = q
        for _ in range(count):
            half = v + h / 2 * accelerations(q, v, inputs[k], m, d, a)
            middle = q + h / 2 * v
            v = v + h * accelerations(middle, half, inputs[k], m, d, a)
            q = q + h * half
    return angles


def simulate(parameters: Any, effects: Any, inputs: Any) -> Any:
    """The Python simulation of the arm, as somebody would bring it."""
    values = [np.array([parameters[f"{key}{k}"] for k in (1, 2)]) for key in ("mass", "damping", "armature")]
    return _two_steps(np.ascontiguousarray(inputs), *values)


def of_rig(machine: Machine, rig: Any, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """Voltage (T, 1), outputs (T, 2) and what is logged beside, of one log of the flexible link."""
    dt_s = rig.sampling.dt_s
    arm = SampledArm(rig, dt_s=dt_s / RIG_STEPS)
    wrist = 0.5 * smooth(rng, 1, 1.5, 50, SAMPLES)[:, 0]
    load = smooth(rng, 1, 1.5, 45, SAMPLES)[:, 0]
    voltage = RIG_VOLTS * smooth(rng, 1, 8.0, 25, SAMPLES)
    Y = np.zeros((SAMPLES, 2))
    last = 0.0
    for k in range(SAMPLES):
        Y[k] = arm.true_output
        for part in range(RIG_STEPS):
            hub = float(arm.true_output[0])
            speed = (hub - last) / (dt_s / RIG_STEPS)
            last = hub
            time_s = (k + part / RIG_STEPS) * DT_S
            of = machine.torque(np.array([hub, wrist[k]]), np.array([speed, 0.0]), time_s, load[k])
            arm.advance(float(voltage[k, 0]), of)
    noise = np.array([rig.sensors.hub_angle_noise_rad, rig.sensors.tip_noise_m])
    return voltage, Y + noise * rng.standard_normal(Y.shape), {"wrist_rad": wrist, "load_N": load}


def case_of(route: str, variable: str, number: int, seed: int) -> tuple[Machine, Any, Any]:
    """The machine, its case and its residuals (record -> (T, Y))."""
    draw = [seed, ROUTES.index(route), ("none", *VARIABLES, "shaken").index(variable), number]
    rng = np.random.default_rng(draw)

    def off(values: Any, share: float) -> Any:
        return np.array(values) * np.exp(share * rng.standard_normal(2))

    joint = 0 if route == "rig" else int(rng.integers(2))
    rest_angle = REST[joint]
    if route == "rig":
        rest_angle = 0.0
    elif variable == "other":
        rest_angle = REST[1 - joint]
    force = None
    if variable != "none":
        middle = rest_angle + rng.uniform(-0.2, 0.2)
        force = Force(variable, int(rng.integers(3)), 0.0, middle if variable in ("angle", "other") else 0.0)
    known = 0.0 if variable in ("none", "shaken") else 1.0
    offs = ((MASSES_KG, MASS_OFF), (DAMPING, DAMPING_OFF), (ARMATURE, ARMATURE_OFF))
    bodies = [off(values, known * share) for values, share in offs]
    machine = Machine(route, force, joint, *bodies)
    share = float(np.exp(rng.uniform(*np.log(SHARES))))
    rig = rig_of(rng, known)

    def log(machine: Machine, draw: np.random.Generator) -> Any:
        if route == "rig":
            return of_rig(machine, rig[1], draw)
        return (in_mujoco if route == "mujoco" else by_equations)(machine, draw)

    if force is not None:
        # The size of a force is that which has the drawn share of the torques in the log without it.
        U, Y, beside = log(Machine(route, None, joint, *bodies), np.random.default_rng(draw))
        unit_force = Force(variable, force.law, 1.0, force.middle)
        unit = Machine(route, unit_force, joint, *bodies)
        dt_s = rig[1].sampling.dt_s if route == "rig" else DT_S
        scale = rig_torque(rig[1]) if route == "rig" else 1.0
        whole = np.std(scale * U[:, joint]) * share
        machine = Machine(
            route,
            Force(variable, force.law, whole / np.std(along(unit, Y, beside, dt_s)), force.middle),
            joint,
            *bodies,
        )
    records = []
    for k, (name, role) in enumerate(LOGS):
        U, Y, beside = log(replace(machine, seed=1000 * number + k), rng)
        if route == "rig":
            records.append(Experiment(name, role, U[:, 0], Y, beside=beside))  # type: ignore[arg-type]
            continue
        held = np.column_stack([U, Y]) if route == "mujoco" else U
        load = {"load_N": beside}
        records.append(PlantExperiment(name, role, held, Y, beside=load))  # type: ignore[arg-type]
    case = modelled(route, f"{route} {variable} {number}", records, rig[0])
    as_stated = np.zeros(len(case.machine.tolerances))
    return machine, case, ResidualModel(case).by_experiment(as_stated, ())


def rig_of(rng: np.random.Generator, known: float) -> tuple[Any, Any]:
    """The rig as stated, and as it is."""
    rig = paper_link().perturbed(
        {
            "link.length_m": 0.6, "link.width_m": 0.025, "link.thickness_m": 0.0011,
            "hub.inertia_kg_m2": 0.007, "hub.radius_m": 0.05, "hub.viscous_friction_Nms": 0.006,
            "motor.gear_ratio": 20.0, "sensors.tip_noise_m": 0.0008,
        }
    )  # fmt: skip
    off = {
        key: float(np.exp(known * RIG_OFF * t * rng.standard_normal())) for key, t in rig.tolerances.items()
    }
    return rig, rig.scaled(off)


def rig_torque(rig: Any) -> float:
    """Nm per volt at rest."""
    return float(rig.motor.torque_constant_Nm_A * rig.motor.gear_ratio / rig.motor.resistance_ohm)


def along(machine: Machine, Y: Any, beside: Any, dt_s: float) -> Any:
    """(T,) true force along a log, from its readings; the time of a machine is in hundredths of a second."""
    if machine.route == "rig":
        angles = np.column_stack([Y[:, 0], beside["wrist_rad"]])
        load = beside["load_N"]
    else:
        angles = Y
        load = beside
    speeds = np.gradient(angles, dt_s, axis=0)
    steps = zip(angles, speeds, DT_S * np.arange(len(Y)), load, strict=True)
    return np.array([machine.torque(*step) for step in steps])


def modelled(route: str, name: str, records: Any, rig: Any) -> Any:
    """The case of a route."""
    if route == "rig":
        return Case(name, rig, tuple(records))
    noise = np.full(2, NOISE_RAD)
    if route == "mujoco":
        spec = mujoco.MjSpec.from_string(xml_of(2, False, MASSES_KG, DAMPING, ARMATURE, STEP_S))
        arm = MujocoArm(spec, JOINTS, DT_S)
        arm = MujocoArm(arm.spec, JOINTS, DT_S, arm.tracking(records))
        return PlantCase(name, arm.plant(records, noise), tuple(records))
    stated = {"mass": MASSES_KG, "damping": DAMPING, "armature": ARMATURE}
    parameters = {f"{key}{k + 1}": value[k] for key, value in stated.items() for k in (0, 1)}
    listed = (PlantEffect("nothing", (EffectParameter("size", 1e-3, 1.0),)),)
    plant = Plant(
        simulate, parameters, dict.fromkeys(parameters, 0.05), OUTPUTS, noise, listed, 0.0, DT_S,
        input_names=("shoulder_Nm", "elbow_Nm"),
    )  # fmt: skip
    return PlantCase(name, plant, tuple(records))


def places(machine: Machine) -> str:
    """Name of the place at which the force acts."""
    return {"mujoco": JOINTS[machine.joint], "python": f"{JOINTS[machine.joint]}_Nm", "rig": "hub"}[
        machine.route
    ]


def missed(machine: Machine, case: Any, found: Any) -> float:
    """RMS of curve less true force over that of the force, each about its mean, over the last log."""
    record = case.experiments[-1]
    beside = record.beside if machine.route == "rig" else record.beside["load_N"]
    true = along(machine, record.output, beside, case.dt_s)
    x = variable_of(machine, record, case.dt_s)
    curve = np.interp(x, found.centres, found.values)
    inside = (x >= found.centres[0]) & (x <= found.centres[-1])
    error = (curve - true)[inside]
    return float(np.std(error) / np.std(true[inside]))


def variable_of(machine: Machine, record: Any, dt_s: float) -> Any:
    """(T,) of the force of a machine, in the unit of the finding."""
    assert machine.force is not None
    if machine.route == "rig":
        angles = np.column_stack([record.output[:, 0], record.beside["wrist_rad"]])
    else:
        angles = record.output
    return {
        "angle": angles[:, machine.joint],
        "speed": np.gradient(angles[:, machine.joint], dt_s),
        "time": dt_s * np.arange(len(angles)),
        "load": record.beside["load_N"],
        "other": angles[:, 1 - machine.joint],
    }[machine.force.variable]


def answered(
    route: str, variable: str, number: int, seed: int, out: Print
) -> tuple[bool, bool, float, float]:
    """Whether the variable is named right (of none: nothing is found), the place too; error of the curve
    (not a number where it is another one); CPU seconds."""
    machine, case, residuals = case_of(route, variable, number, seed)
    look = (
        partial(where, case, residuals)
        if route == "rig"
        else partial(where_in_records, case, residuals, DT_S)
    )
    seen, cpu_s = timed(look)
    dependences = seen.dependences
    in_words = "; ".join(
        f"{dependence.acts} {dependence.place}({dependence.quantity} {dependence.of}) "
        f"{dependence.share:.2f} {dependence.shape}"
        for dependence in dependences
    )
    begin = f"{route:7s} {variable:6s} {number}"
    if machine.force is None or variable == "shaken":
        out(f"{begin} {'' if dependences else 'right':6s} {in_words or 'nothing'} ({cpu_s:.1f} s)")
        return not dependences, not dependences, float("nan"), cpu_s

    right = bool(dependences) and (dependences[0].quantity, dependences[0].of) == machine.answer
    at_place = right and dependences[0].place == places(machine) and dependences[0].acts == "force"
    error = missed(machine, case, dependences[0]) if at_place else float("nan")
    of = f"law {machine.force.law} of {machine.force.size:.3g} Nm at {places(machine)}"
    off = f", curve off by {100 * error:.0f} %" if np.isfinite(error) else ""
    out(
        f"{begin} {'right' if right else 'WRONG':6s} {of:36s} -> {in_words or 'nothing'}{off} "
        f"(gap {seen.gap.gap_rms:.1f}, {cpu_s:.1f} s)"
    )
    return right, at_place, error, cpu_s


def run(
    out: Print, *, seed: int = 86, each: int = 5, routes: tuple[str, ...] = ROUTES, none: int = NONE
) -> None:
    every: list[tuple[bool, bool, float, float]] = []
    quiet: list[tuple[bool, bool, float, float]] = []
    counts: dict[tuple[str, str], int] = {}
    for route in routes:
        for variable in VARIABLES:
            here = [answered(route, variable, k, seed, out) for k in range(each)]
            counts[route, variable] = sum(answer[0] for answer in here)
            every += here
        quiet += [answered(route, "none", k, seed, out) for k in range(none)]
        quiet += [answered(route, "shaken", k, seed, out) for k in range(each)]
    out()
    for route in routes:
        by = ", ".join(f"{variable} {counts[route, variable]}" for variable in VARIABLES)
        out(f"{route:7s} right of {each}: {by}")
    out(f"variable right: {sum(answer[0] for answer in every)} of {len(every)}")
    out(f"place right too: {sum(answer[1] for answer in every)} of {len(every)}")
    out(f"false alarms: {sum(not answer[0] for answer in quiet)} of {len(quiet)}")
    errors = [answer[2] for answer in every if np.isfinite(answer[2])]
    if errors:
        out(f"curve against the true force: median {100 * float(np.median(errors)):.0f} % of it")
    times = [answer[3] for answer in every + quiet]
    out(f"CPU of where, median: {float(np.median(times)):.1f} s, most {max(times):.1f} s")


if __name__ == "__main__":
    main(run)
