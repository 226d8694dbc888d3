"""Records, identification and uncertainty on the page: every sentence is made from the numbers beside it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ident.checks.validation import ScatterRow
from workflow.config.run_config import SimulatedSource
from workflow.report.data import ChannelData, RunData
from workflow.report.formats import count, frequency, listing, number, percent, sentence
from workflow.report.model_blocks import (
    STABILISATION_CAPTION,
    band_table,
    band_words,
    order_table,
    pole_tables,
    residual_caption,
    stabilisation_sentence,
    structure_words,
    test_remarks,
    unknown_bands,
)
from workflow.report.page import Block, Plot, Remarks, Section, Table, Text, heading, maybe
from workflow.report.pictures import channel_picture, fresh_index, shown_pair

_ROLE = {"estimation": "estimation", "validation": "validation", "repeat": "repeat"}


def records_section(data: RunData) -> Section:
    """What was measured."""
    abouts = data.records
    roles = [about.role for about in abouts]
    where = "simulated" if isinstance(data.config.source, SimulatedSource) else "read from files"
    duration = sum(about.duration_s for about in abouts)
    uses = (
        ("estimation", "to estimate from"),
        ("validation", "kept for validation"),
        ("repeat", "as repeats"),
    )
    split = listing([f"{roles.count(role)} {words}" for role, words in uses if role in roles])
    lead = (
        f"{count(len(abouts), 'record')} ({number(duration)} s in all, sampled every "
        f"{number(1e3 * abouts[0].record.dt_s)} ms) {'was' if len(abouts) == 1 else 'were'} {where}: {split}."
    )
    rows = tuple(
        (
            str(index),
            about.name,
            _ROLE[about.role],
            about.kind,
            f"{about.record.n_samples}",
            number(about.duration_s),
            "closed" if about.record.reference is not None else "open",
            "; ".join(part for part in (about.condition, about.remark) if part),
        )
        for index, about in enumerate(abouts, 1)
    )
    head = ("no.", "record", "used for", "kind", "samples", "length [s]", "loop", "condition, remark")
    blocks: list[Block] = [
        Text(lead),
        Plot(
            "records", "All records one after another on one time axis; shading says what each is used for."
        ),
        Table(head, rows),
    ]
    if isinstance(data.config.source, SimulatedSource) and data.config.source.effects:
        effects = tuple(
            (str(effect["name"]), ", ".join(f"{k} = {v}" for k, v in effect.items() if k != "name"))
            for effect in data.config.source.effects
        )
        blocks.append(Table(("effect on the simulated arm", "parameters"), effects))
    if "validation" not in roles:
        blocks.append(
            Remarks(
                (
                    "No record was kept back for validation: how the model does on fresh data is not known. "
                    "Advice: "
                    "give one record role = 'validation'.",
                ),
                "warning",
            )
        )
    return Section("records", "Excitation and records", "Records", tuple(blocks))


def identification_section(data: RunData) -> Section:
    """What was found in the records."""
    blocks: list[Block] = [
        Text(
            "A generalised orthonormal basis was fitted to each channel: poles by global search and descent, "
            "coefficients by least squares."
        )
    ]
    for index, channel in enumerate(data.channels):
        blocks += _identified(data, index, channel)
    return Section("identification", "Identified models", "Identification", tuple(blocks))


def _identified(data: RunData, index: int, channel: ChannelData) -> list[Block]:
    about = channel.identified
    model = channel.result.identification.model
    single = len(data.channels) == 1
    blocks: list[Block] = [] if single else [heading(f"Channel {channel.label}")]
    of = "Fit to"
    if about.increments:
        of = "Fitted to the differences from sample to sample, so that drift weighs less. Fit to those of"
    fits = listing([f"{percent(fit)} ({name})" for name, fit in about.fit_estimation_percent.items()])
    blocks.append(
        Text(
            f"{about.input} to {about.output}: {structure_words(about)}, found with "
            f"{about.identification.search.evaluations} evaluations of the error. {of} the records used: "
            f"{fits}."
        )
    )
    blocks += pole_tables(about, model.dt_s, channel.uncertain.intervals)
    pair = shown_pair(channel)
    if pair is not None:
        omega = float(model.poles.omega_rad_s(model.dt_s)[pair])
        blocks.append(
            Plot(
                channel_picture("error-surface", index, channel.label),
                f"Error over frequency and damping of the pair at {frequency(omega)}, the other poles held "
                "where they "
                "were found, coefficients fitted anew at every point. Dots: points a global search tried "
                "for this "
                "pair, then still without the poles found later.",
            )
        )
    loop = index == data.config.control_index and data.has_controller
    blocks.append(
        Plot(
            channel_picture("poles", index, channel.label),
            "Poles in the z-plane"
            + (", and those of the closed loop with the controller below." if loop else "."),
        )
    )
    blocks += [
        *maybe(tuple(map(sentence, about.warnings)), "warning", "To look at before trusting this model")
    ]
    staged = about.two_stage
    blocks += maybe((sentence(staged),) if staged else (), "note", "Records made in closed loop")
    blocks += [*maybe(tuple(map(sentence, about.verdicts)), "note", "What the data decided")]
    options = data.config.channels[index].identification
    if channel.stabilisation is not None and about.order_table:
        blocks += [
            Text(stabilisation_sentence(channel.stabilisation)),
            Plot(channel_picture("order", index, channel.label), STABILISATION_CAPTION),
        ]
    return blocks + order_table(about, options)


def uncertainty_section(data: RunData) -> Section:
    """How sure the models are, and what the residuals say."""
    blocks: list[Block] = []
    for index, channel in enumerate(data.channels):
        blocks += _uncertain(data, index, channel)
    return Section("uncertainty", "How sure: ellipses and validation", "Uncertainty", tuple(blocks))


def _uncertain(data: RunData, index: int, channel: ChannelData) -> list[Block]:
    about, label = channel.uncertain, channel.label
    level = percent(100 * about.level, 4)
    bands = about.bands
    blocks: list[Block] = [] if len(data.channels) == 1 else [heading(f"Channel {label}")]
    blocks += [
        Text(
            f"Method '{about.method}'. The {level} ellipses are {band_words(bands)}. The level holds at "
            "each frequency taken alone."
        ),
        Plot(
            channel_picture("bode", index, label),
            f"Identified response with the range of gain and phase over its {level} ellipses, and the size "
            "of the "
            "ellipses beside the gain.",
        ),
        band_table(bands),
    ]
    nominal = about.agreement
    blocks.append(
        Text(
            "The nominal model of the design lies inside its ellipse at "
            f"{percent(nominal.share_inside_percent)} "
            f"of these frequencies; farthest out at {frequency(nominal.at_rad_s)}, "
            f"{number(nominal.largest_distance)} times the ellipse's own radius from its centre."
        )
    )
    blocks += maybe(unknown_bands(bands), "warning")
    return blocks + _validated(data, index, channel)


def _validated(data: RunData, index: int, channel: ChannelData) -> list[Block]:
    about, label = channel.identified, channel.label
    blocks: list[Block] = []
    fresh = fresh_index(data, channel)
    fits = [
        *((name, fit, "validation") for name, fit in about.fit_validation_percent.items()),
        *((name, fit, "repeat") for name, fit in about.fit_repeat_percent.items()),
    ]
    what = "of the output's differences from sample to sample" if about.increments else "of the output"
    if fits:
        worst_name, worst, _ = min(fits, key=lambda entry: entry[1])
        unseen = f"On {count(len(fits), 'record')} that the fit has not seen"
        range_of = f"between {percent(worst)} ({worst_name}) and {percent(max(fit for _, fit, _ in fits))}"
        if len(fits) == 1:
            unseen, range_of = f"On the record {worst_name}, which the fit has not seen", percent(worst)
        only_repeats = not about.fit_validation_percent
        if only_repeats:
            unseen = "On repeats of the fitted experiment" if len(fits) > 1 else f"On the repeat {worst_name}"
        text = f"{unseen}, the model run freely reproduces {range_of} {what}."
        if only_repeats:
            text += " Repeats show the noise; whether the model holds for another input is not tested."
        blocks.append(Text(text))
        if worst < 50 and not about.increments:
            blocks.append(
                Remarks(
                    (
                        f"On {worst_name} the model misses more than half of the output. Advice: look at "
                        "the residual "
                        "below; dry friction, drift or another operating point are common causes.",
                    ),
                    "warning",
                )
            )
    caption = "Measured output and free run of the model, and the difference."
    if fresh is None:
        caption += " There is no fresh record; this one was used in the fit."
    blocks.append(Plot(channel_picture("validation", index, label), caption))
    if len(fits) > 1:
        rows = tuple((name, role, number(fit, 4)) for name, fit, role in fits)
        blocks.append(Table(("record", "kept as", "fit [%]"), rows))
    tests = channel.uncertain.tests
    if tests:
        blocks.append(Plot(channel_picture("residuals", index, label), residual_caption(channel.uncertain)))
    blocks += test_remarks(tests)
    scatter = channel.uncertain.repeat_scatter
    if scatter:
        blocks += [
            Plot(
                channel_picture("repeats", index, label),
                "Scatter between repeats of the same experiment against what the ellipses of one repeat "
                "predict.",
            ),
            _scatter_table(scatter),
        ]
    return blocks


def _scatter_table(rows: Sequence[ScatterRow]) -> Table:
    between = any(not math.isnan(row.between) for row in rows)
    head: tuple[str, ...] = (
        "from [rad/s]",
        "to [rad/s]",
        "predicted / gain [%]",
        "measured / gain [%]",
        "measured / predicted [1]",
    )
    cells = []
    for row in rows:
        cell = [number(row.omega_low_rad_s), number(row.omega_high_rad_s)]
        cell += [number(100 * row.predicted), number(100 * row.measured), number(row.ratio)]
        if between:
            cell += [number(100 * row.between), number(row.between_ratio)]
        cells.append(tuple(cell))
    if between:
        head += ("between conditions / gain [%]", "over noise alone [1]")
    return Table(head, tuple(cells), "Scatter is RMS over the band, one standard deviation.")
