"""Identify a model of one input and one output from records: the path of `identify` from data to answer.

Poles are searched on the records, or on a part of long ones (`searched`), with free responses where records
begin in motion, and again behind a dead time where the data show one. They are then refined on all samples,
where what was left to the data is decided: initial state and offset (`fitted_on_all`). What somebody stated
as known is tested by likelihood ratios, and a relative degree is imposed (`_priors_judged`). At the end the
model and what describes its fit are read off (`description`). All noise is taken as white here;
`ident.coloured_noise` runs the same path on records that were whitened.

Types of other files that travel here: `Regression`, records made ready for a fit (inputs u (1, N), outputs y
(N,) of all records, and their structure); `PoleSearch`, a search on one of them, with its options, its fixed
poles and its trace (minima, stages, evaluations); `Refined`, the end of a descent (poles, residual sum of
squares rss); `Fitted`, a search and such an end; `SearchOutcome`, a `Fitted` with the selection of its order.
A `Record` has finite samples, at least one, or it could not be made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.checks.answer import explains_nothing
from ident.checks.input_checks import advice, refuse_unusable
from ident.checks.plausible_modes import implausible_pairs, pole_warnings
from ident.checks.prior_tests import (
    best_under_relative_degree,
    clearly_left_out,
    delay_test,
    direct_term_test,
    fixed_poles_test,
    integrators_test,
    nuisance_test,
    relative_degree_test,
    too_few_poles,
)
from ident.coloured_noise import identify_in_noise
from ident.data.arrays import RealArray
from ident.data.finding import Finding, FindingKind, PriorTest, finding
from ident.data.record import Record
from ident.fit.least_squares import Regression, fit
from ident.fit.refinement import Refined, free_optimality
from ident.fit.regression import prepare, restructured, thinned
from ident.fit.structured_fit import UnderRelativeDegree, structured_fit
from ident.identification import Identification
from ident.search.dead_time import SearchOutcome, first_answer, seek
from ident.search.order_selection import OrderSelection, Progress, silent
from ident.search.pole_search import Fitted, PoleSearch, PolishedMinimum, SearchTrace

# Factor in residual energy from a fit whose records begin in motion to one from rest. From it on, the search
# from rest may have been led to other poles, and the records are searched anew; below it the search goes on
# from the poles that were found from rest, which is faster. Chosen; set to 1 or doubled, no test of
# `identify` moves.
MISLED_FACTOR = 1.2
# Fewest poles beside the fixed ones with which a search from rest counts as one that found the dynamics: one
# real pole and a pair.
DYNAMICS_ORDER = 3
# Fits with free responses are tried only where there are samples enough for so many poles, or for as many as
# were found from rest: two real poles and a pair, the first search.
LEAST_ORDER_IN_MOTION = 4


def identify(
    records: Sequence[Record], options: IdentOptions | None = None, *, progress: Progress | None = None
) -> Identification:
    """Fit one GOBF model to all records of one input and one output together.

    Parameters
    ----------
    records : sequence of Record
        Of equal sampling time; each has its own nuisance columns (offset, initial state).
    options : IdentOptions, optional
        What is known, what is left to the data, and limits of the search.
    progress : callable, optional
        Called with a share 0 .. 1 and a short message.

    Returns
    -------
    Identification
        Model, residuals, verdicts and trace. Deterministic.

    Raises
    ------
    ValueError
        In one line: no record, a record that cannot be used (constant signal, several columns, other sampling
        time), or too few samples for the order.
    """
    options = options or IdentOptions()
    report = progress or silent
    if options.noise != "auto":
        return _identified(records, options, report)

    def identified_step(
        step_records: Sequence[Record], step_options: IdentOptions, begin: float, end: float
    ) -> Identification:
        """Fit in white noise, with the part `begin` to `end` of the progress; raises as `identify`."""
        return _identified(step_records, step_options, part_of(report, begin, end - begin))

    refuse_unusable(records, prepare(records, options.structure()), least_order(options))
    return identify_in_noise(records, options, identified_step)


def part_of(report: Progress, begin: float, length: float) -> Progress:
    """Progress of a step: its shares 0 .. 1 are reported as begin .. begin + length of the whole; not
    checked."""

    def report_step(share: float, message: str) -> None:
        """Report a share 0 .. 1 of the step as one of the whole; it is not checked."""
        report(begin + length * share, message)

    return report_step


def untested_model(records: Sequence[Record], options: IdentOptions) -> GobfModel:
    """Model of `identify` in white noise before what is stated as known is tested.

    Parameters
    ----------
    records : sequence of Record
        Of one input and one output, of equal sampling time.
    options : IdentOptions
        The relative degree is not imposed, and no dead time is sought.

    Returns
    -------
    GobfModel
        The model of the search, refined on all samples.

    Raises
    ------
    ValueError
        A record cannot be used, or there are too few samples for the order, as `identify` says it.
    """
    data = prepare(records, options.structure())
    refuse_unusable(records, data, least_order(options))
    outcome, _ = searched(records, data, options, silent)
    fitted, _ = fitted_on_all(records, outcome)
    model, _ = description(records, outcome, fitted)
    return model


def _identified(records: Sequence[Record], options: IdentOptions, report: Progress) -> Identification:
    """The identification that takes the noise as white.

    Raises ValueError for records that cannot be used and for too few samples (`prepare`, `refuse_unusable`).
    """
    data = prepare(records, options.structure())
    refuse_unusable(records, data, least_order(options))
    outcome, part = searched(records, data, options, report)
    outcome, answers_at_once = _behind_dead_time(part, outcome, report)
    fitted, verdicts = fitted_on_all(records, outcome)
    if outcome.dead_time is not None:
        verdicts = (outcome.dead_time, *verdicts)

    # Numbers of the bar of progress are chosen by about how long each step takes; they decide nothing.
    report(0.9, "tests of what is stated as known")
    fitted, tests = _priors_judged(records, part, outcome, fitted)
    model, fields = description(records, outcome, fitted)

    # What the reader is warned of: priors that the data refuse. A relative degree that was left to the data
    # and refused was not imposed, which is no reason to warn.
    warnings = []
    for test in tests:
        if test.refused and (test.imposed or options.relative_degree != "auto"):
            warnings.append(test.finding)
    # An output that answers in the very sample of the input has a direct term, which nobody asked for.
    nobody_asked = not options.feedthrough and options.relative_degree is None
    if answers_at_once and nobody_asked and fitted.poles.order:
        test = direct_term_test(records, fitted)
        if test.refused:
            warnings.append(finding(FindingKind.ANSWERS_AT_ONCE, **test.finding.values))
    report(1.0, "identified")
    return Identification(
        model=model,
        verdicts=(*verdicts, *(test.finding for test in tests)),
        prior_tests=tests,
        advise=partial(_advice, tuple(records), fitted, model, fields["residuals"], tuple(warnings)),
        **fields,
    )


def least_order(options: IdentOptions) -> int:
    """Number of poles that the data have to be enough for.

    Those that are stated; where none is, those that a search begins with (`ident.search.order_selection`):
    two real poles and a pair, or as many as the options allow. The options have refused negative numbers.
    """
    n_real = options.n_real or 0
    n_pairs = options.n_pairs or 0
    stated_order = options.fixed().order + n_real + 2 * n_pairs
    if stated_order:
        return stated_order
    return min(2, options.max_real) + 2 * min(1, options.max_pairs)


def searched(
    records: Sequence[Record], data: Regression, options: IdentOptions, report: Progress
) -> tuple[SearchOutcome, Sequence[Record]]:
    """Poles from a search, and the records that were searched.

    Parameters
    ----------
    records : sequence of Record
        Of one input and one output.
    data : Regression
        These records made ready for a fit from rest; that they are the same ones is not checked.
    options : IdentOptions
        Numbers and bounds of poles, `search_samples`, and whether initial states are left to the data.
    report : callable
        Told of shares 0 to .85.

    Returns
    -------
    SearchOutcome
        Search, selection of the order, and where they ended. Initial states are estimated where the data ask
        for it.
    sequence of Record
        All records, or a part of long ones.
    """
    part, in_mid_record = thinned(records, options.search_samples)
    structure = options.structure()
    if in_mid_record:
        # A stretch from the middle of a record does not begin at rest.
        structure = replace(structure, estimate_initial_state=True)
    if in_mid_record or len(part) < len(records):
        data = prepare(part, structure)
    # Shares of the bar of progress here and below are chosen; they decide nothing.
    outcome = _searched(data, options, part_of(report, 0.0, 0.4))
    # In mid-record the free responses are there already.
    if options.estimate_initial_state == "auto" and not in_mid_record:
        outcome = _searched_with_initial_state(part, outcome, report)
    report(0.85, "refinement and tests on all samples")
    return outcome, part


def _behind_dead_time(
    records: Sequence[Record], outcome: SearchOutcome, report: Progress
) -> tuple[SearchOutcome, bool]:
    """Outcome of the search behind a delay that the data show, and whether the output answers at once.

    Nothing is sought where somebody stated a delay, or where a reference was recorded: noise that comes back
    through a loop looks like dead time. At once means in the very sample of the input. `records` : those that
    were searched. Nothing is raised for short records: these tell no delay.
    """
    in_loop = any(record.reference is not None for record in records)
    if in_loop or outcome.search.options.input_delay_samples:
        return outcome, False
    # Just behind the end of the search (.85) on the bar of progress.
    report(0.86, "dead time")
    starts, answers_at_once = first_answer(records)
    delayed = None
    if outcome.search.options.delay_left_to_data:
        delayed = seek(records, outcome, starts)
    if delayed is None:
        return outcome, answers_at_once
    # The trace tells of both searches.
    search = delayed.search
    search.minima = [*outcome.search.minima, *search.minima]
    search.stages = [*outcome.search.stages, *search.stages]
    search.evaluations += outcome.search.evaluations
    return delayed, False


def _searched(
    data: Regression, options: IdentOptions, report: Progress, start: Refined | None = None
) -> SearchOutcome:
    """Outcome of one selection of the order on these data; `start`: poles to go on from; None: a global
    search.

    Raises ValueError where stated bounds leave no box to search in (`search_space`).
    """
    search = PoleSearch(data, options)
    selection = OrderSelection(search, report)
    return SearchOutcome(search, selection.run(start), selection)


def _searched_with_initial_state(
    records: Sequence[Record], outcome: SearchOutcome, report: Progress
) -> SearchOutcome:
    """Outcome of a second search with unknown initial states, or of the first one from rest.

    `outcome` : the search from rest on these records. It stays unless it is improbably worse than a fit with
    free responses of all poles, by `nuisance_test` (a likelihood ratio at 99 %); or where there are too few
    samples for such a fit. Nothing is raised for the records, which the first search has used.
    """
    data = outcome.data
    options = outcome.search.options
    data_in_motion = restructured(records, data, replace(data.structure, estimate_initial_state=True))
    tried_order = max(outcome.poles.order, LEAST_ORDER_IN_MOTION)
    if not data_in_motion.n_samples > data_in_motion.n_parameters(tried_order):
        return outcome
    search = PoleSearch(data_in_motion, options)
    searched_order = outcome.poles.order - search.fixed.order
    order_left_to_data = options.n_real is None or options.n_pairs is None
    from_rest: Fitted = outcome
    start = None
    polished = None
    if searched_order < DYNAMICS_ORDER and order_left_to_data:
        # Nothing was found from rest. A free decay looks just like that, so one mode is sought with free
        # responses, and its poles are judged with and without them: a pair and two real poles, those of the
        # first search.
        most_pairs = options.max_pairs if options.n_pairs is None else options.n_pairs
        n_real = min(2, options.max_real) if options.n_real is None else options.n_real
        end = search.joint(n_real, min(1, most_pairs))
        search_from_rest = PoleSearch(data, options)
        from_rest = Fitted(search_from_rest, search_from_rest.descend(end.poles, "from rest"))
    else:
        if from_rest.poles.order > 0:
            # A step on the linearisation is enough to see that free responses gain nothing.
            left_out = clearly_left_out("initial state", from_rest, data_in_motion)
            if left_out is not None:
                return replace(outcome, from_rest=left_out.finding)
        end = search.descend(from_rest.poles, "with initial state")
        polished = end
        # Where transients are no larger than the noise the search from rest was not misled: go on from its
        # poles.
        if from_rest.end.rss < MISLED_FACTOR * end.rss:
            start = end
    if end.poles.order == 0 or not nuisance_test("initial state", from_rest, Fitted(search, end)).needed:
        return replace(outcome, free=polished)
    # From .45 to .85 on the bar of progress, behind the first search.
    return _searched(data_in_motion, options, part_of(report, 0.45, 0.4), start)


def fitted_on_all(records: Sequence[Record], outcome: SearchOutcome) -> tuple[Fitted, tuple[Finding, ...]]:
    """Poles refined on all samples, and what the data said about initial state and offset.

    Parameters
    ----------
    records : sequence of Record
        All of them; none is refused here, as the search has.
    outcome : SearchOutcome
        Of a search on these records, or a part of them.

    Returns
    -------
    Fitted
        The optimum, with the nuisances that the options state or the data ask for.
    tuple of Finding
        A verdict for each nuisance that was left to the data: initial state first, then the offset.
    """
    options = outcome.search.options
    structure = outcome.data.structure
    fitted: Fitted = outcome
    n_samples = sum(record.n_samples - structure.input_delay_samples for record in records)
    if outcome.data.n_samples < n_samples:
        if options.estimate_initial_state is False:
            # A search in mid-record had to estimate it all the same.
            structure = replace(structure, estimate_initial_state=False)
        fitted = _moved(outcome, prepare(records, structure), outcome.poles)

    verdicts = []
    for name, key in (("initial state", "estimate_initial_state"), ("offset", "estimate_offset")):
        if getattr(options, key) != "auto":
            continue
        # The search has put this question to the very same records, where all of them were searched.
        already_asked = key == "estimate_initial_state" and fitted is outcome
        if already_asked and outcome.from_rest:
            verdicts.append(outcome.from_rest)
            continue

        # The same records with the nuisance, or without it: whichever they are not fitted with.
        is_estimated = getattr(fitted.data.structure, key)
        changed: dict[str, Any] = {key: not is_estimated}
        changed_data = restructured(records, fitted.data, replace(fitted.data.structure, **changed))
        unknowns = changed_data.n_parameters(fitted.poles.order)
        # With integrators the polynomials that they leave free contain the offset.
        no_difference = unknowns == fitted.data.n_parameters(fitted.poles.order)
        if no_difference or not changed_data.n_samples > unknowns:
            continue
        if already_asked and outcome.free:
            changed_fit = Fitted(PoleSearch(changed_data, options), outcome.free)
        else:
            changed_fit = _moved(outcome, changed_data, fitted.poles)
        if is_estimated:
            with_it = fitted
            without = changed_fit
        else:
            with_it = changed_fit
            without = fitted
        test = nuisance_test(name, without, with_it)
        verdicts.append(test.finding)
        fitted = with_it if test.needed else without
    return fitted, tuple(verdicts)


def _priors_judged(
    records: Sequence[Record], part: Sequence[Record], outcome: SearchOutcome, fitted: Fitted
) -> tuple[Fitted, tuple[PriorTest, ...]]:
    """The fit under the relative degree, and a test of each thing that somebody stated as known.

    `part` : records that were searched; `fitted` : the optimum on all records. In this order: integrators,
    fixed poles, direct term, relative degree, delay. What the program chose from the data, in options of its
    own, is not tested. Each test starts from a model that the data have not refused: with integrators
    refused, relative degree is judged with slow poles in their place. No tests where nothing was stated, or
    where there is no pole. Nothing is raised: a degree above the number of poles gives a test TOO_FEW_POLES.
    """
    options = outcome.search.options
    integrators_stated = options.integrators > 0 and options.is_stated("integrators")
    delay_stated = options.is_stated("input_delay_samples") and outcome.dead_time is None
    stated = integrators_stated or options.fixed_poles or options.relative_degree is not None
    if fitted.poles.order == 0 or not (stated or delay_stated):
        return fitted, ()
    search = PoleSearch(fitted.data, options)
    search.minima = list(outcome.search.minima)
    # Both are fits to all records: one keeps to every prior, the other to those that were not refused.
    as_stated = Fitted(search, fitted.end)
    not_refused = as_stated
    searched_part = (part, outcome.data.structure)
    tests: list[PriorTest] = []
    if integrators_stated:
        test, without_integrators = integrators_test(records, searched_part, as_stated)
        tests.append(test)
        outcome.search.evaluations += without_integrators.search.evaluations
        if test.refused:
            not_refused = without_integrators
    if options.fixed_poles:
        tests.append(fixed_poles_test(records, searched_part, as_stated))

    # Relative degree 1 is no direct term. Where they are left to the data higher ones are tried one after the
    # other, up to the first that is refused; a stated one is imposed even so.
    asked = options.relative_degree
    if asked in (1, "auto"):
        tests.append(direct_term_test(records, not_refused))
    relative_degree = 1
    end = fitted.end
    trials: tuple[int, ...] = ()
    if asked == "auto":
        # Chosen: 2 is that of a force that moves a mass; beyond 3 none is tried, though it may be stated.
        trials = (2, 3)
    elif asked is not None and asked > 1:
        trials = (asked,)
    for trial in trials:
        if trial > min(as_stated.poles.order, not_refused.poles.order):
            if asked != "auto":
                tests.append(too_few_poles(trial, as_stated.poles.order))
            break
        test, constrained = relative_degree_test(not_refused, trial)
        if asked == "auto" and test.refused:
            tests.append(replace(test, imposed=False))
            break
        tests.append(test)
        relative_degree = trial
        end = constrained
        if not_refused is not as_stated:
            # The model keeps its integrators, also refused ones: the same degree with them.
            end = best_under_relative_degree(as_stated, trial)
    if delay_stated:
        tests.append(delay_test(records, as_stated, relative_degree))
    if relative_degree > 1:
        structure = replace(fitted.data.structure, relative_degree=relative_degree)
        fitted = Fitted(PoleSearch(replace(fitted.data, structure=structure), options), end)
        outcome.search.minima.append(PolishedMinimum("relative degree", end.poles, end.rss))
    return fitted, tuple(tests)


def in_order(poles: Poles, fixed: Poles) -> Poles:
    """Poles in the order of a model: fixed ones first of each type, then the fitted ones sorted.

    Parameters
    ----------
    poles : Poles
        Fixed ones first of each type.
    fixed : Poles
        Only their numbers count here; more of them than there are poles is not checked.

    Returns
    -------
    Poles
        Fixed poles as they are, then real ones from slow to fast and pairs from low to high frequency.
    """
    n_fixed_real, n_fixed_pairs = fixed.counts
    fitted_real = poles.real[n_fixed_real:]
    fitted_pairs = poles.pairs[n_fixed_pairs:]
    slow_to_fast = np.sort(fitted_real)[::-1]
    # |log p| is the undamped frequency, in radians per sample.
    low_to_high = fitted_pairs[np.argsort(np.abs(np.log(fitted_pairs)))]
    return Poles(
        np.concatenate([poles.real[:n_fixed_real], slow_to_fast]),
        np.concatenate([poles.pairs[:n_fixed_pairs], low_to_high]),
    )


def _moved(outcome: SearchOutcome, data: Regression, poles: Poles) -> Fitted:
    """Optimum near these poles on other rows or columns; noted in the trace of the search.

    `data` has more samples than unknowns with these poles: the caller has seen to it.
    """
    search = PoleSearch(data, outcome.search.options)
    end = search.descend(poles, "final polish")
    outcome.search.minima += search.minima
    outcome.search.evaluations += search.evaluations
    return Fitted(search, end)


def description(
    records: Sequence[Record], outcome: SearchOutcome, fitted: Fitted
) -> tuple[GobfModel, dict[str, Any]]:
    """Model of a fit, and the fields that describe it.

    Parameters
    ----------
    records : sequence of Record
        All that were fitted.
    outcome : SearchOutcome
        The search, for the trace and the table of orders.
    fitted : Fitted
        The optimum; the structure of its data holds the relative degree.

    Returns
    -------
    GobfModel
        With the names of the first record's columns.
    dict
        Fields of `ident.identification.FittedRecords` that are read from fit and search, by name.

    Notes
    -----
    Nothing is raised: outputs that stand still, or no more samples than unknowns, which would divide by zero
    here, were refused before the search.
    """
    data = fitted.data
    options = outcome.search.options
    search = outcome.search
    degree = data.structure.relative_degree
    poles = in_order(fitted.poles, search.fixed)
    bounds = fitted.search.bounds
    if degree > 1:
        linear = structured_fit(data, poles, degree)
        optimality = UnderRelativeDegree(data, degree, search.fixed).optimality(poles, bounds)
    else:
        linear = fit(data, poles)
        linearisation = data.linearise(*poles.writable())
        optimality = free_optimality(linearisation, poles, bounds, search.fixed)
    model = GobfModel(
        poles=poles,
        coefficients=linear.coefficients[0],
        feedthrough=float(linear.feedthrough[0]),
        dt_s=data.dt_s,
        input_name=records[0].input_names[0],
        output_name=records[0].output_names[0],
        integrators=options.integrators,
        input_delay_samples=options.input_delay_samples,
        unstable=data.structure.unstable,
    )

    # Record by record: what the fit leaves, as a share of the motion about its mean.
    residuals = []
    fit_percent = []
    for rows in data.segments:
        residual = linear.residual[rows]
        motion = np.linalg.norm(data.y[rows] - data.y[rows].mean())
        residuals.append(residual)
        fit_percent.append(100 * (1 - np.linalg.norm(residual) / motion))
    # Each degree beyond the first is one equation for the coefficients, so one number less is free.
    unknowns = data.n_parameters(poles.order) - (degree - 1)
    return model, {
        "structure": data.structure,
        "record_names": tuple(record.name for record in records),
        "residuals": tuple(residuals),
        "fit_percent": np.array(fit_percent),
        "rss": linear.rss,
        "noise_std": float(np.sqrt(linear.rss / (data.n_samples - unknowns))),
        "tangent_optimality": optimality,
        "order_table": outcome.selection.table(outcome.end),
        "n_fixed": search.fixed.counts,
        "search": SearchTrace(tuple(search.stages), tuple(search.minima), (), search.evaluations),
    }


def _advice(
    records: tuple[Record, ...],
    fitted: Fitted,
    model: GobfModel,
    residuals: tuple[RealArray, ...],
    refused: tuple[Finding, ...],
) -> list[Finding]:
    """Findings of `Identification.warnings` beside those of the search.

    Whether there is an answer to the input at all, doubts about the records, doubts about the poles, and the
    priors that were refused. `residuals` (T - delay,) of each record; `refused` : findings of `_identified`.
    Empty where there is no doubt; nothing is raised.
    """
    data = fitted.data
    fixed = fitted.search.fixed
    longest_s = data.longest * data.dt_s
    warnings = []
    if model.order:
        warnings += explains_nothing(data, model.poles, fixed, np.concatenate(residuals))
    warnings += advice(records, data, model, residuals, fixed)
    warnings += pole_warnings(model, fixed, fitted.search.bounds)
    warnings += implausible_pairs(model.poles, fixed, data.dt_s, longest_s)
    warnings += refused
    return warnings
