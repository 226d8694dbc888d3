"""The report: one self-contained page and its pictures, from what the stages left in the run directory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from workflow.config.run_config import RunConfig
from workflow.engine import storage
from workflow.figures.style import Picture, render
from workflow.report.data import RunData, load
from workflow.report.loop_sections import (
    closed_loop_section,
    design_section,
    margins_section,
    notes_section,
)
from workflow.report.model_sections import identification_section, records_section, uncertainty_section
from workflow.report.page import Plot, Section, Table
from workflow.report.pictures import pictures_of
from workflow.report.rendering import page
from workflow.report.verdict import reproducibility_section, verdict_of
from workflow.tasks.results import RunResults
from workflow.tasks.summary import summarise

__all__ = ["write_report"]

OVERVIEW_CAPTION = (
    "Left: the identified response that is fed back and the range over its ellipses. Middle: the loop with "
    "the controller, and the point of its ellipses nearest to -1. Right: the reference step, computed and "
    "run."
)


def write_report(
    results: RunResults, config: RunConfig, progress: Callable[[float, str], None] | None = None
) -> Path:
    """Draw every picture into `figures/`, then write `report.html`; each file is whole or absent.

    Pictures of an earlier report that this run no longer has are removed. Returns the path of the page.
    Raises InputError when a stage the report cannot do without is missing, or the disk refuses.
    """
    run, data = results.run, load(results, config)
    drawers = pictures_of(data)
    pictures = {}
    for position, (name, draw) in enumerate(drawers.items()):
        if progress is not None:
            progress(position / len(drawers), name)
        pictures[name] = render(draw())
    run.figures_path.mkdir(exist_ok=True)
    written = set()
    for name, picture in pictures.items():
        path = run.figures_path / f"{name}.{picture.kind}"
        storage.write_bytes(path, picture.content)
        written.add(path.name)
    for stale in sorted(run.figures_path.iterdir()):
        if stale.suffix in (".svg", ".png") and stale.name not in written:
            stale.unlink()
    storage.write_text(run.report_path, page_of(results, data, pictures))
    return run.report_path


def page_of(results: RunResults, data: RunData, pictures: Mapping[str, Picture]) -> str:
    """The page as HTML. Everything that comes from the user is escaped by the template engine."""
    summary = summarise(results, data.config)
    sections = [
        records_section(data),
        identification_section(data),
        uncertainty_section(data),
        design_section(data),
        margins_section(data),
        closed_loop_section(data),
        notes_section(data),
        reproducibility_section(data),
    ]
    rows = [
        (section.title if number == 0 else "", row.label, row.value)
        for section in summary.sections
        for number, row in enumerate(section.rows)
    ]
    table = Table(("", "quantity", "value"), tuple(rows))
    picture = (Plot("overview", OVERVIEW_CAPTION),) if "overview" in pictures else ()
    overview = Section("summary", "Summary", "Summary", (*picture, table))
    return page(
        "report.html.j2",
        title=data.config.run.title or data.config.run.name,
        sections=[overview, *sections],
        pictures=pictures,
        verdict=verdict_of(data, certified=summary.certified),
    )
