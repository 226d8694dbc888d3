"""Search for the best controller of one order: starts, descent, exchange of frequencies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from control_design.biquads import Cascade
from control_design.descent import MinimaxDescent, natural_units
from control_design.ellipses import Real
from control_design.search_tasks import StartEnd, StartTask, Workshop
from control_design.starts import StartMaker
from control_design.synthesis_result import LARGEST_GAMMA, StartReport
from control_design.work_pool import WorkPool

Told = Callable[[float, str], None]

_DRAWS = 200  # shaped loops drawn; each costs 1 ms
_EASED = 4  # with tracking: low-gain starts given to the interior point first
_SHAPED_TRACKING = 3
_STEPS = 100
_CARRIED = 3  # candidates carried through the exchange
_HOPS, _LATER_HOPS = 4, 2
_HALVINGS = 20  # natural units of a section far from the loop's crossover are far too large
_AGREE = 1.001


@dataclass(frozen=True, eq=False)
class Candidate:
    """A stable controller: parameters, worst case on the lean grid it came from, and on the dense grid."""

    parameters: Real
    gamma_grid: float
    gamma: float


@dataclass(frozen=True, eq=False)
class OrderResult:
    """Best candidate of one order (None: nothing stable), how the starts did, gamma after every round."""

    best: Candidate | None
    reports: tuple[StartReport, ...]
    history: tuple[float, ...]


class OrderSearch:
    """One cascade on one problem; `given` are parameter vectors that are good already, from a lower order."""

    def __init__(
        self,
        workshop: Workshop,
        pool: WorkPool,
        cascade: Cascade,
        rng: np.random.Generator,
        tell: Told,
        given: Sequence[Real] = (),
    ) -> None:
        self.workshop, self.pool, self.problem = workshop, pool, workshop.problem
        self.cascade, self.rng, self.tell, self.given = cascade, rng, tell, given
        self.options, self.spec = self.problem.options, self.problem.spec
        self.reports: list[StartReport] = []

    def run(self) -> OrderResult:
        """Starts, descent from each, exchange with hops."""
        found = [self._as_given(x) for x in self.given[:1]]
        if self._enough(found):
            return OrderResult(found[0], (), (found[0].gamma,))
        tasks = self._starts()
        drawn = len(tasks) - len(self.given)
        least = len(self.given) + max((drawn + 1) // 2, min(drawn, 3))
        for number, end in enumerate(self.pool.do(tasks)):
            self.tell(0.5 * (number + 1) / len(tasks), f"start {number + 1} of {len(tasks)}")
            found += self._taken(end)
            if self._enough(found):
                best = min(found, key=lambda c: c.gamma)
                return OrderResult(best, tuple(self.reports), (best.gamma,))
            if number + 1 >= least and self._agree(found):
                break  # not before half of the starts: the first ones are of one kind
        found = sorted((c for c in found if np.isfinite(c.gamma)), key=lambda c: c.gamma)
        if not found:
            return OrderResult(None, tuple(self.reports), ())
        return self._exchange(found)

    def _agree(self, found: Sequence[Candidate]) -> bool:
        """Enough descents ended at the best value: more of them would hardly find another."""
        best = min((c.gamma_grid for c in found), default=np.inf)
        return sum(c.gamma_grid <= best * _AGREE for c in found) >= self.options.agreeing_starts

    def _enough(self, found: Sequence[Candidate]) -> bool:
        best = min((c.gamma for c in found), default=np.inf)
        return best <= self.options.sufficient_gamma

    def _task(self, parameters: Real, *, eased: bool = False) -> StartTask:
        return StartTask(self.cascade, parameters, tuple(self.problem.grids), _STEPS, eased)

    def _taken(self, end: StartEnd) -> list[Candidate]:
        """A start's end as a candidate (none where it is unstable), reported."""
        last = len(end.stages) - 1
        for number, stage in enumerate(end.stages):
            dense = end.gamma_dense if number == last and np.isfinite(end.gamma_dense) else None
            at = len(self.reports) + 1
            gamma = min(stage.gamma, LARGEST_GAMMA)
            self.reports.append(StartReport(at, stage.status, stage.iterations, gamma, dense))
        if not np.isfinite(end.gamma):
            return []
        return [Candidate(end.parameters, end.gamma, end.gamma_dense)]

    def _as_given(self, parameters: Real) -> Candidate:
        return Candidate(
            parameters, self._descent().value(parameters), self.problem.gamma(self.cascade, parameters)
        )

    def _descent(self) -> MinimaxDescent:
        return self.workshop.descent(self.cascade, tuple(self.problem.grids))

    def _starts(self) -> list[StartTask]:
        maker = StartMaker(
            self.cascade,
            self.problem.lean(),
            self.problem.integrators,
            self._descent().value,
            self.rng,
            controller_damping=self.spec.controller_damping,
            keeps_sign=self.problem.asks_tracking or self.problem.integrators > 0,
        )
        tracking = self.problem.asks_tracking
        shaped = [self._task(x) for x, _ in maker.shaped(_DRAWS, self.options.starts)]
        random = [self._task(maker.low_gain(), eased=tracking) for _ in range(self.options.starts)]
        given = [self._task(x) for x in self.given]
        if tracking:
            # The interior point finds valleys the descent alone does not: its starts come first, so that no
            # agreement of the others ends the search before them.
            return [*given, *random[:_EASED], *shaped[:_SHAPED_TRACKING]]
        mixed = [start for pair in zip_longest(shaped, random) for start in pair if start is not None]
        return [*given, *mixed]

    def _exchange(self, found: list[Candidate]) -> OrderResult:
        """Add violated frequencies of the best candidates, improve them on the finer grid, and again.

        Several are carried along at first: the best on a coarse grid is often not the best on a finer one.
        In between, hops from the best look for a better valley.
        """
        history, tolerance = [found[0].gamma], self.options.exchange_tolerance
        pool, fresh = different(found, _CARRIED), list[Candidate]()
        for number in range(self.options.exchange_rounds):
            self.tell(0.5 + 0.5 * number / self.options.exchange_rounds, f"exchange {number + 1}")
            if self._enough(pool):
                break
            # Also of what lost: better on the grid and worse between its points, it may yet win.
            added = sum(
                self.problem.add_violated(self.cascade, c.parameters, c.gamma_grid)
                for c in different([*pool, *fresh], _CARRIED)
            )
            if added == 0 and number > 0:
                break
            starts = [c.parameters for c in pool]
            if fresh and min(c.gamma_grid for c in fresh) < pool[0].gamma * (1 - tolerance):
                starts.append(min(fresh, key=lambda c: c.gamma_grid).parameters)
            hops = min(_HOPS if number == 0 else _LATER_HOPS, self.options.starts)
            starts += [self._hop(pool[0].parameters) for _ in range(hops)]
            fresh = []
            for at, end in enumerate(self.pool.do([self._task(x) for x in starts])):
                fresh += self._taken(end)
                if number == 0 and at >= len(pool) and self._agree(fresh):
                    break
            fresh = [c for c in fresh if np.isfinite(c.gamma)]
            pool = different([*pool, *fresh], max(1, _CARRIED - 1 - number))
            history.append(pool[0].gamma)
            settled = min([c.gamma_grid for c in fresh], default=np.inf) > pool[0].gamma * (1 - tolerance)
            if number > 0 and settled and history[-1] > history[-2] * (1 - tolerance):
                break
        return OrderResult(pool[0], tuple(self.reports), tuple(history))

    def _hop(self, parameters: Real) -> Real:
        """A stable neighbour: every parameter moved by up to a natural unit, less until it is stable."""
        size = 10 ** self.rng.uniform(-1.0, 0.0)
        direction = self.rng.standard_normal(parameters.size) * natural_units(self.cascade, parameters)
        for _ in range(_HALVINGS):
            if np.isfinite(self._descent().value(parameters + size * direction)):
                break
            size *= 0.5
        return np.asarray(parameters + size * direction, dtype=np.float64)


def different(candidates: Sequence[Candidate], most: int) -> list[Candidate]:
    """Best candidates that differ in gamma by more than 0.1 %: the same optimum twice teaches nothing."""
    kept: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda c: c.gamma):
        if all(abs(candidate.gamma / other.gamma - 1) > _AGREE - 1 for other in kept):
            kept.append(candidate)
        if len(kept) == most:
            break
    return kept
