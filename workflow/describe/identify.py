"""What `flexlink identify` says of logs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from workflow.describe.facts import (
    Block,
    FirstScreen,
    PageSection,
    Picture,
    Quantity,
    Remarks,
    Row,
    Section,
    Table,
    Text,
    said,
    worded,
)
from workflow.describe.friction import amplitude_row, friction_row
from workflow.describe.identification import (
    ORDER_CAPTION,
    model_rows,
    order_table,
    pole_blocks,
    stabilisation_text,
    structure,
    true_mode,
    who_chose,
)
from workflow.describe.records import distortion_page, logs_section
from workflow.describe.uncertainty import (
    HALF_PERCENT,
    band_table,
    described,
    ellipse_rows,
    free_run_picture,
    misses_half,
    residual_blocks,
    unknown_bands,
)
from workflow.tasks.log_identification import LogIdentification
from workflow.tasks.results import RunRecord
from workflow.text.findings.sentences import words
from workflow.text.formats import count, hertz, number, percent, share
from workflow.text.sentences.records import cut_off, signal, time_base

if TYPE_CHECKING:
    from workflow.figures.subjects import ChannelView

# Modes on the first screen: with fit and ellipses they are five rows.
_SHOWN_MODES = 3
# How clear the advantage of the best structure is by the difference of the criterion to the next best: the
# usual words for differences of an information criterion.
_ADVANTAGES = (
    (2.0, "a negligible advantage"),
    (6.0, "a slight advantage"),
    (10.0, "a clear advantage"),
)


def identify_sections(result: LogIdentification) -> list[Section]:
    """Logs, model, uncertainty and warnings."""
    input_unit = "".join(result.measured[0].input_units)
    output_unit = "".join(result.measured[0].output_units)
    friction = None
    if result.friction is not None:
        friction = friction_row(result.friction, input_unit, output_unit)
    uncertainty = [*ellipse_rows(result.spread), friction]
    if friction is not None:
        uncertainty.append(amplitude_row(result.equivalent, input_unit))
    warnings = [worded(str(number), words(item)) for number, item in enumerate(result.careful, 1)]
    sections = [
        logs_section((*result.measured, *result.fresh_records), result.input_limit),
        Section("model", model_rows(result.about, result.spread.intervals, result.true_modes)),
        Section("uncertainty", said(*uncertainty)),
        Section("warnings", tuple(warnings)),
    ]
    return [section for section in sections if section.rows]


def identify_first_screen(result: LogIdentification, channel: ChannelView) -> FirstScreen:
    """What the page of `flexlink identify` begins with."""
    identified = channel.found
    light = channel.light
    level = share(channel.spread.level)
    warned = ""
    if result.careful:
        warned = f"; {count(len(result.careful), 'warning')}"
    light_modes = count(len(light), "lightly damped mode")
    headline = f"Model of order {identified.model.order} with {light_modes}{warned}"
    marked = "; lightly damped modes marked" if light else ""
    picture = Picture(
        "response",
        f"Identified response with its {level} uncertainty at each frequency{marked}.",
        (channel,),
    )
    rows = _first_rows(result, channel)
    bullets = tuple(_bullets(result, channel))
    return FirstScreen(headline, "plain", rows, bullets, picture, "findings", "Findings")


def _first_rows(result: LogIdentification, channel: ChannelView) -> tuple[Row, ...]:
    """Fit, up to three modes, size of the ellipses."""
    identified = channel.found
    spread = channel.spread
    fresh = channel.unseen
    if fresh:
        name, fit_percent, _ = min(fresh, key=lambda row: row[1])
        remark = f"smallest of {len(fresh)} records" if len(fresh) > 1 else name
        if identified.increments:
            remark += ", increments"
        rows = [Row("", "fit, validation", Quantity.of(fit_percent, "%"), remark)]
    else:
        least = min(identified.fit_percent["estimation"].values())
        rows = [Row("", "fit, estimation records", Quantity.of(least, "%"), "no validation record")]
    for order, (place, mode) in enumerate(channel.light[:_SHOWN_MODES], 1):
        remark = true_mode(result.true_modes[place]) if result.true_modes else ""
        if remark:
            remark = f"true (linear arm): {remark}"
        elif spread.intervals is not None:
            known = spread.intervals.modes[place]
            remark = f"{_known_to(known.frequency_Hz)}, {_known_to(known.damping)}"
        text = f"{number(mode.frequency_Hz)} Hz, {number(mode.damping)}"
        rows.append(Row("", f"mode {order}: frequency, damping", Quantity.words(text), remark))
    radii = [band.median_radius_percent for band in spread.bands]
    size = f"{number(min(radii), 2)} to {number(max(radii), 2)} %"
    about = "median radius by band, of the gain"
    rows.append(Row("", f"{share(spread.level)} ellipses", Quantity.words(size), about))
    return tuple(rows)


def _known_to(ends: tuple[float, float]) -> str:
    """Half the width of an interval of a positive number, in percent of its lower end."""
    low, high = ends
    # Half of the width, times 100 %.
    half_percent = 50 * (high / low - 1) if low > 0 else math.inf
    return f"±{percent(half_percent, 2)}" if half_percent < 100 else "a factor of two at best"


def _bullets(result: LogIdentification, channel: ChannelView) -> list[str]:
    """Sentences on a model, the weightiest first; empty ones are left out by whoever shows them."""
    identified = channel.found
    spread = channel.spread
    first = result.measured[0]
    input_unit = "".join(first.input_units)
    output_unit = "".join(first.output_units)
    bullets = [] if identified.closed_loop is None else [words(identified.closed_loop)]
    bullets += [words(item) for item in result.careful]
    worst = min(channel.unseen, key=lambda row: row[1], default=None)
    if worst is None:
        bullets.append(
            "No record was kept for validation: record one more with another input and give it as "
            "--validation"
        )
    elif worst[1] < HALF_PERCENT:
        bullets.append(misses_half(worst[0]))
    bullets.append(unknown_bands(spread.bands))
    if identified.band_rad_s is not None:
        low, high = identified.band_rad_s
        bullets.append(
            f"Fitted inside the band from {number(low)} to {number(high)} rad/s; the model does not cover "
            "other frequencies"
        )
    logs = (*result.measured, *result.fresh_records)
    bullets.append(cut_off(logs, result.input_limit, input_unit))
    real, pairs = channel.searched
    found_poles = f"{count(real, 'real pole')} and {count(pairs, 'pole pair')} were found"
    bullets.append(f"{structure(identified)}: {found_poles}, {_why_this_order(channel)}")
    about = described(result.described, result.friction, input_unit, output_unit, result.equivalent)
    bullets.append(about.replace("They describe", "The ellipses describe", 1))
    if all(test.passed for test in spread.tests):
        bullets.append("The residuals pass both tests, whiteness and independence of the input")
    bullets += [words(item) for item in identified.identification.verdicts if item not in result.careful]
    return bullets


def _why_this_order(channel: ChannelView) -> str:
    """Who decided on the order, and how clearly."""
    steps = channel.found.identification.order_table
    if channel.options.n_real is not None and channel.options.n_pairs is not None:
        return "as specified"
    if len(steps) < 2:
        return "the only structure tried"
    best, second = sorted(step.criterion for step in steps)[:2]
    better = second - best
    advantage = "a very clear advantage"
    for below, name in _ADVANTAGES:
        if better < below:
            advantage = name
            break
    return (
        f"chosen by an information criterion from {len(steps)} structures (next best: {number(better)} "
        f"worse, {advantage})"
    )


def identify_page_sections(
    result: LogIdentification,
    channel: ChannelView,
    records: Sequence[RunRecord],
    stated: Sequence[tuple[str, object]],
    inputs: Mapping[str, str],
) -> list[PageSection]:
    """The sections of the page of `flexlink identify`.

    Args:
        result: What was found.
        channel: The same with what pictures need.
        records: All logs with their roles.
        stated: Options that differ from their defaults, then versions.
        inputs: SHA-256 by file.
    """
    identified = channel.found
    spread = channel.spread
    level = share(spread.level)
    unseen = channel.unseen
    modes = pole_blocks(channel, result.true_modes)
    if identified.modes or identified.real_poles_z or identified.unstable_poles:
        modes.append(Text("Intervals include noise, initial state and unmodelled dynamics."))
    caption = (
        f"Identified response with its {level} ellipses, their size, and the response computed from the "
        "records without a model."
    )
    response = (Picture("bode", caption, (channel, "Response")), band_table(spread.bands))
    order: list[Block] = [Picture("order", ORDER_CAPTION, (channel,))]
    if identified.stabilisation is not None:
        order.append(Text(stabilisation_text(channel)))
    order += order_table(channel) or [Text(who_chose(channel.options))]
    fresh: list[Block] = [free_run_picture(channel)]
    if len(unseen) > 1:
        rows = tuple((name, number(fit, 4)) for name, fit, _ in unseen)
        fresh.append(Table(("validation record", "fit [%]"), rows))
    validated = ("On validation data", "Validation") if unseen else ("On the data of the fit", "Fit")
    reproduce = (
        Table(("option or version", "value"), tuple(stated), "All other options have their defaults."),
        Table(("input file", "SHA-256"), tuple(inputs.items())),
        Remarks(("The result is deterministic: the same files and options give the same page.",)),
    )
    return [
        PageSection("modes", "Modes and poles", "Modes", tuple(modes)),
        PageSection("response", "Frequency response", "Response", response),
        PageSection("order", "How many poles", "Order", tuple(order)),
        PageSection("poles", "Poles and zeros", "Poles", tuple(_pole_place_blocks(channel))),
        PageSection("fresh", *validated, tuple(fresh)),
        PageSection("residuals", "Residuals", "Residuals", tuple(residual_blocks(channel))),
        PageSection("records", "Records", "Records", tuple(_record_blocks(result, channel, records))),
        distortion_page(channel),
        PageSection("reproduce", "To reproduce this", "Reproduce", reproduce),
    ]


def _pole_place_blocks(channel: ChannelView) -> list[Block]:
    """Poles and zeros in the z plane."""
    zeros = count(channel.zeros.size, "zero")
    text = f"The model has {zeros}."
    if channel.zeros_outside:
        text = (
            f"The model has {zeros}, {channel.zeros_outside} of them outside the unit circle. The sampled "
            "response is non-minimum phase, which limits the bandwidth of any loop."
        )
    elif channel.zeros.size:
        text = f"The model has {zeros}, none of them outside the unit circle."
    caption = "Poles (crosses) and zeros (circles) in the z-plane, and near z = 1."
    subjects = (channel.found.model, channel.name, None, channel.spread.intervals)
    blocks: list[Block] = [Picture("poles", caption, subjects), Text(text)]
    if channel.zero_pairs:
        rows = []
        for omega, zeta in channel.zero_pairs:
            rows.append((number(hertz(omega), 4), number(omega, 4), number(zeta)))
        head = ("zero pair (antiresonance): frequency [Hz]", "[rad/s]", "damping ratio [1]")
        blocks.append(Table(head, tuple(rows)))
    return blocks


def _record_blocks(
    result: LogIdentification, channel: ChannelView, records: Sequence[RunRecord]
) -> list[Block]:
    """The logs, how their time was read, and the fit of each."""
    identified = channel.found
    first = result.measured[0]
    fit_of = identified.fit_percent
    rows = []
    for place, item in enumerate(records, 1):
        fit_percent = fit_of[item.role].get(item.name)
        rows.append(
            (
                place,
                item.name,
                item.role,
                item.record.n_samples,
                number(item.duration_s),
                time_base(item.record),
                number(fit_percent, 4),
            )
        )
    read_input = signal(first.input_names[0], first.input_units)
    read_output = signal(first.output_names[0], first.output_units)
    subjects = (records, [identified.input], [identified.output])
    head = ("no.", "record", "used for", "samples", "length [s]", "time", "fit [%]")
    return [
        Picture("records", "All records on one time axis.", subjects),
        Text(f"Input {read_input}, output {read_output}."),
        Table(head, tuple(rows)),
    ]
