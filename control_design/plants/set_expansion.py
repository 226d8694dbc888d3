"""Uncertainty ellipses between frequencies: centre and generators as first-order expansions with remainder.

The ellipse at omega is {centre + sum_q x_q generator_q : x real, |x| <= 1}, the generators scaled to the
level. For a posterior over coefficients of basis functions, centre and generators are rational with known
poles, so they expand on whole intervals (`posterior_expansion`), to second order until they are summed, as
their coefficients may nearly cancel; a stated uncertainty brings its own expansion. A response known on its
own frequencies only needs an assumption between them: straight lines (`own_grid_set`, and `StraightBetween`
for who asks at single frequencies). `expandable` chooses among these for a channel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from control_design.plants import second_order
from control_design.plants.ellipses import Boolean, Complex, Real, quotient, radius_of
from control_design.plants.first_order import FirstOrder, FrequencyIntervals, RationalResponse
from control_design.plants.plant_set import PlantChannel, UncertainPlant
from control_design.plants.second_order import SecondOrder
from ident.basis.functions import block_parameters
from ident.basis.poles import Poles
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior

# A frequency lies in the range of a record within this share: files round to ten digits or so.
_SAME_FREQUENCY_SHARE = 1e-9


@dataclass(frozen=True, eq=False)
class SetExpansion:
    """A set of responses on each of F intervals, to first order.

    Parameters
    ----------
    centre : FirstOrder
        (F,), middle of the set.
    groups : tuple of FirstOrder
        Generators (F, Q) each. The members of a group are its real combinations with coefficients in the unit
        ball; the sets of several groups add up.
    """

    centre: FirstOrder
    groups: tuple[FirstOrder, ...]

    def times(self, factor: FirstOrder) -> SetExpansion:
        """The set of every member times a response (F,).

        Intervals of both must be the same, not checked.
        """
        groups = tuple(factor.times(group) for group in self.groups)
        return SetExpansion(factor.times(self.centre), groups)

    def support(self, direction: Complex, side: int) -> Real:
        """Largest Re(conj(direction) (member - centre)) of the linear part, (F,), at one end of the
        intervals.

        direction : (F,) complex array. side : 1 the upper, -1 the lower end, 0 the middle.

        Without groups it is 0. Units of the response if |direction| = 1; not checked.
        """
        total = np.zeros(direction.size)
        for group in self.groups:
            turned = np.real(np.conj(direction)[:, None] * group.end(side))
            total = total + np.sqrt(np.einsum("fq,fq->f", turned, turned))
        return total

    def remainder(self) -> Real:
        """Bound (F,) of everything beyond the linear part, centre and groups together.

        In units of the response; inf or huge where an interval holds a pole.
        """
        of_groups = sum(group.remainder for group in self.groups)
        return np.asarray(self.centre.remainder + of_groups, dtype=np.float64)

    def gram(self, side: int = 0) -> Real:
        """Shape matrix P (F, 2, 2) of the ellipse e^T P^-1 e <= 1 around the linear part, at the middle
        (side = 0) or one end (side = +-1) of the intervals; the sum of several groups lies inside of it.

        Zero without groups. Another side extrapolates, not checked.
        """
        total = np.zeros((self.centre.value.size, 2, 2))
        for group in self.groups:
            value = group.end(side)
            rows = np.stack([value.real, value.imag], axis=1)
            # The sum of n ellipsoids lies in the one with n times the sum of their shapes (Cauchy-Schwarz).
            total += rows @ np.swapaxes(rows, 1, 2) * len(self.groups)
        return total


Expand = Callable[[FrequencyIntervals, int], SetExpansion]
"""Gives ellipses times (z - 1)^cleared as expansions on intervals, from (intervals, cleared)."""


@runtime_checkable
class FirstOrderUncertainty(Protocol):
    """What an uncertainty of one's own offers beside `at` to have it certified between frequencies."""

    def first_order(self, intervals: FrequencyIntervals, cleared: int) -> tuple[FirstOrder, FirstOrder]:
        """Centre (F,) and generators (F, Q) on the intervals, both times (z - 1)^cleared.

        The Gram matrix of the generators' real and imaginary parts is the covariance that `at` gives.

        Both are of one standard deviation. An interval that cannot be bounded has a huge remainder rather
        than an error.
        """


def expandable(channel: PlantChannel, integrators: int, between_own_points: str) -> Expand | None:
    """How the channel's ellipses expand, or None if nothing can be said between frequencies.

    Parameters
    ----------
    channel : PlantChannel
        Nominal and uncertainty of one response.
    integrators : int
        Poles of the nominal at z = 1.
    between_own_points : str
        "linear": between the frequencies of a record the response lies on straight lines (`own_grid_set`);
        with any other word nothing is said there.

    Returns
    -------
    Expand or None
        None also for an uncertainty that can be evaluated but brings no `first_order`.
    """
    uncertainty = channel.uncertainty
    if channel.own_grid is not None:
        if between_own_points != "linear":
            return None
        nominal = RationalResponse.from_state_space(channel.nominal, integrators)
        return partial(own_grid_set, channel, nominal)
    if uncertainty is None:
        exact = RationalResponse.from_state_space(channel.nominal, integrators)
        return lambda intervals, cleared: SetExpansion(exact.expand(intervals, cleared), ())
    first_order: Callable[[FrequencyIntervals, int], tuple[FirstOrder, FirstOrder]]
    if isinstance(uncertainty, ResponsePosterior):
        first_order = partial(posterior_expansion, uncertainty)
    elif isinstance(uncertainty, FirstOrderUncertainty):
        first_order = uncertainty.first_order
    else:
        return None

    def expand(intervals: FrequencyIntervals, cleared: int) -> SetExpansion:
        """Ellipses of the channel's level on the intervals, times (z - 1)^cleared.

        What `first_order` raises goes up.
        """
        centre, generators = first_order(intervals, cleared)
        scaled_generators = generators.scaled(radius_of(channel.level))
        return SetExpansion(centre, (scaled_generators,))

    return expand


def posterior_expansion(
    posterior: ResponsePosterior, intervals: FrequencyIntervals, cleared: int
) -> tuple[FirstOrder, FirstOrder]:
    """Centre (F,) and generators (F, Q) of an identified response on F intervals, times (z - 1)^cleared.

    Parameters
    ----------
    posterior : ResponsePosterior
        A Gaussian over numbers (P,): coefficients of basis functions and impulse response and, behind them,
        offsets of the unstable poles to first order. mean (P,), covariance_factor (P, Q); integrators, a
        delay in samples and the unstable poles are common to all columns.
    intervals : FrequencyIntervals
        F of them.
    cleared : int
        Power of z - 1 that takes integrators away.

    Returns
    -------
    tuple of FirstOrder
        Centre and generators of one standard deviation. Nothing is refused: an interval that holds a pole has
        a huge remainder, or nan where the pole is its middle.

    Notes
    -----
    Every column of the response is rational, so it expands factor by factor (`plants.second_order`).
    Neglected: rounding.
    """
    columns = _columns(posterior, intervals)
    factor = np.array(posterior.covariance_factor)
    mean = np.array(posterior.mean)
    centre = _combined(columns, mean[:, None], intervals.half_width)
    centre = replace(centre, value=centre.value[:, 0], slope=centre.slope[:, 0])
    generators = _combined(columns, factor, intervals.half_width)
    # Integrators and delay are common to all columns: 1/(1 - z^-1)^i z^-d = z^(i - d)/(z - 1)^i.
    common = intervals.shift(posterior.integrators - posterior.input_delay_samples)
    common = common.times(intervals.cleared(cleared - posterior.integrators))
    # Unstable poles, by the inverse of their all-pass: 1/B = prod (z - a)/(1 - conj(a) z).
    for a in posterior.unstable.values.tolist():
        unstable_pole = 1 / a.conjugate()
        pole_factor = intervals.pole(unstable_pole - 1.0).scaled(-unstable_pole)
        common = common.times(intervals.zero(a - 1.0)).times(pole_factor)
    return common.times(centre), common.times(generators)


class _Columns(NamedTuple):
    """Expansions of P functions to second order on F intervals: (F, P) each, as of `SecondOrder`."""

    value: Complex
    slope: Complex
    curvature: Complex
    remainder: Real


def _combined(columns: _Columns, coefficients: Real, half_width: Real) -> FirstOrder:
    """Sums (F, Q) of P columns times coefficients (P, Q), to first order on intervals of half_width (F,).

    Values, slopes and curvatures are summed with their signs, so that what cancels does; what the curvature
    adds at the ends counts as remainder.

    Shapes that do not fit are numpy's ValueError.
    """
    n_intervals = half_width.size
    # Real and imaginary parts one below the other: a product of real matrices takes half the time.
    parts = (columns.value, columns.slope, columns.curvature)
    rows = np.concatenate([part for each in parts for part in (each.real, each.imag)])
    sums = (rows @ coefficients).reshape(3, 2, n_intervals, coefficients.shape[1])
    value = sums[0, 0] + 1j * sums[0, 1]
    slope = sums[1, 0] + 1j * sums[1, 1]
    curvature = np.sqrt(np.einsum("kfq,kfq->f", sums[2], sums[2]))
    coefficient_size = np.linalg.norm(coefficients, axis=1)
    remainder = 0.5 * half_width**2 * curvature + columns.remainder @ coefficient_size
    return FirstOrder(value, slope, remainder, half_width)


def _columns(posterior: ResponsePosterior, intervals: FrequencyIntervals) -> _Columns:
    """Expansions (F, P) of the response's columns on F intervals.

    There is one column for each coefficient of the posterior (as in `ResponsePosterior.frequency_rows`):
    basis functions of real poles and of pairs, the feedthrough, lags of the impulse response and, for an
    unstable plant, derivatives with respect to its unstable poles. Integrators, delay and the all-pass of the
    unstable poles, which all columns have in common, are left out.

    posterior: `poles`, `has_feedthrough`, `fir_length`, `unstable` and `mean` (P,) are read; it has checked
    itself.
    """
    columns: list[SecondOrder] = []
    # Each basis function is a section of its own pole behind the all-passes of the poles before it.
    all_pass = second_order.constant(intervals, 1.0)
    parameters = block_parameters(posterior.poles).tolist()
    for real_pole, (_, gain, _, _) in zip(posterior.poles.real, parameters, strict=False):
        driven = all_pass.times(second_order.pole(intervals, complex(real_pole - 1.0)))
        columns.append(driven.scaled(gain))
        all_pass = driven.times(_reflected_zero(complex(real_pole), intervals))
    # A pair has two functions: one with a zero at beta, and one without, orthogonal to it.
    pair_parameters = parameters[posterior.poles.real.size :]
    for pair, (_, beta, gain, gain_ratio) in zip(posterior.poles.pairs, pair_parameters, strict=True):
        driven = all_pass.times(second_order.pole(intervals, pair - 1.0))
        driven = driven.times(second_order.pole(intervals, pair.conjugate() - 1.0))
        zero = second_order.linear(intervals, complex(1.0 - beta), 1.0)
        columns.append(driven.times(zero).scaled(gain))
        columns.append(driven.scaled(gain * gain_ratio))
        all_pass = driven.times(_reflected_zero(pair, intervals))
        all_pass = all_pass.times(_reflected_zero(pair.conjugate(), intervals))
    if posterior.has_feedthrough:
        columns.append(second_order.constant(intervals, 1.0))
    for lag in range(1, posterior.fir_length + 1):
        columns.append(second_order.shift(intervals, -lag))
    # The derivative of (stable part)/B by an unstable pole is -(stable part)/B times that of log B.
    if posterior.unstable.order:
        coefficients = posterior.mean.tolist()
        weighted = [column.scaled(-x) for column, x in zip(columns, coefficients, strict=False)]
        minus_mean = reduce(add, weighted)
        for slope in _log_all_pass_slopes(posterior.unstable, intervals):
            columns.append(minus_mean.times(slope))
    return _Columns(
        np.stack([column.value for column in columns], axis=1),
        np.stack([column.slope for column in columns], axis=1),
        np.stack([column.curvature for column in columns], axis=1),
        np.stack([column.remainder for column in columns], axis=1),
    )


def _log_all_pass_slopes(unstable: Poles, intervals: FrequencyIntervals) -> list[SecondOrder]:
    """Derivatives (F,) of log B by each parameter of the unstable poles, B their all-pass.

    unstable : Poles, held as their mirror images inside the circle. A real pole is one parameter; a pair is
    two, its real and its imaginary part, in this order.

    Not checked: a pole at 0 has no mirror image (ZeroDivisionError).
    """

    def slope(p: complex) -> SecondOrder:
        """Derivative of log B by p, which stands in z - p and in 1 - p z: 1/(z - p) - z/(1 - p z).

        ZeroDivisionError for p = 0.
        """
        # -z / (1 - p z) = 1/p + 1/p^2 / (z - 1/p)
        mirrored_pole = second_order.pole(intervals, 1 / p - 1.0).scaled(1 / p**2)
        mirrored = second_order.constant(intervals, 1 / p) + mirrored_pole
        return second_order.pole(intervals, p - 1.0) + mirrored

    slopes = [slope(complex(real_pole)) for real_pole in unstable.real.tolist()]
    for pair in unstable.pairs.tolist():
        upper = slope(pair)
        lower = slope(pair.conjugate())
        slopes.append(upper + lower)
        slopes.append((upper + lower.scaled(-1.0)).scaled(1j))
    return slopes


def _reflected_zero(p: complex, intervals: FrequencyIntervals) -> SecondOrder:
    """Expansion (F,) of 1 - conj(p) z, the numerator of an all-pass with the pole p.

    p: one complex number, not checked.
    """
    q = p.conjugate()
    return second_order.linear(intervals, 1.0 - q, -q)


def _in_range(grid: Real, low: Real, high: Real) -> Boolean:
    """Whether each interval from low to high (F,) lies between the ends of grid (K,), all in rad/s.

    grid ascending, K >= 1, not checked; nan is not in range.
    """
    above_first = low >= grid[0] * (1 - _SAME_FREQUENCY_SHARE)
    below_last = high <= grid[-1] * (1 + _SAME_FREQUENCY_SHARE)
    return np.asarray(above_first & below_last)


def own_grid_set(
    channel: PlantChannel, nominal: RationalResponse, intervals: FrequencyIntervals, cleared: int
) -> SetExpansion:
    """Ellipses of a response known on a user's own frequencies, on F intervals, times (z - 1)^cleared.

    Parameters
    ----------
    channel : PlantChannel
        Its uncertainty is a record on K frequencies of its own.
    nominal : RationalResponse
        The channel's nominal response, which stands alone, without uncertainty, outside their range.
    intervals : FrequencyIntervals
        F of them, none across a frequency of the record.
    cleared : int
        Power of z - 1.

    Returns
    -------
    SetExpansion
        Two groups of two generators, of the record's own level. An interval across a frequency of the record
        is not seen and bounded as if it lay in one gap.

    Notes
    -----
    Assumed: at fraction x of the way between neighbours the response lies in (1 - x) E_k + x E_{k+1}
    (Minkowski sum of their ellipses). Each of the two is a group of its own.
    """
    grid = channel.own_grid
    assert grid is not None
    half_width = intervals.half_width
    inside = _in_range(grid, intervals.centre - half_width, intervals.centre + half_width)
    left = np.clip(np.searchsorted(grid, intervals.centre) - 1, 0, grid.size - 2)
    gap = grid[left + 1] - grid[left]
    share = (intervals.centre - grid[left]) / gap
    ellipses = channel.at(grid)
    no_remainder = np.zeros(half_width.size)
    clear = intervals.cleared(cleared)
    # Centre: a straight line between the centres of both ellipses, or the nominal response outside.
    left_centre = ellipses.centre[left]
    right_centre = ellipses.centre[left + 1]
    line = FirstOrder(
        left_centre + share * (right_centre - left_centre),
        (right_centre - left_centre) / gap,
        no_remainder,
        half_width,
    )
    between = clear.times(line)
    outside = nominal.expand(intervals, cleared)
    centre = FirstOrder(
        np.where(inside, between.value, outside.value),
        np.where(inside, between.slope, outside.slope),
        np.where(inside, between.remainder, outside.remainder),
        half_width,
    )
    # Both half axes of each ellipse are its generators; those of the left one shrink as x grows.
    half_axes = np.stack([ellipses.semi_major + 0j, 1j * ellipses.semi_minor], axis=1)
    axes = ellipses.direction[:, None] * half_axes
    groups = []
    for index, weight, rate in ((left, 1.0 - share, -1.0 / gap), (left + 1, share, 1.0 / gap)):
        generators = axes[index] * inside[:, None]
        value = generators * weight[:, None]
        slope = generators * rate[:, None]
        groups.append(clear.times(FirstOrder(value, slope, no_remainder, half_width)))
    return SetExpansion(centre, tuple(groups))


@dataclass(frozen=True, eq=False)
class StraightBetween:
    """A response known on its own frequencies as one at any, by the assumption of `own_grid_set`.

    Parameters
    ----------
    channel : PlantChannel
        Its uncertainty is a record with omega_rad_s (K,), centre, covariance and level.

    Notes
    -----
    At a frequency the fraction x between neighbours, the ellipse is one that encloses (1 - x) E_k + x
    E_{k+1}. With shapes P and Q of the two and p^2 = tr P, q^2 = tr Q it is (p + q)(P/p + Q/q), exact where
    one of them vanishes or both are alike.
    """

    channel: PlantChannel

    def at(self, omega_rad_s: Real, level: float) -> FrequencyUncertainty:
        """Centre and covariances at omega (F,) in rad/s, such that ellipses of `level` enclose those of the
        record; outside its range the nominal response without uncertainty.

        ValueError where frequencies do not ascend or a value is not finite (`FrequencyUncertainty`); the
        level is not checked before (radius 0 at level 0 divides by zero).
        """
        grid = self.channel.own_grid
        assert grid is not None
        record: Any = self.channel.uncertainty
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        inside = _in_range(grid, omega, omega)
        left = np.clip(np.searchsorted(grid, omega, side="right") - 1, 0, grid.size - 2)
        share = np.clip((omega - grid[left]) / (grid[left + 1] - grid[left]), 0.0, 1.0)
        # Inside, the nominal response is not used and may have a pole: it is asked for at half of Nyquist.
        harmless_rad_s = np.pi / 2 / self.channel.dt_s
        nominal = self.channel.nominal_response(np.where(inside, harmless_rad_s, omega))
        centres = np.asarray(record.centre, dtype=np.complex128)
        line = (1 - share) * centres[left] + share * centres[left + 1]
        centre = np.where(inside, line, nominal)
        # Covariances of the two ellipses, scaled from the record's level to the one asked for.
        scale = (radius_of(float(record.level)) / radius_of(level)) ** 2
        shapes = np.asarray(record.covariance, dtype=np.float64) * scale
        left_shape = (1 - share)[:, None, None] ** 2 * shapes[left]
        right_shape = share[:, None, None] ** 2 * shapes[left + 1]
        left_size = np.sqrt(np.trace(left_shape, axis1=1, axis2=2))
        right_size = np.sqrt(np.trace(right_shape, axis1=1, axis2=2))
        total_size = left_size + right_size
        left_factor = np.asarray(quotient(total_size, left_size))[:, None, None]
        right_factor = np.asarray(quotient(total_size, right_size))[:, None, None]
        enclosing = left_shape * left_factor + right_shape * right_factor
        covariance = np.where(inside[:, None, None], enclosing, 0.0)
        return FrequencyUncertainty(
            omega, centre, covariance, self.channel.dt_s, level=level, method="straight between"
        )


def with_straight_between(plant: UncertainPlant) -> UncertainPlant:
    """The plant with `StraightBetween` in place of every record that is known on its own frequencies only.

    Nothing is refused; of a plant that is known everywhere nothing is changed.
    """
    performance = plant.performance
    if performance is not None and performance.own_grid is not None:
        performance = replace(performance, uncertainty=StraightBetween(performance))
    if plant.own_grid is None:
        return replace(plant, performance=performance)
    return replace(plant, uncertainty=StraightBetween(plant.channel), performance=performance)


def stacked(columns: Sequence[FirstOrder]) -> FirstOrder:
    """Q expansions (F,) on the same intervals as one (F, Q).

    At least one (IndexError); the remainder is the root of the sum of squares.
    """
    squares: Any = sum(column.remainder**2 for column in columns)
    return FirstOrder(
        np.stack([column.value for column in columns], axis=1),
        np.stack([column.slope for column in columns], axis=1),
        np.sqrt(squares),
        columns[0].half_width,
    )
