"""Records of several inputs, of one output or several, in, one model with shared poles out.

Poles are searched on the joint cost of all outputs, each weighted by its noise; then every mode is given one
shape (`ident.mode_shapes`) where the records do not refuse it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from ident.basis.mimo_model import MimoModel
from ident.basis.model import MisoModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.checks.answer import explains_nothing
from ident.checks.input_checks import alike_inputs, few_samples, refuse_unusable
from ident.checks.plausible_modes import pole_warnings
from ident.checks.prior_tests import NuisanceTest
from ident.data.arrays import RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.record import Record
from ident.fit.least_squares import fit
from ident.fit.refinement import Refined, free_optimality
from ident.fit.regression import thinned
from ident.fit.several_outputs import OutputRegressions, prepare_outputs, whitened
from ident.identification import MimoIdentification
from ident.mode_shapes import one_shape_each
from ident.one_input import in_order, least_order
from ident.search.order_selection import OrderSelection, Progress, silent
from ident.search.pole_search import PoleSearch, SearchTrace
from ident.uncertainty.embedding import NOISE_ROUNDS

# Covariance of whitened residuals, off the unit matrix by less: the weights are right.
_WHITE = 0.05
# Level of the test of one shape per mode.
_LEVEL = 1e-3
# A residual worth less than this share of its samples is not white.
_COLOURED = 0.8


class _Found(NamedTuple):
    search: PoleSearch[OutputRegressions]
    selection: OrderSelection
    end: Refined
    verdicts: tuple[Finding, ...]


def identify_mimo(
    records: Sequence[Record],
    options: IdentOptions | None = None,
    *,
    free_shapes: bool = False,
    start: Poles | None = None,
    progress: Progress | None = None,
) -> MimoIdentification:
    """Fit one model with shared poles to all inputs and outputs of all records together.

    records: of equal inputs, outputs and sampling time; each has its own offset and initial state. An input
    may rest in some records. options: as for `identify`, the same for every channel; with several outputs at
    most one integrator in a row, for each joint has its own. No relative degree; what you know is not tested.
    free_shapes: leave every residue free. start: poles at a neighbouring operating point, where the search
    begins.

    Raises ValueError, one line, if a record cannot be used: an output that stands still or is another one
    again, inputs that differ between records or are one signal, too few samples for the order. Noise is taken
    as white in time; its covariance between outputs is estimated and weights them. Deterministic.
    """
    options = options or IdentOptions()
    if options.relative_degree is not None:
        raise ValueError(
            f"relative_degree = {options.relative_degree} is not available with several outputs; leave it out"
        )
    if options.integrators > 1 and any(len(record.output_names) > 1 for record in records):
        raise ValueError(
            f"integrators = {options.integrators}: with several outputs at most one in a row; joints that "
            "turn freely have one each, which is integrators = 1"
        )
    report = progress or silent
    _refuse_outputs(records, options)
    white = np.diag(1 / np.std(np.concatenate([record.output for record in records]), axis=0))
    for turn in range(NOISE_ROUNDS):
        # Most of the time goes into the first round.
        begun, part = 0.9 * (0.0, 0.7, 0.85)[turn], 0.9 * (0.7, 0.15, 0.15)[turn]
        told = partial(lambda begun, part, share, what: report(begun + part * share, what), begun, part)
        found = _searched(whitened(records, white), options, told, start)
        data, start = found.search.data, found.end.poles
        residual = data.residual(found.end.poles).reshape(len(data.each), -1)
        spare = 1 - data.n_parameters(found.end.poles.order) / data.n_samples
        covariance = residual @ residual.T / residual.shape[1] / spare
        refined = np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), white))
        if turn == NOISE_ROUNDS - 1 or np.max(np.abs(covariance - np.eye(len(covariance)))) < _WHITE:
            break
        white = refined
    report(0.95, "one shape for every mode")
    return _described(records, white, found, options, free_shapes=free_shapes)


def _refuse_outputs(records: Sequence[Record], options: IdentOptions) -> None:
    """What `refuse_unusable` says of each output; and outputs that are one signal."""
    data = prepare_outputs(records, options.structure())
    for k, one in enumerate(data.each):
        refuse_unusable([record.only(k) for record in records], one, least_order(options))
    rows = np.stack([one.y_clear for one in data.each])
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    if np.linalg.eigvalsh(rows @ rows.T)[0] <= 1e-12:
        raise ValueError(
            f"{records[0].label}: the outputs {list(records[0].output_names)} are linearly dependent (the "
            "same sensor twice?); leave out what others tell"
        )


def _searched(
    records: Sequence[Record], options: IdentOptions, report: Progress, start: Poles | None
) -> _Found:
    """Poles from a search on the records, or a part of long ones; polished on all of them."""
    part, in_mid_record = thinned(records, options.search_samples)
    structure = options.structure()
    structure = replace(structure, estimate_initial_state=True) if in_mid_record else structure
    search = PoleSearch(prepare_outputs(part, structure), options)
    selection = OrderSelection(search, report)
    end = selection.with_real(
        selection.run(None if start is None else search.descend(start, "other weights"))
    )
    verdicts: tuple[Finding, ...] = ()
    if options.estimate_initial_state == "auto" and not in_mid_record and end.poles.order:
        free = PoleSearch(prepare_outputs(part, replace(structure, estimate_initial_state=True)), options)
        other = free.descend(end.poles, "with initial state")
        # Likelihood ratio, the samples counted that the residual is worth.
        columns = free.data.n_parameters(end.poles.order) - search.data.n_parameters(end.poles.order)
        worth = free.colour(other).effective_samples
        ratio = max(end.rss, 1e-300) / max(other.rss, 1e-300)
        test = NuisanceTest("initial state", columns, float(worth * np.log(ratio)))
        verdicts = (test.finding,)
        if test.needed:
            search, selection = free, OrderSelection(free, report)
            end = selection.with_real(selection.run(other))
            structure = free.data.structure
    if (part is not records and len(part) < len(records)) or in_mid_record:
        everything = PoleSearch(prepare_outputs(records, structure), options)
        end = everything.descend(end.poles, "final polish")
        everything.minima[:0] = search.minima
        everything.stages[:0] = search.stages
        search = everything
    return _Found(search, selection, end, verdicts)


def _described(
    records: Sequence[Record], white: RealArray, found: _Found, options: IdentOptions, *, free_shapes: bool
) -> MimoIdentification:
    """The model in the outputs' units, modes with one shape each where the records let them."""
    search, data = found.search, found.search.data
    poles = in_order(found.end.poles, search.fixed)
    fits = [fit(one, poles) for one in data.each]
    coefficients = np.stack([one.coefficients for one in fits])
    direct = np.stack([one.feedthrough for one in fits])
    residual = np.stack([one.residual for one in fits])
    rss = float(np.sum(residual**2))
    unknowns = data.n_parameters(poles.order)
    worth = search.colour(found.end).effective_samples / data.n_samples
    free, noise_power = rss, rss / (data.n_samples - unknowns)

    def chance(rss: float, saved: int) -> float:
        return float(chi2.sf(max(rss - free, 0.0) / noise_power * worth, saved))

    given, refused = (data, poles, coefficients, direct), lambda rss, saved: chance(rss, saved) < _LEVEL
    shaped = None if free_shapes else one_shape_each(*given, n_fixed=search.fixed.counts, refused=refused)
    if shaped is not None:
        poles, coefficients, direct = shaped.poles, shaped.coefficients, shaped.direct
        residual, rss, unknowns = shaped.residual, shaped.rss, unknowns - shaped.saved
    back = np.linalg.inv(white)
    coefficients, direct = np.einsum("xy,yub->xub", back, coefficients), back @ direct
    model = MimoModel(
        tuple(
            MisoModel(
                poles=poles,
                coefficients=coefficients[k],
                feedthrough=direct[k],
                dt_s=records[0].dt_s,
                input_names=records[0].input_names,
                output_name=name,
                integrators=options.integrators,
                input_delay_samples=data.structure.input_delay_samples,
            )
            for k, name in enumerate(records[0].output_names)
        )
    )
    noise = residual @ residual.T / (residual.shape[1] * (1 - unknowns / data.n_samples))
    own, segments = back @ residual, data.each[0].segments
    measured = back @ np.stack([one.y for one in data.each])
    by_output = np.array(
        [
            [
                100 * (1 - np.linalg.norm(own[k, part]) / np.linalg.norm(y[part] - y[part].mean()))
                for k, y in enumerate(measured)
            ]
            for part in segments
        ]
    )
    return MimoIdentification(
        model=model,
        noise_covariance=back @ noise @ back.T,
        output_fit_percent=by_output,
        rank_one=() if shaped is None else shaped.rank_one,
        rank_one_test=1.0 if shaped is None else chance(shaped.rss, shaped.saved),
        structure=data.structure,
        record_names=tuple(record.name for record in records),
        residuals=tuple(own[:, part].T for part in segments),
        fit_percent=by_output.mean(axis=1),
        rss=rss,
        noise_std=float(np.sqrt(rss / (data.n_samples - unknowns))),
        tangent_optimality=free_optimality(
            data.linearise(*poles.writable()), poles, search.bounds, search.fixed
        ),
        order_table=found.selection.table(found.end),
        n_fixed=search.fixed.counts,
        verdicts=found.verdicts,
        search=SearchTrace(tuple(search.stages), tuple(search.minima), (), search.evaluations),
        advise=partial(_advice, records, search, model, residual),
    )


def _advice(
    records: Sequence[Record], search: PoleSearch[OutputRegressions], model: MimoModel, residual: RealArray
) -> list[Finding]:
    data, found = search.data, pole_warnings(model.outputs[0], search.fixed, search.bounds)
    if model.order:
        for one, rest in zip(data.each, residual, strict=True):
            found += explains_nothing(one, model.poles, search.fixed, rest)
    found += few_samples(data.each[0], model.order) + alike_inputs(records)
    worth = data.colour(residual.ravel()).effective_samples
    if worth < _COLOURED * data.n_samples:
        found.append(finding(FindingKind.COLOURED_RESIDUAL, n_samples=data.n_samples, worth=worth))
    return found
