"""Certify: check the controller independently of the optimiser that made it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from control_design.synthesis.synthesis_result import Outcome
from workflow.config.run_config import RunConfig
from workflow.engine.errors import naming
from workflow.engine.run_directory import StageData
from workflow.tasks.joint_coverage import certify_whole
from workflow.tasks.stages.base import StageInput
from workflow.tasks.stages.results import load_plant, load_synthesis


def settings(config: RunConfig) -> Mapping[str, Any]:
    """What is asked about whole responses."""
    return {"certificate": config.certificate.model_dump(mode="json")}


def certify_controller(stage: StageInput) -> StageData:
    """The certificate, or the reason why there is nothing to certify."""
    result = load_synthesis(stage.results)
    if result is None or result.outcome is Outcome.NOT_CONVERGED:
        reason = stage.results.load_stage("design").document["reason"]
        return StageData(document={"certificate": None, "certified": False, "reason": reason, "whole": {}})
    with naming("certify"):
        plant = load_plant(stage.results, stage.config)
        certificate, whole = certify_whole(
            result.controller,
            [plant],
            stage.config.specification,
            stage.config.certificate,
            stage.rng("certify"),
        )
    missed = [item.sentence() for item in certificate.items if not item.met]
    unstable = [verdict.plant for verdict in certificate.plants if not verdict.stable]
    reason = "; ".join([*(f"{name}: nominal closed loop unstable" for name in unstable), *missed])
    return StageData(
        document={
            "certificate": certificate.to_dict(),
            "certified": certificate.certified,
            "reason": reason or ("every item is met" if certificate.certified else "an ellipse reaches -1"),
            "whole": whole,
        }
    )
