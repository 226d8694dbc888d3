"""Global search for the poles: DIRECT on log J, descents from the best points, block rescans."""

from __future__ import annotations

import cmath
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import combinations_with_replacement, cycle, islice, pairwise
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from ident.basis.coordinates import SearchSpace, search_space
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.data.arrays import RealArray, lock
from ident.data.finding import Finding
from ident.data.record import Record
from ident.fit.least_squares import Regression
from ident.fit.problem import CandidateCost, PoleProblem, ResidualColour
from ident.fit.refinement import FAR, NEAR, Bounds, Refined, refine
from ident.fit.regression import prepare
from ident.search.direct import best_apart, minimise

Problem = TypeVar("Problem", bound=PoleProblem, covariant=True)

# A rescan or an exchange has to gain this fraction of J to count.
GAIN = 1e-6
# Rescans of every block at most.
_ROUNDS = 6
# Descents that only compare starts stop when this share of J is left to gain.
ROUGH = 1e-3
# So many starts that end in one place make further ones and a rescan superfluous.
_STARTS_TO_AGREE = 3
# Where they disagree, so many times the starts asked for are tried.
_PATIENCE = 5
# Cost evaluations for one more pair when the rest is frozen: two unknowns.
_PAIR_EVALUATIONS = 240
_REAL_GRID = 9  # levels of a real pole: two a decade over the box of a record of 10 000 samples
_PAIR_GRID = (40, 2)
# Ends of rough descents are one optimum if J and poles differ by no more than this.
_SAME_COST = 3 * ROUGH
_SAME_POLE = 0.1  # see `_SAME_COST`
# Up to this share of the output's power a residual is little: with more noise many minima lie together.
_LITTLE_NOISE = 0.02


class PoleSearch(Generic[Problem]):
    """The search on one problem, with its trace. Fixed poles come first of each type and are never moved.

    bounds: sides that refined poles keep; default: those that the options state.
    """

    def __init__(self, data: Problem, options: IdentOptions, bounds: Bounds | None = None) -> None:
        self.data = data
        self.options = options
        self.fixed = options.fixed()
        self.bounds = bounds or Bounds.from_options(options, data.longest, data.dt_s)
        self.stages: list[SearchStage] = []
        self.minima: list[PolishedMinimum] = []
        self.evaluations = 0
        # Slower than the box of the search goes, of which a record says nothing.
        self._slowest = 0.2 / max(data.longest, 30)
        self._box = options
        unbounded = options.omega_max_rad_s is None and options.coordinates == "log"
        if unbounded and data.omega_max_rad_s is not None:
            self._box = options.model_copy(update={"omega_max_rad_s": data.omega_max_rad_s})
        self._settled: Refined | None = None
        self._coloured: tuple[Refined, ResidualColour] | None = None

    def space(self, n_real: int, n_pairs: int) -> SearchSpace:
        return search_space(n_real, n_pairs, self.data.longest, self.data.dt_s, self._box)

    def joint(self, n_real: int, n_pairs: int) -> Refined:
        """Best poles of a joint global search over n_real real poles and n_pairs pairs. It has settled if
        the first starts, far from each other, all end in one place that can be trusted (`is_trusted`: a
        broad wrong minimum catches several, but leaves dynamics); else `_PATIENCE` times as many starts
        are tried."""
        title = f"{n_real} real, {n_pairs} pairs"
        if n_real + n_pairs == 0:
            return self.descend(self.fixed, title)
        space = self.space(n_real, n_pairs)
        cost = self.data.candidate_cost(space, self.fixed, self.fixed)
        few = min(self.options.starts, _STARTS_TO_AGREE)
        points = self._global(title, cost, self.options.evaluations, self.options.starts * _PATIENCE)

        def starts(chosen: RealArray) -> list[Poles]:
            return [self.fixed.appended(space.poles(point)) for point in chosen]

        known = len(self.minima)
        best = self._best_descent(starts(points[:few]), title)
        ends = self.minima[known : known + len(points[:few])]
        agreed = len(ends) == _STARTS_TO_AGREE and all(self._is_same(end, best) for end in ends)
        if agreed and self.is_trusted(best):
            self._settled = best
            return best
        if len(points) > few:
            other = self._best_rough(starts(points[few:]), title)
            if other.rss < best.rss * (1 - GAIN):
                best = min(best, self.descend(other.poles, title), key=lambda end: end.rss)
        return best

    def is_trusted(self, best: Refined) -> bool:
        """Whether `best` leaves little of the output, the rest white, and is no saddle of equal real
        poles."""
        distances = sorted(1 - a for a in best.poles.real[self.fixed.real.size :].tolist())
        meeting = any(
            fast > self._slowest / 4 and fast - slow <= _SAME_POLE * fast
            for slow, fast in pairwise(distances)
        )
        return not meeting and best.rss <= _LITTLE_NOISE * self.data.power and self.colour(best).white

    def _is_same(self, end: PolishedMinimum, best: Refined) -> bool:
        """Whether a rough descent was on its way to `best`."""
        if end.rss > best.rss * (1 + _SAME_COST):
            return False
        return all(
            abs(ours - theirs) <= _SAME_POLE * theirs + self._slowest
            for ours, theirs in zip(_rates(end.poles), _rates(best.poles), strict=True)
        )

    def add_pair(self, poles: Poles) -> Refined:
        """Best descent from the given poles and one more pair, sought on what their tangent space leaves."""
        title = f"pair {poles.pairs.size - self.fixed.pairs.size + 1}"
        space = self.space(0, 1)
        cost = self.data.candidate_cost(space, poles.doubled(), poles)
        points = self._global(
            title, cost, min(_PAIR_EVALUATIONS, self.options.evaluations), self.options.starts
        )
        return self._best_descent([poles.appended(space.poles(point)) for point in points], title)

    def add_real(self, poles: Poles) -> Refined:
        """Best descent from the given poles and one more real pole."""
        space = self.space(1, 0)
        cost = self.data.candidate_cost(space, poles.doubled(), poles)
        grid = np.linspace(0, 1, 2 * _REAL_GRID)[:, np.newaxis]
        points = best_apart(grid, cost.rss(grid), 2)
        self.evaluations += cost.evaluations
        return self._best_descent(
            [poles.appended(space.poles(point)) for point in points], "one more real pole"
        )

    def split_pair(self, poles: Poles) -> Refined:
        """Best descent with one searched pair as two, a half-width apart, where `add_pair` sees no mode."""
        starts = []
        for i in range(self.fixed.pairs.size, poles.pairs.size):
            log = cmath.log(poles.pairs[i])
            angles = np.clip(log.imag + np.array([0.5, -0.5]) * log.real, *self.bounds.array[2:4])
            starts.append(poles.without_pair(i).appended(Poles(pairs=np.exp(log.real + 1j * angles))))
        return self._best_descent(starts, "pair as two")

    def rescan(self, best: Refined) -> Refined:
        """Look at each block on a grid with the rest frozen, descend from what is found, until a round gains
        nothing; not if the joint search settled on `best`."""
        if best is self._settled:
            return best
        n_fixed_real, n_fixed_pairs = self.fixed.counts
        n_real, n_pairs = best.poles.counts
        # Up to two real poles are looked at together: one alone can be held by the other.
        couples = [slice(i, min(i + 2, n_real)) for i in range(n_fixed_real, n_real, 2)]
        scans = [partial(self._rescan, part="real", here=here) for here in couples]
        scans += [
            partial(self._rescan, part="pairs", here=slice(i, i + 1)) for i in range(n_fixed_pairs, n_pairs)
        ]
        quiet = 0
        for scan in islice(cycle(scans), _ROUNDS * len(scans)):
            found = scan(best)
            quiet = 1 if found.rss < best.rss * (1 - GAIN) else quiet + 1
            best = found
            if quiet == len(scans):
                break
        return best

    def _rescan(self, best: Refined, part: Literal["real", "pairs"], here: slice) -> Refined:
        """Descents from the best points of a grid over one block, the rest frozen, not from next to where it
        is."""
        poles = best.poles
        if part == "real":
            kept, block = poles.without_real(here), Poles(poles.real[here])
            grid, n_levels, n_starts = _real_grid(block.order), _REAL_GRID, 2
        else:
            kept, block = poles.without_pair(here), Poles(pairs=poles.pairs[here])
            grid, n_levels, n_starts = _pair_grid(), _PAIR_GRID[0], 1
        space = self.space(*block.counts)
        cost = self.data.candidate_cost(space, kept, kept)
        here_now = np.sort(space.levels(block))
        costs = cost.rss(grid)
        self.evaluations += cost.evaluations
        found = best
        for point in best_apart(grid, costs, n_starts):
            new = space.poles(point)
            if np.all(np.abs(np.sort(space.levels(new)) - here_now) <= 1 / (n_levels - 1)):
                continue
            moved = getattr(poles, part).copy()
            moved[here] = getattr(new, part)
            trial = self.descend(replace(poles, **{part: moved}), "rescan", ROUGH)
            if trial.rss < found.rss * (1 - GAIN):
                found = self.descend(trial.poles, "rescan")
        return found

    def colour(self, end: Refined) -> ResidualColour:
        """Colour of the residual of an end; kept for the last end asked for."""
        if self._coloured is None or self._coloured[0] is not end:
            self._coloured = end, self.data.colour(self.data.residual(end.poles))
        return self._coloured[1]

    def descend(self, poles: Poles, stage: str, tolerance: float = 1e-9) -> Refined:
        """Refine from the given poles (fixed ones first) and note the end in the trace."""
        damping = FAR if tolerance >= ROUGH else NEAR
        end = refine(self.data, poles, self.bounds, self.fixed, tolerance=tolerance, damping=damping)
        self.evaluations += end.iterations + 1
        self.minima.append(PolishedMinimum(stage, end.poles, end.rss))
        return end

    def _best_descent(self, starts: list[Poles], stage: str) -> Refined:
        return self.descend(self._best_rough(starts, stage).poles, stage)

    def _best_rough(self, starts: list[Poles], stage: str) -> Refined:
        return min((self.descend(start, stage, ROUGH) for start in starts), key=lambda end: end.rss)

    def _global(self, title: str, cost: CandidateCost, evaluations: int, count: int) -> RealArray:
        points, costs = minimise(cost.log, cost.space.dimension, self.options.algorithm, evaluations)
        self.evaluations += cost.evaluations
        self.stages.append(SearchStage(title, cost.space.names, cost.space.coordinates(points), costs))
        return best_apart(points, costs, count)


@dataclass(frozen=True, eq=False)
class Fitted:
    """An optimum, and the search (records, options, bounds, trace) it belongs to."""

    search: PoleSearch[Regression]
    end: Refined

    @property
    def data(self) -> Regression:
        return self.search.data

    @property
    def poles(self) -> Poles:
        return self.end.poles

    @property
    def residual(self) -> RealArray:
        return self.data.residual(self.poles)

    def worth(self) -> float:
        """Independent samples that the residual is worth."""
        return self.search.colour(self.end).effective_samples

    def refitted(self, records: Sequence[Record], start: Poles, **changed: Any) -> Fitted:
        """The optimum from `start` with other settings, which structure and options call by the same names.

        Where the rows are the same their nuisances are, so that both sides of a comparison have them.
        """
        data = prepare(records, replace(self.data.structure, **changed))
        if data.n_samples == self.data.n_samples:
            data = replace(data, polynomials=self.data.polynomials)
        search = PoleSearch(data, self.search.options.model_copy(update=changed))
        return Fitted(search, search.descend(start, "other structure"))


def _rates(poles: Poles) -> list[float]:
    """Decays of the real poles, frequencies of the pairs and their decays per sample, each by size."""
    pairs = [cmath.log(pole) for pole in poles.pairs.tolist()]
    return [
        *sorted(1 - a for a in poles.real.tolist()),
        *sorted(abs(log) for log in pairs),
        *sorted(-log.real for log in pairs),
    ]


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


@dataclass(frozen=True, eq=False)
class SearchStage:
    """One global search: coordinates (E, D) of the points in the order of evaluation and log J (E,)."""

    title: str
    coordinate_names: tuple[str, ...]
    points: RealArray
    log_cost: RealArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "coordinate_names", tuple(self.coordinate_names))
        lock(self, "points", "log_cost")
        if self.points.shape != (self.log_cost.size, len(self.coordinate_names)):
            raise ValueError(
                f"points must be ({self.log_cost.size}, {len(self.coordinate_names)}); got "
                f"{self.points.shape}"
            )


@dataclass(frozen=True, eq=False)
class PolishedMinimum:
    """End of one descent: where it started, the poles it reached and their residual sum of squares."""

    stage: str
    poles: Poles
    rss: float


@dataclass(frozen=True, eq=False)
class SearchTrace:
    """Global searches (stages) and descents (minima, in order) of one identification, warnings, and
    evaluations of the cost, rescans and descents included."""

    stages: tuple[SearchStage, ...]
    minima: tuple[PolishedMinimum, ...]
    warnings: tuple[Finding, ...]
    evaluations: int
