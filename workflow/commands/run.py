"""`flexlink run` and `flexlink report`: a configuration into a run directory with its page."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from workflow.config.run_config import built_in_config, load_config
from workflow.engine.errors import InputError
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory, default_directory

if TYPE_CHECKING:
    from workflow.tasks.summary import RunSummary


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
    from workflow.report.run_report import REPORT
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
    """Write report.html anew from the stages of a finished run. Raises InputError when a stage is missing.

    also: kinds of file for its pictures beside SVG, pdf or png.
    """
    from workflow.report.run_report import REPORT, write_page
    from workflow.tasks.pipeline import rebuild_page

    return rebuild_page(run, dataclasses.replace(REPORT, run=partial(write_page, also=also)), progress)
