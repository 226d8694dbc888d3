"""Models with the features of public ones: they load, are simulated as MuJoCo does, and come back whole.

Classes, gears, dampratio, fullinertia, general actuators, tendons, equalities, actuators and joints of one
name, models of one step per sample; a floating base is refused in one line.
"""

import numpy as np
import pytest

from workflow.diagnose.simulator_case import load_simulator_case
from workflow.diagnose.simulator_settings import settings_of
from workflow.engine.errors import InputError

mujoco = pytest.importorskip("mujoco")

from diagnosis.machine.telling import telling  # noqa: E402

NOISE = 1e-5
# Model, measured joints, sampling period.
MODELS = {
    "cartpole": (
        """<mujoco model="cart-pole"><option timestep="0.01" integrator="RK4">
        <flag contact="disable" energy="enable"/></option><default><default class="pole">
        <joint type="hinge" axis="0 1 0" damping="2e-6"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size="0.045" mass="0.1"/></default></default><worldbody>
        <geom name="floor" pos="0 0 -.05" size="4 4 .2" type="plane"/><body name="cart" pos="0 0 1">
        <joint name="slider" type="slide" limited="true" axis="1 0 0" range="-1.8 1.8" solreflimit=".08 1"
        damping="5e-4"/>
        <geom name="cart" type="box" size="0.2 0.15 0.1" mass="1"/><body name="pole_1" childclass="pole">
        <joint name="hinge_1"/><geom name="pole_1"/></body></body></worldbody><actuator>
        <motor name="slide" joint="slider" gear="10" ctrllimited="true" ctrlrange="-1 1"/></actuator>
        </mujoco>""",
        ("slider", "hinge_1"),
        0.02,
    ),
    "inverted pendulum": (
        """<mujoco model="inverted pendulum"><compiler inertiafromgeom="true"/><default>
        <joint armature="0" damping="1" limited="true"/><geom contype="0" friction="1 0.1 0.1"/>
        <motor ctrlrange="-3 3"/></default><option gravity="0 0 -9.81" integrator="RK4" timestep="0.02"/>
        <size nstack="3000"/><worldbody>
        <geom name="rail" pos="0 0 0" quat="0.707 0 0.707 0" size="0.02 1" type="capsule"/>
        <body name="cart" pos="0 0 0">
        <joint axis="1 0 0" limited="true" name="slider" pos="0 0 0" range="-1 1" type="slide"/>
        <geom name="cart" pos="0 0 0" quat="0.707 0 0.707 0" size="0.1 0.1" type="capsule"/>
        <body name="pole" pos="0 0 0">
        <joint axis="0 1 0" name="hinge" pos="0 0 0" range="-90 90" type="hinge"/>
        <geom fromto="0 0 0 0.001 0 0.6" name="cpole" size="0.049 0.3" type="capsule"/></body></body>
        </worldbody><actuator>
        <motor ctrllimited="true" ctrlrange="-3 3" gear="100" joint="slider" name="slide"/></actuator>
        </mujoco>""",
        ("slider", "hinge"),
        0.02,
    ),
    "panda": (
        """<mujoco model="panda"><compiler angle="radian" autolimits="true"/>
        <option integrator="implicitfast"/><default><default class="panda">
        <joint armature="0.1" damping="1" axis="0 0 1" range="-2.8973 2.8973"/>
        <general dyntype="none" biastype="affine" ctrlrange="-2.8973 2.8973" forcerange="-87 87"/>
        </default></default><worldbody><body name="link0" childclass="panda">
        <inertial mass="0.63" pos="-0.04 0 0.05" fullinertia="0.0031 0.0039 0.0041 8e-07 0.0005 7e-08"/>
        <body name="link1" pos="0 0 0.333">
        <inertial mass="4.97" pos="0.0038 0.0021 -0.047" fullinertia="0.7034 0.7066 0.0092 -0.0001 0.0068
        0.0192"/>
        <joint name="joint1"/><body name="link2" quat="1 -1 0 0">
        <inertial mass="0.65" pos="-0.0031 -0.0287 0.0035" fullinertia="0.018 0.0281 0.026 -0.0039 0.0103
        0.0007"/>
        <joint name="joint2" range="-1.7628 1.7628"/></body></body></body></worldbody><actuator>
        <general class="panda" name="actuator1" joint="joint1" gainprm="450" biasprm="0 -450 -45"/>
        <general class="panda" name="actuator2" joint="joint2" gainprm="450" biasprm="0 -450 -45"
        ctrlrange="-1.76 1.76"/>
        </actuator></mujoco>""",
        ("joint1", "joint2"),
        0.01,
    ),
    "so arm": (
        """<mujoco model="so"><compiler angle="radian" autolimits="true"/>
        <option integrator="implicitfast" cone="elliptic"/><default><default class="so">
        <joint frictionloss="0.1" armature="0.1"/><position kp="50" dampratio="1" forcerange="-3.5 3.5"/>
        </default></default><worldbody><body name="base"><geom size=".03" mass=".2"/>
        <body name="upper" pos="0 0 .05"><joint class="so" name="pitch" axis="1 0 0" range="-3.3 .2"/>
        <geom type="capsule" fromto="0 0 0 0 .11 0" size=".02" mass=".16"/>
        <body name="lower" pos="0 .11 0"><joint class="so" name="flex" axis="1 0 0" range="0 3.14"/>
        <geom type="capsule" fromto="0 0 0 0 .13 0" size=".02" mass=".15"/></body></body></body>
        </worldbody><actuator><position class="so" name="pitch" joint="pitch" inheritrange="1"/>
        <position class="so" name="flex" joint="flex" inheritrange="1"/></actuator></mujoco>""",
        ("pitch", "flex"),
        0.01,
    ),
    "gripper": (
        """<mujoco model="grip"><compiler angle="radian" autolimits="true"/><worldbody><body name="hand">
        <geom size=".03" mass=".5" pos="0 0 -.1"/><body name="left" pos="0 .01 0">
        <joint name="left" type="slide" axis="0 1 0" range="0 .04" damping="5"/>
        <geom size=".01" mass=".05" contype="0" conaffinity="0"/></body><body name="right" pos="0 -.01 0">
        <joint name="right" type="slide" axis="0 -1 0" range="0 .04" damping="5"/>
        <geom size=".01" mass=".05" contype="0" conaffinity="0"/></body></body></worldbody><tendon>
        <fixed name="split"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed>
        </tendon><equality><joint joint1="left" joint2="right" solimp="0.95 0.99 0.001" solref="0.005 1"/>
        </equality><actuator>
        <general name="fingers" tendon="split" forcerange="-100 100" ctrlrange="0 255" gainprm="0.0157 0 0"
        biasprm="0 -100 -10" biastype="affine"/>
        </actuator></mujoco>""",
        ("left", "right"),
        0.01,
    ),
    "leg": (
        """<mujoco model="leg"><compiler angle="radian"/><option timestep="0.002"/><worldbody>
        <geom type="plane" size="5 5 1"/><body name="trunk" pos="0 0 .45"><freejoint/>
        <geom type="box" size=".2 .1 .05" mass="6"/><body name="thigh" pos=".2 0 0">
        <joint name="hip" axis="0 1 0" damping="1" armature=".01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass="1"/><body name="calf" pos="0 0 -.2">
        <joint name="knee" axis="0 1 0" damping="1" armature=".01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".015" mass=".2"/></body></body></body>
        </worldbody><actuator><motor name="hip_t" joint="hip"/><motor name="knee_t" joint="knee"/>
        </actuator></mujoco>""",
        ("hip", "knee"),
        0.01,
    ),
}


def record(folder, model, joints, dt_s: float):
    """Two logs under sines in the middle of the commands' ranges; what the columns are called."""
    low, high = -np.ones(model.nu), np.ones(model.nu)
    if model.actuator_ctrllimited.any():
        low, high = model.actuator_ctrlrange.T
    motors = [model.actuator(k).name for k in range(model.nu)]
    for seed in range(2):
        data, rows = mujoco.MjData(model), []
        noise = NOISE * np.random.default_rng(seed).standard_normal(200)
        rate = 2 * np.pi * (1 + seed) / 100 * np.arange(1, model.nu + 1)
        for k in range(200):
            command = (low + high) / 2 + (high - low) / 20 * np.sin(rate * k) * min(k / 50, 1.0)
            angles = [data.joint(joint).qpos[0] + noise[k] for joint in joints]
            rows.append([k * dt_s, *command, *angles])
            data.ctrl[:] = command
            mujoco.mj_step(model, data, round(dt_s / model.opt.timestep))
        header = ",".join(["time_s", *(f"u_{name}" for name in motors), *(f"q_{name}" for name in joints)])
        np.savetxt(folder / f"{seed}.csv", rows, delimiter=",", header=header, comments="")
    both = set(motors) & set(joints)
    columns = {f"actuator {name}" if name in both else name: f"u_{name}" for name in motors}
    return columns | {f"joint {name}" if name in both else name: f"q_{name}" for name in joints}


# The gripper has a tendon and an equality, the Panda classes, an inertia and actuators of its own.
MARKS = {"cartpole": pytest.mark.long, "inverted pendulum": pytest.mark.long, "panda": pytest.mark.slow}
MARKS["so arm"] = pytest.mark.long


@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, ())) for name in MODELS])
def test_a_model_like_a_public_one_loads_and_leaves_little_of_its_own_logs(tmp_path, name):
    text, joints, dt_s = MODELS[name]
    (tmp_path / "model.xml").write_text(text)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    columns = record(tmp_path, model, joints, dt_s)
    settings = settings_of({"mjcf": "model.xml", "log": ["0.csv", "1.csv"], "columns": columns}, "case.toml")
    if name == "leg":
        with pytest.raises(InputError, match="the base 'trunk' moves freely, and no log says where it is"):
            load_simulator_case(settings, tmp_path, "case.toml")
        return
    loaded = load_simulator_case(settings, tmp_path, "case.toml")
    case, plant = loaded.case, loaded.case.plant
    for e in case.experiments:
        left = np.std(plant.simulator(())(e.input) - e.output, axis=0)
        assert np.all(left < np.maximum(3 * NOISE, 3e-3 * np.std(e.output, axis=0)))
    found = telling(case)
    assert len(found.hidden) < len(found.least) / 2  # a stiff servo hides what it carries
    # The file that is written holds the model, a value moved.
    key = next(iter(plant.tolerances))
    repaired = plant.scaled({key: 1.1})
    again = mujoco.MjModel.from_xml_string(plant.simulation.arm.repaired(plant, repaired, ()))
    assert (again.nq, again.nu, again.ntendon, again.neq) == (model.nq, model.nu, model.ntendon, model.neq)
    assert np.isclose(np.sum(again.body_mass), np.sum(model.body_mass)) == ("mass" not in key)
