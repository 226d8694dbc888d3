"""The sections of the page from records to closed loop: every sentence is made from the numbers beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from control_design.synthesis import Outcome
from workflow.config import SimulatedSource
from workflow.report.data import ChannelData, RunData
from workflow.report.page import Block, Code, Plot, Remarks, Section, Table, Text, heading, maybe
from workflow.report.pictures import channel_picture, fresh_index, residual_tests, shown_pair
from workflow.report.words import count, decibels, frequency, listing, number, percent, sentence

_ROLE = {"estimation": "estimation", "validation": "validation", "repeat": "repeat"}
_NOT_A_REQUIREMENT = {"structure", "controller_order", "computational_delay_samples"}


def records_section(data: RunData) -> Section:
    """What was measured."""
    abouts = data.about_records
    roles = [about["role"] for about in abouts]
    where = (
        "simulated with the arm below"
        if isinstance(data.config.source, SimulatedSource)
        else "read from files"
    )
    duration = sum(about["duration_s"] for about in abouts)
    uses = (
        ("estimation", "to estimate from"),
        ("validation", "kept for validation"),
        ("repeat", "as repeats"),
    )
    split = listing([f"{roles.count(role)} {words}" for role, words in uses if role in roles])
    lead = (
        f"{count(len(abouts), 'record')} ({number(duration)} s in all, sampled every "
        f"{number(1e3 * abouts[0]['dt_s'])} ms) {'was' if len(abouts) == 1 else 'were'} {where}: {split}."
    )
    rows = tuple(
        (
            str(index),
            about["name"],
            _ROLE[about["role"]],
            about["kind"],
            f"{about['samples']}",
            number(about["duration_s"]),
            "closed" if about["closed_loop"] else "open",
            "; ".join(part for part in (about["condition"], about["remark"]) if part),
        )
        for index, about in enumerate(abouts, 1)
    )
    head = ("no.", "record", "used for", "kind", "samples", "length [s]", "loop", "condition, remark")
    blocks: list[Block] = [
        Text(lead),
        Plot(
            "records", "All records one after another on one time axis; shading says what each is used for."
        ),
        Table(head, rows),
    ]
    if isinstance(data.config.source, SimulatedSource) and data.config.source.effects:
        effects = tuple(
            (str(effect["name"]), ", ".join(f"{k} = {v}" for k, v in effect.items() if k != "name"))
            for effect in data.config.source.effects
        )
        blocks.append(Table(("effect on the simulated arm", "parameters"), effects))
    if "validation" not in roles:
        blocks.append(
            Remarks(
                (
                    "No record was kept back for validation: how the model does on fresh data is not known. "
                    "Advice: "
                    "give one record role = 'validation'.",
                ),
                "warning",
            )
        )
    return Section("records", "Excitation and records", "Records", tuple(blocks))


def identification_section(data: RunData) -> Section:
    """What was found in the records."""
    blocks: list[Block] = [
        Text(
            "A generalised orthonormal basis was fitted to each channel: poles by global search and descent, "
            "coefficients by least squares."
        )
    ]
    for index, channel in enumerate(data.channels):
        blocks += _identified(data, index, channel)
    return Section("identification", "Identified models", "Identification", tuple(blocks))


def _identified(data: RunData, index: int, channel: ChannelData) -> list[Block]:
    about = channel.identified
    model = channel.result.identification.model
    single = len(data.channels) == 1
    blocks: list[Block] = [] if single else [heading(f"Channel {channel.label}")]
    parts = [f"order {about['order']}"]
    if about["integrators"]:
        parts.append(f"{count(about['integrators'], 'integrator')} given as known")
    if about["input_delay_samples"]:
        parts.append(f"{count(about['input_delay_samples'], 'sample')} of input delay")
    if about["feedthrough"]:
        parts.append("a direct term")
    of = "Fit to"
    if about["increments"]:
        of = "Fitted to the differences from sample to sample, so that drift weighs less. Fit to those of"
    fits = listing([f"{percent(fit)} ({name})" for name, fit in about["fit_estimation_percent"].items()])
    blocks.append(
        Text(
            f"{about['input']} to {about['output']}: {listing(parts)}, found with "
            f"{about['search_evaluations']} evaluations of the error. {of} the records used: {fits}."
        )
    )
    modes = tuple(
        (number(m["frequency_Hz"], 4), number(m["omega_rad_s"], 4), number(m["damping"]))
        for m in about["modes"]
    )
    reals = tuple((number(z, 6), _rate(z, model.dt_s)) for z in about["real_poles_z"])
    if modes:
        blocks.append(Table(("pole pair: frequency [Hz]", "[rad/s]", "damping ratio [1]"), modes))
    if reals:
        blocks.append(Table(("real pole z [1]", "decay rate [1/s]"), reals))
    pair = shown_pair(channel)
    if pair is not None:
        omega = float(model.poles.omega_rad_s(model.dt_s)[pair])
        blocks.append(
            Plot(
                channel_picture("error-surface", index, channel.label),
                f"Error over frequency and damping of the pair at {frequency(omega)}, the other poles held "
                "where they "
                "were found, coefficients fitted anew at every point. Dots: points a global search tried "
                "for this "
                "pair, then still without the poles found later.",
            )
        )
    loop = index == data.config.control_index and data.has_controller
    blocks.append(
        Plot(
            channel_picture("poles", index, channel.label),
            "Poles in the z-plane"
            + (", and those of the closed loop with the controller below." if loop else "."),
        )
    )
    blocks += [
        *maybe(tuple(map(sentence, about["warnings"])), "warning", "To look at before trusting this model")
    ]
    staged = about.get("two_stage")
    blocks += maybe((sentence(staged),) if staged else (), "note", "Records made in closed loop")
    blocks += [*maybe(tuple(map(sentence, about["verdicts"])), "note", "What the data decided")]
    if len(about["order_table"]) > 1:
        best = min(step["criterion"] for step in about["order_table"])
        steps = tuple(
            (
                str(step["n_real"]),
                str(step["n_pairs"]),
                number(step["rss"], 4),
                f"{step['criterion'] - best:.1f}",
            )
            for step in about["order_table"]
        )
        head = ("real poles", "pairs", "residual sum of squares", "criterion above the best")
        blocks.append(Table(head, steps, "Structures tried; the smallest criterion wins."))
    return blocks


def _rate(z: float, dt_s: float) -> str:
    """Decay rate of a real pole; one at or left of the origin has no counterpart in continuous time."""
    return number(-math.log(z) / dt_s, 4) if z > 0 else "none (z is not positive)"


def uncertainty_section(data: RunData) -> Section:
    """How sure the models are, and what the residuals say."""
    blocks: list[Block] = []
    for index, channel in enumerate(data.channels):
        blocks += _uncertain(data, index, channel)
    return Section("uncertainty", "How sure: ellipses and validation", "Uncertainty", tuple(blocks))


def _uncertain(data: RunData, index: int, channel: ChannelData) -> list[Block]:
    about, label = channel.uncertain, channel.label
    level = percent(100 * about["level"], 4)
    bands: Sequence[Mapping[str, float]] = about["bands"]
    narrow = min(bands, key=lambda band: band["median_radius_percent"])
    wide = max(bands, key=lambda band: band["median_radius_percent"])
    blocks: list[Block] = [] if len(data.channels) == 1 else [heading(f"Channel {label}")]
    blocks += [
        Text(
            f"Method '{about['method']}'. The {level} ellipses are narrowest between "
            f"{number(narrow['from_rad_s'])} and "
            f"{number(narrow['to_rad_s'])} rad/s (median radius {percent(narrow['median_radius_percent'])} "
            "of the gain) "
            f"and widest between {number(wide['from_rad_s'])} and {number(wide['to_rad_s'])} rad/s "
            f"({percent(wide['median_radius_percent'])}). The level holds at each frequency taken alone."
        ),
        Plot(
            channel_picture("bode", index, label),
            f"Identified response with the range of gain and phase over its {level} ellipses, and the size "
            "of the "
            "ellipses beside the gain.",
        ),
        Table(
            ("from [rad/s]", "to [rad/s]", "median ellipse / gain [%]", "largest [%]"),
            tuple(
                (
                    number(band["from_rad_s"]),
                    number(band["to_rad_s"]),
                    number(band["median_radius_percent"]),
                    number(band["largest_radius_percent"]),
                )
                for band in bands
            ),
        ),
    ]
    nominal = about["nominal"]
    blocks.append(
        Text(
            "The nominal model of the design lies inside its ellipse at "
            f"{percent(nominal['share_inside_percent'])} "
            f"of these frequencies; farthest out at {frequency(nominal['at_rad_s'])}, "
            f"{number(nominal['largest_distance'])} times the ellipse's own radius from its centre."
        )
    )
    beyond = [band for band in bands if band["median_radius_percent"] > 100]
    if beyond:
        blocks.append(
            Remarks(
                tuple(
                    f"Between {number(band['from_rad_s'])} and {number(band['to_rad_s'])} rad/s the "
                    "ellipses are larger "
                    "than the response itself: gain and phase are not known there. Advice: excite this "
                    "band, or keep "
                    "the controller out of it."
                    for band in beyond
                ),
                "warning",
            )
        )
    return blocks + _validated(data, index, channel)


def _validated(data: RunData, index: int, channel: ChannelData) -> list[Block]:
    about, label = channel.identified, channel.label
    blocks: list[Block] = []
    fresh = fresh_index(data, channel)
    fits = [
        *((name, fit, "validation") for name, fit in about["fit_validation_percent"].items()),
        *((name, fit, "repeat") for name, fit in about["fit_repeat_percent"].items()),
    ]
    what = "of the output's differences from sample to sample" if about["increments"] else "of the output"
    if fits:
        worst_name, worst, _ = min(fits, key=lambda entry: entry[1])
        unseen = f"On {count(len(fits), 'record')} that the fit has not seen"
        range_of = f"between {percent(worst)} ({worst_name}) and {percent(max(fit for _, fit, _ in fits))}"
        if len(fits) == 1:
            unseen, range_of = f"On the record {worst_name}, which the fit has not seen", percent(worst)
        blocks.append(Text(f"{unseen}, the model run freely reproduces {range_of} {what}."))
        if worst < 50 and not about["increments"]:
            blocks.append(
                Remarks(
                    (
                        f"On {worst_name} the model misses more than half of the output. Advice: look at "
                        "the residual "
                        "below; dry friction, drift or another operating point are common causes.",
                    ),
                    "warning",
                )
            )
    caption = "Measured output and free run of the model, and the difference."
    if fresh is None:
        caption += " There is no fresh record; this one was used in the fit."
    blocks.append(Plot(channel_picture("validation", index, label), caption))
    if len(fits) > 1:
        rows = tuple((name, role, number(fit, 4)) for name, fit, role in fits)
        blocks.append(Table(("fresh record", "kept as", "fit [%]"), rows))
    tests = channel.uncertain["tests"]
    if {"whiteness", "independence"} <= residual_tests(channel).keys():
        blocks.append(
            Plot(
                channel_picture("residuals", index, label),
                "Correlation of the residuals with themselves and with the past input. The verdict takes "
                "all lags "
                "together; single lags outside their own band are expected now and then.",
            )
        )
    failed = [test for test in tests if not test["passed"]]
    passed = [test for test in tests if test["passed"]]
    blocks += maybe(
        tuple(f"{_on(test)}: {test['verdict']}" for test in failed), "warning", "Residual tests that fail"
    )
    blocks += maybe(
        tuple(f"{_on(test)}: {test['verdict']}" for test in passed), "good", "Residual tests that pass"
    )
    scatter = channel.uncertain["repeat_scatter"]
    if scatter:
        blocks += [
            Plot(
                channel_picture("repeats", index, label),
                "Scatter between repeats of the same experiment against what the ellipses of one repeat "
                "predict.",
            ),
            _scatter_table(scatter),
        ]
    return blocks


def _behind(about: Mapping[str, Any]) -> str:
    """Which residuals the whiteness test looks at."""
    report = about["report"]
    order = len(report["ar_coefficients"]) if report else 0
    return f" (behind the noise model of order {order})" if order else ""


def _on(test: Mapping[str, Any]) -> str:
    return "Records of the fit" if test["data"] == "estimation" else f"Record {test['data']}"


def _scatter_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    between = any(not math.isnan(row["between"]) for row in rows)
    head: tuple[str, ...] = (
        "from [rad/s]",
        "to [rad/s]",
        "predicted / gain [%]",
        "measured / gain [%]",
        "measured / predicted [1]",
    )
    cells = []
    for row in rows:
        cell = [number(row["omega_low_rad_s"]), number(row["omega_high_rad_s"])]
        cell += [number(100 * row["predicted"]), number(100 * row["measured"]), number(row["ratio"])]
        if between:
            cell += [number(100 * row["between"]), number(row["between_ratio"])]
        cells.append(tuple(cell))
    if between:
        head += ("between conditions / gain [%]", "over noise alone [1]")
    return Table(head, tuple(cells), "Scatter is RMS over the band, one standard deviation.")


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
    blocks: list[Block] = [
        Text(
            f"A controller of order {asked.controller_order} ({asked.structure}) with "
            f"{count(asked.computational_delay_samples, 'sample')} of computational delay was optimised "
            "over the "
            "ellipses against these requirements."
        ),
        Table(("requirement", "asked for", "meaning"), tuple(rows)),
    ]
    result = data.synthesis
    if result is None:
        reason = str(data.design.get("reason", "the design stage left no result"))
        blocks.append(Remarks((sentence(reason),), "warning", "No controller was sought"))
        return Section("design", "Controller design", "Design", tuple(blocks))
    converged = [start for start in result.starts if start.gamma_dense is not None]
    blocks.append(
        Text(
            f"Outcome: {result.explain()}. {len(converged)} of {count(len(result.starts), 'start')} ended "
            "in a "
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
        Code("Controller as JSON (state space, limits, anti-windup)", result.controller.to_json()),
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
    level = percent(100 * data.level, 4)
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
                "largest pole "
                f"radius {number(verdict.pole_radius, 6)}; every member has |S| below -3 dB up to "
                f"{number(verdict.bandwidth_rad_s)} rad/s.",
                states,
            )
        ]
    blocks.append(
        Table(
            ("requirement", "plant", "asked for", "worst case", "at", "met?"),
            tuple(
                (
                    item.requirement,
                    item.plant,
                    f"{number(item.required)} {item.unit}".strip(),
                    f"{number(item.achieved, 4)} {item.unit}".strip(),
                    "–" if item.omega_rad_s is None else frequency(item.omega_rad_s),
                    _met(item.met),
                )
                for item in certificate.items
            ),
            "Every item of the specification. Weighted gains |W ...| are met at 1 or below.",
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
        Remarks(tuple(map(sentence, certificate.checked)), "good", "What was checked"),
        Remarks(tuple(map(sentence, certificate.not_checked)), "warning", "What was not checked"),
    ]
    return Section("margins", "Margins and certificate", "Margins", tuple(blocks))


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
    document = data.closed_loop.document
    channel = data.config.control_channel
    output = data.unit(channel.output) or "as logged"
    command = data.unit(channel.input) or "as logged"
    simulated = document["machine"] == "simulated"
    draws, settled = document["draws"], document["settled_draws"]
    where = (
        f"{count(draws, 'run')} on the simulated nonlinear arm"
        if simulated
        else f"{count(draws, 'plant')} drawn from the identified uncertainty"
    )
    lead = (
        f"A reference step of {number(document['reference_step'])} {output} and a step disturbance of "
        f"{number(document['disturbance'])} {command} at the plant's input, on the identified model and in "
        f"{where}"
    )
    if document["quantisation"]:
        lead += f", commands rounded to {number(document['quantisation'])} {command}"
    lead += f": {settled} of {draws} settled."
    blocks: list[Block] = [Text(lead)]
    if not document["tracking"]:
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
            f"of the step at the end of either half{', or not there' if document['tracking'] else ''}. "
            "Advice: look at friction (a steady error, a limit cycle) and at the disturbance's size first."
        )
        blocks.append(Remarks((words,), "warning"))
    achieved: Sequence[Mapping[str, Any]] = document["achieved"]
    rows = []
    for key, words, factor in _METRICS if document["tracking"] else _METRICS[_ONLY_TRACKING:]:
        predicted = document["predicted"][key]
        label = words.format(output=output, input=command)
        rows.append((label, _reached(predicted, factor), *_range([row[key] for row in achieved], factor)))
    first = "arm, first run" if simulated else "first plant"
    head = ("quantity", "predicted", first, f"smallest of {draws}", f"largest of {draws}")
    blocks.append(Table(head, tuple(rows)))
    return Section(anchor, title, short, tuple(blocks))


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
