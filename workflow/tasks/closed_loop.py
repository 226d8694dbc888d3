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

# Samples of a run at least: fewer show no shape of a step.
_SHORTEST = 200
# Samples of a run on the simulated arm at most: each costs a step of the nonlinear arm.
_LONGEST = 6000
# Samples of a run on a plant that was drawn at most. It is linear and ten times as fast to simulate.
_LONGEST_DRAWN = 60_000


@dataclass(frozen=True, eq=False)
class Trial:
    """Signals that a closed-loop run is driven with: a reference step, then a constant input disturbance.

    Attributes
    ----------
    time_s, reference : (T,) arrays
        The step begins after the lead-in, in units of the output.
    filtered_reference : (T,) array
        What the loop gets: the reference behind the reference filter, or the reference where there is none.
    disturbance : (T,) array
        Added to the plant's input, in its units; zero before sample `half`.
    step : float
        Size of the reference step.
    half : int
        First sample of the disturbance.
    tracking : bool
        Whether the specification asks the output to follow the reference.
    resolution : float
        One count of the sensor, in units of the output; 0 where it is not known.
    """

    time_s: RealArray
    reference: RealArray
    filtered_reference: RealArray
    disturbance: RealArray
    step: float
    half: int
    tracking: bool
    resolution: float = 0.0


def run_closed_loop(stage: StageInput) -> ClosedLoopResult:
    """The loop on the identified model (prediction) and on the machine, both on the same trial.

    Parameters
    ----------
    stage : StageInput
        With the results of every stage before it.

    Returns
    -------
    ClosedLoopResult
        With `check`, or with `skipped`, one line, where there is no controller or the nominal loop is
        unstable. On the simulated arm each run has its own noise and draw of the rig; where records are logs
        the machine is plants drawn from the posterior.
    """
    config = stage.config
    results = stage.results
    controller = results.design.controller
    options = config.closed_loop
    if controller is None:
        return ClosedLoopResult(skipped=results.certify.reason)
    law = results.reference_filter.law(controller)
    with naming("closed loop"):
        # A nominal loop that is unstable has no settling time to choose the length of the trial by.
        radii = [np.max(np.abs(closed_loop_poles(controller, plant))) for plant in stage.plants]
        radius = max(map(float, radii))
        if not radius < 1:
            return ClosedLoopResult(skipped="the nominal closed loop is unstable")
        reference_filter = results.reference_filter.filter
        trial = make_trial(stage, controller.dt_s, radius, reference_filter)

        # Prediction: on the posterior mean, of the performance channel too where there is one.
        channels = results.uncertainty.seen_by_controller(config)
        performance = config.performance_index
        posterior = channels[config.control_index].posterior
        tip = None
        mean_tip = None
        if performance is not None:
            tip = channels[performance].posterior
            mean_tip = (tip, tip.mean[None])
        predicted = run_on_draws(controller, (posterior, posterior.mean[None]), mean_tip, trial)

        # Machine: the simulated arm, or, where records are logs, plants drawn from the posterior.
        stage.progress.update("closed_loop", 0.1, "machine")
        sensitivity = None
        conditions = []
        friction = None
        if config.machine == "simulated":
            achieved = run_on_arm(stage, law, trial)
            if options.sensitivity:
                stage.progress.update("closed_loop", 0.8, "sensitivity")
                sensitivity = sensitivity_on_arm(stage, controller, trial.half)
            if options.conditions:
                stage.progress.update("closed_loop", 0.9, "conditions")
                source = _simulated(stage)
                bench = ConditionBench(
                    controller=law,
                    reference_filter=reference_filter,
                    posterior=posterior,
                    source=source,
                    options=options,
                    rig=rig_of(source),
                    reference=trial.reference[: trial.half],
                    measured=OUTPUT_NAMES.index(config.control_channel.output),
                    rng=stage.rng("closed_loop", "conditions"),
                )
                conditions = [
                    bench.slew(),
                    bench.push(),
                    *bench.payloads(),
                    bench.late(),
                    *bench.frictions(),
                    bench.coarse(),
                    *bench.overdriven(),
                ]
        else:
            # Control and performance channel are drawn independently, the parts of the set in turn.
            control_rng = stage.rng("closed_loop", "control")
            rng = stage.rng("closed_loop", "performance")
            steps = converter_steps(options)
            members = channels[config.control_index].members
            counts = np.bincount(np.arange(options.draws) % len(members))
            runs = []
            for member, draws in zip(members, counts.tolist(), strict=False):
                control_draws = (member.posterior, member.posterior.sample(control_rng, draws))
                tip_draws = None if tip is None else (tip, tip.sample(rng, draws))
                runs.append(run_on_draws(controller, control_draws, tip_draws, trial, **steps))
            achieved = LoopRuns.together(runs)

        # Dry friction is no part of the linear runs above: what it does is checked on the step alone.
        if options.sensitivity and results.identify.friction is not None:
            stage.progress.update("closed_loop", 0.95, "friction")
            first = slice(0, trial.half)
            friction = check_friction(
                stage, controller, trial.reference[first], trial.filtered_reference[first], sensitivity
            )

    # What the output would be if it followed the reference model exactly.
    ideal_output = None
    if reference_filter is not None and config.reference_filter is not None:
        reference_model = config.reference_filter.reference_model
        ideal_output = model_answer(reference_model, trial.reference, controller.dt_s)
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
            model_answer=ideal_output,
            predicted_runs=predicted,
            achieved_runs=achieved,
            sensitivity=sensitivity,
            conditions=tuple(conditions),
            friction=friction,
        )
    )


def _simulated(stage: StageInput) -> SimulatedSource:
    # Any other source was refused with the configuration.
    assert isinstance(stage.config.source, SimulatedSource)
    return stage.config.source


def make_trial(
    stage: StageInput, dt_s: float, pole_radius: float, reference_filter: ReferenceFilter | None = None
) -> Trial:
    """The trial of a run: half for the step, half for the disturbance.

    Parameters
    ----------
    stage : StageInput
    dt_s : float
        Period of the controller [s].
    pole_radius : float
        Modulus of the slowest closed-loop pole, below 1; each half is long enough for it to die out.
    reference_filter : ReferenceFilter, optional
        Of the loop.

    Returns
    -------
    Trial
        Sizes that are not stated are half the rms of the output and a tenth of that of the input in the
        records of the fit.
    """
    options = stage.config.closed_loop
    config = stage.config
    used = stage.results.records.fitted(config.control_channel)
    # A plant that was drawn is linear, and cheap: at a high sampling rate a slow pole takes many samples.
    longest = _LONGEST if config.machine == "simulated" else _LONGEST_DRAWN
    samples = settling_samples(pole_radius, _SHORTEST, longest)
    if options.duration_s is not None:
        samples = min(max(round(options.duration_s / dt_s), _SHORTEST), longest)
    step = options.reference_step or 0.5 * rms_of([record.output for record in used])
    disturbance = options.disturbance
    k = np.arange(samples)
    half = samples // 2
    if disturbance is None:
        # Small beside the commands of the records, so that the loop has room to answer it.
        disturbance = 0.1 * rms_of([record.input for record in used])
    reference = np.where(k >= round(LEAD_IN * samples), step, 0.0)
    filtered = reference if reference_filter is None else reference_filter.filtered(reference)
    # A loop that is asked for neither a bandwidth nor a sensitivity only damps: no reference to follow.
    wanted = config.specification
    tracking = wanted.bandwidth_rad_s is not None or wanted.sensitivity_weight is not None
    return Trial(
        time_s=np.asarray(k * dt_s, dtype=np.float64),
        reference=reference,
        filtered_reference=filtered,
        disturbance=np.where(k >= half, disturbance, 0.0),
        step=step,
        half=half,
        tracking=tracking,
        resolution=options.measurement_step,
    )


def run_on_arm(stage: StageInput, controller: Controller, trial: Trial) -> LoopRuns:
    """Closed-loop runs (R, T) on the nonlinear arm of the source with its extra effects.

    Every run has its own noise; the first is on the nominal rig, the others on draws within its tolerances.
    """
    config = stage.config
    options = stage.config.closed_loop
    performance = config.performance_index
    tip = None if performance is None else OUTPUT_NAMES.index(config.channels[performance].output)
    nominal = rig_of(_simulated(stage))
    runs = []
    for draw in range(options.draws):
        # The first tenth was the model, the last two tenths are sensitivity and conditions.
        stage.progress.update("closed_loop", 0.1 + 0.7 * draw / options.draws, "machine")
        # The first run is the nominal rig, the others as its tolerances allow (all alike where it has none).
        rig = nominal if draw == 0 else nominal.drawn(stage.rng("closed_loop", "rig", str(draw)))
        arm = loop_of_arm(config, stage.rng("closed_loop", "noise", str(draw)), options.effects, rig)
        runs.append(
            simulate(
                controller, reference=trial.filtered_reference, input_disturbance=trial.disturbance, **arm
            )
        )
    tip_outputs = None if tip is None else [run.output[:, tip] for run in runs]
    return _loop_runs(runs, tip_outputs)


def run_on_draws(
    controller: Controller,
    control: tuple[ResponsePosterior, RealArray],
    performance: tuple[ResponsePosterior, RealArray] | None,
    trial: Trial,
    **steps: float,
) -> LoopRuns:
    """One closed loop for each draw of the plant.

    Parameters
    ----------
    controller : Controller
    control : tuple of ResponsePosterior and (R, P) array
        The channel that is fed back, and R draws of its coefficients.
    performance : tuple of ResponsePosterior and (R, P') array, or None
        A second channel and its draws. Its output follows from the command that acted, in open loop.
    trial : Trial
    **steps : float
        Steps of the converters: `measurement_step`, `command_step`.

    Returns
    -------
    LoopRuns
        R runs of T samples.
    """
    posterior, draws = control
    how: dict[str, Any] = {"input_disturbance": trial.disturbance, **steps}
    runs = [
        simulate_plant(controller, realise(posterior, coefficients), trial.filtered_reference, **how)
        for coefficients in draws
    ]
    if performance is None:
        return _loop_runs(runs, None)
    tip, tip_draws = performance
    tip_outputs = [
        tip.simulate(run.command + trial.disturbance, coefficients)
        for run, coefficients in zip(runs, tip_draws, strict=True)
    ]
    return _loop_runs(runs, tip_outputs)


def _loop_runs(runs: Sequence[ClosedLoopTrajectory], performance: Sequence[RealArray] | None) -> LoopRuns:
    return LoopRuns(
        np.stack([run.measured for run in runs]),
        np.stack([run.command for run in runs]),
        None if performance is None else np.stack(performance),
        np.stack([run.limited for run in runs]),
    )


def describe(runs: LoopRuns, trial: Trial) -> tuple[LoopMetrics, ...]:
    """Step and disturbance metrics of every run.

    A run is `settled` where the last tenth of both halves moves by no more than a tenth of the step (two
    counts of the sensor at least) and, where tracking is asked for, has arrived within it.
    """
    rows = []
    for output, command, limited in zip(runs.output, runs.command, runs.limited, strict=True):
        first = slice(0, trial.half)
        dt_s = float(trial.time_s[1] - trial.time_s[0])
        step = ClosedLoopTrajectory(
            trial.time_s[first],
            trial.reference[first],
            output[first, None],
            command[first],
            limited[first],
            dt_s,
        )
        error = trial.reference - output
        step_error = error[: trial.half]
        disturbance_error = error[trial.half :]
        step_end = _tail(step_error)
        disturbance_end = _tail(disturbance_error)
        # Resting means moving by no more than the sensor's steps, one up and one down, make it seem to move.
        small = SETTLED * abs(trial.step)
        largest_swing = max(small, 2 * trial.resolution)
        steady = np.ptp(step_end) <= largest_swing and np.ptp(disturbance_end) <= largest_swing
        arrived = abs(float(np.mean(step_end))) <= max(small, trial.resolution)
        rows.append(
            LoopMetrics(
                **vars(step_metrics(step)),
                disturbance_peak=float(np.max(np.abs(disturbance_error))),
                disturbance_left=float(np.mean(disturbance_end)),
                settled=bool(steady and (arrived or not trial.tracking)),
            )
        )
    return tuple(rows)


def _tail(signal: RealArray) -> RealArray:
    """The last tenth."""
    return signal[-max(1, signal.size // 10) :]
