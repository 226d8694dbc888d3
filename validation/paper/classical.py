"""The paper's stochastic embedding (Goodwin, Gevers and Ninness, IEEE TAC 37(7), 1992), for comparison.

F = Phi, prior C = alpha lam^k, unconditional covariance. Its ellipses do not cover: poles are treated as
known, and the kernel keeps its prior variance at frequencies that the data know well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.options import EmbeddingOptions
from ident.basis.posterior import ResponsePosterior
from ident.data.record import Record
from ident.uncertainty.autoregression import fit_autoregression
from ident.uncertainty.embedding import NOISE_ROUNDS, common_fir_length, tangent_rows
from ident.uncertainty.embedding_algebra import (
    KernelGrid,
    KernelPosterior,
    ReducedRegression,
    exponential_factor,
    joint_factor,
    kernel_grid,
    reduce_regression,
)
from ident.uncertainty.embedding_rows import EmbeddingRows, gls_residuals


def classical(
    records: Sequence[Record], model: GobfModel, options: EmbeddingOptions | None = None
) -> ResponsePosterior:
    """Posterior of the response as `ident.uncertainty.embedding.tangent`, by the published recipe."""
    options = options or EmbeddingOptions()
    length = common_fir_length(records, model.poles, options)
    rows = replace(tangent_rows(records, model, options), poles=model.poles, fir_length=length)
    reduced, kernel = _solved(rows)
    for _ in range(NOISE_ROUNDS if options.coloured_noise else 0):
        residuals, absorbed = gls_residuals(rows, reduced, kernel)
        noise = fit_autoregression(residuals, options.max_ar_order, rows.noise, absorbed)
        rows = replace(rows, noise=noise)
        reduced, kernel = _solved(rows)
    return ResponsePosterior(
        model.poles,
        *joint_factor(reduced, kernel),
        model.dt_s,
        fir_length=length,
        has_feedthrough=rows.structure.feedthrough,
        integrators=model.integrators,
        input_delay_samples=model.input_delay_samples,
    )


def _solved(rows: EmbeddingRows) -> tuple[ReducedRegression, KernelPosterior]:
    reduced = reduce_regression(rows.blocks())
    return reduced, prior_posterior(kernel_grid(reduced, [exponential_factor], order_given=False))


def prior_posterior(grid: KernelGrid) -> KernelPosterior:
    """alpha, lam of largest restricted likelihood, eta left at its prior."""
    best = np.unravel_index(int(np.argmax(grid.log_likelihood)), grid.log_likelihood.shape)
    spectrum = grid.spectra[best[0]]
    s2 = float(grid.noise_variance[best])
    alpha = float(grid.alpha[best])
    factor = np.zeros((spectrum.length, spectrum.singular.size))
    factor[: spectrum.singular.size] = np.sqrt(s2 * alpha) * spectrum.axes  # B V (B V)^T = B B^T
    return KernelPosterior(
        kernel_mean=np.zeros(spectrum.length),
        kernel_factor=factor,
        noise_variance=s2,
        alpha=alpha,
        lam=spectrum.lam,
        probability_no_remainder=0.0,
        log_evidence=float(grid.log_likelihood[best] - grid.log_likelihood_none),
    )
