"""Parts of a controller in an engineer's parameters: PID, notch, low-pass; each parameter is free or fixed.

With p = (2/dt)(z - 1)/(z + 1)/scale, the Tustin plane of `biquads`, these are

    PID        Kp (1 + 1/(Ti p) + Td p/(Tf p + 1)), and what is left of it for P, PI and PD
    notch      (p^2 + 2 zeta/depth w p + w^2)/(p^2 + 2 zeta w p + w^2)
    low-pass   w/(p + w), or w^2/(p^2 + 2 zeta w p + w^2)

A part holds what is fixed, in units of the scale; what is free stands in the parameter vector of its cascade,
in the order of the part's `bounds`: Kp as it is, everything else as its logarithm, Td as its ratio to Tf. So
a controller of free parameters only is stable but for its integrator, and has positive times. Frequencies w
are those of the Tustin plane: w = tan(pi f dt)/h with h = dt scale/2 (`tustin_corner`), so that a notch at f
has its depth at f, and a low-pass its corner, in discrete time exactly.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from control_design.plants.ellipses import Real

Structure = Literal["p", "pi", "pd", "pid"]

# Least and largest logarithm of a free time or corner in units of the scale: five decades on either side, in
# which every corner of a controller lies; exp() does not overflow in a wild step. The same as of the free
# cascade.
_LARGEST_LOG = 12.0
# Td over Tf where Td is free, or Tf beside a fixed Td: below a tenth the derivative adds less than 10 % to
# the gain, and its pole and zero are told apart no longer; ten thousand is no filter. Chosen.
DERIVATIVE_RATIOS = (0.1, 1e4)
# Largest logarithm of a free Tf, in units of 1/scale: a filter twenty times slower than the loop leaves no
# derivative. Chosen.
_SLOWEST_FILTER_LOG = 3.0
# Damping ratios that a free notch may have. Below .02 it is narrower than its mode is known; at 1 its poles
# meet on the real axis, where a pair is told from two lags no longer.
NOTCH_DAMPING = (0.02, 0.99)
# Damping ratios that a free low-pass may have: a resonance of 1.3 at most, and no two real corners.
_LOW_PASS_DAMPING = (0.4, 0.99)
# Largest depth of a free notch, a ratio: 60 dB. Deeper ones differ by less than a mode's frequency is known.
_DEEPEST = 1e3
# Highest frequency of a free notch or low-pass, share of Nyquist: the Tustin plane is stretched five times
# there, and a corner nearer to Nyquist means nothing to a machine. Chosen.
_HIGHEST_OF_NYQUIST = 0.8


def tustin_corner(frequency_hz: float, dt_s: float) -> float:
    """tan(pi f dt), no unit: the Tustin frequency times dt/2 of a frequency f below Nyquist.

    frequency_hz, dt_s: positive; from Nyquist on the value is huge or negative (not checked).
    """
    return float(np.tan(np.pi * frequency_hz * dt_s))


def frequency_of_corner(corner: float, dt_s: float) -> float:
    """Frequency in Hz, 0 to Nyquist, of `tustin_corner`; an infinite corner is Nyquist, a negative one gives
    a negative frequency."""
    return float(np.arctan(corner) / (np.pi * dt_s))


def damping_of_width(width_hz: float, corner: float, dt_s: float) -> float:
    """Damping ratio of a notch that is so wide between the frequencies at which half of its power is gone.

    There |N|^2 = (1 + 1/depth^2)/2, which is -3 dB for a deep notch. In the Tustin plane these frequencies
    v satisfy |w^2 - v^2| = 2 zeta w v; with t = tan(pi f dt) that is, exactly in discrete time,

        tan(pi width dt) = 2 zeta t/(1 + t^2) = zeta sin(2 pi f dt).

    Parameters
    ----------
    width_hz : float
        Positive, below Nyquist (not checked).
    corner : float
        t, positive.
    dt_s : float
        Sampling period, s.

    Returns
    -------
    float
        zeta; from 1 on the notch is wider than its frequency allows.
    """
    return float(np.tan(np.pi * width_hz * dt_s) * (1.0 + corner**2) / (2.0 * corner))


def width_of_damping(damping: float, corner: float, dt_s: float) -> float:
    """Width in Hz of a notch of a damping ratio: the inverse of `damping_of_width`, for the same corner t."""
    return float(np.arctan(2.0 * damping * corner / (1.0 + corner**2)) / (np.pi * dt_s))


class Part(ABC):
    """What `Cascade` asks of a part. A part is frozen and hashable: functions of a structure are cached by
    it.

    Nothing is checked here; `Specification` has refused what no part can be.
    """

    order: int

    @property
    def parameters(self) -> int:
        """How many parameters are free."""
        return len(self.bounds())

    @abstractmethod
    def coefficients(self, x: Any, exp: Callable[[Any], Any]) -> tuple[list[Any], list[Any]]:
        """Numerator and denominator in p, order + 1 coefficients each, highest power first, the denominator's
        first is 1. x: the part's own free parameters, numbers or symbols; exp: the exponential of these."""

    @abstractmethod
    def bounds(self) -> list[tuple[float, float]]:
        """Least and largest value of each free parameter, in the order of the vector."""

    def units(self, x: Real) -> list[float]:
        """A substantial change of each free parameter: 1 of logarithms."""
        return [1.0] * len(x)

    def log_damping(self) -> int | None:
        """Place of the free logarithm of a damping ratio among the part's own parameters; None without."""
        return None

    def pair(self, x: Real) -> tuple[float, float] | None:
        """Damping ratio and corner of the part's pair of poles; None where it has none."""
        return None


@dataclass(frozen=True)
class PidPart(Part):
    """Kp (1 + 1/(Ti p) + Td p/(Tf p + 1)) or a part of it; None is free.

    Attributes
    ----------
    structure : "p", "pi", "pd" or "pid"
    kp : float or None
        Command per error; not 0.
    ti, td, tf : float or None
        Times in units of 1/scale, positive; those that the structure has not are not read.
    shortest_filter : float
        Least Tf that is free, in units of 1/scale: half a sample, below which the filter's pole in z is
        negative and the command alternates.
    """

    structure: Structure
    kp: float | None
    ti: float | None
    td: float | None
    tf: float | None
    shortest_filter: float

    @property
    def order(self) -> int:  # type: ignore[override]
        """Number of states: one of the integrator, one of the filter."""
        return {"p": 0, "pi": 1, "pd": 1, "pid": 2}[self.structure]

    @property
    def has_integral(self) -> bool:
        """Whether it has Ti."""
        return self.structure in ("pi", "pid")

    @property
    def has_derivative(self) -> bool:
        """Whether it has Td and Tf."""
        return self.structure in ("pd", "pid")

    def values(self, x: Any, exp: Callable[[Any], Any]) -> tuple[Any, Any, Any, Any]:
        """Kp, Ti, Td, Tf of free parameters x, in units of the scale; None where the structure has none."""
        free = iter([x[i] for i in range(self.parameters)])
        kp = next(free) if self.kp is None else self.kp
        ti = None
        td = None
        tf = None
        if self.has_integral:
            ti = exp(next(free)) if self.ti is None else self.ti
        if self.has_derivative:
            tf = exp(next(free)) if self.tf is None else self.tf
            td = exp(next(free)) * tf if self.td is None else self.td
        return kp, ti, td, tf

    def coefficients(self, x: Any, exp: Callable[[Any], Any]) -> tuple[list[Any], list[Any]]:
        """As `Part.coefficients`: over the common denominator, which is p, p + 1/Tf or their product."""
        kp, ti, td, tf = self.values(x, exp)
        if self.structure == "p":
            return [kp], [1.0]
        if self.structure == "pi":
            return [kp, kp / ti], [1.0, 0.0]
        if self.structure == "pd":
            return [kp * (1.0 + td / tf), kp / tf], [1.0, 1.0 / tf]
        return [kp * (1.0 + td / tf), kp * (1.0 / tf + 1.0 / ti), kp / (ti * tf)], [1.0, 1.0 / tf, 0.0]

    def bounds(self) -> list[tuple[float, float]]:
        """As `Part.bounds`, of Kp, Ti, Tf and Td/Tf: Kp has none, Tf at least the half sample."""
        bounds = []
        if self.kp is None:
            bounds.append((-np.inf, np.inf))
        if self.has_integral and self.ti is None:
            bounds.append((-_LARGEST_LOG, _LARGEST_LOG))
        if self.has_derivative and self.tf is None:
            shortest = float(np.log(self.shortest_filter))
            longest = _SLOWEST_FILTER_LOG
            if self.td is not None:
                longest = float(np.log(self.td / DERIVATIVE_RATIOS[0]))
            bounds.append((shortest, max(shortest, longest)))
        if self.has_derivative and self.td is None:
            bounds.append((float(np.log(DERIVATIVE_RATIOS[0])), float(np.log(DERIVATIVE_RATIOS[1]))))
        return bounds

    def units(self, x: Real) -> list[float]:
        """As `Part.units`: of a free Kp its own size."""
        units = super().units(x)
        if self.kp is None:
            # Far below any gain: one that has come to nothing can still move.
            units[0] = max(abs(float(x[0])), 1e-9)
        return units


@dataclass(frozen=True)
class NotchPart(Part):
    """A notch; None is free. Static gain and gain at high frequency are 1.

    Attributes
    ----------
    corner : float or None
        w in units of the scale.
    damping : float or None
        zeta of the poles, below 1.
    width_tan : float or None
        tan(pi width dt) in place of a damping ratio, which then depends on the corner (`damping_of_width`).
    depth : float or None
        Gain beside the notch over that in its middle, a ratio above 1.
    half_sample : float
        h = dt scale/2.
    """

    corner: float | None
    damping: float | None
    width_tan: float | None
    depth: float | None
    half_sample: float
    order: int = 2

    @property
    def is_free(self) -> bool:
        """Whether nothing of it is fixed."""
        fixed = (self.corner, self.damping, self.width_tan, self.depth)
        return all(value is None for value in fixed)

    def values(self, x: Any, exp: Callable[[Any], Any]) -> tuple[Any, Any, Any]:
        """Corner, damping ratio and depth of free parameters x."""
        free = iter([x[i] for i in range(self.parameters)])
        corner = exp(next(free)) if self.corner is None else self.corner
        if self.width_tan is not None:
            t = corner * self.half_sample
            damping = self.width_tan * (1.0 / t + t) / 2.0
        else:
            damping = exp(next(free)) if self.damping is None else self.damping
        depth = exp(next(free)) if self.depth is None else self.depth
        return corner, damping, depth

    def coefficients(self, x: Any, exp: Callable[[Any], Any]) -> tuple[list[Any], list[Any]]:
        """As `Part.coefficients`."""
        corner, damping, depth = self.values(x, exp)
        swing = 2.0 * damping * corner
        return [1.0, swing / depth, corner**2], [1.0, swing, corner**2]

    def bounds(self) -> list[tuple[float, float]]:
        """As `Part.bounds`: a corner that is free stays below 80 % of Nyquist, and where the width is fixed,
        where the damping ratio stays below 1."""
        bounds = []
        if self.corner is None:
            low = float(np.exp(-_LARGEST_LOG))
            high = float(np.tan(_HIGHEST_OF_NYQUIST * np.pi / 2)) / self.half_sample
            if self.width_tan is not None:
                # zeta = width_tan (t + 1/t)/2 is at most the largest between the two roots in t.
                half_sum = NOTCH_DAMPING[1] / self.width_tan
                spread = float(np.sqrt(max(half_sum**2 - 1.0, 0.0)))
                low = max(low, (half_sum - spread) / self.half_sample)
                high = min(high, (half_sum + spread) / self.half_sample)
            bounds.append((float(np.log(low)), float(np.log(high))))
        if self.damping is None and self.width_tan is None:
            bounds.append((float(np.log(NOTCH_DAMPING[0])), float(np.log(NOTCH_DAMPING[1]))))
        if self.depth is None:
            bounds.append((0.0, float(np.log(_DEEPEST))))
        return bounds

    def log_damping(self) -> int | None:
        """As `Part.log_damping`."""
        if self.damping is not None or self.width_tan is not None:
            return None
        return int(self.corner is None)

    def pair(self, x: Real) -> tuple[float, float] | None:
        """As `Part.pair`."""
        corner, damping, _ = self.values(x, np.exp)
        return float(damping), float(corner)


@dataclass(frozen=True)
class LowPassPart(Part):
    """A low-pass of first or second order; None is free. Its static gain is 1.

    Attributes
    ----------
    order : 1 or 2
    corner : float or None
        w in units of the scale.
    damping : float or None
        zeta, below 1; not read of the first order.
    half_sample : float
        h = dt scale/2.
    """

    order: int
    corner: float | None
    damping: float | None
    half_sample: float

    def values(self, x: Any, exp: Callable[[Any], Any]) -> tuple[Any, Any]:
        """Corner, and damping ratio (None of the first order), of free parameters x."""
        free = iter([x[i] for i in range(self.parameters)])
        corner = exp(next(free)) if self.corner is None else self.corner
        damping = None
        if self.order == 2:
            damping = exp(next(free)) if self.damping is None else self.damping
        return corner, damping

    def coefficients(self, x: Any, exp: Callable[[Any], Any]) -> tuple[list[Any], list[Any]]:
        """As `Part.coefficients`."""
        corner, damping = self.values(x, exp)
        if self.order == 1:
            return [0.0, corner], [1.0, corner]
        return [0.0, 0.0, corner**2], [1.0, 2.0 * damping * corner, corner**2]

    def bounds(self) -> list[tuple[float, float]]:
        """As `Part.bounds`: a corner that is free stays below 80 % of Nyquist."""
        bounds = []
        if self.corner is None:
            highest = float(np.tan(_HIGHEST_OF_NYQUIST * np.pi / 2)) / self.half_sample
            bounds.append((-_LARGEST_LOG, float(np.log(highest))))
        if self.order == 2 and self.damping is None:
            bounds.append((float(np.log(_LOW_PASS_DAMPING[0])), float(np.log(_LOW_PASS_DAMPING[1]))))
        return bounds

    def log_damping(self) -> int | None:
        """As `Part.log_damping`."""
        if self.order == 1 or self.damping is not None:
            return None
        return int(self.corner is None)

    def pair(self, x: Real) -> tuple[float, float] | None:
        """As `Part.pair`; None of the first order."""
        if self.order == 1:
            return None
        corner, damping = self.values(x, np.exp)
        return float(damping), float(corner)
