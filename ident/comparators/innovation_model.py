"""A linear model in innovation form: what every comparison method's model is turned into to be judged.

The form x+ = A x + B u + K e, y = C x + D u + e has a free run (e = 0) and, where its noise was identified, a
prediction from one sample to the next (e from the measured output). Both begin with a state that no record
says: it is fitted to the record by least squares, as `ident.checks.validation` does for GOBF models.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ident.data.arrays import ComplexArray, RealArray, lock
from ident.data.record import Record
from ident.data.shown import Shown

# Free responses weaker than this share of the strongest are left out of the fit of a start: poles that lie
# together have nearly equal ones. Chosen: far above the rounding of doubles, far below what a record tells.
_SAME_RESPONSE = 1e-10
# Signals beyond this have left the numbers: a free run of an unstable model. Squares of larger ones overflow.
_LARGEST = 1e150


@dataclass(frozen=True, eq=False, repr=False)
class InnovationModel(Shown):
    """x+ = A x + B u + K e, y = C x + D u + e of one input and one output, with e white.

    Attributes
    ----------
    A, B, C, D : ndarray, shape (n, n), (n, 1), (1, n), (1, 1)
        Output units per unit of the input.
    K : ndarray, shape (n, 1), or None
        Gain of the innovation; None where no noise model was identified.
    dt_s : float
        Sampling time, s.
    method : str
        What made it, as 'N4SID'.
    fit_s : float
        Seconds that the fit took; nan where nobody measured.

    Raises
    ------
    ValueError
        Shapes that do not fit.
    """

    A: RealArray
    B: RealArray
    C: RealArray
    D: RealArray
    K: RealArray | None
    dt_s: float
    method: str = "state space"
    fit_s: float = np.nan

    def __post_init__(self) -> None:
        """Lock the matrices and check their shapes (ValueError)."""
        lock(self, "A", "B", "C", "D")
        n = self.order
        shapes = (self.A.shape, self.B.shape, self.C.shape, self.D.shape)
        if shapes != ((n, n), (n, 1), (1, n), (1, 1)):
            raise ValueError(f"expected A (n, n), B (n, 1), C (1, n), D (1, 1); got {shapes}")
        if self.K is not None:
            lock(self, "K")

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def poles(self) -> ComplexArray:
        """Eigenvalues of A in z, (n,)."""
        return np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)

    def frequency_response(self, omega_rad_s: RealArray) -> ComplexArray:
        """Response (F,) from u to y at omega (F,) in rad/s; LinAlgError of numpy at a pole."""
        z = np.exp(1j * np.atleast_1d(np.asarray(omega_rad_s, dtype=np.float64)) * self.dt_s)
        matrices = z[:, None, None] * np.eye(self.order) - self.A
        states = np.linalg.solve(matrices, np.broadcast_to(self.B, (z.size, self.order, 1)))
        return np.asarray((self.C @ states + self.D)[:, 0, 0], dtype=np.complex128)

    def simulate(self, u: RealArray) -> RealArray:
        """Output (T,) for the input u (T,), from rest; an unstable model may leave the numbers."""
        samples = np.ravel(u)
        output = _response(self.A, self.B[:, 0], self.C[0], samples)
        return np.asarray(output + self.D[0, 0] * samples, dtype=np.float64)

    def free_run(self, record: Record) -> RealArray:
        """Output (T,) for a record's input alone, with the start and the constant that fit its output."""
        y = record.output[:, 0]
        return self._from_best_start(self.simulate(record.input[:, 0]), self.A, y, constant=True)

    def one_step_ahead(self, record: Record) -> RealArray | None:
        """Output (T,), each sample predicted from all before it; None without a noise model."""
        if self.K is None:
            return None
        u = record.input[:, 0]
        y = record.output[:, 0]
        predictor = self.A - self.K @ self.C
        from_input = _response(predictor, (self.B - self.K @ self.D)[:, 0], self.C[0], u)
        from_output = _response(predictor, self.K[:, 0], self.C[0], y)
        from_rest = from_input + from_output + self.D[0, 0] * u
        return self._from_best_start(from_rest, predictor, y, constant=False)

    def _from_best_start(
        self, from_rest: RealArray, A: RealArray, y: RealArray, *, constant: bool
    ) -> RealArray:
        """Add the free response of A (and a constant) that brings a response from rest nearest to y (T,)."""
        columns = free_responses(A, self.C[0], y.size)
        if constant:
            columns = np.column_stack([columns, np.ones(y.size)])
        if not np.all(np.abs(from_rest) < _LARGEST) or not np.all(np.abs(columns) < _LARGEST):
            return from_rest
        coefficients, *_ = np.linalg.lstsq(columns, y - from_rest, rcond=_SAME_RESPONSE)
        return np.asarray(from_rest + columns @ coefficients)

    def to_control(self) -> Any:
        """This model as a `control.StateSpace` of period dt_s, without its noise."""
        import control

        return control.ss(self.A, self.B, self.C, self.D, self.dt_s, remove_useless_states=False)


def free_responses(A: RealArray, c: RealArray, n_samples: int) -> RealArray:
    """Response c A^k of each state (n_samples, n) that nothing drives, k from 0."""
    rows = np.empty((n_samples, c.size))
    row = c
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(n_samples):
            rows[k] = row
            row = row @ A
    return rows


def _response(A: RealArray, b: RealArray, c: RealArray, u: RealArray) -> RealArray:
    """Response c x (T,) of x+ = A x + b u, from rest."""
    output = np.empty(u.size)
    x = np.zeros(b.size)
    with np.errstate(over="ignore", invalid="ignore"):
        for k, value in enumerate(u):
            output[k] = c @ x
            x = A @ x + b * value
    return output


def fit_percent(measured: RealArray, simulated: RealArray) -> float:
    """100 (1 - |y - y_hat| / |y - mean y|), of (T,) both; minus infinity for a run that left the numbers.

    ValueError for a measured signal that is constant.
    """
    spread = float(np.linalg.norm(measured - measured.mean()))
    if spread == 0:
        raise ValueError("the output is constant: no share of its motion can be explained")
    if not np.all(np.abs(simulated) < _LARGEST):
        return -np.inf
    return float(100 * (1 - np.linalg.norm(measured - simulated) / spread))
