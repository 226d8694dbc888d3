"""Residual tests: is what the model leaves white, and is it independent of the input?"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ident.checks.residual_tests import ResidualTest
from workflow.figures import style
from workflow.figures.registry import drawing
from workflow.figures.subjects import ChannelView


@drawing("residuals")
def draw_channel(channel: ChannelView) -> Figure | None:
    """Of a channel; nothing where its records allow no test."""
    tests = {test.name: test for test in channel.spread.tests}
    if not {"whiteness", "independence"} <= tests.keys():
        return None
    return draw_residual_tests(tests["whiteness"], tests["independence"], name=channel.name)


def draw_residual_tests(whiteness: ResidualTest, independence: ResidualTest, *, name: str) -> Figure:
    """Both correlations with the band of each lag taken alone; lags outside it are marked."""
    with style.house_style():
        figure = style.new_figure(3.5)
        panels = figure.subplots(1, 2, width_ratios=[1.0, 1.35])
        for axes, test in zip(panels, (whiteness, independence), strict=True):
            band = f"{100 * test.level:.4g} % band of each lag"
            axes.fill_between(test.lags, -test.band, test.band, **style.BAND, label=band)
            axes.vlines(test.lags, 0, test.correlation, color=style.MEASURED, lw=0.9)
            axes.plot(
                test.lags, test.correlation, ls="none", marker=".", ms=4, color=style.MEASURED, label="inside"
            )
            outside = np.abs(test.correlation) > test.band
            if outside.any():
                axes.plot(
                    test.lags[outside],
                    test.correlation[outside],
                    ls="none",
                    marker="o",
                    ms=4,
                    color=style.ACHIEVED,
                    label="outside",
                )
            axes.axhline(0, color="#555555", lw=0.8)
            reach = 1.25 * max(float(np.abs(test.correlation).max()), float(test.band.max()), 1e-6)
            axes.set_ylim(-reach, reach)
            axes.margins(x=0.02)
            axes.set_xlabel("lag [samples]")
        left, right = panels
        left.set_ylabel("correlation [1]")
        # "passed" is about all lags together; single lags outside their band are expected now and then.
        left.set_title(f"Residual, {style.plain(name, 24)}: {'white' if whiteness.passed else 'not white'}")
        right.set_title(f"With the input: {'independent' if independence.passed else 'not independent'}")
        style.finish(figure, panels, columns=3)
    return figure
