"""How numbers of a MuJoCo model that may be off or missing are written into an `mujoco.MjSpec`.

A function `put_...` takes the name of a part of the model and what is known about it, then the spec and the
new value. Its first arguments are bound where a quantity is listed (`diagnosis.machine.mujoco_quantities`),
so that `put(spec, value)` remains. All of them change the spec that they are given and return nothing; a name
that the spec does not have is an AttributeError. Lengths are in m, angles in rad, masses in kg.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import count
from typing import Any

import mujoco
import numpy as np

# Its defaults are MuJoCo's own: what an edit adds takes nothing from the default class of a model.
PLAIN = mujoco.MjSpec()
# Kinds of actuator dynamics that are no lag or a first-order lag; the second is integrated by Euler's rule,
# the third exactly.
LAGS = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
# Last part of the name of a <numeric> with the excess of friction at rest, on which MuJoCo does not act.
STRIBECK = "stribeck"
# Last part of the name of a <numeric> with the width of a dead zone, on which MuJoCo does not act.
DEAD_ZONE = "dead_zone"
# Last part of the name of the joint that is added behind the spring of a drive.
ELASTIC = "elastic"
# Places in an actuator's gainprm and biasprm that are forces, by gaintype and biastype: 0 is fixed or none,
# 1 affine, 2 a muscle. The other numbers of a muscle are lengths and speeds.
FORCES = {0: (0,), 1: (0, 1, 2), 2: (2, 3)}

# Least second moment of mass along an axis, as a share of the sum over all axes. MuJoCo refuses an inertia
# that rounding makes thinner than a line; chosen far above rounding (1e-16) and far below any link.
_THINNEST = 1e-9
# Moment of inertia of a payload over its mass, m^2: a point mass, but for what MuJoCo demands of an inertia.
# That of a ball of 0.05 mm; chosen.
_POINT_MASS_M2 = 1e-9


def put_compiled(spec: Any, model: Any) -> None:
    """Write into the spec, as plain numbers, what MuJoCo's compiler derives from other numbers.

    Inertias follow from geoms, a joint's spring and damper from a time constant (springdamper), a servo's
    damping from a damping ratio. Once they stand as numbers, an edit changes one value and no second one.

    Parameters
    ----------
    spec : mujoco.MjSpec
        Changed in place.
    model : mujoco.MjModel
        What the spec compiles to.
    """
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    spec.compiler.settotalmass = -1
    for k, body in enumerate(spec.bodies):
        if model.body_mass[k] > 0:
            body.explicitinertial = True
            body.mass = model.body_mass[k]
            body.inertia = model.body_inertia[k]
            body.ipos = model.body_ipos[k]
            body.iquat = model.body_iquat[k]
            # Other ways to say the same, which would win over the numbers above.
            body.fullinertia = np.full(6, np.nan)
            body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    for k, joint in enumerate(spec.joints):
        if np.any(joint.springdamper):
            put_component(joint, "stiffness", 0, model.jnt_stiffness[k])
            put_component(joint, "damping", 0, model.dof_damping[model.jnt_dofadr[k]])
            joint.springdamper = np.zeros(2)
    for k, actuator in enumerate(spec.actuators):
        # A damping ratio stands in the spec as a positive number where the compiled damping is negative.
        if actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE:
            actuator.biasprm = model.actuator_biasprm[k]


def free_name(part: str, what: str, find: Callable[[str], Any]) -> str:
    """Name for what is added to a part: "PART WHAT"; "PART 2 WHAT" and so on where the model has that.

    A repaired file has such parts, and may be repaired again. find : name -> part of a spec of the kind that
    is added, None where there is none.
    """
    if find(f"{part} {what}") is None:
        return f"{part} {what}"
    return next(name for name in (f"{part} {k} {what}" for k in count(2)) if find(name) is None)


def put_component(part: Any, attribute: str, place: int, value: float) -> None:
    """Set one number of an attribute that holds several; a spec takes them as a whole only."""
    numbers = np.array(getattr(part, attribute), dtype=np.float64)
    numbers[place] = value
    setattr(part, attribute, numbers)


def put_at_joint(joint: str, attribute: str, place: int, spec: Any, value: float) -> None:
    """Set a number of a joint, in MuJoCo's unit of it.

    place : of the number, where the attribute holds several (coefficients of a polynomial in the speed).
    """
    part = spec.joint(joint)
    if np.ndim(getattr(part, attribute)):
        put_component(part, attribute, place, value)
    else:
        setattr(part, attribute, value)


def put_gravity(axis: int, balanced_by: int, spec: Any, value: float) -> None:
    """Set a component of gravity [m/s^2] and turn the vector so that it keeps its size.

    Parameters
    ----------
    axis : int
        Component that is set: 0, 1 or 2.
    balanced_by : int
        Component that changes in turn and keeps its sign. `axis` itself: none does, the size changes.
    value : float
        Beyond the size of gravity the other component is zero, and the size grows.
    """
    gravity = np.array(spec.option.gravity)
    squared = gravity[balanced_by] ** 2 + gravity[axis] ** 2 - value**2
    gravity[balanced_by] = np.copysign(np.sqrt(max(squared, 0.0)), gravity[balanced_by])
    gravity[axis] = value
    spec.option.gravity = gravity


def put_scaled(
    name: str, attribute: str, places: Sequence[int], stated: float, spec: Any, value: float
) -> None:
    """Multiply numbers of an actuator by value / stated: they go with a value that is stated as one."""
    actuator = spec.actuator(name)
    for place in places:
        put_component(actuator, attribute, place, value / stated * getattr(actuator, attribute)[place])


def put_gain(name: str, spec: Any, factor: float) -> None:
    """Multiply the force of an actuator, that of its feedback included.

    Of a gaintype or biastype that is not in `FORCES` it is a KeyError: nobody knows which number is a force.
    """
    actuator = spec.actuator(name)
    put_scaled(name, "gainprm", FORCES[int(actuator.gaintype)], 1.0, spec, factor)
    put_scaled(name, "biasprm", FORCES[int(actuator.biastype)], 1.0, spec, factor)


def put_kp(name: str, stated: float, spec: Any, value: float) -> None:
    """Set the stiffness of a servo, stated is the present one, and leave its damping alone."""
    put_scaled(name, "gainprm", (0,), stated, spec, value)
    put_scaled(name, "biasprm", (0, 1), stated, spec, value)


def put_forcerange(name: str, limits: tuple[float, float], spec: Any, factor: float) -> None:
    """Multiply the limits of an actuator's force, least and largest as stated."""
    spec.actuator(name).forcerange = factor * np.array(limits)


def put_limit(name: str, limits: tuple[float, float], spec: Any, limit: float) -> None:
    """Limit an actuator's force to the same size both ways, within its stated limits (infinite: none)."""
    actuator = spec.actuator(name)
    actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    actuator.forcerange = np.clip(limits, -limit, limit)


def put_lag(name: str, spec: Any, time_constant_s: float) -> None:
    """Set the time constant of an actuator's first-order lag; one without dynamics gets an exact lag."""
    actuator = spec.actuator(name)
    if actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE:
        actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        # The force follows the state at the end of the step: without it, a lag of next to nothing would
        # still delay by a whole step.
        actuator.actearly = True
    put_component(actuator, "dynprm", 0, time_constant_s)


def put_delay(kind: str, name: str, step_s: float, spec: Any, delay_s: float) -> None:
    """Set the delay of a part; kind is "actuator" or "sensor", step_s the time step of the model."""
    part = getattr(spec, kind)(name)
    part.delay = delay_s
    # Values in memory: one for each step of the delay, and one more at either end to interpolate between.
    part.nsample = int(np.ceil(delay_s / step_s)) + 2
    # Linear interpolation, so that the output depends on the delay continuously.
    part.interp = 1


def put_mass(name: str, spec: Any, mass_kg: float) -> None:
    """Set the mass of a body at the same shape and density profile: its inertia goes in proportion."""
    body = spec.body(name)
    body.inertia = np.array(body.inertia) * (mass_kg / body.mass)
    body.mass = mass_kg


def put_inertia(name: str, spec: Any, factor: float) -> None:
    """Multiply the inertia of a body about its centre of mass."""
    body = spec.body(name)
    body.inertia = np.array(body.inertia) * factor


def put_centre(name: str, axis: int, spec: Any, shift_m: float) -> None:
    """Move the centre of mass along an axis (0, 1, 2) of the body; the inertia about the centre stays."""
    body = spec.body(name)
    put_component(body, "ipos", axis, body.ipos[axis] + shift_m)


def put_shape(name: str, i: int, j: int, spec: Any, value: float) -> None:
    """Stretch a body's mass along its axis i (i = j), or shear it in the plane of its axes i and j.

    The second moments S = integral of r r^T dm about the centre of mass become M S M^T. M is the identity
    with `value` at (i, i), a factor; or at the shorter of two axes by the longer, a slope. That multiplies
    the Cholesky factor L of S = L L^T by a triangular matrix: factors and shears are log-Cholesky
    coordinates of S, and any values of them leave an inertia that a body can have.
    """
    body = spec.body(name)
    to_body = np.zeros(9)
    mujoco.mju_quat2Mat(to_body, np.array(body.iquat))
    rotation = to_body.reshape(3, 3)
    inertia = rotation @ np.diag(body.inertia) @ rotation.T
    # I = tr(S) 1 - S, so that S = tr(I) / 2 1 - I.
    second_moments = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    shorter = i
    longer = j
    if not second_moments[i, i] < second_moments[j, j]:
        shorter = j
        longer = i
    change = np.eye(3)
    change[shorter, longer] = value
    second_moments = change @ second_moments @ change.T
    # Back to principal axes; a quaternion needs a right-handed triple of them.
    principal, axes = np.linalg.eigh(second_moments)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    principal = np.maximum(principal, _THINNEST * np.sum(principal))
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    body.inertia = np.sum(principal) - principal
    body.iquat = quaternion


def put_payload(name: str, position_m: tuple[float, ...], spec: Any, mass_kg: float) -> None:
    """Add a point mass at a position (3,) of a body, in the body's frame."""
    load = spec.body(name).add_body(name=free_name(name, "payload", spec.body), pos=position_m)
    load.explicitinertial = True
    load.mass = mass_kg
    load.ipos = np.zeros(3)
    load.inertia = np.full(3, _POINT_MASS_M2 * mass_kg)


def _joint_behind(name: str, what: str, spec: Any) -> Any:
    """A second joint "NAME WHAT" on the axis of the first; the armature stays at the first, the motor."""
    joint = spec.joint(name)
    added = free_name(name, what, spec.joint)
    return joint.parent.add_joint(PLAIN.default, name=added, type=joint.type, axis=joint.axis, pos=joint.pos)


def put_backlash(name: str, spec: Any, gap: float) -> None:
    """Let a link move freely against its motor within a gap, end to end [rad of a hinge, m of a slide].

    Where the damping of a servo would stop the unloaded motor within a step, steps of Euler's integrator are
    unstable and implicit ones are not: the spec then gets MuJoCo's "implicitfast".
    """
    damping = 0.0
    for actuator in spec.actuators:
        if actuator.target == name and actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE:
            damping += -(actuator.gear[0] ** 2) * actuator.biasprm[2]
    stops_within_a_step = damping * spec.option.timestep > spec.joint(name).armature
    if stops_within_a_step and spec.option.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    joint = _joint_behind(name, "backlash", spec)
    # A spec keeps the unit of its file: the compiler turns ranges of hinges from degrees.
    if spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE:
        gap = np.rad2deg(gap)
    joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
    joint.range = np.array([-0.5, 0.5]) * gap
    # The stiffest contact that MuJoCo allows: a time constant of two steps, critically damped.
    joint.solref_limit = np.array([2 * spec.option.timestep, 1.0])


def put_spring(name: str, load: float, spec: Any, stiffness: float, damping_ratio: float) -> None:
    """Put a spring and a damper between a motor and its load.

    Parameters
    ----------
    load : float
        Inertia behind the spring [kg m^2 of a hinge, kg of a slide]; the motor's is the joint's armature.
    stiffness : float
        N m/rad or N/m.
    damping_ratio : float
        Of the load against the motor, both free: d = 2 zeta sqrt(k J), J = load motor / (load + motor).
    """
    motor = spec.joint(name).armature
    joint = _joint_behind(name, ELASTIC, spec)
    put_component(joint, "stiffness", 0, stiffness)
    put_component(joint, "damping", 0, 2 * damping_ratio * np.sqrt(stiffness * load * motor / (load + motor)))


def put_stribeck(name: str, spec: Any, level: float, share: float, velocity: float) -> None:
    """Add dry friction that falls with speed, from `level` at rest to `share` of it.

    F(v) = level (share + (1 - share) exp(-|v| / velocity)). MJCF has no word for the part that falls, so
    that stands as <numeric name="JOINT.stribeck" data="(1 - share) level, velocity">.
    """
    spec.joint(name).frictionloss += share * level
    put_number(f"{name}.{STRIBECK}", spec, (1 - share) * level, velocity)


def put_number(name: str, spec: Any, *values: float) -> None:
    """Write a <numeric> of the file, in place of one of this name."""
    present = spec.numeric(name)
    if present is not None:
        spec.delete(present)
    spec.add_numeric(name=name, size=len(values)).data = np.array(values)
