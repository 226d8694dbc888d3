"""Designs of order 5 for the published flexible link, scenarios A, B and C: worst case and CPU time.

Beside each: what the Youla bound of the same run says and costs. Published for the same plants and weights:
`mixsyn` on the disc over-bound, order 9, 1.296, 1.585, 2.234; D-K iteration, order 18, 1.066, 1.353, 1.899
in 8 to 14 s.
"""

from __future__ import annotations

import time

import numpy as np

from benchmarks.harness import Print, main
from control_design import certify, synthesise, youla_bracket
from control_design.convex.convex_options import YoulaOptions
from validation.example_plants import flexible_link, flexible_link_specification


def run(out: Print, *, order: int = 5, seeds: int = 5) -> None:
    asked = flexible_link_specification(order)
    synthesise([flexible_link("A")], asked, rng=np.random.default_rng(0))  # what starts once is not counted
    for scenario in ("A", "B", "C"):
        plant = flexible_link(scenario)
        bounds, spent, gammas = [], [], []
        for seed in range(seeds):
            start = time.process_time()
            bound = youla_bracket(plant, asked, YoulaOptions()).ellipse
            bounds.append(time.process_time() - start)
            start = time.process_time()
            result = synthesise([plant], asked, rng=np.random.default_rng(seed))
            spent.append(time.process_time() - start)
            gammas.append(certify(result.controller, [plant], asked).gamma)
        out(
            f"{scenario} order {order}: certified {np.median(gammas):.4f} ({min(gammas):.4f} to "
            f"{max(gammas):.4f}), Youla bound {bound:.4f}; {np.median(spent):.2f} s, the bound "
            f"{np.median(bounds):.2f} s"
        )


if __name__ == "__main__":
    main(run)
