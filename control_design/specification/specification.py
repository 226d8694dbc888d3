"""What the loop has to do, in the engineer's words, and the weights built from it.

For the worst member of the uncertainty ellipses, at the Tustin frequency s = j (2/dt) tan(omega dt/2):

    |W1 S| <= 1   tracking and modulus margin    W1 = max(|(m s + wb)/(s + wb r)|, m)
    |W3 K S| <= 1 effort                         W3 = (s/wr + 1)/(s/(40 wr) + 1)/effort_limit
    |W4 Gp S| <= 1 damping of the flexible modes W4 = 1/(ratio x open-loop peak) inside the band, 0 outside

with m the modulus margin, r the low-frequency rejection (0 with an integrator) and wb = bandwidth sqrt(2 -
m^2), so that |W1| is at least sqrt 2 (-3 dB of S) up to the bandwidth.

`Specification` holds the words and makes the weights. Each requirement is a class of its own below it, with
`of(specification, plant)`, which makes it where it is asked, and `check(findings)`, which decides;
`REQUIREMENTS` lists those of a plant's loop. `Specification.check_against` refuses, before anything is
optimised, what no controller can meet (the functions `_refuse_...`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from control_design.controllers.biquads import SOLVER_SLACK, Cascade, SectionKind
from control_design.plants.ellipses import Real
from control_design.plants.frequency_grid import lowest_rad_s
from control_design.plants.plant_set import (
    Mode,
    UncertainPlant,
    count_integrators,
    frequency_response,
)
from control_design.plants.weights import (
    RationalWeight,
    bandwidth_weight,
    effort_limit_weight,
    integral_corner,
)
from control_design.specification.requirement import (
    Findings,
    LoopFunction,
    Requirement,
    SpecificationItem,
    WeightedRequirement,
    constant_weight,
)
from control_design.specification.structure import (
    PID_STRUCTURES,
    Fixed,
    LowPass,
    Notch,
    order_of_structure,
    parts_of,
    refuse_contradictions,
    refuse_sampling,
)
from ident.data.settings import Settings

if TYPE_CHECKING:
    import control

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]

# Relative difference of two sampling times that counts as none: they come as decimal numbers of logs.
_SAME_PERIOD = 1e-6
# Factor either side of the lowest mode that makes the band of the damping requirement where none is given;
# the field's description promises it.
_BAND_OF_MODE = 1.5
# Frequency, rad per sample, below which an integrating plant is its integrator and no more: a band that
# starts there has no finite open-loop peak. Ten times the lowest frequency of the grids.
_INTEGRATES_BELOW_RAD = 5e-6
# Distance of a zero from z = 1 that an integrator would cancel: rounding of a zero that is at 1, whose double
# splits by 1e-8.
_ZERO_AT_ONE = 1e-6
# Modulus beyond which a zero lies outside the circle, but for rounding.
_OUTSIDE_CIRCLE = 1.0 + 1e-9
# Halvings with which the largest possible bandwidth is told: more than a double has digits.
_HALVINGS = 60
# Largest order of a controller: room for seven notches beside a PID. Chosen.
_LARGEST_ORDER = 16
# Frequencies at which tracking and effort are compared, 0.4 % from one to the next. Chosen; a conflict that
# is narrower is found later, by the certificate.
_POINTS_OF_CONFLICT = 4000

# Frequencies, on a logarithmic scale, at which an open-loop peak is sought before the modes get their own:
# 0.04 % from one to the next in a band of a factor 2.25. Chosen.
_POINTS_OF_PEAK = 2000
# Points around each mode where that peak is sought: twenty in each half width next to its middle, so that the
# peak is met within 0.1 %.
_POINTS_OF_MODE = 121

# Reach of these points, sinh 3 = 10 half widths either side, where a mode is a tenth of its peak.
_REACH_OF_MODE = 3

# Damping ratio that they take at least, so that they are different numbers.
_LEAST_DAMPING = 1e-9
# Least divisor, and least bandwidth, rad/s: keeps both above zero.
_TINY = 1e-300


# Keys that may give way, by the key that says how far. The modulus margin is not among them: it is what keeps
# a loop safe where the plant is not what was identified. Nor is the damping of the controller, its order, or
# a limit of the machine.
GIVES_WAY = {
    "bandwidth_rad_s": "lowest_bandwidth_rad_s",
    "effort_limit": "highest_effort_limit",
    "mode_peak_ratio": "highest_mode_peak_ratio",
}


class SpecificationError(ValueError):
    """The specification contradicts itself or the plant; no controller of any order can meet it."""


class Specification(Settings):
    """Requirements on the closed loop, for every plant in the uncertainty set.

    Examples
    --------
    >>> flexlink.Specification(bandwidth_rad_s=5.0, structure="pid", notches=[{}]).modulus_margin
    0.5
    """

    bandwidth_rad_s: _Positive | None = Field(
        default=None,
        description="|S| stays below -3 dB up to here, rad/s; none = no tracking requirement (pure damping)",
    )
    lowest_bandwidth_rad_s: _Positive | None = Field(
        default=None,
        description="where bandwidth_rad_s cannot be met, the highest that can, down to here; none = "
        "bandwidth_rad_s as it stands",
    )
    tracking_from_rad_s: _Positive | None = Field(
        default=None,
        description="tracking is asked from here on, rad/s; none = at all frequencies, or above those where "
        "the ellipses hold a gain of zero, with which no controller tracks",
    )
    integrator: bool = Field(default=False, description="the controller has a pole at z = 1")
    # Chosen: 60 dB.
    low_frequency_rejection: float = Field(
        default=1e-3,
        gt=0,
        lt=1,
        description="largest |S| towards zero frequency; with bandwidth_rad_s and without integrator",
    )
    # The usual: |S| of at most 2, hence a gain margin of 2 and a phase margin of 29 degrees.
    modulus_margin: float = Field(
        default=0.5, gt=0, lt=1, description="smallest distance of the loop from -1 (1/max|S|)"
    )
    effort_limit: _Positive | None = Field(
        default=None, description="largest |K S|, input unit per measured unit; none = not limited"
    )
    highest_effort_limit: _Positive | None = Field(
        default=None,
        description="where effort_limit cannot be met with the rest (at the lowest bandwidth), as little "
        "more as is needed, up to here; none = effort_limit as it stands",
    )
    effort_rolloff_rad_s: _Positive | None = Field(
        default=None, description="above it the limit on |K S| falls with 1/frequency"
    )
    delay_margin_s: _Positive | None = Field(
        default=None, description="extra loop delay that the loop must tolerate, s"
    )
    mode_peak_ratio: _Positive | None = Field(
        default=None,
        description="peak of |Gp S| in the mode's band over the open-loop peak of |Gp| there: below 1 the "
        "loop has to damp the mode, above 1 it may raise it by that much",
    )
    highest_mode_peak_ratio: _Positive | None = Field(
        default=None,
        description="where mode_peak_ratio cannot be met with the rest (at the lowest bandwidth), as little "
        "more as is needed, up to here; none = mode_peak_ratio as it stands",
    )
    mode_damping: float | None = Field(
        default=None,
        gt=0,
        lt=1,
        description="smallest damping ratio of the nominal closed-loop modes inside mode_band_rad_s; "
        "checked by the certificate, not seen by the optimiser",
    )
    mode_band_rad_s: tuple[float, float] | None = Field(
        default=None,
        description="band of the damping requirement; none = a factor 1.5 either side of the lowest mode",
    )
    input_limit: _Positive | None = Field(
        default=None, description="saturation of the command (both signs), input unit"
    )
    rate_limit: _Positive | None = Field(
        default=None, description="largest change of the command, input unit per second"
    )
    # Chosen: 4 is an integrator, a lead and one notch.
    controller_order: Annotated[int, Field(ge=0, le=_LARGEST_ORDER)] | Literal["auto"] = Field(
        default=4,
        description="number of controller states, with lowest_bandwidth_rad_s at most: fewer where the step "
        "then settles sooner with the identified friction; auto: the lowest within 2 % of what a controller "
        "of any order reaches; of structure p, pi, pd or pid: what their parts have",
    )
    structure: Literal["biquads", "p", "pi", "pd", "pid"] = Field(
        default="biquads",
        description="biquads: free cascade of controller_order; p, pi, pd, pid: Kp (1 + 1/(Ti s) + Td s/(Tf "
        "s + 1)) or a part of it, with notches and low_pass; numbers that are given are fixed, the others "
        "are chosen by the synthesis",
    )
    fixed: Fixed = Field(
        default=Fixed(),
        description="numbers of p, pi, pd, pid that are fixed: kp, ti_s, td_s, tf_s, e.g. {ti_s = 0.5}",
    )
    notches: tuple[Notch, ...] = Field(
        default=(),
        description="notches of p, pi, pd, pid, each with frequency_hz, depth_db and width_hz (or damping), "
        "as far as they are fixed: [{frequency_hz = 22.9, depth_db = 10}, {}] has a second one that is free",
    )
    low_pass: LowPass | None = Field(
        default=None,
        description="low-pass of p, pi, pd, pid, with frequency_hz, order and damping, as far as they are "
        "fixed: {frequency_hz = 200, damping = 0.7}; {}: of order 2, free; none without",
    )
    controller_damping: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="smallest damping ratio of the controller's own pole pairs; prevents a controller "
        "resonance at a notch of the plant, which would ring in closed loop (default: none; for plants known "
        "on their own frequencies only, half the relative spacing of these)",
    )
    controller_dt_s: _Positive | None = Field(
        default=None,
        description="period of the new controller, s: a whole multiple or part of the step of the logs; "
        "default: that step (certificate, simulation and C code are about this rate)",
    )
    # One sample: the usual of a controller that computes during a period. At most 10, chosen: more is a
    # mistake.
    computational_delay_samples: int = Field(
        default=1,
        ge=0,
        le=10,
        description="samples between measuring and applying the command, added to the delay that the "
        "plant's model holds: 0 if that model starts at the command computed from the same sample",
    )
    sensitivity_weight: RationalWeight | None = Field(
        default=None, description="W1 itself, instead of bandwidth_rad_s"
    )
    effort_weight: RationalWeight | None = Field(
        default=None, description="W3 itself, instead of effort_limit"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Specification:
        """Return self; ValueError, with the keys, for settings that contradict each other.

        Integrator and order of a structure p, pi, pd or pid follow from it; they are set here, and stay
        settings that nobody has stated.
        """
        # Tracking and effort: in words or as a weight.
        if self.sensitivity_weight is not None and self.bandwidth_rad_s is not None:
            raise ValueError("give bandwidth_rad_s or sensitivity_weight, not both")
        if self.tracking_from_rad_s is not None and not self.asks_tracking:
            raise ValueError("tracking_from_rad_s needs bandwidth_rad_s or sensitivity_weight")
        if self.lowest_bandwidth_rad_s is not None:
            bandwidth = self.bandwidth_rad_s
            if bandwidth is None or not self.lowest_bandwidth_rad_s < bandwidth:
                raise ValueError(
                    "lowest_bandwidth_rad_s needs a larger bandwidth_rad_s, which is tried first"
                )
        for key in ("effort_limit", "mode_peak_ratio"):
            value = getattr(self, key)
            highest = getattr(self, GIVES_WAY[key])
            if highest is not None and (value is None or not value < highest):
                raise ValueError(f"{GIVES_WAY[key]} needs a smaller {key}, which is tried first")
        if self.effort_weight is not None and (self.effort_limit or self.effort_rolloff_rad_s):
            raise ValueError("give effort_limit (with effort_rolloff_rad_s) or effort_weight, not both")
        if self.effort_rolloff_rad_s is not None and self.effort_limit is None:
            raise ValueError("effort_rolloff_rad_s needs effort_limit")
        # Damping of modes: the nominal damping ratio needs a band, the peak may take that of the lowest mode.
        if self.mode_band_rad_s is not None:
            low, high = self.mode_band_rad_s
            if not (0 < low < high and np.isfinite(high)):
                raise ValueError(f"mode_band_rad_s needs 0 < low < high; got {low}, {high}")
            if self.mode_peak_ratio is None and self.mode_damping is None:
                raise ValueError("mode_band_rad_s needs mode_peak_ratio or mode_damping")
        if self.mode_damping is not None and self.mode_band_rad_s is None:
            raise ValueError("mode_damping needs mode_band_rad_s: the band whose modes are meant")
        # Orders that the structure can have.
        refuse_contradictions(self)
        if self.controller_order == "auto":
            if self.structure != "biquads":
                raise ValueError("controller_order = 'auto' needs structure 'biquads'; give a number")
            return self
        if self.structure in PID_STRUCTURES:
            self._take_from_structure()
            return self
        if self.controller_order < 1:
            raise ValueError(f"controller_order must be at least 1; got {self.controller_order}")
        return self

    def _take_from_structure(self) -> None:
        """Set integrator and controller_order to those of the structure; ValueError where others are stated
        or the order is too large."""
        follows = {
            "integrator": self.structure in ("pi", "pid"),
            "controller_order": order_of_structure(self),
        }
        if follows["controller_order"] > _LARGEST_ORDER:
            raise ValueError(
                f"structure {self.structure!r} with {len(self.notches)} notches has order "
                f"{follows['controller_order']}; at most {_LARGEST_ORDER}"
            )
        for key, value in follows.items():
            stated = getattr(self, key)
            if key in self.model_fields_set and stated != value:
                raise ValueError(
                    f"{key} = {str(stated).lower()}, but structure {self.structure!r} has "
                    f"{str(value).lower()} by itself: leave {key} out"
                )
            # The class is frozen for its users; this is still its making.
            self.__dict__[key] = value

    def cascade(self, dt_s: float, scale_rad_s: float) -> Cascade:
        """Structure of the controller: integrator, sections of first order, sections of second order; or the
        parts of p, pi, pd and pid.

        Parameters
        ----------
        dt_s : float
            Period of the controller, s.
        scale_rad_s : float
            Frequency at which its parameters are of size one, rad/s.

        Raises
        ------
        SpecificationError
            controller_order is "auto".
        """
        if self.structure in PID_STRUCTURES:
            return Cascade(parts_of(self, dt_s, scale_rad_s), dt_s, scale_rad_s)
        if self.controller_order == "auto":
            raise SpecificationError(
                "controller_order = 'auto': the synthesis chooses it; give a number here"
            )
        kinds: list[SectionKind] = []
        if self.integrator:
            kinds.append("integrator")
        n_left = self.controller_order - len(kinds)
        # What order is left goes to sections of second order, which have real or complex poles.
        kinds += ["first_order"] * (n_left % 2)
        kinds += ["second_order"] * (n_left // 2)
        return Cascade(tuple(kinds), dt_s, scale_rad_s)

    def refuse_sampling(self, dt_s: float) -> None:
        """Refuse fixed notches, low-pass and Tf that a controller of this period, s, cannot have.

        Raises
        ------
        SpecificationError
            One line with the key and what is possible.
        """
        try:
            refuse_sampling(self, self.controller_dt_s or dt_s)
        except ValueError as error:
            raise SpecificationError(str(error)) from None

    @property
    def asks_tracking(self) -> bool:
        """Whether S is weighed at low frequency, by a bandwidth or a weight of its own."""
        return self.bandwidth_rad_s is not None or self.sensitivity_weight is not None

    def tracking_weight(self, plant: UncertainPlant | None = None) -> RationalWeight | None:
        """W1 without the modulus margin; None without a tracking requirement.

        plant: whose slow poles add to the slope that an integrator of the controller asks for; None: a plant
        without any.

        Of the plant its poles, zeros and integrators are read; W1 is a rational function of s, rad/s. Not
        checked: the bandwidth against Nyquist (`check_against` does that).
        """
        if self.sensitivity_weight is not None or self.bandwidth_rad_s is None:
            return self.sensitivity_weight
        # Where the controller integrates |S| has to fall to zero, with a plant's slow poles the faster.
        floor = self.low_frequency_rejection
        slow_poles: tuple[float, ...] = ()
        if self.integrator:
            floor = 0.0
            if plant is not None:
                corner = integral_corner(self.bandwidth_rad_s, self.modulus_margin)
                slow_poles = plant.slow_poles_rad_s(corner)
        return bandwidth_weight(self.bandwidth_rad_s, self.modulus_margin, floor, slow_poles_rad_s=slow_poles)

    def limit_weight(self) -> RationalWeight | None:
        """W3, or None where effort is not limited.

        W3 is a rational function of s, rad/s. Validation has checked its parts.
        """
        if self.effort_weight is not None or self.effort_limit is None:
            return self.effort_weight
        return effort_limit_weight(self.effort_limit, self.effort_rolloff_rad_s)

    def requirements(self, plant: UncertainPlant) -> tuple[Requirement, ...]:
        """Requirements on the loop of one plant that are asked, in the order of `REQUIREMENTS`.

        Raises
        ------
        SpecificationError
            Damping of a mode is asked for, and the plant has none.
        ValueError
            By numpy, where the mode's band begins above Nyquist; `check_against` refuses that before.
        """
        requirements: list[Requirement] = []
        for kind in REQUIREMENTS:
            requirement = kind.of(self, plant)
            if requirement is not None:
                requirements.append(requirement)
        return tuple(requirements)

    def weighted(self, plant: UncertainPlant) -> tuple[WeightedRequirement, ...]:
        """The requirements on the loop of one plant that bound a closed-loop function.

        Never empty: the modulus margin is one of them. Raises what `requirements` raises.
        """
        requirements = self.requirements(plant)
        return tuple(each for each in requirements if isinstance(each, WeightedRequirement))

    def on_controller(self) -> tuple[Requirement, ...]:
        """Requirements on the controller alone.

        Empty where none is asked; nothing can be refused.
        """
        requirements: list[Requirement] = []
        if self.controller_damping is not None:
            requirements.append(ControllerDamping(self.controller_damping))
        if self.integrator:
            requirements.append(ControllerIntegrator())
        return tuple(requirements)

    def magnitude(self, plant: UncertainPlant, omega_rad_s: Real, function: LoopFunction) -> Real:
        """|W| (F,) on one closed-loop function, all requirements on it together; zeros where none is.

        omega_rad_s (F,), rad/s; function: S, K S, G S or T, as it is asked of the plant. Raises what
        `requirements` raises; omega is not checked.
        """
        sizes = [
            each.magnitude(omega_rad_s, plant.dt_s)
            for each in self.weighted(plant)
            if each.function is function
        ]
        if not sizes:
            return np.zeros(np.shape(omega_rad_s))
        return np.asarray(np.max(sizes, axis=0), dtype=np.float64)

    def refuse_other_rate(self, plants: Sequence[UncertainPlant]) -> None:
        """Refuse plants with another sampling time than `controller_dt_s`.

        Raises
        ------
        SpecificationError
            One line, with both steps, for the first such plant. Nothing is refused without `controller_dt_s`,
            or without plants.
        """
        wanted_s = self.controller_dt_s
        if wanted_s is None:
            return
        for plant in plants:
            if abs(plant.dt_s - wanted_s) > _SAME_PERIOD * wanted_s:
                raise SpecificationError(
                    f"controller_dt_s = {wanted_s:.6g} s, but plant {plant.name!r} is sampled every "
                    f"{plant.dt_s:.6g} s: leave controller_dt_s out, or give it to flexlink run "
                    f"(--from RUN --controller-dt-s {wanted_s:.6g}), which brings the arm to this rate"
                )

    def check_against(self, plants: Sequence[UncertainPlant]) -> None:
        """Refuse a specification that no controller can meet, before optimising.

        Parameters
        ----------
        plants : sequence of UncertainPlant
            Their nominal models count.

        Raises
        ------
        SpecificationError
            One line: which requirement, what limits it, by how much.

        Notes
        -----
        At a zero w of G outside the circle (also the one at z = infinity that a sample of delay makes) S(w) =
        1, hence max|W1 S| >= |W1(w)| for a stable loop. On the circle 1 = S + G K S gives gamma >= 1/(1/|W1|
        + |G|/|W3|). Both use the nominal plant, so they are necessary conditions only.
        """
        if not plants:
            raise SpecificationError("no plant given: the design needs at least one uncertain plant")
        periods_s = {plant.dt_s for plant in plants}
        if len(periods_s) > 1:
            raise SpecificationError(
                f"the plants differ in sampling time: {[p.dt_s for p in plants]} s; sample all "
                "with one period"
            )
        self.refuse_other_rate(plants)
        self.refuse_sampling(plants[0].dt_s)
        for plant in plants:
            _refuse_frequencies(self, plant)
            _refuse_zeros(self, plant)
            _refuse_effort(self, plant)
            # Called for its error: damping of a mode that the plant has not.
            self.requirements(plant)


class Tracking(WeightedRequirement):
    """|W1 S| <= 1 where W1 asks for more than the modulus margin."""

    name = "tracking"
    caption = "tracking, largest |W1 S|"
    function = LoopFunction.SENSITIVITY

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> Tracking | None:
        """Requirement with the specification's weight for this plant; None where tracking is not asked.

        spec: its bandwidth or sensitivity weight. Raises nothing.
        """
        weight = spec.tracking_weight(plant)
        if weight is None:
            return None
        band = None
        if spec.tracking_from_rad_s is not None:
            band = (spec.tracking_from_rad_s, np.inf)
        # Where the weight asks for no more than the modulus margin, that requirement asks it already.
        return cls(weight, band, above=spec.modulus_margin)

    def check(self, found: Findings) -> SpecificationItem:
        """Item as of every weighted requirement, with the frequency from which on it is asked."""
        item = super().check(found)
        if self.band is None:
            return item
        return replace(item, requirement=f"{self.caption}, from {self.band[0]:.3g} rad/s on")


class ModulusMargin(WeightedRequirement):
    """|m S| <= 1: the loop keeps the distance m from -1."""

    name = "modulus"
    caption = "modulus margin, worst case"
    function = LoopFunction.SENSITIVITY

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> ModulusMargin:
        """Requirement with the specification's margin; always asked.

        Raises nothing: validation has put the margin between 0 and 1.
        """
        return cls(constant_weight(spec.modulus_margin))

    def check(self, found: Findings) -> SpecificationItem:
        """Item in terms of the distance from -1 itself, of which a bound of |m S| makes a lower bound.

        found: `modulus` (distance, rad/s) and `bounds` are read. A nan distance is not met.
        """
        wanted = self.weight.numerator[0]
        achieved, omega_rad_s = found.modulus
        bound = None
        if found.bounds is not None:
            bound = wanted / found.bounds.get(self.name, np.inf)
        return SpecificationItem(
            requirement=self.caption,
            plant=found.plant,
            required=wanted,
            achieved=achieved,
            unit="",
            met=bool(achieved >= wanted) and found.proved(self.name),
            omega_rad_s=omega_rad_s,
            bound=bound,
            at_least=True,
        )


class Effort(WeightedRequirement):
    """|W3 K S| <= 1."""

    name = "effort"
    caption = "effort, largest |W3 K S|"
    function = LoopFunction.EFFORT

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> Effort | None:
        """Requirement with the specification's weight; None where effort is not limited.

        Raises nothing; the plant is not read.
        """
        weight = spec.limit_weight()
        if weight is None:
            return None
        return cls(weight)


class ModePeak(WeightedRequirement):
    """|W4 Gp S| <= 1 in the band of the flexible mode, W4 = 1/(ratio x open-loop peak of the nominal Gp)."""

    name = "mode damping"
    caption = "damping of the mode, largest |W4 Gp S|"
    function = LoopFunction.DISTURBANCE

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> ModePeak | None:
        """Requirement on this plant's damped channel; None where mode_peak_ratio is not given.

        Raises
        ------
        SpecificationError
            The plant has no flexible mode and no band is given.
        ValueError
            By numpy, where the band begins above Nyquist (`check_against` refuses that before).
        """
        if spec.mode_peak_ratio is None:
            return None
        band = spec.mode_band_rad_s
        if band is None:
            modes = plant.damped.modes
            if not modes:
                raise SpecificationError(
                    f"mode_peak_ratio: plant {plant.name!r} has no lightly damped mode; give mode_band_rad_s"
                )
            lowest_rad_s = modes[0].omega_rad_s
            band = (lowest_rad_s / _BAND_OF_MODE, lowest_rad_s * _BAND_OF_MODE)
        # Above Nyquist there is no response to take a peak of.
        band_end = min(band[1], plant.nyquist_rad_s)
        damped = plant.damped
        open_loop_peak = _nominal_peak(damped.nominal, damped.modes, band[0], band_end)
        weight = constant_weight(1.0 / (spec.mode_peak_ratio * open_loop_peak))
        return cls(weight, band, channel=plant.performance)


# Kept for the last 32 models and bands: every grid of a synthesis asks for the requirements of its plant, and
# a certificate for those of the plant at some twenty levels of its ellipses.
@lru_cache(maxsize=32)
def _nominal_peak(
    nominal: control.StateSpace, modes: tuple[Mode, ...], low_rad_s: float, high_rad_s: float
) -> float:
    """Largest gain of a channel's nominal in a band, on a grid that is finer around its modes.

    low_rad_s, high_rad_s: ends of the band, 0 < low < high, not checked: an empty band is numpy's ValueError,
    a band with an integrator's pole gives a huge value. Units of output per input.
    """
    omega = np.geomspace(low_rad_s, high_rad_s, _POINTS_OF_PEAK)
    for mode in modes:
        half_width = max(mode.zeta, _LEAST_DAMPING) * mode.omega_rad_s
        offsets = np.sinh(np.linspace(-_REACH_OF_MODE, _REACH_OF_MODE, _POINTS_OF_MODE))
        omega = np.append(omega, mode.omega_rad_s + half_width * offsets)
    is_in_band = np.logical_and(omega >= low_rad_s, omega <= high_rad_s)
    response = frequency_response(nominal, np.unique(omega[is_in_band]))
    return float(np.max(np.abs(response)))


@dataclass(frozen=True)
class DelayMargin(Requirement):
    """The loop stands this much more delay, s; the synthesis carries a delayed copy of every plant."""

    delay_s: float
    caption = "delay margin, worst case"

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> DelayMargin | None:
        """Requirement with the specification's delay; None where it is not asked.

        Raises nothing; the plant is not read.
        """
        if spec.delay_margin_s is None:
            return None
        return cls(spec.delay_margin_s)

    def check(self, found: Findings) -> SpecificationItem:
        """Item with the worst delay margin, s.

        found: `delay_s` is read; nan, of a loop that is not stable, is not met.
        """
        return SpecificationItem(
            requirement=self.caption,
            plant=found.plant,
            required=self.delay_s,
            achieved=found.delay_s,
            unit="s",
            met=bool(found.delay_s >= self.delay_s),
            at_least=True,
        )


@dataclass(frozen=True)
class ModeDamping(Requirement):
    """Least damped mode of the nominal closed loop in a band; without one there, damping is no issue."""

    zeta: float
    band: tuple[float, float]
    caption = "damping ratio of the nominal closed loop's modes"

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> ModeDamping | None:
        """Requirement with the specification's ratio and band; None where it is not asked.

        Raises nothing: validation asks for a band with the ratio. The plant is not read.
        """
        if spec.mode_damping is None or spec.mode_band_rad_s is None:
            return None
        return cls(spec.mode_damping, spec.mode_band_rad_s)

    def check(self, found: Findings) -> SpecificationItem:
        """Item with the smallest damping ratio in the band; 1, and no frequency, without a mode there.

        found: `modes` are read, also those of a loop that is not stable (zeta negative).
        """
        low_rad_s, high_rad_s = self.band
        inside = [mode for mode in found.modes if low_rad_s <= mode.omega_rad_s <= high_rad_s]
        achieved = 1.0
        omega_rad_s = None
        met = True
        if inside:
            least_damped = min(inside, key=lambda mode: mode.zeta)
            achieved = least_damped.zeta
            omega_rad_s = least_damped.omega_rad_s
            met = achieved >= self.zeta
        return SpecificationItem(
            requirement=self.caption,
            plant=found.plant,
            required=self.zeta,
            achieved=achieved,
            unit="",
            met=met,
            omega_rad_s=omega_rad_s,
            at_least=True,
            about="nominal loop",
        )


@dataclass(frozen=True)
class ControllerDamping(Requirement):
    """Damping ratio of the controller's own pole pairs, a bound on parameters in the synthesis.

    Met within `SOLVER_SLACK` = 1e-3, the share by which the solver may miss a bound: ten times the tolerance
    that it ends with.
    """

    zeta: float
    caption = "damping ratio of the controller's own poles"

    def check(self, found: Findings) -> SpecificationItem:
        """Item with the smallest damping ratio of the controller's pole pairs; 1 without a pair.

        found: `controller` with `poles` in z and `dt_s` is read. A pole at z = -1 has no place in Tustin's
        plane: numpy warns, and it is no pair.
        """
        # In Tustin's plane, where the cascade and its bound live: ln z would call fast pairs less damped.
        poles = found.controller.poles
        w = 2 / found.controller.dt_s * (poles - 1) / (poles + 1)
        is_upper = np.imag(w) > 0
        pairs = w[is_upper]
        damping = -np.real(pairs) / np.abs(pairs)
        achieved = 1.0
        omega_rad_s = None
        if pairs.size:
            least = int(np.argmin(damping))
            achieved = float(damping[least])
            omega_rad_s = float(np.abs(pairs[least]))
        return SpecificationItem(
            requirement=self.caption,
            plant="controller",
            required=self.zeta,
            achieved=achieved,
            unit="",
            met=achieved >= self.zeta * (1 - SOLVER_SLACK),
            omega_rad_s=omega_rad_s,
            at_least=True,
            about="controller",
        )


@dataclass(frozen=True)
class ControllerIntegrator(Requirement):
    """A pole of the controller at z = 1, part of its structure in the synthesis."""

    caption = "integrators in the controller"

    def check(self, found: Findings) -> SpecificationItem:
        """Item with the number of such poles.

        found: `controller.poles` in z are counted by `count_integrators`; at least one is met.
        """
        n_integrators = count_integrators(found.controller.poles)
        return SpecificationItem(
            requirement=self.caption,
            plant="controller",
            required=1.0,
            achieved=float(n_integrators),
            unit="",
            met=bool(n_integrators >= 1),
            at_least=True,
            about="controller",
        )


REQUIREMENTS = (ModulusMargin, Tracking, Effort, ModePeak, DelayMargin, ModeDamping)
"""What may be asked of a plant's loop; each has `of(specification, plant)`, None where it is not asked."""


def _refuse_frequencies(spec: Specification, plant: UncertainPlant) -> None:
    """Raise SpecificationError for a frequency that the plant's sampling, integrator or zeros rule out.

    plant: `nyquist_rad_s`, `n_integrators`, `zeros` and `dt_s` of its nominal are read. Returns nothing where
    all is well.
    """
    nyquist = plant.nyquist_rad_s
    for name in ("bandwidth_rad_s", "effort_rolloff_rad_s"):
        value = getattr(spec, name)
        if value is not None and not value < nyquist:
            raise SpecificationError(
                f"{name} = {value:.4g} rad/s lies beyond the Nyquist frequency {nyquist:.4g} rad/s"
            )
    if spec.mode_band_rad_s is not None:
        low = spec.mode_band_rad_s[0]
        if not low < nyquist:
            raise SpecificationError(
                f"mode_band_rad_s starts at {low:.4g} rad/s, beyond the Nyquist frequency {nyquist:.4g} rad/s"
            )
        if plant.n_integrators and low * plant.dt_s < _INTEGRATES_BELOW_RAD:
            raise SpecificationError(
                f"mode_band_rad_s starts at {low:.4g} rad/s, where plant {plant.name!r} integrates and has "
                "no finite peak"
            )
    if spec.integrator and np.any(np.abs(plant.zeros - 1.0) < _ZERO_AT_ONE):
        raise SpecificationError(
            f"integrator = true, but plant {plant.name!r} has a zero at z = 1: the two would cancel"
        )


def _refuse_zeros(spec: Specification, plant: UncertainPlant) -> None:
    """Raise SpecificationError where a zero outside the circle makes tracking impossible.

    There S = 1 for every stable loop, so |W1| must not exceed 1. The message names the zero and, of a
    bandwidth, the largest that is possible there.

    plant: zeros in z and D of its nominal are read. A zero on the circle is not looked at; nor is any where
    tracking is asked in a band only, as the bound is one for weights on all frequencies.
    """
    if spec.tracking_from_rad_s is not None:
        return
    # In the Tustin plane; the sample of delay's zero at z = infinity is w = 2/dt, the last.
    is_outside = np.abs(plant.zeros) > _OUTSIDE_CIRCLE
    outside = plant.zeros[is_outside]
    w = 2.0 / plant.dt_s * (outside - 1.0) / (outside + 1.0)
    zero_of_delay = 2.0 / plant.dt_s
    feedthrough = float(np.asarray(plant.nominal.D)[0, 0])
    if feedthrough == 0.0 or spec.computational_delay_samples > 0:
        w = np.append(w, zero_of_delay)
    weight = spec.tracking_weight(plant)
    if weight is None:
        return
    bound = np.abs(weight.at(w))
    if not np.any(bound > 1.0):
        return

    worst = int(np.argmax(bound))
    where = f"the non-minimum-phase zero at {np.abs(w[worst]):.4g} rad/s"
    # A zero of the plant may lie at 2/dt, too; the last one is that of the delay.
    if worst == w.size - 1 and w[worst] == zero_of_delay:
        where = "the sampling delay"
    message = (
        f"plant {plant.name!r}: {where} makes the tracking requirement impossible by a factor "
        f"{bound[worst]:.3g}"
    )
    if spec.bandwidth_rad_s is not None:
        # The weight grows with the bandwidth everywhere, so the largest possible one is found by bisection.
        low = 0.0
        high = spec.bandwidth_rad_s
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            slower = spec.model_copy(update={"bandwidth_rad_s": max(middle, _TINY)})
            slower_weight = slower.tracking_weight(plant)
            if slower_weight is not None and np.all(np.abs(slower_weight.at(w)) <= 1.0):
                low = middle
            else:
                high = middle
        message += (
            f": bandwidth_rad_s = {spec.bandwidth_rad_s:.4g}, at most {low:.4g} with modulus_margin "
            f"{spec.modulus_margin:.3g}"
        )
    raise SpecificationError(message)


def _refuse_effort(spec: Specification, plant: UncertainPlant) -> None:
    """Raise SpecificationError where tracking needs more effort than its limit allows, at some frequency.

    1 = S + G K S gives gamma >= 1 / (1/|W1| + |G|/|W3|) there.

    Raises also what `Specification.requirements` raises. Not checked: a plant whose gain is 0 at such a
    frequency, where the needed effort is shown as inf.
    """
    # The nominal plant on a grid: a necessary condition, so points between may be missed.
    lowest = lowest_rad_s(plant.dt_s, plant.poles)
    omega = np.geomspace(lowest, plant.nyquist_rad_s, _POINTS_OF_CONFLICT)
    effort = spec.magnitude(plant, omega, LoopFunction.EFFORT)
    if not np.any(effort > 0):
        return
    gain = np.abs(plant.channel.nominal_response(omega))
    tracking = spec.magnitude(plant, omega, LoopFunction.SENSITIVITY)
    with np.errstate(divide="ignore", over="ignore"):
        largest_sensitivity = 1.0 / tracking
        bound = 1.0 / (largest_sensitivity + gain / np.maximum(effort, _TINY))
    worst = int(np.argmax(bound))
    if bound[worst] > 1.0:
        needed = (1.0 - 1.0 / tracking[worst]) / gain[worst]
        raise SpecificationError(
            f"plant {plant.name!r}: at {omega[worst]:.4g} rad/s tracking needs |K S| of at least "
            f"{needed:.4g}, the effort limit there is {1.0 / effort[worst]:.4g}; the two contradict each "
            f"other: both would have to be relaxed by a factor of {bound[worst]:.3g}"
        )
