"""`JointsConfig`: a run for several joints at once, from one TOML file with a table [[joints]]."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, NonNegativeInt, model_validator

from control_design.specification import Specification
from control_design.specification.multivariable import MultivariableSpecification
from control_design.synthesis.synthesis_options import MultivariableOptions
from workflow.config.run_config import AnyConfig, FileSource, Name, Notes, Role
from workflow.config.settings import Section, repeated

Two = tuple[float, float]


class OperatingPoint(Section):
    """Where the arm rests while its joints are moved a little."""

    name: Name = Field(description="name of the plant")
    elbow_rad: float = Field(description="angle of link 2 against link 1")
    shoulder_rad: float = Field(0.0, description="angle of link 1; matters under gravity")
    payload_kg: float = Field(0.05, ge=0, description="point mass at the tip")

    # Of the record that is made there.
    kind: ClassVar[str] = "multisine"
    role: ClassVar[Role] = "estimation"
    remark: ClassVar[str] = ""

    @property
    def condition(self) -> str:
        return self.name


class TwoJointSource(Section):
    """Records of a simulated arm of two joints, in SI units: at every point a multisine at each motor.

    Notes
    -----
    Angles are measured with white noise of `noise_rad`, rad; the amplifier has no limit here. Values out of
    their bounds are refused when the file is read.
    """

    kind: Literal["two_joint_arm"] = Field(description="records come from the simulated arm of two joints")
    points: tuple[OperatingPoint, ...] = Field(min_length=1, description="operating points, one plant each")
    dt_s: float = Field(0.002, gt=0, description="sampling period")
    samples: int = Field(8000, ge=500, description="length of a record")
    rms_V: Two = Field(
        (0.2, 0.2), description="size of the multisine at each motor; the response is that of small motions"
    )
    band_Hz: Two = Field((0.1, 60.0), description="band of the multisines")
    noise_rad: float = Field(2e-5, ge=0, description="standard deviation of the angle sensors")
    coulomb_Nm: Two = Field((0.0, 0.0), description="dry friction of each joint while records are made")
    gravity_m_s2: float = Field(0.0, ge=0, description="0: the arm moves in a horizontal plane")

    input_limit: ClassVar[float | None] = None

    @property
    def records(self) -> tuple[OperatingPoint, ...]:
        """One at each operating point."""
        return self.points


Source = Annotated[TwoJointSource | FileSource, Field(discriminator="kind")]


class Joint(Specification):
    """One actuator and one sensor, with what is asked of them: keys of [specification]."""

    input: str = Field(min_length=1, description="column of the command")
    output: str = Field(min_length=1, description="column of the measured angle")

    def specification(self) -> Specification:
        """What is asked of the joint, without its columns.

        Only the keys that were stated: some are refused where they are stated
        (`MultivariableSpecification`), even at their defaults.
        """
        return Specification(**self.model_dump(exclude={"input", "output"}, exclude_unset=True))


class JointsIdentification(Section):
    """Model of each operating point, on shared poles."""

    integrators: int = Field(1, ge=0, le=1, description="1: joints that turn freely")
    input_delay_samples: NonNegativeInt | tuple[NonNegativeInt, ...] = Field(
        0, description="dead time, of all inputs or one for each"
    )
    n_real: int | None = Field(None, ge=0, description="real poles; default: the data decide")
    n_pairs: int | None = Field(None, ge=0, description="pole pairs; default: the data decide")
    increments: bool = Field(
        True, description="fit differences between samples: same response, less weight on drift"
    )
    level: float = Field(0.95, gt=0, lt=1, description="probability of the balls, at a frequency")
    lowest_rad_s: float = Field(0.3, gt=0, description="from where on the balls are taken over")
    gain_error: float = Field(
        0.0, ge=0, lt=1, description="share by which each actuator's gain may be off beyond the balls"
    )


class JointsSearch(MultivariableOptions):
    """Effort of the search in a run for several joints."""

    # A worst case just below 1 is certified; the last percents below it cost most of the time.
    sufficient_gamma: float = Field(
        0.97, ge=0, description=MultivariableOptions.model_fields["sufficient_gamma"].description
    )


class JointsDesign(Section):
    """One controller for all joints: its states and structure, and how hard it is searched for.

    Notes
    -----
    `controller_damping` is a damping ratio, without unit; real poles have none to keep.
    """

    controller_order: int = Field(6, ge=0, le=40, description="number of controller states")
    structure: Literal["full", "decentralised"] = Field("full", description="decentralised: K is diagonal")
    controller_damping: float = Field(0.02, gt=0, le=1, description="smallest of the controller's pole pairs")
    search: JointsSearch = Field(
        default_factory=JointsSearch,
        description="effort of the search, which ends at a worst case of 0.97",
    )


class JointsLoop(Section):
    """The loop on the nonlinear machine, or on the identified models where records are logs."""

    step: tuple[float, ...] | None = Field(
        None, description="reference step of each joint, in units of its output; default: 0.1 each"
    )
    duration_s: float | None = Field(
        None, gt=0, description="length of a run; default: 20 over the bandwidth"
    )
    extra_payload_kg: tuple[float, ...] = Field((), description="further payloads at every operating point")
    coulomb_Nm: Two | None = Field(None, description="dry friction of each joint in further runs")


class JointsConfig(AnyConfig):
    """A whole run for several joints. Load with `workflow.kinds.load_any`."""

    source: Source
    joints: tuple[Joint, ...] = Field(min_length=1)
    identification: JointsIdentification = Field(
        default_factory=lambda: JointsIdentification.model_validate({})
    )
    design: JointsDesign = Field(default_factory=lambda: JointsDesign.model_validate({}))
    closed_loop: JointsLoop = Field(default_factory=lambda: JointsLoop.model_validate({}))
    notes: Notes = Field(default_factory=Notes)

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        for kind in ("input", "output"):
            name = repeated([getattr(joint, kind) for joint in self.joints])
            if name is not None:
                raise ValueError(f"two joints have the {kind} {name!r}: each needs its own")
        ambiguous = {joint.input for joint in self.joints} & {joint.output for joint in self.joints}
        if ambiguous:
            raise ValueError(f"{min(ambiguous)!r} is an input and an output: give each signal its own column")
        for number, joint in enumerate(self.joints):
            if joint.input_limit is None:
                raise ValueError(
                    f"joints[{number}] has no input_limit: state what its actuator gives at most, in the "
                    "unit of its input"
                )
        if isinstance(self.source, TwoJointSource):
            if len(self.joints) != 2:
                raise ValueError(f"the simulated arm has two joints; got {len(self.joints)}")
            name = repeated([point.name for point in self.source.points])
            if name is not None:
                raise ValueError(f"two operating points are called {name!r}: give them different names")
        else:
            if self.closed_loop.extra_payload_kg or self.closed_loop.coulomb_Nm is not None:
                raise ValueError(
                    "closed_loop.extra_payload_kg and closed_loop.coulomb_Nm act on the simulated arm only: "
                    "where records are logs, the loop runs on the identified models"
                )
            records = self.source.records
            fitted = {record.condition for record in records if record.role == "estimation"}
            for number, record in enumerate(records):
                if record.role == "repeat":
                    raise ValueError(
                        f"source.records[{number}] has role 'repeat': with several joints a record is fitted "
                        "or kept back with role = 'validation'"
                    )
                if record.condition not in fitted:
                    raise ValueError(
                        f"source.records[{number}] is kept back, but no record with condition "
                        f"{record.condition!r} is fitted: give one of that condition role = 'estimation'"
                    )
        if len(self.dead_times) != len(self.joints):
            raise ValueError(
                "identification.input_delay_samples needs one value, or one for each of "
                f"{len(self.joints)} joints"
            )
        if self.closed_loop.step is not None and len(self.closed_loop.step) != len(self.joints):
            raise ValueError(f"closed_loop.step needs one value for each of {len(self.joints)} joints")
        if self.closed_loop.step is not None and not any(self.closed_loop.step):
            raise ValueError("closed_loop.step is zero for every joint: give at least one a step")
        # Made to refuse keys that no design of several joints reads.
        self.specification()
        return self

    def specification(self) -> MultivariableSpecification:
        """What is asked of the whole."""
        return MultivariableSpecification(
            joints=tuple(joint.specification() for joint in self.joints),
            structure=self.design.structure,
            controller_order=self.design.controller_order,
            controller_damping=self.design.controller_damping,
        )

    @property
    def dead_times(self) -> tuple[int, ...]:
        """Delay of each input, in samples."""
        stated = self.identification.input_delay_samples
        return (stated,) * len(self.joints) if isinstance(stated, int) else stated

    @property
    def columns(self) -> tuple[Joint, ...]:
        """Inputs and outputs that records have."""
        return self.joints

    @property
    def loops(self) -> tuple[Joint, ...]:
        """What the controller drives and is fed."""
        return self.joints
