"""The record of an answer from what a judge found, with or without a model error."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

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
from diagnosis.evidence.hypotheses import Probabilities
from diagnosis.fit.nominal import NominalParameters
from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from diagnosis.machine.rounding import Rounding, rounding_effect
from plant.effects.search_space import Candidate


@dataclass(frozen=True, eq=False)
class FittedEffect:
    """An effect where it is fitted best: coordinates (A,), 95 % intervals; gap_after, explains as in
    `NamedEffect`, of the set that it is in; widened_by: the nominal value it is widest by."""

    candidate: Candidate
    coordinates: Real
    intervals: dict[str, tuple[float, float]]
    gap_after: float
    explains: tuple[float, float, float]
    widened_by: int | None = None


@dataclass(frozen=True, eq=False)
class Model:
    """Nominal values off by deviations (P,), whitened residuals (T, Y) of every experiment."""

    deviations: Real
    residuals: dict[str, Real]


@dataclass(frozen=True, eq=False)
class Judgement:
    """What a judge says. answer: the first one; together: effects accepted with it, rounding too where it
    interests; alike: others that fit as well. refit, repaired: without and with effects; repair: these;
    complete: probability that they are all. untried: effect -> what it needs to be tried. acts_alike:
    effect -> probability that a cause on no list acts like it."""

    probabilities: Probabilities
    answer: str
    together: tuple[str, ...]
    stated: Model
    refit: Model
    repaired: Model
    repair: tuple[Any, ...]
    complete: float
    rounding: Rounding | None = None
    alike: tuple[str, ...] = ()
    untried: Mapping[str, str] | None = None
    acts_alike: Mapping[str, float] | None = None
    converged: bool = True

    @property
    def verdict(self) -> Verdict:
        named: dict[str, Verdict] = {"none": "none", "unknown": "unknown"}
        return named.get(self.answer, "effect")

    @property
    def shares(self) -> dict[str, float]:
        """Presence of every effect, probabilities of none and unknown."""
        both = {name: self.probabilities.cause[name] for name in ("none", "unknown")}
        return {**self.probabilities.presence, **both}

    @property
    def ambiguous_with(self) -> tuple[str, ...]:
        """Other answers that keep more than a few per cent, most probable first, then effects that fit as
        well: one that contains an accepted one (Stribeck friction) is improbable for its needless parameters,
        yet the records do not rule it out."""
        others = {n: p for n, p in self.shares.items() if n != self.answer and n not in self.together}
        likely = [n for n, p in sorted(others.items(), key=lambda item: -item[1]) if p >= POSSIBLE]
        return tuple(dict.fromkeys([*likely, *(n for n in self.alike if n not in self.together)]))

    @property
    def detail(self) -> DetailVerdict:
        if not self.converged:
            return "not_converged"
        if self.verdict == "unknown":
            return "unknown"
        if self.verdict == "none":
            far = np.max(np.abs(self.repaired.deviations), initial=0.0) > FAR_OFF
            return "parametric" if far else "none"
        unsure = self.probabilities.cause[self.answer] < SURE
        likely = any(self.shares[name] >= POSSIBLE for name in self.ambiguous_with)
        return "ambiguous" if unsure or likely else "effect"


def assembled(
    case: CaseOfMachine,
    nominal: NominalParameters,
    found: Judgement,
    fitted: Callable[[str], FittedEffect | None],
    rng: np.random.Generator,
    **more: Any,
) -> Diagnosis:
    """fitted: effect -> where it is fitted best. more: fields of `Diagnosis` that only one judge knows."""
    keys, weighed = nominal.keys, found.probabilities
    before, refit, after = (model.residuals for model in (found.stated, found.refit, found.repaired))
    of_sensor = rounding_effect(case)
    floor = NOISE_FLOOR if of_sensor is None else of_sensor.floor
    closed, interval = share_closed(case, refit, after, rng, floor)
    named = {name: _entry(name, found, fitted(name), case, keys) for name in weighed.presence}
    for name in ("none", "unknown"):
        named[name] = NamedEffect(name, weighed.cause[name], weighed.cause[name], {}, {}, float("nan"))

    def off(model: Model) -> dict[str, float]:
        return dict(zip(keys, map(float, model.deviations), strict=True))

    return Diagnosis(
        case=case,
        verdict=found.verdict,
        detail_verdict=found.detail,
        probabilities=weighed.cause,
        sets=weighed.sets,
        effects=best_first([*named.values()], found.answer, found.together),
        combination=found.together if found.verdict == "effect" else (),
        ambiguous_with=found.ambiguous_with,
        gap_before=held_out_gap(case, before),
        gap_refit=held_out_gap(case, refit),
        gap_after=held_out_gap(case, after),
        noise_floor=floor,
        gap_closed=closed,
        gap_closed_interval=interval,
        deviations=off(found.repaired),
        deviations_refit=off(found.refit),
        rig=nominal.at(found.repaired.deviations).description,
        repair=found.repair if found.rounding is None else (*found.repair, found.rounding.effect),
        residuals_before=before,
        residuals_refit=refit,
        residuals_after=after,
        completeness=completeness_of(case, found.complete, after),
        **more,
    )


def _entry(
    name: str, found: Judgement, fitted: FittedEffect | None, case: CaseOfMachine, keys: tuple[str, ...]
) -> NamedEffect:
    weighed, rounding = found.probabilities, found.rounding
    entry = NamedEffect(name, weighed.cause[name], weighed.presence[name], {}, {}, float("nan"))
    if fitted is not None:
        entry = replace(
            entry,
            parameters=fitted.candidate.parameters(fitted.coordinates),
            intervals=fitted.intervals,
            gap_after=fitted.gap_after,
            explains=fitted.explains,
            remarks=remarks(fitted.candidate, fitted.coordinates, fitted.intervals),
            widened_by="" if fitted.widened_by is None else keys[fitted.widened_by],
        )
    elif rounding is not None and name == rounding.name:
        gap = held_out_gap(case, found.repaired.residuals)
        sizes = rounding.effect.parameters()
        entry = replace(entry, parameters=sizes, intervals=rounding.intervals, gap_after=gap)
    alike = (found.acts_alike or {}).get(name, 0.0)
    return replace(entry, untried=(found.untried or {}).get(name, ""), acts_alike=alike)
