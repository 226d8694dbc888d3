"""Yardstick: what a controller of any order could reach with this plant and specification."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from workflow.config.run_config import RunConfig
from workflow.engine.errors import naming
from workflow.engine.run_directory import StageData
from workflow.tasks.achievable_performance import UNKNOWN_TO_BRACKET, find_bracket
from workflow.tasks.stages.base import StageInput
from workflow.tasks.stages.results import load_plant


def settings(config: RunConfig) -> Mapping[str, Any]:
    """Options, and of the specification what the bracket knows: another order leaves it as it is."""
    return {
        "specification": config.specification.model_dump(mode="json", exclude=set(UNKNOWN_TO_BRACKET)),
        "yardstick": config.yardstick.model_dump(mode="json"),
        "purposes": [config.purpose_of(index) for index in range(len(config.channels))],
        "levels": [channel.uncertainty.level for channel in config.channels],
    }


def find_yardstick(stage: StageInput) -> StageData:
    """The bracket, or the reason why there is none."""

    def report(fraction: float, message: str) -> None:
        stage.progress.update("yardstick", fraction, message)

    with naming("yardstick"):
        plant = load_plant(stage.results, stage.config)
        found = find_bracket([plant], stage.config.specification, stage.config.yardstick, report)
    return StageData(document=found)
