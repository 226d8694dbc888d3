"""How many poles: stepwise from the data, or the numbers asked for (design 4.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ident.options import IdentOptions
from ident.pole_search import PoleSearch
from ident.poles import Poles
from ident.polish import Polished

Progress = Callable[[float, str], None]

# Residual this small relative to the output (in power) is rounding: no further pole can be seen.
_EXPLAINED = 1e-18


@dataclass(frozen=True)
class OrderStep:
    """One structure that was tried: numbers of searched poles, residual sum of squares and criterion.

    criterion = N ln(J/N) + 2 n ln N, lower is better: a pole costs two numbers, itself and a coefficient.
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
        self.steps: dict[tuple[int, int], OrderStep] = {}
        self._n = search.data.n_samples
        self._power = float(search.data.y @ search.data.y)

    def run(self) -> Polished:
        """Best poles with the numbers asked for, or with those the criterion keeps."""
        options = self.options
        n_real = min(2, options.max_real) if options.n_real is None else options.n_real
        most_pairs = options.max_pairs if options.n_pairs is None else options.n_pairs
        self.progress(0.05, "global search for the first poles")
        # One mode is searched together with the real poles, further ones pair by pair: a joint search over
        # several pairs has never found the best poles.
        best = self._noted(self.search.rescan(self.search.joint(n_real, min(1, most_pairs))))
        for _ in range(3):
            order = best.poles.order
            best = self._grow_pairs(best, most_pairs)
            if options.n_real is None:
                best = self._grow_real(best)
            best = self._prune(best)
            if best.poles.order == order:
                break
        return best

    def _grow_pairs(self, best: Polished, most_pairs: int) -> Polished:
        while (count := self._counts(best)[1]) < most_pairs and self._visible(best):
            self.progress(0.1 + 0.8 * count / max(most_pairs, 1), f"search for pole pair {count + 1}")
            trial = self._noted(self.search.rescan(self.search.add_pair(best.poles)))
            if self.options.n_pairs is None and not self._gain(best, trial) > 4 * np.log(self._n):
                break
            best = trial
        return best

    def _grow_real(self, best: Polished) -> Polished:
        while self._counts(best)[0] < self.options.max_real and self._visible(best):
            trial = self._noted(self.search.rescan(self.search.add_real(best.poles)))
            if not self._gain(best, trial) > 2 * np.log(self._n):
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
            ends = [self._noted(self.search.descend(poles, "pruning", 1e-4)) for poles in trials]
            # Per pole that would go: what the fit loses against what the criterion asks it to be worth.
            ends = [end for end in ends if self._excess(end) < self._excess(best)]
            if not ends:
                return best
            best = self._noted(self.search.descend(min(ends, key=self._excess).poles, "pruning"))

    def _excess(self, end: Polished) -> float:
        floor = max(end.rss, _EXPLAINED * self._power, np.finfo(np.float64).tiny)
        return float(self._n * np.log(floor / self._n) + 2 * end.poles.order * np.log(self._n))

    def _gain(self, before: Polished, after: Polished) -> float:
        floor = max(after.rss, np.finfo(np.float64).tiny)
        return float(self._n * np.log(before.rss / floor))

    def _visible(self, best: Polished) -> bool:
        enough = self._n > 2 * self.search.data.n_parameters(best.poles.order + 2)
        return enough and best.rss > _EXPLAINED * self._power

    def _counts(self, end: Polished) -> tuple[int, int]:
        fixed = self.search.fixed
        return end.poles.real.size - fixed.real.size, end.poles.pairs.size - fixed.pairs.size

    def _noted(self, end: Polished) -> Polished:
        key = self._counts(end)
        step = OrderStep(*key, rss=end.rss, criterion=self._excess(end))
        if key not in self.steps or step.rss < self.steps[key].rss:
            self.steps[key] = step
        return end
