"""A small fast run, made once; the command line called in this process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.workflow.command import FAST_ARM, Answer
from workflow.cli import main
from workflow.tasks.summary import RunSummary


@pytest.fixture
def flexlink(capfd: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """Call `flexlink` in this process."""

    def call(*arguments: object) -> Answer:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        captured = capfd.readouterr()
        return Answer(code, captured.out, captured.err)

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
def fast_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunSummary]:
    """Directory and summary of the fast arm's run."""
    from workflow.tasks.entry import run_from_files

    out = tmp_path_factory.mktemp("fast") / "run"
    return out, run_from_files(FAST_ARM, out)
