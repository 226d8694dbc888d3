"""The flexible link with ellipses: certified worst case of our designs and what any controller can reach,
scenarios A, B, C at orders 3 to 6, with times.

The worst case is max(|W1 S|, |W3 K S|) over all ellipses from the certificate (its own refined grid, not the
optimiser's). Reach beside it: the same orders by a prototype, and the exact-ellipse Youla value.

Second table: time of an order-5 design, exchange included, with each number of processes: smallest of the
repeats. On a shared machine the wall time is that of the machine as it was, so the load (processes wanting to
run, mean of a minute) is printed beside it, and what a machine with that many cores to spare would take: CPU
seconds of this process and those of its workers over their number.

Third table: the bracket. Row fine: a larger basis and grid, how far the default ones are from their limits.
Then the ellipse problem, which is not convex, from five starts.
"""

from __future__ import annotations

import os
import resource
import time
from functools import partial

import numpy as np

from benchmarks.harness import Print, main, timed
from control_design import SynthesisOptions, SynthesisResult, certify, synthesise
from control_design.convex.convex_options import YoulaOptions
from control_design.convex.youla import BracketProblem, youla_bracket
from validation.example_plants import Scenario, flexible_link, flexible_link_specification

REFERENCE: dict[Scenario, dict[int | str, float]] = {
    "A": {3: 0.996, 4: 0.994, 5: 0.937, 6: 0.931, "youla": 0.931},
    "B": {3: 1.349, 4: 1.155, 5: 1.085, 6: 1.082, "youla": 1.065},
    "C": {3: 1.508, 4: 1.366, 5: 1.334, 6: 1.277, "youla": 1.268},
}
BRACKET = {"A": (0.912, 0.931, 0.945), "B": (0.916, 1.065, 1.205), "C": (0.916, 1.268, 1.705)}
TIMED_ORDER = 5
REACH_S = {1: 15, 2: 8}
FINE = YoulaOptions(real_poles=50, pairs_per_mode=20, grid_points=400, mode_points=250, dense_points=20_000)


def design(scenario: Scenario, order: int, jobs: int, seed: int) -> SynthesisResult:
    """Synthesise."""
    plant, specification = flexible_link(scenario), flexible_link_specification(order)
    return synthesise([plant], specification, SynthesisOptions(jobs=jobs), rng=np.random.default_rng(seed))


def certified(out: Print, scenario: Scenario, order: int, seed: int) -> float:
    """Design, certify and compare; the certified worst case."""
    plant, specification, known = flexible_link(scenario), flexible_link_specification(order), REFERENCE
    result, designed_s = timed(partial(design, scenario, order, 1, seed))
    certificate, certified_s = timed(lambda: certify(result.controller, [plant], specification))
    verdict = certificate.plants[0]
    out(
        f"{scenario:>8} {order:>5}  {certificate.gamma:>9.4f}  ({known[scenario][order]:.3f})  "
        f"{100 * (certificate.gamma / known[scenario]['youla'] - 1):>12.2f}  "
        f"{verdict.stable and verdict.nyquist.matches!s:>6}  {designed_s:>5.1f}  {certified_s:>9.2f}"
    )
    return certificate.gamma


def cpu_s() -> np.ndarray:
    """CPU seconds of this process, and of the processes it has waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return np.array([each.ru_utime + each.ru_stime for each in used])


def times(out: Print, scenario: Scenario, jobs: int, repeat: int, seed: int) -> None:
    """Smallest times of the repeats."""
    found = []
    for _ in range(repeat):
        before, begin = cpu_s(), time.perf_counter()
        design(scenario, TIMED_ORDER, jobs, seed)
        waited, (own, workers) = time.perf_counter() - begin, cpu_s() - before
        found.append((waited, os.getloadavg()[0], own + workers / jobs))
    (wall_s, load, _), free = min(found), min(each[2] for each in found)
    reach = f"({REACH_S[jobs]:d})" if jobs in REACH_S else "-"
    out(f"{scenario:>8} {jobs:>4}  {wall_s:>6.1f} {reach:>5}  {load:>14.1f}  {free:>12.1f}")


def bracketed(out: Print, scenario: Scenario, gamma: dict[int, float]) -> None:
    """Bracket of one scenario by several settings; gamma: certified worst case by order."""
    plant, specification = flexible_link(scenario), flexible_link_specification(TIMED_ORDER)
    settings = {"default": YoulaOptions(), "hull": YoulaOptions(hull=True), "fine": FINE}
    for name, options in settings.items():
        bracket, spent = timed(partial(youla_bracket, plant, specification, options))
        one = bracket.plants[0]
        values = zip((bracket.inscribed, bracket.ellipse, bracket.enclosing), BRACKET[scenario], strict=True)
        cells = "  ".join(f"{value:>9.4f} ({reach:.3f})" for value, reach in values)
        excess = " / ".join(f"{100 * bracket.excess(gamma[o]):.1f}" if o in gamma else "-" for o in (5, 6))
        hull = "-" if one.hull is None else f"{one.hull:.4f}"
        out(f"{scenario:>8}  {name:<7}  {one.functions:>9}  {cells}  {hull:>10}  {excess:>14}  {spent:>7.1f}")


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
    gamma = {s: {order: certified(out, s, order, seed) for order in orders} for s in scenarios}
    out()
    out(f"time of an order-{TIMED_ORDER} design, smallest of {repeat}; reach in brackets")
    out("scenario jobs  wall s (reach)  load meanwhile  free cores s")
    for scenario in scenarios:
        for processes in jobs:
            times(out, scenario, processes, repeat, seed)
    out()
    out("Worst case of max(|W1 S|, |W3 K S|): none below 'inscribed', the others are reached.")
    out("reach = published (smaller basis, larger values); excess = our order 5 / 6 over 'ellipse'.")
    out("hull bound = lower bound from convex hulls at every frequency, tighter than the inscribed discs.")
    out(
        "scenario  basis    functions  inscribed (reach)  ellipse (reach)  enclosing (reach)"
        "  hull bound  excess 5 / 6 %  CPU s"
    )
    for scenario in scenarios:
        bracketed(out, scenario, gamma[scenario])
    out()
    out("The ellipse problem is not convex: its value from five starts between the discs' answers.")
    for scenario in scenarios:
        problem = BracketProblem(flexible_link(scenario), flexible_link_specification(5), YoulaOptions())
        outer, inner = (problem.exchanged(region, None)[2] for region in ("enclosing", "inscribed"))
        starts = ((1 - f) * outer + f * inner for f in (0.0, 0.25, 0.5, 0.75, 1.0))
        values = [problem.exchanged("ellipse", start)[0] for start in starts]
        out(f"{scenario:>8}  " + "  ".join(f"{value:.4f}" for value in values))


if __name__ == "__main__":
    main(run)
