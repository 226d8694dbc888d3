"""Candidates of MuJoCo models that are tried by name, and limits of force.

The truth is MuJoCo with another text, integrator and step, or with forces and commands changed by hand.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from diagnosis import Change, PlantExperiment, diagnose  # noqa: E402
from diagnosis.machine import mujoco_simulation  # noqa: E402
from diagnosis.machine.mujoco_plant import MujocoArm  # noqa: E402
from tests.workflow.command import ROOT  # noqa: E402
from workflow.diagnose.simulator_case import SimulatorCase, load_simulator_case  # noqa: E402
from workflow.diagnose.simulator_settings import settings_of  # noqa: E402

DT_S, FINE_S, NOISE_RAD = 0.01, 2.5e-4, 1e-4
MOTOR = '<motor name="motor" joint="hinge" {}/>'
SERVO = '<position name="motor" joint="hinge" kp="{}" kv="{}"/>'
ROD = """<mujoco><option timestep="{step}" integrator="{integrator}" gravity="0 0 {gravity}"/><worldbody>
<body name="rod"><joint name="hinge" axis="0 -1 0" damping="0.15" armature="{armature}"/>
<inertial pos="{com} 0 0" mass="1" diaginertia="0.002 0.03 0.03"/></body></worldbody>
<actuator>{drive}</actuator></mujoco>"""
# Rotor and rod, a spring between.
SPRUNG = f"""<mujoco><option timestep="{FINE_S}" integrator="RK4" gravity="0 0 0"/><worldbody>
<body><joint name="hinge" axis="0 0 1" damping="0.15"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.03 0.03 0.05"/>
<body><joint name="spring" axis="0 0 1" stiffness="60" damping="0.06"/>
<inertial pos="0.3 0 0" mass="1" diaginertia="0.002 0.03 0.03"/></body></body></worldbody>
<actuator>{MOTOR.format("")}</actuator></mujoco>"""
# It turns and nods.
HEAD = """<mujoco><option timestep="{step}" integrator="{integrator}" gravity="0 0 0"/><worldbody>
<body name="neck"><joint name="hinge" axis="0 0 1" damping="0.15" armature="0.02"/>
<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/><body name="head">
<joint name="nod" axis="0 1 0" damping="0.1" armature="0.01"/>
<inertial pos="0 0 0" mass="2" fullinertia="{inertia}"/></body></body></worldbody>
<actuator><motor name="motor" joint="hinge"/><motor name="other" joint="nod"/></actuator></mujoco>"""


def rod(**values: Any) -> str:
    usual = {"step": 0.002, "integrator": "implicitfast", "gravity": 0, "armature": 0.05, "com": 0.3}
    return ROD.format(**{**usual, "drive": MOTOR.format(""), **values})


true_rod = partial(rod, step=FINE_S, integrator="RK4")
hanging = {"gravity": -9.81, "armature": 0.01}
head = partial(HEAD.format, step=0.002, integrator="implicitfast", inertia="0.04 0.05 0.03 0 0 0")
true_head = partial(head, step=FINE_S, integrator="RK4")


@dataclass(frozen=True)
class Machine:
    """xml : of the truth. friction : of a speed; arrives : of commands what does; size : of commands."""

    xml: str
    friction: Callable[[float], float] | None = None
    arrives: Callable[[Any], Any] = lambda commands: commands
    size: float = 1.0

    def run(self, commands: Any) -> Any:
        """Angles (T, n) of the joints that have a motor."""
        model = mujoco.MjModel.from_xml_string(self.xml)
        data, angles = mujoco.MjData(model), []
        for u in self.arrives(commands):
            angles.append([data.joint(name).qpos[0] for name in ("hinge", "nod")[: model.nu]])
            data.ctrl[:] = u
            for _ in range(round(DT_S / model.opt.timestep)):
                if self.friction:
                    data.qfrc_applied[0] = -self.friction(data.qvel[0])
                mujoco.mj_step(model, data)
        return np.array(angles)

    def case(self, folder: Path, stated: str, **settings: Any) -> SimulatorCase:
        """Two logs and a case file."""
        (folder / "arm.xml").write_text(stated)
        for seed in range(2):
            rng, n = np.random.default_rng(seed), self.xml.count("<motor") + self.xml.count("<position")
            commands = self.size * rng.uniform(-1, 1, (15, n)).repeat(20, axis=0)
            angles = self.run(commands)
            angles += NOISE_RAD * rng.standard_normal(angles.shape)
            names = ["time_s", *("motor", "other")[:n], *("hinge", "nod")[:n]]
            rows = np.column_stack([DT_S * np.arange(len(angles)), commands, angles])
            np.savetxt(folder / f"{seed}.csv", rows, delimiter=",", header=",".join(names), comments="")
        whole = {"mjcf": "arm.xml", "log": ["0.csv", "1.csv"], "model_error": 0.01, **settings}
        return load_simulator_case(settings_of(whole, "arm.toml"), folder, "arm.toml")


def stribeck(v: float) -> float:
    return float((0.1 + 0.25 * np.exp(-abs(v) / 0.2)) * np.tanh(v / 2e-3))


def dead(u: Any) -> Any:
    return u - np.clip(u, -0.25, 0.25)


weak = true_rod(drive=MOTOR.format('forcerange="-.5 .5"'))
strong = rod(drive=MOTOR.format('forcerange="-20 20"'))
# Second moments (.02, .01, .03) kg m2: sheared along x by z, stretched along x.
sheared, stretched = "0.04 0.0512 0.0312 0 -0.006 0", "0.04 0.0638 0.0438 0 0 0"
wide = Machine(true_head(inertia=stretched), size=0.4)
SERVO_OF_40_4 = rod(drive=SERVO.format(40, 4))
# Truth, model, candidates by name, what is named with its size. The damping of a joint does what that of its
# servo does, so it is excluded.
CASES: dict[str, tuple[Machine, str, str, str, float]] = {
    "kp": (Machine(true_rod(drive=SERVO.format(60, 4))), SERVO_OF_40_4, "*.k?", "wrong_motor.kp", 1.5),
    "kv": (Machine(true_rod(drive=SERVO.format(40, 8))), SERVO_OF_40_4, "*.k?", "wrong_motor.kv", 2.0),
    "drag": (Machine(true_rod(), lambda v: 0.08 * v * abs(v)), rod(), "*.drag", "hinge.drag", 0.08),
    "stribeck": (Machine(true_rod(), stribeck), rod(), "*.stribeck", "hinge.stribeck", 0.35),
    "dead zone": (Machine(true_rod(), arrives=dead), rod(), "*.dead_zone", "motor.dead_zone", 0.25),
    "a limit": (Machine(weak), rod(), "motor.forcerange", "motor.forcerange", 0.5),
    "a limit below that stated": (Machine(weak), strong, "motor.forcerange", "motor.forcerange", 0.5),
    "spring": (Machine(SPRUNG), rod(), "*.elastic", "hinge.elastic", 60.0),
    "centre": (Machine(true_rod(com=0.36, **hanging)), rod(**hanging), "*.com_*", "rod.com_x", 0.06),
    "shear": (Machine(true_head(inertia=sheared), size=0.4), head(), "*.shear_*", "head.shear_xz", 0.2),
    "stretch": (wide, head(), "*.stretch_*", "wrong_head.stretch_x", 1.3),
}


# One of what the repaired file can only note, one of what it holds: of the quickest.
SLOW = ("dead zone", "a limit")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name in SLOW else pytest.mark.long) for name in CASES],
)
def test_it_is_named_with_its_size_and_the_repaired_model_moves_as_the_machine(tmp_path, name):
    machine, stated, candidates, effect, size = CASES[name]
    exclude = {"exclude": ["*.damping"]} if name == "kv" else {}
    beside = ["head.*", "nod.frictionloss"] if "head" in stated else ["hinge.*", "motor.*", "rod.mass"]
    loaded = machine.case(tmp_path, stated, candidates=[*beside, candidates], **exclude)
    found = diagnose(loaded.case)
    assert found.combination == (effect,)
    ((parameter, value), *_) = next(change for change in found.repair if change.id == effect).values.items()
    assert name != "a limit" or parameter == "limit_Nm"
    (low, high) = next(iter(found.effects[0].intervals.values()))
    assert low < size < high
    assert value == pytest.approx(size, rel=0.1)
    # MuJoCo alone, from the text alone, on commands that no log has.
    text = loaded.repaired(found, Path(tmp_path))
    model = mujoco.MjModel.from_xml_string(text)
    beyond = {"motor.dead_zone", "hinge.stribeck"} & {effect}
    notes = [line for line in text.splitlines() if '<text name="flexlink"' in line]
    assert any(effect in line for line in notes) == bool(beyond)
    commands = machine.size * np.random.default_rng(9).uniform(-1, 1, (8, model.nu)).repeat(20, axis=0)
    true, before, after = (one.run(commands) for one in (machine, Machine(stated), Machine(text)))
    if not beyond:
        assert np.std(after - true) < 0.3 * np.std(before - true)
        return
    # What it does not act on is read back.
    again = machine.case(tmp_path, text).case
    for e, last in zip(again.experiments, found.case.experiments, strict=True):
        left, first = (
            np.std(one.machine.simulator(())(log.input) - log.output)
            for one, log in ((again, e), (found.case, last))
        )
        assert left < 0.15 * first


def test_a_spring_is_wound_where_a_log_begins(monkeypatch):
    """A pendulum in motion, once its own swing is gone; what is left is that the spring unwinds there."""
    sprung = SPRUNG.replace('gravity="0 0 0"', 'gravity="0 0 -9.81"').replace("0 0 1", "0 -1 0")
    sprung = sprung.replace("0.03 0.03 0.05", "0.03 0.05 0.03")
    torque = 2 * np.sin(2 * np.pi * 1.3 * DT_S * np.arange(1000)[:, None])
    log = np.column_stack([torque, Machine(sprung).run(torque)])[800:]
    model = mujoco.MjSpec.from_string(rod(gravity=-9.81, step=0.001))
    e = PlantExperiment("log", "estimation", log, log[:, 1:])
    arm = MujocoArm(model, ("hinge",), DT_S, 20.0)
    plant = arm.plant([e], np.array([NOISE_RAD]), named=["*.elastic"])
    reduced = 0.05 * 0.12 / 0.17  # kg m2, of rotor against rod
    values = {"stiffness_Nm_rad": 60.0, "damping_ratio": 0.06 / (2 * np.sqrt(60 * reduced))}
    spring = [Change("hinge.elastic", values)]
    wound, stated = (np.std(plant.simulator(one)(log) - log[:, 1:]) for one in (spring, []))
    monkeypatch.setattr(mujoco_simulation, "_wind", lambda *_: None)
    loose = np.std(plant.simulator(spring)(log) - log[:, 1:])
    assert wound < 0.5 * min(loose, stated)


@pytest.mark.slow
def test_names_choose_what_is_tried(tmp_path):
    """Neither all nor all of a place is a name."""
    machine = Machine(true_rod())
    for candidates, tried in (
        (["*"], set()),
        (["hinge*", "rod.*", "*"], set()),
        (["*", "hinge.elastic", "*.com_?"], {"hinge.elastic", "rod.com_x", "rod.com_z"}),
        (["*.dr*"], {"hinge.drag"}),
    ):
        plant = machine.case(tmp_path, rod(gravity=-9.81), candidates=candidates).case.plant
        names = {effect.name for effect in plant.effects} | {*plant.tolerances}
        kinds = ("elastic", "com_x", "com_y", "com_z", "drag", "stribeck", "dead_zone", "kp", "kv")
        assert {name for name in names if name.endswith(kinds)} == tried
        assert ("hinge.backlash" in names) == ("*" in candidates)


@pytest.mark.parametrize("kv", [4, 0])
def test_what_a_servo_is_made_of_is_tried(tmp_path, kv):
    """Without damping of its own its stiffness is its gain."""
    stated = rod(drive=SERVO.format(40, kv))
    plant = Machine(true_rod(drive=SERVO.format(40, kv))).case(tmp_path, stated).case.plant
    of_servo = {name: share for name, share in plant.tolerances.items() if name[-2:] in ("kp", "kv")}
    assert of_servo == (dict.fromkeys(("motor.kp", "motor.kv"), 0.02) if kv else {})


@pytest.mark.parametrize(("gravity", "rate"), [(-9.81, 1.5 * np.sqrt(9.81 * 0.3 / 0.17)), (0.0, 0.5 / 0.49)])
def test_tracking_holds_a_rod_that_would_fall(gravity, rate):
    """Half as fast again as it falls; else half its speed over its travel."""
    slow = PlantExperiment("slow", "estimation", np.zeros((50, 2)), np.linspace(0, 1e-3, 50)[:, None])
    arm = MujocoArm(mujoco.MjSpec.from_string(rod(gravity=gravity)), ("hinge",), DT_S)
    assert arm.tracking([slow]) == pytest.approx(rate, rel=1e-3)


def test_any_stretch_and_shear_leaves_an_inertia_that_a_body_can_have():
    from diagnosis.machine.mujoco_edits import put_shape

    rng = np.random.default_rng(4)
    for k in range(60):
        # Every third a line without width.
        spec = mujoco.MjSpec.from_string(head(**{} if k % 3 else {"inertia": "0.05 0.05 1e-12 0 0 0"}))
        body = spec.compile().body("head")
        spec.body("head").explicitinertial = True
        spec.body("head").inertia, spec.body("head").iquat = body.inertia, body.iquat
        spec.body("head").fullinertia = np.full(6, np.nan)
        for i in range(3):
            put_shape("head", i, i, spec, rng.uniform(0.1, 10.0))
            for j in range(i):
                put_shape("head", j, i, spec, rng.uniform(-2.0, 2.0))
        largest, middle, least = np.sort(spec.compile().body("head").inertia)[::-1]
        assert least > 0
        assert largest <= (middle + least) * (1 + 1e-9)


def test_the_table_of_candidates_in_the_documentation_is_what_the_code_tries():
    text = head().replace('<motor name="other"', '<position kp="3" kv="1" name="other"')
    spec = mujoco.MjSpec.from_string(text.replace('<body name="head">', '<body name="head"><site/>'))
    arm = MujocoArm(spec, ("hinge", "nod"), DT_S)
    motion = np.random.default_rng(0).standard_normal((50, 4))
    every = arm.quantities([PlantExperiment("one", "estimation", motion, motion[:, 2:])])
    # The component that follows from the others is released by a tolerance of its own.
    tried: dict[bool, set[str]] = {False: {"gravity.z"}, True: set()}
    for name, one in every.items():
        tried[one.tried == "by name"].add(name if name.startswith("gravity") else name.rpartition(".")[2])
    rows = (ROOT / "docs" / "simulators.md").read_text().split("| of | values | values by name |")[1]
    table = [row.split("|")[2:4] for row in rows.split("\n\n")[0].splitlines()[2:]]
    stated = [{name for cells in table for name in re.findall("`([^`]+)`", cells[k])} for k in (0, 1)]
    assert stated == [tried[False], tried[True]]
