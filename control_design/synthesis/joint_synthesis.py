"""Synthesis where a joint coverage is asked: design, draw samples, guard against unstable ones, again.

The weighted worst case is that of the ellipses at their level (say 95 %), frequency by frequency. Stability
is asked of nearly all sampled responses (say 99.9 %), also of those that the first-order ellipses do not
describe. The two are different statements and are kept apart: a sample that is unstable becomes a guard,
which the next design has to keep stable without meeting any weight for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from control_design.analysis.joint_coverage import unstable_draws
from control_design.plants.guards import Guard
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from control_design.synthesis.order_search import Progress
from control_design.synthesis.synthesis import part_of, synthesise
from control_design.synthesis.synthesis_options import SynthesisOptions
from control_design.synthesis.synthesis_result import Outcome, SynthesisResult
from ident.data.shown import Shown

# Guards that are added for each plant in a round, from far apart: each is one more set of rows in every
# descent. Chosen.
_MOST_GUARDS = 6
# Standard deviations of the count of unstable draws that are added before it counts as few enough: fresh
# draws shall confirm the share. Two are a one-sided level of 98 %.
_DEVIATIONS = 2.0


@dataclass(frozen=True, eq=False, repr=False)
class JointDesign(Shown):
    """A design whose sampled responses are stable as often as asked, or the best one of the search.

    Attributes
    ----------
    result : SynthesisResult
        Its `outcome` and `gamma` say what the design reaches; not converged: nothing kept the first guards.
    guards : tuple of Guard
        Responses that the design had to keep stable; empty for the first design.
    draws : int
        Responses that were drawn after each design.
    unstable : tuple of int
        Unstable ones among them, for the first design and each better one; the last is that of `result`.
        Empty where the first design did not converge.
    reached : bool
        That count, and two standard deviations of it more, are within the share that may be unstable.
    """

    result: SynthesisResult
    guards: tuple[Guard, ...]
    draws: int
    unstable: tuple[int, ...]
    reached: bool


def synthesise_jointly(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator,
    stable_share: float = 0.999,
    draws: int = 10_000,
    rounds: int = 3,
    first: SynthesisResult | None = None,
    progress: Progress | None = None,
) -> JointDesign:
    """Design, and design again with guards, until the share of stable draws is what is asked.

    Parameters
    ----------
    plants : sequence of UncertainPlant
        With uncertainties that can be drawn from.
    specification : Specification
        What every design is asked.
    options : SynthesisOptions, optional
        Of every design (`synthesise`).
    rng : numpy.random.Generator
        Draws starts and responses.
    stable_share : float
        Of the sampled responses that must be stable, in (0, 1). The default is far above the level of the
        ellipses (.95), since an unstable loop is worse than a missed weight.
    draws : int
        Responses drawn after every design, fresh ones each time; by default ten may be unstable, so that the
        count means something beside its scatter.
    rounds : int
        Designs with guards, at most; 0: the first design is counted only. The default is chosen: each costs a
        whole synthesis.
    first : SynthesisResult, optional
        The design without guards, where it is known already.
    progress : callable, optional
        Called with (fraction, message).

    Returns
    -------
    JointDesign
        The design with the fewest unstable draws.

    Raises
    ------
    SpecificationError
        Specification and plants contradict each other (before optimising).
    ValueError
        The share lies outside (0, 1), the draws are too few to show it, or an uncertainty cannot be drawn
        from.
    """
    if not 0 < stable_share < 1:
        raise ValueError(f"stable_share must lie in (0, 1); got {stable_share}")
    allowed = (1.0 - stable_share) * draws
    if not allowed >= 1:
        raise ValueError(
            f"{draws} draws cannot show a stable share of {stable_share:.6g}: at least "
            f"{int(np.ceil(1 / (1 - stable_share)))} are needed"
        )
    tell = progress or (lambda fraction, message: None)
    guards: list[Guard] = []
    best: JointDesign | None = None
    for number in range(rounds + 1):
        part = part_of(tell, number, rounds + 1)
        if number == 0 and first is not None:
            result = first
        else:
            result = synthesise(plants, specification, options, rng=rng, progress=part, guards=guards)
        if result.outcome is Outcome.NOT_CONVERGED:
            # Nothing keeps all guards stable: the design before is the best, if there is one.
            best = best or JointDesign(result, tuple(guards), draws, (), False)
            break
        count, new_guards = unstable_draws(
            result.controller, plants, specification, rng=rng, draws=draws, most=_MOST_GUARDS
        )
        if best is None or count < best.unstable[-1]:
            # The count is Poisson distributed: its standard deviation is its root.
            reached = bool(count + _DEVIATIONS * np.sqrt(count) <= allowed)
            earlier = () if best is None else best.unstable
            best = JointDesign(result, tuple(guards), draws, (*earlier, count), reached)
        if best.reached:
            break
        guards += new_guards
    assert best is not None
    tell(1.0, f"gamma {best.result.gamma:.4g}")
    return best
