"""The answer about one case: is there a gap, which effect, how sure, how far the gap shrinks with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from diagnosis.evidence.confirmation import confronted
from diagnosis.evidence.hypotheses import DISAGREEMENT, Hypothesis, Probabilities, probabilities
from diagnosis.evidence.look_alikes import look_alikes
from diagnosis.evidence.search import Progress, search
from diagnosis.fit.fit import Fit, fit
from diagnosis.fit.model_error import at_its_own_level
from diagnosis.fit.residual import ResidualModel, pooled_rms
from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from diagnosis.machine.rounding import Rounding, leads_over, rounding_effect
from diagnosis.next_experiment.discrimination import (
    CompetingHypothesis,
    competing_hypotheses,
    competing_hypothesis,
)
from plant.effects import LOOK_ALIKES
from plant.effects.search_space import Candidate

Verdict = Literal["none", "effect", "unknown"]
DetailVerdict = Literal["none", "parametric", "effect", "ambiguous", "unknown", "not_converged"]
# Nominal parameters as stated, re-estimated within their tolerances, effects added.
Model = Literal["stated", "refit", "repaired"]

NOISE_FLOOR = 1.0
# A nominal parameter that has to be off by more tolerances than this is significant by itself.
FAR_OFF = 3.0
# Below this probability of the first answer, or with another one above that, the answer is called ambiguous.
_SURE, _POSSIBLE = 0.8, 0.05
# At most so many explanations are told apart by the next experiment.
_MOST_COMPETING = 3
# Difference of the cost that the records do not tell apart (chi-square, 95 %, two parameters).
_AS_GOOD = 6.0
_LAST_ITERATIONS = 30
_DRAWS, _BLOCKS, _BLOCK = 4000, 2000, 50


@dataclass(frozen=True, eq=False)
class NamedEffect:
    """One possible answer.

    name : effect id, or "none" or "unknown"
    probability : float. That it is the main cause; over all answers the sum is one.
    presence : float
        That it is there at all, as the main cause or beside another (equals `probability` for none, unknown).
    parameters, intervals : parameter -> value, 95 % interval (low, high). From the most probable set of
        effects that holds it; empty for none and unknown, and where no size of the effect was worth a fit.
    gap_after : float. Pooled RMS of the held-out residuals over the noise with that set; nan without a fit.
    """

    name: str
    probability: float
    presence: float
    parameters: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    gap_after: float


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is wrong with a model, as far as its records tell.

    verdict, detail_verdict : str
    effects : tuple of NamedEffect. Every effect, none and unknown; the answer first, then by presence, with
        none and unknown last unless they are the answer.
    combination : tuple of str. Effects that are accepted together; empty for the verdicts none and unknown.
    ambiguous_with : tuple of str. Answers that the records cannot rule out beside the first.
    gap_before, gap_refit, gap_after : float. Pooled RMS of (measured - model)/noise over the held-out
        experiments: nominal rig, nominal parameters moved within their tolerances, accepted effects added.
    gap_closed, gap_closed_interval : float, (low, high)
        1 - (R_after - F)/(R_refit - F) with R, F the held-out mean squares and the noise floor's (design 6.2)
        and its 95 % bootstrap interval over blocks of samples; nan without a gap to close.
    deviations : key -> tolerances
        How far the nominal parameters are off, with the accepted effects in the model.
    rig, repair : The repaired model: nominal parameters moved (a Rig, or a Plant of one's own), effects to
        add (of `plant.effects`, or changes of the own plant).
    residuals_before, residuals_refit, residuals_after : experiment -> (T, 2)
        Whitened, every experiment; (T, Y) in the machine's order of outputs.
    simulations : int. Number of simulated records.
    held_out_decided : bool. The held-out records did not confirm what the others said, and chose among the
        answers (none was fitted to them).
    unlisted : tuple of effects. What explains the records where the answer is unknown and yet can be named: a
        cause beyond the list that looks like one of it, with whatever it acts beside.
    competing : tuple of CompetingHypothesis. Fitted explanations that contradict each other, most probable
        first, for `next_experiment`; only for a flexible link.
    """

    case: Any
    verdict: Verdict
    detail_verdict: DetailVerdict
    probabilities: dict[str, float]
    sets: dict[tuple[str, ...], float]
    effects: tuple[NamedEffect, ...]
    combination: tuple[str, ...]
    ambiguous_with: tuple[str, ...]
    gap_before: float
    gap_refit: float
    gap_after: float
    noise_floor: float
    gap_closed: float
    gap_closed_interval: tuple[float, float]
    deviations: dict[str, float]
    rig: Any
    repair: tuple[Any, ...]
    residuals_before: dict[str, Real]
    residuals_refit: dict[str, Real]
    residuals_after: dict[str, Real]
    simulations: int
    held_out_decided: bool = False
    unlisted: tuple[Any, ...] = ()
    competing: tuple[CompetingHypothesis, ...] = ()

    @property
    def probability(self) -> float:
        """Of the answer: the main cause where it stands alone, the whole set where there are several."""
        if self.verdict != "effect":
            return self.probabilities[self.verdict]
        if len(self.combination) == 1:
            return self.probabilities[self.combination[0]]
        return self.sets[tuple(sorted(self.combination))]

    def presence(self, name: str) -> float:
        """Probability that an effect is there at all; of "none" and "unknown" that they are the answer."""
        return next(effect.presence for effect in self.effects if effect.name == name)

    @property
    def runner_up(self) -> str:
        """The likeliest answer beside the accepted ones."""
        others = [name for name in self.probabilities if name not in self.combination]
        return max((self.presence(name), name) for name in others)[1]

    @property
    def residuals(self) -> dict[Model, dict[str, Real]]:
        """Model -> experiment -> residuals (T, Y) over noise."""
        return {
            "stated": self.residuals_before,
            "refit": self.residuals_refit,
            "repaired": self.residuals_after,
        }

    @property
    def models(self) -> tuple[Model, ...]:
        """Models to compare: re-estimated where there are tolerances, repaired where effects were found."""
        moved: tuple[Model, ...] = ("refit",) if self.deviations else ()
        added: tuple[Model, ...] = ("repaired",) if self.combination else ()
        return ("stated", *moved, *added)

    @property
    def gaps(self) -> dict[Model, float]:
        """Held-out residual over noise of the models to compare."""
        pooled: dict[Model, float] = {
            "stated": self.gap_before,
            "refit": self.gap_refit,
            "repaired": self.gap_after,
        }
        return {model: pooled[model] for model in self.models}

    @property
    def gap_by_experiment(self) -> dict[str, dict[Model, float]]:
        """Experiment -> model -> RMS of the residuals over noise, all sensors together."""
        return {
            e.name: {model: pooled_rms(self.residuals[model][e.name]) for model in self.models}
            for e in self.case.experiments
        }

    @property
    def worst_experiment(self) -> tuple[str, float]:
        """Where most is left with the effects added: its name and RMS over noise."""
        after = {name: pooled_rms(e) for name, e in self.residuals_after.items()}
        name = max(after, key=after.__getitem__)
        return name, after[name]


def diagnose(
    case: CaseOfMachine, *, progress: Progress | None = None, rng: np.random.Generator | None = None
) -> Diagnosis:
    """Search, weigh, and answer.

    case : A `Case` (flexible link) or a `PlantCase` (a simulation of one's own).
    progress : Called with the share done (0 to 1) and what is being done.
    rng : Of interval draws and bootstrap; without it a fixed sequence, so that one case has one answer.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    found = search(case, progress)
    model = ResidualModel(case)
    every: Sequence[Hypothesis]
    every = (*found.hypotheses, *look_alikes(model, found.hypotheses, found.base))
    weighed = probabilities(every)
    accepted = _accepted(every, weighed.answer)
    seen = confronted(model, every, accepted) if weighed.answer != "unknown" else None
    if seen is not None:
        every = seen
        weighed = probabilities(every)
        accepted = _accepted(every, weighed.answer)
    hypotheses = [h for h in every if h.is_answer]
    alike = [h for h in every if not h.is_answer]
    likeliest = max(every, key=lambda h: h.unknown_weight)
    last = _refined(model, accepted.fit)
    before = model.by_experiment(np.zeros(model.nominal.count), ())
    refit = model.by_experiment(found.base.deviations, ())
    after = model.by_experiment(last.deviations, last.effects)
    rounding = rounding_effect(case)
    if rounding is not None:
        leads = leads_over(case, rounding, refit, after)
        weighed = weighed.beside(rounding.name, leads=leads)
    floor = NOISE_FLOOR if rounding is None else rounding.floor
    answer = weighed.answer
    verdict: Verdict = "none" if answer == "none" else "unknown" if answer == "unknown" else "effect"
    together = accepted.names if rounding is None else rounding.joined(accepted.names, leads=leads)
    gap_before, gap_refit, gap_after = (_held_out(case, r) for r in (before, refit, after))
    closed, interval = _closed(case, refit, after, rng, floor)
    ambiguous_with = _competing(weighed, hypotheses, accepted, together, answer)
    return Diagnosis(
        case=case,
        verdict=verdict,
        detail_verdict=_detail(verdict, weighed, ambiguous_with, last),
        probabilities=weighed.cause,
        sets=weighed.sets,
        effects=_named(model, hypotheses, weighed, together, last, rounding, rng),
        combination=together if verdict == "effect" else (),
        ambiguous_with=ambiguous_with,
        gap_before=gap_before,
        gap_refit=gap_refit,
        gap_after=gap_after,
        noise_floor=floor,
        gap_closed=closed,
        gap_closed_interval=interval,
        deviations=dict(zip(model.nominal.keys, map(float, last.deviations), strict=True)),
        rig=model.nominal.at(last.deviations).description,
        repair=last.effects if rounding is None else (*last.effects, rounding.effect),
        residuals_before=before,
        residuals_refit=refit,
        residuals_after=after,
        simulations=found.simulations + model.simulations,
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
    if min([weighed.cause["unknown"], *(weighed.presence[str(name)] for name in imitated)]) < _POSSIBLE:
        return competing
    double = competing_hypothesis(case, likeliest.fit, weighed.cause["unknown"])
    return tuple(sorted((*competing, double), key=lambda hypothesis: -hypothesis.probability))[
        :_MOST_COMPETING
    ]


def _accepted(hypotheses: Sequence[Hypothesis], answer: str) -> Hypothesis:
    """The best hypothesis of the answer: nothing added for none and unknown, else the set it leads."""
    names = () if answer in ("none", "unknown") else (answer,)
    return max((h for h in hypotheses if h.names[:1] == names), key=lambda h: h.log_weight)


def _refined(model: ResidualModel, end: Fit) -> Fit:
    if not end.candidates and not end.deviations.size:
        return end
    last = fit(model, end.candidates, end.coordinates, end.deviations, iterations=_LAST_ITERATIONS)
    return last if last.cost <= end.cost else end


def _detail(verdict: Verdict, weighed: Probabilities, competing: Sequence[str], last: Fit) -> DetailVerdict:
    if not last.converged:
        return "not_converged"
    if verdict == "unknown":
        return "unknown"
    far = bool(last.deviations.size) and float(np.max(np.abs(last.deviations))) > FAR_OFF
    if verdict == "none":
        return "parametric" if far else "none"
    shares = {**weighed.presence, **{name: weighed.cause[name] for name in ("none", "unknown")}}
    likely = any(shares[name] >= _POSSIBLE for name in competing)
    return "ambiguous" if weighed.cause[weighed.answer] < _SURE or likely else "effect"


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
    likely = [name for name, p in sorted(share.items(), key=lambda item: -item[1]) if p >= _POSSIBLE]
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
    last: Fit,
    rounding: Rounding | None,
    rng: np.random.Generator,
) -> tuple[NamedEffect, ...]:
    case = model.case
    samples = float(np.mean([len(record.output) for record in case.estimation]))

    def held_out_gap(end: Fit) -> float:
        return _held_out(case, model.by_experiment(end.deviations, end.effects, case.held_out))

    entries = []
    for name in case.machine.weighing.listed:
        holding = [h for h in hypotheses if name in h.names]
        parameters: dict[str, float] = {}
        intervals: dict[str, tuple[float, float]] = {}
        gap = float("nan")
        if holding:
            end = last if name in last.names else max(holding, key=lambda h: h.log_weight).fit
            k = end.names.index(name)
            parameters = end.candidates[k].parameters(end.coordinates[k])
            intervals = _intervals(end, k, samples, rng)
            gap = held_out_gap(end)
        elif rounding is not None and name == rounding.name:
            parameters, intervals = rounding.effect.parameters(), rounding.intervals
            gap = held_out_gap(last)
        entries.append(
            NamedEffect(name, weighed.cause[name], weighed.presence[name], parameters, intervals, gap)
        )
    entries += [
        NamedEffect(name, weighed.cause[name], weighed.cause[name], {}, {}, float("nan"))
        for name in ("none", "unknown")
    ]
    order = {weighed.answer: -1, **{name: k for k, name in enumerate(together)}}
    last_ones = {"none", "unknown"} - {weighed.answer}
    return tuple(
        sorted(
            entries,
            key=lambda e: (e.name in last_ones, order.get(e.name, len(order)), -e.presence, -e.probability),
        )
    )


def _intervals(
    end: Fit, k: int, samples_per_record: float, rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    """95 % intervals of the parameters of the k-th candidate, from Gaussian draws of its coordinates.

    What is left beyond the noise widens them in proportion, its correlation too where the machine states one,
    and so does what solvers may disagree about.
    """
    if end.weighing.model_error > 0:
        end = at_its_own_level(end)
    candidate: Candidate = end.candidates[k]
    at = end.deviations.size + sum(len(c.axes) for c in end.candidates[:k])
    rows = slice(at, at + len(candidate.axes))
    covariance = (
        end.covariance()[rows, rows] * max(1.0, end.rms**2) * _solver_variance(end, samples_per_record)
    )
    x = end.coordinates[k]
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    low, high = candidate.box
    draws = np.clip(x + rng.standard_normal((_DRAWS, x.size)) @ root.T, low, high)
    found = {}
    centre = candidate.parameters(x)
    sampled = [candidate.parameters(draw) for draw in draws]
    for key, value in centre.items():
        spread = np.array([p[key] for p in sampled]) - value
        if key == "phase_rad":
            spread = np.mod(spread + np.pi, 2 * np.pi) - np.pi
        below, above = np.quantile(spread, [0.025, 0.975])
        found[key] = (float(value + below), float(value + above))
    return found


def _solver_variance(end: Fit, samples_per_record: float) -> float:
    """Variance of fitted values in units of what white noise gives, where contacts switch.

    Two correct solvers of backlash drift apart once a contact falls differently, and stay apart to the end of
    a record: an error of their usual disagreement that is correlated over the record.
    """
    if not end.non_smooth:
        return 1.0
    # median of the half-normal prior of the disagreement's size
    usual = 0.674 * DISAGREEMENT["non-smooth"]
    return 1.0 + usual**2 * samples_per_record


def _held_out(case: CaseOfMachine, residuals: dict[str, Real]) -> float:
    return pooled_rms(np.concatenate([residuals[e.name].ravel() for e in case.held_out]))


def _closed(
    case: CaseOfMachine,
    before: dict[str, Real],
    after: dict[str, Real],
    rng: np.random.Generator,
    floor: float,
) -> tuple[float, tuple[float, float]]:
    """Share of the explainable held-out energy that is gone, with a block bootstrap."""
    pairs = []
    for experiment in case.held_out:
        T = len(experiment.output)
        for start in range(0, T, _BLOCK):
            part = slice(start, start + _BLOCK)
            a, b = before[experiment.name][part], after[experiment.name][part]
            pairs.append((float(np.sum(a**2)), float(np.sum(b**2)), a.size))
    sums = np.array(pairs)
    drawn = sums[rng.integers(0, len(sums), (_BLOCKS, len(sums)))].sum(axis=1)

    def share(total: Real) -> Real:
        explainable = total[..., 0] / total[..., 2] - floor**2
        left = total[..., 1] / total[..., 2] - floor**2
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(explainable > 0, 1 - left / explainable, np.nan))

    # A gap that the noise of so many samples could make is none to close.
    count = sums[:, 2].sum()
    if sums[:, 0].sum() / count - floor**2 < 3 * floor**2 * np.sqrt(2 / count):
        return float("nan"), (float("nan"), float("nan"))
    low, high = np.nanquantile(share(drawn), [0.025, 0.975])
    return float(share(sums.sum(axis=0))), (float(low), float(high))
