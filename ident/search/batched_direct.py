"""DIRECT-L that hands out all points of an iteration at once: NLopt's GN_DIRECT_L, point for point the same.

NLopt calls the cost back for one point after the other; with a compiled cost that takes eight points together
these calls would be most of a search (measured by `benchmarks.fit_time`). NLopt's variants stay selectable,
and the tests compare every point with GN_DIRECT_L.

The method (Gablonsky, Kelley: A locally-biased form of the DIRECT algorithm, J. Global Optim. 21, 2001):
boxes that tile the unit cube are judged by the cost f at their centre and by d, half their longest side. Of
the boxes on the lower right convex hull of (d, f), one for each d, those are divided whose next edge of the
hull, prolonged to d = 0, reaches the lowest cost found so far; dividing means trisecting along all longest
sides, the best side first. As in NLopt the lowest cost is followed within an iteration, so a box may fail
after its points were evaluated; they are kept until its turn comes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from ident.data.arrays import RealArray

_THIRD = 1 / 3
# Columns of a box: trisections of its longest side, cost, age, whether its side costs are known; then centre
# (D), widths (D), side costs (2 D).
_LEVEL, COST, _AGE, _KNOWN, _CENTRE = range(5)
_ASKED = 2  # the side costs were asked for just now
# After 32 trisections a box is as small as rounding; it is not divided again.
_LEVELS = 32


def minimise_in_batches(
    cost: Callable[[RealArray], RealArray], dimension: int, evaluations: int
) -> tuple[RealArray, RealArray]:
    """Points (E, D) of the unit cube in NLopt's order and their costs (E,); cost maps points (K, D) to (K,).

    E = evaluations; the cost may be asked for a few points more. The time for bookkeeping grows with E^2
    (about 0.2 s at 100 000).
    """
    points, costs, boxes, hull, proposed = room(dimension, evaluations)
    boxes[0, COST] = costs[0] = cost(points[:1])[0]
    n_boxes, n_points, age = 1, 1, 1
    while n_points < evaluations:
        n_hull, n_proposed = choose(boxes, n_boxes, hull, proposed)
        if n_hull == 0:  # every box is as small as rounding
            return points[:n_points], costs[:n_points]
        values = cost(proposed[:n_proposed]) if n_proposed else proposed[0, :0]
        n_boxes, n_points, age = divide(boxes, n_boxes, age, hull[:n_hull], values, points, costs, n_points)
    return points, costs


@numba.njit(cache=True)
def room(dimension: int, evaluations: int) -> Any:
    """Points (E, D), the first in place, costs (E,), boxes with the first one but for its cost, and room for
    the hull and for the points that an iteration proposes."""
    points, costs = np.empty((evaluations, dimension)), np.empty(evaluations)
    boxes = np.zeros((evaluations + 2 * dimension + 1, _CENTRE + 4 * dimension))
    for i in range(dimension):
        boxes[0, _CENTRE + i] = points[0, i] = 0.5
        boxes[0, _CENTRE + dimension + i] = 1.0
    hull, proposed = np.empty(_LEVELS, dtype=np.int64), np.empty((_LEVELS * 2 * dimension, dimension))
    return points, costs, boxes, hull, proposed


@numba.njit(cache=True)
def _half_side(boxes: Any, box: int) -> float:
    """d, rounded as NLopt does, so that boxes of one size have one d."""
    dimension = (boxes.shape[1] - _CENTRE) // 4
    widest = 0.0
    for i in range(dimension):
        widest = max(widest, boxes[box, _CENTRE + dimension + i])
    return float(np.float32(0.5 * widest))


@numba.njit(cache=True)
def _is_longest(boxes: Any, box: int, side: int) -> bool:
    # Widths are powers of 1/3: anything well above 1/3 tells equal from shorter.
    dimension = (boxes.shape[1] - _CENTRE) // 4
    return bool(boxes[box, _CENTRE + dimension + side] > 1.5 * _half_side(boxes, box))


@numba.njit(cache=True)
def _lower_hull(boxes: Any, best: Any, hull: Any) -> int:
    """Lower hull of (d, cost) over the best box of each level, small boxes first (Andrew's monotone chain).

    As in NLopt, the second point and the last but one stay even where the chain is not convex there.
    """
    levels = np.flatnonzero(best >= 0)[::-1]
    first, last = best[levels[0]], best[levels[-1]]
    d_first, f_first = _half_side(boxes, first), boxes[first, COST]
    hull[0] = first
    if levels.size == 1:
        return 1
    chord = (boxes[last, COST] - f_first) / (_half_side(boxes, last) - d_first)
    n_hull = 1
    for level in levels[1:-1]:
        box = best[level]
        d, f = _half_side(boxes, box), boxes[box, COST]
        if f > f_first + (d - d_first) * chord:
            continue
        while n_hull > 2:
            d1, f1 = _half_side(boxes, hull[n_hull - 1]), boxes[hull[n_hull - 1], COST]
            d2, f2 = _half_side(boxes, hull[n_hull - 2]), boxes[hull[n_hull - 2], COST]
            if (d1 - d2) * (f - f2) - (f1 - f2) * (d - d2) >= 0:
                break
            n_hull -= 1
        hull[n_hull] = box
        n_hull += 1
    hull[n_hull] = last
    return n_hull + 1


@numba.njit(cache=True)
def _intercept(boxes: Any, hull: Any, i: int, d_before: float) -> float:
    """The hull's steeper edge at its point i, prolonged to d = 0; the largest boxes always count."""
    if i + 1 == hull.size:
        return -np.inf
    d, f = _half_side(boxes, hull[i]), boxes[hull[i], COST]
    slope = (f - boxes[hull[i + 1], COST]) / (d - _half_side(boxes, hull[i + 1]))
    if i > 0:
        slope = max(slope, (f - boxes[hull[i - 1], COST]) / (d - d_before))
    return float(f - slope * d)


@numba.njit(cache=True)
def choose(boxes: Any, n_boxes: int, hull: Any, proposed: Any) -> tuple[int, int]:
    """Boxes on the hull, and the points needed to divide those that can turn out potentially optimal."""
    dimension = (boxes.shape[1] - _CENTRE) // 4
    best = np.full(_LEVELS, -1)
    lowest = np.inf
    for box in range(n_boxes):
        level, value = int(boxes[box, _LEVEL]), boxes[box, COST]
        lowest = min(lowest, value)
        if level < _LEVELS:
            old = best[level]
            if old < 0 or (value, boxes[box, _AGE]) < (boxes[old, COST], boxes[old, _AGE]):
                best[level] = box
    if np.all(best < 0):
        return 0, 0
    n_hull = _lower_hull(boxes, best, hull)
    n_proposed = 0
    for i in range(n_hull):
        box = hull[i]
        d_before = _half_side(boxes, hull[i - 1]) if i > 0 else 0.0
        # The box before may have been divided by the time it is this one's turn.
        as_is, divided = (
            _intercept(boxes, hull[:n_hull], i, d_before),
            _intercept(boxes, hull[:n_hull], i, d_before / 3),
        )
        if min(as_is, divided) <= lowest and boxes[box, _KNOWN] == 0:
            boxes[box, _KNOWN] = _ASKED
            for side in range(dimension):
                if _is_longest(boxes, box, side):
                    step = boxes[box, _CENTRE + dimension + side] * _THIRD
                    for sign in (-1.0, 1.0):
                        for k in range(dimension):
                            proposed[n_proposed, k] = boxes[box, _CENTRE + k]
                        proposed[n_proposed, side] += sign * step
                        n_proposed += 1
    return n_hull, n_proposed


@numba.njit(cache=True)
def divide(
    boxes: Any, n_boxes: int, age: int, hull: Any, values: Any, points: Any, costs: Any, n_points: int
) -> tuple[int, int, int]:
    """Divide boxes of the hull one after the other, noting points and costs until there is no room for
    more."""
    dimension = (boxes.shape[1] - _CENTRE) // 4
    widths, side_costs = _CENTRE + dimension, _CENTRE + 2 * dimension
    used = 0
    for box in hull:
        if boxes[box, _KNOWN] == _ASKED:
            for side in range(dimension):
                if _is_longest(boxes, box, side):
                    boxes[box, side_costs + 2 * side] = values[used]
                    boxes[box, side_costs + 2 * side + 1] = values[used + 1]
                    used += 2
            boxes[box, _KNOWN] = 1
    lowest = np.inf
    for k in range(n_points):
        lowest = min(lowest, costs[k])
    sides = np.empty(dimension, dtype=np.int64)
    for i in range(hull.size):
        box = hull[i]
        d_before = _half_side(boxes, hull[i - 1]) if i > 0 else 0.0
        if boxes[box, _KNOWN] == 0 or _intercept(boxes, hull, i, d_before) > lowest:
            continue
        n_sides = 0
        for side in range(dimension):
            if not _is_longest(boxes, box, side):
                continue
            step = boxes[box, widths + side] * _THIRD
            for k in range(2):
                if n_points == costs.size:
                    return n_boxes, n_points, age
                for j in range(dimension):
                    points[n_points, j] = boxes[box, _CENTRE + j]
                points[n_points, side] += (2 * k - 1) * step
                costs[n_points] = boxes[box, side_costs + 2 * side + k]
                lowest = min(lowest, costs[n_points])
                n_points += 1
            # Sides in ascending order of their better cost.
            at = n_sides
            value = min(boxes[box, side_costs + 2 * side], boxes[box, side_costs + 2 * side + 1])
            while at > 0:
                other = side_costs + 2 * sides[at - 1]
                if min(boxes[box, other], boxes[box, other + 1]) <= value:
                    break
                sides[at] = sides[at - 1]
                at -= 1
            sides[at] = side
            n_sides += 1
        boxes[box, _KNOWN] = 0
        for s in range(n_sides):
            side = sides[s]
            boxes[box, widths + side] *= _THIRD
            if s == n_sides - 1:
                boxes[box, _LEVEL] += 1
            boxes[box, _AGE] = age
            age += 1
            for k in range(2):
                new = n_boxes
                for j in range(boxes.shape[1]):
                    boxes[new, j] = boxes[box, j]
                boxes[new, _CENTRE + side] += (2 * k - 1) * boxes[box, widths + side]
                boxes[new, COST] = boxes[box, side_costs + 2 * side + k]
                boxes[new, _AGE] = age
                age += 1
                n_boxes += 1
    return n_boxes, n_points, age
