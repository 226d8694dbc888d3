"""The cost of candidate poles on top of frozen ones against fits of all poles together."""

import numpy as np
import pytest

from ident import IdentOptions, Poles, Record, Structure
from ident.basis.coordinates import search_space
from ident.fit.least_squares import fit
from ident.fit.regression import prepare, prepare_inputs
from tests.ident.benchmark_plants import as_record, p2

STRUCTURES = {
    "plain": Structure(),
    "offset and direct term": Structure(estimate_offset=True, feedthrough=True),
    "initial state": Structure(estimate_offset=True, estimate_initial_state=True),
}


def several_records(n_inputs):
    rng = np.random.default_rng(0)
    names = tuple("abc"[:n_inputs])
    return [
        Record(
            rng.normal(size=(n, n_inputs)), 1 + rng.normal(size=(n, 1)), 0.005, name="r", input_names=names
        )
        for n in (150, 90, 33)
    ]


@pytest.mark.parametrize("n_inputs", [1, 2])
@pytest.mark.parametrize("n_records", [1, 3])
@pytest.mark.parametrize("counts", [(1, 0), (0, 1), (2, 1), (1, 2)], ids=str)
@pytest.mark.parametrize("kept", [Poles(), Poles([0.9], [0.95 * np.exp(0.3j)])], ids=["none", "kept"])
@pytest.mark.parametrize("structure", STRUCTURES.values(), ids=STRUCTURES)
def test_the_cost_of_candidates_is_the_residual_of_the_fit(structure, kept, counts, n_records, n_inputs):
    data = prepare_inputs(several_records(n_inputs)[:n_records], structure)
    space = search_space(*counts, data.longest, data.dt_s, IdentOptions())
    cost = data.candidate_cost(space, kept, kept)
    units = np.random.default_rng(1).random((5, space.dimension))
    expected = [data.residual(kept.appended(space.poles(unit))) for unit in units]
    # The Gram matrix squares condition numbers; with free responses of slow poles those reach 1e3.
    np.testing.assert_allclose(cost.rss(units), [r @ r for r in expected], rtol=1e-8)
    assert cost.evaluations == 5
    assert cost.log(units[0]) == pytest.approx(np.log(expected[0] @ expected[0]), abs=1e-8)


def test_candidates_join_the_tangent_space():
    """A candidate at a frozen pole is that pole a third time."""
    data = prepare([p2(0, 700).record], Structure(estimate_offset=True))
    space = search_space(1, 0, data.longest, data.dt_s, IdentOptions())
    kept = space.poles(np.array([0.5]))
    frozen = data.residual(kept.doubled())
    cost = data.candidate_cost(space, kept.doubled(), kept)
    tripled = fit(data, kept.doubled().appended(kept)).rss
    assert cost.rss(np.array([[0.5]]))[0] == pytest.approx(tripled, rel=1e-8)
    assert tripled < frozen @ frozen


def test_logarithms_stop_where_products_know_nothing():
    u = np.random.default_rng(3).normal(size=300)
    data = prepare([as_record(u, np.concatenate([[0.0], u[:-1]]))], Structure())
    space = search_space(1, 0, 300, 0.005, IdentOptions(decay_max_per_s=1e4))
    cost = data.candidate_cost(space, Poles([0.0]), Poles())
    floor = np.log(1e-13 * (data.y @ data.y))
    assert all(cost.log(np.array([x])) >= floor - 1e-12 for x in np.linspace(0, 1, 9))
