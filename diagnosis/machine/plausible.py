"""Whether the records of a case can be of its rig at all: units, signs, columns, sensors, before any fit.

Outputs are compared with the nominal rig from rest, driven by the logged voltage, as speeds below its first
bending frequency: there an arm turns as a rigid body, and the voltage sets its speed by the back-EMF. Missing
effects change that motion by factors of a few; degrees for radians, or a wrong sign, by far more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from diagnosis.machine.case import Case, Experiment
from diagnosis.machine.machine_protocol import Real
from plant.modal import link_modes

Spectrum = npt.NDArray[np.complex128]

_RANGES = {
    "link.length_m": (0.01, 20.0),
    "link.width_m": (1e-4, 2.0),
    "link.thickness_m": (1e-5, 0.3),
    "link.density_kg_m3": (10.0, 3e4),
    "link.youngs_modulus_Pa": (1e6, 2e12),
}
_LARGEST = 1e9  # no voltage, angle or length of an arm in SI units comes near it
# Of 93 recorded cases with effects of every kind, all records together correlate by 0.45 at least and move
# between 0.29 and 1.6 times as far as predicted.
_LEAST, _LEAST_OF_ONE = 0.3, 0.8
FARTHER, LESS = 6.0, 1 / 15
_ACCELERATION_FARTHER, _ACCELERATION_LESS = 4.0, 1 / 6
# Ratios within this factor of each other may be one fault.
_ALIKE = 8.0
# Exchanged columns must follow the slow motion, correlate by so much in the fast one, and leave no more than
# this share of what the given ones leave; columns that explain so much are not tried with another voltage.
_FOLLOWED, _EXCHANGED, _UNEXPLAINED, _EXPLAINED = 0.6, 0.85, 0.3, 0.5
_FASTEST_HZ, _OF_NYQUIST = 30.0, 0.6
_CLIPPED_ROWS, _FROZEN_ROWS = 5, 50
_ABRUPT, _REPEATED = 0.3, 5e-3

_DEGREES = (180 / np.pi, "degrees per radian")
_FACTORS: dict[str, tuple[tuple[float, str], ...]] = {
    "hub_angle_rad": (_DEGREES, (1000.0, "milli")),
    "tip_m": ((1000.0, "milli"), (100.0, "centi"), (1 / 0.0254, "inches per metre")),
    "tip_acceleration_m_s2": ((9.80665, "g"), (1000.0, "milli"), (1000 / 9.80665, "milli-g")),
    "hub_speed_rad_s": (_DEGREES, (1000.0, "milli"), (30 / np.pi, "revolutions per minute")),
    "tip_deflection_m": ((1000.0, "milli"), (100.0, "centi")),
    "voltage_V": ((1000.0, "milli"),),
}


@dataclass(frozen=True)
class _Match:
    """Measured beside predicted motion: correlation, and ratio of their RMS."""

    correlation: float
    ratio: float


def refuse_implausible(case: Case) -> None:
    """Raises ValueError, one line, what and where and what was expected: a value of the rig that no link has,
    exchanged columns, a sensor that is clipped or stands still, a sign, a factor between units.

    Neglected: the start of the records (their ends are tapered), and whatever moves the arm beside the
    voltage. Faults of less than a factor of six, a sensor that dies while the arm hardly moves, and columns
    exchanged where the link hardly bends, go unnoticed.
    """
    _refuse_values(case)
    compare = _Comparison(case)
    given = tuple(range(len(compare.names)))
    _refuse_exchange(compare, given)
    for experiment in case.experiments:
        _refuse_sensors(experiment)
    single = [
        _fault(case, compare.matches([i], given, compare.slow_Hz), _LEAST_OF_ONE)
        for i in range(len(case.experiments))
    ]
    wrong = [i for i, fault in enumerate(single) if fault]
    if 0 < len(wrong) < len(single) / 2:
        raise ValueError(f"experiment {case.experiments[wrong[0]].name}: {single[wrong[0]]}")
    if fault := _fault(case, compare.matches(range(len(single)), given, compare.slow_Hz), _LEAST):
        raise ValueError(f"all records: {fault}")


class _Comparison:
    """Records beside what the rig predicts of them, with columns in any order (column 0 is the voltage)."""

    def __init__(self, case: Case) -> None:
        self.names = ("voltage_V", *case.outputs)
        self.dt_s = case.rig.sampling.dt_s
        self.slow_Hz = max(0.7 * float(link_modes(case.rig, 1).omega_rad_s[0]) / (2 * np.pi), 1.5)
        self.fast_Hz = min(_FASTEST_HZ, 0.5 * _OF_NYQUIST / self.dt_s)
        self.count = len(case.experiments)
        self._columns = [np.column_stack([e.voltage_V, e.output]) for e in case.experiments]
        self._simulate = case.machine.simulator(())
        self._predicted: dict[int, list[Real]] = {}

    def matches(self, of: Sequence[int], order: Sequence[int], highest_Hz: float) -> list[_Match]:
        """Of these records, one match per output; order[k] is the column taken for names[k]."""
        voltage = order[0]
        if voltage not in self._predicted:
            self._predicted[voltage] = [self._simulate(c[:, [voltage]]) for c in self._columns]
        return [
            _match(
                [_speed(self._predicted[voltage][i][:, k], self.dt_s, highest_Hz) for i in of],
                [_speed(self._columns[i][:, column], self.dt_s, highest_Hz) for i in of],
            )
            for k, column in enumerate(order[1:])
        ]

    def worst(self, order: Sequence[int], highest_Hz: float) -> float:
        """Lowest correlation of an output over all records."""
        return min(m.correlation for m in self.matches(range(self.count), order, highest_Hz))


def _refuse_exchange(compare: _Comparison, given: Sequence[int]) -> None:
    slow, fast = compare.worst(given, compare.slow_Hz), compare.worst(given, compare.fast_Hz)
    every = range(compare.count)
    for a, b in combinations(given, 2):
        order = [b if k == a else a if k == b else k for k in given]
        if a == 0 and fast > _EXPLAINED:
            continue  # Two simulations fewer: as given, the voltage explains the motion.
        other = compare.matches(every, order, compare.slow_Hz)
        if any(m.correlation < _FOLLOWED or not 1 / _ALIKE < m.ratio < _ALIKE for m in other):
            continue
        better = compare.worst(order, compare.fast_Hz)
        if slow < _LEAST or (better > _EXCHANGED and 1 - better < _UNEXPLAINED * (1 - fast)):
            raise ValueError(
                f"the columns of {compare.names[a]} and {compare.names[b]} look exchanged: the other way "
                f"round the records correlate with the rig's prediction by {better:.2f}, as given by "
                f"{fast:.2f}; see [columns]"
            )


def _refuse_values(case: Case) -> None:
    for key, (least, most) in _RANGES.items():
        if not least <= (value := case.rig.value(key)) <= most:
            raise ValueError(
                f"rig file: {key} is {value:g}; expected {least:g} to {most:g}, in the unit of its name"
            )
    for e in case.experiments:
        for name, y in zip(("voltage_V", *e.outputs), (e.voltage_V, *e.output.T), strict=True):
            if not (largest := float(np.max(np.abs(y)))) < _LARGEST:
                raise ValueError(f"experiment {e.name}: {name} is up to {largest:g}; expected SI units")


def _refuse_sensors(experiment: Experiment) -> None:
    """Outputs that stop dead and stay at exactly one value: of a limit again and again, or for long.

    A motion that turns, or comes to rest, is slow before; a limit is met at speed. Of a coarse encoder, one
    or two steps are no speed. Where no value but a limit comes twice in a row, two are enough.
    """
    what = f"experiment {experiment.name}"
    readings = experiment.output if experiment.readings is None else experiment.readings
    for name, y in zip(experiment.outputs, readings.T, strict=True):
        speed = np.abs(np.diff(y))
        starts = np.flatnonzero(np.r_[True, speed != 0])
        lengths = np.diff(np.r_[starts, len(y)])
        before = np.where(starts > 1, speed[np.maximum(starts - 2, 0)], 0.0)
        abrupt = (before > _ABRUPT * np.quantile(speed, 0.9)) & (before > 2.5 * np.min(speed[speed > 0]))
        inside = (y[1:] != np.max(y)) & (y[1:] != np.min(y))
        fine = np.count_nonzero(speed[inside] == 0) < _REPEATED * len(y)
        fine &= np.unique(y).size > len(y) / 4  # Not so of an arm that rests, read by a coarse encoder.
        met = (lengths >= 2) if fine else abrupt & (lengths >= _CLIPPED_ROWS)
        met[-1] = False  # What does not come back may as well be dead.
        for bound in (np.max(y), np.min(y)):
            clipped = met & (y[starts] == bound)
            if np.count_nonzero(clipped) > 1 or np.any(abrupt & clipped & (lengths >= 4 * _CLIPPED_ROWS)):
                raise ValueError(
                    f"{what}: {name} runs into {bound:.6g} and stays there for {lengths[clipped].sum()} "
                    f"samples, from sample {starts[clipped][0]} on: is it clipped? Expected a wider range"
                )
        if np.any(frozen := abrupt & (lengths >= _FROZEN_ROWS)):
            raise ValueError(
                f"{what}: {name} stops in full motion at {y[starts[frozen][0]]:.6g} for {lengths[frozen][0]} "
                f"samples, from sample {starts[frozen][0]} on: is the sensor dead, or at its limit?"
            )


def _fault(case: Case, found: Sequence[_Match], least: float) -> str:
    """What is wrong with signs and ratios of the outputs that follow the prediction closely enough to say so;
    empty if nothing is."""
    followed = {n: m for n, m in zip(case.outputs, found, strict=True) if abs(m.correlation) > least}
    either = ("voltage_V",) if len(case.outputs) == 1 else ()
    if against := [name for name, m in followed.items() if m.correlation < 0]:
        suspects = ("voltage_V",) if len(against) == len(case.outputs) > 1 else (*either, *against)
        return (
            f"{' and '.join(against)} against the rig's prediction (correlation "
            f"{min(followed[name].correlation for name in against):.2f}): wrong sign of "
            f"{' or '.join(suspects)}? Expected: a positive voltage turns hub and tip to positive angles; "
            "see scale in [columns]"
        )
    ratios = {name: m.ratio for name, m in followed.items()}
    far = {name: ratio for name, ratio in ratios.items() if not LESS < ratio < FARTHER}
    hub, tip = ratios.get("hub_angle_rad"), ratios.get("tip_acceleration_m_s2")
    # Both follow from one speed, whatever made it: the motor does not matter.
    if not far and hub and tip and not _ACCELERATION_LESS < tip / hub < _ACCELERATION_FARTHER:
        far = {"tip_acceleration_m_s2": tip}
    if not far:
        return ""
    alike = len(far) == len(case.outputs) > 1 and max(far.values()) < _ALIKE * min(far.values())
    ratio = next(iter(far.values()))
    gear = (case.rig.motor.gear_ratio, "gear ratio")
    near = sorted(
        (float(abs(np.log(max(ratio, 1 / ratio) / factor))), f"{quantity} off by {factor:.4g} ({word})")
        for quantity in (("voltage_V",) if alike else (*either, next(iter(far))))
        for factor, word in (*_FACTORS[quantity], *([gear] if quantity == "hub_angle_rad" else []))
    )
    guesses = [guess for distance, guess in near if distance < np.log(_ALIKE / 2)]
    return (
        f"{' and '.join(far)} {ratio:.3g} times what the rig and voltage_V predict: "
        f"{' or '.join(guesses) or 'unit of a column, or value of the rig file'}? Expected {LESS:.2g} to "
        f"{FARTHER:g}; see scale in [columns]"
    )


def _speed(signal: Real, dt_s: float, highest_Hz: float) -> Spectrum:
    """Spectrum of the rate of a signal (T,) less its straight line, tapered: above drift, to a frequency."""
    n = len(signal)
    k = np.linspace(-1.0, 1.0, n)
    line = np.polynomial.polynomial.polyfit(k, signal, 1)
    spectrum = np.fft.rfft(np.hanning(n) * (signal - np.polynomial.polynomial.polyval(k, line)))
    frequency = np.fft.rfftfreq(n, dt_s)
    band = (frequency >= 1.5 / (n * dt_s) + 0.2) & (frequency <= highest_Hz)
    return np.asarray(spectrum[band] * frequency[band])


def _match(predicted: Sequence[Spectrum], measured: Sequence[Spectrum]) -> _Match:
    both = sum(float(np.vdot(p, m).real) for p, m in zip(predicted, measured, strict=True))
    one = sum(float(np.vdot(p, p).real) for p in predicted)
    other = sum(float(np.vdot(m, m).real) for m in measured)
    if not (one > 0 and other > 0):
        return _Match(0.0, 1.0)
    return _Match(both / float(np.sqrt(one * other)), float(np.sqrt(other / one)))
