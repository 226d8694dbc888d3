"""Arms for comparisons: the paper's simulation example, and two links linearised at an operating point."""

from __future__ import annotations

import control
import numpy as np
import numpy.typing as npt

from plant.beam import clamped_free_modes
from plant.presets import two_link_arm
from plant.rig import Hub, Link

Real = npt.NDArray[np.float64]

# The paper, below its eq. (32).
_EXAMPLE_ZEROS_RAD_S = (10.8, -10.5)
# The example's flexible pole is not printed; this is where the identification benchmark puts it.
_EXAMPLE_POLE_RAD_S = 15.0
# Length over inertia of an arm with such zeros: 1 m long and as wide as the paper's, but 0.77 mm thick.
_EXAMPLE_GAIN = 217.863


def paper_example() -> control.TransferFunction:
    """The paper's simulation example, eq. (32) with n = 1: hub torque [N m] to tip position [m], continuous
    time.

    Two poles at the origin, a lightly damped pair at 15 rad/s and real zeros at +10.8 and -10.5 rad/s. With
    one assumed mode (clamped root, unit modal mass, frequency w, tip value p, coupling b)

        tip / torque = ((L - b p) s^2 + L kappa w^2 s + L w^2) / (s^2 ((I - b^2) s^2 + I kappa w^2 s + I
        w^2)),

    so the asymmetry of the zeros is the structural damping kappa, and gives the pair a damping ratio of 0.02.
    """
    right, left = _EXAMPLE_ZEROS_RAD_S
    square, kappa, constant = np.polymul([-1 / right, 1.0], [-1 / left, 1.0])
    return control.tf(
        _EXAMPLE_GAIN * np.array([square, kappa, constant]),
        [1 / _EXAMPLE_POLE_RAD_S**2, kappa, constant, 0.0, 0.0],
        inputs=["hub_torque_Nm"],
        outputs=["tip_m"],
        name="paper_example",
    )


def two_link_matrices(
    links: tuple[Link, Link],
    hubs: tuple[Hub, Hub],
    elbow_mass_kg: float,
    payload_kg: float,
    elbow_angle_rad: float,
    n_modes: int,
) -> tuple[Real, Real, Real, Real]:
    """Mass, damping, stiffness (N, N) and tip row (N,) in (theta_1, theta_2, q_1.., q_2..) of two links in a
    horizontal plane, linearised at an elbow angle phi.

    Link 1 turns about the shoulder by theta_1 and bends by w_1; at its tip sits the elbow motor, which turns
    link 2 by phi plus theta_2. To first order the elbow moves by d = L1 theta_1 + w_1(L1) across link 1, link
    2 turns by psi = theta_1 + w_1'(L1) + theta_2, and its point x moves by

        d n1 + (x psi + w_2) n2,        n1 . n2 = cos(phi),

    n1 and n2 across the links. Energies and motors as in `plant.modal`. Coriolis and centrifugal forces are
    of second order and neglected. The tip row is the displacement of the tip across link 2. Hub radii must
    be zero. Link 1 bends in its modes with a clamped shoulder, elbow, link 2 and payload a point mass at the
    tip, and as under a moment at the tip, (x/L)^2, which those modes lack and link 2 exerts; so N = 3 + 2
    n_modes with that shape last of q_1.

    Raises ValueError if a hub has a radius, a mass is negative, the angle is not finite or n_modes < 1.
    """
    if any(hub.radius_m != 0 for hub in hubs):
        raise ValueError("both hub radii must be zero")
    if not (elbow_mass_kg >= 0 and payload_kg >= 0 and abs(elbow_angle_rad) < np.inf):
        raise ValueError(
            f"need masses >= 0 and a finite angle; got {elbow_mass_kg}, {payload_kg}, {elbow_angle_rad}"
        )
    far_mass = links[1].mass_per_length_kg_m * links[1].length_m + payload_kg
    unit = np.eye(3 + 2 * n_modes)
    theta_1 = unit[0]
    theta_2 = unit[1]
    q_1 = unit[2 : 3 + n_modes]
    q_2 = unit[3 + n_modes :]
    across_1, bent, weights_1, spring_1 = _bending(links[0], n_modes, elbow_mass_kg + far_mass, theta_1, q_1)
    elbow = across_1[-1]
    psi = theta_1 + bent + theta_2
    across_2, _, weights_2, spring_2 = _bending(links[1], n_modes, payload_kg, psi, q_2)
    weights_2[-1] = payload_kg
    mass = across_1.T @ (weights_1[:, None] * across_1) + across_2.T @ (weights_2[:, None] * across_2)
    mass += (elbow_mass_kg + far_mass) * np.outer(elbow, elbow)
    turned = np.cos(elbow_angle_rad) * np.outer(elbow, weights_2 @ across_2)
    mass += turned + turned.T
    damping = links[0].kelvin_voigt_s * spring_1 + links[1].kelvin_voigt_s * spring_2
    # Hubs: the first turns with the shoulder, the second with the root of link 2.
    for hub, joint, turn in zip(hubs, (theta_1, theta_2), (theta_1, psi), strict=True):
        mass += hub.inertia_kg_m2 * np.outer(turn, turn)
        damping += hub.viscous_friction_Nms * np.outer(joint, joint)
    return mass, damping, spring_1 + spring_2, np.cos(elbow_angle_rad) * elbow + across_2[-1]


def _bending(
    link: Link, n_modes: int, tip_mass_kg: float, turn: Real, q: Real
) -> tuple[Real, Real, Real, Real]:
    """Displacement (X, N) across a link that turns by `turn` (N,) and bends in the coordinates q, slope (N,)
    of the bent tip, mass (X,) at the points, stiffness (N, N).

    Points are the nodes of a quadrature and, without mass, the tip. q (n_modes, N), or one more: (x/L)^2.
    """
    length = link.length_m
    ei = link.bending_stiffness_Nm2
    modes = clamped_free_modes(ei, link.mass_per_length_kg_m, length, n_modes, tip_mass_kg)
    # The highest mode has about n_modes / 2 waves along the link; 8 nodes a mode integrate its square to
    # rounding.
    nodes, weights = np.polynomial.legendre.leggauss(8 * n_modes + 16)
    x = np.append(0.5 * length * (nodes + 1), length)
    area = np.append(0.5 * length * weights, 0.0)
    bent: list[Real] = [modes.shape(x), modes.slope(x), modes.curvature(x)]
    if q.shape[0] > n_modes:
        # A parabola beside the modes, with its slope and its curvature.
        parabola = (x / length) ** 2, 2 * x / length**2, np.full(x.size, 2 / length**2)
        bent = [np.column_stack(pair) for pair in zip(bent, parabola, strict=True)]
    shape, slope, curvature = (each @ q for each in bent)
    spring = ei * curvature.T @ (area[:, None] * curvature)
    return np.outer(x, turn) + shape, slope[-1], link.mass_per_length_kg_m * area, spring


def two_link_operating_point(elbow_angle_rad: float = np.pi / 3, n_modes: int = 2) -> control.StateSpace:
    """Two aluminium links with motors of our choosing, as a continuous-time python-control model.

    Inputs shoulder_voltage_V, elbow_voltage_V; outputs shoulder_angle_rad, elbow_angle_rad (change from the
    operating angle) and tip_m (across link 2). Values of `plant.two_link_arm`.
    """
    arm = two_link_arm()
    motors = arm.motors
    mass, damping, stiffness, tip = two_link_matrices(
        arm.links, arm.hubs, arm.elbow_mass_kg, arm.payload_kg, elbow_angle_rad, n_modes
    )
    n = mass.shape[0]
    joints = np.eye(n)[:2]
    zero = np.zeros((n, n))
    damping[:2, :2] += np.diag([motor.back_emf_damping_Nms for motor in motors])
    drive = joints.T * [motor.torque_per_volt_Nm_V for motor in motors]
    return control.ss(
        np.block([[zero, np.eye(n)], [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)]]),
        np.vstack([np.zeros((n, 2)), np.linalg.solve(mass, drive)]),
        np.hstack([np.vstack([joints, tip]), np.zeros((3, n))]),
        np.zeros((3, 2)),
        inputs=["shoulder_voltage_V", "elbow_voltage_V"],
        outputs=["shoulder_angle_rad", "elbow_angle_rad", "tip_m"],
        name="two_link_arm",
    )
