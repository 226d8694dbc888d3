"""Effects on the link itself: its payload, stiffness and damping, and gravity in a tilted plane.

A class per effect: its docstring states the equation, its fields the parameters, and its class variables what
`plant.effects.base.Effect` explains.
"""

from __future__ import annotations

from dataclasses import replace
from operator import add

import numpy as np
from pydantic import Field

from plant.effects.base import Effect, NotNegative, Positive, RatioEffect, register
from plant.effects.search_space import Candidate, EffectParameter, Scales, searches
from plant.machine import Machine

# A tilt is the listed one up to so far from along the link, rad: a fifth of half a turn, where 0.83 of
# gravity is still along it. Another direction is no answer, as every machine stands a little out of level.
_ALONG_RAD = 0.6
# Starts of the direction, rad. A sixth of a turn apart, a search from one of them reaches any other.
_DIRECTIONS_RAD = tuple(k * np.pi / 3 for k in (0, 1, 2, 3, -2, -1))


@register
class TipPayload(Effect):
    """A point mass added to the payload of the rig."""

    id = "tip_payload"
    law = ("rig", "payload.mass_kg", add)
    words = "an additional mass at the tip"
    check = "weigh the tip with everything that is fixed to it"
    adds_to = "payload.mass_kg"
    # Up to five times the mass of the link; starts 2.1 times apart.
    sought = (EffectParameter("mass_kg", 1e-6, 5, unit="link_mass_kg", spread=(1e-4, 1.5, 14)),)

    mass_kg: NotNegative = Field(description="added point mass at the tip")


@register
class LinkStiffness(RatioEffect):
    """E I multiplied by a ratio; kappa unchanged, so the damping moment scales too."""

    id = "link_stiffness"
    words = "a wrong bending stiffness of the link"
    check = "clamp the hub, pull the tip with a known force and measure the deflection"
    multiplies = "link.youngs_modulus_Pa"

    ratio: Positive = Field(description="true over nominal bending stiffness")


@register
class StructuralDamping(RatioEffect):
    """Kelvin-Voigt constant kappa multiplied by a ratio."""

    id = "structural_damping"
    words = "wrong damping of the link"
    check = "clamp the hub, pluck the tip and count the swings until half of them is left"
    multiplies = "link.kelvin_voigt_s"
    # Damping is stated worst of all: it may be wrong by more than other values.
    largest_ratio = 50.0

    ratio: NotNegative = Field(description="true over nominal kappa")


@register
class Gravity(Effect):
    """The plane is tilted: in-plane gravity g along the link axis at theta = 0, pointing away from the hub.

    Another direction is no answer of a diagnosis: every machine stands a little out of level somehow. Acts on
    link and tip mass with the full angle of the link root; the deflection enters to second order, so the
    hanging link is also stiffened by its own weight.
    """

    id = "gravity"
    words = "gravity in a tilted plane"
    check = "put a spirit level on the base, and let the arm go with the motor off: it should stay"
    beside = "a linear spring from hub to ground, while motions are small; larger ones"
    environment = True
    absolute_angle = True
    # Up to twice the gravity of the earth: the stated masses may be wrong. Starts 2.3 times apart.
    sought = (
        EffectParameter("acceleration_m_s2", 1e-4, 20, spread=(1e-3, 10, 12)),
        EffectParameter("direction_rad", -np.pi, np.pi, _DIRECTIONS_RAD, "angle", step=1e-4),
    )

    acceleration_m_s2: NotNegative = Field(description="in-plane component of gravity")
    direction_rad: float = Field(default=0.0, description="hub angle at which the link hangs")

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        """A search of the size, and of the direction where an output tells the zero of the hub angle.

        Elsewhere the unknown zero stands in for the direction.
        """
        parameters = cls.sought if scales.any_direction else cls.sought[:1]
        return searches(cls, [parameter.at(scales) for parameter in parameters])

    @property
    def as_listed(self) -> bool:
        """Whether the tilt is along the link, so far that it is the listed effect."""
        return abs(self.direction_rad) <= _ALONG_RAD

    def parameters(self) -> dict[str, float]:
        """Parameter values by name; the direction only where it is not along the link."""
        values = super().parameters()
        if values["direction_rad"] == 0:
            del values["direction_rad"]
        return values

    def modify(self, machine: Machine) -> Machine:
        """The machine in this gravity, in place of any other."""
        return replace(machine, gravity_m_s2=self.acceleration_m_s2, gravity_direction_rad=self.direction_rad)
