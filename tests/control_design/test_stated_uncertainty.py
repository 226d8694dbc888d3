"""Stated discs: radius against the formula, bounds between frequencies against dense sampling."""

import control
import numpy as np
import pytest

from control_design import Controller, RationalWeight, Specification, UncertainPlant, certify
from control_design.plants.first_order import FrequencyIntervals
from control_design.plants.stated_uncertainty import StatedDiscs

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
    plant = UncertainPlant("arm", arm(), StatedDiscs(arm(), WEIGHT, kind))
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
    plant = UncertainPlant("arm", arm(), StatedDiscs(arm(), WEIGHT))
    law = Controller(*(np.array([[value]]) for value in (1.0, DT_S, 0.4, 0.0)), DT_S)
    found = certify(law, [plant], Specification(modulus_margin=0.3, controller_order=1))
    assert found.certified
    assert found.plants[0].all_frequencies.proved
    peak = found.plants[0].worst_peak_sensitivity
    loop = law.to_control(include_delay=True) * arm()
    omega = np.geomspace(1e-3, np.pi / DT_S, 4000)
    z = np.exp(1j * omega * DT_S)
    largest = 0.0
    for phase in np.linspace(0, 2 * np.pi, 60):
        # A member at every frequency by itself: the disc's boundary point of that phase.
        value = loop(z) * (1 + weight_size(omega) * np.exp(1j * phase))
        largest = max(largest, float(np.max(1 / np.abs(1 + value))))
    assert largest <= peak * (1 + 1e-6)
    assert largest > 0.99 * peak  # and it is reached
    for factor in (0.9, 1.1):
        assert np.all(np.abs(control.feedback(loop * factor, 1).poles()) < 1)


def test_pole_on_the_axis_is_refused():
    with pytest.raises(ValueError, match="pole on the imaginary axis"):
        StatedDiscs(arm(), RationalWeight(numerator=(1.0,), denominator=(1.0, 0.0)))
