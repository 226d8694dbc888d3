"""Reference filter: the second degree of freedom, designed for the controller that was certified."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from workflow.config.run_config import RunConfig
from workflow.engine.errors import naming
from workflow.tasks.reference_filter import find_filter
from workflow.tasks.results import ReferenceFilterResult
from workflow.tasks.stages.base import StageInput


def settings(config: RunConfig) -> Mapping[str, Any]:
    """Model, weight and order of the reference filter, if one is asked for."""
    return {
        "reference_filter": None
        if config.reference_filter is None
        else config.reference_filter.model_dump(mode="json")
    }


def design_filter(stage: StageInput) -> ReferenceFilterResult:
    """The filter with its worst-case errors; nothing where none is asked for or no controller is there."""
    settings, synthesis = stage.config.reference_filter, stage.results.design.synthesis
    if settings is None:
        return ReferenceFilterResult()
    if synthesis is None or stage.results.certify.certificate is None:
        return ReferenceFilterResult(reason="no reference filter: there is no controller")
    with naming("reference filter"):
        plant = stage.results.uncertainty.plant(stage.config)
        return find_filter(synthesis.controller, [plant], settings)
