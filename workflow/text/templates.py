"""The environments of all templates; they load no matplotlib, so texts for terminals come from them too."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ident.data.finding import Finding
from workflow.text.compiled import CompiledTemplates
from workflow.text.formats import FILTERS, TESTS


@cache
def environment(*own: tuple[str, Callable[..., Any]], package: str = "workflow") -> Environment:
    """The environment of all pages and texts; another package's templates come before ours.

    own: filters (name, function) beside those of all. Everything that comes from the user is escaped.
    """
    made = Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in dict.fromkeys((package, "workflow"))]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        bytecode_cache=None if own else CompiledTemplates(),
    )
    made.filters.update(FILTERS, words=words, labelled=labelled)
    made.filters.update(own)
    made.tests.update(TESTS)
    return made


def labelled(rows: Markup, head: Sequence[str]) -> Markup:
    """Rows of a table whose cells carry the words of their column, for screens too narrow for columns."""

    def of_row(row: re.Match[str]) -> str:
        words = iter(Markup.escape(word) for word in head)
        return re.sub(
            "<td>", lambda _: f'<td data-head="{word}">' if (word := next(words, "")) else "<td>", row[0]
        )

    return Markup(re.sub("<tr.*?</tr>", of_row, rows, flags=re.DOTALL))


def render_text(template: str, **values: Any) -> str:
    """Plain text by template: for terminals and files. Nothing is escaped."""
    return Markup(environment().get_template(template).render(**values)).unescape()


def said(macro: str, *values: Any) -> str:
    """A sentence of sentences.j2 by the name of its macro, on one line; empty where nothing is to be said."""
    return _plain(getattr(environment().get_template("sentences.j2").module, macro)(*values))


def words(found: Finding) -> str:
    """The sentence of findings.j2 that says what ident found."""
    return _plain(getattr(_findings(), found.kind.name.lower())(found.values))


@cache
def _findings() -> Any:
    return environment().get_template("findings.j2").module


class Row(NamedTuple):
    """One line of a table."""

    label: str
    value: str


class Section(NamedTuple):
    title: str
    rows: Sequence[Row]


def rows_of(
    template: str, filters: Iterable[tuple[str, Callable[..., Any]]] = (), **values: Any
) -> list[Section]:
    """A table by template: plain text on one line each.

    The template calls part("title") and {% call line("label") %}value{% endcall %}; an empty value is no row,
    a part without rows no section. filters: (name, function) beside those of all.
    """
    parts: list[tuple[str, list[Row]]] = []

    def part(title: str) -> str:
        parts.append((_plain(title), []))
        return ""

    def line(label: str, caller: Callable[[], str]) -> str:
        value = _plain(caller())
        if value:
            parts[-1][1].append(Row(_plain(label), value))
        return ""

    environment(*filters).get_template(template).render(part=part, line=line, **values)
    return [Section(title, rows) for title, rows in parts if rows]


def _plain(text: str) -> str:
    """Without escapes, on one line."""
    return " ".join((text.unescape() if isinstance(text, Markup) else str(text)).split())
