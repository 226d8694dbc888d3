"""Effects on the link itself."""

from __future__ import annotations

from dataclasses import replace

from pydantic import Field

from plant.effects.base import Effect, NotNegative, Positive, RatioEffect, register, with_parameters
from plant.effects.search_space import Sought
from plant.machine import Machine


@register
class TipPayload(Effect):
    """A point mass added to the payload of the rig."""

    id = "tip_payload"
    words = "an additional mass at the tip"
    adds_to = "payload.mass_kg"
    sought = Sought((1e-6, 5), (1e-4, 1.5, 14), "link_mass_kg")

    mass_kg: NotNegative = Field(description="added point mass at the tip")

    def modify(self, machine: Machine) -> Machine:
        return with_parameters(machine, {"payload.mass_kg": machine.rig.payload.mass_kg + self.mass_kg})


@register
class LinkStiffness(RatioEffect):
    """E I multiplied by a ratio; kappa unchanged, so the damping moment scales too."""

    id = "link_stiffness"
    words = "a wrong bending stiffness of the link"
    multiplies = "link.youngs_modulus_Pa"

    ratio: Positive = Field(description="true over nominal bending stiffness")


@register
class StructuralDamping(RatioEffect):
    """Kelvin-Voigt constant kappa multiplied by a ratio."""

    id = "structural_damping"
    words = "wrong damping of the link"
    multiplies = "link.kelvin_voigt_s"
    largest_ratio = 50.0

    ratio: NotNegative = Field(description="true over nominal kappa")


@register
class Gravity(Effect):
    """The plane is tilted: in-plane gravity g along the link axis at theta = 0, pointing away from the hub.

    Acts on link and tip mass with the full angle of the link root; the deflection enters to second order,
    so the hanging link is also stiffened by its own weight.
    """

    id = "gravity"
    words = "gravity in a tilted plane"
    beside = "a linear spring from hub to ground, while motions are small; larger ones"
    environment = True
    everywhere = True
    absolute_angle = True
    sought = Sought((1e-4, 20), (1e-3, 10, 12))

    acceleration_m_s2: NotNegative = Field(description="in-plane component of gravity")

    def modify(self, machine: Machine) -> Machine:
        return replace(machine, gravity_m_s2=machine.gravity_m_s2 + self.acceleration_m_s2)
