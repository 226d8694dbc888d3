"""Which effect: fits of every single one, then of further ones beside the best, until nothing is gained."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.candidates import Candidate
from diagnosis.fit import Fit, cost_at, fit
from diagnosis.hypotheses import Hypothesis
from diagnosis.jagged import refined
from diagnosis.leftover import leftover
from diagnosis.machine_protocol import CaseOfMachine, Real
from diagnosis.residual import ResidualModel
from diagnosis.screening import Screening, Start, smallest_size

Progress = Callable[[float, str], None]

# An effect that changes no record by more than this many noise deviations (RMS) is not looked for.
SMALLEST_SIZE_RATIO = 0.2
# Fits whose cost is within this much of the best are finished with exact derivatives.
_CLOSE = 60.0
# A further effect has a smaller prior (7 in log weight, 15 in cost): what gains less roughly is not finished.
_LEAST_GAIN = 10.0
_ROUGH_ITERATIONS, _FINE_ITERATIONS = 8, 15
_MOST_EFFECTS = 3
# Where two effects leave more than this share of the gap, a third would only imitate something unknown.
_HOPELESS = 0.1
# Sets whose members are tried without one of them.
_SETS_TO_REDUCE = 3
# Further effects that are fitted beside the best hypothesis, by the cost their screening promises.
_BESIDE = 6


@dataclass(frozen=True, eq=False)
class Search:
    """Everything that was fitted: the nominal alone, then every hypothesis, most probable first."""

    base: Fit
    hypotheses: tuple[Hypothesis, ...]
    simulations: int

    @property
    def best(self) -> Hypothesis:
        return self.hypotheses[0]


def search(case: CaseOfMachine, progress: Progress | None = None) -> Search:
    """Fit the nominal, every effect alone, and sets of effects as long as they gain."""
    report = progress or (lambda fraction, message: None)
    model = ResidualModel(case)
    base = fit(model, (), (), np.zeros(model.nominal.count))
    screening = Screening(model, base)
    listed: list[tuple[Candidate, list[Start]]] = []
    spaces = case.machine.candidates(case)
    for k, candidate in enumerate(spaces):
        report(0.05 + 0.3 * k / len(spaces), f"looking at {candidate.effect}")
        starts = screening.starts(candidate)
        least = smallest_size(candidate, starts, SMALLEST_SIZE_RATIO) if starts else None
        if least is not None:
            if candidate.dependence == "jagged":
                starts = screening.zoomed(candidate, starts)
            listed.append((candidate.from_size(least), starts))
    found = [_weighed(model, base)]
    found += _fitted(model, base, listed, _part(report, 0.35, 0.35))
    found.sort(key=lambda h: -h.log_weight)
    while found[0].names and len(found[0].names) < _MOST_EFFECTS:
        lead = found[0]
        if len(lead.names) > 1 and _beyond_noise(lead.fit) > _HOPELESS * _beyond_noise(base):
            break
        further = [
            (candidate, screening.beside(lead.fit, starts))
            for candidate, starts in listed
            if candidate.effect not in lead.names
        ]
        further.sort(key=lambda item: item[1][0].cost)
        found += _fitted(model, lead.fit, further[:_BESIDE], _part(report, 0.7 + 0.1 * len(lead.names), 0.1))
        found += _without_one(model, found)
        found.sort(key=lambda h: -h.log_weight)
        if len(found[0].names) <= len(lead.names):
            break
    report(1.0, "done")
    return Search(base, tuple(found), model.simulations)


def _beyond_noise(end: Fit) -> float:
    return max(end.rms**2 - 1.0, 0.0)


def _weighed(model: ResidualModel, end: Fit) -> Hypothesis:
    segments = [len(experiment.output) for experiment in model.case.estimation]
    return Hypothesis.of(end, leftover(end.residuals, segments, model.case.noise.size))


def _part(report: Progress, begin: float, share: float) -> Progress:
    return lambda fraction, message: report(begin + share * fraction, message)


def _fitted(
    model: ResidualModel, around: Fit, listed: Sequence[tuple[Candidate, list[Start]]], report: Progress
) -> list[Hypothesis]:
    """Hypotheses with one effect more than `around`: rough fits of all, the best finished."""
    nominal = around.jacobian[:, : around.deviations.size]
    rough = []
    for k, (candidate, starts) in enumerate(listed):
        report(0.6 * k / len(listed), f"fitting {candidate.effect}")
        ends = [
            fit(
                model,
                (*around.candidates, candidate),
                (*around.coordinates, start.coordinates),
                model.nominal.within(start.deviations),
                nominal_jacobian=nominal,
                iterations=_ROUGH_ITERATIONS,
                tolerance=0.5,
            )
            for start in _apart(starts, around.cost)
        ]
        rough.append(min(ends, key=lambda end: end.cost))
    rough.sort(key=lambda end: end.cost)
    finished = []
    for k, item in enumerate(rough):
        report(0.6 + 0.4 * k / len(rough), f"finishing {item.names[-1]}")
        promising = item.cost < min(rough[0].cost + _CLOSE, around.cost - _LEAST_GAIN)
        if k < (1 if around.candidates else 3) or promising:
            fine = fit(model, item.candidates, item.coordinates, item.deviations, iterations=_FINE_ITERATIONS)
            item = refined(model, fine if fine.cost <= item.cost else item)
        finished.append(_weighed(model, item))
    return finished


def _without_one(model: ResidualModel, found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best sets of effects with one of their members left out, fitted from where the set has ended.

    A set often finds its way where a member alone has stuck; what it found there is no merit of the further
    effect, so the smaller set is given the same start.
    """
    known: dict[tuple[str, ...], Fit] = {}
    for hypothesis in found:
        key = tuple(sorted(hypothesis.names))
        if key not in known or hypothesis.fit.cost < known[key].cost:
            known[key] = hypothesis.fit
    tried: list[Hypothesis] = []
    for hypothesis in sorted(found, key=lambda h: -h.log_weight)[:_SETS_TO_REDUCE]:
        whole = hypothesis.fit
        for k in range(len(whole.candidates)) if len(whole.candidates) > 1 else ():
            rest = tuple(c for i, c in enumerate(whole.candidates) if i != k)
            before = known.get(tuple(sorted(c.effect for c in rest)))
            x = tuple(part for i, part in enumerate(whole.coordinates) if i != k)
            start = cost_at(model, rest, x, whole.deviations)
            # From one contact sequence to the next the cost jumps: there a bad start says nothing.
            jagged = any(c.dependence == "jagged" for c in rest)
            if before is not None and start > before.cost + _CLOSE and not jagged:
                continue
            end = refined(model, fit(model, rest, x, whole.deviations, iterations=_FINE_ITERATIONS))
            if before is None or end.cost < before.cost:
                tried.append(_weighed(model, end))
    return tried


def _apart(starts: list[Start], without: float) -> list[Start]:
    """The best start, and a second one that is elsewhere and not much worse."""
    best = starts[0]
    enough = best.cost + 0.5 * abs(without - best.cost) + 20
    for start in starts[1:]:
        if start.cost < enough and _distance(start.coordinates, best.coordinates) > 0.3:
            return [best, start]
    return [best]


def _distance(a: Real, b: Real) -> float:
    return float(np.max(np.abs(a - b)))
