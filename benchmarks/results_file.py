"""Results as committed: printed as they come, written whole at the end, with command, seeds and date."""

from __future__ import annotations

import datetime
import os
import shlex
import sys
from pathlib import Path

RESULTS = Path(__file__).parent / "results"


class ResultsFile:
    """Lines of one results file; use as a context manager.

    Nothing is written if the block raises, so a results file is never half of a run.

    Parameters
    ----------
    name : str
        File name without suffix, under `benchmarks/results/`.
    seeds : str
        Which seeds the numbers rest on, in words ("0 to 49").
    write : bool
        Without it the lines are only printed (a short trial run).
    """

    def __init__(self, name: str, *, seeds: str, write: bool = True) -> None:
        self._path = RESULTS / f"{name}.txt"
        self._write = write
        module = getattr(sys.modules["__main__"].__spec__, "name", None) or f"benchmarks.{name}"
        command = shlex.join(["python", "-m", module, *sys.argv[1:]])
        threads = os.environ.get("OMP_NUM_THREADS")
        prefix = f"OMP_NUM_THREADS={threads} " if threads else ""
        self._lines = [f"# {prefix}{command}   (seeds {seeds}; {datetime.date.today().isoformat()})"]

    def __call__(self, line: str = "") -> None:
        """Print and keep one line."""
        print(line, flush=True)
        self._lines.append(line.rstrip())

    def __enter__(self) -> ResultsFile:
        print(self._lines[0], flush=True)
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if kind is None and self._write:
            self._path.write_text("\n".join(self._lines) + "\n", encoding="utf-8")
