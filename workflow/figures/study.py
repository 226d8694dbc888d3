"""Pareto plots of a study: what can be had together, and what it costs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from workflow.figures.registry import drawing
from workflow.figures.style import (
    LIMIT,
    PREDICTED,
    WIDTH_IN,
    finish,
    house_style,
    new_figure,
    pad_limits,
    plain,
)

_DOMINATED = "#a8adb4"
_PER_ROW = 2


@dataclass(frozen=True)
class Mark:
    """A point in the plane of two columns. `good`: certified, and settles; `front`: nothing good beats it."""

    number: int
    x: float
    y: float
    good: bool
    front: bool


@dataclass(frozen=True)
class Panel:
    """Marks with the axes they lie on; `x_better` and `y_better` are 'larger' or 'smaller'.

    missing: points that have no place here.
    """

    x_label: str
    y_label: str
    x_better: str
    y_better: str
    marks: tuple[Mark, ...]
    missing: int = 0


@drawing("pareto")
def draw_pareto(panels: Sequence[Panel]) -> Figure:
    """Certified points filled (those on the front coloured and numbered), others hollow."""
    rows = -(-len(panels) // _PER_ROW)
    columns = min(len(panels), _PER_ROW)
    with house_style():
        figure = new_figure(4.3 * rows + 0.4, WIDTH_IN)
        grid = figure.subplots(rows, columns, squeeze=False)
        axes = list(grid.flat)
        for one, panel in zip(axes, panels, strict=False):
            _draw(one, panel)
        for one in axes[len(panels) :]:
            one.set_visible(False)
        finish(figure, axes[: len(panels)])
    return figure


def _draw(axes: Axes, panel: Panel) -> None:
    axes.set_xlabel(f"{plain(panel.x_label, 40)} ({panel.x_better} is better)")
    axes.set_ylabel(f"{plain(panel.y_label, 40)} ({panel.y_better} is better)")
    axes.set_title(plain(f"{panel.y_label} against {panel.x_label}", 70))
    if panel.missing:
        axes.annotate(
            f"{panel.missing} not drawn: no number here",
            (0.99, 0.01),
            xycoords="axes fraction",
            ha="right",
            fontsize=8,
            color="#666666",
        )
    if not panel.marks:
        return
    hollow = [mark for mark in panel.marks if not mark.good]
    behind = [mark for mark in panel.marks if mark.good and not mark.front]
    front = sorted((mark for mark in panel.marks if mark.front), key=lambda mark: (mark.x, mark.y))
    styles: tuple[tuple[Sequence[Mark], str, dict[str, Any]], ...] = (
        (hollow, "not certified", {"mfc": "none", "mec": LIMIT, "mew": 1.2, "marker": "o", "ms": 6}),
        (behind, "certified, dominated", {"color": _DOMINATED, "marker": "o", "ms": 6, "mew": 0}),
        (front, "certified, on the front", {"color": PREDICTED, "marker": "D", "ms": 7, "mew": 0}),
    )
    for marks, label, style in styles:
        if marks:
            axes.plot([m.x for m in marks], [m.y for m in marks], ls="none", label=label, zorder=3, **style)
    if len(front) > 1:
        axes.plot([m.x for m in front], [m.y for m in front], color=PREDICTED, lw=0.9, ls=":", zorder=2)
    xs, ys = np.array([m.x for m in panel.marks]), np.array([m.y for m in panel.marks])
    axes.set_xlim(*pad_limits(float(xs.min()), float(xs.max()), 0.1))
    axes.set_ylim(*pad_limits(float(ys.min()), float(ys.max()), 0.1))
    _number(axes, front)


def _number(axes: Axes, front: Sequence[Mark]) -> None:
    """Numbers as in the table, those of points in one place together."""
    low, high = axes.get_xlim()
    bottom, top = axes.get_ylim()
    places: dict[tuple[int, int], list[Mark]] = {}
    for mark in front:
        # A fiftieth of the axes: closer together, two labels would lie on one another.
        place = (round(50 * (mark.x - low) / (high - low)), round(50 * (mark.y - bottom) / (top - bottom)))
        places.setdefault(place, []).append(mark)
    for marks in places.values():
        numbers = ", ".join(str(mark.number) for mark in sorted(marks, key=lambda mark: mark.number))
        axes.annotate(
            plain(numbers, 18),
            (marks[0].x, marks[0].y),
            xytext=(6, 5),
            textcoords="offset points",
            fontsize=8.5,
            color=PREDICTED,
            zorder=4,
        )
