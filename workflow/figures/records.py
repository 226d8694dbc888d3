"""The records as measured: input and outputs over time, shaded by what each record is used for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ident.data.record import Record
from workflow.figures import style
from workflow.figures.bands import Real, liveliest, outline
from workflow.figures.registry import drawing
from workflow.tasks.results import RunRecord

_ZOOM_SAMPLES = 400
_WORDS = {
    "estimation": "used to estimate",
    "validation": "kept for validation",
    "repeat": "repeat, not fitted",
}


@drawing("records")
def draw_records(shown: Sequence[RunRecord], inputs: Sequence[str], outputs: Sequence[str]) -> Figure:
    """Rows: the named inputs and outputs. Left: all records one after another. Right: the liveliest part of
    the first.

    Raises ValueError when there is no record or a name is not in one of them.
    """
    if not shown:
        raise ValueError("there is no record to draw")
    rows = [("input", name) for name in inputs] + [("output", name) for name in outputs]
    figure, grid = style.panels(
        1.55 * len(rows) + 1.0, len(rows), 2, squeeze=False, sharex="col", width_ratios=[2.1, 1.0]
    )
    starts = np.concatenate([[0.0], np.cumsum([item.duration_s * 1.02 for item in shown])])
    first = shown[0].record
    lively, _ = _signal(first, *rows[len(inputs) if outputs else 0])
    zoom = liveliest(lively, min(_ZOOM_SAMPLES, first.n_samples))
    for (kind, name), (left, right) in zip(rows, grid, strict=True):
        for item, start in zip(shown, starts, strict=False):
            shade = {"color": style.SHADE[item.role], "label": _WORDS[item.role], "alpha": 0.15, "lw": 0}
            left.axvspan(start, start + item.duration_s, **shade)
            signal, _ = _signal(item.record, kind, name)
            left.plot(
                *outline(item.record.time_s + start, signal, 1000 // len(shown)),
                **style.MEASURED_LINE | {"lw": 0.6},
            )
        signal, unit = _signal(first, kind, name)
        steps = {"drawstyle": "steps-post"} if kind == "input" else {}
        right.plot(first.time_s[zoom], signal[zoom], **style.MEASURED_LINE, **steps)
        right.margins(x=0)
        left.set_ylabel(style.two_lines(name, unit))
        left.set_xlim(0, starts[-1])
    _name_records(grid[0, 0], shown, starts)
    grid[0, 0].set_title("Records, one after another", pad=16)
    grid[0, 1].set_title("Close-up of record 1", pad=16)
    grid[-1, 0].set_xlabel("time, all records [s]")
    grid[-1, 1].set_xlabel("time in this record [s]")
    return figure


def _signal(record: Record, kind: str, name: str) -> tuple[Real, str]:
    """Samples (T,) and unit of an input or output."""
    names: Sequence[str] = getattr(record, f"{kind}_names")
    if name not in names:
        raise ValueError(f"{record.label}: no {kind} column {name!r}; there is {list(names)}")
    column, units = names.index(name), getattr(record, f"{kind}_units")
    return np.asarray(getattr(record, kind)[:, column]), units[column] if units else ""


def _name_records(axes: Axes, shown: Sequence[RunRecord], starts: Real) -> None:
    """Numbers above the records when names would run into each other."""
    for number, (item, start) in enumerate(zip(shown, starts, strict=False), 1):
        width = item.duration_s / starts[-1]
        name = style.plain(item.name, 40)
        # About 0.0125 of the axis per letter at this size; the table beside the picture lists number and
        # name.
        text = f"{number} {name}" if len(name) + 3 < width / 0.0125 else str(number)
        if len(text) > 2 or width > 0.012:
            axes.annotate(
                text,
                (start, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(1, 3),
                textcoords="offset points",
                fontsize=8.5,
                color="#444444",
            )
