"""The keys of a case file (docs/case_files.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, Field

from ident.data.arrays import RealArray
from ident.data.settings import meant
from ident.data.wrapping import unwrapped
from plant.effects import EFFECTS
from plant.rig import Output
from workflow.config.settings import Section, check, repeated
from workflow.engine.documents import read_toml
from workflow.engine.errors import InputError

# The case file in a case folder.
CASE_FILE = "case.toml"
# The rig file beside it, unless the case file names another one.
RIG_FILE = "rig.toml"


class Column(Section):
    """Where a quantity stands in a log: quantity = scale * column + offset, of a column that goes on where it
    wraps."""

    column: str = Field(min_length=1, description="name of the column")
    scale: float | None = Field(
        None,
        description="unit of the quantity per unit of the column, not 0; default: by the unit in the "
        "header, else 1",
    )
    offset: float = Field(0.0, description="added after scaling, in the unit of the quantity")

    unwrap: float | None = Field(
        None, gt=0, allow_inf_nan=False, description="period of a column that wraps: 4096 counts, 360 degrees"
    )

    def quantity(self, values: RealArray, usual: float = 1.0) -> RealArray:
        """(T,) the quantity of a column's values (T,); usual: the scale where none is stated."""
        if self.unwrap is not None:
            values = unwrapped(values, self.unwrap)[0]
        scale = usual if self.scale is None else self.scale
        return values * scale + self.offset


def _moves(column: Column) -> Column:
    """A column that says something of its quantity; a scale of 0 makes it a constant."""
    if column.scale == 0:
        raise ValueError("scale must not be 0")
    return column


# A column with scale and offset, or its name alone.
ColumnChoice = Annotated[
    Column, BeforeValidator(lambda v: {"column": v} if isinstance(v, str) else v), AfterValidator(_moves)
]


class Columns(Section):
    """Which column holds which quantity; what is left out keeps its default."""

    time_s: ColumnChoice | None = Field(None, description="time stamp: when the outputs were sampled")
    voltage_V: ColumnChoice | None = Field(None, description="commanded voltage")
    hub_angle_rad: ColumnChoice | None = Field(None, description="hub angle")
    tip_m: ColumnChoice | None = Field(None, description="tip position, arc plus deflection")
    tip_acceleration_m_s2: ColumnChoice | None = Field(None, description="across the link, at the tip")
    hub_speed_rad_s: ColumnChoice | None = Field(None, description="speed of the hub")
    tip_deflection_m: ColumnChoice | None = Field(
        None, description="of the tip from the straight link: strain gauge or camera; scale is its length"
    )
    reference_rad: ColumnChoice | None = Field(None, description="controller's reference, where there is one")


class ExperimentEntry(Section):
    """One log."""

    file: str = Field(min_length=1, description="log file, relative to the case file")
    role: Literal["estimation", "held_out"]
    kind: str = ""
    samples: int | None = Field(None, ge=1, description="rows the file must have")
    closed_loop: bool = False
    description: str = ""
    columns: Columns = Field(default_factory=Columns)

    def column(self, quantity: str, of_all: Columns) -> Column:
        """Where a quantity stands in this log: as said for it, for all logs, or under its own name."""
        stated: Column | None = getattr(self.columns, quantity) or getattr(of_all, quantity)
        return stated or Column(column=quantity)


def _known_effect(name: str) -> str:
    if name not in EFFECTS:
        raise ValueError(f"no such effect {name!r} ({meant(name, tuple(EFFECTS), 'effects')})")
    return name


def _hub_first(names: tuple[Output, ...]) -> tuple[Output, ...]:
    """Outputs in the order in which a rig has them, the hub angle first."""
    if "hub_angle_rad" not in names or repeated(names) is not None:
        raise ValueError(f"expected hub_angle_rad and others, each once; got {', '.join(names) or 'none'}")
    return tuple(name for name in get_args(Output) if name in names)


# It becomes the name of files: no path, and nothing that a shell reads otherwise.
CaseName = Annotated[
    Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=80)] | None,
    Field(description="names the output files; letters, digits, '_', '-' and '.'"),
]


class CaseSettings(Section):
    """A case file."""

    case: CaseName = None
    rig: str = Field(RIG_FILE, min_length=1, description="rig file, relative to the case file")
    dt_s: float | None = Field(None, gt=0, description="sampling period of logs without a time column [s]")
    outputs: Annotated[tuple[Output, ...], AfterValidator(_hub_first)] = ("hub_angle_rad", "tip_m")
    model_error: float = Field(
        0.0, ge=0, lt=1, description="share of the motion's RMS that a good model may miss; 0: none"
    )
    suspected: tuple[Annotated[str, AfterValidator(_known_effect)], ...] = ()
    columns: Columns = Field(default_factory=Columns)
    experiments: tuple[ExperimentEntry, ...] = Field(min_length=1)


def case_document(place: Path) -> tuple[Path, dict[str, Any]]:
    """The case file of a folder, or the one named itself, and what it says. Raises InputError."""
    file = place if place.is_file() else place / CASE_FILE
    if not file.is_file():
        toml_files = sorted(place.glob("*.toml")) if place.is_dir() else []
        instead = f"; is it {toml_files[0]}?" if len(toml_files) == 1 else ""
        raise InputError(
            f"{place}: no case is there; expected a folder with {CASE_FILE}, or a TOML file like it{instead}"
        )
    return file, read_toml(file)[1]


def read_case_file(place: Path) -> tuple[Path, CaseSettings]:
    """`case_document`, checked. Raises InputError."""
    file, document = case_document(place)
    return file, check(CaseSettings, document, source=str(file))
