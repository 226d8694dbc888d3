"""Coordinates of candidates in a row: bounds, effects, difference quotients, intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from diagnosis.machine.machine_protocol import Real
from plant.effects.search_space import Candidate

# Of every Monte Carlo: quantiles of 2.5 % are then known to half a per cent.
MONTE_CARLO_DRAWS = 1000


def bounds_of(candidates: Sequence[Candidate]) -> tuple[Real, Real]:
    """Bounds (A,), (A,) of all coordinates in a row."""
    boxes = [candidate.box for candidate in candidates]
    low = np.concatenate([np.zeros(0), *(bounds[0] for bounds in boxes)])
    return low, np.concatenate([np.zeros(0), *(bounds[1] for bounds in boxes)])


def effects_at(candidates: Sequence[Candidate], x: Real) -> tuple[Any, ...]:
    """Effects at the coordinates of all candidates in a row (A,)."""
    splits = np.cumsum([len(c.axes) for c in candidates])[:-1]
    return tuple(c.effect_at(part) for c, part in zip(candidates, np.split(x, splits), strict=False))


def non_smooth(candidates: Sequence[Candidate]) -> bool:
    """Whether contacts switch in any of these."""
    return any(c.dependence == "non-smooth" for c in candidates)


def difference_quotients(
    function: Callable[[Real], Real], at: Real, start: Real, steps: Real, high: Real | float = np.inf
) -> Real:
    """Derivatives (N, A) at a point (A,) of a function (A,) -> (N,) that is `start` there.

    Difference quotients, forwards by steps (A,) where that stays below `high`, else backwards.
    """
    J = np.empty((start.size, at.size))
    for i, step in enumerate(np.where(at + steps <= high, steps, -steps)):
        moved = at.copy()
        moved[i] += step
        J[:, i] = (function(moved) - start) / step
    return J


def solve_or_least_squares(matrix: Real, right: Real) -> Real:
    """x of matrix x = right, the smallest where trials that ran away leave the matrix singular."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0])


# Of the variance: without this share the interval would be half as wide.
_MOST = 0.75


def widening_tolerance(inverse: Real, nominal: int, size: int, variance: float) -> int | None:
    """Where the tolerances of the first `nominal` unknowns make up most of the variance of unknown `size`:
    the one that makes up most of it; else None. inverse (M, M): covariance of the unknowns as far as the
    likelihood tells; variance: of that unknown, from all sources."""
    with_them = inverse[size, :nominal]
    together = with_them @ solve_or_least_squares(inverse[:nominal, :nominal], with_them)
    if not nominal or not together > _MOST * variance:
        return None
    return int(np.argmax(with_them**2 / np.diag(inverse)[:nominal]))


def parameter_intervals(
    candidate: Candidate, coordinates: Real, covariance: Real, rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    """95 % intervals by Gaussian draws of the coordinates (A,), kept inside their box; covariance (A, A)."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    moved = coordinates + rng.standard_normal((MONTE_CARLO_DRAWS, coordinates.size)) @ root.T
    sampled = [candidate.parameters(draw) for draw in np.clip(moved, *candidate.box)]
    found = {}
    for key, value in candidate.parameters(coordinates).items():
        spread = np.array([p[key] for p in sampled]) - value
        if key == "phase_rad":
            spread = np.mod(spread + np.pi, 2 * np.pi) - np.pi
        below, above = np.quantile(spread, [0.025, 0.975])
        found[key] = (float(value + below), float(value + above))
    return found
