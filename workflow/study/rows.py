"""One row per point: what was asked, what came of it, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd

from workflow.engine.run_directory import RunDirectory
from workflow.study.columns import COLUMNS, Number, numbers_of
from workflow.study.points import Combination, Point, short
from workflow.study.settings import Axis, ParetoPlot
from workflow.tasks.results import RunResults
from workflow.tasks.summary import verdict_of
from workflow.text.templates import said

State = Literal["certified", "does not come to rest", "not certified", "impossible", "failed"]


@dataclass(frozen=True, eq=False)
class PointRow(Combination):
    """A point in the table. `numbers` has every column, None where there is no number."""

    state: State
    why: str
    numbers: Mapping[str, Number]

    @property
    def good(self) -> bool:
        """Certified, and every run in closed loop settles."""
        return self.state == "certified"


def row_of(point: Point, run: RunDirectory) -> PointRow:
    """The row of a finished point."""
    results, specification = RunResults(run), point.config.specification
    design, certify, loop = results.design, results.certify, results.closed_loop
    state: State
    if design.synthesis is None:
        state = "impossible"
    elif not certify.certified:
        state = "not certified"
    elif loop.check is None or loop.check.settled_draws != loop.check.draws:
        state = "does not come to rest"
    else:
        state = "certified"
    numbers = numbers_of(results, specification.mode_band_rad_s)
    # The certificate is the judge and names every item that is missed; the optimiser only what blocks it.
    why = certify.reason
    if design.gamma is not None and design.gamma > 1:
        achievable, order = results.achievable_performance, specification.controller_order
        advice = said("order_advice", achievable, design.gamma, order)
        why = f"{why}; {advice}" if advice else why
    if certify.certified:
        why = verdict_of(replace(design, met=True), certify, loop)
    return PointRow(point.number, point.name, point.values, state, why, numbers)


def row_without_run(point: Combination, state: State, why: str) -> PointRow:
    """The row of a combination that contradicts itself, or of a point that failed."""
    return PointRow(point.number, point.name, point.values, state, why, dict.fromkeys(COLUMNS))


def csv_text(axes: Sequence[Axis], rows: Sequence[PointRow], front: Sequence[Sequence[int]]) -> str:
    """The table; numbers with every digit, nothing where there is none.

    front: numbers of the points on each Pareto front; a column each.
    """
    records = [
        {
            "number": row.number,
            "name": row.name,
            **{
                a.key: v if isinstance(v := row.values[a.key], (int, float)) else _cell(short(v))
                for a in axes
            },
            "state": row.state,
            **row.numbers,
            **{f"front_{k}": "yes" if row.number in on else "no" for k, on in enumerate(front, 1)},
            "why": _cell(row.why),
        }
        for row in rows
    ]
    # As objects: a whole number stays one beside a cell without a number.
    return str(pd.DataFrame(records, dtype=object).to_csv(index=False, lineterminator="\n"))


def _cell(text: str) -> str:
    """Text that no spreadsheet takes for a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@") else text


def pareto_front(rows: Sequence[PointRow], plot: ParetoPlot) -> list[int]:
    """Numbers of the good points that no other good point beats in one column without losing in the other."""
    names = (plot.x, plot.y)
    placed = [row for row in rows if row.good and None not in [row.numbers[name] for name in names]]
    a, b = ([COLUMNS[name].badness(row.numbers[name] or 0.0) for row in placed] for name in names)
    beats = np.less_equal.outer(a, a) & np.less_equal.outer(b, b)
    beats &= np.less.outer(a, a) | np.less.outer(b, b)  # [j, i]: j beats i
    return [placed[i].number for i in np.flatnonzero(~np.any(beats, axis=0))]
