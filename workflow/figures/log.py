"""The columns of a log as they are."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.registry import drawing
from workflow.tasks.log_look import LogLook

# Panels of one figure; a log of more signals is looked at in parts.
_MOST = 12


@drawing("log")
def draw_log(found: LogLook) -> Figure | None:
    """One panel per column of numbers, the first twelve."""
    shown = [column for column in found.columns if column.values is not None][:_MOST]
    if not shown:
        return None
    figure, axes = style.panels(1.6 * len(shown), len(shown), 1)
    known = found.time is not None and not found.time.why
    step = found.time.period_s if known and found.time is not None else 1.0
    for panel, column in zip(np.atleast_1d(axes), shown, strict=True):
        values = column.values
        assert values is not None
        panel.plot(step * np.arange(values.size), values, color=style.MEASURED, lw=0.7)
        panel.set(
            xlabel="time [s]" if known else "row [1]", ylabel=f"[{column.unit or '?'}]", title=column.name
        )
    return figure
