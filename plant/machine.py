"""A machine: the rig together with everything an effect can change, as one frozen description.

An effect is a function Machine -> Machine (see `plant.effects`). The description is physical, not
numerical: matrices are made from it in `plant.modal`, arrays for the stepper in `plant.plan`. Every default
means "as nominal".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, TypeVar, cast

import numpy as np
import numpy.typing as npt

from plant.rig import Rig

SINE, CUBIC, STRIBECK, GRAVITY, QUADRATIC = 0, 1, 2, 3, 4  # smooth forces of `plant.kernel`

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
        """The memoryless part: gain, dead zone, saturation."""
        value = self.gain * voltage_V
        if isinstance(value, float):  # sample by sample: numpy's functions take five times as long
            acting = min(max(abs(value) - self.dead_zone_V, 0.0), self.limit_V)
            return math.copysign(acting, value)
        size = np.minimum(np.maximum(np.abs(value) - self.dead_zone_V, 0.0), self.limit_V)
        return cast(Signal, np.copysign(size, value))


@dataclass(frozen=True)
class DryFriction:
    """Dry friction of the level Tc + (Ts - Tc) exp(-|omega| / vs) with elastic pre-sliding."""

    static_torque_Nm: float
    coulomb_torque_Nm: float
    stribeck_velocity_rad_s: float

    PRE_SLIDING_RAD = 1e-5

    @property
    def stiffness_Nm_rad(self) -> float:
        return self.static_torque_Nm / self.PRE_SLIDING_RAD


@dataclass(frozen=True)
class SmoothTorque:
    """A torque (hub side of the gear) that is a smooth function of one angle, or of one speed.

    law: how, one of the smooth forces of `plant.kernel`. values: its parameters, the size first; 0 is no
    torque. at: what it acts on and depends on: "shaft", from housing to shaft, or "motor", from ground on the
    motor side of the hub.
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
    """What acts between voltage and link root."""

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
    """The rig (its parameters already changed by parametric effects) and the paths around it."""

    rig: Rig
    voltage: VoltagePath = field(default_factory=VoltagePath)
    joint: JointPath = field(default_factory=JointPath)
    sensor: SensorPath = field(default_factory=SensorPath)
    gravity_m_s2: float = 0.0
    gravity_direction_rad: float = 0.0

    @property
    def linear(self) -> bool:
        """Whether the outputs, noise aside, are linear in voltage and forces from outside."""
        voltage, joint, sensor = self.voltage, self.joint, self.sensor
        bent = voltage.dead_zone_V > 0 or voltage.limit_V < float("inf") or sensor.step_m > 0
        bent = bent or bool(joint.friction or joint.torques or joint.backlash_gap_rad)
        return not (bent or joint.disturbance or sensor.drift_m_s or self.gravity_m_s2)
