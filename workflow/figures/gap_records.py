"""Residuals as they are: over time in every experiment, and over frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from scipy.signal import welch

from workflow.figures import gap_style, style
from workflow.figures.bands import outline

Real = npt.NDArray[np.float64]

_SEGMENT = 512
_TRACE_BINS = 250  # a panel is some 400 pixels wide


@dataclass(frozen=True, eq=False)
class ResidualRecord:
    """One experiment: model ("stated", "refit", "repaired") -> residuals over noise (T, 2)."""

    name: str
    held_out: bool
    residuals: Mapping[str, Real]


def draw_residual_traces(records: Sequence[ResidualRecord], dt_s: float) -> Figure:
    """Rows are experiments, columns are sensors; the band is two standard deviations of the sensor noise."""
    with style.house_style():
        figure = style.new_figure(0.9 + 1.25 * len(records))
        grid = figure.subplots(len(records), 2, sharex="row", squeeze=False)
        for row, record in zip(grid, records, strict=True):
            time = np.arange(len(record.residuals["stated"]), dtype=np.float64) * dt_s
            for column, axes in enumerate(row):
                axes.axhspan(-2, 2, color="#e6e6e6", lw=0, label="2 standard deviations of the sensor noise")
                for name, signal in record.residuals.items():
                    look = {**gap_style.MODELS[name], "lw": 0.7, "ls": "-"}
                    axes.plot(
                        *outline(time, signal[:, column], _TRACE_BINS), **look, label=gap_style.WORDS[name]
                    )
                largest = max(float(np.max(np.abs(e[:, column]))) for e in record.residuals.values())
                reach = max(4.0, 1.05 * largest)
                axes.set_ylim(-reach, reach)
                axes.margins(x=0.01)
                role = " (held out)" if record.held_out else ""
                axes.set_title(
                    f"{style.plain(record.name, 30)}{role}: {gap_style.SENSOR_WORDS[column]}",
                    fontsize=9,
                    fontweight="normal",
                )
            row[0].set_ylabel("residual\nover noise [1]", fontsize=8.5)
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
        style.finish(figure, grid.ravel(), columns=3)
    return figure


def draw_residual_spectra(
    by_model: Mapping[str, Sequence[Real]], modes_Hz: Sequence[float], dt_s: float
) -> Figure:
    """Spectra of the residuals over noise, all experiments together; white noise of the stated size is 1.

    by_model: "stated", "refit", "repaired" -> residuals (T, 2) of every experiment. modes_Hz: flexible modes
    of the rig as stated; the lowest three are marked.
    """
    with style.house_style():
        figure = style.new_figure(3.7)
        panels = figure.subplots(1, 2, sharey=True)
        for column, axes in enumerate(panels):
            for name, residuals in by_model.items():
                frequency, power = _spectrum([r[:, column] for r in residuals], dt_s)
                axes.loglog(frequency, power, **gap_style.MODELS[name], label=gap_style.WORDS[name])
            axes.axhline(1.0, **gap_style.FLOOR, label=gap_style.WORDS["floor"])
            for number, mode in enumerate(modes_Hz[:3], 1):
                if mode < 0.5 / dt_s:
                    axes.axvline(mode, color="#999999", lw=0.8, ls=":")
                    style.tag_below(axes, mode, f"mode {number}")
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, 0.1), max(high, 10.0))
            axes.set_xlabel("frequency [Hz]")
            axes.set_title(f"Residual of the {gap_style.SENSOR_WORDS[column]}")
        panels[0].set_ylabel("power over that of the noise [1]")
        style.finish(figure, panels)
    return figure


def _spectrum(signals: Sequence[Real], dt_s: float) -> tuple[Real, Real]:
    """Welch's estimate over all records, relative to white noise of unit variance."""
    length = min(_SEGMENT, *(s.size for s in signals))
    total, weight = np.zeros(length // 2 + 1), 0
    frequency = np.asarray(np.fft.rfftfreq(length, dt_s), dtype=np.float64)
    for signal in signals:
        _, power = welch(signal, 1 / dt_s, nperseg=length, detrend=False)
        total += signal.size * power
        weight += signal.size
    # One-sided density of unit white noise: 2 dt.
    return frequency[1:], np.asarray(total / weight / (2 * dt_s))[1:]
