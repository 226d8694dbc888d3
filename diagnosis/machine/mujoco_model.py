"""A MuJoCo model read from a file: its actuators are inputs, sensors or joints are outputs."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import mujoco
import numpy as np

from diagnosis.machine.mujoco_edits import LAGS, put_compiled

_LONGEST_MODEL = 2**26  # bytes
_SENSORS = mujoco.mjtSensor
# Units of sensors whose object says nothing more; of those of a joint or tendon, along a line or about it.
_SENSOR_UNITS = {
    **dict.fromkeys((_SENSORS.mjSENS_ACCELEROMETER, _SENSORS.mjSENS_FRAMELINACC), "m/s²"),
    **dict.fromkeys((_SENSORS.mjSENS_GYRO, _SENSORS.mjSENS_FRAMEANGVEL), "rad/s"),
    **dict.fromkeys((_SENSORS.mjSENS_VELOCIMETER, _SENSORS.mjSENS_FRAMELINVEL), "m/s"),
    **dict.fromkeys((_SENSORS.mjSENS_FRAMEPOS, _SENSORS.mjSENS_TENDONPOS), "m"),
    **dict.fromkeys((_SENSORS.mjSENS_FORCE, _SENSORS.mjSENS_TOUCH), "N"),
    _SENSORS.mjSENS_TENDONVEL: "m/s",
    _SENSORS.mjSENS_TORQUE: "N m",
}
_JOINT_UNITS = {
    _SENSORS.mjSENS_JOINTPOS: ("rad", "m"),
    _SENSORS.mjSENS_JOINTVEL: ("rad/s", "m/s"),
    _SENSORS.mjSENS_JOINTACTFRC: ("N m", "N"),
    _SENSORS.mjSENS_JOINTLIMITFRC: ("N m", "N"),
}


def names(path: str) -> dict[str, list[str]]:
    """Kind -> names of what an MJCF file has of it: "actuator", "sensor", "joint" (but those that a sensor of
    their name reads, as in a repaired file)."""
    spec = read(path)
    every = {"actuator": spec.actuators, "sensor": spec.sensors, "joint": spec.joints}
    found = {kind: [one.name for one in every[kind] if one.name] for kind in every}
    angles = [one for one in spec.sensors if one.type == _SENSORS.mjSENS_JOINTPOS]
    read_by = {one.name for one in angles if one.name == one.objname}
    return {**found, "joint": [name for name in found["joint"] if name not in read_by]}


_FILES = re.compile(rb"""\b(file|(?:mesh|texture|asset)dir)\s*=\s*["']([^"'<]+)""")


def _refuse_pipes(model: Path) -> None:
    """Whatever a model names is a file, as far as it is there: MuJoCo would wait for a pipe without an end.

    Included models, as MuJoCo does, from the folder of the first.
    """
    todo, seen = [model], set[Path]()
    while todo:
        path = todo.pop()
        if path in seen or not path.exists():
            continue
        seen.add(path)
        if not path.is_file():
            raise ValueError(f"{path.name} is no file, but a folder, pipe or device")
        if path.suffix.lower() not in (".xml", ".mjcf", ".urdf", "") or path.stat().st_size > _LONGEST_MODEL:
            continue
        named = [(key, value.decode("utf-8", "replace")) for key, value in _FILES.findall(path.read_bytes())]
        folders = ["", *(value for key, value in named if key != b"file")]
        files = [value for key, value in named if key == b"file"]
        todo += [model.parent / folder / name for folder in folders for name in files if "\0" not in name]


def read(path: str) -> Any:
    _refuse_pipes(Path(path))
    # Else a trial that runs away is told on the terminal and in a file.
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        return mujoco.MjSpec.from_file(path)
    except ValueError as error:
        raise ValueError(f"not a model that MuJoCo reads: {' '.join(str(error).split())}") from None


@dataclass(frozen=True, eq=False)
class MujocoModel:
    """A model with its actuators as inputs and some of its sensors, or joints, as outputs.

    spec : mujoco.MjSpec. outputs : (Y,) names of sensors of one number or of joints, "joint NAME" where
    both have the name.
    dt_s : sampling period of the records; the model takes the fewest equal steps no longer than its own.
    tracking_rad_s : how fast the simulation is drawn to the measured joints; 0 is a free run.
    """

    spec: Any
    outputs: tuple[str, ...]
    dt_s: float
    tracking_rad_s: float = 0.0

    @classmethod
    def from_file(cls, path: str, **settings: Any) -> Self:
        """Raises ValueError, one line: a file that MuJoCo does not read, an output that is not there."""
        return cls(read(path), **settings)

    def __post_init__(self) -> None:
        object.__setattr__(self, "outputs", tuple(self.outputs))
        spec = self.spec
        spec.option.timestep = self.dt_s / max(int(np.ceil(self.dt_s / spec.option.timestep - 1e-6)), 1)
        every = {"body": spec.bodies, "joint": spec.joints, "actuator": spec.actuators}
        for what in every:
            for k, one in enumerate(every[what]):
                one.name = one.name or f"{what}{k}"
        if not spec.actuators:
            raise ValueError("the model has no actuator")
        for name in self.outputs:
            if spec.sensor(name) is None:
                joint = name if spec.joint(name) is not None else name.removeprefix("joint ")
                if spec.joint(joint) is None:
                    there = [one.name for one in (*spec.joints, *spec.sensors) if one.name]
                    raise ValueError(f"no joint or sensor is called {name!r}; there are {', '.join(there)}")
                spec.add_sensor(
                    name=name,
                    type=mujoco.mjtSensor.mjSENS_JOINTPOS,
                    objtype=mujoco.mjtObj.mjOBJ_JOINT,
                    objname=joint,
                )
        model = spec.compile()
        for name in self.outputs:
            refuse_free_base(spec, model, name)
            if model.sensor(name).dim[0] != 1:
                raise ValueError(f"sensor {name} has {model.sensor(name).dim[0]} numbers, expected one")
        put_compiled(spec, model)

    @property
    def inputs(self) -> tuple[str, ...]:
        """(U,) names of the actuators, in the model's order."""
        return tuple(one.name for one in self.spec.actuators)

    @cached_property
    def nominal(self) -> Any:
        """The compiled model."""
        return self.spec.compile()

    @cached_property
    def moving(self) -> Any:
        """The model (MjSpec) without meshes that touch nothing: their inertia stands in their bodies, and
        every compilation would read them again."""
        spec = self.spec.copy()
        for geom in list(spec.geoms):
            if geom.type == mujoco.mjtGeom.mjGEOM_MESH and not (geom.contype or geom.conaffinity):
                spec.delete(geom)
        used = {geom.meshname for geom in spec.geoms}
        for mesh in [mesh for mesh in spec.meshes if mesh.name not in used]:
            spec.delete(mesh)
        return spec

    @cached_property
    def tracked(self) -> tuple[tuple[int, str, float], ...]:
        """Outputs that are angles or positions of joints: column, joint, inertia [kg m2 or kg]."""
        found = []
        for k, name in enumerate(self.outputs):
            sensor = self.spec.sensor(name)
            if sensor.type == mujoco.mjtSensor.mjSENS_JOINTPOS:
                dof = self.nominal.joint(sensor.objname).dofadr[0]
                found.append((k, sensor.objname, float(self.nominal.dof_M0[dof])))
        return tuple(found)

    @property
    def measured_joints(self) -> set[str]:
        """Names of the joints whose position or speed is an output."""
        read_by = [self.spec.sensor(name) for name in self.outputs]
        return {one.objname for one in read_by if one.type in _JOINT_UNITS}

    @property
    def units(self) -> dict[str, str]:
        """Output -> unit, of sensors that say what they measure."""
        found = {}
        for name in self.outputs:
            sensor = self.spec.sensor(name)
            if sensor.type in _JOINT_UNITS:
                slides = self.spec.joint(sensor.objname).type == mujoco.mjtJoint.mjJNT_SLIDE
                found[name] = _JOINT_UNITS[sensor.type][slides]
            elif sensor.type in _SENSOR_UNITS:
                found[name] = _SENSOR_UNITS[sensor.type]
        return found

    @cached_property
    def filtered(self) -> tuple[int, ...]:
        """Actuators with a state that follows the command."""
        return tuple(u for u, one in enumerate(self.spec.actuators) if one.dyntype in LAGS[1:])

    @property
    def reaches(self) -> dict[str, tuple[float, str]]:
        """Command of a servo, or measured joint -> largest position in the range of the joint, and its unit.
        A servo turns a joint without a range no more than once round."""
        servos = {
            one.name: one.target for one in self.spec.actuators if one.biasprm[1] == -one.gainprm[0] != 0
        }
        read = {self.outputs[k]: joint for k, joint, _ in self.tracked}
        without = {joint: 2 * np.pi if joint in servos.values() else np.inf for joint in read.values()}
        units = {joint: self.units[name] for name, joint in read.items()}
        return {
            name: (float(np.max(np.abs(self.nominal.joint(joint).range))) or without[joint], units[joint])
            for name, joint in {**servos, **read}.items()
            if joint in units
        }

    def number(self, name: str, without: float) -> float:
        """A <numeric> of the file."""
        one = self.spec.numeric(name)
        return without if one is None else float(one.data[0])


def refuse_free_base(spec: Any, model: Any, output: str) -> None:
    """Raises ValueError where a joint hangs on a body that flies, of which nobody logs where it is."""
    sensor = spec.sensor(output)
    if sensor.objtype != mujoco.mjtObj.mjOBJ_JOINT:
        return
    root = model.body_rootid[model.joint(sensor.objname).bodyid[0]]
    first = model.body_jntadr[root]
    if first >= 0 and spec.joints[first].type == mujoco.mjtJoint.mjJNT_FREE:
        name = model.body(root).name
        raise ValueError(
            f"the base {name!r} moves freely, and no log says where it is: take its <freejoint/> out if it "
            "was held; else give only logs of a held machine"
        )
