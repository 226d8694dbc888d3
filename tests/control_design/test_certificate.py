"""The certificate: honest about instability, exact against sampled plants, clear about its limits."""

from functools import cache

import control
import numpy as np
import pytest

from control_design import LoopFunction, PlantChannel, Specification, UncertainPlant, certify
from validation.example_plants import ResponseRecord

from .plants import RelativeDisc, gain, hub_arm, tip_acceleration, uncertain_hub

_DT = 0.005


def test_a_gentle_gain_on_the_hub_is_certified_and_says_what_it_checked():
    spec = Specification(modulus_margin=0.5, bandwidth_rad_s=0.5, low_frequency_rejection=0.01)
    certificate = certify(gain(0.3), [uncertain_hub(0.02)], spec)
    assert certificate.certified, certificate.items
    (verdict,) = certificate.plants
    assert verdict.stable
    assert verdict.nyquist.matches
    assert verdict.nyquist.half_turns == pytest.approx(0.5, abs=1e-6)
    closed = control.feedback(control.series(hub_arm(), control.ss(0, 1, 0.3, 0, _DT)), 1)
    assert verdict.pole_radius == pytest.approx(np.max(np.abs(closed.poles())), rel=1e-9)
    light = min(verdict.closed_loop_modes, key=lambda m: m.zeta)
    assert light.omega_rad_s == pytest.approx(16, rel=0.05)
    assert not verdict.all_frequencies.possible
    # The worst case is worse than the nominal one in every margin.
    nominal, worst = verdict.nominal_margins, verdict.worst_margins
    assert worst.modulus < nominal.modulus
    assert worst.gain_up < nominal.gain_up
    assert worst.phase_rad < nominal.phase_rad
    assert worst.delay_s < nominal.delay_s


def test_worst_sensitivity_bounds_every_sampled_plant_and_is_reached():
    """Members drawn on the ellipses' boundary: max|S| never above, and within 0.1 % of, the certificate."""
    plant, k = uncertain_hub(0.05), 0.3
    certificate = certify(gain(k), [plant], Specification())
    verdict = certificate.plants[0]
    omega = np.unique(
        np.append(np.geomspace(1e-2, plant.nyquist_rad_s, 4000), verdict.worst_margin_omega_rad_s)
    )
    e = plant.at(omega)
    loop = k * np.exp(-1j * omega * _DT)
    worst = max(
        np.max(1 / np.abs(1 + loop * e.points(np.cos(f), np.sin(f)))) for f in np.linspace(0, 2 * np.pi, 721)
    )
    assert worst <= verdict.worst_peak_sensitivity * (1 + 1e-9)
    assert worst >= verdict.worst_peak_sensitivity * 0.999


def test_every_requirement_is_listed_with_its_number():
    plant = UncertainPlant(
        hub_arm(),
        name="arm",
        uncertainty=RelativeDisc(hub_arm(), 0.02, 60.0),
        performance=PlantChannel(tip_acceleration(), RelativeDisc(tip_acceleration(), 0.02, 60.0)),
    )
    spec = Specification(
        bandwidth_rad_s=2.0, integrator=True, modulus_margin=0.6, effort_limit=10.0, mode_peak_ratio=0.2,
        delay_margin_s=0.01,
    )  # fmt: skip
    certificate = certify(gain(0.3), [plant], spec)
    met = {item.requirement.split(",")[0]: item.met for item in certificate.items}
    assert met == {
        "modulus margin": True, "tracking": False, "effort": True, "damping of the mode": False,
        "delay margin": True, "integrators in the controller": False,
    }  # fmt: skip
    assert not certificate.certified
    assert certificate.plants[0].own_performance


def test_damping_number_is_the_sampled_worst_case_of_the_measured_output():
    plant, spec = uncertain_hub(0.05), Specification(mode_peak_ratio=0.5)
    certificate = certify(gain(0.3), [plant], spec)
    (item,) = [i for i in certificate.items if i.requirement.startswith("damping")]
    (asked,) = [each for each in spec.weighted(plant) if each.function is LoopFunction.DISTURBANCE]
    low, high = asked.band
    omega = np.unique(np.append(np.linspace(low, high, 4001), item.omega_rad_s))
    e = plant.at(omega)
    loop = 0.3 * np.exp(-1j * omega * _DT)
    w4 = asked.weight.numerator[0]
    worst = 0.0
    for f in np.linspace(0, 2 * np.pi, 721):
        g = e.points(np.cos(f), np.sin(f))
        worst = max(worst, float(np.max(w4 * np.abs(g / (1 + loop * g)))))
    assert worst <= item.achieved * (1 + 1e-9)
    assert worst >= item.achieved * 0.999


@pytest.mark.parametrize("ratio", [1.0, 4.0, pytest.param(1.5, marks=pytest.mark.long)])
def test_a_mode_may_be_raised_by_as_much_as_is_allowed(ratio):
    """The weighted peak falls as the allowance grows: |Gp S| itself does not depend on it."""
    raised = damping_of_a_mode(ratio)
    assert raised.achieved * ratio == pytest.approx(0.5 * damping_of_a_mode(0.5).achieved, rel=1e-6)
    assert raised.met == (raised.achieved <= 1)


@cache
def damping_of_a_mode(asked_ratio):
    """What a certificate says of the mode of a hub whose peak may be raised by a ratio."""
    specification = Specification(mode_peak_ratio=asked_ratio)
    certificate = certify(gain(0.3), [uncertain_hub(0.05)], specification)
    (item,) = [item for item in certificate.items if item.requirement.startswith("damping")]
    return item


def test_uncertainty_on_its_own_grid_is_named():
    own = np.geomspace(0.5, 200.0, 800)
    record: ResponseRecord = RelativeDisc(hub_arm(), 0.02, 60.0).at(own, 0.95)
    certificate = certify(
        gain(0.3), [UncertainPlant(hub_arm(), name="frf", uncertainty=record)], Specification()
    )
    assert certificate.plants[0].own_grid_rad_s == (0.5, 200.0)
    assert certificate.certified


def test_no_uncertainty_is_said_and_mismatches_are_refused():
    bare = UncertainPlant(hub_arm(), name="bare")
    certificate = certify(gain(0.3), [bare], Specification())
    assert not certificate.plants[0].stated
    with pytest.raises(ValueError, match="0 samples of computational delay"):
        certify(gain(0.3, delay=0), [bare], Specification())
    with pytest.raises(ValueError, match="at least one plant"):
        certify(gain(0.3), [], Specification())
    slow = UncertainPlant(hub_arm(0.01), name="slow")
    with pytest.raises(ValueError, match="differ in dt_s"):
        certify(gain(0.3), [slow], Specification())


def test_mode_damping_is_that_of_python_controls_closed_loop():
    plant, controller = uncertain_hub(0.02), gain(1.0)
    loop = control.feedback(plant.nominal * controller.to_control(include_delay=True), 1)
    omega, zeta, _ = control.damp(loop, doprint=False)
    band = (5.0, 60.0)
    inside = zeta[(omega >= band[0]) & (omega <= band[1])]
    for asked, met in ((0.9 * inside.min(), True), (1.1 * inside.min(), False)):
        specification = Specification(modulus_margin=0.1, mode_damping=asked, mode_band_rad_s=band)
        certificate = certify(controller, [plant], specification)
        (item,) = [item for item in certificate.items if item.requirement.startswith("damping ratio")]
        assert item.achieved == pytest.approx(inside.min(), rel=1e-6)
        assert item.met is met
        assert certificate.certified is met
