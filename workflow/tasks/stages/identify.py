"""Identify: one GOBF model per channel, and how it does on records it has not seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.checks.validation import FreshFit, fit_on_fresh_data
from ident.closed_loop import two_stage
from ident.identify import Identification, identify
from ident.stabilisation import stabilisation
from workflow.config.run_config import RunConfig
from workflow.engine.errors import naming
from workflow.engine.run_directory import StageData
from workflow.engine.storage import AnyArray
from workflow.tasks.conditioning import as_bounded, as_fitted
from workflow.tasks.stages.base import StageInput
from workflow.tasks.stages.results import RunRecord, load_records


def settings(config: RunConfig) -> Mapping[str, Any]:
    """Names and identification options of the channels, roles of the records."""
    return {
        "channels": [
            channel.model_dump(mode="json", exclude={"uncertainty", "purpose"}) for channel in config.channels
        ],
        "closed_loop_data": config.closed_loop_data.model_dump(mode="json"),
    }


def identify_channels(stage: StageInput) -> StageData:
    """Fit every channel; free runs on all validation and repeat records."""
    records = load_records(stage.results)
    config = stage.config
    arrays: dict[str, AnyArray] = {}
    about = []
    for k, channel in enumerate(config.channels):
        report = stage.part_of_progress("identify", k, len(config.channels), channel.label)
        with naming(f"channel {channel.label!r}"):
            measured = [item.record for item in records if item.role == "estimation"]
            bounded = [as_bounded(record, channel) for record in measured]
            first_stage = None
            if config.closed_loop_data.method == "two_stage":
                opened = two_stage(bounded, channel.identification, channel.uncertainty)
                bounded, first_stage = list(opened.records), opened.verdict
                used = bounded
                if channel.bounds_band_rad_s is not None:
                    used = [as_fitted(record, channel) for record in bounded]
            else:
                used = [as_fitted(record, channel) for record in measured]
            found = identify(used, channel.identification, progress=report)
            plot = stabilisation(used, found, channel.identification)
            # A free run of an integrating plant drifts away with friction; it is judged as it was fitted.
            fresh = [
                fit_on_fresh_data(found.model, as_fitted(item.record, channel))
                for item in records
                if item.role != "estimation"
            ]
        at = f"channel/{k}/"
        arrays |= {f"{at}identification/{key}": value for key, value in found.to_arrays().items()}
        arrays |= {f"{at}stabilisation/{key}": value for key, value in plot.to_arrays().items()}
        for i, record in enumerate(used):
            arrays |= {f"{at}used/{i}/{key}": value for key, value in record.to_arrays().items()}
        if channel.bounds_band_rad_s is not None:
            for i, record in enumerate(bounded):
                arrays |= {f"{at}bounded/{i}/{key}": value for key, value in record.to_arrays().items()}
        for i, fit in enumerate(fresh):
            arrays |= {f"{at}fresh/{i}/{key}": value for key, value in fit.to_arrays().items()}
        about.append({**describe(config, k, found, fresh, records), "two_stage": first_stage})
    return StageData(arrays, {"channels": about})


def describe(
    config: RunConfig,
    index: int,
    found: Identification,
    fresh: Sequence[FreshFit],
    records: Sequence[RunRecord],
) -> dict[str, Any]:
    """What a reader wants to know about one channel, in plain numbers."""
    channel = config.channels[index]
    role = {item.record.name: item.role for item in records}
    return {
        "name": channel.label,
        "input": channel.input,
        "output": channel.output,
        "purpose": config.purpose_of(index),
        "increments": channel.increments,
        "band_rad_s": channel.band_rad_s,
        "bounds_band_rad_s": channel.bounds_band_rad_s,
        "n_used": len(found.record_names),
        "n_fresh": len(fresh),
        "fit_estimation_percent": dict(zip(found.record_names, found.fit_percent.tolist(), strict=True)),
        "fit_validation_percent": {
            fit.name: fit.fit_percent for fit in fresh if role[fit.name] == "validation"
        },
        "fit_repeat_percent": {fit.name: fit.fit_percent for fit in fresh if role[fit.name] == "repeat"},
        **describe_model(found),
    }


def describe_model(found: Identification) -> dict[str, Any]:
    """Poles in an engineer's units, structure and the search's own remarks."""
    model = found.model
    poles = model.poles
    # A pole at or left of z = 0 is no decay that a continuous-time rate could describe.
    decay = -np.log(poles.real[poles.real > 0]) / model.dt_s
    modes = sorted(zip(poles.omega_rad_s(model.dt_s).tolist(), poles.zeta().tolist(), strict=True))
    return {
        "order": model.order,
        "integrators": model.integrators,
        "input_delay_samples": model.input_delay_samples,
        "feedthrough": found.structure.feedthrough,
        "modes": [
            {"frequency_Hz": omega / (2 * np.pi), "omega_rad_s": omega, "damping": zeta}
            for omega, zeta in modes
        ],
        "real_poles_per_s": sorted(decay.tolist()),
        "real_poles_z": sorted(poles.real.tolist(), reverse=True),
        "noise_std": found.noise_std,
        "tangent_optimality": found.tangent_optimality,
        "warnings": list(found.warnings),
        "verdicts": list(found.verdicts),
        "order_table": [
            {"n_real": step.n_real, "n_pairs": step.n_pairs, "rss": step.rss, "criterion": step.criterion}
            for step in found.order_table
        ],
        "search_evaluations": found.search.evaluations,
    }
