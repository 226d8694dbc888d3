"""Measured output against the model's free run on a record, and what is left."""

from __future__ import annotations

from typing import Literal

import numpy as np
from matplotlib.figure import Figure

from ident.checks.validation import FreshFit, fit_on_fresh_data
from ident.data.record import Record
from workflow.figures import style
from workflow.figures.bands import outline
from workflow.figures.registry import drawing
from workflow.figures.subjects import ChannelView

_WORDS = {
    "validation": "validation record",
    "repeat": "repeat of a fitted record",
    "estimation": "record of the fit",
}


@drawing("validation")
def draw_channel(channel: ChannelView) -> Figure:
    """The free run of a channel on a record kept back, or on the first fitted one where there is none."""
    found, shown = channel.found.identification, channel.shown_fresh
    if shown is None:
        record = channel.found.used[0]
        fit = fit_on_fresh_data(found.model, record)
        return draw_validation(record, fit, kept_as="estimation", noise_std=found.noise_std)
    return draw_validation(
        channel.fresh_records[shown],
        channel.found.fresh[shown],
        kept_as=channel.found.fresh_roles[shown],
        noise_std=found.noise_std,
    )


def draw_validation(
    record: Record,
    fit: FreshFit,
    *,
    kept_as: Literal["validation", "repeat", "estimation"],
    noise_std: float | None = None,
    zoom_samples: int = 400,
) -> Figure:
    """Above: both outputs, whole and close up. Below: the residual, with +-2 standard deviations of the
    noise.

    `record` has one input and one output; `kept_as` is its role: a repeat of a fitted experiment is no fresh
    one.
    """
    measured, time_s = record.output[:, 0], record.time_s
    with style.house_style():
        figure = style.new_figure(4.7)
        grid = figure.subplots(2, 2, sharex="col", height_ratios=[1.5, 1.0], width_ratios=[1.7, 1.0])
        length = min(zoom_samples, max(time_s.size // 4, min(100, time_s.size)))
        energy = np.concatenate([[0.0], np.cumsum((measured - measured.mean()) ** 2)])
        start = int(np.argmax(energy[length:] - energy[:-length]))
        for column, part in ((0, slice(None)), (1, slice(start, start + length))):
            time = time_s[part]
            upper, lower = grid[0, column], grid[1, column]
            upper.plot(*outline(time, measured[part]), **_THICK, label="measured")
            upper.plot(*outline(time, fit.simulated[part]), **_THIN, label="model, simulated")
            lower.plot(
                *outline(time, fit.residual[part]), **(style.MEASURED_LINE | {"lw": 0.7}), label="residual"
            )
            if noise_std is not None:
                label = "±2 standard deviations of the noise"
                lower.axhspan(-2 * noise_std, 2 * noise_std, **style.BAND, zorder=0, label=label)
            lower.set_xlabel("time [s]")
            upper.set_xlim(time[0], time[-1])
        words = _WORDS[kept_as]
        grid[0, 0].set_title(f"{style.plain(record.name, 34)} ({words}): fit {fit.fit_percent:.1f} %")
        grid[0, 1].set_title("Close-up")
        unit = record.output_units[0] if record.output_units else ""
        grid[0, 0].set_ylabel(style.two_lines(record.output_names[0], unit))
        grid[1, 0].set_ylabel(style.two_lines("residual", unit))
        figure.align_ylabels()
        style.finish(figure, grid.ravel(), columns=4)
    return figure


_THICK = style.MEASURED_LINE | {"lw": 2.4, "alpha": 0.6}
_THIN = style.MODEL_LINE | {"lw": 0.9}
