"""Equations of motion in a rigid-body coordinate and modal deflections.

The displacement of the link point x is y = (r + x) theta + w(x, t), w = sum_i phi_i(x) q_i with the exact
clamped-free modes of `plant.beam`, the whole tip mass in their boundary condition. Unit modal mass makes

    T = 1/2 J thetadot^2 + 1/2 I thetadot^2 + thetadot sum_i b_i qdot_i + 1/2 sum_i qdot_i^2,
    U = 1/2 sum_i omega_i^2 q_i^2,
    damping power = kappa sum_i omega_i^2 qdot_i^2 + (b + n^2 Kt Kb / R) thetadot^2

with I = int m (r + x)^2 dx + mp (r + L)^2 and b_i = int m (r + x) phi_i dx + mp (r + L) phi_i(L).

Linearised; shear, rotary inertia of the section, air and motor inductance are neglected.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from plant.beam import BeamModes, clamped_free_modes
from plant.machine import Machine, Real
from plant.rig import Rig

if TYPE_CHECKING:
    import control

INPUT_NAMES = ("voltage_V", "hub_torque_Nm", "tip_force_N")
OUTPUT_NAMES = ("hub_angle_rad", "tip_m")
# Share of the hub inertia on the motor side of a gear with backlash.
MOTOR_SIDE_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class Equations:
    """M accel + D speed + K coordinate = sum of forces, with named directions in coordinate space.

    A direction d serves both ways: the displacement d . coordinate, and the generalised force d * f.

    mass, damping, stiffness : (N, N)
    shaft : (N,)
        Motor shaft angle relative to its housing: motor torque, back-EMF, friction and ripple act here.
    hub, motor : (N,). Absolute angles of the hub and of its motor side; the same but for a backlash.
    encoder : (N,). Measured hub angle (hub minus base).
    root : (N,). Absolute angle of the link root.
    tip : (N,). Tip position (r + L) * root angle + w(L).
    bending : (N,). Deflection w(L) of the tip from the straight link.
    backlash : (N,) or None. Motor side minus hub, where there is a gap between them.
    modes : BeamModes
    first_mode : int. Index of the first modal coordinate; the last one is the last coordinate.
    """

    mass: Real
    damping: Real
    stiffness: Real
    shaft: Real
    hub: Real
    motor: Real
    encoder: Real
    root: Real
    tip: Real
    bending: Real
    backlash: Real | None
    modes: BeamModes
    first_mode: int

    def state_matrix(self) -> Real:
        """A (2N, 2N) of the state (coordinates, speeds)."""
        n = self.mass.shape[0]
        a = np.zeros((2 * n, 2 * n))
        a[:n, n:] = np.eye(n)
        a[n:, :n] = -self._mobility @ self.stiffness
        a[n:, n:] = -self._mobility @ self.damping
        return a

    @cached_property
    def _mobility(self) -> Real:
        """(N, N) accelerations by unit generalised forces."""
        return np.asarray(np.linalg.inv(self.mass), dtype=np.float64)

    def input_column(self, direction: Real) -> Real:
        """State derivative (2N,) for a unit generalised force along a direction."""
        return np.concatenate([np.zeros(direction.size), self._mobility @ direction])

    def position_row(self, direction: Real) -> Real:
        return np.pad(direction, (0, direction.size))


def default_n_modes(rig: Rig) -> int:
    """As many modes as lie below the Nyquist frequency of the rig's sampling, at least three.

    The modes left out still deflect statically. On the rigs of the reference records that residue is below
    0.3 % of the sensor noise with three modes (2.5 % with two, 60 % with one), so no static correction is
    added.
    """
    nyquist = np.pi / rig.sampling.dt_s
    n = 4
    while n < 40 and link_modes(rig, n).omega_rad_s[-1] < nyquist:
        n += 1
    return min(max(int(np.sum(link_modes(rig, n).omega_rad_s < nyquist)), 3), 39)


def link_modes(rig: Rig, n_modes: int) -> BeamModes:
    """Modes of the rig's link with its payload."""
    return clamped_free_modes(
        rig.link.bending_stiffness_Nm2,
        rig.link.mass_per_length_kg_m,
        rig.link.length_m,
        n_modes,
        rig.payload.mass_kg,
        rig.hub.radius_m,
    )


def equations_of_motion(machine: Machine, n_modes: int) -> Equations:
    """Linear equations of the machine: rig, springs at joint, base and hub, a body held to the
    hub, the two sides of a backlash.

    Torques that are not linear in the state (friction, contact, ripple, cubic spring, gravity) are not in it.
    """
    rig, joint = machine.rig, machine.joint
    modes = link_modes(rig, n_modes)
    names = ["hub"]
    if joint.base is not None:
        names.append("base")
    if joint.backlash_gap_rad is not None:
        names.append("motor")
    if joint.attached is not None:
        names.append("attached")
    if joint.compliance is not None:
        names.append("root")
    first = len(names)
    n = first + n_modes
    unit = {name: np.eye(n)[i] for i, name in enumerate(names)}
    zero = np.zeros(n)
    hub = unit["hub"]
    base = unit.get("base", zero)
    motor = unit.get("motor", hub)
    attached = unit.get("attached", hub)
    root = unit.get("root", hub)
    shaft = motor - base

    mass, damping, stiffness = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    motor_share = MOTOR_SIDE_SHARE if joint.backlash_gap_rad is not None else 0.0
    mass += rig.hub.inertia_kg_m2 * (
        (1 - motor_share) * np.outer(hub, hub) + motor_share * np.outer(motor, motor)
    )
    mass += link_inertia_kg_m2(rig) * np.outer(root, root)
    deflection = np.zeros((n_modes, n))
    deflection[:, first:] = np.eye(n_modes)
    coupling = modes.coupling @ deflection
    mass += np.outer(root, coupling) + np.outer(coupling, root) + deflection.T @ deflection
    elastic = deflection.T @ (modes.omega_rad_s[:, None] ** 2 * deflection)
    stiffness += elastic
    damping += rig.link.kelvin_voigt_s * elastic
    damping += (rig.hub.viscous_friction_Nms + rig.motor.back_emf_damping_Nms) * np.outer(shaft, shaft)
    sprung = (
        (joint.compliance, root, root - hub),
        (joint.base, base, base),
        (joint.attached, attached, attached - hub),
    )
    for spring, carried, twist in sprung:
        if spring is not None:
            stiffness += spring.stiffness_Nm_rad * np.outer(twist, twist)
            damping += spring.damping_Nms * np.outer(twist, twist)
            mass += spring.inertia_kg_m2 * np.outer(carried, carried)
    stiffness += joint.ground_spring_Nm_rad * np.outer(motor, motor)
    bending = modes.tip @ deflection
    return Equations(
        mass=mass,
        damping=damping,
        stiffness=stiffness,
        shaft=shaft,
        hub=hub,
        motor=motor,
        encoder=hub - base,
        root=root,
        tip=(rig.hub.radius_m + rig.link.length_m) * root + bending,
        bending=bending,
        backlash=motor - hub if joint.backlash_gap_rad is not None else None,
        modes=modes,
        first_mode=first,
    )


def link_inertia_kg_m2(rig: Rig) -> float:
    """Inertia of the straight link and payload about the hub axis."""
    r, length = rig.hub.radius_m, rig.link.length_m
    return (
        rig.link.mass_per_length_kg_m * ((r + length) ** 3 - r**3) / 3.0
        + rig.payload.mass_kg * (r + length) ** 2
    )


def static_moment_kg_m(rig: Rig) -> float:
    """Mass times distance from the hub axis of the straight link and payload: what gravity pulls at."""
    r, length = rig.hub.radius_m, rig.link.length_m
    return rig.link.mass_per_length_kg_m * length * (r + length / 2) + rig.payload.mass_kg * (r + length)


def linear_arm(rig: Rig, n_modes: int | None = None) -> control.StateSpace:
    """The nominal arm as a continuous-time python-control model without feedthrough.

    States (theta, q_1..q_M, their rates); inputs voltage_V, hub_torque_Nm (on the hub, from ground) and
    tip_force_N (transverse); outputs hub_angle_rad and tip_m = (r + L) theta + w(L). n_modes None takes
    `default_n_modes`.
    """
    import control  # here, because it brings a plotting library with it

    equations = equations_of_motion(Machine(rig), default_n_modes(rig) if n_modes is None else n_modes)
    drive = rig.motor.torque_per_volt_Nm_V * equations.shaft
    return control.ss(
        equations.state_matrix(),
        np.column_stack([equations.input_column(d) for d in (drive, equations.hub, equations.tip)]),
        np.array([equations.position_row(equations.encoder), equations.position_row(equations.tip)]),
        np.zeros((2, 3)),
        inputs=list(INPUT_NAMES),
        outputs=list(OUTPUT_NAMES),
        name="arm",
    )
