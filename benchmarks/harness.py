"""What every benchmark shares: options, CPU times, and the results file.

A benchmark is a module with a function `run(out, *, option=default, ...)` that tells its numbers line by line
with `out(line)`, and ends with `main(run)`:

    OMP_NUM_THREADS=1 FLEXLINK_DATA=/path/to/data python -m benchmarks.MODULE --help

Its options on the command line are the keywords of `run`. A run with all options as they are writes
benchmarks/results/MODULE.txt; with --name NAME any run writes NAME.txt; everything else is only printed.
"""

from __future__ import annotations

import argparse
import datetime
import inspect
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

RESULTS = Path(__file__).parent / "results"

# Tells a line, or an empty one.
Print = Callable[..., None]
R = TypeVar("R")
C = TypeVar("C")


class Results:
    """Lines of one results file: printed as they come, written whole at the end, so never half of a run."""

    def __init__(self, head: str) -> None:
        self.head = head
        self._lines: list[str] = []
        self(head)

    def __call__(self, line: str = "") -> None:
        """Print and keep a line, or several."""
        print(line, flush=True)
        self._lines += [part.rstrip() for part in line.split("\n")]

    def write(self, path: Path) -> None:
        path.write_text("\n".join(self._lines) + "\n", encoding="utf-8")


def main(
    run: Callable[..., None],
    arguments: Sequence[str] | None = None,
    *,
    seeds: str | None = None,
    writes: bool = True,
) -> None:
    """Call `run` with the options of the command line; the results file begins with command, seeds, commit
    and date.

    seeds: in words, where they are not the options `seeds` (0 to seeds - 1) or `seed`; may name options in
    braces; writes: a run with all options as they are writes its results file.
    """
    file = Path(inspect.getfile(run))
    module = file.parent.name if file.stem == "__main__" else file.stem  # a package is named by its folder
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(run).parameters.items()
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY
    }
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks.{module}",
        description=sys.modules[run.__module__].__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--name", help="write benchmarks/results/NAME.txt, whatever the options")
    for name, default in defaults.items():
        parser.add_argument(f"--{name.replace('_', '-')}", **_kind(default))
    parsed = vars(parser.parse_args(arguments))
    options = {name: tuple(value) if isinstance(value, list) else value for name, value in parsed.items()}
    target = options.pop("name") or (module if writes and options == defaults else None)
    # No path of the machine it ran on.
    shown = [os.path.relpath(each) if os.path.isabs(each) else each for each in arguments]
    command = shlex.join(["python", "-m", f"benchmarks.{module}", *shown])
    threads = os.environ.get("OMP_NUM_THREADS")
    rests_on = seeds.format(**options) if seeds is not None else _seeds(options)
    out = Results(
        f"# {f'OMP_NUM_THREADS={threads} ' if threads else ''}{command}   (seeds {rests_on}; "
        f"commit {_commit()}; {datetime.date.today().isoformat()})"
    )
    run(out, **options)
    if target is not None:
        out.write(RESULTS / f"{target}.txt")


def _kind(default: Any) -> dict[str, Any]:
    """How argparse reads an option with this default."""
    if isinstance(default, bool):
        return {"action": argparse.BooleanOptionalAction, "default": default}
    if isinstance(default, tuple):
        return {"nargs": "+", "type": type(default[0]), "default": default}
    return {"type": str if default is None else type(default), "default": default}


def _seeds(options: Mapping[str, Any]) -> str:
    if "seed" in options:
        return str(options["seed"])
    counted = options.get("seeds")
    if isinstance(counted, tuple):
        return " ".join(map(str, counted))
    first = options.get("first_seed", 0)
    return "none" if counted is None else f"{first} to {first + counted - 1}"


def _commit() -> str:
    """Short hash of the checkout, with a plus where files differ from it, other than results."""

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *words], cwd=RESULTS.parent, capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        changed = git("status", "--porcelain", "-uno", "--", ":/", f":!{RESULTS}")
        return git("rev-parse", "--short", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def data_folder(*needed: str) -> Path:
    """FLEXLINK_DATA; ends the program where it is not set or lacks one of these folders."""
    folder = Path(os.environ.get("FLEXLINK_DATA") or "not set")
    if not all((folder / name).is_dir() for name in needed):
        sys.exit(f"set FLEXLINK_DATA to the folder that holds {', '.join(needed)}")
    return folder


def flexlink(*words: str, longest_s: float | None = None) -> tuple[int, str, list[str]]:
    """Exit code and standard output of a command, and the lines it said but for progress (on standard error
    where there are any); -1 where it takes longer than longest_s."""
    command = [sys.executable, "-m", "flexlink", *words]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=longest_s)
    except subprocess.TimeoutExpired:
        return -1, "", [f"no answer in {longest_s} s"]
    lines = [line.strip() for line in (ended.stderr or ended.stdout).splitlines() if line.strip()]
    lines = [line for line in lines if not re.match(r"flexlink: \d+ s: ", line)]
    return ended.returncode, ended.stdout, lines or ["(nothing said)"]


def reading(name: str, **values: object) -> str:
    """What is said about the numbers of a benchmark: benchmarks/readings/NAME.txt, values put in."""
    return (
        (Path(__file__).parent / "readings" / f"{name}.txt").read_text("utf-8").rstrip("\n").format(**values)
    )


def timed(call: Callable[[], R]) -> tuple[R, float]:
    """What the call returns, and CPU seconds of this process."""
    begin = time.process_time()
    result = call()
    return result, time.process_time() - begin
