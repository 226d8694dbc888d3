"""The certificate, and for how many whole responses of the posterior its worst case holds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from control_design.analysis.certificate import Certificate, certify
from control_design.analysis.joint_coverage import ResponseDraws, joint_coverage
from control_design.controllers.controller import Controller
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from control_design.synthesis.joint_synthesis import synthesise_jointly
from control_design.synthesis.synthesis import synthesise
from control_design.synthesis.synthesis_options import SynthesisOptions
from control_design.synthesis.synthesis_result import SynthesisResult
from ident.uncertainty import ResponsePosterior
from workflow.config.design_options import CertificateOptions
from workflow.engine import codec
from workflow.tasks.proportions import wilson_interval
from workflow.tasks.results import CertifyResult, SampledResponses


def synthesise_asked(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    synthesis: SynthesisOptions,
    options: CertificateOptions,
    rng: np.random.Generator,
    progress: Callable[[float, str], None] | None = None,
) -> tuple[SynthesisResult, str | None]:
    """The design; with `calibrate`, and plants to draw from, one whose sampled responses are stable as often
    as the certificate then asks. Second: what became of that, in one sentence."""
    if not options.calibrate or undrawable(plants) is not None:
        return synthesise(plants, specification, synthesis, rng=rng, progress=progress), None
    found = synthesise_jointly(plants, specification, synthesis, rng=rng, progress=progress)
    return found.result, found.sentence()


def certify_asked(
    controller: Controller,
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: CertificateOptions,
    rng: np.random.Generator,
    *,
    between_own_points: Literal["nothing", "linear"] = "nothing",
) -> CertifyResult:
    """The certificate, and for how many sampled responses its worst case holds.

    Without `calibrate` the certificate is that of the ellipses at their own level, whatever the draws say;
    with it the ellipses are of the calibrated level where that is higher, and the share of stable draws is an
    item of the certificate.
    """
    reason = undrawable(plants) if options.joint_draws else "no responses were drawn (joint_draws = 0)"
    if reason is None and options.calibrate:
        certificate = certify(
            controller,
            plants,
            specification,
            between_own_points=between_own_points,
            joint_coverage=options.joint_coverage,
            rng=rng,
            joint_draws=options.joint_draws,
        )
        assert certificate.joint is not None
        return _result(certificate, SampledResponses(certificate.joint, calibrated=True))
    certificate = certify(controller, plants, specification, between_own_points=between_own_points)
    if reason is not None:
        return _result(certificate, SampledResponses(reason=reason))
    joint = joint_coverage(
        controller,
        plants,
        specification,
        rng=rng,
        coverage=options.joint_coverage,
        draws=options.joint_draws,
    )
    return _result(certificate, SampledResponses(joint))


def _result(certificate: Certificate, sampled: SampledResponses) -> CertifyResult:
    missed = [item.sentence() for item in certificate.items if not item.met]
    unstable = [verdict.plant for verdict in certificate.plants if not verdict.stable]
    reason = "; ".join([*(f"{name}: nominal closed loop unstable" for name in unstable), *missed])
    return CertifyResult(
        certificate,
        certificate.certified,
        reason or ("every item is met" if certificate.certified else "an ellipse reaches -1"),
        sampled,
    )


def undrawable(plants: Sequence[UncertainPlant]) -> str | None:
    """Why whole responses of these plants cannot be drawn; None where they can."""
    drawn = False
    for plant in plants:
        for channel in (plant.channel, plant.performance):
            uncertainty = None if channel is None else channel.uncertainty
            if uncertainty is None:
                continue
            if not isinstance(uncertainty, ResponsePosterior | ResponseDraws):
                known = (
                    "known at its own frequencies only"
                    if plant.own_grid is not None
                    else "a bound, not a distribution"
                )
                return f"responses of {plant.name} cannot be sampled: its uncertainty is {known}"
            drawn = True
    return None if drawn else "no uncertainty is stated: there is nothing to draw from"


def joint_numbers(found: SampledResponses) -> dict[str, Any]:
    """Numbers for JSON and tables; shares with Wilson intervals at 95 %."""
    joint = found.joint
    if joint is None:
        return {"reason": found.reason}
    held, stable = (_counted(share, joint.draws) for share in (joint.coverage_given, joint.stable_share))
    return {
        **codec.plain(joint),
        "calibrated": found.calibrated,
        "held_share": held[0],
        "held_interval": list(held[1]),
        "stable_interval": list(stable[1]),
        "reason": None,
    }


def _counted(share: float, draws: int) -> tuple[float, tuple[float, float]]:
    return share, wilson_interval(round(share * draws), draws)
