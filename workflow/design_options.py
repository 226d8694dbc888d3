"""What is asked about a design beyond its margins: any order's reach, whole responses, a prefilter."""

from __future__ import annotations

from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from control_design.prefilter import PrefilterOptions
from control_design.specification import RationalWeight
from control_design.youla import YoulaOptions

FEWEST_DRAWS = 100


class CertificateOptions(BaseModel):
    """[certificate]: what is said of whole responses, of which the ellipses know one frequency at a time."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    joint_coverage: float = Field(
        0.95, gt=0, lt=1, description="share of whole responses for which the worst case shall hold"
    )
    joint_draws: int = Field(
        2000, ge=0, le=100_000, description="whole responses drawn from the posterior; 0: none"
    )
    calibrate: bool = Field(
        False,
        description="certify over ellipses of the level at which the worst case holds for joint_coverage of "
        "the whole responses, where that is above the level of the ellipses; false: say what it holds for",
    )

    @model_validator(mode="after")
    def _enough_draws(self) -> Self:
        if 0 < self.joint_draws < FEWEST_DRAWS:
            raise ValueError(f"joint_draws must be 0 or at least {FEWEST_DRAWS}; got {self.joint_draws}")
        if self.calibrate and not self.joint_draws:
            raise ValueError("calibrate needs joint_draws")
        return self


class YardstickOptions(YoulaOptions):
    """[yardstick]: what a controller of any order could reach (Youla bracket), how finely it is sought."""

    compute: bool = Field(True, description="false: the design is not compared with other orders")


class PrefilterSettings(PrefilterOptions):
    """[prefilter]: second degree of freedom, u = K (F r - y), designed after K to follow a model."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    corner_rad_s: float | None = Field(
        None, gt=0, description="the model is 1/(s/corner + 1)^model_order; this or model"
    )
    model_order: int = Field(2, ge=1, le=6, description="order of that model")
    model: RationalWeight | None = Field(
        None, description="the model itself: numerator and denominator in s, e.g. of a step with overshoot"
    )
    weight: RationalWeight | None = Field(
        None, description="weight of the matching error, numerator and denominator in s; none: 1"
    )

    @model_validator(mode="after")
    def _one_model(self) -> Self:
        if (self.corner_rad_s is None) == (self.model is None):
            raise ValueError("give either corner_rad_s or model")
        if self.model is not None and "model_order" in self.model_fields_set:
            raise ValueError("model_order goes with corner_rad_s")
        return self

    @property
    def reference_model(self) -> RationalWeight:
        """T_ref(s)."""
        if self.model is not None:
            return self.model
        assert self.corner_rad_s is not None
        denominator = [1.0]
        for _ in range(self.model_order):
            # times (s/corner + 1)
            scaled = [value / self.corner_rad_s for value in denominator] + [0.0]
            denominator = [a + b for a, b in zip(scaled, [0.0, *denominator], strict=True)]
        return RationalWeight(numerator=(1.0,), denominator=tuple(denominator))
