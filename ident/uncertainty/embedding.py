"""Model error and noise as one covariance: tangent stochastic embedding.

Every pole twice (the first-order effect of moving it), initial state and offset as nuisance, a short kernel
for the rest, everything conditioned on the data, averaged over one mode that the search may have missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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

# Kernel of 150 taps, as far as the records can carry it.
_DEFAULT_FIR_LENGTH = 150
# The same for a measured frequency response, as far as the frequencies can carry it.
_FRF_FIR_LENGTH = 60
# Slow, alike, near Nyquist: the rest stands anywhere (Chen, Ohlsson and Ljung, Automatica 48(8), 2012).
_SHAPES = (tc_factor, exponential_factor, alternating_factor)
# Modes that the embedding adds: coloured noise hides them from a search that takes it for white.
_MOST_ADDED = 5
# Share of the output that is nothing beside its noise.
_FREE = 1e-9
# Rounds of residuals, noise model, whitening: the first is unwhitened, the others remove its bias; of several
# outputs the covariance of the second is that of the first to a few per cent.
NOISE_ROUNDS = 3


def tangent(
    records: Sequence[Record],
    model: GobfModel,
    options: EmbeddingOptions | None = None,
    *,
    noise: NoiseModel | None = None,
) -> ResponsePosterior:
    """Posterior of the response around a model whose poles were chosen from these records.

    records: SISO, same sampling time as the model, each with its own initial state and offset; model gives
    poles, integrators and delay. Its poles, twice; then, twice each, modes that an order selection would have
    kept; then pairs of one further mode that has a probability worth counting
    (`ident.uncertainty.undetected_mode`). noise: known beforehand, so that none is fitted, whatever the
    options. Raises ValueError when the records are too short, have another
    sampling time, or do not excite the poles at all. A mode that is not seen at all stays outside the
    ellipses at its peak.
    """
    return tangent_beside(records, model, (), options, noise=noise)[0]


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
) -> tuple[ResponsePosterior, RealArray, RealArray]:
    """The tangent posterior with q columns beside the basis functions, in every record, and their
    coefficients: mean (q,) and factor (q, P') on the same unit normals as the response's covariance_factor.

    The last n_known coefficients are independent unknowns of zero mean and unit variance, the others free.
    missed_above: least frequency of a mode that may be missing, radians a sample. classes: of the rows (T,)
    of each record, by what errors of the model may depend on; where they differ the covariance is wider
    (`sandwiched`). noise: known beforehand, so that none is fitted. Errors as `tangent`.
    """
    options = options or EmbeddingOptions()
    rows, n_off = tangent_rows(records, model, options, beside), model.unstable.order
    rows = replace(rows, n_known=n_known, missed_above=missed_above, classes=tuple(classes))
    # Coloured noise taken for white passes for modes: none are added before it has been whitened.
    fits_noise = options.coloured_noise and noise is None
    if noise is not None:
        _refuse_short(records, noise)
        rows = replace(rows, noise=noise)
    first = options.model_copy(update={"prior_missed_mode": 0.0}) if fits_noise else options
    whole, reduced, kernel, missed = _solve(rows, first)
    if fits_noise:
        for _ in range(NOISE_ROUNDS):
            residuals, absorbed = gls_residuals(whole, reduced, kernel)
            fitted = fit_autoregression(residuals, options.max_ar_order, whole.noise, absorbed)
            whole, reduced, kernel, missed = _solve(replace(whole, noise=fitted), options)
    poles, without_pairs = whole.poles, (reduced, kernel)
    if missed is not None and missed.poles.size:
        reduced, kernel = (
            replace(reduced, r12=np.hstack([reduced.r12, missed.onto])),
            with_pairs(kernel, missed),
        )
        poles = Poles(poles.real, np.concatenate([poles.pairs, missed.poles]))
    # The columns beside the basis functions are no part of the response.
    after = whole.poles.order + int(rows.structure.feedthrough)
    joint, beside_rows = joint_factor(reduced, kernel), slice(after + n_off, after + rows.n_beside)
    if rows.classes:
        # The kernel's normals stay: what it leaves open above the excitation would drown everything.
        own, rest = np.split(joint[1], [reduced.n_regressors], axis=1)
        scores = whole.scores(joint_factor(*without_pairs)[0])
        scores = scores @ own[: reduced.n_columns] / kernel.noise_variance
        joint = joint[0], np.hstack([sandwiched(own, scores), rest])
    mean, factor = (np.delete(part, slice(after, after + rows.n_beside), axis=0) for part in joint)
    if missed is not None and missed.poles.size:
        mean, factor = (_pairs_after_poles(part, whole.poles.order, missed.poles) for part in (mean, factor))
    off = slice(after, after + n_off)
    mean, factor = np.concatenate([mean, joint[0][off]]), np.concatenate([factor, joint[1][off]])
    report = embedding_report(
        "tangent embedding",
        reduced,
        kernel,
        ar_coefficients=whole.noise.ar_coefficients,
        probability_missed_mode=missed.probability if missed else 0.0,
        missed_mode_rad_s=missed.most_probable_rad_s(model.dt_s) if missed else 0.0,
        n_added_modes=(whole.poles.order - rows.poles.order) // 4,
    )
    posterior = _posterior(model, poles, rows.structure.feedthrough, rows.fir_length, mean, factor, report)
    return posterior, joint[0][beside_rows], joint[1][beside_rows]


def _refuse_short(records: Sequence[Record], noise: NoiseModel) -> None:
    """Raise ValueError where a record is over before the noise model knows its past."""
    for record in records:
        if record.n_samples <= 2 * noise.n_start:
            raise ValueError(
                f"{record.label}: {record.n_samples} samples are too few for the noise model, whose first "
                f"{noise.n_start} rows have no past; expected more than {2 * noise.n_start}"
            )


def common_fir_length(records: Sequence[Record], poles: Poles, options: EmbeddingOptions) -> int:
    """Taps of the kernel: as given, else 150 or a third of the rows that the regressors leave over."""
    if options.fir_length is not None:
        return options.fir_length
    spare = sum(record.n_samples for record in records) - (len(records) + 1) * (poles.order + 2)
    return max(1, min(_DEFAULT_FIR_LENGTH, spare // 3))


def embed_response(
    data: FrfRegression,
    model: GobfModel,
    fixed: Poles,
    options: EmbeddingOptions | None = None,
    *,
    shared_gain_std: float = 0.0,
) -> ResponsePosterior:
    """Tangent posterior around a model whose poles were chosen from this response; `fixed` (first among its
    poles) are not doubled.

    The rows are whitened frequencies. The covariances of the measurement are multiplied by the estimated
    noise variance (in their units, Birge's ratio) where the rest of the fit is larger than they explain.
    shared_gain_std: relative standard deviation of a real factor common to all frequencies; it adds the
    direction of the mean. Raises ValueError if the frequencies do not outnumber the unknowns, or
    shared_gain_std is negative.
    """
    if not 0 <= shared_gain_std < np.inf:
        raise ValueError(f"shared_gain_std must not be negative; got {shared_gain_std}")
    options = options or EmbeddingOptions()
    basis = model.poles.doubled(fixed.counts)
    regressors = data.columns(basis)
    length = options.fir_length or max(1, min(_FRF_FIR_LENGTH, (data.n_samples - regressors.shape[1]) // 3))
    taps = data.common[:, np.newaxis] * data.z[:, np.newaxis] ** -np.arange(1.0, length + 1)
    measured = data.weight.ravel() > 0
    nothing = np.zeros((data.n_samples, 0))
    block = RegressionBlock(nothing, regressors[measured], data.whiten(taps)[measured], data.y[measured])
    reduced = reduce_regression([block])
    grid = kernel_grid(reduced, _SHAPES, order_given=bool(options.order_given))
    kernel = conditional_posterior(grid, *grid_weights(grid, options.no_remainder))
    mean, factor = joint_factor(reduced, kernel)
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
    """Around the model: what is not asked here is taken from it."""
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
    """Standard deviation of what regressors and kernel leave of the stacked records, their coefficients as
    good as free.

    Not quite, for a column may do nothing in these records.
    """
    size = max(float(np.std(record.output)) for record in rows.records)
    reduced = reduce_stacked(stack_blocks(replace(rows, known_std=_FREE * size).known_blocks(), stacked))
    return float(np.sqrt(reduced.rest / max(reduced.degrees_of_freedom - reduced.fir_length, 1)))


def tangent_rows(
    records: Sequence[Record], model: GobfModel, options: EmbeddingOptions, beside: Sequence[Beside] = ()
) -> EmbeddingRows:
    """Rows of the regression behind `tangent`, not yet whitened, without modes that it would add."""
    if not records:
        raise ValueError("need at least one record")
    for record in records:
        record.refuse_several(model.dt_s)
    structure = Structure(
        integrators=model.integrators,
        input_delay_samples=model.input_delay_samples,
        feedthrough=model.feedthrough != 0 if options.feedthrough is None else options.feedthrough,
        estimate_offset=options.estimate_offset,
        estimate_initial_state=options.estimate_initial_state,
        unstable=model.unstable,
    )
    poles = model.poles.doubled()
    length = common_fir_length(records, poles, options)
    if model.unstable.order:
        # A change of the unstable poles changes B(q) y: dB y on the other side, before the other columns.
        own = [-all_pass_slopes(model.unstable, record.output[:, 0]) for record in records]
        both = zip(beside or [Beside(part[:, :0], part[:, :0]) for part in own], own, strict=True)
        beside = [replace(other, columns=np.hstack([part, other.columns])) for other, part in both]
    return EmbeddingRows(tuple(records), structure, poles, length, WHITE_NOISE, tuple(beside))


def _solve(
    rows: EmbeddingRows, options: EmbeddingOptions
) -> tuple[EmbeddingRows, ReducedRegression, KernelPosterior, PairMixture | None]:
    """Posterior on these rows without a missed mode, and the pairs that may be missing (None: not looked
    for); modes that an order selection would have kept are added to the poles of the rows."""
    n_added = 0
    while True:
        stacked = stack_blocks(rows.record_blocks())
        if rows.n_known and n_added == 0:
            rows = replace(rows, known_std=_noise_std(rows, stacked))
        reduced = reduce_stacked(stack_blocks(rows.known_blocks(), stacked))
        grid = kernel_grid(reduced, _SHAPES, order_given=bool(options.order_given))
        kernel = conditional_posterior(grid, *grid_weights(grid, options.no_remainder))
        if not options.prior_missed_mode > 0:
            return rows, reduced, kernel, None
        poles, prior = candidate_pairs(max(record.n_samples for record in rows.records), rows.missed_above)
        statistics = pair_statistics(rows.pair_blocks(), reduced, poles)
        odds = options.prior_missed_mode / (1 - options.prior_missed_mode)
        log_rest = total_log_evidence(grid, options.no_remainder)
        missed = pair_mixture(poles, prior, statistics, reduced.degrees_of_freedom, log_rest, odds)
        if missed.visible is None or n_added == _MOST_ADDED:
            return rows, reduced, kernel, missed
        # Twice: the pair's first-order movement is in the regressors too.
        pair = refined_pair(rows.pair_blocks, reduced, missed.visible)
        rows = replace(rows, poles=rows.poles.appended(Poles(pairs=np.array([pair, pair]))))
        n_added += 1


def _pairs_after_poles(coefficients: RealArray, order: int, pairs: ComplexArray) -> RealArray:
    """Rows (theta, eta, amplitudes) rearranged to (basis of all poles in cascade, direct term, eta)."""
    first, rest, amplitudes = np.split(coefficients, [order, coefficients.shape[0] - 2 * pairs.size])
    return np.concatenate([first, cascade_coordinates(pairs) @ amplitudes, rest])
