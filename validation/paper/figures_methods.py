"""Figs. 2 to 7 redrawn: frequency responses, in the paper's decibels and degrees, and free runs.

One line per method, the same in every picture, in the house colours: those of the controller and the closed
loop are free here, since the page has neither. Green is OE and vermilion is what the paper did. Dashes differ
too (ARX thin, ARMAX thick, OE dash-dotted, as in the paper), so that a grey print reads.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ident.data.arrays import ComplexArray, RealArray
from ident.uncertainty import FrequencyUncertainty
from validation.paper.bounds import BoundsStudy
from validation.paper.experiments import Comparison, PaperResults
from validation.paper.machines import NOISE_STD
from validation.paper.methods import JUDGED_BAND_RAD_S, METHODS
from workflow.figures import style
from workflow.figures.bands import response_band, unwrapped_degrees
from workflow.figures.description import Panel, Picture, new_picture

# Colour of what follows the paper's own way.
PAPER_WAY = style.ACHIEVED
# Colour of what follows ours.
OUR_WAY = style.MODEL

# Looks of the methods.
METHOD_LINES: dict[str, dict[str, Any]] = {
    "GOBF": {"color": style.MODEL, "lw": 1.6},
    "ARX": {"color": style.HIGHLIGHT, "lw": 1.2, "ls": (0, (3, 2))},
    "ARMAX": {"color": style.LIMIT, "lw": 2.0, "ls": (0, (6, 3))},
    "OE": {"color": style.PREDICTED, "lw": 1.6, "ls": (0, (6, 2, 1.5, 2))},
}
# The true response, under all others.
TRUTH_LINE: dict[str, Any] = {"color": style.REFERENCE, "lw": 3.0, "alpha": 0.35}
# GOBF by the paper's own search.
RECIPE_LINE: dict[str, Any] = {"color": PAPER_WAY, "lw": 1.2, "ls": (0, (2, 2))}
# The measured output.
_MEASURED = style.MEASURED_LINE | {"lw": 2.4, "alpha": 0.6}

# Where the phases of two curves are brought to the same turn.
_COMMON_TURN_RAD_S = (0.5, 5.0)


# Entry in the legend -> response (F,) and its line.
Curves = dict[str, tuple[ComplexArray, dict[str, Any]]]


def draw_simulation(results: PaperResults) -> Picture:
    """Fig. 2: the simulated plant, GOBF as we search, and GOBF as the paper searched."""
    shown = results.simulation
    omega = shown.omega_rad_s
    ours = shown.models["GOBF"].frequency_response(omega)
    curves: Curves = {
        "simulated plant": (shown.truth, TRUTH_LINE),
        "GOBF, DIRECT alone in (x, beta, gamma)": (results.recipe.frequency_response(omega), RECIPE_LINE),
        "GOBF, poles by flexlink": (ours, METHOD_LINES["GOBF"]),
    }
    return _bode(shown, curves, "Simulation: plant and GOBF model of order 4")


def draw_simulation_peers(results: PaperResults) -> Picture:
    """Fig. 3: the same plant with ARX, ARMAX and OE from the usual starts."""
    shown = results.simulation
    curves = {"simulated plant": (shown.truth, TRUTH_LINE)} | _methods(shown, METHODS[1:])
    return _bode(shown, curves, "Simulation: plant and ARX, ARMAX, OE of order 4, usual starts")


def draw_experiment(results: PaperResults) -> Picture:
    """Fig. 4: the nonlinear arm's models, and the linear arm for truth."""
    shown = results.experiment
    curves = {"true linear arm": (shown.truth, TRUTH_LINE)} | _methods(shown, METHODS)
    return _bode(shown, curves, "Experiment (nonlinear arm): models of order 4")


def _methods(shown: Comparison, names: tuple[str, ...]) -> Curves:
    omega = shown.omega_rad_s
    return {name: (shown.models[name].frequency_response(omega), METHOD_LINES[name]) for name in names}


def _bode(shown: Comparison, curves: Curves, title: str) -> Picture:
    omega = shown.omega_rad_s
    reference, _ = next(iter(curves.values()))
    picture, (gain, phase) = new_picture(6.0, 2, 1, sharex=True, height_ratios=[1.25, 1.0])
    for label, (response, line) in curves.items():
        gain.plot(omega, decibels(np.abs(response)), **line, label=label)
        phase.plot(omega, _phase(omega, response, reference), **line)
    _frequency_axes(gain, phase, omega)
    gain.set(title=title, ylabel=f"gain [dB re 1 {shown.machine.gain_unit}]")
    phase.set(ylabel="phase [deg]")
    phase.y.every = 180.0
    return picture


def draw_gobf_run(shown: Comparison) -> Picture:
    """Fig. 5: measured tip and GOBF's free run, and what is left."""
    record = shown.trial.fresh
    time = record.time_s
    measured = record.output[:, 0]
    picture, (upper, lower) = new_picture(4.9, 2, 1, sharex=True, height_ratios=[1.7, 1.0])
    _overlay(upper, shown, "GOBF")
    residual = {**style.MEASURED_LINE, "lw": 0.7}
    lower.plot(time, measured - shown.simulated["GOBF"], **residual, label="measured - simulated")
    sensor = "±2 standard deviations of the sensor noise"
    lower.axhspan(-2 * NOISE_STD, 2 * NOISE_STD, **style.BAND, zorder=0, label=sensor)
    lower.set(xlabel="time [s]", ylabel="residual [m]")
    fit = shown.scores["GOBF"].fit_percent
    upper.set(title=f"Fresh data, GOBF: fit {fit:.1f} %", xlim=(time[0], time[-1]))
    return picture


def draw_peer_runs(shown: Comparison) -> Picture:
    """Fig. 6: the same for ARX, ARMAX and OE, one panel each on the same axes."""
    measured = shown.trial.fresh.output[:, 0]
    names = METHODS[1:]
    picture, panels = new_picture(7.0, len(names), 1, sharex=True, sharey=True)
    for panel, name in zip(panels, names, strict=True):
        _overlay(panel, shown, name)
        fit = shown.scores[name].fit_percent
        words = f"fit {fit:.1f} %" if np.isfinite(fit) else "runs away"
        panel.set_title(f"Fresh data, {name}: {words}")
    span = float(np.ptp(measured))
    # A run that leaves the measured range by far is not worth making the others unreadable for.
    panels[0].set(ylim=(measured.min() - 0.6 * span, measured.max() + 0.6 * span))
    panels[0].set(xlim=(0, shown.trial.fresh.time_s[-1]))
    panels[-1].set(xlabel="time [s]")
    return picture


def _overlay(panel: Panel, shown: Comparison, name: str) -> None:
    time = shown.trial.fresh.time_s
    panel.plot(time, shown.trial.fresh.output[:, 0], **_MEASURED, label="measured")
    simulated = np.clip(shown.simulated[name], -1e3, 1e3)
    panel.plot(time, simulated, **METHOD_LINES[name], label=f"{name}, free run")
    panel.set(ylabel="tip [m]")


def draw_bounds(study: BoundsStudy, gain_unit: str) -> Picture:
    """Fig. 7: two-sigma bounds of both recipes on one record, the truth, and its distance from the centre."""
    colours = {"classical": PAPER_WAY, "tangent": OUR_WAY}
    picture, grid = new_picture(7.4, 3, 2, sharex=True, sharey="row", height_ratios=[1.5, 1.1, 0.9])
    floor = decibels(np.abs(study.truth).min()) - 20
    for column, (name, bound) in enumerate(study.bounds.items()):
        gain, phase, distance = grid[:, column]
        _band(gain, phase, bound, study.truth, colours[name], name, float(floor))
        distance.axhspan(1e-3, 1.0, color=colours[name], alpha=0.15, lw=0)
        for values, words, line in (
            (study.distance[name], "distance, this record", {"ls": "-"}),
            (study.distance_frictionless[name], "distance, same arm without friction", {"ls": ":"}),
        ):
            shown = np.maximum(values, 1e-3)
            distance.plot(study.omega_rad_s, shown, color=style.REFERENCE, lw=1.2, **line, label=words)
        distance.set(yscale="log")
        _frequency_axes(gain, distance, study.omega_rad_s)
        share = study.inside_percent[name][0]
        low, high = JUDGED_BAND_RAD_S
        gain.set_title(f"{name}: truth inside at {share:.0f} % of {low:.0f} to {high:.0f} rad/s")
    gain, phase, distance = grid[:, 0]
    highest = decibels(np.abs(study.truth).max())
    span = unwrapped_degrees(study.truth)
    gain.set(ylabel=f"gain [dB re 1 {gain_unit}]", ylim=(floor, highest + 10))
    phase.set(ylabel="phase [deg]", ylim=(span.min() - 200, span.max() + 100))
    phase.y.every = 180.0
    largest = max(float(values.max()) for values in study.distance.values())
    distance.set(ylabel="distance of\ntruth [2 sigma]", ylim=(0.05, max(100.0, 1.5 * largest)))
    return picture


def _band(
    gain: Panel,
    phase: Panel,
    bound: FrequencyUncertainty,
    truth: ComplexArray,
    colour: str,
    name: str,
    floor: float,
) -> None:
    """Draw centre and band of a bound with the truth; floor: decibels below which the gain is not shown."""
    band = response_band(bound)
    low = np.maximum(decibels(np.maximum(band.gain_low, 1e-300)), floor - 50)
    fill: dict[str, Any] = {"color": colour, "alpha": 0.35, "lw": 0}
    omega = band.omega_rad_s
    gain.fill_between(omega, low, decibels(band.gain_high), **fill, label=f"2 sigma, {name}")
    gain.plot(omega, decibels(band.gain), color=colour, lw=1.4, label=f"centre, {name}")
    gain.plot(omega, decibels(np.abs(truth)), **TRUTH_LINE, label="true linear arm")
    turn = _turn(omega, band.phase_deg, unwrapped_degrees(truth))
    phase.fill_between(omega, band.phase_low_deg + turn, band.phase_high_deg + turn, **fill)
    phase.plot(omega, band.phase_deg + turn, color=colour, lw=1.4)
    phase.plot(omega, unwrapped_degrees(truth), **TRUTH_LINE)


def _frequency_axes(top: Panel, bottom: Panel, omega: RealArray) -> None:
    top.set(xscale="log", xlim=(omega[0], omega[-1]))
    top.hertz = True
    bottom.set(xlabel="frequency [rad/s]")


def _phase(omega: RealArray, response: ComplexArray, reference: ComplexArray) -> RealArray:
    phase = unwrapped_degrees(response)
    target = unwrapped_degrees(reference)
    return phase + _turn(omega, phase, target)


def _turn(omega: RealArray, phase: RealArray, target: RealArray) -> float:
    """Whole turns that bring a phase nearest to the target at low frequency, where all models know it."""
    near = (omega >= _COMMON_TURN_RAD_S[0]) & (omega <= _COMMON_TURN_RAD_S[1])
    return float(360 * np.round(np.median(target[near] - phase[near]) / 360))


def decibels(gain: Any) -> Any:
    """20 log10."""
    return 20 * np.log10(gain)
