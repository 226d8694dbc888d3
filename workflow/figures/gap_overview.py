"""Several cases at a glance: the gap before and after, on the held-out experiments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from workflow.figures import gap_style, style


@dataclass(frozen=True)
class CaseGap:
    """One case: pooled RMS over noise with the rig as stated and with the effects added, and what it is."""

    name: str
    answer: str
    stated: float
    repaired: float
    floor: float


def draw_case_gaps(cases: Sequence[CaseGap]) -> Figure:
    """One line per case, from the gap with the rig as stated to the gap with the effects added."""
    with style.house_style():
        figure = style.new_figure(1.5 + 0.32 * len(cases))
        axes = figure.subplots()
        at = np.arange(len(cases))
        for y, case in zip(at, cases, strict=True):
            axes.plot([case.stated, case.repaired], [y, y], color="#999999", lw=1.0, zorder=1)
        for name, marker in (("stated", "s"), ("repaired", "o")):
            axes.plot(
                [getattr(case, name) for case in cases],
                at,
                ls="none",
                marker=marker,
                ms=7,
                color=gap_style.MODELS[name]["color"],
                label=gap_style.WORDS[name],
            )
        floor = float(np.median([case.floor for case in cases]))
        axes.axvline(floor, **gap_style.FLOOR, label=gap_style.WORDS["floor"], zorder=0)
        axes.set_xscale("log")
        axes.set_xlim(0.8 * floor, 1.3 * max(2 * floor, *(case.stated for case in cases)))
        labels = [f"{style.plain(case.name, 34)}: {style.plain(case.answer, 44)}" for case in cases]
        axes.set_yticks(at, labels)
        axes.set_ylim(len(cases) - 0.5, -0.5)
        axes.set_xlabel("held-out residual over noise, RMS [1]")
        axes.set_title("How far each gap shrinks")
        style.finish(figure, axes)
    return figure
