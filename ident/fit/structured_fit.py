"""Fit and descent under a known relative degree: variable projection with the conditions of
`ident.basis.relative_degree`.

For given poles the coefficients solve a least-squares problem under linear conditions R(p) c = 0. When a pole
moves, the model at fixed numerator moves along a known direction g_p (`ident.fit.refinement`) that in general
leaves the conditions; taken back along the basis functions, g_p - L R^+ l(g_p), it is tangent to the
constrained models, l being the conditions as functionals of a transfer function. Projected off what the
coefficients can re-fit, these are Kaufman's sensitivities, and the gradient -2 S^T r is exact as without
conditions. No derivative of R is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ident.basis.functions import block_parameters, regressor
from ident.basis.poles import Poles
from ident.basis.relative_degree import conditions, conditions_with_sensitivities, null_space
from ident.data.arrays import RealArray
from ident.fit.least_squares import LinearFit, Projection, project, shared_columns
from ident.fit.refinement import Bounds, Polished
from ident.fit.regression import Regression

_RANK_TOLERANCE = 1e-12
# Fastest real pole: decayed to this part within a sample. One at 0 or below has no continuous counterpart.
_FASTEST = 0.01
# Angle of a pair per sample: beyond pi a mode is folded back.
_HIGHEST = 0.995 * np.pi


@dataclass(frozen=True, eq=False)
class _Constrained:
    """Least squares under conditions, in the orthonormal columns of the fit without them."""

    projection: Projection
    coefficients: RealArray
    inverse: RealArray  # (B, r - 1), right inverse of the conditions
    reachable: RealArray  # (Q, B - r + 1), orthonormal: what coefficients that keep the conditions reach
    residual: RealArray


def structured_fit(data: Regression, poles: Poles, relative_degree: int) -> LinearFit:
    """Least squares for given poles among models of at least this relative degree.

    Raises
    ------
    ValueError
        If a pole has no continuous-time counterpart, there are too few poles or samples, or the regression
        has a direct term.
    """
    solved = _solve(data, poles, relative_degree)
    return LinearFit(solved.coefficients, 0.0, solved.residual, float(solved.residual @ solved.residual))


def _solve(data: Regression, poles: Poles, relative_degree: int) -> _Constrained:
    if data.structure.feedthrough:
        raise ValueError("relative_degree of 1 or more excludes a direct term; expected feedthrough = false")
    needed = data.n_parameters(poles.order) - (relative_degree - 1)
    if not data.n_samples > needed:
        raise ValueError(f"too few samples: {data.n_samples} for {needed} unknowns with {poles.order} poles")
    rows = conditions(poles, data.structure.integrators, relative_degree)
    projection = project(data, poles)
    basis, inverse = null_space(rows, np.linalg.norm(projection.triangle, axis=0))
    target = projection.shared_q @ data.y
    columns = projection.triangle @ basis
    left, values, right = np.linalg.svd(columns, full_matrices=False)
    kept = values > _RANK_TOLERANCE * values[0]
    reachable = left[:, kept]
    along = reachable.T @ target
    coefficients = basis @ (right[kept].T @ (along / values[kept]))
    residual = projection.residual + projection.shared_q.T @ (target - reachable @ along)
    return _Constrained(projection, coefficients, inverse, reachable, residual)


def structured_sensitivities(
    data: Regression,
    poles: Poles,
    relative_degree: int,
    *,
    n_fixed_real: int = 0,
    n_fixed_pairs: int = 0,
) -> tuple[LinearFit, RealArray]:
    """The fit, and how its output moves with each free unknown (N, P), coefficients re-fitted all the time.

    Unknowns in the order of `ident.fit.refinement`: 1 - a of real poles, then (s, f) of each pair, p = exp(-s
    + jf). The gradient of the residual sum of squares is -2 S^T r exactly.
    """
    solved = _solve(data, poles, relative_degree)
    projection = solved.projection
    fitted = data.y - solved.residual
    driven = shared_columns(data, poles) @ solved.coefficients
    if not data.structure.estimate_initial_state:
        # Offsets are no output of the poles; with free responses among the columns polynomials do no harm.
        fitted = driven
    blocks = (
        *(Poles([a]) for a in poles.real[n_fixed_real:]),  # type: ignore[arg-type]
        *(Poles(pairs=[pole]) for pole in poles.pairs[n_fixed_pairs:]),  # type: ignore[arg-type]
    )
    states = np.concatenate(
        [
            np.concatenate([regressor(block, fitted[data.segment(i)]) for i in range(data.n_records)])
            for block in blocks
        ],
        axis=1,
    )
    _, functionals = conditions_with_sensitivities(
        poles, data.structure.integrators, relative_degree, solved.coefficients, blocks
    )
    chain = _chain_rule(blocks)
    moved = states @ chain
    for i in range(data.n_records):
        here = data.segment(i)
        local = projection.local_q[:, here]
        moved[here] -= local.T @ (local @ moved[here])
    shared = projection.shared_q @ moved
    moved -= projection.shared_q.T @ shared
    shared -= projection.triangle @ (solved.inverse @ (functionals @ chain))
    shared -= solved.reachable @ (solved.reachable.T @ shared)
    moved += projection.shared_q.T @ shared
    return LinearFit(
        solved.coefficients, 0.0, solved.residual, float(solved.residual @ solved.residual)
    ), moved


def _chain_rule(blocks: tuple[Poles, ...]) -> RealArray:
    """(S, P): change of the output with each unknown as a combination of the block states it drives.

    A real block gives b/(z - a) y, and the model moves by -y/(z - a) with 1 - a; a pair gives
    sg (z - beta)/D y and sg sb/D y, and the model moves by (dt z - dg)/D y, D = z^2 - t z + g,
    t = 2 exp(-s) cos f, g = exp(-2 s).
    """
    chain = np.zeros((sum(block.order for block in blocks),) * 2)
    at = 0
    for block in blocks:
        p0, p1, p2, p3 = block_parameters(block)[0]
        if block.real.size:
            chain[at, at] = -1 / p1
        else:
            gamma, beta, sg, sb = p0, p1, p2, p3
            pole = block.pairs[0]
            dt, dg = np.array([-2 * pole.real, -2 * pole.imag]), np.array([-2 * gamma, 0.0])
            chain[at, at : at + 2] = dt / sg
            chain[at + 1, at : at + 2] = (dt * beta - dg) / (sg * sb)
        at += block.order
    return chain


@dataclass(frozen=True, eq=False)
class _Unknowns:
    """The free numbers of a descent (see `structured_sensitivities`) and the bounds they keep."""

    poles: Poles
    bounds: Bounds
    n_fixed_real: int
    n_fixed_pairs: int

    @property
    def n_real(self) -> int:
        return int(self.poles.real.size - self.n_fixed_real)

    def start(self) -> RealArray:
        log = np.log(self.poles.pairs[self.n_fixed_pairs :])
        pairs = np.column_stack([-log.real, log.imag]).ravel()
        return self.clipped(np.concatenate([1 - self.poles.real[self.n_fixed_real :], pairs]))

    def clipped(self, x: RealArray) -> RealArray:
        """The nearest unknowns within the bounds: decay of real poles, frequency and damping of pairs."""
        bounds, x = self.bounds, x.copy()
        real, s, f = x[: self.n_real], x[self.n_real :: 2], x[self.n_real + 1 :: 2]
        real[:] = np.clip(real, bounds.distance_min, min(bounds.distance_max, 1 - _FASTEST))
        s[:], f[:] = np.maximum(s, bounds.s_min), np.maximum(f, 1e-12)
        omega = np.hypot(s, f)
        zeta = np.clip(s / omega, bounds.zeta_min, bounds.zeta_max)
        omega = np.clip(omega, bounds.omega_min, bounds.omega_max)
        s[:] = np.maximum(zeta * omega, bounds.s_min)
        f[:] = np.minimum(omega * np.sqrt(1 - zeta**2), _HIGHEST)
        return x

    def poles_at(self, x: RealArray) -> Poles:
        pairs = np.exp(-x[self.n_real :: 2] + 1j * x[self.n_real + 1 :: 2])
        return Poles(
            np.concatenate([self.poles.real[: self.n_fixed_real], 1 - x[: self.n_real]]),
            np.concatenate([self.poles.pairs[: self.n_fixed_pairs], pairs]),
        )

    def movable(self, x: RealArray, direction: RealArray) -> npt.NDArray[np.intp]:
        """Indices of the unknowns that no bound holds when they are to go along `direction` (P,)."""
        free = []
        for i, sign in enumerate(np.sign(direction)):
            step = 1e-6 * abs(x[i]) * sign
            trial = x.copy()
            trial[i] += step
            if (self.clipped(trial)[i] - x[i]) * sign > 0.5 * abs(step):
                free.append(i)
        return np.array(free, dtype=np.intp)


def structured_polish(
    data: Regression,
    poles: Poles,
    relative_degree: int,
    bounds: Bounds,
    *,
    n_fixed_real: int = 0,
    n_fixed_pairs: int = 0,
    max_iterations: int = 100,
    tolerance: float = 1e-9,
) -> Polished:
    """Levenberg-Marquardt descent from the given poles under the relative degree; the first n_fixed poles of
    each type stay.

    Real poles are kept at or above 0.01. Stops when the decrease that the linearisation still promises is
    below `tolerance` of J.
    """
    unknowns = _Unknowns(poles, bounds, n_fixed_real, n_fixed_pairs)

    def at(x: RealArray) -> tuple[Poles, LinearFit, RealArray]:
        here = unknowns.poles_at(x)
        return here, *structured_sensitivities(
            data, here, relative_degree, n_fixed_real=n_fixed_real, n_fixed_pairs=n_fixed_pairs
        )

    x = unknowns.start()
    if x.size == 0:
        return Polished(poles, structured_fit(data, poles, relative_degree).rss, 0, True)
    current, linear, moved = at(x)
    floor = 1e-26 * float(data.y @ data.y)
    damping, growth = 1e-3, 2.0
    for iteration in range(max_iterations):
        free = unknowns.movable(x, moved.T @ linear.residual)
        if linear.rss <= floor or free.size == 0:
            return Polished(current, linear.rss, iteration, True)
        scale, values, right, along = _scaled(moved[:, free], linear.residual)
        if along @ along <= tolerance * linear.rss:
            return Polished(current, linear.rss, iteration, True)
        while True:
            weights = values / (values**2 + damping)
            trial_x = x.copy()
            trial_x[free] += (right.T @ (weights * along)) / scale
            trial_x = unknowns.clipped(trial_x)
            trial, trial_linear, trial_moved = at(trial_x)
            promised = float(np.sum(along**2 * (2 * weights * values - (weights * values) ** 2)))
            ratio = (linear.rss - trial_linear.rss) / promised if promised > 0 else 0.0
            if ratio > 1e-4:
                break
            damping *= growth
            growth *= 2
            if damping > 1e12:
                return Polished(current, linear.rss, iteration, False)
        x, current, linear, moved = trial_x, trial, trial_linear, trial_moved
        damping *= max(1 / 5, 1 - (2 * ratio - 1) ** 3)
        growth = 2.0
    return Polished(current, linear.rss, max_iterations, False)


def _scaled(moved: RealArray, residual: RealArray) -> tuple[RealArray, RealArray, RealArray, RealArray]:
    """Column lengths, singular values and right vectors of the sensitivities, and the residual along the left
    ones.

    Singular values of the sensitivities, not of their normal matrix: two slow poles lie close together.
    """
    scale = np.maximum(np.linalg.norm(moved, axis=0), 1e-300)
    left, values, right = np.linalg.svd(moved / scale, full_matrices=False)
    kept = values > _RANK_TOLERANCE * values[0]
    return scale, values[kept], right[kept], left.T[kept] @ residual


def structured_optimality(
    data: Regression,
    poles: Poles,
    relative_degree: int,
    bounds: Bounds,
    *,
    n_fixed_real: int = 0,
    n_fixed_pairs: int = 0,
) -> float:
    """|P r|/|r| over the tangent directions of the constrained models that no bound holds; 0: an optimum."""
    unknowns = _Unknowns(poles, bounds, n_fixed_real, n_fixed_pairs)
    x = unknowns.start()
    if x.size == 0:
        return 0.0
    linear, moved = structured_sensitivities(
        data, poles, relative_degree, n_fixed_real=n_fixed_real, n_fixed_pairs=n_fixed_pairs
    )
    free = unknowns.movable(x, moved.T @ linear.residual)
    if not linear.rss > 0 or free.size == 0:
        return 0.0
    along = _scaled(moved[:, free], linear.residual)[-1]
    return float(np.linalg.norm(along) / np.sqrt(linear.rss))
