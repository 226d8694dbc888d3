"""The table of numbers at the end of a run: what a reader wants to see before opening the report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from control_design.analysis.margins import Margins
from workflow.config.run_config import Role, RunConfig
from workflow.engine import codec
from workflow.tasks.achievable_performance import achievable_words, bracket_numbers, order_advice
from workflow.tasks.joint_coverage import joint_numbers, joint_words
from workflow.tasks.reference_filter import filter_words
from workflow.tasks.results import (
    AchievablePerformance,
    CertifyResult,
    ClosedLoopResult,
    DesignResult,
    IdentifiedChannel,
    Intervals,
    RecordsResult,
    ReferenceFilterResult,
    RunResults,
    SampledResponses,
    UncertainChannel,
)


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    label: str
    value: str


@dataclass(frozen=True)
class Section:
    title: str
    rows: tuple[Row, ...]


def sections_of(parts: Sequence[tuple[str, Sequence[tuple[str, str]]]]) -> tuple[Section, ...]:
    """Of a table that a template made."""
    return tuple(Section(title, tuple(Row(*row) for row in rows)) for title, rows in parts)


@dataclass(frozen=True)
class RunSummary:
    """Rows to read, `numbers` (JSON-able) to compute with, and the verdict in one line.

    `certified` is False when the specification is missed or the certificate fails; the verdict then says by
    how much and at which frequencies.
    """

    title: str
    sections: tuple[Section, ...]
    numbers: Mapping[str, Any] = field(default_factory=dict)
    certified: bool = True
    verdict: str = ""
    report_path: str | None = None

    def to_document(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "title": self.title,
            "certified": self.certified,
            "verdict": self.verdict,
            "report": self.report_path,
            "numbers": dict(self.numbers),
            "table": [
                {"section": section.title, "label": row.label, "value": row.value}
                for section in self.sections
                for row in section.rows
            ],
        }


def summarise(results: RunResults, config: RunConfig) -> RunSummary:
    """The table of a run whose stages are all there."""
    records, design, certify = results.records, results.design, results.certify
    achievable, loop = results.achievable_performance, results.closed_loop
    pairs = list(zip(results.identify.channels, results.uncertainty.channels, strict=True))
    order = config.specification.controller_order
    unit = records.unit(config.control_channel.output)
    command_unit = records.unit(config.control_channel.input)
    sections = (
        Section("records", record_rows(records)),
        *(
            Section(
                f"channel {found.name}", (*channel_rows(found, spread.intervals), *uncertainty_rows(spread))
            )
            for found, spread in pairs
        ),
        Section("design", (*design_rows(design), *achievable_rows(achievable, design, order))),
        Section("certificate", (*certificate_rows(certify), *sampled_rows(certify.sampled))),
        *filter_sections(results.reference_filter),
        Section("closed loop", closed_loop_rows(loop, unit, command_unit)),
    )
    settles = loop.check is not None and loop.check.settled_draws == loop.check.draws
    return RunSummary(
        title=config.run.title or config.run.name,
        sections=sections,
        numbers={
            "channels": [channel_numbers(found, spread) for found, spread in pairs],
            "design": design_numbers(design),
            "certificate": codec.plain(certify.certificate),
            "achievable_performance": bracket_numbers(achievable, design.gamma),
            "sampled_responses": joint_numbers(certify.sampled),
            "reference_filter": codec.plain(results.reference_filter.filter),
            "closed_loop": loop_numbers(loop),
        },
        certified=certify.certified and settles,
        verdict=verdict_of(design, certify, loop, achievable, order),
        report_path=str(results.run.report_path) if results.run.report_path.is_file() else None,
    )


def verdict_of(
    design: DesignResult,
    certify: CertifyResult,
    loop: ClosedLoopResult,
    achievable: AchievablePerformance | None = None,
    order: int | None = None,
) -> str:
    """One line: certified, or what is missed, by how much and at which frequency, and, where the achievable
    performance is given, whether a higher order would help."""
    if not design.met:
        advice = None
        if achievable is not None and order is not None and design.gamma is not None:
            advice = order_advice(achievable, design.gamma, order)
        return f"specification not met: {design.reason}" + (f"; {advice}" if advice else "")
    if not certify.certified:
        return f"not certified: {certify.reason}"
    if loop.check is None:
        return f"not checked in closed loop: {loop.skipped}"
    draws, settled = loop.check.draws, loop.check.settled_draws
    if settled != draws:
        return f"closed loop did not settle in {draws - settled} of {draws} runs"
    return f"certified: every item is met, and all {draws} closed-loop runs settle"


_ROLES: tuple[Role, ...] = ("estimation", "validation", "repeat")


def record_rows(result: RecordsResult) -> tuple[Row, ...]:
    """How many records of each role."""
    rows = []
    for role in _ROLES:
        chosen = result.of_role(role)
        if chosen:
            seconds = sum(item.duration_s for item in chosen)
            samples = sum(item.record.n_samples for item in chosen)
            rows.append(Row(role, f"{_count(len(chosen), 'record')}, {samples} samples, {seconds:.4g} s"))
    return tuple(rows)


def channel_rows(found: IdentifiedChannel, intervals: Intervals | None = None) -> tuple[Row, ...]:
    """Structure, modes (with the intervals of the posterior, if given) and fits of one channel."""
    extras = [_count(found.integrators, "integrator")] if found.integrators else []
    extras += [f"delay {found.input_delay_samples}"] if found.input_delay_samples else []
    extras += ["direct term"] if found.feedthrough else []
    rows = [Row("order", ", ".join([str(found.order), *extras]))]
    for index, mode in enumerate(found.modes):
        text = f"{mode.frequency_Hz:.4g} Hz, damping {mode.damping:.3g}"
        if intervals is not None:
            known = intervals.modes[index]
            text += (
                f" ({100 * intervals.level:g} %: {between(*known.frequency_Hz)} Hz, "
                f"{between(*known.damping)})"
            )
        rows.append(Row("mode", text))
    if found.real_poles_per_s:
        rates = ", ".join(f"{rate:.4g}" for rate in found.real_poles_per_s)
        rows.append(Row("real poles", f"{rates} 1/s"))
    no_rate = [value for value in found.real_poles_z if value <= 0]
    if no_rate:
        rows.append(Row("real poles, z plane", ", ".join(f"{value:.4g}" for value in no_rate)))
    of = " of increments" if found.increments else ""
    for role, fits in (
        ("estimation", found.fit_estimation_percent),
        ("validation", found.fit_validation_percent),
        ("repeat", found.fit_repeat_percent),
    ):
        if fits:
            rows.append(Row(f"fit, {role}", _range(list(fits.values()), f"%{of}")))
    return tuple(rows)


def between(low: float, high: float) -> str:
    """low to high with two digits of what lies between; 'not known' where an end is open."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return "not known"
    if not 1e-7 < high - low < 1e5:
        return f"{low:.6g} to {high:.6g}"
    decimals = max(0, 1 - math.floor(math.log10(high - low)))
    return f"{low:.{decimals}f} to {high:.{decimals}f}"


def uncertainty_rows(spread: UncertainChannel) -> tuple[Row, ...]:
    """Ellipse sizes by band, verdicts of the residual tests, repeat scatter."""
    rows = [
        Row(
            f"{100 * spread.level:g} % radius",
            ", ".join(
                f"{_percent(band.median_radius_percent)} % ({band.from_rad_s:.3g}-{band.to_rad_s:.3g} rad/s)"
                for band in spread.bands
            ),
        )
    ]
    for test in spread.tests:
        passed = "pass" if test.passed else "FAIL"
        rows.append(Row(f"residuals, {test.name}", f"{passed}: {test.verdict}"))
    found = spread.agreement
    rows.append(
        Row(
            "nominal model",
            f"inside {found.share_inside_percent:.3g} % of the ellipses, at most "
            f"{found.largest_distance:.3g} of one from the centre ({found.at_rad_s:.4g} rad/s)",
        )
    )
    if spread.repeat_scatter:
        ratios = [row.ratio for row in spread.repeat_scatter]
        rows.append(Row("repeat scatter", f"{_range(ratios, '')} times the predicted (by band)"))
    return tuple(rows)


def design_rows(design: DesignResult) -> tuple[Row, ...]:
    """Outcome and controller."""
    rows = [Row("outcome", design.reason)]
    if design.synthesis is not None:
        order, gamma = design.synthesis.controller.order, design.synthesis.gamma
        rows.insert(0, Row("controller", f"order {order}, gamma {_text(gamma)}"))
    if design.jointly:
        rows.append(Row("sampled", design.jointly))
    return tuple(rows)


def certificate_rows(certify: CertifyResult) -> tuple[Row, ...]:
    """Margins, nominal and worst over the ellipses, and the items."""
    certificate = certify.certificate
    if certificate is None:
        return (Row("none", certify.reason),)
    rows = [Row("verdict", "certified" if certify.certified else f"NOT certified: {certify.reason}")]
    for verdict in certificate.plants:
        rows += [
            Row("margins, nominal", margin_text(verdict.nominal_margins)),
            Row("margins, worst case", margin_text(verdict.worst_margins)),
            Row(
                "bandwidth",
                f"{_text(verdict.bandwidth_rad_s)} rad/s (|S| below -3 dB up to here, worst case)",
            ),
        ]
        rows += [
            Row("closed-loop mode", f"{m.omega_rad_s / (2 * math.pi):.4g} Hz, damping {m.zeta:.3g}")
            for m in verdict.closed_loop_modes
            if m.zeta < 0.4
        ]
    for item in certificate.items:
        where = "" if item.omega_rad_s is None else f" at {_text(item.omega_rad_s)} rad/s"
        state = "met" if item.met else "NOT met"
        value = f"{_text(item.achieved)} against {_text(item.required)} {item.unit}".rstrip()
        rows.append(Row(item.requirement, f"{value}{where}: {state}"))
    return tuple(rows)


def achievable_rows(found: AchievablePerformance, design: DesignResult, order: int) -> tuple[Row, ...]:
    """How far the order chosen is from what any order could reach."""
    words = achievable_words(found, design.gamma, order)
    return (Row("against any order", words),) if words else ()


def sampled_rows(found: SampledResponses) -> tuple[Row, ...]:
    """For how many sampled responses the worst case holds."""
    words = joint_words(found)
    return (Row("sampled responses", words),) if words else ()


def filter_sections(result: ReferenceFilterResult) -> tuple[Section, ...]:
    """The reference filter, if one was asked for."""
    words = filter_words(result)
    if words is None:
        return ()
    label = "none" if result.filter is None else "model matching"
    return (Section("reference filter", (Row(label, words),)),)


def margin_text(margins: Margins) -> str:
    """Gain, phase, modulus and delay margin in one line; infinite ones are unlimited."""

    def number(value: float, text: str) -> str:
        return text if math.isfinite(value) else "unlimited"

    gain = number(margins.gain_up, f"{20 * math.log10(margins.gain_up):.2f} dB")
    phase = number(margins.phase_rad, f"{math.degrees(margins.phase_rad):.1f} deg")
    delay = number(margins.delay_s, f"{1e3 * margins.delay_s:.1f} ms")
    return f"gain {gain}, phase {phase}, modulus {_text(margins.modulus)}, delay {delay}"


def closed_loop_rows(loop: ClosedLoopResult, unit: str, command_unit: str) -> tuple[Row, ...]:
    """Prediction beside what the machine did (median and range over the runs)."""
    check = loop.check
    if check is None:
        return (Row("not run", str(loop.skipped)),)
    machine = {"simulated": "simulated nonlinear arm", "identified": "plants drawn from the identified model"}
    rows = [
        Row("machine", f"{machine[check.machine]}, {check.draws} runs, {check.settled_draws} settle"),
        Row("reference step", f"{check.reference_step:.4g} {unit}".rstrip()),
    ]
    tracking = (
        ("rise time", "rise_time_s", "s"),
        ("overshoot", "overshoot_percent", "%"),
        ("settling time", "settling_time_s", "s"),
        ("steady error", "steady_error", unit),
    )
    always = (("peak command", "peak_command", command_unit), ("disturbance peak", "disturbance_peak", unit))
    for label, key, suffix in (*(tracking if check.tracking else ()), *always):
        values = [getattr(row, key) for row in check.achieved]
        achieved = [value for value in values if value is not None]
        text = _range(achieved, suffix) if achieved else "never"
        if achieved and len(achieved) < len(values):
            text += f" ({len(values) - len(achieved)} never)"
        rows.append(Row(label, f"predicted {_text(getattr(check.predicted, key), suffix)}, achieved {text}"))
    found = check.sensitivity
    if found is not None:
        large = found.measured[0]
        rows.append(
            Row(
                "peak of |S|",
                f"predicted {_text(found.nominal_peak)}, certified at most {_text(found.certified_peak)}, "
                f"measured {_text(large.peak)} ({large.off_nominal_percent:+.2f} % of predicted)",
            )
        )
    if check.conditions:
        unsettled = [row.name for row in check.conditions if not row.settled]
        count = len(check.conditions)
        rows.append(
            Row(
                "other conditions",
                f"{count - len(unsettled)} of {count} settle"
                + (f", not: {', '.join(unsettled)}" if unsettled else ""),
            )
        )
    return tuple(rows)


def model_numbers(found: IdentifiedChannel) -> dict[str, Any]:
    """What was found in one channel, for programs."""
    names: tuple[str, ...] = (
        "name",
        "input",
        "output",
        "order",
        "integrators",
        "input_delay_samples",
        "feedthrough",
    )
    names += ("real_poles_per_s", "real_poles_z", "warnings", "verdicts", "order_table", "band_rad_s")
    names += ("fit_estimation_percent", "fit_validation_percent", "fit_repeat_percent", "two_stage")
    return {
        **{name: codec.plain(getattr(found, name)) for name in names},
        "modes": [{"frequency_Hz": mode.frequency_Hz, **codec.plain(mode)} for mode in found.modes],
        "noise_std": found.identification.noise_std,
        "tangent_optimality": found.identification.tangent_optimality,
        "search_evaluations": found.identification.search.evaluations,
    }


def uncertainty_numbers(spread: UncertainChannel) -> dict[str, Any]:
    """The same of its ellipses, arrays left out."""
    found: dict[str, Any] = codec.plain(spread, arrays=False)
    for unwanted in ("posterior", "nominal", "frequency", "empirical"):
        found.pop(unwanted)
    return {**found, "report": codec.plain(spread.posterior.report)}


def channel_numbers(found: IdentifiedChannel, spread: UncertainChannel) -> dict[str, Any]:
    """The model of a channel and its ellipses together."""
    said = uncertainty_numbers(spread)
    return {**model_numbers(found), **{key: said[key] for key in ("bands", "tests", "repeat_scatter")}}


def design_numbers(design: DesignResult) -> dict[str, Any]:
    """Outcome of a design without its controller."""
    found = design.synthesis
    return {
        "met": design.met,
        "reason": design.reason,
        "gamma": design.gamma,
        "outcome": "IMPOSSIBLE" if found is None else found.outcome.name,
        "blocking": [] if found is None else codec.plain(found.blocking),
    }


def loop_numbers(loop: ClosedLoopResult) -> dict[str, Any]:
    """The check without its signals."""
    if loop.check is None:
        return {"skipped": loop.skipped}
    draws, settled = loop.check.draws, loop.check.settled_draws
    said: dict[str, Any] = codec.plain(loop.check, arrays=False)
    return {"skipped": None, "draws": draws, "settled_draws": settled, **said}


def _percent(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def _text(value: float | str | None, suffix: str = "") -> str:
    if value is None:
        return "none"
    if isinstance(value, str):
        return value
    return f"{value:.4g} {suffix}".rstrip()


def _range(values: Sequence[float], suffix: str) -> str:
    low, high = min(values), max(values)
    text = f"{low:.4g}" if f"{low:.4g}" == f"{high:.4g}" else f"{low:.4g} to {high:.4g}"
    return f"{text} {suffix}".rstrip()
