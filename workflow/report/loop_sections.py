"""Design, margins, closed loop and rig on the page: every sentence is made from the numbers beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from control_design.synthesis.synthesis_result import Outcome
from workflow.report.beyond_margins import order_blocks, prefilter_blocks, whole_blocks
from workflow.report.data import RunData
from workflow.report.formats import count, decibels, frequency, listing, number, percent, sentence, si
from workflow.report.page import Block, Code, Plot, Remarks, Section, Table, Text, maybe
from workflow.tasks.joint_coverage import open_words

_NOT_A_REQUIREMENT = {"structure", "controller_order", "computational_delay_samples"}


def design_section(data: RunData) -> Section:
    """What was asked of the controller, and what came out."""
    asked = data.config.specification
    rows = []
    for name, field in type(asked).model_fields.items():
        value = getattr(asked, name)
        if name in _NOT_A_REQUIREMENT or value is None or value is False:
            continue
        if name == "low_frequency_rejection" and (asked.bandwidth_rad_s is None or asked.integrator):
            continue
        rows.append((name, _setting(value), field.description or ""))
    result = data.synthesis
    blocks: list[Block] = [
        Text(
            f"A controller of order {asked.controller_order} ({asked.structure}) with "
            f"{count(asked.computational_delay_samples, 'sample')} of computational delay was "
            f"{'to be ' if result is None else ''}optimised over the ellipses against these requirements."
        ),
        Table(("requirement", "asked for", "meaning"), tuple(rows)),
    ]
    if result is None:
        reason = data.design.reason
        blocks.append(Remarks((sentence(reason),), "warning", "No controller was sought"))
        return Section("design", "Controller design", "Design", tuple(blocks))
    stable = [start for start in result.starts if start.stable]
    blocks.append(
        Text(
            f"Outcome: {result.explain()}. {len(stable)} of {count(len(result.starts), 'start')} ended in a "
            "stable loop."
        )
    )
    if result.outcome is Outcome.NOT_CONVERGED:
        advice = (
            "No start led to a stable loop, so nothing is certified or run. Advice: lower bandwidth_rad_s, "
            "raise "
            "controller_order, or improve the model where its ellipses are widest."
        )
        blocks.append(Remarks((advice,), "warning"))
        blocks += order_blocks(data)
        return Section("design", "Controller design", "Design", tuple(blocks))
    if result.blocking:
        places = [(b.weight, b.plant, frequency(b.omega_rad_s), number(b.value, 4)) for b in result.blocking]
        blocks.append(
            Table(
                ("requirement", "plant", "at", "weighted worst case (at most 1 is met)"),
                tuple(places),
                "What blocks: the frequencies that keep the worst case from getting smaller.",
            )
        )
    level = percent(100 * data.level, 4)
    blocks += [
        Plot(
            "nyquist",
            f"Loop gain with its {level} ellipses, whole and around -1. The dash-dotted circle is the "
            "modulus margin "
            "asked for; the dot is the nearest point of any ellipse.",
        ),
        Plot(
            "sensitivities",
            f"Closed-loop gains: nominal, worst over the {level} ellipses, and what the specification "
            "allows.",
        ),
        *order_blocks(data),
        Code("Controller as JSON (state space, limits, anti-windup)", result.controller.to_json()),
        *prefilter_blocks(data),
    ]
    return Section("design", "Controller design", "Design", tuple(blocks))


def _setting(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float | int):
        return number(float(value), 6)
    if isinstance(value, tuple):
        return " to ".join(number(part) for part in value)
    return str(value)


def margins_section(data: RunData) -> Section:
    """Margins, requirement by requirement, and what was checked and what was not."""
    certificate = data.certificate
    if certificate is None:
        return Section(
            "margins", "Margins and certificate", "Margins", (Text("There is no controller to certify."),)
        )
    asked = data.config.specification
    level = percent(100 * data.certified_level, 4)
    blocks: list[Block] = []
    for verdict in certificate.plants:
        nominal, worst = verdict.nominal_margins, verdict.worst_margins

        def met(achieved: float, required: float | None) -> bool | None:
            return None if required is None else bool(achieved >= required)

        rows = [
            (
                "modulus margin [1]",
                number(nominal.modulus),
                number(worst.modulus),
                number(asked.modulus_margin),
            ),
            ("gain may rise by", decibels(nominal.gain_up), decibels(worst.gain_up), "–"),
            ("gain may fall to", decibels(nominal.gain_down), decibels(worst.gain_down), "–"),
            ("phase margin [deg]", _degrees(nominal.phase_rad), _degrees(worst.phase_rad), "–"),
            (
                "delay margin [ms]",
                number(1e3 * nominal.delay_s),
                number(1e3 * worst.delay_s),
                "–" if asked.delay_margin_s is None else number(1e3 * asked.delay_margin_s),
            ),
        ]
        states = (
            met(worst.modulus, asked.modulus_margin),
            None,
            None,
            None,
            met(worst.delay_s, asked.delay_margin_s),
        )
        blocks += [
            Table(
                ("margin", "nominal", f"worst case over the {level} ellipses", "specification", "met?"),
                tuple((*row, _met(state)) for row, state in zip(rows, states, strict=True)),
                f"Plant {verdict.plant}. Closest to -1 at {frequency(verdict.worst_margin_omega_rad_s)}; "
                f"largest pole radius {number(verdict.pole_radius, 6)}; "
                f"{_bandwidth(verdict.bandwidth_rad_s)}.",
                states,
            )
        ]
    blocks.append(
        Table(
            ("requirement", "plant", "asked for", "worst case", "at", "proved", "met?"),
            tuple(
                (
                    item.requirement,
                    item.plant,
                    f"{number(item.required)} {item.unit}".strip(),
                    f"{number(item.achieved, 4)} {item.unit}".strip(),
                    "–" if item.omega_rad_s is None else frequency(item.omega_rad_s),
                    "–" if item.bound is None else number(item.bound, 4),
                    _met(item.met),
                )
                for item in certificate.items
            ),
            "Every item of the specification. Weighted gains |W ...| are met at 1 or below. Worst case: on "
            "the dense grid; proved: the bound for all frequencies, between the grid's points too.",
            tuple(item.met for item in certificate.items),
        )
    )
    modes = [(v.plant, mode) for v in certificate.plants for mode in v.closed_loop_modes]
    if modes:
        blocks.append(
            Table(
                ("plant", "closed-loop mode [rad/s]", "[Hz]", "damping ratio [1]"),
                tuple(
                    (plant, number(m.omega_rad_s), number(m.omega_rad_s / (2 * math.pi)), number(m.zeta))
                    for plant, m in modes
                ),
                "Oscillatory poles of the nominal closed loop.",
            )
        )
    blocks += [
        *whole_blocks(data),
        Remarks(tuple(map(sentence, certificate.checked)), "good", "What was checked"),
        Remarks(
            tuple(map(sentence, open_words(certificate.not_checked, data.sampled))),
            "warning",
            "What was not checked",
        ),
    ]
    return Section("margins", "Margins and certificate", "Margins", tuple(blocks))


def _bandwidth(omega_rad_s: float) -> str:
    if omega_rad_s > 0:  # false for nan as well
        return f"every member has |S| below -3 dB up to {number(omega_rad_s)} rad/s"
    return "|S| is not below -3 dB at low frequencies for every member"


def _degrees(radians: float) -> str:
    return number(math.degrees(radians)) if math.isfinite(radians) else number(radians)


def _met(state: bool | None) -> str:
    return "–" if state is None else "yes" if state else "NO"


_ONLY_TRACKING = 5  # the first metrics mean something only where the specification asks for tracking
_METRICS = (
    ("rise_time_s", "rise time 10-90 % [s]", 1.0),
    ("overshoot_percent", "overshoot [%]", 1.0),
    ("undershoot_percent", "undershoot [%]", 1.0),
    ("settling_time_s", "settling time to 2 % [s]", 1.0),
    ("steady_error", "steady error [{output}]", 1.0),
    ("peak_command", "largest command [{input}]", 1.0),
    ("limited_fraction", "time at a limit [%]", 100.0),
    ("disturbance_peak", "largest error after the disturbance [{output}]", 1.0),
    ("disturbance_left", "error left at the end [{output}]", 1.0),
)


def closed_loop_section(data: RunData) -> Section:
    """What the loop does over time, predicted and on the machine."""
    title, anchor, short = "Closed loop over time", "closed-loop", "Closed loop"
    if data.closed_loop is None:
        return Section(
            anchor, title, short, (Text("The closed loop was not run: there is no stable controller."),)
        )
    document = data.closed_loop
    channel = data.config.control_channel
    output = data.unit(channel.output) or "as logged"
    command = data.unit(channel.input) or "as logged"
    simulated = document.machine == "simulated"
    draws, settled = document.draws, document.settled_draws
    where = (
        f"{count(draws, 'run')} on the simulated nonlinear arm"
        if simulated
        else f"{count(draws, 'plant')} drawn from the identified uncertainty"
    )
    lead = (
        f"A reference step of {si(document.reference_step, data.unit(channel.output))} and a step "
        "disturbance of "
        f"{si(document.disturbance_step, data.unit(channel.input))} at the plant's input, on the "
        "identified model and in "
        f"{where}"
    )
    if document.quantisation:
        lead += f", commands rounded to {si(document.quantisation, data.unit(channel.input))}"
    lead += f": {settled} of {draws} settled."
    blocks: list[Block] = [Text(lead)]
    if document.filtered:
        words = (
            "Every reference goes through the prefilter, which makes the loop follow its model (dotted in "
            "the picture); the errors below are against the reference itself."
        )
        blocks.append(Text(words))
    if not document.tracking:
        blocks.append(Text("The specification asks for no tracking; the step only shows what the loop does."))
    if simulated and data.config.closed_loop.effects:
        effects = listing([_effect(effect) for effect in data.config.closed_loop.effects])
        blocks.append(Text(f"The arm differs from the one the records came from: {effects}."))
    if not simulated:
        words = (
            "Nothing was run on the real machine here. The plants are linear: friction, backlash and limits "
            "other "
            "than the controller's own are not in them."
        )
        blocks.append(Remarks((words,), "warning"))
    blocks += maybe(_beyond_records(data), "warning")
    blocks.append(
        Plot(
            "closed-loop",
            "Prediction from the identified model against "
            + ("the simulated arm." if simulated else "the spread of plants drawn from the uncertainty."),
        )
    )
    if settled < draws:
        words = (
            f"{count(draws - settled, 'run')} of {draws} did not settle: still moving by more than a tenth "
            f"of the step at the end of either half{', or not there' if document.tracking else ''}. "
            "Advice: look at friction (a steady error, a limit cycle) and at the disturbance's size first."
        )
        blocks.append(Remarks((words,), "warning"))
    rows = []
    for key, words, factor in _METRICS if document.tracking else _METRICS[_ONLY_TRACKING:]:
        predicted = getattr(document.predicted, key)
        label = words.format(output=output, input=command)
        rows.append(
            (
                label,
                _reached(predicted, factor),
                *_range([getattr(row, key) for row in document.achieved], factor),
            )
        )
    first = "arm, first run" if simulated else "first plant"
    head = ("quantity", "predicted", first, f"smallest of {draws}", f"largest of {draws}")
    blocks.append(Table(head, tuple(rows)))
    blocks += maybe(_lasting_error(data), "warning")
    blocks += [*_sensitivity_blocks(data), *_condition_blocks(data)]
    return Section(anchor, title, short, tuple(blocks))


_AGREES_PERCENT = 5.0
_FRICTION_WORDS = (
    "dry friction takes a fixed torque out of a motor torque that shrinks with the reference, so the loop "
    "gain falls, the hub sticks, and |S| goes towards 1"
)


def _sensitivity_blocks(data: RunData) -> list[Block]:
    """The peak of S: predicted, certified, measured on the arm, large and small."""
    assert data.closed_loop is not None
    found = data.closed_loop.sensitivity
    if not found:
        return []
    channel = data.config.control_channel
    unit = data.unit(channel.output)
    nominal, certified, rows = found.nominal_peak, found.certified_peak, found.measured
    large, small = rows[0], rows[1]
    agrees = abs(large.off_nominal_percent) <= _AGREES_PERCENT
    bound = f"certified at most {number(certified, 4)}" if math.isfinite(certified) else "no bound certified"
    words = [
        f"Peak of |S| measured on the arm: {number(large.peak, 4)} (standard deviation "
        f"{number(large.peak_std, 2)}) at {frequency(large.peak_omega_rad_s)}, predicted "
        f"{number(nominal, 4)}, {bound}: measured and predicted are "
        f"{percent(abs(large.off_nominal_percent), 2)} apart."
    ]
    if not agrees:
        words.append(
            "The loop on the arm is not the predicted one: look at friction, at the voltage limit and at the "
            "validation of the model before trusting the margins."
        )
    apart = small.off_nominal_percent
    if abs(apart) > abs(large.off_nominal_percent) and small.peak_std < abs(apart) / 200 * nominal:
        words.append(
            f"With a tenth of the excitation the peak is {percent(abs(apart), 2)} "
            f"{'lower' if apart < 0 else 'higher'} than predicted"
            + (f": {_FRICTION_WORDS}." if apart < 0 else ": the loop is not linear at that size.")
        )
    table = Table(
        (
            "measured on",
            "reference, rms",
            "peak of |S|",
            "at",
            "from nominal",
            "from certified",
            "at a limit",
        ),
        tuple(
            (
                row.name,
                si(row.reference_rms, unit),
                f"{number(row.peak, 4)} ± {number(row.peak_std, 2)}",
                frequency(row.peak_omega_rad_s),
                f"{row.off_nominal_percent:+.2f} %",
                "–" if row.off_certified_percent is None else f"{row.off_certified_percent:+.2f} %",
                percent(100 * row.limited_fraction, 2),
            )
            for row in rows
        ),
        "Random-phase multisines as reference, error over reference; ± one standard deviation. The largest "
        "of many noisy lines lies one to two of them above the true peak.",
    )
    picture = Plot(
        "measured-sensitivity",
        "Sensitivity measured in closed loop on the arm, beside prediction and worst case over the ellipses.",
    )
    return [Remarks(tuple(words), "good" if agrees else "warning", "Sensitivity on the arm"), picture, table]


def _condition_blocks(data: RunData) -> list[Block]:
    """What the loop does where the arm is not the one that was identified."""
    assert data.closed_loop is not None
    rows = data.closed_loop.conditions
    if not rows:
        return []
    channel = data.config.control_channel
    command = data.unit(channel.input)
    table = Table(
        (
            "condition",
            "meaning",
            "largest difference",
            "overshoot",
            "error left",
            f"largest command [{command or 'as logged'}]",
            "settled?",
        ),
        tuple(
            (
                row.name,
                row.words,
                percent(row.largest_difference_percent, 3),
                "–" if row.overshoot_percent is None else percent(row.overshoot_percent, 2),
                percent(row.error_left_percent, 2),
                number(row.peak_command),
                "yes" if row.settled else "NO",
            )
            for row in rows
        ),
        "One run each, otherwise on the arm of the closed-loop check; percent of the move, for the push of "
        "its predicted swing. Difference: achieved from predicted, at its largest.",
        tuple(bool(row.settled) for row in rows),
    )
    picture = Plot(
        "closed-loop-conditions",
        "The loop under other conditions. The prediction knows the model, the controller and its limits; of "
        "payload, delay, friction and converters it knows nothing, and of a push at the tip how it moves the "
        "free arm.",
    )
    unsettled = [row.name for row in rows if not row.settled]
    words = (f"The loop does not settle with: {listing(unsettled)}.",) if unsettled else ()
    return [picture, table, *maybe(words, "warning")]


def _beyond_records(data: RunData) -> tuple[str, ...]:
    """A remark where the loop commands far more than the model was ever shown."""
    if data.closed_loop is None:
        return ()
    channel = data.config.control_channel
    seen = max(
        float(np.max(np.abs(item.record.siso(channel.input, channel.output).input)))
        for item in data.records
        if item.role == "estimation"
    )
    peak = float(data.closed_loop.predicted.peak_command)
    if not peak > 1.5 * seen:
        return ()
    unit = data.unit(channel.input)
    return (
        f"The command reaches {si(peak, unit)}, {number(peak / seen, 2)} times the largest input in "
        f"the records of the fit ({si(seen, unit)}): how the arm answers there is not known. "
        "Advice: set effort_limit or input_limit in [specification], or take a smaller "
        "closed_loop.reference_step.",
    )


def _lasting_error(data: RunData) -> tuple[str, ...]:
    """A remark where a constant disturbance leaves a large part of the reference step as error for good."""
    if data.closed_loop is None or not data.closed_loop.tracking:
        return ()
    document = data.closed_loop
    left, step = abs(document.predicted.disturbance_left), document.reference_step
    if not left > 0.05 * step:
        return ()
    if data.config.specification.integrator:
        until, advice = "at the end of the run", "a larger bandwidth_rad_s"
    else:
        until, advice = "for good", "integrator = true in [specification]"
    channel = data.config.control_channel
    return (
        f"A constant disturbance of {si(document.disturbance_step, data.unit(channel.input))} "
        f"leaves {si(left, data.unit(channel.output))} of error {until}, "
        f"{percent(100 * left / step, 2)} of the reference step. The specification asks for nothing better; "
        f"where that matters: {advice}.",
    )


def _effect(effect: Mapping[str, Any]) -> str:
    parameters = ", ".join(f"{key} = {value}" for key, value in effect.items() if key != "name")
    return f"{effect['name']} ({parameters})"


def _reached(value: float | None, factor: float) -> str:
    return "not reached" if value is None else number(factor * value)


def _range(values: Sequence[float | None], factor: float) -> tuple[str, str, str]:
    """First, smallest and largest; a run that never got there is larger than every other."""
    known = [value for value in values if value is not None]
    smallest = _reached(min(known) if known else None, factor)
    largest = "not reached" if len(known) < len(values) else _reached(max(known), factor)
    return _reached(values[0], factor), smallest, largest


def notes_section(data: RunData) -> Section:
    """What the user says about the rig."""
    notes = data.config.notes
    blocks: list[Block] = [
        *maybe(tuple(notes.known), "good", "Known"),
        *maybe(tuple(notes.unknown), "warning", "Not known"),
    ]
    if not blocks:
        blocks = [Text("The configuration says nothing about the rig ([notes] known, unknown).")]
    return Section("rig", "What is known about the rig", "Rig", tuple(blocks))
