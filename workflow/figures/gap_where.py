"""Where the gap lies: by frequency, by experiment and sensor, by regime, and as a missing function."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from diagnosis.where.where_records import (
    BandGap,
    EquivalentCurve,
    ExperimentGap,
    PartGap,
    RegimeBin,
    RegimeFinding,
)
from workflow.figures import gap_style, style

SENSOR_COLOURS = {"hub_angle": style.UNCERTAIN, "tip": style.HIGHLIGHT}
_SENSOR_NAMES = {"hub_angle": "hub angle", "tip": "tip position"}
_COLUMNS = 3
_FEW_BINS = 2
_SMALLEST = 0.05  # noise deviations; less is drawn there


def draw_bands_and_experiments(bands: Sequence[BandGap], experiments: Sequence[ExperimentGap]) -> Figure:
    """Size of the gap, noise taken off, with 95 % intervals: by band and sensor, and by experiment and
    sensor.

    Parts in which nothing is found beyond chance are drawn pale. The frequency panel ends at 0.05 noise
    deviations; less is drawn at its edge.
    """
    with style.house_style():
        figure = style.new_figure(max(3.7, 1.7 + 0.36 * len(experiments)))
        left, right = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
        for sensor, name in _SENSOR_NAMES.items():
            for band in (band for band in bands if band.sensor == sensor):
                middle = float(np.sqrt(max(band.low_Hz, 0.5 * band.high_Hz / 4) * band.high_Hz))
                middle *= 0.97 if sensor == "hub_angle" else 1.03
                left.plot(
                    [band.low_Hz, band.high_Hz],
                    [max(band.gap.gap_rms, _SMALLEST)] * 2,
                    color=SENSOR_COLOURS[sensor],
                    alpha=1.0 if band.gap.found else 0.35,
                    lw=4.0,
                    solid_capstyle="butt",
                )
                _whisker(left, middle, band.gap, sensor, vertical=True)
            left.plot([], [], color=SENSOR_COLOURS[sensor], lw=4.0, label=name)
        left.set_xscale("log")
        left.set_yscale("log")
        left.set_ylim(bottom=_SMALLEST)
        left.set_xlabel("frequency [Hz]")
        left.set_ylabel("gap over noise, RMS [1]")
        left.set_title("By frequency")
        for row, entry in enumerate(experiments):
            for sensor, part, offset in zip(_SENSOR_NAMES, entry.sensors, (-0.15, 0.15), strict=True):
                right.barh(
                    row + offset,
                    part.gap_rms,
                    height=0.27,
                    color=SENSOR_COLOURS[sensor],
                    alpha=1.0 if part.found else 0.35,
                )
                _whisker(right, row + offset, part, sensor, vertical=False)
        right.set_yticks(range(len(experiments)), [style.plain(e.experiment, 30) for e in experiments])
        right.set_ylim(len(experiments) - 0.5, -0.5)
        right.grid(visible=False, axis="y")
        right.set_xlabel("gap over noise, RMS [1]")
        right.set_title("By experiment and sensor")
        left.plot([], [], color="#444444", lw=1.0, label="95 % interval")
        style.finish(figure, (left, right))
    return figure


def _whisker(axes: Axes, at: float, part: PartGap, sensor: str, *, vertical: bool) -> None:
    look: dict[str, Any] = {"color": "#444444", "lw": 1.0}
    if vertical:
        axes.plot([at, at], np.maximum(part.interval, _SMALLEST), **look)
    else:
        axes.plot(part.interval, [at, at], **look)


_REGIMES = {
    "speed_sign": "sign of the hub speed",
    "speed_size": "size of the hub speed",
    "reversal": "time from the last reversal",
    "angle": "hub angle",
    "angle_in_period": "angle within one period",
    "deflection": "deflection of the link",
    "command_size": "size of the command",
    "time": "time since start",
}


def regime_words(axis: str) -> str:
    return _REGIMES.get(axis, axis.replace("_", " "))


def _bin_words(one: RegimeBin, count: int) -> str:
    """The label where there is room for words, else the range on two lines."""
    return style.plain(one.label, 24) if count <= _FEW_BINS else f"{one.low:.2g}\nto {one.high:.2g}"


def draw_regimes(findings: Sequence[RegimeFinding]) -> Figure:
    """Residual energy over a regime variable where it depends on it, with what chance would give."""
    count = len(findings)
    rows, columns = _grid(count)
    with style.house_style():
        figure = style.new_figure(0.9 + 2.6 * rows)
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes, finding in zip(grid.ravel(), findings, strict=False):
            at = np.arange(len(finding.bins))
            energy = [one.energy for one in finding.bins]
            low, high = np.array([one.interval for one in finding.bins]).T
            axes.bar(
                at, high - low, bottom=low, width=0.8, color="#dddddd", label="95 % of what chance gives"
            )
            axes.plot(
                at,
                energy,
                "o",
                ms=6,
                color=SENSOR_COLOURS[finding.sensor],
                label=_SENSOR_NAMES[finding.sensor],
            )
            axes.set_xticks(at, [_bin_words(one, len(finding.bins)) for one in finding.bins], fontsize=8)
            axes.axhline(1.0, **gap_style.FLOOR, label=gap_style.WORDS["floor"])
            axes.set_ylim(bottom=0)
            axes.grid(visible=False, axis="x")
            unit = f" [{finding.unit}]" if finding.unit else ""
            axes.set_xlabel(f"{regime_words(finding.axis)}{unit}")
            axes.set_title(_SENSOR_NAMES[finding.sensor], fontsize=9.5, fontweight="normal")
        for axes in grid.ravel()[count:]:
            axes.set_axis_off()
        for axes in grid[:, 0]:
            axes.set_ylabel("residual energy\nover that of the noise [1]")
        style.finish(figure, grid.ravel())
    return figure


_ROUTES = {"hub_torque": "torque on the hub", "hub_angle": "hub angle reading", "tip": "tip reading"}


def _grid(count: int) -> tuple[int, int]:
    """Rows and columns for so many panels; a single one does not fill the page."""
    columns = min(_COLUMNS, max(2, count))
    return -(-count // columns), columns


def draw_curves(curves: Sequence[EquivalentCurve]) -> Figure:
    """The gap read as one missing function of a variable, two standard errors either side."""
    count = len(curves)
    rows, columns = _grid(count)
    with style.house_style():
        figure = style.new_figure(0.9 + 2.6 * rows)
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes, curve in zip(grid.ravel(), curves, strict=False):
            at, value = np.array(curve.centres), np.array(curve.values)
            error = 2 * np.array(curve.standard_errors)
            axes.fill_between(at, value - error, value + error, **style.BAND, label="two standard errors")
            axes.plot(at, value, "o-", color=style.MODEL, ms=4, lw=1.0, label="what is missing")
            axes.axhline(0, color="#555555", lw=0.8)
            unit = f" [{curve.unit}]" if curve.unit else ""
            axes.set_xlabel(f"{curve.axis.replace('_', ' ')}{unit}")
            axes.set_ylabel(f"{_ROUTES.get(curve.route, curve.route)} [{curve.value_unit}]")
            axes.set_title(f"{100 * curve.share:.0f} % of the gap energy", fontsize=9.5, fontweight="normal")
        for axes in grid.ravel()[count:]:
            axes.set_axis_off()
        style.finish(figure, grid.ravel())
    return figure
