"""The answer in pictures: how probable each cause is, how far the gap shrinks, several cases at once; and
what to do with it: the proposed experiment, what the gap means for a loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from diagnosis.answer import Diagnosis
from diagnosis.next_experiment.next_experiment import NextExperiment
from plant.effects import in_words
from workflow.figures import gap_style, style
from workflow.figures.bands import Real, outline
from workflow.text.formats import listing

_MOST_BARS = 8  # more names are too small to read at the width of a page
_LOOKS = {"stated": ("s", -0.22), "refit": ("D", 0.0), "repaired": ("o", 0.22)}


@style.drawing("gap_probabilities")
def draw_probabilities(found: Diagnosis) -> Figure:
    """Bars: presence of the likeliest effects, those of the answer in colour; whether more is missing."""
    ranked = sorted(found.effects, key=lambda effect: -effect.presence)
    shown = [e for e in ranked if e.presence >= 0.005 and e.name not in ("none", "unknown")][:_MOST_BARS]
    names = [*(style.plain(in_words(e.name), 52) for e in shown), "something else is missing"]
    percent = [100 * p for p in (*(e.presence for e in shown), 1 - found.completeness.probability)]
    own = gap_style.MODELS["repaired"]["color"]
    colours = [own if e in found.present else gap_style.PALE for e in shown] + [gap_style.PALE]
    labels = ["under 0.1 %" if p < 0.1 else f"{p:.3g} %" for p in percent]
    return _bars(names, percent, labels, colours, "Is it present, given the records", "probability [%]")


@style.drawing("gap_waterfall")
def draw_waterfall(found: Diagnosis) -> Figure:
    """Pooled root mean square of (measured - model)/noise: held-out records together, every record alone.

    Beside a model error: in per cent of the motion.
    """
    gaps, floor = found.gaps, found.noise_floor
    # Nothing beyond noise has no place on a logarithmic axis.
    rows = {
        name: {model: max(value, gap_style.LEAST * floor) for model, value in entry.items()}
        for name, entry in found.gap_by_experiment.items()
    }
    rough = found.case.model_error
    words, line = gap_style.SHARE_AXIS if rough > 0 else gap_style.RESIDUAL_AXIS, gap_style.floor_of(rough)
    figure, (left, right) = style.panels(max(3.4, 1.8 + 0.3 * len(rows)), 1, 2, width_ratios=[1.0, 1.15])
    bars = left.bar(
        np.arange(len(gaps)),
        list(gaps.values()),
        color=[gap_style.MODELS[model]["color"] for model in gaps],
        width=0.6,
        tick_label=[gap_style.WORDS[model].replace(" ", "\n") for model in gaps],
    )
    digits = [".3g" if rough > 0 else ".3f" if v < 10 else ".1f" for v in gaps.values()]
    left.bar_label(bars, [format(v, d) for v, d in zip(gaps.values(), digits, strict=True)], padding=3)
    left.axhline(floor, **line, zorder=1)
    left.set(xlim=(-0.6, max(len(gaps), 3) - 0.4), ylim=(0, 1.15 * max(*gaps.values(), floor)))
    left.set(ylabel=words, title="Validation records together")
    left.grid(visible=False, axis="x")
    for model in gaps:
        marker, offset = _LOOKS[model]
        at = np.arange(len(rows)) + offset
        right.plot([entry[model] for entry in rows.values()], at, marker, ms=6, **_label(model))
    right.axvline(floor, **line)
    every = [value for entry in rows.values() for value in entry.values()]
    # Beside a model error the repaired model may lie far below the threshold.
    right.set(xscale="log", xlim=(0.8 * min(*every, floor), 1.3 * max(*every, 2 * floor)))
    right.set_yticks(range(len(rows)), [style.plain(name, 34) for name in rows])
    right.set(ylim=(len(rows) - 0.5, -0.5), xlabel=words, title="Every experiment alone")
    return figure


@style.drawing("gap_partial")
def draw_partial_answers(partial: Sequence[tuple[Sequence[str], float]]) -> Figure:
    """Bars: share of the held-out gap that effects close by themselves."""
    names = [style.plain(listing([in_words(name) for name in effects]), 60) for effects, _ in partial]
    percent = [100 * share for _, share in partial]
    labels, colours = [f"{p:.3g} %" for p in percent], [gap_style.PALE] * len(names)
    what = "What effects close by themselves", "of the held-out gap closed [%]"
    return _bars(names, percent, labels, colours, *what)


def _bars(
    names: Sequence[str],
    percent: Sequence[float],
    labels: Sequence[str],
    colours: Sequence[str],
    title: str,
    axis: str,
) -> Figure:
    figure, axes = style.panels(1.0 + 0.34 * len(names))
    bars = axes.barh(np.arange(len(names)), percent, color=colours, height=0.62, tick_label=names)
    axes.bar_label(bars, labels, padding=4, fontsize=9)
    axes.invert_yaxis()
    axes.set(xlim=(0, 112), xticks=[0, 20, 40, 60, 80, 100], xlabel=axis, title=title)
    axes.grid(visible=False, axis="y")
    return figure


@style.drawing("gap_overview")
def draw_case_gaps(cases: Sequence[Any]) -> Figure:
    """One line per case (`fleet.Machine`): RMS over noise with the nominal parameters, and with the effects
    added."""
    before, after = ([case.numbers[key] for case in cases] for key in ("gap_before", "gap_after"))
    at, floor = np.arange(len(cases)), float(np.median([case.numbers["noise_floor"] for case in cases]))
    figure, axes = style.panels(1.5 + 0.32 * len(cases))
    axes.plot([before, after], [at, at], color="#999999", lw=1.0, zorder=1)
    for model, values in (("stated", before), ("repaired", after)):
        axes.plot(values, at, _LOOKS[model][0], ms=7, **_label(model))
    axes.axvline(floor, **gap_style.FLOOR, zorder=0)
    axes.set(xscale="log", xlim=(0.8 * floor, 1.3 * max(2 * floor, *before)))
    axes.set_yticks(at, [f"{style.plain(c.name, 34)}: {style.plain(c.answer, 44)}" for c in cases])
    axes.set(ylim=(len(cases) - 0.5, -0.5), xlabel=f"validation {gap_style.RESIDUAL_AXIS}")
    axes.set_title("Model error, nominal and with effects")
    return figure


def _label(model: str) -> dict[str, Any]:
    return {"color": gap_style.MODELS[model]["color"], "label": gap_style.WORDS[model]}


@style.drawing("gap_next")
def draw_next_experiment(proposal: NextExperiment, difference: Real, names: Sequence[str]) -> Figure:
    """Voltage, and difference (T, Y) of the two likeliest answers in standard deviations, hub before tip."""
    time_s = np.arange(proposal.voltage_V.size, dtype=np.float64) * proposal.dt_s
    figure, (above, below) = style.panels(4.2, 2, 1, sharex=True, height_ratios=[1.0, 1.3])
    above.step(time_s, proposal.voltage_V, where="post", color=style.REFERENCE, lw=0.8)
    above.set(ylabel="voltage [V]", title="Proposed experiment")
    below.axhspan(-2, 2, **{**gap_style.NOISE_BAND, "label": "2 standard deviations"})
    for signal, (words, _, colour) in zip(difference.T, gap_style.OUTPUTS.values(), strict=False):
        below.plot(*outline(time_s, signal), color=colour, lw=1.0, label=words)
    title = f"{style.plain(names[0], 48)} minus {style.plain(names[1], 48)}"
    below.set_title(title, fontweight="normal", fontsize=9.5)
    below.set(xlabel="time [s]", ylabel="difference over\nstandard deviation [1]")
    below.margins(x=0.01)
    return figure


@style.drawing("gap_controller")
def draw_controller_check(
    time_s: Real, reference_m: Real, tips_m: Sequence[Real], commands_V: Sequence[Real]
) -> Figure:
    """The same step with the design on the nominal rig and on the repaired one, a column each.

    Runs in the order nominal predicted by its own model (dashed), nominal achieved on the repaired machine,
    repaired predicted, repaired achieved.
    """
    looks = (
        ({**style.PREDICTED_LINE, "ls": (0, (4, 1.5))}, "predicted by its own model"),
        (style.ACHIEVED_LINE, "achieved on the repaired machine"),
    )
    figure, grid = style.panels(4.6, 2, 2, sharex=True, sharey="row", height_ratios=[1.6, 1.0])
    for column, design in enumerate(("nominal parameters", "repaired rig")):
        above, below = grid[:, column]
        above.plot(time_s, 1e3 * reference_m, **style.REFERENCE_LINE, label="reference")
        for run, (look, label) in enumerate(looks, 2 * column):
            above.plot(time_s, 1e3 * tips_m[run], **look, label=label)
            below.step(time_s, commands_V[run], where="post", **look)
        above.set_title(f"Design with the {design}")
        below.set_xlabel("time [s]")
        above.margins(x=0.01)
    grid[0, 0].set_ylabel("tip position [mm]")
    grid[1, 0].set_ylabel("voltage [V]")
    return figure
