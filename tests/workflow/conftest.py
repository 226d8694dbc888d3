"""What is computed once and looked at by many tests; of all workers the first one computes it."""

import fcntl
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.workflow.command import FAST_ARM, build_nothing, draw_nothing
from tests.workflow.study_examples import write_study
from workflow.describe.facts import Quantity, Row, Section
from workflow.describe.summary import RunSummary

MakeOnce = Callable[[str, Callable[[Path], RunSummary | None]], tuple[Path, RunSummary | None]]


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> MakeOnce:
    """make(directory) is called by the first worker that asks for the name; every worker gets a copy of the
    directory of its own, and the summary that came back."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def once(name: str, make: Callable[[Path], RunSummary | None]) -> tuple[Path, RunSummary | None]:
        (kept := base / f"once-{name}").mkdir(exist_ok=True)
        with open(kept / "lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (kept / "value").exists():
                value = make(kept / "out")
                (kept / "value").write_text(json.dumps(None if value is None else _plain(value)))
        out = tmp_path_factory.mktemp(name) / "out"
        shutil.copytree(kept / "out", out, symlinks=True)
        value = json.loads((kept / "value").read_text())
        if value is None:
            return out, None
        tables = [
            Section(title, tuple(Row("", name, Quantity.words(text)) for name, text in rows))
            for title, rows in value.pop("sections")
        ]
        return out, RunSummary(sections=tables, **value)

    return once


def _plain(summary: RunSummary) -> dict[str, Any]:
    """A summary as JSON; its rows without their keys."""
    parts = [part for section in summary.sections for part in section.whole()]
    sections = [(part.title, [(row.name, row.text) for row in part.rows]) for part in parts]
    return {**vars(summary), "sections": sections}


@pytest.fixture(scope="session")
def fast_run(made_once: MakeOnce) -> tuple[Path, RunSummary]:
    """Directory and summary of the fast arm's run."""
    from workflow.commands.run import run_from_files

    return made_once("fast", lambda out: run_from_files(FAST_ARM, out))


@pytest.fixture(scope="session")
def small_study(made_once: MakeOnce) -> tuple[Path, RunSummary]:
    """Directory and summary of the small study, computed on two processes."""
    from workflow.study.settings import load_study
    from workflow.study.work import run_study

    def make(out: Path) -> RunSummary:
        return run_study(load_study(write_study(out.parent)), out, jobs=2)

    return made_once("study", make)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    draw_nothing(monkeypatch)


@pytest.fixture
def unbuilt(undrawn: None, monkeypatch: pytest.MonkeyPatch) -> None:
    build_nothing(monkeypatch)


@pytest.fixture
def unidentified(monkeypatch: pytest.MonkeyPatch) -> None:
    """`flexlink init` writes what it makes of the logs before it identifies them, within a second."""
    # The run is loaded first: it would keep what is put in place here, in whatever test loads it.
    from workflow.commands import init, run as run_command

    assert run_command.decided is init.decided

    def decided(command, logs, file, stated, progress, run):
        return init.drafted(command, logs, file, stated)

    monkeypatch.setattr(init, "decided", decided)
