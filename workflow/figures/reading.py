"""What a page's script needs to read values off a picture: names of its artists, scales of its axes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib import rcParams
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import TICKDOWN, TICKLEFT, TICKUP
from matplotlib.text import Annotation

from workflow.figures.layout import POINT, every_axis, within


def marked(figure: Figure, reaches: list[tuple[float, float]]) -> dict[str, Any]:
    """Name the artists of a figure that is laid out, in place, and describe it in units of its SVG, y down.
    reaches: from where to where each panel reaches with its words, in pixels.

    Names (the SVG's ids): `aN` of the N-th axes; `kE-M` of data under the legend's entry E, `d-M` of other
    data, `t-M` and `u-M` of words at a place in the data, of the latter only x is. Returned: `axes`, a list
    of box, scales, names and which others share its x or y; `cuts`, where columns of panels may be parted;
    `height` above the legend; `legend`, the entries' words.
    """
    width, height = figure.get_size_inches() * POINT
    renderer: Any = figure._get_renderer()  # type: ignore[attr-defined]
    words = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    entries = {word: place for place, word in enumerate(words)}
    looks: dict[tuple[Any, ...], int | None] = {}
    every: list[Any] = [one for axes in figure.axes for one in (axes, *axes.child_axes)]
    shown = [axes for axes in every if axes.get_visible()]
    for axes in filter(shown.__contains__, figure.axes):
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            looks.setdefault(_look(handle), entries.get(str(label)))
    parents = {child: axes for axes in figure.axes for child in axes.child_axes}
    number, described = 0, []
    for place, axes in enumerate(shown):
        axes.set_gid(f"a{place}")
        for artist in (*axes.lines, *axes.collections, *axes.patches, *axes.images, *axes.texts):
            if str(artist.get_gid()).endswith("tick_minor"):
                continue
            number += 1
            kind = f"{_place_of(artist, axes)}-" if artist in axes.texts else "d-"
            if kind == "d-":
                entry = entries.get(str(artist.get_label()), looks.get(_look(artist)))
                kind = "d-" if entry is None else f"k{entry}-"
            artist.set_gid(f"{kind}{number}")
        parent = parents.get(axes, axes)  # of a second frequency axis, which has no place of its own
        left, bottom, right, top = parent.get_position().extents
        box = [left * width, (1 - top) * height, right * width, (1 - bottom) * height]
        described.append(
            {
                "box": [round(float(value), 2) for value in box],
                "near": axes.get_aspect() != "auto",  # a plane: values belong to points, not to an x
                # A second axis has a scale of functions, of the same kind as its parent's.
                "x": _scale(axes.xaxis, parent.get_xscale()),
                "y": _scale(axes.yaxis, axes.get_yscale()),
                "second": parent is not axes,
                "names": [_name(axes, "x"), _name(axes, "y")],
                "with": [
                    min(map(shown.index, filter(shown.__contains__, group.get_siblings(parent))))
                    for group in (parent.get_shared_x_axes(), parent.get_shared_y_axes())
                ],
            }
        )
    # A colour bar stays with what is left of it.
    bars = [hasattr(axes, "_colorbar") for axes in figure.axes if axes.get_visible()]
    columns = sorted(
        (0.0 if bar else low / figure.dpi * POINT, high / figure.dpi * POINT)
        for bar, (low, high) in zip(bars, reaches, strict=True)
    )
    above = [legend.get_window_extent(renderer).y1 / figure.dpi * POINT for legend in figure.legends]
    return {
        "axes": described,
        "cuts": list(_cuts(columns)),
        "height": round(float(height - max(above, default=0.0)), 1),
        "width": round(float(width), 1),
        "legend": words,
    }


def draw_minor_ticks(figure: Figure) -> None:
    """Those of an axis as markers of one line: as ticks they would take a quarter of the drawing's time."""
    for axis in every_axis(axes for axes in figure.axes if axes.get_visible()):
        places = np.asarray(axis.get_minorticklocs(), dtype=np.float64)
        if not places.size or not axis.get_visible():
            continue
        places = places[within(axis, places)]
        axes: Any = axis.axes
        x = axis is axes.xaxis
        edge = np.full(places.size, 0.0 if axes in axes.figure.axes else 1.0)  # a second axis stands on top
        marker: Any = TICKLEFT if not x else TICKDOWN if axes in axes.figure.axes else TICKUP
        line = Line2D(
            *((places, edge) if x else (edge, places)),
            transform=axes.get_xaxis_transform("grid") if x else axes.get_yaxis_transform("grid"),
            marker=marker,
            markersize=rcParams["xtick.minor.size"],
            markeredgewidth=rcParams["xtick.minor.width"],
            color=rcParams["xtick.color"],
            linestyle="none",
            clip_on=False,
            zorder=0.5,
            gid=f"{'xy'[not x]}tick_minor",
        )
        axes.add_artist(line)


def _look(artist: Artist) -> tuple[Any, ...]:
    """What an artist looks like: in this house the same thing looks the same in every panel."""
    if isinstance(artist, Line2D):
        dashes: Any = artist._dash_pattern  # type: ignore[attr-defined]
        return (
            "line",
            to_hex(artist.get_color()),
            str(dashes),
            str(artist.get_marker()),
            str(artist.get_markerfacecolor()),
        )
    faces: Any = getattr(artist, "get_facecolor", lambda: ())()
    return "area", str(faces)


def _place_of(text: Artist, axes: Axes) -> str:
    where = text.xycoords if isinstance(text, Annotation) else text.get_transform()
    if where == "data" or where == axes.transData:
        return "t"
    return "u" if isinstance(where, tuple) and where[0] == "data" else "w"


def _scale(axis: Axis, kind: str) -> list[Any]:
    """Limits, and the kind of scale: lin, log, or the range in which a symmetric log scale is linear."""
    low, high = (float(f"{value:.7g}") for value in axis.get_view_interval())
    linear: Any = getattr(axis.get_transform(), "linthresh", None)
    return [low, high, linear or ("log" if kind == "log" else "lin")]


def _name(axes: Axes, which: str) -> str:
    """Words of an axis, from the one it is shared with where it has none of its own."""
    group = getattr(axes, f"get_shared_{which}_axes")()
    labels = (getattr(other, f"get_{which}label")() for other in (axes, *group.get_siblings(axes)))
    return " ".join(next(filter(None, labels), "").split())


def _cuts(columns: list[tuple[float, float]]) -> Iterator[float]:
    """Where no panel lies; columns: from and to of each, ascending."""
    reach = columns[0][1] if columns else 0.0
    for low, high in columns[1:]:
        if low > reach:
            yield round((low + reach) / 2, 1)
        reach = max(reach, high)
