"""Uncertainty: ellipses around every identified response, and what the residuals say about them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, pairwise

import numpy as np

from control_design.plants.frequency_grid import frequency_grid
from control_design.plants.plant_set import Mode
from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.checks.answer import refuse_unanswered
from ident.checks.residual_tests import residual_advice, residual_tests, whiteness_test
from ident.checks.validation import ScatterRow, repeat_scatter
from ident.command_timing import CommandTiming, with_unknown_timing
from ident.data.arrays import ComplexArray, RealArray
from ident.data.distortion import distortion_of
from ident.data.finding import FindingKind, finding
from ident.data.nonparametric import empirical_frf
from ident.data.record import Record
from ident.data.roles import is_position
from ident.data.signal_filter import increments
from ident.friction import (
    BehindFriction,
    EquivalentFriction,
    FrictionFit,
    RateMember,
    at_amplitude,
    equivalent_friction,
    other_output_without_friction,
    with_remote_friction,
    without_friction,
)
from ident.response_uncertainty import Tests, with_noise_model
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior
from ident.uncertainty.conditions import combine_posteriors, record_posteriors, repeat_posteriors
from ident.uncertainty.embedding import tangent
from ident.uncertainty.nominal import MOST_INSIDE_PERCENT, NominalAgreement, nominal_near, nominals_near
from ident.uncertainty.pole_intervals import growth_intervals, pole_intervals
from workflow.config.run_config import Channel
from workflow.config.uncertainty_options import UncertaintyOptions
from workflow.engine.errors import naming
from workflow.tasks.identification import as_bounded
from workflow.tasks.results import (
    Band,
    IdentifiedChannel,
    Intervals,
    ModeInterval,
    RunRecord,
    UncertainChannel,
    UncertainMember,
    UncertaintyResult,
)
from workflow.tasks.stage import StageInput
from workflow.text.findings.sentences import words
from workflow.text.sentences.records import rate_part, unexplained_logs

# Frequencies over a band of the data at least, some decade: a nominal model has a tenth as many numbers.
_FEWEST_FREQUENCIES = 100
# Share of the ellipses that hold a nominal model: below it the model is no member of the set it stands for.
_SHARE_INSIDE = 0.9
# A model explains nothing whose best fit to a log is below this, in percent: right ones had 90 and more,
# wrong ones 75 and less.
LEAST_FIT_PERCENT = 80.0
# With friction, the arm's free run is only doubted where it leaves more than so many times the sensor's
# noise.
_BEYOND_NOISE = 3.0

# Bands of equal width on the log axis in which radii and scatter are summarised. Chosen for a short table.
N_BANDS = 6


def find_uncertainty(stage: StageInput) -> UncertaintyResult:
    """Posterior, ellipses on a display grid, residual tests and repeat scatter of every channel."""
    config = stage.config
    records = stage.results.records
    identified = stage.results.identify
    control = config.control_index
    equivalent = None
    channels: dict[int, UncertainChannel] = {}
    # The control channel first: it says what the friction does at an amplitude, the same one for all.
    order = sorted(range(len(config.channels)), key=lambda k: k != control)
    for done, k in enumerate(order):
        channel = config.channels[k]
        result = identified.channels[k]
        stage.progress.update("uncertainty", done / len(order), channel.label)
        with naming(f"channel {channel.label!r}"):
            friction = identified.friction if channel.uncertainty.friction_identified else None
            uncertain, equivalent = uncertainty_of(
                channel,
                result,
                records.fitted(channel),
                stage.rng("uncertainty", channel.label),
                friction=friction,
                at_shaft=k == control,
                equivalent=equivalent,
                timing=records.timing,
            )
            bands = [(band.from_rad_s, band.to_rad_s) for band in uncertain.bands]
            scatter = scatter_of(channel, result, records.records, bands, friction)
            channels[k] = replace(uncertain, repeat_scatter=scatter)
    return UncertaintyResult(tuple(channels[k] for k in sorted(channels)), equivalent)


def uncertainty_of(
    channel: Channel,
    result: IdentifiedChannel,
    measured: Sequence[Record],
    rng: np.random.Generator,
    *,
    friction: FrictionFit | None = None,
    at_shaft: bool = True,
    equivalent: EquivalentFriction | None = None,
    timing: CommandTiming | None = None,
    in_parts: bool = True,
) -> tuple[UncertainChannel, EquivalentFriction | None]:
    """Ellipses and residual tests of one channel.

    Parameters
    ----------
    channel : Channel
    result : IdentifiedChannel
        Its model.
    measured : sequence of Record
        The fit's records as recorded, one input and one output.
    rng : Generator
        Of the simulations behind an equivalent friction.
    friction : FrictionFit, optional
        Of the shaft.
    at_shaft : bool
        Whether the channel's output is the position of that shaft.
    equivalent : EquivalentFriction, optional
        Where it is known from the shaft's channel.
    timing : CommandTiming, optional
        Of the command between two rows.
    in_parts : bool
        Whether a set that one ellipse holds badly may come in several parts.

    Returns
    -------
    channel : UncertainChannel
    equivalent : EquivalentFriction or None
        Viscous friction that acts like the dry one, where the ellipses describe an amplitude.

    Raises
    ------
    ValueError
        One line: the model explains nothing.
    """
    poles = result.model.poles
    linear_poles = result.model.poles
    options = channel.embedding
    members: tuple[RateMember, ...] = ()

    # The posterior: of the response as recorded, of the arm behind its friction, or at an amplitude.
    if friction is None:
        white = whiteness_test(result.identification.residuals).passed

        def posterior_behind(asked: UncertaintyOptions) -> tuple[ResponsePosterior, Tests]:
            tangent_posterior = tangent(result.bounded, result.model, asked)
            return tangent_posterior, residual_tests(tangent_posterior, result.bounded)

        if options.method == "tangent" or options.coloured_noise == "auto":
            (posterior, tests), options = with_noise_model(options, white, posterior_behind)
        if options.method != "tangent":
            posterior = posterior_of(result.model, result.bounded, options)
            tests = residual_tests(posterior, result.bounded)
        linear = posterior
    else:
        # An observer has a noise model of its own.
        white = friction.observed or whiteness_test([friction.residual(record) for record in measured]).passed
        find = without_friction if at_shaft else other_output_without_friction

        def arm_behind(asked: UncertaintyOptions) -> tuple[BehindFriction, Tests]:
            arm = find(measured, friction, result.model, asked)
            if not at_shaft:
                return arm, residual_tests(arm.response, result.bounded)
            return arm, residual_tests(arm.response, measured, arm.friction)

        (behind, tests), _ = with_noise_model(options, white, arm_behind)
        linear = behind.shaft if at_shaft else behind.response
        poles = behind.poles
        linear_poles = behind.poles
        posterior = behind.response
        if channel.uncertainty.response == "this amplitude":
            equivalent = equivalent or equivalent_friction(friction, measured, rng)
            posterior, poles = at_amplitude(behind, equivalent, rng)
        elif behind.members and (in_parts or len(behind.members) == 1):
            members = behind.members
            posterior = members[0].response
            poles = members[0].poles

    # What widens it: friction of a shaft that the sensor does not see, and a timing that is not known.
    remote = result.remote
    if remote is not None:
        longest_s = max(record.n_samples for record in measured) * result.model.dt_s
        posterior, linear = with_remote_friction(posterior, remote, poles, longest_s)
    if timing is not None:
        posterior = with_unknown_timing(posterior, timing)
        members = tuple(
            replace(member, response=with_unknown_timing(member.response, timing)) for member in members
        )
    band = result.data_band_rad_s
    omega = display_grid(result.model, result.bounded)
    # In a band of the data the nominal model has to be right, and need not elsewhere.
    if band is not None:
        is_in_band = (omega >= band[0]) & (omega <= band[1])
        omega = omega[is_in_band]
        if omega.size < _FEWEST_FREQUENCIES:
            omega = np.geomspace(*band, _FEWEST_FREQUENCIES)
    observer = friction is not None and friction.observed
    uncertain = uncertain_channel(
        channel.uncertainty.method,
        channel.uncertainty.level,
        posterior,
        result,
        omega,
        poles=poles,
        linear=linear,
        linear_poles=linear_poles,
        members=members,
        tests=tests,
    )

    # Refusals and advice. Friction is identified with a position; who records a speed is not told to record
    # another signal.
    position = is_position(result.output, "".join(measured[0].output_units))
    if observer or (result.closed_loop is not None and result.closed_loop.kind is not FindingKind.DIRECT):
        refuse_unexplained(result, uncertain.agreement, friction, position=position)
    # In a loop friction biases damping and poles, also where a noise model leaves white residuals.
    rubs = friction is None and remote is None and result.closed_loop is not None and not white
    # Where friction is looked at elsewhere, or cannot show, the advice is not to look for it again.
    may_be_friction = friction is None and band is None and not result.increments and not rubs and position
    advice = residual_advice(
        *tests,
        noise_order=uncertain.noise_order,
        friction=may_be_friction,
        observer=observer and at_shaft,
    )
    if remote is not None:
        # What an inexact direction leaves is not white; the ellipses are widened for it where it is told.
        if remote.is_told:
            advice = [item for item in advice if item.kind is not FindingKind.NOT_WHITE]
        advice.append(
            finding(
                FindingKind.REMOTE_FRICTION,
                output=result.output,
                unit="".join(measured[0].input_units),
                level=remote.level,
                level_std=remote.level_std,
                ratio=remote.ratio if remote.is_told else 0.0,
            )
        )
    elif rubs:
        advice.append(finding(FindingKind.UNTRIED_FRICTION, output=result.output, speed=not position))
    return replace(uncertain, advice=(*advice, *uncertain.agreement.doubt)), equivalent


def uncertain_channel(
    method: str,
    level: float,
    posterior: ResponsePosterior,
    result: IdentifiedChannel,
    omega: RealArray,
    *,
    members: Sequence[RateMember] = (),
    tests: Tests,
    poles: Poles,
    linear: ResponsePosterior,
    linear_poles: Poles,
) -> UncertainChannel:
    """A channel's posterior with its nominal model, ellipses, intervals and bands.

    Parameters
    ----------
    method, level : str, float
        Of the posterior, as the settings name them; probability of an ellipse.
    posterior : ResponsePosterior
        Of the first part of the set.
    result : IdentifiedChannel
    omega : (F,) array
        Frequencies that are shown, and where the nominal has to be right [rad/s].
    members : sequence of RateMember
        Parts of the set; empty where it has one.
    tests : Tests
        Of the residuals.
    poles : Poles
        Of the nominal model.
    linear : ResponsePosterior
        Of the identified model, for intervals of its poles.
    linear_poles : Poles
        Of that model; `linear` has them twice.

    Raises
    ------
    ValueError
        One line: the posterior says nothing at these frequencies (`refuse_unanswered`).
    """
    model = result.model
    doubts = [doubt for record in result.bounded for doubt in record.doubts]
    why = next((words(doubt) for doubt in doubts if doubt.kind is FindingKind.WRAPS), "")
    refuse_unanswered(linear, omega, result.identification.warnings, why=why)
    frequency = posterior.at(omega, level)
    intervals = intervals_of(linear, linear_poles.without(model.unstable), level)
    by_frequency = np.argsort(model.stable_poles.omega_rad_s(model.dt_s), kind="stable")
    pairs = model.stable_poles.pairs[by_frequency]
    modes = intervals.modes if intervals else ()
    untold = [i for i, mode in enumerate(modes) if not mode.told]
    # A pair that the records do not tell may move: the nominal model is fitted with it free.
    free_pairs = pairs[untold]
    nominal = nominal_of(posterior, poles, omega, free_pairs)
    further_parts = tuple(
        UncertainMember(
            rate_part(member.from_rad_s, member.to_rad_s),
            member.response,
            nominal_of(member.response, member.poles, omega, free_pairs),
            bands_of(member.response.at(omega, level)),
        )
        for member in members[1:]
    )
    # A set of one part needs no name for it.
    about = rate_part(members[0].from_rad_s, members[0].to_rad_s) if further_parts else ""
    empirical = empirical_response(
        result.bounded,
        integrators=0 if result.increments else model.integrators,
        level=level,
        band_rad_s=result.data_band_rad_s,
    )
    return UncertainChannel(
        name=result.name,
        method=method,
        level=level,
        posterior=posterior,
        nominal=nominal,
        frequency=frequency,
        empirical=empirical,
        bands=bands_of(frequency),
        tests=tests,
        agreement=NominalAgreement.of(frequency, nominal.frequency_response),
        intervals=intervals,
        about=about,
        others=further_parts,
    )


def bands_of(frequency: FrequencyUncertainty) -> tuple[Band, ...]:
    """Size of ellipses in `N_BANDS` bands of equal ratio over their frequencies, lowest first."""
    omega = frequency.omega_rad_s
    semi_major = frequency.ellipse().semi_major
    relative = 100 * semi_major / np.abs(frequency.centre)
    # The last band holds its end.
    end = omega[-1] * (1 + 1e-9)
    edges = np.geomspace(omega[0], end, N_BANDS + 1).tolist()
    bands = []
    for low, high in pairwise(edges):
        is_in_band = (omega >= low) & (omega < high)
        radii = relative[is_in_band]
        median_percent = float(np.median(radii))
        largest_percent = float(np.max(radii))
        bands.append(Band(low, high, median_percent, largest_percent))
    return tuple(bands)


def refuse_unexplained(
    result: IdentifiedChannel,
    agreement: NominalAgreement,
    friction: FrictionFit | None,
    *,
    position: bool = True,
) -> None:
    """Nothing, for a model of logs made in a loop that explains them.

    Parameters
    ----------
    result : IdentifiedChannel
    agreement : NominalAgreement
        Of the nominal model with the ellipses.
    friction : FrictionFit or None
        Where one was identified.
    position : bool
        Whether the output is a position.

    Raises
    ------
    ValueError
        One line: the nominal lies outside most of its ellipses, or, with friction, the best fit is poor and
        leaves much more than the sensor's noise. No number of such a model means anything.
    """
    identification = result.identification
    best = result.best_fit_percent
    why = ""
    if agreement.share_inside_percent < MOST_INSIDE_PERCENT:
        outside = 100 - agreement.share_inside_percent
        at = agreement.at_rad_s
        why = f"it lies outside {outside:.0f} % of its own ellipses, most near {at:.3g} rad/s"
    elif friction is not None and best < LEAST_FIT_PERCENT:
        times = identification.noise_std / friction.noise_std
        if times > _BEYOND_NOISE:
            why = f"its best fit to one is {best:.0f} %, and it leaves {times:.0f} times the sensor's noise"
    if why:
        raise ValueError(
            unexplained_logs(result.output, why, friction_known=friction is not None or not position)
        )


def posterior_of(
    model: GobfModel, bounded: Sequence[Record], options: UncertaintyOptions
) -> ResponsePosterior:
    """The posterior of a model by the method of the options: "tangent", or "records", from their scatter.

    bounded: estimation records as the ellipses see them (`ChannelResult.bounded`), one input and one output
    each.

    Raises ValueError, one line, where the method needs more records than there are.
    """
    if options.method == "tangent":
        return tangent(bounded, model, options)
    # From fewer the ellipses of one more record have no level (`combine_posteriors`).
    if len(bounded) < 4:
        raise ValueError(
            f"uncertainty.method = {options.method!r} needs at least four estimation records; found "
            f"{len(bounded)}"
        )
    return combine_posteriors(record_posteriors(bounded, model, options), small_sample_level=options.level)


def nominal_of(
    posterior: ResponsePosterior, poles: Poles, omega: RealArray, untold: ComplexArray
) -> GobfModel:
    """The nominal model: nearest to the posterior on the identified poles.

    Tried without the pairs (P,) that the records do not tell (`untold`), with them, and as `nominals_near`
    goes on; the first that stays in its ellipses at omega (F,), else the one with all identified poles.

    The nominal gives the design its closed-loop poles, so it should be a member of the set it stands for;
    but a pole taken twice is a mode listed twice, and one that is not told or was not given may be none, so
    they have to earn that.
    """
    told_poles = Poles(poles.real, poles.pairs[~np.isin(poles.pairs, untold)])
    ellipses = posterior.at(omega)
    candidates = chain([nominal_near(posterior, told_poles, omega)], nominals_near(posterior, poles, omega))
    for model in candidates:
        share_inside = np.mean(ellipses.contains(model.frequency_response(omega)))
        if share_inside >= _SHARE_INSIDE:
            return model
    return nominal_near(posterior, poles, omega)


def display_grid(model: GobfModel, records: Sequence[Record]) -> RealArray:
    """Frequencies (F,) for pictures: from one period per longest record to Nyquist, denser at modes."""
    longest_s = max(record.n_samples for record in records) * model.dt_s
    poles = model.poles
    frequencies = poles.omega_rad_s(model.dt_s)
    modes = []
    for omega, zeta in zip(frequencies, poles.zeta(), strict=True):
        # The response of a more damped pair is smooth: the plain grid shows it.
        if zeta < 0.4:
            modes.append(Mode(float(omega), float(zeta)))
    low = 2 * np.pi / longest_s
    high = np.pi / model.dt_s
    # A curve of 300 points looks smooth, but for its resonances: each has points of its own.
    return frequency_grid(high, modes, omega_min_rad_s=low, n_log=300, n_mode=41 * len(modes))


def intervals_of(posterior: ResponsePosterior, poles: Poles, level: float) -> Intervals | None:
    """Confidence intervals of modes by frequency, and of decay and growth rates.

    None for a posterior that has none: only that of the tangent method does.
    """
    try:
        intervals = pole_intervals(posterior, poles, level)
    except ValueError:
        return None
    by_frequency = np.argsort(poles.omega_rad_s(posterior.dt_s), kind="stable")
    # A pole at or left of z = 0 has no decay rate.
    slowest_first = [i for i in np.argsort(-poles.real, kind="stable") if poles.real[i] > 0]
    modes = []
    for i in by_frequency:
        omega_ends = _interval(intervals.omega_rad_s[i])
        zeta_ends = _interval(intervals.zeta[i])
        modes.append(ModeInterval(omega_ends, zeta_ends))
    return Intervals(
        level,
        tuple(modes),
        tuple(_interval(intervals.decay_per_s[i]) for i in slowest_first),
        tuple(_interval(ends) for ends in growth_intervals(posterior, level)),
    )


def _interval(ends: RealArray) -> tuple[float, float]:
    return float(ends[0]), float(ends[1])


def empirical_response(
    records: Sequence[Record],
    *,
    integrators: int = 0,
    level: float = 0.95,
    band_rad_s: tuple[float, float] | None = None,
) -> FrequencyUncertainty | None:
    """The response without a model; None where the records are too short for one.

    At the excited lines of the largest amplitude where records are periodic and several realisations, else
    from the largest set of equally long records.

    Parameters
    ----------
    records : sequence of Record
        One input, one output.
    integrators : int
        How often differences from sample to sample are taken first, of input and output, unless the records
        are confined to a band.
    level : float
        Probability of an ellipse.
    band_rad_s : tuple of two float, optional
        To which the records are confined [rad/s].
    """
    periodic = None
    # Records that are not periodic alike are no error: they may do together below.
    with suppress(ValueError):
        responses = (distortion.response(level) for distortion in reversed(distortion_of(records)))
        periodic = next(responses, None)
    if periodic is not None:
        return periodic
    by_length: dict[int, list[Record]] = {}
    for record in records:
        by_length.setdefault(record.n_samples, []).append(record)
    alike = max(by_length.values(), key=len)
    if band_rad_s is None:
        # An integrated output ends elsewhere than it began, and leaks everywhere.
        for _ in range(integrators):
            alike = [increments(record) for record in alike]
    low, high = band_rad_s or (None, None)
    try:
        return empirical_frf(alike, level=level, omega_min_rad_s=low, omega_max_rad_s=high)
    except ValueError:
        # The records are too short for this picture; the identification stands without it.
        return None


def scatter_of(
    channel: Channel,
    result: IdentifiedChannel,
    records: Sequence[RunRecord],
    bands: Sequence[tuple[float, float]],
    friction: FrictionFit | None,
) -> tuple[ScatterRow, ...] | None:
    """Scatter of repeats, by half decades of the data, against what the other repeats predict.

    Where there are two it is compared with what each record's own noise does. None without repeats.

    Parameters
    ----------
    channel : Channel
    result : IdentifiedChannel
    records : sequence of RunRecord
        All of the run; those that share a condition are repeats.
    bands : sequence of tuples of two float
        Of the ellipses [rad/s], for the range of frequencies.
    friction : FrictionFit or None
        That is taken off the records.
    """
    bounded = {record.name: record for record in result.bounded}
    groups: dict[str, list[Record]] = {}
    for item in records:
        if item.condition is not None and item.role != "validation":
            record = bounded.get(item.record.name) or as_bounded(item.record, channel, friction)
            groups.setdefault(item.condition, []).append(record)
    repeated = [group for group in groups.values() if len(group) >= 2]
    if not repeated:
        return None
    posteriors = repeat_posteriors(repeated, result.identification.model, channel.embedding)
    low, high = result.data_band_rad_s or (bands[0][0], bands[-1][1])
    # Two bands a decade, one at least; the last edge lies inside the data.
    decades = np.log10(high / low)
    n_bands = max(round(2 * decades), 1)
    edges = np.geomspace(low, high * (1 - 1e-6), n_bands + 1)
    # Some twenty frequencies a band; the last one lies inside the last band.
    omega = np.geomspace(low, high * (1 - 2e-6), 20 * len(edges))
    estimates = [[each.at(omega, channel.uncertainty.level) for each in group] for group in posteriors]
    return tuple(repeat_scatter(estimates, list(pairwise(edges.tolist()))))
