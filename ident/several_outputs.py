"""Identify one model with shared poles from records of several inputs and one or several outputs.

The poles are searched on the sum of the outputs' residual energies, which is the likelihood where the noises
of the outputs are independent and equally strong. So the outputs are whitened first: multiplied by a matrix W
that makes the covariance of their noise the unit matrix. W is not known before a fit, so search and estimate
of the covariance are repeated. At the end each mode gets one shape, a residue of rank one, where a likelihood
ratio does not refuse it (`ident.mode_shapes`), and the result is written in the outputs' units.

Assumed: the noise is white in time. Its covariance between outputs is estimated.

Types of other files that travel here: `OutputRegressions`, a regression for each output (`each`) of the same
inputs u (U, N), with `y` (N,), `segments` (rows of each record) and numbers of all outputs together;
`PoleSearch`, a search on them with its fixed poles, bounds and trace; `Refined`, the end of a descent (poles,
residual sum of squares rss). A `Record` has finite samples, at least one, or it could not be made.
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
from ident.one_input import in_order, least_order, part_of
from ident.search.order_selection import OrderSelection, Progress, silent
from ident.search.pole_search import PoleSearch, SearchTrace
from ident.uncertainty.embedding import NOISE_ROUNDS

# Rounds of search and noise covariance end when no entry of the covariance of whitened residuals is off the
# unit matrix by more: weights that are wrong by w make estimates worse by about w^2, here 0.3 %.
LARGEST_WHITENING_ERROR = 0.05
# Probability with which modes that have one shape are refused by noise. Chosen: one in a thousand, small as
# each of several modes is asked. Halved or doubled, no test of several outputs moves: a wrong shape is
# refused with a probability far below it.
SHAPE_REFUSAL_LEVEL = 1e-3
# A residual worth a smaller share of its samples as independent ones is called coloured. The share of white
# noise is 1 but for chance; at 0.95 and at 0.4 the tests of several outputs do not move.
WHITE_SHARE = 0.8
# Power of a combination of outputs, each of unit length, below which it is zero. Sensors have at least a
# millionth of their motion as noise, 1e-12 in power; a copied column leaves 1e-16 of rounding.
SMALLEST_DISTINCT_POWER = 1e-12
# Where the bar of progress stands when the rounds of search are over; the shapes of the modes follow. Chosen.
ROUNDS_END = 0.9
# Begin and length of every round, as shares of all of them: the first has no poles to start from, and takes
# longer. Chosen; one entry for each of `NOISE_ROUNDS`.
ROUND_SPANS = ((0.0, 0.7), (0.7, 0.15), (0.85, 0.15))


class _FittedPoles(NamedTuple):
    """Poles from one search on whitened records, with free residues.

    search : problem (its `data`), options, bounds and trace of the fit that ended it
    selection : structures that were tried
    end : the poles, and the residual sum of squares J
    verdicts : what the data said about an initial state, where that was left to them
    """

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

    Parameters
    ----------
    records : sequence of Record
        K records of equal inputs (U), outputs (Y) and sampling time; each has its own offset and initial
        state. An input may rest in some records.
    options : IdentOptions, optional
        As for `identify`, the same for every channel. With several outputs at most one integrator in a row,
        for each joint has its own. No relative degree. What is stated as known is not tested.
    free_shapes : bool
        Leave every residue (Y, U) free, also where one of rank one would do.
    start : Poles, optional
        Where the search begins: poles at a neighbouring operating point.
    progress : callable, optional
        Called with a share 0 .. 1 and a short message.

    Returns
    -------
    MimoIdentification
        Model in the outputs' units, how well it fits, and what was tried. Deterministic.

    Raises
    ------
    ValueError
        In one line: an output that stands still or is another one again, inputs that differ between records
        or are one signal, too few samples for the order, an option that is not available, no record.

    Notes
    -----
    Noise is taken as white in time. Its covariance between outputs is estimated from the residuals, divided
    by the share of measured numbers that are left after the unknowns, and weights the outputs.
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

    # Before anything is known about the noise every output counts by how much it moves.
    output_std = np.std(np.concatenate([record.output for record in records]), axis=0)
    whitening = np.diag(1 / output_std)
    for noise_round in range(NOISE_ROUNDS):
        round_begin, round_length = ROUND_SPANS[noise_round]
        round_report = part_of(report, ROUNDS_END * round_begin, ROUNDS_END * round_length)
        fitted = _searched(whitened(records, whitening), options, round_report, start)
        data = fitted.search.data
        start = fitted.end.poles

        # Covariance (Y, Y) of what the whitened outputs leave; the unit matrix where the weights are right.
        residual = data.residual(start).reshape(len(data.each), -1)
        share_left = 1 - data.n_parameters(start.order) / data.n_samples
        covariance = residual @ residual.T / residual.shape[1] / share_left
        whitening_error = np.max(np.abs(covariance - np.eye(len(covariance))))
        if noise_round == NOISE_ROUNDS - 1 or whitening_error < LARGEST_WHITENING_ERROR:
            break
        # With L L^T the covariance, L^-1 whitens what the last weights left.
        whitening = np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), whitening))

    # Half way from `ROUNDS_END` to the end of the bar.
    report(0.95, "one shape for every mode")
    return _identification(records, whitening, fitted, options, free_shapes=free_shapes)


def _refuse_outputs(records: Sequence[Record], options: IdentOptions) -> None:
    """Raise ValueError for an output that `refuse_unusable` refuses, or for outputs that are dependent.

    Dependent are outputs of which a combination is zero but for rounding: the same sensor twice, or a column
    that was computed from others. Also raised below: no record, other names of inputs, another sampling time
    (`prepare_outputs`).
    """
    data = prepare_outputs(records, options.structure())
    for index, regression in enumerate(data.each):
        refuse_unusable([record.only(index) for record in records], regression, least_order(options))
    # Eigenvalues of the correlation of the outputs (Y, Y), offsets taken off.
    outputs = np.stack([regression.y_clear for regression in data.each])
    outputs /= np.linalg.norm(outputs, axis=1, keepdims=True)
    smallest_power = np.linalg.eigvalsh(outputs @ outputs.T)[0]
    if smallest_power <= SMALLEST_DISTINCT_POWER:
        raise ValueError(
            f"{records[0].label}: the outputs {list(records[0].output_names)} are linearly dependent (the "
            "same sensor twice?); leave out what others tell"
        )


def _searched(
    records: Sequence[Record], options: IdentOptions, report: Progress, start: Poles | None
) -> _FittedPoles:
    """Poles with free residues from a search on whitened records, or on a part of long ones.

    `start` : poles to begin with; None: a global search. Where a part was searched, the poles are polished on
    all records. Whether initial states are estimated is left to a likelihood ratio if the options say "auto".
    Records were refused before (`_refuse_outputs`); raises ValueError where bounds leave no box to search in.
    """
    part, in_mid_record = thinned(records, options.search_samples)
    structure = options.structure()
    if in_mid_record:
        # A stretch from the middle of a record does not begin at rest.
        structure = replace(structure, estimate_initial_state=True)
    search = PoleSearch(prepare_outputs(part, structure), options)
    selection = OrderSelection(search, report)
    first = None if start is None else search.descend(start, "other weights")
    end = selection.with_real(selection.run(first))

    # Did the records begin in motion? Fit free responses beside the poles, and compare.
    verdicts: tuple[Finding, ...] = ()
    if options.estimate_initial_state == "auto" and not in_mid_record and end.poles.order:
        structure_in_motion = replace(structure, estimate_initial_state=True)
        search_in_motion = PoleSearch(prepare_outputs(part, structure_in_motion), options)
        end_in_motion = search_in_motion.descend(end.poles, "with initial state")
        test = _initial_state_test(search, end, search_in_motion, end_in_motion)
        verdicts = (test.finding,)
        if test.needed:
            # Other poles may be the best ones now, and another number of them.
            search = search_in_motion
            selection = OrderSelection(search, report)
            end = selection.with_real(selection.run(end_in_motion))
            structure = search.data.structure

    # A part may be one record as well, of which the first stretch was searched.
    n_searched = sum(record.n_samples for record in part)
    if n_searched < sum(record.n_samples for record in records):
        search_on_all = PoleSearch(prepare_outputs(records, structure), options)
        end = search_on_all.descend(end.poles, "final polish")
        search_on_all.minima[:0] = search.minima
        search_on_all.stages[:0] = search.stages
        search = search_on_all
    return _FittedPoles(search, selection, end, verdicts)


def _initial_state_test(
    at_rest: PoleSearch[OutputRegressions],
    end_at_rest: Refined,
    in_motion: PoleSearch[OutputRegressions],
    end_in_motion: Refined,
) -> NuisanceTest:
    """Likelihood ratio of a fit whose records begin in motion to one whose records begin at rest.

    The statistic is Ne ln(J at rest / J in motion), with Ne the independent samples that the residual of the
    larger fit is worth; its degrees of freedom are the free responses that the larger fit has more. Not
    checked: that both ends have as many poles, and that the data of both are the same rows.
    """
    order = end_at_rest.poles.order
    columns = in_motion.data.n_parameters(order) - at_rest.data.n_parameters(order)
    effective_samples = in_motion.colour(end_in_motion).effective_samples
    # Data without noise may leave nothing: the smallest double that can be divided by stands for it.
    ratio = max(end_at_rest.rss, 1e-300) / max(end_in_motion.rss, 1e-300)
    return NuisanceTest("initial state", columns, float(effective_samples * np.log(ratio)))


def _identification(
    records: Sequence[Record],
    whitening: RealArray,
    fitted: _FittedPoles,
    options: IdentOptions,
    *,
    free_shapes: bool,
) -> MimoIdentification:
    """The model and how well it fits, from poles that were fitted to whitened outputs.

    `whitening` W (Y, Y) : takes outputs in their units to those of the fit. Modes get one shape each where
    `free_shapes` is False and the records do not refuse it. Model, residuals and noise covariance are in the
    outputs' units; rss and noise_std are those of the whitened outputs. `whitening` is invertible and there
    are more samples than unknowns: `identify_mimo` has seen to both.
    """
    search = fitted.search
    data = search.data
    poles = in_order(fitted.end.poles, search.fixed)
    linear_fits = [fit(regression, poles) for regression in data.each]
    coefficients = np.stack([linear.coefficients for linear in linear_fits])
    direct = np.stack([linear.feedthrough for linear in linear_fits])
    residual = np.stack([linear.residual for linear in linear_fits])
    rss = float(np.sum(residual**2))
    unknowns = data.n_parameters(poles.order)

    # One shape for each mode: less free numbers, so a larger residual, by no more than chance makes of them.
    free_rss = rss
    noise_power = free_rss / (data.n_samples - unknowns)
    effective_share = search.colour(fitted.end).effective_samples / data.n_samples

    def chance_of(shaped_rss: float, saved_numbers: int) -> float:
        """Probability that noise alone makes free residues fit so much better than shapes that leave
        `shaped_rss`.

        `saved_numbers` : free numbers that the shapes save, at least one: of none it is nan.
        """
        loss = max(shaped_rss - free_rss, 0.0)
        return float(chi2.sf(loss / noise_power * effective_share, saved_numbers))

    def refused(shaped_rss: float, saved_numbers: int) -> bool:
        """Whether noise alone hardly makes free residues fit so much better than shapes, as in
        `chance_of`."""
        return chance_of(shaped_rss, saved_numbers) < SHAPE_REFUSAL_LEVEL

    shaped = None
    if not free_shapes:
        n_fixed = search.fixed.counts
        shaped = one_shape_each(data, poles, coefficients, direct, n_fixed=n_fixed, refused=refused)
    rank_one: tuple[bool, ...] = ()
    rank_one_chance = 1.0
    if shaped is not None:
        poles = shaped.poles
        coefficients = shaped.coefficients
        direct = shaped.direct
        residual = shaped.residual
        rss = shaped.rss
        unknowns -= shaped.saved
        rank_one = shaped.rank_one
        rank_one_chance = chance_of(shaped.rss, shaped.saved)

    # Back to the outputs' units.
    unwhitening = np.linalg.inv(whitening)
    coefficients = np.einsum("xy,yub->xub", unwhitening, coefficients)
    direct = unwhitening @ direct
    model = MimoModel(
        tuple(
            MisoModel(
                poles=poles,
                coefficients=coefficients[index],
                feedthrough=direct[index],
                dt_s=records[0].dt_s,
                input_names=records[0].input_names,
                output_name=name,
                integrators=options.integrators,
                input_delay_samples=data.structure.input_delay_samples,
            )
            for index, name in enumerate(records[0].output_names)
        )
    )
    share_left = 1 - unknowns / data.n_samples
    noise_covariance = residual @ residual.T / (residual.shape[1] * share_left)
    output_residual = unwhitening @ residual
    segments = data.each[0].segments

    # How much of the motion of each output about its mean is explained, record by record: (K, Y), percent.
    measured = unwhitening @ np.stack([regression.y for regression in data.each])
    output_fit_percent = np.empty((len(segments), len(measured)))
    for record_index, rows in enumerate(segments):
        for output_index, signal in enumerate(measured):
            motion = np.linalg.norm(signal[rows] - signal[rows].mean())
            unexplained = np.linalg.norm(output_residual[output_index, rows])
            output_fit_percent[record_index, output_index] = 100 * (1 - unexplained / motion)

    linearisation = data.linearise(*poles.writable())
    return MimoIdentification(
        model=model,
        noise_covariance=unwhitening @ noise_covariance @ unwhitening.T,
        output_fit_percent=output_fit_percent,
        rank_one=rank_one,
        rank_one_test=rank_one_chance,
        structure=data.structure,
        record_names=tuple(record.name for record in records),
        residuals=tuple(output_residual[:, rows].T for rows in segments),
        fit_percent=output_fit_percent.mean(axis=1),
        rss=rss,
        noise_std=float(np.sqrt(rss / (data.n_samples - unknowns))),
        tangent_optimality=free_optimality(linearisation, poles, search.bounds, search.fixed),
        order_table=fitted.selection.table(fitted.end),
        n_fixed=search.fixed.counts,
        verdicts=fitted.verdicts,
        search=SearchTrace(tuple(search.stages), tuple(search.minima), (), search.evaluations),
        advise=partial(_advice, records, search, model, residual),
    )


def _advice(
    records: Sequence[Record], search: PoleSearch[OutputRegressions], model: MimoModel, residual: RealArray
) -> list[Finding]:
    """Findings to look at before trusting the model; `residual` (Y, N) is that of the whitened outputs.

    Doubtful poles, outputs that do not answer to the inputs, few samples, inputs that move together, and a
    residual that is not white. Empty where there is no doubt; nothing is raised.
    """
    data = search.data
    findings = pole_warnings(model.outputs[0], search.fixed, search.bounds)
    if model.order:
        for regression, output_residual in zip(data.each, residual, strict=True):
            findings += explains_nothing(regression, model.poles, search.fixed, output_residual)
    findings += few_samples(data.each[0], model.order)
    findings += alike_inputs(records)
    effective_samples = data.colour(residual.ravel()).effective_samples
    if effective_samples < WHITE_SHARE * data.n_samples:
        findings.append(
            finding(FindingKind.COLOURED_RESIDUAL, n_samples=data.n_samples, worth=effective_samples)
        )
    return findings
