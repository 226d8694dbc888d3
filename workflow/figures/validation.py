"""A model against records: its free run, tests of what it leaves of them, and the scatter of repeats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ident.checks.validation import FreshFit, ScatterRow
from workflow.figures import style
from workflow.figures.bands import Real, liveliest, outline
from workflow.figures.description import Picture, new_picture
from workflow.figures.subjects import ChannelView
from workflow.text.formats import share

# Roles of a record in the title.
_WORDS = {
    "validation": "validation record",
    "repeat": "repeat of a fitted record",
    "estimation": "record of the fit",
}
# The measured output, under the simulated one.
_THICK = style.MEASURED_LINE | {"lw": 2.4, "alpha": 0.6}
# The simulated output.
_THIN = style.MODEL_LINE | {"lw": 0.9}


@style.drawing("validation")
def draw_validation(channel: ChannelView) -> Picture:
    """The free run on a record kept back, or on the first fitted one where there is none.

    Above: both outputs, whole and close up. Below: the residual, with +-2 standard deviations of the noise.
    """
    identified = channel.found
    identification = identified.identification
    shown = channel.shown_fresh
    if shown is None:
        record = identified.used[0]
        role = "estimation"
        residual = identification.residuals[0]
        simulated = record.output[record.n_samples - residual.size :, 0] - residual
        fit = FreshFit(record.name, float(identification.fit_percent[0]), simulated, residual)
    else:
        record = channel.fresh_records[shown]
        role = identified.fresh_roles[shown]
        fit = identified.fresh[shown]
    # A delayed answer begins later than the record.
    time_s = record.time_s[record.n_samples - fit.residual.size :]
    noise = 2 * identification.noise_std
    picture, grid = new_picture(4.7, 2, 2, sharex="col", height_ratios=[1.5, 1.0], width_ratios=[1.7, 1.0])
    length = min(400, max(time_s.size // 4, min(100, time_s.size)))
    close = liveliest(fit.simulated + fit.residual, length)
    for panels, part in zip(grid.T, (slice(None), close), strict=True):
        draw_free_run(panels, time_s, fit, noise, part)
    grid[0, 0].set_title(f"{style.plain(record.name, 34)} ({_WORDS[role]}): fit {fit.fit_percent:.1f} %")
    grid[0, 1].set_title("Close-up")
    unit = record.output_units[0] if record.output_units else ""
    grid[0, 0].set(ylabel=style.two_lines(record.output_names[0], unit))
    grid[1, 0].set(ylabel=style.two_lines("residual", unit))
    return picture


def draw_free_run(panels: Any, time_s: Real, fit: FreshFit, noise: float, part: slice = slice(None)) -> None:
    """Draw a free run into two panels: measured and simulated output above, the residual below.

    time_s (T,): of the fit; noise: half width of the band around the residual; part: of the samples.
    """
    upper, lower = panels
    time = time_s[part]
    simulated = fit.simulated[part]
    residual = fit.residual[part]
    upper.plot(*outline(time, simulated + residual), **_THICK, label="measured")
    upper.plot(*outline(time, simulated), **_THIN, label="model, simulated")
    lower.plot(*outline(time, residual), **style.MEASURED_LINE | {"lw": 0.7}, label="residual")
    lower.axhspan(-noise, noise, **style.BAND, zorder=0, label="±2 std of the noise")
    lower.set(xlabel="time [s]")
    upper.set(xlim=(time[0], time[-1]))


@style.drawing("residuals")
def draw_residual_tests(channel: ChannelView) -> Picture | None:
    """Correlations of the residual, with itself and with the input; lags outside their band are marked.

    The band is that of each lag taken alone. None where the records allow no test.
    """
    tests = {test.name: test for test in channel.spread.tests}
    if not {"whiteness", "independence"} <= tests.keys():
        return None
    whiteness = tests["whiteness"]
    independence = tests["independence"]
    picture, panels = new_picture(3.5, 1, 2, width_ratios=[1.0, 1.35])
    left, right = panels
    dots = {"ls": "none", "ms": 4}
    for panel, test in zip(panels, (whiteness, independence), strict=True):
        lags = test.lags
        size = test.correlation
        panel.fill_between(
            lags, -test.band, test.band, **style.BAND, label=f"{share(test.level)} band of each lag"
        )
        panel.uprights(lags, 0.0, size, color=style.MEASURED, lw=0.9)
        panel.plot(lags, size, marker=".", color=style.MEASURED, label="inside", **dots)
        outside = np.abs(size) > test.band
        if outside.any():
            panel.plot(
                lags[outside], size[outside], marker="o", color=style.ACHIEVED, label="outside", **dots
            )
        panel.axhline(0, color="#555555", lw=0.8)
        reach = 1.25 * max(float(np.abs(size).max()), float(test.band.max()), 1e-6)
        panel.set(ylim=(-reach, reach))
        panel.x.margin = 0.02
        panel.set(xlabel="lag [samples]")
    left.set(ylabel="correlation [1]")
    # "passed" is about all lags together; single lags outside their band are expected now and then.
    name = style.plain(channel.name, 24)
    left.set_title(f"Residual, {name}: {'white' if whiteness.passed else 'not white'}")
    right.set_title(f"With the input: {'independent' if independence.passed else 'not independent'}")
    return picture


@style.drawing("repeats")
def draw_repeat_scatter(rows: Sequence[ScatterRow], name: str) -> Picture:
    """Scatter of repeats over the gain in each band, predicted and measured, and their ratio.

    rows: of the bands, one or more (ValueError without); name: of the channel, for the title.
    """
    if not rows:
        raise ValueError("there is no band of repeat scatter to draw")
    picture, (upper, lower) = new_picture(4.4, 2, 1, sharex=True, height_ratios=[1.5, 1.0])
    for panel, field, factor, color, label in (
        (upper, "predicted", 100, style.MODEL, "one repeat, predicted"),
        (upper, "measured", 100, style.MEASURED, "measured between repeats"),
        (upper, "between", 100, style.HIGHLIGHT, "between conditions (amplitude, day)"),
        (lower, "ratio", 1, style.MEASURED, None),
        (lower, "between_ratio", 1, style.HIGHLIGHT, None),
    ):
        for row in rows:
            value = factor * getattr(row, field)
            if np.isfinite(value) and value > 0:
                ends = [row.omega_low_rad_s * 1.02, row.omega_high_rad_s / 1.02]
                panel.plot(ends, [value, value], color=color, lw=3, solid_capstyle="butt", label=label)
    upper.set(xscale="log", yscale="log", ylabel="scatter / gain [%]")
    upper.set_title(f"Repeat scatter: {style.plain(name, 40)}")
    lower.axhline(1.0, color=style.MODEL, lw=1.2)
    lower.set(yscale="log", xlabel="frequency [rad/s]", ylabel="measured /\npredicted [1]")
    low, high = lower.y.limits()
    lower.set(ylim=(min(0.4, low), max(2.5, high)))
    upper.hertz = True
    return picture
