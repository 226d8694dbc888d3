"""Subspace identification for comparison: past-output MOESP (M. Verhaegen, Automatica 30(1), 1994)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import hankel, lstsq

from ident.data.arrays import ComplexArray, RealArray
from ident.data.record import Record


@dataclass(frozen=True, eq=False)
class StateSpaceModel:
    """x(k+1) = A x + B u, y = C x + D u with sampling time dt_s; A (n, n), B (n, 1), C (1, n), D (1, 1)."""

    A: RealArray
    B: RealArray
    C: RealArray
    D: RealArray
    dt_s: float

    @property
    def poles(self) -> ComplexArray:
        """Eigenvalues of A (n,) in the z plane."""
        return np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)

    def frequency_response(self, omega_rad_s: RealArray) -> ComplexArray:
        """omega (F,) in rad/s -> response (F,)."""
        z = np.exp(1j * np.asarray(omega_rad_s) * self.dt_s)
        inner = np.linalg.solve(
            z[:, None, None] * np.eye(self.A.shape[0]) - self.A, self.B.astype(np.complex128)
        )
        return np.asarray((self.C @ inner + self.D)[:, 0, 0])

    def simulate(self, u: RealArray) -> RealArray:
        """Output (T,) for the input u (T,), from rest; grows without bound if |poles| > 1."""
        return np.asarray(_states(self.A, self.B, u) @ self.C[0] + self.D[0, 0] * u)


def moesp(record: Record, order: int, *, horizon: int = 10) -> StateSpaceModel:
    """State space of the given order by PO-MOESP with block Hankel matrices of `horizon` rows.

    The column space of the future outputs, cleared of the future input and seen through past inputs and
    outputs, gives A and C; B, D and the initial state follow by least squares on the simulated output. The
    poles are taken as they come. Raises ValueError if the record is too short or the horizon not above the
    order.
    """
    if record.input.shape[1] != 1 or record.output.shape[1] != 1:
        raise ValueError(f"{record.label}: expected one input and one output; choose with siso(...)")
    if not horizon > order >= 1:
        raise ValueError(f"horizon must be above order >= 1; got {horizon} and {order}")
    u, y = record.input[:, 0], record.output[:, 0]
    columns = u.size - 2 * horizon + 1
    if columns < 4 * horizon:
        raise ValueError(
            f"{record.label}: {u.size} samples are too few for horizon {horizon}; expected at least "
            f"{6 * horizon - 1}"
        )
    past_u, future_u = np.vsplit(hankel(u[: 2 * horizon], u[2 * horizon - 1 :]), 2)
    past_y, future_y = np.vsplit(hankel(y[: 2 * horizon], y[2 * horizon - 1 :]), 2)
    stacked = np.vstack([future_u, past_u, past_y, future_y])
    lower = np.linalg.qr(stacked.T)[1].T
    extended = np.linalg.svd(lower[3 * horizon :, horizon : 3 * horizon])[0][:, :order]
    A = np.asarray(lstsq(extended[:-1], extended[1:])[0])
    C = extended[:1]
    # y is linear in B, D and x(0): one column for each.
    responses = [_states(A, np.eye(order)[:, [i]], u) @ C[0] for i in range(order)]
    free = _states(A, np.zeros((order, 1)), u, np.eye(order))
    regressors = np.column_stack([*responses, u, *(free[:, :, i] @ C[0] for i in range(order))])
    # Poles outside the circle make columns of very different lengths.
    lengths = np.linalg.norm(regressors, axis=0)
    theta = lstsq(regressors / lengths, y)[0] / lengths
    return StateSpaceModel(A, theta[:order, None], C, theta[None, [order]], record.dt_s)


def _states(A: RealArray, B: RealArray, u: RealArray, start: RealArray | None = None) -> RealArray:
    """x(k), k = 0 .. T - 1: (T, n), or (T, n, m) from m initial states (n, m)."""
    x = np.zeros((A.shape[0], 1)) if start is None else start
    states = np.empty((u.size, *x.shape))
    for k, value in enumerate(u):
        states[k] = x
        x = A @ x + B * value
    return states[:, :, 0] if start is None else states
