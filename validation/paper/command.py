"""`flexlink paper`: compute, draw, and only then write."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

from markupsafe import Markup

from validation.paper import table
from validation.paper.bounds import TWO_SIGMA_LEVEL
from validation.paper.experiments import RECIPE_BUDGET, STAGES, PaperResults, run_experiments
from validation.paper.figures_methods import (
    draw_bounds,
    draw_experiment,
    draw_gobf_run,
    draw_peer_runs,
    draw_simulation,
    draw_simulation_peers,
)
from validation.paper.figures_search import draw_surface
from validation.paper.findings import CLOSE_TO_BEST, PEERS, Findings, findings_of
from validation.paper.methods import BETTER_STARTS, JUDGED_BAND_RAD_S, METHODS
from validation.paper.quotes import OPEN_CHOICES, REPORTED, SOURCE
from validation.paper.settings import PaperSettings
from workflow.describe.facts import Quantity, Row, Section
from workflow.describe.summary import RunSummary
from workflow.engine.codec import plain_text
from workflow.engine.errors import InputError
from workflow.engine.progress import Progress
from workflow.engine.run_directory import package_versions
from workflow.engine.store import Store
from workflow.figures.description import Picture
from workflow.figures.svg import COMMON_STYLE, alone, drawn, style_of
from workflow.report.rendering import embedded
from workflow.text.templates import environment

# The page.
PAGE = "paper.html"
# The table of all rows for a spreadsheet.
TABLE_CSV = "table.csv"
# The table of all rows for a program.
TABLE_JSON = "table.json"


class PaperDirectory(Store):
    """Figures, tables and, last, the page: only these are removed by --replace."""

    what = "redrawn paper"
    manifest_name = PAGE
    own_files = (
        *(f"figure-{item.number}.{kind}" for item in REPORTED for kind in ("svg", "png")),
        TABLE_CSV,
        TABLE_JSON,
    )


# Function that draws each figure.
DRAWERS: Mapping[int, Callable[[PaperResults], Picture]] = {
    1: lambda results: draw_surface(results.surface),
    2: draw_simulation,
    3: draw_simulation_peers,
    4: draw_experiment,
    5: lambda results: draw_gobf_run(results.experiment),
    6: lambda results: draw_peer_runs(results.experiment),
    7: lambda results: draw_bounds(results.bounds, results.experiment.machine.gain_unit),
}


def redraw_paper(
    out: Path,
    settings: PaperSettings | None = None,
    *,
    replace: bool = False,
    progress: Progress | None = None,
) -> RunSummary:
    """Redraw Figs. 1-7 into `out`, new or empty: paper.html, figure-N.svg, table.csv, table.json.

    Nothing is written before everything is computed and drawn; then each file appears whole, the page last:
    no page ever stands over other figures.

    Parameters
    ----------
    out : Path
        A directory.
    settings : PaperSettings, optional
        Seed and sizes of the repetitions.
    replace : bool
        Exchange the files of an earlier call; nothing else is touched.
    progress : Progress, optional

    Raises
    ------
    InputError
        One line: `out` cannot be written, or holds something.
    """
    settings = settings or PaperSettings()
    progress = progress or Progress()
    store = PaperDirectory(Path(out))
    if store.refuse_unless_free(replace=True) and not replace:
        raise InputError(f"{out}: not empty, a redrawn paper is there; choose another --out or --replace it")
    progress.plan(STAGES)
    results = run_experiments(settings, progress)
    with progress.stage("page") as update:
        pictures = {}
        for number, draw in DRAWERS.items():
            update((number - 1) / len(DRAWERS), f"figure {number}")
            pictures[number] = draw(results)
        findings = findings_of(results)
        rows = table.rows_of(results)
        headlines = headlines_of(results, findings)
        document = {
            "seed": settings.seed,
            "repeats": settings.repeats,
            "searches": settings.searches,
            "versions": package_versions(),
            "figures": [
                {
                    "figure": item.number,
                    "title": item.title,
                    "agrees": findings.agrees[item.number],
                    "found": headline,
                }
                for item, headline in zip(REPORTED, headlines, strict=True)
            ],
            "rows": [asdict(row) for row in rows],
        }
        page = page_html(results, pictures, findings, rows)
        files = {f"figure-{number}.svg": alone(picture) for number, picture in pictures.items()}
        files |= {TABLE_CSV: table.csv_text(rows).encode(), TABLE_JSON: plain_text(document).encode()}
        files[store.manifest_name] = page.encode()
        with store.writing(replace=True):
            store.prepare(replace=True)
            store.write(files)
    return _summary(store.path, document)


def headlines_of(results: PaperResults, findings: Findings) -> list[str]:
    """What the run found, one line a figure."""
    template = environment(package="validation").get_template("paper_headlines.txt.j2")
    text = template.render(results=results, found=findings, methods=METHODS, peers=PEERS)
    return text.strip().splitlines()


def page_html(
    results: PaperResults, pictures: Mapping[int, Picture], findings: Findings, rows: Sequence[table.Row]
) -> str:
    """The self-contained page; everything drawn stands inside it."""
    styles: dict[str, str] = {}
    return (
        environment(package="validation")
        .get_template("paper.html.j2")
        .render(
            contents=[],
            styles=styles,
            looks=lambda: Markup(COMMON_STYLE + style_of(styles)),
            results=results,
            found=findings,
            headlines=headlines_of(results, findings),
            source=SOURCE,
            reported=REPORTED,
            choices=OPEN_CHOICES,
            band=JUDGED_BAND_RAD_S,
            methods=METHODS,
            peers=PEERS,
            better=BETTER_STARTS,
            close=CLOSE_TO_BEST,
            level=TWO_SIGMA_LEVEL,
            recipe_evaluations=RECIPE_BUDGET * results.settings.evaluations,
            drawings={
                item.number: embedded(
                    f"figure-{item.number}",
                    drawn(
                        pictures[item.number],
                        f"Fig. {item.number}, redrawn: {item.title}",
                        item.number,
                        styles,
                    ),
                )
                for item in REPORTED
            },
            tables={figure: list(group) for figure, group in groupby(rows, key=lambda row: row.figure)},
        )
    )


def _summary(out: Path, document: Mapping[str, Any]) -> RunSummary:
    """One line a figure for the terminal; `numbers` holds every row."""
    figures = document["figures"]
    verdicts = {True: "as the paper reports", False: "not as the paper reports"}
    return RunSummary(
        title="Ziaei & Wang 2006, redrawn",
        sections=tuple(
            Section(
                f"Fig. {item['figure']}", (Row("", verdicts[item["agrees"]], Quantity.words(item["found"])),)
            )
            for item in figures
        ),
        numbers=document,
        verdict=f"{sum(item['agrees'] for item in figures)} of {len(figures)} figures as the paper reports; "
        f"numbers in {out / TABLE_CSV}",
        report_path=str(out / PAGE),
    )
