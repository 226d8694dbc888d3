"""`AnyRun`: what the configurations of all runs are; `RunConfig`: that of one loop, from one TOML file."""

from __future__ import annotations

import math
import os
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from importlib import resources
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Protocol, Self, TypeVar

import tomlkit
from pydantic import AfterValidator, Field, model_validator

from control_design.specification import Specification
from control_design.synthesis.synthesis_options import SynthesisOptions
from plant.experiment_plan import ExperimentPlan
from workflow.config.design_options import AchievableOptions, CertificateOptions, ReferenceFilterSettings
from workflow.config.log_reading import LogReading, TimeUnit
from workflow.config.rig_settings import EffectTable, Excitation, Multisine, RigChoice
from workflow.config.settings import InputPath, Section, check, expand, repeated
from workflow.config.uncertainty_options import FitOptions, UncertaintyOptions
from workflow.engine.documents import read_toml

Role = Literal["estimation", "validation", "repeat"]
Name = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]+$", max_length=80)]


RecordRole = Annotated[
    Role, Field(description="estimation: fitted; validation: only simulated; repeat: scatter between runs")
]


class RunSection(Section):
    """Name, headline and seed of a run.

    Notes
    -----
    The seed decides every random stream: the same configuration and seed give the same bytes.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=60)] = Field(
        "run", description="name of the default output directory; letters, digits, '_', '-' and '.'"
    )
    title: Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]*$", max_length=120)] = Field(
        "", description="headline of the report; the name if empty"
    )
    seed: int = Field(2006, ge=0, description="seed of every random stream of the run")


class SimulatedRecord(Section):
    """One experiment on the simulated arm."""

    name: Name = Field(description="name of the record")
    role: RecordRole = "estimation"
    condition: str | None = Field(None, description="records with the same label are repeats of one another")
    remark: str = Field("", description="shown beside the record in the report")
    excitation: Excitation


class SimulatedLoop(Section):
    """PD controller of the hub angle, u = K_P e + K_D de/dt by backward differences."""

    proportional_V_per_rad: float = Field(gt=0, description="K_P")
    derivative_Vs_per_rad: float = Field(0.0, ge=0, description="K_D")
    reference_rad_per_V: float = Field(
        gt=0, description="the reference is the excitation of a record times this"
    )


class SimulatedSource(Section):
    """Records of the simulated flexible arm in SI units, planned or listed one by one.

    Notes
    -----
    The arm has the parameters of `rig` and, beside these, `effects`; `encoder_step_rad` is the step of its
    hub angle, rad. Modes beyond `modes` are neglected. A source without a record is refused.
    """

    kind: Literal["simulated"] = Field(description="records come from the simulated arm")
    rig: RigChoice = Field("paper_link", description="preset 'paper_link', or the path of a rig TOML file")
    modes: int | None = Field(
        None, ge=1, le=20, description="flexible modes; default: all below Nyquist, at least 3"
    )
    effects: tuple[EffectTable, ...] = Field(
        (), description="effects that the nominal rig lacks, e.g. coulomb_friction"
    )
    encoder_step_rad: float = Field(0.0, ge=0, description="resolution of the hub encoder; 0 is none")
    loop: SimulatedLoop | None = Field(
        None, description="records are made in closed loop, on this controller; default: in open loop"
    )
    plan: ExperimentPlan | None = Field(
        None, exclude=True, description="estimation records, one per amplitude and realisation; read once"
    )
    records: tuple[SimulatedRecord, ...] = ()

    @model_validator(mode="after")
    def _with_planned_records(self) -> Self:
        if self.plan is not None:
            # One record for each amplitude and realisation, in front of those that are listed.
            shared = self.plan.model_dump(exclude={"rms_V", "realisations"})
            planned = (
                SimulatedRecord(
                    name=f"{rms_V:g} V rms, realisation {k}",
                    excitation=Multisine(kind="multisine", grid="odd_random", rms_V=rms_V, **shared),
                )
                for rms_V in self.plan.rms_V
                for k in range(1, self.plan.realisations + 1)
            )
            object.__setattr__(self, "records", (*planned, *self.records))
            object.__setattr__(self, "plan", None)
            # Whoever states a plan states its records, which are stored in its place.
            self.model_fields_set.discard("plan")
            self.model_fields_set.add("records")
        if not self.records:
            raise ValueError("there is nothing to simulate: give [source.plan] or [[source.records]]")
        return self

    @property
    def input_limit(self) -> float | None:
        """What the amplifier gives at most, V: a number of its data sheet, like the rig's."""
        limits = [effect["limit_V"] for effect in self.effects if effect["name"] == "actuator_saturation"]
        return min(limits, default=None)


class FileRecord(Section):
    """One log file; [source] gives the keys that are left out."""

    kind: ClassVar[str] = "file"
    path: InputPath = Field(
        description="csv or named arrays (npz, mat, ...); relative to this file; ${FLEXLINK_DATA} is expanded"
    )
    name: Name | None = Field(None, description="default: the file name without its ending")
    role: RecordRole = "estimation"
    condition: str | None = Field(None, description="records with the same label are repeats of one another")
    remark: str = Field("", description="shown beside the record in the report")
    time: str | None = Field(None, description="name of the time column")
    time_unit: TimeUnit | None = Field(None, description="its unit; default: as in its name, else s")
    dt_s: float | None = Field(None, gt=0, description="sampling period, where there is no time column")
    references: tuple[str, ...] | None = Field(None, description="reference columns, closed loop")
    start_sample: int = Field(0, ge=0, description="first row used, counted from 0")
    stop_sample: int | None = Field(None, ge=1, description="row after the last one used")
    run: int | None = Field(
        None,
        ge=0,
        description="of a table in which time starts again, and another column changes there; from 0",
    )
    mirrored: bool = Field(False, description="change the sign of every signal (G stays the same)")


class FileSource(LogReading):
    """Records read from log files, in units of the columns unless `scale` and `units` say otherwise.

    Notes
    -----
    Every record needs a time base: a column (`time`) or a sampling period (`dt_s`, s), never both; another
    source is refused.
    """

    kind: Literal["files"] = Field(description="records are log files")
    references: tuple[str, ...] = Field((), description="reference columns of logs made in closed loop")
    records: tuple[FileRecord, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _time_is_known(self) -> Self:
        if self.time is not None and self.dt_s is not None:
            raise ValueError("give time (a column) or dt_s (a number), not both")
        for index, record in enumerate(self.records):
            if record.time is not None and record.dt_s is not None:
                raise ValueError(f"records[{index}]: give time (a column) or dt_s (a number), not both")
            if not any((self.time, self.dt_s, record.time, record.dt_s)):
                raise ValueError(
                    f"records[{index}] has no time base: give time = 'column name' or dt_s = seconds in "
                    "[source]"
                )
            if record.stop_sample is not None and record.stop_sample <= record.start_sample:
                raise ValueError(
                    f"records[{index}].stop_sample must be above start_sample {record.start_sample}, "
                    f"got {record.stop_sample}"
                )
        return self


Source = Annotated[SimulatedSource | FileSource, Field(discriminator="kind")]


def _ordered(band: tuple[float, float]) -> tuple[float, float]:
    if not 0 < band[0] < band[1]:
        raise ValueError(f"a band needs 0 < low < high in rad/s; got {band[0]:g}, {band[1]:g}")
    return band


Band = Annotated[tuple[float, float], AfterValidator(_ordered)]


class Channel(Section):
    """One input to one output."""

    input: str = Field(min_length=1, description="column or signal name")
    output: str = Field(min_length=1, description="column or signal name")
    name: Name | None = Field(None, description="default: the output's name")
    purpose: Literal["control", "performance"] | None = Field(
        None,
        description="'control': measured and fed back; 'performance': must not swing; default: "
        "control for the first channel, performance for the others",
    )
    increments: bool = Field(
        False,
        description="fit differences between samples of input and output: same response, less weight "
        "on drift and friction",
    )
    band_rad_s: Band | None = Field(
        None,
        description="fit inside this band only [rad/s, low and high]: the same filter on input and "
        "output keeps the response and removes drift, friction and noise outside the band",
    )
    bounds_band_rad_s: Band | None = Field(
        None, description="band of the data for the ellipses, if wider than that of the poles"
    )
    identification: FitOptions = Field(default_factory=FitOptions)
    uncertainty: UncertaintyOptions = Field(default_factory=UncertaintyOptions)

    @property
    def data_band_rad_s(self) -> tuple[float, float] | None:
        """Band of the data behind the ellipses; None where they are not confined to one."""
        return self.bounds_band_rad_s or self.band_rad_s

    @property
    def embedding(self) -> UncertaintyOptions:
        """The uncertainty's settings with what the identification knows of the order."""
        order_given = self.uncertainty.order_given
        if order_given is None:
            order_given = self.identification.n_pairs is not None
        return self.uncertainty.model_copy(update={"order_given": order_given})

    @model_validator(mode="after")
    def _one_filter(self) -> Self:
        if self.input == self.output:
            raise ValueError(f"input and output are the same column, {self.input!r}")
        if self.increments and (self.band_rad_s or self.bounds_band_rad_s):
            raise ValueError("give increments or a band, not both: each is a filter of its own")
        if self.bounds_band_rad_s is not None and self.band_rad_s is None:
            raise ValueError("bounds_band_rad_s goes with band_rad_s, the band of the fit")
        if self.uncertainty.friction_identified and (self.increments or self.band_rad_s):
            raise ValueError(
                f"response = {self.uncertainty.response!r} takes records as measured: no increments, no band"
            )
        return self

    @property
    def label(self) -> str:
        return self.name or self.output


class StatedController(Section):
    """u = K (r - y) of the loop the logs were made in."""

    numerator: tuple[float, ...] = Field(
        min_length=1, description="coefficients of K in z, highest power first, in units of the logs"
    )
    denominator: tuple[float, ...] = Field(
        min_length=1, description="the same of its denominator; the delay of the computation belongs to it"
    )

    @model_validator(mode="after")
    def _proper(self) -> Self:
        if len(self.numerator) > len(self.denominator) or not self.denominator[0] or not any(self.numerator):
            raise ValueError("K needs a denominator of at least the numerator's degree, and a gain")
        return self


class ClosedLoopData(Section):
    """Use of logs made in closed loop."""

    method: Literal["auto", "direct", "two_stage", "indirect"] = Field(
        "auto",
        description="direct: the logged input; two_stage: the part of the input that the reference explains; "
        "indirect: the same with what the stated controller tells of the reference; auto: the data decide",
    )
    controller: StatedController | None = Field(
        None, description="of the loop the logs were made in: numerator and denominator in z"
    )
    controller_file: InputPath | None = Field(
        None,
        description="the same from a file: controller.json of a run, or A, B, C, D, dt_s (npz, json, mat)",
    )

    @property
    def controlled(self) -> bool:
        """The controller of the loop is known."""
        return self.controller is not None or self.controller_file is not None

    @property
    def stated(self) -> bool:
        """The logs were made in closed loop, whatever they look like."""
        return self.method != "auto" or self.controlled

    @model_validator(mode="after")
    def _one_controller(self) -> Self:
        if self.method == "indirect" and not self.controlled:
            raise ValueError(
                "method = 'indirect' needs the controller of the loop: controller = { numerator = [...], "
                "denominator = [...] } in z, or controller_file"
            )
        if self.method in ("direct", "two_stage") and self.controlled:
            raise ValueError(f"method = {self.method!r} uses no controller: leave one of them out")
        if self.controller is not None and self.controller_file is not None:
            raise ValueError("give controller or controller_file, not both")
        return self


class ClosedLoopOptions(Section):
    """Simulation of the closed loop."""

    machine: Literal["simulated", "identified"] | None = Field(
        None,
        description="'simulated': nonlinear arm of [source]; 'identified': plants drawn from the "
        "identified uncertainty; default: simulated if the records are",
    )
    effects: tuple[EffectTable, ...] = Field(
        (), description="further effects on the simulated arm, e.g. tip_payload"
    )
    reference_step: float | None = Field(
        None,
        gt=0,
        description="reference step, in units of the measured output; default: half its spread in the "
        "estimation records",
    )
    disturbance: float | None = Field(
        None,
        description="disturbance step at the plant's input half-way, in its units; default: a tenth "
        "of the input's spread",
    )
    quantisation: float = Field(
        0.0, ge=0, description="step of the converter at the plant's input, in its units"
    )
    measurement_step: float = Field(0.0, ge=0, description="step of the measured output, e.g. an encoder's")
    duration_s: float | None = Field(
        None, gt=0, description="length of a run; default: long enough for two settled steps"
    )
    draws: int = Field(20, ge=1, le=2000, description="Monte Carlo runs")
    friction_feedforward: bool = Field(
        False,
        description="add the identified dry friction at the reference speed to the command; needs "
        "response = 'without friction'",
    )
    sensitivity: bool = Field(
        True, description="on the simulated arm: measure S and compare with the prediction"
    )
    conditions: bool = Field(
        True,
        description="on the simulated arm: also run a slew, a push at the tip, payloads of 0 to 200 "
        "%, delay, friction, coarse converters and a step beyond the voltage limit",
    )


class Notes(Section):
    """Known and unknown facts about the rig, shown in the report as written."""

    known: tuple[str, ...] = Field((), description="sentences for the report")
    unknown: tuple[str, ...] = Field((), description="sentences for the report: limits of its statements")


class AnyRun(Section):
    """What runs of one loop and of several joints have in common."""

    run: RunSection = Field(default_factory=RunSection)
    source: Section

    @model_validator(mode="after")
    def _each_row_once(self) -> Self:
        """Rows counted twice shrink every bound, and rows that were fitted validate nothing."""
        if not isinstance(self.source, FileSource):
            return self
        for first, second in combinations(self.source.records, 2):
            ends = [math.inf if r.stop_sample is None else r.stop_sample for r in (first, second)]
            overlap = first.start_sample < ends[1] and second.start_sample < ends[0]
            if (first.path, first.run) == (second.path, second.run) and overlap:
                raise ValueError(
                    f"records {record_name(first)!r} and {record_name(second)!r} share rows of "
                    f"{first.path.name}: use each row once"
                )
        return self

    @property
    def input_files(self) -> list[Path]:
        """Every file the run reads besides its configuration."""
        source = self.source
        return sorted({record.path for record in source.records}) if isinstance(source, FileSource) else []

    def to_document(self) -> dict[str, Any]:
        """What the configuration states, JSON-able; `from_document` gives back an equal configuration.

        Notes
        -----
        Defaults are left out, because a default and the same value stated are different settings: a delay of
        0 that is stated is tested and kept, one that is not stated is sought in the data.
        """
        return self.model_dump(mode="json", exclude_unset=True)

    def with_defaults(self) -> dict[str, Any]:
        """Every key with its value, JSON-able, for whoever reads values; it no longer tells what was
        stated."""
        return self.model_dump(mode="json")

    def to_toml(self) -> str:
        """What the configuration states, as a user would write it; keys without a value are left out."""
        return tomlkit.dumps(self.model_dump(mode="json", exclude_unset=True, exclude_none=True))

    @classmethod
    def from_document(cls, document: Mapping[str, Any], *, source: str) -> Self:
        """The configuration that `to_document` wrote, with the same keys stated.

        Input files may have moved away since: a report does not need them.
        """
        return check(cls, document, source=source, context={"may_be_gone": True})


RunT = TypeVar("RunT", bound=AnyRun)


class SimulationConfig(AnyRun):
    """The experiments of a simulated machine alone."""

    source: SimulatedSource


class Signals(Protocol):
    """An input and an output by their columns."""

    @property
    def input(self) -> str:
        """Column of the command."""

    @property
    def output(self) -> str:
        """Column of what is measured."""


class AnyConfig(AnyRun):
    """The configuration of a whole run, of one loop or of several joints."""

    @property
    @abstractmethod
    def columns(self) -> Sequence[Signals]:
        """Inputs and outputs that records have."""

    @property
    @abstractmethod
    def loops(self) -> Sequence[Signals]:
        """What the controller drives and is fed."""


class RunConfig(AnyConfig):
    """A whole run of one loop. Load with `load_config`."""

    source: Source
    channels: tuple[Channel, ...] = Field(min_length=1)
    closed_loop_data: ClosedLoopData = Field(default_factory=ClosedLoopData)
    specification: Specification
    synthesis: SynthesisOptions = Field(default_factory=SynthesisOptions)
    certificate: CertificateOptions = Field(default_factory=CertificateOptions)
    achievable_performance: AchievableOptions = Field(default_factory=AchievableOptions)
    reference_filter: ReferenceFilterSettings | None = Field(
        None, description="second degree of freedom; default: the reference is not filtered"
    )
    closed_loop: ClosedLoopOptions = Field(default_factory=ClosedLoopOptions)
    notes: Notes = Field(default_factory=Notes)

    @model_validator(mode="after")
    def _describes_one_arm(self) -> Self:
        described = dict.fromkeys(channel.uncertainty.response for channel in self.channels)
        if "this amplitude" in described and len(described) > 1:
            raise ValueError(
                "a certificate holds at one amplitude: the channels describe "
                + " and ".join(map(repr, described))
            )
        return self

    @model_validator(mode="after")
    def _parts_fit_together(self) -> Self:
        labels = [channel.label for channel in self.channels]
        label = repeated(labels)
        if label is not None:
            raise ValueError(f"two channels are called {label!r}: give them different names")
        control = [label for index, label in enumerate(labels) if self.purpose_of(index) == "control"]
        if len(control) != 1:
            raise ValueError(
                f"exactly one channel has purpose 'control' (the one fed back); found {len(control)}"
            )
        if len({channel.input for channel in self.channels}) > 1:
            raise ValueError("all channels must have the same input: the controller drives one actuator")
        name = repeated(self.record_names)
        if name is not None:
            raise ValueError(f"two records are called {name!r}: give them different names")
        if not any(record.role == "estimation" for record in self.source.records):
            raise ValueError("no record has role 'estimation': there is nothing to identify from")
        if self.closed_loop.machine == "simulated" and self.source.kind != "simulated":
            raise ValueError("closed_loop.machine = 'simulated' needs [source] kind = 'simulated'")
        if self.closed_loop.effects and self.machine != "simulated":
            raise ValueError("closed_loop.effects act on the simulated arm only")
        if self.closed_loop.friction_feedforward and not self.friction_identified:
            raise ValueError(
                "closed_loop.friction_feedforward = true needs an identified friction: response = "
                "'without friction' in [channels.uncertainty] of a channel"
            )
        if self.friction_identified:
            if self.closed_loop_data.method not in ("auto", "direct"):
                raise ValueError("identifying friction needs closed_loop_data.method = 'direct' or 'auto'")
            control_options = self.control_channel.identification
            if control_options.integrators > 1 or control_options.feedthrough:
                raise ValueError(
                    "friction is identified from the control channel: its output is the position of the "
                    "shaft, so it has at most one integrator and no direct term"
                )
        if self.closed_loop_data.method == "two_stage" and not self._has_references:
            raise ValueError(
                "closed_loop_data.method = 'two_stage' needs references in [source] for every record"
            )
        return self

    @property
    def _has_references(self) -> bool:
        if isinstance(self.source, SimulatedSource):
            return False
        return all(self.source.references or record.references for record in self.source.records)

    @property
    def record_names(self) -> list[str]:
        return [record_name(record) for record in self.source.records]

    @property
    def machine(self) -> Literal["simulated", "identified"]:
        """What the closed loop is checked on."""
        return self.closed_loop.machine or ("simulated" if self.source.kind == "simulated" else "identified")

    @property
    def friction_identified(self) -> bool:
        """The dry friction of the shaft is identified: the uncertainty of some channel needs it."""
        return any(channel.uncertainty.friction_identified for channel in self.channels)

    @property
    def control_channel(self) -> Channel:
        """The channel that is fed back."""
        return self.channels[self.control_index]

    def purpose_of(self, index: int) -> Literal["control", "performance"]:
        """Purpose of a channel with the default filled in."""
        return self.channels[index].purpose or ("control" if index == 0 else "performance")

    @property
    def control_index(self) -> int:
        """Position of the control channel."""
        return next(index for index in range(len(self.channels)) if self.purpose_of(index) == "control")

    @property
    def performance_index(self) -> int | None:
        """Position of the first performance channel, the one the damping requirement is about."""
        return next((k for k in range(len(self.channels)) if self.purpose_of(k) == "performance"), None)

    @property
    def input_files(self) -> list[Path]:
        """Every file the run reads besides its configuration."""
        files = set(super().input_files)
        # A rig may be a preset's name, which is no file.
        for path in (getattr(self.source, "rig", None), self.closed_loop_data.controller_file):
            if isinstance(path, Path):
                files.add(path)
        return sorted(files)

    @property
    def columns(self) -> tuple[Channel, ...]:
        """Inputs and outputs that records have."""
        return self.channels

    @property
    def loops(self) -> tuple[Channel, ...]:
        """What the controller drives and is fed."""
        return (self.control_channel,)


def record_name(record: SimulatedRecord | FileRecord) -> str:
    """Name of a record with the default filled in."""
    return record.name if record.name is not None else record.path.stem


def load_config(path: Path) -> tuple[RunConfig, str]:
    """Configuration and its text. Raises InputError: file, dotted key and what was expected in one line."""
    return loaded(RunConfig, path)


def loaded(kind: type[RunT], path: Path) -> tuple[RunT, str]:
    """Configuration of a kind of run, and its text.

    Parameters
    ----------
    kind : type
        A configuration's class.
    path : Path
        A TOML file.

    Returns
    -------
    config : RunT
    text : str
        As it was written, with absolute paths, so that it states the same wherever it is kept.

    Raises
    ------
    InputError
        As of `load_config`.
    """
    text, document = read_toml(path)
    config = check(kind, document, source=str(path), context={"base": path.absolute().parent})
    # Byte for byte where no path is relative.
    if not _state_absolute_paths(document, config):
        return config, text
    return config, with_absolute_paths(text, config)


def with_absolute_paths(text: str, config: AnyRun) -> str:
    """The text of a configuration, which states the same wherever it is kept then. Comments stay."""
    written = tomlkit.parse(text)
    _state_absolute_paths(written, config)
    return tomlkit.dumps(written)


def _state_absolute_paths(stated: Any, found: Any) -> bool:
    """Write absolute paths into a parsed document.

    Parameters
    ----------
    stated : Any
        Tables and lists as parsed; changed in place.
    found : Any
        What was read from them: settings, mappings and tuples.

    Returns
    -------
    bool
        Whether a path was changed. Those with variables of the environment stay where these make them
        absolute.
    """
    pairs: list[tuple[Any, Any]]
    if isinstance(stated, Mapping):
        pairs = [(key, _part(found, key)) for key in stated]
    elif isinstance(stated, list) and isinstance(found, tuple | list) and len(stated) == len(found):
        # Of another length it is made from what is stated: records of a plan.
        pairs = list(enumerate(found))
    else:
        return False
    is_changed = False
    for key, part in pairs:
        value = stated[key]
        if isinstance(part, Path) and isinstance(value, str):
            if not os.path.isabs(expand(value)):
                stated[key] = str(part)
                is_changed = True
        elif _state_absolute_paths(value, part):
            is_changed = True
    return is_changed


def _part(found: Any, key: str) -> Any:
    """What settings or a mapping have under a key; None where they have no such key."""
    return found.get(key) if isinstance(found, Mapping) else getattr(found, key, None)


def built_in_config() -> tuple[RunConfig, str]:
    """The default arm: configuration and its text."""
    with resources.as_file(resources.files("workflow") / "data" / "default_arm.toml") as path:
        return load_config(path)
