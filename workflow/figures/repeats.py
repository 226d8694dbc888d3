"""Repeated experiments: does their scatter agree with the ellipses?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.bands import Real


@dataclass(frozen=True, eq=False)
class ScatterCurves:
    """Over omega_rad_s (F,): |G|, the scatter predicted by the ellipses and the one measured between repeats.

    Both scatters are RMS radii of one response estimate in the units of |G|.
    """

    omega_rad_s: Real
    gain: Real
    predicted: Real
    measured: Real
    repeats: int
    gain_unit: str = ""


def draw_repeat_scatter(curves: ScatterCurves, *, name: str) -> Figure:
    """Predicted and measured scatter beside the response, and their ratio."""
    with style.house_style():
        figure = style.new_figure(4.8)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.6, 1.0])
        upper.plot(curves.omega_rad_s, curves.gain, **style.MODEL_LINE, label="gain of the response")
        upper.plot(
            curves.omega_rad_s,
            curves.predicted,
            color=style.UNCERTAIN,
            lw=1.8,
            label="scatter predicted by the ellipses",
        )
        upper.plot(
            curves.omega_rad_s,
            curves.measured,
            color=style.MEASURED,
            ls="none",
            marker=".",
            ms=4,
            label=f"scatter measured between {curves.repeats} repeats",
        )
        upper.set_xscale("log")
        upper.set_yscale("log")
        upper.set_title(f"Repeat scatter: {style.plain(name, 40)}")
        upper.set_ylabel(f"gain [{style.plain(curves.gain_unit or 'as logged', 34)}]")
        positive = curves.predicted > 0
        ratio = curves.measured[positive] / curves.predicted[positive]
        lower.plot(curves.omega_rad_s[positive], ratio, color=style.MEASURED, ls="none", marker=".", ms=4)
        lower.axhline(1.0, color=style.UNCERTAIN, lw=1.6)
        lower.set_yscale("log")
        if ratio.size and np.any(ratio > 0):
            low, high = float(ratio[ratio > 0].min()), float(ratio.max())
            lower.set_ylim(min(0.3, low / 1.3), max(3.0, high * 1.3))
        style.plain_log(lower.yaxis)
        lower.set_ylabel("measured /\npredicted [1]")
        lower.set_xlabel("frequency [rad/s]")
        upper.set_xlim(curves.omega_rad_s[0], curves.omega_rad_s[-1])
        style.hertz_axis(upper)
        figure.align_ylabels()
        style.legend_below(figure, upper, columns=3)
    return figure
