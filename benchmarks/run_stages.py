"""CPU seconds of `flexlink run` on the default arm by stage, each run a process of its own, compiled code
at hand: medians, and the range of the whole."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.harness import Print, main

_RUN = """
import json, sys, time
from pathlib import Path
from workflow.engine.progress import Progress
clock, spent = time.process_time, {}
class Clock(Progress):
    def start(self, stage):
        self.begun = clock()
    def finish(self, stage, seconds, *, taken_up):
        spent[stage] = clock() - self.begun
from workflow.__main__ import collect_seldom
collect_seldom()
from workflow.commands.run import run_from_files
import workflow.report.pages, workflow.tasks.pipeline
spent["imports"] = clock()
run_from_files(None, Path(sys.argv[1]), progress=Clock())
spent["all"] = clock()
spent["records"] = spent["all"] - sum(spent[name] for name in spent if name != "all")
print(json.dumps(spent))
"""


def run(out: Print, *, repeats: int = 5) -> None:
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    found = []
    for _ in range(repeats + 1):  # the first may compile
        with tempfile.TemporaryDirectory(prefix="flexlink-") as name:
            call = [sys.executable, "-c", _RUN, str(Path(name) / "run")]
            done = subprocess.run(call, env=kept, capture_output=True, text=True, check=True)
            found.append(json.loads(done.stdout))
    for stage in found[0]:
        seconds = [one[stage] for one in found[1:]]
        ends = f"   {min(seconds):.2f} to {max(seconds):.2f}" if stage == "all" else ""
        out(f"{stage:<24}{np.median(seconds):>8.2f}{ends}")


if __name__ == "__main__":
    main(run)
