"""What a run says at its end, on a terminal and to programs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from control_design.controllers.engineers_numbers import ControllerNumbers, engineers_numbers
from control_design.specification import Specification
from control_design.synthesis.synthesis_result import BlockingPoint
from ident.command_timing import CommandTiming
from ident.data.finding import Finding
from workflow.config.run_config import AnyConfig, RunConfig
from workflow.describe.certificate import certificate_section, margin_rows, margins_by_key
from workflow.describe.closed_loop import closed_loop_numbers, loop_numbers, loop_section
from workflow.describe.controller import controller_section, pid_row
from workflow.describe.design import design_section, filter_section, gave_way_text, run_verdict
from workflow.describe.facts import Row, Section, answer, said, worded
from workflow.describe.friction import amplitude_row, friction_row
from workflow.describe.identification import model_rows
from workflow.describe.records import records_section
from workflow.describe.summary import RunSummary
from workflow.describe.uncertainty import channel_numbers, ellipse_rows, untold_below_rad_s
from workflow.engine import codec
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.design import bracket_numbers, joint_numbers
from workflow.tasks.exports import Logged
from workflow.tasks.giving_way import gave_way
from workflow.tasks.results import AnyResults, CertifyResult, DesignResult, RunResults
from workflow.text.findings.sentences import words
from workflow.text.sentences.design import lowered, tracking_begins


def summarise(results: RunResults, config: RunConfig) -> RunSummary:
    """What a run of one loop says whose stages are all there."""
    document = run_document(results, config)
    certificate = results.certify.certificate
    if certificate is not None:
        # For programs: a terminal has them in one line of words.
        document = with_rows(document, [Section("margins", margins_by_key(certificate))])
    sections = run_sections(results, config)
    return summary_of(results, config, sections, document, verdict_of_run(results, config))


def summary_of(
    results: AnyResults,
    config: AnyConfig,
    sections: Sequence[Section],
    document: Mapping[str, Any],
    verdict: str,
) -> RunSummary:
    """The summary of a run, of one loop or of several joints.

    Parameters
    ----------
    results : AnyResults
    config : AnyConfig
    sections : sequence of Section
        Rows for a terminal.
    document : mapping of str to value
        The stages for programs.
    verdict : str
        In one line.
    """
    return RunSummary(
        title=title_of(config, results.run),
        sections=sections,
        numbers=with_rows(document, sections),
        certified=results.certified and results.settles,
        verdict=verdict,
        report_path=str(results.run.report_path) if results.run.report_path.is_file() else None,
        taken_over=results.run.taken_over(),
    )


def title_of(config: AnyConfig, run: RunDirectory) -> str:
    """Headline of a run: what the configuration calls it, else its folder."""
    named = config.run.name != type(config.run).model_fields["name"].default
    return config.run.title or (config.run.name if named else run.path.resolve().name)


def with_rows(document: Mapping[str, Any], sections: Sequence[Section]) -> dict[str, Any]:
    """The stages of a run for programs, with every row that has a key in its place beside them.

    Raises:
        ValueError: A row has the key of something that is there.
    """
    return _merged(document, answer(sections))


def _merged(document: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(document)
    for key, value in more.items():
        present = merged.get(key)
        if isinstance(value, dict) and isinstance(present, dict):
            merged[key] = _merged(present, value)
        elif present is None:
            merged[key] = value
        else:
            raise ValueError(f"the key {key!r} of a row is there already")
    return merged


def run_sections(results: RunResults, config: RunConfig) -> list[Section]:
    """The closed loop and the plant of a run of one loop, with everything else as their parts."""
    certify = results.certify
    design = results.design
    # Requirements may have given way: what was designed for is not always what was asked.
    asked = config.specification
    used = design.specification or asked
    given_way = gave_way(asked, design.specification)
    channel = config.control_channel
    input_unit = results.records.unit(channel.input)
    output_unit = results.records.unit(channel.output)
    signals = signals_where_scaled(config, results)
    numbers = numbers_of_controller(results, config)

    # What everybody sees first: how the loop moves, and how much it tolerates.
    rows = [*loop_numbers(results, config)]
    if certify.certificate is not None:
        rows += margin_rows(certify.certificate)
    gave_way_row = worded("gave way", gave_way_text(given_way))

    # Its parts, in the order in which one asks for them.
    loop_part = loop_section(
        results.closed_loop,
        input_unit,
        output_unit,
        feedforward=config.closed_loop.friction_feedforward,
    )
    certificate_part = certificate_section(
        certify,
        joint_numbers(certify.sampled),
        results.certified_for(config),
        whole=False,
    )
    design_part = design_section(
        design,
        results.achievable_performance,
        used.controller_order,
        bandwidth=lowered_bandwidth(results, config),
        given_way=given_way,
        tracking=tracking_begins(asked, design.specification),
        files=signals,
    )
    controller_part = controller_section(numbers, used.computational_delay_samples, signals)
    filter_part = filter_section(results.reference_filter)
    loop = Section(
        "closed loop",
        said(*rows, gave_way_row, pid_row(numbers)),
        parts=(loop_part, certificate_part, design_part, controller_part, filter_part),
    )

    # The plant: friction and doubts first, then records, channels and what friction makes of the response.
    friction = results.identify.friction
    plant_rows: list[Row | None] = []
    if friction is not None:
        plant_rows.append(friction_row(friction, input_unit, output_unit))
    warnings = [words(item) for item in warnings_of(results)]
    plant_rows.append(first_warning(warnings))
    records_part = records_section(results.records)
    channel_parts = channel_sections(results)
    amplitude = amplitude_row(results.uncertainty.equivalent, input_unit)
    friction_part = Section("friction", said(amplitude))
    plant = Section(
        "plant",
        said(*plant_rows),
        parts=(records_part, *channel_parts, friction_part),
    )
    return [loop, plant]


def channel_sections(results: RunResults) -> list[Section]:
    """Model and ellipses of every channel."""
    sections = []
    for channel, spread in zip(results.identify.channels, results.uncertainty.channels, strict=True):
        rows = (
            *model_rows(channel, spread.intervals, whole=False),
            *(worded("warning", words(item)) for item in channel.identification.warnings),
            *ellipse_rows(spread, whole=False),
        )
        sections.append(Section(f"channel {channel.name}", rows))
    return sections


def warnings_of(results: RunResults) -> list[Finding]:
    """Warnings about the models, and residual tests that fail, channel by channel."""
    warnings: list[Finding] = []
    for channel, spread in zip(results.identify.channels, results.uncertainty.channels, strict=True):
        warnings += channel.identification.warnings
        warnings += [test.finding for test in spread.tests if not test.passed]
    return warnings


def first_warning(warnings: Sequence[str]) -> Row | None:
    """The first of several warnings, and how many more there are; each counts once."""
    distinct = list(dict.fromkeys(warnings))
    if not distinct:
        return None
    further = ""
    if len(distinct) > 1:
        further = f" ({len(distinct) - 1} more: --verbose)"
    return worded("warning", f"{distinct[0]}{further}")


def signals_where_scaled(config: AnyConfig, results: AnyResults) -> str:
    """What the controller's files take and give, where that is not the quantities of the model; else ""."""
    signals = Logged.of(config, results.records).signals
    if "as logged" not in signals:
        return ""
    return signals


def lowered_bandwidth(results: RunResults, config: RunConfig) -> str:
    """Which bandwidth is which where a lower one was taken than specified; "" elsewhere."""
    design = results.design
    asked = config.specification
    blocking: tuple[BlockingPoint, ...] = ()
    if design.synthesis is not None:
        blocking = design.synthesis.blocking
    bandwidths = bandwidth_numbers(design, results.certify, asked)
    reached_rad_s = bandwidths["reached"] or 0.0
    return lowered(asked, design.specification, blocking, reached_rad_s)


def numbers_of_controller(results: RunResults, config: RunConfig) -> ControllerNumbers | None:
    """The controller in an engineer's numbers, as the run's files have it; None without one, and where it has
    no such factors."""
    if results.design.controller is None:
        return None
    # As it is written to files: for the columns of the logs.
    logged = Logged.of(config, results.records)
    law = logged.law(results.design.controller)
    return engineers_numbers(law)


def verdict_of_run(results: RunResults, config: RunConfig) -> str:
    """The verdict on a run of one loop in one line."""
    design = results.design
    used = design.specification or config.specification
    fed_back = results.uncertainty.channels[config.control_index]
    return run_verdict(
        design,
        results.certify,
        results.closed_loop,
        results.achievable_performance,
        used.controller_order,
        untold_below_rad_s(fed_back.frequency),
        results.uncertainty.conditions(config),
        config.specification,
        results.identify.modes_rad_s,
    )


def run_document(results: RunResults, config: RunConfig) -> dict[str, Any]:
    """The stages of a run of one loop for programs."""
    design = results.design
    certify = results.certify
    synthesis = design.synthesis
    asked = config.specification
    used = design.specification or asked

    # Without a controller the keys stay: a program finds an answer to every question.
    outcome = "IMPOSSIBLE"
    blocking: Any = []
    if synthesis is not None:
        outcome = synthesis.outcome.name
        blocking = codec.plain(synthesis.blocking)
    controller_dt_s = None
    if design.controller is not None:
        controller_dt_s = design.controller.dt_s
    numbers = numbers_of_controller(results, config)
    engineers = None
    if numbers is not None:
        engineers = numbers.to_dict()

    channels = []
    pairs = zip(results.identify.channels, results.uncertainty.channels, strict=True)
    for channel, spread in pairs:
        channels.append(channel_numbers(channel, spread))
    conditions = [words(doubt) for doubt in results.uncertainty.conditions(config)]
    return {
        "command_timing": timing_numbers(results.records.timing),
        "channels": channels,
        "design": {
            "met": design.met,
            "reason": design.reason,
            "gamma": design.gamma,
            "outcome": outcome,
            "blocking": blocking,
            "bandwidth_rad_s": bandwidth_numbers(design, certify, asked),
            "gave_way": codec.plain(gave_way(asked, design.specification)),
            "tracking_from_rad_s": used.tracking_from_rad_s,
            "controller_dt_s": controller_dt_s,
        },
        "engineers_numbers": engineers,
        "signals": Logged.of(config, results.records).signals,
        "certificate": codec.plain(certify.certificate),
        "certificate_conditions": conditions,
        "achievable_performance": bracket_numbers(results.achievable_performance, design.gamma),
        "sampled_responses": joint_numbers(certify.sampled),
        "reference_filter": codec.plain(results.reference_filter.filter),
        "closed_loop": closed_loop_numbers(results.closed_loop),
    }


def timing_numbers(timing: CommandTiming | None) -> dict[str, Any] | None:
    """How the period of the controller that made the logs is known; None of simulated records."""
    if timing is None:
        return None
    return {
        "source": timing.source.value,
        "row_step_s": timing.row_step_s,
        "controller_period_s": timing.period_s,
        "rows_per_command": timing.rows_per_command,
        "known": timing.known,
    }


def bandwidth_numbers(
    design: DesignResult, certify: CertifyResult, asked: Specification
) -> dict[str, float | None]:
    """Bandwidths [rad/s] specified, designed for, and reached: up to there every plant has |S| below -3 dB.

    "reached" is None without a certificate, and where a nominal loop is unstable.
    """
    used = design.specification or asked
    # The slowest of several plants counts.
    reached = None
    if certify.certificate is not None:
        bandwidths = [plant.bandwidth_rad_s for plant in certify.certificate.plants]
        # nan of an unstable loop: min would pass over it or not, by the order of the plants.
        if not any(math.isnan(bandwidth) for bandwidth in bandwidths):
            reached = min(bandwidths, default=None)
    return {
        "specified": asked.bandwidth_rad_s,
        "designed_for": used.bandwidth_rad_s,
        "reached": reached,
    }
