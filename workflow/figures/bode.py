"""Responses over frequency: with the bands of their ellipses, beside noise and nonlinear distortion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ident.basis.model import GobfModel
from ident.data.distortion import Distortion
from ident.uncertainty import FrequencyUncertainty
from workflow.figures import style
from workflow.figures.bands import (
    Real,
    ResponseBand,
    degrees_near,
    enlargement,
    extremes,
    response_band,
)
from workflow.figures.description import Panel, Picture, X, new_picture, pad_limits, small_multiples
from workflow.figures.nyquist import loop_of
from workflow.figures.subjects import ChannelView, RunView
from workflow.tasks.results import UncertainMember
from workflow.text.formats import margin, share

# A response without a model.
_DOTS: dict[str, Any] = {
    "color": style.MEASURED,
    "ls": "none",
    "marker": ".",
    "ms": 4.0,
    "alpha": 0.55,
    "mew": 0,
}
# Foot of an area on a log axis, which has no 0 [%]: below every ellipse.
_FOOT = 1e-12
# Least upper end of the sizes of ellipses [%]: the line of those as large as the response is in view.
_LEAST_TOP = 200.0
# Ends of parts of the frequency axis whose smallest and largest dot are drawn: a part is two dots wide.
_PARTS = 151
# The nominal model, thin and dashed over the ellipses.
_NOMINAL: dict[str, Any] = {"color": style.REFERENCE, "lw": 1.0, "ls": (0, (2, 2))}


@style.drawing("bode")
def draw_channel(channel: ChannelView, name: str, part: UncertainMember | None = None) -> Picture:
    """Identified response of a channel, its nominal model, and what the records say without one.

    Parameters
    ----------
    channel : ChannelView
    name : str
        Of the channel, for the title.
    part : UncertainMember, optional
        A further part of its set, in place of the first.
    """
    spread = channel.spread
    if part is not None:
        frequency = part.posterior.at(spread.frequency.omega_rad_s, spread.level)
        spread = replace(spread, nominal=part.nominal, frequency=frequency)
    signals = f"{style.plain(channel.found.input, 26)} to {style.plain(channel.found.output, 26)}"
    return draw_bode(
        spread.frequency,
        f"{style.plain(name, 26)}: {signals}",
        style.ratio_unit(channel.units[1], channel.units[0]),
        model=spread.nominal,
        empirical=spread.empirical,
    )


@style.drawing("response")
def draw_response(channel: ChannelView) -> Picture:
    """Gain and phase side by side with the band of the ellipses, lightly damped modes marked.

    The bands are drawn enlarged where that of the gain is too narrow to be seen.
    """
    identified = channel.found
    spread = channel.spread
    picture, (gain, phase) = new_picture(4.4, 1, 2, width_in=12.0)
    for panel, quantity in ((gain, "gain{}"), (phase, "phase{}_deg")):
        band = draw_enlarged(panel, spread.frequency, quantity)
        for number, (_, mode) in enumerate(channel.light, 1):
            if band.omega_rad_s[0] < mode.omega_rad_s < band.omega_rad_s[-1]:
                style.tag_below(panel, mode.omega_rad_s, f"mode {number}")
    unit = style.plain(style.ratio_unit(channel.units[1], channel.units[0]), 24)
    lowest_gain = _gain_floor(band.gain)
    gain.set(yscale="log", ylabel=f"gain [{unit}]", ylim=(lowest_gain, 3 * band.gain.max()))
    phase.set(ylabel="phase [deg]")
    lowest_deg = float(band.phase_deg.min())
    highest_deg = float(band.phase_deg.max())
    phase.set(ylim=pad_limits(lowest_deg, highest_deg, 0.15))
    input_name = style.plain(identified.input, 26)
    output_name = style.plain(identified.output, 26)
    gain.set_title(f"{input_name} to {output_name}")
    return picture


def draw_enlarged(panel: Panel, response: FrequencyUncertainty, quantity: str = "gain{}") -> ResponseBand:
    """Gain or phase over rad/s with its band, enlarged where that of the gain is too narrow to be seen.

    Parameters
    ----------
    panel : Panel
        That is drawn on.
    response : FrequencyUncertainty
    quantity : str
        Names of fields of `ResponseBand`, with a place for _low and _high.

    Returns
    -------
    ResponseBand
        What was drawn, not enlarged.
    """
    band = response_band(response)
    factor = enlargement(band)
    centre, *ends = (getattr(band, quantity.format(end)) for end in ("", "_low", "_high"))
    low, high = (centre + factor * (end - centre) for end in ends)
    # Where the ellipse holds the origin the lower end of its gain is 0, which a log axis cannot show.
    if quantity == "gain{}":
        low = np.maximum(low, 1e-3 * centre)
    label = f"{share(response.level)} band"
    if factor > 1:
        label += f", enlarged {factor} times"
    panel.fill_between(band.omega_rad_s, low, high, **style.BAND, label=label)
    panel.plot(band.omega_rad_s, centre, **style.MODEL_LINE, label="identified response (centre)")
    panel.set(xscale="log", xlabel="frequency [rad/s]", xlim=(band.omega_rad_s[0], band.omega_rad_s[-1]))
    return band


def draw_bode(
    uncertainty: FrequencyUncertainty,
    title: str,
    unit: str,
    *,
    model: GobfModel | None = None,
    empirical: FrequencyUncertainty | None = None,
    dB: bool = False,
    Hz: bool = False,
) -> Picture:
    """Gain, phase and relative size of the ellipses over frequency.

    The band is the range of gain and phase over each frequency's ellipse, not over all of them jointly.

    Parameters
    ----------
    uncertainty : FrequencyUncertainty
        Ellipses of the response.
    title, unit : str
        Of the picture, and of the gain.
    model : GobfModel, optional
        Drawn as a line.
    empirical : FrequencyUncertainty, optional
        A response without a model, drawn as dots.
    dB, Hz : bool
        One scale in dB or Hz; without, absolute gain and rad/s with dB and Hz on the far sides.
    """
    picture, (gain, phase, size) = new_picture(7.0, 3, 1, sharex=True, height_ratios=[1.5, 1.1, 0.8])
    x, y = _units(dB, Hz)

    # Gain and phase with their bands.
    label = f"{share(uncertainty.level)} ellipses"
    look = style.MODEL_LINE | {"label": "identified response (centre)"}
    measured = np.abs(empirical.centre) if empirical else None
    band = _draw(gain, phase, uncertainty, look, style.BAND | {"label": label}, measured, dB=dB, Hz=Hz)
    omega = band.omega_rad_s
    if empirical is not None:
        # Evenly spread on the log axis: the thousands of a long record hide each other. Of each part the
        # smallest and the largest, so that no peak is lost.
        shown = (empirical.omega_rad_s >= omega[0]) & (empirical.omega_rad_s <= omega[-1])
        at = empirical.omega_rad_s[shown]
        response = empirical.centre[shown]
        # It may have been taken at other frequencies altogether.
        if at.size:
            parts = np.geomspace(omega[0], omega[-1], _PARTS)
            index = extremes(at, np.abs(response), parts)
            at = at[index]
            response = response[index]
        lowest_gain = _gain_floor(band.gain, measured)
        seen = y(np.maximum(np.abs(response), lowest_gain))
        gain.plot(x(at), seen, **_DOTS, label="records, no model", zorder=1)
        # A measured phase is known but for whole turns.
        phase_deg = degrees_near(response, np.interp(at, omega, band.phase_deg))
        phase.plot(x(at), phase_deg, **_DOTS, zorder=1)
    if model is not None:
        response = model.frequency_response(omega)
        gain.plot(x(omega), y(np.abs(response)), **_NOMINAL, label="nominal model")
        phase.plot(x(omega), degrees_near(response, band.phase_deg), **_NOMINAL)
    _frame(gain, phase, style.plain(unit, 24), band, measured=measured, dB=dB, Hz=Hz)
    gain.set_title(title)

    # Below: how large each ellipse is beside the response.
    # The band leaves out a frequency of 0 as well, which a log axis does not have.
    above_zero = uncertainty.omega_rad_s > 0
    relative = 100 * uncertainty.ellipse().semi_major[above_zero] / band.gain
    size.fill_between(x(omega), np.full_like(relative, _FOOT), relative, **style.BAND)
    size.plot(x(omega), relative, color=style.UNCERTAIN, lw=1.3)
    size.axhline(100, **style.LIMIT_LINE, label="ellipse as large as the response")
    size.set(yscale="log")
    can_be_drawn = np.isfinite(relative) & (relative > 0)
    finite = relative[can_be_drawn]
    if finite.size:
        highest = max(_LEAST_TOP, 2 * float(finite.max()))
        lowest_decade = np.floor(np.log10(finite.min()))
        size.set(ylim=(10**lowest_decade, highest))
    size.set(xlabel=phase.labels[X], ylabel="ellipse / gain [%]")
    phase.set(xlabel="")
    return picture


def draw_comparison(
    responses: Mapping[str, FrequencyUncertainty],
    *,
    dB: bool = False,
    Hz: bool = False,
) -> Picture:
    """Gain and phase of several responses, with bands where they have ellipses.

    Parameters
    ----------
    responses : mapping of str to FrequencyUncertainty
        By the name in the legend; all with gains of one unit.
    dB, Hz : bool
        One scale in dB or Hz; without, absolute gain and rad/s with dB and Hz on the far sides.
    """
    picture, (gain, phase) = new_picture(6.0, 2, 1, sharex=True, height_ratios=[1.4, 1.0])
    colours = (style.MODEL, style.ACHIEVED, style.PREDICTED, style.LIMIT, style.HIGHLIGHT, style.MEASURED)
    # Colours first, then dashes: eighteen responses differ in one or the other.
    lines = ("-", (0, (5, 2)), (0, (1, 1.5)))
    bands = []
    for k, (name, response) in enumerate(responses.items()):
        colour = colours[k % len(colours)]
        dashes = lines[k // len(colours) % len(lines)]
        drawn: dict[str, Any] = {"color": colour, "lw": 1.4, "ls": dashes, "label": style.plain(name, 40)}
        filled: dict[str, Any] = {"color": colour, "alpha": 0.25, "lw": 0}
        bands.append(_draw(gain, phase, response, drawn, filled, dB=dB, Hz=Hz))
    _frame(gain, phase, "as logged", *bands, dB=dB, Hz=Hz)
    gain.set_title("Responses compared")
    return picture


@style.drawing("bode-loop")
def draw_loop(run: RunView) -> Picture:
    """Controller and loop gain of a run, the loop with its ellipses, crossovers and margins."""
    loop = loop_of(run)
    law = replace(
        loop, centre=run.controller.response(loop.omega_rad_s), covariance=np.zeros_like(loop.covariance)
    )
    delay = run.controller.computational_delay_samples
    picture, grid = new_picture(6.4, 2, 2, sharex=True, height_ratios=[1.3, 1.0])
    filled = style.BAND | {"label": f"{share(loop.level)} ellipses"}
    for (gain, phase), response, of, title in zip(
        grid.T,
        (law, loop),
        (style.ratio_unit(run.input_unit, run.output_unit), "1"),
        ("Controller K with its computational delay" if delay else "Controller K", "Loop K G"),
        strict=True,
    ):
        band = _draw(gain, phase, response, style.PREDICTED_LINE | {"label": "nominal"}, filled)
        _frame(gain, phase, style.plain(of, 24), band)
        gain.set_title(title)
    _mark_margins(gain, phase, band)
    return picture


def _mark_margins(gain: Panel, phase: Panel, loop: ResponseBand) -> None:
    """Mark the crossovers of a nominal loop with its gain and phase margin.

    The margins are those that python-control finds; one that does not exist is left out.
    """
    # Imported here: it brings a plotting library with it.
    import control

    margins = control.stability_margins((loop.gain, loop.phase_deg, loop.omega_rad_s))
    factor, degrees, _, at_phase, at_gain, _ = (float(value) for value in margins)
    limits: dict[str, Any] = {"color": style.MEASURED, "lw": 0.8, "ls": ":"}
    gain.axhline(1, **limits)
    look: dict[str, Any] = {"lw": 1.6, "marker": "o", "ms": 4}
    if np.isfinite(at_gain):
        here = float(np.interp(at_gain, loop.omega_rad_s, loop.phase_deg))
        phase.axhline(here - degrees, **limits)
        label = f"gain crossover at {at_gain:.3g} rad/s: phase margin {margin(degrees)} deg"
        phase.plot([at_gain] * 2, [here - degrees, here], color=style.ACHIEVED, label=label, **look)
        gain.plot([at_gain], [1], color=style.ACHIEVED, ls="none", **look)
    if np.isfinite(at_phase):
        gain_db = float(style.decibels(factor))
        label = f"phase crossover at {at_phase:.3g} rad/s: gain margin {margin(gain_db)} dB"
        gain.plot([at_phase] * 2, [1 / factor, 1], color=style.LIMIT, label=label, **look)


def _units(dB: bool, Hz: bool) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Functions of a frequency [rad/s] and of an absolute gain to their values on the axes."""

    def frequency(omega: Any) -> Any:
        return omega / (2 * np.pi) if Hz else omega

    return frequency, style.decibels if dB else np.asarray


def _draw(
    gain: Panel,
    phase: Panel,
    response: FrequencyUncertainty,
    look: Mapping[str, Any],
    filled: Mapping[str, Any],
    measured: Real | None = None,
    *,
    dB: bool = False,
    Hz: bool = False,
) -> ResponseBand:
    """Draw a response as a line, and where it has ellipses as a band of gain and phase.

    look, filled: looks of line and band; measured: gains (F,) that are in view, too. Returns the band.
    """
    band = response_band(response)
    x, y = _units(dB, Hz)
    at = x(band.omega_rad_s)
    floor = _gain_floor(band.gain, measured)
    if np.any(response.covariance):
        low = np.maximum(band.gain_low, floor)
        gain.fill_between(at, y(low), y(band.gain_high), **filled)
        phase.fill_between(at, band.phase_low_deg, band.phase_high_deg, **filled)
    gain.plot(at, y(band.gain), **look)
    phase.plot(at, band.phase_deg, **look)
    return band


def _frame(
    gain: Panel,
    phase: Panel,
    unit: str,
    *bands: ResponseBand,
    measured: Real | None = None,
    dB: bool = False,
    Hz: bool = False,
) -> None:
    """Scales and labels of gain and phase: absolute and rad/s, dB and Hz on the far sides, or one alone."""
    x, y = _units(dB, Hz)
    phases = np.concatenate([band.phase_deg for band in bands])
    lowest = float(x(min(band.omega_rad_s[0] for band in bands)))
    highest = float(x(max(band.omega_rad_s[-1] for band in bands)))
    gain_unit = "dB" if dB else unit
    frequency_unit = "Hz" if Hz else "rad/s"
    gain.set(xscale="log", yscale="lin" if dB else "log", ylabel=f"gain [{gain_unit}]")
    phase.set(xscale="log", ylabel="phase [deg]", xlabel=f"frequency [{frequency_unit}]")
    for panel in (gain, phase):
        panel.set(xlim=(lowest, highest))
    lowest_gain = min(_gain_floor(band.gain, measured) for band in bands)
    gain.set(ylim=(float(y(lowest_gain)), None))

    # A number of the phase axis every quarter, half or whole turn, as many as fit.
    span = np.ptp(phases)
    if span < 400:
        phase.y.every = 90.0
    elif span < 1000:
        phase.y.every = 180.0
    else:
        phase.y.every = 360.0
    phase.set(ylim=pad_limits(float(phases.min()), float(phases.max()), 0.15))
    # The other unit on the far side.
    if not Hz:
        gain.hertz = True
    if not dB:
        gain.decibel = True


def _gain_floor(gain: Real, empirical: Real | None = None) -> float:
    """Bottom of the gain axis: below the response, above the noise of an empirical response at a notch."""
    smallest = float(np.min(gain, where=gain > 0, initial=gain.max() or 1.0))
    floor = smallest
    positive = gain
    if empirical is not None:
        is_positive = empirical > 0
        positive = empirical[is_positive]
    if positive.size:
        floor = min(smallest, float(np.percentile(positive, 2)))
    return floor / 3


@style.drawing("distortion")
def draw_distortion(found: Sequence[Distortion], units: tuple[str, str]) -> Picture | None:
    """Best linear approximation, and what scatters around it at every line, as measured.

    Points above the line of the noise are distortion.

    Parameters
    ----------
    found : sequence of Distortion
        Levels by amplitude.
    units : tuple of two str
        Of input and output.

    Returns
    -------
    Picture or None
        None where no record is periodic.
    """
    if not found:
        return None
    columns = min(len(found), 3)
    picture, places = small_multiples(len(found), columns, 3.9, 0.6, sharex=True, sharey=True)
    for panel, levels in zip(places, found, strict=True):
        omega = levels.omega_rad_s
        panel.plot(omega, np.abs(levels.gain), **style.MODEL_LINE, label="gain, best linear approximation")
        if levels.noise_std is not None:
            noise = levels.noise_std / np.sqrt(levels.periods)
            panel.plot(omega, noise, **style.MEASURED_LINE | {"lw": 1.6}, label="noise, mean of the periods")
        for lines, marker, colour, label in (
            (levels.even, "x", style.LIMIT, "even detection line"),
            (levels.excited, ".", style.PREDICTED, "between realisations"),
            (levels.odd, "o", style.ACHIEVED, "odd detection line"),
        ):
            if lines is not None:
                dots: dict[str, Any] = {"ls": "none", "marker": marker, "ms": 3.5, "mew": 0.7}
                panel.plot(lines.omega_rad_s, np.sqrt(lines.power), color=colour, label=label, **dots)
        panel.set(xscale="log", yscale="log")
        input_unit = style.plain(units[0], 10)
        # Without a unit there are two blanks.
        panel.set_title(f"{levels.rms:.3g} {input_unit} rms".replace("  ", " "))
        panel.hertz = True
        panel.set(xlabel="frequency [rad/s]")
    places[0].set(ylabel=f"level [{style.ratio_unit(units[1], units[0])}]")
    return picture
