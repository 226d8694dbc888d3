"""Nominal parameters and how far off they may be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from diagnosis.machine.machine_protocol import Real, SimulatedMachine

# Up to so many tolerances the prior is Gaussian. Beyond them it falls faster: a value that far off gets
# noticed before it gets stated.
EDGE, _STIFFNESS = 2.0, 15.0


def prior_cost(deviations: Real) -> float:
    """-2 log of the prior density of the deviations (P,), up to a constant: |d|^2 within two tolerances."""
    beyond = np.maximum(np.abs(deviations) - EDGE, 0.0)
    return float(deviations @ deviations + _STIFFNESS * (beyond @ beyond))


def prior_slope(deviations: Real) -> Real:
    """Half the gradient of `prior_cost` (P,)."""
    beyond = np.maximum(np.abs(deviations) - EDGE, 0.0)
    return np.asarray(deviations + _STIFFNESS * np.copysign(beyond, deviations))


def prior_curvature(deviations: Real) -> Real:
    """Half the second derivatives of `prior_cost` (P,)."""
    return np.where(np.abs(deviations) > EDGE, 1.0 + _STIFFNESS, 1.0)


@dataclass(frozen=True, eq=False)
class NominalParameters:
    """Deviations d (P,) of nominal parameters in units of their tolerances; `prior_cost` before any record.

    A machine with tolerances t states values that are wrong by draws of that size: stated =
    true (1 + t d), so the true value is stated / (1 + t d).
    """

    stated: SimulatedMachine
    # A value that would have to be wrong by more tolerances than this is not believed.
    farthest: ClassVar[float] = 8.0

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(self.stated.tolerances)

    @property
    def count(self) -> int:
        return len(self.stated.tolerances)

    def at(self, deviations: Real) -> SimulatedMachine:
        """The machine whose nominal parameters are off by these deviations (P,)."""
        if not self.count:
            return self.stated
        # Once for all effects that are tried at the same values.
        if (key := deviations.tobytes()) not in self._last:
            self._last.clear()
            self._last[key] = self.stated.scaled(self.factors(deviations))
        return self._last[key]

    @cached_property
    def _last(self) -> dict[bytes, SimulatedMachine]:
        return {}

    def factors(self, deviations: Real) -> dict[str, float]:
        """Key -> true value over stated value."""
        return {
            # A tolerance of 30 % and a deviation of -3 leave a tenth of the value: no lower than 5 %.
            key: 1.0 / max(1.0 + tolerance * float(d), 0.05)
            for (key, tolerance), d in zip(self.stated.tolerances.items(), deviations, strict=True)
        }

    def clipped(self, deviations: Real) -> Real:
        return np.clip(deviations, -self.farthest, self.farthest)


class LogNormalParameters(NominalParameters):
    """true = stated exp(t d): up and down alike, and no value grows without bound."""

    # Beside a model error a value that is farther off is a finding.
    farthest: ClassVar[float] = 5.0

    def factors(self, deviations: Real) -> dict[str, float]:
        pairs = zip(self.stated.tolerances.items(), deviations, strict=True)
        return {key: float(np.exp(tolerance * d)) for (key, tolerance), d in pairs}
