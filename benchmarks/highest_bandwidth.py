"""Random plants whose bandwidth is left open: the bandwidth that is met, its worst case, and the time.

Plants and specifications are those of `benchmarks.random_designs`, from three times their bandwidth down to a
tenth of it. Of two searches the better one meets more bandwidth; at the same bandwidth a lower gamma is only
spare.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.harness import Print, main, timed
from benchmarks.random_designs import LOW_EFFORT, random_case
from control_design import SpecificationError
from control_design.synthesis.giving_way import synthesise_giving_way

# The range of bandwidths, as factors on the one that is drawn. Chosen: some of both ends are met.
_HIGHEST = 3.0
_LOWEST = 0.1


def run(out: Print, *, first_seed: int = 0, seeds: int = 45) -> None:
    """One line for each seed, then the median time."""
    times: list[float] = []
    met = 0
    out("seed  bandwidth rad/s   gamma  design s")
    for seed in range(first_seed, first_seed + seeds):
        plant, _, drawn = random_case(seed)
        assert drawn.bandwidth_rad_s is not None
        asked = drawn.model_copy(
            update={
                "bandwidth_rad_s": _HIGHEST * drawn.bandwidth_rad_s,
                "lowest_bandwidth_rad_s": _LOWEST * drawn.bandwidth_rad_s,
            }
        )
        search = partial(synthesise_giving_way, [plant], asked, LOW_EFFORT, rng=np.random.default_rng(seed))
        try:
            (used, result), taken = timed(search)
        except SpecificationError as refused:
            out(f"{seed:4d}  refused: {refused}")
            continue
        times.append(taken)
        met += result.gamma <= 1.0
        out(f"{seed:4d}  {used.bandwidth_rad_s:15.4g}  {result.gamma:6.4f}  {taken:8.2f}")
    out()
    out(
        f"met {met} of {len(times)}; CPU seconds of a search: median {np.median(times):.2f}, "
        f"all {sum(times):.0f}"
    )


if __name__ == "__main__":
    main(run)
