"""What a stage is: a name, what it comes after, its share of the configuration, and one function."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from ident.basis.options import LEFT_OPEN
from ident.data.record import Record
from workflow.config.joints_config import AnyConfig
from workflow.config.run_config import RunConfig
from workflow.engine.progress import Progress
from workflow.engine.randomness import stage_rng
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.results import RunResults


@dataclass(frozen=True)
class StageInput:
    """What a stage may look at. results: of those before it; called: the configuration, in a complaint; read:
    its logs, where they have been read."""

    config: RunConfig
    results: RunResults
    progress: Progress
    called: str = "the configuration"
    read: Sequence[Record] = ()

    @property
    def plant(self) -> UncertainPlant:
        """The plant that was identified, of several the one nearest to the model."""
        return self.plants[0]

    @property
    def plants(self) -> tuple[UncertainPlant, ...]:
        """The plants that were identified: several where one ellipse would hold too much."""
        return self.results.uncertainty.plants(self.config)

    @property
    def specification(self) -> Specification:
        """What was designed for: every requirement as far as it gave way."""
        return self.results.design.specification or self.config.specification

    def rng(self, *names: str) -> np.random.Generator:
        """The random stream of these names: the same whatever else ran before."""
        return stage_rng(self.config.run.seed, *names)


@dataclass(frozen=True)
class Stage:
    """One step of a run.

    `uses` and `except_for` name the part of the configuration the result depends on (pydantic's `include` and
    `exclude`), `after` the stages whose files it reads: with the seed and the input files these make the
    input hash. `expected_s` (two cores, warm) only shapes the progress bar. `also_writes` names files outside
    `stages/` that belong to the result. several: what it does for several joints, and how long that takes;
    None: there is no such step for them.
    """

    name: str
    after: tuple[str, ...]
    run: Callable[[StageInput], Any]
    expected_s: float
    uses: Mapping[str, Any]
    except_for: Mapping[str, Any] | None = None
    also_writes: Callable[[RunDirectory], tuple[Path, ...]] = lambda run: ()
    several: tuple[Callable[[StageInput], Any], float] | None = None

    def settings(self, config: AnyConfig) -> dict[str, Any]:
        """Its share of the configuration, JSON-able: every value, and which of `LEFT_OPEN` were stated.

        Two configurations with the same settings of a stage give it the same result: a key stated at its
        default is the same as one left out, but for those where the data decide unless it is stated.
        """
        part: dict[str, Any] = {"mode": "json", "include": self.uses, "exclude": self.except_for}
        values: dict[str, Any] = config.model_dump(**part)
        stated = sorted(_stated_of_left_open(config.model_dump(**part, exclude_unset=True)))
        return {**values, "stated": stated}


def _stated_of_left_open(document: Any, where: str = "") -> Iterator[str]:
    """Dotted keys in a nested document whose last name is one of `LEFT_OPEN`."""
    if isinstance(document, Mapping):
        for name, value in document.items():
            key = f"{where}.{name}".removeprefix(".")
            if name in LEFT_OPEN:
                yield key
            yield from _stated_of_left_open(value, key)
    elif isinstance(document, list):
        for index, value in enumerate(document):
            yield from _stated_of_left_open(value, f"{where}[{index}]")


def stages_for(config: AnyConfig, stages: Sequence[Stage]) -> tuple[Stage, ...]:
    """The stages of a run: those that there are for one loop, or for several joints."""
    if isinstance(config, RunConfig):
        return tuple(stages)
    there = {stage.name: stage.several for stage in stages if stage.several is not None}
    return tuple(
        replace(stage, run=run, expected_s=s, after=tuple(name for name in stage.after if name in there))
        for stage in stages
        for run, s in filter(None, [stage.several])
    )
