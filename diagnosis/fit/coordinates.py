"""Coordinates of several candidates in a row: bounds, effects, difference quotients, intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from diagnosis.machine.machine_protocol import Real
from plant.effects.search_space import Candidate

# Draws of a Monte Carlo: quantiles of 2.5 % are then known to half a per cent, sqrt(0.025 / 1000).
MONTE_CARLO_DRAWS = 1000
# Share of a variance that tolerances must make up to be called what widens an interval: without this share
# the interval would be half as wide, sqrt(1 - 0.75).
_SHARE_THAT_WIDENS = 0.75
# Quantiles between which 95 % of the draws lie.
_INTERVAL_QUANTILES = (0.025, 0.975)


def bounds_of(candidates: Sequence[Candidate]) -> tuple[Real, Real]:
    """Lower and upper bounds (A,), (A,) of all coordinates in a row; empty without candidates."""
    boxes = [candidate.box for candidate in candidates]
    low = np.concatenate([np.zeros(0), *(box[0] for box in boxes)])
    high = np.concatenate([np.zeros(0), *(box[1] for box in boxes)])
    return low, high


def effects_at(candidates: Sequence[Candidate], x: Real) -> tuple[Any, ...]:
    """Effects, one for each candidate, at the coordinates x (A,) of all candidates in a row."""
    splits = np.cumsum([len(candidate.axes) for candidate in candidates])[:-1]
    coordinates = np.split(x, splits)
    return tuple(candidate.effect_at(part) for candidate, part in zip(candidates, coordinates, strict=False))


def non_smooth(candidates: Sequence[Candidate]) -> bool:
    """Whether contacts switch in any of the candidates."""
    return any(candidate.dependence == "non-smooth" for candidate in candidates)


def difference_quotients(
    function: Callable[[Real], Real],
    point: Real,
    value: Real,
    steps: Real,
    high: Real | float = np.inf,
) -> Real:
    """Derivatives of a function by difference quotients, one call a column.

    Parameters
    ----------
    function : callable
        (A,) -> (N,).
    point : (A,) array
        Where the derivatives are sought.
    value : (N,) array
        The function there.
    steps : (A,) array
        Above 0, in the units of the point.
    high : (A,) array or float
        A step that would go above it is taken backwards.

    Returns
    -------
    (N, A) array
        Of first order: the error is half the second derivative times the step.
    """
    derivatives = np.empty((value.size, point.size))
    signed_steps = np.where(point + steps <= high, steps, -steps)
    for i, step in enumerate(signed_steps):
        moved = point.copy()
        moved[i] += step
        derivatives[:, i] = (function(moved) - value) / step
    return derivatives


def solve_or_least_squares(matrix: Real, right: Real) -> Real:
    """x (M,) of matrix x = right; the smallest least-squares solution where the matrix (M, M) is singular.

    It becomes so where a trial ran away and everything else is lost in rounding. Raises
    `numpy.linalg.LinAlgError` where a number of the matrix is not finite.
    """
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0])


def widening_tolerance(inverse: Real, nominal: int, size: int, variance: float) -> int | None:
    """Which nominal value's tolerance makes the interval of an effect wide.

    Parameters
    ----------
    inverse : (M, M) array
        Covariance of the unknowns as far as the likelihood tells.
    nominal : int
        Number of nominal values, which come first among the unknowns.
    size : int
        Place of the effect's size among the unknowns.
    variance : float
        Of that size, from all sources.

    Returns
    -------
    int or None
        Place of the value that makes up most of the variance, if all of them together make up more than
        `_SHARE_THAT_WIDENS` of it; else None, as without nominal values.
    """
    if nominal == 0:
        return None
    covariances = inverse[size, :nominal]
    by_tolerances = covariances @ solve_or_least_squares(inverse[:nominal, :nominal], covariances)
    # Written so that a variance that is not a number is no reason either.
    if not by_tolerances > _SHARE_THAT_WIDENS * variance:
        return None
    return int(np.argmax(covariances**2 / np.diag(inverse)[:nominal]))


def parameter_intervals(
    candidate: Candidate, coordinates: Real, covariance: Real, rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    """95 % interval of every parameter of an effect, by Gaussian draws of its coordinates.

    Parameters
    ----------
    candidate : Candidate
        With A coordinates; draws are kept inside its bounds.
    coordinates : (A,) array
        Where the fit ended.
    covariance : (A, A) array
        Symmetric; negative eigenvalues, which only rounding makes, count as 0.
    rng : Generator
        Gives `MONTE_CARLO_DRAWS` draws.

    Returns
    -------
    dict
        Parameter -> (low, high) in its unit. An angle may leave its range, around the estimate.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = coordinates + rng.standard_normal((MONTE_CARLO_DRAWS, coordinates.size)) @ root.T
    drawn_parameters = [candidate.parameters(draw) for draw in np.clip(drawn, *candidate.box)]
    angles = {axis.parameter for axis in candidate.axes if axis.scale == "angle"}
    intervals = {}
    for name, estimate in candidate.parameters(coordinates).items():
        deviations = np.array([parameters[name] for parameters in drawn_parameters]) - estimate
        if name in angles:
            # The nearest turn: an angle just below the end of its range is near one just above its begin.
            deviations = np.mod(deviations + np.pi, 2 * np.pi) - np.pi
        below, above = np.quantile(deviations, _INTERVAL_QUANTILES)
        intervals[name] = (float(estimate + below), float(estimate + above))
    return intervals
