"""Effects on the link itself."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from pydantic import Field

from plant.effects.base import Effect, NotNegative, Positive, with_parameters
from plant.machine import Machine


class TipPayload(Effect):
    """A point mass added to the payload of the rig."""

    id = "tip_payload"
    group = "link"
    neutral = MappingProxyType({"mass_kg": 0.0})

    mass_kg: NotNegative = Field(description="added point mass at the tip")

    def modify(self, machine: Machine) -> Machine:
        return with_parameters(machine, {"payload.mass_kg": machine.rig.payload.mass_kg + self.mass_kg})


class LinkStiffness(Effect):
    """E I multiplied by a ratio; kappa unchanged, so the damping moment scales too."""

    id = "link_stiffness"
    group = "link"
    neutral = MappingProxyType({"ratio": 1.0})

    ratio: Positive = Field(description="true over nominal bending stiffness")

    def modify(self, machine: Machine) -> Machine:
        return with_parameters(
            machine, {"link.youngs_modulus_Pa": machine.rig.link.youngs_modulus_Pa * self.ratio}
        )


class StructuralDamping(Effect):
    """Kelvin-Voigt constant kappa multiplied by a ratio."""

    id = "structural_damping"
    group = "link"
    neutral = MappingProxyType({"ratio": 1.0})

    ratio: NotNegative = Field(description="true over nominal kappa")

    def modify(self, machine: Machine) -> Machine:
        return with_parameters(machine, {"link.kelvin_voigt_s": machine.rig.link.kelvin_voigt_s * self.ratio})


class Gravity(Effect):
    """The plane is tilted: in-plane gravity g along the link axis at theta = 0, pointing away from the hub.

    Acts on link and tip mass with the full angle of the link root; the deflection enters to second order,
    so the hanging link is also stiffened by its own weight.
    """

    id = "gravity"
    group = "link"
    neutral = MappingProxyType({"acceleration_m_s2": 0.0})

    acceleration_m_s2: NotNegative = Field(description="in-plane component of gravity")

    def modify(self, machine: Machine) -> Machine:
        return replace(machine, gravity_m_s2=machine.gravity_m_s2 + self.acceleration_m_s2)
