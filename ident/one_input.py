"""Records of one input and output and settings in, a GOBF model with everything needed to judge it out."""

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

# Initial states that raise the residual of a fit from rest by this factor may have led its search astray.
_MISLED = 1.2


def identify(
    records: Sequence[Record], options: IdentOptions | None = None, *, progress: Progress | None = None
) -> Identification:
    """Fit one GOBF model to all single-input single-output records (equal sampling time) together.

    Each has its own nuisance columns (offset, initial state). progress: called with a fraction 0..1 and a
    short message. Raises ValueError for a record that cannot be used (constant signal, several columns, other
    sampling time) or too few samples for the order. Deterministic.
    """
    options = options or IdentOptions()
    report = progress or silent
    if options.noise == "auto":
        refuse_unusable(records, prepare(records, options.structure()), least_order(options))
        return identify_in_noise(
            records,
            options,
            lambda part, asked, start, end: _identified(
                part, asked, lambda f, message: report(start + (end - start) * f, message)
            ),
        )
    return _identified(records, options, report)


def untested_model(records: Sequence[Record], options: IdentOptions) -> GobfModel:
    """The model of `identify` in white noise, without relative degree, before what is stated as known is
    tested. Raises ValueError as `identify`."""
    data = prepare(records, options.structure())
    refuse_unusable(records, data, least_order(options))
    outcome, _ = searched(records, data, options, silent)
    return description(records, outcome, fitted_on_all(records, outcome)[0])[0]


def _identified(records: Sequence[Record], options: IdentOptions, report: Progress) -> Identification:
    """The fit that takes the noise as white."""
    data = prepare(records, options.structure())
    refuse_unusable(records, data, least_order(options))
    outcome, part = searched(records, data, options, report)
    outcome, at_once = _behind_dead_time(part, outcome, report)
    fitted, verdicts = fitted_on_all(records, outcome)
    if outcome.dead_time is not None:
        verdicts = (outcome.dead_time, *verdicts)
    report(0.9, "tests of what is stated as known")
    fitted, tests = _priors_judged(records, part, outcome, fitted)
    model, found = description(records, outcome, fitted)
    refused = tuple(
        test.finding for test in tests if test.refused and (test.imposed or options.relative_degree != "auto")
    )
    if at_once and not options.feedthrough and options.relative_degree is None and fitted.poles.order:
        test = direct_term_test(records, fitted)
        refused += (finding(FindingKind.ANSWERS_AT_ONCE, **test.finding.values),) if test.refused else ()
    report(1.0, "identified")
    return Identification(
        model=model,
        verdicts=(*verdicts, *(test.finding for test in tests)),
        prior_tests=tests,
        advise=partial(_advice, tuple(records), fitted, model, found["residuals"], refused),
        **found,
    )


def least_order(options: IdentOptions) -> int:
    """Poles that the data have to be enough for."""
    wanted = options.fixed().order + (options.n_real or 0) + 2 * (options.n_pairs or 0)
    return wanted if wanted else min(2, options.max_real) + 2 * min(1, options.max_pairs)


def searched(
    records: Sequence[Record], data: Regression, options: IdentOptions, report: Progress
) -> tuple[SearchOutcome, Sequence[Record]]:
    """Poles from a search on the records, or a part of long ones, and that part; initial states are estimated
    where the data ask for it. `data` are the records made ready for a fit from rest."""
    part, in_mid_record = thinned(records, options.search_samples)
    structure = options.structure()
    structure = replace(structure, estimate_initial_state=True) if in_mid_record else structure
    if in_mid_record or len(part) < len(records):
        data = prepare(part, structure)
    outcome = _searched(data, options, lambda f, message: report(0.4 * f, message))
    if options.estimate_initial_state == "auto" and not in_mid_record:
        outcome = _searched_with_initial_state(part, outcome, report)
    report(0.85, "refinement and tests on all samples")
    return outcome, part


def _behind_dead_time(
    records: Sequence[Record], plain: SearchOutcome, report: Progress
) -> tuple[SearchOutcome, bool]:
    """The search behind a delay that the data show, where nobody stated one; and whether the output answers
    in the very sample of the input. Not where a reference was recorded: noise that comes back looks like dead
    time."""
    looped = any(record.reference is not None for record in records)
    if looped or plain.search.options.input_delay_samples:
        return plain, False
    report(0.86, "dead time")
    starts, at_once = first_answer(records)
    found = seek(records, plain, starts) if plain.search.options.delay_left_to_data else None
    if found is None:
        return plain, at_once
    search = found.search
    search.minima = [*plain.search.minima, *search.minima]
    search.stages = [*plain.search.stages, *search.stages]
    search.evaluations += plain.search.evaluations
    return found, False


def _searched(
    data: Regression, options: IdentOptions, report: Progress, start: Refined | None = None
) -> SearchOutcome:
    search = PoleSearch(data, options)
    selection = OrderSelection(search, report)
    return SearchOutcome(search, selection.run(start), selection)


def _searched_with_initial_state(
    records: Sequence[Record], outcome: SearchOutcome, report: Progress
) -> SearchOutcome:
    """Search again with unknown initial states if the fit from rest is improbably worse than one with
    them."""
    data, options = outcome.data, outcome.search.options
    free = restructured(records, data, replace(data.structure, estimate_initial_state=True))
    without: Fitted = outcome
    if not free.n_samples > free.n_parameters(max(without.poles.order, 4)):
        return outcome
    search = PoleSearch(free, options)
    start, polished = None, None
    if without.poles.order - search.fixed.order < 3 and None in (options.n_real, options.n_pairs):
        # Nothing found from rest: a free decay looks just so. Judge by a search with free responses.
        most_pairs = options.max_pairs if options.n_pairs is None else options.n_pairs
        n_real = min(2, options.max_real) if options.n_real is None else options.n_real
        end = search.joint(n_real, min(1, most_pairs))
        rest = PoleSearch(data, options)
        without = Fitted(rest, rest.descend(end.poles, "from rest"))
    else:
        if without.poles.order > 0 and (clear := clearly_left_out("initial state", without, free)):
            return replace(outcome, from_rest=clear.finding)
        end = polished = search.descend(without.poles, "with initial state")
        # Transients no larger than the noise leave the search from rest its bearings: go on from its poles.
        start = end if without.end.rss < _MISLED * end.rss else None
    if end.poles.order == 0 or not nuisance_test("initial state", without, Fitted(search, end)).needed:
        return replace(outcome, free=polished)
    return _searched(free, options, lambda fraction, message: report(0.45 + 0.4 * fraction, message), start)


def fitted_on_all(records: Sequence[Record], outcome: SearchOutcome) -> tuple[Fitted, tuple[Finding, ...]]:
    """Refine on all samples and decide what was left to the data: initial state first, then the offset."""
    options, structure = outcome.search.options, outcome.data.structure
    here: Fitted = outcome
    if outcome.data.n_samples < sum(record.n_samples - structure.input_delay_samples for record in records):
        if options.estimate_initial_state is False:  # a search in mid-record had to estimate it all the same
            structure = replace(structure, estimate_initial_state=False)
        here = _moved(outcome, prepare(records, structure), outcome.poles)
    verdicts = []
    for name, key in (("initial state", "estimate_initial_state"), ("offset", "estimate_offset")):
        if getattr(options, key) != "auto":
            continue
        # The search put this question to the very same records.
        again = key == "estimate_initial_state" and here is outcome
        if again and outcome.from_rest:
            verdicts.append(outcome.from_rest)
            continue
        present = getattr(here.data.structure, key)
        changed: dict[str, Any] = {key: not present}
        other = restructured(records, here.data, replace(here.data.structure, **changed))
        needed = other.n_parameters(here.poles.order)
        # With integrators the polynomials that they leave free contain the offset.
        if needed == here.data.n_parameters(here.poles.order) or not other.n_samples > needed:
            continue
        if again and outcome.free:
            there = Fitted(PoleSearch(other, options), outcome.free)
        else:
            there = _moved(outcome, other, here.poles)
        with_it, without = (here, there) if present else (there, here)
        test = nuisance_test(name, without, with_it)
        verdicts.append(test.finding)
        here = with_it if test.needed else without
    return here, tuple(verdicts)


def _priors_judged(
    records: Sequence[Record], part: Sequence[Record], outcome: SearchOutcome, fitted: Fitted
) -> tuple[Fitted, tuple[PriorTest, ...]]:
    """Test what somebody stated as known, and impose the relative degree.

    What the program chose from the data, in options of its own, is not tested. Each test starts from a model
    that the data have not refused: with integrators refused, relative degree is judged with slow poles in
    their place.
    """
    options = outcome.search.options
    integrators_stated = options.integrators > 0 and options.is_stated("integrators")
    delay_stated = options.is_stated("input_delay_samples") and outcome.dead_time is None
    stated = integrators_stated or options.fixed_poles or options.relative_degree is not None
    if fitted.poles.order == 0 or not (stated or delay_stated):
        return fitted, ()
    search = PoleSearch(fitted.data, options)
    search.minima = list(outcome.search.minima)
    given = judged = Fitted(search, fitted.end)
    searched = part, outcome.data.structure
    tests: list[PriorTest] = []
    if integrators_stated:
        test, free = integrators_test(records, searched, given)
        tests.append(test)
        outcome.search.evaluations += free.search.evaluations
        if test.refused:
            judged = free
    if options.fixed_poles:
        tests.append(fixed_poles_test(records, searched, given))
    asked = options.relative_degree
    if asked in (1, "auto"):
        tests.append(direct_term_test(records, judged))
    relative_degree, end = 1, fitted.end
    trials = (2, 3) if asked == "auto" else (asked,) if asked is not None and asked > 1 else ()
    for trial in trials:
        if trial > min(given.poles.order, judged.poles.order):
            if asked != "auto":
                tests.append(too_few_poles(trial, given.poles.order))
            break
        test, constrained = relative_degree_test(judged, trial)
        if asked == "auto" and test.refused:
            tests.append(replace(test, imposed=False))
            break
        tests.append(test)
        relative_degree = trial
        end = constrained if judged is given else best_under_relative_degree(given, trial)
    if delay_stated:
        tests.append(delay_test(records, given, relative_degree))
    if relative_degree > 1:
        structure = replace(fitted.data.structure, relative_degree=relative_degree)
        fitted = Fitted(PoleSearch(replace(fitted.data, structure=structure), options), end)
        outcome.search.minima.append(PolishedMinimum("relative degree", end.poles, end.rss))
    return fitted, tuple(tests)


def in_order(poles: Poles, fixed: Poles) -> Poles:
    """Fixed poles first as they are, then real ones from slow to fast and pairs from low to high
    frequency."""
    real, pairs = poles.real[fixed.real.size :], poles.pairs[fixed.pairs.size :]
    return Poles(
        np.concatenate([poles.real[: fixed.real.size], np.sort(real)[::-1]]),
        np.concatenate([poles.pairs[: fixed.pairs.size], pairs[np.argsort(np.abs(np.log(pairs)))]]),
    )


def _moved(outcome: SearchOutcome, data: Regression, poles: Poles) -> Fitted:
    """The poles polished on other rows or columns; noted in the trace of the search."""
    search = PoleSearch(data, outcome.search.options)
    end = search.descend(poles, "final polish")
    outcome.search.minima += search.minima
    outcome.search.evaluations += search.evaluations
    return Fitted(search, end)


def description(
    records: Sequence[Record], outcome: SearchOutcome, fitted: Fitted
) -> tuple[GobfModel, dict[str, Any]]:
    """The model, and the fields of `ident.identification.FittedRecords` that are read from fit and search."""
    data, search, options = fitted.data, outcome.search, outcome.search.options
    degree = data.structure.relative_degree
    poles, bounds = in_order(fitted.poles, search.fixed), fitted.search.bounds
    if degree > 1:
        linear = structured_fit(data, poles, degree)
        optimality = UnderRelativeDegree(data, degree, search.fixed).optimality(poles, bounds)
    else:
        linear = fit(data, poles)
        optimality = free_optimality(data.linearise(*poles.writable()), poles, bounds, search.fixed)
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
    residuals = tuple(linear.residual[here] for here in data.segments)
    spread = [np.linalg.norm(data.y[here] - data.y[here].mean()) for here in data.segments]
    unknowns = data.n_parameters(poles.order) - (degree - 1)
    return model, {
        "structure": data.structure,
        "record_names": tuple(record.name for record in records),
        "residuals": residuals,
        "fit_percent": np.array(
            [100 * (1 - np.linalg.norm(r) / size) for r, size in zip(residuals, spread, strict=True)]
        ),
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
    """All that `Identification.warnings` has to say."""
    data, fixed, bounds = fitted.data, fitted.search.fixed, fitted.search.bounds
    unanswered = explains_nothing(data, model.poles, fixed, np.concatenate(residuals)) if model.order else []
    return [
        *unanswered,
        *advice(records, data, model, residuals, fixed),
        *pole_warnings(model, fixed, bounds),
        *implausible_pairs(model.poles, fixed, data.dt_s, data.longest * data.dt_s),
        *refused,
    ]
