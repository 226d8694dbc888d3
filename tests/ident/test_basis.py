"""The basis against its own identities, its limits, and independent realisations."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, strategies as st

from ident.basis import functions
from ident.basis.poles import Poles
from tests.ident.paper_oracles import complex_realisation, printed_functions, real_realisation

real_poles = st.lists(st.floats(-0.95, 0.95), max_size=3)
pair_poles = st.lists(
    st.tuples(st.floats(0.05, 0.95), st.floats(0.01, np.pi - 0.01)).map(lambda v: v[0] * np.exp(1j * v[1])),
    max_size=3,
)
poles_inside = st.builds(Poles, real_poles, pair_poles).filter(lambda poles: poles.order > 0)
MIXED = Poles([0.5, 0.9, -0.3], [0.8 * np.exp(0.4j), 0.95 * np.exp(2.0j)])
Z = np.exp(1j * np.linspace(0.1, 3, 7))
CIRCLE = np.exp(2j * np.pi * np.arange(4096) / 4096)


@given(poles_inside)
def test_realisation_is_lossless(poles):
    A, B, C, D = functions.basis_state_space(poles)
    whole = np.block([[A, B], [C, D]])
    np.testing.assert_allclose(whole @ whole.T, np.eye(poles.order + 1), atol=1e-14)


@pytest.mark.parametrize("gamma", [0.99, 0.9999, 0.999999])
def test_realisation_is_lossless_next_to_the_circle(gamma):
    """Where inverting E of (24) loses digits."""
    poles = Poles([gamma, 1 - 1e-9], np.sqrt(gamma) * np.exp(1j * np.array([1e-3, 0.1, 3.0])))
    A, B, _, _ = functions.basis_state_space(poles)
    assert np.linalg.norm(A @ A.T + B @ B.T - np.eye(poles.order)) <= 1e-14
    np.testing.assert_allclose(functions.block_parameters(poles)[2:, 0], gamma, rtol=1e-15)
    away = np.exp(1j * np.array([0.3, 1.1, 2.0]))
    assert np.abs(np.abs(functions.all_pass_response(poles, away)) - 1).max() < 1e-13


@given(poles_inside)
def test_basis_is_orthonormal_on_the_circle(poles):
    basis = functions.basis_response(poles, CIRCLE)
    # The mean over 4096 points aliases lags of 4096: 0.95^4096 is nothing.
    np.testing.assert_allclose(basis.conj().T @ basis / CIRCLE.size, np.eye(poles.order), atol=1e-11)


@given(poles_inside)
def test_kernel_identity(poles):
    z1, z2 = np.array([1.3 * np.exp(0.2j), -1.1, 1.05j]), np.array([1.2, 1.5 * np.exp(1j), -1.01j])
    left = functions.basis_response(poles, z1) @ functions.basis_response(poles, z2).conj().T
    product = np.outer(functions.all_pass_response(poles, z1), functions.all_pass_response(poles, z2).conj())
    right = (1 - product) / (np.outer(z1, z2.conj()) - 1)
    np.testing.assert_allclose(left, right, rtol=1e-9, atol=1e-11)


def test_real_poles_give_the_printed_formula():
    x = np.array([0.5, -0.3, 0.9])
    np.testing.assert_allclose(functions.basis_response(Poles(x), Z), printed_functions(x, Z), rtol=1e-12)


def test_fir_is_delay():
    u = np.random.default_rng(0).normal(size=50)
    columns = functions.regressor(Poles(np.zeros(4)), u)
    for i in range(4):
        np.testing.assert_array_equal(columns[:, i], np.concatenate([np.zeros(i + 1), u[: -i - 1]]))


def test_laguerre_by_transfer_functions():
    a, u = 0.8, np.random.default_rng(1).normal(size=200)
    signal = u
    columns = functions.regressor(Poles([a, a, a]), u)
    for i in range(3):
        expected = scipy.signal.lfilter([0, np.sqrt(1 - a**2)], [1, -a], signal)
        np.testing.assert_allclose(columns[:, i], expected, atol=1e-12)
        signal = scipy.signal.lfilter([-a, 1], [1, -a], signal)


def test_two_parameter_kautz_by_transfer_functions():
    """Wahlberg's functions with b = beta and c = -gamma, pair repeated."""
    pole, u = 0.9 * np.exp(0.7j), np.random.default_rng(2).normal(size=200)
    gamma, beta = abs(pole) ** 2, 2 * pole.real / (1 + abs(pole) ** 2)
    denominator = [1, -beta * (1 + gamma), gamma]
    columns = functions.regressor(Poles([], [pole, pole]), u)
    signal = u
    for i in (0, 2):
        odd = scipy.signal.lfilter(np.sqrt(1 - gamma**2) * np.array([0, 1, -beta]), denominator, signal)
        even = scipy.signal.lfilter([0, 0, np.sqrt((1 - gamma**2) * (1 - beta**2))], denominator, signal)
        np.testing.assert_allclose(columns[:, i], odd, atol=1e-11)
        np.testing.assert_allclose(columns[:, i + 1], even, atol=1e-11)
        signal = scipy.signal.lfilter(denominator[::-1], denominator, signal)


def test_paper_state_space_gives_the_same_basis():
    """(22)-(26), made real by (25), is the lossless cascade itself: same A and B to rounding."""
    A, B = real_realisation(MIXED)
    cascade = functions.basis_state_space(MIXED)
    # Inverting E costs its condition number times rounding, about 1e2 here.
    np.testing.assert_allclose(A, cascade.A, atol=1e-13)
    np.testing.assert_allclose(B, cascade.B, atol=1e-13)


def test_paper_complex_states_are_the_printed_functions():
    A, B = complex_realisation(MIXED)
    response = np.array([np.linalg.solve(value * np.eye(MIXED.order) - A, B)[:, 0] for value in Z])
    np.testing.assert_allclose(response, printed_functions(MIXED.values, Z), rtol=1e-10)


def test_regressor_steps_the_state_space():
    u = np.random.default_rng(3).normal(size=120)
    A, B, C, D = functions.basis_state_space(MIXED)
    columns, out = functions.regressor(MIXED, u), functions.all_pass_signal(MIXED, u)
    x = np.zeros((MIXED.order, 1))
    for k, value in enumerate(u):
        np.testing.assert_allclose(columns[k], x[:, 0], atol=1e-13)
        np.testing.assert_allclose(out[k], (C @ x + D * value)[0, 0], atol=1e-13)
        x = A @ x + B * value


def test_free_response_is_powers_of_the_state_matrix():
    A, B, _, _ = functions.basis_state_space(MIXED)
    x = B
    for row in functions.free_response(MIXED, 200):
        np.testing.assert_allclose(row, x[:, 0], atol=1e-13)
        x = A @ x


def test_free_response_that_dies_out_stays_zero():
    columns = functions.free_response(Poles([0.1], [0.2 * np.exp(1j)]), 2000)
    assert np.all(columns[100:] == 0)
    assert np.any(columns[0] != 0)  # it did start


def test_response_near_a_pole_is_accurate():
    """Factored denominators: 1e-9 away from the pole the value is still good to rounding times 1e9."""
    pole = 0.99 * np.exp(0.3j)
    z = np.array([pole + 1e-9])
    gamma, beta = abs(pole) ** 2, 2 * pole.real / (1 + abs(pole) ** 2)
    expected = np.sqrt(1 - gamma**2) * (pole - beta) / (1e-9 * (pole - pole.conjugate()))
    value = functions.basis_response(Poles([], [pole]), z)[0, 0]
    assert abs(value / expected - 1) < 1e-6
