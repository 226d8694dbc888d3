"""Progress and tables on a terminal (rich); everything goes to standard error unless a table is asked for."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Column, Table

from workflow.engine import progress
from workflow.engine.errors import printable

if TYPE_CHECKING:
    from workflow.tasks.summary import RunSummary


LINE_EVERY_S = 10.0


class TerminalProgress(progress.Progress):
    """Progress with remaining time on standard error: a bar, or, where that is no terminal, a line every ten
    seconds; nothing with `quiet`. Use as a context manager."""

    def __init__(self, *, quiet: bool = False) -> None:
        console = Console(stderr=True)
        self._lines = not quiet and not console.is_terminal
        self._doing, self._share, self._began_s = "", 0.0, time.monotonic()
        self._over = threading.Event()
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis")),
            BarColumn(bar_width=30),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeRemainingColumn(compact=True),
            console=console,
            transient=True,
            disable=quiet or not console.is_terminal,
        )
        self._task: TaskID | None = None
        self._expected: dict[str, float] = {}
        self._done_s = 0.0

    def __enter__(self) -> Self:
        self._bar.start()
        if self._lines:
            threading.Thread(target=self._tell, daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._bar.stop()

    def _tell(self) -> None:
        while not self._over.wait(LINE_EVERY_S):
            spent_s = time.monotonic() - self._began_s
            line = f"flexlink: {spent_s:.0f} s: {printable(self._doing) or 'starting'}"
            if self._share > 0.02:  # less says nothing about the whole
                left_s = spent_s * (1 - self._share) / self._share
                line += f" ({100 * self._share:.0f} %, about {left_s:.0f} s left)"
            print(line, file=sys.stderr, flush=True)  # noqa: T201

    def plan(self, stages: Sequence[tuple[str, float]]) -> None:
        self._expected = dict(stages)
        self._task = self._bar.add_task("", total=sum(self._expected.values()) or 1.0)

    def start(self, stage: str) -> None:
        self.update(stage, 0.0)

    def update(self, stage: str, fraction: float, message: str = "") -> None:
        if self._task is not None:
            done = self._done_s + min(max(fraction, 0.0), 1.0) * self._expected.get(stage, 0.0)
            total = sum(self._expected.values()) or 1.0
            self._doing, self._share = f"{stage}: {message}" if message else stage, done / total
            self._bar.update(self._task, completed=done, total=total, description=escape(self._doing))

    def finish(self, stage: str, seconds: float, *, taken_up: bool) -> None:
        if taken_up:
            self._expected[stage] = 0.0  # it says nothing about the speed of this run
        self._done_s += self._expected.get(stage, 0.0)
        if not self._bar.disable:
            words = "taken up from the earlier run" if taken_up else f"{seconds:.1f} s"
            self._bar.console.print(f"  {escape(stage):<12} {words}", highlight=False)


class _Output(Console):
    """Standard output; a reader that left is the caller's business (rich would leave with code 1)."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def print_summary(summary: RunSummary) -> None:
    """The table of numbers on standard output."""
    # A pipe has no width; 120 columns keep the rows on one line there.
    console = _Output(file=sys.stdout, width=None if sys.stdout.isatty() else 120)
    table = Table(title=_text(summary.title), title_justify="left", show_header=False, pad_edge=False)
    table.add_column("section", style="bold")
    table.add_column("quantity")
    table.add_column("value")
    for section in summary.sections:
        for index, row in enumerate(section.rows):
            label = _text(section.title) if index == 0 else ""
            table.add_row(
                label, _text(row.label), _text(row.value), end_section=index == len(section.rows) - 1
            )
    console.print(table)
    console.print(_text(summary.verdict), highlight=False, soft_wrap=True)
    if summary.report_path:
        console.print(f"report: {_text(summary.report_path)}", highlight=False, soft_wrap=True)


def _text(words: str) -> str:
    """Words from files and configurations, with neither rich's markup nor the terminal's own codes."""
    return escape(printable(words))
