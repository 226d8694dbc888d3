"""A run for several joints: models, design, certificate and loop at every operating point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from markupsafe import Markup

from control_design.analysis.multivariable_certificate import MultivariableCertificate
from workflow.describe.certificate import NOT_ON_THE_MACHINE, UNCHECKED
from workflow.describe.facts import (
    Block,
    FirstScreen,
    PageSection,
    Picture,
    Quantity,
    Remarks,
    Row,
    Section,
    Table,
    Text,
    link,
    said,
    worded,
)
from workflow.describe.identification import sentences
from workflow.describe.records import records_section
from workflow.describe.run import first_warning, signals_where_scaled, summary_of
from workflow.describe.summary import RunSummary
from workflow.engine import codec
from workflow.joints.config import JointsConfig
from workflow.joints.results import JointsCertificate, JointsLoopResult, JointsResults, PointModels
from workflow.tasks.results import DesignResult
from workflow.text.findings.sentences import words
from workflow.text.formats import (
    at_least,
    at_most,
    count,
    extent,
    hertz,
    number,
    percent,
    sentence,
    share,
    si,
    yes_no,
)
from workflow.text.sentences.certificate import unknown_at_limits

if TYPE_CHECKING:
    from workflow.figures.subjects import AnyRunView


# Share of the samples of a run at a limit from which on it is worth a sentence; chosen.
_OFTEN_LIMITED = 0.01


def joints_verdict(design: DesignResult, certify: JointsCertificate, settled: int, points: int) -> str:
    """The verdict in one line; settled: operating points where every run settles, of `points`."""
    if design.synthesis is None:
        return f"no controller: {design.reason}"
    if not certify.certified:
        return f"not certified: {design.reason}"
    of = count(points, "operating point")
    if settled < points:
        return f"certified, but the loop does not settle at {points - settled} of {of}"
    return f"certified: every requirement is met, and the loop settles at {settled} of {of}"


def joints_numbers(
    models: PointModels, certify: JointsCertificate, loop: JointsLoopResult, config: JointsConfig
) -> tuple[Row, ...]:
    """The numbers of a run for several joints that everybody sees first."""
    rows = []
    certificate = certify.certificate
    if certificate is not None:
        points = count(len(models.points), "operating point")
        gamma = Quantity(at_most(certificate.gamma, 4), codec.plain(certificate.gamma))
        rows.append(Row("", "worst case", gamma, f"over {points}; needed: 1 or less"))
        # The weakest operating point counts, of sensors and of actuators by itself.
        verdicts = certificate.verdicts
        gains = {
            "sensors": min(verdict.output_disk.gain for verdict in verdicts),
            "actuators": min(verdict.input_disk.gain for verdict in verdicts),
        }
        for name, gain in gains.items():
            key = f"certificate.gain_at_{name}"
            value = Quantity(f"× {at_least(gain)}", codec.plain(gain))
            rows.append(Row(key, f"gain at the {name}", value, "tolerated in all at once, up or down"))

    # The largest overshoot of any joint in any run; nothing where no loop ran.
    settled, total = loop.settled_points()
    if not total:
        return tuple(rows)
    largest = -float("inf")
    place = ""
    for run in loop.runs:
        for joint, overshoot in zip(config.joints, run.overshoot.tolist(), strict=True):
            if overshoot > largest:
                largest = overshoot
                place = f"{joint.output} at {run.point}, {run.condition}"
    overshoot_percent = Quantity.of(100 * largest, "%")
    largest_at = f"largest, of {place}"
    rows.append(Row("closed_loop.overshoot_percent", "overshoot", overshoot_percent, largest_at))
    settles = Quantity(f"{settled} of {total}", settled)
    ran_on = f"operating points, {_machine_words(loop)}"
    rows.append(Row("closed_loop.settled_points", "settles", settles, ran_on))
    return tuple(rows)


def _machine_words(loop: JointsLoopResult) -> str:
    """What the loop ran on: the simulated arm where there is one."""
    if loop.machine == "simulated":
        return "on the nonlinear arm"
    return "on the identified models"


def fit_row(models: PointModels, config: JointsConfig) -> Row:
    """Fit of each output over the operating points, the worst record of each."""
    parts = []
    for index, joint in enumerate(config.joints):
        worst = [point.fit_percent.min(axis=0)[index] for point in models.points]
        parts.append(f"{extent(worst, 3)} % ({joint.output})")
    of_what = ""
    if config.identification.increments:
        of_what = ", of the increments"
    all_parts = ", ".join(parts)
    return worded("fit", f"{all_parts}{of_what}")


def models_section(models: PointModels, config: JointsConfig) -> Section:
    """Every model with its fits, warnings, and the modes of the first."""
    of_what = ""
    if config.identification.increments:
        of_what = " of the increments"

    # Fits of the records that were fitted, the worst of each output, then of those that were kept back.
    rows = []
    for point in models.points:
        worst_fits = point.fit_percent.min(axis=0).tolist()
        fits = ", ".join(percent(fit) for fit in worst_fits)
        states = count(point.states, "state")
        rows.append(worded(point.name, f"{states}, fit {fits}{of_what}"))
    for point in models.points:
        for fresh in point.fresh:
            fits = ", ".join(percent(fit.fit_percent) for fit in fresh)
            rows.append(worded("kept back", f"{fresh[0].name}: fit {fits}"))
    for point in models.points:
        for warning in point.warnings:
            rows.append(worded("warning", f"{point.name}: {words(warning)}"))

    # Modes move little between operating points: those of the first stand for all.
    for omega_rad_s, zeta, moved in models.points[0].modes:
        if moved is None:
            continue
        sizes = [number(size, 2) for size in moved.tolist()]
        joint_names = [joint.output for joint in config.joints]
        moves = [f"{name} {size}" for name, size in zip(joint_names, sizes, strict=True)]
        motion = ", ".join(moves)
        frequency_Hz = number(hertz(omega_rad_s))
        rows.append(worded("mode", f"{frequency_Hz} Hz, damping {number(zeta, 2)}: {motion}"))
    return Section("model", tuple(rows))


def joints_certificate_section(certify: JointsCertificate) -> Section:
    """Worst case at every operating point, and the loop at its limits."""
    rows: list[Row] = []
    if certify.certificate is None:
        return Section("certificate", ())
    for plant in certify.certificate.verdicts:
        if not plant.stable:
            text = "unstable"
        elif plant.obstacle:
            text = plant.obstacle
        else:
            worst_case = number(max(plant.bounds.values()))
            gain = number(plant.output_disk.gain)
            text = (
                f"at most {worst_case} at all frequencies; gains at the sensors may change by {gain} at once"
            )
        rows.append(worded(plant.plant, text))

        # A loop that never meets its limits has no end to look at.
        limited = plant.limited
        if limited is not None and limited.steps:
            met = "NOT met"
            if limited.ends:
                met = "met"
            away_percent = at_most(100 * limited.worst, 3)
            away = f"{away_percent} % away from where it must end (at most 2 %): {met}"
            rows.append(worded(f"{plant.plant}, at the limits", away))
    return Section("certificate", tuple(rows))


def joints_loop_section(loop: JointsLoopResult) -> Section:
    """How many operating points and runs settle."""
    if loop.skipped:
        return Section("closed loop", (worded("not run", loop.skipped),))
    settled, points = loop.settled_points()
    of_points = count(points, "operating point")
    settled_runs = sum(run.settled for run in loop.runs)
    of_runs = count(len(loop.runs), "run")
    machine = _machine_words(loop)
    text = f"at {settled} of {of_points}, {settled_runs} of {of_runs}, {machine}"
    return Section("closed loop", (worded("settles", text),))


def joints_design_section(design: DesignResult, files: str) -> Section:
    """Outcome of the design; files: columns and units of the controller's, where they are not plain."""
    outcome = worded("worst case", design.reason)
    columns = worded("controller files", files)
    return Section("design", said(outcome, columns))


def joints_first_screen(view: AnyRunView) -> FirstScreen:
    """What the page of a run for several joints begins with."""
    config = view.config
    results = view.results
    models = results.identify
    certificate = results.certify.certificate
    loop = results.closed_loop
    settled, points = loop.settled_points()
    holds = results.certified and results.settles
    bullets = [results.design.reason]
    if "as logged" in view.signals:
        bullets.append(
            "The controller's files take and give the columns as logged, this page does not. "
            f"{sentence(view.signals)}"
        )

    # What is wrong comes before what is right: no proof, no rest, a limit that is met often.
    if certificate is not None:
        for plant in certificate.verdicts:
            if plant.obstacle:
                bullets.append(f"{plant.plant}: {plant.obstacle}")
        for run in loop.runs:
            if not run.settled:
                bullets.append(f"{run.point}, {run.condition}: the loop does not settle.")
        for run in loop.runs:
            if run.limited > _OFTEN_LIMITED:
                where = f"{run.point}, {run.condition}"
                limited = share(run.limited)
                bullets.append(f"{where}: an actuator is at its limit for {limited} of the time.")
    if holds:
        level = share(config.identification.level)
        of = count(len(models.points), "operating point")
        unchecked = link("unchecked", "What was not checked")
        bullets.append(Markup("The certificate covers the {} balls at {}. {}.").format(level, of, unchecked))
    if not all(point.shaped for point in models.points):
        bullets.append("Not every mode has one shape; a mode without one has more than two states.")
    headline = "Certified: every requirement is met"
    look: Literal["certified", "refused"] = "certified"
    if not holds:
        # A headline has no full stop.
        verdict = joints_verdict(results.design, results.certify, settled, points)
        headline = sentence(verdict)[:-1]
        look = "refused"
    machine = _machine_words(loop)
    caption = f"A step of all joints at once: {machine}, at every operating point and under every condition."
    picture = Picture("joint-steps", caption, (view,))
    rows = joints_numbers(models, results.certify, loop, config)
    return FirstScreen(headline, look, rows, tuple(bullets), picture)


def joints_pages(view: AnyRunView) -> list[PageSection]:
    """Requirements, closed loop and model of a run for several joints."""
    config = view.config
    names = [joint.output for joint in config.joints]
    results = view.results
    blocks: list[Block] = [
        Picture(
            "joint-requirements",
            "Largest singular value of each weighted function, the worst over the balls of all operating "
            "points. At most 1 is needed.",
            (view,),
        )
    ]
    certificate = results.certify.certificate
    if certificate is not None:
        rows = []
        for plant in certificate.verdicts:
            is_met = "no"
            if plant.met:
                is_met = "yes"
            cells = (
                plant.plant,
                number(max(plant.worst.values()), 4),
                number(max(plant.bounds.values()), 4),
                number(plant.stability_radius),
                number(plant.output_disk.gain),
                number(plant.input_disk.gain),
                is_met,
            )
            rows.append(cells)
        head = (
            "operating point",
            "worst case on the grid",
            "bound for all frequencies",
            "uncertainty may grow by",
            "gain at sensors",
            "gain at actuators",
            "specification met",
        )
        met = tuple(plant.met for plant in certificate.verdicts)
        blocks.append(Table(head, tuple(rows), met=met))

    # Every run of the loop; a joint that stays below its step has no overshoot.
    runs = results.closed_loop.runs
    rows_of_runs = []
    for run in runs:
        overshoot_percent = (100 * run.overshoot).clip(0).tolist()
        overshoots = [percent(overshoot) for overshoot in overshoot_percent]
        at_limit = share(run.limited)
        rows_of_runs.append((run.point, run.condition, *overshoots, at_limit, yes_no(run.settled)))
    overshoot_heads = [f"overshoot of {name}" for name in names]
    loop_head = ("operating point", "condition", *overshoot_heads, "at a limit", "settles")
    settled = tuple(run.settled for run in runs)
    loop_table = Table(loop_head, tuple(rows_of_runs), met=settled)
    return [
        PageSection("requirements", "Requirements", "Requirements", tuple(blocks)),
        PageSection("loop", "Closed loop", "Loop", (loop_table,)),
        PageSection("model", "Model", "Model", tuple(_model_blocks(view, names))),
    ]


def _model_blocks(view: AnyRunView, names: Sequence[str]) -> list[Block]:
    config = view.config
    models = view.results.identify.points
    level = share(config.identification.level)
    increments = config.identification.increments
    blocks: list[Block] = [
        Remarks(sentences(point.warnings), "warning", f"Warnings about {point.name}") for point in models
    ]
    blocks += [
        Picture(
            "matrix-response",
            f"Size of every channel at every operating point, with the range over its {level} ball.",
            (view,),
        ),
        Picture(
            "singular-values",
            "Largest and smallest gain over all directions of the inputs at once, at every operating point, "
            "with the range over its ball.",
            (view,),
        ),
        Picture("mode-shapes", f"Modes of {models[0].name}: how much each joint moves.", (view,)),
    ]
    # Who knows fits of signals would take this one for a bad one.
    if increments:
        blocks.append(
            Text(
                "The fit is that of differences between samples, in which sensor noise weighs most: 70 % may "
                "be all that can be explained."
            )
        )
    kept_back = any(point.fresh for point in models)
    head = ["operating point", "states", *(f"fit of {name}" for name in names)]
    if kept_back:
        head.append("fit of records kept back")
    head += [f"noise of {name}" for name in names]
    units = [view.results.records.unit(name) for name in names]
    rows = []
    for point in models:
        cells: list[object] = [point.name, point.states]
        worst_fits = point.fit_percent.min(axis=0).tolist()
        cells += [percent(fit) for fit in worst_fits]
        if kept_back:
            fits = [fit.fit_percent for record in point.fresh for fit in record]
            worst_kept_back = "none"
            if fits:
                worst_kept_back = percent(min(fits))
            cells.append(worst_kept_back)
        cells += [si(noise, unit) for noise, unit in zip(point.noise_std, units, strict=False)]
        rows.append(tuple(cells))
    blocks.append(Table(tuple(head), tuple(rows)))
    how = ""
    if increments:
        how = ", in differences between samples"
    blocks.append(
        Picture(
            "joint-validation",
            f"Of the records that were kept back the one that the model meets worst{how}.",
            (view,),
        )
    )
    return blocks


def joints_document(
    models: PointModels, design: DesignResult, certify: JointsCertificate, loop: JointsLoopResult
) -> dict[str, Any]:
    """The stages of a run for several joints, for programs that read JSON.

    gamma: the design's weighted worst case, no unit, met up to 1; None where nothing could be designed. The
    certificate is None without a controller. Of points and runs all arrays are left out, those of one number
    a joint (fit_percent, noise_std, overshoot) too: the rows have them in words.
    """
    return {
        "points": [codec.plain(point, arrays=False) for point in models.points],
        "design": {"gamma": design.gamma, "reason": design.reason},
        "certificate": codec.plain(certify.certificate),
        "closed_loop": codec.plain(loop, arrays=False),
    }


def joints_unchecked_page(certify: JointsCertificate, loop: JointsLoopResult) -> PageSection:
    """What neither certificate nor simulation of several joints speaks about."""
    items = ["Without a controller, nothing about a closed loop was checked."]
    if certify.certificate is not None:
        items = [sentence(text) for text in not_checked_of_joints(certify.certificate)]
        if loop.machine != "simulated":
            items.append(NOT_ON_THE_MACHINE)
    return PageSection(*UNCHECKED, (Remarks(tuple(items), "plain"),))


def not_checked_of_joints(certificate: MultivariableCertificate) -> list[str]:
    """What a certificate of several joints leaves open, a sentence each."""
    left = ["nonlinear effects (friction, Coriolis forces, quantisation) and plants outside the balls"]
    at_limits = [verdict for verdict in certificate.verdicts if verdict.limited]
    if not at_limits:
        left.append(
            "the command at a limit: the controller has none, or an earlier version made this certificate"
        )
    else:
        left.append(
            "the command at its limits, other than steps of one reference from rest on the nominal models"
        )
        for verdict in at_limits:
            loops = () if verdict.limited is None else (verdict.limited,)
            left += [
                f"{verdict.plant}: the loop at the limits of the command: {why}"
                for _, why in unknown_at_limits(loops)
            ]
    left.append(f"anything between the operating points ({len(certificate.verdicts)} checked)")
    left += [
        f"{verdict.plant}: between grid points: {verdict.obstacle}"
        for verdict in certificate.verdicts
        if verdict.obstacle
    ]
    left.append("disk margins (nominal loop) and the growth of the uncertainty between grid points")
    left.append("all frequencies together: the balls hold at their level at each frequency by itself")
    left.append("that the true plant has as many unstable poles and integrators as the nominal")
    return left


def joints_sections(results: JointsResults, config: JointsConfig) -> list[Section]:
    """The closed loop and the plant of a run for several joints, with everything else as their parts.

    Args:
        results: Of the run.
        config: Its configuration.
    """
    models = results.identify
    certify = results.certify
    loop = Section(
        "closed loop",
        joints_numbers(models, certify, results.closed_loop, config),
        parts=(
            joints_loop_section(results.closed_loop),
            joints_certificate_section(certify),
            joints_design_section(results.design, signals_where_scaled(config, results)),
        ),
    )
    warnings = [words(item) for point in models.points for item in point.warnings]
    plant = Section(
        "plant",
        said(fit_row(models, config), first_warning(warnings)),
        parts=(records_section(results.records), models_section(models, config)),
    )
    return [loop, plant]


def summarise_joints(results: JointsResults, config: JointsConfig) -> RunSummary:
    """What a run for several joints says whose stages are all there."""
    loop = results.closed_loop
    return summary_of(
        results,
        config,
        joints_sections(results, config),
        joints_document(results.identify, results.design, results.certify, loop),
        joints_verdict(results.design, results.certify, *loop.settled_points()),
    )
