"""Linear least squares for given poles by thin QR, with per-record nuisance columns (design 4.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.basis.functions import all_pass_signal, block_parameters, free_response, regressor
from ident.basis.poles import Poles
from ident.data.arrays import RealArray
from ident.fit.kernels import linearise
from ident.fit.regression import Regression

# Directions of the columns weaker than this fraction of the strongest are left at zero: the data do not
# show them.
_RANK_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class Projection:
    """Orthonormal columns of a regression (as rows) and what they leave of the output.

    Attributes
    ----------
    local_q : (Ql, N) array
        Nuisance columns of each record, orthonormal within each record.
    shared_q : (Qs, N) array
        Columns common to all records, orthonormal to each other and to the local ones.
    triangle : (Qs, Qs) array
        R of the shared columns after the local ones are taken out.
    residual : (N,) array
        The output without its part in all these columns.
    """

    local_q: RealArray
    shared_q: RealArray
    triangle: RealArray
    residual: RealArray


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Least-squares fit for given poles: coefficients (B,), direct term, residual (N,), residual sum of
    squares."""

    coefficients: RealArray
    feedthrough: float
    residual: RealArray
    rss: float


def shared_columns(data: Regression, poles: Poles) -> RealArray:
    """Columns common to all records (N, B or B + 1): the basis driven by the input, then the input itself."""
    parts = [regressor(poles, data.u[data.segment(i)]) for i in range(data.n_records)]
    columns = np.concatenate(parts)
    return np.column_stack([columns, data.u]) if data.structure.feedthrough else columns


def local_columns(data: Regression, poles: Poles, record: int) -> RealArray:
    """Nuisance columns of one record (T, Q): polynomials, then the free responses of the poles."""
    here = data.segment(record)
    polynomials = data.polynomials[:, here].T
    if not data.structure.estimate_initial_state:
        return polynomials
    return np.column_stack([polynomials, free_response(poles, here.stop - here.start)])


def project(data: Regression, shared: Poles, local: Poles | None = None) -> Projection:
    """Orthonormalise the columns of a regression; `local` are the poles of the free responses (default: the
    same).

    With `shared` doubled and `local` not, the residual is the one that candidates for a further pole see: all
    first-order changes of the poles are taken out of it (design 4.3).
    """
    local = shared if local is None else local
    free = local.order > 0 and data.structure.estimate_initial_state
    if shared.order == 0 and not free and not data.structure.feedthrough:
        nothing = np.zeros((0, data.n_samples))
        return Projection(data.polynomials_q, nothing, np.zeros((0, 0)), data.y_clear.copy())
    columns = shared_columns(data, shared)
    if free:
        residual = data.y.copy()
        local_q = np.zeros((data.polynomials.shape[0] + local.order, data.n_samples))
        for i in range(data.n_records):
            here = data.segment(i)
            q, _ = np.linalg.qr(local_columns(data, local, i))
            local_q[: q.shape[1], here] = q.T
            columns[here] -= q @ (q.T @ columns[here])
            residual[here] -= q @ (q.T @ residual[here])
    else:
        local_q, residual = data.polynomials_q, data.y_clear.copy()
        for here in map(data.segment, range(data.n_records)):
            columns[here] -= local_q[:, here].T @ (local_q[:, here] @ columns[here])
    if columns.shape[1] == 0:
        return Projection(local_q, np.zeros((0, data.n_samples)), np.zeros((0, 0)), residual)
    q, triangle = np.linalg.qr(columns)
    residual -= q @ (q.T @ residual)
    return Projection(local_q, np.ascontiguousarray(q.T), triangle, residual)


def fit(data: Regression, poles: Poles) -> LinearFit:
    """theta = R^-1 Q^T y by thin QR, never by Phi^T Phi (27).

    Raises
    ------
    ValueError
        If there are not more samples than free numbers.
    """
    needed = data.n_parameters(poles.order)
    if not data.n_samples > needed:
        raise ValueError(f"too few samples: {data.n_samples} for {needed} unknowns with {poles.order} poles")
    projection = project(data, poles)
    # Q^T y with the local part taken out: Q is orthogonal to it, so it needs no subtraction here.
    theta = np.linalg.lstsq(projection.triangle, projection.shared_q @ data.y, rcond=_RANK_TOLERANCE)[0]
    residual = projection.residual
    return LinearFit(
        coefficients=np.asarray(theta[: poles.order], dtype=np.float64),
        feedthrough=float(theta[poles.order]) if data.structure.feedthrough else 0.0,
        residual=residual,
        rss=float(residual @ residual),
    )


@dataclass(frozen=True, eq=False)
class Linearisation:
    """How the residual sum of squares changes with the poles, coefficients re-fitted all the time.

    The directions are the states of each block driven by the fitted output (one per real pole, two per pair),
    projected off the regression: every pole sensitivity is a combination of them and of regression columns.

    Attributes
    ----------
    rss : float
    residual : (N,) array
    normal : (B, B) array
        S^T S of the projected directions: the Gauss-Newton (Kaufman) Hessian.
    gradient : (B,) array
        S^T r.
    """

    rss: float
    residual: RealArray
    normal: RealArray
    gradient: RealArray


def linearisation(data: Regression, poles: Poles) -> Linearisation:
    """Cost, residual and Kaufman linearisation at the given poles (compiled; see
    `ident.fit.kernels.linearise`)."""
    n = poles.order
    residual, normal, gradient = np.empty(data.n_samples), np.empty((n, n)), np.empty(n)
    rss = linearise(
        block_parameters(poles),
        poles.real.size,
        data.u,
        data.y,
        data.starts,
        data.polynomials,
        data.structure.feedthrough,
        data.structure.estimate_initial_state,
        residual,
        normal,
        gradient,
    )
    return Linearisation(float(rss), residual, normal, gradient)


def driving_signal(data: Regression, poles: Poles) -> RealArray:
    """The input sent through the all-pass of the poles, (N,): what drives the next block of the cascade."""
    if poles.order == 0:
        return data.u
    parts = [all_pass_signal(poles, data.u[data.segment(i)]) for i in range(data.n_records)]
    return np.concatenate(parts)
