"""Prediction-error minimisation for A y = (B / F) u + C e by Levenberg-Marquardt, and its starting points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import lfilter

from ident.data.arrays import RealArray
from validation.comparators.stable_sections import (
    LARGEST,
    from_sections,
    sections_derivative,
    stabilised,
    to_sections,
)

_ITERATIONS = 100
_COST_TOLERANCE = 1e-8

Signals = Sequence[tuple[RealArray, RealArray]]
"""(u, y) of each record, (T,) each; u already delayed."""


@dataclass(frozen=True, eq=False)
class Polynomials:
    """Coefficients of q^0, q^-1, ... of A, B, C and F; A, C, F begin with 1."""

    a: RealArray
    b: RealArray
    c: RealArray
    f: RealArray


def monic(tail: RealArray) -> RealArray:
    """[1, tail]."""
    return np.concatenate([np.ones(1), tail])


def shifted(signal: RealArray, lags: range) -> RealArray:
    """Columns signal(k - lag), zero before the record: (T,) -> (T, len(lags))."""
    columns = np.zeros((signal.size, len(lags)))
    for j, lag in enumerate(lags):
        columns[lag:, j] = signal[: max(signal.size - lag, 0)]
    return columns


def prediction_errors(model: Polynomials, signals: Signals) -> RealArray:
    """e = C^-1 [A y - (B / F) u] of all records one after the other, each from rest."""
    parts = [lfilter(model.a, model.c, y) - _response(model, u) for u, y in signals]
    return np.concatenate(parts)


def _response(model: Polynomials, u: RealArray) -> RealArray:
    return np.asarray(lfilter(model.b, np.convolve(model.f, model.c), u))


def prediction_jacobian(model: Polynomials, signals: Signals, errors: RealArray) -> RealArray:
    """de/dtheta (N, P): each block is one filtered signal and its shifts."""
    one = np.ones(1)
    blocks, start = [], 0
    for u, y in signals:
        e = errors[start : start + y.size]
        start += y.size
        columns = []
        if model.a.size > 1:
            columns.append(shifted(lfilter(one, model.c, y), range(1, model.a.size)))
        driven = lfilter(one, np.convolve(model.f, model.c), u)
        columns.append(-shifted(driven, range(model.b.size)))
        if model.c.size > 1:
            columns.append(-shifted(lfilter(one, model.c, e), range(1, model.c.size)))
        if model.f.size > 1:
            columns.append(shifted(lfilter(model.b, model.f, driven), range(1, model.f.size)))
        blocks.append(np.hstack(columns))
    return np.vstack(blocks)


def minimise(start: Polynomials, signals: Signals) -> tuple[Polynomials, float]:
    """Local minimum of the sum of squared prediction errors from a start, over stable C and F.

    Levenberg-Marquardt in column-scaled coordinates (`validation.comparators.stable_sections` for C and F),
    with coordinates at a bound held there while the gradient points outwards. Ends when the cost stands
    still, at the latest after 100 Jacobians. Returns the polynomials and their cost, never above that of the
    (stabilised) start.
    """
    place = _Coordinates.of(start)
    x = place.from_polynomials(start)
    model = place.polynomials(x)
    errors = prediction_errors(model, signals)
    cost, damping = float(errors @ errors), 1e-3
    for _ in range(_ITERATIONS):
        jacobian = prediction_jacobian(model, signals, errors) @ place.derivative(x)
        gradient = jacobian.T @ errors
        free = (np.abs(x) < place.bound) | (x * gradient > 0)
        scale = np.linalg.norm(jacobian, axis=0)
        scale[scale == 0] = 1.0
        q, r = np.linalg.qr((jacobian / scale)[:, free])
        left, values, right = np.linalg.svd(r)
        target = left.T @ (q.T @ errors)
        before = cost
        while damping < 1e8:
            step = np.zeros(x.size)
            step[free] = right.T @ (values / (values**2 + damping) * target)
            trial_x = np.clip(x - step / scale, -place.bound, place.bound)
            trial = place.polynomials(trial_x)
            trial_errors = prediction_errors(trial, signals)
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


@dataclass(frozen=True, eq=False)
class _Coordinates:
    """Unconstrained A and B, and C and F by their sections: x (P,) with |x| <= bound (P,)."""

    na: int
    nb: int
    nc: int
    nf: int

    @classmethod
    def of(cls, model: Polynomials) -> _Coordinates:
        return cls(model.a.size - 1, model.b.size, model.c.size - 1, model.f.size - 1)

    @property
    def bound(self) -> RealArray:
        return np.concatenate([np.full(self.na + self.nb, np.inf), np.full(self.nc + self.nf, LARGEST)])

    def from_polynomials(self, model: Polynomials) -> RealArray:
        return np.concatenate([model.a[1:], model.b, to_sections(model.c), to_sections(model.f)])

    def _parts(self, x: RealArray) -> list[RealArray]:
        return np.split(x, np.cumsum([self.na, self.nb, self.nc]))

    def polynomials(self, x: RealArray) -> Polynomials:
        a, b, c, f = self._parts(x)
        return Polynomials(monic(a), b, from_sections(c), from_sections(f))

    def derivative(self, x: RealArray) -> RealArray:
        """d(free coefficients)/dx (P, P)."""
        _, _, c, f = self._parts(x)
        return np.asarray(
            block_diag(np.eye(self.na + self.nb), sections_derivative(c), sections_derivative(f))
        )


def arx_polynomials(signals: Signals, na: int, nb: int) -> tuple[RealArray, RealArray]:
    """Least-squares A (na + 1,), B (nb,) of A y = B u + e; samples with unrecorded past are left out."""
    first = max(na, nb - 1)
    rows = [np.hstack([-shifted(y, range(1, na + 1)), shifted(u, range(nb))])[first:] for u, y in signals]
    theta = np.linalg.lstsq(np.vstack(rows), np.concatenate([y[first:] for _, y in signals]))[0]
    return monic(theta[:na]), theta[na:]


def steiglitz_mcbride(signals: Signals, nb: int, nf: int, iterations: int = 20) -> Polynomials:
    """Output-error polynomials by repeated ARX on signals filtered with 1 / F of the step before (best one).

    L. Ljung, System Identification, 2nd ed., section 10.4; F is reflected into the circle at every step.
    """
    one = np.ones(1)
    f = one
    best, least = Polynomials(one, np.zeros(nb), one, monic(np.zeros(nf))), np.inf
    for _ in range(iterations):
        filtered = [(lfilter(one, f, u), lfilter(one, f, y)) for u, y in signals]
        a, b = arx_polynomials(filtered, nf, nb)
        f = stabilised(a)
        model = Polynomials(one, b, one, f)
        errors = prediction_errors(model, signals)
        cost = float(errors @ errors)
        if cost < least:
            best, least = model, cost
    return best
