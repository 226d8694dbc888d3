"""How log files are read, for configurations and options alike."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from ident.data.units import stated_time_unit
from workflow.config.settings import Section


def _not_zero(scale: float) -> float:
    if scale == 0:
        raise ValueError("a scale must not be 0")
    return scale


Scale = Annotated[float, AfterValidator(_not_zero)]
TimeUnit = Annotated[str, AfterValidator(stated_time_unit)]


class LogReading(Section):
    """What may be said of every log of a set."""

    time: str | None = Field(None, description="name of the time column; give this or dt_s")
    time_unit: TimeUnit | None = Field(
        None,
        description="unit of the time column: s, ms, us, ns, min, h or d; default: as in its name ('t_ms', "
        "'Zeit [ms]'), else s",
    )
    dt_s: float | None = Field(None, gt=0, description="sampling period [s]; give this or time")
    units: Mapping[str, str] = Field(
        default_factory=dict, description="unit of a column, for axes: {theta_rad = 'rad'}"
    )
    input_limit: float | None = Field(
        None,
        gt=0,
        description="limit of the amplifier: larger commands in the logs are clipped to it",
    )
    controller_period_s: float | None = Field(
        None,
        gt=0,
        description="period of the controller that made the logs [s], where its command was held for another "
        "time than from row to row: 0.001 of a drive at 1 kHz that logs every second sample; default: as the "
        "logs tell",
    )
    command_averaged: bool = Field(
        False, description="the drive logs the mean of its commands since the row before, not the last one"
    )
    scale: Mapping[str, Scale] = Field(
        default_factory=dict, description="factor per column: quantity = scale * column + offset"
    )
    offset: Mapping[str, float] = Field(
        default_factory=dict, description="offset per column, added after scaling"
    )
    repair: bool = Field(
        False, description="put jittering time stamps and single missing rows on a uniform grid"
    )
    resample_s: float | None = Field(
        None,
        gt=0,
        description="put all rows on a coarser grid of this step [s], for stamps that keep to none",
    )
    unwrap: Mapping[str, Annotated[float, Field(gt=0)]] = Field(
        default_factory=dict,
        description="of a column that wraps, the period: {encoder = 4096}, {angle_deg = 360}; before scale",
    )
    decimal: Literal["point", "comma"] | None = Field(
        None, description="what separates decimals in text; default: as the numbers say"
    )
