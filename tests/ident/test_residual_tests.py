"""Whiteness and independence: false alarms at the stated rate, real faults found."""

import numpy as np
import pytest
from scipy import signal

from ident.checks.residual_tests import independence_test, residual_advice, whiteness_test
from ident.data.finding import FindingKind, finding


def coloured(rng, n, pole):
    return signal.lfilter([1.0], [1.0, -pole], rng.standard_normal(n))


def test_false_alarms_are_about_one_in_a_hundred():
    alarms_white = alarms_independent = outside = 0
    runs = 300
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        e, u = rng.standard_normal(600), coloured(rng, 600, 0.9)
        white, independent = whiteness_test([e]), independence_test([u], [e])
        alarms_white += not white.passed
        alarms_independent += not independent.passed
        outside += np.count_nonzero(np.abs(white.correlation) > white.band)
    # Binomial, 300 trials at 1 %: mean 3, 4 sd above is 10.
    assert alarms_white <= 10
    assert alarms_independent <= 10
    assert outside / (25 * runs) == pytest.approx(0.01, abs=0.006)


def test_coloured_residual_and_input_do_not_fail_the_independence_test_by_themselves():
    alarms = 0
    for seed in range(200):
        rng = np.random.default_rng([1, seed])
        alarms += not independence_test([coloured(rng, 800, 0.9)], [coloured(rng, 800, 0.8)]).passed
    assert alarms <= 12  # a little above 1 %: the variance is estimated


def test_coloured_residuals_are_found_and_named():
    result = whiteness_test([coloured(np.random.default_rng(2), 500, 0.5) for _ in range(3)])
    assert not result.passed
    assert result.largest == (1, result.correlation[0])
    assert result.correlation[0] == pytest.approx(0.5, abs=0.1)
    # Of a first-order process with a factor of 0.5 its past predicts a quarter of the power; of noise none.
    assert result.predictable_share == pytest.approx(0.25, abs=0.08)
    white = whiteness_test([np.random.default_rng(3).standard_normal(5000)])
    assert white.predictable_share < 0.02


def test_missed_dynamics_are_found_at_their_lag():
    rng = np.random.default_rng(3)
    u = rng.standard_normal(2000)
    e = rng.standard_normal(2000)
    e[7:] += 0.3 * u[:-7]
    result = independence_test([u], [e])
    assert not result.passed
    assert result.largest[0] == 7
    assert result.lags[np.argmax(np.abs(result.correlation))] == 7


def test_feedback_shows_at_negative_lags_and_does_not_fail_the_model():
    rng = np.random.default_rng(4)
    e = rng.standard_normal(4000)
    u = rng.standard_normal(4000)
    u[2:] -= 0.8 * e[:-2]
    result = independence_test([u], [e])
    assert result.passed
    assert result.precedes_input


def test_records_are_pooled_without_correlating_across_their_joint():
    rng = np.random.default_rng(5)
    parts = [rng.standard_normal(400) for _ in range(5)]
    pooled = whiteness_test(parts, max_lag=3)
    own = sum(p @ p for p in [q - q.mean() for q in parts])
    expected = sum((q - q.mean())[1:] @ (q - q.mean())[:-1] for q in parts) / own
    assert pooled.correlation[0] == pytest.approx(expected, rel=1e-9)
    assert pooled.band[0] == pytest.approx(2.5758 / np.sqrt(2000), rel=1e-4)


def test_short_records_are_left_out_beside_long_ones():
    rng = np.random.default_rng(7)
    e, u = rng.standard_normal(400), rng.standard_normal(400)
    with_short = whiteness_test([e[:20], e])
    np.testing.assert_array_equal(with_short.correlation, whiteness_test([e]).correlation)
    both = independence_test([u[:20], u], [e[:20], e])
    np.testing.assert_array_equal(both.correlation, independence_test([u], [e]).correlation)


def test_the_tail_may_underflow():
    ramp = np.linspace(-1.0, 1.0, 3000)
    result = whiteness_test([ramp])
    assert result.probability == 0.0  # underflow of the chi-squared tail


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="T > 50"):
        whiteness_test([np.zeros(20)])
    with pytest.raises(ValueError, match="constant"):
        whiteness_test([np.ones(100)])
    with pytest.raises(ValueError, match="equal length"):
        independence_test([np.zeros(100)], [np.zeros(90)])
    with pytest.raises(ValueError, match="at least one record"):
        whiteness_test([])
    with pytest.raises(ValueError, match="max_lag"):
        whiteness_test([np.zeros(100)], max_lag=0)


def test_advice_is_about_the_tests_that_fail():
    rng = np.random.default_rng(8)
    u, white = rng.standard_normal(2000), rng.standard_normal(2000)
    colour = coloured(rng, 2000, 0.8)
    driven = white.copy()
    driven[5:] += 0.5 * u[:-5]
    good = whiteness_test([white]), independence_test([u], [white])
    assert residual_advice(*good) == []
    tested = whiteness_test([colour])
    share = tested.predictable_share
    for order in (0, 8):
        alone = residual_advice(tested, independence_test([u], [colour]), noise_order=order)
        told = {"independent": True, "friction": False, "observer": False, "predictable_share": share}
        assert alone == [finding(FindingKind.NOT_WHITE, noise_order=order, **told)]
    missed = finding(FindingKind.NOT_INDEPENDENT, lag=5)
    assert residual_advice(good[0], independence_test([u], [driven])) == [missed]
    both = residual_advice(tested, independence_test([u], [driven]), friction=True)
    told = {"independent": False, "friction": True, "observer": False, "predictable_share": share}
    assert both == [missed, finding(FindingKind.NOT_WHITE, noise_order=0, **told)]


@pytest.mark.parametrize("kind", ["held binary", "sweep"])
def test_inputs_of_experiments_do_not_fail_the_independence_test_by_themselves(kind):
    """Neither has white samples; the variance of each lag is that of this input and this residual."""
    alarms = 0
    for seed in range(150):
        rng = np.random.default_rng([9, seed])
        if kind == "held binary":
            u = np.repeat(rng.choice([-1.0, 1.0], 50), 20)
        else:
            u = signal.chirp(np.arange(1000) * 0.005, 0.1, 5.0, 40.0)
        alarms += not independence_test([u], [coloured(rng, 1000, 0.9)]).passed
    assert alarms <= 6  # 1 % of 150 and 4 sd; correlated lags make the shared level (Sidak) cautious
