"""Search for the poles of a measured frequency response: the recipe of the time domain (design 4.3).

DIRECT on log J in log coordinates, the best points polished, pair by pair on what the tangent space of the
poles so far leaves, each block rescanned on a grid, and the order step by step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.basis.coordinates import SearchSpace, search_space
from ident.basis.functions import all_pass_response
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.data.arrays import RealArray
from ident.fit.frf_refinement import polish_response
from ident.fit.frf_regression import FrfRegression, fit_response
from ident.fit.refinement import Bounds, Polished
from ident.fit.residual_colour import effective_samples
from ident.search.direct import best_apart, minimise
from ident.search.order_selection import OrderStep
from ident.search.search_trace import PolishedMinimum, SearchStage

_GAIN = 1e-6
_ROUGH = 1e-4
# Two poles that meet make a descent crawl; one that only compares starts is stopped then.
_ITERATIONS, _ROUGH_ITERATIONS = 80, 20
_PAIR_EVALUATIONS = 240
_PAIR_GRID = (60, 4)
_REAL_GRID = 18
# Residual this small relative to the response (in power) is rounding: no further pole can be seen.
_EXPLAINED = 1e-18


class ResponseCost:
    """J over the unit cube of a search space, with other poles frozen."""

    def __init__(self, data: FrfRegression, space: SearchSpace, frozen: Poles) -> None:
        self.space = space
        self.evaluations = 0
        self._data = data
        columns = data.columns(frozen)
        self._q = np.linalg.qr(columns)[0] if columns.shape[1] else columns
        self._residual = data.y - self._q @ (self._q.T @ data.y)
        self._drive = data.common * all_pass_response(frozen, data.z)
        self._floor = 1e-13 * float(data.y @ data.y)

    def rss(self, units: RealArray) -> RealArray:
        """Residual sums of squares (E,) at points (E, D) of the unit cube."""
        self.evaluations += len(units)
        blocks = np.stack([self.space.blocks(unit) for unit in units])
        z, n_real = self._data.z, self.space.n_real
        drive = np.broadcast_to(self._drive, (len(units), z.size))
        columns = []
        for i in range(blocks.shape[1]):
            p0, p1, p2, p3 = (blocks[:, i, j, np.newaxis] for j in range(4))
            if i < n_real:
                columns.append(p1 / (z - p0) * drive)
                drive = drive * (1 - p0 * z) / (z - p0)
            else:
                below = z**2 - p1 * (1 + p0) * z + p0
                columns += [p2 * (z - p1) / below * drive, p2 * p3 / below * drive]
                drive = drive * (1 - p1 * (1 + p0) * z + p0 * z**2) / below
        rows = self._data.whiten(np.stack(columns, axis=-1))
        rows = rows - self._q @ (self._q.T @ rows)
        q = np.linalg.qr(rows)[0]
        return np.asarray(
            self._residual @ self._residual - np.sum(np.einsum("enk,n->ek", q, self._residual) ** 2, axis=1)
        )

    def log(self, units: RealArray) -> RealArray:
        """log J (E,) at points (E, D), as DIRECT sees it."""
        return np.log(np.maximum(self.rss(units), self._floor))


@dataclass(frozen=True)
class _Judge:
    """Reading of J: share of the rows that count as independent, their number, and the noise variance.

    J is a chi-square because the covariances are known: one more pole, of two numbers, is kept if J falls by
    more than 2 ln Ne (a pair: 4 ln Ne, design 4.3), and a fall within the covariances is no reason for one,
    however small the residual became. Where J stays larger than the covariances explain they are multiplied
    by its excess. Neighbouring frequencies may share their errors, hence Ne instead of the number of rows.
    """

    share: float
    worth: float
    scale: float


class FrfSearch:
    """The search on one measured response; collects the trace on the way. Fixed poles come first."""

    def __init__(self, data: FrfRegression, options: IdentOptions) -> None:
        self.data = data
        self.options = options
        self.fixed = options.fixed()
        self.stages: list[SearchStage] = []
        self.minima: list[PolishedMinimum] = []
        self.evaluations = 0
        self._tried: dict[tuple[int, int], float] = {}
        angle = np.angle(data.z)
        positive = angle[angle > 0]
        # A record that shows its lowest measured frequency twice: the length the box of the search asks for.
        self._length = int(np.ceil(4 * np.pi / positive.min()))
        highest = min(float(positive.max()), 0.9 * np.pi) / data.dt_s
        # Beyond the last measured frequency nothing shows where a pair is; the descent may still go there.
        self._box = (
            options
            if options.omega_max_rad_s is not None or options.coordinates == "raw"
            else options.model_copy(update={"omega_max_rad_s": highest})
        )
        self.bounds = Bounds.from_options(options, self._length, data.dt_s)

    def run(self) -> Polished:
        """Best poles with the numbers asked for, or with those the criterion keeps."""
        options = self.options
        n_real = min(2, options.max_real) if options.n_real is None else options.n_real
        most_pairs = options.max_pairs if options.n_pairs is None else options.n_pairs
        best = self._noted(self.rescan(self.joint(n_real, min(1, most_pairs))))
        for _ in range(3):
            order = best.poles.order
            best = self._grow_pairs(best, most_pairs)
            if options.n_real is None:
                best = self._grow_real(best)
                if options.n_pairs is None:
                    best = self._split_overdamped(best, options.max_real)
            best = self._prune(best)
            if best.poles.order == order:
                break
        return best if None in (options.n_real, options.n_pairs) else self._exchanged(best)

    def table(self, best: Polished) -> tuple[OrderStep, ...]:
        """Every structure that was tried, by order, judged by the residual of the chosen model."""
        judge = self._judge(best)
        steps = [
            OrderStep(n_real, n_pairs, rss, self._criterion(rss, n_real + 2 * n_pairs, judge))
            for (n_real, n_pairs), rss in self._tried.items()
        ]
        return tuple(sorted(steps, key=lambda step: (step.order, step.n_real)))

    def joint(self, n_real: int, n_pairs: int) -> Polished:
        """Best poles of a joint global search."""
        title = f"{n_real} real, {n_pairs} pairs"
        if n_real + n_pairs == 0:
            return self.descend(self.fixed, title)
        cost = ResponseCost(self.data, self._space(n_real, n_pairs), self.fixed)
        return self._searched(title, cost, self.fixed, self.options.evaluations)

    def add_pair(self, poles: Poles) -> Polished:
        """Best descent from the given poles and one more pair, sought on what their tangent space leaves."""
        cost = ResponseCost(self.data, self._space(0, 1), poles.doubled())
        evaluations = min(_PAIR_EVALUATIONS, self.options.evaluations)
        return self._searched(f"pair {self._counts(poles)[1] + 1}", cost, poles, evaluations)

    def add_real(self, poles: Poles) -> Polished:
        """Best descent from the given poles and one more real pole."""
        cost = ResponseCost(self.data, self._space(1, 0), poles.doubled())
        grid = np.linspace(0, 1, _REAL_GRID)[:, np.newaxis]
        points = best_apart(grid, cost.rss(grid), 2)
        self.evaluations += cost.evaluations
        return self._best_descent(
            [poles.appended(cost.space.poles(point)) for point in points], "one more real pole"
        )

    def rescan(self, best: Polished) -> Polished:
        """Look at each pole on a grid with the rest frozen, descend from what is found, until nothing is
        gained."""
        pair_grid = np.array(
            [
                [omega, zeta]
                for omega in np.linspace(0, 1, _PAIR_GRID[0])
                for zeta in np.linspace(0, 1, _PAIR_GRID[1] + 2)[1:-1]
            ]
        )
        real_grid = np.linspace(0, 1, _REAL_GRID)[:, np.newaxis]
        for _ in range(6):
            found = best
            for i in range(self.fixed.real.size, best.poles.real.size):
                kept = Poles(np.delete(found.poles.real, i), found.poles.pairs)
                found = self._from_grid(found, kept, self._space(1, 0), real_grid)
            for i in range(self.fixed.pairs.size, best.poles.pairs.size):
                kept = Poles(found.poles.real, np.delete(found.poles.pairs, i))
                found = self._from_grid(found, kept, self._space(0, 1), pair_grid)
            if not found.rss < best.rss * (1 - _GAIN):
                return best
            best = found
        return best

    def descend(self, poles: Poles, stage: str, tolerance: float = 1e-9) -> Polished:
        """Polish from the given poles and note the end in the trace."""
        end = polish_response(
            self.data,
            poles,
            self.bounds,
            n_fixed_real=self.fixed.real.size,
            n_fixed_pairs=self.fixed.pairs.size,
            tolerance=tolerance,
            max_iterations=_ITERATIONS if tolerance < _ROUGH else _ROUGH_ITERATIONS,
        )
        self.evaluations += end.iterations + 1
        self.minima.append(PolishedMinimum(stage, end.poles, end.rss))
        return end

    def _space(self, n_real: int, n_pairs: int) -> SearchSpace:
        return search_space(n_real, n_pairs, self._length, self.data.dt_s, self._box)

    def _searched(self, title: str, cost: ResponseCost, kept: Poles, evaluations: int) -> Polished:
        points, costs = minimise(cost.log, cost.space.dimension, self.options.algorithm, evaluations)
        self.evaluations += cost.evaluations
        self.stages.append(SearchStage(title, cost.space.names, cost.space.coordinates(points), costs))
        chosen = best_apart(points, costs, self.options.starts)
        return self._best_descent([kept.appended(cost.space.poles(point)) for point in chosen], title)

    def _best_descent(self, starts: list[Poles], stage: str) -> Polished:
        rough = min((self.descend(start, stage, _ROUGH) for start in starts), key=lambda end: end.rss)
        return self.descend(rough.poles, stage)

    def _from_grid(self, best: Polished, kept: Poles, space: SearchSpace, grid: RealArray) -> Polished:
        cost = ResponseCost(self.data, space, kept)
        point = grid[int(np.argmin(cost.rss(grid)))]
        self.evaluations += cost.evaluations
        trial = self.descend(kept.appended(space.poles(point)), "rescan", _ROUGH)
        return self.descend(trial.poles, "rescan") if trial.rss < best.rss * (1 - _GAIN) else best

    def _grow_pairs(self, best: Polished, most_pairs: int) -> Polished:
        while (self._counts(best.poles)[1] < most_pairs) and self._visible(best):
            trial = self._noted(self.rescan(self.add_pair(best.poles)))
            if self.options.n_pairs is None and not self._better(trial, best, self._judge(trial)):
                break
            best = trial
        return best

    def _grow_real(self, best: Polished) -> Polished:
        while self._counts(best.poles)[0] < self.options.max_real and self._visible(best):
            trial = self._noted(self.rescan(self.add_real(best.poles)))
            if not self._better(trial, best, self._judge(trial)):
                break
            best = trial
        return best

    def _split_overdamped(self, best: Polished, most_real: int) -> Polished:
        """A pair that went to its largest damping wants to be two real poles; it may."""
        zeta = best.poles.zeta()
        for i in reversed(range(self.fixed.pairs.size, zeta.size)):
            if zeta[i] < self.bounds.zeta_max * (1 - 1e-6):
                continue
            omega = abs(np.log(best.poles.pairs[i]))
            real = np.concatenate([best.poles.real, np.exp(-omega * np.array([0.7, 1.4]))])
            trial = self._noted(self.descend(Poles(real, np.delete(best.poles.pairs, i)), "two real poles"))
            if trial.rss < best.rss and self._counts(trial.poles)[0] <= most_real:
                best = trial
        return best

    def _exchanged(self, best: Polished) -> Polished:
        """One pole more and the least needed one of its kind less, as long as something is gained.

        A search that grows to a given structure can end with a pair where two real poles should be and no way
        to move them one by one.
        """
        counts = self._counts(best.poles)
        for _ in range(4):
            if not self._visible(best):
                return best
            larger = [self.add_pair(best.poles)]
            if counts[0]:
                larger.append(self.add_real(best.poles))
                larger.append(self.add_pair(self._split_overdamped(best, counts[0] + 2).poles))
            found = min((self._reduced(end, counts) for end in larger), key=lambda end: end.rss)
            if not found.rss < best.rss * (1 - _GAIN):
                return best
            best = self._noted(self.rescan(found))
        return best

    def _reduced(self, end: Polished, counts: tuple[int, int]) -> Polished:
        """Poles taken out one by one, the one first whose loss costs least, down to the given numbers."""
        while True:
            here = self._counts(end.poles)
            trials = []
            if here[0] > counts[0]:
                for i in range(self.fixed.real.size, end.poles.real.size):
                    trials.append(Poles(np.delete(end.poles.real, i), end.poles.pairs))
            if here[1] > counts[1]:
                for i in range(self.fixed.pairs.size, end.poles.pairs.size):
                    trials.append(Poles(end.poles.real, np.delete(end.poles.pairs, i)))
            if not trials:
                return end
            end = self._best_descent(trials, "exchange")

    def _prune(self, best: Polished) -> Polished:
        """Take out poles whose loss the criterion does not mind, the least needed first."""
        while True:
            trials = []
            if self.options.n_real is None:
                for i in range(self.fixed.real.size, best.poles.real.size):
                    trials.append(Poles(np.delete(best.poles.real, i), best.poles.pairs))
            if self.options.n_pairs is None:
                for i in range(self.fixed.pairs.size, best.poles.pairs.size):
                    trials.append(Poles(best.poles.real, np.delete(best.poles.pairs, i)))
            judge = self._judge(best)
            ends = [self._noted(self.descend(poles, "pruning")) for poles in trials]
            ends = [end for end in ends if self._better(end, best, judge)]
            if not ends:
                return best
            best = min(ends, key=lambda end: self._criterion(end.rss, end.poles.order, judge))

    def _better(self, trial: Polished, best: Polished, judge: _Judge) -> bool:
        return self._criterion(trial.rss, trial.poles.order, judge) < self._criterion(
            best.rss, best.poles.order, judge
        )

    def _criterion(self, rss: float, order: int, judge: _Judge) -> float:
        return judge.share * rss / judge.scale + self.data.n_parameters(order) * float(np.log(judge.worth))

    def _judge(self, end: Polished) -> _Judge:
        """How J is to be read, from the residual of the larger of two models."""
        data = self.data
        residual = fit_response(data, end.poles).residual
        count = data.z.size
        starts = np.array([0, count, 2 * count], dtype=np.int64)
        share = effective_samples(residual, starts) / residual.size
        freedom = max(data.n_rows - data.n_parameters(end.poles.order, self.fixed.order), 1)
        return _Judge(share, max(share * data.n_rows, 3.0), max(1.0, end.rss / freedom))

    def _visible(self, best: Polished) -> bool:
        enough = self.data.n_rows > 2 * self.data.n_parameters(best.poles.order + 2)
        return enough and best.rss > _EXPLAINED * float(self.data.y @ self.data.y)

    def _counts(self, poles: Poles) -> tuple[int, int]:
        return poles.real.size - self.fixed.real.size, poles.pairs.size - self.fixed.pairs.size

    def _noted(self, end: Polished) -> Polished:
        key = self._counts(end.poles)
        self._tried[key] = min(end.rss, self._tried.get(key, np.inf))
        return end
