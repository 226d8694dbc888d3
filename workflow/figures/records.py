"""Signals as they are: of the records of a run, of any log, of a planned experiment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.data.record import Record
from workflow.figures import style
from workflow.figures.bands import Real, liveliest, outline
from workflow.figures.description import Picture, new_picture
from workflow.tasks.experiment import PlannedExperiment
from workflow.tasks.log_look import LogLook
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
    starts = np.concatenate([[0.0], np.cumsum([item.duration_s * 1.02 for item in shown])])
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
            left.plot(
                *outline(item.record.time_s + start, signal, max(600 // len(shown), 40)),
                **style.MEASURED_LINE | {"lw": 0.6},
            )
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
    return np.asarray(getattr(record, kind)[:, column]), units[column] if units else ""


# Panels of one picture; a log of more signals is looked at in parts.
_MOST = 12


@style.drawing("log")
def draw_log(found: LogLook) -> Picture | None:
    """One panel per column of numbers, the first twelve."""
    shown = [column for column in found.columns if column.values is not None][:_MOST]
    if not shown:
        return None
    picture, grid = new_picture(1.6 * len(shown), len(shown), 1, squeeze=False)
    known = found.time is not None and not found.time.why
    step = found.time.period_s if known and found.time is not None else 1.0
    for panel, column in zip(grid[:, 0], shown, strict=True):
        values = column.values
        assert values is not None
        panel.plot(step * np.arange(values.size), values, color=style.MEASURED, lw=0.7)
        panel.set(
            xlabel="time [s]" if known else "row [1]", ylabel=f"[{column.unit or '?'}]", title=column.name
        )
    return picture


# Seconds of a voltage that are shown: a panel of more shows a band and no signal.
_TIME_S = 10.0


@style.drawing("excitation")
def draw_excitation(found: PlannedExperiment) -> Picture:
    """A planned experiment: first record at the highest amplitude, lines of all, and what to expect.

    Right: the expected radius of the response, and its gain where it is known.
    """
    rms = np.array(found.plan.rms_V)
    loudest = int(np.argmax(rms))
    picture, (signal, lines, response) = new_picture(3.6, 1, 3)
    voltage = found.voltages_V[loudest, 0]
    time = np.arange(voltage.size) * found.limits.dt_s
    shown = time <= _TIME_S
    signal.plot(time[shown], voltage[shown], **style.REFERENCE_STEPS | {"ls": "-", "lw": 0.7})
    for sign in (1, -1):
        signal.axhline(sign * found.limits.peak_V, **style.LIMIT_LINE, label="voltage limit")
    lead_in_s = found.plan.lead_in_samples * found.limits.dt_s
    signal.axvspan(0, lead_in_s, color=style.MEASURED, alpha=0.2, lw=0, label="lead-in")
    cut = "" if shown.all() else f", first {_TIME_S:g} s"
    signal.set(xlabel=f"time [s]{cut}", ylabel="voltage [V]")
    signal.set_title(f"First record at {rms[loudest]:g} V rms")
    for value, shade in zip(rms, np.linspace(1.0, 0.45, rms.size), strict=True):
        line_V = np.full(found.lines_Hz.size, value * np.sqrt(2 / found.lines_Hz.size))
        dots = {"ls": "none", "marker": ".", "ms": 3, "alpha": shade, "color": style.MODEL}
        lines.plot(found.lines_Hz, line_V, **dots, label="excited line")
    bottom = 0.5 * rms.min() * np.sqrt(2 / found.lines_Hz.size)
    lines.plot(
        found.detection_Hz,
        np.full(found.detection_Hz.size, bottom),
        ls="none",
        marker="|",
        ms=6,
        color=style.ACHIEVED,
        label="detection line (odd)",
    )
    lines.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="amplitude of a line [V]")
    lines.set_title("Lines of every record")
    if found.gain is not None:
        response.plot(found.lines_Hz, found.gain, **style.MODEL_LINE, label="expected gain")
    for value, radius in zip(rms, found.radii, strict=True):
        response.plot(
            found.lines_Hz[[0, -1]], [radius] * 2, color=style.UNCERTAIN, lw=1.4, label="expected 95 % radius"
        )
        response.words(f"{value:g} V rms", found.lines_Hz[0], radius, offset=(0.0, 1.0))
    response.set(xscale="log", yscale="log", xlabel="frequency [Hz]", ylabel="hub angle / voltage [rad/V]")
    response.set_title("Response to be expected")
    return picture
