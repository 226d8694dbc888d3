"""A MuJoCo model (MJCF) as a plant: its values are nominal parameters, what it has none of may be missing.

    arm = MujocoArm.from_file("arm.xml", outputs=("shoulder", "elbow"), dt_s=0.01)
    experiments = [PlantExperiment(name, role, np.column_stack([commands, angles]), angles), ...]
    plant = arm.plant(experiments, noise)
    found = diagnose(PlantCase("arm", plant, experiments))
    text = arm.repaired(plant, found.rig, found.repair)  # MJCF

Every effect is an edit of the model, so that the repaired file holds it: friction loss, damping, armature
and stiffness of joints, gain, lag and delay of actuators, backlash, mass and inertia of links, a payload,
gravity, delay of sensors; gain and offset of a sensor, which MJCF does not know, stand in it as
<numeric name="SENSOR.gain"> and "SENSOR.offset" and are read from there. So is the tolerance of a value,
"tolerance.shoulder.damping"; others have a usual one (`TOLERANCES`).

A free run of an arm in a closed loop drifts away: its controller is not part of the model. The simulated
joints are therefore held near the measured ones by a soft spring and damper of their own (`tracking_rad_s`),
and the model is judged by what it does beside it. The start of a record is fitted, for every set of values
anew, within what its first rows leave open.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import numpy as np
from mujoco import rollout
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.own_plant import Plant, PlantExperiment
from diagnosis.machine.plant_effect import Change, EffectParameter, PlantEffect
from plant.effects.search_space import Dependence, geometric

Put = Callable[[Any, float], None]
Kept = TypeVar("Kept")

# Relative standard deviations where the file has no <numeric name="tolerance.NAME">, by a name's last part.
TOLERANCES = {
    "mass": 0.03,
    "inertia": 0.05,
    "frictionloss": 0.2,
    "damping": 0.2,
    "armature": 0.1,
    "stiffness": 0.05,
    "gain": 0.02,
    "lag": 0.2,
    "delay": 0.2,
}
_ELSE = 0.01  # gravity, sensors
_LONGEST_MODEL = 2**26  # bytes
_SMOOTHED = 9  # samples, of a measured angle whose speed is asked
# Noise deviations that the largest start of an effect has to move a record by to be looked for, and the
# share of the model error that it has to make: what makes less is never named.
_SEEN, _INTERESTS = 3.0, 0.5
# The factor by which a stated value is wrong at that; records that are simulated for it.
_WRONG, _LOOKED_AT = 3.0, 2
# Numbers of a file have no more digits than this.
_NO_LEVER_M = 1e-6
# Share by which forces change to see the motion that they make.
_FORCED = 0.05
# Of the rate at which an inverted joint falls.
_HELD = 1.5
_KEPT, _KEPT_PATHS = 8, 60
# By how much slopes of the stated model may miss what a start does in another one; starts that are simulated.
_OF_SLOPES, _RESTARTS = 0.3, 2
# Samples of a parabola whose begin is a start; it is off by more than noise from so many deviations on.
_SMOOTHED_FROM, _AS_NOISE = (4, 5, 7, 9, 12, 16, 21, 28), 2.0
_UNITS = {"hinge": ("Nm", "rad", "kg_m2"), "slide": ("N", "m", "kg")}
_STANDARD_GRAVITY = 9.81
# Its defaults are MuJoCo's own: what an edit adds takes nothing from the default class of a model.
_PLAIN = mujoco.MjSpec()
_LAGS = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
# When in a step, in steps from its begin, a force meets the position and the speed that the model then has:
# Euler holds the speed of the step before, implicit ones solve for that of the next, RK4 takes means.
_MET = {
    int(mujoco.mjtIntegrator.mjINT_EULER): (0.0, -0.5),
    int(mujoco.mjtIntegrator.mjINT_RK4): (0.5, 0.5),
    int(mujoco.mjtIntegrator.mjINT_IMPLICIT): (0.0, 0.5),
    int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST): (0.0, 0.5),
}
# Which numbers of an actuator's gain and bias are force, by type: fixed or none, affine, muscle.
_FORCES = {0: (0,), 1: (0, 1, 2), 2: (2, 3)}


def names(path: str) -> dict[str, list[str]]:
    """Kind -> names of what an MJCF file has of it: "actuator", "sensor", "joint"."""
    spec = _read(path)
    every = {"actuator": spec.actuators, "sensor": spec.sensors, "joint": spec.joints}
    return {kind: [one.name for one in every[kind] if one.name] for kind in every}


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


def _read(path: str) -> Any:
    _refuse_pipes(Path(path))
    # Else a trial that runs away is told on the terminal and in a file.
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        return mujoco.MjSpec.from_file(path)
    except ValueError as error:
        raise ValueError(f"not a model that MuJoCo reads: {' '.join(str(error).split())}") from None


@dataclass(frozen=True)
class Quantity:
    """A number of the model. put: writes it into an MjSpec. Where the model has none of it, an effect:

    parameter : with its unit; unit : its magnitude, of which low to high is its range.
    """

    name: str
    value: float
    put: Put
    parameter: str = ""
    unit: float = 1.0
    span: tuple[float, float] = (1e-4, 1.0)
    starts: tuple[float, float] = (3e-3, 0.6)
    signed: bool = False
    dependence: Dependence = "smooth"
    group: str = ""

    @property
    def effect(self) -> PlantEffect:
        low, high = (self.unit * share for share in self.span)
        first, last = (self.unit * min(share, 0.6 * self.span[1]) for share in self.starts)
        size = EffectParameter(self.parameter, low, high, tuple(geometric(first, last, 6)))
        return PlantEffect(
            self.name,
            (size,),
            self.signed,
            dependence=self.dependence,
            group=self.group,
        )


@dataclass(frozen=True, eq=False)
class MujocoArm:
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
    def from_file(cls, path: str, **settings: Any) -> MujocoArm:
        """Raises ValueError, one line: a file that MuJoCo does not read, an output that is not there."""
        return cls(_read(path), **settings)

    def __post_init__(self) -> None:
        object.__setattr__(self, "outputs", tuple(self.outputs))
        spec = self.spec
        steps = max(int(np.ceil(self.dt_s / spec.option.timestep - 1e-6)), 1)
        spec.option.timestep = self.dt_s / steps
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
            _refuse_free_base(model, name)
            if model.sensor(name).dim[0] != 1:
                raise ValueError(f"sensor {name} has {model.sensor(name).dim[0]} numbers, expected one")
        _put_compiled(spec, model)

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

    @cached_property
    def filtered(self) -> tuple[int, ...]:
        """Actuators with a state that follows the command."""
        model = self.nominal
        return tuple(u for u in range(model.nu) if model.actuator_dyntype[u] in _LAGS[1:])

    def number(self, name: str, without: float) -> float:
        """A <numeric> of the file."""
        one = self.spec.numeric(name)
        return without if one is None else float(one.data[0])

    def quantities(self, experiments: Sequence[PlantExperiment]) -> dict[str, Quantity]:
        """Everything that may be off or missing, by name."""
        sizes = self._sizes(experiments)
        longest = 0.2 * max(len(e.input) for e in experiments)
        swings = [max(float(np.ptp(e.output[:, k])) for e in experiments) for k in range(len(self.outputs))]
        found = [
            *(one for joint in self.spec.joints for one in self._of_joint(joint, *sizes[joint.name])),
            *(one for actuator in self.spec.actuators for one in self._of_actuator(actuator, longest)),
            *(one for body in self.spec.bodies for one in self._of_link(body)),
            *self._of_gravity(),
            *(one for y in zip(self.outputs, swings, strict=True) for one in self._of_sensor(*y)),
        ]
        return {one.name: one for one in found}

    def _of_joint(self, joint: Any, force: float, travel: float, speed: float) -> Iterator[Quantity]:
        kinds = {mujoco.mjtJoint.mjJNT_HINGE: "hinge", mujoco.mjtJoint.mjJNT_SLIDE: "slide"}
        if joint.type not in kinds:
            return
        F, x, m = _UNITS[kinds[joint.type]]
        inertia = float(self.nominal.dof_M0[self.nominal.joint(joint.name).dofadr[0]])
        parts: tuple[tuple[str, str, float, float, Dependence], ...] = (
            ("frictionloss", f"level_{F}", force, 1.0, "continuous"),
            ("damping", f"coefficient_{F}s_{x}", force / speed, 10.0, "smooth"),
            ("armature", f"inertia_{m}", inertia, 10.0, "smooth"),
            ("stiffness", f"stiffness_{F}_{x}", force / travel, 10.0, "smooth"),
        )
        for key, parameter, unit, most, dependence in parts:
            value = float(np.ravel(getattr(joint, key))[0])
            yield Quantity(
                f"{joint.name}.{key}",
                value,
                partial(_put_first, joint.name, key),
                parameter,
                unit,
                (1e-4, most),
                dependence=dependence,
                group="joint",
            )
        if joint.armature > 0:
            yield Quantity(
                f"{joint.name}.backlash",
                0.0,
                partial(_put_backlash, joint.name),
                f"gap_{x}",
                travel,
                (1e-3, 0.5),
                dependence="non-smooth",
                group="joint",
            )

    def _of_actuator(self, one: Any, longest: float) -> Iterator[Quantity]:
        """longest : of a lag or delay, in samples."""
        lag = 0.0 if one.dyntype == mujoco.mjtDyn.mjDYN_NONE else float(one.dynprm[0])
        late = partial(
            Quantity, unit=self.dt_s, span=(0.02, longest), starts=(0.2, min(20.0, longest)), group="actuator"
        )
        if {int(one.gaintype), int(one.biastype)} <= set(_FORCES):
            yield Quantity(f"{one.name}.gain", 1.0, partial(_put_gain, one.name))
        if one.dyntype in _LAGS:
            yield late(f"{one.name}.lag", lag, partial(_put_lag, one.name), "time_constant_s")
        put = partial(_put_delay, "actuator", one.name, self.spec.option.timestep)
        yield late(f"{one.name}.delay", float(one.delay), put, "delay_s")

    def _of_link(self, body: Any) -> Iterator[Quantity]:
        model = self.nominal
        k = model.body(body.name).id
        if not model.body_weldid[k]:
            return
        if model.body_weldid[k] == k and (at := self._load_place(k)):
            put = partial(_put_payload, *at)
            # Of all that moves with it: what a robot carries is no multiple of its last link.
            mass = float(model.body_subtreemass[model.body_rootid[k]])
            yield Quantity(f"{body.name}.payload", 0.0, put, "mass_kg", mass, (1e-3, 10.0), group="link")
        if not body.mass > 0:
            return
        yield Quantity(f"{body.name}.mass", float(body.mass), partial(_put_mass, body.name))
        # Of a link on one hinge in the world, inertia is what armature is.
        if model.body_weldid[model.body_parentid[model.body_weldid[k]]]:
            yield Quantity(f"{body.name}.inertia", 1.0, partial(_put_inertia, body.name))

    def _load_place(self, k: int) -> tuple[str, tuple[float, ...]] | None:
        """Body and place in it of a payload of link k with all that is fixed to it: the first site.

        Without a site, of a last link the far end: where the line from its joint through its centre of mass
        leaves its geoms' boxes and bodies. None: a link between others, or one that turns about its centre.
        """
        model, data = self.nominal, mujoco.MjData(self.nominal)
        link = np.flatnonzero(model.body_weldid == k)
        for site in range(model.nsite):
            if model.site_bodyid[site] in link:
                return model.body(model.site_bodyid[site]).name, tuple(model.site_pos[site])
        if any(model.body_weldid[model.body_parentid[c]] == k for c in set(model.body_weldid) - {0, k}):
            return None
        mujoco.mj_kinematics(model, data)
        joint = data.xanchor[model.body_jntadr[k]]
        lever = np.average(data.xipos[link], axis=0, weights=model.body_mass[link]) - joint
        length = float(np.linalg.norm(lever))
        if length < _NO_LEVER_M:
            return None
        along = lever / length
        far = float(np.max((np.vstack([data.xpos[link], data.xipos[link]]) - joint) @ along))
        for g in np.flatnonzero(np.isin(model.geom_bodyid, link)):
            turn, box = data.geom_xmat[g].reshape(3, 3), model.geom_aabb[g]
            centre = data.geom_xpos[g] + turn @ box[:3] - joint
            far = max(far, float(along @ centre + np.abs(along @ turn) @ box[3:]))
        at = joint + far * along - data.xpos[k]
        return model.body(k).name, tuple(data.xmat[k].reshape(3, 3).T @ at)

    def _of_gravity(self) -> Iterator[Quantity]:
        """Its direction: the largest component follows from the others and the size, unless it is released by
        a tolerance of its own."""
        gravity = np.array(self.spec.option.gravity)
        main = int(np.argmax(np.abs(gravity)))
        for k, axis in enumerate("xyz"):
            name, turned = f"gravity.{axis}", k != main and gravity[main] != 0
            if k != main or not gravity[main] or self.number(f"tolerance.{name}", 0.0) > 0:
                yield Quantity(
                    name,
                    float(gravity[k]),
                    partial(_put_gravity, k, main if turned else k),
                    "acceleration_m_s2",
                    _STANDARD_GRAVITY,
                    signed=True,
                    group="link",
                )

    def _of_sensor(self, name: str, swing: float) -> Iterator[Quantity]:
        sensor = self.spec.sensor(name)
        gain, offset = self.number(f"{name}.gain", 1.0), self.number(f"{name}.offset", 0.0)
        yield Quantity(f"{name}.sensor_gain", gain, partial(_put_number, f"{name}.gain"))
        put = partial(_put_number, f"{name}.offset")
        yield Quantity(f"{name}.sensor_offset", offset, put, "offset", swing, signed=True, group="sensor")
        put = partial(_put_delay, "sensor", name, self.spec.option.timestep)
        late = ((0.02, 100.0), (0.2, 10.0))
        yield Quantity(
            f"{name}.sensor_delay", float(sensor.delay), put, "delay_s", self.dt_s, *late, group="sensor"
        )

    def _sizes(self, experiments: Sequence[PlantExperiment]) -> dict[str, tuple[float, float, float]]:
        """Largest force of its actuators, travel and speed of every joint; of one not measured, of all."""
        columns = [k for k, _, _ in self.tracked]
        joints = [self.nominal.joint(joint) for _, joint, _ in self.tracked]
        dofs = [int(joint.dofadr[0]) for joint in joints]
        biggest = np.zeros((len(columns), 3))
        for e in experiments:
            q = e.output[:, columns]
            v = savgol_filter(q, _SMOOTHED, 2, deriv=1, delta=self.dt_s, axis=0)
            forces = self._forces(e.input[:, : len(self.inputs)], q, v)[:, dofs]
            here = [np.max(np.abs(forces), axis=0), np.ptp(q, axis=0), np.max(np.abs(v), axis=0)]
            biggest = np.maximum(biggest, np.transpose(here))
        seen = {joint.name: tuple(map(float, row)) for joint, row in zip(joints, biggest, strict=True)}
        usual = tuple(max((one[k] for one in seen.values()), default=0.0) or 1.0 for k in range(3))
        return {
            joint.name: tuple(s or u for s, u in zip(seen.get(joint.name, (0.0,) * 3), usual, strict=True))  # type: ignore[misc]
            for joint in self.spec.joints
        }

    def _forces(self, commands: Real, q: Real, v: Real) -> Real:
        """(T, DOF) what the actuators do to every joint at measured positions and speeds, without delay."""
        spec = self.spec.copy()
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        for one in spec.actuators:
            one.delay, one.nsample = 0.0, 0
        model = spec.compile()
        data, joints = mujoco.MjData(model), [model.joint(joint) for _, joint, _ in self.tracked]
        at, dofs = [j.qposadr[0] for j in joints], [j.dofadr[0] for j in joints]
        forces = np.zeros((len(q), model.nv))
        for k, command in enumerate(commands):
            data.qpos[at], data.qvel[dofs], data.ctrl[:] = q[k], v[k], command
            _start_filters(model, data, command)
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_fwdActuation(model, data)
            forces[k] = data.qfrc_actuator
        return forces

    def _commanded(
        self, simulation: Simulation, stated: Mapping[str, float], experiments: Sequence[PlantExperiment]
    ) -> float:
        """Share of the motion that the forces of the actuators make beside the tracking; 1 in a free run of
        motors.

        Of a motor it is what its commands make. A servo makes the motion of its command whatever the machine
        is: its force, without the damping of its own, makes what it strays from that. Of an actuator whose
        gain is no quantity: its command.
        """
        spec, free = simulation.edited({}), list[int]()
        for u, one in enumerate(list(spec.actuators)):
            if f"{one.name}.gain" in stated:
                own = one.biasprm[2]
                _put_gain(one.name, spec, 1 + _FORCED)
                if one.biastype == mujoco.mjtBias.mjBIAS_AFFINE:
                    _put_component(one, "biasprm", 2, own)
            else:
                free.append(u)
        forced = simulation._compiled(spec)
        made = moved = 0.0
        for e in experiments:
            more = e.input.copy()
            more[:, free] += _FORCED * (more[:, free] - np.mean(more[:, free], axis=0))
            start = simulation._start(e.input).state
            by_forces = simulation._run(forced, stated, more, start)
            by_forces -= simulation._run(simulation._model({}), stated, e.input, start)
            made += float(np.sum(np.var(by_forces / _FORCED, axis=0) / np.var(e.output, axis=0)))
            moved += len(self.outputs)
        return float(min(np.sqrt(made / moved), 1.0))

    def tracking(self, experiments: Sequence[PlantExperiment]) -> float:
        """Half the largest speed over the travel [rad/s], and enough to hold every joint against gravity."""
        model, data = self.nominal, mujoco.MjData(self.nominal)
        mujoco.mj_forward(model, data)
        fastest, sizes = 0.0, self._sizes(experiments)
        for _, name, inertia in self.tracked:
            joint = model.joint(name)
            _, travel, speed = sizes[name]
            axis, body = data.xaxis[joint.id], joint.bodyid[0]
            pull = np.linalg.norm(np.cross(axis, model.opt.gravity)) * float(model.body_subtreemass[body])
            arm = np.linalg.norm(np.cross(axis, data.subtree_com[body] - data.xanchor[joint.id]))
            falls = np.sqrt(pull * arm / inertia) if joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE else 0.0
            fastest = max(fastest, 0.5 * speed / travel, _HELD * float(falls))
        return fastest

    def repaired(self, plant: Plant, repaired: Plant, effects: Sequence[Change]) -> str:
        """MJCF of the model with the values of a repaired plant (`Diagnosis.rig`) and effects (`repair`)."""
        values = dict(repaired.parameters)
        for change in effects:
            size = next(iter(change.values.values()))
            name = change.id.removeprefix("wrong_")
            values[name] = values[name] * size if name in values else size
        assert isinstance(plant.simulation, Simulation)
        changed = {k: v for k, v in values.items() if v != plant.parameters.get(k)}
        spec = plant.simulation.edited(changed, self.spec)
        poses = [np.array(key.qpos) for key in spec.keys]
        model, before = spec.compile(), self.nominal
        # A joint within a backlash stands in the middle of a pose, and MuJoCo fills up its end.
        for key, pose in zip(spec.keys, poses, strict=True):
            if len(pose) == before.nq < model.nq:
                whole = np.array(model.qpos0)
                for joint in (before.joint(j) for j in range(before.njnt)):
                    first, size = joint.qposadr[0], joint.qpos0.size
                    at = model.joint(joint.name).qposadr[0]
                    whole[at : at + size] = pose[first : first + size]
                key.qpos = whole
        # Wherever it is written, it finds its meshes where they are.
        if spec.modelfiledir:
            spec.meshdir, spec.texturedir = (
                str(Path(spec.modelfiledir, one).resolve()) for one in (spec.meshdir, spec.texturedir)
            )
        spec.compile()
        return str(spec.to_xml())

    def plant(
        self, experiments: Sequence[PlantExperiment], noise: Real, *, model_error: float = 0.0
    ) -> Plant:
        """The arm with everything that its model has as nominal parameters and all else as effects.

        experiments : input (T, U + Y) commands, then outputs as measured; output (T, Y).
        model_error : share of the motion that commands make; beside the tracking that is less than all of it.
        """
        every = self.quantities(experiments)
        stated = {name: one.value for name, one in every.items() if one.value != 0.0}
        tolerances = {name: self.number(f"tolerance.{name}", _usual_tolerance(name)) for name in stated}
        simulation = Simulation(self, every, noise)
        share = model_error * self._commanded(simulation, stated, experiments)
        records = experiments[:_LOOKED_AT]
        as_stated = [simulation(stated, {}, e.input) for e in records]

        def seen(parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]]) -> bool:
            for e, before in zip(records, as_stated, strict=True):
                moved = simulation({**stated, **parameters}, effects, e.input) - before
                least = _INTERESTS * share * np.std(e.output, axis=0)
                large = np.sqrt(np.mean(moved**2, axis=0)) > least
                if np.any(large & (np.max(np.abs(moved), axis=0) > _SEEN * noise)):
                    return True
            return False

        missing = [one.effect for one in every.values() if one.value == 0.0]
        sizes = {effect.name: effect.parameters[0] for effect in missing}
        shown = {name for name, value in stated.items() if seen({name: _WRONG * value}, {})}
        shown |= {name for name, size in sizes.items() if seen({}, {name: {size.name: size.starts[-1]}})}
        silent = [f"wrong_{name}" for name in stated if name not in shown and tolerances[name] > 0]
        return Plant(
            simulation,
            stated,
            {name: value for name, value in tolerances.items() if value > 0 and name in shown},
            self.outputs,
            noise,
            tuple(effect for effect in missing if effect.name in shown),
            share,
            self.dt_s,
            inactive={**self._untried(every), **dict.fromkeys(silent, "records in which it shows")},
            settled=simulation.settled,
            untracked=Simulation(
                replace(self, tracking_rad_s=0.0), every, noise, False, _starts=simulation._starts
            ),
        )

    def _untried(self, every: Mapping[str, Quantity]) -> dict[str, str]:
        moving = {self.nominal.body(k).name for k in set(self.nominal.body_weldid) - {0}}
        needs = {f"{name}.payload": f"a <site> in the body {name}, where a load may be" for name in moving}
        for one in self.spec.actuators:
            needs[f"{one.name}.gain"] = "an actuator whose gain is fixed, affine or a muscle's"
            needs[f"{one.name}.lag"] = "an actuator without dynamics or with those of a filter"
        return {name: need for name, need in sorted(needs.items()) if name not in every}


@dataclass(frozen=True, eq=False)
class Simulation:
    """parameters, effects, inputs (T, U + Y) -> outputs (T, Y). settles : they are meant for `settled`."""

    arm: MujocoArm
    quantities: Mapping[str, Quantity]
    noise: Real
    settles: bool = True
    _models: dict[Any, tuple[Any, Any]] = field(default_factory=dict, repr=False)
    _paths: dict[Any, tuple[Real, Real]] = field(default_factory=dict, repr=False)
    _starts: dict[Any, _Start] = field(default_factory=dict, repr=False)

    def edited(self, values: Mapping[str, float], of: Any = None) -> Any:
        """The model (MjSpec) with these values; of: as a whole, else what moves of it."""
        spec = (of or self.arm.moving).copy()
        for name, value in values.items():
            self.quantities[name].put(spec, value)
        return spec

    def __call__(
        self, parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
    ) -> Real:
        values = {**parameters, **{name: next(iter(size.values())) for name, size in effects.items()}}
        changed = {k: v for k, v in values.items() if v != self.quantities[k].value}
        model, start = self._model(changed), self._start(inputs)
        found = self._run(model, values, inputs, start.state)
        measured = inputs[:, len(self.arm.inputs) :]
        if not (self.settles and np.all(np.isfinite(found))):
            return found
        # Commands before a record, of which a lag or delay that the model lacks still feels something.
        before = inputs[0, : len(self.arm.inputs)].copy()
        if late := self._late(model[0]):
            spread = np.array([np.std(inputs[:, u]) or 1.0 for u in late])
            moved_by = [
                before + size * (np.arange(before.size) == u) for u, size in zip(late, spread, strict=True)
            ]
            runs = [self._run(model, values, inputs, start.state, one) for one in moved_by]
            slopes = np.array([(run - found) / size for run, size in zip(runs, spread, strict=True)])
            own = start.beside(spread, slopes).shift(measured - found)[start.state.size :]
            before[late] += own
            found = found + np.tensordot(own, slopes, 1)
        # What `settled` adds is of the stated model: simulated where it may miss most of what is left.
        moved = np.zeros(start.state.size)
        for _ in range(_RESTARTS):
            shift = start.shift(measured - found)
            left = _rms(measured - found - start.adds(shift))
            missed = _OF_SLOPES * _rms(start.adds(shift - moved)) / np.hypot(left, self.noise)
            weight = float(np.clip(np.max(missed) - 1, 0.0, 1.0))
            if weight == 0:
                break
            again = self._run(model, values, inputs, start.state + shift, before) - start.adds(shift)
            found, moved = found + weight * (again - found), moved + weight * (shift - moved)
        return found

    def _model(self, changed: Mapping[str, float]) -> tuple[Any, Any]:
        return _remembered(
            self._models, tuple(changed.items()), lambda: self._compiled(self.edited(changed)), _KEPT
        )

    def _compiled(self, spec: Any) -> tuple[Any, Any]:
        omega = self.arm.tracking_rad_s
        for _, joint, inertia in self.arm.tracked if omega else ():
            one = spec.add_actuator(_PLAIN.default, name=f"tracking {joint}", target=joint)
            one.trntype, one.gear = mujoco.mjtTrn.mjTRN_JOINT, np.eye(6)[0]
            one.gaintype, one.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
            one.gainprm[0] = 1.0
            one.biasprm[1], one.biasprm[2] = -inertia * omega**2, -2 * inertia * omega
        model = spec.compile()
        return model, mujoco.MjData(model)

    def _late(self, model: Any) -> list[int]:
        """Actuators with a lag or delay that the stated model does not have."""
        stated = self.arm.nominal
        pairs = [(one.actuator_actadr >= 0, one.actuator_history[:, 0] > 0) for one in (model, stated)]
        return [
            u
            for u in range(len(self.arm.inputs))
            if any(now[u] > then[u] for now, then in zip(*pairs, strict=True))
        ]

    def _run(
        self,
        compiled: tuple[Any, Any],
        values: Mapping[str, float],
        inputs: Real,
        start: Real,
        before: Real | None = None,
    ) -> Real:
        """start: (S,), see `_Start`. before: (U,) commands before the first row; None: as in that."""
        arm, (model, data) = self.arm, compiled
        before = inputs[0, : len(arm.inputs)] if before is None else before
        U, T = len(arm.inputs), len(inputs)
        h = model.opt.timestep
        steps = round(arm.dt_s / h)
        control = np.zeros((T * steps, model.nu))
        control[:, :U] = np.repeat(inputs[:, :U], steps, axis=0)
        mujoco.mj_resetData(model, data)
        gain = np.array([values.get(f"{name}.sensor_gain", 1.0) for name in arm.outputs])
        offset = np.array([values.get(f"{name}.sensor_offset", 0.0) for name in arm.outputs])
        omega = arm.tracking_rad_s
        for j, (k, joint, inertia) in enumerate(arm.tracked):
            late = values.get(f"{arm.outputs[k]}.sensor_delay", 0.0)
            path, speed = self._path(inputs[:, U + k], h, late, model.opt.integrator)
            data.joint(joint).qpos[0] = (start[j] - offset[k]) / gain[k]
            data.joint(joint).qvel[0] = start[len(arm.tracked) + j] / gain[k]
            if omega:
                target = omega**2 * (path - offset[k]) + 2 * omega * speed
                control[:, U + j] = inertia / gain[k] * target
        _start_filters(model, data, before)
        data.act[model.actuator_actadr[list(arm.filtered)]] = start[2 * len(arm.tracked) :]
        for u in range(U):
            n = model.actuator_history[u, 0]
            if n:
                mujoco.mj_initCtrlHistory(model, data, u, None, np.full((n, 1), before[u]))
        if model.nhistory:
            mujoco.mj_forward(model, data)
            for s in range(model.nsensor):
                n = model.sensor_history[s, 0]
                if n:
                    first = data.sensordata[model.sensor_adr[s]]
                    mujoco.mj_initSensorHistory(model, data, s, None, np.full((n, 1), first), 0.0)
        state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        _, sensed = rollout.rollout(model, data, state[None], control[None])
        columns = [model.sensor(name).adr[0] for name in arm.outputs]
        return np.asarray(sensed[0, ::steps][:, columns] * gain + offset)

    def _path(self, y: Real, step_s: float, late_s: float, integrator: int) -> tuple[Real, Real]:
        """What was measured, and its slope, as the tracking meets them in every step (`_MET`), read `late_s`
        later."""

        def compute() -> tuple[Real, Real]:
            dt_s = self.arm.dt_s
            path = CubicSpline(dt_s * np.arange(len(y)), y)
            at = step_s * np.arange(len(y) * round(dt_s / step_s)) + late_s
            of_path, of_slope = (np.clip(at + part * step_s, 0.0, path.x[-1]) for part in _MET[integrator])
            return np.asarray(path(of_path)), np.asarray(path(of_slope, 1))

        return _remembered(self._paths, (y.tobytes(), late_s), compute)

    def _start(self, inputs: Real) -> _Start:
        """Of a record: from its first samples, moved once by what the stated model leaves from there."""

        def compute() -> _Start:
            arm, U = self.arm, len(self.arm.inputs)
            h = arm.nominal.opt.timestep
            late = 0.0 if _MET[arm.nominal.opt.integrator] == (0.5, 0.5) else 0.5 * h
            begun = [_begun(inputs[:, U + k], arm.dt_s, self.noise[k], late) for k, *_ in arm.tracked]
            guess, spread = np.array(begun).reshape(-1, 2, 2).transpose(2, 1, 0).reshape(2, -1)
            for u in arm.filtered:
                guess, spread = np.append(guess, inputs[0, u]), np.append(spread, np.std(inputs[:, u]) or 1.0)
            stated = {name: one.value for name, one in self.quantities.items() if one.value != 0.0}
            model = self._model({})
            first = self._run(model, stated, inputs, guess)
            moved = guess + np.diag(spread)
            runs = [self._run(model, stated, inputs, state) for state in moved]
            slopes = [(run - first) / size for run, size in zip(runs, spread, strict=True)]
            start = _Start(guess, guess, spread, np.array(slopes).reshape(-1, *first.shape), self.noise)
            return replace(start, state=guess + start.shift(inputs[:, U:] - first))

        return _remembered(self._starts, inputs.tobytes(), compute)

    def settled(self, inputs: Real, outputs: Real) -> Real:
        """Outputs (T, Y) as they are from the start that fits the record best; to first order in its move."""
        start = self._start(inputs)
        if not start.state.size:
            return outputs
        shift = start.shift(inputs[:, len(self.arm.inputs) :] - outputs)
        return np.asarray(outputs + start.adds(shift))


@dataclass(frozen=True, eq=False)
class _Start:
    """Of a record (S,): positions, then speeds, of the tracked joints as their sensors tell them; what
    filters of actuators hold.

    guess, spread : of the first samples alone. slopes : (S, T, Y) of the outputs by the state.
    """

    state: Real
    guess: Real
    spread: Real
    slopes: Real
    noise: Real

    def beside(self, spread: Real, slopes: Real) -> _Start:
        """With further states (L,) that are zero as far as anybody knows, slopes (L, T, Y)."""
        nothing = np.zeros(spread.size)
        return replace(
            self,
            state=np.append(self.state, nothing),
            guess=np.append(self.guess, nothing),
            spread=np.append(self.spread, spread),
            slopes=np.concatenate([self.slopes, slopes]),
        )

    def adds(self, shift: Real) -> Real:
        """(T, Y) of the outputs by a move of the start, in the stated model and to first order."""
        return np.asarray(np.tensordot(shift, self.slopes, 1))

    def shift(self, left: Real) -> Real:
        """(S,) by which the start moves that fits best where measured - model is left (T, Y)."""
        level = np.maximum(_rms(left), self.noise)
        A = (self.slopes / level).reshape(len(self.state), left.size)
        H = A @ A.T + np.diag(self.spread**-2.0)
        return np.asarray(
            np.linalg.solve(H, A @ (left / level).ravel() + (self.guess - self.state) / self.spread**2)
        )


def _refuse_free_base(model: Any, output: str) -> None:
    """Raises ValueError where a joint hangs on a body that flies, of which nobody logs where it is."""
    sensor = model.sensor(output)
    if sensor.objtype[0] != mujoco.mjtObj.mjOBJ_JOINT:
        return
    root = model.body_rootid[model.jnt_bodyid[sensor.objid[0]]]
    first = model.body_jntadr[root]
    if first >= 0 and model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE:
        name = model.body(root).name
        raise ValueError(
            f"the base {name!r} moves freely, and no log says where it is: take its <freejoint/> out if it "
            "was held; else give only logs of a held machine"
        )


def _rms(signals: Real) -> Real:
    """(T, Y) -> (Y,)"""
    return np.asarray(np.sqrt(np.mean(signals**2, axis=0)))


def _remembered(
    kept: dict[Any, Kept], key: Any, compute: Callable[[], Kept], most: int = _KEPT_PATHS
) -> Kept:
    if key not in kept:
        if len(kept) >= most:
            kept.pop(next(iter(kept)))
        kept[key] = compute()
    return kept[key]


def _start_filters(model: Any, data: Any, commands: Real) -> None:
    """As if the commands had been held for long; what integrates them starts at zero."""
    for u in range(len(commands)):
        if model.actuator_actadr[u] >= 0 and model.actuator_dyntype[u] != mujoco.mjtDyn.mjDYN_INTEGRATOR:
            data.act[model.actuator_actadr[u]] = commands[u]


def _begun(q: Real, dt_s: float, noise: float, early_s: float) -> list[tuple[float, float]]:
    """Position in the first row and speed a little earlier, each with what it may be off by: of the longest
    parabola that leaves no more than noise of the first samples, and what its force may change in a row."""
    for n in (n for n in _SMOOTHED_FROM if n <= len(q)):
        time_s = dt_s * np.arange(n)
        fit, covariance = np.polyfit(time_s, q[:n], 2, cov="unscaled")
        left = float(np.sqrt(np.sum((q[:n] - np.polyval(fit, time_s)) ** 2) / (n - 3)))
        if n > _SMOOTHED_FROM[0] and left > _AS_NOISE * noise:
            break
        level = max(left, noise)
        off = _AS_NOISE * level * np.sqrt(np.diag(covariance))
        found = [
            (fit[2], min(off[2], level)),
            (fit[1] - 2 * fit[0] * early_s, off[1] + abs(2 * fit[0]) * dt_s),
        ]
    return found


def _usual_tolerance(name: str) -> float:
    return TOLERANCES.get(name.rpartition(".")[2], _ELSE)


def _put_compiled(spec: Any, model: Any) -> None:
    """As numbers what the compiler makes of other numbers: an edit then changes one value and no second."""
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    spec.compiler.settotalmass = -1
    for k, body in enumerate(spec.bodies):
        if model.body_mass[k] > 0:
            body.explicitinertial = True
            body.mass, body.inertia = model.body_mass[k], model.body_inertia[k]
            body.ipos, body.iquat = model.body_ipos[k], model.body_iquat[k]
            body.fullinertia, body.ialt.type = np.full(6, np.nan), mujoco.mjtOrientation.mjORIENTATION_QUAT
    for k, joint in enumerate(spec.joints):
        if np.any(joint.springdamper):
            _put_component(joint, "stiffness", 0, model.jnt_stiffness[k])
            _put_component(joint, "damping", 0, model.dof_damping[model.jnt_dofadr[k]])
            joint.springdamper = np.zeros(2)
    for k, one in enumerate(spec.actuators):
        # Else dampratio, of which the compiler makes a damping: the spec holds it as a positive number.
        if one.biastype == mujoco.mjtBias.mjBIAS_AFFINE:
            one.biasprm = model.actuator_biasprm[k]


# Each writes a value into an MjSpec once the arguments before it are bound.


def _put_first(joint: str, key: str, spec: Any, value: float) -> None:
    """A number of a joint, or the first of several (of a polynomial of the speed)."""
    one = spec.joint(joint)
    if np.ndim(getattr(one, key)):
        _put_component(one, key, 0, value)
    else:
        setattr(one, key, value)


def _put_gravity(k: int, main: int, spec: Any, value: float) -> None:
    """A component; another one (main) keeps the size."""
    gravity = np.array(spec.option.gravity)
    rest = gravity[main] ** 2 + gravity[k] ** 2 - value**2
    gravity[main] = np.copysign(np.sqrt(max(rest, 0.0)), gravity[main])
    gravity[k] = value
    spec.option.gravity = gravity


def _put_component(one: Any, key: str, k: int, value: float) -> None:
    whole = np.array(getattr(one, key), dtype=np.float64)
    whole[k] = value
    setattr(one, key, whole)


def _put_gain(name: str, spec: Any, factor: float) -> None:
    """Force of an actuator, its feedback included."""
    one = spec.actuator(name)
    for key, kind in (("gainprm", one.gaintype), ("biasprm", one.biastype)):
        for k in _FORCES[int(kind)]:
            _put_component(one, key, k, factor * getattr(one, key)[k])


def _put_lag(name: str, spec: Any, value: float) -> None:
    one = spec.actuator(name)
    if one.dyntype == mujoco.mjtDyn.mjDYN_NONE:
        one.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        one.actearly = True
    _put_component(one, "dynprm", 0, value)


def _put_delay(kind: str, name: str, step_s: float, spec: Any, value: float) -> None:
    one = getattr(spec, kind)(name)
    one.delay, one.nsample, one.interp = value, int(np.ceil(value / step_s)) + 2, 1


def _put_mass(name: str, spec: Any, value: float) -> None:
    """At the same density and shape: inertia in proportion."""
    body = spec.body(name)
    body.inertia = np.array(body.inertia) * (value / body.mass)
    body.mass = value


def _put_inertia(name: str, spec: Any, factor: float) -> None:
    body = spec.body(name)
    body.inertia = np.array(body.inertia) * factor


def _put_payload(name: str, at: tuple[float, ...], spec: Any, mass: float) -> None:
    load = spec.body(name).add_body(name=f"{name} payload", pos=at)
    load.explicitinertial, load.mass, load.ipos = True, mass, np.zeros(3)
    load.inertia = np.full(3, 1e-9 * mass)


def _put_backlash(name: str, spec: Any, gap: float) -> None:
    """A second joint on the same axis that is free within the gap; armature stays at the first, the motor."""
    joint = spec.joint(name)
    in_degrees = spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
    gap = np.rad2deg(gap) if in_degrees else gap
    joint.parent.add_joint(
        _PLAIN.default,
        name=f"{name} backlash",
        type=joint.type,
        axis=joint.axis,
        pos=joint.pos,
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=np.array([-0.5, 0.5]) * gap,
        solref_limit=np.array([2 * spec.option.timestep, 1.0]),
    )


def _put_number(name: str, spec: Any, value: float) -> None:
    one = spec.numeric(name) or spec.add_numeric(name=name, size=1)
    one.data = np.array([value])
