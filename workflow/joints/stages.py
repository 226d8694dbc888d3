"""The stages of a run for several joints: models with their balls, one controller, its certificate, the loop
on the nonlinear machine at every operating point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from control_design.analysis.closed_loop import LinearMachine, simulate_joints
from control_design.analysis.multivariable_certificate import certify_multivariable
from control_design.controllers.controller import Controller
from control_design.plants.multivariable import MultivariablePlant
from control_design.specification import SpecificationError
from control_design.synthesis.multivariable import synthesise_multivariable
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.checks.validation import FreshFit, fit_in_windows, fit_on_fresh_data
from ident.closed_loop import two_stage_several
from ident.data.finding import Finding, FindingKind, finding
from ident.data.frequency_uncertainty import FREQUENCIES
from ident.data.record import Record
from ident.data.signal_filter import increments
from ident.several_outputs import identify_mimo
from ident.uncertainty.matrix_response import matrix_posterior
from workflow.config.run_config import Role
from workflow.engine.errors import naming
from workflow.joints.config import JointsConfig, TwoJointSource
from workflow.joints.machine import machine_at, simulated_points
from workflow.joints.results import (
    JointsCertificate,
    JointsLoopResult,
    JointsResults,
    JointsRun,
    PointModel,
    PointModels,
)
from workflow.tasks.loop_sensitivity import SETTLED
from workflow.tasks.records import make_records
from workflow.tasks.results import DesignResult
from workflow.tasks.stage import RunKind, Stage, StageInput

Real = npt.NDArray[np.float64]


def _of(stage: StageInput) -> tuple[JointsConfig, JointsResults]:
    """Configuration and results of a stage by their types in a run for several joints."""
    config: Any = stage.config
    results: Any = stage.results
    return config, results


def identify_points(stage: StageInput) -> PointModels:
    """A model and its uncertainty ball for every operating point.

    Each search begins at the poles of the point before: they move little between operating points.

    Raises
    ------
    InputError
        One line that names the operating point.
    """
    config, results = _of(stage)
    options = config.identification
    least = min(config.dead_times)
    # A delay that all inputs share is the model's, the rest of each is taken off its signal beforehand.
    later = tuple(delay - least for delay in config.dead_times)
    asked = IdentOptions(
        integrators=options.integrators,
        input_delay_samples=least,
        n_real=options.n_real,
        n_pairs=options.n_pairs,
    )
    # Operating points in the order of their first record; logs without a condition are of one arm.
    items = results.records.of_role("estimation")
    names = list(dict.fromkeys(item.condition or "arm" for item in items))
    prepared: dict[tuple[str, Role], list[Record]] = {}
    for item in results.records.records:
        record = _with_later_inputs(item.record, later)
        if options.increments:
            record = increments(record)
        point_name = item.condition or "arm"
        of_point = prepared.setdefault((point_name, item.role), [])
        of_point.append(record)
    # A free run of joints that turn freely drifts away, that of differences does not.
    again = fit_on_fresh_data if options.increments else fit_in_windows
    points: list[PointModel] = []
    start: Poles | None = None
    for number, name in enumerate(names):

        def report(fraction: float, message: str, number: int = number, name: str = name) -> None:
            stage.progress.update("identify", (number + fraction) / len(names), f"{name}: {message}")

        records = prepared[name, "estimation"]
        fresh = prepared.get((name, "validation"), [])
        remarks: tuple[Finding, ...] = ()
        with naming(f"operating point {name!r}"):
            # Records of a loop: the feedback's noise is in their commands, the reference is free of it.
            if any(record.reference is not None for record in records):
                stages = two_stage_several(records, asked, start=start, progress=report)
                assert stages.plant is not None
                records = list(stages.records)
                start = stages.plant.poles
                remarks = stages.finding, *stages.warnings
            identified = identify_mimo(records, asked, start=start, progress=report)
            ball = matrix_posterior(records, identified, level=options.level)
            model = identified.model

            # Records that were kept back, output by output; one that the model says nothing about is named.
            outputs = list(enumerate(model.outputs))
            fits: list[tuple[FreshFit, ...]] = []
            for record in fresh:
                fits_of_record = tuple(again(output_model, record.only(k)) for k, output_model in outputs)
                fits.append(fits_of_record)
                for fit, output in zip(fits_of_record, model.output_names, strict=True):
                    if not fit.answers:
                        where = f"{fit.name}, {output}"
                        no_answer = finding(
                            FindingKind.NO_ANSWER_THERE, record=where, fit_percent=fit.fit_percent
                        )
                        remarks = (*remarks, no_answer)
            # A colour of the noise is the ball's own.
            for warning in identified.warnings:
                if warning.kind is not FindingKind.COLOURED_RESIDUAL:
                    remarks = (*remarks, warning)

            # The ball as pictures and the design see it: just below the Nyquist frequency it still exists.
            low = options.lowest_rad_s
            high = 0.999 * (np.pi / model.dt_s)
            shown = ball.at(np.geomspace(low, high, FREQUENCIES))
            noise_std = np.sqrt(np.diag(identified.noise_covariance))
            Li_a, Li_b, Li_c, Li_d = ball.input_factor(low)
            points.append(
                PointModel(
                    name=name,
                    model=model,
                    noise_std=noise_std,
                    fit_percent=identified.output_fit_percent,
                    rank_one=identified.rank_one,
                    Lo=ball.output_factor,
                    Li_a=Li_a,
                    Li_b=Li_b,
                    Li_c=Li_c,
                    Li_d=Li_d,
                    radius=ball.largest_radius(low),
                    shown=shown,
                    warnings=remarks,
                    later=later,
                    fresh=tuple(fits),
                )
            )
        start = model.poles
    return PointModels(tuple(points))


def _with_later_inputs(record: Record, later: tuple[int, ...]) -> Record:
    """The record with each input as it stands when it begins to act: later by so many samples.

    The samples before the last of them begins to act are left out.
    """
    longest = max(later)
    held = [record.input[longest - delay : record.n_samples - delay, k] for k, delay in enumerate(later)]
    return replace(record.slice(longest, record.n_samples), input=np.column_stack(held))


def design_joints(stage: StageInput) -> DesignResult:
    """One controller for all operating points, and in one line how far it is from the specification."""
    config, results = _of(stage)
    plants = _plants(config, results)
    with naming("design"):
        try:
            synthesis = synthesise_multivariable(
                plants,
                config.specification(),
                config.design.search,
                progress=partial(stage.progress.update, "design"),
            )
        except SpecificationError as impossible:
            return DesignResult(None, met=False, reason=str(impossible))
    # The requirement that is nearest to its limit, or beyond it, is the active constraint.
    blocking = synthesis.blocking[0]
    joint = config.joints[blocking.joint or 0]
    signal = joint.output
    if blocking.weight == "effort":
        signal = joint.input
    reason = (
        f"worst case {synthesis.gamma:.3f} (at most 1 is needed), of {blocking.weight} of "
        f"{signal}, {blocking.plant}, at {blocking.omega_rad_s:.3g} rad/s"
    )
    return DesignResult(synthesis, synthesis.gamma <= 1.0, reason)


def _plants(config: JointsConfig, results: JointsResults) -> list[MultivariablePlant]:
    return [point.plant(config.identification.gain_error) for point in results.identify.points]


def certify_joints(stage: StageInput) -> JointsCertificate:
    """The certificate of the controller, computed independently of the synthesis, for all frequencies."""
    config, results = _of(stage)
    law = results.design.controller
    if law is None:
        return JointsCertificate(None)
    return JointsCertificate(certify_multivariable(law, _plants(config, results), config.specification()))


def run_loops(stage: StageInput) -> JointsLoopResult:
    """A step of all joints at every operating point.

    On the nonlinear machine as identified and under further payloads and friction, or on the models where
    records are logs.
    """
    config, results = _of(stage)
    law = results.design.controller
    source = config.source
    if law is None:
        return JointsLoopResult(skipped=results.design.reason)
    # Twenty time constants of the slowest joint, unless a time is stated.
    bandwidths = [joint.bandwidth_rad_s for joint in config.joints if joint.bandwidth_rad_s]
    bandwidth_rad_s = min(bandwidths, default=1.0)
    # Twenty time constants of the bandwidth: a step has settled in the first few.
    duration_s = config.closed_loop.duration_s or 20.0 / bandwidth_rad_s
    samples = int(np.ceil(duration_s / law.dt_s))

    # A twentieth at rest shows what the loop does without a step.
    step_sizes = config.closed_loop.step or (0.1,) * len(config.joints)
    step = np.array(step_sizes)
    reference = np.tile(step, (samples, 1))
    reference[: samples // 20] = 0.0

    # Every operating point as identified, then under each further condition.
    runs: list[JointsRun] = []
    machines = _machines(config, results, stage)
    for number, (point, condition, machine) in enumerate(machines):
        stage.progress.update("closed_loop", number / len(machines), f"{point}, {condition}")
        with naming("closed loop"):
            output, command = simulate_joints(law, machine(), reference)
        runs.append(_judged(point, condition, output, command, step, law))
    kind: Literal["simulated", "identified"] = "identified"
    if isinstance(source, TwoJointSource):
        kind = "simulated"
    return JointsLoopResult(kind, np.asarray(np.arange(samples) * law.dt_s), reference, tuple(runs))


def _judged(
    point: str, condition: str, output: Real, command: Real, step: Real, law: Controller
) -> JointsRun:
    """A run with what is read off it. output (T, Y) on a step (Y,), command (T, U)."""
    # A joint that is to rest is judged by the largest step of the others.
    step_size = np.abs(step)
    size = np.where(step, step_size, np.max(step_size))

    # Settled: the last twentieth stays near the step; an unstable run has no finite end.
    last_samples = max(1, len(output) // 20)
    late = output[-last_samples:]
    error = np.abs(late - step)
    is_finite = np.all(np.isfinite(output))
    settled = bool(is_finite and np.all(error < SETTLED * size))

    # Beyond the step in its own direction.
    direction = np.where(step < 0, -1.0, 1.0)
    beyond = direction * (output - step)
    overshoot = np.max(beyond / size, axis=0)

    # Limits to the last digits: a limited command stands at its limit but for rounding.
    limits = law.limits("input_limit") * (1 - 1e-9)
    at_limit = np.any(np.abs(command) >= limits, axis=1)
    return JointsRun(
        point=point,
        condition=condition,
        output=output,
        command=command,
        settled=settled,
        overshoot=overshoot,
        limited=float(np.mean(at_limit)),
    )


def _machines(
    config: JointsConfig, results: JointsResults, stage: StageInput
) -> list[tuple[str, str, Callable[[], Any]]]:
    """Machines to run the loop on: operating point, condition in words, and a function that makes it."""
    source = config.source
    options = config.closed_loop
    if not isinstance(source, TwoJointSource):
        return [
            (point.name, "identified model", partial(LinearMachine, point.plant(0.0).nominal))
            for point in results.identify.points
        ]
    machines: list[tuple[str, str, Callable[[], Any]]] = []
    for point in source.points:
        # One stream for all machines of a point: further conditions leave the noise of the first as it is.
        rng = stage.rng("closed_loop", point.name)
        at_point = partial(machine_at, source, point, rng)
        as_identified = partial(at_point, coulomb_Nm=source.coulomb_Nm)
        machines.append((point.name, "as identified", as_identified))
        for extra_kg in options.extra_payload_kg:
            payload_kg = point.payload_kg + extra_kg
            loaded = partial(as_identified, extra_kg=extra_kg)
            machines.append((point.name, f"payload {payload_kg:g} kg", loaded))
        if options.coulomb_Nm is not None:
            shoulder_Nm, elbow_Nm = options.coulomb_Nm
            condition = f"dry friction {shoulder_Nm:g} and {elbow_Nm:g} N m"
            with_friction = partial(at_point, coulomb_Nm=options.coulomb_Nm)
            machines.append((point.name, condition, with_friction))
    return machines


# Columns that records are read for.
_COLUMNS = {"__all__": {"input", "output"}}
# What design and certificate depend on: the uncertainty of gains is part of the identification's settings.
_ASKED = {"joints": True, "design": True, "identification": True}

# A run for several joints.
SEVERAL_JOINTS = RunKind(
    (
        Stage(
            "records",
            (),
            partial(make_records, simulate=simulated_points),
            expected_s=3.0,
            uses={"source": True, "joints": _COLUMNS},
        ),
        Stage(
            "identify",
            ("records",),
            identify_points,
            expected_s=15.0,
            uses={"identification": True},
        ),
        Stage(
            "design",
            ("records", "identify"),
            design_joints,
            expected_s=20.0,
            uses=_ASKED,
        ),
        Stage(
            "certify",
            ("identify", "design"),
            certify_joints,
            expected_s=5.0,
            uses=_ASKED,
        ),
        Stage(
            "closed_loop",
            ("records", "identify", "design", "certify"),
            run_loops,
            expected_s=5.0,
            uses={"closed_loop": True, "source": True, "joints": True},
            except_for={"source": {"records"}},
        ),
    ),
    JointsResults,
)
