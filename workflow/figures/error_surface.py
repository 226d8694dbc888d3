"""The error surface of the pole search over frequency and damping of one pole pair."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure

from ident.search.error_surface import ErrorSurface, error_surface
from ident.search.search_trace import SearchStage
from workflow.figures import style
from workflow.figures.bands import Real
from workflow.figures.subjects import ChannelView

_DOTS: dict[str, Any] = {"ls": "none", "marker": ".", "ms": 5, "color": "white", "mec": "black", "mew": 0.3}
_PAIR_AXIS = "frequency of the pair [rad/s]"
_HOLLOW: dict[str, Any] = {
    "ls": "none",
    "marker": "v",
    "ms": 8,
    "mfc": "none",
    "mec": style.HIGHLIGHT,
    "mew": 1.6,
}


@style.drawing("error-surface")
def draw_error_surface(channel: ChannelView) -> Figure | None:
    """The surface of the slowest lightly damped pair, on a grid around it; nothing without a pair.

    Residual RMS over that of the smallest grid point: contours on log axes, and the floor along frequency.
    """
    if channel.shown_pair is None:
        return None
    surface = _surface(channel, channel.shown_pair)
    omega, zeta = surface.first, surface.second
    ratio = np.sqrt(surface.mean_square.T / surface.mean_square.min())
    figure, (left, right) = style.panels(4.9, 1, 2, width_ratios=[1.75, 1.0])
    top = max(float(np.percentile(ratio, 99)), 1.0001)
    levels = np.geomspace(1.0, top, 22)
    shades = np.clip(ratio, 1.0, top)
    filled = left.contourf(omega, zeta, shades, levels=levels, cmap="cividis_r", norm="log")
    searched = searched_pairs(channel.found.identification.search.stages, surface.pole[0])
    low, high = [omega[0], zeta[0]], [omega[-1], zeta[-1]]
    seen = searched[np.all((searched >= low) & (searched <= high), axis=1)]
    if seen.size:
        left.plot(seen[:, 0], seen[:, 1], **_DOTS, label=f"{seen.shape[0]} points the search tried")
    others = [(i, j) for i, j in surface.local_minima() if _is_another(surface, i, j)]
    if others:
        i, j = np.array(others[:8]).T
        left.plot(omega[i], zeta[j], **_HOLLOW, label="other local minima")
    label = f"found: {surface.pole[0]:.4g} rad/s, damping {surface.pole[1]:.3g}"
    left.plot(surface.pole[:1], surface.pole[1:], **style.STAR | {"ms": 15, "mew": 0.8}, label=label)
    left.set(xscale="log", yscale="log", xlim=(omega[0], omega[-1]), ylim=(zeta[0], zeta[-1]))
    left.set(xlabel=_PAIR_AXIS, ylabel="damping ratio of the pair [1]")
    left.set_title(f"Error surface: {style.plain(channel.name, 34)}")
    _round_ticks(figure.colorbar(filled, ax=left, pad=0.01, aspect=30), levels)
    right.plot(omega, ratio.min(axis=0), **style.MODEL_LINE)
    right.axvline(surface.pole[0], color=style.HIGHLIGHT, lw=1.4)
    right.set(xscale="log", yscale="log", xlim=(omega[0], omega[-1]))
    right.set(xlabel=_PAIR_AXIS, ylabel="residual RMS / smallest [1]")
    right.set_title("Along frequency, best damping")
    return figure


def _surface(channel: ChannelView, pair: int) -> ErrorSurface:
    found = channel.found.identification
    poles, dt_s = found.model.poles, found.model.dt_s
    omega, zeta = float(poles.omega_rad_s(dt_s)[pair]), float(poles.zeta()[pair])
    low = min(max(omega / 8, 2 * np.pi / channel.found.longest_s), 0.8 * omega)
    high = max(min(8 * omega, 0.95 * np.pi / dt_s), 1.02 * omega)
    wide = np.geomspace(low, high, 30)
    # The valley of a lightly damped pair is as narrow as its damping: even steps would jump over it.
    near = omega * np.exp(zeta * np.sinh(np.linspace(-3.0, 3.0, 21)))
    return error_surface(
        channel.found.used,
        found.model,
        found.structure,
        pair=pair,
        first=np.unique(np.concatenate([wide, near[(near > low) & (near < high)]])),
        second=np.geomspace(min(1e-3, zeta / 3), max(0.7, min(0.97, 1.1 * zeta)), 24),
    )


def searched_pairs(stages: Sequence[SearchStage], omega_rad_s: float) -> Real:
    """Points (E, 2) of the global search whose best point lies nearest to a frequency.

    Empty where no search was made in frequency and damping.
    """
    nearest: tuple[float, Real] = (np.inf, np.zeros((0, 2)))
    for stage in stages:
        for column, name in enumerate(stage.coordinate_names):
            if name.startswith("log10(omega"):
                points = 10.0 ** stage.points[:, [column, column + 1]]
                best = points[int(np.argmin(stage.log_cost)), 0]
                away = abs(float(np.log(best / omega_rad_s)))
                nearest = min(nearest, (away, points), key=lambda entry: entry[0])
    return nearest[1]


def _is_another(surface: ErrorSurface, i: int, j: int) -> bool:
    """Whether a grid minimum lies inside the picture and is not the pair's own (which is no grid point)."""
    inside = 0 < i < surface.first.size - 1 and 0 < j < surface.second.size - 1
    return bool(inside and abs(np.log(surface.first[i] / surface.pole[0])) > 0.2)


def _round_ticks(bar: Colorbar, levels: Real) -> None:
    """Round values at least a fifteenth of the bar apart: its own log ticks run into each other."""
    ticks: list[float] = []
    step = np.log(levels[-1] / levels[0]) / 15
    for value in (1, 1.02, 1.05, 1.1, 1.2, 1.5, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000):
        if value <= levels[-1] and (not ticks or np.log(value / ticks[-1]) > step):
            ticks.append(value)
    if len(ticks) < 3:
        ticks = [float(f"{value:.4g}") for value in np.linspace(levels[0], levels[-1], 5)]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
