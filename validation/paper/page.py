"""The page, and one line a figure for the terminal, by template."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

from validation.paper.bounds import TWO_SIGMA_LEVEL
from validation.paper.experiments import RECIPE_BUDGET, PaperResults
from validation.paper.findings import CLOSE_TO_BEST, PEERS, Findings
from validation.paper.methods import BETTER_STARTS, JUDGED_BAND_RAD_S, METHODS
from validation.paper.quotes import OPEN_CHOICES, REPORTED, SOURCE
from validation.paper.table import Row
from workflow.figures.style import Picture
from workflow.report.rendering import embedded
from workflow.text.templates import environment


def headlines_of(results: PaperResults, findings: Findings) -> list[str]:
    """What the run found, one line a figure."""
    template = environment(package="validation").get_template("paper_headlines.txt.j2")
    text = template.render(results=results, found=findings, methods=METHODS, peers=PEERS)
    return text.strip().splitlines()


def page_html(
    results: PaperResults, pictures: Mapping[int, Picture], findings: Findings, rows: Sequence[Row]
) -> str:
    """The self-contained page; everything drawn stands inside it."""
    return (
        environment(package="validation")
        .get_template("paper.html.j2")
        .render(
            contents=[],
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
                    f"Fig. {item.number}, redrawn: {item.title}",
                    pictures[item.number],
                )
                for item in REPORTED
            },
            tables={figure: list(group) for figure, group in groupby(rows, key=lambda row: row.figure)},
        )
    )
