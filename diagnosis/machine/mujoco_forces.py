"""Forces on a joint of a MuJoCo model that MJCF has no word for.

Their rows are those of any simulation (`diagnosis.machine.listed_effects`): each one with a smooth law, or
with dry friction in proportion to load, is a quantity of every joint, tried by name. It stands in a model as
<numeric name="JOINT.EFFECT" data="...">, values in the order of the row's parameters, is read from there, and
acts as an applied force, or as the joint's frictionloss, that is held over a step.

Dry friction of one direction or behind a play has no row here: a frictionloss acts both ways and everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import mujoco
import numpy as np

from diagnosis.machine.around import EffectLaw
from diagnosis.machine.body_forces import (
    BodyForces,
    DryFriction,
    DryLaw,
    SmoothLaw,
    friction_level,
    smooth_force,
)
from diagnosis.machine.listed_effects import KINDS, Magnitudes
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.mujoco_edits import STRIBECK, put_number
from diagnosis.machine.plant_effect import PlantEffect, name_with_unit
from plant.machine import OFF_AXIS

# Effects that are numbers of a joint in MJCF: frictionloss, damping, damping[1], stiffness, stiffness[2].
_IN_MJCF = ("coulomb_friction", "viscous_friction", "quadratic_drag", "spring", "hardening_spring")
# Warnings after which MuJoCo goes on from the model's reference state.
_OF_A_RUNAWAY = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
# Fields of dry friction that a frictionloss can be, if it changes from step to step.
_AS_FRICTIONLOSS = {"coulomb", "excess", "stribeck_velocity", "load"}


def _acts_on_a_joint(law: object) -> bool:
    """Whether a force by this law of a body can be put on a joint."""
    if isinstance(law, DryLaw):
        return set(law.levels) <= _AS_FRICTIONLOSS
    return isinstance(law, SmoothLaw)


# Names of the effects that are not, last parts of the names of numbers that MuJoCo does not act on.
FORCE_NAMES = tuple(
    kind.name for kind in KINDS.values() if _acts_on_a_joint(kind.law.change) and kind.name not in _IN_MJCF
)


def forces_of_joint(
    spec: Any, joint: Any, magnitudes: Magnitudes, force_unit: str, position_unit: str
) -> Iterator[PlantEffect]:
    """Effects that may be missing at a hinge or slide, of those in `FORCE_NAMES`.

    Parameters
    ----------
    spec : mujoco.MjSpec
        One that the model states already is none: it acts.
    joint : mujoco.MjsJoint
    magnitudes : Magnitudes
        Force, position and speed of the joint in its records, for ranges.
    force_unit, position_unit : str
        "Nm" and "rad", or "N" and "m"; names of parameters end with them.
    """
    units = {"force": force_unit, "position": position_unit, "speed": f"{position_unit}_s"}
    for name in FORCE_NAMES:
        kind = KINDS[name].at(magnitudes)
        # A weight turns about an axis.
        law = kind.law.change
        if isinstance(law, SmoothLaw) and law.law == OFF_AXIS and joint.type != mujoco.mjtJoint.mjJNT_HINGE:
            continue
        number = f"{joint.name}.{name}"
        if spec.numeric(number) is not None:
            continue
        yield replace(
            kind,
            name=number,
            parameters=tuple(replace(p, name=name_with_unit(p, units)) for p in kind.parameters),
            group="joint",
            law=EffectLaw("model", partial(put_number, number)),
            tried="by name",
        )


@dataclass(frozen=True)
class JointForces:
    """Forces at one degree of freedom of a compiled model that MuJoCo does not act on itself.

    dof, position : places of the joint in qvel and in qpos. forces : those that act.
    """

    dof: int
    position: int
    forces: BodyForces

    @classmethod
    def of_model(cls, model: Any) -> tuple[JointForces, ...]:
        """Forces of every joint that has any, from the numbers in a compiled model (MjModel)."""
        joints = []
        for k in range(model.njnt):
            joint = model.joint(k)
            forces = BodyForces()
            falling = _number(model, f"{joint.name}.{STRIBECK}")
            if falling is not None and falling[0] != 0:
                dry = DryFriction(excess=float(falling[0]), stribeck_velocity=float(falling[1]))
                forces = forces + BodyForces(dry)
            for name in FORCE_NAMES:
                values = _number(model, f"{joint.name}.{name}")
                if values is None:
                    continue
                names = (parameter.name for parameter in KINDS[name].parameters)
                forces = forces + KINDS[name].law.change(dict(zip(names, values, strict=True)))
            if forces != BodyForces():
                joints.append(cls(int(joint.dofadr[0]), int(joint.qposadr[0]), forces))
        return tuple(joints)


def sensed_under(joints: tuple[JointForces, ...], model: Any, data: Any, control: Real) -> Real:
    """What sensors read at the beginning of every step, under forces that are held over a step.

    Parameters
    ----------
    joints : tuple of JointForces
    model, data : MjModel, MjData
        As the record begins. The model is as before when this returns.
    control : (N, NU)
        Commands of all actuators of the model, tracking included, of N steps.

    Returns
    -------
    (N, S)
        Numbers of all sensors; not finite from the step on in which the trial runs away.
    """
    stated_level = np.array(model.dof_frictionloss)
    dry = [(joint.dof, joint.forces.dry) for joint in joints if joint.forces.dry != DryFriction()]
    smooth = [(joint.dof, joint.position, joint.forces.table) for joint in joints if joint.forces.smooth]
    if any(friction.load != 0 for _, friction in dry):
        # The load of a step is that of the one before; of the first one there is none yet.
        data.ctrl[:] = control[0]
        mujoco.mj_forward(model, data)
    readings = np.zeros((len(control), model.nsensordata))
    for k, command in enumerate(control):
        for dof, friction in dry:
            level = friction_level(friction, data.qvel[dof]) + friction.load * abs(data.qfrc_actuator[dof])
            model.dof_frictionloss[dof] = stated_level[dof] + level
        for dof, position, table in smooth:
            data.qfrc_applied[dof] = smooth_force(table, data.qpos[position], data.qvel[dof])
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        if ran_away(data):
            readings[k:] = np.nan
            break
        readings[k] = data.sensordata
    model.dof_frictionloss[:] = stated_level
    data.qfrc_applied[:] = 0.0
    return readings


def ran_away(data: Any) -> bool:
    """Whether MuJoCo met a position, speed or acceleration that is infinite, no number or beyond its limits.

    It then sets the state back to the model's reference and goes on: what follows is finite, and of another
    trial.
    """
    return any(data.warning[warning].number > 0 for warning in _OF_A_RUNAWAY)


def _number(model: Any, name: str) -> Real | None:
    """Values of a <numeric> of a compiled model; None where it has none of that name."""
    k = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    return None if k < 0 else np.asarray(model.numeric(k).data)
