"""Rows of a study's table, what is best of them, and its Pareto plots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from workflow.config.run_config import RunConfig
from workflow.describe.design import gave_way_text, never_settles, run_verdict
from workflow.engine import codec
from workflow.engine.run_directory import RunDirectory
from workflow.figures import style
from workflow.figures.description import Panel, Picture, pad_limits, small_multiples
from workflow.kinds import kind_of, summarise
from workflow.study.columns import COLUMNS, StudyColumn, numbers_of
from workflow.study.points import Point, PointRow, State, short
from workflow.study.settings import ParetoPlot, StudyAxis, StudyConfig
from workflow.tasks.giving_way import gave_way
from workflow.text.sentences.design import lowered as lowered_text, order_advice


def row_of(point: Point, run: RunDirectory) -> PointRow:
    """The row of a finished point."""
    config = point.config
    results: Any = kind_of(config).results(run)
    design = results.design
    certify = results.certify
    numbers = numbers_of(results, config)
    all_settle = numbers["settled_draws"] and numbers["settled_draws"] == numbers["draws"]
    state: State
    if design.synthesis is None:
        state = "impossible"
    elif not certify.certified:
        state = "not certified"
    elif all_settle:
        state = "certified"
    else:
        state = "keeps moving"

    if not isinstance(config, RunConfig):
        # Several joints have no check of tracking: a run at rest beside the reference looks like one that
        # moves.
        if state == "keeps moving":
            state = "does not settle"
        why = summarise(results, config).verdict
        return PointRow(point.number, point.name, point.values, state, why, numbers)
    specification = config.specification
    check = results.closed_loop.check
    # The certificate is the judge and names every item that is missed; the optimiser only what blocks it.
    why = certify.reason
    if design.gamma is not None and design.gamma > 1:
        bracket = results.achievable_performance.bracket
        advice = order_advice(bracket, design.gamma, specification.controller_order, specification.structure)
        if advice:
            why = f"{why}; {advice}"
    if certify.certified:
        conditions = results.uncertainty.conditions(config)
        why = run_verdict(replace(design, met=True), certify, results.closed_loop, conditions=conditions)

    lowered = lowered_text(specification, design.specification, (), numbers["bandwidth_rad_s"] or 0)
    never_arrives = False
    if state == "certified" and check and check.tracking:
        *_, longest_settling_s = check.spread_of("settling_time_s")
        never_arrives = longest_settling_s is None
    if check and never_arrives:
        # At rest, but beside the reference: certified, and yet of no use.
        state = "does not settle"
        why = never_settles(check)
    elif state == "certified" and lowered:
        state = "certified at a lower bandwidth"
    given_way = gave_way_text(gave_way(specification, design.specification))
    if given_way:
        why = f"designed for {given_way}; {why}"
    if lowered:
        why = f"{lowered}; {why}"
    return PointRow(point.number, point.name, point.values, state, why, numbers)


def csv_text(axes: Sequence[StudyAxis], rows: Sequence[PointRow], front: Sequence[Sequence[int]]) -> str:
    """The table; numbers with every digit, nothing where there is none.

    front: numbers of the points on each Pareto front; a column each.
    """
    records = []
    for row in rows:
        record: dict[str, Any] = {"number": row.number, "name": row.name}
        for axis in axes:
            value = row.values[axis.key]
            record[axis.key] = value if isinstance(value, (int, float)) else _cell(short(value))
        record["state"] = row.state
        record |= row.numbers
        for k, points_on_front in enumerate(front, 1):
            record[f"front_{k}"] = "yes" if row.number in points_on_front else "no"
        record["why"] = _cell(row.why)
        records.append(record)
    # As objects: a whole number stays one beside a cell without a number.
    return str(pd.DataFrame(records, dtype=object).to_csv(index=False, lineterminator="\n"))


def _cell(text: str) -> str:
    """Text that no spreadsheet takes for a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@") else text


def pareto_front(rows: Sequence[PointRow], plot: ParetoPlot) -> list[int]:
    """Numbers of the good points that no other good point beats in one column without losing in the other."""
    names = (plot.x, plot.y)
    # A point without one of the two numbers is on no front.
    placed = []
    for row in rows:
        has_both = None not in [row.numbers[name] for name in names]
        if row.good and has_both:
            placed.append(row)
    x, y = ([COLUMNS[name].badness(row.numbers[name] or 0.0) for row in placed] for name in names)
    # beats[j, i]: j is nowhere worse than i, and somewhere better.
    beats = np.less_equal.outer(x, x) & np.less_equal.outer(y, y)
    beats &= np.less.outer(x, x) | np.less.outer(y, y)
    return [placed[i].number for i in np.flatnonzero(~np.any(beats, axis=0))]


# Axes that change what is required of a point begin like this...
_REQUIREMENTS = ("specification", "joints[")
# ... except those that change the controller only.
_CONTROLLERS = ("specification.controller_order", "specification.structure")
# Columns by which the best point is named, in the order in which one asks for them.
_BEST_BY = ("worst_gamma", "bandwidth_rad_s", "modulus_margin", "disk_margin", "rise_time_s")


@dataclass(frozen=True, eq=False)
class StudyView:
    """A finished study. text: its file; units: those of columns whose unit the rig decides; left_out: as
    in `Base`."""

    title: str
    config: StudyConfig
    text: str
    base: str
    rows: Sequence[PointRow]
    units: Mapping[str, str]
    left_out: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def fronts(self) -> list[list[int]]:
        """Numbers of the points on the Pareto front of each plot of the settings."""
        return [pareto_front(self.rows, plot) for plot in self.config.pareto]

    @property
    def in_order(self) -> list[PointRow]:
        """The good points first, each kind by its number."""
        return sorted(self.rows, key=lambda row: not row.good)

    @property
    def counts(self) -> Mapping[State, int]:
        return Counter(row.state for row in self.rows)

    def column(self, name: str) -> StudyColumn:
        return COLUMNS[name]

    def unit(self, name: str) -> str:
        return COLUMNS[name].unit or self.units.get(name, "")

    def asked(self, row: PointRow) -> dict[str, str]:
        """What was asked of a point: value by name of the axis."""
        return {axis.name: short(row.values[axis.key]) for axis in self.config.axes}

    def known(self, names: Sequence[str]) -> list[str]:
        """Columns in which some point has a number, of `names`; the others were not asked for."""
        return [name for name in names if any(row.numbers[name] is not None for row in self.rows)]

    @property
    def best(self) -> list[tuple[StudyColumn, PointRow]]:
        """The best certified point by each of the columns one asks for first."""
        # Where requirements differ, so does what a gamma of 1 means.
        differ = any(row.lowered for row in self.rows)
        for axis in self.config.axes:
            if axis.key.startswith(_REQUIREMENTS) and axis.key not in _CONTROLLERS:
                differ = True

        best = []
        for name in _BEST_BY:
            if differ and name == "worst_gamma":
                continue
            column = COLUMNS[name]
            ranked = []
            for row in self.rows:
                number = row.numbers[name]
                if row.good and number:
                    # Of two that are as good, the one with the lower number.
                    ranked.append((column.badness(number), row.number, row))
            if ranked:
                best.append((column, min(ranked)[-1]))
        return best

    @property
    def reasons(self) -> list[tuple[State, str, list[int]]]:
        """State and reason of the points that miss something; points of one design miss the same items."""
        # Points of one design share its verdict, word for word.
        together: dict[tuple[State, str], list[int]] = {}
        for row in self.rows:
            if row.state != "certified":
                together.setdefault((row.state, row.why), []).append(row.number)
        return [(state, why, numbers) for (state, why), numbers in together.items()]

    def heading(self, name: str) -> str:
        unit = self.unit(name)
        return f"{COLUMNS[name].label} [{unit}]" if unit else COLUMNS[name].label

    @property
    def document(self) -> Any:
        """What table.json holds."""
        columns = {}
        for name, column in COLUMNS.items():
            columns[name] = {"label": column.label, "unit": column.unit, "better": column.better}
        fronts = []
        for plot, front in zip(self.config.pareto, self.fronts, strict=True):
            fronts.append({"x": plot.x, "y": plot.y, "points": front})
        return codec.plain({"title": self.title, "columns": columns, "fronts": fronts, "points": self.rows})


# A point of a Pareto plot: in front of the line between those of the front.
_DOT: dict[str, Any] = {"ls": "none", "zorder": 3, "marker": "o", "ms": 6}
# A point that is not certified, or does not settle.
_HOLLOW = _DOT | {"mfc": "none", "mec": style.LIMIT, "mew": 1.2}
# Around a point that is certified at a lower bandwidth than specified.
_RING = _HOLLOW | {"ms": 11}
# A good point that another one beats.
_DOMINATED = _DOT | {"color": "#a8adb4", "mew": 0}
# A good point that no other one beats.
_FRONT = _DOT | {"color": style.PREDICTED, "marker": "D", "ms": 7, "mew": 0}


@style.drawing("pareto")
def draw_pareto(study: StudyView) -> Picture:
    """Pareto plots of a study: certified points filled (those on the front coloured, with their numbers),
    others hollow."""
    plots = study.config.pareto
    picture, places = small_multiples(len(plots), min(len(plots), 2), 4.3, 0.4)
    for panel, plot, front in zip(places, plots, study.fronts, strict=True):
        _draw(panel, study, plot, front)
    return picture


def _draw(panel: Panel, study: StudyView, plot: ParetoPlot, front: list[int]) -> None:
    """One plot of a study; front: numbers of the points on it."""
    x_column = study.column(plot.x)
    y_column = study.column(plot.y)
    x_label = study.heading(plot.x)
    y_label = study.heading(plot.y)
    short_x = style.plain(x_label, 40)
    short_y = style.plain(y_label, 40)
    panel.set(
        xlabel=f"{short_x} ({x_column.better} is better)",
        ylabel=f"{short_y} ({y_column.better} is better)",
    )
    panel.set_title(style.plain(f"{y_label} against {x_label}", 70))

    # A point without one of the two numbers has no place, but it is counted.
    at = np.array([(row.numbers[plot.x], row.numbers[plot.y]) for row in study.rows], dtype=np.float64)
    has_place = ~np.isnan(at).any(axis=1)
    if not has_place.all():
        words = f"{np.count_nonzero(~has_place)} not drawn: no number here"
        panel.words(words, 0.99, 0.01, across_x=True, across_y=True, horizontal="right")

    number = np.array([row.number for row in study.rows])
    good = np.array([row.good for row in study.rows])
    on_front = np.isin(number, front)
    for kind, label, look in (
        (~good, "not certified, or does not settle", _HOLLOW),
        (good & ~on_front, "certified, dominated", _DOMINATED),
        (on_front, "certified, on the front", _FRONT),
    ):
        drawn = kind & has_place
        if drawn.any():
            panel.plot(*at[drawn].T, label=label, **look)
    lowered = has_place & np.array([row.lowered for row in study.rows])
    if lowered.any():
        panel.plot(*at[lowered].T, label="certified at a lower bandwidth than specified", **_RING)

    # The front as a line from left to right, points above one another from bottom to top.
    if on_front.sum() > 1:
        places = at[on_front]
        along_x = np.lexsort((places[:, 1], places[:, 0]))
        along = places[along_x]
        panel.plot(*along.T, color=style.PREDICTED, lw=0.9, ls=":", zorder=2)
    if has_place.any():
        x, y = at[has_place].T
        x_limits = pad_limits(x.min(), x.max(), 0.1)
        y_limits = pad_limits(y.min(), y.max(), 0.1)
        panel.set(xlim=x_limits, ylim=y_limits)
        _number(panel, at[on_front], number[on_front])


def _number(panel: Panel, at: npt.NDArray[np.float64], number: npt.NDArray[np.int64]) -> None:
    """Numbers as in the table at places (P, 2), those of points in one place together."""
    # A fiftieth of the axes: closer together, two labels would lie on one another.
    x_shares = panel.x.shares(at[:, 0])
    y_shares = panel.y.shares(at[:, 1])
    shares = np.rint(50 * np.column_stack([x_shares, y_shares]))
    for share in np.unique(shares, axis=0):
        here = np.all(shares == share, axis=1)
        numbers = ", ".join(map(str, sorted(number[here])))
        words = style.plain(numbers, 18)
        panel.words(words, *at[here][0], offset=(6.0, 5.0), size=8.5, color=style.REFERENCE)
