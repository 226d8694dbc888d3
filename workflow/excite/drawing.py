"""The picture of a planned experiment."""

from __future__ import annotations

import numpy as np

from workflow.excite.experiment import PlannedExperiment
from workflow.figures import style
from workflow.figures.description import Picture, new_picture

# Seconds of a voltage that are shown: a panel of more shows a band and no signal.
_TIME_S = 10.0


@style.drawing("excitation")
def draw_excitation(experiment: PlannedExperiment) -> Picture:
    """A planned experiment: first record at the highest amplitude, lines of all, and what to expect.

    Right: the expected radius of the response, and its gain where it is known.
    """
    rms = np.array(experiment.plan.rms_V)
    loudest = int(np.argmax(rms))
    picture, (signal, lines, response) = new_picture(3.6, 1, 3)
    voltage = experiment.voltages_V[loudest, 0]
    time = np.arange(voltage.size) * experiment.limits.dt_s
    shown = time <= _TIME_S
    signal.plot(time[shown], voltage[shown], **style.REFERENCE_STEPS | {"ls": "-", "lw": 0.7})
    for sign in (1, -1):
        signal.axhline(sign * experiment.limits.peak_V, **style.LIMIT_LINE, label="voltage limit")
    lead_in_s = experiment.plan.lead_in_samples * experiment.limits.dt_s
    signal.axvspan(0, lead_in_s, color=style.MEASURED, alpha=0.2, lw=0, label="lead-in")
    cut = "" if shown.all() else f", first {_TIME_S:g} s"
    signal.set(xlabel=f"time [s]{cut}", ylabel="voltage [V]")
    signal.set_title(f"First record at {rms[loudest]:g} V rms")
    for value, shade in zip(rms, np.linspace(1.0, 0.45, rms.size), strict=True):
        line_V = np.full(experiment.lines_Hz.size, value * np.sqrt(2 / experiment.lines_Hz.size))
        dots = {"ls": "none", "marker": ".", "ms": 3, "alpha": shade, "color": style.MODEL}
        lines.plot(experiment.lines_Hz, line_V, **dots, label="excited line")
    bottom = 0.5 * rms.min() * np.sqrt(2 / experiment.lines_Hz.size)
    lines.plot(
        experiment.detection_Hz,
        np.full(experiment.detection_Hz.size, bottom),
        ls="none",
        marker="|",
        ms=6,
        color=style.ACHIEVED,
        label="detection line (odd)",
    )
    lines.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="amplitude of a line [V]")
    lines.set_title("Lines of every record")
    if experiment.gain is not None:
        response.plot(experiment.lines_Hz, experiment.gain, **style.MODEL_LINE, label="expected gain")
    for value, radius in zip(rms, experiment.radii, strict=True):
        response.plot(
            experiment.lines_Hz[[0, -1]],
            [radius] * 2,
            color=style.UNCERTAIN,
            lw=1.4,
            label="expected 95 % radius",
        )
        response.words(f"{value:g} V rms", experiment.lines_Hz[0], radius, offset=(0.0, 1.0))
    response.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="hub angle / voltage [rad/V]")
    response.set_title("Response to be expected")
    return picture
