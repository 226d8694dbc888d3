"""Compiled rows and lanes against the plain recursion of the basis and against NumPy."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from ident.basis.functions import block_parameters, regressor
from ident.basis.poles import Poles
from ident.fit.lane_signals import cascade_states, combine, pitch_of, products, row_products, single_states
from ident.fit.lanes import WIDTH, load, shifted, splat, store, total

SETS = {
    "one real": Poles([0.9]),
    "mixed": Poles([0.7, -0.3], [0.95 * np.exp(0.4j), 0.999 * np.exp(0.02j)]),
    "more blocks than lanes": Poles(np.linspace(0.1, 0.99, 5), 0.97 * np.exp(1j * np.linspace(0.1, 3.0, 13))),
}


@numba.njit
def _all_operations(x, out):
    a, b = load(x, 0), load(x, WIDTH)
    store(out, 0, a + b)
    store(out, WIDTH, a - b)
    store(out, 2 * WIDTH, a * b)
    store(out, 3 * WIDTH, splat(2.5))
    store(out, 4 * WIDTH, shifted(a, -1.0))
    return total(a)


def test_lanes_calculate():
    x = np.random.default_rng(0).normal(size=2 * WIDTH)
    out = np.empty(5 * WIDTH)
    a, b = x[:WIDTH], x[WIDTH:]
    assert _all_operations(x, out) == pytest.approx(a.sum(), rel=1e-14)
    expected = np.concatenate([a + b, a - b, a * b, np.full(WIDTH, 2.5), [-1.0], a[:-1]])
    np.testing.assert_array_equal(out, expected)


@pytest.mark.parametrize("poles", SETS.values(), ids=SETS)
@pytest.mark.parametrize("span", [(0, 200), (37, 100), (5, 9)], ids=str)
def test_states_are_those_of_the_basis(poles, span):
    lo, hi = span
    u = np.random.default_rng(1).normal(size=203)
    pitch = pitch_of(u.size)
    assert pitch == 208
    expected = {
        cascade_states: regressor(poles, u[lo:hi]).T,
        single_states: np.concatenate(
            [regressor(Poles([a]), u[lo:hi]).T for a in poles.real]
            + [regressor(Poles([], [p]), u[lo:hi]).T for p in poles.pairs]
        ),
    }
    for function, states in expected.items():
        rows = np.zeros((poles.order + 1) * pitch)
        function(block_parameters(poles), poles.real.size, u, lo, hi, rows, 1, pitch)
        found = rows.reshape(-1, pitch)
        # Each block is lossless: rounding neither grows nor dies.
        np.testing.assert_allclose(found[1:, lo:hi], states, atol=1e-13)
        found[1:, lo:hi] = 0
        assert not found.any()


def test_products_and_combinations():
    rng = np.random.default_rng(2)
    rows, vector = np.zeros((12, 64)), np.zeros(64)
    rows[:, :61], vector[:61] = rng.normal(size=(12, 61)), rng.normal(size=61)
    gram = np.full((12, 12), np.nan)
    products(rows.ravel(), 64, 4, 12, gram)
    lower = np.tril(np.ones((12, 12), dtype=bool)) & (np.arange(12) >= 4)[:, None]
    np.testing.assert_allclose(gram[lower], (rows @ rows.T)[lower], atol=1e-13)
    along, target = np.empty(12), np.empty(64)
    row_products(rows.ravel(), 64, 12, vector, along)
    np.testing.assert_allclose(along, rows @ vector, atol=1e-13)
    combine(rows.ravel(), 64, 12, along, target)
    np.testing.assert_allclose(target, along @ rows, atol=1e-12)
