"""Dry friction identified with the linear arm: the response behind it, and what it makes of it."""

from ident.friction.amplitude import EquivalentFriction, at_amplitude, equivalent_friction
from ident.friction.arm import FrictionLaw
from ident.friction.behind import identify_behind
from ident.friction.command_causes import recorded_in_loop, with_commands_in_time
from ident.friction.fit import fit_friction, refuse_missed_friction, refuse_unseen_shaft
from ident.friction.gauss_newton import FrictionFit
from ident.friction.posterior import BehindFriction, other_output_without_friction, without_friction
from ident.friction.rate_members import RateMember
from ident.friction.remote import (
    RemoteFriction,
    remote_friction,
    with_remote_friction,
    without_remote_friction,
)

__all__ = [
    "BehindFriction",
    "EquivalentFriction",
    "FrictionFit",
    "FrictionLaw",
    "RateMember",
    "RemoteFriction",
    "at_amplitude",
    "equivalent_friction",
    "fit_friction",
    "identify_behind",
    "other_output_without_friction",
    "recorded_in_loop",
    "refuse_missed_friction",
    "refuse_unseen_shaft",
    "remote_friction",
    "with_commands_in_time",
    "with_remote_friction",
    "without_friction",
    "without_remote_friction",
]
