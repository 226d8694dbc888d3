"""The answer in pictures: how probable each cause is, how far the gap shrinks, several cases at once; and
what to do with it: the proposed experiment, what the gap means for a loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from diagnosis.answer import Diagnosis
from diagnosis.next_experiment.next_experiment import NextExperiment
from plant.effects import in_words
from workflow.figures import gap_style, style
from workflow.figures.bands import Real, outline
from workflow.figures.description import Picture, new_picture
from workflow.text.formats import listing

# Bars at most: more names are too small to read at the width of a page.
_MOST_BARS = 8
# Marker of a model, and how far it stands from the middle of its row.
_LOOKS = {"stated": ("s", -0.22), "refit": ("D", 0.0), "repaired": ("o", 0.22)}


@style.drawing("gap_probabilities")
def draw_probabilities(found: Diagnosis) -> Picture:
    """Bars: presence of the likeliest effects, those of the answer in colour; whether more is missing."""
    ranked = sorted(found.effects, key=lambda effect: -effect.presence)
    effects = [effect for effect in ranked if effect.name not in ("none", "unknown")]
    # Half a percent: below it a bar cannot be seen.
    shown = [effect for effect in effects if effect.presence >= 0.005][:_MOST_BARS]
    names = [style.plain(in_words(effect.name), 52) for effect in shown]
    names.append("something else is missing")
    probabilities = [effect.presence for effect in shown]
    probabilities.append(1 - found.completeness.probability)
    percent = [100 * probability for probability in probabilities]
    present_colour = gap_style.MODELS["repaired"]["color"]
    colours = [present_colour if effect in found.present else gap_style.PALE for effect in shown]
    colours.append(gap_style.PALE)
    labels = ["under 0.1 %" if p < 0.1 else f"{p:.3g} %" for p in percent]
    return _bars(names, percent, labels, colours, "Is it present, given the records", "probability [%]")


@style.drawing("gap_waterfall")
def draw_waterfall(found: Diagnosis) -> Picture:
    """Pooled root mean square of (measured - model)/noise: held-out records together, every record alone.

    Beside a model error: in per cent of the motion.
    """
    gaps = found.gaps
    floor = found.noise_floor
    # Nothing beyond noise has no place on a logarithmic axis.
    least = gap_style.LEAST * floor
    rows = {}
    for name, entry in found.gap_by_experiment.items():
        rows[name] = {model: max(value, least) for model, value in entry.items()}
    rough = found.case.model_error
    words = gap_style.SHARE_AXIS if rough > 0 else gap_style.RESIDUAL_AXIS
    line = gap_style.floor_of(rough)
    # A row of every experiment needs its room.
    height_in = max(3.4, 1.8 + 0.3 * len(rows))
    picture, (left, right) = new_picture(height_in, 1, 2, width_ratios=[1.0, 1.15])
    for place, (model, value) in enumerate(gaps.items()):
        left.bars(place, value, 0.6, color=gap_style.MODELS[model]["color"])
        if rough > 0:
            digits = ".3g"
        elif value < 10:
            digits = ".3f"
        else:
            digits = ".1f"
        words_at = {"offset": (0.0, 3.0), "size": 9.5, "color": "#000", "horizontal": "center"}
        left.words(format(value, digits), place, value, **words_at)
    left.x.named = [(k, gap_style.WORDS[model].replace(" ", "\n")) for k, model in enumerate(gaps)]
    left.axhline(floor, **line, zorder=1)
    highest = max(*gaps.values(), floor)
    # Room for three bars at least: two alone would fill the panel.
    n_places = max(len(gaps), 3)
    left.set(xlim=(-0.6, n_places - 0.4), ylim=(0, 1.15 * highest))
    left.set(ylabel=words, title="Validation records together")
    left.grid_lines[0] = False
    for model in gaps:
        marker, offset = _LOOKS[model]
        at = np.arange(len(rows)) + offset
        values = [entry[model] for entry in rows.values()]
        right.plot(values, at, marker=marker, ls="none", ms=6, **_label(model))
    right.axvline(floor, **line)
    every = [value for entry in rows.values() for value in entry.values()]
    # Beside a model error the repaired model may lie far below the threshold.
    smallest = min(*every, floor)
    largest = max(*every, 2 * floor)
    right.set(xscale="log", xlim=(0.8 * smallest, 1.3 * largest))
    right.y.named = [(k, style.plain(name, 34)) for k, name in enumerate(rows)]
    right.set(ylim=(len(rows) - 0.5, -0.5), xlabel=words, title="Every experiment alone")
    return picture


@style.drawing("gap_partial")
def draw_partial_answers(partial: Sequence[tuple[Sequence[str], float]]) -> Picture:
    """Bars: share of the held-out gap that effects close by themselves."""
    names = []
    for effects, _ in partial:
        together = listing([in_words(name) for name in effects])
        names.append(style.plain(together, 60))
    percent = [100 * share for _, share in partial]
    labels = [f"{p:.3g} %" for p in percent]
    colours = [gap_style.PALE] * len(names)
    what = "What effects close by themselves", "of the held-out gap closed [%]"
    return _bars(names, percent, labels, colours, *what)


def _bars(
    names: Sequence[str],
    percent: Sequence[float],
    labels: Sequence[str],
    colours: Sequence[str],
    title: str,
    axis: str,
) -> Picture:
    """Lying bars in percent with a name before and a label behind each, the first on top."""
    picture, panel = new_picture(1.0 + 0.34 * len(names))
    for at, (value, label, colour) in enumerate(zip(percent, labels, colours, strict=True)):
        panel.bars(at, value, 0.62, lying=True, color=colour)
        panel.words(label, value, at, offset=(4.0, 0.0), size=9.0, color="#000", vertical="center")
    panel.y.named = list(enumerate(names))
    panel.x.every = 20.0
    # The first bar on top; room for the words of a bar that is 100 % long.
    panel.set(xlim=(0, 112), ylim=(len(names) - 0.5, -0.5), xlabel=axis, title=title)
    panel.grid_lines[1] = False
    return picture


@style.drawing("gap_overview")
def draw_case_gaps(cases: Sequence[Any]) -> Picture:
    """One line per case (`fleet.Machine`): RMS over noise with the nominal parameters, and with the effects
    added."""
    before, after = ([case.numbers[key] for case in cases] for key in ("gap_before", "gap_after"))
    at = np.arange(len(cases))
    floor = float(np.median([case.numbers["noise_floor"] for case in cases]))
    picture, panel = new_picture(1.5 + 0.32 * len(cases))
    for place, ends in enumerate(zip(before, after, strict=True)):
        panel.plot(ends, [place, place], color="#999999", lw=1.0, zorder=1)
    for model, values in (("stated", before), ("repaired", after)):
        panel.plot(values, at, marker=_LOOKS[model][0], ls="none", ms=7, **_label(model))
    panel.axvline(floor, **gap_style.FLOOR, zorder=0)
    # The line of the floor stays inside, also where no case has a model error.
    largest = max(2 * floor, *before)
    panel.set(xscale="log", xlim=(0.8 * floor, 1.3 * largest))
    panel.y.named = []
    for k, case in enumerate(cases):
        words = f"{style.plain(case.name, 34)}: {style.plain(case.answer, 44)}"
        panel.y.named.append((k, words))
    panel.set(ylim=(len(cases) - 0.5, -0.5), xlabel=f"validation {gap_style.RESIDUAL_AXIS}")
    panel.set_title("Model error, nominal and with effects")
    return picture


def _label(model: str) -> dict[str, Any]:
    return {"color": gap_style.MODELS[model]["color"], "label": gap_style.WORDS[model]}


@style.drawing("gap_next")
def draw_next_experiment(proposal: NextExperiment, difference: Real, names: Sequence[str]) -> Picture:
    """Voltage, and difference (T, Y) of the two likeliest answers in standard deviations, hub before tip."""
    time_s = np.arange(proposal.voltage_V.size, dtype=np.float64) * proposal.dt_s
    picture, (above, below) = new_picture(4.2, 2, 1, sharex=True, height_ratios=[1.0, 1.3])
    above.plot(time_s, proposal.voltage_V, drawstyle="steps-post", color=style.REFERENCE, lw=0.8)
    above.set(ylabel="voltage [V]", title="Proposed experiment")
    below.axhspan(-2, 2, **{**gap_style.NOISE_BAND, "label": "2 standard deviations"})
    for signal, (words, _, colour) in zip(difference.T, gap_style.OUTPUTS.values(), strict=False):
        below.plot(*outline(time_s, signal), color=colour, lw=1.0, label=words)
    title = f"{style.plain(names[0], 48)} minus {style.plain(names[1], 48)}"
    below.set_title(title, size=9.5, bold=False)
    below.set(xlabel="time [s]", ylabel="difference over\nstandard deviation [1]")
    below.x.margin = 0.01
    return picture


@style.drawing("gap_controller")
def draw_controller_check(
    time_s: Real, reference_m: Real, tips_m: Sequence[Real], commands_V: Sequence[Real]
) -> Picture:
    """A reference step with the design on the nominal rig and on the repaired one, a column each.

    Runs in the order nominal predicted by its own model (dashed), nominal achieved on the repaired machine,
    repaired predicted, repaired achieved.
    """
    looks = (
        ({**style.PREDICTED_LINE, "ls": (0, (4, 1.5))}, "predicted by its own model"),
        (style.ACHIEVED_LINE, "achieved on the repaired machine"),
    )
    picture, grid = new_picture(4.6, 2, 2, sharex=True, sharey="row", height_ratios=[1.6, 1.0])
    for column, design in enumerate(("nominal parameters", "repaired rig")):
        above, below = grid[:, column]
        above.plot(time_s, 1e3 * reference_m, **style.REFERENCE_LINE, label="reference")
        for run, (look, label) in enumerate(looks, 2 * column):
            above.plot(time_s, 1e3 * tips_m[run], **look, label=label)
            below.plot(time_s, commands_V[run], drawstyle="steps-post", **look)
        above.set_title(f"Design with the {design}")
        below.set(xlabel="time [s]")
        above.x.margin = 0.01
    grid[0, 0].set(ylabel="tip position [mm]")
    grid[1, 0].set(ylabel="voltage [V]")
    return picture
