"""Weights as rational functions of s, and those that the words of a specification stand for.

On the circle s = j (2/dt) tan(omega dt/2), so a weight means the same for every sampling time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field, model_validator

from control_design.plants.ellipses import Complex
from ident.data.settings import Settings

# Of the corner. SIMC, at its fastest: a quarter of the crossover (Skogestad, J. Process Control 13, 2003).
_INTEGRAL_SHARE = 0.2
# Of the corner. Whether a plant's pole is slower than this no record tells: beside it, ellipses are wide.
_SLOWEST = 0.01
_ROLLOFF_END = 40.0  # the effort weight flattens this far above its corner, so that it stays proper


class RationalWeight(Settings):
    """W(s) = numerator(s)/denominator(s), coefficients of s with the highest power first; stable and
    proper."""

    numerator: tuple[float, ...] = Field(min_length=1, description="coefficients, highest power of s first")
    denominator: tuple[float, ...] = Field(min_length=1, description="coefficients, highest power of s first")

    @model_validator(mode="after")
    def _stable_and_proper(self) -> RationalWeight:
        for name in ("numerator", "denominator"):
            values = np.array(getattr(self, name))
            if not (np.all(np.isfinite(values)) and values[0] != 0):
                raise ValueError(f"{name} needs finite coefficients with a non-zero first one; got {values}")
        if len(self.numerator) > len(self.denominator):
            raise ValueError("the weight is improper: numerator of higher degree than the denominator")
        roots = np.roots(self.denominator)
        if np.any(roots.real > 0):
            raise ValueError(
                f"the weight is unstable: denominator root at {roots[np.argmax(roots.real)]:.4g} rad/s"
            )
        return self

    def at(self, s: Complex) -> Complex:
        """W at complex s (F,); infinite at a pole on the axis."""
        with np.errstate(divide="ignore", invalid="ignore"):
            value = np.polyval(self.numerator, s) / np.polyval(self.denominator, s)
        return np.asarray(value, dtype=np.complex128)


def integral_corner(bandwidth_rad_s: float, modulus_margin: float) -> float:
    """wc/5 of `bandwidth_weight`: up to there integral action is asked for."""
    return float(_INTEGRAL_SHARE * bandwidth_rad_s * np.sqrt(2.0 - modulus_margin**2))


def bandwidth_weight(
    bandwidth_rad_s: float, modulus_margin: float, floor: float, *, slow_poles_rad_s: Sequence[float] = ()
) -> RationalWeight:
    """W1 = (m s + wc)/(s + wc r) times (s + wc/5)/(s + p) for every slow pole p.

    wc = bandwidth sqrt(2 - m^2): |W1| is at least sqrt 2 up to the bandwidth, m = modulus_margin far above it
    and 1/r at zero frequency, r = floor (0: integral). slow_poles_rad_s: magnitudes of the plant's poles
    below wc/5, 0 for an integrator, others at least wc/100. A plant that integrates from p on meets a weight
    of slope one without the controller's integrator; each factor asks for its action by a fifth of the
    corner.
    """
    corner = bandwidth_rad_s * np.sqrt(2.0 - modulus_margin**2)
    share = integral_corner(bandwidth_rad_s, modulus_margin)
    numerator, denominator = np.array([modulus_margin, corner]), np.array([1.0, corner * floor])
    for pole in slow_poles_rad_s:
        numerator = np.polymul(numerator, [1.0, share])
        denominator = np.polymul(denominator, [1.0, max(pole, _SLOWEST * corner) if pole else 0.0])
    return RationalWeight(numerator=tuple(numerator), denominator=tuple(denominator))


def effort_limit_weight(effort_limit: float, rolloff_rad_s: float | None) -> RationalWeight:
    """W3 = 1/limit, times (s/wr + 1)/(s/(40 wr) + 1) with a roll-off: the limit on |K S| falls above wr."""
    if rolloff_rad_s is None:
        return RationalWeight(numerator=(1.0 / effort_limit,), denominator=(1.0,))
    return RationalWeight(
        numerator=(1.0 / effort_limit / rolloff_rad_s, 1.0 / effort_limit),
        denominator=(1.0 / (_ROLLOFF_END * rolloff_rad_s), 1.0),
    )
