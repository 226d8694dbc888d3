"""How sure a model is: sizes of its ellipses, residual tests, scatter between repeats."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ident.checks.validation import ScatterRow
from ident.friction import EquivalentFriction, FrictionFit
from ident.uncertainty import FrequencyUncertainty
from workflow.config.uncertainty_options import UncertaintyOptions
from workflow.describe.facts import (
    Block,
    Heading,
    PageSection,
    Picture,
    Remarks,
    Row,
    Table,
    Text,
    said,
    worded,
)
from workflow.describe.identification import model_numbers, sentences
from workflow.engine import codec
from workflow.tasks.results import Band, IdentifiedChannel, UncertainChannel
from workflow.text.findings.sentences import words
from workflow.text.formats import extent, frequency, listing, number, percent, share, si
from workflow.text.sentences.friction import friction_law

if TYPE_CHECKING:
    from workflow.figures.subjects import ChannelView, RunView

# Fit below which a model misses more than half of an output.
HALF_PERCENT = 50.0
# Share of the frequencies at which the nominal model has to lie inside its ellipse to need no word.
USUALLY_INSIDE_PERCENT = 90.0


def ellipse_rows(spread: UncertainChannel, *, whole: bool = True) -> tuple[Row, ...]:
    """Sizes of the ellipses by band, residual tests, and what to do about them.

    Args:
        spread: The channel.
        whole: Rows, too, that a page beside the table shows, and those that say that all is well.
    """
    rows = [worded(f"{share(spread.level)} radius of the response", f"of its gain: {_radii(spread.bands)}")]
    rows += [worded(f"the same, {part.about}", _radii(part.bands)) for part in spread.others]
    for test in spread.tests:
        if whole or not test.passed:
            outcome = "pass" if test.passed else "FAIL"
            rows.append(worded(f"residuals, {test.name}", f"{outcome}: {words(test.finding)}"))
    rows += [worded("residuals, next step", words(item)) for item in spread.advice]
    agreement = spread.agreement
    if whole or agreement.share_inside_percent < USUALLY_INSIDE_PERCENT:
        rows.append(
            worded(
                "nominal model",
                f"inside {percent(agreement.share_inside_percent)} of the ellipses; farthest "
                f"{number(agreement.largest_distance)} radii from the centre "
                f"({number(agreement.at_rad_s, 4)} rad/s)",
            )
        )
    if whole and spread.repeat_scatter:
        ratios = extent(row.ratio for row in spread.repeat_scatter)
        rows.append(worded("repeat scatter", f"{ratios} times the predicted (by band)"))
    return said(*rows)


def _radii(bands: Sequence[Band]) -> str:
    """Median radius of each band: "2.1 % (0.3-3 rad/s), 0.8 % (3-30 rad/s)"."""
    return ", ".join(
        f"{percent(band.median_radius_percent, 2)} ({number(band.from_rad_s)}-{number(band.to_rad_s)} rad/s)"
        for band in bands
    )


def described(
    options: UncertaintyOptions,
    friction: FrictionFit | None,
    input_unit: str,
    output_unit: str,
    equivalent: EquivalentFriction | None = None,
) -> str:
    """What response the ellipses of a channel are about.

    Args:
        options: Of the channel.
        friction: Identified, or None.
        input_unit: "" where nobody stated it.
        output_unit: "" where nobody stated it.
        equivalent: Viscous friction that acts like the dry one, where the ellipses are about an amplitude.
    """
    if options.response == "without friction" and friction is not None:
        varies = friction.between / friction.level if friction.level else 0
        return (
            "The ellipses describe the linear dynamics without dry friction. Friction was identified with "
            f"them: {friction_law(friction, input_unit, output_unit)}. From record to record it varies by "
            f"{share(varies)}. Viscous friction is part of the linear dynamics. Friction that depends on "
            "position or load is not modelled"
        )
    if options.response == "without remote friction":
        return (
            "The ellipses describe the linear dynamics without the dry friction of the motor's shaft, which "
            "the sensor does not see: it was told by inverse dynamics, and taken off the command. What is "
            "not known of it widens them"
        )
    if options.response == "this amplitude" and equivalent is not None and friction is not None:
        return (
            "They describe the dynamics with friction (best linear approximation) for random-phase "
            f"multisines of {si(equivalent.rms, input_unit)} rms with the spectrum of these records. "
            f"Identified: {friction_law(friction, input_unit, output_unit)}. It acts like viscous friction "
            f"of {number(equivalent.damping)} units of input per unit of speed. At smaller amplitudes it "
            "acts like more: the ellipses do not hold there"
        )
    return (
        "They describe linear dynamics. What is not linear in these records counts as noise. With friction "
        "the response depends on amplitude"
    )


def band_table(bands: Sequence[Band]) -> Table:
    """Sizes of the ellipses by band."""
    rows = tuple(
        (
            number(band.from_rad_s),
            number(band.to_rad_s),
            number(band.median_radius_percent),
            number(band.largest_radius_percent),
        )
        for band in bands
    )
    return Table(("from [rad/s]", "to [rad/s]", "median ellipse / gain [%]", "largest [%]"), rows)


def unknown_bands(bands: Sequence[Band]) -> str:
    """A warning on bands whose ellipses are larger than the response, in the median over the band.

    Returns:
        Two sentences with the bands; "" where there is none.
    """
    ranges = [
        f"{number(band.from_rad_s)} to {number(band.to_rad_s)}"
        for band in bands
        if band.median_radius_percent > 100
    ]
    if not ranges:
        return ""
    bands_named, pronoun = ("this band", "it") if len(ranges) == 1 else ("these bands", "them")
    return (
        f"From {listing(ranges)} rad/s the ellipses are larger than the response itself: gain and phase are "
        f"not known there. Excite {bands_named}, or keep the controller out of {pronoun}."
    )


def residual_blocks(channel: ChannelView) -> list[Block]:
    """Correlation of the residuals, and the tests on it: those that fail first."""
    spread = channel.spread
    whitened = f" (whitened, order {spread.noise_order})" if spread.noise_order else ""
    caption = f"Correlation of the residuals{whitened}. The test uses all lags together."
    failed = sentences(test.finding for test in spread.tests if not test.passed)
    passed = sentences(test.finding for test in spread.tests if test.passed)
    return [
        Picture("residuals", caption, (channel,), channel.file),
        Remarks(failed, "warning", "Residual tests that fail"),
        Remarks(passed, "good", "Residual tests that pass"),
    ]


def free_run_picture(channel: ChannelView) -> Picture:
    """A free run of the model beside a record."""
    used = ""
    if channel.shown_fresh is None:
        used = " There is no validation record; this one was used in the fit."
    return Picture("validation", f"Free run and residual.{used}", (channel,), channel.file)


def misses_half(record: str) -> str:
    """A warning that the model misses more than half of the output of a record."""
    return (
        f"On {record} the model misses more than half of the output. Dry friction, drift or another "
        "operating point are common causes."
    )


def uncertainty_page(view: RunView) -> PageSection:
    """How sure the models of a run of one loop are, and what the residuals say."""
    blocks: list[Block] = []
    for channel in view.channels:
        if len(view.channels) > 1:
            blocks.append(Heading(f"Channel {channel.name}"))
        blocks += _channel_blocks(channel, view)
    return PageSection("uncertainty", "How sure: ellipses and validation", "Uncertainty", tuple(blocks))


def _channel_blocks(channel: ChannelView, view: RunView) -> list[Block]:
    identified = channel.found
    spread = channel.spread
    is_control = channel is view.control
    level = share(spread.level)
    blocks: list[Block] = []
    if is_control:
        about = described(
            view.config.control_channel.uncertainty,
            view.results.identify.friction,
            *channel.units,
            view.results.uncertainty.equivalent,
        )
        blocks.append(Text(f"{about}."))
    # Without a simulation the first screen shows this response.
    if view.results.closed_loop.check is not None or not is_control:
        caption = f"Response with its {level} ellipses (method '{spread.method}')."
        blocks.append(Picture("bode", caption, (channel, channel.name), channel.file))
    blocks.append(band_table(spread.bands))
    if spread.others:
        blocks.append(
            Text(
                "The logs hardly tell a slow rate of this axis, so one ellipse would hold a gain of zero. "
                f"The set has {len(spread.members)} parts, and the controller is designed and certified for "
                f"all of them. Above: {spread.about}."
            )
        )
    for place, part in enumerate(spread.others, 2):
        caption = f"Response with its {level} ellipses, {part.about}."
        file = f"{channel.file}-part-{place}"
        blocks.append(Picture("bode", caption, (channel, channel.name, part), file))
        blocks.append(band_table(part.bands))
    agreement = spread.agreement
    blocks.append(
        Text(
            f"The nominal model lies inside {percent(agreement.share_inside_percent)} of the ellipses, at "
            f"most {number(agreement.largest_distance)} radii from the centre "
            f"({frequency(agreement.at_rad_s)})."
        )
    )
    blocks.append(Remarks((unknown_bands(spread.bands),), "warning"))
    if channel.unseen and not identified.fit_percent["validation"]:
        blocks.append(Text("Repeats show the noise; they do not test another input."))
    if channel.unseen and channel.unseen[0][1] < HALF_PERCENT and not identified.increments:
        blocks.append(Remarks((misses_half(channel.unseen[0][0]),), "warning"))
    blocks.append(free_run_picture(channel))
    if len(channel.unseen) > 1:
        rows = tuple((name, role, number(fit, 4)) for name, fit, role in channel.unseen)
        blocks.append(Table(("record", "kept as", "fit [%]"), rows))
    blocks += residual_blocks(channel)
    blocks.append(Remarks(sentences(spread.advice), "warning", "What to do about it"))
    if spread.repeat_scatter:
        blocks.append(
            Picture(
                "repeats",
                "Scatter between repeats of one experiment, beside the scatter predicted from the residuals.",
                (spread.repeat_scatter, channel.name),
                channel.file,
            )
        )
        blocks.append(_scatter_table(spread.repeat_scatter))
    return blocks


def _scatter_table(scatter: Sequence[ScatterRow]) -> Table:
    """Scatter between repeats by band; between conditions where any band tells it."""
    between = any(not math.isnan(band.between) for band in scatter)
    head = ["from [rad/s]", "to [rad/s]", "predicted / gain [%]", "measured / gain [%]"]
    head.append("measured / predicted [1]")
    if between:
        head += ["between conditions / gain [%]", "over noise alone [1]"]
    rows = []
    for band in scatter:
        cells = [
            number(band.omega_low_rad_s),
            number(band.omega_high_rad_s),
            number(100 * band.predicted),
            number(100 * band.measured),
            number(band.ratio),
        ]
        if between:
            cells += [number(100 * band.between), number(band.between_ratio)]
        rows.append(tuple(cells))
    return Table(tuple(head), tuple(rows), "Scatter is RMS over the band, one standard deviation.")


def untold_below_rad_s(found: FrequencyUncertainty) -> float:
    """Up to here an ellipse is wider than the gain, from the lowest frequency on; 0 where none is."""
    resolved = np.flatnonzero(found.enclosing_radius() < np.abs(found.centre))
    if resolved.size == 0:
        return float(found.omega_rad_s[-1])
    return float(found.omega_rad_s[resolved[0] - 1]) if resolved[0] else 0.0


def uncertainty_numbers(spread: UncertainChannel) -> dict[str, Any]:
    """The ellipses of a channel for programs, arrays left out."""
    ellipses: dict[str, Any] = codec.plain(spread, arrays=False)
    for unwanted in ("posterior", "nominal", "frequency", "empirical"):
        ellipses.pop(unwanted)
    if spread.intervals is not None:
        for row, known in zip(ellipses["intervals"]["modes"], spread.intervals.modes, strict=True):
            row["frequency_Hz"] = list(known.frequency_Hz)
    for row, test in zip(ellipses["tests"], spread.tests, strict=True):
        row["verdict"] = words(test.finding)
    for part in ellipses["others"]:
        del part["posterior"], part["nominal"]
    ellipses["advice"] = [words(item) for item in spread.advice]
    return {**ellipses, "report": codec.plain(spread.posterior.report)}


def channel_numbers(found: IdentifiedChannel, spread: UncertainChannel) -> dict[str, Any]:
    """The model of a channel and its ellipses for programs."""
    ellipses = uncertainty_numbers(spread)
    model = model_numbers(found)
    if spread.intervals is not None:
        for row, known in zip(model["modes"], spread.intervals.modes, strict=True):
            row["is_mode"] &= known.told
    return {
        **model,
        **{key: ellipses[key] for key in ("bands", "intervals", "tests", "advice", "repeat_scatter")},
    }
