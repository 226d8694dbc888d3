"""The nonlinear two-link arm against an independent linearisation, conserved energy and momentum."""

import casadi as ca
import numpy as np
import pytest

from plant import TwoLinkArm, TwoLinkMachine, two_link_arm
from plant.rig import Hub, Motor
from validation.example_arms import two_link_operating_point


@pytest.mark.parametrize("elbow_rad", [-0.4, 0.5, 2.1])
def test_around_rest_it_is_the_linear_arm_of_another_derivation(elbow_rad):
    a, b = two_link_arm().linear(elbow_rad)
    other = two_link_operating_point(elbow_rad, n_modes=1)
    np.testing.assert_allclose(a, other.A, rtol=1e-7, atol=1e-6 * np.abs(other.A).max(axis=1).mean() * 1e-6)
    np.testing.assert_allclose(b, other.B, rtol=1e-7, atol=1e-9)


def _without_losses(**changes) -> TwoLinkArm:
    arm = two_link_arm(0.1)
    free = Motor(torque_constant_Nm_A=0.03, back_emf_Vs_rad=0.0, resistance_ohm=1.0, gear_ratio=30.0)
    hubs = tuple(Hub(inertia_kg_m2=h.inertia_kg_m2, radius_m=0.0, viscous_friction_Nms=0.0) for h in arm.hubs)
    links = tuple(link.model_copy(update={"kelvin_voigt_s": 0.0}) for link in arm.links)
    return TwoLinkArm(links, hubs, (free, free), 0.25, 0.1, **changes)


@pytest.mark.slow
def test_without_losses_the_shoulder_keeps_its_angular_momentum():
    """No torque acts about the shoulder's axis, whatever link 2 and the bending do: dL/dt = 0, with L the
    derivative of the kinetic energy by a common turn. A point-mass sum over both links stands for L."""
    arm = _without_losses()
    rng = np.random.default_rng(2)
    n = arm.coordinates
    x = np.concatenate([[0.3, 0.9], np.zeros(n - 2), [0.5, -2.0], 0.2 * rng.standard_normal(n - 2)])
    sample = arm.sampled(1e-4)
    momenta = []
    for _ in range(150):
        momenta.append(_momentum(arm, x))
        x = np.asarray(sample(x, np.zeros(2)).full())[:, 0]
    assert abs(x[1] - 0.9) > 0.02  # it has moved
    assert np.ptp(momenta) < 1e-5 * np.abs(momenta).mean()


def _momentum(arm: TwoLinkArm, x) -> float:
    """Sum of m (r x v) over points of both links, elbow and payload, and of hub inertia times turn rate."""
    n = arm.coordinates
    first, second = arm.bending
    q, v = x[:n], x[n:]
    split = 2 + first.at_tip.size

    def places(q):
        from plant.two_link import clamped_free_modes

        found, masses = [], []
        turn = np.array([q[0], 0.0])
        turn[1] = q[0] + first.slope_at_tip @ q[2:split] + q[1]
        root = np.zeros(2)
        for k, (link, a) in enumerate(zip(arm.links, (q[2:split], q[split:]), strict=True)):
            e = np.array([np.cos(turn[k]), np.sin(turn[k])])
            across = np.array([-e[1], e[0]])
            tip = (
                arm.payload_kg
                if k
                else arm.elbow_mass_kg
                + (arm.links[1].mass_per_length_kg_m * arm.links[1].length_m + arm.payload_kg)
            )
            modes = clamped_free_modes(
                link.bending_stiffness_Nm2, link.mass_per_length_kg_m, link.length_m, arm.n_modes, tip
            )
            nodes, weights = np.polynomial.legendre.leggauss(40)
            s = 0.5 * link.length_m * (nodes + 1)
            shapes = modes.shape(s)
            if k == 0:
                shapes = np.column_stack([shapes, (s / link.length_m) ** 2])
            found += list(root + s[:, None] * e + (shapes @ a)[:, None] * across)
            masses += list(0.5 * link.length_m * weights * link.mass_per_length_kg_m)
            at_tip = (first, second)[k].at_tip
            root = root + link.length_m * e + (at_tip @ a) * across
            found.append(root)
            masses.append(arm.payload_kg if k else arm.elbow_mass_kg)
        return np.array(found), np.array(masses), turn

    h = 1e-6
    here, masses, _ = places(q)
    ahead, _, turned = places(q + h * v)
    behind, _, before = places(q - h * v)
    speed = (ahead - behind) / (2 * h)
    rates = (turned - before) / (2 * h)
    hubs = sum(hub.inertia_kg_m2 * rate for hub, rate in zip(arm.hubs, rates, strict=True))
    return float(np.sum(masses * (here[:, 0] * speed[:, 1] - here[:, 1] * speed[:, 0])) + hubs)


def test_gravity_is_held_and_dry_friction_brakes():
    heavy = two_link_arm(0.2, gravity_m_s2=9.81)
    machine = TwoLinkMachine(heavy, (0.3, 0.5), 0.002, 0.0, np.random.default_rng(0))
    assert np.max(np.abs(machine.run(np.zeros((300, 2))))) < 1e-9
    weight = heavy.rest((0.3, 0.5))[1]
    assert np.all(weight > 0.1)  # both motors hold something up
    push = np.tile([0.5, 0.5], (400, 1))
    free, braked = (
        TwoLinkMachine(two_link_arm(coulomb_Nm=c), (0.0, 1.0), 0.002, 0.0, np.random.default_rng(0)).run(push)
        for c in ((0.0, 0.0), (0.2, 0.05))
    )
    torque = np.array([m.torque_per_volt_Nm_V for m in heavy.motors]) * 0.5
    share = braked[-1] / free[-1]
    np.testing.assert_allclose(share, 1 - np.array([0.2, 0.05]) / torque, atol=0.06)


def test_parts_that_do_not_fit_are_refused():
    arm = two_link_arm()
    with pytest.raises(ValueError, match=r"-0\.1"):
        TwoLinkArm(arm.links, arm.hubs, arm.motors, payload_kg=-0.1)
    wide = arm.hubs[0].model_copy(update={"radius_m": 0.1})
    with pytest.raises(ValueError, match="radi"):
        TwoLinkArm(arm.links, (wide, arm.hubs[1]), arm.motors)
    assert isinstance(arm.sampled(0.002), ca.Function)
