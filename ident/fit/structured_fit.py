"""Fit under a known relative degree, and its linearisation for a local refinement: variable projection with
the conditions R(p) c = 0 of `ident.basis.relative_degree`.

When a pole moves, the model at fixed numerator moves along a known direction g_p (`ident.fit.refinement`).
Taken back along the basis functions, g_p - L R^+ l(g_p), l being the conditions as functionals, it is tangent
to the constrained models; projected off what the coefficients can re-fit, these are Kaufman's sensitivities,
and the gradient -2 S^T r is exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ident.basis.poles import Poles
from ident.basis.relative_degree import conditions, conditions_with_sensitivities, null_space
from ident.data.arrays import ComplexArray, RealArray
from ident.fit.least_squares import RANK_TOLERANCE, LinearFit, Projection, Regression, block_states, project
from ident.fit.problem import Linearisation
from ident.fit.refinement import Bounds, Refined, free_optimality, refine

# Fastest real pole: decayed to this part within a sample. One at 0 or below has no continuous counterpart.
_FASTEST = 0.01


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

    Raises ValueError if a pole has no continuous-time counterpart, there are too few poles or samples, or the
    regression has a direct term.
    """
    solved = _solve(data, poles, relative_degree)
    residual = solved.residual
    return LinearFit(solved.coefficients[np.newaxis], np.zeros(1), residual, float(residual @ residual))


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
    left, values, right = np.linalg.svd(projection.triangle @ basis, full_matrices=False)
    kept = values > RANK_TOLERANCE * values[0]
    reachable = left[:, kept]
    along = reachable.T @ target
    coefficients = basis @ (right[kept].T @ (along / values[kept]))
    residual = projection.residual + projection.shared_q.T @ (target - reachable @ along)
    return _Constrained(projection, coefficients, inverse, reachable, residual)


@dataclass(frozen=True, eq=False)
class UnderRelativeDegree:
    """Records with one input, the coefficients kept to a relative degree: what `refine` asks of them.

    Fixed poles (first of each type) need no continuous-time counterpart; their directions are left at zero.
    """

    data: Regression
    relative_degree: int
    fixed: Poles

    @property
    def power(self) -> float:
        return self.data.power

    def sensitivities(self, poles: Poles) -> tuple[RealArray, RealArray]:
        """Residual (N,) and directions (B, N) in block states: how the fitted output moves, coefficients
        re-fitted all the time."""
        solved = _solve(self.data, poles, self.relative_degree)
        projection = solved.projection
        # Offsets are no output of the poles; with free responses among the columns polynomials do no harm.
        fitted = solved.coefficients @ projection.shared
        if self.data.structure.estimate_initial_state:
            fitted = self.data.y - solved.residual
        n_real, n_pairs = self.fixed.counts
        free = Poles(poles.real[n_real:], poles.pairs[n_pairs:])
        states = block_states(self.data, free, fitted)
        _, functionals = conditions_with_sensitivities(
            poles, self.data.structure.integrators, self.relative_degree, solved.coefficients, free.blocks()
        )
        self.data.take_out_local(projection.local_q, states)
        shared = projection.shared_q @ states.T
        states -= shared.T @ projection.shared_q
        # Back to the conditions along the basis functions, then off what the coefficients can re-fit.
        shared -= projection.triangle @ (solved.inverse @ functionals)
        shared -= solved.reachable @ (solved.reachable.T @ shared)
        states += shared.T @ projection.shared_q
        directions = np.zeros((poles.order, self.data.n_samples))
        first_pair = poles.real.size + 2 * n_pairs
        directions[n_real : poles.real.size] = states[: free.real.size]
        directions[first_pair:] = states[free.real.size :]
        return solved.residual, directions

    def linearise(self, real: RealArray, pairs: ComplexArray, below: float = np.inf) -> Linearisation:
        """Cost and linearisation at these poles."""
        residual, directions = self.sensitivities(Poles(real, pairs))
        return Linearisation(float(residual @ residual), directions @ directions.T, directions @ residual)

    def bounded(self, bounds: Bounds) -> Bounds:
        """The bounds without real poles that have no continuous-time counterpart."""
        return replace(bounds, distance_max=min(bounds.distance_max, 1 - _FASTEST))

    def refine(self, poles: Poles, bounds: Bounds, tolerance: float = 1e-9) -> Refined:
        """`ident.fit.refinement.refine` under the relative degree; real poles are kept at or above 0.01."""
        return refine(self, poles, self.bounded(bounds), self.fixed, max_iterations=100, tolerance=tolerance)

    def optimality(self, poles: Poles, bounds: Bounds) -> float:
        """|P r|/|r| over the tangent directions of the constrained models that no bound holds; 0: an
        optimum."""
        return free_optimality(self.linearise(*poles.writable()), poles, self.bounded(bounds), self.fixed)
