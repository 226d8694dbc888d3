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
from diagnosis.judge.verdict import LISTED, genuine_beside
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


class KnownNoise(Judge[Hypothesis]):
    """By the evidence of white noise. A time limit that is over lowers "unknown", and leaves validation
    records aside."""

    search: WhiteSearch

    def __init__(self, search: WhiteSearch) -> None:
        self.search, case, model = search, search.case, search.records
        untried, base = search.untried, search.base
        self.found: Sequence[Hypothesis] = search.found
        weighed = probabilities(self.found)
        accepted, unknown = _accepted(self.found, weighed.answer), weighed.answer == "unknown"
        leading = max(self.found, key=lambda h: h.unknown_weight) if unknown else accepted
        late = search.late("confrontation with validation records")
        seen = None if late or (unknown and leading.is_answer) else confronted(model, self.found, leading)
        self.held_out_decided = seen is not None
        if seen is not None:
            self.found = seen
            weighed = probabilities(self.found)
            accepted = _accepted(self.found, weighed.answer)
        nothing = np.zeros(model.nominal.count)
        self.stated = replace(base, end=replace(base.end, deviations=nothing))
        self.refit = base
        repairs = Repairs(search, base)
        self.repair = repairs.best(accepted.names)
        self.trials = repairs.trials
        self.repaired = self.repair.explanation
        converged = self.repaired.end.converged
        rounding, together = rounding_effect(case), accepted.names
        self.floor = NOISE_FLOOR if rounding is None else rounding.floor
        if rounding is not None:
            before, after = (search.whitened(one) for one in (base, self.repaired))
            leads = leads_over(case, rounding, before, after)
            weighed = weighed.beside(rounding.name, leads=leads)
            together = (rounding.name, *together) if leads or not together else (*together, rounding.name)
        if search.left_out:
            weighed = weighed.with_untried(untried, larger=True)
        # What was not tried counts as unknown.
        answer = weighed.counting_as_unknown(untried).answer
        # Of sets of the same number that fit as well as the accepted one.
        sets = [h for h in self.found if h.is_answer and 0 < len(accepted.names) == len(h.names)]
        near = [h for h in sets if h.end.loss <= accepted.end.loss + SUBSTANTIAL and answer != "unknown"]
        alike = tuple(name for h in sorted(near, key=lambda h: h.end.loss) for name in h.names)
        self.said = Judgement(
            weighed, answer, together, untried, rounding, alike, converged=converged or late
        )
        self.complete = 1 - sum(weighed.cause[name] for name in ("unknown", *untried))
        self.gap_refit = held_out_gap(case, search.whitened(base, case.held_out))
        if answer == "unknown":
            presence = {**weighed.presence, **self._presence_by_prediction()}
            self.said = replace(self.said, probabilities=replace(weighed, presence=presence))

    def _presence_by_prediction(self) -> dict[str, float]:
        """Effect of the repair -> probability that it is there, where prediction has more than evidence.

        The main cause stays unknown: where simulation and sensors are exact, an effect that leaves anything
        is not the whole cause.
        """
        gap_after = self._gap(self.repaired)
        beyond_noise = self.gap_refit**2 - self.floor**2
        if not beyond_noise > 0:
            return {}
        left = max(gap_after**2 - self.floor**2, 0.0) / beyond_noise
        in_repairs = share_of_repairs(self.trials)
        presence = {}
        for name in self.repaired.names:
            if name not in self.said.probabilities.presence:
                continue
            share, _, _ = self.explains(self.repaired, name, gap_after)
            if np.isfinite(share):
                there = presence_by_prediction(in_repairs.get(name, 0.0), genuine_beside(share, left), LISTED)
                presence[name] = max(there, self.said.probabilities.presence[name])
        return presence

    def answer(self, rng: np.random.Generator) -> Diagnosis:
        likeliest = max(self.found, key=lambda h: h.unknown_weight)
        left_out = [what for what in self.search.left_out if what not in self.said.untried]
        return self.recorded(
            rng,
            held_out_decided=self.held_out_decided,
            doubts=(f"the time limit left out {', '.join(left_out)}",) if left_out else (),
            unlisted=likeliest.end.effects
            if self.said.verdict == "unknown" and not likeliest.is_answer
            else (),
            competing=self._competing(),
        )

    def holding(self, name: str) -> Hypothesis | None:
        if name in self.repaired.names:
            return self.repaired
        holding = [h for h in self.found if h.is_answer and name in h.names]
        return max(holding, key=lambda h: h.log_weight) if holding else None

    def covariance(self, found: Hypothesis, k: int) -> tuple[Real, Real]:
        """What is left beyond the noise widens intervals in proportion, as does what solvers disagree about:
        where contacts switch, that is correlated over a record."""
        end, samples = found.end, np.mean([len(record.output) for record in self.search.case.estimation])
        # .674: median of a half-normal prior.
        usual = 0.674 * DISAGREEMENT["non-smooth"] if end.non_smooth else 0.0
        wider = max(1.0, end.rms**2) * (1 + usual**2 * float(samples))
        told = wider * np.asarray(np.linalg.pinv(end.hessian, hermitian=True), dtype=np.float64)
        return told, told[end.rows_of(k), end.rows_of(k)]

    def explains(self, found: Hypothesis, name: str, gap_after: float) -> tuple[float, float, float]:
        """Of the energy of the validation error beyond noise, without an interval."""
        rest = {n for n in found.names if n != name}
        without = [self._gap(h) for h in self.found if h.is_answer and rest == {*h.names}]
        before = min(without, default=np.nan) if rest else self.gap_refit
        energy = self.gap_refit**2 - self.floor**2
        explained = (before**2 - gap_after**2) / energy if energy > 0 else float("nan")
        return float(np.clip(explained, 0.0, 1.0)), float("nan"), float("nan")

    def _gap(self, found: Hypothesis) -> float:
        case = self.search.case
        return held_out_gap(case, self.search.whitened(found, case.held_out))

    def _competing(self) -> tuple[CompetingHypothesis, ...]:
        """What the next experiment is to separate; what is unknown is one where it has a name (a
        look-alike)."""
        case, weighed = self.search.case, self.said.probabilities
        if not isinstance(case, Case):
            return ()
        answers, alike = ([h for h in self.found if h.is_answer == listed] for listed in (True, False))
        competing = competing_hypotheses(case, answers, weighed.sets)
        if not alike:
            return competing
        likeliest = max(alike, key=lambda h: h.unknown_weight)
        acted = [LOOK_ALIKES[n].look_alike_of for n in likeliest.names if n in LOOK_ALIKES]
        if min([weighed.cause["unknown"], *(weighed.presence[str(name)] for name in acted)]) < POSSIBLE:
            return competing
        double = competing_hypothesis(case, likeliest.end, weighed.cause["unknown"])
        ranked = sorted((*competing, double), key=lambda hypothesis: -hypothesis.probability)
        return tuple(ranked[:MOST_COMPETING])


def _accepted(hypotheses: Sequence[Hypothesis], answer: str) -> Hypothesis:
    """The best hypothesis of the answer: nothing added for none and unknown, else the set it leads."""
    names = () if answer in ("none", "unknown") else (answer,)
    return max((h for h in hypotheses if h.names[:1] == names), key=lambda h: h.log_weight)
