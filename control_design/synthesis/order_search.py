"""Search for the controller of one order and structure with the smallest worst case.

The worst case gamma of a parameter vector has many local minima. `OrderSearch` finds good ones in two ways.
`quick` begins at controllers of any order (from the Youla bound, `youla_starts`), fitted by the structure,
and says whether the search may end with what they lead to. `run` begins at many random and shaped loops
(`starts`) and at controllers of a lower order. Both send each start down with `MinimaxDescent`.

Descents see the worst case on a lean grid of frequencies only. What ends best is then improved by exchange
(`_exchange`): frequencies at which the dense grid shows a larger worst case join the lean grid, and the
descents go on. So two numbers belong to every end: `gamma_grid`, of the lean grid, and `gamma`, of the dense
one.

The constants below are efforts: larger ones take more time and may find a better valley. "Doubled" says what
became of the worst cases of five designs: two of random plants, two dampings of an arm, one that integrates.
"""

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
from control_design.synthesis.youla_starts import FreeController, FreeControllers, fitted

# Called with the share that is done, 0 to 1, and a message for the user.
Progress = Callable[[float, str], None]

# Steps of a descent. Of 700 descents 95 % ended by themselves within 60; one in a hundred is cut off.
_STEPS = 100
# Shaped loops that are drawn, of which the best are started from. Each costs 1 ms.
_SHAPED_DRAWS = 200
# Starts of little gain where tracking is asked, beside the shaped ones. Doubled, nothing moves.
_LOW_GAIN_STARTS = 4
# Ends that are carried through the exchange, and shaped loops that are started from where tracking is asked.
# Doubled, one is 3 % higher and the others as they are, in a third more time.
_CARRIED = 3
# Random neighbours of the best end that are started from, in the first round of exchange. Doubled, nothing
# moves.
_FIRST_HOPS = 4
# Random neighbours in later rounds, which begin nearer to the optimum. Doubled, nothing moves.
_LATER_HOPS = 2
# Halvings of a random hop until it is stable. Natural units of a section far from the crossover are far too
# large.
_HALVINGS = 20
# Rounds for ends that are good on the lean grid and not robustly stable between its points. Doubled, nothing
# moves.
_RETRIEVALS = 3
# Factor on the gain of an end that is to be retrieved, again and again until it is stable on the finer grid:
# less gain moves most loops away from -1. Chosen.
_RETREAT = 0.8
# How often that factor is applied at most: 1 % of the gain is left then.
_RETREATS = 20
# Rounds of exchange for the best end by itself: a limit for grids that never agree. Chosen.
_FINISHING = 10
# Ratio of two worst cases up to which both count as the same local minimum: twice what the exchange accepts
# (EXCHANGE_TOLERANCE).
_AGREE = 1.001
# Least damping ratio of fitted poles: a narrow resonance of a start stays, and hides between grid points.
# Chosen.
_NO_RESONANCE = 0.3
# Rounds of fits with random weights over frequency, after the one that weighs all relative errors alike: a
# low order can do without some frequencies. Chosen.
_WEIGHTED_ROUNDS = 3
# Steps that every fit gets before the best of a round goes on alone. Read off the paths of random designs 0
# to 21: after ten it mostly, not always, leads to the best end of its round; after five less often.
_TRIAL_STEPS = 10
# Shaped loops that are drawn where ten steps choose between them. Doubled, nothing moves.
_ROUGH_DRAWS = 50
# Worst case over that of the small Youla problem (`youla_starts`) at which a search may end: what a further
# search could gain is at most these 3 %. Chosen.
_NEAR = 1.03
# Worst case over that of the small Youla problem up to which agreeing ends may end the search before all
# kinds of starts were tried: agreement allows for a little more than `_NEAR`. Chosen.
_FAIR = 1.05
# How far the small problem's worst case lies above that of the default one, at most: 8 % were seen
# (`youla_starts`). A design below both shows that the small problem has ended in a valley of its own, and
# that its value is no bound.
FINER = 1.1


@dataclass(frozen=True, eq=False)
class TriedController:
    """Where the descent from one start ended.

    Attributes
    ----------
    parameters : ndarray, shape (n,)
        Of the cascade.
    gamma_grid : float
        Worst case on the lean grid of that descent; inf: unstable.
    gamma : float
        Worst case on the dense grid; inf: not robustly stable there, or not checked.
    """

    parameters: Real
    gamma_grid: float
    gamma: float


@dataclass(frozen=True, eq=False)
class OrderResult:
    """What the search of one order found.

    Attributes
    ----------
    best : TriedController or None
        None: nothing was robustly stable on the dense grid.
    reports : tuple of StartReport
        One for each descent, in the order in which they were run.
    history : tuple of float
        Dense worst case of the best after the starts and after every round of exchange.
    nearest : ndarray, shape (n,), or None
        Without a best: parameters of the end that came nearest to a robustly stable loop.
    """

    best: TriedController | None
    reports: tuple[StartReport, ...]
    history: tuple[float, ...]
    nearest: Real | None = None


class OrderSearch:
    """Searches for the parameters of one cascade on one problem.

    Parameters
    ----------
    problem : Problem
        Plants, requirements (`spec`), effort (`options`), and lean grids `grids`, one array in rad/s for each
        plant, which grow while this searches.
    cascade : Cascade
        Sections of the controller.
    rng : numpy.random.Generator
        All starts and hops are drawn from it.
    tell : Progress
        Called with the share that is done and a message.
    known_starts : sequence of ndarray, shape (n,)
        Parameter vectors that are good already, from a lower order; the first is checked before any descent.
    """

    def __init__(
        self,
        problem: Problem,
        cascade: Cascade,
        rng: np.random.Generator,
        tell: Progress,
        known_starts: Sequence[Real] = (),
    ) -> None:
        """Keep the arguments; nothing is run yet."""
        self.problem = problem
        self.cascade = cascade
        self.rng = rng
        self.tell = tell
        self.known_starts = known_starts
        self.options = problem.options
        self.spec = problem.spec
        self.reports: list[StartReport] = []
        # Lean grids and the descent on them, which takes a while to build.
        self._latest_descent: tuple[list[Real], MinimaxDescent] | None = None

    # The three searches

    def run(self) -> OrderResult:
        """Best controller from many starts: descent from each, then exchange with hops.

        Returns
        -------
        OrderResult
            Ends early where a controller is good enough (`options.sufficient_gamma`). There always is a
            start, as options ask for at least one. Without a best where nothing is robustly stable.
        """
        ends: list[TriedController] = []
        for x in self.known_starts[:1]:
            grid_gamma = self._descent().value(x)
            ends.append(TriedController(x, grid_gamma, self.problem.gamma(self.cascade, x)))
        if self._good_enough(ends):
            return OrderResult(ends[0], (), (ends[0].gamma,))

        starts = self._starts()
        # Agreement counts not before half of the starts, and three, were tried: the first ones may be of one
        # kind.
        drawn = len(starts) - len(self.known_starts)
        fewest_starts = len(self.known_starts) + max((drawn + 1) // 2, min(drawn, 3))
        ends_of_starts: list[TriedController] = []
        for number, start in enumerate(starts, 1):
            end = self._end(start)
            self.tell(0.5 * number / len(starts), f"start {number} of {len(starts)}")
            ends_of_starts.append(end)
            ends.append(end)
            if self._good_enough(ends):
                best = min(ends, key=lambda end: end.gamma)
                return OrderResult(best, tuple(self.reports), (best.gamma,))
            if number >= fewest_starts and self._agree(ends):
                break

        stable_ends = self._retrieved(ends)
        if not stable_ends:
            return OrderResult(None, tuple(self.reports), (), self._nearest(ends_of_starts))
        return self._exchange(stable_ends)

    def quick(
        self,
        bound: Callable[[], FreeControllers],
        known: Sequence[FreeController] = (),
        *,
        is_trial: bool = False,
    ) -> tuple[OrderResult, bool]:
        """Best controller from those of the Youla bound, and whether the search may end with it.

        Parameters
        ----------
        bound : callable
            Gives responses of controllers of any order, and `gamma`, the worst case that they reach; inf:
            none is known, nothing counts as near it. Called once, if at all.
        known : sequence of FreeController
            Responses of controllers that are tried first.
        is_trial : bool
            Only whether the result is good enough counts: nothing is improved by exchange that cannot become
            so by it.

        Returns
        -------
        result : OrderResult
            Without a best where no start led to a loop that is robustly stable on the dense grid.
        settled : bool
            The result is good enough, or lies within `_NEAR` of `free.gamma`, or meets the specification with
            as many ends agreeing on it as are asked.

        Notes
        -----
        Rounds of starts, each a race (`_raced`): one fit of each free controller, then fits with random
        weights over frequency `_WEIGHTED_ROUNDS` times, then shaped and random loops. A round may be the last
        if the best end so far is near `free.gamma` and meets the specification: a design that misses it gets
        all fits, as another valley may meet it. It may also be the last if the ends agree on a design that
        meets the specification within `_FAIR` of `free.gamma`.
        """
        ends: list[TriedController] = []
        if known:
            ends = self._raced(self._fits(FreeControllers(tuple(known), np.inf), weighted=False))
            if self._good_enough(ends):
                best = min(ends, key=lambda end: end.gamma)
                return OrderResult(best, tuple(self.reports), (best.gamma,)), True
        free = bound()

        def near_free(gamma: float) -> bool:
            """Whether a worst case is within `_NEAR` of the bound, and not so far below it (`FINER`) that
            the bound cannot be one; False for an infinite bound."""
            return free.gamma / FINER <= gamma <= _NEAR * free.gamma < np.inf

        def agreed(gamma: float, fair: float = np.inf) -> bool:
            """Whether enough ends agree and gamma meets the specification, within fair times the bound (by
            default whatever the bound)."""
            return gamma <= min(1.0, fair * free.gamma) and self._agree(ends)

        rounds = _WEIGHTED_ROUNDS + 2
        for number in range(rounds):
            least = min((end.gamma_grid for end in ends), default=np.inf)
            all_fits_tried = number > _WEIGHTED_ROUNDS
            may_end_near = least <= 1.0 or all_fits_tried
            if self._good_enough(ends) or agreed(least, _FAIR) or (may_end_near and near_free(least)):
                break
            # Five rounds are half of the search, the exchange is the other half.
            self.tell(0.1 * number, f"start {number + 1} of {rounds}, from controllers of any order")
            starts = self._other_starts() if all_fits_tried else self._fits(free, weighted=number > 0)
            ends = ends + self._raced(starts)

        stable_ends = self._retrieved(self._checked(ends))
        if not stable_ends:
            nearest = self._nearest(ends) if ends else None
            return OrderResult(None, tuple(self.reports), (), nearest), False
        # More frequencies on the lean grid raise an optimum: exchange brings no end below what it has there.
        least = min(end.gamma_grid for end in stable_ends)
        if is_trial and least > self.options.sufficient_gamma:
            best = stable_ends[0]
            return OrderResult(best, tuple(self.reports), (best.gamma,)), True
        result = self._exchange(stable_ends, hops=False)
        assert result.best is not None
        gamma = result.best.gamma
        settled = self._good_enough([result.best]) or near_free(gamma) or agreed(gamma)
        return result, settled

    def fits_only(self, free: FreeControllers) -> OrderResult:
        """Best controller from one fit of each free controller and from the known starts: one race.

        Parameters
        ----------
        free : FreeControllers
            Its responses; the bound itself does not count.

        Returns
        -------
        OrderResult
            Without a best, and without a nearest, where nothing is robustly stable on the dense grid.
        """
        starts = [*self.known_starts, *self._fits(free, weighted=False)]
        ends = self._retrieved(self._checked(self._raced(starts)))
        if not ends:
            return OrderResult(None, tuple(self.reports), ())
        return self._exchange(ends, hops=False)

    # Starts

    def _fits(self, free: FreeControllers, *, weighted: bool) -> list[Real]:
        """Parameters (n,) of a stable fit of each free controller that has one, if with less gain.

        weighted: errors are weighted over frequency at random, else all relative errors alike. No fit for a
        cascade of parts.
        """
        # Clear of the bound on the controller's damping by 1 %: a start on it has no room to move.
        asked_damping = self.spec.controller_damping or 0.0
        damping = max(1.01 * asked_damping, _NO_RESONANCE)
        rng = self.rng if weighted else None
        fits = [fitted(self.cascade, each, least_damping=damping, rng=rng) for each in free.each]
        worst_case = self._descent().value
        stable = []
        for x in fits:
            if x is None:
                continue
            start = x if np.isfinite(worst_case(x)) else self._retreat(x)
            if start is not None:
                stable.append(start)
        return stable

    def _other_starts(self) -> list[Real]:
        """Parameters (n,) of a few shaped loops and random ones of little gain; none for unstable plants."""
        if any(plant.unstable_poles for plant in self.problem.plants):
            return []
        maker = self._maker()
        shaped = [x for x, _ in maker.shaped(_ROUGH_DRAWS, _CARRIED)]
        return shaped + [maker.low_gain() for _ in range(min(self.options.starts, _CARRIED))]

    def _starts(self) -> list[Real]:
        """Parameters (n,) of all starts of `run`: the known ones first, then those that are drawn.

        At least one is drawn. For unstable plants they are loops that were led to stability; not all of
        these, nor of the random ones, are stable.
        """
        maker = self._maker()
        if any(plant.unstable_poles for plant in self.problem.plants):
            stabilised = maker.stabilising(self._radius, max(self.options.starts, _CARRIED))
            return [*self.known_starts, *stabilised]
        shaped = [x for x, _ in maker.shaped(_SHAPED_DRAWS, self.options.starts)]
        random = [maker.low_gain() for _ in range(self.options.starts)]
        if self.problem.asks_tracking:
            return [*self.known_starts, *random[:_LOW_GAIN_STARTS], *shaped[:_CARRIED]]
        # In turn, so that an early end has seen both kinds.
        mixed: list[Real] = []
        for pair in zip_longest(shaped, random):
            mixed += [start for start in pair if start is not None]
        return [*self.known_starts, *mixed]

    def _maker(self) -> StartMaker:
        """Source of random starts, scored on the lean grids as they are now; it does not follow their
        growth."""
        return StartMaker(
            self.cascade,
            self.problem.lean(),
            self.problem.integrators,
            self._descent().value,
            self.rng,
            controller_damping=self.spec.controller_damping,
            keeps_sign=self.problem.asks_tracking or self.problem.integrators > 0,
        )

    # Descents

    def _descent(self) -> MinimaxDescent:
        """Descent on the lean grids as they are now; built again only when they have changed."""
        grids = list(self.problem.grids)
        if self._latest_descent is not None:
            known_grids, known_descent = self._latest_descent
            if all(map(np.array_equal, known_grids, grids)):
                return known_descent
        descent = MinimaxDescent(
            self.cascade,
            self.problem.rows(grids),
            partial(self.problem.stable, self.cascade),
            controller_damping=self.spec.controller_damping,
        )
        self._latest_descent = (grids, descent)
        return descent

    def _end(self, start: Real, steps: int = _STEPS, *, checked: bool = True) -> TriedController:
        """Where the descent from a start (n,) ends after at most so many steps; its report is noted.

        checked: gamma of the dense grid, too; without it that is inf.
        """
        x, gamma_grid, steps_taken = self._descent().run(start, steps)
        gamma = np.inf
        if checked and np.isfinite(gamma_grid):
            gamma = self.problem.gamma(self.cascade, x)
        # Reports are stored as JSON, which knows no infinity.
        reported_gamma = gamma if np.isfinite(gamma) else None
        report = StartReport("descent", steps_taken, min(gamma_grid, LARGEST_GAMMA), reported_gamma)
        self.reports.append(report)
        return TriedController(x, gamma_grid, gamma)

    def _raced(self, starts: Sequence[Real]) -> list[TriedController]:
        """Where `_TRIAL_STEPS` steps lead from each start, and for the best of them a whole descent.

        In ascending order of gamma_grid after the trial steps; empty without starts. Not checked on the dense
        grid, unless the best is good enough on the lean one to end the search.
        """
        trials = [self._end(x, _TRIAL_STEPS, checked=False) for x in starts]
        trials.sort(key=lambda end: end.gamma_grid)
        if trials and np.isfinite(trials[0].gamma_grid):
            trials[0] = self._end(trials[0].parameters, checked=False)
            if trials[0].gamma_grid <= self.options.sufficient_gamma:
                trials[:1] = self._checked(trials[:1])
        return trials

    # Judgement of ends

    def _checked(self, ends: Sequence[TriedController]) -> list[TriedController]:
        """Ends in different minima with their gamma on the dense grid, best on the lean grid first.

        Stops once `_CARRIED` of them are robustly stable there, as the dense check is the dearer one. Ends
        that are unstable on the lean grid are left out; of none, none.
        """
        checked: list[TriedController] = []
        for end in different(ends, len(ends), on_grid=True):
            if np.isfinite(end.gamma_grid):
                dense_gamma = self.problem.gamma(self.cascade, end.parameters)
                checked.append(replace(end, gamma=dense_gamma))
            stable = sum(np.isfinite(end.gamma) for end in checked)
            if stable == _CARRIED:
                break
        return checked

    def _good_enough(self, ends: Sequence[TriedController]) -> bool:
        """Whether the smallest dense gamma is one at which the user wants the search to stop: at most
        `sufficient_gamma`, which is 0 by default, for never. False without ends."""
        return min((end.gamma for end in ends), default=np.inf) <= self.options.sufficient_gamma

    def _agree(self, ends: Sequence[TriedController]) -> bool:
        """Whether enough descents ended at the best value: more of them would hardly find another.

        Enough are `agreeing_starts` within `_AGREE` of the smallest gamma_grid. Without a stable end none
        agrees, and the answer is False.
        """
        stable = [end.gamma_grid for end in ends if np.isfinite(end.gamma_grid)]
        agreeing = sum(gamma <= min(stable) * _AGREE for gamma in stable)
        return agreeing >= self.options.agreeing_starts

    def _nearest(self, ends: Sequence[TriedController]) -> Real:
        """Parameters (n,) of the end nearest to a robustly stable loop.

        That is the smallest gamma_grid; where none is stable on the lean grid, the smallest pole modulus. At
        least one end, else ValueError of an empty minimum.
        """
        nearest = min(ends, key=lambda end: (end.gamma_grid, self._radius(end.parameters)))
        return nearest.parameters

    def _radius(self, parameters: Real) -> float:
        """Largest pole modulus of all nominal loops, in z, under parameters (n,); below 1: stable, inf for an
        algebraic loop."""
        poles_of_loops = self.problem.closed_loop_poles(self.cascade, parameters)
        return max(float(np.max(np.abs(poles), initial=0.0)) for poles in poles_of_loops)

    # From the lean grid to the dense one

    def _retrieved(self, ends: Sequence[TriedController]) -> list[TriedController]:
        """Ends that are stable on the dense grid, best first, with those of the others that could be saved.

        An end that is better on the lean grid than the best, and reaches -1 between its points, has found a
        valley worth having: the frequencies that it violates join the lean grid, and it goes on from there,
        with less gain at first. At most `_CARRIED` at a time, `_RETRIEVALS` times. Empty where no end is
        stable on the dense grid and none could be saved; an end that was not checked there counts as lost.
        """
        stable = [end for end in ends if np.isfinite(end.gamma)]
        lost = _lost_between_points(ends)
        for _ in range(_RETRIEVALS):
            limit = min((end.gamma for end in stable), default=np.inf) * (1 - EXCHANGE_TOLERANCE)
            promising = [end for end in lost if end.gamma_grid < limit]
            lost = different(promising, _CARRIED, on_grid=True)
            if not lost or self._good_enough(stable):
                break
            for end in lost:
                self.problem.add_violated(self.cascade, end.parameters, end.gamma_grid)
            retreats = [self._retreat(end.parameters) for end in lost]
            new_ends = [self._end(x) for x in retreats if x is not None]
            stable += [end for end in new_ends if np.isfinite(end.gamma)]
            lost = _lost_between_points(new_ends)
        return sorted(stable, key=lambda end: end.gamma)

    def _retreat(self, parameters: Real) -> Real | None:
        """Parameters (n,) with as little less gain as makes them stable on the lean grids.

        None where `_RETREATS` steps do not, as of unstable plants, and of a Kp that is fixed, so that the
        gain does not change.
        """
        for number in range(1, _RETREATS + 1):
            trial = with_gain(self.cascade, parameters, _RETREAT**number)
            if np.isfinite(self._descent().value(trial)):
                return trial
        return None

    def _exchange(self, ends: list[TriedController], *, hops: bool = True) -> OrderResult:
        """Best end after rounds of adding violated frequencies to the lean grid and descending again.

        ends: stable on the dense grid, best first, at least one. Several are carried along at first, one less
        in each round: the best on a coarse grid is often not the best on a finer one. hops: random neighbours
        of the best are started from as well, which may lie in a better valley.
        """
        tolerance = EXCHANGE_TOLERANCE
        history = [ends[0].gamma]
        pool = different(ends, _CARRIED)
        new_ends: list[TriedController] = []
        for number in range(self.options.exchange_rounds):
            self.tell(0.5 + 0.5 * number / self.options.exchange_rounds, f"exchange {number + 1}")
            if self._good_enough(pool):
                break

            # Frequencies that new ends violate count, too: better on the grid and worse between its points,
            # such an end may win yet.
            added = 0
            for end in different([*pool, *new_ends], _CARRIED):
                added += self.problem.add_violated(self.cascade, end.parameters, end.gamma_grid)
            if added == 0 and number > 0:
                break

            # Starts of this round: the pool, a new end that was better on the grid, and hops.
            starts = [end.parameters for end in pool]
            if new_ends:
                best_on_grid = min(new_ends, key=lambda end: end.gamma_grid)
                if best_on_grid.gamma_grid < pool[0].gamma * (1 - tolerance):
                    starts.append(best_on_grid.parameters)
            hop_count = 0
            if hops:
                hop_count = min(_FIRST_HOPS if number == 0 else _LATER_HOPS, self.options.starts)
            starts += [self._hop(pool[0].parameters) for _ in range(hop_count)]

            # Descents on the finer grid. In the first round, hops end where enough ends agree.
            new_ends = []
            for position, start in enumerate(starts):
                new_ends.append(self._end(start))
                if number == 0 and position >= len(pool) and self._agree(new_ends):
                    break
            retrieved = self._retrieved([pool[0], *new_ends])
            new_ends = [end for end in retrieved if end is not pool[0]]

            # The pool of the next round. More frequencies raise an optimum: what lies above the best already
            # stays there.
            pool = different([*pool, *new_ends], max(1, _CARRIED - 1 - number))
            best_gamma = pool[0].gamma
            pool = pool[:1] + [end for end in pool[1:] if end.gamma_grid <= best_gamma]
            history.append(best_gamma)

            # Settled: no new end promises more on its grid, and the round has gained nothing.
            least_on_grid = min([end.gamma_grid for end in new_ends], default=np.inf)
            promises_nothing = least_on_grid > best_gamma * (1 - tolerance)
            gained_nothing = history[-1] > history[-2] * (1 - tolerance)
            if number > 0 and promises_nothing and gained_nothing:
                break

        best = self._finished(pool[0])
        if best.gamma < history[-1]:
            history.append(best.gamma)
        return OrderResult(best, tuple(self.reports), tuple(history))

    def _finished(self, best: TriedController) -> TriedController:
        """Best of an end (gamma finite) and its improvements, by exchange until dense check and lean grid
        agree, at most `_FINISHING` times, or an improvement is not robustly stable between grid points."""
        current = best
        for _ in range(_FINISHING):
            grids_agree = current.gamma <= current.gamma_grid * (1 + EXCHANGE_TOLERANCE)
            if grids_agree or self._good_enough([best]):
                break
            self.problem.add_violated(self.cascade, current.parameters, current.gamma_grid)
            current = self._end(current.parameters)
            if not np.isfinite(current.gamma):
                break
            best = min(best, current, key=lambda end: end.gamma)
        return best

    def _hop(self, parameters: Real) -> Real:
        """Random neighbour (n,) of parameters (n,), moved by a tenth to one natural unit in every parameter.

        Moved less until it is stable, at most `_HALVINGS` times; then it is nearly where it began.
        """
        # A tenth to one: less leads back to the same minimum, more is mostly unstable. Chosen.
        size = 10 ** self.rng.uniform(-1.0, 0.0)
        direction = self.rng.standard_normal(parameters.size) * natural_units(self.cascade, parameters)
        for _ in range(_HALVINGS):
            if np.isfinite(self._descent().value(parameters + size * direction)):
                break
            size *= 0.5
        return np.asarray(parameters + size * direction, dtype=np.float64)


def _lost_between_points(ends: Sequence[TriedController]) -> list[TriedController]:
    """Ends that are stable on the lean grid and not robustly stable on the dense one, or not checked
    there."""
    return [end for end in ends if np.isfinite(end.gamma_grid) and not np.isfinite(end.gamma)]


def different(
    candidates: Sequence[TriedController], most: int, *, on_grid: bool = False
) -> list[TriedController]:
    """Candidates in different local minima, the best first.

    Parameters
    ----------
    candidates : sequence of TriedController
    most : int
        Candidates that are returned at most; at least 1, as 0 is no limit.
    on_grid : bool
        Judged by `gamma_grid` instead of `gamma`.

    Returns
    -------
    list of TriedController
        Of two whose worst cases differ by less than .1 % only the better one: the same minimum twice teaches
        nothing. Of infinite ones at most one, at the end. Worst cases are positive: a better one of 0 is a
        division by zero.
    """
    gamma = attrgetter("gamma_grid" if on_grid else "gamma")
    selected: list[TriedController] = []
    for candidate in sorted(candidates, key=gamma):
        differences = [abs(gamma(candidate) / gamma(other) - 1) for other in selected]
        if all(difference > _AGREE - 1 for difference in differences):
            selected.append(candidate)
        if len(selected) == most:
            break
    return selected
