"""Which pictures a run has, and how each is drawn from the run's results."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from control_design.analysis.stability import closed_loop_poles
from control_design.plants.frequency_grid import frequency_grid
from control_design.plants.plant_set import Mode, modes_of
from ident.checks.validation import fit_on_fresh_data
from ident.search.error_surface import error_surface
from ident.stabilisation import Stabilisation
from ident.uncertainty import ResponsePosterior
from workflow.figures.bands import Real
from workflow.figures.bode import EmpiricalResponse, draw_bode
from workflow.figures.closed_loop import (
    ConditionTraces,
    LoopScene,
    LoopTraces,
    MeasuredPeak,
    PredictedSensitivity,
    draw_closed_loop,
    draw_conditions,
    draw_measured_sensitivity,
)
from workflow.figures.error_surface import draw_error_surface, searched_pairs
from workflow.figures.nyquist import UncertainLoop, draw_nyquist, uncertain_loop
from workflow.figures.order import draw_order
from workflow.figures.overview import StepView, draw_overview
from workflow.figures.poles import draw_poles
from workflow.figures.records import ShownRecord, draw_records
from workflow.figures.repeats import draw_repeat_scatter
from workflow.figures.residuals import draw_residual_tests
from workflow.figures.sensitivity import draw_sensitivities, sensitivity_curves
from workflow.figures.style import ratio_unit
from workflow.figures.validation import draw_validation
from workflow.report.data import ChannelData, RunData
from workflow.tasks.results import LoopRuns

Drawer = Callable[[], Figure]

MACHINE_WORDS = {"simulated": "simulated arm", "identified": "plants drawn from the identified uncertainty"}


def pictures_of(data: RunData) -> dict[str, Drawer]:
    """Every picture of the run by the name of its file (without ending), in the order of the page."""
    drawers: dict[str, Drawer] = {"records": lambda: _records(data)}
    for index, channel in enumerate(data.channels):
        drawers |= _of_channel(data, index, channel)
    if data.has_controller and data.plant is not None:
        drawers["nyquist"] = lambda: _nyquist(data)
        drawers["sensitivities"] = lambda: _sensitivities(data)
    if data.closed_loop is not None:
        drawers["closed-loop"] = lambda: _closed_loop(data)
        if data.closed_loop.sensitivity and data.plant is not None:
            drawers["measured-sensitivity"] = lambda: _measured_sensitivity(data)
        if data.closed_loop.conditions:
            drawers["closed-loop-conditions"] = lambda: _conditions(data)
    if data.closed_loop is not None and data.plant is not None:
        drawers["overview"] = lambda: _overview(data)
    return drawers


def channel_picture(family: str, index: int, label: str) -> str:
    """File name of a channel's picture: letters, digits and dashes only, whatever the channel is called."""
    slug = re.sub(r"[^A-Za-z0-9]+", "-", label).strip("-").lower()[:24]
    return f"{family}-{index + 1}{'-' + slug if slug else ''}"


def _of_channel(data: RunData, index: int, channel: ChannelData) -> dict[str, Drawer]:
    found: dict[str, Drawer] = {}

    def add(family: str, drawer: Drawer) -> None:
        found[channel_picture(family, index, channel.label)] = drawer

    pair = shown_pair(channel)
    if pair is not None:
        add("error-surface", lambda: _error_surface(channel, pair))
    add("poles", lambda: _poles(data, channel, with_loop=index == data.config.control_index))
    add("bode", lambda: _bode(data, channel))
    add("validation", lambda: _validation(data, channel))
    plot, steps = channel.stabilisation, channel.result.identification.order_table
    if plot is not None and steps:
        add("order", lambda: _order(channel, plot))
    tests = channel.uncertain
    add(
        "residuals",
        lambda: draw_residual_tests(tests.test("whiteness"), tests.test("independence"), name=channel.label),
    )
    rows = channel.uncertain.repeat_scatter
    if rows:
        add("repeats", lambda: draw_repeat_scatter(rows, name=channel.label))
    return found


def shown_pair(channel: ChannelData) -> int | None:
    """Index of the pole pair whose error surface is shown: the slowest lightly damped one, else the
    slowest."""
    model = channel.result.identification.model
    if model.poles.pairs.size == 0:
        return None
    omega, zeta = model.poles.omega_rad_s(model.dt_s), model.poles.zeta()
    light = np.flatnonzero((zeta < 0.3) & (zeta > 5e-4))
    candidates = light if light.size else np.arange(omega.size)
    return int(candidates[np.argmin(omega[candidates])])


def fresh_index(data: RunData, channel: ChannelData) -> int | None:
    """Which free run is shown: the first validation record, else the first repeat, else None (a fitted
    record)."""
    role = {item.record.name: item.role for item in data.records}
    for wanted in ("validation", "repeat"):
        for i, fit in enumerate(channel.result.fresh):
            if role[fit.name] == wanted:
                return i
    return None


def _records(data: RunData) -> Figure:
    inputs = list(dict.fromkeys(channel.input for channel in data.config.channels))
    outputs = list(dict.fromkeys(channel.output for channel in data.config.channels))
    return draw_records([ShownRecord(item.record, item.role) for item in data.records], inputs, outputs)


def _error_surface(channel: ChannelData, pair: int) -> Figure:
    found = channel.result.identification
    poles, dt_s = found.model.poles, found.model.dt_s
    omega, zeta = float(poles.omega_rad_s(dt_s)[pair]), float(poles.zeta()[pair])
    longest_s = max(record.n_samples for record in channel.result.used) * dt_s
    low = min(max(omega / 8, 2 * np.pi / longest_s), 0.8 * omega)
    high = max(min(8 * omega, 0.95 * np.pi / dt_s), 1.02 * omega)
    wide = np.geomspace(low, high, 30)
    # The valley of a lightly damped pair is as narrow as its damping: even steps would jump over it.
    near = omega * np.exp(zeta * np.sinh(np.linspace(-3.0, 3.0, 21)))
    surface = error_surface(
        channel.result.used,
        found.model,
        found.structure,
        pair=pair,
        first=np.unique(np.concatenate([wide, near[(near > low) & (near < high)]])),
        second=np.geomspace(min(1e-3, zeta / 3), max(0.7, min(0.97, 1.1 * zeta)), 24),
    )
    return draw_error_surface(surface, searched_pairs(found.search.stages, omega), name=channel.label)


def _poles(data: RunData, channel: ChannelData, *, with_loop: bool) -> Figure:
    model = channel.result.identification.model
    loop = None
    if with_loop and data.has_controller and data.plant is not None and data.synthesis is not None:
        loop = closed_loop_poles(data.synthesis.controller, data.plant)
    return draw_poles(
        model.dt_s,
        identified=model.poles.values,
        integrators=model.integrators,
        closed_loop=loop,
        name=channel.label,
    )


def _order(channel: ChannelData, plot: Stabilisation) -> Figure:
    return draw_order(
        channel.result.identification.order_table,
        (plot.n_real, plot.chosen),
        plot,
        name=channel.label,
        response=_empirical(channel),
    )


def _empirical(channel: ChannelData) -> EmpiricalResponse | None:
    if channel.empirical is None:
        return None
    return EmpiricalResponse(channel.empirical.omega_rad_s, channel.empirical.centre)


def _bode(data: RunData, channel: ChannelData) -> Figure:
    model = channel.result.identification.model
    return draw_bode(
        channel.frequency,
        name=channel.label,
        input_label=(model.input_name, data.unit(model.input_name)),
        output_label=(model.output_name, data.unit(model.output_name)),
        model=channel.nominal,
        empirical=_empirical(channel),
    )


def _validation(data: RunData, channel: ChannelData) -> Figure:
    found, fresh = channel.result.identification, fresh_index(data, channel)
    if fresh is None:
        record = channel.result.used[0]
        fit = fit_on_fresh_data(found.model, record)
        return draw_validation(record, fit, kept_as="estimation", noise_std=found.noise_std)
    record, fit = channel.fresh_records[fresh], channel.result.fresh[fresh]
    role = next(item.role for item in data.records if item.record.name == fit.name)
    return draw_validation(record, fit, kept_as=role, noise_std=found.noise_std)


def _loop_grid(data: RunData) -> Real:
    """Display frequencies, denser around the modes of controller and closed loop, with the certificate's
    worst one.

    A controller that notches a mode has features as narrow as the mode's own; the identified poles do not
    show them.
    """
    omega = data.control.frequency.omega_rad_s
    omega = omega[omega > 0]
    assert data.plant is not None
    assert data.synthesis is not None
    if data.plant.own_grid is not None:
        return omega
    controller = data.synthesis.controller
    poles = [closed_loop_poles(controller, data.plant)]
    if controller.order:
        poles.append(np.linalg.eigvals(controller.A).astype(np.complex128))
    modes = [
        Mode(mode.omega_rad_s, max(abs(mode.zeta), 1e-4))
        for mode in modes_of(np.concatenate(poles), data.plant.dt_s)
        if omega[0] < mode.omega_rad_s < omega[-1]
    ]
    worst = [] if data.certificate is None else [v.worst_margin_omega_rad_s for v in data.certificate.plants]
    dense = frequency_grid(
        float(omega[-1]), modes, omega_min_rad_s=float(omega[0]), n_log=2, n_mode=81 * len(modes)
    )
    every = np.unique(np.concatenate([omega, dense, [w for w in worst if 0 < w <= omega[-1]]]))
    return np.asarray(every[(every > 0) & (every <= omega[-1])])


def _uncertain_loop(data: RunData) -> UncertainLoop:
    assert data.plant is not None
    assert data.synthesis is not None
    frequency = data.control.frequency
    if isinstance(data.plant.uncertainty, ResponsePosterior):
        frequency = data.plant.uncertainty.at(_loop_grid(data), data.plant.level)
    return uncertain_loop(frequency, data.synthesis.controller.response(frequency.omega_rad_s))


def _nyquist(data: RunData) -> Figure:
    margin = data.config.specification.modulus_margin
    return draw_nyquist(
        _uncertain_loop(data), level=data.level, modulus_margin=margin, name=data.control.label
    )


def _overview(data: RunData) -> Figure:
    """Three panels of what matters; the step without the disturbance that follows it."""
    assert data.closed_loop is not None
    loop = data.closed_loop
    time, reference = loop.time_s, loop.reference
    predicted, achieved = loop.predicted_runs.output, loop.achieved_runs.output
    half = slice(0, time.size // 2)
    channel = data.config.control_channel
    step = StepView(
        time_s=time[half],
        reference=reference[half],
        predicted=predicted[0, half],
        achieved=achieved[:, half],
        machine=MACHINE_WORDS[data.closed_loop.machine],
        output=(channel.output, data.unit(channel.output)),
    )
    return draw_overview(
        data.control.frequency,
        data.control.nominal,
        _uncertain_loop(data),
        step,
        gain_unit=ratio_unit(data.unit(channel.output), data.unit(channel.input)),
        modulus_margin=data.config.specification.modulus_margin,
    )


def _sensitivities(data: RunData) -> Figure:
    assert data.plant is not None
    assert data.synthesis is not None
    config, performance = data.config, data.performance
    curves = sensitivity_curves(
        data.plant,
        data.synthesis.controller,
        config.specification,
        _loop_grid(data),
        input_unit=data.unit(config.control_channel.input),
        output_unit=data.unit(config.control_channel.output),
        performance_unit=""
        if performance is None
        else data.unit(performance.result.identification.model.output_name),
    )
    modes = [m for m in data.control.identified.modes if m.damping < 0.3]
    marks = [(mode.omega_rad_s, f"mode {number}") for number, mode in enumerate(modes[:4], 1)]
    return draw_sensitivities(curves, level=data.plant.level, marks=marks)


def _measured_sensitivity(data: RunData) -> Figure:
    assert data.closed_loop is not None
    assert data.plant is not None
    assert data.synthesis is not None
    found = data.closed_loop.sensitivity
    assert found is not None
    low, high = found.band_rad_s
    omega = np.geomspace(0.9 * low, min(1.1 * high, data.plant.nyquist_rad_s), 900)
    curve = sensitivity_curves(data.plant, data.synthesis.controller, data.config.specification, omega)[0]
    peaks = [MeasuredPeak(row.name, row.omega_rad_s, row.magnitude, row.std) for row in found.measured]
    predicted = PredictedSensitivity(omega, curve.nominal, curve.worst)
    return draw_measured_sensitivity(predicted, peaks, level=data.level)


def _conditions(data: RunData) -> Figure:
    assert data.closed_loop is not None
    document = data.closed_loop
    rows = [
        ConditionTraces(row.name, row.words, row.reference, row.predicted, row.achieved)
        for row in document.conditions
    ]
    output = data.config.control_channel.output
    machine = MACHINE_WORDS[document.machine]
    return draw_conditions(
        document.time_s[: rows[0].reference.size], rows, (output, data.unit(output)), machine=machine
    )


def _closed_loop(data: RunData) -> Figure:
    assert data.closed_loop is not None
    config, document = data.config, data.closed_loop
    performance = data.performance

    def signal(name: str) -> tuple[str, str]:
        return name, data.unit(name)

    scene = LoopScene(
        time_s=document.time_s,
        reference=document.reference,
        model=document.model_answer,
        disturbance=document.disturbance,
        output=signal(config.control_channel.output),
        command=signal(config.control_channel.input),
        performance=None
        if performance is None
        else signal(performance.result.identification.model.output_name),
        command_limit=document.input_limit,
    )
    predicted, runs = _traces(document.predicted_runs), _traces(document.achieved_runs)
    if document.machine == "simulated":
        return draw_closed_loop(scene, predicted, runs, machine=MACHINE_WORDS["simulated"])
    return draw_closed_loop(scene, predicted, None, spread=runs)


def _traces(runs: LoopRuns) -> LoopTraces:
    return LoopTraces(output=runs.output, command=runs.command, performance=runs.performance)
