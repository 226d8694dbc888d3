"""Panels in their places: as matplotlib's constrained layout has them, but words are measured once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text
from matplotlib.transforms import Bbox


@dataclass(frozen=True)
class Measured:
    """A panel's words, in pixels from its edges (left, bottom, right, top), outwards.

    around: all that needs room; wide: left and right with the long words that may stand over other panels;
    x_labels: of the x axes, from the lower edge or (a second one) the upper; y_label: from the edge it is at.
    """

    axes: Axes
    around: tuple[float, ...]
    wide: tuple[float, float]
    x_labels: tuple[tuple[Axis, float], ...]
    y_label: float


def lay_out(figure: Figure) -> list[tuple[float, float]]:
    """Place the panels of a figure that awaits a constrained layout, and their labels, once and for all.

    Returned: from where to where each panel reaches with its words, in pixels. Positions are on a grid of
    1e-5 of the figure: the solver's last bits depend on where its objects lie in memory, and clip paths are
    named after them.
    """
    engine = figure.get_layout_engine()
    shown = [axes for axes in figure.axes if axes.get_visible()]
    figure.set_layout_engine("none")
    if isinstance(engine, ConstrainedLayoutEngine):
        if _in_a_grid(figure):
            measured = _placed(figure, shown)
        else:
            # Drawing everything, as draw_without_rendering does, would take as long again.
            engine.execute(figure)
            _move(figure.axes, [axes.get_position(original=True).get_points() for axes in figure.axes])
            measured = [_measured(axes) for axes in shown]
        _fix_labels(measured)
    else:
        measured = [_measured(axes) for axes in shown]
    return [(it.axes.bbox.x0 - it.wide[0], it.axes.bbox.x1 + it.wide[1]) for it in measured]


def titles(axes: Axes) -> Iterator[Text]:
    """Its title, wherever it stands."""
    words = (it for it in axes.get_children() if isinstance(it, Text) and it not in axes.texts)
    return (it for it in words if it.get_text())


def _in_a_grid(figure: Figure) -> bool:
    """Whether there is one grid, in whose cells the panels are, with nothing beside them but the legend."""
    places = [axes.get_subplotspec() for axes in figure.axes]
    if None in places or not places or figure.subfigs or figure.get_suptitle():
        return False
    grid = places[0].get_gridspec()  # type: ignore[union-attr]
    return all(
        place is not None
        and place.get_gridspec() is grid
        and len(place.rowspan) == len(place.colspan) == 1
        and axes.get_aspect() == "auto"
        for place, axes in zip(places, figure.axes, strict=True)
    )


def _placed(figure: Figure, shown: Sequence[Axes]) -> list[Measured]:
    """Guess, measure, place; measure again only where a panel has other ticks at its new size."""
    _place(figure, dict.fromkeys(shown, (55.0, 25.0, 10.0, 25.0)))
    ticks = _ticks(shown)
    measured = [_measured(axes) for axes in shown]
    _place(figure, {it.axes: it.around for it in measured})
    if _ticks(shown) != ticks:
        measured = [_measured(axes) for axes in shown]
        _place(figure, {it.axes: it.around for it in measured})
    return measured


def _place(figure: Figure, around: dict[Axes, tuple[float, ...]]) -> None:
    """Panels of the given ratios in what the widest words of each row and column leave."""
    width, height = figure.bbox.size
    in_inches = rcParams["figure.constrained_layout.w_pad"], rcParams["figure.constrained_layout.h_pad"]
    pads = figure.dpi * np.array(in_inches)
    grid: Any = figure.axes[0].get_subplotspec().get_gridspec()  # type: ignore[union-attr]
    room = np.zeros((2, 2, max(grid.nrows, grid.ncols)))  # column or row, before or after, which
    room += pads[:, None, None]
    for axes, (left, bottom, right, top) in around.items():
        place: Any = axes.get_subplotspec()
        for which, cell, sizes in (
            (0, place.colspan.start, (left, right)),
            (1, place.rowspan.start, (top, bottom)),
        ):
            room[which, :, cell] = np.maximum(room[which, :, cell], np.array(sizes) + pads[which])
    below = max((legend.get_window_extent().height + 2 * pads[1] for legend in figure.legends), default=0.0)
    x_px = _edges(room[0, :, : grid.ncols], grid.get_width_ratios(), width) / width
    y_px = 1 - _edges(room[1, :, : grid.nrows], grid.get_height_ratios(), height - below) / height
    places = [axes.get_subplotspec() for axes in figure.axes]
    boxes = [
        np.array([[x_px[0, column], y_px[1, row]], [x_px[1, column], y_px[0, row]]])
        for row, column in (
            (place.rowspan.start, place.colspan.start) for place in places if place is not None
        )
    ]
    _move(figure.axes, boxes)


def _edges(room: Any, ratios: Sequence[float], total: float) -> Any:
    """Where each column (or row) begins and ends, without its room before and after."""
    sizes = np.asarray(ratios) / np.sum(ratios) * (total - room.sum())
    starts = np.cumsum(room[0] + np.append(0.0, (sizes + room[1])[:-1]))
    return np.array([starts, starts + sizes])


def _move(every: Sequence[Axes], boxes: Sequence[Any]) -> None:
    for axes, box in zip(every, boxes, strict=True):
        axes.set_position(Bbox(np.round(box, 5)))


def _ticks(shown: Sequence[Axes]) -> list[list[float]]:
    axes = chain.from_iterable((each, *each.child_axes) for each in shown)
    return [list(axis.get_majorticklocs()) for each in axes for axis in (each.xaxis, each.yaxis)]


def _measured(axes: Axes) -> Measured:
    figure: Any = axes.figure
    renderer = figure._get_renderer()
    taken = axes.get_tightbbox(renderer, for_layout_only=True)
    box = axes.bbox
    if taken is None:
        taken = box
    words = (*titles(axes), *(each.xaxis.label for each in (axes, *axes.child_axes)))
    long = Bbox.union([taken, *(it.get_window_extent(renderer) for it in words if it.get_text())])
    x_axes = [each.xaxis for each in (axes, *axes.child_axes)]
    return Measured(
        axes,
        (box.x0 - taken.x0, box.y0 - taken.y0, taken.x1 - box.x1, taken.y1 - box.y1),
        (box.x0 - long.x0, long.x1 - box.x1),
        tuple((axis, axis.label.get_position()[1] - _edge(axis, axes)) for axis in x_axes),
        axes.yaxis.label.get_position()[0] - (box.x0 if _on_the_left(axes) else box.x1),
    )


def _edge(axis: Axis, axes: Axes) -> float:
    low, high = axes.bbox.intervaly
    return float(high if axis.get_label_position() == "top" else low)


def _on_the_left(axes: Axes) -> bool:
    side: str = axes.yaxis.get_label_position()
    return side == "left"


def _fix_labels(measured: Sequence[Measured]) -> None:
    """Labels of axes where they were measured to fit, those of a column under each other.

    Else all numbers of a column would be measured again for each of its labels, whenever one is drawn.
    """
    columns: dict[Any, list[Measured]] = {}
    for it in measured:
        for axis, beyond in it.x_labels:
            y_px = _edge(axis, it.axes) + beyond
            y = it.axes.transAxes.inverted().transform((0, y_px))[1]
            axis.set_label_coords(axis.label.get_position()[0], y, it.axes.transAxes)
        place = it.axes.get_subplotspec()
        alone = place is None or not _on_the_left(it.axes)
        columns.setdefault(it.axes if alone or place is None else place.colspan.start, []).append(it)
    for column in columns.values():
        beyond = min(it.y_label for it in column)
        for it in column:
            x_px = (it.axes.bbox.x0 if _on_the_left(it.axes) else it.axes.bbox.x1) + beyond
            x = it.axes.transAxes.inverted().transform((x_px, 0))[0]
            it.axes.yaxis.set_label_coords(x, it.axes.yaxis.label.get_position()[1])
