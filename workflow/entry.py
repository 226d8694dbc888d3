"""One library call per command: files and options in, a table of numbers out."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from workflow.config import RunConfig, load_config
from workflow.errors import InputError
from workflow.pipeline import config_of, run_pipeline
from workflow.progress import Progress
from workflow.run_directory import RunDirectory, default_directory
from workflow.summary import RunSummary


def built_in_config() -> tuple[RunConfig, str]:
    """The default arm: configuration and its text."""
    with resources.as_file(resources.files("workflow") / "data" / "default_arm.toml") as path:
        return load_config(path)


def run_from_files(
    config_path: Path | None,
    out: Path | None,
    *,
    resume: bool = False,
    replace: bool = False,
    progress: Progress | None = None,
) -> RunSummary:
    """Load a configuration and run it; see `run_pipeline`.

    Without `config_path` the built-in default arm is run, or on resuming the configuration kept in `out`;
    without `out` a new directory below runs/ is made. Raises InputError.
    """
    if resume and replace:
        raise InputError("--resume and --replace contradict each other")
    if (resume or replace) and out is None:
        raise InputError(
            f"{'--resume' if resume else '--replace'} needs --out DIR, the directory of the earlier run"
        )
    if config_path is not None:
        config, text = load_config(config_path)
    elif resume and out is not None and (out / "manifest.json").is_file():
        config, text = config_of(RunDirectory.open(out)), ""
    else:
        config, text = built_in_config()
    return run_pipeline(
        config,
        out if out is not None else default_directory(config.run.name),
        config_text=text,
        resume=resume,
        replace=replace,
        progress=progress,
    )
