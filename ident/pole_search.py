"""Global search for the poles: DIRECT on log J, descents from the best points, block rescans (design 4.3)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations_with_replacement

import numpy as np

from ident.arrays import RealArray
from ident.coordinates import SearchSpace, blocks_of_point, search_space
from ident.direct import best_apart, minimise
from ident.kernels import candidate_rss
from ident.least_squares import Projection, driving_signal, project
from ident.options import IdentOptions
from ident.poles import Poles
from ident.polish import Bounds, Polished, polish
from ident.regression import Regression
from ident.search_trace import PolishedMinimum, SearchStage

# A rescan has to gain this fraction of J to count.
_GAIN = 1e-6
# Descents that only compare starts stop when this fraction of J is left to gain; the winner goes on to the
# end.
_ROUGH = 1e-4
# Cost evaluations for one more pair when the rest is frozen: two unknowns.
_PAIR_EVALUATIONS = 240
_REAL_GRID = 9
_PAIR_GRID = (60, 3)


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
        self._power = float(data.y @ data.y)

    def space(self, n_real: int, n_pairs: int) -> SearchSpace:
        return search_space(n_real, n_pairs, self.data.longest, self.data.dt_s, self.options)

    def joint(self, n_real: int, n_pairs: int) -> Polished:
        """Best poles of a joint global search over n_real real poles and n_pairs pairs."""
        title = f"{n_real} real, {n_pairs} pairs"
        if n_real + n_pairs == 0:
            return self.descend(self.fixed, title)
        space = self.space(n_real, n_pairs)
        cost = self.candidate_cost(space, self.fixed, self.fixed)
        points = self._global(title, space, cost, self.options.evaluations)
        return self._best_descent([self.fixed.appended(space.poles(point)) for point in points], title)

    def add_pair(self, poles: Poles) -> Polished:
        """Best descent from the given poles and one more pair, sought on what their tangent space leaves."""
        title = f"pair {poles.pairs.size - self.fixed.pairs.size + 1}"
        space = self.space(0, 1)
        cost = self.candidate_cost(space, poles.doubled(), poles)
        points = self._global(title, space, cost, min(_PAIR_EVALUATIONS, self.options.evaluations))
        return self._best_descent([poles.appended(space.poles(point)) for point in points], title)

    def add_real(self, poles: Poles) -> Polished:
        """Best descent from the given poles and one more real pole."""
        space = self.space(1, 0)
        cost = self.candidate_cost(space, poles.doubled(), poles)
        grid = np.linspace(0, 1, 2 * _REAL_GRID)[:, np.newaxis]
        costs = np.array([cost(point) for point in grid])
        points = best_apart(grid, costs, 2)
        return self._best_descent(
            [poles.appended(space.poles(point)) for point in points], "one more real pole"
        )

    def rescan(self, best: Polished) -> Polished:
        """Look at each block on a grid with the rest frozen, descend from what is found, until nothing is
        gained."""
        for _ in range(6):
            found = self._rescan_real(best)
            for index in range(self.fixed.pairs.size, best.poles.pairs.size):
                found = self._rescan_pair(found, index)
            if not found.rss < best.rss * (1 - _GAIN):
                return best
            best = found
        return best

    def _rescan_real(self, best: Polished) -> Polished:
        n_fixed = self.fixed.real.size
        n_real = best.poles.real.size - n_fixed
        # Up to two real poles are looked at together: one alone can be held by the other.
        together = min(n_real, 2)
        for first in range(0, n_real, 2):
            chosen = list(range(n_fixed + first, n_fixed + min(first + together, n_real)))
            kept = Poles(np.delete(best.poles.real, chosen), best.poles.pairs)
            space = self.space(len(chosen), 0)
            cost = self.candidate_cost(space, kept, kept)
            levels = np.linspace(0, 1, _REAL_GRID)
            grid = [
                np.array([low, 0.0 if low == 1 else (high - low) / (1 - low)])[: len(chosen)]
                for low, high in combinations_with_replacement(levels, 2)
            ]
            best = self._descend_from_grid(best, np.array(grid), cost, space, kept, n_starts=2)
        return best

    def _rescan_pair(self, best: Polished, index: int) -> Polished:
        kept = Poles(best.poles.real, np.delete(best.poles.pairs, index))
        space = self.space(0, 1)
        cost = self.candidate_cost(space, kept, kept)
        omegas, zetas = np.linspace(0, 1, _PAIR_GRID[0]), np.linspace(0, 1, _PAIR_GRID[1] + 2)[1:-1]
        grid = np.array([[omega, zeta] for omega in omegas for zeta in zetas])
        return self._descend_from_grid(best, grid, cost, space, kept, n_starts=1)

    def _descend_from_grid(
        self,
        best: Polished,
        grid: RealArray,
        cost: Callable[[RealArray], float],
        space: SearchSpace,
        kept: Poles,
        n_starts: int,
    ) -> Polished:
        costs = np.array([cost(point) for point in grid])
        found = best
        for point in best_apart(grid, costs, n_starts):
            trial = self.descend(kept.appended(space.poles(point)), "rescan", _ROUGH)
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

    def _global(
        self, title: str, space: SearchSpace, cost: Callable[[RealArray], float], evaluations: int
    ) -> RealArray:
        points, costs = minimise(cost, space.dimension, self.options.algorithm, evaluations)
        self.stages.append(SearchStage(title, space.names, space.coordinates(points), costs))
        return best_apart(points, costs, self.options.starts)

    def candidate_cost(self, space: SearchSpace, shared: Poles, local: Poles) -> Callable[[RealArray], float]:
        """log J over the unit cube of `space`, with the columns of the frozen poles taken out beforehand."""
        frozen: Projection = project(self.data, shared, local)
        drive = driving_signal(self.data, shared)
        data, n_real, low, high, raw = self.data, space.n_real, space.low, space.high, space.raw
        free = data.structure.estimate_initial_state
        # Below this the Gram matrix knows nothing; the descents see the true residual.
        floor = 1e-13 * self._power

        def cost(unit: RealArray) -> float:
            self.evaluations += 1
            rss = candidate_rss(
                blocks_of_point(unit, n_real, low, high, raw),
                n_real,
                drive,
                frozen.residual,
                data.starts,
                frozen.local_q,
                frozen.shared_q,
                free,
            )
            return float(np.log(max(rss, floor)))

        return cost
