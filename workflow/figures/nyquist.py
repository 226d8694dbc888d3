"""Nyquist picture of the uncertain loop: ellipses of K G, the forbidden disc around -1, the nearest point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from control_design.plants.ellipses import nearest_distance
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior
from workflow.figures import style
from workflow.figures.bands import Complex, Real
from workflow.figures.subjects import RunView
from workflow.text.formats import at_least, share

_MOST_ELLIPSES = 220  # more fill the panel, and the file
_SEEN = 0.01  # of the panel's width: two pixels


@dataclass(frozen=True, eq=False)
class UncertainLoop:
    """Loop gain over its ellipses: L = K G with G in {centre + ...}; all (F,).

    outline (F, P): boundary points of each ellipse of L; distance (F,): exact distance of the filled ellipse
    from -1.
    """

    omega_rad_s: Real
    centre: Complex
    outline: Complex
    distance: Real

    @property
    def nearest(self) -> int:
        """Index of the ellipse that comes nearest to -1."""
        return int(np.argmin(self.distance))


def uncertain_loop(plant: FrequencyUncertainty, controller: Complex) -> UncertainLoop:
    """Ellipses of the plant multiplied by the controller's response (F,); frequency 0 is left out."""
    keep = plant.omega_rad_s > 0
    gain = np.asarray(controller, dtype=np.complex128)[keep]
    ellipse = plant.ellipse()
    centre = gain * plant.centre[keep]
    offset = gain[:, None] * ellipse.boundary(40)[keep]
    size = np.abs(gain)
    axis = ellipse.direction[keep] * np.where(size > 0, gain / np.where(size > 0, size, 1.0), 1.0)
    distance = nearest_distance(
        (-1.0 - centre) * np.conj(axis), size * ellipse.semi_major[keep], size * ellipse.semi_minor[keep]
    )
    return UncertainLoop(plant.omega_rad_s[keep], centre, centre[:, None] + offset, distance)


def loop_of(run: RunView) -> UncertainLoop:
    """The certified loop of a run, fine enough for what its controller does to the modes."""
    frequency, plant = run.control.spread.frequency, run.plant
    if isinstance(plant.uncertainty, ResponsePosterior):
        frequency = plant.uncertainty.at(run.loop_grid, plant.level)
    return uncertain_loop(frequency, run.controller.response(frequency.omega_rad_s))


@style.drawing("nyquist")
def draw_nyquist(run: RunView) -> Figure:
    """Whole curve of a run's loop (as far as it fits) and the surroundings of -1."""
    loop, margin = loop_of(run), run.specification.modulus_margin
    figure, (whole, near) = style.panels(6.0, 1, 2)
    size = np.abs(loop.centre)
    # Of the whole view: all that the loop does after it first falls below 1, no integrator.
    below = np.flatnonzero(size < 1)
    reach = float(np.clip(1.25 * (size[below[0] :] if below.size else size).max(), 1.8, 6.0))
    _draw_loop(whole, loop, (-reach, reach), (-reach, reach), run.level)
    _mark_forbidden(whole, margin)
    draw_around_minus_one(near, loop, level=run.level, modulus_margin=margin)
    whole.set_title(f"Loop K G: {style.plain(run.control.name, 34)}")
    slow = size > reach
    if slow.any():
        beyond = f"beyond the frame below {loop.omega_rad_s[slow].max():.3g} rad/s"
        words = beyond if slow[0] and not slow[-1] else "partly beyond the frame"
        box = {"facecolor": "white", "lw": 0, "alpha": 0.8, "pad": 1}
        whole.text(0.02, 0.02, words, transform=whole.transAxes, fontsize=8.5, color="#555555", bbox=box)
    return figure


def draw_around_minus_one(axes: Axes, loop: UncertainLoop, *, level: float, modulus_margin: float) -> None:
    """The surroundings of -1 on given axes: ellipses, the disc to keep out of, the nearest point."""
    nearest = loop.nearest
    closest = loop.distance[nearest]
    side = float(np.clip(1.35 * max(closest, modulus_margin, 0.35), 0.5, 1.3))
    _draw_loop(axes, loop, (-1 - side, -1 + 1.25 * side), (-1.12 * side, 1.12 * side), level)
    _mark_forbidden(axes, modulus_margin)
    touch = _nearest_point(loop.outline[nearest])
    label = f"nearest: {at_least(closest)} at {loop.omega_rad_s[nearest]:.4g} rad/s"
    axes.plot([-1, touch.real], [0, touch.imag], color=style.ACHIEVED, lw=1.2)
    axes.plot([touch.real], [touch.imag], marker="o", ms=6, color=style.ACHIEVED, ls="none", label=label)
    axes.set_title("Around -1")


def _mark_forbidden(axes: Axes, modulus_margin: float) -> None:
    disc = Circle((-1, 0), modulus_margin, fill=False, label="specification: keep out of here")
    disc.set(edgecolor=style.LIMIT, linewidth=1.3, linestyle=style.LIMIT_LINE["ls"])
    axes.add_patch(disc)
    axes.plot([-1], [0], marker="P", ms=8, color=style.REFERENCE, ls="none", label="-1")


def _draw_loop(
    axes: Axes, loop: UncertainLoop, real: tuple[float, float], imag: tuple[float, float], level: float
) -> None:
    edges = loop.outline
    inside = (
        (edges.real.max(axis=1) > real[0])
        & (edges.real.min(axis=1) < real[1])
        & (edges.imag.max(axis=1) > imag[0])
        & (edges.imag.min(axis=1) < imag[1])
    )
    index = np.flatnonzero(inside)
    if index.size > _MOST_ELLIPSES:
        index = index[np.linspace(0, index.size - 1, _MOST_ELLIPSES).round().astype(int)]
    index = np.union1d(index, [loop.nearest])
    polygons = np.stack([edges[index].real, edges[index].imag], axis=-1)
    look: Any = {"facecolors": style.UNCERTAIN, "edgecolors": style.MODEL, "linewidths": 0.4, "alpha": 0.2}
    # Ellipses thinner than a line cannot be seen: no entry of the legend. Enlarged they might seem to reach
    # into the disc.
    width = np.median(np.ptp(polygons, axis=1).max(axis=-1))
    label = f"{share(level)} ellipses" if width > _SEEN * (real[1] - real[0]) else "_ellipses"
    dense = polygons.shape[0] * polygons.shape[1] > 6000
    axes.add_collection(PolyCollection(list(polygons), **look, label=label, rasterized=dense))
    axes.plot(loop.centre.real, loop.centre.imag, **style.PREDICTED_LINE, label="loop at the centres")
    _arrow(axes, loop.centre, real, imag)
    axes.axhline(0, color="#999999", lw=0.7)
    axes.axvline(0, color="#999999", lw=0.7)
    axes.set(xlim=real, ylim=imag, aspect="equal")
    axes.set(xlabel="real part of K G [1]", ylabel="imaginary part of K G [1]")


def _arrow(axes: Axes, centre: Complex, real: tuple[float, float], imag: tuple[float, float]) -> None:
    """Direction of rising frequency, half-way along the longest visible run."""
    x, y = centre.real, centre.imag
    seen = (x > real[0]) & (x < real[1]) & (y > imag[0]) & (y < imag[1])
    steps = np.where(seen[:-1] & seen[1:], np.abs(np.diff(centre)), 0.0)
    if steps.sum() > 0:
        k = min(int(np.searchsorted(np.cumsum(steps), 0.35 * steps.sum())), centre.size - 2)
        look = {"arrowstyle": "-|>", "color": style.PREDICTED, "lw": 1.4, "mutation_scale": 14}
        axes.annotate("", xy=(x[k + 1], y[k + 1]), xytext=(x[k], y[k]), arrowprops=look)


def _nearest_point(boundary: Complex) -> complex:
    """Point of a polygonal outline nearest to -1."""
    a, b = boundary, np.roll(boundary, -1)
    edge = b - a
    length = np.abs(edge) ** 2
    points = a + np.clip(((-1 - a) * np.conj(edge)).real / np.where(length > 0, length, 1.0), 0, 1) * edge
    return complex(points[np.argmin(np.abs(points + 1))])
