"""How many poles: stepwise from the data, or the numbers asked for (design 4.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.fit.refinement import Polished
from ident.search.pole_search import PoleSearch

Progress = Callable[[float, str], None]

# Residual this small relative to the output (in power) is rounding: no further pole can be seen.
_EXPLAINED = 1e-18


@dataclass(frozen=True)
class OrderStep:
    """One structure that was tried: numbers of searched poles, residual sum of squares and criterion.

    criterion = Ne ln(J/N) + (2 n + nuisances) ln Ne, lower is better: a pole costs two numbers, itself and a
    coefficient, and one more per record whose initial state is estimated. Ne is the number of independent
    samples that the chosen model's residual is worth, N where it is white.
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

    def __init__(self, search: PoleSearch, progress: Progress) -> None:
        self.search = search
        self.options: IdentOptions = search.options
        self.progress = progress
        self._tried: dict[tuple[int, int], float] = {}
        self._n = search.data.n_samples
        self._power = float(search.data.y @ search.data.y)

    def run(self, start: Polished | None = None) -> Polished:
        """Best poles with the numbers asked for, or with those the criterion keeps; `start`: poles to go on
        from, such as those found under another structure."""
        options = self.options
        n_real = min(2, options.max_real) if options.n_real is None else options.n_real
        most_pairs = options.max_pairs if options.n_pairs is None else options.n_pairs
        self.progress(0.05, "global search for the first poles")
        # One mode is searched together with the real poles, further ones pair by pair: a joint search over
        # several pairs has never found the best poles.
        first = self.search.joint(n_real, min(1, most_pairs)) if start is None else start
        best = self._noted(self.search.rescan(first))
        for _ in range(3):
            order = best.poles.order
            best = self._grow_pairs(best, most_pairs)
            if options.n_real is None:
                best = self._grow_real(best)
            best = self._prune(best)
            if best.poles.order == order:
                break
        return best

    def table(self, best: Polished) -> tuple[OrderStep, ...]:
        """Everything that was tried, by order, judged by the residual of the chosen model."""
        worth = self.worth(best)
        steps = [
            OrderStep(n_real, n_pairs, rss, self._criterion(rss, n_real + 2 * n_pairs, worth))
            for (n_real, n_pairs), rss in self._tried.items()
        ]
        return tuple(sorted(steps, key=lambda step: (step.order, step.n_real)))

    def worth(self, end: Polished) -> float:
        """Independent samples that the residual of an end is worth."""
        return self.search.colour(end).effective_samples

    def _grow_pairs(self, best: Polished, most_pairs: int) -> Polished:
        while (count := self._counts(best)[1]) < most_pairs and self._visible(best):
            self.progress(0.1 + 0.8 * count / max(most_pairs, 1), f"search for pole pair {count + 1}")
            trial = self._noted(self.search.rescan(self.search.add_pair(best.poles)))
            if self.options.n_pairs is None and not self._better(trial, best, self.worth(trial)):
                break
            best = trial
        return best

    def _grow_real(self, best: Polished) -> Polished:
        while self._counts(best)[0] < self.options.max_real and self._visible(best):
            trial = self._noted(self.search.rescan(self.search.add_real(best.poles)))
            if not self._better(trial, best, self.worth(trial)):
                break
            best = trial
        return best

    def _prune(self, best: Polished) -> Polished:
        """Take out poles whose loss the criterion does not mind, the least needed first."""
        fixed = self.search.fixed
        while True:
            trials = []
            if self.options.n_real is None:
                for i in range(fixed.real.size, best.poles.real.size):
                    trials.append(Poles(np.delete(best.poles.real, i), best.poles.pairs))
            if self.options.n_pairs is None:
                for i in range(fixed.pairs.size, best.poles.pairs.size):
                    trials.append(Poles(best.poles.real, np.delete(best.poles.pairs, i)))
            worth = self.worth(best) if trials else 0.0
            ends = [self._noted(self.search.descend(poles, "pruning", 1e-4)) for poles in trials]
            ends = [end for end in ends if self._better(end, best, worth)]
            if not ends:
                return best
            chosen = min(ends, key=lambda end: self._criterion(end.rss, end.poles.order, worth))
            best = self._noted(self.search.descend(chosen.poles, "pruning"))

    def _better(self, trial: Polished, best: Polished, worth: float) -> bool:
        """Is the trial's criterion lower? For one more pair: Ne ln(J0/J1) > 4 ln Ne (design 4.3)."""
        return self._criterion(trial.rss, trial.poles.order, worth) < self._criterion(
            best.rss, best.poles.order, worth
        )

    def _criterion(self, rss: float, order: int, worth: float) -> float:
        floor = max(rss, _EXPLAINED * self._power, np.finfo(np.float64).tiny)
        return float(worth * np.log(floor / self._n) + self.search.data.n_parameters(order) * np.log(worth))

    def _visible(self, best: Polished) -> bool:
        enough = self._n > 2 * self.search.data.n_parameters(best.poles.order + 2)
        return enough and best.rss > _EXPLAINED * self._power

    def _counts(self, end: Polished) -> tuple[int, int]:
        fixed = self.search.fixed
        return end.poles.real.size - fixed.real.size, end.poles.pairs.size - fixed.pairs.size

    def _noted(self, end: Polished) -> Polished:
        key = self._counts(end)
        self._tried[key] = min(end.rss, self._tried.get(key, np.inf))
        return end
