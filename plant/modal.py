"""Equations of motion in a rigid-body coordinate and modal deflections.

The displacement of the link point x is y = (r + x) theta + w(x, t), w = sum_i phi_i(x) q_i with the exact
clamped-free modes of `plant.beam`, the whole tip mass in their boundary condition. Unit modal mass makes

    T = 1/2 J thetadot^2 + 1/2 I thetadot^2 + thetadot sum_i b_i qdot_i + 1/2 sum_i qdot_i^2,
    U = 1/2 sum_i omega_i^2 q_i^2,
    damping power = kappa sum_i omega_i^2 qdot_i^2 + (b + n^2 Kt Kb / R) thetadot^2

with I = int m (r + x)^2 dx + mp (r + L)^2 and b_i = int m (r + x) phi_i dx + mp (r + L) phi_i(L).

Linearised; shear, rotary inertia of the section, air and motor inductance are neglected.

`equations_of_motion` writes mass, damping and stiffness for a machine with its springs and extra bodies;
`linear_arm` is the nominal arm as a state-space model, `default_n_modes` how many modes either takes.
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

# Inputs and outputs of `linear_arm`; the outputs are also those of a record.
INPUT_NAMES = ("voltage_V", "hub_torque_Nm", "tip_force_N")
OUTPUT_NAMES = ("hub_angle_rad", "tip_m")
# Share of the hub inertia on the motor side of a gear with backlash: the rotor behind its gear, while clamp
# and cabling are on the link's side. Chosen; see `plant.effects.joint.Backlash`.
MOTOR_SIDE_SHARE = 0.3
# Modes that a simulation has at the least: with three, the statical deflection of the others is below 0.3 %
# of the sensor noise on the rigs of the reference records (2.5 % with two, 60 % with one).
_FEWEST_MODES = 3
# Modes are counted up to this; a link with more of them below Nyquist is taken with one fewer than this.
_MODES_COUNTED = 40


@dataclass(frozen=True, eq=False)
class Equations:
    """M accel + D speed + K coordinate = sum of forces, with named directions in coordinate space.

    A direction d serves both ways: the displacement d . coordinate, and the generalised force d * f. The N
    coordinates are angles, rad, and modal deflections, sqrt(kg) m.

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
        """Matrix A (2N, 2N) of the state (coordinates, speeds) without inputs."""
        n = self.mass.shape[0]
        a = np.zeros((2 * n, 2 * n))
        a[:n, n:] = np.eye(n)
        a[n:, :n] = -self._mobility @ self.stiffness
        a[n:, n:] = -self._mobility @ self.damping
        return a

    @cached_property
    def _mobility(self) -> Real:
        """Accelerations (N, N) by unit generalised forces: the inverse of the mass matrix."""
        return np.asarray(np.linalg.inv(self.mass), dtype=np.float64)

    def input_column(self, direction: Real) -> Real:
        """State derivative (2N,) for a unit generalised force along a direction."""
        return np.concatenate([np.zeros(direction.size), self._mobility @ direction])

    def position_row(self, direction: Real) -> Real:
        """Row (2N,) that gives the displacement along a direction (N,) from the state."""
        return np.concatenate([direction, np.zeros(direction.size)])


def default_n_modes(rig: Rig) -> int:
    """Number of modes below the Nyquist frequency of the rig's sampling, at least three and at most 39.

    The modes left out still deflect statically. On the rigs of the reference records that residue is below
    0.3 % of the sensor noise with three modes (2.5 % with two, 60 % with one), so no static correction is
    added.
    """
    nyquist_rad_s = np.pi / rig.sampling.dt_s
    # Until the last mode is above Nyquist.
    n_counted = _FEWEST_MODES + 1
    while n_counted < _MODES_COUNTED and link_modes(rig, n_counted).omega_rad_s[-1] < nyquist_rad_s:
        n_counted += 1
    is_below = link_modes(rig, n_counted).omega_rad_s < nyquist_rad_s
    n_below = int(np.sum(is_below))
    return min(max(n_below, _FEWEST_MODES), _MODES_COUNTED - 1)


def link_modes(rig: Rig, n_modes: int) -> BeamModes:
    """First n_modes modes of the rig's link with its payload, root clamped at the hub's radius."""
    return clamped_free_modes(
        rig.link.bending_stiffness_Nm2,
        rig.link.mass_per_length_kg_m,
        rig.link.length_m,
        n_modes,
        rig.payload.mass_kg,
        rig.hub.radius_m,
    )


def equations_of_motion(machine: Machine, n_modes: int) -> Equations:
    """Linear equations of a machine: rig, springs at joint, base and hub, a body, two sides of a backlash.

    Torques that are not linear in the state (friction, contact, ripple, cubic spring, gravity) are not in it.

    Parameters
    ----------
    machine : Machine
        Rig and joint; voltage and sensor paths are not looked at.
    n_modes : int
        Modes of the link.

    Returns
    -------
    Equations
        Coordinates are angles of the hub, then of base, motor side, attached body and link root where the
        machine has them, then the modal deflections.
    """
    rig = machine.rig
    joint = machine.joint
    modes = link_modes(rig, n_modes)

    # Coordinates, and directions along them. What a machine does not have moves with its neighbour.
    names = ["hub"]
    if joint.base is not None:
        names.append("base")
    if joint.backlash_gap_rad is not None:
        names.append("motor")
    if joint.attached is not None:
        names.append("attached")
    if joint.compliance is not None:
        names.append("root")
    first_mode = len(names)
    n = first_mode + n_modes
    unit = dict(zip(names, np.eye(n), strict=False))
    zero = np.zeros(n)
    hub = unit["hub"]
    base = unit.get("base", zero)
    motor = unit.get("motor", hub)
    attached = unit.get("attached", hub)
    root = unit.get("root", hub)
    shaft = motor - base

    mass = np.zeros((n, n))
    damping = np.zeros((n, n))
    stiffness = np.zeros((n, n))

    # The hub, in two parts where there is a gap between them.
    motor_share = 0.0
    if joint.backlash_gap_rad is not None:
        motor_share = MOTOR_SIDE_SHARE
    link_side = (1 - motor_share) * np.outer(hub, hub)
    motor_side = motor_share * np.outer(motor, motor)
    mass += rig.hub.inertia_kg_m2 * (link_side + motor_side)

    # The link: straight with its root, and bending. Modal masses are one.
    mass += link_inertia_kg_m2(rig) * np.outer(root, root)
    deflection = np.zeros((n_modes, n))
    deflection[:, first_mode:] = np.eye(n_modes)
    coupling = modes.coupling @ deflection
    mass += np.outer(root, coupling) + np.outer(coupling, root) + deflection.T @ deflection
    elastic = deflection.T @ (modes.omega_rad_s[:, None] ** 2 * deflection)
    stiffness += elastic
    damping += rig.link.kelvin_voigt_s * elastic

    # Friction and back-EMF at the shaft; springs with what they carry, by the angle that twists them.
    shaft_damping = rig.hub.viscous_friction_Nms + rig.motor.back_emf_damping_Nms
    damping += shaft_damping * np.outer(shaft, shaft)
    springs = (
        (joint.compliance, root, root - hub),
        (joint.base, base, base),
        (joint.attached, attached, attached - hub),
    )
    for spring, carried, twist in springs:
        if spring is not None:
            stiffness += spring.stiffness_Nm_rad * np.outer(twist, twist)
            damping += spring.damping_Nms * np.outer(twist, twist)
            mass += spring.inertia_kg_m2 * np.outer(carried, carried)
    stiffness += joint.ground_spring_Nm_rad * np.outer(motor, motor)

    backlash = None
    if joint.backlash_gap_rad is not None:
        backlash = motor - hub
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
        backlash=backlash,
        modes=modes,
        first_mode=first_mode,
    )


def link_inertia_kg_m2(rig: Rig) -> float:
    """Inertia of the straight link and payload about the hub axis, kg m^2."""
    root_m = rig.hub.radius_m
    tip_m = root_m + rig.link.length_m
    link = rig.link.mass_per_length_kg_m * (tip_m**3 - root_m**3) / 3.0
    payload = rig.payload.mass_kg * tip_m**2
    return link + payload


def static_moment_kg_m(rig: Rig) -> float:
    """Mass times distance from the hub axis of the straight link and payload, kg m: what gravity pulls at."""
    root_m = rig.hub.radius_m
    length_m = rig.link.length_m
    link = rig.link.mass_per_length_kg_m * length_m * (root_m + length_m / 2)
    payload = rig.payload.mass_kg * (root_m + length_m)
    return link + payload


def linear_arm(rig: Rig, n_modes: int | None = None) -> control.StateSpace:
    """The nominal arm as a continuous-time python-control model without feedthrough.

    Parameters
    ----------
    rig : Rig
        The nominal arm.
    n_modes : int, optional
        Modes of the link; None takes `default_n_modes`.

    Returns
    -------
    control.StateSpace
        States (theta, q_1..q_M, their rates); inputs voltage_V, hub_torque_Nm (on the hub, from ground) and
        tip_force_N (transverse); outputs hub_angle_rad and tip_m = (r + L) theta + w(L).

    Examples
    --------
    >>> arm = flexlink.linear_arm(flexlink.paper_link(), n_modes=2)
    >>> arm.nstates, arm.input_labels
    (6, ['voltage_V', 'hub_torque_Nm', 'tip_force_N'])
    """
    import control  # here, because it brings a plotting library with it

    if n_modes is None:
        n_modes = default_n_modes(rig)
    equations = equations_of_motion(Machine(rig), n_modes)
    drive = rig.motor.torque_per_volt_Nm_V * equations.shaft
    directions = (drive, equations.hub, equations.tip)
    columns = [equations.input_column(direction) for direction in directions]
    rows = [equations.position_row(direction) for direction in (equations.encoder, equations.tip)]
    return control.ss(
        equations.state_matrix(),
        np.column_stack(columns),
        np.array(rows),
        np.zeros((2, 3)),
        inputs=list(INPUT_NAMES),
        outputs=list(OUTPUT_NAMES),
        name="arm",
    )
