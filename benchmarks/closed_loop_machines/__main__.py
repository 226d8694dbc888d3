"""Logs of machines under their own controllers, made by an independent simulator, through
`flexlink run LOG...`, nothing typed, to a controller: what came out, against the truth (criteria: judge.py).

The ten kinds unless --kinds names others; the further ones (machines.FURTHER_KINDS) are quick, tip, load,
clipped, late.
Seeds with seed mod 6 below 4 record the reference. Series 1 is for development.
    python -m benchmarks.closed_loop_machines --make-only LOGS    writes logs, and the truth to LOGS_truth
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.closed_loop_machines.judge import judged
from benchmarks.closed_loop_machines.logs import machine, write
from benchmarks.closed_loop_machines.machines import KINDS
from benchmarks.harness import Print, main


def run(
    out: Print,
    *,
    seeds: str = "0:6",
    kinds: str = ",".join(KINDS),
    series: int = 1,
    jobs: int = 2,
    keep: str = "",
    judge_only: bool = False,
    make_only: str = "",
) -> None:
    """A line per machine and the table by kind. keep: where logs, runs and
    judged.json stay, to be judged again with judge_only."""
    first, last = map(int, seeds.split(":"))
    cases = [(kind, seed) for kind in kinds.split(",") for seed in range(first, last)]
    if make_only:
        for kind, seed in cases:
            write(machine(kind, seed, series), Path(make_only), Path(f"{make_only.rstrip('/')}_truth"))
        return
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as scratch, ProcessPoolExecutor(jobs) as pool:
        judge_one = partial(_one, series=series, folder=Path(keep or scratch), judge_only=judge_only)
        rows = []
        for row in pool.map(judge_one, cases):
            out(_line(row))
            rows.append(row)
    out()
    out(_HEAD)
    for kind in dict.fromkeys(row["kind"] for row in rows):
        out(_table_row(kind, [row for row in rows if row["kind"] == kind]))
    out(_table_row("all", rows))


def _one(case: tuple[str, int], series: int, **options: Any) -> dict[str, Any]:
    return judged(machine(*case, series), **options)


def _line(row: dict[str, Any]) -> str:
    """What came out of one machine."""
    parts = [f"{row['kind']}_{row['seed']}: exit {row['code']}, {row['cpu_s']:.0f} s"]
    if row["certified"]:
        parts.append(f"certified, settles {row['settled']}/20")
        parts += [f"VIOLATED {line}" for line in row["violations"]]
    for key, unit in (("frequency_error", 100), ("friction_error", 100), ("unstable_error", 100)):
        if row.get(key) is not None:
            parts.append(f"{key.replace('_', ' ')} {row[key] * unit:+.2f} %")
    if "damping" in row:
        parts.append(f"damping {row['damping']:.4f} ({row['damping_true']:.4f})")
    parts += [f"ellipses {row['ellipses']:.0%}"] if row.get("ellipses") is not None else []
    return ", ".join(parts) + ("" if row["certified"] else f"; {row['line']}")


_HEAD = (
    "kind        | good, with r | good, no r | violated | rest: next step | frequency %, median | damping in "
    "| friction %, median | friction in | ellipses | by machine 92-98 % | unstable 5 % | CPU s, median, max"
)


def _table_row(name: str, rows: Sequence[dict[str, Any]]) -> str:
    """A row of the table: counts are `so many of so many`; good: certified, and all 20 runs settle."""

    def share(values: Sequence[bool]) -> str:
        return f"{sum(values)} of {len(values)}" if values else "-"

    def median(key: str) -> str:
        values = [abs(row[key]) for row in rows if row.get(key) is not None]
        return f"{100 * np.median(values):.2f}" if values else "-"

    def inside(key: str) -> str:
        return share([row[key] for row in rows if key in row])

    good = [(row["seed"] % 6 < 4, row["certified"] and row["settled"] == 20) for row in rows]
    ellipses = [row["ellipses"] for row in rows if row.get("ellipses") is not None]
    unstable = [row["unstable_error"] for row in rows if "unstable_error" in row]
    times = [row["cpu_s"] for row in rows]
    cells = [
        name.ljust(11),
        share([g for recorded, g in good if recorded]),
        share([g for recorded, g in good if not recorded]),
        share([bool(row["violations"]) for row in rows if row["certified"]]),
        share([row["next_step"] for row in rows if not row["certified"]]),
        median("frequency_error"),
        inside("damping_inside"),
        median("friction_error"),
        inside("friction_inside"),
        f"{np.mean(ellipses):.1%}" if ellipses else "-",
        share([0.92 <= value <= 0.98 for value in ellipses]),
        share([error is not None and abs(error) <= 0.05 for error in unstable]),
        f"{np.median(times):.0f}, {np.max(times):.0f}",
    ]
    return " | ".join(cells)


if __name__ == "__main__":
    main(run, seeds="{seeds} of series {series}")
