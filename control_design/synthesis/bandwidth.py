"""The bandwidth of a specification that leaves it open down to `lowest_bandwidth_rad_s`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from control_design.plants.frequency_grid import lowest_rad_s
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification, SpecificationError
from control_design.synthesis.order_search import Progress
from control_design.synthesis.synthesis import synthesise
from control_design.synthesis.synthesis_options import SynthesisOptions
from control_design.synthesis.synthesis_result import SynthesisResult

# A trial, without the search from many starts, ends with a design this much clear of the specification.
_CLEAR = 0.95
_QUICK = {"sufficient_gamma": _CLEAR}
# Bandwidths that are tried lie this ratio apart, about: the full search closes a part of it again.
_RATIO = 1.3


def synthesise_widest(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[Specification, SynthesisResult]:
    """`synthesise` for the highest bandwidth that is met, from bandwidth_rad_s down to
    lowest_bandwidth_rad_s; and the specification with that bandwidth. Where none is met, for the lowest.

    Trials look for it by bisection: a wider bandwidth is taken to ask for more. They start from controllers
    of the Youla bound only; what they miss and many starts would meet is not found. Raises SpecificationError
    as `synthesise`.
    """
    options, tell = options or SynthesisOptions(), progress or (lambda fraction, message: None)
    top, lowest = specification.bandwidth_rad_s, specification.lowest_bandwidth_rad_s
    if top is None or lowest is None:
        found = synthesise(plants, specification, options, rng=rng, progress=progress)
        return with_order(specification, found), found
    count = 1 + int(np.ceil(np.log(top / lowest) / np.log(_RATIO)))
    tried = [stated(specification, value) for value in np.geomspace(top, lowest, max(count, 2)).tolist()]
    # A trial ends before it can mend a pole that is slower than the plant's grids; a whole design does.
    low_rad_s = options.omega_min_rad_s or min(lowest_rad_s(plant.dt_s, plant.poles) for plant in plants)
    root, quick = int(rng.integers(2**63)), options.model_copy(update=_QUICK | {"omega_min_rad_s": low_rad_s})

    searches = [False, True]  # where no fit is stable, the bandwidth may still be met

    def gamma(one: Specification) -> float:
        tell(0.0, f"bandwidth {one.bandwidth_rad_s:.3g} rad/s")
        for thorough in tuple(searches):
            try:
                found = synthesise(plants, one, quick, rng=np.random.default_rng(root), thorough=thorough)
            except SpecificationError:
                return np.inf
            if np.isfinite(found.gamma):
                return found.gamma
        # What nothing stabilises, nothing stabilises at another bandwidth: the last design looks once more.
        searches[1:] = []
        return np.inf

    low, high = 0, len(tried) - 1  # all from `high` on are met, or nothing is known of the last
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if gamma(tried[middle]) <= _CLEAR else (middle + 1, high)
    for one in tried[high:]:
        found = synthesise(plants, one, options, rng=np.random.default_rng(root), progress=progress)
        if found.gamma <= 1.0:
            break
    return with_order(one, found), found


def with_order(specification: Specification, found: SynthesisResult) -> Specification:
    """The specification with the order that was chosen where "auto" was asked and a design found."""
    if specification.controller_order != "auto" or not found.controller.order:
        return specification
    return specification.model_copy(update={"controller_order": found.controller.order})


def stated(specification: Specification, bandwidth_rad_s: float) -> Specification:
    """The specification with this bandwidth and no other."""
    return specification.model_copy(
        update={"bandwidth_rad_s": float(f"{bandwidth_rad_s:.3g}"), "lowest_bandwidth_rad_s": None}
    )
