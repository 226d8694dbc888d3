"""The comparison methods on data made with scipy.signal.lfilter, and OE on the one-mode plant P1."""

import control
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from ident.comparators.n4sid import n4sid
from ident.comparators.polynomial_fits import PolynomialModel, armax, arx, oe
from ident.comparators.prediction_error import prediction_errors, prediction_jacobian
from ident.comparators.stable_sections import from_sections, sections_derivative, stabilised, to_sections
from tests.ident.benchmark_plants import as_record, p1

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
        armax(record, 2, 2, 0, delay_samples=2),
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


def test_n4sid_finds_plant_and_noise():
    omega = np.linspace(1, 300, 50)
    exact = data(300)
    truth = arx(exact, 2, 2).frequency_response(omega)
    np.testing.assert_allclose(n4sid(exact, 2).frequency_response(omega), truth, rtol=1e-9)
    noisy = data(8000, noise_std=0.5, noise=(C, A))
    model = n4sid(noisy, 2)
    # Of 8000 samples about 1 % of the response is left open, and 1 % of a standard deviation.
    np.testing.assert_allclose(model.frequency_response(omega), truth, rtol=0.05)
    errors = noisy.output[:, 0] - model.one_step_ahead(noisy)
    assert np.std(errors) == pytest.approx(0.5, rel=0.04)


@pytest.mark.parametrize("arguments", [(2, 2, 2), (2, 3, 1), (3, 1, 2)])
def test_the_innovation_form_is_the_same_model(arguments):
    record = data(2000, noise_std=0.5, noise=(C, A))
    model = armax(record, *arguments)
    state_model = model.innovation_form()
    omega = np.linspace(1, 300, 50)
    np.testing.assert_allclose(
        state_model.frequency_response(omega), model.frequency_response(omega), rtol=1e-9
    )
    u = record.input[:, 0]
    np.testing.assert_allclose(state_model.simulate(u), model.simulate(u), atol=1e-9)
    # From rest the innovations are the prediction errors, but for the start that is fitted.
    errors = record.output[:, 0] - state_model.one_step_ahead(record)
    delayed = np.r_[0.0, u[:-1]]
    expected = prediction_errors(model, delayed, record.output[:, 0])
    np.testing.assert_allclose(errors[200:], expected[200:], atol=0.02)


@pytest.mark.parametrize("output_error_start", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_armax_finds_the_noise_filter(output_error_start):
    record = data(20_000, noise_std=0.5, noise=(C, A))
    model = armax(record, 2, 2, 2, output_error_start=output_error_start)
    # sd of c about sqrt((1 - c_2^2) / N) = 7e-3 at most; 4 sd.
    np.testing.assert_allclose(model.c, C, atol=0.03)
    np.testing.assert_allclose(model.a, A, atol=0.02)
    np.testing.assert_allclose(model.b, B, atol=0.02)
    assert np.max(np.abs(np.roots(model.c))) < 1


def test_jacobian_is_the_derivative_of_the_prediction_errors():
    rng = np.random.default_rng(5)
    u, y = rng.normal(size=(2, 40))
    parts = [A, B, C, np.poly([0.5, -0.3])]
    model = PolynomialModel(*parts)
    jacobian = prediction_jacobian(model, u, y, prediction_errors(model, u, y))
    column = 0
    for i, part in enumerate(parts):
        for j in range(part.size) if i == 1 else range(1, part.size):
            errors = []
            for step in (1e-6, -1e-6):
                moved = [p.copy() for p in parts]
                moved[i][j] += step
                errors.append(prediction_errors(PolynomialModel(*moved), u, y))
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
    system = control.tf(B, [*np.convolve(A, [1.0, -0.5]), 0.0], 0.005)
    response = system(np.exp(1j * omega * 0.005))
    np.testing.assert_allclose(model.frequency_response(omega), response, rtol=1e-10)
    np.testing.assert_allclose(np.sort_complex(model.poles), np.sort_complex([*np.roots(A), 0.5]))
    with pytest.raises(ValueError, match="read-only"):
        model.b[0] = 0


def test_smallest_orders_and_silent_signals():
    record = data(60)
    assert oe(record, 3, 0).f.tolist() == [1.0]
    # The search ends when the cost stands still to 1e-8: taps good to 1e-4 of the misfit, about 3.
    np.testing.assert_allclose(oe(record, 3, 0).b, arx(record, 0, 3).b, atol=1e-3)
    assert armax(record, 0, 1, 1).c.size == 2
    silent = as_record(record.input[:, 0], np.zeros(60))
    for model in (arx(silent, 2, 2), oe(silent, 2, 2), armax(silent, 2, 2, 2)):
        np.testing.assert_array_equal(model.simulate(np.ones(10)), np.zeros(10))


def test_unusable_input_is_refused_in_one_line():
    record = data(30)
    for call, message in (
        (lambda: arx(record, -1, 2), "na must be a whole number, at least 0; got -1"),
        (lambda: oe(record, 0, 2), "nb must be a whole number, at least 1"),
        (lambda: oe(record, 1, 2, delay_samples=-1), "delay_samples must be a whole number, at least 0"),
        (lambda: oe(record, "4", 4), "nb must be a whole number, at least 1; got '4'"),
        (lambda: armax(record, 10, 10, 10), "20 equations for 30 unknowns"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_oe_on_p1_finds_the_mode():
    """Measured over 50 seeds: median 0.033, 90th percentile 0.079 (published peer: 0.049 and 0.120)."""
    omega = np.geomspace(1, 100, 200)
    truth = p1(0)
    model = oe(truth.record, 4, 4)
    error = model.frequency_response(omega) / truth.response(omega) - 1
    assert np.sqrt(np.mean(np.abs(error) ** 2)) < 0.15
    poles = model.poles[model.poles.imag > 0]
    assert np.any(np.abs(np.abs(np.log(poles)) / 0.005 - 15) < 0.5)
    assert np.all(np.abs(model.poles) < 1)
