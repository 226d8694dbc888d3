"""A planned experiment: what it excites, and how well the response will be known."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.registry import drawing
from workflow.tasks.experiment import PlannedExperiment

_TIME_S = 10.0


@drawing("excitation")
def draw_excitation(found: PlannedExperiment) -> Figure:
    """Left: first record at the highest amplitude, and its lines. Right: expected radius and gain, where
    there is anything to expect."""
    rms = np.array(found.plan.rms_V)
    loudest = int(np.argmax(rms))
    known = found.radii is not None or found.gain is not None
    figure, axes = style.panels(3.6, 1, 3 if known else 2)
    voltage = found.voltages_V[loudest, 0]
    time = np.arange(voltage.size) * found.limits.dt_s
    shown = time <= _TIME_S
    axes[0].plot(time[shown], voltage[shown], **style.REFERENCE_STEPS | {"ls": "-", "lw": 0.7})
    for sign in (1, -1):
        axes[0].axhline(sign * found.limits.peak_V, **style.LIMIT_LINE, label="voltage limit")
    lead_in_s = found.plan.lead_in_samples * found.limits.dt_s
    axes[0].axvspan(0, lead_in_s, color=style.MEASURED, alpha=0.2, lw=0, label="lead-in")
    cut = "" if shown.all() else f", first {_TIME_S:g} s"
    axes[0].set(xlabel=f"time [s]{cut}", ylabel="voltage [V]")
    axes[0].set_title(f"First record at {rms[loudest]:g} V rms")
    for value, shade in zip(rms, np.linspace(1.0, 0.45, rms.size), strict=True):
        line_V = np.full(found.lines_Hz.size, value * np.sqrt(2 / found.lines_Hz.size))
        dots = {"ls": "none", "marker": ".", "ms": 3, "alpha": shade, "color": style.MODEL}
        axes[1].plot(found.lines_Hz, line_V, **dots, label="excited line")
    bottom = 0.5 * rms.min() * np.sqrt(2 / found.lines_Hz.size)
    axes[1].plot(
        found.detection_Hz,
        np.full(found.detection_Hz.size, bottom),
        ls="none",
        marker="|",
        ms=6,
        color=style.ACHIEVED,
        label="detection line (odd)",
    )
    axes[1].set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="amplitude of a line [V]")
    axes[1].set_title("Lines of every record")
    if known:
        if found.gain is not None:
            axes[2].plot(found.lines_Hz, found.gain, **style.MODEL_LINE, label="expected gain")
        for value, radius in zip(rms, found.radii or (), strict=False):
            axes[2].axhline(radius, color=style.UNCERTAIN, lw=1.4, label="expected 95 % radius")
            axes[2].annotate(f"{value:g} V rms", (found.lines_Hz[0], radius), fontsize=8, va="bottom")
        axes[2].set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="hub angle / voltage [rad/V]")
        axes[2].set_title("Response to be expected")
    return figure
