"""Effects at motor, gear and hub; torques act from housing to shaft, sizes at the hub side of the gear.

A class per effect: its docstring states the equation, its fields the parameters, and its class variables what
`plant.effects.base.Effect` explains. A `spread` (first, last, count) has the starts of a search in equal
ratios, in multiples of the `unit`. Ranges are three decades and more: `candidates` makes those that need
several magnitudes of the rig.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from operator import add
from types import MappingProxyType
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from plant.effects.base import (
    USUAL_TOLERANCES,
    Effect,
    NotNegative,
    Positive,
    RatioEffect,
    alone,
    register,
)
from plant.effects.search_space import PHASE, Axis, Candidate, EffectParameter, Scales, geometric, log_axis
from plant.machine import (
    CUBIC,
    QUADRATIC,
    SINE,
    Disturbance,
    DryFriction,
    Machine,
    Real,
    SmoothTorque,
    TorsionSpring,
)
from plant.modal import static_moment_kg_m
from plant.rig import Rig

# Largest level of dry friction, N m. It only keeps the step of the simulation reasonable: a stiffer
# pre-sliding needs a shorter one (see `plant.plan`), as do a steeper fall and a finer ripple, whose bounds
# stand in the fields.
_LARGEST_LEVEL_NM = 1e4
# Friction smaller than this many tolerances of the stated value it is added to is not significant: two
# standard deviations. Doubled, additional friction has to be twice as large to be looked for.
_VISCOUS_TOLERANCES = 2.0
# Lowest resonance, Hz, of a body that something holds to the hub: slower ones swing once in two seconds.
_SLOWEST_BODY_HZ = 0.5
# Highest one, cycles a sample: an eighth, a quarter of the Nyquist frequency. Held more stiffly than that a
# body is inertia of the hub.
_FASTEST_BODY_CYCLES = 0.125


@register
class CoulombFriction(Effect):
    """Dry friction -Tc sign(omega); at rest up to Tc is held (with 10 microradian of elastic pre-sliding)."""

    id = "coulomb_friction"
    words = "dry (Coulomb) friction"
    check = "raise the voltage slowly from rest and note where the hub starts to turn, in both directions"
    friction = True
    dependence = "continuous"
    # Up to the stall torque at the largest command, where nothing moves; starts 1.8 times apart.
    sought = (EffectParameter("torque_Nm", 1e-5, 1, unit="torque_Nm", spread=(3e-4, 0.6, 14)),)

    torque_Nm: float = Field(ge=0, le=_LARGEST_LEVEL_NM, description="friction level Tc")

    def modify(self, machine: Machine) -> Machine:
        """The machine with one more friction element, which has no excess and so no use for its speed."""
        friction = DryFriction(self.torque_Nm, self.torque_Nm, 1.0)
        joint = replace(machine.joint, friction=(*machine.joint.friction, friction))
        return replace(machine, joint=joint)


@register
class StribeckFriction(Effect):
    """Dry friction of size Tc + (Ts - Tc) exp(-|omega| / vs); at rest up to Ts is held (same pre-sliding)."""

    id = "stribeck_friction"
    law = ("joint", "friction", DryFriction)
    words = "dry friction that falls with speed (Stribeck)"
    check = "let the hub creep at several slow, steady speeds and note the voltage that each takes"
    contains = "coulomb_friction"
    friction = True
    neutral = MappingProxyType({"stribeck_velocity_rad_s": 0.1})
    dependence = "continuous"
    # The Coulomb level is sought as a share of the static one (`from_search`). A fall over less than a
    # hundredth of the largest speed is over before it shows: dry friction of the Coulomb kind by another
    # name.
    # Starts are 3 times apart in level and 5 times in speed; the step averages over switching instants.
    sought = (
        EffectParameter("static_torque_Nm", 1e-5, 2, unit="torque_Nm", spread=(3e-4, 0.6, 8), step=2e-3),
        EffectParameter("coulomb_torque_Nm", 0.0, 0.98, (0.5, 0.8), "linear", step=2e-3),
        EffectParameter(
            "stribeck_velocity_rad_s", 0.01, 2, unit="speed_rad_s", spread=(0.012, 0.3, 3), step=2e-3
        ),
    )

    static_torque_Nm: float = Field(
        ge=0, le=_LARGEST_LEVEL_NM, description="break-away level Ts, at least Tc"
    )
    coulomb_torque_Nm: float = Field(ge=0, description="level Tc at speed")
    stribeck_velocity_rad_s: float = Field(ge=1e-4, description="speed vs over which the level falls")

    @model_validator(mode="after")
    def _falls_with_speed(self) -> Self:
        """The effect itself. Raises ValueError where the static level is below the Coulomb level."""
        if not self.static_torque_Nm >= self.coulomb_torque_Nm:
            raise ValueError(
                "static_torque_Nm must not be below coulomb_torque_Nm; "
                f"got {self.static_torque_Nm} and {self.coulomb_torque_Nm}"
            )
        return self

    @classmethod
    def from_search(cls, values: Mapping[str, float], sign: int) -> Self:
        """The effect at the values of the axes, of which the Coulomb level is a share of the static one."""
        level = values["coulomb_torque_Nm"] * values["static_torque_Nm"]
        return cls(**{**values, "coulomb_torque_Nm": level})

    def simpler(self) -> CoulombFriction:
        """Coulomb friction halfway between the levels."""
        return CoulombFriction(torque_Nm=0.5 * (self.static_torque_Nm + self.coulomb_torque_Nm))


@register
class ViscousFriction(Effect):
    """Torque -c omega, added to the linear friction of the rig."""

    id = "viscous_friction"
    law = ("rig", "hub.viscous_friction_Nms", add)
    words = "additional viscous friction"
    check = "turn the hub at several steady speeds and note the voltage: it should grow in proportion"
    adds_to = "hub.viscous_friction_Nms"
    friction = True

    coefficient_Nms: NotNegative = Field(description="added to the rig's viscous friction")

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        """A search in multiples of the damping that the hub has, from what tolerances do not explain."""
        rig = scales.rig
        spread = scales.tolerance("hub.viscous_friction_Nms") * rig.hub.viscous_friction_Nms
        damping = rig.hub.viscous_friction_Nms + rig.motor.back_emf_damping_Nms
        least = _VISCOUS_TOLERANCES * spread
        usual = None
        if least > 0:
            usual = (least, USUAL_TOLERANCES * spread)
        # From what no record shows to a hub that hardly moves.
        axis = log_axis("coefficient_Nms", max(1e-5 * damping, least), 30 * damping, usual=usual)
        first_start = max(1e-4 * damping, 1.2 * least)
        starts = [(coefficient,) for coefficient in geometric(first_start, 3 * damping, 8)]
        return (cls._candidate([axis], starts),)


@register
class QuadraticDrag(Effect):
    """Torque -c omega |omega| on the hub (motor side, with backlash), as of air or churned oil.

    At one speed that is viscous friction: no answer of a diagnosis, which needs it to tell that from what
    looks like it.
    """

    id = "quadratic_drag"
    law = ("joint", "torques", partial(SmoothTorque, QUADRATIC, at="motor", of="speed"))
    words = "a drag that grows with the square of the speed"
    look_alike_of = "viscous_friction"

    coefficient_Nms2: NotNegative = Field(description="coefficient c")


@register
class HubInertia(RatioEffect):
    """Hub inertia J multiplied by a ratio."""

    id = "hub_inertia"
    words = "a wrong inertia of the hub"
    check = "weigh what is fixed to the hub (clamp, coupling, cable) and measure how far out it sits"
    beside = "a body that something compliant holds to the hub, below its resonance; faster motions"
    multiplies = "hub.inertia_kg_m2"

    ratio: Positive = Field(description="true over nominal hub inertia")


@register
class AttachedBody(Effect):
    """A body about the hub axis that a torsion spring and damper hold to the hub: a coupling, a drum.

    Below its resonance that is inertia of the hub: no answer of a diagnosis, which needs it to tell that from
    what looks like it.
    """

    id = "attached_body"
    law = ("joint", "attached", TorsionSpring)
    words = "a body that something compliant holds to the hub"
    look_alike_of = "hub_inertia"

    inertia_kg_m2: Positive = Field(description="inertia Ja of the body")
    stiffness_Nm_rad: Positive = Field(description="stiffness k")
    damping_Nms: NotNegative = Field(description="damping c")

    @classmethod
    def in_place_of(cls, other: Candidate, x: Real, rig: Rig) -> Candidate:
        """Search of a body that explains the hub's inertia ratio which the search `other` ended at, in x
        (1,).

        Below its resonance the body adds its inertia to the hub. Starts have resonances all over the range
        and a damping ratio of 0.1.
        """
        hub_inertia = rig.hub.inertia_kg_m2
        ratio = other.axes[0].value(x[0])
        if ratio > 1:
            inertias = [(ratio - 1) * hub_inertia]
        else:
            # A hub that moves above the resonance of what it carries seems lighter, by no telling how much.
            inertias = [0.3 * hub_inertia, hub_inertia, 3 * hub_inertia]
        slowest_rad_s = 2 * np.pi * _SLOWEST_BODY_HZ
        fastest_rad_s = 2 * np.pi * _FASTEST_BODY_CYCLES / rig.sampling.dt_s
        softest = inertias[0] * slowest_rad_s**2
        stiffest = inertias[-1] * fastest_rad_s**2
        # Damping ratios from 0.005 of the slowest to 1 of the fastest.
        least_damping = 0.01 * inertias[0] * slowest_rad_s
        most_damping = 2 * inertias[-1] * fastest_rad_s
        axes = [
            log_axis("inertia_kg_m2", 0.02 * hub_inertia, 10 * hub_inertia),
            log_axis("stiffness_Nm_rad", softest, stiffest),
            log_axis("damping_Nms", least_damping, most_damping),
        ]
        resonances_rad_s = geometric(3 * slowest_rad_s, 0.6 * fastest_rad_s, 6)
        starts = []
        for inertia, omega in product(inertias, resonances_rad_s):
            starts.append((inertia, inertia * omega**2, 0.2 * inertia * omega))
        return cls._candidate(axes, starts)


@register
class TorqueRipple(Effect):
    """Extra motor torque a sin(N theta + p), theta the shaft angle; N counts per hub revolution."""

    id = "torque_ripple"
    law = ("joint", "torques", partial(SmoothTorque, SINE, at="shaft"))
    words = "torque ripple over the hub angle"
    check = "turn the hub slowly by hand with the motor off and feel for places where it sticks"
    harmonic = "hub_angle"

    amplitude_Nm: NotNegative = Field(description="amplitude a")
    cycles_per_rev: float = Field(ge=0, le=1e4, description="cycles N per hub revolution")
    phase_rad: float = Field(description="phase p at theta = 0")

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        """A search without starts: amplitude and phase follow by least squares for every number of cycles."""
        # Less than a quarter of a period looks like a spring or a constant torque; once per revolution is a
        # weight, whatever its direction.
        fewest = float(np.clip(0.5 * np.pi / scales.swing_rad, 2.0, 20.0))
        amplitude = log_axis("amplitude_Nm", 1e-6 * scales.torque_Nm, scales.torque_Nm)
        # Eighty cycles a turn: the teeth of a gear, or the poles of a motor behind one. Chosen.
        cycles = Axis("cycles_per_rev", "linear", fewest, 80.0, 1e-4, edge="low")
        return (cls._candidate([amplitude, cycles, PHASE]),)


@register
class PeriodicDisturbance(Effect):
    """Torque a sin(2 pi f t + p) from ground on the hub, t from the start of the record."""

    id = "periodic_disturbance"
    law = ("joint", "disturbance", Disturbance)
    words = "a periodic disturbance torque"
    check = "log the arm for half a minute at zero voltage: a disturbance from outside goes on"
    environment = True
    harmonic = "time"

    amplitude_Nm: NotNegative = Field(description="amplitude a")
    frequency_Hz: NotNegative = Field(description="frequency f")
    phase_rad: float = Field(description="phase p at the start of the record")

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        """A search without starts: amplitude and phase follow by least squares for every frequency."""
        # What shakes the hub may be stronger than what the motor was asked for.
        amplitude = log_axis("amplitude_Nm", 1e-6 * scales.torque_Nm, 10 * scales.torque_Nm)
        # From a third of a period in the longest record, which is hardly one, to Nyquist.
        lowest_Hz = 0.3 / scales.duration_s
        highest_Hz = 0.5 / scales.dt_s
        frequency = Axis("frequency_Hz", "linear", lowest_Hz, highest_Hz, 1e-5, edge="low")
        return (cls._candidate([amplitude, frequency, PHASE]),)


@register
class HardeningSpring(Effect):
    """Cubic spring from hub (motor side, with backlash) to ground, torque -k3 theta^3, no linear part."""

    id = "hardening_spring"
    law = ("joint", "torques", partial(SmoothTorque, CUBIC, at="motor"))
    words = "a hardening spring (cable, hose)"
    check = "pull the hub with a spring balance at small and at large angles and look for cables and hoses"
    absolute_angle = True
    # In stall torques at the largest angle of the records; starts 3.5 times apart.
    sought = (
        EffectParameter("cubic_Nm_rad3", 1e-7, 1e3, unit="torque_Nm/angle_rad^3", spread=(1e-5, 10, 12)),
    )

    cubic_Nm_rad3: NotNegative = Field(description="coefficient k3")


@register
class GroundSpring(Effect):
    """Linear spring from hub (motor side, with backlash) to ground, torque -k theta.

    At small angles that is the torque of gravity on a hanging link: no answer of a diagnosis, which needs it
    to tell gravity from what looks like it.
    """

    id = "ground_spring"
    law = ("joint", "ground_spring_Nm_rad", add)
    words = "a linear spring from hub to ground"
    look_alike_of = "gravity"

    stiffness_Nm_rad: NotNegative = Field(description="stiffness k")

    @classmethod
    def look_alike_scale(cls, rig: Rig) -> float:
        """Stiffness, N m/rad, by unit of gravity of a hanging link: its static moment, kg m."""
        return static_moment_kg_m(rig)


@register
class JointCompliance(Effect):
    """Torsion spring and damper, coaxial with the hub and without inertia, between hub and link root.

    The clamp, at the hub radius, turns about the hub axis by an extra angle; the hub angle stays the
    encoder's.
    """

    id = "joint_compliance"
    law = ("joint", "compliance", TorsionSpring)
    words = "a compliant joint between hub and link"
    check = "hold the hub and push the link sideways at its clamp: nothing should give"
    neutral = None  # the rigid joint is the limit of infinite stiffness

    stiffness_Nm_rad: Positive = Field(description="stiffness k")
    damping_Nms: NotNegative = Field(description="damping c")

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        """A search in multiples of the link's stiffness; a softer joint is a larger effect."""
        link_stiffness = scales.link_stiffness_Nm_rad
        axes = [
            log_axis("stiffness_Nm_rad", 0.05 * link_stiffness, 1e4 * link_stiffness),
            log_axis("damping_Nms", 1e-6 * link_stiffness, 100 * link_stiffness),
        ]
        # Damping in proportion to the stiffness: time constants, not torques.
        stiffnesses = geometric(0.2 * link_stiffness, 1e3 * link_stiffness, 12)
        time_constants_s = [3e-4, 3e-3, 2e-2]
        starts = []
        for stiffness, time_constant_s in product(stiffnesses, time_constants_s):
            starts.append((stiffness, time_constant_s * stiffness))
        return (cls._candidate(axes, starts, grows=False),)


@register
class BaseCompliance(Effect):
    """Hub axis and motor housing sit on a base that turns about the same axis, sprung and damped to ground.

    Motor torque, back-EMF, friction and ripple act between base and hub. The encoder reads hub minus base,
    tip_m uses the absolute hub angle.
    """

    id = "base_compliance"
    law = ("joint", "base", TorsionSpring)
    words = "a compliant base under the motor"
    check = "put a dial gauge on the base of the motor and shake the arm: nothing should move"
    neutral = None  # the fixed base is the limit of infinite stiffness

    stiffness_Nm_rad: Positive = Field(description="stiffness k to ground")
    damping_Nms: NotNegative = Field(description="damping c to ground")
    inertia_kg_m2: Positive = Field(description="inertia Jb of the base")

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        """A search by the base's resonance, damping ratio and inertia; a softer base is a larger effect."""
        link_stiffness = scales.link_stiffness_Nm_rad
        hub_inertia = scales.rig.hub.inertia_kg_m2
        axes = [
            log_axis("stiffness_Nm_rad", 1e-3 * link_stiffness, 1e5 * link_stiffness),
            log_axis("damping_Nms", 1e-6 * link_stiffness, 10 * link_stiffness),
            log_axis("inertia_kg_m2", 0.02 * hub_inertia, 300 * hub_inertia),
        ]
        # Outputs oscillate with the resonance, so that a search goes astray between far starts.
        resonances_Hz = geometric(1.0, 40.0, 14)
        damping_ratios = [0.02, 0.15]
        inertia_ratios = [0.5, 2.0, 8.0, 30.0]
        starts = []
        for resonance_Hz, damping_ratio, inertia_ratio in product(
            resonances_Hz, damping_ratios, inertia_ratios
        ):
            inertia = inertia_ratio * hub_inertia
            omega = 2 * np.pi * resonance_Hz
            starts.append((omega**2 * inertia, 2 * damping_ratio * omega * inertia, inertia))
        return (cls._candidate(axes, starts, grows=False),)


@register
class Backlash(Effect):
    """Backlash between motor side (30 % of J, friction, back-EMF, motor torque) and hub (70 % of J, link).

    They touch at a relative angle of +-gap/2 and start in the middle. The contact is a damped spring that
    only pushes: torque max(kc p + cc dp/dt, 0) at the penetration p, kc = 0.21 J (2 pi 180)^2, cc = 0.8
    sqrt(0.3 J kc). The encoder is on the hub.
    """

    id = "backlash"
    law = ("joint", "backlash_gap_rad", alone)
    words = "backlash in the gear"
    check = "hold the motor shaft and turn the hub to and fro by hand: the free play is the backlash"
    neutral = None  # without a gap the contact is still elastic
    dependence = "non-smooth"
    # In radians, as a gap belongs to a gear and not to a record; starts 1.25 times apart: outputs jump with
    # it.
    sought = (EffectParameter("gap_rad", 1e-5, 0.5, spread=(3e-4, 0.2, 30)),)

    gap_rad: Positive = Field(description="total gap")
