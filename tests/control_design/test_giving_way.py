"""Requirements that give way by as little as makes the rest feasible, and what stays hard."""

import numpy as np
import pytest

from control_design import Specification, SynthesisOptions, certify, synthesise
from control_design.specification import GIVES_WAY
from control_design.synthesis.giving_way import synthesise_giving_way, without_limits
from tests.control_design.test_bandwidth import _inertia

# An inertia has neither modes nor ellipses: few frequencies hold its loop.
_EFFORT = SynthesisOptions(starts=1, grid_points=40, mode_points=0, dense_points=800)


def _asked(**change) -> Specification:
    stated = {"bandwidth_rad_s": 6.0, "effort_limit": 20.0, "controller_order": 2, "modulus_margin": 0.6}
    return Specification(**(stated | change))


def _met(asked: Specification, seed: int = 1) -> bool:
    rng = np.random.default_rng(seed)
    return synthesise([_inertia()], without_limits(asked), _EFFORT, rng=rng).gamma <= 1.0


@pytest.mark.slow
def test_an_effort_limit_gives_way_by_as_little_as_is_needed():
    asked = _asked(highest_effort_limit=400.0)
    assert not _met(asked)
    used, result = synthesise_giving_way([_inertia()], asked, _EFFORT, rng=np.random.default_rng(1))
    assert asked.effort_limit < used.effort_limit < asked.highest_effort_limit
    assert all(getattr(used, limit) is None for limit in GIVES_WAY.values())
    # What was designed for is what is certified; three per cent less was not to be had.
    assert certify(result.controller, [_inertia()], used).certified
    assert not _met(used.model_copy(update={"effort_limit": 0.97 * used.effort_limit}), seed=2)
    # All else stays as it was asked.
    unmoved = set(type(used).model_fields) - {"effort_limit", *GIVES_WAY.values()}
    assert all(getattr(used, key) == getattr(asked, key) for key in unmoved)


def test_what_states_no_limit_is_hard_and_a_limit_that_is_not_enough_changes_nothing():
    hard = _asked()
    same, missed = synthesise_giving_way([_inertia()], hard, _EFFORT, rng=np.random.default_rng(1))
    assert (same, missed.gamma > 1.0) == (hard, True)
    short = _asked(highest_effort_limit=22.0)
    used, result = synthesise_giving_way([_inertia()], short, _EFFORT, rng=np.random.default_rng(1))
    assert (used, result.gamma > 1.0) == (hard, True)


def test_what_is_met_gives_no_way():
    asked = _asked(effort_limit=400.0, highest_effort_limit=4000.0)
    used, result = synthesise_giving_way([_inertia()], asked, _EFFORT, rng=np.random.default_rng(1))
    assert (used, result.gamma <= 1.0) == (without_limits(asked), True)


@pytest.mark.slow
def test_the_bandwidth_gives_way_before_anything_else():
    asked = _asked(lowest_bandwidth_rad_s=0.5, highest_effort_limit=400.0)
    used, result = synthesise_giving_way([_inertia()], asked, _EFFORT, rng=np.random.default_rng(1))
    assert result.gamma <= 1.0
    assert used.effort_limit == asked.effort_limit
    assert 0.5 <= used.bandwidth_rad_s < 6.0


@pytest.mark.parametrize(
    "change",
    [
        {"highest_effort_limit": 5.0},
        {"effort_limit": None, "highest_effort_limit": 5.0},
        {"highest_mode_peak_ratio": 2.0},
        {"mode_peak_ratio": 2.0, "highest_mode_peak_ratio": 1.0},
    ],
)
def test_a_limit_needs_a_smaller_value(change):
    with pytest.raises(ValueError, match=r"highest_\w+ needs a smaller"):
        _asked(**change)
