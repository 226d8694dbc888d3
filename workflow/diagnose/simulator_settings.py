"""Settings of a case of one's own simulation (docs/simulators.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, PositiveFloat, model_validator

from workflow.config.settings import Section, check
from workflow.diagnose.case_settings import CaseName, ColumnChoice

# Keys that name a model, one of them in each case; also which simulator runs it.
KINDS = ("mjcf", "fmu", "python")


class SimulatorSettings(Section):
    """A TOML file that names a model, or the options of the command line."""

    case: CaseName = None
    mjcf: str | None = Field(None, description="MuJoCo model of the machine")
    fmu: str | None = Field(None, description="FMU (FMI 2.0, co-simulation); runs its native code")
    python: str | None = Field(None, description="file with simulate, PARAMETERS, INPUTS and OUTPUTS")
    log: str | Annotated[tuple[str, ...], Field(min_length=1)] = Field(
        description="log files; the last one is for validation, of a single one its last third"
    )
    columns: dict[str, ColumnChoice] = Field({}, description="name in the model -> column, where they differ")
    beside: tuple[str, ...] = Field(
        (), description="columns the model does not use, a load or temperature, that the error may depend on"
    )
    dt_s: float | None = Field(None, gt=0, description="sampling period of logs without a time column")
    repair: bool = Field(False, description="put stamps that jitter, and missing rows, on a uniform grid")
    resample_s: float | None = Field(None, gt=0, description="put all rows on a grid of this step")
    noise: dict[str, PositiveFloat] = Field(
        {}, description="output -> standard deviation; default: estimated"
    )
    tolerances: dict[str, PositiveFloat] = Field({}, description="parameter -> relative standard deviation")
    candidates: tuple[str, ...] = Field(
        ("*",), description="what may be wrong or missing, * for any part of a name; all else is as stated"
    )
    exclude: tuple[str, ...] = Field((), description="what is as stated all the same")
    bounds: dict[str, tuple[PositiveFloat, PositiveFloat]] = Field(
        {}, description="effect -> smallest and largest size, in its unit"
    )
    model_error: float = Field(0.05, ge=0, lt=1, description="share of the motion that the model may miss")
    tracking_rad_s: float | None = Field(None, ge=0, description="MJCF: see docs/simulators.md; 0: free run")
    motion: Literal["position", "speed"] | None = Field(
        None,
        description="FMU and Python: kind of the first output, if it is the motion of the body that "
        "the first input pushes",
    )

    @model_validator(mode="after")
    def _one_model(self) -> SimulatorSettings:
        stated = [key for key in KINDS if getattr(self, key) is not None]
        if len(stated) != 1:
            raise ValueError(f"expected one of mjcf, fmu, python; got {' and '.join(stated) or 'none'}")
        return self

    @property
    def logs(self) -> tuple[str, ...]:
        """Log files in their order; the last one is for validation."""
        return (self.log,) if isinstance(self.log, str) else self.log

    @property
    def model(self) -> str:
        """File of the model, whatever its kind."""
        return str(self.mjcf or self.fmu or self.python)


def is_simulator(document: Mapping[str, Any]) -> bool:
    """Whether a TOML file names a simulator's model."""
    return any(key in document for key in KINDS)


def settings_of(document: Mapping[str, Any], source: str) -> SimulatorSettings:
    """A case file's content, checked. source: named in errors. Raises InputError."""
    return check(SimulatorSettings, dict(document), source=source)
