"""Paths to data that never enters the repository, and the command line called in this process."""

import functools
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import typer.main
from hypothesis import settings

from tests.browser import PROGRAM, Browser, faults_of
from tests.workflow.command import ROOT, Answer, without_progress
from workflow.cli import main

# The same examples on every machine, and no time limit for an example that happens to compile something.
settings.register_profile("flexlink", deadline=None, derandomize=True)
settings.load_profile("flexlink")

_SHARED = Path(__file__).resolve().parents[2] / "shared"


def _folder(variable: str, beside: Path) -> Path | None:
    """The folder an environment variable names, else the one beside the checkout, else None."""
    named = os.environ.get(variable)
    folder = Path(named) if named else beside
    return folder if folder.is_dir() else None


@pytest.fixture(scope="session", autouse=True)
def no_time_lost() -> Iterator[None]:
    """Thousands of calls in this process wait neither for typer to make all commands anew, nor for a disk to
    have everything before it goes on (no test switches the power off)."""
    make = typer.main.get_command
    made = functools.cache(lambda app, _: make(app))
    with pytest.MonkeyPatch.context() as patch:
        # Commands from outside join those that were there.
        patch.setattr(typer.main, "get_command", lambda app: made(app, len(app.registered_commands)))
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(autouse=True)
def no_width_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables are as wide as COLUMNS says, which a terminal or another test may have set."""
    monkeypatch.delenv("COLUMNS", raising=False)


@pytest.fixture(scope="session")
def flexlink_data() -> Path:
    """Folder of measured arms (slfr_krauss_2009, daisy_robot_arm, ...)."""
    folder = _folder("FLEXLINK_DATA", _SHARED / "data")
    if folder is None:
        pytest.skip("measured data not found: set FLEXLINK_DATA to the folder that holds slfr_krauss_2009")
    return folder


@pytest.fixture(scope="session")
def gap_cases() -> Path:
    """Folder of recorded gap cases (labelled/<case>/rig.toml ...)."""
    folder = _folder("FLEXLINK_GAP", _SHARED / "gap")
    if folder is None:
        pytest.skip("gap cases not found: set FLEXLINK_GAP to the folder that holds labelled/")
    return folder


@pytest.fixture
def examples_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a directory with the examples and nothing else, without logs that somebody has made there."""
    examples = tmp_path / "examples"
    shutil.copytree(ROOT / "examples", examples, ignore=shutil.ignore_patterns("logs_of_mine"))
    shutil.rmtree(examples / "logs", ignore_errors=True)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def flexlink(capfd: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """Call `flexlink` in this process."""

    def call(*arguments: object) -> Answer:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        captured = capfd.readouterr()
        return Answer(code, captured.out, without_progress(captured.err))

    return call


@pytest.fixture
def refused(flexlink: Callable[..., Answer]) -> Callable[..., str]:
    """Call `flexlink`, insist on exit code 2 with one line on standard error only, return the line."""

    def call(*arguments: object) -> str:
        answer = flexlink(*arguments)
        assert answer.code == 2, answer
        assert answer.out == ""
        assert answer.err.count("\n") == 1, answer.err
        assert "Traceback" not in answer.err
        return answer.err

    return call


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """One browser for all tests of a worker."""
    if PROGRAM is None:
        pytest.skip("chromium is not installed")
    found = Browser()
    yield found
    found.close()


@pytest.fixture
def faults_seen(request: pytest.FixtureRequest) -> Callable[[Path], list[str]]:
    """What a reader would mind about a page; without a browser nothing (test_pages_in_a_browser.py skips)."""
    if PROGRAM is None:
        return lambda page: []
    browser = request.getfixturevalue("browser")
    return lambda page: faults_of(browser, page)
