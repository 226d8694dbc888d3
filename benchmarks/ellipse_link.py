"""The flexible link with ellipses: certified worst case of our designs, scenarios A, B, C at orders 3 to 6,
with times.

    OMP_NUM_THREADS=1 python -m benchmarks.ellipse_link [--orders 3 4 5 6] [--scenarios A B C] [--seed 1]
                                                        [--jobs 1 2] [--no-write]

The worst case is max(|W1 S|, |W3 K S|) over all ellipses from the certificate (its own refined grid, not the
optimiser's). Reach beside it: the same orders by a prototype, and the exact-ellipse Youla value. Times: CPU
seconds of all processes (starting them included) and wall seconds; on a shared machine the wall time is that
of the machine as it was, so the load (processes wanting to run, mean of a minute) is printed beside it.
"""

from __future__ import annotations

import argparse
import os
import resource
import time

import numpy as np

from benchmarks.results_file import ResultsFile
from control_design import SynthesisOptions, certify, synthesise
from control_design.example_plants import Scenario, flexible_link, flexible_link_specification

REFERENCE: dict[Scenario, dict[int | str, float]] = {
    "A": {3: 0.996, 4: 0.994, 5: 0.937, 6: 0.931, "youla": 0.931},
    "B": {3: 1.349, 4: 1.155, 5: 1.085, 6: 1.082, "youla": 1.065},
    "C": {3: 1.508, 4: 1.366, 5: 1.334, 6: 1.277, "youla": 1.268},
}


def cpu_s() -> float:
    """CPU seconds of this process and of those it has waited for."""
    own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


def main() -> None:
    """Design, certify, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--orders", type=int, nargs="+", choices=[3, 4, 5, 6], default=[3, 4, 5, 6])
    parser.add_argument("--scenarios", nargs="+", choices=list(REFERENCE), default=list(REFERENCE))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, nargs="+", default=[1])
    parser.add_argument("--no-write", action="store_true")
    arguments = parser.parse_args()
    with ResultsFile("ellipse_link", seeds=str(arguments.seed), write=not arguments.no_write) as out:
        out("reach of the time: 15 s on one core, 8 s with two, at order 5")
        out("scenario order jobs  certified  (reach)  over youla %  stable  CPU s  wall s  load  certify s")
        for scenario in arguments.scenarios:
            for order in arguments.orders:
                for jobs in arguments.jobs:
                    out(row(scenario, order, jobs, arguments.seed))


def row(scenario: Scenario, order: int, jobs: int, seed: int) -> str:
    """One design."""
    plant, specification = flexible_link(scenario), flexible_link_specification(order)
    begin, wall = cpu_s(), time.perf_counter()
    result = synthesise([plant], specification, SynthesisOptions(jobs=jobs), rng=np.random.default_rng(seed))
    spent, waited = cpu_s() - begin, time.perf_counter() - wall
    begin = cpu_s()
    certificate = certify(result.controller, [plant], specification)
    verdict, known = certificate.plants[0], REFERENCE[scenario]
    sound = verdict.stable and verdict.nyquist.matches
    return (
        f"{scenario:>8} {order:>5} {jobs:>4}  {certificate.gamma:>9.4f}  ({known[order]:.3f})  "
        f"{100 * (certificate.gamma / known['youla'] - 1):>12.2f}  {sound!s:>6}  {spent:>5.1f}  "
        f"{waited:>6.1f}  {os.getloadavg()[0]:>4.1f}  {cpu_s() - begin:>9.2f}"
    )


if __name__ == "__main__":
    main()
