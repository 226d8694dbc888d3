"""Poles behind coloured noise: modes under dry friction, and the same digits as before in white noise."""

import numpy as np
import pytest
import scipy.signal

from benchmarks.readme_identify import weak_records
from ident import IdentOptions, Poles, identify
from ident.checks.plausible_modes import PairKind, implausible_pairs, kind_of_pair, pairs_outside
from ident.coloured_noise import long_arx_filter, prewhitened
from ident.data.finding import FindingKind
from tests.ident.benchmark_plants import as_record, p1, p2
from tests.ident.findings import kinds
from workflow.config.run_config import built_in_config

STATED = {"integrators": 1, "input_delay_samples": 1, "noise": "auto"}


def arm_records(seed: int):
    """Weak records of the default arm: dry friction of 0.02 N m, an encoder, sensor noise of 1 mrad."""
    return weak_records(built_in_config()[0].source, seed)


def frequencies_Hz(found):
    return np.sort(found.model.poles.omega_rad_s(found.model.dt_s)) / (2 * np.pi)


@pytest.mark.slow
def test_both_modes_are_found_under_dry_friction_where_plain_least_squares_miss_one():
    records = arm_records(4)
    options = IdentOptions(**STATED, n_real=1, n_pairs=2)
    found = identify(records, options)
    assert frequencies_Hz(found)[0] == pytest.approx(7.625, rel=0.005)
    # The Cramer-Rao bound for the sensor noise alone is a standard deviation of 1.4 %; three of them.
    assert frequencies_Hz(found)[1] == pytest.approx(33.16, rel=0.042)
    assert found.noise_filter.size > 1
    assert FindingKind.COLOURED_NOISE in kinds(found.verdicts)
    # A fit of the output itself is worse in least squares: that is the price.
    plain = identify(records, options.model_copy(update={"noise": "white"}))
    assert np.max(frequencies_Hz(plain)) < 10
    assert plain.noise_filter.tolist() == [1.0]
    assert plain.rss < found.rss


@pytest.mark.long
def test_no_slow_pair_is_called_a_mode_when_the_data_choose():
    records = arm_records(0)
    found = identify(records, IdentOptions(**STATED))
    kinds = [
        kind_of_pair(omega, zeta, 10.0)
        for omega, zeta in zip(found.model.poles.omega_rad_s(0.005), found.model.poles.zeta(), strict=True)
    ]
    hertz = frequencies_Hz(found)
    assert PairKind.SLOW not in kinds
    assert np.any(np.abs(hertz / 7.625 - 1) < 0.005)
    assert np.any(np.abs(hertz / 33.16 - 1) < 0.042)


@pytest.mark.parametrize(
    ("truth", "numbers"),
    [(p1, {}), (p1, {"n_real": 2, "n_pairs": 1}), pytest.param(p2, {}, marks=pytest.mark.long)],
)
def test_white_noise_leaves_every_digit_as_it_is(truth, numbers):
    record = truth(3).record
    auto, white = (identify([record], IdentOptions(noise=noise, **numbers)) for noise in ("auto", "white"))
    np.testing.assert_array_equal(auto.model.poles.values, white.model.poles.values)
    np.testing.assert_array_equal(auto.model.coefficients, white.model.coefficients)
    assert auto.noise_filter.tolist() == [1.0]
    assert auto.warnings == white.warnings


def test_the_long_arx_model_whitens_its_noise():
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 1.0], 1000), 4)
    a = np.poly([0.95, 0.8])
    y = scipy.signal.lfilter([0, 0.1], a, u) + scipy.signal.lfilter([1], a, 0.1 * rng.normal(size=u.size))
    found = long_arx_filter([as_record(u, y)], IdentOptions(input_delay_samples=1))
    assert found.order == 4  # the shortest tried
    # Each coefficient within four standard errors, of the order of 1 / sqrt(N).
    np.testing.assert_allclose(found.a_polynomial, [*a, 0, 0], atol=4 / np.sqrt(u.size))
    shorter = prewhitened(as_record(u, y), found)
    assert shorter.n_samples == u.size - 4
    np.testing.assert_allclose(shorter.input[0, 0], found.a_polynomial @ u[4::-1])


def test_too_short_records_are_taken_as_white():
    rng = np.random.default_rng(1)
    assert long_arx_filter([as_record(rng.normal(size=51), rng.normal(size=51))], IdentOptions()).is_white


def test_a_mode_of_fewer_than_three_periods_is_none():
    def pair(hertz: float, zeta: float) -> complex:
        omega = 2 * np.pi * hertz
        return complex(np.exp(0.005 * omega * (-zeta + 1j * np.sqrt(1 - zeta**2))))

    found = Poles(pairs=np.array([pair(0.01, 0.1), pair(5.0, 0.02), pair(9.0, 0.8)]))
    slow, damped = implausible_pairs(found, Poles(), 0.005, 8.0)
    assert (slow.kind, damped.kind) == (FindingKind.SLOW_PAIR, FindingKind.DAMPED_PAIR)
    assert slow.values["omega_rad_s"] == pytest.approx(2 * np.pi * 0.01)
    assert (damped.values["omega_rad_s"], damped.values["zeta"]) == pytest.approx((2 * np.pi * 9.0, 0.8))
    assert implausible_pairs(found, found, 0.005, 8.0) == []
    (outside,) = pairs_outside(found, Poles(pairs=found.pairs[:1]), 0.005, (20.0, 50.0))
    assert outside.values["omega_rad_s"] == pytest.approx(2 * np.pi * 9.0)
    assert kind_of_pair(2 * np.pi * 5, 0.02, 8.0) is PairKind.MODE
