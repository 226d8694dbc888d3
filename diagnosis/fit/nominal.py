"""Nominal parameters and how far off they may be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from diagnosis.machine.machine_protocol import Real, SimulatedMachine

# Deviations up to so many tolerances have a Gaussian prior, 95 % of it. Beyond them it falls faster: a value
# that far off gets noticed before it gets stated.
EDGE = 2.0
# Added to the curvature 1 of the prior beyond the edge: at three tolerances the cost is 9 + 15 in place of 9,
# as decisive as 5 tolerances are without it. Chosen; without it several values share what one effect causes.
# Doubled, no answer of six cases moved (`python -m benchmarks.frozen_answers --change`).
_STIFFNESS = 15.0
# Smallest stated value over true value that a tolerance can make: one of 30 % at a deviation of -3 leaves a
# tenth of the value, a larger one would turn its sign.
_SMALLEST_RATIO = 0.05


def prior_cost(deviations: Real) -> float:
    """-2 log of the prior density of the deviations (P,), up to a constant: |d|^2 within two tolerances."""
    beyond_edge = np.maximum(np.abs(deviations) - EDGE, 0.0)
    return float(deviations @ deviations + _STIFFNESS * (beyond_edge @ beyond_edge))


def prior_slope(deviations: Real) -> Real:
    """(P,) half the gradient of `prior_cost`: deviations count as squares d^2 / 2, as residuals do."""
    beyond_edge = np.maximum(np.abs(deviations) - EDGE, 0.0)
    return np.asarray(deviations + _STIFFNESS * np.copysign(beyond_edge, deviations))


def prior_curvature(deviations: Real) -> Real:
    """(P,) half the second derivatives of `prior_cost`; it has no mixed ones."""
    return np.where(np.abs(deviations) > EDGE, 1.0 + _STIFFNESS, 1.0)


@dataclass(frozen=True, eq=False)
class NominalParameters:
    """Nominal parameters by their deviations d (P,), in units of their tolerances (`prior_cost`).

    A machine with tolerances t states values that are wrong by draws of that size: stated =
    true (1 + t d), so the true value is stated / (1 + t d).
    """

    stated: SimulatedMachine
    # A value that would have to be wrong by more tolerances than this is not believed. At 8 the prior has
    # cost 604, more than any effect's own prior, so that the limit is a guard for the descent only.
    farthest: ClassVar[float] = 8.0

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the P nominal parameters, in the order of the deviations."""
        return tuple(self.stated.tolerances)

    @property
    def count(self) -> int:
        """Number P of nominal parameters; 0 for a machine whose values are exact."""
        return len(self.stated.tolerances)

    def at(self, deviations: Real) -> SimulatedMachine:
        """The machine whose nominal parameters are off by these deviations (P,).

        The last one is kept: many effects are tried at the same values.
        """
        if self.count == 0:
            return self.stated
        key = deviations.tobytes()
        if key not in self._last_machine:
            self._last_machine.clear()
            self._last_machine[key] = self.stated.scaled(self.factors(deviations))
        return self._last_machine[key]

    @cached_property
    def _last_machine(self) -> dict[bytes, SimulatedMachine]:
        """Bytes of the deviations -> the machine there; one entry at most."""
        return {}

    def factors(self, deviations: Real) -> dict[str, float]:
        """Key -> true value over stated value, above 0, at deviations (P,)."""
        factors = {}
        for (key, tolerance), deviation in zip(self.stated.tolerances.items(), deviations, strict=True):
            factors[key] = 1.0 / max(1.0 + tolerance * float(deviation), _SMALLEST_RATIO)
        return factors

    def clipped(self, deviations: Real) -> Real:
        """(P,) deviations no larger than `farthest`."""
        return np.clip(deviations, -self.farthest, self.farthest)


class LogNormalParameters(NominalParameters):
    """Nominal parameters with true = stated exp(t d): up and down alike, and no value grows without bound."""

    # Beside a model error a value that is farther off is a finding.
    farthest: ClassVar[float] = 5.0

    def factors(self, deviations: Real) -> dict[str, float]:
        """Key -> true value over stated value, exp(t d), at deviations (P,)."""
        factors = {}
        for (key, tolerance), deviation in zip(self.stated.tolerances.items(), deviations, strict=True):
            factors[key] = float(np.exp(tolerance * deviation))
        return factors
