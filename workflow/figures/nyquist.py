"""Nyquist and Nichols pictures of an uncertain loop K G: its ellipses, the disc around -1 to keep out of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import control
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MultipleLocator

from control_design.plants.ellipses import nearest_distance
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior
from workflow.figures import style
from workflow.figures.bands import Complex, Real, times, unwrapped_degrees
from workflow.figures.subjects import RunView
from workflow.text.formats import at_least, share

_MOST_ELLIPSES = 220  # more fill the panel, and the file
_LOWEST_DB = -30.0  # below it a loop does nothing, and its phase takes all the width


def loop_of(run: RunView) -> FrequencyUncertainty:
    """The certified loop of a run, fine enough for what its controller does to the modes."""
    frequency, plant = run.control.spread.frequency, run.plant
    if isinstance(plant.uncertainty, ResponsePosterior):
        frequency = plant.uncertainty.at(run.loop_grid, plant.level)
    return times(frequency, run.controller.response(frequency.omega_rad_s))


@style.drawing("nyquist")
def draw_run(run: RunView) -> Figure:
    """Nyquist curve of a run's loop, as far as it fits, beside its Nichols chart."""
    loop, (figure, (whole, chart)) = loop_of(run), style.panels(6.2, 1, 2)
    draw_nyquist(whole, loop, run.specification.modulus_margin)
    draw_nichols(chart, loop)
    return figure


@style.finished
def draw_alone(draw: Callable[..., None], loop: FrequencyUncertainty, *, ax: Any = None) -> Figure:
    """A Nyquist curve or a Nichols chart, as `draw` has it, on a figure of its own or on given axes."""
    figure, axes = style.panels(6.2, ax=ax)
    draw(axes, loop)
    return figure


def draw_nyquist(
    axes: Axes, loop: FrequencyUncertainty, modulus_margin: float = 0.0, *, near: bool = False
) -> None:
    """Ellipses of a loop as far as they fit, or near -1; the disc to keep out of and the nearest point where
    a modulus margin is asked for."""
    centre, ellipse = loop.centre, loop.ellipse()
    edges, size = centre[:, None] + ellipse.boundary(40), np.abs(centre)
    distance = nearest_distance(
        (-1.0 - centre) * np.conj(ellipse.direction), ellipse.semi_major, ellipse.semi_minor
    )
    nearest = int(np.argmin(distance))
    # Of the whole view: all that the loop does after it first falls below 1, no integrator.
    below = np.flatnonzero(size < 1)
    reach = float(np.clip(1.25 * (size[below[0] :] if below.size else size).max(), 1.8, 6.0))
    real = imag = (-reach, reach)
    if near:
        side = float(np.clip(1.35 * max(distance[nearest], modulus_margin, 0.35), 0.5, 1.3))
        real, imag = (-1 - side, -1 + 1.25 * side), (-1.12 * side, 1.12 * side)
    low, high = np.array([real, imag]).T
    both = np.stack([edges.real, edges.imag], axis=-1)
    inside = np.all((both.max(axis=1) > low) & (both.min(axis=1) < high), axis=1)
    axes.set(xlim=real, ylim=imag, aspect="equal")
    axes.set(xlabel="real part of K G [1]", ylabel="imaginary part of K G [1]")
    # The last one is always drawn.
    _fill(axes, both[np.append(np.flatnonzero(inside), nearest)], loop.level)
    axes.plot(centre.real, centre.imag, **style.PREDICTED_LINE, label="loop at the centres")
    _arrow(axes, centre, real, imag)
    axes.axhline(0, color="#999999", lw=0.7)
    axes.axvline(0, color="#999999", lw=0.7)
    axes.plot([-1], [0], marker="P", ms=8, color=style.REFERENCE, ls="none", label="-1")
    if modulus_margin:
        disc = Circle((-1, 0), modulus_margin, fill=False, label="specification: keep out of here")
        disc.set(edgecolor=style.LIMIT, linewidth=1.3, linestyle=style.LIMIT_LINE["ls"])
        axes.add_patch(disc)
        touch = edges[nearest, np.argmin(np.abs(edges[nearest] + 1))]
        label = f"nearest: {at_least(distance[nearest])} at {loop.omega_rad_s[nearest]:.4g} rad/s"
        axes.plot([-1, touch.real], [0, touch.imag], color=style.ACHIEVED, lw=1.2)
        axes.plot([touch.real], [touch.imag], marker="o", ms=6, color=style.ACHIEVED, ls="none", label=label)
    beyond = " K G" if size.max() < reach else " K G (partly beyond the frame)"
    axes.set_title(f"Loop{' around -1' if near else beyond}")


def draw_nichols(axes: Axes, loop: FrequencyUncertainty) -> None:
    """Gain over phase of a loop with its ellipses, on the Nichols chart of python-control."""
    phase, level = unwrapped_degrees(loop.centre), style.decibels(np.abs(loop.centre))
    edges, shown = loop.centre[:, None] + loop.ellipse().boundary(40), level > _LOWEST_DB
    turned = phase[:, None] + np.degrees(
        np.angle(edges / np.where(loop.centre == 0, 1.0, loop.centre)[:, None])
    )
    axes.plot(phase, level, **style.PREDICTED_LINE, label="loop at the centres")
    axes.plot([-180], [0], marker="P", ms=8, color=style.REFERENCE, ls="none", label="-1")
    ends = np.append(phase[shown], [-360.0, 0.0])
    view: Any = {"xlim": (ends.min(), ends.max()), "ylim": (_LOWEST_DB, max(float(level.max()), 12.0))}
    axes.set(**view)
    _fill(axes, np.stack([turned, style.decibels(np.abs(edges))], axis=-1)[shown], loop.level)
    *_, gains, phases = control.nichols_grid(ax=axes)
    for text in (*gains, *phases):
        x, y = text.get_position()
        inside = view["xlim"][0] < x < view["xlim"][1] and _LOWEST_DB < y < view["ylim"][1]
        text.set(color="#666666", fontsize=8, visible=inside)
    axes.grid(visible=False)
    axes.set(**view, xlabel="phase of K G [deg]", ylabel="gain of K G [dB]")
    axes.xaxis.set_major_locator(MultipleLocator(90))
    axes.set_title("Nichols chart (dotted: closed loop)")


def _fill(axes: Axes, polygons: Real, level: float) -> None:
    """Outlines (F, P, 2) of ellipses, as many as fill a panel; those too thin to be seen stay unnamed.
    Enlarged they might seem to reach into the disc."""
    if not len(polygons):
        return
    polygons = polygons[
        np.linspace(0, len(polygons) - 1, min(len(polygons), _MOST_ELLIPSES)).round().astype(int)
    ]
    look: Any = {"facecolors": style.UNCERTAIN, "edgecolors": style.MODEL, "linewidths": 0.4, "alpha": 0.2}
    # Two pixels are a hundredth of a panel's width.
    wide = np.median(np.ptp(polygons, axis=1)[:, 0]) > 0.01 * np.ptp(axes.get_xlim())
    dense = polygons.shape[0] * polygons.shape[1] > 6000
    label = f"{share(level)} ellipses" if wide else "_ellipses"
    axes.add_collection(PolyCollection(list(polygons), **look, label=label, rasterized=dense))


def _arrow(axes: Axes, centre: Complex, real: tuple[float, float], imag: tuple[float, float]) -> None:
    """Direction of rising frequency, half-way along the longest visible run."""
    x, y = centre.real, centre.imag
    seen = (x > real[0]) & (x < real[1]) & (y > imag[0]) & (y < imag[1])
    length = np.cumsum(np.where(seen[:-1] & seen[1:], np.abs(np.diff(centre)), 0.0))
    if length.size and length[-1] > 0:
        k = min(int(np.searchsorted(length, 0.35 * length[-1])), centre.size - 2)
        look = {"arrowstyle": "-|>", "color": style.PREDICTED, "lw": 1.4, "mutation_scale": 14}
        axes.annotate("", xy=(x[k + 1], y[k + 1]), xytext=(x[k], y[k]), arrowprops=look)
