"""The study's page and what the terminal says of it; every sentence stands in the templates `study*.j2`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from workflow.figures.study import Mark, Panel
from workflow.report.rendering import RenderedPage, render_page
from workflow.study.columns import COLUMNS, Column
from workflow.study.points import short
from workflow.study.rows import PointRow, State
from workflow.study.settings import ParetoPlot, StudyConfig
from workflow.tasks.summary import RunSummary
from workflow.text.templates import render_text, rows_of

_BEST_BY = ("worst_gamma", "bandwidth_rad_s", "modulus_margin", "rise_time_s")


@dataclass(frozen=True, eq=False)
class StudyView:
    """A finished study. text: its file; fronts: numbers of the points on the Pareto front of each plot of the
    settings; units: those of columns whose unit the rig decides."""

    config: StudyConfig
    text: str
    base: str
    rows: Sequence[PointRow]
    fronts: Sequence[Sequence[int]]
    units: Mapping[str, str]

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

    @property
    def panels(self) -> list[Panel]:
        plots = zip(self.config.pareto, self.fronts, strict=True)
        return [self._panel(plot, front) for plot, front in plots]

    def _panel(self, plot: ParetoPlot, front: Sequence[int]) -> Panel:
        marks = []
        for row in self.rows:
            a, b = row.numbers[plot.x], row.numbers[plot.y]
            if a is not None and b is not None:
                marks.append(Mark(row.number, float(a), float(b), row.good, row.number in front))
        x, y = COLUMNS[plot.x], COLUMNS[plot.y]
        return Panel(
            self._heading(x),
            self._heading(y),
            str(x.better),
            str(y.better),
            tuple(marks),
            missing=len(self.rows) - len(marks),
        )

    def _heading(self, column: Column) -> str:
        unit = self.unit(column.name)
        return f"{column.label} [{unit}]" if unit else column.label


def study_page(title: str, study: StudyView) -> RenderedPage:
    """The page with its pictures."""
    return render_page("study.html.j2", title=title, study=study)


def study_summary(title: str, study: StudyView, numbers: Mapping[str, Any], path: str) -> RunSummary:
    """What the terminal says of it."""
    return RunSummary(
        title=title,
        sections=rows_of("study_summary.j2", study=study),
        numbers=numbers,
        certified=any(row.good for row in study.rows),
        verdict=render_text("study_verdict.j2", study=study).strip(),
        report_path=path,
    )
