"""Residual tests: is what the model leaves white, and is it independent of the input?"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.registry import drawing
from workflow.figures.subjects import ChannelView
from workflow.text.formats import share


@drawing("residuals")
def draw_residual_tests(channel: ChannelView) -> Figure | None:
    """Both correlations with the band of each lag taken alone, lags outside it marked.

    Nothing where the records allow no test.
    """
    tests = {test.name: test for test in channel.spread.tests}
    if not {"whiteness", "independence"} <= tests.keys():
        return None
    whiteness, independence = tests["whiteness"], tests["independence"]
    figure = style.new_figure(3.5)
    panels = left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.35])
    dots = {"ls": "none", "ms": 4}
    for axes, test in zip(panels, (whiteness, independence), strict=True):
        lags, size = test.lags, test.correlation
        axes.fill_between(
            lags, -test.band, test.band, **style.BAND, label=f"{share(test.level)} band of each lag"
        )
        axes.vlines(lags, 0, size, color=style.MEASURED, lw=0.9)
        axes.plot(lags, size, marker=".", color=style.MEASURED, label="inside", **dots)
        outside = np.abs(size) > test.band
        if outside.any():
            axes.plot(lags[outside], size[outside], marker="o", color=style.ACHIEVED, label="outside", **dots)
        axes.axhline(0, color="#555555", lw=0.8)
        reach = 1.25 * max(float(np.abs(size).max()), float(test.band.max()), 1e-6)
        axes.set_ylim(-reach, reach)
        axes.margins(x=0.02)
        axes.set_xlabel("lag [samples]")
    left.set_ylabel("correlation [1]")
    # "passed" is about all lags together; single lags outside their band are expected now and then.
    name = style.plain(channel.name, 24)
    left.set_title(f"Residual, {name}: {'white' if whiteness.passed else 'not white'}")
    right.set_title(f"With the input: {'independent' if independence.passed else 'not independent'}")
    return figure
