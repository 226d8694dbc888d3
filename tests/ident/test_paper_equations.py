"""Equations (1) to (31) of Ziaei & Wang 2006: the function that is each of them, and the test that checks it.

`EQUATIONS` is the table; what moves is missed where it is imported, what loses its test in the first test.
Reading the printed text: (8) and (9) are about squared moduli, the first entry of (19) is negative (otherwise
(15) fails), and gamma of (29) is |xi|^2 in (0, 1), Fig. 1's axis being -gamma.
"""

import re
import typing

import nlopt
import numpy as np
import pytest
import scipy.optimize
import scipy.signal

from ident.basis.coordinates import search_space
from ident.basis.functions import (
    all_pass_response,
    basis_response,
    basis_state_space,
    block_parameters,
    regressor,
)
from ident.basis.model import GobfModel
from ident.basis.options import Algorithm, IdentOptions
from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.comparators.polynomial_fits import arx
from ident.fit.least_squares import fit
from ident.fit.problem import CandidateCost
from ident.fit.regression import prepare
from ident.one_input import identify
from ident.search.direct import minimise
from ident.search.error_surface import error_surface
from ident.search.pole_search import PoleSearch
from tests.ident import (
    paper_oracles as oracles,
    test_basis,
    test_candidate_cost,
    test_error_surface,
    test_least_squares,
    test_model,
    test_pole_search,
)
from tests.ident.benchmark_plants import as_record

DT_S = 0.005
MIXED = Poles([0.5, 0.9, -0.3], [0.8 * np.exp(0.4j), 0.95 * np.exp(2.0j)])
Z = np.exp(1j * np.array([0.05, 0.3, 1.1, 2.0, 3.1]))
DIRECT = [name for name in typing.get_args(Algorithm) if "DIRECT" in name]


# What each equation says, the functions that are it, and its tests in other files; those in this file have
# its number in their names.
EQUATIONS = (
    ((1,), "y = G(q) u + v, G a sum of delays", [GobfModel.simulate],
        [test_model.test_simulation_agrees_with_control]),
    ((2,), "FIR: the sum cut off", [arx, regressor], [test_basis.test_fir_is_delay]),
    ((3,), "y = sum theta_i L_i(q) u", [GobfModel.frequency_response, GobfModel.simulate],
        [test_model.test_simulation_agrees_with_control]),
    ((4,), "orthonormal on the unit circle", [basis_response],
        [test_basis.test_basis_is_orthonormal_on_the_circle, test_basis.test_kernel_identity]),
    ((5,), "the generalised basis", [basis_response, all_pass_response, oracles.complex_realisation],
        [test_basis.test_real_poles_give_the_printed_formula,
        test_basis.test_paper_complex_states_are_the_printed_functions]),
    ((6,), "Laguerre: one real pole repeated", [basis_response, regressor],
        [test_basis.test_laguerre_by_transfer_functions]),
    ((7, 8, 9, 10), "real pair as unitary combinations of the complex functions", [oracles.combination],
        [test_basis.test_paper_state_space_gives_the_same_basis]),
    ((11, 12), "each function from the one before", [basis_response, oracles.complex_realisation], []),
    ((13,), "m1 q + m2 behind the all-pass of the poles before", [regressor, oracles.combination], []),
    ((14, 15, 16), "x_k' M x_k = |1 - xi^2|^2, x_1' M x_2 = 0, and M", [oracles.pair_metric], []),
    ((17,), "x_2 from x_1 by a quarter turn in the space of M", [oracles.rotated_numerators], []),
    ((18, 19), "the solution with m2 = 0", [oracles.paper_numerators], []),
    ((20,), "J, the mean square of the residual", [fit, error_surface],
        [test_error_surface.test_surface_is_the_fit_at_every_point]),
    ((21,), "linear regression phi' theta", [regressor, GobfModel.simulate], []),
    ((22, 23, 24), "difference equations of the states, solved for x(k+1)", [oracles.complex_realisation],
        [test_basis.test_paper_complex_states_are_the_printed_functions]),
    ((25, 26), "real states by the block diagonal T", [oracles.real_realisation, basis_state_space],
        [test_basis.test_paper_state_space_gives_the_same_basis,
        test_basis.test_realisation_is_lossless_next_to_the_circle]),
    ((27,), "least-squares coefficients", [fit],
        [test_least_squares.test_fit_is_the_dense_least_squares_fit]),
    ((28, 29), "filter parameters eta, beta and gamma", [search_space, block_parameters],
        [test_pole_search.test_points_of_the_cube_are_ordered_poles_inside_the_circle]),
    ((30,), "cost over eta with the coefficients fitted every time", [CandidateCost.rss, PoleSearch.joint,
        identify], [test_candidate_cost.test_the_cost_of_candidates_is_the_residual_of_the_fit,
        test_pole_search.test_paper_coordinates_can_be_chosen]),
    ((31,), "bounded global minimisation: DIRECT in all variants", [minimise],
        [test_pole_search.test_every_variant_of_direct_finds_the_lowest_of_many_minima]),
)  # fmt: skip


def test_every_equation_has_a_function_with_a_contract_and_a_test():
    assert [number for numbers, *_ in EQUATIONS for number in numbers] == list(range(1, 32))
    ranges = re.findall(
        r"(?<=_)(\d+)(?:_to_(\d+))?(?=_)", " ".join(name for name in globals() if name.startswith("test_"))
    )
    tested = {number for low, high in ranges for number in range(int(low), int(high or low) + 1)}
    for numbers, says, functions, elsewhere in EQUATIONS:
        assert all(function.__doc__ for function in functions), says
        assert elsewhere or tested.issuperset(numbers), says


def noise(seed: int, n: int = 400) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(n)


def test_2_zero_poles_are_the_fir_model():
    taps = np.array([0.5, -1.0, 0.25, 2.0, 0.125])
    model = GobfModel(Poles(np.zeros(5)), taps, DT_S)
    np.testing.assert_array_equal(model.simulate(np.eye(1, 12)[0]), [0, *taps, *np.zeros(6)])
    # The same numbers from the regression on delayed inputs, and cut off they miss what lies behind the cut.
    u = noise(1)
    y = model.simulate(u)
    np.testing.assert_allclose(arx(as_record(u, y), 0, 5).b, taps, atol=1e-12)
    slow = GobfModel(Poles([0.9]), np.ones(1), DT_S)
    y = slow.simulate(u)
    errors = [np.linalg.norm(arx(as_record(u, y), 0, n).simulate(u) - y) for n in (10, 20, 40)]
    # What is cut off of a decay 0.9^k shrinks by 0.9^10 and 0.9^20; the fit of the rest can only help.
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.2 * errors[1]


SOLUTIONS = {
    "paper (18)-(19)": oracles.paper_numerators,
    "rotated by 0.7": lambda pole: oracles.rotated_numerators(pole, 0.7),
    "rotated by 2.9": lambda pole: oracles.rotated_numerators(pole, 2.9),
    "Kautz": oracles.kautz_numerators,
}


def test_11_12_functions_follow_from_the_one_before():
    xi, z = MIXED.values, Z
    A, B = oracles.complex_realisation(MIXED)
    functions = np.array([np.linalg.solve(value * np.eye(xi.size) - A, B)[:, 0] for value in z])
    for i in range(1, xi.size):
        ratio = np.sqrt((1 - abs(xi[i]) ** 2) / (1 - abs(xi[i - 1]) ** 2))
        step = ratio * (1 - np.conj(xi[i - 1]) * z) / (z - xi[i])  # (11)
        np.testing.assert_allclose(functions[:, i], step * functions[:, i - 1], rtol=1e-10)
    for i in (3, 5):  # the pairs: their second function from the one before the pair
        ratio = np.sqrt((1 - abs(xi[i]) ** 2) / (1 - abs(xi[i - 1]) ** 2))
        denominator = z**2 - 2 * xi[i].real * z + abs(xi[i]) ** 2
        step = ratio * (1 - np.conj(xi[i - 1]) * z) * (1 - np.conj(xi[i]) * z) / denominator  # (12)
        np.testing.assert_allclose(functions[:, i + 1], step * functions[:, i - 1], rtol=1e-10)
    for i in (1, 2):  # and (11) among our own real functions
        ratio = np.sqrt((1 - xi[i].real ** 2) / (1 - xi[i - 1].real ** 2))
        ours = basis_response(MIXED, z)
        step = ratio * (1 - xi[i - 1].real * z) / (z - xi[i].real)
        np.testing.assert_allclose(ours[:, i], step * ours[:, i - 1], rtol=1e-12)


@pytest.mark.parametrize("first", SOLUTIONS)
@pytest.mark.parametrize("second", SOLUTIONS)
def test_13_to_19_every_solution_gives_the_same_fit_behind_other_poles(first, second):
    """Two real poles and two pairs, each pair by a solution of its own: the fit is that of the basis."""
    poles = Poles([0.4, -0.6], [0.9 * np.exp(0.3j), 0.97 * np.exp(1.2j)])
    u, y = noise(3), noise(4)
    ours = regressor(poles, u)
    expected = ours @ np.linalg.lstsq(ours, y)[0]
    # By scipy: each section behind the all-pass of those before it.
    columns, signal = [], u
    for a in poles.real:
        columns.append(scipy.signal.lfilter([0, 1], [1, -a], signal))
        signal = scipy.signal.lfilter([-a, 1], [1, -a], signal)
    for pole, name in zip(poles.pairs, (first, second), strict=True):
        denominator = np.array([1, -2 * pole.real, abs(pole) ** 2])
        columns += [
            scipy.signal.lfilter([0, m[0], m[1]], denominator, signal) for m in SOLUTIONS[name](complex(pole))
        ]
        signal = scipy.signal.lfilter(denominator[::-1], denominator, signal)
    theirs = np.column_stack(columns)
    np.testing.assert_allclose(theirs @ np.linalg.lstsq(theirs, y)[0], expected, atol=1e-9)


def test_21_output_is_linear_in_the_coefficients():
    u = noise(7)
    one, two = noise(8, 7), noise(9, 7)

    def output(theta):
        return GobfModel(MIXED, theta, DT_S).simulate(u)

    np.testing.assert_allclose(output(2 * one - 3 * two), 2 * output(one) - 3 * output(two), atol=1e-11)
    np.testing.assert_allclose(output(one), regressor(MIXED, u) @ one, atol=1e-12)


def test_28_29_filter_parameters_and_poles_correspond():
    space = search_space(1, 2, 1000, DT_S, IdentOptions(coordinates="raw"))
    assert space.names == ("x 1", "beta 1", "gamma 1", "beta 2", "gamma 2")
    rng, checked = np.random.default_rng(13), 0
    for _ in range(200):
        unit = rng.random(5)
        x, beta_1, gamma_1, beta_2, gamma_2 = space.coordinates(unit[None, :])[0]
        poles = space.poles(unit)
        assert np.all(np.abs(poles.values) < 1)
        assert poles.real[0] == pytest.approx(x, abs=1e-12)
        for pole, beta, gamma in zip(poles.pairs, (beta_1, beta_2), (gamma_1, gamma_2), strict=True):
            root = complex(np.roots([1, -beta * (1 + gamma), gamma])[0])
            # Two real poles, or nearly, are moved to a pair of damping 0.95.
            if root.imag != 0 and -np.log(root).real < 0.94 * abs(np.log(root)):
                checked += 1
                assert abs(pole) ** 2 == pytest.approx(gamma, rel=1e-9)
                assert 2 * pole.real / (1 + abs(pole) ** 2) == pytest.approx(beta, rel=1e-9, abs=1e-12)
    assert checked > 100
    gamma, beta = block_parameters(Poles([], [0.9 * np.exp(0.3j)]))[0, :2]
    assert gamma == pytest.approx(0.81)
    assert beta == pytest.approx(1.8 * np.cos(0.3) / 1.81)


def test_31_all_variants_of_nlopt_are_there():
    offered = {name for name in dir(nlopt) if name.startswith("GN_") and "DIRECT" in name}
    assert offered <= set(DIRECT)


def test_31_a_search_that_nlopt_breaks_off_keeps_what_it_found():
    """Noise-free, every box near the pole is worth dividing: the original DIRECT fills its tables."""
    pole, u = 0.8 * np.exp(0.9j), noise(17)
    y = scipy.signal.lfilter([0, 1.0, 0.5], [1, -2 * pole.real, abs(pole) ** 2], u)
    space = search_space(0, 1, 400, DT_S, IdentOptions(coordinates="raw"))
    cost = prepare([as_record(u, y)], Structure()).candidate_cost(space, Poles(), Poles())
    points, values = minimise(cost.log, 2, "GN_ORIG_DIRECT", 1500)
    beta, gamma = space.coordinates(points[np.argmin(values)][None, :])[0]
    assert beta == pytest.approx(2 * pole.real / (1 + abs(pole) ** 2), abs=0.02)
    assert gamma == pytest.approx(abs(pole) ** 2, abs=0.02)
