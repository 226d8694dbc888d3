"""Options beyond margins: achievable performance, posterior samples, reference filter."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from numpy.polynomial.polynomial import polypow
from pydantic import ConfigDict, Field, model_validator

from control_design.convex.convex_options import ReferenceFilterOptions, YoulaOptions
from control_design.specification import RationalWeight
from workflow.config.settings import Section

# Draws at least: a share of 0.95 is then known to 0.02, sqrt(0.95 * 0.05 / 100).
FEWEST_DRAWS = 100
# Weight of an error that lasts over that of a passing one.
_LASTING = 100.0


class CertificateOptions(Section):
    """[certificate]: joint coverage, the share of posterior samples that meet the worst case."""

    joint_coverage: float = Field(
        0.95, gt=0, lt=1, description="share of posterior samples for which the worst case must hold"
    )
    joint_draws: int = Field(2000, ge=0, le=100_000, description="number of posterior samples; 0: none")
    calibrate: bool = Field(
        False,
        description="raise the ellipse level until the worst case holds for joint_coverage of the "
        "posterior samples, and design so that 99.9 % of them are stable; false: report "
        "the coverage only",
    )

    @model_validator(mode="after")
    def _enough_draws(self) -> Self:
        if 0 < self.joint_draws < FEWEST_DRAWS:
            raise ValueError(f"joint_draws must be 0 or at least {FEWEST_DRAWS}; got {self.joint_draws}")
        if self.calibrate and not self.joint_draws:
            raise ValueError("calibrate needs joint_draws")
        return self


class AchievableOptions(YoulaOptions):
    """[achievable_performance]: bounds on what a controller of any order can reach."""

    compute: bool = Field(True, description="compare the design with other orders")


class ReferenceFilterSettings(ReferenceFilterOptions):
    """[reference_filter]: F in u = K (F r - y), designed after K to follow a reference model."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    corner_rad_s: float | None = Field(
        None,
        gt=0,
        description="corner of the reference model 1/(s/corner + 1)^model_order; give this or model",
    )
    model_order: int = Field(2, ge=1, le=6, description="order of the reference model")
    model: RationalWeight | None = Field(
        None, description="reference model: numerator and denominator in s, e.g. of a step with overshoot"
    )
    weight: Literal["steps", "flat"] | RationalWeight = Field(
        "steps",
        description="weight of the matching error. steps: (s + w)/(s + w/100) with w the corner of "
        "the model, which weighs lasting errors most; flat: 1, the largest error at any "
        "frequency; or numerator and denominator in s",
    )

    @model_validator(mode="after")
    def _one_model(self) -> Self:
        if (self.corner_rad_s is None) == (self.model is None):
            raise ValueError("give either corner_rad_s or model")
        if self.model is not None and "model_order" in self.model_fields_set:
            raise ValueError("model_order goes with corner_rad_s")
        return self

    @property
    def error_weight(self) -> RationalWeight | None:
        """W(s) of the matching error; None is 1."""
        if self.weight == "flat":
            return None
        if isinstance(self.weight, RationalWeight):
            return self.weight
        corner = self.corner_rad_s or self._corner()
        return RationalWeight(numerator=(1.0, corner), denominator=(1.0, corner / _LASTING))

    def _corner(self) -> float:
        """Where the model has fallen by 3 dB, rad/s; its fastest pole where it never does."""
        model = self.reference_model
        poles = np.abs(np.roots(model.denominator))
        # Three decades to each side of all poles: beyond them the gain has its end values.
        omega = np.geomspace(1e-3 * poles.min(initial=1.0), 1e3 * poles.max(initial=1.0), 4000)
        size = np.abs(model.at(1j * omega))
        below = np.flatnonzero(size < size[0] / np.sqrt(2))
        return float(omega[below[0]] if below.size else poles.max(initial=1.0))

    @property
    def reference_model(self) -> RationalWeight:
        """T_ref(s)."""
        if self.model is not None:
            return self.model
        assert self.corner_rad_s is not None
        denominator = polypow([1.0, 1 / self.corner_rad_s], self.model_order)[::-1]
        return RationalWeight(numerator=(1.0,), denominator=tuple(denominator.tolist()))
