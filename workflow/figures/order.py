"""How many poles: the criterion over the order, beside the modes that stay when more poles are allowed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from ident.search.order_selection import OrderStep
from ident.stabilisation import Stabilisation
from workflow.figures import style
from workflow.figures.bands import EmpiricalResponse
from workflow.figures.registry import drawing
from workflow.figures.subjects import ChannelView

# Below this a difference of the criterion is drawn linearly, above logarithmically: a factor exp(5) = 150 in
# posterior odds is where "better" begins to mean something.
_LINEAR = 10.0


@drawing("order")
def draw_channel(channel: ChannelView) -> Figure | None:
    """Of a channel; nothing where no other structure was tried."""
    plot, steps = channel.found.stabilisation, channel.found.order_table
    if plot is None or not steps:
        return None
    chosen = plot.n_real, plot.chosen
    return draw_order(steps, chosen, plot, name=channel.name, response=channel.empirical)


def draw_order(
    steps: Sequence[OrderStep],
    chosen: tuple[int, int],
    plot: Stabilisation,
    *,
    name: str,
    response: EmpiricalResponse | None = None,
) -> Figure:
    """Left: criterion of every structure tried, above the best. Right: pole pairs of fits with 0, 1, 2 ...

    chosen = (real poles, pole pairs) of the model. `response` is drawn faintly behind the right panel: modes
    belong on its peaks. Raises ValueError without a structure.
    """
    if not steps:
        raise ValueError("there is no structure to draw")
    with style.house_style():
        figure = style.new_figure(4.6)
        left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.7])
        _criterion(left, steps, chosen)
        left.set_title(f"Criterion: {style.plain(name, 16)}")
        _stabilisation(right, plot, response)
        style.finish(figure, (left, right), columns=4)
    return figure


def _criterion(axes: Axes, steps: Sequence[OrderStep], chosen: tuple[int, int]) -> None:
    best = min(step.criterion for step in steps)
    order = np.array([step.order for step in steps])
    above = np.array([step.criterion - best for step in steps])
    axes.plot(
        order, above, ls="none", marker="o", ms=5, mfc="white", mec=style.MODEL, label="structure tried"
    )
    lowest = np.unique(order)
    envelope = [above[order == n].min() for n in lowest]
    axes.plot(lowest, envelope, color=style.MODEL, lw=1.0)
    mine = [k for k, step in enumerate(steps) if (step.n_real, step.n_pairs) == chosen]
    if mine:
        axes.plot(
            order[mine],
            above[mine],
            ls="none",
            marker="*",
            ms=14,
            mfc=style.HIGHLIGHT,
            mec="black",
            mew=0.7,
            label=f"the model: {chosen[0]} real, {chosen[1]} pairs",
        )
    axes.set_yscale("symlog", linthresh=_LINEAR)
    axes.set_ylim(-0.15 * _LINEAR, max(2.5 * above.max(), 1.5 * _LINEAR))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlim(order.min() - 0.6, order.max() + 0.6)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("searched poles [1]")
    axes.set_ylabel("criterion above the best [1]")


def _stabilisation(axes: Axes, plot: Stabilisation, response: EmpiricalResponse | None) -> None:
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
    axes.set_xlabel("frequency of the pair [rad/s]")
    axes.set_ylabel("pole pairs in the fit [1]")


def _faint(axes: Axes, response: EmpiricalResponse) -> None:
    """The gain behind the marks, on a log scale of its own that nobody has to read."""
    gain = np.abs(response.response)
    seen = gain > 0
    log = np.log(gain[seen])
    low, high = np.percentile(log, 1), log.max()
    share = np.clip((log - low) / max(high - low, 1e-12), 0.0, 1.0)
    axes.plot(
        response.omega_rad_s[seen],
        0.03 + 0.94 * share,
        transform=axes.get_xaxis_transform(),
        color=style.MEASURED,
        lw=0.8,
        alpha=0.4,
        label="gain straight from the records (own log scale)",
    )
    axes.set_xlim(response.omega_rad_s[seen][0], response.omega_rad_s[seen][-1])
