"""Filters, convolutions, trends, quantiles and tails against SciPy's, digit by digit."""

import numpy as np
import pytest
import scipy.signal
import scipy.stats

from ident.data.distributions import (
    chi_square_quantile,
    chi_square_tail,
    fisher_tail,
    normal_quantile,
    normal_tail,
    student_quantile,
    student_tail,
)
from ident.data.filters import convolved, through_filter, without_line

RNG = np.random.default_rng(7)
SIGNAL = RNG.standard_normal(301)
COLUMNS = RNG.standard_normal((301, 3))
PROBABILITIES = np.array([0.0, 1e-12, 0.025, 0.5, 0.95, 1.0])
INSIDE = PROBABILITIES[1:-1]
VALUES = np.array([0.0, 1e-9, 0.7, 3.0, 40.0, np.inf])


@pytest.mark.parametrize("signals", [SIGNAL, COLUMNS, SIGNAL[:1], COLUMNS[:2]], ids=lambda x: str(x.shape))
@pytest.mark.parametrize(
    ("numerator", "denominator"),
    [([1.0], [2.0, -0.9]), ([0.0, 1.0], [1.0, -1.2, 0.7]), ([1, 2, 3, 4], [1.0, -0.5]), ([1, -2], [4.0])],
)
def test_a_filter_is_that_of_scipy(numerator, denominator, signals):
    expected = scipy.signal.lfilter(numerator, denominator, signals, axis=0)
    np.testing.assert_array_equal(through_filter(numerator, denominator, signals), expected)


def test_a_filter_goes_on_from_its_state():
    expected, _ = scipy.signal.lfilter([0.1, 0.2], [1.0, -0.8], SIGNAL, zi=[0.6])
    np.testing.assert_array_equal(through_filter([0.1, 0.2], [1.0, -0.8], SIGNAL, before=0.6), expected)


def test_from_a_missing_value_on_all_is_missing():
    behind = through_filter([1.0], [1.0, -0.5], np.array([1.0, np.nan, 1.0, 1.0]))
    np.testing.assert_array_equal(np.isnan(behind), [False, True, True, True])


def test_a_signal_is_left_as_it_was():
    before = SIGNAL.copy()
    through_filter([1.0], [1.0, -0.5], SIGNAL)
    np.testing.assert_array_equal(SIGNAL, before)


def test_convolution_and_correlation_are_those_of_scipy():
    np.testing.assert_array_equal(
        convolved(SIGNAL, SIGNAL[:40]), scipy.signal.fftconvolve(SIGNAL, SIGNAL[:40])
    )
    correlation = scipy.signal.correlate(SIGNAL, SIGNAL[:40], mode="full", method="fft")
    np.testing.assert_array_equal(convolved(SIGNAL, SIGNAL[:40][::-1]), correlation)


@pytest.mark.parametrize("signals", [SIGNAL, COLUMNS], ids=["signal", "columns"])
def test_a_line_is_taken_off_as_by_scipy(signals):
    drifting = (signals.T + np.linspace(3.0, 9.0, 301)).T
    np.testing.assert_array_equal(without_line(drifting), scipy.signal.detrend(drifting, axis=0))


@pytest.mark.parametrize("freedom", [0, 1, 2, 37])
def test_quantiles_and_tails_are_those_of_scipy(freedom):
    chi2, t, f = scipy.stats.chi2(freedom), scipy.stats.t(freedom), scipy.stats.f(freedom, freedom + 5)
    np.testing.assert_array_equal(chi_square_quantile(PROBABILITIES, freedom), chi2.ppf(PROBABILITIES))
    np.testing.assert_array_equal(chi_square_tail(VALUES, freedom), chi2.sf(VALUES))
    np.testing.assert_array_equal(student_quantile(INSIDE, freedom), t.ppf(INSIDE))
    np.testing.assert_array_equal(student_tail(VALUES, freedom), t.sf(VALUES))
    np.testing.assert_array_equal(fisher_tail(VALUES, freedom, freedom + 5), f.sf(VALUES))


def test_normal_quantiles_and_tails_are_those_of_scipy():
    np.testing.assert_array_equal(normal_quantile(PROBABILITIES), scipy.stats.norm.ppf(PROBABILITIES))
    np.testing.assert_array_equal(normal_tail(VALUES), scipy.stats.norm.sf(VALUES))


def test_a_number_gives_a_number():
    assert float(chi_square_quantile(0.95, 1)) == scipy.stats.chi2.ppf(0.95, 1)
