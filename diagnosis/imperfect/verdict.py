"""From fitted sets to an answer: which effects matter, what remains, and how sure that is.

"None", "exactly these effects" and "unknown" are all false for a real machine; what is asked is which effect
carries a part of the gap that interests (more than the stated model error), and whether what then remains is
no more than imperfections leave. Both are judged on shares of the motion, of estimation and held-out records.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from scipy.special import expit, softmax

from diagnosis.evidence.hypotheses import Probabilities
from diagnosis.machine.machine_protocol import Real, Weighing
from diagnosis.machine.rounding import Rounding, rounding_effect
from diagnosis.search.explanation import Explanation, best_of_sets
from diagnosis.search.search import Search
from plant.effects import EFFECTS, LOOK_ALIKES

# Log likelihoods count this much less than independent coefficients would (calibrated on generated cases:
# `flexlink blind --workshop`); prior densities of stated values count whole.
TEMPER = 4.0
_VOLUME = 0.25
# Prior by number of effects, small ones included, which every machine has: shared among sets of that size.
_PRIOR_COUNT = (0.2, 0.35, 0.3, 0.1, 0.035, 0.015)
# An effect interests from this many model errors on; the limits are soft, their width in natural logarithms.
# Every machine rubs, cogs, stands a little out of level and has an amplifier that lags: that is among what
# the model error allows, and the limit of these is higher. Nor is it a measure what a drift makes of them in
# the records they were fitted to: they must carry as much of held-out ones.
_INTERESTS, _INTERESTS_EVERYWHERE, _INTERESTS_WIDTH = 0.75, 1.12, 0.06
# Held-out records of which an effect changes less than this (model errors) say nothing about it.
_SILENT = 0.25
# A wrong stated value interests from this many tolerances on.
_FAR_OFF, _FAR_OFF_WIDTH = 4.4, 0.06
# And is none within this many.
_WITHIN = 2.0
# What a complete answer leaves, and what an unknown cause does: medians in model errors, widths (logarithms
# of shares of the motion, normal; any size above its median for an unknown cause), prior of the latter.
_IMPERFECTIONS, _IMPERFECTIONS_WIDTH = 0.6, 0.65
_UNKNOWN, _UNKNOWN_WIDTH, _PRIOR_UNKNOWN = 2.2, 0.6, 0.15
# How far off (logarithm) the usual model error may be which stands for one nobody has stated: a judgement.
_UNSTATED_WIDTH = 0.9
# After a contact that comes a little early all goes another way: what imperfections leave is more.
_AFTER_CONTACTS = 2.0
# A set is out that leaves so much more of the held-out records, in model errors too, than a part of it.
_WORSE, _WORSE_BY = 1.15, 0.2
# How probable a cause beyond the list is that looks like an effect, beside the effect.
_UNLISTED = 1 / 3
_LISTED_AS = {name: str(kind.look_alike_of) for name, kind in LOOK_ALIKES.items()}
# Draws of the Bayesian bootstrap over records.
_DRAWS = 400
# Sets this far behind in score take no part.
_BEHIND, _MOST_SETS, _PASSES = 8.0, 8, 3
# Sets no further behind have their effects exchanged for others that are as likely.
_NEAR = 2.0


@dataclass(frozen=True)
class Part:
    """What one effect of a set carries: share of the motion, probability that it matters.

    share : geometric mean of what it carries on estimation and on held-out records. An effect that is real
        carries something of both, but where it does nothing in the latter, or where the records speak for it
        and what it does on the former can be had otherwise. Of effects that every machine has some of, no
        more than on the latter.
    """

    name: str
    share: float
    matters: float


@dataclass(frozen=True, eq=False)
class Judged:
    """A set with its listed parts and its score.

    explains : probability that it leaves no more than imperfections. complete : and that it needs no cause
        beyond the list for more than these.
    """

    explanation: Explanation
    parts: tuple[Part, ...]
    score: float
    explains: float
    complete: float


@dataclass(frozen=True, eq=False)
class Verdict:
    """probabilities; judged: the sets that were weighed, best first; answer: names that are accepted, with
    rounding where that interests, which is read off the values and in none of the sets."""

    probabilities: Probabilities
    judged: tuple[Judged, ...]
    answer: str
    accepted: tuple[str, ...]
    rounding: Rounding | None = None

    def fitted(self, names: Iterable[str]) -> set[str]:
        """Those of the names that are in sets."""
        return set(names) - ({self.rounding.name} if self.rounding else set())

    def probability(self, fitted: Iterable[str]) -> float:
        """Of a set, and rounding."""
        beside = () if self.rounding is None else (self.rounding.name,)
        return self.probabilities.sets.get(tuple(sorted((*fitted, *beside))), 0.0)


def score_of(explanation: Explanation, weighing: Weighing) -> float:
    """Log weight of a set of effects, out of those that are listed."""
    left = _remaining(_beyond(explanation), weighing.model_error)
    return _gain(explanation, weighing.listed) + float(np.log(sum(left)))


def _gain(explanation: Explanation, listed: Sequence[str]) -> float:
    """Without what is left of the motion."""
    candidates = explanation.end.candidates
    further = float(sum(len(c.axes) - 1 for c in candidates))
    return (
        explanation.log_likelihood / TEMPER
        + explanation.log_prior
        + _VOLUME * explanation.log_volume
        + float(np.log(_PRIOR_COUNT[len(candidates)] / comb(len(listed), len(candidates))))
        - further
        + float(np.log(_UNLISTED)) * sum(name not in listed for name in explanation.names)
    )


def judged(search: Search) -> Verdict:
    """The answer from everything that a search has fitted; fits the best set without each of its effects, and
    with simpler ones. What that finds is weighed with all others."""
    for _ in range(_PASSES):
        known = len(search.found)
        sets = _weighed(search)
        near_sets = [one for one in sets if one.score > sets[0].score - _NEAR]
        for near in near_sets:
            search.exchanged(near.explanation, {part.name for part in near.parts if part.matters > 0.5})
            search.joined(sets[0].explanation, near.explanation)
        for one in [*(near.explanation for near in near_sets), *search.found[known:]]:
            search.simpler(one)
        if len(search.found) == known:
            break
    weighing = search.case.machine.weighing
    # What effects too small to interest carry together is measured as each of them is; held-out records have
    # a veto.
    most = np.max(search.base.shares, axis=1)
    alike = max(float(np.sqrt(np.prod(most))), float(most[1]))
    none_enough = _enough(alike, weighing) if weighing.stated else 0.0
    probabilities = _probabilities(sets, weighing.listed, none_enough)
    rounding, beside = rounding_effect(search.case), dict[str, float]()
    if rounding is not None and (share := _rounded(search, rounding)) > _INTERESTS * weighing.model_error:
        beside[rounding.name] = share
        leads = share > max((part.share for part in sets[0].parts), default=0.0)
        probabilities = probabilities.beside(rounding.name, leads=leads)
    accepted = _accepted(probabilities, sets, beside)
    return Verdict(probabilities, sets, probabilities.answer, accepted, rounding if beside else None)


def _accepted(
    probabilities: Probabilities, sets: Sequence[Judged], beside: Mapping[str, float]
) -> tuple[str, ...]:
    """The likeliest set that holds the answer, what carries most first; beside: shares of what is in every
    set and was fitted in none."""
    answer = probabilities.answer
    if answer in ("none", "unknown"):
        return ()
    found = max((key for key in probabilities.sets if answer in key), key=lambda key: probabilities.sets[key])
    main = next(s for s in sets if set(found) - set(beside) <= {p.name for p in s.parts})
    shares = {part.name: part.share for part in main.parts} | dict(beside)
    return tuple(sorted(found, key=lambda name: -shares[name]))


def _rounded(search: Search, rounding: Rounding) -> float:
    """Share of the motion that rounding is, of the output that shows most of it."""
    Y, records = search.case.noise.size, (*search.case.estimation, *search.case.held_out)
    energy = rounding.variances * sum(len(e.output) for e in records)
    motion = np.concatenate([search.records.levels.motion, search.held_out.levels.motion]).reshape(-1, Y)
    return float(np.sqrt(np.max(energy / motion.sum(axis=0))))


def _weighed(search: Search) -> tuple[Judged, ...]:
    """The sets that take part, best first: none that leaves more of the held-out records than the nominal, as
    stated or re-estimated."""
    weighing = search.case.machine.weighing
    best = best_of_sets(search.found)
    noise = search.case.noise
    farthest = min(e.pooled_held_out(noise) for e in (search.base, search.stated()))
    score = {
        key: score_of(explanation, weighing)
        for key, explanation in best.items()
        if not _contradicted(explanation, best.values(), weighing.model_error)
        and (not key or explanation.pooled_held_out(noise) <= farthest)
    }
    ranked = sorted((best[key] for key in score), key=lambda e: -score[e.key])
    top = score[ranked[0].key]
    chosen = [e for e in ranked[:_MOST_SETS] if score[e.key] > top - _BEHIND]
    return tuple(_judged(search, e, best, fit=k == 0) for k, e in enumerate(chosen))


def _contradicted(explanation: Explanation, others: Iterable[Explanation], model_error: float) -> bool:
    """Whether held-out records are left notably more by a set than by a part of it: what it adds is fitted to
    the other records and true of none."""
    left, listed = float(np.max(explanation.shares[1])), _as_listed(explanation)
    parts = [float(np.max(e.shares[1])) for e in others if _as_listed(e) < listed]
    return bool(parts) and left > max(_WORSE * min(parts), min(parts) + _WORSE_BY * model_error)


def _as_listed(explanation: Explanation) -> set[str]:
    """Its effects, each look-alike under the name of what it looks like."""
    return {_LISTED_AS.get(name, name) for name in explanation.names}


def _judged(
    search: Search,
    explanation: Explanation,
    best: Mapping[tuple[str, ...], Explanation],
    *,
    fit: bool,
) -> Judged:
    weighing = search.case.machine.weighing
    parts, reduced = dict[str, Part](), explanation
    while reduced.names:
        rests = {
            name: search.without(reduced, k)
            if fit and len(reduced.names) > 1
            else best_without(best, reduced, name)
            for k, name in enumerate(reduced.names)
        }
        within = [_part(search, reduced, name, rest, parts.get(name)) for name, rest in rests.items()]
        parts |= {part.name: part for part in within}
        small = [part.name for part in within if part.matters < 0.5]
        if not small:
            break
        # Two effects that can replace each other would both seem to carry nothing: the one goes first without
        # which the records are the likelier.
        rest = max((rests[name] for name in small), key=lambda e: score_of(e, weighing))
        if len(rest.names) < len(reduced.names) - 1:
            break
        reduced = rest
    at_edge = any(
        c.at_edge(explanation.end.coordinates_of(k)) and parts[c.effect].matters > 0.5
        for k, c in enumerate(explanation.end.candidates)
    )
    explains = complete = 0.0 if at_edge else _enough(_beyond(explanation), weighing)
    answers = {
        name
        for name, effect in zip(explanation.names, explanation.end.effects, strict=True)
        if name in weighing.listed and effect.as_listed
    }
    for part in parts.values():
        complete *= 1.0 if part.name in answers else 1 - part.matters
    named = tuple(parts[name] for name in explanation.names if name in answers)
    return Judged(explanation, named, score_of(explanation, weighing), explains, complete)


def best_without(
    best: Mapping[tuple[str, ...], Explanation], explanation: Explanation, name: str
) -> Explanation:
    """The set without this effect; where nobody fitted that, the best of its parts."""
    rest = {n for n in explanation.names if n != name}
    return max(
        (e for key, e in best.items() if rest.issuperset(key)),
        key=lambda e: (len(e.names) == len(rest), e.evidence),
    )


def _part(
    search: Search,
    explanation: Explanation,
    name: str,
    rest: Explanation,
    seen: Part | None,
) -> Part:
    """What an effect carries within a set, or within the larger one in which it was seen before; rest: the
    set without it."""
    k, weighing = explanation.names.index(name), search.case.machine.weighing
    model_error, listed = weighing.model_error, weighing.listed
    estimated, held_out = map(float, _carried(rest, explanation))
    share, limit = float(np.sqrt(estimated * held_out)), _INTERESTS
    # What looks like a tilt is judged as a tilt: some of either is everywhere.
    alike = _LISTED_AS.get(name)
    if (EFFECTS[alike] if alike else explanation.end.candidates[k].kind).everywhere:
        share, limit = min(share, held_out), _INTERESTS_EVERYWHERE
    elif share < limit * model_error < estimated and is_silent(search, explanation, name):
        share = estimated
    elif estimated < held_out and score_of(explanation, weighing) > _BEHIND + score_of(rest, weighing):
        # Without it the others fit the records they were fitted to as well, with values that others refute.
        share = held_out
    share = max(share, seen.share if seen else 0.0)
    matters = _soft(share / limit / model_error, _INTERESTS_WIDTH)
    off = _tolerances_off(search, explanation, k)
    if off is not None:
        # A stated value in itself: what it changes may be imitated by the others within their tolerances. Far
        # off is not enough: of a value that nobody stated anything is.
        preferred = float(expit(_gain(explanation, listed) - _gain(rest, listed)))
        matters = max(matters, preferred * _soft(off / _FAR_OFF, _FAR_OFF_WIDTH))
        # An effect and a deviation that cancel each other are no finding, whatever a fit without it left.
        matters *= _soft(off / _WITHIN, _FAR_OFF_WIDTH)
    return Part(name, share, matters)


def is_silent(search: Search, explanation: Explanation, name: str) -> bool:
    """Whether held-out records say nothing about an effect: it does nothing there."""
    acts = search.acts_on_held_out(explanation, explanation.names.index(name))
    return acts < _SILENT * search.case.machine.weighing.model_error


def share_beside(rest: Explanation, explanation: Explanation) -> float:
    """Share of the motion that a set carries beyond a part of it: geometric mean of estimation and held-out
    records."""
    return float(np.sqrt(np.prod(_carried(rest, explanation))))


def _carried(rest: Explanation, explanation: Explanation) -> Real:
    """(2,) the same of estimation records and of held-out ones, of the output that shows most of it."""
    carried = np.sqrt(np.maximum(rest.shares**2 - explanation.shares**2, 0.0))
    return np.asarray(np.max(carried, axis=1))


def _tolerances_off(search: Search, explanation: Explanation, k: int) -> float | None:
    """How far the k-th effect and the deviations together move the value it changes; None for others, and for
    values without a tolerance: none of theirs is there to imitate what the effect does."""
    end, machine = explanation.end, search.case.machine
    kind = end.candidates[k].kind
    key = kind.multiplies or kind.adds_to
    if key is None or key not in machine.tolerances or not machine.description.value(key) > 0:
        return None
    tolerance, stated = machine.tolerances[key], machine.description.value(key)
    deviation = float(end.deviations[search.records.nominal.keys.index(key)])
    moved = stated * np.exp(tolerance * deviation)
    size = next(iter(end.effects[k].parameters().values()))
    moved = moved * size if kind.multiplies else moved + size
    return abs(float(moved / stated) - 1) / tolerance


def _left(explanation: Explanation) -> float:
    """Share of the motion that is left of estimation and held-out records."""
    return float(np.sqrt(np.mean(np.max(explanation.shares, axis=1) ** 2)))


def _beyond(explanation: Explanation) -> float:
    """What is left, as it would be without contacts."""
    return _left(explanation) / (_AFTER_CONTACTS if explanation.end.non_smooth else 1.0)


def _enough(left: float, weighing: Weighing) -> float:
    """Probability that what is left is no more than imperfections.

    How large these are where nobody has stated it says nothing about which of several sets is right.
    """
    enough, more = _remaining(left, weighing.model_error, 0.0 if weighing.stated else _UNSTATED_WIDTH)
    return enough / (enough + more)


def _remaining(left: float, model_error: float, uncertain: float = 0.0) -> tuple[float, float]:
    """Densities of a share of the motion that is left by a complete answer, and beside an unknown cause."""
    width = np.hypot(_IMPERFECTIONS_WIDTH, uncertain)
    size = np.log(max(left / model_error, 1e-3))
    z = max(size - np.log(_IMPERFECTIONS), 0.0) / width
    u = min(size - np.log(_UNKNOWN), 0.0) / _UNKNOWN_WIDTH
    enough = (1 - _PRIOR_UNKNOWN) / width * np.exp(-0.5 * z**2)
    return float(enough), float(_PRIOR_UNKNOWN / _UNKNOWN_WIDTH * np.exp(-0.5 * u**2))


def _soft(ratio: float, width: float) -> float:
    return float(expit(np.log(max(ratio, 1e-6)) / width))


def _probabilities(sets: Sequence[Judged], listed: Sequence[str], none_enough: float) -> Probabilities:
    """Every set shared out: unknown where it is not complete, else those of its effects that matter. None of
    them only as far as the nominal alone leaves no more than imperfections (none_enough): where it leaves
    more and the set does not, the largest of its effects interests, however little it carries. With
    none_enough zero nobody has stated what does not interest: then that is unknown."""
    shared: dict[tuple[str, ...], float] = {("unknown",): 0.0}
    cause = {"none": 0.0, **dict.fromkeys(listed, 0.0), "unknown": 0.0}
    presence = dict.fromkeys(listed, 0.0)

    def give(names: Sequence[str], share: float) -> None:
        key = tuple(sorted(names))
        shared[key] = shared.get(key, 0.0) + share
        cause[names[0] if names else "none"] += share
        for name in presence.keys() & set(names):
            presence[name] += share

    for weight, one in zip(_weights(sets), sets, strict=True):
        give(["unknown"], weight * (1 - one.complete))
        parts = sorted(one.parts, key=lambda part: -part.share)
        some = (chosen for count in range(len(parts) + 1) for chosen in combinations(parts, count))
        for chosen in some if one.complete > 0 else ():
            share = weight * one.complete
            for part in parts:
                share *= part.matters if part in chosen else 1 - part.matters
            if not chosen:
                enough = none_enough / (1.0 if one.explanation.names else one.complete)
                give([parts[0].name if parts and none_enough > 0 else "unknown"], share * (1 - enough))
                share *= enough
            give([part.name for part in chosen], share)
    return Probabilities(
        {name: float(p) for name, p in cause.items()},
        {names: float(p) for names, p in shared.items()},
        {name: float(p) for name, p in presence.items()},
    )


def _weights(sets: Sequence[Judged]) -> Real:
    """Posterior weights of sets, the mean over a Bayesian bootstrap of the records (Yao et al. 2018, 3.4).

    What imperfections leave is alike within a record and another from one to the next: a set that most of the
    records speak for is surer than one that a single record prefers as much.
    """
    likelihoods = np.array([s.explanation.log_likelihoods for s in sets]) / TEMPER
    count = likelihoods.shape[1]
    draws = count * np.random.default_rng(0).dirichlet(np.ones(count), _DRAWS)
    scores = np.array([s.score for s in sets]) + (draws - 1) @ likelihoods.T
    return np.asarray(np.mean(softmax(scores, axis=1), axis=0))
