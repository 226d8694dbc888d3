"""The process that diagnoses one case of the blind protocol: it knows a folder and nothing else.

    python -m validation.blind.worker FOLDER [--keep-out DIRECTORY] [--no-baselines]

prints one JSON document. From its first line on it cannot open, list, rename or remove anything below
DIRECTORY (the run with its sealed labels), nor start a process that could.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import warnings
from pathlib import Path
from typing import Any

_PATH_EVENTS = (
    "open",
    "os.listdir",
    "os.scandir",
    "os.rename",
    "os.remove",
    "os.link",
    "os.symlink",
    "os.chmod",
    "os.truncate",
    "os.chdir",
)
_PROCESS_EVENTS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "os.forkpty")


def keep_out(directory: Path) -> None:
    """Refuse every access of this process below `directory`, and new processes; there is no way back."""
    wall = os.path.realpath(directory)

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event in _PROCESS_EVENTS:
            raise PermissionError("a blind diagnosis starts no processes")
        if event in _PATH_EVENTS:
            for argument in arguments:
                if isinstance(argument, (str, bytes, os.PathLike)):
                    path = os.path.realpath(os.fsdecode(argument))
                    if path == wall or path.startswith(wall + os.sep):
                        raise PermissionError("below the directory of a blind run: sealed")

    sys.addaudithook(watch)


def diagnose_folder(folder: Path, with_baselines: bool) -> dict[str, Any]:
    """Answer about a case folder with the processor time it took, and the baselines' answers."""
    from diagnosis.diagnosis import diagnose
    from validation.blind.baselines import baselines
    from workflow.diagnose.case_files import load_case
    from workflow.diagnose.document import document_of

    loaded = load_case(folder)
    found = diagnose(loaded.case)
    document = document_of(loaded, found)
    document["cpu_s"] = time.process_time()
    if with_baselines:
        start = time.process_time()
        document["baselines"] = baselines(loaded.case)
        document["baselines_cpu_s"] = time.process_time() - start
    return document


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--keep-out", type=Path)
    parser.add_argument("--no-baselines", action="store_true")
    given = parser.parse_args()
    if given.keep_out is not None:
        keep_out(given.keep_out)
    from workflow.engine.errors import one_line

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            document = diagnose_folder(given.folder, not given.no_baselines)
        except Exception as error:
            sys.stderr.write(f"{type(error).__name__}: {one_line(error)}\n")
            raise SystemExit(1) from error
    from workflow.diagnose.document import json_text

    sys.stdout.write(json.dumps(json.loads(json_text(document))) + "\n")


if __name__ == "__main__":
    main()
