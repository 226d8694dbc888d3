"""One minimax step against linear programming (scipy) and against its own optimality conditions."""

import numpy as np
import pytest
from scipy.optimize import linprog

from control_design.synthesis.minimax_step import minimax_step


def _random(seed: int, rows: int = 120, n: int = 7):
    rng = np.random.default_rng(seed)
    value = 0.3 * rng.standard_normal(rows)
    slope = rng.standard_normal((rows, n)) * rng.lognormal(0, 1, (rows, 1))
    a = rng.standard_normal((2, n))
    return rng, value, slope, a, np.array([0.05, 0.0])


@pytest.mark.parametrize("seed", range(5))
def test_without_curvature_it_is_the_linear_programme(seed):
    _, value, slope, a, b = _random(seed)
    n = slope.shape[1]
    step = minimax_step(value, slope, np.zeros((n, n)), np.full(n, -0.3), np.full(n, 0.2), a, b)
    rows = np.column_stack([slope, -np.ones(value.size)])
    known = linprog(
        np.append(np.zeros(n), 1.0),
        A_ub=np.vstack([rows, np.column_stack([a, np.zeros(2)])]),
        b_ub=np.concatenate([-value, b]),
        bounds=[(-0.3, 0.2)] * n + [(None, None)],
    )
    # Stopped at a gap of 1e-8; a bound met exactly is moved by 1e-9.
    assert step.level == pytest.approx(known.fun, abs=1e-7)
    assert np.all(a @ step.step <= b + 1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_with_curvature_the_optimality_conditions_hold(seed):
    rng, value, slope, _, _ = _random(seed)
    n = slope.shape[1]
    root = rng.standard_normal((n, n))
    curvature = root @ root.T
    box = np.full(n, 50.0)  # inactive
    step = minimax_step(value, slope, curvature, -box, box, np.zeros((0, n)), np.zeros(0))
    assert np.all(step.multipliers >= 0)
    assert np.sum(step.multipliers) == pytest.approx(1.0)
    np.testing.assert_allclose(curvature @ step.step + step.multipliers @ slope, 0, atol=1e-4)
    slack = step.level - (value + slope @ step.step)
    assert np.max(slack * step.multipliers) < 1e-6


def test_no_step_where_the_side_conditions_exclude_each_other():
    _, value, slope, _, _ = _random(0)
    n = slope.shape[1]
    a = np.vstack([np.eye(n)[:1], -np.eye(n)[:1]])
    box = np.ones(n)
    assert minimax_step(value, slope, np.zeros((n, n)), -box, box, a, np.array([-0.5, -0.5])) is None
