"""What a worker does: bytes in, bytes out, in a directory of its own that is gone afterwards.

Nothing here knows where it runs. A worker that dies leaves nothing behind, and the same task gives the same
bytes anywhere: streams are keyed by the seed in the configuration and the stage, never by worker or order.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from workflow.config.run_config import RunConfig
from workflow.engine import storage
from workflow.engine.code_version import code_digest
from workflow.engine.errors import InputError, StageError, one_line
from workflow.engine.executor import Report
from workflow.engine.progress import Silence
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.pipeline import stage_input_hash
from workflow.tasks.results import RunResults
from workflow.tasks.stages import STAGES, StageInput


@dataclass(frozen=True, eq=False)
class Job:
    """One directory to fill: a configuration (`RunConfig.to_document`) and its input files' hashes."""

    name: str
    config: Mapping[str, Any]
    inputs: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class Done:
    """What became of a job: stage files by name, seconds and input hash by stage; or why it failed.

    bad_input: the failure is about what the user gave, not about the computation.
    """

    name: str
    files: Mapping[str, bytes]
    seconds: Mapping[str, float]
    hashes: Mapping[str, str]
    failure: str | None = None
    bad_input: bool = False


@dataclass(frozen=True, eq=False)
class Task:
    """Jobs for one worker, one after the other: a result two of them share is computed once.

    given: stage files (name to content) that every job starts from. stages: names of those to compute.
    code: digest of the code of whoever asks.
    """

    jobs: tuple[Job, ...]
    given: Mapping[str, bytes]
    stages: tuple[str, ...]
    code: str

    def run(self, report: Report) -> tuple[Done, ...]:
        """Every job in turn. Whatever goes wrong inside a job is that job's failure and nobody else's."""
        if self.code != code_digest():
            return self.failed(
                "the code of the worker is not that of the study: another version, or edited meanwhile"
            )
        done: list[Done] = []
        with tempfile.TemporaryDirectory(prefix="flexlink-") as folder:
            earlier: list[RunDirectory] = []
            for job in self.jobs:
                run = RunDirectory(Path(folder) / str(len(earlier)))
                done.append(_done(job, run, self, earlier))
                earlier.append(run)
        return tuple(done)

    def failed(self, reason: str) -> tuple[Done, ...]:
        """Every job of the task failed for the same reason."""
        return tuple(Done(job.name, {}, {}, {}, reason) for job in self.jobs)


def _done(job: Job, run: RunDirectory, task: Task, earlier: list[RunDirectory]) -> Done:
    try:
        seconds, hashes = _fill(run, job, task, earlier)
        files = {path.name: path.read_bytes() for path in map(run.stage_file, task.stages) if path}
        return Done(job.name, files, seconds, hashes)
    except InputError as error:
        return Done(job.name, {}, {}, {}, str(error), bad_input=True)
    except StageError as error:
        return Done(job.name, {}, {}, {}, str(error))
    except Exception as error:
        reason = f"internal error: {type(error).__name__}: {one_line(error)}"
        return Done(job.name, {}, {}, {}, reason)


def _fill(
    run: RunDirectory, job: Job, task: Task, earlier: list[RunDirectory]
) -> tuple[dict[str, float], dict[str, str]]:
    run.stages_path.mkdir(parents=True)
    for name, content in task.given.items():
        storage.write_bytes(run.stages_path / name, content)
    config = RunConfig.from_document(job.config, source=job.name)
    seconds, hashes, results = {}, {}, RunResults(run)
    for stage in STAGES:
        if stage.name not in task.stages:
            continue
        started = time.monotonic()
        wanted = stage_input_hash(stage, config, run, job.inputs)
        if not _take_over(run, stage.name, wanted, earlier):
            run.save_stage(stage.name, stage.run(StageInput(config, results, Silence())), wanted)
        seconds[stage.name], hashes[stage.name] = time.monotonic() - started, wanted
    return seconds, hashes


def _take_over(run: RunDirectory, stage: str, wanted: str, earlier: list[RunDirectory]) -> bool:
    for other in earlier:
        path = other.stage_file(stage)
        if path is not None and other.is_done(stage, wanted):
            shutil.copyfile(path, run.stages_path / path.name)
            return True
    return False
