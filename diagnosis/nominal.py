"""Nominal parameters and how far off they may be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

import numpy as np

from diagnosis.machine_protocol import Real, Stated

# Where a stated value would have to be more wrong than this many tolerances nothing is believed any more.
LARGEST_DEVIATION = 8.0


@dataclass(frozen=True, eq=False)
class NominalParameters(Generic[Stated]):
    """Deviations d (P,) of the stated values in units of their tolerances; d ~ N(0, I) before any record.

    A rig or machine with tolerances t states values that are wrong by draws of that size: stated =
    true (1 + t d), so the true value is stated / (1 + t d).
    """

    stated: Stated

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(self.stated.tolerances)

    @property
    def count(self) -> int:
        return len(self.stated.tolerances)

    def at(self, deviations: Real) -> Stated:
        """The rig or machine whose stated values are off by these deviations (P,)."""
        if not self.count:
            return self.stated
        factors = {
            # A tolerance of 30 % and a deviation of -3 leave a tenth of the value: no lower than 5 %.
            key: 1.0 / max(1.0 + tolerance * float(d), 0.05)
            for (key, tolerance), d in zip(self.stated.tolerances.items(), deviations, strict=True)
        }
        return self.stated.scaled(factors)

    def within(self, deviations: Real) -> Real:
        return np.clip(deviations, -LARGEST_DEVIATION, LARGEST_DEVIATION)
