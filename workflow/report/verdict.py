"""The verdict in words, at the head of the page, and how to reproduce it, at its foot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from workflow.report.beyond_margins import beyond_words
from workflow.report.data import ChannelData, RunData
from workflow.report.formats import count, frequency, listing, number, percent, sentence
from workflow.report.page import Block, Code, Section, Table, Text
from workflow.tasks.joint_coverage import open_words


@dataclass(frozen=True)
class Verdict:
    """Certified or not, in one line; the reasons; then what was found, how sure it is, and what was not
    checked."""

    certified: bool
    headline: str
    reasons: tuple[str, ...]
    found: tuple[str, ...]
    sure: tuple[str, ...]
    open_questions: tuple[str, ...]


def verdict_of(data: RunData, *, certified: bool) -> Verdict:
    """Every sentence from the run's own numbers; `certified` is the run's status, as its exit code says
    it."""
    headline, reasons = _certified(data)
    return Verdict(
        certified=certified,
        headline=headline,
        reasons=tuple(map(sentence, reasons)),
        found=tuple(_found(data)),
        sure=tuple(_sure(data)),
        open_questions=tuple(map(sentence, _open(data))),
    )


def _certified(data: RunData) -> tuple[str, list[str]]:
    certificate = data.certificate
    if certificate is None or not data.has_controller:
        return "Not certified: there is no controller", [data.design.reason]
    level = percent(100 * data.certified_level, 4)
    if certificate.certified:
        worst = min(verdict.worst_margins.modulus for verdict in certificate.plants)
        at = min(certificate.plants, key=lambda verdict: verdict.worst_margins.modulus)
        met = (
            "the one item of the specification is"
            if len(certificate.items) == 1
            else f"all {len(certificate.items)} items of the specification are"
        )
        headline, in_time = _in_time(data)
        proved = all(plant.all_frequencies.proved for plant in certificate.plants)
        where = "proved for all frequencies" if proved else "on a dense grid of frequencies"
        return headline, [
            *in_time,
            f"the nominal loop is stable, no {level} ellipse reaches -1, and {met} met in the worst case "
            f"over the ellipses, {where}",
            f"the loop stays {number(worst)} away from -1 or farther (asked for: "
            f"{number(data.config.specification.modulus_margin)}), nearest at "
            f"{frequency(at.worst_margin_omega_rad_s)}",
            *beyond_words(data),
        ]
    reasons = []
    for verdict in certificate.plants:
        if not verdict.stable:
            reasons.append(
                f"{verdict.plant}: the nominal closed loop is unstable (largest pole radius "
                f"{number(verdict.pole_radius, 6)})"
            )
        if not verdict.nyquist.matches:
            reasons.append(
                f"{verdict.plant}: the Nyquist count is {number(verdict.nyquist.half_turns)} half turns "
                "where a stable "
                f"loop needs {number(verdict.nyquist.required)}"
            )
        if not verdict.worst_margins.modulus > 0:
            reasons.append(
                f"{verdict.plant}: a {level} ellipse reaches -1 at "
                f"{frequency(verdict.worst_margin_omega_rad_s)}"
            )
    reasons += [item.sentence() for item in certificate.items if not item.met]
    if data.synthesis is not None and data.synthesis.gamma > 1 and data.synthesis.blocking:
        first = data.synthesis.blocking[0]
        reasons.append(
            f"the design comes within a factor {number(data.synthesis.gamma)} of the specification; "
            f"{first.weight} at {frequency(first.omega_rad_s)} blocks it"
        )
    return "Not certified", reasons + beyond_words(data)


def _in_time(data: RunData) -> tuple[str, list[str]]:
    """Headline of a run whose certificate holds, by what the loop then did over time."""
    if data.closed_loop is None:
        return "Certificate holds, but the loop was not run", ["the closed loop was not simulated"]
    document = data.closed_loop
    draws, settled = document.draws, document.settled_draws
    on = "on the simulated arm" if document.machine == "simulated" else "of plants drawn from the uncertainty"
    if settled < draws:
        return "Certificate holds, but the loop does not settle", [
            f"{draws - settled} of {count(draws, 'run')} {on} did not settle; what the certificate covers "
            "is the linear "
            "model and its ellipses, not what else is in this loop"
        ]
    return "Certified", [f"{'the run' if draws == 1 else f'all {draws} runs'} {on} settled"]


def _found(data: RunData) -> list[str]:
    return [_modes_sentence(channel) for channel in data.channels] + _achieved(data)


def _modes_sentence(channel: ChannelData) -> str:
    about = channel.identified
    light = [mode for mode in about.modes if mode.damping < 0.3]
    model = f"{channel.label}: a model of order {about.order}"
    if about.integrators:
        model += f" with {count(about.integrators, 'integrator')}"
    if not light:
        return f"{model}; no pole pair with a damping ratio below 0.3."
    words = [f"{number(mode.frequency_Hz)} Hz (damping {number(mode.damping, 2)})" for mode in light]
    return f"{model}; {count(len(light), 'lightly damped pole pair')} at {listing(words)}."


def _achieved(data: RunData) -> list[str]:
    if data.closed_loop is None:
        return []
    document = data.closed_loop
    predicted, first = document.predicted, document.achieved[0]
    draws, settled = document.draws, document.settled_draws
    on = (
        "runs on the simulated arm"
        if document.machine == "simulated"
        else "plants drawn from the uncertainty"
    )
    text = f"In closed loop {settled} of {draws} {on} settled"
    if document.tracking and predicted.rise_time_s is not None and first.rise_time_s is not None:
        text += (
            f"; rise time {number(first.rise_time_s)} s in the first (predicted "
            f"{number(predicted.rise_time_s)} s)"
            f", overshoot {number(first.overshoot_percent)} % (predicted "
            f"{number(predicted.overshoot_percent)} %)"
        )
    return [text + "."]


def _sure(data: RunData) -> list[str]:
    sentences = []
    for channel in data.channels:
        bands = channel.uncertain.bands
        narrow = min(bands, key=lambda band: band.median_radius_percent)
        wide = max(bands, key=lambda band: band.median_radius_percent)
        text = (
            f"{channel.label}: {percent(100 * channel.uncertain.level, 4)} ellipses with a median radius "
            "from "
            f"{percent(narrow.median_radius_percent)} of the gain ({number(narrow.from_rad_s)} to "
            f"{number(narrow.to_rad_s)} rad/s) to {percent(wide.median_radius_percent)} "
            f"({number(wide.from_rad_s)} to {number(wide.to_rad_s)} rad/s)"
        )
        fits = channel.identified.fit_validation_percent
        if fits:
            each = listing([f"{percent(fit)} ({name})" for name, fit in fits.items()])
            text += f"; fit on fresh data{' (increments)' if channel.identified.increments else ''} {each}"
        else:
            text += "; no validation record to test it on"
        sentences.append(text + ".")
        inside = channel.uncertain.agreement.share_inside_percent
        if inside < 90 and data.plant is not None:
            sentences.append(
                f"{channel.label}: the nominal model of the design lies outside its ellipse at "
                f"{percent(100 - inside)} of the frequencies; margins and worst cases are those of the "
                "ellipses, the closed-loop poles those of the nominal."
            )
        warnings = channel.identified.warnings
        if warnings:
            sentences.append(
                f"{channel.label}: {count(len(warnings), 'warning')} about the model, first: "
                f"{sentence(warnings[0])}"
            )
        failed = [test for test in channel.uncertain.tests if not test.passed]
        if failed:
            sentences.append(
                f"{channel.label}: {len(failed)} of "
                f"{count(len(channel.uncertain.tests), 'residual test')} "
                f"{'fails' if len(failed) == 1 else 'fail'}: the records hold something the model does not "
                "explain."
            )
    return sentences


def _open(data: RunData) -> list[str]:
    if data.certificate is None:
        return ["without a controller, nothing about a closed loop was checked"]
    items = open_words(data.certificate.not_checked, data.sampled)
    if data.closed_loop is not None and data.closed_loop.machine != "simulated":
        items.append("the controller has not run on the real machine")
    return items


def reproducibility_section(data: RunData) -> Section:
    """Configuration, versions, seed and hashes; times differ from run to run and stay in the manifest."""
    manifest = data.manifest
    versions = tuple(
        (name, str(version)) for name, version in sorted(_mapping(manifest.get("versions")).items())
    )
    inputs = tuple((name, str(digest)) for name, digest in _mapping(manifest.get("inputs")).items())
    blocks: list[Block] = [
        Table(("what", "value"), (("seed of every random stream", str(data.config.run.seed)), *versions)),
    ]
    if inputs:
        blocks.append(Table(("input file", "SHA-256"), inputs))
    if data.config_text:
        blocks.append(Code("Configuration as it was given (config.toml)", data.config_text))
    blocks.append(Text("Times of the stages stand in manifest.json beside this page."))
    return Section("reproduce", "To reproduce this", "Reproduce", tuple(blocks))


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
