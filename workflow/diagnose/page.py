"""The page of one case: answers in the order a person asks for them, in words first, pictures beside."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata

from diagnosis.diagnosis import Diagnosis
from workflow.diagnose import findings
from workflow.diagnose.content import CasePage
from workflow.diagnose.document import gaps_by_experiment
from workflow.diagnose.pictures import drawers_of
from workflow.diagnose.words import (
    GROUPS,
    key_words,
    probability_words,
    times_noise,
    unit_of,
)
from workflow.figures.gap_style import WORDS
from workflow.figures.style import Picture, render
from workflow.report.formats import count, number
from workflow.report.page import Block, Code, Plot, Section, Table, Text, maybe
from workflow.report.rendering import page

_LEAST_PRESENCE = 0.01  # of an effect in the table


def case_page(content: CasePage, progress: Callable[[float, str], None] | None = None) -> str:
    """One self-contained HTML page; equal content gives equal bytes."""
    drawers = drawers_of(content)
    pictures: dict[str, Picture] = {}
    for position, (name, draw) in enumerate(drawers.items()):
        if progress is not None:
            progress(position / len(drawers), name)
        pictures[name] = render(draw())
    found = content.found
    sections = [
        _gap(content),
        _where(content),
        _which(content),
        _closure(content),
        _remains(content),
        _next(content),
        _controller(content),
        _not_checked(content),
        _reproduce(content),
    ]
    return page(
        "identify.html.j2",
        title=content.loaded.case.name,
        sections=[_drawn_only(section, pictures) for section in sections],
        pictures=pictures,
        headline=findings.headline(found),
        findings=_summary(content),
    )


@dataclass(frozen=True)
class _Part:
    title: str
    items: tuple[str, ...]


def _summary(content: CasePage) -> list[_Part]:
    """The head of the page: one or two sentences for each of the questions."""
    found = content.found
    parts = [
        ("Is there a gap?", findings.gap_sentences(found)[:2]),
        ("Where?", [content.where.headline] if found.verdict != "none" else []),
        ("Which effect?", findings.which_sentences(found)),
        ("How far does the gap shrink?", findings.closure_sentences(found) if found.combination else []),
        ("What next?", list(content.next_experiment.sentences[-1:])),
    ]
    return [_Part(title, tuple(items)) for title, items in parts if items]


def _drawn_only(section: Section, pictures: Mapping[str, Picture]) -> Section:
    """Without the plots that there was nothing to draw for."""
    blocks = tuple(b for b in section.blocks if not isinstance(b, Plot) or b.name in pictures)
    return Section(section.anchor, section.title, section.short, blocks)


def _paragraphs(sentences: list[str]) -> list[Block]:
    return [Text(sentence) for sentence in sentences]


def _gap(content: CasePage) -> Section:
    blocks = _paragraphs(findings.gap_sentences(content.found))
    blocks.append(
        Plot(
            "waterfall",
            "Root mean square of (measured - model) over the sensor noise for each model. 1 is what "
            "white noise of the stated size leaves. Held-out experiments were never fitted.",
        )
    )
    return Section("gap", "Is there a gap beyond noise?", "Gap", tuple(blocks))


def _where(content: CasePage) -> Section:
    where = content.where
    blocks: list[Block] = [Text(where.headline)]
    # The subsystem is said with the causes, of which it is the sum.
    blocks += _paragraphs([words for axis, words in where.sentences.items() if axis != "subsystem"])
    blocks += [
        Plot(
            "bands",
            "Size of the gap with the sensor noise taken off, after moving the stated values within their "
            "tolerances. Pale: no more than chance gives. The frequency panel ends at 0.05; less is drawn "
            "there.",
        ),
        Plot("curves", "The gap read as one missing function: what would have to be added, and where."),
        Plot(
            "regimes",
            "Residual energy while a variable lies in a range. Grey: what the same energy gives when it is "
            "shifted in time. A dot outside says that the gap depends on the variable.",
        ),
        Plot("traces", "Residuals over noise in every experiment: before, and with the best model there is."),
    ]
    return Section("where", "Where does it lie?", "Where", tuple(blocks))


def _which(content: CasePage) -> Section:
    found = content.found
    sentences = findings.which_sentences(found) + findings.suspicion_sentences(
        found, content.loaded.suspected
    )
    rows = tuple(
        (GROUPS.get(name, name), probability_words(p))
        for name, p in sorted(content.where.subsystem.items(), key=lambda item: -item[1])
    )
    blocks = _paragraphs(sentences)
    blocks.append(
        Plot("probabilities", "Probabilities over no effect, every effect of the list, and none of them.")
    )
    table = _effect_table(found)
    blocks += [table] if table.rows else []
    blocks.append(Table(("subsystem", "probability"), rows, "The same, added up by subsystem."))
    return Section("which", "Which effect, and how sure?", "Which", tuple(blocks))


def _effect_table(found: Diagnosis) -> Table:
    rows = []
    for effect in found.effects:
        if effect.presence < _LEAST_PRESENCE or not effect.parameters:
            continue
        for position, (key, value) in enumerate(effect.parameters.items()):
            low, high = effect.intervals[key]
            once = (effect.name, probability_words(effect.probability), probability_words(effect.presence))
            rows.append(
                (
                    *(once if position == 0 else ("", "", "")),
                    key,
                    f"{number(value, 5)} {unit_of(key)}".rstrip(),
                    f"{number(low, 5)} to {number(high, 5)}",
                    times_noise(effect.gap_after) if position == 0 else "",
                )
            )
    return Table(
        ("effect", "main cause", "there at all", "parameter", "value", "95 % interval", "gap after"),
        tuple(rows),
        "Effects that the records leave possible, with fitted parameters. Gap after: held-out residual over "
        "noise with the best set of effects that holds the effect.",
    )


def _closure(content: CasePage) -> Section:
    found = content.found
    roles = {e.name: e.role.replace("_", " ") for e in content.loaded.case.experiments}
    pooled = {"stated": found.gap_before, "refit": found.gap_refit, "repaired": found.gap_after}
    models = content.models
    rows = [
        (name, roles[name], *(times_noise(entry[model]) for model in models))
        for name, entry in gaps_by_experiment(found).items()
    ]
    rows.append(("held out, together", "", *(times_noise(pooled[model]) for model in models)))
    blocks = _paragraphs(findings.closure_sentences(found))
    blocks.append(
        Table(
            ("experiment", "role", *(WORDS[model] for model in models)),
            tuple(rows),
            "Residual over noise, RMS.",
        )
    )
    return Section("closure", "How far does the gap shrink?", "Closure", tuple(blocks))


def _remains(content: CasePage) -> Section:
    found = content.found
    blocks = _paragraphs(findings.remaining_sentences(found))
    if found.combination:
        blocks += _paragraphs([content.remains.headline, *content.remains.sentences.values()])
    blocks.append(
        Plot(
            "spectra",
            "Spectra of the residuals over noise, all experiments together; 1 is white sensor noise.",
        )
    )
    rows = tuple(
        (
            key_words(key),
            f"{number(content.loaded.case.rig.value(key), 5)} {unit_of(key)}".rstrip(),
            f"{number(found.rig.value(key), 5)} {unit_of(key)}".rstrip(),
            f"{d:+.2f}",
        )
        for key, d in found.deviations.items()
    )
    if rows:
        blocks.append(
            Table(
                ("stated value", "as stated", "repaired", "moved by [tolerances]"),
                rows,
                "Values that the rig file gives a tolerance for.",
            )
        )
    return Section("remains", "What remains?", "Remains", tuple(blocks))


def _next(content: CasePage) -> Section:
    coming = content.next_experiment
    blocks = _paragraphs(list(coming.sentences))
    if coming.proposal is not None and coming.proposal.separates:
        blocks.append(
            Plot(
                "next",
                "Voltage of the proposed experiment, within the voltages, angles and deflections of these "
                "records, and the difference between what the two likeliest answers predict for it, before "
                f"the free parameters take their share. The voltage stands in "
                f"{content.loaded.case.name}.next.csv.",
            )
        )
    if coming.proposal is not None:
        pairs = tuple(
            (" / ".join(pair.rivals), number(pair.standard_deviations), number(pair.log_bayes_factor))
            for pair in coming.proposal.separations
        )
        blocks.append(
            Table(
                ("rivals", "apart by [standard deviations]", "expected log Bayes factor"),
                pairs,
                "After both rivals' free parameters and the tolerances have absorbed what they can.",
            )
        )
    return Section("next", "Which experiment to run next?", "Next", tuple(blocks))


def _controller(content: CasePage) -> Section:
    blocks = _paragraphs(findings.control_sentences(content.control))
    if content.check is not None:
        asked = content.control["specification"]
        blocks.append(
            Plot(
                "controller",
                "A step of the hub angle, then a short push by the voltage. Left the design on the rig as "
                "stated, right the same specification on the repaired rig.",
            )
        )
        rows = tuple(
            (
                run["design"],
                run["machine"],
                number(run["cost_s"], 4),
                number(run["modulus_margin"], 4),
                number(run["peak_command_V"], 4),
                "yes" if run["settles"] else "NO",
            )
            for run in content.control["runs"]
        )
        blocks.append(
            Table(
                ("designed on", "run on", "cost [s]", "modulus margin", "peak voltage [V]", "settles"),
                rows,
                "Cost: integral of the squared tip error over the squared move. Specification: bandwidth "
                f"{number(asked['bandwidth_rad_s'])} rad/s, modulus margin "
                f"{number(asked['modulus_margin'])}, effort {number(asked['effort_limit_V_rad'])} V/rad, "
                f"{count(asked['controller_order'], 'state')}. On the machine the distance from -1 is one "
                "over the largest sensitivity measured there.",
            )
        )
    return Section("controller", "What does it mean for the controller?", "Controller", tuple(blocks))


def _not_checked(content: CasePage) -> Section:
    words = [
        "Only effects of the list are named. A cause outside it that looks like one of them would be called "
        "by the wrong name; the residuals above are what speaks against that.",
        "Noise levels are taken from the rig file. If they are wrong, so is every statement about noise.",
        "Every record is taken to start from rest at zero angle.",
    ]
    if content.check is not None:
        words.append(
            "The repaired model stands for the machine in closed loop: nothing was run on the machine "
            "itself, and the designs know no uncertainty."
        )
    if not any(e.closed_loop for e in content.loaded.case.experiments):
        words.append("No experiment was made in closed loop.")
    if not content.found.deviations:
        words.append("The stated values are taken as exact; a wrong one would show up as an effect.")
    return Section("unchecked", "What was not checked", "Not checked", maybe(tuple(words), "warning"))


def _reproduce(content: CasePage) -> Section:
    loaded = content.loaded
    rows = tuple(
        (
            e.name,
            e.role.replace("_", " "),
            e.kind,
            "closed loop" if e.closed_loop else "open loop",
            str(e.voltage_V.size),
            loaded.descriptions.get(e.name, ""),
        )
        for e in loaded.case.experiments
    )
    versions = tuple((name, metadata.version(name)) for name in ("flexlink", "numpy", "scipy", "numba"))
    blocks: list[Block] = [
        Table(("experiment", "role", "input", "loop", "samples", "description"), rows),
        Table(
            ("what", "value"),
            (
                ("rig file", loaded.rig_file),
                ("SHA-256 of all inputs", loaded.input_sha256),
                ("simulations", f"{content.found.simulations}"),
                *versions,
                ("python", sys.version.split()[0]),
            ),
            "The result is deterministic: the same files and versions give the same page.",
        ),
        Code("Repaired rig file", content.rig_text),
    ]
    if content.effects_text:
        blocks.append(Code("Effects to add", content.effects_text))
    return Section("made", "To reproduce this", "Reproduce", tuple(blocks))
