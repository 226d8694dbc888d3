"""Several cases at a glance: the gap before and after, on the held-out experiments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure

from workflow.figures import gap_style, style
from workflow.figures.registry import drawing


class CaseGap(Protocol):
    """A case: RMS over noise with the nominal parameters and with the effects added, and its answer."""

    @property
    def name(self) -> str: ...

    @property
    def answer(self) -> str: ...

    @property
    def gap_before(self) -> float: ...

    @property
    def gap_after(self) -> float: ...

    @property
    def noise_floor(self) -> float: ...


@drawing("gap_overview")
def draw_case_gaps(cases: Sequence[CaseGap]) -> Figure:
    """One line per case, from the gap with the nominal parameters to the gap with the effects added."""
    at = np.arange(len(cases))
    ends = {"stated": [c.gap_before for c in cases], "repaired": [c.gap_after for c in cases]}
    with style.house_style():
        figure = style.new_figure(1.5 + 0.32 * len(cases))
        axes = figure.subplots()
        axes.plot(list(ends.values()), [at, at], color="#999999", lw=1.0, zorder=1)
        for (name, values), marker in zip(ends.items(), "so", strict=True):
            colour, label = gap_style.MODELS[name]["color"], gap_style.WORDS[name]
            axes.plot(values, at, ls="none", marker=marker, ms=7, color=colour, label=label)
        floor = float(np.median([c.noise_floor for c in cases]))
        axes.axvline(floor, **gap_style.FLOOR, zorder=0)
        axes.set_xscale("log")
        axes.set_xlim(0.8 * floor, 1.3 * max(2 * floor, *ends["stated"]))
        labels = [f"{style.plain(c.name, 34)}: {style.plain(c.answer, 44)}" for c in cases]
        axes.set_yticks(at, labels)
        axes.set_ylim(len(cases) - 0.5, -0.5)
        axes.set_xlabel("held-out residual over noise, RMS [1]")
        axes.set_title("How far each gap shrinks")
        style.finish(figure, axes)
    return figure
