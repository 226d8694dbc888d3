"""Effects at the motor, gear and hub. Torques act on the shaft relative to the housing, sizes at the hub side of the gear."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from plant.effects.base import Effect, NotNegative, Positive, with_joint, with_parameters
from plant.machine import DryFriction, Machine


class CoulombFriction(Effect):
    """Dry friction -Tc sign(omega); at rest any torque up to Tc is held (10 microradian of elastic pre-sliding)."""

    id = "coulomb_friction"
    group = "joint"
    neutral = {"torque_Nm": 0.0}
    smooth = False

    torque_Nm: NotNegative = Field(description="friction level Tc")

    def modify(self, machine: Machine) -> Machine:
        friction = DryFriction(self.torque_Nm, self.torque_Nm, 1.0)
        return with_joint(machine, friction=(*machine.joint.friction, friction))


class StribeckFriction(Effect):
    """Dry friction of size Tc + (Ts - Tc) exp(-|omega| / vs); at rest up to Ts is held (same pre-sliding)."""

    id = "stribeck_friction"
    group = "joint"
    neutral = {"static_torque_Nm": 0.0, "coulomb_torque_Nm": 0.0, "stribeck_velocity_rad_s": 0.1}
    smooth = False

    static_torque_Nm: NotNegative = Field(description="break-away level Ts, at least Tc")
    coulomb_torque_Nm: NotNegative = Field(description="level Tc at speed")
    stribeck_velocity_rad_s: Positive = Field(description="speed vs over which the level falls")

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
    neutral = {"coefficient_Nms": 0.0}

    coefficient_Nms: NotNegative = Field(description="added to the rig's viscous friction")

    def modify(self, machine: Machine) -> Machine:
        total = machine.rig.hub.viscous_friction_Nms + self.coefficient_Nms
        return with_parameters(machine, {"hub.viscous_friction_Nms": total})


class HubInertia(Effect):
    """Hub inertia J multiplied by a ratio."""

    id = "hub_inertia"
    group = "joint"
    neutral = {"ratio": 1.0}

    ratio: Positive = Field(description="true over nominal hub inertia")

    def modify(self, machine: Machine) -> Machine:
        total = machine.rig.hub.inertia_kg_m2 * self.ratio
        return with_parameters(machine, {"hub.inertia_kg_m2": total})
