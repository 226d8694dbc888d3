"""The answer about a machine whose simulation, with the right effects, is as good as the sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from diagnosis.answer import NOISE_FLOOR, POSSIBLE, Diagnosis, held_out_gap
from diagnosis.assembled import FittedEffect, Judgement, Model, assembled
from diagnosis.evidence.confirmation import confronted
from diagnosis.evidence.hypotheses import DISAGREEMENT, Hypothesis, Probabilities, probabilities
from diagnosis.evidence.search import WhiteSearch
from diagnosis.fit.coordinates import parameter_intervals, widened_by
from diagnosis.fit.descent import FINE, Descent
from diagnosis.fit.likelihood import SUBSTANTIAL
from diagnosis.fit.residual import ResidualModel
from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import CaseOfMachine
from diagnosis.machine.rounding import leads_over, rounding_effect
from diagnosis.next_experiment.discrimination import (
    MOST_COMPETING,
    CompetingHypothesis,
    competing_hypotheses,
    competing_hypothesis,
)
from diagnosis.search.loop import Progress
from plant.effects import LOOK_ALIKES


def without_error(
    case: CaseOfMachine, progress: Progress, rng: np.random.Generator, deadline_s: float = np.inf
) -> Diagnosis:
    """deadline_s : of time.monotonic(); what was not tried until then is said, and lowers "unknown"."""
    search = WhiteSearch(case, progress, deadline_s)
    search.run_in_time()
    model, base = search.records, search.base.end
    every: Sequence[Hypothesis] = search.found
    untried = search.untried
    left_out = [what for what in search.left_out if what not in untried]
    weighed = probabilities(every)
    accepted, unknown = _accepted(every, weighed.answer), weighed.answer == "unknown"
    leading = max(every, key=lambda h: h.unknown_weight) if unknown else accepted
    late = search.late("confrontation with validation records")
    seen = None if late or (unknown and leading.is_answer) else confronted(model, every, leading)
    if seen is not None:
        every = seen
        weighed = probabilities(every)
        accepted = _accepted(every, weighed.answer)
    hypotheses = [h for h in every if h.is_answer]
    alike = [h for h in every if not h.is_answer]
    likeliest = max(every, key=lambda h: h.unknown_weight)
    last = accepted.end
    if not late and (last.candidates or last.deviations.size):
        last = min(last.on(model, model.start, **FINE), last, key=lambda one: one.loss)
    refit = model.by_experiment(base.deviations, ())
    after = model.by_experiment(last.deviations, last.effects)
    rounding, together = rounding_effect(case), accepted.names
    if rounding is not None:
        leads = leads_over(case, rounding, refit, after)
        weighed = weighed.beside(rounding.name, leads=leads)
        together = (rounding.name, *together) if leads or not together else (*together, rounding.name)
    if search.left_out:
        weighed = weighed.with_untried(untried, larger=True)
    # What was not tried counts as unknown.
    judged = weighed.counting_as_unknown(untried).answer
    found = Judgement(
        weighed,
        judged,
        together,
        Model(np.zeros(model.nominal.count), model.by_experiment(np.zeros(model.nominal.count), ())),
        Model(base.deviations, refit),
        Model(last.deviations, after),
        last.effects,
        1 - weighed.cause["unknown"]
        if not untried
        else 1 - sum(weighed.cause[name] for name in ("unknown", *untried)),
        rounding,
        _as_good(hypotheses, accepted) if judged != "unknown" else (),
        untried,
        converged=last.converged or late,
    )
    return assembled(
        case,
        model.nominal,
        found,
        _fitted(
            model,
            hypotheses,
            last,
            rounding.floor if rounding else NOISE_FLOOR,
            held_out_gap(case, refit),
            rng,
        ),
        rng,
        simulations=model.simulations,
        held_out_decided=seen is not None,
        doubts=(f"the time limit left out {', '.join(left_out)}",) if left_out else (),
        unlisted=likeliest.end.effects if found.verdict == "unknown" and not likeliest.is_answer else (),
        competing=_to_part(case, hypotheses, weighed, alike) if isinstance(case, Case) else (),
    )


def _as_good(hypotheses: Sequence[Hypothesis], accepted: Hypothesis) -> tuple[str, ...]:
    """Effects of sets of the same number that fit as well as the accepted one."""
    rivals = [h for h in hypotheses if accepted.names and len(h.names) == len(accepted.names)]
    near = [h for h in rivals if h.end.loss <= accepted.end.loss + SUBSTANTIAL]
    return tuple(name for h in sorted(near, key=lambda h: h.end.loss) for name in h.names)


def _to_part(
    case: Case, hypotheses: Sequence[Hypothesis], weighed: Probabilities, alike: Sequence[Hypothesis]
) -> tuple[CompetingHypothesis, ...]:
    """What the next experiment is to separate; what is unknown is one where it has a name (a look-alike)."""
    competing = competing_hypotheses(case, hypotheses, weighed.sets)
    if not alike:
        return competing
    likeliest = max(alike, key=lambda h: h.unknown_weight)
    imitated = [LOOK_ALIKES[n].look_alike_of for n in likeliest.names if n in LOOK_ALIKES]
    if min([weighed.cause["unknown"], *(weighed.presence[str(name)] for name in imitated)]) < POSSIBLE:
        return competing
    double = competing_hypothesis(case, likeliest.end, weighed.cause["unknown"])
    return tuple(sorted((*competing, double), key=lambda hypothesis: -hypothesis.probability))[
        :MOST_COMPETING
    ]


def _accepted(hypotheses: Sequence[Hypothesis], answer: str) -> Hypothesis:
    """The best hypothesis of the answer: nothing added for none and unknown, else the set it leads."""
    names = () if answer in ("none", "unknown") else (answer,)
    return max((h for h in hypotheses if h.names[:1] == names), key=lambda h: h.log_weight)


def _fitted(
    model: ResidualModel,
    hypotheses: Sequence[Hypothesis],
    last: Descent,
    floor: float,
    gap_refit: float,
    rng: np.random.Generator,
) -> Callable[[str], FittedEffect | None]:
    """floor, gap_refit : of validation records over noise: what noise and rounding leave, and the nominal."""
    case = model.case
    samples = float(np.mean([len(record.output) for record in case.estimation]))

    def gap_of(end: Descent) -> float:
        return held_out_gap(case, model.by_experiment(end.deviations, end.effects, case.held_out))

    def fitted(name: str) -> FittedEffect | None:
        holding = [h for h in hypotheses if name in h.names]
        if not holding:
            return None
        end = last if name in last.names else max(holding, key=lambda h: h.log_weight).end
        k, after = end.names.index(name), gap_of(end)
        rest = {n for n in end.names if n != name}
        without = [gap_of(h.end) for h in hypotheses if rest == set(h.names)] if rest else [gap_refit]
        # Of the energy of the validation error beyond noise.
        energy, explained = gap_refit**2 - floor**2, min(without, default=np.nan) ** 2 - after**2
        share = float(np.clip(explained / energy, 0.0, 1.0)) if energy > 0 else float("nan")
        # What is left beyond the noise widens intervals in proportion, as does what solvers disagree about.
        # Where contacts switch, that is correlated over a record; .674: median of a half-normal prior.
        usual = 0.674 * DISAGREEMENT["non-smooth"] if end.non_smooth else 0.0
        wider = max(1.0, end.rms**2) * (1 + usual**2 * samples)
        inverse = wider * np.asarray(np.linalg.pinv(end.hessian, hermitian=True), dtype=np.float64)
        rows = end.rows_of(k)
        return FittedEffect(
            end.candidates[k],
            end.coordinates_of(k),
            parameter_intervals(end.candidates[k], end.coordinates_of(k), inverse[rows, rows], rng),
            after,
            (share, float("nan"), float("nan")),
            widened_by(inverse, end.deviations.size, rows.start, float(inverse[rows, rows][0, 0])),
        )

    return fitted
