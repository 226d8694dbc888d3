"""A diagnosis on a terminal: rows of its JSON answer, which is all that a resumed call has of a case."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from plant.effects import in_words
from workflow.describe.diagnosis_words import (
    is_of_forces,
    key_words,
    names_words,
    output_unit,
    parameter_words,
    probability_words,
    times_noise,
)
from workflow.describe.facts import Quantity, Row, Section
from workflow.text.dependence import dependence_line
from workflow.text.formats import MISSING, listing, number, portion, share as percentage, si, signed
from workflow.text.names import name_words

Document = Mapping[str, Any]

# A probability from which on an effect is present, or an answer complete: likelier than not.
PRESENT = 0.5
# A nominal value that moved by so many tolerances is named: less is what tolerances are for.
MOVED_FAR = 1.0
# Partial answers that a terminal shows.
_MOST_PARTIAL = 3


def nothing_tried(document: Document) -> bool:
    """Whether a time limit left no candidate tried."""
    needs = [effect["needs"] for effect in document["presence"].values()]
    return document["verdict"] == "unknown" and bool(needs) and all(needs)


def present_of(document: Document) -> list[str]:
    """Effects of the answer, and those that are likelier there than not."""
    return [
        name
        for name, effect in document["presence"].items()
        if name in document["combination"] or effect["probability"] >= PRESENT
    ]


def short_answer(document: Document) -> str:
    """Both answers in a few words: which effects are present, and whether that is all."""
    if document["detail_verdict"] == "not_converged":
        return "not converged"
    present = present_of(document)
    if not present:
        if nothing_tried(document):
            return "no answer: nothing was tried"
        if document["verdict"] != "none":
            return "none of the candidate effects"
        if "shares" not in document:
            return "no model error"
        if document["completeness"]["probability"] < PRESENT:
            return "no candidate effect, but more remains than the threshold"
        return "no significant model error"
    addition = "" if document["completeness"]["probability"] >= PRESENT else ", and something else"
    unsure = " (ambiguous)" if document["detail_verdict"] == "ambiguous" else ""
    return names_words(present) + unsure + addition


def repair_words(document: Document) -> str:
    """What the repaired model changes, and its error in validation records beside that of the nominal one.

    Returns:
        "error / noise 66.9 nominal, 64.2 re-estimated, 46.3 repaired, with dry friction (torque 0.121 N m);
        moved: inertia". Without effects and moved values it is said that nothing predicts better.
    """
    repair = document["repair"]
    sizes = f"error / noise {times_noise(document['gap_before'])} nominal"
    if document["deviations"]:
        sizes += f", {times_noise(document['gap_refit'])} re-estimated"

    effects = []
    for effect in repair["effects"]:
        name, *parameters = effect.items()
        key, value = parameters[0]
        effects.append(f"{in_words(name[1])} ({parameter_words(key, value)})")
    moved = [key_words(key) for key, deviation in document["deviations"].items() if deviation]

    if effects or moved:
        sizes += f", {times_noise(document['gap_after'])} repaired"
    if not document["completeness"]["threshold"]:
        sizes += f" (noise alone {times_noise(document['noise_floor'])})"
    if not effects and not moved:
        return f"{sizes}; nothing that was tried predicts validation records better"
    with_effects = f", with {listing(effects)}" if effects else ""
    return f"{sizes}{with_effects}; moved: {listing(moved) if moved else 'no value'}"


def explained_words(document: Document) -> str:
    """Share of the model error that is explained, with its interval; a dash where nothing was added."""
    explained = document["gap_closed"]
    if not document["repair"]["effects"] or explained is None:
        return MISSING
    low, high = (100 * v if v is not None else float("nan") for v in document["gap_closed_interval"])
    return f"{number(100 * explained, 4)} % ({number(low, 4)} to {number(high, 4)})"


def failed_case(case: str, reason: str) -> Section:
    """A case that has no answer."""
    return Section(case, (_said("failed", reason),))


def diagnosis_section(document: Document, folder: Path) -> Section:
    """Rows of one answer, in the order of importance. folder: of its files."""
    rows = [
        *_answer_rows(document),
        *_effect_rows(document),
        *_completeness_rows(document),
        *_open_rows(document),
        *_partial_rows(document),
        *_replay_rows(document),
        *_model_rows(document, folder),
    ]
    return Section(document["case"], tuple(row for row in rows if row.value.text))


def _said(name: str, words: str) -> Row:
    """A row in words."""
    return Row("", name, Quantity.words(words))


def _keyed(key: str, name: str, words: str, plain: Any) -> Row:
    """A row in words, for people, of what the answer has under a key."""
    return Row(key, name, Quantity(words, plain))


def _answer_rows(document: Document) -> Iterator[Row]:
    presence = document["presence"]
    answer = short_answer(document)
    if nothing_tried(document):
        yield _said("answer", f"{answer}. Give more time: --time-limit")
        return
    yield _keyed("repair.effects", "repair", repair_words(document), document["repair"]["effects"])
    probability = document["probability"]
    answer += f", {probability_words(probability)}"
    unsure = [
        f"{in_words(name)} (not certain: {probability_words(presence[name]['probability'])})"
        for name in _small(document)
        if presence[name]["probability"] < PRESENT
    ]
    if unsure:
        answer += f"; the repaired model also has {' and '.join(unsure)}"
    yield Row("probability", "answer", Quantity(answer, probability))


def _presence_key(name: str) -> str:
    """Where the answer has the probability of an effect; "" for "elbow.delay", whose dot is no level."""
    return "" if "." in name else f"presence.{name}.probability"


def _small(document: Document) -> Sequence[str]:
    """Effects of the repaired model that carry less than the threshold beside the answer."""
    small: Sequence[str] = document["shares"]["small"] if "shares" in document else ()
    return small if document["combination"] else ()


def _effect_rows(document: Document) -> Iterator[Row]:
    """Every effect that is present, then those of the repaired model that carry little, with their sizes.

    An effect may be both: it has two rows then, the second without a key. "explains" and "carried" are a
    share, 0 to 1, and the two ends of its interval.
    """
    presence = document["presence"]
    present = present_of(document)
    for name in present:
        effect = presence[name]
        parts = [probability_words(effect["probability"])]
        for key, value in effect["parameters"].items():
            remark = f", {effect['remarks'][key]}" if key in effect["remarks"] else ""
            parts.append(parameter_words(key, value, effect["intervals"].get(key)) + remark)
        if effect["explains"][0] is not None:
            parts.append(f"explains {portion(effect['explains'][0])} of the error")
        yield _keyed(_presence_key(name), name, "; ".join(parts), effect["probability"])
    for name in _small(document):
        effect = presence[name]
        parts = [f"in the repaired model, present with {probability_words(effect['probability'])}"]
        for key, value in effect["parameters"].items():
            parts.append(parameter_words(key, value, effect["intervals"].get(key)))
        # Nothing is shared out where a time limit came first, or there is no error to share out.
        carried = document["shares"]["carried"].get(name)
        if carried is not None:
            parts.append(f"explains {portion(carried[0])} of the error")
        # One that is present has the key above.
        key = "" if name in present else _presence_key(name)
        yield _keyed(key, name, "; ".join(parts), effect["probability"])


def _completeness_rows(document: Document) -> Iterator[Row]:
    """Whether the effects are all, and what remains; no row where nothing was tried.

    "remains" has for every output (one at least) the share of its motion, 0 to 1, left in validation records;
    "remains_in_record" the same in the record that is furthest off. Threshold 0: sensor noise alone may
    remain.
    """
    if nothing_tried(document):
        return
    complete = document["completeness"]
    remains = complete["remains"]
    left = ", ".join(f"{percentage(share, 3)} of {name_words(name)}" for name, share in remains.items())
    words = f"{probability_words(complete['probability'])}: {left} remain{'s' if len(remains) == 1 else ''}"
    elsewhere = max(complete["remains_in_record"].values(), default=0.0)
    # Validation records stay below the threshold, but another record does not.
    only_elsewhere = max(remains.values()) < complete["threshold"] <= elsewhere
    if complete["probability"] < PRESENT and only_elsewhere:
        words += f" in validation records, but {percentage(elsewhere, 3)} in {complete['in_record']}"
    if complete["threshold"]:
        of_forces = ""
        if is_of_forces(complete["threshold"], document["model_error"]):
            share = percentage(document["model_error"])
            of_forces = f": {share} of what the forces of the actuators make"
        words += f" (threshold {percentage(complete['threshold'], 3)}{of_forces})"
    yield Row("completeness.probability", "complete", Quantity(words, complete["probability"]))


def _open_rows(document: Document) -> Iterator[Row]:
    """What the error depends on, what was not tried, what is doubtful, which other answers are left."""
    for dependence in document["where"]["dependences"]:
        yield _said("depends on", dependence_line(dependence))
    if document["repair"]["effects"]:
        for dependence in document["remains"]["dependences"]:
            yield _said("what remains depends on", dependence_line(dependence))
    untried = sorted(
        ((effect["needs"], name) for name, effect in document["presence"].items() if effect["needs"]),
        key=lambda item: item[0],
    )
    for needs, items in groupby(untried, key=lambda item: item[0]):
        yield _said("not tried", f"{names_words(name for _, name in items)}: needs {needs}")
    for doubt in document["doubts"]:
        yield _said("doubtful", doubt)
    yield _keyed("instead", "or instead", names_words(document["instead"]), document["instead"])
    yield _keyed("perhaps", "perhaps also", names_words(document["perhaps"]), document["perhaps"])
    following = document["next_experiment"]["words"]
    yield _keyed("next_experiment.words", "next", following[0], following)


def _partial_rows(document: Document) -> Iterator[Row]:
    """What explains a part by itself, where no effect is the answer."""
    if "shares" not in document or document["verdict"] != "unknown":
        return
    for names, explained in document["shares"]["closes"][:_MOST_PARTIAL]:
        if explained > 0:
            yield _said("explains a part", f"{names_words(names)}: {percentage(explained)}")


def _replay_rows(document: Document) -> Iterator[Row]:
    """How far plain simulations leave the records, in units of the outputs."""
    replayed = document["replayed"]
    if not replayed:
        return
    outputs = []
    for name, left in replayed.items():
        unit = output_unit(name, document["units"])
        sizes = [f"{si(left['stated'], unit, 3)} nominal"]
        for model, rms in left.items():
            if model != "stated":
                sizes.append(f"{si(rms, unit, 3)} {'re-estimated' if model == 'refit' else model}")
        outputs.append(f"{name_words(name)}: {', '.join(sizes)}")
    worse = ""
    if any(list(left.values())[-1] > left["stated"] for left in replayed.values()):
        worse = (
            "; worse than nominal: without its controller the machine drifts, or a column has the wrong sign "
            "or is another joint's"
        )
    yield _keyed(
        "replayed",
        "replayed",
        f"{listing(document['validation'])} by plain simulation, from the start under the commands alone; "
        f"RMS error of {'; '.join(outputs)}{worse}",
        replayed,
    )


def _model_rows(document: Document, folder: Path) -> Iterator[Row]:
    """What moved in the repaired model, where it is, and what it explains."""
    moved = []
    for key, tolerances in document["deviations"].items():
        if abs(tolerances) >= MOVED_FAR:
            value = document["repair"]["values"][key]
            stated, repaired = number(value["stated"], 4), number(value["repaired"], 4)
            moved.append(f"{key_words(key)} {stated} to {repaired} ({signed(tolerances)} tolerances)")
    yield _keyed("deviations", "moved", ", ".join(moved), document["deviations"])
    for file in document["files"]:
        if file.endswith((".xml", ".toml")):
            yield _said("repaired model", f"{folder}/{file}")
    if document["repair"]["effects"]:
        yield Row(
            "gap_closed",
            "explained",
            Quantity(
                f"{explained_words(document)} of the error in validation records by the repaired model",
                document["gap_closed"],
            ),
        )
