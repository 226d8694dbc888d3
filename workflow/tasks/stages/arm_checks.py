"""Closed loop beyond the step: S measured on the simulated arm, and the loop under other conditions."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from control_design.controllers.controller import Controller
from control_design.convex.reference_filter import Prefilter
from control_design.plants.plant_set import UncertainPlant
from ident.uncertainty import ResponsePosterior
from workflow.config.run_config import SimulatedSource
from workflow.engine.run_directory import StageData
from workflow.tasks.loop_conditions import ConditionBench, condition_arrays
from workflow.tasks.loop_sensitivity import measure_on, plan_sensitivity, sensitivity_row
from workflow.tasks.sampled_plant import FINITE, ClippedMachine
from workflow.tasks.simulated_rig import OUTPUT_NAMES, EncodedArm, rig_of
from workflow.tasks.stages.base import StageInput
from workflow.tasks.stages.results import fitted_records

Real = npt.NDArray[np.float64]


def check_on_arm(
    stage: StageInput,
    controller: Controller,
    prefilter: Prefilter | None,
    plant: UncertainPlant,
    posterior: ResponsePosterior,
    reference: Real,
) -> StageData:
    """S measured on the arm, and the loop under other conditions; nothing where the arm is not simulated.

    reference: (T,) step after a lead-in, long enough to settle.
    """
    source, options = stage.config.source, stage.config.closed_loop
    document: dict[str, Any] = {"sensitivity": None, "conditions": []}
    arrays: dict[str, npt.NDArray[Any]] = {}
    if not (isinstance(source, SimulatedSource) and stage.config.machine == "simulated"):
        return StageData(document=document)
    if options.sensitivity:
        stage.progress.update("closed_loop", 0.8, "sensitivity")
        certificate = stage.results.load_stage("certify").document["certificate"]
        certified = float(certificate["plants"][0]["worst_peak_sensitivity"])
        measured = _sensitivity(stage, source, controller, plant, certified, reference.size)
        document["sensitivity"] = measured.document
        arrays |= measured.arrays
    if options.conditions:
        stage.progress.update("closed_loop", 0.9, "conditions")
        conditions = ConditionBench(
            controller=controller,
            prefilter=prefilter,
            posterior=posterior,
            source=source,
            options=options,
            rig=rig_of(source),
            reference=reference,
            measured=OUTPUT_NAMES.index(stage.config.control_channel.output),
            rng=stage.rng("closed_loop", "conditions"),
        ).run_all()
        document["conditions"] = [condition.row() for condition in conditions]
        arrays |= condition_arrays(conditions)
    return StageData(arrays, document)


def _sensitivity(
    stage: StageInput,
    source: SimulatedSource,
    controller: Controller,
    plant: UncertainPlant,
    certified: float,
    samples: int,
) -> StageData:
    """The peak of S on the arm, large and small, beside prediction and certified bound."""
    options = stage.config.closed_loop
    measured = OUTPUT_NAMES.index(stage.config.control_channel.output)
    records = fitted_records(stage.results, stage.config)
    plan = plan_sensitivity(controller, plant, certified, records, samples)
    arms: list[tuple[str, tuple[dict[str, Any], ...], bool]] = [
        ("arm as identified", (), False),
        ("arm as identified, a tenth of the size", (), True),
    ]
    if options.effects:
        arms.append(("arm of the closed-loop check", options.effects, False))
    rows, arrays = [], {}
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
        rows.append(sensitivity_row(name, found, plan))
        at = f"sensitivity/{number}"
        arrays[f"{at}/omega_rad_s"] = found.omega_rad_s
        arrays[f"{at}/magnitude"] = np.abs(found.response)
        arrays[f"{at}/std"] = found.std
    document = {
        "nominal_peak": plan.nominal_peak,
        "nominal_omega_rad_s": plan.nominal_omega_rad_s,
        "certified_peak": plan.certified_peak,
        "band_rad_s": list(plan.band_rad_s),
        "measured": rows,
    }
    return StageData(arrays, document)
