"""Dry friction in the loop: peak of the sensitivity by size, and what its feed-forward does."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.bands import outline
from workflow.figures.registry import drawing
from workflow.figures.subjects import MACHINE, RunView


@drawing("friction-in-the-loop")
def draw_friction(run: RunView) -> Figure | None:
    """Left: peak of |S| over the rms of the reference, predicted with friction, measured, certified. Right:
    error on the slow sine. Nothing where friction was not identified."""
    if run.loop is None or run.loop.friction is None:
        return None
    loop, found, unit = run.loop, run.loop.friction, run.output_unit
    name, sine = run.config.control_channel.output, found.tracking
    figure, (peaks, errors) = style.panels(3.9, 1, 2)
    middle = np.sqrt(found.low * found.high)
    bars = {"elinewidth": 5.0, "capsize": 0, "color": style.UNCERTAIN, "alpha": 0.7}
    reach = [middle - found.low, found.high - middle]
    label = "identified arm with friction, 95 %"
    peaks.errorbar(found.sizes, middle, yerr=reach, marker="_", ls="none", label=label, **bars)
    if found.measured is not None:
        looks = {"color": style.ACHIEVED, "marker": "o", "ms": 4.0, "ls": "none"}
        peaks.plot(found.sizes, found.measured, **looks, label=f"measured, {MACHINE[loop.machine]}")
    peaks.axhline(found.nominal_peak, **style.PREDICTED_LINE, label="linear prediction")
    if np.isfinite(found.certified_peak):
        peaks.axhline(found.certified_peak, **style.LIMIT_LINE, label="certified")
    if found.sticking_step > 0:
        peaks.axvline(found.sticking_step, **style.REFERENCE_LINE, label="a step of this size sticks")
    peaks.set(xscale="log", title="Peak of |S| by size of the reference", ylabel="|S| [1]")
    peaks.set_xlabel(f"rms of the reference [{style.plain(unit, 12)}]")
    time_s = np.asarray(np.arange(sine.without.size) * run.plant.dt_s, dtype=np.float64)
    for error, look, words in (
        (sine.without, style.ACHIEVED_LINE, "without feed-forward"),
        (sine.given, style.MODEL_LINE, "with friction feed-forward"),
    ):
        errors.plot(*outline(time_s, error, 400), **look, label=words)
    for sign in (-1, 1):
        errors.axhline(
            sign * found.error_at_rest, **style.LIMIT_LINE, label="most that friction leaves at rest"
        )
    errors.set(xlabel="time [s]", title="Error on a slow sine")
    errors.set_xlim(0.0, float(time_s[-1]))
    errors.set_ylabel(style.two_lines(name, unit))
    return figure
