"""What the report page is made of: sections of blocks, all plain text until the template escapes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal


@dataclass(frozen=True)
class Text:
    """One paragraph."""

    words: str
    kind: ClassVar[str] = "text"


@dataclass(frozen=True)
class Table:
    """Cells as text. `met` marks rows as fulfilled (True), missed (False) or neither (None)."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""
    met: tuple[bool | None, ...] = ()
    kind: ClassVar[str] = "table"

    def __post_init__(self) -> None:
        if any(len(row) != len(self.head) for row in self.rows):
            raise ValueError(f"every row needs {len(self.head)} cells like the head {self.head}")
        if self.met and len(self.met) != len(self.rows):
            raise ValueError("met needs one entry per row")


@dataclass(frozen=True)
class Plot:
    """A picture by the name of its file in figures/, with its caption."""

    name: str
    caption: str
    kind: ClassVar[str] = "plot"


@dataclass(frozen=True)
class Remarks:
    """Sentences to heed ('warning'), that reassure ('good'), or that just inform ('note')."""

    items: tuple[str, ...]
    tone: Literal["warning", "good", "note"] = "note"
    title: str = ""
    kind: ClassVar[str] = "remarks"


@dataclass(frozen=True)
class Code:
    """Text as it stands in a file, folded up."""

    title: str
    text: str
    kind: ClassVar[str] = "code"


Block = Text | Table | Plot | Remarks | Code


@dataclass(frozen=True)
class Section:
    """A part of the page: its anchor, its title, its word in the table of contents, and its blocks."""

    anchor: str
    title: str
    short: str
    blocks: tuple[Block, ...] = field(default=())


def heading(words: str) -> Text:
    """A sub-heading: a paragraph of its own kind."""
    return _Heading(words)


@dataclass(frozen=True)
class _Heading(Text):
    kind: ClassVar[str] = "heading"


def maybe(
    remarks: Sequence[str], tone: Literal["warning", "good", "note"], title: str = ""
) -> tuple[Remarks, ...]:
    """Remarks if there are any."""
    return (Remarks(tuple(remarks), tone, title),) if remarks else ()
