"""How many poles: stepwise from the data, or the numbers asked for.

`OrderSelection.run` begins with one mode and a few real poles, adds pairs and real poles as long as an
information criterion falls, and takes out what it does not miss. The criterion is Ne ln(J / N) + (free
numbers) ln Ne (Schwarz, Annals of Statistics 6(2), 1978), J the residual sum of squares of N samples and Ne
the independent samples that the residual of the chosen model is worth, so that coloured noise asks for no
further poles. `exchanged` and `with_real` put poles of one type in the place of others, which growing alone
does not do. Poles are found by `ident.search.pole_search`; fixed ones come first of each type, are never
moved, and not counted here.

`Refined`, of another file, is the end of a descent: its `poles`, fixed ones first of each type, and `rss`,
their J. `PoleProblem` is what is searched: `n_samples` N, free numbers of a fit (`n_parameters`), `power` of
the output. The data have more samples than unknowns for a first model: callers refuse others before; here too
few samples end the growth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.data.arrays import ComplexArray
from ident.fit.least_squares import EXPLAINED
from ident.fit.problem import PoleProblem
from ident.fit.refinement import Refined
from ident.search.pole_search import FINE, GAIN, PoleSearch

# (fraction 0..1, message) of a search that goes on.
Progress = Callable[[float, str], None]
# (J, order) -> criterion of that model, lower is better (`ident.fit.problem.PoleProblem.criterion`).
Criterion = Callable[[float, int], float]

# Real poles of the first global search where their number is free. Chosen: two, for what decays slowly and
# fast beside a mode; what is too much is pruned, what is missing comes one by one.
FIRST_REAL = 2

# Pairs of that search: one, then pair by pair. A joint search of several has never found the best: of
# problems with three and five modes 0 of 32, pair by pair 32 of 32.
FIRST_PAIRS = 1
# Rounds of growing and pruning at most: after a pole was pruned another one may be worth adding. Chosen.
MOST_ROUNDS = 3
# Samples for each free number that a model with a further pair has at least. Chosen: with so few the price of
# the criterion, which holds for many samples, is too low.
SAMPLES_PER_NUMBER = 2
# Share of J that is left to gain when a descent ends that only asks which pole can be spared: at 1000 samples
# the criterion is then known to .1, far below the price of a pole.
SPARING = 1e-4
# Exchanges of a pole for another at most. A bound on time: they end where one gains nothing.
MOST_EXCHANGES = 4
# Damping ratio above which a pair does what real poles do: its step overshoots by less than 0.2 %.
NO_OVERSHOOT = 0.9
# Factor between a rate of decay and those of two real poles that start to both sides of it. Chosen: apart
# enough for a descent not to let them meet, near enough for the same valley.
APART = 1.5
# Share of their distance from one by which poles differ that have met: descents end alike to 1e-9 of J, so to
# about its square root.
MET = 1e-4


def silent(fraction: float, message: str) -> None:
    """Nothing: the default progress, to which nobody listens; anything is taken."""


@dataclass(frozen=True)
class OrderStep:
    """One structure that a selection looked at.

    Attributes
    ----------
    n_real, n_pairs : int
        Numbers of searched poles; fixed ones do not count.
    rss : float
        Least residual sum of squares J that was found with so many.
    criterion : float
        Ne ln(J / N) + (2 n + nuisances) ln Ne: a pole costs itself and a coefficient, and one number for each
        record whose initial state is estimated. Ne: independent samples that the chosen model's residual is
        worth.
    """

    n_real: int
    n_pairs: int
    rss: float
    criterion: float

    @property
    def order(self) -> int:
        """Number of searched poles, a pair counted twice."""
        return self.n_real + 2 * self.n_pairs


class PoleCounts(NamedTuple):
    """Numbers of searched real poles and of searched pairs."""

    real: int
    pairs: int


class OrderSelection:
    """Growth and pruning of the set of poles of one search.

    Parameters
    ----------
    search : PoleSearch
        Finds poles and refines them; its options state numbers of poles, or most of them.
    progress : Progress
        Told how far the selection is, 0 .. 1, with a short message.
    """

    def __init__(self, search: PoleSearch[PoleProblem], progress: Progress = silent) -> None:
        """Nothing is looked at yet, and nothing is checked."""
        self.search = search
        self.options: IdentOptions = search.options
        self.progress = progress
        self._least_rss: dict[PoleCounts, float] = {}

    def run(self, start: Refined | None = None) -> Refined:
        """End with the numbers of poles asked for, or with those the criterion keeps.

        Parameters
        ----------
        start : Refined, optional
            Poles to go on from, such as those found under another structure; default: a global search.

        Returns
        -------
        Refined
            Poles, fixed ones first, and J.

        Raises
        ------
        ValueError
            Stated bounds leave no box to search in (`search_space`). A `start` with other poles than the
            stated ones is not refused.
        """
        options = self.options
        most_pairs = options.max_pairs if options.n_pairs is None else options.n_pairs
        # Places on the bar of progress are chosen, and decide nothing.
        self.progress(0.05, "global search for the first poles")
        if start is None:
            n_real = min(FIRST_REAL, options.max_real) if options.n_real is None else options.n_real
            start = self.search.joint(n_real, min(FIRST_PAIRS, most_pairs))
        best = self._noted(self.search.rescan(start))
        for _ in range(MOST_ROUNDS):
            order_before = best.poles.order
            with_pairs = self._grown_by_pairs(best, most_pairs)
            best = self.pruned(self._grown_by_real(with_pairs))
            # From where no pair was to be added, none will be: a second look would end the same.
            if best is with_pairs or best.poles.order == order_before:
                break
        return best

    def _grown_by_pairs(self, best: Refined, most_pairs: int) -> Refined:
        """End with further pairs, one by one: as many as asked for, or as long as the criterion falls.

        most_pairs: searched pairs at most. `best` where it has so many, or the samples tell no further one.
        """
        while self._counts(best).pairs < most_pairs and self._visible(best):
            n_pairs = self._counts(best).pairs
            # Between a tenth and nine tenths of the bar of progress; chosen.
            self.progress(0.1 + 0.8 * n_pairs / max(most_pairs, 1), f"search for pole pair {n_pairs + 1}")
            trial = self._noted(self.search.rescan(self.search.add_pair(best.poles)))
            if self.options.n_pairs is None and not self._better(trial, best):
                break
            is_last = n_pairs == most_pairs - 1
            if n_pairs > 0 and is_last:
                trial = self._or_split(best, trial)
            best = trial
        return best

    def _or_split(self, smaller: Refined, larger: Refined) -> Refined:
        """`larger`, or the smaller model with one pair as two where that leaves less.

        Only with a stated number of pairs, the last of which `larger` may have spent on something else, and
        where it leaves something to explain. `smaller` has a searched pair (ValueError of `min` without):
        `larger` is not its first.
        """
        if self.options.n_pairs is None or self.search.is_trusted(larger):
            return larger
        split = self._noted(self.search.split_pair(smaller.poles))
        return min(larger, split, key=lambda end: end.rss)

    def _grown_by_real(self, best: Refined) -> Refined:
        """End with further real poles, one by one, as long as the criterion falls; a stated number is kept.

        `best` itself where none gains, or where there are `max_real`.
        """
        if self.options.n_real is not None:
            return best
        while self._counts(best).real < self.options.max_real and self._visible(best):
            trial = self._noted(self.search.rescan(self.search.add_real(best.poles)))
            if not self._better(trial, best):
                break
            best = trial
        return best

    def pruned(self, best: Refined) -> Refined:
        """End without the poles whose loss the criterion does not mind, the least needed first.

        Poles of a type whose number is stated stay. `best` itself where every pole is needed, or there is
        none.
        """
        real_is_free = self.options.n_real is None
        pairs_are_free = self.options.n_pairs is None
        while True:
            trials = self._one_less(best.poles, real_is_free, pairs_are_free)
            if not trials:
                return best
            chosen = self._likeliest(best, trials, "pruning", SPARING)
            if chosen is best:
                return best
            best = self._noted(self.search.descend(chosen.poles, "pruning"))

    def exchanged(self, best: Refined) -> Refined:
        """End with one pole more and the least needed one less, as often as that gains.

        A pair may stand where two real poles should. Not for records, where the pole gained may follow
        friction. `best` itself where nothing gains.
        """
        for _ in range(MOST_EXCHANGES):
            if not self._visible(best):
                break
            counts = self._counts(best)
            larger = [self.search.add_pair(best.poles)]
            if counts.real:
                larger.append(self.search.add_real(best.poles))
            ends = [self._reduced(end, counts) for end in larger]
            exchanged = min(ends, key=lambda end: end.rss)
            if not exchanged.rss < best.rss * (1 - GAIN):
                break
            best = self._noted(self.search.rescan(exchanged))
        return best

    def _reduced(self, end: Refined, counts: PoleCounts) -> Refined:
        """End with poles taken out one by one down to `counts`, first the one whose loss costs least.

        Where a type has fewer poles than `counts` nothing is added.
        """
        while True:
            present = self._counts(end)
            trials = self._one_less(end.poles, present.real > counts.real, present.pairs > counts.pairs)
            if not trials:
                return self.search.descend(end.poles, "exchange")
            ends = [self.search.descend(poles, "exchange", SPARING) for poles in trials]
            end = min(ends, key=lambda trial: trial.rss)

    def with_real(self, best: Refined) -> Refined:
        """End with one real pole or two in the place of each pair without any overshoot, if that is likelier.

        As long as the criterion falls: what grows pair by pair makes such pairs of real poles. Then poles
        that have met are parted (`_parted`). With stated numbers of poles `best` stays. Without such pairs
        and such poles `best` is returned.
        """
        while self.options.n_real is None and self.options.n_pairs is None:
            poles = best.poles
            trials = []
            for index in range(self.search.fixed.pairs.size, poles.pairs.size):
                log = np.log(poles.pairs[index])
                rate = abs(log)
                damping_ratio = -log.real / rate
                if damping_ratio > NO_OVERSHOOT:
                    without = poles.without_pair(index)
                    trials.append(without.appended(_real_poles(rate, [1.0])))
                    trials.append(without.appended(_real_poles(rate, [1.0 / APART, APART])))
            chosen = self._likeliest(best, trials, "real poles of a pair")
            if chosen is best:
                break
            best = self.pruned(chosen)
        return self._parted(best)

    def _parted(self, best: Refined) -> Refined:
        """End without poles that have met: a descent does not part them, and they have no residue each.

        One in the place of two, or two real poles further apart, whichever the criterion prefers. `best`
        where no poles have met, or their numbers are stated. Met: nearer than `MET` times their distance from
        1; one couple is parted, others are left.
        """
        fixed = self.search.fixed
        poles = best.poles
        if self.options.n_real is not None or self.options.n_pairs is not None:
            return best
        real = _met(poles.real[fixed.real.size :].astype(complex))
        pair = _met(poles.pairs[fixed.pairs.size :])
        if real is not None:
            at = fixed.real.size + real
            one_less = poles.without_real(at)
            twin = int(np.argmin(np.abs(one_less.real - poles.real[at])))
            without_both = one_less.without_real(twin)
            rate = -np.log(poles.real[at])
        elif pair is not None:
            at = fixed.pairs.size + pair
            one_less = poles.without_pair(at)
            twin = int(np.argmin(np.abs(one_less.pairs - poles.pairs[at])))
            without_both = one_less.without_pair(twin)
            rate = abs(np.log(poles.pairs[at]))
        else:
            return best
        apart = without_both.appended(_real_poles(rate, [1 / APART, APART]))
        ends = [self._noted(self.search.descend(trial, "poles apart")) for trial in (one_less, apart)]
        criterion = self._criterion(best)
        return min(ends, key=lambda end: criterion(end.rss, end.poles.order))

    def table(self, best: Refined) -> tuple[OrderStep, ...]:
        """Every structure that was looked at, by order, judged by the residual of the chosen model `best`.

        Empty before anything was looked at.
        """
        criterion = self._criterion(best)
        steps = []
        for counts, rss in self._least_rss.items():
            order = counts.real + 2 * counts.pairs
            steps.append(OrderStep(counts.real, counts.pairs, rss, criterion(rss, order)))
        return tuple(sorted(steps, key=lambda step: (step.order, step.n_real)))

    def _likeliest(
        self, best: Refined, trials: Sequence[Poles], stage: str, tolerance: float = FINE
    ) -> Refined:
        """Lowest by the criterion among `best` and the ends of descents from some poles; `best` wins a tie.

        The criterion is read from the residual of `best`. stage, tolerance: name of the step in the trace,
        and share of J that a descent may leave to gain. `best` itself without trials.
        """
        ends = [self._noted(self.search.descend(poles, stage, tolerance)) for poles in trials]
        criterion = self._criterion(best)
        return min([best, *ends], key=lambda end: criterion(end.rss, end.poles.order))

    def _one_less(self, poles: Poles, real: bool, pairs: bool) -> list[Poles]:
        """Sets of poles without one of the searched real ones (where `real`), and without one of the pairs
        (`pairs`).

        Empty where there is none to leave out.
        """
        fixed = self.search.fixed
        smaller: list[Poles] = []
        if real:
            smaller += [poles.without_real(i) for i in range(fixed.real.size, poles.real.size)]
        if pairs:
            smaller += [poles.without_pair(i) for i in range(fixed.pairs.size, poles.pairs.size)]
        return smaller

    def _criterion(self, end: Refined) -> Criterion:
        """The criterion (J, order) -> number, lower is better, with Ne of the residual of this model.

        J that is rounding of the output counts as such, so that none is minus infinity.
        """
        worth = self.search.colour(end).effective_samples
        return self.search.data.criterion(end.rss, end.poles.order, worth)

    def _better(self, trial: Refined, best: Refined) -> bool:
        """Whether the larger trial's criterion is lower. For one more pair: Ne ln(J0 / J1) > 4 ln Ne.

        J0 and J1 are those of `best` and `trial`, Ne of the trial's residual; 4 are a pair's free numbers,
        two of the pole and two coefficients. False for nan.
        """
        criterion = self._criterion(trial)
        return criterion(trial.rss, trial.poles.order) < criterion(best.rss, best.poles.order)

    def _visible(self, best: Refined) -> bool:
        """Whether a further pair could be seen: enough samples for it, and a residual above rounding.

        `EXPLAINED` : the share of the output's power, 1e-18, that counts as rounding.
        """
        # A pair is two poles.
        n_numbers = self.search.data.n_parameters(best.poles.order + 2)
        enough = self.search.data.n_samples > SAMPLES_PER_NUMBER * n_numbers
        return enough and best.rss > EXPLAINED * self.search.data.power

    def _counts(self, end: Refined) -> PoleCounts:
        """Numbers of searched real poles and pairs of an end; that it has the fixed ones is not checked."""
        fixed = self.search.fixed
        return PoleCounts(end.poles.real.size - fixed.real.size, end.poles.pairs.size - fixed.pairs.size)

    def _noted(self, end: Refined) -> Refined:
        """The end itself; its J is noted for the table where it is the least of its structure; nan is not
        refused."""
        counts = self._counts(end)
        self._least_rss[counts] = min(end.rss, self._least_rss.get(counts, np.inf))
        return end


def _real_poles(rate: float, factors: Sequence[float]) -> Poles:
    """Real poles exp(-rate factor), one for each factor; rate: decay per sample, above zero.

    Raises ValueError (`Poles`) for a rate that is not: the pole would not lie inside the circle.
    """
    return Poles(np.exp(-rate * np.array(factors)))


def _met(poles: ComplexArray) -> int | None:
    """Index of the first pole (P,) that another one has met; None where all are apart, or there are none.

    Met: nearer than `MET` times its distance from 1.
    """
    distance = np.abs(poles[:, None] - poles[None, :])
    near = distance <= MET * np.abs(1 - poles)
    another = ~np.eye(poles.size, dtype=bool)
    indices = np.flatnonzero((near & another).any(axis=1))
    if not indices.size:
        return None
    return int(indices[0])
