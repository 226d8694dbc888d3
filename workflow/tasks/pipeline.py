"""A whole run as one library call: stages in order, each skipped when its result is there."""

from __future__ import annotations

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
from workflow.config.run_config import AnyConfig, RunConfig
from workflow.engine import interrupts, storage
from workflow.engine.code_version import code_digest
from workflow.engine.errors import CommandInterruptedError, InputError, naming, one_line
from workflow.engine.progress import Progress
from workflow.engine.run_directory import KEPT_FILES, LAYOUT_VERSION, RunDirectory, hash_of
from workflow.tasks.exports import Logged, model_bytes, write_controller
from workflow.tasks.results import AnyResults, ReferenceFilterResult, RunResults
from workflow.tasks.stage import RunKind, Stage, StageInput
from workflow.tasks.stages import ONE_LOOP


def run_pipeline(
    config: AnyConfig,
    out: Path,
    *,
    kind: RunKind = ONE_LOOP,
    config_text: str = "",
    called: str = "the configuration",
    resume: bool = False,
    replace: bool = False,
    page: Stage | None = None,
    c_code: Mapping[str, Any] | None = None,
    note: str = "",
    read: Sequence[Record] = (),
    begun: RunDirectory | None = None,
    earlier: RunDirectory | None = None,
    progress: Progress | None = None,
) -> AnyResults:
    """Run every stage into a directory and return the results of its stages.

    Parameters
    ----------
    config : AnyConfig
    out : Path
        The run directory.
    kind : RunKind
        That of the configuration.
    config_text : str
        Kept as config.toml.
    called : str
        What complaints call the configuration.
    resume, replace : bool
        Go on with a run that is there, or start it afresh; otherwise `out` has to be free.
    page : Stage, optional
        The last stage, which writes the page.
    c_code : mapping of str to value, optional
        Fields of `Dialect` that are stated; kept for when the run is resumed.
    note : str
        A line that is said once nothing refuses the run.
    read : sequence of Record
        The logs, where they have been read.
    begun, earlier : RunDirectory, optional
        Runs whose stages are taken over where they were made from the same, as those of the run itself are
        when it is resumed. `begun` is of this same call, `earlier` one that the user names.
    progress : Progress, optional

    Returns
    -------
    AnyResults
        Those of the kind. A result that is not certified is no error.

    Raises
    ------
    InputError
        One line: something wrong with what the user gave. What this call created is removed then, unless
        identification had already been paid for.
    StageError
        A computation failed.
    """
    progress = progress or Progress()
    run = RunDirectory(Path(out))
    stages = kind.stages
    existed = run.path.exists()
    stage_input = _stage_input(config, kind.results(run), progress, called)
    run.refuse_unless_free(resume=resume, replace=replace)
    inputs = input_digests(config, earlier)
    # Records are read before anything is written: a bad log leaves no directory behind.
    ready: tuple[Any, float] | None = None
    first_is_there = begun is not None
    if earlier is not None:
        nothing_because = why_nothing_is_taken_over(config, stages[0], earlier, inputs)
        first_is_there = first_is_there or not nothing_because
        if begun is None:
            _say_what_cannot_be_taken_over(earlier, nothing_because, progress)
    if not (resume and existed) and not first_is_there:
        started = time.monotonic()
        with threadpool_limits(1):
            ready = stages[0].run(changed(stage_input, read=read)), time.monotonic() - started
    # With more threads sums round otherwise: a resumed run would have other digits.
    with run.writing(resume=resume, replace=replace), threadpool_limits(1):
        run.begin_run(
            config_text=config_text,
            config=config.to_document(),
            seed=config.run.seed,
            inputs=inputs,
            resume=resume,
            replace=replace,
        )

        # Names and number type of the C code: as stated now, or when the run began.
        kept_dialect = run.manifest().get("c_code", {})
        # A run that began with an older version may have fewer of them.
        kept_keys = {key: kept_dialect[key] for key in ("prefix", "number") if key in kept_dialect}
        with naming(str(run.manifest_path)):
            dialect_before = changed(Dialect(), **kept_keys)
        dialect = changed(dialect_before, **(c_code or {}))
        run.record_status("running", c_code=asdict(dialect))

        # The stages in order; each is taken over where a run has it already.
        stages = stages if page is None else (*stages, page)
        progress.plan([(stage.name, stage.expected_s) for stage in stages])
        if note:
            progress.note(note)
        try:
            for stage in stages:
                _perform(
                    stage,
                    stage_input,
                    inputs,
                    ready if stage is stages[0] else None,
                    begun=begun,
                    earlier=earlier,
                )
            _say_what_was_taken_over(run, progress)
            written = _keep_files(stage_input.results, config, dialect)
            # No file of an earlier design stays.
            for name in KEPT_FILES:
                if run.path / name not in written:
                    (run.path / name).unlink(missing_ok=True)
            holds = stage_input.results.certified and stage_input.results.settles
        except BaseException as error:
            # A library may turn an interrupt into any other error, so that it is asked for, too.
            if isinstance(error, KeyboardInterrupt) or interrupts.came():
                # A full disk or a directory that is gone does not hide that the run was interrupted.
                with suppress(InputError):
                    run.record_status("interrupted")
                raise CommandInterruptedError(run.path) from None
            _fail(run, error, created=not existed)
            raise
        run.record_status("complete" if holds else "complete, not certified")
    return stage_input.results


def identify_only(
    config: RunConfig,
    out: Path,
    *,
    config_text: str = "",
    earlier: RunDirectory | None = None,
    progress: Progress | None = None,
) -> None:
    """Run the stages up to the uncertain plant into `out`, which `flexlink design` reads.

    What is there is replaced. earlier: a run whose stages are taken over where they were made from the same.
    Raises InputError and StageError, see `run_pipeline`.
    """
    stage_input = StageInput(config, RunResults(RunDirectory(out)), progress or Progress())
    inputs = input_digests(config)
    stages = ONE_LOOP.plant_stages
    with stage_input.results.run.writing(replace=True), threadpool_limits(1):
        stage_input.results.run.begin_run(
            config_text=config_text,
            config=config.to_document(),
            seed=config.run.seed,
            inputs=inputs,
            replace=True,
        )
        stage_input.progress.plan([(stage.name, stage.expected_s) for stage in stages])
        if earlier is not None:
            nothing_because = why_nothing_is_taken_over(config, stages[0], earlier, inputs)
            _say_what_cannot_be_taken_over(earlier, nothing_because, stage_input.progress)
        for stage in stages:
            _perform(stage, stage_input, inputs, earlier=earlier)


def rebuild_page(
    config: AnyConfig, results: AnyResults, page: Stage, progress: Progress | None = None
) -> None:
    """Perform the last stage again on a finished run. Raises InputError when a stage is missing.

    Parameters
    ----------
    config : AnyConfig
        That the run was begun with.
    results : AnyResults
        Of the run.
    page : Stage
        The last stage.
    progress : Progress, optional
    """
    stage_input = _stage_input(config, results, progress or Progress())
    stage_input.progress.plan([(page.name, page.expected_s)])
    with results.run.locked():
        _perform(page, stage_input, {}, always=True)


def _stage_input(
    config: AnyConfig, results: AnyResults, progress: Progress, called: str = "the configuration"
) -> StageInput:
    # The stages of another kind of run know what their configuration and results are.
    of_any_kind: Any = config
    of_its_results: Any = results
    return StageInput(of_any_kind, of_its_results, progress, called)


def config_of(run: RunDirectory) -> RunConfig:
    """The configuration a run of one loop was begun with. Raises InputError for one of several joints."""
    document = run.config_document()
    if "joints" in document:
        config_file = path_as_typed(run.path / "config.toml")
        raise InputError(
            f"{run.path}: a run for several joints, and this command takes one loop; for other settings edit "
            f"its config.toml and type: flexlink run --config {config_file} --out OTHER"
        )
    return RunConfig.from_document(document, source=str(run.path / "config.json"))


def _perform(
    stage: Stage,
    stage_input: StageInput,
    inputs: Mapping[str, str],
    ready: tuple[Any, float] | None = None,
    *,
    begun: RunDirectory | None = None,
    earlier: RunDirectory | None = None,
    always: bool = False,
) -> None:
    """Leave a stage's file in the run: taken over where a run has one made from the same, else made.

    ready: its result where that is known already, and the seconds it took. begun, earlier: see
    `run_pipeline`; always: made again although it is there.
    """
    run = stage_input.results.run
    progress = stage_input.progress
    input_hash = stage_input_hash(stage, stage_input.config, run, inputs)
    progress.start(stage.name)
    if not always:
        # What a stage writes beside its own file is not in another run's stages.
        other_runs: tuple[RunDirectory, ...] = ()
        if not stage.also_writes(run):
            other_runs = tuple(filter(None, (begun, earlier)))
        origin = run.take_over(stage.name, input_hash, other_runs)
        if origin is not None and all(path.is_file() for path in stage.also_writes(run)):
            if origin is not run:
                called = str(origin.path) if origin is earlier else None
                run.record_taken_over(stage.name, origin, called)
            progress.finish(stage.name, 0.0, taken_up=True)
            return
    started = time.monotonic()
    result, before_s = ready or (stage.run(stage_input), 0.0)
    interrupts.check()
    run.save_stage(stage.name, result, input_hash)
    # The stages after it see what is on the disk, as they would in a resumed run: to the last digit.
    stage_input.results.read.pop(stage.name, None)
    seconds = time.monotonic() - started + before_s
    run.record_stage(stage.name, seconds, input_hash)
    progress.finish(stage.name, seconds, taken_up=False)


def input_digests(config: AnyConfig, earlier: RunDirectory | None = None) -> dict[str, str]:
    """Every input file with its SHA-256; of one that is gone what an earlier run notes of it.

    Raises InputError where a file cannot be read that `earlier` does not know.
    """
    noted = {} if earlier is None else earlier.manifest()["inputs"]
    digests = {}
    for path in config.input_files:
        if str(path) in noted and not path.is_file():
            digests[str(path)] = noted[str(path)]
        else:
            digests[str(path)] = storage.sha256_of_file(path)
    return digests


def why_nothing_is_taken_over(
    config: AnyConfig, first: Stage, earlier: RunDirectory, inputs: Mapping[str, str]
) -> str:
    """The reason why a run shares no stage with an earlier one, from its first stage on; "" where it does.

    first: the first stage of the run. inputs: every input file with its SHA-256. Raises InputError where the
    earlier run was made from other files: every stage reads them, through the first.
    """
    earlier.refuse_other_inputs(inputs)
    first_hash = stage_input_hash(first, config, earlier, inputs)
    # Also of a file that is lost since: made again it is the same, and so are the stages after it.
    noted = earlier.manifest()["stages"].get(first.name, {})
    if noted.get("input_sha256") == first_hash or earlier.is_done(first.name, first_hash):
        return ""
    if earlier.manifest().get("code_sha256") != code_digest():
        return "it was made by another version of flexlink"
    if not noted and earlier.stage_file(first.name) is None:
        return "it ended before its first stage was done"
    return "its records were read with other settings"


def _say_what_cannot_be_taken_over(earlier: RunDirectory, nothing_because: str, progress: Progress) -> None:
    """One line where nothing of an earlier run can be taken over, for a reason, or where files of its
    finished stages are missing or damaged."""
    if nothing_because:
        progress.note(f"nothing of {earlier.path} is taken over: {nothing_because}")
        return
    lost = earlier.lost_stages()
    # The page is drawn again in any case.
    lost.pop("report", None)
    by_state: dict[str, list[str]] = {}
    for name, state in lost.items():
        by_state.setdefault(state, []).append(name)
    if by_state:
        words = []
        for state, names in by_state.items():
            verb = "is" if len(names) == 1 else "are"
            words.append(f"{', '.join(names)} {verb} {state}")
        progress.note(f"of {earlier.path}/stages {' and '.join(words)}: done again")


def _say_what_was_taken_over(run: RunDirectory, progress: Progress) -> None:
    """Name the stages that came from another run, once for each such run."""
    for origin, names in run.taken_over().items():
        progress.note(f"taken over from {origin}, whose inputs are the same: {', '.join(names)}")


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


def _keep_files(results: AnyResults, config: AnyConfig, dialect: Dialect) -> list[Path]:
    """controller.json, .mat, .c and .h; of one loop with those of its reference filter, and model.json."""
    reference_filter = ReferenceFilterResult()
    written = list[Path]()
    if isinstance(config, RunConfig):
        assert isinstance(results, RunResults)
        reference_filter = results.reference_filter
        channel = results.uncertainty.seen_by_controller(config)[config.control_index]
        model_file = results.run.path / "model.json"
        content = model_bytes(model_file, ModelFile(channel.nominal, channel.enclosing))
        storage.write_together({model_file: content})
        written = [model_file]
    controller = results.design.controller
    if controller is None:
        return written
    law = Logged.of(config, results.records).law(reference_filter.law(controller))
    return written + write_controller(
        results.run.path,
        law,
        reference_filter.filter,
        certified=results.certified,
        about=results.certified_for(config),
        dialect=dialect,
    )


def _fail(run: RunDirectory, error: BaseException, *, created: bool) -> None:
    if isinstance(error, InputError) and created and run.stage_file("identify") is None:
        # Nothing of value is there yet, and a half-filled directory would refuse the corrected attempt.
        run.discard()
        return
    # What went wrong first is what is said.
    with suppress(InputError):
        run.record_status(f"failed: {one_line(error) or type(error).__name__}")
