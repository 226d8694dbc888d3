"""Measured output against the model's on a record, and what is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.bands import Real, outline


@dataclass(frozen=True, eq=False)
class ModelCheck:
    """One record against the model: measured and modelled (T,), in `unit`; fit_percent = 100 (1 - |e| / |y -
    mean|).

    fresh: whether the fit never saw this record.
    """

    record_name: str
    output: tuple[str, str]
    time_s: Real
    measured: Real
    modelled: Real
    fit_percent: float
    fresh: bool
    noise_std: float | None = None


def draw_validation(check: ModelCheck, *, zoom_samples: int = 400) -> Figure:
    """Above: both outputs, whole and close up. Below: the residual, with +-2 standard deviations of the
    noise."""
    residual = check.measured - check.modelled
    with style.house_style():
        figure = style.new_figure(4.7)
        grid = figure.subplots(2, 2, sharex="col", height_ratios=[1.5, 1.0], width_ratios=[1.7, 1.0])
        length = min(zoom_samples, max(check.time_s.size // 4, min(100, check.time_s.size)))
        energy = np.concatenate([[0.0], np.cumsum((check.measured - check.measured.mean()) ** 2)])
        start = int(np.argmax(energy[length:] - energy[:-length]))
        close = slice(start, start + length)
        for column, part in ((0, slice(None)), (1, close)):
            time = check.time_s[part]
            upper, lower = grid[0, column], grid[1, column]
            upper.plot(
                *outline(time, check.measured[part]),
                **(style.MEASURED_LINE | {"lw": 2.4, "alpha": 0.6}),
                label="measured",
            )
            upper.plot(
                *outline(time, check.modelled[part]), **(style.MODEL_LINE | {"lw": 0.9}), label="model"
            )
            lower.plot(
                *outline(time, residual[part]), **(style.MEASURED_LINE | {"lw": 0.7}), label="residual"
            )
            if check.noise_std is not None:
                lower.axhspan(
                    -2 * check.noise_std,
                    2 * check.noise_std,
                    **style.BAND,
                    zorder=0,
                    label="±2 standard deviations of the noise",
                )
            lower.set_xlabel("time [s]")
            upper.set_xlim(time[0], time[-1])
        words = "fresh record" if check.fresh else "record of the fit"
        grid[0, 0].set_title(f"{style.plain(check.record_name, 34)} ({words}): fit {check.fit_percent:.1f} %")
        grid[0, 1].set_title("Close-up")
        name = style.plain(check.output[0], 22)
        unit = style.plain(check.output[1], 16) if check.output[1] else "as logged"
        grid[0, 0].set_ylabel(f"{name}\n[{unit}]")
        grid[1, 0].set_ylabel(f"residual\n[{unit}]")
        figure.align_ylabels()
        style.legend_below(figure, grid.ravel(), columns=4)
    return figure
