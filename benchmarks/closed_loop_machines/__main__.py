"""Closed-loop logs of machines from an independent simulator, from `flexlink init` to a certified controller.

python -m benchmarks.closed_loop_machines --make-only LOGS --truth-folder TRUTH
"""

from __future__ import annotations

from pathlib import Path

from benchmarks.closed_loop_machines.logs import machine, write
from benchmarks.closed_loop_machines.machines import KINDS
from benchmarks.harness import Print, main


def run(
    out: Print,
    *,
    seeds: str = "0:6",
    kinds: str = ",".join(KINDS),
    series: int = 1,
    make_only: str = "",
    truth: str = "",
) -> None:
    """Logs of every machine to MAKE_ONLY, its truth to TRUTH (default: MAKE_ONLY_truth)."""
    first, last = map(int, seeds.split(":"))
    for kind in kinds.split(","):
        for seed in range(first, last):
            one = machine(kind, seed, series)
            paths = write(one, Path(make_only), Path(truth or f"{make_only.rstrip('/')}_truth"))
            out(f"{one.name}: {len(paths)} logs, {' '.join(one.classes)}")


if __name__ == "__main__":
    main(run, seeds="{seeds} of series {series}")
