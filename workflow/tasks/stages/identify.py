"""Identify: one GOBF model per channel, and how it does on records it has not seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from ident.checks.validation import fit_on_fresh_data
from ident.closed_loop import two_stage
from ident.identify import Identification, identify
from ident.stabilisation import stabilisation
from workflow.config.run_config import Channel, RunConfig
from workflow.engine.errors import naming
from workflow.tasks.conditioning import as_bounded, as_fitted
from workflow.tasks.results import IdentifiedChannel, IdentifyResult, RecordsResult
from workflow.tasks.stages.base import StageInput


def settings(config: RunConfig) -> Mapping[str, Any]:
    """Names and identification options of the channels, roles of the records."""
    return {
        "channels": [
            channel.model_dump(mode="json", exclude={"uncertainty", "purpose"}) for channel in config.channels
        ],
        "closed_loop_data": config.closed_loop_data.model_dump(mode="json"),
    }


def identify_channels(stage: StageInput) -> IdentifyResult:
    """Fit every channel; free runs on all validation and repeat records."""
    config = stage.config
    channels = []
    for k, channel in enumerate(config.channels):
        report = stage.part_of_progress("identify", k, len(config.channels), channel.label)
        with naming(f"channel {channel.label!r}"):
            channels.append(_identify_channel(stage.results.records, config, channel, report))
    return IdentifyResult(tuple(channels))


def _identify_channel(
    records: RecordsResult, config: RunConfig, channel: Channel, report: Callable[[float, str], None]
) -> IdentifiedChannel:
    measured = [item.record for item in records.of_role("estimation")]
    bounded = [as_bounded(record, channel) for record in measured]
    first_stage = None
    if config.closed_loop_data.method == "two_stage":
        opened = two_stage(bounded, channel.identification, channel.uncertainty)
        bounded, first_stage = list(opened.records), opened.finding
        used = bounded
        if channel.bounds_band_rad_s is not None:
            used = [as_fitted(record, channel) for record in bounded]
    else:
        used = [as_fitted(record, channel) for record in measured]
    found = identify(used, channel.identification, progress=report)
    fresh = [item for item in records.records if item.role != "estimation"]
    return IdentifiedChannel(
        name=channel.label,
        input=channel.input,
        output=channel.output,
        identification=settled(found),
        used=tuple(used),
        bounded=tuple(bounded),
        # A free run of an integrating plant drifts away with friction; it is judged as it was fitted.
        fresh=tuple(fit_on_fresh_data(found.model, as_fitted(item.record, channel)) for item in fresh),
        fresh_roles=tuple(item.role for item in fresh),
        stabilisation=stabilisation(used, found, channel.identification),
        increments=channel.increments,
        band_rad_s=channel.band_rad_s,
        bounds_band_rad_s=channel.bounds_band_rad_s,
        two_stage=first_stage,
    )


def settled(found: Identification) -> Identification:
    """The same with all of its warnings looked for, so that it is a plain value."""
    return replace(found, search=replace(found.search, warnings=found.warnings), advise=tuple)
