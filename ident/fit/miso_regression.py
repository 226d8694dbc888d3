"""Least squares of one output on several inputs for given shared poles, and how it changes with the poles.

The columns are [Phi(u_1) Phi(u_2) ...]: the numerators of all channels are re-fitted, their denominator is
one. So modulo these columns moving a pole changes the output by -(dD_b/dp)/D_b y_hat, y_hat the fitted output
of all channels together, and the sensitivities are the block's states driven by y_hat exactly as with one
input (`ident.fit.refinement`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ident.basis.functions import block_parameters, free_response, run_cascade
from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.fit.least_squares import Linearisation
from ident.fit.regression import Regression, prepare

# As in `ident.fit.least_squares`: directions of the columns weaker than this are left out.
_RANK_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class MisoRegression(Regression):
    """A `Regression` whose u is (N, U): what counts poles and samples is inherited, what drives the basis
    is here."""

    @property
    def n_inputs(self) -> int:
        return int(self.u.shape[1])

    @cached_property
    def input_rows(self) -> RealArray:
        """The inputs as contiguous rows (U, N)."""
        return np.ascontiguousarray(self.u.T)

    def n_parameters(self, order: int) -> int:
        """Free real numbers of a fit: a pole costs 1 + U, itself and a coefficient per input."""
        one_input = super().n_parameters(order)
        return one_input + (self.n_inputs - 1) * (order + self.structure.feedthrough)


@dataclass(frozen=True, eq=False)
class MisoFit:
    """Least-squares fit for given poles: coefficients (U, B), direct terms (U,), residual (N,) and its sum
    of squares."""

    coefficients: RealArray
    feedthrough: RealArray
    residual: RealArray
    rss: float


@dataclass(frozen=True, eq=False)
class MisoProjection:
    """Columns of a regression as rows: orthonormal nuisances `local_q` (Ql, N) of each record, shared ones
    `shared` (Qs, N) as they are and orthonormal `shared_q` (Qs, N) off the local ones, with their `triangle`;
    `residual` (N,) is what all of them leave of the output."""

    local_q: RealArray
    shared: RealArray
    shared_q: RealArray
    triangle: RealArray
    residual: RealArray


def prepare_inputs(records: Sequence[Record], structure: Structure) -> MisoRegression:
    """Stack records of equal inputs and one output for one fit; ValueError as `ident.fit.regression.prepare`,
    and if the inputs or the output differ between records."""
    if not records:
        raise ValueError("identification needs at least one record; got none")
    first = records[0]
    for record in records:
        if len(record.output_names) != 1:
            raise ValueError(
                f"{record.label}: identification of several inputs takes one output, got "
                f"{list(record.output_names)}"
            )
        if (record.input_names, record.output_names) != (first.input_names, first.output_names):
            raise ValueError(
                f"{record.label}: columns {[*record.input_names, *record.output_names]}, but the first "
                f"record has {[*first.input_names, *first.output_names]}"
            )
    channels = [prepare([record.siso(name) for record in records], structure) for name in first.input_names]
    one = channels[0]
    u = np.column_stack([channel.u for channel in channels])
    return MisoRegression(u, one.y, one.starts, one.polynomials, one.structure, one.dt_s)


def restructured(data: MisoRegression, records: Sequence[Record], **changes: bool) -> MisoRegression:
    """The regression of the same records with some flags of its structure changed."""
    return prepare_inputs(records, replace(data.structure, **changes))


def driven(
    blocks: RealArray, n_real: int, data: Regression, signals: RealArray
) -> tuple[RealArray, RealArray]:
    """States of a cascade driven by each of the signals (U, N), record by record from rest, (U B, N), and
    the signals sent through its all-pass (U, N)."""
    order = 2 * blocks.shape[0] - n_real
    rows = np.empty((signals.shape[0] * order, signals.shape[1]))
    through = signals.copy()
    for i in range(signals.shape[0]):
        for lo, hi in zip(data.starts[:-1], data.starts[1:], strict=True):
            run_cascade(blocks, n_real, through[i], rows, i * order, lo, hi)
    return rows, through


def project(data: MisoRegression, shared: Poles, local: Poles | None = None) -> MisoProjection:
    """Orthonormalise the columns; `local` are the poles of the free responses (default: the same).

    With `shared` doubled the residual is clear of all first-order changes of the poles (and of some more: in
    the tangent space of shared poles the channels move together).
    """
    local = shared if local is None else local
    rows, _ = driven(block_parameters(shared), shared.real.size, data, data.input_rows)
    if data.structure.feedthrough:
        rows = np.vstack([rows, data.input_rows])
    if local.order and data.structure.estimate_initial_state:
        local_q = np.zeros((data.polynomials.shape[0] + local.order, data.n_samples))
        for here in map(data.segment, range(data.n_records)):
            free = free_response(local, here.stop - here.start)
            q, _ = np.linalg.qr(np.column_stack([data.polynomials[:, here].T, free]))
            local_q[: q.shape[1], here] = q.T
    else:
        local_q = data.polynomials_q
    clear = rows.copy()
    residual = data.y[None, :].copy()
    take_out_local(data, local_q, clear)
    take_out_local(data, local_q, residual)
    q, triangle = np.linalg.qr(clear.T)
    size = np.linalg.norm(rows, axis=1)
    lost = np.abs(np.diag(triangle)) <= _RANK_TOLERANCE * size[: triangle.shape[0]]
    q[:, lost] = 0.0
    shared_q = np.ascontiguousarray(q.T)
    # Twice: the second pass takes out what rounding left of the first.
    for _ in range(2):
        residual[0] -= (shared_q @ residual[0]) @ shared_q
    return MisoProjection(local_q, rows, shared_q, triangle, residual[0])


def take_out_local(data: Regression, local_q: RealArray, rows: RealArray) -> None:
    """Project rows (R, N) off the nuisances of each record, in place."""
    for here in map(data.segment, range(data.n_records)):
        rows[:, here] -= (rows[:, here] @ local_q[:, here].T) @ local_q[:, here]


def fit(data: MisoRegression, poles: Poles) -> MisoFit:
    """Coefficients of all channels for given poles; ValueError if samples are not more than unknowns."""
    needed = data.n_parameters(poles.order)
    if not data.n_samples > needed:
        raise ValueError(f"too few samples: {data.n_samples} for {needed} unknowns with {poles.order} poles")
    projection = project(data, poles)
    theta = _coefficients(data, projection)
    n = data.n_inputs * poles.order
    return MisoFit(
        coefficients=theta[:n].reshape(data.n_inputs, poles.order),
        feedthrough=theta[n:] if data.structure.feedthrough else np.zeros(data.n_inputs),
        residual=projection.residual,
        rss=float(projection.residual @ projection.residual),
    )


def _coefficients(data: MisoRegression, projection: MisoProjection) -> RealArray:
    return np.asarray(
        np.linalg.lstsq(projection.triangle, projection.shared_q @ data.y, rcond=_RANK_TOLERANCE)[0]
    )


def linearisation(data: MisoRegression, poles: Poles) -> Linearisation:
    """Cost, residual and Kaufman linearisation at the given poles, as
    `ident.fit.least_squares.linearisation`.
    """
    projection = project(data, poles)
    states = pole_sensitivities(data, poles, projection)
    residual = projection.residual
    return Linearisation(float(residual @ residual), residual, states @ states.T, states @ residual)


def pole_sensitivities(data: MisoRegression, poles: Poles, projection: MisoProjection) -> RealArray:
    """States (B, N) of each block driven by the fitted output, projected off the regression."""
    states = block_states(data, poles, fitted_output(data, projection))
    take_out_local(data, projection.local_q, states)
    states -= (states @ projection.shared_q.T) @ projection.shared_q
    return states


def fitted_output(data: MisoRegression, projection: MisoProjection) -> RealArray:
    """The part of the output that the poles make, (N,)."""
    # With free responses among the columns a polynomial part does no harm (filtered, it stays in their span);
    # without them it has to be left out.
    if data.structure.estimate_initial_state:
        return np.asarray(data.y - projection.residual)
    return np.asarray(_coefficients(data, projection) @ projection.shared)


def block_states(data: Regression, poles: Poles, signal: RealArray) -> RealArray:
    """States (B, N) of each block by itself driven by the signal (N,), record by record from rest."""
    blocks, n_real = block_parameters(poles), poles.real.size
    parts = [
        driven(blocks[i : i + 1], int(i < n_real), data, signal[None, :])[0] for i in range(blocks.shape[0])
    ]
    return np.concatenate(parts) if parts else np.zeros((0, signal.size))
