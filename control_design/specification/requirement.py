"""What a requirement is: the closed-loop function it bounds, its weight, its check and its caption.

With K the controller and G a member of the uncertainty, four functions are everything a linear loop does:

    S = 1/(1 + G K),   K S,   G S,   T = G K S.

A weighted requirement asks max |W f| <= 1 over the ellipses for one of them. Everything numerical (worst
case, programmes of the synthesis, bounds between grid points, achievable performance) knows these four and
no requirement by name; slopes and curvatures follow from the powers of K and G.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar, Literal

import numpy as np

from control_design.controllers.biquads import imaginary_axis
from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Real
from control_design.plants.plant_set import Mode, PlantChannel
from control_design.plants.weights import RationalWeight

# Share by which a bound for all frequencies may exceed a limit that the dense maximum meets: twice the excess
# `LEAST_EXCESS` to which such bounds are cut (`between_grid_points`). Without it a design on its limit would
# not be proved.
_PROOF_SLACK = 2e-5


class LoopFunction(Enum):
    """K^a G^b/(1 + G K), value (a, b)."""

    SENSITIVITY = (0, 0)
    EFFORT = (1, 0)
    DISTURBANCE = (0, 1)
    COMPLEMENTARY = (1, 1)

    @property
    def of_controller(self) -> bool:
        """Whether K is a factor."""
        return self in (LoopFunction.EFFORT, LoopFunction.COMPLEMENTARY)

    @property
    def of_plant(self) -> bool:
        """Whether the member G is a factor."""
        return self in (LoopFunction.DISTURBANCE, LoopFunction.COMPLEMENTARY)


@dataclass(frozen=True)
class SpecificationItem:
    """One requirement on one plant: met or not, with the number that decides it and where.

    Attributes
    ----------
    requirement, plant : str
        What is asked, in words, and of whom.
    required, achieved : float
        The limit, and the number that decides.
    unit : str
        Of both; "" for ratios.
    met : bool
    omega_rad_s : float or None
        Where `achieved` is reached; None: it has no frequency.
    bound : float or None
        What was proved of `achieved` for all frequencies, where that was possible.
    at_least : bool
        `required` is the smallest value allowed, else the largest.
    about : str
        What `achieved` is a number of.
    """

    requirement: str
    plant: str
    required: float
    achieved: float
    unit: str
    met: bool
    omega_rad_s: float | None = None
    bound: float | None = None
    at_least: bool = False
    about: Literal["worst case", "nominal loop", "controller", "sampled responses"] = "worst case"

    @property
    def proved(self) -> bool:
        """Whether it is met for all frequencies by proof.

        False where no bound could be had, or it is inf or nan.
        """
        return self.met and self.bound is not None and bool(np.isfinite(self.bound))

    @property
    def only_unproved(self) -> bool:
        """Whether `achieved` is enough and what was proved of it for all frequencies is not.

        A nan in either number is no yes.
        """
        if self.met or self.bound is None:
            return False
        # The limit lies between the two.
        excess = self.achieved - self.required
        excess_of_bound = self.bound - self.required
        return excess * excess_of_bound <= 0.0


@dataclass(frozen=True)
class Findings:
    """What was found out about one loop, for requirements to decide on.

    Attributes
    ----------
    plant : str
        Its name.
    peaks : mapping of str to (float, float or None)
        By name of the weighted requirement: its largest value over ellipses and grid, and where, rad/s; nan
        and None where the loop is not stable.
    bounds : mapping of str to float, or None
        Upper bounds of these for all frequencies; None where nothing can be proved.
    modulus : (float, float or None)
        Smallest distance from -1, and where, rad/s; nan and None where the loop is not stable.
    delay_s : float
        Worst delay margin, s; inf without a crossing, nan where the loop is not stable.
    modes : sequence of Mode
        Oscillatory pole pairs of the nominal closed loop: rad/s and damping ratio of each.
    controller : Controller
        Its `poles` in z and `dt_s` are read by requirements on it alone.
    """

    plant: str
    peaks: Mapping[str, tuple[float, float | None]]
    bounds: Mapping[str, float] | None
    modulus: tuple[float, float | None]
    delay_s: float
    modes: Sequence[Mode]
    controller: Controller

    def proved(self, name: str) -> bool:
        """Whether a requirement is shown to hold for all frequencies, where that can be shown at all.

        name: of the requirement; without a bound of its own it is not shown. True where `bounds` is None.
        """
        return self.bounds is None or self.bounds.get(name, np.inf) <= 1.0 + _PROOF_SLACK


class Requirement(ABC):
    """One requirement on one plant; `Specification.requirements` makes those that are asked."""

    caption: ClassVar[str]

    @abstractmethod
    def check(self, found: Findings) -> SpecificationItem:
        """Met or not, and the number that decides.

        A number that is nan meets nothing.
        """


@dataclass(frozen=True, eq=False)
class WeightedRequirement(Requirement):
    """max |W f| <= 1 over the ellipses of one plant, f a closed-loop function.

    Attributes
    ----------
    name : str
        Key of its peak and its bound in `Findings`.
    function : LoopFunction
        The closed-loop function f.
    weight : RationalWeight
        W(s), seen through the Tustin frequency s = j (2/dt) tan(omega dt/2), rad/s.
    band : (float, float) or None
        Frequencies, rad/s, where it is asked; None: all.
    above : float
        It is asked only where |W| is larger: below, another requirement asks more.
    channel : PlantChannel or None
        An independent response Gp in place of the factor G of f; every pair of members is then allowed.
    """

    name: ClassVar[str]
    function: ClassVar[LoopFunction]

    weight: RationalWeight
    band: tuple[float, float] | None = None
    above: float = 0.0
    channel: PlantChannel | None = None

    @property
    def of_member(self) -> LoopFunction:
        """Closed-loop function of the member: f without the factor that an independent channel replaces.

        A factor K stays. Nothing can be refused.
        """
        if self.channel is None:
            return self.function
        if self.function.of_controller:
            return LoopFunction.EFFORT
        return LoopFunction.SENSITIVITY

    def magnitude(self, omega_rad_s: Real, dt_s: float) -> Real:
        """|W| (F,) at omega (F,), 0 where nothing is asked; without the independent channel.

        omega in rad/s, dt_s in seconds. At Nyquist s is infinite but for rounding, and W has its value there.
        Inf where the weight has a pole on omega; nothing is checked.
        """
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        size = np.abs(self.weight.at(imaginary_axis(omega, dt_s)))
        size = np.where(size > self.above, size, 0.0)
        if self.band is not None:
            low, high = self.band
            is_in_band = np.logical_and(omega >= low, omega <= high)
            size = np.where(is_in_band, size, 0.0)
        return np.asarray(size, dtype=np.float64)

    def check(self, found: Findings) -> SpecificationItem:
        """Item with the largest |W f|, met where it and its bound, if one can be had, are at most 1.

        KeyError where `found.peaks` has no value of this requirement; nan (a loop that is not stable) is not
        met.
        """
        value, omega_rad_s = found.peaks[self.name]
        bound = None
        if found.bounds is not None:
            # Without a bound of its own it is not proved.
            bound = found.bounds.get(self.name, np.inf)
        return SpecificationItem(
            requirement=self.caption,
            plant=found.plant,
            required=1.0,
            achieved=value,
            unit="",
            met=bool(value <= 1.0) and found.proved(self.name),
            omega_rad_s=omega_rad_s,
            bound=bound,
        )


def constant_weight(value: float) -> RationalWeight:
    """W = value at all frequencies.

    pydantic's ValidationError, a ValueError, where it is 0 or not finite.
    """
    return RationalWeight(numerator=(value,), denominator=(1.0,))
