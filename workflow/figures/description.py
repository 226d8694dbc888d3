"""A picture as data: panels in a grid, what is drawn in each, and in which look.

A drawing describes with these classes what is to be seen. `svg` makes the picture of a page from it, and
`matplotlib_figure` the figure of the Python front door and the files in further formats. The words of a look
are those of matplotlib: color, lw, ls, alpha, marker, ms, mfc, mec, mew, drawstyle, zorder.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Real = npt.NDArray[np.float64]
Look = Mapping[str, Any]
# The x axis of a panel, as a place in pairs.
X = 0
# The y axis of a panel, as a place in pairs.
Y = 1

# Width of a picture: a page is 1000 pixels wide, and looks right at 100 pixels an inch.
WIDTH_IN = 10.0
# Width of a picture on a narrow screen: letters of 9 pt are then 11.6 pixels high where 372 pixels are left
# for it (a screen of 400). Twice as much shrinks them to 5.8 pixels, which nobody reads.
NARROW_WIDTH_IN = 4.0
# Room between data and the ends of an axis that nobody stated, share of the data's range: as of matplotlib.
_MARGIN = 0.05
# Where a log axis without any positive value begins and ends; without data there is nothing to choose by.
_EMPTY_LOG = (0.1, 10.0)
# Points of a circle: its corners are then less than a hundredth of its radius away from it.
_CIRCLE_POINTS = 73
# Layers, as of matplotlib: areas, then lines, then words, each in the order in which they were drawn.
AREA_LAYER = 1.0
# As of matplotlib, above areas.
LINE_LAYER = 2.0
# As of matplotlib, above everything.
WORD_LAYER = 3.0


@dataclass(frozen=True, eq=False)
class Curve:
    """A line through points, or a marker at each. across: y is a share of the panel's height, not a value."""

    x: Real
    y: Real
    look: Look
    label: str = ""
    across: bool = False


@dataclass(frozen=True, eq=False)
class Area:
    """Filled outlines, each (N, 2). whole: all are one area, the inner ones are holes in it."""

    outlines: Sequence[Real]
    look: Look
    label: str = ""
    whole: bool = False


@dataclass(frozen=True, eq=False)
class Rule:
    """A straight line across the panel at a value of one axis (X or Y)."""

    axis: int
    at: float
    look: Look
    label: str = ""


@dataclass(frozen=True, eq=False)
class Span:
    """A filled strip across the panel between two values of one axis (X or Y)."""

    axis: int
    low: float
    high: float
    look: Look
    label: str = ""


@dataclass(frozen=True, eq=False)
class Words:
    """A short text at a place.

    x, y: in the data, or a share of the panel's width or height (`across_x`, `across_y`). offset: to the
    right and upwards from there [pt]. clipped: not drawn where the place is out of view.
    """

    text: str
    x: float
    y: float
    offset: tuple[float, float] = (0.0, 0.0)
    size: float = 8.0
    color: str = "#666666"
    horizontal: Literal["left", "center", "right"] = "left"
    vertical: Literal["baseline", "center"] = "baseline"
    across_x: bool = False
    across_y: bool = False
    clipped: bool = False


@dataclass(frozen=True, eq=False)
class Arrow:
    """The head of an arrow at `tip` (x, y), that comes from `start`."""

    start: tuple[float, float]
    tip: tuple[float, float]
    color: str


Mark = Curve | Area | Rule | Span | Words | Arrow


@dataclass(eq=False)
class Axis:
    """The scale of one panel, or of all panels that share it.

    Parameters
    ----------
    which : int
        X or Y.
    kind : "lin", "log" or float
        A float: linear up to this size, logarithmic beyond.
    low, high : float or None
        Ends that were stated; None: as the data of `panels` have it. `low` may be above `high`.
    margin : float
        Room beside the data, share of their range, at an end that was not stated.
    every : float or None
        A number at every multiple of it, or at every second, third ... where not all have room.
    whole : bool
        Numbers at whole values only.
    named : sequence of (float, str) or None
        Places and words in place of numbers.
    """

    which: int
    kind: float | Literal["lin", "log"] = "lin"
    low: float | None = None
    high: float | None = None
    margin: float = _MARGIN
    every: float | None = None
    whole: bool = False
    named: Sequence[tuple[float, str]] | None = None
    panels: list[Panel] = field(default_factory=list)

    def limits(self) -> tuple[float, float]:
        """Both ends: as stated, else a margin beside the data that are drawn."""
        if self.low is not None and self.high is not None:
            return self.low, self.high
        drawn = [panel.data(self.which) for panel in self.panels]
        values = np.concatenate(drawn or [np.zeros(0)])
        values = values[np.isfinite(values)]
        if self.kind == "log":
            is_positive = values > 0
            values = values[is_positive]
            if not values.size:
                ends = _EMPTY_LOG
            else:
                lowest = float(np.log10(values.min()))
                highest = float(np.log10(values.max()))
                low, high = pad_limits(lowest, highest, self.margin)
                ends = 10.0**low, 10.0**high
        elif values.size:
            ends = pad_limits(float(values.min()), float(values.max()), self.margin)
        else:
            ends = (0.0, 1.0)
        low_end = ends[0] if self.low is None else self.low
        high_end = ends[1] if self.high is None else self.high
        return low_end, high_end

    def even(self, values: Any) -> Real:
        """Values as lengths in which the axis is even; on a log axis what is not positive lies far below."""
        numbers: Real = np.asarray(values, dtype=np.float64)
        if self.kind == "lin":
            return numbers
        if self.kind == "log":
            return np.asarray(np.log10(np.maximum(numbers, 1e-300)))
        size = np.abs(numbers)
        # The linear part is as long as 10/9 of a decade, so that the slope has no jump where it ends.
        decades = np.log10(np.maximum(size, self.kind) / self.kind)
        logarithmic = np.sign(numbers) * (10 / 9 + decades)
        linear = numbers / self.kind * 10 / 9
        return np.asarray(np.where(size <= self.kind, linear, logarithmic))

    def shares(self, values: Any) -> Real:
        """How far along the axis values lie: 0 at its beginning, 1 at its end."""
        begin, end = (float(value) for value in self.even(self.limits()))
        # An axis of no length has all values at its beginning.
        length = (end - begin) or 1.0
        return np.asarray((self.even(values) - begin) / length)


class Panel:
    """One pair of axes and what is drawn on it."""

    def __init__(self, x: Axis, y: Axis, place: tuple[int, int]) -> None:
        """place: row and column in the grid of the picture."""
        self.x = x
        self.y = y
        self.place = place
        self.marks: list[Mark] = []
        self.title = ""
        self.title_bold = True
        self.title_size = 10.5
        # In pt, above words that stand over the panel.
        self.title_raised = 0.0
        self.labels = ["", ""]
        self.label_size = [9.5, 9.5]
        self.tick_size = [9.0, 9.0]
        self.grid_lines = [True, True]
        # A unit is as long in x as in y.
        self.equal = False
        # A second frequency axis above, in Hz, where x is in rad/s.
        self.hertz = False
        # A second gain axis on the right, in dB, where y is an absolute gain.
        self.decibel = False
        self.visible = True
        self.colour_bar = False
        x.panels.append(self)
        y.panels.append(self)

    # -- what is drawn ---------------------------------------------------------------------------------------

    def plot(self, x: Any, y: Any, *, label: str | None = None, across: bool = False, **look: Any) -> None:
        """A line through points (N,), or markers at them; across: as of `Curve`."""
        at = np.asarray(x, dtype=np.float64).ravel()
        values = np.asarray(y, dtype=np.float64).ravel()
        self.marks.append(Curve(at, values, look, label or "", across))

    def fill_between(self, x: Any, low: Any, high: Any, *, label: str | None = None, **look: Any) -> None:
        """The band between two curves (N,), parted where one of them is no number."""
        at = np.asarray(x, dtype=np.float64)
        lower = np.broadcast_to(np.asarray(low, dtype=np.float64), at.shape)
        upper = np.broadcast_to(np.asarray(high, dtype=np.float64), at.shape)
        finite = np.isfinite(at) & np.isfinite(lower) & np.isfinite(upper)
        # Begin and end of each run of numbers: where the flag changes.
        flags = np.concatenate([[False], finite, [False]]).astype(int)
        edges = np.flatnonzero(np.diff(flags))
        outlines = []
        for first, last in edges.reshape(-1, 2):
            part = slice(first, last)
            # Along the lower edge and back along the upper one.
            lower_edge = np.column_stack([at[part], lower[part]])
            upper_edge = np.column_stack([at[part], upper[part]])[::-1]
            outlines.append(np.concatenate([lower_edge, upper_edge]))
        self.fill(outlines, label=label, **look)

    def fill(
        self, outlines: Iterable[Any], *, label: str | None = None, whole: bool = False, **look: Any
    ) -> None:
        """Areas with outlines (N, 2) each; whole: as of `Area`."""
        shapes = [np.asarray(outline, dtype=np.float64) for outline in outlines]
        self.marks.append(Area(shapes, look, label or "", whole))

    def uprights(self, x: Any, low: Any, high: Any, **look: Any) -> None:
        """Vertical strokes at places (N,) between two values (N,) each."""
        at = np.asarray(x, dtype=np.float64).ravel()
        # A gap after each stroke parts it from the next.
        gap = np.full(at.size, np.nan)
        lower = np.broadcast_to(low, at.shape)
        upper = np.broadcast_to(high, at.shape)
        ends = np.column_stack([lower, upper, gap])
        places = np.column_stack([at, at, gap])
        self.plot(places.ravel(), ends.ravel(), **look)

    def circle(self, centre: tuple[float, float], radius: float, *, label: str = "", **look: Any) -> None:
        """A circle in units of the data, drawn as a line."""
        turn = np.linspace(0, 2 * np.pi, _CIRCLE_POINTS)
        x = centre[0] + radius * np.cos(turn)
        y = centre[1] + radius * np.sin(turn)
        self.plot(x, y, label=label, **look)

    def bars(
        self,
        at: Any,
        ends: Any,
        thick: float,
        *,
        begins: Any = 0.0,
        lying: bool = False,
        label: str | None = None,
        **look: Any,
    ) -> None:
        """Bars at places (N,) along one axis, from `begins` to `ends` (N,) along the other."""
        at = np.atleast_1d(np.asarray(at, dtype=np.float64))
        ends = np.atleast_1d(ends)
        corners = []
        for place, begin, end in zip(at, np.broadcast_to(begins, ends.shape), ends, strict=True):
            left = place - thick / 2
            right = place + thick / 2
            along = np.array([left, right, right, left])
            up = np.array([begin, begin, end, end])
            corners.append(np.column_stack([up, along] if lying else [along, up]))
        self.fill(corners, label=label, **({"lw": 0} | look))

    def axhline(self, at: float = 0.0, *, label: str | None = None, **look: Any) -> None:
        """A line across the panel at a value of y."""
        self.marks.append(Rule(Y, float(at), look, label or ""))

    def axvline(self, at: float = 0.0, *, label: str | None = None, **look: Any) -> None:
        """A line across the panel at a value of x."""
        self.marks.append(Rule(X, float(at), look, label or ""))

    def axhspan(self, low: float, high: float, *, label: str | None = None, **look: Any) -> None:
        """A strip across the panel between two values of y."""
        self.marks.append(Span(Y, float(low), float(high), look, label or ""))

    def axvspan(self, low: float, high: float, *, label: str | None = None, **look: Any) -> None:
        """A strip across the panel between two values of x."""
        self.marks.append(Span(X, float(low), float(high), look, label or ""))

    def words(self, text: str, x: float, y: float, **more: Any) -> None:
        """A short text; more: as of `Words`."""
        self.marks.append(Words(text, float(x), float(y), **more))

    def arrow(self, start: tuple[float, float], tip: tuple[float, float], color: str) -> None:
        """The head of an arrow at a place in the data."""
        self.marks.append(Arrow(start, tip, color))

    # -- how it is framed ------------------------------------------------------------------------------------

    def set(
        self,
        *,
        title: str | None = None,
        xlabel: str | None = None,
        ylabel: str | None = None,
        xscale: Any = None,
        yscale: Any = None,
        xlim: tuple[float | None, float | None] | None = None,
        ylim: tuple[float | None, float | None] | None = None,
        equal: bool | None = None,
    ) -> None:
        """Title, labels, scales ("lin", "log", or where a logarithmic scale begins) and ends of the axes;
        what is None stays."""
        if title is not None:
            self.title = title
        for which, label in enumerate((xlabel, ylabel)):
            if label is not None:
                self.labels[which] = label
        for axis, scale, ends in ((self.x, xscale, xlim), (self.y, yscale, ylim)):
            if scale is not None:
                axis.kind = scale
            if ends is not None:
                axis.low = axis.low if ends[0] is None else float(ends[0])
                axis.high = axis.high if ends[1] is None else float(ends[1])
        if equal is not None:
            self.equal = equal

    def set_title(self, title: str, *, size: float = 10.5, bold: bool = True, raised: float = 0.0) -> None:
        """Words above the panel. raised: pt, above words that already stand there."""
        self.title = title
        self.title_size = size
        self.title_bold = bold
        self.title_raised = raised

    def axis(self, which: int) -> Axis:
        """Its x axis (X) or y axis (Y)."""
        return self.y if which else self.x

    def data(self, which: int) -> Real:
        """Values (N,) along one axis that are drawn, by which it is scaled."""
        values = [np.zeros(0)]
        for mark in self.marks:
            if isinstance(mark, Curve):
                if not (mark.across and which == Y):
                    values.append(mark.y if which else mark.x)
            elif isinstance(mark, Area):
                values += [outline[:, which] for outline in mark.outlines]
            elif isinstance(mark, Rule) and mark.axis == which:
                values.append(np.array([mark.at]))
            elif isinstance(mark, Span) and mark.axis == which:
                values.append(np.array([mark.low, mark.high]))
        return np.concatenate(values)

    def layered(self) -> list[Mark]:
        """What is drawn, the lowest layer first."""

        def layer(mark: Mark) -> float:
            if isinstance(mark, Words | Arrow):
                return WORD_LAYER
            usual = AREA_LAYER if isinstance(mark, Area | Span) else LINE_LAYER
            return float(mark.look.get("zorder", usual))

        return sorted(self.marks, key=layer)


@dataclass(eq=False)
class Picture:
    """Panels in a grid, row by row, and the size of the whole in inches; a place of the grid without a panel
    holds None."""

    height_in: float
    width_in: float
    grid: npt.NDArray[np.object_]
    height_ratios: Sequence[float]
    width_ratios: Sequence[float]

    @property
    def panels(self) -> list[Panel]:
        """The panels that are seen, row by row."""
        return [panel for panel in self.grid.ravel() if panel is not None and panel.visible]

    def of_columns(self, columns: Iterable[int], *, width_in: float, height_in: float) -> Picture:
        """A picture of some columns of this one, in another size [in].

        Parameters
        ----------
        columns : iterable of int
            Columns of the grid that stay; all others are left empty and take no width.
        width_in, height_in : float
            Size of the new picture.

        Returns
        -------
        Picture
            It holds the same panels, at the same places of a grid of the same shape.
        """
        kept = set(columns)
        grid = self.grid.copy()
        width_ratios = list(self.width_ratios)
        for column in range(grid.shape[1]):
            if column not in kept:
                grid[:, column] = None
                width_ratios[column] = 0.0
        return Picture(height_in, width_in, grid, self.height_ratios, width_ratios)

    def legend(self) -> dict[str, Mark]:
        """Words of the legend and the mark that each first stood with, in the order of the panels."""
        entries: dict[str, Mark] = {}
        for panel in self.panels:
            for mark in panel.marks:
                label = getattr(mark, "label", "")
                if label:
                    entries.setdefault(label, mark)
        return entries

    def numbered(self, panel: Panel, which: int) -> bool:
        """Whether numbers stand at an axis: where panels share it, at the lowest or the leftmost only."""
        row, column = panel.place
        sharing = [other for other in self.panels if other.axis(which) is panel.axis(which)]
        if which == X:
            return not any(other.place[1] == column and other.place[0] > row for other in sharing)
        return not any(other.place[0] == row and other.place[1] < column for other in sharing)

    def name(self, panel: Panel, which: int) -> str:
        """Label of an axis, from a panel that shares it where it has none of its own."""
        labels = (other.labels[which] for other in (panel, *panel.axis(which).panels))
        return " ".join(next(filter(None, labels), "").split())


Sharing = bool | Literal["row", "col"]


def new_picture(
    height_in: float,
    rows: int = 1,
    columns: int = 1,
    *,
    width_in: float = WIDTH_IN,
    sharex: Sharing = False,
    sharey: Sharing = False,
    height_ratios: Sequence[float] | None = None,
    width_ratios: Sequence[float] | None = None,
    squeeze: bool = True,
) -> tuple[Picture, Any]:
    """An empty picture and its panels: one, a row or a column of them, or (not squeeze) rows of columns."""

    def axis_of(which: int, sharing: Sharing, row: int, column: int) -> Axis:
        if sharing is True:
            key = (0, 0)
        elif sharing == "row":
            key = (row, 0)
        elif sharing == "col":
            key = (0, column)
        else:
            key = (row, column)
        return shared.setdefault((which, *key), Axis(which))

    shared: dict[tuple[int, int, int], Axis] = {}
    grid = np.empty((rows, columns), dtype=object)
    for row in range(rows):
        for column in range(columns):
            x = axis_of(X, sharex, row, column)
            y = axis_of(Y, sharey, row, column)
            grid[row, column] = Panel(x, y, (row, column))
    picture = Picture(
        height_in, width_in, grid, height_ratios or [1.0] * rows, width_ratios or [1.0] * columns
    )
    return picture, grid.squeeze()[()] if squeeze else grid


def small_multiples(
    count: int, columns: int, row_in: float, rest_in: float, **options: Any
) -> tuple[Picture, list[Panel]]:
    """So many panels in rows of `columns`, each row `row_in` high; a place left over stays empty."""
    rows = -(-count // columns)
    picture, grid = new_picture(row_in * rows + rest_in, rows, columns, squeeze=False, **options)
    places = list(grid.ravel())
    for panel in places[count:]:
        panel.visible = False
    return picture, places[:count]


def pad_limits(low: float, high: float, share: float = 0.06) -> tuple[float, float]:
    """Axis limits with a margin; a constant signal gets room on both sides."""
    span = high - low
    if not span > 0:
        span = abs(high) or 1.0
    return low - share * span, high + share * span
