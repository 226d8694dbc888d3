"""A lower bound on what any controller could reach that is tighter than the inscribed disc's.

At one frequency the whole requirement on q = K S (of the base plant) is that q lies in a set of the plane,
R(gamma) = {q : |1 + D q| >= max(|W1 (1 - G q)|, |W3 q|)/gamma for every G + D in the ellipse}. For elongated
ellipses R is not convex, which makes the exact problem hard; its convex hull contains it, and with hulls in
place of R the problem is a linear programme in the coefficients of Q. The smallest gamma for which that is
feasible is a lower bound. The hull is cut from samples of R, moved outwards by half their spacing: a
numerical bound, exact up to details of R finer than that.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from control_design.analysis.worst_case import PlantData
from control_design.convex.youla_basis import AffineLoop
from control_design.plants.ellipses import Complex, Real, nearest_distance, quotient
from control_design.specification.requirement import LoopFunction
from ident.data.arrays import real_rows

_DIRECTIONS = 24  # half-planes of every hull
_ANGLES, _RADII = 300, 60  # samples of the disc that is known to contain R
_KEPT = 1e-9  # singular values below this fraction are no directions of the programme
_STEPS = 8  # of the bisection in gamma


def hull_bound(data: PlantData, loop: AffineLoop, basis: Complex, floor: float, ceiling: float) -> float:
    """Largest gamma in [floor, ceiling] known to be out of reach (floor if none), on the grid of `data`.

    basis (F, n): Q on the grid; floor, ceiling: gammas between which to look, e.g. of inscribed disc and
    ellipse. Requirements on S and K S count; what is asked of disturbances does not, so that the bound
    holds with it too.
    """
    g = loop.base
    w1, w3 = data.sensitivity, data.largest(LoopFunction.EFFORT)
    # The base plant itself is a member (or close to one): |q| <= gamma/W3 and |1 - G q| <= gamma/W1 contain
    # R.
    by_effort = quotient(ceiling, w3, np.inf)
    by_tracking = ceiling / (w1 * np.abs(g))
    centre = np.where(by_tracking < by_effort, 1.0 / g, 0.0)
    radius = np.minimum(by_tracking, by_effort)
    pattern, spacing = _disc_samples()
    samples = [centre[i] + radius[i] * pattern for i in range(g.size)]
    worst = np.stack([_worst(data, loop, w1[i], w3[i], q, i) for i, q in enumerate(samples)])
    turn = np.exp(-2j * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS)
    projected = np.real(turn[:, None] * pattern)  # (directions, samples)
    slope = (loop.effort_slope / radius)[:, None] * basis
    offset = (loop.effort - centre) / radius
    programme = _Programme(slope, offset, turn)
    low, high = floor, ceiling
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        inside = worst <= middle
        if not np.all(np.any(inside, axis=1)):
            low = middle  # at some frequency nothing is left
            continue
        support = np.stack([np.max(projected[:, each], axis=1) for each in inside])
        if programme.feasible(support + spacing):
            high = middle
        else:
            low = middle
    return low


def _disc_samples() -> tuple[Complex, float]:
    """Points of the unit disc and half their largest spacing."""
    radii = np.linspace(0.0, 1.0, _RADII)
    points = radii[:, None] * np.exp(2j * np.pi * np.arange(_ANGLES) / _ANGLES)
    return points.ravel(), max(0.5 / (_RADII - 1), np.pi / _ANGLES)


def _worst(data: PlantData, loop: AffineLoop, w1: float, w3: float, q: Complex, i: int) -> Real:
    """Smallest gamma that lets q (samples,) into R at frequency i with its weights, (samples,)."""
    e = data.ellipses
    size = np.abs(q)
    direction = e.direction[i] * data.delay[i]
    moved = 1.0 + (e.centre[i] * data.delay[i] - loop.base[i]) * q
    turned = quotient(moved * np.conj(q * direction), size, 1.0)
    distance = nearest_distance(turned, size * e.semi_major[i], size * e.semi_minor[i])
    asked = np.maximum(w1 * np.abs(1.0 - loop.base[i] * q), w3 * size)
    return np.asarray(quotient(asked, distance, np.inf))


class _Programme:
    """Is there x with Re(turn_j (offset_k + slope_k x)) <= support_kj for all frequencies and directions?"""

    def __init__(self, slope: Complex, offset: Complex, turn: Complex) -> None:
        _, sizes, directions = np.linalg.svd(real_rows(slope), full_matrices=False)
        keep = sizes > _KEPT * sizes[0]
        scaled = slope @ (directions[keep].T / sizes[keep] * 10.0)
        rows = np.real(turn[None, :, None] * scaled[:, None, :])
        self._rows = rows.reshape(-1, rows.shape[2])
        self._known = np.real(turn[None, :] * offset[:, None]).ravel()

    def feasible(self, support: Real) -> bool:
        """The smallest common violation is not positive; an unclear answer of the solver counts as
        feasible."""
        count = self._rows.shape[1]
        answer = linprog(
            np.append(np.zeros(count), 1.0),
            A_ub=np.hstack([self._rows, -np.ones((self._rows.shape[0], 1))]),
            b_ub=support.ravel() - self._known,
            bounds=[(None, None)] * count + [(-1.0, None)],
            method="highs",
        )
        return answer.status != 0 or answer.fun is None or bool(answer.fun <= 1e-9)
