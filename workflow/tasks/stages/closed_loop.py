"""Closed loop: the controller on the identified model (prediction) and on the machine (what was achieved)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from control_design.analysis.closed_loop import ClosedLoopTrajectory, SampledMachine, simulate, step_metrics
from control_design.analysis.stability import closed_loop_poles
from control_design.controllers.controller import Controller
from control_design.convex.reference_filter import ReferenceFilter
from ident.uncertainty import ResponsePosterior
from workflow.config.run_config import ClosedLoopOptions, RunConfig, SimulatedSource
from workflow.engine.errors import naming
from workflow.tasks.reference_filter import model_answer
from workflow.tasks.results import ClosedLoopResult, LoopCheck, LoopMetrics, LoopRuns
from workflow.tasks.sampled_plant import FINITE, ClippedMachine, StateSpaceMachine, realise
from workflow.tasks.simulated_rig import OUTPUT_NAMES, EncodedArm, rig_of
from workflow.tasks.stages.arm_checks import check_on_arm
from workflow.tasks.stages.base import StageInput

Real = npt.NDArray[np.float64]

_LEAD_IN = 0.05  # share of the record before the step, so that the picture shows rest
# A run counts as settled when, at the end of either half, it moves by less than this share of the step and,
# where tracking is asked for, has arrived within it.
_SETTLED = 0.1
_LONGEST_SAMPLES = 6000


def settings(config: RunConfig) -> Mapping[str, Any]:
    """The machine and what is asked of it."""
    source = config.source
    return {
        "closed_loop": config.closed_loop.model_dump(mode="json"),
        "machine": config.machine,
        "source": source.model_dump(mode="json", exclude={"records"}) if source.kind == "simulated" else None,
    }


@dataclass(frozen=True, eq=False)
class Trial:
    """What is asked of the loop: reference step after the lead-in, input disturbance from half-way on; (T,)
    each. reference_filtered: the reference behind the filter, which the loop is then given; None without."""

    time_s: Real
    reference: Real
    disturbance: Real
    step: float
    half: int
    tracking: bool
    reference_filtered: Real | None = None


def run_closed_loop(stage: StageInput) -> ClosedLoopResult:
    """Prediction and machine on the same trial; Monte Carlo over noise and rig, or over drawn plants."""
    config, results = stage.config, stage.results
    synthesis = results.design.synthesis
    if synthesis is None or results.certify.certificate is None:
        return ClosedLoopResult(skipped=results.certify.reason)
    controller = synthesis.controller
    with naming("closed loop"):
        plant = results.uncertainty.plant(config)
        radius = float(np.max(np.abs(closed_loop_poles(controller, plant))))
        if not radius < 1:
            return ClosedLoopResult(skipped="the nominal closed loop is unstable")
        reference_filter = results.reference_filter.filter
        trial = make_trial(stage, controller.dt_s, radius, reference_filter)
        channels, performance = results.uncertainty.channels, config.performance_index
        posterior = channels[config.control_index].posterior
        tip = None if performance is None else channels[performance].posterior
        predicted = run_on_draws(controller, posterior, tip, [posterior.mean], _means(tip), trial, None)
        stage.progress.update("closed_loop", 0.1, "machine")
        achieved = (
            run_on_arm(stage, controller, trial)
            if config.machine == "simulated"
            else run_on_posterior(stage, controller, posterior, tip, trial)
        )
        sensitivity, conditions = check_on_arm(
            stage, controller, reference_filter, plant, posterior, trial.reference[: trial.half]
        )
    model = None
    if reference_filter is not None and config.reference_filter is not None:
        model = model_answer(config.reference_filter.reference_model, trial.reference, controller.dt_s)
    return ClosedLoopResult(
        check=LoopCheck(
            machine=config.machine,
            tracking=trial.tracking,
            reference_step=trial.step,
            disturbance_step=float(trial.disturbance[-1]),
            quantisation=config.closed_loop.quantisation,
            measurement_step=config.closed_loop.measurement_step,
            input_limit=controller.input_limit,
            filtered=reference_filter is not None,
            predicted=describe(predicted, trial)[0],
            achieved=describe(achieved, trial),
            time_s=trial.time_s,
            reference=trial.reference,
            disturbance=trial.disturbance,
            model_answer=model,
            predicted_runs=predicted,
            achieved_runs=achieved,
            sensitivity=sensitivity,
            conditions=conditions,
        )
    )


def make_trial(
    stage: StageInput, dt_s: float, pole_radius: float, reference_filter: ReferenceFilter | None = None
) -> Trial:
    """Half the record for the step, half for the disturbance, each long enough for the slowest closed-loop
    pole."""
    options, config = stage.config.closed_loop, stage.config
    used = stage.results.records.fitted(config.control_channel)
    if options.duration_s is not None:
        samples = round(options.duration_s / dt_s)
    else:
        # e^-7 is a thousandth: the slowest pole has died out by the end of either half.
        samples = round(2 * 7 / -np.log(min(max(pole_radius, 0.5), 1 - 1e-9)))
    samples = min(max(samples, 200), _LONGEST_SAMPLES)
    step = options.reference_step or 0.5 * float(np.sqrt(np.mean([np.var(r.output) for r in used])))
    disturbance = options.disturbance
    if disturbance is None:
        disturbance = 0.1 * float(np.sqrt(np.mean([np.var(r.input) for r in used])))
    k = np.arange(samples)
    half = samples // 2
    reference = np.where(k >= round(_LEAD_IN * samples), step, 0.0)
    return Trial(
        time_s=np.asarray(k * dt_s, dtype=np.float64),
        reference=reference,
        disturbance=np.where(k >= half, disturbance, 0.0),
        step=step,
        half=half,
        tracking=config.specification.bandwidth_rad_s is not None
        or config.specification.sensitivity_weight is not None,
        reference_filtered=None if reference_filter is None else reference_filter.filtered(reference),
    )


def run_on_arm(stage: StageInput, controller: Controller, trial: Trial) -> LoopRuns:
    """The nonlinear arm of the source with its extra effects; every run has its own noise and rig draw."""
    config = stage.config
    source = config.source
    assert isinstance(source, SimulatedSource)
    measured = OUTPUT_NAMES.index(config.control_channel.output)
    shown = config.performance_index
    tip = None if shown is None else OUTPUT_NAMES.index(config.channels[shown].output)
    nominal = rig_of(source)
    runs = []
    for draw in range(config.closed_loop.draws):
        stage.progress.update("closed_loop", 0.1 + 0.7 * draw / config.closed_loop.draws, "machine")
        # The first run is the nominal rig, the others as its tolerances allow (all alike where it has none).
        rig = nominal if draw == 0 else nominal.drawn(stage.rng("closed_loop", "rig", str(draw)))
        arm = EncodedArm(
            source, config.closed_loop.effects, stage.rng("closed_loop", "noise", str(draw)), rig=rig
        )
        runs.append(_loop(controller, ClippedMachine(arm, FINITE), trial, measured, config.closed_loop))
    outputs = np.stack([run.output for run in runs])
    return LoopRuns(
        outputs[:, :, measured],
        np.stack([run.command for run in runs]),
        None if tip is None else outputs[:, :, tip],
        np.stack([run.limited for run in runs]),
    )


def run_on_posterior(
    stage: StageInput,
    controller: Controller,
    posterior: ResponsePosterior,
    tip: ResponsePosterior | None,
    trial: Trial,
) -> LoopRuns:
    """Plants drawn from the identified uncertainty; control and performance channel are drawn
    independently."""
    draws = stage.config.closed_loop.draws
    control = posterior.sample(stage.rng("closed_loop", "control"), draws)
    shown = None if tip is None else tip.sample(stage.rng("closed_loop", "performance"), draws)
    return run_on_draws(controller, posterior, tip, control, shown, trial, stage.config.closed_loop)


def run_on_draws(
    controller: Controller,
    posterior: ResponsePosterior,
    tip: ResponsePosterior | None,
    control_draws: Sequence[Real] | Real,
    tip_draws: Sequence[Real] | Real | None,
    trial: Trial,
    steps: ClosedLoopOptions | None,
) -> LoopRuns:
    """One closed loop per draw of coefficients; the performance output follows from the command that
    acted."""
    runs, shown = [], []
    for number, coefficients in enumerate(control_draws):
        a, b, c, d = realise(posterior, np.asarray(coefficients))
        holds = d != 0.0
        if holds and controller.computational_delay_samples < 1:
            raise ValueError(
                "a plant with a direct term needs at least one sample of computational delay in the loop"
            )
        machine = StateSpaceMachine(a, b, c, d, posterior.dt_s, holds_input=holds)
        law = replace(
            controller, computational_delay_samples=controller.computational_delay_samples - int(holds)
        )
        run = _loop(law, machine, trial, 0, steps, early=holds)
        if holds:
            # The machine acted on each command one sample after it was handed over.
            run = replace(run, command=np.concatenate([[0.0], run.command[:-1]]))
        runs.append(run)
        if tip is not None and tip_draws is not None:
            shown.append(tip.simulate(run.command + trial.disturbance, np.asarray(tip_draws[number])))
    return LoopRuns(
        np.stack([run.measured for run in runs]),
        np.stack([run.command for run in runs]),
        np.stack(shown) if shown else None,
        np.stack([run.limited for run in runs]),
    )


def _loop(
    controller: Controller,
    machine: SampledMachine,
    trial: Trial,
    measured: int,
    steps: ClosedLoopOptions | None,
    *,
    early: bool = False,
) -> ClosedLoopTrajectory:
    disturbance = np.append(trial.disturbance[1:], trial.disturbance[-1]) if early else trial.disturbance
    return simulate(
        controller,
        machine,
        trial.reference if trial.reference_filtered is None else trial.reference_filtered,
        measured_index=measured,
        input_disturbance=disturbance,
        measurement_step=0.0 if steps is None else steps.measurement_step,
        command_step=0.0 if steps is None else steps.quantisation,
    )


def describe(runs: LoopRuns, trial: Trial) -> tuple[LoopMetrics, ...]:
    """Step and disturbance metrics of every run; `settled` says whether its motion dies out."""
    rows = []
    for output, command, limited in _each(runs):
        first = slice(0, trial.half)
        step = ClosedLoopTrajectory(
            trial.time_s[first],
            trial.reference[first],
            output[first, None],
            command[first],
            limited[first],
            float(trial.time_s[1] - trial.time_s[0]),
        )
        error = trial.reference - output
        ends = [_tail(error[: trial.half]), _tail(error[trial.half :])]
        steady = all(np.ptp(end) <= _SETTLED * abs(trial.step) for end in ends)
        arrived = abs(float(np.mean(ends[0]))) <= _SETTLED * abs(trial.step)
        rows.append(
            LoopMetrics(
                **vars(step_metrics(step)),
                disturbance_peak=float(np.max(np.abs(error[trial.half :]))),
                disturbance_left=float(np.mean(ends[1])),
                settled=bool(steady and (arrived or not trial.tracking)),
            )
        )
    return tuple(rows)


def _tail(signal: Real) -> Real:
    """The last tenth."""
    return signal[-max(1, signal.size // 10) :]


def _each(runs: LoopRuns) -> Iterator[tuple[Real, Real, npt.NDArray[np.bool_]]]:
    return zip(runs.output, runs.command, runs.limited, strict=True)


def _means(posterior: ResponsePosterior | None) -> list[Real] | None:
    return None if posterior is None else [posterior.mean]
