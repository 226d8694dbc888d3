"""An arm identified at one rate, for a controller at another: against the arm sampled there by itself."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from ident import Poles
from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import real_rows
from ident.resampling import ratio_of, resampled, resampled_friction

STEP_S = 0.002
# 5 rad/s and a mode at 120 rad/s, damping .05; behind it an integrator where asked for.
A = scipy.linalg.block_diag([[-5.0]], [[0.0, 1.0], [-(120.0**2), -12.0]])
B = np.array([[5.0], [0.0], [120.0**2]])
C = np.array([[1.0, 0.5, 0.0]])


def arm(period_s, omega, integrators=0):
    """Response (F,) to a command held for a period, read once in it."""
    a, b, c = A, B, C
    if integrators:
        a = np.block([[A, np.zeros((3, 1))], [C, np.zeros((1, 1))]])
        b = np.vstack([B, [[0.0]]])
        c = np.array([[0.0, 0.0, 0.0, 1.0]])
    n = len(a)
    held = scipy.linalg.expm(np.block([[a, b], [np.zeros((1, n + 1))]]) * period_s)
    z = np.exp(1j * omega * period_s)
    return np.array([(c @ np.linalg.solve(x * np.eye(n) - held[:n, :n], held[:n, n:])).item() for x in z])


def posterior(integrators=0, taps=2, delay=0):
    """Of that arm every 2 ms, each pole twice, its coefficients known to 1 %."""
    poles = Poles([np.exp(-5 * STEP_S)], [np.exp((-6 + np.sqrt(120.0**2 - 36) * 1j) * STEP_S)]).doubled()
    size = poles.order + taps
    empty = ResponsePosterior(
        poles,
        np.ones(size),
        np.eye(size),
        STEP_S,
        integrators=integrators,
        fir_length=taps,
        input_delay_samples=delay,
    )
    omega = np.geomspace(0.05, 0.98 * np.pi / STEP_S, 400)
    truth = arm(STEP_S, omega, integrators) * np.exp(-1j * omega * delay * STEP_S)
    rows = real_rows(empty.frequency_rows(omega) / truth[:, None])
    mean = np.linalg.lstsq(rows, real_rows(np.ones((omega.size, 1), complex)), rcond=1e-13)[0][:, 0]
    return replace(empty, mean=mean, covariance_factor=0.01 * np.diag(np.abs(mean)))


@pytest.mark.parametrize("steps", [15, 20, 30, 60])
def test_a_mode_above_half_the_rate_of_a_slow_controller_is_folded_below_it(steps):
    """The mode is at 120 rad/s, half the rates at 105, 79, 52 and 26 rad/s."""
    slower = resampled(posterior(), steps * STEP_S)
    omega = np.geomspace(0.1, 0.95 * np.pi / (steps * STEP_S), 60)
    np.testing.assert_allclose(slower.centre(omega), arm(steps * STEP_S, omega), rtol=1e-3)
    assert np.all(slower.poles.pairs.imag > 0)


@pytest.mark.parametrize("integrators", [0, 1])
@pytest.mark.parametrize("steps", [2, 3])
def test_a_slower_controller_sees_the_arm_that_is_sampled_at_its_rate(integrators, steps):
    """Up to its Nyquist frequency, with what is folded back."""
    slower = resampled(posterior(integrators), steps * STEP_S)
    omega = np.geomspace(0.1, 0.95 * np.pi / (steps * STEP_S), 60)
    np.testing.assert_allclose(slower.centre(omega), arm(steps * STEP_S, omega, integrators), rtol=1e-3)


@pytest.mark.parametrize("integrators", [0, 1])
@pytest.mark.parametrize("parts", [2, 4])
def test_a_faster_controller_sees_it_where_the_log_shows_it(integrators, parts):
    """Within what is folded back, less for an arm that falls faster, which the ellipses hold; above the log's
    Nyquist frequency they are as wide as the response."""
    known = posterior(integrators)
    faster = resampled(known, STEP_S / parts)
    omega = np.geomspace(0.1, 0.3 * np.pi / STEP_S, 60)
    truth = arm(STEP_S / parts, omega, integrators)
    np.testing.assert_allclose(faster.centre(omega), truth, rtol=0.015 if integrators else 0.05)
    width = faster.at(omega).ellipse().semi_major / np.abs(truth)
    before = known.at(omega).ellipse().semi_major / np.abs(known.centre(omega))
    np.testing.assert_allclose(width[omega < 120], before[omega < 120], rtol=0.2)

    above = np.geomspace(0.9, 0.9 * parts, 20) * np.pi / STEP_S
    ellipses = faster.at(above).ellipse()
    assert np.all(ellipses.semi_major > 0.6 * np.abs(faster.centre(above)))
    higher = np.geomspace(0.03, 0.6, 40) * np.pi / STEP_S
    assert np.mean(faster.at(higher).contains(arm(STEP_S / parts, higher, integrators))) > 0.95


def test_a_dead_time_stays_as_many_seconds():
    late = resampled(posterior(delay=3), 2 * STEP_S)
    assert late.input_delay_samples == 1
    omega = np.geomspace(0.1, 0.5 * np.pi / (2 * STEP_S), 40)
    early = resampled(posterior(), 2 * STEP_S).centre(omega)
    np.testing.assert_allclose(late.centre(omega), early * np.exp(-3j * omega * STEP_S), atol=6e-3)
    assert resampled(posterior(delay=3), STEP_S / 2).input_delay_samples == 6


def test_the_same_rate_leaves_everything_as_it_is():
    known = posterior()
    assert resampled(known, STEP_S * (1 + 1e-6)) is known


@pytest.mark.parametrize("period_s", [0.003, 0.0013, 0.0045])
def test_periods_that_do_not_meet_are_refused_in_one_line(period_s):
    with pytest.raises(ValueError, match=r"0\.002") as refused:
        ratio_of(STEP_S, period_s)
    assert "controller_dt_s" in str(refused.value)


@pytest.mark.parametrize("times", [1000, 0.001])
def test_rates_too_far_apart_are_refused_in_one_line(times):
    with pytest.raises(ValueError, match=r"controller_dt_s.*0\.002.*2e-05.*0\.2"):
        ratio_of(STEP_S, times * STEP_S)


def test_the_arm_with_friction_moves_alike_at_both_rates():
    """Under one command, held for the longer step: the same position at the samples that both have."""
    from tests.workflow.test_friction_loop import DT_S, fit

    found = fit()
    finer = resampled_friction(found, DT_S / 2)
    command = np.repeat(np.random.default_rng(1).normal(0, 0.5, 40), 5)
    position = found.arm.run(found.coefficients, command, found.law)[0]
    again = finer.arm.run(finer.coefficients, np.repeat(command, 2), finer.law)[0]
    np.testing.assert_allclose(again[::2], position, atol=0.01 * np.ptp(position))
    assert finer.level == found.level
