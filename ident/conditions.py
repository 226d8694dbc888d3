"""Several operating conditions, one uncertain plant: scatter between conditions as part of the uncertainty.

A linear response identified at one amplitude, day or payload is known to its noise ellipse, but the next
condition has another response. Random effects: G_i = G + d_i, d_i ~ N(0, T), each measured with covariance
P_i. The plant met next is G + d, whose covariance around the mean of K estimates is T + (T + mean P) / K.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.embedding import EmbeddingOptions, common_fir_length, tangent
from ident.frequency_uncertainty import FrequencyUncertainty
from ident.model import GobfModel
from ident.posterior import ResponsePosterior
from ident.record import Record


def record_posteriors(
    records: Sequence[Record], model: GobfModel, options: EmbeddingOptions | None = None
) -> list[ResponsePosterior]:
    """`tangent` for every record alone, all with the model's poles and one fir_length, so that they can be combined."""
    options = options or EmbeddingOptions()
    length = min(common_fir_length([record], model.poles.doubled(), options) for record in records)
    shared = options.model_copy(update={"fir_length": length})
    return [tangent([record], model, shared) for record in records]


def combine_posteriors(posteriors: Sequence[ResponsePosterior]) -> ResponsePosterior:
    """Posterior of the response in a condition like these, from one posterior per condition.

    Mean = average of the K means; covariance = (1 + 1/K) S + mean P / K with S the sample covariance between
    the means. S estimates T + mean P, so noise is counted once too often in directions that differ between
    conditions: the error is on the safe side. S has rank K - 1: with two conditions the ellipses stretch
    along the line that joins them, to 2.1 times either's distance from the middle per standard deviation, and
    nowhere else. The conditions are taken as a sample of those to be met; far outside their range nothing is
    promised.

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
    between = (means - mean).T * np.sqrt((1 + 1 / count) / (count - 1))
    within = np.hstack([posterior.covariance_factor for posterior in posteriors]) / count
    report = first.report and replace(
        first.report,
        method=f"{first.report.method}, {count} conditions",
        noise_std=float(np.sqrt(np.mean([p.report.noise_std**2 for p in posteriors if p.report]))),
        n_rows=sum(p.report.n_rows for p in posteriors if p.report),
    )
    factor = np.asarray(np.linalg.qr(np.hstack([between, within]).T, mode="r")).T
    return replace(first, mean=mean, covariance_factor=factor, report=report)


def combine_responses(responses: Sequence[FrequencyUncertainty]) -> FrequencyUncertainty:
    """The same for frequency responses of any origin on one grid, frequency by frequency.

    Raises ValueError when there are fewer than two or their grids or sampling times differ.
    """
    if len(responses) < 2:
        raise ValueError(f"a scatter between conditions needs at least two; got {len(responses)}")
    first = responses[0]
    for other in responses[1:]:
        if not np.array_equal(first.omega_rad_s, other.omega_rad_s) or first.dt_s != other.dt_s:
            raise ValueError("the responses are on different frequency grids or sampling times")
    count = len(responses)
    centres = np.stack([response.centre for response in responses])
    deviation = centres - centres.mean(axis=0)
    pair = np.stack([deviation.real, deviation.imag])
    between = np.einsum("akf,bkf->fab", pair, pair) * (1 + 1 / count) / (count - 1)
    within = np.mean([response.covariance for response in responses], axis=0) / count
    return replace(
        first,
        centre=centres.mean(axis=0),
        covariance=between + within,
        method=f"{first.method}, {count} conditions",
    )
