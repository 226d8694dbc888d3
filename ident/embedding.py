"""Model error and noise as one covariance: stochastic embedding, classical and tangent (design 4.5).

`classical` is the recipe of Goodwin, Gevers and Ninness (IEEE TAC 37(7), 1992) that the paper's Fig. 7 uses.
Its ellipses do not cover: poles chosen from the same data are treated as known, and the kernel keeps its
prior variance at frequencies that the data know well. `tangent` is the default: every pole twice (which spans
the first-order effect of moving the poles), initial state and offset as nuisance, a short kernel for what is
left, everything conditioned on the data.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from ident.arrays import RealArray
from ident.autoregression import fit_autoregression
from ident.basis import free_response, regressor
from ident.embedding_algebra import (
    KernelPosterior,
    ReducedRegression,
    RegressionBlock,
    conditional_posterior,
    evaluate_grid,
    exponential_factor,
    grid_weights,
    joint_factor,
    kernel_spectrum,
    prior_posterior,
    reduce_regression,
    tc_factor,
)
from ident.model import GobfModel
from ident.poles import Poles
from ident.posterior import EmbeddingReport, ResponsePosterior
from ident.record import Record
from ident.structure import filter_input

# Kernel of 150 taps (design 4.5), as far as the records can carry it.
_DEFAULT_FIR_LENGTH = 150


class EmbeddingOptions(BaseModel):
    """Settings of the uncertainty estimate."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    fir_length: int | None = Field(
        default=None,
        ge=1,
        description="taps of the kernel on the remainder; none given: 150, less for short records",
    )
    hyperparameters: Literal["average", "maximum"] = Field(
        default="average",
        description="average the kernel over a grid weighted by restricted likelihood, or take the largest",
    )
    prior_no_remainder: float = Field(
        default=0.5,
        ge=0.0,
        lt=1.0,
        description="prior probability that the poles explain everything (alpha = 0)",
    )
    estimate_offset: bool = Field(default=True, description="a constant on each record's output")
    estimate_initial_state: bool = Field(
        default=True, description="free response of all poles in each record"
    )
    coloured_noise: bool = Field(
        default=False, description="whiten with an AR model of the residuals, two rounds"
    )
    max_ar_order: int = Field(default=8, ge=1, le=100, description="largest AR order that BIC may choose")
    feedthrough: bool | None = Field(
        default=None, description="direct term; none given: as the model has one or not"
    )


def tangent(
    records: Sequence[Record], model: GobfModel, options: EmbeddingOptions | None = None
) -> ResponsePosterior:
    """Posterior of the response around a model whose poles were chosen from these records.

    records: SISO, same sampling time as the model, each with its own initial state and offset; model gives
    poles, integrators and delay (its coefficients are not used). Raises ValueError when the records are too
    short, have another sampling time, or do not excite the poles at all.
    """
    options = options or EmbeddingOptions()
    return _embed(records, model, model.poles.doubled(), options, classical_recipe=False)


def classical(
    records: Sequence[Record], model: GobfModel, options: EmbeddingOptions | None = None
) -> ResponsePosterior:
    """The published recipe, for comparison: F = Phi, prior C = alpha lam^k, unconditional covariance.

    Same arguments and errors as `tangent`; hyperparameters are always those of largest restricted likelihood,
    and prior_no_remainder is not used. Do not design a controller on it: see the module docstring.
    """
    options = options or EmbeddingOptions()
    return _embed(records, model, model.poles, options, classical_recipe=True)


def common_fir_length(records: Sequence[Record], poles: Poles, options: EmbeddingOptions) -> int:
    """Taps of the kernel: as given, else 150 or a third of the rows that the regressors leave over."""
    if options.fir_length is not None:
        return options.fir_length
    spare = sum(record.n_samples for record in records) - (len(records) + 1) * (poles.order + 2)
    return max(1, min(_DEFAULT_FIR_LENGTH, spare // 3))


@dataclass(frozen=True, eq=False)
class _Regression:
    """How to make the matrices; made anew for each pass: only one record's are in memory."""

    records: tuple[Record, ...]
    model: GobfModel
    poles: Poles
    options: EmbeddingOptions
    feedthrough: bool
    fir_length: int

    def blocks(self, whitening: RealArray) -> Iterator[RegressionBlock]:
        for record in self.records:
            yield _block(
                record, self.model, self.poles, self.options, self.feedthrough, self.fir_length, whitening
            )


def _embed(
    records: Sequence[Record],
    model: GobfModel,
    poles: Poles,
    options: EmbeddingOptions,
    *,
    classical_recipe: bool,
) -> ResponsePosterior:
    feedthrough = model.feedthrough != 0 if options.feedthrough is None else options.feedthrough
    regression = _build(records, model, poles, options, feedthrough)
    whitening = np.ones(1)
    reduced, kernel = _solve(regression, whitening, options, classical_recipe)
    if options.coloured_noise:
        for _ in range(2):
            residuals = _residuals(regression, whitening, reduced, kernel)
            whitening = fit_autoregression(residuals, options.max_ar_order)
            reduced, kernel = _solve(regression, whitening, options, classical_recipe)
    mean, factor = joint_factor(reduced, kernel)
    return ResponsePosterior(
        poles=poles,
        mean=mean,
        covariance_factor=factor,
        dt_s=model.dt_s,
        fir_length=regression.fir_length,
        has_feedthrough=feedthrough,
        integrators=model.integrators,
        input_delay_samples=model.input_delay_samples,
        input_name=model.input_name,
        output_name=model.output_name,
        report=EmbeddingReport(
            method="classical embedding" if classical_recipe else "tangent embedding",
            noise_std=float(np.sqrt(kernel.noise_variance)),
            alpha=kernel.alpha,
            lam=kernel.lam,
            probability_no_remainder=kernel.probability_no_remainder,
            log_evidence=kernel.log_evidence,
            n_rows=reduced.n_rows,
            n_regressors=reduced.n_regressors,
            ar_coefficients=tuple(float(a) for a in whitening[1:]),
        ),
    )


def _build(
    records: Sequence[Record], model: GobfModel, poles: Poles, options: EmbeddingOptions, feedthrough: bool
) -> _Regression:
    if not records:
        raise ValueError("need at least one record")
    for record in records:
        if record.input.shape[1] != 1 or record.output.shape[1] != 1:
            raise ValueError(
                f"record {record.name!r}: need one input and one output; use record.siso(input, output)"
            )
        if not abs(record.dt_s - model.dt_s) <= 1e-9 * model.dt_s:
            raise ValueError(f"record {record.name!r} has dt_s = {record.dt_s}, the model {model.dt_s}")
    length = common_fir_length(records, poles, options)
    return _Regression(tuple(records), model, poles, options, feedthrough, length)


def _block(
    record: Record,
    model: GobfModel,
    poles: Poles,
    options: EmbeddingOptions,
    feedthrough: bool,
    length: int,
    whitening: RealArray,
) -> RegressionBlock:
    """Matrices of one record, every column filtered by A(q), its first rows dropped.

    That is exact for any noise before the record. Columns driven by the input from rest commute with the
    filter, so for them the input is filtered; only the nuisance columns are filtered one by one.
    """
    n_samples, skip = record.n_samples, whitening.size - 1
    u = _filtered(filter_input(record.input[:, 0], model.integrators, model.input_delay_samples), whitening)
    delayed = np.concatenate([np.zeros(1), u[:-1]])
    columns = [regressor(poles, u)]
    if feedthrough:
        columns.append(u[:, None])
    degrees = max(int(options.estimate_offset), model.integrators if options.estimate_initial_state else 0)
    ramp = np.linspace(-1.0, 1.0, n_samples)
    nuisance = [ramp[:, None] ** degree for degree in range(degrees)]
    if options.estimate_initial_state:
        nuisance.append(free_response(poles, n_samples))
    known = np.hstack(nuisance) if nuisance else np.zeros((n_samples, 0))
    return RegressionBlock(
        nuisance=_filtered(known, whitening)[skip:],
        regressors=np.hstack(columns)[skip:],
        kernel=toeplitz(delayed, np.zeros(length))[skip:],
        output=_filtered(record.output[:, 0], whitening)[skip:],
    )


def _filtered(signal: RealArray, whitening: RealArray) -> RealArray:
    if whitening.size == 1 or signal.size == 0:
        return signal
    return np.asarray(lfilter(whitening, np.ones(1), signal, axis=0), dtype=np.float64)


def _solve(
    regression: _Regression, whitening: RealArray, options: EmbeddingOptions, classical_recipe: bool
) -> tuple[ReducedRegression, KernelPosterior]:
    reduced = reduce_regression(regression.blocks(whitening))
    length = regression.fir_length
    # Decay times from less than a sample to where the kernel has died out (e^-6 in variance) at its last tap.
    decay_samples = np.geomspace(0.7, max(length / 6.0, 1.0), 12)
    # From a remainder far below the noise to one a hundred thousand times its amplitude.
    relative_alpha = np.geomspace(1e-2, 1e10, 49)
    factor = exponential_factor if classical_recipe else tc_factor
    spectra = [
        kernel_spectrum(reduced, lam, factor(lam, length)) for lam in np.exp(-1.0 / decay_samples).tolist()
    ]
    grid = evaluate_grid(reduced, spectra, relative_alpha)
    if classical_recipe:
        return reduced, prior_posterior(grid)
    weights, none = grid_weights(grid, options.prior_no_remainder)
    if options.hyperparameters == "maximum":
        # alpha = 0 is the lower end of the grid in the limit, so it wins only where the whole grid is worse.
        none = float(grid.log_likelihood_none >= grid.log_likelihood.max())
        weights = np.zeros_like(weights)
        weights.flat[int(np.argmax(grid.log_likelihood))] = 1.0 - none
    return reduced, conditional_posterior(grid, weights, none)


def _residuals(
    regression: _Regression, whitening: RealArray, reduced: ReducedRegression, kernel: KernelPosterior
) -> list[RealArray]:
    """y minus the posterior mean response and each record's nuisance, unwhitened, one array per record."""
    mean, _ = joint_factor(reduced, kernel)
    p = reduced.n_columns
    residuals = []
    for block in regression.blocks(np.ones(1)):
        rest = block.output - block.regressors @ mean[:p] - block.kernel @ mean[p:]
        if block.nuisance.shape[1]:
            # The nuisance is fitted where it was estimated, in the whitened rows, and taken off the plain
            # ones.
            skip = whitening.size - 1
            columns, target = (_filtered(part, whitening)[skip:] for part in (block.nuisance, rest))
            coefficients, *_ = np.linalg.lstsq(columns, target, rcond=1e-10)
            rest = rest - block.nuisance @ coefficients
        residuals.append(rest)
    return residuals
