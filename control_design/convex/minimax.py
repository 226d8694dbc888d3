"""Smallest worst ratio of a convex over a concave function, many rows at once: the core of bound and
reference filter.

Every row looks at one complex number y_k = sum_i basis_ki x_i, a vector of the plane, and asks that |A y + a|
<= gamma m(y) with m(y) = e + E y - |C y + c|: convex in x for fixed gamma. `smallest_ratio` finds the
smallest gamma by Dinkelbach's iteration (Management Science 13, 1967): gamma_j is the worst ratio at x_j,
then x_{j+1} minimises the largest (|A y + a| - gamma_j m(y))/m(y_j). Each of these is a convex programme,
solved by a primal-dual interior point (`_Scaled.lower`) in coordinates in which the rows are well scaled.
`exchanged` repeats such a programme on a grid to which the frequencies that a dense check found violated are
added.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg

from control_design.plants.ellipses import Complex, Integer, Real, quotient
from control_design.plants.frequency_grid import with_violations

# Radius r of the rounding sqrt(|p|^2 + r^2) of a numerator |p| at its kink, as a share of an active
# numerator: it changes an active row by r^2/2 = 5e-7 of it, a twentieth of the accuracy asked by default.
_NUMERATOR_ROUNDING_SHARE = 1e-3

# Radius of the rounding of |C y + c|. Denominators are about one, so they are off by at most this, and at the
# kink alone. Chosen.
_REACH_ROUNDING = 1e-4

# Radius of it while denominators are being made positive: their maximum may sit on the kink, where a smaller
# one leaves Newton's method hardly any curvature to go by. Chosen.
_FEASIBILITY_ROUNDING = 1e-2

# Relative excess of the dense check over the programme that ends an exchange of frequencies: what the last
# gamma may be too low by. Chosen well below the per cent by which bounds are compared.
EXCHANGE_TOLERANCE = 5e-4

# Most steps of the interior point in one round. Usual are 5 to 40; a round that ends early leaves a higher
# gamma.
_MOST_STEPS = 200

# Singular values of the basis below this share of the largest are rounding, no directions of the search. The
# best Q of an unstable plant with a resonance has a part at 1e-13.
_SMALLEST_SINGULAR_SHARE = 1e-14

# A least-squares start is shortened, up to so many times by this factor, until all denominators exceed the
# margin: y = 0 is the loop without Q, whose denominators are about one.
_MOST_START_SHORTENINGS = 30

# Factor of each shortening, 0.7^30 = 2e-5 in all. Chosen; a smaller one throws more of the start away.
_START_SHORTENING = 0.7

# Denominator that all rows must exceed before a start is taken. Chosen: on the edge of feasibility the next
# point has an infinite ratio.
_START_MARGIN = 0.05

# The search for a point with positive denominators ends when all exceed this: ratios up to a thousand times
# the numerators are finite enough for the next programme to lower. Chosen.
_FEASIBLE_MARGIN = 1e-3

# Share of the way to the boundary that a step of the interior point goes (usual: .99 to .9995), the careful
# end: rows bend.
_TO_BOUNDARY_SHARE = 0.99

# Smallest share of the gap that the centring of a step aims at, so that slacks do not fall to zero at once.
# Chosen.
_LEAST_CENTRING = 1e-3

# Relative increase of the diagonal of the Newton system, some thousand times its rounding.
_REGULARISATION_SHARE = 1e-13

# Shortest step that is tried where rows bend away from their linearisation: 26 halvings. Chosen; a step that
# short ends nothing, the best point is kept.
_SHORTEST_STEP = 1e-8

# Steps to a boundary that is farther away than this many steps count as this long: a finite number for one
# that is never reached. Lengths above 1 are cut to 1 anyway.
_LONGEST_TO_BOUNDARY = 1e3


@dataclass(frozen=True, eq=False)
class PlaneRows:
    """R ratios |A y + a|/(e + E y - |C y + c|), each of one of F plane vectors y (2,).

    Parameters
    ----------
    at : (R,) integer array
        Which of the F vectors each row looks at, from 0.
    A, a : (R, 2, 2), (R, 2) array
        Numerator.
    e, E, C, c : (R,), (R, 2), (R, 2, 2), (R, 2) array
        Denominator.

    Notes
    -----
    Real and finite; no shape is checked, and what does not fit is an error of numpy at the first evaluation.
    """

    at: Integer
    A: Real
    a: Real
    e: Real
    E: Real
    C: Real
    c: Real

    @classmethod
    def stacked(cls, parts: Sequence[PlaneRows]) -> PlaneRows:
        """Rows of all parts, which look at the same F vectors, one part after the other; at least one part
        (numpy's ValueError without)."""
        values = []
        for field in fields(cls):
            values.append(np.concatenate([getattr(part, field.name) for part in parts]))
        return cls(*values)

    def numerator(self, y: Real) -> Real:
        """|A y + a|, (R,), for vectors y (F, 2), F above every number in `at` (else an IndexError)."""
        vector = np.einsum("rij,rj->ri", self.A, y[self.at]) + self.a
        return np.asarray(np.hypot(vector[:, 0], vector[:, 1]))

    def denominator(self, y: Real) -> Real:
        """e + E y - |C y + c|, (R,), for vectors y (F, 2); a row counts as feasible where it is positive."""
        vector = np.einsum("rij,rj->ri", self.C, y[self.at]) + self.c
        level = self.e + np.einsum("rj,rj->r", self.E, y[self.at])
        return np.asarray(level - np.hypot(vector[:, 0], vector[:, 1]))

    def ratio(self, y: Real) -> Real:
        """Numerator over denominator, (R,), for vectors y (F, 2); infinite where the denominator is not
        positive."""
        return np.asarray(quotient(self.numerator(y), self.denominator(y), np.inf))


def plane(value: Complex) -> Real:
    """Complex numbers (R,) as vectors of the plane (R, 2): real and imaginary part. Any shape (...) gives
    (..., 2)."""
    return np.stack([value.real, value.imag], axis=-1)


class MinimaxPoint(NamedTuple):
    """A point of the programme: x (n,) in the original basis, and gamma, the largest ratio there; gamma is
    infinite if no x was found that makes every denominator positive."""

    x: Real
    gamma: float


def smallest_ratio(
    basis: Complex,
    rows: PlaneRows,
    start: Real | None = None,
    *,
    most_rounds: int = 30,
    accuracy: float = 1e-5,
) -> MinimaxPoint:
    """Point with the smallest largest ratio of numerator over denominator.

    Parameters
    ----------
    basis : (F, n) complex array
        The vectors are y = basis x, as complex numbers, for real x.
    rows : PlaneRows
        R ratios of these F vectors.
    start : (n,) array or None
        Where to begin, if all denominators are positive there; else at the least-squares solution of the
        numerators, shortened until they are.
    most_rounds : int
        Of Dinkelbach's iteration; 3 to 8 are usual, 30 a limit.
    accuracy : float
        Relative, of gamma. The default is far below the per cents by which bounds are compared.

    Returns
    -------
    MinimaxPoint
        Its gamma is the exact largest ratio at its x. Infinite where no x with positive denominators was
        found.

    Raises
    ------
    ValueError
        Without rows, or for arrays that do not fit or are not finite, from numpy (LinAlgError among them).
    """
    programme = _Scaled(basis, rows, accuracy)
    if start is not None:
        start_is_feasible = np.min(rows.denominator(plane(basis @ start))) > 0
        if not start_is_feasible:
            start = None
    # Coordinates z of the start.
    if start is None:
        z = programme.least_squares()
        for _ in range(_MOST_START_SHORTENINGS):
            if np.min(rows.denominator(programme.planar @ z)) > _START_MARGIN:
                break
            z = _START_SHORTENING * z
    else:
        z = programme.back @ start
    if not np.isfinite(programme.ratio(z)):
        unit_scale = np.ones(rows.at.size)
        z = programme.lower(z, 0.0, unit_scale, stop_below=-_FEASIBLE_MARGIN, feasibility=True)
    gamma = programme.ratio(z)
    if not np.isfinite(gamma):
        return MinimaxPoint(programme.map @ z, gamma)
    for _ in range(most_rounds):
        lowered = programme.lower(z, gamma, rows.denominator(programme.planar @ z))
        lowered_gamma = programme.ratio(lowered)
        if not lowered_gamma < gamma:
            break
        gain = gamma - lowered_gamma
        z = lowered
        gamma = lowered_gamma
        # With constant denominators one round is the answer.
        if gain < accuracy * gamma or programme.constant:
            break
    return MinimaxPoint(programme.map @ z, gamma)


@dataclass(frozen=True, eq=False)
class Exchanged:
    """Best point of an exchange of frequencies.

    Parameters
    ----------
    x : (n,) array or None
        None: no round found a point with positive denominators.
    values : list of (F,) arrays
        Values at x on every dense grid; empty with x.
    gamma : float
        Of the last programme with a finite one, on its lean grids; 0 where there was none.
    """

    x: Real | None
    values: list[Real]
    gamma: float

    @property
    def worst(self) -> float:
        """Largest of the values on all dense grids; infinite without any."""
        return max((float(np.max(value)) for value in self.values), default=float("inf"))


def exchanged(
    solve: Callable[[Real | None], MinimaxPoint],
    check: Callable[[Real], list[Real]],
    grids: list[Real],
    dense: Sequence[Real],
    *,
    rounds: int,
    most: int,
    start: Real | None = None,
) -> Exchanged:
    """Best point of a programme on lean grids to which violated frequencies of dense ones are added.

    Parameters
    ----------
    solve : callable
        From a start (n,), or None, to the optimum on the grids as they are.
    check : callable
        From x (n,) to its values (F,) at the frequencies of every dense grid.
    grids : list of (G,) arrays
        Lean grids in rad/s, which `solve` reads; changed in place.
    dense : sequence of (F,) arrays
        Dense grids in rad/s, one for each lean one.
    rounds : int
        Exchanges at most, not negative; the programme is solved once more than that.
    most : int
        Largest maxima of each dense grid that are added in a round.
    start : (n,) array or None
        For the first programme; each later one begins at the last optimum.

    Returns
    -------
    Exchanged
        The point with the smallest worst value. Ends when no value exceeds gamma by more than
        `EXCHANGE_TOLERANCE`, or when a programme finds no point. One array of values for each dense grid,
        else a ValueError; what `solve` and `check` raise goes up.
    """
    best = Exchanged(None, [], 0.0)
    for _ in range(rounds + 1):
        point = solve(start)
        if not np.isfinite(point.gamma):
            break
        start = point.x
        values = check(start)
        candidate = Exchanged(start, values, point.gamma)
        best = candidate if candidate.worst < best.worst else replace(best, gamma=point.gamma)
        limit = point.gamma * (1.0 + EXCHANGE_TOLERANCE)
        if candidate.worst <= limit:
            break
        for number, (omega, value) in enumerate(zip(dense, values, strict=True)):
            grids[number] = with_violations(grids[number], omega, value, limit, most)
    return best


class _Scaled:
    """The rows in coordinates z (m,) that are orthonormal as seen by them, and the convex programme in z.

    map (n, m) and back (m, n): x = map z, z = back x. planar (F, 2, m): y = planar z. constant: no
    denominator depends on x. All rows at one frequency see the same y: what they say of z is said of y first,
    in the plane, and summed over the rows there before it is taken to z.
    """

    def __init__(self, basis: Complex, rows: PlaneRows, accuracy: float) -> None:
        """Coordinates for basis (F, n) complex and R rows; accuracy is that of gamma, relative.

        Directions of x that no row sees are left out, so m <= n. n = 0 is an IndexError, a basis or rows that
        are not finite a LinAlgError.
        """
        self.rows = rows
        self.accuracy = accuracy
        planar = np.stack([basis.real, basis.imag], axis=1)
        # Gram matrix of all that rows see of x, by its factor: singular values tell which directions are
        # rounding.
        numerator_gram = np.einsum("rji,rjk->rik", rows.A, rows.A)
        reach_gram = np.einsum("rji,rjk->rik", rows.C, rows.C)
        gram = _summed(rows.at, numerator_gram + reach_gram, len(basis))
        triangle = np.linalg.qr(_half(gram, planar), mode="r")
        _, sizes, directions = np.linalg.svd(triangle)
        is_direction = sizes > _SMALLEST_SINGULAR_SHARE * sizes[0]
        directions = directions[is_direction]
        sizes = sizes[is_direction]
        self.map = directions.T / sizes * np.sqrt(rows.at.size)
        self.back = (directions * sizes[:, None]) / np.sqrt(rows.at.size)
        self.planar = planar @ self.map
        self.constant = not (np.any(rows.C) or np.any(rows.E))
        self._reach_rounding = _REACH_ROUNDING
        self._fixed_reach = np.hypot(rows.c[:, 0], rows.c[:, 1])

    def least_squares(self) -> Real:
        """z (m,) with the smallest sum of squared numerators; denominators may be of any sign there."""
        rows = self.rows
        seen = np.matmul(rows.A, self.planar[rows.at]).reshape(-1, self.planar.shape[2])
        return np.asarray(np.linalg.lstsq(seen, -rows.a.reshape(-1), rcond=None)[0])

    def ratio(self, z: Real) -> float:
        """Largest ratio of all rows at z (m,); infinite where a denominator is not positive."""
        return float(np.max(self.rows.ratio(self.planar @ z)))

    def seen(self, z: Real) -> Real:
        """Vector y that every row looks at, (R, 2), for z (m,); linear, so for a step of z the step of y. z
        of another length is numpy's ValueError, here and in what follows."""
        return np.asarray((self.planar @ z)[self.rows.at])

    def onto_z(self, vectors: Real) -> Real:
        """Sum over the rows of the linear forms vectors (R, 2) of their y, as one linear form (m,) of z: the
        transpose of `seen`."""
        summed = _summed(self.rows.at, vectors, len(self.planar))
        return np.asarray(summed.reshape(-1) @ self.planar.reshape(-1, self.planar.shape[2]))

    def lower(
        self, z: Real, gamma: float, scale: Real, *, stop_below: float = -np.inf, feasibility: bool = False
    ) -> Real:
        """Coordinates with the smallest largest h of all rows, h = (|A y + a| - gamma m(y))/scale.

        Parameters
        ----------
        z : (m,) array
            Where to begin.
        gamma : float
            Fixed in this programme.
        scale : (R,) array
            Denominators m(y) at the point that gave gamma; positive.
        stop_below : float
            The largest h below which the search ends.
        feasibility : bool
            h = -m(y) instead: to make all denominators positive.

        Returns
        -------
        (m,) array
            The best of the points passed; z itself where none is better.

        Notes
        -----
        Primal-dual interior point for min v with h - v + slack = 0, predictor and corrector (Mehrotra, SIAM
        J. Optimization 2, 1992); slacks are variables of their own. It ends when the gap is below a twentieth
        of what was gained, as the next gamma changes the programme anyway, or at full accuracy where this is
        the last one.
        """
        if feasibility:
            weight = 0.0
            factor = 1.0
            self._reach_rounding = _FEASIBILITY_ROUNDING
        else:
            weight = 1.0
            factor = gamma
            self._reach_rounding = _REACH_ROUNDING
        n = z.size
        h = self._values(z, weight, factor, scale)
        begin = float(np.max(h))
        # Slacks to begin with are a tenth of the size of gamma, duals their inverses, scaled to the sum of
        # one that the optimum has. Chosen.
        v = begin + 0.1 * factor
        slack = v - h
        dual = 1.0 / slack
        dual /= np.sum(dual)
        best = z
        best_value = begin
        is_last_programme = feasibility or self.constant
        for _ in range(_MOST_STEPS):
            # Newton system of z and v, with the slacks and duals eliminated.
            by_row, blocks = self._derivatives(z, weight, factor, scale, dual)
            miss = h - v + slack
            ratio = dual / slack
            weighted = by_row * ratio[:, None]
            blocks += by_row[:, :, None] * weighted[:, None, :]
            half = _half(_summed(self.rows.at, blocks, len(self.planar)), self.planar)
            matrix = np.empty((n + 1, n + 1))
            # A product of an array with itself is half the work.
            matrix[:n, :n] = half.T @ half
            coupling = -self.onto_z(weighted)
            matrix[:n, n] = coupling
            matrix[n, :n] = coupling
            matrix[n, n] = np.sum(ratio)
            matrix[np.diag_indices(n + 1)] *= 1.0 + _REGULARISATION_SHARE
            factored = scipy.linalg.lu_factor(matrix, check_finite=False)
            gap = float(np.mean(dual * slack))
            # Predictor towards a gap of zero, then corrector towards the share of the gap that it left.
            target: Real | float = 0.0
            for corrector in (False, True):
                pull = target / slack + ratio * miss
                right = np.append(self.onto_z(by_row * pull[:, None]), 1.0 - np.sum(pull))
                step = -scipy.linalg.lu_solve(factored, right, check_finite=False)
                rise = np.sum(by_row * self.seen(step[:n]), axis=1)
                change = rise - step[n]
                slack_step = -miss - change
                dual_step = pull - dual + ratio * change
                primal_length = _to_boundary(slack, slack_step)
                dual_length = _to_boundary(dual, dual_step)
                if not corrector:
                    predicted_slack = slack + min(1.0, primal_length) * slack_step
                    predicted_dual = dual + min(1.0, dual_length) * dual_step
                    predicted_gap = float(np.mean(predicted_slack * predicted_dual))
                    # The cube is Mehrotra's.
                    share = min(1.0, max(predicted_gap / gap, 0.0)) ** 3
                    target = max(share, _LEAST_CENTRING) * gap - slack_step * dual_step
            # The system has become singular to working precision: the best point stands.
            if not np.all(np.isfinite(step)):
                break
            length = min(1.0, _TO_BOUNDARY_SHARE * min(primal_length, dual_length))
            # What convex rows lie above their linearisation is its error: far from the kinks steps would run
            # away.
            largest_error = float(np.max(slack))
            new_h = self._values(z + length * step[:n], weight, factor, scale)
            while np.max(new_h - h - length * rise) > largest_error and length > _SHORTEST_STEP:
                length *= 0.5
                new_h = self._values(z + length * step[:n], weight, factor, scale)
            z = z + length * step[:n]
            v = v + length * float(step[n])
            slack = slack + length * slack_step
            dual = dual + length * dual_step
            h = new_h
            largest = float(np.max(h))
            if largest < best_value:
                best = z
                best_value = largest
            # What gap and error end the programme, in units of gamma: a third of the accuracy asked for in
            # the last programme; before it a twentieth of what was gained, or a tenth of the accuracy.
            # Chosen.
            if is_last_programme:
                small = 0.3 * self.accuracy * factor
            else:
                gained = max(begin - best_value, 0.0)
                small = max(0.05 * gained, 0.1 * self.accuracy * factor)
            gap_is_closed = float(dual @ slack) < small and largest - best_value < small
            if best_value < stop_below or (gap_is_closed and np.max(h - v + slack) < small):
                break
        return best

    def _parts(self, z: Real, rounding: Real) -> tuple[Real, Real, Real, Real, Real]:
        """Parts of all rows at z (m,): vectors p = A y + a and q = C y + c (R, 2), their sizes (R,) rounded
        at the kink, and e + E y (R,). rounding (R,): radius for the numerators. For constant denominators q
        is not used and stands for p."""
        rows = self.rows
        y = self.seen(z)
        p = np.einsum("rij,rj->ri", rows.A, y) + rows.a
        size_p = np.sqrt(p[:, 0] ** 2 + p[:, 1] ** 2 + rounding**2)
        if self.constant:
            return p, p, size_p, self._fixed_reach, rows.e
        q = np.einsum("rij,rj->ri", rows.C, y) + rows.c
        size_q = np.sqrt(q[:, 0] ** 2 + q[:, 1] ** 2 + self._reach_rounding**2)
        level = rows.e + np.sum(rows.E * y, axis=1)
        return p, q, size_p, size_q, level

    def _values(self, z: Real, weight: float, gamma: float, scale: Real) -> Real:
        """h (R,) of all rows at z (m,): (weight |A y + a| - gamma m(y))/scale with rounded kinks.

        scale (R,), positive; weight is 1, or 0 to look at denominators only. Of gamma 0 numerators have no
        rounding, and h is their size over the scale.
        """
        rounding = _NUMERATOR_ROUNDING_SHARE * gamma * scale
        _, _, size_p, size_q, level = self._parts(z, rounding)
        return np.asarray((weight * size_p - gamma * (level - size_q)) / scale)

    def _derivatives(
        self, z: Real, weight: float, gamma: float, scale: Real, dual: Real
    ) -> tuple[Real, Real]:
        """Gradients (R, 2) of h by the y of each row, and dual (R,) times its Hessians (R, 2, 2), at z (m,).

        weight, gamma and scale (R,) as of `_values`; dual (R,), positive: the multiplier of each row.
        The Hessian of size = sqrt(|p|^2 + r^2) is (w w^T + (r/size)^2 u u^T)/size, u along p and w across it.
        """
        rows = self.rows
        rounding = _NUMERATOR_ROUNDING_SHARE * gamma * scale
        p, q, size_p, size_q, _ = self._parts(z, rounding)
        share = dual / scale
        gradient, hessian = _norm_derivatives(rows.A, p, size_p, rounding, weight * share)
        gradient *= (weight / scale)[:, None]
        if not self.constant:
            reach_rounding = np.full(size_q.size, self._reach_rounding)
            reach_gradient, reach_hessian = _norm_derivatives(
                rows.C, q, size_q, reach_rounding, gamma * share
            )
            gradient += (gamma / scale)[:, None] * (reach_gradient - rows.E)
            hessian += reach_hessian
        return gradient, hessian


def _summed(at: Integer, values: Real, count: int) -> Real:
    """Sum of values (R, ...) over the rows that look at each of `count` vectors, (count, ...); at (R,) holds
    numbers from 0 below count. Zero where no row looks."""
    flat = values.reshape(len(values), -1)
    columns = [np.bincount(at, weights=column, minlength=count) for column in flat.T]
    return np.asarray(np.stack(columns, axis=1).reshape(count, *values.shape[1:]), dtype=np.float64)


def _half(blocks: Real, planar: Real) -> Real:
    """H (2 F, m) with H^T H = sum over F of P^T B P, for blocks B (F, 2, 2), symmetric and not negative, and
    planar P (F, 2, m): each B by its Cholesky factor. What rounding makes negative counts as 0; a negative
    first entry gives nan."""
    first_root = np.sqrt(blocks[:, 0, 0])
    cross = np.divide(blocks[:, 0, 1], first_root, out=np.zeros_like(first_root), where=first_root > 0)
    second_root = np.sqrt(np.maximum(blocks[:, 1, 1] - cross**2, 0.0))
    half = np.empty((2, *planar.shape[::2]))
    np.multiply(first_root[:, None], planar[:, 0], out=half[0])
    half[0] += cross[:, None] * planar[:, 1]
    np.multiply(second_root[:, None], planar[:, 1], out=half[1])
    return half.reshape(-1, planar.shape[2])


def _to_boundary(value: Real, step: Real) -> float:
    """Largest length of a step (R,) for which all positive values (R,) stay so, at most
    `_LONGEST_TO_BOUNDARY`; entries of a step that are nan are passed over."""
    falling = step < 0
    return float(np.min(-value[falling] / step[falling], initial=_LONGEST_TO_BOUNDARY))


def _norm_derivatives(
    forms: Real, vector: Real, size: Real, rounding: Real, weight: Real
) -> tuple[Real, Real]:
    """Gradients (R, 2) by y of the rounded norms of R plane vectors, and weight times their Hessians (R, 2,
    2).

    vector (R, 2) = forms (R, 2, 2) y + a constant; size (R,) = sqrt(|vector|^2 + rounding^2); weight (R,).
    Where a vector is zero its direction does not matter, and the first axis is taken. A size of 0, a zero
    vector without rounding, gives nan.
    """
    length = np.hypot(vector[:, 0], vector[:, 1])
    is_positive = length > 0
    direction = np.where(is_positive[:, None], vector, [1.0, 0.0])
    direction = direction / np.where(is_positive, length, 1.0)[:, None]
    u_x = direction[:, 0, None]
    u_y = direction[:, 1, None]
    along = u_x * forms[:, 0] + u_y * forms[:, 1]
    across = u_x * forms[:, 1] - u_y * forms[:, 0]
    gradient = along * (length / size)[:, None]
    curvature = weight / size
    hessian = curvature[:, None, None] * across[:, :, None] * across[:, None, :]
    along_curvature = curvature * (rounding / size) ** 2
    hessian += along_curvature[:, None, None] * along[:, :, None] * along[:, None, :]
    return gradient, hessian
