"""Candidates evaluated eight at a time against the one-by-one cost and against fits of all poles."""

from __future__ import annotations

import numpy as np
import pytest

from ident.basis.coordinates import search_space
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.fit.least_squares import fit
from ident.fit.regression import prepare
from ident.search.candidate_cost import CandidateCost
from tests.ident.benchmark_plants import as_record, p2

STRUCTURES = {
    "plain": Structure(),
    "offset and direct term": Structure(estimate_offset=True, feedthrough=True),
    "initial state": Structure(estimate_offset=True, estimate_initial_state=True),
}
FROZEN = {
    "none": (Poles(), Poles()),
    "kept": (Poles([0.9], [0.95 * np.exp(0.3j)]), Poles([0.9], [0.95 * np.exp(0.3j)])),
    "tangent": (Poles([0.9]).doubled(), Poles([0.9])),
}


def several_records():
    rng = np.random.default_rng(0)
    return [as_record(rng.normal(size=n), 1 + rng.normal(size=n)) for n in (150, 90, 33)]


@pytest.mark.parametrize("n_records", [1, 3])
@pytest.mark.parametrize("counts", [(1, 0), (0, 1), (2, 1), (1, 2)], ids=str)
@pytest.mark.parametrize("frozen", FROZEN.values(), ids=FROZEN)
@pytest.mark.parametrize("structure", STRUCTURES.values(), ids=STRUCTURES)
def test_a_batch_has_the_costs_of_its_points(structure, frozen, counts, n_records):
    data = prepare(several_records()[:n_records], structure)
    space = search_space(*counts, data.longest, data.dt_s, IdentOptions())
    cost = CandidateCost(data, space, *frozen)
    units = np.random.default_rng(1).random((11, space.dimension))  # not a multiple of eight
    one_by_one = np.concatenate([cost.rss(unit[None, :]) for unit in units])
    # The Gram matrix squares condition numbers; with free responses of slow poles those reach 1e3.
    np.testing.assert_allclose(cost.rss(units), one_by_one, rtol=1e-8)
    assert cost.evaluations == 22


def test_a_batch_has_the_residuals_of_fits():
    data = prepare([p2(0, 700).record], Structure(estimate_offset=True))
    kept = Poles([0.98])
    space = search_space(1, 1, data.longest, data.dt_s, IdentOptions())
    units = np.random.default_rng(2).random((20, 3))
    expected = [fit(data, kept.appended(space.poles(unit))).rss for unit in units]
    np.testing.assert_allclose(CandidateCost(data, space, kept, kept).rss(units), expected, rtol=1e-8)


def test_logarithms_stop_where_products_know_nothing():
    u = np.random.default_rng(3).normal(size=300)
    data = prepare([as_record(u, np.concatenate([[0.0], u[:-1]]))], Structure())
    space = search_space(1, 0, 300, 0.005, IdentOptions(decay_max_per_s=1e4))
    cost = CandidateCost(data, space, Poles([0.0]), Poles())
    assert np.all(cost.log(np.linspace(0, 1, 9)[:, None]) >= np.log(1e-13 * (data.y @ data.y)) - 1e-12)
