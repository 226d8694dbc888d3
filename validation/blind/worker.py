"""What diagnoses one case of the blind protocol, in a process of its own: it knows a folder and nothing else.

From before the diagnosis on the process can do nothing to a path below the directory of the run, nor start a
process that could. The labels are not there anyway while cases are diagnosed (`validation.blind.seal`).
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diagnosis.diagnosis import diagnose
from validation.blind.baselines import baselines
from workflow.diagnose.case_files import load_case
from workflow.diagnose.document import document_of
from workflow.engine import codec
from workflow.engine.executor import Report

_PROCESS_EVENTS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "os.forkpty")


def keep_out(directory: Path) -> None:
    """Refuse every access of this process below `directory`, and new processes; there is no way back."""
    wall = os.path.realpath(directory)

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event in _PROCESS_EVENTS:
            raise PermissionError("a blind diagnosis starts no processes")
        # Whatever the event: a list of those that take a path would leave some out.
        for argument in arguments:
            if isinstance(argument, (str, bytes, os.PathLike)) and (named := os.fsdecode(argument)):
                if "\0" in named:
                    continue  # no path
                path = os.path.realpath(named)
                if path == wall or path.startswith(wall + os.sep):
                    raise PermissionError("below the directory of a blind run: sealed")

    sys.addaudithook(watch)


def diagnose_folder(folder: Path) -> dict[str, Any]:
    """Answer about a case folder with the processor time it took, and the baselines' answers."""
    loaded = load_case(folder)
    start = time.process_time()
    document = document_of(loaded, diagnose(loaded.case))
    document["cpu_s"] = time.process_time() - start
    document["baselines"] = baselines(loaded.case)
    document["baselines_cpu_s"] = time.process_time() - start - document["cpu_s"]
    plain: dict[str, Any] = codec.plain(document)
    return plain


@dataclass(frozen=True)
class BlindCase:
    """A case folder to be diagnosed by a process that is kept out of `sealed`."""

    folder: Path
    sealed: Path
    diagnose: Callable[[Path], dict[str, Any]] = diagnose_folder

    def run(self, report: Report) -> dict[str, Any]:
        """The answer."""
        # Under a neutral path: not even the name of the run is in what is diagnosed.
        with tempfile.TemporaryDirectory() as room:
            copy = Path(room) / self.folder.name
            shutil.copytree(self.folder, copy)
            keep_out(self.sealed)
            return self.diagnose(copy)


def failed(case: str, reason: str) -> dict[str, Any]:
    """The answer of a case without one: it counts as wrong."""
    nothing: dict[str, Any] = {"effects": [], "combination": [], "gap_after": None}
    return {"case": case, "verdict": "failed", **nothing, "reason": reason}
