"""How numbers of a MuJoCo model that may be off or missing are written into an MjSpec."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

# Its defaults are MuJoCo's own: what an edit adds takes nothing from the default class of a model.
PLAIN = mujoco.MjSpec()
LAGS = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
# Second moment of a rod across, as a share of all: MuJoCo refuses what rounding makes thinner than a line.
_THINNEST = 1e-9
# Last parts of names: of numbers that MuJoCo does not act on, and of the joint behind a spring.
STRIBECK, DEAD_ZONE, ELASTIC = "stribeck", "dead_zone", "elastic"
# Which numbers of an actuator's gain and bias are force, by type: fixed or none, affine, muscle.
FORCES = {0: (0,), 1: (0, 1, 2), 2: (2, 3)}


def put_compiled(spec: Any, model: Any) -> None:
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
            put_component(joint, "stiffness", 0, model.jnt_stiffness[k])
            put_component(joint, "damping", 0, model.dof_damping[model.jnt_dofadr[k]])
            joint.springdamper = np.zeros(2)
    for k, one in enumerate(spec.actuators):
        # Else dampratio, of which the compiler makes a damping: the spec holds it as a positive number.
        if one.biastype == mujoco.mjtBias.mjBIAS_AFFINE:
            one.biasprm = model.actuator_biasprm[k]


# Each writes a value into an MjSpec once the arguments before it are bound.


def put_at_joint(joint: str, key: str, k: int, spec: Any, value: float) -> None:
    """A number of a joint, or the k-th of several (of a polynomial of the speed)."""
    one = spec.joint(joint)
    if np.ndim(getattr(one, key)):
        put_component(one, key, k, value)
    else:
        setattr(one, key, value)


def put_gravity(k: int, main: int, spec: Any, value: float) -> None:
    """A component; another one (main) keeps the size."""
    gravity = np.array(spec.option.gravity)
    rest = gravity[main] ** 2 + gravity[k] ** 2 - value**2
    gravity[main] = np.copysign(np.sqrt(max(rest, 0.0)), gravity[main])
    gravity[k] = value
    spec.option.gravity = gravity


def put_component(one: Any, key: str, k: int, value: float) -> None:
    whole = np.array(getattr(one, key), dtype=np.float64)
    whole[k] = value
    setattr(one, key, whole)


def put_gain(name: str, spec: Any, factor: float) -> None:
    """Force of an actuator, its feedback included."""
    one = spec.actuator(name)
    for key, kind in (("gainprm", one.gaintype), ("biasprm", one.biastype)):
        put_scaled(name, key, FORCES[int(kind)], 1.0, spec, factor)


def put_scaled(name: str, key: str, places: Sequence[int], stated: float, spec: Any, value: float) -> None:
    """Numbers of an actuator in proportion to a value that is stated."""
    one = spec.actuator(name)
    for k in places:
        put_component(one, key, k, value / stated * getattr(one, key)[k])


def put_kp(name: str, stated: float, spec: Any, value: float) -> None:
    """Stiffness of a servo, without its damping."""
    put_scaled(name, "gainprm", (0,), stated, spec, value)
    put_scaled(name, "biasprm", (0, 1), stated, spec, value)


def put_forcerange(name: str, limits: tuple[float, float], spec: Any, factor: float) -> None:
    spec.actuator(name).forcerange = factor * np.array(limits)


def put_limit(name: str, limits: tuple[float, float], spec: Any, limit: float) -> None:
    """The same force both ways, within stated limits."""
    one = spec.actuator(name)
    one.forcelimited, one.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, np.clip(limits, -limit, limit)


def put_lag(name: str, spec: Any, value: float) -> None:
    one = spec.actuator(name)
    if one.dyntype == mujoco.mjtDyn.mjDYN_NONE:
        one.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        one.actearly = True
    put_component(one, "dynprm", 0, value)


def put_delay(kind: str, name: str, step_s: float, spec: Any, value: float) -> None:
    one = getattr(spec, kind)(name)
    one.delay, one.nsample, one.interp = value, int(np.ceil(value / step_s)) + 2, 1


def put_mass(name: str, spec: Any, value: float) -> None:
    """At the same density and shape: inertia in proportion."""
    body = spec.body(name)
    body.inertia = np.array(body.inertia) * (value / body.mass)
    body.mass = value


def put_inertia(name: str, spec: Any, factor: float) -> None:
    body = spec.body(name)
    body.inertia = np.array(body.inertia) * factor


def put_centre(name: str, k: int, spec: Any, shift: float) -> None:
    """Of mass, along an axis of the body; the inertia about it stays."""
    body = spec.body(name)
    put_component(body, "ipos", k, body.ipos[k] + shift)


def put_shape(name: str, i: int, j: int, spec: Any, value: float) -> None:
    """Stretches a mass (i = j) or shears it along the shorter of two axes by the longer, in axes of the body.

    That multiplies the Cholesky factor L of its second moments S = L L^T by a triangular matrix: factors and
    shears are log-Cholesky coordinates, and any of them leave an inertia that a body can have.
    """
    body, flat = spec.body(name), np.zeros(9)
    mujoco.mju_quat2Mat(flat, np.array(body.iquat))
    turn = flat.reshape(3, 3)
    inertia = turn @ np.diag(body.inertia) @ turn.T
    moments = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    shorter, longer = (i, j) if moments[i, i] < moments[j, j] else (j, i)
    change = np.eye(3)
    change[shorter, longer] = value
    moments = change @ moments @ change.T
    principal, axes = np.linalg.eigh(moments)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    principal = np.maximum(principal, _THINNEST * np.sum(principal))
    body.inertia, quaternion = np.sum(principal) - principal, np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    body.iquat = quaternion


def put_payload(name: str, at: tuple[float, ...], spec: Any, mass: float) -> None:
    load = spec.body(name).add_body(name=f"{name} payload", pos=at)
    load.explicitinertial, load.mass, load.ipos = True, mass, np.zeros(3)
    load.inertia = np.full(3, 1e-9 * mass)


def _behind(name: str, what: str, spec: Any) -> Any:
    """A second joint on the axis of the first; armature stays at that, the motor."""
    joint = spec.joint(name)
    return joint.parent.add_joint(
        PLAIN.default, name=f"{name} {what}", type=joint.type, axis=joint.axis, pos=joint.pos
    )


def put_backlash(name: str, spec: Any, gap: float) -> None:
    """Free within the gap. Where damping of a servo stops a motor without load within a step, Euler's steps
    are not stable, implicit ones are."""
    servos = (
        one for one in spec.actuators if one.target == name and one.biastype == mujoco.mjtBias.mjBIAS_AFFINE
    )
    damping = sum(-(one.gear[0] ** 2) * one.biasprm[2] for one in servos)
    stops = damping * spec.option.timestep > spec.joint(name).armature
    if stops and spec.option.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    joint = _behind(name, "backlash", spec)
    gap = np.rad2deg(gap) if spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE else gap
    joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, np.array([-0.5, 0.5]) * gap
    joint.solref_limit = np.array([2 * spec.option.timestep, 1.0])


def put_spring(name: str, load: float, spec: Any, stiffness: float, damping_ratio: float) -> None:
    """load : inertia behind it; the damping is that of the load against the motor."""
    joint, motor = _behind(name, ELASTIC, spec), spec.joint(name).armature
    put_component(joint, "stiffness", 0, stiffness)
    put_component(joint, "damping", 0, 2 * damping_ratio * np.sqrt(stiffness * load * motor / (load + motor)))


def put_stribeck(name: str, spec: Any, level: float, share: float, velocity: float) -> None:
    """Dry friction of level at rest, a share of it at speed; MJCF has no word for the difference."""
    spec.joint(name).frictionloss += share * level
    put_number(f"{name}.{STRIBECK}", spec, (1 - share) * level, velocity)


def put_number(name: str, spec: Any, *value: float) -> None:
    if (one := spec.numeric(name)) is not None:
        spec.delete(one)
    spec.add_numeric(name=name, size=len(value)).data = np.array(value)
