"""Records and settings in, a GOBF model with everything needed to judge it out; and the part of that which is
the same for several inputs (`ident.several_inputs`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.checks.input_checks import advice, refuse_unusable
from ident.checks.integrators_prior import integrators_test
from ident.checks.nuisance_tests import NuisanceTest, clearly_left_out, nuisance_test
from ident.checks.plausible_modes import implausible_pairs
from ident.checks.prior_tests import (
    Fitted,
    best_under_relative_degree,
    delay_test,
    direct_term_test,
    fixed_poles_test,
    relative_degree_test,
    too_few_poles,
)
from ident.coloured_noise import identify_in_noise
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.finding import Finding, PriorTest
from ident.fit.least_squares import LinearFit, Regression, fit
from ident.fit.refinement import Bounds, Refined, free_optimality
from ident.fit.regression import prepare, prepare_inputs, restructured, thinned
from ident.fit.structured_fit import UnderRelativeDegree, structured_fit
from ident.identification import Identification
from ident.search.order_selection import OrderSelection, Progress, silent
from ident.search.pole_search import PoleSearch
from ident.search.pole_warnings import pole_warnings
from ident.search.search_trace import PolishedMinimum, SearchTrace

# Initial states that raise the residual of a fit from rest by this factor may have led its search astray.
_MISLED = 1.2

__all__ = ["Identification", "identify"]


def identify(
    records: Sequence[Record], options: IdentOptions | None = None, *, progress: Progress | None = None
) -> Identification:
    """Fit one GOBF model to all records together.

    Parameters
    ----------
    records : sequence of single-input single-output records of equal sampling time
        Each has its own nuisance columns (offset, initial state).
    options : IdentOptions
    progress : callable, optional
        Called with a fraction 0..1 and a short message.

    Raises
    ------
    ValueError
        If a record cannot be used (constant signal, several columns, other sampling time) or all of them
        are too short for the order asked for.

    Notes
    -----
    The result is deterministic: the same records and options give the same numbers.
    """
    options = options or IdentOptions()
    report = progress or silent
    if options.noise == "auto":

        def in_white_noise(
            part: Sequence[Record], asked: IdentOptions, start: float, end: float
        ) -> Identification:
            return _identified(part, asked, lambda f, message: report(start + (end - start) * f, message))

        refuse_unusable(records, prepare(records, options.structure()), least_order(options))
        return identify_in_noise(records, options, in_white_noise)
    return _identified(records, options, report)


def _identified(records: Sequence[Record], options: IdentOptions, report: Progress) -> Identification:
    """The fit that takes the noise as white."""
    data = prepare(records, options.structure())
    refuse_unusable(records, data, least_order(options))
    outcome, part = searched(records, data, options, report)
    data, best, verdicts = fitted_on_all(records, outcome)
    report(0.9, "tests of what is stated as known")
    data, best, tests = _priors_judged(records, part, outcome, data, best)
    result = _result(records, data, best, outcome, verdicts, tests)
    report(1.0, "identified")
    return result


def least_order(options: IdentOptions) -> int:
    """Poles that the data have to be enough for."""
    wanted = options.fixed().order + (options.n_real or 0) + 2 * (options.n_pairs or 0)
    return wanted if wanted else min(2, options.max_real) + 2 * min(1, options.max_pairs)


def searched(
    records: Sequence[Record], data: Regression, options: IdentOptions, report: Progress
) -> tuple[Outcome, Sequence[Record]]:
    """Poles from a search on the records, or a part of long ones, and that part; initial states are estimated
    where the data ask for it. `data` are the records made ready for a fit from rest."""
    part, in_mid_record = thinned(records, options.search_samples)
    structure = options.structure()
    if in_mid_record:
        structure = replace(structure, estimate_initial_state=True)
    if in_mid_record or len(part) < len(records):
        data = prepare_inputs(part, structure)
    outcome = _searched(data, options, lambda f, message: report(0.4 * f, message))
    if options.estimate_initial_state == "auto" and not in_mid_record:
        outcome = _searched_with_initial_state(part, outcome, report)
    report(0.85, "refinement and tests on all samples")
    return outcome, part


@dataclass(frozen=True, eq=False)
class Outcome:
    """A search that has come to an end on one structure.

    `from_rest` is the test that left the initial states out; where it took a descent with them, `free` is its
    end.
    """

    data: Regression
    search: PoleSearch
    selection: OrderSelection
    best: Refined
    free: Refined | None = None
    from_rest: NuisanceTest | None = None


def _searched(
    data: Regression, options: IdentOptions, report: Progress, start: Refined | None = None
) -> Outcome:
    search = PoleSearch(data, options)
    selection = OrderSelection(search, report)
    return Outcome(data, search, selection, selection.run(start))


def _searched_with_initial_state(records: Sequence[Record], outcome: Outcome, report: Progress) -> Outcome:
    """Search again with unknown initial states if the fit from rest is improbably worse than one with
    them."""
    data, options = outcome.data, outcome.search.options
    free = restructured(records, data, replace(data.structure, estimate_initial_state=True))
    without = outcome.best
    if not free.n_samples > free.n_parameters(max(without.poles.order, 4)):
        return outcome
    search = PoleSearch(free, options)
    start, polished = None, None
    if without.poles.order - search.fixed.order < 3 and None in (options.n_real, options.n_pairs):
        # Nothing found from rest: a free decay looks just so. Judge by what a search with free responses
        # finds.
        most_pairs = options.max_pairs if options.n_pairs is None else options.n_pairs
        n_real = min(2, options.max_real) if options.n_real is None else options.n_real
        end = search.joint(n_real, min(1, most_pairs))
        without = PoleSearch(data, options).descend(end.poles, "from rest")
    else:
        if without.poles.order > 0 and (
            clear := clearly_left_out(
                "initial state",
                (data, without),
                free,
                search.bounds,
                search.fixed,
                outcome.selection.worth(without),
            )
        ):
            return replace(outcome, from_rest=clear)
        end = search.descend(without.poles, "with initial state")
        polished = end
        # Transients no larger than the noise leave the search from rest its bearings: go on from its poles.
        start = end if without.rss < _MISLED * end.rss else None
    if end.poles.order == 0 or not nuisance_test("initial state", (data, without), (free, end)).needed:
        return replace(outcome, free=polished)
    return _searched(free, options, lambda fraction, message: report(0.45 + 0.4 * fraction, message), start)


def fitted_on_all(
    records: Sequence[Record], outcome: Outcome
) -> tuple[Regression, Refined, tuple[Finding, ...]]:
    """Refine on all samples and decide what was left to the data: initial state first, then the offset."""
    structure, search, best = outcome.data.structure, outcome.search, outcome.best
    options = search.options
    if options.estimate_initial_state is False:  # a search in mid-record had to estimate it all the same
        structure = replace(structure, estimate_initial_state=False)
    if outcome.data.n_samples == sum(record.n_samples - structure.input_delay_samples for record in records):
        data = restructured(records, outcome.data, structure)
    else:
        data = prepare_inputs(records, structure)
        best = _moved(data, best, search)
    verdicts = []
    for name, key, chosen in (
        ("initial state", "estimate_initial_state", options.estimate_initial_state),
        ("offset", "estimate_offset", options.estimate_offset),
    ):
        if chosen != "auto":
            continue
        if key == "estimate_initial_state" and outcome.from_rest and best is outcome.best:
            verdicts.append(outcome.from_rest.finding)
            continue
        here = (data, best)
        other_structure = replace(data.structure, **{key: not getattr(data.structure, key)})
        other_data = restructured(records, data, other_structure)
        order = best.poles.order
        if other_data.n_parameters(order) == data.n_parameters(order):
            continue  # the polynomials that integrators leave free contain the offset
        if not other_data.n_samples > other_data.n_parameters(order):
            continue
        if key == "estimate_initial_state" and outcome.free and best is outcome.best:
            there = (other_data, outcome.free)  # the very same descent was made when the search was judged
        else:
            there = (other_data, _moved(other_data, best, search))
        with_it, without = (here, there) if getattr(data.structure, key) else (there, here)
        known = with_it[1] is outcome.best and with_it[0].structure == outcome.data.structure
        worth = outcome.selection.worth(outcome.best) if known else None
        test = nuisance_test(name, without, with_it, worth)
        verdicts.append(test.finding)
        data, best = with_it if test.needed else without
    return data, best, tuple(verdicts)


def _priors_judged(
    records: Sequence[Record], part: Sequence[Record], outcome: Outcome, data: Regression, best: Refined
) -> tuple[Regression, Refined, tuple[PriorTest, ...]]:
    """Test what the options state as known, and impose the relative degree.

    Each test starts from a model that the data have not refused yet: where the integrators are refused, the
    relative degree is judged with slow poles in their place.
    """
    options = outcome.search.options
    stated = options.integrators or options.fixed_poles or options.relative_degree is not None
    if best.poles.order == 0 or not (stated or "input_delay_samples" in options.model_fields_set):
        return data, best, ()
    search = PoleSearch(data, options)
    search.minima = list(outcome.search.minima)
    given = judged = Fitted(data, best, search)
    searched = part, outcome.data.structure
    tests: list[PriorTest] = []
    if options.integrators:
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
    relative_degree, end = 1, best
    trials = (2, 3) if asked == "auto" else (asked,) if asked is not None and asked > 1 else ()
    for trial in trials:
        if trial > min(best.poles.order, judged.end.poles.order):
            if asked != "auto":
                tests.append(too_few_poles(trial, best.poles.order))
            break
        test, constrained = relative_degree_test(judged, trial)
        if asked == "auto" and test.refused:
            tests.append(replace(test, imposed=False))
            break
        tests.append(test)
        relative_degree = trial
        end = constrained if judged is given else best_under_relative_degree(given, trial)
    if "input_delay_samples" in options.model_fields_set:
        tests.append(delay_test(records, given, relative_degree))
    if relative_degree > 1:
        data = replace(data, structure=replace(data.structure, relative_degree=relative_degree))
        best = end
        outcome.search.minima.append(PolishedMinimum("relative degree", best.poles, best.rss))
    return data, best, tuple(tests)


def in_order(poles: Poles, fixed: Poles) -> Poles:
    """Fixed poles first as they are, then real ones from slow to fast and pairs from low to high
    frequency."""
    real, pairs = poles.real[fixed.real.size :], poles.pairs[fixed.pairs.size :]
    return Poles(
        np.concatenate([poles.real[: fixed.real.size], np.sort(real)[::-1]]),
        np.concatenate([poles.pairs[: fixed.pairs.size], pairs[np.argsort(np.abs(np.log(pairs)))]]),
    )


def _moved(data: Regression, best: Refined, search: PoleSearch) -> Refined:
    """The best poles polished on other rows or columns; noted in the trace of the search."""
    other = PoleSearch(data, search.options)
    end = other.descend(best.poles, "final polish")
    search.minima += other.minima
    search.evaluations += other.evaluations
    return end


def _result(
    records: Sequence[Record],
    data: Regression,
    best: Refined,
    outcome: Outcome,
    verdicts: tuple[Finding, ...],
    tests: tuple[PriorTest, ...],
) -> Identification:
    options, fixed = outcome.search.options, outcome.search.fixed
    poles = in_order(best.poles, fixed)
    degree = data.structure.relative_degree
    linear = structured_fit(data, poles, degree) if degree > 1 else fit(data, poles)
    bounds = Bounds.from_options(options, data.longest, data.dt_s)
    model = GobfModel(
        poles=poles,
        coefficients=linear.coefficients[0],
        dt_s=data.dt_s,
        feedthrough=float(linear.feedthrough[0]),
        integrators=options.integrators,
        input_delay_samples=options.input_delay_samples,
        input_name=records[0].input_names[0],
        output_name=records[0].output_names[0],
    )
    if degree > 1:
        optimality = UnderRelativeDegree(data, degree, fixed).optimality(poles, bounds)
    else:
        optimality = free_optimality(data.linearise(*poles.writable()), poles, bounds, fixed)
    refused = tuple(
        test.finding for test in tests if test.refused and (test.imposed or options.relative_degree != "auto")
    )
    described = description(records, data, poles, linear, outcome, optimality)
    residuals = described["residuals"]
    return Identification(
        model=model,
        verdicts=(*verdicts, *(test.finding for test in tests)),
        prior_tests=tests,
        advise=partial(_advice, tuple(records), data, model, residuals, fixed, bounds, refused),
        **described,
    )


def description(
    records: Sequence[Record],
    data: Regression,
    poles: Poles,
    linear: LinearFit,
    outcome: Outcome,
    optimality: float,
) -> dict[str, Any]:
    """Fields of `ident.identification.FittedRecords` that are read from the fit and the search."""
    search = outcome.search
    residuals = tuple(linear.residual[here] for here in data.segments)
    spread = [np.linalg.norm(data.y[here] - data.y[here].mean()) for here in data.segments]
    unknowns = data.n_parameters(poles.order) - (data.structure.relative_degree - 1)
    return {
        "structure": data.structure,
        "record_names": tuple(record.name for record in records),
        "residuals": residuals,
        "fit_percent": np.array(
            [100 * (1 - np.linalg.norm(r) / size) for r, size in zip(residuals, spread, strict=True)]
        ),
        "rss": linear.rss,
        "noise_std": float(np.sqrt(linear.rss / (data.n_samples - unknowns))),
        "tangent_optimality": optimality,
        "order_table": outcome.selection.table(outcome.best),
        "n_fixed": search.fixed.counts,
        "search": SearchTrace(tuple(search.stages), tuple(search.minima), (), search.evaluations),
    }


def _advice(
    records: tuple[Record, ...],
    data: Regression,
    model: GobfModel,
    residuals: tuple[RealArray, ...],
    fixed: Poles,
    bounds: Bounds,
    refused: tuple[Finding, ...],
) -> list[Finding]:
    """All that `Identification.warnings` has to say."""
    return [
        *advice(records, data, model, residuals, fixed),
        *pole_warnings(model.poles, fixed, bounds, data.dt_s),
        *implausible_pairs(model.poles, fixed, data.dt_s, data.longest * data.dt_s),
        *refused,
    ]
