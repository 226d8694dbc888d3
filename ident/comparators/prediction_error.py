"""Prediction-error minimisation for A y = (B / F) u + C e by Levenberg-Marquardt, and its starting points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import lfilter

from ident.comparators.polynomial_model import PolynomialModel
from ident.comparators.stable_sections import (
    LARGEST,
    from_sections,
    sections_derivative,
    stabilised,
    to_sections,
)
from ident.data.arrays import RealArray

_ONE = np.ones(1)
# Jacobians of a local search at most: a bound on its time, where the cost never stands still.
_ITERATIONS = 100
# Share of the cost by which a step has to lower it. Chosen: far below what noise leaves open (1/T), far above
# rounding.
_COST_TOLERANCE = 1e-8


def monic(tail: RealArray) -> RealArray:
    """[1, tail]."""
    return np.concatenate([np.ones(1), tail])


def shifted(signal: RealArray, lags: range) -> RealArray:
    """Columns signal(k - lag), zero before the record: (T,) -> (T, len(lags))."""
    columns = np.zeros((signal.size, len(lags)))
    for j, lag in enumerate(lags):
        columns[lag:, j] = signal[: max(signal.size - lag, 0)]
    return columns


def prediction_errors(model: PolynomialModel, u: RealArray, y: RealArray) -> RealArray:
    """e = C^-1 [A y - (B / F) u] (T,), from rest; u already delayed, as in every function here."""
    response = lfilter(model.b, np.convolve(model.f, model.c), u)
    return np.asarray(lfilter(model.a, model.c, y) - response)


def prediction_jacobian(model: PolynomialModel, u: RealArray, y: RealArray, errors: RealArray) -> RealArray:
    """de/dtheta (T, P): each block is one filtered signal and its shifts."""
    driven = lfilter(_ONE, np.convolve(model.f, model.c), u)
    return np.hstack(
        [
            shifted(lfilter(_ONE, model.c, y), range(1, model.a.size)),
            -shifted(driven, range(model.b.size)),
            -shifted(lfilter(_ONE, model.c, errors), range(1, model.c.size)),
            shifted(lfilter(model.b, model.f, driven), range(1, model.f.size)),
        ]
    )


def best_end(starts: Sequence[PolynomialModel], u: RealArray, y: RealArray) -> PolynomialModel:
    """Where the local search with the smallest cost ends."""
    return min((_minimise(start, u, y) for start in starts), key=lambda end: end[1])[0]


def _minimise(start: PolynomialModel, u: RealArray, y: RealArray) -> tuple[PolynomialModel, float]:
    """Local minimum of the sum of squared prediction errors from a start, over stable C and F.

    Levenberg-Marquardt in column-scaled coordinates (`ident.comparators.stable_sections` for C and F),
    with coordinates at a bound held there while the gradient points outwards: the fits of an integrator lie
    there, where a method that keeps inside its bounds crawls. Ends when the cost stands still, at the latest
    after 100 Jacobians. Returns the polynomials and their cost, never above that of the (stabilised) start.
    """
    ends = np.cumsum([start.a.size - 1, start.b.size, start.c.size - 1])

    def model_at(x: RealArray) -> PolynomialModel:
        a, b, c, f = np.split(x, ends)
        return PolynomialModel(monic(a), b, from_sections(c), from_sections(f))

    x = np.concatenate([start.a[1:], start.b, to_sections(start.c), to_sections(start.f)])
    bound = np.where(np.arange(x.size) < ends[1], np.inf, LARGEST)
    model = model_at(x)
    errors = prediction_errors(model, u, y)
    cost, damping = float(errors @ errors), 1e-3
    for _ in range(_ITERATIONS):
        _, _, c, f = np.split(x, ends)
        inner = block_diag(np.eye(ends[1]), sections_derivative(c), sections_derivative(f))
        jacobian = prediction_jacobian(model, u, y, errors) @ inner
        gradient = jacobian.T @ errors
        free = (np.abs(x) < bound) | (x * gradient > 0)
        scale = np.linalg.norm(jacobian, axis=0)
        scale[scale == 0] = 1.0
        q, r = np.linalg.qr((jacobian / scale)[:, free])
        left, values, right = np.linalg.svd(r)
        target = left.T @ (q.T @ errors)
        before = cost
        while damping < 1e8:
            step = np.zeros(x.size)
            step[free] = right.T @ (values / (values**2 + damping) * target)
            trial_x = np.clip(x - step / scale, -bound, bound)
            trial = model_at(trial_x)
            trial_errors = prediction_errors(trial, u, y)
            trial_cost = float(trial_errors @ trial_errors)
            if trial_cost < cost:
                x, model, errors, cost = trial_x, trial, trial_errors, trial_cost
                # Two poles near z = 1 leave singular values of 1e-6: with a larger least damping it crawls.
                damping = max(damping / 10, 1e-16)
                break
            damping *= 10
        if not before - cost > _COST_TOLERANCE * before:
            break
    return model, cost


def arx_polynomials(u: RealArray, y: RealArray, na: int, nb: int) -> tuple[RealArray, RealArray]:
    """Least-squares A (na + 1,), B (nb,) of A y = B u + e; samples with unrecorded past are left out."""
    first = max(na, nb - 1)
    columns = np.hstack([-shifted(y, range(1, na + 1)), shifted(u, range(nb))])
    theta = np.asarray(np.linalg.lstsq(columns[first:], y[first:])[0], dtype=np.float64)
    return monic(theta[:na]), theta[na:]


def steiglitz_mcbride(u: RealArray, y: RealArray, nb: int, nf: int, iterations: int = 20) -> PolynomialModel:
    """Output-error polynomials by repeated ARX on signals filtered with 1 / F of the step before (best one).

    L. Ljung, System Identification, 2nd ed., section 10.4; F is reflected into the circle at every step.
    """
    f, least = _ONE, np.inf
    best = PolynomialModel(_ONE, np.zeros(nb), _ONE, monic(np.zeros(nf)))
    for _ in range(iterations):
        a, b = arx_polynomials(lfilter(_ONE, f, u), lfilter(_ONE, f, y), nf, nb)
        f = stabilised(a)
        model = PolynomialModel(_ONE, b, _ONE, f)
        errors = prediction_errors(model, u, y)
        cost = float(errors @ errors)
        if cost < least:
            best, least = model, cost
    return best
