"""Everything of a MuJoCo model that may be off or missing, with ranges that its records say.

A quantity is a `PlantEffect` named "PART.WHAT" whose law writes a number into the model
(`diagnosis.machine.mujoco_edits`). `stated` is what the model has; a quantity that it has none of (0) has
parameters with ranges and may be missing. Ranges are multiples of what the records show of the joint: force,
travel and speed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

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
from diagnosis.machine.plant_effect import PlantEffect, Tried
from plant.effects.search_space import Dependence, EffectParameter


class JointUnits(NamedTuple):
    """Units of a joint's force, position and inertia, as names of parameters end with them."""

    force: str
    position: str
    inertia: str


class JointNumber(NamedTuple):
    """A number that MJCF has of every joint.

    Parameters
    ----------
    name : str
        Last part of the quantity's name.
    attribute, place
        Where it stands in a joint of an MjSpec; place among several numbers, else 0.
    parameter : str
        Name of its size where it is missing, with {F}, {x}, {m} for the units of force, position, inertia.
    unit : str
        Magnitudes of the joint that its range is a multiple of (`EffectParameter.unit`).
    largest : float
        End of the range, in that unit.
    dependence : Dependence
        How the motion depends on it.
    tried : Tried
        Of a model that has none of it; one that is stated is always tried.
    """

    name: str
    attribute: str
    place: int
    parameter: str
    unit: str
    largest: float
    dependence: Dependence
    tried: Tried = "always"


class JointMotion(NamedTuple):
    """Largest force of the actuators on a joint, its travel and its largest speed in the records [N m, rad,
    rad/s of a hinge; N, m, m/s of a slide]."""

    force: float
    travel: float
    speed: float


class RecordAsFelt(NamedTuple):
    """What the stated actuators do along a measured motion.

    positions, speeds : (T, J) of the tracked joints. joint_forces : (T, DOF) of all actuators on every
    degree of freedom. actuator_forces : (T, U).
    """

    positions: Real
    speeds: Real
    joint_forces: Real
    actuator_forces: Real


_UNITS = {
    mujoco.mjtJoint.mjJNT_HINGE: JointUnits("Nm", "rad", "kg_m2"),
    mujoco.mjtJoint.mjJNT_SLIDE: JointUnits("N", "m", "kg"),
}
# Ends of ranges: friction as large as the largest force holds the joint still. Other numbers may be ten times
# what takes all of the force at the largest speed, position or inertia; a hardening spring, which is hardly
# felt but near its ends, a thousand times. Chosen: the prior is flat in the logarithm of a size, so twice the
# end lowers the log evidence for a missing effect by less than 0.08.
_JOINT_NUMBERS = (
    JointNumber("frictionloss", "frictionloss", 0, "level_{F}", "force", 1.0, "continuous"),
    JointNumber("damping", "damping", 0, "coefficient_{F}s_{x}", "force/speed", 10.0, "smooth"),
    JointNumber("drag", "damping", 1, "coefficient_{F}s2_{x}2", "force/speed^2", 10.0, "smooth", "by name"),
    JointNumber("armature", "armature", 0, "inertia_{m}", "inertia", 10.0, "smooth"),
    JointNumber("stiffness", "stiffness", 0, "stiffness_{F}_{x}", "force/position", 10.0, "smooth"),
    JointNumber(
        "hardening_spring", "stiffness", 2, "cubic_{F}_{x}3", "force/position^3", 1e3, "smooth", "by name"
    ),
)
# Samples of a parabola through measured positions whose slope is their speed: noise of the speed falls with
# the power 1.5 of them, motions within fewer samples are lost. Chosen; it gives ranges only.
_SMOOTHED_SAMPLES = 9
# A link whose centre of mass is nearer to its joint has no far end. Numbers of a file have no more digits.
_NO_LEVER_M = 1e-6
# Size of gravity on earth, m/s^2, MuJoCo's own default: largest component that a tilted base can have.
_STANDARD_GRAVITY = 9.81
# From this share of a limit on the stated model reaches it. A limited force is the limit itself, so that any
# share below one but for rounding would do; chosen.
_REACHED = 0.999
# Longest lag or delay of an actuator, as a share of the longest record. Chosen: of a longer one the record
# shows less than five time constants.
_LONGEST_LAG = 0.2
# Least lag or delay, in samples, if the model's steps can integrate it: a fiftieth shows in no record.
_LEAST_LAG_SAMPLES = 0.02
# First and last start of a search for a lag or delay of an actuator, in samples. Chosen: a controller's
# usual delays are one to three samples.
_LAG_STARTS_SAMPLES = (0.2, 20.0)
# Range of a sensor's delay, in samples, and the first and last start of a search for it.
_SENSOR_DELAY_SAMPLES = (0.02, 100.0)
_SENSOR_DELAY_STARTS_SAMPLES = (0.2, 10.0)
# Usual range of a size in multiples of its magnitude: below a ten thousandth it is next to nothing.
_SPAN = (1e-4, 1.0)
# First and last start of a search for a size, in multiples of its magnitude: most missing effects are small.
_STARTS = (3e-3, 0.6)
# Starts between these: a search finds its way over a factor of three.
_START_COUNT = 6
# The last start is no larger than this share of the range: beyond it a descent meets the end first.
_LAST_START = 0.6
# Friction at high speed as a share of that at rest: at one there is no Stribeck effect.
_COULOMB_SHARE = EffectParameter("coulomb_share", 0.0, 0.98, (0.5,), "linear")
# Damping ratio of the spring of a drive: none to critical. It starts at that of a shaft and that of a belt;
# both chosen.
_DAMPING_RATIO = EffectParameter("damping_ratio", 1e-3, 1.0, (0.03, 0.3))


def _size(
    name: str,
    unit: float | str = 1.0,
    span: tuple[float, float] = _SPAN,
    starts: tuple[float, float] = _STARTS,
) -> EffectParameter:
    """The size of an effect: its range and the starts of a search.

    Parameters
    ----------
    name : str
        With its unit.
    unit : float or str
        What span and starts are multiples of: a number above zero, or the name of a magnitude that
        `EffectParameter.at` turns into one.
    span, starts : (low, high)
        Range, and first and last start within it.
    """
    spread = (max(starts[0], span[0]), min(starts[1], _LAST_START * span[1]), _START_COUNT)
    if isinstance(unit, str):
        return EffectParameter(name, *span, unit=unit, spread=spread)
    return EffectParameter(name, *span, spread=spread).times(unit)


def _quantity(
    name: str, stated: float, put: Callable[..., None], *parameters: EffectParameter, **more: Any
) -> PlantEffect:
    """A number of a model as an effect.

    Parameters
    ----------
    name : str
        "PART.WHAT".
    stated : float
        What the model has; 0: nothing. Of a factor 1.
    put : callable
        (spec, values in the order of the parameters) -> None; writes them into the spec.
    parameters : EffectParameter
        Of the effect where the model has none of it; without any it can only be wrong.
    more
        Other fields of `PlantEffect`.
    """
    return PlantEffect(name, parameters, law=EffectLaw("model", put), stated=stated, **more)


@dataclass(frozen=True, eq=False)
class Quantities:
    """The quantities of a model that moves as in experiments, whose outputs are the model's."""

    model: MujocoModel
    experiments: Sequence[PlantExperiment]

    def by_name(self) -> dict[str, PlantEffect]:
        """Everything that may be off or missing, by name: of joints, actuators, links, gravity, sensors."""
        spec = self.model.spec
        quantities: list[PlantEffect] = []
        for joint in spec.joints:
            quantities += self._of_joint(joint)
        for actuator in spec.actuators:
            quantities += self._of_actuator(actuator)
        for body in spec.bodies:
            quantities += self._of_link(body)
        quantities += self._of_gravity()
        for column, output in enumerate(self.model.outputs):
            swing = max(float(np.ptp(e.output[:, column])) for e in self.experiments)
            quantities += self._of_sensor(output, swing)
        return {quantity.name: quantity for quantity in quantities}

    def _of_joint(self, joint: Any) -> Iterator[PlantEffect]:
        """Quantities of a hinge or slide; of another joint (mujoco.MjsJoint) none."""
        if joint.type not in _UNITS:
            return
        units = _UNITS[joint.type]
        name = joint.name
        step_s = self.model.nominal.opt.timestep
        force, travel, speed = self.motions[name]
        degree_of_freedom = self.model.nominal.joint(name).dofadr[0]
        inertia = float(self.model.nominal.dof_M0[degree_of_freedom])
        magnitudes = Magnitudes(force=force, position=travel, speed=speed, inertia=inertia)

        for number in _JOINT_NUMBERS:
            stated = float(np.ravel(getattr(joint, number.attribute))[number.place])
            parameter = number.parameter.format(F=units.force, x=units.position, m=units.inertia)
            yield _quantity(
                f"{name}.{number.name}",
                stated,
                partial(put_at_joint, name, number.attribute, number.place),
                _size(parameter, number.unit, (_SPAN[0], number.largest)).at(magnitudes),
                dependence=number.dependence,
                group="joint",
                tried=number.tried if stated == 0 else "always",
            )

        if self.model.spec.numeric(f"{name}.{STRIBECK}") is None:
            velocity = EffectParameter(
                f"velocity_{units.position}_s", 0.01 * speed, speed, (0.02 * speed, 0.2 * speed)
            )
            yield _quantity(
                f"{name}.{STRIBECK}",
                0.0,
                partial(put_stribeck, name),
                _size(f"level_{units.force}", force),
                _COULOMB_SHARE,
                velocity,
                dependence="continuous",
                group="joint",
                contains=None if joint.frictionloss else f"{name}.frictionloss",
                tried="by name",
            )
        yield from forces_of_joint(self.model.spec, joint, magnitudes, units.force, units.position)

        # Behind a gap or a spring there must be a motor with an inertia of its own.
        motor = joint.armature
        load = inertia - joint.armature
        if not motor > 0:
            return
        yield _quantity(
            f"{name}.backlash",
            0.0,
            partial(put_backlash, name),
            _size(f"gap_{units.position}", travel, (1e-3, 0.5)),
            dependence="non-smooth",
            group="joint",
        )
        # From a spring that gives way by the travel to one that steps of the model can follow: its frequency
        # is at most one over a step. Half of that is a start as well.
        softest = force / travel
        stiffest = motor * load / inertia / step_s**2
        largest_ratio = stiffest / softest
        if largest_ratio > 2:
            yield _quantity(
                f"{name}.{ELASTIC}",
                0.0,
                partial(put_spring, name, load),
                _size(
                    f"stiffness_{units.force}_{units.position}",
                    softest,
                    (1.0, largest_ratio),
                    (1.0, 0.5 * largest_ratio),
                ),
                _DAMPING_RATIO,
                grows=False,
                group="joint",
                tried="by name",
            )

    def _of_actuator(self, actuator: Any) -> Iterator[PlantEffect]:
        """Quantities of an actuator (mujoco.MjsActuator): what it makes of a command, and how late."""
        yield from self._of_gain(actuator)
        yield from self._of_force_limit(actuator)
        yield from self._of_lateness(actuator)

    def _of_gain(self, actuator: Any) -> Iterator[PlantEffect]:
        """Gain, stiffness and damping of a servo, dead zone of a motor."""
        name = actuator.name
        gain_and_bias = (int(actuator.gaintype), int(actuator.biastype))
        motor = (0, 0)
        servo = (0, 1)
        if set(gain_and_bias) <= set(FORCES):
            yield _quantity(f"{name}.gain", 1.0, partial(put_gain, name))

        # A servo's force is kp (command - position) - kv speed.
        kp = float(actuator.gainprm[0])
        _, minus_kp, minus_kv = actuator.biasprm[:3]
        if gain_and_bias == servo and minus_kp == -kp != 0:
            # Without damping of its own it is what the gain is.
            tried = "always" if minus_kv else "by name"
            yield _quantity(f"{name}.kp", kp, partial(put_kp, name, kp), tried=tried)
            if minus_kv:
                put = partial(put_scaled, name, "biasprm", (2,), -minus_kv)
                yield _quantity(f"{name}.kv", -float(minus_kv), put)

        if gain_and_bias == motor:
            stated = self.model.number(f"{name}.{DEAD_ZONE}", 0.0)
            column = self.model.inputs.index(name)
            largest = max(float(np.max(np.abs(e.input[:, column]))) for e in self.experiments)
            yield _quantity(
                f"{name}.{DEAD_ZONE}",
                stated,
                partial(put_number, f"{name}.{DEAD_ZONE}"),
                _size("width", largest or 1.0, (1e-3, 1.0)),
                dependence="continuous",
                group="actuator",
                tried="always" if stated else "by name",
            )

    def _of_force_limit(self, actuator: Any) -> Iterator[PlantEffect]:
        """The limit of the force: a factor where the stated model reaches it, else one that it lacks."""
        name = f"{actuator.name}.forcerange"
        stated = self.model.nominal.actuator(actuator.name)
        limits = (-np.inf, np.inf)
        if stated.forcelimited[0]:
            limits = tuple(stated.forcerange)
        least, largest = self.forces[actuator.name]
        if least <= _REACHED * limits[0] or largest >= _REACHED * limits[1]:
            yield _quantity(name, 1.0, partial(put_forcerange, actuator.name, limits))
            return
        force = max(-least, largest)
        if not force > 0:
            return
        # The kind of a joint says the unit of the force.
        parameter = "limit"
        if actuator.trntype in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            kind = self.model.spec.joint(actuator.target).type
            if kind in _UNITS:
                parameter = f"limit_{_UNITS[kind].force}"
        yield _quantity(
            name,
            0.0,
            partial(put_limit, actuator.name, limits),
            _size(parameter, force, (0.05, 1.0), (0.1, 0.98)),
            grows=False,
            dependence="continuous",
            group="actuator",
        )

    def _of_lateness(self, actuator: Any) -> Iterator[PlantEffect]:
        """Lag, where the actuator has no other dynamics, and delay."""
        name = actuator.name
        option = self.model.spec.option
        dt_s = self.model.dt_s
        longest = _LONGEST_LAG * max(len(e.input) for e in self.experiments)
        starts = (_LAG_STARTS_SAMPLES[0], min(_LAG_STARTS_SAMPLES[1], longest))
        if actuator.dyntype in LAGS:
            stated = 0.0
            if actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE:
                stated = float(actuator.dynprm[0])
            # Integrated as all else is, a filter that is faster than a step runs away.
            least = _LEAST_LAG_SAMPLES
            if option.integrator == mujoco.mjtIntegrator.mjINT_RK4 or actuator.dyntype == LAGS[1]:
                least = max(least, option.timestep / dt_s)
            size = _size("time_constant_s", dt_s, (least, longest), starts)
            yield _quantity(f"{name}.lag", stated, partial(put_lag, name), size, group="actuator")
        size = _size("delay_s", dt_s, (_LEAST_LAG_SAMPLES, longest), starts)
        put = partial(put_delay, "actuator", name, option.timestep)
        yield _quantity(f"{name}.delay", float(actuator.delay), put, size, group="actuator")

    def _of_link(self, body: Any) -> Iterator[PlantEffect]:
        """Quantities of a body (mujoco.MjsBody) that moves: payload, mass, and the parts of its inertia."""
        model = self.model.nominal
        name = body.name
        k = model.body(name).id
        # Bodies that are fixed to each other move as the first of them; the world is 0.
        link = model.body_weldid[k]
        if link == 0:
            return
        if link == k:
            place = self._load_place(k)
            if place is not None:
                # Of all that moves with it: what a robot carries is no multiple of its last link.
                mass_kg = float(model.body_subtreemass[model.body_rootid[k]])
                # From a thousandth of it, which no actuator feels, to ten times its mass.
                size = _size("mass_kg", mass_kg, (1e-3, 10.0))
                yield _quantity(f"{name}.payload", 0.0, partial(put_payload, *place), size, group="link")
        if not body.mass > 0:
            return
        yield _quantity(f"{name}.mass", float(body.mass), partial(put_mass, name), _size("mass_kg"))
        # Of a link on one hinge in the world, inertia is what armature is.
        hangs_on = model.body_weldid[model.body_parentid[link]]
        if hangs_on != 0:
            yield _quantity(f"{name}.inertia", 1.0, partial(put_inertia, name))

        of_link = partial(_quantity, group="link", tried="by name")
        radius_of_gyration = float(np.sqrt(np.max(body.inertia) / body.mass))
        radius = max(radius_of_gyration, float(np.linalg.norm(body.ipos)))
        # A centre farther off than the body reaches would be another body's.
        shift = _size("shift_m", radius or 1.0, (1e-3, 1.0))
        for i, axis in enumerate("xyz"):
            yield of_link(f"{name}.com_{axis}", 0.0, partial(put_centre, name, i), shift, signed=True)
            yield of_link(f"{name}.stretch_{axis}", 1.0, partial(put_shape, name, i, i))
            for j in range(i):
                put = partial(put_shape, name, j, i)
                yield of_link(f"{name}.shear_{'xyz'[j]}{axis}", 0.0, put, _size("slope"), signed=True)

    def _load_place(self, k: int) -> tuple[str, tuple[float, ...]] | None:
        """Where a payload of link k would be: a body, and a position (3,) [m] in its frame.

        A link is a body with all that is fixed to it. The place is its first site. Without a site, of a last
        link it is the far end: where the line from its joint through its centre of mass leaves the boxes of
        its geoms and its bodies. None: a link between others, or one that turns about its centre of mass.
        """
        model = self.model.nominal
        link = np.flatnonzero(model.body_weldid == k)
        for site in range(model.nsite):
            if model.site_bodyid[site] in link:
                return model.body(model.site_bodyid[site]).name, tuple(model.site_pos[site])
        other_links = set(model.body_weldid) - {0, k}
        if any(model.body_weldid[model.body_parentid[other]] == k for other in other_links):
            return None

        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        joint = data.xanchor[model.body_jntadr[k]]
        centre_of_mass = np.average(data.xipos[link], axis=0, weights=model.body_mass[link])
        lever = centre_of_mass - joint
        length = float(np.linalg.norm(lever))
        if length < _NO_LEVER_M:
            return None
        along = lever / length
        frames_and_centres = np.vstack([data.xpos[link], data.xipos[link]])
        far_end = float(np.max((frames_and_centres - joint) @ along))
        for geom in np.flatnonzero(np.isin(model.geom_bodyid, link)):
            rotation = data.geom_xmat[geom].reshape(3, 3)
            box_centre = model.geom_aabb[geom][:3]
            half_sides = model.geom_aabb[geom][3:]
            centre = data.geom_xpos[geom] + rotation @ box_centre - joint
            far_end = max(far_end, float(along @ centre + np.abs(along @ rotation) @ half_sides))
        to_body = data.xmat[k].reshape(3, 3).T
        return model.body(k).name, tuple(to_body @ (joint + far_end * along - data.xpos[k]))

    def _of_gravity(self) -> Iterator[PlantEffect]:
        """The direction of gravity, by its components.

        The largest one follows from the others and the size of gravity, which stays; unless a tolerance of
        its own in the file releases it, and the size with it. Without gravity all three may be missing.
        """
        gravity = np.array(self.model.spec.option.gravity)
        main = int(np.argmax(np.abs(gravity)))
        for k, axis in enumerate("xyz"):
            name = f"gravity.{axis}"
            follows = k == main and gravity[main] != 0
            if follows and not self.model.number(f"tolerance.{name}", 0.0) > 0:
                continue
            turns = k != main and gravity[main] != 0
            yield _quantity(
                name,
                float(gravity[k]),
                partial(put_gravity, k, main if turns else k),
                _size("acceleration_m_s2", _STANDARD_GRAVITY),
                signed=True,
                group="link",
            )

    def _of_sensor(self, output: str, swing: float) -> Iterator[PlantEffect]:
        """Gain, offset and delay of the sensor of an output; swing: range of its readings in the records."""
        sensor = self.model.spec.sensor(output)
        gain, offset = self.model.gain_and_offset(output)
        yield _quantity(f"{output}.sensor_gain", gain, partial(put_number, f"{output}.gain"))
        yield _quantity(
            f"{output}.sensor_offset",
            offset,
            partial(put_number, f"{output}.offset"),
            _size("offset", "output").at(Magnitudes(output=swing)),
            signed=True,
            group="sensor",
        )
        yield _quantity(
            f"{output}.sensor_delay",
            float(sensor.delay),
            partial(put_delay, "sensor", output, self.model.spec.option.timestep),
            _size("delay_s", self.model.dt_s, _SENSOR_DELAY_SAMPLES, _SENSOR_DELAY_STARTS_SAMPLES),
            group="sensor",
        )

    @cached_property
    def motions(self) -> dict[str, JointMotion]:
        """What the records show of every joint, by name.

        A joint that is not measured, or shows nothing of a kind, has the largest of all joints; where none
        does, one unit.
        """
        tracked = self.model.tracked
        names = [joint.name for joint in tracked]
        dofs = [int(self.model.nominal.joint(name).dofadr[0]) for name in names]
        largest = np.zeros((len(tracked), 3))
        for record in self._as_felt:
            force = np.max(np.abs(record.joint_forces[:, dofs]), axis=0)
            travel = np.ptp(record.positions, axis=0)
            speed = np.max(np.abs(record.speeds), axis=0)
            largest = np.maximum(largest, np.column_stack([force, travel, speed]))

        usual = np.ones(3)
        if len(tracked) > 0:
            of_all = np.max(largest, axis=0)
            usual = np.where(of_all > 0, of_all, 1.0)
        motions = {}
        for joint in self.model.spec.joints:
            shown = largest[names.index(joint.name)] if joint.name in names else np.zeros(3)
            motions[joint.name] = JointMotion(*np.where(shown > 0, shown, usual).tolist())
        return motions

    @cached_property
    def forces(self) -> dict[str, tuple[float, float]]:
        """Actuator -> least and largest force along the measured motions."""
        forces = np.concatenate([record.actuator_forces for record in self._as_felt])
        least = forces.min(axis=0)
        largest = forces.max(axis=0)
        return {name: (least[u], largest[u]) for u, name in enumerate(self.model.inputs)}

    @cached_property
    def _as_felt(self) -> list[RecordAsFelt]:
        """Every record as the stated actuators feel it; without their delay, and without contacts."""
        spec = self.model.spec.copy()
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        for actuator in spec.actuators:
            actuator.delay = 0.0
            actuator.nsample = 0
        model = spec.compile()
        data = mujoco.MjData(model)
        joints = [model.joint(joint.name) for joint in self.model.tracked]
        position_places = [joint.qposadr[0] for joint in joints]
        dofs = [joint.dofadr[0] for joint in joints]

        records = []
        for e in self.experiments:
            positions = self.model.joint_positions(e.output)
            speeds = savgol_filter(positions, _SMOOTHED_SAMPLES, 2, deriv=1, delta=self.model.dt_s, axis=0)
            joint_forces = np.zeros((len(positions), model.nv))
            actuator_forces = np.zeros((len(positions), model.nu))
            for row, command in enumerate(e.input[:, : model.nu]):
                data.qpos[position_places] = positions[row]
                data.qvel[dofs] = speeds[row]
                data.ctrl[:] = command
                start_filters(model, data, command)
                mujoco.mj_fwdPosition(model, data)
                mujoco.mj_fwdVelocity(model, data)
                mujoco.mj_fwdActuation(model, data)
                joint_forces[row] = data.qfrc_actuator
                actuator_forces[row] = data.actuator_force
            records.append(RecordAsFelt(positions, speeds, joint_forces, actuator_forces))
        return records
