"""Design where a specification leaves open how far some of its requirements give way.

Beside a value that is asked a specification may state how far it gives way (`GIVES_WAY`): a bandwidth down to
`lowest_bandwidth_rad_s`, an effort limit up to `highest_effort_limit`, the peak of a mode up to
`highest_mode_peak_ratio`. What states no such limit is hard. `synthesise_giving_way` meets what is hard with
as little given up as it finds, in this order:

1. the highest bandwidth that is met with everything else as asked, by bisection over a geometric series; 2.
where the lowest one is not met either, effort and mode peaks there, all by one common share of the way from
   the value asked to its limit, the least share that makes the rest feasible; then each of them back to what
   the controller needs.

The bandwidth goes first because it is what the rest of a specification leaves: a bandwidth is a wish, a limit
of effort says what the machine is thought to stand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from control_design.analysis.worst_case import Grids
from control_design.controllers.controller import Controller
from control_design.plants.frequency_grid import lowest_rad_s
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import GIVES_WAY, Specification, SpecificationError
from control_design.synthesis.order_search import FINER, Progress
from control_design.synthesis.synthesis import synthesise
from control_design.synthesis.synthesis_options import SynthesisOptions
from control_design.synthesis.synthesis_result import SynthesisResult
from control_design.synthesis.youla_starts import free_controllers

# Worst case of a quick design up to which a bandwidth counts as met; below 1, so that the whole design, which
# has to stay below 1, is met there, too. Chosen.
_CLEAR = 0.95
# Ratio of neighbouring bandwidths, at most: the full search closes a part of it again, by a lower gamma.
# Chosen; at the square root of it one trial more is made of every bisection.
_RATIO = 1.3
# Worst case that the least share of giving way is sought for: as near to 1 as is proved for all frequencies
# (`_PROVABLE`), with as much room below. Of an inertia whose effort limit gives way 2 % too much are given up
# (tests/control_design/test_giving_way.py); doubled distance from 1: 4 %.
_AIM = 0.995
# Worst case from which on less is not sought: as far below the aim as `_PROVABLE` lies above.
_NEAR_AIM = 0.993
# Designs at most that seek the least share. Between two ends the secant of log gamma meets the aim within one
# per cent after three to five of them; the others are for kinks, where another requirement takes over.
_MOST_SHARES = 8
# Worst case up to which a share counts as enough: bounds for all frequencies are cut to within 0.2 % of the
# dense maximum (`EXCESS` of `control_design.analysis.between_grid_points`), and closer under 1 they may need
# more intervals than there are.
_PROVABLE = 0.997
# Of a requirement's value beyond what the controller needs, for the same reason.
_ROOM_FOR_PROOF = 3e-3

# Requirements that give way together, by the key that limits each: name of its weighted requirement.
_WEIGHTED = {"effort_limit": "effort", "mode_peak_ratio": "mode damping"}


def synthesise_giving_way(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[Specification, SynthesisResult]:
    """Design for what is asked, or for as little less as meets what gives no way.

    Parameters
    ----------
    plants : sequence of UncertainPlant
        At least one; all of one sampling time.
    specification : Specification
        With limits up to which requirements give way; without any, one design.
    options : SynthesisOptions, optional
        Effort of the last design; trials have it too, but end at gamma = .95.
    rng : numpy.random.Generator
        Every design begins with the same starts.
    progress : callable, optional
        Called with (fraction, message).

    Returns
    -------
    specification : Specification
        What was designed for: every requirement as stated or as far as it gave way, none that gives way
        further, and the order where "auto" was asked. Where nothing is met, with the lowest bandwidth and the
        rest as asked.
    result : SynthesisResult
        Of the last design; its `gamma` is above 1 where nothing is met.

    Raises
    ------
    SpecificationError
        Specification and plants contradict each other however far it gives way; a trial that they contradict
        counts as not met.

    Notes
    -----
    A wider bandwidth, and less effort, are taken to ask for more. What the Youla bound says no controller of
    any order reaches is not tried. Trials start from the controller of the
    last trial that was met, then from the Youla bound, and from many starts only where these lead to nothing
    stable, until that has failed once; what many starts would meet beside them is not found. Once a design
    meets the specification no further starts are tried: a lower gamma would only be spare.
    """
    options = options or SynthesisOptions()
    tell = progress or (lambda fraction, message: None)
    giving = [key for key, limit in GIVES_WAY.items() if getattr(specification, limit) is not None]
    if not giving:
        only = synthesise(plants, specification, options, rng=rng, progress=progress, enough=1.0)
        return with_order(specification, only), only

    designs = _Designs(plants, options, int(rng.integers(2**63)), tell)
    weighted = [key for key in giving if key in _WEIGHTED]
    asked, result, refused = _highest_bandwidth(specification, designs)
    if weighted and (result is None or result.gamma > 1.0):
        least = _least_given_way(specification, asked, weighted, result, designs)
        if least is not None:
            asked, result = least
    if result is None:
        assert refused is not None
        raise refused
    return with_order(asked, result), result


@dataclass(eq=False)
class _Designs:
    """Designs of one search, each from the controller of the last trial that was met.

    Attributes
    ----------
    plants, options, tell
        As of `synthesise_giving_way`.
    seed : int
        Of every design's generator.
    last : Controller or None
        Of the last trial that was met.
    many_starts_may_help : bool
        Until they found nothing stable once. Stability does not depend on what is asked: what many starts did
        not stabilise, they are not expected to stabilise in another trial. The last design looks once more.
    """

    plants: Sequence[UncertainPlant]
    options: SynthesisOptions
    seed: int
    tell: Progress
    last: Controller | None = None
    many_starts_may_help: bool = True
    quick_options: SynthesisOptions = field(init=False)

    def __post_init__(self) -> None:
        """Options of trials: they end once they are clearly met.

        A trial ends before it can mend a pole that is slower than the plant's grids, so these begin there.
        """
        lowest = self.options.omega_min_rad_s or min(
            lowest_rad_s(plant.dt_s, plant.poles) for plant in self.plants
        )
        self.quick_options = self.options.model_copy(
            update={"sufficient_gamma": _CLEAR, "omega_min_rad_s": lowest}
        )

    def generator(self) -> np.random.Generator:
        """The same generator for every design."""
        return np.random.default_rng(self.seed)

    def is_met(self, trial: Specification, message: str) -> bool:
        """Whether a quick design clearly meets a specification without limits that give way.

        Its controller is `last` then. False where plants and specification contradict each other, or nothing
        stable is found. Errors other than SpecificationError go up.
        """
        self.tell(0.0, message)
        try:
            if self.is_out_of_reach(trial):
                return False
            # Where no fit of the Youla bound's controllers is stable, the trial may still be met: by the many
            # starts of a thorough search.
            for thorough in (False, True) if self.many_starts_may_help else (False,):
                result = synthesise(
                    self.plants,
                    trial,
                    self.quick_options,
                    rng=self.generator(),
                    thorough=thorough,
                    known=() if self.last is None else (self.last,),
                    is_trial=True,
                )
                if np.isfinite(result.gamma):
                    if result.gamma <= _CLEAR:
                        self.last = result.controller
                    return result.gamma <= _CLEAR
        except SpecificationError:
            return False
        self.many_starts_may_help = False
        return False

    def is_out_of_reach(self, trial: Specification) -> bool:
        """Whether no controller of any order clearly meets a specification, as the Youla bound tells.

        Its floor lies so far above what a trial is to reach that the small basis does not explain it. Raises
        SpecificationError where plants and specification contradict each other.
        """
        trial.check_against(self.plants)
        return free_controllers(self.plants, trial).floor > FINER * _CLEAR

    def whole(self, specification: Specification) -> SynthesisResult:
        """The best design for a specification; many starts only where the others do not meet it.

        Raises SpecificationError where plants and specification contradict each other.
        """
        known = () if self.last is None else (self.last,)
        return synthesise(
            self.plants,
            specification,
            self.options,
            rng=self.generator(),
            progress=self.tell,
            known=known,
            enough=1.0,
        )


def _highest_bandwidth(
    specification: Specification, designs: _Designs
) -> tuple[Specification, SynthesisResult | None, SpecificationError | None]:
    """Design for the highest bandwidth that is met, everything else as it is asked.

    Returns
    -------
    specification : Specification
        With one bandwidth, and nothing that gives way.
    result : SynthesisResult or None
        Of the whole design there; `gamma` above 1 where not even the lowest bandwidth is met, None where that
        one contradicts the plants.
    refused : SpecificationError or None
        The contradiction.
    """
    top = specification.bandwidth_rad_s
    lowest = specification.lowest_bandwidth_rad_s
    trials = [without_limits(specification)]
    if top is not None and lowest is not None:
        count = 1 + int(np.ceil(np.log(top / lowest) / np.log(_RATIO)))
        # At least both ends.
        bandwidths = np.geomspace(top, lowest, max(count, 2)).tolist()
        trials = [stated(specification, bandwidth) for bandwidth in bandwidths]

    # Trial `high` is met, or it is the last, of which nothing is known; all before `low` are not met.
    low = 0
    high = len(trials) - 1
    while low < high:
        middle = (low + high) // 2
        trial = trials[middle]
        if designs.is_met(trial, f"bandwidth {trial.bandwidth_rad_s:.3g} rad/s"):
            high = middle
        else:
            low = middle + 1

    # Several bandwidths where the whole design misses one that a trial met.
    result: SynthesisResult | None = None
    for trial in trials[high:]:
        try:
            result = designs.whole(trial)
        except SpecificationError as refused:
            return trial, None, refused
        if result.gamma <= 1.0:
            break
    return trial, result, None


def _least_given_way(
    specification: Specification,
    asked: Specification,
    keys: Sequence[str],
    missed: SynthesisResult | None,
    designs: _Designs,
) -> tuple[Specification, SynthesisResult] | None:
    """Design with the least common share of the way from what is asked to the limits.

    Parameters
    ----------
    specification : Specification
        With the limits.
    asked : Specification
        What was missed: with one bandwidth and without limits.
    keys : sequence of str
        That give way.
    missed : SynthesisResult or None
        The design for `asked`; None: it contradicts the plants.
    designs : _Designs

    Returns
    -------
    specification, result
        Each key as far as the controller needs it; None where the limits themselves are not met.

    Notes
    -----
    The worst case gamma falls as the share grows. Secants of log gamma over the share (regula falsi, its
    kept end halved each time as in the Illinois variant) lead to the share at which it is `_AIM`.
    """
    if missed is not None and np.isfinite(missed.gamma):
        designs.last = missed.controller
    high = 1.0
    try:
        best = designs.whole(_at_share(specification, asked, keys, high))
    except SpecificationError:
        return None
    if best.gamma > 1.0:
        return None
    designs.last = best.controller

    def gamma_above_aim(result: SynthesisResult | None) -> float:
        """log(gamma / aim); a loop that is not stable is far above."""
        if result is None or not np.isfinite(result.gamma):
            return 1.0
        return float(np.log(result.gamma / _AIM))

    low = 0.0
    above_at_low = gamma_above_aim(missed)
    above_at_high = min(gamma_above_aim(best), -1e-6)
    for number in range(_MOST_SHARES):
        if best.gamma >= _NEAR_AIM:
            break
        designs.tell(number / _MOST_SHARES, "how far requirements give way")
        share = low + (high - low) * above_at_low / (above_at_low - above_at_high)
        trial = _at_share(specification, asked, keys, share)
        try:
            result = designs.whole(trial)
        except SpecificationError:
            result = None
        if result is not None and result.gamma <= _PROVABLE:
            high = share
            best = result
            designs.last = result.controller
            above_at_high = min(gamma_above_aim(result), -1e-6)
            above_at_low *= 0.5
        else:
            low = share
            above_at_low = max(gamma_above_aim(result), 1e-6)
            above_at_high *= 0.5
    return _as_far_as_needed(asked, _at_share(specification, asked, keys, high), keys, best, designs), best


def _at_share(
    specification: Specification, asked: Specification, keys: Sequence[str], share: float
) -> Specification:
    """What is asked with keys moved by a share of the way to their limits, on a logarithmic scale.

    share: 0: as asked, 1: at the limits of `specification`. Rounded up to three digits. Every value is
    positive, which the limits' fields ensure.
    """
    values = {}
    for key in keys:
        value = getattr(specification, key)
        limit = getattr(specification, GIVES_WAY[key])
        values[key] = min(_rounded_up(value * (limit / value) ** share), limit)
    return asked.model_copy(update=values)


def _as_far_as_needed(
    asked: Specification,
    used: Specification,
    keys: Sequence[str],
    result: SynthesisResult,
    designs: _Designs,
) -> Specification:
    """What was designed for, with every key as near to what is asked as the controller allows.

    Parameters
    ----------
    asked, used : Specification
        As asked, and with the common share.
    keys : sequence of str
    result : SynthesisResult
        Of the design for `used`.
    designs : _Designs

    Returns
    -------
    Specification
        Of each key the value asked, or the controller's worst case on the dense grids with `_ROOM_FOR_PROOF`,
        rounded up to three digits, never beyond that of `used`.
    """
    grids = Grids(designs.plants, asked, designs.options)
    largest = dict.fromkeys(keys, 0.0)
    for data in grids.dense:
        omega = data.ellipses.omega_rad_s
        worst_cases = data.weighted(result.controller.response(omega, with_delay=False))
        for key in keys:
            largest[key] = max(largest[key], float(np.max(worst_cases[_WEIGHTED[key]])))
    values = {}
    for key in keys:
        needed = getattr(asked, key) * largest[key] * (1.0 + _ROOM_FOR_PROOF)
        if largest[key] <= 1.0:
            values[key] = getattr(asked, key)
        else:
            values[key] = min(_rounded_up(needed), getattr(used, key))
    return used.model_copy(update=values)


def _rounded_up(value: float) -> float:
    """A positive value with three digits, not below it."""
    unit = 10.0 ** (np.floor(np.log10(value)) - 2)
    return float(f"{np.ceil(value / unit * (1 - 1e-12)) * unit:.3g}")


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


def without_limits(specification: Specification) -> Specification:
    """Specification whose requirements are all hard, as they are asked.

    Nothing can be refused; without limits the copy is equal.
    """
    return specification.model_copy(update=dict.fromkeys(GIVES_WAY.values()))


def stated(specification: Specification, bandwidth_rad_s: float) -> Specification:
    """Specification with one bandwidth, rounded to three digits, and nothing that gives way.

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
    return without_limits(specification).model_copy(update={"bandwidth_rad_s": rounded})
