"""One picture of a run: what was identified, how far the loop stays from -1, what it does in time."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.bands import enlargement, envelope, outline, response_band
from workflow.figures.closed_loop import height
from workflow.figures.nyquist import draw_around_minus_one, loop_of
from workflow.figures.subjects import FRICTION, MACHINE, RunView
from workflow.text.formats import share


@style.drawing("overview")
def draw_overview(run: RunView) -> Figure:
    """Left: identified gain with its ellipses; middle: the loop around -1; right: the reference step, without
    the disturbance that follows it."""
    figure, (gain, around, step) = style.panels(4.4, 1, 3, width_in=12.0)
    spread, loop = run.control.spread, run.results.closed_loop.check
    assert loop is not None
    band = response_band(spread.frequency)
    factor = enlargement(band)
    # Where the ellipse holds the origin the lower end is zero, which a log axis cannot show.
    low = np.maximum(band.gain + factor * (band.gain_low - band.gain), 1e-3 * band.gain)
    high = band.gain + factor * (band.gain_high - band.gain)
    label = f"{share(spread.frequency.level)} band" + (f", enlarged {factor} times" if factor > 1 else "")
    gain.fill_between(band.omega_rad_s, low, high, **style.BAND, label=label)
    gain.plot(band.omega_rad_s, band.gain, **style.MODEL_LINE, label="identified response (centre)")
    nominal = np.abs(spread.nominal.frequency_response(band.omega_rad_s))
    dotted = {"color": style.REFERENCE, "lw": 1.0, "ls": (0, (1, 1.5))}
    gain.plot(band.omega_rad_s, nominal, **dotted, label="nominal model")
    unit = style.plain(style.ratio_unit(run.output_unit, run.input_unit), 30)
    gain.set(xscale="log", yscale="log", xlabel="frequency [rad/s]", ylabel=f"gain [{unit}]")
    gain.set_ylim(0.3 * band.gain.min(), 3 * band.gain.max())
    gain.set_title("Identified, with its uncertainty")
    margin = run.specification.modulus_margin
    draw_around_minus_one(around, loop_of(run), level=spread.frequency.level, modulus_margin=margin)
    around.set_title("Loop around -1")
    half = slice(0, loop.time_s.size // 2)
    time_s, achieved = loop.time_s[half], loop.achieved_runs.output[:, half]
    machine = MACHINE[loop.machine]
    step.fill_between(
        *envelope(time_s, achieved), **style.ACHIEVED_BAND, label=f"{machine}: all {achieved.shape[0]} runs"
    )
    step.plot(*outline(time_s, achieved[0], 180), **style.ACHIEVED_LINE, label=f"{machine}: first run")
    for held, look in zip(loop.with_friction, FRICTION, strict=False):
        step.plot(*outline(time_s, held, 180), **look)
    predicted = loop.predicted_runs.output[0, half]
    step.plot(time_s, predicted, **style.PREDICTED_LINE, label="predicted, nominal model")
    step.plot(time_s, loop.reference[half], **style.REFERENCE_STEPS, label="reference")
    name, unit = style.plain(run.config.control_channel.output, 24), style.plain(run.output_unit, 16)
    step.set(xlabel="time [s]", ylabel=f"{name} [{unit or 'as logged'}]", title="Checked in closed loop")
    asked = np.append(predicted, loop.reference[half])
    step.set_ylim(*style.pad_limits(*height(asked, (achieved, *loop.with_friction), 3.0), 0.08))
    return figure
