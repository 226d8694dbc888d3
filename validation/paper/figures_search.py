"""Fig. 1 redrawn: the error surface with its minima, cuts along beta, and where DIRECT ends."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, MaxNLocator, MultipleLocator

from validation.paper.surface import VARIANTS, MinimaCount, SearchShares, SurfaceStudy, slices
from workflow.figures import style

# Cuts of the surface: the border of the paper's window, and close to the circle.
CUTS = (0.9988, 0.9998)
_CUT_LINES: tuple[dict[str, Any], ...] = (
    {"color": style.MODEL, "lw": 1.4},
    {"color": style.LIMIT, "lw": 1.4, "ls": (0, (4, 2))},
)


@style.finished
def draw_surface(study: SurfaceStudy) -> Figure:
    """Above: surface and cuts. Below: minima against the grid, and shares of DIRECT's searches at order 4."""
    figure = style.new_figure(8.6)
    grid = figure.add_gridspec(4, 3, height_ratios=[0.5, 0.7, 0.6, 0.6], width_ratios=[1.1, 0.05, 1.0])
    left, bar = figure.add_subplot(grid[:2, 0]), figure.add_subplot(grid[:2, 1])
    close, whole = figure.add_subplot(grid[0, 2]), figure.add_subplot(grid[1, 2])
    counts, shares = figure.add_subplot(grid[2:, :2]), figure.add_subplot(grid[2:, 2])
    _surface(left, bar, study)
    _cuts(close, whole, study)
    _counts(counts, study.counts)
    _shares(shares, study.shares)
    return figure


def _surface(axes: Axes, beside: Axes, study: SurfaceStudy) -> None:
    surface = study.surface
    # Levels of equal area: on an even scale the side valleys, a few per cent deep, would not show.
    levels = np.unique(np.quantile(surface.mean_square, np.linspace(0, 1, 25)))
    mesh = axes.pcolormesh(
        surface.first,
        surface.second,
        surface.mean_square.T,
        norm=BoundaryNorm(levels, 256),
        cmap=colormaps["cividis_r"],
        shading="nearest",
        rasterized=True,
    )
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
            axes.plot(surface.first[i], surface.second[j], ls="none", clip_on=False, **marker, label=words)
    axes.set(xlabel="beta [1]", ylabel="gamma [1]", title="Error surface J, colours of equal area")
    axes.xaxis.set_major_locator(MultipleLocator(0.005))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%.3f"))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%.4f"))
    axes.grid(visible=False)
    ticks = levels[:: max(levels.size // 6, 1)].tolist()
    bar = Colorbar(beside, mesh, ticks=ticks)
    bar.ax.yaxis.set_major_formatter(FormatStrFormatter("%.5f"))
    bar.set_label("J [output²]")


def _cuts(close: Axes, whole: Axes, study: SurfaceStudy) -> None:
    top = float(study.surface.mean_square.max())
    for (gamma, values), line in zip(slices(study.surface, CUTS), _CUT_LINES, strict=True):
        for axes in (close, whole):
            axes.plot(study.surface.first, values, **line, label=f"cut at gamma = {gamma:.4f}")
    for axes in (close, whole):
        axes.set(xlim=(study.surface.first[0], study.surface.first[-1]), ylabel="J [output²]")
        axes.xaxis.set_major_locator(MultipleLocator(0.005))
        axes.xaxis.set_major_formatter(FormatStrFormatter("%.3f"))
    close.set(ylim=(0.92 * top, 1.01 * top), title="Cuts along beta: top, and whole")
    close.tick_params(labelbottom=False)
    whole.set(ylim=(0, 1.05 * top), xlabel="beta [1]")


def _counts(axes: Axes, counts: tuple[MinimaCount, ...]) -> None:
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
        axes.bar(place + offset, values, width=0.36, color=colour, label=label)
        for x, value in zip(place + offset, values, strict=True):
            axes.text(x, value + 0.3, f"{value}", ha="center", fontsize=8, color="#333333")
    axes.set_xticks(place, [f"{count.n_points}" for count in counts])
    axes.set(xlabel="grid points per axis [1]", ylabel="number [1]", title="Minima counted, by grid")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(visible=False, axis="x")


def _shares(axes: Axes, shares: SearchShares) -> None:
    """Two bars per variant: the paper's raw box and our logarithmic coordinates."""
    place = np.arange(len(VARIANTS))[::-1]
    for offset, coordinates, colour, words in (
        (0.2, "raw", style.ACHIEVED, "search in (x, beta, gamma)"),
        (-0.2, "log", style.MODEL, "search in log decay, frequency, damping"),
    ):
        percent = [100 * shares.hits["order 4", coordinates, name] / shares.searches for name in VARIANTS]
        axes.barh(place + offset, percent, height=0.36, color=colour, label=words)
        for y, value in zip(place + offset, percent, strict=True):
            axes.text(value + 1.5, y, f"{value:.0f}", va="center", fontsize=7.5, color="#333333")
    axes.set_yticks(place, [name.removeprefix("GN_") for name in VARIANTS], fontsize=7.5)
    axes.set(xlim=(0, 112), xticks=[0, 20, 40, 60, 80, 100], title="DIRECT at order 4 (plant of Fig. 2)")
    axes.set_xlabel("searches ending in the global minimum [%]")
    axes.grid(visible=False, axis="y")
