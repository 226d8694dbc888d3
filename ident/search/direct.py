"""DIRECT over the unit cube: NLopt's variants, recorded point by point."""

from __future__ import annotations

from collections.abc import Callable

import nlopt
import numpy as np

from ident.basis.options import Algorithm
from ident.data.arrays import RealArray


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
        # The original DIRECT may fill its tables (noise-free data): the points it looked at are a search.
        if not points:
            raise
    return np.array(points), np.array(costs)


def best_apart(points: RealArray, costs: RealArray, count: int, apart: float = 0.15) -> RealArray:
    """Up to `count` of the best points (C, D), each at least `apart` from the better ones chosen before
    it."""
    left = points[np.argsort(costs, kind="stable")]
    chosen: list[RealArray] = []
    while len(left) and len(chosen) < count:
        chosen.append(left[0])
        left = left[~(np.sum((left - left[0]) ** 2, axis=1) < apart * apart)]
    return np.array(chosen).reshape(-1, points.shape[1])
