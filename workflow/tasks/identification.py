"""Records into one GOBF model per channel, and how it does on records it has not seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from ident.basis.options import IdentOptions
from ident.checks.distortion_findings import amplitude_effects
from ident.checks.input_checks import clipped
from ident.checks.validation import fit_in_windows, fit_on_fresh_data
from ident.closed_loop import two_stage
from ident.data.finding import Finding, FindingKind, finding
from ident.data.record import Record
from ident.data.signal_filter import band_limited, increments
from ident.friction import (
    FrictionFit,
    fit_friction,
    identify_behind,
    refuse_unrecorded,
    refuse_unseen_shaft,
)
from ident.one_input import identify
from ident.stabilisation import stabilisation
from workflow.config.run_config import Channel, Role
from workflow.engine.errors import naming
from workflow.tasks.results import IdentifiedChannel, IdentifyResult
from workflow.tasks.stage import StageInput

Report = Callable[[float, str], None]
_OF_THE_FIT = 0.6  # share of the time; the stabilisation plot takes the rest


def as_fitted(record: Record, channel: Channel, friction: FrictionFit | None = None) -> Record:
    """The channel's columns as the pole search sees them: as measured, as increments, or inside the band; as
    if there were no friction, where it is given."""
    record = record.siso(channel.input, channel.output)
    if friction is not None:
        return friction.taken_off(record)
    if channel.increments:
        return increments(record)
    return record if channel.band_rad_s is None else band_limited(record, *channel.band_rad_s)


def as_bounded(record: Record, channel: Channel, friction: FrictionFit | None = None) -> Record:
    """The channel's columns as the ellipses see them; the same unless a wider band is given for them."""
    if channel.bounds_band_rad_s is None:
        return as_fitted(record, channel, friction)
    return band_limited(record.siso(channel.input, channel.output), *channel.bounds_band_rad_s)


def identify_channels(stage: StageInput) -> IdentifyResult:
    """Fit every channel; free runs on all validation and repeat records."""
    config, records = stage.config, stage.results.records
    measured = [item.record for item in records.of_role("estimation")]
    unseen = [item for item in records.records if item.role != "estimation"]
    friction = friction_of(stage) if config.friction_identified else None
    channels = []
    for k, channel in enumerate(config.channels):

        def report(fraction: float, message: str, k: int = k, label: str = channel.label) -> None:
            stage.progress.update("identify", (k + fraction) / len(config.channels), f"{label}: {message}")

        with naming(f"channel {channel.label!r}"):
            known = friction if channel.uncertainty.friction_identified else None
            if known is not None and known.in_loop and k != config.control_index:
                raise ValueError(
                    "the friction of logs made in a loop is known behind the output that is fed back only: "
                    "leave this channel out, or give it response = 'as recorded'"
                )
            bounded, finding = [as_bounded(record, channel, known) for record in measured], None
            used = [as_fitted(record, channel, known) for record in measured]
            if config.closed_loop_data.method == "two_stage":
                opened = two_stage(bounded, channel.identification)
                used = bounded = list(opened.records)
                finding = opened.finding
                if channel.bounds_band_rad_s is not None:
                    used = [as_fitted(record, channel) for record in bounded]
            options = channel.identification
            if known is not None or finding is not None:
                # The arm with friction was fitted without delay, and a closed loop looks like one.
                options = options.with_delay_stated()
            found = identified_channel(
                channel.label,
                used,
                # A free run of an integrating plant drifts away with friction; it is judged as it was fitted.
                [(as_fitted(item.record, channel, known), item.role) for item in unseen],
                options,
                report,
                two_stage=finding,
                friction=known,
            )
            as_measured = records.fitted(channel)
            if known is not None:
                found = clipped_as_measured(found, as_measured)
            warnings = found.identification.search.warnings
            found = with_warnings(found, (*warnings, *amplitude_effects(as_measured)))
            channels.append(
                replace(
                    found,
                    bounded=tuple(bounded),
                    increments=channel.increments,
                    band_rad_s=channel.band_rad_s,
                    bounds_band_rad_s=channel.bounds_band_rad_s,
                )
            )
    return IdentifyResult(tuple(channels), friction)


def with_warnings(found: IdentifiedChannel, warnings: Sequence[Finding]) -> IdentifiedChannel:
    """The channel with this as what is doubtful of its model."""
    search = replace(found.identification.search, warnings=tuple(warnings))
    return replace(found, identification=replace(found.identification, search=search))


def clipped_as_measured(found: IdentifiedChannel, measured: Sequence[Record]) -> IdentifiedChannel:
    """What stands at its limit is seen in what was measured, not in what taking the friction off has left."""
    warnings = found.identification.search.warnings
    others = [warning for warning in warnings if warning.kind is not FindingKind.CLIPPED]
    return with_warnings(found, [*others, *clipped(measured)])


def friction_of(stage: StageInput) -> FrictionFit:
    """Coulomb friction of the shaft whose position the control channel measures."""
    channel = stage.config.control_channel
    with naming(f"channel {channel.label!r}"):
        at_shaft = stage.results.records.fitted(channel)
        for other in stage.config.channels:
            refuse_unrecorded(at_shaft, other.uncertainty.amplitudes)
        found = fit_friction(
            at_shaft,
            channel.identification,
            progress=lambda done, what: stage.progress.update("identify", 0.0, what),
        )
        refuse_unseen_shaft(found, at_shaft)
        return found


def identified_channel(
    name: str,
    used: Sequence[Record],
    fresh: Sequence[tuple[Record, Role]],
    options: IdentOptions,
    report: Report,
    *,
    with_plot: bool = True,
    two_stage: Finding | None = None,
    friction: FrictionFit | None = None,
) -> IdentifiedChannel:
    """Model of SISO records as the fit is to see them, with free runs on the records it does not see.

    friction: taken off these records; of logs made in a loop, everything is over windows and behind its
    observer, because the arm drifts.
    """
    share, in_loop = _OF_THE_FIT if with_plot else 1.0, friction is not None and friction.in_loop

    def part(done: float, what: str) -> None:
        report(share * done, what)

    if friction is not None and in_loop:
        found = identify_behind(friction, used, options, part)
        known = found.model.input_delay_samples
        options = options.model_copy(update={"input_delay_samples": known})
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
    plot = None
    if with_plot:
        plot = stabilisation(
            used, found, options, progress=lambda done, what: report(share + (1 - share) * done, what)
        )
    return IdentifiedChannel(
        name=name,
        identification=found,
        used=tuple(used),
        bounded=tuple(used),
        fresh=fits,
        fresh_roles=tuple(role for _, role in fresh),
        stabilisation=plot,
        two_stage=two_stage,
    )
