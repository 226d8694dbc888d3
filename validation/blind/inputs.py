"""The six experiments of a case: random binary voltages, multisine, doublet, and a slew under PD control."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from validation.blind.rigs import magnitudes
from validation.blind.truth import Feedback, Real, Truth

# Samples of a period of the multisine.
_PERIOD = 700


@dataclass(frozen=True, eq=False)
class Planned:
    """One experiment before it is run; a slew has a feedback in place of a voltage (zeros of its length)."""

    name: str
    kind: str
    role: str
    description: str
    voltage_V: Real
    feedback: Feedback | None = None


def plan_experiments(truth: Truth, rng: np.random.Generator) -> tuple[Planned, ...]:
    """Six experiments whose amplitudes keep hub angle and deflection of the given machine small.

    `truth` is the machine without effects: amplitudes are those its makers would have chosen for it.
    """
    length = truth.rig["link"]["length_m"]
    arm = truth.rig["hub"]["radius_m"] + length

    def scaled(shape: Real, angle_rad: float, share: float) -> Real:
        """Largest hub angle and largest deflection over the length, whichever is reached first."""
        unit = truth.record(1e-2 * shape)
        angle = float(np.max(np.abs(unit.hub_angle_rad)))
        bend = float(np.max(np.abs(unit.tip_m - arm * unit.hub_angle_rad))) / length
        return np.asarray(np.round(1e-2 * shape * min(angle_rad / angle, share / bend), 4))

    T = 1400
    dt = truth.dt_s
    angles = rng.uniform(0.09, 0.15), rng.uniform(0.17, 0.35), rng.uniform(0.15, 0.23)
    low, high, fresh = (scaled(_binary(T, rng), angle, 0.065) for angle in angles)
    multisine = scaled(_multisine(dt, rng), rng.uniform(0.12, 0.25), rng.uniform(0.04, 0.07))
    doublet = scaled(_doublet(dt, rng), rng.uniform(0.15, 0.3), rng.uniform(0.04, 0.07))
    slew = _slew(truth, 1200, rng)
    periods = "random-phase multisine, two identical periods of 700 samples"
    pulses = "voltage doublet, then zero volts (free decay)"
    medium = "random binary voltage, medium amplitude, fresh sequence"
    motion = "smooth point-to-point slew under PD control of the measured hub angle (closed loop)"
    return (
        Planned("01_prbs_low", "prbs", "estimation", "random binary voltage, low amplitude", low),
        Planned("02_prbs_high", "prbs", "estimation", "random binary voltage, high amplitude", high),
        Planned("03_multisine", "multisine", "estimation", periods, multisine),
        Planned("04_doublet_decay", "doublet", "estimation", pulses, doublet),
        Planned("05_prbs_fresh", "prbs", "held_out", medium, fresh),
        Planned("06_slew_closed_loop", "slew", "held_out", motion, np.zeros(1200), slew),
    )


def _binary(T: int, rng: np.random.Generator) -> Real:
    """A random binary signal (T,): +-1, each held for a drawn number of samples; zero in the first row."""
    hold = int(rng.integers(2, 5))
    bits = rng.integers(0, 2, -(-T // hold))
    voltage = np.where(np.repeat(bits, hold)[:T] == 1, 1.0, -1.0)
    voltage[0] = 0.0
    return voltage


def _multisine(dt_s: float, rng: np.random.Generator) -> Real:
    """Two periods of a random-phase multisine with all lines up to 35 Hz, largest value 1.

    It is weaker at the first lines, which turn the hub most.
    """
    lines = np.arange(1, int(35.0 * _PERIOD * dt_s) + 1)
    size = np.minimum(lines / 3.5, 1.0) / np.sqrt(1 + (lines / 46.0) ** 2)
    spectrum = np.zeros(_PERIOD // 2 + 1, dtype=np.complex128)
    spectrum[lines] = size * np.exp(2j * np.pi * rng.random(lines.size))
    period = np.fft.irfft(spectrum, _PERIOD)
    return np.tile(period / np.max(np.abs(period)), 2)


def _doublet(dt_s: float, rng: np.random.Generator) -> Real:
    voltage = np.zeros(1000)
    pulse = round(rng.uniform(0.12, 0.18) / dt_s)
    sign = rng.choice([-1.0, 1.0])
    voltage[20 : 20 + pulse] = sign
    voltage[20 + pulse : 20 + 2 * pulse] = -sign * rng.uniform(0.6, 0.85)
    return voltage


def _slew(truth: Truth, T: int, rng: np.random.Generator) -> Feedback:
    """Out and part of the way back along smooth references; bandwidth well below the first mode."""
    known = magnitudes(truth.rig)
    braking = known.braking + known.viscous
    bandwidth = rng.uniform(2.5, 4.0)
    proportional = known.inertia * bandwidth**2 / known.per_volt
    derivative = max(2 * 0.8 * bandwidth * known.inertia - braking, 0.02 * braking) / known.per_volt
    target = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 0.42)
    back = target * rng.uniform(-0.5, 0.5)
    reference = np.zeros(T)
    begin = int(rng.integers(80, 150))
    first = int(rng.integers(150, 300))
    again = int(rng.integers(560, 680))
    second = int(rng.integers(150, 300))
    rows = np.arange(T)
    reference += target * _smooth((rows - begin) / first)
    reference += (back - target) * _smooth((rows - again) / second)
    return Feedback(reference, proportional, derivative, float(np.exp(-1 / rng.uniform(2.0, 5.0))))


def _smooth(x: Real) -> Real:
    """Minimum-jerk step from 0 to 1 over 0 <= x <= 1."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10 - 15 * x + 6 * x**2))
