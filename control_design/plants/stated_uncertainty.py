"""Uncertainty as an engineer states it: discs around a nominal response, their radius a weight.

Who has no posterior of an identification may still know that a model is right within 10 % up to 5 Hz and
worse above. `StatedDiscs` takes such a statement as a rational weight W(s), multiplicative or additive, and
offers what `PlantChannel` asks of an uncertainty: covariances at any frequency (`at`), and a first-order
expansion with a proved remainder (`first_order`), so that the certificate holds between grid points too.
"""

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


# A pole of a weight is on the imaginary axis if its real part is below this share of its size: the rounding
# of a root from double precision coefficients, times some thousand.
_AXIS_SHARE = 1e-12


@dataclass(frozen=True, eq=False)
class StatedDiscs:
    """Discs |G - G_nom| <= |W| |G_nom| (multiplicative) or |G - G_nom| <= |W| (additive) at every frequency.

    Parameters
    ----------
    nominal : control.StateSpace
        Discrete, one input and one output.
    weight : RationalWeight
        W(s), evaluated at the Tustin frequency s = j (2/dt) tan(omega dt/2).
    kind : "multiplicative" or "additive"
        Whether the weight is relative to the nominal response.
    level : float
        Probability in (0, 1) of the ellipses that are these discs: ellipses of another level are larger or
        smaller in the ratio of their Gaussian radii. The default is the plants' usual one.

    Raises
    ------
    ValueError
        For a weight with a pole on the imaginary axis, or a level outside (0, 1). Another kind counts as
        additive, and a nominal of more inputs or outputs fails where it is evaluated: neither is checked.
    """

    nominal: control.StateSpace
    weight: RationalWeight
    kind: Literal["multiplicative", "additive"] = "multiplicative"
    level: float = 0.95

    def __post_init__(self) -> None:
        """Check weight and level.

        Raises the ValueError that the class names.
        """
        roots = np.roots(self.weight.denominator)
        on_axis = np.abs(roots.real) <= _AXIS_SHARE * (1.0 + np.abs(roots))
        if np.any(on_axis):
            raise ValueError(
                f"the weight of the {self.kind} uncertainty has a pole on the imaginary axis, where its "
                "radius is infinite"
            )
        if not 0 < self.level < 1:
            raise ValueError(f"level must lie in (0, 1); got {self.level}")

    @cached_property
    def _rational(self) -> tuple[RationalResponse, RationalResponse]:
        """Nominal response and weight, each by gain, zeros and poles in z.

        Both keep their distance from z = 1, so that slow roots keep their digits.
        """
        integrators = count_integrators(np.asarray(self.nominal.poles(), dtype=np.complex128))
        nominal = RationalResponse.from_state_space(self.nominal, integrators)
        weight = RationalResponse.from_weight(self.weight, float(self.nominal.dt))
        return nominal, weight

    def radius(self, omega_rad_s: Real) -> Real:
        """Radius (F,) of the discs at omega (F,) in rad/s, units of output per input.

        Inf or nan, with numpy's warning, at an integrator or a pole of the nominal on the circle (omega = 0).
        """
        _, weight = self._rational
        size = np.abs(weight.at(omega_rad_s))
        if self.kind == "multiplicative":
            size = size * np.abs(frequency_response(self.nominal, omega_rad_s))
        return size

    def at(self, omega_rad_s: Real, level: float) -> FrequencyUncertainty:
        """Nominal response and circular covariances at omega (F,) in rad/s, whose ellipses of `self.level`
        are the discs; `level` is handed on as that of the record.

        ValueError, of the record, where the response is not finite or frequencies do not ascend.
        """
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        standard_deviation = self.radius(omega) / radius_of(self.level)
        variance = standard_deviation**2
        return FrequencyUncertainty(
            omega,
            frequency_response(self.nominal, omega),
            variance[:, None, None] * np.eye(2),
            float(self.nominal.dt),
            level=level,
            method=f"{self.kind} discs as stated",
        )

    def first_order(self, intervals: FrequencyIntervals, cleared: int) -> tuple[FirstOrder, FirstOrder]:
        """Expansions on intervals of frequency of the discs' centre and of the generators of their
        covariance.

        Parameters
        ----------
        intervals : FrequencyIntervals
            F of them.
        cleared : int
            Both expansions are multiplied by (z - 1)^cleared, which takes integrators away.

        Returns
        -------
        tuple of FirstOrder
            Centre (F,) and two generators (F, 2), of one standard deviation. Intervals that hold a pole have
            a huge remainder; nothing is refused.

        Notes
        -----
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
