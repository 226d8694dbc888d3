"""A page as `workflow.describe` words it: `described.html.j2` lays it out and decides nothing.

Text is plain and escaped when it is laid out. Only what `link` makes is markup.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote

from markupsafe import Markup

from workflow.describe.facts import Picture, Row, Verdict


def link(text: str, address: str) -> Markup:
    """A link; both may come from a user. address: a file beside the page, or "#anchor"."""
    target = address if address.startswith("#") else quote(address)
    return Markup('<a href="{}">{}</a>').format(target, text)


@dataclass(frozen=True)
class Line:
    """Cells of one line of a table, with the verdict that colours it."""

    cells: tuple[str, ...]
    verdict: Verdict = Verdict.NONE


@dataclass(frozen=True)
class Table:
    """Lines under names of columns; an empty name is no heading."""

    head: tuple[str, ...]
    lines: tuple[Line, ...]
    caption: str = ""

    @classmethod
    def of(cls, head: tuple[str, ...], cells: Sequence[tuple[str, ...]], caption: str = "") -> Table:
        """A table whose lines have no verdict."""
        return cls(head, tuple(Line(line) for line in cells), caption)


@dataclass(frozen=True)
class Warnings:
    """A box of sentences to heed; nothing where there are none."""

    warnings: tuple[str, ...]


@dataclass(frozen=True)
class FileText:
    """A file as it stands, folded."""

    title: str
    text: str


@dataclass(frozen=True)
class Sketch:
    """An image that is no drawing of `workflow.figures`. image: SVG of ours."""

    image: Markup
    caption: str


@dataclass(frozen=True)
class Fold:
    """What only some will want to see."""

    title: str
    folded: tuple[Table, ...]


# A sentence is a paragraph of its own.
Block = str | Picture | Table | Warnings | FileText | Sketch | Fold


@dataclass(frozen=True)
class PageSection:
    """One subject of a page, folded at first.

    Attributes:
        anchor: Of links to it.
        title: As it stands above the section.
        short: As it stands in the contents.
        blocks: In the order in which they are read.
        open: Shown unfolded.
    """

    anchor: str
    title: str
    short: str
    blocks: tuple[Block, ...]
    open: bool = False


@dataclass(frozen=True)
class FirstScreen:
    """What a page begins with.

    Attributes:
        headline: The answer in one line.
        rows: At most five of them are shown.
        bullets: Sentences, the weightiest first; those behind the fifth fold. Empty ones are left out.
        pictures: Between the numbers and the bullets.
        below: Behind the bullets.
        state: "certified", "refused" or "plain".
        anchor, short: As in `PageSection`.
        all_bullets: None of them folds.
    """

    headline: str
    rows: tuple[Row, ...]
    bullets: tuple[str, ...]
    pictures: tuple[Block, ...] = ()
    below: tuple[Block, ...] = ()
    state: str = "plain"
    anchor: str = "findings"
    short: str = "Findings"
    all_bullets: bool = False


@dataclass(frozen=True)
class Page:
    """A whole page. wide: its tables have many columns."""

    title: str
    first: FirstScreen
    sections: tuple[PageSection, ...]
    wide: bool = False
