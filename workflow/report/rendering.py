"""Templates into self-contained pages: every sentence and all layout stand in `workflow/templates`.

A template sees the typed values it is given, the filters of `workflow.text.formats`, and, through the macro
`figure`, every drawing of `workflow.figures` by its name.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from markupsafe import Markup

from workflow.describe.facts import Page
from workflow.figures.style import drawings
from workflow.figures.svg import COMMON_STYLE, Drawn, drawn, style_of
from workflow.text.templates import environment

# Pictures that are taken to come still. Chosen: it shapes the progress bar only.
_EXPECTED_PICTURES = 6


@dataclass(frozen=True)
class RenderedPage:
    """The page as HTML, and its pictures by the names of their files (without ending), with their looks."""

    html: str
    pictures: Mapping[str, Drawn] = field(default_factory=dict)
    looks: Mapping[str, str] = field(default_factory=dict)


def render_page(
    template: str,
    progress: Callable[[float, str], None] | None = None,
    *,
    filters: Iterable[tuple[str, Callable[..., Any]]] = (),
    **values: Any,
) -> RenderedPage:
    """A page whose template extends base.html.j2. Equal values give equal bytes.

    filters: (name, function) of this page, beside those of all.

    Pictures are drawn where the template asks for them; progress(share, picture) is told of each. How many
    are to come is not known, so the share only approaches 1.
    """
    pictures: dict[str, Drawn] = {}
    styles: dict[str, str] = {}

    def draw(name: str, caption: str, file: str, *what: Any) -> Embedded | None:
        if progress is not None:
            progress(len(pictures) / (len(pictures) + _EXPECTED_PICTURES), name)
        picture = drawings()[name](*what)
        if picture is None:
            return None
        stem = f"{name}-{file}" if file else name
        if stem in pictures:
            raise ValueError(f"the page has two pictures called {stem!r}: give one another `file`")
        label = Markup(caption).striptags()
        pictures[stem] = made = drawn(picture, label, len(pictures) + 1, styles)
        return embedded(stem, made)

    page = environment(*filters).get_template(template)
    html = page.render(
        draw=draw, contents=[], styles=styles, looks=lambda: Markup(COMMON_STYLE + style_of(styles)), **values
    )
    # The name of a file, in a locale that cannot read it, holds halves of characters.
    html = html.encode("utf-8", "replace").decode()
    return RenderedPage(html.strip() + "\n", pictures, styles)


def render_described(page: Page, progress: Callable[[float, str], None] | None = None) -> RenderedPage:
    """A page whose sentences `workflow.describe` has made; equal pages give equal bytes."""
    return render_page(
        "report.html.j2",
        progress,
        title=page.title,
        first=page.first,
        parts=page.sections,
        study=False,
        wide=page.wide,
    )


@dataclass(frozen=True)
class Embedded:
    """What the macro `picture` puts: image, samples and words of the legend, JSON for the script, and the
    same of each part for a narrow screen."""

    name: str
    image: Markup
    legend: list[tuple[Markup, str]]
    plot: Markup
    narrow: list[Embedded] = field(default_factory=list)


def embedded(name: str, made: Drawn) -> Embedded:
    """A picture as a template puts it. name: of its file, without ending."""
    plot = json.dumps(made.plot, separators=(",", ":"), ensure_ascii=False)
    # For an attribute in single quotes: there are a thousand double ones.
    quoted = Markup(plot.replace("&", "&amp;").replace("'", "&#39;").replace("<", "&lt;"))
    legend = [(Markup(sample), words) for sample, words in made.samples]
    narrow = [embedded(name, part) for part in made.narrow]
    return Embedded(name, Markup(made.svg), legend, quoted, narrow)
