"""Dry friction at rest and at its edges, where a law that is almost right shows."""

import numpy as np
import pytest

from plant import SampledArm, paper_link, parse_effect, prbs, simulate
from plant.modal import link_modes

RIG = paper_link()
LEVEL = 0.3
COULOMB = parse_effect({"name": "coulomb_friction", "torque_Nm": LEVEL})
_FALLING = {"static_torque_Nm": LEVEL, "coulomb_torque_Nm": 0.2, "stribeck_velocity_rad_s": 0.05}
STRIBECK = parse_effect({"name": "stribeck_friction", **_FALLING})
STALL = RIG.motor.torque_per_volt_Nm_V


@pytest.mark.parametrize("friction", [COULOMB, STRIBECK], ids=["coulomb", "stribeck"])
@pytest.mark.parametrize("fraction", [0.5, -0.9, 0.99])
def test_a_constant_torque_below_break_away_is_held_without_drift(friction, fraction):
    # Ramped up over a second, so that the elastic pre-sliding does not overshoot; then held for a minute.
    voltage = fraction * LEVEL / STALL * np.minimum(np.arange(12200) / 200, 1.0)
    angle = simulate(RIG, voltage, [friction]).hub_angle_rad
    expected = fraction * 1e-5  # the spring of 10 microradian at this fraction of its limit
    np.testing.assert_allclose(angle[-12000 + 2000 :], expected, rtol=1e-6)
    assert np.ptp(angle[3000:]) < 1e-12


@pytest.mark.parametrize("friction", [COULOMB, STRIBECK], ids=["coulomb", "stribeck"])
def test_a_torque_above_break_away_moves_the_arm(friction):
    voltage = 1.05 * LEVEL / STALL * np.minimum(np.arange(1200) / 200, 1.0)
    assert simulate(RIG, voltage, [friction]).hub_angle_rad[-1] > 1e-3


@pytest.mark.parametrize(
    ("friction", "level"), [(COULOMB, LEVEL), (STRIBECK, 0.2)], ids=["coulomb", "stribeck"]
)
def test_steady_speed_is_what_is_left_of_the_torque(friction, level):
    volts = 3.0
    brake = RIG.hub.viscous_friction_Nms + RIG.motor.back_emf_damping_Nms
    angle = simulate(RIG, np.full(4000, volts), [friction]).hub_angle_rad
    speed = (angle[-1] - angle[-201]) / (200 * RIG.sampling.dt_s)
    # Stribeck's is Coulomb's at speed: exp(-2.8 / 0.05) is nothing.
    assert speed == pytest.approx((volts * STALL - level) / brake, rel=1e-9)


def test_stribeck_friction_without_a_fall_is_coulomb_friction():
    voltage = prbs(7, 5, 1.5, 600)
    same = STRIBECK.model_copy(update={"coulomb_torque_Nm": LEVEL})
    runs = [simulate(RIG, voltage, [friction]).output for friction in (same, COULOMB)]
    np.testing.assert_array_equal(*runs)


def test_after_a_push_the_arm_comes_to_rest_and_stays():
    voltage = np.zeros(6000)
    voltage[:40] = 4.0
    trajectory = simulate(RIG, voltage, [COULOMB])
    rest = trajectory.hub_angle_rad[-400:]
    assert np.ptp(rest) < 1e-10
    # Held somewhere within the elastic pre-sliding, the link straight again.
    np.testing.assert_allclose(trajectory.tip_m[-1], 1.04 * rest[-1], atol=1e-9)


def test_with_the_hub_stuck_the_link_rings_as_if_clamped():
    voltage = np.zeros(1600)
    voltage[:20] = 4.0
    trajectory = simulate(RIG, voltage, [COULOMB])
    ringing = (trajectory.tip_m - 1.04 * trajectory.hub_angle_rad)[600:]
    # A sampled decaying sine obeys a recursion of two coefficients; they give its pole.
    rows = np.column_stack([ringing[1:-1], ringing[:-2]])
    one, two = np.linalg.lstsq(rows, ringing[2:])[0]
    pole = np.log(np.roots([1, -one, -two])[0]) / RIG.sampling.dt_s
    clamped = link_modes(RIG, 1).omega_rad_s[0]
    zeta = RIG.link.kelvin_voigt_s * clamped / 2
    # The hub gives by 10 microradian for 0.3 N m: 3e4 N m/rad against 3 EI / L of the link, 27, so 1e-3 at
    # the most.
    assert abs(pole.imag) == pytest.approx(clamped * np.sqrt(1 - zeta**2), rel=1e-3)
    assert -pole.real == pytest.approx(zeta * clamped, rel=5e-3)


def test_stick_survives_closed_loop_stepping():
    arm = SampledArm(RIG, [COULOMB])
    for k in range(2000):
        arm.advance(0.8 * LEVEL / STALL * min(k / 200, 1.0))
    assert arm.true_output[0] == pytest.approx(0.8e-5, rel=1e-6)
