"""Closed loop: the controller on the identified model (prediction) and on the machine (what was achieved)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from control_design.analysis.closed_loop import ClosedLoopTrajectory, simulate, step_metrics
from control_design.analysis.stability import closed_loop_poles
from control_design.controllers.controller import Controller
from control_design.convex.reference_filter import ReferenceFilter
from ident.data.arrays import RealArray
from ident.uncertainty import ResponsePosterior
from workflow.config.run_config import SimulatedSource
from workflow.engine.errors import naming
from workflow.tasks.design import model_answer
from workflow.tasks.friction_loop import check_friction
from workflow.tasks.loop_conditions import ConditionBench
from workflow.tasks.loop_sensitivity import LEAD_IN, SETTLED, rms_of, sensitivity_on_arm, settling_samples
from workflow.tasks.results import ClosedLoopResult, LoopCheck, LoopMetrics, LoopRuns
from workflow.tasks.sampled_plant import realise, simulate_plant
from workflow.tasks.simulated_rig import OUTPUT_NAMES, converter_steps, loop_of_arm, rig_of
from workflow.tasks.stage import StageInput

# Samples of a run on the simulated arm, and at most of one on a plant that was drawn.
_SHORTEST, _LONGEST, _LONGEST_DRAWN = 200, 6000, 60_000


@dataclass(frozen=True, eq=False)
class Trial:
    """What is asked of the loop: reference step after the lead-in, input disturbance from half-way on; (T,)
    each. given: what the loop is given for the reference, which a filter makes of it. resolution: one count
    of the sensor."""

    time_s: RealArray
    reference: RealArray
    given: RealArray
    disturbance: RealArray
    step: float
    half: int
    tracking: bool
    resolution: float = 0.0


def run_closed_loop(stage: StageInput) -> ClosedLoopResult:
    """Prediction and machine on the same trial; Monte Carlo over noise and rig, or over drawn plants."""
    config, results = stage.config, stage.results
    controller, options = results.design.controller, config.closed_loop
    if controller is None:
        return ClosedLoopResult(skipped=results.certify.reason)
    law = results.reference_filter.law(controller)
    with naming("closed loop"):
        radius = max(float(np.max(np.abs(closed_loop_poles(controller, plant)))) for plant in stage.plants)
        if not radius < 1:
            return ClosedLoopResult(skipped="the nominal closed loop is unstable")
        reference_filter = results.reference_filter.filter
        trial = make_trial(stage, controller.dt_s, radius, reference_filter)
        channels, performance = results.uncertainty.seen_by_controller(config), config.performance_index
        posterior = channels[config.control_index].posterior
        tip = None if performance is None else channels[performance].posterior
        mean = (posterior, posterior.mean[None]), None if tip is None else (tip, tip.mean[None])
        predicted = run_on_draws(controller, *mean, trial)
        stage.progress.update("closed_loop", 0.1, "machine")
        sensitivity, conditions, friction = None, [], None
        if config.machine == "simulated":
            achieved = run_on_arm(stage, law, trial)
            if options.sensitivity:
                stage.progress.update("closed_loop", 0.8, "sensitivity")
                sensitivity = sensitivity_on_arm(stage, controller, trial.half)
            if options.conditions:
                stage.progress.update("closed_loop", 0.9, "conditions")
                bench = ConditionBench(
                    controller=law,
                    reference_filter=reference_filter,
                    posterior=posterior,
                    source=_simulated(stage),
                    options=options,
                    rig=rig_of(_simulated(stage)),
                    reference=trial.reference[: trial.half],
                    measured=OUTPUT_NAMES.index(config.control_channel.output),
                    rng=stage.rng("closed_loop", "conditions"),
                )
                some = bench.slew(), bench.push(), *bench.payloads(), bench.late(), *bench.frictions()
                conditions = [*some, bench.coarse(), *bench.overdriven()]
        else:
            # Control and performance channel are drawn independently, the parts of the set in turn.
            control_rng = stage.rng("closed_loop", "control")
            rng = stage.rng("closed_loop", "performance")
            steps = converter_steps(options)
            members = channels[config.control_index].members
            counts = np.bincount(np.arange(options.draws) % len(members))
            runs = []
            for member, draws in zip(members, counts.tolist(), strict=False):
                own = member.posterior, member.posterior.sample(control_rng, draws)
                shown = None if tip is None else (tip, tip.sample(rng, draws))
                runs.append(run_on_draws(controller, own, shown, trial, **steps))
            achieved = LoopRuns.together(runs)
        if options.sensitivity and results.identify.friction is not None:
            stage.progress.update("closed_loop", 0.95, "friction")
            first = slice(0, trial.half)
            friction = check_friction(
                stage, controller, trial.reference[first], trial.given[first], sensitivity
            )
    followed = None if reference_filter is None else config.reference_filter
    dt_s = controller.dt_s
    model = None if followed is None else model_answer(followed.reference_model, trial.reference, dt_s)
    return ClosedLoopResult(
        check=LoopCheck(
            machine=config.machine,
            tracking=trial.tracking,
            reference_step=trial.step,
            disturbance_step=float(trial.disturbance[-1]),
            quantisation=options.quantisation,
            measurement_step=options.measurement_step,
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
            conditions=tuple(conditions),
            friction=friction,
        )
    )


def _simulated(stage: StageInput) -> SimulatedSource:
    assert isinstance(stage.config.source, SimulatedSource)  # or the configuration had been refused
    return stage.config.source


def make_trial(
    stage: StageInput, dt_s: float, pole_radius: float, reference_filter: ReferenceFilter | None = None
) -> Trial:
    """Half for the step, half for the disturbance, each long enough for the slowest closed-loop pole."""
    options, config = stage.config.closed_loop, stage.config
    used = stage.results.records.fitted(config.control_channel)
    # A plant that was drawn is linear, and cheap: at a high sampling rate a slow pole takes many samples.
    longest = _LONGEST if config.machine == "simulated" else _LONGEST_DRAWN
    samples = settling_samples(pole_radius, _SHORTEST, longest)
    if options.duration_s is not None:
        samples = min(max(round(options.duration_s / dt_s), _SHORTEST), longest)
    step = options.reference_step or 0.5 * rms_of([record.output for record in used])
    disturbance, k, half = options.disturbance, np.arange(samples), samples // 2
    if disturbance is None:
        disturbance = 0.1 * rms_of([record.input for record in used])
    reference = np.where(k >= round(LEAD_IN * samples), step, 0.0)
    return Trial(
        time_s=np.asarray(k * dt_s, dtype=np.float64),
        reference=reference,
        given=reference if reference_filter is None else reference_filter.filtered(reference),
        disturbance=np.where(k >= half, disturbance, 0.0),
        step=step,
        half=half,
        tracking=config.specification.bandwidth_rad_s is not None
        or config.specification.sensitivity_weight is not None,
        resolution=options.measurement_step,
    )


def run_on_arm(stage: StageInput, controller: Controller, trial: Trial) -> LoopRuns:
    """The nonlinear arm of the source with its extra effects; every run has its own noise and rig draw."""
    config, options = stage.config, stage.config.closed_loop
    shown = config.performance_index
    tip = None if shown is None else OUTPUT_NAMES.index(config.channels[shown].output)
    nominal = rig_of(_simulated(stage))
    runs = []
    for draw in range(options.draws):
        stage.progress.update("closed_loop", 0.1 + 0.7 * draw / options.draws, "machine")
        # The first run is the nominal rig, the others as its tolerances allow (all alike where it has none).
        rig = nominal if draw == 0 else nominal.drawn(stage.rng("closed_loop", "rig", str(draw)))
        arm = loop_of_arm(config, stage.rng("closed_loop", "noise", str(draw)), options.effects, rig)
        runs.append(simulate(controller, reference=trial.given, input_disturbance=trial.disturbance, **arm))
    return _loop_runs(runs, None if tip is None else [run.output[:, tip] for run in runs])


def run_on_draws(
    controller: Controller,
    drawn: tuple[ResponsePosterior, RealArray],
    shown: tuple[ResponsePosterior, RealArray] | None,
    trial: Trial,
    **steps: float,
) -> LoopRuns:
    """One closed loop per draw of coefficients (R, P), of the performance channel (R, P') too where there is
    one: its output follows from the command that acted. steps: of the converters."""
    posterior, draws = drawn
    how: dict[str, Any] = {"input_disturbance": trial.disturbance, **steps}
    runs = [simulate_plant(controller, realise(posterior, one), trial.given, **how) for one in draws]
    if shown is None:
        return _loop_runs(runs, None)
    tip, tip_draws = shown
    pairs = zip(runs, tip_draws, strict=True)
    return _loop_runs(runs, [tip.simulate(run.command + trial.disturbance, own) for run, own in pairs])


def _loop_runs(runs: Sequence[ClosedLoopTrajectory], performance: Sequence[RealArray] | None) -> LoopRuns:
    return LoopRuns(
        np.stack([run.measured for run in runs]),
        np.stack([run.command for run in runs]),
        None if performance is None else np.stack(performance),
        np.stack([run.limited for run in runs]),
    )


def describe(runs: LoopRuns, trial: Trial) -> tuple[LoopMetrics, ...]:
    """Step and disturbance metrics of every run; `settled` says whether its motion dies out."""
    rows = []
    for output, command, limited in zip(runs.output, runs.command, runs.limited, strict=True):
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
        steady = all(np.ptp(end) <= max(SETTLED * abs(trial.step), 2 * trial.resolution) for end in ends)
        arrived = abs(float(np.mean(ends[0]))) <= max(SETTLED * abs(trial.step), trial.resolution)
        rows.append(
            LoopMetrics(
                **vars(step_metrics(step)),
                disturbance_peak=float(np.max(np.abs(error[trial.half :]))),
                disturbance_left=float(np.mean(ends[1])),
                settled=bool(steady and (arrived or not trial.tracking)),
            )
        )
    return tuple(rows)


def _tail(signal: RealArray) -> RealArray:
    """The last tenth."""
    return signal[-max(1, signal.size // 10) :]
