"""The weights of a specification as rational functions of z, for bounds between frequencies.

The same formulas as `Specification.tracking_at` and `.effort_magnitude`, written by coefficients; a test
compares the two.
"""

from __future__ import annotations

import numpy as np

from control_design.rational_response import RationalResponse
from control_design.specification import _INTEGRAL_SHARE, _ROLLOFF_END, RationalWeight, Specification


def tracking_weight(
    specification: Specification, dt_s: float, plant_integrators: int
) -> RationalResponse | None:
    """W1 without the modulus margin, or None where no tracking is asked for."""
    weight = specification.sensitivity_weight
    if weight is None:
        if specification.bandwidth_rad_s is None:
            return None
        m = specification.modulus_margin
        corner = specification.bandwidth_rad_s * np.sqrt(2.0 - m**2)
        floor = 0.0 if specification.integrator else specification.low_frequency_rejection
        numerator, denominator = np.array([m, corner]), np.array([1.0, corner * floor])
        if specification.integrator:
            for _ in range(plant_integrators):
                numerator = np.polymul(numerator, [1.0, _INTEGRAL_SHARE * corner])
                denominator = np.polymul(denominator, [1.0, 0.0])
        weight = RationalWeight(numerator=tuple(numerator), denominator=tuple(denominator))
    return RationalResponse.from_weight(weight, dt_s)


def effort_weight(specification: Specification, dt_s: float) -> RationalResponse | None:
    """W3, or None where effort is not limited."""
    weight = specification.effort_weight
    if weight is None:
        if specification.effort_limit is None:
            return None
        numerator: tuple[float, ...] = (1.0 / specification.effort_limit,)
        denominator: tuple[float, ...] = (1.0,)
        corner = specification.effort_rolloff_rad_s
        if corner is not None:
            numerator = (numerator[0] / corner, *numerator)
            denominator = (1.0 / (_ROLLOFF_END * corner), *denominator)
        weight = RationalWeight(numerator=numerator, denominator=denominator)
    return RationalResponse.from_weight(weight, dt_s)
