"""A picture as SVG, written straight from its description: for a page, or as a file of its own.

Lengths are in points, y down. A page gives looks classes and stands the legend beside the picture as words;
its script reads values, zooms and hides from the classes of the groups: `aN` of the N-th pair of axes, in it
`kE` of what stands under entry E of the legend, `d` of other data, `t` and `u` of words at a place in the
data (of `u` only x is), `x` and `y` of an axis; inside of `kE` and `d` a group `m` of outlines and paths `p`
with a marker at every point. Where a picture is laid out again for a narrow screen, its outlines stand in a
group `v` with an id, which the narrow one shows again, stretched into its own panel.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import groupby, pairwise
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from workflow.figures import look as looks
from workflow.figures.description import (
    NARROW_WIDTH_IN,
    Area,
    Arrow,
    Axis,
    Curve,
    Mark,
    Panel,
    Picture,
    Real,
    Rule,
    Span,
    Words,
    X,
    Y,
)
from workflow.figures.ticks import DECIBEL_STEPS, MOST_DECIBELS, Ticks, linear_ticks, log_ticks, ticks_of

# Units of an SVG to the inch: points, so that sizes of letters are those of print.
POINT = 72
# Room around the words of every panel [pt]: 0.06 inches, as in the figures of matplotlib.
_PAD = 4.32
# From the edge of a panel to its numbers [pt]: a mark of 3.5 pt and as much room, as of matplotlib.
_TO_NUMBERS = 7.0
# Length of a mark that bears a number [pt], as of matplotlib.
_MARK = 3.5
# Length of a mark between numbers [pt], as of matplotlib.
_SMALL_MARK = 2.0
# From the numbers to the label of an axis [pt], as of matplotlib.
_TO_LABEL = 4.0
# From the panel, or what stands above it, to its title [pt], as of matplotlib.
_TO_TITLE = 6.0
# Letters of second axes [pt]: a little smaller than those of the first, which are read more often. Chosen.
_SECOND_SIZE = 8.5
# From line to line, in sizes of the letters: the usual leading.
_LINE = 1.2
# From the foot of a letter to its head, in sizes of the letters: that of DejaVu Sans.
_ASCENT = 0.76
# Above a panel, for the power of ten of its numbers [pt]: a line of numbers and the room of a mark.
_POWER_ROOM = 12.0
# Letters of DejaVu Sans from the blank to the tilde: widths in hundredths of the size. Verdana is as wide.
_WIDTHS = (
    32, 40, 46, 84, 64, 95, 78, 27, 39, 39, 50, 84, 32, 36, 32, 34, 64, 64, 64, 64, 64, 64, 64, 64,
    64, 64, 34, 34, 84, 84, 84, 53, 100, 68, 69, 70, 77, 63, 58, 77, 75, 29, 29, 66, 56, 86, 75, 79,
    60, 79, 69, 63, 61, 73, 68, 99, 69, 61, 69, 39, 34, 39, 84, 50, 50, 61, 63, 55, 63, 62, 35, 63,
    63, 28, 28, 58, 28, 97, 63, 61, 63, 63, 41, 52, 39, 63, 59, 82, 59, 59, 52, 64, 34, 64, 84,
)  # fmt: skip
# Width of letters beyond these, in sizes: as of most in the font.
_OTHER_WIDTH = 0.65
# Width of raised digits, in sizes: that of DejaVu Sans.
_SUPERSCRIPT_WIDTH = 0.42
# How much wider bold letters are: the mean over the letters above, from the same font.
_BOLD = 1.105
# Points of a line that are nearer than this to the line without them are left out [pt]: a third of a pixel
# where a page is 1000 pixels wide, and a few thousandths of a panel's height. Half as much adds a tenth to a
# page.
_UNSEEN = 0.2
# As much of a line on a logarithmic axis [pt], where a tenth of a point may be 1 % of the value that the
# script reads there.
_UNSEEN_LOG = 0.05
# Numbers of an axis at most: of more, none is read faster.
_MOST_NUMBERS = 9
# Width of a number in Hz with the space around it [pt].
_HERTZ_PT = 27
# How often every second point of a line is looked at; each time leaves at least half of them. Ten leave a
# thousandth of a straight line, and later ones find little.
_THINNINGS = 10
# Lines that run beside a panel at less than this distance [pt] are drawn: half of the widest line of the
# house.
_EDGE = 3.0
# Areas that are smaller than this [pt] in both ways are left out: the line of the house in whose middle they
# lie hides them.
_SPECK = 0.4
# A pixel of a page that is 1000 pixels wide [pt].
_PIXEL = 0.72
# A picture is laid out anew for a narrow screen where a part of it that cannot be parted further is wider
# than this [pt]: letters of 9 pt would be less than 8.4 pixels high on a screen of 400. Half of a picture,
# with the words that reach into its other half, is just not. Twice as much lets letters of 4 pixels pass.
_WIDEST_PART = 400.0
# Panels are laid out in the room that the words of the layout before need: three are usual, six end what
# would go on.
_MOST_LAYOUTS = 6
# Rooms that differ by less are the same [pt]: what is seen at most, a pixel.
_SAME_ROOM = 0.72
# Longest words in place of numbers beside a panel, share of the width of the picture: longer ones go on in a
# second line. Half as much parts words of two syllables, twice as much leaves no panel on a narrow screen.
_LONGEST_NAME = 0.4
# Farther outside of the picture than this [pt] a place is drawn at this distance.
_FAR = 2e4
# Height of a row in the legend of a file [pt]: letters of 9 pt with room to tell rows apart. Chosen.
_ROW = 13.0
# Width of a sample in a legend [pt]: two periods of the longest dashes of the house.
_SAMPLE = 18.0
# Room between a sample and its words [pt], as of matplotlib.
_AFTER_SAMPLE = 7.0
# Room between an entry of a legend and the next [pt]: clearly more than between words. Chosen.
_AFTER_ENTRY = 16.0
# Letters of a legend [pt]: as of the numbers.
_LEGEND_SIZE = 9.0
# A blank that a path does not need: in "1.5 .3" the second point can only begin another number.
_BLANK_BETWEEN_POINTS = re.compile(r"(\.\d+) (?=\.)")
# What all pictures have in common; looks of data are added to it.
COMMON_STYLE = (
    "svg *{stroke-linejoin:round}"
    'svg text{font-family:"DejaVu Sans",Verdana,sans-serif;font-size:9px;fill:#333}'
    ".gl{fill:none;stroke:#ddd;stroke-width:.6}.tk{fill:none;stroke:#333;stroke-width:.8}"
    ".tn{fill:none;stroke:#333;stroke-width:.6}.fr{fill:none;stroke:#444;stroke-width:.8}"
    ".p{fill:none;stroke:none}.lb{font-size:9.5px;fill:#000}.ti{font-weight:bold;font-size:10.5px;fill:#000}"
    ".se{font-size:8.5px;fill:#666}.mi{text-anchor:middle}.en{text-anchor:end}"
)


@dataclass(frozen=True, eq=False)
class _Place:
    """Where a panel stands in the picture that writes its lines.

    Attributes
    ----------
    name : str
        What the ids of its groups of lines begin with.
    box : (4,) array
        Left, top, right, bottom [pt].
    """

    name: str
    box: Real


@dataclass(frozen=True, eq=False)
class Drawn:
    """A picture as it stands in a page.

    Attributes
    ----------
    picture : Picture
        What it was drawn from.
    label : str
        Words for those who do not see it.
    body : str
        Groups of its SVG, without a legend.
    legend : list of tuples of two str
        Sample (groups around the middle of a box from (0, -4.5) to (18, 4.5)) and words of each entry.
    plot : dict
        What the script reads of it.
    narrow : list of Drawn
        Its parts laid out again for a narrow screen; empty where the parts of this one can be read there.
    """

    picture: Picture
    label: str
    body: str
    legend: list[tuple[str, str]]
    plot: dict[str, Any]
    narrow: list[Drawn] = field(default_factory=list)

    @property
    def svg(self) -> str:
        """The image that stands in the page."""
        size = f"0 0 {self.plot['width']:g} {self.plot['height']:g}"
        label = escape(self.label, {'"': "&quot;"})
        return f'<svg viewBox="{size}" role="img" aria-label="{label}">{self.body}</svg>'

    @property
    def samples(self) -> list[tuple[str, str]]:
        """Sample and words of each entry, each sample an image of its own."""
        box = 'viewBox="-1 -4.5 20 9" aria-hidden="true"'
        return [(f"<svg {box}>{sample}</svg>", words) for sample, words in self.legend]


def text_width(text: str, size: float, *, bold: bool = False) -> float:
    """Length [pt] of the longest line of a text."""
    lengths = [sum(map(_letter, line)) for line in text.split("\n")]
    longest = max(lengths, default=0.0)
    boldness = _BOLD if bold else 1.0
    return longest * size * boldness


@lru_cache(maxsize=1000)
def _letter(letter: str) -> float:
    place = ord(letter) - 32
    if 0 <= place < len(_WIDTHS):
        return _WIDTHS[place] / 100
    return _SUPERSCRIPT_WIDTH if letter in "⁻⁰¹²³⁴⁵⁶⁷⁸⁹" else _OTHER_WIDTH


# -- places
# ----------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Frame:
    """A panel in its place.

    Attributes
    ----------
    panel : Panel
    box : (4,) array
        Left, top, right, bottom [pt].
    x, y : Ticks
        Numbers of its axes.
    hertz, decibel : Ticks or None
        Numbers of its second axes.
    numbered : tuple of two bool
        Whether numbers stand at x and at y.
    title, x_label : str
        In as many lines as fit into the picture.
    """

    panel: Panel
    box: Real
    x: Ticks
    y: Ticks
    hertz: Ticks | None = None
    decibel: Ticks | None = None
    numbered: tuple[bool, bool] = (True, True)
    title: str = ""
    x_label: str = ""

    @property
    def width(self) -> float:
        return float(self.box[2] - self.box[0])

    @property
    def height(self) -> float:
        return float(self.box[3] - self.box[1])

    def place(self, which: int, values: Any) -> Real:
        """Where values of an axis lie [pt]."""
        shares = self.panel.axis(which).shares(values)
        places = self.box[0] + shares * self.width
        if which != X:
            places = self.box[3] - shares * self.height
        return np.asarray(np.clip(places, -_FAR, _FAR))

    def written(self, points: Real) -> Real:
        """A line (N, 2) as it is written: without points that are not seen; in y to a tenth where the axis is
        linear, which is 0.03 % of a panel's height."""
        if self.panel.y.kind != "lin":
            return thinned(points, _UNSEEN_LOG)
        points = thinned(points, _UNSEEN)
        rounded_y = np.round(points[:, Y], 1)
        return np.column_stack([points[:, X], rounded_y])

    def number_room(self, which: int) -> float:
        """Room for the marks and numbers of an axis [pt]."""
        if not self.numbered[which]:
            return _MARK
        ticks = self.y if which else self.x
        size = self.panel.tick_size[which]
        if which == Y:
            return _TO_NUMBERS + max((text_width(word, size) for word in ticks.words), default=0.0)
        lines = max((word.count("\n") + 1 for word in ticks.words), default=1)
        return _TO_NUMBERS + size * (_ASCENT + _LINE * (lines - 1) + 0.24)

    def label_room(self) -> float:
        """Room for the label of the y axis, beside the numbers [pt]."""
        label = self.panel.labels[Y]
        if not label:
            return 0.0
        height = _lines(label) * self.panel.label_size[Y] * _LINE
        return _TO_LABEL + height

    def above(self) -> float:
        """Height of what stands over the panel, but for its title [pt]."""
        if self.hertz is not None:
            return _TO_NUMBERS + _SECOND_SIZE + _TO_LABEL + _SECOND_SIZE * _LINE
        return _POWER_ROOM if self.y.power else 0.0

    def around(self) -> Real:
        """Room (4,) that its words need: left, top, right, bottom; but for the label of the y axis."""
        panel = self.panel
        left = self.number_room(Y)
        right = 0.0
        if panel.colour_bar:
            left, right = 0.0, left
        bottom = self.number_room(X)
        if self.x_label:
            bottom += _TO_LABEL + _lines(self.x_label) * panel.label_size[X] * _LINE
        top = self.above()
        if self.title:
            raised = max(panel.title_raised, top + _TO_TITLE)
            top = raised + _lines(self.title) * panel.title_size * _LINE
        if self.decibel is not None:
            words = max((text_width(word, _SECOND_SIZE) for word in self.decibel.words), default=0.0)
            right = _TO_NUMBERS + words + _TO_LABEL + _SECOND_SIZE * _LINE
        # The first and the last number of x reach beyond the panel by half of their width.
        if self.numbered[X] and self.x.words:
            places = self.place(X, self.x.places)
            size = panel.tick_size[X]
            half = np.array([text_width(word, size) / 2 for word in self.x.words])
            beyond_right = np.max(places + half - self.box[2])
            beyond_left = np.max(self.box[0] - places + half)
            right = max(right, float(beyond_right))
            left = max(left, float(beyond_left))
        for mark in panel.marks:
            if isinstance(mark, Words) and not mark.clipped:
                x, y = self.anchor(mark)
                if not self.box[0] <= x <= self.box[2]:
                    continue
                if mark.horizontal == "left":
                    end = x + text_width(mark.text, mark.size)
                    right = max(right, end - self.box[2])
                top = max(top, self.box[1] - y + mark.size)
        return np.array([left, top, right, bottom])

    def anchor(self, words: Words) -> tuple[float, float]:
        """Where words stand [pt]."""
        x = self.box[0] + words.x * self.width if words.across_x else float(self.place(X, words.x))
        # A box is measured downwards, words across it upwards.
        y = self.box[3] - words.y * self.height if words.across_y else float(self.place(Y, words.y))
        right, up = words.offset
        return x + right, y - up

    def reach(self) -> tuple[float, float]:
        """From where to where its words reach [pt], its title included."""
        left, _, right, _ = self.around()
        panel = self.panel
        title_width = text_width(self.title, panel.title_size, bold=panel.title_bold)
        title_end = self.box[0] + title_width
        outer_left = self.box[0] - left - self.label_room()
        outer_right = float(self.box[2] + right)
        return float(outer_left), max(outer_right, title_end)


def _lines(text: str) -> int:
    return text.count("\n") + 1


def _wrapped(text: str, size: float, room: float, *, bold: bool = False) -> str:
    """A text in lines that are no longer than `room` [pt], parted between words; a longer word stays
    whole."""
    lines: list[str] = []
    for paragraph in text.split("\n"):
        line = ""
        for word in paragraph.split(" "):
            longer = f"{line} {word}" if line else word
            if line and text_width(longer, size, bold=bold) > room:
                lines.append(line)
                line = word
            else:
                line = longer
        lines.append(line)
    return "\n".join(lines)


def _laid_out(picture: Picture, height: float) -> list[_Frame]:
    """Panels in what their widest words leave of so high a picture."""
    width = picture.width_in * POINT
    rows, columns = picture.grid.shape
    before = np.zeros((2, max(rows, columns)))
    after = np.zeros((2, max(rows, columns)))
    # A column that holds no panel takes no width.
    pad = np.zeros((2, max(rows, columns)))
    for panel in picture.panels:
        row, column = panel.place
        before[X, column] = 55.0
        before[Y, row] = 25.0
        after[X, column] = 12.0
        after[Y, row] = 25.0
        pad[X, column] = _PAD
        pad[Y, row] = _PAD

    # The room that words need depends on the size of the panels, and that on the room; begun with usual ones.
    frames: list[_Frame] = []
    for _ in range(_MOST_LAYOUTS):
        room_x = pad[X, :columns]
        room_y = pad[Y, :rows]
        first_x = before[X, :columns] + room_x
        last_x = after[X, :columns] + room_x
        first_y = before[Y, :rows] + room_y
        last_y = after[Y, :rows] + room_y
        x = _edges(first_x, last_x, picture.width_ratios, width)
        y = _edges(first_y, last_y, picture.height_ratios, height)
        frames = []
        for panel in picture.panels:
            row, column = panel.place
            frames.append(_framed(picture, panel, x[:, column], y[:, row]))
        known = np.concatenate([before, after])
        before[:] = 0.0
        after[:] = 0.0
        # Labels stand under each other, beside the widest numbers of the column.
        labels = np.zeros(columns)
        for frame in frames:
            row, column = frame.panel.place
            left, top, right, bottom = frame.around()
            before[X, column] = max(before[X, column], left)
            before[Y, row] = max(before[Y, row], top)
            after[X, column] = max(after[X, column], right)
            after[Y, row] = max(after[Y, row], bottom)
            labels[column] = max(labels[column], frame.label_room())
        before[X, :columns] += labels
        # Words that stand at a place in the data need another room at every size of their panel.
        change = np.concatenate([before, after]) - known
        if np.max(np.abs(change)) < _SAME_ROOM:
            break
    return frames


def _edges(before: Real, after: Real, ratios: Any, total: float) -> Real:
    """Begin and end (2, N) of each column or row, without the room before and after it."""
    # Where the words alone fill the picture, a point is left: a panel of no size has no scale.
    left_over = max(total - before.sum() - after.sum(), 1.0)
    shares = np.asarray(ratios) / np.sum(ratios)
    sizes = shares * left_over
    # Each column begins where the last one and the room after it end.
    behind = np.append(0.0, (sizes + after)[:-1])
    starts = np.cumsum(before + behind)
    return np.array([starts, starts + sizes])


def _framed(picture: Picture, panel: Panel, x: Real, y: Real) -> _Frame:
    """A panel between the edges of its column and its row, with its numbers."""
    box = np.array([x[0], y[0], x[1], y[1]])
    if panel.equal:
        # A unit is as long in x as in y: the box shrinks around its middle.
        spans = np.abs([np.ptp(panel.x.limits()), np.ptp(panel.y.limits())])
        width = x[1] - x[0]
        height = y[1] - y[0]
        scale = min(width / spans[X], height / spans[Y])
        half = scale * spans / 2
        middle = np.array([x.mean(), y.mean()])
        box = np.concatenate([middle - half, middle + half])
    along = box[2] - box[0]
    up = box[3] - box[1]
    size = panel.tick_size
    fitting_y = up / (2 * size[Y])
    y_ticks = ticks_of(panel.y, int(np.clip(fitting_y, 1, _MOST_NUMBERS)))
    width_pt = picture.width_in * POINT
    if panel.y.named is not None:
        longest = _LONGEST_NAME * width_pt
        words = [_wrapped(word, size[Y], longest) for word in y_ticks.words]
        y_ticks = replace(y_ticks, words=words)
    # A title may run from its panel's left edge to the picture's right one, a label over the whole picture.
    title_room = width_pt - float(box[0]) - _PAD
    label_room = width_pt - 2 * _PAD
    frame = _Frame(
        panel,
        box,
        _fitting(panel.x, float(along), size[X]),
        y_ticks,
        numbered=(picture.numbered(panel, X), picture.numbered(panel, Y)),
        title=_wrapped(panel.title, panel.title_size, title_room, bold=panel.title_bold),
        x_label=_wrapped(panel.labels[X], panel.label_size[X], label_room),
    )
    if panel.hertz:
        low, high = np.array(panel.x.limits()) / (2 * np.pi)
        fitting = int(np.clip(along / _HERTZ_PT, 1, _MOST_NUMBERS))
        frame.hertz = log_ticks(float(low), float(high), fitting)
    if panel.decibel:
        low, high = 20 * np.log10(panel.y.limits())
        frame.decibel = linear_ticks(float(low), float(high), MOST_DECIBELS, DECIBEL_STEPS)
    return frame


def _fitting(axis: Axis, length: float, size: float) -> Ticks:
    """The ticks of an axis with as many numbers as fit along a length [pt] in letters of a size [pt]."""
    count = int(np.clip(length / (3 * size), 1, _MOST_NUMBERS))
    while True:
        ticks = ticks_of(axis, count)
        widest = max((text_width(word, size) for word in ticks.words), default=0.0)
        places = np.sort(axis.shares(ticks.places)) * length
        nearest = float(np.min(np.diff(places), initial=np.inf))
        if count <= 2 or axis.named is not None or widest + 4 < nearest:
            return ticks
        count -= 1


# -- paths
# -----------------------------------------------------------------------------------------------------


def path_of(points: Real, *, closed: bool = False, start: tuple[int, int] = (0, 0)) -> str:
    """Points (N, 2) [pt] as a path of relative steps, to a tenth in x and a hundredth in y. start: where the
    path before it ended, in hundredths."""
    steps = np.diff(_hundredths(points), axis=0, prepend=np.array([start]))
    return f"m{_joined(steps.ravel().tolist())}{'z' if closed else ''}"


def _joined(hundredths: list[int]) -> str:
    """Numbers as a path has them: a sign, and the point of a number after one with a point, part as a blank
    does."""
    text = " ".join(map(_short, hundredths)).replace(" -", "-")
    return _BLANK_BETWEEN_POINTS.sub(r"\1", text)


def _hundredths(points: Real) -> Any:
    steps_per_pt = np.array([10.0, 100.0])
    places = np.rint(points * steps_per_pt).astype(np.int64)
    places[:, 0] *= 10
    return places


@lru_cache(maxsize=20_000)
def _short(hundredths: int) -> str:
    """A number of hundredths as SVG writes it shortest: ".5", "-3", "0"."""
    whole, decimals = divmod(abs(hundredths), 100)
    text = str(whole) if whole else ""
    if decimals:
        text += f".{decimals:02d}".rstrip("0")
    sign = "-" if hundredths < 0 else ""
    return sign + (text or "0")


def _lines_of(points: Real, box: Real) -> Iterator[Real]:
    """Parts of a line (N, 2) that are seen in a box (left, top, right, bottom), between points that are no
    numbers."""
    with np.errstate(invalid="ignore"):
        before_box = points < box[:2] - _EDGE
        after_box = points > box[2:] + _EDGE
    past_side: Any = np.concatenate([before_box, after_box], axis=1)
    # A step whose ends lie beyond the same side is not in the box.
    outside: Any = np.any(past_side[1:] & past_side[:-1], axis=1)
    drawn_steps = ~outside
    finite: Any = np.isfinite(points).all(axis=1)
    drawn_steps &= finite[1:] & finite[:-1]
    # Begin and end of each run of steps that are drawn: where the flag changes.
    flags = np.concatenate([[False], drawn_steps, [False]]).astype(int)
    edges = np.flatnonzero(np.diff(flags))
    for first, last in edges.reshape(-1, 2):
        yield points[first : last + 1]


def thinned(points: Real, unseen: float = _UNSEEN) -> Real:
    """A line (N, 2) without points that are not seen: those nearer than `unseen` [pt] to the line between
    their neighbours, and of a signal that goes up and down within a pixel all but four there."""
    points = _four_a_pixel(points)
    for turn in range(_THINNINGS):
        if points.shape[0] < 3:
            break
        # Every second point in turn, so that no two neighbours go at once.
        middle = np.arange(1 + turn % 2, points.shape[0] - 1, 2)
        if not middle.size:
            continue
        before = points[middle - 1]
        after = points[middle + 1]
        way = after - before
        length = np.hypot(*way.T)
        off = points[middle] - before
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = way[:, 0] * off[:, 1] - way[:, 1] * off[:, 0]
            beside = np.abs(cross) / length
            along = np.sum(way * off, axis=1) / length**2
        straight = (beside < unseen) & (along >= 0) & (along <= 1)
        if not straight.any():
            if turn % 2:
                break
            continue
        points = np.delete(points, middle[straight], axis=0)
    return points


def _four_a_pixel(points: Real) -> Real:
    """A line (N, 2) with four points of each pixel at most: the first, the smallest, the largest, the last.

    They cover the same pixels as all of it (M4: Jugel et al., Proc. VLDB 7(10), 2014). A line that does not
    only go to the right, or has few points, comes back as it is.
    """
    x, y = points.T
    goes_back = np.any(np.diff(x) < 0)
    # Fewer than four points a pixel: there is nothing to leave out.
    most_pt = x.size / 4 * _PIXEL
    if x.size < 5 or goes_back or x[-1] - x[0] > most_pt:
        return points
    pixel = np.floor(x / _PIXEL).astype(np.int64)
    firsts = np.flatnonzero(np.diff(pixel, prepend=pixel[0] - 1))
    lasts = np.append(firsts[1:], x.size) - 1
    # Sorted by pixel, then by value.
    order = np.lexsort((y, pixel))
    lowest = order[firsts]
    highest = order[lasts]
    chosen = np.unique(np.concatenate([firsts, lasts, lowest, highest]))
    return np.asarray(points[chosen])


def _many(parts: list[Real], *, closed: bool = False) -> str:
    """Several lines as one path."""
    texts = []
    end = (0, 0)
    for part in parts:
        texts.append(path_of(part, closed=closed, start=end))
        # A closed path ends where it began.
        end_point = part[:1] if closed else part[-1:]
        last = _hundredths(end_point)[0]
        end = int(last[0]), int(last[1])
    return "".join(texts)


def _held(points: Real) -> Real:
    """Points (N, 2) of a signal that holds each value until the next."""
    held = np.repeat(points, 2, axis=0)
    next_x = held[1:, 0]
    value_until_then = held[:-1, 1]
    return np.column_stack([next_x, value_until_then])


# -- groups
# ----------------------------------------------------------------------------------------------------


class _Writer:
    """Writes a picture as SVG.

    Parameters
    ----------
    picture : Picture
    number : str
        Of the picture in the page, unlike that of all others.
    classes : dict
        Looks of the page by what they say; new ones are added.
    entries : dict
        What the legend names, of all panels that it stands for.
    whole : dict
        Of a part for a narrow screen: `written` of the whole picture, whose lines it shows again.
    shows_again : bool
        Whether such parts follow: then groups of lines have ids.

    Attributes
    ----------
    written : dict
        Where each panel, by its id(), has been written.
    """

    def __init__(
        self,
        picture: Picture,
        number: str,
        classes: dict[str, str],
        entries: dict[str, Mark],
        *,
        whole: Mapping[int, _Place] | None = None,
        shows_again: bool = False,
    ) -> None:
        self.whole = whole or {}
        self.written: dict[int, _Place] = {}
        self.shows_again = shows_again
        self.picture = picture
        self.number = number
        self.classes = classes
        self.markers: dict[tuple[str, str], str] = {}
        self.entries = entries
        # Of two entries with one look the first one stands for it.
        self.entry_of_look: dict[Any, int] = {}
        for number_of_entry, mark in enumerate(self.entries.values()):
            self.entry_of_look.setdefault(looks.key(mark), number_of_entry)
        self.entry_of_label = {label: k for k, label in enumerate(self.entries)}

    def named(self, look: str) -> str:
        """The class of a look."""
        return self.classes.setdefault(look, f"s{len(self.classes)}")

    def panel(self, place: int, frame: _Frame) -> str:
        """The group of a panel, its second axes not included."""
        clip = f"f{self.number}-c{place}"
        self.written[id(frame.panel)] = _Place(clip, frame.box)
        # Left and top, right and top, right and bottom, left and bottom.
        corners = frame.box[[0, 1, 2, 1, 2, 3, 0, 3]].reshape(4, 2)
        outline = path_of(corners, closed=True)
        parts = [
            f'<clipPath id="{clip}"><path d="{outline}"/></clipPath>',
            self.axis(frame, X),
            self.axis(frame, Y),
        ]
        drawn = [mark for mark in frame.panel.layered() if not isinstance(mark, Words | Arrow)]
        for k, (name, marks) in enumerate(groupby(drawn, self.group_name)):
            parts.append(self.data(list(marks), name, clip, frame, k))
        left, top, right, bottom = frame.box
        spine = np.array([[left, top], [left, bottom], [right, bottom]])
        parts.append(f'<path class="fr" d="{path_of(spine)}"/>')
        for mark in frame.panel.marks:
            if isinstance(mark, Words):
                parts.append(self.words(mark, frame))
            elif isinstance(mark, Arrow):
                parts.append(self.arrow(mark, clip, frame))
        parts.append(self.title(frame))
        return f'<g class="a{place}">{"".join(parts)}</g>'

    def group_name(self, mark: Mark) -> str:
        """`kE` of what the legend names or what looks like it, `d` of all else."""
        entry = self.entry_of_label.get(getattr(mark, "label", ""))
        if entry is None:
            entry = self.entry_of_look.get(looks.key(mark))
        return "d" if entry is None else f"k{entry}"

    def data(self, marks: list[Mark], name: str, clip: str, frame: _Frame, k: int) -> str:
        """The k-th group of data of a panel: what can be stretched in a group of its own, then markers."""
        stretched: list[str] = []
        dots: list[str] = []
        for mark in marks:
            if isinstance(mark, Area):
                stretched += self.area(mark, frame)
            elif isinstance(mark, Curve):
                line, markers = self.curve(mark, frame)
                stretched += line
                dots += markers
            elif isinstance(mark, Rule | Span):
                stretched.append(self.across(mark, frame))
        moving = "".join(stretched)
        whole = self.whole.get(id(frame.panel))
        if moving and whole is not None:
            stretch = _stretch(whole.box, frame.box)
            moving = f'<use href="#{whole.name}-{k}" transform="{stretch}"/>'
        elif moving and self.shows_again:
            moving = f'<g id="{clip}-{k}" class="v">{moving}</g>'
        if moving:
            moving = f'<g class="m">{moving}</g>'
        still = "".join(dots)
        return f'<g class="{name}" clip-path="url(#{clip})">{moving}{still}</g>'

    def area(self, mark: Area, frame: _Frame) -> list[str]:
        """Paths of the outlines that are large enough to be seen."""
        shapes = []
        for outline in mark.outlines:
            x = frame.place(X, outline[:, X])
            y = frame.place(Y, outline[:, Y])
            points = np.column_stack([x, y])
            is_finite = np.isfinite(points).all()
            # A speck that nobody can see costs as many bytes as a large shape.
            if len(points) and is_finite and np.ptp(points, axis=0).max() > _SPECK:
                shapes.append(frame.written(points))
        if not shapes:
            return []
        look = self.named(looks.filling(mark.look))
        if mark.whole:
            return [f'<path class="{look}" fill-rule="evenodd" d="{_many(shapes, closed=True)}"/>']
        return [f'<path class="{look}" d="{path_of(shape, closed=True)}"/>' for shape in shapes]

    def curve(self, mark: Curve, frame: _Frame) -> tuple[list[str], list[str]]:
        """Paths of the line, and of the markers."""
        x = frame.place(X, mark.x)
        y = frame.box[3] - mark.y * frame.height if mark.across else frame.place(Y, mark.y)
        points = np.column_stack([x, y])
        lines: list[str] = []
        if looks.is_line(mark.look):
            seen = _held(points) if mark.look.get("drawstyle") == "steps-post" else points
            parts = [frame.written(part) for part in _lines_of(seen, frame.box)]
            path = _many(parts)
            if path:
                look = self.named(looks.stroke(mark.look))
                lines = [f'<path class="{look}" d="{path}"/>']
        dots = []
        if mark.look.get("marker"):
            places = points[np.isfinite(points).all(axis=1)]
            after_left_top = places >= frame.box[:2] - 1
            before_right_bottom = places <= frame.box[2:] + 1
            inside = (after_left_top & before_right_bottom).all(axis=1)
            places = places[inside]
            if len(places):
                known = self.marker(mark.look)
                dots = [f'<path class="p" style="marker:url(#{known})" d="{path_of(places)}"/>']
        return lines, dots

    def marker(self, look: Mapping[str, Any]) -> str:
        """The id of a marker."""
        style, outline = looks.marker(look)
        kind = (self.named(style), outline)
        new_id = f"f{self.number}-m{len(self.markers)}"
        return self.markers.setdefault(kind, new_id)

    def definitions(self) -> str:
        """Markers of the picture."""
        markers = "".join(
            f'<marker id="{name}" markerUnits="userSpaceOnUse" overflow="visible"><path class="{style}" '
            f'd="{outline}"/></marker>'
            for (style, outline), name in self.markers.items()
        )
        return f"<defs>{markers}</defs>" if markers else ""

    def across(self, mark: Rule | Span, frame: _Frame) -> str:
        """A line or a strip from edge to edge."""
        ends = np.array([mark.at]) if isinstance(mark, Rule) else np.array([mark.low, mark.high])
        places = frame.place(mark.axis, ends)
        left, top, right, bottom = frame.box
        along = (left, right) if mark.axis == Y else (top, bottom)
        # The second edge of a strip runs backwards, so that its outline goes round.
        corners = []
        for place, sides in zip(places, (along, along[::-1]), strict=False):
            for side in sides:
                corner = (place, side) if mark.axis == X else (side, place)
                corners.append(corner)
        points = np.array(corners)
        if isinstance(mark, Rule):
            look = self.named(looks.stroke(mark.look))
            return f'<path class="{look}" d="{path_of(points)}"/>'
        look = self.named(looks.filling(mark.look))
        return f'<path class="{look}" d="{path_of(points, closed=True)}"/>'

    def words(self, mark: Words, frame: _Frame) -> str:
        """Words at their place; "" where that is out of view and they are not to be drawn there."""
        x, y = frame.anchor(mark)
        if mark.vertical == "center":
            y += 0.35 * mark.size
        left, top, right, bottom = frame.box
        if mark.clipped and not (left <= x <= right and top <= y <= bottom):
            return ""
        side = mark.horizontal
        end = x + text_width(mark.text, mark.size)
        if mark.clipped and side == "left" and end > right:
            # Where there is no room to the right of a line, to its left.
            x -= 2 * mark.offset[0]
            side = "right"
        # Classes that the page's script knows: `t` at a place in the data, `u` where only x is one, `w` where
        # x is none.
        if mark.across_x:
            name = "w"
        elif mark.across_y:
            name = "u"
        else:
            name = "t"
        look = self.named(f"font-size:{mark.size:g}px;fill:{mark.color}")
        return f'<g class="{name}">{_text(mark.text, x, y, look, side)}</g>'

    def arrow(self, mark: Arrow, clip: str, frame: _Frame) -> str:
        """The head of an arrow, as long as letters are high."""
        start, tip = (
            np.array([float(frame.place(X, x)), float(frame.place(Y, y))]) for x, y in (mark.start, mark.tip)
        )
        way = tip - start
        length = float(np.hypot(*way))
        if not length > 0:
            return ""
        ahead = way / length
        beside = np.array([-ahead[1], ahead[0]])
        foot = tip - 8 * ahead
        corners = np.array([tip, foot + 3.4 * beside, foot - 3.4 * beside])
        look = self.named(f"fill:{mark.color}")
        path = path_of(corners, closed=True)
        return f'<g class="d" clip-path="url(#{clip})"><g class="m"><path class="{look}" d="{path}"/></g></g>'

    def axis(self, frame: _Frame, which: int) -> str:
        """Lines of the grid, marks, numbers and label of an axis."""
        panel = frame.panel
        ticks = frame.y if which else frame.x
        left, top, right, bottom = frame.box
        places = frame.place(which, ticks.places)
        minor = frame.place(which, ticks.minor)
        parts = []
        if panel.grid_lines[which] and places.size:
            ends = (left, right) if which else (bottom, top)
            parts.append(f'<path class="gl" d="{_strokes(places, which, *ends)}"/>')
        edge = left if which else bottom
        outwards = -1 if which else 1
        side = "en" if which else "mi"
        if panel.colour_bar and which == Y:
            edge = right
            outwards = 1
            side = "st"
        beside = edge + outwards * _TO_NUMBERS
        for values, long, name in ((places, _MARK, "tk"), (minor, _SMALL_MARK, "tn")):
            if values.size:
                strokes = _strokes(values, which, edge, edge + outwards * long)
                parts.append(f'<path class="{name}" d="{strokes}"/>')
        size = panel.tick_size[which]
        look = "" if size == 9 else self.named(f"font-size:{size:g}px;fill:#333")
        if frame.numbered[which]:
            below = bottom + _TO_NUMBERS + _ASCENT * size
            for place, word in zip(places, ticks.words, strict=True):
                if which == X:
                    parts.append(_text(word, place, below, look, size=size))
                else:
                    # Digits are .72 of their size high. Further lines move the first up by half their room.
                    further_lines = _lines(word) - 1
                    foot = place + (0.36 - further_lines * _LINE / 2) * size
                    parts.append(_text(word, beside, foot, look, size=size))
        group = f'<g class="{"xy"[which]} {side}">{"".join(parts)}</g>'
        if ticks.power and frame.numbered[which]:
            if which == X:
                group += _text(ticks.power, right, bottom + frame.number_room(X) + size, "pw", "right")
            else:
                group += _text(ticks.power, left, top - 3.0, "pw", "left")
        label = panel.labels[which]
        letters = panel.label_size[which]
        if not label:
            return group
        look = "lb" if letters == 9.5 else self.named(f"font-size:{letters:g}px;fill:#000")
        if which == X:
            foot = bottom + frame.number_room(X) + _TO_LABEL + _ASCENT * letters
            # Below the middle of its panel, but inside of the picture.
            half = text_width(frame.x_label, letters) / 2
            rightmost = self.picture.width_in * POINT - _PAD - half
            middle = max(min((left + right) / 2, rightmost), _PAD + half)
            return group + _text(frame.x_label, middle, foot, look, "center", letters)
        # Labels of a column stand under each other: beside the widest numbers of all its panels.
        outer = left - self.number_rooms[panel.place[1]] - _TO_LABEL
        further_lines = _lines(label) - 1
        foot = outer - 0.24 * letters - further_lines * letters * _LINE
        middle = (top + bottom) / 2
        return group + _turned(label, foot, middle, look, letters)

    def second(self, frame: _Frame, which: int, place: int) -> str:
        """A second axis: Hz above, dB on the right."""
        ticks = frame.decibel if which else frame.hertz
        assert ticks is not None
        left, top, right, bottom = frame.box
        # Marks stand at round values of the other unit: Hz where the axis has rad/s, dB for a gain.
        if which:
            values = 10 ** (ticks.places / 20)
            minor_values = 10 ** (ticks.minor / 20)
            edge, outwards = right, 1
        else:
            values = ticks.places * 2 * np.pi
            minor_values = ticks.minor * 2 * np.pi
            edge, outwards = top, -1
        places = frame.place(which, values)
        minor = frame.place(which, minor_values)
        parts = []
        for ends, long, name in ((places, _MARK, "tk"), (minor, _SMALL_MARK, "tn")):
            if ends.size:
                strokes = _strokes(ends, which, edge, edge + outwards * long)
                parts.append(f'<path class="{name}" d="{strokes}"/>')
        for at, word in zip(places, ticks.words, strict=True):
            if which == X:
                parts.append(_text(word, at, top - _TO_NUMBERS, "se"))
            else:
                foot = at + 0.36 * _SECOND_SIZE
                parts.append(_text(word, right + _TO_NUMBERS, foot, "se"))
        widest = max((text_width(word, _SECOND_SIZE) for word in ticks.words), default=0.0)
        if which == X:
            foot = top - _TO_NUMBERS - _SECOND_SIZE - _TO_LABEL
            label = _text("frequency [Hz]", (left + right) / 2, foot, "se", "center")
        else:
            beside = right + _TO_NUMBERS + widest + _TO_LABEL + _ASCENT * _SECOND_SIZE
            label = _turned("[dB]", beside, (top + bottom) / 2, "se", _SECOND_SIZE)
        line = np.array([[right, top], [right, bottom]] if which else [[left, top], [right, top]])
        return (
            f'<g class="a{place}"><path class="fr" d="{path_of(line)}"/>'
            f'<g class="{("x mi", "y")[which]}">{"".join(parts)}</g>{label}</g>'
        )

    def title(self, frame: _Frame) -> str:
        """The title above a panel, in its lines; "" without one."""
        panel = frame.panel
        if not frame.title:
            return ""
        look = "ti"
        if panel.title_size != 10.5 or not panel.title_bold:
            weight = "bold" if panel.title_bold else "normal"
            look = self.named(f"font-weight:{weight};font-size:{panel.title_size:g}px;fill:#000")
        raised = max(panel.title_raised, frame.above() + _TO_TITLE)
        further_lines = _lines(frame.title) - 1
        lines = further_lines * panel.title_size * _LINE
        foot = frame.box[1] - raised - lines
        return _text(frame.title, frame.box[0], foot, look, "left", panel.title_size)

    def sample(self, mark: Mark) -> str:
        """What stands before a word of the legend: a line, an area or a marker around the middle of a box
        from (0, -4.5) to (18, 4.5)."""
        if isinstance(mark, Area | Span):
            return f'<path class="{self.named(looks.filling(mark.look))}" d="m0-3h18v6h-18z"/>'
        assert isinstance(mark, Curve | Rule)
        parts = ""
        if looks.is_line(mark.look):
            parts = f'<path class="{self.named(looks.stroke(mark.look))}" d="m0 0h18"/>'
        if mark.look.get("marker"):
            style, outline = looks.marker(mark.look)
            parts += f'<path class="{self.named(style)}" transform="translate(9)" d="{outline}"/>'
        return parts

    def body(self, frames: list[_Frame]) -> tuple[str, list[dict[str, Any]]]:
        """Groups of all axes, and what the script reads of each."""
        rooms: dict[int, float] = {}
        for frame in frames:
            column = frame.panel.place[1]
            rooms[column] = max(rooms.get(column, 0.0), frame.number_room(Y))
        self.number_rooms = rooms
        groups: list[str] = []
        read: list[dict[str, Any]] = []
        first_of: dict[int, int] = {}
        for frame in frames:
            place = len(read)
            panel = frame.panel
            groups.append(self.panel(place, frame))
            shared = [first_of.setdefault(id(axis), place) for axis in (panel.x, panel.y)]
            read.append(_read(self.picture, frame, shared))
            for which, ticks in enumerate((frame.hertz, frame.decibel)):
                if ticks is not None:
                    groups.append(self.second(frame, which, len(read)))
                    read.append(_read_second(frame, which, shared))
        return self.definitions() + "".join(groups), read


def _read(picture: Picture, frame: _Frame, shared: list[int]) -> dict[str, Any]:
    """What the script reads of a panel: `box`, scales, names, and which others share its x or y."""
    panel = frame.panel
    return {
        "box": [round(float(value), 2) for value in frame.box],
        # A plane: values belong to points, not to an x.
        "near": panel.equal,
        "x": _scale(panel.x),
        "y": _scale(panel.y),
        "second": False,
        "names": [picture.name(panel, X), picture.name(panel, Y)],
        "with": shared,
    }


def _read_second(frame: _Frame, which: int, shared: list[int]) -> dict[str, Any]:
    """What the script reads of a second axis: the same box in other units."""
    x = _scale(frame.panel.x)
    y = _scale(frame.panel.y)
    names = ["", ""]
    if which == X:
        ends_Hz = [end / (2 * np.pi) for end in x[:2]]
        x = [float(f"{end:.7g}") for end in ends_Hz] + x[2:]
        names[X] = "frequency [Hz]"
    else:
        ends_dB = [20 * np.log10(end) for end in y[:2]]
        y = [float(f"{end:.7g}") for end in ends_dB] + ["lin"]
        names[Y] = "[dB]"
    box = [round(float(value), 2) for value in frame.box]
    return {"box": box, "near": False, "x": x, "y": y, "second": True, "names": names, "with": shared}


def _scale(axis: Axis) -> list[Any]:
    """Ends and kind of a scale."""
    ends = [float(f"{end:.7g}") for end in axis.limits()]
    return [*ends, axis.kind]


def _stretch(before: Real, after: Real) -> str:
    """The transformation that takes what stands in a box (left, top, right, bottom) [pt] into another."""
    scale = (after[2:] - after[:2]) / (before[2:] - before[:2])
    shift = after[:2] - scale * before[:2]
    # Lines are as far as 1000 pt from the origin: six digits of the scale keep a thousandth of a point.
    return f"matrix({scale[X]:.6g} 0 0 {scale[Y]:.6g} {shift[X]:.5g} {shift[Y]:.5g})"


def _strokes(places: Real, which: int, first: float, last: float) -> str:
    """Straight strokes across an axis at places along it, there and back in turn."""
    ends = np.array([first, last])
    path = []
    at = np.zeros(2, dtype=np.int64)
    for number, place in enumerate(places):
        begin, end = ends[::-1] if number % 2 else ends
        if which:
            corners = np.array([[begin, place], [end, place]])
        else:
            corners = np.array([[place, begin], [place, end]])
        start, stop = _hundredths(corners)
        step = _joined((start - at).tolist())
        letter = "h" if which else "v"
        length = int((stop - start)[1 - which])
        path.append(f"m{step}{letter}{_short(length)}")
        at = stop
    return "".join(path)


def _text(words: str, x: float, y: float, look: str, side: str = "left", size: float = 9.0) -> str:
    """Words at a place, several lines of them below each other."""
    end = {"center": " mi", "right": " en"}.get(side, "")
    name = f' class="{(look + end).strip()}"' if look or end else ""
    place = f'x="{_tenth(x)}" y="{_tenth(y)}"'
    first, *further_lines = words.split("\n")
    if not further_lines:
        return f"<text{name} {place}>{escape(first)}</text>"
    spans = ""
    for line in further_lines:
        spans += f'<tspan x="{_tenth(x)}" dy="{size * _LINE:.1f}">{escape(line)}</tspan>'
    return f"<text{name} {place}>{escape(first)}{spans}</text>"


def _tenth(length: float) -> str:
    """A length to a tenth."""
    return f"{length:.1f}".removesuffix(".0")


def _turned(words: str, x: float, y: float, look: str, size: float) -> str:
    """Words that read upwards, several lines of them beside each other; x: foot of the first line."""
    lines = []
    for k, line in enumerate(words.split("\n")):
        foot = x + k * size * _LINE
        turned = f"translate({foot:.1f} {y:.1f})rotate(-90)"
        lines.append(f'<text class="{look} mi" transform="{turned}">{escape(line)}</text>')
    return "".join(lines)


def _cuts(frames: list[_Frame]) -> list[float]:
    """Where columns of panels may be parted; a colour bar stays with what is left of it."""
    columns = []
    for frame in frames:
        left, right = frame.reach()
        columns.append((0.0 if frame.panel.colour_bar else left, right))
    columns.sort()
    cuts = []
    reach = columns[0][1] if columns else 0.0
    for low, high in columns[1:]:
        if low > reach:
            cuts.append(round((low + reach) / 2, 1))
        reach = max(reach, high)
    return cuts


def _legend_rows(picture: Picture) -> list[list[str]]:
    """Words of the legend in rows that fit into the width of the picture."""
    rows: list[list[str]] = [[]]
    left = _PAD
    for label in picture.legend():
        width = _SAMPLE + _AFTER_SAMPLE + text_width(label, _LEGEND_SIZE) + _AFTER_ENTRY
        if rows[-1] and left + width > picture.width_in * POINT:
            rows.append([])
            left = _PAD
        rows[-1].append(label)
        left += width
    return rows if rows[0] else []


def _legend_height(picture: Picture) -> float:
    """Height of the legend with room above and below it [pt]."""
    rows = len(_legend_rows(picture))
    return _ROW * rows + 2 * _PAD if rows else 0.0


def drawn(picture: Picture, label: str, number: int, classes: dict[str, str]) -> Drawn:
    """A picture for a page. label: what is read aloud in its place; number: of the picture in the page;
    classes: looks of the page by what they say, added to."""
    entries = picture.legend()
    height = picture.height_in * POINT - _legend_height(picture)
    frames = _laid_out(picture, height)
    parts = _narrow_parts(picture, frames, height)
    writer = _Writer(picture, str(number), classes, entries, shows_again=bool(parts))
    made = _written(picture, label, height, frames, writer)
    # A part for a narrow screen shows the lines of the whole again: a second copy would weigh as much.
    for k, part in enumerate(parts):
        of_part = _Writer(part, f"{number}n{k}", classes, entries, whole=writer.written)
        made.narrow.append(_written(part, label, height, _laid_out(part, height), of_part))
    return made


def _written(picture: Picture, label: str, height: float, frames: list[_Frame], writer: _Writer) -> Drawn:
    """A picture of this height [pt] without its legend as it is written, its panels being in their places."""
    body, read = writer.body(frames)
    plot = {
        "axes": read,
        "cuts": _cuts(frames),
        "height": round(height, 1),
        "width": round(picture.width_in * POINT, 1),
        "legend": list(writer.entries),
    }
    samples = [(writer.sample(mark), words) for words, mark in writer.entries.items()]
    return Drawn(picture, label, body, samples, plot)


def _narrow_parts(picture: Picture, frames: list[_Frame], height: float) -> list[Picture]:
    """The parts of a picture as pictures for a narrow screen; none where each can be read there as it is.

    Parameters
    ----------
    picture : Picture
        The whole, as for a wide screen.
    frames : list
        Its panels in their places.
    height : float
        Of the whole without its legend [pt]; that of each part as well.

    Returns
    -------
    list of Picture
        One for each run of columns between the cuts, from left to right.
    """
    edges = [0.0, *_cuts(frames), picture.width_in * POINT]
    if max(np.diff(edges)) <= _WIDEST_PART:
        return []
    parts = []
    for left, right in pairwise(edges):
        inside = [frame for frame in frames if left <= frame.box[0] < right]
        columns = {frame.panel.place[1] for frame in inside}
        parts.append(picture.of_columns(columns, width_in=NARROW_WIDTH_IN, height_in=height / POINT))
    return parts


def svg_file(made: Drawn, classes: Mapping[str, str]) -> bytes:
    """A picture of a page with its legend as a file of its own. Equal pictures give equal bytes."""
    picture = made.picture
    width = picture.width_in * POINT
    height = picture.height_in * POINT
    samples = {words: sample for sample, words in made.legend}
    rows = _legend_rows(picture)
    legend = []
    for row, labels in enumerate(rows):
        left = _PAD
        middle = height - _PAD - _ROW * (len(rows) - row - 0.5)
        for label in labels:
            words = _text(label, _SAMPLE + _AFTER_SAMPLE, 0.36 * _LEGEND_SIZE, "")
            legend.append(f'<g transform="translate({left:.1f} {middle:.1f})">{samples[label]}{words}</g>')
            sample_width = _SAMPLE + _AFTER_SAMPLE
            left += sample_width + text_width(label, _LEGEND_SIZE) + _AFTER_ENTRY
    drawing = made.body + "".join(legend)
    used = set(re.findall(r'class="(s\d+)', drawing))
    used_classes = {look: name for look, name in classes.items() if name in used}
    style = COMMON_STYLE + style_of(used_classes)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}pt" height="{height:g}pt" '
        f'viewBox="0 0 {width:g} {height:g}"><style>{style}</style>'
        f'<path fill="#fff" d="m0 0h{width:g}v{height:g}h-{width:g}z"/>{drawing}</svg>\n'
    ).encode()


def alone(picture: Picture) -> bytes:
    """A picture that stands in no page as a file of its own. Equal pictures give equal bytes."""
    classes: dict[str, str] = {}
    return svg_file(drawn(picture, "", 0, classes), classes)


def style_of(classes: Mapping[str, str]) -> str:
    """The style sheet of looks."""
    return "".join(f".{name}{{{look}}}" for look, name in classes.items())
