"""Stochastic embedding on matrices: one QR reduction, restricted likelihood, posterior of the kernel.

y = N nu + F theta + Psi eta + v with flat nu (nuisance) and theta, eta ~ N(0, s2 Ct), Ct = alpha B B^T, v ~
N(0, s2 I) (Goodwin, Gevers and Ninness, IEEE TAC 37(7), 1992). `reduce_regression` brings everything that
depends on the data into a triangle of the size of the parameters. `kernel_grid` evaluates the restricted
likelihood over decays and scales of the kernel, `grid_weights` weighs them against no kernel at all,
`conditional_posterior` averages eta over the weights, and `joint_factor` adds theta.

Neglected: the uncertainty of s2, which is taken at its estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import lapack, qr, solve_triangular, svd

from ident.basis.posterior import EmbeddingReport
from ident.data.arrays import IntArray, RealArray

# Rows of a record that stand in memory with all their columns: some hundred megabytes for 200 columns.
_PIECE = 65536
# Columns of the QR decomposition that are done at a time: LAPACK's usual block. It acts on speed and
# rounding.
_PANEL = 32
# Columns of unit length whose part orthogonal to the earlier ones is below this say what those say. A hundred
# times smaller or larger, no ellipse of twenty simulated arms moved by 1 %.
RANK = 1e-10
# Share of the largest prior variance below which a tap is none: rounding, even ten orders above the noise.
# From 1e-12 to 1e-34 no ellipse of twenty simulated arms moved by 1 %.
_DIED_OUT = 1e-17
# Decays of each kernel shape that are tried, evenly in the logarithm of their time constant. Halved or
# doubled, no ellipse of twenty simulated arms moved by more than 3 %.
_N_DECAYS = 12
# Least time constant of a kernel's variance, samples: less than one, so that one tap alone is among them.
# Halved or doubled, no ellipse of eight simulated arms moved by more than 3 %.
_SHORTEST_DECAY = 0.7
# Time constants in which a kernel dies out: e^-6 of its variance is left at its last tap at most. Halved or
# doubled, no ellipse of eight simulated arms moved by more than 2 %.
_DECAYS_PER_KERNEL = 6.0
# Energies of the remainder that are tried where the order came from the data, in noise variances: from far
# below the noise, which is none, to a remainder of 100 dB; four to a decade. With two or eight to a decade no
# ellipse of eight simulated arms moved by 1 %.
_ENERGIES = np.geomspace(1e-2, 1e10, 49)
# Steps of the energy from one noise variance up to what an order selection keeps, where the order was given.
# Halved or doubled, the median ellipse of twenty simulated arms moved by less than 1 %, their coverage by
# .1 %.
_SCALES = 6
# Probability that a remainder is larger than an order selection would have let pass, where the order was
# given. Halved or doubled, the median ellipse of twenty simulated arms moved by less than 1 %, their coverage
# by .1 %.
_VISIBLE_SHARE = 0.1
# Largest energy of such a remainder, noise variances: 120 dB. From 1e6 to 1e24 no ellipse of
# twenty simulated arms moved by 1 %.
_LARGEST_ENERGY = 1e12
# Weight, times the number of grid points, below which a point is left out of averages: together less than a
# millionth. Ten times less or more, no ellipse of eight simulated arms moved by 1 %.
_NEGLIGIBLE_WEIGHT = 1e-6
# Least trace by which an energy is divided: a kernel that the input does not excite has scale infinity.
_SMALLEST_TRACE = 1e-300
# Share of the largest eigenvalue of a covariance below which a direction is rounding. From 1e-17 to
# 1e-13 no ellipse of eight simulated arms moved by 1 %.
_ROUNDING = 1e-15


@dataclass(frozen=True, eq=False)
class Delays:
    """Matrix (T - begin, L) of an input one, two, ... L samples ago, made where its rows are asked for.

    It takes slices of rows and products from the right, as an array does.

    Attributes
    ----------
    input : ndarray, shape (T,)
        Taken as zero before the record.
    length : int
        L, number of columns, at least 1.
    first : ndarray, shape (n, L)
        In place of the matrix's first n rows, counted with those left out.
    begin : int
        Rows before that one are left out; at most T. Nothing is checked.
    """

    input: RealArray
    length: int
    first: RealArray
    begin: int = 0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns, as of an array."""
        return self.input.size - self.begin, self.length

    def __getitem__(self, rows: slice) -> RealArray:
        """Rows of the matrix, (n, L), as of an array; an empty slice gives (0, L), a step is ignored."""
        start, stop, _ = rows.indices(self.shape[0])
        begin = self.begin + start
        end = self.begin + stop
        if end <= begin:
            return np.zeros((0, self.length))
        known = self.input[max(begin - self.length, 0) : end - 1]
        n_before_record = max(self.length - begin, 0)
        padded = np.concatenate([np.zeros(n_before_record), known])
        # The newest sample stands first.
        made = sliding_window_view(padded, self.length)[:, ::-1].copy()
        replaced = self.first[begin:end]
        made[: len(replaced)] = replaced
        return made

    def __matmul__(self, taps: RealArray) -> RealArray:
        """Output (T - begin,) of taps (L,). Raises ValueError (numpy's) for another number of taps."""
        # No rows are no pieces, which numpy would refuse to join: blocks have at least one row.
        return np.concatenate([self[rows] @ taps for rows in pieces(self.shape[0])])


def pieces(n_rows: int) -> list[slice]:
    """Slices of `_PIECE` rows that together are n_rows: what of a long record is worked on together.

    The last one may reach beyond n_rows, which slicing ignores; none for 0.
    """
    return [slice(begin, begin + _PIECE) for begin in range(0, n_rows, _PIECE)]


@dataclass(frozen=True, eq=False)
class RegressionBlock:
    """Whitened rows of one record: nuisance (T,n), regressors F (T,p), kernel Psi (T,L), output y (T,).

    The output is in its units, all columns in output units per unit of their coefficient. Numbers of rows are
    not checked here: numpy refuses to stack unequal ones.
    """

    nuisance: RealArray
    regressors: RealArray
    kernel: RealArray | Delays
    output: RealArray


@dataclass(frozen=True, eq=False)
class ReducedRegression:
    """Triangle of [F Psi y] after projecting the nuisance out: the sufficient statistics.

    `reduce_stacked` makes and checks it. Entries are in output units, per unit of a coefficient where there
    is one.

    Attributes
    ----------
    r11 : ndarray, shape (p, p)
        Upper triangular, of F.
    r12 : ndarray, shape (p, L)
        Beside r11, of Psi.
    r1 : ndarray, shape (p,)
        Of y, beside r11.
    r22 : ndarray, shape (L, L)
        Upper triangular, of Psi orthogonal to F.
    z : ndarray, shape (L,)
        Of y, beside r22.
    unexplained : float
        Squared norm of the part of y outside all columns, output units squared.
    n_rows : int
        Rows minus the rank of the nuisance.
    in_use : ndarray, shape (p,)
        Columns of F, of n_columns, that these records can tell from the others; the coefficients of those
        left out are zero.
    n_columns : int
        Columns of F before any was left out.
    """

    r11: RealArray
    r12: RealArray
    r1: RealArray
    r22: RealArray
    z: RealArray
    unexplained: float
    n_rows: int
    in_use: npt.NDArray[np.intp]
    n_columns: int

    @property
    def n_regressors(self) -> int:
        """p, columns of F in use."""
        return int(self.r1.size)

    @property
    def fir_length(self) -> int:
        """L, taps of the kernel."""
        return int(self.z.size)

    @property
    def degrees_of_freedom(self) -> int:
        """nu = N - p, with the nuisance already taken off N."""
        return self.n_rows - self.n_regressors


@dataclass(frozen=True, eq=False)
class KernelPosterior:
    """Gaussian of theta and eta, conditional on the data.

    eta = kernel_mean + kernel_factor w', theta = R11^-1 (r1 - R12 eta + sqrt(noise_variance) w); w, w'
    standard normal. `conditional_posterior` makes it; nothing is checked.

    Attributes
    ----------
    kernel_mean : ndarray, shape (L,)
    kernel_factor : ndarray, shape (L, L')
    noise_variance : float
        Output units squared.
    alpha, lam : float
        Scale, and decay per sample, of largest weight.
    probability_no_remainder : float
        Weight on alpha = 0.
    log_evidence : float
        Log likelihood of the best pair less that of alpha = 0.
    """

    kernel_mean: RealArray
    kernel_factor: RealArray
    noise_variance: float
    alpha: float
    lam: float
    probability_no_remainder: float
    log_evidence: float


def nuisance_basis(nuisance: RealArray) -> RealArray:
    """Orthonormal columns (T,r) spanning the nuisance (T,n), nearly dependent ones dropped (`RANK`).

    r = 0 where there are no columns, or all are zero. A column with NaN or infinity is not seen as one: it is
    dropped or spoils the others; nuisances come from record lengths and poles, which are finite.
    """
    if nuisance.shape[1] == 0:
        return nuisance
    length = np.linalg.norm(nuisance, axis=0)
    nonzero = length > 0
    scaled = np.asarray(nuisance[:, nonzero] / length[nonzero], dtype=np.float64)
    if scaled.shape[1] == 0:
        return scaled
    q, r, _ = qr(scaled, mode="economic", pivoting=True)
    rank = int(np.count_nonzero(np.abs(np.diag(r)) > RANK))
    return np.asarray(q[:, :rank])


@dataclass(frozen=True, eq=False)
class StackedBlocks:
    """Square triangle of p regressors, `length` kernel columns and the output of n_rows rows.

    triangle (p + length + 1, p + length + 1): upper, columns in this order. n_rows: rows less the rank of the
    nuisance, over all blocks.
    """

    triangle: RealArray
    n_rows: int
    p: int
    length: int


def reduce_regression(blocks: Iterable[RegressionBlock]) -> ReducedRegression:
    """Sufficient statistics of all records by one QR: each block is stacked under the last triangle.

    Parameters
    ----------
    blocks : iterable of RegressionBlock
        One per record, with the same columns but the nuisance, which is projected out of each.

    Returns
    -------
    ReducedRegression

    Raises
    ------
    ValueError
        When rows do not exceed p + L, or the input does not excite a regressor, or there is no block.

    Notes
    -----
    Cost O(N (p + L)^2), memory that of the largest block's F and a piece of its Psi.
    """
    return reduce_stacked(stack_blocks(blocks))


def stack_blocks(blocks: Iterable[RegressionBlock], upon: StackedBlocks | None = None) -> StackedBlocks:
    """Triangle of blocks, and of those already stacked.

    Parameters
    ----------
    blocks : iterable of RegressionBlock
    upon : StackedBlocks, optional
        With the same columns.

    Returns
    -------
    StackedBlocks
        NaN of a block stays in the triangle.

    Raises
    ------
    ValueError
        Where there are neither blocks nor `upon`; numpy's, where blocks differ in numbers of columns.
    """
    triangle: RealArray | None = None
    n_rows = 0
    p = 0
    length = 0
    if upon is not None:
        triangle = upon.triangle
        n_rows = upon.n_rows
        p = upon.p
        length = upon.length
    for block in blocks:
        p = block.regressors.shape[1]
        length = block.kernel.shape[1]
        n_columns = p + length + 1
        basis = nuisance_basis(block.nuisance)
        # The nuisance as first columns: below its rows the triangle is orthogonal to it.
        rank = basis.shape[1]
        upper = np.zeros((0, rank + n_columns))
        for rows in pieces(block.output.size):
            # In the order in which LAPACK reads it, under the triangle of the pieces before.
            known = len(upper)
            output = block.output[rows]
            stacked = np.empty((known + output.size, rank + n_columns), order="F")
            stacked[:known] = upper
            stacked[known:, :rank] = basis[rows]
            stacked[known:, rank : rank + p] = block.regressors[rows]
            stacked[known:, rank + p : -1] = block.kernel[rows]
            stacked[known:, -1] = output
            upper = triangle_of(stacked)
        upper = upper[rank : rank + n_columns, rank:]
        n_rows += block.output.size - rank
        if triangle is not None:
            upper = triangle_of(np.vstack([triangle, upper]))
        triangle = upper
    if triangle is None:
        raise ValueError("need at least one record")
    return StackedBlocks(triangle, n_rows, p, length)


def reduce_stacked(stacked: StackedBlocks) -> ReducedRegression:
    """Sufficient statistics of stacked blocks; regressors that say what earlier ones say are left out.

    A column counts as such where less than `RANK` of its length is orthogonal to those before it.

    Raises
    ------
    ValueError
        When rows do not exceed p + L + 1, or a regressor is zero in all of them. NaN is not refused: columns
        with it are left out.
    """
    triangle = stacked.triangle
    p = stacked.p
    length = stacked.length
    if stacked.n_rows <= p + length + 1:
        raise ValueError(
            f"{stacked.n_rows} usable samples do not determine {p} regressors and {length} kernel "
            "coefficients: give a longer record or a smaller fir_length"
        )
    of_regressors = triangle[:p, :p]
    size = np.linalg.norm(of_regressors, axis=0)
    if np.any(size == 0):
        raise ValueError(
            f"the input does not excite regressor {int(np.argmax(size == 0)) + 1} of {size.size}"
        )

    # Columns that are not, to rounding, combinations of earlier ones: what the diagonal has is orthogonal.
    columns_in_use = np.flatnonzero(np.abs(np.diag(of_regressors)) > RANK * size)
    q = columns_in_use.size
    if q < p:
        columns = np.concatenate([columns_in_use, np.arange(p, p + length + 1)])
        triangle = triangle_of(triangle[:, columns])
    return ReducedRegression(
        r11=np.triu(triangle[:q, :q]),
        r12=triangle[:q, q:-1],
        r1=triangle[:q, -1],
        r22=np.triu(triangle[q:-1, q:-1]),
        z=triangle[q:-1, -1],
        unexplained=float(triangle[-1, -1] ** 2),
        n_rows=stacked.n_rows,
        in_use=columns_in_use,
        n_columns=p,
    )


def triangle_of(columns: RealArray) -> RealArray:
    """R (n,n) of the QR decomposition of columns (T,n); rows of zeros where T < n.

    By LAPACK's recursive decomposition: several times faster than `qr` of NumPy and SciPy on matrices this
    narrow. The diagonal may have either sign. NaN stays in its column and those behind it. Raises LAPACK's
    own error for no rows or no columns, and ArithmeticError where it refuses anything else.
    """
    n_rows, n = columns.shape
    width = min(_PANEL, n_rows, n)
    packed, _, info = lapack.dgeqrt(width, np.asfortranarray(columns), overwrite_a=1)
    if info != 0:
        raise ArithmeticError(f"dgeqrt returned {info}")
    upper = np.zeros((n, n))
    upper[: min(n_rows, n)] = np.triu(packed[:n])
    return upper


def tc_factor(lam: float, length: int) -> RealArray:
    """B (L,L) with (B B^T)_ij = lam^max(i,j), i, j = 1..L: the tuned/correlated kernel of unit alpha.

    lam: decay of the variance per tap, between 0 and 1 (Chen, Ohlsson and Ljung, Automatica 48(8), 2012);
    above 1, not checked, B has NaN. length: L, at least 1.
    """
    k = np.arange(1, length + 1, dtype=np.float64)
    step = lam**k * (1 - lam)
    step[-1] = lam**length
    ones = np.triu(np.ones((length, length)))
    return np.asarray(ones * np.sqrt(step))


def alternating_factor(lam: float, length: int) -> RealArray:
    """B (L,L) of the tuned/correlated kernel (`tc_factor`) with taps of alternating sign.

    Its remainder has most power near the Nyquist frequency, where that of `tc_factor` has least. lam, length:
    those of `tc_factor`.
    """
    signs = (-1.0) ** np.arange(length)[:, None]
    return np.asarray(signs * tc_factor(lam, length))


def exponential_factor(lam: float, length: int) -> RealArray:
    """B (L,L) with B B^T = diag(lam^k), k = 1..L: the prior of the classical recipe, alike over frequency.

    lam: decay of the variance per tap, between 0 and 1, not checked. length: L. The recipe is that of
    Goodwin, Gevers and Ninness (module text).
    """
    k = np.arange(1, length + 1, dtype=np.float64)
    return np.diag(np.sqrt(lam**k))


@dataclass(frozen=True, eq=False)
class KernelSpectrum:
    """Singular value decomposition U diag(d) V^T of R22 B for one kernel shape: every alpha then costs O(L).

    Of the L taps the first n are in use, which have not died out; R22 and B are upper triangular.

    Attributes
    ----------
    lam : float
        Decay of the kernel's variance per tap.
    length : int
        L.
    axes : ndarray, shape (n, n)
        B V.
    singular : ndarray, shape (n,)
        d.
    projected : ndarray, shape (n,)
        U^T z.
    outside : float
        Squared norm of the other entries of z.
    """

    lam: float
    length: int
    axes: RealArray
    singular: RealArray
    projected: RealArray
    outside: float


def kernel_spectrum(reduced: ReducedRegression, lam: float, factor: RealArray) -> KernelSpectrum:
    """Singular value decomposition for an upper triangular factor B (L,L) whose columns die out with the tap.

    reduced: of it r22 (L, L) and z (L,), the kernel's share of the regression. lam: decay of the kernel's
    variance per tap, for the report alone. Not checked: B of another size (numpy refuses it), or all zero
    (IndexError); the shapes of this file are neither.
    """
    size = np.einsum("ij,ij->j", factor, factor)
    alive = np.flatnonzero(size > _DIED_OUT * size.max())
    n = int(alive[-1]) + 1
    alive_factor = factor[:n, :n]
    u, d, vt = svd(reduced.r22[:n, :n] @ alive_factor, full_matrices=False, check_finite=False)
    return KernelSpectrum(
        lam=lam,
        length=factor.shape[0],
        axes=alive_factor @ vt.T,
        singular=d,
        projected=u.T @ reduced.z[:n],
        outside=float(reduced.z[n:] @ reduced.z[n:]),
    )


def restricted_log_likelihood(
    reduced: ReducedRegression, spectrum: KernelSpectrum, alpha: RealArray
) -> tuple[RealArray, RealArray]:
    """Restricted log likelihood and s2, both (A,), for scales alpha (A,) of the kernel C = s2 alpha B B^T.

    Parameters
    ----------
    reduced : ReducedRegression
        Its degrees of freedom and the unexplained part of the output; the rest is in `spectrum`.
    spectrum : KernelSpectrum
        Of the kernel's shape B.
    alpha : ndarray, shape (A,)
        Prior variance of the first tap in noise variances; 0: no kernel. Negative ones are not checked.

    Returns
    -------
    log_likelihood : ndarray, shape (A,)
        Up to a constant that all kernels share; s2 is at its maximum.
    s2 : ndarray, shape (A,)
        Noise variance, output units squared.

    Notes
    -----
    -2 log L = nu log s2 + log det M + nu, M = I + R22 Ct R22^T, s2 = (S + z^T M^-1 z) / nu.
    """
    nu = reduced.degrees_of_freedom
    # Eigenvalues of M.
    gain = 1.0 + alpha[:, None] * spectrum.singular**2
    weighted = np.sum(spectrum.projected**2 / gain, axis=1)
    s2 = (reduced.unexplained + spectrum.outside + weighted) / nu
    # A record that is explained to the last digit has a logarithm, too.
    floor = np.finfo(np.float64).tiny
    log_s2 = np.log(np.maximum(s2, floor))
    log_det = np.sum(np.log(gain), axis=1)
    return -0.5 * (nu * log_s2 + log_det + nu), s2


@dataclass(frozen=True, eq=False)
class KernelGrid:
    """Restricted likelihood of K kernels (shape and decay) at A scales each, and of none (alpha = 0).

    Attributes
    ----------
    spectra : tuple of KernelSpectrum
        K.
    prior : ndarray, shape (A,)
        Of a scale, the same for all kernels: K times its sum is 1.
    alpha : ndarray, shape (K, A)
        Prior variance of the first tap in noise variances.
    noise_variance : ndarray, shape (K, A)
        Output units squared.
    log_likelihood : ndarray, shape (K, A)
    noise_variance_none, log_likelihood_none : float
        Without a kernel.
    """

    spectra: tuple[KernelSpectrum, ...]
    prior: RealArray
    alpha: RealArray
    noise_variance: RealArray
    log_likelihood: RealArray
    noise_variance_none: float
    log_likelihood_none: float


class RemainderEnergies(NamedTuple):
    """Energies of what the poles leave out of the output, and how likely each is beforehand.

    energy (A,): in noise variances; prior (A,): its sum is 1.
    """

    energy: RealArray
    prior: RealArray


def remainder_energies(degrees_of_freedom: int) -> RemainderEnergies:
    """Energies of a remainder where the order was given, log-uniform up to what an order selection keeps.

    That is 4 ln nu noise variances, nu = degrees_of_freedom; a tenth of the prior lies beyond. nu has to be
    at least 2, so that this is above 1, which is not checked: `reduce_stacked` leaves at least 3.
    """
    # A pair of poles, four numbers, is kept where it lowers nu ln J by more than ln nu for each.
    edge = 4 * np.log(degrees_of_freedom)
    n = int(np.ceil(np.log(_LARGEST_ENERGY) / np.log(edge) * _SCALES))
    index = np.arange(n + 1)
    energy = edge ** (index / _SCALES)
    visible = index > _SCALES
    prior_visible = _VISIBLE_SHARE / (n - _SCALES)
    prior_hidden = (1 - _VISIBLE_SHARE) / (_SCALES + 1)
    return RemainderEnergies(energy, np.where(visible, prior_visible, prior_hidden))


def evaluate_grid(
    reduced: ReducedRegression, spectra: Iterable[KernelSpectrum], energy: RealArray, prior: RealArray
) -> KernelGrid:
    """Restricted likelihood over kernel shapes, all alike beforehand, and energies of the remainder.

    Parameters
    ----------
    reduced : ReducedRegression
        That of the spectra.
    spectra : iterable of KernelSpectrum
        K, at least one (IndexError or ValueError of numpy else).
    energy : ndarray, shape (A,)
        Of the remainder in the output, in noise variances: alpha = energy / trace(R22 B B^T R22^T).
    prior : ndarray, shape (A,)
        Of each energy; its sum is 1, which is not checked.

    Returns
    -------
    KernelGrid
        A kernel that the input does not excite has a huge alpha and the likelihood of none.
    """
    spectra = tuple(spectra)
    traces = [float(spectrum.singular @ spectrum.singular) for spectrum in spectra]
    alpha = np.stack([energy / max(trace, _SMALLEST_TRACE) for trace in traces])
    log_likelihoods = []
    noise_variances = []
    for spectrum, scales in zip(spectra, alpha, strict=True):
        log_likelihood, noise_variance = restricted_log_likelihood(reduced, spectrum, scales)
        log_likelihoods.append(log_likelihood)
        noise_variances.append(noise_variance)
    log_none, variance_none = restricted_log_likelihood(reduced, spectra[0], np.zeros(1))
    return KernelGrid(
        spectra=spectra,
        prior=prior / len(spectra),
        alpha=alpha,
        log_likelihood=np.stack(log_likelihoods),
        noise_variance=np.stack(noise_variances),
        noise_variance_none=float(variance_none[0]),
        log_likelihood_none=float(log_none[0]),
    )


def kernel_grid(
    reduced: ReducedRegression, shapes: Iterable[Callable[[float, int], RealArray]], *, order_given: bool
) -> KernelGrid:
    """Restricted likelihood (`evaluate_grid`) over `_N_DECAYS` decays of every shape, and scales.

    Parameters
    ----------
    reduced : ReducedRegression
        Its kernel part gives the number of taps L, at least 1. Nothing is checked here.
    shapes : iterable of callable
        Decay and length to a factor B, as `tc_factor`.
    order_given : bool
        Somebody gave the order of the model: energies are those of `remainder_energies`. Else they are those
        of `_ENERGIES`, alike in the logarithm from far below the noise on: where the order was chosen from
        the data, little is left.

    Returns
    -------
    KernelGrid
    """
    length = reduced.fir_length
    # From less than a sample to where the kernel has died out at its last tap.
    longest = max(length / _DECAYS_PER_KERNEL, 1.0)
    time_constants = np.geomspace(_SHORTEST_DECAY, longest, _N_DECAYS)
    decays = np.exp(-1.0 / time_constants).tolist()
    spectra = [kernel_spectrum(reduced, lam, shape(lam, length)) for shape in shapes for lam in decays]
    if order_given:
        energy, prior = remainder_energies(reduced.degrees_of_freedom)
    else:
        energy = _ENERGIES
        prior = np.full(energy.size, 1 / energy.size)
    return evaluate_grid(reduced, spectra, energy, prior)


def total_log_evidence(grid: KernelGrid, prior_no_remainder: float) -> float:
    """Logarithm of the likelihood averaged over the prior of `grid_weights`, up to the grid's constant.

    prior_no_remainder: prior probability that the poles explain everything, from 0 to 1, not checked. NaN of
    the grid gives NaN.
    """
    top = max(float(grid.log_likelihood.max()), grid.log_likelihood_none)
    of_grid = float(np.sum(grid.prior * np.exp(grid.log_likelihood - top)))
    of_none = np.exp(grid.log_likelihood_none - top)
    mean = (1 - prior_no_remainder) * of_grid
    return top + float(np.log(mean + prior_no_remainder * of_none))


def grid_weights(grid: KernelGrid, prior_no_remainder: float) -> tuple[RealArray, float]:
    """Posterior weights (K,A) of the grid points, and the weight of no kernel; together they are 1.

    prior_no_remainder: prior probability that the poles explain everything, from 0 to below 1 (at 1, numpy
    warns of a logarithm of zero and all weight is on no kernel); not checked. NaN of the grid gives NaN.
    """
    log_grid = grid.log_likelihood + np.log((1 - prior_no_remainder) * grid.prior)
    log_prior_none = -np.inf
    if prior_no_remainder > 0:
        log_prior_none = np.log(prior_no_remainder)
    log_none = grid.log_likelihood_none + log_prior_none
    # Over the largest, so that no exponential overflows.
    top = max(float(log_grid.max()), log_none)
    weights = np.exp(log_grid - top)
    weight_none = float(np.exp(log_none - top))
    total = float(weights.sum()) + weight_none
    return weights / total, weight_none / total


def conditional_posterior(grid: KernelGrid, weights: RealArray, weight_none: float) -> KernelPosterior:
    """Mean and covariance of eta given the data, averaged over the grid, the spread of the means included.

    Parameters
    ----------
    grid : KernelGrid
    weights : ndarray, shape (K, A)
        Of the grid points (`grid_weights`).
    weight_none : float
        Of alpha = 0, where eta is zero. All weights together are 1, which is not checked; of weights that are
        NaN the covariance comes out empty.

    Returns
    -------
    KernelPosterior

    Notes
    -----
    For one pair (lam, alpha): m = Ct R22^T M^-1 z = alpha B V diag(d / (1 + alpha d^2)) U^T z and
    s2 V = s2 alpha B V diag(1 / (1 + alpha d^2)) V^T B^T.
    """
    length = grid.spectra[0].length
    mean = np.zeros(length)
    covariance = np.zeros((length, length))
    means_of_points: list[tuple[RealArray, RealArray]] = []
    for k, spectrum in enumerate(grid.spectra):
        # Grid points that together weigh less than a millionth are not worth their arithmetic.
        weighty = weights[k] > _NEGLIGIBLE_WEIGHT / weights.size
        if not np.any(weighty):
            continue
        alpha = grid.alpha[k][weighty, None]
        weight = weights[k][weighty]
        noise_variance = grid.noise_variance[k][weighty]
        gain = 1.0 + alpha * spectrum.singular**2
        n = spectrum.singular.size
        mean_of_point = np.zeros((weight.size, length))
        along_axes = alpha * spectrum.singular / gain * spectrum.projected
        mean_of_point[:, :n] = along_axes @ spectrum.axes.T
        means_of_points.append((weight, mean_of_point))
        mean += weight @ mean_of_point
        variance_of_axes = (weight * noise_variance) @ (alpha / gain)
        covariance[:n, :n] += (spectrum.axes * variance_of_axes) @ spectrum.axes.T

    # What the means of the points, and zero without a kernel, differ by.
    if means_of_points:
        deviations = [
            np.sqrt(weight)[:, None] * (mean_of_point - mean) for weight, mean_of_point in means_of_points
        ]
        spread = np.concatenate(deviations)
        covariance += spread.T @ spread
    covariance += weight_none * np.outer(mean, mean)

    mean_noise = float(np.sum(weights * grid.noise_variance))
    best = np.unravel_index(int(np.argmax(weights)), weights.shape)
    alpha_of_best = 0.0
    if np.any(weights):
        alpha_of_best = float(grid.alpha[best])
    return KernelPosterior(
        kernel_mean=mean,
        kernel_factor=symmetric_factor(covariance),
        noise_variance=weight_none * grid.noise_variance_none + mean_noise,
        alpha=alpha_of_best,
        lam=grid.spectra[best[0]].lam,
        probability_no_remainder=weight_none,
        log_evidence=float(grid.log_likelihood[best] - grid.log_likelihood_none),
    )


def embedding_report(
    method: str, reduced: ReducedRegression, kernel: KernelPosterior, **further: Any
) -> EmbeddingReport:
    """Report of a posterior: how it came about, by which a reader can judge it.

    method: its name. reduced: gives numbers of rows and regressors; kernel: noise (output units), scale,
    decay and evidence. further: fields of `EmbeddingReport` that neither knows (TypeError for a name it
    lacks).
    """
    return EmbeddingReport(
        method=method,
        noise_std=float(np.sqrt(kernel.noise_variance)),
        alpha=kernel.alpha,
        lam=kernel.lam,
        probability_no_remainder=kernel.probability_no_remainder,
        log_evidence=kernel.log_evidence,
        n_rows=reduced.n_rows,
        n_regressors=reduced.n_regressors,
        **further,
    )


def joint_factor(reduced: ReducedRegression, posterior: KernelPosterior) -> tuple[RealArray, RealArray]:
    """Mean (P+L,) and covariance factor (P+L, P') of (theta, eta), P counting the columns left out too.

    reduced: the triangle, with its p columns in use; posterior: mean and factor of the L taps (with pairs:
    more) and the noise variance, as many taps as `reduced.r12` has columns, which numpy refuses otherwise.
    Coefficients of columns that are not in use are zero with no uncertainty. The first p columns of the
    factor are normals of the noise, the others those of the kernel.
    """
    p = reduced.n_regressors
    length = posterior.kernel_mean.size
    # Columns of R11 scaled to length 1: regressors differ by orders of magnitude.
    scale = np.linalg.norm(reduced.r11, axis=0)
    right_hand = np.column_stack(
        [
            reduced.r1 - reduced.r12 @ posterior.kernel_mean,
            np.sqrt(posterior.noise_variance) * np.eye(p),
            -reduced.r12 @ posterior.kernel_factor,
        ]
    )
    scaled_solution = solve_triangular(reduced.r11 / scale, right_hand, check_finite=False)
    solution = scaled_solution / scale[:, None]
    mean = np.zeros(reduced.n_columns + length)
    factor = np.zeros((mean.size, p + posterior.kernel_factor.shape[1]))
    mean[reduced.in_use] = solution[:, 0]
    factor[reduced.in_use] = solution[:, 1:]
    mean[reduced.n_columns :] = posterior.kernel_mean
    factor[reduced.n_columns :, p:] = posterior.kernel_factor
    return mean, factor


def by_class(rest: RealArray, classes: IntArray) -> RealArray:
    """Residual (T,) split into a column (T,M) for each of the M classes of its rows, zero in the others.

    classes: numbers 0 .. M - 1 of the rows of a record, of which the residual has the last T; M is one more
    than the largest. Not checked: fewer classes than T (numpy refuses them), negative ones (in no column).
    """
    class_of_row = classes[-rest.size :, None]
    in_class = class_of_row == np.arange(1 + classes.max())
    return np.where(in_class, rest[:, None], 0.0)


def sandwiched(factor: RealArray, scores: RealArray) -> RealArray:
    """Factor (P,P') of a covariance, wider where the scores of classes of rows exceed what noise makes.

    Parameters
    ----------
    factor : ndarray, shape (P, P')
        Of the covariance that the noise makes.
    scores : ndarray, shape (M, P')
        Sums over the rows of each class, in the unit normals of the factor. M is at least 2, which is not
        checked: of one class the factor is NaN.

    Notes
    -----
    H^-1 S H^-1 with S the scores' sum of squares (White, Econometrica 50(1), 1982), never below what the
    noise leaves open.
    """
    count = len(scores)
    size, directions = np.linalg.eigh(scores.T @ scores * count / (count - 1))
    width = np.sqrt(np.maximum(size, 1.0))
    return np.asarray(factor @ (directions * width) @ directions.T)


def symmetric_factor(covariance: RealArray) -> RealArray:
    """Factor S (L,L') with S S^T = covariance (L,L), directions below rounding (`_ROUNDING`) left out.

    L at least 1; the symmetric part counts. L' = 0 for a covariance of zeros. ValueError for one that is not
    finite: an empty factor would say that nothing is uncertain.
    """
    if not np.all(np.isfinite(covariance)):
        raise ValueError("the covariance of the coefficients has a value that is not finite")
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    certain = np.zeros(values.size, dtype=np.bool_)
    if values[-1] > 0:
        certain = values > values[-1] * _ROUNDING
    return np.asarray(vectors[:, certain] * np.sqrt(values[certain]))
