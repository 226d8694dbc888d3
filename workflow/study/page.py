"""The study's page and what the terminal says of it; every sentence stands in the templates `study*.j2`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from workflow.engine import codec
from workflow.study.columns import COLUMNS, Column
from workflow.study.points import short
from workflow.study.rows import PointRow, State, pareto_front
from workflow.study.settings import StudyConfig
from workflow.tasks.summary import RunSummary
from workflow.text.templates import render_text, rows_of

_BEST_BY = ("worst_gamma", "bandwidth_rad_s", "modulus_margin", "rise_time_s")


@dataclass(frozen=True, eq=False)
class StudyView:
    """A finished study. text: its file; units: those of columns whose unit the rig decides."""

    title: str
    config: StudyConfig
    text: str
    base: str
    rows: Sequence[PointRow]
    units: Mapping[str, str]

    @cached_property
    def fronts(self) -> list[list[int]]:
        """Numbers of the points on the Pareto front of each plot of the settings."""
        return [pareto_front(self.rows, plot) for plot in self.config.pareto]

    @property
    def counts(self) -> Mapping[State, int]:
        return Counter(row.state for row in self.rows)

    def column(self, name: str) -> Column:
        return COLUMNS[name]

    def unit(self, name: str) -> str:
        return COLUMNS[name].unit or self.units.get(name, "")

    def asked(self, row: PointRow) -> dict[str, str]:
        """What was asked of a point: value by name of the axis."""
        return {axis.name: short(row.values[axis.key]) for axis in self.config.axes}

    def known(self, names: Sequence[str]) -> list[str]:
        """Those columns that some point has a number in: the others were not asked for."""
        return [name for name in names if any(row.numbers[name] is not None for row in self.rows)]

    @property
    def best(self) -> list[tuple[Column, PointRow]]:
        """The best certified point by each of the columns one asks for first."""
        found = []
        for column in (COLUMNS[name] for name in _BEST_BY):
            good = [row for row in self.rows if row.good and row.numbers[column.name]]
            if good:
                key = column.name
                found.append(
                    (column, min(good, key=lambda row: (column.badness(row.numbers[key] or 0), row.number)))
                )
        return found

    @property
    def reasons(self) -> list[tuple[State, str, list[int]]]:
        """State and reason of the points that are not good; points of one design miss the same items."""
        together: dict[tuple[State, str], list[int]] = {}
        for row in self.rows:
            if not row.good:
                together.setdefault((row.state, row.why), []).append(row.number)
        return [(state, why, numbers) for (state, why), numbers in together.items()]

    def heading(self, name: str) -> str:
        unit = self.unit(name)
        return f"{COLUMNS[name].label} [{unit}]" if unit else COLUMNS[name].label

    @property
    def document(self) -> Any:
        """What table.json holds."""
        return codec.plain(
            {
                "title": self.title,
                "columns": {
                    name: {"label": column.label, "unit": column.unit, "better": column.better}
                    for name, column in COLUMNS.items()
                },
                "fronts": [
                    {"x": plot.x, "y": plot.y, "points": front}
                    for plot, front in zip(self.config.pareto, self.fronts, strict=True)
                ],
                "points": self.rows,
            }
        )


def study_summary(study: StudyView, path: str) -> RunSummary:
    """What the terminal says of it."""
    return RunSummary(
        title=study.title,
        sections=rows_of("study_summary.j2", study=study),
        numbers=study.document,
        certified=any(row.good for row in study.rows),
        verdict=render_text("study_verdict.j2", study=study).strip(),
        report_path=path,
    )
