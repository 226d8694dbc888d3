"""Landau's flexible transmission, three loads: the published score, then the smallest margin over the
specification.

    OMP_NUM_THREADS=1 python -m benchmarks.landau_transmission [--seed 1]

Six free parameters. First our synthesis for the three loads at once from the frequency-domain items (order 3
with integrator: six parameters), then a direct search from its controller, because four items are read off
step responses. The second part searches on for the largest smallest margin, for three ways to split the six
parameters.
"""

from __future__ import annotations

import time

import control
import numpy as np

from benchmarks.harness import Print, main
from benchmarks.landau_score import ITEMS, LOADS, TS_S, Law, all_values, margins, score
from benchmarks.landau_search import law_of, search
from control_design import Specification, SynthesisOptions, UncertainPlant, synthesise

SPECIFICATION = Specification(
    bandwidth_rad_s=1.0,
    integrator=True,
    modulus_margin=0.5,
    effort_limit=3.16,
    delay_margin_s=0.04,
    controller_order=3,
    computational_delay_samples=0,
)
QUICK = SynthesisOptions(
    starts=3,
    agreeing_starts=1,
    exchange_rounds=1,
    dense_points=1000,
    grid_points=50,
    mode_points=40,
    omega_min_rad_s=1e-2,
    sufficient_gamma=0.999,
)
SPLITS = {
    (4, 2): np.array([0.2, -0.55, 0.4, -0.05, -0.3, -0.2]),
    (3, 3): np.array([0.2, -0.5, 0.35, -0.05, -0.2, -0.15]),
    (5, 1): np.array([0.2, -0.55, 0.4, -0.05, 0.0, -0.5]),
}


def plants() -> list[UncertainPlant]:
    """The three loads, known exactly."""
    return [
        UncertainPlant(
            name, control.ss(control.tf(np.trim_zeros(np.array(b), "f"), np.array(a, dtype=float), TS_S))
        )
        for name, (a, b) in LOADS.items()
    ]


def synthesised(seed: int) -> tuple[np.ndarray, float]:
    """Parameters (6,) of our order-3 controller, S first, and its gamma."""
    result = synthesise(plants(), SPECIFICATION, QUICK, rng=np.random.default_rng(seed))
    transfer = control.tf(result.controller.to_control())
    r, s = np.asarray(transfer.den[0][0]), np.asarray(transfer.num[0][0])
    s = np.concatenate([np.zeros(r.size - s.size), s]) / r[0]
    inner = np.polydiv(r / r[0], np.array([1.0, -1.0]))[0]
    return np.concatenate([s, inner[1:]]), result.gamma


def table(out: Print, law: Law) -> None:
    found = all_values(law)
    assert found is not None
    smallest = margins(law)
    out(f"  {'item':<15} {'limit':>8}  " + "  ".join(f"{load:>8}" for load in found) + "   margin %")
    for item in ITEMS:
        cells = "  ".join(f"{v[item]:>8.3f}" for v in found.values())
        out(f"  {item:<15} {ITEMS[item].limit:>8}  {cells}  {100 * smallest[item]:>8.1f}")
    out(f"  R = {np.round(law.R, 7).tolist()}")
    out(f"  S = {np.round(law.S, 7).tolist()}, T = S(1) = {law.T[0]:.7f}")


def run(out: Print, *, seed: int = 1) -> None:
    begin = time.process_time()
    start, gamma = synthesised(seed)
    designed = time.process_time()
    x = search(start, 4, np.random.default_rng(seed), generations=150)
    done = time.process_time()
    law = law_of(x, 4)
    out("Reach: 100/100 with at most 6 free parameters in at most 10 s.")
    out(
        f"synthesis, order 3: gamma {gamma:.3f}, score {score(law_of(start, 4)):.1f}, "
        f"{designed - begin:.1f} s CPU; with the direct search: score {score(law):.1f}, "
        f"6 parameters, {done - begin:.1f} s CPU in all"
    )
    table(out, law)
    out()
    out("Largest smallest margin over the specification (share of each limit), 6 free parameters:")
    best: tuple[float, Law] | None = None
    for (s_free, r_free), first in SPLITS.items():
        begin = time.process_time()
        x = search(first, s_free, np.random.default_rng(seed), generations=1500)
        law = law_of(x, s_free)
        least = min(margins(law).values())
        out(
            f"  {s_free} in S, {r_free} in R: score {score(law):.1f}, smallest margin "
            f"{100 * least:.2f} %, {time.process_time() - begin:.1f} s CPU"
        )
        if best is None or least > best[0]:
            best = least, law
    assert best is not None
    out("best of them:")
    table(out, best[1])


if __name__ == "__main__":
    main(run)
