"""Sections whose rows a template words, until a typed function of this package does."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from workflow.describe.facts import Quantity, Row, Section
from workflow.text.templates import environment, plain_line


def rows_of(
    template: str, filters: Iterable[tuple[str, Callable[..., Any]]] = (), **values: Any
) -> list[Section]:
    """Sections by template: plain text on one line each.

    The template calls part("title") and {% call line("label") %}value{% endcall %}; an empty value is no row,
    a part without rows no section.

    Args:
        template: Its name.
        filters: (name, function) beside those of all templates.
        values: What the template sees.
    """
    parts: list[tuple[str, list[Row]]] = []

    def part(title: str) -> str:
        parts.append((plain_line(title), []))
        return ""

    def line(label: str, caller: Callable[[], str]) -> str:
        value = plain_line(caller())
        if value:
            parts[-1][1].append(Row("", plain_line(label), Quantity.words(value)))
        return ""

    environment(*filters).get_template(template).render(part=part, line=line, **values)
    return [Section(title, tuple(rows)) for title, rows in parts if rows]
