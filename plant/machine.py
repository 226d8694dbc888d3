"""A machine: the rig together with everything an effect can change, as one frozen description.

An effect is a function Machine -> Machine (see `plant.effects`). The description is physical, not
numerical: matrices are made from it in `plant.modal`, arrays for the stepper in `plant.plan`. Every default
means "as nominal". `Machine` has a rig and three paths: from commanded to acting voltage, from voltage to
link root (the joint), and from tip to reading (the sensor).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, TypeVar, cast

import numpy as np
import numpy.typing as npt

from plant.rig import Rig

# Labels of the laws of smooth forces of a position or speed y, with parameters p. `plant.force_laws` computes
# those that any moving body may feel, `plant.kernel` the two that need more than y.
# Ripple p0 sin(p1 y + p2): y the shaft angle, rad, p0 in N m.
SINE = 0
# Cubic spring -p0 y^3: y an angle, rad, p0 in N m/rad^3.
CUBIC = 1
# What dry friction has above its Coulomb level while it slips, p0 exp(-|y| / p1): y a speed, rad/s, p0 in N
# m. In `plant.kernel`: its direction is that of the element that slips.
STRIBECK = 2
# Gravity on link and tip mass: p0 in m/s^2, p1 the static moment, kg m, p2 the hub angle of hanging, rad. In
# `plant.kernel`: it acts on the bending of the link, too.
GRAVITY = 3
# Drag -p0 y |y|: y a speed, rad/s, p0 in N m s^2/rad^2.
QUADRATIC = 4
# Linear spring or damper -p0 y: y an angle, rad, or a speed, rad/s.
LINEAR = 5
# Drag that has one direction, -p0 |y|: y a speed, rad/s, p0 in N m s/rad.
ABSOLUTE = 6
# Weight off the axis, -p0 (sin(y + p1) - sin(p1)): y an angle, rad, zero force at y = 0, p0 in N m.
OFF_AXIS = 7

Real = npt.NDArray[np.float64]
Integer = npt.NDArray[np.int64]
Signal = TypeVar("Signal", float, Real)


@dataclass(frozen=True)
class VoltagePath:
    """From the commanded to the acting voltage, in this order: delay, gain, dead zone, saturation, lag."""

    delay_s: float = 0.0
    gain: float = 1.0
    dead_zone_V: float = 0.0
    limit_V: float = float("inf")
    lag_s: float = 0.0

    def static(self, voltage_V: Signal) -> Signal:
        """Voltage behind gain, dead zone and saturation, the memoryless part of the path.

        Parameters
        ----------
        voltage_V : float or (T,)
            As commanded.

        Returns
        -------
        float or (T,)
            Like the argument, V; delay and lag are not in it.
        """
        value = self.gain * voltage_V
        # One sample: numpy's functions would take five times as long.
        if isinstance(value, float):
            acting = min(max(abs(value) - self.dead_zone_V, 0.0), self.limit_V)
            return math.copysign(acting, value)
        size = np.minimum(np.maximum(np.abs(value) - self.dead_zone_V, 0.0), self.limit_V)
        return cast(Signal, np.copysign(size, value))


@dataclass(frozen=True)
class DryFriction:
    """Dry friction of the level Tc + (Ts - Tc) exp(-|omega| / vs) with elastic pre-sliding.

    static_torque_Nm : float. Ts, held at rest.
    coulomb_torque_Nm : float. Tc, left at high speed.
    stribeck_velocity_rad_s : float. vs, over which the excess falls.
    """

    static_torque_Nm: float
    coulomb_torque_Nm: float
    stribeck_velocity_rad_s: float

    # Deflection of the stuck joint at break-away, rad: a hundredth of the encoder noise of the paper's link,
    # so that rest looks like rest. Smaller is stiffer, and needs shorter steps (`plant.plan`).
    PRE_SLIDING_RAD = 1e-5

    @property
    def stiffness_Nm_rad(self) -> float:
        """Stiffness of the stuck joint, N m/rad."""
        return self.static_torque_Nm / self.PRE_SLIDING_RAD


@dataclass(frozen=True)
class SmoothTorque:
    """A torque (hub side of the gear) that is a smooth function of one angle, or of one speed.

    law : int
        Label of the function above, of those in `plant.force_laws`.
    values : tuple of float
        Its one to three parameters p0, p1, p2; p0 is the size, and 0 is no torque.
    at : str
        What it acts on and depends on: "shaft", from housing to shaft, or "motor", from ground on the motor
        side of the hub.
    of : str
        Whether it depends on the angle or on the speed there.
    """

    law: int
    values: tuple[float, ...]
    at: Literal["shaft", "motor"]
    of: Literal["angle", "speed"] = "angle"


@dataclass(frozen=True)
class Disturbance:
    """Torque a sin(2 pi f t + phase) from ground on the hub."""

    amplitude_Nm: float
    frequency_Hz: float
    phase_rad: float


@dataclass(frozen=True)
class TorsionSpring:
    """A torsion spring and damper, with the inertia of what it carries (0 where it carries none)."""

    stiffness_Nm_rad: float
    damping_Nms: float
    inertia_kg_m2: float = 0.0


@dataclass(frozen=True)
class JointPath:
    """What acts between voltage and link root.

    friction : dry friction from housing to shaft.
    torques : smooth nonlinear torques.
    disturbance : sinusoidal torques from ground on the hub.
    ground_spring_Nm_rad : stiffness of a linear spring from ground to the motor side of the hub.
    compliance : spring between hub and link root, or None where the link is clamped rigidly.
    base : spring between ground and motor housing, which carries the base, or None where it stands firmly.
    attached : spring between hub and a body about its axis, or None where there is no such body.
    backlash_gap_rad : total gap between motor side and hub, or None without a gap.
    """

    friction: tuple[DryFriction, ...] = ()
    torques: tuple[SmoothTorque, ...] = ()
    disturbance: tuple[Disturbance, ...] = ()
    ground_spring_Nm_rad: float = 0.0
    compliance: TorsionSpring | None = None
    base: TorsionSpring | None = None
    attached: TorsionSpring | None = None
    backlash_gap_rad: float | None = None


@dataclass(frozen=True)
class SensorPath:
    """The tip sensor, in this order: lag, gain, drift, noise, quantisation; of other sensors the gain."""

    lag_s: float = 0.0
    gain: float = 1.0
    drift_m_s: float = 0.0
    step_m: float = 0.0


@dataclass(frozen=True)
class Machine:
    """The rig (its parameters already changed by parametric effects) and the paths around it.

    gravity_m_s2 : float. Component of gravity in the plane of motion.
    gravity_direction_rad : float. Hub angle at which the link hangs.
    """

    rig: Rig
    voltage: VoltagePath = field(default_factory=VoltagePath)
    joint: JointPath = field(default_factory=JointPath)
    sensor: SensorPath = field(default_factory=SensorPath)
    gravity_m_s2: float = 0.0
    gravity_direction_rad: float = 0.0

    @property
    def linear(self) -> bool:
        """Whether the outputs, noise aside, are linear in voltage and forces from outside."""
        voltage = self.voltage
        joint = self.joint
        sensor = self.sensor
        bent_path = voltage.dead_zone_V > 0 or voltage.limit_V < float("inf") or sensor.step_m > 0
        bent_joint = bool(joint.friction or joint.torques or joint.backlash_gap_rad)
        # Affine, not linear: they move the outputs without any voltage.
        from_outside = joint.disturbance or sensor.drift_m_s or self.gravity_m_s2
        return not (bent_path or bent_joint or from_outside)
