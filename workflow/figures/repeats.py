"""Repeated experiments: does their scatter agree with what the ellipses predict?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ident.checks.validation import ScatterRow
from workflow.figures import style
from workflow.figures.registry import drawing


@drawing("repeats")
def draw_repeat_scatter(rows: Sequence[ScatterRow], name: str) -> Figure:
    """Relative scatter per band, predicted and measured, and their ratio.

    Raises ValueError without a band.
    """
    if not rows:
        raise ValueError("there is no band of repeat scatter to draw")
    figure, (upper, lower) = style.panels(4.4, 2, 1, sharex=True, height_ratios=[1.5, 1.0])
    for axes, field, factor, color, label in (
        (upper, "predicted", 100, style.MODEL, "one repeat, predicted"),
        (upper, "measured", 100, style.MEASURED, "measured between repeats"),
        (upper, "between", 100, style.HIGHLIGHT, "between conditions (amplitude, day)"),
        (lower, "ratio", 1, style.MEASURED, None),
        (lower, "between_ratio", 1, style.HIGHLIGHT, None),
    ):
        for row in rows:
            value = factor * getattr(row, field)
            if np.isfinite(value) and value > 0:
                ends = [row.omega_low_rad_s * 1.02, row.omega_high_rad_s / 1.02]
                axes.plot(ends, [value, value], color=color, lw=3, solid_capstyle="butt", label=label)
    upper.set(xscale="log", yscale="log", ylabel="scatter / gain [%]")
    upper.set_title(f"Repeat scatter: {style.plain(name, 40)}")
    lower.axhline(1.0, color=style.MODEL, lw=1.2)
    lower.set(yscale="log", xlabel="frequency [rad/s]", ylabel="measured /\npredicted [1]")
    low, high = lower.get_ylim()
    lower.set_ylim(min(0.4, low), max(2.5, high))
    style.hertz_axis(upper)
    return figure
