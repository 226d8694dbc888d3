"""Certify: check the controller independently of the optimiser that made it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from control_design.certificate import certify
from control_design.synthesis_result import Outcome
from workflow.config import RunConfig
from workflow.errors import naming
from workflow.run_directory import StageData
from workflow.stages.base import StageInput
from workflow.stages.results import load_plant, load_synthesis


def settings(config: RunConfig) -> Mapping[str, Any]:
    """Nothing beyond what the stages before it depend on."""
    return {}


def certify_controller(stage: StageInput) -> StageData:
    """The certificate, or the reason why there is nothing to certify."""
    result = load_synthesis(stage.results)
    if result is None or result.outcome is Outcome.NOT_CONVERGED:
        reason = stage.results.load_stage("design").document["reason"]
        return StageData(document={"certificate": None, "certified": False, "reason": reason})
    with naming("certify"):
        plant = load_plant(stage.results, stage.config)
        certificate = certify(result.controller, [plant], stage.config.specification)
    missed = [item.sentence() for item in certificate.items if not item.met]
    unstable = [verdict.plant for verdict in certificate.plants if not verdict.stable]
    reason = "; ".join([*(f"{name}: nominal closed loop unstable" for name in unstable), *missed])
    return StageData(
        document={
            "certificate": certificate.to_dict(),
            "certified": certificate.certified,
            "reason": reason or ("every item is met" if certificate.certified else "an ellipse reaches -1"),
        }
    )
