"""Nyquist and Nichols pictures of an uncertain loop K G: its ellipses, the disc around -1 to keep out of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from control_design.plants.ellipses import nearest_distance
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior
from workflow.figures import style
from workflow.figures.bands import Complex, Real, times, unwrapped_degrees
from workflow.figures.description import Panel, Picture, new_picture
from workflow.figures.subjects import RunView
from workflow.text.formats import at_least, share

# Ellipses at most: more fill the panel, and the file.
_MOST_ELLIPSES = 220
# Closed-loop gains and phases whose lines a Nichols chart has: those of `control.nichols_grid`.
_GRID_GAINS_DB = np.array([-40.0, -20.0, -12.0, -6.0, -3.0, -1.0, -0.5, 0.0, 0.25, 0.5, 1.0, 3.0, 6.0, 12.0])
# Closed-loop phases of its lines.
_GRID_PHASES_DEG = np.array([-359.75, -315.0, -270.0, -225.0, -180.0, -135.0, -90.0, -45.0, -0.25])
# Gain where the Nichols chart ends: below it a loop does nothing, and its phase takes all the width.
_LOWEST_DB = -30.0


def loop_of(run: RunView) -> FrequencyUncertainty:
    """The certified loop of a run, fine enough for what its controller does to the modes."""
    frequency = run.control.spread.frequency
    plant = run.plant
    if isinstance(plant.uncertainty, ResponsePosterior):
        frequency = plant.uncertainty.at(run.loop_grid, plant.level)
    return times(frequency, run.controller.response(frequency.omega_rad_s))


@style.drawing("nyquist")
def draw_run(run: RunView) -> Picture:
    """Nyquist curve of a run's loop, as far as it fits, beside its Nichols chart."""
    loop = loop_of(run)
    picture, (whole, chart) = new_picture(6.2, 1, 2)
    draw_nyquist(whole, loop, run.specification.modulus_margin)
    draw_nichols(chart, loop)
    return picture


def draw_alone(draw: Callable[..., None], loop: FrequencyUncertainty) -> Picture:
    """A Nyquist curve or a Nichols chart, as `draw` has it, on a picture of its own."""
    picture, panel = new_picture(6.2)
    draw(panel, loop)
    return picture


def draw_nyquist(
    panel: Panel, loop: FrequencyUncertainty, modulus_margin: float = 0.0, *, near: bool = False
) -> None:
    """Draw the Nyquist curve of a loop with its ellipses.

    Parameters
    ----------
    panel : Panel
    loop : FrequencyUncertainty
        Ellipses of K G.
    modulus_margin : float
        Radius of the disc around -1 to keep out of, drawn with the nearest point; 0: none is asked for.
    near : bool
        Around -1; else as far as the curve fits.
    """
    centre = loop.centre
    ellipse = loop.ellipse()
    edges = centre[:, None] + ellipse.boundary(40)
    size = np.abs(centre)
    # -1 as it lies in the axes of each ellipse.
    critical_point = (-1.0 - centre) * np.conj(ellipse.direction)
    distance = nearest_distance(critical_point, ellipse.semi_major, ellipse.semi_minor)
    nearest = int(np.argmin(distance))

    # The whole view holds all that the loop does after it first falls below 1, but no integrator.
    below = np.flatnonzero(size < 1)
    shown_size = size[below[0] :] if below.size else size
    reach = float(np.clip(1.25 * shown_size.max(), 1.8, 6.0))
    real = imag = (-reach, reach)
    if near:
        # What comes nearest to -1 fills most of the view, whichever of the three is largest.
        widest = max(distance[nearest], modulus_margin, 0.35)
        side = float(np.clip(1.35 * widest, 0.5, 1.3))
        # More to the right, towards the origin.
        real = (-1 - side, -1 + 1.25 * side)
        imag = (-1.12 * side, 1.12 * side)

    # Ellipses that are in view at least in part.
    low, high = np.array([real, imag]).T
    corners = np.stack([edges.real, edges.imag], axis=-1)
    begins_before_end = corners.min(axis=1) < high
    ends_after_begin = corners.max(axis=1) > low
    inside = np.all(ends_after_begin & begins_before_end, axis=1)
    panel.set(xlim=real, ylim=imag, equal=True)
    panel.set(xlabel="real part of K G [1]", ylabel="imaginary part of K G [1]")
    # The one nearest to -1 is always drawn, on top.
    _fill(panel, corners[np.append(np.flatnonzero(inside), nearest)], loop.level)
    panel.plot(centre.real, centre.imag, **style.PREDICTED_LINE, label="loop at the centres")
    _arrow(panel, centre, real, imag)
    panel.axhline(0, color="#999999", lw=0.7)
    panel.axvline(0, color="#999999", lw=0.7)
    panel.plot([-1], [0], marker="P", ms=8, color=style.REFERENCE, ls="none", label="-1")
    if modulus_margin:
        label = "specification: keep out of here"
        panel.circle((-1.0, 0.0), modulus_margin, **style.LIMIT_LINE, label=label)
        touching = np.argmin(np.abs(edges[nearest] + 1))
        touch = edges[nearest, touching]
        label = f"nearest: {at_least(distance[nearest])} at {loop.omega_rad_s[nearest]:.4g} rad/s"
        panel.plot([-1, touch.real], [0, touch.imag], color=style.ACHIEVED, lw=1.2)
        panel.plot([touch.real], [touch.imag], marker="o", ms=6, color=style.ACHIEVED, ls="none", label=label)
    reach_in_words = " K G" if size.max() < reach else " K G (partly beyond the frame)"
    panel.set_title(f"Loop{' around -1' if near else reach_in_words}")


def draw_nichols(panel: Panel, loop: FrequencyUncertainty) -> None:
    """Gain over phase of a loop with its ellipses, on the Nichols chart of python-control."""
    phase = unwrapped_degrees(loop.centre)
    level = style.decibels(np.abs(loop.centre))
    edges = loop.centre[:, None] + loop.ellipse().boundary(40)
    shown = level > _LOWEST_DB
    # The edge's phase is taken from its centre's: that one is unwrapped.
    centre = np.where(loop.centre == 0, 1.0, loop.centre)
    beside_centre = np.angle(edges / centre[:, None])
    turned = phase[:, None] + np.degrees(beside_centre)
    panel.plot(phase, level, **style.PREDICTED_LINE, label="loop at the centres")
    panel.plot([-180], [0], marker="P", ms=8, color=style.REFERENCE, ls="none", label="-1")
    # A whole turn is in view at least, with -1 in its middle.
    ends = np.append(phase[shown], [-360.0, 0.0])
    highest = max(float(level.max()), 12.0)
    view: Any = {"xlim": (ends.min(), ends.max()), "ylim": (_LOWEST_DB, highest)}
    panel.set(**view)
    outlines = np.stack([turned, style.decibels(np.abs(edges))], axis=-1)
    _fill(panel, outlines[shown], loop.level)
    _closed_loop_grid(panel)
    panel.grid_lines = [False, False]
    panel.set(**view, xlabel="phase of K G [deg]", ylabel="gain of K G [dB]")
    panel.x.every = 90.0
    panel.set_title("Nichols chart (dotted: closed loop)")


def _closed_loop_grid(panel: Panel) -> None:
    """Draw lines of constant closed-loop gain and phase in every turn that is seen.

    They are those of `control.nichols_grid`: the closed loop is T = L / (1 + L), so L = T / (1 - T).
    """
    left, right = panel.x.limits()
    low, high = panel.y.limits()
    look: dict[str, Any] = {"color": "#d3d3d3", "ls": ":", "lw": 1.5, "zorder": 0}
    turn = np.radians(np.linspace(_GRID_PHASES_DEG[0], _GRID_PHASES_DEG[-1], 361))
    gains_dB = np.linspace(_GRID_GAINS_DB[0], _GRID_GAINS_DB[-1], 361)
    gains = 10 ** (gains_dB / 20)
    lines = [(f"{gain:g} dB", 10 ** (gain / 20) * np.exp(1j * turn), -1) for gain in _GRID_GAINS_DB]
    lines += [
        (f"{round(phase)}\N{DEGREE SIGN}", gains * np.exp(1j * np.radians(phase)), 0)
        for phase in _GRID_PHASES_DEG
    ]
    # The pattern repeats with every turn of the phase.
    first_turn = np.floor(left / 360) + 1
    last_turn = np.ceil(right / 360)
    for shift in 360.0 * np.arange(first_turn, last_turn + 1):
        for words, closed, named in lines:
            open_loop = closed / (1 - closed)
            phase = -np.mod(-np.degrees(np.angle(open_loop)), 360.0) + shift
            level = style.decibels(np.abs(open_loop))
            panel.plot(phase, level, **look)
            if left < phase[named] < right and low < level[named] < high:
                side = "right" if phase[named] > shift - 175 else "left"
                panel.words(words, phase[named], level[named], horizontal=side)


def _fill(panel: Panel, polygons: Real, level: float) -> None:
    """Draw outlines (F, P, 2) of ellipses, as many as fill a panel.

    Those too thin to be seen stay unnamed in the legend; enlarged they might seem to reach into the disc.
    """
    if not len(polygons):
        return
    # More would cover each other, and make the page large.
    count = min(len(polygons), _MOST_ELLIPSES)
    chosen = np.linspace(0, len(polygons) - 1, count).round().astype(int)
    polygons = polygons[chosen]
    look: Any = {"facecolor": style.UNCERTAIN, "edgecolor": style.MODEL, "lw": 0.4, "alpha": 0.2}
    # Two pixels are a hundredth of a panel's width.
    widths = np.ptp(polygons, axis=1)[:, 0]
    wide = np.median(widths) > 0.01 * np.ptp(panel.x.limits())
    label = f"{share(level)} ellipses" if wide else None
    panel.fill(polygons, **look, label=label)


def _arrow(panel: Panel, centre: Complex, real: tuple[float, float], imag: tuple[float, float]) -> None:
    """Draw an arrow in the direction of rising frequency, a third along the visible part of the curve."""
    x = centre.real
    y = centre.imag
    in_width = (x > real[0]) & (x < real[1])
    in_height = (y > imag[0]) & (y < imag[1])
    seen = in_width & in_height
    # Length of the curve so far, as far as it is in view: the arrow stands a third along what is seen.
    both_ends_seen = seen[:-1] & seen[1:]
    steps = np.where(both_ends_seen, np.abs(np.diff(centre)), 0.0)
    length = np.cumsum(steps)
    if length.size and length[-1] > 0:
        third_along = int(np.searchsorted(length, 0.35 * length[-1]))
        k = min(third_along, centre.size - 2)
        start = float(x[k]), float(y[k])
        tip = float(x[k + 1]), float(y[k + 1])
        panel.arrow(start, tip, style.PREDICTED)
