"""Smallest worst ratio and one step to it: known answers, linear programming, optimality conditions."""

import numpy as np
import pytest
from scipy.optimize import linprog

from control_design.convex.minimax import PlaneRows, plane, smallest_ratio
from control_design.synthesis.minimax_step import minimax_step
from ident.data.arrays import factor_matrices


def _rows(at, factor, offset, level, slope=None, reach=None):
    size = at.size
    return PlaneRows(
        at,
        factor_matrices(np.asarray(factor, complex)),
        plane(np.asarray(offset, complex)),
        np.asarray(level, float),
        np.zeros((size, 2)) if slope is None else slope,
        np.zeros((size, 2, 2)) if reach is None else reach,
        np.zeros((size, 2)),
    )


def test_smallest_circle_around_points():
    # Equilateral triangle and points inside: centre and radius are the triangle's.
    corners = 2 + 1j + 3 * np.exp(2j * np.pi * np.arange(3) / 3)
    points = np.concatenate([corners, [2 + 1.5j, 1 + 1j]])
    basis = np.array([[1.0 + 0j, 1j]])
    rows = _rows(np.zeros(5, int), np.ones(5), -points, np.ones(5))
    point = smallest_ratio(basis, rows)
    np.testing.assert_allclose(point.x, [2.0, 1.0], atol=1e-4)
    assert point.gamma == pytest.approx(3.0, rel=2e-5)


def test_real_ratio_agrees_with_bisection_over_linear_programmes():
    rng = np.random.default_rng(0)
    size, n = 40, 5
    a, b = rng.standard_normal((size, n)), rng.standard_normal(size)
    e, slope = 1 + rng.uniform(size=size), 0.2 * rng.standard_normal((size, n))
    # Real numerators by a real basis per row; the slope acts on the imaginary part, which carries slope x.
    basis = a + 1j * slope
    keep_real = np.zeros((size, 2, 2))
    keep_real[:, 0, 0] = 1.0
    right, none = np.tile([0.0, 1.0], (size, 1)), np.zeros((size, 2))
    rows = PlaneRows(np.arange(size), keep_real, plane(b + 0j), e, right, 0 * keep_real, none)
    got = smallest_ratio(basis, rows).gamma
    low, high = 0.0, 10.0
    for _ in range(40):
        mid = 0.5 * (low + high)
        matrix = np.vstack([a - mid * slope, -a - mid * slope])
        answer = linprog(
            np.zeros(n), A_ub=matrix, b_ub=np.concatenate([mid * e - b, mid * e + b]), bounds=(None, None)
        )
        low, high = (low, mid) if answer.status == 0 else (mid, high)
    assert got == pytest.approx(high, rel=5e-5)


def test_reach_makes_a_norm_constraint():
    # |y - 1| <= gamma (1 - |y|) for real y: worst at y = 0 is 1, at y = 1/2 also 1; every y in [0, 1) gives
    # (1 - y)/(1 - y) = 1, and outside it is more.
    rows = _rows(np.zeros(1, int), [1.0], [-1.0], [1.0], reach=np.eye(2)[None])
    point = smallest_ratio(np.array([[1.0 + 0j]]), rows)
    assert point.gamma == pytest.approx(1.0, rel=1e-6)


def test_denominators_that_start_negative_are_made_positive_first():
    # m = 1 - |y - 3| and 1.5 - |y - 3.4 - 0.5j| are both positive near 3 only, the numerator is |y - 1.5|.
    eyes, at = np.tile(np.eye(2), (2, 1, 1)), np.array([[-3.0, 0.0], [-3.4, -0.5]])
    level, zero = np.array([1.0, 1.5]), np.zeros((2, 2))
    rows = PlaneRows(np.zeros(2, int), eyes, np.array([[-1.5, 0.0]] * 2), level, zero, eyes, at)
    point = smallest_ratio(np.array([[1.0 + 0j, 1j]]), rows, np.array([0.0, 0.0]))
    y = np.linspace(2, 4, 801)[:, None] + 1j * np.linspace(-0.5, 0.5, 401)
    m = np.minimum(1 - np.abs(y - 3), 1.5 - np.abs(y - 3.4 - 0.5j))
    scanned = np.min((np.abs(y - 1.5) / np.where(m > 0, m, 1.0))[m > 0])
    # The scan steps by 2.5e-3 over a kinked minimum: up to 1e-3 too high.
    assert scanned * (1 - 1e-3) <= point.gamma <= scanned


def test_denominator_that_cannot_be_positive_is_said():
    rows = _rows(np.zeros(1, int), [1.0], [-1.0], [-1.0], reach=np.eye(2)[None])
    assert smallest_ratio(np.array([[1.0 + 0j]]), rows).gamma == np.inf


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


def test_a_step_that_rounding_spoils_is_none(monkeypatch):
    """A start that runs away has rows of 1e8, whose normal equations are singular to rounding: it ends
    itself, not the design. By a stand-in, as which rows do so depends on the order of the sums."""

    def singular(*_):
        raise np.linalg.LinAlgError

    monkeypatch.setattr("control_design.synthesis.minimax_step._interior_point", singular)
    none = np.zeros((0, 2))
    assert (
        minimax_step(np.ones(1), np.ones((1, 2)), np.eye(2), -np.ones(2), np.ones(2), none, none[:, 0])
        is None
    )
