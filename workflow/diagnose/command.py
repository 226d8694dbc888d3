"""What `flexlink diagnose` does: cases in; answers, pages, repaired rigs and an overview out."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from diagnosis.answer import Diagnosis
from diagnosis.diagnosis import diagnose
from workflow.config.settings import repeated
from workflow.diagnose.case_files import LoadedCase, load_case
from workflow.diagnose.case_settings import CASE_FILE, case_document
from workflow.diagnose.directory import DiagnosisDirectory
from workflow.diagnose.outputs import Work
from workflow.diagnose.simulator_case import (
    SimulatorCase,
    SimulatorSettings,
    is_simulator,
    load_simulator_case,
    settings_of,
)
from workflow.diagnose.words import FILTERS, closure_words, short_answer
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
from workflow.engine.executor import Failure, LocalProcesses
from workflow.engine.progress import Progress
from workflow.report.rendering import render_page
from workflow.text.templates import RunSummary, rows_of

_Failed = tuple[str, Failure]  # case, why it has no answer
_CASE_S, _OVERVIEW_S = 30.0, 1.0  # expected: they shape the progress bar only


@dataclass(frozen=True, eq=False)
class DiagnosisRun:
    """What a call left behind: the JSON answers in the order asked for, cases without one, the exit code."""

    documents: tuple[Mapping[str, Any], ...]
    failures: tuple[_Failed, ...]
    summary: RunSummary

    @property
    def exit_code(self) -> int:
        """Internal error over bad input over a fit that did not converge over success."""
        if any(not failure.bad_input for _, failure in self.failures):
            return EXIT_INTERNAL
        if self.failures:
            return EXIT_BAD_INPUT
        unsure = any(document["detail_verdict"] == "not_converged" for document in self.documents)
        return EXIT_NOT_CERTIFIED if unsure else EXIT_OK

    def complaints(self) -> list[str]:
        """One line for every case that failed or whose fit did not converge."""
        lines = [f"{case}: {one_line(failure.reason)}" for case, failure in self.failures]
        return lines + [
            f"{document['case']}: the fit did not converge, no cause is named"
            for document in self.documents
            if document["detail_verdict"] == "not_converged"
        ]

    def to_document(self) -> dict[str, Any]:
        return {
            "cases": list(self.documents),
            "failed": [{"case": case, "reason": failure.reason} for case, failure in self.failures],
            "report": self.summary.report_path,
        }


def diagnose_cases(
    places: Sequence[Path | SimulatorSettings],
    out: Path,
    *,
    rig: str | None = None,
    jobs: int | None = None,
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
    (default: one per processor). time_limit_s: see `diagnosis.diagnose`, in whose place tests put a quick
    `engine`. A case that fails does not lose the others; one that fails alone raises InputError or
    StageError. Raises InputError (one line, nothing written) if no case can be read, two have one name, or
    `out` cannot be used.
    """
    progress = progress or Progress()
    loaded, unreadable = _load(places, rig)
    code = code_digest("diagnosis", drawing=True)
    limits: dict[str, Any] = {} if time_limit_s is None else {"time_limit_s": time_limit_s}
    options, engine = {"controller": controller, **limits}, partial(engine or diagnose, **limits)
    work = [Work(one, options, code, engine) for one in loaded]
    with DiagnosisDirectory(out).writing(resume=resume, replace=replace):
        directory = DiagnosisDirectory.begin(
            out,
            inputs={one.case.name: one.input_sha256 for one in loaded},
            options=options,
            resume=resume,
            replace=replace,
        )
        documents, failures = _compute(directory, work, jobs or os.cpu_count() or 1, progress)
        failures = [*unreadable, *failures]
        if len(places) == 1 and failures:
            directory.discard_if_empty()
            failure = failures[0][1]
            raise (InputError if failure.bad_input else StageError)(failure.reason)
        page = out / f"{loaded[0].case.name}.html"
        if len(places) > 1:
            page = out / "index.html"
            with progress.stage("overview"):
                directory.write("index.html", _overview(documents, failures).encode())
    return DiagnosisRun(tuple(documents), tuple(failures), _summary(documents, failures, page))


_Loaded = LoadedCase | SimulatorCase


def _load(places: Sequence[Path | SimulatorSettings], rig: str | None) -> tuple[list[_Loaded], list[_Failed]]:
    loaded: list[_Loaded] = []
    failures: list[_Failed] = []
    for place in places:
        try:
            loaded.append(_loaded(place, rig))
        except InputError as error:
            named = place.resolve() if isinstance(place, Path) else Path(place.model)
            failures.append((named.name, Failure(str(error), bad_input=True)))
    if not loaded:
        more = f" (and {len(failures) - 1} more cases cannot be read)" if len(failures) > 1 else ""
        raise InputError(failures[0][1].reason + more)
    if (name := repeated([one.case.name for one in loaded])) is not None:
        raise InputError(
            f"two cases are called {name!r}: give one another name in its {CASE_FILE} (key 'case')"
        )
    return loaded, failures


def _loaded(place: Path | SimulatorSettings, rig: str | None) -> _Loaded:
    if isinstance(place, SimulatorSettings):
        return load_simulator_case(place, Path(), "--log")
    file, document = case_document(place)
    if not is_simulator(document):
        return load_case(place, rig)
    if place.is_dir():  # a folder may come from anybody; a model can run code and read any file
        raise InputError(f"{file}: names a simulator's model; name {CASE_FILE} itself to load it")
    return load_simulator_case(settings_of(document, str(file)), file.parent, str(file))


def _compute(
    directory: DiagnosisDirectory, work: Sequence[Work], jobs: int, progress: Progress
) -> tuple[list[dict[str, Any]], list[_Failed]]:
    order = [one.loaded.case.name for one in work]
    there = {name: directory.finished(name, one.made_from) for name, one in zip(order, work, strict=True)}
    answers = {name: known for name, known in there.items() if known is not None}
    todo = {name: one for name, one in zip(order, work, strict=True) if name not in answers}
    names, several = list(todo), len(work) > 1
    width = max(1, min(jobs, len(todo)))
    progress.plan(
        [("cases", _CASE_S * len(todo) / width), *((("overview", _OVERVIEW_S),) if several else ())]
    )
    shares = [0.0] * len(todo)
    timings = directory.timings()
    failures: dict[str, Failure] = {}

    def watch(index: int, fraction: float, message: str) -> None:
        shares[index] = fraction
        done = len(answers) + len(failures)
        words = f"{done} of {len(work)} done, {names[index]}: {message}" if several else message
        progress.update("cases", sum(shares) / len(todo), words)

    processes = LocalProcesses(width, preload=["diagnosis.diagnosis", "workflow.diagnose.outputs"])
    with progress.stage("cases", taken_up=not todo):
        for index, found in processes.run(list(todo.values()), watch):
            name = names[index]
            if isinstance(found, Failure):
                failures[name] = found
            else:
                files, cpu_s = found
                timings[name] = {"cpu_s": round(cpu_s, 3)}
                directory.save(name, {**files, "timings.json": codec.plain_text(timings).encode()})
                answers[name] = json.loads(files[f"{name}.json"])
            watch(index, 1.0, "done")
    return (
        [answers[name] for name in order if name in answers],
        [(name, failures[name]) for name in order if name in failures],
    )


def _overview(documents: Sequence[Mapping[str, Any]], failures: Sequence[_Failed]) -> str:
    """The page of several cases: a picture, a table with links, and what failed."""
    failed = {case: failure.reason for case, failure in failures}
    cases = [
        {**answer, "name": answer["case"], "answer": short_answer(answer), "closed": closure_words(answer)}
        for answer in documents
    ]
    page = "diagnosis/overview.html.j2"
    return render_page(page, filters=FILTERS.items(), title="Gap diagnosis", cases=cases, failed=failed).html


def _summary(documents: Sequence[Mapping[str, Any]], failures: Sequence[_Failed], page: Path) -> RunSummary:
    count, table = len(documents), "diagnosis/summary.j2"
    return RunSummary(
        title="Gap diagnosis",
        sections=rows_of(table, FILTERS.items(), documents=documents, failures=failures),
        verdict=short_answer(documents[0])
        if count == 1 and not failures
        else f"{count} of {count + len(failures)} cases answered",
        report_path=str(page) if documents or failures else None,
    )
