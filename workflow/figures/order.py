"""How many poles: the criterion over the order, beside the modes that stay when more poles are allowed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from ident.search.order_selection import OrderStep
from ident.stabilisation import Stabilisation
from ident.uncertainty import FrequencyUncertainty
from workflow.figures import style
from workflow.figures.subjects import ChannelView

# Below this a difference of the criterion is drawn linearly, above logarithmically: a factor exp(5) = 150 in
# posterior odds is where "better" begins to mean something.
_LINEAR = 10.0


@style.drawing("order")
def draw_order(channel: ChannelView) -> Figure | None:
    """Left: criterion of every structure tried, above the best. Right: pole pairs of fits with 0, 1, 2 ...

    The response straight from the records stands faintly behind the right panel: modes belong on its peaks.
    Nothing where no other structure was tried.
    """
    plot, steps = channel.found.stabilisation, channel.found.identification.order_table
    if plot is None or not steps:
        return None
    figure, (left, right) = style.panels(4.6, 1, 2, width_ratios=[1.0, 1.7])
    _criterion(left, steps, (plot.n_real, plot.chosen))
    left.set_title(f"Criterion: {style.plain(channel.name, 16)}")
    _stabilisation(right, plot, channel.spread.empirical)
    return figure


def _criterion(axes: Axes, steps: Sequence[OrderStep], chosen: tuple[int, int]) -> None:
    order = np.array([step.order for step in steps])
    above = np.array([step.criterion for step in steps])
    above -= above.min()
    axes.plot(
        order, above, ls="none", marker="o", ms=5, mfc="white", mec=style.MODEL, label="structure tried"
    )
    lowest = np.unique(order)
    axes.plot(lowest, [above[order == n].min() for n in lowest], color=style.MODEL, lw=1.0)
    mine = [k for k, step in enumerate(steps) if (step.n_real, step.n_pairs) == chosen]
    if mine:
        label = f"the model: {chosen[0]} real, {chosen[1]} pairs"
        axes.plot(order[mine], above[mine], **style.STAR | {"ms": 14, "mew": 0.7}, label=label)
    axes.set_yscale("symlog", linthresh=_LINEAR)
    axes.set_ylim(-0.15 * _LINEAR, max(2.5 * above.max(), 1.5 * _LINEAR))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlim(order.min() - 0.6, order.max() + 0.6)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel="searched poles [1]", ylabel="criterion above the best [1]")


def _stabilisation(axes: Axes, plot: Stabilisation, response: FrequencyUncertainty | None) -> None:
    omega, count = plot.omega_rad_s, plot.n_pairs
    stable, same = plot.stable, plot.previous >= 0
    axes.set_xscale("log")
    if response is not None:
        _faint(axes, response)
    for mode in plot.columns():
        axes.axvline(mode.omega_rad_s, color=style.PREDICTED, lw=0.9, alpha=0.5)
    kinds = (
        (stable & plot.needed, "o", style.PREDICTED, style.PREDICTED, 6.5, "stays, and the data need it"),
        (stable & ~plot.needed, "o", "white", style.MEASURED, 5.5, "stays, but the data would not miss it"),
        (same & ~stable, "^", "white", style.HIGHLIGHT, 5.5, "same frequency, other damping"),
        (~same & plot.needed, "D", "white", style.PREDICTED, 5.0, "new, and needed"),
        (~same & ~plot.needed, "x", style.MEASURED, style.MEASURED, 5.0, "new, not needed"),
    )
    for here, marker, face, edge, size, label in kinds:
        if here.any():
            axes.plot(
                omega[here], count[here], ls="none", marker=marker, ms=size, mfc=face, mec=edge, label=label
            )
    axes.axhline(plot.chosen, color=style.HIGHLIGHT, lw=5, alpha=0.35, label="number of pairs in the model")
    axes.set_ylim(-0.4, max(plot.rss.size - 1, 1) + 0.6)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    if response is None and omega.size:
        axes.set_xlim(omega.min() / 1.5, omega.max() * 1.5)
    axes.set_title("Stabilisation: which modes stay")
    axes.set(xlabel="frequency of the pair [rad/s]", ylabel="pole pairs in the fit [1]")


def _faint(axes: Axes, response: FrequencyUncertainty) -> None:
    """The gain behind the marks, on a log scale of its own that nobody has to read."""
    gain = np.abs(response.centre)
    omega, log = response.omega_rad_s[gain > 0], np.log(gain[gain > 0])
    low, high = np.percentile(log, 1), log.max()
    height = np.clip((log - low) / max(high - low, 1e-12), 0.0, 1.0)
    axes.plot(
        omega,
        0.03 + 0.94 * height,
        transform=axes.get_xaxis_transform(),
        color=style.MEASURED,
        lw=0.8,
        alpha=0.4,
        label="gain straight from the records (own log scale)",
    )
    axes.set_xlim(omega[0], omega[-1])
