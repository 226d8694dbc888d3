"""What a worker does: bytes in, bytes out, in a directory of its own that is gone afterwards.

The same task gives the same bytes anywhere: random streams are keyed by seed and stage.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from workflow.engine import storage
from workflow.engine.code_version import code_digest
from workflow.engine.errors import StageError
from workflow.engine.executor import Failure, Report, attempt
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory
from workflow.kinds import kind_of
from workflow.study.points import Point
from workflow.tasks.pipeline import stage_input_hash
from workflow.tasks.stage import StageInput


@dataclass(frozen=True, eq=False)
class Done:
    """A computed point: contents of its stage files by file name, seconds and input hash by stage."""

    files: Mapping[str, bytes]
    seconds: Mapping[str, float]
    hashes: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class PointTask:
    """Points for one worker, one after the other: a result two of them share is computed once.

    given: stage files (name to content) that every point starts from. stages: names of those to compute.
    code: digest of the code of whoever asks.
    """

    points: tuple[Point, ...]
    given: Mapping[str, bytes]
    stages: tuple[str, ...]
    code: str

    def run(self, report: Report) -> tuple[Done | Failure, ...]:
        """Every point in turn. Whatever goes wrong with one is its own failure and nobody else's.

        Raises StageError where this is not the code of whoever asks.
        """
        if self.code != code_digest():
            raise StageError(
                "the code of the worker is not that of the study: another version, or edited meanwhile"
            )
        with tempfile.TemporaryDirectory(prefix="flexlink-") as folder:
            runs = [RunDirectory(Path(folder) / str(index)) for index in range(len(self.points))]
            return tuple(
                attempt(partial(self._fill, runs[index], point, runs[:index]))
                for index, point in enumerate(self.points)
            )

    def _fill(self, run: RunDirectory, point: Point, earlier: Sequence[RunDirectory]) -> Done:
        """Compute the stages of one point in a run directory; earlier: runs that may share some."""
        config: Any = point.config
        run.stages_path.mkdir(parents=True)
        for name, content in self.given.items():
            storage.write_bytes(run.stages_path / name, content)
        seconds = {}
        hashes = {}
        kind = kind_of(point.config)
        results: Any = kind.results(run)
        for stage in kind.stages:
            if stage.name not in self.stages:
                continue
            started = time.monotonic()
            wanted = stage_input_hash(stage, point.config, run, point.inputs)
            if run.take_over(stage.name, wanted, earlier) is None:
                run.save_stage(stage.name, stage.run(StageInput(config, results, Progress())), wanted)
            seconds[stage.name] = time.monotonic() - started
            hashes[stage.name] = wanted
        return Done(run.stage_files(self.stages), seconds, hashes)
