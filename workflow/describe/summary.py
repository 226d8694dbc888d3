"""What a command says at its end: its rows, its numbers for programs, and its verdict in one line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from workflow.describe.facts import Section


@dataclass(frozen=True)
class RunSummary:
    """Rows to read, numbers to compute with, and the verdict.

    Attributes:
        title: What it is about.
        sections: A terminal shows their rows; with --verbose those of their parts, too.
        numbers: JSON-able.
        certified: False when the specification is missed or the certificate fails; the verdict then says by
            how much and at which frequencies. None: nothing was to be certified.
        verdict: One line.
        report_path: Of the page; None without one.
        taken_over: Stages of a run that came from other runs, by the run; None: no run.
    """

    title: str
    sections: Sequence[Section]
    numbers: Mapping[str, Any] = field(default_factory=dict)
    certified: bool | None = None
    verdict: str = ""
    report_path: str | None = None
    taken_over: Mapping[str, Sequence[str]] | None = None

    def to_document(self) -> dict[str, Any]:
        """What --json prints: `numbers`, and every row with its section, its name and its text."""
        document: dict[str, Any] = {"title": self.title}
        if self.certified is not None:
            document["certified"] = self.certified
        document["verdict"] = self.verdict
        document["report"] = self.report_path
        if self.taken_over is not None:
            document["taken_over"] = self.taken_over
        document["numbers"] = dict(self.numbers)
        document["table"] = [
            {"section": part.title, "label": row.name, "value": row.text}
            for section in self.sections
            for part in section.whole()
            for row in part.rows
        ]
        return document
