"""The page: every figure with the paper's words and ours beside it, the choices, and the table."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from itertools import groupby

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from validation.paper.findings import Finding
from validation.paper.methods import JUDGED_BAND_RAD_S
from validation.paper.quotes import OPEN_CHOICES, REPORTED, SOURCE, Reported
from validation.paper.settings import PaperSettings
from validation.paper.table import Row
from workflow.figures.style import Picture, inline_svg


def page_html(
    settings: PaperSettings,
    pictures: Mapping[int, Picture],
    findings: Sequence[Finding],
    rows: Sequence[Row],
) -> str:
    """The self-contained page; everything drawn stands inside it."""
    environment = Environment(
        loader=ChoiceLoader([PackageLoader("validation"), PackageLoader("workflow")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("paper.html.j2").render(
        source=SOURCE,
        command=f"flexlink paper --out DIR --seed {settings.seed}",
        settings=settings,
        band=JUDGED_BAND_RAD_S,
        figures=[
            {
                "reported": reported,
                "agrees": found.agrees,
                "headline": _unbroken(found.headline),
                "sentences": [_unbroken(words) for words in found.sentences],
                "drawing": _embedded(reported, pictures[reported.number]),
            }
            for reported, found in zip(REPORTED, findings, strict=True)
        ],
        choices=OPEN_CHOICES,
        tables=[
            (REPORTED[number - 1], list(group)) for number, group in groupby(rows, key=lambda row: row.figure)
        ],
    )


def _unbroken(words: str) -> str:
    """A number stays on one line with its per cent sign."""
    return words.replace(" %", "\N{NO-BREAK SPACE}%")


def _embedded(reported: Reported, picture: Picture) -> Markup:
    label = html.escape(f"Fig. {reported.number}, redrawn: {reported.title}", quote=True)
    if picture.kind == "svg":
        return Markup(inline_svg(picture.content, f"figure-{reported.number}-", label))
    content = base64.b64encode(picture.content).decode("ascii")
    return Markup(f'<img src="data:image/png;base64,{content}" alt="{label}">')
