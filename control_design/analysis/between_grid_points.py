"""The worst case over the ellipses for all frequencies: upper bounds on intervals, cut until they are tight.

With K, the centre c and the generators S of the ellipses expanded to first order around the middle of an
interval (`plants.first_order`, `plants.set_expansion`), and one unit normal u kept over it,

    dist(-1, K E) >= Re(conj(u) (1 + K c)) - |Re(conj(u) K S)|,

whose linear part is concave over the interval; every numerator (|W1|, |W3 K|, ...) has a convex linear part.
The quotient is then largest at an end, and the remainders are added there. Everything is multiplied by (z -
1)^i, i the integrators of the loop, so that intervals may reach down to zero frequency. The winding of
1 + K c is counted on the same intervals: with it no ellipse on -1 means that every plant in them is stable.

`bound_all_frequencies` is the entry: it refuses what cannot be expanded, cuts intervals (`_bisect`) until
each bound (`_Loop.bounds`) is close to the dense maximum, and judges (`_verdict`). Neglected: rounding of
double precision.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from control_design.analysis.stability import loop_integrators
from control_design.analysis.worst_case import WorstCase
from control_design.controllers.controller import Controller
from control_design.plants.ellipses import (
    Complex,
    Ellipses,
    Real,
    farthest_distance,
    largest_disturbance_gain,
    quotient,
    secular_root,
)
from control_design.plants.first_order import FrequencyIntervals, RationalResponse
from control_design.plants.frequency_grid import starting_edges
from control_design.plants.plant_set import Mode, PlantChannel, UncertainPlant, frequency_response
from control_design.plants.set_expansion import Expand, SetExpansion, expandable
from control_design.specification import Specification
from control_design.specification.requirement import WeightedRequirement

# Excess of a bound over the dense maximum, relative, at which an interval is good enough: the pages say 0.2
# %, the tests ask for 0.5 %. Halved, the proofs of three loops of the tests need at most 7 % more intervals.
EXCESS = 0.002
# Such an excess where a dense maximum lies closer than `EXCESS` under its limit 1, which the bound must not
# exceed. Chosen; it is below `_PROOF_SLACK`, with which a requirement counts as met.
LEAST_EXCESS = 1e-5
# Limit of work, and of memory: a proof that needs more is given up. Chosen, nine times what the widest
# posterior seen needs (6 300 intervals, .35 s: a position identified through friction at 1 kHz, over a basis
# whose coefficients nearly cancel); with 6 000 no test moves.
_MOST_INTERVALS = 60_000
# Parts into which an interval is cut that is not good enough. With two or six no test moves, and the number
# of intervals changes by 2 %.
_PARTS = 3
# Largest relative disagreement of zeros and poles with the state space that a proof allows: far below
# `EXCESS`. The flexible link of the tests shows 8e-7, an arm with one mode 2e-10.
_MODEL_ERROR = 1e-6
# Relative width below which an interval is not cut: some 1e5 roundings of its frequency.
_LEAST_WIDTH = 1e-11

# The comparison of `_difference` is relative to the value, but not below this share of the largest one: where
# a response has a zero, its rounding is that of its terms. Chosen, some million roundings.
_SMALLEST_SHARE = 1e-9
# Likewise for shapes of ellipses: below this share of the centre's square, axes of a millionth of the centre,
# an ellipse has no size. Chosen.
_SMALLEST_SHAPE = 1e-12
# Least divisor: keeps quotients finite; no response in units of a machine is as small.
_TINY = 1e-300
# Least length, in units of a response, by which lengths are scaled: keeps the quotient 0/0 of a point at the
# centre of an ellipse of no size from being nan. Far below any response, so its value decides nothing.
_TINY_LENGTH = 1e-100

# Keeps a multiplier of ellipses away from zero; multipliers that decide are of the size of gamma squared.
_TINY_MULTIPLIER = 1e-30


class Obstacle(Enum):
    """Why nothing was proved for all frequencies; `AllFrequencies.obstacle_at` is the number in brackets."""

    OWN_FREQUENCIES = "uncertainty without model"
    OWN_PERFORMANCE_FREQUENCIES = "performance channel without model"
    NO_DERIVATIVES = "uncertainty without derivatives"
    INEXACT = "inexact zeros and poles"  # relative difference
    NOT_STABLE = "not robustly stable"
    NO_DISTANCE = "distance not positive"  # rad/s
    WINDING = "wrong winding"


# Obstacles that were met by trying: the uncertainty can be bounded between frequencies.
_MET_BY_TRYING = (Obstacle.NOT_STABLE, Obstacle.NO_DISTANCE, Obstacle.WINDING)


@dataclass(frozen=True)
class AllFrequencies:
    """What was proved for every frequency from 0 to Nyquist, ends included, on one plant.

    Attributes
    ----------
    possible : bool
        The uncertainty can be bounded between frequencies.
    proved : bool
        No ellipse reaches -1 anywhere, and 1 + K c winds as that of a stable loop.
    obstacle : Obstacle or None
        Why nothing was proved; None with a proof.
    obstacle_at : float or None
        The number that belongs to it: rad/s, or a relative difference.
    gamma : float
        Largest of the bounds.
    bounds : dict of str to float
        Upper bound of each weighted worst case, by name of the requirement; inf: none was found.
    distance : float
        Lower bound of dist(-1, K E); 0 without a proof.
    half_turns : float
        Of 1 + K c from 0+ to Nyquist, in units of pi, exact by the intervals; 0 without a proof.
    intervals : int
        Number of intervals that were looked at.
    """

    possible: bool
    proved: bool
    obstacle: Obstacle | None = None
    obstacle_at: float | None = None
    gamma: float = np.inf
    bounds: dict[str, float] = field(default_factory=dict)
    distance: float = 0.0
    half_turns: float = 0.0
    intervals: int = 0

    @classmethod
    def ended_by(cls, obstacle: Obstacle, at: float | None = None, **results: Any) -> AllFrequencies:
        """Nothing proved because of an obstacle; at: its number; results: other fields that are known.

        Fields that are not in `results` keep the values of no proof: gamma inf, distance 0. Nothing is
        checked.
        """
        return cls(obstacle in _MET_BY_TRYING, False, obstacle, at, **results)


class _Bounds(NamedTuple):
    """What holds on each of F intervals, for K requirements.

    centre (F,): their middles, rad/s. upper (K, F): upper bounds of the worst cases. middle (K, F): worst
    cases at the middle, to the accuracy of the normal. distance (F,): lower bound of dist(-1, K E). start,
    end (F,) complex: 1 + L times (z - 1)^integrators at the lower and upper ends, by the linear parts.
    """

    centre: Real
    upper: Real
    middle: Real
    distance: Real
    start: Complex
    end: Complex


class _BothEnds(NamedTuple):
    """One value (F,) at the lower and at the upper end of every interval."""

    low: Real
    high: Real


class _WeightedBound(NamedTuple):
    """Upper bounds (F,) of one weighted worst case on intervals, and its values (F,) at their middles."""

    upper: Real
    middle: Real


class _Asked(NamedTuple):
    """One weighted requirement, its weight as a rational response, and its independent channel or None."""

    requirement: WeightedRequirement
    weight: RationalResponse
    channel: Expand | None


@dataclass(frozen=True, eq=False)
class _Loop:
    """Everything rational of one plant, controller and specification.

    plant: its `n_integrators` is read. specification: its `computational_delay_samples` is read. controller:
    zeros, poles and gain in z, without that delay. members: expands the ellipses on intervals, from
    (intervals, power of z - 1). asked: the requirements to bound, K of them.
    """

    plant: UncertainPlant
    specification: Specification
    controller: RationalResponse
    members: Expand
    asked: tuple[_Asked, ...]

    def bounds(self, intervals: FrequencyIntervals) -> _Bounds:
        """Upper bounds of every requirement, and lower bounds of the distance, on F intervals.

        intervals: middles and half widths (F,), rad/s. Where an interval is too wide for its expansion (a
        root within it, a remainder larger than the distance), the distance is 0 and the upper bounds are inf,
        and the caller cuts it. Nothing is checked.
        """
        # 1 + L, multiplied by (z - 1)^i of controller and plant so that it is finite at zero frequency.
        n_controller = self.controller.integrators
        n_plant = self.plant.n_integrators
        delay = self.specification.computational_delay_samples
        law = self.controller.delayed(delay).expand(intervals, n_controller)
        loop_gain = self.members(intervals, n_plant).times(law)
        clear = intervals.cleared(n_controller + n_plant)
        difference = SetExpansion(clear + loop_gain.centre, loop_gain.groups)

        # Distance of the set from 0 along one normal per interval: linear parts at both ends less remainders.
        normal = _normal(difference.centre.value, difference.gram())
        remainder = difference.remainder()
        along_normal = [
            np.real(np.conj(normal) * difference.centre.end(side)) - difference.support(normal, side)
            for side in (-1, 1)
        ]
        ends = _BothEnds(low=along_normal[0] - remainder, high=along_normal[1] - remainder)
        at_middle = np.real(np.conj(normal) * difference.centre.value) - difference.support(normal, 0)

        # Each requirement on the intervals that its band touches; 0 elsewhere. No band is all frequencies.
        half_width = intervals.half_width
        upper = np.zeros((len(self.asked), half_width.size))
        middle = np.zeros((len(self.asked), half_width.size))
        for row, asked in enumerate(self.asked):
            band_low, band_high = asked.requirement.band or (-np.inf, np.inf)
            begins_before = intervals.centre - half_width < band_high
            ends_after = intervals.centre + half_width > band_low
            use = begins_before & ends_after
            if not np.any(use):
                continue
            part = intervals.part(use)
            part_ends = _BothEnds(ends.low[use], ends.high[use])
            if asked.requirement.of_member.of_plant:
                bound = self._with_member(asked, part, part_ends)
            else:
                bound = self._without_member(asked, part, part_ends, at_middle[use])
            upper[row, use] = bound.upper
            middle[row, use] = bound.middle

        nearest = np.minimum(ends.low, ends.high)
        distance = np.where(nearest > 0, nearest / clear.largest(), 0.0)
        start = difference.centre.end(-1)
        end = difference.centre.end(1)
        return _Bounds(intervals.centre, upper, middle, distance, start, end)

    def _without_member(
        self, asked: _Asked, intervals: FrequencyIntervals, ends: _BothEnds, at_middle: Real
    ) -> _WeightedBound:
        """Bound of |W S| or |W K S|, times |Gp| of an independent channel, on F intervals.

        ends, at_middle (F,): lower bounds of |1 + K G| times (z - 1)^i at the ends, its value at the middles.

        Inf where such a lower bound is not positive. Nothing is checked.
        """
        n_controller = self.controller.integrators
        n_plant = self.plant.n_integrators
        if asked.requirement.function.of_controller:
            weight = asked.weight.expand(intervals, n_plant)
            numerator = weight.times(self.controller.expand(intervals, n_controller))
        else:
            numerator = asked.weight.expand(intervals, n_controller + n_plant)
        # Convex over concave is largest at an end.
        largest_low = np.abs(numerator.end(-1)) + numerator.remainder
        largest_high = np.abs(numerator.end(1)) + numerator.remainder
        at_low = quotient(largest_low, ends.low, np.inf)
        at_high = quotient(largest_high, ends.high, np.inf)
        upper = np.maximum(np.maximum(at_low, at_high), 0.0)
        middle = quotient(np.abs(numerator.value), at_middle, np.inf)

        if asked.channel is not None:
            channel = asked.channel(intervals, 0)
            largest = np.maximum(_farthest(channel, -1), _farthest(channel, 1)) + channel.remainder()
            upper = largest * upper
            middle = _farthest(channel, 0) * middle
        if asked.requirement.above > 0:
            # Where the weight asks for less, another requirement is bounded instead.
            cleared = intervals.cleared(asked.weight.integrators)
            least = asked.requirement.above * np.maximum(np.abs(cleared.value) - cleared.change(), 0.0)
            largest_weight = asked.weight.expand(intervals, asked.weight.integrators).largest()
            counts = largest_weight > least
            upper = np.where(counts, upper, 0.0)
            middle = np.where(counts, middle, 0.0)
        return _WeightedBound(upper, middle)

    def _with_member(self, asked: _Asked, intervals: FrequencyIntervals, ends: _BothEnds) -> _WeightedBound:
        """Bound of |W G S| or |W T| on F intervals, G the member, W finite at zero frequency.

        ends (F,): lower bounds of |1 + K G| times (z - 1)^i at the ends. Members G, G0 of the ellipses at
        omega and at the middle, g = G/(1 + G K):
        g - g0 = (G - G0 + G G0 (K0 - K))/((1 + G K)(1 + G0 K0)), hence with the largest |G - G0| = e
        M <= M0 + e/(d d0) + M M0 |K - K0|.

        Inf where d is not positive or M |K - K0| >= 1, which a cut of the interval mends. Nothing is checked.
        """
        n_cleared = self.controller.integrators + self.plant.n_integrators
        delay = self.specification.computational_delay_samples
        law = self.controller.delayed(delay).expand(intervals)
        members = self.members(intervals, 0)
        ellipses = Ellipses(intervals.centre, members.centre.value, *_axes(members.gram()))
        at_middle = largest_disturbance_gain(law.value, ellipses)
        moved = members.centre.change() + sum(group.change() for group in members.groups)
        nearest = np.minimum(ends.low, ends.high) / intervals.cleared(n_cleared).largest()
        turn = at_middle * law.change()
        has_distance = nearest > 0
        turns_little = turn < 1
        is_bounded = has_distance & turns_little & np.isfinite(at_middle)
        with np.errstate(divide="ignore", invalid="ignore"):
            # d0 >= nearest as well: the middle belongs to the interval.
            bound = (at_middle + moved / nearest**2) / (1.0 - turn)
        factor = asked.weight.expand(intervals)
        if asked.requirement.function.of_controller:
            factor = factor.times(law)
        upper = np.where(is_bounded, factor.largest() * bound, np.inf)
        return _WeightedBound(upper, np.abs(factor.value) * at_middle)


def _normal(point: Complex, shape: Real) -> Complex:
    """Unit normals (F,) complex from ellipses e^T P^-1 e <= 1 at the origin towards points (F,).

    shape: P (F, 2, 2). The normal is (P + t)^-1 point, normalised, t the `secular_root`. Any normal gives a
    valid bound; that of a point inside the ellipse means nothing.

    For a point at the centre it is 1. Nothing is checked: nan in gives nan out.
    """
    major, minor, axis = _axes(shape)
    # Lengths in units of the largest: squares of squares stay far from the ends of the number range.
    largest = np.maximum(np.abs(point), major)
    scale = np.maximum(largest, _TINY_LENGTH)
    turned = point * np.conj(axis) / scale
    a = major / scale
    b = minor / scale
    root = secular_root(np.abs(turned.real) * a, np.abs(turned.imag) * b, a * a, b * b)
    t = np.maximum(root, _TINY_MULTIPLIER)
    normal = (turned.real / (a**2 + t) + 1j * turned.imag / (b**2 + t)) * axis
    return np.asarray(quotient(normal, np.abs(normal), 1.0), dtype=np.complex128)


def _axes(shape: Real) -> tuple[Real, Real, Complex]:
    """Semi-axes, the larger first, and direction of the larger one, (F,) each, of e^T P^-1 e <= 1.

    shape: P (F, 2, 2). They are roots of the eigenvalues of P, and the angle of its first eigenvector as a
    complex number of modulus one.

    Not checked: that P is symmetric. A small eigenvalue that rounding made negative counts as zero.
    """
    a = shape[:, 0, 0]
    b = shape[:, 0, 1]
    d = shape[:, 1, 1]
    # Closed form of the eigenvalues of a symmetric 2 x 2 matrix: half trace, plus and minus half the gap.
    half_gap = np.hypot((a - d) / 2, b)
    large = (a + d) / 2 + half_gap
    small = np.maximum((a + d) / 2 - half_gap, 0.0)
    direction = np.exp(0.5j * np.arctan2(2 * b, a - d))
    return np.sqrt(large), np.sqrt(small), direction


def _farthest(members: SetExpansion, side: int) -> Real:
    """Largest modulus (F,) over the linear part of a set of responses on F intervals.

    side: -1 lower end of the intervals, 0 middle, 1 upper end. Of two groups of generators an ellipse around
    both is taken, so it is an upper bound. Nothing is checked.
    """
    major, minor, direction = _axes(members.gram(side))
    centre = members.centre.end(side) * np.conj(direction)
    return farthest_distance(centre, major, minor)


def bound_all_frequencies(
    controller: Controller,
    plant: UncertainPlant,
    specification: Specification,
    worst: WorstCase,
    *,
    modes: tuple[Mode, ...],
    between_own_points: str = "nothing",
) -> AllFrequencies:
    """Bound every weighted worst case and the distance from -1 for all frequencies from 0 to Nyquist.

    Parameters
    ----------
    controller : Controller
        One error, one command (not checked), with a stable loop: callers ask for no other.
    plant : UncertainPlant
        Nominal model and ellipses.
    specification : Specification
        Its weighted requirements on the plant are bounded, with its computational delay.
    worst : WorstCase
        The dense check, of which the largest value of every requirement is read: an interval is cut until its
        bound is within 0.2 % of the dense maximum, or under the limit 1 where the dense maximum lies closer
        under it.
    modes : tuple of Mode
        Flexible modes of plant, controller and closed loop, where the first partition is finer.
    between_own_points : {"nothing", "linear"}
        What may be assumed of a response that is known on its own frequencies only.

    Returns
    -------
    AllFrequencies
        With an obstacle where nothing could be proved.

    Raises
    ------
    SpecificationError
        `Specification.weighted`: a mode's peak is limited and the plant has no mode.
    KeyError
        `worst` lacks one of the requirements.

    Notes
    -----
    Neglected: rounding errors of double precision, also those of the zeros and poles computed from the state
    spaces. The responses and ellipses so represented are compared with those of the dense check on the first
    partition, and the proof is refused beyond a relative difference of 1e-6.
    """
    n_loop, unstable = loop_integrators(controller, plant)
    n_controller = n_loop - plant.n_integrators

    # What cannot be expanded between frequencies ends here.
    members = expandable(plant.channel, plant.n_integrators, between_own_points)
    if members is None:
        if plant.own_grid is not None:
            return AllFrequencies.ended_by(Obstacle.OWN_FREQUENCIES)
        return AllFrequencies.ended_by(Obstacle.NO_DERIVATIVES)
    every_asked: list[_Asked] = []
    for requirement in specification.weighted(plant):
        channel = None
        if requirement.channel is not None:
            channel = expandable(requirement.channel, 0, between_own_points)
            if channel is None:
                return AllFrequencies.ended_by(Obstacle.OWN_PERFORMANCE_FREQUENCIES)
        weight = RationalResponse.from_weight(requirement.weight, plant.dt_s)
        every_asked.append(_Asked(requirement, weight, channel))

    # Towards zero frequency such a weight grows without limit and the loop gain does not: its bound is inf.
    infinite = [asked for asked in every_asked if asked.weight.integrators > n_loop]
    bounded = tuple(asked for asked in every_asked if asked not in infinite)
    law = RationalResponse.from_state_space(controller.to_control(), n_controller)
    loop = _Loop(plant, specification, law, members, bounded)

    # First partition, with the edges of bands and the plant's own frequencies among its edges.
    extra: list[float] = []
    if plant.own_grid is not None:
        extra += plant.own_grid.tolist()
    for asked in every_asked:
        extra += asked.requirement.band or ()
    edges = starting_edges(plant, modes, extra)
    difference = _model_error(loop, controller, edges[1:])
    if not difference <= _MODEL_ERROR:
        return AllFrequencies.ended_by(Obstacle.INEXACT, difference)

    # Targets of the bounds, then intervals that meet them.
    names = [asked.requirement.name for asked in bounded]
    dense_maxima = np.array([worst.peak(name)[0] for name in names])
    targets = dense_maxima * (1.0 + EXCESS)
    close = np.logical_and(dense_maxima <= 1.0, targets > 1.0)
    targets[close] = np.maximum(1.0, dense_maxima[close] * (1.0 + LEAST_EXCESS))
    bounds, used = _bisect(loop.bounds, edges, plant.dt_s, targets)
    result = _verdict(bounds, names, used, n_loop, unstable)
    if result.distance > 0:
        # The modulus was cut until it was tight, the distance only came along.
        by_modulus = specification.modulus_margin / result.bounds["modulus"]
        result = replace(result, distance=max(result.distance, by_modulus))
    if infinite:
        without_bound = {asked.requirement.name: float("inf") for asked in infinite}
        result = replace(result, gamma=float("inf"), bounds=result.bounds | without_bound)
    return result


def _model_error(loop: _Loop, controller: Controller, omega: Real) -> float:
    """Largest relative difference at frequencies (F,) of the forms used here from those of the dense check.

    Compared are the controller's response, and centre and shape matrix of the ellipses of the plant and of
    independent channels: the centre by its size, the shape by its trace and the size of the centre.

    No unit; nan if an expansion of an uncertainty of one's own is nan somewhere.
    """
    law = frequency_response(controller.to_control(), omega)
    differences = [_difference(loop.controller.at(omega), law)]
    sets: list[tuple[Expand, PlantChannel]] = [(loop.members, loop.plant.channel)]
    for asked in loop.asked:
        if asked.channel is not None and asked.requirement.channel is not None:
            sets.append((asked.channel, asked.requirement.channel))

    points = FrequencyIntervals(omega, np.zeros(omega.size), loop.plant.dt_s)
    for members, channel in sets:
        if channel.own_grid is not None:
            continue
        ellipses = channel.at(omega)
        expansion = members(points, 0)
        differences.append(_difference(expansion.centre.value, ellipses.centre))
        major = ellipses.direction * ellipses.semi_major
        minor = 1j * ellipses.direction * ellipses.semi_minor
        rows = np.stack([[major.real, minor.real], [major.imag, minor.imag]]).transpose(2, 0, 1)
        shape = rows @ np.swapaxes(rows, 1, 2)
        trace = np.trace(shape, axis1=1, axis2=2)
        size = trace + _SMALLEST_SHAPE * np.abs(ellipses.centre) ** 2 + _TINY
        shape_difference = np.max(np.abs(expansion.gram() - shape), axis=(1, 2))
        differences.append(float(np.max(shape_difference / size)))
    # The maximum of Python passes over a nan, that of numpy does not.
    return float(np.max(differences))


def _difference(form: Complex, value: Complex) -> float:
    """Largest relative difference of two responses (F,), in parts of the second; nan if one of them is nan.

    F = 0 is not possible: numpy would raise ValueError for the maximum of nothing.
    """
    size = np.abs(value)
    smallest = _SMALLEST_SHARE * np.max(size) + _TINY
    scale = np.maximum(size, smallest)
    return float(np.max(np.abs(form - value) / scale))


def _bisect(
    evaluate: Callable[[FrequencyIntervals], _Bounds], edges: Real, dt_s: float, targets: Real
) -> tuple[_Bounds, int]:
    """Bounds on intervals that are cut until every target is met, ascending, and how many were looked at.

    Parameters
    ----------
    evaluate : callable
        Gives `_Bounds` (F,) of F intervals.
    edges : (F + 1,) array
        Of the first intervals, rad/s.
    dt_s : float
        Sampling time, s.
    targets : (K,) array
        Upper bounds that are good enough, a requirement each. A middle above its target shows that the dense
        check missed the maximum: the target then rises to it.

    Notes
    -----
    Where `_MOST_INTERVALS` would be exceeded, intervals are accepted as they are, with their loose bounds.
    Not checked: at least one interval, and one requirement (the modulus margin is always asked).
    """
    low = edges[:-1]
    high = edges[1:]
    accepted: list[_Bounds] = []
    used = 0
    while low.size:
        bounds = evaluate(FrequencyIntervals(0.5 * (low + high), 0.5 * (high - low), dt_s))
        used += low.size
        seen = np.max(bounds.middle, axis=1, initial=0.0, where=np.isfinite(bounds.middle))
        targets = np.maximum(targets, (1.0 + EXCESS) * seen)

        # Which intervals are cut: those that say too little, unless they are at the limit of a double.
        misses_target = np.any(bounds.upper > targets[:, None], axis=0)
        no_distance = ~(bounds.distance > 0)
        can_be_cut = high - low > _LEAST_WIDTH * high
        cut = (no_distance | misses_target) & can_be_cut
        if used + _PARTS * int(np.sum(cut)) > _MOST_INTERVALS:
            cut[:] = False

        accepted.append(_Bounds._make(value[..., ~cut] for value in bounds))
        step = (high[cut] - low[cut]) / _PARTS
        starts = low[cut][:, None] + step[:, None] * np.arange(_PARTS)
        ends = np.concatenate([starts[:, 1:], high[cut][:, None]], axis=1)
        low = starts.reshape(-1)
        high = ends.reshape(-1)
    together = _Bounds._make(np.concatenate(parts, axis=-1) for parts in zip(*accepted, strict=True))
    order = np.argsort(together.centre, kind="stable")
    return _Bounds._make(value[..., order] for value in together), used


def _verdict(
    bounds: _Bounds, names: Sequence[str], used: int, integrators: int, unstable: int
) -> AllFrequencies:
    """What the bounds on all intervals, in ascending order from 0 to Nyquist, prove.

    names: of the K requirements. used: intervals that were looked at. integrators, unstable: numbers of poles
    of the loop gain at z = 1 and outside the circle; a stable loop winds by as many half turns as both.

    bounds: at least one interval, not checked. An interval without a distance ends it with the obstacle
    NO_DISTANCE, other half turns than a stable loop's with WINDING.
    """
    largest = np.max(bounds.upper, axis=1)
    by_name = dict(zip(names, largest.tolist(), strict=True))
    distance = float(np.min(bounds.distance))
    if distance <= 0:
        omega = float(bounds.centre[np.argmin(bounds.distance)])
        return AllFrequencies.ended_by(Obstacle.NO_DISTANCE, omega, bounds=by_name, intervals=used)

    # Within an interval 1 + L stays in a half-plane, so the principal value of the turn from its start to its
    # end is the turn; at a joint the two estimates of one value differ by less than a quarter turn each.
    start = bounds.start
    end = bounds.end
    within = np.sum(np.angle(end / start))
    at_joints = np.sum(np.angle(start[1:] / end[:-1]))
    turn = float(within + at_joints)
    # (z - 1)^i (1 + L) is real at 0 and at Nyquist, and less than a quarter turn from its estimate there.
    at_zero = np.angle(start[0] * np.sign(start[0].real))
    at_nyquist = np.angle(end[-1] * np.sign(end[-1].real))
    turn += float(at_zero - at_nyquist)
    turns = float(np.round(turn / np.pi))
    # Adding 0.0 leaves no minus sign on zero.
    half_turns = turns - integrators / 2.0 + 0.0
    is_stable = turns == unstable + integrators
    return AllFrequencies(
        possible=True,
        proved=is_stable,
        obstacle=None if is_stable else Obstacle.WINDING,
        obstacle_at=None,
        gamma=max(by_name.values()),
        bounds=by_name,
        distance=distance,
        half_turns=half_turns,
        intervals=used,
    )
