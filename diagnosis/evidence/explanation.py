"""A fitted set of effects and what it leaves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from diagnosis.fit.descent import Fit
from diagnosis.machine.machine_protocol import Real


@dataclass(frozen=True, eq=False)
class WeighedFit(ABC):
    """The end of a fit with its evidence."""

    fit: Fit

    @property
    def names(self) -> tuple[str, ...]:
        return self.fit.names

    @property
    def sorted_names(self) -> tuple[str, ...]:
        return tuple(sorted(self.names))

    @property
    @abstractmethod
    def log_evidence(self) -> float:
        """Log of the probability of these effects, up to a constant of the case."""


@dataclass(frozen=True, eq=False)
class Explanation(WeighedFit):
    """A fitted set of effects and what it leaves.

    log_likelihoods : (R,) of every record, estimation and held-out.
    log_prior, log_volume : of deviations, start and effects; what the records leave of them.
    left, left_held_out : experiment residuals (T, Y) in the outputs' units.
    shares : (2, Y) RMS left beyond noise over the motion: estimation records, held-out records.
    mean_squares : (2, Y) energies left over those of the motion, noise included: of differences.
    """

    log_likelihoods: Real
    log_prior: float
    log_volume: float
    residuals: tuple[Real, ...]
    held_out_residuals: tuple[Real, ...]
    residual_shares: Real
    energy_ratios: Real

    def held_out_energy(self, noise: Real) -> float:
        """Energy left of the held-out records, in noise deviations (Y,)."""
        return float(sum(np.sum((part / noise) ** 2) for part in self.held_out_residuals))

    @property
    def log_likelihood(self) -> float:
        return float(np.sum(self.log_likelihoods))

    @property
    def log_evidence(self) -> float:
        return self.log_likelihood + self.log_prior + self.log_volume


E = TypeVar("E", bound=WeighedFit)


def best_of_sets(
    found: Iterable[E], weight: Callable[[E], float] = lambda e: e.log_evidence
) -> dict[tuple[str, ...], E]:
    """Sorted effect names -> the explanation by these of largest weight, the likeliest first."""
    best: dict[tuple[str, ...], E] = {}
    for explanation in sorted(found, key=lambda e: -weight(e)):
        best.setdefault(explanation.sorted_names, explanation)
    return best
