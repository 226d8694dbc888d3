"""What `diagnosis.where.where` answers: findings by frequency, regime, experiment, sensor, size.

Every finding carries its number, an interval, a p-value against chance and whether it is `found` (beyond
chance at the level of its axis). Sizes are in noise standard deviations, or in those of noise and what a good
model may miss together. A sensor, an experiment and an effect are named as in the case.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.stats import chi2, norm

from diagnosis.machine.case import Case
from plant.rig import Output

Interval = tuple[float, float]
# What is measured -> its sensor, as findings name it, and the unit of its slope.
SENSORS: dict[Output, tuple[str, str]] = {
    "hub_angle_rad": ("hub_angle", "rad/s"),
    "tip_m": ("tip", "m/s"),
    "tip_acceleration_m_s2": ("tip_acceleration", "m/s^3"),
    "hub_speed_rad_s": ("hub_speed", "rad/s^2"),
    "tip_deflection_m": ("tip_deflection", "m/s"),
}

# Standard deviations of a two-sided interval of 95 %.
_Z95 = float(norm.ppf(0.975))
# A statement about where "most" of the gap lies covers at least this share of it. Chosen; at 0.9 most gaps of
# an arm with one mode have no such band.
_MOST = 0.8
# And at least this share for certain, at the lower end of its interval: half of it is not most of it.
_MOST_FOR_CERTAIN = 0.5
# From such a share of the gap on it is called linear in the voltage: what a linear correction leaves of a
# linear cause is what its poles are off by, a tenth of it. Chosen.
_LINEAR = 0.9
# Below such a share it is called nonlinear: of dry friction about a half looks like viscous friction.
_NOT_LINEAR = 0.5
# Share of a common part within one line of its strongest one from which on it is called a line: a straight
# drift has 7 % of its energy around its fourth line. Chosen; doubled, a disturbance that swells has no line.
_LINE = 0.2
# A drift that explains less of a gap is not worth a sentence. Chosen, as of a dependence.
_LEAST_DRIFT = 0.1
# A sensor alone shows the gap where it has this share at the lower end of its interval.
_ALONE_FOR_CERTAIN = 0.95
# Or this share where the gap of every other sensor is within chance.
_ALONE = 0.9
# Axes of regimes that are told: a page says no more than a reader keeps. Chosen.
_MOST_AXES = 3
# Below this a standard deviation is zero: it keeps a ratio finite.
_TINY = 1e-12


def sensors_of(case: Case) -> tuple[str, ...]:
    """Names of the sensors in the order of the output columns."""
    return tuple(SENSORS[output][0] for output in case.outputs)


@dataclass(frozen=True)
class PartGap:
    """Gap in a part of the data: a sensor, an experiment, a sensor in an experiment, a sensor in a band.

    gap_rms : float. Root mean square of the gap itself in noise standard deviations, the noise taken off:
        sqrt(max(mean e^2 - 1, 0)). 0 where the part holds no more than noise.
    interval : (low, high). 95 % for gap_rms; what sensor noise moves, the gap being what it is.
    share : float. Of the gap energy of all records, 0 to 1; shares of disjoint parts sum to 1 but for noise.
        0 where there is no gap at all.
    share_interval : (low, high). 95 %, cut to 0 and 1.
    p_value : float. Chance of as much energy from noise alone.
    found : bool
    share_deviation : float. Standard deviation of the share, that is not cut.
    """

    gap_rms: float
    interval: Interval
    share: float
    share_interval: Interval
    p_value: float
    found: bool
    share_deviation: float = 0.0


@dataclass(frozen=True)
class SensorGap:
    """Gap of one sensor, all experiments together."""

    sensor: str
    gap: PartGap


@dataclass(frozen=True)
class ExperimentGap:
    """Gap of one experiment, all sensors together and apart (in their order)."""

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
class RegimePeak:
    """The bin that stands out most: gap in noise deviations there, and what shifts in time give."""

    label: str
    gap_rms: float
    usual: float


@dataclass(frozen=True)
class RegimeFinding:
    """Does the residual energy of a sensor depend on a regime variable?

    axis: speed_sign, speed_size, reversal, angle, deflection, command_size or time.
    `p_value` is by circular shifts of the energy against the regime within every experiment, which keeps the
    colour of the residuals. `contrast`: the largest deviation of a bin from what shifts give, in their
    standard deviations. `peak` is None where nothing is found, or too little to tell anybody.
    """

    axis: str
    unit: str
    sensor: str
    bins: tuple[RegimeBin, ...]
    p_value: float
    found: bool
    peak: RegimePeak | None
    contrast: float = 0.0


@dataclass(frozen=True)
class DriftFinding:
    """Slope of a sensor's residual over the time since start, common to all experiments.

    `rate` is in `unit`, as is its 95 % interval. `share` is what a drift from zero at this rate explains of
    the sensor's gap energy. The interval comes from the scatter of the experiments' own slopes (Student), so
    that residuals of any colour are covered; without three experiments there is none and nothing is found.
    """

    sensor: str
    unit: str
    rate: float
    share: float
    interval: Interval | None
    p_value: float
    found: bool

    @property
    def notable(self) -> bool:
        """Whether it is beyond chance and explains a tenth of the gap."""
        return self.found and self.share >= _LEAST_DRIFT


@dataclass(frozen=True)
class CommonFinding:
    """The part of a sensor's gap that is the same in all experiments at the same time since the start.

    Whatever the input was: a drift, an offset, a disturbance that starts with the record.

    share : float. Of the sensor's gap energy over the experiments' common length.
    share_by_chance : float. Largest share when the sign of some of the experiments is turned.
    peak_Hz, peak_share : float. Strongest line of the common part above the two slowest ones, and the share
        of the common energy within one line of it.
    """

    sensor: str
    experiments: int
    share: float
    share_by_chance: float
    peak_Hz: float
    peak_share: float
    p_value: float
    found: bool

    @property
    def has_line(self) -> bool:
        """Whether the common part is, for a fifth at least, at one frequency."""
        return self.peak_share >= _LINE


# What a variable is: the motion of an output, an output that is no motion, a command, the time in the log, a
# column beside inputs and outputs.
Quantity = Literal["position", "speed", "acceleration", "value", "command", "time", "beside"]
# What a curve is: a straight line, a change of sign with the variable, or no less than the curve.
Shape = Literal["line", "jump", "curve"]


@dataclass(frozen=True)
class Alternative:
    """Another variable, with its unit, at a place, that explains this share of the error."""

    place: str
    quantity: Quantity
    of: str
    unit: str
    share: float


@dataclass(frozen=True)
class Dependence:
    """A missing force, or an error of a reading, as a curve of one variable.

    Parameters
    ----------
    place : str
        Joint, hub or command at which the force acts; output whose reading is wrong.
    acts : "force" or "reading"
    quantity, of, unit : str
        The variable: what it is, of which output, command or column ("" of the time), and its unit.
    own : bool
        The variable is the motion of the place itself.
    value_unit : str
        Of the force or the reading; of a force added to a command, that of the command.
    centres, values, standard_errors : tuple of float
        The curve at points of the variable.
    share : float
        Of the error's energy above noise that the curve explains in data that it was not drawn on, 0 to 1; of
        a second dependence, of what it takes beside the first.
    constant_share : float
        What a constant force at the same place explains of it.
    judged_on : "logs" or "blocks"
        What was left out in turn: whole logs, or blocks of the only one.
    shape : "line", "jump" or "curve"
        What explains at least nine tenths of it: a straight line, a change of sign with the variable, or no
        less than the curve.
    slope, slope_error : float or None
        Of a line, per unit of the variable; of a jump, half its height; with standard errors.
    beside : bool
        It explains what another dependence leaves.
    also : tuple of Alternative
        What explains as much within two standard errors, at most two.
    """

    place: str
    acts: Literal["force", "reading"]
    quantity: Quantity
    of: str
    unit: str
    own: bool
    value_unit: str
    centres: tuple[float, ...]
    values: tuple[float, ...]
    standard_errors: tuple[float, ...]
    share: float
    constant_share: float
    judged_on: Literal["logs", "blocks"]
    shape: Shape
    slope: float | None
    slope_error: float | None
    beside: bool
    also: tuple[Alternative, ...]


@dataclass(frozen=True)
class FrequencyResponseBand:
    """Measured against modelled frequency response over the excited lines of a band.

    `distance` is the root mean square over the lines of |measured - model| in radii of the 95 % noise disc: 1
    is the edge of what noise explains on a single line, sqrt(2/5.99) = 0.58 what noise alone gives.
    `relative_error`: the same over the model's response, infinite where the model does not respond.
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

    period_samples, periods : length of a period, and how many whole ones the record has.
    even_odd_separable : only odd lines are excited, so that even and odd distortion are told apart.
    """

    experiment: str
    period_samples: int
    periods: int
    bands: tuple[FrequencyResponseBand, ...]
    groups: tuple[LineGroup, ...]
    even_odd_separable: bool


Growth = Literal["offset", "saturating", "linear", "faster", "undecided"]


@dataclass(frozen=True)
class AmplitudeFinding:
    """How the gap grows between two open-loop experiments of one kind at different amplitude.

    experiments: the weaker and the stronger. voltage_ratio, gap_ratio: stronger over weaker, RMS.
    exponent: gap_rms proportional to amplitude^exponent (1 in a linear machine), 95 % interval by blocks.
    growth: what that allows to say; found: that it is not proportion.
    """

    experiments: tuple[str, str]
    voltage_ratio: float
    gap_ratio: float
    exponent: float
    interval: Interval
    growth: Growth
    found: bool


@dataclass(frozen=True)
class LinearCorrection:
    """Share of the gap energy that any linear correction from voltage to sensors takes away.

    Fitted on the estimation records, judged on the held-out ones: `share` with a 95 % interval, both cut to 0
    and 1. One that makes the held-out error larger takes nothing away.
    """

    share: float
    interval: Interval

    @property
    def linear(self) -> bool | None:
        """Whether the cause is linear in the voltage; None where the share leaves that open."""
        if self.share >= _LINEAR:
            return True
        if self.share < _NOT_LINEAR:
            return False
        return None


@dataclass(frozen=True)
class Concentration:
    """Share of a gap's energy between two frequencies, and half the width of its 95 % interval."""

    low_Hz: float
    high_Hz: float
    share: float
    half_width: float


@dataclass(frozen=True)
class Where:
    """Where the gap lies.

    Parameters
    ----------
    gap : PartGap
        All records together.
    sensors, experiments, bands, regimes, dependences : tuple
        See their records; at least one sensor, experiment and band.
    drift, common, periodic : tuple
        Only of a flexible link; empty where the records do not allow it.
    amplitude, linear : AmplitudeFinding, LinearCorrection or None
        Only of a flexible link; None where the records do not allow it.
    subsystem : dict
        Probability of none, actuator, joint, link, sensor, environment, unknown; empty without probabilities.
    level : float
        Chance of any finding of an axis when there is nothing.
    """

    gap: PartGap
    sensors: tuple[SensorGap, ...]
    experiments: tuple[ExperimentGap, ...]
    bands: tuple[BandGap, ...]
    regimes: tuple[RegimeFinding, ...] = ()
    drift: tuple[DriftFinding, ...] = ()
    common: tuple[CommonFinding, ...] = ()
    dependences: tuple[Dependence, ...] = ()
    periodic: tuple[PeriodicFinding, ...] = ()
    amplitude: AmplitudeFinding | None = None
    linear: LinearCorrection | None = None
    subsystem: dict[str, float] = field(default_factory=dict)
    level: float = field(kw_only=True)

    @property
    def is_gap(self) -> bool:
        """Anything beyond noise in the records as a whole, a sensor, an experiment or a band."""
        parts = [self.gap]
        parts += [sensor.gap for sensor in self.sensors]
        parts += [band.gap for band in self.bands]
        for experiment in self.experiments:
            parts += [experiment.gap, *experiment.sensors]
        return any(part.found for part in parts)

    @property
    def dominant_sensor(self) -> str | None:
        """The sensor that alone shows the gap, if the other ones show none or next to none of it.

        None of a machine with one sensor.
        """
        if len(self.sensors) == 1:
            return None
        with_gap = [sensor for sensor in self.sensors if sensor.gap.found]
        for sensor in with_gap:
            gap = sensor.gap
            if gap.share_interval[0] > _ALONE_FOR_CERTAIN or (len(with_gap) == 1 and gap.share > _ALONE):
                return sensor.sensor
        return None

    @property
    def telling_regimes(self) -> tuple[RegimeFinding, ...]:
        """The clearest regime of every axis, at most three axes."""
        best: dict[str, RegimeFinding] = {}
        for regime in self.regimes:
            if regime.peak is None:
                continue
            if regime.axis not in best or regime.contrast > best[regime.axis].contrast:
                best[regime.axis] = regime
        clearest_first = sorted(best.values(), key=lambda regime: -regime.contrast)
        return tuple(clearest_first[:_MOST_AXES])

    @property
    def common_found(self) -> tuple[CommonFinding, ...]:
        """What all experiments share beyond chance, largest share first."""
        beyond_chance = [common for common in self.common if common.found]
        return tuple(sorted(beyond_chance, key=lambda common: -common.share))

    def concentration(self, sensor: str | None = None) -> Concentration | None:
        """Narrowest run of bands with at least 80 % of the gap (of one sensor: of its own gap).

        None if only the whole range has it, no band is found, or it may be less than half.
        """
        bands = [band for band in self.bands if sensor is None or band.sensor == sensor]
        if not any(band.gap.found for band in bands):
            return None
        # Shares are of the gap of all sensors; those of one sensor are taken over its own.
        scale = 1.0
        if sensor is not None:
            whole = sum(band.gap.share for band in bands)
            scale = whole if whole > 0 else 1.0
        edges = sorted({band.low_Hz for band in bands} | {band.high_Hz for band in bands})
        shares = [sum(band.gap.share / scale for band in bands if band.low_Hz == low) for low in edges[:-1]]

        runs = []
        for begin in range(len(shares)):
            for end in range(begin + 1, len(shares) + 1):
                share = sum(shares[begin:end])
                if share >= _MOST:
                    runs.append((end - begin, -share, edges[begin], edges[end]))
        # The narrowest; of two as narrow the one that holds more.
        count, minus_share, low, high = min(runs, default=(len(shares), 0.0, 0.0, 0.0))
        if count == len(shares):
            return None
        halves = [_Z95 * band.gap.share_deviation / scale for band in bands if low <= band.low_Hz < high]
        half_width = float(np.sqrt(np.sum(np.square(halves))))
        share = min(-minus_share, 1.0)
        if share - half_width < _MOST_FOR_CERTAIN:
            return None
        return Concentration(low, high, share, half_width)

    def even(self, sensor: str) -> bool:
        """Whether a sensor's gap is spread evenly over all frequencies, as more sensor noise would be.

        Chi-square of the bands' mean energies about their mean by width, at 5 %.
        """
        bands = [band for band in self.bands if band.sensor == sensor]
        if not all(band.gap.found for band in bands):
            return False
        width = np.array([band.high_Hz - band.low_Hz for band in bands])
        energy = np.array([band.gap.gap_rms**2 for band in bands])
        # Half the interval of gap_rms^2 over 1.96 is its standard deviation where the lower end is not cut.
        deviation = np.array([(band.gap.interval[1] ** 2 - band.gap.gap_rms**2) / _Z95 for band in bands])
        mean = np.sum(width * energy) / np.sum(width)
        away = (energy - mean) / np.maximum(deviation, _TINY)
        return bool(np.sum(away**2) < chi2.ppf(0.95, len(bands) - 1))
