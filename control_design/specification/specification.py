"""What the loop has to do, in the engineer's words, and the weights built from it.

For the worst member of the uncertainty ellipses, at the Tustin frequency s = j (2/dt) tan(omega dt/2):

    |W1 S| <= 1   tracking and modulus margin    W1 = max(|(m s + wb)/(s + wb r)|, m)
    |W3 K S| <= 1 effort                         W3 = (s/wr + 1)/(s/(40 wr) + 1)/effort_limit
    |W4 Gp S| <= 1 damping of the flexible modes W4 = 1/(ratio x open-loop peak) inside the band, 0 outside

with m the modulus margin, r the low-frequency rejection (0 with an integrator) and wb = bandwidth sqrt(2 -
m^2), so that |W1| is at least sqrt 2 (-3 dB of S) up to the bandwidth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from control_design.controllers.biquads import SOLVER_SLACK, SectionKind
from control_design.plants.ellipses import Real
from control_design.plants.frequency_grid import lowest_rad_s
from control_design.plants.plant_set import PlantChannel, UncertainPlant, count_integrators
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
from ident.data.settings import Settings

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class SpecificationError(ValueError):
    """The specification contradicts itself or the plant; no controller of any order can meet it."""


class Specification(Settings):
    """Requirements on the closed loop, for every plant in the uncertainty set."""

    bandwidth_rad_s: _Positive | None = Field(
        default=None,
        description="|S| stays below -3 dB up to here, rad/s; none = no tracking requirement (pure damping)",
    )
    lowest_bandwidth_rad_s: _Positive | None = Field(
        default=None,
        description="where bandwidth_rad_s cannot be met, the highest that can, down to here; none = "
        "bandwidth_rad_s as it stands",
    )
    integrator: bool = Field(default=False, description="the controller has a pole at z = 1")
    low_frequency_rejection: float = Field(
        default=1e-3,
        gt=0,
        lt=1,
        description="largest |S| towards zero frequency; with bandwidth_rad_s and without integrator",
    )
    modulus_margin: float = Field(
        default=0.5, gt=0, lt=1, description="smallest distance of the loop from -1 (1/max|S|)"
    )
    effort_limit: _Positive | None = Field(
        default=None, description="largest |K S|, input unit per measured unit; none = not limited"
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
    controller_order: Annotated[int, Field(ge=1, le=16)] | Literal["auto"] = Field(
        default=4,
        description="number of controller states, with lowest_bandwidth_rad_s at most: fewer where the step "
        "then settles sooner with the identified friction; auto: the lowest within 2 % of what a controller "
        "of any order reaches",
    )
    structure: Literal["biquads", "pi_d_notch"] = Field(
        default="biquads",
        description="biquads: free cascade; pi_d_notch: integrator (if set), lead/lag and free notches",
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
        if self.sensitivity_weight is not None and self.bandwidth_rad_s is not None:
            raise ValueError("give bandwidth_rad_s or sensitivity_weight, not both")
        if self.lowest_bandwidth_rad_s is not None and not (
            self.bandwidth_rad_s is not None and self.lowest_bandwidth_rad_s < self.bandwidth_rad_s
        ):
            raise ValueError("lowest_bandwidth_rad_s needs a larger bandwidth_rad_s, which is tried first")
        if self.effort_weight is not None and (self.effort_limit or self.effort_rolloff_rad_s):
            raise ValueError("give effort_limit (with effort_rolloff_rad_s) or effort_weight, not both")
        if self.effort_rolloff_rad_s is not None and self.effort_limit is None:
            raise ValueError("effort_rolloff_rad_s needs effort_limit")
        if self.mode_band_rad_s is not None:
            low, high = self.mode_band_rad_s
            if not (0 < low < high and np.isfinite(high)):
                raise ValueError(f"mode_band_rad_s needs 0 < low < high; got {low}, {high}")
            if self.mode_peak_ratio is None and self.mode_damping is None:
                raise ValueError("mode_band_rad_s needs mode_peak_ratio or mode_damping")
        if self.mode_damping is not None and self.mode_band_rad_s is None:
            raise ValueError("mode_damping needs mode_band_rad_s: the band whose modes are meant")
        if self.controller_order == "auto":
            if self.structure != "biquads":
                raise ValueError("controller_order = 'auto' needs structure 'biquads'; give a number")
            return self
        smallest = 1 if self.structure == "biquads" else 1 + int(self.integrator)
        if self.controller_order < smallest:
            raise ValueError(
                f"structure {self.structure!r} needs controller_order of at least {smallest}; got "
                f"{self.controller_order}"
            )
        if self.structure == "pi_d_notch" and (self.controller_order - smallest) % 2:
            raise ValueError(
                f"pi_d_notch has order {smallest} plus two per notch; got controller_order "
                f"{self.controller_order}"
            )
        return self

    def sections(self) -> tuple[SectionKind, ...]:
        """Section kinds of the cascade, integrator first."""
        if self.controller_order == "auto":
            raise SpecificationError(
                "controller_order = 'auto': the synthesis chooses it; give a number here"
            )
        head: list[SectionKind] = ["integrator"] if self.integrator else []
        rest = self.controller_order - len(head)
        real: list[SectionKind] = ["first_order"] * (1 if self.structure == "pi_d_notch" else rest % 2)
        pair: SectionKind = "notch" if self.structure == "pi_d_notch" else "second_order"
        return (*head, *real, *([pair] * ((rest - len(real)) // 2)))

    def tracking_weight(self, plant: UncertainPlant | None = None) -> RationalWeight | None:
        """W1 without the modulus margin; None without a tracking requirement.

        plant: whose slow poles add to the slope that an integrator of the controller asks for; None: a plant
        without any.
        """
        if self.sensitivity_weight is not None or self.bandwidth_rad_s is None:
            return self.sensitivity_weight
        slow: tuple[float, ...] = ()
        if self.integrator and plant is not None:
            slow = plant.slow_poles_rad_s(integral_corner(self.bandwidth_rad_s, self.modulus_margin))
        floor = 0.0 if self.integrator else self.low_frequency_rejection
        return bandwidth_weight(self.bandwidth_rad_s, self.modulus_margin, floor, slow_poles_rad_s=slow)

    def limit_weight(self) -> RationalWeight | None:
        """W3, or None where effort is not limited."""
        if self.effort_weight is not None or self.effort_limit is None:
            return self.effort_weight
        return effort_limit_weight(self.effort_limit, self.effort_rolloff_rad_s)

    def requirements(self, plant: UncertainPlant) -> tuple[Requirement, ...]:
        """All requirements on the loop of one plant."""
        found = (kind.of(self, plant) for kind in REQUIREMENTS)
        return tuple(each for each in found if each is not None)

    def weighted(self, plant: UncertainPlant) -> tuple[WeightedRequirement, ...]:
        """The requirements that bound a closed-loop function."""
        return tuple(each for each in self.requirements(plant) if isinstance(each, WeightedRequirement))

    def on_controller(self) -> tuple[Requirement, ...]:
        """Requirements on the controller alone."""
        damping = self.controller_damping
        rings = () if damping is None else (ControllerDamping(damping),)
        return (*rings, *([ControllerIntegrator()] if self.integrator else []))

    def magnitude(self, plant: UncertainPlant, omega_rad_s: Real, function: LoopFunction) -> Real:
        """|W| (F,) on one closed-loop function, all requirements on it together; zeros where none is."""
        sizes = [
            each.magnitude(omega_rad_s, plant.dt_s)
            for each in self.weighted(plant)
            if each.function is function
        ]
        return np.max(sizes, axis=0) if sizes else np.zeros(np.shape(omega_rad_s))

    def refuse_other_rate(self, plants: Sequence[UncertainPlant]) -> None:
        """Raise SpecificationError, one line, where a plant has another step than the controller."""
        wanted_s = self.controller_dt_s
        for plant in plants:
            if wanted_s is not None and abs(plant.dt_s - wanted_s) > 1e-6 * wanted_s:
                raise SpecificationError(
                    f"controller_dt_s = {wanted_s:.6g} s, but plant {plant.name!r} is sampled every "
                    f"{plant.dt_s:.6g} s: leave controller_dt_s out, or give it to flexlink run, which "
                    "brings the arm to this rate"
                )

    def check_against(self, plants: Sequence[UncertainPlant]) -> None:
        """Refuse a specification that no controller can meet, before optimising.

        Raises SpecificationError: one line: which requirement, what limits it, by how much.

        At a zero w of G outside the circle (also the one at z = infinity that a sample of delay makes) S(w) =
        1, hence max|W1 S| >= |W1(w)| for a stable loop. On the circle 1 = S + G K S gives gamma >= 1/(1/|W1|
        + |G|/|W3|). Both use the nominal plant, so they are necessary conditions only.
        """
        if not plants:
            raise SpecificationError("no plant given: the design needs at least one uncertain plant")
        if len({plant.dt_s for plant in plants}) > 1:
            raise SpecificationError(
                f"the plants differ in sampling time: {[p.dt_s for p in plants]} s; sample all "
                "with one period"
            )
        self.refuse_other_rate(plants)
        for plant in plants:
            _refuse_frequencies(self, plant)
            _refuse_zeros(self, plant)
            _refuse_effort(self, plant)
            self.requirements(plant)


class Tracking(WeightedRequirement):
    """|W1 S| <= 1 where W1 asks for more than the modulus margin."""

    name, caption, function = "tracking", "tracking, largest |W1 S|", LoopFunction.SENSITIVITY

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> Tracking | None:
        weight = spec.tracking_weight(plant)
        return None if weight is None else cls(weight, above=spec.modulus_margin)


class ModulusMargin(WeightedRequirement):
    """|m S| <= 1: the loop keeps the distance m from -1."""

    name, caption, function = "modulus", "modulus margin, worst case", LoopFunction.SENSITIVITY

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> ModulusMargin:
        return cls(constant_weight(spec.modulus_margin))

    def check(self, found: Findings) -> SpecificationItem:
        """In terms of the distance itself."""
        wanted = self.weight.numerator[0]
        achieved, omega = found.modulus
        bound = None if found.bounds is None else wanted / found.bounds.get(self.name, np.inf)
        met = bool(achieved >= wanted) and found.proved(self.name)
        return SpecificationItem(self.caption, found.plant, wanted, achieved, "", met, omega, bound, True)


class Effort(WeightedRequirement):
    """|W3 K S| <= 1."""

    name, caption, function = "effort", "effort, largest |W3 K S|", LoopFunction.EFFORT

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> Effort | None:
        weight = spec.limit_weight()
        return None if weight is None else cls(weight)


class ModePeak(WeightedRequirement):
    """|W4 Gp S| <= 1 in the band of the flexible mode, W4 = 1/(ratio x open-loop peak of the nominal Gp)."""

    name, caption, function = (
        "mode damping",
        "damping of the mode, largest |W4 Gp S|",
        LoopFunction.DISTURBANCE,
    )

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> ModePeak | None:
        """SpecificationError if the plant has no flexible mode and no band is given."""
        if spec.mode_peak_ratio is None:
            return None
        band, modes = spec.mode_band_rad_s, plant.damped.modes
        if band is None:
            if not modes:
                raise SpecificationError(
                    f"mode_peak_ratio: plant {plant.name!r} has no lightly damped mode; give mode_band_rad_s"
                )
            band = modes[0].omega_rad_s / 1.5, modes[0].omega_rad_s * 1.5
        peak = _nominal_peak(plant.damped, band[0], min(band[1], plant.nyquist_rad_s))
        return cls(constant_weight(1.0 / (spec.mode_peak_ratio * peak)), band, channel=plant.performance)


@lru_cache(maxsize=32)  # every grid of a synthesis asks for the requirements of its plant
def _nominal_peak(channel: PlantChannel, low_rad_s: float, high_rad_s: float) -> float:
    """Largest nominal gain in a band, refined around the modes."""
    omega = np.geomspace(low_rad_s, high_rad_s, 2000)
    for mode in channel.modes:
        width = max(mode.zeta, 1e-9) * mode.omega_rad_s
        omega = np.append(omega, mode.omega_rad_s + width * np.sinh(np.linspace(-3, 3, 121)))
    omega = np.unique(omega[(omega >= low_rad_s) & (omega <= high_rad_s)])
    return float(np.max(np.abs(channel.nominal_response(omega))))


@dataclass(frozen=True)
class DelayMargin(Requirement):
    """The loop stands this much more delay; the synthesis carries a delayed copy of every plant."""

    delay_s: float
    caption = "delay margin, worst case"

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> DelayMargin | None:
        return None if spec.delay_margin_s is None else cls(spec.delay_margin_s)

    def check(self, found: Findings) -> SpecificationItem:
        met = bool(found.delay_s >= self.delay_s)
        return SpecificationItem(
            self.caption, found.plant, self.delay_s, found.delay_s, "s", met, at_least=True
        )


@dataclass(frozen=True)
class ModeDamping(Requirement):
    """Least damped mode of the nominal closed loop in a band; without one there, damping is no issue."""

    zeta: float
    band: tuple[float, float]
    caption = "damping ratio of the nominal closed loop's modes"

    @classmethod
    def of(cls, spec: Specification, plant: UncertainPlant) -> ModeDamping | None:
        if spec.mode_damping is None or spec.mode_band_rad_s is None:
            return None
        return cls(spec.mode_damping, spec.mode_band_rad_s)

    def check(self, found: Findings) -> SpecificationItem:
        inside = [mode for mode in found.modes if self.band[0] <= mode.omega_rad_s <= self.band[1]]
        least = min(inside, key=lambda mode: mode.zeta, default=None)
        achieved, omega = (1.0, None) if least is None else (least.zeta, least.omega_rad_s)
        met = least is None or achieved >= self.zeta
        return SpecificationItem(
            self.caption, found.plant, self.zeta, achieved, "", met, omega, None, True, "nominal loop"
        )


@dataclass(frozen=True)
class ControllerDamping(Requirement):
    """Damping ratio of the controller's own pole pairs, a bound on parameters in the synthesis, met within
    `SOLVER_SLACK`."""

    zeta: float
    caption = "damping ratio of the controller's own poles"

    def check(self, found: Findings) -> SpecificationItem:
        # In Tustin's plane, where the cascade and its bound live: ln z would call fast pairs less damped.
        poles = found.controller.poles
        w = 2 / found.controller.dt_s * (poles - 1) / (poles + 1)
        pairs = w[np.imag(w) > 0]
        zeta = -np.real(pairs) / np.abs(pairs)
        least = int(np.argmin(zeta)) if pairs.size else None
        achieved, omega = (1.0, None) if least is None else (float(zeta[least]), float(np.abs(pairs[least])))
        met = achieved >= self.zeta * (1 - SOLVER_SLACK)
        return SpecificationItem(
            self.caption, "controller", self.zeta, achieved, "", met, omega, None, True, "controller"
        )


@dataclass(frozen=True)
class ControllerIntegrator(Requirement):
    """A pole of the controller at z = 1, part of its structure in the synthesis."""

    caption = "integrators in the controller"

    def check(self, found: Findings) -> SpecificationItem:
        own = count_integrators(found.controller.poles)
        met = bool(own >= 1)
        return SpecificationItem(
            self.caption, "controller", 1.0, float(own), "", met, None, None, True, "controller"
        )


REQUIREMENTS = (ModulusMargin, Tracking, Effort, ModePeak, DelayMargin, ModeDamping)
"""What may be asked of a plant's loop; each has `of(specification, plant)`, None where it is not asked."""


def _refuse_frequencies(spec: Specification, plant: UncertainPlant) -> None:
    nyquist = plant.nyquist_rad_s
    for name in ("bandwidth_rad_s", "effort_rolloff_rad_s"):
        value = getattr(spec, name)
        if value is not None and not value < nyquist:
            raise SpecificationError(
                f"{name} = {value:.4g} rad/s lies beyond the Nyquist frequency {nyquist:.4g} rad/s"
            )
    low = np.inf if spec.mode_band_rad_s is None else spec.mode_band_rad_s[0]
    if spec.mode_band_rad_s is not None and not low < nyquist:
        raise SpecificationError(
            f"mode_band_rad_s starts at {low:.4g} rad/s, beyond the Nyquist frequency {nyquist:.4g} rad/s"
        )
    if plant.n_integrators and low * plant.dt_s < 5e-6:  # where the open loop is its integrator and no more
        raise SpecificationError(
            f"mode_band_rad_s starts at {low:.4g} rad/s, where plant {plant.name!r} integrates and has no "
            "finite peak"
        )
    if spec.integrator and np.any(np.abs(plant.zeros - 1.0) < 1e-6):
        raise SpecificationError(
            f"integrator = true, but plant {plant.name!r} has a zero at z = 1: the two would cancel"
        )


def _refuse_zeros(spec: Specification, plant: UncertainPlant) -> None:
    # In the Tustin plane; the sample of delay's zero at z = infinity is w = 2/dt, the last.
    outside = plant.zeros[np.abs(plant.zeros) > 1.0 + 1e-9]
    w = 2.0 / plant.dt_s * (outside - 1.0) / (outside + 1.0)
    if float(np.asarray(plant.nominal.D)[0, 0]) == 0.0 or spec.computational_delay_samples > 0:
        w = np.append(w, 2.0 / plant.dt_s)
    weight = spec.tracking_weight(plant)
    bound = np.zeros(0) if weight is None else np.abs(weight.at(w))
    if not np.any(bound > 1.0):
        return
    worst = int(np.argmax(bound))
    last = worst == w.size - 1 and w[worst] == 2.0 / plant.dt_s
    where = "the sampling delay" if last else f"the non-minimum-phase zero at {np.abs(w[worst]):.4g} rad/s"
    message = (
        f"plant {plant.name!r}: {where} makes the tracking requirement impossible by a factor "
        f"{bound[worst]:.3g}"
    )
    if spec.bandwidth_rad_s is not None:
        low, high = 0.0, spec.bandwidth_rad_s
        for _ in range(60):
            middle = 0.5 * (low + high)
            weight = spec.model_copy(update={"bandwidth_rad_s": max(middle, 1e-300)}).tracking_weight(plant)
            possible = weight is not None and bool(np.all(np.abs(weight.at(w)) <= 1.0))
            low, high = (middle, high) if possible else (low, middle)
        message += (
            f": bandwidth_rad_s = {spec.bandwidth_rad_s:.4g}, at most {low:.4g} with modulus_margin "
            f"{spec.modulus_margin:.3g}"
        )
    raise SpecificationError(message)


def _refuse_effort(spec: Specification, plant: UncertainPlant) -> None:
    omega = np.geomspace(lowest_rad_s(plant.dt_s, plant.poles), plant.nyquist_rad_s, 4000)
    effort = spec.magnitude(plant, omega, LoopFunction.EFFORT)
    if not np.any(effort > 0):
        return
    gain = np.abs(plant.channel.nominal_response(omega))
    tracking = spec.magnitude(plant, omega, LoopFunction.SENSITIVITY)
    with np.errstate(divide="ignore", over="ignore"):
        bound = 1.0 / (1.0 / tracking + gain / np.maximum(effort, 1e-300))
    worst = int(np.argmax(bound))
    if bound[worst] > 1.0:
        needed = (1.0 - 1.0 / tracking[worst]) / gain[worst]
        raise SpecificationError(
            f"plant {plant.name!r}: at {omega[worst]:.4g} rad/s tracking needs |K S| of at least "
            f"{needed:.4g}, the effort limit there is {1.0 / effort[worst]:.4g}; the two contradict each "
            f"other: both would have to be relaxed by a factor of {bound[worst]:.3g}"
        )
