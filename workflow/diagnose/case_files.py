"""Cases as files: `case.toml`, or a TOML file like it beside a user's own logs (docs/case_files.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from diagnosis.machine.case import Case, Experiment
from diagnosis.machine.plausible import refuse_implausible
from ident.data.foreign_files import shown
from ident.data.record import SAME_CLOCK
from ident.data.record_files import read_table
from ident.data.time_grid import TimeGrid
from ident.data.units import per, written_unit
from plant.rig import Rig
from workflow.config.rig_settings import read_rig
from workflow.config.settings import expand, repeated
from workflow.diagnose.case_settings import CASE_FILE, RIG_FILE, CaseSettings, ExperimentEntry, read_case_file
from workflow.engine import storage
from workflow.engine.errors import InputError, naming
from workflow.engine.run_directory import hash_of

# Names of pages and files in the output directory that no case may take.
_TAKEN_NAMES = ("index", "diagnose")


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
    file, settings = read_case_file(place)
    folder = file.parent
    called_by_folder = file.name == CASE_FILE
    name = settings.case or (folder.resolve().name if called_by_folder else file.stem)
    if name in _TAKEN_NAMES:
        raise InputError(f"{file}: case: {name!r} is the name of a file of the overview; choose another")
    # A folder may come from anybody; who names a case file himself knows what it reads.
    within = folder.resolve() if place.is_dir() else None
    rig_path = folder / (rig or settings.rig)
    if rig is None:
        _refuse_outside(within, rig_path, f"{file}: rig")
    machine = _rig(rig_path)
    experiments = [
        _experiment(file, i, entry, settings, machine, within) for i, entry in enumerate(settings.experiments)
    ]
    with naming(str(file)):
        case = Case(name, machine, tuple(experiments), settings.model_error)
        refuse_implausible(case)
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


def _refuse_outside(folder: Path | None, path: Path, where: str) -> None:
    """Links and `..` lead nowhere else from a case folder."""
    if folder is not None and not path.resolve().is_relative_to(folder):
        raise InputError(f"{where}: {path} lies outside the case folder; name {CASE_FILE} itself to read it")


def _rig(path: Path) -> Rig:
    if not path.is_file():
        beside = sorted(p.name for p in path.parent.glob("*.toml") if p.name != CASE_FILE)
        instead = f"; beside it: {', '.join(beside)}" if beside else ""
        raise InputError(f"{path}: no such rig file{instead}")
    return read_rig(path)


def _experiment(
    file: Path, index: int, entry: ExperimentEntry, settings: CaseSettings, rig: Rig, within: Path | None
) -> Experiment:
    """One log of a case file as an experiment, its rows on the grid of the sampling period.

    Commands and references are held between the controller's ticks, outputs are sampled (`TimeGrid`).

    Parameters
    ----------
    file : Path
        The case file; `entry.file` is relative to its folder.
    index : int
        Of the entry, for errors.
    entry : ExperimentEntry
    settings : CaseSettings
        Columns, outputs and sampling period of all logs.
    rig : Rig
        Its sampling period has to be that of the log.
    within : Path or None
        Folder that the log must not lie outside of; None: it may lie anywhere.

    Raises
    ------
    InputError
        One line that names the case file and key, or the log: no such file, a column that is missing, that
        stands for two quantities or whose unit is not that of its quantity, a sampling period or a number of
        rows that is not the stated one.
    """
    here = f"{file}: experiments[{index}]"
    with naming(f"{here}.file"):
        path = file.parent / expand(entry.file)
    _refuse_outside(within, path, f"{here}.file")
    if not path.is_file():
        raise InputError(f"{here}.file: no such file: {path}")

    # Without a sampling period only time stamps say when the outputs were sampled.
    wanted = ["voltage_V", *settings.outputs]
    if entry.columns.time_s or settings.columns.time_s or settings.dt_s is None:
        wanted.insert(0, "time_s")
    names = {quantity: entry.column(quantity, settings.columns) for quantity in (*wanted, "reference_rad")}
    with naming(str(path)):
        table = read_table(path)
        # Some logs have no reference: a column stated for all is that of those that have it. One stated for
        # this log is missed where it is not there.
        is_stated = entry.columns.reference_rad is not None
        if is_stated or names["reference_rad"].column in table.names:
            wanted.append("reference_rad")
        columns = [names[quantity].column for quantity in wanted]
        twice = repeated(columns)
        if twice is not None:
            first, second, *_ = [quantity for quantity in wanted if names[quantity].column == twice]
            raise InputError(f"{here}: {first} and {second} are both {twice!r}")
        readings_of = table.columns(columns)

        # A stated scale is right whatever the header says; otherwise the header's unit is converted.
        values = {}
        for quantity in wanted:
            place = names[quantity]
            unit = written_unit(quantity)
            header_unit = table.unit(place.column)
            factor: float | None = 1.0
            if header_unit and place.scale is None and quantity != "time_s":
                factor = per(header_unit, unit)
            if factor is None:
                raise ValueError(
                    f"column {place.column!r} is in {shown(header_unit, 30)}: "
                    f"state what makes it {unit} (scale)"
                )
            values[quantity] = place.quantity(readings_of[place.column], factor)

        # Time stamps decide which row is when; the rig file's period has to be theirs.
        n_rows = len(values["voltage_V"])
        grid = TimeGrid(settings.dt_s or rig.sampling.dt_s, np.arange(n_rows), np.zeros(n_rows))
        if "time_s" in values:
            time = names["time_s"]
            if time.scale is None:
                values["time_s"] = table.seconds(time.column, values["time_s"], None)[0]
            grid = TimeGrid.of(table, time.column, values["time_s"], options=False)
        stated = rig.sampling.dt_s
        if not abs(grid.dt_s - stated) <= SAME_CLOCK * stated:
            raise InputError(
                f"{path}: sampled every {grid.dt_s:.6g} s, but the rig file states sampling.dt_s = "
                f"{stated:.6g}"
            )
        if entry.samples is not None and entry.samples != n_rows:
            raise InputError(f"{here}.samples: {entry.samples} stated, {path} has {n_rows}")
        readings = np.column_stack([values[quantity] for quantity in settings.outputs])
        return Experiment(
            name=path.stem,
            role=entry.role,
            voltage_V=grid.held(values["voltage_V"]),
            output=grid.sampled(readings),
            kind=entry.kind,
            closed_loop=entry.closed_loop,
            outputs=settings.outputs,
            reference_rad=grid.held(values["reference_rad"]) if "reference_rad" in values else None,
            missing=grid.missing,
            readings=readings,
        )
