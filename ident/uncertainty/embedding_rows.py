"""Records as whitened rows of the embedding's regression, and what a fit of them leaves."""

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
    """The rows of one record that answer to its input: nuisance (T,n), regressors F (T,p), output y (T,),
    whitened.

    input (T,): after integrators, delay and A(q); head (n,): its first samples before A(q); first (n,n): what
    whitens those rows, zero where they are dropped.
    """

    nuisance: RealArray
    regressors: RealArray
    output: RealArray
    input: RealArray
    head: RealArray
    first: RealArray


@dataclass(frozen=True, eq=False)
class Beside:
    """What the output of one record depends on besides the basis functions: first (T,p1), in place of the
    first p1 regressors; columns (T,q), with coefficients that all records share."""

    first: RealArray
    columns: RealArray


@dataclass(frozen=True, eq=False)
class EmbeddingRows:
    """How to make the matrices; made anew for each pass, so that only one record's are in memory.

    poles: of the regressors (doubled for the tangent method); fir_length: of the kernel; noise: makes the
    rows white. beside: one per record, or none, whose last n_known columns have coefficients known to
    one; known_std: of the (whitened) noise, as far as known. missed_above: least frequency of a mode that
    may be missing, radians a sample. classes: of the rows (T,) of each record, by what errors of the model
    may depend on.
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
        """Columns beside the basis functions."""
        return self.beside[0].columns.shape[1] if self.beside else 0

    def __iter__(self) -> Iterator[RecordRows]:
        for k, record in enumerate(self.records):
            yield self._rows(record, self.beside[k] if self.beside else None)

    def blocks(self) -> Iterator[RegressionBlock]:
        """Those of the records, and of what is known of shared coefficients."""
        yield from self.record_blocks()
        yield from self.known_blocks()

    def record_blocks(self) -> Iterator[RegressionBlock]:
        """Rows with kernel columns; those that are dropped are left out, for they count as data here."""
        for rows in self:
            dropped = 0 if np.any(rows.first) else len(rows.first)
            head = Delays(rows.head, self.fir_length, np.zeros((0, self.fir_length)))
            kernel = Delays(rows.input, self.fir_length, rows.first @ head[:], dropped)
            used = slice(dropped, None)
            yield RegressionBlock(rows.nuisance[used], rows.regressors[used], kernel, rows.output[used])

    def scores(self, mean: RealArray) -> RealArray:
        """(M, P): sums over the rows of each class of regressors times what the mean (P+L,) leaves, behind
        the nuisance."""
        total = np.zeros(())
        for block, classes in zip(self.record_blocks(), self.classes, strict=True):
            p, basis = block.regressors.shape[1], nuisance_basis(block.nuisance)
            rest = block.output - block.regressors @ mean[:p] - block.kernel @ mean[p:]
            own = by_class(rest - basis @ (basis.T @ rest), classes)
            total = total + (own - basis @ (basis.T @ own)).T @ block.regressors
        return total

    def known_blocks(self) -> Iterator[RegressionBlock]:
        """What is known of the shared coefficients: as many measurements of them, each off by one."""
        if self.known_std is not None:
            q = self.n_known
            known = np.zeros((q, self.poles.order + int(self.structure.feedthrough) + self.n_beside))
            known[:, -q:] = self.known_std * np.eye(q)
            yield RegressionBlock(np.zeros((q, 0)), known, np.zeros((q, self.fir_length)), np.zeros(q))

    def pair_blocks(self) -> Iterator[RecordRows]:
        """Rows with the signal that drives one more pair after all the poles in place of the input."""
        for rows in self:
            signal, head = (all_pass_signal(self.poles, part) for part in (rows.input, rows.head))
            yield replace(rows, input=signal, head=head)

    def _rows(self, record: Record, beside: Beside | None) -> RecordRows:
        """Matrices of one record, every column whitened. Columns driven by the input from rest commute with
        A(q): for them the input is filtered, but for the first rows."""
        structure, noise = self.structure, self.noise
        delay = structure.input_delay_samples
        first = noise.first_rows
        unknown = structure.estimate_offset and structure.estimate_initial_state and not structure.integrators
        level = level_before(record.input[:, 0]) if unknown else 0.0
        plain = driving_input(record.input[:, 0] - level, structure.integrators, delay)
        head = plain[: len(first)]
        u = plain if noise.is_white else noise.filtered(plain)
        regressors = self._driven(u)
        if first.size:
            regressors[: len(first)] = first @ self._driven(head)
        if beside is not None:
            more = noise.whiten(answered(np.column_stack([beside.first, beside.columns]), delay))
            p = beside.first.shape[1]
            regressors = np.column_stack([more[:, :p], regressors[:, p:], more[:, p:]])
        known = nuisance_columns(
            self.poles, plain.size, structure.n_polynomials, structure.estimate_initial_state
        )
        return RecordRows(
            nuisance=noise.whiten(known),
            regressors=regressors,
            output=noise.whiten(answered(stabilised(record.output[:, 0], structure.unstable), delay)),
            input=u,
            head=head,
            first=first,
        )

    def _driven(self, u: RealArray) -> RealArray:
        columns = regressor(self.poles, u)
        return np.column_stack([columns, u]) if self.structure.feedthrough else columns


def gls_residuals(
    rows: EmbeddingRows, reduced: ReducedRegression, kernel: KernelPosterior
) -> tuple[list[RealArray], list[RealArray]]:
    """y minus posterior mean and nuisance, unwhitened, one array per record; and what the fit has absorbed.
    rows: of the fit, with its noise model. Neglected: the kernel's share of the absorption."""
    mean, _ = joint_factor(reduced, kernel)
    p = reduced.n_columns
    scale = np.linalg.norm(reduced.r11, axis=0)
    residuals, absorbed = [], []
    # What is known beforehand is no record and leaves nothing.
    for block in replace(rows, noise=WHITE_NOISE).record_blocks():
        rest = block.output - block.regressors @ mean[:p] - block.kernel @ mean[p:]
        shared = block.regressors[:, reduced.kept] / scale
        local = np.zeros((rest.size, 0))
        length = np.linalg.norm(block.nuisance, axis=0)
        nuisance = block.nuisance[:, length > 0] / length[length > 0]
        if nuisance.shape[1]:
            # Fitted where it was estimated, in the whitened rows, and taken off the plain ones.
            u, d, vt = np.linalg.svd(rows.noise.whiten(nuisance), full_matrices=False)
            rank = int(np.count_nonzero(d > RANK * d[0]))
            local = nuisance @ (vt[:rank].T / d[:rank])
            fitted = local @ (u[:, :rank].T @ rows.noise.whiten(np.column_stack([rest, shared])))
            rest = rest - fitted[:, 0]
            shared = shared - fitted[:, 1:]
        theirs = solve_triangular((reduced.r11 / scale).T, shared.T, lower=True, check_finite=False).T
        residuals.append(rest)
        columns = np.column_stack([local, theirs])
        if rows.noise.drops_start:
            columns = rows.noise.coloured(rows.noise.whiten(columns))
        absorbed.append(columns)
    return residuals, absorbed
