"""Formats of a diagnosis: effects, parameters, probabilities; the filters of its templates."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from plant.effects import in_words
from workflow.engine import codec
from workflow.text.dependence import (
    alternatives_words,
    dependence_line,
    dependence_short,
    dependence_words,
)
from workflow.text.formats import MISSING, fixed, interval, listing, number, portion, si
from workflow.text.names import name_words, stated_name, stated_unit, unit_of

# Share of the error, explained by nothing on the list, from which on a page says so. Chosen: less is what a
# good model leaves, too.
_LEAST_UNEXPLAINED = 0.05
_SURE = {0.99: "practically certain", 0.9: "very likely", 0.66: "likely", 0.33: "possible", 0.0: "unlikely"}


def parameter_words(parameter: str, value: float, bounds: Sequence[float] | None = None) -> str:
    """Name, value, unit and 95 % interval."""
    text = f"{stated_name(parameter)} {si(value, stated_unit(parameter), 4)}"
    return text if bounds is None else f"{text} (95 %: {interval(bounds, 4)})"


def key_words(key: str) -> str:
    """A key of the rig file, "hub.inertia_kg_m2" as "inertia (hub)"; of one's own plant without a section."""
    section, _, name = key.rpartition(".")
    if not section:
        return stated_name(name)
    what = name_words(name)
    return what if re.search(rf"\b{section}\b", what) else f"{what} ({section})"


def setting_words(name: str, value: float | int | str) -> str:
    """up_to_Hz 35.0 as "up to 35 Hz"."""
    what, _, unit = name.rpartition("_")
    if not what or isinstance(value, str):
        return f"{name.replace('_', ' ')} {value}"
    return f"{what.replace('_', ' ')} {si(value, unit)}"


def probability_words(p: float) -> str:
    """A probability in percent, without claiming 100 or 0."""
    percent = 100 * p
    if percent > 99.9:
        return "over 99.9 %"
    if percent < 0.1:
        return "under 0.1 %"
    return f"{number(percent) if percent < 99 else fixed(percent)} %"


def times_noise(rms: float) -> str:
    """A residual over noise, fine enough to tell 1.003 from 1."""
    return MISSING if math.isnan(rms) else fixed(rms, 3 if rms < 10 else 1)


def sureness(p: float) -> str:
    """How sure that is, in a word."""
    return next(word for limit, word in _SURE.items() if p >= limit)


def nothing_tried(document: Mapping[str, Any]) -> bool:
    """Whether a time limit left no candidate tried."""
    needs = [effect["needs"] for effect in document["presence"].values()]
    return document["verdict"] == "unknown" and bool(needs) and all(needs)


def short_answer(document: Mapping[str, Any]) -> str:
    """Both answers of a JSON document in a few words: which effects are present, and whether that is all."""
    if document["detail_verdict"] == "not_converged":
        return "not converged"
    chosen = document["combination"]
    present = [n for n, e in document["presence"].items() if n in chosen or e["probability"] >= 0.5]
    if not present:
        if nothing_tried(document):
            return "no answer: nothing was tried"
        if document["verdict"] != "none":
            return "none of the candidate effects"
        if "shares" not in document:
            return "no model error"
        if document["completeness"]["probability"] < 0.5:
            return "no candidate effect, but more remains than the threshold"
        return "no significant model error"
    more = "" if document["completeness"]["probability"] >= 0.5 else ", and something else"
    unsure = " (ambiguous)" if document["detail_verdict"] == "ambiguous" else ""
    return listing([in_words(name) for name in present]) + unsure + more


def repair_words(document: Mapping[str, Any]) -> str:
    """What the repaired model changes, and its error in validation records beside that of the nominal one.

    Parameters
    ----------
    document : mapping
        JSON answer of one case.

    Returns
    -------
    str
        "error / noise 66.9 nominal, 64.2 re-estimated, 46.3 repaired, with dry friction (torque 0.121 N m);
        moved: inertia". Without effects and moved values it is said that nothing predicts better.
    """
    repair = document["repair"]
    floor = document["noise_floor"]
    sizes = f"error / noise {times_noise(document['gap_before'])} nominal"
    if document["deviations"]:
        sizes += f", {times_noise(document['gap_refit'])} re-estimated"

    effects = []
    for effect in repair["effects"]:
        name, *parameters = effect.items()
        key, value = parameters[0]
        effects.append(f"{in_words(name[1])} ({parameter_words(key, value)})")
    moved = [key_words(key) for key, off in document["deviations"].items() if off]

    if effects or moved:
        sizes += f", {times_noise(document['gap_after'])} repaired"
    threshold = document["completeness"]["threshold"]
    sizes += "" if threshold else f" (noise alone {times_noise(floor)})"
    if not effects and not moved:
        return f"{sizes}; nothing that was tried predicts validation records better"
    with_effects = f", with {listing(effects)}" if effects else ""
    return f"{sizes}{with_effects}; moved: {listing(moved) if moved else 'no value'}"


def unexplained_words(found: Any) -> str:
    """A sentence on what the repaired model of a diagnosis leaves that nothing on the list explains.

    "" where that is little, no repair was made, or the answer is that nothing is missing.
    """
    prediction = found.prediction
    if not prediction or found.verdict == "none" or prediction.unexplained < _LEAST_UNEXPLAINED:
        return ""
    return f"{portion(prediction.unexplained)} of the error is explained by nothing on the list."


def closure_words(document: Mapping[str, Any]) -> str:
    """Share of the model error that is explained, with its interval; a dash where nothing was added."""
    closed = document["gap_closed"]
    if not document["repair"]["effects"] or closed is None:
        return MISSING
    low, high = (100 * v if v is not None else float("nan") for v in document["gap_closed_interval"])
    return f"{number(100 * closed, 4)} % ({number(low, 4)} to {number(high, 4)})"


def trend_words(found: Any) -> str:
    """A `fleet.Trend` in one sentence."""
    what = (
        f"{in_words(found.effect)}: {stated_name(found.parameter)}"
        if found.effect
        else key_words(found.parameter)
    )
    grows = "grows" if found.tau > 0 else "falls"
    slope = si(abs(found.per_number), stated_unit(found.parameter), 3)
    return (
        f"{what} {grows} with the number in the name, by {slope} per number (Kendall's tau {found.tau:.2f}, "
        f"p = {found.p:.1g}, {found.machines} machines)"
    )


def of_finding(words: Callable[[Mapping[str, Any]], str]) -> Callable[[Any], str]:
    """Words of a dependence that is a record of numbers, or the same in JSON."""
    return lambda finding: words(codec.plain(finding))


FILTERS: Mapping[str, Callable[..., Any]] = {
    "effect": in_words,
    "parameter_unit": unit_of,
    "parameter": parameter_words,
    "parameter_name": name_words,
    "value_unit": stated_unit,
    "value_name": stated_name,
    "rig_key": key_words,
    "setting_of": setting_words,
    "probability": probability_words,
    "times_noise": times_noise,
    "sureness": sureness,
    "short_answer": short_answer,
    "nothing_tried": nothing_tried,
    "closure": closure_words,
    "repair": repair_words,
    "unexplained": unexplained_words,
    "select_moved": lambda deviations: [key for key, off in deviations.items() if off],
    "trend": trend_words,
    "dependence": of_finding(dependence_words),
    "dependence_line": of_finding(dependence_line),
    "dependence_short": of_finding(dependence_short),
    "alternatives": of_finding(alternatives_words),
}
