"""Where the gap lies: by frequency, by experiment and sensor, by regime, and what it depends on."""

from __future__ import annotations

import numpy as np

from diagnosis.where.findings import SENSORS, BandGap, Where
from workflow.engine import codec
from workflow.figures import gap_style, style
from workflow.figures.bands import Real
from workflow.figures.description import Picture, X, new_picture, small_multiples
from workflow.text.dependence import missing_words, variable_words
from workflow.text.formats import portion

# Words and colour of sensors that a rig always has.
_LOOKS = {SENSORS[output][0]: (words, colour) for output, (words, _, colour) in gap_style.OUTPUTS.items()}
# Panels at most: two rows.
_MOST_REGIMES = 6
# Bins whose labels are words: those of three overlap.
_FEW_BINS = 2
# Intervals.
_WHISKER = {"color": "#444444", "lw": 1.0}
# What regimes are told by, in words.
_REGIMES = {
    "speed_sign": "sign of the hub speed",
    "speed_size": "size of the hub speed",
    "reversal": "time from the last reversal",
    "angle": "hub angle",
    "deflection": "deflection of the link",
    "command_size": "size of the command",
    "time": "time since start",
}


def _size(model_error: float) -> tuple[float, str]:
    """Factor and words of a gap that `where` found: over the noise, or in per cent of the motion."""
    if model_error > 0:
        return 100 * model_error, "model error [% of the motion]"
    return 1.0, "model error over noise, RMS [1]"


def _of_band(where: Where, band: BandGap, model_error: float) -> tuple[float, Real]:
    """Size and interval to draw: over the noise per line, or what the band has of its sensor's per cent."""
    if not model_error > 0:
        return band.gap.gap_rms, np.array(band.gap.interval)
    whole = 100 * model_error * where.gap.gap_rms * np.sqrt(len(where.sensors))
    share, *ends = np.sqrt(np.maximum([band.gap.share, *band.gap.share_interval], 0.0)) * whole
    return float(share), np.array(ends)


def _look(where: Where, sensor: str) -> tuple[str, str]:
    """Words and colour of a sensor in these pictures."""
    sensors = [of_sensor.sensor for of_sensor in where.sensors]
    words, _, colour = gap_style.look_of(sensor, sensors.index(sensor))
    return _LOOKS.get(sensor, (words, colour))


@style.drawing("gap_bands")
def draw_bands_and_experiments(where: Where, model_error: float = 0.0) -> Picture:
    """Size of the gap, noise (or what a model may miss) taken off: by band and experiment, of every sensor.

    With 95 % intervals. Parts in which nothing is found beyond chance are drawn pale. The frequency panel
    ends at 0.05 noise deviations; less is drawn at its edge.
    """
    experiments = where.experiments
    factor, words = _size(model_error)
    # A bar of every experiment needs its room.
    height_in = max(3.7, 1.7 + 0.36 * len(experiments))
    picture, (left, right) = new_picture(height_in, 1, 2, width_ratios=[1.25, 1.0])
    sensors = [of_sensor.sensor for of_sensor in where.sensors]
    apart = np.linspace(-1.0, 1.0, len(sensors)) if len(sensors) > 1 else np.zeros(1)
    # Whiskers of several sensors stand beside each other.
    for sensor, shift in zip(sensors, 1 + 0.03 * apart, strict=True):
        name, colour = _look(where, sensor)
        for band in (band for band in where.bands if band.sensor == sensor):
            # A band may begin at zero, which has no place on a logarithmic axis: an eighth of its end counts.
            low_Hz = max(band.low_Hz, 0.5 * band.high_Hz / 4)
            middle = shift * np.sqrt(low_Hz * band.high_Hz)
            size, interval = _of_band(where, band, model_error)
            # What is smaller has no place on a logarithmic axis.
            least = factor * gap_style.LEAST
            left.plot(
                [band.low_Hz, band.high_Hz],
                [max(size, least)] * 2,
                color=colour,
                alpha=1.0 if band.gap.found else 0.35,
                lw=4.0,
                solid_capstyle="butt",
            )
            left.plot([middle, middle], np.maximum(interval, least), **_WHISKER)
        left.plot([], [], color=colour, lw=4.0, label=name)
    left.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel=words)
    # Up to the threshold at least, so that a frame in which nothing is large is not empty.
    left.set(ylim=(factor * gap_style.LEAST, max(left.y.limits()[1], factor)))
    left.set_title("By frequency")
    for row, entry in enumerate(experiments):
        for sensor, part, offset in zip(sensors, entry.sensors, 0.15 * apart, strict=True):
            pale = 1.0 if part.found else 0.35
            right.bars(
                row + offset,
                factor * part.gap_rms,
                0.54 / len(sensors),
                lying=True,
                color=_look(where, sensor)[1],
                alpha=pale,
            )
            right.plot(factor * np.array(part.interval), [row + offset] * 2, **_WHISKER)
    right.y.named = [(k, style.plain(entry.experiment, 30)) for k, entry in enumerate(experiments)]
    right.set(
        xlim=(0.0, None), ylim=(len(experiments) - 0.5, -0.5), xlabel=words, title="By experiment and sensor"
    )
    right.grid_lines[1] = False
    left.plot([], [], **_WHISKER, label="95 % interval")
    return picture


@style.drawing("gap_regimes")
def draw_regimes(where: Where, model_error: float = 0.0) -> Picture | None:
    """Residual energy over a regime variable where it depends on it, with what chance would give."""
    findings = [finding for finding in where.regimes if finding.found][:_MOST_REGIMES]
    if not findings:
        return None
    floor = "the\nthreshold" if model_error > 0 else "the noise"
    picture, panels = small_multiples(len(findings), min(3, max(2, len(findings))), 2.6, 0.9)
    for panel, finding in zip(panels, findings, strict=True):
        at = np.arange(len(finding.bins))
        count = len(finding.bins)
        low, high = np.array([of_bin.interval for of_bin in finding.bins]).T
        panel.bars(at, high, 0.8, begins=low, color="#dddddd", label="95 % of what chance gives")
        name, colour = _look(where, finding.sensor)
        panel.plot(
            at,
            [of_bin.energy for of_bin in finding.bins],
            marker="o",
            ls="none",
            ms=6,
            color=colour,
            label=name,
        )
        # The label where there is room for words, else the range on two lines.
        named = []
        for of_bin in finding.bins:
            if count <= _FEW_BINS:
                named.append(style.plain(of_bin.label, 24))
            else:
                named.append(f"{of_bin.low:.2g}\nto {of_bin.high:.2g}")
        panel.x.named = list(zip(at, named, strict=True))
        panel.tick_size[X] = 8.0
        panel.axhline(1.0, **gap_style.floor_of(model_error))
        panel.set(ylim=(0, None))
        panel.grid_lines[0] = False
        panel.set(xlabel=_with_unit(_REGIMES.get(finding.axis, finding.axis), finding.unit))
        panel.set(ylabel=f"residual energy\nover that of {floor} [1]")
        panel.set_title(name, size=9.5, bold=False)
    return picture


@style.drawing("gap_dependences")
def draw_dependences(where: Where) -> Picture | None:
    """The missing force, or error of a reading, over what it depends on, two standard errors either side."""
    dependences = where.dependences
    if not dependences:
        return None
    picture, panels = small_multiples(len(dependences), 2, 2.9, 0.9)
    for panel, dependence in zip(panels, dependences, strict=True):
        plain = codec.plain(dependence)
        at = np.array(dependence.centres)
        value = np.array(dependence.values)
        error = 2 * np.array(dependence.standard_errors)
        panel.fill_between(at, value - error, value + error, **style.BAND, label="two standard errors")
        panel.plot(at, value, color=style.MODEL, lw=1.6, label="what is missing")
        panel.axhline(0, color="#555555", lw=0.8)
        panel.set(xlabel=_with_unit(variable_words(plain).removeprefix("the "), dependence.unit))
        panel.set(ylabel=_with_unit(missing_words(plain), dependence.value_unit.replace("Nm", "N m")))
        panel.set_title(
            f"{portion(dependence.share)} of the error on {dependence.judged_on} not used",
            size=9.5,
            bold=False,
        )
    return picture


def _with_unit(words: str, unit: str) -> str:
    return f"{words} [{unit}]" if unit else words
