"""Prefilter: the second degree of freedom, designed for the controller that was certified."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from workflow.config.run_config import RunConfig
from workflow.engine.errors import naming
from workflow.engine.run_directory import StageData
from workflow.tasks.reference_filter import find_prefilter
from workflow.tasks.stages.base import StageInput
from workflow.tasks.stages.results import load_plant, load_synthesis


def settings(config: RunConfig) -> Mapping[str, Any]:
    """Model, weight and order of the prefilter, if one is asked for."""
    return {"prefilter": None if config.prefilter is None else config.prefilter.model_dump(mode="json")}


def design_filter(stage: StageInput) -> StageData:
    """The prefilter with its worst-case errors; nothing where none is asked for or no controller is there."""
    result = load_synthesis(stage.results)
    certify = stage.results.load_stage("certify").document
    if stage.config.prefilter is None:
        return StageData(document={"prefilter": None, "reason": None})
    if result is None or certify["certificate"] is None:
        return StageData(document={"prefilter": None, "reason": "no prefilter: there is no controller"})
    with naming("prefilter"):
        plant = load_plant(stage.results, stage.config)
        return StageData(document=find_prefilter(result.controller, [plant], stage.config.prefilter))
