"""The answer in two pictures: how probable each cause is, and how far the gap shrinks with it."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from diagnosis.diagnosis import Diagnosis
from plant.effects import in_words
from workflow.figures import gap_style, style
from workflow.figures.registry import drawing

_MOST_BARS = 8
_LOOKS = {"stated": ("s", -0.22), "refit": ("D", 0.0), "repaired": ("o", 0.22)}


@drawing("gap_probabilities")
def draw_probabilities(found: Diagnosis) -> Figure:
    """Bars of the likeliest causes, the accepted ones in colour; all others are added up in a last bar."""
    ranked = sorted(found.probabilities.items(), key=lambda item: -item[1])
    accepted = set(found.combination) or {"none" if found.verdict == "none" else "unknown"}
    bars = [
        (
            style.plain(in_words(name), 52),
            p,
            gap_style.MODELS["repaired"]["color"] if name in accepted else gap_style.PALE,
        )
        for name, p in ranked[: min(_MOST_BARS, sum(p >= 0.005 for _, p in ranked) or 1)]
    ]
    others = len(ranked) - len(bars)
    if others:
        rest = max(0.0, 1.0 - sum(p for _, p, _ in bars))
        bars.append((f"all {others} others together", rest, gap_style.PALE))
    with style.house_style():
        figure = style.new_figure(1.0 + 0.34 * len(bars))
        axes = figure.subplots()
        at = np.arange(len(bars))
        axes.barh(at, [100 * p for _, p, _ in bars], color=[colour for _, _, colour in bars], height=0.62)
        for y, (_, p, _) in zip(at, bars, strict=True):
            text = "under 0.1 %" if p < 1e-3 else f"{100 * p:.3g} %"
            axes.annotate(
                text, (100 * p, y), xytext=(4, 0), textcoords="offset points", va="center", fontsize=9
            )
        axes.set_yticks(at, [name for name, _, _ in bars])
        axes.invert_yaxis()
        axes.set_xlim(0, 112)
        axes.set_xticks([0, 20, 40, 60, 80, 100])
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("probability [%]")
        axes.set_title("Which cause, given the records")
    return figure


@drawing("gap_waterfall")
def draw_waterfall(found: Diagnosis) -> Figure:
    """Pooled root mean square of (measured - model)/noise: held-out records together, every record alone."""
    gaps, rows, floor = found.gaps, found.gap_by_experiment, found.noise_floor
    with style.house_style():
        figure = style.new_figure(max(3.4, 1.8 + 0.3 * len(rows)))
        left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.15])
        at = np.arange(len(gaps))
        left.bar(at, list(gaps.values()), color=[gap_style.MODELS[name]["color"] for name in gaps], width=0.6)
        for x, value in zip(at, gaps.values(), strict=True):
            left.annotate(
                f"{value:.3f}" if value < 10 else f"{value:.1f}",
                (x, value),
                xytext=(0, 3),
                textcoords="offset points",
                ha="center",
                fontsize=10,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6},
            )
        left.axhline(floor, **gap_style.FLOOR, zorder=1)
        left.set_xticks(
            at, [gap_style.WORDS[name].replace(", ", ",\n").replace(" ", "\n", 1) for name in gaps]
        )
        left.set_xlim(-0.6, max(len(gaps), 3) - 0.4)
        left.set_ylim(0, 1.15 * max(*gaps.values(), floor))
        left.grid(visible=False, axis="x")
        left.set_ylabel("residual over noise, RMS [1]")
        left.set_title("Held-out experiments together")
        for name in gaps:
            marker, offset = _LOOKS[name]
            right.plot(
                [entry[name] for entry in rows.values()],
                np.arange(len(rows)) + offset,
                marker,
                ms=6,
                color=gap_style.MODELS[name]["color"],
                label=gap_style.WORDS[name],
            )
        right.axvline(floor, **gap_style.FLOOR)
        right.set_xscale("log")
        largest = max(max(entry.values()) for entry in rows.values())
        right.set_xlim(0.8 * floor, 1.3 * max(largest, 2 * floor))
        right.set_yticks(range(len(rows)), [style.plain(name, 34) for name in rows])
        right.set_ylim(len(rows) - 0.5, -0.5)
        right.set_xlabel("residual over noise, RMS [1]")
        right.set_title("Every experiment alone")
        style.finish(figure, (right, left))
    return figure
