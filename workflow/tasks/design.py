"""The design, its certificate, for how many posterior samples the worst case holds, what a
controller of any order could reach, and the reference filter (u = K (F r - y)), designed after K."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from control_design.analysis.certificate import certify
from control_design.analysis.joint_coverage import ResponseDraws, joint_coverage
from control_design.controllers.controller import Controller
from control_design.convex.reference_filter import design_reference_filter
from control_design.convex.youla import youla_bracket
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import GIVES_WAY, RationalWeight, Specification, SpecificationError
from control_design.specification.told_band import tracking_where_told
from control_design.synthesis.giving_way import synthesise_giving_way, without_limits
from control_design.synthesis.joint_synthesis import synthesise_jointly
from control_design.synthesis.synthesis import part_of, synthesise
from control_design.synthesis.synthesis_options import SynthesisOptions
from ident.uncertainty import ResponsePosterior
from workflow.config.design_options import AchievableOptions, CertificateOptions, ReferenceFilterSettings
from workflow.engine import codec
from workflow.engine.errors import InputError
from workflow.tasks.results import (
    AchievablePerformance,
    CertifyResult,
    DesignResult,
    ReferenceFilterResult,
    SampledResponses,
)
from workflow.text.sentences import design as sentences
from workflow.text.sentences.certificate import certificate_reason

# Worst case of a quick design that the whole design then meets, too, as a rule.
_CLEARLY = 0.97
# Whole designs at most that verify a hint: each takes as long as the one that missed.
_MOST_WHOLE_DESIGNS = 2


def find_design(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    synthesis: SynthesisOptions,
    options: CertificateOptions,
    rng: np.random.Generator,
    progress: Callable[[float, str], None] | None = None,
    *,
    advise: bool = True,
    between_own_points: Literal["nothing", "linear"] = "linear",
) -> DesignResult:
    """One controller for all plants, and in one line how it stands against the specification.

    With `options.calibrate`, and plants to draw from, its sampled responses are stable as often as the
    certificate then asks.

    Parameters
    ----------
    plants : sequence of UncertainPlant
        With one sampling time.
    specification : Specification
        As it is stated; requirements with a limit may give way as far as it.
    synthesis : SynthesisOptions
    options : CertificateOptions
    rng : Generator
        Of the starts of the search.
    progress : callable, optional
        Called with the share that is done and a line.
    advise : bool
        Where the specification is missed, `reason` also says what would be met instead. Takes more designs.
    between_own_points : {"linear", "nothing"}
        What certificates of that advice take for granted between the frequencies of a measured response.

    Returns
    -------
    DesignResult
        Without a controller where no controller can meet the specification: that is a result, not an error.
    """
    # As it is stored: without what a run says beside it.
    specification = Specification.model_validate(
        specification.model_dump(include=set(Specification.model_fields))
    )
    specification = tracking_where_told(specification, plants)
    stated = specification
    if plants:
        # What the user has to change, not what a search has found.
        specification.refuse_sampling(plants[0].dt_s)
    rng_at_start = copy.deepcopy(rng)

    # The search: with `calibrate` a second one follows, for the share of posterior samples.
    jointly = None
    try:
        if options.calibrate and undrawable(plants) is None:
            parts = [part_of(progress, number, 2) if progress else None for number in range(2)]
            specification, first = synthesise_giving_way(
                plants, specification, synthesis, rng=rng, progress=parts[0]
            )
            joint_design = synthesise_jointly(
                plants, specification, synthesis, rng=rng, first=first, progress=parts[1]
            )
            result = joint_design.result
            jointly = sentences.draws_stable(joint_design)
        else:
            specification, result = synthesise_giving_way(
                plants, specification, synthesis, rng=rng, progress=progress
            )
    except SpecificationError as impossible:
        return DesignResult(None, met=False, reason=str(impossible), specification=specification)

    # How it stands, and what the user could ask for instead.
    reason = sentences.outcome(result)
    if advise and 1.0 < result.gamma < math.inf:
        meets = would_meet(
            plants,
            stated,
            result.gamma,
            synthesis,
            options,
            rng_at_start,
            between_own_points=between_own_points,
        )
        reason += sentences.would_meet(meets)
    return DesignResult(result, result.gamma <= 1.0, reason, jointly, specification)


def would_meet(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    gamma: float,
    synthesis: SynthesisOptions,
    options: CertificateOptions,
    rng: np.random.Generator,
    *,
    between_own_points: Literal["nothing", "linear"] = "linear",
) -> tuple[str, float] | None:
    """A key of the specification and a value with which a design is certified, the rest as it is.

    Quick designs find a candidate; it is told only once it was designed and certified in the way that a user
    would who typed it.

    Parameters
    ----------
    plants, specification, synthesis, options, between_own_points
        See `find_design`; the specification as the user stated it.
    gamma : float
        Weighted worst case of the design that missed, above 1.
    rng : Generator
        As that design had it when it began; it is not moved on.

    Returns
    -------
    tuple of str and float, or None
        A larger effort_limit, else a smaller bandwidth; of a key that gives way a further limit. None where
        none of a few values is certified.
    """
    # The trials draw from a generator of their own: the caller's must not depend on how many there were.
    root = int(copy.deepcopy(rng).integers(2**63))
    quick = synthesis.model_copy(update={"sufficient_gamma": _CLEARLY})
    # Of a range of bandwidths it is the lowest that was missed.
    left_open = specification.lowest_bandwidth_rad_s is not None
    missed = without_limits(specification)
    if left_open:
        missed = missed.model_copy(update={"bandwidth_rad_s": specification.lowest_bandwidth_rad_s})
    if specification.highest_effort_limit is not None:
        missed = missed.model_copy(update={"effort_limit": specification.highest_effort_limit})
    whole_designs = 0
    # More effort costs the user least; a lower bandwidth is the second choice.
    for key, factors in (("effort_limit", (1.5 * gamma, 3 * gamma)), ("bandwidth_rad_s", (0.5, 0.25))):
        stated = getattr(missed, key)
        for factor in factors if stated is not None else ():
            value = float(f"{factor * stated:.2g}")
            asked = missed.model_copy(update={key: value})
            try:
                quick_design = synthesise(
                    plants, asked, quick, rng=np.random.default_rng(root), thorough=False
                )
            except SpecificationError:
                continue
            if not quick_design.gamma <= _CLEARLY:
                continue

            # As a user would who typed it.
            if whole_designs == _MOST_WHOLE_DESIGNS:
                return None
            whole_designs += 1
            typed = key if getattr(specification, GIVES_WAY[key]) is None else GIVES_WAY[key]
            wished = specification.model_copy(update={typed: value})
            design = find_design(plants, wished, synthesis, options, copy.deepcopy(rng), advise=False)
            if not design.met or design.controller is None:
                continue
            certified = certify_asked(
                design.controller,
                plants,
                design.specification or wished,
                options,
                copy.deepcopy(rng),
                between_own_points=between_own_points,
            )
            if certified.certified:
                return typed, value
    return None


def certify_asked(
    controller: Controller,
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: CertificateOptions,
    rng: np.random.Generator,
    *,
    between_own_points: Literal["nothing", "linear"] = "linear",
) -> CertifyResult:
    """The certificate of a controller, and for how many sampled responses its worst case holds.

    With `options.calibrate` the ellipses are of the calibrated level where that is higher, and the share of
    stable draws is an item of the certificate.

    Parameters
    ----------
    controller : Controller
    plants : sequence of UncertainPlant
        Every one has to meet the specification.
    specification : Specification
    options : CertificateOptions
    rng : Generator
        Of the posterior samples.
    between_own_points : {"linear", "nothing"}
        What is taken for granted between the frequencies of a measured response.

    Returns
    -------
    CertifyResult
    """
    reason = undrawable(plants) if options.joint_draws else sentences.NOT_DRAWN
    calibrated = reason is None and options.calibrate
    certificate = certify(
        controller,
        plants,
        specification,
        between_own_points=between_own_points,
        joint_coverage=options.joint_coverage if calibrated else None,
        rng=rng,
        joint_draws=options.joint_draws,
    )
    joint = certificate.joint
    if reason is None and not calibrated:
        joint = joint_coverage(
            controller,
            plants,
            specification,
            rng=rng,
            coverage=options.joint_coverage,
            draws=options.joint_draws,
        )
    return CertifyResult(
        certificate,
        certificate.certified,
        certificate_reason(certificate),
        SampledResponses(joint, calibrated, reason),
    )


def undrawable(plants: Sequence[UncertainPlant]) -> str | None:
    """Why posterior samples of these plants cannot be drawn; None where they can."""
    drawn = False
    for plant in plants:
        for channel in (plant.channel, plant.performance):
            uncertainty = None if channel is None else channel.uncertainty
            if uncertainty is None:
                continue
            if not isinstance(uncertainty, ResponsePosterior | ResponseDraws):
                return sentences.undrawable(plant.name, plant.own_grid is not None)
            drawn = True
    return None if drawn else sentences.NOTHING_TO_DRAW


def joint_numbers(found: SampledResponses) -> dict[str, Any]:
    """Numbers for JSON and tables; shares with Wilson intervals at 95 %."""
    # Imported here: it takes its time to load.
    from scipy.stats import binomtest

    joint = found.joint
    if joint is None:
        return {"reason": found.reason}
    held, stable = (
        binomtest(round(share * joint.draws), joint.draws).proportion_ci(method="wilson")
        for share in (joint.coverage_given, joint.stable_share)
    )
    return {
        **codec.plain(joint),
        "calibrated": found.calibrated,
        "held_share": joint.coverage_given,
        "held_interval": [held.low, held.high],
        "stable_interval": [stable.low, stable.high],
        "reason": None,
    }


def find_bracket(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: AchievableOptions,
    progress: Callable[[float, str], None] | None = None,
) -> AchievablePerformance:
    """What a controller of any order could reach on these plants (lower and upper bound of the worst case),
    or the reason why that is not known."""
    if not options.compute:
        return AchievablePerformance(reason=sentences.BRACKET_NOT_ASKED)
    try:
        bracket = youla_bracket(plants, specification, options, progress=progress)
    except SpecificationError as impossible:
        return AchievablePerformance(reason=str(impossible))
    except (ValueError, ArithmeticError) as unfit:
        return AchievablePerformance(reason=sentences.bracket_unfit(str(unfit)))
    return AchievablePerformance(bracket)


def bracket_numbers(found: AchievablePerformance, gamma: float | None) -> dict[str, Any]:
    """Numbers for JSON and tables: what any order reaches, the floor, how far gamma is above in percent."""
    bracket = found.bracket
    if bracket is None:
        return {"reached": None, "floor": None, "above_percent": None, "reason": found.reason}
    reached = codec.plain(bracket.ellipse)
    floor = codec.plain(bracket.floor)
    known = gamma is not None and math.isfinite(gamma) and reached is not None
    return {
        "reached": reached,
        "floor": floor,
        "above_percent": 100.0 * (gamma / reached - 1.0) if known and gamma and reached else None,
        "reason": None,
        "bracket": codec.plain(bracket),
    }


def find_filter(
    controller: Controller, plants: Sequence[UncertainPlant], settings: ReferenceFilterSettings | None
) -> ReferenceFilterResult:
    """The reference filter of a loop, or the reason why there is none.

    Parameters
    ----------
    controller : Controller
    plants : sequence of UncertainPlant
    settings : ReferenceFilterSettings or None
        None: no filter is asked for, and the result is empty.

    Returns
    -------
    ReferenceFilterResult
        Without a filter, but with a reason, where the loop is not robustly stable: it has no worst-case error
        to make small.

    Raises
    ------
    InputError
        One line: a frequency beyond what the sampling time allows (`check_filter`).
    """
    if settings is None:
        return ReferenceFilterResult()
    check_filter(settings, controller.dt_s)
    try:
        reference_filter = design_reference_filter(
            controller, plants, settings.reference_model, settings, weight=settings.error_weight
        )
    except ValueError as unfit:
        return ReferenceFilterResult(reason=sentences.no_filter(str(unfit)))
    return ReferenceFilterResult(reference_filter)


def check_filter(settings: ReferenceFilterSettings | None, dt_s: float, source: str = "") -> None:
    """Refuse frequencies that a sampling time does not allow, before anything is designed.

    source: the file, for the complaint. Raises InputError: one line naming the key.
    """
    if settings is None:
        return
    nyquist = np.pi / dt_s
    where = f"{source}: reference_filter" if source else "reference_filter"
    for rate in settings.poles_rad_s or ():
        if not 0 < rate < nyquist:
            raise InputError(
                f"{where}.poles_rad_s: {rate:.4g} is not between 0 and the Nyquist frequency "
                f"{nyquist:.4g} rad/s"
            )
    corner = settings.corner_rad_s
    if corner is not None and not corner < nyquist:
        raise InputError(
            f"{where}.corner_rad_s: {corner:.4g} lies beyond the Nyquist frequency {nyquist:.4g} rad/s"
        )


def model_answer(
    model: RationalWeight, reference: npt.NDArray[np.float64], dt_s: float
) -> npt.NDArray[np.float64]:
    """Answer (T,) of the reference model, by Tustin's map as the design sees it, to a reference (T,)."""
    # Imported here: it takes its time to load.
    import scipy.signal

    discrete = scipy.signal.bilinear(model.numerator, model.denominator, 1.0 / dt_s)
    return np.asarray(scipy.signal.lfilter(*discrete, reference), dtype=np.float64)
