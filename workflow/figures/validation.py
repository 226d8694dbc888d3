"""Measured output against the model's free run on a record, and what is left."""

from __future__ import annotations

from matplotlib.figure import Figure

from ident.checks.validation import fit_on_fresh_data
from workflow.figures import style
from workflow.figures.bands import liveliest, outline
from workflow.figures.registry import drawing
from workflow.figures.subjects import ChannelView

_WORDS = {
    "validation": "validation record",
    "repeat": "repeat of a fitted record",
    "estimation": "record of the fit",
}
_THICK = style.MEASURED_LINE | {"lw": 2.4, "alpha": 0.6}
_THIN = style.MODEL_LINE | {"lw": 0.9}


@drawing("validation")
def draw_validation(channel: ChannelView) -> Figure:
    """The free run on a record kept back, or on the first fitted one where there is none.

    Above: both outputs, whole and close up. Below: the residual, with +-2 standard deviations of the noise.
    """
    found, shown = channel.found, channel.shown_fresh
    if shown is None:
        record, role = found.used[0], "estimation"
        fit = fit_on_fresh_data(found.model, record)
    else:
        record, role, fit = channel.fresh_records[shown], found.fresh_roles[shown], found.fresh[shown]
    measured, time_s = record.output[:, 0], record.time_s
    noise = 2 * found.identification.noise_std
    figure, grid = style.panels(4.7, 2, 2, sharex="col", height_ratios=[1.5, 1.0], width_ratios=[1.7, 1.0])
    length = min(400, max(time_s.size // 4, min(100, time_s.size)))
    for (upper, lower), part in zip(grid.T, (slice(None), liveliest(measured, length)), strict=True):
        time = time_s[part]
        upper.plot(*outline(time, measured[part]), **_THICK, label="measured")
        upper.plot(*outline(time, fit.simulated[part]), **_THIN, label="model, simulated")
        lower.plot(*outline(time, fit.residual[part]), **style.MEASURED_LINE | {"lw": 0.7}, label="residual")
        label = "±2 standard deviations of the noise"
        lower.axhspan(-noise, noise, **style.BAND, zorder=0, label=label)
        lower.set_xlabel("time [s]")
        upper.set_xlim(time[0], time[-1])
    grid[0, 0].set_title(f"{style.plain(record.name, 34)} ({_WORDS[role]}): fit {fit.fit_percent:.1f} %")
    grid[0, 1].set_title("Close-up")
    unit = record.output_units[0] if record.output_units else ""
    grid[0, 0].set_ylabel(style.two_lines(record.output_names[0], unit))
    grid[1, 0].set_ylabel(style.two_lines("residual", unit))
    return figure
