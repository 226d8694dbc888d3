"""Effects at motor, gear and hub; torques act from housing to shaft, sizes at the hub side of the gear."""

from __future__ import annotations

from types import MappingProxyType
from typing import Self

from pydantic import Field, model_validator

from plant.effects.base import Effect, NotNegative, Positive, with_joint, with_parameters
from plant.machine import Disturbance, DryFriction, Machine, Ripple, TorsionSpring

# Bounds that only keep the step of the simulation reasonable: a stiffer pre-sliding, a steeper fall or a
# finer ripple needs a shorter one (see plant.plan).
_LARGEST_LEVEL_NM = 1e4


class CoulombFriction(Effect):
    """Dry friction -Tc sign(omega); at rest up to Tc is held (with 10 microradian of elastic pre-sliding)."""

    id = "coulomb_friction"
    group = "joint"
    neutral = MappingProxyType({"torque_Nm": 0.0})
    dependence = "continuous"

    torque_Nm: float = Field(ge=0, le=_LARGEST_LEVEL_NM, description="friction level Tc")

    def modify(self, machine: Machine) -> Machine:
        friction = DryFriction(self.torque_Nm, self.torque_Nm, 1.0)
        return with_joint(machine, friction=(*machine.joint.friction, friction))


class StribeckFriction(Effect):
    """Dry friction of size Tc + (Ts - Tc) exp(-|omega| / vs); at rest up to Ts is held (same pre-sliding)."""

    id = "stribeck_friction"
    group = "joint"
    neutral = MappingProxyType(
        {"static_torque_Nm": 0.0, "coulomb_torque_Nm": 0.0, "stribeck_velocity_rad_s": 0.1}
    )
    dependence = "continuous"

    static_torque_Nm: float = Field(
        ge=0, le=_LARGEST_LEVEL_NM, description="break-away level Ts, at least Tc"
    )
    coulomb_torque_Nm: float = Field(ge=0, description="level Tc at speed")
    stribeck_velocity_rad_s: float = Field(ge=1e-4, description="speed vs over which the level falls")

    @model_validator(mode="after")
    def _falls_with_speed(self) -> Self:
        if not self.static_torque_Nm >= self.coulomb_torque_Nm:
            raise ValueError(
                "static_torque_Nm must not be below coulomb_torque_Nm; "
                f"got {self.static_torque_Nm} and {self.coulomb_torque_Nm}"
            )
        return self

    def modify(self, machine: Machine) -> Machine:
        friction = DryFriction(self.static_torque_Nm, self.coulomb_torque_Nm, self.stribeck_velocity_rad_s)
        return with_joint(machine, friction=(*machine.joint.friction, friction))


class ViscousFriction(Effect):
    """Torque -c omega, added to the linear friction of the rig."""

    id = "viscous_friction"
    group = "joint"
    neutral = MappingProxyType({"coefficient_Nms": 0.0})

    coefficient_Nms: NotNegative = Field(description="added to the rig's viscous friction")

    def modify(self, machine: Machine) -> Machine:
        total = machine.rig.hub.viscous_friction_Nms + self.coefficient_Nms
        return with_parameters(machine, {"hub.viscous_friction_Nms": total})


class HubInertia(Effect):
    """Hub inertia J multiplied by a ratio."""

    id = "hub_inertia"
    group = "joint"
    neutral = MappingProxyType({"ratio": 1.0})

    ratio: Positive = Field(description="true over nominal hub inertia")

    def modify(self, machine: Machine) -> Machine:
        total = machine.rig.hub.inertia_kg_m2 * self.ratio
        return with_parameters(machine, {"hub.inertia_kg_m2": total})


class TorqueRipple(Effect):
    """Extra motor torque a sin(N theta + p), theta the shaft angle; N counts per hub revolution."""

    id = "torque_ripple"
    group = "joint"
    neutral = MappingProxyType({"amplitude_Nm": 0.0, "cycles_per_rev": 1.0, "phase_rad": 0.0})

    amplitude_Nm: NotNegative = Field(description="amplitude a")
    cycles_per_rev: float = Field(ge=0, le=1e4, description="cycles N per hub revolution")
    phase_rad: float = Field(description="phase p at theta = 0")

    def modify(self, machine: Machine) -> Machine:
        ripple = Ripple(self.amplitude_Nm, self.cycles_per_rev, self.phase_rad)
        return with_joint(machine, ripple=(*machine.joint.ripple, ripple))


class PeriodicDisturbance(Effect):
    """Torque a sin(2 pi f t + p) from ground on the hub, t from the start of the record."""

    id = "periodic_disturbance"
    group = "joint"
    neutral = MappingProxyType({"amplitude_Nm": 0.0, "frequency_Hz": 1.0, "phase_rad": 0.0})

    amplitude_Nm: NotNegative = Field(description="amplitude a")
    frequency_Hz: NotNegative = Field(description="frequency f")
    phase_rad: float = Field(description="phase p at the start of the record")

    def modify(self, machine: Machine) -> Machine:
        disturbance = Disturbance(self.amplitude_Nm, self.frequency_Hz, self.phase_rad)
        return with_joint(machine, disturbance=(*machine.joint.disturbance, disturbance))


class HardeningSpring(Effect):
    """Cubic spring from hub (motor side, with backlash) to ground, torque -k3 theta^3, no linear part."""

    id = "hardening_spring"
    group = "joint"
    neutral = MappingProxyType({"cubic_Nm_rad3": 0.0})

    cubic_Nm_rad3: NotNegative = Field(description="coefficient k3")

    def modify(self, machine: Machine) -> Machine:
        total = machine.joint.cubic_spring_Nm_rad3 + self.cubic_Nm_rad3
        return with_joint(machine, cubic_spring_Nm_rad3=total)


class GroundSpring(Effect):
    """Linear spring from hub (motor side, with backlash) to ground, torque -k theta.

    Not in `EFFECTS`: no answer of a diagnosis, which needs it to tell gravity from what looks like it.
    """

    id = "ground_spring"
    group = "joint"
    neutral = MappingProxyType({"stiffness_Nm_rad": 0.0})

    stiffness_Nm_rad: NotNegative = Field(description="stiffness k")

    def modify(self, machine: Machine) -> Machine:
        total = machine.joint.ground_spring_Nm_rad + self.stiffness_Nm_rad
        return with_joint(machine, ground_spring_Nm_rad=total)


class JointCompliance(Effect):
    """Torsion spring and damper, coaxial with the hub and without inertia, between hub and link root.

    The clamp, at the hub radius, turns about the hub axis by an extra angle; the hub angle stays the
    encoder's.
    """

    id = "joint_compliance"
    group = "joint"
    neutral = None  # the rigid joint is the limit of infinite stiffness

    stiffness_Nm_rad: Positive = Field(description="stiffness k")
    damping_Nms: NotNegative = Field(description="damping c")

    def modify(self, machine: Machine) -> Machine:
        return with_joint(machine, compliance=TorsionSpring(self.stiffness_Nm_rad, self.damping_Nms))


class BaseCompliance(Effect):
    """Hub axis and motor housing sit on a base that turns about the same axis, sprung and damped to ground.

    Motor torque, back-EMF, friction and ripple act between base and hub. The encoder reads hub minus base,
    tip_m uses the absolute hub angle.
    """

    id = "base_compliance"
    group = "joint"
    neutral = None  # the fixed base is the limit of infinite stiffness

    stiffness_Nm_rad: Positive = Field(description="stiffness k to ground")
    damping_Nms: NotNegative = Field(description="damping c to ground")
    inertia_kg_m2: Positive = Field(description="inertia Jb of the base")

    def modify(self, machine: Machine) -> Machine:
        return with_joint(
            machine, base=TorsionSpring(self.stiffness_Nm_rad, self.damping_Nms, self.inertia_kg_m2)
        )


class Backlash(Effect):
    """Play between motor side (30 % of J, friction, back-EMF, motor torque) and hub (70 % of J, link).

    They touch at a relative angle of +-gap/2 and start in the middle. The contact is a damped spring that
    only pushes: torque max(kc p + cc dp/dt, 0) at the penetration p, kc = 0.21 J (2 pi 180)^2, cc = 0.8
    sqrt(0.3 J kc). The encoder is on the hub.
    """

    id = "backlash"
    group = "joint"
    neutral = None  # without play the contact is still elastic
    dependence = "jagged"

    gap_rad: Positive = Field(description="total play")

    def modify(self, machine: Machine) -> Machine:
        return with_joint(machine, backlash_gap_rad=self.gap_rad)
