"""Repeated experiments: does their scatter agree with what the ellipses predict?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ident.checks.validation import ScatterRow
from workflow.figures import style
from workflow.figures.registry import drawing


@drawing("repeats")
def draw_repeat_scatter(rows: Sequence[ScatterRow], name: str) -> Figure:
    """Relative scatter per band, predicted and measured, and their ratio. Raises ValueError without a
    band."""
    if not rows:
        raise ValueError("there is no band of repeat scatter to draw")
    with style.house_style():
        figure = style.new_figure(4.4)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.5, 1.0])
        edges = [(row.omega_low_rad_s, row.omega_high_rad_s) for row in rows]
        series: list[tuple[str, str, dict[str, Any]]] = [
            ("predicted", "one repeat, predicted by the ellipses", {"color": style.MODEL, "lw": 3.0}),
            ("measured", "measured between repeats", {"color": style.MEASURED, "lw": 3.0}),
        ]
        if any(np.isfinite(row.between) for row in rows):
            series.append(
                ("between", "between conditions (amplitude, day)", {"color": style.HIGHLIGHT, "lw": 3.0})
            )
        for field, label, how in series:
            for number, (row, (low, high)) in enumerate(zip(rows, edges, strict=True)):
                value = 100 * getattr(row, field)
                if np.isfinite(value) and value > 0:
                    upper.plot(
                        [low * 1.02, high / 1.02],
                        [value, value],
                        **how,
                        solid_capstyle="butt",
                        label=label if number == 0 else None,
                    )
        for row, (low, high) in zip(rows, edges, strict=True):
            for field, color in (("ratio", style.MEASURED), ("between_ratio", style.HIGHLIGHT)):
                value = getattr(row, field)
                if np.isfinite(value) and value > 0:
                    lower.plot(
                        [low * 1.02, high / 1.02], [value, value], color=color, lw=3, solid_capstyle="butt"
                    )
        upper.set_xscale("log")
        upper.set_yscale("log")
        upper.set_title(f"Repeat scatter: {style.plain(name, 40)}")
        upper.set_ylabel("scatter / gain [%]")
        lower.axhline(1.0, color=style.MODEL, lw=1.2)
        lower.set_yscale("log")
        low_ratio, high_ratio = lower.get_ylim()
        lower.set_ylim(min(0.4, low_ratio), max(2.5, high_ratio))
        lower.set_ylabel("measured /\npredicted [1]")
        lower.set_xlabel("frequency [rad/s]")
        style.hertz_axis(upper)
        figure.align_ylabels()
        style.finish(figure, upper, columns=3)
    return figure
