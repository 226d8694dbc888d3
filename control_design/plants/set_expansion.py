"""Uncertainty ellipses between frequencies: centre and generators as first-order expansions with remainder.

The ellipse at omega is {centre + sum_q x_q generator_q : x real, |x| <= 1}, generators scaled to the level:
rational with known poles for a posterior over coefficients. Of a response known on its own frequencies only
the assumption between them is stated in `own_grid_set`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add
from typing import Any, Protocol, runtime_checkable

import numpy as np

from control_design.plants.ellipses import Complex, Real, quotient, radius_of
from control_design.plants.first_order import FirstOrder, FrequencyIntervals, RationalResponse
from control_design.plants.plant_set import PlantChannel, UncertainPlant
from ident.basis.functions import block_parameters
from ident.basis.poles import Poles
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior


@dataclass(frozen=True, eq=False)
class SetExpansion:
    """centre (F,); groups: generators (F, Q) each, every group with a unit ball of its own (sets add up)."""

    centre: FirstOrder
    groups: tuple[FirstOrder, ...]

    def times(self, factor: FirstOrder) -> SetExpansion:
        """The set times a response (F,)."""
        return SetExpansion(factor.times(self.centre), tuple(factor.times(group) for group in self.groups))

    def support(self, direction: Complex, side: int) -> Real:
        """Largest Re(conj(direction) (member - centre)) of the linear part at one end, (F,)."""
        total = np.zeros(direction.size)
        for group in self.groups:
            turned = np.real(np.conj(direction)[:, None] * group.end(side))
            total = total + np.sqrt(np.einsum("fq,fq->f", turned, turned))
        return total

    def remainder(self) -> Real:
        """Everything beyond the linear part, centre and groups together, (F,)."""
        return np.asarray(
            self.centre.remainder + sum(group.remainder for group in self.groups), dtype=np.float64
        )

    def gram(self, side: int = 0) -> Real:
        """Shape matrix P (F, 2, 2) at the centres, or of the linear part at one end (side = +-1): the ellipse
        e^T P^-1 e <= 1, which encloses the sum of several groups."""
        total = np.zeros((self.centre.value.size, 2, 2))
        for group in self.groups:
            value = group.end(side)
            rows = np.stack([value.real, value.imag], axis=1)
            total += rows @ np.swapaxes(rows, 1, 2) * len(self.groups)
        return total


Expand = Callable[[FrequencyIntervals, int], SetExpansion]
"""Ellipses bounded between frequencies: their expansion times (z - 1)^cleared on intervals."""


@runtime_checkable
class FirstOrderUncertainty(Protocol):
    """What an uncertainty of one's own offers beside `at` to have it certified between frequencies.

    generators: columns whose Gram matrix of real and imaginary parts is the covariance that `at` gives.
    """

    def first_order(self, intervals: FrequencyIntervals, cleared: int) -> tuple[FirstOrder, FirstOrder]:
        """(centre (F,), generators (F, Q)), both times (z - 1)^cleared."""


def expandable(channel: PlantChannel, integrators: int, between_own_points: str) -> Expand | None:
    """How the channel's ellipses expand, or None if nothing can be said between frequencies."""
    uncertainty = channel.uncertainty
    if channel.own_grid is not None and between_own_points != "linear":
        return None
    if uncertainty is None or channel.own_grid is not None:
        nominal = RationalResponse.from_state_space(channel.nominal, integrators)
        if uncertainty is None:
            return lambda intervals, cleared: SetExpansion(nominal.expand(intervals, cleared), ())
        return partial(own_grid_set, channel, nominal)
    first_order: Callable[[FrequencyIntervals, int], tuple[FirstOrder, FirstOrder]]
    if isinstance(uncertainty, ResponsePosterior):
        first_order = partial(posterior_expansion, uncertainty)
    elif isinstance(uncertainty, FirstOrderUncertainty):
        first_order = uncertainty.first_order
    else:
        return None

    def expand(intervals: FrequencyIntervals, cleared: int) -> SetExpansion:
        centre, generators = first_order(intervals, cleared)
        return SetExpansion(centre, (generators.scaled(radius_of(channel.level)),))

    return expand


def posterior_expansion(
    posterior: ResponsePosterior, intervals: FrequencyIntervals, cleared: int
) -> tuple[FirstOrder, FirstOrder]:
    """`FirstOrderUncertainty.first_order` of a Gaussian over coefficients of basis functions and impulse
    response: every column is rational."""
    value, slope, remainder = _columns(posterior, intervals)
    factor = np.array(posterior.covariance_factor)
    mean = np.array(posterior.mean)
    h = intervals.half_width
    centre = FirstOrder(value @ mean, slope @ mean, remainder @ np.abs(mean), h)
    spread = FirstOrder(value @ factor, slope @ factor, remainder @ np.linalg.norm(factor, axis=1), h)
    # 1/(1 - z^-1)^i z^-d = z^(i - d)/(z - 1)^i
    common = intervals.shift(posterior.integrators - posterior.input_delay_samples)
    common = common.times(intervals.cleared(cleared - posterior.integrators))
    # 1/B = prod (z - a)/(1 - conj(a) z)
    for a in posterior.unstable.values.tolist():
        outside = 1 / a.conjugate()
        common = common.times(intervals.zero(a - 1.0)).times(intervals.pole(outside - 1.0).scaled(-outside))
    return common.times(centre), common.times(spread)


def _columns(posterior: ResponsePosterior, intervals: FrequencyIntervals) -> tuple[Complex, Complex, Real]:
    """Value, slope and remainder (F, P) of the columns of `ResponsePosterior.frequency_rows`, without
    integrators, delay and all-pass."""
    columns: list[FirstOrder] = []
    all_pass = intervals.constant(1.0)
    parameters = block_parameters(posterior.poles).tolist()
    for a, (_, gain, _, _) in zip(posterior.poles.real, parameters, strict=False):
        driven = all_pass.times(intervals.pole(complex(a - 1.0)))
        columns.append(driven.scaled(gain))
        all_pass = driven.times(_reflected_zero(complex(a), intervals))
    pairs = parameters[posterior.poles.real.size :]
    for p, (_, beta, gain, other) in zip(posterior.poles.pairs, pairs, strict=True):
        driven = all_pass.times(intervals.pole(p - 1.0))
        driven = driven.times(intervals.pole(p.conjugate() - 1.0))
        columns.append(driven.times(intervals.zero(complex(beta - 1.0))).scaled(gain))
        columns.append(driven.scaled(gain * other))
        all_pass = driven.times(_reflected_zero(p, intervals))
        all_pass = all_pass.times(_reflected_zero(p.conjugate(), intervals))
    if posterior.has_feedthrough:
        columns.append(intervals.constant(1.0))
    columns += [intervals.shift(-lag) for lag in range(1, posterior.fir_length + 1)]
    if posterior.unstable.order:
        scaled = zip(columns, posterior.mean.tolist(), strict=False)
        against = reduce(add, (column.scaled(-each) for column, each in scaled))
        columns += [against.times(slope) for slope in _log_all_pass_slopes(posterior.unstable, intervals)]
    return (
        np.stack([column.value for column in columns], axis=1),
        np.stack([column.slope for column in columns], axis=1),
        np.stack([column.remainder for column in columns], axis=1),
    )


def _log_all_pass_slopes(unstable: Poles, intervals: FrequencyIntervals) -> list[FirstOrder]:
    """`ident.basis.functions.log_all_pass_slopes` as expansions."""

    def slope(p: complex) -> FirstOrder:
        # -z / (1 - p z) = 1/p + 1/p^2 / (z - 1/p)
        beyond = intervals.constant(1 / p) + intervals.pole(1 / p - 1.0).scaled(1 / p**2)
        return intervals.pole(p - 1.0) + beyond

    found = [slope(complex(a)) for a in unstable.real.tolist()]
    for p in unstable.pairs.tolist():
        upper, lower = slope(p), slope(p.conjugate())
        found += [upper + lower, (upper + lower.scaled(-1.0)).scaled(1j)]
    return found


def _reflected_zero(p: complex, intervals: FrequencyIntervals) -> FirstOrder:
    """1 - conj(p) z."""
    q = p.conjugate()
    factor = intervals.zero(0.0).scaled(-q)
    return FirstOrder(factor.value + (1.0 - q), factor.slope, factor.remainder, factor.half_width)


def own_grid_set(
    channel: PlantChannel, nominal: RationalResponse, intervals: FrequencyIntervals, cleared: int
) -> SetExpansion:
    """Ellipses on a user's own frequencies. Assumed: at fraction x of the way between neighbours the response
    lies in (1 - x) E_k + x E_{k+1} (Minkowski sum). Outside the range the nominal response stands alone."""
    own = channel.own_grid
    assert own is not None
    low, high = intervals.centre - intervals.half_width, intervals.centre + intervals.half_width
    inside = (low >= own[0] * (1 - 1e-9)) & (high <= own[-1] * (1 + 1e-9))
    left = np.clip(np.searchsorted(own, intervals.centre) - 1, 0, own.size - 2)
    gap = own[left + 1] - own[left]
    share = (intervals.centre - own[left]) / gap
    ellipses = channel.at(own)
    h = intervals.half_width
    none = np.zeros(h.size)
    clear = intervals.cleared(cleared)
    c0, c1 = ellipses.centre[left], ellipses.centre[left + 1]
    between = clear.times(FirstOrder(c0 + share * (c1 - c0), (c1 - c0) / gap, none, h))
    alone = nominal.expand(intervals, cleared)
    pairs = ((getattr(between, name), getattr(alone, name)) for name in ("value", "slope", "remainder"))
    value, slope, remainder = (np.where(inside, here, there) for here, there in pairs)
    centre = FirstOrder(value, slope, remainder, h)
    axes = ellipses.direction[:, None] * np.stack(
        [ellipses.semi_major + 0j, 1j * ellipses.semi_minor], axis=1
    )
    groups = []
    for index, weight, rate in ((left, 1.0 - share, -1.0 / gap), (left + 1, share, 1.0 / gap)):
        here = axes[index] * inside[:, None]
        groups.append(clear.times(FirstOrder(here * weight[:, None], here * rate[:, None], none, h)))
    return SetExpansion(centre, tuple(groups))


@dataclass(frozen=True, eq=False)
class StraightBetween:
    """A response known on its own frequencies as one at any: the assumption of `own_grid_set`.

    at: per frequency the ellipse that encloses (1 - x) E_k + x E_{k+1}; with shapes P and Q of the two and
    p^2 = tr P, q^2 = tr Q it is (p + q)(P/p + Q/q), exact where one of them vanishes or both are alike.
    """

    channel: PlantChannel

    def at(self, omega_rad_s: Real, level: float) -> FrequencyUncertainty:
        """Centre and covariances at omega (F,), so that ellipses of `level` enclose those of the record."""
        own = self.channel.own_grid
        assert own is not None
        record: Any = self.channel.uncertainty
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        inside = (omega >= own[0] * (1 - 1e-9)) & (omega <= own[-1] * (1 + 1e-9))
        left = np.clip(np.searchsorted(own, omega, side="right") - 1, 0, own.size - 2)
        share = np.clip((omega - own[left]) / (own[left + 1] - own[left]), 0.0, 1.0)
        centres = np.asarray(record.centre, dtype=np.complex128)
        centre = (1 - share) * centres[left] + share * centres[left + 1]
        centre = np.where(
            inside,
            centre,
            self.channel.nominal_response(np.where(inside, np.pi / 2 / self.channel.dt_s, omega)),
        )
        scale = (radius_of(float(record.level)) / radius_of(level)) ** 2
        shapes = np.asarray(record.covariance, dtype=np.float64) * scale
        parts = [(1 - share)[:, None, None] ** 2 * shapes[left], share[:, None, None] ** 2 * shapes[left + 1]]
        sizes = [np.sqrt(np.trace(part, axis1=1, axis2=2)) for part in parts]
        covariance = sum(
            part * np.asarray(quotient(sizes[0] + sizes[1], size))[:, None, None]
            for part, size in zip(parts, sizes, strict=True)
        )
        covariance = np.where(inside[:, None, None], covariance, 0.0)
        return FrequencyUncertainty(
            omega, centre, covariance, self.channel.dt_s, level=level, method="straight between"
        )


def with_straight_between(plant: UncertainPlant) -> UncertainPlant:
    """The plant with `StraightBetween` in place of records on their own frequencies."""
    performance = plant.performance
    if performance is not None and performance.own_grid is not None:
        performance = replace(performance, uncertainty=StraightBetween(performance))
    if plant.own_grid is None:
        return replace(plant, performance=performance)
    return replace(plant, uncertainty=StraightBetween(plant.channel), performance=performance)


def stacked(columns: Sequence[FirstOrder]) -> FirstOrder:
    """Q expansions (F,) as one (F, Q)."""
    squares: Any = sum(column.remainder**2 for column in columns)
    return FirstOrder(
        np.stack([column.value for column in columns], axis=1),
        np.stack([column.slope for column in columns], axis=1),
        np.sqrt(squares),
        columns[0].half_width,
    )
