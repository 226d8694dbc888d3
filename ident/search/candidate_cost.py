"""The cost of candidate poles on top of frozen ones, for single points and whole grids of a search space."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from ident.basis.coordinates import SearchSpace, blocks_of_point
from ident.basis.options import Algorithm
from ident.basis.poles import Poles
from ident.data.arrays import RealArray, kernel_array
from ident.fit.batched_cost import COLUMNS, batched_rss
from ident.fit.kernels import candidate_rss
from ident.fit.least_squares import Projection, driving_signal, project
from ident.fit.regression import Regression
from ident.search.batched_direct import COST, choose, divide, room
from ident.search.direct import minimise

# Below this fraction of |y|^2 the Gram matrix of the candidates knows nothing; descents see the true
# residual.
_FLOOR = 1e-13
# One pass of eight costs less than two single ones.
_FEWEST_IN_A_BATCH = 2


class CandidateCost:
    """Residual sum of squares over the unit cube of a search space, with other poles frozen.

    `shared` are the frozen poles driven by the input, `local` those of the free responses; their columns are
    taken out of the output once, here. From `_FEWEST_IN_A_BATCH` points on, unless several records have free
    responses, points are evaluated eight at a time (`ident.fit.batched_cost`); the two ways agree to
    rounding.
    """

    def __init__(self, data: Regression, space: SearchSpace, shared: Poles, local: Poles) -> None:
        self.space = space
        self.evaluations = 0
        self._floor = _FLOOR * float(data.y @ data.y)
        frozen = project(data, shared, local)
        free = data.structure.estimate_initial_state
        residual_power = float(frozen.residual @ frozen.residual)
        box = (space.n_real, space.low.copy(), space.high.copy(), space.raw)
        drive = driving_signal(data, shared)
        n_shared = frozen.shared_q.shape[0]
        self._one_by_one = (
            *box, drive, frozen.residual, data.starts, frozen.local_q, frozen.shared_q, free,
        )  # fmt: skip
        self._together: tuple[Any, ...] | None = None
        if not (free and data.n_records > 1):
            self._together = (*box, drive, _against(frozen), n_shared, residual_power, data.starts, free)

    def rss(self, units: RealArray) -> RealArray:
        """Residual sums of squares (E,) at points (E, D) of the unit cube."""
        self.evaluations += len(units)
        units = kernel_array(units)
        if self._together is not None and len(units) >= _FEWEST_IN_A_BATCH:
            return np.asarray(batched_rss(units, *self._together))
        return np.asarray(_scan(units, *self._one_by_one))

    def minimise(self, algorithm: Algorithm, evaluations: int) -> tuple[RealArray, RealArray]:
        """Points (E, D) of the unit cube that DIRECT looked at and log J (E,) there."""
        if algorithm != "DIRECT_L" or self._together is None:
            return minimise(self.log, self.space.dimension, algorithm, evaluations)
        points, costs, asked_for = _direct_l(self.space.dimension, evaluations, self._floor, *self._together)
        self.evaluations += asked_for
        return points, costs

    def log(self, units: RealArray) -> RealArray:
        """log J (E,) at points (E, D), as DIRECT sees it."""
        values = self.rss(units)
        np.maximum(values, self._floor, out=values)
        np.log(values, out=values)
        return values


def _against(frozen: Projection) -> RealArray:
    """What the candidates are multiplied with, sample by sample (N, Q): see `batched_rss`."""
    n_columns = 1 + frozen.shared_q.shape[0] + frozen.local_q.shape[0]
    columns = np.zeros((frozen.residual.size, -(-n_columns // COLUMNS) * COLUMNS))
    columns[:, 0] = frozen.residual
    columns[:, 1 : 1 + frozen.shared_q.shape[0]] = frozen.shared_q.T
    columns[:, 1 + frozen.shared_q.shape[0] : n_columns] = frozen.local_q.T
    return columns


@numba.njit(cache=True)
def _direct_l(
    dimension: int,
    evaluations: int,
    floor: float,
    n_real: int,
    low: Any,
    high: Any,
    raw: bool,
    drive: Any,
    against: Any,
    n_shared: int,
    residual_power: float,
    starts: Any,
    free: bool,
) -> tuple[Any, Any, int]:
    """`ident.search.batched_direct.minimise_in_batches` on log J without a way through the interpreter, a
    third of its time; and how often the cost was asked for."""
    points, costs, boxes, hull, proposed = room(dimension, evaluations)
    first = batched_rss(
        points[:1], n_real, low, high, raw, drive, against, n_shared, residual_power, starts, free
    )
    boxes[0, COST] = costs[0] = np.log(max(first[0], floor))
    n_boxes, n_points, age, asked_for = 1, 1, 1, 1
    while n_points < evaluations:
        n_hull, n_proposed = choose(boxes, n_boxes, hull, proposed)
        if n_hull == 0:  # every box is as small as rounding
            break
        values = batched_rss(
            proposed[:n_proposed], n_real, low, high, raw, drive, against, n_shared, residual_power, starts,
            free,
        )  # fmt: skip
        for k in range(n_proposed):
            values[k] = np.log(max(values[k], floor))
        asked_for += n_proposed
        n_boxes, n_points, age = divide(boxes, n_boxes, age, hull[:n_hull], values, points, costs, n_points)
    return points[:n_points], costs[:n_points], asked_for


@numba.njit(cache=True)
def _scan(
    units: Any,
    n_real: int,
    low: Any,
    high: Any,
    raw: bool,
    drive: Any,
    residual: Any,
    starts: Any,
    local_q: Any,
    shared_q: Any,
    free: bool,
) -> Any:
    values = np.empty(units.shape[0])
    for i in range(units.shape[0]):
        blocks = blocks_of_point(units[i], n_real, low, high, raw)
        values[i] = candidate_rss(blocks, n_real, drive, residual, starts, local_q, shared_q, free)
    return values
