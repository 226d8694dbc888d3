"""CPU time of an order-4 fit and of its hot loop, the cost of candidate poles, beside those of others.

Plant P1 (one mode, double integrator, 30 dB). Fits: two real poles and a pair sought without prior
knowledge, N = 1000, on noise seeds 0 .. SEEDS - 1, ours and an output-error fit (Steiglitz-McBride start,
NumPy and SciPy) taking turns. Warnings are worked out when they are asked for: the row that names them asks.
Cost: residual sum of squares at points of the unit cube of that search, with the offset of the output as
nuisance.
Peak memory is that of the process, libraries included. Compiling: CPU time of the first fit of a process
without any stored code, and of the first fit of one that finds it.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from benchmarks.harness import Print, main, median_s, taking_turns
from ident import IdentOptions, identify
from ident.basis.coordinates import search_space
from ident.basis.poles import Poles
from ident.fit.problem import CandidateCost
from ident.fit.regression import prepare
from ident.search.direct import minimise
from tests.ident.benchmark_plants import max_length_sequence, p1
from validation.comparators.comparators import oe

FOURTH_ORDER = IdentOptions(n_real=2, n_pairs=1)
FIRST_FIT = """
from benchmarks.fit_time import FOURTH_ORDER, identify, p1
from benchmarks.harness import timed
record = p1(0).record
print(timed(lambda: identify([record], FOURTH_ORDER))[1])
"""


def fits(out: Print, count: int) -> None:
    methods: dict[str, Callable[..., object]] = {
        "GOBF, 2 real + 1 pair": lambda record: identify([record], FOURTH_ORDER),
        "    and its warnings": lambda record: identify([record], FOURTH_ORDER).warnings,
        "GOBF, order from data": lambda record: identify([record]),
        "OE 4/4": lambda record: oe(record, 4, 4, arx_start=False),
    }
    times = taking_turns(methods, [p1(seed).record for seed in range(count)])
    out(f"{'fit, N = 1000':<26}  CPU ms median   10th    90th   reach")
    for name, seconds in times.items():
        each = 1e3 * np.array(seconds)
        low, high = np.quantile(each, [0.1, 0.9])
        reach = "5" if "pair" in name else ""
        out(f"{name:<26}  {np.median(each):>13.2f}  {low:>5.2f}  {high:>6.2f}   {reach:>5}")
    out()


def cost_of(n_samples: int) -> tuple[CandidateCost, np.ndarray]:
    """The cost of two real poles and a pair on P1 of any length, and points to evaluate it at."""
    rng = np.random.default_rng(0)
    u = np.resize(max_length_sequence(1, 2047), n_samples)
    record = p1(0).record
    y = np.resize(record.output[:, 0], n_samples) + 1e-3 * rng.normal(size=n_samples)
    data = prepare(
        [type(record)("P1", u[:, None], y[:, None], 0.005, ("u",), ("y",))], FOURTH_ORDER.structure()
    )
    space = search_space(2, 1, data.longest, data.dt_s, FOURTH_ORDER)
    return data.candidate_cost(space, Poles(), Poles()), rng.random((96, 4))


def lfilter_and_lstsq(n_samples: int) -> Callable[[], object]:
    """One candidate by library calls: four filters for the columns, one least-squares solution."""
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=n_samples), rng.normal(size=n_samples)
    a1, a2, pole = 0.999, 0.9, 0.99 * np.exp(0.075j)
    denominator = [1.0, -2 * pole.real, abs(pole) ** 2]

    def call() -> object:
        first = lfilter([0, 1], [1, -a1], u)
        second = lfilter([0, 1], [1, -a2], lfilter([-a1, 1], [1, -a1], u))
        driven = lfilter([-a2, 1], [1, -a2], lfilter([-a1, 1], [1, -a1], u))
        pair = [lfilter([0, 1], denominator, driven), lfilter([0, 0, 1], denominator, driven)]
        columns = np.column_stack([first, second, *pair, np.ones(n_samples)])
        theta = np.linalg.lstsq(columns, y, rcond=None)[0]
        residual = y - columns @ theta
        return residual @ residual

    return call


def costs(out: Print) -> None:
    out(f"{'cost, n = 4':<26}  us per candidate")
    out(f"{'N':<26}  one by one  lfilter+lstsq  ns per sample  peak memory MB")
    out(f"{'reach (N = 1000)':<26}  {'12':>10}  {'':>13}  {'constant':>13}  {'2000':>14}")
    for n_samples in (1_000, 10_000, 100_000, 1_000_000):
        cost, units = cost_of(n_samples)
        repeats, at_once = max(5, 200_000 // n_samples), max(1, 50_000 // n_samples)
        single = median_s(lambda cost=cost, units=units: cost.log(units[0]), repeats, at_once)
        library = median_s(lfilter_and_lstsq(n_samples), max(3, repeats // 10))
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        out(
            f"{n_samples:<26}  {1e6 * single:>10.1f}  {1e6 * library:>13.1f}  "
            f"{1e9 * single / n_samples:>13.2f}  {peak_mb:>14.0f}"
        )
    out()


def searches(out: Print) -> None:
    evaluations = FOURTH_ORDER.evaluations
    cost, _ = cost_of(1000)
    out(f"{f'DIRECT-L, {evaluations} evaluations':<26}  CPU ms")
    seconds = median_s(lambda: minimise(cost.log, 4, FOURTH_ORDER.algorithm, evaluations), 21)
    out(f"{'NLopt':<26}  {1e3 * seconds:>6.2f}")
    out()


def compiling(out: Print) -> None:
    with tempfile.TemporaryDirectory() as directory:
        environment = {**os.environ, "NUMBA_CACHE_DIR": directory}
        out(f"{'first fit of a process':<26}  CPU s")
        for name in ("nothing compiled yet", "compiled before"):
            run = subprocess.run(
                [sys.executable, "-c", FIRST_FIT], env=environment, capture_output=True, text=True, check=True
            )
            out(f"{name:<26}  {float(run.stdout):>5.2f}")


def run(out: Print, *, seeds: int = 50) -> None:
    fits(out, seeds)
    costs(out)
    searches(out)
    compiling(out)


if __name__ == "__main__":
    main(run)
