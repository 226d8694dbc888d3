"""Fit under a known relative degree, and its linearisation for a local refinement.

It is variable projection with the conditions R(p) c = 0 of `ident.basis.relative_degree`. When a pole moves,
the model at fixed numerator moves along a known direction g_p (`ident.fit.refinement`). Taken back along the
basis functions, g_p - L R^+ l(g_p), l being the conditions as functionals, it is tangent to the constrained
models; projected off what the coefficients can re-fit, these are Kaufman's sensitivities, and the gradient
-2 S^T r is exact. `structured_fit` gives the coefficients at given poles, `UnderRelativeDegree` is what a
refinement of the poles needs. Records have one input.
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

# Fastest real pole, as its value a: decayed to this part within a sample. One at 0 or below has no continuous
# counterpart, and its logarithm would grow without end. Chosen; doubled or halved, no test of these fits
# fails.
_FASTEST = 0.01
# Most steps of a refinement. Chosen, above the 60 of a refinement without conditions; with 50 no test of
# these fits fails.
_MOST_STEPS = 100


@dataclass(frozen=True, eq=False)
class _Constrained:
    """Least squares under conditions, in the orthonormal columns of the fit without them.

    Attributes
    ----------
    projection : Projection
        Columns of the fit without conditions: shared_q (B, N) orthonormal, triangle (B, B), residual (N,).
    coefficients : ndarray, shape (B,)
        Those that keep the conditions.
    inverse : ndarray, shape (B, r - 1)
        Right inverse of the conditions.
    reachable : ndarray, shape (B, at most B - r + 1)
        Orthonormal: what coefficients that keep the conditions reach, in coordinates of shared_q.
    residual : ndarray, shape (N,)
        What they leave of the output.
    """

    projection: Projection
    coefficients: RealArray
    inverse: RealArray
    reachable: RealArray
    residual: RealArray


def structured_fit(data: Regression, poles: Poles, relative_degree: int) -> LinearFit:
    """Least squares for given poles among models of at least a relative degree.

    Parameters
    ----------
    data : Regression
        Records with one input: u (1, N), y (N,), structure without a direct term.
    poles : Poles
        B poles, the zeros of the integrators first.
    relative_degree : int
        r, at least 1.

    Returns
    -------
    LinearFit
        Coefficients (1, B), direct term 0, residual (N,) and its sum of squares.

    Raises
    ------
    ValueError
        A pole has no continuous-time counterpart (real and not above 0), there are too few poles or samples,
        relative_degree is below 1, or the regression has a direct term. Several inputs are not refused by
        name: shapes do not fit then. Signals with NaN give NaN or numpy's LinAlgError.
    """
    solved = _solve(data, poles, relative_degree)
    residual = solved.residual
    rss = float(residual @ residual)
    return LinearFit(solved.coefficients[np.newaxis], np.zeros(1), residual, rss)


def _solve(data: Regression, poles: Poles, relative_degree: int) -> _Constrained:
    """Solution of the constrained problem at given poles, with what its linearisation needs.

    data (N samples, one input), poles (B, the zeros of the integrators first) and r as for `structured_fit`;
    raises as it does.
    """
    if data.structure.feedthrough:
        raise ValueError("relative_degree of 1 or more excludes a direct term; expected feedthrough = false")
    needed = data.n_parameters(poles.order) - (relative_degree - 1)
    if not data.n_samples > needed:
        raise ValueError(f"too few samples: {data.n_samples} for {needed} unknowns with {poles.order} poles")

    # c = basis a keeps the conditions for every a; least squares in a, whose weak directions are left out.
    rows = conditions(poles, data.structure.integrators, relative_degree)
    projection = project(data, poles)
    column_lengths = np.linalg.norm(projection.triangle, axis=0)
    basis, inverse = null_space(rows, column_lengths)
    target = projection.shared_q @ data.y
    left, values, right = np.linalg.svd(projection.triangle @ basis, full_matrices=False)
    is_shown = values > RANK_TOLERANCE * values[0]
    reachable = left[:, is_shown]
    along = reachable.T @ target
    coefficients = basis @ (right[is_shown].T @ (along / values[is_shown]))

    # What the conditions keep from the fit comes on top of what the columns leave anyway.
    out_of_reach = target - reachable @ along
    residual = projection.residual + projection.shared_q.T @ out_of_reach
    return _Constrained(projection, coefficients, inverse, reachable, residual)


@dataclass(frozen=True, eq=False)
class UnderRelativeDegree:
    """Records with one input, the coefficients kept to a relative degree: what `refine` asks of them.

    Attributes
    ----------
    data : Regression
        The records.
    relative_degree : int
        r, at least 1.
    fixed : Poles
        Poles that do not move, first of each type; their numbers count, and that they come first is not
        checked. Their directions are left at zero.

    Bad input is refused when the poles are fitted (`structured_fit`), not here.
    """

    data: Regression
    relative_degree: int
    fixed: Poles

    @property
    def power(self) -> float:
        """Square sum of the outputs without the part of constants and the like, output units squared."""
        return self.data.power

    def sensitivities(self, poles: Poles) -> tuple[RealArray, RealArray]:
        """Residual, and how the fitted output moves with the poles, coefficients re-fitted all the time.

        Parameters
        ----------
        poles : Poles
            B poles, the fixed ones first of each type.

        Returns
        -------
        residual : ndarray, shape (N,)
            In units of the output.
        directions : ndarray, shape (B, N)
            By block states: one per real pole, two per pair; zero for fixed poles. In units of the output.

        Raises
        ------
        ValueError
            As `structured_fit`.
        """
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
        # Split into a part outside the columns of the fit, and coordinates (B, S) within them.
        shared = projection.shared_q @ states.T
        states -= shared.T @ projection.shared_q
        # Back to the conditions along the basis functions, then off what the coefficients can re-fit.
        shared -= projection.triangle @ (solved.inverse @ functionals)
        shared -= solved.reachable @ (solved.reachable.T @ shared)
        states += shared.T @ projection.shared_q

        # Rows of all poles, those of the fixed ones zero.
        directions = np.zeros((poles.order, self.data.n_samples))
        first_pair = poles.real.size + 2 * n_pairs
        directions[n_real : poles.real.size] = states[: free.real.size]
        directions[first_pair:] = states[free.real.size :]
        return solved.residual, directions

    def linearise(self, real: RealArray, pairs: ComplexArray, below: float = np.inf) -> Linearisation:
        """Cost and linearisation at real poles (R,) and pairs (P,), the poles above the axis.

        rss in output units squared, normal (B, B), gradient (B,), all filled. `below` is not used: nearly all
        of the work is done before the cost is known. Raises ValueError as `structured_fit`, and by `Poles`
        for one that is not inside the circle.
        """
        residual, directions = self.sensitivities(Poles(real, pairs))
        rss = float(residual @ residual)
        return Linearisation(rss, directions @ directions.T, directions @ residual)

    def bounded(self, bounds: Bounds) -> Bounds:
        """Bounds (distance_max, 1 - a, at most .99) without real poles of no continuous-time counterpart.

        A stated distance_min beyond that is not refused: `Bounds`.
        """
        return replace(bounds, distance_max=min(bounds.distance_max, 1 - _FASTEST))

    def refine(self, poles: Poles, bounds: Bounds, tolerance: float = 1e-9) -> Refined:
        """Poles downhill from the given ones, under the relative degree.

        As `ident.fit.refinement.refine`, with real poles kept at or above `_FASTEST`. bounds: a start outside
        is brought inside. tolerance: promised fall of J, as a share of it, below which a point counts as
        stationary; the default is that of `refine`. Raises ValueError as `structured_fit`.
        """
        limits = self.bounded(bounds)
        return refine(self, poles, limits, self.fixed, max_iterations=_MOST_STEPS, tolerance=tolerance)

    def optimality(self, poles: Poles, bounds: Bounds) -> float:
        """Share |P r|/|r| of the residual that moving poles could explain, to first order; 0: an optimum.

        P projects on the tangent directions of the constrained models that no bound holds; r (N,) is the
        residual of the fit. 0 also where r is zero. Raises ValueError as `structured_fit`.
        """
        linearisation = self.linearise(*poles.writable())
        return free_optimality(linearisation, poles, self.bounded(bounds), self.fixed)
