"""The error surface of the pole search over frequency and damping of one pole pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ident.options import IdentOptions
from ident.pole_search import PoleSearch
from ident.poles import Poles
from ident.regression import Regression
from ident.search_trace import SearchStage
from workflow.figures import style
from workflow.figures.bands import Real


@dataclass(frozen=True, eq=False)
class ErrorSurface:
    """Error over (omega, zeta) of one pair, everything else held at the optimum.

    omega_rad_s (W,), zeta (Z,) ascending; cost (Z, W): root mean square of the residual over that at the
    optimum. searched (E, 2): frequency and damping the search asked for, in its order; best: those of the
    result. frozen: what was held, in words.
    """

    omega_rad_s: Real
    zeta: Real
    cost: Real
    searched: Real
    best: tuple[float, float]
    frozen: str = "the other poles held at the optimum"


def draw_error_surface(surface: ErrorSurface, *, name: str) -> Figure:
    """Filled contours of the residual's root mean square relative to the optimum, on log axes."""
    with style.house_style():
        figure = style.new_figure(4.9)
        left, right = figure.subplots(1, 2, width_ratios=[1.75, 1.0])
        cost = np.maximum(surface.cost, 1e-300)
        top = float(np.nanpercentile(cost, 99))
        levels = np.geomspace(min(float(np.nanmin(cost)), 1.0), max(top, 1.0 * (1 + 1e-6)), 22)
        filled = left.contourf(
            surface.omega_rad_s,
            surface.zeta,
            np.minimum(cost, levels[-1]),
            levels=levels,
            cmap="cividis_r",
            norm="log",
        )
        left.set_xscale("log")
        left.set_yscale("log")
        if surface.searched.size:
            left.plot(
                surface.searched[:, 0],
                surface.searched[:, 1],
                ls="none",
                marker=".",
                ms=5,
                color="white",
                mec="black",
                mew=0.3,
                label=f"points the search tried ({surface.searched.shape[0]})",
            )
        left.plot(
            [surface.best[0]],
            [surface.best[1]],
            marker="*",
            ms=15,
            mfc=style.HIGHLIGHT,
            mec="black",
            mew=0.8,
            ls="none",
            label=f"minimum: {surface.best[0]:.4g} rad/s, damping {surface.best[1]:.3g}",
        )
        left.set_xlim(surface.omega_rad_s[0], surface.omega_rad_s[-1])
        left.set_ylim(surface.zeta[0], surface.zeta[-1])
        left.set_xlabel("frequency of the pair [rad/s]")
        left.set_ylabel("damping ratio of the pair [1]")
        left.set_title(f"Error surface: {style.plain(name, 34)}")
        bar = figure.colorbar(filled, ax=left, pad=0.01, aspect=30)

        # Round values at least a fifteenth of the bar apart: its own log ticks run into each other.
        ticks: list[float] = []
        step = np.log(levels[-1] / levels[0]) / 15
        for value in (1, 1.02, 1.05, 1.1, 1.2, 1.5, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000):
            if levels[0] <= value <= levels[-1] and (not ticks or np.log(value / ticks[-1]) > step):
                ticks.append(value)
        bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
        bar.ax.minorticks_off()
        lowest = np.nanmin(cost, axis=0)
        right.plot(surface.omega_rad_s, lowest, **style.MODEL_LINE, label="best over damping")
        right.axvline(surface.best[0], color=style.HIGHLIGHT, lw=1.4)
        right.set_xscale("log")
        right.set_yscale("log")
        right.set_xlim(surface.omega_rad_s[0], surface.omega_rad_s[-1])
        right.set_title("Along frequency, best damping")
        right.set_xlabel("frequency of the pair [rad/s]")
        right.set_ylabel("residual RMS / its minimum [1]")
        style.finish(figure, (left, right), columns=4)
    return figure


def surface_of_pair(
    data: Regression,
    options: IdentOptions,
    found: Poles,
    index: int,
    rss: float,
    stages: Sequence[SearchStage],
    *,
    size: tuple[int, int] = (64, 28),
) -> ErrorSurface:
    """Error over frequency and damping of pair `index` of `found`, the other poles held, coefficients
    re-fitted.

    `rss` is the residual sum of squares of the whole identification, `stages` its global searches: the points
    of the one that looked at pairs last before this pair was found are shown, as far as they lie in the
    picture.
    """
    kept = Poles(found.real, np.delete(found.pairs, index))
    log_options = options.model_copy(update={"coordinates": "log"})
    search = PoleSearch(data, log_options)
    space = search.space(0, 1)
    cost = search.candidate_cost(space, kept, kept)
    first, second = np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1])
    logs = np.array([[cost(np.array([x, y])) for x in first] for y in second])
    omega = 10.0 ** (space.low[1] + (space.high[1] - space.low[1]) * first) / data.dt_s
    zeta = 10.0 ** (space.low[2] + (space.high[2] - space.low[2]) * second)
    best = float(found.omega_rad_s(data.dt_s)[index]), float(found.zeta()[index])
    others = found.order - 2
    return ErrorSurface(
        omega_rad_s=omega,
        zeta=zeta,
        cost=np.sqrt(np.exp(logs - np.log(rss))),
        searched=_searched_pairs(stages, best[0]),
        best=best,
        frozen="no other poles" if others == 0 else f"the other {others} poles held where they were found",
    )


def _searched_pairs(stages: Sequence[SearchStage], omega_rad_s: float) -> Real:
    """Points (E, 2) of the global search whose best point lies nearest in frequency; empty without one in log
    coordinates."""
    nearest: tuple[float, Real] = (np.inf, np.zeros((0, 2)))
    for stage in stages:
        columns = [i for i, name in enumerate(stage.coordinate_names) if name.startswith("log10(omega")]
        for column in columns:
            points = 10.0 ** stage.points[:, [column, column + 1]]
            away = abs(float(np.log(points[int(np.argmin(stage.log_cost)), 0] / omega_rad_s)))
            if away < nearest[0]:
                nearest = (away, points)
    return nearest[1]
