"""Where a model error lies, in sentences; nothing is said where nothing is found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from diagnosis.where.findings import (
    AmplitudeFinding,
    Concentration,
    ExperimentGap,
    Growth,
    LinearCorrection,
    PartGap,
    PeriodicFinding,
    Where,
)
from workflow.engine import codec
from workflow.text.dependence import alternatives_words, dependence_short, dependence_words
from workflow.text.formats import interval, number, portion, sentence, share as percentage
from workflow.text.names import name_words

# From this share on what is left over is a rounding error: the number is not said.
PRACTICALLY_ALL = 0.995
# A share whose 95 % interval is no wider than this on either side is said as it is, a wider one by its end.
SURE_SHARE = 0.05
# An interval narrower than this share of its value says nothing that two digits do not. Chosen.
NARROW_INTERVAL = 0.1
# The largest error of an experiment is said to be larger where its interval is above the smallest one's by
# this factor: less is no difference that anybody would look into. Chosen.
CLEARLY_LARGER = 1.5
# An output with less of the whole error than this is not worth a sentence on its frequencies. Chosen.
LEAST_SHARE_OF_SENSOR = 0.05
# Chances below this are not told apart.
LEAST_CHANCE = 0.001

_GROWTHS: Mapping[Growth, str] = {
    "offset": "it hardly grows with the input, as with dry friction, an offset or a disturbance",
    "saturating": "it grows less than the input",
    "linear": "it grows with the input, as in a linear machine with other parameters",
    "faster": "it grows faster than the input, as with saturation or a hardening spring",
}


@dataclass(frozen=True)
class Floor:
    """What a model error is measured by.

    Attributes:
        model_error: Threshold as a share of the motion; 0 where the simulation is to be as good as the
            sensors, whose noise is the floor then.
    """

    model_error: float

    @property
    def is_threshold(self) -> bool:
        return self.model_error > 0

    @property
    def words(self) -> str:
        return "the threshold" if self.is_threshold else "the noise"

    @property
    def units(self) -> str:
        """What a number of floors counts."""
        return "times the threshold" if self.is_threshold else "noise deviations"

    def times(self, gap_rms: float) -> float:
        """An error with the floor taken off, over the floor as it is said.

        At a threshold nothing is taken off, as in the tables of the page.
        """
        return math.sqrt(1 + gap_rms**2) if self.is_threshold else gap_rms

    def said(self, gap_rms: float) -> str:
        """`times` in two digits."""
        return number(self.times(gap_rms), 2)


def share_words(share: float) -> str:
    """A share of an error in whole per cent."""
    return "practically all" if share >= PRACTICALLY_ALL else portion(share)


def concentration_words(run: Concentration) -> str:
    """How much of an error lies between two frequencies: the share, or its lower end where it is unsure."""
    if run.half_width <= SURE_SHARE:
        return share_words(run.share)
    return f"at least {portion(run.share - run.half_width)}"


def frequency_range(low_Hz: float, high_Hz: float, where: Where) -> str:
    """Between which frequencies: "below 2 Hz", "above 40 Hz", "between 2 and 10 Hz"."""
    if low_Hz == 0:
        return f"below {number(high_Hz)} Hz"
    if high_Hz >= max(band.high_Hz for band in where.bands):
        return f"above {number(low_Hz)} Hz"
    return f"between {number(low_Hz)} and {number(high_Hz)} Hz"


def mostly(where: Where) -> str:
    """Where most of an error lies: "mostly below 2 Hz"; "" where no narrow band has it."""
    run = where.concentration() if where.is_gap else None
    return "" if run is None else f"mostly {frequency_range(run.low_Hz, run.high_Hz, where)}"


def in_short(where: Where, floor: Floor) -> str:
    """Where the error lies, in one sentence."""
    floor_words = floor.words if floor.is_threshold else "sensor noise"
    if not where.is_gap:
        return f"No sensor, experiment or frequency band lies above {floor_words}."
    if not where.gap.gap_rms > 0:
        single = (
            "single experiments or frequency bands are above their share of it"
            if floor.is_threshold
            else "parts of them do not"
        )
        return f"All records together stay within {floor_words}; {single}."

    parts = []
    if where.dominant_sensor:
        parts.append(f"it shows in {name_words(where.dominant_sensor)}")
    run = where.concentration()
    if run is not None:
        range_words = frequency_range(run.low_Hz, run.high_Hz, where)
        parts.append(f"{concentration_words(run)} of its energy {range_words}")
    if any(drift.notable for drift in where.drift):
        parts.append("growing steadily with time")
    elif where.common_found:
        parts.append("the same in all experiments, whatever the input")
    elif where.linear is not None and where.linear.linear is not None:
        parts.append(f"{'linear' if where.linear.linear else 'not linear'} in the voltage")
    place = "; ".join(parts) or "in all sensors and frequencies"
    # The first one is the strongest; the others stand at length.
    depends = ""
    if where.dependences:
        strongest = codec.plain(where.dependences[0])
        depends = f"; {dependence_short(strongest)}"
    return f"Where it lies: {place}{depends}."


def at_length(where: Where, floor: Floor, model: str) -> tuple[str, ...]:
    """Where the error lies, a paragraph for every axis that has something to say; none without an error.

    model: the simulation whose error it is, "nominal parameters".
    """
    if not where.is_gap:
        return ()
    threshold = ""
    if floor.is_threshold:
        threshold = f"; the threshold is {percentage(floor.model_error, 2)} of the motion"
    paragraphs = [
        f"Of all records, estimation and validation, with {model}{threshold}:",
        dependences_words(where),
        sensors_words(where, floor),
        experiments_words(where, floor),
        frequencies_words(where, floor),
        regimes_words(where, floor),
        drift_words(where),
        common_words(where),
        amplitude_words(where.amplitude, where.linear),
        linear_words(where.linear),
        " ".join(periodic_words(finding, floor) for finding in where.periodic).strip(),
    ]
    return tuple(paragraph for paragraph in paragraphs if paragraph)


def dependences_words(where: Where) -> str:
    """What the error depends on, and what explains as much."""
    sentences = []
    for dependence in where.dependences:
        plain = codec.plain(dependence)
        sentences += [sentence(dependence_words(plain)), sentence(alternatives_words(plain))]
    return " ".join(words for words in sentences if words)


def sensors_words(where: Where, floor: Floor) -> str:
    """In which outputs the error shows."""
    with_error = [sensor for sensor in where.sensors if sensor.gap.found]
    only = where.dominant_sensor
    if only:
        other_sensors = [sensor for sensor in where.sensors if sensor.sensor != only]
        floor_words = floor.words if floor.is_threshold else "noise"
        little = (
            "shows next to nothing of it"
            if any(sensor.gap.found for sensor in other_sensors)
            else f"shows nothing beyond {floor_words}"
        )
        names = " and ".join(name_words(sensor.sensor) for sensor in other_sensors)
        return f"The model error shows in {name_words(only)}; {names} {little}."
    if not with_error:
        return ""
    sizes = []
    for sensor in with_error:
        times = _times_words(sensor.gap, floor)
        sizes.append(f"{times} {floor.words} in {name_words(sensor.sensor)}")
    return f"The model error is {' and '.join(sizes)}."


def _times_words(gap: PartGap, floor: Floor) -> str:
    """How many times the floor, with the interval where it is wide."""
    low, high = gap.interval
    words = f"{floor.said(gap.gap_rms)} times"
    if high - low >= NARROW_INTERVAL * gap.gap_rms:
        words += f" (95 % interval {floor.said(low)} to {floor.said(high)})"
    return words


def experiments_words(where: Where, floor: Floor) -> str:
    """In which experiments the error shows, and whether about equally."""
    with_error: list[ExperimentGap] = []
    quiet: list[ExperimentGap] = []
    for experiment in where.experiments:
        if experiment.gap.found or any(gap.found for gap in experiment.sensors):
            with_error.append(experiment)
        else:
            quiet.append(experiment)
    if not with_error:
        return ""
    if quiet and len(with_error) > len(quiet):
        names = ", ".join(_file_words(gap.experiment) for gap in quiet)
        return f"All experiments but {names} show a model error; there it stays within {floor.words}."
    if quiet:
        names = ", ".join(_file_words(gap.experiment) for gap in with_error)
        show = "shows" if len(with_error) == 1 else "show"
        return f"Only {names} {show} a model error; the others stay within {floor.words}."

    by_size = sorted(with_error, key=lambda experiment: experiment.gap.gap_rms)
    largest = by_size[-1]
    smallest = by_size[0]
    all_show = f"All {len(with_error)} experiments show the model error"
    if largest.gap.interval[0] <= CLEARLY_LARGER * smallest.gap.interval[1]:
        return f"{all_show}, about equally."
    largest_size = f"{floor.said(largest.gap.gap_rms)} {floor.units}"
    smallest_size = floor.said(smallest.gap.gap_rms)
    largest_words = f"{_file_words(largest.experiment)} most ({largest_size})"
    least = f"{_file_words(smallest.experiment)} least ({smallest_size})"
    return f"{all_show}, {largest_words}, {least}."


def _file_words(experiment: str) -> str:
    """Name of an experiment without folder and ending."""
    return experiment.split("/")[-1].removesuffix(".csv")


def frequencies_words(where: Where, floor: Floor) -> str:
    """Between which frequencies the error of every output lies."""
    sentences: list[str] = []
    for sensor in where.sensors:
        name = name_words(sensor.sensor)
        if not sensor.gap.found:
            # A concentrated error can hide in the sum over all frequencies; a band on its own still speaks.
            bands = [band for band in where.bands if band.sensor == sensor.sensor and band.gap.found]
            for band in bands:
                place = frequency_range(band.low_Hz, band.high_Hz, where)
                times = floor.said(band.gap.gap_rms)
                if floor.is_threshold:
                    begin = place[:1].upper() + place[1:]
                    sentences.append(
                        f"{begin} {name} shows {times} times what it would if the threshold were spread "
                        "evenly over all frequencies."
                    )
                else:
                    sentences.append(
                        f"In {name} it stands out of {floor.words} {place}, by {times} times {floor.words} "
                        "in that band."
                    )
            continue
        if sensor.gap.share < LEAST_SHARE_OF_SENSOR:
            continue
        run = where.concentration(sensor.sensor)
        if where.even(sensor.sensor):
            sentences.append(
                f"The model error of {name} is spread evenly over all frequencies, like more sensor noise or "
                "coarse resolution."
            )
        elif run is not None:
            place = frequency_range(run.low_Hz, run.high_Hz, where)
            sentences.append(
                f"Of the model error of {name}, {concentration_words(run)} of the energy lies {place}."
            )
    return " ".join(sentences)


def regimes_words(where: Where, floor: Floor) -> str:
    """While which variable lies where the error is larger or smaller than by chance."""
    sentences = []
    for regime in where.telling_regimes:
        peak = regime.peak
        assert peak is not None  # of a telling one
        larger = "larger" if peak.gap_rms > peak.usual else "smaller"
        chance = f"below {LEAST_CHANCE:g}" if regime.p_value < LEAST_CHANCE else number(regime.p_value, 2)
        size = f"{floor.said(peak.gap_rms)} {floor.units} against {floor.said(peak.usual)} expected there"
        sentences.append(
            f"The model error of {name_words(regime.sensor)} is {larger} {peak.label}: {size} "
            f"(chance {chance})."
        )
    return " ".join(sentences)


def drift_words(where: Where) -> str:
    """Readings that drift away from the model."""
    count = len(where.experiments)
    sentences = []
    for drift in where.drift:
        if drift.notable and drift.interval is not None:
            rate = f"{number(drift.rate)} {drift.unit} (95 % interval {interval(drift.interval, 3)})"
            sentences.append(
                f"The reading of {name_words(drift.sensor)} drifts away from the model by {rate}, alike in "
                f"all {count} experiments."
            )
    return " ".join(sentences)


def common_words(where: Where) -> str:
    """What is the same in all experiments, whatever the input was."""
    sentences = []
    for k, common in enumerate(where.common_found):
        name = name_words(common.sensor)
        if k > 0:
            sentences.append(f"The same holds for {name} ({share_words(common.share)}).")
            continue
        line = f", with a line near {number(common.peak_Hz)} Hz" if common.has_line else ""
        sentences.append(
            f"{portion(common.share)} of the energy of the model error of {name} is the same in "
            f"{common.experiments} experiments with different inputs{line}: it follows the clock, not the "
            "input."
        )
    return " ".join(sentences)


def amplitude_words(amplitude: AmplitudeFinding | None, linear: LinearCorrection | None) -> str:
    """How the error grows with the voltage.

    Another growth than "linear" is not told where a linear correction explains the error: two inputs never
    excite it quite alike.
    """
    if amplitude is None or amplitude.growth not in _GROWTHS:
        return ""
    if amplitude.growth != "linear" and linear is not None and linear.linear:
        return ""
    weaker, stronger = (_file_words(name) for name in amplitude.experiments)
    voltages = f"{number(amplitude.voltage_ratio, 2)} times the voltage ({weaker} to {stronger})"
    times = number(amplitude.gap_ratio, 2)
    return f"With {voltages} the model error is {times} times as large; {_GROWTHS[amplitude.growth]}."


def linear_words(linear: LinearCorrection | None) -> str:
    """Whether the cause acts linearly."""
    if linear is None or linear.linear is None:
        return ""
    if linear.linear:
        return (
            "The cause acts linearly, as a wrong inertia, stiffness, gain, lag or delay would: a linear "
            f"correction explains {portion(linear.share)} on the validation records."
        )
    explained = "nothing" if linear.share <= 0 else f"only {portion(linear.share)}"
    return (
        "The cause is not linear, or does not come from the input: a linear correction explains "
        f"{explained} on the validation records."
    )


def periodic_words(finding: PeriodicFinding, floor: Floor) -> str:
    """What a record with repeated periods says: the worst band, and the largest distortion."""
    bands = [band for band in finding.bands if band.found]
    groups = [group for group in finding.groups if group.found]
    sentences = []
    if bands:
        band = max(bands, key=lambda band: band.distance)
        place = f"{number(band.low_Hz)} and {number(band.high_Hz)} Hz in {name_words(band.sensor)}"
        off_percent = number(100 * band.relative_error, 2)
        times = number(band.distance, 2)
        sentences.append(
            f"The measured frequency response differs most from the model's between {place}: {off_percent} % "
            f"off, {times} times the 95 % noise radius."
        )
    if groups:
        group = max(groups, key=lambda group: group.repeated_rms)
        # A group is called "not excited, odd": its last word is the kind of distortion.
        kind = f"{group.group.split(' ')[-1]} " if finding.even_odd_separable else ""
        size = f"{number(group.repeated_rms, 2)} {floor.units}"
        sentences.append(
            f"The machine responds at frequencies that were not excited ({size}, the same in every period): "
            f"{kind}distortion, so it is not linear."
        )
    return " ".join(sentences)
