"""Uncertain plants: integrators counted, responses against python-control, refusals in one line."""

import control
import numpy as np
import pytest

from control_design import PlantChannel, UncertainPlant
from control_design.plants.plant_set import count_integrators, frequency_response, modes_of
from validation.example_plants import LinkUncertainty, ResponseRecord, flexible_link

from .plants import RelativeDisc, hub_arm, random_stable


def test_frequency_response_agrees_with_python_control():
    rng = np.random.default_rng(1)
    system = random_stable(rng, 6, 0.01)
    omega = np.geomspace(1e-3, np.pi / 0.01, 50)
    expected = np.asarray(control.frequency_response(system, omega).complex).ravel()
    np.testing.assert_allclose(frequency_response(system, omega), expected, rtol=1e-9)


@pytest.mark.parametrize("integrators", [1, 2])
def test_integrators_are_counted_from_the_nominal(integrators):
    plant = UncertainPlant("arm", hub_arm(integrators=integrators))
    assert plant.n_integrators == integrators
    assert plant.unstable_poles == 0
    assert [round(m.omega_rad_s, 6) for m in plant.modes] == [16.0]
    assert plant.modes[0].zeta == pytest.approx(0.015, rel=1e-6)
    with pytest.raises(ValueError, match=f"0 integrators declared, the nominal has {integrators} poles"):
        UncertainPlant("arm", hub_arm(integrators=integrators), integrators=0)


def test_a_slow_pole_is_not_an_integrator():
    assert count_integrators(np.array([1 - 1e-6, 0.5])) == 0
    assert count_integrators(np.array([1.0, 1 - 1e-6])) == 1
    assert count_integrators(np.array([1 + 3e-8j, 1 - 3e-8j, 0.9])) == 2


def test_the_example_link_is_the_published_one():
    plant = flexible_link("A")
    dt = plant.dt_s
    s = np.log(plant.poles) / dt
    np.testing.assert_allclose(np.sort(s.real)[[0, -1]], [-4, -0.02], rtol=1e-6)
    finite = plant.zeros[np.abs(plant.zeros + 1) > 1e-6]
    np.testing.assert_allclose(np.sort(np.log(finite.real) / dt), [-11.5, 10.8], rtol=1e-9)
    # Nyquist itself is left out: both have their zero at z = -1 there.
    omega = np.geomspace(1e-4, 600, 300)
    centre = LinkUncertainty("A").at(omega, 0.95).centre
    np.testing.assert_allclose(frequency_response(plant.nominal, omega), centre, rtol=1e-8)
    g = LinkUncertainty("A").at(np.array([0.2]), 0.95).centre[0]
    s = 0.2j
    continuous = (
        (1 - s / 10.8) * (1 + s / 11.5) / ((s + 0.02) * (s / 4 + 1) * (s**2 / 225 + 2 * 0.015 * s / 15 + 1))
    )
    assert abs(g) == pytest.approx(abs(continuous), rel=1e-12)
    assert abs(np.angle(g / continuous)) < 2e-3  # half a sample of delay for each missing zero: 0.2 dt


def test_uncertainty_on_its_own_grid_is_refused_elsewhere_and_nominal_outside():
    system = hub_arm()
    own = np.array([1.0, 2.0, 4.0])
    record = RelativeDisc(system, 0.1, 50.0).at(own, 0.95)
    plant = UncertainPlant("arm", system, record)
    np.testing.assert_array_equal(plant.own_grid, own)
    assert np.all(plant.at(own).semi_major > 0)
    assert np.all(plant.at(np.array([0.5, 10.0])).semi_major == 0)
    with pytest.raises(ValueError, match=r"own grid only; 3 rad/s is not on it"):
        plant.at(np.array([1.0, 3.0]))


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (control.ss(-1, 1, 1, 0), "sampling time in seconds"),
        (control.tf([1], [1, 0.5], 0.1), "control.StateSpace"),
        (control.ss(0.5 * np.eye(2), np.eye(2), np.eye(2), 0, 0.1), "one input and one output"),
        (control.ss([[0, 1], [-1, 0]], [[0], [1]], [[1, 0]], 0, 0.1), "unit circle away from z = 1"),
    ],
)
def test_plants_that_cannot_be_used_are_refused(system, message):
    with pytest.raises(ValueError, match=message):
        UncertainPlant("bad", system)


def test_uncertainty_records_are_checked():
    with pytest.raises(ValueError, match="uncertainty needs a method at"):
        PlantChannel(hub_arm(), object())  # type: ignore[arg-type]
    record = ResponseRecord(np.array([2.0, 1.0]), np.zeros(2), np.zeros((2, 2, 2)), 0.95)
    with pytest.raises(ValueError, match="ascending"):
        PlantChannel(hub_arm(), record)
    record = ResponseRecord(np.array([1.0, 1000.0]), np.zeros(2), np.zeros((2, 2, 2)), 0.95)
    with pytest.raises(ValueError, match="Nyquist frequency is 628"):
        PlantChannel(hub_arm(), record)


def test_modes_of_known_poles():
    s = -0.1 * 20 + 20j * np.sqrt(1 - 0.01)
    (mode,) = modes_of(np.exp(0.01 * np.array([s, s.conjugate(), -3])), 0.01)
    assert (mode.omega_rad_s, mode.zeta) == pytest.approx((20, 0.1))


def test_a_plant_integrates_from_its_slow_poles_on_unless_a_zero_follows():
    s = control.tf("s")
    arm = 1 / (s * (2.0 * s + 0.6))
    for system, expected in (
        (arm, [0.0, 0.3]),
        (arm * (s + 0.35) / (s + 50.0), [0.0]),
        (arm * (s + 5.0) / (s + 50.0), [0.0, 0.3]),
        (1 / (s - 0.4), [0.4]),
        (1 / (s**2 + 0.1 * s + 4.0), [2.0, 2.0]),
        (1.0 + 0.0 * s, []),
    ):
        plant = UncertainPlant("arm", control.ss(control.c2d(control.ss(system), 1e-3, method="tustin")))
        np.testing.assert_allclose(plant.slow_poles_rad_s(3.0), expected, rtol=1e-3, atol=1e-9)
