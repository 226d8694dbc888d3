"""The self-contained pages of a run, from what its stages left, and of `flexlink identify`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from importlib import metadata
from pathlib import Path

from workflow.config.joints_config import AnyConfig
from workflow.config.run_config import RunConfig
from workflow.describe.identify import identify_first_screen, identify_page_sections
from workflow.describe.run import title_of
from workflow.describe.run_page import page_of_run
from workflow.engine import storage
from workflow.engine.run_directory import RunDirectory
from workflow.figures.subjects import AnyRunView, RunView, log_channel
from workflow.figures.svg import svg_file
from workflow.report.rendering import RenderedPage, render_page
from workflow.tasks.log_identification import LogIdentification
from workflow.tasks.results import RunRecord, RunResults
from workflow.tasks.stage import Stage, StageInput, stages_for
from workflow.tasks.stages import STAGES


def write_report(
    results: RunResults,
    config: AnyConfig,
    progress: Callable[[float, str], None] | None = None,
    also: Iterable[str] = (),
    *,
    is_design: bool = False,
) -> Path:
    """Draw every picture into `figures/`, and write `report.html`: all of them or none.

    Pictures of an earlier report that this run no longer has are removed.

    Parameters
    ----------
    results : RunResults
    config : RunConfig or JointsConfig
    progress : callable, optional
        Called with the share done and the name of each picture.
    also : iterable of str
        Kinds of file beside SVG: pdf, png.
    is_design : bool
        The page will not stand among the run's files, and names none of them.

    Returns
    -------
    Path
        Of the page.

    Raises
    ------
    InputError
        A stage the report cannot do without is missing, or the disk refuses.
    """
    run = results.run
    view = RunView if isinstance(config, RunConfig) else AnyRunView
    first, parts = page_of_run(view(config, results, run.manifest()), is_design=is_design)
    page = render_page(
        "report.html.j2",
        progress,
        title=title_of(config, run),
        first=first,
        parts=parts,
        # A point of a study lies in the study's directory, two levels below its page.
        study=(run.path.parent.parent / "study.html").is_file(),
    )
    return _write(run, page, also)


def _write(run: RunDirectory, page: RenderedPage, also: Iterable[str]) -> Path:
    """Write page and pictures into a run directory; the path of the page."""
    run.figures_path.mkdir(exist_ok=True)
    files = {
        run.figures_path / f"{name}.svg": svg_file(made, page.looks) for name, made in page.pictures.items()
    }
    if also:
        # matplotlib takes half a second to load.
        from workflow.figures.matplotlib_figure import saved

        for name, made in page.pictures.items():
            further = saved(made.picture, also)
            files |= {run.figures_path / f"{name}.{kind}": content for kind, content in further.items()}
    storage.write_together({**files, run.report_path: page.html.encode()})
    # Only now: what an earlier page shows is there until the new one is whole.
    for stale in sorted(run.figures_path.iterdir()):
        if stale.suffix in (".svg", ".png", ".pdf") and stale not in files:
            stale.unlink()
    return run.report_path


def write_page(stage: StageInput, also: Iterable[str] = ()) -> str:
    """The last stage of a run: report.html and the hash of its content; also: as of `write_report`."""
    path = write_report(stage.results, stage.config, partial(stage.progress.update, "report"), also)
    return storage.sha256_of_file(path)


def page_of(config: AnyConfig, also: Iterable[str] = ()) -> Stage:
    """The stage that writes the page of a run. also: kinds of file for its pictures beside SVG."""
    stage = stages_for(config, (*STAGES, REPORT))[-1]
    return replace(stage, run=partial(write_page, also=also)) if also else stage


# The last stage of a run.
REPORT = Stage(
    "report",
    tuple(stage.name for stage in STAGES),
    write_page,
    expected_s=7.0,
    # Words that appear on the page and nowhere before.
    uses={"run": True, "notes": True, "specification": True, "joints": True},
    also_writes=lambda run: (run.report_path,),
    several=(write_page, 5.0),
)


def identify_page(
    result: LogIdentification, inputs: Mapping[str, str], progress: Callable[[float, str], None] | None = None
) -> str:
    """One self-contained HTML page; inputs are the files with their SHA-256. Same results, same page."""
    options = result.options
    channel = log_channel(result)
    versions = [(name, metadata.version(name)) for name in ("flexlink", "numpy", "scipy", "nlopt")]
    records = [
        *(RunRecord(record, "estimation", None, "") for record in result.measured),
        *(RunRecord(record, "validation", None, "") for record in result.fresh_records),
    ]
    # What is as it always is says nothing about this model.
    changed = []
    for name, field in type(options).model_fields.items():
        value = getattr(options, name)
        if value != field.default:
            changed.append((name, value))
    stated = [*changed, *versions, ("python", sys.version.split()[0])]
    page = render_page(
        "report.html.j2",
        progress,
        title=f"{channel.found.input} to {channel.found.output}",
        first=identify_first_screen(result, channel),
        parts=identify_page_sections(result, channel, records, stated, inputs),
        study=False,
    )
    return page.html
