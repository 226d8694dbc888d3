"""Weights as rational functions of s, and those that the words of a specification stand for.

A requirement on a closed-loop function (sensitivity S, control effort K S) is |W| |function| <= gamma at
every frequency. `RationalWeight` is such a W(s), stable and proper. It is evaluated on the imaginary axis of
the Tustin map, s = j (2/dt) tan(omega dt/2), so that a weight means the same for every sampling period.
`bandwidth_weight` turns a bandwidth and a modulus margin into a weight on S, `effort_limit_weight` a limit
and a roll-off into a weight on K S.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field, model_validator

from control_design.plants.ellipses import Complex
from ident.data.settings import Settings

# Corner of the integral action as a share of the weight's corner: a fifth, a little slower than SIMC at its
# fastest, whose integral time is four closed-loop time constants (Skogestad, J. Process Control 13, 2003).
# Doubled, the integral action takes twice the phase from the crossover.
_INTEGRAL_SHARE = 0.2

# Slowest pole that a factor of the bandwidth weight may have, as a share of the weight's corner. Chosen: no
# record that a loop of that bandwidth is designed from tells whether a pole of the plant is slower than a
# hundredth of it: beside such a pole the ellipses are wide.
_SLOWEST_POLE_SHARE = 0.01

# The effort weight flattens at this multiple of its roll-off frequency, which keeps it proper. By then it
# asks for forty times less effort (32 dB). Chosen: far enough that the corner is above Nyquist for most arms,
# where doubling it changes nothing.
_ROLLOFF_END_RATIO = 40.0


class RationalWeight(Settings):
    """W(s) = numerator(s)/denominator(s), stable and proper; coefficients of s, highest power first.

    Raises
    ------
    ValueError
        (of pydantic) for coefficients that are not finite, a first coefficient of 0, a numerator of higher
        degree than the denominator, or a pole in the right half plane. Poles on the imaginary axis are
        allowed.

    Examples
    --------
    >>> weight = flexlink.RationalWeight(numerator=(0.5, 2.6), denominator=(1.0, 0.0026))
    >>> flexlink.Specification(sensitivity_weight=weight, controller_order=3).bandwidth_rad_s is None
    True
    """

    numerator: tuple[float, ...] = Field(min_length=1, description="coefficients, highest power of s first")
    denominator: tuple[float, ...] = Field(min_length=1, description="coefficients, highest power of s first")

    @model_validator(mode="after")
    def _stable_and_proper(self) -> RationalWeight:
        """The weight itself, once its coefficients, degree and poles are checked.

        Raises ValueError, which pydantic hands on, for what the class refuses.
        """
        for name in ("numerator", "denominator"):
            values = np.array(getattr(self, name))
            if not (np.all(np.isfinite(values)) and values[0] != 0):
                raise ValueError(f"{name} needs finite coefficients with a non-zero first one; got {values}")
        if len(self.numerator) > len(self.denominator):
            raise ValueError("the weight is improper: numerator of higher degree than the denominator")
        roots = np.roots(self.denominator)
        if np.any(roots.real > 0):
            fastest_growing = roots[np.argmax(roots.real)]
            raise ValueError(f"the weight is unstable: denominator root at {fastest_growing:.4g} rad/s")
        return self

    def at(self, s: Complex) -> Complex:
        """W (F,) at complex s (F,) in rad/s; infinite at a pole on the axis.

        Nan where numerator and denominator vanish together, or s is infinite; shapes as of s.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            value = np.polyval(self.numerator, s) / np.polyval(self.denominator, s)
        return np.asarray(value, dtype=np.complex128)


def integral_corner(bandwidth_rad_s: float, modulus_margin: float) -> float:
    """Frequency in rad/s up to which `bandwidth_weight` asks for integral action: a fifth of its corner.

    Not checked: bandwidth above 0, modulus margin between 0 and 1, which `Specification` has made sure of.
    """
    return float(_INTEGRAL_SHARE * bandwidth_rad_s * np.sqrt(2.0 - modulus_margin**2))


def bandwidth_weight(
    bandwidth_rad_s: float, modulus_margin: float, floor: float, *, slow_poles_rad_s: Sequence[float] = ()
) -> RationalWeight:
    """Weight on the sensitivity that a bandwidth and a modulus margin stand for.

    Parameters
    ----------
    bandwidth_rad_s : float
        Up to there |S| is to be below 1/sqrt(2).
    modulus_margin : float
        m, smallest distance of the loop from -1, between 0 and 1.
    floor : float
        r: |S| at zero frequency may be r; 0 asks for integral action.
    slow_poles_rad_s : sequence of float
        Magnitudes of the plant's poles below the corner of integral action, 0 for an integrator.

    Returns
    -------
    RationalWeight
        W = (m s + wc)/(s + wc r) times (s + wc/5)/(s + p) for every slow pole p.

    Raises
    ------
    ValueError
        By pydantic, where a coefficient is not finite. Ranges are not checked: `Specification` has done that.

    Notes
    -----
    With wc = bandwidth sqrt(2 - m^2), |W| is at least sqrt(2) up to the bandwidth, m far above it and 1/r at
    zero frequency. A plant that integrates from p on meets a weight of slope one without the controller's
    integrator, so each slow pole brings a factor that asks for integral action up to a fifth of the corner.
    Poles other than integrators count as at least wc/100.
    """
    corner = bandwidth_rad_s * np.sqrt(2.0 - modulus_margin**2)
    integral_end = integral_corner(bandwidth_rad_s, modulus_margin)
    numerator = np.array([modulus_margin, corner])
    denominator = np.array([1.0, corner * floor])
    for pole in slow_poles_rad_s:
        weight_pole = 0.0
        if pole:
            weight_pole = max(pole, _SLOWEST_POLE_SHARE * corner)
        numerator = np.polymul(numerator, [1.0, integral_end])
        denominator = np.polymul(denominator, [1.0, weight_pole])
    return RationalWeight(numerator=tuple(numerator), denominator=tuple(denominator))


def effort_limit_weight(effort_limit: float, rolloff_rad_s: float | None) -> RationalWeight:
    """Weight on the control effort K S that a limit and a roll-off stand for.

    Parameters
    ----------
    effort_limit : float
        Largest |K S|, units of the input per unit of the output.
    rolloff_rad_s : float or None
        wr: above it the limit falls with frequency; None: one limit at all frequencies.

    Returns
    -------
    RationalWeight
        W = 1/limit, times (s/wr + 1)/(s/(40 wr) + 1) with a roll-off.

    Raises
    ------
    ZeroDivisionError
        A limit or a roll-off is zero, which `Specification` does not allow.
    """
    if rolloff_rad_s is None:
        return RationalWeight(numerator=(1.0 / effort_limit,), denominator=(1.0,))
    return RationalWeight(
        numerator=(1.0 / effort_limit / rolloff_rad_s, 1.0 / effort_limit),
        denominator=(1.0 / (_ROLLOFF_END_RATIO * rolloff_rad_s), 1.0),
    )
