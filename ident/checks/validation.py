"""Does the model hold on other data? Fit on fresh records, repeat scatter."""

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

# Windows of a log of an arm that drifts, and samples per unknown of its start at least.
_WINDOWS, _SHORTEST = 16, 20


@dataclass(frozen=True, eq=False)
class FreshFit:
    """Free run on a record the model was not fitted to.

    fit_percent = 100 (1 - |y - y_hat| / |y - mean y|); simulated and residual (T - delay,) in output units,
    in the rows that answer to the record's input. answers: nearer to the record than a response of zero.
    """

    name: str
    fit_percent: float
    simulated: RealArray
    residual: RealArray
    answers: bool = True

    def __post_init__(self) -> None:
        lock(self, "simulated", "residual")


def fit_on_fresh_data(model: GobfModel | MisoModel | ResponsePosterior, record: Record) -> FreshFit:
    """Free-run simulation of a record of one output, no output fed back.

    The free response of poles and integrators at the start, and a constant, are fitted to the record. Of an
    unstable model the free run is that of B G to B y (`ident.basis.structure.stabilised`), and simulated what
    it predicts from sample to sample. Raises ValueError for another sampling time, other inputs than the
    model's, several outputs, or a constant one.
    """
    record.refuse_several(model.dt_s, model.n_inputs if isinstance(model, MisoModel) else 1)
    unstable, delay = model.unstable, model.input_delay_samples
    try:
        measured = answered(record.output[:, 0], delay)
    except ValueError as error:
        raise ValueError(f"{record.label}: {error}") from None
    y = answered(stabilised(record.output[:, 0], unstable), delay)
    spread = float(np.linalg.norm(measured - measured.mean()))
    if spread == 0:
        raise ValueError(f"{record.label}: the output is constant")
    u = record.input if model.integrators else record.input - list(map(level_before, record.input.T))
    simulated = model.simulate(u) if isinstance(model, MisoModel) else model.stable_part.simulate(u[:, 0])
    simulated = answered(simulated, delay)
    nuisance = nuisance_columns(model.poles, y.size, max(1, model.integrators), True)
    coefficients, *_ = np.linalg.lstsq(nuisance, np.column_stack([y - simulated, y]), rcond=1e-10)
    simulated, without = simulated + nuisance @ coefficients[:, 0], y - nuisance @ coefficients[:, 1]
    residual = y - simulated
    left = float(np.linalg.norm(residual))
    answers = left < float(np.linalg.norm(without))
    if unstable.order:
        # B over its direct term answers to y with y itself and what it was before: a prediction's error.
        direct = float(basis_state_space(unstable).D[0, 0])
        residual, left = residual / direct, left / abs(direct)
        simulated = measured - residual
    return FreshFit(record.name, 100 * (1 - left / spread), simulated, residual, answers)


def fit_in_windows(model: GobfModel | MisoModel | ResponsePosterior, record: Record) -> FreshFit:
    """`fit_on_fresh_data` over windows one after the other, each from its own start: for arms that drift.
    Spread and residual are those of the windows; one in which the output stands still counts as simulated."""
    delay, shortest = model.input_delay_samples, _SHORTEST * (model.poles.order + 1)
    count = min(_WINDOWS, max(1, (record.n_samples - delay) // max(shortest, 1)))
    edges = np.linspace(delay, record.n_samples, count + 1).astype(int)
    fits, spread = [], 0.0
    for low, high in pairwise(edges.tolist()):
        part = record.slice(low - delay, high)
        y = part.output[delay:, 0]
        if np.ptp(y) > 0:
            fits.append(fit_on_fresh_data(model, part))
            spread += float(np.sum((y - y.mean()) ** 2))
        else:
            fits.append(FreshFit(record.name, 100.0, y, np.zeros_like(y)))
    if not spread > 0:
        raise ValueError(f"{record.label}: the output is constant")
    left = np.concatenate([fit.residual for fit in fits])
    return FreshFit(
        record.name,
        100 * (1 - float(np.linalg.norm(left)) / np.sqrt(spread)),
        np.concatenate([fit.simulated for fit in fits]),
        left,
        sum(fit.answers for fit in fits) > len(fits) / 2,
    )


@dataclass(frozen=True)
class ScatterRow:
    """One band of `repeat_scatter`; radii are RMS over the band, one standard deviation, relative to |G|.

    predicted: of one repeat by its covariance; measured: scatter of the repeats around their mean, unbiased;
    ratio = measured / predicted, between ratio_low and ratio_high in 95 % of experiments if the prediction is
    honest (chi-square with degrees_of_freedom). between: RMS deviation of the groups' means, unbiased;
    between_ratio: over what noise alone would give; both NaN with one group.
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

    groups: one sequence per condition with the estimate of each repeat, all on one grid. posterior (of any
    repeat) tells how errors of neighbouring frequencies move together; without it they count as independent.
    Bands without a grid frequency are left out. Raises ValueError for fewer than two repeats, or grids that
    differ.
    """
    everything = [estimate for group in groups for estimate in group]
    if not everything or any(len(group) < 2 for group in groups):
        raise ValueError("every group needs at least two repeats")
    omega = everything[0].omega_rad_s
    if any(not np.array_equal(estimate.omega_rad_s, omega) for estimate in everything):
        raise ValueError("the estimates are on different frequency grids")
    means = np.stack([np.mean([estimate.centre for estimate in group], axis=0) for group in groups])
    size = np.abs(means.mean(axis=0))
    predicted = np.mean([_variance(estimate) for estimate in everything], axis=0) / size**2
    scatter = np.zeros(omega.size)
    for group, mean in zip(groups, means, strict=True):
        scatter += np.sum([np.abs(estimate.centre - mean) ** 2 for estimate in group], axis=0)
    measured = scatter / (len(everything) - len(groups)) / size**2
    if len(groups) > 1:
        between = np.sum(np.abs(means - means.mean(axis=0)) ** 2, axis=0) / (len(groups) - 1) / size**2
        noise = [
            np.mean([_variance(estimate) for estimate in group], axis=0) / len(group) for group in groups
        ]
        between_noise = np.mean(noise, axis=0) / size**2
    else:
        between = between_noise = np.full(omega.size, np.nan)
    rows = []
    for low, high in bands_rad_s:
        inside = (omega >= low) & (omega < high)
        if not np.any(inside):
            continue
        p, m, b, bn = (
            float(np.sqrt(np.mean(part[inside]))) for part in (predicted, measured, between, between_noise)
        )
        relative = _relative_spread(everything[0], posterior, inside, size)
        # Satterthwaite's of |e|^2 for e ~ N(0, M M^T): tr(K)^2 / tr(K^2), K = M M^T.
        wide = relative.shape[1] < relative.shape[0]
        inner = relative.T @ relative if wide else relative @ relative.T
        independent = float(np.trace(inner)) ** 2 / max(float(np.sum(inner**2)), np.finfo(float).tiny)
        freedom = independent * (len(everything) - len(groups))
        interval = np.sqrt(chi2.ppf([0.025, 0.975], freedom) / freedom) if freedom > 0 else [np.nan, np.nan]
        rows.append(
            ScatterRow(
                float(low),
                float(high),
                p,
                m,
                _ratio(m, p),
                b,
                _ratio(b, bn),
                freedom,
                float(interval[0]),
                float(interval[1]),
            )
        )
    return rows


def _relative_spread(
    estimate: FrequencyUncertainty,
    posterior: ResponsePosterior | None,
    inside: BoolArray,
    size: RealArray,
) -> RealArray:
    """Factor M (2 F, K) of the covariance M M^T of the relative errors (Re, Im) of a band."""
    if posterior is not None:
        spread = posterior.frequency_rows(estimate.omega_rad_s[inside]) @ posterior.covariance_factor
        return real_rows(spread / size[inside, np.newaxis])
    values, vectors = np.linalg.eigh(estimate.covariance[inside] / size[inside, None, None] ** 2)
    return np.asarray(block_diag(*(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])))


def _variance(estimate: FrequencyUncertainty) -> RealArray:
    return np.asarray(estimate.covariance[:, 0, 0] + estimate.covariance[:, 1, 1])


def _ratio(measured: float, predicted: float) -> float:
    return measured / predicted if predicted > 0 else float("inf") if measured > 0 else float("nan")
