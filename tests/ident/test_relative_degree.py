"""Conditions of a relative degree against SciPy: sampled plants, matrix logarithm, contour integrals."""

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from ident import GobfModel, Poles, basis_response, basis_state_space
from ident.basis.relative_degree import conditions, conditions_with_sensitivities, null_space
from tests.ident.benchmark_plants import DT_S, by_factors


def moments(response, circles, count):
    """1/(2 pi j) times the integral of G(z) log(z)^m / (z - 1), m = 1 .. count, around circles that hold all
    poles.

    The trapezoidal rule on a circle converges geometrically; G C A_c^k B_c dt^(k + 1) = the moment m = k + 1.
    """
    totals = np.zeros(count, dtype=np.complex128)
    turn = np.exp(2j * np.pi * np.arange(400) / 400)
    for centre, radius in circles:
        z = centre + radius * turn
        weights = response(z) * radius * turn / 400
        for m in range(count):
            totals[m] += np.sum(weights * np.log(z) ** (m + 1) / (z - 1))
    return totals.real


def with_zeros(poles, integrators):
    """The poles of a `GobfModel` with integrators."""
    return Poles(np.concatenate([np.zeros(integrators), poles.real]), poles.pairs)


def model_response(poles, integrators, coefficients):
    return lambda z: basis_response(poles, z) @ coefficients * (z / (z - 1)) ** integrators


PLANTS = {
    "P1": ([-1 / 113.4, -1 / 10.8 + 1 / 10.5, 1.0], [], [(15.0, 0.015)], 2),
    "no zero": ([1.0], [], [(15.0, 0.015)], 2),
    "two modes, one real pole": ([1.0, 5.0], [3.0], [(15.0, 0.015), (200.0, 0.02)], 1),
    "no integrator": ([1.0, 50.0, 900.0], [0.1, 7.0], [(15.0, 0.015), (60.0, 0.3)], 0),
}


@pytest.mark.parametrize("plant", PLANTS)
def test_sampled_plants_satisfy_the_conditions_of_their_relative_degree_and_no_more(plant):
    numerator, decays, modes, k = PLANTS[plant]
    denominator, poles = by_factors(decays, modes, k)
    order = denominator.size - 1
    relative_degree = order - (len(numerator) - 1)
    A, B, C, _, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(numerator, denominator), DT_S)
    # Coefficients from the response, each frequency weighted by its size.
    z = np.exp(1j * np.geomspace(0.1, 600, 300) * DT_S)
    response = np.array([(C @ np.linalg.solve(point * np.eye(order) - A, B))[0, 0] for point in z])
    columns = basis_response(poles, z) * (z[:, None] / (z[:, None] - 1)) ** k / response[:, None]
    rows = np.vstack([columns.real, columns.imag])
    lengths = np.linalg.norm(rows, axis=0)
    coefficients = np.linalg.lstsq(rows / lengths, np.repeat([1.0, 0.0], z.size), rcond=None)[0] / lengths
    R = conditions(poles, k, min(relative_degree + 1, order))
    share = np.abs(R @ coefficients) / (np.abs(R) @ np.abs(coefficients))
    # The response of five or six poles gives coefficients to about 1e-9 only.
    assert np.all(share[: relative_degree - 1] < 1e-7)
    if relative_degree < order:
        assert share[relative_degree - 1] > 0.01


@pytest.mark.parametrize("k", [0, 1, 2, 3])
def test_conditions_are_those_of_scipys_matrix_logarithm(k):
    rest = Poles([0.9999, 0.2], [0.99 * np.exp(0.3j), 0.9 * np.exp(2.8j)])
    cascade = basis_state_space(rest)
    n = k + rest.order
    hold = np.zeros((n + 1, n + 1))
    hold[:k, :k] = np.eye(k) + np.eye(k, k=-1)
    hold[k:n, k:n] = cascade.A
    hold[k:n, k - 1 if k else n] = cascade.B[:, 0]
    if k:
        hold[0, n] = 1
    hold[n, n] = 1
    log = scipy.linalg.logm(hold)
    expected = [log[:n, n]]
    for _ in range(3):
        expected.append(log[:n, :n] @ expected[-1])
    rows = conditions(with_zeros(rest, k), k, 5)
    scale = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(rows[:, k:] / scale, np.array(expected)[:, k:] / scale, atol=1e-12)
    if k:
        # The last of the columns z^(k - j)/(z - 1)^k is the state 1/(z - 1)^k itself.
        np.testing.assert_allclose(
            rows[:, k - 1] / scale[:, 0], np.array(expected)[:, k - 1] / scale[:, 0], atol=1e-12
        )


@pytest.mark.parametrize("k", [0, 2])
def test_functionals_of_the_model_and_of_blocks_behind_it_are_contour_integrals(k):
    poles = with_zeros(Poles([0.7], [0.9 * np.exp(0.5j), 0.6 * np.exp(0.9j)]), k)
    coefficients = np.random.default_rng(0).normal(size=poles.order)
    blocks = (Poles([0.7]), Poles(pairs=[0.9 * np.exp(0.5j)]))
    rows, behind = conditions_with_sensitivities(poles, k, 4, coefficients, blocks)
    model = model_response(poles, k, coefficients)
    # One circle around all poles, clear of the cut of the logarithm.
    circles = [(0.95, 0.85)]
    np.testing.assert_allclose(rows @ coefficients, moments(model, circles, 3), rtol=1e-9)
    at = 0
    for block in blocks:
        for i in range(block.order):
            driven = lambda z, block=block, i=i: basis_response(block, z)[:, i] * model(z)  # noqa: E731
            np.testing.assert_allclose(behind[:, at], moments(driven, circles, 3), rtol=1e-9)
            at += 1
    np.testing.assert_allclose(rows, conditions(poles, k, 4), rtol=1e-12, atol=1e-14)


def test_a_model_in_the_null_space_has_a_sampled_counterpart_of_that_relative_degree():
    """Back to continuous time by SciPy: the first derivatives of its impulse response vanish at t = 0."""
    poles = Poles([0.99], [0.995 * np.exp(0.08j), 0.97 * np.exp(0.9j)])
    rows = conditions(poles, 0, 3)
    basis, inverse = null_space(rows, np.array([3.0, 1, 1, 2, 0.1]))
    np.testing.assert_allclose(rows @ basis, 0, atol=1e-14)
    np.testing.assert_allclose(rows @ inverse, np.eye(2), atol=1e-12)
    assert basis.shape == (5, 3)
    assert np.linalg.matrix_rank(basis) == 3
    A, B, C, _ = GobfModel(poles, basis @ [1.0, -2.0, 0.5], DT_S).state_space()
    log = scipy.linalg.logm(np.block([[A, B], [np.zeros((1, 5)), np.eye(1)]])).real / DT_S
    Ac, Bc = log[:5, :5], log[:5, 5:]
    derivatives = [np.linalg.norm(C) * np.linalg.norm(np.linalg.matrix_power(Ac, m) @ Bc) for m in range(3)]
    values = [(C @ np.linalg.matrix_power(Ac, m) @ Bc)[0, 0] for m in range(3)]
    np.testing.assert_allclose(np.array(values[:2]) / derivatives[:2], 0, atol=1e-11)
    assert abs(values[2]) > 1e-3 * derivatives[2]


def test_relative_degree_one_asks_for_nothing():
    assert conditions(Poles([-0.5, 0.0]), 0, 1).shape == (0, 2)


@pytest.mark.parametrize(
    ("poles", "integrators", "relative_degree", "message"),
    [
        (Poles([0.5, -0.2]), 0, 2, r"real pole -0\.2"),
        (Poles([0.0, 0.5]), 0, 2, "real pole 0 "),
        (Poles([0.5, 0.3]), 1, 2, "first real poles"),
        (Poles([0.5, 0.4]), 0, 3, "relative_degree = 3 .* got 2"),
        (Poles([0.5, 0.4]), 0, 0, "at least 1; got 0"),
    ],
)
def test_impossible_conditions_are_refused(poles, integrators, relative_degree, message):
    with pytest.raises(ValueError, match=message):
        conditions(poles, integrators, relative_degree)
