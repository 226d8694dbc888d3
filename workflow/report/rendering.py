"""Templates into self-contained pages: every sentence and all layout stand in `workflow/templates`.

A template sees the typed values it is given, the filters of `workflow.text.formats`, and, through the macro
`figure`, every drawing of `workflow.figures` by its name.
"""

from __future__ import annotations

import base64
import gc
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from markupsafe import Markup

from workflow.figures.style import Picture, drawings, render
from workflow.report.inline import inline
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
    also: Iterable[str] = (),
    **values: Any,
) -> RenderedPage:
    """A page whose template extends base.html.j2. Equal values give equal bytes.

    filters: (name, function) of this page, beside those of all. also: see `render`.

    Pictures are drawn where the template asks for them; progress(share, picture) is told of each. How many
    are to come is not known, so the share only approaches 1.
    """
    pictures: dict[str, Picture] = {}
    styles: dict[str, str] = {}

    def draw(name: str, caption: str, file: str, *what: Any) -> Drawn | None:
        if progress is not None:
            progress(len(pictures) / (len(pictures) + 6), name)
        figure = drawings()[name](*what)
        if figure is None:
            return None
        stem = f"{name}-{file}" if file else name
        if stem in pictures:
            raise ValueError(f"the page has two pictures called {stem!r}: give one another `file`")
        pictures[stem] = render(figure, also)
        return embedded(stem, Markup(caption).striptags(), pictures[stem], len(pictures), styles)

    page = environment(*filters).get_template(template)
    with _garbage_left():
        html = page.render(draw=draw, contents=[], styles=styles, **values)
    # The name of a file, in a locale that cannot read it, holds halves of characters.
    html = html.encode("utf-8", "replace").decode()
    return RenderedPage(html.strip() + "\n", pictures)


@contextmanager
def _garbage_left() -> Iterator[None]:
    """While pictures are drawn, what was there before is not looked through for garbage.

    A picture is tens of thousands of small objects; to go through all that the numerical libraries hold
    whenever their number has grown by so many takes a sixth of the drawing's time.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@dataclass(frozen=True)
class Drawn:
    """What the macro `picture` puts: image, samples and words of the legend, JSON for the script."""

    name: str
    image: Markup
    legend: list[tuple[Markup, str]] = field(default_factory=list)
    plot: str = ""


def embedded(name: str, label: str, picture: Picture, number: int, styles: dict[str, str]) -> Drawn:
    """The picture inside the page; label: plain text, read in its place; styles: see `inline`."""
    if picture.kind == "png":
        content = base64.b64encode(picture.content).decode("ascii")
        return Drawn(name, Markup('<img src="data:image/png;base64,{}" alt="{}">').format(content, label))
    image, legend = inline(picture, label, number, styles)
    return Drawn(name, image, legend, json.dumps(picture.plot, separators=(",", ":")))
