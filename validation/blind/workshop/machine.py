"""A workshop's machine: stated and true values, what no data sheet mentions, and how it is measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi
from typing import Literal

import numpy as np

from validation.blind.rigs import Rig, draw_rig, log_uniform, off, rounded
from validation.blind.truth import Background, Real

Sensor = Literal["none", "tip", "acc"]
# Second sensors: none, the tip position, its acceleration.
SENSORS: tuple[Sensor, ...] = ("none", "tip", "acc")

# Relative standard deviations are drawn between these.
_TOLERANCES = {
    "link.density_kg_m3": (0.02, 0.045),
    "link.youngs_modulus_Pa": (0.02, 0.06),
    "link.kelvin_voigt_s": (0.06, 0.12),
    "hub.inertia_kg_m2": (0.03, 0.075),
    "hub.viscous_friction_Nms": (0.06, 0.1),
    "motor.torque_constant_Nm_A": (0.02, 0.06),
    "motor.back_emf_Vs_rad": (0.04, 0.07),
    "motor.resistance_ohm": (0.03, 0.05),
    "payload.mass_kg": (0.025, 0.05),
}
# Transport delay over the sampling period, as stated.
_DELAY = 0.75
# Its relative tolerance.
_DELAY_TOLERANCE = 0.2
# How often a value may be `_FARTHEST` tolerances off; else two.
_FAR = 0.1
# Tolerances by which a value is off at most, then.
_FARTHEST = 3.0
# Sampling period, and rows of a record.
_ROWS = {0.002: (2100, 3000), 0.004: (1050, 1600), 0.005: (850, 1300), 0.01: (800, 900)}


@dataclass(frozen=True)
class Noise:
    """What the sensors add: standard deviations of white hub noise and coloured tip noise, and hum.

    correlation: of neighbouring tip samples. jitter: time stamps are off by about a hundredth of a period.
    """

    hub: float
    tip: float
    correlation: float
    hum: float
    hum_Hz: float
    jitter: bool

    def draw(self, rows: int, dt_s: float, rng: np.random.Generator) -> tuple[Real, Real]:
        """(T,) of the hub, (T,) of the tip."""
        white = rng.standard_normal(rows)
        tip = np.empty(rows)
        last = rng.standard_normal()
        for k in range(rows):
            last = self.correlation * last + np.sqrt(1 - self.correlation**2) * white[k]
            tip[k] = last
        hum = self.hum * np.sin(2 * pi * (self.hum_Hz * dt_s * np.arange(rows) + rng.random()))
        return self.hub * rng.standard_normal(rows), self.tip * (tip + hum)


@dataclass(frozen=True)
class Workshop:
    """stated, true: the nominal and the real rig. counts: encoder steps per turn."""

    stated: Rig
    true: Rig
    tolerances: dict[str, float]
    background: Background
    noise: Noise
    counts: int
    sensor: Sensor
    rows: tuple[int, int]

    @property
    def outputs(self) -> list[str]:
        """Names of the measured quantities in the files."""
        tip = {"none": [], "tip": ["tip_m"], "acc": ["tip_acceleration_m_s2"]}
        return ["hub_angle_rad", *tip[self.sensor]]

    def scaled(self, factor: float) -> Background:
        """Friction, cogging and tilt times this; lag and encoder as they are."""
        b = self.background
        return replace(
            b,
            dry_friction_Nm=rounded(factor * b.dry_friction_Nm),
            cogging_Nm=rounded(factor * b.cogging_Nm),
            tilt_m_s2=rounded(factor * b.tilt_m_s2),
        )


def draw_workshop(sensor: Sensor, rng: np.random.Generator) -> Workshop:
    """A machine; friction, cogging and tilt are relative to each other only (see `Workshop.scaled`)."""

    def log(low: float, high: float) -> float:
        return rounded(log_uniform(rng, low, high))

    nominal = draw_rig(rng)
    dt = float(rng.choice(list(_ROWS)))
    nominal["sampling"] = {"dt_s": dt, "transport_delay_s": _DELAY * dt}
    nominal["sensors"] = {"hub_angle_noise_rad": rounded(log(0.0003, 0.0016), 2)}
    if sensor == "tip":
        nominal["sensors"]["tip_noise_m"] = rounded(log(0.0006, 0.0015), 2)
    if sensor == "acc":
        nominal["sensors"]["tip_acceleration_noise_m_s2"] = rounded(log(0.02, 0.15), 2)
    tolerances = {key: round(rng.uniform(*ends), 3) for key, ends in _TOLERANCES.items()}
    if nominal["payload"]["mass_kg"] == 0:
        del tolerances["payload.mass_kg"]
    tolerances["sampling.transport_delay_s"] = _DELAY_TOLERANCE
    true: Rig = {section: dict(values) for section, values in nominal.items()}
    for key, tolerance in tolerances.items():
        largest_draw = _FARTHEST if rng.random() < _FAR else 2.0
        off(true, key, tolerance, largest_draw, 6, rng)
    counts = round(log(2200, 18500))
    drag = nominal["hub"]["viscous_friction_Nms"]
    # Of a scale that the caller sets: torques of some tenths of the viscous one at a radian per second.
    background = Background(
        dry_friction_Nm=drag * log(0.3, 1.0),
        presliding_rad=log(0.0003, 0.002),
        cogging_Nm=drag * log(0.08, 0.4),
        cogging_per_rev=float(rng.integers(12, 60)),
        cogging_phase_rad=rounded(rng.uniform(0, 2 * pi)),
        amplifier_lag_s=log(0.0003, 0.0015),
        tilt_m_s2=log(0.02, 0.08),
        tilt_angle_rad=rounded(rng.uniform(-pi, pi)),
        hub_offset_rad=rounded(rng.uniform(-pi, pi)),
        encoder_step_rad=2 * pi / counts,
    )
    noise = Noise(
        hub=rounded(nominal["sensors"]["hub_angle_noise_rad"] * log(0.65, 1.5)),
        tip=rounded(list(nominal["sensors"].values())[-1] * log(0.65, 1.5)) if sensor != "none" else 0.0,
        correlation=rounded(rng.uniform(0.35, 0.88)),
        hum=rounded(rng.uniform(0.05, 0.85)),
        hum_Hz=rounded(50 + 0.05 * rng.standard_normal()),
        jitter=bool(rng.random() < 0.4),
    )
    return Workshop(nominal, true, tolerances, background, noise, counts, sensor, _ROWS[dt])
