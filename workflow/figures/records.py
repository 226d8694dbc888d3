"""Signals as they are: the records of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.data.record import Record
from workflow.figures import style
from workflow.figures.bands import Real, liveliest, outline
from workflow.figures.description import Picture, new_picture
from workflow.tasks.results import RunRecord

# Samples of the close-up: as many as a panel has pixels across.
_ZOOM_SAMPLES = 400
# Roles of a record in the legend.
_WORDS = {
    "estimation": "used to estimate",
    "validation": "kept for validation",
    "repeat": "repeat, not fitted",
}


@style.drawing("records")
def draw_records(shown: Sequence[RunRecord], inputs: Sequence[str], outputs: Sequence[str]) -> Picture:
    """Records one after another, shaded by what each is used for, and the liveliest part of the first.

    Parameters
    ----------
    shown : sequence of RunRecord
        One or more.
    inputs, outputs : sequences of str
        Columns, a row of the picture each.

    Raises
    ------
    ValueError
        There is no record, or a name is not in one of them.
    """
    if not shown:
        raise ValueError("there is no record to draw")
    rows = [("input", name) for name in inputs] + [("output", name) for name in outputs]
    picture, grid = new_picture(
        1.55 * len(rows) + 1.0, len(rows), 2, squeeze=False, sharex="col", width_ratios=[2.1, 1.0]
    )
    # A fiftieth of each record is left free before the next.
    lengths_s = [item.duration_s * 1.02 for item in shown]
    starts = np.concatenate([[0.0], np.cumsum(lengths_s)])
    first = shown[0].record
    # The first output where there is one, else the first input.
    liveliest_row = rows[0]
    if outputs:
        liveliest_row = rows[len(inputs)]
    lively, _ = _signal(first, *liveliest_row)
    zoom = liveliest(lively, min(_ZOOM_SAMPLES, first.n_samples))
    for (kind, name), (left, right) in zip(rows, grid, strict=True):
        for item, start in zip(shown, starts, strict=False):
            shade = {"color": style.SHADE[item.role], "label": _WORDS[item.role], "alpha": 0.15, "lw": 0}
            left.axvspan(start, start + item.duration_s, **shade)
            signal, _ = _signal(item.record, kind, name)
            # Many records share one axis: each gets as many points as it has pixels.
            n_points = max(600 // len(shown), 40)
            drawn = outline(item.record.time_s + start, signal, n_points)
            left.plot(*drawn, **style.MEASURED_LINE | {"lw": 0.6})
        signal, unit = _signal(first, kind, name)
        steps = {"drawstyle": "steps-post"} if kind == "input" else {}
        right.plot(first.time_s[zoom], signal[zoom], **style.MEASURED_LINE, **steps)
        right.x.margin = 0.0
        left.set(ylabel=style.two_lines(name, unit))
        left.set(xlim=(0, starts[-1]))
    # Numbers above the records where names would run into each other.
    for number, (item, start) in enumerate(zip(shown, starts, strict=False), 1):
        width = item.duration_s / starts[-1]
        label = style.plain(item.name, 40)
        # About 0.0125 of the axis per letter at this size; a table beside the picture has number and name.
        text = f"{number} {label}" if len(label) + 3 < width / 0.0125 else str(number)
        if len(text) > 2 or width > 0.012:
            grid[0, 0].words(text, start, 1.0, across_y=True, offset=(1.0, 3.0), size=8.5, color="#444444")
    grid[0, 0].set_title("Records, one after another", raised=16)
    grid[0, 1].set_title("Close-up of record 1", raised=16)
    grid[-1, 0].set(xlabel="time, all records [s]")
    grid[-1, 1].set(xlabel="time in this record [s]")
    return picture


def _signal(record: Record, kind: str, name: str) -> tuple[Real, str]:
    """Samples (T,) and unit of an input or output."""
    names: Sequence[str] = getattr(record, f"{kind}_names")
    if name not in names:
        raise ValueError(f"{record.label}: no {kind} column {name!r}; there is {list(names)}")
    column = names.index(name)
    units = getattr(record, f"{kind}_units")
    signals = getattr(record, kind)
    return np.asarray(signals[:, column]), units[column] if units else ""
