"""Fig. 1 redrawn: the error surface with its minima, cuts along beta, and where DIRECT ends."""

from __future__ import annotations

from typing import Any

import numpy as np

from validation.paper.surface import VARIANTS, MinimaCount, SearchShares, SurfaceStudy, slices
from workflow.figures import style
from workflow.figures.description import Panel, Picture, X, Y, new_picture
from workflow.figures.pole_search import colour_bar, fill_levels

# Cuts of the surface: the border of the paper's window, and close to the circle.
CUTS = (0.9988, 0.9998)
# Looks of cuts through the surface.
_CUT_LINES: tuple[dict[str, Any], ...] = (
    {"color": style.MODEL, "lw": 1.4},
    {"color": style.LIMIT, "lw": 1.4, "ls": (0, (4, 2))},
)


def draw_surface(study: SurfaceStudy) -> Picture:
    """Above: surface and cuts. Below: minima against the grid, and shares of DIRECT's searches at order 4."""
    picture, grid = new_picture(
        9.6, 3, 3, squeeze=False, height_ratios=[0.8, 0.8, 1.0], width_ratios=[1.1, 0.05, 1.0]
    )
    (left, bar, close), (empty, no_bar, whole), (counts, nothing, shares) = grid
    for panel in (empty, no_bar, nothing):
        panel.visible = False
    _surface(left, bar, study)
    _cuts(close, whole, study)
    _counts(counts, study.counts)
    _shares(shares, study.shares)
    return picture


def _surface(panel: Panel, bar: Panel, study: SurfaceStudy) -> None:
    surface = study.surface
    # Levels of equal area: on an even scale the side valleys, a few per cent deep, would not show.
    levels = np.unique(np.quantile(surface.mean_square, np.linspace(0, 1, 25)))
    fill_levels(panel, surface.first, surface.second, surface.mean_square.T, levels)
    # Of levels of equal area the bar, too, gives each the same height.
    colour_bar(bar, np.arange(levels.size, dtype=np.float64))
    bar.y.named = [(k, f"{levels[k]:.5f}") for k in range(0, levels.size, max(levels.size // 6, 1))]
    bar.set_title("J [output²]", size=9.0, bold=False)
    minima = surface.local_minima()
    last = surface.first.size - 1, surface.second.size - 1
    inside = [(i, j) for i, j in minima if 0 < i < last[0] and 0 < j < last[1]]
    border = [point for point in minima if point not in inside]
    marks: tuple[tuple[list[tuple[int, int]], str, dict[str, Any]], ...] = (
        (
            border,
            "border points lower than their neighbours",
            {"marker": "v", "ms": 7, "mfc": "white", "mec": "black"},
        ),
        (inside, "minima inside", {"marker": "*", "ms": 15, "mfc": style.HIGHLIGHT, "mec": "black"}),
    )
    for points, label, marker in marks:
        if points:
            i, j = np.array(points).T
            words = f"{label}: {len(points)}"
            panel.plot(surface.first[i], surface.second[j], ls="none", **marker, label=words)
    panel.set(xlabel="beta [1]", ylabel="gamma [1]", title="Error surface J, colours of equal area")
    panel.x.every = 0.005
    panel.grid_lines = [False, False]


def _cuts(close: Panel, whole: Panel, study: SurfaceStudy) -> None:
    top = float(study.surface.mean_square.max())
    for (gamma, values), line in zip(slices(study.surface, CUTS), _CUT_LINES, strict=True):
        for panel in (close, whole):
            panel.plot(study.surface.first, values, **line, label=f"cut at gamma = {gamma:.4f}")
    for panel in (close, whole):
        panel.set(xlim=(study.surface.first[0], study.surface.first[-1]), ylabel="J [output²]")
        panel.x.every = 0.005
    close.set(ylim=(0.92 * top, 1.01 * top), title="Cuts along beta: top, and whole")
    whole.set(ylim=(0, 1.05 * top), xlabel="beta [1]")


def _counts(panel: Panel, counts: tuple[MinimaCount, ...]) -> None:
    """Draw how many minima grids of several sizes show."""
    place = np.arange(len(counts))
    for offset, values, colour, label in (
        (-0.2, [count.inside for count in counts], style.HIGHLIGHT, "grid minima inside the window"),
        (
            0.2,
            [count.border for count in counts],
            style.MEASURED,
            "border points lower than their neighbours",
        ),
    ):
        panel.bars(place + offset, values, 0.36, color=colour, label=label)
        for x, value in zip(place + offset, values, strict=True):
            panel.words(f"{value}", x, value, offset=(0.0, 2.0), horizontal="center", color="#333333")
    panel.x.named = [(k, f"{count.n_points}") for k, count in enumerate(counts)]
    panel.set(xlabel="grid points per axis [1]", ylabel="number [1]", title="Minima counted, by grid")
    panel.y.whole = True
    panel.set(ylim=(0.0, None))
    panel.grid_lines[X] = False


def _shares(panel: Panel, shares: SearchShares) -> None:
    """Two bars per variant: the paper's raw box and our logarithmic coordinates."""
    place = np.arange(len(VARIANTS))[::-1]
    for offset, coordinates, colour, words in (
        (0.2, "raw", style.ACHIEVED, "search in (x, beta, gamma)"),
        (-0.2, "log", style.MODEL, "search in log decay, frequency, damping"),
    ):
        percent = [100 * shares.hits["order 4", coordinates, name] / shares.searches for name in VARIANTS]
        panel.bars(place + offset, percent, 0.36, lying=True, color=colour, label=words)
        for y, value in zip(place + offset, percent, strict=True):
            words = f"{value:.0f}"
            panel.words(words, value, y, offset=(3.0, 0.0), vertical="center", size=7.5, color="#333333")
    panel.y.named = [(at, name.removeprefix("GN_")) for at, name in zip(place, VARIANTS, strict=True)]
    panel.tick_size[Y] = 7.5
    panel.x.every = 20.0
    panel.set(xlim=(0, 112), title="DIRECT at order 4 (plant of Fig. 2)")
    panel.set(xlabel="searches ending in the global minimum [%]")
    panel.grid_lines[Y] = False
