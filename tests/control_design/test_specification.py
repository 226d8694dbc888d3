"""Weights by hand, and contradictions refused in one line with their numbers."""

import control
import numpy as np
import pytest

from control_design import LoopFunction, RationalWeight, Specification, SpecificationError, UncertainPlant
from validation.example_plants import flexible_link

from .plants import hub_arm, tip_acceleration


def test_bandwidth_means_minus_three_decibels():
    lag = UncertainPlant(control.ss(0.9, 0.1, 1, 0, 0.001), name="lag")
    for integrator in (False, True):
        spec = Specification(bandwidth_rad_s=3.0, modulus_margin=0.5, integrator=integrator)
        # At s = j bandwidth the weight is sqrt 2 up to the tiny low-frequency floor.
        value = abs(spec.tracking_weight().at(np.array([3j]))[0])
        assert value == pytest.approx(np.sqrt(2), rel=1e-5)
        high = spec.magnitude(lag, np.array([500.0]), LoopFunction.SENSITIVITY)
        assert high[0] == pytest.approx(0.5, rel=1e-3)
    low = abs(Specification(bandwidth_rad_s=3.0).tracking_weight().at(np.array([1e-9j]))[0])
    assert low == pytest.approx(1000, rel=1e-6)


def test_effort_limit_and_rolloff():
    spec = Specification(effort_limit=4.0, effort_rolloff_rad_s=10.0)
    lag = UncertainPlant(control.ss(0.9, 0.1, 1, 0, 1e-5), name="lag")
    omega = np.array([0.01, 10.0, 100.0])
    limit = 1 / spec.magnitude(lag, omega, LoopFunction.EFFORT)
    np.testing.assert_allclose(limit, [4, 4 / np.sqrt(2), 4 / np.sqrt(101)], rtol=0.05)
    assert np.all(Specification().magnitude(lag, np.array([1.0]), LoopFunction.EFFORT) == 0)


def test_damping_weight_is_relative_to_the_open_loop_peak():
    plant = UncertainPlant(hub_arm(), name="arm")
    spec = Specification(mode_peak_ratio=0.25)
    weight = spec.magnitude(plant, np.array([5.0, 16.0, 100.0]), LoopFunction.DISTURBANCE)
    omega = np.linspace(16 / 1.5, 24, 20_001)
    peak = np.max(np.abs(control.frequency_response(hub_arm(), omega).complex))
    np.testing.assert_allclose(weight, [0, 4 / peak, 0], rtol=1e-3)  # peak found on 121 points of the mode


def test_bandwidth_beyond_the_right_half_plane_zero_says_by_how_much():
    plant = flexible_link("A")
    Specification(bandwidth_rad_s=3.0, modulus_margin=0.5).check_against([plant])
    spec = Specification(bandwidth_rad_s=12.0, modulus_margin=0.5)
    with pytest.raises(SpecificationError, match=r"non-minimum-phase zero at 10.8.* = 12, at most 4.08"):
        spec.check_against([plant])
    # By hand: (m z + wb)/(z + wb r) = 1 at z = 10.8 gives wb = z (1 - m)/(1 - r), bandwidth = wb/sqrt(2 -
    # m^2).
    by_hand = 10.8 * 0.5 / 0.999 / np.sqrt(1.75)
    assert by_hand == pytest.approx(4.08, abs=0.01)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"bandwidth_rad_s": 700.0}, r"bandwidth_rad_s = 700 .*Nyquist.* 628\.3"),
        ({"bandwidth_rad_s": 400.0}, "'arm'.*delay.*bandwidth_rad_s = 400"),
        ({"bandwidth_rad_s": 3.0, "effort_limit": 0.01}, r"'arm'.*\|K S\|.*0\.01"),
        ({"mode_peak_ratio": 0.5, "mode_band_rad_s": (700.0, 800.0)}, r"mode_band_rad_s.*700 .*628\.3"),
        (
            {"mode_peak_ratio": 0.5, "mode_band_rad_s": (1e-4, 20.0)},
            "mode_band_rad_s.*0.0001.*'arm' integrates",
        ),
    ],
)
def test_contradictions_with_the_plant(fields, message):
    with pytest.raises(SpecificationError, match=message) as caught:
        Specification(**fields).check_against([UncertainPlant(hub_arm(), name="arm")])
    assert "\n" not in str(caught.value)


def test_integrator_against_a_zero_at_one_and_damping_without_mode():
    plant = UncertainPlant(tip_acceleration(), name="acceleration")
    with pytest.raises(SpecificationError, match="zero at z = 1"):
        Specification(integrator=True).check_against([plant])
    lag = UncertainPlant(control.ss(0.9, 0.1, 1, 0, 0.01), name="lag")
    with pytest.raises(SpecificationError, match="no lightly damped mode"):
        Specification(mode_peak_ratio=0.5).check_against([lag])
    with pytest.raises(SpecificationError, match="no plant"):
        Specification().check_against([])


@pytest.mark.parametrize(
    "fields",
    [
        {"bandwidth_rad_s": -1.0},
        {"bandwidth_rad_s": float("nan")},
        {"effort_rolloff_rad_s": 10.0},
        {"mode_band_rad_s": (2.0, 1.0), "mode_peak_ratio": 0.5},
        {"mode_band_rad_s": (1.0, 2.0)},
        {"structure": "pid", "controller_order": 5},
        {"unknown": 1},
        {
            "bandwidth_rad_s": 1.0,
            "sensitivity_weight": RationalWeight(numerator=(1.0,), denominator=(1.0, 1.0)),
        },
    ],
)
def test_fields_that_do_not_fit_are_refused(fields):
    with pytest.raises(ValueError):
        Specification(**fields)


@pytest.mark.parametrize(
    ("numerator", "denominator", "message"),
    [
        ((1.0, 0.0, 0.0), (1.0, 1.0), "improper"),
        ((1.0,), (1.0, -2.0), "unstable"),
        ((1.0,), (0.0, 1.0), "non-zero"),
    ],
)
def test_weights_must_be_stable_and_proper(numerator, denominator, message):
    with pytest.raises(ValueError, match=message):
        RationalWeight(numerator=numerator, denominator=denominator)


@pytest.mark.parametrize("slow_poles", [(), (0.0,), (0.0, 0.0), (0.0, 0.2, 7.0)])
def test_weights_are_the_formulas_of_their_words(slow_poles):
    s = 1j * np.geomspace(1e-3, 1e4, 60)
    spec = Specification(
        bandwidth_rad_s=3.0, integrator=True, modulus_margin=0.4, effort_limit=5.0, effort_rolloff_rad_s=40.0
    )
    poles = np.exp(-0.05 * np.array([*slow_poles, 100.0]))
    plant = UncertainPlant(control.ss(control.zpk([], poles, 1.0, 0.05)), name="arm")
    corner = 3.0 * np.sqrt(2 - 0.4**2)
    expected = (0.4 * s + corner) / s
    for pole in slow_poles:  # 7 rad/s lies above a fifth of the corner
        expected = expected * ((s + corner / 5) / (s + pole) if pole < corner / 5 else 1.0)
    np.testing.assert_allclose(spec.tracking_weight(plant).at(s), expected, rtol=1e-6)
    limit = spec.limit_weight()
    np.testing.assert_allclose(limit.at(s), (s / 40 + 1) / (s / 1600 + 1) / 5.0, rtol=1e-12)
    # Without an integrator of its own the controller is not asked for integral action.
    plain = Specification(bandwidth_rad_s=3.0, modulus_margin=0.4, low_frequency_rejection=0.01)
    expected = (0.4 * s + corner) / (s + corner * 0.01)
    np.testing.assert_allclose(plain.tracking_weight(plant).at(s), expected, rtol=1e-12)
