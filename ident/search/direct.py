"""DIRECT over the unit cube: NLopt's variants, recorded point by point."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import nlopt
import numba
import numpy as np

from ident.basis.options import Algorithm
from ident.data.arrays import RealArray, kernel_array


def minimise(
    cost: Callable[[RealArray], float], dimension: int, algorithm: Algorithm, evaluations: int
) -> tuple[RealArray, RealArray]:
    """Points (E, D) of the unit cube that DIRECT looked at, in order, and their costs (E,); cost is asked at
    points (D,)."""
    points: list[RealArray] = []
    costs: list[float] = []

    def recorded(x: RealArray, gradient: RealArray | None = None) -> float:
        point = x.copy()
        value = cost(point)
        points.append(point)
        costs.append(value)
        return value

    if "RAND" in algorithm:
        # These variants draw from NLopt's own generator; a fixed seed keeps the search reproducible.
        nlopt.srand(1)
    problem = nlopt.opt(getattr(nlopt, algorithm), dimension)
    problem.set_lower_bounds(np.zeros(dimension))
    problem.set_upper_bounds(np.ones(dimension))
    problem.set_min_objective(recorded)
    problem.set_maxeval(evaluations)
    try:
        problem.optimize(np.full(dimension, 0.5))
    except nlopt.runtime_error:
        # The original DIRECT may fill its tables in mid-iteration (noise-free data) and report a bare
        # failure; the points it looked at are a search all the same.
        if not points:
            raise
    return np.array(points), np.array(costs)


def best_apart(points: RealArray, costs: RealArray, count: int, apart: float = 0.15) -> RealArray:
    """Up to `count` of the best points (C, D), each at least `apart` from the better ones chosen before
    it."""
    return np.asarray(points[_greedy(kernel_array(points), np.argsort(costs, kind="stable"), count, apart)])


@numba.njit(cache=True)
def _greedy(points: Any, order: Any, count: int, apart: float) -> Any:
    chosen = np.empty(count, dtype=np.int64)
    n_chosen = 0
    for i in order:
        near = False
        for c in chosen[:n_chosen]:
            distance = 0.0
            for j in range(points.shape[1]):
                distance += (points[i, j] - points[c, j]) ** 2
            near = near or distance < apart * apart
        if not near:
            chosen[n_chosen] = i
            n_chosen += 1
            if n_chosen == count:
                break
    return chosen[:n_chosen]
