"""Several operating conditions, one uncertain plant: scatter between conditions as part of the uncertainty.

Random effects: G_i = G + d_i, d_i ~ N(0, T), each measured with covariance P_i. The plant met next is G + d,
whose covariance around the mean of K estimates is T + (T + mean P) / K. P_i from the residuals of one record
holds for a linear arm in stationary noise; where an experiment was repeated, `repeat_posteriors` takes the
scatter from the other repeats.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.options import EmbeddingOptions
from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import RealArray
from ident.data.ellipses import hotelling_widening
from ident.data.record import Record
from ident.uncertainty.embedding import common_fir_length, tangent, tangent_rows
from ident.uncertainty.embedding_algebra import nuisance_basis, triangle_of

# Errors count together for so many time constants of the slowest pole, at most a share of a record.
_TIME_CONSTANTS, _LONGEST_WINDOW = 3.0, 0.1


def record_posteriors(
    records: Sequence[Record], model: GobfModel, options: EmbeddingOptions | None = None
) -> list[ResponsePosterior]:
    """`tangent` for every record, all with the model's poles and one fir_length, fit to be combined:
    averaging over a missed mode is off, for it would give each its own further poles."""
    options = options or EmbeddingOptions()
    length = min(common_fir_length([record], model.poles.doubled(), options) for record in records)
    shared = options.model_copy(update={"fir_length": length, "prior_missed_mode": 0.0})
    return [tangent([record], model, shared) for record in records]


def repeat_posteriors(
    groups: Sequence[Sequence[Record]], model: GobfModel, options: EmbeddingOptions | None = None
) -> list[list[ResponsePosterior]]:
    """`record_posteriors` of repeats, each with the covariance that the others of its group predict.

    The error of an estimate is a sum over time of the noise with known weights; noise: what the residuals of
    the other repeats around their common model differ by. Products of the summands are added up to three time
    constants of the slowest pole apart, with weights that fall linearly (Newey and West, Econometrica 55(3),
    1987), which needs no stationarity. Groups of two keep the covariance of each record's own residuals.
    """
    flat = iter(record_posteriors([record for group in groups for record in group], model, options))
    theirs = [[next(flat) for _ in group] for group in groups]
    return [
        _predicted_by_others(group, posteriors, model, options or EmbeddingOptions())
        if len(group) > 2
        else posteriors
        for group, posteriors in zip(groups, theirs, strict=True)
    ]


def _predicted_by_others(
    group: Sequence[Record],
    posteriors: Sequence[ResponsePosterior],
    model: GobfModel,
    options: EmbeddingOptions,
) -> list[ResponsePosterior]:
    rows = [_linear_rows(*pair, model, options) for pair in zip(group, posteriors, strict=True)]
    n_rows = min(output.size for _, output in rows)
    columns, outputs = zip(*((x[-n_rows:], y[-n_rows:]) for x, y in rows), strict=True)
    memory = -_TIME_CONSTANTS / np.log(max(float(np.abs(model.poles.values).max()), 0.1))
    window = int(np.clip(memory, 1, _LONGEST_WINDOW * n_rows))
    predicted = []
    for k, posterior in enumerate(posteriors):
        others = [j for j in range(len(group)) if j != k]
        common = np.mean([posteriors[j].mean for j in others], axis=0)
        residuals = np.stack([outputs[j] - columns[j] @ common for j in others])
        noise = (residuals - residuals.mean(axis=0)) * np.sqrt(len(others) / (len(others) - 1))
        factors = []
        for j, differs in zip(others, noise, strict=True):
            # Coefficients = mean + F F^T / s^2 X^T noise, F the factor of their covariance.
            factor = posteriors[j].covariance_factor
            report = posteriors[j].report
            assert report is not None
            # Sums over every stretch of `window` rows, those that reach over the ends too.
            total = np.cumsum((columns[j] @ factor) * differs[:, None], axis=0)
            summed = np.vstack([total, np.repeat(total[-1:], window - 1, axis=0)])
            summed[window:] -= total[:-1]
            weights = triangle_of(summed).T / (np.sqrt(window * len(others)) * report.noise_std**2)
            factors.append(factor @ weights)
        predicted.append(replace(posterior, covariance_factor=np.hstack(factors)))
    return predicted


def _linear_rows(
    record: Record, posterior: ResponsePosterior, model: GobfModel, options: EmbeddingOptions
) -> tuple[RealArray, RealArray]:
    """Columns (T, P) of the posterior's coefficients and the output (T,), whitened, without the nuisance."""
    assert posterior.report is not None
    rows = tangent_rows([record], model, options.model_copy(update={"fir_length": posterior.fir_length}))
    (block,) = replace(rows, noise=posterior.report.noise).blocks()
    basis, off = np.split(block.regressors, [block.regressors.shape[1] - model.unstable.order], axis=1)
    both = np.column_stack([basis, block.kernel[:], off, block.output])
    nuisance = nuisance_basis(block.nuisance)
    both = both - nuisance @ (nuisance.T @ both)
    return both[:, :-1], both[:, -1]


def combine_posteriors(
    posteriors: Sequence[ResponsePosterior], *, small_sample_level: float | None = None
) -> ResponsePosterior:
    """Posterior of the response in a condition like these, from one posterior per condition.

    Mean of the K means; covariance (1 + 1/K) w S + mean P / K, S the sample covariance between the means:
    noise is counted once too often in directions that differ, which is safe. S has rank K - 1. w = 1 takes S
    as known; with small_sample_level it gives Hotelling's prediction region for one more condition, w = 2 (K
    - 1) / (K - 2) F(2, K - 2) / chi2(2), and needs K >= 4. All must share poles, structure and fir_length,
    else ValueError.
    """
    if len(posteriors) < 2:
        raise ValueError(f"a scatter between conditions needs at least two; got {len(posteriors)}")
    first = posteriors[0]
    for other in posteriors[1:]:
        same = (
            np.array_equal(first.poles.values, other.poles.values)
            and np.array_equal(first.unstable.values, other.unstable.values)
            and all(
                getattr(first, name) == getattr(other, name)
                for name in ("dt_s", "fir_length", "has_feedthrough", "integrators", "input_delay_samples")
            )
        )
        if not same:
            raise ValueError("the posteriors differ in poles, structure, sampling time or fir_length")
    count = len(posteriors)
    means = np.stack([posterior.mean for posterior in posteriors])
    mean = means.mean(axis=0)
    if small_sample_level is not None and count < 4:
        raise ValueError(f"a small-sample region needs at least four conditions; got {count}")
    # Hotelling's prediction region over the chi-square ellipse.
    wider = 1.0 if small_sample_level is None else hotelling_widening(count - 1, small_sample_level)
    between = (means - mean).T * np.sqrt(wider * (1 + 1 / count) / (count - 1))
    within = np.hstack([posterior.covariance_factor for posterior in posteriors]) / count
    report = first.report and replace(
        first.report,
        method=f"{first.report.method}, {count} conditions",
        noise_std=float(np.sqrt(np.mean([p.report.noise_std**2 for p in posteriors if p.report]))),
        n_rows=sum(p.report.n_rows for p in posteriors if p.report),
    )
    factor = np.asarray(np.linalg.qr(np.hstack([between, within]).T, mode="r")).T
    return replace(first, mean=mean, covariance_factor=factor, report=report)
