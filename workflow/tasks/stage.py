"""What a stage is: a name, what it comes after, its share of the configuration, and one function."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from ident.basis.options import LEFT_OPEN
from ident.data.record import Record
from workflow.config.run_config import AnyConfig, RunConfig
from workflow.engine.progress import Progress
from workflow.engine.randomness import stage_rng
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.results import AnyResults, RunResults


@dataclass(frozen=True)
class StageInput:
    """What a stage may look at.

    Attributes
    ----------
    config : RunConfig
    results : RunResults
        Of the stages before it.
    progress : Progress
    called : str
        What a complaint calls the configuration.
    read : sequence of Record
        Its logs, where they have been read already.
    """

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

    With the seed and the input files, `after`, `uses` and `except_for` make the input hash.

    Attributes
    ----------
    name : str
    after : tuple of str
        Stages whose files it reads.
    run : callable
        Returns its result.
    expected_s : float
        How long it takes on two warm cores; only shapes the progress bar.
    uses, except_for : mapping
        The part of the configuration that the result depends on, as pydantic's `include` and `exclude`.
    also_writes : callable
        Files of a run outside `stages/` that belong to the result.
    """

    name: str
    after: tuple[str, ...]
    run: Callable[[StageInput], Any]
    expected_s: float
    uses: Mapping[str, Any]
    except_for: Mapping[str, Any] | None = None
    also_writes: Callable[[RunDirectory], tuple[Path, ...]] = lambda run: ()

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


# Stages up to the uncertain plant, by name, which several designs may share; a run for several joints has no
# step of its own for the ellipses.
PLANT = ("records", "identify", "uncertainty")


@dataclass(frozen=True, eq=False)
class RunKind:
    """One kind of run: of one loop, or of several joints.

    Attributes
    ----------
    stages : tuple of Stage
        Before the page, in order.
    results : type
        Reads what they leave.
    """

    stages: tuple[Stage, ...]
    results: type[AnyResults]

    @property
    def plant_stages(self) -> tuple[Stage, ...]:
        """Stages up to the uncertain plant."""
        return tuple(stage for stage in self.stages if stage.name in PLANT)

    @property
    def controller_stages(self) -> tuple[Stage, ...]:
        """Stages from the design to the closed loop."""
        return tuple(stage for stage in self.stages if stage.name not in PLANT)
