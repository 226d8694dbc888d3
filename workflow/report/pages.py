"""The self-contained pages of a run, from what its stages left, and of `flexlink identify`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from importlib import metadata
from pathlib import Path

from workflow.config.run_config import RunConfig
from workflow.describe.facts import FirstScreen, PageSection
from workflow.describe.identify import identify_first_screen, identify_page_sections
from workflow.describe.run import title_of
from workflow.describe.run_page import page_of_run
from workflow.engine import storage
from workflow.engine.run_directory import RunDirectory
from workflow.figures.subjects import RunView, log_channel
from workflow.figures.svg import svg_file
from workflow.report.rendering import RenderedPage, render_page
from workflow.tasks.log_identification import LogIdentification
from workflow.tasks.results import RunRecord, RunResults
from workflow.tasks.stage import Stage, StageInput
from workflow.tasks.stages import STAGES


def write_report(
    results: RunResults,
    config: RunConfig,
    progress: Callable[[float, str], None] | None = None,
    also: Iterable[str] = (),
    *,
    is_design: bool = False,
) -> Path:
    """Draw every picture into `figures/`, and write `report.html` of a run of one loop: all of them or none.

    Parameters
    ----------
    results : RunResults
    config : RunConfig
    progress, also
        As of `write_run_page`.
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
    first, parts = page_of_run(RunView(config, results, results.run.manifest()), is_design=is_design)
    return write_run_page(results.run, title_of(config, results.run), first, parts, progress, also)


def write_run_page(
    run: RunDirectory,
    title: str,
    first: FirstScreen,
    parts: Sequence[PageSection],
    progress: Callable[[float, str], None] | None = None,
    also: Iterable[str] = (),
) -> Path:
    """Write the page of a run, of one loop or of several joints, with its pictures: all of them or none.

    Pictures of an earlier report that this run no longer has are removed.

    Parameters
    ----------
    run : RunDirectory
    title : str
    first : FirstScreen
    parts : sequence of PageSection
    progress : callable, optional
        Called with the share done and the name of each picture.
    also : iterable of str
        Kinds of file beside SVG: pdf, png.

    Returns
    -------
    Path
        Of the page.

    Raises
    ------
    InputError
        The disk refuses.
    """
    page = render_page(
        "report.html.j2",
        progress,
        title=title,
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


# The last stage of a run of one loop.
REPORT = Stage(
    "report",
    tuple(stage.name for stage in STAGES),
    write_page,
    expected_s=7.0,
    # Words that appear on the page and nowhere before.
    uses={"run": True, "notes": True, "specification": True},
    also_writes=lambda run: (run.report_path,),
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
