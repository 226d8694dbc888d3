"""What a judge says of all that a search has fitted, and the record of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from diagnosis.fit.coordinates import parameter_intervals, widening_tolerance
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.rounding import Rounding, rounding_effect
from diagnosis.repair.repair import Trial
from diagnosis.search.loop import SearchLoop


@dataclass(frozen=True, eq=False)
class Judgement:
    """What a judge says of a case.

    Attributes
    ----------
    probabilities : Probabilities
        Of causes, of sets of effects, and of every effect's presence.
    answer : str
        The most probable cause: an effect, "none" or "unknown".
    accepted : tuple of str
        Effects that are accepted with the answer. Rounding of a sensor may be among them: it is read off the
        measured values and stands in no fitted set.
    untried : mapping
        Effect that was not tried -> what it needs to be tried.
    rounding : Rounding or None
        Rounding of a sensor that interests.
    alike : tuple of str
        Effects that fit as well as the accepted ones.
    converged : bool
        False where the fit of the repaired model did not end.
    """

    probabilities: Probabilities
    answer: str
    accepted: tuple[str, ...]
    untried: Mapping[str, str]
    rounding: Rounding | None = None
    alike: tuple[str, ...] = ()
    converged: bool = True

    @property
    def verdict(self) -> Verdict:
        """ "none", "unknown", or "effect" where the answer is one."""
        if self.answer == "none":
            return "none"
        if self.answer == "unknown":
            return "unknown"
        return "effect"

    @property
    def shares(self) -> dict[str, float]:
        """Presence of every effect, probabilities of none and unknown."""
        cause = self.probabilities.cause
        return {**self.probabilities.presence, "none": cause["none"], "unknown": cause["unknown"]}

    @property
    def ambiguous_with(self) -> tuple[str, ...]:
        """Other answers that keep at least `POSSIBLE`, most probable first, then effects that fit as well.

        An effect that contains an accepted one (Stribeck friction contains Coulomb friction) is improbable
        for the parameters that it does not need, yet the records do not rule it out.
        """
        probability_of_others = {}
        for name, probability in self.shares.items():
            if name != self.answer and name not in self.accepted and probability >= POSSIBLE:
                probability_of_others[name] = probability
        likely = sorted(probability_of_others, key=lambda name: -probability_of_others[name])
        fitting = [name for name in self.alike if name not in self.accepted]
        # A dictionary keeps the first of each name, in order.
        return tuple(dict.fromkeys([*likely, *fitting]))

    def detail(self, deviations: Real) -> DetailVerdict:
        """The verdict in more detail: whether the fit ended, values are far off, or rivals are possible.

        Parameters
        ----------
        deviations : (P,) array
            Of the repaired model's values from those stated, in tolerances.
        """
        if not self.converged:
            return "not_converged"
        if self.verdict == "unknown":
            return "unknown"
        if self.verdict == "none":
            return "parametric" if np.max(np.abs(deviations), initial=0.0) > FAR_OFF else "none"
        is_unsure = self.probabilities.cause[self.answer] < SURE
        has_rival = any(self.shares[name] >= POSSIBLE for name in self.ambiguous_with)
        return "ambiguous" if is_unsure or has_rival else "effect"


class Judge(ABC, Generic[E]):
    """Weighs what a search has fitted, in `said`, and records it.

    Attributes
    ----------
    search : SearchLoop
        After its run.
    judgement : Judgement
        The answer.
    stated, refit, repaired : Explanation or Hypothesis
        The models to compare: as stated, with nominal values re-estimated, with effects added.
    repair : Trial
        The repaired model with how well it predicts.
    trials : sequence of Trial
        Sets of effects that the repair was chosen from, the nominal first.
    complete : float
        Probability that the effects of the repaired model are all that is missing.
    """

    search: SearchLoop[E]
    judgement: Judgement
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
    def covariance(self, explanation: E, k: int) -> tuple[Real, Real]:
        """Covariances of a fit: (M, M) of all its unknowns as far as the records tell, and (A, A) of the
        coordinates of its k-th effect from all sources."""

    @abstractmethod
    def explains(self, explanation: E, name: str, gap_after: float) -> tuple[float, float, float]:
        """Share of the validation error that an effect explains, with the ends of a 95 % interval; NaN where
        nothing is known (`NamedEffect.explains`). gap_after: RMS that the fit leaves, in noise deviations."""

    def recorded(self, rng: np.random.Generator, **fields: Any) -> Diagnosis:
        """The record of this judgement.

        Parameters
        ----------
        rng : numpy.random.Generator
            Of the intervals.
        **fields
            Of `Diagnosis`, which only one kind of judge knows.
        """
        case = self.search.case
        probabilities = self.judgement.probabilities
        value_names = self.search.records.nominal.keys
        residuals_before = self.search.whitened_residuals(self.stated)
        residuals_refit = self.search.whitened_residuals(self.refit)
        residuals_after = self.search.whitened_residuals(self.repaired)
        # Simulations for the intervals below are not the search's.
        simulations = self.search.simulations

        rounding_of_sensor = rounding_effect(case)
        noise_floor = NOISE_FLOOR if rounding_of_sensor is None else rounding_of_sensor.floor
        closed, closed_interval = share_closed(case, residuals_refit, residuals_after, rng, noise_floor)

        entries = [self._entry(name, residuals_after, rng) for name in probabilities.presence]
        # "Unknown" is about what the repair leaves.
        unexplained = (1 - closed, 1 - closed_interval[1], 1 - closed_interval[0])
        not_a_number = float("nan")
        for name, explains in (("none", (not_a_number,) * 3), ("unknown", unexplained)):
            probability = probabilities.cause[name]
            entries.append(NamedEffect(name, probability, probability, {}, {}, not_a_number, explains))

        repair = self.repaired.fit.effects
        if self.judgement.rounding is not None:
            repair = (*repair, self.judgement.rounding.effect)
        is_effect = self.judgement.verdict == "effect"
        deviations = self.repaired.fit.deviations
        return Diagnosis(
            case=case,
            verdict=self.judgement.verdict,
            detail_verdict=self.judgement.detail(deviations),
            probabilities=probabilities.cause,
            sets=probabilities.sets,
            effects=best_first(entries, self.judgement.answer, self.judgement.accepted),
            combination=self.judgement.accepted if is_effect else (),
            ambiguous_with=self.judgement.ambiguous_with,
            gap_before=held_out_gap(case, residuals_before),
            gap_refit=held_out_gap(case, residuals_refit),
            gap_after=held_out_gap(case, residuals_after),
            noise_floor=noise_floor,
            gap_closed=closed,
            gap_closed_interval=closed_interval,
            deviations=dict(zip(value_names, map(float, deviations), strict=True)),
            deviations_refit=dict(zip(value_names, map(float, self.refit.fit.deviations), strict=True)),
            rig=self.search.records.nominal.at(deviations).description,
            repair=repair,
            residuals_before=residuals_before,
            residuals_refit=residuals_refit,
            residuals_after=residuals_after,
            simulations=simulations,
            completeness=completeness_of(case, self.complete, residuals_after),
            partial_model=() if is_effect else tuple(sorted(self.repair.names)),
            prediction=self._prediction(closed),
            **fields,
        )

    def _prediction(self, closed: float) -> Prediction:
        """What the repair is worth on logs that it was not fitted to.

        closed : share of the validation error that it explains. Errors are RMS in noise deviations, the
        standard error is a share of the nominal model's energy.
        """
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

    def _entry(self, name: str, residuals_after: dict[str, Real], rng: np.random.Generator) -> NamedEffect:
        """What is known of one effect: its probabilities, and its sizes with intervals where it was fitted.

        residuals_after : record -> (T, Y) residuals of the repaired model in noise deviations.
        """
        case = self.search.case
        entry = NamedEffect(
            name,
            self.judgement.probabilities.cause[name],
            self.judgement.probabilities.presence[name],
            {},
            {},
            float("nan"),
            untried=self.judgement.untried.get(name, ""),
        )
        rounding = self.judgement.rounding
        explanation = self.holding(name)
        if explanation is None:
            if rounding is None or name != rounding.name:
                return entry
            return replace(
                entry,
                parameters=rounding.effect.parameters(),
                intervals=rounding.intervals,
                gap_after=held_out_gap(case, residuals_after),
            )

        place = explanation.names.index(name)
        candidate = explanation.fit.candidates[place]
        coordinates = explanation.fit.coordinates_of(place)
        by_records, covariance = self.covariance(explanation, place)
        intervals = parameter_intervals(candidate, coordinates, covariance, rng)
        gap_after = held_out_gap(case, self.search.whitened_residuals(explanation, case.held_out))
        # The nominal value whose uncertainty widens the interval of the effect's size most.
        first_row = explanation.fit.unknowns_of(place).start
        value = widening_tolerance(
            by_records, explanation.fit.deviations.size, first_row, float(covariance[0, 0])
        )
        return replace(
            entry,
            parameters=candidate.parameters(coordinates),
            intervals=intervals,
            gap_after=gap_after,
            explains=self.explains(explanation, name, gap_after),
            remarks=remarks(candidate, coordinates, intervals),
            widened_by="" if value is None else self.search.records.nominal.keys[value],
        )
