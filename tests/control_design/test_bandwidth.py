"""The bandwidth that a specification leaves open."""

from contextlib import suppress

import control
import numpy as np
import pytest

from control_design import Specification, SpecificationError, SynthesisOptions, UncertainPlant, synthesise
from control_design.synthesis.giving_way import synthesise_giving_way

_DT = 0.01
_EFFORT = SynthesisOptions(starts=2, grid_points=80, dense_points=2000)
# An inertia has neither modes nor ellipses: few frequencies hold its loop.
_FEW = SynthesisOptions(starts=1, grid_points=40, mode_points=0, dense_points=800)


def _inertia(delay_samples: int = 0) -> UncertainPlant:
    arm = control.c2d(control.ss(control.tf([1.0], [1.0, 0.5, 0.0])), _DT)
    late = control.ss(control.tf([1.0], [1.0] + [0.0] * delay_samples, _DT))
    return UncertainPlant(arm * late if delay_samples else arm, name="arm")


def _asked(**change) -> Specification:
    stated = {"bandwidth_rad_s": 40.0, "lowest_bandwidth_rad_s": 0.5, "controller_order": 3}
    return Specification(**(stated | {"integrator": True} | change))


@pytest.mark.slow
@pytest.mark.parametrize("delays", [(10,), pytest.param((2, 10), marks=pytest.mark.long)])
def test_the_highest_bandwidth_that_is_met_is_taken(delays):
    """What a dead time leaves is in proportion to it, as two of them show."""
    highest_rad_s = {}
    for delay in delays:
        plant = _inertia(delay)
        asked = _asked(bandwidth_rad_s=8.0, lowest_bandwidth_rad_s=1.2, controller_order=2)
        used, result = synthesise_giving_way([plant], asked, _FEW, rng=np.random.default_rng(1))
        assert result.gamma <= 1.0
        assert used.lowest_bandwidth_rad_s is None
        assert 1.2 <= used.bandwidth_rad_s < 8.0
        wider = used.model_copy(update={"bandwidth_rad_s": 1.8 * used.bandwidth_rad_s})
        with suppress(SpecificationError):  # where the delay alone forbids it
            assert synthesise([plant], wider, _FEW, rng=np.random.default_rng(2)).gamma > 1.0
        highest_rad_s[delay] = used.bandwidth_rad_s
    if len(delays) > 1:
        assert 2 < highest_rad_s[2] / highest_rad_s[10] < 6


def test_a_bandwidth_that_is_met_stays():
    asked = _asked(bandwidth_rad_s=1.0)
    used, result = synthesise_giving_way([_inertia()], asked, _EFFORT, rng=np.random.default_rng(1))
    assert (used.bandwidth_rad_s, result.gamma <= 1.0) == (1.0, True)


@pytest.mark.long
def test_nothing_is_lowered_unless_it_is_asked_for():
    asked = _asked(lowest_bandwidth_rad_s=None, bandwidth_rad_s=6.0, controller_order=1)
    plant = _inertia(20)
    used, result = synthesise_giving_way([plant], asked, _FEW, rng=np.random.default_rng(1))
    assert used == asked
    assert result.gamma == synthesise([plant], asked, _FEW, rng=np.random.default_rng(1)).gamma


def test_where_none_is_met_the_lowest_is_designed_for():
    asked = _asked(effort_limit=1e-3)
    with pytest.raises(SpecificationError, match="effort"):
        synthesise_giving_way([_inertia()], asked, _EFFORT, rng=np.random.default_rng(1))


@pytest.mark.parametrize("change", [{"bandwidth_rad_s": 0.5}, {"bandwidth_rad_s": None}])
def test_a_lowest_bandwidth_needs_a_higher_one(change):
    with pytest.raises(ValueError, match=r"lowest_bandwidth_rad_s.* bandwidth_rad_s"):
        _asked(**change)
