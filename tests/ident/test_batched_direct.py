"""DIRECT-L in batches against NLopt's GN_DIRECT_L, point by point."""

from __future__ import annotations

import numpy as np
import pytest

from ident.search.batched_direct import minimise_in_batches
from ident.search.direct import minimise


def valley(rng, dimension):
    """A bowl with ripples, on a logarithmic scale like a residual over poles; (K, D) -> (K,)."""
    centre, ripple = rng.random(dimension), rng.uniform(5, 60)
    height = rng.uniform(0, 0.3)

    def cost(x):
        return np.log(
            1e-3 + np.sum((x - centre) ** 2 + height * (1 - np.cos(ripple * (x - centre))), axis=-1)
        )

    return cost


# One dimension is left out: there 700 points reach boxes as small as rounding, where costs tie by chance.
@pytest.mark.parametrize("dimension", [2, 3, 4, 7])
@pytest.mark.parametrize("seed", range(5))
def test_every_point_is_that_of_nlopt(dimension, seed):
    cost = valley(np.random.default_rng(seed), dimension)
    points, costs = minimise_in_batches(cost, dimension, 700)
    expected_points, expected_costs = minimise(cost, dimension, "GN_DIRECT_L", 700)
    np.testing.assert_array_equal(points, expected_points)
    # Sums over rows of one and of many points may be formed in another order.
    np.testing.assert_allclose(costs, expected_costs, rtol=1e-12, atol=1e-12)


def test_points_are_asked_for_together():
    asked = []
    cost = valley(np.random.default_rng(0), 4)

    def counted(x):
        asked.append(len(x))
        return cost(x)

    points, _ = minimise_in_batches(counted, 4, 500)
    assert len(points) == 500
    assert len(asked) < 60
    # Points of boxes that fail within an iteration are kept; at the end some are left over.
    assert 500 <= sum(asked) < 550


def test_a_flat_cost_is_searched_everywhere():
    points, costs = minimise_in_batches(lambda x: np.zeros(len(x)), 2, 243)
    assert np.all(costs == 0)
    expected, _ = minimise(lambda x: np.zeros(len(x)), 2, "GN_DIRECT_L", 243)
    np.testing.assert_array_equal(points, expected)


def test_a_search_ends_where_boxes_are_as_small_as_rounding():
    points, costs = minimise_in_batches(lambda x: np.abs(x[:, 0] - 0.3), 1, 5000)
    assert len(points) == len(costs) <= 5000
    assert np.min(costs) < 1e-14
