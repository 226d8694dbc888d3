"""Fits of the Youla bound's controllers: exact where K has the asked order, near the bound on the links."""

import numpy as np
import pytest

from control_design import synthesise
from control_design.controllers.biquads import Cascade
from control_design.controllers.parts import NotchPart
from control_design.synthesis.order_search import FINER
from control_design.synthesis.youla_starts import FreeController, fitted, free_controllers
from validation.example_plants import flexible_link, flexible_link_specification

_OMEGA = np.geomspace(0.05, 600.0, 150)


@pytest.mark.parametrize(
    "sections",
    [("second_order",), ("first_order", "second_order", "second_order"), ("integrator", "second_order")],
)
@pytest.mark.parametrize("weighted", [False, True])
def test_a_controller_of_the_asked_order_is_found_again(sections, weighted):
    """Random sections with damped poles; the weights do not matter where the fit is exact."""
    cascade, rng = Cascade(sections, 0.005, 15.0), np.random.default_rng(3)
    for _ in range(5):
        x: list[float] = []
        for kind in sections:
            corner, zeta = 10 ** rng.uniform(-0.7, 0.7), rng.uniform(0.35, 1.5)
            x += rng.normal(1.0, 0.3, 3 if kind == "second_order" else 2).tolist()
            if kind != "integrator":
                x += (
                    [np.log(corner)]
                    if kind == "first_order"
                    else [np.log(2 * zeta * corner), 2 * np.log(corner)]
                )
        k = cascade.response(x, _OMEGA)
        found = fitted(cascade, FreeController(_OMEGA, k), least_damping=0.3, rng=rng if weighted else None)
        np.testing.assert_allclose(cascade.response(found, _OMEGA), k, rtol=1e-5)


def test_fits_are_damped_as_asked_and_not_made_of_notches():
    resonance = Cascade(("second_order",), 0.005, 15.0)
    k = resonance.response([0.0, 0.0, 1.0, np.log(2 * 0.01), 0.0], _OMEGA)
    found = fitted(resonance, FreeController(_OMEGA, k), least_damping=0.3)
    assert resonance.least_damping(found) >= 0.3 * (1 - 1e-9)
    parts = Cascade((NotchPart(None, None, None, None, 0.04),), 0.005, 15.0)
    assert fitted(parts, FreeController(_OMEGA, k), least_damping=0.3) is None


@pytest.mark.parametrize(
    ("scenario", "youla", "limit"),
    [("A", 0.926, 0.9374), pytest.param("C", 1.2547, 1.3356, marks=pytest.mark.long)],
)
def test_the_search_ends_with_few_starts_where_they_come_near_the_bound(scenario, youla, limit):
    """Limits: within .1 % of what 40 starts of two orders reach; youla: bound with the default basis."""
    plant, specification = flexible_link(scenario), flexible_link_specification(5)
    free = free_controllers([plant], specification)
    assert youla <= free.gamma <= 1.1 * youla
    # Which order is asked for is nothing to the bound: it is the same object.
    assert free_controllers([plant], flexible_link_specification(3)) is free
    result = synthesise([plant], specification, rng=np.random.default_rng(1))
    assert result.gamma <= limit
    # The floor is a bound of any controller, but for the size of the basis.
    assert 0.9 * free.gamma < free.floor <= min(free.gamma, FINER * result.gamma)
    assert len(result.starts) < 30
    assert {start.status for start in result.starts} == {"descent"}
