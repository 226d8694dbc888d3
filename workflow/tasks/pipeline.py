"""A whole run as one library call: stages in order, each skipped when its result is there."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace as changed
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from control_design.controllers.c_code import Dialect
from ident.basis.model_files import ModelFile
from ident.data.foreign_files import path_as_typed
from ident.data.record import Record
from workflow.config.joints_config import AnyConfig, JointsConfig
from workflow.config.run_config import RunConfig
from workflow.engine import interrupts, storage
from workflow.engine.code_version import code_digest
from workflow.engine.errors import CommandInterruptedError, InputError, naming, one_line
from workflow.engine.progress import Progress
from workflow.engine.run_directory import KEPT_FILES, LAYOUT_VERSION, RunDirectory, hash_of
from workflow.tasks.exports import Logged, model_bytes, write_controller
from workflow.tasks.results import ReferenceFilterResult, RunResults
from workflow.tasks.stage import Stage, StageInput, stages_for
from workflow.tasks.stages import PLANT, STAGES
from workflow.tasks.summary import summarise
from workflow.text.templates import RunSummary, said


def run_pipeline(
    config: AnyConfig,
    out: Path,
    *,
    config_text: str = "",
    called: str = "the configuration",
    resume: bool = False,
    replace: bool = False,
    page: Stage | None = None,
    c_code: Mapping[str, Any] | None = None,
    note: str = "",
    read: Sequence[Record] = (),
    known: Mapping[str, bytes] | None = None,
    progress: Progress | None = None,
) -> RunSummary:
    """Run every stage into `out` and return the table of numbers.

    config_text: kept as config.toml (`called` in complaints); resume takes up a run that is there, replace
    starts it afresh; page: the last stage, which writes the page; c_code: the fields of `Dialect` that are
    stated, kept for when it is resumed; note: said once nothing refuses the run; read: the logs,
    where they have been read; known: files of stages that were performed elsewhere, which stand where they
    were made from the same. A result that is not certified is no error.

    Raises InputError (one line) for anything wrong with what the user gave; what this call created is removed
    then, unless identification had already been paid for. Raises StageError when a computation fails.
    """
    progress = progress or Progress()
    run, stages = RunDirectory(Path(out)), stages_for(config, STAGES)
    existed, given = run.path.exists(), _given(config, run, progress, called)
    run.refuse_unless_free(resume=resume, replace=replace)
    inputs = {str(path): storage.sha256_of_file(path) for path in config.input_files}
    # Records are read before anything is written: a bad log leaves no directory behind.
    ready: tuple[Any, float] | None = None
    if not (resume and existed) and not known:
        started = time.monotonic()
        with threadpool_limits(1):
            ready = stages[0].run(changed(given, read=read)), time.monotonic() - started
    # More threads round otherwise.
    with run.writing(resume=resume, replace=replace), threadpool_limits(1):
        run.begin_run(
            config_text=config_text,
            config=config.to_document(),
            seed=config.run.seed,
            inputs=inputs,
            resume=resume,
            replace=replace,
        )
        kept = run.manifest().get("c_code", {})
        with naming(str(run.manifest_path)):
            before = changed(Dialect(), **{k: kept[k] for k in ("prefix", "number") if k in kept})
        for name, content in (known or {}).items():
            run.write_stage(*os.path.splitext(name), content)
        dialect = changed(before, **(c_code or {}))  # as stated now, or else before
        run.record_status("running", c_code=asdict(dialect))
        stages = stages if page is None else (*stages, page)
        progress.plan([(stage.name, stage.expected_s) for stage in stages])
        if note:
            progress.note(note)
        try:
            for stage in stages:
                _perform(stage, given, inputs, ready if stage is stages[0] else None)
            written = _keep_files(given.results, config, dialect)
            for name in KEPT_FILES:  # none of an earlier design stay
                if run.path / name not in written:
                    (run.path / name).unlink(missing_ok=True)
            summary = summarise(given.results, config)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt) or interrupts.came():  # a library may make anything of it
                with suppress(InputError):  # a full disk, a directory that is gone
                    run.record_status("interrupted")
                raise CommandInterruptedError(run.path) from None
            _fail(run, error, created=not existed)
            raise
        run.record_status("complete" if summary.certified else "complete, not certified")
    return summary


def identify_only(
    config: RunConfig, out: Path, *, config_text: str = "", progress: Progress | None = None
) -> None:
    """The stages up to the uncertain plant into `out`, which `flexlink design` reads; an earlier run there is
    replaced. Raises as a run."""
    given = StageInput(config, RunResults(RunDirectory(out)), progress or Progress())
    inputs = {str(path): storage.sha256_of_file(path) for path in config.input_files}
    stages = plant_stages(config)
    with given.results.run.writing(replace=True), threadpool_limits(1):
        given.results.run.begin_run(
            config_text=config_text,
            config=config.to_document(),
            seed=config.run.seed,
            inputs=inputs,
            replace=True,
        )
        given.progress.plan([(stage.name, stage.expected_s) for stage in stages])
        for stage in stages:
            _perform(stage, given, inputs)


def rebuild_page(run: RunDirectory, page: Stage, progress: Progress | None = None) -> RunSummary:
    """Perform the last stage again on a finished run. Raises InputError when a stage is missing."""
    config = any_config_of(run)
    given = _given(config, run, progress or Progress())
    given.progress.plan([(page.name, page.expected_s)])
    with run.locked():
        _perform(page, given, {}, always=True)
    return summarise(given.results, config)


def _given(
    config: AnyConfig, run: RunDirectory, progress: Progress, called: str = "the configuration"
) -> StageInput:
    given: Any = config
    return StageInput(given, RunResults(run), progress, called)


def certified_for(results: RunResults, config: AnyConfig) -> str:
    """What a certificate of the plant that was identified is about."""
    if isinstance(config, JointsConfig):
        models: Any = results.identify
        return f"{len(models.points)} operating points"
    channel = config.control_channel
    unit = results.records.unit(channel.input)
    return said("certified_for", channel.uncertainty, results.uncertainty.equivalent, unit)


def config_of(run: RunDirectory) -> RunConfig:
    """The configuration a run of one loop was begun with. Raises InputError for one of several joints."""
    config = any_config_of(run)
    if isinstance(config, JointsConfig):
        kept = path_as_typed(run.path / "config.toml")
        raise InputError(
            f"{run.path}: a run for several joints, and this command takes one loop; for other settings edit "
            f"its config.toml and type: flexlink run --config {kept} --out OTHER"
        )
    return config


def any_config_of(run: RunDirectory) -> AnyConfig:
    """The same, of a run for several joints too."""
    document, source = run.config_document(), str(run.path / "config.json")
    return (JointsConfig if "joints" in document else RunConfig).from_document(document, source=source)


def _perform(
    stage: Stage,
    given: StageInput,
    inputs: Mapping[str, str],
    ready: tuple[Any, float] | None = None,
    *,
    always: bool = False,
) -> None:
    """ready: its result where that is known already, and the seconds it took."""
    run, progress = given.results.run, given.progress
    input_hash = stage_input_hash(stage, given.config, run, inputs)
    progress.start(stage.name)
    there = run.is_done(stage.name, input_hash) and all(p.is_file() for p in stage.also_writes(run))
    if there and not always:
        progress.finish(stage.name, 0.0, taken_up=True)
        return
    started = time.monotonic()
    result, before_s = ready or (stage.run(given), 0.0)
    interrupts.check()
    run.save_stage(stage.name, result, input_hash)
    # The stages after it see what is on the disk, as they would in a resumed run: to the last digit.
    given.results.read.pop(stage.name, None)
    seconds = time.monotonic() - started + before_s
    run.record_stage(stage.name, seconds, input_hash)
    progress.finish(stage.name, seconds, taken_up=False)


def stage_input_hash(stage: Stage, config: AnyConfig, run: RunDirectory, inputs: Mapping[str, str]) -> str:
    """SHA-256 over all that a stage's result depends on, our own code included."""
    return hash_of(
        {
            "layout": LAYOUT_VERSION,
            "code": code_digest(drawing=bool(stage.also_writes(run))),
            "stage": stage.name,
            "seed": config.run.seed,
            "settings": stage.settings(config),
            "files": dict(inputs) if not stage.after else {},
            "after": {name: run.stage_digest(name) for name in stage.after},
        }
    )


def _keep_files(results: RunResults, config: AnyConfig, dialect: Dialect) -> list[Path]:
    """controller.json, .mat, .c and .h; of one loop with those of its reference filter, and model.json."""
    second, kept = ReferenceFilterResult(), list[Path]()
    if isinstance(config, RunConfig):
        second = results.reference_filter
        found = results.uncertainty.seen_by_controller(config)[config.control_index]
        kept = [results.run.path / "model.json"]
        storage.write_together({kept[0]: model_bytes(kept[0], ModelFile(found.nominal, found.frequency))})
    if (controller := results.design.controller) is None:
        return kept
    law = Logged.of(config, results.records).law(second.law(controller))
    about, certified = certified_for(results, config), results.certify.certified
    return kept + write_controller(
        results.run.path, law, second.filter, certified=certified, about=about, dialect=dialect
    )


def plant_stages(config: AnyConfig) -> tuple[Stage, ...]:
    """Stages up to the uncertain plant."""
    return tuple(stage for stage in stages_for(config, STAGES) if stage.name in PLANT)


def controller_stages(config: AnyConfig) -> tuple[Stage, ...]:
    """Stages from the design to the closed loop."""
    return tuple(stage for stage in stages_for(config, STAGES) if stage.name not in PLANT)


def _fail(run: RunDirectory, error: BaseException, *, created: bool) -> None:
    if isinstance(error, InputError) and created and run.stage_file("identify") is None:
        # Nothing of value is there yet, and a half-filled directory would refuse the corrected attempt.
        run.discard()
        return
    with suppress(InputError):  # what went wrong first is what is said
        run.record_status(f"failed: {one_line(error) or type(error).__name__}")
