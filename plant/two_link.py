"""Two flexible links in a horizontal plane, linearised at an operating point.

Link 1 turns about the shoulder by theta_1 and bends by w_1; at its tip sits the elbow motor, which turns
link 2 by the operating angle phi plus theta_2. To first order the elbow moves by d = L1 theta_1 + w_1(L1)
across link 1, link 2 turns by psi = theta_1 + w_1'(L1) + theta_2, and its point x moves by

    d n1 + (x psi + w_2) n2,        n1 . n2 = cos(phi),

n1 and n2 across the links. Energies and motors as in `plant.modal`. At rest nothing is neglected by
linearising but terms of second order; Coriolis and centrifugal forces are of second order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from plant.beam import clamped_free_modes
from plant.rig import Hub, Link, Motor

if TYPE_CHECKING:
    import control

Real = npt.NDArray[np.float64]


def two_link_matrices(
    links: tuple[Link, Link],
    hubs: tuple[Hub, Hub],
    elbow_mass_kg: float,
    payload_kg: float,
    elbow_angle_rad: float,
    n_modes: int,
) -> tuple[Real, Real, Real, Real]:
    """Mass, damping, stiffness (N, N) and tip row (N,) in (theta_1, theta_2, q_1.., q_2..), N = 2 + 2
    n_modes.

    The tip row is the displacement of the tip across link 2. Hub radii must be zero. Link 1 bends in its
    modes with a clamped shoulder, elbow, link 2 and payload a point mass at the tip, and as under a moment
    at the tip, which those modes lack and link 2 exerts; so N = 3 + 2 n_modes with that shape last of q_1.

    Raises
    ------
    ValueError
        If a hub has a radius, a mass is negative, the angle is not finite or n_modes < 1.
    """
    if any(hub.radius_m != 0 for hub in hubs):
        raise ValueError("both hub radii must be zero")
    if not (elbow_mass_kg >= 0 and payload_kg >= 0 and abs(elbow_angle_rad) < np.inf):
        raise ValueError(
            f"need masses >= 0 and a finite angle; got {elbow_mass_kg}, {payload_kg}, {elbow_angle_rad}"
        )
    first, second = links
    m1, m2 = first.mass_per_length_kg_m, second.mass_per_length_kg_m
    far_mass = m2 * second.length_m + payload_kg
    carried = elbow_mass_kg + far_mass
    bending_1 = _bending(first, n_modes, carried, moment=True)
    bending_2 = _bending(second, n_modes, payload_kg, moment=False)

    n_1 = n_modes + 1
    n = 2 + n_1 + n_modes
    theta_1, theta_2 = np.eye(n)[:2]
    q_1, q_2 = np.eye(n)[2 : 2 + n_1], np.eye(n)[2 + n_1 :]
    elbow = first.length_m * theta_1 + bending_1.tip @ q_1
    psi = theta_1 + bending_1.tip_slope @ q_1 + theta_2

    # Link 1 with all it carries as a point mass at its tip.
    inertia_1 = m1 * first.length_m**3 / 3 + carried * first.length_m**2
    coupling_1 = bending_1.coupling @ q_1
    mass = inertia_1 * np.outer(theta_1, theta_1) + q_1.T @ bending_1.mass @ q_1
    mass += np.outer(theta_1, coupling_1) + np.outer(coupling_1, theta_1)
    # Link 2 about the elbow, and its first moment against the motion of the elbow.
    inertia_2 = m2 * second.length_m**3 / 3 + payload_kg * second.length_m**2
    coupling_2 = bending_2.coupling @ q_2
    mass += inertia_2 * np.outer(psi, psi) + q_2.T @ bending_2.mass @ q_2
    mass += np.outer(psi, coupling_2) + np.outer(coupling_2, psi)
    moment_2 = (m2 * second.length_m**2 / 2 + payload_kg * second.length_m) * psi
    moment_2 += bending_2.first_moment @ q_2
    mass += np.cos(elbow_angle_rad) * (np.outer(elbow, moment_2) + np.outer(moment_2, elbow))
    # Hubs: the first turns with the shoulder, the second with the root of link 2.
    mass += hubs[0].inertia_kg_m2 * np.outer(theta_1, theta_1) + hubs[1].inertia_kg_m2 * np.outer(psi, psi)

    stiffness, damping = np.zeros((n, n)), np.zeros((n, n))
    for link, bending, q in ((first, bending_1, q_1), (second, bending_2, q_2)):
        spring = q.T @ bending.stiffness @ q
        stiffness += spring
        damping += link.kelvin_voigt_s * spring
    for hub, joint in zip(hubs, (theta_1, theta_2), strict=True):
        damping += hub.viscous_friction_Nms * np.outer(joint, joint)
    tip = np.cos(elbow_angle_rad) * elbow + second.length_m * psi + bending_2.tip @ q_2
    return mass, damping, stiffness, tip


def two_link_operating_point(elbow_angle_rad: float = np.pi / 3, n_modes: int = 2) -> control.StateSpace:
    """Two aluminium links with motors of our choosing, as a continuous-time python-control model.

    Inputs shoulder_voltage_V, elbow_voltage_V; outputs shoulder_angle_rad, elbow_angle_rad (change from the
    operating angle) and tip_m (across link 2). Link 2 is the paper's, half as long; link 1 is twice as thick.
    """
    import control  # here, because it brings a plotting library with it

    def link(thickness_m: float) -> Link:
        return Link(
            length_m=0.5,
            width_m=0.00635,
            thickness_m=thickness_m,
            density_kg_m3=2700.0,
            youngs_modulus_Pa=68.9e9,
            kelvin_voigt_s=0.0003,
        )

    hubs = (
        Hub(inertia_kg_m2=0.03, radius_m=0.0, viscous_friction_Nms=0.02),
        Hub(inertia_kg_m2=0.004, radius_m=0.0, viscous_friction_Nms=0.005),
    )
    motors = (
        Motor(torque_constant_Nm_A=0.036, back_emf_Vs_rad=0.036, resistance_ohm=1.7, gear_ratio=40.0),
        Motor(torque_constant_Nm_A=0.02, back_emf_Vs_rad=0.02, resistance_ohm=2.5, gear_ratio=26.0),
    )
    mass, damping, stiffness, tip = two_link_matrices(
        (link(0.0127), link(0.00635)),
        hubs,
        elbow_mass_kg=0.25,
        payload_kg=0.05,
        elbow_angle_rad=elbow_angle_rad,
        n_modes=n_modes,
    )
    n = mass.shape[0]
    joints = np.eye(n)[:2]
    damping = damping + joints.T @ np.diag([motor.back_emf_damping_Nms for motor in motors]) @ joints
    a = np.zeros((2 * n, 2 * n))
    a[:n, n:] = np.eye(n)
    a[n:, :n] = -np.linalg.solve(mass, stiffness)
    a[n:, n:] = -np.linalg.solve(mass, damping)
    b = np.zeros((2 * n, 2))
    b[n:] = np.linalg.solve(mass, joints.T * [motor.torque_per_volt_Nm_V for motor in motors])
    c = np.hstack([np.vstack([joints, tip]), np.zeros((3, n))])
    return control.ss(
        a,
        b,
        c,
        np.zeros((3, 2)),
        inputs=["shoulder_voltage_V", "elbow_voltage_V"],
        outputs=["shoulder_angle_rad", "elbow_angle_rad", "tip_m"],
        name="two_link_arm",
    )


@dataclass(frozen=True, eq=False)
class _Bending:
    """Integrals of the bending shapes of one link, the point mass at its tip included."""

    mass: Real
    stiffness: Real
    coupling: Real
    first_moment: Real
    tip: Real
    tip_slope: Real


def _bending(link: Link, n_modes: int, tip_mass_kg: float, moment: bool) -> _Bending:
    """Exact modes, and with `moment` the shape (x/L)^2 of a link under a moment at its tip."""
    length, m, ei = link.length_m, link.mass_per_length_kg_m, link.bending_stiffness_Nm2
    modes = clamped_free_modes(ei, m, length, n_modes, tip_mass_kg)
    # The highest mode has about n_modes / 2 waves along the link; 8 nodes a mode integrate its square to
    # rounding.
    nodes, weights = np.polynomial.legendre.leggauss(8 * n_modes + 16)
    x = np.append(0.5 * length * (nodes + 1), length)
    shape, slope, curvature = modes.shape(x), modes.slope(x), modes.curvature(x)
    if moment:
        shape = np.column_stack([shape, (x / length) ** 2])
        slope = np.column_stack([slope, 2 * x / length**2])
        curvature = np.column_stack([curvature, np.full(x.size, 2 / length**2)])
    area = np.append(0.5 * length * weights, 0.0)
    weighted = m * area
    weighted[-1] = tip_mass_kg
    return _Bending(
        mass=shape.T @ (weighted[:, None] * shape),
        stiffness=ei * curvature.T @ (area[:, None] * curvature),
        coupling=(weighted * x) @ shape,
        first_moment=weighted @ shape,
        tip=shape[-1],
        tip_slope=slope[-1],
    )
