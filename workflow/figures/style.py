"""The house style: one colour per meaning, units on every axis, the same bytes every time.

Colours are from the Okabe-Ito palette (told apart with every common colour-vision deficiency) and every
meaning has a line style of its own as well, so a grey print still reads.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import pkgutil
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache, wraps
from typing import Any, Literal, TypeVar, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.ticker import (
    FixedLocator,
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    NullLocator,
)
from matplotlib.transforms import ScaledTranslation

from workflow.engine import interrupts
from workflow.figures.layout import POINT, Real, lay_out, titles
from workflow.figures.reading import draw_minor_ticks, marked

MEASURED = "#6b6b6b"  # what sensors said
MODEL = "#0072B2"  # identified model, open loop
UNCERTAIN = "#56B4E9"  # ellipses and the bands made of them
PREDICTED = "#009E73"  # controller, and the loop as computed from the model
ACHIEVED = "#D55E00"  # the loop as it ran on the machine
REFERENCE = "#111111"  # what was asked for
LIMIT = "#8B2E7F"  # specification and hard limits
HIGHLIGHT = "#E69F00"  # the one point the sentence below the picture speaks of
SHADE = {"estimation": "#0072B2", "validation": "#E69F00", "repeat": "#6b6b6b"}

MEASURED_LINE: dict[str, Any] = {"color": MEASURED, "lw": 0.9}
MODEL_LINE: dict[str, Any] = {"color": MODEL, "lw": 1.4}
PREDICTED_LINE: dict[str, Any] = {"color": PREDICTED, "lw": 1.5}
ACHIEVED_LINE: dict[str, Any] = {"color": ACHIEVED, "lw": 1.1}
REFERENCE_LINE: dict[str, Any] = {"color": REFERENCE, "lw": 1.0, "ls": (0, (4, 2))}
LIMIT_LINE: dict[str, Any] = {"color": LIMIT, "lw": 1.3, "ls": (0, (6, 2, 1.5, 2))}
REFERENCE_STEPS: dict[str, Any] = REFERENCE_LINE | {"drawstyle": "steps-post"}
BAND: dict[str, Any] = {"color": UNCERTAIN, "alpha": 0.42, "lw": 0}
ACHIEVED_BAND: dict[str, Any] = {"color": ACHIEVED, "alpha": 0.22, "lw": 0}
STAR: dict[str, Any] = {"ls": "none", "marker": "*", "mfc": HIGHLIGHT, "mec": "black"}

Drawing = Callable[..., Figure | None]
D = TypeVar("D", bound=Drawing)

WIDTH_IN = 10.0  # 100 px per inch at the width of the page
SVG_LIMIT_BYTES = 400_000  # above it the PNG is the smaller file
_PNG_DPI = 160  # 1600 pixels at `WIDTH_IN`: sharp on screens of high density

_RC: Any = {
    "font.family": ["DejaVu Sans"],  # ships with matplotlib: the same picture on every machine
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # `_raise_titles` knows what is in the way; looking for it measures all words again
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
    "path.simplify_threshold": 0.05,  # values are read off these lines
    "svg.fonttype": "none",  # text stays text: it is found, copied and read aloud
    "svg.hashsalt": "flexlink",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "axes.unicode_minus": True,
    "axes.formatter.use_mathtext": False,
    "text.parse_math": False,  # a dollar sign in a column name is a dollar sign
    "axes.formatter.limits": (-4, 4),
    "figure.constrained_layout.h_pad": 0.06,
    "figure.constrained_layout.w_pad": 0.06,
}


@dataclass(frozen=True)
class Picture:
    """A rendered figure: SVG text or PNG bytes.

    plot: what `reading.marked` says of it; files: the same figure in further kinds.
    """

    kind: Literal["svg", "png"]
    content: bytes
    plot: dict[str, Any] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)


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


def panels(
    height_in: float,
    rows: int = 1,
    columns: int = 1,
    *,
    width_in: float = WIDTH_IN,
    ax: Any = None,
    **options: Any,
) -> tuple[Figure, Any]:
    """An empty figure with its axes, as `Figure.subplots` gives them; or axes that the caller has, `ax`.

    Raises ValueError where these are not as many as there are panels.
    """
    if ax is not None:
        if np.size(ax) != rows * columns:
            raise ValueError(f"ax: expected {rows * columns} axes, one for each panel; got {np.size(ax)}")
        grid = np.array(ax, dtype=object).reshape(rows, columns)
        return grid[0, 0].figure, grid if options.get("squeeze") is False else grid.squeeze()[()]
    figure = new_figure(height_in, width_in)
    return figure, figure.subplots(rows, columns, **options)


def small_multiples(
    count: int, columns: int, row_in: float, rest_in: float, **options: Any
) -> tuple[Figure, list[Axes]]:
    """So many panels in rows of `columns`, each row `row_in` high; a place left over stays empty."""
    rows = -(-count // columns)
    figure, grid = panels(row_in * rows + rest_in, rows, columns, squeeze=False, **options)
    places = list(grid.ravel())
    for axes in places[count:]:
        axes.set_visible(False)
    return figure, places[:count]


def render(figure: Figure, also: Iterable[str] = ()) -> Picture:
    """SVG, or PNG where the SVG would be larger than 400 kB. Equal figures give equal bytes.

    also: further kinds of file, pdf or png.
    """
    with house_style():
        reaches = lay_out(figure)
        draw_minor_ticks(figure)
        plot = marked(figure, reaches)
        text = io.StringIO()
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        canvas: Any = FigureCanvasSVG(figure)
        canvas.print_svg(text, metadata=nothing)  # savefig would lay everything out once more
        FigureCanvasAgg(figure)
        # Where the font is not installed, others as wide stand in for it. Coordinates of paths to a hundredth
        # of a point: a third of the size goes, nothing a printer could show.
        svg = text.getvalue().encode().replace(b"'DejaVu Sans'", b"'DejaVu Sans', Verdana, sans-serif")
        svg = re.sub(rb'\b(d|x|y)="[^"]*"', lambda match: re.sub(rb"(\.\d\d)\d+", rb"\1", match.group()), svg)
        files = {kind: _saved(figure, kind) for kind in also}
        small = len(svg) <= SVG_LIMIT_BYTES
        png = b"" if small else files.get("png") or _saved(figure, "png")
        interrupts.check()  # compiled parts of matplotlib make anything of one
        return Picture("svg", svg, plot, files) if small else Picture("png", png, plot, files)


def _saved(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    dated = ("Software",) if kind == "png" else ("Creator", "Producer", "CreationDate")
    figure.savefig(buffer, format=kind, metadata=dict.fromkeys(dated), dpi=_PNG_DPI)
    return buffer.getvalue()


@cache
def _drawable() -> frozenset[int]:
    return frozenset(get_font(findfont(FontProperties(family="DejaVu Sans"))).get_charmap())


def plain(text: object, longest: int = 60) -> str:
    """Somebody else's text as matplotlib may safely draw it.

    Line breaks become blanks, characters the font lacks become a box, and
    a text longer than `longest` is cut with an ellipsis.
    """
    one_line = " ".join(str(text).split())
    if len(one_line) > longest:
        one_line = one_line[: longest - 1] + "\u2026"
    return "".join(letter if ord(letter) in _drawable() else "\u25a1" for letter in one_line)


def two_lines(name: object, unit: str) -> str:
    """Axis label `name`, `[unit]`; a unit nobody stated is said to be as logged, never guessed."""
    return f"{plain(name, 18)}\n[{plain(unit, 16) if unit else 'as logged'}]"


def ratio_unit(output_unit: str, input_unit: str) -> str:
    """Unit of a gain."""
    return f"{output_unit or '?'} / {input_unit or '?'}" if output_unit or input_unit else "as logged"


def finish(figure: Figure) -> None:
    """Last step of a figure: labels of log axes, and one legend below, every entry once."""
    _raise_titles(figure)
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        # In plain text: formula labels take a third of the time of a report, and over few decades 1, 2, 5, 10
        # read better than powers of ten.
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_scale() != "log" or isinstance(axis.get_major_locator(), FixedLocator):
                continue
            low, high = sorted(axis.get_view_interval())
            few = low > 0 and high / low < 60
            if few:
                subs = LogLocator(base=10, subs=(1.0, 2.0, 5.0))
                axis.set_major_locator(subs if high / low >= 5 else MaxNLocator(5))
            axis.set_major_formatter(FuncFormatter((lambda value, _: f"{value:g}") if few else _power_of_ten))
            axis.set_minor_formatter(NullFormatter())
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if not handles:
        return
    # Entries stand in columns of equal width: 0.08 in a letter at this size, 0.75 in for sample and gap.
    entry_in = 0.75 + 0.08 * max(len(label) for label in handles)
    fitting = max(1, int(figure.get_figwidth() / entry_in))
    figure.legend(
        list(handles.values()),
        list(handles),
        loc="outside lower center",
        borderaxespad=0.9,
        ncols=min(fitting, len(handles)),
    )


def finished(draw: D) -> D:
    """Decorator of what draws a figure: the house style around it, and `finish` once at its end; on axes of
    the caller's (`ax`) a legend inside the first."""

    @wraps(draw)
    def styled(*what: Any, **more: Any) -> Figure | None:
        with house_style():
            figure = draw(*what, **more)
            if more.get("ax") is not None:
                np.ravel(more["ax"])[0].legend()
            elif figure is not None and not figure.legends:
                finish(figure)
        return figure

    return cast(D, styled)


_DRAWINGS: dict[str, Drawing] = {}


def drawing(name: str) -> Callable[[D], D]:
    """Name of a drawing, by which a template asks for it: `figure("nyquist", run)`; it is `finished`.

    It takes typed results; None means there is nothing to draw.
    """

    def register(draw: D) -> D:
        if name in _DRAWINGS:
            raise ValueError(f"two drawings are called {name!r}")
        _DRAWINGS[name] = done = finished(draw)
        return done

    return register


@cache
def drawings() -> Mapping[str, Drawing]:
    """Every drawing of every module of this package, so that a new one is named in its own file only."""
    for module in pkgutil.iter_modules(importlib.import_module("workflow.figures").__path__):
        importlib.import_module(f"workflow.figures.{module.name}")
    return _DRAWINGS


_SECOND_AXIS_PT, _POWER_PT = 27.4, 12.0  # from the panel's edge to above ticks, numbers and words


def _raise_titles(figure: Figure) -> None:
    """Titles above a second frequency axis, or the power of ten of the y axis, where there is one."""
    for axes in figure.axes:
        for title in titles(axes):
            above = _SECOND_AXIS_PT if axes.child_axes else _POWER_PT if _has_power(axes.yaxis) else 0.0
            raised = axes.transAxes + ScaledTranslation(
                0, (above + mpl.rcParams["axes.titlepad"]) / POINT, figure.dpi_scale_trans
            )
            if raised.transform((0, 1))[1] > title.get_transform().transform((0, 1))[1]:
                title.set_transform(raised)


def _has_power(axis: Axis) -> bool:
    formatter = axis.get_major_formatter()
    formatter.set_locs(list(axis.get_majorticklocs()))
    return bool(formatter.get_offset()) and axis.get_offset_text().get_visible()


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _power_of_ten(value: float, _: int) -> str:
    if not value > 0:
        return ""
    if 0.999e-3 <= value <= 1.001e3:
        return f"{value:g}"
    return f"10{str(round(np.log10(value))).translate(_SUPERSCRIPT)}"


def tag_below(axes: Axes, x: float, text: str) -> None:
    """A dotted vertical line at data position x, with a small word at its foot, inside the axes."""
    axes.axvline(x, color="#888888", lw=0.8, ls=":")
    axes.annotate(
        plain(text, 20),
        (x, 0.02),
        xycoords=("data", "axes fraction"),
        xytext=(2, 1),
        textcoords="offset points",
        fontsize=8,
        color="#666666",
    )


def hertz_axis(axes: Axes) -> None:
    """A second frequency axis on top, in Hz, for axes whose x is in rad/s."""
    turn: Any = 2 * np.pi
    top = axes.secondary_xaxis("top", functions=(lambda omega: omega / turn, lambda hertz: hertz * turn))
    _second(top.xaxis, "frequency [Hz]").set_major_formatter(FuncFormatter(_power_of_ten))


def decibel_axis(axes: Axes) -> None:
    """A second gain axis on the right, in dB, for axes whose y is an absolute gain on a log scale."""
    factor: Any = 1 / 20
    right = axes.secondary_yaxis("right", functions=(decibels, lambda level: 10 ** (level * factor)))
    right.set_yscale("linear")  # levels are even where gains are logarithmic
    axis = _second(right.yaxis, "[dB]")
    axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 4, 10]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda level, _: f"{level:g}".replace("-", "\u2212")))


def decibels(gain: Any) -> Real:
    """20 log10 of gains above 0."""
    return np.asarray(20 * np.log10(np.maximum(gain, 1e-300)))


def _second(axis: Axis, label: str) -> Axis:
    axis.set_minor_formatter(NullFormatter())
    axis.set_tick_params(labelsize=8.5, colors="#666666")
    axis.set_label_text(label, fontsize=8.5, color="#666666")
    return axis


def pad_limits(low: float, high: float, share: float = 0.06) -> tuple[float, float]:
    """Axis limits with a margin; a constant signal gets room on both sides."""
    span = high - low
    if not span > 0:
        span = abs(high) or 1.0
    return low - share * span, high + share * span
