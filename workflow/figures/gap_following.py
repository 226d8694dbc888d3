"""What to do with the answer: the proposed experiment, and what the gap means for a loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from diagnosis.next_experiment.next_experiment import NextExperiment
from workflow.figures import gap_style, style
from workflow.figures.bands import Real, outline
from workflow.figures.registry import drawing


@drawing("gap_next")
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


@drawing("gap_controller")
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
        above.plot(time_s, 1e3 * reference_m, **style.REFERENCE_LINE, label="asked for")
        for run, (look, label) in enumerate(looks, 2 * column):
            above.plot(time_s, 1e3 * tips_m[run], **look, label=label)
            below.step(time_s, commands_V[run], where="post", **look)
        above.set_title(f"Design with the {design}")
        below.set_xlabel("time [s]")
        above.margins(x=0.01)
    grid[0, 0].set_ylabel("tip position [mm]")
    grid[1, 0].set_ylabel("voltage [V]")
    return figure
