"""One flexible mode that the pole search may have missed, averaged over.

Every pair of a grid over frequency and damping is a hypothesis "the poles, and this pair": its two amplitudes
get a Gaussian prior, their scale a grid, so that its restricted likelihood is comparable with those of the
kernel. The pairs stand after the all-pass of the model's poles, orthogonal to everything those can express.

Neglected: two missed modes at once, a missed mode together with a kernel, the missed mode's own initial
state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

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

# Lightly damped: half way (in ratio) between two, or at 0.005, a mode loses a tenth of its energy.
_ZETA = (0.01, 0.03)
# A candidate's own decay over the record, in time constants, is at least this.
_DECAY = 2.0
_FEWEST_PERIODS = 6.0  # the damping that `_DECAY` asks for is then light: 2 / (2 pi 6) = 0.053
# Highest frequency, rad/sample.
_HIGHEST = 0.9 * np.pi
# Neighbours in frequency are this many half bandwidths apart: a mode half way loses a tenth of its energy.
_SPACING = 1.5
# Least probability of a missed mode around a frequency, and of each pair; most pairs that stand for it.
_LEAST_PROBABILITY = 0.05
# Of some hundred pairs that are left out for it: together less than `_LEAST_PROBABILITY`.
_NEGLIGIBLE = 1e-4
_MOST_PAIRS = 12  # 24 columns of the posterior beside the 150 of its kernel
# Samples that are held at a time: a few megabytes, whatever the length of the records.
_BLOCK = 512
# Shares of a pair's columns (in energy) that are rounding, and that make it a hypothesis of its own.
_ROUNDING = 1e-9
_DISTINGUISHABLE = 1e-6  # a thousandth of the amplitude


@dataclass(frozen=True, eq=False)
class PairStatistics:
    """What the data say on each pair, nuisance and F projected out.

    gram (J,2,2) = X^T X, projection (J,2) = X^T y, onto_regressors (J,p,2) = Q1^T X with F = Q1 R11; residual
    = |y|^2; size (J,): trace of X^T X before the projections.
    """

    gram: RealArray
    projection: RealArray
    onto_regressors: RealArray
    residual: float
    size: RealArray

    def axes(self) -> tuple[RealArray, RealArray, RealArray]:
        """Eigenvalues (J,2), ascending, and eigenvectors of the gram matrices; projections (J,2) on them,
        zero for what is left of a column at the level of rounding."""
        values, vectors = np.linalg.eigh(self.gram)
        along = np.einsum("jki,jk->ji", vectors, self.projection)
        floor = _ROUNDING * self.size[:, None]
        return np.maximum(values, floor), vectors, np.where(values > floor, along, 0.0)

    def distinguishable(self) -> BoolArray:
        """(J,) whether these records can tell the pair from the poles and the nuisance at all."""
        return np.asarray(self.gram[:, 0, 0] + self.gram[:, 1, 1] > _DISTINGUISHABLE * self.size)


@dataclass(frozen=True, eq=False)
class PairEvidence:
    """log likelihood (J,A) over pairs and scales, on the scale of `embedding_algebra`.

    energy (A,): expected, in noise variances, and prior (A,); mean (J,A,2), covariance (J,A,2,2) of the
    amplitudes, noise_variance (J,A).
    """

    log_likelihood: RealArray
    energy: RealArray
    prior: RealArray
    mean: RealArray
    covariance: RealArray
    noise_variance: RealArray


@lru_cache(maxsize=16)
def candidate_pairs(n_samples: int, above: float = 0.0) -> tuple[ComplexArray, RealArray]:
    """Grid of lightly damped pairs: poles (J,) of the upper half plane and prior weights (J,) that sum to 1.

    From six periods in the record, or `above` [rad/sample], to nine tenths of the Nyquist frequency.
    Free oscillations of a candidate fall to e^-2 within the record: a sharper peak could stand between the
    frequencies that the record resolves, as high as one likes, and no data would contradict it.

    Raises ValueError for a record in which not even the most damped and fastest candidate falls that far.
    """
    fewest_samples = int(np.ceil(_DECAY / (_ZETA[-1] * _HIGHEST)))
    if n_samples < fewest_samples:
        raise ValueError(
            f"{n_samples} samples are too few to tell whether a mode is missing; expected at least "
            f"{fewest_samples}: record longer, or set prior_missed_mode = 0 if you know of none"
        )
    low = 2 * np.pi * _FEWEST_PERIODS / n_samples
    high = _HIGHEST
    rate = _DECAY / n_samples
    low = min(max(low, above), high)
    poles, prior = [], []
    for lower, zeta in zip((0.0, *_ZETA[:-1]), _ZETA, strict=True):
        group = []
        omega = low if lower == 0 else max(low, rate / zeta)
        while omega <= high:
            damping = max(zeta, rate / omega)
            group.append(np.exp(omega * (-damping + 1j * np.sqrt(1 - damping**2))))
            omega *= 1 + _SPACING * damping
        poles += group
        prior += [1 / len(group)] * len(group)
    return readonly(poles, np.complex128), readonly(np.array(prior) / np.sum(prior))


def pair_statistics(
    blocks: Iterable[RecordRows], reduced: ReducedRegression, poles: ComplexArray
) -> PairStatistics:
    """One pass over the records; time O(N J (p + n)), memory that of a few hundred rows of all pairs. blocks:
    `EmbeddingRows.pair_blocks`."""
    q = reduced.n_regressors
    gram = np.zeros((3, poles.size))
    inner, size = np.zeros((2 * poles.size, q + 1)), np.zeros(poles.size)
    parameters = block_parameters(Poles(np.zeros(0), poles))
    scale = np.linalg.norm(reduced.r11, axis=0)
    for block in blocks:
        basis = nuisance_basis(block.nuisance)
        regressors = block.regressors[:, reduced.kept]
        for _ in range(2):
            regressors = regressors - basis @ (basis.T @ regressors)
        output = block.output - basis @ (basis.T @ block.output)
        q1 = solve_triangular((reduced.r11 / scale).T, (regressors / scale).T, lower=True).T
        others = np.ascontiguousarray(np.column_stack([basis, q1, output - q1 @ reduced.r1]))
        n = basis.shape[1]
        products = np.zeros((others.shape[1], 2 * poles.size))
        gram_here, states = np.zeros((3, poles.size)), np.zeros((2, poles.size))
        # The first rows are whitened together.
        piece = max(_BLOCK, block.head.size)
        for start in range(0, block.input.size, piece):
            part = slice(start, start + piece)
            x1, x2 = _pair_rows(parameters, kernel_array(block.input[part]), states)
            if start == 0 and block.head.size:
                plain = _pair_rows(parameters, kernel_array(block.head), np.zeros((2, poles.size)))
                x1[: block.head.size], x2[: block.head.size] = (block.first @ x for x in plain)
            gram_here += [np.einsum("kj,kj->j", a, b) for a, b in ((x1, x1), (x1, x2), (x2, x2))]
            products[:, 0::2] += others[part].T @ x1
            products[:, 1::2] += others[part].T @ x2
        size += gram_here[0] + gram_here[2]
        first, second = products[:n, 0::2], products[:n, 1::2]
        gram += gram_here - np.stack([np.sum(first**2, 0), np.sum(first * second, 0), np.sum(second**2, 0)])
        inner += products[n:].T
    onto = inner[:, :q].reshape(poles.size, 2, q).transpose(0, 2, 1)
    matrices = gram[[0, 1, 1, 2]].T.reshape(-1, 2, 2) - onto.transpose(0, 2, 1) @ onto
    residual = reduced.rest + float(reduced.z @ reduced.z)
    return PairStatistics(matrices, inner[:, q].reshape(-1, 2), onto, residual, size)


@numba.njit(**COMPILED, fastmath=True)
def _pair_rows(parameters: Any, signal: Any, states: Any) -> Any:
    """The two basis functions of every pair alone, driven by the signal (T,): two arrays (T,J). states (2,J):
    where the pairs start, and afterwards stand. All pairs advance together, neighbours in memory."""
    n_pairs = parameters.shape[0]
    numbers = np.empty((5, n_pairs))
    gb, gs, beta, sg, sb = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    for i in range(n_pairs):
        gamma, beta[i], sg[i], sb[i] = parameters[i, 0], parameters[i, 1], parameters[i, 2], parameters[i, 3]
        gb[i], gs[i] = gamma * beta[i], gamma * sb[i]
    out1, out2 = np.empty((signal.size, n_pairs)), np.empty((signal.size, n_pairs))
    a, b = states[0], states[1]
    for k in range(signal.size):
        v = signal[k]
        row1, row2 = out1[k], out2[k]
        for i in range(n_pairs):
            p, q = a[i], b[i]
            row1[i] = p
            row2[i] = q
            a[i] = gb[i] * p - gs[i] * q + sg[i] * v
            b[i] = sb[i] * p + beta[i] * q
    return out1, out2


def pair_evidence(statistics: PairStatistics, degrees_of_freedom: int) -> PairEvidence:
    """Restricted likelihood and posterior of a ~ N(0, s2 kappa I) for every pair and scale kappa.

    -2 log L = nu log s2 + log det(I + kappa G) + nu with s2 = (|y|^2 - b^T (G + I / kappa)^-1 b) / nu; kappa
    = energy / largest eigenvalue of G.
    """
    nu = degrees_of_freedom
    energy, prior = remainder_energies(nu)
    values, vectors, along = statistics.axes()
    kappa = energy / values[:, 1:]
    precision = values[:, None, :] + 1 / kappa[:, :, None]
    explained = np.sum(along[:, None, :] ** 2 / precision, axis=2)
    s2 = np.maximum(statistics.residual - explained, np.finfo(np.float64).tiny) / nu
    log_det = np.sum(np.log1p(kappa[:, :, None] * values[:, None, :]), axis=2)
    log_likelihood = -0.5 * (nu * np.log(s2) + log_det + nu)
    return PairEvidence(
        log_likelihood=np.where(statistics.distinguishable()[:, None], log_likelihood, -np.inf),
        energy=energy,
        prior=prior,
        mean=np.einsum("jki,jai->jak", vectors, along[:, None, :] / precision),
        covariance=s2[:, :, None, None] * np.einsum("jki,jai,jli->jakl", vectors, 1 / precision, vectors),
        noise_variance=s2,
    )


@dataclass(frozen=True, eq=False)
class PairMixture:
    """The pairs worth keeping, as independent hypotheses.

    poles (K,), weight (K,) their posterior probabilities, probability: of all pairs together; mean (K,2),
    covariance (K,2,2), noise_variance (K,), averaged over the scale; onto (p,2K) = Q1^T X. visible: the
    likeliest pair if an order selection would have kept it and the kernel does not explain it better, else
    None.
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
        """Natural frequency of the likeliest pair; 0 when none was kept."""
        if self.weight.size == 0:
            return 0.0
        return float(np.abs(np.log(self.poles[np.argmax(self.weight)])) / dt_s)


def pair_mixture(
    poles: ComplexArray,
    prior: RealArray,
    statistics: PairStatistics,
    degrees_of_freedom: int,
    log_rest: float,
    prior_odds: float,
) -> PairMixture:
    """Probabilities of the pairs against everything else, and the moments of those worth keeping.

    Pair j at scale a has the posterior weight prior_odds prior_j prior_a L_ja, everything else exp(log_rest):
    prior times likelihood summed over all hypotheses without a missed mode; moments by the law of total
    covariance. Visible: nu ln(J0/J1) > 4 ln nu, nu = degrees_of_freedom, and the pairs together are likelier
    than the rest. The weight of pairs not kept is shared out among all others.
    """
    evidence = pair_evidence(statistics, degrees_of_freedom)
    logs = evidence.log_likelihood + np.log(prior_odds * prior[:, None] * evidence.prior)
    top = max(float(logs.max()), log_rest)
    joint = np.exp(logs - top)
    per_pair = joint.sum(axis=1)
    total = per_pair.sum() + np.exp(log_rest - top)
    # The likeliest pairs of probable neighbourhoods (two half bandwidths), in grid order: moments of a
    # mixture feel an improbable hypothesis by the square of its distance, and it is outside every confidence
    # region.
    probability, frequency = per_pair / total, np.angle(poles)
    decay = -np.log(np.abs(poles))
    near = np.abs(frequency[:, None] - frequency) <= 2 * np.maximum(decay[:, None], decay)
    probable = np.flatnonzero((near @ probability > _LEAST_PROBABILITY) & (probability > _NEGLIGIBLE))
    kept = np.sort(probable[np.argsort(probability[probable])[::-1][:_MOST_PAIRS]])
    share = joint[kept] / per_pair[kept, None]
    mean = np.einsum("ja,jak->jk", share, evidence.mean[kept])
    apart = evidence.mean[kept] - mean[:, None, :]
    covariance = np.einsum("ja,jakl->jkl", share, evidence.covariance[kept])
    covariance += np.einsum("ja,jak,jal->jkl", share, apart, apart)
    explained = _explained(statistics)
    best = int(np.argmax(explained))
    gain = -degrees_of_freedom * np.log1p(-min(float(explained[best]) / statistics.residual, 1 - 1e-15))
    visible = gain > 4 * np.log(degrees_of_freedom) and per_pair.sum() > 0.5 * total
    return PairMixture(
        poles=poles[kept],
        weight=per_pair[kept] / (total - per_pair.sum() + per_pair[kept].sum()),
        mean=mean,
        covariance=covariance,
        noise_variance=np.sum(share * evidence.noise_variance[kept], axis=1),
        onto=np.hstack(
            [np.zeros((statistics.onto_regressors.shape[1], 0)), *statistics.onto_regressors[kept]]
        ),
        probability=float(per_pair.sum() / total),
        visible=complex(poles[best]) if visible else None,
    )


def refined_pair(
    blocks: Callable[[], Iterable[RecordRows]], reduced: ReducedRegression, pair: complex
) -> complex:
    """The pair near this grid point that explains most. Six rounds of 5 x 5 that shrink end within a
    hundredth of a half bandwidth; the tangent columns cover the rest."""
    rate = np.log(pair)
    omega, zeta = float(np.abs(rate)), float(-np.real(rate) / np.abs(rate))
    step_omega, step_zeta = 0.5 * _SPACING * zeta, 0.5 * np.log(_ZETA[1] / _ZETA[0])
    offsets = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    for _ in range(6):
        omegas = np.minimum(omega * np.exp(step_omega * offsets), _HIGHEST)
        zetas = np.clip(zeta * np.exp(step_zeta * offsets), 1e-3, 0.6)
        w, z = (grid.ravel() for grid in np.meshgrid(omegas, zetas))
        trial = np.exp(w * (-z + 1j * np.sqrt(1 - z**2)))
        best = int(np.argmax(_explained(pair_statistics(blocks(), reduced, trial))))
        omega, zeta, pair = float(w[best]), float(z[best]), complex(trial[best])
        step_omega, step_zeta = 0.5 * step_omega, 0.5 * step_zeta
    return pair


def _explained(statistics: PairStatistics) -> RealArray:
    """Drop (J,) of the residual sum of squares by each pair with free amplitudes."""
    values, _, along = statistics.axes()
    return np.where(statistics.distinguishable(), np.sum(along**2 / values, axis=1), 0.0)


def with_pairs(rest: KernelPosterior, mixture: PairMixture) -> KernelPosterior:
    """Moments of (eta, a_1 .. a_K), a Gaussian in place of the mixture of `rest` and the pairs.

    Under each hypothesis all the others' amplitudes are zero, so that the covariance between them is minus
    the product of the weighted means.
    """
    length, k = rest.kernel_mean.size, mixture.weight.size
    weight_rest = 1.0 - float(mixture.weight.sum())
    mean = np.concatenate([weight_rest * rest.kernel_mean, (mixture.weight[:, None] * mixture.mean).ravel()])
    second = np.zeros((length + 2 * k, length + 2 * k))
    second[:length, :length] = weight_rest * (
        rest.kernel_factor @ rest.kernel_factor.T + np.outer(rest.kernel_mean, rest.kernel_mean)
    )
    for i in range(k):
        here = slice(length + 2 * i, length + 2 * i + 2)
        second[here, here] = mixture.weight[i] * (
            mixture.covariance[i] + np.outer(mixture.mean[i], mixture.mean[i])
        )
    return replace(
        rest,
        kernel_mean=mean,
        kernel_factor=symmetric_factor(second - np.outer(mean, mean)),
        noise_variance=weight_rest * rest.noise_variance + float(mixture.weight @ mixture.noise_variance),
        probability_no_remainder=weight_rest * rest.probability_no_remainder,
    )


def cascade_coordinates(poles: ComplexArray) -> RealArray:
    """(2K,2K): columns are the two basis functions of every pair alone, in the basis of the pairs in cascade.

    A basis function of pair p is 2 Re(rho / (z - p)), and the inner product of 1 / (z - p) with a basis
    function L of the cascade is L(1 / p) / p (Cauchy), so that no integral and no equation is solved. Exact:
    both sets span the same space, and the cascade is orthonormal.
    """
    cascade = basis_response(Poles(np.zeros(0), poles), 1 / poles)
    out = np.empty((2 * poles.size, 2 * poles.size))
    for i, (p, (_, beta, sg, sb)) in enumerate(
        zip(poles, block_parameters(Poles(np.zeros(0), poles)), strict=True)
    ):
        for column, numerator in ((2 * i, sg * (p - beta)), (2 * i + 1, sg * sb)):
            out[:, column] = 2 * np.real((numerator / (2j * p.imag)) * cascade[i] / p)
    return out
