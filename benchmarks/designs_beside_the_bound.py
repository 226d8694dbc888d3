"""Random plants of `random_designs` with the order left open: how far a design lies above the bound.

The bound is that of the Youla bracket on the ellipses themselves, which no controller of any order beats but
for basis and grid. missed: the specification is not met although the bound meets it. `--order drawn` designs
with the order that the case draws, and prints no bound.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.harness import Print, main, timed
from benchmarks.random_designs import random_case
from control_design import SpecificationError, synthesise
from control_design.convex.youla import youla_bracket


def run(out: Print, *, first_seed: int = 1000, seeds: int = 30, order: str = "auto") -> None:
    """A line a plant; then the shares."""
    ratios, times, missed = list[float](), list[float](), 0
    out(" seed order   gamma  over the bound  CPU s")
    for seed in range(first_seed, first_seed + seeds):
        plant, _, specification = random_case(seed)
        if order == "auto":
            specification = specification.model_copy(update={"controller_order": "auto"})
        design = partial(synthesise, [plant], specification, rng=np.random.default_rng([seed, 2]))
        try:
            result, taken = timed(design)
        except SpecificationError as error:
            out(f"{seed:5d} refused: {str(error).splitlines()[0]}")
            continue
        times.append(taken)
        line = f"{seed:5d} {result.controller.order:5d} {result.gamma:8.4f}"
        if order == "auto":
            bound = youla_bracket([plant], specification).ellipse
            ratios.append(result.gamma / bound)
            missed += result.gamma > 1.0 >= bound
            line += f" {ratios[-1]:14.4f} "
        out(f"{line} {taken:6.2f}")
    if ratios:
        within = np.mean(np.array(ratios) <= 1.02)
        out(f"over the bound: median {np.median(ratios):.4f}, within 2 %: {within:.0%}, missed: {missed}")
    out(f"CPU seconds of a design: median {np.median(times):.2f}, largest {np.max(times):.2f}")


if __name__ == "__main__":
    main(run)
