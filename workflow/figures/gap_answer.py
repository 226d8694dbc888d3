"""The answer in two pictures: how probable each cause is, and how far the gap shrinks with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from workflow.figures import gap_style, style

Real = npt.NDArray[np.float64]

_MOST_BARS = 8
_TICKS = {
    "stated": "rig as\nstated",
    "refit": "values moved\nwithin tolerances",
    "repaired": "effects\nadded",
}


def draw_probabilities(
    words: Sequence[str], probabilities: Sequence[float], accepted: Sequence[bool]
) -> Figure:
    """Bars of the likeliest causes, the accepted ones in colour; the rest is added up in a last bar.

    words, probabilities, accepted: (C,), most probable first.
    """
    shown = min(_MOST_BARS, sum(p >= 0.005 for p in probabilities) or 1)
    names = [style.plain(word, 52) for word in words[:shown]]
    values = [float(p) for p in probabilities[:shown]]
    colours = [gap_style.REPAIRED["color"] if a else gap_style.PALE for a in accepted[:shown]]
    rest = max(0.0, 1.0 - sum(values))
    if len(words) > shown:
        names.append(f"all {len(words) - shown} others together")
        values.append(rest)
        colours.append(gap_style.PALE)
    with style.house_style():
        figure = style.new_figure(1.0 + 0.34 * len(names))
        axes = figure.subplots()
        at = np.arange(len(names))
        axes.barh(at, [100 * v for v in values], color=colours, height=0.62)
        for y, value in zip(at, values, strict=True):
            text = "under 0.1 %" if value < 1e-3 else f"{100 * value:.3g} %"
            axes.annotate(
                text, (100 * value, y), xytext=(4, 0), textcoords="offset points", va="center", fontsize=9
            )
        axes.set_yticks(at, names)
        axes.invert_yaxis()
        axes.set_xlim(0, 112)
        axes.set_xticks([0, 20, 40, 60, 80, 100])
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("probability [%]")
        axes.set_title("Which cause, given the records")
    return figure


def draw_waterfall(
    held_out: Mapping[str, float], by_experiment: Mapping[str, Mapping[str, float]], floor: float
) -> Figure:
    """Pooled root mean square of (measured - model)/noise for the three models.

    held_out: "stated", "refit" and, if effects were added, "repaired" -> value over the held-out experiments.
    by_experiment: experiment
    -> the same for it alone.
    """
    with style.house_style():
        figure = style.new_figure(max(3.4, 1.8 + 0.3 * len(by_experiment)))
        left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.15])
        names = list(held_out)
        at = np.arange(len(names))
        values = [held_out[name] for name in names]
        left.bar(at, values, color=[gap_style.MODELS[name]["color"] for name in names], width=0.6)
        for x, value in zip(at, values, strict=True):
            left.annotate(
                f"{value:.3f}" if value < 10 else f"{value:.1f}",
                (x, value),
                xytext=(0, 3),
                textcoords="offset points",
                ha="center",
                fontsize=10,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6},
            )
        left.axhline(floor, **gap_style.FLOOR, label=gap_style.WORDS["floor"], zorder=1)
        left.set_xticks(at, [_TICKS[name] for name in names])
        left.set_xlim(-0.6, max(len(names), 3) - 0.4)
        left.set_ylim(0, 1.15 * max(*values, floor))
        left.grid(visible=False, axis="x")
        left.set_ylabel("residual over noise, RMS [1]")
        left.set_title("Held-out experiments together")
        rows = list(by_experiment)
        for row, experiment in enumerate(rows):
            for name, offset in zip(names, (-0.22, 0.0, 0.22), strict=False):
                right.plot(
                    by_experiment[experiment][name],
                    row + offset,
                    "o" if name == "repaired" else ("D" if name == "refit" else "s"),
                    ms=6,
                    color=gap_style.MODELS[name]["color"],
                    label=gap_style.WORDS[name],
                )
        right.axvline(floor, **gap_style.FLOOR, label=gap_style.WORDS["floor"])
        right.set_xscale("log")
        largest = max(max(entry.values()) for entry in by_experiment.values())
        right.set_xlim(0.8 * floor, 1.3 * max(largest, 2 * floor))
        right.set_yticks(range(len(rows)), [style.plain(name, 34) for name in rows])
        right.set_ylim(len(rows) - 0.5, -0.5)
        right.set_xlabel("residual over noise, RMS [1]")
        right.set_title("Every experiment alone")
        style.finish(figure, (right, left))
    return figure
