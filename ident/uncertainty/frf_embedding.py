"""Posterior of a response fitted to a measured frequency response: the tangent embedding of design 4.5.

The rows are whitened frequencies instead of samples; the rest is the same: every searched pole twice, a short
kernel (or none, by restricted likelihood) for what the poles leave, everything conditioned on the data.
"""

from __future__ import annotations

import numpy as np

from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.fit.frf_regression import FrfRegression
from ident.uncertainty.embedding import EmbeddingOptions
from ident.uncertainty.embedding_algebra import (
    RegressionBlock,
    averaged_posterior,
    embedding_report,
    joint_factor,
    kernel_grid,
    reduce_regression,
    tc_factor,
)

# Kernel of 60 taps, as far as the frequencies can carry it.
_DEFAULT_FIR_LENGTH = 60


def embed_response(
    data: FrfRegression,
    poles: Poles,
    fixed: Poles,
    *,
    integrators: int,
    input_delay_samples: int,
    options: EmbeddingOptions | None = None,
    shared_gain_std: float = 0.0,
) -> ResponsePosterior:
    """Posterior around poles chosen from this response; `fixed` (first among `poles`) are not doubled.

    The covariances of the measurement are taken as they are if the rest of the fit is no larger than they
    explain, and multiplied by the estimated noise variance (in their units, Birge's ratio) if it is: the
    posterior never claims more than the measurement. shared_gain_std is the relative standard deviation of a
    real factor common to all frequencies; the fit is proportional to the measurement, so it adds exactly one
    direction, that of the mean itself. Raises ValueError if the frequencies do not outnumber the unknowns, or
    shared_gain_std is negative.
    """
    if not 0 <= shared_gain_std < np.inf:
        raise ValueError(f"shared_gain_std must not be negative; got {shared_gain_std}")
    options = options or EmbeddingOptions()
    basis = poles.doubled(fixed.counts)
    regressors = data.columns(basis)
    spare = data.n_rows - regressors.shape[1]
    length = options.fir_length or max(1, min(_DEFAULT_FIR_LENGTH, spare // 3))
    taps = data.common[:, np.newaxis] * data.z[:, np.newaxis] ** -np.arange(1.0, length + 1)
    measured = data.weight.ravel() > 0
    reduced = reduce_regression(
        [
            RegressionBlock(
                nuisance=np.zeros((data.n_rows, 0)),
                regressors=regressors[measured],
                kernel=data.whiten(taps)[measured],
                output=data.y[measured],
            )
        ]
    )
    grid = kernel_grid(reduced, tc_factor)
    kernel = averaged_posterior(grid, options.prior_no_remainder, options.hyperparameters)
    mean, factor = joint_factor(reduced, kernel)
    widening = np.sqrt(max(kernel.noise_variance, 1.0) / kernel.noise_variance)
    return ResponsePosterior(
        poles=basis,
        mean=mean,
        covariance_factor=np.column_stack([widening * factor, shared_gain_std * mean]),
        dt_s=data.dt_s,
        fir_length=length,
        has_feedthrough=data.feedthrough,
        integrators=integrators,
        input_delay_samples=input_delay_samples,
        report=embedding_report("tangent embedding of a measured response", reduced, kernel),
    )
