"""What the loop has to do, in the engineer's words, and the weights built from it.

Everything is stated for the worst member of the uncertainty ellipses. Weights act on the circle through the
Tustin frequency s = j (2/dt) tan(omega dt/2); a requirement is met where its weighted worst case is at most
1:

    |W1 S| <= 1   tracking and modulus margin    W1 = max(|(m s + wb)/(s + wb r)|, m)
    |W3 K S| <= 1 effort                         W3 = (s/wr + 1)/(s/(40 wr) + 1)/effort_limit
    |W4 Gp S| <= 1 damping of the flexible modes W4 = 1/(ratio x open-loop peak) inside the band, 0 outside

with m the modulus margin, r the low-frequency rejection (0 with an integrator) and wb = bandwidth sqrt(2 -
m^2), so that |W1| is at least sqrt 2 (-3 dB of S) up to the bandwidth.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from control_design.controllers.biquads import SectionKind, imaginary_axis
from control_design.plants.ellipses import Complex, Real
from control_design.plants.plant_set import Mode, UncertainPlant, modes_of
from control_design.plants.weights import RationalWeight, bandwidth_weight, effort_limit_weight

__all__ = ["RationalWeight", "Specification", "SpecificationError", "performance_modes"]


class SpecificationError(ValueError):
    """The specification contradicts itself or the plant; no controller of any order can meet it."""


class Specification(BaseModel):
    """Requirements on the closed loop, for every member of the uncertainty."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bandwidth_rad_s: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="|S| stays below -3 dB up to here, rad/s; none = no tracking requirement (pure damping)",
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
    effort_limit: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="largest |K S|, input unit per measured unit; none = not limited",
    )
    effort_rolloff_rad_s: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="above it the limit on |K S| falls with 1/frequency",
    )
    delay_margin_s: float | None = Field(
        default=None, gt=0, allow_inf_nan=False, description="extra loop delay that must not destabilise, s"
    )
    mode_peak_ratio: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="peak of |Gp S| in the mode's band over the open-loop peak of |Gp| there (damping)",
    )
    mode_damping: float | None = Field(
        default=None,
        gt=0,
        lt=1,
        description="least damping ratio of the nominal closed loop's modes inside mode_band_rad_s; the "
        "certificate checks it, the optimiser only sees what the other requirements make of it",
    )
    mode_band_rad_s: tuple[float, float] | None = Field(
        default=None,
        description="band of the damping requirement; none = a factor 1.5 either side of the lowest mode",
    )
    input_limit: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="saturation of the command (both signs), input unit",
    )
    rate_limit: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="largest change of the command, input unit per second",
    )
    controller_order: int = Field(default=4, ge=1, le=16, description="number of controller states")
    structure: Literal["biquads", "pi_d_notch"] = Field(
        default="biquads",
        description="biquads: free cascade; pi_d_notch: [integrator], lead/lag, notches at free frequencies",
    )
    controller_damping: float | None = Field(
        default=None,
        gt=0,
        le=1,
        description="least damping ratio of the controller's own pole pairs; without it a controller may "
        "answer a notch of the plant with a resonance of its own, which then rings in closed loop",
    )
    computational_delay_samples: int = Field(
        default=1, ge=0, le=10, description="samples between measuring and applying the command"
    )
    sensitivity_weight: RationalWeight | None = Field(
        default=None, description="W1 given directly, in place of bandwidth_rad_s"
    )
    effort_weight: RationalWeight | None = Field(
        default=None, description="W3 given directly, in place of effort_limit"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Specification:
        if self.sensitivity_weight is not None and self.bandwidth_rad_s is not None:
            raise ValueError("give bandwidth_rad_s or sensitivity_weight, not both")
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
        head: list[SectionKind] = ["integrator"] if self.integrator else []
        rest = self.controller_order - len(head)
        real: list[SectionKind] = ["first_order"] * (1 if self.structure == "pi_d_notch" else rest % 2)
        pair: SectionKind = "notch" if self.structure == "pi_d_notch" else "second_order"
        return (*head, *real, *([pair] * ((rest - len(real)) // 2)))

    def tracking_weight(self, plant_integrators: int = 0) -> RationalWeight | None:
        """W1 without the modulus margin, or None where no tracking is asked for."""
        if self.sensitivity_weight is not None or self.bandwidth_rad_s is None:
            return self.sensitivity_weight
        return bandwidth_weight(
            self.bandwidth_rad_s,
            self.modulus_margin,
            0.0 if self.integrator else self.low_frequency_rejection,
            integral_factors=plant_integrators if self.integrator else 0,
        )

    def limit_weight(self) -> RationalWeight | None:
        """W3, or None where effort is not limited."""
        if self.effort_weight is not None or self.effort_limit is None:
            return self.effort_weight
        return effort_limit_weight(self.effort_limit, self.effort_rolloff_rad_s)

    def tracking_at(self, s: Complex, plant_integrators: int = 0) -> Complex:
        """`tracking_weight` at complex s; the modulus margin where there is no tracking requirement."""
        weight = self.tracking_weight(plant_integrators)
        if weight is None:
            return np.full(np.shape(s), self.modulus_margin, dtype=np.complex128)
        return weight.at(np.asarray(s, dtype=np.complex128))

    def sensitivity_magnitude(self, omega_rad_s: Real, dt_s: float, plant_integrators: int = 0) -> Real:
        """|W1| (F,): tracking and modulus margin together."""
        s = imaginary_axis(omega_rad_s, dt_s)
        return np.maximum(np.abs(self.tracking_at(s, plant_integrators)), self.modulus_margin)

    def effort_magnitude(self, omega_rad_s: Real, dt_s: float) -> Real:
        """|W3| (F,); zeros where effort is not limited."""
        s = imaginary_axis(omega_rad_s, dt_s)
        weight = self.limit_weight()
        return np.zeros(s.shape) if weight is None else np.abs(weight.at(s))

    def mode_band(self, plant: UncertainPlant) -> tuple[float, float] | None:
        """Band of the damping requirement for this plant, or None without one.

        Raises
        ------
        SpecificationError
            If damping is asked for and the plant has no flexible mode and no band is given.
        """
        if self.mode_peak_ratio is None:
            return None
        if self.mode_band_rad_s is not None:
            return self.mode_band_rad_s
        modes = performance_modes(plant)
        if not modes:
            raise SpecificationError(
                f"mode_peak_ratio: plant {plant.name!r} has no lightly damped mode; give mode_band_rad_s"
            )
        return modes[0].omega_rad_s / 1.5, modes[0].omega_rad_s * 1.5

    def mode_reference_peak(self, plant: UncertainPlant) -> float:
        """Open-loop peak of the nominal |Gp| inside the band (the reference of mode_peak_ratio)."""
        band = self.mode_band(plant)
        assert band is not None
        omega = np.geomspace(band[0], min(band[1], plant.nyquist_rad_s), 2000)
        for mode in performance_modes(plant):
            width = max(mode.zeta * mode.omega_rad_s, 1e-9)
            omega = np.append(omega, mode.omega_rad_s + width * np.sinh(np.linspace(-3, 3, 121)))
        omega = omega[(omega >= band[0]) & (omega <= min(band[1], plant.nyquist_rad_s))]
        channel = plant.channel if plant.performance is None else plant.performance
        return float(np.max(np.abs(channel.nominal_response(np.unique(omega)))))

    def damping_magnitude(self, omega_rad_s: Real, plant: UncertainPlant) -> Real:
        """|W4| (F,); zeros outside the band or without a damping requirement."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        band = self.mode_band(plant)
        if band is None or self.mode_peak_ratio is None:
            return np.zeros(omega.shape)
        inside = (omega >= band[0]) & (omega <= band[1])
        return np.where(inside, 1.0 / (self.mode_peak_ratio * self.mode_reference_peak(plant)), 0.0)

    def check_against(self, plants: Sequence[UncertainPlant]) -> None:
        """Refuse, before optimising, what no controller can do.

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
        if len({plant.dt_s for plant in plants}) > 1:
            raise SpecificationError(f"the plants differ in sampling time: {[p.dt_s for p in plants]} s")
        for plant in plants:
            self._check_frequencies(plant)
            self._check_zeros(plant)
            self._check_effort(plant)
            self.mode_band(plant)

    def _check_frequencies(self, plant: UncertainPlant) -> None:
        for name in ("bandwidth_rad_s", "effort_rolloff_rad_s"):
            value = getattr(self, name)
            if value is not None and not value < plant.nyquist_rad_s:
                raise SpecificationError(
                    f"{name} = {value:.4g} rad/s lies beyond the Nyquist frequency "
                    f"{plant.nyquist_rad_s:.4g} rad/s"
                )
        if self.mode_band_rad_s is not None and not self.mode_band_rad_s[0] < plant.nyquist_rad_s:
            raise SpecificationError(
                f"mode_band_rad_s starts at {self.mode_band_rad_s[0]:.4g} rad/s, beyond the Nyquist "
                "frequency "
                f"{plant.nyquist_rad_s:.4g} rad/s"
            )
        if self.mode_band_rad_s is not None and plant.n_integrators and self.mode_band_rad_s[0] < 1e-3:
            raise SpecificationError(
                f"mode_band_rad_s starts at {self.mode_band_rad_s[0]:.4g} rad/s, where plant {plant.name!r} "
                "integrates and has no finite peak"
            )
        if self.integrator and np.any(np.abs(plant.zeros - 1.0) < 1e-6):
            raise SpecificationError(
                f"integrator asked for, but plant {plant.name!r} has a zero at z = 1: the two would cancel"
            )

    def _check_zeros(self, plant: UncertainPlant) -> None:
        dt = plant.dt_s
        zeros = plant.zeros
        outside = zeros[np.abs(zeros) > 1.0 + 1e-9]
        w = 2.0 / dt * (outside - 1.0) / (outside + 1.0) if outside.size else np.zeros(0, complex)
        d0 = float(np.asarray(plant.nominal.D)[0, 0])
        if d0 == 0.0 or self.computational_delay_samples > 0:
            w = np.append(w, 2.0 / dt)
        if not w.size:
            return
        bound = np.abs(self.tracking_at(w, plant.n_integrators))
        worst = int(np.argmax(bound))
        if bound[worst] <= 1.0:
            return
        last = worst == w.size - 1 and w[worst] == 2.0 / dt
        where = (
            "the sampling delay" if last else f"the non-minimum-phase zero at {np.abs(w[worst]):.4g} rad/s"
        )
        message = (
            f"plant {plant.name!r}: {where} makes the tracking requirement "
            f"impossible by a factor {bound[worst]:.3g}"
        )
        if self.bandwidth_rad_s is not None:
            low, high = 0.0, self.bandwidth_rad_s
            for _ in range(60):
                mid = 0.5 * (low + high)
                trial = self.model_copy(update={"bandwidth_rad_s": max(mid, 1e-300)})
                low, high = (
                    (mid, high)
                    if np.all(np.abs(trial.tracking_at(w, plant.n_integrators)) <= 1.0)
                    else (low, mid)
                )
            message += (
                f": bandwidth_rad_s = {self.bandwidth_rad_s:.4g}, at most {low:.4g} with modulus_margin "
                f"{self.modulus_margin:.3g}"
            )
        raise SpecificationError(message)

    def _check_effort(self, plant: UncertainPlant) -> None:
        omega = np.geomspace(1e-4, plant.nyquist_rad_s, 4000)
        effort = self.effort_magnitude(omega, plant.dt_s)
        if not np.any(effort > 0):
            return
        gain = np.abs(plant.channel.nominal_response(omega))
        tracking = self.sensitivity_magnitude(omega, plant.dt_s, plant.n_integrators)
        with np.errstate(divide="ignore", over="ignore"):
            bound = 1.0 / (1.0 / tracking + gain / np.maximum(effort, 1e-300))
        worst = int(np.argmax(bound))
        if bound[worst] > 1.0:
            needed = (1.0 - 1.0 / tracking[worst]) / gain[worst]
            raise SpecificationError(
                f"plant {plant.name!r}: at {omega[worst]:.4g} rad/s tracking needs |K S| of at "
                f"least {needed:.4g}, the effort "
                f"limit there is {1.0 / effort[worst]:.4g}; the two contradict each other by a "
                f"factor {bound[worst]:.3g}"
            )


def performance_modes(plant: UncertainPlant) -> tuple[Mode, ...]:
    """Flexible modes of the channel the damping requirement looks at."""
    if plant.performance is None:
        return plant.modes
    nominal = plant.performance.nominal
    poles: npt.NDArray[np.complex128] = np.asarray(nominal.poles(), dtype=np.complex128)
    return tuple(m for m in modes_of(poles, plant.dt_s) if m.omega_rad_s < plant.nyquist_rad_s)
