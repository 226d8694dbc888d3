"""The answer in sentences, in the order a person asks for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diagnosis.diagnosis import Diagnosis
from workflow.diagnose.words import (
    effect_words,
    key_words,
    parameter_words,
    probability_words,
    sureness,
    times_noise,
)
from workflow.report.formats import listing, number

# A stated value that had to move further than this is worth a sentence.
NOTABLE_TOLERANCES = 2.0
# Largest residual, RMS over the floor, that is called noise.
_NOISE_SHARE = 1.03
# Below this probability of the answer the headline says "may".
_SURE = 0.66
# A rival less probable than this is named further down.
_WORTH_A_HEADLINE = 0.05


def headline(found: Diagnosis) -> str:
    """The whole answer in one sentence."""
    detail = found.detail_verdict
    if detail == "not_converged":
        return "No verdict: the fit did not converge"
    if detail == "parametric":
        return "No effect is missing, but stated values are further off than their tolerances allow"
    if found.verdict == "none":
        return "No gap beyond sensor noise and the stated tolerances"
    if found.verdict == "unknown":
        likeness = listing([effect_words(type(effect).id) for effect in found.unlisted])
        text = "There is a gap, and nothing on the list explains it"
        return f"{text}; it looks like {likeness}" if likeness else text
    names = listing([effect_words(name) for name in found.combination])
    text = f"The gap {'comes' if answer_probability(found) >= _SURE else 'may come'} from {names}"
    others = [
        effect_words(name)
        for name in found.ambiguous_with
        if name != "none" and presence_of(found, name) >= _WORTH_A_HEADLINE
    ]
    return text + (f", or from {listing(others)}" if others else "")


def gap_sentences(found: Diagnosis) -> list[str]:
    """Is there a gap beyond noise?"""
    floor = found.noise_floor
    words = [
        "With the rig as stated the residual of the held-out experiments is "
        f"{times_noise(found.gap_before)} times the sensor noise (RMS); noise alone would give "
        f"{number(floor)}."
    ]
    if found.deviations:
        moved = f"Moving the stated values within their tolerances leaves {times_noise(found.gap_refit)}"
        words.append(moved + (", which is no more than noise." if _is_noise(found.gap_refit, floor) else "."))
    else:
        words.append("The rig file states no tolerances: its values are taken as exact.")
    if found.verdict == "none":
        words.append(
            "No effect of the list is needed to explain the records; what may hide below is smaller than "
            "these records can show."
        )
    elif found.detail_verdict == "not_converged":
        words.append("The fit did not converge, so no cause is named: more or better records are needed.")
    return words


def which_sentences(found: Diagnosis) -> list[str]:
    """Which effect, how sure, and what it could be confused with."""
    p = found.probabilities
    words: list[str] = []
    if found.detail_verdict == "not_converged":
        words.append("The fit did not converge: what follows is the best point it reached, not an answer.")
    if found.verdict == "effect":
        sure = answer_probability(found)
        names = listing([effect_words(name) for name in found.combination])
        together = " together" if len(found.combination) > 1 else ""
        words.append(f"{_capital(names)}{together}: {sureness(sure)} ({probability_words(sure)}).")
        words += parameter_sentences(found, found.combination)
    elif found.verdict == "none":
        words.append(f"That nothing is missing is {sureness(p['none'])} ({probability_words(p['none'])}).")
    elif found.verdict == "unknown" and found.unlisted:
        words.append(
            f"That the cause is outside the list is {sureness(p['unknown'])} "
            f"({probability_words(p['unknown'])}): what explains the records best is {unlisted_words(found)}."
        )
    elif found.verdict == "unknown":
        words.append(
            f"That the cause is outside the list is {sureness(p['unknown'])} "
            f"({probability_words(p['unknown'])}): no effect, and no set of a few effects, brings the "
            "residuals down to the noise."
        )
    if found.held_out_decided:
        words.append(
            "The held-out records did not confirm what the records of estimation said alone; how well each "
            "answer predicts them has been counted too, so they are no independent check of this choice."
        )
    if found.ambiguous_with:
        others = [
            f"{effect_words(n)} ({probability_words(presence_of(found, n))})" for n in found.ambiguous_with
        ]
        words.append(f"It could also be {listing(others)}: these records do not rule that out.")
        if "gravity" in found.combination and "unknown" in found.ambiguous_with:
            words.append(
                "A linear spring from hub to ground (a cable, a hose) is not on the list and pulls as "
                "gravity does while angles are small; larger swings would tell them apart."
            )
    elif found.verdict == "effect":
        value, name = max(
            (presence_of(found, n), n) for n in found.probabilities if n not in found.combination
        )
        words.append(
            f"The next likeliest answer is {effect_words(name)} ({probability_words(value)})."
            if value >= 1e-3
            else "No other answer is likelier than one in a thousand."
        )
    return words


def unlisted_words(found: Diagnosis) -> str:
    """A cause beyond the list, and what it acts beside, with their sizes."""
    parts = []
    for effect in found.unlisted:
        sizes = listing([parameter_words(key, value, None) for key, value in effect.parameters().items()])
        parts.append(f"{effect_words(type(effect).id)} ({sizes})")
    return listing(parts)


def parameter_sentences(found: Diagnosis, names: Sequence[str]) -> list[str]:
    """Fitted sizes with their 95 % intervals."""
    words = []
    for effect in (effect for effect in found.effects if effect.name in names):
        parts = [parameter_words(k, value, effect.intervals.get(k)) for k, value in effect.parameters.items()]
        words.append(f"Fitted, {effect_words(effect.name)}: {'; '.join(parts)}.")
    return words


def answer_probability(found: Diagnosis) -> float:
    """Of the main cause where it stands alone, of the whole set where several effects are accepted."""
    if found.verdict != "effect":
        return found.probabilities[found.verdict]
    if len(found.combination) == 1:
        return found.probabilities[found.combination[0]]
    return found.sets[tuple(sorted(found.combination))]


def presence_of(found: Diagnosis, name: str) -> float:
    """Probability that an effect is there at all; of "none" and "unknown" that they are the answer."""
    return next(effect.presence for effect in found.effects if effect.name == name)


def suspicion_sentences(found: Diagnosis, suspected: Sequence[str]) -> list[str]:
    """What the case file asked about."""
    return [
        f"Asked about: {effect_words(name)} has probability {probability_words(presence_of(found, name))}"
        + (" and is part of the answer." if name in found.combination else ".")
        for name in suspected
    ]


def closure_sentences(found: Diagnosis) -> list[str]:
    """How far the gap shrinks."""
    if not found.combination:
        return ["Nothing was added to the model, so nothing is closed."]
    low, high = found.gap_closed_interval
    names = listing([effect_words(name) for name in found.combination])
    if np.isnan(found.gap_closed):
        return [
            f"The held-out experiments hold no gap to close beyond noise ({times_noise(found.gap_refit)} "
            f"times the noise before, {times_noise(found.gap_after)} with {names}): the effect shows in the "
            "experiments of estimation."
        ]
    return [
        f"With {names} in the model the held-out residual falls from {times_noise(found.gap_before)} (rig "
        f"as stated){_by_way_of(found)} to {times_noise(found.gap_after)} times the noise.",
        f"That closes {number(100 * found.gap_closed, 4)} % of the explainable gap "
        f"(95 % by resampling blocks: {number(100 * low, 4)} to {number(100 * high, 4)} %). The held-out "
        "experiments were never fitted.",
    ]


def _by_way_of(found: Diagnosis) -> str:
    return f" by way of {times_noise(found.gap_refit)} (values moved)" if found.deviations else ""


def remaining_sentences(found: Diagnosis) -> list[str]:
    """What the repaired model still misses."""
    after = {name: float(np.sqrt(np.mean(e**2))) for name, e in found.residuals_after.items()}
    worst = max(after, key=after.__getitem__)
    if all(_is_noise(value, found.noise_floor) for value in after.values()):
        words = ["No experiment keeps more than 3 % above the noise floor."]
    else:
        words = [f"The largest residual left is {times_noise(after[worst])} times the noise, in {worst}."]
    far = {key: d for key, d in found.deviations.items() if abs(d) >= NOTABLE_TOLERANCES}
    if far:
        moved = [f"{key_words(key)} by {number(d, 2)} tolerances" for key, d in far.items()]
        words.append(
            f"Stated values that had to move far: {listing(moved)}. Measure them: that is a finding too."
        )
    return words


def control_sentences(check: Mapping[str, Any]) -> list[str]:
    """What it means for a controller, from the document of the check."""
    if "skipped" in check:
        return [check["skipped"]]
    first, second, third, fourth = check["runs"]
    return [
        f"Designed on the rig as stated, the loop promises a cost of {number(first['cost_s'])} s and a "
        f"modulus margin of {number(first['modulus_margin'])}. On the repaired machine it reaches "
        f"{_reached(second, first)}",
        f"Designed on the repaired rig, it promises {number(third['cost_s'])} s and "
        f"{number(third['modulus_margin'])}, and reaches {_reached(fourth, third)}",
    ]


def _reached(achieved: Mapping[str, Any], predicted: Mapping[str, Any]) -> str:
    percent = round(100 * (achieved["cost_s"] / predicted["cost_s"] - 1), 1) + 0.0
    text = f"{number(achieved['cost_s'])} s ({percent:+.1f} %) and {number(achieved['modulus_margin'])}"
    return text + ("." if achieved["settles"] else "; it does not settle.")


def _is_noise(rms: float, floor: float) -> bool:
    return rms <= _NOISE_SHARE * floor


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
