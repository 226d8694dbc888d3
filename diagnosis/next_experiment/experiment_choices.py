"""Experiments worth choosing from: excitations of the usual kinds within the limits of a machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.signal import sawtooth

from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import Real
from ident.data.arrays import lock
from plant.excitation import Grid, doublet, log_chirp, multisine, multisine_lines, prbs

Integer = npt.NDArray[np.int64]
Parameters = Mapping[str, float | int | str]


@dataclass(frozen=True)
class Limits:
    """What an experiment may ask of the machine.

    voltage_V : float. Largest commanded voltage.
    hub_angle_rad : float. Largest deviation of the hub angle from the start.
    deflection_m : float. Largest deflection of the tip, tip_m - (r + L) hub_angle.
    """

    voltage_V: float
    hub_angle_rad: float = np.inf
    deflection_m: float = np.inf

    def __post_init__(self) -> None:
        for name in ("voltage_V", "hub_angle_rad", "deflection_m"):
            if not getattr(self, name) > 0:
                raise ValueError(f"limit {name} must be positive; got {getattr(self, name)}")

    @classmethod
    def of_records(cls, case: Case) -> Limits:
        """What the machine has already done: the largest voltage, hub angle and deflection of the records.

        Beside a model error, where zeros and starts are unknown, from the start and about the mean. The
        deflection is the measured one less three deviations of its noise; without a tip position it has no
        limit.
        """
        reach = case.rig.hub.radius_m + case.rig.link.length_m
        hubs = [x.output[:, 0] - (x.output[0, 0] if case.model_error > 0 else 0.0) for x in case.experiments]
        voltage = max(float(np.max(np.abs(x.voltage_V))) for x in case.experiments)
        angle = max(float(np.max(np.abs(hub))) for hub in hubs)
        if "tip_m" not in case.outputs:
            return cls(voltage, angle)
        tip = case.outputs.index("tip_m")
        noise = float(np.hypot(case.noise[tip], reach * case.noise[0]))
        bends = [x.output[:, tip] - reach * x.output[:, 0] for x in case.experiments]
        bends = [bend - np.mean(bend) if case.model_error > 0 else bend for bend in bends]
        return cls(voltage, angle, max(max(float(np.max(np.abs(bend))) for bend in bends) - 3 * noise, noise))


@dataclass(frozen=True, eq=False)
class Excitation:
    """One experiment: voltage (T,) of a kind with its parameters; `amplitude_V` is its largest value."""

    kind: str
    parameters: Parameters
    voltage_V: Real

    def __post_init__(self) -> None:
        lock(self, "voltage_V")

    @property
    def amplitude_V(self) -> float:
        return float(np.max(np.abs(self.voltage_V)))

    def scaled(self, factor: float) -> Excitation:
        return replace(self, voltage_V=self.voltage_V * factor)


def excitations(
    voltage_V: float, n_samples: int, dt_s: float, rng: np.random.Generator
) -> tuple[Excitation, ...]:
    """Ten excitations (T,) of equal length and largest voltage.

    Random binary (fast, slow), multisine (wide, odd lines at low frequency), doublet (short, long), slow
    triangle through reversals, steps with rests, chirp (up, and slow alone).

    Raises ValueError: fewer than 100 samples, or a voltage or period that is not positive.
    """
    if not n_samples >= 100:
        raise ValueError(f"an experiment needs at least 100 samples; got {n_samples}")
    if not (0 < voltage_V < np.inf and 0 < dt_s < np.inf):
        raise ValueError(f"need a positive voltage and sampling period; got {voltage_V} V and {dt_s} s")
    T, nyquist, duration = n_samples, 0.5 / dt_s, n_samples * dt_s
    return (
        _binary(voltage_V, T, 4, rng),
        _binary(voltage_V, T, max(T // 60, 5), rng),
        _multisine(voltage_V, T, dt_s, 0.35 * nyquist, "full", rng),
        _multisine(voltage_V, T, dt_s, 0.06 * nyquist, "odd_random", rng),
        _doublet(voltage_V, T, dt_s, T // 40),
        _doublet(voltage_V, T, dt_s, T // 6),
        Excitation(
            "triangle",
            {"period_s": round(T * dt_s / 3, 6)},
            voltage_V * sawtooth(2 * np.pi * (np.arange(T) * 3 / T) + np.pi / 2, 0.5),
        ),
        _steps(voltage_V, T, dt_s, 8, rng),
        _chirp(voltage_V, T, dt_s, 1 / duration, 0.6 * nyquist),
        _chirp(voltage_V, T, dt_s, 0.5 / duration, 0.05 * nyquist),
    )


# Kinds that are also tried at a third of what the limits allow: dry friction, backlash and dead zones weigh
# more in small motions.
ALSO_WEAK = ("random binary", "triangle")


def within(
    excitation: Excitation, limits: Limits, respond: Callable[[Real], tuple[float, float]]
) -> Excitation | None:
    """The excitation, scaled down until its largest hub angle and deflection stay in the limits.

    respond gives both for a voltage (T,). Five scalings at most (a nonlinear machine does not scale exactly);
    None if the last is still outside or below a hundredth of the voltage limit.
    """
    if excitation.amplitude_V > limits.voltage_V * (1 + 1e-9):
        excitation = excitation.scaled(limits.voltage_V / excitation.amplitude_V)
    for _ in range(5):
        angle, deflection = respond(excitation.voltage_V)
        excess = max(angle / limits.hub_angle_rad, deflection / limits.deflection_m)
        if not np.isfinite(excess):
            return None
        if excess <= 1:
            return excitation
        excitation = excitation.scaled(0.95 / excess)
        if excitation.amplitude_V < 0.01 * limits.voltage_V:
            return None
    return None


def tailored_excitations(
    lines: Integer, n_samples: int, dt_s: float, voltage_V: float, rng: np.random.Generator
) -> list[Excitation]:
    """Multisine of the given lines, two periods, and the binary signal of its signs, which has more power."""
    period = n_samples // 2
    signal = _two_periods(lines, n_samples, rng)
    parameters: Parameters = {
        "from_Hz": round(float(lines[0] / (period * dt_s)), 3),
        "to_Hz": round(float(lines[-1] / (period * dt_s)), 3),
        "lines": int(lines.size),
    }
    return [
        Excitation("tailored multisine", parameters, signal * (voltage_V / np.max(np.abs(signal)))),
        Excitation("tailored binary", parameters, voltage_V * np.where(signal >= 0, 1.0, -1.0)),
    ]


def _binary(voltage: float, T: int, hold: int, rng: np.random.Generator) -> Excitation:
    length = int(np.clip(np.ceil(np.log2(T / hold + 1)), 4, 20))
    return Excitation("random binary", {"hold_samples": hold}, prbs(length, hold, voltage, T, rng))


def _multisine(
    voltage: float, T: int, dt: float, high_Hz: float, grid: Grid, rng: np.random.Generator
) -> Excitation:
    period = T // 2
    low = 0.99 / (period * dt)
    lines = multisine_lines(period, dt, (low, max(high_Hz, 12 * low)), grid, rng)
    signal = _two_periods(lines, T, rng)
    parameters: Parameters = {
        "lines": grid.replace("_", " "),
        "up_to_Hz": round(float(lines[-1] / (period * dt)), 3),
        "periods": 2,
    }
    return Excitation("multisine", parameters, signal * (voltage / np.max(np.abs(signal))))


def _two_periods(lines: Integer, T: int, rng: np.random.Generator) -> Real:
    return np.resize(multisine(lines, T // 2, 1.0, rng, periods=2, draws=20), T)


def _doublet(voltage: float, T: int, dt: float, pulse: int) -> Excitation:
    pulse = max(pulse, 2)
    return Excitation("doublet", {"pulse_s": round(pulse * dt, 6)}, doublet(voltage, 0.0, pulse * dt, T, dt))


def _steps(voltage: float, T: int, dt: float, count: int, rng: np.random.Generator) -> Excitation:
    """Steps of different height, each one followed by its negative and a rest, so that the hub comes back."""
    heights = voltage * rng.permutation(np.linspace(1, 0.25, count // 2))
    length = T // (3 * heights.size)
    pattern = np.concatenate([np.repeat([h, -h, 0.0], length) for h in heights])
    signal = np.concatenate([pattern, np.zeros(T - pattern.size)])
    return Excitation("step and hold", {"hold_s": round(length * dt, 6)}, signal)


def _chirp(voltage: float, T: int, dt: float, low_Hz: float, high_Hz: float) -> Excitation:
    high = max(high_Hz, 4 * low_Hz)
    parameters = {"from_Hz": round(low_Hz, 4), "to_Hz": round(high, 4)}
    return Excitation("chirp", parameters, log_chirp(low_Hz, high, voltage, T, dt))
