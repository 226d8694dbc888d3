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

# Samples of an experiment at least: its slow kinds have twelve parts, and each needs some samples.
_LEAST_SAMPLES = 100
# Standard deviations of its noise that a deflection is measured too large by at most.
_NOISE_OF_LARGEST = 3.0
# Samples for which the fast binary signal holds: a quarter of the sampling rate, which drives still follow.
_FAST_HOLD = 4
# Changes of the slow one in a record at most: enough for its spectrum to be flat below them.
_SLOW_CHANGES = 60
# Samples for which it holds at least: more than the fast one.
_LEAST_SLOW_HOLD = 5
# Highest line of the wide multisine over the Nyquist frequency: where delays and modes show. Chosen.
_WIDE = 0.35
# Highest line of the slow one: where friction and springs show. Chosen.
_SLOW = 0.06
# End of the chirp that goes up, over the Nyquist frequency: above most modes that a log can show. Chosen.
_CHIRP_WIDE = 0.6
# End of the slow chirp: as the slow multisine.
_CHIRP_SLOW = 0.05
# The pulse of the short doublet is this part of a record: a push, as of a hand.
_SHORT_PULSES = 40
# That of the long one: the machine comes to its steady motion in it.
_LONG_PULSES = 6
# Periods of the triangle in a record: six reversals, each slow enough for friction to show.
_TRIANGLES = 3
# Steps of the record with rests: four heights, each with its negative.
_STEPS = 8
# Smallest of these heights over the largest: where dry friction weighs most.
_LOWEST_STEP = 0.25
# Draws of phases of a multisine, of which the flattest signal is taken.
_DRAWS = 20
# Rounds of scaling an excitation into its limits: a nonlinear machine does not scale exactly.
_SCALINGS = 5
# What an excitation is scaled to, as a part of the limit it exceeds.
_INSIDE = 0.95
# Part of the voltage limit below which an excitation is of no use.
_LEAST_VOLTAGE = 0.01


@dataclass(frozen=True)
class Limits:
    """What an experiment may ask of the machine; a ValueError where one is not positive.

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
        zero_is_known = not case.model_error > 0
        voltage = 0.0
        angle = 0.0
        for experiment in case.experiments:
            hub = experiment.output[:, 0]
            start = 0.0 if zero_is_known else hub[0]
            voltage = max(voltage, float(np.max(np.abs(experiment.voltage_V))))
            angle = max(angle, float(np.max(np.abs(hub - start))))
        if "tip_m" not in case.outputs:
            return cls(voltage, angle)

        tip = case.outputs.index("tip_m")
        reach = case.rig.hub.radius_m + case.rig.link.length_m
        noise = float(np.hypot(case.noise[tip], reach * case.noise[0]))
        largest = 0.0
        for experiment in case.experiments:
            deflection = experiment.output[:, tip] - reach * experiment.output[:, 0]
            middle = 0.0 if zero_is_known else np.mean(deflection)
            largest = max(largest, float(np.max(np.abs(deflection - middle))))
        return cls(voltage, angle, max(largest - _NOISE_OF_LARGEST * noise, noise))


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
        """Largest voltage."""
        return float(np.max(np.abs(self.voltage_V)))

    def scaled(self, factor: float) -> Excitation:
        """Every voltage times a factor."""
        return replace(self, voltage_V=self.voltage_V * factor)


def excitations(
    voltage_V: float, n_samples: int, dt_s: float, rng: np.random.Generator
) -> tuple[Excitation, ...]:
    """Ten excitations (T,) of equal length and largest voltage.

    Random binary (fast, slow), multisine (wide, odd lines at low frequency), doublet (short, long), slow
    triangle through reversals, steps with rests, chirp (up, and slow alone).

    Raises
    ------
    ValueError
        Fewer than 100 samples, or a voltage or period that is not positive.
    """
    if not n_samples >= _LEAST_SAMPLES:
        raise ValueError(f"an experiment needs at least {_LEAST_SAMPLES} samples; got {n_samples}")
    if not (0 < voltage_V < np.inf and 0 < dt_s < np.inf):
        raise ValueError(f"need a positive voltage and sampling period; got {voltage_V} V and {dt_s} s")
    T = n_samples
    nyquist_Hz = 0.5 / dt_s
    duration_s = n_samples * dt_s
    slow_hold = max(T // _SLOW_CHANGES, _LEAST_SLOW_HOLD)
    phase = 2 * np.pi * (np.arange(T) * _TRIANGLES / T) + np.pi / 2
    triangle = Excitation(
        "triangle",
        {"period_s": round(duration_s / _TRIANGLES, 6)},
        voltage_V * sawtooth(phase, 0.5),
    )
    return (
        _binary(voltage_V, T, _FAST_HOLD, rng),
        _binary(voltage_V, T, slow_hold, rng),
        _multisine(voltage_V, T, dt_s, _WIDE * nyquist_Hz, "full", rng),
        _multisine(voltage_V, T, dt_s, _SLOW * nyquist_Hz, "odd_random", rng),
        _doublet(voltage_V, T, dt_s, T // _SHORT_PULSES),
        _doublet(voltage_V, T, dt_s, T // _LONG_PULSES),
        triangle,
        _steps(voltage_V, T, dt_s, _STEPS, rng),
        _chirp(voltage_V, T, dt_s, 1 / duration_s, _CHIRP_WIDE * nyquist_Hz),
        _chirp(voltage_V, T, dt_s, 0.5 / duration_s, _CHIRP_SLOW * nyquist_Hz),
    )


# Kinds that are also tried at a third of what the limits allow: dry friction, backlash and dead zones weigh
# more in small motions.
ALSO_WEAK = ("random binary", "triangle")


def within(
    excitation: Excitation, limits: Limits, respond: Callable[[Real], tuple[float, float]]
) -> Excitation | None:
    """The excitation, scaled down until its largest hub angle and deflection stay in the limits.

    Parameters
    ----------
    excitation : Excitation
    limits : Limits
    respond : callable
        Voltage (T,) -> largest hub angle [rad] and deflection [m].

    Returns
    -------
    Excitation or None
        None if it is still outside after five scalings, below a hundredth of the voltage limit, or if the
        response is not finite.
    """
    if excitation.amplitude_V > limits.voltage_V * (1 + 1e-9):
        excitation = excitation.scaled(limits.voltage_V / excitation.amplitude_V)
    for _ in range(_SCALINGS):
        angle, deflection = respond(excitation.voltage_V)
        excess = max(angle / limits.hub_angle_rad, deflection / limits.deflection_m)
        if not np.isfinite(excess):
            return None
        if excess <= 1:
            return excitation
        excitation = excitation.scaled(_INSIDE / excess)
        if excitation.amplitude_V < _LEAST_VOLTAGE * limits.voltage_V:
            return None
    return None


def tailored_excitations(
    lines: Integer, n_samples: int, dt_s: float, voltage_V: float, rng: np.random.Generator
) -> list[Excitation]:
    """Multisine of the given lines, two periods, and the binary signal of its signs, which has more power.

    lines : (L,) of a period of half the samples, ascending. Both have the largest voltage voltage_V.
    """
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
    """Pseudo-random binary signal (T,) that holds each value for some samples, without repeating itself."""
    length = int(np.clip(np.ceil(np.log2(T / hold + 1)), 4, 20))
    return Excitation("random binary", {"hold_samples": hold}, prbs(length, hold, voltage, T, rng))


def _multisine(
    voltage: float, T: int, dt: float, high_Hz: float, grid: Grid, rng: np.random.Generator
) -> Excitation:
    """Two periods (T,) of a multisine from its lowest line up to a frequency."""
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
    """(T,) two periods of a flat multisine; of an odd T one sample of a third."""
    return np.resize(multisine(lines, T // 2, 1.0, rng, periods=2, draws=_DRAWS), T)


def _doublet(voltage: float, T: int, dt: float, pulse: int) -> Excitation:
    """A pulse of some samples, two at least, and its negative, then rest (T,)."""
    pulse = max(pulse, 2)
    return Excitation("doublet", {"pulse_s": round(pulse * dt, 6)}, doublet(voltage, 0.0, pulse * dt, T, dt))


def _steps(voltage: float, T: int, dt: float, count: int, rng: np.random.Generator) -> Excitation:
    """Steps of different height, each one followed by its negative and a rest, so that the hub comes back."""
    heights = voltage * rng.permutation(np.linspace(1, _LOWEST_STEP, count // 2))
    length = T // (3 * heights.size)
    pattern = np.concatenate([np.repeat([h, -h, 0.0], length) for h in heights])
    signal = np.concatenate([pattern, np.zeros(T - pattern.size)])
    return Excitation("step and hold", {"hold_s": round(length * dt, 6)}, signal)


def _chirp(voltage: float, T: int, dt: float, low_Hz: float, high_Hz: float) -> Excitation:
    """A sine (T,) whose frequency grows exponentially, by two octaves at least."""
    high = max(high_Hz, 4 * low_Hz)
    parameters = {"from_Hz": round(low_Hz, 4), "to_Hz": round(high, 4)}
    return Excitation("chirp", parameters, log_chirp(low_Hz, high, voltage, T, dt))
