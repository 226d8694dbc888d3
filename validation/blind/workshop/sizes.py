"""Major effects of workshop cases: what is drawn, how large it may get, when it exceeds a tolerance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import pi
from types import MappingProxyType

import numpy as np

from validation.blind.inputs import Planned
from validation.blind.rigs import Rig, rounded
from validation.blind.sizes import NOT_TOGETHER, PARAMETRIC, Sizable, Table, sizable
from validation.blind.truth import LISTED, UNLISTED, WORKSHOP_UNLISTED, RigTable
from validation.blind.workshop.machine import Sensor

# Effects of a tip sensor.
TIP_ONLY = frozenset({"sensor_lag", "sensor_gain", "sensor_drift", "quantisation", "sensor_clipping"})
# Effects whose size has an end of its own; the others may grow beyond what the noise-sized cases need.
_BOUNDED = frozenset(
    {
        "actuator_saturation",
        "actuator_dead_zone",
        "cogging",
        "amplifier_cubic",
        "winding_heat",
        "encoder_eccentricity",
        "sensor_clipping",
        "inductance",
        "asymmetric_dead_zone",
    }
)
# Largest sizes here, over those of the noise-sized cases.
_LARGER = 8.0
# Tolerances by which a parametric effect is off at least.
LEAST_TOLERANCES = 5.0
# Pairs that no record of a workshop could tell from one of them.
_NEVER = (*NOT_TOGETHER, {"joint_compliance", "base_compliance"}, {"sensor_gain", "sensor_lag"})


def listed(sensor: Sensor) -> list[str]:
    """Effects of the list that this machine's sensors can show."""
    return [name for name in LISTED if sensor == "tip" or name not in TIP_ONLY]


def unlisted(sensor: Sensor) -> list[str]:
    """Causes outside the list; the encoder's error is seen everywhere."""
    return [name for name in UNLISTED + WORKSHOP_UNLISTED if sensor == "tip" or name not in TIP_ONLY]


def partners(name: str, sensor: Sensor) -> list[str]:
    return [other for other in listed(sensor) if other != name and {other, name} not in _NEVER]


def of_size(name: str, rig: RigTable, plans: tuple[Planned, ...], rng: np.random.Generator) -> Sizable:
    """An effect with everything but its size drawn, see `validation.blind.sizes.sizable`.

    Sizes may be larger than there, and the causes that only workshops have are known, too.
    """
    # Scales of the noise-sized cases refer to a tip sensor.
    sensed: Rig = {section: dict(values) for section, values in rig.items()}
    sensed["sensors"].setdefault("tip_noise_m", 0.001)
    if name not in WORKSHOP_UNLISTED:
        effect = sizable(name, sensed, plans, rng)
        if name in _BOUNDED:
            return effect
        return replace(effect, largest=_LARGER * effect.largest)
    rms = float(np.median([np.sqrt(np.mean(p.voltage_V**2)) for p in plans]))
    sign = float(rng.choice([-1.0, 1.0]))
    hub = rig["hub"]
    if name == "gear_drag":
        unit = hub["viscous_friction_Nms"]
        return Sizable(name, 0.5, 100.0, lambda size: {"coefficient_Nms2": size * unit})
    if name == "asymmetric_dead_zone":
        wide, narrow = ("positive_V", "negative_V")[:: int(sign)]
        share = rng.uniform(0.1, 0.4)
        return Sizable(name, 0.05, 1.0, lambda size: {wide: size * rms, narrow: share * size * rms})
    if name == "slew_limit":
        # Size 1: from zero to the usual voltage in 50 ms.
        return Sizable(name, 0.3, 20.0, lambda size: {"rate_V_s": rms / (0.05 * size)})
    frequency = rng.uniform(2.0, 6.0)
    damping = rng.uniform(0.02, 0.08)

    def attached(size: float) -> Table:
        inertia = size * hub["inertia_kg_m2"]
        omega = 2 * pi * frequency
        return {
            "inertia_kg_m2": inertia,
            "stiffness_Nm_rad": inertia * omega**2,
            "damping_Nms": 2 * damping * inertia * omega,
        }

    return Sizable(name, 0.3, 8.0, attached)


# Relative changes of stated values that an effect amounts to.
_CHANGES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {**PARAMETRIC, "tip_payload": ("payload.mass_kg",), "input_delay": ("sampling.transport_delay_s",)}
)


def tolerances_away(effect: Table, rig: Rig, tolerances: Mapping[str, float]) -> float | None:
    """Size of an effect that is only another stated value, in tolerances; None for all others."""
    name = effect["name"]
    keys = [key for key in _CHANGES.get(name, ()) if key in tolerances]
    if not keys:
        return None
    spread = float(np.sqrt(sum(tolerances[key] ** 2 for key in keys)))
    section, parameter = keys[0].split(".")
    added = next((effect[p] for p in ("coefficient_Nms", "mass_kg", "delay_s") if p in effect), None)
    if added is not None:
        return rounded(abs(added) / rig[section][parameter] / spread)
    return rounded(abs(effect["ratio"] - 1) / spread)
