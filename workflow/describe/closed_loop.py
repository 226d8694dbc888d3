"""The closed loop over time: what was predicted, and what its runs did."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from control_design.specification import Specification
from control_design.specification.requirement import LoopFunction
from ident.data.arrays import RealArray
from workflow.config.run_config import RunConfig
from workflow.describe.certificate import (
    bandwidth_row,
    certified_bandwidth_rad_s,
    modulus_row,
)
from workflow.describe.facts import (
    ON_THE_FIRST_SCREEN,
    Block,
    Fold,
    PageSection,
    Picture,
    Quantity,
    Remarks,
    Row,
    Section,
    Table,
    Text,
    said,
    worded,
)
from workflow.describe.friction import (
    beside_recorded,
    friction_blocks,
    friction_exceeds,
    friction_step,
    settling_range,
    stands_still,
    sticking,
)
from workflow.describe.loop_metrics import LOOP_METRICS
from workflow.engine import codec
from workflow.tasks.results import ClosedLoopResult, LoopCheck, MeasuredPeak, RunResults
from workflow.text.formats import (
    both_frequencies,
    count,
    extent,
    listing,
    number,
    percent,
    setting,
    share,
    si,
    signed,
    yes_no,
)

if TYPE_CHECKING:
    from workflow.figures.subjects import RunView

# Where rows of `LOOP_METRICS` stand in the JSON answer.
METRICS_AT = "closed_loop"
# Anchor, title and short name of the section of a page.
_PAGE = ("closed-loop", "Closed loop over time", "Closed loop")
# Largest command over the largest recorded input from which on the records tell nothing of it; chosen.
_BEYOND_RECORDED = 1.5
# Percent between measured and predicted peak of |S| up to which they agree; chosen.
_AGREES_PERCENT = 5.0
# Share of the reference step from which on an error that a constant disturbance leaves is worth a word.
_LARGE_ERROR = 0.05


@dataclass(frozen=True, eq=False)
class MeasuredBeyond:
    """A measurement of |S| beyond what is certified.

    cause: what sets its arm apart: "effects" (the arm of the closed-loop check), "size" (the arm as
    identified with a small reference, where friction weighs more), or "model" (nothing but friction and what
    else is not linear). limit (F,): the specification at the lines, infinite where nothing is asked for.
    line: where |S| exceeds it most, bandwidth_line: where it exceeds -3 dB most up to the certified
    bandwidth; None: nowhere.
    """

    measured: MeasuredPeak
    cause: str
    limit: RealArray
    line: int | None
    bandwidth_line: int | None
    bandwidth_rad_s: float


def spread(check: LoopCheck, metric: str, unit: str) -> str:
    """A metric, predicted and over the runs: "predicted 3.12 %, achieved 3.47 to 3.78 % (2 never)"."""
    predicted = getattr(check.predicted, metric)
    values = [getattr(row, metric) for row in check.achieved]
    reached = [value for value in values if value is not None]
    never = len(values) - len(reached)
    first = "never" if predicted is None else si(predicted, unit, 4)
    if not reached:
        return f"predicted {first}, achieved never"
    achieved = f"{extent(reached)} {unit}".rstrip()
    some_never = f" ({never} never)" if never else ""
    return f"predicted {first}, achieved {achieved}{some_never}"


def largest(check: LoopCheck, metric: str, more: Sequence[float | None] = ()) -> float | None:
    """The largest value of a metric over prediction, runs and more; None where one never gets there."""
    values = [getattr(row, metric) for row in (check.predicted, *check.achieved)]
    values += more
    return None if None in values else max(values)


def metric_rows(check: LoopCheck, input_unit: str, output_unit: str) -> tuple[Row, ...]:
    """A row for each of `LOOP_METRICS`, with what was predicted and the runs beside it.

    The text is the largest of prediction and runs. Programs get the prediction, the smallest and the largest
    of the runs; null where a run never gets there.
    """
    rows = []
    for metric in LOOP_METRICS:
        unit = metric.unit or input_unit
        largest_text = Quantity.of(largest(check, metric.name), unit).text
        remark = spread(check, metric.name, unit)
        if metric.name == "settling_time_s":
            largest_text, with_friction = _settling(check, output_unit)
            remark += f"; {with_friction}"
        if metric.name == "peak_command" and check.input_limit is not None:
            remark += f"; limit {si(check.input_limit, unit)}"
        _, smallest_run, largest_run = check.spread_of(metric.name)
        predicted = getattr(check.predicted, metric.name)
        plain = {"predicted": predicted, "smallest": smallest_run, "largest": largest_run}
        value = Quantity(largest_text, plain, unit)
        rows.append(Row(f"{METRICS_AT}.{metric.name}", metric.label, value, remark))
    return tuple(rows)


def _settling(check: LoopCheck, output_unit: str) -> tuple[str, str]:
    """The longest settling time, with friction those of steps of half to twice the size included; and what
    friction does to it."""
    friction = check.friction
    linear_s = largest(check, "settling_time_s")
    if friction is None:
        return Quantity.of(linear_s, "s").text, "friction was not identified"
    held = sticking(friction, output_unit) or f"with dry friction {settling_range(friction.settling)}"
    worst_s = friction.settling.worst_s
    if worst_s is not None:
        return Quantity.of(largest(check, "settling_time_s", (worst_s,)), "s").text, held
    if linear_s is None:
        return Quantity.of(None, "s").text, held
    return f"over {si(friction.settling.watched_s, 's')}", held


def not_the_arm(check: LoopCheck | None, bandwidth_rad_s: float, effects: Sequence[Mapping[str, Any]]) -> str:
    """Says that an arm on which |S| was measured has a smaller bandwidth; "" elsewhere.

    Args:
        check: None: nothing was measured.
        bandwidth_rad_s: That is certified.
        effects: Of the arm of the closed-loop check, the third that is measured.
    """
    if check is None or check.sensitivity is None:
        return ""
    arms = []
    for index, measured in enumerate(check.sensitivity.measured):
        if measured.beyond_bandwidth(bandwidth_rad_s) is None:
            continue
        of_the_check = index == 2
        if of_the_check:
            arms.append(f"with {listing(effect['name'] for effect in effects)}")
        else:
            arms.append(f"on the {measured.name}")
    return f"; measured less {listing(arms)}" if arms else ""


def loop_numbers(results: RunResults, config: RunConfig) -> tuple[Row, ...]:
    """The numbers of a run of one loop that everybody sees first."""
    certificate = results.certify.certificate
    check = results.closed_loop.check
    asked = results.design.specification or config.specification
    input_unit = results.records.unit(config.control_channel.input)
    output_unit = results.records.unit(config.control_channel.output)
    rows = []
    if certificate is not None and results.design.controller is not None:
        bandwidth = certified_bandwidth_rad_s(certificate)
        smaller = not_the_arm(check, bandwidth, config.closed_loop.effects)
        rows.append(bandwidth_row(certificate, f"every plant has |S| below -3 dB up to here{smaller}"))
        rows.append(modulus_row(certificate, asked.modulus_margin))
    if check is None:
        return tuple(rows)
    shown = {metric.name for metric in LOOP_METRICS if check.tracking or not metric.of_tracking}
    metrics = metric_rows(check, input_unit, output_unit)
    rows += [row for row in metrics if row.key.removeprefix(f"{METRICS_AT}.") in shown]
    if not check.tracking:
        error = Quantity.of(check.lasting_error, output_unit)
        disturbance = f"under a constant {si(check.disturbance_step, input_unit)} disturbance"
        rows.append(Row("closed_loop.steady_state_error", "steady-state error", error, disturbance))
    return tuple(rows)


def loop_section(loop: ClosedLoopResult, input_unit: str, output_unit: str, *, feedforward: bool) -> Section:
    """The closed loop beyond its first numbers. feedforward: of the friction, on in this run."""
    check = loop.check
    if check is None:
        return Section("closed loop", said(worded("not run", loop.skipped or "")))
    linear = check.friction is not None and check.machine != "simulated"
    runs = f"{check.settled_draws} of {check.draws} settle, "
    if check.machine == "simulated":
        runs += "on the simulated arm"
    else:
        runs += "with linear plants drawn from the uncertainty set"
    runs += ", without dry friction" if linear else ""
    disturbance = f"under a constant {si(check.disturbance_step, input_unit)} disturbance"
    left = f"{si(check.lasting_error, output_unit)} {disturbance}"
    rows: list[Row | None] = [worded("runs", runs), worded("steady-state error", left)]
    friction = check.friction
    if friction is not None:
        rows += [
            worded("sticking", sticking(friction, output_unit)),
            worded("with friction", f"{friction_step(friction, output_unit)} (simulated)"),
            worded("recorded loop", beside_recorded(friction, output_unit)),
            worded("small sines", stands_still(friction.tracking, output_unit, feedforward=feedforward)),
            worded("friction", friction_exceeds(friction, output_unit)),
        ]
    if check.conditions:
        restless = [run.name for run in check.conditions if not run.settled]
        settled = len(check.conditions) - len(restless)
        text = f"{settled} of {len(check.conditions)} settle"
        if restless:
            text += f", not: {', '.join(restless)}"
        rows.append(worded("other conditions", text))
    return Section("closed loop", said(*rows))


def lasting_error(check: LoopCheck, specification: Specification) -> str:
    """A constant disturbance that leaves a large part of the reference step as error; "" where not."""
    if not check.tracking or check.lasting_error <= _LARGE_ERROR * check.reference_step:
        return ""
    remedy = "The controller has no integrator; integrator = true in [specification] removes this error"
    if specification.integrator:
        remedy = "A larger bandwidth_rad_s shortens the recovery"
    left = share(check.lasting_error / check.reference_step, 2)
    return f"the constant disturbance leaves {left} of the reference step as error. {remedy}"


def closed_loop_numbers(loop: ClosedLoopResult) -> dict[str, Any]:
    """The check for programs, without its signals."""
    if loop.check is None:
        return {"skipped": loop.skipped}
    check = loop.check
    counts = {"skipped": None, "draws": check.draws, "settled_draws": check.settled_draws}
    return {**counts, **codec.plain(check, arrays=False)}


def measured_beyond(results: RunResults, config: RunConfig) -> list[MeasuredBeyond]:
    """Measurements of |S| on an arm that contradict the specification or the certified bandwidth, which are
    about linear plants in the uncertainty set."""
    check = results.closed_loop.check
    certificate = results.certify.certificate
    if check is None or check.sensitivity is None or certificate is None:
        return []
    specification = results.design.specification or config.specification
    plant = results.uncertainty.plant(config)
    bandwidth = min(verdict.bandwidth_rad_s for verdict in certificate.plants)
    contradictions = []
    for index, measured in enumerate(check.sensitivity.measured):
        # The arm as identified at two sizes of the reference, then that of the closed-loop check.
        cause = ("model", "size")[index] if index < 2 else "effects"
        weight = specification.magnitude(plant, measured.omega_rad_s, LoopFunction.SENSITIVITY)
        limit = np.divide(1.0, weight, out=np.full_like(weight, np.inf), where=weight > 0)
        contradiction = MeasuredBeyond(
            measured, cause, limit, measured.beyond(limit), measured.beyond_bandwidth(bandwidth), bandwidth
        )
        if contradiction.line is not None or contradiction.bandwidth_line is not None:
            contradictions.append(contradiction)
    return contradictions


def effects_text(effects: Sequence[Mapping[str, Any]]) -> str:
    """Effects with their parameters: "friction (torque_Nm = 0.04) and tip_payload (mass_kg = 0.1)"."""
    return listing(f"{effect['name']} ({setting(effect)})" for effect in effects)


def measured_beyond_text(found: MeasuredBeyond, effects: Sequence[Mapping[str, Any]]) -> str:
    """Why |S| measured on an arm is beyond what is certified.

    Args:
        found: The measurement.
        effects: Of the arm of the closed-loop check.
    """
    row = found.measured
    causes = {
        "effects": f"with {effects_text(effects)}: the records were made without",
        "size": "as identified at small references, where dry friction weighs more",
        "model": "as identified: it has friction, or the model is not right",
    }
    about = causes[found.cause]
    places = []
    if found.line is not None:
        magnitude = number(row.magnitude[found.line])
        omega = number(row.omega_rad_s[found.line])
        limit = number(found.limit[found.line])
        places.append(f"{magnitude} at {omega} rad/s (specification: below {limit})")
    if found.bandwidth_line is not None:
        magnitude = number(row.magnitude[found.bandwidth_line])
        omega = number(row.omega_rad_s[found.bandwidth_line])
        places.append(
            f"{magnitude} at {omega} rad/s, where every plant in the uncertainty set is below -3 dB (0.707)"
        )
    return f"the certificate does not cover the arm {about}. Measured |S| is {' and '.join(places)}"


def closed_loop_page(view: RunView) -> PageSection:
    """What the loop does over time, predicted and on the machine."""
    results = view.results
    check = results.closed_loop.check
    if check is None:
        why = results.closed_loop.skipped or "there is no stable controller"
        return PageSection(*_PAGE, (Text(f"The closed loop was not run: {why}."),))
    blocks = _what_was_run(check, view)
    blocks.append(Picture("closed-loop", "The step and the disturbance.", (view,)))
    if check.settled_draws < check.draws:
        at_the_end = " and is there" if check.tracking else ""
        blocks.append(
            Remarks(
                (
                    f"A run settles when it moves by less than a tenth of the step at the end of either "
                    f"half{at_the_end}. Look at friction first (a steady-state error, a limit cycle), then "
                    "at the size of the disturbance.",
                ),
                "warning",
            )
        )
    further_rows = loop_numbers(results, view.config)[ON_THE_FIRST_SCREEN:]
    blocks.append(_metrics_table(check, view.output_unit, further_rows))
    blocks += _sensitivity_blocks(check, view)
    if check.friction is not None:
        blocks.append(Fold("Dry friction in the loop", tuple(friction_blocks(check, view))))
    blocks += _condition_blocks(check, view)
    return PageSection(*_PAGE, tuple(blocks))


def _what_was_run(check: LoopCheck, view: RunView) -> list[Block]:
    """Reference, disturbance and plants of the runs, and what is doubtful about them."""
    config = view.config
    input_unit = view.input_unit
    simulated = check.machine == "simulated"
    plants = f"{count(check.draws, 'plant')} drawn from the identified uncertainty"
    if simulated:
        plants = f"{count(check.draws, 'run')} on the simulated nonlinear arm"
        if config.closed_loop.effects:
            effects = effects_text(config.closed_loop.effects)
            plants += f" with {effects}, which the records were made without"
    rounded = ""
    if check.quantisation:
        rounded = f", commands rounded to {si(check.quantisation, input_unit)}"
    blocks: list[Block] = [
        Text(
            f"Simulated: a reference step of {si(check.reference_step, view.output_unit)} and a step "
            f"disturbance of {si(check.disturbance_step, input_unit)} at the plant's input, on the "
            f"identified model and in {plants}{rounded}."
        )
    ]
    if check.filtered:
        blocks.append(Text("The reference is filtered; errors are against the unfiltered one."))
    if not check.tracking:
        blocks.append(Text("The specification requires no tracking; the step only shows what the loop does."))
    if not simulated:
        friction = "friction, " if check.friction is None else ""
        blocks.append(
            Remarks(
                (
                    f"Nothing was run on the real machine here. The plants are linear: {friction}backlash "
                    "and limits other than the controller's own are not simulated.",
                ),
                "warning",
            )
        )
    return blocks + _command_remarks(check, view)


def _command_remarks(check: LoopCheck, view: RunView) -> list[Block]:
    """Whether the records tell what happens at the commands of the new loop."""
    input_unit = view.input_unit
    peak = check.predicted.peak_command
    seen = view.largest_recorded(view.config.control_channel.input)
    blocks: list[Block] = []
    if peak > _BEYOND_RECORDED * seen:
        times = number(peak / seen, 2)
        beyond = (
            f"The command reaches {si(peak, input_unit)}, {times} times the largest input in the records of "
            f"the fit ({si(seen, input_unit)}). The records do not show how the arm answers there. Set "
            "effort_limit or input_limit in [specification], or a smaller closed_loop.reference_step."
        )
        blocks.append(Remarks((beyond,), "warning"))
    equivalent = view.results.uncertainty.equivalent
    if equivalent is not None and peak < equivalent.rms:
        below = (
            f"The command peaks at {si(peak, input_unit)}, below the amplitude that the certificate is about "
            f"({si(equivalent.rms, input_unit)} rms). So small a motion meets more friction; see "
            '"Dry friction in the loop". Record with smaller inputs, or describe the arm "without friction".'
        )
        blocks.append(Remarks((below,), "warning"))
    return blocks


def _metrics_table(check: LoopCheck, output_unit: str, further_rows: Sequence[Row]) -> Table:
    """Metrics that are not on the first screen: predicted, smallest and largest of the runs.

    further_rows: of `metric_rows`, for which the first screen has no room.
    """
    unit = output_unit or "as logged"
    metrics = [
        ("limited_fraction", "time at a limit [%]", 100.0),
        ("disturbance_peak", f"largest error after the disturbance [{unit}]", 1.0),
        ("disturbance_left", f"error left by the disturbance [{unit}]", 1.0),
    ]
    if check.tracking:
        metrics = [
            ("undershoot_percent", "undershoot [%]", 1.0),
            ("steady_error", f"steady-state error [{unit}]", 1.0),
            *metrics,
        ]

    def reached(value: float | None, factor: float) -> str:
        return "not reached" if value is None else number(factor * value, 4)

    rows = []
    for row in further_rows:
        name = row.name
        # A run that never gets there has no number, and the table would hide it behind the others.
        metric = row.key.rpartition(".")[2]
        never = [run for run in check.achieved if getattr(run, metric) is None]
        if never:
            name += f" ({len(never)} of {check.draws} runs never)"
        ends = row.value.plain
        values = (ends["predicted"], ends["smallest"], ends["largest"])
        rows.append((f"{name} [{row.value.unit}]", *(reached(value, 1.0) for value in values)))
    for metric, name, factor in metrics:
        _, smallest, greatest = check.spread_of(metric)
        values = (getattr(check.predicted, metric), smallest, greatest)
        rows.append((name, *(reached(value, factor) for value in values)))
    head = ("quantity", "predicted", f"smallest of {check.draws}", f"largest of {check.draws}")
    return Table(head, tuple(rows))


def _sensitivity_blocks(check: LoopCheck, view: RunView) -> list[Block]:
    """|S| as it was measured on the arm, beside the predicted and the certified one.

    That it exceeds what is certified stands on the first screen.
    """
    sensitivity = check.sensitivity
    if sensitivity is None:
        return []
    large, small = sensitivity.measured[0], sensitivity.measured[1]
    agrees = abs(large.off_nominal_percent) <= _AGREES_PERCENT
    certified = "no bound certified"
    if math.isfinite(sensitivity.certified_peak):
        certified = f"certified at most {number(sensitivity.certified_peak, 4)}"
    predicted = number(sensitivity.nominal_peak, 4)
    difference = percent(abs(large.off_nominal_percent), 2)
    said_of = [f"Peak of |S|: predicted {predicted}, {certified}."]
    if not agrees:
        said_of.append(
            f"Measured and predicted are {difference} apart. "
            "The loop on the arm is not the predicted one. Check friction, the voltage limit and the "
            "validation of the model before you trust the margins."
        )
    apart = small.off_nominal_percent
    clearly = small.peak_std < abs(apart) / 200 * sensitivity.nominal_peak  # two standard deviations
    if check.friction is None and abs(apart) > abs(large.off_nominal_percent) and clearly:
        why = "the loop is not linear at that size."
        if apart < 0:
            why = (
                "dry friction takes a fixed torque from a smaller motor torque, so the loop gain falls and "
                "|S| goes towards 1."
            )
        direction = "lower" if apart < 0 else "higher"
        said_of.append(
            f"With a tenth of the excitation the peak is {percent(abs(apart), 2)} {direction} than "
            f"predicted: {why}"
        )
    rows = []
    for row in sensitivity.measured:
        peak = f"{number(row.peak, 4)} ± {number(row.peak_std, 2)}"
        rows.append(
            (
                row.name,
                si(row.reference_rms, view.output_unit),
                peak,
                both_frequencies(row.peak_omega_rad_s),
                signed(row.off_nominal_percent),
                signed(row.off_certified_percent),
                number(100 * row.limited_fraction, 2),
            )
        )
    head = (
        "measured on",
        "reference, rms",
        "peak of |S| [1]",
        "at [rad/s (Hz)]",
        "from nominal [%]",
        "from certified [%]",
        "at a limit [%]",
    )
    return [
        Remarks(tuple(said_of), "good" if agrees else "warning", "Sensitivity measured on the arm"),
        Picture("measured-sensitivity", "|S| measured on the arm.", (view,)),
        Table(
            head,
            tuple(rows),
            "± is one standard deviation. The peak is the largest of many noisy values: it lies one or two "
            "of them too high.",
        ),
    ]


def _condition_blocks(check: LoopCheck, view: RunView) -> list[Block]:
    """The loop under other conditions than it was designed in."""
    if not check.conditions:
        return []
    restless = [run.name for run in check.conditions if not run.settled]
    settled = len(check.conditions) - len(restless)
    rows = []
    for run in check.conditions:
        cells = [
            f"{run.name}: {run.words}",
            number(run.largest_difference_percent),
            number(run.overshoot_percent, 2),
            number(run.error_left_percent, 2),
            number(run.peak_command),
        ]
        if restless:
            cells.append(yes_no(run.settled))
        rows.append(tuple(cells))
    head = [
        "condition",
        "largest difference [%]",
        "overshoot [%]",
        "error left [%]",
        f"largest command [{view.input_unit or 'as logged'}]",
    ]
    # Where all settle the title says so.
    if restless:
        head.append("settles?")
    table = Table(
        tuple(head),
        tuple(rows),
        "One run each; % of the step; for the push, of the predicted swing. Difference: from the prediction.",
        tuple(run.settled for run in check.conditions),
    )
    picture = Picture(
        "closed-loop-conditions",
        "The prediction does not know about payload, delay, friction and converters.",
        (view,),
    )
    title = f"Other conditions: {settled} of {len(check.conditions)} settle"
    blocks: list[Block] = [Fold(title, (picture, table))]
    if restless:
        blocks.append(Remarks((f"The loop does not settle with: {listing(restless)}.",), "warning"))
    return blocks
