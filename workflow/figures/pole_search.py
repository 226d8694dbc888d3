"""How the poles were found: the error surface over frequency and damping of one pair, and how many poles."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from contourpy import contour_generator

from ident.search.error_surface import ErrorSurface, error_surface
from ident.search.order_selection import OrderStep
from ident.search.pole_search import SearchStage
from ident.stabilisation import Stabilisation
from ident.uncertainty import FrequencyUncertainty
from workflow.figures import style
from workflow.figures.bands import Real
from workflow.figures.description import Panel, Picture, new_picture
from workflow.figures.subjects import ChannelView

# Points that a search tried.
_DOTS: dict[str, Any] = {"ls": "none", "marker": ".", "ms": 5, "color": "white", "mec": "black", "mew": 0.3}
# Colours of the error surface from its floor upwards: cividis of matplotlib, reversed, at nine even steps
# (Nunez, Anderton and Renslow, PLoS ONE 13(7), 2018: even in lightness for every colour vision).
_CIVIDIS = np.array([
    (254, 232, 56), (221, 200, 88), (187, 173, 109), (154, 147, 118), (124, 123, 120), (96, 100, 111),
    (66, 78, 108), (24, 55, 111), (0, 34, 78),
])  # fmt: skip
# Label of the axis of both pictures.
_PAIR_AXIS = "frequency of the pair [rad/s]"
# Minima beside the model's.
_HOLLOW: dict[str, Any] = {
    "ls": "none",
    "marker": "v",
    "ms": 8,
    "mfc": "none",
    "mec": style.HIGHLIGHT,
    "mew": 1.6,
}


@style.drawing("error-surface")
def draw_error_surface(channel: ChannelView) -> Picture | None:
    """The surface of the slowest lightly damped pair, on a grid around it; nothing without a pair."""
    if channel.shown_pair is None:
        return None
    surface = _surface(channel, channel.shown_pair)
    searched = searched_pairs(channel.found.identification.search.stages, surface.pole[0])
    return draw_surface(surface, searched, style.plain(channel.name, 34))


def draw_surface(surface: ErrorSurface, searched: Real | None = None, name: str = "") -> Picture:
    """Residual RMS over that of the smallest grid point: contours, and the floor along the first coordinate.

    Parameters
    ----------
    surface : ErrorSurface
        Over two coordinates of a pole pair.
    searched : (E, 2) array, optional
        Points that a search tried; those inside the picture are drawn.
    name : str
        Of the channel, for the title.
    """
    first = surface.first
    second = surface.second
    ratio = np.sqrt(surface.mean_square.T / surface.mean_square.min())
    picture, (left, bar, right) = new_picture(4.9, 1, 3, width_ratios=[1.75, 0.06, 1.0])

    # Contours, up to what all but a hundredth of the grid stays below.
    top = max(float(np.percentile(ratio, 99)), 1.0001)
    levels = np.geomspace(1.0, top, 22)
    shades = np.clip(ratio, 1.0, top)
    # In logarithms a contour is straight between neighbours of the grid.
    fill_levels(left, first, second, np.log(shades), np.log(levels))
    bar.set(yscale="log")
    colour_bar(bar, levels)

    # Points of the search, further minima, and the pair of the model.
    low = [first[0], second[0]]
    high = [first[-1], second[-1]]
    if searched is not None:
        is_inside = np.all((searched >= low) & (searched <= high), axis=1)
        seen = searched[is_inside]
        if seen.size:
            left.plot(seen[:, 0], seen[:, 1], **_DOTS, label=f"{seen.shape[0]} points the search tried")
    further_minima = []
    for i, j in surface.local_minima():
        is_inside_first = 0 < i < surface.first.size - 1
        is_inside_second = 0 < j < surface.second.size - 1
        is_inside_grid = is_inside_first and is_inside_second
        # The pair's own minimum is no grid point.
        frequency_ratio = surface.first[i] / surface.pole[0]
        is_another = abs(np.log(frequency_ratio)) > 0.2
        if is_inside_grid and is_another:
            further_minima.append((i, j))
    if further_minima:
        # More of them would hide the surface.
        i, j = np.array(further_minima[:8]).T
        left.plot(first[i], second[j], **_HOLLOW, label="other local minima")
    polar = surface.names == ("omega_rad_s", "zeta")
    if polar:
        words = "{:.4g} rad/s, damping {:.3g}".format(*surface.pole)
        scale: Any = "log"
        labels = (_PAIR_AXIS, "damping ratio of the pair [1]")
        title = "Along frequency, best damping"
    else:
        words = "beta {:.6g}, gamma {:.6g}".format(*surface.pole)
        scale = "lin"
        labels = surface.names
        title = "Along beta, best gamma"
    star = style.STAR | {"ms": 15, "mew": 0.8}
    left.plot(surface.pole[:1], surface.pole[1:], **star, label=f"found: {words}")
    left.set(xscale=scale, yscale=scale, xlim=(first[0], first[-1]), ylim=(second[0], second[-1]))
    left.set(xlabel=labels[0], ylabel=labels[1])
    left.set_title(f"Error surface: {name}" if name else "Error surface")
    bar.y.named = [(level, f"{level:.3g}") for level in levels[::7]]

    # Right: the lowest point over the second coordinate.
    right.plot(first, ratio.min(axis=0), **style.MODEL_LINE)
    right.axvline(surface.pole[0], color=style.HIGHLIGHT, lw=1.4)
    right.set(xscale=scale, yscale="log", xlim=(first[0], first[-1]))
    right.set(xlabel=labels[0], ylabel="residual RMS / smallest [1]", title=title)
    return picture


def fill_levels(panel: Panel, x: Real, y: Real, values: Real, levels: Real) -> None:
    """Areas between neighbouring levels (L,) of values (Y, X) over a grid x (X,), y (Y,), in the colours of
    their numbers."""
    contours: Any = contour_generator(x, y, values, fill_type="ChunkCombinedOffset")
    # A value at the end of all levels is in one of them.
    least = 1e-9 * (levels[-1] - levels[0])
    for number, (low, high) in enumerate(pairwise(levels)):
        (points,), (ends,) = contours.filled(low - least, high + least)
        if points is not None:
            colour = _shade(number / (levels.size - 2))
            panel.fill(np.split(points, ends[1:-1]), whole=True, color=colour, lw=0.3)


def colour_bar(panel: Panel, levels: Real) -> None:
    """The colours between neighbouring levels (L,), below each other on a narrow panel."""
    panel.set(xlim=(0.0, 1.0), ylim=(float(levels[0]), float(levels[-1])))
    panel.x.named = []
    panel.grid_lines = [False, False]
    panel.colour_bar = True
    for number, (low, high) in enumerate(pairwise(levels)):
        panel.bars(0.5, high, 1.0, begins=low, color=_shade(number / (levels.size - 2)), lw=0.3)


def _shade(share: float) -> str:
    """The colour of a share of the surface's height: 0 its floor, 1 its top."""
    place = share * (len(_CIVIDIS) - 1)
    steps = np.arange(len(_CIVIDIS))
    channels = [round(float(np.interp(place, steps, column))) for column in _CIVIDIS.T]
    return "#" + "".join(f"{value:02x}" for value in channels)


def _surface(channel: ChannelView, pair: int) -> ErrorSurface:
    """The error over frequency and damping of a pole pair, the others as they are, three octaves around it.

    As far as the records tell such a frequency: a period in the longest one, and below Nyquist.
    """
    identification = channel.found.identification
    poles = identification.model.poles
    dt_s = identification.model.dt_s
    omega = float(poles.omega_rad_s(dt_s)[pair])
    zeta = float(poles.zeta()[pair])
    # Three octaves to each side, as far as records and sampling tell a frequency; the pair stays inside.
    slowest_told = 2 * np.pi / channel.found.longest_s
    fastest_told = 0.95 * np.pi / dt_s
    low = min(max(omega / 8, slowest_told), 0.8 * omega)
    high = max(min(8 * omega, fastest_told), 1.02 * omega)
    wide = np.geomspace(low, high, 30)
    # The valley of a lightly damped pair is as narrow as its damping: even steps would jump over it.
    dampings_away = np.sinh(np.linspace(-3.0, 3.0, 21))
    near = omega * np.exp(zeta * dampings_away)
    is_between = (near > low) & (near < high)
    frequencies = np.concatenate([wide, near[is_between]])
    least_zeta = min(1e-3, zeta / 3)
    largest_zeta = max(0.7, min(0.97, 1.1 * zeta))
    return error_surface(
        channel.found.used,
        identification.model,
        identification.structure,
        pair=pair,
        first=np.unique(frequencies),
        second=np.geomspace(least_zeta, largest_zeta, 24),
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
                best = int(np.argmin(stage.log_cost))
                away = abs(float(np.log(points[best, 0] / omega_rad_s)))
                nearest = min(nearest, (away, points), key=lambda entry: entry[0])
    return nearest[1]


# Below this a difference of the criterion is drawn linearly, above logarithmically: a factor exp(5) = 150 in
# posterior odds is where "better" begins to mean something.
_LINEAR = 10.0


@style.drawing("order")
def draw_order(channel: ChannelView) -> Picture | None:
    """Left: criterion of every structure tried, above the best. Right: pole pairs of fits with 0, 1, 2 ...

    The response straight from the records stands faintly behind the right panel: modes belong on its peaks.
    Nothing where no other structure was tried.
    """
    plot = channel.found.stabilisation
    steps = channel.found.identification.order_table
    if plot is None or not steps:
        return None
    picture, (left, right) = new_picture(4.6, 1, 2, width_ratios=[1.0, 1.7])
    _criterion(left, steps, (plot.n_real, plot.chosen))
    left.set_title(f"Criterion: {style.plain(channel.name, 16)}")
    _stabilisation(right, plot, channel.spread.empirical)
    return picture


def _criterion(panel: Panel, steps: Sequence[OrderStep], chosen: tuple[int, int]) -> None:
    """Draw the criterion of every structure above the best one.

    chosen: real poles and pairs of the model, whose mark is a star.
    """
    order = np.array([step.order for step in steps])
    above = np.array([step.criterion for step in steps])
    above -= above.min()
    panel.plot(
        order, above, ls="none", marker="o", ms=5, mfc="white", mec=style.MODEL, label="structure tried"
    )
    lowest = np.unique(order)
    least_above = [np.min(above, where=order == n, initial=np.inf) for n in lowest]
    panel.plot(lowest, least_above, color=style.MODEL, lw=1.0)
    mine = [k for k, step in enumerate(steps) if (step.n_real, step.n_pairs) == chosen]
    if mine:
        label = f"the model: {chosen[0]} real, {chosen[1]} pairs"
        star = style.STAR | {"ms": 14, "mew": 0.7}
        panel.plot(order[mine], above[mine], **star, label=label)
    panel.set(yscale=_LINEAR)
    # The scale is linear up to `_LINEAR`: as much again is shown where all orders lie below.
    highest = max(2.5 * above.max(), 1.5 * _LINEAR)
    panel.set(ylim=(-0.15 * _LINEAR, highest))
    panel.set(xlim=(order.min() - 0.6, order.max() + 0.6))
    panel.x.whole = True
    panel.set(xlabel="searched poles [1]", ylabel="criterion above the best [1]")


def _stabilisation(panel: Panel, plot: Stabilisation, response: FrequencyUncertainty | None) -> None:
    """Draw the pole pairs of fits with 0, 1, 2 ... pairs by whether they stay from one fit to the next."""
    omega = plot.omega_rad_s
    count = plot.n_pairs
    stable = plot.stable
    same = plot.previous >= 0
    panel.set(xscale="log")
    if response is not None:
        # The gain behind the marks, on a log scale of its own that nobody has to read.
        gain = np.abs(response.centre)
        is_positive = gain > 0
        seen = response.omega_rad_s[is_positive]
        log = np.log(gain[is_positive])
        low = np.percentile(log, 1)
        high = log.max()
        height = np.clip((log - low) / max(high - low, 1e-12), 0.0, 1.0)
        panel.plot(
            seen,
            0.03 + 0.94 * height,
            across=True,
            color=style.MEASURED,
            lw=0.8,
            alpha=0.4,
            label="gain from the records (own log scale)",
        )
        panel.set(xlim=(seen[0], seen[-1]))
    for mode in plot.columns():
        panel.axvline(mode.omega_rad_s, color=style.PREDICTED, lw=0.9, alpha=0.5)
    kinds = (
        (stable & plot.needed, "o", style.PREDICTED, style.PREDICTED, 6.5, "stable and significant"),
        (stable & ~plot.needed, "o", "white", style.MEASURED, 5.5, "stable, not significant"),
        (same & ~stable, "^", "white", style.HIGHLIGHT, 5.5, "same frequency, other damping"),
        (~same & plot.needed, "D", "white", style.PREDICTED, 5.0, "new, significant"),
        (~same & ~plot.needed, "x", style.MEASURED, style.MEASURED, 5.0, "new, not significant"),
    )
    for here, marker, face, edge, size, label in kinds:
        if here.any():
            panel.plot(
                omega[here], count[here], ls="none", marker=marker, ms=size, mfc=face, mec=edge, label=label
            )
    panel.axhline(plot.chosen, color=style.HIGHLIGHT, lw=5, alpha=0.35, label="number of pairs in the model")
    most_pairs = max(plot.rss.size - 1, 1)
    panel.set(ylim=(-0.4, most_pairs + 0.6))
    panel.y.whole = True
    if response is None and omega.size:
        panel.set(xlim=(omega.min() / 1.5, omega.max() * 1.5))
    panel.set_title("Stabilisation: which modes stay")
    panel.set(xlabel=_PAIR_AXIS, ylabel="pole pairs in the fit [1]")
