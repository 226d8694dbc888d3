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

# Ranges of a link that anybody has built, from a needle to a crane; a value beyond is in another unit.
_RANGES = {
    "link.length_m": (0.01, 20.0),
    "link.width_m": (1e-4, 2.0),
    "link.thickness_m": (1e-5, 0.3),
    "link.density_kg_m3": (10.0, 3e4),
    "link.youngs_modulus_Pa": (1e6, 2e12),
}
# No voltage, angle or length of an arm in SI units comes near it.
_LARGEST = 1e9
# Least correlation of all records together with the rig's prediction by which signs and ratios are judged. Of
# 93 recorded cases with effects of every kind the lowest one is 0.45.
_LEAST_OF_ALL = 0.3
# The same of a single record, which an effect may change more. Chosen.
_LEAST_OF_ONE = 0.8
# Times the predicted motion from which on something is wrong. The 93 cases move up to 1.6 times as far.
FARTHER = 6.0
# Share of the predicted motion up to which something is wrong. The 93 cases move 0.29 times as far and more.
LESS = 1 / 15
# Times its speed at the hub that a tip accelerates more than predicted: the motor has no part in that ratio.
_ACCELERATION_FARTHER = 4.0
# Share of it, likewise. Both chosen below a factor of g.
_ACCELERATION_LESS = 1 / 6
# Ratios within this factor of each other may be one fault. Chosen between the factors of units.
_ALIKE = 8.0
# Correlation with the slow motion that exchanged columns have at least, as all columns of a machine do.
_FOLLOWED = 0.6
# Correlation in the fast motion that exchanged columns have at least.
_EXCHANGED = 0.85
# Share of what the given columns leave of it that exchanged ones leave at most.
_UNEXPLAINED = 0.3
# Correlation of the given columns from which on they are not tried with another voltage. These four are
# chosen.
_EXPLAINED = 0.5
# Highest frequency of the slow motion: this share of the first bending frequency, where an arm is rigid,
_RIGID_SHARE = 0.7
# and no less than this, or there is no motion in it [Hz].
_SLOWEST_HZ = 1.5
# Highest frequency of the fast motion [Hz]: beyond it an arm hardly moves.
_FASTEST_HZ = 30.0
# The same as a share of the Nyquist frequency: a difference of samples is no rate beyond it.
_OF_NYQUIST = 0.6
# Lowest frequency that is compared [Hz]: a drift of a sensor (five seconds and more) is slower. Chosen.
_DRIFT_HZ = 0.2
# Periods of that lowest frequency in the record besides: the taper's main lobe is two bins wide on each side,
# so that a straight line that was not quite taken off reaches no farther. Chosen.
_LEAST_PERIODS = 1.5
# Samples at one value that are a limit, where a sensor repeats values now and then.
_CLIPPED_ROWS = 5
# Samples at one value that are a limit though it is met once: a motion that stops there is slow before.
_CLIPPED_LONG = 4 * _CLIPPED_ROWS
# Samples at one value inside the range of a sensor that are a dead one.
_FROZEN_ROWS = 50
# Share of the usual largest step before a stop from which on it is abrupt.
_ABRUPT = 0.3
# Quantile of the steps that is the usual largest one: beyond are outliers.
_USUAL_LARGEST = 0.9
# Smallest steps of a coarse encoder that are no speed.
_STEPS_AT_REST = 2.5
# Share of samples that repeat the one before up to which a sensor is fine enough that two are a limit.
_REPEATED = 5e-3

_DEGREES = (180 / np.pi, "degrees per radian")
# Quantity -> factors that a unit, or a value of the rig file, may be off by, and what makes them.
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
    """Measured beside predicted motion: correlation (-1 to 1), and RMS of the measured over the predicted."""

    correlation: float
    ratio: float


def refuse_implausible(case: Case) -> None:
    """Refuses records that cannot be of the rig of a case.

    Neglected: the start of the records (their ends are tapered), and whatever moves the arm beside the
    voltage. Faults of less than a factor of six, a sensor that dies while the arm hardly moves, and columns
    exchanged where the link hardly bends, go unnoticed.

    Raises
    ------
    ValueError
        One line, what and where and what was expected: a value of the rig that no link has, exchanged
        columns, a sensor that is clipped or stands still, a sign, a factor between units.
    """
    _refuse_values(case)
    compare = _Comparison(case)
    given_order = tuple(range(len(compare.names)))
    _refuse_exchange(compare, given_order)
    for experiment in case.experiments:
        _refuse_sensors(experiment)

    # A fault of few records is theirs; of most it is everybody's.
    faults = []
    for k in range(len(case.experiments)):
        matches = compare.matches([k], given_order, compare.slow_Hz)
        faults.append(_fault(case, matches, _LEAST_OF_ONE))
    faulty = [k for k, fault in enumerate(faults) if fault]
    if 0 < len(faulty) < len(faults) / 2:
        first = faulty[0]
        raise ValueError(f"experiment {case.experiments[first].name}: {faults[first]}")
    matches = compare.matches(range(len(faults)), given_order, compare.slow_Hz)
    fault = _fault(case, matches, _LEAST_OF_ALL)
    if fault:
        raise ValueError(f"all records: {fault}")


class _Comparison:
    """Records beside what the rig predicts of them, with columns in any order.

    names : of the columns, the voltage first. slow_Hz, fast_Hz : highest frequencies of two comparisons.
    """

    def __init__(self, case: Case) -> None:
        self.names = ("voltage_V", *case.outputs)
        self.dt_s = case.rig.sampling.dt_s
        first_bending_Hz = float(link_modes(case.rig, 1).omega_rad_s[0]) / (2 * np.pi)
        self.slow_Hz = max(_RIGID_SHARE * first_bending_Hz, _SLOWEST_HZ)
        self.fast_Hz = min(_FASTEST_HZ, 0.5 * _OF_NYQUIST / self.dt_s)
        self.count = len(case.experiments)
        self._columns = [np.column_stack([e.voltage_V, e.output]) for e in case.experiments]
        self._simulate = case.machine.simulator(())
        self._predicted: dict[int, list[Real]] = {}

    def matches(self, records: Sequence[int], order: Sequence[int], highest_Hz: float) -> list[_Match]:
        """One match per output, of these records together.

        order : order[k] is the column that is taken for names[k].
        """
        voltage = order[0]
        if voltage not in self._predicted:
            self._predicted[voltage] = [self._simulate(columns[:, [voltage]]) for columns in self._columns]
        predictions = self._predicted[voltage]
        matches = []
        for k, column in enumerate(order[1:]):
            predicted = [_speed(predictions[i][:, k], self.dt_s, highest_Hz) for i in records]
            measured = [_speed(self._columns[i][:, column], self.dt_s, highest_Hz) for i in records]
            matches.append(_match(predicted, measured))
        return matches

    def worst(self, order: Sequence[int], highest_Hz: float) -> float:
        """Lowest correlation of an output over all records."""
        return min(match.correlation for match in self.matches(range(self.count), order, highest_Hz))


def _refuse_exchange(compare: _Comparison, given_order: Sequence[int]) -> None:
    """Raises ValueError where two columns explain the records far better the other way round."""
    slow = compare.worst(given_order, compare.slow_Hz)
    fast = compare.worst(given_order, compare.fast_Hz)
    for a, b in combinations(given_order, 2):
        order = list(given_order)
        order[a] = b
        order[b] = a
        if a == 0 and fast > _EXPLAINED:
            continue  # Two simulations fewer: as given, the voltage explains the motion.
        matches = compare.matches(range(compare.count), order, compare.slow_Hz)
        if any(m.correlation < _FOLLOWED or not 1 / _ALIKE < m.ratio < _ALIKE for m in matches):
            continue
        exchanged = compare.worst(order, compare.fast_Hz)
        explains_more = exchanged > _EXCHANGED and 1 - exchanged < _UNEXPLAINED * (1 - fast)
        if slow < _LEAST_OF_ALL or explains_more:
            raise ValueError(
                f"the columns of {compare.names[a]} and {compare.names[b]} look exchanged: the other way "
                f"round the records correlate with the rig's prediction by {exchanged:.2f}, as given by "
                f"{fast:.2f}; see [columns]"
            )


def _refuse_values(case: Case) -> None:
    """Raises ValueError for a value of the rig that no link has, or a signal that is in no SI unit."""
    for key, (lowest, highest) in _RANGES.items():
        value = case.rig.value(key)
        if not lowest <= value <= highest:
            raise ValueError(
                f"rig file: {key} is {value:g}; expected {lowest:g} to {highest:g}, in the unit of its name"
            )
    for e in case.experiments:
        for name, signal in zip(("voltage_V", *e.outputs), (e.voltage_V, *e.output.T), strict=True):
            largest = float(np.max(np.abs(signal)))
            if not largest < _LARGEST:
                raise ValueError(f"experiment {e.name}: {name} is up to {largest:g}; expected SI units")


def _refuse_sensors(experiment: Experiment) -> None:
    """Raises ValueError for outputs that stop dead and stay at exactly one value: of a limit again and again,
    or for long.

    A motion that turns, or comes to rest, is slow before; a limit is met at speed. Of a coarse encoder, one
    or two steps are no speed. Where no value but a limit comes twice in a row, two are enough.
    """
    what = f"experiment {experiment.name}"
    readings = experiment.output if experiment.readings is None else experiment.readings
    for name, y in zip(experiment.outputs, readings.T, strict=True):
        # Stretches of equal values: where they start, how long they are, the step into them.
        step = np.abs(np.diff(y))
        has_moved = step != 0
        starts = np.flatnonzero(np.r_[True, has_moved])
        lengths = np.diff(np.r_[starts, len(y)])
        step_before = np.where(starts > 1, step[np.maximum(starts - 2, 0)], 0.0)
        is_large = step_before > _ABRUPT * np.quantile(step, _USUAL_LARGEST)
        is_speed = step_before > _STEPS_AT_REST * np.min(step[has_moved])
        is_abrupt = is_large & is_speed

        # A fine sensor hardly ever repeats a value; not so of an arm that rests, read by a coarse encoder.
        at_an_end = np.isin(y[1:], (np.max(y), np.min(y)))
        repeats = np.count_nonzero(~has_moved & ~at_an_end)
        seldom_repeats = repeats < _REPEATED * len(y)
        is_fine = seldom_repeats and np.unique(y).size > len(y) / 4
        is_stretch = lengths >= (2 if is_fine else _CLIPPED_ROWS)
        is_limited = is_stretch if is_fine else is_abrupt & is_stretch
        is_limited[-1] = False  # What does not come back may as well be dead.

        for bound in (np.max(y), np.min(y)):
            is_there = y[starts] == bound
            clipped = is_limited & is_there
            is_long = lengths >= _CLIPPED_LONG
            if np.count_nonzero(clipped) > 1 or np.any(is_abrupt & clipped & is_long):
                raise ValueError(
                    f"{what}: {name} runs into {bound:.6g} and stays there for {lengths[clipped].sum()} "
                    f"samples, from sample {starts[clipped][0]} on: is it clipped? Expected a wider range"
                )
        is_long = lengths >= _FROZEN_ROWS
        frozen = is_abrupt & is_long
        if np.any(frozen):
            raise ValueError(
                f"{what}: {name} stops in full motion at {y[starts[frozen][0]]:.6g} for {lengths[frozen][0]} "
                f"samples, from sample {starts[frozen][0]} on: is the sensor dead, or at its limit?"
            )


def _fault(case: Case, matches: Sequence[_Match], least: float) -> str:
    """What is wrong with signs and ratios of the outputs, "" if nothing is.

    matches : one per output. least : size of a correlation from which on an output is judged.
    """
    followed = {
        name: match
        for name, match in zip(case.outputs, matches, strict=True)
        if abs(match.correlation) > least
    }
    # With a single output a fault may as well be the voltage's.
    or_voltage = ("voltage_V",) if len(case.outputs) == 1 else ()
    against = [name for name, match in followed.items() if match.correlation < 0]
    if against:
        all_of_several = len(against) == len(case.outputs) > 1
        suspects = ("voltage_V",) if all_of_several else (*or_voltage, *against)
        lowest = min(followed[name].correlation for name in against)
        return (
            f"{' and '.join(against)} against the rig's prediction (correlation {lowest:.2f}): wrong sign of "
            f"{' or '.join(suspects)}? Expected: a positive voltage turns hub and tip to positive angles; "
            "see scale in [columns]"
        )

    ratios = {name: match.ratio for name, match in followed.items()}
    far: dict[str, float] = {name: ratio for name, ratio in ratios.items() if not LESS < ratio < FARTHER}
    hub = ratios.get("hub_angle_rad")
    tip = ratios.get("tip_acceleration_m_s2")
    # Both follow from one speed, whatever made it: the motor does not matter.
    if not far and hub and tip and not _ACCELERATION_LESS < tip / hub < _ACCELERATION_FARTHER:
        far = {"tip_acceleration_m_s2": tip}
    if not far:
        return ""
    return _factor_fault(case, far, or_voltage)


def _factor_fault(case: Case, far: dict[str, float], or_voltage: Sequence[str]) -> str:
    """What makes outputs move farther or less than predicted by these ratios (name -> ratio), in a sentence.

    or_voltage : the voltage, where it may be off in place of the output.
    """
    all_alike = len(far) == len(case.outputs) > 1 and max(far.values()) < _ALIKE * min(far.values())
    first, ratio = next(iter(far.items()))
    size = max(ratio, 1 / ratio)
    guesses = []
    for quantity in ("voltage_V",) if all_alike else (*or_voltage, first):
        factors = list(_FACTORS[quantity])
        if quantity == "hub_angle_rad":
            factors.append((case.rig.motor.gear_ratio, "gear ratio"))
        for factor, word in factors:
            distance = float(abs(np.log(size / factor)))
            if distance < np.log(_ALIKE / 2):
                guesses.append((distance, f"{quantity} off by {factor:.4g} ({word})"))
    likely = " or ".join(guess for _, guess in sorted(guesses))
    return (
        f"{' and '.join(far)} {ratio:.3g} times what the rig and voltage_V predict: "
        f"{likely or 'unit of a column, or value of the rig file'}? Expected {LESS:.2g} to "
        f"{FARTHER:g}; see scale in [columns]"
    )


def _speed(signal: Real, dt_s: float, highest_Hz: float) -> Spectrum:
    """(F,) complex spectrum of the rate of a signal (T,), up to the factor 2 pi i: in the signal's units, Hz.

    The signal less its straight line, tapered. F frequencies from above a sensor's drift, and
    `_LEAST_PERIODS` periods of the record, to highest_Hz.
    """
    n = len(signal)
    k = np.linspace(-1.0, 1.0, n)
    line = np.polynomial.polynomial.polyfit(k, signal, 1)
    spectrum = np.fft.rfft(np.hanning(n) * (signal - np.polynomial.polynomial.polyval(k, line)))
    frequency_Hz = np.fft.rfftfreq(n, dt_s)
    lowest_Hz = _LEAST_PERIODS / (n * dt_s) + _DRIFT_HZ
    above = frequency_Hz >= lowest_Hz
    below = frequency_Hz <= highest_Hz
    band = above & below
    return np.asarray(spectrum[band] * frequency_Hz[band])


def _match(predicted: Sequence[Spectrum], measured: Sequence[Spectrum]) -> _Match:
    """Match of spectra (F,) of several records; no correlation, and a ratio of one, where nothing moves."""
    cross = sum(float(np.vdot(p, m).real) for p, m in zip(predicted, measured, strict=True))
    power_predicted = sum(float(np.vdot(p, p).real) for p in predicted)
    power_measured = sum(float(np.vdot(m, m).real) for m in measured)
    if not (power_predicted > 0 and power_measured > 0):
        return _Match(0.0, 1.0)
    correlation = cross / float(np.sqrt(power_predicted * power_measured))
    return _Match(correlation, float(np.sqrt(power_measured / power_predicted)))
