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
from workflow.text.sentences.records import loop_refused

# Share of the time that the fit takes; the stabilisation plot takes the rest. For the progress bar only.
_SHARE_OF_FIT = 0.6
# Samples of a record, from its start, that are searched for feedback from its output. Chosen for speed.
_SAMPLES_FOR_FEEDBACK = 50_000


def as_fitted(record: Record, channel: Channel, friction: FrictionFit | None = None) -> Record:
    """The channel's columns of a record as the pole search sees them: one input, one output.

    As if there were no friction, where a `friction` is passed; else as increments, inside the channel's band,
    or as measured.
    """
    record = record.siso(channel.input, channel.output)
    if friction is not None:
        return friction.taken_off(record)
    if channel.increments:
        return increments(record)
    return record if channel.band_rad_s is None else _inside(record, channel, channel.band_rad_s)


def as_bounded(record: Record, channel: Channel, friction: FrictionFit | None = None) -> Record:
    """The channel's columns of a record as the ellipses see them: as the pole search does, unless the channel
    states a wider band for them."""
    if channel.bounds_band_rad_s is None:
        return as_fitted(record, channel, friction)
    return _inside(record.siso(channel.input, channel.output), channel, channel.bounds_band_rad_s)


def _inside(record: Record, channel: Channel, band_rad_s: tuple[float, float]) -> Record:
    """A record within a band [rad/s], without the start that the filter spoils.

    A record from rest keeps its start; of a short one at most half is left out.
    """
    filtered = band_limited(record, *band_rad_s)
    if channel.identification.estimate_initial_state is False:
        return filtered
    settled = round(settling_time_s(record.dt_s, *band_rad_s) / record.dt_s)
    return filtered.slice(min(settled, record.n_samples // 2), record.n_samples)


def _searched_around(channel: Channel, dt_s: float) -> IdentOptions:
    """Options of the pole search that keep its pairs within an octave of the channel's band, unless bounds
    are stated: a pair far outside could only fit the filter's skirts."""
    options = channel.identification
    band = channel.band_rad_s
    if band is None or options.coordinates == "raw":
        return options
    bounds = {}
    if options.omega_min_rad_s is None:
        bounds["omega_min_rad_s"] = band[0] / 2
    if options.omega_max_rad_s is None:
        # An octave above the band: a mode beyond its end shows inside. Near Nyquist there is none.
        bounds["omega_max_rad_s"] = min(2 * band[1], 0.9 * np.pi / dt_s)
    return options.model_copy(update=bounds)


def identify_channels(stage: StageInput) -> IdentifyResult:
    """Models of every channel, with free runs on all validation and repeat records.

    Raises
    ------
    InputError
        One line that names the channel, where its logs cannot carry a model.
    """
    config = stage.config
    records = stage.results.records
    unseen = [(item.record, item.role) for item in records.records if item.role != "estimation"]

    # Friction is that of the shaft whose position is fed back; all channels share it.
    friction = None
    shaft = config.control_channel
    if config.friction_identified:
        with naming(f"channel {shaft.label!r}"):
            progress = partial(stage.progress.update, "identify", 0.0)
            other_channels = [channel for channel in config.channels if channel is not shaft]
            friction = shaft_friction(
                records.fitted(shaft),
                shaft,
                lambda done, what: progress(what),
                free=any(channel.uncertainty.friction_identified for channel in other_channels),
            )
    in_loop = False
    if isinstance(config.source, FileSource):
        in_loop = config.closed_loop_data.stated or made_in_loop(records.fitted(shaft))
    scale = config.source.scale if isinstance(config.source, FileSource) else {}
    channels = []
    for k, channel in enumerate(config.channels):

        def report(fraction: float, message: str, k: int = k, label: str = channel.label) -> None:
            share_done = (k + fraction) / len(config.channels)
            stage.progress.update("identify", share_done, f"{label}: {message}")

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
    return recorded_in_loop(
        [record.slice(0, min(record.n_samples, _SAMPLES_FOR_FEEDBACK)) for record in measured]
    )


def shaft_friction(
    measured: Sequence[Record],
    channel: Channel,
    report: Progress,
    *,
    free: bool = False,
) -> FrictionFit:
    """Coulomb friction of the shaft whose position a channel measures.

    Parameters
    ----------
    measured : sequence of Record
        One input, one output, as recorded.
    channel : Channel
    report : callable
        Called with the share that is done and a line.
    free : bool
        See `fit_friction`: for other outputs behind the same friction.

    Raises
    ------
    ValueError
        One line: the logs do not show this friction.
    """
    friction = fit_friction(measured, channel.identification, free=free, progress=report)
    refuse_unseen_shaft(friction, measured)
    return friction


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
    """The model of one channel from its records, in `flexlink run` and `flexlink identify` alike.

    Parameters
    ----------
    channel : Channel
    measured : sequence of Record
        The fit's records as recorded, one input and one output.
    unseen : sequence of tuples of Record and role
        Records that are not fitted, for free runs.
    loop : ClosedLoopData or None
        How logs that were made in closed loop are used; None: these were not.
    report : callable
        Called with the share that is done and a line.
    friction : FrictionFit, optional
        Of the shaft that the output is the position of.
    with_plot : bool
        Also compute the stabilisation plot.
    units : float
        See `with_stated_controller`.
    law : RecordedLaw, optional
        A law that repeats the command of these records.

    Raises
    ------
    ValueError
        One line: the logs cannot carry a model.
    """
    if channel.uncertainty.friction_remote:
        return _behind_remote_friction(
            channel, measured, unseen, loop, report, with_plot=with_plot, units=units
        )
    options = _searched_around(channel, measured[0].dt_s)
    # The arm with friction was fitted without delay, and a closed loop looks like one.
    as_logged = options if friction is None and loop is None else options.with_delay_stated()

    # A free run of an integrating plant drifts away with friction; it is judged as it was fitted.
    fresh = [(as_fitted(record, channel, friction), role) for record, role in unseen]
    doubted = (*measured, *(record for record, _ in unseen))
    doubts = [doubt for record in doubted for doubt in record.doubts]
    doubts = list(distinct([*doubts, *early_doubts(measured)]))

    def fitted(opened: TwoStage | None, closed_loop: Finding | None = None) -> IdentifiedChannel:
        """The channel from records that a reference opened, or, None, from the records as logged."""
        if opened is None:
            bounded = [as_bounded(record, channel, friction) for record in measured]
            used = [as_fitted(record, channel, friction) for record in measured]
        else:
            used = bounded = list(opened.records)
            if channel.bounds_band_rad_s is not None:
                used = [as_fitted(record, channel) for record in bounded]
        identified = identified_channel(
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
            not_clipped = [
                warning
                for warning in identified.identification.search.warnings
                if warning.kind is not FindingKind.CLIPPED
            ]
            identified = with_warnings(identified, [*not_clipped, *clipped(measured)])
        warnings = [*doubts, *amplitude_effects(measured), *identified.identification.warnings]
        model = identified.model
        band = channel.data_band_rad_s
        if band is not None:
            # The search may go an octave further.
            warnings += pairs_outside(model.poles, options.fixed(), model.dt_s, band)
        if opened:
            warnings = [*warnings, *opened.warnings]
        return replace(
            with_warnings(identified, warnings),
            bounded=tuple(bounded),
            increments=channel.increments,
            band_rad_s=channel.band_rad_s,
            bounds_band_rad_s=channel.bounds_band_rad_s,
            closed_loop=closed_loop,
        )

    if friction is not None:
        closed_loop = None
        if friction.observed and loop is not None:
            closed_loop = finding(FindingKind.DIRECT_WITH_FRICTION)
        return fitted(None, closed_loop)
    if loop is None:
        return fitted(None)

    # Where a known law on the error made the command, that loop itself opens the records.
    moving = all(record.reference is not None and np.ptp(record.reference) > 0 for record in measured)
    controlled = loop.controlled
    filtered = channel.increments or channel.band_rad_s is not None
    by_reference = moving and not filtered and loop.method in ("auto", "two_stage")
    if by_reference and law is not None and law.on_error is not None:
        in_recorded_loop = _in_recorded_loop(fitted, measured, options, law)
        if in_recorded_loop is not None:
            return in_recorded_loop

    # Ways to use logs of a loop, in this order: the first one that explains the command, or whose residuals
    # the loop did not feed back.
    if loop.method != "auto":
        ways = [loop.method]
    else:
        ways = ["direct"]
        if moving:
            ways.insert(0, "two_stage")
        if controlled:
            ways.append("indirect")
    explained = None
    remark = None
    for way in ways:
        if way == "direct":
            direct = fitted(None)
            remark, spoilt = _direct(direct, explained, stated=loop.method == "direct")
            if not spoilt or loop.method != "auto":
                return replace(direct, closed_loop=remark)
            continue
        known = measured if way == "two_stage" else with_stated_controller(measured, loop, units)
        opened = two_stage([as_bounded(record, channel) for record in known], options)
        explained = min(opened.fit_percent)
        if explained >= EXPLAINED_PERCENT or loop.method != "auto":
            kind = FindingKind.TWO_STAGE if way == "two_stage" else FindingKind.INDIRECT
            return fitted(opened, finding(kind, **opened.finding.values))
    # "direct" is among the ways of "auto", and a stated way has returned.
    assert remark is not None
    raise ValueError(loop_refused(remark.values, controlled))


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
    """The channel from records without the friction of a shaft that the sensor does not see, with `remote`.

    Parameters are those of `identify_channel`, but for the law: that made the command, not what friction
    leaves of it, so it is of no use here. Raises ValueError, one line, where the logs were not made in a loop
    or do not tell such a friction.
    """
    if loop is None:
        raise ValueError("response = 'without remote friction' is for logs of a loop; none was seen in these")
    described = channel.uncertainty.model_copy(update={"response": "as recorded"})
    plain = channel.model_copy(update={"uncertainty": described})
    as_recorded = identify_channel(plain, measured, [], loop, report, with_plot=False, units=units)
    remote = remote_friction(measured, as_recorded.model)
    free = [without_remote_friction(record, remote) for record in measured]
    free_unseen = []
    for record, role in unseen:
        shaft_record = record.siso(channel.input, channel.output)
        free_unseen.append((without_remote_friction(shaft_record, remote), role))
    identified = identify_channel(plain, free, free_unseen, loop, report, with_plot=with_plot, units=units)
    return replace(identified, remote=remote)


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
    identified = fitted(opened, opened.finding)
    if identified.model.feedthrough:
        return identified
    percent = [fit_in_loop(identified.model, record, law).fit_percent for record in measured]
    if min(percent) < EXPLAINED_PERCENT:
        return None
    explained = {"least_in_loop_percent": min(percent), "most_in_loop_percent": max(percent)}
    return replace(
        identified, closed_loop=finding(FindingKind.TWO_STAGE, **opened.finding.values, **explained)
    )


def with_stated_controller(
    measured: Sequence[Record], loop: ClosedLoopData, units: float = 1.0
) -> list[Record]:
    """The records with a reference made of the stated controller, each shorter by its order.

    Parameters
    ----------
    measured : sequence of Record
        One input, one output.
    loop : ClosedLoopData
        With a controller, or a file of one.
    units : float
        Scale of the input over that of the output, from the logs to the records: the controller is in units
        of the logs.

    Raises
    ------
    InputError
        One line: a file that holds no controller.
    """
    if loop.controller is not None:
        numerator = list(loop.controller.numerator)
        denominator = list(loop.controller.denominator)
    else:
        # What reads systems is slow to load.
        from workflow.tasks.system_files import read_controller

        assert loop.controller_file is not None
        numerator, denominator = read_controller(loop.controller_file, measured[0].dt_s)
    numerator = [units * coefficient for coefficient in numerator]
    return [with_controller(record, numerator, denominator) for record in measured]


def _direct(channel: IdentifiedChannel, explained: float | None, *, stated: bool) -> tuple[Finding, bool]:
    """What is to be said of a fit by the logged input, and whether noise that the loop fed back spoils it.

    Feedback does no harm where the residuals are not found again in later inputs; else what they have in
    common with the input is held against the ellipses, which take model and noise as independent.
    """
    model = channel.model
    residuals = channel.identification.residuals
    delay = model.input_delay_samples
    inputs = [record.input[: record.n_samples - delay, 0] for record in channel.used]
    why = "clean"
    times = 0.0
    if independence_test(inputs, residuals).precedes_input:
        bounds = EmbeddingOptions(coloured_noise=True, max_ar_order=NOISE_ORDERS[-1])
        times = fed_back(tangent(channel.bounded, model, bounds), channel.bounded)
        why = "small" if times <= 1 else "spoilt"
    by_reference = {} if explained is None else {"explained_percent": explained}
    remark = finding(FindingKind.DIRECT, why=why, times=times, stated=stated, **by_reference)
    return remark, why == "spoilt"


def with_warnings(channel: IdentifiedChannel, warnings: Sequence[Finding]) -> IdentifiedChannel:
    """The channel with these warnings of its model in place of its own."""
    search = replace(channel.identification.search, warnings=tuple(warnings))
    return replace(channel, identification=replace(channel.identification, search=search))


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
    """A channel from records that are prepared for the fit.

    Parameters
    ----------
    name : str
    used : sequence of Record
        One input, one output, as the fit is to see them.
    fresh : sequence of tuples of Record and role
        Records that the fit does not see, prepared alike, for free runs.
    options : IdentOptions
    report : callable
        Called with the share that is done and a line.
    with_plot : bool
        Also compute the stabilisation plot.
    friction : FrictionFit, optional
        Was taken off these records. Of logs made in a loop, model and free runs are over windows and behind
        its observer, because the arm drifts.
    """
    share = _SHARE_OF_FIT if with_plot else 1.0
    in_loop = friction is not None and friction.observed

    def part(done: float, what: str) -> None:
        report(share * done, what)

    if friction is not None and in_loop:
        identification = identify_behind(friction, used, options, part)
        options = options.model_copy(update={"input_delay_samples": identification.model.input_delay_samples})
    else:
        identification = identify(used, options, progress=part)
    again = fit_in_windows if in_loop else fit_on_fresh_data
    fits = tuple(again(identification.model, record) for record, _ in fresh)
    unseen = [
        finding(FindingKind.NO_ANSWER_THERE, record=record.label, fit_percent=fit.fit_percent)
        for fit, (record, _) in zip(fits, fresh, strict=True)
        if not fit.answers
    ]
    # All of its warnings are looked for now, so that it is a plain value.
    identification = replace(
        identification,
        search=replace(identification.search, warnings=(*identification.warnings, *unseen)),
        advise=tuple,
    )
    plot = None
    if with_plot:
        plot = stabilisation(
            used,
            identification,
            options,
            progress=lambda done, what: report(share + (1 - share) * done, what),
        )
    return IdentifiedChannel(
        name=name,
        identification=identification,
        used=tuple(used),
        bounded=tuple(used),
        fresh=fits,
        fresh_roles=tuple(role for _, role in fresh),
        stabilisation=plot,
    )
