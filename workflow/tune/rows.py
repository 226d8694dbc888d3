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
    # The slowest plant counts; one that never settles makes the whole set never settle.
    times_s = [step.settling_time_s for step in steps]
    reached_s = [time_s for time_s in times_s if time_s is not None]
    settling = "never"
    if len(reached_s) == len(times_s):
        settling = si(max(reached_s), "s")

    # Margins are rounded to the safe side: what is shown is reached.
    phase_margin = f"{at_least(math.degrees(margins.phase_rad))} deg"
    delay_margin = f"{at_least(1000 * margins.delay_s)} ms"
    bandwidth = f"{at_least(bandwidth_rad_s)} rad/s"
    overshoot = max(step.overshoot_percent for step in steps)
    peak_command = si(max(step.peak_command for step in steps), input_unit)
    return said(
        worded("worst case γ", at_most(gamma, 4)),
        worded("modulus margin", at_least(margins.modulus)),
        worded("gain margin", decibels(margins.gain_up)),
        worded("phase margin", phase_margin),
        worded("delay margin", delay_margin),
        worded("bandwidth", bandwidth),
        worded("overshoot", percent(overshoot)),
        worded("settling time to 2 %", settling),
        worded("settling time with friction, steps of half to twice the size", friction),
        worded("peak command", peak_command),
        worded("controller order", str(order)),
        pid_row(numbers),
        worded("at the limits", limits),
    )
