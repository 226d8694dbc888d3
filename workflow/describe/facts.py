"""Facts of a result, worded once: a terminal, a page, the JSON answer and a study show the same `Row`.

A function of `workflow.describe` makes a `Section` of rows from the typed values of a result. Rules that
decide (met or missed, worth a remark or not) stand in such a function or below it, never in a renderer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar, Literal, TypeAlias
from urllib.parse import quote

from markupsafe import Markup

from workflow.text.formats import at_least, at_most, number, unit as with_unit

# Rows that a page begins with; those behind them stand in the section of their subject.
ON_THE_FIRST_SCREEN = 5
# Digits of a number where its fact asks for no others: what a drawing or a data sheet gives.
USUAL_DIGITS = 3


class Bound(Enum):
    """What a number says of the value behind it."""

    VALUE = "value"
    AT_LEAST = "at least"  # shown rounded down
    AT_MOST = "at most"  # shown rounded up


@dataclass(frozen=True)
class Quantity:
    """The value of a fact, as text for people and as plain data for programs.

    Attributes:
        text: As people read it, unit included.
        plain: As JSON holds it: a number in `unit`, text, a list or a mapping; None for "not known" or
            "never".
        unit: Of the number; "" for words and pure numbers.
    """

    text: str
    plain: Any
    unit: str = ""

    @classmethod
    def of(
        cls,
        value: float | None,
        unit: str = "",
        *,
        digits: int = USUAL_DIGITS,
        bound: Bound = Bound.VALUE,
        missing: str = "never",
    ) -> Quantity:
        """A number with its unit.

        Args:
            value: In `unit`; None where there is none.
            unit: As it stands behind the number.
            digits: Significant digits.
            bound: A bound is rounded to its safe side, so that what the text says holds.
            missing: The text of None.
        """
        if value is None:
            return cls(missing, None, unit)
        rounded = {Bound.VALUE: number, Bound.AT_LEAST: at_least, Bound.AT_MOST: at_most}[bound]
        text = with_unit(rounded(value, digits), unit)
        if bound is Bound.AT_LEAST:
            text = f"at least {text}"
        if bound is Bound.AT_MOST:
            text = f"at most {text}"
        return cls(text, float(value) if math.isfinite(value) else None, unit)

    @classmethod
    def words(cls, text: str) -> Quantity:
        """What is no number."""
        return cls(text, text)


@dataclass(frozen=True)
class Row:
    """One fact of a result.

    Attributes:
        key: Its place in the JSON answer and in a study, dots between levels: "certificate.modulus_margin".
            "" for a fact that programs read elsewhere.
        name: As people call it, in lower case: "modulus margin".
        value: Number with unit, interval or words.
        remark: What to know beside it: "required: 0.5; smallest at 2.28 Hz".
    """

    key: str
    name: str
    value: Quantity
    remark: str = ""

    @property
    def text(self) -> str:
        """Value and remark in one line: "at least 0.673 (required: 0.5)"."""
        return f"{self.value.text} ({self.remark})" if self.remark else self.value.text


@dataclass(frozen=True)
class Picture:
    """A drawing of `workflow.figures` by its name, with what it is drawn of and its caption."""

    drawing: str
    caption: str
    subjects: tuple[Any, ...] = ()
    file: str = ""  # tells two pictures of one drawing apart
    kind: ClassVar[str] = "picture"


@dataclass(frozen=True)
class Section:
    """What there is to say of one subject, in the order of importance.

    Attributes:
        title: The subject: "closed loop".
        rows: Facts that everybody sees.
        parts: Folded on a page; on a terminal with --verbose only.
    """

    title: str
    rows: tuple[Row, ...] = ()
    parts: tuple[Section, ...] = ()

    def whole(self) -> Iterator[Section]:
        """The section and all of its parts, depth first."""
        yield self
        for part in self.parts:
            yield from part.whole()

    def all_rows(self) -> Iterator[Row]:
        """Rows of the section and of its parts, depth first."""
        for section in self.whole():
            yield from section.rows


@dataclass(frozen=True)
class Text:
    """A paragraph of a page."""

    text: str
    kind: ClassVar[str] = "text"


@dataclass(frozen=True)
class Heading:
    """A title inside a section of a page; anchor: "" where nothing links to it."""

    text: str
    anchor: str = ""
    kind: ClassVar[str] = "heading"


@dataclass(frozen=True)
class Remarks:
    """Sentences in a box: to heed ("warning"), that reassure ("good"), that inform ("note"), or in a plain
    list ("plain"). Nothing where there are none."""

    items: tuple[str, ...]
    tone: Literal["warning", "good", "note", "plain"] = "note"
    title: str = ""
    kind: ClassVar[str] = "remarks"


@dataclass(frozen=True)
class Table:
    """Facts in columns. met: of each row whether it is as required, () where nothing is required."""

    head: tuple[str, ...]
    rows: tuple[tuple[object, ...], ...]
    caption: str = ""
    met: tuple[bool | None, ...] = ()
    kind: ClassVar[str] = "table"


@dataclass(frozen=True)
class Copy:
    """A law to copy. forms: its zeros and poles, polynomials and sections; delay: samples that a controller
    has beside them, None: of a law without a name."""

    title: str
    forms: Mapping[str, Any]
    dt_s: float
    signal: str = "error"
    delay: int | None = None
    kind: ClassVar[str] = "copy"


@dataclass(frozen=True)
class Code:
    """Text as it is typed (`typed`) or printed."""

    text: str
    typed: bool = False
    kind: ClassVar[str] = "code"


@dataclass(frozen=True)
class Fold:
    """What only some will want to see, folded up."""

    title: str
    blocks: tuple[Block, ...]
    kind: ClassVar[str] = "fold"


@dataclass(frozen=True)
class Sketch:
    """An image that is no drawing of `workflow.figures`. image: SVG of ours."""

    image: Markup
    caption: str
    kind: ClassVar[str] = "sketch"


@dataclass(frozen=True)
class PageSection:
    """A part of a page; short: what the contents call it; open: not folded at first."""

    anchor: str
    title: str
    short: str
    blocks: tuple[Block, ...]
    open: bool = False


@dataclass(frozen=True)
class FirstScreen:
    """What a page begins with.

    Attributes:
        headline: The verdict in one line.
        state: "certified", "refused" or "plain".
        rows: At most five are shown.
        bullets: Sentences, the weightiest first; those behind the fifth fold.
        picture: Below the numbers; None without one.
        anchor: Where links to it lead.
        short: What the contents call it.
        beside: Behind the picture.
        below: Behind the bullets.
    """

    headline: str
    state: State
    rows: tuple[Row, ...]
    bullets: tuple[str, ...]
    picture: Picture | None = None
    anchor: str = "verdict"
    short: str = "Verdict"
    beside: tuple[Block, ...] = ()
    below: tuple[Block, ...] = ()


@dataclass(frozen=True)
class Page:
    """A whole page. wide: its tables have many columns."""

    title: str
    first: FirstScreen
    sections: tuple[PageSection, ...]
    wide: bool = False


State: TypeAlias = Literal["certified", "refused", "plain"]
Block: TypeAlias = Text | Heading | Remarks | Table | Picture | Copy | Code | Fold | Sketch


def link(anchor: str, words: str) -> Markup:
    """A link inside a page."""
    return Markup('<a href="#{}">{}</a>').format(anchor, words)


def file_link(file: str, words: str = "") -> Markup:
    """A link to a file beside the page, in words, else by its name; both may come from a user."""
    return Markup('<a href="{}">{}</a>').format(quote(file), words or file)


def file_text(title: str, text: str) -> Fold:
    """A file as it stands, folded."""
    return Fold(title, (Code(text),))


def worded(name: str, text: str) -> Row:
    """A fact in words, on one line, that programs read elsewhere."""
    return Row("", name, Quantity.words(" ".join(text.split())))


def said(*rows: Row | None) -> tuple[Row, ...]:
    """The rows that say something: None and empty ones are left out."""
    return tuple(row for row in rows if row is not None and row.value.text)


def answer(sections: Sequence[Section]) -> dict[str, Any]:
    """Rows by key, nested at the dots, as a JSON answer holds them.

    Raises:
        ValueError: Two rows have one key, or a key is also the beginning of another: one would hide the
            other.
    """
    nested: dict[str, Any] = {}
    for section in sections:
        for row in section.all_rows():
            if row.key:
                _put(nested, row)
    return nested


def _put(nested: dict[str, Any], row: Row) -> None:
    *levels, last = row.key.split(".")
    place = nested
    for level in levels:
        place = place.setdefault(level, {})
        if not isinstance(place, dict):
            raise ValueError(f"the key {row.key!r} begins with the key of another row")
    if last in place:
        raise ValueError(f"two rows have the key {row.key!r}")
    place[last] = row.value.plain


def by_key(sections: Sequence[Section]) -> Mapping[str, Row]:
    """Rows that have a key, by it: for the columns of a study and for Python."""
    return {row.key: row for section in sections for row in section.all_rows() if row.key}
