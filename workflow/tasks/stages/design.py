"""Design: one controller for the identified uncertain plant."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from control_design.specification import SpecificationError
from workflow.config.run_config import RunConfig
from workflow.engine.errors import naming
from workflow.engine.run_directory import StageData
from workflow.tasks.joint_coverage import synthesise_asked
from workflow.tasks.stages.base import StageInput
from workflow.tasks.stages.results import load_plant


def settings(config: RunConfig) -> Mapping[str, Any]:
    """Specification, synthesis options, and which channel is which."""
    return {
        "specification": config.specification.model_dump(mode="json"),
        "synthesis": config.synthesis.model_dump(mode="json"),
        "purposes": [config.purpose_of(index) for index in range(len(config.channels))],
        "levels": [channel.uncertainty.level for channel in config.channels],
        "calibrate": config.certificate.calibrate,
    }


def design_controller(stage: StageInput) -> StageData:
    """Best controller found; `reason` says in one line how it stands against the specification.

    A specification that no controller can meet is a result, not an error: the report has to say what blocks
    it.
    """
    config = stage.config

    def report(fraction: float, message: str) -> None:
        stage.progress.update("design", fraction, message)

    with naming("design"):
        plant = load_plant(stage.results, config)
        try:
            result, jointly = synthesise_asked(
                [plant],
                config.specification,
                config.synthesis,
                config.certificate,
                stage.rng("design"),
                report,
            )
        except SpecificationError as impossible:
            return StageData(
                document={"synthesis": None, "met": False, "reason": str(impossible), "jointly": None}
            )
    return StageData(
        document={
            "synthesis": result.to_dict(),
            "met": result.gamma <= 1.0,
            "reason": result.explain(),
            "jointly": jointly,
        }
    )
