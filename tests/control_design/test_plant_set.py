"""Uncertain plants: integrators counted, responses, stated discs between frequencies, refusals."""

import control
import numpy as np
import pytest

from control_design import Controller, PlantChannel, RationalWeight, Specification, UncertainPlant, certify
from control_design.plants.first_order import FrequencyIntervals
from control_design.plants.plant_set import count_integrators, frequency_response, modes_of
from control_design.plants.stated_uncertainty import StatedDiscs
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
    plant = UncertainPlant(hub_arm(integrators=integrators), name="arm")
    assert plant.n_integrators == integrators
    assert plant.unstable_poles == 0
    assert [round(m.omega_rad_s, 6) for m in plant.modes] == [16.0]
    assert plant.modes[0].zeta == pytest.approx(0.015, rel=1e-6)
    with pytest.raises(ValueError, match=rf"0\D+{integrators} poles"):
        UncertainPlant(hub_arm(integrators=integrators), name="arm", integrators=0)


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
    plant = UncertainPlant(system, name="arm", uncertainty=record)
    np.testing.assert_array_equal(plant.own_grid, own)
    assert np.all(plant.at(own).semi_major > 0)
    assert np.all(plant.at(np.array([0.5, 10.0])).semi_major == 0)
    with pytest.raises(ValueError, match="3 rad/s"):
        plant.at(np.array([1.0, 3.0]))


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (control.ss(-1, 1, 1, 0), "continuous time"),
        ("arm", "control.ss"),
        (control.ss(0.5 * np.eye(2), np.eye(2), np.eye(2), 0, 0.1), "2 inputs and 2 outputs"),
        (control.ss([[0, 1], [-1, 0]], [[0], [1]], [[1, 0]], 0, 0.1), "unit circle away from z = 1"),
    ],
)
def test_plants_that_cannot_be_used_are_refused(system, message):
    with pytest.raises(ValueError, match=message):
        UncertainPlant(system, name="bad")


def test_uncertainty_records_are_checked():
    with pytest.raises(ValueError, match="uncertainty"):
        PlantChannel(hub_arm(), object())  # type: ignore[arg-type]
    record = ResponseRecord(np.array([2.0, 1.0]), np.zeros(2), np.zeros((2, 2, 2)), 0.95)
    with pytest.raises(ValueError, match="ascending"):
        PlantChannel(hub_arm(), record)
    record = ResponseRecord(np.array([1.0, 1000.0]), np.zeros(2), np.zeros((2, 2, 2)), 0.95)
    with pytest.raises(ValueError, match="628"):
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
        plant = UncertainPlant(control.ss(control.c2d(control.ss(system), 1e-3, method="tustin")), name="arm")
        np.testing.assert_allclose(plant.slow_poles_rad_s(3.0), expected, rtol=1e-3, atol=1e-9)


DT_S = 0.05
WEIGHT = RationalWeight(numerator=(0.2, 0.1), denominator=(0.1, 1.0))


def arm() -> control.StateSpace:
    """A lag and a mode at 12 rad/s."""
    continuous = control.tf([1.0], [0.5, 1.0]) * control.tf([144.0], [1.0, 1.2, 144.0])
    return control.sample_system(control.ss(continuous), DT_S)


def weight_size(omega):
    """|W| at the Tustin frequency, from the coefficients."""
    s = 2j / DT_S * np.tan(omega * DT_S / 2)
    return np.abs((0.2 * s + 0.1) / (0.1 * s + 1.0))


@pytest.mark.parametrize("kind", ["multiplicative", "additive"])
def test_ellipses_are_discs_of_the_stated_radius(kind):
    plant = UncertainPlant(arm(), name="arm", uncertainty=StatedDiscs(arm(), WEIGHT, kind))
    omega = np.geomspace(0.01, 60.0, 50)
    found = plant.at(omega)
    response = arm()(np.exp(1j * omega * DT_S))
    radius = weight_size(omega) * (np.abs(response) if kind == "multiplicative" else 1.0)
    np.testing.assert_allclose(found.centre, response, rtol=1e-9)
    np.testing.assert_allclose(found.semi_major, radius, rtol=1e-9)
    np.testing.assert_allclose(found.semi_minor, radius, rtol=1e-7)


@pytest.mark.parametrize("kind", ["multiplicative", "additive"])
def test_expansion_holds_on_its_interval(kind):
    discs = StatedDiscs(arm(), WEIGHT, kind)
    intervals = FrequencyIntervals(np.array([0.3, 3.0, 12.0]), np.array([0.01, 0.1, 0.2]), DT_S)
    centre, generators = discs.first_order(intervals, 0)
    scale = np.sqrt(-2 * np.log(0.05))
    for k, (middle, half) in enumerate(zip(intervals.centre, intervals.half_width, strict=True)):
        x = np.linspace(-half, half, 41)
        true = arm()(np.exp(1j * (middle + x) * DT_S))
        linear = centre.value[k] + centre.slope[k] * x
        assert np.max(np.abs(true - linear)) <= centre.remainder[k] * (1 + 1e-9)
        size = weight_size(middle + x) * (np.abs(true) if kind == "multiplicative" else 1.0)
        linear = np.linalg.norm(generators.value[k] + x[:, None] * generators.slope[k], axis=1) / np.sqrt(2)
        assert np.max(np.abs(size - scale * linear)) <= scale * generators.remainder[k] + 1e-12


@pytest.mark.slow
def test_certificate_covers_members_of_the_set_for_all_frequencies():
    """Gains, delays and lags inside the discs: each is stable and has its peak of S below the certified."""
    plant = UncertainPlant(arm(), name="arm", uncertainty=StatedDiscs(arm(), WEIGHT))
    law = Controller(*(np.array([[value]]) for value in (1.0, DT_S, 0.4, 0.0)), DT_S)
    found = certify(law, [plant], Specification(modulus_margin=0.3, controller_order=1))
    assert found.certified
    assert found.plants[0].all_frequencies.proved
    peak = found.plants[0].worst_peak_sensitivity
    loop = law.to_control(include_delay=True) * arm()
    omega = np.geomspace(1e-3, np.pi / DT_S, 4000)
    z = np.exp(1j * omega * DT_S)
    nominal_loop, radius, largest = loop(z), weight_size(omega), 0.0
    for phase in np.linspace(0, 2 * np.pi, 60):
        # A member at every frequency by itself: the disc's boundary point of that phase.
        value = nominal_loop * (1 + radius * np.exp(1j * phase))
        largest = max(largest, float(np.max(1 / np.abs(1 + value))))
    assert largest <= peak * (1 + 1e-6)
    assert largest > 0.99 * peak  # and it is reached
    for factor in (0.9, 1.1):
        assert np.all(np.abs(control.feedback(loop * factor, 1).poles()) < 1)


def test_pole_on_the_axis_is_refused():
    with pytest.raises(ValueError, match="pole on the imaginary axis"):
        StatedDiscs(arm(), RationalWeight(numerator=(1.0,), denominator=(1.0, 0.0)))
