"""Responses over frequency: with the bands of their ellipses, beside noise and nonlinear distortion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from ident.basis.model import GobfModel
from ident.data.distortion import Distortion
from ident.uncertainty import FrequencyUncertainty
from workflow.figures import style
from workflow.figures.bands import Complex, Real, degrees_near, enlargement, response_band
from workflow.figures.subjects import ChannelView
from workflow.text.formats import share

_DOTS: dict[str, Any] = {
    "color": style.MEASURED,
    "ls": "none",
    "marker": ".",
    "ms": 4.0,
    "alpha": 0.55,
    "mew": 0,
}
_NOMINAL: dict[str, Any] = {"color": style.REFERENCE, "lw": 1.0, "ls": (0, (2, 2))}


@style.drawing("bode")
def draw_channel(channel: ChannelView, name: str) -> Figure:
    """Identified response of a channel, its nominal model, and what the records say without one."""
    found, spread = channel.found, channel.spread
    signals = f"{style.plain(found.input, 26)} to {style.plain(found.output, 26)}"
    return draw_bode(
        spread.frequency,
        f"{style.plain(name, 26)}: {signals}",
        style.ratio_unit(channel.units[1], channel.units[0]),
        model=spread.nominal,
        empirical=spread.empirical,
    )


@style.drawing("response")
def draw_response(channel: ChannelView) -> Figure:
    """Gain and phase side by side with the band of the ellipses, lightly damped modes marked.

    The band of the gain is drawn enlarged where it is too narrow to be seen.
    """
    found, spread = channel.found, channel.spread
    band = response_band(spread.frequency)
    omega, factor = band.omega_rad_s, enlargement(band)
    figure, (gain, phase) = style.panels(4.4, 1, 2, width_in=12.0)
    floor = _gain_floor(band.gain, np.empty(0))
    label = f"{share(spread.frequency.level)} band" + (f", enlarged {factor} times" if factor > 1 else "")
    for axes, centre, low, high in (
        (gain, band.gain, band.gain_low, band.gain_high),
        (phase, band.phase_deg, band.phase_low_deg, band.phase_high_deg),
    ):
        ends = [centre + factor * (end - centre) for end in (low, high)]
        if axes is gain:
            ends[0] = np.maximum(ends[0], floor)
        axes.fill_between(omega, *ends, **style.BAND, label=label)
        axes.plot(omega, centre, **style.MODEL_LINE, label="identified response (centre)")
        for number, (_, mode) in enumerate(channel.light, 1):
            if omega[0] < mode.omega_rad_s < omega[-1]:
                style.tag_below(axes, mode.omega_rad_s, f"mode {number}")
        axes.set(xscale="log", xlabel="frequency [rad/s]", xlim=(omega[0], omega[-1]))
    unit = style.plain(style.ratio_unit(channel.units[1], channel.units[0]), 24)
    gain.set(yscale="log", ylabel=f"gain [{unit}]", ylim=(floor, 3 * band.gain.max()))
    phase.set_ylabel("phase [deg]")
    phase.set_ylim(*style.pad_limits(float(band.phase_deg.min()), float(band.phase_deg.max()), 0.15))
    gain.set_title(f"{style.plain(found.input, 26)} to {style.plain(found.output, 26)}")
    return figure


@style.finished
def draw_bode(
    uncertainty: FrequencyUncertainty,
    title: str,
    unit: str,
    *,
    model: GobfModel | None = None,
    empirical: FrequencyUncertainty | None = None,
) -> Figure:
    """Gain [unit], phase and relative size of the ellipses over frequency; `empirical` as dots.

    The band is the range of gain and phase over each frequency's ellipse, not over all of them jointly.
    """
    band = response_band(uncertainty)
    omega = band.omega_rad_s
    figure, (gain, phase, size) = style.panels(7.0, 3, 1, sharex=True, height_ratios=[1.5, 1.1, 0.8])
    floor = _gain_floor(band.gain, np.abs(empirical.centre) if empirical else np.empty(0))
    if empirical is not None:
        inside = (empirical.omega_rad_s >= omega[0]) & (empirical.omega_rad_s <= omega[-1])
        at, response = _thinned(empirical.omega_rad_s[inside], empirical.centre[inside])
        label = "straight from the records, no model"
        gain.plot(at, np.maximum(np.abs(response), floor), **_DOTS, label=label)
        phase.plot(at, degrees_near(response, np.interp(at, omega, band.phase_deg)), **_DOTS)
    label = f"{share(uncertainty.level)} ellipses"
    gain.fill_between(omega, np.maximum(band.gain_low, floor), band.gain_high, **style.BAND, label=label)
    phase.fill_between(omega, band.phase_low_deg, band.phase_high_deg, **style.BAND)
    gain.plot(omega, band.gain, **style.MODEL_LINE, label="identified response (centre)")
    phase.plot(omega, band.phase_deg, **style.MODEL_LINE)
    if model is not None:
        response = model.frequency_response(omega)
        gain.plot(omega, np.abs(response), **_NOMINAL, label="nominal model")
        phase.plot(omega, degrees_near(response, band.phase_deg), **_NOMINAL)
    gain.set(xscale="log", yscale="log", ylabel=f"gain [{style.plain(unit, 24)}]")
    gain.set_ylim(bottom=floor)
    gain.set_title(title)
    phase.set_ylabel("phase [deg]")
    span = np.ptp(band.phase_deg)
    phase.yaxis.set_major_locator(MultipleLocator(90 if span < 400 else 180 if span < 1000 else 360))
    phase.set_ylim(*style.pad_limits(float(band.phase_deg.min()), float(band.phase_deg.max()), 0.15))
    relative = 100 * uncertainty.ellipse().semi_major[uncertainty.omega_rad_s > 0] / band.gain
    size.fill_between(omega, np.full_like(relative, 1e-12), relative, **style.BAND)
    size.plot(omega, relative, color=style.UNCERTAIN, lw=1.3)
    size.axhline(100, **style.LIMIT_LINE, label="ellipse as large as the response itself")
    size.set_yscale("log")
    finite = relative[np.isfinite(relative) & (relative > 0)]
    if finite.size:
        size.set_ylim(10 ** np.floor(np.log10(finite.min())), max(200.0, 2 * float(finite.max())))
    size.set(xlabel="frequency [rad/s]", ylabel="ellipse / gain [%]")
    gain.set_xlim(omega[0], omega[-1])
    style.hertz_axis(gain)
    return figure


@style.finished
def draw_comparison(responses: Mapping[str, FrequencyUncertainty]) -> Figure:
    """Gain and phase of several responses by name, with bands where they have ellipses."""
    figure, (gain, phase) = style.panels(6.0, 2, 1, sharex=True, height_ratios=[1.4, 1.0])
    colours = (style.MODEL, style.ACHIEVED, style.PREDICTED, style.LIMIT, style.HIGHLIGHT, style.MEASURED)
    lines = ("-", (0, (5, 2)), (0, (1, 1.5)))
    for k, (name, response) in enumerate(responses.items()):
        band, colour = response_band(response), colours[k % len(colours)]
        drawn: dict[str, Any] = {"color": colour, "lw": 1.4, "ls": lines[k // len(colours) % len(lines)]}
        gain.plot(band.omega_rad_s, band.gain, **drawn, label=style.plain(name, 40))
        phase.plot(band.omega_rad_s, band.phase_deg, **drawn)
        if np.any(response.covariance):
            filled: dict[str, Any] = {"color": colour, "alpha": 0.25, "lw": 0}
            floor = _gain_floor(band.gain, np.empty(0))
            gain.fill_between(band.omega_rad_s, np.maximum(band.gain_low, floor), band.gain_high, **filled)
            phase.fill_between(band.omega_rad_s, band.phase_low_deg, band.phase_high_deg, **filled)
    gain.set(xscale="log", yscale="log", ylabel="gain [as logged]", title="Responses compared")
    phase.set(ylabel="phase [deg]", xlabel="frequency [rad/s]")
    style.hertz_axis(gain)
    return figure


def _thinned(omega_rad_s: Real, response: Complex, most: int = 300) -> tuple[Real, Complex]:
    """Points evenly spread on the log axis: the thousands of a long record hide each other."""
    if omega_rad_s.size <= most:
        return omega_rad_s, response
    wanted = np.geomspace(omega_rad_s[0], omega_rad_s[-1], most)
    index = np.unique(np.minimum(np.searchsorted(omega_rad_s, wanted), omega_rad_s.size - 1))
    return omega_rad_s[index], response[index]


def _gain_floor(gain: Real, empirical: Real) -> float:
    """Bottom of the gain axis: below the response, above the noise of an empirical response at a notch."""
    smallest = float(gain[gain > 0].min())
    positive = empirical[empirical > 0]
    return min(smallest, float(np.percentile(positive, 2)) if positive.size else smallest) / 3


@style.drawing("distortion")
def draw_distortion(found: Sequence[Distortion], units: tuple[str, str]) -> Figure | None:
    """Best linear approximation, and what scatters around it at every line, as measured: points above the
    line of the noise are distortion. units: of input and output. Nothing where no record is periodic."""
    if not found:
        return None
    columns = min(len(found), 3)
    figure, places = style.small_multiples(len(found), columns, 3.9, 0.6, sharex=True, sharey=True)
    for axes, levels in zip(places, found, strict=True):
        omega = levels.omega_rad_s
        axes.plot(omega, np.abs(levels.gain), **style.MODEL_LINE, label="gain, best linear approximation")
        if levels.noise_std is not None:
            noise = levels.noise_std / np.sqrt(levels.periods)
            axes.plot(omega, noise, **style.MEASURED_LINE | {"lw": 1.6}, label="noise, mean of the periods")
        for lines, marker, colour, label in (
            (levels.even, "x", style.LIMIT, "even detection line"),
            (levels.excited, ".", style.PREDICTED, "between realisations"),
            (levels.odd, "o", style.ACHIEVED, "odd detection line"),
        ):
            if lines is not None:
                dots: dict[str, Any] = {"ls": "none", "marker": marker, "ms": 3.5, "mew": 0.7}
                axes.plot(lines.omega_rad_s, np.sqrt(lines.power), color=colour, label=label, **dots)
        axes.set(xscale="log", yscale="log")
        axes.set_title(f"{levels.rms:.3g} {style.plain(units[0], 10)} rms".replace("  ", " "))
        style.hertz_axis(axes)
        axes.set_xlabel("frequency [rad/s]")
    places[0].set_ylabel(f"level [{style.ratio_unit(units[1], units[0])}]")
    return figure
