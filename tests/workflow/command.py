"""Calling the command line from tests, in this process or in one that can be killed."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
FAST_ARM = Path(__file__).parent / "data" / "fast_arm.toml"


@dataclass(frozen=True)
class Answer:
    """What a command left behind."""

    code: int
    out: str
    err: str

    def document(self, code: int = 0) -> Any:
        """What `--json` printed; the exit code must be this one."""
        assert self.code == code, self.err
        return json.loads(self.out)


# Of tests in the background of a shell, or behind nohup, commands would inherit that these are ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


def start_flexlink(
    *arguments: object, stdout: IO[bytes] | int = subprocess.PIPE, threads: int = 1, first: str = ""
) -> subprocess.Popen[bytes]:
    """`flexlink` in a process of its own; first: statements that it begins with."""
    begin = ["-c", f"{first}\nimport sys\nfrom workflow.__main__ import main\nsys.exit(main())"]
    return subprocess.Popen(
        [
            sys.executable,
            *(begin if first else ["-m", "workflow"]),
            *(str(argument) for argument in arguments),
        ],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": str(threads)},
        stdout=stdout,
        stderr=subprocess.PIPE,
    )


def finish(process: subprocess.Popen[bytes], code: int = 0, *, seconds: float = 600.0) -> str:
    """Standard error of a process that ends with this code, lines of progress left out."""
    _, error = process.communicate(timeout=seconds)
    assert process.returncode == code, error.decode()
    return without_progress(error.decode())


def without_progress(error: str) -> str:
    """Standard error without the lines that come every ten seconds, and where something is compiled."""
    return re.sub(r"^flexlink: (?:\d+ s: |compiling, once).*\n", "", error, flags=re.MULTILINE)


@dataclass(frozen=True)
class Imported:
    """For a process of ours: where it finds modules, and what its children would be told."""

    names: tuple[str, ...]

    def run(self, report: object) -> tuple[list[str], str | None]:
        found = [str(import_module(name).__file__) for name in self.names]
        return found, os.environ.get("PYTHONSAFEPATH")


def wait_until(condition: Callable[[], object], process: subprocess.Popen[bytes]) -> None:
    """Return once the condition holds; fail when the process ends before."""
    deadline = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < deadline, "nothing happened"
        assert process.poll() is None, process.communicate()[1].decode()
        time.sleep(0.002)


def draw_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are described but not drawn: what a page says does not depend on its pictures."""
    from workflow.figures.description import new_picture
    from workflow.figures.svg import Drawn
    from workflow.report import rendering

    nothing = {"axes": [], "cuts": [], "legend": [], "width": 1, "height": 1}
    empty = Drawn(new_picture(1.0)[0], "", "", [], nothing)
    monkeypatch.setattr(rendering, "drawn", lambda picture, label, number, styles: empty)


class _Built(dict[str, Callable[..., object]]):
    """In place of all drawings: something is there to be rendered."""

    def __missing__(self, name: str) -> Callable[..., object]:
        return lambda *_: name


def build_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside `draw_nothing`, where the same numbers have been drawn before: nothing is even described."""
    from workflow.report import rendering

    monkeypatch.setattr(rendering, "drawings", _Built)


def perform_stages(monkeypatch: pytest.MonkeyPatch, stages: Sequence[Any]) -> None:
    """Runs of one loop perform these stages (`Stage`) in place of their own."""
    from workflow.tasks import pipeline, stages as of_one_loop

    changed = replace(of_one_loop.ONE_LOOP, stages=tuple(stages))
    for module in (pipeline, of_one_loop):
        monkeypatch.setattr(module, "ONE_LOOP", changed)


def kill(process: subprocess.Popen[bytes]) -> None:
    """SIGKILL, and wait for the end."""
    process.kill()
    finish(process, -signal.SIGKILL)
