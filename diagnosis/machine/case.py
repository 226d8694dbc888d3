"""A case: a nominal rig and recorded experiments that it may or may not explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from diagnosis.machine.flexible_arm import FlexibleArm
from diagnosis.machine.machine_protocol import RecordOfMachine
from diagnosis.machine.quantisation_grid import lattice_step
from plant.rig import Rig

Real = npt.NDArray[np.float64]
Role = Literal["estimation", "held_out"]


@dataclass(frozen=True, eq=False)
class Experiment:
    """One record.

    Attributes
    ----------
    name : str
    role : "estimation" or "held_out"
        Held-out records judge a repaired model; no parameter is fitted to them.
    voltage_V : (T,)
        Commanded voltage, held from its row to the next.
    output : (T, 2)
        hub_angle_rad, tip_m as measured.
    kind : str
        Sort of input, in the words of whoever made the record; only shown.
    closed_loop : bool
        The command came from a feedback. It is still the exact input of the actuator.
    """

    name: str
    role: Role
    voltage_V: Real
    output: Real
    kind: str = ""
    closed_loop: bool = False

    def __post_init__(self) -> None:
        voltage = np.array(self.voltage_V, dtype=np.float64)
        output = np.array(self.output, dtype=np.float64)
        if voltage.ndim != 1 or output.shape != (voltage.size, 2):
            raise ValueError(
                f"experiment {self.name}: needs voltage_V (T,) and output (T, 2); got {voltage.shape} and "
                f"{output.shape}"
            )
        if self.role not in ("estimation", "held_out"):
            raise ValueError(
                f"experiment {self.name}: role must be estimation or held_out; got {self.role!r}"
            )
        if not (np.all(np.isfinite(voltage)) and np.all(np.isfinite(output))):
            raise ValueError(f"experiment {self.name}: a value is not finite")
        if voltage.size < 20:
            raise ValueError(f"experiment {self.name}: {voltage.size} samples, needs at least 20")
        for column, name in zip(output.T, ("hub_angle_rad", "tip_m"), strict=True):
            if np.ptp(column) == 0:
                raise ValueError(
                    f"experiment {self.name}: {name} is {column[0]:.6g} throughout: is the sensor dead?"
                )
        voltage.setflags(write=False)
        output.setflags(write=False)
        object.__setattr__(self, "voltage_V", voltage)
        object.__setattr__(self, "output", output)

    @property
    def input(self) -> Real:
        """(T, 1) the voltage."""
        return self.voltage_V[:, None]


def check_names_and_roles(case: str, experiments: Sequence[RecordOfMachine]) -> None:
    """Every name once, both roles there; ValueError otherwise."""
    names = [experiment.name for experiment in experiments]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"case {case}: experiment {name} is given twice")
    for role in ("estimation", "held_out"):
        if not any(experiment.role == role for experiment in experiments):
            raise ValueError(f"case {case}: no experiment has the role {role}")


@dataclass(frozen=True, eq=False)
class Case:
    """A rig as its makers know it, and what it did.

    Raises
    ------
    ValueError
        If there is no estimation or no held-out experiment, a name comes twice, or a noise level is zero
        (then nothing can be said to lie beyond the noise).
    """

    name: str
    rig: Rig
    experiments: tuple[Experiment, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "experiments", tuple(self.experiments))
        check_names_and_roles(self.name, self.experiments)
        if not np.all(self.noise > 0):
            raise ValueError(f"case {self.name}: sensors need a noise level above zero to judge a gap by")

    @property
    def noise(self) -> Real:
        """(2,) noise standard deviations of hub_angle_rad and tip_m."""
        return self.machine.noise

    @cached_property
    def steps(self) -> Real:
        """(2,) steps of the lattice that all records of an output lie on, 0 where they lie on none."""
        return np.array(
            [
                lattice_step([e.output[:, k] for e in self.experiments], float(sigma))
                for k, sigma in enumerate(self.noise)
            ]
        )

    @property
    def machine(self) -> FlexibleArm:
        """The rig in the form the engine asks for (see `diagnosis.machine.machine_protocol`)."""
        return FlexibleArm(self.rig)

    @property
    def estimation(self) -> tuple[Experiment, ...]:
        return tuple(e for e in self.experiments if e.role == "estimation")

    @property
    def held_out(self) -> tuple[Experiment, ...]:
        return tuple(e for e in self.experiments if e.role == "held_out")
