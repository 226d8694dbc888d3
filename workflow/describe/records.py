"""What was measured: records of a run, and how the logs of `flexlink identify` were read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any, get_args

from ident.data.distortion import Distortion
from ident.data.record import Record
from workflow.config.run_config import Notes, Role, RunConfig
from workflow.describe.facts import (
    Block,
    PageSection,
    Picture,
    Remarks,
    Row,
    Section,
    Table,
    Text,
    said,
    worded,
)
from workflow.tasks.results import RecordsResult, RunRecord
from workflow.text.findings.sentences import words
from workflow.text.formats import count, listing, number, sentence, setting, si
from workflow.text.sentences.records import cut_off, signal, time_base

if TYPE_CHECKING:
    from workflow.figures.subjects import AnyRunView, ChannelView

# A command that is held for less than this share of a row changes between two rows.
_HELD_THROUGH = 0.999

# A record of a series: "4 V rms, realisation 3".
_NUMBERED = re.compile(r"(?P<name>.*\D)(?P<number>\d+)")
ROLES: tuple[Role, ...] = get_args(Role)


def records_section(records: RecordsResult) -> Section:
    """How many records a run has by what they are used for, with samples and length."""
    rows: list[Row] = []
    for role in ROLES:
        chosen = records.of_role(role)
        if not chosen:
            continue
        records_of_role = count(len(chosen), "record")
        samples = sum(item.record.n_samples for item in chosen)
        length = si(sum(item.duration_s for item in chosen), "s", 4)
        rows.append(worded(role, f"{records_of_role}, {samples} samples, {length}"))
    return Section("records", tuple(rows))


def logs_section(logs: Sequence[Record], input_limit: float | None) -> Section:
    """How logs of one channel were read.

    Args:
        logs: All of them, at least one.
        input_limit: What the amplifier gives, where it was stated.
    """
    # All logs have the columns of the first.
    first = logs[0]
    input_signal = signal(first.input_names[0], first.input_units)
    output_signal = signal(first.output_names[0], first.output_units)
    input_unit = "".join(first.input_units)
    rows = [worded(record.name, time_base(record)) for record in logs]
    rows.append(worded("input", input_signal))
    rows.append(worded("output", output_signal))
    rows.append(worded("input limit", cut_off(logs, input_limit, input_unit)))
    return Section("logs", said(*rows))


def records_page(view: AnyRunView) -> PageSection:
    """What was measured, and how it was read."""
    config = view.config
    several = not isinstance(config, RunConfig)
    items = view.results.records.records
    simulated = config.source.kind != "files"
    inputs = list(dict.fromkeys(column.input for column in config.columns))
    outputs = list(dict.fromkeys(column.output for column in config.columns))
    head = ("no.", "record", "used for", "samples", "length [s]", "loop", "condition, remark")
    blocks: list[Block] = [
        Text(_about_records(view, simulated=simulated)),
        Picture("records", "All records on one time axis.", (items, inputs, outputs)),
        Table(head, tuple(_record_rows(items))),
        *_limit_blocks(view, several=several),
    ]
    effects = getattr(config.source, "effects", ())
    if effects:
        effect_rows = tuple((effect["name"], setting(effect)) for effect in effects)
        blocks.append(Table(("effect on the simulated arm", "parameters"), effect_rows))
    if not simulated:
        read = tuple(f"{item.name}: {time_base(item.record)}" for item in items)
        doubts = [sentence(words(doubt)) for item in items for doubt in item.record.doubts]
        blocks.append(Remarks(read, "plain", "How time was read"))
        blocks.append(Remarks(tuple(dict.fromkeys(doubts)), "warning"))
    of_points = hasattr(config.source, "points")
    if all(item.role != "validation" for item in items) and not of_points:
        blocks.append(
            Remarks(
                (
                    "There is no validation record: the model was not tested on new data. Give one record "
                    "role = 'validation'.",
                ),
                "warning",
            )
        )
    return PageSection("records", "Excitation and records", "Records", tuple(blocks))


def _record_rows(items: Sequence[RunRecord]) -> list[tuple[str, ...]]:
    """A row for each record, or for several in a row that are alike in all but the number in their name."""

    def said_of(item: RunRecord) -> tuple[str, ...]:
        loop = "closed"
        if item.record.reference is None:
            loop = "open"
        samples = str(item.record.n_samples)
        length_s = number(item.duration_s)
        remarks = [text for text in (item.condition, item.remark) if text]
        return item.role, samples, length_s, loop, "; ".join(remarks)

    def series_of(numbered: tuple[int, RunRecord]) -> tuple[object, ...]:
        place, item = numbered
        match = _NUMBERED.fullmatch(item.name)
        if match is None:
            return item.name, place, said_of(item)
        # Equal in a series whose numbers rise by one from row to row.
        return match["name"], int(match["number"]) - place, said_of(item)

    rows = []
    for _, group in groupby(enumerate(items, 1), series_of):
        series = list(group)
        first_place, first = series[0]
        last_place, last = series[-1]
        if len(series) == 1:
            rows.append((str(first_place), first.name, *said_of(first)))
            continue
        last_number = _NUMBERED.fullmatch(last.name)
        assert last_number is not None
        names = f"{first.name} to {last_number['number']}"
        rows.append((f"{first_place} to {last_place}", names, *said_of(first)))
    return rows


def _about_records(view: AnyRunView, *, simulated: bool) -> str:
    """How many records there are, what they are used for, and what their command did between two rows."""
    items = view.results.records.records
    uses = {"estimation": "for estimation", "validation": "for validation", "repeat": "as repeats"}
    split = []
    for role, use in uses.items():
        chosen = sum(item.role == role for item in items)
        if chosen:
            split.append(f"{chosen} {use}")
    seconds = number(sum(item.duration_s for item in items))
    # All records of a run have one step.
    step_ms = number(1000 * items[0].record.dt_s)
    was = "were"
    if len(items) == 1:
        was = "was"
    source = "read from files"
    if simulated:
        source = "simulated"
    text = (
        f"{count(len(items), 'record')} ({seconds} s in all, sampled every {step_ms} ms) {was} {source}: "
        f"{listing(split)}."
    )
    timing = view.results.records.timing
    if timing is not None:
        period_s = timing.period_s
        if timing.rows_per_command > 1:
            text += (
                f" The command changes every {timing.rows_per_command} rows of the logs: the rows at which "
                "it changes are used."
            )
        elif timing.known and period_s is not None and period_s < _HELD_THROUGH * timing.row_step_s:
            text += (
                f" The controller that made them held its command for {si(period_s, 's')}: the input is "
                "filtered so that, held from row to row, it moves the arm as the recorded command did."
            )
        elif not timing.known:
            text += (
                " What the command did between two rows is not known: the ellipses hold every period up to "
                f"{si(timing.row_step_s, 's')}."
            )
    controller_dt_s = None
    if isinstance(view.config, RunConfig):
        used = view.results.design.specification or view.config.specification
        controller_dt_s = used.controller_dt_s
    if controller_dt_s is not None:
        text += (
            f" The new controller runs every {si(controller_dt_s, 's')}; records, model and ellipses below "
            "are at the step of the records."
        )
    return text


def _limit_blocks(view: AnyRunView, *, several: bool) -> list[Block]:
    """What was clipped to the amplifier's limit, or may have been."""
    config = view.config
    records = [item.record for item in view.results.records.records]
    stated_limit = getattr(config.source, "input_limit", None)
    cut = cut_off(records, stated_limit, view.results.records.unit(config.loops[0].input))
    if cut:
        return [Text(f"{cut}.")]
    if stated_limit is not None:
        return []
    blocks: list[Block] = []
    for loop in config.loops:
        asked: Any = loop
        if not several:
            asked = view.results.design.specification or config.specification
        limit = asked.input_limit
        largest = view.largest_recorded(loop.input)
        if limit is None or largest <= limit:
            continue
        unit = view.results.records.unit(loop.input)
        name = ""
        key = "specification.input_limit"
        if several:
            name = f" {loop.input}"
            key = "its input_limit"
        reaches = si(largest, unit)
        beyond = si(limit, unit)
        warning = (
            f"The recorded input{name} reaches {reaches}, beyond the {beyond} of {key}. If the amplifier "
            f"clips there, the arm never got these commands: set input_limit = {setting(limit)} in [source]."
        )
        blocks.append(Remarks((warning,), "warning"))
    return blocks


def distortion_page(channel: ChannelView) -> PageSection:
    """Noise and nonlinear distortion of a channel's records, as far as they show them."""
    blocks = tuple(distortion_blocks(channel))
    return PageSection("distortion", "Noise and nonlinear distortion", "Distortion", blocks)


def distortion_blocks(channel: ChannelView) -> list[Block]:
    """Levels of noise and distortion by band."""
    distortions, known, refused = channel.distortion
    blocks: list[Block] = []
    if refused:
        blocks.append(Text(f"Not analysed: {refused}."))
    remarks = [sentence(words(item)) for item in known]
    blocks.append(Remarks(tuple(remarks), "plain"))

    # On a page of several channels each picture says of which it is.
    about = "Gain"
    if channel.file:
        about = f"{channel.name}: gain"
    caption = (
        f"{about} and scatter at every frequency of the input. Points above the noise curve are nonlinear "
        "distortion."
    )
    blocks.append(Picture("distortion", caption, (distortions, channel.units), channel.file))
    levels_told = [each for each in distortions if each.excited is not None and len(each.bands_rad_s)]
    if levels_told:
        blocks.append(_distortion_table(levels_told, channel.units[0]))
    return blocks


def _distortion_table(levels_told: Sequence[Distortion], input_unit: str) -> Table:
    """Noise and distortion by amplitude and band; levels_told: of one band or more each."""
    rows = []
    for levels in levels_told:
        assert levels.excited is not None
        for low, high in levels.bands_rad_s:
            at = levels.excited.within(low, high)
            if at is None:
                continue
            # Odd and even lines where the input left some of them out; else the cell is empty.
            odd_percent = None
            if levels.odd is not None:
                odd = levels.odd.within(low, high)
                if odd is not None:
                    odd_percent = 100 * odd.distortion
            even_percent = None
            if levels.even is not None:
                even = levels.even.within(low, high)
                if even is not None:
                    even_percent = 100 * even.distortion
            rms = number(levels.rms)
            band = f"{number(low)} to {number(high)}"
            distortion = number(100 * at.distortion, 2)
            least, most = at.interval
            interval = f"{number(100 * least, 2)} to {number(100 * most, 2)}"
            odd_cell = number(odd_percent, 2)
            even_cell = number(even_percent, 2)
            noise = number(100 * at.noise, 2)
            rows.append((rms, band, distortion, interval, odd_cell, even_cell, noise))
    head = (
        f"input, rms [{input_unit or 'as logged'}]",
        "band [rad/s]",
        "distortion, of the gain [%]",
        "95 % interval [%]",
        "odd lines [%]",
        "even lines [%]",
        "noise [%]",
    )
    made = [
        f"{count(levels.realisations, 'realisation')} of {count(levels.periods, 'period')}"
        for levels in levels_told
    ]
    caption = f"{made[0]} at each amplitude."
    if len(set(made)) > 1:
        at_each = [
            f"{how} at {si(each.rms, input_unit)}" for how, each in zip(made, levels_told, strict=True)
        ]
        caption = f"{listing(at_each)}."
    return Table(head, tuple(rows), caption)


def rig_page(notes: Notes) -> PageSection:
    """What the user says about the rig."""
    blocks: list[Block] = [
        Remarks(tuple(notes.known), "good", "Known"),
        Remarks(tuple(notes.unknown), "warning", "Not known"),
    ]
    if not notes.known and not notes.unknown:
        blocks.append(Text("The configuration says nothing about the rig ([notes] known, unknown)."))
    return PageSection("rig", "What is known about the rig", "Rig", tuple(blocks))


def reproduce_page(view: AnyRunView, *, is_design: bool) -> PageSection:
    """Seed, versions and hashes; times differ from run to run and stay in the manifest.

    Args:
        view: The run.
        is_design: The page stands away from the run's files, and names none of them.
    """
    manifest = view.manifest
    rows: list[tuple[object, ...]] = [("seed of every random stream", view.config.run.seed)]
    rows += sorted((manifest.get("versions") or {}).items(), key=lambda item: item[0].lower())
    for name, stage in (manifest.get("stages") or {}).items():
        if stage.get("taken_over_from"):
            rows.append((f"stage {name}", f"taken over from {stage['taken_over_from']}"))
    blocks: list[Block] = [Table(("what", "value"), tuple(rows))]
    inputs = manifest.get("inputs")
    if inputs:
        blocks.append(Table(("input file", "SHA-256"), tuple(inputs.items())))
    if not is_design:
        blocks.append(
            Text(
                "Beside this page: the configuration as it was given (config.toml), times of the stages "
                "(manifest.json)."
            )
        )
    return PageSection("reproduce", "To reproduce this", "Reproduce", tuple(blocks))
