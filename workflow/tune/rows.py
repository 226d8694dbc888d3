"""What stands beside the sliders of `flexlink tune`."""

from __future__ import annotations

import math
from collections.abc import Sequence

from control_design.analysis.closed_loop import StepMetrics
from control_design.analysis.margins import Margins
from control_design.controllers.engineers_numbers import ControllerNumbers
from workflow.describe.controller import pid_row
from workflow.describe.facts import Row, said, worded
from workflow.text.formats import at_least, at_most, decibels, percent, si


def tune_rows(
    gamma: float,
    margins: Margins,
    bandwidth_rad_s: float,
    steps: Sequence[StepMetrics],
    *,
    input_unit: str,
    order: int,
    numbers: ControllerNumbers | None,
    friction: str,
    limits: str,
) -> tuple[Row, ...]:
    """Margins over the ellipses of all plants, and the step of the nominal loops.

    Args:
        gamma: Weighted worst case.
        margins: The worst over the plants.
        bandwidth_rad_s: Certified on all of them.
        steps: Of the nominal loop with each plant.
        input_unit: Of the command.
        order: Of the controller.
        numbers: The controller in an engineer's numbers, where it has such factors.
        friction: Settling times with friction; "" where they are not known.
        limits: What is said of the loop at its limits.
    """
    times_s = [step.settling_time_s for step in steps]
    reached_s = [time_s for time_s in times_s if time_s is not None]
    settling = "never"
    if len(reached_s) == len(times_s):
        settling = si(max(reached_s), "s")
    phase_deg = math.degrees(margins.phase_rad)
    delay_ms = 1000 * margins.delay_s
    overshoot = max(step.overshoot_percent for step in steps)
    peak_command = max(step.peak_command for step in steps)
    return said(
        worded("worst case γ", at_most(gamma, 4)),
        worded("modulus margin", at_least(margins.modulus)),
        worded("gain margin", decibels(margins.gain_up)),
        worded("phase margin", f"{at_least(phase_deg)} deg"),
        worded("delay margin", f"{at_least(delay_ms)} ms"),
        worded("bandwidth", f"{at_least(bandwidth_rad_s)} rad/s"),
        worded("overshoot", percent(overshoot)),
        worded("settling time to 2 %", settling),
        worded("settling time with friction, steps of half to twice the size", friction),
        worded("peak command", si(peak_command, input_unit)),
        worded("controller order", str(order)),
        pid_row(numbers),
        worded("at the limits", limits),
    )
