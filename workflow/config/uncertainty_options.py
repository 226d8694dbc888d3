"""Settings of a channel: its fit, and method and model class of its ellipses."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from ident.basis.options import EmbeddingOptions, IdentOptions


class FitOptions(IdentOptions):
    """Settings of the fit of a channel: those of any fit, but that the data decide about its noise model."""

    noise: Literal["white", "auto"] = Field(
        "auto", description=IdentOptions.model_fields["noise"].description
    )


class UncertaintyOptions(EmbeddingOptions):
    """Ellipses around an identified response: method and model class."""

    coloured_noise: bool | Literal["auto"] = Field(
        "auto",
        description="whiten with an AR model of the residuals, three rounds; auto: where they are not white, "
        "or where max_ar_order is given",
    )
    method: Literal["tangent", "records"] = Field(
        "tangent",
        description="tangent: noise; records: also the scatter between records, for arms that differ "
        "from run to run or with amplitude (four records or more)",
    )
    level: float = Field(0.95, gt=0.5, lt=1, description="confidence of each ellipse taken alone")
    response: Literal["as recorded", "without friction", "without remote friction", "this amplitude"] = Field(
        "as recorded",
        description="which response the ellipses describe. as recorded: linear dynamics, everything else "
        "counts as noise. without remote friction: of logs of a loop whose sensor is at a load behind a "
        "spring, the dry friction of the motor's shaft taken off by inverse dynamics. The others identify "
        "dry friction as well: the output (of the control channel) must be the shaft's position. "
        "without friction: linear dynamics without friction; this amplitude: best linear "
        "approximation with friction, at the rms of the recorded inputs",
    )

    @property
    def friction_identified(self) -> bool:
        """The dry friction of the shaft is identified with the arm."""
        return self.response in ("without friction", "this amplitude")

    @property
    def friction_remote(self) -> bool:
        """The dry friction of a shaft behind a spring is taken off the command."""
        return self.response == "without remote friction"

    @model_validator(mode="after")
    def _friction_by_tangent(self) -> Self:
        if self.friction_identified and self.method != "tangent":
            raise ValueError(
                f"response = {self.response!r} goes with method = 'tangent', not {self.method!r}"
            )
        return self
