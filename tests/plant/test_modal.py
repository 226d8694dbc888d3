import numpy as np
import pytest

from plant import linear_arm, paper_link
from plant.modal import default_n_modes, link_inertia_kg_m2, link_modes

RIG = paper_link().perturbed({"payload.mass_kg": 0.04})
OMEGA = np.geomspace(0.3, 400, 60)


def _response(arm, omega=OMEGA):
    """(F, outputs, inputs)."""
    return np.moveaxis(arm(1j * omega), -1, 0)


def _exact_response(rig, omega):
    """(F, 2, 2) from (hub torque, tip force) to (theta, y(L)): the beam equation solved at each frequency.

    EI (1 + j omega kappa) y'''' = m omega^2 y with y = rigid rotation plus deflection, no expansion in modes.
    """
    link, hub, motor = rig.link, rig.hub, rig.motor
    m = link.density_kg_m3 * link.width_m * link.thickness_m
    length, r = link.length_m, hub.radius_m
    stall = motor.gear_ratio * motor.torque_constant_Nm_A / motor.resistance_ohm
    brake = hub.viscous_friction_Nms + stall * motor.gear_ratio * motor.back_emf_Vs_rad
    out = []
    for w in omega:
        ei = (
            link.youngs_modulus_Pa
            * link.width_m
            * link.thickness_m**3
            / 12
            * (1 + 1j * w * link.kelvin_voigt_s)
        )
        beta = (m * w**2 / ei) ** 0.25
        # y = sum of exponentials exp(s x), s = beta, -beta, j beta, -j beta; one more unknown: theta.
        s = beta * np.array([1, -1, 1j, -1j])
        end = np.exp(s * length)
        equations = np.zeros((5, 5), dtype=complex)
        equations[0] = [*np.ones(4), -r]  # y(0) = r theta
        equations[1] = [*s, -1]  # y'(0) = theta
        equations[2] = [*(s**2 * end), 0]
        equations[3] = [*((ei * s**3 + rig.payload.mass_kg * w**2) * end), 0]  # = -tip force
        equations[4] = [*(-ei * (s**2 - r * s**3)), -hub.inertia_kg_m2 * w**2 + 1j * w * brake]  # = torque
        solution = np.linalg.solve(equations, np.array([[0, 0, 0, 0, 1], [0, 0, 0, -1, 0]], dtype=complex).T)
        out.append([solution[4], end @ solution[:4]])
    return np.array(out)


def test_response_is_that_of_the_beam_equation():
    exact = _exact_response(RIG, OMEGA)
    # Up to 64 Hz, notches included; measured 2.7e-2, 3.7e-4 and 2.7e-8, largest for a force at the tip.
    for n_modes, tolerance in ((3, 5e-2), (6, 1e-3), (40, 1e-7)):
        response = _response(linear_arm(RIG, n_modes))[:, :, 1:]
        assert np.max(np.abs(response - exact) / np.abs(exact)) < tolerance


def test_the_motor_is_a_torque_and_a_brake():
    arm = linear_arm(RIG)
    response = _response(arm)
    np.testing.assert_allclose(
        response[:, :, 0], RIG.motor.torque_per_volt_Nm_V * response[:, :, 1], rtol=1e-12
    )
    # At constant voltage the arm runs at the speed where back-EMF and friction balance the torque.
    motor, b = RIG.motor, RIG.hub.viscous_friction_Nms
    stall = motor.gear_ratio * motor.torque_constant_Nm_A / motor.resistance_ohm
    speed = stall / (b + stall * motor.gear_ratio * motor.back_emf_Vs_rad)
    slow = np.array([1e-4])
    assert abs(1j * slow * _response(arm, slow)[:, 0, 0])[0] == pytest.approx(speed, rel=1e-6)


def test_forces_and_displacements_are_reciprocal():
    response = _response(linear_arm(RIG))
    np.testing.assert_allclose(response[:, 1, 1], response[:, 0, 2], rtol=1e-8)


def test_the_modes_together_carry_the_whole_link():
    rig = RIG.perturbed({"hub.radius_m": 0.0})
    coupling = link_modes(rig, 60).coupling
    # Completeness: sum b_i^2 is the inertia of link and payload; with r = 0 the remainder falls like n^-3.
    assert np.sum(coupling**2) == pytest.approx(link_inertia_kg_m2(rig), rel=1e-5)


def test_default_modes_reach_nyquist():
    rig = paper_link()
    assert default_n_modes(rig) == 3
    fast = rig.perturbed({"sampling.dt_s": 0.001})
    n = default_n_modes(fast)
    omega = link_modes(fast, n + 1).omega_rad_s
    assert omega[n - 1] < np.pi / 0.001 < omega[n]


def test_poles_are_stable_and_one_is_the_angle():
    poles = np.sort_complex(linear_arm(RIG).poles())
    assert abs(poles[-1]) < 1e-9
    assert np.all(poles[:-1].real < 0)
