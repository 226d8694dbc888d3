"""A picture as a figure of matplotlib: for the Python front door, and for files in further formats."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable
from functools import cache
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis as MatplotlibAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.ticker import (
    FixedLocator,
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    MultipleLocator,
    NullFormatter,
    NullLocator,
)

from workflow.engine import interrupts
from workflow.figures.description import (
    WIDTH_IN,
    Area,
    Arrow,
    Axis,
    Curve,
    Mark,
    Panel,
    Picture,
    Rule,
    Words,
)
from workflow.figures.style import decibels
from workflow.figures.ticks import DECIBEL_STEPS, MOST_DECIBELS, number, power_of_ten

# 1600 pixels at the width of a page: sharp on screens of high density.
_PNG_DPI = 160
# Entries of a legend stand in columns of equal width. Inches that a letter of 9 pt takes at most, on average.
_LETTER_IN = 0.08
# Inches for the sample of an entry and the gaps beside it.
_SAMPLE_IN = 0.75

# Settings of matplotlib that make its figures look like those of a page.
_RC: Any = {
    # Ships with matplotlib: the same picture on every machine.
    "font.family": ["DejaVu Sans"],
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#444444",
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.fontsize": 9.0,
    "legend.frameon": False,
    "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0,
    "xtick.color": "#333333",
    "ytick.color": "#333333",
    "path.simplify": True,
    # Values are read off these lines.
    "path.simplify_threshold": 0.05,
    # Text stays text: it is found, copied and read aloud.
    "svg.fonttype": "none",
    "svg.hashsalt": "flexlink",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "axes.unicode_minus": True,
    "axes.formatter.use_mathtext": False,
    # A dollar sign in a column name is a dollar sign.
    "text.parse_math": False,
    "axes.formatter.limits": (-4, 4),
    "figure.constrained_layout.h_pad": 0.06,
    "figure.constrained_layout.w_pad": 0.06,
}


def house_style() -> contextlib._GeneratorContextManager[None]:
    """Context in which figures are built and rendered; global matplotlib settings come back afterwards."""
    return mpl.rc_context(_RC)


class NotebookFigure(Figure):
    """A figure that a notebook shows; it would know those of pyplot only."""

    def _repr_svg_(self) -> str:
        text = io.StringIO()
        with house_style():
            self.savefig(text, format="svg")
        return text.getvalue()


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """An empty figure of the page's width, laid out automatically, owned by no global state."""
    figure = NotebookFigure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def figure_of(picture: Picture, ax: Any = None) -> Figure:
    """The figure of a picture.

    Parameters
    ----------
    picture : Picture
    ax : axes or sequence of axes, optional
        One for each panel, to draw on in place of a new figure; a legend then stands inside the first.

    Raises
    ------
    ValueError
        Where `ax` are not as many as there are panels.
    """
    rows, columns = picture.grid.shape
    with house_style():
        if ax is not None:
            if np.size(ax) != rows * columns:
                raise ValueError(f"ax: expected {rows * columns} axes, one for each panel; got {np.size(ax)}")
            places = np.array(ax, dtype=object).reshape(rows, columns)
            figure: Figure = places[0, 0].figure
        else:
            figure = new_figure(picture.height_in, picture.width_in)
            places = np.empty((rows, columns), dtype=object)
            grid = figure.add_gridspec(
                rows, columns, height_ratios=picture.height_ratios, width_ratios=picture.width_ratios
            )
            first: dict[int, Axes] = {}
            for row, column in np.ndindex(rows, columns):
                panel: Any = picture.grid[row, column]
                axes = figure.add_subplot(
                    grid[row, column], sharex=first.get(id(panel.x)), sharey=first.get(id(panel.y))
                )
                first.setdefault(id(panel.x), axes)
                first.setdefault(id(panel.y), axes)
                places[row, column] = axes
                axes.set_visible(panel.visible)
        for shown in picture.panels:
            _draw_panel(picture, shown, places[shown.place])
        entries = picture.legend()
        if ax is not None:
            places[0, 0].legend()
        elif entries:
            _legend(figure)
    return figure


def saved(picture: Picture, kinds: Iterable[str]) -> dict[str, bytes]:
    """A picture as files by their kind, pdf or png. Equal pictures give equal bytes."""
    figure = figure_of(picture)
    files = {}
    with house_style():
        # Laid out once for all kinds: it takes as long as drawing.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        for kind in kinds:
            buffer = io.BytesIO()
            varying = ("Software",) if kind == "png" else ("Creator", "Producer", "CreationDate")
            figure.savefig(buffer, format=kind, metadata=dict.fromkeys(varying), dpi=_PNG_DPI)
            files[kind] = buffer.getvalue()
    # An interrupt may be lost in compiled parts of matplotlib: then the files are not to be kept.
    interrupts.check()
    return files


def _legend(figure: Figure) -> None:
    """One legend below all panels, every entry once."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    longest = max(len(label) for label in handles)
    entry_in = _SAMPLE_IN + _LETTER_IN * longest
    fitting = max(1, int(figure.get_figwidth() / entry_in))
    figure.legend(
        list(handles.values()),
        list(handles),
        loc="outside lower center",
        borderaxespad=0.9,
        ncols=min(fitting, len(handles)),
    )


def _draw_panel(picture: Picture, panel: Panel, axes: Axes) -> None:
    """What a panel holds, on axes of matplotlib."""
    for which, axis in enumerate((panel.x, panel.y)):
        name = "xy"[which]
        if axis.kind in ("lin", "log"):
            getattr(axes, f"set_{name}scale")("linear" if axis.kind == "lin" else "log")
        else:
            getattr(axes, f"set_{name}scale")("symlog", linthresh=axis.kind)
        # Stated limits end any scaling by what is drawn.
        getattr(axes, f"set_{name}lim")(*axis.limits())
    for mark in panel.marks:
        _draw_mark(mark, axes)
    for which, axis in enumerate((panel.x, panel.y)):
        name = "xy"[which]
        label = drawable(panel.labels[which])
        getattr(axes, f"set_{name}label")(label, fontsize=panel.label_size[which])
        axes.grid(visible=panel.grid_lines[which], axis=name)  # type: ignore[arg-type]
        of_axis = axes.yaxis if which else axes.xaxis
        _number(of_axis, axis)
        of_axis.set_tick_params(labelsize=panel.tick_size[which])
        numbers: dict[str, Any] = {"labelleft" if which else "labelbottom": picture.numbered(panel, which)}
        of_axis.set_tick_params(**numbers)
    if panel.equal:
        axes.set_aspect("equal")
    if panel.title:
        look: dict[str, Any] = {"fontsize": panel.title_size}
        look["fontweight"] = "bold" if panel.title_bold else "normal"
        if panel.title_raised:
            look["pad"] = panel.title_raised
        axes.set_title(drawable(panel.title), **look)
    if panel.hertz:
        _hertz_axis(axes)
    if panel.decibel:
        _decibel_axis(axes)
    if panel.colour_bar:
        axes.minorticks_off()
        axes.yaxis.tick_right()


def _draw_mark(mark: Mark, axes: Axes) -> None:
    """One thing of a panel."""
    if isinstance(mark, Words):
        across = tuple("axes fraction" if share else "data" for share in (mark.across_x, mark.across_y))
        axes.annotate(
            drawable(mark.text),
            (mark.x, mark.y),
            xycoords=across,  # type: ignore[arg-type]
            xytext=mark.offset,
            textcoords="offset points",
            fontsize=mark.size,
            color=mark.color,
            ha=mark.horizontal,
            va=mark.vertical,
            annotation_clip=mark.clipped,
        )
        return
    if isinstance(mark, Arrow):
        arrow = {"arrowstyle": "-|>", "color": mark.color, "lw": 1.4, "mutation_scale": 14}
        axes.annotate("", xy=mark.tip, xytext=mark.start, arrowprops=arrow)
        return
    look: dict[str, Any] = {**mark.look}
    if mark.label:
        look["label"] = drawable(mark.label)
    if isinstance(mark, Curve):
        if mark.across:
            look["transform"] = axes.get_xaxis_transform()
        axes.plot(mark.x, mark.y, **look)
    elif isinstance(mark, Rule):
        (axes.axhline if mark.axis else axes.axvline)(mark.at, **look)
    elif isinstance(mark, Area):
        look = {**look}
        if mark.whole:
            parts = [Path(np.append(outline, outline[:1], axis=0), closed=True) for outline in mark.outlines]
            if parts:
                axes.add_patch(PathPatch(Path.make_compound_path(*parts), **look))
        else:
            axes.add_collection(PolyCollection(list(mark.outlines), **look))
    else:
        (axes.axhspan if mark.axis else axes.axvspan)(mark.low, mark.high, **look)


def _number(of_axis: MatplotlibAxis, axis: Axis) -> None:
    """The numbers of an axis: in plain text, as formulas take a third of a figure's time."""
    low, high = sorted(axis.limits())
    if axis.named is not None:
        places = [place for place, _ in axis.named]
        of_axis.set_major_locator(FixedLocator(places))
        of_axis.set_ticklabels([drawable(words) for _, words in axis.named])
    elif axis.every is not None:
        of_axis.set_major_locator(MultipleLocator(axis.every))
    elif axis.whole:
        of_axis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    elif axis.kind == "log":
        # Below two decades powers of ten alone would be one or two numbers.
        few = low > 0 and high / low < 60
        if few:
            subs = LogLocator(base=10, subs=(1.0, 2.0, 5.0))
            of_axis.set_major_locator(subs if high / low >= 5 else MaxNLocator(5))
        of_axis.set_major_formatter(
            FuncFormatter((lambda value, _: f"{value:g}") if few else (lambda value, _: power_of_ten(value)))
        )
        of_axis.set_minor_formatter(NullFormatter())
    elif axis.kind != "lin":
        of_axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))


@cache
def _in_the_font() -> frozenset[int]:
    return frozenset(get_font(findfont(FontProperties(family="DejaVu Sans"))).get_charmap())


def drawable(text: str) -> str:
    """A text in which characters that the font lacks are a box."""
    drawn = [letter if letter == "\n" or ord(letter) in _in_the_font() else "\u25a1" for letter in text]
    return "".join(drawn)


def _hertz_axis(axes: Axes) -> None:
    """A second frequency axis on top, in Hz, for axes whose x is in rad/s."""
    turn: Any = 2 * np.pi
    top = axes.secondary_xaxis("top", functions=(lambda omega: omega / turn, lambda hertz: hertz * turn))
    formatter = FuncFormatter(lambda value, _: power_of_ten(value))
    _second(top.xaxis, "frequency [Hz]").set_major_formatter(formatter)


def _decibel_axis(axes: Axes) -> None:
    """A second gain axis on the right, in dB, for axes whose y is an absolute gain on a log scale."""
    factor: Any = 1 / 20
    right = axes.secondary_yaxis("right", functions=(decibels, lambda level: 10 ** (level * factor)))
    # Levels are even where gains are logarithmic.
    right.set_yscale("linear")
    axis = _second(right.yaxis, "[dB]")
    axis.set_major_locator(MaxNLocator(MOST_DECIBELS, steps=DECIBEL_STEPS))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda level, _: number(level)))


def _second(axis: MatplotlibAxis, label: str) -> MatplotlibAxis:
    axis.set_minor_formatter(NullFormatter())
    axis.set_tick_params(labelsize=8.5, colors="#666666")
    axis.set_label_text(label, fontsize=8.5, color="#666666")
    return axis
