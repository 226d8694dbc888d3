"""Which effect: fits of every single one, then of further ones beside the best, until nothing is gained."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from diagnosis.evidence.hypotheses import BESIDE_NON_SMOOTH, DISAGREEMENT, Hypothesis
from diagnosis.fit.coordinates import effects_at, non_smooth
from diagnosis.fit.descent import Descent, descend, loss_at, refined
from diagnosis.fit.discrepancy import discrepancy
from diagnosis.fit.residual import ResidualModel
from diagnosis.fit.solver_spread import NO_DRIFT, solver_spread, without_drift
from diagnosis.fit.starts import Point, beside, point_at, points_of, superposed
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
_ROUGH_ITERATIONS, _FINE_ITERATIONS, _FINE_TOLERANCE = 8, 40, 0.02
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

    base: Descent
    hypotheses: tuple[Hypothesis, ...]
    simulations: int

    @property
    def best(self) -> Hypothesis:
        return self.hypotheses[0]


def search(case: CaseOfMachine, progress: Progress | None = None) -> Search:
    """Fit the nominal, every effect alone, and sets of effects as long as they gain."""
    report = progress or (lambda fraction, message: None)
    model = ResidualModel(case)
    base = fitted_to(model, (), np.zeros(0), np.zeros(model.nominal.count))
    N = base.left.size
    first: list[_Trial] = []
    listed: list[tuple[Candidate, list[Point]]] = []
    spaces = case.machine.candidates(case.experiments)
    for k, candidate in enumerate(spaces):
        report(0.05 + 0.3 * k / len(spaces), f"looking at {candidate.effect}")
        starts = points_of(model, base, candidate)
        alone = smallest_size(candidate, starts, SMALLEST_SIZE_RATIO) if starts else None
        beside = smallest_size(candidate, starts, SMALLEST_SIZE_BESIDE) if starts else None
        if alone is None or beside is None:
            continue
        if candidate.dependence == "non-smooth" and starts[0].cost - N < 0.5 * (base.cost - N):
            starts = zoomed(model, base, candidate, starts)
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
        further = _further(model, parents, listed, explained=_explained(found))
        found += _fitted(model, base, further, _part(report, 0.6 + 0.1 * count, 0.1))
        found += _reduced(model, base, found, [candidate for candidate, _ in listed])
    found.sort(key=lambda h: -h.log_weight)
    report(1.0, "done")
    return Search(base, tuple(found), model.simulations)


@dataclass(frozen=True, eq=False)
class _Trial:
    """One effect more than a fit holds."""

    around: Descent
    candidate: Candidate
    starts: list[Point]

    @property
    def effects(self) -> frozenset[str]:
        return frozenset((*self.around.names, self.candidate.effect))


def _explained(found: Sequence[Hypothesis]) -> bool:
    """Whether the best set leaves nothing over, by its own evidence against that of an unknown rest."""
    return max(h.log_weight for h in found) >= max(h.unknown_weight for h in found)


def _parents(found: Sequence[Hypothesis], count: int) -> list[Descent]:
    """Sets of so many effects to which one more is added, best first.

    The best one as soon as a set explains everything. Before, what is left over says little about which
    member of the true set has been found: of single effects the three that would leave the most probable
    unknown rest.
    """
    if _explained(found):
        best = max(found, key=lambda h: h.log_weight)
        return [best.fit] if len(best.names) == count else []
    parents: dict[frozenset[str], Descent] = {}
    for h in sorted(found, key=lambda h: -h.unknown_weight):
        if len(h.names) == count:
            parents.setdefault(frozenset(h.names), h.fit)
    return list(parents.values())[: _BEAM[count]]


def _further(
    model: ResidualModel,
    parents: Sequence[Descent],
    listed: Sequence[tuple[Candidate, list[Point]]],
    *,
    explained: bool,
) -> list[_Trial]:
    """The most promising effects beside the parents, every set and side of an effect once."""
    trials = []
    for parent in parents:
        for candidate, starts in listed:
            if candidate.effect not in parent.names:
                # Phases and amplitudes found without the parent are of no use beside it.
                anew = candidate.kind.harmonic is not None
                near = points_of(model, parent, candidate) if anew else superposed(model, parent, starts)
                trials.append(_Trial(parent, candidate, near))
    chosen: dict[tuple[frozenset[str], int], _Trial] = {}
    for trial in sorted(trials, key=lambda trial: trial.starts[0].cost):
        chosen.setdefault((trial.effects, trial.candidate.sign), trial)
    promising = list(chosen.values())[: _BESIDE + 2 * (len(parents) - 1)]
    if explained:
        # Nothing is left over; what linear estimates do not even promise is not fitted.
        promising = [t for t in promising if t.around.cost - t.starts[0].cost > _least_promise(t.around)]
    pulled = [p for parent in parents for p in _pulled(model, parent, [candidate for candidate, _ in listed])]
    return [_simulated(model, trial) for trial in promising] + pulled


def _least_promise(parent: Descent) -> float:
    """Beside backlash a further effect has to gain more (in log weight; half of that in linear estimates)."""
    return _PROMISE + (BESIDE_NON_SMOOTH if parent.non_smooth else 0.0)


def _pulled(model: ResidualModel, parent: Descent, listed: Sequence[Candidate]) -> list[_Trial]:
    """Effects that multiply a nominal parameter, in place of that value pulled beyond belief."""
    trials = []
    factors = model.nominal.factors(parent.deviations)
    for k, key in enumerate(model.nominal.keys):
        found = in_place_of(key, factors[key], listed) if abs(parent.deviations[k]) > _BEYOND_BELIEF else None
        if found is None or found[0].effect in parent.names:
            continue
        d = parent.deviations.copy()
        d[k] = 0.0
        trials.append(_Trial(parent, found[0], [Point(parent.loss, found[1], d, model.start)]))
    return trials


def in_place_of(key: str, factor: float, listed: Sequence[Candidate]) -> tuple[Candidate, Real] | None:
    """The effect that multiplies a nominal parameter by this factor, or by the nearest one worth a name."""
    sign = 1 if factor > 1 else -1
    for candidate in listed:
        if candidate.kind.multiplies == key and candidate.sign == sign:
            return candidate, np.clip([candidate.axes[0].coordinate(factor)], *candidate.box)
    return None


def _simulated(model: ResidualModel, trial: _Trial) -> _Trial:
    """The trial with its best starts judged by simulation."""
    if trial.candidate.kind.harmonic:
        return trial
    best = trial.starts[: _NON_SMOOTH_TO_SIMULATE if non_smooth([trial.candidate]) else _STARTS_TO_SIMULATE]
    starts = beside(model, trial.around, trial.candidate, best)
    return replace(trial, starts=starts) if starts else trial


def _beyond_noise(end: Descent) -> float:
    return max(end.rms**2 - 1.0, 0.0)


def _as_solvers_differ(model: ResidualModel, end: Descent) -> bool:
    """Whether backlash is in the set and what is left is no more than correct solvers of it may differ by."""
    if not end.non_smooth:
        return False
    e, drift = without_drift(end.left, solver_spread(model, end))
    return float(np.mean(e**2)) - 1.0 < max(DISAGREEMENT["non-smooth"], drift.size) ** 2


def weighed(model: ResidualModel, end: Descent, base: Descent) -> Hypothesis:
    """A fit with its log weights; base: the fit without any effect."""
    segments = [len(experiment.output) for experiment in model.case.estimation]
    e, drift = end.left, NO_DRIFT
    if _near(end, base):
        e, drift = without_drift(e, solver_spread(model, end))
    left = discrepancy(e, segments, model.case.noise.size)
    return Hypothesis.of(end, left, drift, model.case.machine.weighing.listed)


def _part(report: Progress, begin: float, share: float) -> Progress:
    return lambda fraction, message: report(begin + share * fraction, message)


def _fitted(
    model: ResidualModel, base: Descent, trials: Sequence[_Trial], report: Progress
) -> list[Hypothesis]:
    """Hypotheses with one effect more: rough fits of all, the best finished."""
    rough: list[tuple[Descent, Descent]] = []
    for k, trial in enumerate(trials):
        around, candidate = trial.around, trial.candidate
        report(0.6 * k / len(trials), f"fitting {candidate.effect}")
        ends = [
            descend(
                model,
                (*around.candidates, candidate),
                model.nominal.within(start.deviations),
                np.concatenate([around.coordinates, start.coordinates]),
                model.start,
                nominal_jacobian=around.jacobian[:, : around.deviations.size],
                iterations=_ROUGH_ITERATIONS,
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
            fine = fitted_to(model, item.candidates, item.coordinates, item.deviations)
            item = _refined(model, fine if fine.cost <= item.cost else item, base)
        finished.append(weighed(model, item, base))
    return finished


def fitted_to(
    model: ResidualModel, candidates: Sequence[Candidate], coordinates: Real, deviations: Real
) -> Descent:
    """To its end."""
    return descend(
        model,
        candidates,
        deviations,
        coordinates,
        model.start,
        iterations=_FINE_ITERATIONS,
        tolerance=_FINE_TOLERANCE,
    )


def zoomed(model: ResidualModel, around: Descent, candidate: Candidate, starts: list[Point]) -> list[Point]:
    """Two finer grids around the best points of a non-smooth cost, one size coordinate; best first."""
    found = list(starts)
    for points, reach in ((24, 0.25), (16, 0.02)):
        centre = min(found, key=lambda start: start.loss).coordinates
        for shift in np.linspace(-reach, reach, points):
            x = np.clip(centre + np.concatenate([[shift], np.zeros(centre.size - 1)]), *candidate.box)
            start = point_at(model, around, candidate, x, model.start)
            if start is not None:
                found.append(start)
    return sorted(found, key=lambda start: start.loss)


def _refined(model: ResidualModel, end: Descent, base: Descent) -> Descent:
    """`refined` where backlash or the like may be the answer; beside much of a gap jumps do not matter."""
    return refined(model, end) if _near(end, base) else end


def _near(end: Descent, base: Descent) -> bool:
    return _beyond_noise(end) < max(_NEAR * _beyond_noise(base), _NEAR_FLOOR)


def _reduced(
    model: ResidualModel, base: Descent, found: Sequence[Hypothesis], listed: Sequence[Candidate]
) -> list[Hypothesis]:
    """The best sets of effects made simpler, fitted from where the set has ended.

    A set often finds its way where a member alone has stuck; what it found there is no merit of the further
    effect, so the simpler set is given the same start.
    """
    known: dict[tuple[str, ...], Descent] = {}
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
            e = model.of(whole.deviations, effects_at(rest, x))
            start = 2 * loss_at(model, e, whole.deviations, model.start)[0]
            # From one contact sequence to the next the cost jumps: there a bad start says nothing.
            if before is not None and start > before.cost + _CLOSE and not non_smooth(rest):
                continue
            end = _refined(model, fitted_to(model, rest, x, whole.deviations), base)
            if before is None or end.cost < before.cost:
                tried.append(weighed(model, end, base))
    return tried


def _simpler(whole: Descent, listed: Sequence[Candidate]) -> Iterator[tuple[tuple[Candidate, ...], Real]]:
    """Candidates and coordinates with one member left out, or with Coulomb friction for Stribeck's."""
    for k, candidate in enumerate(whole.candidates):
        before, after = slice(None, k), slice(k + 1, None)
        others, x = whole.candidates[before] + whole.candidates[after], whole.coordinates_of(k)
        first = sum(len(c.axes) for c in whole.candidates[before])
        begin, end = whole.coordinates[:first], whole.coordinates[first + x.size :]
        yield others, np.concatenate([begin, end])
        simple = _without_extras(candidate.effect_at(x), listed)
        if simple is not None and simple[0].effect not in {c.effect for c in others}:
            yield (
                (*whole.candidates[before], simple[0], *whole.candidates[after]),
                np.concatenate([begin, simple[1], end]),
            )


def _without_extras(effect: Any, listed: Sequence[Candidate]) -> tuple[Candidate, Real] | None:
    """The simpler effect that this one contains (Coulomb friction in Stribeck's), where it is looked for."""
    simple = effect.simpler() if isinstance(effect, Effect) else None
    for candidate in listed:
        if simple is not None and candidate.effect == simple.id:
            x = [axis.coordinate(getattr(simple, axis.parameter)) for axis in candidate.axes]
            return candidate, np.clip(x, *candidate.box)
    return None


def _apart(starts: list[Point], without: float, *, most: int) -> list[Point]:
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


def smallest_size(candidate: Candidate, starts: list[Point], ratio: float) -> float | None:
    """Coordinate of the size at which the effect changes the model by `ratio` noise deviations.

    From the grid: interpolated between points in log-log, extrapolated in proportion; over several points of
    equal size the largest change counts. None if the grid never changes anything.
    """
    sizes: dict[float, float] = {}
    for start in starts:
        key = float(start.coordinates[0])
        sizes[key] = max(sizes.get(key, 0.0), start.size)
    x = np.array(sorted(sizes))
    change = np.array([sizes[v] for v in x])
    if not np.any(change > 0):
        return None
    change = np.log(np.maximum(change, 1e-9))
    if not candidate.grows:
        x, change = -x[::-1], change[::-1]
    change = np.maximum.accumulate(change)
    target = np.log(ratio)
    if target <= change[0]:
        found = x[0] + (target - change[0])
    elif target >= change[-1]:
        found = x[-1] + (target - change[-1])
    else:
        i = int(np.searchsorted(change, target))
        share = (target - change[i - 1]) / (change[i] - change[i - 1])
        found = x[i - 1] + share * (x[i] - x[i - 1])
    return float(found if candidate.grows else -found)
