"""The judge of a machine whose simulation, with the right effects, is as good as the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diagnosis.answer import NOISE_FLOOR, POSSIBLE, Diagnosis, held_out_gap
from diagnosis.evidence.hypotheses import DISAGREEMENT, Hypothesis, probabilities
from diagnosis.fit.likelihood import SUBSTANTIAL
from diagnosis.judge.by_prediction import presence_by_prediction
from diagnosis.judge.confirmation import confronted
from diagnosis.judge.judgement import Judge, Judgement
from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.rounding import leads_over, rounding_effect
from diagnosis.next_experiment.discrimination import (
    MOST_COMPETING,
    CompetingHypothesis,
    competing_hypotheses,
    competing_hypothesis,
)
from diagnosis.repair.repair import Repairs
from diagnosis.repair.stability import share_of_repairs
from diagnosis.search.white import WhiteSearch
from plant.effects import LOOK_ALIKES

# Median of a half-normal variable, in scales: what solvers usually disagree about, of a prior of that shape.
_HALF_NORMAL_MEDIAN = 0.674


class KnownNoise(Judge[Hypothesis]):
    """Weighs hypotheses by their evidence under white noise of known size.

    Attributes
    ----------
    found : sequence of Hypothesis
        Everything that was fitted, with the weight of validation records where these decided.
    held_out_decided : bool
        Whether validation records moved the weights.
    floor : float
        RMS in noise deviations that a perfect model leaves.
    gap_refit : float
        RMS that the nominal with values re-estimated leaves of validation records, in noise deviations.
    """

    search: WhiteSearch

    def __init__(self, search: WhiteSearch) -> None:
        """Weigh what a search has fitted.

        A time limit that is over leaves validation records aside; what was not tried for it counts as
        unknown.
        """
        self.search = search
        case = search.case
        base = search.nominal_alone
        self.found: Sequence[Hypothesis] = search.explanations
        weighed = probabilities(self.found)
        accepted = _accepted(self.found, weighed.answer)

        # Validation records decide where they contradict what estimation records say.
        is_unknown = weighed.answer == "unknown"
        leading = max(self.found, key=lambda h: h.log_weight_with_unknown) if is_unknown else accepted
        confronted_hypotheses = None
        is_late = search.skips("confrontation with validation records")
        if not is_late and not (is_unknown and leading.is_answer):
            confronted_hypotheses = confronted(search.records, self.found, leading)
        self.held_out_decided = confronted_hypotheses is not None
        if confronted_hypotheses is not None:
            self.found = confronted_hypotheses
            weighed = probabilities(self.found)
            accepted = _accepted(self.found, weighed.answer)

        # The models to compare: as stated, with values re-estimated, with effects added.
        as_stated = replace(base.fit, deviations=np.zeros(search.records.nominal.count))
        self.stated = replace(base, fit=as_stated)
        self.refit = base
        repairs = Repairs(search, base)
        self.repair = repairs.best(accepted.names)
        self.trials = repairs.trials
        self.repaired = self.repair.explanation

        # Rounding of a sensor is read off the measured values and stands in no hypothesis.
        rounding = rounding_effect(case)
        accepted_names = accepted.names
        self.floor = NOISE_FLOOR
        if rounding is not None:
            self.floor = rounding.floor
            leads = leads_over(
                case, rounding, search.whitened_residuals(base), search.whitened_residuals(self.repaired)
            )
            weighed = weighed.with_certain_effect(rounding.name, leads=leads)
            if leads or not accepted_names:
                accepted_names = (rounding.name, *accepted_names)
            else:
                accepted_names = (*accepted_names, rounding.name)

        untried = search.untried
        if search.skipped_for_time:
            weighed = weighed.with_untried(untried, larger=True)
        # What was not tried counts as unknown.
        answer = weighed.counting_as_unknown(untried).answer
        self.judgement = Judgement(
            weighed,
            answer,
            accepted_names,
            untried,
            rounding,
            () if answer == "unknown" else self._fitting_as_well(accepted),
            converged=self.repaired.fit.converged or is_late,
        )
        self.complete = 1 - sum(weighed.cause[name] for name in ("unknown", *untried))
        self.gap_refit = held_out_gap(case, search.whitened_residuals(base, case.held_out))
        if answer == "unknown":
            presence = {**weighed.presence, **self._presence_by_prediction()}
            self.judgement = replace(self.judgement, probabilities=replace(weighed, presence=presence))

    def _fitting_as_well(self, accepted: Hypothesis) -> tuple[str, ...]:
        """Effects of sets of the same number that fit the estimation records as well as the accepted one,
        those that fit best first; none where no effect is accepted."""
        if not accepted.names:
            return ()
        fitting = []
        for hypothesis in self.found:
            is_same_size = hypothesis.is_answer and len(hypothesis.names) == len(accepted.names)
            if is_same_size and hypothesis.fit.loss <= accepted.fit.loss + SUBSTANTIAL:
                fitting.append(hypothesis)
        fitting.sort(key=lambda hypothesis: hypothesis.fit.loss)
        return tuple(name for hypothesis in fitting for name in hypothesis.names)

    def _presence_by_prediction(self) -> dict[str, float]:
        """Effect of the repair -> probability that it is there, where prediction has more than evidence.

        The main cause stays unknown: where simulation and sensors are exact, an effect that leaves anything
        is not the whole cause.
        """
        gap_after = self._validation_gap(self.repaired)
        beyond_noise = self.gap_refit**2 - self.floor**2
        if not beyond_noise > 0:
            return {}
        share_left = max(gap_after**2 - self.floor**2, 0.0) / beyond_noise
        in_repairs = share_of_repairs(self.trials)
        presence = {}
        for name in self.repaired.names:
            if name not in self.judgement.probabilities.presence:
                continue
            share, _, _ = self.explains(self.repaired, name, gap_after)
            if np.isfinite(share):
                by_prediction = presence_by_prediction(in_repairs.get(name, 0.0), share, share_left)
                presence[name] = max(by_prediction, self.judgement.probabilities.presence[name])
        return presence

    def answer(self, rng: np.random.Generator) -> Diagnosis:
        """The record of the judgement; what a time limit left out is a doubt."""
        likeliest = max(self.found, key=lambda hypothesis: hypothesis.log_weight_with_unknown)
        left_out = [what for what in self.search.skipped_for_time if what not in self.judgement.untried]
        doubts = (f"the time limit left out {', '.join(left_out)}",) if left_out else ()
        looks_like = self.judgement.verdict == "unknown" and not likeliest.is_answer
        return self.recorded(
            rng,
            held_out_decided=self.held_out_decided,
            doubts=doubts,
            unlisted=likeliest.fit.effects if looks_like else (),
            competing=self._competing(),
        )

    def holding(self, name: str) -> Hypothesis | None:
        """See `Judge.holding`: the repaired model, or the likeliest hypothesis that holds the effect."""
        if name in self.repaired.names:
            return self.repaired
        holding = [h for h in self.found if h.is_answer and name in h.names]
        return max(holding, key=lambda h: h.log_weight, default=None)

    def covariance(self, explanation: Hypothesis, k: int) -> tuple[Real, Real]:
        """See `Judge.covariance`.

        Notes
        -----
        What is left beyond the noise widens intervals in proportion. So does what solvers disagree about
        where contacts switch: that is correlated over a record, so that its whole length counts as one value.
        """
        fit = explanation.fit
        mean_samples = float(np.mean([len(record.output) for record in self.search.case.estimation]))
        disagreement = _HALF_NORMAL_MEDIAN * DISAGREEMENT["non-smooth"] if fit.non_smooth else 0.0
        widening = max(1.0, fit.rms**2) * (1 + disagreement**2 * mean_samples)
        covariance = widening * np.asarray(np.linalg.pinv(fit.hessian, hermitian=True), dtype=np.float64)
        return covariance, covariance[fit.unknowns_of(k), fit.unknowns_of(k)]

    def explains(self, explanation: Hypothesis, name: str, gap_after: float) -> tuple[float, float, float]:
        """See `Judge.explains`: without an interval, and NaN where the set without the effect was not
        fitted."""
        other_names = {other for other in explanation.names if other != name}
        gap_without = self.gap_refit
        if other_names:
            fitted = [h for h in self.found if h.is_answer and set(h.names) == other_names]
            gap_without = min((self._validation_gap(h) for h in fitted), default=float("nan"))
        beyond_noise = self.gap_refit**2 - self.floor**2
        explained = (gap_without**2 - gap_after**2) / beyond_noise if beyond_noise > 0 else float("nan")
        return float(np.clip(explained, 0.0, 1.0)), float("nan"), float("nan")

    def _validation_gap(self, hypothesis: Hypothesis) -> float:
        """RMS that a hypothesis leaves of validation records, in noise deviations."""
        case = self.search.case
        return held_out_gap(case, self.search.whitened_residuals(hypothesis, case.held_out))

    def _competing(self) -> tuple[CompetingHypothesis, ...]:
        """What the next experiment is to separate, most probable first.

        What is unknown is one of them where it has a name (a look-alike) and it, and every effect that it
        looks like, are possible. Empty for machines that are no rigs.
        """
        case = self.search.case
        if not isinstance(case, Case):
            return ()
        weighed = self.judgement.probabilities
        answers = [h for h in self.found if h.is_answer]
        look_alikes = [h for h in self.found if not h.is_answer]
        competing = competing_hypotheses(case, answers, weighed.sets)
        if not look_alikes:
            return competing
        likeliest = max(look_alikes, key=lambda h: h.log_weight_with_unknown)
        looked_like = [str(LOOK_ALIKES[n].look_alike_of) for n in likeliest.names if n in LOOK_ALIKES]
        if min([weighed.cause["unknown"], *(weighed.presence[name] for name in looked_like)]) < POSSIBLE:
            return competing
        look_alike = competing_hypothesis(case, likeliest.fit, weighed.cause["unknown"])
        ranked = sorted((*competing, look_alike), key=lambda hypothesis: -hypothesis.probability)
        return tuple(ranked[:MOST_COMPETING])


def _accepted(hypotheses: Sequence[Hypothesis], answer: str) -> Hypothesis:
    """The best hypothesis of the answer: without effects for none and unknown, else of the sets that it
    leads."""
    leading_names = () if answer in ("none", "unknown") else (answer,)
    return max((h for h in hypotheses if h.names[:1] == leading_names), key=lambda h: h.log_weight)
