"""A small fast run, made once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.workflow.command import FAST_ARM
from workflow.figures.style import Picture
from workflow.report import rendering
from workflow.tasks.summary import RunSummary


@pytest.fixture(scope="session")
def fast_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunSummary]:
    """Directory and summary of the fast arm's run."""
    from workflow.commands.run import run_from_files

    out = tmp_path_factory.mktemp("fast") / "run"
    return out, run_from_files(FAST_ARM, out)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are built but not rendered: what a page says does not depend on its pictures."""
    nothing = {"axes": [], "cuts": [], "legend": [], "width": 1, "height": 1}
    empty = Picture("svg", b"<svg/>", nothing)
    monkeypatch.setattr(rendering, "render", lambda figure, also: empty)
