"""Equations (7)-(19): every solution (x1, x2) is a valid real pair, and all give the same fit."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from ident.basis.functions import basis_response, regressor
from ident.basis.poles import Poles
from tests.ident.paper_oracles import (
    kautz_numerators,
    pair_metric,
    pair_response,
    paper_numerators,
    rotated_numerators,
)

POLES = [0.9 * np.exp(0.3j), 0.99 * np.exp(2.5j), 0.3 * np.exp(1.0j), 0.999 * np.exp(0.05j)]
SOLUTIONS = {
    "paper (18)-(19)": paper_numerators,
    "rotated by 0.7": lambda pole: rotated_numerators(pole, 0.7),
    "rotated by 2.9": lambda pole: rotated_numerators(pole, 2.9),
    "Kautz": kautz_numerators,
}


@pytest.mark.parametrize("pole", POLES)
@pytest.mark.parametrize("solution", SOLUTIONS)
def test_solutions_satisfy_the_constraints(pole, solution):
    x1, x2 = SOLUTIONS[solution](pole)
    metric, target = pair_metric(pole), abs(1 - pole**2) ** 2
    assert x1 @ metric @ x1 == pytest.approx(target, rel=1e-10)  # (14)
    assert x2 @ metric @ x2 == pytest.approx(target, rel=1e-10)
    assert abs(x1 @ metric @ x2) <= 1e-10 * target  # (15)


@pytest.mark.parametrize("solution", SOLUTIONS)
def test_constraints_make_the_pair_orthonormal(solution):
    pole = 0.9 * np.exp(0.3j)
    circle = np.exp(2j * np.pi * np.arange(4096) / 4096)
    values = pair_response(pole, *SOLUTIONS[solution](pole), circle)
    np.testing.assert_allclose(values.conj().T @ values / 4096, np.eye(2), atol=1e-12)


def test_kautz_solution_is_the_basis():
    pole, z = 0.9 * np.exp(0.3j), np.exp(1j * np.linspace(0, 3, 20))
    np.testing.assert_allclose(
        pair_response(pole, *kautz_numerators(pole), z), basis_response(Poles([], [pole]), z), rtol=1e-11
    )


@pytest.mark.parametrize("solution", SOLUTIONS)
def test_every_solution_gives_the_same_fit(solution):
    rng = np.random.default_rng(5)
    u, y, pole = rng.normal(size=300), rng.normal(size=300), complex(0.9 * np.exp(0.3j))
    denominator = [1, -2 * pole.real, abs(pole) ** 2]
    ours = regressor(Poles([], [pole]), u)
    expected = ours @ np.linalg.lstsq(ours, y, rcond=None)[0]
    columns = np.column_stack(
        [scipy.signal.lfilter([0, m[0], m[1]], denominator, u) for m in SOLUTIONS[solution](pole)]
    )
    np.testing.assert_allclose(columns @ np.linalg.lstsq(columns, y, rcond=None)[0], expected, atol=1e-10)


def test_wrong_numerators_are_refused():
    with pytest.raises(ValueError, match="do not satisfy"):
        pair_response(0.5j, np.array([1.0, 0.0]), np.array([1.0, 0.0]), np.array([1.0 + 0j]))
