"""Everything of a MuJoCo model that may be off or missing, with ranges that its records say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.mujoco_edits import (
    DEAD_ZONE,
    ELASTIC,
    FORCES,
    LAGS,
    STRIBECK,
    Put,
    Quantity,
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
from diagnosis.machine.mujoco_model import MujocoModel
from diagnosis.machine.mujoco_simulation import start_filters
from diagnosis.machine.own_plant import PlantExperiment
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


@dataclass(frozen=True, eq=False)
class Quantities:
    """Those of a model that moves as in experiments."""

    model: MujocoModel
    experiments: Sequence[PlantExperiment]

    def by_name(self) -> dict[str, Quantity]:
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

    def _of_joint(self, joint: Any, force: float, travel: float, speed: float) -> Iterator[Quantity]:
        if joint.type not in _UNITS:
            return
        F, x, m = _UNITS[joint.type]
        name, h = joint.name, self.model.nominal.opt.timestep
        inertia = float(self.model.nominal.dof_M0[self.model.nominal.joint(name).dofadr[0]])
        # Name, where it stands, parameter, unit, largest size in it, dependence.
        parts: tuple[tuple[str, str, int, str, float, float, Dependence], ...] = (
            ("frictionloss", "frictionloss", 0, f"level_{F}", force, 1.0, "continuous"),
            ("damping", "damping", 0, f"coefficient_{F}s_{x}", force / speed, 10.0, "smooth"),
            ("drag", "damping", 1, f"coefficient_{F}s2_{x}2", force / speed**2, 10.0, "smooth"),
            ("armature", "armature", 0, f"inertia_{m}", inertia, 10.0, "smooth"),
            ("stiffness", "stiffness", 0, f"stiffness_{F}_{x}", force / travel, 10.0, "smooth"),
        )
        of = partial(Quantity, group="joint")
        for what, key, k, parameter, unit, most, kind in parts:
            value = float(np.ravel(getattr(joint, key))[k])
            put: Put = partial(put_at_joint, name, key, k)
            usual = of(f"{name}.{what}", value, put, parameter, unit, (1e-4, most), dependence=kind)
            yield replace(usual, by_name=what == "drag" and value == 0)
        if self.model.spec.numeric(f"{name}.{STRIBECK}") is None:
            velocity = EffectParameter(f"velocity_{x}_s", 0.01 * speed, speed, (0.02 * speed, 0.2 * speed))
            inner = None if joint.frictionloss else f"{name}.frictionloss"
            dry = of(f"{name}.{STRIBECK}", 0.0, partial(put_stribeck, name), f"level_{F}", force)
            yield replace(dry, dependence="continuous", more=(_SHARE, velocity), contains=inner, by_name=True)
        motor, load = joint.armature, inertia - joint.armature
        if not motor > 0:
            return
        put, gap = partial(put_backlash, name), f"gap_{x}"
        yield of(f"{name}.backlash", 0.0, put, gap, travel, (1e-3, 0.5), dependence="non-smooth")
        # From a spring that gives way by the travel to one that steps of the model can follow.
        softest, stiffest = force / travel, motor * load / inertia / h**2
        if (most := stiffest / softest) > 1:
            put, parameter = partial(put_spring, name, load), f"stiffness_{F}_{x}"
            spring = of(f"{name}.{ELASTIC}", 0.0, put, parameter, softest, (1.0, most), (1.0, 0.5 * most))
            yield replace(spring, more=(_DAMPING_RATIO,), grows=False, by_name=True)

    def _of_actuator(self, one: Any, longest: float) -> Iterator[Quantity]:
        """longest : of a lag or delay, in samples."""
        lag = 0.0 if one.dyntype == mujoco.mjtDyn.mjDYN_NONE else float(one.dynprm[0])
        late = partial(
            Quantity,
            unit=self.model.dt_s,
            span=(0.02, longest),
            starts=(0.2, min(20.0, longest)),
            group="actuator",
        )
        of = partial(Quantity, dependence="continuous", group="actuator")
        if {int(one.gaintype), int(one.biastype)} <= set(FORCES):
            yield Quantity(f"{one.name}.gain", 1.0, partial(put_gain, one.name))
        kinds, (_, stiffness, damping) = (int(one.gaintype), int(one.biastype)), one.biasprm[:3]
        if kinds == (0, 1) and stiffness == -one.gainprm[0] != 0:
            put = partial(put_kp, one.name, one.gainprm[0])
            # Without damping of its own it is what the gain is.
            yield Quantity(f"{one.name}.kp", float(one.gainprm[0]), put, by_name=not damping)
            if damping:
                put = partial(put_scaled, one.name, "biasprm", (2,), -damping)
                yield Quantity(f"{one.name}.kv", -float(damping), put, by_name=True)
        if kinds == (0, 0):
            dead = self.model.number(f"{one.name}.{DEAD_ZONE}", 0.0)
            u = [actuator.name for actuator in self.model.spec.actuators].index(one.name)
            put = partial(put_number, f"{one.name}.{DEAD_ZONE}")
            unit = max(float(np.max(np.abs(e.input[:, u]))) for e in self.experiments)
            zone = of(f"{one.name}.{DEAD_ZONE}", dead, put, "width", unit or 1.0, (1e-3, 1.0))
            yield replace(zone, by_name=dead == 0)
        stated = self.model.nominal.actuator(one.name)
        limits = tuple(stated.forcerange) if stated.forcelimited[0] else (-np.inf, np.inf)
        least, largest = self.forces[one.name]
        if least <= _REACHED * limits[0] or largest >= _REACHED * limits[1]:
            yield Quantity(f"{one.name}.forcerange", 1.0, partial(put_forcerange, one.name, limits))
        elif (force := max(-least, largest)) > 0:
            put = partial(put_limit, one.name, limits)
            # The kind of a joint says the unit of the force.
            on_joint = one.trntype in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
            kind = self.model.spec.joint(one.target).type if on_joint else None
            name = f"limit_{_UNITS[kind][0]}" if kind in _UNITS else "limit"
            limit = of(f"{one.name}.forcerange", 0.0, put, name, force, (0.05, 1.0), (0.1, 0.98))
            yield replace(limit, grows=False)
        if one.dyntype in LAGS:
            yield late(f"{one.name}.lag", lag, partial(put_lag, one.name), "time_constant_s")
        put = partial(put_delay, "actuator", one.name, self.model.spec.option.timestep)
        yield late(f"{one.name}.delay", float(one.delay), put, "delay_s")

    def _of_link(self, body: Any) -> Iterator[Quantity]:
        model = self.model.nominal
        k = model.body(body.name).id
        if not model.body_weldid[k]:
            return
        if model.body_weldid[k] == k and (at := self._load_place(k)):
            put = partial(put_payload, *at)
            # Of all that moves with it: what a robot carries is no multiple of its last link.
            mass = float(model.body_subtreemass[model.body_rootid[k]])
            yield Quantity(f"{body.name}.payload", 0.0, put, "mass_kg", mass, (1e-3, 10.0), group="link")
        if not body.mass > 0:
            return
        yield Quantity(f"{body.name}.mass", float(body.mass), partial(put_mass, body.name), "mass_kg")
        # Of a link on one hinge in the world, inertia is what armature is.
        if model.body_weldid[model.body_parentid[model.body_weldid[k]]]:
            yield Quantity(f"{body.name}.inertia", 1.0, partial(put_inertia, body.name))
        part = partial(Quantity, group="link", by_name=True)
        radius = max(float(np.sqrt(np.max(body.inertia) / body.mass)), float(np.linalg.norm(body.ipos)))
        for i, axis in enumerate("xyz"):
            put = partial(put_centre, body.name, i)
            yield part(
                f"{body.name}.com_{axis}", 0.0, put, "shift_m", radius or 1.0, (1e-3, 1.0), signed=True
            )
            yield part(f"{body.name}.stretch_{axis}", 1.0, partial(put_shape, body.name, i, i))
            for j in range(i):
                put = partial(put_shape, body.name, j, i)
                yield part(f"{body.name}.shear_{'xyz'[j]}{axis}", 0.0, put, "slope", 1.0, signed=True)

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

    def _of_gravity(self) -> Iterator[Quantity]:
        """Its direction: the largest component follows from the others and the size, unless it is released by
        a tolerance of its own."""
        gravity = np.array(self.model.spec.option.gravity)
        main = int(np.argmax(np.abs(gravity)))
        for k, axis in enumerate("xyz"):
            name, turned = f"gravity.{axis}", k != main and gravity[main] != 0
            if k != main or not gravity[main] or self.model.number(f"tolerance.{name}", 0.0) > 0:
                yield Quantity(
                    name,
                    float(gravity[k]),
                    partial(put_gravity, k, main if turned else k),
                    "acceleration_m_s2",
                    _STANDARD_GRAVITY,
                    signed=True,
                    group="link",
                )

    def _of_sensor(self, name: str, swing: float) -> Iterator[Quantity]:
        sensor = self.model.spec.sensor(name)
        gain, offset = self.model.number(f"{name}.gain", 1.0), self.model.number(f"{name}.offset", 0.0)
        yield Quantity(f"{name}.sensor_gain", gain, partial(put_number, f"{name}.gain"))
        put = partial(put_number, f"{name}.offset")
        yield Quantity(f"{name}.sensor_offset", offset, put, "offset", swing, signed=True, group="sensor")
        put = partial(put_delay, "sensor", name, self.model.spec.option.timestep)
        yield Quantity(
            f"{name}.sensor_delay",
            float(sensor.delay),
            put,
            "delay_s",
            self.model.dt_s,
            (0.02, 100.0),
            (0.2, 10.0),
            group="sensor",
        )

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
