"""Spoilt files are refused in one short line that names the file, or they are read: never an internal error,
never a wait. What would compute is cut off where it begins."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import signal
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from dataclasses import replace as with_fields
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import workflow.commands.designed
import workflow.diagnose.command
import workflow.study.work
import workflow.tasks.design_source
import workflow.tasks.pipeline
import workflow.tasks.simulated_rig
from control_design.controllers.controller import Controller
from tests.workflow.command import FAST_ARM, ROOT
from tests.workflow.diagnosis_examples import write_case
from tests.workflow.mutations import spoilt, tamper
from tests.workflow.study_examples import SMALL_STUDY
from tests.workflow.test_cli import good_table
from tests.workflow.test_cli import write_case as write_own
from tests.workflow.test_design_sources import (
    QUICK,
    WISH,
    arm,
    document,
    model_file,
    write_repeats,
    write_response,
)
from workflow.cli import main

LONGEST_LINE = 300
LONGEST_WAIT_S = 20.0
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


def _kinds(folder: Path) -> dict[str, Kind]:
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
    (folder / "design" / "wish.toml").write_text(WISH + uncertain + QUICK)
    (folder / "design" / "arm.json").write_text(json.dumps(document(arm()), indent=1))
    (folder / "design" / "model.json").write_text(model_file().to_json())
    (folder / "frf" / "wish.toml").write_text(WISH + '[plant]\ndt_s = 0.05\nnominal = "arm.json"\n' + QUICK)
    (folder / "frf" / "arm.json").write_text(json.dumps(document(arm()), indent=1))
    write_response(folder / "frf" / "response.csv")
    write_repeats(folder / "frf" / "repeats.csv")
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
    return _kinds(tmp_path_factory.mktemp("good"))


@pytest.fixture
def cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is computed: what was given has been taken once a command gets that far."""
    idle = [with_fields(stage, run=_computes) for stage in workflow.tasks.pipeline.STAGES]
    monkeypatch.setattr(workflow.tasks.pipeline, "STAGES", tuple(idle))
    monkeypatch.setattr(workflow.commands.designed, "_design", _computes)
    monkeypatch.setattr(workflow.tasks.design_source, "identify_frf", _computes)
    simulate = workflow.tasks.simulated_rig.simulate
    monkeypatch.setattr(
        workflow.tasks.simulated_rig,
        "simulate",
        lambda rig, voltage, *a, **k: simulate(rig, voltage, *a, **k) if len(voltage) < 2000 else _computes(),
    )
    monkeypatch.setattr(workflow.study.work._Work, "make_base_plant", _computes)
    monkeypatch.setattr(workflow.diagnose.command, "_compute", _computes)


@contextlib.contextmanager
def _at_most(seconds: float) -> Iterator[None]:
    def late(*_: object) -> None:
        raise TimeoutError(f"no answer within {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def outcome(arguments: list[str], named: tuple[str, ...]) -> tuple[str, str]:
    """'taken' or 'refused', and the line; 'BAD ...' for anything else."""
    error = io.StringIO()
    with (
        contextlib.redirect_stderr(error),
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        try:
            with _at_most(LONGEST_WAIT_S):
                code = main(arguments)
        except ComputesError:
            return "taken", ""
    line = error.getvalue()
    if code in (0, 3):
        return "taken", line
    if code != 2:
        return f"BAD exit {code}", line
    if line.count("\n") != 1 or len(line) > LONGEST_LINE + len("flexlink: \n"):
        return f"BAD length {len(line)}", line
    if not any(name in line for name in named):
        return "BAD no file named", line
    return "refused", line


FEW_AND_ALL = pytest.mark.parametrize("amount", ["few", pytest.param("all", marks=pytest.mark.slow)])


def _report(found: Counter[str], bad: list[tuple[int, str, str]]) -> None:
    sys.__stdout__.write(f"\n{dict(found)}\n") if sys.__stdout__ is not None else None
    assert not bad, "\n".join(f"seed {seed}: {what}: {line[:400]!r}" for seed, what, line in bad[:20])


KINDS = (
    *("default_arm.toml", "fast_arm.toml", "own.toml", "simulation and rig", "study", "state space", "model"),
    *("response", "repeats", "case and rig"),
)


@FEW_AND_ALL
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("cut_off")
def test_spoilt_files_are_refused_or_taken(kinds, tmp_path, kind, amount):
    one, found, bad = kinds[kind], Counter[str](), list[tuple[int, str, str]]()
    for seed in range(12 if amount == "few" else 850):
        rng = np.random.default_rng([seed, KINDS.index(kind)])
        place = tmp_path / str(seed)
        shutil.copytree(one.folder, place)
        name = one.spoil[seed % len(one.spoil)]
        (place / name).write_bytes(spoilt(rng, (place / name).read_text()))
        what, line = outcome(one.call(place), (str(place),))
        found[what] += 1
        if what.startswith("BAD"):
            bad.append((seed, what, line))
        shutil.rmtree(place)
    _report(found, bad)


@FEW_AND_ALL
@pytest.mark.usefixtures("cut_off", "undrawn")
def test_tampered_run_directories(fast_run, tmp_path, amount):
    """`report` and `run --resume` on them."""
    found, bad = Counter[str](), list[tuple[int, str, str]]()
    for seed in range(8 if amount == "few" else 500):
        rng = np.random.default_rng([seed, 99])
        place = tmp_path / str(seed)
        shutil.copytree(fast_run[0], place)
        what_was_done = tamper(rng, place)
        command = ["report", str(place)] if seed % 2 else ["run", "--out", str(place), "--resume"]
        what, line = outcome(command, (str(place),))
        found[what] += 1
        if what.startswith("BAD"):
            bad.append((seed, f"{what_was_done} {command[0]} {what}", line))
        shutil.rmtree(place)
    _report(found, bad)


@FEW_AND_ALL
def test_spoilt_controllers(amount):
    """As a library call, which says ValueError."""
    text = Controller.proportional(2.0, 0.01, input_limit=3.0).to_json()
    system = arm()
    second = Controller(system.A, system.B, system.C, system.D, 0.05, input_limit=3.0).to_json()
    for seed in range(50 if amount == "few" else 1000):
        rng = np.random.default_rng([seed, 98])
        content = spoilt(rng, (text, second)[seed % 2]).decode("utf-8", "replace")
        with contextlib.suppress(ValueError), _short_complaint():
            Controller.from_json(content)


@contextlib.contextmanager
def _short_complaint() -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        if len(str(error)) > LONGEST_LINE:
            raise AssertionError(str(error)[:400]) from error
        raise
