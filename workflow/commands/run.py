"""`flexlink run`, `report`, `simulate`: a configuration into a run with its page, or into CSV files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ident.data.record import Record
from workflow.commands.init import decided
from workflow.config.joints_config import AnyConfig, JointsConfig, load_any, load_simulation
from workflow.config.run_config import FileSource, SimulatedSource, built_in_config
from workflow.engine import storage
from workflow.engine.errors import InputError
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory, default_directory
from workflow.tasks.early_refusals import refuse_hopeless_source
from workflow.tasks.records import read_records

if TYPE_CHECKING:
    from workflow.commands.logs import Reading
    from workflow.text.templates import RunSummary


def run_from_files(
    config_path: Path | None,
    out: Path | None,
    logs: Sequence[Path] = (),
    stated: Reading | None = None,
    *,
    resume: bool = False,
    replace: bool = False,
    c_code: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> RunSummary:
    """Load a configuration and run it; see `run_pipeline`.

    Of logs, read as stated, the configuration is that of `flexlink init`, kept in `out`. Without
    `config_path` or logs the built-in default arm is run, or on resuming the configuration kept in `out`;
    without `out` a new directory below runs/ is made. Raises InputError.
    """
    if logs and config_path is not None:
        raise InputError("give logs or --config FILE, which names its logs, not both")
    if (resume or replace) and out is None:
        raise InputError(
            f"{'--resume' if resume else '--replace'} needs --out DIR, the directory of the earlier run"
        )
    config: AnyConfig
    note, known = "", dict[str, bytes]()
    if logs:
        out = out if out is not None else default_directory(logs[0].stem)
        RunDirectory(out).refuse_unless_free(resume=resume, replace=replace)
        config, text, known, found = decided("run", logs, out / "config.toml", stated, progress)
        note = f"described as recorded, its friction not identified: {found.refused}" if found.refused else ""
    elif config_path is not None:
        config, text = load_any(config_path)
    elif resume and out is not None and (out / "manifest.json").is_file():
        from workflow.tasks.pipeline import any_config_of

        config, text = any_config_of(RunDirectory.open(out)), ""
    elif resume and not replace:
        raise InputError(f"{out}: no run is there to resume; start one without --resume")
    else:
        config, text = built_in_config()
        note = "no --config: this is the built-in default arm, not a machine of yours"
    place, read = out if out is not None else default_directory(config.run.name), list[Record]()
    # What is refused does not wait for what computes: that takes seconds to load.
    if isinstance(config.source, FileSource) and not known and not (resume and place.exists()):
        RunDirectory(place).refuse_unless_free(resume=resume, replace=replace)
        read = read_records(config.source, config.columns)
        refuse_hopeless_source(config, read, progress)
    from workflow.report.pages import page_of
    from workflow.tasks.pipeline import run_pipeline

    return run_pipeline(
        config,
        place,
        config_text=text,
        called=str(config_path or ("logs" if logs else "default arm")),
        page=page_of(config),
        resume=resume,
        replace=replace,
        c_code=c_code,
        note=note,
        read=read,
        known=known,
        progress=progress,
    )


def rebuild_report(
    run: RunDirectory, also: Iterable[str] = (), progress: Progress | None = None
) -> RunSummary:
    """Write report.html again from the stages of a finished run. Raises InputError when a stage is missing.

    also: kinds of file for its pictures beside SVG, pdf or png.
    """
    from workflow.report.pages import page_of
    from workflow.tasks.pipeline import any_config_of, rebuild_page

    return rebuild_page(run, page_of(any_config_of(run), also), progress)


def simulate_to_csv(config_path: Path | None, out: Path) -> list[Path]:
    """Simulate the experiments of a configuration; one CSV per record, named after it, then truth.json.

    Columns time_s, reference_rad (of a loop), voltage_V, hub_angle_rad, tip_m, so that the files can be read
    back as a log. Raises InputError.
    """
    config = load_simulation(config_path) if config_path is not None else built_in_config()[0]
    if isinstance(config.source, FileSource):
        kind = "two_joint_arm" if isinstance(config, JointsConfig) else "simulated"
        raise InputError(f"{config_path}: source.kind is 'files'; simulating needs kind = {kind!r}")
    RunDirectory(out).refuse_unless_free()
    # Here: what simulates takes seconds to load, and a configuration that is refused does not need it.
    from workflow.tasks.simulated_rig import TRUTH_FILE, simulated_records, truth_of

    files = _as_csv(simulated_records(config, str(config_path or "default arm")))
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
