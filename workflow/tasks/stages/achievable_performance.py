"""Achievable performance: what a controller of any order could reach with this plant and specification."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from workflow.config.run_config import RunConfig
from workflow.engine.errors import naming
from workflow.tasks.achievable_performance import UNKNOWN_TO_BRACKET, find_bracket
from workflow.tasks.results import AchievablePerformance
from workflow.tasks.stages.base import StageInput


def settings(config: RunConfig) -> Mapping[str, Any]:
    """Options, and of the specification what the bracket knows: another order leaves it as it is."""
    return {
        "specification": config.specification.model_dump(mode="json", exclude=set(UNKNOWN_TO_BRACKET)),
        "achievable_performance": config.achievable_performance.model_dump(mode="json"),
        "purposes": [config.purpose_of(index) for index in range(len(config.channels))],
        "levels": [channel.uncertainty.level for channel in config.channels],
    }


def find_achievable(stage: StageInput) -> AchievablePerformance:
    """The bracket, or the reason why there is none."""

    def report(fraction: float, message: str) -> None:
        stage.progress.update("achievable_performance", fraction, message)

    config = stage.config
    with naming("achievable performance"):
        plant = stage.results.uncertainty.plant(config)
        return find_bracket([plant], config.specification, config.achievable_performance, report)
