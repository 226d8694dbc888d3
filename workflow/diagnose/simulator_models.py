"""Models of one's own simulation, opened beside logs: an MJCF model, an FMU or a Python file.

A model is opened in two steps. It names the inputs and outputs that the logs are read for; with what was read
it makes its `Plant`.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from diagnosis.answer import Diagnosis
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.own_plant import Plant, PlantExperiment
from diagnosis.machine.simulation import PythonFile, Simulation, plant_with_all
from ident.data.table import Table
from workflow.diagnose.simulator_logs import bare, column_of, refuse_other_unit, which_column
from workflow.diagnose.simulator_settings import KINDS, SimulatorSettings
from workflow.engine.errors import InputError
from workflow.text.formats import listing
from workflow.text.names import unit_of

if TYPE_CHECKING:
    from diagnosis.machine.mujoco_plant import MujocoArm

# Units of what moves.
_MOTIONS: Mapping[str, Literal["position", "speed"]] = {
    "m": "position",
    "rad": "position",
    "m/s": "speed",
    "rad/s": "speed",
}
# Units of what drives a body; a voltage or current does, where force follows it at once.
_DRIVES = ("N", "N m", "V", "A")
# What positions are logged in beside the unit of the model, and its size.
_OTHER_UNITS = {"rad": ("degrees", np.pi / 180), "m": ("millimetres", 1e-3)}
# Times the reach of a joint that a log may go: more is another unit. Units differ by 57 and more.
_FARTHER = 3


class OpenedModel(Protocol):
    """A model with the names that its logs are read for."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the commands."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of what is measured."""

    @property
    def doubts(self) -> tuple[str, ...]:
        """Sentences on what the logs leave open."""

    @property
    def is_tracked(self) -> bool:
        """Whether what was measured follows the commands in the inputs of its simulation."""

    @property
    def repairs(self) -> bool:
        """Whether it writes a repaired model."""

    def plant(self, experiments: Sequence[PlantExperiment], noise: Real) -> Plant:
        """The plant of these records and noise levels (Y,). Raises ValueError, one line."""

    def repaired(self, plant: Plant, diagnosis: Diagnosis, folder: Path) -> str:
        """Text of the repaired model, to be written into a folder."""


@dataclass(frozen=True, eq=False)
class SimulationModel:
    """An FMU or a Python file, with the listed effects around it."""

    simulation: Simulation
    settings: SimulatorSettings
    dt_s: float

    doubts = ()
    is_tracked = False
    repairs = False

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the simulation's inputs."""
        return self.simulation.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the simulation's outputs."""
        return self.simulation.outputs

    def plant(self, experiments: Sequence[PlantExperiment], noise: Real) -> Plant:
        """The plant, with effects of a body where a motion is stated, or its unit says one (see
        `plant_with_all`)."""
        stated = self.settings.motion
        motion = (self.outputs[0], stated) if stated else _motion_by_unit(self.inputs, self.outputs)
        return plant_with_all(
            self.simulation,
            experiments,
            noise,
            dt_s=self.dt_s,
            model_error=self.settings.model_error,
            motion=motion,
            motion_is_sure=stated is not None,
        )

    def repaired(self, plant: Plant, diagnosis: Diagnosis, folder: Path) -> str:
        """Raises NotImplementedError: effects act around the simulation, which stays as it is."""
        raise NotImplementedError("only an MJCF model is repaired")


@dataclass(frozen=True, eq=False)
class MjcfModel:
    """A MuJoCo model.

    arm : the model with the outputs that the logs have. inputs, outputs : their names in the logs, with their
    kind in front where several parts of the model have one name.
    """

    arm: MujocoArm
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    doubts: tuple[str, ...]
    settings: SimulatorSettings
    table: Table

    is_tracked = True
    repairs = True

    def plant(self, experiments: Sequence[PlantExperiment], noise: Real) -> Plant:
        """The plant. Raises InputError, one line, for columns that seem to be in another unit."""
        self._refuse_other_reach(experiments)
        stated = self.settings.tracking_rad_s
        tracking = self.arm.tracking(experiments) if stated is None else stated
        # A pattern for all of a place ("elbow.*") is no name.
        named = [
            pattern
            for pattern in self.settings.candidates
            if pattern.rpartition(".")[2] != "*" and "." in pattern
        ]
        arm = replace(self.arm, tracking_rad_s=tracking)
        return arm.plant(experiments, noise, model_error=self.settings.model_error, named=named)

    def repaired(self, plant: Plant, diagnosis: Diagnosis, folder: Path) -> str:
        """MJCF with the repair of a diagnosis; its validation records are keyframes."""
        return self.arm.repaired(plant, diagnosis.rig, diagnosis.repair, diagnosis.case.held_out, folder)

    def _refuse_other_reach(self, experiments: Sequence[PlantExperiment]) -> None:
        """Raises InputError where columns without a unit go farther than the model can, and in another unit
        would not."""
        largest = np.max([np.max(np.abs(e.input), axis=0) for e in experiments], axis=0)
        labels = (*self.inputs, *self.outputs)
        names = (*self.arm.inputs, *self.arm.outputs)
        doubtful: list[str] = []
        message = ""
        for label, name, size in zip(labels, names, largest, strict=True):
            reach, unit = self.arm.reaches.get(name, (np.inf, ""))
            column = column_of(label, self.table, self.settings)
            other_unit, scale = _OTHER_UNITS.get(unit, ("", 1.0))
            # Of a unit that is stated, and of what is not so far off, nobody need be asked.
            is_stated = column.scale is not None or self.table.unit(column.column)
            if is_stated or not size > _FARTHER * reach > _FARTHER * scale * size:
                continue
            doubtful.append(column.column)
            if len(doubtful) == 1:
                first = json.dumps(column.column)
                message = (
                    f"in {other_unit} ({column.column} up to {size:.3g}, the model {reach:.3g} {unit})? Say "
                    f"of each, in a case file: columns = {{{first} = "
                    f'{{column = "{column.column}", scale = {scale:.6g}}}}} '
                    "(1: in the model's unit)"
                )
        if doubtful:
            raise InputError(f"{self.table.path}: {listing(doubtful)} {message}")


def open_model(model: Path, tables: Sequence[Table], settings: SimulatorSettings, dt_s: float) -> OpenedModel:
    """The model that settings name, opened beside its logs of a sampling period [s].

    Raises ValueError or InputError, one line: a file that is none, a package that is missing, names that do
    not fit, a unit of time.
    """
    kind = next(kind for kind in KINDS if getattr(settings, kind))
    if kind == "mjcf":
        return _open_mjcf(model, tables, settings, dt_s)
    simulation: Simulation
    if kind == "fmu":
        _needs("fmpy")
        from diagnosis.machine.fmu_plant import Fmu

        simulation = Fmu(model, dt_s)
        refuse_other_unit(tables, settings, dt_s, simulation.step_s)
    else:
        simulation = PythonFile.read(model)
        refuse_other_unit(tables, settings, dt_s, None)
    return SimulationModel(simulation, settings, dt_s)


def _open_mjcf(model: Path, tables: Sequence[Table], settings: SimulatorSettings, dt_s: float) -> MjcfModel:
    """An MJCF model whose outputs are its sensors and joints that have a column."""
    _needs("mujoco")
    from diagnosis.machine.mujoco_model import names, read
    from diagnosis.machine.mujoco_plant import MujocoArm

    refuse_other_unit(tables, settings, dt_s, float(read(str(model)).option.timestep))
    table = tables[0]
    parts = names(str(model))
    kinds: dict[str, list[str]] = {}
    for kind, several in parts.items():
        for name in several:
            kinds.setdefault(name, []).append(kind)
    _refuse_ambiguous(kinds, table, settings)

    def label(kind: str, name: str) -> str:
        """The name, with its kind in front where other parts have it, too."""
        return f"{kind} {name}" if len(kinds.get(name, ())) > 1 else name

    # What the logs measure: columns of sensors and joints, but those that never change.
    measured = {label(kind, name): (kind, name) for kind in ("sensor", "joint") for name in parts[kind]}
    columns = {name: column_of(name, table, settings).column for name in measured}
    labels = tuple(name for name, column in columns.items() if column in table.names)
    dead = [name for name in labels if _never_changes(columns[name], tables)]
    doubts = []
    if dead and len(dead) < len(labels):
        doubts.append(f"columns that never change are left out: {', '.join(columns[name] for name in dead)}")
        warnings.warn(doubts[0], stacklevel=2)
        labels = tuple(name for name in labels if name not in dead)
    if not labels:
        raise ValueError(
            f"no column of {table.path.name} is named after a joint or sensor: "
            f"{which_column([*columns], table, settings)}"
        )

    # A joint beside a sensor of its name is known to the plant by its label, any other by its own name.
    outputs = []
    for output_label in labels:
        kind, name = measured[output_label]
        outputs.append(output_label if kind == "joint" and "sensor" in kinds[name] else name)
    arm = MujocoArm.from_file(str(model), outputs=tuple(outputs), dt_s=dt_s)
    commands = tuple(label("actuator", name) for name in arm.inputs)

    # Columns of the case file: each is of something, there, and of one thing only.
    unknown = [name for name in settings.columns if name not in (*commands, *measured, "time_s")]
    if unknown:
        raise ValueError(
            f"columns: no actuator, sensor or joint is called {unknown[0]!r}; there are "
            f"{', '.join((*commands, *measured))}"
        )
    absent = [name for name in settings.columns if name in measured and name not in (*labels, *dead)]
    if absent:
        raise ValueError(f"columns: {table.path} has no column {columns[absent[0]]!r} ({absent[0]})")
    for name in commands:
        command_column = column_of(name, table, settings).column
        outputs_of_column = [output for output in labels if columns[output] == command_column]
        if outputs_of_column:
            raise ValueError(
                f"column {command_column!r} is both {name} and {outputs_of_column[0]}: say which of the two"
            )

    known = {*arm.measured_joints, *dead}
    loose = [name for name in parts["joint"] if name not in known and name.partition(" ")[0] not in known]
    if loose:
        doubts.append(f"no column measures {listing(loose)}: simulated from where the model rests")
    return MjcfModel(arm, commands, labels, tuple(doubts), settings, table)


def _refuse_ambiguous(kinds: Mapping[str, Sequence[str]], table: Table, settings: SimulatorSettings) -> None:
    """Raises ValueError where a column has the name of several parts of the model.

    kinds : name -> kinds of parts (actuator, sensor, joint) that have it.
    """
    stated = {column.column for column in settings.columns.values()}
    unstated = [name for name in table.names if name not in stated]
    for name in [*settings.columns, *unstated, *(bare(column) for column in unstated)]:
        if len(kinds.get(name, ())) > 1:
            several = [f'"{kind} {name}" = ...' for kind in kinds[name]]
            raise ValueError(
                f"{name} is the name of {' and '.join(kinds[name])}: say which is which, "
                f"columns = {{{', '.join(several)}}}"
            )


def _never_changes(column: str, tables: Sequence[Table]) -> bool:
    """Whether a column has one value throughout every log."""
    return all(np.ptp(table.columns([column])[column]) == 0 for table in tables)


def _needs(package: str) -> None:
    """Raises ValueError, one line with the command that mends it, where a package is not installed."""
    if find_spec(package) is None:
        raise ValueError(f"needs the package {package}: {sys.executable} -m pip install {package}")


def _motion_by_unit(
    inputs: Sequence[str], outputs: Sequence[str]
) -> tuple[str, Literal["position", "speed"]] | None:
    """Output that is the motion of a body, and what it is, by its unit.

    It is the only one that is a position or a speed, where the first input is what drives a body; else None.
    """
    moving = {name: _MOTIONS[unit_of(name)] for name in outputs if unit_of(name) in _MOTIONS}
    if len(moving) != 1 or unit_of(inputs[0]) not in _DRIVES:
        return None
    return next(iter(moving.items()))
