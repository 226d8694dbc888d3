"""A small fast run, made once; helpers to call the command line in this process and in another."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from workflow.cli import main
from workflow.summary import RunSummary

ROOT = Path(__file__).resolve().parents[2]
FAST_ARM = Path(__file__).parent / "data" / "fast_arm.toml"


@dataclass(frozen=True)
class Answer:
    """What a command left behind."""

    code: int
    out: str
    err: str


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
    """Call `flexlink`, insist on exit code 2 with one line on standard error and nothing else, return the line."""

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
    from workflow.entry import run_from_files

    out = tmp_path_factory.mktemp("fast") / "run"
    return out, run_from_files(FAST_ARM, out)


def start_flexlink(*arguments: object) -> subprocess.Popen[bytes]:
    """`flexlink` in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "workflow", *(str(argument) for argument in arguments)],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
