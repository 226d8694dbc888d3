"""Typed results of finished stages, as later stages and the report read them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from control_design.analysis.certificate import Certificate
from control_design.plants.plant_set import Channel as PlantChannel
from control_design.plants.plant_set import UncertainPlant
from control_design.synthesis.synthesis_result import SynthesisResult
from ident.basis.model import GobfModel
from ident.checks.validation import FreshFit
from ident.data.record import Record
from ident.identify import Identification
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior
from workflow.config.run_config import Role, RunConfig
from workflow.engine.run_directory import RunDirectory, StageData


@dataclass(frozen=True, eq=False)
class RunRecord:
    """A record of the run and what the configuration says about it."""

    record: Record
    role: Role
    condition: str | None
    remark: str


def load_records(run: RunDirectory) -> list[RunRecord]:
    """All records, in the order of the configuration."""
    data = run.load_stage("records")
    return [
        RunRecord(
            Record.from_arrays(data.under(f"record/{index}/")),
            about["role"],
            about["condition"],
            about["remark"],
        )
        for index, about in enumerate(data.document["records"])
    ]


def fitted_records(run: RunDirectory, config: RunConfig) -> list[Record]:
    """The estimation records of the channel that is fed back."""
    channel = config.control_channel
    return [
        item.record.siso(channel.input, channel.output)
        for item in load_records(run)
        if item.role == "estimation"
    ]


@dataclass(frozen=True, eq=False)
class ChannelResult:
    """One channel after identification: what was fitted to what, and free runs on the other records.

    `used` are the SISO estimation records as the fit saw them, `bounded` the same as the ellipses see them,
    `fresh` the free runs on records not fitted.
    """

    label: str
    identification: Identification
    used: tuple[Record, ...]
    bounded: tuple[Record, ...]
    fresh: tuple[FreshFit, ...]


def load_identification(run: RunDirectory, index: int) -> ChannelResult:
    """Channel `index` (order of the configuration)."""
    return channel_result(run.load_stage("identify"), index)


def channel_result(data: StageData, index: int) -> ChannelResult:
    """The same from a stage already read."""
    about = data.document["channels"][index]
    at = f"channel/{index}/"
    used = tuple(Record.from_arrays(data.under(f"{at}used/{i}/")) for i in range(about["n_used"]))
    bounded = used
    if about["bounds_band_rad_s"] is not None:
        bounded = tuple(Record.from_arrays(data.under(f"{at}bounded/{i}/")) for i in range(about["n_used"]))
    return ChannelResult(
        label=about["name"],
        identification=Identification.from_arrays(data.under(f"{at}identification/")),
        used=used,
        bounded=bounded,
        fresh=tuple(FreshFit.from_arrays(data.under(f"{at}fresh/{i}/")) for i in range(about["n_fresh"])),
    )


def load_posterior(run: RunDirectory, index: int) -> ResponsePosterior:
    """Coefficient posterior of channel `index`."""
    return ResponsePosterior.from_arrays(run.load_stage("uncertainty").under(f"channel/{index}/posterior/"))


def load_frequency(run: RunDirectory, index: int) -> FrequencyUncertainty:
    """Ellipses of channel `index` on the display grid."""
    return FrequencyUncertainty.from_arrays(
        run.load_stage("uncertainty").under(f"channel/{index}/frequency/")
    )


def load_empirical(run: RunDirectory, index: int) -> FrequencyUncertainty | None:
    """Response of channel `index` straight from the records, if they allow one."""
    arrays = run.load_stage("uncertainty").under(f"channel/{index}/empirical/")
    return FrequencyUncertainty.from_arrays(arrays) if arrays else None


def load_plant(run: RunDirectory, config: RunConfig) -> UncertainPlant:
    """The uncertain plant the controller is designed for: control channel and first performance channel."""
    data = run.load_stage("uncertainty")

    def channel(index: int) -> PlantChannel:
        nominal = GobfModel.from_arrays(data.under(f"channel/{index}/nominal/"))
        posterior = ResponsePosterior.from_arrays(data.under(f"channel/{index}/posterior/"))
        return PlantChannel(nominal.to_control(), posterior, config.channels[index].uncertainty.level)

    control = channel(config.control_index)
    performance = config.performance_index
    return UncertainPlant(
        name=config.control_channel.label,
        nominal=control.nominal,
        uncertainty=control.uncertainty,
        performance=None if performance is None else channel(performance),
        level=control.level,
    )


def load_synthesis(run: RunDirectory) -> SynthesisResult | None:
    """The design, or None where the specification was impossible from the start (see the document's
    `reason`)."""
    document = run.load_stage("design").document
    return SynthesisResult.from_dict(dict(document["synthesis"])) if document["synthesis"] else None


def load_certificate(run: RunDirectory) -> Certificate | None:
    """The certificate, or None where there is no controller to certify."""
    document = run.load_stage("certify").document
    return Certificate.from_dict(document["certificate"]) if document["certificate"] else None


def load_document(run: RunDirectory, stage: str) -> Mapping[str, Any]:
    """The document of a stage; empty where the run was made before there was such a stage."""
    return {} if run.stage_file(stage) is None else run.load_stage(stage).document
