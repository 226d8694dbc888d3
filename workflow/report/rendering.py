"""Templates into self-contained pages: every sentence and all layout stand in `workflow/templates`.

A template sees the typed values it is given, the filters of `workflow.report.formats`, and, through the macro
`figure`, every drawing of `workflow.figures` by its name.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from workflow.figures.registry import drawings
from workflow.figures.style import Picture, inline_svg, render
from workflow.report.formats import FILTERS, TESTS
from workflow.report.page import Plot, Section


@cache
def environment(package: str = "workflow") -> Environment:
    """The one environment of all pages and texts; another package's templates come before ours.

    Everything that comes from the user is escaped.
    """
    made = Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in dict.fromkeys((package, "workflow"))]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters.update(FILTERS)
    made.tests.update(TESTS)
    return made


@dataclass(frozen=True)
class RenderedPage:
    """The page as HTML, and its pictures by the names of their files (without ending)."""

    html: str
    pictures: Mapping[str, Picture] = field(default_factory=dict)


def render_page(
    template: str, progress: Callable[[float, str], None] | None = None, **values: Any
) -> RenderedPage:
    """A page whose template extends base.html.j2. Equal values give equal bytes.

    Pictures are drawn where the template asks for them; progress(share, picture) is told of each. How many
    are to come is not known, so the share only approaches 1.
    """
    pictures: dict[str, Picture] = {}

    def draw(name: str, caption: str, file: str, *what: Any) -> Markup | None:
        if progress is not None:
            progress(len(pictures) / (len(pictures) + 6), name)
        figure = drawings()[name](*what)
        if figure is None:
            return None
        stem = f"{name}-{file}" if file else name
        if stem in pictures:
            raise ValueError(f"the page has two pictures called {stem!r}: give one another `file`")
        pictures[stem] = render(figure)
        return embedded(stem, Markup(caption).striptags(), pictures[stem])

    page = environment().get_template(template).render(draw=draw, contents=[], **values)
    return RenderedPage(page.strip() + "\n", pictures)


def render_text(template: str, **values: Any) -> str:
    """Plain text by template: for terminals and files. Nothing is escaped."""
    return Markup(environment().get_template(template).render(**values)).unescape()


def page(
    template: str,
    *,
    title: str,
    sections: Sequence[Section],
    pictures: Mapping[str, Picture],
    **values: Any,
) -> str:
    """A page of sections that Python made; pictures by the names that the sections' plots give them."""
    drawn = {
        block.name: embedded(block.name, block.caption, pictures[block.name])
        for section in sections
        for block in section.blocks
        if isinstance(block, Plot)
    }
    return environment().get_template(template).render(title=title, sections=sections, drawn=drawn, **values)


def embedded(name: str, label: str, picture: Picture) -> Markup:
    """The picture inside the page: SVG elements with ids of their own, or a base64 image."""
    label = html.escape(label, quote=True)
    if picture.kind == "svg":
        return Markup(inline_svg(picture.content, f"{name}-", label))
    content = base64.b64encode(picture.content).decode("ascii")
    return Markup(f'<img src="data:image/png;base64,{content}" alt="{label}">')
