"""From base and axes to points: a name, a checked configuration, and what it shares with other points."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from control_design.specification import GIVES_WAY
from workflow.config.run_config import AnyConfig, built_in_config
from workflow.config.settings import check
from workflow.engine import storage
from workflow.engine.errors import InputError
from workflow.engine.run_directory import RunDirectory, hash_of
from workflow.kinds import config_of_any, kind_of, load_any
from workflow.study.columns import COLUMNS, Number
from workflow.study.settings import StudyAxis, StudyConfig, last_name, with_values

State = Literal[
    "certified",
    "certified at a lower bandwidth",
    "does not settle",
    "keeps moving",
    "not certified",
    "impossible",
    "failed",
]


@dataclass(frozen=True, eq=False)
class Base:
    """What every point starts from.

    Attributes
    ----------
    config : AnyConfig
    inputs : mapping of str to str
        Its input files with their SHA-256.
    run : RunDirectory or None
        The run whose plant is used, where one was given.
    folder : Path
        What paths in changed values are relative to.
    left_out : mapping of str to float
        Limits up to which requirements of the configuration gave way, where an axis sets these.
    """

    config: AnyConfig
    inputs: Mapping[str, str]
    run: RunDirectory | None
    folder: Path
    left_out: Mapping[str, float] = field(default_factory=dict)

    def changed(self, values: Mapping[str, Any], source: str) -> AnyConfig:
        """The configuration with dotted keys set. Raises InputError naming `source` where they do not fit."""
        try:
            document = self.with_values(values)
        except ValueError as error:
            raise InputError(f"{source}: {error}") from error
        return check(type(self.config), document, source=source, context=self.context)

    def with_values(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """What the configuration states with dotted keys set, not checked. Raises ValueError for a key that
        leads nowhere."""
        return with_values(self.document, values, self.config.with_defaults())

    @cached_property
    def document(self) -> dict[str, Any]:
        """What the configuration states."""
        return self.config.to_document()

    @property
    def context(self) -> dict[str, Any]:
        """What paths in changed values are relative to; logs behind a run that is there may be gone."""
        return {"base": self.folder, "may_be_gone": self.run is not None}

    def inputs_of(self, config: AnyConfig) -> Mapping[str, str]:
        """SHA-256 of the input files, those of the run where one was given."""
        if self.run is not None:
            return self.inputs
        return {str(path): storage.sha256_of_file(path) for path in config.input_files}

    @property
    def digests(self) -> dict[str, str]:
        """SHA-256 of the stage files taken from a given run."""
        if self.run is None:
            return {}
        return {stage.name: self.run.stage_digest(stage.name) for stage in kind_of(self.config).plant_stages}


@dataclass(frozen=True, eq=False)
class Combination:
    """One value per axis."""

    number: int
    name: str
    values: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class PointRow(Combination):
    """A point in the table. `numbers` has every column, None where there is no number."""

    state: State
    why: str
    numbers: Mapping[str, Number] = field(default_factory=lambda: dict.fromkeys(COLUMNS))

    @property
    def good(self) -> bool:
        """Certified, and every run in closed loop stops at its reference."""
        return self.state == "certified" or self.lowered

    @property
    def lowered(self) -> bool:
        """Certified for a lower bandwidth than specified."""
        return self.state == "certified at a lower bandwidth"


@dataclass(frozen=True, eq=False)
class Point(Combination):
    """A combination that can be computed.

    Points of equal `plant_key` share records, model and ellipses; of equal `design_key` the controller as
    well. given: stages taken over from the base where that is a run.
    """

    config: AnyConfig
    inputs: Mapping[str, str]
    plant_key: str
    design_key: str
    given: tuple[str, ...]


def load_base(study: StudyConfig, study_path: Path, base: Path | None) -> Base:
    """What the study starts from, with its `changes` and seed applied.

    base: None, the built-in configuration; a file, that one; a directory, the configuration of a run whose
    records, model and ellipses the points take over. study_path: file that paths in the changes are relative
    to. Raises InputError: a file that cannot be read, changes that contradict the rest, or a run without
    one of those stages.
    """
    run: RunDirectory | None = None
    config: AnyConfig
    if base is None:
        config, _ = built_in_config()
    elif base.is_dir():
        run = RunDirectory.open(base)
        config = config_of_any(run)
        for stage in kind_of(config).plant_stages:
            # Raises where a stage is missing, and names it.
            run.stage_digest(stage.name)
    else:
        config, _ = load_any(base)

    # Changes of the study, with the limits that an axis makes void.
    values: dict[str, Any] = dict(study.changes)
    left_out: dict[str, float] = {}
    axes = {axis.key for axis in study.axes}
    # An axis asks for each of its values: giving way from it would answer another question.
    for key, limit in GIVES_WAY.items():
        if f"specification.{key}" not in axes or f"specification.{limit}" in axes | set(values):
            continue
        value = getattr(getattr(config, "specification", None), limit, None)
        if value is not None:
            left_out[limit] = value
            values[f"specification.{limit}"] = None
    if study.study.seed is not None:
        values["run.seed"] = study.study.seed
    inputs = {} if run is None else run.manifest()["inputs"]
    start = Base(config, inputs, run, study_path.absolute().parent, left_out)
    changed = start.changed(values, f"{study_path}: changes")
    return replace(start, config=changed, inputs=start.inputs_of(changed))


class PointMaker:
    """Makes the points of a study, numbered in the order they are asked for."""

    def __init__(self, study: StudyConfig, study_path: Path, base: Base) -> None:
        self._axes = study.axes
        self._path = study_path
        self._base = base
        self._original = None if base.run is None else config_of_any(base.run)
        self._digests = base.digests
        self._made = 0
        for index, axis in enumerate(self._axes):
            self._refuse_bad_values(index, axis)

    def make(self, values: Mapping[str, Any]) -> Point | PointRow:
        """The point of these values, one per axis. That they contradict one another is a result too."""
        self._made += 1
        # Values that contradict one another are a row of the table, not an error.
        try:
            config = self._base.changed(values, "the configuration contradicts itself")
        except InputError as error:
            name = self._name(values, hash_of({"base": self._base.document, "values": values}))
            return PointRow(self._made, name, dict(values), "impossible", str(error))
        inputs = self._base.inputs_of(config)
        given = () if self._original is None else shared_stages(config, self._original)

        # Keys by what results depend on: points of equal keys share them.
        plant = kind_of(config).plant_stages
        given_digests = {name: self._digests[name] for name in given}
        settings = {stage.name: stage.settings(config) for stage in plant}
        # A plant that is taken over whole draws nothing.
        seed = None if len(given) == len(plant) else config.run.seed
        plant_key = hash_of(
            {"given": given_digests, "seed": seed, "files": dict(inputs), "settings": settings}
        )
        design = kind_of(config).controller_stages[0].settings(config)
        design_key = hash_of({"plant": plant_key, "seed": config.run.seed, "settings": design})
        name = self._name(values, hash_of({"plant": plant_key, "config": config.to_document()}))
        return Point(self._made, name, dict(values), config, inputs, plant_key, design_key, given)

    def grid(self) -> list[Point | PointRow]:
        """Every combination, the last axis fastest."""
        keys = [axis.key for axis in self._axes]
        combinations = itertools.product(*(axis.grid() for axis in self._axes))
        return [self.make(dict(zip(keys, values, strict=True))) for values in combinations]

    def base_point(self) -> Point:
        """The base itself, whose plant the others begin with; it is no point of the study."""
        self._made -= 1
        point = self.make({})
        # The base was checked when it was loaded.
        assert isinstance(point, Point)
        return point

    def _name(self, values: Mapping[str, Any], digest: str) -> str:
        labels = {axis.key: axis.name for axis in self._axes}
        words = [f"{labels[key]}-{short(value)}" for key, value in values.items()]
        # File systems allow 255 bytes a name; the digest tells points apart whose words are cut.
        readable = re.sub(r"[^A-Za-z0-9_.-]+", "_", "_".join(words))[:90]
        return f"{readable or 'base'}_{digest[:10]}"

    def _refuse_bad_values(self, index: int, axis: StudyAxis) -> None:
        """A value no combination can make right is an error of the study, named with file and key."""
        ends: dict[str, Any] = {"from": axis.from_, "to": axis.to}
        if axis.values is not None:
            ends = {f"values[{place}]": value for place, value in enumerate(axis.values)}
        for where, value in ends.items():
            try:
                document = self._base.with_values({axis.key: value})
                type(self._base.config).model_validate(document, context=self._base.context)
            except ValidationError as error:
                # Only what sections say about values that are each right by themselves.
                about_sections = [
                    detail["type"] == "value_error" and last_name(axis.key) not in detail["loc"]
                    for detail in error.errors()
                ]
                if all(about_sections):
                    continue
            except ValueError:
                pass
            self._base.changed({axis.key: value}, f"{self._path}: axes[{index}].{where}")


def shared_stages(config: AnyConfig, other: AnyConfig) -> tuple[str, ...]:
    """Names of the plant's stages before the first whose settings differ between two configurations."""
    shared = []
    for stage in kind_of(config).plant_stages:
        if hash_of(stage.settings(config)) != hash_of(stage.settings(other)):
            break
        shared.append(stage.name)
    return tuple(shared)


def short(value: Any) -> str:
    """A value as it stands in names and tables."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(short(item) for item in value) + "]"
    if isinstance(value, Mapping):
        entries = [f"{key} = {short(item)}" for key, item in value.items()]
        return "{" + ", ".join(entries) + "}"
    return str(value)
