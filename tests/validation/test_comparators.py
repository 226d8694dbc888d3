"""The comparison methods on data made with scipy.signal.lfilter, and OE on the one-mode plant P1."""

from __future__ import annotations

import control
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from tests.ident.benchmark_plants import as_record, p1
from validation.comparators.comparators import PolynomialModel, armax, arx, fir, oe, regularised_fir
from validation.comparators.prediction_error import Polynomials, prediction_errors, prediction_jacobian
from validation.comparators.stable_sections import from_sections, sections_derivative, stabilised, to_sections

A = np.poly([0.9 * np.exp(0.5j), 0.9 * np.exp(-0.5j)]).real
B = np.array([1.0, 0.5])
C = np.poly([0.7, -0.4])
ONE = np.ones(1)


def data(n_samples, noise_std=0.0, noise=(ONE, ONE), seed=0, delay=1):
    """Record of B/A q^-delay with white noise through (numerator, denominator) added."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=n_samples)
    clean = scipy.signal.lfilter(np.concatenate([np.zeros(delay), B]), A, u)
    return as_record(u, clean + scipy.signal.lfilter(*noise, noise_std * rng.normal(size=n_samples)))


def test_noise_free_data_give_back_the_plant():
    record = data(300, delay=2)
    for model in (
        arx(record, 2, 2, delay_samples=2),
        oe(record, 2, 2, delay_samples=2),
        armax([record, data(200, seed=1, delay=2)], 2, 2, 0, delay_samples=2),
    ):
        # Rounding times the condition of the regression, far below 1e6.
        np.testing.assert_allclose(np.convolve(model.a, model.f), A, atol=1e-10)
        np.testing.assert_allclose(model.b, B, atol=1e-10)
        np.testing.assert_allclose(model.c, ONE)
    longer = oe(record, 3, 3, delay_samples=1)  # too high an order, and a delay that b[0] = 0 makes up for
    omega = np.linspace(1, 600, 50)
    expected = arx(record, 2, 2, delay_samples=2).frequency_response(omega)
    np.testing.assert_allclose(longer.frequency_response(omega), expected, rtol=1e-4)


def test_white_output_noise_biases_arx_and_not_oe():
    record = data(20_000, noise_std=1.0)
    # Standard deviation of the OE coefficients here about 2e-3; the ARX bias does not shrink with the record.
    np.testing.assert_allclose(oe(record, 2, 2).f, A, atol=0.01)
    assert np.max(np.abs(arx(record, 2, 2).a - A)) > 0.05


def test_arx_noise_is_no_trouble_for_arx():
    model = arx(data(20_000, noise_std=0.5, noise=(ONE, A)), 2, 2)
    np.testing.assert_allclose(model.a, A, atol=0.015)  # 4 sd, 0.5 / sqrt(N) / (spread of y, about 1)
    np.testing.assert_allclose(model.b, B, atol=0.015)


@pytest.mark.parametrize("output_error_start", [True, False])
def test_armax_finds_the_noise_filter(output_error_start):
    record = data(20_000, noise_std=0.5, noise=(C, A))
    model = armax(record, 2, 2, 2, output_error_start=output_error_start)
    # sd of c about sqrt((1 - c_2^2) / N) = 7e-3 at most; 4 sd.
    np.testing.assert_allclose(model.c, C, atol=0.03)
    np.testing.assert_allclose(model.a, A, atol=0.02)
    np.testing.assert_allclose(model.b, B, atol=0.02)
    assert np.max(np.abs(np.roots(model.c))) < 1


def test_fir_is_least_squares_on_shifted_inputs():
    record = data(120, noise_std=0.3)
    u, y = record.input[:, 0], record.output[:, 0]
    rows = scipy.linalg.toeplitz(np.append(0, u[:-1]), np.zeros(15))
    np.testing.assert_allclose(fir(record, 15).b, np.linalg.lstsq(rows, y)[0], rtol=1e-9)


def test_regularised_fir_beats_fir_on_short_noisy_data():
    true = scipy.signal.lfilter(B, A, np.eye(1, 60)[0])
    for seed in range(5):
        record = data(90, noise_std=1.0, seed=seed)
        plain, smooth = (np.linalg.norm(f(record, 60).b - true) for f in (fir, regularised_fir))
        assert smooth < 0.8 * plain


def test_regularised_fir_lets_rich_data_speak():
    true = scipy.signal.lfilter(B, A, np.eye(1, 40)[0])
    record = data(5000, noise_std=0.01)
    # sd of each tap 0.01 / sqrt(5000) = 1.4e-4, about 4 to 7 of them; 80 taps leave a tail of 0.9^80 = 2e-4.
    np.testing.assert_allclose(regularised_fir(record, 40).b, fir(record, 40).b, atol=1e-3)
    np.testing.assert_allclose(fir(record, 80).b[:40], true, atol=1e-3)
    assert regularised_fir(data(30), 50).b.shape == (50,)  # fewer samples than taps


def test_regularised_fir_is_the_most_likely_gaussian_posterior():
    """Independent N x N formulas: no kernel on a grid is more likely than the one behind the taps."""
    record = data(60, noise_std=1.0, seed=3)
    u, y = record.input[:, 0], record.output[:, 0]
    rows = scipy.linalg.toeplitz(np.append(0, u[:-1]), np.zeros(30))
    index = np.arange(1, 31)
    best, taps = np.inf, None
    for lam in np.linspace(0.6, 0.99, 79):
        kernel = lam ** np.maximum(index[:, None], index)
        for alpha in np.geomspace(1e-2, 1e3, 60):
            covariance = np.eye(60) + alpha * rows @ kernel @ rows.T
            weighted = np.linalg.solve(covariance, y)
            deviance = 60 * np.log(y @ weighted) + np.linalg.slogdet(covariance)[1]
            if deviance < best:
                best, taps = deviance, alpha * kernel @ rows.T @ weighted
    # The grid is 0.005 in lam and 22 % in alpha: half a step changes the posterior mean by under 2 %.
    assert np.linalg.norm(regularised_fir(record, 30).b - taps) < 0.02 * np.linalg.norm(taps)


def test_jacobian_is_the_derivative_of_the_prediction_errors():
    rng = np.random.default_rng(5)
    signals = [(rng.normal(size=40), rng.normal(size=40)), (rng.normal(size=25), rng.normal(size=25))]
    parts = [A, B, C, np.poly([0.5, -0.3])]
    jacobian = prediction_jacobian(
        Polynomials(*parts), signals, prediction_errors(Polynomials(*parts), signals)
    )
    column = 0
    for i, part in enumerate(parts):
        for j in range(part.size) if i == 1 else range(1, part.size):
            errors = []
            for step in (1e-6, -1e-6):
                moved = [p.copy() for p in parts]
                moved[i][j] += step
                errors.append(prediction_errors(Polynomials(*moved), signals))
            # Central difference: truncation 1e-12, rounding 1e-16 / 1e-6, both times values up to 1e2.
            np.testing.assert_allclose(jacobian[:, column], (errors[0] - errors[1]) / 2e-6, atol=1e-7)
            column += 1
    assert column == jacobian.shape[1]


def test_sections_are_stable_and_invert():
    rng = np.random.default_rng(6)
    for order in (0, 1, 2, 5, 6):
        x = rng.uniform(-1, 1, order)
        polynomial = from_sections(x)
        assert np.all(np.abs(np.roots(polynomial)) < 1)
        # Roots of random order-6 polynomials are good to about 1e-13.
        np.testing.assert_allclose(from_sections(to_sections(polynomial)), polynomial, atol=1e-10)
        for j in range(order):
            move = 1e-6 * np.eye(order)[j]
            slope = (from_sections(x + move) - from_sections(x - move))[1:] / 2e-6
            np.testing.assert_allclose(sections_derivative(x)[:, j], slope, atol=1e-8)


def test_unstable_roots_are_mirrored_with_the_gain_pattern_kept():
    polynomial = np.poly([2.0, 1.1 * np.exp(1j), 1.1 * np.exp(-1j), 0.3, 0.0]).real
    mirrored = stabilised(polynomial)
    expected = np.poly([0.5, np.exp(1j) / 1.1, np.exp(-1j) / 1.1, 0.3, 0.0]).real
    np.testing.assert_allclose(mirrored, expected, atol=1e-12)
    np.testing.assert_allclose(from_sections(to_sections(polynomial)), expected, atol=1e-7)


def test_the_model_is_the_same_in_every_form():
    model = PolynomialModel(A, B, C, np.array([1.0, -0.5]), 3, 0.005)
    omega = np.linspace(0, np.pi / 0.005, 40)
    u = np.random.default_rng(7).normal(size=50)
    expected = scipy.signal.lfilter(np.append(np.zeros(3), B), np.convolve(A, [1.0, -0.5]), u)
    np.testing.assert_allclose(model.simulate(u), expected, atol=1e-12)
    system = model.to_control()
    response = system(np.exp(1j * omega * 0.005))
    np.testing.assert_allclose(model.frequency_response(omega), response, rtol=1e-10)
    np.testing.assert_allclose(control.forced_response(system, inputs=u).outputs, expected, atol=1e-9)
    np.testing.assert_allclose(np.sort_complex(model.poles), np.sort_complex([*np.roots(A), 0.5]))
    with pytest.raises(ValueError, match="read-only"):
        model.b[0] = 0


def test_smallest_orders_and_silent_signals():
    record = data(60)
    assert oe(record, 3, 0).f.tolist() == [1.0]
    # The search ends when the cost stands still to 1e-8: taps good to 1e-4 of the misfit, about 3.
    np.testing.assert_allclose(oe(record, 3, 0).b, fir(record, 3).b, atol=1e-3)
    assert armax(record, 0, 1, 1).c.size == 2
    silent = as_record(record.input[:, 0], np.zeros(60))
    for model in (arx(silent, 2, 2), oe(silent, 2, 2), armax(silent, 2, 2, 2), regularised_fir(silent, 9)):
        np.testing.assert_array_equal(model.simulate(np.ones(10)), np.zeros(10))


def test_unusable_input_is_refused_in_one_line():
    record = data(30)
    for call, message in (
        (lambda: arx(record, -1, 2), "na must be at least 0; got -1"),
        (lambda: oe(record, 0, 2), "nb must be at least 1"),
        (lambda: oe(record, 1, 2, delay_samples=-1), "delay_samples must be at least 0"),
        (lambda: armax(record, 10, 10, 10), "20 equations for 30 unknowns"),
        (lambda: fir(record, 31), "30 equations for 31 unknowns"),
        (lambda: arx([], 1, 1), "no record"),
        (lambda: arx([record, as_record(np.ones(30), np.ones(30), dt_s=0.01)], 1, 1), "dt_s is 0.01"),
        (lambda: PolynomialModel(2 * ONE, B, ONE, ONE, 1, 0.005), "a must begin with 1"),
        (lambda: PolynomialModel(ONE, B * np.nan, ONE, ONE, 1, 0.005), "b must be"),
        (lambda: PolynomialModel(ONE, B, ONE, ONE, 1, 0.0), "dt_s"),
        (lambda: arx(record, 1, 1).simulate(np.ones((5, 1))), r"u must be \(T,\)"),
        (lambda: arx(record, 1, 1).frequency_response(np.array([700.0])), "stop at pi/dt"),
        (lambda: PolynomialModel([1, -1], B, ONE, ONE, 1, 1).frequency_response(np.zeros(1)), "has a pole"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_oe_on_p1_finds_the_mode():
    """Measured over 50 seeds: median 0.033, 90th percentile 0.079 (published peer: 0.049 and 0.120)."""
    omega = np.geomspace(1, 100, 200)
    for seed in range(3):
        truth = p1(seed)
        model = oe(truth.record, 4, 4)
        error = model.frequency_response(omega) / truth.response(omega) - 1
        assert np.sqrt(np.mean(np.abs(error) ** 2)) < 0.15
        poles = model.poles[model.poles.imag > 0]
        assert np.any(np.abs(np.abs(np.log(poles)) / 0.005 - 15) < 0.5)
        assert np.all(np.abs(model.poles) < 1)
