"""Search for the best controller of one order: starts, descent, interior point, exchange of frequencies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from control_design.angle_program import AngleProgram
from control_design.biquads import Cascade
from control_design.descent import Descended, MinimaxDescent, natural_units
from control_design.ellipses import Real
from control_design.problem import Problem
from control_design.starts import StartMaker
from control_design.synthesis_result import LARGEST_GAMMA, StartReport
from control_design.worst_case import KINDS

Told = Callable[[float, str], None]

_DRAWS = 200  # shaped loops drawn; each costs 2 ms
_EASIER, _FROM_AFAR = 4, 4  # with tracking: low-gain starts given to the interior point first, and in all
_SHAPED_TRACKING = 3
_STEPS = 80
_POLISHED = 3
_ITERATIONS = 120  # of the interior point from a descended start: where it works it needs 10 to 60
_HOPS = 3
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
        problem: Problem,
        cascade: Cascade,
        rng: np.random.Generator,
        tell: Told,
        given: Sequence[Real] = (),
    ) -> None:
        self.problem, self.cascade, self.rng, self.tell, self.given = problem, cascade, rng, tell, given
        self.options, self.spec = problem.options, problem.spec
        self.reports: list[StartReport] = []
        self._descent = self._new_descent()

    def run(self) -> OrderResult:
        """Starts, descent, interior point from the best, exchange with hops."""
        found = [self._checked(x, self._descent.value(x)) for x in self.given[:1]]
        if self._enough(found):
            return OrderResult(found[0], (), (found[0].gamma,))
        ends: list[Descended] = []
        starts = self._starts()
        for number, start in enumerate(starts):
            self.tell(0.4 * number / len(starts), f"start {number + 1} of {len(starts)}")
            ends += self._descended(start)
            if ends and ends[-1].gamma <= self.options.sufficient_gamma:
                found.append(self._checked(ends[-1].parameters, ends[-1].gamma))
                if self._enough(found[-1:]):
                    return OrderResult(found[-1], tuple(self.reports), (found[-1].gamma,))
            if number >= len(self.given) and self._agree(ends):
                break
        found += self._polished(self._best_of(ends, _POLISHED))
        found = sorted((c for c in found if np.isfinite(c.gamma)), key=lambda c: c.gamma)
        if not found:
            return OrderResult(None, tuple(self.reports), ())
        return self._exchange(found)

    def _agree(self, ends: Sequence[Descended]) -> bool:
        """Enough descents ended at the best value: more of them would hardly find another."""
        best = min((end.gamma for end in ends), default=np.inf)
        return sum(end.gamma <= best * _AGREE for end in ends) >= self.options.agreeing_starts

    def _enough(self, found: Sequence[Candidate]) -> bool:
        best = min((c.gamma for c in found), default=np.inf)
        return best <= self.options.sufficient_gamma

    def _best_of(self, ends: Sequence[Descended], most: int) -> list[Candidate]:
        """The best ends with different values, checked on the dense grid."""
        kept: list[Descended] = []
        for end in sorted(ends, key=lambda e: e.gamma):
            if all(abs(end.gamma / other.gamma - 1) > _AGREE - 1 for other in kept):
                kept.append(end)
            if len(kept) == most:
                break
        return [self._checked(end.parameters, end.gamma) for end in kept]

    def _new_descent(self) -> MinimaxDescent:
        return MinimaxDescent(
            self.cascade,
            self.problem.rows(),
            lambda x: self.problem.stable(self.cascade, x),
            controller_damping=self.spec.controller_damping,
        )

    def _starts(self) -> list[Real]:
        maker = StartMaker(
            self.cascade,
            self.problem.lean(),
            self.problem.integrators,
            self._descent.value,
            self.rng,
            controller_damping=self.spec.controller_damping,
            keeps_sign=self.problem.asks_tracking or self.problem.integrators > 0,
        )
        shaped = [parameters for parameters, _ in maker.shaped(_DRAWS, self.options.starts)]
        random = [maker.low_gain() for _ in range(self.options.starts)]
        if self.problem.asks_tracking:
            random = [*self._without_damping(random[:_EASIER]), *random[_EASIER:_FROM_AFAR]]
            shaped = shaped[:_SHAPED_TRACKING]
        mixed = [start for pair in zip_longest(shaped, random) for start in pair if start is not None]
        return [*self.given, *mixed]

    def _without_damping(self, starts: Sequence[Real]) -> list[Real]:
        """Interior point from low gain, without W4 of the measured output: it crosses steep tracking weights
        better than the descent, and W4 on thin ellipses is easier to reach from there."""
        program = AngleProgram(
            self.cascade,
            self.problem.rows(with_damping=False),
            controller_damping=self.spec.controller_damping,
            max_iterations=self.options.iterations,
        )
        solved = []
        for start in starts:
            gamma = self.problem.gamma(self.cascade, start, kinds=KINDS[:3])
            point = program.solve(self.problem.at(self.cascade, start, program.plants, gamma))
            self._report(point.status, point.iterations, 1.0 / point.g, None)
            if np.isfinite(self._descent.value(point.parameters)):
                solved.append(point.parameters)
        return solved

    def _checked(self, parameters: Real, gamma_grid: float) -> Candidate:
        return Candidate(parameters, gamma_grid, self.problem.gamma(self.cascade, parameters))

    def _descended(self, start: Real) -> list[Descended]:
        end = self._descent.run(start, _STEPS)
        self._report("descent", end.steps, end.gamma, None)
        return [end] if np.isfinite(end.gamma) else []

    def _report(self, status: str, steps: int, grid: float, dense: float | None) -> None:
        self.reports.append(
            StartReport(
                len(self.reports) + 1,
                status,
                steps,
                min(grid, LARGEST_GAMMA),
                dense if dense is not None and np.isfinite(dense) else None,
            )
        )

    def _polished(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """The candidates, each replaced by what the interior point makes of it where that gains."""
        if not candidates:
            return []
        program = AngleProgram(
            self.cascade,
            self.problem.rows(),
            controller_damping=self.spec.controller_damping,
            max_iterations=min(_ITERATIONS, self.options.iterations),
        )
        better: list[Candidate] = []
        for candidate in candidates:
            start = self.problem.at(self.cascade, candidate.parameters, program.plants, candidate.gamma_grid)
            point = program.solve(start)
            after = self._checked(point.parameters, 1.0 / point.g)
            self._report(point.status, point.iterations, 1.0 / point.g, after.gamma)
            better.append(after if after.gamma < candidate.gamma else candidate)
        return better

    def _exchange(self, found: list[Candidate]) -> OrderResult:
        """Add violated frequencies of the best candidates, improve them on the finer grid, and again.

        Several are carried along at first: the best on a coarse grid is often not the best on a finer one.
        In between, hops from the best look for a better valley.
        """
        history = [found[0].gamma]
        pool = different(found, _POLISHED)
        for number in range(self.options.exchange_rounds):
            self.tell(0.5 + 0.5 * number / self.options.exchange_rounds, f"exchange {number + 1}")
            if self._enough(pool):
                break
            added = sum(self.problem.add_violated(self.cascade, c.parameters, c.gamma_grid) for c in pool)
            if added == 0 and number > 0:
                break
            self._descent = self._new_descent()
            starts = [c.parameters for c in pool]
            ends = [end for start in starts for end in self._descended(start)]
            for _ in range(min(_HOPS, self.options.starts) if number == 0 else 1):
                ends += self._descended(self._hop(pool[0].parameters))
                if number == 0 and self._agree(ends):
                    break
            most = max(1, _POLISHED - 1 - number)
            fresh = self._polished(self._best_of(ends, most))
            pool = different([*pool, *fresh], most)
            history.append(pool[0].gamma)
            if number > 0 and history[-1] > history[-2] * (1 - self.options.exchange_tolerance):
                break
        return OrderResult(pool[0], tuple(self.reports), tuple(history))

    def _hop(self, parameters: Real) -> Real:
        """A stable neighbour: every parameter moved by up to a natural unit, less until it is stable."""
        size = 10 ** self.rng.uniform(-1.0, 0.0)
        direction = self.rng.standard_normal(parameters.size) * natural_units(self.cascade, parameters)
        for _ in range(8):
            if np.isfinite(self._descent.value(parameters + size * direction)):
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
