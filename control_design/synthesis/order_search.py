"""Search for the best controller of one order: starts, descent, exchange of frequencies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from operator import attrgetter

import numpy as np

from control_design.controllers.biquads import Cascade
from control_design.convex.minimax import EXCHANGE_TOLERANCE
from control_design.plants.ellipses import Real
from control_design.synthesis.descent import MinimaxDescent, natural_units
from control_design.synthesis.problem import Problem
from control_design.synthesis.starts import StartMaker, with_gain
from control_design.synthesis.synthesis_result import LARGEST_GAMMA, StartReport
from control_design.synthesis.youla_starts import FreeControllers, fitted

Progress = Callable[[float, str], None]

_STEPS = 100  # of the descent
_DRAWS = 200  # shaped loops drawn; each costs 1 ms
_LOW_GAIN = 4  # with tracking: starts of little gain
_CARRIED = 3  # candidates carried through the exchange, and shaped loops that are started from
_HOPS, _LATER_HOPS = 4, 2  # starts beside the best end, in the first round and in later ones
_HALVINGS = 20  # natural units of a section far from the loop's crossover are far too large
_RETRIEVALS = 3  # rounds for ends that are good on the grid and not robustly stable between its points
_RETREAT, _RETREATS = 0.8, 20  # factor on their gain, and how often, until they are stable on the finer grid
_FINISHING = 10  # rounds for the best alone, until dense check and grid agree
_AGREE = 1.001  # gammas that differ by less than a thousandth are of one optimum
_NO_RESONANCE = 0.3  # damping that fits begin with: a narrow one of their own hides between grid points
_WEIGHTED = 3  # rounds of fits with random weights
# Steps that every fit gets before the best of a round goes on alone. Read off the paths of random designs 0
# to 21: after ten it mostly, not always, leads to the best end of its round; after five less often.
_TRIAL = 10
_ROUGH_DRAWS = 50  # shaped loops drawn where ten steps choose between them
# Of the worst case that the small Youla problem reaches, and how far that lies above the default one's at
# most: a design below both shows that it has ended in a valley, and is no bound.
_NEAR, _FAIR, _FINER = 1.03, 1.05, 1.1


@dataclass(frozen=True, eq=False)
class TriedController:
    """Where a start ended: parameters, worst case on the lean grid it came from and on the dense grid (inf:
    unstable, or not checked)."""

    parameters: Real
    gamma_grid: float
    gamma: float


@dataclass(frozen=True, eq=False)
class OrderResult:
    """Best candidate of one order (None: nothing stable), how the starts did, gamma after every round.

    nearest: without a best, the parameters of the end that came nearest to a robustly stable loop.
    """

    best: TriedController | None
    reports: tuple[StartReport, ...]
    history: tuple[float, ...]
    nearest: Real | None = None


class OrderSearch:
    """One cascade on one problem; `given` are parameter vectors that are good already, from a lower order."""

    def __init__(
        self,
        problem: Problem,
        cascade: Cascade,
        rng: np.random.Generator,
        tell: Progress,
        given: Sequence[Real] = (),
    ) -> None:
        self.problem, self.cascade, self.rng, self.tell, self.given = problem, cascade, rng, tell, given
        self.options, self.spec = problem.options, problem.spec
        self.reports: list[StartReport] = []
        self._known: tuple[list[Real], MinimaxDescent] | None = None

    def run(self) -> OrderResult:
        """Starts, descent from each, exchange with hops."""
        found = [
            TriedController(x, self._descent().value(x), self.problem.gamma(self.cascade, x))
            for x in self.given[:1]
        ]
        if self._enough(found):
            return OrderResult(found[0], (), (found[0].gamma,))
        starts = self._starts()
        drawn = len(starts) - len(self.given)
        least = len(self.given) + max((drawn + 1) // 2, min(drawn, 3))
        ends: list[TriedController] = []
        for number, end in enumerate(map(self._end, starts)):
            self.tell(0.5 * (number + 1) / len(starts), f"start {number + 1} of {len(starts)}")
            ends.append(end)
            found.append(end)
            if self._enough(found):
                best = min(found, key=lambda c: c.gamma)
                return OrderResult(best, tuple(self.reports), (best.gamma,))
            if number + 1 >= least and self._agree(found):
                break  # not before half of the starts: the first ones are of one kind
        found = self._retrieved(found)
        if not found:
            return OrderResult(None, tuple(self.reports), (), self._nearest(ends))
        return self._exchange(found)

    def quick(self, free: FreeControllers) -> tuple[OrderResult, bool]:
        """From controllers of the Youla bound: the result, and whether the search may end with it.

        One fit of each, then fits with random weights, then shaped and random loops, each round a race: see
        `_raced`. It may end where the result lies within `_NEAR` of what the controllers of any order reach,
        or where as many ends as asked agree on it and it meets the specification. A design that misses the
        specification gets all fits, as another valley may meet it. Agreement before the last starts
        counts within `_FAIR` only.
        """
        found: list[TriedController] = []

        def near(gamma: float) -> bool:
            return free.gamma / _FINER <= gamma <= _NEAR * free.gamma < np.inf

        def agreed(gamma: float, fair: float = np.inf) -> bool:
            return gamma <= min(1.0, fair * free.gamma) and self._agree(found)

        turn = 0
        while turn < _WEIGHTED + 2:
            least = min((c.gamma_grid for c in found), default=np.inf)
            last = least <= 1.0 or turn > _WEIGHTED
            if self._enough(found) or agreed(least, _FAIR) or (last and near(least)):
                break
            self.tell(0.1 * turn, f"start {turn + 1} of {_WEIGHTED + 2}, from controllers of any order")
            starts = self._fits(free, turn) if turn <= _WEIGHTED else self._others()
            found, turn = found + self._raced(starts), turn + 1
        ends = self._retrieved(self._checked(found))
        if not ends:
            return OrderResult(None, tuple(self.reports), (), self._nearest(found) if found else None), False
        result = self._exchange(ends, hops=False)
        assert result.best is not None
        gamma = result.best.gamma
        return result, self._enough([result.best]) or near(gamma) or agreed(gamma)

    def fits_only(self, free: FreeControllers) -> OrderResult:
        """From one fit of each controller of any order, and what is given of a lower order: a race."""
        ends = self._retrieved(self._checked(self._raced([*self.given, *self._fits(free, 0)])))
        return self._exchange(ends, hops=False) if ends else OrderResult(None, tuple(self.reports), ())

    def _raced(self, starts: Sequence[Real]) -> list[TriedController]:
        """Where `_TRIAL` steps lead from each start, the best first and from there to its end; not checked
        between the points of the grid unless it may be enough."""
        tried = sorted((self._end(x, _TRIAL, checked=False) for x in starts), key=lambda c: c.gamma_grid)
        if tried and np.isfinite(tried[0].gamma_grid):
            tried[0] = self._end(tried[0].parameters, checked=False)
            if tried[0].gamma_grid <= self.options.sufficient_gamma:
                tried[:1] = self._checked(tried[:1])
        return tried

    def _checked(self, found: Sequence[TriedController]) -> list[TriedController]:
        """Those of different optima, best first, with their worst cases on the dense grid, until as many as
        are carried are stable there."""
        checked: list[TriedController] = []
        for c in different(found, len(found), on_grid=True):
            if np.isfinite(c.gamma_grid):
                checked.append(replace(c, gamma=self.problem.gamma(self.cascade, c.parameters)))
            if sum(np.isfinite(c.gamma) for c in checked) == _CARRIED:
                break
        return checked

    def _fits(self, free: FreeControllers, turn: int) -> list[Real]:
        """Stable fits of the controllers of any order; from the second turn on with random weights."""
        damping = max(1.01 * (self.spec.controller_damping or 0.0), _NO_RESONANCE)
        rng = self.rng if turn else None
        fits = [fitted(self.cascade, each, least_damping=damping, rng=rng) for each in free.each]
        value = self._descent().value
        stable = [x if np.isfinite(value(x)) else self._retreat(x) for x in fits if x is not None]
        return [x for x in stable if x is not None]

    def _others(self) -> list[Real]:
        """Shaped loops and random ones of little gain."""
        if any(plant.unstable_poles for plant in self.problem.plants):
            return []
        maker = self._maker()
        shaped = [x for x, _ in maker.shaped(_ROUGH_DRAWS, _CARRIED)]
        return shaped + [maker.low_gain() for _ in range(min(self.options.starts, _CARRIED))]

    def _nearest(self, ends: Sequence[TriedController]) -> Real:
        """Parameters that are stable on the grid, the smallest worst case first; else nearest to the
        circle."""
        key = [(c.gamma_grid, self._radius(c.parameters)) for c in ends]
        return ends[min(range(len(ends)), key=lambda at: key[at])].parameters

    def _radius(self, parameters: Real) -> float:
        """Largest pole modulus of the nominal loops."""
        poles = self.problem.closed_loop_poles(self.cascade, parameters)
        return max(float(np.max(np.abs(z), initial=0.0)) for z in poles)

    def _retrieved(self, found: Sequence[TriedController]) -> list[TriedController]:
        """What is stable on the dense grid, best first, enlarged by what can be saved of the rest.

        An end that is better on the grid than the best, and reaches -1 between its points, has found a valley
        worth having: with its violated frequencies on the grid it goes on, with less gain at first.
        """
        kept = [c for c in found if np.isfinite(c.gamma)]
        lost = [c for c in found if np.isfinite(c.gamma_grid) and not np.isfinite(c.gamma)]
        for _ in range(_RETRIEVALS):
            limit = min((c.gamma for c in kept), default=np.inf) * (1 - EXCHANGE_TOLERANCE)
            lost = different([c for c in lost if c.gamma_grid < limit], _CARRIED, on_grid=True)
            if not lost or self._enough(kept):
                break
            for c in lost:
                self.problem.add_violated(self.cascade, c.parameters, c.gamma_grid)
            retreats = [self._retreat(c.parameters) for c in lost]
            lost = [self._end(x) for x in retreats if x is not None]
            kept += [c for c in lost if np.isfinite(c.gamma)]
            lost = [c for c in lost if np.isfinite(c.gamma_grid) and not np.isfinite(c.gamma)]
        return sorted(kept, key=lambda c: c.gamma)

    def _retreat(self, parameters: Real) -> Real | None:
        """The same with less gain, until it is stable on the grids as they are now; None if it never is."""
        for number in range(1, _RETREATS + 1):
            trial = with_gain(self.cascade, parameters, _RETREAT**number)
            if np.isfinite(self._descent().value(trial)):
                return trial
        return None

    def _agree(self, found: Sequence[TriedController]) -> bool:
        """Enough descents ended at the best value: more of them would hardly find another."""
        stable = [c.gamma_grid for c in found if np.isfinite(c.gamma_grid)]
        return sum(g <= min(stable) * _AGREE for g in stable) >= self.options.agreeing_starts

    def _enough(self, found: Sequence[TriedController]) -> bool:
        return min((c.gamma for c in found), default=np.inf) <= self.options.sufficient_gamma

    def _end(self, start: Real, steps: int = _STEPS, *, checked: bool = True) -> TriedController:
        """Where the descent from a start ends; checked: on the dense grid, too. What was run is noted."""
        x, gamma, taken = self._descent().run(start, steps)
        dense = self.problem.gamma(self.cascade, x) if checked and np.isfinite(gamma) else np.inf
        seen = min(gamma, LARGEST_GAMMA), dense if np.isfinite(dense) else None
        self.reports.append(StartReport("descent", taken, *seen))
        return TriedController(x, gamma, dense)

    def _descent(self) -> MinimaxDescent:
        """On the lean grids as they are now; kept until they change."""
        problem, cascade, grids = self.problem, self.cascade, list(self.problem.grids)
        if self._known is None or not all(map(np.array_equal, self._known[0], grids)):
            damping = self.spec.controller_damping
            descent = MinimaxDescent(
                cascade, problem.rows(grids), partial(problem.stable, cascade), controller_damping=damping
            )
            self._known = grids, descent
        return self._known[1]

    def _maker(self) -> StartMaker:
        return StartMaker(
            self.cascade,
            self.problem.lean(),
            self.problem.integrators,
            self._descent().value,
            self.rng,
            controller_damping=self.spec.controller_damping,
            keeps_sign=self.problem.asks_tracking or self.problem.integrators > 0,
        )

    def _starts(self) -> list[Real]:
        maker = self._maker()
        if any(plant.unstable_poles for plant in self.problem.plants):
            return [*self.given, *maker.stabilising(self._radius, max(self.options.starts, _CARRIED))]
        shaped = [x for x, _ in maker.shaped(_DRAWS, self.options.starts)]
        random = [maker.low_gain() for _ in range(self.options.starts)]
        if self.problem.asks_tracking:
            return [*self.given, *random[:_LOW_GAIN], *shaped[:_CARRIED]]
        mixed = (start for pair in zip_longest(shaped, random) for start in pair if start is not None)
        return [*self.given, *mixed]

    def _exchange(self, found: list[TriedController], *, hops: bool = True) -> OrderResult:
        """Add violated frequencies of the best candidates, improve them on the finer grid, and again.

        Several are carried along at first: the best on a coarse grid is often not the best on a finer one.
        In between, hops from the best look for a better valley.
        """
        history, tolerance = [found[0].gamma], EXCHANGE_TOLERANCE
        pool, fresh = different(found, _CARRIED), list[TriedController]()
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
            count = min(_HOPS if number == 0 else _LATER_HOPS, self.options.starts) if hops else 0
            starts += [self._hop(pool[0].parameters) for _ in range(count)]
            fresh = []
            for at, end in enumerate(map(self._end, starts)):
                fresh.append(end)
                if number == 0 and at >= len(pool) and self._agree(fresh):
                    break
            fresh = [c for c in self._retrieved([pool[0], *fresh]) if c is not pool[0]]
            pool = different([*pool, *fresh], max(1, _CARRIED - 1 - number))
            # More frequencies raise an optimum: what lies above the best already stays there.
            pool = pool[:1] + [c for c in pool[1:] if c.gamma_grid <= pool[0].gamma]
            history.append(pool[0].gamma)
            settled = min([c.gamma_grid for c in fresh], default=np.inf) > pool[0].gamma * (1 - tolerance)
            if number > 0 and settled and history[-1] > history[-2] * (1 - tolerance):
                break
        best = self._finished(pool[0])
        if best.gamma < history[-1]:
            history.append(best.gamma)
        return OrderResult(best, tuple(self.reports), tuple(history))

    def _finished(self, best: TriedController) -> TriedController:
        """The best alone, violated frequencies added and improved until dense check and grid agree."""
        current = best
        for _ in range(_FINISHING):
            agreed = current.gamma <= current.gamma_grid * (1 + EXCHANGE_TOLERANCE)
            if agreed or self._enough([best]):
                break
            self.problem.add_violated(self.cascade, current.parameters, current.gamma_grid)
            current = self._end(current.parameters)
            if not np.isfinite(current.gamma):
                break
            best = min(best, current, key=lambda c: c.gamma)
        return best

    def _hop(self, parameters: Real) -> Real:
        """A stable neighbour: every parameter moved by up to a natural unit, less until it is stable."""
        size = 10 ** self.rng.uniform(-1.0, 0.0)
        direction = self.rng.standard_normal(parameters.size) * natural_units(self.cascade, parameters)
        for _ in range(_HALVINGS):
            if np.isfinite(self._descent().value(parameters + size * direction)):
                break
            size *= 0.5
        return np.asarray(parameters + size * direction, dtype=np.float64)


def different(
    candidates: Sequence[TriedController], most: int, *, on_grid: bool = False
) -> list[TriedController]:
    """Best candidates that differ in gamma (on_grid: of their lean grid) by more than 0.1 %: the same optimum
    twice teaches nothing."""

    gamma = attrgetter("gamma_grid" if on_grid else "gamma")
    kept: list[TriedController] = []
    for candidate in sorted(candidates, key=gamma):
        if all(abs(gamma(candidate) / gamma(other) - 1) > _AGREE - 1 for other in kept):
            kept.append(candidate)
        if len(kept) == most:
            break
    return kept
