"""A case: a nominal rig and recorded experiments that it may or may not explain."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diagnosis.machine.flexible_arm import FlexibleArm
from diagnosis.machine.machine_protocol import Real, RecordedCase, Role, check_record
from diagnosis.machine.quantisation_grid import grid_step
from ident.data.arrays import lock
from plant.rig import Rig


@dataclass(frozen=True, eq=False)
class Experiment:
    """One record.

    name : str
    role : "estimation" or "held_out"
        Held-out records judge a repaired model; no parameter is fitted to them.
    voltage_V : (T,). Commanded voltage, held from its row to the next.
    output : (T, 2). hub_angle_rad, tip_m as measured.
    kind : str. Sort of input, in the words of whoever made the record; only shown.
    closed_loop : bool. The command came from a feedback. It is still the exact input of the actuator.
    """

    name: str
    role: Role
    voltage_V: Real
    output: Real
    kind: str = ""
    closed_loop: bool = False

    def __post_init__(self) -> None:
        lock(self, "voltage_V", "output")
        if self.voltage_V.ndim != 1:
            raise ValueError(f"experiment {self.name}: voltage_V must be (T,); got {self.voltage_V.shape}")
        check_record(self, ("hub_angle_rad", "tip_m"))

    @property
    def input(self) -> Real:
        """(T, 1) the voltage."""
        return self.voltage_V[:, None]


@dataclass(frozen=True, eq=False)
class Case(RecordedCase[Experiment]):
    """A rig as its makers know it, and what it did.

    Raises ValueError if there is no estimation or no held-out experiment, a name comes twice, or a noise
    level is zero (then nothing can be said to lie beyond the noise).
    """

    name: str
    rig: Rig
    experiments: tuple[Experiment, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not np.all(self.noise > 0):
            raise ValueError(f"case {self.name}: sensors need a noise level above zero to judge a gap by")

    @cached_property
    def steps(self) -> Real:
        """(2,) steps of the quantisation grids that the outputs of all records lie on; 0: on none."""
        outputs = [[e.output[:, k] for e in self.experiments] for k in range(2)]
        return np.array([grid_step(y, float(sigma)) for y, sigma in zip(outputs, self.noise, strict=True)])

    @property
    def machine(self) -> FlexibleArm:
        """The rig in the form that fits and evidence ask for (see `diagnosis.machine.machine_protocol`)."""
        return FlexibleArm(self.rig)
