"""What a stage is: a name, what it comes after, its share of the configuration, and one function."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from workflow.config.run_config import RunConfig
from workflow.engine.progress import Progress
from workflow.engine.randomness import stage_rng
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.results import RunResults


@dataclass(frozen=True)
class StageInput:
    """What a stage may look at. `earlier` is None for the first stage only, which reads no earlier result."""

    config: RunConfig
    earlier: RunResults | None
    progress: Progress

    @property
    def results(self) -> RunResults:
        """What the stages before it found."""
        if self.earlier is None:
            raise RuntimeError("the first stage has no earlier results")
        return self.earlier

    def rng(self, *names: str) -> np.random.Generator:
        """The random stream of these names: the same whatever else ran before."""
        return stage_rng(self.config.run.seed, *names)

    def part_of_progress(self, name: str, index: int, count: int, label: str) -> Callable[[float, str], None]:
        """A library's progress callback for part `index` of `count` equal parts of stage `name`."""

        def report(fraction: float, message: str) -> None:
            self.progress.update(name, (index + fraction) / count, f"{label}: {message}")

        return report


def _nothing(run: RunDirectory) -> tuple[Path, ...]:
    return ()


@dataclass(frozen=True)
class Stage:
    """One step of a run.

    `settings` gives the JSON-able part of the configuration the result depends on, `after` the stages whose
    files it reads: with the seed and the input files these make the input hash. `expected_s` (two cores,
    warm) only shapes the progress bar. `also_writes` names files outside `stages/` that belong to the result.
    """

    name: str
    after: tuple[str, ...]
    settings: Callable[[RunConfig], Mapping[str, Any]]
    run: Callable[[StageInput], Any]
    expected_s: float
    also_writes: Callable[[RunDirectory], tuple[Path, ...]] = _nothing
