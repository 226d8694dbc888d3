"""What the gap does to a loop: the same step with the design on the nominal rig and on the repaired one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.registry import drawing

Real = npt.NDArray[np.float64]


class LoopRun(Protocol):
    """Tip position [m] and command [V] of one run."""

    @property
    def tip_m(self) -> Real: ...

    @property
    def command_V(self) -> Real: ...


class ControllerCheck(Protocol):
    """Runs in the order nominal predicted, nominal achieved, repaired predicted, repaired achieved."""

    @property
    def time_s(self) -> Real: ...

    @property
    def reference_rad(self) -> Real: ...

    @property
    def arm_m(self) -> float: ...

    @property
    def runs(self) -> Sequence[LoopRun]: ...


@drawing("gap_controller")
def draw_controller_check(check: ControllerCheck) -> Figure:
    """One column per design: what its own model predicted (dashed) and what the repaired machine does."""
    with style.house_style():
        figure = style.new_figure(4.6)
        grid = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=[1.6, 1.0])
        for column, design in enumerate(("nominal parameters", "repaired rig")):
            above, below = grid[:, column]
            reference_mm = 1e3 * check.arm_m * check.reference_rad
            above.plot(check.time_s, reference_mm, **style.REFERENCE_LINE, label="asked for")
            predicted, achieved = check.runs[2 * column : 2 * column + 2]
            for run, look, label in (
                (predicted, {**style.PREDICTED_LINE, "ls": (0, (4, 1.5))}, "predicted by its own model"),
                (achieved, style.ACHIEVED_LINE, "achieved on the repaired machine"),
            ):
                above.plot(check.time_s, 1e3 * run.tip_m, **look, label=label)
                below.step(check.time_s, run.command_V, where="post", **look)
            above.set_title(f"Design with the {design}")
            below.set_xlabel("time [s]")
            above.margins(x=0.01)
        grid[0, 0].set_ylabel("tip position [mm]")
        grid[1, 0].set_ylabel("voltage [V]")
        style.finish(figure, grid.ravel())
    return figure
