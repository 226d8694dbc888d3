"""From fitted sets to an answer: which effects matter, what remains, and how sure that is.

Two questions are asked apart: which effect carries a part of the gap that interests (more than the stated
model error), and whether what then remains is no more than imperfections leave. Both are judged on shares of
the motion, of estimation and held-out records.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from itertools import combinations
from math import comb

import numpy as np
from scipy.special import expit, softmax
from scipy.stats import norm

from diagnosis.evidence.explanation import Explanation, best_of_sets
from diagnosis.evidence.hypotheses import UNLISTED, Probabilities
from diagnosis.fit.coordinates import DRAWS
from diagnosis.fit.likelihood import DECISIVE, SUBSTANTIAL
from diagnosis.fit.nominal import EDGE
from diagnosis.fit.records import Records, mean_square_left
from diagnosis.judge.judgement import Judgement
from diagnosis.machine.machine_protocol import Real, Weighing
from diagnosis.machine.rounding import Rounding, rounding_effect
from diagnosis.search.loop import MANY, SEVERAL
from diagnosis.search.search import Search
from plant.effects import LOOK_ALIKES

# Log likelihoods count this much less than independent coefficients would (calibrated on generated cases:
# `flexlink blind --workshop`); prior densities of stated values count whole.
TEMPER = 4.0
# Prior by number of effects, small ones included, which every machine has: shared among sets of that size.
_PRIOR_COUNT = (0.2, 0.35, 0.3, 0.1, 0.035, 0.015)
# The one significance threshold, of every effect: the stated model error. It is soft, as what is left is
# uncertain: the width in natural logarithms.
_SOFT = 0.06
# Share of the stated model error that is little: held-out records of which an effect changes less say nothing
# about it, and one standard deviation of it may act as an effect does (set on 40 generated cases, where dry
# friction and cogging of the background added to what was found).
LITTLE = 0.25
# What closes less than this share of a gap does not close it.
MOST_OF_IT = 0.5
# A wrong stated value interests from this many tolerances on.
_FAR_OFF = 4.4
# What a complete answer leaves, and what an unknown cause does: medians in model errors, widths (logarithms
# of shares of the motion, normal; any size above its median for an unknown cause), prior of the latter.
_IMPERFECTIONS, _IMPERFECTIONS_WIDTH = 0.6, 0.65
_UNKNOWN, _UNKNOWN_WIDTH, _PRIOR_UNKNOWN = 2.2, 0.6, 0.15
# Prior probability that what acts like an effect of the list is one, not a cause beyond it.
LISTED = _PRIOR_COUNT[1] / (_PRIOR_COUNT[1] + _PRIOR_UNKNOWN)
# Share of the motion that is nothing.
_NOTHING = 1e-4
# How far off (logarithm) the usual model error may be which stands for one nobody has stated: a judgement.
_UNSTATED_WIDTH = 0.9
# After a contact that comes a little early all goes another way: what imperfections leave is more.
_AFTER_CONTACTS = 2.0
# A set is out that leaves so much more of the held-out records, and more by a little, than a part of it.
_WORSE = 1.15
# Beside something unlisted an effect may only stand in for that: as probable as not where it carries nearly
# as much as is left beside it (the best stand-in of five unlisted causes of labelled cases: .7; documented
# effects of real and of made machines: from .85 on). Width in logarithms.
_STANDS_IN, _STANDS_IN_WIDTH = 0.9, 0.3
# Operating points are one where they leave no more of a constant's energy than this, as error bars of a third
# of them do.
_SAME_POINT = 0.1
_LISTED_AS = {name: str(kind.look_alike_of) for name, kind in LOOK_ALIKES.items()}


@dataclass(frozen=True)
class Part:
    """What one effect of a set carries: share of the motion, probability that it matters.

    share : geometric mean of what it carries on estimation and on held-out records, no more than on these. An
        effect that is real carries something of both, but where it does nothing in the latter, or where the
        records speak for it and what it does on the former can be had otherwise.
    by_name : probability that it is that effect only by its name: the records do not show what makes it
        this one.
    """

    name: str
    share: float
    matters: float
    by_name: float = 0.0


@dataclass(frozen=True, eq=False)
class Judged:
    """A set with its listed parts and its score.

    explains : probability that it leaves no more than imperfections. complete : and that it needs no cause
        beyond the list for more than these. left : share of the motion that it leaves; carries : what it
        explains of what the nominal leaves.
    beyond : share of the motion that its largest cause beyond the list carries, which looks like an effect.
    weight : posterior probability among the sets that were weighed.
    """

    explanation: Explanation
    parts: tuple[Part, ...]
    score: float
    explains: float
    complete: float
    left: float
    carries: float
    beyond: float
    weight: float = 0.0


@dataclass(frozen=True, eq=False)
class JudgedSets(Judgement):
    """judged : the sets that were weighed, likeliest first. nominal : as stated, or re-estimated where that
    leaves less of the held-out records."""

    judged: tuple[Judged, ...] = field(kw_only=True)
    nominal: Explanation = field(kw_only=True)

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
    return (
        explanation.log_likelihood / TEMPER
        + explanation.log_prior
        + explanation.log_volume / TEMPER
        + float(np.log(_PRIOR_COUNT[len(candidates)] / comb(len(listed), len(candidates))))
        - float(sum(len(c.axes) - 1 for c in candidates))
        + float(np.log(UNLISTED)) * sum(name not in listed for name in explanation.names)
    )


def judged(search: Search) -> JudgedSets:
    """The answer from everything that a search has fitted; fits the best set without each of its effects, and
    with simpler ones. What that finds is weighed with all others."""
    nominal = min(search.base, search.stated(), key=lambda e: e.pooled_held_out(search.case.noise))
    for _ in range(SEVERAL):
        known, sets = len(search.found), _weighed(search, nominal)
        if search.out_of_time:
            break
        near_sets = [one for one in sets if one.score > sets[0].score - SUBSTANTIAL]
        for near in near_sets:
            search.exchanged(near.explanation, {part.name for part in near.parts if part.matters > 0.5})
        for one in [*(near.explanation for near in near_sets), *search.found[known:]]:
            search.simpler(one)
        if len(search.found) == known:
            break
    sets = tuple(replace(one, weight=float(w)) for one, w in zip(sets, _weights(sets), strict=True))
    sets = tuple(sorted(sets, key=lambda one: -one.weight))
    weighing = search.case.machine.weighing
    # What effects too small to interest carry together is measured as each of them is; held-out records have
    # a veto.
    most = np.max(search.base.shares, axis=1)
    alike = max(float(np.sqrt(np.prod(most))), float(most[1]))
    none_enough = _enough(alike, weighing) if weighing.stated else 0.0
    probabilities = _probabilities(sets, weighing.listed, none_enough)
    rounding, beside = rounding_effect(search.case), dict[str, float]()
    if rounding is not None and (share := _rounded(search, rounding)) > weighing.model_error:
        beside[rounding.name] = share
        leads = share > max((part.share for part in sets[0].parts), default=0.0)
        probabilities = probabilities.beside(rounding.name, leads=leads)
    untried = search.untried
    probabilities = probabilities.with_untried(
        untried,
        (_PRIOR_COUNT[1], sum(_PRIOR_COUNT[2:]), _PRIOR_UNKNOWN),
        larger=len(search.left_out) > 0,
    )
    answer = probabilities.counting_as_unknown(untried).answer
    accepted = _accepted(probabilities, answer, sets, beside)
    # Where something is missing, what stands in for it is weighed already (`_genuine`); of what cannot be
    # tried (`untried`) nothing is known.
    there, whole = probabilities.presence, sum(one.weight * one.explains for one in sets)
    acting = {
        name: p * whole * acts_like(name, weighing.listed, weighing.counted)
        for name, p in there.items()
        if weighing.counted and name in weighing.listed and name not in beside
    }
    probabilities = replace(probabilities, presence={n: p - acting.get(n, 0.0) for n, p in there.items()})
    return JudgedSets(
        probabilities,
        answer,
        accepted,
        untried,
        rounding if beside else None,
        acts_alike=acting,
        judged=sets,
        nominal=nominal,
    )


@cache
def acts_like(name: str, listed: tuple[str, ...], machines: str) -> float:
    """Probability that what an effect explains is the work of a cause on no list, given that it is there.

    From the priors of an effect, one of those that are listed, and of such a cause, and from how often
    effects of its kind stood in for one in these machines (a table of look_alikes.toml), shrunk to the rate
    of all kinds and shared by those of the kind that are listed.
    """
    tables = tomllib.loads(resources.files(__package__).joinpath("look_alikes.toml").read_text("utf-8"))
    seen, kind = tables[machines], kind_of(name)
    pooled = seen["pooled_cases"] * sum(seen["stood_in"].values()) / seen["cases"] / seen["kinds"]
    rate = (seen["stood_in"].get(kind, 0) + pooled) / (seen["cases"] + seen["pooled_cases"])
    each = rate / sum(kind_of(other) == kind for other in listed)
    return float(1 / (1 + _PRIOR_COUNT[1] / (seen["unlisted"] * each * len(listed))))


def kind_of(name: str) -> str:
    """Kind of an effect, or of a stated value that may be wrong, whichever part of a model it is of.

    "hinge.mass" and "wrong_rod.mass" are of the kind "mass". A value of somebody's own simulation is of no
    part of a model, and its name is anybody's choice: it is a kind of its own, also where an effect is called
    so.
    """
    value = name.removeprefix("wrong_")
    return value.rpartition(".")[2] if "." in value else name


def _accepted(
    probabilities: Probabilities, answer: str, sets: Sequence[Judged], beside: Mapping[str, float]
) -> tuple[str, ...]:
    """The likeliest set that holds the answer, what carries most first; beside: shares of what is in every
    set and was fitted in none."""
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


def _weighed(search: Search, nominal: Explanation) -> tuple[Judged, ...]:
    """The sets that take part, best first: none that leaves more of the held-out records than the nominal."""
    weighing, best = search.case.machine.weighing, best_of_sets(search.found)
    noise = search.case.noise
    farthest = nominal.pooled_held_out(noise)
    score = {
        key: score_of(explanation, weighing)
        for key, explanation in best.items()
        if not _contradicted(explanation, best.values(), weighing.model_error)
        and (not key or explanation.pooled_held_out(noise) <= farthest)
    }
    ranked = sorted((best[key] for key in score), key=lambda e: -score[e.key])
    top = score[ranked[0].key]
    chosen = [e for e in ranked[:MANY] if score[e.key] > top - DECISIVE]
    in_time = not search.out_of_time
    return tuple(_judged(search, e, best, nominal, fit=in_time and k == 0) for k, e in enumerate(chosen))


def _contradicted(explanation: Explanation, others: Iterable[Explanation], model_error: float) -> bool:
    """Whether held-out records are left notably more by a set than by a part of it: what it adds is fitted to
    the other records and true of none."""
    left, listed = float(np.max(explanation.shares[1])), _as_listed(explanation)
    parts = [float(np.max(e.shares[1])) for e in others if _as_listed(e) < listed]
    return bool(parts) and left > max(_WORSE * min(parts), min(parts) + LITTLE * model_error)


def _as_listed(explanation: Explanation) -> set[str]:
    """Its effects, each look-alike under the name of what it looks like."""
    return {_LISTED_AS.get(name, name) for name in explanation.names}


def _judged(
    search: Search,
    explanation: Explanation,
    best: Mapping[tuple[str, ...], Explanation],
    nominal: Explanation,
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
    for k, name in enumerate(explanation.names):
        parts[name] = replace(parts[name], by_name=is_none_but_by_name(search, explanation, k))
    by_name = max((part.by_name for part in parts.values() if part.matters > 0.5), default=0.0)
    left, carries = _beyond(explanation), share_beside(nominal, explanation)
    explains = 0.0 if by_name == 1 else _enough(left, weighing)
    complete = (1 - by_name) * explains
    answers = {
        name
        for name, effect in zip(explanation.names, explanation.end.effects, strict=True)
        if name in weighing.listed and effect.as_listed and name not in search.refuted
    }
    for part in parts.values():
        complete *= 1.0 if part.name in answers else 1 - part.matters
    named = tuple(parts[name] for name in explanation.names if name in answers)
    beyond = max((part.share for part in parts.values() if part.name not in answers), default=0.0)
    score = score_of(explanation, weighing)
    return Judged(explanation, named, score, explains, complete, left, carries, beyond)


def is_none_but_by_name(search: Search, explanation: Explanation, k: int) -> float:
    """Probability that the k-th effect is none but by its name.

    At an end of its range it is. A constant is what a static error of an unlisted cause adds, too, where it
    is one share, below one, of the operating points of all records.
    """
    end, records = explanation.end, search.records
    if end.candidates[k].at_edge(end.coordinates_of(k)):
        return 1.0
    column = end.jacobian[:, end.deviations.size + sum(len(c.axes) for c in end.candidates[:k])]
    added = [-records.likelihood.unseen(column[part], search.case.noise.size) for part in records.parts]
    constant = np.array([np.mean(a, axis=0) for a in added])
    if not np.any(constant) or any(
        np.ptp(a) > 1e-3 * np.max(np.abs(a)) for signal in added for a in signal.T if np.any(a)
    ):
        return 0.0
    pairs = zip(records.experiments, explanation.left, strict=True)
    point = np.array([np.mean(e.output - left, axis=0) for e, left in pairs]) - constant
    point = np.where(constant, point, 0.0)
    share = np.sum(constant * point) / (np.sum(point**2) or 1.0)
    same = np.sum((constant - share * point) ** 2) < _SAME_POINT * np.sum(constant**2)
    return UNLISTED / (1 + UNLISTED) if same and abs(share) < 1 else 0.0


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
    if name in search.refuted:
        return Part(name, 0.0, 0.0)
    k, weighing = explanation.names.index(name), search.case.machine.weighing
    model_error, listed = weighing.model_error, weighing.listed
    carried = _carried(rest, explanation)
    estimated, held_out = map(float, carried)
    # A drift may make much of an effect in the records it was fitted to.
    share = float(min(np.sqrt(estimated * held_out), held_out))
    if share < model_error < estimated and is_silent(search, explanation, name):
        share = estimated
    elif estimated < held_out and score_of(explanation, weighing) > DECISIVE + score_of(rest, weighing):
        # Without it the others fit the records they were fitted to as well, with values that others refute.
        share = held_out
    share = max(share, seen.share if seen else 0.0)
    least = _least_that_matters(search, carried, explanation) if name in listed else model_error
    matters, off = _soft(share / least), _tolerances_off(search, explanation, k)
    if off is not None:
        # A stated value in itself: what it changes may be imitated by the others within their tolerances. Far
        # off is not enough: of a value that nobody stated anything is.
        preferred = float(expit(_gain(explanation, listed) - _gain(rest, listed)))
        matters = max(matters, preferred * _soft(off / _FAR_OFF))
        # An effect and a deviation that cancel each other are no finding, whatever a fit without it left.
        matters *= _soft(off / EDGE)
    return Part(name, share, matters)


def _least_that_matters(search: Search, carried: Real, explanation: Explanation) -> float:
    """Share of the motion: the stated model error, or less where an effect explains most of the error that
    there is, of estimation and of held-out records (carried, as shares of the motion), and its set leaves
    less than a good model does. Then that says how much the simulation misses, and counts as much as what is
    stated: the geometric mean of both."""
    stated = search.case.machine.weighing.model_error
    if np.any(carried**2 < MOST_OF_IT * np.max(search.base.mean_squares, axis=1)):
        return stated
    shown = float(np.max(np.sqrt(explanation.mean_squares))) / _IMPERFECTIONS
    return float(np.sqrt(stated * np.clip(shown, _IMPERFECTIONS * stated, stated)))


def is_silent(search: Search, explanation: Explanation, name: str) -> bool:
    """Whether held-out records say nothing about an effect: it does nothing there."""
    acts = search.acts_on_held_out(explanation, explanation.names.index(name))
    return acts < LITTLE * search.case.machine.weighing.model_error


def share_beside(rest: Explanation, explanation: Explanation) -> float:
    """Share of the motion that a set carries beyond a part of it: geometric mean of estimation and held-out
    records."""
    return float(np.sqrt(np.prod(_carried(rest, explanation))))


def _carried(rest: Explanation, explanation: Explanation) -> Real:
    """(2,) the same of estimation records and of held-out ones, of the output that shows most of it."""
    return np.asarray(np.max(np.sqrt(np.maximum(rest.mean_squares - explanation.mean_squares, 0.0)), axis=1))


def _tolerances_off(search: Search, explanation: Explanation, k: int) -> float | None:
    """How far the k-th effect and the deviations together move the value it changes; None for others, and for
    values without a tolerance: none of theirs is there to imitate what the effect does."""
    end, machine = explanation.end, search.case.machine
    kind = end.candidates[k].kind
    key = kind.multiplies or kind.adds_to
    if key is None or key not in machine.tolerances or not machine.description.value(key) > 0:
        return None
    tolerance, stated = machine.tolerances[key], machine.description.value(key)
    moved = stated * np.exp(tolerance * float(end.deviations[search.records.nominal.keys.index(key)]))
    size = next(iter(end.effects[k].parameters().values()))
    moved = moved * size if kind.multiplies else moved + size
    return abs(float(moved / stated) - 1) / tolerance


def below_threshold(search: Search, explanation: Explanation) -> float:
    """Probability that what is left is below the threshold, which other records would show another size of:
    log-normal, as wide as the mean of those that there are is uncertain, and what solver and start add.

    As the records run freely or in windows, whichever leaves less: a drift alone is no error that interests.
    """
    case, seen = search.case, [(search.records, search.held_out)]
    if search.horizon and not search.windows:
        seen.append(
            (Records(case, case.estimation, search.horizon), Records(case, case.held_out, search.horizon))
        )
    found = []
    for fitted, held in seen:
        parts = [fitted.energies(explanation.left), held.energies(explanation.left_held_out)]
        shares = [np.max(mean_square_left(part)) for part in parts]
        energies = np.concatenate(parts, axis=1)
        logs = np.log(np.maximum(np.max(np.sqrt(energies[0] / energies[1]), axis=1), _NOTHING))
        width = np.hypot(_SOFT, np.std(logs) / np.sqrt(logs.size))
        left = max(float(np.sqrt(np.mean(shares))), _NOTHING)
        found.append(float(norm.cdf(np.log(case.machine.weighing.model_error / left) / width)))
    return max(found)


def _beyond(explanation: Explanation) -> float:
    """Share of the motion that is left of estimation and held-out records, as if without contacts."""
    left = float(np.sqrt(np.mean(np.max(explanation.shares, axis=1) ** 2)))
    return left / (_AFTER_CONTACTS if explanation.end.non_smooth else 1.0)


def _enough(left: float, weighing: Weighing) -> float:
    """Probability that what is left is no more than imperfections.

    How large these are where nobody has stated it says nothing about which of several sets is right.
    """
    enough, more = _remaining(left, weighing.model_error, 0.0 if weighing.stated else _UNSTATED_WIDTH)
    return enough / (enough + more)


def _remaining(left: float, model_error: float, uncertain: float = 0.0) -> tuple[float, float]:
    """Densities of a share of the motion that is left by a complete answer, and beside an unknown cause."""
    width = np.hypot(_IMPERFECTIONS_WIDTH, uncertain)
    size = np.log(max(left / model_error, _NOTHING))
    z = max(size - np.log(_IMPERFECTIONS), 0.0) / width
    u = min(size - np.log(_UNKNOWN), 0.0) / _UNKNOWN_WIDTH
    enough = (1 - _PRIOR_UNKNOWN) / width * np.exp(-0.5 * z**2)
    return float(enough), float(_PRIOR_UNKNOWN / _UNKNOWN_WIDTH * np.exp(-0.5 * u**2))


def _soft(ratio: float, width: float = _SOFT) -> float:
    return float(expit(np.log(max(ratio, _NOTHING)) / width))


def _probabilities(sets: Sequence[Judged], listed: Sequence[str], none_enough: float) -> Probabilities:
    """Every set shared out among those of its effects that matter, whether or not it is complete.

    Where it is not, an effect that carries little beside what is left may only stand in for that
    (`_genuine`); unknown is where none is there. Beside a cause beyond the list that carries more, unknown is
    the main cause. None of them only as far as the nominal alone leaves no more than imperfections
    (none_enough): where it leaves more and the set does not, the largest of its effects interests, however
    little it carries. With none_enough zero nobody has stated what does not interest: then that is unknown.
    """
    shared: dict[tuple[str, ...], float] = {("unknown",): 0.0}
    cause = {"none": 0.0, **dict.fromkeys(listed, 0.0), "unknown": 0.0}
    presence = dict.fromkeys(listed, 0.0)

    def give(names: Sequence[str], share: float, main: str = "") -> None:
        key = tuple(sorted(names))
        shared[key] = shared.get(key, 0.0) + share
        cause[main or (names[0] if names else "none")] += share
        for name in presence.keys() & set(names):
            presence[name] += share

    for one in sets:
        parts = sorted(one.parts, key=lambda part: -part.share)
        # It is all; all but a cause beyond the list that looks like an effect; something else is missing.
        branches = (one.complete, one.explains - one.complete, 1 - one.explains)
        for branch, probability in enumerate(branches):
            genuine = [(1.0, float(p.by_name == 0), _genuine(p, one))[branch] for p in parts]
            there = [p.matters * real for p, real in zip(parts, genuine, strict=True)]
            for chosen in subsets(range(len(parts))) if probability > 0 else ():
                share = one.weight * probability
                share *= float(np.prod([p if k in chosen else 1 - p for k, p in enumerate(there)]))
                names = [parts[k].name for k in chosen]
                if branch:
                    looks_alike = branch == 1 and bool(names) and parts[chosen[0]].share < one.beyond
                    give(names or ["unknown"], share, "unknown" if looks_alike else "")
                    continue
                if not names:
                    enough = none_enough / (1.0 if one.explanation.names else one.complete)
                    give([parts[0].name if parts and none_enough > 0 else "unknown"], share * (1 - enough))
                    share *= enough
                give(names, share)
    return Probabilities(
        {name: float(p) for name, p in cause.items()},
        {names: float(p) for names, p in shared.items()},
        {name: float(p) for name, p in presence.items()},
    )


def _genuine(part: Part, one: Judged) -> float:
    """Probability that an effect of a set is no stand-in for what that leaves; two that only make up for each
    other carry no more than the set does."""
    share = min(part.share, one.carries)
    return (1 - part.by_name) * _soft(share / _STANDS_IN / max(one.left, _NOTHING), _STANDS_IN_WIDTH)


def genuine_beside(share: float, left: float) -> float:
    """Probability that an effect does not stand in for what its set leaves.

    share, left : of the energy of the error, what it explains and what nothing explains.
    """
    size = float(np.sqrt(share / max(left, _NOTHING)))
    return _soft(size / _STANDS_IN, _STANDS_IN_WIDTH)


def subsets(items: Iterable[int]) -> list[tuple[int, ...]]:
    """All of them, in the order given, the empty one first."""
    items = list(items)
    return [some for count in range(len(items) + 1) for some in combinations(items, count)]


def _weights(sets: Sequence[Judged]) -> Real:
    """Posterior weights of sets, the mean over a Bayesian bootstrap of the records (Yao et al. 2018, 3.4).

    What imperfections leave is alike within a record and another from one to the next: a set that most of the
    records speak for is surer than one that a single record prefers as much.
    """
    likelihoods = np.array([s.explanation.log_likelihoods for s in sets]) / TEMPER
    count = likelihoods.shape[1]
    draws = count * np.random.default_rng(0).dirichlet(np.ones(count), DRAWS)
    scores = np.array([s.score for s in sets]) + (draws - 1) @ likelihoods.T
    return np.asarray(np.mean(softmax(scores, axis=1), axis=0))
