"""Figs. 5 and 6 redrawn: free runs on fresh data."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from validation.paper.colours import METHOD_LINES
from validation.paper.experiments import Comparison
from validation.paper.machines import NOISE_STD
from validation.paper.methods import METHODS
from workflow.figures import style

_MEASURED = style.MEASURED_LINE | {"lw": 2.4, "alpha": 0.6}


def draw_gobf_run(shown: Comparison) -> Figure:
    """Fig. 5: measured tip and GOBF's free run, and what is left."""
    record = shown.trial.fresh
    time, measured = record.time_s, record.output[:, 0]
    with style.house_style():
        figure = style.new_figure(4.9)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.7, 1.0])
        _overlay(upper, shown, "GOBF")
        upper.set_title(f"Fresh data, GOBF: fit {shown.scores['GOBF'].fit_percent:.1f} %")
        residual = {**style.MEASURED_LINE, "lw": 0.7}
        lower.plot(time, measured - shown.simulated["GOBF"], **residual, label="measured - simulated")
        sensor = "±2 standard deviations of the sensor noise"
        lower.axhspan(-2 * NOISE_STD, 2 * NOISE_STD, **style.BAND, zorder=0, label=sensor)
        lower.set_ylabel("residual [m]")
        lower.set_xlabel("time [s]")
        upper.set_xlim(time[0], time[-1])
        figure.align_ylabels()
        style.finish(figure, [upper, lower], columns=4)
    return figure


def draw_peer_runs(shown: Comparison) -> Figure:
    """Fig. 6: the same for ARX, ARMAX and OE, one panel each on the same axes."""
    measured = shown.trial.fresh.output[:, 0]
    names = METHODS[1:]
    with style.house_style():
        figure = style.new_figure(7.0)
        panels = figure.subplots(len(names), 1, sharex=True, sharey=True)
        for axes, name in zip(panels, names, strict=True):
            _overlay(axes, shown, name)
            fit = shown.scores[name].fit_percent
            words = f"fit {fit:.1f} %" if np.isfinite(fit) else "runs away"
            axes.set_title(f"Fresh data, {name}: {words}")
        span = float(np.ptp(measured))
        # A run that leaves the measured range by far is not worth making the others unreadable for.
        panels[0].set_ylim(measured.min() - 0.6 * span, measured.max() + 0.6 * span)
        panels[0].set_xlim(0, shown.trial.fresh.time_s[-1])
        panels[-1].set_xlabel("time [s]")
        style.finish(figure, panels, columns=4)
    return figure


def _overlay(axes: Axes, shown: Comparison, name: str) -> None:
    time = shown.trial.fresh.time_s
    axes.plot(time, shown.trial.fresh.output[:, 0], **_MEASURED, label="measured")
    simulated = np.clip(shown.simulated[name], -1e3, 1e3)
    axes.plot(time, simulated, **METHOD_LINES[name], label=f"{name}, free run")
    axes.set_ylabel("tip [m]")
