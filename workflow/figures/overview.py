"""One picture of a run: what was identified and how surely, how far the loop stays from -1, what it does in
time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ident.basis.model import GobfModel
from ident.uncertainty import FrequencyUncertainty
from workflow.figures import style
from workflow.figures.bands import Real, envelope, outline, response_band
from workflow.figures.nyquist import UncertainLoop, draw_around_minus_one, loop_of
from workflow.figures.registry import drawing
from workflow.figures.subjects import MACHINE, RunView


@dataclass(frozen=True, eq=False)
class StepView:
    """The reference step alone: time_s, reference and predicted (T,), achieved (R, T) of R runs; machine says
    on what."""

    time_s: Real
    reference: Real
    predicted: Real
    achieved: Real
    machine: str
    output: tuple[str, str]


@drawing("overview")
def draw_run(run: RunView) -> Figure:
    """Of a run whose loop was run: the step without the disturbance that follows it."""
    loop, channel = run.loop, run.config.control_channel
    assert loop is not None
    half = slice(0, loop.time_s.size // 2)
    step = StepView(
        time_s=loop.time_s[half],
        reference=loop.reference[half],
        predicted=loop.predicted_runs.output[0, half],
        achieved=loop.achieved_runs.output[:, half],
        machine=MACHINE[loop.machine],
        output=(channel.output, run.output_unit),
    )
    return draw_overview(
        run.control.spread.frequency,
        run.control.spread.nominal,
        loop_of(run),
        step,
        gain_unit=style.ratio_unit(run.output_unit, run.input_unit),
        modulus_margin=run.config.specification.modulus_margin,
    )


def draw_overview(
    frequency: FrequencyUncertainty,
    nominal: GobfModel,
    loop: UncertainLoop,
    step: StepView,
    *,
    gain_unit: str,
    modulus_margin: float,
) -> Figure:
    """Left: identified gain with its ellipses; middle: the loop around -1; right: the step."""
    with style.house_style():
        figure = style.new_figure(4.4, 12.0)
        gain, around, time = figure.subplots(1, 3)
        _draw_gain(gain, frequency, nominal, gain_unit)
        draw_around_minus_one(around, loop, level=frequency.level, modulus_margin=modulus_margin)
        around.set_title("Loop around -1")
        _draw_step(time, step)
        style.finish(figure, (gain, around, time), columns=5)
    return figure


def _draw_gain(axes: Axes, frequency: FrequencyUncertainty, nominal: GobfModel, unit: str) -> None:
    band = response_band(frequency)
    # Where the ellipse holds the origin the lower end is zero, which a log axis cannot show.
    low = np.maximum(band.gain_low, 1e-3 * band.gain)
    axes.fill_between(
        band.omega_rad_s,
        low,
        band.gain_high,
        **style.BAND,
        label=f"gain over the {100 * frequency.level:.4g} % ellipses",
    )
    axes.plot(band.omega_rad_s, band.gain, **style.MODEL_LINE, label="identified response (centre)")
    axes.plot(
        band.omega_rad_s,
        np.abs(nominal.frequency_response(band.omega_rad_s)),
        color=style.REFERENCE,
        lw=1.0,
        ls=(0, (1, 1.5)),
        label="nominal model",
    )
    axes.set(xscale="log", yscale="log", xlabel="frequency [rad/s]", ylabel=f"gain [{style.plain(unit, 30)}]")
    axes.set_ylim(0.3 * band.gain.min(), 3 * band.gain.max())
    axes.set_title("Identified, with its uncertainty")


def _draw_step(axes: Axes, step: StepView) -> None:
    axes.fill_between(
        *envelope(step.time_s, step.achieved),
        color=style.ACHIEVED,
        alpha=0.22,
        lw=0,
        label=f"{step.machine}: all {step.achieved.shape[0]} runs",
    )
    axes.plot(
        *outline(step.time_s, step.achieved[0], 180),
        **style.ACHIEVED_LINE,
        label=f"{step.machine}: first run",
    )
    axes.plot(step.time_s, step.predicted, **style.PREDICTED_LINE, label="predicted, nominal model")
    axes.plot(step.time_s, step.reference, **style.REFERENCE_LINE, drawstyle="steps-post", label="reference")
    name, unit = step.output
    axes.set(
        xlabel="time [s]",
        ylabel=f"{style.plain(name, 24)} [{style.plain(unit, 16) if unit else 'as logged'}]",
    )
    axes.set_title("Checked in closed loop")
