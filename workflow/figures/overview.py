"""One picture of a run: what was identified, how far the loop stays from -1, what it does in time."""

from __future__ import annotations

import numpy as np

from workflow.figures import style
from workflow.figures.bode import draw_enlarged
from workflow.figures.closed_loop import draw_closed_loop
from workflow.figures.description import Picture, new_picture
from workflow.figures.nyquist import draw_nyquist, loop_of
from workflow.figures.subjects import MACHINE, RunView
from workflow.tasks.results import LoopRuns


@style.drawing("overview")
def draw_overview(run: RunView) -> Picture:
    """Left: identified gain with its ellipses; middle: the loop around -1; right: the reference step, without
    the disturbance that follows it."""
    picture, (gain, around, step) = new_picture(4.1, 1, 3, width_in=12.0)
    spread = run.control.spread
    loop = run.results.closed_loop.check
    assert loop is not None
    band = draw_enlarged(gain, spread.frequency)
    nominal = np.abs(spread.nominal.frequency_response(band.omega_rad_s))
    dotted = {"color": style.REFERENCE, "lw": 1.0, "ls": (0, (1, 1.5))}
    gain.plot(band.omega_rad_s, nominal, **dotted, label="nominal model")
    unit = style.plain(style.ratio_unit(run.output_unit, run.input_unit), 30)
    gain.set(yscale="log", ylabel=f"gain [{unit}]")
    # An enlarged band may reach far below: the view keeps to the gain itself.
    gain.set(ylim=(0.3 * band.gain.min(), 3 * band.gain.max()))
    gain.set_title("Identified, with its uncertainty")
    margin = run.specification.modulus_margin
    draw_nyquist(around, loop_of(run), margin, near=True)
    half = slice(0, loop.time_s.size // 2)
    predicted, achieved = (
        LoopRuns(runs.output[:, half], runs.command[:, half], None, runs.limited[:, half])
        for runs in (loop.predicted_runs, loop.achieved_runs)
    )
    draw_closed_loop(
        loop.time_s[half],
        loop.reference[half],
        predicted,
        {"output": (run.config.control_channel.output, run.output_unit)},
        others=achieved,
        machine=MACHINE["simulated"] if loop.machine == "simulated" else "",
        with_friction=loop.with_friction,
        settled_s=loop.longest_settling_s,
        onto=(picture, step),
    )
    step.set_title("Checked in closed loop")
    return picture
