"""A fitted set of effects, what it leaves of every record, and its evidence."""

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
    """A fit and how likely its effects are.

    Attributes
    ----------
    fit : Fit
        Effects, nominal values and starts, and what they leave.
    """

    fit: Fit

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects in the order in which they were added; empty for the nominal machine."""
        return self.fit.names

    @property
    def sorted_names(self) -> tuple[str, ...]:
        """Names of the effects in alphabetical order: the key of a set in every table of sets."""
        return tuple(sorted(self.names))

    @property
    @abstractmethod
    def log_evidence(self) -> float:
        """Logarithm of the probability of these effects, up to a constant of the case."""


@dataclass(frozen=True, eq=False)
class Explanation(WeighedFit):
    """A fitted set of effects beside a model error, weighed on estimation and held-out records.

    Attributes
    ----------
    log_likelihoods : (R,) array
        Of every record: estimation records first, then held-out ones with the prior of their fitted starts.
    log_prior : float
        Logarithm of the prior density of deviations and starts.
    log_volume : float
        Logarithm of what the records leave of the prior volume of effects and deviations
        (`diagnosis.fit.descent.log_occam_factor`).
    residuals : tuple of (T, Y) arrays
        measured - model of every estimation record, in the outputs' units.
    held_out_residuals : tuple of (T, Y) arrays
        measured - model of every held-out record, of which only the start was fitted.
    residual_shares : (2, Y) array
        RMS left beyond what sensors may have, over the RMS of the motion; row 0 of estimation records, row 1
        of held-out ones.
    energy_ratios : (2, Y) array
        Energy left, noise included, over that of the motion, in the same rows. A difference of two of these
        is free of the noise, which both have.
    """

    log_likelihoods: Real
    log_prior: float
    log_volume: float
    residuals: tuple[Real, ...]
    held_out_residuals: tuple[Real, ...]
    residual_shares: Real
    energy_ratios: Real

    def held_out_energy(self, noise: Real) -> float:
        """Sum of squares left of all held-out records, outputs in units of their noise deviations (Y,)."""
        return float(sum(np.sum((left / noise) ** 2) for left in self.held_out_residuals))

    @property
    def log_likelihood(self) -> float:
        """Sum over all records."""
        return float(np.sum(self.log_likelihoods))

    @property
    def log_evidence(self) -> float:
        """Laplace's approximation: likelihood at the optimum, times prior density, times volume."""
        return self.log_likelihood + self.log_prior + self.log_volume


E = TypeVar("E", bound=WeighedFit)


def best_of_sets(
    explanations: Iterable[E], weight: Callable[[E], float] = lambda explanation: explanation.log_evidence
) -> dict[tuple[str, ...], E]:
    """The best explanation by every set of effects.

    Parameters
    ----------
    explanations : iterable
        Any number by the same set; none gives an empty result.
    weight : callable
        Of two explanations by one set, the one with the larger weight is kept; the first of equal ones.

    Returns
    -------
    dict
        Sorted names of the effects -> explanation, that of the largest weight first.
    """
    best: dict[tuple[str, ...], E] = {}
    for explanation in sorted(explanations, key=lambda explanation: -weight(explanation)):
        best.setdefault(explanation.sorted_names, explanation)
    return best
