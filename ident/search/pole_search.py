"""Global search for the poles of a least-squares problem: DIRECT on log J, descents, rescans of single
blocks.

J is the residual sum of squares with coefficients and nuisances re-fitted at given poles (variable
projection, Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973). It has many local minima, so
`PoleSearch.joint` looks at a whole box of poles with DIRECT (Jones, Perttunen and Stuckman, J. Optim. Theory
Appl. 79(1), 1993) and descends from the best points that lie apart. `add_pair`, `add_real` and `split_pair`
make a set of poles larger, `rescan` moves one block at a time to where a grid finds it better, the rest
frozen. `descend` is the local refinement behind all of them. What problem is searched does not matter
(`ident.fit.problem.PoleProblem`): records or frequency responses.

`Fitted` is an optimum with its search; `SearchStage`, `PolishedMinimum` and `SearchTrace` are the trace that
is stored and drawn. Fixed poles come first of each type everywhere and are never moved.

Types of other files: `Refined`, the end of a descent (`poles`, their J `rss`); `SearchSpace`, a box of poles
as a map from the unit cube of D coordinates; `CandidateCost`, J over that cube with other poles frozen;
`ResidualColour`, whether a residual is white and its worth in independent samples. Data with too few samples,
or without motion, the callers have refused: here nothing is raised for them.
"""

from __future__ import annotations

import cmath
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations_with_replacement, pairwise
from typing import Any, Generic, Literal, NamedTuple, TypeVar

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

# Share of J that a rescan or an exchange of poles has to gain to count: far more than rounding, far less than
# any pole is worth (2 ln Ne / Ne, 3e-5 at a million samples). Chosen between both.
GAIN = 1e-6
# Share of J that is left to gain when a descent ends that only compares starts. Chosen.
ROUGH = 1e-3
# Share of J that is left to gain when a descent ends whose poles are used: far below the 1 / N by which noise
# moves J, and above its rounding.
FINE = 1e-9
# Rescans of every block at most. A bound on time: the rescan ends where a whole round gains nothing.
MOST_ROUNDS = 6
# Points of a rescan of real poles from which a descent starts: the best may lead back to where the poles are.
# Chosen.
STARTS_OF_REAL = 2

# Points of a rescan of a pair from which one starts: a descent of two unknowns takes longer.
STARTS_OF_PAIR = 1

# Starts that end in one place and make further ones and a rescan superfluous. Chosen: two may agree by
# chance.
STARTS_TO_AGREE = 3
# Where they disagree, so many times the starts asked for are tried. A safeguard: on 78 records of the
# benchmark plants all models stay the same with neither further starts nor an early end, as rescans find the
# better place.
PATIENCE = 5
# Share of the output's power up to which a residual is little: with more noise many minima lie together, and
# starts that agree prove nothing. Chosen.
LITTLE_NOISE = 0.02
# Share of J by which ends of rough descents differ that are one optimum: each is known to `ROUGH`, so two
# differ by 2 ROUGH, and one is to spare.
SAME_COST = 3 * ROUGH
# Share of a decay or frequency by which poles of such ends differ: near an optimum J is flat, so poles end
# less alike than J: by the root of `ROUGH`, 3 %, and some more. Chosen.
SAME_POLE = 0.1

# Cost evaluations of DIRECT for one more pair when the rest is frozen: two unknowns, so fifteen or so a side.
# Chosen.
PAIR_EVALUATIONS = 240
# Levels of a real pole in a grid: two a decade over the box of a record of 10 000 samples. Chosen: descents
# find what lies between.
REAL_LEVELS = 9
# Frequencies and damping ratios of a pair in a grid. A grid of 60 x 3 led to the same models on the benchmark
# plants.
PAIR_OMEGAS = 40

# Damping ratios of a pair in a grid: light and well damped. Chosen, as a descent finds the damping.
PAIR_ZETAS = 2
# Samples below which a record counts as so long for the slowest pole of a search, so that its box is not
# empty. It has to be the number of `ident.basis.coordinates.search_space`.
SHORTEST = 30
# Decay over the longest record, 1 - a times samples, of the slowest real pole of the search's box: a record
# says nothing about slower ones. It has to be the number of `ident.basis.coordinates.search_space`.
SLOWEST_DECAY = 0.2


class Block(NamedTuple):
    """Poles that a rescan moves together: real poles or pairs, and their places among those."""

    part: Literal["real", "pairs"]
    places: slice


class PoleSearch(Generic[Problem]):
    """A search for the poles of one problem, with its trace.

    Parameters
    ----------
    data : PoleProblem
        Cost J at given poles, and its change; `power` of the output, samples of the longest record.
    options : IdentOptions
        Bounds of the poles, fixed poles, evaluations and starts of the search.
    bounds : Bounds, optional
        Sides that refined poles keep; default: those that the options state.

    Attributes
    ----------
    fixed : Poles
        Stated poles; they come first of each type in every result and are never moved.
    stages : list of SearchStage
        Global searches so far.
    minima : list of PolishedMinimum
        Ends of descents so far, in order.
    evaluations : int
        Evaluations of the cost so far, steps of descents included.
    """

    def __init__(self, data: Problem, options: IdentOptions, bounds: Bounds | None = None) -> None:
        """Nothing is searched yet.

        Fixed poles outside the circle were refused by the options; `bounds` are not checked.
        """
        self.data = data
        self.options = options
        self.fixed = options.fixed()
        self.bounds = bounds or Bounds.from_options(options, data.longest, data.dt_s)
        self.stages: list[SearchStage] = []
        self.minima: list[PolishedMinimum] = []
        self.evaluations = 0
        self._slowest = SLOWEST_DECAY / max(data.longest, SHORTEST)
        # What the data cannot show is not searched, unless somebody stated a bound.
        self._box = options
        unbounded = options.omega_max_rad_s is None and options.coordinates == "log"
        if unbounded and data.omega_max_rad_s is not None:
            self._box = options.model_copy(update={"omega_max_rad_s": data.omega_max_rad_s})
        # The end on which a joint search settled; a rescan of it is superfluous.
        self._settled: Refined | None = None
        # Colour of the residual of the end that was asked for last.
        self._coloured: tuple[Refined, ResidualColour] | None = None

    def space(self, n_real: int, n_pairs: int) -> SearchSpace:
        """Box of so many searched real poles and pairs, as a map from the unit cube.

        Raises ValueError where bounds that were stated leave it empty.
        """
        return search_space(n_real, n_pairs, self.data.longest, self.data.dt_s, self._box)

    def joint(self, n_real: int, n_pairs: int) -> Refined:
        """End of the best descent after a global search over all searched poles together.

        Parameters
        ----------
        n_real, n_pairs : int
            Numbers of real poles and pairs beside the fixed ones; none: these are refined alone.

        Returns
        -------
        Refined
            Poles, fixed ones first, and J.

        Raises
        ------
        ValueError
            Bounds that were stated leave no box (`space`).

        Notes
        -----
        A search has settled (`rescan` then leaves its end as it is) if the first starts, far from each other,
        all end in one place that can be trusted (`is_trusted`: a broad wrong minimum catches several, but
        leaves dynamics). Else `PATIENCE` times as many starts as asked for are tried.
        """
        title = f"{n_real} real, {n_pairs} pairs"
        if n_real + n_pairs == 0:
            return self.descend(self.fixed, title)
        space = self.space(n_real, n_pairs)
        cost = self.data.candidate_cost(space, self.fixed, self.fixed)
        points = self._global(title, cost, self.options.evaluations, self.options.starts * PATIENCE)
        n_first = min(self.options.starts, STARTS_TO_AGREE)

        # The first starts; what is settled ends here.
        first_starts = [self.fixed.appended(space.poles(point)) for point in points[:n_first]]
        n_known = len(self.minima)
        best = self._best_descent(first_starts, title)
        ends = self.minima[n_known : n_known + len(first_starts)]
        agreed = len(ends) == STARTS_TO_AGREE and all(self._is_same(end, best) for end in ends)
        if agreed and self.is_trusted(best):
            self._settled = best
            return best

        further_starts = [self.fixed.appended(space.poles(point)) for point in points[n_first:]]
        if further_starts:
            other = self._best_rough(further_starts, title)
            if other.rss < best.rss * (1 - GAIN):
                other = self.descend(other.poles, title)
                if other.rss < best.rss:
                    best = other
        return best

    def is_trusted(self, best: Refined) -> bool:
        """Whether an end leaves little of the output, the rest white, and is no saddle of equal real poles.

        Two real poles that are about to meet are such a saddle: a descent does not part them. White at 99 %;
        a record of less than 250 samples never is.
        """
        searched_real = best.poles.real[self.fixed.real.size :]
        distances = sorted(1 - pole for pole in searched_real.tolist())
        for slow, fast in pairwise(distances):
            # Poles far slower than the box are all alike. Far: four times; chosen.
            in_box = fast > self._slowest / 4
            if in_box and fast - slow <= SAME_POLE * fast:
                return False
        explains = best.rss <= LITTLE_NOISE * self.data.power
        return explains and self.colour(best).white

    def _is_same(self, end: PolishedMinimum, best: Refined) -> bool:
        """Whether a rough descent was on its way to `best`, by J and by decays and frequencies of the poles.

        Both have as many poles of each type (ValueError else); by `SAME_COST` and `SAME_POLE`.
        """
        if end.rss > best.rss * (1 + SAME_COST):
            return False
        for rate, best_rate in zip(_rates(end.poles), _rates(best.poles), strict=True):
            # Poles slower than the box may differ by all of it.
            if not abs(rate - best_rate) <= SAME_POLE * best_rate + self._slowest:
                return False
        return True

    def add_pair(self, poles: Poles) -> Refined:
        """End of the best descent from some poles (fixed ones first) and one more pair.

        The pair is sought by DIRECT on what the tangent space of these poles leaves of the output: whatever
        their first-order changes explain is taken out (`Poles.doubled`). Raises ValueError where bounds leave
        no box for a pair.
        """
        title = f"pair {poles.pairs.size - self.fixed.pairs.size + 1}"
        space = self.space(0, 1)
        cost = self.data.candidate_cost(space, poles.doubled(), poles)
        evaluations = min(PAIR_EVALUATIONS, self.options.evaluations)
        points = self._global(title, cost, evaluations, self.options.starts)
        return self._best_descent([poles.appended(space.poles(point)) for point in points], title)

    def add_real(self, poles: Poles) -> Refined:
        """End of the best descent from some poles (fixed ones first) and one more real pole.

        Starts are the two best levels of a grid, twice as fine as that of a rescan, on what the tangent space
        of the poles leaves of the output. Raises ValueError where bounds leave no box for a real pole.
        """
        space = self.space(1, 0)
        cost = self.data.candidate_cost(space, poles.doubled(), poles)
        grid = np.linspace(0, 1, 2 * REAL_LEVELS)[:, np.newaxis]
        points = best_apart(grid, cost.rss(grid), STARTS_OF_REAL)
        self.evaluations += cost.evaluations
        starts = [poles.appended(space.poles(point)) for point in points]
        return self._best_descent(starts, "one more real pole")

    def split_pair(self, poles: Poles) -> Refined:
        """End of the best descent with one searched pair as two, a half-width apart.

        For two modes so close that `add_pair` sees none: one pair in the middle explains both to first order.
        Each searched pair is a start; without any `min` raises ValueError.
        """
        starts = []
        for index in range(self.fixed.pairs.size, poles.pairs.size):
            # log p = -s + j f, half-power width s; the two stand at f - s / 2 and f + s / 2.
            log = cmath.log(poles.pairs[index])
            angles = log.imag + np.array([0.5, -0.5]) * log.real
            angles = np.clip(angles, self.bounds.omega_min, self.bounds.omega_max)
            two = Poles(pairs=np.exp(log.real + 1j * angles))
            starts.append(poles.without_pair(index).appended(two))
        return self._best_descent(starts, "pair as two")

    def rescan(self, best: Refined) -> Refined:
        """End that is left when no block of poles is better elsewhere, the rest frozen.

        Parameters
        ----------
        best : Refined
            Where to begin; returned as it is if a joint search settled on it.

        Returns
        -------
        Refined
            `best` itself where nothing gains.

        Notes
        -----
        Blocks, up to two real poles or one pair, are looked at in turns, until a whole round gained nothing
        or after `MOST_ROUNDS` rounds.
        """
        if best is self._settled:
            return best
        n_fixed_real, n_fixed_pairs = self.fixed.counts
        n_real, n_pairs = best.poles.counts
        # Up to two real poles are looked at together: one alone can be held by the other.
        blocks = [Block("real", slice(i, min(i + 2, n_real))) for i in range(n_fixed_real, n_real, 2)]
        blocks += [Block("pairs", slice(i, i + 1)) for i in range(n_fixed_pairs, n_pairs)]
        # Blocks that were looked at since the last gain, that one included.
        n_quiet = 0
        for block in MOST_ROUNDS * blocks:
            end = self._rescanned(best, block)
            if end.rss < best.rss * (1 - GAIN):
                n_quiet = 1
            else:
                n_quiet += 1
            best = end
            if n_quiet == len(blocks):
                break
        return best

    def _rescanned(self, best: Refined, block: Block) -> Refined:
        """Best end of descents from the best points of a grid over one block of poles, the rest frozen.

        `best` itself where nothing gains. Points next to where the block is are left out: they would come
        back. Raises ValueError where bounds leave no box for the block.
        """
        poles = best.poles
        if block.part == "real":
            frozen = poles.without_real(block.places)
            moving = Poles(poles.real[block.places])
            grid = _real_grid(moving.order)
            level_step = 1 / (REAL_LEVELS - 1)
            n_starts = STARTS_OF_REAL
        else:
            frozen = poles.without_pair(block.places)
            moving = Poles(pairs=poles.pairs[block.places])
            grid = _pair_grid()
            level_step = 1 / (PAIR_OMEGAS - 1)
            n_starts = STARTS_OF_PAIR
        space = self.space(*moving.counts)
        cost = self.data.candidate_cost(space, frozen, frozen)
        levels = np.sort(space.levels(moving))
        costs = cost.rss(grid)
        self.evaluations += cost.evaluations
        for point in best_apart(grid, costs, n_starts):
            candidate = space.poles(point)
            distance = np.abs(np.sort(space.levels(candidate)) - levels)
            if np.all(distance <= level_step):
                continue
            start = getattr(poles, block.part).copy()
            start[block.places] = getattr(candidate, block.part)
            rough = self.descend(replace(poles, **{block.part: start}), "rescan", ROUGH)
            if rough.rss < best.rss * (1 - GAIN):
                best = self.descend(rough.poles, "rescan")
        return best

    def colour(self, end: Refined) -> ResidualColour:
        """Colour of the residual of an end: whether it is white, and what it is worth in independent samples.

        Kept for the end asked for last. The end is one of this search's data, which is not checked.
        """
        if self._coloured is None or self._coloured[0] is not end:
            residual = self.data.residual(end.poles)
            self._coloured = (end, self.data.colour(residual))
        return self._coloured[1]

    def descend(self, poles: Poles, stage: str, tolerance: float = FINE) -> Refined:
        """End of a local refinement from some poles, fixed ones first; noted in the trace.

        Parameters
        ----------
        poles : Poles
            The start; outside the bounds it is brought inside.
        stage : str
            Name of the step in the trace.
        tolerance : float
            Share of J that is left to gain at the end. From `ROUGH` on the start may be far from an optimum,
            so that first steps are cautious.

        Returns
        -------
        Refined
            The start itself where there is nothing to move, or nothing gains; after 60 steps where it is.
        """
        damping = FAR if tolerance >= ROUGH else NEAR
        end = refine(self.data, poles, self.bounds, self.fixed, tolerance=tolerance, damping=damping)
        self.evaluations += end.iterations + 1
        self.minima.append(PolishedMinimum(stage, end.poles, end.rss))
        return end

    def _best_descent(self, starts: Sequence[Poles], stage: str) -> Refined:
        """End of a fine descent from the best end of rough descents from some starts; ValueError without
        any."""
        return self.descend(self._best_rough(starts, stage).poles, stage)

    def _best_rough(self, starts: Sequence[Poles], stage: str) -> Refined:
        """Best of the ends of rough descents from some starts, the first of equal ones; ValueError without
        any."""
        ends = [self.descend(start, stage, ROUGH) for start in starts]
        return min(ends, key=lambda end: end.rss)

    def _global(self, title: str, cost: CandidateCost, evaluations: int, count: int) -> RealArray:
        """Up to `count` best points (C, D) apart from each other of a search by DIRECT; noted in the trace.

        title: of the stage; evaluations: of the cost, about. nlopt.runtime_error where NLopt fails at once.
        """
        points, costs = minimise(cost.log, cost.space.dimension, self.options.algorithm, evaluations)
        self.evaluations += cost.evaluations
        coordinates = cost.space.coordinates(points)
        self.stages.append(SearchStage(title, cost.space.names, coordinates, costs))
        return best_apart(points, costs, count)


@dataclass(frozen=True, eq=False)
class Fitted:
    """An optimum of one output's records, and the search it belongs to.

    Attributes
    ----------
    search : PoleSearch
        Records, options, bounds and trace.
    end : Refined
        Poles, fixed ones first, and residual sum of squares J.
    """

    search: PoleSearch[Regression]
    end: Refined

    @property
    def data(self) -> Regression:
        """The records made ready for a fit."""
        return self.search.data

    @property
    def poles(self) -> Poles:
        """Poles of the optimum, fixed ones first of each type."""
        return self.end.poles

    @property
    def residual(self) -> RealArray:
        """What the fit leaves of the output, (N,), in its units."""
        return self.data.residual(self.poles)

    def worth(self) -> float:
        """Independent samples that the residual is worth, at most N; N for a residual of zeros."""
        return self.search.colour(self.end).effective_samples

    def refitted(self, records: Sequence[Record], start: Poles, **changed: Any) -> Fitted:
        """The optimum from other poles with other settings.

        Parameters
        ----------
        records : sequence of Record
            Those of this fit.
        start : Poles
            Where the descent begins, fixed ones first.
        **changed
            Settings that structure and options call by the same names, such as `integrators`.

        Returns
        -------
        Fitted
            Where the rows are the same their nuisance polynomials are, so that both sides of a comparison
            have them.

        Raises
        ------
        ValueError
            A setting is not allowed (`Structure`), or a record has no rows behind the delay (`prepare`).
            TypeError for a name that the structure does not have.
        """
        data = prepare(records, replace(self.data.structure, **changed))
        if data.n_samples == self.data.n_samples:
            data = replace(data, polynomials=self.data.polynomials)
        search = PoleSearch(data, self.search.options.model_copy(update=changed))
        return Fitted(search, search.descend(start, "other structure"))


def _rates(poles: Poles) -> list[float]:
    """Distances from one of the real poles, frequencies of the pairs and their decays, per sample, each by
    size.

    R + 2 P numbers; empty without poles.
    """
    logs = [cmath.log(pole) for pole in poles.pairs.tolist()]
    distances = sorted(1 - pole for pole in poles.real.tolist())
    frequencies = sorted(abs(log) for log in logs)
    decays = sorted(-log.real for log in logs)
    return [*distances, *frequencies, *decays]


@cache
def _pair_grid() -> RealArray:
    """Frequencies and damping ratios of one pair, as points (E, 2) of the unit cube.

    E = `PAIR_OMEGAS` times `PAIR_ZETAS`; nothing goes in.
    """
    omegas = np.linspace(0, 1, PAIR_OMEGAS)
    # Inside the box: at its sides a pair has no damping, or no peak.
    zetas = np.linspace(0, 1, PAIR_ZETAS + 2)[1:-1]
    return np.array([[omega, zeta] for omega in omegas for zeta in zetas])


@cache
def _real_grid(n_poles: int) -> RealArray:
    """Levels of one real pole (E, 1), or all ordered couples of levels of two (E, 2), in the unit cube.

    n_poles: 1 or 2; every other number counts as 2.
    """
    levels = np.linspace(0, 1, REAL_LEVELS)
    if n_poles == 1:
        return levels[:, np.newaxis]
    # The search space maps (x1, x2) to levels x1 and x1 + (1 - x1) x2; (1, x2) is two equal poles at the top.
    points = []
    for low, high in combinations_with_replacement(levels, 2):
        above_low = 0.0 if low == 1 else (high - low) / (1 - low)
        points.append([low, above_low])
    return np.array(points)


@dataclass(frozen=True, eq=False)
class SearchStage:
    """One global search: D coordinates of E points in the order of evaluation, and their costs.

    Attributes
    ----------
    title : str
        Numbers of poles that were sought, as "2 real, 1 pairs".
    coordinate_names : tuple of str
        D names with units.
    points : (E, D) array
        Coordinates in the units that their names say, not of the unit cube.
    log_cost : (E,) array
        Natural logarithm of J.
    """

    title: str
    coordinate_names: tuple[str, ...]
    points: RealArray
    log_cost: RealArray

    def __post_init__(self) -> None:
        """Locked arrays; ValueError where their shapes do not fit together."""
        object.__setattr__(self, "coordinate_names", tuple(self.coordinate_names))
        lock(self, "points", "log_cost")
        expected = (self.log_cost.size, len(self.coordinate_names))
        if self.points.shape != expected:
            raise ValueError(f"points must be ({expected[0]}, {expected[1]}); got {self.points.shape}")


@dataclass(frozen=True, eq=False)
class PolishedMinimum:
    """End of one descent: name of the step, the poles it reached (fixed first) and their residual sum of
    squares J."""

    stage: str
    poles: Poles
    rss: float


@dataclass(frozen=True, eq=False)
class SearchTrace:
    """What a search did on the way to one identification.

    Attributes
    ----------
    stages : tuple of SearchStage
        Global searches.
    minima : tuple of PolishedMinimum
        Ends of descents, in order.
    warnings : tuple of Finding
        On poles at a bound and the like; empty where a later step looks for them.
    evaluations : int
        Of the cost, rescans and descents included.
    """

    stages: tuple[SearchStage, ...]
    minima: tuple[PolishedMinimum, ...]
    warnings: tuple[Finding, ...]
    evaluations: int
