"""Scores of `flexlink diagnose` on cases whose answers lie beside them.

    FLEXLINK_GAP=/path/to/gap OMP_NUM_THREADS=1 python -m benchmarks.gap_diagnosis

diagnoses the 15 labelled cases twice, with the exact and with the uncertain rig file. Cases of one's own:

    python -m validation.blind.generate --cases 120 --seed 501 --out CASES --open
    python -m benchmarks.gap_diagnosis --cases CASES --name gap_diagnosis_own
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from benchmarks.harness import Print, main
from validation.blind.report import text
from validation.blind.scores import GROUPS
from validation.blind.workshop.score import score_folders
from workflow.engine.errors import EXIT_NOT_CERTIFIED, EXIT_OK
from workflow.engine.storage import read_json

LABELLED = Path(os.environ.get("FLEXLINK_GAP", Path(__file__).parents[2] / "shared" / "gap")) / "labelled"


def diagnose(cases: Sequence[Path], rig: str, out: Path, jobs: int) -> None:
    """The command as a user gives it."""
    command = [sys.executable, "-m", "workflow", "diagnose", *map(str, cases), "--no-controller"]
    command += ["--out", str(out), "--rig", rig, "--jobs", str(jobs)]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
    if done.returncode not in (EXIT_OK, EXIT_NOT_CERTIFIED):  # the second: some answer is not certain
        raise SystemExit(f"flexlink diagnose ended with {done.returncode}")


def tell(out: Print, diagnosis: Path, cases: Path) -> None:
    """A line a case, then the scores."""
    timings = read_json(diagnosis / "timings.json")
    for path in sorted(diagnosis.glob("*.json")):
        found = read_json(path)
        if "verdict" not in found:
            continue
        said = " + ".join(found["combination"]) or found["verdict"]
        first = found["effects"][0]["probability"]
        out(
            f"  {path.stem:34s} {said:42s} p {first:.3f}  {found['detail_verdict']:10s} gap "
            f"{found['gap_before']:7.3f} -> {found['gap_after']:6.3f}  "
            f"CPU {timings.get(path.stem, {}).get('cpu_s', float('nan')):5.1f} s"
        )
    out()
    out(text(score_folders(cases, diagnosis, GROUPS)).rstrip("\n"))


def run(out: Print, *, cases: Path = LABELLED, jobs: int = 2, keep: str = "") -> None:
    """keep: directory for documents and pages, which are thrown away without it."""
    folders = sorted(path for path in cases.iterdir() if (path / "answer.toml").is_file())
    if not folders:
        sys.exit(f"{cases}: no case folders with answer.toml")
    rigs = [name for name in ("rig.toml", "rig_uncertain.toml") if (folders[0] / name).is_file()]
    with tempfile.TemporaryDirectory() as room:
        for rig in rigs:
            where = Path(keep or room) / rig.removesuffix(".toml")
            diagnose(folders, rig, where, jobs)
            out()
            out(f"rig file: {rig}")
            tell(out, where, cases)


if __name__ == "__main__":
    main(run, seeds="of the cases")
