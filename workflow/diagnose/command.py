"""What `flexlink diagnose` does: cases in; answers, pages, repaired rigs and an overview out."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from workflow.diagnose.case_files import LoadedCase, load_case, refuse_equal_names
from workflow.diagnose.directory import DiagnosisDirectory, diagnosis_digest
from workflow.diagnose.document import json_text
from workflow.diagnose.outputs import Engine, Options, made_from
from workflow.diagnose.overview import closure_words, overview_page, short_answer
from workflow.diagnose.processes import Finished, Work
from workflow.diagnose.words import parameter_words, probability_words, times_noise
from workflow.engine.errors import (
    EXIT_BAD_INPUT,
    EXIT_INTERNAL,
    EXIT_NOT_CERTIFIED,
    EXIT_OK,
    InputError,
    StageError,
    one_line,
)
from workflow.engine.executor import LocalProcesses
from workflow.engine.progress import Progress, Silence
from workflow.tasks.summary import Row, RunSummary, Section
from workflow.text.formats import listing

_CASE_S, _OVERVIEW_S = 30.0, 1.0  # expected: they shape the progress bar only


@dataclass(frozen=True)
class Failure:
    """A case without an answer."""

    case: str
    reason: str
    bad_input: bool


@dataclass(frozen=True, eq=False)
class DiagnosisRun:
    """What a call left behind: the JSON answers in the order asked for, what failed, and the exit code."""

    documents: tuple[Mapping[str, Any], ...]
    failures: tuple[Failure, ...]
    summary: RunSummary

    @property
    def exit_code(self) -> int:
        """Internal error over bad input over a fit that did not converge over success."""
        if any(not failure.bad_input for failure in self.failures):
            return EXIT_INTERNAL
        if self.failures:
            return EXIT_BAD_INPUT
        unsure = any(document["detail_verdict"] == "not_converged" for document in self.documents)
        return EXIT_NOT_CERTIFIED if unsure else EXIT_OK

    def complaints(self) -> list[str]:
        """One line for every case that failed or whose fit did not converge."""
        lines = [f"{failure.case}: {one_line(failure.reason)}" for failure in self.failures]
        return lines + [
            f"{document['case']}: the fit did not converge, no cause is named"
            for document in self.documents
            if document["detail_verdict"] == "not_converged"
        ]

    def to_document(self) -> dict[str, Any]:
        return {
            "cases": list(self.documents),
            "failed": [{"case": failure.case, "reason": failure.reason} for failure in self.failures],
            "report": self.summary.report_path,
        }


def diagnose_cases(
    places: Sequence[Path],
    out: Path,
    *,
    rig: str | None = None,
    jobs: int | None = None,
    resume: bool = False,
    replace: bool = False,
    controller: bool = True,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> DiagnosisRun:
    """Diagnose every case into `out`.

    rig: file in each case folder that is read in place of the one its case file names. jobs: processes
    (default: one per processor). A case that fails does not lose the others; one that fails alone raises
    InputError or StageError. Raises InputError (one line, nothing written) if no case can be read, two have
    one name, or `out` cannot be used.
    """
    progress = progress or Silence()
    if jobs is not None and jobs < 1:
        raise InputError(f"--jobs must be at least 1, got {jobs}")
    if resume and replace:
        raise InputError(
            "--resume and --replace contradict each other: continue the diagnosis or start it afresh"
        )
    loaded, unreadable = _load(places, rig)
    options, code = Options(controller), diagnosis_digest()
    directory = DiagnosisDirectory.begin(
        out,
        inputs={one.case.name: one.input_sha256 for one in loaded},
        options=options.document(),
        resume=resume,
        replace=replace,
    )
    with directory.locked():
        documents, failures = _compute(
            directory, loaded, options, code, engine or Engine(), jobs or os.cpu_count() or 1, progress
        )
        failures = [*unreadable, *failures]
        if len(places) == 1 and failures:
            directory.discard_if_empty()
            raise (InputError if failures[0].bad_input else StageError)(failures[0].reason)
        page = out / f"{loaded[0].case.name}.html"
        if len(places) > 1:
            page = out / "index.html"
            progress.start("overview")
            reasons = {failure.case: failure.reason for failure in failures}
            directory.write("index.html", overview_page(documents, reasons).encode())
            progress.finish("overview", 0.0, taken_up=False)
    return DiagnosisRun(tuple(documents), tuple(failures), _summary(documents, failures, page))


def _load(places: Sequence[Path], rig: str | None) -> tuple[list[LoadedCase], list[Failure]]:
    loaded, failures = [], []
    for place in places:
        try:
            loaded.append(load_case(place, rig))
        except InputError as error:
            failures.append(Failure(place.resolve().name, str(error), bad_input=True))
    if not loaded:
        more = f" (and {len(failures) - 1} more cases cannot be read)" if len(failures) > 1 else ""
        raise InputError(failures[0].reason + more)
    refuse_equal_names([one.case.name for one in loaded])
    return loaded, failures


def _compute(
    directory: DiagnosisDirectory,
    loaded: Sequence[LoadedCase],
    options: Options,
    code: str,
    engine: Engine,
    jobs: int,
    progress: Progress,
) -> tuple[list[dict[str, Any]], list[Failure]]:
    answers: dict[str, dict[str, Any]] = {}
    for one in loaded:
        known = directory.finished(one.case.name, made_from(one, options, code))
        if known is not None:
            answers[one.case.name] = known
    todo = [one for one in loaded if one.case.name not in answers]
    width = max(1, min(jobs, len(todo)))
    several = len(loaded) > 1
    progress.plan(
        [("cases", _CASE_S * len(todo) / width), *((("overview", _OVERVIEW_S),) if several else ())]
    )
    progress.start("cases")
    started = time.monotonic()
    shares = dict.fromkeys(range(len(todo)), 0.0)
    timings = directory.timings()
    failures: list[Failure] = []

    def watch(index: int, fraction: float, message: str) -> None:
        shares[index] = fraction
        name = todo[index].case.name
        done = len(loaded) - len(todo) + sum(share >= 1.0 for share in shares.values())
        words = f"{done} of {len(loaded)} done, {name}: {message}" if several else message
        progress.update("cases", sum(shares.values()) / len(todo), words)

    work = [Work(one, options, code, engine) for one in todo]
    processes = LocalProcesses(width, preload=["workflow.diagnose.processes"])
    for index, finished in processes.run(work, watch):
        name = todo[index].case.name
        if finished.failure is not None:
            failures.append(Failure(name, finished.failure, finished.bad_input))
        else:
            directory.save(name, finished.files)
            answers[name] = json.loads(finished.files[f"{name}.json"])
            timings[name] = _timing(finished)
            directory.write("timings.json", json_text(timings).encode())
        watch(index, 1.0, "done")
    progress.finish("cases", time.monotonic() - started, taken_up=not todo)
    order = [one.case.name for one in loaded]
    failures.sort(key=lambda failure: order.index(failure.case))
    return [answers[name] for name in order if name in answers], failures


def _timing(finished: Finished) -> dict[str, float]:
    return {"cpu_s": round(finished.cpu_s, 3)}


def _summary(documents: Sequence[Mapping[str, Any]], failures: Sequence[Failure], page: Path) -> RunSummary:
    sections = [Section(str(document["case"]), tuple(_rows(document))) for document in documents]
    sections += [Section(f.case, (Row("failed", one_line(f.reason)),)) for f in failures]
    answers = len(documents)
    return RunSummary(
        title="Gap diagnosis",
        sections=tuple(sections),
        verdict=short_answer(documents[0])
        if answers == 1 and not failures
        else f"{answers} of {answers + len(failures)} cases answered",
        report_path=str(page) if documents or failures else None,
    )


def _rows(document: Mapping[str, Any]) -> list[Row]:
    sure = probability_words(document["probability"])
    rows = [Row("answer", f"{short_answer(document)}, {sure}")]
    for effect in document["effects"]:
        if effect["name"] in document["combination"]:
            parts = [
                parameter_words(key, value, effect["intervals"].get(key))
                for key, value in effect["parameters"].items()
            ]
            rows.append(Row(effect["name"], "; ".join(parts)))
    if document["ambiguous_with"]:
        rows.append(Row("could also be", listing(document["ambiguous_with"])))
    gaps = [times_noise(document[key]) for key in ("gap_before", "gap_refit", "gap_after", "noise_floor")]
    rows.append(
        Row(
            "residual / noise",
            f"{gaps[0]} nominal, {gaps[1]} re-estimated, {gaps[2]} with effects, floor {gaps[3]}",
        )
    )
    if document["combination"]:
        rows.append(Row("gap closed", closure_words(document)))
    return rows
