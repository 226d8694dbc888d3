"""A small fast run, made once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.workflow.command import FAST_ARM, draw_nothing
from workflow.text.templates import RunSummary


@pytest.fixture(scope="session")
def fast_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunSummary]:
    """Directory and summary of the fast arm's run."""
    from workflow.commands.run import run_from_files

    out = tmp_path_factory.mktemp("fast") / "run"
    return out, run_from_files(FAST_ARM, out)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    draw_nothing(monkeypatch)
