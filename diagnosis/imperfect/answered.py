"""The diagnosis of a machine with a stated model error: search, verdict, and the record of both."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from diagnosis.answer import Diagnosis, held_out_gap
from diagnosis.assembled import FittedEffect, Judgement, Model, assembled
from diagnosis.fit.coordinates import parameter_intervals, widened_by
from diagnosis.fit.descent import Descent
from diagnosis.imperfect import verdict as judging
from diagnosis.imperfect.carried import closed_by, shares_of
from diagnosis.machine.case import Case
from diagnosis.machine.flexible_arm import FlexibleArm
from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from diagnosis.machine.own_plant import PlantCase
from diagnosis.next_experiment.discrimination import MOST_COMPETING, CompetingHypothesis, fitted_hypothesis
from diagnosis.search.explanation import Explanation, best_of_sets
from diagnosis.search.loop import Progress
from diagnosis.search.search import Search
from plant.effects.search_space import Candidate

# RMS in noise deviations: what a simulation without error leaves, and a little that the search has not found.
_NEAR_NOISE = 2.0


def searched(case: CaseOfMachine, progress: Progress, deadline_s: float = np.inf) -> Search:
    """Everything fitted that a diagnosis beside a model error weighs.

    deadline_s : of time.monotonic(); after it nothing more is tried.
    """
    search = Search(case, progress, deadline_s)
    search.run_in_time()
    return search


def looked_at_again(
    first: Search, answer: Diagnosis, progress: Progress, deadline_s: float, rng: np.random.Generator
) -> Diagnosis:
    """The answer of a machine that does not forget its inputs, from windows where a free run says less.

    Windows are not looked at where the records leave no gap that interests, nor where the first answer leaves
    none, in them either; they are not taken where they only add to what was named.
    """
    # Unlisted causes act within windows too: what a free run leaves unknown stays so, and what it names of a
    # rig stands.
    named = set(answer.combination)
    windows = first.horizon if named and isinstance(answer.case, PlantCase) else None
    if windows is None:
        return answer
    search = Search(answer.case, progress, deadline_s, windows)
    holding = [e for e in first.found if named <= set(e.names)]
    if holding:
        named_alone = first.by_these(answer.combination, max(holding, key=lambda e: e.evidence))
        # The same effects in windows, descended on from where the free run ended.
        left = np.sqrt(search.explained(named_alone.end.on(search.records)).mean_squares)
        if max(np.max(left), np.max(named_alone.shares)) < answer.case.machine.weighing.model_error:
            return answer
    search.run_in_time()
    again = beside_imperfections(search, rng)
    return again if again.combination and not named < set(again.combination) else answer


def reaches_noise(search: Search) -> bool:
    """Whether some set leaves little beyond the noise of any output and record: it may be exact."""
    return any(
        max(np.sqrt(np.mean(part**2, axis=0)).max() for part in _whitened(search.case, e).values())
        < _NEAR_NOISE
        for e in search.found
    )


def beside_imperfections(search: Search, rng: np.random.Generator) -> Diagnosis:
    """The answer of a search beside a model error; what a time limit left out is said."""
    case = search.case
    listed, found = case.machine.weighing.listed, judging.judged(search)
    search.progress(1.0, "done")
    refit, best = found.nominal, found.judged[0]
    accepted, partial, looks_like = refit, tuple[str, ...](), False
    if found.answer == "unknown":
        looks_like = best.explains > 0.5 and not set(best.explanation.names) <= set(listed)
        accepted = _in_part(search, found, looks_like=looks_like)
        partial = tuple(sorted(accepted.names))
    elif found.accepted:
        whole = next(
            one for one in found.judged if found.fitted(found.accepted) <= {p.name for p in one.parts}
        )
        accepted = _kept(search, whole, found.accepted)
        if accepted.pooled_held_out(case.noise) > refit.pooled_held_out(case.noise):
            accepted = whole.explanation
    if accepted.names:
        # Values are re-estimated beside effects too only where that leaves less of the held-out records.
        accepted = min(accepted, search.stated(accepted), key=lambda e: e.pooled_held_out(case.noise))
    shares = shares_of(search, found.accepted or partial, accepted, refit, rng)
    # Present in validation records as well, or not: what certainly makes these worse is something else.
    worse = {n for n, (*_, most) in shares.carried.items() if most <= 0 and n in found.accepted}
    if worse := worse - search.refuted - {*shares.silent}:
        search.refuted |= worse
        return beside_imperfections(search, rng)

    def model(of: Explanation) -> Model:
        return Model(of.end.deviations, _whitened(case, of))

    return assembled(
        case,
        search.records.nominal,
        Judgement(
            found.probabilities,
            found.answer,
            found.accepted,
            model(search.stated()),
            model(refit),
            model(accepted),
            accepted.end.effects,
            judging.below_threshold(search, accepted),
            found.rounding,
            untried=found.untried,
            acts_alike=found.alike,
        ),
        _fitted(search, found, accepted, shares.carried, rng),
        rng,
        simulations=search.simulations,
        unlisted=(accepted if partial else best.explanation).end.effects if looks_like else (),
        partial_model=partial,
        shares=shares,
        competing=_competing(search, found),
    )


def _kept(search: Search, whole: judging.Judged, accepted: Iterable[str]) -> Explanation:
    """A set without what is not accepted and carries next to nothing, fitted to its end.

    Nor is kept what stands at an end of its range: a size that is no answer, and moves those that are.
    """
    least = judging.LITTLE * search.case.machine.weighing.model_error
    accepted = set(accepted)
    small = {part.name for part in whole.parts if part.share > least and part.by_name < 1}
    kept = [n for n in whole.explanation.names if n in accepted | small]
    if judging.late(search):
        return whole.explanation
    return search.finished(search.by_these(kept, whole.explanation))


def _in_part(search: Search, found: judging.Verdict, *, looks_like: bool) -> Explanation:
    """What the records look like, or the likeliest set of listed effects.

    The nominal re-estimated where that does not close most of the held-out gap, leaves half of the motion
    there, or as much as the nominal as stated.
    """
    listed = (one for one in found.judged if one.parts and len(one.parts) == len(one.explanation.names))
    whole = found.judged[0] if looks_like else next(listed, None)
    if whole is None:
        return found.nominal
    unlisted = set(whole.explanation.names) - {part.name for part in whole.parts}
    part, noise = _kept(search, whole, unlisted), search.case.noise
    closes = closed_by(search, part, found.nominal) > judging.MOST_OF_IT
    nearer = part.pooled_held_out(noise) < found.nominal.pooled_held_out(noise)
    return part if closes and nearer and np.max(part.shares[1]) < 1 - judging.MOST_OF_IT else found.nominal


def _competing(search: Search, found: judging.Verdict) -> tuple[CompetingHypothesis, ...]:
    """Sets whose effects that matter contradict each other, for the experiment that parts them.

    One standard deviation is what the likelihood counts as one: the energies that do not interest, over as
    many independent values as its bands have. Neglected: that they grow with the motion.
    """
    case, records, kept = search.case, search.records, dict[tuple[str, ...], Descent]()
    for one in found.judged:
        key = tuple(sorted(part.name for part in one.parts if part.matters >= 0.5))
        if key and not any(set(key) <= set(other) or set(other) <= set(key) for other in kept):
            kept[key] = one.explanation.end
    floor, counted = (
        part.reshape(-1, case.noise.size).sum(axis=0)  # bands are ordered record, octave, output
        for part in (records.levels.floor, records.levels.counted)
    )
    noise = np.sqrt(judging.TEMPER * floor / counted)
    if isinstance(case, Case):
        level = dict(zip(case.outputs, noise, strict=True))
        noise = np.array([level.get(name, np.inf) for name in FlexibleArm(case.rig).output_names])
    return tuple(
        fitted_hypothesis(
            records.nominal,
            end.candidates,
            end.deviations,
            end.coordinates,
            end.precision(records) / judging.TEMPER,
            found.probability(key),
            noise,
            key,
        )
        for key, end in list(kept.items())[:MOST_COMPETING]
    )


def _whitened(case: CaseOfMachine, explanation: Explanation) -> dict[str, Real]:
    records = (*case.estimation, *case.held_out)
    left = (*explanation.left, *explanation.left_held_out)
    named = {e.name: part / case.noise for e, part in zip(records, left, strict=True)}
    return {e.name: named[e.name] for e in case.experiments}


def _fitted(
    search: Search,
    found: judging.Verdict,
    accepted: Explanation,
    carried: Mapping[str, tuple[float, float, float]],
    rng: np.random.Generator,
) -> Callable[[str], FittedEffect | None]:
    sets = best_of_sets(search.found)
    likeliest = [accepted, *(one.explanation for one in found.judged), *sets.values()]

    def fitted(name: str) -> FittedEffect | None:
        best = next((e for e in likeliest if name in e.names), None)
        if best is None:
            return None
        end = best.end
        likely = np.linalg.pinv(end.normal(search.records).hessian, hermitian=True)
        inverse = judging.TEMPER * np.asarray(likely, dtype=np.float64)
        k, rest = best.names.index(name), judging.best_without(sets, best, name)
        rows = end.rows_of(k)
        covariance = inverse[rows, rows] + _taken_for(search, best, k)
        explains = closed_by(search, best, found.nominal) - closed_by(search, rest, found.nominal)
        return FittedEffect(
            end.candidates[k],
            end.coordinates_of(k),
            parameter_intervals(end.candidates[k], end.coordinates_of(k), covariance, rng),
            held_out_gap(search.case, _whitened(search.case, best)),
            carried.get(name) or (max(explains, 0.0), float("nan"), float("nan")),
            widened_by(inverse, end.deviations.size, rows.start, covariance[0, 0]),
        )

    return fitted


def _taken_for(search: Search, explanation: Explanation, k: int) -> Real:
    """Covariance of the k-th effect's coordinates from imperfections of the model that may act as it does."""
    candidate, coordinates = explanation.end.candidates[k], explanation.end.coordinates_of(k)
    rest = judging.best_without(best_of_sets(search.found), explanation, explanation.names[k])
    alike = judging.LITTLE * search.case.machine.weighing.model_error
    share = max(judging.share_beside(rest, explanation), alike)
    sizes = alike / share * np.array([_size(candidate, i, x) for i, x in enumerate(coordinates)])
    return np.outer(sizes, sizes)


def _size(candidate: Candidate, i: int, x: float) -> float:
    """By how much the i-th coordinate changes where the effect becomes larger by a small part of itself."""
    axis = candidate.axes[i]
    if axis.scale == "log" and axis.parameter != "ratio":
        return 1.0
    return abs(x) if i == 0 else 0.0
