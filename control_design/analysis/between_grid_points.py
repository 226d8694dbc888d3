"""The worst case over the ellipses for all frequencies: upper bounds on intervals, bisected until tight.

With K, the centre c and the generators S of the ellipses expanded to first order around the middle of an
interval, and one unit normal u kept over it,

    dist(-1, K E) >= Re(conj(u) (1 + K c)) - |Re(conj(u) K S)|,

whose linear part is concave over the interval; every numerator (|W1|, |W3 K|, ...) has a convex linear part.
The quotient is then largest at an end, and the remainders are added there. Everything is multiplied by (z -
1)^i, i the integrators of the loop, so that intervals may reach down to zero frequency.
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
from control_design.plants.plant_set import Mode, UncertainPlant, frequency_response
from control_design.plants.set_expansion import Expand, SetExpansion, expandable
from control_design.specification import Specification
from control_design.specification.requirement import WeightedRequirement

EXCESS = 0.002  # asked of every bound over the dense maximum; 0.005 is promised
LEAST_EXCESS = 1e-5  # where a dense maximum lies this close under its limit
_MOST_INTERVALS = 60_000  # limit of work, and of memory: a proof that needs more is given up
_PARTS = 3  # an interval that is not good enough is cut in so many
_MODEL_ERROR = 1e-6  # largest relative disagreement of zeros and poles with the state space


class Obstacle(Enum):
    """Why nothing was proved for all frequencies; `AllFrequencies.obstacle_at` is the number in brackets."""

    OWN_FREQUENCIES = "uncertainty without model"
    OWN_PERFORMANCE_FREQUENCIES = "performance channel without model"
    NO_DERIVATIVES = "uncertainty without derivatives"
    INEXACT = "inexact zeros and poles"  # relative difference
    NOT_STABLE = "not robustly stable"
    NO_DISTANCE = "distance not positive"  # rad/s
    WINDING = "wrong winding"


@dataclass(frozen=True)
class AllFrequencies:
    """What was proved for every frequency from 0 to Nyquist, ends included, on one plant.

    possible: the uncertainty can be bounded between frequencies. proved: no ellipse reaches -1 anywhere and
    the winding of 1 + K c is the one of a stable loop. obstacle: why nothing was proved. bounds: upper bound
    of each weighted worst case (inf: none found), gamma the largest of them. distance: lower bound of
    dist(-1, K E). half_turns: of 1 + K c from 0+ to Nyquist, in units of pi, exact by the intervals (0
    without a proof).
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
    def ended_by(cls, obstacle: Obstacle, at: float | None = None, **found: Any) -> AllFrequencies:
        """Nothing proved, and why."""
        tried = obstacle in (Obstacle.NOT_STABLE, Obstacle.NO_DISTANCE, Obstacle.WINDING)
        return cls(tried, False, obstacle, at, **found)


class _Bounds(NamedTuple):
    """Per interval: its middle (F,), upper bounds of each requirement (K, F), their worst cases at the middle
    (K, F) (to the accuracy of the normal), lower bound of the distance (F,), 1 + L cleared at both ends
    (F,)."""

    centre: Real
    upper: Real
    middle: Real
    distance: Real
    start: Complex
    end: Complex


class _Asked(NamedTuple):
    """One weighted requirement, its weight as a rational response, its independent channel."""

    requirement: WeightedRequirement
    weight: RationalResponse
    channel: Expand | None


@dataclass(frozen=True, eq=False)
class _Loop:
    """Everything rational of one plant, controller and specification."""

    plant: UncertainPlant
    specification: Specification
    controller: RationalResponse  # without delay
    members: Expand
    asked: tuple[_Asked, ...]

    def bounds(self, intervals: FrequencyIntervals) -> _Bounds:
        """Upper bounds on every interval."""
        own, i_plant = self.controller.integrators, self.plant.n_integrators
        delay = self.specification.computational_delay_samples
        loop = self.members(intervals, i_plant).times(self.controller.delayed(delay).expand(intervals, own))
        clear = intervals.cleared(own + i_plant)
        loop = SetExpansion(clear + loop.centre, loop.groups)
        normal = _normal(loop.centre.value, loop.gram())
        slack = loop.remainder()
        ends = {
            side: np.real(np.conj(normal) * loop.centre.end(side)) - loop.support(normal, side) - slack
            for side in (-1, 1)
        }
        at_middle = np.real(np.conj(normal) * loop.centre.value) - loop.support(normal, 0)
        h = intervals.half_width
        upper, middle = np.zeros((2, len(self.asked), h.size))
        for row, each in enumerate(self.asked):
            band = each.requirement.band or (-np.inf, np.inf)
            use = (intervals.centre - h < band[1]) & (intervals.centre + h > band[0])
            if np.any(use):
                below = {side: value[use] for side, value in ends.items()}
                bound = self._with_member if each.requirement.of_member.of_plant else self._alone
                upper[row, use], middle[row, use] = bound(each, intervals.part(use), below, at_middle[use])
        low = np.minimum(ends[-1], ends[1])
        distance = np.where(low > 0, low / clear.largest(), 0.0)
        return _Bounds(intervals.centre, upper, middle, distance, loop.centre.end(-1), loop.centre.end(1))

    def _alone(
        self, each: _Asked, intervals: FrequencyIntervals, ends: dict[int, Real], at_middle: Real
    ) -> tuple[Real, Real]:
        """Upper bounds and the values at the middles of |W S| or |W K S|, times |Gp| of an independent
        channel."""
        own, i_plant, weight = self.controller.integrators, self.plant.n_integrators, each.weight
        if each.requirement.function.of_controller:
            numerator = weight.expand(intervals, i_plant).times(self.controller.expand(intervals, own))
        else:
            numerator = weight.expand(intervals, own + i_plant)
        # Convex over concave is largest at an end.
        at_ends = [
            quotient(np.abs(numerator.end(side)) + numerator.remainder, low, np.inf)
            for side, low in ends.items()
        ]
        upper, middle = (
            np.maximum(np.maximum(*at_ends), 0.0),
            quotient(np.abs(numerator.value), at_middle, np.inf),
        )
        if each.channel is not None:
            channel = each.channel(intervals, 0)
            largest = np.maximum(_farthest(channel, -1), _farthest(channel, 1)) + channel.remainder()
            upper, middle = largest * upper, _farthest(channel, 0) * middle
        if each.requirement.above > 0:  # where it asks for less, another requirement is bounded instead
            cleared = intervals.cleared(weight.integrators)
            least = each.requirement.above * np.maximum(np.abs(cleared.value) - cleared.change(), 0.0)
            more = weight.expand(intervals, weight.integrators).largest() > least
            upper, middle = np.where(more, upper, 0.0), np.where(more, middle, 0.0)
        return upper, middle

    def _with_member(
        self, each: _Asked, intervals: FrequencyIntervals, ends: dict[int, Real], at_middle: Real
    ) -> tuple[Real, Real]:
        """The same of |W G S| and |W T|, G the member; for a weight that is finite at zero frequency.

        Members G, G0 of the ellipses at omega and at the middle, g = G/(1 + G K):
        g - g0 = (G - G0 + G G0 (K0 - K))/((1 + G K)(1 + G0 K0)), hence with the largest |G - G0| = e
        M <= M0 + e/(d d0) + M M0 |K - K0|.
        """
        own, i_plant = self.controller.integrators, self.plant.n_integrators
        k = self.controller.delayed(self.specification.computational_delay_samples).expand(intervals)
        members = self.members(intervals, 0)
        ellipses = Ellipses(intervals.centre, members.centre.value, *_axes(members.gram()))
        most = largest_disturbance_gain(k.value, ellipses)
        moved = members.centre.change() + sum(group.change() for group in members.groups)
        nearest = np.minimum(ends[-1], ends[1]) / intervals.cleared(own + i_plant).largest()
        turn = most * k.change()
        good = (nearest > 0) & (turn < 1) & np.isfinite(most)
        with np.errstate(divide="ignore", invalid="ignore"):
            # d0 >= nearest as well: the middle belongs to the interval.
            bound = (most + moved / nearest**2) / (1.0 - turn)
        factor = each.weight.expand(intervals)
        if each.requirement.function.of_controller:
            factor = factor.times(k)
        return np.where(good, factor.largest() * bound, np.inf), np.abs(factor.value) * most


def _normal(point: Complex, shape: Real) -> Complex:
    """Unit normal, from the ellipse e^T P^-1 e <= 1 at the origin, towards `point`: (P + t)^-1 point, t the
    `secular_root`. Any normal gives a valid bound; inside the ellipse the direction means nothing."""
    major, minor, axis = _axes(shape)
    # Lengths in units of the largest: squares of squares stay far from the ends of the number range.
    scale = np.maximum(np.maximum(np.abs(point), major), 1e-100)
    turned, a, b = point * np.conj(axis) / scale, major / scale, minor / scale
    t = np.maximum(secular_root(np.abs(turned.real) * a, np.abs(turned.imag) * b, a * a, b * b), 1e-30)
    normal = (turned.real / (a**2 + t) + 1j * turned.imag / (b**2 + t)) * axis
    return np.asarray(quotient(normal, np.abs(normal), 1.0), dtype=np.complex128)


def _axes(shape: Real) -> tuple[Real, Real, Complex]:
    """Semi-axes (F,), (F,) and direction of the major one (F,) of e^T P^-1 e <= 1."""
    a, b, d = shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]
    half_gap = np.hypot((a - d) / 2, b)
    large = (a + d) / 2 + half_gap
    small = np.maximum((a + d) / 2 - half_gap, 0.0)
    return np.sqrt(large), np.sqrt(small), np.exp(0.5j * np.arctan2(2 * b, a - d))


def _farthest(members: SetExpansion, side: int) -> Real:
    """Largest modulus over the linear part of the set at one end of the intervals."""
    major, minor, direction = _axes(members.gram(side))
    return farthest_distance(members.centre.end(side) * np.conj(direction), major, minor)


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

    worst: the dense check; a kind is bisected until its bound is within 0.4 % of the dense maximum, or under
    its limit 1 where the dense maximum lies closer under it. modes: flexible modes of plant, controller and
    closed loop, where the first partition is finer.

    Neglected: rounding errors of double precision, also those of the zeros and poles computed from the state
    spaces (the responses and ellipses so represented are compared with those of the dense check on the first
    partition, and the proof is refused beyond a relative difference of 1e-6).
    """
    own, unstable = loop_integrators(controller, plant)
    own -= plant.n_integrators
    members = expandable(plant.channel, plant.n_integrators, between_own_points)
    if members is None:
        known = plant.own_grid is not None
        return AllFrequencies.ended_by(Obstacle.OWN_FREQUENCIES if known else Obstacle.NO_DERIVATIVES)
    asked: list[_Asked] = []
    for requirement in specification.weighted(plant):
        channel = None
        if requirement.channel is not None:
            channel = expandable(requirement.channel, 0, between_own_points)
            if channel is None:
                return AllFrequencies.ended_by(Obstacle.OWN_PERFORMANCE_FREQUENCIES)
        asked.append(
            _Asked(requirement, RationalResponse.from_weight(requirement.weight, plant.dt_s), channel)
        )
    # Towards zero frequency such a weight grows without limit and the loop gain does not.
    infinite = [each for each in asked if each.weight.integrators > own + plant.n_integrators]
    loop = _Loop(
        plant,
        specification,
        RationalResponse.from_state_space(controller.to_control(), own),
        members,
        tuple(each for each in asked if each not in infinite),
    )
    bands = [edge for each in asked for edge in each.requirement.band or ()]
    edges = starting_edges(plant, modes, (*(() if plant.own_grid is None else plant.own_grid), *bands))
    difference = _model_error(loop, controller, edges[1:])
    if difference > _MODEL_ERROR:
        return AllFrequencies.ended_by(Obstacle.INEXACT, difference)
    names = [each.requirement.name for each in loop.asked]
    most = np.array([worst.peak(name)[0] for name in names])
    targets = most * (1.0 + EXCESS)
    close = (most <= 1.0) & (targets > 1.0)
    targets[close] = np.maximum(1.0, most[close] * (1.0 + LEAST_EXCESS))
    found, used = _bisect(loop.bounds, edges, plant.dt_s, targets)
    result = _verdict(found, names, used, own + plant.n_integrators, unstable)
    if result.distance > 0:  # the modulus was bisected, the distance only came along
        nearest = specification.modulus_margin / result.bounds["modulus"]
        result = replace(result, distance=max(result.distance, nearest))
    if infinite:
        bounds = result.bounds | {each.requirement.name: float("inf") for each in infinite}
        result = replace(result, gamma=float("inf"), bounds=bounds)
    return result


def _model_error(loop: _Loop, controller: Controller, omega: Real) -> float:
    """Largest relative difference at omega (F,) of the forms used here from the state spaces and from the
    ellipses the dense check uses (centre by its size, shape by its trace and the centre)."""
    largest = _difference(loop.controller.at(omega), frequency_response(controller.to_control(), omega))
    sets = [(loop.members, loop.plant.channel)]
    sets += [
        (each.channel, each.requirement.channel)
        for each in loop.asked
        if each.channel is not None and each.requirement.channel is not None
    ]
    for members, channel in sets:
        if channel.own_grid is not None:
            continue
        given = channel.at(omega)
        expansion = members(FrequencyIntervals(omega, np.zeros(omega.size), loop.plant.dt_s), 0)
        largest = max(largest, _difference(expansion.centre.value, given.centre))
        major, minor = given.direction * given.semi_major, 1j * given.direction * given.semi_minor
        rows = np.stack([[major.real, minor.real], [major.imag, minor.imag]]).transpose(2, 0, 1)
        shape = rows @ np.swapaxes(rows, 1, 2)
        size = np.trace(shape, axis1=1, axis2=2) + 1e-12 * np.abs(given.centre) ** 2 + 1e-300
        largest = max(largest, float(np.max(np.max(np.abs(expansion.gram() - shape), axis=(1, 2)) / size)))
    return largest


def _difference(form: Complex, value: Complex) -> float:
    scale = np.maximum(np.abs(value), 1e-9 * np.max(np.abs(value)) + 1e-300)
    return float(np.max(np.abs(form - value) / scale))


def _bisect(
    evaluate: Callable[[FrequencyIntervals], _Bounds], edges: Real, dt_s: float, targets: Real
) -> tuple[_Bounds, int]:
    """Refine until every interval is under every target (K,) or the budget is spent; the accepted pieces in
    ascending order, and how many were looked at. A middle above its target shows that the dense check missed
    the maximum: the target rises to it."""
    low, high = edges[:-1], edges[1:]
    accepted: list[_Bounds] = []
    used = 0
    while low.size:
        found = evaluate(FrequencyIntervals(0.5 * (low + high), 0.5 * (high - low), dt_s))
        used += low.size
        seen = np.max(found.middle, axis=1, initial=0.0, where=np.isfinite(found.middle))
        targets = np.maximum(targets, (1.0 + EXCESS) * seen)
        wide = ~(found.distance > 0) | np.any(found.upper > targets[:, None], axis=0)
        # An interval at the limit of double precision is as good as it gets.
        wide &= high - low > 1e-11 * high
        if used + _PARTS * int(np.sum(wide)) > _MOST_INTERVALS:
            wide[:] = False
        accepted.append(_Bounds._make(value[..., ~wide] for value in found))
        starts = low[wide][:, None] + ((high[wide] - low[wide]) / _PARTS)[:, None] * np.arange(_PARTS)
        ends = np.concatenate([starts[:, 1:], high[wide][:, None]], axis=1)
        low, high = starts.reshape(-1), ends.reshape(-1)
    together = [np.concatenate(parts, axis=-1) for parts in zip(*accepted, strict=True)]
    order = np.argsort(together[0], kind="stable")
    return _Bounds._make(value[..., order] for value in together), used


def _verdict(
    found: _Bounds, names: Sequence[str], used: int, integrators: int, unstable: int
) -> AllFrequencies:
    bounds = dict(zip(names, np.max(found.upper, axis=1).tolist(), strict=True))
    start, end = found.start, found.end
    distance = float(np.min(found.distance))
    if distance <= 0:
        omega = float(found.centre[np.argmin(found.distance)])
        return AllFrequencies.ended_by(Obstacle.NO_DISTANCE, omega, bounds=bounds, intervals=used)
    # Within an interval 1 + L stays in a half-plane, so the principal value of the turn from its start to its
    # end is the turn; at a joint the two estimates of one value differ by less than a quarter turn each.
    turn = float(np.sum(np.angle(end / start)) + np.sum(np.angle(start[1:] / end[:-1])))
    # (z - 1)^i (1 + L) is real at 0 and at Nyquist, and less than a quarter turn from its estimate there.
    turn += float(np.angle(start[0] * np.sign(start[0].real)) - np.angle(end[-1] * np.sign(end[-1].real)))
    turns = float(np.round(turn / np.pi))
    half_turns = turns - integrators / 2.0 + 0.0  # no minus sign on zero
    stable = turns == unstable + integrators
    obstacle = None if stable else Obstacle.WINDING
    largest = max(bounds.values())
    return AllFrequencies(True, stable, obstacle, None, largest, bounds, distance, half_turns, used)
