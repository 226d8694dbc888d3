"""Dry friction identified with the linear arm: the response behind it, and what it makes of it."""

from ident.friction.amplitude import EquivalentFriction, at_amplitude, equivalent_friction
from ident.friction.arm import FrictionLaw
from ident.friction.behind import identify_behind
from ident.friction.command_causes import recorded_in_loop, with_commands_in_time
from ident.friction.fit import fit_friction, refuse_unseen_shaft
from ident.friction.gauss_newton import FrictionFit
from ident.friction.posterior import BehindFriction, other_output_without_friction, without_friction
from ident.friction.rate_members import RateMember

__all__ = [
    "BehindFriction",
    "EquivalentFriction",
    "FrictionFit",
    "FrictionLaw",
    "RateMember",
    "at_amplitude",
    "equivalent_friction",
    "fit_friction",
    "identify_behind",
    "other_output_without_friction",
    "recorded_in_loop",
    "refuse_unseen_shaft",
    "with_commands_in_time",
    "without_friction",
]
