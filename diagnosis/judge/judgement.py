"""What a judge says of all that a search has fitted, and the record of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic

import numpy as np

from diagnosis.answer import (
    FAR_OFF,
    NOISE_FLOOR,
    POSSIBLE,
    SURE,
    DetailVerdict,
    Diagnosis,
    NamedEffect,
    Prediction,
    Verdict,
    best_first,
    completeness_of,
    held_out_gap,
    remarks,
    share_closed,
)
from diagnosis.evidence.explanation import E
from diagnosis.evidence.hypotheses import Probabilities
from diagnosis.fit.coordinates import parameter_intervals, widened_by
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.rounding import Rounding, rounding_effect
from diagnosis.repair.repair import Trial
from diagnosis.search.loop import SearchLoop


@dataclass(frozen=True, eq=False)
class Judgement:
    """What a judge says. answer: the most probable cause; accepted: effects accepted with it, rounding too
    where it interests, which is read off the values and in none of the sets; alike: others that fit as well.
    untried: effect -> what it needs to be tried. acts_alike: effect -> what its presence is less by, as a
    cause on no list may act like it."""

    probabilities: Probabilities
    answer: str
    accepted: tuple[str, ...]
    untried: Mapping[str, str]
    rounding: Rounding | None = None
    alike: tuple[str, ...] = ()
    acts_alike: Mapping[str, float] = field(default_factory=dict)
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
        others = {n: p for n, p in self.shares.items() if n != self.answer and n not in self.accepted}
        likely = [n for n, p in sorted(others.items(), key=lambda item: -item[1]) if p >= POSSIBLE]
        return tuple(dict.fromkeys([*likely, *(n for n in self.alike if n not in self.accepted)]))

    def detail(self, deviations: Real) -> DetailVerdict:
        """deviations (P,): of the repaired model, in tolerances."""
        if not self.converged:
            return "not_converged"
        if self.verdict == "unknown":
            return "unknown"
        if self.verdict == "none":
            return "parametric" if np.max(np.abs(deviations), initial=0.0) > FAR_OFF else "none"
        unsure = self.probabilities.cause[self.answer] < SURE
        likely = any(self.shares[name] >= POSSIBLE for name in self.ambiguous_with)
        return "ambiguous" if unsure or likely else "effect"


class Judge(ABC, Generic[E]):
    """Weighs what a search has fitted, in `said`, and records it.

    stated, refit, repaired : the models to compare: as stated, nominal values re-estimated, effects added.
    repair : the repaired model with how well it predicts; trials : sets of effects that it was chosen from.
    complete : probability that these effects are all.
    """

    search: SearchLoop[E]
    said: Judgement
    stated: E
    refit: E
    repaired: E
    repair: Trial[E]
    trials: Sequence[Trial[E]]
    complete: float

    @abstractmethod
    def answer(self, rng: np.random.Generator) -> Diagnosis:
        """`recorded`, with what only this judge knows."""

    @abstractmethod
    def holding(self, name: str) -> E | None:
        """Where an effect is fitted best; None where no size of it was worth a fit."""

    @abstractmethod
    def covariance(self, found: E, k: int) -> tuple[Real, Real]:
        """Of all its unknowns (M, M) as far as the records tell, and (A, A) of the k-th effect's coordinates
        from all sources."""

    @abstractmethod
    def explains(self, found: E, name: str, gap_after: float) -> tuple[float, float, float]:
        """See `NamedEffect.explains`; gap_after: that of `found`."""

    def recorded(self, rng: np.random.Generator, **more: Any) -> Diagnosis:
        """more: fields of `Diagnosis` that only one judge knows."""
        case, said, search = self.search.case, self.said, self.search
        keys, weighed = search.records.nominal.keys, said.probabilities
        before, refit, after = (search.whitened(one) for one in (self.stated, self.refit, self.repaired))
        simulations = search.simulations
        of_sensor = rounding_effect(case)
        floor = NOISE_FLOOR if of_sensor is None else of_sensor.floor
        closed, interval = share_closed(case, refit, after, rng, floor)
        named = {name: self._entry(name, keys, after, rng) for name in weighed.presence}
        # "Unknown" is about what the repair leaves.
        unexplained = (1 - closed, 1 - interval[1], 1 - interval[0])
        for name, explains in (("none", (float("nan"),) * 3), ("unknown", unexplained)):
            probability = weighed.cause[name]
            named[name] = NamedEffect(name, probability, probability, {}, {}, float("nan"), explains)

        def off(found: E) -> dict[str, float]:
            return dict(zip(keys, map(float, found.end.deviations), strict=True))

        repair, rounding = self.repaired.end.effects, said.rounding
        return Diagnosis(
            case=case,
            verdict=said.verdict,
            detail_verdict=said.detail(self.repaired.end.deviations),
            probabilities=weighed.cause,
            sets=weighed.sets,
            effects=best_first([*named.values()], said.answer, said.accepted),
            combination=said.accepted if said.verdict == "effect" else (),
            ambiguous_with=said.ambiguous_with,
            gap_before=held_out_gap(case, before),
            gap_refit=held_out_gap(case, refit),
            gap_after=held_out_gap(case, after),
            noise_floor=floor,
            gap_closed=closed,
            gap_closed_interval=interval,
            deviations=off(self.repaired),
            deviations_refit=off(self.refit),
            rig=search.records.nominal.at(self.repaired.end.deviations).description,
            repair=repair if rounding is None else (*repair, rounding.effect),
            residuals_before=before,
            residuals_refit=refit,
            residuals_after=after,
            simulations=simulations,
            completeness=completeness_of(case, self.complete, after),
            partial_model=() if said.verdict == "effect" else tuple(sorted(self.repair.names)),
            prediction=self._prediction(closed),
            **more,
        )

    def _prediction(self, closed: float) -> Prediction:
        """What the repair is worth; closed: share of the validation error that it explains."""
        keys = self.search.records.nominal.keys
        best = min(self.trials, key=lambda trial: trial.error.rms)
        nominal = self.trials[0]
        _, standard_error = self.repair.error.beyond(nominal.error)
        return Prediction(
            effects=self.repair.names,
            values=tuple(key for key, moved in zip(keys, self.repair.moved, strict=True) if moved),
            error_nominal=nominal.error.rms,
            error=self.repair.error.rms,
            error_best=best.error.rms,
            standard_error=standard_error / max(float(np.sum(nominal.error.energy)), np.finfo(float).tiny),
            unexplained=float(np.clip(1 - closed, 0.0, 1.0)),
            tried=tuple((trial.names, trial.error.rms) for trial in self.trials),
        )

    def _entry(
        self, name: str, keys: tuple[str, ...], after: dict[str, Real], rng: np.random.Generator
    ) -> NamedEffect:
        said, rounding, search = self.said, self.said.rounding, self.search
        entry = NamedEffect(
            name,
            said.probabilities.cause[name],
            said.probabilities.presence[name],
            {},
            {},
            float("nan"),
            untried=said.untried.get(name, ""),
            acts_alike=said.acts_alike.get(name, 0.0),
        )
        best = self.holding(name)
        if best is not None:
            end, k = best.end, best.names.index(name)
            candidate, at, rows = end.candidates[k], end.coordinates_of(k), end.rows_of(k)
            told, whole = self.covariance(best, k)
            intervals = parameter_intervals(candidate, at, whole, rng)
            gap = held_out_gap(search.case, search.whitened(best, search.case.held_out))
            widest = widened_by(told, end.deviations.size, rows.start, float(whole[0, 0]))
            entry = replace(
                entry,
                parameters=candidate.parameters(at),
                intervals=intervals,
                gap_after=gap,
                explains=self.explains(best, name, gap),
                remarks=remarks(candidate, at, intervals),
                widened_by="" if widest is None else keys[widest],
            )
        elif rounding is not None and name == rounding.name:
            gap, sizes = held_out_gap(search.case, after), rounding.effect.parameters()
            entry = replace(entry, parameters=sizes, intervals=rounding.intervals, gap_after=gap)
        return entry
