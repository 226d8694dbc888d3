"""`StudyConfig`: base and axes of a study, from one TOML file; and its dotted keys
(`closed_loop.effects[0].mass_kg`)."""

from __future__ import annotations

import copy
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from workflow.config.settings import Section, check, expand, repeated
from workflow.engine.documents import read_toml
from workflow.engine.errors import InputError
from workflow.study.columns import COLUMNS

# Points of a study: a day and a half at 12 s a point.
MOST_POINTS = 10_000
# Digits of a number in a range: enough for any tuning, and short in names and tables.
_DIGITS = 6


def _judged(name: str) -> str:
    column = COLUMNS.get(name)
    if column is None or column.better is None:
        known = ", ".join(key for key, item in COLUMNS.items() if item.better is not None)
        raise ValueError(f"no column {name!r} to compare by; known: {known}")
    return name


DottedKey = Annotated[str, AfterValidator(lambda text: parse_key(text) and text)]
Judged = Annotated[str, AfterValidator(_judged)]


class StudyAxis(Section):
    """One key and the values it takes."""

    key: DottedKey = Field(
        description="dotted key of the run's configuration, e.g. specification.bandwidth_rad_s"
    )
    label: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_.]*$", max_length=24)] | None = Field(
        None, description="short name in the table and in the names of points; default: last name of the key"
    )
    values: tuple[Any, ...] | None = Field(None, description="list of values")
    from_: int | float | None = Field(None, alias="from", description="lower end of a range")
    to: int | float | None = Field(None, description="upper end of a range")
    points: int | None = Field(None, ge=2, le=1000, description="points of the range in a grid")
    log: bool = Field(False, description="logarithmic spacing of the range")

    @model_validator(mode="after")
    def _list_or_range(self) -> Self:
        ranged = self.from_ is not None or self.to is not None
        if (self.values is not None) == ranged:
            raise ValueError("give values, or from and to")
        if self.values is not None:
            if not self.values:
                raise ValueError("values is empty: give one or more")
            if self.points is not None or self.log:
                raise ValueError("points and log go with from and to")
            twice = repeated([repr(value) for value in self.values])
            if twice is not None:
                raise ValueError(f"the value {twice} is listed twice")
        elif self.from_ is None or self.to is None:
            raise ValueError("a range needs from and to")
        elif not self.from_ < self.to:
            raise ValueError(f"a range needs from below to; got {self.from_} and {self.to}")
        elif self.log and not self.from_ > 0:
            raise ValueError(f"a range in equal ratios starts above 0; got {self.from_}")
        return self

    @property
    def name(self) -> str:
        return self.label or last_name(self.key)

    @property
    def whole(self) -> bool:
        """A range of whole numbers: both ends are written as such."""
        return isinstance(self.from_, int) and isinstance(self.to, int)

    def grid(self) -> tuple[Any, ...]:
        """The values of the axis; of a range its `points` (whole numbers: all between, without `points`)."""
        if self.values is not None:
            return self.values
        assert self.from_ is not None
        assert self.to is not None
        if self.points is None:
            return tuple(range(int(self.from_), int(self.to) + 1))
        spread = np.geomspace if self.log else np.linspace
        numbers = [tidy(float(value)) for value in spread(self.from_, self.to, self.points)]
        if not self.whole:
            return tuple(numbers)
        # Neighbours may round to one whole number.
        return tuple(dict.fromkeys(round(number) for number in numbers))


def tidy(value: float) -> float:
    """The number to six digits."""
    return float(f"{value:.{_DIGITS}g}")


class ParetoPlot(Section):
    """Two columns of the table, plotted against each other."""

    x: Judged = Field(description="column of the table, across")
    y: Judged = Field(description="column of the table, up")

    @model_validator(mode="after")
    def _two_columns(self) -> Self:
        if self.x == self.y:
            raise ValueError(f"x and y are the same column, {self.x!r}")
        return self


# Pictures of a study of one loop, where none are stated.
_DEFAULT_PLOTS = (
    ParetoPlot(x="bandwidth_rad_s", y="modulus_margin"),
    ParetoPlot(x="peak_command", y="rise_time_s"),
)
# Of several joints: commands and bandwidths are one per joint.
JOINTS_PLOTS = (
    ParetoPlot(x="worst_gamma", y="disk_margin"),
    ParetoPlot(x="disk_margin", y="overshoot_percent"),
)


class StudySection(Section):
    """Headline, base and seed of a study.

    Notes
    -----
    The base is the built-in arm where none is stated. A seed here holds for every point; an axis over
    run.seed contradicts it and is refused.
    """

    title: Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]*$", max_length=120)] = Field(
        "", description="headline of the page; default: that of the base"
    )
    base: str | None = Field(
        None,
        min_length=1,
        description="run configuration (TOML) or run directory, relative to this file; default: built-in arm",
    )
    seed: int | None = Field(
        None, ge=0, description="seed of every random stream of every point; default: that of the base"
    )


class StudyConfig(Section):
    """A whole study. Load with `load_study`."""

    study: StudySection = Field(default_factory=StudySection)
    changes: Mapping[DottedKey, Any] = Field(
        default_factory=dict, description="dotted keys of the base with other values for every point"
    )
    axes: tuple[StudyAxis, ...] = Field(min_length=1, max_length=12)
    pareto: tuple[ParetoPlot, ...] = Field(_DEFAULT_PLOTS, min_length=1, max_length=4)

    @model_validator(mode="after")
    def _axes_differ(self) -> Self:
        for kind, names in (
            ("keys", [axis.key for axis in self.axes]),
            ("labels", [axis.name for axis in self.axes]),
        ):
            name = repeated(names)
            if name is not None:
                raise ValueError(f"two axes have the same {kind[:-1]} {name!r}: give different {kind}")
        if self.study.seed is not None and any(axis.key == "run.seed" for axis in self.axes):
            raise ValueError("study.seed and an axis over run.seed contradict each other")
        for index, axis in enumerate(self.axes):
            if axis.values is None and axis.points is None and not axis.whole:
                raise ValueError(f"axes[{index}] ({axis.key}): a grid over a range needs points")
        count = math.prod(len(axis.grid()) for axis in self.axes)
        if count > MOST_POINTS:
            raise ValueError(f"the grid has {count} points, more than {MOST_POINTS}")
        return self


@dataclass(frozen=True)
class StudyFile:
    """A study as read; base: a file or a directory, None for the built-in arm."""

    path: Path
    config: StudyConfig
    text: str
    base: Path | None


def load_study(path: Path) -> StudyFile:
    """The study of a file. Raises InputError: one line naming file, key and what was expected."""
    text, document = read_toml(path)
    if "study" not in document and "specification" in document:
        raise InputError(
            f'{path}: a configuration of a run; name it in a study file: [study] base = "{path}"'
        )
    config = check(StudyConfig, document, source=str(path))
    if config.study.base is None:
        return StudyFile(path, config, text, None)
    try:
        base = Path(os.path.normpath(path.absolute().parent / expand(config.study.base)))
    except ValueError as error:
        raise InputError(f"{path}: study.base: {error}") from error
    if not base.exists():
        raise InputError(f"{path}: study.base: no such file or run directory: {base}")
    return StudyFile(path, config, text, base)


# A part of a dotted key, with its places in lists.
_NAME = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)((?:\[\d+\])*)")


def parse_key(key: str) -> tuple[str | int, ...]:
    """Names and list indices of a dotted key. Raises ValueError saying how one is written."""
    parts: list[str | int] = []
    for piece in key.split("."):
        match = _NAME.fullmatch(piece)
        if match is None:
            raise ValueError(
                f"not a dotted key: {key!r}; expected for example 'specification.bandwidth_rad_s' or "
                "'closed_loop.effects[0].mass_kg'"
            )
        parts.append(match.group(1))
        parts += [int(index) for index in re.findall(r"\d+", match.group(2))]
    return tuple(parts)


def last_name(key: str) -> str:
    """The last name in a dotted key, without an index."""
    return next(part for part in reversed(parse_key(key)) if isinstance(part, str))


def with_values(
    document: Mapping[str, Any], values: Mapping[str, Any], defaults: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """A copy of a document with dotted keys set.

    Parameters
    ----------
    document
        What a configuration states, nested.
    values
        New values by dotted key.
    defaults
        The same configuration with every default filled in. A list that the document does not state begins
        as it is there, so that one of its entries can be set.

    Returns
    -------
    dict
        The changed copy. A table that is absent is made, with nothing in it but the keys that are set;
        whether these are known is for the configuration's own check to say.

    Raises
    ------
    ValueError
        A key goes through something that is no table, or an index is beyond the list.
    """
    changed = copy.deepcopy(dict(document))
    for key, value in values.items():
        path = parse_key(key)
        here: Any = changed
        default: Any = defaults
        where = ""
        for position, part in enumerate(path):
            if isinstance(part, int):
                if not isinstance(here, list):
                    raise ValueError(f"{key}: {where} is no list")
                if part >= len(here):
                    raise ValueError(f"{key}: {where} has {len(here)} entries, counted from 0")
                # A list that is stated, or was copied whole, has no default.
                default = None
                where = f"{where}[{part}]"
            else:
                if not isinstance(here, dict):
                    raise ValueError(f"{key}: {where} is no table")
                default = default.get(part) if isinstance(default, Mapping) else None
                if here.get(part) is None:
                    here[part] = copy.deepcopy(default) if isinstance(default, list) else {}
                where = f"{where}.{part}".removeprefix(".")
            if position == len(path) - 1:
                here[part] = copy.deepcopy(value)
            here = here[part]
    return changed
