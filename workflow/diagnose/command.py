"""What `flexlink diagnose` does: cases in; answers, pages, repaired rigs and an overview out."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, replace as changed
from functools import partial
from pathlib import Path
from typing import Any

from diagnosis.answer import Diagnosis
from diagnosis.diagnosis import diagnose
from workflow.config.settings import repeated
from workflow.describe.diagnosis_rows import diagnosis_section, failed_case, short_answer
from workflow.describe.summary import RunSummary
from workflow.diagnose.case_files import LoadedCase, load_case
from workflow.diagnose.case_settings import CASE_FILE, case_document
from workflow.diagnose.directory import LAYOUT_VERSION, DiagnosisDirectory
from workflow.diagnose.fleet import FleetMachine, csv_text, groups, machines_section, overview_page, trends
from workflow.diagnose.outputs import files_of
from workflow.diagnose.simulator_case import SimulatorCase, load_simulator_case
from workflow.diagnose.simulator_settings import SimulatorSettings, is_simulator, settings_of
from workflow.engine import codec
from workflow.engine.code_version import code_digest
from workflow.engine.errors import (
    EXIT_BAD_INPUT,
    EXIT_INTERNAL,
    EXIT_NOT_CERTIFIED,
    EXIT_OK,
    InputError,
    StageError,
    one_line,
)
from workflow.engine.executor import Executor, Failure, Report, ThisProcess, workers
from workflow.engine.progress import Progress
from workflow.report.rendering import render_described

# A case, and why it has no answer.
_Failed = tuple[str, Failure]
# Time that a case is expected to take [s]: it shapes the progress bar only.
_CASE_S = 30.0
# Of more cases the terminal shows groups alone.
_MOST_SHOWN = 20


@dataclass(frozen=True, eq=False)
class DiagnosisRun:
    """What a call left behind: the JSON answers in the order asked for, cases without one, the exit code."""

    documents: Answers
    failures: tuple[_Failed, ...]
    summary: RunSummary

    @property
    def exit_code(self) -> int:
        """Internal error over bad input over a fit that did not converge over success."""
        # The worst one counts: whoever runs many cases looks at the code first.
        if any(not failure.bad_input for _, failure in self.failures):
            return EXIT_INTERNAL
        if self.failures:
            return EXIT_BAD_INPUT
        unsure = any(document["detail_verdict"] == "not_converged" for document in self.documents)
        return EXIT_NOT_CERTIFIED if unsure else EXIT_OK

    def complaints(self) -> list[str]:
        """One line for every case that failed or whose fit did not converge."""
        lines = [f"{case}: {one_line(failure.reason)}" for case, failure in self.failures]
        for document in self.documents:
            if document["detail_verdict"] == "not_converged":
                lines.append(f"{document['case']}: the fit did not converge, no cause is named")
        return lines

    def json_parts(self, *, ascii_only: bool = False) -> Iterator[str]:
        """The run as JSON text in parts, an answer each: a thousand answers are never in memory at once."""
        failed = [{"case": case, "reason": failure.reason} for case, failure in self.failures]
        frame = {"cases": [], "failed": failed, "report": self.summary.report_path}
        # The answers go between the brackets of the empty list of cases, which comes first.
        before, after = codec.plain_text(frame, ascii_only=ascii_only).split("[", 1)
        for document in self.documents:
            text = codec.plain_text(document, ascii_only=ascii_only).rstrip().replace("\n", "\n  ")
            yield f"{before}[\n  {text}" if before else f",\n  {text}"
            before = ""
        yield f"{before}[{after}" if before else f"\n {after}"


def diagnose_cases(
    places: Sequence[Path | SimulatorSettings],
    out: Path,
    *,
    rig: str | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    replace: bool = False,
    controller: bool = True,
    time_limit_s: float | None = None,
    engine: Callable[..., Diagnosis] | None = None,
    progress: Progress | None = None,
) -> DiagnosisRun:
    """Diagnose every case into `out`.

    places: case folders or files, or what a simulator's case file says, with files in the current folder.
    rig: file in each case folder that is read in place of the one its case file names. jobs: processes
    (default: one per processor). scheduler: address of a Dask scheduler whose workers see the same files.
    time_limit_s: see `diagnosis.diagnose`, in whose place tests put a quick
    `engine`. A case that fails does not lose the others; one that fails alone raises InputError or
    StageError. Raises InputError (one line, nothing written) if no case can be read, two have one name, or
    `out` cannot be used.
    """
    progress = progress or Progress()
    code = code_digest("diagnosis", drawing=True)
    limits: dict[str, Any] = {} if time_limit_s is None else {"time_limit_s": time_limit_s}
    options = {"controller": controller, **limits}
    engine = partial(engine or diagnose, **limits)
    work, unreadable = _load(
        places, lambda place: PlacedCase(place, rig, Path.cwd(), options, code, engine, out.resolve())
    )
    width = max(1, min(jobs or os.cpu_count() or 1, len(work)))
    preload = ["diagnosis.diagnosis", "workflow.diagnose.command"]
    inputs = {case.name: case.input_sha256 for case in work}
    directory = DiagnosisDirectory(out)
    # A model of a user's may end its process, or wait for ever in code that no interrupt reaches.
    in_this_process = scheduler is None and len(work) == 1 and not work[0].of_simulator
    computing: AbstractContextManager[Executor] = (
        closing(ThisProcess()) if in_this_process else workers(width, scheduler, preload)
    )
    with computing as executor, directory.writing(resume=resume, replace=replace):
        begun_with = {"layout": LAYOUT_VERSION, "inputs": inputs, "options": options}
        directory.begin(begun_with, resume=resume, replace=replace)
        machines, failures = _compute(directory, work, executor, progress)
        failures = [*unreadable, *failures]
        if len(places) == 1 and failures:
            directory.discard_if_empty()
            failure = failures[0][1]
            raise (InputError if failure.bad_input else StageError)(failure.reason)
        # Read from the files, in which a resumed run has those of earlier ones as well.
        documents = Answers(directory, [machine.name for machine in machines])
        # One case is its own overview.
        page = out / f"{work[0].name}.html"
        if len(places) > 1:
            page = out / "index.html"
            with progress.stage("overview"):
                failed = {case: failure.reason for case, failure in failures}
                overview = render_described(overview_page(machines, failed)).html
                table = csv_text(machines, failed)
                directory.write({"index.html": overview.encode(), "fleet.csv": table.encode()})
        summary = _summary(documents, machines, failures, page)
    return DiagnosisRun(documents, tuple(failures), summary)


@dataclass(frozen=True)
class Answers(Sequence[Mapping[str, Any]]):
    """JSON answers, read when they are looked at: a thousand would not fit."""

    directory: DiagnosisDirectory
    names: Sequence[str]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: Any) -> Any:
        name = self.names[index]
        if isinstance(name, str):
            return self.directory.document(f"{name}.json")
        return Answers(self.directory, name)


@dataclass(frozen=True, eq=False)
class PlacedCase:
    """A case by its place, read where it is done: whoever has a thousand of them holds no record.

    folder: of relative places. See `files_of` for the others.
    """

    place: Path | SimulatorSettings
    rig: str | None
    folder: Path
    options: Mapping[str, Any]
    code_sha256: str
    diagnose: Callable[..., Diagnosis]
    out: Path
    name: str = ""
    input_sha256: str = ""
    of_simulator: bool = False

    def read(self) -> PlacedCase:
        """This case with the name and the hash of its files, which are read. Raises InputError."""
        loaded = load_any_case(self.place, self.rig)
        return changed(
            self,
            name=loaded.case.name,
            input_sha256=loaded.input_sha256,
            of_simulator=isinstance(loaded, SimulatorCase),
        )

    @property
    def made_from(self) -> dict[str, Any]:
        """See `files_of`."""
        return {
            "input_sha256": self.input_sha256,
            "code_sha256": self.code_sha256,
            "options": {**self.options},
        }

    def run(self, report: Report) -> tuple[dict[str, bytes], float]:
        """See `files_of`. Raises StageError: other code or files than where the work was given out."""
        if self.code_sha256 != code_digest("diagnosis", drawing=True):
            raise StageError(
                "the code of the worker is not that of the diagnosis: another version, or edited"
            )
        place = self.folder / self.place if isinstance(self.place, Path) else self.place
        loaded = load_any_case(place, self.rig, self.folder)
        if loaded.input_sha256 != self.input_sha256:
            raise StageError(f"case {self.name}: its files changed meanwhile; run the command again")
        return files_of(loaded, self.made_from, self.diagnose, report, self.out)


def _load(
    places: Sequence[Path | SimulatorSettings], task: Callable[[Path | SimulatorSettings], PlacedCase]
) -> tuple[list[PlacedCase], list[_Failed]]:
    loaded: list[PlacedCase] = []
    failures: list[_Failed] = []
    for place in places:
        try:
            loaded.append(task(place).read())
        except InputError as error:
            named = place.resolve() if isinstance(place, Path) else Path(place.model)
            failures.append((named.name, Failure(str(error), bad_input=True)))
    if not loaded:
        further = f" (and {len(failures) - 1} more cases cannot be read)" if len(failures) > 1 else ""
        raise InputError(failures[0][1].reason + further)
    # The name of a case is that of its files in the output directory.
    name = repeated([case.name for case in loaded])
    if name is not None:
        raise InputError(
            f"two cases are called {name!r}: give one another name in its {CASE_FILE} (key 'case')"
        )
    return loaded, failures


def load_any_case(
    place: Path | SimulatorSettings, rig: str | None = None, folder: Path = Path()
) -> LoadedCase | SimulatorCase:
    """A case of a rig or of a simulator: as `load_case` and `load_simulator_case`."""
    if isinstance(place, SimulatorSettings):
        return load_simulator_case(place, folder, "--log")
    file, document = case_document(place)
    if not is_simulator(document):
        return load_case(place, rig)
    # A folder may come from anybody; a model can run code and read any file.
    if place.is_dir():
        raise InputError(f"{file}: names a simulator's model; name {CASE_FILE} itself to load it")
    return load_simulator_case(settings_of(document, str(file)), file.parent, str(file))


def _compute(
    directory: DiagnosisDirectory, work: Sequence[PlacedCase], executor: Executor, progress: Progress
) -> tuple[list[FleetMachine], list[_Failed]]:
    """Diagnose the cases that have no answer yet, and save each answer as soon as it is there."""
    # A resumed run keeps the answers that the same inputs and the same code gave.
    answers = {}
    for case in work:
        document = directory.finished(case.name, case.made_from)
        if document is not None:
            answers[case.name] = FleetMachine.of(document)
    todo = {case.name: case for case in work if case.name not in answers}
    names = list(todo)
    several = len(work) > 1
    progress.plan([("cases", _CASE_S * len(todo) / executor.width)])
    shares = [0.0] * len(todo)
    timings = directory.document("timings.json")
    failures: dict[str, Failure] = {}

    def watch(index: int, fraction: float, message: str) -> None:
        shares[index] = fraction
        done = len(answers) + len(failures)
        words = f"{done} of {len(work)} done, {names[index]}: {message}" if several else message
        progress.update("cases", sum(shares) / len(todo), words)

    with progress.stage("cases", taken_up=not todo):
        for index, result in executor.run(list(todo.values()), watch):
            name = names[index]
            if isinstance(result, Failure):
                failures[name] = result
            else:
                files, cpu_s = result
                timings[name] = {"cpu_s": round(cpu_s, 3)}
                directory.save(name, {**files, "timings.json": codec.plain_text(timings).encode()})
                answers[name] = FleetMachine.of(json.loads(files[f"{name}.json"]))
            watch(index, 1.0, "done")
    return (
        [answers[case.name] for case in work if case.name in answers],
        [(case.name, failures[case.name]) for case in work if case.name in failures],
    )


def _summary(
    documents: Answers, machines: Sequence[FleetMachine], failures: Sequence[_Failed], page: Path
) -> RunSummary:
    """Rows for the terminal: groups of several machines, answers of a few, cases that failed."""
    count = len(documents)
    sections = []
    if count > 1:
        sections.append(machines_section(groups(machines), trends(machines)))
    if count <= _MOST_SHOWN:
        sections += [diagnosis_section(document, page.parent) for document in documents]
    sections += [failed_case(case, failure.reason) for case, failure in failures]
    verdict = f"{count} of {count + len(failures)} cases answered"
    if count == 1 and not failures:
        verdict = short_answer(documents[0])
    return RunSummary(
        title="Gap diagnosis",
        sections=sections,
        verdict=verdict,
        report_path=str(page) if documents or failures else None,
    )
