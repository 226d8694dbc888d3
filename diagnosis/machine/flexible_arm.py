"""A flexible link on a motor, described by a rig, as a machine the diagnosis can ask."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from diagnosis.machine.machine_protocol import Real, RecordOfMachine, Weighing
from plant.effects import EFFECTS, Effect
from plant.effects.search_space import Candidate, Scales
from plant.rig import Rig
from plant.simulate import Simulator

Output = Literal["hub_angle_rad", "tip_m", "tip_acceleration_m_s2"]
"""What a flexible link can be measured by, in the order of a record's columns."""

NOISE: dict[Output, str] = {
    "hub_angle_rad": "hub_angle_noise_rad",
    "tip_m": "tip_noise_m",
    "tip_acceleration_m_s2": "tip_acceleration_noise_m_s2",
}
_TIP: Output = "tip_m"
_ACCELERATION: Output = "tip_acceleration_m_s2"
_WEIGHING = Weighing()
_SPEED_SAMPLES = 10


@dataclass(frozen=True, eq=False)
class FlexibleArm:
    """A rig with the registry of `plant.effects`: voltage (T, 1) -> the outputs (T, Y) that are measured."""

    rig: Rig
    outputs: tuple[Output, ...] = ("hub_angle_rad", "tip_m")

    @property
    def noise(self) -> Real:
        return np.array([self.rig.value(f"sensors.{NOISE[name]}") for name in self.outputs])

    @property
    def tolerances(self) -> Mapping[str, float]:
        return self.rig.tolerances

    @property
    def weighing(self) -> Weighing:
        return _WEIGHING

    @property
    def description(self) -> Rig:
        return self.rig

    def scaled(self, factors: Mapping[str, float]) -> FlexibleArm:
        return FlexibleArm(self.rig.scaled(factors), self.outputs)

    def simulator(self, effects: Sequence[Effect]) -> Callable[[Real], Real]:
        prepared = Simulator(self.rig, effects, accelerometer=_ACCELERATION in self.outputs)
        return lambda inputs: prepared.run(inputs[:, 0]).columns(self.outputs)

    def candidates(self, experiments: Sequence[RecordOfMachine]) -> tuple[Candidate, ...]:
        """Every effect of the registry that a fit can find; signed ones twice. Those on the sensor of tip_m
        only where it is measured."""
        scales = scales_of(self.rig, experiments)
        seen = [effect for effect in EFFECTS.values() if effect.group != "sensor" or _TIP in self.outputs]
        return tuple(found for effect in seen for found in effect.candidates(scales))


def scales_of(rig: Rig, experiments: Sequence[RecordOfMachine]) -> Scales:
    """Magnitudes of the largest motion in the records; speeds are means over ten samples."""
    angles = [e.output[:, 0] for e in experiments]
    k, dt = _SPEED_SAMPLES, rig.sampling.dt_s
    return Scales(
        rig,
        voltage_V=max(float(np.max(np.abs(e.input))) for e in experiments),
        angle_rad=max(float(np.max(np.abs(angle))) for angle in angles),
        swing_rad=max(float(np.ptp(angle)) for angle in angles),
        speed_rad_s=max(float(np.max(np.abs(angle[k:] - angle[:-k]))) / k for angle in angles) / dt,
        duration_s=max(len(e.input) for e in experiments) * dt,
    )
