"""The loop as computed from the model against as run on the machine: in time, |S| as measured, friction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from workflow.figures import style
from workflow.figures.bands import Real, envelope, outline
from workflow.figures.description import Panel, Picture, new_picture, pad_limits, small_multiples
from workflow.figures.sensitivity import curves_of, draw_curve
from workflow.figures.subjects import FRICTION, MACHINE, RunView
from workflow.tasks.results import LoopRuns
from workflow.text.formats import si

# Predicted runs are at rest from where they stay within this share of their range of where they end: as of a
# settling time.
_PREDICTED_REST = 0.02
# The same of runs on a machine, which are noisy. Chosen.
_MACHINE_REST = 0.15
# A panel is this much longer than what moves in it. Chosen: some rest shows that it is over.
_WITH_REST = 1.5
# A panel that is cut is at least this share of its whole length: less looks like a jump.
_LEAST_SHARE = 0.2
# A panel is cut only where less than this share of it is left: elsewhere little is saved.
_WORTH_CUTTING = 0.75
# The step's panel goes on beyond the settling time by this factor, so that it is no corner of the picture.
_BEYOND_SETTLING = 1.15
# Share of the whole time before a disturbance that its panel shows, for where it comes from.
_BEFORE_DISTURBANCE = 0.03
# A disturbance nearer to either end than this many times the time before it gets no panel of its own.
_FEWEST_MARGINS = 4
# Share of a command's limit that a run has to reach for the limit to be drawn: else it only makes it flat.
_NEAR_LIMIT = 0.4
# Runs that leave the range of the prediction by more than this many times it are cut in the picture.
_MOST_BEYOND = 3.0
# Within this time [s] two instants are one: far below any sampling period.
_SAME_INSTANT_S = 1e-9
# The loop on the identified model.
_PREDICTED: dict[str, Any] = style.PREDICTED_LINE | {"label": "predicted"}
# What is asked for.
_REFERENCE: dict[str, Any] = style.REFERENCE_STEPS | {"label": "reference"}


@style.drawing("closed-loop")
def draw_run(run: RunView) -> Picture:
    """The reference step and the disturbance of a run, predicted and on its machine."""
    loop = run.results.closed_loop.check
    channel = run.config.control_channel
    performance = run.performance
    assert loop is not None
    labels = {"output": (channel.output, run.output_unit)}
    if performance is not None:
        labels["performance"] = (performance.found.output, performance.units[1])
    return draw_closed_loop(
        loop.time_s,
        loop.reference,
        loop.predicted_runs,
        labels | {"command": (channel.input, run.input_unit)},
        others=loop.achieved_runs,
        machine=MACHINE["simulated"] if loop.machine == "simulated" else "",
        disturbance=loop.disturbance,
        command_limit=loop.input_limit,
        model=loop.model_answer,
        with_friction=loop.with_friction,
        settled_s=loop.longest_settling_s,
    )


def draw_closed_loop(
    time_s: Real,
    reference: Real,
    predicted: LoopRuns,
    labels: Mapping[str, tuple[str, str]],
    *,
    others: LoopRuns | None = None,
    machine: str = "",
    disturbance: Real | None = None,
    command_limit: float | None = None,
    model: Real | None = None,
    with_friction: Sequence[Real] = (),
    settled_s: float | None = None,
    onto: tuple[Picture, Panel] | None = None,
) -> Picture:
    """The loop in time. Left: the reference step. Right: the disturbance.

    The first run is drawn as a line, all of them as the band between their extremes.

    Parameters
    ----------
    time_s, reference : (T,) arrays
    predicted : LoopRuns
        On the identified model, one run.
    labels : mapping of str to (str, str)
        Rows of the picture, of "output", "performance" and "command": name and unit of each.
    others : LoopRuns, optional
        On the machine.
    machine : str
        That machine in words; "": plants drawn from the uncertainty.
    disturbance : (T,) array, optional
    command_limit : float, optional
    model : (T,) array, optional
        Output of the model that a reference filter makes the loop follow.
    with_friction : sequence of arrays
        Outputs of the lines `FRICTION`, as far as they go; the step's panel goes as far as the longest.
    settled_s : float, optional
        The panels are cut where nothing moves any more, not before this time after the step; None: the step
        is shown whole, until the disturbance begins where there is one.
    onto : tuple of Picture and Panel, optional
        Drawn on in place of a new picture; of one row and column.
    """
    all_runs = (predicted,) if others is None else (predicted, others)
    dt_s = float(time_s[1] - time_s[0])
    # The steps with friction may be watched for longer than the trial.
    longest = max((line.size for line in with_friction), default=1)
    friction_s = float(time_s[0]) + dt_s * (longest - 1)
    onset, windows = _windows(time_s, reference, disturbance, labels, all_runs, settled_s, friction_s)
    grid: Any
    if onto is not None:
        picture = onto[0]
        grid = np.array([[onto[1]]])
    else:
        picture, grid = new_picture(
            2.1 * len(labels) + 0.9, len(labels), len(windows), squeeze=False, sharex="col", sharey="row"
        )

    # A row for output, performance and command each, a column for step and disturbance.
    for (kind, label), row in zip(labels.items(), grid, strict=True):
        # A command is held from sample to sample.
        hold = {"drawstyle": "steps-post"} if kind == "command" else {}
        line: Real = getattr(predicted, kind)[0]
        for panel, window in zip(row, windows, strict=True):
            part = _samples(time_s, window)
            time = time_s[part]
            if others is not None:
                _draw_runs(panel, time, getattr(others, kind)[:, part], machine, hold)
            panel.plot(*outline(time, line[part], hold=bool(hold)), **_PREDICTED, **hold)
            if kind == "output":
                wanted_s, wanted = outline(time, reference[part], hold=True)
                # Up to the panel's edge, also where the samples end before it.
                until_s = np.append(wanted_s, window.stop)
                until = np.append(wanted, wanted[-1])
                panel.plot(until_s, until, **_REFERENCE)
                if window is windows[0]:
                    for output, look in zip(with_friction, FRICTION, strict=False):
                        # It may go on beyond the other runs.
                        friction_time_s = time_s[0] + dt_s * np.arange(output.size)
                        seen = friction_time_s <= window.stop
                        panel.plot(*outline(friction_time_s[seen], output[seen]), **look)
                if model is not None:
                    looks = style.MODEL_LINE | {"ls": ":", "label": "model to follow"}
                    panel.plot(*outline(time, model[part]), **looks)
            panel.set(xlim=(window.start, window.stop))
            if onset is not None and window.start <= onset <= window.runs_until:
                panel.axvline(onset, color="#888888", lw=0.8, ls=":")
        row[0].set(ylabel=style.two_lines(*label))

        # Height of the row: the prediction, and other runs as far as they do not flatten it.
        wanted_range = line
        runs = list[Real]()
        if kind == "output":
            wanted_range = np.append(line, reference)
            runs += with_friction
        if others is not None:
            runs.append(getattr(others, kind))
        low, high = height(wanted_range, runs, _MOST_BEYOND)

        # The command's limits, where it comes near enough for them to matter.
        limits: tuple[float, ...] = ()
        if kind == "command" and command_limit is not None:
            limits = (-command_limit, command_limit)
        for limit in limits:
            # How far the command goes towards this limit.
            reached = -low if limit < 0 else high
            if _NEAR_LIMIT * abs(limit) < reached:
                low = min(low, limit)
                high = max(high, limit)
                for panel in row:
                    panel.axhline(limit, **style.LIMIT_LINE, label="saturation")
        row[0].set(ylim=pad_limits(low, high, 0.08))
    for panel, window in zip(grid[0], windows, strict=True):
        panel.set_title(window.title)
    for panel in grid[-1]:
        panel.set(xlabel="time [s]")
    return picture


def _draw_runs(panel: Panel, time_s: Real, runs: Real, machine: str, hold: dict[str, Any]) -> None:
    """Runs (R, T) of a machine as a band with the first as a line, those of other plants as a band."""
    count = runs.shape[0]
    if not machine:
        panel.fill_between(
            *envelope(time_s, runs), **style.BAND, label=f"{count} plants from the uncertainty"
        )
        return
    if count > 1:
        panel.fill_between(
            *envelope(time_s, runs), **style.ACHIEVED_BAND, label=f"{machine}: all {count} runs"
        )
    label = f"{machine}: first run" if count > 1 else machine
    look: dict[str, Any] = style.ACHIEVED_LINE | hold
    panel.plot(*outline(time_s, runs[0], hold=bool(hold)), **look, label=label)


class _Window(NamedTuple):
    """What a column of panels shows, in s: the axis, and until when the runs are about its title."""

    start: float
    stop: float
    runs_until: float
    title: str


def _samples(time_s: Real, window: _Window) -> slice:
    """Samples of the runs that a window shows."""
    stop = min(window.stop, window.runs_until)
    first, last = np.searchsorted(time_s, [window.start, stop])
    # The last sample of all belongs to the window that ends with it.
    if stop == time_s[-1]:
        last += 1
    return slice(int(first), int(last))


def _windows(
    time_s: Real,
    reference: Real,
    disturbance: Real | None,
    labels: Mapping[str, tuple[str, str]],
    all_runs: tuple[LoopRuns, ...],
    settled_s: float | None,
    friction_s: float,
) -> tuple[float | None, list[_Window]]:
    """When the disturbance begins, and the panels: step and disturbance apart.

    Each is as long as something moves, the step at least until `settled_s` after it (None: the step is shown
    whole, until the disturbance begins where there is one). Lines with friction go on to `friction_s`, where
    they settle later than the others, and the step's panel with them.
    """
    start = float(time_s[0])
    stop = float(time_s[-1])
    stepped = np.flatnonzero(reference != reference[0])
    step_s = float(time_s[stepped[0]]) if stepped.size else start

    def shown(first: float, last: float, least: float, title: str) -> _Window:
        begin = int(np.searchsorted(time_s, first))
        end_of_part = int(np.searchsorted(time_s, last))
        part = slice(begin, end_of_part)
        quiet_s = []
        for runs, tolerance in zip(all_runs, (_PREDICTED_REST, _MACHINE_REST), strict=False):
            for kind in labels:
                signals = getattr(runs, kind)[:, part]
                quiet_s.append(_quiet_from(time_s[part], signals, tolerance))
        moving_s = max(quiet_s) - first
        length = last - first
        shown_s = max(_WITH_REST * moving_s, _LEAST_SHARE * length)
        end = max(first + shown_s, least)
        # The first sample of the disturbance is not of the step's panel.
        uncut = last if last == stop else last - _SAME_INSTANT_S
        if least > uncut:
            return _Window(first, max(uncut, min(least, friction_s)), uncut, title)
        if end < first + _WORTH_CUTTING * length:
            return _Window(first, end, uncut, title)
        return _Window(first, uncut, uncut, title)

    least_s = np.inf
    if settled_s is not None:
        least_s = step_s + _BEYOND_SETTLING * settled_s

    if disturbance is None or not disturbance.any():
        if settled_s is None:
            return None, [_Window(start, stop, stop, "Reference step")]
        return None, [shown(start, stop, least_s, "Reference step")]

    moving = np.flatnonzero(disturbance != disturbance[0])
    onset = float(time_s[moving[0]]) if moving.size else start
    before_s = _BEFORE_DISTURBANCE * (stop - start)
    room_s = _FEWEST_MARGINS * before_s
    if not start + room_s < onset < stop - room_s:
        return onset, [_Window(start, stop, stop, "Reference step and disturbance")]
    largest = disturbance[np.argmax(np.abs(disturbance))]
    size = si(float(largest), style.plain(labels["command"][1], 12))
    return onset, [
        shown(start, onset, least_s, "Reference step"),
        shown(onset - before_s, stop, 0.0, f"Disturbance of {size} at the plant's input"),
    ]


def _quiet_from(time_s: Real, runs: Real, tolerance: float) -> float:
    """Time after which all runs (R, T) stay within a share of their range of where they end."""
    # The mean over the last twentieth: noise has no last value.
    last = max(1, time_s.size // 20)
    end = runs[:, -last:].mean(axis=1, keepdims=True)
    range_of_run = np.ptp(runs, axis=1, keepdims=True)
    moving = np.any(np.abs(runs - end) > tolerance * range_of_run, axis=0)
    if not moving.any():
        return float(time_s[0])
    return float(time_s[np.flatnonzero(moving)[-1]])


def height(asked: Real, runs: Sequence[Real], most: float) -> tuple[float, float]:
    """Range of a row of panels.

    Parameters
    ----------
    asked : (N,) array
        Values that are shown whole.
    runs : sequence of arrays
        Further values; one that leaves the range of `asked` by more than `most` times it does not flatten the
        others.
    most : float

    Returns
    -------
    low, high : float
    """
    low = float(asked.min())
    high = float(asked.max())
    # A reference that stands has no span: its own size is the next best measure.
    span = high - low if high > low else max(abs(high), 1e-12)
    together = np.nan_to_num(np.concatenate([asked, *(np.ravel(run) for run in runs)]), nan=low)
    shown = np.clip(together, low - most * span, high + most * span)
    return float(shown.min()), float(shown.max())


# Arms on which |S| was measured, in their order.
_MARKERS = (
    {"color": style.ACHIEVED, "marker": "o", "ms": 3.0},
    {"color": style.HIGHLIGHT, "marker": "^", "ms": 3.0},
    {"color": style.MEASURED, "marker": "s", "ms": 2.6},
)


@style.drawing("measured-sensitivity")
def draw_measured_sensitivity(run: RunView) -> Picture | None:
    """|S| as measured on the arm with two standard deviations, beside nominal and worst case.

    None where it was not measured.
    """
    loop = run.results.closed_loop.check
    if loop is None or loop.sensitivity is None:
        return None
    low, high = loop.sensitivity.band_rad_s
    # A little beyond the measured lines, so that the first and the last do not stand on the frame.
    high = min(1.1 * high, run.plant.nyquist_rad_s)
    is_near = (run.loop_grid > 0.9 * low) & (run.loop_grid < high)
    fine = run.loop_grid[is_near]
    # Both grids together: even for the eye, and fine at the resonances.
    plain_grid = np.geomspace(0.9 * low, high, 900)
    curve = curves_of(run, np.union1d(plain_grid, fine))[0]
    picture, panel = new_picture(4.4)
    draw_curve(panel, curve, run.level)
    for measured, look in zip(loop.sensitivity.measured, _MARKERS, strict=False):
        size = measured.magnitude
        # A bar that would reach zero has no lower end on a log axis.
        half = np.minimum(2 * measured.std, 0.9 * size)
        bars = {"color": look["color"], "lw": 0.6, "solid_capstyle": "butt"}
        panel.uprights(measured.omega_rad_s, size - half, size + half, **bars)
        panel.plot(measured.omega_rad_s, size, **look, ls="none", label=measured.name)
    panel.set(title="Sensitivity, reference to error (bars: two standard deviations)")
    panel.set(xlabel="frequency [rad/s]")
    return picture


@style.drawing("closed-loop-conditions")
def draw_conditions(run: RunView) -> Picture | None:
    """The loop under other conditions, a panel each: reference, prediction and what the machine did.

    Nothing where none was tried.
    """
    loop = run.results.closed_loop.check
    columns = 3
    if loop is None or not loop.conditions:
        return None
    time_s = loop.time_s[: loop.conditions[0].reference.size]
    picture, panels = small_multiples(len(loop.conditions), columns, 1.95, 0.8, sharex=True)
    for panel, condition in zip(panels, loop.conditions, strict=True):
        achieved = outline(time_s, condition.achieved)
        panel.plot(*achieved, **style.ACHIEVED_LINE, label=MACHINE[loop.machine])
        panel.plot(*outline(time_s, condition.predicted), **_PREDICTED)
        panel.plot(*outline(time_s, condition.reference, hold=True), **_REFERENCE)
        panel.set_title(condition.name)
        calm = np.append(condition.reference, condition.predicted)
        low, high = height(calm, [condition.achieved], 1.0)
        panel.set(ylim=pad_limits(low, high, 0.08))
        panel.set(xlim=(float(time_s[0]), float(time_s[-1])))
    for panel in panels[::columns]:
        panel.set(ylabel=style.two_lines(run.config.control_channel.output, run.output_unit))
    for panel in panels[-columns:]:
        panel.set(xlabel="time [s]")
    return picture


@style.drawing("friction-in-the-loop")
def draw_friction(run: RunView) -> Picture | None:
    """What dry friction does to the loop. Left: peak of |S| by size of the reference. Right: error on a sine.

    The peak is predicted with friction, measured where there is a machine, and certified without friction.
    None where friction was not identified.
    """
    if run.results.closed_loop.check is None or run.results.closed_loop.check.friction is None:
        return None
    loop = run.results.closed_loop.check
    friction = run.results.closed_loop.check.friction
    unit = run.output_unit
    name = run.config.control_channel.output
    sine = friction.tracking
    picture, (peaks, errors) = new_picture(3.9, 1, 2)

    # Peaks of |S|.
    bars = {"color": style.UNCERTAIN, "lw": 5.0, "alpha": 0.7, "solid_capstyle": "butt"}
    peaks.uprights(
        friction.sizes, friction.low, friction.high, **bars, label="identified arm with friction, 95 %"
    )
    if friction.measured is not None:
        looks = {"color": style.ACHIEVED, "marker": "o", "ms": 4.0, "ls": "none"}
        peaks.plot(friction.sizes, friction.measured, **looks, label=f"measured, {MACHINE[loop.machine]}")
    peaks.axhline(friction.nominal_peak, **style.PREDICTED_LINE, label="linear prediction")
    if np.isfinite(friction.certified_peak):
        peaks.axhline(friction.certified_peak, **style.LIMIT_LINE, label="certified")
    if friction.sticking_step > 0:
        peaks.axvline(
            friction.sticking_step, **style.REFERENCE_LINE, label="smaller steps do not move the arm"
        )
    peaks.set(xscale="log", title="Peak of |S| by size of the reference", ylabel="|S| [1]")
    peaks.set(xlabel=f"rms of the reference [{style.plain(unit, 12)}]")

    # Errors on the slow sine.
    time_s = np.asarray(np.arange(sine.without.size) * run.plant.dt_s, dtype=np.float64)
    for error, look, words in (
        (sine.without, style.ACHIEVED_LINE, "without feed-forward"),
        (sine.given, style.MODEL_LINE, "with friction feed-forward"),
    ):
        errors.plot(*outline(time_s, error), **look, label=words)
    for sign in (-1, 1) if friction.error_at_rest > 0 else ():
        errors.axhline(
            sign * friction.error_at_rest, **style.LIMIT_LINE, label="largest error at rest (friction)"
        )
    errors.set(xlabel="time [s]", title="Error on a sine")
    errors.set(xlim=(0.0, float(time_s[-1])))
    errors.set(ylabel=style.two_lines(name, unit))
    return picture
