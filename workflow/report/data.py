"""All that a finished run left behind, as typed objects for the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from control_design.analysis.certificate import Certificate
from control_design.plants.plant_set import UncertainPlant
from control_design.synthesis.synthesis_result import SynthesisResult
from ident.basis.model import GobfModel
from ident.data.record import Record
from ident.stabilisation import Stabilisation
from ident.uncertainty import FrequencyUncertainty
from workflow.config.run_config import Channel, RunConfig
from workflow.tasks.conditioning import as_fitted
from workflow.tasks.results import (
    AchievablePerformance,
    CertifyResult,
    DesignResult,
    IdentifiedChannel,
    LoopCheck,
    ReferenceFilterResult,
    RunRecord,
    RunResults,
    SampledResponses,
    UncertainChannel,
)


@dataclass(frozen=True, eq=False)
class ChannelData:
    """One channel: what was identified, its ellipses, and the records behind its free runs."""

    identified: IdentifiedChannel
    uncertain: UncertainChannel
    fresh_records: tuple[Record, ...]

    @property
    def label(self) -> str:
        return self.identified.name

    @property
    def result(self) -> IdentifiedChannel:
        return self.identified

    @property
    def nominal(self) -> GobfModel:
        return self.uncertain.nominal

    @property
    def frequency(self) -> FrequencyUncertainty:
        return self.uncertain.frequency

    @property
    def empirical(self) -> FrequencyUncertainty | None:
        return self.uncertain.empirical

    @property
    def stabilisation(self) -> Stabilisation | None:
        return self.identified.stabilisation


@dataclass(frozen=True, eq=False)
class RunData:
    """A run's results. `closed_loop` is None where the loop was not run, `plant` where there was nothing to
    design for."""

    config: RunConfig
    records: tuple[RunRecord, ...]
    channels: tuple[ChannelData, ...]
    design: DesignResult
    achievable: AchievablePerformance
    certify: CertifyResult
    reference_filter: ReferenceFilterResult
    closed_loop: LoopCheck | None
    plant: UncertainPlant | None
    manifest: Mapping[str, Any]
    config_text: str

    @property
    def synthesis(self) -> SynthesisResult | None:
        return self.design.synthesis

    @property
    def certificate(self) -> Certificate | None:
        return self.certify.certificate

    @property
    def sampled(self) -> SampledResponses:
        return self.certify.sampled

    @property
    def has_controller(self) -> bool:
        """Whether there is a controller that means something."""
        return self.design.has_controller

    @property
    def level(self) -> float:
        """Level of the ellipses of the channel that is fed back."""
        return self.control.frequency.level

    @property
    def certified_level(self) -> float:
        """Level of the ellipses that were certified: calibrated to whole responses where that was asked
        for."""
        joint = None if self.certificate is None else self.certificate.joint
        return self.level if joint is None else max(self.level, joint.level)

    @property
    def control(self) -> ChannelData:
        return self.channels[self.config.control_index]

    @property
    def performance(self) -> ChannelData | None:
        index = self.config.performance_index
        return None if index is None else self.channels[index]

    def unit(self, signal: str) -> str:
        """Unit of a signal, empty where nobody stated it."""
        return next((units[signal] for item in self.records if (units := item.units).get(signal)), "")


def _as_fitted(record: Record, channel: Channel) -> Record:
    """The record as the fit sees it, increments and filtered signals named so."""
    fitted = as_fitted(record, channel)
    name = fitted.output_names[0]
    if channel.increments:
        name = f"Δ {name}"
    elif channel.band_rad_s is not None:
        name = f"{name}, in band"
    return replace(fitted, output_names=(name,))


def load(results: RunResults, config: RunConfig) -> RunData:
    """Everything the page shows. Raises InputError when a stage is missing."""
    by_name = {item.name: item.record for item in results.records.records}
    channels = [
        ChannelData(
            identified,
            uncertain,
            tuple(_as_fitted(by_name[fit.name], channel) for fit in identified.fresh),
        )
        for channel, identified, uncertain in zip(
            config.channels, results.identify.channels, results.uncertainty.channels, strict=True
        )
    ]
    text = results.run.path / "config.toml"
    return RunData(
        config=config,
        records=results.records.records,
        channels=tuple(channels),
        design=results.design,
        achievable=results.achievable_performance,
        certify=results.certify,
        reference_filter=results.reference_filter,
        closed_loop=results.closed_loop.check,
        plant=results.uncertainty.plant(config) if results.design.synthesis is not None else None,
        manifest=results.run.manifest(),
        config_text=text.read_text(encoding="utf-8") if text.is_file() else "",
    )
