"""The loop over time: as computed from the identified model against as run on the machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.bands import Real, envelope, outline
from workflow.figures.registry import drawing
from workflow.figures.sensitivity import curves_of
from workflow.figures.subjects import MACHINE, RunView


@dataclass(frozen=True, eq=False)
class LoopTraces:
    """Closed-loop runs: time_s and reference (T,); output, command and performance (R, T) of R runs, or None.

    The first run is drawn as a line, all of them as the band between their extremes.
    """

    output: Real
    command: Real
    performance: Real | None = None

    def __post_init__(self) -> None:
        for name in ("output", "command", "performance"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, np.atleast_2d(np.asarray(value, dtype=np.float64)))


@dataclass(frozen=True, eq=False)
class LoopScene:
    """What was asked of the loop, and the axes' words: (name, unit) per signal.

    model: answer (T,) of the model that a reference filter makes the loop follow.
    """

    time_s: Real
    reference: Real
    disturbance: Real | None
    output: tuple[str, str]
    command: tuple[str, str]
    performance: tuple[str, str] | None = None
    command_limit: float | None = None
    model: Real | None = None


@drawing("closed-loop")
def draw_run(run: RunView) -> Figure:
    """The reference step and the disturbance of a run, predicted and on its machine."""
    loop, channel, performance = run.loop, run.config.control_channel, run.performance
    assert loop is not None
    scene = LoopScene(
        time_s=loop.time_s,
        reference=loop.reference,
        model=loop.model_answer,
        disturbance=loop.disturbance,
        output=(channel.output, run.output_unit),
        command=(channel.input, run.input_unit),
        performance=None if performance is None else (performance.found.output, performance.units[1]),
        command_limit=loop.input_limit,
    )
    predicted, runs = (
        LoopTraces(of.output, of.command, of.performance) for of in (loop.predicted_runs, loop.achieved_runs)
    )
    if loop.machine == "simulated":
        return draw_closed_loop(scene, predicted, runs, machine=MACHINE["simulated"])
    return draw_closed_loop(scene, predicted, None, spread=runs)


def draw_closed_loop(
    scene: LoopScene,
    predicted: LoopTraces,
    achieved: LoopTraces | None,
    *,
    machine: str = "machine",
    spread: LoopTraces | None = None,
) -> Figure:
    """Rows: fed-back output, performance output (if any), command. Left: the reference step. Right: the
    disturbance.

    `machine` says in words what 'achieved' ran on, if anything; `spread` are predictions for plants drawn
    from the uncertainty.
    """
    rows: list[tuple[str, tuple[str, str]]] = [("output", scene.output)]
    if scene.performance is not None and predicted.performance is not None:
        rows.append(("performance", scene.performance))
    rows.append(("command", scene.command))
    onset = _onset(scene)
    windows = _windows(scene, onset, predicted, achieved if achieved is not None else spread)
    with style.house_style():
        figure = style.new_figure(2.1 * len(rows) + 0.9)
        grid = figure.subplots(len(rows), len(windows), squeeze=False, sharex="col", sharey="row")
        for (kind, label), axes_row in zip(rows, grid, strict=True):
            for axes, (start, stop, _) in zip(axes_row, windows, strict=True):
                first, last = np.searchsorted(scene.time_s, [start, stop])
                part = slice(int(first), int(last) + (stop == scene.time_s[-1]))
                _draw_row(axes, scene, kind, predicted, achieved, spread, machine, part)
                axes.set_xlim(start, stop)
                if onset is not None and start <= onset <= stop:
                    axes.axvline(onset, color="#888888", lw=0.8, ls=":")
            axes_row[0].set_ylabel(style.two_lines(*label))
            _limits(axes_row[0], scene, kind, predicted, (achieved, spread))
        for axes, (_, _, title) in zip(grid[0], windows, strict=True):
            axes.set_title(title)
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
        figure.align_ylabels()
        style.finish(figure, grid.ravel(), columns=4)
    return figure


def _onset(scene: LoopScene) -> float | None:
    if scene.disturbance is None:
        return None
    moving = np.flatnonzero(scene.disturbance != scene.disturbance[0])
    if moving.size:
        return float(scene.time_s[moving[0]])
    return float(scene.time_s[0]) if scene.disturbance[0] != 0 else None


def _disturbance_size(scene: LoopScene) -> float:
    values = scene.disturbance if scene.disturbance is not None else np.zeros(1)
    return float(values[np.argmax(np.abs(values))])


def _windows(
    scene: LoopScene, onset: float | None, predicted: LoopTraces, other: LoopTraces | None
) -> list[tuple[float, float, str]]:
    """Start, end and title of each panel: step and disturbance apart, each as long as something moves."""
    start, stop = float(scene.time_s[0]), float(scene.time_s[-1])
    margin = 0.03 * (stop - start)
    if onset is None or not start + 4 * margin < onset < stop - 4 * margin:
        return [(start, stop, "Reference step" if onset is None else "Reference step and disturbance")]
    size = f"{_disturbance_size(scene):.3g} {style.plain(scene.command[1], 12)}".rstrip()
    windows = []
    for first, last, title in (
        (start, onset, "Reference step"),
        (onset - margin, stop, f"Disturbance of {size} at the plant's input"),
    ):
        quiet = _quiet_from(scene.time_s, first, last, predicted, other)
        # Cut only where much is saved; some rest after the motion shows that it is over.
        end = min(last, first + max(1.5 * (quiet - first), 0.2 * (last - first)))
        windows.append((first, end if end < first + 0.75 * (last - first) else last - 1e-9, title))
    return windows


def _quiet_from(
    time_s: Real, first: float, last: float, predicted: LoopTraces, other: LoopTraces | None
) -> float:
    """Time after which predicted runs stay within 2 % and the others (noisy) within 15 % of their range."""
    part = slice(int(np.searchsorted(time_s, first)), int(np.searchsorted(time_s, last)))
    quiet = first
    for traces, share in ((predicted, 0.02), (other, 0.15)):
        for kind in ("output", "command", "performance"):
            values = None if traces is None else getattr(traces, kind)
            if values is None:
                continue
            run = values[:, part]
            end = run[:, -max(1, run.shape[1] // 20) :].mean(axis=1, keepdims=True)
            moving = np.any(np.abs(run - end) > share * np.ptp(run, axis=1, keepdims=True), axis=0)
            if moving.any():
                quiet = max(quiet, float(time_s[part][np.flatnonzero(moving)[-1]]))
    return quiet


def _draw_row(
    axes: Axes,
    scene: LoopScene,
    kind: str,
    predicted: LoopTraces,
    achieved: LoopTraces | None,
    spread: LoopTraces | None,
    machine: str,
    part: slice,
) -> None:
    time = scene.time_s[part]
    hold: dict[str, Any] = {"drawstyle": "steps-post"} if kind == "command" else {}
    if spread is not None and getattr(spread, kind) is not None:
        many = getattr(spread, kind)[:, part]
        axes.fill_between(
            *envelope(time, many),
            **style.BAND,
            label=f"{many.shape[0]} plants from the uncertainty",
        )
    done = None if achieved is None else getattr(achieved, kind)
    if done is not None:
        if done.shape[0] > 1:
            axes.fill_between(
                *envelope(time, done[:, part]),
                color=style.ACHIEVED,
                alpha=0.22,
                lw=0,
                label=f"{machine}: all {done.shape[0]} runs",
            )
        first = f"{machine}: first run" if done.shape[0] > 1 else machine
        axes.plot(*outline(time, done[0, part], 180), **style.ACHIEVED_LINE, **hold, label=first)
    axes.plot(
        *outline(time, getattr(predicted, kind)[0, part], 180),
        **style.PREDICTED_LINE,
        **hold,
        label="predicted, nominal model",
    )
    if kind == "output":
        axes.plot(
            time, scene.reference[part], **style.REFERENCE_LINE, drawstyle="steps-post", label="reference"
        )
        if scene.model is not None:
            axes.plot(time, scene.model[part], **style.MODEL_LINE, ls=":", label="model to follow")


def _limits(
    axes: Axes,
    scene: LoopScene,
    kind: str,
    predicted: LoopTraces,
    others: Sequence[LoopTraces | None],
) -> None:
    """Height of a row, shared by its panels: all runs, but a run that leaves the scene does not flatten the
    others.

    The command's limits are drawn where they are near enough to matter to the picture, else said in words.
    """
    base = getattr(predicted, kind)
    low, high = float(base.min()), float(base.max())
    if kind == "output":
        low, high = min(low, float(scene.reference.min())), max(high, float(scene.reference.max()))
    span = high - low if high > low else max(abs(high), 1e-12)
    for traces in others:
        values = None if traces is None else getattr(traces, kind)
        if values is not None:
            low = max(min(low, float(values.min())), low - 3 * span)
            high = min(max(high, float(values.max())), high + 3 * span)
    limit = scene.command_limit if kind == "command" else None
    siblings = axes.get_shared_y_axes().get_siblings(axes)
    if limit is not None and limit <= 2.5 * max(abs(low), abs(high)):
        for sibling in siblings:
            for value in (-limit, limit):
                sibling.axhline(value, **style.LIMIT_LINE, label="saturation")
        # The nearer limit is shown; the other one only if the command comes anywhere near it.
        high = max(high, limit) if high > 0.4 * limit else high
        low = min(low, -limit) if low < -0.4 * limit else low
    elif limit is not None:
        axes.text(
            0.985,
            0.95,
            f"saturation at ±{limit:.4g} {scene.command[1]} is beyond this axis",
            transform=axes.transAxes,
            ha="right",
            va="top",
            fontsize=8.5,
            color=style.LIMIT,
            bbox={"facecolor": "white", "alpha": 0.75, "lw": 0, "pad": 0.8},
        )
    axes.set_ylim(*style.pad_limits(low, high, 0.08))


@dataclass(frozen=True, eq=False)
class MeasuredPeak:
    """|S| as measured: omega_rad_s, magnitude, its standard deviation (F,); `words` say on what."""

    words: str
    omega_rad_s: Real
    magnitude: Real
    std: Real


@dataclass(frozen=True, eq=False)
class PredictedSensitivity:
    """|S| of the nominal and worst case over the ellipses at omega_rad_s, (F,) each."""

    omega_rad_s: Real
    nominal: Real
    worst: Real


_MARKERS = (
    {"color": style.ACHIEVED, "marker": "o", "ms": 3.0},
    {"color": style.HIGHLIGHT, "marker": "^", "ms": 3.0},
    {"color": style.MEASURED, "marker": "s", "ms": 2.6},
)


@drawing("measured-sensitivity")
def draw_measured(run: RunView) -> Figure | None:
    """|S| of a run as measured on the arm; nothing where it was not."""
    loop, plant = run.loop, run.plant
    if loop is None or loop.sensitivity is None:
        return None
    low, high = loop.sensitivity.band_rad_s
    omega = np.geomspace(0.9 * low, min(1.1 * high, plant.nyquist_rad_s), 900)
    curve = curves_of(run, omega)[0]
    peaks = [MeasuredPeak(m.name, m.omega_rad_s, m.magnitude, m.std) for m in loop.sensitivity.measured]
    predicted = PredictedSensitivity(omega, curve.nominal, curve.worst)
    return draw_measured_sensitivity(predicted, peaks, level=run.level)


def draw_measured_sensitivity(
    predicted: PredictedSensitivity, measured: Sequence[MeasuredPeak], *, level: float
) -> Figure:
    """Left: |S| over the measured band. Right: around its peak, with two standard deviations."""
    with style.house_style():
        figure = style.new_figure(3.9)
        whole, near = figure.subplots(1, 2)
        omega = predicted.omega_rad_s
        at = int(np.argmax(predicted.worst))
        for axes in (whole, near):
            axes.fill_between(omega, predicted.nominal, predicted.worst, **style.BAND)
            axes.plot(
                omega,
                predicted.worst,
                color=style.UNCERTAIN,
                lw=1.2,
                label=f"worst case over the {100 * level:.4g} % ellipses",
            )
            axes.plot(omega, predicted.nominal, **style.PREDICTED_LINE, label="predicted, nominal model")
            for found, look in zip(measured, _MARKERS, strict=False):
                spread = {"yerr": 2 * found.std, "elinewidth": 0.6, "capsize": 0} if axes is near else {}
                axes.errorbar(
                    found.omega_rad_s, found.magnitude, ls="none", label=found.words, **look, **spread
                )
            axes.set_xlabel("frequency [rad/s]")
            axes.set_xscale("log")
        whole.set_yscale("log")
        whole.set_ylabel("|S| [1]")
        whole.set_title("Sensitivity, reference to error")
        low = min(float(found.omega_rad_s[0]) for found in measured)
        high = max(float(found.omega_rad_s[-1]) for found in measured)
        whole.set_xlim(low / 1.1, high * 1.1)
        inside = (omega >= low) & (omega <= high)
        whole.set_ylim(0.7 * float(predicted.nominal[inside].min()), 1.6 * float(predicted.worst.max()))
        start, stop = max(low, omega[at] / 3), min(high, omega[at] * 3)
        peak = float(predicted.worst[at])
        shown = [m.magnitude[(m.omega_rad_s >= start) & (m.omega_rad_s <= stop)] for m in measured]
        top = min(max([peak, *(float(part.max()) for part in shown if part.size)]), 1.5 * peak)
        part = (omega >= start) & (omega <= stop)
        near.set_xlim(start, stop)
        near.set_ylim(*style.pad_limits(float(predicted.nominal[part].min()), top, 0.08))
        near.set_title("Around its peak (bars: two standard deviations)")
        style.finish(figure, [whole, near], columns=3)
    return figure


@dataclass(frozen=True, eq=False)
class ConditionTraces:
    """One condition: name, words, reference, predicted and achieved output (T,)."""

    name: str
    words: str
    reference: Real
    predicted: Real
    achieved: Real


@drawing("closed-loop-conditions")
def draw_run_conditions(run: RunView) -> Figure | None:
    """The loop of a run under other conditions; nothing where none was tried."""
    loop, output = run.loop, run.config.control_channel.output
    if loop is None or not loop.conditions:
        return None
    rows = [ConditionTraces(c.name, c.words, c.reference, c.predicted, c.achieved) for c in loop.conditions]
    time_s = loop.time_s[: rows[0].reference.size]
    return draw_conditions(time_s, rows, (output, run.output_unit), machine=MACHINE[loop.machine])


def draw_conditions(
    time_s: Real, conditions: Sequence[ConditionTraces], label: tuple[str, str], *, machine: str
) -> Figure:
    """One panel per condition: reference, prediction and what the machine did."""
    columns = 3
    rows = -(-len(conditions) // columns)
    with style.house_style():
        figure = style.new_figure(1.95 * rows + 0.8)
        grid = figure.subplots(rows, columns, squeeze=False, sharex=True)
        panels = grid.ravel()
        for axes in panels[len(conditions) :]:
            axes.set_visible(False)
        for axes, found in zip(panels, conditions, strict=False):
            axes.plot(*outline(time_s, found.achieved, 120), **style.ACHIEVED_LINE, label=machine)
            axes.plot(
                *outline(time_s, found.predicted, 120),
                **style.PREDICTED_LINE,
                label="predicted, nominal model",
            )
            axes.plot(
                time_s, found.reference, **style.REFERENCE_LINE, drawstyle="steps-post", label="reference"
            )
            axes.set_title(found.name)
            values = np.concatenate([found.reference, found.predicted])
            low, high = float(values.min()), float(values.max())
            span = high - low
            low = max(min(low, float(found.achieved.min())), low - span)
            high = min(max(high, float(found.achieved.max())), high + span)
            axes.set_ylim(*style.pad_limits(low, high, 0.08))
            axes.set_xlim(float(time_s[0]), float(time_s[-1]))
        for row in grid:
            row[0].set_ylabel(style.two_lines(*label))
        for index in range(columns):
            lowest = [axes for axes in grid[:, index] if axes.get_visible()]
            if lowest:
                lowest[-1].set_xlabel("time [s]")
                lowest[-1].tick_params(labelbottom=True)
        figure.align_ylabels()
        style.finish(figure, list(panels[: len(conditions)]), columns=3)
    return figure
