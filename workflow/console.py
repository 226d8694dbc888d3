"""Progress and tables on a terminal (rich); everything goes to standard error unless a table is asked for."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn
from rich.table import Column, Table
from rich.text import Text

from workflow.engine import interrupts, progress
from workflow.engine.errors import printable

if TYPE_CHECKING:
    from workflow.describe.facts import Row, Section
    from workflow.describe.summary import RunSummary


# When the first line of progress comes [s], where there is no terminal: as soon as one wonders.
FIRST_LINE_S = 0.4
# Time between lines of progress [s]: a log of an hour's work stays short.
LINE_EVERY_S = 10.0
# What is said before any work is reported.
_STARTING = "starting"
# What is refused in one line is refused by then [s]: no progress is said before it.
_REFUSED_S = 3.0
# Time to compile all kernels that one command needs, the first time [s]. Chosen: it is said, and
# counts in the time left, nothing else.
COMPILING_S = 25.0
# Share of the expected work below which no time left is said: less says nothing about the whole.
_LEAST_SHARE = 0.02
# Width where standard output has none and COLUMNS says none, as in a pipe: rows stay on one line.
_PIPE_COLUMNS = 120
# Width below which a table becomes a list: at 40 three columns leave a value ten letters a line; from 72 on
# they leave it forty.
_LEAST_TABLE_COLUMNS = 72
# Length of the bar of progress: a step of it is three percent.
_BAR_COLUMNS = 30
# The same on a narrow terminal, where the words beside it need the room: at 40 columns they get half.
_SHORT_BAR_COLUMNS = 8
# Indentation of a name in a list, behind its section; more would take room from its value.
_NAME_INDENT = 2
# Indentation of a value below its name.
_VALUE_INDENT = 4
# So much work as expected [s] is taken for granted before the speed of this machine counts.
_PRIOR_S = 10.0


class TerminalProgress(progress.Progress):
    """Progress with remaining time on standard error: a bar, or, where that is no terminal, a line at once
    and every ten seconds; nothing with `quiet`. Use as a context manager."""

    def __init__(self, *, quiet: bool = False) -> None:
        console = Console(stderr=True)
        self._quiet = quiet
        self._lines = not quiet and not console.is_terminal
        self._began_s = time.monotonic()
        self._compiled_s = 0.0
        self._worked_s = 0.0
        self._over = threading.Event()
        self._watching = ExitStack()
        self._teller = threading.Thread(target=self._tell, daemon=True)
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis")),
            BarColumn(
                bar_width=_BAR_COLUMNS if console.width >= _LEAST_TABLE_COLUMNS else _SHORT_BAR_COLUMNS
            ),
            TextColumn("{task.percentage:>3.0f} %{task.fields[left]}"),
            console=console,
            transient=True,
            disable=quiet or not console.is_terminal,
        )
        self._doing = _STARTING
        self._task = self._bar.add_task(_STARTING, total=1.0, left="")
        self._expected: dict[str, float] = {}
        self._done_s = 0.0
        # When work was last reported.
        self._reported_s = self._began_s

    def __enter__(self) -> Self:
        self._bar.start()
        if self._lines:
            self._teller.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        if self._lines:
            # What comes later may have another standard error, or none.
            self._teller.join()
        self._watching.close()
        self._bar.stop()

    def _tell(self) -> None:
        pause_s = FIRST_LINE_S
        while not self._over.wait(pause_s):
            spent_s = time.monotonic() - self._began_s
            if self._doing == _STARTING and spent_s < _REFUSED_S:
                continue
            pause_s = LINE_EVERY_S
            self._say(f"{spent_s:.0f} s: {printable(self._doing)}{self._ahead()}")

    def _say(self, line: str) -> None:
        if self._lines:
            print(f"flexlink: {line}", file=sys.stderr, flush=True)  # noqa: T201
        elif not self._quiet:
            self._bar.console.print(f"  {line}", highlight=False)

    def _ahead(self) -> str:
        """Share done and time left, as of the last report of work: it falls till the next and is unknown
        where that takes longer. What compiled is no sign of slowness, but more of it is to come."""
        total_s = sum(self._expected.values())
        if not total_s or self._worked_s < _LEAST_SHARE * total_s:
            return ""
        # Speed so far: as much work as expected is taken for granted at first, so that it does not jump.
        spent_s = self._reported_s - self._began_s - self._compiled_s
        left_s = (total_s - self._worked_s) * ((spent_s + _PRIOR_S) / (self._worked_s + _PRIOR_S))
        # Kernels are compiled once: what is left of that counts until it is over.
        if self._compiled_s:
            left_s += max(COMPILING_S - self._compiled_s, 0.0)
        left_s -= time.monotonic() - self._reported_s
        share = f"{100 * self._worked_s / total_s:.0f} %"
        return f" ({share}, about {left_s:.0f} s left)" if left_s >= 0.0 else f" ({share})"

    def _watch_compiler(self) -> None:
        """Compiling is told when it begins, and its time kept apart."""
        from numba.core import event

        class Watch(event.Listener):
            # A kernel compiles those that it calls: only the outermost is timed.
            depth = 0
            began_s = 0.0

            def on_start(watch, event: object) -> None:  # noqa: N805
                if watch.depth == 0:
                    watch.began_s = time.monotonic()
                    if not self._compiled_s:
                        self._say(f"compiling, once after installing (about {COMPILING_S:.0f} s in all)")
                watch.depth += 1

            def on_end(watch, event: object) -> None:  # noqa: N805
                watch.depth -= 1
                if watch.depth == 0:
                    self._compiled_s += time.monotonic() - watch.began_s

        self._watching.enter_context(event.install_listener("numba:compile", Watch()))

    def plan(self, stages: Sequence[tuple[str, float]]) -> None:
        # What an earlier plan has done counts in the whole, as it does in what is done.
        self._expected = {"": self._done_s, **dict(stages)}
        self._bar.update(self._task, total=sum(self._expected.values()) or 1.0)
        self._watch_compiler()

    def _worked(self, worked_s: float) -> None:
        """Note how much of the expected work is done [s]; a report of no progress is none."""
        if worked_s != self._worked_s:
            self._worked_s = worked_s
            self._reported_s = time.monotonic()

    def note(self, line: str) -> None:
        self._say(line)

    def start(self, stage: str) -> None:
        self.update(stage, 0.0)

    def update(self, stage: str, fraction: float, message: str = "") -> None:
        # Some libraries swallow an interrupt while they are loaded.
        interrupts.check()
        self._worked(self._done_s + min(max(fraction, 0.0), 1.0) * self._expected.get(stage, 0.0))
        self._doing = f"{stage}: {message}" if message else stage
        ahead = self._ahead().partition(", ")[2].rstrip(")")
        self._bar.update(
            self._task, completed=self._worked_s, description=escape(self._doing), left=f"  {ahead}"
        )

    def finish(self, stage: str, seconds: float, *, taken_up: bool) -> None:
        if taken_up:
            # It says nothing about the speed of this run.
            self._expected[stage] = 0.0
            self._bar.update(self._task, total=sum(self._expected.values()) or 1.0)
        self._done_s += self._expected.get(stage, 0.0)
        self._worked(self._done_s)
        if not self._bar.disable:
            words = "kept from the earlier run" if taken_up else f"{seconds:.1f} s"
            self._bar.console.print(f"  {escape(stage):<12} {words}", highlight=False)


def print_summary(summary: RunSummary, *, verbose: bool = False) -> None:
    """The numbers on standard output, and the verdict where it is no complaint on standard error: as a table,
    on a narrow terminal as a list. verbose: rows of parts, too."""
    has_width = sys.stdout.isatty() or "COLUMNS" in os.environ
    console = Console(file=sys.stdout, width=None if has_width else _PIPE_COLUMNS)
    sections = [
        part
        for section in summary.sections
        for part in (section.whole() if verbose else (section,))
        if part.rows
    ]
    if console.width < _LEAST_TABLE_COLUMNS:
        _print_list(console, summary.title, sections)
    else:
        _print_table(console, summary.title, sections)
    if summary.certified is not False:
        console.print(_text(summary.verdict), highlight=False, soft_wrap=True)
    if summary.report_path:
        console.print(f"report: {_text(summary.report_path)}", highlight=False, soft_wrap=True)


def _print_table(console: Console, title: str, sections: Sequence[Section]) -> None:
    """Three columns: section, quantity, value."""
    table = Table(title=_text(title), title_justify="left", show_header=False, pad_edge=False)
    table.add_column("section", style="bold")
    # Names of columns are folded, not cut: what tells two of them apart may stand at the end.
    table.add_column("quantity", overflow="fold")
    table.add_column("value", overflow="fold")
    for section in sections:
        for index, row in enumerate(section.rows):
            heading = _text(section.title) if index == 0 else ""
            is_last = index == len(section.rows) - 1
            table.add_row(heading, _text(row.name), _value(row), end_section=is_last)
    console.print(table)


def _print_list(console: Console, title: str, sections: Sequence[Section]) -> None:
    """A heading for each section, a line for each quantity; a longer value stands indented below its name."""
    _print_wrapped(console, Text(printable(title), style="italic"), 0)
    for section in sections:
        _print_wrapped(console, Text(printable(section.title), style="bold"), 0)
        for row in section.rows:
            value = _value(row)
            in_one_line = Text(f"{printable(row.name)}: ").append_text(value)
            if not row.name:
                _print_wrapped(console, value, _NAME_INDENT)
            elif in_one_line.cell_len <= console.width - _NAME_INDENT:
                _print_wrapped(console, in_one_line, _NAME_INDENT)
            else:
                _print_wrapped(console, Text(printable(row.name)), _NAME_INDENT)
                _print_wrapped(console, value, _VALUE_INDENT)


def _print_wrapped(console: Console, words: Text, indent: int) -> None:
    """Words in lines of the terminal's width, each of them indented."""
    width = max(console.width - indent, 1)
    for line in words.wrap(console, width):
        line.rstrip()
        console.print(Text(" " * indent).append_text(line), highlight=False, soft_wrap=True)


def _value(row: Row) -> Text:
    """Value and remark of a fact; a curve is cut at the end of its line, for it is no use in two."""
    # It loads numpy, which a command that only says its version can do without.
    from workflow.text.formats import BARS

    is_curve = bool(row.text) and not set(row.text) - set(BARS)
    return Text(printable(row.text), overflow="ellipsis" if is_curve else "fold", no_wrap=is_curve)


def _text(words: str) -> str:
    """Words from files and configurations, with neither rich's markup nor the terminal's own codes."""
    return escape(printable(words))
