"""Pareto plots of a study: what can be had together, and what it costs."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.study.page import StudyView
from workflow.study.settings import ParetoPlot

_DOT: dict[str, Any] = {"ls": "none", "zorder": 3, "marker": "o", "ms": 6}
_HOLLOW = _DOT | {"mfc": "none", "mec": style.LIMIT, "mew": 1.2}
_DOMINATED = _DOT | {"color": "#a8adb4", "mew": 0}
_FRONT = _DOT | {"color": style.PREDICTED, "marker": "D", "ms": 7, "mew": 0}


@style.drawing("pareto")
def draw_pareto(study: StudyView) -> Figure:
    """Certified points filled (those on the front coloured and numbered), others hollow."""
    plots = study.config.pareto
    figure, places = style.small_multiples(len(plots), min(len(plots), 2), 4.3, 0.4)
    for axes, plot, front in zip(places, plots, study.fronts, strict=True):
        _draw(axes, study, plot, front)
    return figure


def _draw(axes: Axes, study: StudyView, plot: ParetoPlot, front: list[int]) -> None:
    x_column, y_column = study.column(plot.x), study.column(plot.y)
    x_label, y_label = study.heading(plot.x), study.heading(plot.y)
    for say, label, column in ((axes.set_xlabel, x_label, x_column), (axes.set_ylabel, y_label, y_column)):
        say(f"{style.plain(label, 40)} ({column.better} is better)")
    axes.set_title(style.plain(f"{y_label} against {x_label}", 70))
    at = np.array([(row.numbers[plot.x], row.numbers[plot.y]) for row in study.rows], dtype=np.float64)
    there = ~np.isnan(at).any(axis=1)
    if not there.all():
        words = f"{np.count_nonzero(~there)} not drawn: no number here"
        axes.annotate(words, (0.99, 0.01), xycoords="axes fraction", ha="right", fontsize=8, color="#666666")
    number = np.array([row.number for row in study.rows])
    good, on = np.array([row.good for row in study.rows]), np.isin(number, front)
    for kind, label, look in (
        (~good, "not certified", _HOLLOW),
        (good & ~on, "certified, dominated", _DOMINATED),
        (on, "certified, on the front", _FRONT),
    ):
        if (kind & there).any():
            axes.plot(*at[kind & there].T, label=label, **look)
    if on.sum() > 1:
        axes.plot(*at[on][np.lexsort(at[on].T[::-1])].T, color=style.PREDICTED, lw=0.9, ls=":", zorder=2)
    if there.any():
        for limits, values in ((axes.set_xlim, at[there, 0]), (axes.set_ylim, at[there, 1])):
            limits(*style.pad_limits(values.min(), values.max(), 0.1))
        _number(axes, at[on], number[on])


def _number(axes: Axes, at: npt.NDArray[np.float64], number: npt.NDArray[np.int64]) -> None:
    """Numbers as in the table at places (P, 2), those of points in one place together."""
    # A fiftieth of the axes: closer together, two labels would lie on one another.
    shares = np.rint(50 * axes.transLimits.transform(at)) if number.size else at
    for share in np.unique(shares, axis=0):
        here = np.all(shares == share, axis=1)
        axes.annotate(
            style.plain(", ".join(map(str, sorted(number[here]))), 18),
            at[here][0],
            xytext=(6, 5),
            textcoords="offset points",
            fontsize=8.5,
            color=style.REFERENCE,
            zorder=4,
        )
