"""What was found in one channel: structure, poles with their intervals, fits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ident.basis.options import IdentOptions
from ident.data.finding import Finding, FindingKind
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
from workflow.engine import codec
from workflow.tasks.results import IdentifiedChannel, Intervals, ModeInterval, ModelMode
from workflow.tasks.simulated_rig import TrueMode
from workflow.text.findings.sentences import words
from workflow.text.formats import (
    MISSING,
    count,
    extent,
    fixed,
    frequency,
    interval,
    listing,
    number,
    percent,
    sentence,
    share,
    si,
)

if TYPE_CHECKING:
    from workflow.figures.subjects import ChannelView, RunView


def structure(found: IdentifiedChannel) -> str:
    """Order of a model: "order 6 + 1 integrator, a direct term, 1 sample of input delay"."""
    said_of = f"order {found.model.order}"
    if found.model.integrators:
        said_of += f" + {count(found.model.integrators, 'integrator')}"
    if found.identification.structure.feedthrough:
        said_of += ", a direct term"
    if found.model.input_delay_samples:
        said_of += f", {count(found.model.input_delay_samples, 'sample')} of input delay"
    return said_of


def fits(by_record: Mapping[str, float]) -> str:
    """Fits by record: "97.2 % (r1) and 96.8 % (r2)"."""
    return listing(f"{percent(fit)} ({name})" for name, fit in by_record.items())


def pair_kind(found: IdentifiedChannel, pair: ModelMode, known: ModeInterval | None = None) -> str:
    """What a pole pair is called."""
    if not found.is_mode(pair):
        return "slow or overdamped pair"
    return "mode" if known is None or known.told else "pair that the records do not show"


def true_mode(truth: TrueMode | None) -> str:
    """The true mode of simulated logs, "7.62 Hz, damping 0.0123"; "" where it is not known."""
    return "" if truth is None else f"{number(truth.frequency_Hz)} Hz, damping {number(truth.damping)}"


def model_rows(
    found: IdentifiedChannel,
    intervals: Intervals | None,
    truths: Sequence[TrueMode | None] = (),
    *,
    whole: bool = True,
) -> tuple[Row, ...]:
    """Structure, poles and fits of a channel.

    Args:
        found: The channel.
        intervals: Confidence intervals of its poles; None: not known.
        truths: Beside each mode the true one of simulated logs.
        whole: Rows, too, that a page beside the table shows.
    """
    order = f"{found.model.order}"
    if found.model.integrators:
        order += f" + {count(found.model.integrators, 'integrator')}"
    if found.model.input_delay_samples:
        order += f", delay {count(found.model.input_delay_samples, 'sample')}"
    if found.identification.structure.feedthrough:
        order += ", direct term"
    verdicts = found.identification.verdicts
    dead_times = [verdict for verdict in verdicts if verdict.kind is FindingKind.DEAD_TIME]
    rows = [
        worded("order", order),
        *(worded("dead time", words(item)) for item in dead_times),
        worded("closed loop", words(found.closed_loop) if found.closed_loop else ""),
        *_pair_rows(found, intervals, truths),
        *_unstable_rows(found, intervals),
    ]
    if whole:
        decays = [number(decay, 4) for decay in found.real_poles_per_s]
        if decays:
            all_decays = ", ".join(decays)
            rows.append(worded("real poles", f"{all_decays} 1/s"))
        # A pole at or left of 0 in the z plane has no decay rate.
        places = []
        for pole in found.real_poles_z:
            if pole == 0:
                places.append("0 (deadbeat)")
            elif pole < 0:
                places.append(number(pole, 4))
        rows.append(worded("real poles, z plane", ", ".join(places)))

    # Where records were kept back, their fit says more than that of the fitted ones.
    of_what = ""
    if found.increments:
        of_what = " of increments"
    for role, by_record in found.fit_percent.items():
        shown = whole or role != "estimation" or not found.fit_percent["validation"]
        if by_record and shown:
            fits_of_role = extent(by_record.values())
            rows.append(worded(f"fit, {role}", f"{fits_of_role} %{of_what}"))
    return said(*rows)


def _pair_rows(
    found: IdentifiedChannel, intervals: Intervals | None, truths: Sequence[TrueMode | None]
) -> list[Row]:
    """Pole pairs; one that the records do not tell from none is left out."""
    rows = []
    for index, pair in enumerate(found.modes):
        known = None
        if intervals is not None:
            known = intervals.modes[index]
        if known is not None and found.is_mode(pair) and not known.told:
            continue
        text = f"{number(pair.frequency_Hz, 4)} Hz, damping {number(pair.damping)}"
        if intervals is not None and known is not None:
            level = share(intervals.level)
            frequencies = interval(known.frequency_Hz)
            dampings = interval(known.damping)
            text += f" ({level}: {frequencies} Hz, {dampings})"
        # Simulated logs: what the linear arm behind them has.
        truth = ""
        if truths:
            truth = true_mode(truths[index])
        if truth:
            text += f" (true (linear arm): {truth})"
        rows.append(worded(pair_kind(found, pair), text))
    return rows


def _unstable_rows(found: IdentifiedChannel, intervals: Intervals | None) -> list[Row]:
    rows = []
    for index, (growth_per_s, omega_rad_s) in enumerate(found.unstable_poles):
        text = f"grows with {si(growth_per_s, '1/s', 4)}"
        if omega_rad_s:
            text += f" at {frequency(omega_rad_s, 4)}"
        if intervals is not None:
            level = share(intervals.level)
            growths = interval(intervals.growth_per_s[index])
            text += f" ({level}: {growths} 1/s)"
        rows.append(worded("unstable pole", text))
    return rows


def pole_blocks(channel: ChannelView, truths: Sequence[TrueMode | None] = ()) -> list[Block]:
    """Pole pairs, real and unstable poles with their intervals, for a page; beside pairs the true modes."""
    identified = channel.found
    known = channel.spread.intervals
    level = "" if known is None else share(known.level)
    blocks: list[Block] = []
    if identified.modes:
        blocks.append(_pair_table(identified, known, truths))
    if identified.real_poles_z:
        rows = []
        for index, place in enumerate(identified.real_poles_z):
            cells = [number(place, 6), _decay(place, identified.model.dt_s)]
            if known is not None:
                cells.append(interval(known.real_poles_per_s[index]) if place > 0 else MISSING)
            rows.append(tuple(cells))
        head = ["real pole z [1]", "decay rate [1/s]"] + ([f"{level} interval"] if known else [])
        blocks.append(Table(tuple(head), tuple(rows)))
    if identified.unstable_poles:
        rows = []
        for index, (growth_per_s, omega_rad_s) in enumerate(identified.unstable_poles):
            cells = [frequency(omega_rad_s) if omega_rad_s else "real", number(growth_per_s, 4)]
            if known is not None:
                cells.append(interval(known.growth_per_s[index]))
            rows.append(tuple(cells))
        head = ["unstable pole", "growth rate [1/s]"] + ([f"{level} interval"] if known else [])
        blocks.append(Table(tuple(head), tuple(rows)))
    return blocks or [Text("The model has no pole.")]


def _pair_table(
    found: IdentifiedChannel, known: Intervals | None, truths: Sequence[TrueMode | None]
) -> Table:
    simulated = any(truth is not None for truth in truths)
    head = ["pole pair", "frequency [Hz]", "[rad/s]", "damping ratio [1]"]
    if known is not None:
        head += [f"{share(known.level)} interval of the frequency [Hz]", "of the damping [1]"]
    if simulated:
        head.append("true (linear arm)")
    rows = []
    for index, mode in enumerate(found.modes):
        of_pair = None if known is None else known.modes[index]
        cells = [
            pair_kind(found, mode, of_pair),
            number(mode.frequency_Hz, 4),
            number(mode.omega_rad_s, 4),
            number(mode.damping),
        ]
        if of_pair is not None:
            cells += [interval(of_pair.frequency_Hz), interval(of_pair.damping)]
        if simulated:
            cells.append(true_mode(truths[index]))
        rows.append(tuple(cells))
    return Table(tuple(head), tuple(rows))


def _decay(place: float, dt_s: float) -> str:
    """Decay rate of a real pole in the z plane, 1/s."""
    if place == 0:
        return "deadbeat"
    if place < 0:
        return "changes sign every sample"
    return number(-math.log(place) / dt_s, 4)


def who_chose(options: IdentOptions) -> str:
    """Who decided on the order: the criterion decides only what the options leave open."""
    specified = [
        f"{name} = {value}"
        for name, value in (("n_real", options.n_real), ("n_pairs", options.n_pairs))
        if value is not None
    ]
    if not specified:
        return "Structures tried; the smallest criterion wins."
    if len(specified) == 1:
        return f"Structures tried; {specified[0]} was specified, the smallest criterion decides the rest."
    return (
        f"{listing(specified)} were specified; the criterion alone would choose the structure with 0 in the "
        "last column."
    )


def order_table(channel: ChannelView) -> list[Block]:
    """Every structure that was tried, if there was a choice at all."""
    steps = channel.found.identification.order_table
    if len(steps) < 2:
        return []
    best = min(step.criterion for step in steps)
    rows = tuple(
        (step.n_real, step.n_pairs, number(step.rss, 4), fixed(step.criterion - best)) for step in steps
    )
    head = ("real poles", "pairs", "residual sum of squares", "criterion above the best")
    return [Table(head, rows, who_chose(channel.options))]


def stabilisation_text(channel: ChannelView) -> str:
    """What the stabilisation plot says about the modes, and about those that it does not confirm."""
    plot = channel.found.stabilisation
    modes = [] if plot is None else plot.columns()
    if not modes:
        return "No pole pair is both needed by the data and the same in fits of different order."
    places = listing(frequency(mode.omega_rad_s) for mode in modes)
    needed = f"{len(modes)} modes, and these stay"
    if len(modes) == 1:
        needed = "one mode, and it stays"
    text = f"The data need {needed} the same when more pole pairs are allowed: {places}."
    if channel.unconfirmed_rad_s:
        unconfirmed = listing(frequency(omega) for omega in channel.unconfirmed_rad_s)
        text += f" The data do not confirm that the model's pair at {unconfirmed} is a mode of the machine."
    return text


ORDER_CAPTION = (
    "Left: information criterion above the best. Right: pole pairs found when 0, 1, 2 ... are allowed. "
    "Stable: within 1 % in frequency and 5 % in damping. Significant: the criterion is worse without it."
)


def identification_page(view: RunView) -> PageSection:
    """What was found in the records of a run of one loop."""
    blocks: list[Block] = []
    for channel in view.channels:
        if len(view.channels) > 1:
            blocks.append(Heading(f"Channel {channel.name}"))
        blocks += _channel_blocks(channel, is_control=channel is view.control)
    return PageSection("identification", "Identified models", "Identification", tuple(blocks))


def _channel_blocks(channel: ChannelView, *, is_control: bool) -> list[Block]:
    identified = channel.found
    estimation = identified.fit_percent["estimation"]
    how = "Fit to"
    if identified.increments:
        how = "Fitted to the differences from sample to sample, so that drift weighs less. Fit to those of"
    fit = f"{how} {count(len(estimation), 'record')}: {extent(estimation.values(), 3)} %"
    if identified.fit_percent["validation"]:
        fit += f"; on validation data: {fits(identified.fit_percent['validation'])}"
    closed = channel.closed_loop is not None
    of_loop = ", and poles of the closed loop" if closed else ""
    caption = f"Poles and zeros in the z-plane{of_loop}."
    blocks: list[Block] = [
        Text(f"{identified.input} to {identified.output}: {structure(identified)}. {fit}."),
        *pole_blocks(channel),
        Picture(
            "poles",
            caption,
            (identified.model, channel.name, channel.closed_loop, channel.spread.intervals),
            channel.file,
        ),
        Remarks(sentences(identified.identification.warnings), "warning", "Warnings about this model"),
    ]
    if identified.closed_loop is not None:
        blocks.append(Remarks(sentences([identified.closed_loop]), "note", "Records made in closed loop"))
    if not is_control:
        return blocks
    surface = (
        f"Error over frequency and damping of the pair at {frequency(channel.shown_omega_rad_s)}, the other "
    )
    blocks += [
        Remarks(sentences(identified.identification.verdicts), "note", "What the data decided"),
        Picture("error-surface", f"{surface}poles fixed.", (channel,), channel.file),
    ]
    if identified.stabilisation is not None and identified.identification.order_table:
        blocks.append(Text(stabilisation_text(channel)))
        blocks.append(Picture("order", ORDER_CAPTION, (channel,), channel.file))
    return blocks + order_table(channel)


def sentences(found: Iterable[Finding]) -> tuple[str, ...]:
    """What was found, a sentence each."""
    return tuple(sentence(words(item)) for item in found)


def model_numbers(found: IdentifiedChannel) -> dict[str, Any]:
    """What was found in one channel, for programs."""
    model = found.model
    identification = found.identification
    unstable = []
    for growth_per_s, omega_rad_s in found.unstable_poles:
        unstable.append({"growth_per_s": growth_per_s, "omega_rad_s": omega_rad_s})
    modes = []
    for mode in found.modes:
        numbers_of_mode = {"frequency_Hz": mode.frequency_Hz, **codec.plain(mode)}
        modes.append(numbers_of_mode | {"is_mode": found.is_mode(mode)})
    fits_by_role = {f"fit_{role}_percent": by_record for role, by_record in found.fit_percent.items()}
    # How logs made in a loop were used, and why.
    way = found.closed_loop
    closed_loop = None
    if way is not None:
        closed_loop = {"method": way.kind.name.lower(), "reason": words(way)}
    return {
        "name": found.name,
        "input": found.input,
        "output": found.output,
        "order": model.order,
        "integrators": model.integrators,
        "input_delay_samples": model.input_delay_samples,
        "feedthrough": identification.structure.feedthrough,
        "real_poles_per_s": codec.plain(found.real_poles_per_s),
        "real_poles_z": codec.plain(found.real_poles_z),
        "unstable_poles": unstable,
        "order_table": codec.plain(identification.order_table),
        "band_rad_s": codec.plain(found.band_rad_s),
        **fits_by_role,
        "warnings": [words(item) for item in identification.warnings],
        "verdicts": [words(item) for item in identification.verdicts],
        "closed_loop": closed_loop,
        "modes": modes,
        "noise_std": identification.noise_std,
        "tangent_optimality": identification.tangent_optimality,
        "search_evaluations": identification.search.evaluations,
    }
