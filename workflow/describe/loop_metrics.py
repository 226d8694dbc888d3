"""Numbers of a step of the closed loop that every reader gets: one line each.

A line here puts a number of `StepMetrics` on the terminal, on the page of a run, into the JSON answer
(`closed_loop.NAME`), into the table of a study (column NAME) and into `flexlink.table`. Studies name their
columns before anything is computed, so this file loads nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class LoopMetric:
    """A number of the step, predicted and in every run.

    Attributes:
        name: Of the attribute of `StepMetrics`, unit included.
        label: As people call it.
        unit: "": that of the command.
        better: Which of two values a study prefers.
        of_tracking: Shown only where the reference is to be followed.
    """

    name: str
    label: str
    unit: str
    better: Literal["larger", "smaller"] = "smaller"
    of_tracking: bool = True


LOOP_METRICS = (
    LoopMetric("overshoot_percent", "overshoot", "%"),
    LoopMetric("settling_time_s", "settling time to 2 %", "s"),
    LoopMetric("peak_command", "peak command", "", of_tracking=False),
    LoopMetric("rise_time_s", "rise time 10-90 %", "s"),
)
