"""Panels in their places, as matplotlib's constrained layout has them; numbers of an axis as one moving tick.

A tick is eight objects: one for each number, measured and drawn again and again, took half of a page's time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.axis import Axis, YAxis
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

POINT = 72  # units of an SVG per inch

Real = npt.NDArray[np.float64]
Sizes = dict[tuple[str, float], Real]  # width and height of words in pixels, by words and size of the letters


@dataclass(frozen=True, eq=False)
class Measured:
    """A panel's words, in pixels from its edges outwards.

    around (4,): left, bottom, right, top, all that needs room; wide: left and right with the long words that
    may stand over other panels; labels: of the panel's axes, from the edge they are at.
    """

    axes: Axes
    around: Real
    wide: tuple[float, float]
    labels: dict[Axis, float]


def lay_out(figure: Figure) -> list[tuple[float, float]]:
    """Place the panels of a figure made by `style.panels`, and their labels, once and for all.

    Returned: from where to where each panel reaches with its words, in pixels. Positions are on a grid of
    1e-5 of the figure: clip paths are named after them.
    """
    figure.set_layout_engine("none")
    shown = [axes for axes in figure.axes if axes.get_visible()]
    below = max((legend.get_window_extent().height for legend in figure.legends), default=-np.inf)
    _place(figure, dict.fromkeys(shown, np.array([55.0, 25.0, 10.0, 25.0])), below)
    sizes: Sizes = {}
    numbers, measured = None, []
    for _ in range(2):  # measured again only where a panel has other numbers at its new size
        now = [numbers_of(axis)[2] for axis in every_axis(shown)]
        if now == numbers:
            break
        numbers, measured = now, [_measured(axes, sizes) for axes in shown]
        _place(figure, {it.axes: it.around for it in measured}, below)
    _fix_labels(measured)
    for axis in every_axis(shown):
        setattr(axis, "draw", partial(_draw, axis))  # noqa: B010
    return [(it.axes.bbox.x0 - it.wide[0], it.axes.bbox.x1 + it.wide[1]) for it in measured]


def every_axis(panels: Iterable[Axes]) -> Iterator[Axis]:
    """x and y axes of panels, and of the second axes above them."""
    for each in (one for axes in panels for one in (axes, *axes.child_axes)):
        yield from (each.xaxis, each.yaxis)


def titles(axes: Axes) -> Iterator[Text]:
    """Its title, wherever it stands."""
    words = (it for it in axes.get_children() if isinstance(it, Text) and it not in axes.texts)
    return (it for it in words if it.get_text())


def _place(figure: Figure, around: dict[Axes, Real], legend_px: float) -> None:
    """Panels of the given ratios in what the widest words of each row and column leave."""
    size = np.array(figure.bbox.size)
    in_inches = rcParams["figure.constrained_layout.w_pad"], rcParams["figure.constrained_layout.h_pad"]
    pads = figure.dpi * np.array(in_inches)
    grid: Any = figure.axes[0].get_subplotspec().get_gridspec()  # type: ignore[union-attr]
    room = np.zeros((2, 2, max(grid.nrows, grid.ncols)))  # column or row, before or after, which
    room += pads[:, None, None]
    for axes, (left, bottom, right, top) in around.items():
        for which, ends, words in zip((0, 1), _cells(axes), ((left, right), (top, bottom)), strict=True):
            room[which, (0, 1), ends] = np.maximum(room[which, (0, 1), ends], np.array(words) + pads[which])
    above = size[1] - max(legend_px + 2 * pads[1], 0.0)
    x_px = _edges(room[0, :, : grid.ncols], grid.get_width_ratios(), size[0])
    y_px = size[1] - _edges(room[1, :, : grid.nrows], grid.get_height_ratios(), above)
    for axes in figure.axes:
        (left, right), (top, bottom) = _cells(axes)
        box = np.array([[x_px[0, left], y_px[1, bottom]], [x_px[1, right], y_px[0, top]]]) / size
        axes.set_position(Bbox(np.round(box, 5)))
        axes.apply_aspect()
        for child in axes.child_axes:
            locate: Any = child.get_axes_locator()
            child.apply_aspect(locate(child, None))


def _cells(axes: Axes) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and last column, first and last row."""
    place: Any = axes.get_subplotspec()
    columns, rows = place.colspan, place.rowspan
    return (columns.start, columns.stop - 1), (rows.start, rows.stop - 1)


def _edges(room: Any, ratios: Sequence[float], total: float) -> Any:
    """Where each column (or row) begins and ends, without its room before and after."""
    sizes = np.asarray(ratios) / np.sum(ratios) * (total - room.sum())
    starts = np.cumsum(room[0] + np.append(0.0, (sizes + room[1])[:-1]))
    return np.array([starts, starts + sizes])


def numbers_of(axis: Axis) -> tuple[Any, Real, list[str]]:
    """The tick that is drawn at every number, where they are in the data (n,), and their words."""
    places = np.asarray(axis.get_majorticklocs(), dtype=np.float64)
    words = axis.get_major_formatter().format_ticks(list(places))
    inside = within(axis, places)
    shown = [word for word, there in zip(words, inside, strict=True) if there]
    return axis.get_major_ticks(1)[0], places[inside], shown


def within(axis: Axis, places: Real) -> npt.NDArray[np.bool_]:
    """Which places (n,) in the data are in view."""
    share = _share(axis, places)
    return np.asarray((share >= -1e-10) & (share <= 1 + 1e-10))


def _share(axis: Axis, places: Real) -> Real:
    """How far along the axis places (n,) in the data are, 0 to 1."""
    scale = axis.get_transform()
    begin, end = scale.transform(np.array(axis.get_view_interval()))
    return np.asarray((scale.transform(places) - begin) / (end - begin))


def _measured(axes: Axes, sizes: Sizes) -> Measured:
    figure: Any = axes.figure
    renderer, box = figure._get_renderer(), axes.bbox
    around, labels = np.zeros(4), dict[Axis, float]()
    for axis in every_axis([axes]):
        if axis.get_visible():
            words, beyond = _around(axis, box, sizes)
            around = np.maximum(around, words)
            labels |= {axis: beyond} if axis.label.get_text() else {}
    beside = [it for it in (*axes.texts, *axes.artists) if it.get_visible()]
    beside += [it for it in (*axes.lines, *axes.patches, *axes.collections) if not it.get_clip_on()]
    wide = around[[0, 2]]
    long = list(titles(axes))
    for artist in (*beside, *long, *(axis.label for axis in labels if not _along(axis))):
        it = artist.get_window_extent(renderer)
        reach = np.array([box.x0 - it.x0, box.y0 - it.y0, it.x1 - box.x1, it.y1 - box.y1])
        if artist in beside:
            around = np.maximum(around, reach)
        elif artist in long:
            around[3] = max(around[3], reach[3])
        wide = np.maximum(wide, reach[[0, 2]])
    return Measured(axes, around, (float(wide[0]), float(wide[1])), labels)


def _around(axis: Axis, box: Any, sizes: Sizes) -> tuple[Real, float]:
    """Room (4,) for the numbers and the label of an axis at a panel's box; how far away the label is."""
    figure: Any = axis.figure
    renderer, px = figure._get_renderer(), figure.dpi / POINT
    tick, places, words = numbers_of(axis)
    around, along = np.zeros(4), _along(axis)
    outer = 2 * int(tick.label2.get_visible())
    label = tick.label2 if outer else tick.label1
    reach = px * tick.get_tick_padding() * (tick.tick1line.get_visible() or tick.tick2line.get_visible())
    if label.get_visible() and words:
        size = np.array([_size(label, word, renderer, sizes) for word in words])
        share = _share(axis, places)
        for end, away in ((0, share), (2, 1 - share)):
            around[along + end] = max(0.0, float(np.max(size[:, along] / 2 - away * box.size[along])))
        reach = max(reach, px * (tick.get_pad() + tick.get_tick_padding()) + float(size[:, 1 - along].max()))
    side = 1 - along + outer
    around[side] = reach
    power = axis.get_offset_text()
    if power.get_visible() and (text := axis.get_major_formatter().get_offset()):
        power.set_text(text)
        if along:
            power.set_y(box.y1 + px * Axis.OFFSETTEXTPAD)
            around[3] = max(around[3], power.get_window_extent(renderer).y1 - box.y1)
        else:
            around[side] += px * Axis.OFFSETTEXTPAD + power.get_window_extent(renderer).height
    beyond = 0.0
    if axis.label.get_text():
        beyond = reach + px * axis.labelpad
        around[side] = max(around[side], beyond + axis.label.get_window_extent(renderer).size[1 - along])
    return around, beyond


def _size(text: Text, words: str, renderer: Any, sizes: Sizes) -> Real:
    """Of words in the look of a text."""
    key = words, float(text.get_fontsize())
    if key not in sizes:
        text.set_text(words)
        sizes[key] = np.array(text.get_window_extent(renderer).size)
    return sizes[key]


def _draw(axis: Axis, renderer: Any) -> None:
    """As `Axis.draw`, of an axis whose label is in its place."""
    if not axis.get_visible():
        return
    renderer.open_group("axis")
    tick, places, words = numbers_of(axis)
    for place, word in zip(places, words, strict=True):
        tick.update_position(place)
        tick.label1.set_text(word)
        tick.label2.set_text(word)
        tick.draw(renderer)
    axis.label.draw(renderer)
    power = axis.get_offset_text()
    power.set_text(axis.get_major_formatter().get_offset())
    if power.get_text():
        numbers = [text.get_window_extent(renderer) for text in (tick.label1, tick.label2)]
        axis._update_offset_text_position([numbers[0]], [numbers[1]])  # type: ignore[attr-defined]
        power.draw(renderer)
    renderer.close_group("axis")


def _fix_labels(measured: Sequence[Measured]) -> None:
    """Labels beside the numbers of their axis, those of a column under each other."""
    columns: dict[Any, float] = {}
    for axis, beyond in (pair for it in measured for pair in it.labels.items()):
        columns[_column(axis)] = max(columns.get(_column(axis), 0.0), beyond)
    for it in measured:
        for axis in it.labels:
            along, away = _along(axis), columns[_column(axis)] / it.axes.bbox.size[1 - _along(axis)]
            where = list(axis.label.get_position())
            where[1 - along] = 1 + away if axis.get_label_position() in ("top", "right") else -away
            axis.set_label_coords(where[0], where[1], it.axes.transAxes)


def _along(axis: Axis) -> int:
    """0 of an x axis, 1 of a y axis."""
    return int(isinstance(axis, YAxis))


def _column(axis: Axis) -> Any:
    """Of a y axis on the left its column; of others the axis itself."""
    side: Any = axis.get_label_position()
    return _cells(axis.axes)[0][0] if side == "left" else axis
