"""The TOML file of `flexlink design`: specification, and what the file of a plant does not contain."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, field_validator, model_validator

from control_design.specification import RationalWeight, Specification
from control_design.synthesis.synthesis_options import SynthesisOptions
from ident.basis.options import IdentOptions
from workflow.config.design_options import AchievableOptions, CertificateOptions, ReferenceFilterSettings
from workflow.config.settings import InputPath, Section, check
from workflow.engine.documents import read_toml

if TYPE_CHECKING:
    from workflow.config.run_config import RunConfig


class PlantSection(Section):
    """[plant] of a design file: what the file of a plant does not contain."""

    integrators: int = Field(0, ge=0, le=2, description="known poles of the plant at z = 1")
    dt_s: float | None = Field(None, gt=0, description="sampling period of a measured response [s]")
    level: float = Field(
        0.95, gt=0.5, lt=1, description="confidence of each ellipse of a measured response or of a posterior"
    )
    ellipses: Literal["measured", "fitted"] = Field(
        "measured",
        description="uncertainty of a measured response: its covariances at its frequencies, or the "
        "posterior of a fitted model at every frequency",
    )
    nominal: InputPath | None = Field(
        None, description="state-space model with the poles of a measured response; default: fitted"
    )
    fit: IdentOptions = Field(
        default_factory=IdentOptions, description="settings of the model fit to a measured response"
    )
    pool_neighbours: int = Field(
        0, ge=0, le=50, description="repeats: neighbouring frequencies on either side whose scatter is pooled"
    )
    outlier_threshold: float | None = Field(
        None, gt=0, description="repeats: drop points farther out than this, in robust standard deviations"
    )
    between_points: Literal["nothing", "linear"] = Field(
        "linear", description="what the certificate may assume of ellipses between their own frequencies"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if "integrators" in self.fit.model_fields_set:
            raise ValueError("fit.integrators: say integrators in [plant] itself")
        if self.ellipses == "fitted" and self.nominal is not None:
            raise ValueError("ellipses = 'fitted' makes its own nominal: leave nominal out")
        return self


class StatedUncertainty(Section):
    """[uncertainty] of a design file: deviation of the plant from a state-space model."""

    multiplicative: RationalWeight | None = Field(
        None, description="limit of |G - G_nom|/|G_nom|: a number, or numerator and denominator in s"
    )
    additive: RationalWeight | None = Field(
        None, description="limit of |G - G_nom|: a number, or numerator and denominator in s"
    )

    @field_validator("multiplicative", "additive", mode="before")
    @classmethod
    def _constant(cls, value: Any) -> Any:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            if not 0 < value < np.inf:
                raise ValueError(f"a constant radius must be positive and finite; got {value}")
            return RationalWeight(numerator=(float(value),), denominator=(1.0,))
        # A table seen before it is checked is no JSON any more, whose lists stand for tuples.
        lists = value.items() if isinstance(value, Mapping) else ()
        return {key: tuple(v) if isinstance(v, list) else v for key, v in lists} or value

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if (self.multiplicative is None) == (self.additive is None):
            raise ValueError("give either multiplicative or additive")
        return self


class DesignFile(Section):
    """Content of a design file; specification is None without a file."""

    specification: Specification | None = None
    synthesis: SynthesisOptions = Field(default_factory=SynthesisOptions)
    plant: PlantSection = Field(default_factory=PlantSection)
    uncertainty: StatedUncertainty | None = None
    certificate: CertificateOptions = Field(default_factory=CertificateOptions)
    achievable_performance: AchievableOptions = Field(default_factory=AchievableOptions)
    reference_filter: ReferenceFilterSettings | None = None
    _name: str = PrivateAttr("a design file (--spec FILE)")

    @property
    def name(self) -> str:
        return self._name

    def completed(self, run: RunConfig | None) -> DesignFile:
        """What is left out is as in a run, but for [reference_filter]: to leave it out is to ask for none."""
        if run is None:
            return self
        lacking = {"specification", "synthesis", "certificate", "achievable_performance"}
        if self.specification is None:
            lacking.add("reference_filter")
        return self.model_copy(update={name: getattr(run, name) for name in lacking - self.model_fields_set})


def read_design_file(path: Path) -> DesignFile:
    """The design file at a path.

    TOML with the keys of [specification], in a table of that name or at the top, and optionally [plant],
    [uncertainty], [synthesis], [certificate], [achievable_performance] and [reference_filter]. From a run's
    configuration those tables that a design has are taken.

    Raises
    ------
    InputError
        File, dotted key and what was expected, in one line.
    """
    _, document = read_toml(path)
    known = DesignFile.model_fields.keys()
    if "specification" not in document:
        document["specification"] = {key: document.pop(key) for key in document.keys() - known}
    elif "channels" in document:
        document = {key: value for key, value in document.items() if key in known}
    file = check(DesignFile, document, source=str(path), context={"base": path.absolute().parent})
    file._name = str(path)
    return file
