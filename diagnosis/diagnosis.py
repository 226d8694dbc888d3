"""The answer about one case: is there a gap, which effect, how sure, how far the gap shrinks with it."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diagnosis.answer import (
    FAR_OFF,
    NOISE_FLOOR,
    POSSIBLE,
    SURE,
    DetailVerdict,
    Diagnosis,
    NamedEffect,
    Verdict,
    best_first,
    completeness_of,
    held_out_gap,
    remarks,
    share_closed,
)
from diagnosis.evidence.confirmation import confronted
from diagnosis.evidence.hypotheses import DISAGREEMENT, Hypothesis, Probabilities, probabilities
from diagnosis.evidence.search import WhiteSearch
from diagnosis.fit.coordinates import parameter_intervals
from diagnosis.fit.descent import Descent, descend
from diagnosis.fit.levels import quietest
from diagnosis.fit.residual import ResidualModel
from diagnosis.imperfect.answered import (
    beside_imperfections,
    looked_at_again,
    reaches_noise,
    searched,
)
from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import CaseOfMachine
from diagnosis.machine.own_plant import PlantCase
from diagnosis.machine.probed import doubts_about
from diagnosis.machine.rounding import Rounding, leads_over, rounding_effect
from diagnosis.next_experiment.discrimination import (
    CompetingHypothesis,
    competing_hypotheses,
    competing_hypothesis,
)
from diagnosis.search.loop import Progress
from plant.effects import LOOK_ALIKES
from plant.effects.search_space import Candidate

# Share of a time limit for fits; the rest is for what the answer needs besides.
_SEARCHED = 0.9
# Share of the progress that the first search is; the second may not be needed.
_FIRST_SEARCH = 0.6
# Noise of an own machine is what the quietest octave shows where that is below the one share of what is
# stated, not below the other.
_TOO_LOUD, _LEAST = 0.5, 1e-3
# At most so many explanations are told apart by the next experiment.
_MOST_COMPETING = 3
# Difference of the cost that the records do not tell apart (chi-square, 95 %, two parameters).
_AS_GOOD = 6.0
_LAST_ITERATIONS, _LAST_TOLERANCE = 40, 0.01
_DRAWS = 4000


def diagnose(
    case: CaseOfMachine,
    *,
    progress: Progress | None = None,
    rng: np.random.Generator | None = None,
    time_limit_s: float = np.inf,
) -> Diagnosis:
    """Search, weigh, and answer.

    case : A `Case` (flexible link) or a `PlantCase` (a simulation of one's own).
    progress : Called with the share done (0 to 1) and what is being done.
    time_limit_s : After it nothing more is tried, and the answer says what was not; only
        beside a model error.
    rng : Of interval draws and bootstrap; without it a fixed sequence, so that one case has one answer.

    Warns where the records of an own machine show less noise than is stated, and an effect in what that hid,
    and of what makes its answer doubtful (`doubts_about`, which raises ValueError where it is random).
    """
    rng = np.random.default_rng(0) if rng is None else rng
    progress = progress or (lambda fraction, message: None)
    deadline_s = time.monotonic() + _SEARCHED * time_limit_s
    doubts = doubts_about(case, deadline_s) if isinstance(case, PlantCase) else ()
    for doubt in doubts:
        warnings.warn(f"plant: {doubt}", stacklevel=2)
    return replace(_at_noise_seen(case, progress, rng, deadline_s), doubts=doubts)


def _at_noise_seen(
    case: CaseOfMachine, progress: Progress, rng: np.random.Generator, deadline_s: float
) -> Diagnosis:
    """With the noise as stated, or as the records show it where that tells more."""
    answer = _answered(case, progress, rng, deadline_s)
    hidden = answer.verdict == "none" or (answer.shares and not any(answer.shares.before))
    if not (hidden and isinstance(case, PlantCase)) or time.monotonic() > deadline_s:
        return answer
    seen = quietest([e * case.noise for e in answer.residuals_refit.values()])
    if not np.any(seen < _TOO_LOUD * case.noise):
        return answer
    quieter = case.with_noise(np.clip(seen, _LEAST * case.noise, case.noise))
    last = _answered(quieter, lambda done, what: progress(1.0, f"{what}, less noise"), rng, deadline_s)
    if last.verdict != "effect":
        return answer
    noise = zip(case.outputs, map(float, quieter.noise), map(float, case.noise), strict=True)
    last = replace(last, noise_below_stated=tuple(noise))
    words = ", ".join(
        f"{name} {seen:.3g}, stated {stated:.3g}" for name, seen, stated in last.noise_below_stated
    )
    warnings.warn(f"plant: the records show less noise than stated, which counts: {words}", stacklevel=3)
    return last


def _answered(
    case: CaseOfMachine, progress: Progress, rng: np.random.Generator, deadline_s: float
) -> Diagnosis:
    """With the noise as stated."""
    weighing = case.machine.weighing
    if not weighing.model_error > 0:
        return _without_error(case, progress, rng)
    if isinstance(case, Case):
        case = case.at_fast_lengths()
    found = searched(case, lambda done, what: progress(_FIRST_SEARCH * done, what), deadline_s)
    if found.left_out:
        return beside_imperfections(found, rng)

    def again(done: float, what: str) -> None:
        progress(_FIRST_SEARCH + (1 - _FIRST_SEARCH) * done, what)

    if not isinstance(case, PlantCase):
        return beside_imperfections(found, rng)
    if not weighing.stated and reaches_noise(found):
        exact = _without_error(case.without_model_error(), again, rng)
        if exact.verdict != "unknown":
            return exact
    return looked_at_again(found, beside_imperfections(found, rng), again, deadline_s, rng)


def _without_error(case: CaseOfMachine, progress: Progress, rng: np.random.Generator) -> Diagnosis:
    """Of a machine whose simulation, with the right effects, is as good as the sensors."""
    search = WhiteSearch(case, progress)
    search.run()
    model, base = search.records, search.base.end
    every: Sequence[Hypothesis] = search.found
    weighed = probabilities(every)
    accepted = _accepted(every, weighed.answer)
    unknown = weighed.answer == "unknown"
    leading = max(every, key=lambda h: h.unknown_weight) if unknown else accepted
    seen = None if unknown and leading.is_answer else confronted(model, every, leading)
    if seen is not None:
        every = seen
        weighed = probabilities(every)
        accepted = _accepted(every, weighed.answer)
    hypotheses = [h for h in every if h.is_answer]
    alike = [h for h in every if not h.is_answer]
    likeliest = max(every, key=lambda h: h.unknown_weight)
    last = _refined(model, accepted.fit)
    before = model.by_experiment(np.zeros(model.nominal.count), ())
    refit = model.by_experiment(base.deviations, ())
    after = model.by_experiment(last.deviations, last.effects)
    rounding = rounding_effect(case)
    if rounding is not None:
        leads = leads_over(case, rounding, refit, after)
        weighed = weighed.beside(rounding.name, leads=leads)
    floor = NOISE_FLOOR if rounding is None else rounding.floor
    answer = weighed.answer
    verdict: Verdict = "none" if answer == "none" else "unknown" if answer == "unknown" else "effect"
    together = accepted.names if rounding is None else rounding.joined(accepted.names, leads=leads)
    gap_before, gap_refit, gap_after = (held_out_gap(case, r) for r in (before, refit, after))
    closed, interval = share_closed(case, refit, after, rng, floor)
    ambiguous_with = _competing(weighed, hypotheses, accepted, together, answer)
    return Diagnosis(
        case=case,
        verdict=verdict,
        detail_verdict=_detail(verdict, weighed, ambiguous_with, last),
        probabilities=weighed.cause,
        sets=weighed.sets,
        effects=_named(model, hypotheses, weighed, together, last, (gap_refit, floor), rounding, rng),
        combination=together if verdict == "effect" else (),
        ambiguous_with=ambiguous_with,
        gap_before=gap_before,
        gap_refit=gap_refit,
        gap_after=gap_after,
        noise_floor=floor,
        gap_closed=closed,
        gap_closed_interval=interval,
        deviations=dict(zip(model.nominal.keys, map(float, last.deviations), strict=True)),
        deviations_refit=dict(zip(model.nominal.keys, map(float, base.deviations), strict=True)),
        rig=model.nominal.at(last.deviations).description,
        repair=last.effects if rounding is None else (*last.effects, rounding.effect),
        residuals_before=before,
        residuals_refit=refit,
        residuals_after=after,
        simulations=model.simulations,
        completeness=completeness_of(case, 1 - weighed.cause["unknown"], after),
        held_out_decided=seen is not None,
        unlisted=likeliest.fit.effects if verdict == "unknown" and not likeliest.is_answer else (),
        competing=_to_part(case, hypotheses, weighed, alike) if isinstance(case, Case) else (),
    )


def _to_part(
    case: Case, hypotheses: Sequence[Hypothesis], weighed: Probabilities, alike: Sequence[Hypothesis]
) -> tuple[CompetingHypothesis, ...]:
    """What the next experiment is to separate; what is unknown is one where it has a name (a look-alike)."""
    competing = competing_hypotheses(case, hypotheses, weighed.sets)
    if not alike:
        return competing
    likeliest = max(alike, key=lambda h: h.unknown_weight)
    imitated = [LOOK_ALIKES[n].look_alike_of for n in likeliest.names if n in LOOK_ALIKES]
    if min([weighed.cause["unknown"], *(weighed.presence[str(name)] for name in imitated)]) < POSSIBLE:
        return competing
    double = competing_hypothesis(case, likeliest.fit, weighed.cause["unknown"])
    return tuple(sorted((*competing, double), key=lambda hypothesis: -hypothesis.probability))[
        :_MOST_COMPETING
    ]


def _accepted(hypotheses: Sequence[Hypothesis], answer: str) -> Hypothesis:
    """The best hypothesis of the answer: nothing added for none and unknown, else the set it leads."""
    names = () if answer in ("none", "unknown") else (answer,)
    return max((h for h in hypotheses if h.names[:1] == names), key=lambda h: h.log_weight)


def _refined(model: ResidualModel, end: Descent) -> Descent:
    if not end.candidates and not end.deviations.size:
        return end
    last = descend(
        model,
        end.candidates,
        end.deviations,
        end.coordinates,
        model.start,
        iterations=_LAST_ITERATIONS,
        tolerance=_LAST_TOLERANCE,
    )
    return last if last.loss <= end.loss else end


def _detail(
    verdict: Verdict, weighed: Probabilities, competing: Sequence[str], last: Descent
) -> DetailVerdict:
    if not last.converged:
        return "not_converged"
    if verdict == "unknown":
        return "unknown"
    far = bool(last.deviations.size) and float(np.max(np.abs(last.deviations))) > FAR_OFF
    if verdict == "none":
        return "parametric" if far else "none"
    shares = {**weighed.presence, **{name: weighed.cause[name] for name in ("none", "unknown")}}
    likely = any(shares[name] >= POSSIBLE for name in competing)
    return "ambiguous" if weighed.cause[weighed.answer] < SURE or likely else "effect"


def _competing(
    weighed: Probabilities,
    hypotheses: Sequence[Hypothesis],
    accepted: Hypothesis,
    together: Sequence[str],
    answer: str,
) -> tuple[str, ...]:
    """Other answers that keep more than a few per cent, most probable first, then effects that fit as well.

    An effect that contains the accepted one (Stribeck friction beside Coulomb's) is improbable for its
    needless parameters, yet the records do not rule it out.
    """
    share = {name: p for name, p in weighed.presence.items() if name not in together}
    share |= {name: weighed.cause[name] for name in ("none", "unknown")}
    share.pop(answer, None)
    likely = [name for name, p in sorted(share.items(), key=lambda item: -item[1]) if p >= POSSIBLE]
    if accepted.names and answer != "unknown":
        for h in sorted(hypotheses, key=lambda h: h.fit.cost):
            if len(h.names) == len(accepted.names) and h.fit.cost <= accepted.fit.cost + _AS_GOOD:
                likely += [name for name in h.names if name not in (*together, *likely)]
    return tuple(likely)


def _named(
    model: ResidualModel,
    hypotheses: Sequence[Hypothesis],
    weighed: Probabilities,
    together: Sequence[str],
    last: Descent,
    gap: tuple[float, float],
    rounding: Rounding | None,
    rng: np.random.Generator,
) -> tuple[NamedEffect, ...]:
    """gap : of the nominal on validation records over noise, and the noise floor."""
    case = model.case
    samples = float(np.mean([len(record.output) for record in case.estimation]))

    def gap_of(end: Descent) -> float:
        return held_out_gap(case, model.by_experiment(end.deviations, end.effects, case.held_out))

    entries = []
    for name in case.machine.weighing.listed:
        holding = [h for h in hypotheses if name in h.names]
        entry = NamedEffect(name, weighed.cause[name], weighed.presence[name], {}, {}, float("nan"))
        if holding:
            end = last if name in last.names else max(holding, key=lambda h: h.log_weight).fit
            k = end.names.index(name)
            intervals, after = _intervals(end, k, samples, rng), gap_of(end)
            rest = {n for n in end.names if n != name}
            without = min(gap_of(h.fit) for h in hypotheses if rest == set(h.names)) if rest else gap[0]
            entry = replace(
                entry,
                parameters=end.candidates[k].parameters(end.coordinates_of(k)),
                intervals=intervals,
                gap_after=after,
                explains=(_explained(without, after, *gap), float("nan"), float("nan")),
                remarks=remarks(end.candidates[k], end.coordinates_of(k), intervals),
            )
        elif rounding is not None and name == rounding.name:
            entry = replace(
                entry,
                parameters=rounding.effect.parameters(),
                intervals=rounding.intervals,
                gap_after=gap_of(last),
            )
        entries.append(entry)
    entries += [
        NamedEffect(name, weighed.cause[name], weighed.cause[name], {}, {}, float("nan"))
        for name in ("none", "unknown")
    ]
    return best_first(entries, weighed.answer, together)


def _explained(without: float, after: float, refit: float, floor: float) -> float:
    """Share of the energy of the validation error beyond noise that an effect explains; nan without one."""
    error = refit**2 - floor**2
    return float(np.clip((without**2 - after**2) / error, 0.0, 1.0)) if error > 0 else float("nan")


def _intervals(
    end: Descent, k: int, samples_per_record: float, rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    """95 % intervals of the parameters of the k-th candidate, from Gaussian draws of its coordinates.

    What is left beyond the noise widens them in proportion, and so does what solvers may disagree about.
    """
    candidate: Candidate = end.candidates[k]
    at = end.deviations.size + sum(len(c.axes) for c in end.candidates[:k])
    rows = slice(at, at + len(candidate.axes))
    covariance = (
        np.asarray(np.linalg.pinv(end.hessian, hermitian=True), dtype=np.float64)[rows, rows]
        * max(1.0, end.rms**2)
        * _solver_variance(end, samples_per_record)
    )
    return parameter_intervals(candidate, end.coordinates_of(k), covariance, rng, _DRAWS)


def _solver_variance(end: Descent, samples_per_record: float) -> float:
    """Variance of fitted values in units of what white noise gives, where contacts switch.

    Two correct solvers of backlash drift apart once a contact falls differently, and stay apart to the end of
    a record: an error of their usual disagreement that is correlated over the record.
    """
    if not end.non_smooth:
        return 1.0
    # median of the half-normal prior of the disagreement's size
    usual = 0.674 * DISAGREEMENT["non-smooth"]
    return 1.0 + usual**2 * samples_per_record
