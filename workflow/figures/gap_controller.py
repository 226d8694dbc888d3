"""What the gap does to a loop: the same step with the design on the rig as stated and on the repaired one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from workflow.figures import style

Real = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LoopRun:
    """Tip position [m] and command [V] of one run; model: "stated" or "repaired", the one the design saw."""

    model: str
    achieved: bool
    tip_m: Real
    command_V: Real


def draw_controller_check(time_s: Real, reference_m: Real, runs: tuple[LoopRun, ...]) -> Figure:
    """One column per design: what its own model predicted (dashed) and what the repaired machine does."""
    with style.house_style():
        figure = style.new_figure(4.6)
        grid = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=[1.6, 1.0])
        for column, model in enumerate(("stated", "repaired")):
            above, below = grid[0, column], grid[1, column]
            above.plot(time_s, 1e3 * reference_m, **style.REFERENCE_LINE, label="asked for")
            for run in (run for run in runs if run.model == model):
                look = style.ACHIEVED_LINE if run.achieved else {**style.PREDICTED_LINE, "ls": (0, (4, 1.5))}
                label = "achieved on the repaired machine" if run.achieved else "predicted by its own model"
                above.plot(time_s, 1e3 * run.tip_m, **look, label=label)
                below.step(time_s, run.command_V, where="post", **look)
            above.set_title(f"Design on the {'rig as stated' if model == 'stated' else 'repaired rig'}")
            below.set_xlabel("time [s]")
            above.margins(x=0.01)
        grid[0, 0].set_ylabel("tip position [mm]")
        grid[1, 0].set_ylabel("voltage [V]")
        style.finish(figure, grid.ravel())
    return figure
