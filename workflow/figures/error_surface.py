"""The error surface of the pole search over frequency and damping of one pole pair."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure

from ident.search.error_surface import ErrorSurface, error_surface
from ident.search.search_trace import SearchStage
from workflow.figures import style
from workflow.figures.bands import Real
from workflow.figures.registry import drawing
from workflow.figures.subjects import ChannelView


@drawing("error-surface")
def draw_channel(channel: ChannelView) -> Figure | None:
    """The surface of the slowest lightly damped pair, on a grid around it; nothing without a pair."""
    pair = channel.shown_pair
    if pair is None:
        return None
    found = channel.found.identification
    poles, dt_s = found.model.poles, found.model.dt_s
    omega, zeta = float(poles.omega_rad_s(dt_s)[pair]), float(poles.zeta()[pair])
    longest_s = max(record.n_samples for record in channel.found.used) * dt_s
    low = min(max(omega / 8, 2 * np.pi / longest_s), 0.8 * omega)
    high = max(min(8 * omega, 0.95 * np.pi / dt_s), 1.02 * omega)
    wide = np.geomspace(low, high, 30)
    # The valley of a lightly damped pair is as narrow as its damping: even steps would jump over it.
    near = omega * np.exp(zeta * np.sinh(np.linspace(-3.0, 3.0, 21)))
    surface = error_surface(
        channel.found.used,
        found.model,
        found.structure,
        pair=pair,
        first=np.unique(np.concatenate([wide, near[(near > low) & (near < high)]])),
        second=np.geomspace(min(1e-3, zeta / 3), max(0.7, min(0.97, 1.1 * zeta)), 24),
    )
    return draw_error_surface(surface, searched_pairs(found.search.stages, omega), name=channel.name)


def draw_error_surface(surface: ErrorSurface, searched: Real, *, name: str) -> Figure:
    """Residual RMS over that of the smallest grid point: contours on log axes, and the floor along frequency.

    `surface` is over (omega, zeta); searched (E, 2) are points in these coordinates that a search tried.
    Raises ValueError for a surface in other coordinates.
    """
    if surface.names != ("omega_rad_s", "zeta"):
        raise ValueError(f"need a surface over omega_rad_s and zeta; got {surface.names}")
    omega, zeta = surface.first, surface.second
    ratio = np.sqrt(surface.mean_square.T / surface.mean_square.min())
    with style.house_style():
        figure = style.new_figure(4.9)
        left, right = figure.subplots(1, 2, width_ratios=[1.75, 1.0])
        top = max(float(np.percentile(ratio, 99)), 1.0001)
        levels = np.geomspace(1.0, top, 22)
        filled = left.contourf(
            omega, zeta, np.clip(ratio, 1.0, top), levels=levels, cmap="cividis_r", norm="log"
        )
        left.set_xscale("log")
        left.set_yscale("log")
        seen = searched[_inside(searched[:, 0], omega) & _inside(searched[:, 1], zeta)]
        if seen.size:
            dots = {"ls": "none", "marker": ".", "ms": 5, "color": "white", "mec": "black", "mew": 0.3}
            left.plot(seen[:, 0], seen[:, 1], **dots, label=f"{seen.shape[0]} points the search tried")
        others = [(i, j) for i, j in surface.local_minima() if _is_another(surface, i, j)]
        if others:
            i, j = np.array(others[:8]).T
            hollow = {"ls": "none", "marker": "v", "ms": 8, "mfc": "none", "mec": style.HIGHLIGHT, "mew": 1.6}
            left.plot(omega[i], zeta[j], **hollow, label="other local minima")
        star = {"marker": "*", "ms": 15, "mfc": style.HIGHLIGHT, "mec": "black", "mew": 0.8, "ls": "none"}
        label = f"found: {surface.pole[0]:.4g} rad/s, damping {surface.pole[1]:.3g}"
        left.plot([surface.pole[0]], [surface.pole[1]], **star, label=label)
        left.set_xlim(omega[0], omega[-1])
        left.set_ylim(zeta[0], zeta[-1])
        left.set_xlabel("frequency of the pair [rad/s]")
        left.set_ylabel("damping ratio of the pair [1]")
        left.set_title(f"Error surface: {style.plain(name, 34)}")
        _round_ticks(figure.colorbar(filled, ax=left, pad=0.01, aspect=30), levels)
        right.plot(omega, ratio.min(axis=0), **style.MODEL_LINE)
        right.axvline(surface.pole[0], color=style.HIGHLIGHT, lw=1.4)
        right.set_xscale("log")
        right.set_yscale("log")
        right.set_xlim(omega[0], omega[-1])
        right.set_title("Along frequency, best damping")
        right.set_xlabel("frequency of the pair [rad/s]")
        right.set_ylabel("residual RMS / smallest [1]")
        style.finish(figure, left, columns=4)
    return figure


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
                if away < nearest[0]:
                    nearest = (away, points)
    return nearest[1]


def _inside(values: Real, axis: Real) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return np.asarray((values >= axis[0]) & (values <= axis[-1]))


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
