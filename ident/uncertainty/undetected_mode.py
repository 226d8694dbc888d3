"""One flexible mode that the pole search may have missed, averaged over.

Every pair of a grid over frequency and damping is a hypothesis "the poles, and this pair" (Bayesian model
averaging: Hoeting et al., Statistical Science 14(4), 1999). Its two amplitudes get a Gaussian prior of a size
that runs over a grid, so that its restricted likelihood is comparable with those of the kernel in
`embedding_algebra`. A pair stands behind the all-pass of the model's poles, orthogonal to everything that
they can express. `candidate_pairs` makes the grid, `pair_statistics` passes over the records once,
`pair_mixture` weighs the pairs, and `with_pairs` adds the likely ones to the posterior.

Neglected: two missed modes at once, a missed mode together with a kernel, the missed mode's own initial
state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numba
import numpy as np
from scipy.linalg import solve_triangular

from ident.basis.functions import basis_response, block_parameters
from ident.basis.poles import Poles
from ident.data.arrays import COMPILED, BoolArray, ComplexArray, RealArray, kernel_array, readonly
from ident.uncertainty.embedding_algebra import (
    KernelPosterior,
    ReducedRegression,
    nuisance_basis,
    remainder_energies,
    symmetric_factor,
)
from ident.uncertainty.embedding_rows import RecordRows

# "Measured" below: on twenty simulated arms of 1200 samples, half of them with a mode left out.

# Damping ratios of the grid, those of lightly damped structures. A mode half way between two (in ratio), or
# at .005, loses a tenth of its energy to the nearest. Measured: a third one between them changes neither the
# median ellipse nor coverage by .1 %; both doubled, coverage rises by .4 % and ellipses by .2 %.
_ZETA = (0.01, 0.03)
# Time constants by which a candidate decays over the record, at least; see `candidate_pairs`. Measured:
# halved or doubled, the median ellipse stays to .1 % and coverage to .3 %.
_DECAY = 2.0
# Periods that the slowest candidate makes in the longest record. The damping that `_DECAY` asks for is then
# still light: 2 / (2 pi 6) = 0.053.
_FEWEST_PERIODS = 6.0
# Highest frequency of a candidate, rad/sample: 0.9 of Nyquist's. Measured: at .8 or .99 of it, the median
# ellipse stays to .1 % and coverage to .1 %.
_HIGHEST = 0.9 * np.pi
# Half bandwidths between neighbours in frequency: a mode half way loses a tenth of its energy to the nearest.
# Measured: doubled, coverage of arms with a mode left out falls by .9 %; halved, nothing is gained.
_SPACING = 1.5
# Probability of a missed mode around a frequency from which on its pairs are kept. Measured: half of it keeps
# improbable pairs, which widen single ellipses up to 2.6 times for .2 % of coverage.
_LEAST_PROBABILITY = 0.05
# Probability of a pair from which on it is kept: the some hundred pairs left out are together less likely
# than `_LEAST_PROBABILITY`. Measured: halved or ten times as large, no ellipse moves by 1 %.
_NEGLIGIBLE = 1e-4
# Pairs that are kept at most: 24 columns of the posterior beside the 150 of its kernel. Measured: with 24 the
# median ellipse stays to .1 %; six make single ones up to 26 % smaller.
_MOST_PAIRS = 12
# Samples of a record that stand in memory for all pairs at a time: a few megabytes, whatever the length of
# the records. No number depends on it but by rounding.
_BLOCK = 512
# Share of the energy of a pair's columns that is rounding, after all else has been projected off them.
# Measured: from 1e-12 to 1e-7 no ellipse moves by 1 %.
_ROUNDING = 1e-9
# Share of that energy from which on a pair is a hypothesis of its own: a thousandth in amplitude.
# Measured: from 1e-8 to 1e-4 no ellipse moves by 1 %.
_DISTINGUISHABLE = 1e-6
# Rounds of `refined_pair`, each of half the step of the one before: the last step is 1/64 of a spacing.
# Measured on eight of the arms: with three rounds no ellipse moves by more than 1 %.
_REFINEMENTS = 6
# Half bandwidths within which pairs are neighbours, whose probabilities are added up before they are judged.
# It is more than `_SPACING`, so that a mode half way between two counts with both. Chosen.
_NEIGHBOURHOOD = 2
# Points at which each round of `refined_pair` looks along frequency, and along damping, in steps: the ends,
# the middle and half way. Four further points each halve the interval. Chosen.
_OFFSETS = (-1.0, -0.5, 0.0, 0.5, 1.0)
# Fall of nu ln J, in ln nu, for which an order selection keeps a pair: ln nu for each of its four numbers
# (Schwarz's criterion, as `ident.fit.least_squares.information_criterion` has it).
_KEPT_BY_SELECTION = 4
# Share of all probability that the pairs together must have for the best one to be visible: likelier than
# not.
_LIKELIER_THAN_REST = 0.5
# Damping ratios between which a pair is refined: at .6 a mode has hardly a peak. Measured on eight
# of the arms: with 1e-4 to .9 no ellipse moves by 1 %.
_REFINED_ZETA = (1e-3, 0.6)
# Largest share of a residual that counts as explained: what is left, 1e-15, is a few times the rounding of a
# double, so that its logarithm is finite.
_MOST_EXPLAINED = 1 - 1e-15


class PairAxes(NamedTuple):
    """Principal axes of J pairs' gram matrices.

    eigenvalues (J,2), ascending; eigenvectors (J,2,2), in columns; projections (J,2) of X^T y on them. Where
    a column is nothing but rounding, its eigenvalue is that of rounding, and its projection zero.
    """

    eigenvalues: RealArray
    eigenvectors: RealArray
    projections: RealArray


@dataclass(frozen=True, eq=False)
class PairStatistics:
    """What the data say on each of J pairs: inner products of its two columns X with the records.

    Nuisance and regressors F = Q1 R11 are projected out of X and of the output y. All columns are whitened.
    `pair_statistics` makes them; nothing is checked here.

    Attributes
    ----------
    gram : ndarray, shape (J, 2, 2)
        X^T X.
    projection : ndarray, shape (J, 2)
        X^T y, in output units.
    onto_regressors : ndarray, shape (J, p, 2)
        Q1^T X of X before F was projected out.
    residual : float
        |y|^2, output units squared.
    size : ndarray, shape (J,)
        Trace of X^T X before all projections.
    """

    gram: RealArray
    projection: RealArray
    onto_regressors: RealArray
    residual: float
    size: RealArray

    def axes(self) -> PairAxes:
        """Principal axes of the gram matrices of all J pairs.

        Eigenvalues below `_ROUNDING` of the columns' size are raised to it. A pair whose columns have NaN
        gets eigenvalues of NaN and projections of zero.
        """
        values, vectors = np.linalg.eigh(self.gram)
        along = np.einsum("jki,jk->ji", vectors, self.projection)
        rounding = _ROUNDING * self.size[:, None]
        return PairAxes(
            eigenvalues=np.maximum(values, rounding),
            eigenvectors=vectors,
            projections=np.where(values > rounding, along, 0.0),
        )

    def distinguishable(self) -> BoolArray:
        """Whether these records can tell each pair from the poles and the nuisance at all, (J,).

        False for a pair that the input does not drive, or whose columns are NaN.
        """
        remaining = self.gram[:, 0, 0] + self.gram[:, 1, 1]
        return np.asarray(remaining > _DISTINGUISHABLE * self.size)


@dataclass(frozen=True, eq=False)
class PairEvidence:
    """Likelihood of J pairs at A sizes of their amplitudes, and the amplitudes' posterior at each.

    Attributes
    ----------
    log_likelihood : ndarray, shape (J, A)
        Restricted, up to the constant of `embedding_algebra.restricted_log_likelihood`.
    energy : ndarray, shape (A,)
        Expected energy of the pair in the output, in noise variances (`remainder_energies`).
    prior : ndarray, shape (A,)
        Prior probability of each energy; the sum is 1.
    mean : ndarray, shape (J, A, 2)
        Of the amplitudes, output units.
    covariance : ndarray, shape (J, A, 2, 2)
        Of the amplitudes.
    noise_variance : ndarray, shape (J, A)
        Of the whitened noise, output units squared.
    """

    log_likelihood: RealArray
    energy: RealArray
    prior: RealArray
    mean: RealArray
    covariance: RealArray
    noise_variance: RealArray


# Remembered for sixteen lengths of record, far more than one identification has; it costs memory alone.
@lru_cache(maxsize=16)
def candidate_pairs(n_samples: int, above: float = 0.0) -> tuple[ComplexArray, RealArray]:
    """Poles (J,) of the upper half plane on a grid of lightly damped pairs, and prior weights (J,).

    Parameters
    ----------
    n_samples : int
        Rows of the longest record.
    above : float
        Least frequency of a pair, radians a sample; one beyond the highest leaves a pair of each damping.

    Returns
    -------
    poles : ndarray, shape (J,)
        In z, read-only. From six periods in the record, or `above`, to nine tenths of the Nyquist frequency;
        first all of the least damping, ascending.
    prior : ndarray, shape (J,)
        Sum 1: each damping alike, and within a damping each pair.

    Raises
    ------
    ValueError
        For a record in which not even the most damped and fastest candidate dies out.

    Notes
    -----
    Free oscillations of a candidate fall to e^-2 within the record: a sharper peak could stand between the
    frequencies that the record resolves, as high as one likes, and no data would contradict it.
    """
    fewest_samples = int(np.ceil(_DECAY / (_ZETA[-1] * _HIGHEST)))
    if n_samples < fewest_samples:
        raise ValueError(
            f"{n_samples} samples are too few to tell whether a mode is missing; expected at least "
            f"{fewest_samples}: record longer, or set prior_missed_mode = 0 if you know of none"
        )
    slowest = 2 * np.pi * _FEWEST_PERIODS / n_samples
    lowest = min(max(slowest, above), _HIGHEST)
    least_decay_rate = _DECAY / n_samples

    poles: list[complex] = []
    prior: list[float] = []
    for index, zeta in enumerate(_ZETA):
        # A damping begins at the frequency from which on it dies out within the record. The least one begins
        # at once: at low frequencies it is raised to what dies out.
        omega = lowest
        if index > 0:
            omega = max(lowest, least_decay_rate / zeta)
        pairs_of_damping = []
        while omega <= _HIGHEST:
            damping = max(zeta, least_decay_rate / omega)
            log_pole = omega * (-damping + 1j * np.sqrt(1 - damping**2))
            pairs_of_damping.append(np.exp(log_pole))
            omega *= 1 + _SPACING * damping
        poles += pairs_of_damping
        prior += [1 / len(pairs_of_damping)] * len(pairs_of_damping)
    return readonly(poles, np.complex128), readonly(np.array(prior) / np.sum(prior))


def pair_statistics(
    blocks: Iterable[RecordRows], reduced: ReducedRegression, poles: ComplexArray
) -> PairStatistics:
    """Inner products of all pairs with the records, in one pass over them.

    Parameters
    ----------
    blocks : iterable of RecordRows
        `EmbeddingRows.pair_blocks`: whitened rows, and the input behind the all-pass of the model's poles.
    reduced : ReducedRegression
        The regression of the same rows; of it the triangle R11 (p, p), the columns in use and the residual
        matter.
    poles : ndarray, shape (J,)
        One of each pair, in z, above the axis and inside the circle.

    Returns
    -------
    PairStatistics
        Not checked: without blocks all products are zero; NaN of a record is in all of them.

    Notes
    -----
    Time O(N J (p + n)), N rows, p regressors, n nuisance columns; memory that of `_BLOCK` rows of all pairs.
    """
    n_pairs = poles.size
    n_regressors = reduced.n_regressors
    parameters = block_parameters(Poles(np.zeros(0), poles))
    scale = np.linalg.norm(reduced.r11, axis=0)
    # x1^T x1, x1^T x2, x2^T x2 of every pair, without what the nuisance takes of them.
    gram = np.zeros((3, n_pairs))
    # Columns x1, x2 of one pair after the other, against Q1 and what Q1 leaves of the output.
    inner = np.zeros((2 * n_pairs, n_regressors + 1))
    size = np.zeros(n_pairs)
    for block in blocks:
        # Orthonormal nuisance, regressors and output of this record.
        basis = nuisance_basis(block.nuisance)
        n_nuisance = basis.shape[1]
        regressors = block.regressors[:, reduced.in_use]
        # Twice is enough: the second pass takes off what rounding left of the first.
        for _ in range(2):
            regressors = regressors - basis @ (basis.T @ regressors)
        output = block.output - basis @ (basis.T @ block.output)
        scaled_triangle = (reduced.r11 / scale).T
        q1 = solve_triangular(scaled_triangle, (regressors / scale).T, lower=True).T
        # C-contiguous, as slices of its rows are multiplied many times.
        known_columns = np.ascontiguousarray(np.column_stack([basis, q1, output - q1 @ reduced.r1]))

        # The pairs' columns, a few hundred rows at a time. The first rows are whitened together.
        products = np.zeros((known_columns.shape[1], 2 * n_pairs))
        gram_of_record = np.zeros((3, n_pairs))
        states = np.zeros((2, n_pairs))
        piece = max(_BLOCK, block.head.size)
        for start in range(0, block.input.size, piece):
            rows = slice(start, start + piece)
            x1, x2 = _pair_rows(parameters, kernel_array(block.input[rows]), states)
            if start == 0 and block.head.size:
                n_first = block.head.size
                plain1, plain2 = _pair_rows(parameters, kernel_array(block.head), np.zeros((2, n_pairs)))
                x1[:n_first] = block.first @ plain1
                x2[:n_first] = block.first @ plain2
            gram_of_record[0] += np.einsum("kj,kj->j", x1, x1)
            gram_of_record[1] += np.einsum("kj,kj->j", x1, x2)
            gram_of_record[2] += np.einsum("kj,kj->j", x2, x2)
            products[:, 0::2] += known_columns[rows].T @ x1
            products[:, 1::2] += known_columns[rows].T @ x2

        size += gram_of_record[0] + gram_of_record[2]
        nuisance1 = products[:n_nuisance, 0::2]
        nuisance2 = products[:n_nuisance, 1::2]
        taken11 = np.sum(nuisance1**2, 0)
        taken12 = np.sum(nuisance1 * nuisance2, 0)
        taken22 = np.sum(nuisance2**2, 0)
        taken_by_nuisance = np.stack([taken11, taken12, taken22])
        gram += gram_of_record - taken_by_nuisance
        inner += products[n_nuisance:].T

    # (J, p, 2) of the regressors' share, and the gram matrices without it.
    by_pair = inner[:, :n_regressors].reshape(n_pairs, 2, n_regressors)
    onto_regressors = by_pair.transpose(0, 2, 1)
    symmetric = gram[[0, 1, 1, 2]].T.reshape(-1, 2, 2)
    return PairStatistics(
        gram=symmetric - onto_regressors.transpose(0, 2, 1) @ onto_regressors,
        projection=inner[:, n_regressors].reshape(-1, 2),
        onto_regressors=onto_regressors,
        residual=reduced.unexplained + float(reduced.z @ reduced.z),
        size=size,
    )


@numba.njit(**COMPILED, fastmath=True)
def _pair_rows(parameters: Any, signal: Any, states: Any) -> Any:
    """Two arrays (T,J): the two basis functions of every pair alone, driven by the signal (T,).

    parameters (J,4): `block_parameters` of the pairs. states (2,J): where the pairs start, and afterwards
    where they stand, changed in place. All pairs advance together, as neighbours in memory, so that the
    processor takes several at once: this loop is most of the time of `pair_statistics`. Compiled: shapes and
    types are not checked, and fastmath does not promise to carry NaN through.
    """
    n_pairs = parameters.shape[0]
    # One contiguous row for each coefficient of the recursion.
    numbers = np.empty((5, n_pairs))
    gamma_beta = numbers[0]
    gamma_sb = numbers[1]
    beta = numbers[2]
    sg = numbers[3]
    sb = numbers[4]
    for i in range(n_pairs):
        gamma = parameters[i, 0]
        beta[i] = parameters[i, 1]
        sg[i] = parameters[i, 2]
        sb[i] = parameters[i, 3]
        gamma_beta[i] = gamma * beta[i]
        gamma_sb[i] = gamma * sb[i]
    outputs1 = np.empty((signal.size, n_pairs))
    outputs2 = np.empty((signal.size, n_pairs))
    states1 = states[0]
    states2 = states[1]
    for k in range(signal.size):
        v = signal[k]
        row1 = outputs1[k]
        row2 = outputs2[k]
        for i in range(n_pairs):
            # The outputs are the states before this sample: neither function answers at once.
            first = states1[i]
            second = states2[i]
            row1[i] = first
            row2[i] = second
            states1[i] = gamma_beta[i] * first - gamma_sb[i] * second + sg[i] * v
            states2[i] = sb[i] * first + beta[i] * second
    return outputs1, outputs2


def pair_evidence(statistics: PairStatistics, degrees_of_freedom: int) -> PairEvidence:
    """Restricted likelihood and posterior of a ~ N(0, s2 kappa I) for every pair and scale kappa.

    Parameters
    ----------
    statistics : PairStatistics
        Of J pairs.
    degrees_of_freedom : int
        nu, rows less nuisance columns and regressors; at least 2 (`remainder_energies`), not checked.

    Returns
    -------
    PairEvidence
        Of a residual that is explained entirely, likelihood and noise variance of the smallest double.

    Notes
    -----
    -2 log L = nu log s2 + log det(I + kappa G) + nu, s2 = (|y|^2 - b^T (G + I / kappa)^-1 b) / nu, with G the
    gram matrix and b the projection of the pair; kappa = energy / largest eigenvalue of G. Pairs that the
    records cannot tell from the poles have likelihood zero.
    """
    nu = degrees_of_freedom
    energy, prior = remainder_energies(nu)
    axes = statistics.axes()
    values = axes.eigenvalues
    # (J, A), then (J, A, 2) along the axes of each pair.
    kappa = energy / values[:, 1:]
    precision = values[:, None, :] + 1 / kappa[:, :, None]
    along = axes.projections[:, None, :]
    explained = np.sum(along**2 / precision, axis=2)
    smallest = np.finfo(np.float64).tiny
    s2 = np.maximum(statistics.residual - explained, smallest) / nu
    log_det = np.sum(np.log1p(kappa[:, :, None] * values[:, None, :]), axis=2)
    log_likelihood = -0.5 * (nu * np.log(s2) + log_det + nu)

    vectors = axes.eigenvectors
    unit_covariance = np.einsum("jki,jai,jli->jakl", vectors, 1 / precision, vectors)
    return PairEvidence(
        log_likelihood=np.where(statistics.distinguishable()[:, None], log_likelihood, -np.inf),
        energy=energy,
        prior=prior,
        mean=np.einsum("jki,jai->jak", vectors, along / precision),
        covariance=s2[:, :, None, None] * unit_covariance,
        noise_variance=s2,
    )


@dataclass(frozen=True, eq=False)
class PairMixture:
    """The K pairs worth keeping, as hypotheses of which at most one is true.

    Attributes
    ----------
    poles : ndarray, shape (K,)
        In z, upper half plane.
    weight : ndarray, shape (K,)
        Posterior probability of each; what is missing to 1 is that of no missed mode.
    mean : ndarray, shape (K, 2)
        Of the amplitudes, output units, averaged over their size.
    covariance : ndarray, shape (K, 2, 2)
        Of the amplitudes, the scatter of the means over the size included.
    noise_variance : ndarray, shape (K,)
        Output units squared.
    onto : ndarray, shape (p, 2 K)
        Q1^T X, how the pairs' columns lean on the regressors.
    probability : float
        Of all pairs together, those left out included.
    visible : complex or None
        The likeliest pair if an order selection would have kept it, and the kernel does not explain it
        better.
    """

    poles: ComplexArray
    weight: RealArray
    mean: RealArray
    covariance: RealArray
    noise_variance: RealArray
    onto: RealArray
    probability: float
    visible: complex | None

    def most_probable_rad_s(self, dt_s: float) -> float:
        """Natural frequency of the likeliest pair, rad/s; 0 where no pair was kept. dt_s: s, positive."""
        if self.weight.size == 0:
            return 0.0
        likeliest = self.poles[np.argmax(self.weight)]
        return float(np.abs(np.log(likeliest)) / dt_s)


def pair_mixture(
    poles: ComplexArray,
    prior: RealArray,
    statistics: PairStatistics,
    degrees_of_freedom: int,
    log_rest: float,
    prior_odds: float,
) -> PairMixture:
    """Probabilities of the pairs against everything else, and the moments of those worth keeping.

    Parameters
    ----------
    poles, prior : ndarray, shape (J,)
        Those of `candidate_pairs`; J is at least 1.
    statistics : PairStatistics
        Of these pairs.
    degrees_of_freedom : int
        nu, rows less nuisance columns and regressors.
    log_rest : float
        Logarithm of the likelihood averaged over all hypotheses without a missed mode
        (`embedding_algebra.total_log_evidence`).
    prior_odds : float
        Prior probability of a missed mode over that of none, above 0; not checked.

    Returns
    -------
    PairMixture
        With K = 0 where no neighbourhood is probable. Not checked: a residual of zero divides by zero.

    Notes
    -----
    Pair j at size a has the posterior weight prior_odds prior_j prior_a L_ja, everything else exp(log_rest);
    moments by the law of total covariance. A pair is visible where nu ln(J0/J1) > 4 ln nu, as in the order
    selection, and the pairs together are likelier than the rest. The weight of pairs not kept is shared out
    among all others.
    """
    # Weights of all pairs and sizes, over the largest so that no exponential overflows.
    evidence = pair_evidence(statistics, degrees_of_freedom)
    log_weights = evidence.log_likelihood + np.log(prior_odds * prior[:, None] * evidence.prior)
    top = max(float(log_weights.max()), log_rest)
    joint = np.exp(log_weights - top)
    per_pair = joint.sum(axis=1)
    total = per_pair.sum() + np.exp(log_rest - top)
    probability = per_pair / total

    # The likeliest pairs of probable neighbourhoods, in grid order: moments of a mixture feel an improbable
    # hypothesis by the square of its distance, and it is outside every confidence region.
    frequency = np.angle(poles)
    decay = -np.log(np.abs(poles))
    apart = np.abs(frequency[:, None] - frequency)
    near = apart <= _NEIGHBOURHOOD * np.maximum(decay[:, None], decay)
    in_neighbourhood = near @ probability
    worth_keeping = (in_neighbourhood > _LEAST_PROBABILITY) & (probability > _NEGLIGIBLE)
    probable = np.flatnonzero(worth_keeping)
    ascending = np.argsort(probability[probable])
    likeliest_first = probable[ascending[::-1]]
    chosen = np.sort(likeliest_first[:_MOST_PAIRS])

    # Moments of the amplitudes over the sizes.
    share = joint[chosen] / per_pair[chosen, None]
    mean_of_size = evidence.mean[chosen]
    mean = np.einsum("ja,jak->jk", share, mean_of_size)
    deviation = mean_of_size - mean[:, None, :]
    covariance = np.einsum("ja,jakl->jkl", share, evidence.covariance[chosen])
    covariance += np.einsum("ja,jak,jal->jkl", share, deviation, deviation)
    no_columns = np.zeros((statistics.onto_regressors.shape[1], 0))
    weight_chosen = per_pair[chosen]
    weight_of_all_pairs = per_pair.sum()
    without_dropped = total - weight_of_all_pairs + weight_chosen.sum()

    # Whether the best pair would have been kept by an order selection: nu ln(J0/J1) > 4 ln nu. A residual
    # that is explained to rounding counts as explained but for 1e-15 of it.
    explained = _explained(statistics)
    best = int(np.argmax(explained))
    explained_share = min(float(explained[best]) / statistics.residual, _MOST_EXPLAINED)
    gain = -degrees_of_freedom * np.log1p(-explained_share)
    visible: complex | None = None
    likelier_than_rest = weight_of_all_pairs > _LIKELIER_THAN_REST * total
    if gain > _KEPT_BY_SELECTION * np.log(degrees_of_freedom) and likelier_than_rest:
        visible = complex(poles[best])
    return PairMixture(
        poles=poles[chosen],
        weight=weight_chosen / without_dropped,
        mean=mean,
        covariance=covariance,
        noise_variance=np.sum(share * evidence.noise_variance[chosen], axis=1),
        onto=np.hstack([no_columns, *statistics.onto_regressors[chosen]]),
        probability=float(weight_of_all_pairs / total),
        visible=visible,
    )


def refined_pair(
    blocks: Callable[[], Iterable[RecordRows]], reduced: ReducedRegression, pair: complex
) -> complex:
    """The pair, in z, near a grid point that explains most of the records with free amplitudes.

    Parameters
    ----------
    blocks : callable
        Gives the records' rows for one more pass, as `EmbeddingRows.pair_blocks`.
    reduced : ReducedRegression
        The regression of these rows.
    pair : complex
        Point of the grid of `candidate_pairs`: above the axis, inside the circle; not checked.

    Returns
    -------
    complex
        Between the damping ratios `_REFINED_ZETA`, not above nine tenths of the Nyquist frequency. Where the
        records tell no point from the poles: the corner of lowest frequency and damping.

    Notes
    -----
    Six rounds of 5 x 5 points that shrink end within a hundredth of a half bandwidth; the pair's tangent
    columns, which the embedding adds too, cover the rest.
    """
    rate = np.log(pair)
    omega = float(np.abs(rate))
    zeta = float(-np.real(rate) / np.abs(rate))
    # From the grid point half way to its neighbours, in the logarithms of frequency and damping; each round
    # half of that.
    step_omega = 0.5 * _SPACING * zeta
    step_zeta = 0.5 * np.log(_ZETA[1] / _ZETA[0])
    offsets = np.array(_OFFSETS)
    for _ in range(_REFINEMENTS):
        omegas = np.minimum(omega * np.exp(step_omega * offsets), _HIGHEST)
        zetas = np.clip(zeta * np.exp(step_zeta * offsets), *_REFINED_ZETA)
        omega_grid, zeta_grid = np.meshgrid(omegas, zetas)
        w = omega_grid.ravel()
        z = zeta_grid.ravel()
        log_poles = w * (-z + 1j * np.sqrt(1 - z**2))
        trial = np.exp(log_poles)
        explained = _explained(pair_statistics(blocks(), reduced, trial))
        best = int(np.argmax(explained))
        omega = float(w[best])
        zeta = float(z[best])
        pair = complex(trial[best])
        step_omega = 0.5 * step_omega
        step_zeta = 0.5 * step_zeta
    return pair


def _explained(statistics: PairStatistics) -> RealArray:
    """Drop (J,) of the residual sum of squares by each pair with free amplitudes, output units squared.

    Zero for pairs that the records cannot tell from the poles, those with NaN among them.
    """
    axes = statistics.axes()
    drop = np.sum(axes.projections**2 / axes.eigenvalues, axis=1)
    return np.where(statistics.distinguishable(), drop, 0.0)


def with_pairs(rest: KernelPosterior, mixture: PairMixture) -> KernelPosterior:
    """Posterior of the kernel eta and the pairs' amplitudes (eta, a_1 .. a_K), one Gaussian for the mixture.

    Parameters
    ----------
    rest : KernelPosterior
        Under the hypothesis of no missed mode; mean (L,) and factor (L, L') of the taps, noise variance.
    mixture : PairMixture
        K pairs: weights (K,), and means (K, 2) and covariances (K, 2, 2) of their amplitudes.

    Returns
    -------
    KernelPosterior
        Its kernel_mean has L + 2 K entries. It has the mean and the covariance of the mixture; alpha, lam and
        log_evidence stay those of `rest`. With K = 0, that of `rest` but for rounding. Weights that exceed 1
        together are not checked.

    Notes
    -----
    Under each hypothesis all the others' amplitudes are zero, so that the covariance between them is minus
    the product of the weighted means.
    """
    length = rest.kernel_mean.size
    n_pairs = mixture.weight.size
    weight_rest = 1.0 - float(mixture.weight.sum())

    # First and second moments, block by block.
    weighted_pairs = mixture.weight[:, None] * mixture.mean
    mean = np.concatenate([weight_rest * rest.kernel_mean, weighted_pairs.ravel()])
    second = np.zeros((length + 2 * n_pairs, length + 2 * n_pairs))
    kernel_covariance = rest.kernel_factor @ rest.kernel_factor.T
    kernel_second = kernel_covariance + np.outer(rest.kernel_mean, rest.kernel_mean)
    second[:length, :length] = weight_rest * kernel_second
    for i in range(n_pairs):
        amplitudes = slice(length + 2 * i, length + 2 * i + 2)
        pair_second = mixture.covariance[i] + np.outer(mixture.mean[i], mixture.mean[i])
        second[amplitudes, amplitudes] = mixture.weight[i] * pair_second

    noise_variance = weight_rest * rest.noise_variance + float(mixture.weight @ mixture.noise_variance)
    return replace(
        rest,
        kernel_mean=mean,
        kernel_factor=symmetric_factor(second - np.outer(mean, mean)),
        noise_variance=noise_variance,
        probability_no_remainder=weight_rest * rest.probability_no_remainder,
    )


def cascade_coordinates(poles: ComplexArray) -> RealArray:
    """Matrix (2K,2K) from amplitudes of K pairs, each alone, to coefficients of the pairs in cascade.

    Parameters
    ----------
    poles : ndarray, shape (K,)
        One of each pair, in z, upper half plane, all different: of equal ones (not checked) the matrix is
        singular.

    Notes
    -----
    A basis function of pair p is 2 Re(rho / (z - p)), and the inner product of 1 / (z - p) with a basis
    function L of the cascade is L(1 / p) / p (Cauchy), so that no integral and no equation is solved. Exact:
    both sets span the same space, and the cascade is orthonormal.
    """
    pairs = Poles(np.zeros(0), poles)
    cascade = basis_response(pairs, 1 / poles)
    coordinates = np.empty((2 * poles.size, 2 * poles.size))
    for i, (p, (_, beta, sg, sb)) in enumerate(zip(poles, block_parameters(pairs), strict=True)):
        # Numerators at z = p of the pair's two functions (`block_parameters`): sg (z - beta) and sg sb.
        numerators = (sg * (p - beta), sg * sb)
        for j, numerator in enumerate(numerators):
            residue = numerator / (2j * p.imag)
            coordinates[:, 2 * i + j] = 2 * np.real(residue * cascade[i] / p)
    return coordinates
