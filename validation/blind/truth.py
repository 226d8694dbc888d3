"""The machine that makes the records of the blind protocol: a rig, effects of the list, and some beyond it.

Equations as in the case format's description, written independently: nothing is taken from `plant`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np
import numpy.typing as npt

from validation.blind.beam import LinkBasis, link_basis
from validation.blind.kernel import ATTACHED, BASE, BODIES, HUB, MOTOR, ROOT, Link, run

Real = npt.NDArray[np.float64]
RigTable = Mapping[str, Mapping[str, float]]
Effects = Sequence[Mapping[str, Any]]

# Causes of the list that a diagnosis knows.
LISTED = (
    "coulomb_friction",
    "stribeck_friction",
    "viscous_friction",
    "backlash",
    "actuator_saturation",
    "actuator_dead_zone",
    "actuator_lag",
    "input_delay",
    "actuator_gain",
    "torque_ripple",
    "joint_compliance",
    "tip_payload",
    "link_stiffness",
    "structural_damping",
    "hardening_spring",
    "gravity",
    "sensor_lag",
    "sensor_gain",
    "sensor_drift",
    "quantisation",
    "periodic_disturbance",
    "base_compliance",
    "hub_inertia",
)
# Causes that no list names: the right answer to each is "unknown".
UNLISTED = (
    "air_drag",  # -c |v| v per unit length of the link
    "cogging",  # torque constant Kt (1 + a cos(N theta + p))
    "ground_spring",  # linear spring from hub to ground
    "inductance",  # L di/dt in the winding, current limited
    "asymmetric_friction",  # dry friction of another level in each direction
    "amplifier_cubic",  # V + c V^3
    "sensor_clipping",  # tip reading ends at +-limit
    "winding_heat",  # resistance grows linearly in time during a record
    "encoder_eccentricity",  # a (sin(theta + p) - sin p) added to the hub angle
)
# Causes that no list names, in workshop cases only (the other cases stay what they were).
WORKSHOP_UNLISTED = (
    "gear_drag",  # -c |omega| omega on the motor side
    "asymmetric_dead_zone",  # dead zone of another width for each sign of the voltage
    "slew_limit",  # voltage of the amplifier changes at a limited rate
    "attachment",  # a body on the hub behind a torsion spring and damper
)

# Deflection before dry friction slips: as good as rigid.
PRE_SLIDING_RAD = 1e-5
# Frequency of both sides of a backlash against each other on its contact. Chosen: stiff beside the modes.
_CONTACT_HZ = 180.0
# Modes of the link above it are left out.
_FASTEST_MODE_HZ = 300.0
# Substeps of a sample at least: a local error far below the noise.
_FEWEST = 16
# With a backlash: contacts want more.
_FEWEST_CONTACT = 128
# At most; a stiffer machine is stepped too coarsely, and drawn again where it leaves every bound.
_MOST = 2000
# Modes of a workshop machine: its imperfections are far larger than what a fifth one adds.
_MODES_WORKSHOP = 4
# Its substeps at least, for the same reason.
_FEWEST_WORKSHOP = 4


class OutOfBoundsError(ValueError):
    """A machine, or its motion, beyond what these simulations are made for: another one is drawn."""


@dataclass(frozen=True, eq=False)
class Feedback:
    """PD control of the noisy hub angle, one sample ahead; reference (T,)."""

    reference_rad: Real
    proportional_V_rad: float
    derivative_Vs_rad: float
    filter_pole: float
    limit_V: float = 1e9


@dataclass(frozen=True)
class Background:
    """What no data sheet of a machine mentions; all of it absent by default.

    Dry friction with a pre-sliding deflection, cogging torque, lag of the amplifier, tilt of the plane
    (in-plane gravity and its direction, an angle of the link), and the encoder's zero and step (0: none).
    """

    dry_friction_Nm: float = 0.0
    presliding_rad: float = 1e-3
    cogging_Nm: float = 0.0
    cogging_per_rev: float = 1.0
    cogging_phase_rad: float = 0.0
    amplifier_lag_s: float = 0.0
    tilt_m_s2: float = 0.0
    tilt_angle_rad: float = 0.0
    hub_offset_rad: float = 0.0
    encoder_step_rad: float = 0.0


@dataclass(frozen=True)
class Before:
    """How a record begins: straight and at rest at this hub angle, rows_before rows before the first."""

    start_angle_rad: float = 0.0
    rows_before: int = 0


@dataclass(frozen=True, eq=False)
class Clean:
    """A record without noise (T,) each, before quantisation; voltage_V is what was commanded."""

    voltage_V: Real
    hub_angle_rad: Real
    tip_m: Real
    step_m: float
    clip_m: float
    tip_acceleration_m_s2: Real

    def measured(self, noise: Real) -> Real:
        """(T, 2) with noise (T, 2) added and the tip quantised or clipped where its sensor does so."""
        hub = self.hub_angle_rad + noise[:, 0]
        tip = self.tip_m + noise[:, 1]
        return np.column_stack([hub, self.sensed_tip(tip)])

    def sensed_tip(self, tip_m: Real) -> Real:
        """A tip reading behind the limit and the step of its sensor, where it has them."""
        tip = np.clip(tip_m, -self.clip_m, self.clip_m)
        return self.step_m * np.rint(tip / self.step_m) if self.step_m > 0 else tip


class Truth:
    """A machine at rest, ready for any number of records; `effects` are tables with a name and parameters."""

    def __init__(self, rig: RigTable, effects: Effects = (), background: Background | None = None) -> None:
        by_name = {str(e["name"]): e for e in effects}
        if len(by_name) != len(effects):
            raise ValueError(f"an effect is given twice: {[e['name'] for e in effects]}")
        for name in by_name:
            if name not in LISTED + UNLISTED + WORKSHOP_UNLISTED:
                raise ValueError(f"unknown effect {name!r}; known: {', '.join(LISTED + UNLISTED)}")
        self.rig = rig
        self.background = around = background or Background()
        self.dt_s = float(rig["sampling"]["dt_s"])
        sensors = rig["sensors"]
        self.noise = np.array([sensors["hub_angle_noise_rad"], sensors.get("tip_noise_m", 0.0)])
        # Nominal with workshop cases only; input_delay comes on top.
        self.transport_delay_s = float(rig["sampling"].get("transport_delay_s", 0.0))

        def get(name: str, parameter: str, absent: float) -> float:
            return float(by_name[name][parameter]) if name in by_name else absent

        self.get = get
        link = rig["link"]
        hub = rig["hub"]
        stiffness_ratio = get("link_stiffness", "ratio", 1.0)
        section = link["width_m"] * link["thickness_m"]
        bending = link["youngs_modulus_Pa"] * section * link["thickness_m"] ** 2 / 12 * stiffness_ratio
        line = link["density_kg_m3"] * section
        tip_mass = rig["payload"]["mass_kg"] + get("tip_payload", "mass_kg", 0.0)
        fixed = None if background is None else _MODES_WORKSHOP
        self._fewest = _FEWEST if background is None else _FEWEST_WORKSHOP
        basis = _basis(link["length_m"], bending, line, tip_mass, fixed)
        lumps = np.append(line * basis.weights_m, tip_mass)
        self._link = Link(
            _couple(set(by_name)), basis.angle, basis.integral, lumps, basis.weights_m, basis.stiffness,
            basis.tip_angle,
        )  # fmt: skip
        J = hub["inertia_kg_m2"] * get("hub_inertia", "ratio", 1.0)
        backlash = "backlash" in by_name
        contact = 0.21 * J * (2 * pi * _CONTACT_HZ) ** 2
        motor = rig["motor"]
        levels = ("torque_positive_Nm", "torque_negative_Nm")
        uneven = [get("asymmetric_friction", level, 0.0) for level in levels]
        if uneven[0] and "coulomb_friction" in by_name:
            raise ValueError(
                "coulomb_friction and asymmetric_friction use the same contact: give one of them"
            )
        # SI units; an effect that is absent has its neutral value (no backlash: negative).
        constants: dict[str, float] = {
            "radius_m": hub["radius_m"],
            "length_m": link["length_m"],
            "kelvin_voigt_s": link["kelvin_voigt_s"] * get("structural_damping", "ratio", 1.0),
            "motor_inertia": 0.3 * J if backlash else 0.0,
            "hub_inertia": 0.7 * J if backlash else J,
            "viscous": hub["viscous_friction_Nms"] + get("viscous_friction", "coefficient_Nms", 0.0),
            "gear": motor["gear_ratio"],
            "torque_constant": motor["torque_constant_Nm_A"],
            "back_emf": motor["back_emf_Vs_rad"],
            "resistance": motor["resistance_ohm"],
            # along the link axis at a hub angle of zero, and a quarter turn further
            "gravity": get("gravity", "acceleration_m_s2", 0.0)
            + around.tilt_m_s2 * float(np.cos(around.tilt_angle_rad)),
            "gravity_across": around.tilt_m_s2 * float(np.sin(around.tilt_angle_rad)),
            # two friction elements: Coulomb, with a level of its own in the negative direction ...
            "dry_static": get("coulomb_friction", "torque_Nm", uneven[0]),
            "dry_minus": get("coulomb_friction", "torque_Nm", uneven[1]),
            # ... and Stribeck
            "stribeck_static": get("stribeck_friction", "static_torque_Nm", 0.0),
            "stribeck_coulomb": get("stribeck_friction", "coulomb_torque_Nm", 0.0),
            "stribeck_velocity": get("stribeck_friction", "stribeck_velocity_rad_s", 1.0),
            "pre_sliding": PRE_SLIDING_RAD,
            "seal_static": around.dry_friction_Nm,
            "seal_sliding": around.presliding_rad,
            "gear_drag": get("gear_drag", "coefficient_Nms2", 0.0),
            "detent": around.cogging_Nm,
            "detent_cycles": around.cogging_per_rev,
            "detent_phase": around.cogging_phase_rad,
            "ripple": get("torque_ripple", "amplitude_Nm", 0.0),
            "ripple_cycles": get("torque_ripple", "cycles_per_rev", 1.0),
            "ripple_phase": get("torque_ripple", "phase_rad", 0.0),
            "disturbance": get("periodic_disturbance", "amplitude_Nm", 0.0),
            "disturbance_omega": 2 * pi * get("periodic_disturbance", "frequency_Hz", 0.0),
            "disturbance_phase": get("periodic_disturbance", "phase_rad", 0.0),
            "cubic_spring": get("hardening_spring", "cubic_Nm_rad3", 0.0),
            "linear_spring": get("ground_spring", "stiffness_Nm_rad", 0.0),
            "joint_stiffness": get("joint_compliance", "stiffness_Nm_rad", 0.0),
            "joint_damping": get("joint_compliance", "damping_Nms", 0.0),
            "base_stiffness": get("base_compliance", "stiffness_Nm_rad", 0.0),
            "base_damping": get("base_compliance", "damping_Nms", 0.0),
            "base_inertia": get("base_compliance", "inertia_kg_m2", 0.0),
            "backlash": get("backlash", "gap_rad", -1.0),
            "contact_stiffness": contact,
            "contact_damping": 0.8 * float(np.sqrt(0.3 * J * contact)),
            "lag": get("actuator_lag", "time_constant_s", 0.0),
            "inductance": get("inductance", "inductance_H", 0.0),
            "current_limit": get("inductance", "current_limit_A", 1e9),
            "cogging": get("cogging", "relative_amplitude", 0.0),
            "cogging_cycles": get("cogging", "cycles_per_rev", 0.0),
            "cogging_phase": get("cogging", "phase_rad", 0.0),
            "heating_1_s": get("winding_heat", "rate_1_s", 0.0),
            "drag": get("air_drag", "coefficient_Ns2_m3", 0.0),
            "sensor_lag": get("sensor_lag", "time_constant_s", 0.0),
            "amplifier_lag": around.amplifier_lag_s,
            "slew_V_s": get("slew_limit", "rate_V_s", 1e9),
            "attached_stiffness": get("attachment", "stiffness_Nm_rad", 0.0),
            "attached_damping": get("attachment", "damping_Nms", 0.0),
            "attached_inertia": get("attachment", "inertia_kg_m2", 0.0),
        }
        kinds = [(name, np.float64) for name in constants]
        # A record with named fields, which compiled code reads as well.
        self._physics = np.rec.array([tuple(constants.values())], dtype=kinds)[0]
        self.substeps = self._substeps()

    def record(
        self,
        voltage_V: npt.ArrayLike,
        feedback: Feedback | None = None,
        hub_noise_rad: Real | None = None,
        before: Before | None = None,
    ) -> Clean:
        """Drive the machine from rest; with a feedback the voltage is the controller's (and T its length).

        The rows before the first one are returned too; time counts from the first.

        Raises OutOfBoundsError where the motion leaves every bound (an unstable loop).
        """
        get = self.get
        p = self._physics
        commanded = np.array(voltage_V, dtype=np.float64)
        static = self.amplifier
        acting = amplified(commanded, static)
        whole, late = _delay(get("input_delay", "delay_s", 0.0) + self.transport_delay_s, self.dt_s)
        if feedback is None:
            gains = np.zeros(0)
            reference = np.zeros(0)
            noise = np.zeros(0)
        else:
            gains = np.array(
                [
                    feedback.proportional_V_rad,
                    feedback.derivative_Vs_rad,
                    feedback.filter_pole,
                    feedback.limit_V,
                ]
            )
            reference = np.array(feedback.reference_rad)
            noise = np.zeros(commanded.size) if hub_noise_rad is None else np.array(hub_noise_rad)
            commanded[:] = 0.0
            acting[:] = 0.0
        outputs = np.zeros((commanded.size, 3))
        around = self.background
        begin = before or Before()
        start = np.array([begin.start_angle_rad, -begin.rows_before * self.dt_s])
        encoder = np.array([around.hub_offset_rad, around.encoder_step_rad, *self._eccentricity])
        fine = run(
            p, self._link, acting, commanded, late, self.dt_s, self.substeps, gains, static, noise,
            reference, whole, start, encoder, outputs,
        )  # fmt: skip
        if not fine or not np.all(np.isfinite(outputs)):
            raise OutOfBoundsError(
                "the motion leaves every bound: the loop is unstable or the voltage too high"
            )
        return self.sensed(commanded, outputs, start[1])

    @property
    def amplifier(self) -> Real:
        """(gain, dead zone, limit, cubic part, negative dead zone) of the voltage's static path."""
        get = self.get
        return np.array(
            [
                get("actuator_gain", "ratio", 1.0),
                get("asymmetric_dead_zone", "positive_V", get("actuator_dead_zone", "width_V", 0.0)),
                get("actuator_saturation", "limit_V", 1e9),
                get("amplifier_cubic", "cubic_1_V2", 0.0),
                get("asymmetric_dead_zone", "negative_V", get("actuator_dead_zone", "width_V", 0.0)),
            ]
        )

    @property
    def _eccentricity(self) -> tuple[float, float]:
        get = self.get
        return (
            get("encoder_eccentricity", "amplitude_rad", 0.0),
            get("encoder_eccentricity", "phase_rad", 0.0),
        )

    def sensed(self, commanded: Real, outputs: Real, from_s: float) -> Clean:
        """The record as sensors see it, but for noise, clipping and quantisation, and the encoder's zero.

        outputs (T, 3), the first of them at the time from_s.
        """
        get = self.get
        hub, tip, acceleration = outputs.T
        a, phase = self._eccentricity
        hub = hub + a * (np.sin(hub + phase) - np.sin(phase))
        time = from_s + np.arange(commanded.size) * self.dt_s
        tip = get("sensor_gain", "ratio", 1.0) * tip + get("sensor_drift", "rate_m_s", 0.0) * time
        return Clean(
            commanded,
            hub,
            tip,
            get("quantisation", "step_m", 0.0),
            get("sensor_clipping", "limit_m", float("inf")),
            acceleration,
        )

    def linear(self) -> tuple[Real, Real, Real]:
        """Mass, stiffness and damping at rest, contacts closed: free angles, then modes of the link."""
        p = self._physics
        link = self._link
        couple = self._link.couple
        R = couple.shape[1]
        n = link.stiffness.size
        size = R + n
        M = np.zeros((size, size))
        K = np.zeros((size, size))
        C = np.zeros((size, size))
        shapes = self.shapes
        to_link = np.zeros((1 + n, size))
        to_link[0, :R] = couple[ROOT]
        to_link[1:, R:] = np.eye(n)
        M += to_link.T @ (shapes.T @ (link.lumps[:, None] * shapes)) @ to_link
        K[R:, R:] += np.diag(link.stiffness)
        C[R:, R:] += p.kelvin_voigt_s * np.diag(link.stiffness)

        def spring(one: Real, other: Real, k: float, c: float) -> None:
            d = np.zeros(size)
            d[:R] = one - other
            K[...] += k * np.outer(d, d)
            C[...] += c * np.outer(d, d)

        bodies = (
            (BASE, p.base_inertia),
            (MOTOR, p.motor_inertia),
            (HUB, p.hub_inertia),
            (ATTACHED, p.attached_inertia),
        )
        for body, inertia in bodies:
            M[:R, :R] += inertia * np.outer(couple[body], couple[body])
        ground = np.zeros(R)
        dry = (p.dry_static + p.stribeck_static) / p.pre_sliding + p.seal_static / p.seal_sliding
        motor = p.gear**2 * p.torque_constant * p.back_emf / p.resistance
        spring(couple[MOTOR], couple[BASE], dry, p.viscous + motor)
        spring(couple[BASE], ground, p.base_stiffness, p.base_damping)
        spring(couple[ROOT], couple[HUB], p.joint_stiffness, p.joint_damping)
        spring(couple[ATTACHED], couple[HUB], p.attached_stiffness, p.attached_damping)
        if p.backlash >= 0:
            spring(couple[MOTOR], couple[HUB], p.contact_stiffness, p.contact_damping)
        return M, K, C

    @property
    def shapes(self) -> Real:
        """(G + 1, 1 + M): transverse displacement at the Gauss points and the tip, straight link."""
        link = self._link
        turned = self._physics.radius_m + link.integral @ np.ones(link.weights.size)
        return np.column_stack([turned, link.integral @ link.angle])

    def _substeps(self) -> int:
        """Substeps per sample from the fastest eigenvalue of the machine at rest."""
        p = self._physics
        fastest = float(np.max(np.abs(np.linalg.eigvals(state_matrix(*self.linear())))))
        if p.inductance > 0:
            fastest = max(fastest, p.resistance / p.inductance)
        fewest = _FEWEST_CONTACT if p.backlash >= 0 else self._fewest
        return int(np.clip(np.ceil(self.dt_s * fastest / 0.9), fewest, _MOST))


def state_matrix(M: Real, K: Real, C: Real) -> Real:
    """State matrix (2 N, 2 N) of mass, stiffness and damping (N, N); positions, then speeds."""
    size = M.shape[0]
    below = [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]
    return np.block([[np.zeros((size, size)), np.eye(size)], below])


def amplified(voltage_V: Real, static: Real) -> Real:
    """Gain, cubic part, dead zones and limit; see `Truth.amplifier`."""
    value = static[0] * voltage_V
    value = value + static[3] * value**3
    dead = np.where(value >= 0, static[1], static[4])
    return np.asarray(np.sign(value) * np.clip(np.abs(value) - dead, 0.0, static[2]))


def _basis(length: float, bending: float, line: float, tip_mass: float, modes: int | None) -> LinkBasis:
    if modes is not None:
        return link_basis(length, bending, line, tip_mass, modes)
    every = link_basis(length, bending, line, tip_mass, 7)
    wanted = int(np.sum(np.sqrt(every.stiffness) / (2 * pi) < _FASTEST_MODE_HZ))
    return link_basis(length, bending, line, tip_mass, min(max(wanted, 4), 6))


def _couple(names: set[str]) -> Real:
    """(5, R): base, motor side, hub, link root and attachment as functions of the free angles."""
    columns = []
    groups = [[BASE]] if "base_compliance" in names else []
    rigid = [[MOTOR], [HUB], [ROOT]]
    if "joint_compliance" not in names:
        rigid = [[MOTOR], [HUB, ROOT]]
    if "attachment" in names:
        groups.append([ATTACHED])
    else:
        rigid[1] = [*rigid[1], ATTACHED]
    if "backlash" not in names:
        rigid = [rigid[0] + rigid[1], *rigid[2:]]
    for group in groups + rigid:
        column = np.zeros(BODIES)
        column[group] = 1.0
        columns.append(column)
    return np.ascontiguousarray(np.column_stack(columns))


def _delay(delay_s: float, dt_s: float) -> tuple[int, float]:
    """Whole samples and the rest in seconds."""
    whole = int(np.floor(delay_s / dt_s + 1e-12))
    return whole, max(delay_s - whole * dt_s, 0.0)
