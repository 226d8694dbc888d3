"""Cases as files: `case.toml`, or a TOML file like it beside a user's own logs (docs/case_files.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from diagnosis.machine.case import Case, Experiment
from ident.data.record import Record
from plant.effects import EFFECTS
from plant.rig import Rig
from workflow.config.settings import Section, check, expand, read_toml
from workflow.engine import storage
from workflow.engine.errors import InputError, naming
from workflow.engine.run_directory import hash_of

CASE_FILE = "case.toml"
RIG_FILE = "rig.toml"

# Names of pages and files in the output directory that no case may take.
_TAKEN_NAMES = ("index", "diagnose")
# Time stamps are written with a few digits; a rig with another sampling period is off by far more.
_SAMPLING_TOLERANCE = 1e-3


class Column(Section):
    """Where a quantity stands in a log: quantity = scale * column + offset."""

    column: str = Field(min_length=1, description="name of the column")
    scale: float = Field(1.0, description="unit of the quantity per unit of the column; not 0")
    offset: float = Field(0.0, description="added after scaling, in the unit of the quantity")


def _column(value: object) -> object:
    return {"column": value} if isinstance(value, str) else value


def _moves(column: Column) -> Column:
    if column.scale == 0:
        raise ValueError("scale must not be 0")
    return column


ColumnChoice = Annotated[Column, BeforeValidator(_column), AfterValidator(_moves)]


class Columns(Section):
    """Which column holds which quantity; what is left out keeps its default."""

    time_s: str | None = Field(None, min_length=1, description="time column [s]")
    voltage_V: ColumnChoice | None = Field(None, description="commanded voltage")
    hub_angle_rad: ColumnChoice | None = Field(None, description="hub angle")
    tip_m: ColumnChoice | None = Field(None, description="tip position, arc plus deflection")


class ExperimentEntry(Section):
    """One log."""

    file: str = Field(min_length=1, description="log file, relative to the case file")
    role: Literal["estimation", "held_out"]
    kind: str = ""
    samples: int | None = Field(None, ge=1, description="rows the file must have")
    closed_loop: bool = False
    description: str = ""
    columns: Columns = Field(default_factory=Columns)


def _known_effect(name: str) -> str:
    if name not in EFFECTS:
        close = get_close_matches(name, EFFECTS, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"known effects: {', '.join(EFFECTS)}"
        raise ValueError(f"no such effect {name!r} ({hint})")
    return name


class CaseSettings(Section):
    """A case file."""

    case: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=80)] | None = Field(
        None, description="names the output files; letters, digits, '_', '-' and '.'"
    )
    rig: str = Field(RIG_FILE, min_length=1, description="rig file, relative to the case file")
    dt_s: float | None = Field(None, gt=0, description="sampling period of logs without a time column [s]")
    suspected: tuple[Annotated[str, AfterValidator(_known_effect)], ...] = ()
    columns: Columns = Field(default_factory=Columns)
    experiments: tuple[ExperimentEntry, ...] = Field(min_length=1)


@dataclass(frozen=True, eq=False)
class LoadedCase:
    """A case with what its files said beside the numbers.

    rig_file : str. Name of the rig file that was read.
    descriptions : dict. Free words per experiment.
    suspected : tuple of str. Effects that whoever wrote the case file asks about.
    input_sha256 : str
        Over the contents of every file that was read, under their names; equal inputs, equal hash.
    """

    case: Case
    rig_file: str
    descriptions: Mapping[str, str]
    suspected: tuple[str, ...]
    input_sha256: str


def load_case(place: Path, rig: str | None = None) -> LoadedCase:
    """Read a case folder or case file; `rig` replaces the rig file named there (default rig.toml).

    Raises InputError: one line naming the file, and the key or line in it: no such case or file, TOML that
    cannot be read, an unknown key, role or effect, a column that is missing or not finite, a sensor that is
    dead, records whose sampling the rig file contradicts, no experiment held out.
    """
    file = place if place.is_file() else place / CASE_FILE
    if not file.is_file():
        raise InputError(
            f"{place}: no case is there; expected a folder with {CASE_FILE}, or a TOML file like it"
        )
    folder = file.parent
    _, content = read_toml(file)
    settings = check(CaseSettings, content, source=str(file))
    name = settings.case or (folder.resolve().name if file.name == CASE_FILE else file.stem)
    if name in _TAKEN_NAMES:
        raise InputError(f"{file}: case: {name!r} is the name of a file of the overview; choose another")
    rig_path = folder / (rig or settings.rig)
    machine = _rig(rig_path)
    experiments = [
        _experiment(file, i, entry, settings, machine) for i, entry in enumerate(settings.experiments)
    ]
    with naming(str(file)):
        case = Case(name, machine, tuple(experiments))
    files = {CASE_FILE: file, RIG_FILE: rig_path}
    files |= {f"{i}": folder / expand(entry.file) for i, entry in enumerate(settings.experiments)}
    hashes = {key: storage.sha256_of_file(path) for key, path in files.items()}
    return LoadedCase(
        case=case,
        rig_file=rig_path.name,
        descriptions={e.name: s.description for e, s in zip(experiments, settings.experiments, strict=True)},
        suspected=settings.suspected,
        input_sha256=hash_of({"name": name, **hashes}),
    )


def _rig(path: Path) -> Rig:
    if not path.is_file():
        beside = sorted(p.name for p in path.parent.glob("*.toml") if p.name != CASE_FILE)
        found = f"; beside it: {', '.join(beside)}" if beside else ""
        raise InputError(f"{path}: no such rig file{found}")
    with naming(str(path)):
        return Rig.from_toml(path)


def _experiment(
    file: Path, index: int, entry: ExperimentEntry, settings: CaseSettings, rig: Rig
) -> Experiment:
    with naming(f"{file}: experiments[{index}].file"):
        path = file.parent / expand(entry.file)
    if not path.is_file():
        raise InputError(f"{file}: experiments[{index}].file: no such file: {path}")
    names = {
        quantity: getattr(entry.columns, quantity)
        or getattr(settings.columns, quantity)
        or Column(column=quantity)
        for quantity in ("voltage_V", "hub_angle_rad", "tip_m")
    }
    own_time = entry.columns.time_s or settings.columns.time_s
    time = own_time or (None if settings.dt_s is not None else "time_s")
    hub, tip = names["hub_angle_rad"], names["tip_m"]
    if hub.column == tip.column:
        raise InputError(f"{file}: experiments[{index}]: hub_angle_rad and tip_m are both {hub.column!r}")
    with naming(str(path)):
        record = Record.from_file(
            path, [names["voltage_V"].column], [hub.column, tip.column], time=time, dt_s=settings.dt_s
        )
    stated = rig.sampling.dt_s
    if not abs(record.dt_s - stated) <= _SAMPLING_TOLERANCE * stated:
        raise InputError(
            f"{path}: sampled every {record.dt_s:.6g} s, but the rig file states sampling.dt_s = {stated:.6g}"
        )
    if entry.samples is not None and entry.samples != record.n_samples:
        raise InputError(
            f"{file}: experiments[{index}].samples: {entry.samples} stated, {path} has {record.n_samples}"
        )
    output = np.column_stack(
        [column.scale * record.output[:, i] + column.offset for i, column in enumerate((hub, tip))]
    )
    voltage = names["voltage_V"].scale * record.input[:, 0] + names["voltage_V"].offset
    with naming(str(path)):
        return Experiment(
            name=path.stem,
            role=entry.role,
            voltage_V=voltage,
            output=output,
            kind=entry.kind,
            closed_loop=entry.closed_loop,
        )
