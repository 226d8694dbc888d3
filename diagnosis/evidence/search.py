"""Which effect: fits of every single one, then of further ones beside the best, until nothing is gained."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from diagnosis.evidence.hypotheses import BESIDE_NON_SMOOTH, DISAGREEMENT, Hypothesis
from diagnosis.evidence.screening import Screening, Start, smallest_size
from diagnosis.fit.discrepancy import discrepancy
from diagnosis.fit.fit import Fit, cost_at, fit, non_smooth, refined
from diagnosis.fit.residual import ResidualModel
from diagnosis.fit.solver_spread import NO_DRIFT, solver_spread, without_drift
from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from plant.effects import Effect
from plant.effects.search_space import Candidate

Progress = Callable[[float, str], None]

# An effect that changes no record by more than this many noise deviations (RMS) is not looked for: alone, and
# beside others, where two dozen further effects have as many chances to follow noise and solver errors.
SMALLEST_SIZE_RATIO, SMALLEST_SIZE_BESIDE = 0.06, 0.2
# Fits whose cost is within this much of the best are finished with exact derivatives.
_CLOSE = 60.0
# A further effect has a smaller prior (7 in log weight, 15 in cost): what gains less roughly is not finished.
_LEAST_GAIN = 10.0
# The same before a fit, by its linear estimate, which is a little low.
_PROMISE = 5.0
_ROUGH_ITERATIONS, _FINE_ITERATIONS = 8, 15
_MOST_EFFECTS = 3
# Where two effects leave more than this share of the gap, a third would only follow something unknown.
_HOPELESS = 0.1
# Sets whose members are tried without one of them.
_SETS_TO_REDUCE = 3
# Further effects that are fitted beside the best hypothesis, by the cost their screening promises.
_BESIDE = 6
# Starts of a further effect that are simulated beside a parent; fewer where a record takes ten times as long.
_STARTS_TO_SIMULATE, _NON_SMOOTH_TO_SIMULATE = 40, 8
# A nominal parameter pulled this far (tolerances) may stand for an effect.
_BEYOND_BELIEF = 2.0
# Single effects, and pairs, that are extended where no set explains everything.
_BEAM = {1: 3, 2: 1}
# Sizes of non-smooth effects are refined where no more than this share of the gap, or this energy, is left.
_NEAR, _NEAR_FLOOR = 0.25, 0.3


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
    N = base.residuals.size
    first: list[_Trial] = []
    listed: list[tuple[Candidate, list[Start]]] = []
    spaces = case.machine.candidates(case.experiments)
    for k, candidate in enumerate(spaces):
        report(0.05 + 0.3 * k / len(spaces), f"looking at {candidate.effect}")
        starts = screening.starts(candidate)
        alone = smallest_size(candidate, starts, SMALLEST_SIZE_RATIO) if starts else None
        beside = smallest_size(candidate, starts, SMALLEST_SIZE_BESIDE) if starts else None
        if alone is None or beside is None:
            continue
        if candidate.dependence == "non-smooth" and starts[0].cost - N < 0.5 * (base.cost - N):
            starts = screening.zoomed(candidate, starts)
        first.append(_Trial(base, candidate.from_size(alone), starts))
        listed.append((candidate.from_size(beside), starts))
    first += _pulled(model, base, [trial.candidate for trial in first])
    found = [weighed(model, base, base)]
    found += _fitted(model, base, first, _part(report, 0.35, 0.35))
    for count in range(1, _MOST_EFFECTS):
        found.sort(key=lambda h: -h.log_weight)
        best, parents = found[0], _parents(found, count)
        if not parents or len(best.names) < (count if _explained(found) else 1):
            break
        hopeless = _beyond_noise(parents[0]) > _HOPELESS * _beyond_noise(base)
        if count > 1 and (hopeless or _as_solvers_differ(model, parents[0])):
            break
        further = _further(screening, parents, listed, explained=_explained(found))
        found += _fitted(model, base, further, _part(report, 0.6 + 0.1 * count, 0.1))
        found += _reduced(model, base, found, [candidate for candidate, _ in listed])
    found.sort(key=lambda h: -h.log_weight)
    report(1.0, "done")
    return Search(base, tuple(found), model.simulations)


@dataclass(frozen=True, eq=False)
class _Trial:
    """One effect more than a fit holds."""

    around: Fit
    candidate: Candidate
    starts: list[Start]

    @property
    def effects(self) -> frozenset[str]:
        return frozenset((*self.around.names, self.candidate.effect))


def _explained(found: Sequence[Hypothesis]) -> bool:
    """Whether the best set leaves nothing over, by its own evidence against that of an unknown rest."""
    return max(h.log_weight for h in found) >= max(h.unknown_weight for h in found)


def _parents(found: Sequence[Hypothesis], count: int) -> list[Fit]:
    """Sets of so many effects to which one more is added, best first.

    The best one as soon as a set explains everything. Before, what is left over says little about which
    member of the true set has been found: of single effects the three that would leave the most probable
    unknown rest.
    """
    if _explained(found):
        best = max(found, key=lambda h: h.log_weight)
        return [best.fit] if len(best.names) == count else []
    parents: dict[frozenset[str], Fit] = {}
    for h in sorted(found, key=lambda h: -h.unknown_weight):
        if len(h.names) == count:
            parents.setdefault(frozenset(h.names), h.fit)
    return list(parents.values())[: _BEAM[count]]


def _further(
    screening: Screening,
    parents: Sequence[Fit],
    listed: Sequence[tuple[Candidate, list[Start]]],
    *,
    explained: bool,
) -> list[_Trial]:
    """The most promising effects beside the parents, every set and side of an effect once."""
    model = screening.model
    trials = []
    for parent in parents:
        anew = Screening(model, parent)
        for candidate, starts in listed:
            if candidate.effect not in parent.names:
                # Phases and amplitudes found without the parent are of no use beside it.
                beside = (
                    anew.starts(candidate) if candidate.kind.harmonic else screening.beside(parent, starts)
                )
                trials.append(_Trial(parent, candidate, beside))
    chosen: dict[tuple[frozenset[str], int], _Trial] = {}
    for trial in sorted(trials, key=lambda trial: trial.starts[0].cost):
        chosen.setdefault((trial.effects, trial.candidate.sign), trial)
    promising = list(chosen.values())[: _BESIDE + 2 * (len(parents) - 1)]
    if explained:
        # Nothing is left over; what linear estimates do not even promise is not fitted.
        promising = [t for t in promising if t.around.cost - t.starts[0].cost > _least_promise(t.around)]
    pulled = [p for parent in parents for p in _pulled(model, parent, [candidate for candidate, _ in listed])]
    return [_simulated(screening, trial) for trial in promising] + pulled


def _least_promise(parent: Fit) -> float:
    """Beside backlash a further effect has to gain more (in log weight; half of that in linear estimates)."""
    return _PROMISE + (BESIDE_NON_SMOOTH if parent.non_smooth else 0.0)


def _pulled(model: ResidualModel, parent: Fit, listed: Sequence[Candidate]) -> list[_Trial]:
    """Effects that multiply a nominal parameter, in place of that value pulled beyond belief."""
    trials = []
    factors = model.nominal.factors(parent.deviations)
    for k, key in enumerate(model.nominal.keys):
        found = in_place_of(key, factors[key], listed) if abs(parent.deviations[k]) > _BEYOND_BELIEF else None
        if found is None or found[0].effect in parent.names:
            continue
        d = parent.deviations.copy()
        d[k] = 0.0
        trials.append(
            _Trial(parent, found[0], [Start(parent.cost, found[1], d, 1.0, np.zeros(1, np.float32))])
        )
    return trials


def in_place_of(key: str, factor: float, listed: Sequence[Candidate]) -> tuple[Candidate, Real] | None:
    """The effect that multiplies a nominal parameter by this factor, or by the nearest one worth a name."""
    sign = 1 if factor > 1 else -1
    for candidate in listed:
        if candidate.kind.multiplies == key and candidate.sign == sign:
            return candidate, np.clip([candidate.axes[0].coordinate(factor)], *candidate.box)
    return None


def _simulated(screening: Screening, trial: _Trial) -> _Trial:
    """The trial with its best starts judged by simulation."""
    if trial.candidate.kind.harmonic:
        return trial
    best = trial.starts[: _NON_SMOOTH_TO_SIMULATE if non_smooth([trial.candidate]) else _STARTS_TO_SIMULATE]
    starts = screening.simulated_beside(trial.around, trial.candidate, best)
    return replace(trial, starts=starts) if starts else trial


def _beyond_noise(end: Fit) -> float:
    return max(end.rms**2 - 1.0, 0.0)


def _as_solvers_differ(model: ResidualModel, end: Fit) -> bool:
    """Whether backlash is in the set and what is left is no more than correct solvers of it may differ by."""
    if not end.non_smooth:
        return False
    e, drift = without_drift(end.residuals, solver_spread(model, end))
    return float(np.mean(e**2)) - 1.0 < max(DISAGREEMENT["non-smooth"], drift.size) ** 2


def weighed(model: ResidualModel, end: Fit, base: Fit) -> Hypothesis:
    """A fit with its log weights; base: the fit without any effect."""
    segments = [len(experiment.output) for experiment in model.case.estimation]
    e, drift = end.residuals, NO_DRIFT
    if _near(end, base):
        e, drift = without_drift(e, solver_spread(model, end))
    return Hypothesis.of(end, discrepancy(e, segments, model.case.noise.size), drift)


def _part(report: Progress, begin: float, share: float) -> Progress:
    return lambda fraction, message: report(begin + share * fraction, message)


def _fitted(model: ResidualModel, base: Fit, trials: Sequence[_Trial], report: Progress) -> list[Hypothesis]:
    """Hypotheses with one effect more: rough fits of all, the best finished."""
    rough: list[tuple[Fit, Fit]] = []
    for k, trial in enumerate(trials):
        around, candidate = trial.around, trial.candidate
        report(0.6 * k / len(trials), f"fitting {candidate.effect}")
        ends = [
            fit(
                model,
                (*around.candidates, candidate),
                (*around.coordinates, start.coordinates),
                model.nominal.within(start.deviations),
                nominal_jacobian=around.jacobian[:, : around.deviations.size],
                iterations=_ROUGH_ITERATIONS,
                tolerance=0.5,
            )
            for start in _apart(trial.starts, around.cost, most=4 if candidate.dependence == "smooth" else 2)
        ]
        rough.append((min(ends, key=lambda end: end.cost), around))
    rough.sort(key=lambda pair: pair[0].cost)
    finished = []
    for k, (item, around) in enumerate(rough):
        report(0.6 + 0.4 * k / len(rough), f"finishing {item.names[-1]}")
        close = item.cost < rough[0][0].cost + _CLOSE
        # What is quick to finish is finished: among faint effects a few units of cost decide, and stated
        # values that a gap has pulled far off need more than rough steps to come back.
        quick = all(c.dependence == "smooth" for c in item.candidates)
        promising = close and (quick or item.cost < around.cost - _LEAST_GAIN)
        promising = promising or (quick and not around.candidates)
        # A backlash that only looks like something else takes as long as everything besides.
        costly = item.non_smooth and not _near(item, base)
        if (promising or k < (1 if around.candidates else 3)) and (k == 0 or not costly):
            fine = fit(model, item.candidates, item.coordinates, item.deviations, iterations=_FINE_ITERATIONS)
            item = _refined(model, fine if fine.cost <= item.cost else item, base)
        finished.append(weighed(model, item, base))
    return finished


def _refined(model: ResidualModel, end: Fit, base: Fit) -> Fit:
    """`refined` where backlash or the like may be the answer; beside much of a gap jumps do not matter."""
    return refined(model, end) if _near(end, base) else end


def _near(end: Fit, base: Fit) -> bool:
    return _beyond_noise(end) < max(_NEAR * _beyond_noise(base), _NEAR_FLOOR)


def _reduced(
    model: ResidualModel, base: Fit, found: Sequence[Hypothesis], listed: Sequence[Candidate]
) -> list[Hypothesis]:
    """The best sets of effects made simpler, fitted from where the set has ended.

    A set often finds its way where a member alone has stuck; what it found there is no merit of the further
    effect, so the simpler set is given the same start.
    """
    known: dict[tuple[str, ...], Fit] = {}
    for hypothesis in found:
        key = tuple(sorted(hypothesis.names))
        if key not in known or hypothesis.fit.cost < known[key].cost:
            known[key] = hypothesis.fit
    tried: list[Hypothesis] = []
    for hypothesis in sorted(found, key=lambda h: -h.log_weight)[:_SETS_TO_REDUCE]:
        whole = hypothesis.fit
        if not _near(whole, base):
            continue
        for rest, x in _simpler(whole, listed) if len(whole.candidates) > 1 else ():
            before = known.get(tuple(sorted(c.effect for c in rest)))
            start = cost_at(model, rest, x, whole.deviations)
            # From one contact sequence to the next the cost jumps: there a bad start says nothing.
            if before is not None and start > before.cost + _CLOSE and not non_smooth(rest):
                continue
            end = _refined(model, fit(model, rest, x, whole.deviations, iterations=_FINE_ITERATIONS), base)
            if before is None or end.cost < before.cost:
                tried.append(weighed(model, end, base))
    return tried


def _simpler(
    whole: Fit, listed: Sequence[Candidate]
) -> Iterator[tuple[tuple[Candidate, ...], tuple[Real, ...]]]:
    """Candidates and coordinates with one member left out, or with Coulomb friction for Stribeck's."""
    for k, (candidate, x) in enumerate(zip(whole.candidates, whole.coordinates, strict=True)):
        before, after = slice(None, k), slice(k + 1, None)
        others = whole.candidates[before] + whole.candidates[after]
        yield others, whole.coordinates[before] + whole.coordinates[after]
        simple = _without_extras(candidate.effect_at(x), listed)
        if simple is not None and simple[0].effect not in {c.effect for c in others}:
            yield (
                (*whole.candidates[before], simple[0], *whole.candidates[after]),
                (*whole.coordinates[before], simple[1], *whole.coordinates[after]),
            )


def _without_extras(effect: Any, listed: Sequence[Candidate]) -> tuple[Candidate, Real] | None:
    """The simpler effect that this one contains (Coulomb friction in Stribeck's), where it is looked for."""
    simple = effect.simpler() if isinstance(effect, Effect) else None
    for candidate in listed:
        if simple is not None and candidate.effect == simple.id:
            x = [axis.coordinate(getattr(simple, axis.parameter)) for axis in candidate.axes]
            return candidate, np.clip(x, *candidate.box)
    return None


def _apart(starts: list[Start], without: float, *, most: int) -> list[Start]:
    """The best start, and others that are elsewhere and not much worse."""
    best = starts[0]
    enough = best.cost + 0.5 * abs(without - best.cost) + 20
    chosen = [best]
    for start in starts[1:]:
        if len(chosen) == most or start.cost > enough:
            break
        if all(_distance(start.coordinates, other.coordinates) > 0.3 for other in chosen):
            chosen.append(start)
    return chosen


def _distance(a: Real, b: Real) -> float:
    return float(np.max(np.abs(a - b)))
