"""Several operating conditions, one uncertain plant: scatter between conditions as part of the uncertainty.

A linear response identified at one amplitude, day or payload is known to its noise ellipse, but the next
condition has another response. Random effects: G_i = G + d_i, d_i ~ N(0, T), each measured with covariance
P_i. The plant met next is G + d, whose covariance around the mean of K estimates is T + (T + mean P) / K.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.posterior import ResponsePosterior
from ident.data.ellipses import hotelling_widening
from ident.data.record import Record
from ident.uncertainty.embedding import EmbeddingOptions, common_fir_length, tangent


def group_posteriors(
    groups: Sequence[Sequence[Record]], model: GobfModel, options: EmbeddingOptions | None = None
) -> list[ResponsePosterior]:
    """`tangent` for every group of records, all with the model's poles and one fir_length, fit to be
    combined: averaging over a missed mode is off, for it would give each its own further poles."""
    options = options or EmbeddingOptions()
    length = min(common_fir_length(group, model.poles.doubled(), options) for group in groups)
    shared = options.model_copy(update={"fir_length": length, "prior_missed_mode": 0.0})
    return [tangent(group, model, shared) for group in groups]


def record_posteriors(
    records: Sequence[Record], model: GobfModel, options: EmbeddingOptions | None = None
) -> list[ResponsePosterior]:
    """`group_posteriors` with every record a group of its own."""
    return group_posteriors([[record] for record in records], model, options)


def combine_posteriors(
    posteriors: Sequence[ResponsePosterior], *, small_sample_level: float | None = None
) -> ResponsePosterior:
    """Posterior of the response in a condition like these, from one posterior per condition.

    Mean = average of the K means; covariance = (1 + 1/K) w S + mean P / K with S the sample covariance
    between the means. S estimates T + mean P, so noise is counted once too often in directions that differ
    between conditions: the error is on the safe side. S has rank K - 1: with two conditions the ellipses
    stretch along the line that joins them, and nowhere else. The conditions are taken as a sample of those to
    be met; far outside their range nothing is promised.

    w = 1 takes S as known. With small_sample_level (for instance 0.95) w makes the ellipses at that level
    those of Hotelling's prediction region for one more condition: w = 2 (K - 1) / (K - 2) F(2, K - 2) /
    chi2(2), 2.9 for six conditions, 10 for four; it needs K >= 4.

    All must share poles, structure and fir_length (see `record_posteriors`). Raises ValueError otherwise.
    """
    if len(posteriors) < 2:
        raise ValueError(f"a scatter between conditions needs at least two; got {len(posteriors)}")
    first = posteriors[0]
    for other in posteriors[1:]:
        same = (
            np.array_equal(first.poles.real, other.poles.real)
            and np.array_equal(first.poles.pairs, other.poles.pairs)
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
    between = (means - mean).T * np.sqrt(_widening(count, small_sample_level) * (1 + 1 / count) / (count - 1))
    within = np.hstack([posterior.covariance_factor for posterior in posteriors]) / count
    report = first.report and replace(
        first.report,
        method=f"{first.report.method}, {count} conditions",
        noise_std=float(np.sqrt(np.mean([p.report.noise_std**2 for p in posteriors if p.report]))),
        n_rows=sum(p.report.n_rows for p in posteriors if p.report),
    )
    factor = np.asarray(np.linalg.qr(np.hstack([between, within]).T, mode="r")).T
    return replace(first, mean=mean, covariance_factor=factor, report=report)


def _widening(count: int, level: float | None) -> float:
    """Hotelling's prediction region over the chi-square ellipse, both at `level`; 1 without a level."""
    if level is None:
        return 1.0
    if count < 4:
        raise ValueError(f"a small-sample region needs at least four conditions; got {count}")
    return float(hotelling_widening(count - 1, level))
