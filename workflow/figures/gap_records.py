"""Residuals as they are: over time in every experiment, and over frequency."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diagnosis.answer import Diagnosis
from diagnosis.fit.residual import pooled_rms
from diagnosis.machine.case import Case
from plant.modal import linear_arm
from workflow.figures import gap_style, style
from workflow.figures.bands import Real, outline
from workflow.figures.description import Picture, Y, new_picture, small_multiples

# Samples of a segment: 257 lines, more than a panel shows; short records still hold several.
_SEGMENT = 512
# Modes that are marked: marks of higher ones stand too close.
_MODES = 3


@style.drawing("gap_measured")
def draw_measured_beside_simulated(found: Diagnosis) -> Picture:
    """Validation record with the largest model error, a column per output in its unit; residuals below.

    Of a model that fits hold near its records, the plain simulations from the recorded start.
    """
    case = found.case
    runs = found.replays
    worst = max(case.held_out, key=lambda e: pooled_rms(found.residuals_before[e.name]))
    time = np.arange(len(worst.output), dtype=np.float64) * case.dt_s
    picture, grid = new_picture(
        4.6, 2, len(case.outputs), sharex=True, squeeze=False, height_ratios=[1.6, 1.0]
    )
    for column, output in enumerate(case.outputs):
        words, unit, _ = gap_style.look_of(output)
        unit = style.plain(unit or case.units.get(output, ""), 16) or "as logged"
        (above, below) = grid[:, column]
        measured = worst.output[:, column]
        # Broad and pale: a model that fits lies on top of it.
        above.plot(*outline(time, measured), color=gap_style.PALE, lw=3.0, label="measured")
        for model in dict.fromkeys(("stated", found.models[-1])):
            look = gap_style.MODELS[model]
            name = gap_style.WORDS[model]
            residual = found.residuals[model][worst.name][:, column] * case.noise[column]
            if runs:
                residual = measured - runs[model][worst.name][:, column]
            above.plot(*outline(time, measured - residual), **look, label=name)
            below.plot(*outline(time, residual), **look)
        above.set(title=f"{style.plain(worst.name, 30)}: {words}", ylabel=f"{words} [{unit}]")
        below.set(xlabel="time [s]", ylabel=f"residual [{unit}]")
        above.x.margin = 0.01
        # A free run may fall over, far away from what was measured.
        if runs:
            far = np.ptp(measured)
            lowest = np.min(measured) - far
            highest = np.max(measured) + far
            for panel, low, high in ((above, lowest, highest), (below, -far, far)):
                bottom, top = panel.y.limits()
                panel.set(ylim=(max(bottom, low), min(top, high)))
    return picture


@style.drawing("gap_traces")
def draw_residual_traces(found: Diagnosis) -> Picture:
    """Rows are experiments, columns are sensors; the band is two standard deviations of the sensor noise.

    Beside a model error residuals are in per cent of the motion, and there is no band.
    """
    case = found.case
    models = dict.fromkeys(("stated", found.models[-1]))
    picture, grid = new_picture(
        0.9 + 1.25 * len(case.experiments),
        len(case.experiments),
        len(case.outputs),
        sharex="row",
        squeeze=False,
    )
    for row, experiment in zip(grid, case.experiments, strict=True):
        residuals = {model: found.residuals[model][experiment.name] for model in models}
        time = np.arange(len(experiment.output), dtype=np.float64) * case.dt_s
        role = " (validation)" if experiment.role == "held_out" else ""
        for column, panel in enumerate(row):
            if not case.model_error > 0:
                panel.axhspan(-2, 2, **gap_style.NOISE_BAND)
            for model, e in residuals.items():
                look = {**gap_style.MODELS[model], "lw": 0.7, "ls": "-"}
                panel.plot(*outline(time, e[:, column]), **look, label=gap_style.WORDS[model])
            largest = max(float(np.max(np.abs(e[:, column]))) for e in residuals.values())
            # Four standard deviations at least, so that noise does not fill the panel.
            reach = max(4.0, 1.05 * largest)
            panel.set(ylim=(-reach, reach))
            panel.x.margin = 0.01
            output = gap_style.look_of(case.outputs[column])[0]
            title = f"{style.plain(experiment.name, 30)}{role}: {output}"
            panel.set_title(title, size=9, bold=False)
        unit = "[% of motion]" if case.model_error > 0 else "over noise [1]"
        row[0].set(ylabel=f"residual\n{unit}")
        row[0].label_size[Y] = 8.5
    for panel in grid[-1]:
        panel.set(xlabel="time [s]")
    return picture


@style.drawing("gap_spectra")
def draw_residual_spectra(found: Diagnosis) -> Picture:
    """Spectra of the residuals over noise, all experiments together; white noise of the stated size is 1.

    The lowest flexible modes of the nominal rig are marked.
    """
    case = found.case
    dt_s = case.dt_s
    # The arm's modes are marked where its values tell them: other plants have no such model.
    poles = linear_arm(case.rig).poles() if isinstance(case, Case) else np.zeros(0, complex)
    upper_poles = poles[poles.imag > 0]
    modes_Hz = sorted(float(abs(pole)) / (2 * np.pi) for pole in upper_poles)
    n_outputs = len(case.outputs)
    picture, panels = small_multiples(n_outputs, n_outputs, 3.7, 0.0, sharey=True)
    for column, panel in enumerate(panels):
        for model in found.models:
            frequency, power = _spectrum([e[:, column] for e in found.residuals[model].values()], dt_s)
            panel.set(xscale="log", yscale="log")
            panel.plot(frequency, power, **gap_style.MODELS[model], label=gap_style.WORDS[model])
        panel.axhline(1.0, **gap_style.FLOOR)
        for number, mode in enumerate(modes_Hz[:_MODES], 1):
            if mode < 0.5 / dt_s:
                style.tag_below(panel, mode, f"mode {number}")
        output = gap_style.look_of(case.outputs[column])[0]
        panel.set(xlabel="frequency [Hz]", title=f"Residual of the {output}")
    # Once all are drawn: a limit that is set ends the scaling of the panels that share it.
    low, high = panels[0].y.limits()
    panels[0].set(ylim=(min(low, 0.1), max(high, 10.0)))
    panels[0].set(ylabel="power over that of the noise [1]")
    return picture


def _spectrum(signals: Sequence[Real], dt_s: float) -> tuple[Real, Real]:
    """Welch's estimate over all records, relative to white noise of unit variance."""
    # Half a second to load, which only this picture needs.
    from scipy.signal import welch

    length = min(_SEGMENT, *(s.size for s in signals))
    total = np.zeros(length // 2 + 1)
    weight = 0
    frequency = np.asarray(np.fft.rfftfreq(length, dt_s), dtype=np.float64)
    for signal in signals:
        _, power = welch(signal, 1 / dt_s, nperseg=length, detrend=False)
        total += signal.size * power
        weight += signal.size
    # One-sided density of unit white noise: 2 dt.
    return frequency[1:], np.asarray(total / weight / (2 * dt_s))[1:]
