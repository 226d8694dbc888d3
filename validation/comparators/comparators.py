"""The methods the paper compares with (Figs. 3, 4, 6): ARX, ARMAX, OE, FIR and regularised FIR.

All of them take single-input single-output records of equal sampling time; offsets are not estimated, so
subtract means where a signal has one. `delay_samples` = 1 (the default) is a plant without direct term.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize_scalar

from ident.basis.structure import filter_input
from ident.data.arrays import RealArray
from ident.data.record import Record
from validation.comparators.polynomial_model import PolynomialModel
from validation.comparators.prediction_error import (
    Polynomials,
    Signals,
    arx_polynomials,
    minimise,
    monic,
    prediction_errors,
    shifted,
    steiglitz_mcbride,
)
from validation.comparators.stable_sections import stabilised

__all__ = ["PolynomialModel", "armax", "arx", "fir", "oe", "regularised_fir"]

_ONE = np.ones(1)


def arx(records: Record | Sequence[Record], na: int, nb: int, *, delay_samples: int = 1) -> PolynomialModel:
    """A y = B u + e by linear least squares: na coefficients in A, nb in B.

    The first max(na, nb - 1) samples of each record serve as past only. Biased when the noise is not 1/A
    filtered white noise. Raises ValueError for orders or records that cannot be used.
    """
    signals = _signals(records, delay_samples, {"na": (na, 0), "nb": (nb, 1)}, lost=max(na, nb - 1))
    a, b = arx_polynomials(signals, na, nb)
    return _model(records, delay_samples, Polynomials(a, b, _ONE, _ONE))


def oe(
    records: Record | Sequence[Record],
    nb: int,
    nf: int,
    *,
    delay_samples: int = 1,
    arx_start: bool = True,
) -> PolynomialModel:
    """y = (B / F) u + e by prediction-error minimisation: nb coefficients in B, nf in F, F stable.

    Best of the local searches from Steiglitz-McBride and, with `arx_start`, from ARX (slower, and hardly
    ever better); records start from rest. The minimum is local. Raises ValueError for orders or records that
    cannot be used.
    """
    signals = _signals(records, delay_samples, {"nb": (nb, 1), "nf": (nf, 0)}, lost=max(nf, nb - 1))
    starts = [steiglitz_mcbride(signals, nb, nf)]
    if arx_start:
        a, b = arx_polynomials(signals, nf, nb)
        starts.append(Polynomials(_ONE, b, _ONE, stabilised(a)))
    return _model(records, delay_samples, _best(starts, signals))


def armax(
    records: Record | Sequence[Record],
    na: int,
    nb: int,
    nc: int,
    *,
    delay_samples: int = 1,
    output_error_start: bool = True,
) -> PolynomialModel:
    """A y = B u + C e by prediction-error minimisation: na, nb, nc coefficients, C stable (A need not be).

    Best of the local searches from ARX, from two-stage least squares (innovations of a long ARX model as a
    second input) and, with `output_error_start`, from Steiglitz-McBride with C = A; records start from rest.
    The minimum is local: without the third start, which common toolboxes do not try, lightly damped modes
    under white output noise are usually missed. Raises ValueError for orders or records that cannot be used.
    """
    orders = {"na": (na, 0), "nb": (nb, 1), "nc": (nc, 0)}
    signals = _signals(records, delay_samples, orders, lost=max(na, nb - 1))
    a, b = arx_polynomials(signals, na, nb)
    starts = [Polynomials(a, b, monic(np.zeros(nc)), _ONE), _two_stage(signals, na, nb, nc)]
    if output_error_start:
        found = steiglitz_mcbride(signals, nb, na)
        c = np.zeros(nc + 1)
        shared = min(nc, na) + 1
        c[:shared] = found.f[:shared]
        starts.append(Polynomials(found.f, found.b, stabilised(c), _ONE))
    return _model(records, delay_samples, _best(starts, signals))


def fir(records: Record | Sequence[Record], n_taps: int, *, delay_samples: int = 1) -> PolynomialModel:
    """y = B u + e with n_taps coefficients by linear least squares, records from rest.

    Raises ValueError for orders or records that cannot be used.
    """
    signals = _signals(records, delay_samples, {"n_taps": (n_taps, 1)}, lost=0)
    regressor, y = _taps(signals, n_taps)
    taps = np.asarray(np.linalg.lstsq(regressor, y)[0], dtype=np.float64)
    return _model(records, delay_samples, Polynomials(_ONE, taps, _ONE, _ONE))


def regularised_fir(
    records: Record | Sequence[Record], n_taps: int, *, delay_samples: int = 1
) -> PolynomialModel:
    """FIR with a tuned-correlated prior on the taps, covariance alpha lam^max(i, j): the posterior mean.

    alpha, lam and the noise variance maximise the marginal likelihood (empirical Bayes; T. Chen, H. Ohlsson,
    L. Ljung, Automatica 48, 2012). Records from rest; n_taps may exceed the number of samples. Raises
    ValueError for orders or records that cannot be used.
    """
    signals = _signals(records, delay_samples, {"n_taps": (n_taps, 1)}, lost=None)
    regressor, y = _taps(signals, n_taps)
    if not np.any(y):
        return _model(records, delay_samples, Polynomials(_ONE, np.zeros(n_taps), _ONE, _ONE))
    q, r = np.linalg.qr(regressor)
    projected = q.T @ y
    unexplained = float(np.sum((y - q @ projected) ** 2))

    def evidence(log_time: float) -> tuple[float, RealArray]:
        return _tuned_taps(r, projected, unexplained, y.size, np.exp(-1 / np.exp(log_time)))

    # lam as a decay time in samples, from one sample to ten times the length of the response.
    times = np.linspace(0.0, np.log(10.0 * n_taps), 25)
    best = int(np.argmin([evidence(time)[0] for time in times]))
    bracket = times[max(best - 1, 0)], times[min(best + 1, times.size - 1)]
    found = minimize_scalar(lambda time: evidence(time)[0], bounds=bracket, method="bounded")
    return _model(records, delay_samples, Polynomials(_ONE, evidence(float(found.x))[1], _ONE, _ONE))


def _tuned_taps(
    r: RealArray, projected: RealArray, unexplained: float, n_samples: int, lam: float
) -> tuple[float, RealArray]:
    """-2 log marginal likelihood at the best alpha and noise variance for one lam, and the taps (L,)."""
    n_taps = r.shape[1]
    power = lam ** np.arange(1, n_taps + 1)
    # The kernel is that of a sum over j >= i of independent steps of these variances; no factorisation.
    steps = np.sqrt(np.append(power[:-1] * (1 - lam), power[-1]))
    left, values, right = np.linalg.svd(np.cumsum(r, axis=1) * steps, full_matrices=False)
    target = left.T @ projected
    # Rounding would make noise-free data infinitely likely at alpha -> infinity.
    floor = (
        unexplained + float(np.sum((projected - left @ target) ** 2)) + 1e-24 * float(projected @ projected)
    )

    def deviance(log_alpha: float) -> float:
        gain = 1 + np.exp(log_alpha) * values**2
        return float(n_samples * np.log(floor + np.sum(target**2 / gain)) + np.sum(np.log(gain)))

    middle = -2 * np.log(max(float(values[0]), 1e-100))
    grid = middle + np.linspace(-10, 60, 36)
    best = int(np.argmin([deviance(item) for item in grid]))
    bracket = grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]
    found = minimize_scalar(deviance, bounds=bracket, method="bounded")
    alpha = np.exp(float(found.x))
    shrunk = right.T @ (alpha * values / (1 + alpha * values**2) * target)
    return float(found.fun), np.cumsum((steps * shrunk)[::-1])[::-1]


def _two_stage(signals: Signals, na: int, nb: int, nc: int) -> Polynomials:
    """ARMAX start by least squares with the innovations of a long ARX model in place of e."""
    shortest = min(y.size for _, y in signals)
    long = max(na, nb, nc, min(4 * max(na, nb, nc, 1), (shortest - 1) // 3))
    a, b = arx_polynomials(signals, long, long)
    long_model = Polynomials(a, b, _ONE, _ONE)
    rows = []
    for u, y in signals:
        e = prediction_errors(long_model, [(u, y)])
        past = [-shifted(y, range(1, na + 1)), shifted(u, range(nb)), shifted(e, range(1, nc + 1))]
        rows.append(np.hstack(past)[long:])
    theta = np.linalg.lstsq(np.vstack(rows), np.concatenate([y[long:] for _, y in signals]))[0]
    a, b, c = np.split(theta, [na, na + nb])
    return Polynomials(monic(a), b, stabilised(monic(c)), _ONE)


def _best(starts: Sequence[Polynomials], signals: Signals) -> Polynomials:
    return min((minimise(start, signals) for start in starts), key=lambda found: found[1])[0]


def _taps(signals: Signals, n_taps: int) -> tuple[RealArray, RealArray]:
    return (
        np.vstack([shifted(u, range(n_taps)) for u, _ in signals]),
        np.concatenate([y for _, y in signals]),
    )


def _sequence(records: Record | Sequence[Record]) -> Sequence[Record]:
    return [records] if isinstance(records, Record) else records


def _signals(
    records: Record | Sequence[Record],
    delay_samples: int,
    orders: dict[str, tuple[int, int]],
    *,
    lost: int | None,
) -> Signals:
    """(delayed u, y) of each record; ValueError if orders (value, least) or records do not fit together.

    lost samples at the start of a record give no equation; None: fewer samples than unknowns will do.
    """
    for name, (value, least) in ({"delay_samples": (delay_samples, 0)} | orders).items():
        if not value >= least:
            raise ValueError(f"{name} must be at least {least}; got {value}")
    records = _sequence(records)
    if not records:
        raise ValueError("no record given; expected at least one")
    for record in records:
        if record.input.shape[1] != 1 or record.output.shape[1] != 1:
            raise ValueError(f"{record.label}: expected one input and one output; choose with siso(...)")
        if record.dt_s != records[0].dt_s:
            raise ValueError(f"{record.label}: dt_s is {record.dt_s}; expected {records[0].dt_s} as before")
    if lost is not None:
        unknowns = sum(value for value, _ in orders.values())
        equations = sum(max(record.n_samples - lost, 0) for record in records)
        if not equations > unknowns:
            raise ValueError(
                f"{records[0].label}: {equations} equations for {unknowns} unknowns; expected more samples"
            )
    return [(filter_input(item.input[:, 0], 0, delay_samples), item.output[:, 0]) for item in records]


def _model(records: Record | Sequence[Record], delay_samples: int, found: Polynomials) -> PolynomialModel:
    first = _sequence(records)[0]
    return PolynomialModel(
        found.a,
        found.b,
        found.c,
        found.f,
        delay_samples,
        first.dt_s,
        first.input_names[0],
        first.output_names[0],
    )
