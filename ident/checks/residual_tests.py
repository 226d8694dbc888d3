"""Is anything left in the residuals? Whiteness and independence from the input, with bands."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import correlate, lfilter
from scipy.stats import chi2, norm

from ident.basis.posterior import ResponsePosterior
from ident.checks.validation import fit_on_fresh_data
from ident.data.arrays import RealArray, lock
from ident.data.finding import TEST_LEVEL, WHITE_LAGS, Finding, FindingKind, finding
from ident.data.nonparametric import empirical_frf
from ident.data.record import Record

# Frequencies at which feedback is looked for, and bands over which it is averaged.
_RESOLVED, _BANDS = 60, 6
# Standard deviations of chance that are taken off: with six bands, one in a hundred logs goes beyond.
_SURE = 3.0


@dataclass(frozen=True, eq=False)
class ResidualTest:
    """One correlation test.

    lags (K,) in samples, correlation (K,) in -1..1; band (K,): |correlation| stays below it with probability
    `level` at each lag alone if the hypothesis holds. probability: of correlations as large as these, all
    lags together; passed: it is at least 1 - level. precedes_input: the residual is found again in a later
    input, as in closed loop.
    """

    name: str
    lags: RealArray
    correlation: RealArray
    band: RealArray
    level: float
    probability: float
    passed: bool
    precedes_input: bool = False

    def __post_init__(self) -> None:
        lock(self, "lags", "correlation", "band")
        if not (self.lags.shape == self.correlation.shape == self.band.shape and self.lags.ndim == 1):
            raise ValueError("lags, correlation and band must be (K,) arrays")

    @property
    def largest(self) -> tuple[int, float]:
        """Lag (not negative) and value of the largest correlation."""
        at = int(np.argmax(np.where(self.lags >= 0, np.abs(self.correlation), 0)))
        return int(self.lags[at]), float(self.correlation[at])

    @property
    def predictable_share(self) -> float:
        """Of the residual's power, what its own past over all lags predicts (Yule-Walker), by the
        autocorrelation at lags 1..K of a whiteness test: 0 of white noise."""
        first_row = np.append(1.0, self.correlation[:-1])
        return float(np.clip(self.correlation @ solve_toeplitz(first_row, self.correlation), 0.0, 1.0))

    @property
    def finding(self) -> Finding:
        lag, correlation = self.largest
        return finding(
            FindingKind[self.name.upper()],
            passed=self.passed,
            probability=self.probability,
            max_lag=int(self.lags[-1]),
            lag=lag,
            correlation=correlation,
            precedes_input=self.precedes_input,
        )


def whiteness_test(residuals: Sequence[RealArray], *, max_lag: int = WHITE_LAGS) -> ResidualTest:
    """Autocorrelation of residuals, one (T,) array per record, at lags 1..max_lag, pooled; Ljung-Box over all
    lags.

    Fitted parameters are not taken off the degrees of freedom. Records of at most 2 max_lag samples are left
    out. Raises ValueError when none is longer, or the residuals are zero.
    """
    centred = _centred(residuals, max_lag)
    n = sum(e.size for e in centred)
    correlation = _pooled_correlation(centred, centred, max_lag)[max_lag + 1 :]
    lags = np.arange(1, max_lag + 1)
    probability = float(chi2.sf(n * (n + 2) * float(np.sum(correlation**2 / (n - lags))), max_lag))
    passed = probability >= 1 - TEST_LEVEL
    band = np.full(max_lag, norm.ppf(0.5 + TEST_LEVEL / 2) / np.sqrt(n))
    return ResidualTest(
        "whiteness", lags.astype(np.float64), correlation, band, TEST_LEVEL, probability, passed
    )


def independence_test(
    inputs: Sequence[RealArray], residuals: Sequence[RealArray], *, max_lag: int = WHITE_LAGS
) -> ResidualTest:
    """Cross-correlation of past input and residual at lags -max_lag..max_lag (residual after input: lag > 0).

    Variance of each lag under independence: sum_k r_e(k) r_u(k) / N, so that colour alone does not fail.
    Records of at most 2 max_lag samples are left out. The verdict rests on lags >= 0, the level shared over
    them (Sidak); negative lags show feedback.
    """
    if len(inputs) != len(residuals) or any(
        u.size != e.size for u, e in zip(inputs, residuals, strict=False)
    ):
        raise ValueError("need one input of equal length for every residual")
    e = _centred(residuals, max_lag)
    u = _centred(inputs, max_lag)
    n = sum(part.size for part in e)
    correlation = _pooled_correlation(e, u, max_lag)
    longest = min(part.size for part in e) // 2
    memory = _pooled_correlation(e, e, longest) * _pooled_correlation(u, u, longest)
    # Bartlett taper keeps the sum of sample correlations positive.
    taper = 1 - np.abs(np.arange(-longest, longest + 1)) / (longest + 1)
    deviation = np.sqrt(max(float(np.sum(taper * memory)), 1.0 / n) / n)
    # 2 Phi(-x), all of max_lag + 1 lags below x with probability (1 - that)^(max_lag + 1).
    single = 2 * norm.sf(np.abs(correlation[max_lag:]) / deviation)
    probability = float(-np.expm1((max_lag + 1) * np.log1p(-min(float(single.min()), 1 - 1e-16))))
    passed = probability >= 1 - TEST_LEVEL
    band = np.full(correlation.size, norm.ppf(0.5 + TEST_LEVEL / 2) * deviation)
    lags = np.arange(-max_lag, max_lag + 1)
    before = np.abs(correlation[:max_lag]).max() if max_lag else 0.0
    precedes = bool(before > deviation * norm.ppf(1 - (1 - TEST_LEVEL) / (2 * max(max_lag, 1))))
    return ResidualTest(
        "independence", lags.astype(np.float64), correlation, band, TEST_LEVEL, probability, passed, precedes
    )


def conditions_of(advice: Iterable[Finding]) -> list[Finding]:
    """What a certificate over ellipses stands or falls with, of the findings about these. Where an observer's
    prediction errors are not white, the ellipses were widened for it."""
    kinds = {FindingKind.NOT_WHITE, FindingKind.NOMINAL_OUTSIDE, FindingKind.UNTRIED_FRICTION}
    return [each for each in advice if each.kind in kinds and not each.values.get("observer")]


def residual_advice(
    whiteness: ResidualTest,
    independence: ResidualTest,
    *,
    noise_order: int = 0,
    friction: bool = False,
    observer: bool = False,
) -> list[Finding]:
    """What is wrong where a test fails. noise_order: of the noise model behind which whiteness was tested.
    friction: nobody has looked for it, and it could be identified. observer: whiteness is that of its
    prediction errors."""
    found = []
    if not independence.passed:
        found.append(finding(FindingKind.NOT_INDEPENDENT, lag=independence.largest[0]))
    if not whiteness.passed:
        told = {"noise_order": noise_order, "independent": independence.passed, "friction": friction}
        share = whiteness.predictable_share
        found.append(finding(FindingKind.NOT_WHITE, **told, observer=observer, predictable_share=share))
    return found


def fed_back(posterior: ResponsePosterior, records: Sequence[Record]) -> float:
    """How far what the residuals still have in common with the input would move the response at least, in
    radii of its ellipses: root mean square over a band, chance taken off, of all bands the largest.

    records: those of the posterior, one input and one output. Where a loop feeds noise back, that part is
    noncausal, of the size of what feedback moves a direct fit by. Bands that the records say nothing of are
    left out.
    """
    shortest = min(record.n_samples for record in records) - posterior.input_delay_samples
    rest = [
        replace(
            record.slice(0, shortest),
            output=fit_on_fresh_data(posterior, record).residual[:shortest, None],
            reference=None,
            reference_names=(),
        )
        for record in records
    ]
    common = empirical_frf(rest, half_width_lines=max(5, shortest // (4 * _RESOLVED)))
    omega = common.omega_rad_s
    ellipses = posterior.at(omega)
    radius = ellipses.ellipse().semi_major
    chance = np.trace(common.covariance, axis1=1, axis2=2)
    told = (radius < np.abs(ellipses.centre)) & (chance < np.abs(ellipses.centre) ** 2)
    band = np.digitize(omega, np.geomspace(omega[0], omega[-1], _BANDS + 1)[1:-1])
    moved, chance = np.abs(common.centre) ** 2 / radius**2, chance / radius**2
    surest = 0.0
    for k in np.unique(band[told]):
        among = told & (band == k)
        # Of independent noise squares at the lines are exponentially distributed.
        deviation = np.sqrt(np.sum(chance[among] ** 2)) / np.count_nonzero(among)
        surest = max(surest, float(np.mean(moved[among] - chance[among]) - _SURE * deviation))
    return float(np.sqrt(surest))


def _centred(signals: Sequence[RealArray], max_lag: int) -> list[RealArray]:
    """The signals longer than 2 max_lag without their means; ValueError where none is."""
    signals = [signal for signal in signals if signal.size > 2 * max_lag] or signals
    if not signals:
        raise ValueError("need at least one record")
    if not max_lag >= 1:
        raise ValueError(f"max_lag must be at least 1; got {max_lag}")
    for signal in signals:
        if signal.ndim != 1 or signal.size <= 2 * max_lag or not np.all(np.isfinite(signal)):
            raise ValueError(
                f"residual tests over {max_lag} lags need finite (T,) signals with T > {2 * max_lag}; "
                f"got shape {signal.shape}"
            )
    centred = [np.asarray(signal - signal.mean(), dtype=np.float64) for signal in signals]
    if not any(np.any(signal) for signal in centred):
        raise ValueError("the signals are constant: there is nothing to correlate")
    return centred


def _pooled_correlation(e: Sequence[RealArray], u: Sequence[RealArray], max_lag: int) -> RealArray:
    """sum_k e(k) u(k - lag) over all records, lag = -max_lag..max_lag, divided by the norms."""
    total = np.zeros(2 * max_lag + 1)
    for a, b in zip(e, u, strict=True):
        middle = b.size - 1
        total += correlate(a, b, mode="full", method="fft")[middle - max_lag : middle + max_lag + 1]
    return np.asarray(total / np.sqrt(sum(float(a @ a) for a in e) * sum(float(b @ b) for b in u)))


class Simulated(Protocol):
    """A machine that simulates its records: `ident.friction.FrictionFit`."""

    @property
    def observed(self) -> bool: ...

    def residual(self, record: Record) -> RealArray: ...


def residual_tests(
    posterior: ResponsePosterior, records: Sequence[Record], friction: Simulated | None = None
) -> tuple[ResidualTest, ResidualTest]:
    """Whiteness and independence of what the posterior's own mean leaves of the records behind the ellipses.

    friction: records of the shaft's position as measured are held against its simulation instead, which has
    the friction between the samples, too. Where the bounds have a noise model, whiteness is that of the
    residuals behind it: they rest on those.
    """
    # Prediction errors of an observer are white as they are.
    in_loop = friction is not None and friction.observed
    colour = () if posterior.report is None or in_loop else posterior.report.ar_coefficients
    filter_of_noise = np.array([1.0, *colour])
    residuals = [
        fit_on_fresh_data(posterior, record).residual if friction is None else friction.residual(record)
        for record in records
    ]
    whitened = [lfilter(filter_of_noise, np.ones(1), residual)[len(colour) :] for residual in residuals]
    delay = posterior.input_delay_samples
    inputs = [record.input[: record.n_samples - delay, 0] for record in records]
    return whiteness_test(whitened), independence_test(inputs, residuals)
