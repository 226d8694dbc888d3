"""Design: one controller for the identified uncertain plant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification, SpecificationError
from control_design.synthesis.synthesis_options import SynthesisOptions
from workflow.config.design_options import CertificateOptions
from workflow.config.run_config import RunConfig
from workflow.engine.errors import naming
from workflow.tasks.joint_coverage import synthesise_asked
from workflow.tasks.results import DesignResult
from workflow.tasks.stages.base import StageInput


def settings(config: RunConfig) -> Mapping[str, Any]:
    """Specification, synthesis options, and which channel is which."""
    return {
        "specification": config.specification.model_dump(mode="json"),
        "synthesis": config.synthesis.model_dump(mode="json"),
        "purposes": [config.purpose_of(index) for index in range(len(config.channels))],
        "levels": [channel.uncertainty.level for channel in config.channels],
        "calibrate": config.certificate.calibrate,
    }


def design_controller(stage: StageInput) -> DesignResult:
    """Best controller found for the plant that was identified."""
    config = stage.config

    def report(fraction: float, message: str) -> None:
        stage.progress.update("design", fraction, message)

    with naming("design"):
        return find_design(
            [stage.results.uncertainty.plant(config)],
            config.specification,
            config.synthesis,
            config.certificate,
            stage.rng("design"),
            report,
        )


def find_design(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    synthesis: SynthesisOptions,
    certificate: CertificateOptions,
    rng: np.random.Generator,
    progress: Callable[[float, str], None] | None = None,
) -> DesignResult:
    """One controller for all plants; `reason` says in one line how it stands against the specification.

    A specification that no controller can meet is a result, not an error: the report has to say what blocks
    it.
    """
    try:
        result, jointly = synthesise_asked(plants, specification, synthesis, certificate, rng, progress)
    except SpecificationError as impossible:
        return DesignResult(None, met=False, reason=str(impossible))
    return DesignResult(result, result.gamma <= 1.0, result.explain(), jointly)
