"""A MuJoCo model read from a file: its actuators are inputs, sensors or joints are outputs."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

import mujoco
import numpy as np

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.mujoco_edits import DEAD_ZONE, LAGS, STRIBECK, put_compiled

# Longest model file that is searched for the files it names; chosen, a hundred times any model of a robot.
# Longer ones are left to MuJoCo unsearched.
_LONGEST_MODEL_BYTES = 2**26
# Endings of files that may name other files: MuJoCo reads each of them as XML, those without an ending too.
_MODEL_ENDINGS = (".xml", ".mjcf", ".urdf", "")
# What an XML file says of files and of the folders they are in: attribute, value.
_FILES = re.compile(rb"""\b(file|(?:mesh|texture|asset)dir)\s*=\s*["']([^"'<]+)""")
# Sampling periods over the model's time step may miss a whole number by this much: rounding of decimals
# (0.01 / 0.002 is 5.000000000000001) must not make one step more.
_WHOLE_STEPS = 1e-6
# Largest command of a servo on a joint without a range, rad: a whole turn each way. Chosen; the joint of a
# robot that turns further has its cables wound up.
_WHOLE_TURN_RAD = 2 * np.pi

_SENSORS = mujoco.mjtSensor
# Units of sensors whose object says nothing more.
_SENSOR_UNITS = {
    _SENSORS.mjSENS_ACCELEROMETER: "m/s²",
    _SENSORS.mjSENS_FRAMELINACC: "m/s²",
    _SENSORS.mjSENS_GYRO: "rad/s",
    _SENSORS.mjSENS_FRAMEANGVEL: "rad/s",
    _SENSORS.mjSENS_VELOCIMETER: "m/s",
    _SENSORS.mjSENS_FRAMELINVEL: "m/s",
    _SENSORS.mjSENS_FRAMEPOS: "m",
    _SENSORS.mjSENS_TENDONPOS: "m",
    _SENSORS.mjSENS_TENDONVEL: "m/s",
    _SENSORS.mjSENS_FORCE: "N",
    _SENSORS.mjSENS_TOUCH: "N",
    _SENSORS.mjSENS_TORQUE: "N m",
}
# Units of sensors of a joint: where it turns (a hinge), where it slides.
_JOINT_UNITS = {
    _SENSORS.mjSENS_JOINTPOS: ("rad", "m"),
    _SENSORS.mjSENS_JOINTVEL: ("rad/s", "m/s"),
    _SENSORS.mjSENS_JOINTACTFRC: ("N m", "N"),
    _SENSORS.mjSENS_JOINTLIMITFRC: ("N m", "N"),
}


class TrackedJoint(NamedTuple):
    """A joint whose position is an output.

    column : of that output. name : of the joint. inertia : what its motor feels of the stated model in its
    zero position [kg m^2 of a hinge, kg of a slide].
    """

    column: int
    name: str
    inertia: float


def names(path: str) -> dict[str, list[str]]:
    """Names of what an MJCF file has, by kind: "actuator", "sensor", "joint".

    A joint that a sensor of its own name reads is listed as a sensor only: a repaired file has one for every
    measured joint. Raises ValueError like `read`.
    """
    spec = read(path)
    sensors_of_their_joint = set()
    for sensor in spec.sensors:
        if sensor.type == _SENSORS.mjSENS_JOINTPOS and sensor.name == sensor.objname:
            sensors_of_their_joint.add(sensor.name)
    joints = [joint.name for joint in spec.joints if joint.name]
    return {
        "actuator": [actuator.name for actuator in spec.actuators if actuator.name],
        "sensor": [sensor.name for sensor in spec.sensors if sensor.name],
        "joint": [name for name in joints if name not in sensors_of_their_joint],
    }


def _refuse_pipes(model: Path) -> None:
    """Raises ValueError where a model, or what it names, is there and is no file.

    MuJoCo would wait for a pipe without an end. Files are looked for as MuJoCo does: those of an included
    model in the folder of the first.
    """
    unread = [model]
    seen = set[Path]()
    while unread:
        path = unread.pop()
        if path in seen or not path.exists():
            continue
        seen.add(path)
        if not path.is_file():
            raise ValueError(f"{path.name} is no file, but a folder, pipe or device")
        if path.suffix.lower() not in _MODEL_ENDINGS or path.stat().st_size > _LONGEST_MODEL_BYTES:
            continue
        folders = [""]
        files = []
        for key, value in _FILES.findall(path.read_bytes()):
            text = value.decode("utf-8", "replace")
            if key != b"file":
                folders.append(text)
            elif "\0" not in text:
                files.append(text)
        unread += [model.parent / folder / name for folder in folders for name in files]


def read(path: str) -> Any:
    """The model of a file as a `mujoco.MjSpec`.

    Raises ValueError, one line, where it is no file or MuJoCo does not read it. MuJoCo's warnings are turned
    off for the whole process: it would write those of every trial that runs away to the terminal and a file.
    """
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        _refuse_pipes(Path(path))
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    try:
        return mujoco.MjSpec.from_file(path)
    except ValueError as error:
        raise ValueError(f"not a model that MuJoCo reads: {' '.join(str(error).split())}") from None


@dataclass(frozen=True, eq=False)
class MujocoModel:
    """A model with its actuators as inputs and some of its sensors, or joints, as outputs.

    Parameters
    ----------
    spec : mujoco.MjSpec
        Changed in place: names for parts that have none, a time step that divides dt_s, a sensor for every
        output that is a joint, and as numbers what the compiler derives (`put_compiled`).
    outputs : (Y,) names
        Of sensors of one number or of joints; "joint NAME" is the joint where a sensor has its name too.
    dt_s : float
        Sampling period of the records. The model takes the fewest equal steps no longer than its own.
    tracking_rad_s : float
        How fast the simulation is drawn to the measured joints, as the natural frequency of a critically
        damped spring; 0 is a free run.

    Raises
    ------
    ValueError
        One line: no actuator, an output that is not there or has several numbers, a joint on a body that
        flies, a <numeric> that is read here and cannot be so, or a model that does not compile.
    """

    spec: Any
    outputs: tuple[str, ...]
    dt_s: float
    tracking_rad_s: float = 0.0

    @classmethod
    def from_file(cls, path: str, **settings: Any) -> Self:
        """The model of an MJCF file; settings are `outputs`, `dt_s`, `tracking_rad_s`. Raises ValueError, one
        line, where MuJoCo does not read it and where the class does."""
        return cls(read(path), **settings)

    def __post_init__(self) -> None:
        object.__setattr__(self, "outputs", tuple(self.outputs))
        spec = self.spec
        steps = int(np.ceil(self.dt_s / spec.option.timestep - _WHOLE_STEPS))
        spec.option.timestep = self.dt_s / max(steps, 1)
        for kind, parts in (("body", spec.bodies), ("joint", spec.joints), ("actuator", spec.actuators)):
            taken = {part.name for part in parts}
            for k, part in enumerate(parts):
                if part.name:
                    continue
                name = f"{kind}{k}"
                while name in taken:
                    name = f"{name}_"
                taken.add(name)
                part.name = name
        if not spec.actuators:
            raise ValueError("the model has no actuator")
        self._refuse_numbers()

        for name in self.outputs:
            if spec.sensor(name) is None:
                self._add_sensor(name)
        model = spec.compile()
        for name in self.outputs:
            refuse_free_base(spec, model, name)
            size = model.sensor(name).dim[0]
            if size != 1:
                raise ValueError(f"sensor {name} has {size} numbers, expected one")
        put_compiled(spec, model)

    def _refuse_numbers(self) -> None:
        """Raises ValueError, one line, where a <numeric> that is read here cannot be what it is."""
        expected = {}
        for numeric in self.spec.numerics:
            if numeric.name.startswith("tolerance."):
                expected[numeric.name] = "zero or more"
        for output in self.outputs:
            expected[f"{output}.gain"] = "not zero"
            expected[f"{output}.offset"] = "finite"
        for actuator in self.inputs:
            expected[f"{actuator}.{DEAD_ZONE}"] = "zero or more"
        for name, what in expected.items():
            value = self.number(name, 1.0)
            too_small = (what == "zero or more" and value < 0) or (what == "not zero" and value == 0)
            if too_small or not np.isfinite(value):
                raise ValueError(f'the model\'s <numeric name="{name}"> is {value:g}; it must be {what}')
        for joint in self.spec.joints:
            numeric = self.spec.numeric(f"{joint.name}.{STRIBECK}")
            if numeric is None:
                continue
            values = np.array(numeric.data)
            if values.size != 2 or not np.all(np.isfinite(values)) or not values[1] > 0:
                listed = " ".join(f"{value:g}" for value in values)
                raise ValueError(
                    f'the model\'s <numeric name="{numeric.name}"> is {listed}; it must be a force and a '
                    "speed above zero"
                )

    def _add_sensor(self, output: str) -> None:
        """Add a sensor of the position of a joint, called as the output. Raises ValueError: no such joint."""
        joint = output
        if self.spec.joint(joint) is None:
            joint = output.removeprefix("joint ")
        if self.spec.joint(joint) is None:
            present_names = [part.name for part in (*self.spec.joints, *self.spec.sensors) if part.name]
            raise ValueError(f"no joint or sensor is called {output!r}; there are {', '.join(present_names)}")
        self.spec.add_sensor(
            name=output,
            type=_SENSORS.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )

    @property
    def inputs(self) -> tuple[str, ...]:
        """(U,) names of the actuators, in the model's order."""
        return tuple(actuator.name for actuator in self.spec.actuators)

    @cached_property
    def nominal(self) -> Any:
        """The model as stated, compiled (`mujoco.MjModel`)."""
        return self.spec.compile()

    @cached_property
    def moving(self) -> Any:
        """The model (`mujoco.MjSpec`) without meshes that touch nothing.

        Their inertia stands in their bodies already, and every compilation would read them again.
        """
        spec = self.spec.copy()
        for geom in list(spec.geoms):
            touches = geom.contype or geom.conaffinity
            if geom.type == mujoco.mjtGeom.mjGEOM_MESH and not touches:
                spec.delete(geom)
        used = {geom.meshname for geom in spec.geoms}
        for mesh in list(spec.meshes):
            if mesh.name not in used:
                spec.delete(mesh)
        return spec

    @cached_property
    def tracked(self) -> tuple[TrackedJoint, ...]:
        """(J,) joints whose position is an output, in the order of the outputs."""
        joints = []
        for column, name in enumerate(self.outputs):
            sensor = self.spec.sensor(name)
            if sensor.type == _SENSORS.mjSENS_JOINTPOS:
                degree_of_freedom = self.nominal.joint(sensor.objname).dofadr[0]
                inertia = float(self.nominal.dof_M0[degree_of_freedom])
                joints.append(TrackedJoint(column, sensor.objname, inertia))
        return tuple(joints)

    def joint_positions(self, outputs: Real) -> Real:
        """(T, J) positions [rad or m] of the tracked joints behind their readings in outputs (T, Y).

        A reading is gain value + offset, where the file has numbers of a sensor.
        """
        positions = np.zeros((len(outputs), len(self.tracked)))
        for j, joint in enumerate(self.tracked):
            gain, offset = self.gain_and_offset(self.outputs[joint.column])
            positions[:, j] = (outputs[:, joint.column] - offset) / gain
        return positions

    def gain_and_offset(self, output: str) -> tuple[float, float]:
        """Gain and offset of the sensor of an output as the file states them; 1 and 0 where it does not."""
        return self.number(f"{output}.gain", 1.0), self.number(f"{output}.offset", 0.0)

    @property
    def measured_joints(self) -> set[str]:
        """Names of the joints of which some quantity (position, speed, force) is an output."""
        sensors = [self.spec.sensor(name) for name in self.outputs]
        return {sensor.objname for sensor in sensors if sensor.type in _JOINT_UNITS}

    @property
    def units(self) -> dict[str, str]:
        """Output -> unit, of sensors that say what they measure."""
        units = {}
        for name in self.outputs:
            sensor = self.spec.sensor(name)
            if sensor.type in _JOINT_UNITS:
                of_hinge, of_slide = _JOINT_UNITS[sensor.type]
                slides = self.spec.joint(sensor.objname).type == mujoco.mjtJoint.mjJNT_SLIDE
                units[name] = of_slide if slides else of_hinge
            elif sensor.type in _SENSOR_UNITS:
                units[name] = _SENSOR_UNITS[sensor.type]
        return units

    @cached_property
    def filtered(self) -> tuple[int, ...]:
        """Places among the inputs of actuators with a state that follows the command with a lag."""
        return tuple(u for u, actuator in enumerate(self.spec.actuators) if actuator.dyntype in LAGS[1:])

    @property
    def reaches(self) -> dict[str, tuple[float, str]]:
        """Command of a servo, or output of a measured joint -> its largest size, and its unit.

        That is the end of the joint's range, of a command through the servo's gear, of an output as its
        sensor reads it. Of a joint without a range it is infinite, but for a hinge that a servo turns: that
        goes no more than once round.
        """
        # A servo's force is kp (command - gear position): its bias by the position is the gain with a minus.
        servos = {
            actuator.name: actuator
            for actuator in self.spec.actuators
            if actuator.biasprm[1] == -actuator.gainprm[0] != 0
        }
        joint_of_servo = {name: servo.target for name, servo in servos.items()}
        joint_of_output = {self.outputs[joint.column]: joint.name for joint in self.tracked}
        units = {joint: self.units[output] for output, joint in joint_of_output.items()}
        reaches = {}
        for name, joint in {**joint_of_servo, **joint_of_output}.items():
            if joint not in units:
                continue
            ends = np.array(self.nominal.joint(joint).range)
            if not np.any(ends):
                is_hinge = self.nominal.joint(joint).type == mujoco.mjtJoint.mjJNT_HINGE
                is_turned = is_hinge and joint in joint_of_servo.values()
                end = _WHOLE_TURN_RAD if is_turned else np.inf
                ends = np.array([-end, end])
            if name in joint_of_output:
                gain, offset = self.gain_and_offset(name)
                ends = gain * ends + offset
            else:
                ends = servos[name].gear[0] * ends
            reaches[name] = (float(np.max(np.abs(ends))), units[joint])
        return reaches

    def number(self, name: str, without: float) -> float:
        """First value of a <numeric> of the file; `without` where the file has none of this name."""
        numeric = self.spec.numeric(name)
        if numeric is None:
            return without
        return float(numeric.data[0])


def refuse_free_base(spec: Any, model: Any, output: str) -> None:
    """Raises ValueError where a joint hangs on a body that flies, of which nobody logs where it is.

    spec : mujoco.MjSpec; model : the same compiled; output : name of a sensor. Sensors of no joint pass.
    """
    sensor = spec.sensor(output)
    if sensor.objtype != mujoco.mjtObj.mjOBJ_JOINT:
        return
    root = model.body_rootid[model.joint(sensor.objname).bodyid[0]]
    first_joint = model.body_jntadr[root]
    if first_joint >= 0 and spec.joints[first_joint].type == mujoco.mjtJoint.mjJNT_FREE:
        name = model.body(root).name
        raise ValueError(
            f"the base {name!r} moves freely, and no log says where it is: take its <freejoint/> out if it "
            "was held; else give only logs of a held machine"
        )
