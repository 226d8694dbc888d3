"""Several operating conditions, one uncertain plant: scatter between conditions as part of the uncertainty.

Random effects: in condition i the response is G_i = G + d_i, d_i ~ N(0, T), and it is measured with
covariance P_i. The plant met next is G + d, whose covariance around the mean of K estimates is
T + (T + mean P) / K (`combine_posteriors`; Hotelling's prediction region where K is small). P_i from the
residuals of one record (`record_posteriors`) holds for a linear arm in stationary noise. Where an experiment
was repeated, `repeat_posteriors` takes the scatter from the other repeats, which needs neither.
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

# Errors at two times count together up to so many time constants of the slowest pole: e^-3 = 5 % of its
# motion is left then. Halved or doubled, the predicted scatter of 72 sweeps stays within the limits of
# tests/ident/test_conditions.py.
_TIME_CONSTANTS = 3.0
# They count together over this share of a record at most: it leaves ten stretches, and fewer would be too few
# to take a scatter from. Halved, the predicted scatter of 72 sweeps stays within the limits of
# tests/ident/test_conditions.py.
_LONGEST_WINDOW = 0.1
# Magnitude that the slowest pole is taken to have at least, as a pole at zero has no time constant. At .1
# three time constants are 1.3 samples, so that the window is one row; any smaller number gives the same.
_FASTEST_POLE = 0.1
# Repeats of a group from which on one is predicted by the others: a single other has nothing to differ from.
_FEWEST_REPEATS = 3
# Conditions from which Hotelling's region is given: at 95 % it makes ellipses 3.1 times as wide for four, and
# 11.5 times for three, which would say nothing.
_FEWEST_CONDITIONS = 4
# What posteriors must share, beside their poles, for their coefficients to mean the same.
_SHARED_FIELDS = ("dt_s", "fir_length", "has_feedthrough", "integrators", "input_delay_samples")


def record_posteriors(
    records: Sequence[Record], model: GobfModel, options: EmbeddingOptions | None = None
) -> list[ResponsePosterior]:
    """Posterior of the response (`tangent`) from every record by itself, fit to be combined.

    Parameters
    ----------
    records : sequence of Record
        At least one (else ValueError of `min`); one input, one output each, sampled as the model.
    model : GobfModel
        Of it the poles and the structure (integrators, delay, direct term, unstable poles) matter, not its
        coefficients: all posteriors have its poles, twice.
    options : EmbeddingOptions, optional
        Averaging over a missed mode is off here, for it would give each record further poles of its own.

    Returns
    -------
    list of ResponsePosterior
        One per record, with one fir_length: the shortest that a record can carry.

    Raises
    ------
    ValueError
        By `ident.uncertainty.embedding.tangent`: a record is too short, has another sampling time, several
        inputs or outputs, or does not excite the poles at all.
    """
    options = options or EmbeddingOptions()
    poles = model.poles.doubled()
    length = min(common_fir_length([record], poles, options) for record in records)
    shared_options = options.model_copy(update={"fir_length": length, "prior_missed_mode": 0.0})
    return [tangent([record], model, shared_options) for record in records]


def repeat_posteriors(
    groups: Sequence[Sequence[Record]], model: GobfModel, options: EmbeddingOptions | None = None
) -> list[list[ResponsePosterior]]:
    """Posteriors of repeats (`record_posteriors`), each with the covariance that its group's others predict.

    Parameters
    ----------
    groups : sequence of sequence of Record
        Each group repeats one experiment.
    model, options
        Those of `record_posteriors`.

    Returns
    -------
    list of list of ResponsePosterior
        One list per group, one posterior per record, in their order. Groups of one or two keep the
        covariance of each record's own residuals.

    Raises
    ------
    ValueError
        By `record_posteriors`, and without any record.

    Notes
    -----
    The error of an estimate is a sum over time of the noise with known weights; noise: what the residuals of
    the other repeats around their common model differ by. Products of the summands are added up to three time
    constants of the slowest pole apart, with weights that fall linearly (Newey and West, Econometrica 55(3),
    1987), which needs no stationarity.
    """
    options = options or EmbeddingOptions()
    # All records at once, so that they get one fir_length.
    records = [record for group in groups for record in group]
    posteriors = iter(record_posteriors(records, model, options))
    predicted = []
    for group in groups:
        of_group = [next(posteriors) for _ in group]
        if len(group) >= _FEWEST_REPEATS:
            of_group = _predicted_by_others(group, of_group, model, options)
        predicted.append(of_group)
    return predicted


def _predicted_by_others(
    group: Sequence[Record],
    posteriors: Sequence[ResponsePosterior],
    model: GobfModel,
    options: EmbeddingOptions,
) -> list[ResponsePosterior]:
    """The posteriors of three or more repeats, each with the covariance of its error as the others show it.

    group and posteriors: one entry per repeat, in the same order, all posteriors with the same P coefficients
    and a report. The means stay; the factors are (P, P (n - 1)) of n repeats. That the repeats had the same
    input is not checked: repeats of unequal length are compared over their last rows.
    """
    # The last rows of all repeats, as many as the shortest has.
    columns: list[RealArray] = []
    outputs: list[RealArray] = []
    for record, posterior in zip(group, posteriors, strict=True):
        record_columns, record_output = _linear_rows(record, posterior, model, options)
        columns.append(record_columns)
        outputs.append(record_output)
    n_rows = min(output.size for output in outputs)
    columns = [record_columns[-n_rows:] for record_columns in columns]
    outputs = [output[-n_rows:] for output in outputs]

    slowest = max(float(np.abs(model.poles.values).max()), _FASTEST_POLE)
    memory = -_TIME_CONSTANTS / np.log(slowest)
    window = int(np.clip(memory, 1, _LONGEST_WINDOW * n_rows))

    predicted = []
    for k, posterior in enumerate(posteriors):
        others = [j for j in range(len(group)) if j != k]
        n_others = len(others)
        # What the others leave of their common model, and by how much they differ in it: their noise, whose
        # mean was taken off, as an unbiased deviation.
        common = np.mean([posteriors[j].mean for j in others], axis=0)
        residuals = np.stack([outputs[j] - columns[j] @ common for j in others])
        noise = (residuals - residuals.mean(axis=0)) * np.sqrt(n_others / (n_others - 1))
        factors = []
        for j, own_noise in zip(others, noise, strict=True):
            # Coefficients = mean + F F^T / s^2 X^T noise, F the factor of their covariance.
            factor = posteriors[j].covariance_factor
            report = posteriors[j].report
            assert report is not None
            # Sums over every stretch of `window` rows, those that reach over the ends too: their outer
            # products, added up, are the products of summands with weights that fall linearly.
            total = np.cumsum((columns[j] @ factor) * own_noise[:, None], axis=0)
            after_end = np.repeat(total[-1:], window - 1, axis=0)
            summed = np.vstack([total, after_end])
            summed[window:] -= total[:-1]
            weights = triangle_of(summed).T / (np.sqrt(window * n_others) * report.noise_std**2)
            factors.append(factor @ weights)
        predicted.append(replace(posterior, covariance_factor=np.hstack(factors)))
    return predicted


def _linear_rows(
    record: Record, posterior: ResponsePosterior, model: GobfModel, options: EmbeddingOptions
) -> tuple[RealArray, RealArray]:
    """Columns (T, P) of the posterior's coefficients and the output (T,), whitened, without the nuisance.

    posterior: made from this record by `record_posteriors`; of it matter the noise model (in its report,
    which has to be there), fir_length, and the order of the coefficients: basis functions and direct term,
    kernel, unstable poles. T counts the rows behind the delay, less those that the noise model leaves out.
    Raises ValueError as `tangent_rows`.
    """
    assert posterior.report is not None
    same_length = options.model_copy(update={"fir_length": posterior.fir_length})
    rows = tangent_rows([record], model, same_length)
    (block,) = replace(rows, noise=posterior.report.noise).blocks()
    # Columns of unstable poles stand last among the coefficients, but before the kernel among the rows.
    n_basis = block.regressors.shape[1] - model.unstable.order
    basis, of_unstable = np.split(block.regressors, [n_basis], axis=1)
    everything = np.column_stack([basis, block.kernel[:], of_unstable, block.output])
    nuisance = nuisance_basis(block.nuisance)
    everything = everything - nuisance @ (nuisance.T @ everything)
    return everything[:, :-1], everything[:, -1]


def combine_posteriors(
    posteriors: Sequence[ResponsePosterior], *, small_sample_level: float | None = None
) -> ResponsePosterior:
    """Posterior of the response in a condition like these, from one posterior per condition.

    Parameters
    ----------
    posteriors : sequence of ResponsePosterior
        K >= 2, with the same poles, structure, sampling time and fir_length.
    small_sample_level : float, optional
        Level, below 1, at which the ellipses of one more condition hold although the scatter is known from K
        conditions only; needs K >= 4. None takes the scatter as known.

    Returns
    -------
    ResponsePosterior
        Its mean is the mean of the K means. Its report is the first one's, with "K conditions" added to the
        name of the method, the root mean square of the noises and the sum of the rows; None if the first
        has none.

    Raises
    ------
    ValueError
        If there are too few posteriors, or they do not share what they must (poles bit by bit, and
        `_SHARED_FIELDS`). `small_sample_level` outside (0, 1): by `hotelling_widening`.

    Notes
    -----
    Covariance (1 + 1/K) w S + mean P / K, S the sample covariance between the means, of rank K - 1: noise is
    counted once too often in directions that differ, which is safe. w = 1, or that of Hotelling's prediction
    region for one more condition, w = 2 (K - 1) / (K - 2) F(2, K - 2) / chi2(2).
    """
    count = len(posteriors)
    if count < 2:
        raise ValueError(f"a scatter between conditions needs at least two; got {count}")
    first = posteriors[0]
    for other in posteriors[1:]:
        same_poles = np.array_equal(first.poles.values, other.poles.values)
        same_unstable = np.array_equal(first.unstable.values, other.unstable.values)
        same_fields = all(getattr(first, name) == getattr(other, name) for name in _SHARED_FIELDS)
        if not (same_poles and same_unstable and same_fields):
            raise ValueError("the posteriors differ in poles, structure, sampling time or fir_length")
    if small_sample_level is not None and count < _FEWEST_CONDITIONS:
        raise ValueError(f"a small-sample region needs at least four conditions; got {count}")

    means = np.stack([posterior.mean for posterior in posteriors])
    mean = means.mean(axis=0)
    # Hotelling's prediction region over the chi-square ellipse.
    wider = 1.0
    if small_sample_level is not None:
        wider = float(hotelling_widening(count - 1, small_sample_level))
    between = (means - mean).T * np.sqrt(wider * (1 + 1 / count) / (count - 1))
    within = np.hstack([posterior.covariance_factor for posterior in posteriors]) / count
    # One triangle in place of a factor with the columns of all conditions.
    factor = np.asarray(np.linalg.qr(np.hstack([between, within]).T, mode="r")).T

    report = first.report
    if report is not None:
        reports = [posterior.report for posterior in posteriors if posterior.report]
        report = replace(
            report,
            method=f"{report.method}, {count} conditions",
            noise_std=float(np.sqrt(np.mean([each.noise_std**2 for each in reports]))),
            n_rows=sum(each.n_rows for each in reports),
        )
    return replace(first, mean=mean, covariance_factor=factor, report=report)
