"""Eighty generated arms against their MuJoCo models: is the effect named, how near is its size, false alarms.

Arms of one and two joints follow random steps under a sampled PD controller, or position servos of their own;
angles have noise of 0.2 mrad. Two of three logs begin in motion. The model has any of MuJoCo's integrators, a
gear or none, and masses, damping and armature drawn off by their usual tolerances. Every other truth is
MuJoCo at a fifth of the model's step, with the effect put in by other means than the candidates use (torques
of our own on the joints, an added geom, a tilted base, commands changed on their way); the others are the
equations of motion of a planar arm, derived by hand and integrated by the classical Runge-Kutta method.

First: the effect is the first answer; exact: it is the only one. Size: the value in the repaired model (ratio
times stated value, or size of an added effect) against the truth. The order of the cases is drawn, so that
the first ones of a series are a sample of it.
"""

from __future__ import annotations

import math
from collections import deque
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any

import mujoco
import numpy as np
from numba import njit
from scipy.signal import butter, sosfilt
from scipy.stats import norm

from benchmarks.harness import Print, main, timed
from diagnosis import PlantCase, PlantExperiment, diagnose
from diagnosis.machine.mujoco_plant import MujocoArm

# Sampling period of the logs.
DT_S = 0.01
# Step of the simulation.
STEP_S = 0.0025
# Rows of a log.
SAMPLES = 300
# Noise of an angle, standard deviation.
NOISE_RAD = 2e-4
# Share of the motion that does not matter.
MODEL_ERROR = 0.02
# Acceleration of gravity, m/s^2.
GRAVITY = 9.81
INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")
# Motors, motors behind a gear, position servos.
DRIVES = ("motor", "gear", "servo")
# Ratio of the gears.
GEAR = 20.0
# Stiffness and damping of each servo.
SERVO = ((60.0, 6.0), (25.0, 2.0))
# Rows that a log lacks at its start.
MOVING = 70
# Lengths of the links.
LENGTHS_M = (0.3, 0.25)
# Their masses.
MASSES_KG = (1.2, 0.8)
# Viscous damping of the joints, N m s/rad.
DAMPING = (0.25, 0.12)
# Armature inertia of the joints, kg m^2.
ARMATURE = (0.03, 0.015)
JOINTS = ("shoulder", "elbow")

# Effect, joints of the arm, joint it is at. Where gravity does not act ("tilt"), the arm lies flat.
KINDS = (
    *[("frictionloss", n, j) for n, j in ((1, 0), (1, 0), (2, 0), (2, 1))],
    *[("damping", n, j) for n, j in ((1, 0), (2, 0), (2, 1))],
    *[("stiffness", n, j) for n, j in ((1, 0), (1, 0), (2, 1))],
    *[("armature", n, j) for n, j in ((1, 0), (2, 0), (2, 1))],
    *[("gain", n, j) for n, j in ((1, 0), (1, 0), (2, 0), (2, 1))],
    *[("lag", n, j) for n, j in ((1, 0), (1, 0), (2, 1))],
    *[("delay", n, j) for n, j in ((1, 0), (1, 0), (2, 0))],
    *[("payload", n, j) for n, j in ((1, 0), (1, 0), (2, 1))],
    *[("tilt", n, j) for n, j in ((1, 0), (1, 0), (2, 0))],
    *[("sensor_offset", 2, 1)] * 3,
    *[("none", n, 0) for n in (1, 2) * 4],
)
SIZES = {
    "frictionloss": (0.08, 0.25),
    "damping": (2.2, 3.5),
    "stiffness": (0.6, 2.0),
    "armature": (1.8, 3.0),
    "gain": (0.7, 0.85),
    "lag": (0.02, 0.05),
    "delay": (0.015, 0.035),
    "payload": (0.12, 0.35),
    "tilt": (0.05, 0.15),
    "sensor_offset": (0.06, 0.15),
}


@dataclass(frozen=True)
class Truth:
    """masses, damping, armature (n,) of the machine; effect, joint, size; flat: gravity along the axes."""

    n: int
    masses: Any
    damping: Any
    armature: Any
    effect: str
    joint: int
    size: float
    flat: bool
    drive: str = "motor"
    integrator: str = "Euler"
    moving: bool = False

    @property
    def name(self) -> str:
        """Name of the candidate that is right."""
        joint = JOINTS[self.joint]
        names = {
            "none": "none",
            "payload": f"link{self.n}.payload",
            "tilt": "gravity.x",
            "gain": f"wrong_motor{self.joint + 1}.gain",
            "lag": f"motor{self.joint + 1}.lag",
            "delay": f"motor{self.joint + 1}.delay",
            "damping": f"wrong_{joint}.damping",
            "armature": f"wrong_{joint}.armature",
        }
        return names.get(self.effect, f"{joint}.{self.effect}")

    @property
    def value(self) -> float:
        """Value of the quantity in the repaired model."""
        if self.effect == "tilt":
            return GRAVITY * float(np.sin(self.size))
        whole = {"damping": self.damping, "armature": self.armature}
        return self.size * float(whole[self.effect][self.joint]) if self.effect in whole else self.size

    def of(self, effect: str, without: float) -> Any:
        """(n,) of a quantity of the joints, with the effect's size at its joint."""
        values = np.full(self.n, without)
        if self.effect == effect:
            values[self.joint] = self.size
        return values


def xml_of(
    n: int,
    flat: bool,
    masses: Any,
    damping: Any,
    armature: Any,
    step_s: float,
    tilt: float = 0.0,
    drive: str = "motor",
    integrator: str = "RK4",
) -> str:
    """tilt: of the base, about y [rad]."""
    axis = "0 0 1" if flat else "0 1 0"
    inner = ""
    for k in reversed(range(n)):
        at = f'pos="{LENGTHS_M[k - 1]} 0 0"' if k else f'euler="0 {tilt} 0"'
        site = f'<site name="tip" pos="{LENGTHS_M[k]} 0 0"/>' if k == n - 1 else ""
        inner = (
            f'<body name="link{k + 1}" {at}><joint name="{JOINTS[k]}" axis="{axis}" damping="{damping[k]}" '
            f'armature="{armature[k]}"/><geom type="box" pos="{LENGTHS_M[k] / 2} 0 0" '
            f'size="{LENGTHS_M[k] / 2} 0.01 0.01" mass="{masses[k]}" contype="0" conaffinity="0"/>'
            f"{site}{inner}</body>"
        )
    kinds = {
        "motor": ["motor"] * n,
        "gear": [f'motor gear="{GEAR}"'] * n,
        "servo": [f'position kp="{kp}" kv="{kv}"' for kp, kv in SERVO[:n]],
    }
    motors = "".join(f'<{kinds[drive][k]} name="motor{k + 1}" joint="{JOINTS[k]}"/>' for k in range(n))
    return (
        f'<mujoco model="arm"><compiler angle="radian"/>'
        f'<option timestep="{step_s}" integrator="{integrator}" gravity="0 0 {-GRAVITY}"/>'
        f"<worldbody>{inner}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


class InMujoco:
    """The machine in MuJoCo at a small step, with torques of our own on the joints."""

    def __init__(self, truth: Truth) -> None:
        self.truth = truth
        tilt = truth.size if truth.effect == "tilt" else 0.0
        stated = (
            truth.masses,
            truth.damping * truth.of("damping", 1.0),
            truth.armature * truth.of("armature", 1.0),
        )
        spec = mujoco.MjSpec.from_string(xml_of(truth.n, truth.flat, *stated, STEP_S / 5, tilt))
        if truth.effect == "payload":
            tip = spec.body(f"link{truth.n}")
            tip.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[1e-3, 0, 0],
                pos=[LENGTHS_M[truth.n - 1], 0, 0],
                mass=truth.size,
                contype=0,
                conaffinity=0,
            )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = at_rest(truth)

    @property
    def angle(self) -> Any:
        return self.data.qpos.copy()

    def step(self, torque: Any) -> None:
        level = self.truth.of("frictionloss", 0.0)
        spring = self.truth.of("stiffness", 0.0)
        kp, kv = np.array(SERVO[: self.truth.n]).T
        for _ in range(round(5 * DT_S / STEP_S)):
            v = self.data.qvel
            held = torque
            if self.truth.drive == "servo":  # the command is an angle
                held = kp * (torque - self.data.qpos) - kv * v
            self.data.ctrl[:] = held * self.truth.of("gain", 1.0)
            self.data.qfrc_applied[:] = -level * np.tanh(v / 5e-3) - spring * self.data.qpos
            mujoco.mj_step(self.model, self.data)


class ByEquations:
    """The machine as two equations of motion (absolute angles of rods, downwards positive), Runge-Kutta."""

    def __init__(self, truth: Truth) -> None:
        self.n = n = truth.n
        self.state = np.zeros(4)
        self.state[:n] = at_rest(truth)

        def two(values: Any, without: float) -> Any:
            return np.array([*values, *[without] * (2 - n)], dtype=np.float64)

        load = truth.size if truth.effect == "payload" else 0.0
        tilt = truth.size if truth.effect == "tilt" else 0.0
        self.constants = (
            n,
            two(truth.masses, 0.0),
            two(truth.damping * truth.of("damping", 1.0), 0.0),
            two(truth.armature * truth.of("armature", 1.0), 1.0),
            two(truth.of("frictionloss", 0.0), 0.0),
            two(truth.of("stiffness", 0.0), 0.0),
            load,
            # Along the arm at zero, and along the direction to which positive angles turn it.
            GRAVITY * np.sin(tilt),
            0.0 if truth.flat else GRAVITY * np.cos(tilt),
        )

    @property
    def angle(self) -> Any:
        return self.state[: self.n].copy()

    def step(self, torque: Any) -> None:
        self.state = _integrated(self.state, np.append(torque, [0.0] * (2 - self.n)), *self.constants)


@njit(cache=True)
def _integrated(y, torque, n, m, d, a, level, spring, load, along, across):  # type: ignore[no-untyped-def]
    count = 100
    h = DT_S / count
    for _ in range(count):
        k1 = _slope(y, torque, n, m, d, a, level, spring, load, along, across)
        k2 = _slope(y + h / 2 * k1, torque, n, m, d, a, level, spring, load, along, across)
        k3 = _slope(y + h / 2 * k2, torque, n, m, d, a, level, spring, load, along, across)
        k4 = _slope(y + h * k3, torque, n, m, d, a, level, spring, load, along, across)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return y


@njit(cache=True)
def _slope(y, torque, n, m, d, a, level, spring, load, along, across):  # type: ignore[no-untyped-def]
    """Rods of square section 2 cm: inertia m (L^2 + 0.02^2) / 12 about the middle. q2 is relative to q1.

    Kinetic energy with c = cos q2: J11 = I1 + I2 + m2 L1^2 + 2 h c, J12 = I2 + h c, J22 = I2, where I are
    about the joints and h = L1 s2, s2 the static moment of rod and payload about the second joint.
    """
    l1, l2 = LENGTHS_M
    q1, q2, v1, v2 = y
    i1 = m[0] * (l1 * l1 / 3 + 0.02 * 0.02 / 12)
    i2 = m[1] * (l2 * l2 / 3 + 0.02 * 0.02 / 12)
    s1 = m[0] * l1 / 2
    s2 = m[1] * l2 / 2
    m2 = m[1]
    if n == 1:
        i1 += load * l1 * l1
        s1 += load * l1
    else:
        i2 += load * l2 * l2
        s2 += load * l2
        m2 += load
    c = np.cos(q2)
    s = np.sin(q2)
    h = l1 * s2
    j11 = i1 + i2 + m2 * l1 * l1 + 2 * h * c + a[0]
    j12 = i2 + h * c
    j22 = i2 + a[1]
    # Gravity moments: a rod at angle q points along (cos q, sin q); its weight pulls along (along, across).
    shoulder_moment = s1 + m2 * l1
    g1 = -shoulder_moment * np.sin(q1) * along + shoulder_moment * np.cos(q1) * across
    g2 = -s2 * np.sin(q1 + q2) * along + s2 * np.cos(q1 + q2) * across
    f1 = torque[0] - d[0] * v1 - level[0] * np.tanh(v1 / 5e-3) - spring[0] * q1 + g1 + g2
    f2 = torque[1] - d[1] * v2 - level[1] * np.tanh(v2 / 5e-3) - spring[1] * q2 + g2
    f1 += h * s * (2 * v1 * v2 + v2 * v2)
    f2 -= h * s * v1 * v1
    if n == 1:
        return np.array([v1, 0.0, f1 / j11, 0.0])
    det = j11 * j22 - j12 * j12
    return np.array([v1, v2, (j22 * f1 - j12 * f2) / det, (j11 * f2 - j12 * f1) / det])


def at_rest(truth: Truth) -> Any:
    """Hanging where gravity acts (a rod at zero lies level), else at zero."""
    return np.array([0.0 if truth.flat else np.pi / 2, 0.0])[: truth.n]


def record(truth: Truth, rng: np.random.Generator, *, by_equations: bool) -> tuple[Any, Any]:
    """Commands and readings (T, n) under the controller."""
    machine: InMujoco | ByEquations = ByEquations(truth) if by_equations else InMujoco(truth)
    n = truth.n
    rows = SAMPLES + (MOVING if truth.moving else 0)
    steps = np.repeat(rng.uniform(-1.0, 1.0, (rows // 60 + 1, n)), 60, axis=0)[:rows]
    steps[:20] = 0.0
    reference = at_rest(truth) + sosfilt(butter(2, 2.5, fs=1 / DT_S, output="sos"), steps, axis=0)
    kp = np.array([25.0, 10.0])[:n]
    kd = np.array([2.5, 0.8])[:n]
    offset = truth.of("sensor_offset", 0.0)
    first = at_rest(truth) if truth.drive == "servo" else np.zeros(n)
    queue = deque([first] * 40, maxlen=40)
    lagged = first
    last = None
    U = np.zeros((rows, n))
    Y = np.zeros((rows, n))
    for k in range(rows):
        q = machine.angle + offset + NOISE_RAD * rng.standard_normal(n)
        speed = np.zeros(n) if last is None else (q - last) / DT_S
        u = reference[k] if truth.drive == "servo" else kp * (reference[k] - q) - kd * speed
        queue.append(u)
        late = truth.of("delay", 0.0) / DT_S
        whole = np.floor(late).astype(int)
        now = np.array([queue[-1 - w][j] for j, w in enumerate(whole)])
        before = np.array([queue[-2 - w][j] for j, w in enumerate(whole)])
        sent = (1 - (late - whole)) * now + (late - whole) * before
        T = truth.of("lag", 0.0)
        keep = np.where(T > 0, np.exp(-DT_S / np.maximum(T, 1e-9)), 0.0)
        # Mean of the lagged command over the sample.
        mean = sent + (lagged - sent) * np.where(T > 0, T / DT_S * (1 - keep), 0.0)
        lagged = keep * lagged + (1 - keep) * sent
        machine.step(mean if isinstance(machine, InMujoco) else mean * truth.of("gain", 1.0))
        U[k] = u / (GEAR if truth.drive == "gear" else 1.0)
        Y[k] = q
        last = q
    return U[rows - SAMPLES :], Y[rows - SAMPLES :]


def case_of(number: int, seed: int) -> tuple[Truth, PlantCase]:
    """The number-th case, 0 to 79."""
    rng = np.random.default_rng([seed, number])
    effect, n, joint = KINDS[number % len(KINDS)]
    drive = DRIVES[number // 2 % 3]
    flat = effect == "tilt"
    low, high = SIZES.get(effect, (1.0, 1.0))

    def off(values: Any, share: float) -> Any:
        return np.array(values[:n]) * np.exp(share * rng.standard_normal(n))

    truth = Truth(
        n, off(MASSES_KG, 0.02), off(DAMPING, 0.1), off(ARMATURE, 0.05), effect, joint,
        float(np.exp(rng.uniform(np.log(low), np.log(high)))), flat,
        drive, INTEGRATORS[number // 2 % 4], number % 3 > 0,
    )  # fmt: skip
    experiments = []
    for role in ("estimation", "held_out"):
        U, Y = record(truth, rng, by_equations=_by_equations(number))
        experiments.append(PlantExperiment(role, role, np.column_stack([U, Y]), Y))  # type: ignore[arg-type]
    model = xml_of(n, flat, MASSES_KG, DAMPING, ARMATURE, STEP_S, drive=drive, integrator=truth.integrator)
    spec = mujoco.MjSpec.from_string(model)
    arm = MujocoArm(spec, JOINTS[:n], DT_S)
    arm = MujocoArm(arm.spec, JOINTS[:n], DT_S, arm.tracking(experiments))
    plant = arm.plant(experiments, np.full(n, NOISE_RAD), model_error=MODEL_ERROR)
    return truth, PlantCase(f"case {number}", plant, tuple(experiments))


def _by_equations(number: int) -> bool:
    """Servos are in MuJoCo alone."""
    return number % 2 == 1 and DRIVES[number // 2 % 3] != "servo"


# Half a 95 % interval of a normal error, in standard deviations.
NORMAL_HALF_WIDTH = float(norm.ppf(0.975))
# Median size of a normal error, in standard deviations.
NORMAL_MEDIAN_SIZE = float(norm.ppf(0.75))
# A wrong answer above this was sure.
SURE = 0.8


@dataclass(frozen=True)
class Answer:
    """How one case was answered.

    Attributes
    ----------
    line : str
        For the table.
    integrator : str
        Of the machine.
    is_none : bool
        Nothing is there.
    first : bool
        The effect that is there is the first answer.
    exact : bool
        The accepted set is what is there.
    error : float
        Relative error of the size, where the effect is named; else nan.
    covers : bool
        The 95 % interval of its size holds the truth.
    standard_errors : float
        The error in standard deviations as the interval states them; nan without an interval.
    is_sure_and_wrong : bool
        A wrong answer of more than 80 %, a wrong partner counted.
    cpu_s : float
    """

    line: str
    integrator: str
    is_none: bool
    first: bool
    exact: bool
    error: float
    covers: bool
    standard_errors: float
    is_sure_and_wrong: bool
    cpu_s: float


def answer(number: int, seed: int) -> Answer:
    """Make a case, diagnose it, and compare."""
    truth, case = case_of(number, seed)
    diagnosis, cpu_s = timed(partial(diagnose, case))
    is_none = truth.effect == "none"
    first = diagnosis.effects[0].name == truth.name
    exact = diagnosis.combination == (truth.name,)
    if is_none:
        exact = diagnosis.verdict == "none"

    # Sizes of the repaired machine: stated values, multiplied or added to.
    values = dict(diagnosis.rig.parameters)
    for change in diagnosis.repair:
        size = next(iter(change.values.values()))
        key = change.id.removeprefix("wrong_")
        values[key] = values[key] * size if key in values else size
    key = truth.name.removeprefix("wrong_")
    error = math.nan
    covers = False
    standard_errors = math.nan
    size_in_words = ""
    if not is_none:
        estimate = abs(values.get(key, 0.0))
        error = abs(estimate / truth.value - 1)
        size_in_words = f"{truth.value:.4g}, found {100 * (estimate / truth.value - 1):+.1f} %"
    if first and not is_none and diagnosis.effects[0].intervals:
        interval = next(iter(diagnosis.effects[0].intervals.values()))
        # A wrong stated value has a ratio.
        low, high = sorted(abs(end) * case.plant.parameters.get(key, 1.0) for end in interval)
        covers = low <= truth.value <= high
        standard_errors = error * truth.value / ((high - low) / 2) * NORMAL_HALF_WIDTH
        if covers:
            size_in_words += " (in its interval)"

    source = "equations" if _by_equations(number) else "MuJoCo"
    answer = ", ".join(diagnosis.combination) or diagnosis.verdict
    line = (
        f"{number:3d} {source:9s} {truth.integrator:12s} {truth.drive:5s} "
        f"{'moving' if truth.moving else 'rest':6s} {truth.n} {truth.name:26s} {size_in_words:42s} "
        f"-> {answer} "
        f"{diagnosis.probability:.3f} (gap {diagnosis.gap_refit:.1f} to {diagnosis.gap_after:.1f}, "
        f"{cpu_s:.0f} s)"
    )
    is_sure = diagnosis.probability > SURE and diagnosis.verdict != "unknown"
    return Answer(
        line,
        truth.integrator,
        is_none,
        first,
        exact,
        error,
        covers,
        standard_errors,
        is_sure and not exact,
        cpu_s,
    )


def run(out: Print, *, seed: int = 15, first: int = 0, cases: int = 80, jobs: int = 2) -> None:
    """Diagnose cases in an order that is drawn, so that the first ones are a sample of all; tell."""
    order = np.random.default_rng(seed).permutation(2 * len(KINDS)).tolist()
    numbers = order[first : first + cases]
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        answers: list[Answer] = []
        try:
            for each in pool.map(answer, numbers, [seed] * len(numbers)):
                out(each.line)
                answers.append(each)
        except KeyboardInterrupt:  # what there is counts
            pool.shutdown(wait=False, cancel_futures=True)

    effects = [each for each in answers if not each.is_none]
    named = [each for each in effects if each.first]
    out()
    for name in (*INTEGRATORS, "all"):
        here = [each for each in effects if name in (each.integrator, "all")]
        exact = sum(each.exact for each in here)
        first_right = sum(each.first for each in here)
        out(f"{name:12s} exact {exact}, first {first_right} of {len(here)}")
    alarms = [each for each in answers if each.is_none and not each.exact]
    out(f"first answer right: {len(named)} of {len(effects)}")
    out(f"false alarms: {len(alarms)} of {len(answers) - len(effects)}")
    if named:
        out(
            f"size of those named first: median error {100 * np.median([each.error for each in named]):.1f} %"
        )
        out(f"interval holds the truth: {sum(each.covers for each in named)} of {len(named)}")
        # The spread is the median of the sizes in that of a standard normal error.
        spread = np.nanmedian([each.standard_errors for each in named]) / NORMAL_MEDIAN_SIZE
        out(f"interval width over the spread of the errors: {1 / spread:.2f}")
    out(f"sure and wrong: {sum(each.is_sure_and_wrong for each in answers)} of {len(answers)}")
    out(f"CPU: median {np.median([each.cpu_s for each in answers]):.0f} s")


if __name__ == "__main__":
    main(run)
