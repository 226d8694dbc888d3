"""Stochastic embedding on matrices: one QR reduction, restricted likelihood, posterior of the kernel.

y = N nu + F theta + Psi eta + v with flat nu (nuisance) and theta, eta ~ N(0, s2 Ct), Ct = alpha B B^T, v ~
N(0, s2 I) (Goodwin, Gevers and Ninness, IEEE TAC 37(7), 1992). Everything
that depends on the data is in a triangle of the size of the parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import lapack, qr, solve_triangular, svd

from ident.basis.posterior import EmbeddingReport
from ident.data.arrays import IntArray, RealArray

# Rows of a record that stand in memory with all their columns: some hundred megabytes.
_PIECE = 65536
# Columns of the QR decomposition that are done at a time.
_PANEL = 32
# Columns of unit length whose part orthogonal to the earlier ones is below this say what those say.
RANK = 1e-10
# Share of the largest prior variance below which a tap is none: rounding, even ten orders above the noise.
_DIED_OUT = 1e-17
# Scales of a remainder up to what an order selection keeps, probability of more, and the largest energy.
_SCALES, _VISIBLE_SHARE, _LARGEST_ENERGY = 6, 0.1, 1e12


@dataclass(frozen=True, eq=False)
class Delays:
    """Matrix (T,L) of an input (T,) one, two, ... samples ago, zero before the record, whose rows are made
    where they are asked for. first (n,L): in place of its first n rows. begin: rows before that one are left
    out."""

    input: RealArray
    length: int
    first: RealArray
    begin: int = 0

    @property
    def shape(self) -> tuple[int, int]:
        return self.input.size - self.begin, self.length

    def __getitem__(self, rows: slice) -> RealArray:
        begin, end, _ = (self.begin + index for index in rows.indices(self.shape[0]))
        if end <= begin:
            return np.zeros((0, self.length))
        known = self.input[max(begin - self.length, 0) : end - 1]
        before = np.concatenate([np.zeros(max(self.length - begin, 0)), known])
        made = sliding_window_view(before, self.length)[:, ::-1].copy()
        replaced = self.first[begin:end]
        made[: len(replaced)] = replaced
        return made

    def __matmul__(self, taps: RealArray) -> RealArray:
        return np.concatenate([self[rows] @ taps for rows in pieces(self.shape[0])])


def pieces(n_rows: int) -> list[slice]:
    """Rows of a long record that are worked on together."""
    return [slice(begin, begin + _PIECE) for begin in range(0, n_rows, _PIECE)]


@dataclass(frozen=True, eq=False)
class RegressionBlock:
    """Rows of one record: nuisance (T,n), regressors F (T,p), kernel columns Psi (T,L), output y (T,)."""

    nuisance: RealArray
    regressors: RealArray
    kernel: RealArray | Delays
    output: RealArray


@dataclass(frozen=True, eq=False)
class ReducedRegression:
    """[F Psi y] after projecting the nuisance out and QR: the sufficient statistics.

    r11 (p,p) upper triangular, r12 (p,L), r1 (p,), r22 (L,L), z (L,), rest = squared norm of the part of y
    outside all columns, n_rows = rows minus nuisance rank. kept (p,): columns of F, of n_columns, that these
    records can tell from the others; the coefficients of those left out are zero.
    """

    r11: RealArray
    r12: RealArray
    r1: RealArray
    r22: RealArray
    z: RealArray
    rest: float
    n_rows: int
    kept: npt.NDArray[np.intp]
    n_columns: int

    @property
    def n_regressors(self) -> int:
        return int(self.r1.size)

    @property
    def fir_length(self) -> int:
        return int(self.z.size)

    @property
    def degrees_of_freedom(self) -> int:
        """nu = N - p, with the nuisance already taken off N."""
        return self.n_rows - self.n_regressors


@dataclass(frozen=True, eq=False)
class KernelPosterior:
    """Gaussian of theta and eta: eta = kernel_mean + kernel_factor w', theta = R11^-1 (r1 - R12 eta +
    sqrt(noise_variance) w); w, w' standard normal.

    kernel_mean (L,), kernel_factor (L,L'): conditional on the data. alpha, lam: those of largest
    weight; probability_no_remainder: weight on alpha = 0; log_evidence: of the best pair relative to it.
    """

    kernel_mean: RealArray
    kernel_factor: RealArray
    noise_variance: float
    alpha: float
    lam: float
    probability_no_remainder: float
    log_evidence: float


def nuisance_basis(nuisance: RealArray) -> RealArray:
    """Orthonormal columns (T,r) spanning the nuisance columns (T,n), nearly dependent ones dropped."""
    if nuisance.shape[1] == 0:
        return nuisance
    length = np.linalg.norm(nuisance, axis=0)
    scaled = np.asarray(nuisance[:, length > 0] / length[length > 0], dtype=np.float64)
    if scaled.shape[1] == 0:
        return scaled
    q, r, _ = qr(scaled, mode="economic", pivoting=True)
    rank = int(np.count_nonzero(np.abs(np.diag(r)) > RANK))
    return np.asarray(q[:, :rank])


@dataclass(frozen=True, eq=False)
class StackedBlocks:
    """Triangle of p regressors, `length` kernel columns and the output of n_rows rows."""

    triangle: RealArray
    n_rows: int
    p: int
    length: int


def reduce_regression(blocks: Iterable[RegressionBlock]) -> ReducedRegression:
    """One QR for all records: each block, its nuisance projected out, is stacked under the last triangle.

    Cost O(N (p + L)^2), memory that of the largest block's F and a piece of its Psi. Raises ValueError when
    rows do not exceed p + L or the input does not excite a regressor.
    """
    return reduce_stacked(stack_blocks(blocks))


def stack_blocks(blocks: Iterable[RegressionBlock], upon: StackedBlocks | None = None) -> StackedBlocks:
    """The triangle of blocks, and of those already stacked. Raises ValueError where there are none."""
    triangle: RealArray | None = None
    n_rows = p = length = 0
    if upon is not None:
        triangle, n_rows, p, length = upon.triangle, upon.n_rows, upon.p, upon.length
    for block in blocks:
        p, length = block.regressors.shape[1], block.kernel.shape[1]
        basis = nuisance_basis(block.nuisance)
        # The nuisance as first columns: below its rows the triangle is orthogonal to it.
        rank = basis.shape[1]
        upper = np.zeros((0, rank + p + length + 1))
        for rows in pieces(block.output.size):
            piece = [basis[rows], block.regressors[rows], block.kernel[rows], block.output[rows]]
            stacked = np.column_stack(piece)
            upper = triangle_of(np.vstack([upper, stacked]) if len(upper) else stacked)
        upper = upper[rank : rank + p + length + 1, rank:]
        n_rows += block.output.size - rank
        triangle = upper if triangle is None else triangle_of(np.vstack([triangle, upper]))
    if triangle is None:
        raise ValueError("need at least one record")
    return StackedBlocks(triangle, n_rows, p, length)


def reduce_stacked(stacked: StackedBlocks) -> ReducedRegression:
    """Raises ValueError as `reduce_regression`."""
    triangle, n_rows, p, length = stacked.triangle, stacked.n_rows, stacked.p, stacked.length
    if n_rows <= p + length + 1:
        raise ValueError(
            f"{n_rows} usable samples do not determine {p} regressors and {length} kernel coefficients: "
            "give a longer record or a smaller fir_length"
        )
    own = np.linalg.norm(triangle[:p, :p], axis=0)
    if np.any(own == 0):
        raise ValueError(f"the input does not excite regressor {int(np.argmax(own == 0)) + 1} of {own.size}")
    # Columns that are not, to rounding, combinations of earlier ones.
    kept = np.flatnonzero(np.abs(np.diag(triangle[:p, :p])) > RANK * own)
    if kept.size < p:
        columns = np.concatenate([kept, np.arange(p, p + length + 1)])
        triangle = triangle_of(triangle[:, columns])
    q = kept.size
    return ReducedRegression(
        r11=np.triu(triangle[:q, :q]),
        r12=triangle[:q, q:-1],
        r1=triangle[:q, -1],
        r22=np.triu(triangle[q:-1, q:-1]),
        z=triangle[q:-1, -1],
        rest=float(triangle[-1, -1] ** 2),
        n_rows=n_rows,
        kept=kept,
        n_columns=p,
    )


def triangle_of(columns: RealArray) -> RealArray:
    """R (n,n) of the QR decomposition of columns (T,n); rows of zeros where T < n. LAPACK's recursive
    decomposition: several times faster than `qr` of NumPy and SciPy on matrices this narrow."""
    n_rows, n = columns.shape
    width = min(_PANEL, n_rows, n)
    packed, _, info = lapack.dgeqrt(width, np.asfortranarray(columns), overwrite_a=1)
    if info != 0:
        raise ArithmeticError(f"dgeqrt returned {info}")
    upper = np.zeros((n, n))
    upper[: min(n_rows, n)] = np.triu(packed[:n])
    return upper


def tc_factor(lam: float, length: int) -> RealArray:
    """B (L,L) with (B B^T)_ij = lam^max(i,j), i, j = 1..L: the tuned/correlated kernel of unit alpha."""
    k = np.arange(1, length + 1, dtype=np.float64)
    step = lam**k * (1 - lam)
    step[-1] = lam**length
    return np.asarray(np.triu(np.ones((length, length))) * np.sqrt(step))


def alternating_factor(lam: float, length: int) -> RealArray:
    """The same for taps of alternating sign: a remainder near the Nyquist frequency, where `tc_factor` has
    least."""
    return np.asarray((-1.0) ** np.arange(length)[:, None] * tc_factor(lam, length))


def exponential_factor(lam: float, length: int) -> RealArray:
    """B (L,L) with B B^T = diag(lam^k), k = 1..L: the prior of the classical recipe, alike over frequency."""
    return np.diag(np.sqrt(lam ** np.arange(1, length + 1, dtype=np.float64)))


@dataclass(frozen=True, eq=False)
class KernelSpectrum:
    """Singular value decomposition of R22 B for one kernel shape: every alpha then costs O(L).

    Of the L taps the first n are kept, which have not died out; R22 and B are upper triangular. axes (n,n) =
    B V, singular d (n,), projected U^T z (n,), outside = squared norm of the rest of z.
    """

    lam: float
    length: int
    axes: RealArray
    singular: RealArray
    projected: RealArray
    outside: float


def kernel_spectrum(reduced: ReducedRegression, lam: float, factor: RealArray) -> KernelSpectrum:
    """For an upper triangular factor B (L,L) whose columns die out with the tap."""
    size = np.einsum("ij,ij->j", factor, factor)
    n = int(np.flatnonzero(size > _DIED_OUT * size.max())[-1]) + 1
    u, d, vt = svd(reduced.r22[:n, :n] @ factor[:n, :n], full_matrices=False, check_finite=False)
    return KernelSpectrum(
        lam=lam,
        length=factor.shape[0],
        axes=factor[:n, :n] @ vt.T,
        singular=d,
        projected=u.T @ reduced.z[:n],
        outside=float(reduced.z[n:] @ reduced.z[n:]),
    )


def restricted_log_likelihood(
    reduced: ReducedRegression, spectrum: KernelSpectrum, alpha: RealArray
) -> tuple[RealArray, RealArray]:
    """log L (up to a constant shared by all kernels) and s2, both (A,), for alpha (A,), C = s2 alpha B B^T.

    -2 log L = nu log s2 + log det M + nu, M = I + R22 Ct R22^T, s2 = (S + z^T M^-1 z) / nu.
    """
    gain = 1.0 + alpha[:, None] * spectrum.singular**2
    nu = reduced.degrees_of_freedom
    s2 = (reduced.rest + spectrum.outside + np.sum(spectrum.projected**2 / gain, axis=1)) / nu
    floor = np.finfo(np.float64).tiny
    return -0.5 * (nu * np.log(np.maximum(s2, floor)) + np.sum(np.log(gain), axis=1) + nu), s2


@dataclass(frozen=True, eq=False)
class KernelGrid:
    """Weights of all (lam, alpha) pairs and of alpha = 0, given the data."""

    spectra: tuple[KernelSpectrum, ...]
    prior: RealArray  # (A,), the same for all lam: K times its sum is 1
    alpha: RealArray  # (K, A)
    noise_variance: RealArray  # (K, A)
    log_likelihood: RealArray  # (K, A)
    noise_variance_none: float
    log_likelihood_none: float


def remainder_energies(degrees_of_freedom: int) -> tuple[RealArray, RealArray]:
    """Expected energies (A,) of what the poles leave out of the output, in noise variances, and their
    prior (A,): log-uniform up to what an order selection would have kept (4 ln nu), one tenth
    beyond."""
    edge = 4 * np.log(degrees_of_freedom)
    n = int(np.ceil(np.log(_LARGEST_ENERGY) / np.log(edge) * _SCALES))
    energy = edge ** (np.arange(n + 1) / _SCALES)
    visible = np.arange(n + 1) > _SCALES
    return energy, np.where(visible, _VISIBLE_SHARE / (n - _SCALES), (1 - _VISIBLE_SHARE) / (_SCALES + 1))


def evaluate_grid(
    reduced: ReducedRegression, spectra: Iterable[KernelSpectrum], energy: RealArray, prior: RealArray
) -> KernelGrid:
    """Restricted likelihood over kernel shapes, all alike, and alpha = energy / trace(R22 B B^T R22^T), for
    energy (A,) of the remainder in the output, in noise variances, with prior (A,)."""
    spectra = tuple(spectra)
    alpha = np.stack([energy / max(float(s.singular @ s.singular), 1e-300) for s in spectra])
    values = [restricted_log_likelihood(reduced, s, a) for s, a in zip(spectra, alpha, strict=True)]
    none, s2_none = restricted_log_likelihood(reduced, spectra[0], np.zeros(1))
    return KernelGrid(
        spectra=spectra,
        prior=prior / len(spectra),
        alpha=alpha,
        log_likelihood=np.stack([value[0] for value in values]),
        noise_variance=np.stack([value[1] for value in values]),
        noise_variance_none=float(s2_none[0]),
        log_likelihood_none=float(none[0]),
    )


def kernel_grid(
    reduced: ReducedRegression, shapes: Iterable[Callable[[float, int], RealArray]], *, order_given: bool
) -> KernelGrid:
    """`evaluate_grid` over twelve decays of every shape, and scales: those of `remainder_energies` where
    the order was given, else log-uniform from far below the noise on, for a choice from the data leaves
    little."""
    length = reduced.fir_length
    # Decay times from less than a sample to where the kernel has died out (e^-6 in variance) at its last tap.
    decays = np.exp(-1.0 / np.geomspace(0.7, max(length / 6.0, 1.0), 12)).tolist()
    spectra = [kernel_spectrum(reduced, lam, shape(lam, length)) for shape in shapes for lam in decays]
    if order_given:
        return evaluate_grid(reduced, spectra, *remainder_energies(reduced.degrees_of_freedom))
    energy = np.geomspace(1e-2, 1e10, 49)
    return evaluate_grid(reduced, spectra, energy, np.full(energy.size, 1 / energy.size))


def total_log_evidence(grid: KernelGrid, prior_no_remainder: float) -> float:
    """log of the likelihood averaged over the prior of `grid_weights`."""
    top = max(float(grid.log_likelihood.max()), grid.log_likelihood_none)
    mean = (1 - prior_no_remainder) * float(np.sum(grid.prior * np.exp(grid.log_likelihood - top)))
    return top + float(np.log(mean + prior_no_remainder * np.exp(grid.log_likelihood_none - top)))


def grid_weights(grid: KernelGrid, prior_no_remainder: float) -> tuple[RealArray, float]:
    """Posterior weights (K,A) of the grid points and of alpha = 0."""
    log_grid = grid.log_likelihood + np.log((1 - prior_no_remainder) * grid.prior)
    log_none = grid.log_likelihood_none + (np.log(prior_no_remainder) if prior_no_remainder > 0 else -np.inf)
    top = max(float(log_grid.max()), log_none)
    weights, none = np.exp(log_grid - top), float(np.exp(log_none - top))
    total = float(weights.sum()) + none
    return weights / total, none / total


def conditional_posterior(grid: KernelGrid, weights: RealArray, weight_none: float) -> KernelPosterior:
    """Mean and covariance of eta given the data, averaged over the grid (the spread of the means included).

    For one pair: m = Ct R22^T M^-1 z = alpha B V diag(d / (1 + alpha d^2)) U^T z and
    s2 V = s2 alpha B V diag(1 / (1 + alpha d^2)) V^T B^T.
    """
    length = grid.spectra[0].length
    mean, covariance = np.zeros(length), np.zeros((length, length))
    means: list[tuple[RealArray, RealArray]] = []
    for spectrum, alpha, s2, weight in zip(
        grid.spectra, grid.alpha, grid.noise_variance, weights, strict=True
    ):
        # Grid points that together weigh less than a millionth are not worth their arithmetic.
        kept = weight > 1e-6 / weights.size
        if not np.any(kept):
            continue
        a, w = alpha[kept, None], weight[kept]
        gain = 1.0 + a * spectrum.singular**2
        n = spectrum.singular.size
        of_point = np.zeros((w.size, length))
        of_point[:, :n] = (a * spectrum.singular / gain * spectrum.projected) @ spectrum.axes.T
        means.append((w, of_point))
        mean += w @ of_point
        covariance[:n, :n] += (spectrum.axes * ((w * s2[kept]) @ (a / gain))) @ spectrum.axes.T
    if means:
        apart = np.concatenate([np.sqrt(w)[:, None] * (of_point - mean) for w, of_point in means])
        covariance += apart.T @ apart
    covariance += weight_none * np.outer(mean, mean)
    noise = weight_none * grid.noise_variance_none + float(np.sum(weights * grid.noise_variance))
    best = np.unravel_index(int(np.argmax(weights)), weights.shape)
    return KernelPosterior(
        kernel_mean=mean,
        kernel_factor=symmetric_factor(covariance),
        noise_variance=noise,
        alpha=float(grid.alpha[best]) if np.any(weights) else 0.0,
        lam=grid.spectra[best[0]].lam,
        probability_no_remainder=weight_none,
        log_evidence=float(grid.log_likelihood[best] - grid.log_likelihood_none),
    )


def embedding_report(
    method: str, reduced: ReducedRegression, kernel: KernelPosterior, **more: Any
) -> EmbeddingReport:
    """What a reader can judge the posterior by; `more` are the fields that neither of the two knows."""
    return EmbeddingReport(
        method=method,
        noise_std=float(np.sqrt(kernel.noise_variance)),
        alpha=kernel.alpha,
        lam=kernel.lam,
        probability_no_remainder=kernel.probability_no_remainder,
        log_evidence=kernel.log_evidence,
        n_rows=reduced.n_rows,
        n_regressors=reduced.n_regressors,
        **more,
    )


def joint_factor(reduced: ReducedRegression, posterior: KernelPosterior) -> tuple[RealArray, RealArray]:
    """Mean (P+L,) and covariance factor (P+L, P') of (theta, eta), P counting the columns left out too."""
    p, length = reduced.n_regressors, posterior.kernel_mean.size
    scale = np.linalg.norm(reduced.r11, axis=0)
    right_hand = np.column_stack(
        [
            reduced.r1 - reduced.r12 @ posterior.kernel_mean,
            np.sqrt(posterior.noise_variance) * np.eye(p),
            -reduced.r12 @ posterior.kernel_factor,
        ]
    )
    solved = solve_triangular(reduced.r11 / scale, right_hand, check_finite=False) / scale[:, None]
    mean = np.zeros(reduced.n_columns + length)
    factor = np.zeros((mean.size, p + posterior.kernel_factor.shape[1]))
    mean[reduced.kept], factor[reduced.kept] = solved[:, 0], solved[:, 1:]
    mean[reduced.n_columns :], factor[reduced.n_columns :, p:] = (
        posterior.kernel_mean,
        posterior.kernel_factor,
    )
    return mean, factor


def by_class(rest: RealArray, classes: IntArray) -> RealArray:
    """What is left of the last rows (T,), in a column for each class of the rows."""
    return np.where(classes[-rest.size :, None] == np.arange(1 + classes.max()), rest[:, None], 0.0)


def sandwiched(factor: RealArray, scores: RealArray) -> RealArray:
    """Factor (P,P') of a covariance, wider where scores (M,P') of classes of rows, in its unit normals, are
    larger than the noise makes them: H^-1 S H^-1 with S their sum of squares (White, Econometrica 50(1),
    1982), never below what the noise leaves open."""
    size, along = np.linalg.eigh(scores.T @ scores * len(scores) / (len(scores) - 1))
    return np.asarray(factor @ (along * np.sqrt(np.maximum(size, 1.0))) @ along.T)


def symmetric_factor(covariance: RealArray) -> RealArray:
    """Factor S (L,L') with S S^T = covariance, directions below rounding left out."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    kept = values > values[-1] * 1e-15 if values[-1] > 0 else np.zeros(values.size, dtype=np.bool_)
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))
