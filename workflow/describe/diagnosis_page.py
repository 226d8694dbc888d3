"""The page of a diagnosis: of a rig, and of a simulation of one's own.

Both have the same first screen and the same sections on size, place, effects and remainder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from markupsafe import Markup

from diagnosis.answer import Model
from diagnosis.machine.machine_protocol import Real
from diagnosis.next_experiment.next_experiment import NextExperiment
from plant.effects import in_words
from workflow.describe.diagnosis import (
    explains_words,
    first_bullets,
    headline,
    numbers,
    remaining_sentences,
)
from workflow.describe.diagnosis_view import DiagnosisView
from workflow.describe.diagnosis_words import (
    is_of_forces,
    key_words,
    names_words,
    output_unit,
    probability_words,
    times_noise,
    value_words,
)
from workflow.describe.facts import (
    Block,
    FirstScreen,
    Page,
    PageSection,
    Picture,
    Remarks,
    Sketch,
    Table,
    Text,
    file_link,
    file_text,
    link,
)
from workflow.describe.where import at_length, in_short
from workflow.text.formats import count, interval, number, share as percentage, si, signed, yes_no
from workflow.text.names import name_words, stated_name

if TYPE_CHECKING:  # it loads what designs controllers
    from workflow.tasks.controller_check import ControllerCheck, Run

# An effect less probable than this has no line in the table of what the records do not exclude.
LEAST_PRESENCE = 0.01
MODELS: Mapping[Model, str] = {
    "stated": "nominal parameters",
    "refit": "nominal parameters, re-estimated",
    "repaired": "effects added",
}
_SUBSYSTEMS = {
    "actuator": "actuator",
    "joint": "joint and hub",
    "link": "link",
    "sensor": "tip sensor",
    "environment": "from outside",
    "none": "nothing missing",
    "unknown": "none of the candidates",
}
_ONLY_CANDIDATES = (
    "Only candidate effects are named. Another cause that looks like one of them gets the wrong name; check "
    "the residuals above."
)
_NOMINAL_IS_EXACT = "The nominal parameters are taken as exact; a wrong one would show up as an effect."


@dataclass(frozen=True)
class Provenance:
    """What the answer of a rig was computed from.

    Attributes:
        rig_file: Name of the rig file.
        input_sha256: Over everything that was read.
        descriptions: Free words of an experiment by its name.
        versions: (name, version) of what computed it.
    """

    rig_file: str
    input_sha256: str
    descriptions: Mapping[str, str]
    versions: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class ProposedExperiment:
    """The experiment to run next, and by how much two answers differ in it.

    Attributes:
        experiment: With its voltage.
        differences: (T, Y) prediction of the first answer less that of the second, in noise deviations.
        competing: Answers in words, the likeliest first.
    """

    experiment: NextExperiment
    differences: Real
    competing: Sequence[str]


def rig_page(
    view: DiagnosisView,
    advice: Sequence[str],
    provenance: Provenance,
    *,
    suspected: Sequence[str],
    proposed: ProposedExperiment | None,
    check: ControllerCheck | None,
    no_check: str,
    rig_text: str,
    effects_text: str,
) -> Page:
    """The page of a flexible link of a rig file.

    Args:
        view: The diagnosis.
        advice: What to do next, in sentences.
        provenance: What it was computed from.
        suspected: Effects that the case file asks about.
        proposed: The experiment that separates the answers left; None where none does.
        check: Controllers designed on both models; None where there is none, and `no_check` says why.
        no_check: "not_asked", "no_gap", "not_explained" or a reason of the design; "" with a check.
        rig_text: The repaired rig file.
        effects_text: The file of effects to add; "" without.
    """
    fitted = " Start of the record and zero of the encoder are fitted." if view.rough else ""
    picture = Picture(
        "gap_measured",
        "Validation record with the largest model error: measured, and simulated before and after. Below: "
        f"measured less simulated.{fitted}",
        (view.found,),
    )
    bullets = first_bullets(view, in_short(view.place, view.floor), advice)
    first = FirstScreen(
        headline(view),
        "plain",
        numbers(view),
        bullets,
        picture,
        "findings",
        "Findings",
        below=_files_to_take(view, bool(effects_text)),
    )
    case_name = view.found.case.name
    unchecked = unchecked_of_rig(view, simulated_loop=check is not None)
    next_sections = [] if proposed is None else [_next_section(view, proposed)]
    controller = controller_blocks(check, no_check)
    sections = (
        *common_sections(view, suspected),
        *next_sections,
        PageSection("controller", "What it means for the controller", "Controller", controller),
        PageSection("unchecked", "What was not checked", "Not checked", (Remarks(unchecked, "warning"),)),
        _reproduce_section(view, provenance, rig_text, effects_text),
    )
    return Page(case_name, first, sections)


def own_plant_page(
    view: DiagnosisView,
    advice: Sequence[str],
    *,
    can_show: Sequence[Table],
    model_error: float,
    repaired_file: str,
    moving: Markup,
    numbers_text: str,
) -> Page:
    """The page of a simulation of one's own.

    Args:
        view: The diagnosis.
        advice: What to do next, in sentences.
        can_show: What its records can tell; none where that was not looked at.
        model_error: As specified, a share of the motion; 0 where it was not.
        repaired_file: Name of the repaired model beside the page; "" without.
        moving: The machine in motion as SVG; "" without.
        numbers_text: Parameters and effects of the repaired model, as JSON.
    """
    answer = view.found
    repaired_words = _of_repaired_file(view, repaired_file)
    bullets = first_bullets(view, in_short(view.place, view.floor), advice, repaired_words)
    if is_of_forces(answer.case.model_error, model_error):
        threshold = percentage(answer.case.model_error, 3)
        bullets += (
            f"The threshold of {threshold} of the motion is {percentage(model_error)} (model_error) of what "
            "the forces of the actuators make.",
        )
    if answer.replays:
        how = "replayed by plain simulation from its start under its commands alone, "
        runs_away = " A replay that runs away leaves the frame."
    else:
        how = "simulated "
        runs_away = ""
    caption = (
        f"Validation record with the largest model error: measured, and {how}before and after. Below: "
        f"measured less simulated.{runs_away}"
    )
    picture = Picture("gap_measured", caption, (answer,))
    sketches = (Sketch(moving, _moving_caption(answer.models[-1])),) if moving else ()
    sections = [*common_sections(view, ())]
    if can_show:
        whatever = (
            "Whatever the answer is: which candidates these records can show, and which they cannot "
            "distinguish. Whether one is present is the answer above."
        )
        can_tell: tuple[Block, ...] = (Text(whatever), *can_show)
        sections.insert(0, PageSection("check", "What these records can tell", "Check", can_tell))
    unchecked = (
        _ONLY_CANDIDATES,
        "" if answer.case.plant.settled else "Every record is assumed to start as the simulation does.",
        "" if answer.deviations else _NOMINAL_IS_EXACT,
    )
    files = file_text("Parameters and effects to put into the simulation", numbers_text)
    sections.append(
        PageSection(
            "unchecked", "What was not checked", "Not checked", (Remarks(unchecked, "warning"), files)
        )
    )
    first = FirstScreen(
        headline(view), "plain", numbers(view), bullets, picture, "findings", "Findings", beside=sketches
    )
    return Page(answer.case.name, first, tuple(sections))


def _of_repaired_file(view: DiagnosisView, file: str) -> tuple[str, ...]:
    """Where the repaired model is."""
    if not file:
        return ()
    has_delay = any("delay" in change.id for change in view.found.repair)
    replay = ", and what a replay of a delay needs" if has_delay else ""
    return (
        Markup("The repaired model is {}. Its first lines list what was changed{}.").format(
            file_link(file), replay
        ),
    )


def _moving_caption(last_model: Model) -> str:
    beside = ""
    if last_model != "stated":
        colour = "blue" if last_model == "repaired" else "brown"
        beside = f" and {MODELS[last_model]} ({colour})"
    return (
        "The machine in this record, from body to body, seen along the axis in which it moves least: "
        f"measured (broad), replayed with nominal parameters (pink){beside}."
    )


def _files_to_take(view: DiagnosisView, has_effects: bool) -> tuple[Block, ...]:
    """The files to put into a model that may miss a share of the motion."""
    if not (view.rough and view.found.added):
        return ()
    name = view.found.case.name
    take = (
        "Put these numbers into your model:"
        if view.found.combination
        else "These numbers bring your model nearer to the records; the cause is unknown:"
    )
    files = f"{name}.rig.toml (your rig file, re-estimated)"
    if has_effects:
        effects = names_words(change.id for change in view.found.repair)
        files += f" and {name}.effects.toml ({effects})"
    return (
        Text(
            Markup("<b>{}</b> {}. Both also stand under {}.").format(take, files, link("made", "Reproduce"))
        ),
    )


# -- sections that every page has ----------------------------------------------------------------------------


def common_sections(view: DiagnosisView, suspected: Sequence[str]) -> tuple[PageSection, ...]:
    """From the size of the error to what remains."""
    return (
        _size_section(view),
        _where_section(view),
        _which_section(view, suspected),
        _explained_section(view),
        _remains_section(view),
    )


def _size_section(view: DiagnosisView) -> PageSection:
    measure = (
        " beyond sensor noise in per cent of the motion (RMS about its mean), of the output with most. "
        "Dotted: threshold."
        if view.rough
        else " over the sensor noise; 1: white noise of the specified size."
    )
    caption = f"RMS of (measured - model){measure} Validation records were not fitted."
    return PageSection(
        "gap", "Size of the model error", "Size", (Picture("gap_waterfall", caption, (view.shown,)),)
    )


def _where_section(view: DiagnosisView) -> PageSection:
    place = view.place
    model_error = view.found.case.model_error
    model = "nominal parameters re-estimated" if view.found.deviations else "nominal parameters"
    # One search finds all dependences, on logs or on blocks; without any the picture is not drawn.
    on_logs = bool(place.dependences) and place.dependences[0].judged_on == "logs"
    floor = "the threshold" if view.rough else "the sensor noise"
    residuals = "in per cent of the motion" if view.rough else "over noise"
    judged_on = "logs" if on_logs else "blocks"
    pictures = (
        Picture("gap_bands", f"Size above {floor}, {model}. Pale: not significant.", (place, model_error)),
        Picture(
            "gap_dependences",
            "What the model error depends on: the force, or the error of a reading, that is missing, over "
            f"the variable. Drawn on some {judged_on} and judged on the others.",
            (place,),
        ),
        Picture(
            "gap_regimes",
            "Residual energy while a variable lies in a range. Grey: what chance gives (residuals shifted in "
            "time). A dot outside: the model error depends on the variable.",
            (place, model_error),
        ),
        Picture(
            "gap_traces",
            f"Residuals {residuals} in every experiment: before, and with the best model.",
            (view.shown,),
        ),
    )
    paragraphs = [Text(paragraph) for paragraph in at_length(place, view.floor, model)]
    return PageSection("where", "Where it lies", "Where", (*paragraphs, *pictures))


def _which_section(view: DiagnosisView, suspected: Sequence[str]) -> PageSection:
    answer = view.shown
    blocks: list[Block] = []
    for name in suspected:
        part = " and is part of the answer" if name in answer.combination else ""
        probability = probability_words(answer.presence(name))
        blocks.append(Text(f"You asked about {in_words(name)}: probability {probability}{part}."))
    blocks.append(
        Picture(
            "gap_probabilities",
            "Presence of every candidate effect; last, whether something else is missing.",
            (answer,),
        )
    )
    possible = presence_table(view)
    if possible.rows:
        blocks.append(possible)
    # One answer that is accepted explains what the numbers above say already.
    if view.partial and (not answer.combination or len(view.partial) > 1):
        caption = "What effects explain by themselves, on validation records."
        blocks.append(Picture("gap_partial", caption, (view.partial,)))
    if view.of_rig:
        by_probability = sorted(view.place.subsystem.items(), key=lambda item: item[1], reverse=True)
        lines = []
        for subsystem, of_subsystem in by_probability:
            subsystem_words = _SUBSYSTEMS.get(subsystem, subsystem.replace("_", " "))
            lines.append((subsystem_words, probability_words(of_subsystem)))
        blocks.append(Table(("subsystem", "probability"), tuple(lines), "The same, added up by subsystem."))
    return PageSection("which", "Which effect, and how sure", "Which", tuple(blocks))


def presence_table(view: DiagnosisView) -> Table:
    """Every effect that the records do not exclude, and its sizes."""
    lines: list[tuple[str, ...]] = []
    for effect in view.shown.effects:
        if effect.presence < LEAST_PRESENCE:
            continue
        of_effect = (in_words(effect.name), probability_words(effect.presence), explains_words(effect))
        for key, value in effect.parameters.items():
            remark = f", {effect.remarks[key]}" if key in effect.remarks else ""
            bounds = f"{interval(effect.intervals[key], 5)}{remark}"
            lines.append((*of_effect, stated_name(key), value_words(key, value, 5), bounds))
            of_effect = ("", "", "")
    return Table(
        ("effect", "present", "explains", "parameter", "value", "95 % interval"),
        tuple(lines),
        "Effects that the records do not exclude. Explains: share of the validation error.",
    )


def _explained_section(view: DiagnosisView) -> PageSection:
    blocks: list[Block] = []
    carried = carried_table(view)
    if carried.rows:
        blocks.append(carried)
    blocks += [left_table(view), experiments_table(view)]
    return PageSection("closure", "What the effects explain", "Explained", tuple(blocks))


def carried_table(view: DiagnosisView) -> Table:
    """Share of the error that every effect of the repaired model explains."""
    answer = view.shown
    head: tuple[str, ...] = ("effect", "explains", "95 % interval")
    caption = "Share of the energy above sensor noise, whatever the order of the effects."
    if answer.combination:
        head += ("significant",)
        caption += " A nominal value far outside its tolerance is significant too."
    lines: list[tuple[str, ...]] = []
    if answer.shares:
        for name, (explained, low, high) in answer.shares.carried.items():
            range_words = f"{percentage(low)} to {percentage(high)}"
            cells = (in_words(name), percentage(explained), range_words)
            significant = ("no" if name in answer.shares.small else "yes",) if answer.combination else ()
            lines.append((*cells, *significant))
    return Table(head, tuple(lines), caption)


def left_table(view: DiagnosisView) -> Table:
    """What every model misses of every output, in per cent of its motion and in its unit."""
    answer = view.shown
    shares = answer.shares
    caption = (
        "Model error of the validation records beyond sensor noise, in per cent of the motion and in units"
    )
    in_windows: tuple[str, ...] = ()
    if shares and shares.horizon_samples:
        window = si(shares.horizon_samples * answer.case.dt_s, "s")
        caption += f"; in windows of {window} no drift can grow"
        # Where the answer itself rests on windows, the columns beside them say the same.
        if not shares.in_windows:
            in_windows = ("re-estimated, in windows", "effects added, in windows")
    lines = []
    for k, left in enumerate(view.left):
        unit = output_unit(left.output, answer.case.units)
        errors = [f"{percentage(share, 3)}, {si(rms, unit, 3)}" for share, rms in left.errors]
        cells = [name_words(left.output), *errors, si(left.noise, unit, 3)]
        if shares and in_windows:
            cells += [percentage(shares.horizon_before[k]), percentage(shares.horizon_after[k])]
        lines.append(tuple(cells))
    models = [MODELS[model] for model in answer.models]
    return Table(("output", *models, "sensor noise", *in_windows), tuple(lines), f"{caption}.")


def experiments_table(view: DiagnosisView) -> Table:
    """What every model misses in every experiment."""
    answer = view.shown
    lines = []
    for experiment in view.found.case.experiments:
        sizes = [times_noise(size) for size in answer.gap_by_experiment[experiment.name].values()]
        lines.append((experiment.name, role_words(experiment.role), *sizes))
    if view.of_rig:
        lines.append(("validation, together", "", *(times_noise(size) for size in answer.gaps.values())))
    caption = (
        "Model error in per cent of the motion, of the output with most."
        if view.rough
        else "Residual over noise, RMS."
    )
    return Table(("experiment", "role", *(MODELS[model] for model in answer.models)), tuple(lines), caption)


def role_words(role: str) -> str:
    """What an experiment was used for."""
    return role.replace("held_out", "validation")


def _remains_section(view: DiagnosisView) -> PageSection:
    answer = view.shown
    blocks: list[Block] = [Text(words) for words in remaining_sentences(view)]
    if answer.added:
        blocks += [
            Text(in_short(view.remains, view.floor)),
            *map(Text, at_length(view.remains, view.floor, "the effects added")),
            Picture(
                "gap_dependences",
                "What the remaining error depends on.",
                (view.remains,),
                file="gap_dependences_left",
            ),
        ]
    blocks.append(
        Picture(
            "gap_spectra",
            "Spectra of the residuals over noise, all experiments together; 1: white sensor noise as "
            "specified.",
            (view.found,),
        )
    )
    if answer.deviations:
        blocks.append(nominal_table(view))
    return PageSection("remains", "What remains", "Remains", tuple(blocks))


def nominal_table(view: DiagnosisView) -> Table:
    """Nominal values that have a tolerance, and how far each moved."""
    answer = view.found
    head: tuple[str, ...] = ("nominal parameter", "nominal", "re-estimated", "moved by [tolerances]")
    if answer.added:
        head += ("without effects",)
    stated, without_effects = answer.case.machine.description, view.moved_refit
    lines = []
    for key, tolerances in view.moved.items():
        nominal = value_words(key, stated.value(key), 5)
        now = value_words(key, answer.rig.value(key), 5)
        cells = [key_words(key), nominal, now, signed(tolerances)]
        if answer.added:
            cells.append(signed(without_effects[key]))
        lines.append(tuple(cells))
    return Table(head, tuple(lines), "Values that have a tolerance.")


# -- sections of a rig ---------------------------------------------------------------------------------------


def _next_section(view: DiagnosisView, proposed: ProposedExperiment) -> PageSection:
    experiment = proposed.experiment
    scale = "imperfections of the model" if view.rough else "sensor noise"
    picture = Picture(
        "gap_next",
        f"Voltage of the proposed experiment ({view.found.case.name}.next.csv), and the difference between "
        "the predictions of the two likeliest answers. Voltage, angle and deflection stay within those of "
        f"these records. Scale: {scale}, one standard deviation.",
        (experiment, proposed.differences, list(proposed.competing)),
    )
    lines = [
        (" / ".join(pair.hypotheses), number(pair.standard_deviations), number(pair.log_bayes_factor))
        for pair in experiment.separations
    ]
    table = Table(
        ("competing hypotheses", "apart by [standard deviations]", "expected log Bayes factor"),
        tuple(lines),
        "Free parameters of both are fitted first.",
    )
    return PageSection("next", "The proposed experiment", "Next", (picture, table))


_NO_CHECK = {
    "not_asked": "Not computed: --no-controller was given.",
    "no_gap": "Nothing is missing in the model: a controller designed on it should work on the machine.",
    "not_explained": (
        "The repaired model does not explain the machine, so it cannot predict a closed loop. Try "
        "controllers of either model with care."
    ),
}


def controller_blocks(check: ControllerCheck | None, no_check: str) -> tuple[Block, ...]:
    """What the model error does to a controller, or why that is not known.

    Args:
        check: Its runs are those of the design on nominal parameters, as predicted and on the repaired model,
            then those of the design on the repaired model.
        no_check: Without a check, why: a key of `_NO_CHECK`, or words.

    Returns:
        Two sentences, the picture and the table of the runs; without a check one sentence.
    """
    if check is None:
        return (Text(_NO_CHECK.get(no_check, f"No controller to compare: {no_check}.")),)
    nominal, nominal_reached, repaired, repaired_reached = check.runs
    trial = check.trial
    asked = check.specification
    order = count(int(asked.controller_order), "state")
    outputs_m = [run.tip_m for run in check.runs]
    commands_V = [run.command_V for run in check.runs]
    picture = Picture(
        "gap_controller",
        "A step of the hub angle, then a short push. Left: designed with nominal parameters. Right: same "
        "specification, repaired rig.",
        (trial.time_s, trial.reference_m, outputs_m, commands_V),
    )
    lines = []
    for run in check.runs:
        cost_s = number(run.cost_s, 4)
        margin = number(run.modulus_margin, 4)
        peak_V = number(run.peak_command_V, 4)
        lines.append((run.design, run.machine, cost_s, margin, peak_V, yes_no(run.settles)))
    table = Table(
        ("designed on", "run on", "cost [s]", "modulus margin", "peak voltage [V]", "settles"),
        tuple(lines),
        "Cost: integral of the squared tip error over the squared move. Specification: bandwidth "
        f"{number(asked.bandwidth_rad_s)} rad/s, modulus margin {number(asked.modulus_margin)}, effort "
        f"{number(asked.effort_limit)} V/rad, {order}. On the machine the "
        "margin is one over the largest measured sensitivity.",
    )
    with_nominal = (
        "Designed with the nominal parameters, the loop is predicted to have a cost of "
        f"{number(nominal.cost_s)} s and a modulus margin of {number(nominal.modulus_margin)}. Simulated on "
        f"the repaired model it reaches {_reached(nominal_reached, nominal)}"
    )
    with_repaired = (
        f"Designed on the repaired model: predicted {number(repaired.cost_s)} s and "
        f"{number(repaired.modulus_margin)}, reached {_reached(repaired_reached, repaired)}"
    )
    return (Text(with_nominal), Text(with_repaired), picture, table)


def _reached(achieved: Run, predicted: Run) -> str:
    """Cost and margin that a loop reaches, the cost beside the predicted one."""
    more_percent = 100 * (achieved.cost_s / predicted.cost_s - 1)
    end = "." if achieved.settles else "; it does not settle."
    reached_s = f"{number(achieved.cost_s)} s ({signed(more_percent, '%', 1)})"
    return f"{reached_s} and {number(achieved.modulus_margin)}{end}"


def unchecked_of_rig(view: DiagnosisView, *, simulated_loop: bool) -> tuple[str, ...]:
    """What nobody looked at in a diagnosis of a rig. simulated_loop: controllers were compared."""
    case = view.found.case
    return (
        _ONLY_CANDIDATES,
        ""
        if view.rough
        else "Noise levels come from the rig file. If they are wrong, so is every statement about noise.",
        ""
        if "tip_m" in case.outputs
        else "Whether the model error depends on deflection or tip position: the tip was not measured.",
        "The linear correction of the residuals ignores motion before the first row of a record."
        if view.rough
        else "Every record is assumed to start from rest at zero angle.",
        "The closed loop was simulated with the repaired model, not run on the machine; the designs take no "
        "account of uncertainty."
        if simulated_loop
        else "",
        ""
        if any(experiment.closed_loop for experiment in case.experiments)
        else "No experiment was made in closed loop.",
        "" if view.found.deviations else _NOMINAL_IS_EXACT,
    )


def _reproduce_section(
    view: DiagnosisView, provenance: Provenance, rig_text: str, effects_text: str
) -> PageSection:
    lines = []
    for experiment in view.found.case.experiments:
        loop = "closed loop" if experiment.closed_loop else "open loop"
        # A part of a record, "name (part)", has the words of the record.
        # A part of a record is described by the record's name.
        record_name = experiment.name.split(" (")[0]
        words = provenance.descriptions.get(record_name, "")
        samples = str(experiment.voltage_V.size)
        lines.append((experiment.name, role_words(experiment.role), experiment.kind, loop, samples, words))
    experiments = Table(("experiment", "role", "input", "loop", "samples", "description"), tuple(lines))
    made_of = Table(
        ("what", "value"),
        (
            ("rig file", provenance.rig_file),
            ("SHA-256 of all inputs", provenance.input_sha256),
            ("simulations", str(view.found.simulations)),
            *provenance.versions,
        ),
        "The result is deterministic: the same files and versions give the same page.",
    )
    files = [file_text("Repaired rig file", rig_text)]
    if effects_text:
        files.append(file_text("Effects to add", effects_text))
    return PageSection("made", "To reproduce this", "Reproduce", (experiments, made_of, *files))
