"""The proposed experiment: its voltage, and what the two likeliest answers would show differently."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from workflow.figures import gap_style, style
from workflow.figures.bands import outline
from workflow.figures.gap_where import SENSOR_COLOURS

Real = npt.NDArray[np.float64]


def draw_next_experiment(time_s: Real, voltage_V: Real, difference: Real, names: tuple[str, str]) -> Figure:
    """voltage_V (T,); difference (T, 2): first answer minus second, in noise deviations, hub before tip."""
    with style.house_style():
        figure = style.new_figure(4.2)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1.0, 1.3])
        above.step(time_s, voltage_V, where="post", color=style.REFERENCE, lw=0.8)
        above.set_ylabel("voltage [V]")
        above.set_title("Proposed experiment")
        below.axhspan(-2, 2, color="#e6e6e6", lw=0, label="2 standard deviations of the sensor noise")
        for column, colour in enumerate(SENSOR_COLOURS.values()):
            below.plot(
                *outline(time_s, difference[:, column]),
                color=colour,
                lw=1.0,
                label=gap_style.SENSOR_WORDS[column],
            )
        below.set_title(
            f"{style.plain(names[0], 48)} minus {style.plain(names[1], 48)}",
            fontweight="normal",
            fontsize=9.5,
        )
        below.set_xlabel("time [s]")
        below.set_ylabel("difference\nover noise [1]")
        below.margins(x=0.01)
        style.finish(figure, below, columns=3)
    return figure
