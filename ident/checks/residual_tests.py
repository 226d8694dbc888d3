"""Is anything left in the residuals that a model should have explained?

Two tests on residuals of one output. `whiteness_test` asks whether they predict themselves (Ljung and Box,
Biometrika 65(2), 1978); `independence_test` whether the input still explains some of them (Soederstroem and
Stoica, System Identification, 1989, ch. 11.2, with the variance of each lag for coloured signals). Both pool
records and keep their level over all lags together. `residual_tests` runs them on what a posterior's mean
leaves of its records, `residual_advice` says what is wrong where one fails, and `fed_back` measures what
input and residual still have in common in radii of the ellipses: where a loop feeds noise back that is
noncausal, which neither test counts. Signals are taken as stationary.

A `ResponsePosterior` is the mean of a response and its ellipses at frequencies; a `Record` has an input (T,
1), an output (T, 1) and finite samples; `TEST_LEVEL` is .99 and `WHITE_LAGS` 25, both of
`ident.data.finding`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import correlate
from scipy.stats import chi2, norm

from ident.basis.autoregressive_noise import WHITE_NOISE
from ident.basis.posterior import ResponsePosterior
from ident.checks.validation import fit_on_fresh_data
from ident.data.arrays import RealArray, lock
from ident.data.finding import TEST_LEVEL, WHITE_LAGS, Finding, FindingKind, finding
from ident.data.nonparametric import empirical_frf
from ident.data.record import Record

# Frequencies at which feedback is looked for: ten a band below in the mean. Chosen; at 30 or 120 no test of
# feedback moves.
RESOLVED_FREQUENCIES = 60
# Lines to each side that are averaged for one frequency at least: eleven lines scatter by a third. Chosen.
FEWEST_LINES_BESIDE = 5
# Bands over which feedback is averaged, equally wide on a logarithmic axis from the first line to Nyquist.
# Chosen; at 3 or 12 no test of feedback moves.
FEEDBACK_BANDS = 6
# Standard deviations of chance that are taken off in each band: with six bands one in a hundred logs without
# feedback goes beyond (6 x 0.13 %). Halved, feedback is seen on a record that was opened in two stages.
SURE_DEVIATIONS = 3.0
# Keeps the logarithm of 1 - p finite where no lag is correlated at all (p = 1): rounding of doubles.
BELOW_ONE = 1 - 1e-16


@dataclass(frozen=True, eq=False)
class ResidualTest:
    """Outcome of one correlation test over K lags.

    Attributes
    ----------
    name : str
        "whiteness" or "independence".
    lags : (K,) array
        In samples; negative where the residual comes before the input.
    correlation : (K,) array
        In -1..1.
    band : (K,) array
        |correlation| stays below it with probability `level` at each lag alone if the hypothesis holds.
    level : float
        Between 0 and 1; that of both tests is .99.
    probability : float
        Of correlations as large as these, all lags together, if the hypothesis holds.
    passed : bool
        The probability is at least 1 - level.
    precedes_input : bool
        The residual is found again in a later input, as in closed loop.
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
        """Locked arrays; ValueError where they are not of one length."""
        lock(self, "lags", "correlation", "band")
        if not (self.lags.shape == self.correlation.shape == self.band.shape and self.lags.ndim == 1):
            raise ValueError("lags, correlation and band must be (K,) arrays")

    @property
    def largest(self) -> tuple[int, float]:
        """Lag (not negative, in samples) and value of the largest correlation in size; the first of equals.

        Without lags ValueError: the tests of this file have some.
        """
        size = np.where(self.lags >= 0, np.abs(self.correlation), 0)
        at = int(np.argmax(size))
        return int(self.lags[at]), float(self.correlation[at])

    @property
    def predictable_share(self) -> float:
        """Share of the residual's power that its own past over all lags predicts, 0 to 1; 0 of white noise.

        Of a whiteness test. By the Yule-Walker equations of its autocorrelation r at lags 1..K: r^T R^-1 r, R
        the Toeplitz matrix of r at lags 0..K-1. Not defined of a test of independence; LinAlgError where the
        matrix is singular, as of a residual that is one sine.
        """
        first_row = np.append(1.0, self.correlation[:-1])
        predictor = solve_toeplitz(first_row, self.correlation)
        return float(np.clip(self.correlation @ predictor, 0.0, 1.0))

    @property
    def finding(self) -> Finding:
        """The outcome as a finding WHITENESS or INDEPENDENCE, for the sentence; KeyError for another name."""
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
    """Autocorrelation of residuals at lags 1..max_lag, pooled over records, with the test of Ljung and Box.

    Parameters
    ----------
    residuals : sequence of (T,) array
        One for each record. Those of at most 2 max_lag samples are left out beside longer ones.
    max_lag : int
        In samples; the usual number of lags is that of all whiteness tests.

    Returns
    -------
    ResidualTest
        Of K = max_lag lags; it passes at 99 %.

    Raises
    ------
    ValueError
        No residual is longer than 2 max_lag, all are constant, one that counts is not finite, or max_lag is
        below 1.

    Notes
    -----
    Q = n (n + 2) sum_k r_k^2 / (n - k) is chi-square with max_lag degrees of freedom for white noise. Fitted
    parameters are not taken off the degrees of freedom.
    """
    centred = _centred(residuals, max_lag)
    n = sum(residual.size for residual in centred)
    correlation = _pooled_correlation(centred, centred, max_lag)[max_lag + 1 :]
    lags = np.arange(1, max_lag + 1)
    ljung_box = n * (n + 2) * float(np.sum(correlation**2 / (n - lags)))
    probability = float(chi2.sf(ljung_box, max_lag))
    # At a single lag the correlation of white noise is normal with variance 1 / n.
    half_width = norm.ppf(0.5 + TEST_LEVEL / 2) / np.sqrt(n)
    return ResidualTest(
        name="whiteness",
        lags=lags.astype(np.float64),
        correlation=correlation,
        band=np.full(max_lag, half_width),
        level=TEST_LEVEL,
        probability=probability,
        passed=probability >= 1 - TEST_LEVEL,
    )


def independence_test(
    inputs: Sequence[RealArray], residuals: Sequence[RealArray], *, max_lag: int = WHITE_LAGS
) -> ResidualTest:
    """Cross-correlation of input and residual at lags -max_lag..max_lag, pooled over records.

    Parameters
    ----------
    inputs, residuals : sequence of (T,) array
        One of each for every record, of equal length. Records of at most 2 max_lag samples are left out
        beside longer ones.
    max_lag : int
        In samples; at a positive lag the residual comes after the input.

    Returns
    -------
    ResidualTest
        The verdict rests on lags >= 0, the level shared over them (Sidak); negative lags show feedback.

    Raises
    ------
    ValueError
        Numbers or lengths of inputs and residuals differ, no record is longer than 2 max_lag, all signals are
        constant, one is not finite, or max_lag is below 1.

    Notes
    -----
    Variance of each lag under independence: sum_k r_e(k) r_u(k) / N, r_e and r_u the autocorrelations, so
    that colour alone does not fail.
    """
    input_sizes = [u.size for u in inputs]
    residual_sizes = [e.size for e in residuals]
    if input_sizes != residual_sizes:
        raise ValueError("need one input of equal length for every residual")
    e = _centred(residuals, max_lag)
    u = _centred(inputs, max_lag)
    n = sum(part.size for part in e)
    correlation = _pooled_correlation(e, u, max_lag)

    # Standard deviation of a lag. A Bartlett taper keeps the sum of sample correlations positive.
    # Lags up to half the shortest record: beyond, few products are averaged.
    longest = min(part.size for part in e) // 2
    memory = _pooled_correlation(e, e, longest) * _pooled_correlation(u, u, longest)
    memory_lags = np.arange(-longest, longest + 1)
    taper = 1 - np.abs(memory_lags) / (longest + 1)
    common_memory = max(float(np.sum(taper * memory)), 1.0 / n)
    deviation = np.sqrt(common_memory / n)

    # Probability 2 Phi(-x) of the largest lag alone, then that one of max_lag + 1 lags is so large:
    # 1 - (1 - p)^(max_lag + 1).
    n_tested = max_lag + 1
    deviates = np.abs(correlation[max_lag:]) / deviation
    single = 2 * norm.sf(deviates)
    least_single = min(float(single.min()), BELOW_ONE)
    probability = float(-np.expm1(n_tested * np.log1p(-least_single)))

    # Feedback: one of the max_lag negative lags is beyond what one of them reaches by chance.
    largest_before = 0.0
    if max_lag:
        largest_before = np.abs(correlation[:max_lag]).max()
    one_sided_chance = (1 - TEST_LEVEL) / (2 * max(max_lag, 1))
    limit_before = deviation * norm.ppf(1 - one_sided_chance)

    half_width = norm.ppf(0.5 + TEST_LEVEL / 2) * deviation
    return ResidualTest(
        name="independence",
        lags=np.arange(-max_lag, max_lag + 1).astype(np.float64),
        correlation=correlation,
        band=np.full(correlation.size, half_width),
        level=TEST_LEVEL,
        probability=probability,
        passed=probability >= 1 - TEST_LEVEL,
        precedes_input=bool(largest_before > limit_before),
    )


def conditions_of(advice: Iterable[Finding]) -> list[Finding]:
    """Findings that a certificate over ellipses stands or falls with, out of those about the ellipses.

    Left out where an observer's prediction errors are not white: the ellipses were widened for it. Empty
    where none of the findings is one; unknown kinds are passed over.
    """
    kinds = {
        FindingKind.NOT_WHITE,
        FindingKind.NOMINAL_OUTSIDE,
        FindingKind.UNTRIED_FRICTION,
        FindingKind.REMOTE_FRICTION,
    }
    conditions = []
    for item in advice:
        widened_for = item.values.get("observer")
        if item.kind in kinds and not widened_for:
            conditions.append(item)
    return conditions


def residual_advice(
    whiteness: ResidualTest,
    independence: ResidualTest,
    *,
    noise_order: int = 0,
    friction: bool = False,
    observer: bool = False,
) -> list[Finding]:
    """Findings on what is wrong where a test fails: NOT_INDEPENDENT, then NOT_WHITE; empty where both pass.

    Parameters
    ----------
    whiteness, independence : ResidualTest
        Outcomes, each of its own test (`residual_tests`); exchanged ones are not noticed.
    noise_order : int
        Order of the noise model behind which whiteness was tested; 0: none.
    friction : bool
        Nobody has looked for friction, and it could be identified.
    observer : bool
        Whiteness is that of an observer's prediction errors.
    """
    findings = []
    if not independence.passed:
        findings.append(finding(FindingKind.NOT_INDEPENDENT, lag=independence.largest[0]))
    if not whiteness.passed:
        findings.append(
            finding(
                FindingKind.NOT_WHITE,
                noise_order=noise_order,
                independent=independence.passed,
                friction=friction,
                observer=observer,
                predictable_share=whiteness.predictable_share,
            )
        )
    return findings


def fed_back(posterior: ResponsePosterior, records: Sequence[Record]) -> float:
    """How far feedback in the residuals would move the response at least, in radii of its ellipses.

    Parameters
    ----------
    posterior : ResponsePosterior
        Mean and ellipses of a response that was fitted to the records.
    records : sequence of Record
        Those of the posterior, one input and one output each.

    Returns
    -------
    float
        Root mean square over a band, chance taken off, of all bands the largest; 0 where nothing is sure.

    Raises
    ------
    ValueError
        Without records, where one has no rows behind the delay or another sampling time
        (`fit_on_fresh_data`), or where they are too short for a spectrum (`empirical_frf`).

    Notes
    -----
    G_r = S_eu / S_uu, e the residual, by averaged spectra. Where a loop feeds noise back, G_r is noncausal,
    of the size of what feedback moves a direct fit by. In a band, mean(|G_r|^2 - its chance) less three
    standard deviations, over the squared radius, is what is surely there. Frequencies that the records say
    nothing of are left out: where the ellipse holds zero, or the chance of G_r is larger than the response.
    """
    # Residuals of the posterior's mean, all cut to the shortest record.
    shortest = min(record.n_samples for record in records) - posterior.input_delay_samples
    of_residual = []
    for record in records:
        residual = fit_on_fresh_data(posterior, record).residual[:shortest, None]
        of_residual.append(
            replace(record.slice(0, shortest), output=residual, reference=None, reference_names=())
        )
    # There are shortest / 2 lines, and a frequency takes twice as many of them as stand on one side: so 4.
    lines_beside = max(FEWEST_LINES_BESIDE, shortest // (4 * RESOLVED_FREQUENCIES))
    common = empirical_frf(of_residual, half_width_lines=lines_beside)
    omega = common.omega_rad_s
    ellipses = posterior.at(omega)
    radius = ellipses.ellipse().semi_major
    response = np.abs(ellipses.centre)
    variance = np.trace(common.covariance, axis1=1, axis2=2)
    is_not_zero = radius < response
    is_measured = variance < response**2
    informative = is_not_zero & is_measured

    # Squares in units of the squared radius, averaged over bands.
    moved = np.abs(common.centre) ** 2 / radius**2
    chance = variance / radius**2
    edges = np.geomspace(omega[0], omega[-1], FEEDBACK_BANDS + 1)
    band = np.digitize(omega, edges[1:-1])
    surest = 0.0
    for number in np.unique(band[informative]):
        in_band = band == number
        inside = informative & in_band
        # Of independent noise squares at the lines are exponentially distributed: deviation = mean.
        deviation = np.sqrt(np.sum(chance[inside] ** 2)) / np.count_nonzero(inside)
        excess = np.mean(moved[inside] - chance[inside])
        surest = max(surest, float(excess - SURE_DEVIATIONS * deviation))
    return float(np.sqrt(surest))


def _centred(signals: Sequence[RealArray], max_lag: int) -> list[RealArray]:
    """Signals (T,) longer than 2 max_lag without their means; the shorter ones are left out.

    Raises ValueError where none is longer, max_lag is below 1, a signal is not a finite (T,) array, or all
    are constant.
    """
    long_enough = [signal for signal in signals if signal.size > 2 * max_lag]
    # Where all are short, the first of them is named below.
    signals = long_enough or signals
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
    """Correlation (2 max_lag + 1,) of signals e and u, (T,) of each record, at lags -max_lag..max_lag.

    sum_k e(k) u(k - lag) over all records, divided by the norms; samples of two records are never multiplied.
    Equal lengths above max_lag, and a power above zero, `_centred` and the callers have seen to.
    """
    total = np.zeros(2 * max_lag + 1)
    for part_e, part_u in zip(e, u, strict=True):
        at_all_lags = correlate(part_e, part_u, mode="full", method="fft")
        zero_lag = part_u.size - 1
        wanted = slice(zero_lag - max_lag, zero_lag + max_lag + 1)
        total += at_all_lags[wanted]
    power_e = sum(float(part @ part) for part in e)
    power_u = sum(float(part @ part) for part in u)
    return np.asarray(total / np.sqrt(power_e * power_u))


class Simulated(Protocol):
    """A machine with friction that simulates its records: `ident.friction.FrictionFit`."""

    @property
    def observed(self) -> bool:
        """Its residuals are the prediction errors of an observer, which are white as they are."""
        ...

    def residual(self, record: Record) -> RealArray:
        """What the simulation leaves of a record, (T - delay,) in units of the output.

        May raise ValueError for a record that is not one of its machine.
        """
        ...


def residual_tests(
    posterior: ResponsePosterior, records: Sequence[Record], friction: Simulated | None = None
) -> tuple[ResidualTest, ResidualTest]:
    """Whiteness and independence of what the posterior's own mean leaves of the records behind the ellipses.

    Parameters
    ----------
    posterior : ResponsePosterior
        Its mean is simulated; where its bounds have a noise model (`report.ar_coefficients`), whiteness is
        that of the residuals behind it, as the bounds rest on those.
    records : sequence of Record
        One input and one output each.
    friction : Simulated, optional
        Records of the shaft's position as measured are held against its simulation instead, which has the
        friction between the samples, too.

    Returns
    -------
    (ResidualTest, ResidualTest)
        Whiteness, independence.

    Raises
    ------
    ValueError
        No record is longer than 50 samples behind delay and noise model, all residuals are constant, or a
        record has another sampling time or several columns (`fit_on_fresh_data`).
    """
    # Prediction errors of an observer are white as they are.
    in_loop = friction is not None and friction.observed
    noise = WHITE_NOISE if posterior.report is None or in_loop else posterior.report.noise
    residuals = []
    for record in records:
        if friction is None:
            residuals.append(fit_on_fresh_data(posterior, record).residual)
        else:
            residuals.append(friction.residual(record))
    whitened = [noise.without_start(residual) for residual in residuals]
    delay = posterior.input_delay_samples
    inputs = [record.input[: record.n_samples - delay, 0] for record in records]
    return whiteness_test(whitened), independence_test(inputs, residuals)
