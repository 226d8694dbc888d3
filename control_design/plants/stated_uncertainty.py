"""Uncertainty as an engineer states it: discs around a nominal response, their radius a weight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from control_design.plants.ellipses import Real, radius_of
from control_design.plants.first_order import FirstOrder, FrequencyIntervals, RationalResponse
from control_design.plants.plant_set import count_integrators, frequency_response
from control_design.plants.set_expansion import stacked
from control_design.plants.weights import RationalWeight
from ident.uncertainty import FrequencyUncertainty

if TYPE_CHECKING:
    import control


@dataclass(frozen=True, eq=False)
class StatedDiscs:
    """Discs |G - G_nom| <= |W| |G_nom| (multiplicative) or |G - G_nom| <= |W| (additive) at every frequency.

    nominal: SISO discrete state space. weight: W(s) at the Tustin frequency. level: of the ellipses that are
    these discs. Evaluated at any frequency, bounded between frequencies. Raises ValueError for a weight with
    a pole on the imaginary axis.
    """

    nominal: control.StateSpace
    weight: RationalWeight
    kind: Literal["multiplicative", "additive"] = "multiplicative"
    level: float = 0.95

    def __post_init__(self) -> None:
        roots = np.roots(self.weight.denominator)
        if np.any(np.abs(roots.real) <= 1e-12 * (1.0 + np.abs(roots))):
            raise ValueError(
                f"the weight of the {self.kind} uncertainty has a pole on the imaginary axis, where its "
                "radius is infinite"
            )
        if not 0 < self.level < 1:
            raise ValueError(f"level must lie in (0, 1); got {self.level}")

    @cached_property
    def _rational(self) -> tuple[RationalResponse, RationalResponse]:
        """Nominal and weight by poles and zeros."""
        integrators = count_integrators(np.asarray(self.nominal.poles(), dtype=np.complex128))
        return (
            RationalResponse.from_state_space(self.nominal, integrators),
            RationalResponse.from_weight(self.weight, float(self.nominal.dt)),
        )

    def radius(self, omega_rad_s: Real) -> Real:
        """Radius of the disc at omega (F,)."""
        size = np.abs(self._rational[1].at(omega_rad_s))
        if self.kind == "multiplicative":
            size = size * np.abs(frequency_response(self.nominal, omega_rad_s))
        return size

    def at(self, omega_rad_s: Real, level: float) -> FrequencyUncertainty:
        """Nominal response and circular covariances at omega (F,)."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        variance = (self.radius(omega) / radius_of(self.level)) ** 2
        return FrequencyUncertainty(
            omega,
            frequency_response(self.nominal, omega),
            variance[:, None, None] * np.eye(2),
            float(self.nominal.dt),
            level=level,
            method=f"{self.kind} discs as stated",
        )

    def first_order(self, intervals: FrequencyIntervals, cleared: int) -> tuple[FirstOrder, FirstOrder]:
        """Centre (F,) and two generators (F, 2), both times (z - 1)^cleared.

        A disc of radius |f| is {x f + y j f : x^2 + y^2 <= 1} whatever the phase of f, so f = W G_nom (or W)
        serves, which is rational.
        """
        nominal, weight = self._rational
        centre = nominal.expand(intervals, cleared)
        if self.kind == "multiplicative":
            disc = weight.expand(intervals).times(centre)
        else:
            disc = weight.expand(intervals, cleared)
        disc = disc.scaled(1.0 / radius_of(self.level))
        return centre, stacked([disc, disc.scaled(1j)])
