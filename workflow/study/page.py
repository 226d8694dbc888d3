"""The study's page: what is best, the Pareto plots, every point, and why some are not certified."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from workflow.figures.study import Mark, Panel, draw_pareto
from workflow.figures.style import Picture, render
from workflow.report.page import Block, Code, Plot, Remarks, Section, Table, Text
from workflow.report.rendering import page
from workflow.study.columns import COLUMNS, Column, Number
from workflow.study.points import short
from workflow.study.rows import PointRow, State
from workflow.study.settings import Axis, ParetoPlot, StudyConfig

_CERTIFIED = (
    "worst_gamma",
    "any_order_gamma",
    "whole_held_percent",
    "modulus_margin",
    "gain_margin_dB",
    "phase_margin_deg",
    "delay_margin_ms",
    "bandwidth_rad_s",
    "mode_damping",
)
_ACHIEVED = (
    "predicted_peak_sensitivity",
    "measured_peak_sensitivity",
    "matching_error",
    "rise_time_s",
    "settling_time_s",
    "overshoot_percent",
    "peak_command",
    "disturbance_peak",
)
_MOST_REASONS = 60


def study_pictures(
    plots: Sequence[ParetoPlot],
    rows: Sequence[PointRow],
    fronts: Sequence[Sequence[int]],
    units: Mapping[str, str],
) -> dict[str, Picture]:
    """The Pareto plots as one picture. units: those of columns whose unit the rig decides."""
    panels = [_panel(plot, rows, front, units) for plot, front in zip(plots, fronts, strict=True)]
    return {"pareto": render(draw_pareto(panels))}


def study_page(
    title: str,
    config: StudyConfig,
    text: str,
    base: str,
    rows: Sequence[PointRow],
    fronts: Sequence[Sequence[int]],
    pictures: dict[str, Picture],
    units: Mapping[str, str],
) -> str:
    """The page as HTML. units: as for the pictures."""
    sections = [
        Section("pareto", "What can be had together", "Pareto", _pareto_blocks(config, rows, fronts)),
        Section(
            "points", "All points", "Points", (*point_tables(config.axes, rows, units), *_points_words())
        ),
        *_reasons(rows),
        Section("study", "How it was made", "Made", _made(config, text, base)),
    ]
    return page(
        "study.html.j2",
        title=title,
        sections=sections,
        pictures=pictures,
        headline=headline(rows),
        good=any(row.good for row in rows),
        found=findings(config.axes, rows),
    )


def headline(rows: Sequence[PointRow]) -> str:
    """One line: how many points, how many certified."""
    counts = Counter(row.state for row in rows)
    others = [f"{counts[state]} {state}" for state in _OTHER_STATES if counts[state]]
    first = f"{counts['certified']} of {len(rows)} points certified"
    return ", ".join([first, *others])


_OTHER_STATES: tuple[State, ...] = ("not certified", "does not settle", "impossible", "failed")


def findings(axes: Sequence[Axis], rows: Sequence[PointRow]) -> list[str]:
    """The best certified point by each of the columns one asks for first."""
    found = []
    for name in ("worst_gamma", "bandwidth_rad_s", "modulus_margin", "rise_time_s"):
        column = COLUMNS[name]
        placed = [(column.badness(float(v)), row) for row in rows if row.good and (v := row.numbers[name])]
        if placed:
            _, best = min(placed, key=lambda item: (item[0], item[1].number))
            word = "Largest" if column.better == "larger" else "Smallest"
            value = f"{_cell(best.numbers[name])} {column.unit}".rstrip()
            asked = ", ".join(f"{axis.name} {short(best.values[axis.key])}" for axis in axes)
            found.append(f"{word} {column.label}: {value}, point {best.number} ({asked}).")
    return found


def _panel(
    plot: ParetoPlot, rows: Sequence[PointRow], front: Sequence[int], units: Mapping[str, str]
) -> Panel:
    x, y = COLUMNS[plot.x], COLUMNS[plot.y]
    marks = []
    for row in rows:
        a, b = row.numbers[plot.x], row.numbers[plot.y]
        if a is not None and b is not None:
            marks.append(Mark(row.number, float(a), float(b), row.good, row.number in front))
    return Panel(
        _heading(x, units),
        _heading(y, units),
        str(x.better),
        str(y.better),
        tuple(marks),
        missing=len(rows) - len(marks),
    )


def _pareto_blocks(
    config: StudyConfig, rows: Sequence[PointRow], fronts: Sequence[Sequence[int]]
) -> tuple[Block, ...]:
    words = [
        f"{COLUMNS[plot.y].label} against {COLUMNS[plot.x].label}: "
        + (
            f"points {', '.join(str(n) for n in front)} are on the front."
            if front
            else "no certified point has both numbers."
        )
        for plot, front in zip(config.pareto, fronts, strict=True)
    ]
    caption = (
        "Filled: certified, and every run in closed loop settles; coloured and numbered as in the table: no "
        "other certified point is better in one and as good in the other. Grey: dominated. Hollow: not "
        "certified, or some run does not settle; nothing is promised there."
    )
    return (Plot("pareto", caption), Remarks(tuple(words), "note"))


def point_tables(
    axes: Sequence[Axis], rows: Sequence[PointRow], units: Mapping[str, str]
) -> tuple[Table, Table]:
    """What is certified of every point, and what its closed loop did."""
    first = Table(
        *_cells(axes, rows, units, _CERTIFIED, ("state", [row.state for row in rows])),
        caption="Left of the worst-case gamma what was asked, right of it what came of it, the worst over "
        "the ellipses. Gamma at most 1: the specification is met. Gamma of any order: what a controller of "
        "any order is known to reach. Whole responses within gamma: share of the responses drawn from the "
        "posterior whose own worst value is no larger than that of the ellipses.",
        met=tuple(row.good for row in rows),
    )
    runs = [
        ""
        if row.numbers["settled_draws"] is None
        else f"{row.numbers['settled_draws']} of {row.numbers['draws']}"
        for row in rows
    ]
    second = Table(
        *_cells(axes, rows, units, _ACHIEVED, ("settle", runs)),
        caption="The closed loop over time, the worst over its runs; a dash is a run that does not get "
        "there (settling: to 2 % of the step). Peak of S, where it was measured: predicted for the nominal "
        "loop, measured on the arm as identified, with all its friction. Model-matching error: with the "
        "prefilter, where there is one.",
        met=tuple(
            None if (n := row.numbers)["draws"] is None else n["settled_draws"] == n["draws"] for row in rows
        ),
    )
    return first, second


def _cells(
    axes: Sequence[Axis],
    rows: Sequence[PointRow],
    units: Mapping[str, str],
    names: Sequence[str],
    last: tuple[str, Sequence[str]],
) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Head and rows: point, what was asked, the numbers, one column more. A column that no point has a number
    in was not asked for."""
    shown = [name for name in names if any(row.numbers[name] is not None for row in rows)]
    heads = ("point", *(axis.name for axis in axes), *(_heading(COLUMNS[name], units) for name in shown))
    cells = [
        (
            str(row.number),
            *(short(row.values[axis.key]) for axis in axes),
            *(_cell(row.numbers[name]) for name in shown),
            extra,
        )
        for row, extra in zip(rows, last[1], strict=True)
    ]
    return (*heads, last[0]), tuple(cells)


def _points_words() -> tuple[Block, ...]:
    return (
        Text(
            "table.csv and table.json have these numbers with every digit and more of them. Every point is a "
            "run directory: flexlink report DIR/points/NAME writes its page, and its config.toml can be run "
            "by itself."
        ),
    )


def _reasons(rows: Sequence[PointRow]) -> tuple[Section, ...]:
    missed = [row for row in rows if not row.good]
    if not missed:
        return ()
    # Points of one design miss the same items.
    together: dict[tuple[str, str], list[str]] = {}
    for row in missed:
        together.setdefault((row.state, row.why), []).append(str(row.number))
    listed = [
        f"{'Point' if len(numbers) == 1 else 'Points'} {', '.join(numbers)} ({state}): {why}"
        for (state, why), numbers in together.items()
    ]
    if len(listed) > _MOST_REASONS:
        listed[_MOST_REASONS:] = [f"{len(listed) - _MOST_REASONS} reasons more: see table.csv."]
    return (Section("why", "Why not certified", "Why not", (Remarks(tuple(listed), "warning"),)),)


def _made(config: StudyConfig, text: str, base: str) -> tuple[Block, ...]:
    how = (
        "every combination of the axes"
        if config.search.method == "grid"
        else f"a Parzen search for {', '.join(COLUMNS[name].label for name in config.search.objectives)}, "
        f"{config.search.trials} trials in batches of {config.search.batch}"
    )
    return (
        Text(
            f"Base: {base}. Points: {how}. Records, model and ellipses are shared by all points that leave "
            "them as they are; all points use the same random streams, so that differences between them are "
            "not luck."
        ),
        Code("The study's file", text),
    )


def _heading(column: Column, units: Mapping[str, str]) -> str:
    unit = column.unit or units.get(column.name, "")
    return f"{column.label} [{unit}]" if unit else column.label


def _cell(value: Number) -> str:
    if value is None:
        return "–"
    return str(value) if isinstance(value, int) else f"{value:.4g}"
