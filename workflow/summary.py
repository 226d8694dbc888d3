"""The table of numbers at the end of a run: what a reader wants to see before opening the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    label: str
    value: str


@dataclass(frozen=True)
class Section:
    title: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class RunSummary:
    """Rows to read, `numbers` (JSON-able) to compute with, and the verdict in one line.

    `certified` is False when the specification is missed or the certificate fails; the verdict then says by how
    much and at which frequencies.
    """

    title: str
    sections: tuple[Section, ...]
    numbers: Mapping[str, Any] = field(default_factory=dict)
    certified: bool = True
    verdict: str = ""
    report_path: str | None = None

    def to_document(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "title": self.title,
            "certified": self.certified,
            "verdict": self.verdict,
            "report": self.report_path,
            "numbers": dict(self.numbers),
            "table": [
                {"section": section.title, "label": row.label, "value": row.value}
                for section in self.sections
                for row in section.rows
            ],
        }
