"""The judge of a machine that its simulation does not reach, whatever is added: beside a model error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diagnosis.answer import Diagnosis, Shares
from diagnosis.evidence.explanation import Explanation, best_of_sets
from diagnosis.fit.descent import Descent
from diagnosis.judge import verdict as judging
from diagnosis.judge.by_prediction import presence_by_prediction, raised
from diagnosis.judge.carried import closed_by, shares_of
from diagnosis.judge.judgement import Judge
from diagnosis.judge.verdict import JudgedSets
from diagnosis.machine.case import Case
from diagnosis.machine.flexible_arm import FlexibleArm
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.own_plant import PlantCase
from diagnosis.next_experiment.discrimination import MOST_COMPETING, CompetingHypothesis, fitted_hypothesis
from diagnosis.repair.repair import Repairs, Trial
from diagnosis.repair.stability import share_of_repairs
from diagnosis.search.loop import Progress
from diagnosis.search.search import Search
from plant.effects.search_space import Candidate

# RMS in noise deviations: what a simulation without error leaves, and a little that the search has not found.
_NEAR_NOISE = 2.0


def looked_at_again(
    judge: BesideModelError, progress: Progress, deadline_s: float, rng: np.random.Generator
) -> Diagnosis:
    """The answer of a machine that does not forget its inputs, from windows where a free run says less.

    Windows are not looked at where the records leave no gap that interests, nor where the first answer leaves
    none, in them either; they are not taken where they only add to what was named, nor where evidence in
    windows names nothing.
    """
    first = judge.search
    answer = judge.answer(rng)
    # Unlisted causes act within windows too: what a free run leaves unknown stays so, and what it names of a
    # rig stands.
    named = set(answer.combination)
    windows = None
    if judge.evidence_names and isinstance(answer.case, PlantCase):
        windows = first.horizon
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
    in_windows = BesideModelError(search.run_in_time(), rng)
    again = in_windows.answer(rng)
    if in_windows.evidence_names and again.combination and not named < set(again.combination):
        return again
    return answer


def reaches_noise(search: Search) -> bool:
    """Whether some set leaves little beyond the noise of any output and record: it may be exact."""
    return any(
        max(np.sqrt(np.mean(part**2, axis=0)).max() for part in search.whitened(e).values()) < _NEAR_NOISE
        for e in search.found
    )


class BesideModelError(Judge[Explanation]):
    """By likelihoods whose levels nobody knows: what a model error leaves is coloured, and no two records'
    alike."""

    search: Search
    said: JudgedSets

    def __init__(self, search: Search, rng: np.random.Generator) -> None:
        """Prediction has a veto: a named effect with which logs are surely predicted worse is something else.
        Without such an effect everything is judged anew."""
        self.search = search
        listed = search.case.machine.weighing.listed
        repairs: Repairs[Explanation] | None = None
        while True:
            judged = judging.judged(search)
            search.progress(1.0, "done")
            if repairs is None:
                repairs = Repairs(search, judged.nominal)
            self.repair = repairs.best(judged.fitted(judged.accepted))
            names = self.repair.names
            matter = judged.accepted or names
            repaired = self.repair.explanation
            self.shares = shares_of(search, matter, repaired, judged.nominal, rng)
            whole = self._named_set(judged)
            surely_worse = {
                name
                for name in judged.fitted(judged.accepted)
                if name not in names
                and name not in search.refuted
                and whole is not None
                and not judging.is_silent(search, whole, name)
                and repairs.refutes(name, whole.names)
            }
            if not surely_worse:
                break
            search.refuted |= surely_worse
        likeliest = judged.judged[0]
        self.looks_like = (
            judged.answer == "unknown"
            and likeliest.explains > 0.5
            and not set(likeliest.explanation.names) <= set(listed)
        )
        self.trials = repairs.trials
        # Whether evidence alone names a cause, whatever prediction adds.
        self.evidence_names = judged.answer not in ("none", "unknown")
        self.said = by_repair(search, judged, self.trials, repaired, self.shares)
        self.stated = search.stated()
        self.refit = judged.nominal
        self.repaired = repaired
        self.complete = judging.below_threshold(search, repaired)
        self.sets = best_of_sets(search.found)

    def _named_set(self, judged: JudgedSets) -> Explanation | None:
        """The likeliest set that holds all that is named; None where nothing of the sets is."""
        named = judged.fitted(judged.accepted)
        holding = (one.explanation for one in judged.judged if named <= set(one.explanation.names))
        return next(holding, None) if named else None

    def answer(self, rng: np.random.Generator) -> Diagnosis:
        """What a time limit left out is said."""
        return self.recorded(
            rng,
            unlisted=self.said.judged[0].explanation.end.effects if self.looks_like else (),
            shares=self.shares,
            competing=_competing(self.search, self.said),
        )

    def holding(self, name: str) -> Explanation | None:
        judged = [one.explanation for one in self.said.judged]
        return next((e for e in (self.repaired, *judged, *self.sets.values()) if name in e.names), None)

    def covariance(self, fit: Explanation, k: int) -> tuple[Real, Real]:
        """See `Judge.covariance`: imperfections of the model that may act as the effect does widen it."""
        end = fit.end
        inverse = np.linalg.pinv(end.normal(self.search.records).hessian, hermitian=True)
        by_records = judging.TEMPER * np.asarray(inverse, dtype=np.float64)
        without = judging.best_without(self.sets, fit, fit.names[k])
        imperfections = judging.LITTLE * self.search.case.machine.weighing.model_error
        share = max(judging.share_beside(without, fit), imperfections)
        changes = [_size(end.candidates[k], i, x) for i, x in enumerate(end.coordinates_of(k))]
        sizes = imperfections / share * np.array(changes)
        return by_records, by_records[end.rows_of(k), end.rows_of(k)] + np.outer(sizes, sizes)

    def explains(self, fit: Explanation, name: str, gap_after: float) -> tuple[float, float, float]:
        """See `Judge.explains`: as the repaired model shares it out, or by this fit alone."""
        carried = self.shares.carried.get(name)
        if carried is not None:
            return carried
        without = judging.best_without(self.sets, fit, name)
        closed = closed_by(self.search, fit, self.refit) - closed_by(self.search, without, self.refit)
        return float(np.clip(closed, 0.0, 1.0)), float("nan"), float("nan")


def by_repair(
    search: Search,
    judged: JudgedSets,
    trials: Sequence[Trial[Explanation]],
    repaired: Explanation,
    shares: Shares,
) -> JudgedSets:
    """What evidence says, with no effect of the repair less probable than prediction has it.

    Where evidence answers "unknown" and an effect becomes likelier than that, it is the answer. An answer
    "none" stays: what is left does not interest, whatever explains it.
    """
    weighing = search.case.machine.weighing
    if judged.answer == "none" or not shares.carried:
        return judged
    carried = {name: share for name, (share, _, _) in shares.carried.items()}
    closed = closed_by(search, repaired, judged.nominal)
    in_repairs = share_of_repairs(trials)
    presence = {}
    for name, share in carried.items():
        if name not in weighing.listed or name in search.refuted or share <= 0:
            continue
        there = presence_by_prediction(
            in_repairs.get(name, 0.0), judging.genuine_beside(share, 1 - closed), judging.LISTED
        )
        if weighing.counted:
            there *= 1 - judging.acts_like(name, weighing.listed, weighing.counted)
        if name in repaired.names:
            there *= 1 - judging.is_none_but_by_name(search, repaired, repaired.names.index(name))
        presence[name] = there
    probabilities = raised(judged.probabilities, presence, carried)
    answer = judged.answer
    accepted = judged.accepted
    if answer == "unknown":
        answer = probabilities.counting_as_unknown(judged.untried).answer
    if answer != judged.answer:
        sets_with_it = [names for names in probabilities.sets if answer in names]
        likeliest = max(sets_with_it, key=lambda names: probabilities.sets[names])
        accepted = tuple(sorted(likeliest, key=lambda name: -carried.get(name, 0.0)))
    return replace(judged, probabilities=probabilities, answer=answer, accepted=accepted)


def _competing(search: Search, found: JudgedSets) -> tuple[CompetingHypothesis, ...]:
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


def _size(candidate: Candidate, i: int, x: float) -> float:
    """By how much the i-th coordinate changes where the effect becomes larger by a small part of itself."""
    axis = candidate.axes[i]
    if axis.scale == "log" and axis.parameter != "ratio":
        return 1.0
    return abs(x) if i == 0 else 0.0
