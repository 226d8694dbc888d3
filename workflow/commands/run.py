"""`flexlink run`, `report`, `simulate`: a configuration into a run with its page, or into CSV files."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from workflow.config.run_config import SimulatedSource, built_in_config, load_config, load_simulation
from workflow.engine import storage
from workflow.engine.errors import InputError, naming
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory, default_directory

if TYPE_CHECKING:
    from workflow.text.templates import RunSummary


def run_from_files(
    config_path: Path | None,
    out: Path | None,
    *,
    resume: bool = False,
    replace: bool = False,
    c_code: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> RunSummary:
    """Load a configuration and run it; see `run_pipeline`.

    Without `config_path` the built-in default arm is run, or on resuming the configuration kept in `out`;
    without `out` a new directory below runs/ is made. Raises InputError.
    """
    if (resume or replace) and out is None:
        raise InputError(
            f"{'--resume' if resume else '--replace'} needs --out DIR, the directory of the earlier run"
        )
    if config_path is not None:
        config, text = load_config(config_path)
    elif resume and out is not None and (out / "manifest.json").is_file():
        from workflow.tasks.pipeline import config_of

        config, text = config_of(RunDirectory.open(out)), ""
    elif resume and not replace:
        raise InputError(f"{out}: no run is there to resume; start one without --resume")
    else:
        config, text = built_in_config()
    # Here: what computes takes seconds to load, and a configuration that is refused does not need it.
    from workflow.report.pages import REPORT
    from workflow.tasks.pipeline import run_pipeline

    return run_pipeline(
        config,
        out if out is not None else default_directory(config.run.name),
        config_text=text,
        called=str(config_path or "default arm"),
        page=REPORT,
        resume=resume,
        replace=replace,
        c_code=c_code,
        progress=progress,
    )


def rebuild_report(
    run: RunDirectory, also: Iterable[str] = (), progress: Progress | None = None
) -> RunSummary:
    """Write report.html again from the stages of a finished run. Raises InputError when a stage is missing.

    also: kinds of file for its pictures beside SVG, pdf or png.
    """
    from workflow.report.pages import REPORT, write_page
    from workflow.tasks.pipeline import rebuild_page

    return rebuild_page(run, dataclasses.replace(REPORT, run=partial(write_page, also=also)), progress)


def simulate_to_csv(config_path: Path | None, out: Path) -> list[Path]:
    """Simulate the experiments of a configuration; one CSV per record, named after it, then truth.json.

    Columns time_s, reference_rad (of a loop), voltage_V, hub_angle_rad, tip_m, so that the files can be read
    back as a log. Raises InputError.
    """
    config = load_simulation(config_path) if config_path is not None else built_in_config()[0]
    if not isinstance(config.source, SimulatedSource):
        raise InputError(f"{config_path}: source.kind is 'files'; simulating needs kind = 'simulated'")
    out = Path(out)
    RunDirectory(out).refuse_unless_free()
    # Here: what simulates takes seconds to load, and a configuration that is refused does not need it.
    from workflow.tasks.simulated_rig import (
        INPUT_NAME,
        OUTPUT_NAMES,
        REFERENCE_NAME,
        TRUTH_FILE,
        simulate_record,
        truth_of,
    )

    texts = {}
    for index, entry in enumerate(config.source.records):
        with naming(f"{config_path or 'default arm'}: source.records[{index}] ({entry.name})"):
            record = simulate_record(config.source, entry, config.run.seed)
        columns = [*record.input.T, *record.output.T]
        signals = dict(zip((INPUT_NAME, *OUTPUT_NAMES), columns, strict=True))
        if record.reference is not None:
            signals = {REFERENCE_NAME: record.reference[:, 0], **signals}
        safe = re.sub(r"[^A-Za-z0-9_.-]+", "_", entry.name)
        texts[f"{index + 1:02d}_{safe}.csv"] = storage.csv_text({"time_s": record.time_s, **signals})
    texts[TRUTH_FILE] = truth_of(config.source).model_dump_json(indent=1) + "\n"
    return storage.write_new_directory(out, texts)
