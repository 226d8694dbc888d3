"""Pareto plots of a study: what can be had together, and what it costs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.registry import drawing


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


_DOT: dict[str, Any] = {"ls": "none", "zorder": 3, "marker": "o", "ms": 6}
_HOLLOW = _DOT | {"mfc": "none", "mec": style.LIMIT, "mew": 1.2}
_DOMINATED = _DOT | {"color": "#a8adb4", "mew": 0}
_FRONT = _DOT | {"color": style.PREDICTED, "marker": "D", "ms": 7, "mew": 0}


@drawing("pareto")
def draw_pareto(panels: Sequence[Panel]) -> Figure:
    """Certified points filled (those on the front coloured and numbered), others hollow."""
    figure, places = style.small_multiples(len(panels), min(len(panels), 2), 4.3, 0.4)
    for axes, panel in zip(places, panels, strict=True):
        _draw(axes, panel)
    return figure


def _draw(axes: Axes, panel: Panel) -> None:
    axes.set_xlabel(f"{style.plain(panel.x_label, 40)} ({panel.x_better} is better)")
    axes.set_ylabel(f"{style.plain(panel.y_label, 40)} ({panel.y_better} is better)")
    axes.set_title(style.plain(f"{panel.y_label} against {panel.x_label}", 70))
    if panel.missing:
        words = f"{panel.missing} not drawn: no number here"
        axes.annotate(words, (0.99, 0.01), xycoords="axes fraction", ha="right", fontsize=8, color="#666666")
    front = sorted((mark for mark in panel.marks if mark.front), key=lambda mark: (mark.x, mark.y))
    for marks, label, look in (
        ([mark for mark in panel.marks if not mark.good], "not certified", _HOLLOW),
        ([mark for mark in panel.marks if mark.good and not mark.front], "certified, dominated", _DOMINATED),
        (front, "certified, on the front", _FRONT),
    ):
        if marks:
            axes.plot([m.x for m in marks], [m.y for m in marks], label=label, **look)
    if len(front) > 1:
        xs, ys = [mark.x for mark in front], [mark.y for mark in front]
        axes.plot(xs, ys, color=style.PREDICTED, lw=0.9, ls=":", zorder=2)
    if panel.marks:
        points = np.array([(mark.x, mark.y) for mark in panel.marks])
        low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        axes.set_xlim(*style.pad_limits(low[0], high[0], 0.1))
        axes.set_ylim(*style.pad_limits(low[1], high[1], 0.1))
        _number(axes, front)


def _number(axes: Axes, front: Sequence[Mark]) -> None:
    """Numbers as in the table, those of points in one place together."""
    places: dict[tuple[int, ...], list[Mark]] = {}
    for mark in front:
        # A fiftieth of the axes: closer together, two labels would lie on one another.
        share = axes.transLimits.transform((mark.x, mark.y))
        places.setdefault(tuple(np.rint(50 * share).astype(int).tolist()), []).append(mark)
    for marks in places.values():
        axes.annotate(
            style.plain(", ".join(str(number) for number in sorted(mark.number for mark in marks)), 18),
            (marks[0].x, marks[0].y),
            xytext=(6, 5),
            textcoords="offset points",
            fontsize=8.5,
            color=style.PREDICTED,
            zorder=4,
        )
