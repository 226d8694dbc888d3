"""The judge of a machine that its simulation does not reach, whatever is added: beside a model error."""

from __future__ import annotations

import numpy as np

from diagnosis.answer import Diagnosis
from diagnosis.evidence.explanation import Explanation, best_of_sets
from diagnosis.fit.descent import Fit
from diagnosis.judge import verdict as judging
from diagnosis.judge.carried import closed_by, shares_of
from diagnosis.judge.judgement import Judge
from diagnosis.judge.set_features import LITTLE, best_without, is_silent, share_beside
from diagnosis.judge.verdict import JudgedSets
from diagnosis.machine.case import Case
from diagnosis.machine.flexible_arm import FlexibleArm
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.own_plant import PlantCase
from diagnosis.next_experiment.discrimination import MOST_COMPETING, CompetingHypothesis, fitted_hypothesis
from diagnosis.repair.repair import Repairs
from diagnosis.repair.stability import shares_of_sets
from diagnosis.search.loop import Progress
from diagnosis.search.search import Search
from plant.effects.search_space import Candidate

# Log likelihoods count this much less than independent coefficients would: what a model error leaves is
# correlated. Calibrated on made cases (`flexlink blind --workshop`); it widens intervals of sizes.
TEMPER = 4.0
# RMS in noise deviations: what a simulation without error leaves, and a little that the search has not found.
_NEAR_NOISE = 2.0


def looked_at_again(
    judge: BesideModelError, progress: Progress, deadline_s: float, rng: np.random.Generator
) -> Diagnosis:
    """The answer of a machine that does not forget its inputs, from windows where a free run says less.

    The answer of the free run is returned, in this order, where

    1. it names nothing, not even an unknown cause, the machine is a rig, or it forgets its inputs;
    2. the named effects leave less than the model error within windows too;
    3. evidence in windows names nothing, or only adds to what the free run named.

    Otherwise the answer from windows is.
    """
    first = judge.search
    answer = judge.answer(rng)
    # Unlisted causes act within windows too: what a free run leaves unknown stays so, and what it names of a
    # rig stands.
    named = set(answer.combination)
    windows = None
    if judge.names_something and isinstance(answer.case, PlantCase):
        windows = first.drift_free_windows
    if windows is None:
        return answer
    search = Search(answer.case, progress, deadline_s, windows)
    holding = [e for e in first.explanations if named <= set(e.names)]
    if holding:
        named_alone = first.with_only(answer.combination, max(holding, key=lambda e: e.log_evidence))
        # The same effects in windows, descended on from where the free run ended.
        left = np.sqrt(search.explain(named_alone.fit.continued(search.records)).energy_ratios)
        if max(np.max(left), np.max(named_alone.residual_shares)) < answer.case.machine.weighing.model_error:
            return answer
    in_windows = BesideModelError(search.run_in_time(), rng)
    again = in_windows.answer(rng)
    # What windows only add is what free runs deny; where these name nothing, windows are all there is.
    only_add = bool(named) and named < set(again.combination)
    if in_windows.names_something and again.combination and not only_add:
        return again
    return answer


def reaches_noise(search: Search) -> bool:
    """Whether some set leaves little beyond the noise of any output and record: it may be exact."""
    return any(
        max(np.sqrt(np.mean(part**2, axis=0)).max() for part in search.whitened_residuals(e).values())
        < _NEAR_NOISE
        for e in search.explanations
    )


class BesideModelError(Judge[Explanation]):
    """Weighs sets of effects beside a model error, whose levels nobody knows: what it leaves is coloured, and
    in no two records alike.

    Attributes
    ----------
    shares : Shares
        Of the validation error, what each effect of the repaired model carries.
    looks_like : bool
        Whether the answer is unknown and the likeliest set holds a look-alike that is on no list.
    names_something : bool
        Whether an effect is more probable than none, or an unknown cause alone.
    sets : dict
        Sorted names -> the likeliest fit of these effects.
    """

    search: Search
    judgement: JudgedSets

    def __init__(self, search: Search, rng: np.random.Generator) -> None:
        """Judge what a search has fitted.

        Prediction has a veto: a named effect with which logs are surely predicted worse is something else.
        Without such an effect everything is judged anew.
        """
        self.search = search
        nominal = judging.better_nominal(search)
        judging.look_closer(search, nominal)
        search.progress(1.0, "done")
        repairs = Repairs(search, nominal)
        while True:
            self.judgement = judging.judged(search, nominal, shares_of_sets(repairs.trials))
            named = self.judgement.fitted(self.judgement.accepted)
            self.repair = repairs.best(named)
            surely_worse = self._surely_worse(repairs, named)
            if not surely_worse:
                break
            search.refuted |= surely_worse
        self.trials = repairs.trials
        self.repaired = self.repair.explanation
        self.shares = shares_of(
            search, self.judgement.accepted or self.repair.names, self.repaired, self.judgement.nominal, rng
        )
        cause = self.judgement.probabilities.cause
        self.names_something = cause["none"] + cause["unknown"] < 0.5
        likeliest = self.judgement.judged[0].explanation
        self.looks_like = self.judgement.answer == "unknown" and not set(likeliest.names) <= set(
            search.case.machine.weighing.listed
        )
        self.stated = search.at_stated_values()
        self.refit = self.judgement.nominal
        self.complete = judging.below_threshold(search, self.repaired)
        self.sets = best_of_sets(search.explanations)

    def _surely_worse(self, repairs: Repairs[Explanation], named: set[str]) -> set[str]:
        """Named effects with which logs are surely predicted worse than without them.

        Not asked are those of the repair, those that were refuted already, and those about which validation
        records say nothing.
        """
        holding = [
            judged_set.explanation
            for judged_set in self.judgement.judged
            if named <= set(judged_set.explanation.names)
        ]
        if not named or not holding:
            return set()
        likeliest = holding[0]
        surely_worse = set()
        for name in named - set(self.repair.names) - self.search.refuted:
            if not is_silent(self.search, likeliest, name) and repairs.refutes(name, likeliest.names):
                surely_worse.add(name)
        return surely_worse

    def answer(self, rng: np.random.Generator) -> Diagnosis:
        """The record of the judgement, with shares and what the next experiment is to part."""
        return self.recorded(
            rng,
            unlisted=self.judgement.judged[0].explanation.fit.effects if self.looks_like else (),
            shares=self.shares,
            competing=_competing(self.search, self.judgement),
        )

    def holding(self, name: str) -> Explanation | None:
        """See `Judge.holding`: the repaired model, then the most probable set, then the likeliest one."""
        judged = [judged_set.explanation for judged_set in self.judgement.judged]
        for explanation in (self.repaired, *judged, *self.sets.values()):
            if name in explanation.names:
                return explanation
        return None

    def covariance(self, explanation: Explanation, k: int) -> tuple[Real, Real]:
        """See `Judge.covariance`: imperfections of the model that may act as the effect does widen it."""
        fit = explanation.fit
        inverse = np.linalg.pinv(fit.normal_equations(self.search.records).hessian, hermitian=True)
        by_records = TEMPER * np.asarray(inverse, dtype=np.float64)
        without = best_without(self.sets, explanation, explanation.names[k])
        imperfections = LITTLE * self.search.case.machine.weighing.model_error
        share = max(share_beside(without, explanation), imperfections)
        changes = [_size(fit.candidates[k], i, x) for i, x in enumerate(fit.coordinates_of(k))]
        sizes = imperfections / share * np.array(changes)
        return by_records, by_records[fit.unknowns_of(k), fit.unknowns_of(k)] + np.outer(sizes, sizes)

    def explains(self, explanation: Explanation, name: str, gap_after: float) -> tuple[float, float, float]:
        """See `Judge.explains`: as the repaired model shares it out, or by this fit alone."""
        carried = self.shares.carried.get(name)
        if carried is not None:
            return carried
        without = best_without(self.sets, explanation, name)
        closed = closed_by(self.search, explanation, self.refit) - closed_by(self.search, without, self.refit)
        return float(np.clip(closed, 0.0, 1.0)), float("nan"), float("nan")


def _competing(search: Search, judgement: JudgedSets) -> tuple[CompetingHypothesis, ...]:
    """Sets whose effects contradict each other, for the experiment that parts them, most probable first.

    One standard deviation of an output is what the likelihood counts as one: the energies that do not
    interest, over as many independent values as its bands have; infinite where nobody measures. Neglected:
    that they grow with the motion.
    """
    case = search.case
    records = search.records
    contradicting: dict[tuple[str, ...], Fit] = {}
    for judged_set in judgement.judged:
        # What a set is about: effects that are likelier there than not.
        key = tuple(sorted(judged_set.holding(0.5)))
        related = [other for other in contradicting if set(key) <= set(other) or set(other) <= set(key)]
        if key and not related:
            contradicting[key] = judged_set.explanation.fit

    # Bands are ordered by record, octave and output.
    outputs = case.noise.size
    uninteresting = records.levels.floor.reshape(-1, outputs).sum(axis=0)
    independent_values = records.levels.independent_counts.reshape(-1, outputs).sum(axis=0)
    noise = np.sqrt(TEMPER * uninteresting / independent_values)
    if isinstance(case, Case):
        of_output = dict(zip(case.outputs, noise, strict=True))
        noise = np.array([of_output.get(name, np.inf) for name in FlexibleArm(case.rig).output_names])
    return tuple(
        fitted_hypothesis(
            records.nominal,
            fit.candidates,
            fit.deviations,
            fit.coordinates,
            fit.precision(records) / TEMPER,
            judgement.probability(key),
            noise,
            key,
        )
        for key, fit in list(contradicting.items())[:MOST_COMPETING]
    )


def _size(candidate: Candidate, i: int, x: float) -> float:
    """By how much the i-th coordinate changes where the effect becomes larger by a small part of itself."""
    axis = candidate.axes[i]
    if axis.scale == "log" and axis.parameter != "ratio":
        return 1.0
    return abs(x) if i == 0 else 0.0
