"""Linear least squares of records for given poles by thin QR, with per-record nuisance columns.

One output; with several inputs the columns are [Phi(u_1) Phi(u_2) ...], Phi(u) the basis functions driven by
an input. Nuisance columns (polynomials, free responses) belong to one record each and go first. `fit`
gives the coefficients, `project` the orthonormal columns, `Regression` answers what a pole search and a
refinement ask (`ident.fit.problem.PoleProblem`), most of it compiled (`ident.fit.kernels`).

Modulo these columns moving a pole changes the output by -(dD_b/dp)/D_b y_hat, y_hat being the fitted output
of all channels together and D_b the denominator of the pole's block: that is `linearisation`.
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

# Directions of the coefficients weaker than this share of the strongest are left at zero: the data do not
# show them. The columns are rounded to 1e-16 of the strongest; this leaves a margin of four digits.
RANK_TOLERANCE = 1e-12
# Residual this small relative to the output (in power) is rounding: no further pole can be seen. That is 1e-9
# of the output, less than the rounding of a log of eight digits leaves.
EXPLAINED = 1e-18


@dataclass(frozen=True, eq=False)
class Regression:
    """Records made ready for a fit, one after the other: everything it needs but the poles.

    `ident.fit.regression` makes it from checked records; nothing is checked here, and every record has at
    least one sample.

    Attributes
    ----------
    u : ndarray, shape (U, N)
        Inputs after delay and integrators, without the first `input_delay_samples` rows of a record.
    y : ndarray, shape (N,)
        Outputs of the same rows.
    starts : ndarray of int, shape (K + 1,)
        Record i owns starts[i]:starts[i + 1].
    polynomials : ndarray, shape (Q, N)
        Legendre columns of each record, degrees 0 .. Q - 1, as rows.
    structure : Structure
        Integrators, delay, direct term, and whether records start from rest.
    dt_s : float
        Sampling time, s.
    """

    u: RealArray
    y: RealArray
    starts: IntArray
    polynomials: RealArray
    structure: Structure
    dt_s: float

    @cached_property
    def polynomials_q(self) -> RealArray:
        """Polynomial columns made orthonormal within each record, (Q, N).

        A record of fewer than Q samples has zeros in place of what it cannot hold.
        """
        rows = np.zeros_like(self.polynomials)
        # Constants alone, by far the most common, need no factorisation.
        if len(rows) == 1:
            for segment in self.segments:
                rows[0, segment] = 1 / np.sqrt(segment.stop - segment.start)
            return rows
        for segment in self.segments:
            q, _ = np.linalg.qr(self.polynomials[:, segment].T)
            rows[: q.shape[1], segment] = q.T
        return rows

    @cached_property
    def y_clear(self) -> RealArray:
        """Outputs without their part in the polynomial columns, (N,), units of the output."""
        y = self.y.copy()
        self.take_out_local(self.polynomials_q, y[np.newaxis])
        return y

    @cached_property
    def power(self) -> float:
        """Square sum |y_clear|^2 of the outputs without constants and the like."""
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
        """Number of inputs U."""
        return int(self.u.shape[0])

    @cached_property
    def longest(self) -> int:
        """Samples of the longest record."""
        return int(np.max(np.diff(self.starts)))

    @cached_property
    def segments(self) -> tuple[slice, ...]:
        """Samples of each record, K slices of 0 .. N."""
        ends = pairwise(self.starts.tolist())
        return tuple(slice(low, high) for low, high in ends)

    def n_parameters(self, order: int) -> int:
        """Free real numbers of a fit with `order` poles: coefficients of each input, poles, nuisances.

        Known poles count as free. order: at least 0, not checked.
        """
        n_free_responses = order if self.structure.estimate_initial_state else 0
        per_record = self.polynomials.shape[0] + n_free_responses
        n_records = self.starts.size - 1
        # Poles count once, coefficients per input, nuisances per record.
        n_direct = 1 if self.structure.feedthrough else 0
        per_input = order + n_direct
        return int(order + self.n_inputs * per_input + n_records * per_record)

    def take_out_local(self, local_q: RealArray, rows: RealArray) -> None:
        """Project rows (R, N) off the columns local_q (Q, N), orthonormal in each record, in place.

        Q = 0 leaves them. That local_q is orthonormal is not checked; other shapes numpy refuses.
        """
        if len(local_q):
            for segment in self.segments:
                q = local_q[:, segment]
                rows[:, segment] -= (rows[:, segment] @ q.T) @ q

    def linearise(self, real: RealArray, pairs: ComplexArray, below: float = np.inf) -> Linearisation:
        """Cost and Kaufman linearisation at these poles.

        Compiled; by orthogonal factorisation where the columns are nearly dependent.

        Parameters
        ----------
        real : ndarray, shape (R,)
            Real poles.
        pairs : ndarray of complex, shape (P,)
            Poles above the axis, one per pair.
        below : float
            Where the cost is not below this, normal matrix and gradient are not filled.

        Returns
        -------
        Linearisation
            rss (output units squared), normal (B, B) and gradient (B,), B = R + 2 P. Of y with NaN all are
            NaN.

        Raises
        ------
        ValueError
            By `Poles`, for one that is not inside the circle, but only where products do not tell: else it is
            not checked.
        """
        blocks = blocks_of_poles(real, pairs)
        n = real.size + 2 * pairs.size
        normal = np.empty((n, n))
        gradient = np.empty(n)
        rss = linearise(
            blocks, real.size, self.u, self.y_clear, self.starts, self.polynomials_q,
            self.structure.feedthrough, self.structure.estimate_initial_state, below, normal, gradient,
        )  # fmt: skip
        # -1 says that products of the columns do not tell; neither does what is not finite.
        if not rss >= 0:
            return linearisation(self, Poles(real, pairs))
        return Linearisation(rss, normal, gradient)

    def residual(self, poles: Poles) -> RealArray:
        """Residual (N,) that the fit with these poles leaves of the output, in its units.

        With more columns than samples it is rounding: `fit` refuses that, this does not.
        """
        return project(self, poles).residual

    def colour(self, residual: RealArray) -> ResidualColour:
        """Colour of a residual (N,): see `residual_colour`, also for zeros and NaN."""
        return residual_colour(residual, self.starts)

    def criterion(self, rss: float, order: int, worth: float) -> Callable[[float, int], float]:
        """Criterion (J, order) -> number, lower is better: see `information_criterion`.

        rss and order are not used: records need no scale from a fit. worth: independent numbers, positive.
        """
        return information_criterion(float(self.y @ self.y), self, worth)

    def candidate_cost(self, space: SearchSpace, shared: Poles, local: Poles) -> CandidateCost:
        """Cost of candidates on top of frozen poles, whose columns are taken out of the output once, here.

        Parameters
        ----------
        space : SearchSpace
            Numbers of candidate poles and the box that their unit cube stands for.
        shared, local : Poles
            Frozen poles driven by the inputs; those with free responses.

        Returns
        -------
        CandidateCost
            J, output units squared, at points (D,) of the unit cube, writable arrays; compiled, so that
            points outside and shapes are not checked.
        """
        projection = project(self, shared, local)
        frozen = np.vstack([projection.shared_q, projection.residual])
        # Behind the all-pass of the frozen poles the candidates' functions stay orthogonal to theirs.
        drive = _driven(self, shared, self.u)[1]
        free = self.structure.estimate_initial_state
        known = (
            space.n_real, space.low.copy(), space.high.copy(), space.raw,
            drive, frozen, self.starts, projection.local_q, free,
        )  # fmt: skip

        def cost(unit: RealArray) -> float:
            """J, output units squared, at a point (D,) of the unit cube; nothing is checked."""
            return float(cost_of_point(unit, *known))

        return CandidateCost(space, float(self.y @ self.y), cost)


def information_criterion(power: float, data: PoleProblem, worth: float) -> Callable[[float, int], float]:
    """Criterion (J, order) -> Ne ln(J/N) + (free numbers) ln Ne, lower is better (Schwarz, 1978).

    Parameters
    ----------
    power : float
        |y|^2: a residual that is rounding of it counts as such, so that no pole explains rounding.
    data : PoleProblem
        Its N = `n_samples`, and `n_parameters` of an order.
    worth : float
        Ne, independent numbers that a residual is worth; positive, not checked.

    Returns
    -------
    callable
        Of a J that is zero or negative: the value at `EXPLAINED` |y|^2. Of NaN: NaN.
    """
    floor = max(EXPLAINED * power, np.finfo(np.float64).tiny)

    def value(rss: float, order: int) -> float:
        """Criterion of a fit with J = rss (unit of `power`) and this order; NaN for a J of NaN."""
        # Of N numbers Ne are independent, so the likelihood counts each Ne/N times.
        fall = worth * np.log(max(rss, floor) / data.n_samples)
        return float(fall + data.n_parameters(order) * np.log(worth))

    return value


@dataclass(frozen=True, eq=False)
class Projection:
    """Columns of a regression as rows, and the residual (N,) that they leave of the output.

    `project` makes it; nothing is checked.

    Attributes
    ----------
    local_q : ndarray, shape (Ql, N)
        Nuisance columns, orthonormal within each record.
    shared : ndarray, shape (Qs, N)
        The basis driven by each input, then inputs with a direct term.
    shared_q : ndarray, shape (Qs, N)
        `shared` made orthonormal to each other and to the local columns.
    triangle : ndarray, shape (Qs, Qs)
        R of their QR factorisation.
    residual : ndarray, shape (N,)
        What all these columns leave of the output.
    """

    local_q: RealArray
    shared: RealArray
    shared_q: RealArray
    triangle: RealArray
    residual: RealArray

    def coefficients(self, y: RealArray) -> RealArray:
        """Least-squares coefficients (Qs,) of the shared columns for the output y (N,).

        Output units per unit of a column. Directions weaker than `RANK_TOLERANCE` are left at zero; y with
        NaN gives NaN.
        """
        # Q is orthogonal to the local part of y, so that needs no subtraction here.
        projected = self.shared_q @ y
        theta = np.linalg.lstsq(self.triangle, projected, rcond=RANK_TOLERANCE)[0]
        return np.asarray(theta, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Least-squares fit at given poles.

    Attributes
    ----------
    coefficients : ndarray, shape (U, B)
        Of each input, one per basis function.
    feedthrough : ndarray, shape (U,)
        Direct terms; 0 where the fit has none.
    residual : ndarray, shape (N,)
        What the fit leaves of the output.
    rss : float
        Its sum of squares.
    """

    coefficients: RealArray
    feedthrough: RealArray
    residual: RealArray
    rss: float


def _driven(data: Regression, poles: Poles, signals: RealArray) -> tuple[RealArray, RealArray]:
    """Basis functions driven by signals (U, N) from rest in each record, and the signals behind the all-pass.

    (U B, N), the states of the first signal first, and (U, N), in the units of the signals. B: order of the
    poles; of data only `starts` counts. Compiled: that the signals have N samples is not checked.
    """
    rows = np.empty((signals.shape[0] * poles.order, signals.shape[1]))
    through = signals.copy()
    driven_rows(block_parameters(poles), poles.real.size, through, data.starts, rows)
    return rows, through


def project(data: Regression, shared: Poles, local: Poles | None = None) -> Projection:
    """Orthonormal columns of a regression, and the residual that they leave.

    Parameters
    ----------
    data : Regression
        The records.
    shared : Poles
        Poles of the basis that the inputs drive.
    local : Poles, optional
        Poles of the free responses; default: `shared`. Not used where records start from rest.

    Returns
    -------
    Projection
        Qs is U B, and U more with a direct term. With more columns than samples, or NaN, nothing is refused:
        the residual is rounding, or NaN.

    Notes
    -----
    With `shared` doubled and `local` not, all first-order changes of the poles are taken out of the residual,
    which is what candidates for a further pole see.
    """
    local = shared if local is None else local
    rows = _driven(data, shared, data.u)[0]
    if data.structure.feedthrough:
        rows = np.vstack([rows, data.u])

    # Nuisance columns of each record; without free responses the polynomials are known already.
    local_q = data.polynomials_q
    residual = data.y_clear.copy()
    if local.order > 0 and data.structure.estimate_initial_state:
        local_q = np.zeros((data.polynomials.shape[0] + local.order, data.n_samples))
        for segment in data.segments:
            free = free_response(local, segment.stop - segment.start)
            columns = np.column_stack([data.polynomials[:, segment].T, free])
            q, _ = np.linalg.qr(columns)
            local_q[: q.shape[1], segment] = q.T
        data.take_out_local(local_q, residual[np.newaxis])
    # No poles and no direct term: nothing is shared, and a factorisation of nothing is refused.
    if len(rows) == 0:
        return Projection(local_q, rows, rows, np.zeros((0, 0)), residual)

    # Shared columns, the local ones taken out of them.
    clear = rows.copy()
    data.take_out_local(local_q, clear)
    q, triangle = np.linalg.qr(clear.T)
    shared_q = np.ascontiguousarray(q.T)
    residual -= (shared_q @ residual) @ shared_q
    return Projection(local_q, rows, shared_q, triangle, residual)


def fit(data: Regression, poles: Poles) -> LinearFit:
    """Least-squares fit for given poles: theta = R^-1 Q^T y by thin QR (27).

    Parameters
    ----------
    data : Regression
        The records: N samples, U inputs.
    poles : Poles
        B poles of the basis.

    Returns
    -------
    LinearFit
        Directions that the data do not show (`RANK_TOLERANCE`) have coefficient zero. Signals with NaN give
        NaN. (27) is the paper's equation (Ziaei and Wang, 2006).

    Raises
    ------
    ValueError
        There are not more samples than free numbers.
    """
    needed = data.n_parameters(poles.order)
    if not data.n_samples > needed:
        raise ValueError(f"too few samples: {data.n_samples} for {needed} unknowns with {poles.order} poles")
    projection = project(data, poles)
    residual = projection.residual
    theta = projection.coefficients(data.y)
    n_of_basis = data.n_inputs * poles.order
    return LinearFit(
        coefficients=theta[:n_of_basis].reshape(data.n_inputs, poles.order),
        feedthrough=theta[n_of_basis:] if data.structure.feedthrough else np.zeros(data.n_inputs),
        residual=residual,
        rss=float(residual @ residual),
    )


def block_states(data: Regression, poles: Poles, signal: RealArray) -> RealArray:
    """States (B, N) of each block by itself driven by the signal (N,), record by record from rest.

    In the unit of the signal, real poles first, two rows per pair; (0, N) without poles.
    """
    parts = [_driven(data, block, signal[np.newaxis])[0] for block in poles.blocks()]
    return np.concatenate(parts) if parts else np.zeros((0, signal.size))


def linearisation(data: Regression, poles: Poles) -> Linearisation:
    """Cost and Kaufman linearisation at these poles, by orthogonal factorisation.

    `Regression.linearise` has the same answer several times as fast where the columns are not too dependent.
    rss (output units squared), normal (B, B), gradient (B,), all filled; NaN where the records have NaN.
    """
    projection = project(data, poles)
    # What the poles make of the output. A polynomial part stays in the span of free responses; without them
    # it has to be left out.
    fitted = np.asarray(data.y - projection.residual)
    if not data.structure.estimate_initial_state:
        fitted = np.asarray(projection.coefficients(data.y) @ projection.shared)
    # The states of each block that it drives, projected off the regression.
    residual = projection.residual
    states = block_states(data, poles, fitted)
    data.take_out_local(projection.local_q, states)
    states -= (states @ projection.shared_q.T) @ projection.shared_q
    return Linearisation(float(residual @ residual), states @ states.T, states @ residual)
