"""Records into one GOBF model per channel, and how it does on records it has not seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ident.basis.options import EmbeddingOptions, IdentOptions
from ident.checks.distortion_findings import amplitude_effects
from ident.checks.early_checks import clipped, early_doubts
from ident.checks.plausible_modes import pairs_outside
from ident.checks.residual_tests import fed_back, independence_test
from ident.checks.validation import fit_in_windows, fit_on_fresh_data
from ident.closed_loop import EXPLAINED_PERCENT, TwoStage, two_stage, with_controller
from ident.data.arrays import clipped_share
from ident.data.finding import Finding, FindingKind, distinct, finding
from ident.data.record import Record
from ident.data.signal_filter import band_limited, increments, settling_time_s
from ident.friction import (
    FrictionFit,
    fit_friction,
    identify_behind,
    recorded_in_loop,
    refuse_unseen_shaft,
    remote_friction,
    without_remote_friction,
)
from ident.one_input import identify
from ident.recorded_law import RecordedLaw
from ident.recorded_loop import fit_in_loop, opened_by_loop
from ident.response_uncertainty import NOISE_ORDERS
from ident.search.order_selection import Progress
from ident.stabilisation import stabilisation
from ident.uncertainty.embedding import tangent
from workflow.config.run_config import Channel, ClosedLoopData, FileSource, Role
from workflow.engine.errors import naming
from workflow.tasks.results import IdentifiedChannel, IdentifyResult
from workflow.tasks.stage import StageInput
from workflow.text.templates import said

_OF_THE_FIT = 0.6  # share of the time; the stabilisation plot takes the rest
# Samples of a record that tell whether its command follows its output.
_TELLING = 50_000


def as_fitted(record: Record, channel: Channel, friction: FrictionFit | None = None) -> Record:
    """The channel's columns as the pole search sees them: as measured, as increments, or inside the band; as
    if there were no friction, where it is given."""
    record = record.siso(channel.input, channel.output)
    if friction is not None:
        return friction.taken_off(record)
    if channel.increments:
        return increments(record)
    return record if channel.band_rad_s is None else _inside(record, channel, channel.band_rad_s)


def as_bounded(record: Record, channel: Channel, friction: FrictionFit | None = None) -> Record:
    """The channel's columns as the ellipses see them; the same unless a wider band is given for them."""
    if channel.bounds_band_rad_s is None:
        return as_fitted(record, channel, friction)
    return _inside(record.siso(channel.input, channel.output), channel, channel.bounds_band_rad_s)


def _inside(record: Record, channel: Channel, band_rad_s: tuple[float, float]) -> Record:
    """The record within a band; without the start that the filter spoils, unless it starts from rest, of a
    short one half."""
    filtered = band_limited(record, *band_rad_s)
    if channel.identification.estimate_initial_state is False:
        return filtered
    settled = round(settling_time_s(record.dt_s, *band_rad_s) / record.dt_s)
    return filtered.slice(min(settled, record.n_samples // 2), record.n_samples)


def _searched_around(channel: Channel, dt_s: float) -> IdentOptions:
    """No pair far outside the band, unless bounds are stated: it could only fit the filter's skirts."""
    options, band = channel.identification, channel.band_rad_s
    if band is None or options.coordinates == "raw":
        return options
    bounds = {"omega_min_rad_s": band[0] / 2, "omega_max_rad_s": min(2 * band[1], 0.9 * np.pi / dt_s)}
    return options.model_copy(update={k: v for k, v in bounds.items() if getattr(options, k) is None})


def identify_channels(stage: StageInput) -> IdentifyResult:
    """Fit every channel; free runs on all validation and repeat records."""
    config, records = stage.config, stage.results.records
    unseen = [(item.record, item.role) for item in records.records if item.role != "estimation"]
    friction, shaft = None, config.control_channel
    if config.friction_identified:
        with naming(f"channel {shaft.label!r}"):
            progress = partial(stage.progress.update, "identify", 0.0)
            others = [one for one in config.channels if one is not shaft]
            friction = shaft_friction(
                records.fitted(shaft),
                shaft,
                lambda done, what: progress(what),
                free=any(one.uncertainty.friction_identified for one in others),
            )
    in_loop = isinstance(config.source, FileSource) and (
        config.closed_loop_data.stated or made_in_loop(records.fitted(shaft))
    )
    scale = config.source.scale if isinstance(config.source, FileSource) else {}
    channels = []
    for k, channel in enumerate(config.channels):

        def report(fraction: float, message: str, k: int = k, label: str = channel.label) -> None:
            stage.progress.update("identify", (k + fraction) / len(config.channels), f"{label}: {message}")

        with naming(f"channel {channel.label!r}"):
            known = friction if channel.uncertainty.friction_identified else None
            if known is not None and known.observed and k != config.control_index:
                raise ValueError(
                    "the friction of logs made in a loop is known behind the output that is fed back only: "
                    "leave this channel out, or give it response = 'as recorded'"
                )
            measured = records.fitted(channel)
            loop = config.closed_loop_data if in_loop else None
            units = scale.get(channel.input, 1.0) / scale.get(channel.output, 1.0)
            # The law is that of the output that is fed back.
            timing = records.timing if k == config.control_index else None
            channels.append(
                identify_channel(
                    channel,
                    measured,
                    unseen,
                    loop,
                    report,
                    friction=known,
                    units=units,
                    law=None if timing is None else timing.law,
                )
            )
    return IdentifyResult(tuple(channels), friction)


def made_in_loop(measured: Sequence[Record]) -> bool:
    """Whether records of the output that may be fed back were made in closed loop."""
    return recorded_in_loop([record.slice(0, min(record.n_samples, _TELLING)) for record in measured])


def shaft_friction(
    measured: Sequence[Record],
    channel: Channel,
    report: Progress,
    *,
    free: bool = False,
) -> FrictionFit:
    """Coulomb friction of the shaft whose position a channel measures; free: as of `fit_friction`, for other
    outputs behind the same friction."""
    found = fit_friction(measured, channel.identification, free=free, progress=report)
    refuse_unseen_shaft(found, measured)
    return found


def identify_channel(
    channel: Channel,
    measured: Sequence[Record],
    unseen: Sequence[tuple[Record, Role]],
    loop: ClosedLoopData | None,
    report: Progress,
    *,
    friction: FrictionFit | None = None,
    with_plot: bool = True,
    units: float = 1.0,
    law: RecordedLaw | None = None,
) -> IdentifiedChannel:
    """One channel from records: what `flexlink run` and `flexlink identify` do.

    measured: SISO, as recorded; unseen: others, with their roles; loop: how to use logs made in closed loop,
    None for others; friction: of the shaft that the output is the position of; units: as of
    `with_stated_controller`; law: that repeats the command of these records, where one is known. Raises
    ValueError, one line, where the logs cannot carry it.
    """
    if channel.uncertainty.friction_remote:
        return _behind_remote_friction(
            channel, measured, unseen, loop, report, with_plot=with_plot, units=units
        )
    options, given = _searched_around(channel, measured[0].dt_s), None
    # The arm with friction was fitted without delay, and a closed loop looks like one.
    as_logged = options if friction is None and loop is None else options.with_delay_stated()
    # A free run of an integrating plant drifts away with friction; it is judged as it was fitted.
    fresh = [(as_fitted(record, channel, friction), role) for record, role in unseen]
    doubted = (*measured, *(record for record, _ in unseen))
    doubts = [doubt for record in doubted for doubt in record.doubts]
    doubts = list(distinct([*doubts, *early_doubts(measured)]))

    def fitted(opened: TwoStage | None, closed_loop: Finding | None = None) -> IdentifiedChannel:
        if opened is None:
            bounded = [as_bounded(record, channel, friction) for record in measured]
            used = [as_fitted(record, channel, friction) for record in measured]
        else:
            used = bounded = list(opened.records)
            if channel.bounds_band_rad_s is not None:
                used = [as_fitted(record, channel) for record in bounded]
        found = identified_channel(
            channel.label,
            used,
            fresh,
            as_logged if opened is None else options,
            report,
            with_plot=with_plot,
            friction=friction,
        )
        if friction is not None:
            # What stands at its limit is seen in what was measured, not where the friction is taken off.
            others = [w for w in found.identification.search.warnings if w.kind is not FindingKind.CLIPPED]
            found = with_warnings(found, [*others, *clipped(measured)])
        warnings = [*doubts, *amplitude_effects(measured), *found.identification.warnings]
        model = found.model
        if (band := channel.data_band_rad_s) is not None:
            # The search may go an octave further.
            warnings += pairs_outside(model.poles, options.fixed(), model.dt_s, band)
        return replace(
            with_warnings(found, [*warnings, *(opened.warnings if opened else ())]),
            bounded=tuple(bounded),
            increments=channel.increments,
            band_rad_s=channel.band_rad_s,
            bounds_band_rad_s=channel.bounds_band_rad_s,
            closed_loop=closed_loop,
        )

    if friction is not None:
        return fitted(
            None,
            finding(FindingKind.DIRECT_WITH_FRICTION) if friction.observed and loop is not None else None,
        )
    if loop is None:
        return fitted(None)
    moving = all(record.reference is not None and np.ptp(record.reference) > 0 for record in measured)
    controlled = loop.controlled
    ways = [("two_stage", moving), ("direct", True), ("indirect", controlled)]
    explained = None
    filtered = channel.increments or channel.band_rad_s is not None
    by_reference = moving and not filtered and loop.method in ("auto", "two_stage")
    if by_reference and law is not None and law.on_error is not None:
        found_in_loop = _in_recorded_loop(fitted, measured, options, law)
        if found_in_loop is not None:
            return found_in_loop
    for way in [way for way, open_ in ways if open_] if loop.method == "auto" else [loop.method]:
        if way == "direct":
            found = fitted(None)
            given, spoilt = _direct(found, explained, stated=loop.method == "direct")
            if not spoilt or loop.method != "auto":
                return replace(found, closed_loop=given)
            continue
        known = measured if way == "two_stage" else with_stated_controller(measured, loop, units)
        opened = two_stage([as_bounded(record, channel) for record in known], options)
        explained = min(opened.fit_percent)
        if explained >= EXPLAINED_PERCENT or loop.method != "auto":
            kind = FindingKind.TWO_STAGE if way == "two_stage" else FindingKind.INDIRECT
            return fitted(opened, finding(kind, **opened.finding.values))
    assert given is not None
    raise ValueError(said("loop_refused", given.values, controlled))


def _behind_remote_friction(
    channel: Channel,
    measured: Sequence[Record],
    unseen: Sequence[tuple[Record, Role]],
    loop: ClosedLoopData | None,
    report: Progress,
    *,
    with_plot: bool,
    units: float,
) -> IdentifiedChannel:
    """The channel from records without the friction of a shaft that the sensor does not see, with that
    friction; arguments as of `identify_channel`.

    The law of a controller made the command, not what friction leaves of it, so it is of no use here. Raises
    ValueError, one line, where the logs were not made in a loop or do not tell such a friction.
    """
    if loop is None:
        raise ValueError("response = 'without remote friction' is for logs of a loop; none was seen in these")
    described = channel.uncertainty.model_copy(update={"response": "as recorded"})
    plain = channel.model_copy(update={"uncertainty": described})
    as_recorded = identify_channel(plain, measured, [], loop, report, with_plot=False, units=units)
    remote = remote_friction(measured, as_recorded.model)
    free = [without_remote_friction(record, remote) for record in measured]
    free_unseen = [
        (without_remote_friction(record.siso(channel.input, channel.output), remote), role)
        for record, role in unseen
    ]
    found = identify_channel(plain, free, free_unseen, loop, report, with_plot=with_plot, units=units)
    return replace(found, remote=remote)


def _in_recorded_loop(
    fitted: Callable[[TwoStage, Finding], IdentifiedChannel],
    measured: Sequence[Record],
    options: IdentOptions,
    law: RecordedLaw,
) -> IdentifiedChannel | None:
    """The channel identified from records that the loop of a known law opens, with what a free run in that
    loop explains of each; None where a command was limited, the reference explains too little of the command,
    or the model of the motion.

    fitted: the identification of opened records; law: of the error, `on_error`.
    """
    # A command that stands at a limit is not the one that the law asked for.
    if any(record.cut or clipped_share(record.input[:, 0]) > 0 for record in measured):
        return None
    opened = opened_by_loop(measured, law, options)
    if min(opened.fit_percent) < EXPLAINED_PERCENT:
        return None
    found = fitted(opened, opened.finding)
    if found.model.feedthrough:
        return found
    percent = [fit_in_loop(found.model, record, law).fit_percent for record in measured]
    if min(percent) < EXPLAINED_PERCENT:
        return None
    explained = {"least_in_loop_percent": min(percent), "most_in_loop_percent": max(percent)}
    return replace(found, closed_loop=finding(FindingKind.TWO_STAGE, **opened.finding.values, **explained))


def with_stated_controller(
    measured: Sequence[Record], loop: ClosedLoopData, units: float = 1.0
) -> list[Record]:
    """The records with what the stated controller tells of the reference. units: of the records, over those
    of the logs, in which the controller is: scale of the input over that of the output. Raises InputError for
    a file that holds none."""
    if loop.controller is not None:
        numerator, denominator = list(loop.controller.numerator), list(loop.controller.denominator)
    else:
        from workflow.tasks.system_files import read_controller  # what reads systems is slow to load

        assert loop.controller_file is not None
        numerator, denominator = read_controller(loop.controller_file, measured[0].dt_s)
    numerator = [units * one for one in numerator]
    return [with_controller(record, numerator, denominator) for record in measured]


def _direct(found: IdentifiedChannel, explained: float | None, *, stated: bool) -> tuple[Finding, bool]:
    """What is to be said of the logged input taken as it is, and whether noise that the loop fed back spoils
    the model.

    Feedback does no harm where the residuals are not found again in later inputs; else what they have in
    common with the input is held against the ellipses, which take model and noise as independent.
    """
    model, residuals = found.model, found.identification.residuals
    delay = model.input_delay_samples
    inputs = [record.input[: record.n_samples - delay, 0] for record in found.used]
    why, times = "clean", 0.0
    if independence_test(inputs, residuals).precedes_input:
        bounds = EmbeddingOptions(coloured_noise=True, max_ar_order=NOISE_ORDERS[-1])
        times = fed_back(tangent(found.bounded, model, bounds), found.bounded)
        why = "small" if times <= 1 else "spoilt"
    told = {} if explained is None else {"explained_percent": explained}
    return finding(FindingKind.DIRECT, why=why, times=times, stated=stated, **told), why == "spoilt"


def with_warnings(found: IdentifiedChannel, warnings: Sequence[Finding]) -> IdentifiedChannel:
    """The channel with this as what is doubtful of its model."""
    search = replace(found.identification.search, warnings=tuple(warnings))
    return replace(found, identification=replace(found.identification, search=search))


def identified_channel(
    name: str,
    used: Sequence[Record],
    fresh: Sequence[tuple[Record, Role]],
    options: IdentOptions,
    report: Progress,
    *,
    with_plot: bool = True,
    friction: FrictionFit | None = None,
) -> IdentifiedChannel:
    """Model of SISO records as the fit is to see them, with free runs on the records it does not see.

    friction: taken off these records; of logs made in a loop, everything is over windows and behind its
    observer, because the arm drifts.
    """
    share, in_loop = _OF_THE_FIT if with_plot else 1.0, friction is not None and friction.observed

    def part(done: float, what: str) -> None:
        report(share * done, what)

    if friction is not None and in_loop:
        found = identify_behind(friction, used, options, part)
        options = options.model_copy(update={"input_delay_samples": found.model.input_delay_samples})
    else:
        found = identify(used, options, progress=part)
    again = fit_in_windows if in_loop else fit_on_fresh_data
    fits = tuple(again(found.model, record) for record, _ in fresh)
    unseen = [
        finding(FindingKind.NO_ANSWER_THERE, record=record.label, fit_percent=fit.fit_percent)
        for fit, (record, _) in zip(fits, fresh, strict=True)
        if not fit.answers
    ]
    # All of its warnings are looked for now, so that it is a plain value.
    found = replace(found, search=replace(found.search, warnings=(*found.warnings, *unseen)), advise=tuple)
    plot = (
        stabilisation(
            used, found, options, progress=lambda done, what: report(share + (1 - share) * done, what)
        )
        if with_plot
        else None
    )
    return IdentifiedChannel(
        name=name,
        identification=found,
        used=tuple(used),
        bounded=tuple(used),
        fresh=fits,
        fresh_roles=tuple(role for _, role in fresh),
        stabilisation=plot,
    )
