"""Reference filter: independent evaluation of errors, known answers, round trips."""

import control
import numpy as np
import pytest

from control_design.analysis.closed_loop import LinearMachine, simulate
from control_design.controllers.controller import Controller
from control_design.convex.reference_filter import (
    ReferenceFilter,
    ReferenceFilterOptions,
    design_reference_filter,
    worst_matching_error,
)
from control_design.plants.ellipses import Ellipses
from control_design.plants.plant_set import UncertainPlant
from control_design.plants.weights import RationalWeight

from .plants import RelativeDisc, hub_arm

_FAST = ReferenceFilterOptions(grid_points=80, mode_points=30, dense_points=1500)
_MODEL = RationalWeight(numerator=(1.0,), denominator=(0.25, 1.0, 1.0))


def _hub_loop(relative_std=0.05):
    nominal = hub_arm()
    plant = UncertainPlant(nominal, name="hub", uncertainty=RelativeDisc(nominal, relative_std, 30.0))
    return Controller.proportional(0.05, 0.005), plant


@pytest.mark.parametrize("seed", range(5))
def test_worst_error_is_the_maximum_over_the_boundary(seed):
    rng = np.random.default_rng(seed)
    size = 40
    complex_normal = lambda: rng.standard_normal(size) + 1j * rng.standard_normal(size)  # noqa: E731
    centre, k = complex_normal(), complex_normal()
    major = 0.3 * rng.uniform(size=size) * np.abs(1 / k + centre)  # the loop stays away from -1
    minor = major * rng.uniform(size=size)
    minor[:5], major[5:10], minor[5:10] = 0.0, 0.0, 0.0
    e = Ellipses(np.arange(1.0, size + 1), centre, major, minor, np.exp(2j * np.pi * rng.uniform(size=size)))
    follow, model = complex_normal(), complex_normal()
    angle = np.linspace(0, 2 * np.pi, 20_001)
    member = e.points(np.cos(angle)[:, None], np.sin(angle)[:, None])
    sampled = np.max(np.abs(follow * member * k / (1 + member * k) - model), axis=0)
    exact = worst_matching_error(k, follow, model, e)
    np.testing.assert_allclose(exact, sampled, rtol=1e-6)
    assert np.all(exact >= sampled * (1 - 1e-12))


def test_constant_filter_of_an_exact_plant_agrees_with_a_scan():
    # Gain 9 on 0.05 z/(z - 0.95): T = 0.45 z/(1.45 z - 0.95).
    dt = 0.01
    plant = UncertainPlant(control.ss(control.tf([0.05, 0], [1, -0.95], dt)), name="lag")
    controller = Controller.proportional(9.0, dt, computational_delay_samples=0)
    model = RationalWeight(numerator=(1.0,), denominator=(1 / 40, 1.0))
    got = design_reference_filter(
        controller, plant, model, ReferenceFilterOptions(order=0, unit_gain=False, dense_points=2000)
    )
    z = np.exp(1j * np.geomspace(1e-4, np.pi / dt, 4000) * dt)
    tracking = 0.45 * z / (1.45 * z - 0.95)
    target = 1 / (2 / dt * (z - 1) / (z + 1) / 40 + 1)
    scan = min(np.max(np.abs(f * tracking - target)) for f in np.linspace(0.3, 1.5, 2401))
    assert got.error_before == pytest.approx(np.max(np.abs(tracking - target)), rel=1e-4)
    assert got.error_after == pytest.approx(scan, rel=1e-3)


def test_designed_filter_improves_over_all_members_and_keeps_unit_gain():
    controller, plant = _hub_loop()
    reference_filter = design_reference_filter(controller, plant, _MODEL, _FAST)
    assert reference_filter.order == 1
    assert reference_filter.error_after < 0.7 * reference_filter.error_before
    f = reference_filter.to_control()
    assert np.real(f(1.0)) == pytest.approx(1.0, abs=1e-9)
    # Independent evaluation: members of the discs, python-control for the loop.
    omega = np.geomspace(1e-2, 600, 300)
    k = 0.05 * np.exp(-1j * omega * 0.005)
    centre = np.asarray(control.frequency_response(plant.nominal, omega).complex).ravel()
    radius = np.abs(centre) * 0.05 * np.sqrt(1 + (omega / 30) ** 4) * np.sqrt(-2 * np.log(0.05))
    member = centre + radius * np.exp(2j * np.pi * np.arange(90) / 90)[:, None]
    s = 2j / 0.005 * np.tan(omega * 0.005 / 2)
    target = 1 / (0.25 * s**2 + s + 1)
    response = np.asarray(control.frequency_response(f, omega).complex).ravel()
    error = np.max(np.abs(response * member * k / (1 + member * k) - target))
    assert error <= reference_filter.error_after * (1 + 1e-6)
    assert error > 0.9 * reference_filter.error_after


@pytest.mark.long
def test_more_poles_never_hurt_and_two_plants_cost():
    controller, plant = _hub_loop()
    one = design_reference_filter(controller, plant, _MODEL, _FAST.model_copy(update={"poles_rad_s": (3.0,)}))
    two = design_reference_filter(
        controller, plant, _MODEL, _FAST.model_copy(update={"poles_rad_s": (3.0, 8.0)})
    )
    assert two.error_after <= one.error_after * (1 + 1e-3)
    wide = _hub_loop(0.08)[1]
    both = design_reference_filter(
        controller, [plant, wide], _MODEL, _FAST.model_copy(update={"poles_rad_s": (3.0,)})
    )
    assert both.error_after >= one.error_after * (1 - 1e-3)


def test_round_trips_and_filtering():
    controller, plant = _hub_loop()
    reference_filter = design_reference_filter(
        controller, plant, _MODEL, _FAST.model_copy(update={"poles_rad_s": (2.0, 9.0)})
    )
    again = ReferenceFilter.from_json(reference_filter.to_json())
    for name in ("A", "B", "C", "D"):
        np.testing.assert_array_equal(getattr(again, name), getattr(reference_filter, name))
    assert (again.error_before, again.error_after) == (
        reference_filter.error_before,
        reference_filter.error_after,
    )
    reference = np.random.default_rng(1).standard_normal(200)
    expected = control.forced_response(reference_filter.to_control(), inputs=reference).outputs
    np.testing.assert_allclose(reference_filter.filtered(reference), expected, atol=1e-12)


def test_simulated_step_is_the_response_of_reference_filter_and_loop():
    controller, plant = _hub_loop()
    reference_filter = design_reference_filter(
        controller, plant, _MODEL, _FAST.model_copy(update={"poles_rad_s": (2.0,)})
    )
    step = np.ones(600)
    run = simulate(controller, LinearMachine(plant.nominal), reference_filter.filtered(step))
    loop = control.series(controller.to_control(include_delay=True), plant.nominal)
    whole = control.series(reference_filter.to_control(), control.feedback(loop, 1))
    expected = control.forced_response(whole, inputs=step).outputs
    np.testing.assert_allclose(run.output[:, 0], expected, atol=1e-9)


def test_bad_input_is_one_clear_line():
    controller, plant = _hub_loop()
    with pytest.raises(ValueError, match="Nyquist"):
        design_reference_filter(controller, plant, _MODEL, ReferenceFilterOptions(poles_rad_s=(1e4,)))
    with pytest.raises(ValueError, match="at least one"):
        design_reference_filter(controller, [], _MODEL)
    with pytest.raises(ValueError, match="loop on -1"):
        design_reference_filter(controller, _hub_loop(0.6)[1], _MODEL, _FAST)
    with pytest.raises(ValueError, match="not stable"):
        ReferenceFilter(np.eye(1), np.ones((1, 1)), np.ones((1, 1)), np.ones((1, 1)), 0.1, 1.0, 1.0, 0.0)
    with pytest.raises(ValueError, match="lacks the key 'dt_s'"):
        ReferenceFilter.from_dict(
            {"format": "flexlink-reference_filter-1", "A": [], "B": [], "C": [], "D": [[1.0]]}
        )
