"""Smallest worst ratio of a convex over a concave function, many rows at once: the core of bound and
reference filter.

Every row looks at one complex number y_k = sum_i basis_ki x_i, a vector of the plane, and asks |A y + a| <=
gamma (e + E y - |C y + c|), convex in x for fixed gamma. Dinkelbach's iteration: gamma_j = worst ratio at
x_j, then x_{j+1} minimises the largest (|A y + a| - gamma_j m(y))/m(y_j), a convex programme, by an interior
point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg

from control_design.plants.ellipses import Complex, Integer, Real, quotient
from control_design.plants.frequency_grid import with_violations

# Radii of the rounding of |.| at its kink, a thousandth of an active numerator: it changes the row by 5e-7.
_ROUND_NUMERATOR = 1e-3
_ROUND_REACH = 1e-4  # denominators are about one: off by at most 1e-4, at the kink alone
_ROUND_FEASIBILITY = 1e-2  # while denominators are being made positive: their maximum may sit on the kink
EXCHANGE_TOLERANCE = 5e-4  # relative; accepted of the dense check over the programme
_MOST_STEPS = 200  # of the interior point in one round; 5 to 40 are usual
# Singular values of the basis below this fraction are no directions of the search: rounding. The best Q of an
# unstable plant with a resonance has a part at 1e-13.
_KEPT = 1e-14


@dataclass(frozen=True, eq=False)
class PlaneRows:
    """R rows on F plane vectors: at (R,) position k of each row; A (R, 2, 2), a (R, 2) numerator; e (R,),
    E (R, 2), C (R, 2, 2), c (R, 2) denominator."""

    at: Integer
    A: Real
    a: Real
    e: Real
    E: Real
    C: Real
    c: Real

    @classmethod
    def stacked(cls, parts: Sequence[PlaneRows]) -> PlaneRows:
        """All of them together."""
        names = (field.name for field in fields(cls))
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def numerator(self, y: Real) -> Real:
        """|A y + a| for y (F, 2): (R,)."""
        vector = np.einsum("rij,rj->ri", self.A, y[self.at]) + self.a
        return np.asarray(np.hypot(vector[:, 0], vector[:, 1]))

    def denominator(self, y: Real) -> Real:
        """e + E y - |C y + c| for y (F, 2): (R,)."""
        vector = np.einsum("rij,rj->ri", self.C, y[self.at]) + self.c
        return np.asarray(
            self.e + np.einsum("rj,rj->r", self.E, y[self.at]) - np.hypot(vector[:, 0], vector[:, 1])
        )

    def ratio(self, y: Real) -> Real:
        """Numerator over denominator for y (F, 2): (R,); infinite where the denominator is not positive."""
        return np.asarray(quotient(self.numerator(y), self.denominator(y), np.inf))


def plane(value: Complex) -> Real:
    """(R,) complex as (R, 2) real."""
    return np.stack([value.real, value.imag], axis=-1)


class MinimaxPoint(NamedTuple):
    """x (n,) of the original basis, gamma = largest ratio there; infinite if no x makes every denominator
    positive."""

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
    """Minimise the largest numerator/denominator over real x (n,), to a relative accuracy.

    basis (F, n): y = basis x. start: x (n,) to begin from; else the least-squares solution of the numerators,
    shortened until all denominators are positive.
    """
    step = _Scaled(basis, rows, accuracy)
    if start is not None and not np.min(rows.denominator(plane(basis @ start))) > 0:
        start = None
    z = step.least_squares() if start is None else step.back @ start
    if start is None:
        for _ in range(30):
            if np.min(rows.denominator(step.planar @ z)) > 0.05:
                break
            z = 0.7 * z
    if not np.isfinite(step.ratio(z)):
        z = step.lower(z, 0.0, np.ones(rows.at.size), stop_below=-1e-3, feasibility=True)
    gamma = step.ratio(z)
    for _ in range(most_rounds if np.isfinite(gamma) else 0):
        new = step.lower(z, gamma, rows.denominator(step.planar @ z))
        reached = step.ratio(new)
        if not reached < gamma:
            break
        gain, z, gamma = gamma - reached, new, reached
        if gain < accuracy * gamma or step.constant:
            break
    return MinimaxPoint(step.map @ z, gamma)


@dataclass(frozen=True, eq=False)
class Exchanged:
    """Best x (n,) of an exchange (None: no round found one), its values (F,) on every dense grid, and the
    gamma of the last programme."""

    x: Real | None
    values: list[Real]
    gamma: float

    @property
    def worst(self) -> float:
        """Largest of the values; infinite without any."""
        return max((float(np.max(each)) for each in self.values), default=float("inf"))


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
    """Solve on the grids, check on the dense ones, add what is violated to the grids (in place), and again.

    solve: from a start (n,) to the optimum on the grids as they are. check: x to its values at the
    frequencies `dense`, of which up to `most` maxima of each grid are added. Ends when none exceeds gamma.
    """
    best = Exchanged(None, [], 0.0)
    for _ in range(rounds + 1):
        point = solve(start)
        if not np.isfinite(point.gamma):
            break
        start = point.x
        values = check(start)
        found = Exchanged(start, values, point.gamma)
        best = found if found.worst < best.worst else replace(best, gamma=point.gamma)
        limit = point.gamma * (1.0 + EXCHANGE_TOLERANCE)
        if found.worst <= limit:
            break
        for number, (omega, value) in enumerate(zip(dense, values, strict=True)):
            grids[number] = with_violations(grids[number], omega, value, limit, most)
    return best


class _Scaled:
    """The rows in coordinates z that are orthonormal as seen by them: x = map z, z = back x, y = planar z.

    All rows at one frequency see the same y: what they say of z is said of y first, in the plane.
    """

    def __init__(self, basis: Complex, rows: PlaneRows, accuracy: float) -> None:
        self.rows, self.accuracy = rows, accuracy
        planar = np.stack([basis.real, basis.imag], axis=1)  # (F, 2, n)
        seen = np.einsum("rji,rjk->rik", rows.A, rows.A) + np.einsum("rji,rjk->rik", rows.C, rows.C)
        triangle = np.linalg.qr(_half(_summed(rows.at, seen, len(basis)), planar), mode="r")
        _, sizes, directions = np.linalg.svd(triangle)
        keep = sizes > _KEPT * sizes[0]
        self.map = directions[keep].T / sizes[keep] * np.sqrt(rows.at.size)
        self.back = (directions[keep] * sizes[keep][:, None]) / np.sqrt(rows.at.size)
        self.planar = planar @ self.map  # (F, 2, m)
        self.constant = not (np.any(rows.C) or np.any(rows.E))
        self._reach_rounding = _ROUND_REACH
        self._fixed_reach = np.hypot(rows.c[:, 0], rows.c[:, 1])

    def least_squares(self) -> Real:
        rows = self.rows
        seen = np.matmul(rows.A, self.planar[rows.at]).reshape(-1, self.planar.shape[2])
        return np.asarray(np.linalg.lstsq(seen, -rows.a.reshape(-1), rcond=None)[0])

    def ratio(self, z: Real) -> float:
        return float(np.max(self.rows.ratio(self.planar @ z)))

    def seen(self, z: Real) -> Real:
        """y of every row, (R, 2)."""
        return np.asarray((self.planar @ z)[self.rows.at])

    def onto_z(self, vectors: Real) -> Real:
        """Sum of forms vector y over the rows, (R, 2), as one form of z, (m,)."""
        summed = _summed(self.rows.at, vectors, len(self.planar))
        return np.asarray(summed.reshape(-1) @ self.planar.reshape(-1, self.planar.shape[2]))

    def lower(
        self, z: Real, gamma: float, scale: Real, *, stop_below: float = -np.inf, feasibility: bool = False
    ) -> Real:
        """z with the smallest max h, h = (|A y + a| - gamma m(y))/scale; for feasibility h = -m(y).

        Primal-dual interior point for min v, h - v + slack = 0, with predictor and corrector; slacks are
        variables of their own. Ends when the gap is below a twentieth of what was gained, or at full
        accuracy.
        """
        weight = 0.0 if feasibility else 1.0
        factor = 1.0 if feasibility else gamma
        self._reach_rounding = _ROUND_FEASIBILITY if feasibility else _ROUND_REACH
        n = z.size
        h = self._values(z, weight, factor, scale)
        begin = float(np.max(h))
        v = begin + 0.1 * factor
        slack = v - h
        dual = 1.0 / slack
        dual /= np.sum(dual)
        best, best_value = z, begin
        final = feasibility or self.constant
        for _ in range(_MOST_STEPS):
            by_row, blocks = self._derivatives(z, weight, factor, scale, dual)
            miss = h - v + slack
            ratio = dual / slack
            weighted = by_row * ratio[:, None]
            blocks += by_row[:, :, None] * weighted[:, None, :]
            half = _half(_summed(self.rows.at, blocks, len(self.planar)), self.planar)
            matrix = np.empty((n + 1, n + 1))
            matrix[:n, :n] = half.T @ half  # of an array with itself: half the work
            matrix[:n, n] = matrix[n, :n] = -self.onto_z(weighted)
            matrix[n, n] = np.sum(ratio)
            matrix[np.diag_indices(n + 1)] *= 1.0 + 1e-13
            factored = scipy.linalg.lu_factor(matrix, check_finite=False)
            gap = float(np.mean(dual * slack))
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
                    ahead = slack + min(1.0, primal_length) * slack_step
                    reached = float(np.mean(ahead * (dual + min(1.0, dual_length) * dual_step)))
                    share = min(1.0, max(reached / gap, 0.0)) ** 3
                    target = max(share, 1e-3) * gap - slack_step * dual_step
            if not np.all(np.isfinite(step)):
                break  # the system has become singular to working precision: the best point stands
            length = min(1.0, 0.99 * min(primal_length, dual_length))
            # What convex rows lie above their linearisation is its error: far from the kinks steps would run
            # away.
            allowed = float(np.max(slack))
            h_new = self._values(z + length * step[:n], weight, factor, scale)
            while np.max(h_new - h - length * rise) > allowed and length > 1e-8:
                length *= 0.5
                h_new = self._values(z + length * step[:n], weight, factor, scale)
            z, v = z + length * step[:n], v + length * float(step[n])
            slack, dual = slack + length * slack_step, dual + length * dual_step
            h = h_new
            largest = float(np.max(h))
            if largest < best_value:
                best, best_value = z, largest
            gained = max(begin - best_value, 0.0)
            enough = (0.3 if final else 0.1) * self.accuracy * factor
            enough = enough if final else max(0.05 * gained, enough)
            if best_value < stop_below or (
                float(dual @ slack) < enough
                and largest - best_value < enough
                and np.max(h - v + slack) < enough
            ):
                break
        return best

    def _parts(self, z: Real, rounding: Real) -> tuple[Real, Real, Real, Real, Real]:
        """Vectors A y + a and C y + c, their rounded sizes, and e + E y."""
        r, y = self.rows, self.seen(z)
        p = np.einsum("rij,rj->ri", r.A, y) + r.a
        size_p = np.sqrt(p[:, 0] ** 2 + p[:, 1] ** 2 + rounding**2)
        if self.constant:
            return p, p, size_p, self._fixed_reach, r.e
        q = np.einsum("rij,rj->ri", r.C, y) + r.c
        size_q = np.sqrt(q[:, 0] ** 2 + q[:, 1] ** 2 + self._reach_rounding**2)
        return p, q, size_p, size_q, r.e + np.sum(r.E * y, axis=1)

    def _values(self, z: Real, weight: float, gamma: float, scale: Real) -> Real:
        _, _, size_p, size_q, level = self._parts(z, _ROUND_NUMERATOR * gamma * scale)
        return np.asarray((weight * size_p - gamma * (level - size_q)) / scale)

    def _derivatives(
        self, z: Real, weight: float, gamma: float, scale: Real, dual: Real
    ) -> tuple[Real, Real]:
        """Gradients of h by y (R, 2), and dual times its Hessians (R, 2, 2).

        The Hessian of sqrt(|p|^2 + r^2) is (w w^T + (r/size)^2 u u^T)/size, u along p and w across it.
        """
        r, rounding = self.rows, _ROUND_NUMERATOR * gamma * scale
        p, q, size_p, size_q, _ = self._parts(z, rounding)
        share = dual / scale
        gradient, hessian = _norm_derivatives(r.A, p, size_p, rounding, weight * share)
        gradient *= (weight / scale)[:, None]
        if not self.constant:
            reach, curved = _norm_derivatives(
                r.C, q, size_q, np.full(size_q.size, self._reach_rounding), gamma * share
            )
            gradient += (gamma / scale)[:, None] * (reach - r.E)
            hessian += curved
        return gradient, hessian


def _summed(at: Integer, values: Real, count: int) -> Real:
    """Sum of values (R, ...) over the rows at each of count frequencies, (count, ...)."""
    flat = values.reshape(len(values), -1)
    columns = [np.bincount(at, weights=column, minlength=count) for column in flat.T]
    return np.asarray(np.stack(columns, axis=1).reshape(count, *values.shape[1:]), dtype=np.float64)


def _half(blocks: Real, planar: Real) -> Real:
    """H (2 F, m) with H^T H = sum of P^T B P over the frequencies, B (F, 2, 2) not negative, P (F, 2, m)."""
    first, both, second = blocks[:, 0, 0], blocks[:, 0, 1], blocks[:, 1, 1]
    root = np.sqrt(first)
    beside = np.divide(both, root, out=np.zeros_like(root), where=root > 0)
    rest = np.sqrt(np.maximum(second - beside**2, 0.0))
    half = np.empty((2, *planar.shape[::2]))
    np.multiply(root[:, None], planar[:, 0], out=half[0])
    half[0] += beside[:, None] * planar[:, 1]
    np.multiply(rest[:, None], planar[:, 1], out=half[1])
    return half.reshape(-1, planar.shape[2])


def _to_boundary(value: Real, step: Real) -> float:
    """Largest length of the step for which all values stay positive, at most a long way."""
    falling = step < 0
    return float(np.min(-value[falling] / step[falling], initial=1e3))


def _norm_derivatives(
    forms: Real, vector: Real, size: Real, rounding: Real, weight: Real
) -> tuple[Real, Real]:
    """Gradients (R, 2) of the rounded norms of vector = forms y, weight times their Hessians (R, 2, 2)."""
    length = np.hypot(vector[:, 0], vector[:, 1])
    u = np.where(length[:, None] > 0, vector, [1.0, 0.0]) / np.where(length > 0, length, 1.0)[:, None]
    along = u[:, 0, None] * forms[:, 0] + u[:, 1, None] * forms[:, 1]
    gradient = along * (length / size)[:, None]
    across = u[:, 0, None] * forms[:, 1] - u[:, 1, None] * forms[:, 0]
    each = weight / size
    hessian = each[:, None, None] * across[:, :, None] * across[:, None, :]
    hessian += (each * (rounding / size) ** 2)[:, None, None] * along[:, :, None] * along[:, None, :]
    return gradient, hessian
