"""`flexlink run`, `report`, `simulate`: a configuration into a run with its page, or into CSV files."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ident.data.foreign_files import path_as_typed
from ident.data.record import Record
from workflow.commands.init import decided
from workflow.config.run_config import (
    AnyConfig,
    FileSource,
    RunConfig,
    SimulatedSource,
    SimulationConfig,
    built_in_config,
    with_absolute_paths,
)
from workflow.engine import storage
from workflow.engine.errors import InputError
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory, default_directory
from workflow.field_options import option_name
from workflow.kinds import config_of_any, kind_of, load_any, load_simulation, page_of, simulated, summarise
from workflow.tasks.changed_specification import config_with_typed
from workflow.tasks.early_refusals import refuse_hopeless_source
from workflow.tasks.records import read_records

if TYPE_CHECKING:
    from workflow.commands.logs import Reading
    from workflow.describe.summary import RunSummary


def run_from_files(
    config_path: Path | None,
    out: Path | None,
    logs: Sequence[Path] = (),
    stated: Reading | None = None,
    *,
    earlier_path: Path | None = None,
    typed: Mapping[str, Any] | None = None,
    resume: bool = False,
    replace: bool = False,
    c_code: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> RunSummary:
    """Load a configuration and run it; see `run_pipeline`.

    Of logs, read as stated, the configuration is that of `flexlink init`, kept in `out`. Without
    `config_path` or logs it is that of the earlier run, on resuming the one kept in `out`, else that of the
    built-in default arm. Without `out` a new directory below runs/ is made.

    Parameters
    ----------
    config_path, out : Path, optional
    logs : sequence of Path
    stated : Reading, optional
    earlier_path : Path, optional
        Directory of a run whose stages are taken over where they were made from the same; it stays as it is.
    typed : mapping of str to value, optional
        Keys of [specification] in place of those of the earlier run, of the built-in arm, or of those drafted
        from the logs.
    resume, replace, c_code, progress
        As of `run_pipeline`.

    Returns
    -------
    RunSummary

    Raises
    ------
    InputError
        One line.
    """
    typed = dict(typed or {})
    if resume and earlier_path is not None:
        raise InputError("--from begins a new run; --resume continues the one at --out: give one of the two")
    if logs and config_path is not None:
        raise InputError("give logs or --config FILE, which names its logs, not both")
    if (resume or replace) and out is None:
        raise InputError(
            f"{'--resume' if resume else '--replace'} needs --out DIR, the directory of the earlier run"
        )
    if typed and (resume or config_path is not None):
        where = config_path or "the configuration of a new run"
        raise InputError(f"{option_name(min(typed))}: write it into {where}, under [specification]")
    earlier = None if earlier_path is None else _earlier(earlier_path, out, logs)
    if logs:
        place = out if out is not None else default_directory(logs[0].stem)
        RunDirectory(place).refuse_unless_free(resume=resume, replace=replace)
        # The logs are identified before their configuration is decided.
        with tempfile.TemporaryDirectory(prefix="flexlink-") as folder:
            begun = RunDirectory(Path(folder))
            drafted, text, found = decided(
                "run", logs, place / "config.toml", stated, progress, begun, earlier=earlier, typed=typed
            )
            note = ""
            if found.refused and not found.remote:
                note = f"described as recorded, its friction not identified: {found.refused}"
            from workflow.tasks.pipeline import run_pipeline

            results = run_pipeline(
                drafted,
                place,
                kind=kind_of(drafted),
                config_text=with_absolute_paths(text, drafted),
                called="logs",
                page=page_of(drafted),
                resume=resume,
                replace=replace,
                c_code=c_code,
                note=note,
                begun=begun,
                earlier=earlier,
                progress=progress,
            )
            return summarise(results, drafted)

    config: AnyConfig
    note = ""
    called = "default arm"
    if config_path is not None:
        config, text = load_any(config_path)
        called = str(config_path)
    elif earlier is not None:
        called = str(earlier.path)
        config = config_with_typed(config_of_any(earlier), typed, called)
        values = {key: "none" if value is None else value for key, value in typed.items()}
        changes = ", ".join(f"{key} = {value}" for key, value in values.items()) or "nothing changed"
        text = f"# As {path_as_typed(earlier.path / 'config.toml')}, {changes}\n\n{config.to_toml()}"
    elif resume and out is not None and (out / "manifest.json").is_file():
        config = config_of_any(RunDirectory.open(out))
        text = ""
    elif resume and not replace:
        raise InputError(f"{out}: no run is there to resume; start one without --resume")
    else:
        config, text = built_in_config()
        note = "no --config: this is the built-in default arm, not a machine of yours"
        if typed:
            config = config_with_typed(config, typed, called)
            text = config.to_toml()
    place = out if out is not None else default_directory(config.run.name)
    read = list[Record]()
    # What is refused does not wait for what computes: that takes seconds to load.
    if isinstance(config.source, FileSource) and earlier is None and not (resume and place.exists()):
        RunDirectory(place).refuse_unless_free(resume=resume, replace=replace)
        read = read_records(config.source, config.columns)
        refuse_hopeless_source(config, read, progress)
    from workflow.tasks.pipeline import run_pipeline

    results = run_pipeline(
        config,
        place,
        kind=kind_of(config),
        config_text=text,
        called=called,
        page=page_of(config),
        resume=resume,
        replace=replace,
        c_code=c_code,
        note=note,
        read=read,
        earlier=earlier,
        progress=progress,
    )
    return summarise(results, config)


def _earlier(path: Path, out: Path | None, logs: Sequence[Path]) -> RunDirectory:
    """The run that --from names.

    Parameters
    ----------
    path, out : Path
        Of the earlier run, and of the new one where it is stated.
    logs : sequence of Path
        Of the new run; empty where its configuration names them.

    Raises
    ------
    InputError
        No run is there, or of another version; it is the new run itself; or it was made from other logs.
    """
    earlier = RunDirectory.open(path)
    # Refused where it is damaged.
    earlier.config_document()
    if out is not None and out.exists() and out.resolve() == path.resolve():
        raise InputError(f"--out {out}: the run of --from, which stays as it is; choose another --out")
    if logs:
        names = {os.path.normpath(log.absolute()): log for log in logs}
        earlier.refuse_other_inputs({name: storage.sha256_of_file(log) for name, log in names.items()})
    return earlier


def rebuild_report(
    run: RunDirectory, also: Iterable[str] = (), progress: Progress | None = None
) -> RunSummary:
    """Write report.html again from the stages of a finished run. Raises InputError when a stage is missing.

    also: kinds of file for its pictures beside SVG, pdf or png.
    """
    from workflow.tasks.pipeline import rebuild_page

    config = config_of_any(run)
    results = kind_of(config).results(run)
    rebuild_page(config, results, page_of(config, also), progress)
    return summarise(results, config)


def simulate_to_csv(config_path: Path | None, out: Path) -> list[Path]:
    """Simulate the experiments of a configuration; one CSV per record, named after it, then truth.json.

    Columns time_s, reference_rad (of a loop), voltage_V, hub_angle_rad, tip_m, so that the files can be read
    back as a log. Raises InputError.
    """
    config = load_simulation(config_path) if config_path is not None else built_in_config()[0]
    if isinstance(config.source, FileSource):
        kind = "simulated" if isinstance(config, RunConfig | SimulationConfig) else "two_joint_arm"
        raise InputError(f"{config_path}: source.kind is 'files'; simulating needs kind = {kind!r}")
    RunDirectory(out).refuse_unless_free()
    # Here: what simulates takes seconds to load, and a configuration that is refused does not need it.
    from workflow.tasks.simulated_rig import TRUTH_FILE, truth_of

    files = _as_csv(simulated(config, str(config_path or "default arm")))
    if isinstance(config.source, SimulatedSource):
        files[TRUTH_FILE] = truth_of(config.source).model_dump_json(indent=1) + "\n"
    return storage.write_new_directory(out, files)


def _as_csv(records: Sequence[Record]) -> dict[str, str]:
    """One text by file name for each: time_s, the reference of a loop, inputs, outputs."""
    texts = {}
    for number, record in enumerate(records, 1):
        names = (*record.reference_names, *record.input_names, *record.output_names)
        signals = [part for part in (record.reference, record.input, record.output) if part is not None]
        columns = dict(zip(names, np.hstack(signals).T, strict=True))
        safe = re.sub(r"[^A-Za-z0-9_.-]+", "_", record.name)
        texts[f"{number:02d}_{safe}.csv"] = storage.csv_text({"time_s": record.time_s, **columns})
    return texts
