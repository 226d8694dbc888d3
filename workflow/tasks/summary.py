"""The table of numbers at the end of a run: what a reader wants to see before opening the report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from workflow.config.run_config import RunConfig
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.achievable_performance import bracket_numbers, order_advice, yardstick_words
from workflow.tasks.joint_coverage import joint_numbers, joint_words
from workflow.tasks.reference_filter import prefilter_of, prefilter_words
from workflow.tasks.stages.results import load_document


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    label: str
    value: str


@dataclass(frozen=True)
class Section:
    title: str
    rows: tuple[Row, ...]


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


def summarise(run: RunDirectory, config: RunConfig) -> RunSummary:
    """The table of a run whose stages are all there."""
    documents = {
        name: run.load_stage(name).document
        for name in ("records", "identify", "uncertainty", "design", "certify", "closed_loop")
    }
    channels = []
    for found, spread in zip(
        documents["identify"]["channels"], documents["uncertainty"]["channels"], strict=True
    ):
        channels.append(
            Section(
                f"channel {found['name']}",
                (*channel_rows(found, spread["intervals"]), *uncertainty_rows(spread)),
            )
        )
    design, certify, loop = (documents[name] for name in ("design", "certify", "closed_loop"))
    yardstick, prefilter = (load_document(run, name) for name in ("yardstick", "prefilter"))
    order = config.specification.controller_order
    unit = _unit(documents["records"], config.control_channel.output)
    command_unit = _unit(documents["records"], config.control_channel.input)
    sections = (
        Section("records", record_rows(documents["records"])),
        *channels,
        Section("design", (*design_rows(design), *yardstick_rows(yardstick, design, order))),
        Section("certificate", (*certificate_rows(certify), *whole_rows(certify.get("whole", {})))),
        *prefilter_sections(prefilter),
        Section("closed loop", closed_loop_rows(loop, unit, command_unit)),
    )
    certified = (
        bool(certify["certified"]) and loop["skipped"] is None and loop["settled_draws"] == loop["draws"]
    )
    return RunSummary(
        title=config.run.title or config.run.name,
        sections=sections,
        numbers={
            "channels": [
                _numbers_of(f, s)
                for f, s in zip(
                    documents["identify"]["channels"], documents["uncertainty"]["channels"], strict=True
                )
            ],
            "design": {"met": design["met"], "reason": design["reason"], **_gamma(design)},
            "certificate": certify["certificate"],
            "yardstick": bracket_numbers(yardstick, gamma_of(design)),
            "whole_responses": joint_numbers(certify.get("whole", {})),
            "prefilter": prefilter.get("prefilter"),
            "closed_loop": loop,
        },
        certified=certified,
        verdict=verdict_of(design, certify, loop, yardstick, order),
        report_path=str(run.report_path) if run.report_path.is_file() else None,
    )


def verdict_of(
    design: Mapping[str, Any],
    certify: Mapping[str, Any],
    loop: Mapping[str, Any],
    yardstick: Mapping[str, Any] | None = None,
    order: int | None = None,
) -> str:
    """One line: certified, or what is missed, by how much and at which frequency, and, where the yardstick is
    given, whether a higher order would help."""
    if not design["met"]:
        gamma = gamma_of(design)
        advice = None
        if yardstick is not None and order is not None and gamma is not None:
            advice = order_advice(yardstick, gamma, order)
        return f"specification not met: {design['reason']}" + (f"; {advice}" if advice else "")
    if not certify["certified"]:
        return f"not certified: {certify['reason']}"
    if loop["skipped"] is not None:
        return f"not checked in closed loop: {loop['skipped']}"
    if loop["settled_draws"] != loop["draws"]:
        return (
            f"closed loop did not settle in {loop['draws'] - loop['settled_draws']} of {loop['draws']} runs"
        )
    return f"certified: every item is met, and all {loop['draws']} closed-loop runs settle"


def record_rows(document: Mapping[str, Any]) -> tuple[Row, ...]:
    """How many records of each role."""
    rows = []
    for role in ("estimation", "validation", "repeat"):
        chosen = [record for record in document["records"] if record["role"] == role]
        if chosen:
            seconds = sum(record["duration_s"] for record in chosen)
            samples = sum(record["samples"] for record in chosen)
            rows.append(Row(role, f"{_count(len(chosen), 'record')}, {samples} samples, {seconds:.4g} s"))
    return tuple(rows)


def channel_rows(found: Mapping[str, Any], intervals: Mapping[str, Any] | None = None) -> tuple[Row, ...]:
    """Structure, modes (with the intervals of the posterior, if given) and fits of one channel."""
    extras = [_count(found["integrators"], "integrator")] if found["integrators"] else []
    extras += [f"delay {found['input_delay_samples']}"] if found["input_delay_samples"] else []
    extras += ["direct term"] if found["feedthrough"] else []
    rows = [Row("order", ", ".join([str(found["order"]), *extras]))]
    for index, mode in enumerate(found["modes"]):
        text = f"{mode['frequency_Hz']:.4g} Hz, damping {mode['damping']:.3g}"
        if intervals is not None:
            known = intervals["modes"][index]
            text += (
                f" ({100 * intervals['level']:g} %: {between(*known['frequency_Hz'])} Hz, "
                f"{between(*known['damping'])})"
            )
        rows.append(Row("mode", text))
    if found["real_poles_per_s"]:
        rates = ", ".join(f"{rate:.4g}" for rate in found["real_poles_per_s"])
        rows.append(Row("real poles", f"{rates} 1/s"))
    no_rate = [value for value in found["real_poles_z"] if value <= 0]
    if no_rate:
        rows.append(Row("real poles, z plane", ", ".join(f"{value:.4g}" for value in no_rate)))
    for role in ("estimation", "validation", "repeat"):
        fits = list(found[f"fit_{role}_percent"].values())
        if fits:
            of = " of increments" if found.get("increments") else ""
            rows.append(Row(f"fit, {role}", _range(fits, f"%{of}")))
    return tuple(rows)


def between(low: float, high: float) -> str:
    """low to high with two digits of what lies between; 'not known' where an end is open."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return "not known"
    if not 1e-7 < high - low < 1e5:
        return f"{low:.6g} to {high:.6g}"
    decimals = max(0, 1 - math.floor(math.log10(high - low)))
    return f"{low:.{decimals}f} to {high:.{decimals}f}"


def uncertainty_rows(spread: Mapping[str, Any]) -> tuple[Row, ...]:
    """Ellipse sizes by band, verdicts of the residual tests, repeat scatter."""
    rows = [
        Row(
            f"{100 * spread['level']:g} % radius",
            ", ".join(
                f"{_percent(band['median_radius_percent'])} % "
                f"({band['from_rad_s']:.3g}-{band['to_rad_s']:.3g} rad/s)"
                for band in spread["bands"]
            ),
        )
    ]
    for test in spread["tests"]:
        if test["data"] == "estimation":
            passed = "pass" if test["passed"] else "FAIL"
            rows.append(Row(f"residuals, {test['name']}", f"{passed}: {test['verdict']}"))
    if "nominal" in spread:
        row = spread["nominal"]
        rows.append(
            Row(
                "nominal model",
                f"inside {row['share_inside_percent']:.3g} % of the ellipses, at most "
                f"{row['largest_distance']:.3g} of one from the centre ({row['at_rad_s']:.4g} rad/s)",
            )
        )
    if spread["repeat_scatter"]:
        ratios = [row["ratio"] for row in spread["repeat_scatter"]]
        rows.append(Row("repeat scatter", f"{_range(ratios, '')} times the predicted (by band)"))
    return tuple(rows)


def design_rows(design: Mapping[str, Any]) -> tuple[Row, ...]:
    """Outcome and controller."""
    synthesis = design["synthesis"]
    rows = [Row("outcome", design["reason"])]
    if synthesis is not None:
        rows.insert(
            0,
            Row(
                "controller", f"order {len(synthesis['controller']['A'])}, gamma {_text(synthesis['gamma'])}"
            ),
        )
    if design.get("jointly"):
        rows.append(Row("sampled", design["jointly"]))
    return tuple(rows)


def certificate_rows(certify: Mapping[str, Any]) -> tuple[Row, ...]:
    """Margins, nominal and worst over the ellipses, and the items."""
    certificate = certify["certificate"]
    if certificate is None:
        return (Row("none", certify["reason"]),)
    rows = [Row("verdict", "certified" if certify["certified"] else f"NOT certified: {certify['reason']}")]
    for verdict in certificate["plants"]:
        for label, key in (("margins, nominal", "nominal_margins"), ("margins, worst case", "worst_margins")):
            rows.append(Row(label, margin_text(verdict[key])))
        rows.append(
            Row(
                "bandwidth",
                f"{_text(verdict['bandwidth_rad_s'])} rad/s (|S| below -3 dB up to here, worst case)",
            )
        )
        for mode in verdict["closed_loop_modes"]:
            if mode["zeta"] < 0.4:
                rows.append(
                    Row(
                        "closed-loop mode",
                        f"{mode['omega_rad_s'] / (2 * math.pi):.4g} Hz, damping {mode['zeta']:.3g}",
                    )
                )
    for item in certificate["items"]:
        where = "" if item["omega_rad_s"] is None else f" at {_text(item['omega_rad_s'])} rad/s"
        state = "met" if item["met"] else "NOT met"
        value = f"{_text(item['achieved'])} against {_text(item['required'])} {item['unit']}".rstrip()
        rows.append(Row(item["requirement"], f"{value}{where}: {state}"))
    return tuple(rows)


def gamma_of(design: Mapping[str, Any]) -> float | None:
    """Weighted worst case of the design on its own grid; None without a controller, inf without a stable
    one."""
    synthesis = design["synthesis"]
    if synthesis is None:
        return None
    return math.inf if synthesis["gamma"] is None else float(synthesis["gamma"])


def yardstick_rows(yardstick: Mapping[str, Any], design: Mapping[str, Any], order: int) -> tuple[Row, ...]:
    """How far the order chosen is from what any order could reach."""
    words = yardstick_words(yardstick, gamma_of(design), order)
    return (Row("against any order", words),) if words else ()


def whole_rows(whole: Mapping[str, Any]) -> tuple[Row, ...]:
    """For how many whole responses the worst case holds."""
    words = joint_words(whole)
    return (Row("whole responses", words),) if words else ()


def prefilter_sections(document: Mapping[str, Any]) -> tuple[Section, ...]:
    """The prefilter, if one was asked for."""
    words = prefilter_words(document)
    if words is None:
        return ()
    found = prefilter_of(document)
    label = "none" if found is None else "model matching"
    return (Section("prefilter", (Row(label, words),)),)


def margin_text(margins: Mapping[str, Any]) -> str:
    """Gain, phase, modulus and delay margin in one line; None means unlimited."""
    gain = "unlimited" if margins["gain_up"] is None else f"{20 * math.log10(margins['gain_up']):.2f} dB"
    phase = "unlimited" if margins["phase_rad"] is None else f"{math.degrees(margins['phase_rad']):.1f} deg"
    delay = "unlimited" if margins["delay_s"] is None else f"{1e3 * margins['delay_s']:.1f} ms"
    return f"gain {gain}, phase {phase}, modulus {_text(margins['modulus'])}, delay {delay}"


def closed_loop_rows(loop: Mapping[str, Any], unit: str, command_unit: str) -> tuple[Row, ...]:
    """Prediction beside what the machine did (median and range over the runs)."""
    if loop["skipped"] is not None:
        return (Row("not run", loop["skipped"]),)
    machine = {"simulated": "simulated nonlinear arm", "identified": "plants drawn from the identified model"}
    rows = [
        Row("machine", f"{machine[loop['machine']]}, {loop['draws']} runs, {loop['settled_draws']} settle"),
        Row("reference step", f"{loop['reference_step']:.4g} {unit}".rstrip()),
    ]
    tracking = (
        ("rise time", "rise_time_s", "s"),
        ("overshoot", "overshoot_percent", "%"),
        ("settling time", "settling_time_s", "s"),
        ("steady error", "steady_error", unit),
    )
    always = (("peak command", "peak_command", command_unit), ("disturbance peak", "disturbance_peak", unit))
    for label, key, suffix in (*(tracking if loop["tracking"] else ()), *always):
        achieved = [row[key] for row in loop["achieved"] if row[key] is not None]
        never = len(loop["achieved"]) - len(achieved)
        text = _range(achieved, suffix) if achieved else "never"
        if achieved and never:
            text += f" ({never} never)"
        rows.append(Row(label, f"predicted {_text(loop['predicted'][key], suffix)}, achieved {text}"))
    found = loop.get("sensitivity")
    if found:
        large = found["measured"][0]
        rows.append(
            Row(
                "peak of |S|",
                f"predicted {_text(found['nominal_peak'])}, certified at most "
                f"{_text(found['certified_peak'])}, measured {_text(large['peak'])} "
                f"({large['off_nominal_percent']:+.2f} % of predicted)",
            )
        )
    if loop.get("conditions"):
        unsettled = [row["name"] for row in loop["conditions"] if not row["settled"]]
        count = len(loop["conditions"])
        rows.append(
            Row(
                "other conditions",
                f"{count - len(unsettled)} of {count} settle"
                + (f", not: {', '.join(unsettled)}" if unsettled else ""),
            )
        )
    return tuple(rows)


def _numbers_of(found: Mapping[str, Any], spread: Mapping[str, Any]) -> dict[str, Any]:
    kept = ("name", "order", "modes", "real_poles_per_s", "noise_std", "tangent_optimality")
    fits = ("fit_estimation_percent", "fit_validation_percent", "fit_repeat_percent")
    tests = [
        {key: test[key] for key in ("data", "name", "probability", "passed")} for test in spread["tests"]
    ]
    return {
        **{key: found[key] for key in (*kept, *fits)},
        "bands": spread["bands"],
        "tests": tests,
        "repeat_scatter": spread["repeat_scatter"],
    }


def _gamma(design: Mapping[str, Any]) -> dict[str, Any]:
    synthesis = design["synthesis"]
    if synthesis is None:
        return {"gamma": None, "outcome": "IMPOSSIBLE", "blocking": []}
    return {key: synthesis[key] for key in ("gamma", "outcome", "blocking")}


def _unit(records: Mapping[str, Any], signal: str) -> str:
    return str(records["records"][0]["units"].get(signal, ""))


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
