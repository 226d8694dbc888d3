"""Certify: check the controller independently of the optimiser that made it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from workflow.config.run_config import RunConfig
from workflow.engine.errors import naming
from workflow.tasks.joint_coverage import certify_asked
from workflow.tasks.results import CertifyResult
from workflow.tasks.stages.base import StageInput


def settings(config: RunConfig) -> Mapping[str, Any]:
    """What is asked about whole responses."""
    return {"certificate": config.certificate.model_dump(mode="json")}


def certify_controller(stage: StageInput) -> CertifyResult:
    """The certificate, or the reason why there is nothing to certify."""
    design, config = stage.results.design, stage.config
    if design.synthesis is None or not design.has_controller:
        return CertifyResult(None, certified=False, reason=design.reason)
    with naming("certify"):
        return certify_asked(
            design.synthesis.controller,
            [stage.results.uncertainty.plant(config)],
            config.specification,
            config.certificate,
            stage.rng("certify"),
        )
