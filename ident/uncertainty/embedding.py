"""Model error and noise as one covariance: tangent stochastic embedding.

The response is expanded around a model whose poles were chosen from the same records (Goodwin, Gevers and
Ninness, IEEE TAC 37(7), 1992, with poles that move). Every pole stands twice in the basis, which is the
first-order effect of moving it; initial state and offset are nuisance; a short kernel holds what the poles
leave out; everything is conditioned on the data, and averaged over one mode that the search may have missed
(`undetected_mode`). `tangent` does it for records, `tangent_beside` with further columns, such as those of a
friction, and `embed_response` for a measured frequency response.

Neglected: second order in the displacement of poles, and two missed modes at once. A mode that is not seen at
all stays outside the ellipses at its peak.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ident.basis.autoregressive_noise import WHITE_NOISE
from ident.basis.functions import all_pass_slopes
from ident.basis.model import GobfModel
from ident.basis.noise_model import NoiseModel
from ident.basis.options import EmbeddingOptions
from ident.basis.poles import Poles
from ident.basis.posterior import EmbeddingReport, ResponsePosterior
from ident.basis.structure import Structure
from ident.data.arrays import ComplexArray, IntArray, RealArray
from ident.data.record import Record
from ident.fit.frf_regression import FrfRegression
from ident.uncertainty.autoregression import fit_autoregression
from ident.uncertainty.embedding_algebra import (
    KernelPosterior,
    ReducedRegression,
    RegressionBlock,
    StackedBlocks,
    alternating_factor,
    conditional_posterior,
    embedding_report,
    exponential_factor,
    grid_weights,
    joint_factor,
    kernel_grid,
    reduce_regression,
    reduce_stacked,
    sandwiched,
    stack_blocks,
    tc_factor,
    total_log_evidence,
)
from ident.uncertainty.embedding_rows import Beside, EmbeddingRows, gls_residuals
from ident.uncertainty.undetected_mode import (
    PairMixture,
    candidate_pairs,
    cascade_coordinates,
    pair_mixture,
    pair_statistics,
    refined_pair,
    with_pairs,
)

# Taps of the kernel, as far as the records can carry it. Halved or doubled, the median ellipse of twenty
# simulated arms moved by .1 %; the time grows with it.
_DEFAULT_FIR_LENGTH = 150
# Taps of the kernel for a measured frequency response, as far as the frequencies can carry it. Chosen below
# `_DEFAULT_FIR_LENGTH`: a measured response has some hundred points, where records have thousands of rows.
_FRF_FIR_LENGTH = 60
# Rows, or frequencies, for each tap: a kernel that is as long as the data are would explain all of them.
# Chosen; it acts on records of fewer than some 500 rows.
_ROWS_PER_TAP = 3
# Columns that `common_fir_length` counts for each record, and for the regressors, beyond one per pole: up to
# two (of the nuisance offset and a polynomial of an integrator; of the regressors the direct term). It is an
# estimate; the exact count is checked when the regression is reduced.
_COLUMNS_BEYOND_POLES = 2
# Kernel shapes for what the poles leave out, by where on the frequency axis it has most power: at low ones,
# alike at all, near the Nyquist frequency. Together they cover a remainder anywhere (Chen, Ohlsson and Ljung,
# Automatica 48(8), 2012).
_SHAPES = (tc_factor, exponential_factor, alternating_factor)
# Modes that the embedding adds at most: coloured noise hides them from a search that takes it for white. Of
# twenty simulated arms none asked for a second one; coloured noise that is taken for white asks for four.
_MOST_ADDED = 5
# Weight of what is known of coefficients, as a share of the output's size, at which it is none beside the
# records, but still keeps a column that does nothing from having no coefficient. Chosen far below the noise
# of any log and far above rounding, 1e-16.
_FREE = 1e-9
# Rounds of residuals, noise model, whitening: the first is unwhitened, the others remove its bias. Of ten
# simulated arms in coloured noise ellipses are 16 % too small after one round and 2 % after two, and six
# rounds change them by .2 %. Of several outputs the covariance of the second is that of the first to a few
# per cent.
NOISE_ROUNDS = 3


def tangent(
    records: Sequence[Record],
    model: GobfModel,
    options: EmbeddingOptions | None = None,
    *,
    noise: NoiseModel | None = None,
) -> ResponsePosterior:
    """Posterior of the response around a model whose poles were chosen from these records.

    Parameters
    ----------
    records : sequence of Record
        One input, one output each, of the model's sampling time; each with its own initial state and offset.
    model : GobfModel
        Gives poles, integrators and delay; its coefficients do not matter.
    options : EmbeddingOptions, optional
        Length of the kernel, nuisances, prior probability of a missed mode, whether the noise is coloured.
    noise : NoiseModel, optional
        Known beforehand, so that none is fitted, whatever the options.

    Returns
    -------
    ResponsePosterior
        On the model's poles, twice; then, twice each, modes that an order selection would have kept; then
        pairs of one further mode that has a probability worth counting (`ident.uncertainty.undetected_mode`).

    Raises
    ------
    ValueError
        When the records are too short, have another sampling time, or do not excite the poles at all.
    """
    return tangent_beside(records, model, (), options, noise=noise).response


class TangentBeside(NamedTuple):
    """Posterior of a response, and of the coefficients of q columns beside its basis functions.

    response: on P' unit normals; mean (q,) and factor (q, P') of the coefficients, on the same normals as the
    response's covariance_factor. q does not count the columns of unstable poles, which are in the response.
    """

    response: ResponsePosterior
    mean: RealArray
    factor: RealArray


def tangent_beside(
    records: Sequence[Record],
    model: GobfModel,
    beside: Sequence[Beside],
    options: EmbeddingOptions | None = None,
    *,
    n_known: int = 0,
    missed_above: float = 0.0,
    classes: Sequence[IntArray] = (),
    noise: NoiseModel | None = None,
) -> TangentBeside:
    """Posterior (`tangent`) with q columns beside the basis functions of every record; their coefficients.

    Parameters
    ----------
    records, model, options, noise
        Those of `tangent`.
    beside : sequence of Beside
        One per record (not checked), or none: columns (T, q) with shared coefficients, and columns (T, p1)
        that take the place of the first p1 basis functions.
    n_known : int
        The last so many coefficients are independent unknowns of zero mean and unit variance, the others
        free.
    missed_above : float
        Least frequency of a mode that may be missing, radians a sample.
    classes : sequence of ndarray of int, shape (T,)
        Class 0 .. M - 1, M at least 2, of each row of each record, by what errors of the model may depend on;
        where the classes differ the covariance is wider (`sandwiched`). Empty: one class.

    Returns
    -------
    TangentBeside

    Raises
    ------
    ValueError
        As `tangent`; also where a record is no longer than twice the first rows of a given noise model, and
        where `classes` has not one entry per record.
    """
    options = options or EmbeddingOptions()
    n_unstable = model.unstable.order
    rows = tangent_rows(records, model, options, beside)
    rows = replace(rows, n_known=n_known, missed_above=missed_above, classes=tuple(classes))
    if noise is not None:
        _refuse_short(records, noise)
        rows = replace(rows, noise=noise)

    # Coloured noise taken for white passes for modes: none are added before it has been whitened.
    fits_noise = options.coloured_noise and noise is None
    first_options = options
    if fits_noise:
        first_options = options.model_copy(update={"prior_missed_mode": 0.0})
    solution = _solve(rows, first_options)
    if fits_noise:
        for _ in range(NOISE_ROUNDS):
            residuals, absorbed = gls_residuals(solution.rows, solution.reduced, solution.kernel)
            fitted = fit_autoregression(residuals, options.max_ar_order, solution.rows.noise, absorbed)
            solution = _solve(replace(solution.rows, noise=fitted), options)
    solved_rows = solution.rows
    reduced = solution.reduced
    kernel = solution.kernel

    # The pairs of a missed mode, as further columns behind the kernel's.
    missed = solution.missed
    poles = solved_rows.poles
    has_pairs = missed is not None and missed.poles.size > 0
    if missed is not None and has_pairs:
        reduced = replace(reduced, r12=np.hstack([reduced.r12, missed.onto]))
        kernel = with_pairs(kernel, missed)
        poles = Poles(poles.real, np.concatenate([poles.pairs, missed.poles]))

    # Coefficients: basis functions and direct term, columns beside them (unstable poles first), kernel,
    # pairs.
    mean, factor = joint_factor(reduced, kernel)
    if rows.classes:
        # The kernel's normals stay: what it leaves open above the excitation would drown everything.
        by_noise, by_kernel = np.split(factor, [reduced.n_regressors], axis=1)
        without_pairs, _ = joint_factor(solution.reduced, solution.kernel)
        plain_scores = solved_rows.scores(without_pairs)
        scores = plain_scores @ by_noise[: reduced.n_columns] / kernel.noise_variance
        factor = np.hstack([sandwiched(by_noise, scores), by_kernel])

    # The columns beside the basis functions are no part of the response, but for those of unstable poles,
    # which come last.
    n_direct = int(rows.structure.feedthrough)
    after = solved_rows.poles.order + n_direct
    of_unstable = slice(after, after + n_unstable)
    of_beside = slice(after + n_unstable, after + rows.n_beside)
    everything_beside = slice(after, after + rows.n_beside)
    response_mean = np.delete(mean, everything_beside, axis=0)
    response_factor = np.delete(factor, everything_beside, axis=0)
    if missed is not None and has_pairs:
        response_mean = _pairs_after_poles(response_mean, solved_rows.poles.order, missed.poles)
        response_factor = _pairs_after_poles(response_factor, solved_rows.poles.order, missed.poles)
    response_mean = np.concatenate([response_mean, mean[of_unstable]])
    response_factor = np.concatenate([response_factor, factor[of_unstable]])

    report = embedding_report(
        "tangent embedding",
        reduced,
        kernel,
        ar_coefficients=solved_rows.noise.ar_coefficients,
        probability_missed_mode=missed.probability if missed else 0.0,
        missed_mode_rad_s=missed.most_probable_rad_s(model.dt_s) if missed else 0.0,
        # Two poles a pair, and each pair twice.
        n_added_modes=(solved_rows.poles.order - rows.poles.order) // 4,
    )
    response = _posterior(
        model, poles, rows.structure.feedthrough, rows.fir_length, response_mean, response_factor, report
    )
    return TangentBeside(response, mean[of_beside], factor[of_beside])


def _refuse_short(records: Sequence[Record], noise: NoiseModel) -> None:
    """Raise ValueError, with its name, where a record has 2 n_start samples or fewer.

    n_start: rows of a record on which the noise model lacks a past.
    """
    for record in records:
        # Twice: at least as many rows with a past as without one.
        if record.n_samples <= 2 * noise.n_start:
            raise ValueError(
                f"{record.label}: {record.n_samples} samples are too few for the noise model, whose first "
                f"{noise.n_start} rows have no past; expected more than {2 * noise.n_start}"
            )


def common_fir_length(records: Sequence[Record], poles: Poles, options: EmbeddingOptions) -> int:
    """Taps of the kernel: as in the options, else the smaller of 150 and a third of the rows left over.

    records: their numbers of rows count. poles: of the regressors (doubled for the tangent method). Rows are
    left over by the regressors and by the nuisance of every record, one column per pole and up to two more;
    columns beside them are not counted. At least 1, also without records; a length from the options is not
    checked here (`reduce_stacked` refuses one that the rows do not determine).
    """
    if options.fir_length is not None:
        return options.fir_length
    n_rows = sum(record.n_samples for record in records)
    n_columns = (len(records) + 1) * (poles.order + _COLUMNS_BEYOND_POLES)
    return max(1, min(_DEFAULT_FIR_LENGTH, (n_rows - n_columns) // _ROWS_PER_TAP))


def embed_response(
    data: FrfRegression,
    model: GobfModel,
    fixed: Poles,
    options: EmbeddingOptions | None = None,
    *,
    shared_gain_std: float = 0.0,
) -> ResponsePosterior:
    """Tangent posterior around a model whose poles were chosen from a measured frequency response.

    Parameters
    ----------
    data : FrfRegression
        The response; its rows are whitened frequencies, first axes of all ellipses above second axes.
    model : GobfModel
        Of it poles and structure matter.
    fixed : Poles
        First among the model's poles of each type (not checked; only their numbers count); they are known and
        not doubled.
    options : EmbeddingOptions, optional
        Length of the kernel, and whether the order was given; the rest concerns records.
    shared_gain_std : float
        Relative standard deviation of a real factor common to all frequencies, such as that of a sensor's
        gain; it adds the direction of the mean.

    Returns
    -------
    ResponsePosterior

    Raises
    ------
    ValueError
        If the frequencies do not outnumber the unknowns, or shared_gain_std is negative, infinite or NaN.

    Notes
    -----
    The covariances of the measurement are multiplied by the estimated noise variance (in their units, Birge's
    ratio) where the rest of the fit is larger than they explain.
    """
    if not 0 <= shared_gain_std < np.inf:
        raise ValueError(f"shared_gain_std must not be negative; got {shared_gain_std}")
    options = options or EmbeddingOptions()
    basis = model.poles.doubled(fixed.counts)
    regressors = data.columns(basis)
    n_spare = data.n_samples - regressors.shape[1]
    length = options.fir_length or max(1, min(_FRF_FIR_LENGTH, n_spare // _ROWS_PER_TAP))
    delays = data.z[:, np.newaxis] ** -np.arange(1.0, length + 1)
    taps = data.common[:, np.newaxis] * delays

    # Frequencies of weight zero were not measured. There is no nuisance.
    measured = data.weight.ravel() > 0
    no_nuisance = np.zeros((data.n_samples, 0))
    block = RegressionBlock(no_nuisance, regressors[measured], data.whiten(taps)[measured], data.y[measured])
    reduced = reduce_regression([block])
    grid = kernel_grid(reduced, _SHAPES, order_given=bool(options.order_given))
    weights, weight_none = grid_weights(grid, options.no_remainder)
    kernel = conditional_posterior(grid, weights, weight_none)
    mean, factor = joint_factor(reduced, kernel)

    # The stated covariances hold where the fit leaves less than they say.
    widening = np.sqrt(max(kernel.noise_variance, 1.0) / kernel.noise_variance)
    factor = np.column_stack([widening * factor, shared_gain_std * mean])
    report = embedding_report("tangent embedding of a measured response", reduced, kernel)
    return _posterior(model, basis, data.feedthrough, length, mean, factor, report)


def _posterior(
    model: GobfModel,
    poles: Poles,
    feedthrough: bool,
    fir_length: int,
    mean: RealArray,
    factor: RealArray,
    report: EmbeddingReport,
) -> ResponsePosterior:
    """Posterior of the coefficients of `poles`, direct term and fir_length taps: mean (P,), factor (P, P').

    Sampling time, integrators, delay, names and unstable poles are those of the model; P counts the unstable
    poles, too, last. Raises ValueError, by `ResponsePosterior`, for other shapes or numbers not finite.
    """
    return ResponsePosterior(
        poles=poles,
        mean=mean,
        covariance_factor=factor,
        dt_s=model.dt_s,
        fir_length=fir_length,
        has_feedthrough=feedthrough,
        integrators=model.integrators,
        input_delay_samples=model.input_delay_samples,
        input_name=model.input_name,
        output_name=model.output_name,
        report=report,
        unstable=model.unstable,
    )


def _noise_std(rows: EmbeddingRows, stacked: StackedBlocks) -> float:
    """Standard deviation, output units, of what regressors and kernel leave of the stacked records.

    stacked: triangle of the records' rows, without what is known of coefficients. Those of which something is
    known are nearly free here (`_FREE`): entirely free, a column that does nothing in these records would be
    refused. Raises ValueError as `reduce_stacked`; 0 for records that are fitted exactly, or all zero.
    """
    size = max(float(np.std(record.output)) for record in rows.records)
    nearly_free = replace(rows, known_std=_FREE * size)
    reduced = reduce_stacked(stack_blocks(nearly_free.known_blocks(), stacked))
    # At least one, against a division by zero.
    freedom = max(reduced.degrees_of_freedom - reduced.fir_length, 1)
    return float(np.sqrt(reduced.unexplained / freedom))


def tangent_rows(
    records: Sequence[Record], model: GobfModel, options: EmbeddingOptions, beside: Sequence[Beside] = ()
) -> EmbeddingRows:
    """Rows of the regression behind `tangent`, not yet whitened, without modes that it would add.

    Parameters
    ----------
    records : sequence of Record
        One input, one output each, of the model's sampling time.
    model : GobfModel
        Gives poles, which are doubled, and structure.
    options : EmbeddingOptions
        Length of the kernel, offset, initial state, direct term (None: the model's).
    beside : sequence of Beside
        Further columns, one entry per record (not checked), or none. Those of unstable poles are put before
        them.

    Returns
    -------
    EmbeddingRows

    Raises
    ------
    ValueError
        Without records, or where one has several inputs or outputs or another sampling time.
    """
    if not records:
        raise ValueError("need at least one record")
    for record in records:
        record.refuse_several(model.dt_s)
    feedthrough = options.feedthrough
    if feedthrough is None:
        feedthrough = model.feedthrough != 0
    structure = Structure(
        integrators=model.integrators,
        input_delay_samples=model.input_delay_samples,
        feedthrough=feedthrough,
        estimate_offset=options.estimate_offset,
        estimate_initial_state=options.estimate_initial_state,
        unstable=model.unstable,
    )
    poles = model.poles.doubled()
    length = common_fir_length(records, poles, options)
    if model.unstable.order:
        # A change of the unstable poles changes B(q) y: dB y on the other side, before the other columns.
        with_unstable = []
        for k, record in enumerate(records):
            slopes = -all_pass_slopes(model.unstable, record.output[:, 0])
            nothing = slopes[:, :0]
            other = beside[k] if beside else Beside(nothing, nothing)
            with_unstable.append(replace(other, columns=np.hstack([slopes, other.columns])))
        beside = with_unstable
    return EmbeddingRows(tuple(records), structure, poles, length, WHITE_NOISE, tuple(beside))


class _Solution(NamedTuple):
    """Fit of some rows: the rows with the modes that were added, their regression, kernel and missed mode.

    reduced: the triangle of these rows with p regressors and L taps. kernel: Gaussian of the taps, and with
    the triangle of the coefficients, under the hypothesis of no missed mode. missed: the pairs that may be
    missing with their probabilities, None where they were not looked for.
    """

    rows: EmbeddingRows
    reduced: ReducedRegression
    kernel: KernelPosterior
    missed: PairMixture | None


def _solve(rows: EmbeddingRows, options: EmbeddingOptions) -> _Solution:
    """Posterior on these rows; modes that an order selection would have kept are added to their poles.

    Modes are looked for where options.prior_missed_mode (in [0, 1) by its class) is positive, one after the
    other, as long as `pair_mixture` names one in `visible` (it drops J by more than 4 ln nu in nu ln J, and
    pairs are likelier than the rest). After `_MOST_ADDED` a further one is left to the mixture, without a
    word. Raises ValueError by `reduce_stacked` and `candidate_pairs`: records too short, or an input that
    does not excite the poles.
    """
    n_added = 0
    while True:
        stacked = stack_blocks(rows.record_blocks())
        # Once: the deviation only weighs what is known, and a mode more changes it little.
        if rows.n_known and n_added == 0:
            rows = replace(rows, known_std=_noise_std(rows, stacked))
        reduced = reduce_stacked(stack_blocks(rows.known_blocks(), stacked))
        grid = kernel_grid(reduced, _SHAPES, order_given=bool(options.order_given))
        weights, weight_none = grid_weights(grid, options.no_remainder)
        kernel = conditional_posterior(grid, weights, weight_none)
        if not options.prior_missed_mode > 0:
            return _Solution(rows, reduced, kernel, None)

        longest = max(record.n_samples for record in rows.records)
        poles, prior = candidate_pairs(longest, rows.missed_above)
        statistics = pair_statistics(rows.pair_blocks(), reduced, poles)
        odds = options.prior_missed_mode / (1 - options.prior_missed_mode)
        log_rest = total_log_evidence(grid, options.no_remainder)
        missed = pair_mixture(poles, prior, statistics, reduced.degrees_of_freedom, log_rest, odds)
        if missed.visible is None or n_added == _MOST_ADDED:
            return _Solution(rows, reduced, kernel, missed)

        # Twice: the pair's first-order movement is in the regressors too.
        pair = refined_pair(rows.pair_blocks, reduced, missed.visible)
        doubled_pair = Poles(pairs=np.array([pair, pair]))
        rows = replace(rows, poles=rows.poles.appended(doubled_pair))
        n_added += 1


def _pairs_after_poles(coefficients: RealArray, order: int, pairs: ComplexArray) -> RealArray:
    """Coefficients, (P,) or (P, n), from (theta, eta, amplitudes) to (basis of all poles, direct term, eta).

    order: of the poles without the pairs, whose basis functions come first in theta. pairs (K,), in z, all
    different: their 2 K amplitudes, the last rows, become the coefficients of their cascade behind those
    poles. Nothing is checked.
    """
    n_amplitudes = 2 * pairs.size
    before_amplitudes = coefficients.shape[0] - n_amplitudes
    of_poles, direct_and_taps, amplitudes = np.split(coefficients, [order, before_amplitudes])
    of_pairs = cascade_coordinates(pairs) @ amplitudes
    return np.concatenate([of_poles, of_pairs, direct_and_taps])
