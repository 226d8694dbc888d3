"""What `diagnosis.where.where` answers: findings by frequency, regime, experiment, sensor, amplitude,
subsystem.

Every finding carries its number, an interval, a p-value against chance and whether it is `found` (beyond
chance at the level of its axis); the sentence of an axis only speaks of what is found.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

Interval = tuple[float, float]
# Sensors in the order of the output columns, as records name them.
SENSORS = ("hub_angle", "tip")


@dataclass(frozen=True)
class PartGap:
    """Gap in a part of the data: a sensor, an experiment, a sensor in an experiment, a sensor in a band.

    Attributes
    ----------
    gap_rms : float
        Root mean square of the gap itself in noise standard deviations, the noise taken off:
        sqrt(max(mean e^2 - 1, 0)). 0 where the part holds no more than noise.
    interval : (low, high)
        95 % for gap_rms; what sensor noise moves, the gap being what it is.
    share : float
        Of the gap energy of all records; shares of disjoint parts sum to 1 (a part below its noise counts
        negative, a little). 0 when there is no gap at all.
    share_interval : (low, high)
        95 %.
    p_value : float
        Chance of as much energy from noise alone.
    found : bool
    """

    gap_rms: float
    interval: Interval
    share: float
    share_interval: Interval
    p_value: float
    found: bool


@dataclass(frozen=True)
class SensorGap:
    sensor: str
    gap: PartGap


@dataclass(frozen=True)
class ExperimentGap:
    """Gap of one experiment, both sensors together and apart (order of `SENSORS`)."""

    experiment: str
    gap: PartGap
    sensors: tuple[PartGap, ...]


@dataclass(frozen=True)
class BandGap:
    """Gap of one sensor between two frequencies, all experiments together."""

    sensor: str
    low_Hz: float
    high_Hz: float
    gap: PartGap


@dataclass(frozen=True)
class RegimeBin:
    """Residual energy while the regime variable lies in [low, high): mean of e^2, 1 for noise alone.

    `interval` is the middle 95 % of what the same energy gives when it is shifted in time against the regime:
    an energy outside it is more (less) than chance.
    """

    label: str
    low: float
    high: float
    samples: int
    energy: float
    interval: Interval


@dataclass(frozen=True)
class RegimeFinding:
    """Does the residual energy of a sensor depend on a regime variable?

    axis: speed_sign, speed_size, reversal, angle, angle_in_period, deflection, command_size or time.
    `p_value` is by circular shifts of the energy against the regime within every experiment, which keeps the
    colour of the residuals. `contrast`: the largest deviation of a bin from what shifts give, in their
    standard deviations. A finding may be beyond chance and still too small to be worth a sentence.
    """

    axis: str
    unit: str
    sensor: str
    bins: tuple[RegimeBin, ...]
    p_value: float
    found: bool
    sentence: str
    contrast: float = 0.0


@dataclass(frozen=True)
class DriftFinding:
    """Slope of a sensor's residual over the time since start, common to all experiments.

    `share` is what a drift from zero at this rate explains of the sensor's gap energy. The interval comes
    from the scatter of the experiments' own slopes (Student), so that residuals of any colour are covered;
    without three experiments there is none and nothing is found.
    """

    sensor: str
    unit: str
    rate: float
    share: float
    interval: Interval | None
    p_value: float
    found: bool
    sentence: str


@dataclass(frozen=True)
class CommonFinding:
    """The part of a sensor's gap that is the same in all experiments at the same time since the start.

    Whatever the input was: a drift, an offset, a disturbance that starts with the record.

    Attributes
    ----------
    share : float
        Of the sensor's gap energy over the experiments' common length.
    share_by_chance : float
        Largest share when the sign of some of the experiments is turned.
    peak_Hz, peak_share : float
        Strongest line of the common part above the two slowest ones, and the share of the common energy
        within one line of it.
    """

    sensor: str
    experiments: int
    share: float
    share_by_chance: float
    peak_Hz: float
    peak_share: float
    p_value: float
    found: bool
    sentence: str


@dataclass(frozen=True)
class EquivalentCurve:
    """The residuals read as one missing function of a regime variable, at one place of the machine.

    Attributes
    ----------
    route : str
        hub_torque (a torque on the hub, sent through the model), hub_angle or tip (added to a sensor).
    axis, unit : str
        The variable it is a function of: speed, angle, command, deflection, time, position.
    centres, values, standard_errors : tuple of float
        The function at the mean of every bin, in Nm, rad or m.
    share : float
        Of the whole gap energy that this one function explains, the energy noise alone would add taken off.
    share_by_chance : float
        95 % point of that share when the function's variable is shifted in time; 0 if it was not needed.
    p_value : float
    """

    route: str
    axis: str
    unit: str
    value_unit: str
    centres: tuple[float, ...]
    values: tuple[float, ...]
    standard_errors: tuple[float, ...]
    share: float
    share_by_chance: float
    p_value: float
    found: bool
    sentence: str


@dataclass(frozen=True)
class FrequencyResponseBand:
    """Measured against modelled frequency response over the excited lines of a band.

    `distance` is the root mean square over the lines of |measured - model| in radii of the 95 % noise disc: 1
    is the edge of what noise explains on a single line, sqrt(2/5.99) = 0.58 what noise alone gives.
    """

    sensor: str
    low_Hz: float
    high_Hz: float
    lines: int
    distance: float
    relative_error: float
    p_value: float
    found: bool


@dataclass(frozen=True)
class LineGroup:
    """Residual at one group of lines of a periodic record: odd, even or all, excited or not.

    `repeated_rms` is the part that comes back every period, noise taken off, in noise standard deviations.
    """

    sensor: str
    group: str
    lines: int
    repeated_rms: float
    p_value: float
    found: bool


@dataclass(frozen=True)
class PeriodicFinding:
    """What a record with repeated periods says.

    unrepeated: per sensor, rms over the lines of what changes from period to period over what noise alone
    gives (1), with its 95 % interval under noise.
    """

    experiment: str
    period_samples: int
    periods: int
    bands: tuple[FrequencyResponseBand, ...]
    groups: tuple[LineGroup, ...]
    unrepeated: tuple[float, ...]
    unrepeated_interval: Interval
    even_odd_separable: bool
    sentence: str


@dataclass(frozen=True)
class AmplitudeFinding:
    """How the gap grows between two open-loop experiments of one kind at different amplitude.

    exponent: gap_rms proportional to amplitude^exponent (1 in a linear machine), 95 % interval by blocks.
    linear_share: share of the gap energy that a linear correction of the model takes away on the held-out
    experiments when fitted on the others; None if not found out.
    """

    experiments: tuple[str, str]
    voltage_ratio: float
    gap_ratio: float
    exponent: float
    interval: Interval
    growth: str
    found: bool
    sentence: str


@dataclass(frozen=True)
class LinearCorrection:
    """Share of the gap energy that any linear correction from voltage to sensors takes away.

    Fitted on the estimation records, judged on the held-out ones: `share` with a 95 % interval.
    """

    share: float
    interval: Interval
    sentence: str


@dataclass(frozen=True)
class Where:
    """Where the gap lies.

    Attributes
    ----------
    headline : str
    gap : PartGap
        All records together.
    sensors, experiments, bands, regimes, drift, common, curves
        See their records.
    periodic, amplitude, linear
        None where the records do not allow it.
    subsystem : dict
        Probability of none, actuator, joint, link, sensor, environment, unknown; empty without probabilities.
    sentences : dict
        One per axis (sensors, experiments, frequency, regimes, time, common, amplitude, curves, linear,
        periodic, subsystem); only axes that have something to say.
    level : float
        Chance of any finding of an axis when there is nothing.
    """

    headline: str
    gap: PartGap
    sensors: tuple[SensorGap, ...]
    experiments: tuple[ExperimentGap, ...]
    bands: tuple[BandGap, ...]
    regimes: tuple[RegimeFinding, ...]
    drift: tuple[DriftFinding, ...]
    common: tuple[CommonFinding, ...]
    curves: tuple[EquivalentCurve, ...]
    periodic: tuple[PeriodicFinding, ...]
    amplitude: AmplitudeFinding | None
    linear: LinearCorrection | None
    subsystem: dict[str, float]
    sentences: dict[str, str]
    level: float

    def to_dict(self) -> dict[str, Any]:
        """Plain dicts, lists, floats and strings; `json.dumps` takes it."""
        return dict(_plain(asdict(self)))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return value
