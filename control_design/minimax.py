"""Smallest worst ratio of a convex over a concave function, many rows at once: the convex core of bound and
prefilter.

Every row looks at one complex number y_k = sum_i basis_ki x_i, taken as a vector of the plane, and asks
    |A y + a| <= gamma (e + E y - |C y + c|).
For fixed gamma that is convex in x, so the smallest feasible gamma has no local minima. Dinkelbach's
iteration
solves it: gamma_j = worst ratio at x_j, then x_{j+1} minimises the largest (|A y + a| - gamma_j m(y))/m(y_j),
a
convex programme, by a barrier and Newton's method. gamma falls in every step, superlinearly near the end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from control_design.ellipses import Complex, Real

_ROUND = 1e-5  # radius of the rounding of |.| at its kink, relative to the row: changes active rows by 1e-9
_GAP = 1e-5  # relative accuracy of gamma
_KEPT = 1e-10  # singular values of the scaled basis below this fraction are no directions of the search


@dataclass(frozen=True, eq=False)
class PlaneRows:
    """R rows on F plane vectors: at (R,) position k of each row; A (R, 2, 2), a (R, 2) numerator; e (R,),
    E (R, 2), C (R, 2, 2), c (R, 2) denominator."""

    at: npt.NDArray[np.int64]
    A: Real
    a: Real
    e: Real
    E: Real
    C: Real
    c: Real

    def stacked(self, other: PlaneRows) -> PlaneRows:
        """Both sets of rows."""
        return PlaneRows(
            *(
                np.concatenate([getattr(self, name), getattr(other, name)])
                for name in ("at", "A", "a", "e", "E", "C", "c")
            )
        )

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


def turning(factor: Complex) -> Real:
    """Multiplication by complex factors (R,) as matrices (R, 2, 2) on (real, imaginary)."""
    return np.stack(
        [np.stack([factor.real, -factor.imag], -1), np.stack([factor.imag, factor.real], -1)], axis=-2
    )


def plane(value: Complex) -> Real:
    """(R,) complex as (R, 2) real."""
    return np.stack([value.real, value.imag], axis=-1)


@dataclass(frozen=True, eq=False)
class MinimaxPoint:
    """x (n,) of the original basis, gamma = largest ratio there, y (F,) complex; steps: Newton steps spent.

    gamma is infinite if no x was found for which every denominator is positive.
    """

    x: Real
    gamma: float
    y: Complex
    steps: int


def smallest_ratio(
    basis: Complex, rows: PlaneRows, start: Real | None = None, *, most_rounds: int = 30
) -> MinimaxPoint:
    """Minimise the largest numerator/denominator over real x (n,).

    basis (F, n): y = basis x. start: x (n,) to begin from, None = the least-squares solution of the
    numerators, shortened until the denominators are positive; where that fails, the denominators are made
    positive first.
    """
    step = _Scaled(basis, rows)
    z = step.least_squares() if start is None else step.coordinates(start)
    if start is None:
        for _ in range(30):
            if np.min(rows.denominator(step.y(z))) > 0.05:
                break
            z = 0.7 * z
    spent = 0
    if not np.min(rows.denominator(step.y(z))) > 0:
        z, spent = step.lower(z, 0.0, np.ones(rows.at.size), stop_below=-1e-3, feasibility=True)
        if not np.min(rows.denominator(step.y(z))) > 0:
            y = step.y(z)
            return MinimaxPoint(step.original(z), float("inf"), y[:, 0] + 1j * y[:, 1], spent)
    gamma = step.ratio(z)
    for _ in range(most_rounds):
        scale = rows.denominator(step.y(z))
        new, used = step.lower(z, gamma, scale)
        spent += used
        reached = step.ratio(new)
        if not reached < gamma:
            break
        gain, z, gamma = gamma - reached, new, reached
        if gain < _GAP * gamma:
            break
    y = step.y(z)
    return MinimaxPoint(step.original(z), gamma, y[:, 0] + 1j * y[:, 1], spent)


class _Scaled:
    """The rows in coordinates z of the basis that are orthonormal as seen by the rows."""

    def __init__(self, basis: Complex, rows: PlaneRows) -> None:
        self.rows = rows
        planar = np.stack([basis.real, basis.imag], axis=1)  # (F, 2, n)
        seen = np.concatenate(
            [
                np.einsum("rij,rjn->rin", matrix, planar[rows.at]).reshape(-1, basis.shape[1])
                for matrix in (rows.A, rows.C)
            ]
        )
        _, sizes, directions = np.linalg.svd(np.linalg.qr(seen, mode="r"))
        keep = sizes > _KEPT * sizes[0]
        self._map = directions[keep].T / sizes[keep] * np.sqrt(rows.at.size)
        self._back = (directions[keep] * sizes[keep][:, None]) / np.sqrt(rows.at.size)
        self._planar = planar @ self._map  # (F, 2, m)
        self._rows_of = self._planar[rows.at]  # (R, 2, m)

    def coordinates(self, x: Real) -> Real:
        return np.asarray(self._back @ x)

    def original(self, z: Real) -> Real:
        return np.asarray(self._map @ z)

    def y(self, z: Real) -> Real:
        return np.asarray(self._planar @ z)

    def least_squares(self) -> Real:
        seen = np.einsum("rij,rjn->rin", self.rows.A, self._rows_of)
        return np.asarray(
            np.linalg.lstsq(seen.reshape(-1, seen.shape[2]), -self.rows.a.reshape(-1), rcond=None)[0]
        )

    def ratio(self, z: Real) -> float:
        y = self.y(z)
        below = self.rows.denominator(y)
        return float(np.max(self.rows.numerator(y) / below)) if np.min(below) > 0 else float("inf")

    def lower(
        self, z: Real, gamma: float, scale: Real, *, stop_below: float = -np.inf, feasibility: bool = False
    ) -> tuple[Real, int]:
        """Minimise max h, h = (|A y + a| - gamma m(y))/scale; for feasibility h = -m(y).

        Barrier: t v - sum log(v - h) in (z, v), t growing until its gap R/t is below a twentieth of what was
        gained.
        """
        weight = 0.0 if feasibility else 1.0
        factor = 1.0 if feasibility else gamma
        n = z.size
        h = self._values(z, weight, factor, scale)
        begin = float(np.max(h))
        v = begin + 0.1 * (1.0 if feasibility else gamma)
        t = 10.0 * h.size / max(v - begin, 1e-12) / 10.0
        best, best_value, spent = z, begin, 0
        for _ in range(40):
            for _ in range(25):
                h, gradient, hessian = self._derivatives(z, weight, factor, scale, v)
                inverse = 1.0 / (v - h)
                g = np.append(gradient, t - np.sum(inverse))
                rows_gradient = self._row_gradient * inverse[:, None]
                matrix = np.empty((n + 1, n + 1))
                matrix[:n, :n] = hessian + rows_gradient.T @ rows_gradient
                matrix[:n, n] = matrix[n, :n] = -rows_gradient.T @ inverse
                matrix[n, n] = np.sum(inverse**2)
                matrix[np.diag_indices(n + 1)] *= 1.0 + 1e-12
                direction = -np.linalg.solve(matrix, g)
                spent += 1
                decrement = -float(g @ direction)
                if decrement < 0.02:
                    break
                length, old = 1.0, t * v - float(np.sum(np.log(v - h)))
                while True:
                    new_z, new_v = z + length * direction[:n], v + length * direction[n]
                    new_h = self._values(new_z, weight, factor, scale)
                    if np.all(new_h < new_v):
                        value = t * new_v - float(np.sum(np.log(new_v - new_h)))
                        if value <= old - 0.1 * length * decrement:
                            break
                    length *= 0.5
                    if length < 1e-9:
                        break
                if length < 1e-9:
                    break
                z, v = new_z, new_v
            largest = float(np.max(self._values(z, weight, factor, scale)))
            if largest < best_value:
                best, best_value = z, largest
            gap = h.size / t
            gained = max(begin - best_value, 0.0)
            enough = 0.1 * _GAP * factor if feasibility else max(0.05 * gained, 0.1 * _GAP * factor)
            if best_value < stop_below or gap < enough:
                break
            t *= 8.0
        return best, spent

    def _values(self, z: Real, weight: float, gamma: float, scale: Real) -> Real:
        r, y = self.rows, (self._planar @ z)[self.rows.at]
        p = np.einsum("rij,rj->ri", r.A, y) + r.a
        q = np.einsum("rij,rj->ri", r.C, y) + r.c
        size_p = np.sqrt(np.sum(p**2, axis=1) + _ROUND**2)
        size_q = np.sqrt(np.sum(q**2, axis=1) + _ROUND**2)
        return np.asarray((weight * size_p - gamma * (r.e + np.sum(r.E * y, axis=1) - size_q)) / scale)

    def _derivatives(
        self, z: Real, weight: float, gamma: float, scale: Real, v: float
    ) -> tuple[Real, Real, Real]:
        """h (R,), gradient (m,) of -sum log(v - h), and the part of its Hessian with second derivatives of
        h."""
        r, y = self.rows, (self._planar @ z)[self.rows.at]
        p = np.einsum("rij,rj->ri", r.A, y) + r.a
        q = np.einsum("rij,rj->ri", r.C, y) + r.c
        size_p = np.sqrt(np.sum(p**2, axis=1) + _ROUND**2)
        size_q = np.sqrt(np.sum(q**2, axis=1) + _ROUND**2)
        h = (weight * size_p - gamma * (r.e + np.sum(r.E * y, axis=1) - size_q)) / scale
        unit_p, unit_q = p / size_p[:, None], q / size_q[:, None]
        by_y = (
            weight * np.einsum("rij,ri->rj", r.A, unit_p)
            - gamma * r.E
            + gamma * np.einsum("rij,ri->rj", r.C, unit_q)
        ) / scale[:, None]
        eye = np.eye(2)
        curve_p = (eye - unit_p[:, :, None] * unit_p[:, None, :]) / size_p[:, None, None]
        curve_q = (eye - unit_q[:, :, None] * unit_q[:, None, :]) / size_q[:, None, None]
        curve = (
            weight * np.einsum("rij,rik,rkl->rjl", r.A, curve_p, r.A)
            + gamma * np.einsum("rij,rik,rkl->rjl", r.C, curve_q, r.C)
        ) / scale[:, None, None]
        inverse = 1.0 / (v - h)
        self._row_gradient = np.einsum("rj,rjm->rm", by_y, self._rows_of)
        gradient = inverse @ self._row_gradient
        weighted = np.matmul(curve * inverse[:, None, None], self._rows_of)
        m = z.size
        hessian = self._rows_of.reshape(-1, m).T @ weighted.reshape(-1, m)
        return h, np.asarray(gradient), np.asarray(hessian)
