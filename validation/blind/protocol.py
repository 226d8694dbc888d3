"""The whole blind run: cases, seal, diagnosis in processes that cannot see it, opening, scores.

blind.json            number of cases, seed; a resumed run is held to them
cases/<case>/         what a diagnosis sees
seal/                 labels, for the owner only; commitment.json is their salted hash
predictions/<case>.json, predictions.json (hash of each, written before the seal is opened)
scores.json, scores.txt, confusion.png
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from validation.blind.cases import SORTS
from validation.blind.generate import Answer, folder_hash, generate
from validation.blind.report import confusion_figure, summary, text
from validation.blind.scores import GROUPS, scores
from validation.blind.seal import (
    COMMITMENT,
    SEAL_DIRECTORY,
    close_seal,
    has_labels,
    off_disk,
    open_seal,
    private_directory,
    renew_seal,
    write_private,
)
from validation.blind.worker import BlindCase, diagnose_folder, failed
from validation.blind.workshop.cases import SHARES
from validation.blind.workshop.score import FAMILIES
from workflow.describe.summary import RunSummary
from workflow.engine.codec import plain_text
from workflow.engine.errors import InputError
from workflow.engine.executor import Failure, workers
from workflow.engine.progress import Progress
from workflow.engine.storage import read_json, sha256_of_file, write_bytes, write_json, write_text
from workflow.engine.store import Store

# Format of a run; one of another format is not resumed.
_FORMAT = "flexlink-blind-1"
# Expected seconds to make a case: they shape the progress bar only.
_CASE_S = 8.0
# Expected seconds to diagnose it.
_DIAGNOSIS_S = 40.0

Diagnose = Callable[[Path], dict[str, Any]]


class BlindDirectory(Store):
    """A run; what it was begun with stands in the manifest."""

    what = "blind run"
    manifest_name = "blind.json"
    folders = ("cases", "predictions")


def run_blind(
    n_cases: int,
    seed: int,
    out: Path,
    *,
    jobs: int | None = None,
    only: str | None = None,
    workshop: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
    diagnose: Diagnose = diagnose_folder,
) -> RunSummary:
    """Generate, seal, diagnose, open, score.

    Parameters
    ----------
    n_cases, seed : int
        Number of cases, and what they are drawn from.
    out : Path
        Directory of the run.
    jobs : int, optional
        Processes; default: one per processor.
    only : str, optional
        Cases of this sort alone (none, faint, clear, pair, unlisted) in place of the mix.
    workshop : bool
        Imperfectly known machines and awkward logs; their sorts are none, single, pair and unlisted.
    resume : bool
        Go on with the run that is there.
    progress : Progress, optional
    diagnose : callable
        From a case folder to its document; runs in processes that are kept out of the run's directory.

    Raises
    ------
    InputError
        One line: something wrong with what the user gave.
    """
    progress = progress or Progress()
    sorts = [*(SHARES if workshop else SORTS)]
    if only is not None and only not in sorts:
        raise InputError(f"--only must be one of {', '.join(sorts)}; got {only!r}")
    if jobs is not None and jobs < 1:
        raise InputError(f"--jobs must be at least 1, got {jobs}")
    if n_cases < 1 or seed < 0:
        raise InputError(f"--cases must be at least 1 and --seed at least 0; got {n_cases} and {seed}")
    width = jobs or os.cpu_count() or 1
    settings: dict[str, Any] = {"format": _FORMAT, "cases": n_cases, "seed": seed}
    if only:
        settings["only"] = only
    if workshop:
        settings["workshop"] = True
    _begin(BlindDirectory(out), settings, resume)
    progress.plan([("cases", _CASE_S * n_cases / width), ("diagnosis", _DIAGNOSIS_S * n_cases / width)])
    _sealed_cases(out, settings, width, progress)
    names = sorted(path.name for path in (out / "cases").iterdir() if path.is_dir())
    # While cases are diagnosed the labels are in no file.
    with off_disk(out):
        _predict(out, names, width, diagnose, progress)
    predictions = [read_json(out / "predictions" / f"{name}.json") for name in names]
    write_json(
        out / "predictions.json",
        {name: sha256_of_file(out / "predictions" / f"{name}.json") for name in names},
    )

    # The answers stand: now the labels may be read.
    labels = open_seal(out)
    _check_cases(out, labels)
    document = _scored(predictions, labels, FAMILIES if workshop else GROUPS)
    document["commitment"] = read_json(out / COMMITMENT)["sha256"]
    document["settings"] = read_json(out / "blind.json")
    write_text(out / "scores.json", plain_text(document))
    write_text(out / "scores.txt", text(document["diagnosis"], document))
    write_bytes(out / "confusion.png", confusion_figure(document["diagnosis"]))
    return summary(document, out)


def _begin(store: BlindDirectory, settings: Mapping[str, Any], resume: bool) -> None:
    if store.manifest_path.is_file() != resume:
        raise InputError(
            f"{store.path}: "
            + ("no blind run to resume" if resume else "a blind run is there already; --resume continues it")
        )
    store.begin(settings, resume=True)


def _sealed_cases(out: Path, settings: Mapping[str, Any], jobs: int, progress: Progress) -> None:
    """Cases and closed seal; an interrupted generation goes on where it stopped."""
    n_cases = settings["cases"]
    taken_up = (out / COMMITMENT).is_file() and has_labels(out)
    with progress.stage("cases", taken_up=taken_up) as update:
        if taken_up:
            return
        begun = (out / COMMITMENT).is_file()  # and killed while cases were diagnosed
        parts = private_directory(private_directory(out / SEAL_DIRECTORY) / "parts")
        finished: dict[str, Answer] = {path.stem: read_json(path) for path in sorted(parts.glob("*.json"))}
        count = len(finished)

        def keep(answer: Answer) -> None:
            nonlocal count
            write_private(parts / f"{answer['case']}.json", json.dumps(answer) + "\n")
            count += 1
            update(count / n_cases, f"{count} of {n_cases}")

        answers = generate(
            n_cases,
            settings["seed"],
            out / "cases",
            jobs=jobs,
            only=settings.get("only"),
            workshop="workshop" in settings,
            finished=finished,
            keep=keep,
        )
        (renew_seal if begun else close_seal)(out, answers)
        shutil.rmtree(parts)


def _predict(out: Path, names: Sequence[str], jobs: int, diagnose: Diagnose, progress: Progress) -> None:
    """Diagnose every case that has no answer yet, and write its answer."""
    folder = out / "predictions"
    todo = [name for name in names if not (folder / f"{name}.json").is_file()]
    done = len(names) - len(todo)
    work = [BlindCase(out / "cases" / name, out.resolve(), diagnose) for name in todo]
    with (
        workers(jobs, preload=["validation.blind.worker"]) as processes,
        progress.stage("diagnosis", taken_up=not todo) as update,
    ):
        for index, result in processes.run(work):
            document = failed(todo[index], result.reason) if isinstance(result, Failure) else result
            write_json(folder / f"{todo[index]}.json", document)
            done += 1
            update(done / len(names), f"{done} of {len(names)}")


def _check_cases(out: Path, labels: Sequence[Answer]) -> None:
    for label in labels:
        if folder_hash(out / "cases" / label["case"]) != label["sha256"]:
            raise InputError(f"{out}: records of {label['case']} are not those the labels were sealed for")


def _scored(
    predictions: Sequence[Mapping[str, Any]], labels: Sequence[Answer], groups: Mapping[str, str]
) -> dict[str, Any]:
    """Scores of the diagnoses and of the baselines; a method that did not answer a case is wrong there."""
    document: dict[str, Any] = {"diagnosis": scores(predictions, labels, groups), "baselines": {}}
    methods = {name: None for p in predictions for name in p.get("baselines", {})}
    for method in methods:
        answers = [
            p.get("baselines", {}).get(method)
            or {"case": p["case"], "verdict": "failed", "effects": [], "combination": []}
            for p in predictions
        ]
        document["baselines"][method] = scores(answers, labels, groups)
    document["failed"] = {p["case"]: p["reason"] for p in predictions if p["verdict"] == "failed"}
    return document
