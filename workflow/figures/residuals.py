"""Residual tests: is what the model leaves white, and is it independent of the input?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.bands import Real


@dataclass(frozen=True, eq=False)
class ResidualCurves:
    """Normalised autocorrelation (L,) at lags (L,) and cross-correlation with the input (K,) at cross_lags
    (K,).

    band and cross_band (scalar or (L,), (K,)): half-widths of the `level` bands; white / independent: the
    verdicts.
    """

    lags: Real
    autocorrelation: Real
    band: Real
    cross_lags: Real
    cross_correlation: Real
    cross_band: Real
    level: float
    white: bool
    independent: bool


def draw_residual_tests(curves: ResidualCurves, *, name: str) -> Figure:
    """Both correlations with their bands; points outside are marked."""
    percent = f"{100 * curves.level:.4g} %"
    with style.house_style():
        figure = style.new_figure(3.5)
        left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.35])
        for axes, lags, values, band in (
            (left, curves.lags, curves.autocorrelation, curves.band),
            (right, curves.cross_lags, curves.cross_correlation, curves.cross_band),
        ):
            half = np.broadcast_to(np.asarray(band, dtype=np.float64), lags.shape)
            axes.fill_between(lags, -half, half, **style.BAND, label=f"{percent} band")
            axes.vlines(lags, 0, values, color=style.MEASURED, lw=0.9)
            axes.plot(lags, values, ls="none", marker=".", ms=4, color=style.MEASURED, label="inside")
            outside = np.abs(values) > half
            if axes is left:
                outside = outside & (lags != 0)
            if outside.any():
                axes.plot(
                    lags[outside],
                    values[outside],
                    ls="none",
                    marker="o",
                    ms=4,
                    color=style.ACHIEVED,
                    label="outside",
                )
            axes.axhline(0, color="#555555", lw=0.8)
            beyond = values[lags != 0] if axes is left else values
            reach = 1.25 * max(float(np.abs(beyond).max()) if beyond.size else 0.0, float(half.max()), 1e-6)
            axes.set_ylim(-reach, reach)
            axes.margins(x=0.02)
            axes.set_xlabel("lag [samples]")
        left.set_ylabel("correlation [1]")
        left.set_title(f"Residual of {style.plain(name, 22)}: {'white' if curves.white else 'not white'}")
        right.set_title(f"Residual with input: {'independent' if curves.independent else 'not independent'}")
        style.legend_below(figure, (left, right), columns=3)
    return figure
