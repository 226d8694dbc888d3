"""Noise and nonlinear distortion beside the gain, over frequency, one panel per amplitude."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ident.data.distortion import Distortion
from workflow.figures import style
from workflow.figures.registry import drawing


@drawing("distortion")
def draw_distortion(found: Sequence[Distortion], units: tuple[str, str]) -> Figure | None:
    """Best linear approximation, and what scatters around it at every line, as measured: points above the
    line of the noise are distortion. units: of input and output. Nothing where no record is periodic."""
    if not found:
        return None
    columns = min(len(found), 3)
    figure, places = style.small_multiples(len(found), columns, 3.9, 0.6, sharex=True, sharey=True)
    for axes, levels in zip(places, found, strict=True):
        omega = levels.omega_rad_s
        axes.plot(omega, np.abs(levels.gain), **style.MODEL_LINE, label="gain, best linear approximation")
        if levels.noise_std is not None:
            noise = levels.noise_std / np.sqrt(levels.periods)
            axes.plot(omega, noise, **style.MEASURED_LINE | {"lw": 1.6}, label="noise, mean of the periods")
        for lines, marker, colour, label in (
            (levels.even, "x", style.LIMIT, "even detection line"),
            (levels.excited, ".", style.PREDICTED, "between realisations"),
            (levels.odd, "o", style.ACHIEVED, "odd detection line"),
        ):
            if lines is not None:
                dots: dict[str, Any] = {"ls": "none", "marker": marker, "ms": 3.5, "mew": 0.7}
                axes.plot(lines.omega_rad_s, np.sqrt(lines.power), color=colour, label=label, **dots)
        axes.set(xscale="log", yscale="log")
        axes.set_title(f"{levels.rms:.3g} {style.plain(units[0], 10)} rms".replace("  ", " "))
        style.hertz_axis(axes)
        axes.set_xlabel("frequency [rad/s]")
    places[0].set_ylabel(f"level [{style.ratio_unit(units[1], units[0])}]")
    return figure
