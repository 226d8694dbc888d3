"""Spoilt files are refused in one short line that names the file, or they are read: never an internal error,
never a wait. What would compute is cut off where it begins."""

import contextlib
import io
import json
import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace as with_fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import workflow.commands.design
import workflow.commands.identify
import workflow.tasks.design_source
import workflow.tasks.simulated_rig
from control_design.controllers.controller import Controller
from tests.ident.mutations import DAMAGE, Tally, tally
from tests.ident.test_forty_logs import LOGS, Log
from tests.workflow import test_design_sources as sources
from tests.workflow.command import (
    FAST_ARM,
    ROOT,
    build_nothing,
    draw_nothing,
    perform_stages,
    without_progress,
)
from tests.workflow.diagnosis_examples import FRICTION, write_case
from tests.workflow.mutations import spoilt, tamper
from tests.workflow.study_examples import SMALL_STUDY, TWO_POINTS, write_study
from tests.workflow.test_cli import good_table, write_case as write_own
from workflow.cli import main
from workflow.engine.executor import LocalProcesses, ThisProcess
from workflow.tasks.stages import ONE_LOOP

TINY_SIMULATION = """
[run]
name = "tiny"
[source]
kind = "simulated"
rig = "rig.toml"
encoder_step_rad = 0.0003
[[source.effects]]
name = "coulomb_friction"
torque_Nm = 0.02
[[source.records]]
name = "prbs"
excitation = { kind = "prbs", amplitude_V = 6.0, samples = 60, hold_samples = 4 }
[[source.records]]
name = "sines"
excitation = { kind = "multisine", rms_V = 2.0, period_samples = 50, from_Hz = 4.0, to_Hz = 90.0 }
[[source.records]]
name = "sweep"
excitation = { kind = "log_chirp", amplitude_V = 2.0, samples = 50, from_Hz = 4.0, to_Hz = 90.0 }
"""


class ComputesError(BaseException):
    """The input was taken: here the computation would begin."""


def _computes(*_: object, **__: object) -> None:
    raise ComputesError


@dataclass(frozen=True)
class Kind:
    """Files that are good, and the command that reads them: of one folder, one file of which is spoilt."""

    folder: Path
    spoil: tuple[str, ...]
    call: Callable[[Path], list[str]]


def _own(folder: Path) -> list[str]:
    return ["run", "--config", f"{folder / 'own.toml'}", "--out", f"{folder / 'out'}"]


def _design(source: str, folder: Path) -> list[str]:
    return ["design", str(folder / source), "--spec", str(folder / "wish.toml")]


def good_files(folder: Path) -> dict[str, Kind]:
    for name in ("run", "own", "simulate", "study", "design", "frf", "case"):
        (folder / name).mkdir()
    for name in ("default_arm", "own_log"):
        text = (ROOT / "examples" / f"{name}.toml").read_text().replace('"logs', '"own/logs')
        (folder / "run" / f"{name}.toml").write_text(text)
    (folder / "run" / "fast_arm.toml").write_text(FAST_ARM.read_text())
    write_own(folder / "own", good_table(), more="[reference_filter]\ncorner_rad_s = 3.0\n")
    from plant.presets import paper_link

    (folder / "simulate" / "rig.toml").write_text(paper_link().to_toml())
    (folder / "simulate" / "tiny.toml").write_text(TINY_SIMULATION)
    (folder / "study" / "study.toml").write_text(SMALL_STUDY)
    uncertain = "[plant]\ndt_s = 0.05\n[uncertainty]\nmultiplicative = 0.1\n"
    (folder / "design" / "wish.toml").write_text(sources.WISH + uncertain + sources.QUICK)
    (folder / "design" / "arm.json").write_text(json.dumps(sources.document(sources.arm()), indent=1))
    (folder / "design" / "model.json").write_text(sources.model_file().to_json())
    (folder / "frf" / "wish.toml").write_text(
        sources.WISH + '[plant]\ndt_s = 0.05\nnominal = "arm.json"\n' + sources.QUICK
    )
    (folder / "frf" / "arm.json").write_text(json.dumps(sources.document(sources.arm()), indent=1))
    sources.write_response(folder / "frf" / "response.csv")
    sources.write_repeats(folder / "frf" / "repeats.csv")
    write_case(folder / "case" / "c", {"name": "coulomb_friction", "torque_Nm": 0.05})

    def run(name: str) -> Callable[[Path], list[str]]:
        return lambda place: ["run", "--config", str(place / name), "--out", str(place / "out")]

    run_folder = folder / "run"
    return {
        **{name: Kind(run_folder, (name,), run(name)) for name in ("default_arm.toml", "fast_arm.toml")},
        "own.toml": Kind(folder / "own", ("own.toml",), _own),
        "simulation and rig": Kind(
            folder / "simulate",
            ("tiny.toml", "rig.toml"),
            lambda place: ["simulate", "--config", str(place / "tiny.toml"), "--out", str(place / "out")],
        ),
        "study": Kind(
            folder / "study",
            ("study.toml",),
            lambda place: ["study", "--config", str(place / "study.toml"), "--out", str(place / "out")],
        ),
        "state space": Kind(folder / "design", ("arm.json", "wish.toml"), partial(_design, "arm.json")),
        "model": Kind(folder / "design", ("model.json",), partial(_design, "model.json")),
        "response": Kind(
            folder / "frf", ("response.csv", "wish.toml", "arm.json"), partial(_design, "response.csv")
        ),
        "repeats": Kind(folder / "frf", ("repeats.csv",), partial(_design, "repeats.csv")),
        "case and rig": Kind(
            folder / "case",
            ("c/case.toml", "c/rig.toml"),
            lambda place: ["diagnose", str(place / "c"), "--out", str(place / "out")],
        ),
    }


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Kind]:
    return good_files(tmp_path_factory.mktemp("good"))


@pytest.fixture
def cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    cut_computations_off(monkeypatch)


def cut_computations_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is computed: what was given has been taken once a command gets that far."""
    idle = [with_fields(stage, run=_computes) for stage in ONE_LOOP.stages]
    perform_stages(monkeypatch, idle)
    monkeypatch.setattr(workflow.commands.design, "_design", _computes)
    monkeypatch.setattr(workflow.commands.identify, "identify_logs", _computes)
    monkeypatch.setattr(workflow.tasks.design_source, "identify_frf", _computes)
    simulate = workflow.tasks.simulated_rig.simulate
    monkeypatch.setattr(
        workflow.tasks.simulated_rig,
        "simulate",
        lambda rig, voltage, *a, **k: simulate(rig, voltage, *a, **k) if len(voltage) < 2000 else _computes(),
    )
    for executor in (LocalProcesses, ThisProcess):
        monkeypatch.setattr(executor, "run", _computes)


def refusal(arguments: list[str], folder: Path) -> str | None:
    """The line that a command is refused with, or None where it takes what is given."""
    error = io.StringIO()
    with (
        contextlib.redirect_stderr(error),
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        try:
            code = main(arguments)
        except ComputesError:
            return None
    line = without_progress(error.getvalue()).removesuffix("\n").removeprefix("flexlink: ")
    assert code in (0, 2, 3), f"exit {code}: {line}"
    assert code != 2 or str(folder) in line, f"no file named: {line}"
    return line if code == 2 else None


# A fault that one damage in forty (of a directory: in twenty) shows is found with 95 % by all of a kind, as
# `make test-long` tries them; CI tries a third of them, `make test` the first.
THOROUGH = [False, pytest.param(True, marks=pytest.mark.long)]


@pytest.fixture
def few(pytestconfig: pytest.Config) -> bool:
    """`make test`, which leaves out what is slow, tries the first of all."""
    return "not slow" in pytestconfig.option.markexpr


KINDS = (
    *("default_arm.toml", "fast_arm.toml", "own.toml", "simulation and rig", "study", "state space", "model"),
    *("response", "repeats", "case and rig"),
)


def spoilt_files(one: Kind, number: int, folder: Path, count: int) -> Tally:
    def attempt(rng: np.random.Generator) -> str | None:
        place = folder / "place"
        shutil.copytree(one.folder, place)
        try:
            name = one.spoil[int(rng.integers(len(one.spoil)))]
            (place / name).write_bytes(spoilt(rng, (place / name).read_text()))
            return refusal(one.call(place), place)
        finally:
            shutil.rmtree(place)

    return tally(attempt, count, number)


Call = Callable[[Path], list[str]]


@dataclass(frozen=True)
class Output:
    """A directory that a command left, what reads it again, and those files of it that come out the same;
    drawn: the run in it that a call draws which compares no files."""

    whole: Path
    calls: tuple[Call, ...]
    same: tuple[str, ...] = ()
    drawn: str = ""


def run_output(run: Path) -> Output:
    return Output(
        run, (lambda place: ["run", "--out", str(place), "--resume"], lambda place: ["report", str(place)])
    )


def outputs_replayed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Output]:
    """A study and a diagnosis of two cases; from then on every task ends at once as it did there."""
    kept: dict[str, Any] = {}
    compute = LocalProcesses.run

    def name(task: Any) -> str:
        points = getattr(task, "points", None)
        return task.name if points is None else f"{task.stages} of {points[0].name}"

    def keep(self: LocalProcesses, tasks: Sequence[Any], watch: Any = None) -> Iterator[tuple[int, Any]]:
        for index, found in compute(self, tasks, watch):
            kept[name(tasks[index])] = found
            yield index, found

    def replay(self: LocalProcesses, tasks: Sequence[Any], watch: Any = None) -> Iterator[tuple[int, Any]]:
        yield from ((index, kept[name(task)]) for index, task in enumerate(tasks))

    study = ["study", "--config", str(write_study(folder, TWO_POINTS)), "--out"]
    cases = [write_case(folder / "still"), write_case(folder / "sticking", FRICTION)]
    diagnosis = ["diagnose", *map(str, cases), "--no-controller", "--out"]
    monkeypatch.setattr(LocalProcesses, "run", keep)
    for call in (study, diagnosis):
        assert refusal([*call, str(folder / call[0])], folder) is None
    monkeypatch.setattr(LocalProcesses, "run", replay)

    def again(call: list[str]) -> Call:
        return lambda place: [*call, str(place), "--resume"]

    def point(place: Path) -> list[str]:
        return ["report", str(place / "points" / "1")]

    others = {"diagnose.json", "timings.json", "lock"}
    answers = sorted({path.name for path in (folder / "diagnose").iterdir()} - others)
    return {
        "study": Output(
            folder / "study", (again(study), point), ("table.csv", "table.json", "study.html"), "points/1"
        ),
        "diagnose": Output(folder / "diagnose", (again(diagnosis),), tuple(answers)),
    }


def _drawn_from(folder: Path) -> dict[Path, bytes]:
    """What the pictures of a run are made of: its numbers and its configuration."""
    made_of = [path for path in folder.rglob("*") if path.is_file()]
    made_of = [path for path in made_of if path.parent.name == "stages" or path.stem == "config"]
    return {path.relative_to(folder): path.read_bytes() for path in made_of}


def tampered(one: Output, folder: Path, count: int, number: int) -> Tally:
    """Its calls on the directory tampered with: refused, or the first ends with the same files.

    Pictures are not rendered. Those of untouched numbers are the same every time: they are drawn where files
    of the directory are compared, and wherever a number or the configuration was touched.
    """
    whole = _drawn_from(one.whole / one.drawn)

    def attempt(rng: np.random.Generator) -> str | None:
        place = folder / "place"
        shutil.copytree(one.whole, place, symlinks=True)
        try:
            tamper(rng, place)
            call = int(rng.integers(len(one.calls)))
            with pytest.MonkeyPatch.context() as patch:
                if (call > 0 or not one.same) and _drawn_from(place / one.drawn) == whole:
                    build_nothing(patch)
                line = refusal(one.calls[call](place), place)
            if line is None and call == 0:
                for name in one.same:
                    assert (place / name).read_bytes() == (one.whole / name).read_bytes(), f"{name} differs"
            return line
        finally:
            shutil.rmtree(place)

    return tally(attempt, count, number)


def damaged_logs(damage: str, folder: Path, count: int, *, binary: float = 0.4) -> Tally:
    """Logs of every kind, damaged, as `look` and `identify` meet them; binary: share of those that take a
    process of their own, where a file can do most."""
    texts = [log for log in LOGS.values() if not log.refused and Path(log.file).suffix not in CHILDREN]
    others = [log for log in LOGS.values() if not log.refused and Path(log.file).suffix in CHILDREN]
    rows = [{"t_s": 0.01 * k, "u_V": k % 3, "y_rad": 0.1 * k, "more": [k, {"on": True}]} for k in range(60)]
    json_logs = {"a.json": json.dumps(rows), "a.jsonl": "\n".join(map(json.dumps, rows))}
    whole = {
        True: [(log.file, _content(log)) for log in others],
        False: [(log.file, _content(log)) for log in texts],
    }
    whole[False] += [(name, text.encode()) for name, text in json_logs.items()] * 2

    def attempt(rng: np.random.Generator) -> str | None:
        (name, one), (_, other) = (
            some[int(rng.integers(len(some)))]
            for some in (whole[bool(rng.random() < binary)], whole[bool(rng.random() < 0.5)])
        )
        path = folder / name
        path.write_bytes(DAMAGE[damage](rng, one, other))
        try:
            return refusal([str(rng.choice(["look", "identify"])), str(path)], folder)
        finally:
            path.unlink()

    return tally(attempt, count, list(DAMAGE).index(damage), 4700)


CHILDREN = (".xlsx", ".parquet", ".h5", ".mcap", ".bag", ".db3")


def _content(log: Log) -> bytes:
    return log.content if isinstance(log.content, bytes) else log.content()


def spoilt_controllers(count: int) -> Tally:
    """As a library call, which says ValueError."""
    system = sources.arm()
    laws = (
        Controller.proportional(2.0, 0.01, input_limit=3.0),
        Controller(system.A, system.B, system.C, system.D, 0.05, input_limit=3.0),
    )

    def attempt(rng: np.random.Generator) -> str | None:
        try:
            Controller.from_json(spoilt(rng, laws[int(rng.integers(2))].to_json()).decode("utf-8", "replace"))
        except ValueError as error:
            return str(error)
        return None

    return tally(attempt, count, 98)


@pytest.mark.parametrize("thorough", THOROUGH, ids=["", "thorough"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("cut_off")
def test_spoilt_files_are_refused_or_taken(kinds, tmp_path, kind, few, thorough):
    count = 120 if thorough else 12 if few else 40
    assert spoilt_files(kinds[kind], KINDS.index(kind), tmp_path, count).wrong == []


@pytest.mark.parametrize("thorough", THOROUGH, ids=["", "thorough"])
@pytest.mark.usefixtures("cut_off", "undrawn")
def test_tampered_run_directories(fast_run, tmp_path, few, thorough):
    count = 60 if thorough else 8 if few else 20
    assert tampered(run_output(fast_run[0]), tmp_path, count, 99).wrong == []


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Output], Any]:
    with pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch)
        return outputs_replayed(tmp_path_factory.mktemp("outputs"), patch), LocalProcesses.run


@pytest.mark.long
@pytest.mark.usefixtures("undrawn")
def test_tampered_studies_and_diagnoses(replayed, tmp_path, monkeypatch):
    outputs, replay = replayed
    monkeypatch.setattr(LocalProcesses, "run", replay)
    for number, one in enumerate(outputs.values(), 96):
        assert tampered(one, tmp_path, 60, number).wrong == []


# Bytes of a text, a packed file, two files in one, none, another encoding: the other damages go the same ways
# through the readers.
USUAL = ("bytes changed", "in a zip", "spliced", "empty", "as UTF-16")


@pytest.mark.parametrize(
    "damage",
    [damage if damage in USUAL else pytest.param(damage, marks=pytest.mark.long) for damage in DAMAGE],
)
@pytest.mark.usefixtures("cut_off")
def test_damaged_logs(tmp_path, damage, few):
    assert damaged_logs(damage, tmp_path, 2 if few else 5, binary=0.2).wrong == []


@pytest.mark.parametrize("thorough", THOROUGH, ids=["", "thorough"])
def test_spoilt_controllers(few, thorough):
    assert spoilt_controllers(1000 if thorough else 50 if few else 200).wrong == []


@pytest.mark.parametrize(
    ("good", "bad", "words"),
    [
        ('"dt_s": 0.01', '"dt_s": true', "dt_s: expected float, got True"),
        ('"input_limit": 3.0', '"input_limit": false', "input_limit: expected"),
        ('"D": [', '"D": [true, ', "D: expected an array of numbers, got"),
        ('"dt_s": 0.01', '"dt_s": 0.01, "dt_s": 0.02', "'dt_s' is there twice in one object"),
    ],
)
def test_true_is_no_number_and_no_name_is_there_twice(good, bad, words):
    text = Controller.proportional(2.0, 0.01, input_limit=3.0).to_json()
    assert good in text
    with pytest.raises(ValueError, match=re.escape(words)):
        Controller.from_json(text.replace(good, bad, 1))
