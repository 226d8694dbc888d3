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
    limits = experiment.limits
    plan = experiment.plan
    lines_Hz = experiment.lines_Hz
    detection_Hz = experiment.detection_Hz
    rms = np.array(plan.rms_V)
    picture, (signal, lines, response) = new_picture(3.6, 1, 3)

    # The loudest record shows how near the voltage comes to its limit.
    loudest = int(np.argmax(rms))
    voltage = experiment.voltages_V[loudest, 0]
    time = np.arange(voltage.size) * limits.dt_s
    shown = time <= _TIME_S
    signal.plot(time[shown], voltage[shown], **style.REFERENCE_STEPS | {"ls": "-", "lw": 0.7})
    for sign in (1, -1):
        signal.axhline(sign * limits.peak_V, **style.LIMIT_LINE, label="voltage limit")
    lead_in_s = plan.lead_in_samples * limits.dt_s
    signal.axvspan(0, lead_in_s, color=style.MEASURED, alpha=0.2, lw=0, label="lead-in")
    cut = "" if shown.all() else f", first {_TIME_S:g} s"
    signal.set(xlabel=f"time [s]{cut}", ylabel="voltage [V]")
    signal.set_title(f"First record at {rms[loudest]:g} V rms")

    # All lines have one amplitude: a sine's is the root of 2 of its rms, and powers add up.
    amplitude_over_rms = np.sqrt(2 / lines_Hz.size)
    # Later amplitudes fade, so that dots of several can be told apart.
    shades = np.linspace(1.0, 0.45, rms.size)
    for value, shade in zip(rms, shades, strict=True):
        line_V = np.full(lines_Hz.size, value * amplitude_over_rms)
        dots = {"ls": "none", "marker": ".", "ms": 3, "alpha": shade, "color": style.MODEL}
        lines.plot(lines_Hz, line_V, **dots, label="excited line")
    # Nothing is excited at the detection lines: their marks stand below all amplitudes.
    bottom = 0.5 * rms.min() * amplitude_over_rms
    lines.plot(
        detection_Hz,
        np.full(detection_Hz.size, bottom),
        ls="none",
        marker="|",
        ms=6,
        color=style.ACHIEVED,
        label="detection line (odd)",
    )
    lines.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="amplitude of a line [V]")
    lines.set_title("Lines of every record")

    # Where the radius lies below the gain, the response will be known.
    expected = list(experiment.radii)
    if experiment.gain is not None:
        expected += [np.min(experiment.gain), np.max(experiment.gain)]
        response.plot(lines_Hz, experiment.gain, **style.MODEL_LINE, label="expected gain")
    ends_Hz = lines_Hz[[0, -1]]
    radius_line = {"color": style.UNCERTAIN, "lw": 1.4, "label": "expected 95 % radius"}
    for value, radius in zip(rms, experiment.radii, strict=True):
        response.plot(ends_Hz, [radius] * 2, **radius_line)
        response.words(f"{value:g} V rms", lines_Hz[0], radius, offset=(0.0, 3.0))
    response.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="hub angle / voltage [rad/V]")
    # Half and twice the values leave room for the words above the highest line.
    response.set(ylim=(0.5 * min(expected), 2 * max(expected)))
    response.set_title("Response to be expected")
    return picture
