"""The table of numbers at the end of a run: what a reader wants to see before opening the report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from control_design.controllers.engineers_numbers import ControllerNumbers, engineers_numbers
from control_design.specification import Specification
from ident.command_timing import CommandTiming
from ident.data.finding import Finding
from ident.uncertainty import FrequencyUncertainty
from workflow.config.joints_config import AnyConfig
from workflow.config.run_config import RunConfig
from workflow.engine import codec
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.design import bracket_numbers, joint_numbers
from workflow.tasks.exports import Logged
from workflow.tasks.giving_way import gave_way
from workflow.tasks.results import (
    AchievablePerformance,
    CertifyResult,
    ClosedLoopResult,
    DesignResult,
    IdentifiedChannel,
    RunResults,
    UncertainChannel,
)
from workflow.text.templates import RunSummary, rows_of, said, words


def summarise(results: RunResults, config: AnyConfig) -> RunSummary:
    """The table of a run whose stages are all there."""
    numbers, settles, verdict = (
        _of_one_loop(results, config) if isinstance(config, RunConfig) else _of_joints(results)
    )
    shown: dict[str, Any] = {"config": config, "results": results}
    shown["numbers_of_controller"] = numbers_of_controller(results, config)
    if isinstance(config, RunConfig):
        shown["given_way"] = gave_way(config.specification, results.design.specification)
    shares, signals = numbers.get("sampled_responses"), Logged.of(config, results.records).signals
    return RunSummary(
        title=title_of(config, results.run),
        sections=rows_of("summary/run.j2", shares=shares, signals=signals, **shown),
        brief=rows_of("summary/brief.j2", **shown),
        numbers=numbers,
        certified=results.certify.certified and settles,
        verdict=verdict,
        report_path=str(results.run.report_path) if results.run.report_path.is_file() else None,
        taken_over=results.run.taken_over(),
    )


def _of_one_loop(results: RunResults, config: RunConfig) -> tuple[dict[str, Any], bool, str]:
    """Numbers for programs, whether every run in closed loop settles, and the verdict."""
    design, certify = results.design, results.certify
    achievable, loop = results.achievable_performance, results.closed_loop
    pairs = list(zip(results.identify.channels, results.uncertainty.channels, strict=True))
    conditions = results.uncertainty.conditions(config)
    numbers = numbers_of_controller(results, config)
    return (
        {
            "command_timing": timing_numbers(results.records.timing),
            "channels": [channel_numbers(found, spread) for found, spread in pairs],
            "design": {
                "met": design.met,
                "reason": design.reason,
                "gamma": design.gamma,
                "outcome": "IMPOSSIBLE" if design.synthesis is None else design.synthesis.outcome.name,
                "blocking": [] if design.synthesis is None else codec.plain(design.synthesis.blocking),
                "bandwidth_rad_s": bandwidth_numbers(design, certify, config.specification),
                "gave_way": codec.plain(gave_way(config.specification, design.specification)),
                "tracking_from_rad_s": (design.specification or config.specification).tracking_from_rad_s,
                "controller_dt_s": None if design.controller is None else design.controller.dt_s,
            },
            "engineers_numbers": None if numbers is None else numbers.to_dict(),
            "signals": Logged.of(config, results.records).signals,
            "certificate": codec.plain(certify.certificate),
            "certificate_conditions": [words(doubt) for doubt in conditions],
            "achievable_performance": bracket_numbers(achievable, design.gamma),
            "sampled_responses": joint_numbers(certify.sampled),
            "reference_filter": codec.plain(results.reference_filter.filter),
            "closed_loop": loop_numbers(loop),
        },
        loop.check is not None and loop.check.settled_draws == loop.check.draws,
        verdict_of(
            design,
            certify,
            loop,
            achievable,
            (design.specification or config.specification).controller_order,
            untold_below_rad_s(results.uncertainty.channels[config.control_index].frequency),
            conditions,
            config.specification,
            results.identify.modes_rad_s,
        ),
    )


def numbers_of_controller(results: RunResults, config: AnyConfig) -> ControllerNumbers | None:
    """The controller in an engineer's numbers, as the run's files have it; None without one, for several
    joints, and where it has no such factors."""
    if not isinstance(config, RunConfig) or results.design.controller is None:
        return None
    return engineers_numbers(Logged.of(config, results.records).law(results.design.controller))


def _of_joints(results: Any) -> tuple[dict[str, Any], bool, str]:
    """The same of several joints."""
    design, certify, loop = results.design, results.certify, results.closed_loop
    settled, points = loop.settled_points()
    return (
        {
            "points": [codec.plain(point, arrays=False) for point in results.identify.points],
            "design": {"gamma": design.gamma, "reason": design.reason},
            "certificate": codec.plain(certify.certificate),
            "closed_loop": codec.plain(loop, arrays=False),
        },
        settled == points,
        said("joints_verdict", design, certify, settled, points),
    )


def title_of(config: AnyConfig, run: RunDirectory) -> str:
    """Headline of a run: what the configuration calls it, else its folder."""
    named = config.run.name != type(config.run).model_fields["name"].default
    return config.run.title or (config.run.name if named else run.path.resolve().name)


def verdict_of(
    design: DesignResult,
    certify: CertifyResult,
    loop: ClosedLoopResult,
    achievable: AchievablePerformance | None = None,
    order: int | str | None = None,
    untold_rad_s: float = 0.0,
    conditions: Sequence[Finding] = (),
    asked: Specification | None = None,
    modes_rad_s: Sequence[float] | None = None,
) -> str:
    """One line: certified, or what is missed, by how much and at which frequency; where the achievable
    performance is given, whether a higher order would help; up to where the ellipses are wider than the
    gain, if they are; what the certificate stands or falls with; and where less than asked was designed for,
    both. modes_rad_s: of the identified models, of which lost damping is said; None: of all of the plant."""
    advice, untold = "", said("untold", untold_rad_s)
    if achievable is not None and order is not None and design.gamma is not None:
        structure = "biquads" if asked is None else asked.structure
        advice = said("order_advice", achievable, design.gamma, order, structure)
    told = ". Also, ".join(words(doubt) for doubt in conditions)
    given_way = () if asked is None else gave_way(asked, design.specification)
    return said(
        "run_verdict",
        design,
        certify,
        loop,
        untold or advice,
        untold,
        told,
        asked,
        given_way,
        modes_rad_s,
    )


def timing_numbers(timing: CommandTiming | None) -> dict[str, Any] | None:
    """How the period of the controller that made the logs is known; None of simulated records."""
    if timing is None:
        return None
    return {
        "source": timing.source.value,
        "row_step_s": timing.row_step_s,
        "controller_period_s": timing.period_s,
        "rows_per_command": timing.rows_per_command,
        "known": timing.known,
    }


def bandwidth_numbers(
    design: DesignResult, certify: CertifyResult, asked: Specification
) -> dict[str, float | None]:
    """Specified, designed for, and reached: up to there every plant has |S| below -3 dB."""
    plants = () if certify.certificate is None else certify.certificate.plants
    return {
        "specified": asked.bandwidth_rad_s,
        "designed_for": (design.specification or asked).bandwidth_rad_s,
        "reached": min((plant.bandwidth_rad_s for plant in plants), default=None),
    }


def untold_below_rad_s(found: FrequencyUncertainty) -> float:
    """Up to here an ellipse is wider than the gain, from the lowest frequency on; 0 where none is."""
    told = np.flatnonzero(found.enclosing_radius() < np.abs(found.centre))
    if told.size == 0:
        return float(found.omega_rad_s[-1])
    return float(found.omega_rad_s[told[0] - 1]) if told[0] else 0.0


def model_numbers(found: IdentifiedChannel) -> dict[str, Any]:
    """What was found in one channel, for programs."""
    model, identification, way = found.model, found.identification, found.closed_loop
    return {
        "name": found.name,
        "input": found.input,
        "output": found.output,
        "order": model.order,
        "integrators": model.integrators,
        "input_delay_samples": model.input_delay_samples,
        "feedthrough": identification.structure.feedthrough,
        "real_poles_per_s": codec.plain(found.real_poles_per_s),
        "real_poles_z": codec.plain(found.real_poles_z),
        "unstable_poles": [
            {"growth_per_s": growth, "omega_rad_s": omega} for growth, omega in found.unstable_poles
        ],
        "order_table": codec.plain(identification.order_table),
        "band_rad_s": codec.plain(found.band_rad_s),
        **{f"fit_{role}_percent": fits for role, fits in found.fit_percent.items()},
        "warnings": [words(item) for item in identification.warnings],
        "verdicts": [words(item) for item in identification.verdicts],
        # How logs made in a loop were used, and why.
        "closed_loop": None if way is None else {"method": way.kind.name.lower(), "reason": words(way)},
        "modes": [
            {"frequency_Hz": mode.frequency_Hz, **codec.plain(mode), "is_mode": found.is_mode(mode)}
            for mode in found.modes
        ],
        "noise_std": identification.noise_std,
        "tangent_optimality": identification.tangent_optimality,
        "search_evaluations": identification.search.evaluations,
    }


def uncertainty_numbers(spread: UncertainChannel) -> dict[str, Any]:
    """The same of its ellipses, arrays left out."""
    found: dict[str, Any] = codec.plain(spread, arrays=False)
    for unwanted in ("posterior", "nominal", "frequency", "empirical"):
        found.pop(unwanted)
    if spread.intervals is not None:
        for row, known in zip(found["intervals"]["modes"], spread.intervals.modes, strict=True):
            row["frequency_Hz"] = list(known.frequency_Hz)
    for row, test in zip(found["tests"], spread.tests, strict=True):
        row["verdict"] = words(test.finding)
    for part in found["others"]:
        del part["posterior"], part["nominal"]
    found["advice"] = [words(item) for item in spread.advice]
    return {**found, "report": codec.plain(spread.posterior.report)}


def channel_numbers(found: IdentifiedChannel, spread: UncertainChannel) -> dict[str, Any]:
    """The model of a channel and its ellipses together."""
    ellipses, model = uncertainty_numbers(spread), model_numbers(found)
    if spread.intervals is not None:
        for row, known in zip(model["modes"], spread.intervals.modes, strict=True):
            row["is_mode"] &= known.told
    return {
        **model,
        **{key: ellipses[key] for key in ("bands", "intervals", "tests", "advice", "repeat_scatter")},
    }


def loop_numbers(loop: ClosedLoopResult) -> dict[str, Any]:
    """The check without its signals."""
    if loop.check is None:
        return {"skipped": loop.skipped}
    check = loop.check
    counts = {"skipped": None, "draws": check.draws, "settled_draws": check.settled_draws}
    return {**counts, **codec.plain(check, arrays=False)}
