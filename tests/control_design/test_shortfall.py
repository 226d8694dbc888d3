"""Why a controller is no design: nominal loops, ellipses over -1, extra delay, a controller that rings."""

import control
import numpy as np
import pytest

from control_design import Specification, SynthesisOptions, UncertainPlant
from control_design.controllers.biquads import Cascade
from control_design.plants.ellipses import Ellipses, scale_to_minus_one
from control_design.synthesis.problem import Problem
from control_design.synthesis.synthesis import DAMPING, DELAYED, NOMINAL, ROBUST, what_destabilises

from .plants import RelativeDisc

_DT_S = 0.01
_LAG = control.c2d(control.ss(control.tf([1.0], [1.0, 1.0])), _DT_S, "zoh")


def _problem(plants: list[UncertainPlant], **fields: float) -> Problem:
    specification = Specification(controller_order=1, computational_delay_samples=0, **fields)
    return Problem(tuple(plants), specification, SynthesisOptions(dense_points=1000))


def _gain(problem: Problem, gain: float) -> tuple[Cascade, np.ndarray]:
    """A constant: first-order section whose zero sits on its pole."""
    cascade = Cascade(("first_order",), problem.dt_s, problem.scale_rad_s)
    return cascade, np.array([gain, gain, 0.0])


def test_a_good_loop_has_nothing_to_name():
    problem = _problem([UncertainPlant(_LAG, name="lag", uncertainty=RelativeDisc(_LAG, 0.1, 60.0))])
    assert what_destabilises(problem, *_gain(problem, 1.0)) == ()


def test_an_unstable_nominal_loop_is_named_by_its_fastest_growing_pole():
    problem = _problem([UncertainPlant(_LAG, name="lag"), UncertainPlant(2 * _LAG, name="double")])
    # z = a - k b with a = e^-0.01, b = 1 - a: k = 210 puts one pole at -1.1 for "lag", at -3.2 for "double"
    found = what_destabilises(problem, *_gain(problem, 210.0))
    assert [(point.plant, point.weight) for point in found] == [("double", NOMINAL), ("lag", NOMINAL)]
    pole = np.exp(-0.01) - 420.0 * (1 - np.exp(-0.01))
    assert found[0].omega_rad_s == pytest.approx(abs(np.log(complex(pole))) / _DT_S, rel=1e-6)


def test_an_ellipse_over_minus_one_is_named_where_it_lies_deepest():
    """A disc of relative radius r reaches -1 where r |T| >= 1; T of lag and gain falls with frequency."""
    plant = UncertainPlant(_LAG, name="vague", uncertainty=RelativeDisc(_LAG, 0.5, 1e6))  # r = 0.5 * 2.448
    problem = _problem([plant])
    found = what_destabilises(problem, *_gain(problem, 20.0))
    assert {point.weight for point in found} == {ROBUST}
    assert found[0].plant == "vague"
    assert found[0].omega_rad_s < 1.0  # |T| = 20/21 at low frequency
    assert np.isinf(found[0].value)


def test_the_delay_that_destabilises_is_named_beyond_a_loop_that_is_stable_without_it():
    """|L| = 1 near 20 rad/s with a phase margin of about pi/2: 0.08 s. Asked: ten times that."""
    plant = UncertainPlant(_LAG, name="lag", uncertainty=RelativeDisc(_LAG, 0.2, 1e6))
    problem = _problem([plant], delay_margin_s=0.8)
    found = what_destabilises(problem, *_gain(problem, 20.0))
    assert {point.weight for point in found} == {DELAYED}
    assert all(1.0 < point.omega_rad_s < 60.0 for point in found)


def test_a_controller_that_rings_is_named_by_its_own_pair():
    specification = Specification(
        controller_order=2, controller_damping=0.5, computational_delay_samples=0, modulus_margin=0.3
    )
    problem = Problem((UncertainPlant(_LAG, name="lag"),), specification, SynthesisOptions(dense_points=1000))
    cascade = Cascade(("second_order",), problem.dt_s, problem.scale_rad_s)
    corner, damping = 3.0, 0.1
    pair = [np.log(2 * damping * corner), 2 * np.log(corner)]
    found = what_destabilises(problem, cascade, np.array([0.0, 0.0, 0.1, *pair]))
    assert [point.weight for point in found] == [DAMPING]
    assert found[0].omega_rad_s == pytest.approx(corner * problem.scale_rad_s)
    assert found[0].value == pytest.approx(5.0)


def test_scaled_by_the_factor_an_ellipse_just_reaches_minus_one():
    rng = np.random.default_rng(3)
    n = 200
    turn = np.exp(2j * np.pi * rng.random(n))
    centre, k = (rng.standard_normal(n) + 1j * rng.standard_normal(n) for _ in range(2))
    minor = rng.random(n)
    ellipses = Ellipses(np.arange(1.0, n + 1), centre, minor + rng.random(n), minor, turn)
    scale = scale_to_minus_one(k, ellipses)
    # The member that hits: G = -1/K lies on the boundary of the scaled ellipse.
    away = (-1 / k - centre) * np.conj(turn) / scale
    on = (away.real / ellipses.semi_major) ** 2 + (away.imag / ellipses.semi_minor) ** 2
    np.testing.assert_allclose(on, 1.0, rtol=1e-9)
    point = Ellipses(np.array([1.0]), np.array([0.5 + 0j]), [0.0], [0.0], np.array([1.0 + 0j]))
    assert np.isinf(scale_to_minus_one(np.array([1.0 + 0j]), point))
    assert np.isinf(scale_to_minus_one(np.array([0.0 + 0j]), point))
