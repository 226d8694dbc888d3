"""Synthesis for the highest bandwidth that is met, where a specification leaves it open.

A specification with `lowest_bandwidth_rad_s` asks for `bandwidth_rad_s` where it can be met, and for as
much as can be met down to the lowest one. `synthesise_widest` tries bandwidths of a geometric series by
bisection, with short searches, and designs for the widest that promises to be met with a whole one.
"""

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

# Worst case at which a trial ends, and at most which it counts as met: clear of 1 by 5 %, since a trial is
# judged on coarser grids and by less search than the whole design, which has to stay below 1. Chosen.
_CLEAR = 0.95
# Ratio of neighbouring bandwidths, at most: the full search closes a part of it again, by a lower gamma.
# Chosen; at the square root of it one trial more is made of every bisection.
_RATIO = 1.3


def synthesise_widest(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[Specification, SynthesisResult]:
    """Design for the highest bandwidth that is met.

    Parameters
    ----------
    plants : sequence of UncertainPlant
        At least one; all of one sampling time.
    specification : Specification
        From `bandwidth_rad_s` down to `lowest_bandwidth_rad_s`, rad/s; without both, one design as
        `synthesise`.
    options : SynthesisOptions, optional
        Effort of the last design; trials have it too, but end at gamma = .95.
    rng : numpy.random.Generator
        Every bandwidth is tried with the same starts.
    progress : callable, optional
        Called with (fraction, message).

    Returns
    -------
    specification : Specification
        With the bandwidth that was designed for, and the order where "auto" was asked. Where no bandwidth is
        met, with the lowest one.
    result : SynthesisResult
        Of a whole design; its `gamma` is above 1 where no bandwidth is met.

    Raises
    ------
    SpecificationError
        Specification and plants contradict each other, at the bandwidth of the last design; a trial that they
        contradict counts as not met.

    Notes
    -----
    Bisection: a wider bandwidth is taken to ask for more. Trials start from controllers of the Youla bound,
    and from many starts only where these lead to nothing stable, until that has failed once; what many starts
    would meet beside them is not found. Several bandwidths are designed for in the end where the whole design
    misses one that a trial met.
    """
    options = options or SynthesisOptions()
    tell = progress or (lambda fraction, message: None)
    top = specification.bandwidth_rad_s
    lowest = specification.lowest_bandwidth_rad_s
    if top is None or lowest is None:
        result = synthesise(plants, specification, options, rng=rng, progress=progress)
        return with_order(specification, result), result

    count = 1 + int(np.ceil(np.log(top / lowest) / np.log(_RATIO)))
    # At least both ends.
    bandwidths = np.geomspace(top, lowest, max(count, 2)).tolist()
    trials = [stated(specification, bandwidth) for bandwidth in bandwidths]
    # A trial ends before it can mend a pole that is slower than the plant's grids; a whole design does.
    low_rad_s = options.omega_min_rad_s or min(lowest_rad_s(plant.dt_s, plant.poles) for plant in plants)
    # One draw, of all whole numbers that rng has: every trial and design begins with the same generator.
    seed = int(rng.integers(2**63))
    quick = options.model_copy(update={"sufficient_gamma": _CLEAR, "omega_min_rad_s": low_rad_s})
    many_starts_may_help = True

    def gamma(trial: Specification) -> float:
        """Worst case (no unit) of a quick design; inf: refused, or nothing stable.

        Where nothing is stable, `many_starts_may_help` goes to False for all later trials. Errors other than
        SpecificationError go up.
        """
        nonlocal many_starts_may_help
        tell(0.0, f"bandwidth {trial.bandwidth_rad_s:.3g} rad/s")
        # Where no fit of the Youla bound's controllers is stable, the bandwidth may still be met: by the many
        # starts of a thorough search.
        for thorough in (False, True) if many_starts_may_help else (False,):
            try:
                rng_of_trial = np.random.default_rng(seed)
                result = synthesise(plants, trial, quick, rng=rng_of_trial, thorough=thorough)
            except SpecificationError:
                return np.inf
            if np.isfinite(result.gamma):
                return result.gamma
        # Stability does not depend on the bandwidth asked: what many starts did not stabilise here, they are
        # not expected to stabilise in another trial. The last design looks once more.
        many_starts_may_help = False
        return np.inf

    # Trial `high` is met, or it is the last, of which nothing is known; all before `low` are not met.
    low = 0
    high = len(trials) - 1
    while low < high:
        middle = (low + high) // 2
        if gamma(trials[middle]) <= _CLEAR:
            high = middle
        else:
            low = middle + 1
    for trial in trials[high:]:
        rng_of_design = np.random.default_rng(seed)
        result = synthesise(plants, trial, options, rng=rng_of_design, progress=progress)
        if result.gamma <= 1.0:
            break
    return with_order(trial, result), result


def with_order(specification: Specification, result: SynthesisResult) -> Specification:
    """Specification with the order that was chosen, where "auto" was asked and a design was made.

    Parameters
    ----------
    specification : Specification
        Its `controller_order`: a number, or "auto".
    result : SynthesisResult
        A controller without states counts as no design.

    Returns
    -------
    Specification
        The one given where nothing changes.
    """
    if specification.controller_order != "auto" or not result.controller.order:
        return specification
    return specification.model_copy(update={"controller_order": result.controller.order})


def stated(specification: Specification, bandwidth_rad_s: float) -> Specification:
    """Specification with one bandwidth, rounded to three digits, and none that it may fall to.

    Parameters
    ----------
    specification : Specification
    bandwidth_rad_s : float
        Positive; not checked again, `synthesise` refuses what does not fit the plants.

    Returns
    -------
    Specification
        A copy; three digits, as pages state them and no requirement is known better.
    """
    rounded = float(f"{bandwidth_rad_s:.3g}")
    return specification.model_copy(update={"bandwidth_rad_s": rounded, "lowest_bandwidth_rad_s": None})
