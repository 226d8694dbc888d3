"""A case: a nominal rig and recorded experiments that it may or may not explain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy

from diagnosis.machine.machine_protocol import Real, RecordedCase, Role, check_record
from diagnosis.machine.quantisation_grid import grid_step
from ident.data.arrays import lock
from ident.data.keywords import clear_constructor
from plant.rig import Output, Rig

if TYPE_CHECKING:
    from diagnosis.machine.flexible_arm import FlexibleArm


@clear_constructor
@dataclass(frozen=True, eq=False)
class Experiment:
    """One record of a flexible link.

    Parameters
    ----------
    name : str
        By which answers name the record.
    role : "estimation" or "validation" (kept as "held_out")
        No parameter is fitted to validation records.
    voltage_V : (T,)
        Commanded voltage, held from its row to the next.
    output : (T, Y)
        The outputs as measured, at the instants at which the voltage changes.
    kind : str
        Kind of input, free text for the page.
    closed_loop : bool
        The command came from a controller; it is still the exact input of the actuator.
    outputs : (Y,) names
        Of the columns, the hub angle first; they end with their units.
    reference_rad : (T,) or None
        What the controller was to follow, in the zero of the encoder.
    missing : tuple of int
        Rows that the log lacks; their values are interpolated.
    readings : (R, Y) or None
        The outputs' values before any interpolation, for the steps of their sensors; None: `output`.
    first_row : int
        Of the run that the record is a part of; disturbances and drifts began with the run.
    beside : mapping
        Name -> (T,) signals of the log that the rig does not use, as a load.

    Raises
    ------
    ValueError
        One line: a shape that does not fit, a value that is not finite, fewer than 20 samples, an output that
        never moves. Arrays are copied and cannot be written to.

    Examples
    --------
    >>> voltage = flexlink.prbs(8, 4, 6.0, 600)
    >>> run = flexlink.simulate(flexlink.paper_link(), voltage, rng=default_rng(1))
    >>> flexlink.Experiment("prbs", "estimation", run.voltage_V, run.output).outputs
    ('hub_angle_rad', 'tip_m')
    """

    name: str
    role: Role
    voltage_V: Real
    output: Real
    kind: str = ""
    closed_loop: bool = False
    outputs: tuple[Output, ...] = ("hub_angle_rad", "tip_m")
    reference_rad: Real | None = None
    missing: tuple[int, ...] = ()
    readings: Real | None = None
    first_row: int = 0
    beside: Mapping[str, Real] = field(default_factory=dict)

    def __post_init__(self) -> None:
        lock(self, "voltage_V", "output")
        if self.reference_rad is not None:
            lock(self, "reference_rad")
        if self.readings is not None:
            lock(self, "readings")
        if self.voltage_V.ndim != 1:
            raise ValueError(f"experiment {self.name}: voltage_V must be (T,); got {self.voltage_V.shape}")
        check_record(self, self.outputs)
        signals = dict(self.beside)
        if self.reference_rad is not None:
            signals["reference_rad"] = self.reference_rad
        for name, signal in signals.items():
            if np.shape(signal) != self.voltage_V.shape or not np.all(np.isfinite(signal)):
                raise ValueError(
                    f"experiment {self.name}: {name} must be finite and ({self.voltage_V.size},) like "
                    f"voltage_V; got {np.shape(signal)}"
                )
        outside = [row for row in self.missing if not 0 <= row < self.voltage_V.size]
        if outside:
            raise ValueError(
                f"experiment {self.name}: row {outside[0]} is missing, but rows are 0 to "
                f"{self.voltage_V.size - 1}"
            )

    @property
    def input(self) -> Real:
        """(T, 1) the voltage."""
        return self.voltage_V[:, None]

    def part(self, name: str, role: Role, first: int, end: int) -> Experiment:
        """Its rows from `first` up to `end`, which is not one of them, as a record of its own.

        Its readings stay those of the whole record: the step of a sensor is that of all of them.
        """
        reference = None
        if self.reference_rad is not None:
            reference = self.reference_rad[first:end]
        return replace(
            self,
            name=name,
            role=role,
            voltage_V=self.voltage_V[first:end],
            output=self.output[first:end],
            reference_rad=reference,
            missing=tuple(row - first for row in self.missing if first <= row < end),
            first_row=self.first_row + first,
            beside={name: signal[first:end] for name, signal in self.beside.items()},
        )


@clear_constructor
@dataclass(frozen=True, eq=False, repr=False)
class Case(RecordedCase[Experiment]):
    """A rig as its maker knows it, and records of the machine.

    Parameters
    ----------
    name : str
        Stands on the page and in names of files.
    rig : Rig
        Nominal values with their tolerances.
    experiments : tuple of Experiment
        Its records: at least one for estimation and one for validation.
    model_error : float
        Share of the motion (RMS of an output about its mean) that a good model may miss; zero where the
        simulation is as good as the sensors.

    Raises
    ------
    ValueError
        One line: no estimation or no held-out experiment, a name that comes twice, experiments that differ
        in their outputs, or a noise level of zero.

    Examples
    --------
    >>> case = example_case()
    >>> case.name, [experiment.role for experiment in case.experiments]
    ('arm', ['estimation', 'held_out'])
    """

    name: str
    rig: Rig
    experiments: tuple[Experiment, ...]
    model_error: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        outputs = {e.outputs for e in self.experiments}
        if len(outputs) > 1 or self.outputs[0] != "hub_angle_rad":
            raise ValueError(
                f"case {self.name}: all experiments need the same outputs, the hub angle first; got "
                f"{sorted(outputs)}"
            )
        for name, level in zip(self.outputs, self.noise, strict=True):
            if not level > 0:
                from diagnosis.machine.flexible_arm import NOISE  # what simulates takes seconds to load

                raise ValueError(
                    f"case {self.name}: sensors.{NOISE[name]} is {level:g}; {name} needs a noise level above "
                    "zero to judge a gap by"
                )

    def at_fast_lengths(self) -> Case:
        """The case with its records cut at their ends to lengths at which a cosine transform is fast.

        Those have no large prime factors (`scipy.fft.prev_fast_len`): a record of 209 rows keeps 200, the
        most that one of hundreds loses; of a thousand and more it is 2.2 % at most.
        """
        parts = []
        for e in self.experiments:
            length = scipy.fft.prev_fast_len(len(e.output))
            parts.append(e.part(e.name, e.role, 0, length))
        return replace(self, experiments=tuple(parts))

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Names of the outputs of every experiment."""
        return self.experiments[0].outputs

    @property
    def dt_s(self) -> float:
        """Sampling period of the records, s."""
        return self.rig.sampling.dt_s

    @cached_property
    def steps(self) -> Real:
        """(Y,) steps of the quantisation grids on which the outputs of all records lie, in their units; 0: on
        none."""
        readings = [e.output if e.readings is None else e.readings for e in self.experiments]
        steps = []
        for column, noise in enumerate(self.noise):
            steps.append(grid_step([of_record[:, column] for of_record in readings], float(noise)))
        return np.array(steps)

    @property
    def machine(self) -> FlexibleArm:
        """The rig in the form that fits and evidence ask for (see `diagnosis.machine.machine_protocol`)."""
        from diagnosis.machine.flexible_arm import FlexibleArm

        return FlexibleArm(self.rig, self.outputs, self.model_error)
