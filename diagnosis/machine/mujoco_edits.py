"""Numbers of a MuJoCo model that may be off or missing, and how each is written into an MjSpec."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from diagnosis.machine.plant_effect import EffectParameter, PlantEffect
from plant.effects.search_space import Dependence, geometric

Put = Callable[[Any, float], None]

# Its defaults are MuJoCo's own: what an edit adds takes nothing from the default class of a model.
PLAIN = mujoco.MjSpec()
LAGS = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
# Which numbers of an actuator's gain and bias are force, by type: fixed or none, affine, muscle.
FORCES = {0: (0,), 1: (0, 1, 2), 2: (2, 3)}


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


def put_first(joint: str, key: str, spec: Any, value: float) -> None:
    """A number of a joint, or the first of several (of a polynomial of the speed)."""
    one = spec.joint(joint)
    if np.ndim(getattr(one, key)):
        put_component(one, key, 0, value)
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
        for k in FORCES[int(kind)]:
            put_component(one, key, k, factor * getattr(one, key)[k])


def put_forcerange(name: str, limits: tuple[float, float], spec: Any, factor: float) -> None:
    spec.actuator(name).forcerange = factor * np.array(limits)


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


def put_payload(name: str, at: tuple[float, ...], spec: Any, mass: float) -> None:
    load = spec.body(name).add_body(name=f"{name} payload", pos=at)
    load.explicitinertial, load.mass, load.ipos = True, mass, np.zeros(3)
    load.inertia = np.full(3, 1e-9 * mass)


def put_backlash(name: str, spec: Any, gap: float) -> None:
    """A second joint on the same axis that is free within the gap; armature stays at the first, the motor."""
    joint = spec.joint(name)
    in_degrees = spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
    gap = np.rad2deg(gap) if in_degrees else gap
    joint.parent.add_joint(
        PLAIN.default,
        name=f"{name} backlash",
        type=joint.type,
        axis=joint.axis,
        pos=joint.pos,
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=np.array([-0.5, 0.5]) * gap,
        solref_limit=np.array([2 * spec.option.timestep, 1.0]),
    )


def put_number(name: str, spec: Any, value: float) -> None:
    one = spec.numeric(name) or spec.add_numeric(name=name, size=1)
    one.data = np.array([value])
