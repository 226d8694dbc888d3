"""The records as measured: input and outputs over time, shaded by what each record is used for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ident.data.record import Record
from workflow.figures import style
from workflow.figures.bands import Real, outline
from workflow.figures.registry import drawing

Role = Literal["estimation", "validation", "repeat"]
_ZOOM_SAMPLES = 400


@dataclass(frozen=True)
class ShownRecord:
    """A record and what it is used for."""

    record: Record
    role: Role


@drawing("records")
def draw_records(shown: Sequence[ShownRecord], inputs: Sequence[str], outputs: Sequence[str]) -> Figure:
    """Rows: the named inputs and outputs. Left: all records one after another. Right: the liveliest part of
    the first.

    Raises ValueError when there is no record or a name is not in one of them.
    """
    if not shown:
        raise ValueError("there is no record to draw")
    with style.house_style():
        rows = [("input", name) for name in inputs] + [("output", name) for name in outputs]
        figure = style.new_figure(1.55 * len(rows) + 1.0)
        grid = figure.subplots(len(rows), 2, squeeze=False, sharex="col", width_ratios=[2.1, 1.0])
        starts = np.concatenate([[0.0], np.cumsum([_duration(item.record) * 1.02 for item in shown])])
        zoom = _liveliest(shown[0].record, outputs[0] if outputs else inputs[0])
        for (kind, name), (left, right) in zip(rows, grid, strict=True):
            for item, start in zip(shown, starts, strict=False):
                left.axvspan(
                    start, start + _duration(item.record), color=style.SHADE[item.role], alpha=0.10, lw=0
                )
                time, signal = outline(item.record.time_s + start, _signal(item.record, kind, name))
                left.plot(time, signal, **(style.MEASURED_LINE | {"lw": 0.6}))
            first = shown[0].record
            signal = _signal(first, kind, name)[zoom]
            draw = {"drawstyle": "steps-post"} if kind == "input" else {}
            right.plot(first.time_s[zoom], signal, **style.MEASURED_LINE, **draw)
            right.margins(x=0)
            left.set_ylabel(style.two_lines(name, _unit(first, kind, name)))
            left.set_xlim(0, starts[-1])
        _name_records(grid[0, 0], shown, starts)
        grid[0, 0].set_title("Records, one after another", pad=16)
        grid[0, 1].set_title("Close-up of record 1", pad=16)
        grid[-1, 0].set_xlabel("time, all records [s]")
        grid[-1, 1].set_xlabel("time in this record [s]")
        figure.align_ylabels()
        words = {
            "estimation": "used to estimate",
            "validation": "kept for validation",
            "repeat": "repeat, not fitted",
        }
        used = [role for role in words if any(item.role == role for item in shown)]
        figure.legend(
            handles=[Patch(color=style.SHADE[role], alpha=0.25, label=words[role]) for role in used],
            loc="outside lower center",
            ncols=len(used),
        )
    return figure


def _duration(record: Record) -> float:
    return record.n_samples * record.dt_s


def _signal(record: Record, kind: str, name: str) -> Real:
    names, values = (
        (record.input_names, record.input) if kind == "input" else (record.output_names, record.output)
    )
    if name not in names:
        raise ValueError(f"{record.label}: no {kind} column {name!r}; there is {list(names)}")
    return np.asarray(values[:, names.index(name)])


def _unit(record: Record, kind: str, name: str) -> str:
    names, units = (
        (record.input_names, record.input_units)
        if kind == "input"
        else (record.output_names, record.output_units)
    )
    return units[names.index(name)] if units else ""


def _liveliest(record: Record, name: str) -> slice:
    """The stretch of up to 400 samples in which the signal moves most."""
    length = min(_ZOOM_SAMPLES, record.n_samples)
    kind = "output" if name in record.output_names else "input"
    signal = _signal(record, kind, name)
    energy = np.concatenate([[0.0], np.cumsum((signal - signal.mean()) ** 2)])
    start = int(np.argmax(energy[length:] - energy[:-length]))
    return slice(start, start + length)


def _name_records(axes: Axes, shown: Sequence[ShownRecord], starts: Real) -> None:
    """Numbers above the records when names would run into each other."""
    total = starts[-1]
    for number, (item, start) in enumerate(zip(shown, starts, strict=False), 1):
        width = _duration(item.record) / total
        name = style.plain(item.record.name, 40)
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
