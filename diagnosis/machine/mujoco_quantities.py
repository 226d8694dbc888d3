"""Everything of a MuJoCo model that may be off or missing, with ranges that its records say."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from diagnosis.machine.around import EffectLaw
from diagnosis.machine.listed_effects import Magnitudes
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.mujoco_edits import (
    DEAD_ZONE,
    ELASTIC,
    FORCES,
    LAGS,
    STRIBECK,
    put_at_joint,
    put_backlash,
    put_centre,
    put_delay,
    put_forcerange,
    put_gain,
    put_gravity,
    put_inertia,
    put_kp,
    put_lag,
    put_limit,
    put_mass,
    put_number,
    put_payload,
    put_scaled,
    put_shape,
    put_spring,
    put_stribeck,
)
from diagnosis.machine.mujoco_forces import forces_of_joint
from diagnosis.machine.mujoco_model import MujocoModel
from diagnosis.machine.mujoco_simulation import start_filters
from diagnosis.machine.own_plant import PlantExperiment
from diagnosis.machine.plant_effect import PlantEffect
from plant.effects.search_space import Dependence, EffectParameter

_SMOOTHED = 9  # samples, of a measured angle whose speed is asked
# Numbers of a file have no more digits than this.
_NO_LEVER_M = 1e-6
_UNITS = {
    mujoco.mjtJoint.mjJNT_HINGE: ("Nm", "rad", "kg_m2"),
    mujoco.mjtJoint.mjJNT_SLIDE: ("N", "m", "kg"),
}
_STANDARD_GRAVITY = 9.81  # m/s^2, MuJoCo's own default
# From this share of a limit on the stated model reaches it.
_REACHED = 0.999
_SHARE = EffectParameter("coulomb_share", 0.0, 0.98, (0.5,), "linear")
_DAMPING_RATIO = EffectParameter("damping_ratio", 1e-3, 1.0, (0.03, 0.3))


def _size(
    name: str,
    unit: float | str = 1.0,
    span: tuple[float, float] = (1e-4, 1.0),
    starts: tuple[float, float] = (3e-3, 0.6),
) -> EffectParameter:
    """A range in multiples of a magnitude, or of one of that name, and six starts in its lower part."""
    spread = (max(starts[0], span[0]), min(starts[1], 0.6 * span[1]), 6)
    if isinstance(unit, str):
        return EffectParameter(name, *span, unit=unit, spread=spread)
    return EffectParameter(name, *span, spread=spread).times(unit)


def _number(
    name: str, stated: float, put: Callable[..., None], *sizes: EffectParameter, **more: Any
) -> PlantEffect:
    """A number of a model. put : model, values -> None. sizes : of the effect where the model has none of it;
    more : fields of `PlantEffect`."""
    return PlantEffect(name, sizes, law=EffectLaw("model", put), stated=stated, **more)


# In every joint: name, where it stands, which of several there, size and its unit (F force, x travel, m
# inertia), largest size in it, dependence.
_OF_JOINT: tuple[tuple[str, str, int, str, str, float, Dependence], ...] = (
    ("frictionloss", "frictionloss", 0, "level_{F}", "force", 1.0, "continuous"),
    ("damping", "damping", 0, "coefficient_{F}s_{x}", "force/speed", 10.0, "smooth"),
    ("drag", "damping", 1, "coefficient_{F}s2_{x}2", "force/speed^2", 10.0, "smooth"),
    ("armature", "armature", 0, "inertia_{m}", "inertia", 10.0, "smooth"),
    ("stiffness", "stiffness", 0, "stiffness_{F}_{x}", "force/position", 10.0, "smooth"),
    ("hardening_spring", "stiffness", 2, "cubic_{F}_{x}3", "force/position^3", 1e3, "smooth"),
)
# Of these a model that has none is seldom missing one.
_BY_NAME = ("drag", "hardening_spring")


@dataclass(frozen=True, eq=False)
class Quantities:
    """Those of a model that moves as in experiments."""

    model: MujocoModel
    experiments: Sequence[PlantExperiment]

    def by_name(self) -> dict[str, PlantEffect]:
        """Everything that may be off or missing, by name."""
        model, experiments, sizes = self.model, self.experiments, self.sizes
        spec, longest = model.spec, 0.2 * max(len(e.input) for e in experiments)
        swings = [max(float(np.ptp(e.output[:, k])) for e in experiments) for k in range(len(model.outputs))]
        found = [
            *(one for joint in spec.joints for one in self._of_joint(joint, *sizes[joint.name])),
            *(one for actuator in spec.actuators for one in self._of_actuator(actuator, longest)),
            *(one for body in spec.bodies for one in self._of_link(body)),
            *self._of_gravity(),
            *(one for y in zip(model.outputs, swings, strict=True) for one in self._of_sensor(*y)),
        ]
        return {one.name: one for one in found}

    def _of_joint(self, joint: Any, force: float, travel: float, speed: float) -> Iterator[PlantEffect]:
        if joint.type not in _UNITS:
            return
        F, x, m = _UNITS[joint.type]
        name, h = joint.name, self.model.nominal.opt.timestep
        inertia = float(self.model.nominal.dof_M0[self.model.nominal.joint(name).dofadr[0]])
        of = partial(_number, group="joint")
        magnitudes = Magnitudes(force=force, position=travel, speed=speed, inertia=inertia)
        for what, key, k, size, unit, most, dependence in _OF_JOINT:
            value = float(np.ravel(getattr(joint, key))[k])
            put: Callable[..., None] = partial(put_at_joint, name, key, k)
            sized = _size(size.format(F=F, x=x, m=m), unit, (1e-4, most)).at(magnitudes)
            tried = "by name" if what in _BY_NAME and value == 0 else "always"
            yield of(f"{name}.{what}", value, put, sized, dependence=dependence, tried=tried)
        if self.model.spec.numeric(f"{name}.{STRIBECK}") is None:
            level = _size(f"level_{F}", force)
            velocity = EffectParameter(f"velocity_{x}_s", 0.01 * speed, speed, (0.02 * speed, 0.2 * speed))
            yield of(
                f"{name}.{STRIBECK}",
                0.0,
                partial(put_stribeck, name),
                *(level, _SHARE, velocity),
                dependence="continuous",
                contains=None if joint.frictionloss else f"{name}.frictionloss",
                tried="by name",
            )
        yield from forces_of_joint(self.model.spec, joint, magnitudes, F, x)
        motor, load = joint.armature, inertia - joint.armature
        if not motor > 0:
            return
        gap = _size(f"gap_{x}", travel, (1e-3, 0.5))
        yield of(f"{name}.backlash", 0.0, partial(put_backlash, name), gap, dependence="non-smooth")
        # From a spring that gives way by the travel to one that steps of the model can follow; half
        # of that is a start as well.
        softest, stiffest = force / travel, motor * load / inertia / h**2
        if (most := stiffest / softest) > 2:
            put = partial(put_spring, name, load)
            stiffness = _size(f"stiffness_{F}_{x}", softest, (1.0, most), (1.0, 0.5 * most))
            yield of(f"{name}.{ELASTIC}", 0.0, put, stiffness, _DAMPING_RATIO, grows=False, tried="by name")

    def _of_actuator(self, one: Any, longest: float) -> Iterator[PlantEffect]:
        """longest : of a lag or delay, in samples."""
        lag = 0.0 if one.dyntype == mujoco.mjtDyn.mjDYN_NONE else float(one.dynprm[0])
        of = partial(_number, dependence="continuous", group="actuator")
        late = partial(_size, unit=self.model.dt_s, span=(0.02, longest), starts=(0.2, min(20.0, longest)))
        if {int(one.gaintype), int(one.biastype)} <= set(FORCES):
            yield _number(f"{one.name}.gain", 1.0, partial(put_gain, one.name))
        kinds, (_, stiffness, damping) = (int(one.gaintype), int(one.biastype)), one.biasprm[:3]
        if kinds == (0, 1) and stiffness == -one.gainprm[0] != 0:
            put = partial(put_kp, one.name, one.gainprm[0])
            # Without damping of its own it is what the gain is.
            tried = "always" if damping else "by name"
            yield _number(f"{one.name}.kp", float(one.gainprm[0]), put, tried=tried)
            if damping:
                put = partial(put_scaled, one.name, "biasprm", (2,), -damping)
                yield _number(f"{one.name}.kv", -float(damping), put)
        if kinds == (0, 0):
            dead = self.model.number(f"{one.name}.{DEAD_ZONE}", 0.0)
            u = [actuator.name for actuator in self.model.spec.actuators].index(one.name)
            put = partial(put_number, f"{one.name}.{DEAD_ZONE}")
            unit = max(float(np.max(np.abs(e.input[:, u]))) for e in self.experiments)
            width = _size("width", unit or 1.0, (1e-3, 1.0))
            yield of(f"{one.name}.{DEAD_ZONE}", dead, put, width, tried="always" if dead else "by name")
        stated = self.model.nominal.actuator(one.name)
        limits = tuple(stated.forcerange) if stated.forcelimited[0] else (-np.inf, np.inf)
        least, largest = self.forces[one.name]
        if least <= _REACHED * limits[0] or largest >= _REACHED * limits[1]:
            yield _number(f"{one.name}.forcerange", 1.0, partial(put_forcerange, one.name, limits))
        elif (force := max(-least, largest)) > 0:
            put = partial(put_limit, one.name, limits)
            # The kind of a joint says the unit of the force.
            on_joint = one.trntype in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
            kind = self.model.spec.joint(one.target).type if on_joint else None
            name = f"limit_{_UNITS[kind][0]}" if kind in _UNITS else "limit"
            limit = _size(name, force, (0.05, 1.0), (0.1, 0.98))
            yield of(f"{one.name}.forcerange", 0.0, put, limit, grows=False)
        option = self.model.spec.option
        if one.dyntype in LAGS:
            # Integrated as all else is, a filter that is faster than a step runs away.
            explicit = option.integrator == mujoco.mjtIntegrator.mjINT_RK4 or one.dyntype == LAGS[1]
            least = max(0.02, option.timestep / self.model.dt_s) if explicit else 0.02
            put, size = partial(put_lag, one.name), late("time_constant_s", span=(least, longest))
            yield _number(f"{one.name}.lag", lag, put, size, group="actuator")
        put = partial(put_delay, "actuator", one.name, option.timestep)
        yield _number(f"{one.name}.delay", float(one.delay), put, late("delay_s"), group="actuator")

    def _of_link(self, body: Any) -> Iterator[PlantEffect]:
        model = self.model.nominal
        k = model.body(body.name).id
        if not model.body_weldid[k]:
            return
        if model.body_weldid[k] == k and (at := self._load_place(k)):
            put = partial(put_payload, *at)
            # Of all that moves with it: what a robot carries is no multiple of its last link.
            mass = float(model.body_subtreemass[model.body_rootid[k]])
            size = _size("mass_kg", mass, (1e-3, 10.0))
            yield _number(f"{body.name}.payload", 0.0, put, size, group="link")
        if not body.mass > 0:
            return
        yield _number(f"{body.name}.mass", float(body.mass), partial(put_mass, body.name), _size("mass_kg"))
        # Of a link on one hinge in the world, inertia is what armature is.
        if model.body_weldid[model.body_parentid[model.body_weldid[k]]]:
            yield _number(f"{body.name}.inertia", 1.0, partial(put_inertia, body.name))
        part = partial(_number, group="link", tried="by name")
        radius = max(float(np.sqrt(np.max(body.inertia) / body.mass)), float(np.linalg.norm(body.ipos)))
        for i, axis in enumerate("xyz"):
            shift = _size("shift_m", radius or 1.0, (1e-3, 1.0))
            yield part(f"{body.name}.com_{axis}", 0.0, partial(put_centre, body.name, i), shift, signed=True)
            yield part(f"{body.name}.stretch_{axis}", 1.0, partial(put_shape, body.name, i, i))
            for j in range(i):
                put = partial(put_shape, body.name, j, i)
                yield part(f"{body.name}.shear_{'xyz'[j]}{axis}", 0.0, put, _size("slope"), signed=True)

    def _load_place(self, k: int) -> tuple[str, tuple[float, ...]] | None:
        """Body and place in it of a payload of link k with all that is fixed to it: the first site.

        Without a site, of a last link the far end: where the line from its joint through its centre of mass
        leaves its geoms' boxes and bodies. None: a link between others, or one that turns about its centre.
        """
        model, data = self.model.nominal, mujoco.MjData(self.model.nominal)
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
        return model.body(k).name, tuple(data.xmat[k].reshape(3, 3).T @ (joint + far * along - data.xpos[k]))

    def _of_gravity(self) -> Iterator[PlantEffect]:
        """Its direction: the largest component follows from the others and the size, unless it is released by
        a tolerance of its own."""
        gravity = np.array(self.model.spec.option.gravity)
        main = int(np.argmax(np.abs(gravity)))
        for k, axis in enumerate("xyz"):
            name, turned = f"gravity.{axis}", k != main and gravity[main] != 0
            if k != main or not gravity[main] or self.model.number(f"tolerance.{name}", 0.0) > 0:
                put = partial(put_gravity, k, main if turned else k)
                size = _size("acceleration_m_s2", _STANDARD_GRAVITY)
                yield _number(name, float(gravity[k]), put, size, signed=True, group="link")

    def _of_sensor(self, name: str, swing: float) -> Iterator[PlantEffect]:
        sensor = self.model.spec.sensor(name)
        gain, offset = self.model.number(f"{name}.gain", 1.0), self.model.number(f"{name}.offset", 0.0)
        of = partial(_number, group="sensor")
        yield _number(f"{name}.sensor_gain", gain, partial(put_number, f"{name}.gain"))
        put = partial(put_number, f"{name}.offset")
        size = _size("offset", "output").at(Magnitudes(output=swing))
        yield of(f"{name}.sensor_offset", offset, put, size, signed=True)
        put = partial(put_delay, "sensor", name, self.model.spec.option.timestep)
        late = _size("delay_s", self.model.dt_s, (0.02, 100.0), (0.2, 10.0))
        yield of(f"{name}.sensor_delay", float(sensor.delay), put, late)

    @cached_property
    def sizes(self) -> dict[str, tuple[float, float, float]]:
        """Largest force of its actuators, travel and speed of every joint; of one not measured, of all."""
        joints = [self.model.nominal.joint(joint) for _, joint, _ in self.model.tracked]
        dofs = [int(joint.dofadr[0]) for joint in joints]
        biggest = np.zeros((len(joints), 3))
        for q, v, at_joints, _ in self._felt:
            here = [np.max(np.abs(at_joints[:, dofs]), axis=0), np.ptp(q, axis=0), np.max(np.abs(v), axis=0)]
            biggest = np.maximum(biggest, np.transpose(here))
        seen = {joint.name: tuple(map(float, row)) for joint, row in zip(joints, biggest, strict=True)}
        usual = tuple(max((one[k] for one in seen.values()), default=0.0) or 1.0 for k in range(3))
        return {
            joint.name: tuple(s or u for s, u in zip(seen.get(joint.name, (0.0,) * 3), usual, strict=True))  # type: ignore[misc]
            for joint in self.model.spec.joints
        }

    @cached_property
    def forces(self) -> dict[str, tuple[float, float]]:
        """Least and largest force of every actuator."""
        whole = np.concatenate([forces for *_, forces in self._felt])
        names = (one.name for one in self.model.spec.actuators)
        return dict(zip(names, zip(whole.min(axis=0), whole.max(axis=0), strict=True), strict=True))

    @cached_property
    def _felt(self) -> list[tuple[Real, Real, Real, Real]]:
        """Of every record (T, J) measured positions and speeds, (T, DOF) what the stated actuators do there
        to every joint, (T, U) their forces; without delay."""
        spec = self.model.spec.copy()
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        for one in spec.actuators:
            one.delay, one.nsample = 0.0, 0
        model = spec.compile()
        data, joints = mujoco.MjData(model), [model.joint(joint) for _, joint, _ in self.model.tracked]
        at, dofs = [j.qposadr[0] for j in joints], [j.dofadr[0] for j in joints]
        found = []
        for e in self.experiments:
            q = e.output[:, [k for k, _, _ in self.model.tracked]]
            v = savgol_filter(q, _SMOOTHED, 2, deriv=1, delta=self.model.dt_s, axis=0)
            at_joints, forces = np.zeros((len(q), model.nv)), np.zeros((len(q), model.nu))
            for k, command in enumerate(e.input[:, : model.nu]):
                data.qpos[at], data.qvel[dofs], data.ctrl[:] = q[k], v[k], command
                start_filters(model, data, command)
                mujoco.mj_fwdPosition(model, data)
                mujoco.mj_fwdVelocity(model, data)
                mujoco.mj_fwdActuation(model, data)
                at_joints[k], forces[k] = data.qfrc_actuator, data.actuator_force
            found.append((q, v, at_joints, forces))
        return found
