"""Global search for the poles: DIRECT on log J, descents from the best points, block rescans (design 4.3)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from itertools import combinations_with_replacement, cycle, islice

import numpy as np

from ident.arrays import RealArray
from ident.candidate_cost import CandidateCost
from ident.coordinates import SearchSpace, search_space
from ident.direct import best_apart, minimise
from ident.options import IdentOptions
from ident.poles import Poles
from ident.polish import Bounds, Polished, polish
from ident.regression import Regression
from ident.search_trace import PolishedMinimum, SearchStage

# A rescan has to gain this fraction of J to count.
_GAIN = 1e-6
# Rescans of every block at most.
_ROUNDS = 6
# Descents that only compare starts stop when this fraction of J is left to gain; the winner goes on to the
# end.
_ROUGH = 1e-3
# So many starts that end in one place make a rescan superfluous.
_STARTS_TO_AGREE = 3
# Cost evaluations for one more pair when the rest is frozen: two unknowns.
_PAIR_EVALUATIONS = 240
_REAL_GRID = 9
_PAIR_GRID = (60, 3)
# Ends of rough descents are one optimum if they differ in J by no more than what such descents leave, in a
# pole by no more than this fraction; of rates below the box's slowest nothing is told anyway.
_SAME_COST = 3 * _ROUGH
_SAME_POLE = 0.1


class PoleSearch:
    """The search on one regression problem; collects the trace on the way.

    The fixed poles come first among the poles of each type and are never moved.
    """

    def __init__(self, data: Regression, options: IdentOptions) -> None:
        self.data = data
        self.options = options
        self.fixed = options.fixed()
        self.bounds = Bounds.from_options(options, data.longest, data.dt_s)
        self.stages: list[SearchStage] = []
        self.minima: list[PolishedMinimum] = []
        self.evaluations = 0
        self._agreed: Polished | None = None

    def space(self, n_real: int, n_pairs: int) -> SearchSpace:
        return search_space(n_real, n_pairs, self.data.longest, self.data.dt_s, self.options)

    def candidate_cost(self, space: SearchSpace, shared: Poles, local: Poles) -> CandidateCost:
        """The cost that global searches and rescans look at (`ident.miso_search` has another)."""
        return CandidateCost(self.data, space, shared, local)

    def joint(self, n_real: int, n_pairs: int) -> Polished:
        """Best poles of a joint global search over n_real real poles and n_pairs pairs."""
        title = f"{n_real} real, {n_pairs} pairs"
        if n_real + n_pairs == 0:
            return self.descend(self.fixed, title)
        space = self.space(n_real, n_pairs)
        cost = self.candidate_cost(space, self.fixed, self.fixed)
        points = self._global(title, cost, self.options.evaluations)
        starts = [self.fixed.appended(space.poles(point)) for point in points]
        known = len(self.minima)
        best = self._best_descent(starts, title)
        ends = self.minima[known : known + len(starts)]
        if len(ends) >= _STARTS_TO_AGREE and all(self._is_same(end, best) for end in ends):
            self._agreed = best
        return best

    def _is_same(self, end: PolishedMinimum, best: Polished) -> bool:
        """Whether a rough descent was on its way to `best`."""
        slack = 0.2 / max(self.data.longest, 30)

        def apart(ours: RealArray, theirs: RealArray) -> bool:
            return bool(
                np.any(np.abs(np.sort(ours) - np.sort(theirs)) > _SAME_POLE * np.sort(theirs) + slack)
            )

        pairs, best_pairs = np.log(end.poles.pairs), np.log(best.poles.pairs)
        return (
            end.rss <= best.rss * (1 + _SAME_COST)
            and not apart(1 - end.poles.real, 1 - best.poles.real)
            and not apart(np.abs(pairs), np.abs(best_pairs))
            and not apart(-pairs.real, -best_pairs.real)
        )

    def add_pair(self, poles: Poles) -> Polished:
        """Best descent from the given poles and one more pair, sought on what their tangent space leaves."""
        title = f"pair {poles.pairs.size - self.fixed.pairs.size + 1}"
        space = self.space(0, 1)
        cost = self.candidate_cost(space, poles.doubled(), poles)
        points = self._global(title, cost, min(_PAIR_EVALUATIONS, self.options.evaluations))
        return self._best_descent([poles.appended(space.poles(point)) for point in points], title)

    def add_real(self, poles: Poles) -> Polished:
        """Best descent from the given poles and one more real pole."""
        space = self.space(1, 0)
        cost = self.candidate_cost(space, poles.doubled(), poles)
        grid = np.linspace(0, 1, 2 * _REAL_GRID)[:, np.newaxis]
        points = best_apart(grid, cost.rss(grid), 2)
        self.evaluations += cost.evaluations
        return self._best_descent(
            [poles.appended(space.poles(point)) for point in points], "one more real pole"
        )

    def rescan(self, best: Polished) -> Polished:
        """Look at each block on a grid with the rest frozen, descend from what is found, until a whole round
        gains nothing.

        Not if `best` is where every start of the joint search ended: points of the cube far from each other,
        each the best of its surroundings. Over 250 searches where they agree no rescan gained anything.
        """
        if best is self._agreed:
            return best
        n_fixed_real, n_fixed_pairs = self.fixed.real.size, self.fixed.pairs.size
        n_real, n_pairs = best.poles.real.size, best.poles.pairs.size
        # Up to two real poles are looked at together: one alone can be held by the other.
        couples = [slice(i, min(i + 2, n_real)) for i in range(n_fixed_real, n_real, 2)]
        singles = [slice(i, i + 1) for i in range(n_fixed_pairs, n_pairs)]
        scans = [partial(self._rescan_real, here=here) for here in couples]
        scans += [partial(self._rescan_pair, here=here) for here in singles]
        quiet = 0
        for scan in islice(cycle(scans), _ROUNDS * len(scans)):
            found = scan(best)
            quiet = 1 if found.rss < best.rss * (1 - _GAIN) else quiet + 1
            best = found
            if quiet == len(scans):
                break
        return best

    def _rescan_real(self, best: Polished, here: slice) -> Polished:
        count = here.stop - here.start
        kept = Poles(np.delete(best.poles.real, here), best.poles.pairs)
        space = self.space(count, 0)
        cost = self.candidate_cost(space, kept, kept)
        here_now = np.sort(space.levels(Poles(best.poles.real[here])))

        def looks(point: RealArray) -> tuple[Poles, bool]:
            new = space.poles(point)
            known = np.abs(np.sort(space.levels(new)) - here_now) <= 1 / (_REAL_GRID - 1)
            real = best.poles.real.copy()
            real[here] = new.real
            return Poles(real, best.poles.pairs), bool(np.all(known))

        return self._descend_from_grid(best, _real_grid(count), cost, looks, n_starts=2)

    def _rescan_pair(self, best: Polished, here: slice) -> Polished:
        kept = Poles(best.poles.real, np.delete(best.poles.pairs, here))
        space = self.space(0, 1)
        cost = self.candidate_cost(space, kept, kept)
        here_now = space.levels(Poles(pairs=best.poles.pairs[here]))

        def looks(point: RealArray) -> tuple[Poles, bool]:
            new = space.poles(point)
            known = np.abs(space.levels(new) - here_now) <= 1 / (_PAIR_GRID[0] - 1)
            pairs = best.poles.pairs.copy()
            pairs[here] = new.pairs
            return Poles(best.poles.real, pairs), bool(np.all(known))

        return self._descend_from_grid(best, _pair_grid(), cost, looks, n_starts=1)

    def _descend_from_grid(
        self,
        best: Polished,
        grid: RealArray,
        cost: CandidateCost,
        looks: Callable[[RealArray], tuple[Poles, bool]],
        n_starts: int,
    ) -> Polished:
        """Descents from the best points of the grid; `looks` gives the poles of a point, and whether it is
        next to where the block already is: from there a descent would come back."""
        costs = cost.rss(grid)
        self.evaluations += cost.evaluations
        found = best
        for point in best_apart(grid, costs, n_starts):
            start, known = looks(point)
            if known:
                continue
            trial = self.descend(start, "rescan", _ROUGH)
            if trial.rss < found.rss * (1 - _GAIN):
                found = self.descend(trial.poles, "rescan")
        return found

    def descend(self, poles: Poles, stage: str, tolerance: float = 1e-9) -> Polished:
        """Polish from the given poles (fixed ones first) and note the end in the trace."""
        end = polish(
            self.data,
            poles,
            self.bounds,
            n_fixed_real=self.fixed.real.size,
            n_fixed_pairs=self.fixed.pairs.size,
            tolerance=tolerance,
        )
        self.evaluations += end.iterations + 1
        self.minima.append(PolishedMinimum(stage, end.poles, end.rss))
        return end

    def _best_descent(self, starts: list[Poles], stage: str) -> Polished:
        rough = min((self.descend(start, stage, _ROUGH) for start in starts), key=lambda end: end.rss)
        return self.descend(rough.poles, stage)

    def _global(self, title: str, cost: CandidateCost, evaluations: int) -> RealArray:
        points, costs = minimise(cost.log, cost.space.dimension, self.options.algorithm, evaluations)
        self.evaluations += cost.evaluations
        self.stages.append(SearchStage(title, cost.space.names, cost.space.coordinates(points), costs))
        return best_apart(points, costs, self.options.starts)


@cache
def _pair_grid() -> RealArray:
    """Frequencies and dampings of one pair, as points of the unit cube."""
    omegas, zetas = np.linspace(0, 1, _PAIR_GRID[0]), np.linspace(0, 1, _PAIR_GRID[1] + 2)[1:-1]
    return np.array([[omega, zeta] for omega in omegas for zeta in zetas])


@cache
def _real_grid(n_poles: int) -> RealArray:
    """Levels of one real pole, or all ordered couples of levels of two, as points of the unit cube."""
    levels = np.linspace(0, 1, _REAL_GRID)
    if n_poles == 1:
        return levels[:, np.newaxis]
    # The triangular map of the search space turns (low, 1) into equal poles at the top.
    couples = combinations_with_replacement(levels, 2)
    return np.array([[low, 0.0 if low == 1 else (high - low) / (1 - low)] for low, high in couples])
