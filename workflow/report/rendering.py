"""Templates into self-contained pages: every sentence and all layout stand in `workflow/templates`.

A template sees the typed values it is given, the filters of `workflow.text.formats`, and, through the macro
`figure`, every drawing of `workflow.figures` by its name.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from markupsafe import Markup

from workflow.figures.registry import drawings
from workflow.figures.style import Picture, render
from workflow.text.templates import environment


@dataclass(frozen=True)
class RenderedPage:
    """The page as HTML, and its pictures by the names of their files (without ending)."""

    html: str
    pictures: Mapping[str, Picture] = field(default_factory=dict)


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
        return embedded(Markup(caption).striptags(), pictures[stem])

    page = environment(*filters).get_template(template).render(draw=draw, contents=[], **values)
    return RenderedPage(page.strip() + "\n", pictures)


def embedded(label: str, picture: Picture) -> Markup:
    """The picture inside the page, an image of its own; label: plain text, read in its place."""
    kind = "svg+xml" if picture.kind == "svg" else "png"
    content = base64.b64encode(picture.content).decode("ascii")
    return Markup('<img src="data:image/{};base64,{}" alt="{}">').format(kind, content, label)
