"""How many poles: stepwise from the data, or the numbers asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.data.arrays import ComplexArray
from ident.fit.least_squares import EXPLAINED
from ident.fit.problem import PoleProblem
from ident.fit.refinement import Refined
from ident.search.pole_search import GAIN, PoleSearch

Progress = Callable[[float, str], None]

# Exchanges of a pole for another at most.
_EXCHANGES = 4
# Damping ratio above which a pair does what real poles do, and how far apart two of them begin.
_NO_OVERSHOOT, _APART = 0.9, 1.5
# Poles have met if they differ by less than this share of their distance from one.
_MET = 1e-4


def silent(fraction: float, message: str) -> None:
    """Default progress: nobody listens."""


# (J, order) -> criterion of that model, lower is better (`ident.fit.problem.PoleProblem.criterion`).
Criterion = Callable[[float, int], float]


@dataclass(frozen=True)
class OrderStep:
    """One structure that was tried: numbers of searched poles, residual sum of squares, criterion.

    criterion = Ne ln(J/N) + (2 n + nuisances) ln Ne: a pole costs itself and a coefficient, and one number
    per record whose initial state is estimated. Ne: independent samples that the chosen model's residual is
    worth.
    """

    n_real: int
    n_pairs: int
    rss: float
    criterion: float

    @property
    def order(self) -> int:
        return self.n_real + 2 * self.n_pairs


class OrderSelection:
    """Grows and prunes the set of poles of one search."""

    def __init__(self, search: PoleSearch[PoleProblem], progress: Progress = silent) -> None:
        self.search = search
        self.options: IdentOptions = search.options
        self.progress = progress
        self._tried: dict[tuple[int, int], float] = {}

    def run(self, start: Refined | None = None) -> Refined:
        """Best poles with the numbers asked for, or with those the criterion keeps; `start`: poles to go on
        from, such as those found under another structure."""
        options = self.options
        n_real = min(2, options.max_real) if options.n_real is None else options.n_real
        most_pairs = options.max_pairs if options.n_pairs is None else options.n_pairs
        self.progress(0.05, "global search for the first poles")
        # One mode with the real poles, then pair by pair: a joint search of several has never found the best.
        first = self.search.joint(n_real, min(1, most_pairs)) if start is None else start
        best = self._noted(self.search.rescan(first))
        for _ in range(3):
            order = best.poles.order
            best = grown = self._grow_pairs(best, most_pairs)
            while options.n_real is None and self._counts(best)[0] < options.max_real and self._visible(best):
                trial = self._noted(self.search.rescan(self.search.add_real(best.poles)))
                if not self._better(trial, best):
                    break
                best = trial
            best = self.pruned(best)
            # From where no pair was to be added, none will be: a second look would end the same.
            if best is grown or best.poles.order == order:
                break
        return best

    def exchanged(self, best: Refined) -> Refined:
        """One pole more and the least needed one less, as long as something is gained: a pair may stand where
        two real poles should. Not for records, where the pole gained may follow friction."""
        for _ in range(_EXCHANGES):
            if not self._visible(best):
                break
            larger = [self.search.add_pair(best.poles)]
            if self._counts(best)[0]:
                larger.append(self.search.add_real(best.poles))
            found = min((self._reduced(end, self._counts(best)) for end in larger), key=lambda end: end.rss)
            if not found.rss < best.rss * (1 - GAIN):
                break
            best = self._noted(self.search.rescan(found))
        return best

    def with_real(self, best: Refined) -> Refined:
        """Pairs without any overshoot as one real pole or two, as long as the criterion falls: what grows
        pair by pair makes such pairs of real poles."""
        while self.options.n_real is None and self.options.n_pairs is None:
            fixed, poles = self.search.fixed.pairs.size, best.poles
            trials = []
            for i in range(fixed, poles.pairs.size):
                rate = np.log(poles.pairs[i])
                if -rate.real / abs(rate) > _NO_OVERSHOOT:
                    size = abs(rate)
                    trials += [
                        poles.without_pair(i).appended(Poles(np.exp(-size * np.array(apart))))
                        for apart in ([1.0], [1.0 / _APART, _APART])
                    ]
            chosen = self._likeliest(best, trials, "real poles of a pair")
            if chosen is best:
                break
            best = self.pruned(chosen)
        return self._apart(best)

    def _apart(self, best: Refined) -> Refined:
        """Without poles that have met: a descent does not part them, and they have no residue each. One in
        place of two, or two real poles further apart, whichever fits better."""
        fixed, poles = self.search.fixed, best.poles
        if self.options.n_real is not None or self.options.n_pairs is not None:
            return best
        real = _met(poles.real[fixed.real.size :].astype(complex))
        pairs = _met(poles.pairs[fixed.pairs.size :])
        if real is not None:
            one = poles.without_real(fixed.real.size + real)
            none = one.without_real(int(np.argmin(np.abs(one.real - poles.real[fixed.real.size + real]))))
            rate = -np.log(poles.real[fixed.real.size + real])
        elif pairs is not None:
            one = poles.without_pair(fixed.pairs.size + pairs)
            met = poles.pairs[fixed.pairs.size + pairs]
            none, rate = one.without_pair(int(np.argmin(np.abs(one.pairs - met)))), abs(np.log(met))
        else:
            return best
        two = none.appended(Poles(np.exp(-rate * np.array([1 / _APART, _APART]))))
        ends = [self._noted(self.search.descend(trial, "poles apart")) for trial in (one, two)]
        criterion = self._criterion(best)
        return min(ends, key=lambda end: criterion(end.rss, end.poles.order))

    def table(self, best: Refined) -> tuple[OrderStep, ...]:
        """Everything that was tried, by order, judged by the residual of the chosen model."""
        criterion = self._criterion(best)
        steps = [
            OrderStep(n_real, n_pairs, rss, criterion(rss, n_real + 2 * n_pairs))
            for (n_real, n_pairs), rss in self._tried.items()
        ]
        return tuple(sorted(steps, key=lambda step: (step.order, step.n_real)))

    def _grow_pairs(self, best: Refined, most_pairs: int) -> Refined:
        while (count := self._counts(best)[1]) < most_pairs and self._visible(best):
            self.progress(0.1 + 0.8 * count / max(most_pairs, 1), f"search for pole pair {count + 1}")
            trial = self._noted(self.search.rescan(self.search.add_pair(best.poles)))
            if self.options.n_pairs is None and not self._better(trial, best):
                break
            best = self._split(best, trial) if 0 < count == most_pairs - 1 else trial
        return best

    def _split(self, smaller: Refined, best: Refined) -> Refined:
        """`best`, or the smaller model with one pair as two where that leaves less and `best` something to
        explain."""
        if self.options.n_pairs is None or self.search.is_trusted(best):
            return best
        return min(best, self._noted(self.search.split_pair(smaller.poles)), key=lambda end: end.rss)

    def pruned(self, best: Refined) -> Refined:
        """Take out poles whose loss the criterion does not mind, the least needed first."""
        free_real, free_pairs = self.options.n_real is None, self.options.n_pairs is None
        while trials := self._one_less(best.poles, free_real, free_pairs):
            chosen = self._likeliest(best, trials, "pruning", 1e-4)
            if chosen is best:
                break
            best = self._noted(self.search.descend(chosen.poles, "pruning"))
        return best

    def _likeliest(self, best: Refined, trials: Sequence[Poles], *how: Any) -> Refined:
        """Of `best` and where descents from these poles end, by the criterion read from its residual; how: as
        `PoleSearch.descend`."""
        ends = [self._noted(self.search.descend(poles, *how)) for poles in trials]
        criterion = self._criterion(best)
        return min([best, *ends], key=lambda end: criterion(end.rss, end.poles.order))

    def _reduced(self, end: Refined, counts: tuple[int, int]) -> Refined:
        """Poles taken out one by one, the one first whose loss costs least, down to the given numbers."""
        while trials := self._one_less(
            end.poles, *(here > wanted for here, wanted in zip(self._counts(end), counts, strict=True))
        ):
            end = min((self.search.descend(poles, "exchange", 1e-4) for poles in trials), key=lambda e: e.rss)
        return self.search.descend(end.poles, "exchange")

    def _one_less(self, poles: Poles, real: bool, pairs: bool) -> list[Poles]:
        """The poles without one of the searched real ones or pairs."""
        fixed = self.search.fixed
        return [
            *(poles.without_real(i) for i in range(fixed.real.size, poles.real.size) if real),
            *(poles.without_pair(i) for i in range(fixed.pairs.size, poles.pairs.size) if pairs),
        ]

    def _criterion(self, end: Refined) -> Criterion:
        """The criterion read from the residual of this model."""
        return self.search.data.criterion(end.rss, end.poles.order, self.search.colour(end).effective_samples)

    def _better(self, trial: Refined, best: Refined) -> bool:
        """Is the larger trial's criterion lower? For one more pair: Ne ln(J0/J1) > 4 ln Ne."""
        criterion = self._criterion(trial)
        return criterion(trial.rss, trial.poles.order) < criterion(best.rss, best.poles.order)

    def _visible(self, best: Refined) -> bool:
        enough = self.search.data.n_samples > 2 * self.search.data.n_parameters(best.poles.order + 2)
        return enough and best.rss > EXPLAINED * self.search.data.power

    def _counts(self, end: Refined) -> tuple[int, int]:
        fixed = self.search.fixed
        return end.poles.real.size - fixed.real.size, end.poles.pairs.size - fixed.pairs.size

    def _noted(self, end: Refined) -> Refined:
        key = self._counts(end)
        self._tried[key] = min(end.rss, self._tried.get(key, np.inf))
        return end


def _met(poles: ComplexArray) -> int | None:
    """Index of a pole that another has met; None where all are apart."""
    near = np.abs(poles[:, None] - poles[None, :]) <= _MET * np.abs(1 - poles)
    at = np.flatnonzero((near & ~np.eye(poles.size, dtype=bool)).any(axis=1))
    return int(at[0]) if at.size else None
