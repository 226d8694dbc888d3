"""Effects to hide in a case: parameters as functions of one size, in units that come from the rig."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import pi
from types import SimpleNamespace
from typing import Any

import numpy as np

from validation.blind.inputs import Planned
from validation.blind.rigs import log_uniform, magnitudes, rounded
from validation.blind.truth import LISTED, UNLISTED, RigTable

Table = dict[str, Any]

# Effects that multiply or add to a stated parameter, and the tolerances that could explain them away.
PARAMETRIC: Mapping[str, tuple[str, ...]] = {
    "hub_inertia": ("hub.inertia_kg_m2",),
    "link_stiffness": ("link.youngs_modulus_Pa",),
    "structural_damping": ("link.kelvin_voigt_s",),
    "viscous_friction": ("hub.viscous_friction_Nms",),
    "actuator_gain": ("motor.torque_constant_Nm_A", "motor.resistance_ohm"),
}
# Pairs that no record of this kind could tell from one of them, or that the format leaves undefined.
NOT_TOGETHER = (
    {"coulomb_friction", "stribeck_friction"},
    {"input_delay", "actuator_lag"},
    {"actuator_gain", "viscous_friction"},
    {"hub_inertia", "tip_payload"},
    {"link_stiffness", "joint_compliance"},
    {"backlash", "hardening_spring"},
)


@dataclass(frozen=True)
class Sizable:
    """An effect of which only the size is open: parameters(size), growing with it from nothing at 0."""

    name: str
    first: float
    largest: float
    parameters: Callable[[float], Table]

    def at(self, size: float) -> Table:
        values = {key: rounded(float(value)) for key, value in self.parameters(size).items()}
        return {"name": self.name, **values}


def sizable(name: str, rig: RigTable, plans: tuple[Planned, ...], rng: np.random.Generator) -> Sizable:
    """An effect with everything but its size drawn; plans give the voltages it has to be felt at."""
    s = _scales(rig, plans)
    sign = float(rng.choice([-1.0, 1.0]))
    phase = rng.uniform(0, 2 * pi)
    log = partial(log_uniform, rng)

    def ratio(size: float) -> Table:
        return {"ratio": 1 + size if sign > 0 else 1 / (1 + size)}

    def growing(first: float, largest: float, fixed: Table, **units: float) -> Sizable:
        """Parameters in proportion to the size, beside fixed ones."""
        return Sizable(name, first, largest, lambda size: {k: size * u for k, u in units.items()} | fixed)

    # name -> (parameter, its value at size 1, first size tried, largest)
    simple = {
        "coulomb_friction": ("torque_Nm", s.torque, 0.05, 0.6),
        "viscous_friction": ("coefficient_Nms", s.viscous, 0.5, 20.0),
        "backlash": ("gap_rad", 1.0, 0.01, 0.06),
        "actuator_dead_zone": ("width_V", s.voltage, 0.03, 0.7),
        "actuator_lag": ("time_constant_s", s.dt, 0.5, 12.0),
        "sensor_lag": ("time_constant_s", s.dt, 0.5, 12.0),
        "input_delay": ("delay_s", s.dt, 0.5, 8.0),
        "tip_payload": ("mass_kg", s.link_mass, 0.05, 1.5),
        "hardening_spring": ("cubic_Nm_rad3", s.inertia, 5.0, 3000.0),
        "gravity": ("acceleration_m_s2", 1.0, 0.05, 9.81),
        "sensor_drift": ("rate_m_s", sign * s.tip_noise, 0.5, 20.0),
        "quantisation": ("step_m", s.tip_noise, 3.0, 60.0),
        "air_drag": ("coefficient_Ns2_m3", 4 * (s.viscous + s.braking) / s.length**4, 0.1, 20.0),
        "ground_spring": ("stiffness_Nm_rad", s.inertia, 0.1, 60.0),
        "winding_heat": ("rate_1_s", 1.0, 0.03, 0.3),
        # Monotone up to the largest voltage also with a falling gain.
        "amplifier_cubic": ("cubic_1_V2", sign / s.peak**2, 0.05, 0.3),
    }
    ratios = {
        "actuator_gain": (0.1, 1.0),
        "hub_inertia": (0.1, 1.0),
        "link_stiffness": (0.05, 1.0),
        "structural_damping": (1.0, 9.0),
        "sensor_gain": (0.02, 0.5),
    }
    if name in simple:
        parameter, unit, first, largest = simple[name]
        return growing(first, largest, {}, **{parameter: unit})
    if name in ratios:
        return Sizable(name, *ratios[name], ratio)
    if name == "stribeck_friction":
        share = rng.uniform(0.35, 0.75)
        speed = log(0.02, 0.3)
        levels = {"static_torque_Nm": s.torque, "coulomb_torque_Nm": share * s.torque}
        return growing(0.05, 0.8, {"stribeck_velocity_rad_s": speed}, **levels)
    if name == "actuator_saturation":
        return Sizable(name, 0.2, 3.0, lambda size: {"limit_V": s.peak * np.exp(-size)})
    if name == "torque_ripple":
        turning = {"cycles_per_rev": float(rng.integers(4, 41)), "phase_rad": phase}
        return growing(0.05, 0.5, turning, amplitude_Nm=s.torque)
    if name == "joint_compliance":
        time = log(0.0005, 0.003)
        return Sizable(
            name,
            0.1,
            1.5,
            lambda size: {
                "stiffness_Nm_rad": s.link_spring / size,
                "damping_Nms": time * s.link_spring / size,
            },
        )
    if name == "periodic_disturbance":
        tone = {"frequency_Hz": log(0.5, 12.0), "phase_rad": phase}
        return growing(0.05, 1.0, tone, amplitude_Nm=s.torque)
    if name == "base_compliance":
        base = s.inertia * log(0.3, 3.0)
        damping = rng.uniform(0.03, 0.15)
        # Size 1: the base swings at 6 Hz.
        stiffness = (s.inertia + base) * (2 * pi * 6.0) ** 2

        def compliant(size: float) -> Table:
            k = stiffness / size
            return {
                "stiffness_Nm_rad": k,
                "damping_Nms": 2 * damping * np.sqrt(k * (s.inertia + base)),
                "inertia_kg_m2": base,
            }

        return Sizable(name, 0.3, 8.0, compliant)
    if name == "cogging":
        turning = {"cycles_per_rev": float(rng.integers(6, 31)), "phase_rad": phase}
        return growing(0.1, 0.7, turning, relative_amplitude=1.0)
    if name == "inductance":
        return Sizable(
            name,
            0.3,
            3.0,
            lambda size: {
                "inductance_H": size * s.resistance * s.dt,
                "current_limit_A": s.peak / s.resistance * np.exp(-size),
            },
        )
    if name == "asymmetric_friction":
        uneven = sign * rng.uniform(0.3, 0.8)
        levels = {"positive": s.torque * (1 + uneven), "negative": s.torque * (1 - uneven)}
        return growing(0.05, 0.6, {}, **{f"torque_{side}_Nm": level for side, level in levels.items()})
    if name == "sensor_clipping":
        return Sizable(name, 0.2, 2.0, lambda size: {"limit_m": s.tip_peak * np.exp(-size)})
    if name == "encoder_eccentricity":
        # Phases that would mostly scale the angle are left out: a gain is another effect.
        offset = 0.5 * pi * sign + rng.uniform(-0.6, 0.6)
        return growing(0.03, 0.5, {"phase_rad": offset}, amplitude_rad=1.0)
    raise ValueError(f"unknown effect {name!r}; known: {', '.join(LISTED + UNLISTED)}")


def _scales(rig: RigTable, plans: tuple[Planned, ...]) -> SimpleNamespace:
    """Magnitudes of a rig and its planned voltages, SI units."""
    link = rig["link"]
    bending = link["youngs_modulus_Pa"] * link["width_m"] * link["thickness_m"] ** 3 / 12
    rms = float(np.median([np.sqrt(np.mean(p.voltage_V**2)) for p in plans if p.feedback is None]))
    known = magnitudes(rig)
    return SimpleNamespace(
        **vars(known),
        voltage=rms,
        peak=max(float(np.max(np.abs(p.voltage_V))) for p in plans),
        torque=known.per_volt * rms,
        link_spring=3 * bending / link["length_m"],
        length=link["length_m"],
        resistance=rig["motor"]["resistance_ohm"],
        dt=rig["sampling"]["dt_s"],
        tip_noise=rig["sensors"]["tip_noise_m"],
        tip_peak=(rig["hub"]["radius_m"] + link["length_m"]) * 0.35,
    )
