"""Several inputs, one output, one basis: identification with shared poles (MISO).

The paper's remark on multi-link manipulators: at an operating point every motor excites the same modes, so
y = sum_i sum_m c_im L_m(q) u_i + nuisances + v has one set of poles and a row of coefficients per input. A
mode that one motor hardly moves is found through the others, and all data sharpen every pole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from ident.basis.miso_model import MisoModel
from ident.basis.options import IdentOptions
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.fit.miso_regression import (
    MisoRegression,
    fit,
    linearisation,
    prepare_inputs,
    project,
    restructured,
)
from ident.fit.refinement import Bounds, Polished, free_optimality
from ident.fit.regression import thinned
from ident.fit.residual_colour import effective_samples
from ident.identify import _in_order
from ident.miso_identification import MisoIdentification
from ident.search.miso_search import MisoSearch, MisoSelection
from ident.search.order_selection import Progress
from ident.search.pole_warnings import pole_warnings
from ident.search.search_trace import SearchTrace

# As in `ident.identify`: level at which a nuisance left to the data stays, and how far initial states may
# have led a search from rest astray.
_NUISANCE_LEVEL = 0.99
_MISLED = 2.0
# Inputs are one signal if a combination of them, each scaled to unit length, has less than the first share of
# the power; below the second the channels are told apart badly.
_SAME_INPUT = 1e-12
_ALIKE_INPUT = 1e-2
# A residual worth less than this share of its samples is not white.
_COLOURED = 0.8

__all__ = ["MisoIdentification", "MisoModel", "identify_miso"]


def identify_miso(
    records: Sequence[Record], options: IdentOptions | None = None, *, progress: Progress | None = None
) -> MisoIdentification:
    """Fit one model with shared poles to all inputs of all records together.

    Parameters
    ----------
    records : sequence of records of equal inputs, one output and equal sampling time
        Each has its own nuisance columns (offset, initial state). An input may rest in some records, so
        experiments that excite one motor at a time can be put together; over all records the inputs must be
        distinguishable.
    options : IdentOptions
        As for `identify`, the same for every input: integrators, delay and direct terms are those of all
        channels. A relative degree is not imposed here, and what is stated as known is not tested.
    progress : callable, optional
        Called with a fraction 0..1 and a short message.

    Raises
    ------
    ValueError
        If a record cannot be used, the inputs of the records differ or are one signal, the data are too short
        for the order asked for, or the options ask for a relative degree.

    Notes
    -----
    Search, descent and choice of the order are those of `identify` on the joint cost; with one input the
    results agree. Deterministic: the same records and options give the same numbers.
    """
    options = options or IdentOptions()
    if options.relative_degree is not None:
        raise ValueError(
            f"relative_degree = {options.relative_degree} is not available with several inputs; leave it out"
        )
    report: Progress = progress or (lambda fraction, message: None)
    data = prepare_inputs(records, options.structure())
    wanted = options.fixed().order + (options.n_real or 0) + 2 * (options.n_pairs or 0)
    _refuse_unusable(
        records, data, wanted if wanted else min(2, options.max_real) + 2 * min(1, options.max_pairs)
    )
    part, in_mid_record = thinned(records, options.search_samples)
    structure = options.structure()
    if in_mid_record:
        structure = replace(structure, estimate_initial_state=True)
    outcome = _searched(prepare_inputs(part, structure), options, lambda f, text: report(0.4 * f, text))
    if options.estimate_initial_state == "auto" and not in_mid_record:
        outcome = _searched_with_initial_state(part, outcome, report)
    report(0.9, "polish and tests on all samples")
    result = _result(records, outcome, *_fitted_on_all(records, outcome))
    report(1.0, "identified")
    return result


@dataclass(frozen=True, eq=False)
class _Outcome:
    """A search that has come to an end on one structure."""

    data: MisoRegression
    search: MisoSearch
    selection: MisoSelection
    best: Polished


def _searched(
    data: MisoRegression, options: IdentOptions, report: Progress, start: Polished | None = None
) -> _Outcome:
    search = MisoSearch(data, options)
    selection = MisoSelection(search, report)
    return _Outcome(data, search, selection, selection.run(start))


def _searched_with_initial_state(records: Sequence[Record], outcome: _Outcome, report: Progress) -> _Outcome:
    """Search again with unknown initial states if the fit from rest is improbably worse than one with
    them."""
    data, options, without = outcome.data, outcome.search.options, outcome.best
    free = restructured(data, records, estimate_initial_state=True)
    if not free.n_samples > free.n_parameters(max(without.poles.order, 4)):
        return outcome
    search = MisoSearch(free, options)
    start = None
    if without.poles.order - search.fixed.order < 3 and None in (options.n_real, options.n_pairs):
        # Nothing found from rest: a free decay looks just so. Judge by what a search with free responses
        # finds.
        most_pairs = options.max_pairs if options.n_pairs is None else options.n_pairs
        n_real = min(2, options.max_real) if options.n_real is None else options.n_real
        end = search.joint(n_real, min(1, most_pairs))
        without = MisoSearch(data, options).descend(end.poles, "from rest")
    else:
        end = search.descend(without.poles, "with initial state")
        start = end if without.rss < _MISLED * end.rss else None
    if end.poles.order == 0 or not _nuisance_test("initial state", (data, without), (free, end))[0]:
        return outcome
    return _searched(free, options, lambda fraction, text: report(0.45 + 0.4 * fraction, text), start)


def _nuisance_test(
    name: str, without: tuple[MisoRegression, Polished], with_it: tuple[MisoRegression, Polished]
) -> tuple[bool, str]:
    """Is the nuisance needed, and the verdict: Ne ln(J without / J with) against its chi-square quantile."""
    order = without[1].poles.order
    columns = with_it[0].n_parameters(order) - without[0].n_parameters(order)
    data, end = with_it
    worth = effective_samples(project(data, end.poles).residual, data.starts)
    statistic = worth * np.log(max(without[1].rss, 1e-300) / max(end.rss, 1e-300))
    limit = float(chdtri(columns, 1 - _NUISANCE_LEVEL))
    needed = bool(statistic > limit)
    return needed, (
        f"{name} {'estimated' if needed else 'left out'}: {columns} unknowns, "
        f"test statistic {statistic:.1f} against {limit:.1f} at {_NUISANCE_LEVEL:.0%}"
    )


def _fitted_on_all(
    records: Sequence[Record], outcome: _Outcome
) -> tuple[MisoRegression, Polished, tuple[str, ...]]:
    """Polish on all samples and decide what was left to the data: initial state first, then the offset."""
    options, structure, best = outcome.search.options, outcome.data.structure, outcome.best
    if options.estimate_initial_state is False:  # a search in mid-record had to estimate it all the same
        structure = replace(structure, estimate_initial_state=False)
    data = prepare_inputs(records, structure)
    if data.n_samples != outcome.data.n_samples:
        best = _moved(data, best, outcome.search)
    verdicts = []
    for name, key, chosen in (
        ("initial state", "estimate_initial_state", options.estimate_initial_state),
        ("offset", "estimate_offset", options.estimate_offset),
    ):
        if chosen != "auto":
            continue
        here = (data, best)
        other = restructured(data, records, **{key: not getattr(data.structure, key)})
        order = best.poles.order
        if other.n_parameters(order) == data.n_parameters(order):
            continue  # the polynomials that integrators leave free contain the offset
        if not other.n_samples > other.n_parameters(order):
            continue
        there = (other, _moved(other, best, outcome.search))
        with_it, without = (here, there) if getattr(data.structure, key) else (there, here)
        needed, verdict = _nuisance_test(name, without, with_it)
        verdicts.append(verdict)
        data, best = with_it if needed else without
    return data, best, tuple(verdicts)


def _moved(data: MisoRegression, best: Polished, search: MisoSearch) -> Polished:
    """The best poles polished on other rows or columns; noted in the trace of the search."""
    other = MisoSearch(data, search.options)
    end = other.descend(best.poles, "final polish")
    search.minima += other.minima
    search.evaluations += other.evaluations
    return end


def _result(
    records: Sequence[Record],
    outcome: _Outcome,
    data: MisoRegression,
    best: Polished,
    verdicts: tuple[str, ...],
) -> MisoIdentification:
    search = outcome.search
    options, fixed = search.options, search.fixed
    poles = _in_order(best.poles, fixed)
    linear = fit(data, poles)
    model = MisoModel(
        poles=poles,
        coefficients=linear.coefficients,
        feedthrough=linear.feedthrough,
        dt_s=data.dt_s,
        input_names=records[0].input_names,
        output_name=records[0].output_names[0],
        integrators=options.integrators,
        input_delay_samples=options.input_delay_samples,
    )
    segments = [data.segment(i) for i in range(data.n_records)]
    residuals = tuple(linear.residual[here] for here in segments)
    spread = [np.linalg.norm(data.y[here] - data.y[here].mean()) for here in segments]
    bounds = Bounds.from_options(options, data.longest, data.dt_s)
    warnings = [*pole_warnings(poles, fixed, bounds, data.dt_s), *_advice(data, model, linear.residual)]
    here = linearisation(data, poles)
    return MisoIdentification(
        model=model,
        structure=data.structure,
        record_names=tuple(record.name for record in records),
        residuals=residuals,
        fit_percent=np.array(
            [100 * (1 - np.linalg.norm(r) / size) for r, size in zip(residuals, spread, strict=True)]
        ),
        rss=linear.rss,
        noise_std=float(np.sqrt(linear.rss / (data.n_samples - data.n_parameters(poles.order)))),
        tangent_optimality=free_optimality(here, poles, bounds, fixed.real.size, fixed.pairs.size),
        order_table=outcome.selection.table(outcome.best),
        n_fixed=(fixed.real.size, fixed.pairs.size),
        verdicts=verdicts,
        search=SearchTrace(
            tuple(search.stages), tuple(search.minima), tuple(dict.fromkeys(warnings)), search.evaluations
        ),
    )


def _refuse_unusable(records: Sequence[Record], data: MisoRegression, order: int) -> None:
    names = records[0].input_names
    for i, name in enumerate(names):
        if all(np.ptp(record.input[:, i]) == 0 for record in records):
            raise ValueError(
                f"{records[0].label}: input column '{name}' is constant in every record; "
                "expected a signal that varies in at least one"
            )
    for record in records:
        if np.ptp(record.output[:, 0]) == 0:
            raise ValueError(
                f"{record.label}: output column '{record.output_names[0]}' is constant "
                f"({record.output[0, 0]:.6g}); expected a signal that varies"
            )
    if _least_independence(data) <= _SAME_INPUT:
        raise ValueError(
            f"{records[0].label}: the inputs {list(names)} are linearly dependent, so their channels cannot "
            "be told apart; expected independent signals"
        )
    needed = data.n_parameters(order)
    if not data.n_samples > needed:
        labels = records[0].label if len(records) == 1 else f"{len(records)} records"
        raise ValueError(
            f"{labels}: {data.n_samples} samples are too few for order {order} from {len(names)} inputs, "
            f"which has {needed} unknowns; expected at least {needed + 1}"
        )


def _least_independence(data: MisoRegression) -> float:
    """Least power of a unit combination of the inputs, each of unit length: 1 uncorrelated, 0 dependent."""
    rows = data.input_rows / np.linalg.norm(data.input_rows, axis=1, keepdims=True)
    return float(np.linalg.eigvalsh(rows @ rows.T)[0])


def _advice(data: MisoRegression, model: MisoModel, residual: RealArray) -> list[str]:
    sentences = []
    needed = data.n_parameters(model.order)
    if data.n_samples < 10 * needed:
        sentences.append(
            f"only {data.n_samples} samples for {needed} unknowns: record longer, or fit fewer poles; below "
            "ten samples per unknown the choice of the poles is itself uncertain"
        )
    if _least_independence(data) < _ALIKE_INPUT:
        sentences.append(
            f"the inputs {list(model.input_names)} are nearly one signal: their channels are told apart "
            "badly; excite them independently, or one at a time in records of their own"
        )
    worth = effective_samples(residual, data.starts)
    if worth < _COLOURED * data.n_samples:
        sentences.append(
            f"the residual is not white ({data.n_samples} samples are worth {worth:.0f}): poles are missing, "
            "or noise and disturbances are coloured; uncertainties that assume white noise are too small"
        )
    return sentences
