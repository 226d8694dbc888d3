"""Does the model hold on other data?

Two answers. `fit_on_fresh_data` simulates a record that the model was not fitted to, from its input alone,
and says how much of the motion is explained; `fit_in_windows` does the same window by window, for arms that
drift. `repeat_scatter` holds the noise ellipses of repeated experiments against the scatter between the
repeats, band by band, with the range that chance allows (a chi-square with the degrees of freedom of
Satterthwaite, Biometrics Bulletin 2(6), 1946). Records have one output. What a record has before its first
row is unknown: the free response of the model's poles is fitted to it, and not counted as an error.

A `Record` has an input (T, U), an output (T, Y) and finite samples; `FrequencyUncertainty` a response at
frequencies (centre (F,), covariance (F, 2, 2) of real and imaginary part); a model its poles, dt_s and delay
in samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2

from ident.basis.functions import basis_state_space, nuisance_columns
from ident.basis.model import GobfModel, MisoModel
from ident.basis.posterior import ResponsePosterior
from ident.basis.structure import answered, level_before, stabilised
from ident.data.arrays import BoolArray, RealArray, lock, real_rows
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record import Record

# Windows into which a log of an arm that drifts is cut at most. Chosen: with 8 the drift of an arm within a
# window is too large in its test, with 32 nothing moves.
MOST_WINDOWS = 16
# Samples of a window for each unknown of its start (poles and a constant) at least: the start then takes up a
# twentieth of the noise.
SAMPLES_PER_UNKNOWN = 20
# Free responses weaker than this share of the strongest are left out of the fit of a start: poles that lie
# together have nearly equal ones. Chosen: far above the rounding of doubles, far below what a record tells.
SAME_RESPONSE = 1e-10
# Quantiles between which an honest ratio of standard deviations lies in 95 % of experiments, the usual share.
LOW_QUANTILE = 0.025

# The upper one of the two: as many experiments lie above it as below the lower one.
HIGH_QUANTILE = 0.975


@dataclass(frozen=True, eq=False)
class FreshFit:
    """Free run of a model on a record that it was not fitted to.

    Attributes
    ----------
    name : str
        Of the record.
    fit_percent : float
        100 (1 - |y - y_hat| / |y - mean y|): 100 where everything is explained, 0 of a constant.
    simulated, residual : (T - delay,) array
        In output units, in the rows that answer to the record's input.
    answers : bool
        The free run is nearer to the record than a response of zero.
    """

    name: str
    fit_percent: float
    simulated: RealArray
    residual: RealArray
    answers: bool = True

    def __post_init__(self) -> None:
        """Locked arrays; their shapes are not checked."""
        lock(self, "simulated", "residual")


def fit_on_fresh_data(model: GobfModel | MisoModel | ResponsePosterior, record: Record) -> FreshFit:
    """Free-run simulation of a record, no output fed back, with how much of the motion it explains.

    Parameters
    ----------
    model : GobfModel, MisoModel or ResponsePosterior
        Of one output; a posterior is simulated with its mean.
    record : Record
        One output, and the model's inputs.

    Returns
    -------
    FreshFit
        Rows behind the input delay.

    Raises
    ------
    ValueError
        The record has another sampling time, other inputs than the model, several outputs, a constant one, or
        no rows behind the input delay.

    Notes
    -----
    The free response of poles and integrators at the start, and a constant, are fitted to the record by least
    squares. Of an unstable model the free run is that of B G to B y (`ident.basis.structure.stabilised`), and
    `simulated` is what it predicts from sample to sample.
    """
    n_inputs = model.n_inputs if isinstance(model, MisoModel) else 1
    record.refuse_several(model.dt_s, n_inputs)
    unstable = model.unstable
    delay = model.input_delay_samples
    try:
        measured = answered(record.output[:, 0], delay)
    except ValueError as error:
        raise ValueError(f"{record.label}: {error}") from None
    spread = float(np.linalg.norm(measured - measured.mean()))
    if spread == 0:
        raise ValueError(f"{record.label}: the output is constant")
    y = answered(stabilised(record.output[:, 0], unstable), delay)

    # Response to the input from rest. An integrator would turn a level before the record into a ramp, which
    # is its own free response anyway; other poles are taken to rest at the level that the input comes from.
    u = record.input
    if not model.integrators:
        u = record.input - [level_before(column) for column in record.input.T]
    if isinstance(model, MisoModel):
        from_rest = answered(model.simulate(u), delay)
    else:
        from_rest = answered(model.stable_part.simulate(u[:, 0]), delay)

    # Response to the unknown start: beside the simulation, and alone as if the input did nothing.
    n_polynomials = max(1, model.integrators)
    nuisance = nuisance_columns(model.poles, y.size, n_polynomials, True)
    targets = np.column_stack([y - from_rest, y])
    coefficients, *_ = np.linalg.lstsq(nuisance, targets, rcond=SAME_RESPONSE)
    simulated = from_rest + nuisance @ coefficients[:, 0]
    residual = y - simulated
    residual_without_input = y - nuisance @ coefficients[:, 1]
    residual_norm = float(np.linalg.norm(residual))
    answers = residual_norm < float(np.linalg.norm(residual_without_input))

    if unstable.order:
        # B over its direct term answers to y with y itself and what it was before: a prediction's error.
        direct = float(basis_state_space(unstable).D[0, 0])
        residual = residual / direct
        residual_norm = residual_norm / abs(direct)
        simulated = measured - residual
    fit_percent = 100 * (1 - residual_norm / spread)
    return FreshFit(record.name, fit_percent, simulated, residual, answers)


def fit_in_windows(model: GobfModel | MisoModel | ResponsePosterior, record: Record) -> FreshFit:
    """Free run over windows of a record one after the other, each from its own start: for arms that drift.

    Parameters
    ----------
    model : GobfModel, MisoModel or ResponsePosterior
        Of one output; a posterior is simulated with its mean.
    record : Record
        One output, and the model's inputs, of its sampling time.

    Returns
    -------
    FreshFit
        Spread and residual are those of the windows together; a window in which the output stands still
        counts as simulated. `answers`: it does in more than half of the windows.

    Raises
    ------
    ValueError
        The record has another sampling time, other inputs, several outputs (where a window moves), no rows
        behind the delay, or an output that is constant in every window.

    Notes
    -----
    Sixteen windows, fewer where they would have less than 20 samples for each unknown of their start.
    """
    delay = model.input_delay_samples
    shortest = SAMPLES_PER_UNKNOWN * (model.poles.order + 1)
    n_windows = min(MOST_WINDOWS, max(1, (record.n_samples - delay) // max(shortest, 1)))
    edges = np.linspace(delay, record.n_samples, n_windows + 1).astype(int)
    fits = []
    squared_spread = 0.0
    for low, high in pairwise(edges.tolist()):
        # Inputs act after the delay, so a window takes that many rows before its first output.
        window = record.slice(low - delay, high)
        y = window.output[delay:, 0]
        if np.ptp(y) > 0:
            fits.append(fit_on_fresh_data(model, window))
            squared_spread += float(np.sum((y - y.mean()) ** 2))
        else:
            fits.append(FreshFit(record.name, 100.0, y, np.zeros_like(y)))
    if not squared_spread > 0:
        raise ValueError(f"{record.label}: the output is constant")
    residual = np.concatenate([fit.residual for fit in fits])
    n_answers = sum(fit.answers for fit in fits)
    return FreshFit(
        name=record.name,
        fit_percent=100 * (1 - float(np.linalg.norm(residual)) / np.sqrt(squared_spread)),
        simulated=np.concatenate([fit.simulated for fit in fits]),
        residual=residual,
        answers=n_answers > len(fits) / 2,
    )


@dataclass(frozen=True)
class ScatterRow:
    """One band of `repeat_scatter`; sizes are RMS over the band, one standard deviation, relative to |G|.

    Attributes
    ----------
    omega_low_rad_s, omega_high_rad_s : float
        Ends of the band.
    predicted : float
        Deviation of one repeat by its covariance.
    measured : float
        Scatter of the repeats around their mean, unbiased.
    ratio : float
        measured / predicted.
    between : float
        RMS deviation of the groups' means, unbiased; NaN with one group.
    between_ratio : float
        `between` over what noise alone would give; NaN with one group.
    degrees_of_freedom : float
        Of the chi-square that the squared ratio follows if the prediction is honest.
    ratio_low, ratio_high : float
        Range of the ratio in 95 % of experiments if the prediction is honest.
    """

    omega_low_rad_s: float
    omega_high_rad_s: float
    predicted: float
    measured: float
    ratio: float
    between: float
    between_ratio: float
    degrees_of_freedom: float = float("nan")
    ratio_low: float = float("nan")
    ratio_high: float = float("nan")


def repeat_scatter(
    groups: Sequence[Sequence[FrequencyUncertainty]],
    bands_rad_s: Sequence[tuple[float, float]],
    *,
    posterior: ResponsePosterior | None = None,
) -> list[ScatterRow]:
    """Predicted noise ellipses against the scatter between repeats, band by band.

    Parameters
    ----------
    groups : sequence of sequence of FrequencyUncertainty
        For each condition, such as an amplitude or a day, the estimate of each repeat: centre (F,) and
        covariance (F, 2, 2), all on one grid.
    bands_rad_s : sequence of (low, high)
        Bands without a grid frequency are left out; `high` belongs to the next band.
    posterior : ResponsePosterior, optional
        Of any repeat: how errors of neighbouring frequencies move together. Without it they count as
        independent.

    Returns
    -------
    list of ScatterRow
        In the order of the bands; empty where no band has a frequency.

    Raises
    ------
    ValueError
        There is no group, one has fewer than two repeats, or the grids differ. That the posterior is of the
        same sampling time is not checked; where the mean response is zero sizes are infinite or nan.
    """
    estimates = [estimate for group in groups for estimate in group]
    if not estimates or any(len(group) < 2 for group in groups):
        raise ValueError("every group needs at least two repeats")
    omega = estimates[0].omega_rad_s
    if any(not np.array_equal(estimate.omega_rad_s, omega) for estimate in estimates):
        raise ValueError("the estimates are on different frequency grids")
    n_groups = len(groups)
    # Each group's mean takes one degree of freedom of its repeats.
    n_free_repeats = len(estimates) - n_groups

    # Variances (F,) relative to |G|^2: as predicted, and around the mean of each group.
    means = np.stack([np.mean([estimate.centre for estimate in group], axis=0) for group in groups])
    size = np.abs(means.mean(axis=0))
    predicted = np.mean([_variance(estimate) for estimate in estimates], axis=0) / size**2
    scatter = np.zeros(omega.size)
    for group, mean in zip(groups, means, strict=True):
        scatter += np.sum([np.abs(estimate.centre - mean) ** 2 for estimate in group], axis=0)
    measured = scatter / n_free_repeats / size**2

    # Variance between the groups' means, and what noise of the repeats alone makes of it.
    if n_groups > 1:
        squared_deviation = np.sum(np.abs(means - means.mean(axis=0)) ** 2, axis=0)
        between = squared_deviation / (n_groups - 1) / size**2
        noise_of_means = []
        for group in groups:
            noise = np.mean([_variance(estimate) for estimate in group], axis=0)
            noise_of_means.append(noise / len(group))
        between_by_noise = np.mean(noise_of_means, axis=0) / size**2
    else:
        between = np.full(omega.size, np.nan)
        between_by_noise = between

    rows = []
    for low, high in bands_rad_s:
        inside = (omega >= low) & (omega < high)
        if not np.any(inside):
            continue
        predicted_rms = _rms(predicted[inside])
        measured_rms = _rms(measured[inside])
        between_rms = _rms(between[inside])
        between_by_noise_rms = _rms(between_by_noise[inside])

        # Degrees of freedom of |e|^2 for errors e ~ N(0, M M^T) of one repeat: tr(K)^2 / tr(K^2), K = M M^T
        # or M^T M, whichever is smaller.
        factor = _relative_spread(estimates[0], posterior, inside, size)
        flat = factor.T if factor.shape[1] < factor.shape[0] else factor
        inner = flat @ flat.T
        square = max(float(np.sum(inner**2)), np.finfo(float).tiny)
        independent = float(np.trace(inner)) ** 2 / square
        freedom = independent * n_free_repeats
        ratio_low = float("nan")
        ratio_high = float("nan")
        if freedom > 0:
            interval = np.sqrt(chi2.ppf([LOW_QUANTILE, HIGH_QUANTILE], freedom) / freedom)
            ratio_low = float(interval[0])
            ratio_high = float(interval[1])
        rows.append(
            ScatterRow(
                omega_low_rad_s=float(low),
                omega_high_rad_s=float(high),
                predicted=predicted_rms,
                measured=measured_rms,
                ratio=_ratio(measured_rms, predicted_rms),
                between=between_rms,
                between_ratio=_ratio(between_rms, between_by_noise_rms),
                degrees_of_freedom=freedom,
                ratio_low=ratio_low,
                ratio_high=ratio_high,
            )
        )
    return rows


def _relative_spread(
    estimate: FrequencyUncertainty,
    posterior: ResponsePosterior | None,
    inside: BoolArray,
    size: RealArray,
) -> RealArray:
    """Factor M (2 B, K) of the covariance M M^T of the relative errors (Re, Im) at the B frequencies of a
    band.

    inside (F,): the frequencies of the band; size (F,): |G|. By the posterior, errors of neighbouring
    frequencies move together; without it M is a diagonal of blocks (2, 2), one for each frequency. B is at
    least 1; a variance below zero counts as zero.
    """
    if posterior is not None:
        spread = posterior.frequency_rows(estimate.omega_rad_s[inside]) @ posterior.covariance_factor
        return real_rows(spread / size[inside, np.newaxis])
    relative = estimate.covariance[inside] / size[inside, None, None] ** 2
    values, vectors = np.linalg.eigh(relative)
    roots = np.sqrt(np.maximum(values, 0.0))
    blocks = vectors * roots[:, None, :]
    return np.asarray(block_diag(*blocks))


def _variance(estimate: FrequencyUncertainty) -> RealArray:
    """Variance E|G_hat - G|^2 (F,) of an estimate, in its units squared: the trace of its covariance (F, 2,
    2)."""
    return np.asarray(estimate.covariance[:, 0, 0] + estimate.covariance[:, 1, 1])


def _rms(squares: RealArray) -> float:
    """Root of the mean of squares (B,), in their unit; nan without any, or where one is nan."""
    return float(np.sqrt(np.mean(squares)))


def _ratio(measured: float, predicted: float) -> float:
    """measured / predicted; infinite where only the prediction is zero, NaN where both are or one is NaN."""
    if predicted > 0:
        return measured / predicted
    if measured > 0:
        return float("inf")
    return float("nan")
