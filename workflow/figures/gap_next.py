"""The proposed experiment: its voltage, and what the two likeliest answers would show differently."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from diagnosis.next_experiment.next_experiment import NextExperiment
from workflow.figures import gap_style, style
from workflow.figures.bands import outline
from workflow.figures.registry import drawing

Real = npt.NDArray[np.float64]


@drawing("gap_next")
def draw_next_experiment(proposal: NextExperiment, difference: Real, names: Sequence[str]) -> Figure:
    """difference (T, 2): first answer minus second, in noise deviations, hub before tip."""
    time_s = np.arange(proposal.voltage_V.size, dtype=np.float64) * proposal.dt_s
    with style.house_style():
        figure = style.new_figure(4.2)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1.0, 1.3])
        above.step(time_s, proposal.voltage_V, where="post", color=style.REFERENCE, lw=0.8)
        above.set_ylabel("voltage [V]")
        above.set_title("Proposed experiment")
        below.axhspan(-2, 2, color="#e6e6e6", lw=0, label="2 standard deviations of the sensor noise")
        for signal, colour, words in zip(
            difference.T, gap_style.SENSOR_COLOURS, gap_style.SENSOR_WORDS, strict=True
        ):
            below.plot(*outline(time_s, signal), color=colour, lw=1.0, label=words)
        title = f"{style.plain(names[0], 48)} minus {style.plain(names[1], 48)}"
        below.set_title(title, fontweight="normal", fontsize=9.5)
        below.set_xlabel("time [s]")
        below.set_ylabel("difference\nover noise [1]")
        below.margins(x=0.01)
        style.finish(figure, below, columns=3)
    return figure
