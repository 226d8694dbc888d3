"""The flexible link with ellipses: certified worst case of our designs, scenarios A, B, C at orders 3 to 6,
with times.

    OMP_NUM_THREADS=1 python -m benchmarks.ellipse_link [--orders 5 6 4 3] [--scenarios A B C] [--seed 1]
                                                        [--jobs 1 2] [--repeat 3]

The worst case is max(|W1 S|, |W3 K S|) over all ellipses from the certificate (its own refined grid, not the
optimiser's). Reach beside it: the same orders by a prototype, and the exact-ellipse Youla value.

Second table: time of an order-5 design, exchange included, with each number of processes: smallest of the
repeats. On a shared machine the wall time is that of the machine as it was, so the load (processes wanting to
run, mean of a minute) is printed beside it, and CPU seconds of this process and of its workers (starting them
included); "free cores" is own + workers/jobs, the wall time of a machine with that many cores to spare and
evenly dealt work.
"""

from __future__ import annotations

import os
import resource
import time
from dataclasses import dataclass

import numpy as np

from benchmarks.harness import Print, main
from control_design import Controller, SynthesisOptions, certify, synthesise
from validation.example_plants import Scenario, flexible_link, flexible_link_specification

REFERENCE: dict[Scenario, dict[int | str, float]] = {
    "A": {3: 0.996, 4: 0.994, 5: 0.937, 6: 0.931, "youla": 0.931},
    "B": {3: 1.349, 4: 1.155, 5: 1.085, 6: 1.082, "youla": 1.065},
    "C": {3: 1.508, 4: 1.366, 5: 1.334, 6: 1.277, "youla": 1.268},
}


TIMED_ORDER = 5
REACH_S = {1: 15, 2: 8}


def cpu_s() -> tuple[float, float]:
    """CPU seconds of this process, and of the processes it has waited for."""
    own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime, others.ru_utime + others.ru_stime


@dataclass(frozen=True)
class Run:
    """One design: the controller, CPU seconds of this process and of its workers, wall seconds, load."""

    controller: Controller
    own_s: float
    workers_s: float
    wall_s: float
    load: float


def design(scenario: Scenario, order: int, jobs: int, seed: int) -> Run:
    """Synthesise and time it."""
    plant, specification = flexible_link(scenario), flexible_link_specification(order)
    before, wall = cpu_s(), time.perf_counter()
    result = synthesise([plant], specification, SynthesisOptions(jobs=jobs), rng=np.random.default_rng(seed))
    waited = time.perf_counter() - wall
    own, workers = (after - begin for after, begin in zip(cpu_s(), before, strict=True))
    return Run(result.controller, own, workers, waited, os.getloadavg()[0])


def row(scenario: Scenario, order: int, run: Run) -> str:
    """Certify and compare."""
    plant, specification = flexible_link(scenario), flexible_link_specification(order)
    begin = cpu_s()[0]
    certificate = certify(run.controller, [plant], specification)
    verdict, known = certificate.plants[0], REFERENCE[scenario]
    sound = verdict.stable and verdict.nyquist.matches
    return (
        f"{scenario:>8} {order:>5}  {certificate.gamma:>9.4f}  ({known[order]:.3f})  "
        f"{100 * (certificate.gamma / known['youla'] - 1):>12.2f}  {sound!s:>6}  "
        f"{run.own_s + run.workers_s:>5.1f}  {cpu_s()[0] - begin:>9.2f}"
    )


def time_row(scenario: Scenario, jobs: int, runs: list[Run]) -> str:
    """Smallest of the repeats."""
    best = min(runs, key=lambda run: run.wall_s)
    free = min(run.own_s + run.workers_s / jobs for run in runs)
    cpu = min(run.own_s + run.workers_s for run in runs)
    reach = f"({REACH_S[jobs]:d})" if jobs in REACH_S else "-"
    return (
        f"{scenario:>8} {jobs:>4}  {best.wall_s:>6.1f} {reach:>5}  {best.load:>14.1f}  {free:>12.1f}  "
        f"{cpu:>5.1f}  {best.own_s:>5.1f}  {best.workers_s:>7.1f}"
    )


def run(
    out: Print,
    *,
    orders: tuple[int, ...] = (5, 6, 4, 3),
    scenarios: tuple[Scenario, ...] = ("A", "B", "C"),
    seed: int = 1,
    jobs: tuple[int, ...] = (1, 2),
    repeat: int = 3,
) -> None:
    out("scenario order  certified  (reach)  over youla %  stable  CPU s  certify s")
    for scenario in scenarios:
        for order in orders:
            out(row(scenario, order, design(scenario, order, 1, seed)))
    out()
    out(f"time of an order-{TIMED_ORDER} design, smallest of {repeat}; reach in brackets")
    out("scenario jobs  wall s (reach)  load meanwhile  free cores s  CPU s  own s  workers s")
    for scenario in scenarios:
        for processes in jobs:
            runs = [design(scenario, TIMED_ORDER, processes, seed) for _ in range(repeat)]
            out(time_row(scenario, processes, runs))


if __name__ == "__main__":
    main(run)
