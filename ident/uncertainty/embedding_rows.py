"""Records as whitened rows of the embedding's regression, and what a fit of them leaves.

`EmbeddingRows` says which columns there are: basis functions driven by the input, columns beside them,
initial state and offset as nuisance, and the delayed input of the kernel. It makes the matrices of one record
after the other, whitened by a noise model, so that only one record's are in memory. `gls_residuals` takes a
fit of these rows and gives its residuals, not whitened, from which the next noise model is fitted
(generalised least squares: Ljung, System Identification, 2nd ed., section 10.4).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from ident.basis.autoregressive_noise import WHITE_NOISE
from ident.basis.functions import all_pass_signal, nuisance_columns, regressor
from ident.basis.noise_model import NoiseModel
from ident.basis.poles import Poles
from ident.basis.structure import Structure, answered, driving_input, level_before, stabilised
from ident.data.arrays import IntArray, RealArray
from ident.data.record import Record
from ident.uncertainty.embedding_algebra import (
    RANK,
    Delays,
    KernelPosterior,
    ReducedRegression,
    RegressionBlock,
    by_class,
    joint_factor,
    nuisance_basis,
)


@dataclass(frozen=True, eq=False)
class RecordRows:
    """The rows of one record that answer to its input, whitened.

    T counts the rows of the record behind its input delay, n_start those on which the noise model lacks a
    past. Units are those of the output, as whitening has none; nothing is checked here.

    Attributes
    ----------
    nuisance : ndarray, shape (T, n)
        Offset, polynomials, free responses.
    regressors : ndarray, shape (T, p)
        F: basis functions, direct term, columns beside them.
    output : ndarray, shape (T,)
        y.
    input : ndarray, shape (T,)
        After integrators, delay and the whitening filter, from rest.
    head : ndarray, shape (n_start,)
        First samples of the input before the whitening filter.
    first : ndarray, shape (n_start, n_start)
        What whitens these rows (`NoiseModel.first_rows`); zero where they are left out.
    """

    nuisance: RealArray
    regressors: RealArray
    output: RealArray
    input: RealArray
    head: RealArray
    first: RealArray


@dataclass(frozen=True, eq=False)
class Beside:
    """What the output of one record depends on besides the basis functions, not whitened.

    T counts all rows of the record, those before the input delay too. p1 and q are those of all records,
    which nothing checks.

    Attributes
    ----------
    first : ndarray, shape (T, p1)
        In place of the first p1 regressors.
    columns : ndarray, shape (T, q)
        With coefficients that all records share; output units per unit of these.
    """

    first: RealArray
    columns: RealArray


@dataclass(frozen=True, eq=False)
class EmbeddingRows:
    """How to make the matrices; they are made anew for each pass, so that only one record's are in memory.

    `tangent_rows` of `ident.uncertainty.embedding` checks records and makes these; nothing is checked here.

    Attributes
    ----------
    records : tuple of Record
        One input, one output each.
    structure : Structure
        Integrators, delay, direct term, and which nuisance there is.
    poles : Poles
        Of the regressors, in z; doubled for the tangent method.
    fir_length : int
        Taps of the kernel.
    noise : NoiseModel
        Whitens the rows.
    beside : tuple of Beside
        One per record, or none.
    n_known : int
        The last so many columns beside have coefficients of zero mean and unit variance.
    known_std : float or None
        Standard deviation of the whitened noise, as far as known; with it what is known of coefficients is
        weighed against the records. None: nothing is taken as known.
    missed_above : float
        Least frequency of a mode that may be missing, radians a sample.
    classes : tuple of ndarray of int, shape (T,)
        Class 0 .. M - 1 of each row of each record (all T rows; `by_class` drops the first ones that a block
        lacks), by what errors of the model may depend on; or none. Every record has rows of class M - 1.
    """

    records: tuple[Record, ...]
    structure: Structure
    poles: Poles
    fir_length: int
    noise: NoiseModel
    beside: tuple[Beside, ...] = ()
    n_known: int = 0
    known_std: float | None = None
    missed_above: float = 0.0
    classes: tuple[IntArray, ...] = ()

    @property
    def n_beside(self) -> int:
        """q, columns beside the basis functions."""
        if not self.beside:
            return 0
        return int(self.beside[0].columns.shape[1])

    def __iter__(self) -> Iterator[RecordRows]:
        """Rows (`RecordRows`) of one record after the other, in the order of `records`.

        Raises ValueError, by `answered`, for a record that is not longer than the delay, and IndexError where
        `beside` has fewer entries than there are records, but some.
        """
        for k, record in enumerate(self.records):
            beside_record = self.beside[k] if self.beside else None
            yield self._rows(record, beside_record)

    def blocks(self) -> Iterator[RegressionBlock]:
        """Blocks of the regression: those of the records, and what is known of shared coefficients.

        One per record, and one of `n_known` rows where `known_std` is set. Raises as iterating does.
        """
        yield from self.record_blocks()
        yield from self.known_blocks()

    def record_blocks(self) -> Iterator[RegressionBlock]:
        """Rows of each record with `fir_length` kernel columns, one block per record.

        The n_start rows that a zero `RecordRows.first` would make zero are left out: they would count among
        the degrees of freedom. A record of no more rows gives an empty block.
        """
        for rows in self:
            n_dropped = 0
            if not np.any(rows.first):
                n_dropped = len(rows.first)
            # First rows of the kernel's columns, whitened as those of the regressors are.
            no_rows = np.zeros((0, self.fir_length))
            plain_head = Delays(rows.head, self.fir_length, no_rows)
            kernel = Delays(rows.input, self.fir_length, rows.first @ plain_head[:], n_dropped)
            used = slice(n_dropped, None)
            yield RegressionBlock(rows.nuisance[used], rows.regressors[used], kernel, rows.output[used])

    def scores(self, mean: RealArray) -> RealArray:
        """Scores (M, P): for each of M classes the sum over records of regressors^T times its residuals.

        mean (P+L,): of regressors' coefficients and kernel. Unit: square of the whitened output over that of
        a coefficient. The nuisance is projected out of the residuals, and out of those of each class, which
        spreads them over all rows of the record again. Raises ValueError where `classes` has not one entry
        per record, or (numpy's, of shapes) where the highest class differs between records; a zero of no
        dimension without records.
        """
        total = np.zeros(())
        for block, classes in zip(self.record_blocks(), self.classes, strict=True):
            p = block.regressors.shape[1]
            basis = nuisance_basis(block.nuisance)
            # What the mean leaves, without what offset and initial state may be.
            residual = block.output - block.regressors @ mean[:p] - block.kernel @ mean[p:]
            without_nuisance = residual - basis @ (basis.T @ residual)
            # A class by itself is no longer orthogonal to the nuisance.
            of_class = by_class(without_nuisance, classes)
            of_class_without = of_class - basis @ (basis.T @ of_class)
            total = total + of_class_without.T @ block.regressors
        return total

    def known_blocks(self) -> Iterator[RegressionBlock]:
        """Block of n_known rows: a measured zero of each of the last coefficients, with deviation one.

        At most one block: none where known_std is None; where it is set n_known has to be from 1 to q, which
        is not checked.
        """
        if self.known_std is None:
            return
        q = self.n_known
        n_direct = int(self.structure.feedthrough)
        n_columns = self.poles.order + n_direct + self.n_beside
        regressors = np.zeros((q, n_columns))
        # In rows whose noise has this deviation, a unit coefficient is one deviation.
        regressors[:, -q:] = self.known_std * np.eye(q)
        yield RegressionBlock(np.zeros((q, 0)), regressors, np.zeros((q, self.fir_length)), np.zeros(q))

    def pair_blocks(self) -> Iterator[RecordRows]:
        """Rows of each record whose input (and head) is what drives one more pair behind all `poles`.

        That is the output of their all-pass; nuisance, regressors and output stay. Raises as iterating does.
        """
        for rows in self:
            signal = all_pass_signal(self.poles, rows.input)
            head = all_pass_signal(self.poles, rows.head)
            yield replace(rows, input=signal, head=head)

    def _rows(self, record: Record, beside: Beside | None) -> RecordRows:
        """Matrices of one record of one input and one output, every column whitened.

        Columns driven by the input from rest commute with the whitening filter: for them the input is
        filtered once, but for the first rows. Raises ValueError where the record is not longer than the
        delay, or (numpy's) where `beside` has another number of rows; NaN of a signal stays in its columns.
        """
        structure = self.structure
        noise = self.noise
        delay = structure.input_delay_samples
        first = noise.first_rows
        n_first = len(first)

        # The level at which the input stood before the record is a free offset and initial state of the
        # output: where both are estimated it is taken off, so that the input begins near zero.
        level = 0.0
        level_is_free = structure.estimate_offset and structure.estimate_initial_state
        if level_is_free and not structure.integrators:
            level = level_before(record.input[:, 0])
        plain = driving_input(record.input[:, 0] - level, structure.integrators, delay)
        head = plain[:n_first]
        filtered = plain if noise.is_white else noise.filtered(plain)

        # The first rows of these columns are those of the plain input, whitened by the matrix.
        regressors = self._driven(filtered)
        if n_first:
            regressors[:n_first] = first @ self._driven(head)
        # Columns that no input drives are whitened as they are.
        if beside is not None:
            plain_columns = np.column_stack([beside.first, beside.columns])
            white_columns = noise.whiten(answered(plain_columns, delay))
            p1 = beside.first.shape[1]
            regressors = np.column_stack([white_columns[:, :p1], regressors[:, p1:], white_columns[:, p1:]])

        nuisance = nuisance_columns(
            self.poles, plain.size, structure.n_polynomials, structure.estimate_initial_state
        )
        output = answered(stabilised(record.output[:, 0], structure.unstable), delay)
        return RecordRows(
            nuisance=noise.whiten(nuisance),
            regressors=regressors,
            output=noise.whiten(output),
            input=filtered,
            head=head,
            first=first,
        )

    def _driven(self, u: RealArray) -> RealArray:
        """Basis functions driven by u (T,) from rest, and u itself where there is a direct term, (T, P or P +
        1).

        u: input behind integrators and delay, whitened or not; NaN in it stays from there on.
        """
        columns = regressor(self.poles, u)
        if self.structure.feedthrough:
            columns = np.column_stack([columns, u])
        return columns


def gls_residuals(
    rows: EmbeddingRows, reduced: ReducedRegression, kernel: KernelPosterior
) -> tuple[list[RealArray], list[RealArray]]:
    """Residuals of a fit, not whitened, and what the fit has absorbed of the noise.

    Parameters
    ----------
    rows : EmbeddingRows
        Those of the fit, with the noise model that it used.
    reduced : ReducedRegression
        Of these rows (not checked): its triangle r11 (p, p) and the columns in use.
    kernel : KernelPosterior
        Of that regression: mean (L,) of the taps, noise variance.

    Returns
    -------
    residuals : list of ndarray, shape (T,)
        One per record: y minus posterior mean and nuisance, output units.
    absorbed : list of ndarray, shape (T, r)
        One per record: columns Z, Z Z^T the share of the noise's covariance that the fit took off, for
        innovations of unit variance (`autoregression.absorbed_gradient`). Neglected: the kernel's share of
        it.
    """
    noise = rows.noise
    mean, _ = joint_factor(reduced, kernel)
    p = reduced.n_columns
    scale = np.linalg.norm(reduced.r11, axis=0)
    residuals = []
    absorbed = []
    # What is known beforehand is no record and leaves nothing.
    for block in replace(rows, noise=WHITE_NOISE).record_blocks():
        # The residual, and the regressors scaled to length 1, before the nuisance is taken off both.
        residual = block.output - block.regressors @ mean[:p] - block.kernel @ mean[p:]
        shared = block.regressors[:, reduced.in_use] / scale
        local = np.zeros((residual.size, 0))
        length = np.linalg.norm(block.nuisance, axis=0)
        nonzero = length > 0
        nuisance = block.nuisance[:, nonzero] / length[nonzero]
        if nuisance.shape[1]:
            # Fitted where it was estimated, in the whitened rows, and taken off the plain ones.
            u, d, vt = np.linalg.svd(noise.whiten(nuisance), full_matrices=False)
            rank = int(np.count_nonzero(d > RANK * d[0]))
            local = nuisance @ (vt[:rank].T / d[:rank])
            white = noise.whiten(np.column_stack([residual, shared]))
            fitted = local @ (u[:, :rank].T @ white)
            residual = residual - fitted[:, 0]
            shared = shared - fitted[:, 1:]
        residuals.append(residual)

        # Columns of the regressors for innovations of unit variance: F R11^-1.
        scaled_triangle = (reduced.r11 / scale).T
        of_regressors = solve_triangular(scaled_triangle, shared.T, lower=True, check_finite=False).T
        columns = np.column_stack([local, of_regressors])
        # Where rows were left out, the columns are what their whitened rows make from rest.
        if noise.drops_start:
            columns = noise.coloured(noise.whiten(columns))
        absorbed.append(columns)
    return residuals, absorbed
