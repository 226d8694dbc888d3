"""Sections and rendered pictures into one self-contained page, by template."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from workflow.figures.style import Picture, inline_svg
from workflow.report.page import Plot, Section


def page(
    template: str,
    *,
    title: str,
    sections: Sequence[Section],
    pictures: Mapping[str, Picture],
    **values: Any,
) -> str:
    """The page as HTML; pictures by the names that the sections' plots give them.

    Everything that comes from the user is escaped by the template engine.
    """
    environment = Environment(
        loader=PackageLoader("workflow", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    drawn = {
        block.name: _embedded(block, pictures[block.name])
        for section in sections
        for block in section.blocks
        if isinstance(block, Plot)
    }
    return environment.get_template(template).render(title=title, sections=sections, drawn=drawn, **values)


def _embedded(plot: Plot, picture: Picture) -> Markup:
    """The picture inside the page: SVG elements with ids of their own, or a base64 image."""
    label = html.escape(plot.caption, quote=True)
    if picture.kind == "svg":
        return Markup(inline_svg(picture.content, f"{plot.name}-", label))
    content = base64.b64encode(picture.content).decode("ascii")
    return Markup(f'<img src="data:image/png;base64,{content}" alt="{label}">')
