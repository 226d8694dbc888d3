"""A flexible link on a motor, described by a rig, as a machine the diagnosis can ask."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diagnosis.machine.candidates import Candidate, candidates
from diagnosis.machine.machine_protocol import Real, Weighing
from plant.effects import Effect
from plant.rig import Rig
from plant.simulate import Simulator

if TYPE_CHECKING:
    from diagnosis.machine.case import Case

_WEIGHING = Weighing()


@dataclass(frozen=True, eq=False)
class FlexibleArm:
    """A rig with the registry of `plant.effects`: voltage (T, 1) -> hub_angle_rad, tip_m."""

    rig: Rig

    @property
    def output_names(self) -> tuple[str, ...]:
        return ("hub_angle_rad", "tip_m")

    @property
    def noise(self) -> Real:
        sensors = self.rig.sensors
        return np.array([sensors.hub_angle_noise_rad, sensors.tip_noise_m])

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
        return FlexibleArm(self.rig.scaled(factors))

    def simulator(self, effects: Sequence[Effect]) -> Callable[[Real], Real]:
        prepared = Simulator(self.rig, effects)
        return lambda inputs: prepared.run(inputs[:, 0]).output

    def candidates(self, case: Case) -> tuple[Candidate, ...]:
        return candidates(case)
