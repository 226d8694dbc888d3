"""A finished study in words: rows for a terminal, and a page."""

from __future__ import annotations

from collections.abc import Sequence

from workflow.describe.facts import (
    FirstScreen,
    Fold,
    Page,
    PageSection,
    Picture,
    Quantity,
    Remarks,
    Row,
    Section,
    Table,
    Text,
    file_link,
    file_text,
)
from workflow.describe.summary import RunSummary
from workflow.study.columns import StudyColumn
from workflow.study.page import StudyView
from workflow.study.points import PointRow, State
from workflow.text.formats import MISSING, number, sentence, si

# Points up to which the table of all of them is unfolded: a screen holds no more.
MOST_UNFOLDED = 12
# Reasons on the first screen, and on the page; the table of the study has all.
_FIRST_REASONS, _MOST_REASONS = 2, 60

_CERTIFIED = (
    "worst_gamma",
    "any_order_gamma",
    "whole_held_percent",
    "modulus_margin",
    "gain_margin_dB",
    "phase_margin_deg",
    "delay_margin_ms",
    "disk_margin",
    "bandwidth_rad_s",
    "design_bandwidth_rad_s",
    "mode_damping",
)
# Of the above, shown where some point was designed for another one than specified.
_OF_LOWERED = "design_bandwidth_rad_s"
_ACHIEVED = (
    "predicted_peak_sensitivity",
    "measured_peak_sensitivity",
    "matching_error",
    "rise_time_s",
    "settling_time_s",
    "settling_time_with_friction_s",
    "overshoot_percent",
    "peak_command",
    "disturbance_peak",
)
_ON_TERMINAL = ("worst_gamma", "modulus_margin", "disk_margin", "bandwidth_rad_s")
# State -> what one point of it, and several of them, are.
_NOT_GOOD: dict[State, tuple[str, str]] = {
    "not certified": ("not certified", "not certified"),
    "does not settle": ("certified but not settling", "certified but not settling"),
    "keeps moving": ("keeps moving", "keep moving"),
    "impossible": ("impossible", "impossible"),
    "failed": ("failed", "failed"),
}


def headline(study: StudyView) -> str:
    """How many points are certified, and what the others are."""
    counts = study.counts
    lower = counts.get("certified at a lower bandwidth", 0)
    words = f"{counts.get('certified', 0) + lower} of {len(study.rows)} points certified"
    if lower:
        words += f", {lower} of them at a lower bandwidth than specified"
    if counts.get("does not settle"):
        words += " and settling"
    for state, (singular, plural) in _NOT_GOOD.items():
        points = counts.get(state, 0)
        if points:
            words += f", {points} {singular if points == 1 else plural}"
    return words


def verdict_words(study: StudyView) -> str:
    """The study in one line: its headline, or why its first point is not certified where none is."""
    if any(row.good for row in study.rows):
        return headline(study)
    return f"no point is certified: {study.rows[0].why}"


def value_words(value: float | None) -> str:
    """A number of a point; whole ones are counts."""
    if value is None:
        return MISSING
    return str(value) if isinstance(value, int) else number(value, 4)


def asked_words(study: StudyView, row: PointRow) -> str:
    """What was asked of a point: "mass 1, damping 0.1"."""
    return ", ".join(f"{name} {value}" for name, value in study.asked(row).items())


def left_out_words(study: StudyView) -> str:
    """Fallbacks of the base that points do not have; "" where none was left out."""
    parts = []
    for limit, value in study.left_out.items():
        what = "bandwidth" if limit == "lowest_bandwidth_rad_s" else limit.removeprefix("highest_")
        parts.append(
            f"each point is designed for the {what} of its axis ({limit} = {number(value)} of the base is "
            "left out)"
        )
    return "; ".join(parts)


def best_words(study: StudyView, column: StudyColumn, row: PointRow) -> str:
    """The best point by a column: "Largest bandwidth: 5.2 rad/s, point 3 (mass 1, damping 0.1)."."""
    largest = "Largest" if column.better == "larger" else "Smallest"
    value = value_words(row.numbers[column.name])
    value += f" {column.unit}" if column.unit else ""
    return f"{largest} {column.label}: {value}, point {row.number} ({asked_words(study, row)})."


def study_summary(study: StudyView, path: str) -> RunSummary:
    """What a terminal and --json say of it. path: of the page."""
    return RunSummary(
        title=study.title,
        sections=study_sections(study),
        numbers=study.document,
        certified=any(row.good for row in study.rows),
        verdict=verdict_words(study),
        report_path=path,
    )


def study_sections(study: StudyView) -> list[Section]:
    """Rows of a terminal."""
    left_out = left_out_words(study)
    head = [_said("points", headline(study))]
    if left_out:
        head.append(_said("bandwidth", left_out))
    best = tuple(_said("", best_words(study, column, row)) for column, row in study.best)
    known = study.known(_ON_TERMINAL)
    points = []
    for row in study.in_order:
        words: str = row.state
        for name in known:
            value = row.numbers[name]
            if value is not None:
                column = study.column(name)
                words += f", {column.label} {si(value, column.unit, 4)}"
        points.append(_said(f"{row.number}: {asked_words(study, row)}".strip(), words))
    sections = [Section("study", tuple(head)), Section("best", best), Section("points", tuple(points))]
    return [section for section in sections if section.rows]


def _said(name: str, words: str) -> Row:
    return Row("", name, Quantity.words(words))


def study_page(study: StudyView) -> Page:
    """The page of a study: what is best, the Pareto plots, every point, and why some are not certified."""
    reasons = []
    for state, why, points in study.reasons:
        numbers = ", ".join(map(str, points))
        plural = "" if len(points) == 1 else "s"
        reasons.append(f"Point{plural} {numbers} ({state}): {why}")
    first = FirstScreen(
        headline(study),
        "certified" if any(row.good for row in study.rows) else "refused",
        tuple(_best_row(study, column, row) for column, row in study.best),
        tuple(reasons[:_FIRST_REASONS]) or ("All points are certified",),
        _picture(study),
        short="Outcome",
    )
    sections = [_points_section(study)]
    if len(reasons) > _FIRST_REASONS:
        shown = reasons[_FIRST_REASONS:_MOST_REASONS]
        if len(reasons) > _MOST_REASONS:
            shown.append(f"{len(reasons) - _MOST_REASONS} reasons more: see table.csv.")
        sections.append(
            PageSection("why", "What the other points miss", "Why not", (Remarks(tuple(shown), "warning"),))
        )
    left_out = left_out_words(study)
    without = f"{sentence(left_out)} " if left_out else ""
    made = (
        f"Base: {study.base}. {without}Points: every combination of the axes. Points share records, model "
        "and ellipses unless an axis changes them. All points use the same random numbers."
    )
    file = file_text("The study's file", study.text)
    sections.append(PageSection("study", "How it was made", "Made", (Text(made), file)))
    return Page(study.title, first, tuple(sections), wide=True)


def _best_row(study: StudyView, column: StudyColumn, row: PointRow) -> Row:
    unit = study.unit(column.name)
    value = row.numbers[column.name]
    text = f"{value_words(value)} {unit}".rstrip()
    largest = "largest" if column.better == "larger" else "smallest"
    remark = f"point {row.number}: {asked_words(study, row)}"
    return Row("", f"{largest} {column.label}", Quantity(text, value, unit), remark)


def _picture(study: StudyView) -> Picture | None:
    if not study.config.pareto:
        return None
    caption = (
        "Filled: certified, and every run settles at its reference. Coloured: on the Pareto front, where no "
        "other filled point is better in both. Grey: dominated. Hollow: not certified, or some run keeps "
        "moving or does not settle at its reference."
    )
    if any(row.lowered for row in study.rows):
        caption += " Ringed: certified at a lower bandwidth than specified."
    return Picture("pareto", caption, (study,))


def _points_section(study: StudyView) -> PageSection:
    lowered = any(row.lowered for row in study.rows)
    certified = study.known([name for name in _CERTIFIED if lowered or name != _OF_LOWERED])
    achieved = study.known(_ACHIEVED)
    certificate = Table(
        _head(study, certified, "state"),
        tuple(_cells(study, row, certified, row.state) for row in study.in_order),
        "Worst case over the uncertainty set. γ of 1 or less: the specification is met. γ of any order: a "
        "controller of some order reaches it.",
        tuple(row.good for row in study.in_order),
    )
    over_time = Table(
        _head(study, achieved, "stop moving"),
        tuple(_cells(study, row, achieved, settled_words(row)) for row in study.in_order),
        "Worst over the runs. A dash: some run never gets that far (settling: to 2 % of the step). Peak of "
        "S: predicted for the nominal loop; measured on the arm as identified, with friction.",
        tuple(is_settled(row) for row in study.in_order),
    )
    files = (
        "table.csv and table.json have more numbers with every digit. Each point is a run directory: "
        "flexlink report DIR/points/NUMBER writes its page."
    )
    return PageSection(
        "points",
        "All points",
        "Points",
        (certificate, Fold("Closed loop over time", (over_time,)), Text(files)),
        open=len(study.rows) <= MOST_UNFOLDED,
    )


def settled_words(row: PointRow) -> str:
    """How many runs of a point stop moving; "" where nobody looked."""
    settled = row.numbers["settled_draws"]
    return "" if settled is None else f"{settled} of {row.numbers['draws']}"


def is_settled(row: PointRow) -> bool | None:
    """Whether all runs of a point come to rest at the reference; None where there were none."""
    if row.numbers["draws"] is None:
        return None
    return row.numbers["settled_draws"] == row.numbers["draws"] and row.state != "does not settle"


def _head(study: StudyView, columns: Sequence[str], last: str) -> tuple[str, ...]:
    axes = [axis.name for axis in study.config.axes]
    return ("point", *axes, *(study.heading(name) for name in columns), last)


def _cells(study: StudyView, row: PointRow, columns: Sequence[str], last: str) -> tuple[str, ...]:
    page = file_link(f"points/{row.name}/", str(row.number))
    values = [value_words(row.numbers[name]) for name in columns]
    return (page, *study.asked(row).values(), *values, last)
