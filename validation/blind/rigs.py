"""Random arms: every parameter of a rig drawn around machines that exist, and what its makers would state."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import numpy as np

from validation.blind.truth import RigTable

Rig = dict[str, dict[str, float]]

# Relative standard deviations as a builder of such arms would state them.
TOLERANCES = {
    "hub.inertia_kg_m2": 0.05,
    "link.youngs_modulus_Pa": 0.03,
    "link.density_kg_m3": 0.02,
    "link.kelvin_voigt_s": 0.3,
    "hub.viscous_friction_Nms": 0.3,
    "motor.torque_constant_Nm_A": 0.05,
    "motor.back_emf_Vs_rad": 0.05,
    "motor.resistance_ohm": 0.03,
}
# Stated values are off by at most this many tolerances.
_LARGEST_DRAW = 2.0
# (density, Young's modulus): aluminium, steel, brass, glass fibre.
_MATERIALS = ((2700.0, 69e9), (7850.0, 205e9), (8500.0, 105e9), (1900.0, 40e9))
# How often each material is drawn.
_SHARES = (0.4, 0.4, 0.1, 0.1)
# First root of cos x cosh x = -1: the lowest mode of a clamped beam.
_FIRST_CLAMPED = 1.8751


def rounded(value: float, digits: int = 4) -> float:
    """Significant digits: what a file states is what was simulated."""
    return float(f"{value:.{digits}g}")


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Drawn evenly in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def off(table: Rig, key: str, tolerance: float, most: float, digits: int, rng: np.random.Generator) -> None:
    """Move a value by its tolerance times a standard normal number, redrawn beyond `most`."""
    d = rng.standard_normal()
    while abs(d) > most:
        d = rng.standard_normal()
    section, name = key.split(".")
    table[section][name] = rounded(table[section][name] * (1 + tolerance * d), digits)


def draw_rig(rng: np.random.Generator) -> Rig:
    """An arm of 0.4 to 1.2 m whose first flexible mode lies between 2 and 20 Hz."""
    log = partial(log_uniform, rng)
    density, modulus = _MATERIALS[int(rng.choice(len(_MATERIALS), p=_SHARES))]
    density = density * rng.uniform(0.93, 1.07)
    modulus = modulus * rng.uniform(0.93, 1.07)
    while True:
        length = rng.uniform(0.4, 1.2)
        clamped = log(1.5, 7.0)
        speed = np.sqrt(modulus / density)
        thickness = 2 * np.pi * clamped * length**2 * np.sqrt(12) / (_FIRST_CLAMPED**2 * speed)
        if 0.0008 <= thickness <= 0.012:
            break
    width = rng.uniform(0.015, 0.04) if thickness < 0.0025 else thickness * log(1.0, 3.5)
    mass = density * width * thickness * length
    payload = 0.0 if rng.random() < 0.6 else mass * rng.uniform(0.05, 0.4)
    radius = rng.uniform(0.03, 0.08)
    link_inertia = mass * (length**2 / 3 + radius * length + radius**2) + payload * (radius + length) ** 2
    inertia = link_inertia * log(0.3, 1.0)
    gear = rng.uniform(15, 40)
    resistance = rng.uniform(1.2, 4.0)
    # Motor time constant of the whole arm.
    braking = (inertia + link_inertia) / log(0.12, 0.4)
    constant = np.sqrt(braking * resistance) / gear
    viscous = braking * log(0.03, 0.12)
    # Damping of the first mode when the hub is held; on a free hub it is faster and better damped.
    damping = 2 * log(0.004, 0.02) / (2 * np.pi * clamped)
    table = {
        "link": {
            "length_m": length,
            "width_m": width,
            "thickness_m": thickness,
            "density_kg_m3": density,
            "youngs_modulus_Pa": modulus,
            "kelvin_voigt_s": min(damping, 0.002),
        },
        "hub": {"inertia_kg_m2": inertia, "radius_m": radius, "viscous_friction_Nms": viscous},
        "motor": {
            "torque_constant_Nm_A": constant,
            "back_emf_Vs_rad": constant,
            "resistance_ohm": resistance,
            "gear_ratio": gear,
        },
        "payload": {"mass_kg": payload},
        "sensors": {"hub_angle_noise_rad": log(0.0006, 0.0015), "tip_noise_m": log(0.0006, 0.0015)},
        "sampling": {"dt_s": 0.005 if rng.random() < 0.75 else 0.004},
    }
    return {
        section: {key: rounded(float(value)) for key, value in values.items()}
        for section, values in table.items()
    }


def magnitudes(rig: RigTable) -> SimpleNamespace:
    """Mass of the link, inertia at the hub when all is stiff, torque per volt and braking of the motor."""
    link = rig["link"]
    hub = rig["hub"]
    motor = rig["motor"]
    L = link["length_m"]
    r = hub["radius_m"]
    mass = link["density_kg_m3"] * link["width_m"] * link["thickness_m"] * L
    inertia = hub["inertia_kg_m2"] + mass * (L**2 / 3 + r * L + r**2)
    per_volt = motor["gear_ratio"] * motor["torque_constant_Nm_A"] / motor["resistance_ohm"]
    return SimpleNamespace(
        link_mass=mass,
        inertia=inertia + rig["payload"]["mass_kg"] * (r + L) ** 2,
        per_volt=per_volt,
        braking=per_volt * motor["gear_ratio"] * motor["back_emf_Vs_rad"],
        viscous=hub["viscous_friction_Nms"],
    )


def draw_tolerances(rng: np.random.Generator) -> dict[str, float]:
    """Half of the makers state the usual tolerances, the others their own: 0.6 to 1.6 times as large.

    None beyond 30 %: two tolerances then still leave 40 % of the value.
    """
    if rng.random() < 0.5:
        return dict(TOLERANCES)
    return {key: round(min(value * rng.uniform(0.6, 1.6), 0.3), 3) for key, value in TOLERANCES.items()}


def stated(rig: RigTable, tolerances: dict[str, float], rng: np.random.Generator) -> Rig:
    """The rig as its makers know it: true (1 + t d) with d standard normal, redrawn beyond two tolerances."""
    table: Rig = {section: dict(values) for section, values in rig.items()}
    for key, tolerance in tolerances.items():
        off(table, key, tolerance, _LARGEST_DRAW, 5, rng)
    return table


def rig_toml(rig: RigTable, tolerances: dict[str, float] | None = None) -> str:
    """Text of a rig file."""
    known = ", known only to the tolerances below" if tolerances else ""
    lines = [f"# nominal rig{known}; SI units, given in the key names"]
    for section, values in rig.items():
        lines += ["", f"[{section}]", *(f"{key} = {float(value)!r}" for key, value in values.items())]
    if tolerances:
        lines += ["", "# relative standard deviations of the values above; what is not listed is exact"]
        lines += ["[tolerances]", *(f'"{key}" = {value!r}' for key, value in tolerances.items())]
    return "\n".join(lines) + "\n"
