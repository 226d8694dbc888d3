"""The picture of `flexlink look`: every column of a log over time."""

from __future__ import annotations

import numpy as np

from workflow.figures import style
from workflow.figures.description import Picture, new_picture
from workflow.look.log_look import LogLook

# Panels of one picture; a log of more signals is looked at in parts.
_MOST = 12


@style.drawing("log")
def draw_log(log_look: LogLook) -> Picture | None:
    """One panel per column of numbers, the first twelve."""
    shown = [column for column in log_look.columns if column.values is not None][:_MOST]
    if not shown:
        return None
    picture, grid = new_picture(1.6 * len(shown), len(shown), 1, squeeze=False)
    known = log_look.time is not None and not log_look.time.why
    step = log_look.time.period_s if known and log_look.time is not None else 1.0
    for panel, column in zip(grid[:, 0], shown, strict=True):
        values = column.values
        assert values is not None
        panel.plot(step * np.arange(values.size), values, color=style.MEASURED, lw=0.7)
        panel.set(
            xlabel="time [s]" if known else "row [1]", ylabel=f"[{column.unit or '?'}]", title=column.name
        )
    return picture
