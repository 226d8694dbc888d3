"""Linear least squares of records for given poles by thin QR, with per-record nuisance columns.

One output; with several inputs the columns are [Phi(u_1) Phi(u_2) ...]. Modulo these columns moving a pole
changes the output by -(dD_b/dp)/D_b y_hat, y_hat being the fitted output of all channels together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from ident.basis.coordinates import SearchSpace
from ident.basis.functions import block_parameters, blocks_of_poles, free_response
from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.data.arrays import ComplexArray, IntArray, RealArray
from ident.fit.kernels import cost_of_point, driven_rows, linearise
from ident.fit.problem import CandidateCost, Linearisation, PoleProblem, ResidualColour, residual_colour

# Directions weaker than this share of the strongest are left at zero: the data do not show them.
RANK_TOLERANCE = 1e-12
# Residual this small relative to the output (in power) is rounding: no further pole can be seen.
EXPLAINED = 1e-18


@dataclass(frozen=True, eq=False)
class Regression:
    """Records made ready for a fit, one after the other: everything it needs but the poles.

    u (U, N): inputs after delay and integrators, without the first `input_delay_samples` rows of a record; y
    (N,): outputs of the same rows. starts (K + 1,): record i owns starts[i]:starts[i + 1]. polynomials (Q,
    N): Legendre columns of each record, degrees 0 .. Q - 1, as rows.
    """

    u: RealArray
    y: RealArray
    starts: IntArray
    polynomials: RealArray
    structure: Structure
    dt_s: float

    @cached_property
    def polynomials_q(self) -> RealArray:
        """The polynomial columns made orthonormal within each record, (Q, N)."""
        rows = np.zeros_like(self.polynomials)
        if len(rows) == 1:  # constants, by far the most common: no factorisation
            for here in self.segments:
                rows[0, here] = 1 / np.sqrt(here.stop - here.start)
            return rows
        for here in self.segments:
            q, _ = np.linalg.qr(self.polynomials[:, here].T)
            rows[: q.shape[1], here] = q.T
        return rows

    @cached_property
    def y_clear(self) -> RealArray:
        """The outputs without their part in the polynomial columns, (N,)."""
        y = self.y.copy()
        self.take_out_local(self.polynomials_q, y[np.newaxis])
        return y

    @cached_property
    def power(self) -> float:
        """|y_clear|^2."""
        return float(self.y_clear @ self.y_clear)

    @property
    def omega_max_rad_s(self) -> float | None:
        """None: records show what lies below the Nyquist frequency."""
        return None

    @property
    def n_samples(self) -> int:
        """Number of samples N over all records."""
        return int(self.y.size)

    @property
    def n_inputs(self) -> int:
        return int(self.u.shape[0])

    @cached_property
    def longest(self) -> int:
        """Samples of the longest record."""
        return int(np.max(np.diff(self.starts)))

    @cached_property
    def segments(self) -> tuple[slice, ...]:
        """The samples of each record."""
        return tuple(slice(low, high) for low, high in pairwise(self.starts.tolist()))

    def n_parameters(self, order: int) -> int:
        """Free real numbers of a fit with `order` poles: coefficients of each input, poles, nuisances."""
        local = self.polynomials.shape[0] + (order if self.structure.estimate_initial_state else 0)
        return int(
            order + self.n_inputs * (order + self.structure.feedthrough) + (self.starts.size - 1) * local
        )

    def take_out_local(self, local_q: RealArray, rows: RealArray) -> None:
        """Project rows (R, N) off the columns local_q (Q, N) of each record, in place."""
        if len(local_q):
            for here in self.segments:
                rows[:, here] -= (rows[:, here] @ local_q[:, here].T) @ local_q[:, here]

    def linearise(self, real: RealArray, pairs: ComplexArray, below: float = np.inf) -> Linearisation:
        """Cost and Kaufman linearisation at these poles (compiled; by orthogonal factorisation where the
        columns are nearly dependent); only the cost counts where it is not under `below`."""
        blocks = blocks_of_poles(real, pairs)
        n = real.size + 2 * pairs.size
        normal, gradient = np.empty((n, n)), np.empty(n)
        rss = linearise(
            blocks, real.size, self.u, self.y_clear, self.starts, self.polynomials_q,
            self.structure.feedthrough, self.structure.estimate_initial_state, below, normal, gradient,
        )  # fmt: skip
        return Linearisation(rss, normal, gradient) if rss >= 0 else linearisation(self, Poles(real, pairs))

    def residual(self, poles: Poles) -> RealArray:
        """What the fit with these poles leaves of the output, (N,)."""
        return project(self, poles).residual

    def colour(self, residual: RealArray) -> ResidualColour:
        """Colour of a residual (N,)."""
        return residual_colour(residual, self.starts)

    def criterion(self, rss: float, order: int, worth: float) -> Callable[[float, int], float]:
        """See `information_criterion`."""
        return information_criterion(float(self.y @ self.y), self, worth)

    def candidate_cost(self, space: SearchSpace, shared: Poles, local: Poles) -> CandidateCost:
        """Cost of candidates on top of frozen poles: `shared` are driven by the input, `local` are those of
        the free responses; their columns are taken out of the output once, here."""
        kept = project(self, shared, local)
        frozen = np.vstack([kept.shared_q, kept.residual])
        drive = _driven(self, shared, self.u)[1]
        free = self.structure.estimate_initial_state
        known = (
            space.n_real, space.low.copy(), space.high.copy(), space.raw,
            drive, frozen, self.starts, kept.local_q, free,
        )  # fmt: skip
        return CandidateCost(space, float(self.y @ self.y), lambda unit: cost_of_point(unit, *known))


def information_criterion(power: float, data: PoleProblem, worth: float) -> Callable[[float, int], float]:
    """Ne ln(J/N) + (free numbers) ln Ne with Ne = worth; power = |y|^2."""
    floor = max(EXPLAINED * power, np.finfo(np.float64).tiny)

    def value(rss: float, order: int) -> float:
        fall = worth * np.log(max(rss, floor) / data.n_samples)
        return float(fall + data.n_parameters(order) * np.log(worth))

    return value


@dataclass(frozen=True, eq=False)
class Projection:
    """Columns of a regression as rows, and the residual (N,) that they leave of the output.

    local_q (Ql, N): nuisance columns, orthonormal within each record. shared (Qs, N): the basis driven by
    each input, then inputs with a direct term; shared_q (Qs, N): the same orthonormal to each other and to
    the local ones; triangle (Qs, Qs): R of them.
    """

    local_q: RealArray
    shared: RealArray
    shared_q: RealArray
    triangle: RealArray
    residual: RealArray

    def coefficients(self, y: RealArray) -> RealArray:
        """Least-squares coefficients (Qs,) of the shared columns for the output y (N,)."""
        # Q is orthogonal to the local part of y, so that needs no subtraction here.
        theta = np.linalg.lstsq(self.triangle, self.shared_q @ y, rcond=RANK_TOLERANCE)[0]
        return np.asarray(theta, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Coefficients (U, B), direct terms (U,), residual (N,) and its sum of squares at given poles."""

    coefficients: RealArray
    feedthrough: RealArray
    residual: RealArray
    rss: float


def _driven(data: Regression, poles: Poles, signals: RealArray) -> tuple[RealArray, RealArray]:
    """Basis functions driven by signals (U, N) from rest, (U B, N), and the signals behind the all-pass (U,
    N)."""
    rows, through = np.empty((signals.shape[0] * poles.order, signals.shape[1])), signals.copy()
    driven_rows(block_parameters(poles), poles.real.size, through, data.starts, rows)
    return rows, through


def project(data: Regression, shared: Poles, local: Poles | None = None) -> Projection:
    """Orthonormalise the columns of a regression; `local` are the poles of the free responses (default: the
    same).

    With `shared` doubled and `local` not, all first-order changes of the poles are taken out of the residual,
    which is what candidates for a further pole see.
    """
    local = shared if local is None else local
    rows = _driven(data, shared, data.u)[0]
    if data.structure.feedthrough:
        rows = np.vstack([rows, data.u])
    local_q, residual = data.polynomials_q, data.y_clear.copy()
    if local.order > 0 and data.structure.estimate_initial_state:
        local_q = np.zeros((data.polynomials.shape[0] + local.order, data.n_samples))
        for here in data.segments:
            free = free_response(local, here.stop - here.start)
            q, _ = np.linalg.qr(np.column_stack([data.polynomials[:, here].T, free]))
            local_q[: q.shape[1], here] = q.T
        data.take_out_local(local_q, residual[np.newaxis])
    if len(rows) == 0:
        return Projection(local_q, rows, rows, np.zeros((0, 0)), residual)
    clear = rows.copy()
    data.take_out_local(local_q, clear)
    q, triangle = np.linalg.qr(clear.T)
    shared_q = np.ascontiguousarray(q.T)
    residual -= (shared_q @ residual) @ shared_q
    return Projection(local_q, rows, shared_q, triangle, residual)


def fit(data: Regression, poles: Poles) -> LinearFit:
    """theta = R^-1 Q^T y by thin QR (27). Raises ValueError if there are not more samples than free
    numbers."""
    needed = data.n_parameters(poles.order)
    if not data.n_samples > needed:
        raise ValueError(f"too few samples: {data.n_samples} for {needed} unknowns with {poles.order} poles")
    projection = project(data, poles)
    theta, n = projection.coefficients(data.y), data.n_inputs * poles.order
    residual = projection.residual
    return LinearFit(
        coefficients=theta[:n].reshape(data.n_inputs, poles.order),
        feedthrough=theta[n:] if data.structure.feedthrough else np.zeros(data.n_inputs),
        residual=residual,
        rss=float(residual @ residual),
    )


def block_states(data: Regression, poles: Poles, signal: RealArray) -> RealArray:
    """States (B, N) of each block by itself driven by the signal (N,), record by record from rest."""
    parts = [_driven(data, block, signal[np.newaxis])[0] for block in poles.blocks()]
    return np.concatenate(parts) if parts else np.zeros((0, signal.size))


def linearisation(data: Regression, poles: Poles) -> Linearisation:
    """`Regression.linearise` by orthogonal factorisation."""
    projection = project(data, poles)
    # What the poles make of the output. A polynomial part stays in the span of free responses; without them
    # it has to be left out.
    fitted = np.asarray(data.y - projection.residual)
    if not data.structure.estimate_initial_state:
        fitted = np.asarray(projection.coefficients(data.y) @ projection.shared)
    # The states of each block that it drives, projected off the regression.
    states, residual = block_states(data, poles, fitted), projection.residual
    data.take_out_local(projection.local_q, states)
    states -= (states @ projection.shared_q.T) @ projection.shared_q
    return Linearisation(float(residual @ residual), states @ states.T, states @ residual)
