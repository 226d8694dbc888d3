"""Parts of the set of an axis whose slow rate is hardly known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import BoolArray, ComplexArray, RealArray, real_rows
from ident.data.ellipses import chi2_radius
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.friction.rate_members import RateMember, below_modes, rate_members

DT_S = 0.01
LONGEST_S = 100.0
OMEGA = np.geomspace(0.002, 300.0, 130)
# Means and deviations of a rate, 1/s.
HARDLY_KNOWN = [(1.0, 1.0), (0.1, 1.0), (0.5, 5.0)]


def axis(rate: RealArray | float) -> ComplexArray:
    """Responses (F, ...) at OMEGA of 1 / (s^2 + rate s), sampled with a hold, for rates (...)."""
    rate = np.asarray(rate, dtype=np.float64)
    z_minus_1 = np.expm1(1j * OMEGA * DT_S).reshape(-1, *(1,) * rate.ndim)
    fading = -np.expm1(-rate * DT_S)
    # Of 1 / s and of 1 / (s + rate), whose difference over the rate it is.
    return (DT_S / z_minus_1 - fading / rate / (z_minus_1 + fading)) / rate


def other_directions() -> ComplexArray:
    """Relative changes (F, 2) of the response by two more normals: 2 % of the gain, and behind an
    all-pass."""
    return 0.02 * np.column_stack([np.ones(OMEGA.size), (1 - 1j * OMEGA) / (1 + 1j * OMEGA)])


@cache
def hardly_known(mean: float, deviation: float) -> tuple[ResponsePosterior, Poles]:
    """Posterior to first order of an axis with a rate `mean` known to `deviation`."""
    slow = np.exp(-abs(mean) * DT_S)
    poles = Poles(np.array([slow]))
    n_coefficients = 2 + 20
    nothing = np.zeros((n_coefficients, 1))
    empty = ResponsePosterior(poles.doubled(), nothing[:, 0], nothing, DT_S, 20, integrators=1)
    # About an axis with a positive rate, from which the mean is away to first order.
    centre = axis(abs(mean))
    by_rate = -1j * OMEGA * centre
    of_mean = 1 + (mean - abs(mean)) * by_rate
    rows = empty.frequency_rows(OMEGA) / centre[:, None]
    wanted = np.column_stack([of_mean, deviation * by_rate, other_directions()])
    found = np.linalg.lstsq(real_rows(rows), real_rows(wanted), rcond=1e-12)[0]
    return replace(empty, mean=found[:, 0], covariance_factor=found[:, 1:]), poles


@cache
def parts_of(mean: float, deviation: float) -> tuple[RateMember, ...]:
    return rate_members(*hardly_known(mean, deviation), LONGEST_S)


def ellipses_of(members: tuple[RateMember, ...]) -> list[FrequencyUncertainty]:
    return [member.response.at(OMEGA) for member in members]


def held(members: tuple[RateMember, ...], responses: ComplexArray) -> BoolArray:
    """Whether any member's ellipse holds responses (F, N)."""
    inside = np.zeros(responses.shape, bool)
    for part in ellipses_of(members):
        away = responses - part.centre[:, None]
        precision = np.linalg.pinv(part.covariance)[:, :, :, None]
        distance = precision[:, 0, 0] * away.real**2 + precision[:, 1, 1] * away.imag**2
        distance += 2 * precision[:, 0, 1] * away.real * away.imag
        inside |= distance <= chi2_radius(0.95) ** 2
    return inside


@pytest.mark.parametrize(("mean", "deviation"), HARDLY_KNOWN)
def test_parts_hold_draws_of_a_positive_rate_at_every_frequency(mean: float, deviation: float) -> None:
    rng = np.random.default_rng(5)
    rates = mean + deviation * rng.standard_normal(4000)
    rates = rates[rates > 0]
    others = other_directions() @ rng.standard_normal((2, rates.size))
    inside = held(parts_of(mean, deviation), axis(rates) / (1 - others))
    assert np.mean(inside, axis=1)[OMEGA < 25.0].min() > 0.94
    assert np.mean(inside[OMEGA < 25.0]) > 0.95


@pytest.mark.parametrize(("mean", "deviation"), HARDLY_KNOWN)
def test_no_part_holds_zero_where_an_ellipse_to_first_order_does(mean: float, deviation: float) -> None:
    straight = hardly_known(mean, deviation)[0].at(OMEGA)
    assert np.max(straight.ellipse().semi_major / np.abs(straight.centre)) > 1.0
    parts = ellipses_of(parts_of(mean, deviation))
    assert parts
    for part in parts:
        assert np.max(part.ellipse().semi_major / np.abs(part.centre)) < 0.9


def test_a_rate_known_to_a_third_needs_no_parts() -> None:
    assert parts_of(1.0, 0.3) == ()


def test_an_arm_on_a_spring_has_no_parts() -> None:
    straight, poles = hardly_known(1.0, 1.0)
    assert rate_members(replace(straight, integrators=0), poles, LONGEST_S) == ()


def test_a_damping_that_the_data_deny_is_not_taken_for_granted() -> None:
    assert parts_of(-3.0, 1.0) == ()


def test_slow_motions_end_before_a_light_zero_and_not_at_the_mode_behind_it() -> None:
    """Over the gain a response is known less again towards a zero; between it and the mode the motion has
    turned round, so that an inertia looks negative there."""
    zero_rad_s, mode_rad_s = 30.0, 60.0
    s = 1j * OMEGA
    notch = 1 + 0.02 * s / zero_rad_s + (s / zero_rad_s) ** 2
    known_to = (0.5 / s + 0.01 / notch)[:, None]
    poles = Poles(np.zeros(0), [np.exp((-1.0 + 1j * mode_rad_s) * DT_S)])
    low = below_modes(OMEGA, known_to, poles, DT_S)
    assert 5.0 < OMEGA[low].max() < zero_rad_s
    without_zero = below_modes(OMEGA, (0.5 / s)[:, None], poles, DT_S)
    assert OMEGA[without_zero].max() == pytest.approx(mode_rad_s, rel=0.1)


def test_parts_meet_where_they_say() -> None:
    """Each begins at the rate where the one before ends, and the first holds the mean rate."""
    members = parts_of(0.5, 5.0)
    assert len(members) > 1
    by_rate = sorted(members, key=lambda member: member.from_rad_s or 0.0)
    assert by_rate[0].from_rad_s is None
    assert by_rate[-1].to_rad_s is None
    for slower, faster in pairwise(by_rate):
        assert slower.to_rad_s == faster.from_rad_s
        # A rate well within one is in that one alone at rest.
        within = 2.0 * faster.from_rad_s
        assert faster.response.at(OMEGA).contains(axis(within))[0]
        assert not slower.response.at(OMEGA).contains(axis(within))[0]
    ends = members[0].from_rad_s or 0.0, members[0].to_rad_s or np.inf
    assert ends[0] < 0.5 < ends[1]


def test_an_axis_whose_command_is_counted_the_other_way_has_the_same_parts() -> None:
    """Also where the mean rate itself is none that an arm has."""
    for mean in (0.5, -0.6):
        straight, poles = hardly_known(mean, 1.0)
        turned = replace(straight, mean=-straight.mean)
        parts = ellipses_of(parts_of(mean, 1.0))
        others = ellipses_of(rate_members(turned, poles, LONGEST_S))
        assert len(parts) == len(others) > 0
        for part, other in zip(parts, others, strict=True):
            assert_allclose(other.centre, -part.centre, rtol=1e-5)
            assert_allclose(other.ellipse().semi_major, part.ellipse().semi_major, rtol=1e-5)


def test_its_own_poles_are_at_the_rate_of_a_part() -> None:
    for member in parts_of(0.5, 5.0):
        rate = -np.log(member.poles.real.max()) / DT_S
        assert (member.from_rad_s or 0.0) < rate < (member.to_rad_s or np.inf)
