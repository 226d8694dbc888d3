"""Closed loop beyond the step: S measured on the simulated arm, and the loop under other conditions."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from control_design.controllers.controller import Controller
from control_design.convex.reference_filter import ReferenceFilter
from control_design.plants.plant_set import UncertainPlant
from ident.uncertainty import ResponsePosterior
from workflow.config.run_config import SimulatedSource
from workflow.tasks.loop_conditions import ConditionBench
from workflow.tasks.loop_sensitivity import measure_on, measured_peak, plan_sensitivity
from workflow.tasks.results import ConditionRun, SensitivityCheck
from workflow.tasks.sampled_plant import FINITE, ClippedMachine
from workflow.tasks.simulated_rig import OUTPUT_NAMES, EncodedArm, rig_of
from workflow.tasks.stages.base import StageInput

Real = npt.NDArray[np.float64]


def check_on_arm(
    stage: StageInput,
    controller: Controller,
    reference_filter: ReferenceFilter | None,
    plant: UncertainPlant,
    posterior: ResponsePosterior,
    reference: Real,
) -> tuple[SensitivityCheck | None, tuple[ConditionRun, ...]]:
    """S measured on the arm, and the loop under other conditions; nothing where the arm is not simulated.

    reference: (T,) step after a lead-in, long enough to settle.
    """
    source, options = stage.config.source, stage.config.closed_loop
    sensitivity, conditions = None, []
    if not (isinstance(source, SimulatedSource) and stage.config.machine == "simulated"):
        return None, ()
    if options.sensitivity:
        stage.progress.update("closed_loop", 0.8, "sensitivity")
        sensitivity = _sensitivity(stage, source, controller, plant, reference.size)
    if options.conditions:
        stage.progress.update("closed_loop", 0.9, "conditions")
        conditions = ConditionBench(
            controller=controller,
            reference_filter=reference_filter,
            posterior=posterior,
            source=source,
            options=options,
            rig=rig_of(source),
            reference=reference,
            measured=OUTPUT_NAMES.index(stage.config.control_channel.output),
            rng=stage.rng("closed_loop", "conditions"),
        ).run_all()
    return sensitivity, tuple(conditions)


def _sensitivity(
    stage: StageInput,
    source: SimulatedSource,
    controller: Controller,
    plant: UncertainPlant,
    samples: int,
) -> SensitivityCheck:
    """The peak of S on the arm, large and small, beside prediction and certified bound."""
    options, certificate = stage.config.closed_loop, stage.results.certify.certificate
    assert certificate is not None
    measured = OUTPUT_NAMES.index(stage.config.control_channel.output)
    records = stage.results.records.fitted(stage.config.control_channel)
    certified = certificate.plants[0].worst_peak_sensitivity
    plan = plan_sensitivity(controller, plant, certified, records, samples)
    arms: list[tuple[str, tuple[dict[str, Any], ...], bool]] = [
        ("arm as identified", (), False),
        ("arm as identified, a tenth of the size", (), True),
    ]
    if options.effects:
        arms.append(("arm of the closed-loop check", options.effects, False))
    rows = []
    for number, (name, effects, small) in enumerate(arms):
        arm = EncodedArm(source, effects, stage.rng("closed_loop", "sensitivity noise", str(number)))
        found = measure_on(
            ClippedMachine(arm, FINITE),
            controller,
            plan,
            stage.rng("closed_loop", "sensitivity", str(number)),
            measured_index=measured,
            measurement_step=options.measurement_step,
            command_step=options.quantisation,
            small=small,
        )
        rows.append(measured_peak(name, found, plan))
    return SensitivityCheck(
        plan.nominal_peak, plan.nominal_omega_rad_s, plan.certified_peak, plan.band_rad_s, tuple(rows)
    )
