"""All that a finished run left behind, as typed objects for the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from control_design.analysis.certificate import Certificate
from control_design.plants.plant_set import UncertainPlant
from control_design.synthesis.synthesis_result import Outcome, SynthesisResult
from ident.basis.model import GobfModel
from ident.data.record import Record
from ident.stabilisation import Stabilisation
from ident.uncertainty import FrequencyUncertainty
from workflow.config.run_config import Channel, RunConfig
from workflow.engine.run_directory import RunDirectory, StageData
from workflow.tasks.conditioning import as_fitted
from workflow.tasks.stages.results import (
    ChannelResult,
    RunRecord,
    channel_result,
    load_certificate,
    load_document,
    load_plant,
    load_records,
    load_synthesis,
)


@dataclass(frozen=True, eq=False)
class ChannelData:
    """One channel: its typed results and the documents of the two stages that made them.

    `nominal` is the model the design calls nominal, `fresh_records` are those behind `result.fresh`.
    """

    result: ChannelResult
    nominal: GobfModel
    frequency: FrequencyUncertainty
    empirical: FrequencyUncertainty | None
    stabilisation: Stabilisation | None
    identified: Mapping[str, Any]
    uncertain: Mapping[str, Any]
    fresh_records: tuple[Record, ...]

    @property
    def label(self) -> str:
        return self.result.label


@dataclass(frozen=True, eq=False)
class RunData:
    """A run's results. `synthesis`, `certificate`, `closed_loop` and `plant` are None where a run did not get
    there; `yardstick`, `whole` (responses) and `prefilter` are documents of their stages, empty likewise."""

    config: RunConfig
    records: tuple[RunRecord, ...]
    about_records: tuple[Mapping[str, Any], ...]
    channels: tuple[ChannelData, ...]
    design: Mapping[str, Any]
    synthesis: SynthesisResult | None
    certificate: Certificate | None
    closed_loop: StageData | None
    plant: UncertainPlant | None
    manifest: Mapping[str, Any]
    config_text: str
    yardstick: Mapping[str, Any] = field(default_factory=dict)
    whole: Mapping[str, Any] = field(default_factory=dict)
    prefilter: Mapping[str, Any] = field(default_factory=dict)

    @property
    def has_controller(self) -> bool:
        """Whether there is a controller that means something."""
        return self.synthesis is not None and self.synthesis.outcome is not Outcome.NOT_CONVERGED

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
        return next((str(a["units"][signal]) for a in self.about_records if a["units"].get(signal)), "")

    def loop_array(self, name: str) -> npt.NDArray[np.float64] | None:
        """An array of the closed-loop stage, if it is there."""
        if self.closed_loop is None or name not in self.closed_loop.arrays:
            return None
        return np.asarray(self.closed_loop.arrays[name], dtype=np.float64)


def _as_fitted(record: Record, channel: Channel) -> Record:
    """The record as the fit sees it, increments and filtered signals named so."""
    fitted = as_fitted(record, channel)
    name = fitted.output_names[0]
    if channel.increments:
        name = f"Δ {name}"
    elif channel.band_rad_s is not None:
        name = f"{name}, in band"
    return replace(fitted, output_names=(name,))


def load(run: RunDirectory, config: RunConfig) -> RunData:
    """Read every stage once. Raises InputError when records, identification or uncertainty are missing."""
    records = run.load_stage("records")
    identified, uncertain = run.load_stage("identify"), run.load_stage("uncertainty")
    channels = []
    typed = load_records(run)
    by_name = {item.record.name: item.record for item in typed}
    for k, channel in enumerate(config.channels):
        result = channel_result(identified, k)
        empirical = uncertain.under(f"channel/{k}/empirical/")
        plot = identified.under(f"channel/{k}/stabilisation/")
        channels.append(
            ChannelData(
                result=result,
                nominal=GobfModel.from_arrays(uncertain.under(f"channel/{k}/nominal/")),
                frequency=FrequencyUncertainty.from_arrays(uncertain.under(f"channel/{k}/frequency/")),
                empirical=FrequencyUncertainty.from_arrays(empirical) if empirical else None,
                stabilisation=Stabilisation.from_arrays(plot) if plot else None,
                identified=identified.document["channels"][k],
                uncertain=uncertain.document["channels"][k],
                fresh_records=tuple(_as_fitted(by_name[fit.name], channel) for fit in result.fresh),
            )
        )
    designed = run.stage_file("design") is not None
    synthesis = load_synthesis(run) if designed else None
    text = run.path / "config.toml"
    closed_loop = run.load_stage("closed_loop") if run.stage_file("closed_loop") is not None else None
    return RunData(
        config=config,
        records=tuple(typed),
        about_records=tuple(records.document["records"]),
        channels=tuple(channels),
        design=run.load_stage("design").document if designed else {},
        synthesis=synthesis,
        certificate=load_certificate(run) if run.stage_file("certify") is not None else None,
        closed_loop=closed_loop if closed_loop is not None and closed_loop.arrays else None,
        plant=load_plant(run, config) if synthesis is not None else None,
        manifest=run.manifest(),
        config_text=text.read_text(encoding="utf-8") if text.is_file() else "",
        yardstick=load_document(run, "yardstick"),
        whole=load_document(run, "certify").get("whole", {}),
        prefilter=load_document(run, "prefilter"),
    )
