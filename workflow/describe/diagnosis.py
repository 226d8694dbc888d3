"""The answer of a diagnosis in sentences: the headline, the numbers and the findings of its page.

Each function answers one question and returns sentences, the weightiest first; none where there is nothing
to say.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby

from diagnosis.answer import Diagnosis, NamedEffect
from plant.effects import EFFECTS, in_words
from workflow.describe.diagnosis_view import DiagnosisView
from workflow.describe.diagnosis_words import (
    begun,
    key_words,
    names_words,
    output_unit,
    parameter_words,
    probability_words,
    sureness,
    value_words,
    with_sizes,
)
from workflow.describe.facts import Quantity, Row
from workflow.describe.where import mostly
from workflow.text.formats import listing, number, portion, share as percentage, si, signed
from workflow.text.names import name_words, stated_name

# An answer that the records do not exclude is named as another one from this probability on; below, it fits
# as well with parameters that the records do not need.
LEAST_LIKELY = 0.05
# An effect with this probability is present: the answer names it as such, not as an alternative.
PRESENT = 0.5
# The next likeliest answer is named from this probability on. Chosen: below, no reader would look into it.
LEAST_RUNNER_UP = 0.001
# Share of the error, explained by nothing on the list, from which on a page says so. Chosen: less is what a
# good model leaves, too.
LEAST_UNEXPLAINED = 0.05
# Times the floor up to which a size is no more than it: what chance adds to it in records of usual length.
NO_MORE_THAN_NOISE = 1.03
# Tolerances by which a nominal value is far off: one in twenty is. From so many it is said to have moved.
FAR_OFF = 2.0


def is_noise(rms: float, floor: float) -> bool:
    """Whether a size is no more than noise, or than the threshold."""
    return rms <= NO_MORE_THAN_NOISE * floor


def far_off(moved: Mapping[str, float]) -> str:
    """Nominal values that moved by far more than their tolerance, and how far; "" where none did."""
    return listing(
        [
            f"{key_words(key)} by {signed(tolerances)} tolerances"
            for key, tolerances in moved.items()
            if abs(tolerances) >= FAR_OFF
        ]
    )


def unexplained_words(answer: Diagnosis) -> str:
    """What the repaired model of a diagnosis leaves that nothing on the list explains.

    "" where that is little, no repair was made, or the answer is that nothing is missing.
    """
    prediction = answer.prediction
    if not prediction or answer.verdict == "none":
        return ""
    # nan where there is no error to explain.
    if not prediction.unexplained >= LEAST_UNEXPLAINED:
        return ""
    return f"{portion(prediction.unexplained)} of the error is explained by nothing on the list."


def with_probabilities(answer: Diagnosis, effects: Iterable[str]) -> str:
    """Effects, each with its probability of being there."""
    return listing([f"{in_words(name)} ({probability_words(answer.presence(name))})" for name in effects])


# -- headline ------------------------------------------------------------------------------------------------


def headline(view: DiagnosisView) -> str:
    """Both answers in one line: which effects are present, and whether that is all."""
    answer = view.shown
    if not view.converged:
        return "No verdict: the fit did not converge"
    if answer.present:
        return _present_headline(view)
    if answer.nothing_tried:
        return "No answer: nothing was tried within the time limit"
    if answer.detail_verdict == "parametric":
        return "No effect is missing, but nominal parameters are outside their tolerances"
    if answer.verdict == "none":
        return _none_headline(view)
    return _unknown_headline(view)


def _present_headline(view: DiagnosisView) -> str:
    answer = view.shown
    names = [effect.name for effect in answer.present]
    present = []
    for effect in answer.present:
        first_size = [f", {value_words(key, value)}" for key, value in list(effect.parameters.items())[:1]]
        probability = probability_words(effect.presence)
        present.append(f"{in_words(effect.name)} ({probability}{''.join(first_size)})")
    words = listing(present)
    if not view.is_all:
        words += f" and something else: {_unexplained_by_present(view)}"

    rivals = [
        f"{in_words(name)} ({probability_words(answer.presence(name))})"
        for name in answer.instead
        if name not in ("none", "unknown") and LEAST_LIKELY <= answer.presence(name) < PRESENT
    ]
    if rivals:
        words += f"; or instead {' or '.join(rivals)}"
    also = [name for name in answer.perhaps if name not in names]
    if also:
        words += f"; perhaps also {with_probabilities(answer, also)}"
    beside = [
        f"{in_words(name)} (not certain: {probability_words(answer.presence(name))})"
        for name in answer.beside
        if name not in names
    ]
    if beside:
        words += f"; the repaired model also has {listing(beside)}"
    return begun(words)


def _left_in_record(answer: Diagnosis) -> str:
    complete = answer.completeness
    return f"{percentage(complete.most_in_record, 2)} of the motion of {complete.in_record} is unexplained"


def _unexplained_by_present(view: DiagnosisView) -> str:
    """What remains beside the effects that are present, and between which frequencies."""
    answer = view.shown
    if answer.completeness.above_elsewhere:
        words = _left_in_record(answer)
    elif view.rough:
        words = f"{percentage(answer.completeness.most, 2)} of the motion is unexplained"
    else:
        words = f"the error left is {view.size(answer.gap_after)}"
    lies = mostly(view.remains)
    return f"{words}, {lies}" if lies else words


def _none_headline(view: DiagnosisView) -> str:
    answer = view.shown
    if not view.rough:
        return "No model error beyond sensor noise and tolerances"
    what = "No significant model error" if view.is_all else "No candidate effect is present"
    threshold = f"your threshold of {number(answer.noise_floor, 3)} %"
    if not view.is_all and answer.completeness.above_elsewhere:
        return (
            f"{what}: {_left_in_record(answer)}, above {threshold}, though validation records stay below it"
        )
    beside = "above"
    if answer.gap_after <= answer.noise_floor:
        beside = "below"
    elif view.is_all:
        beside = "close to"
    return f"{what}: {view.size(answer.gap_after)} unexplained, {beside} {threshold}"


def _unknown_headline(view: DiagnosisView) -> str:
    answer = view.shown
    candidates = "candidate effects that were tried" if answer.untried else "candidate effects"
    partly = answer.partial_model and not answer.unlisted
    words = f"None of the {candidates} explains the model error{' completely' if partly else ''}"
    if answer.unlisted:
        words += f"; it looks like {names_words(effect.id for effect in answer.unlisted)}"
    if partly:
        explain = "together explain" if len(answer.partial_model) > 1 else "explains"
        words += f"; {names_words(answer.partial_model)} {explain} {percentage(answer.gap_closed)}"
    if answer.untried:
        words += f"; {len(answer.untried)} were not tried"
    return words


# -- numbers -------------------------------------------------------------------------------------------------


def numbers(view: DiagnosisView) -> tuple[Row, ...]:
    """At most five: size of the error before and after, what is explained, how sure, whether that is all.

    Sizes have a key where the page shows them as the answer holds them, over the noise.
    """
    answer = view.shown

    def size(key: str, name: str, value: float, remark: str) -> Row:
        unit = "% of the motion" if view.rough else "× noise"
        quantity = Quantity(view.size(value), float(value), unit)
        return Row("" if view.rough else key, name, quantity, remark)

    limit = number(answer.noise_floor, 3)
    floor = f"threshold: {limit} %" if view.rough else f"noise alone: {limit}"
    rows = [
        size(
            "gap_before",
            "model error before",
            answer.gap_before,
            f"validation, nominal parameters; {floor}",
        )
    ]
    if answer.added:
        rows.append(size("gap_after", "model error after", answer.gap_after, "validation, effects added"))
        if not math.isnan(answer.gap_closed):
            above = "noise and rounding" if answer.rounding_rms and view.rough else "noise"
            least = percentage(answer.gap_closed_interval[0])
            rows.append(
                Row(
                    "gap_closed",
                    "explained",
                    Quantity(percentage(answer.gap_closed, 3), float(answer.gap_closed)),
                    f"of the energy above {above}, against the better nominal; at least {least} (95 %)",
                )
            )
    elif answer.deviations:
        rows.append(
            size("gap_refit", "model error after", answer.gap_refit, "validation, parameters re-estimated")
        )
    if view.converged and not answer.nothing_tried:
        complete = answer.completeness.probability
        what_remains = "below the threshold" if view.rough else "noise"
        rows += [
            Row(
                "probability",
                "probability of the answer",
                Quantity(probability_words(answer.probability), float(answer.probability)),
                sureness(answer.probability),
            ),
            Row(
                "completeness.probability",
                "complete",
                Quantity(probability_words(complete), float(complete)),
                f"what remains is {what_remains}",
            ),
        ]
    return tuple(rows)


# -- findings ------------------------------------------------------------------------------------------------


def repair_sentences(view: DiagnosisView) -> Iterator[str]:
    """What makes the simulation predict better, whoever is the cause."""
    answer = view.shown
    moved = [key for key, deviation in answer.deviations.items() if deviation]
    if answer.nothing_tried:
        return
    if not answer.added and not moved:
        if answer.prediction:
            yield (
                "No effect and no moved value that was tried predicts validation records better than the "
                "nominal model."
            )
        return

    changes = "The repaired model"
    if answer.added:
        changes += f" has {with_sizes(answer.repair)}"
    if moved:
        changes += f"{' and' if answer.added else ''} moves {listing([key_words(key) for key in moved])}"
    elif answer.deviations:
        changes += "; all nominal values stay as stated"
    nominal = f"nominal {view.bare_size(answer.gap_before)}"
    if answer.deviations:
        nominal += f", re-estimated {view.bare_size(answer.gap_refit)}"
    yield (
        f"{changes}. Of validation records, to which nothing was fitted, it leaves "
        f"{view.size(answer.gap_after)} ({nominal})."
    )
    unexplained = unexplained_words(answer)
    if unexplained:
        yield unexplained


def which_sentences(view: DiagnosisView) -> Iterator[str]:
    """Which effects, how large, and which other answers the records do not exclude."""
    answer = view.shown
    if not view.converged:
        yield "The fit did not converge. The numbers are the best point it reached, not an answer."
    if answer.verdict == "effect":
        for effect in answer.effects:
            if effect.name in answer.combination:
                yield from _effect_sentence(effect)
    elif answer.verdict == "unknown" and not answer.untried:
        if answer.unlisted:
            yield f"Best explanation: {with_sizes(answer.unlisted)}."
        else:
            floor = "the threshold" if view.rough else "the noise"
            yield f"No small set of effects brings the residual down to {floor}."
    if answer.verdict == "unknown" and view.partial:
        parts = []
        for names, explained in view.partial:
            explain = "explains" if len(names) == 1 else "explain"
            parts.append(f"{names_words(names)} {explain} {percentage(explained)}")
        yield f"Partial answers, each by itself: {'; '.join(parts)}."
    yield from _untried_sentences(answer)
    yield from _remarks_on_values(answer)
    if answer.held_out_decided:
        yield (
            "The validation records did not confirm the answer of the estimation records. They were counted "
            "in as well, so they are not an independent check."
        )
    if answer.perhaps:
        yield f"There could also be {with_probabilities(answer, answer.perhaps)}."
    yield from _other_answers(answer)


def _effect_sentence(effect: NamedEffect) -> Iterator[str]:
    """An accepted effect with its sizes and what it explains."""
    parts = [
        parameter_words(key, value, effect.intervals.get(key)) for key, value in effect.parameters.items()
    ]
    explained = explains_words(effect)
    if explained:
        parts.append(f"explains {explained} of the error")
    if parts:
        yield f"{begun(in_words(effect.name))}: {'; '.join(parts)}."


def explains_words(effect: NamedEffect) -> str:
    """Share of the validation error that an effect explains; "" where it is not known."""
    return "" if math.isnan(effect.explains[0]) else portion(effect.explains[0])


def _untried_sentences(answer: Diagnosis) -> Iterator[str]:
    """Untried is not absent."""
    by_need = sorted(answer.untried.items(), key=lambda item: item[1])
    for needs, items in groupby(by_need, key=lambda item: item[1]):
        names = [name for name, _ in items]
        need = "This needs" if len(names) == 1 else "These need"
        yield f"Not tried, and not excluded: {names_words(names)}. {need} {needs}."
    not_tried = answer.shares.not_tried if answer.shares else ()
    left_out = [name for name in not_tried if name not in answer.untried]
    if left_out:
        yield f"The time limit left out: {names_words(left_out)}."


def _remarks_on_values(answer: Diagnosis) -> Iterator[str]:
    """Sentences on values whose interval does not say all.

    A value at an end of its searched range is not determined. `widened_by` of an effect names the stated
    value whose tolerance makes up most of its variance, so that without it half of the width goes.
    """
    for effect in answer.present:
        name = in_words(effect.name)
        for key, remark in effect.remarks.items():
            yield f"{begun(name)}: {stated_name(key)} is {remark}; these records do not determine it."
        if effect.widened_by:
            yield (
                f"{begun(name)}: the interval is wide mainly because {key_words(effect.widened_by)} is only "
                "known within its tolerance. With exact nominal values it would be half as wide or less."
            )


def _other_answers(answer: Diagnosis) -> Iterator[str]:
    """Answers that could stand in place of this one, else the next likeliest."""
    if answer.instead:
        likely = [name for name in answer.instead if answer.presence(name) >= LEAST_LIKELY]
        alike = [name for name in answer.instead if answer.presence(name) < LEAST_LIKELY]
        if likely:
            yield f"These records do not exclude another answer: {with_probabilities(answer, likely)}."
        if alike:
            yield (
                f"{begun(names_words(alike))} would fit as well, with parameters that these records do not "
                "need."
            )
        for name in answer.combination:
            distinguishes = EFFECTS[name].beside if name in EFFECTS else ""
            if distinguishes and "unknown" in answer.ambiguous_with:
                yield (
                    f"Causes that are not candidates act like {in_words(name)} too: {distinguishes} would "
                    "distinguish them."
                )
    elif answer.verdict == "effect" and not answer.perhaps:
        second = answer.runner_up
        if answer.presence(second) >= LEAST_RUNNER_UP:
            yield f"Next likeliest: {with_probabilities(answer, [second])}."
        else:
            yield "Every other answer has a probability below 0.1 %."


def closure_sentences(view: DiagnosisView) -> Iterator[str]:
    """What the repaired model is worth, beside the numbers of the first screen."""
    answer = view.shown
    if not answer.added:
        return
    if math.isnan(answer.gap_closed):
        yield (
            "The validation records show no model error beyond noise: the effect shows in the estimation "
            "records."
        )
        return
    shares = answer.shares
    if shares and shares.small:
        parts = []
        for name in shares.small:
            part = f"present with {probability_words(answer.presence(name))}"
            # Nothing is shared out where a time limit came first, or there is no error to share out.
            if name in shares.carried:
                part = f"{portion(shares.carried[name][0])} of the error, {part}"
            parts.append(part)
        verb = "is" if len(shares.small) == 1 else "are"
        yield (
            f"{names_words(shares.small)} {verb} in the repaired model too, but not certain: "
            f"{'; '.join(parts)}."
        )
    if answer.partial_model and not answer.unlisted:
        yield (
            f"{names_words(answer.partial_model)} may stand in for the true cause: at other speeds or "
            "amplitudes the model may be worse."
        )
    if shares and shares.silent:
        yield (
            f"The validation records do not excite {names_words(shares.silent)}. That part of the answer "
            "rests on the estimation records."
        )
    if shares and shares.horizon_samples:
        window = si(shares.horizon_samples * answer.case.dt_s, "s")
        yield (
            f"In windows of {window}, each from the state that fits it best, "
            f"{percentage(shares.horizon_closed)} is explained."
        )


def size_sentences(view: DiagnosisView) -> Iterator[str]:
    """What is behind the size of the model error, what makes the answer doubtful, and what it names."""
    answer = view.shown
    if not answer.deviations:
        yield "The rig file gives no tolerances: its values are taken as exact."
    elif not any(view.moved_refit.values()):
        yield ("Nominal parameters are as stated: re-estimating them makes the validation records worse.")
    else:
        yield _re_estimated(view)
    if view.rough and not answer.case.machine.weighing.stated:
        threshold = number(answer.noise_floor, 3)
        yield f"The threshold of {threshold} % is the usual one: model_error is unspecified."
    for doubt in answer.doubts:
        yield f"This makes the answer doubtful: {doubt}{'' if doubt.endswith('?') else '.'}"
    if answer.noise_below_stated:
        noises = []
        for name, seen, stated in answer.noise_below_stated:
            unit = output_unit(name, {})
            noises.append(f"{name_words(name)} {si(seen, unit, 3)} (specified: {si(stated, unit, 3)})")
        yield (
            f"The records show less noise than specified; the noise they show is used: {'; '.join(noises)}."
        )
    if answer.verdict == "none":
        yield "No candidate effect is needed to explain the records."
    elif not view.converged:
        yield "No cause is named: more or better records are needed."


def _re_estimated(view: DiagnosisView) -> str:
    """What the nominal parameters alone explain, and whether they had to move far for it."""
    answer = view.shown
    words = (
        "Re-estimating the nominal parameters (tolerances as standard deviations) leaves "
        f"{view.size(answer.gap_refit)}"
    )
    far = far_off(view.moved_refit)
    if is_noise(answer.gap_refit, answer.noise_floor):
        words += f", {'below the threshold' if view.rough else 'no more than noise'}"
        if far:
            words += f", but only by moving {far}"
    elif far:
        words += f", and moves {far}"
    return f"{words}."


def remaining_sentences(view: DiagnosisView) -> Iterator[str]:
    """What the repaired model still misses."""
    answer = view.shown
    name, worst = answer.worst_experiment
    if not is_noise(worst, answer.noise_floor):
        yield f"The largest residual left is {view.size(worst)}, in {name}."
    else:
        every = "With the effects added, every" if answer.added else "Every"
        if view.rough:
            yield (
                f"{every} experiment is below the threshold of {number(answer.noise_floor, 3)} %: at most "
                f"{view.size(worst)}, in {name}."
            )
        else:
            yield f"{every} experiment is within 3 % of the noise."
    if view.rough and answer.rounding_rms:
        yield f"Rounding of the sensor alone leaves {view.size(answer.rounding_rms)}, whatever the model."
    far = far_off(view.moved)
    if far:
        yield f"Nominal parameters far outside their tolerances: {far}. Measure them."


def first_bullets(
    view: DiagnosisView, where: str, advice: Sequence[str], of_model: Sequence[str] = ()
) -> tuple[str, ...]:
    """Sentences of the first screen, the weightiest first.

    Args:
        view: The diagnosis.
        where: Where the error lies, in a sentence; left out where no candidate effect is needed.
        advice: What to do next.
        of_model: What is to be said of the repaired model's file.
    """
    bullets = [*repair_sentences(view), *which_sentences(view), *of_model]
    # "none" says that no candidate effect is needed, not that there is no model error.
    if view.found.verdict != "none":
        bullets.append(where)
    return (*bullets, *advice, *closure_sentences(view), *size_sentences(view))
