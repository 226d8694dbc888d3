"""What the benchmarks on P1 measure, and the Cramer-Rao bounds of those measures, from SciPy alone.

Response error: RMS of |Ghat - G| / |G| over 400 log-spaced frequencies 0.1-600 rad/s, and over those of them
in 1-100 rad/s. NRMSE: |y - yhat| / |y - mean y| on a fresh noise-free sequence from rest. Mode found: a pole
pair, however damped, with natural frequency within a factor 2 of 15 rad/s.

Bounds: (J^T J)^-1 times the noise variance, J the derivative of the noise-free output by the parameters of
the true plant, here by complex steps through the matrix exponential (no code of the fits). A bound holds for
the root mean square over noise draws; what an efficient estimator would show as median and 90th percentile
is drawn from the Gaussian with that covariance, response and output linearised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy.linalg
import scipy.signal

from benchmarks.harness import timed
from ident.data.record import Record
from tests.ident.benchmark_plants import DT_S, Truth, max_length_sequence, p1, p1_friction, run
from validation.paper.methods import LinearModel, poles_of

GRID = np.geomspace(0.1, 600, 400)
MIDDLE = (GRID >= 1) & (GRID <= 100)
MODE_RAD_S = 15.0
_DRAWS = 20_000


@dataclass(frozen=True)
class Variant:
    """P1 itself or with friction: its records, its validation input, its slow poles s^2 + slow s."""

    name: str
    truth: Callable[[int], Truth]
    hold_samples: int
    slow_per_s: float

    def fresh_input(self) -> np.ndarray:
        return np.repeat(max_length_sequence(77, 1000 // self.hold_samples), self.hold_samples)


PLAIN = Variant("double integrator", p1, 1, 0.0)
FRICTION = Variant("friction", p1_friction, 4, 0.3)


@dataclass(frozen=True)
class Score:
    """One fit of one seed."""

    whole: float
    middle: float
    nrmse: float
    mode_found: bool
    cpu_s: float
    model: Any


def score(fit: Callable[[Record], LinearModel], variant: Variant, truths: Sequence[Truth]) -> list[Score]:
    """Fit every truth's record (after one warm-up fit)."""
    fit(truths[0].record)
    response, fresh = truths[0].response(GRID), variant.fresh_input()
    y = run(truths[0].system, fresh)
    scores = []
    for truth in truths:
        model, cpu_s = timed(partial(fit, truth.record))
        poles = poles_of(model)
        error = np.abs(model.frequency_response(GRID) / response - 1)
        natural = np.abs(np.log(poles[poles.imag > 0])) / DT_S
        scores.append(
            Score(
                float(np.sqrt(np.mean(error**2))),
                float(np.sqrt(np.mean(error[MIDDLE] ** 2))),
                float(np.linalg.norm(y - model.simulate(fresh)) / np.linalg.norm(y - y.mean())),
                bool(np.any((natural >= MODE_RAD_S / 2) & (natural <= MODE_RAD_S * 2))),
                cpu_s,
                model,
            )
        )
    return scores


HEADER = (
    f"{'':<44} error 0.1-600 rad/s    1-100 rad/s   validation NRMSE   mode   CPU ms\n"
    f"{'':<44}   median      90th  median   90th   median    90th   found  median"
)


def row(name: str, scores: Sequence[Score]) -> str:
    """One line under `HEADER`."""
    columns = [
        np.quantile([getattr(item, key) for item in scores], [0.5, 0.9])
        for key in ("whole", "middle", "nrmse")
    ]
    found = sum(item.mode_found for item in scores)
    cpu_ms = 1e3 * np.median([item.cpu_s for item in scores])
    return f"{name:<44} {_numbers(columns)}  {found:>3}/{len(scores):<3} {cpu_ms:>6.1f}"


def _numbers(columns: Sequence[np.ndarray]) -> str:
    (w1, w2), (m1, m2), (n1, n2) = columns
    # A model that diverges on the validation input has any number there.
    nrmse = " ".join(f"{n:>7.4f}" if n < 100 else f"{n:>7.0e}" for n in (n1, n2))
    return f"{w1:>8.3f} {w2:>9.3f}  {m1:>6.3f} {m2:>6.3f}  {nrmse}"


@dataclass(frozen=True, eq=False)
class Bound:
    """Cramer-Rao bounds (root mean squares) and the quantiles of an efficient estimator, for each measure."""

    name: str
    root_mean_squares: np.ndarray
    quantiles: list[np.ndarray]

    def rows(self) -> list[str]:
        w, m, n = self.root_mean_squares
        return [
            f"{'Cramer-Rao, ' + self.name + ': RMS':<44} {w:>8.3f} {'':>9}  {m:>6.3f} {'':>6}  {n:>7.4f}",
            f"{'    an efficient estimator would show':<44} {_numbers(self.quantiles)}",
        ]


def bounds(variant: Variant) -> list[Bound]:
    """Bounds for the structures that can be known of the variant, the weakest first."""
    slow = variant.slow_per_s
    mode = [1.0, 2 * 0.015 * MODE_RAD_S, MODE_RAD_S**2]
    numerator = MODE_RAD_S**2 * np.polymul([-1 / 10.8, 1], [1 / 10.5, 1])
    denominator = np.polymul([1.0, slow, 0.0], mode)
    _, B, C, _ = variant.truth(0).system
    gain = float((C @ B)[0, 0] / _sampled(numerator, denominator)[0][1])
    b, a = _sampled(gain * numerator, denominator)
    double = not slow
    structures: list[tuple[str, np.ndarray, Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]]] = [
        ("8 free numbers", np.concatenate([b[1:], a[1:]]), lambda x: (_with(0, x[:4]), _with(1, x[4:]))),
        (
            "relative degree 2",
            np.concatenate([gain * numerator, denominator[1:]]),
            lambda x: _sampled(x[:3], _with(1, x[3:])),
        ),
        (
            f"and {'two integrators' if double else 'one integrator'}",
            np.concatenate([gain * numerator, mode[1:] if double else denominator[1:-1]]),
            lambda x: _sampled(x[:3], np.concatenate([_with(1, x[3:]), np.zeros(2 if double else 1)])),
        ),
    ]
    truth = variant.truth(0)
    return [_bound(name, x, coefficients, truth, variant) for name, x, coefficients in structures]


def _bound(
    name: str,
    x: np.ndarray,
    coefficients: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    truth: Truth,
    variant: Variant,
) -> Bound:
    fresh, z = variant.fresh_input(), np.exp(1j * GRID * DT_S)
    validation = run(truth.system, fresh)
    response = truth.response(GRID)
    output, response_change, validation_change = [], [], []
    for i in range(x.size):
        step = 1e-30 * max(abs(x[i]), 1.0)
        moved = x.astype(np.complex128)
        moved[i] += 1j * step
        b, a = coefficients(moved)
        output.append(scipy.signal.lfilter(b, a, truth.record.input[:, 0]).imag / step)
        validation_change.append(scipy.signal.lfilter(b, a, fresh).imag / step)
        # Complex steps do not see through a complex function: quotient rule with their derivatives.
        db, da = b.imag / step, a.imag / step
        numerator, denominator = np.polyval(b.real, z), np.polyval(a.real, z)
        change = np.polyval(db, z) / denominator - numerator * np.polyval(da, z) / denominator**2
        response_change.append(change / response)
    jacobian = np.array(output).T
    lengths = np.linalg.norm(jacobian, axis=0)
    _, values, right = np.linalg.svd(jacobian / lengths, full_matrices=False)
    # Covariance = root root^T.
    root = truth.noise_std * (right.T / values) / lengths[:, None]
    relative = np.array(response_change).T @ root
    of_output = np.array(validation_change).T @ root / np.linalg.norm(validation - validation.mean())
    draws = np.random.default_rng(0).normal(size=(x.size, _DRAWS))
    power = np.abs(relative @ draws) ** 2
    measures = [
        np.sqrt(power.mean(axis=0)),
        np.sqrt(power[MIDDLE].mean(axis=0)),
        np.linalg.norm(of_output @ draws, axis=0),
    ]
    exact = np.sum(np.abs(relative) ** 2, axis=1)
    root_mean_squares = np.sqrt([exact.mean(), exact[MIDDLE].mean(), np.sum(of_output**2)])
    return Bound(name, root_mean_squares, [np.quantile(item, [0.5, 0.9]) for item in measures])


def _with(first: float, rest: np.ndarray) -> np.ndarray:
    return np.concatenate([[first], rest])


def _sampled(numerator: np.ndarray, denominator: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(b, a) in powers of q^-1, equally in z, of numerator / denominator (monic) behind a zero-order hold."""
    n = denominator.size - 1
    A = np.eye(n, k=1, dtype=np.result_type(numerator, denominator))
    A[-1] = -denominator[:0:-1]
    block = np.zeros((n + 1, n + 1), dtype=A.dtype)
    block[:n, :n] = A
    block[n - 1, n] = 1.0
    moved = scipy.linalg.expm(block * DT_S)
    Ad, Bd = moved[:n, :n], moved[:n, n]
    C = np.zeros(n, dtype=A.dtype)
    C[: numerator.size] = numerator[::-1]
    a = _characteristic(Ad)
    # b_1 .. b_n from the first n Markov parameters.
    markov, x = np.zeros(n + 1, dtype=A.dtype), Bd
    for k in range(1, n + 1):
        markov[k] = C @ x
        x = Ad @ x
    return np.convolve(markov, a)[: n + 1], a


def _characteristic(A: np.ndarray) -> np.ndarray:
    """Coefficients of det(z I - A), Faddeev-LeVerrier (np.poly goes through eigenvalues, which complex steps
    do not survive at multiple ones)."""
    n = A.shape[0]
    coefficients, M = [np.ones((), dtype=A.dtype)], np.eye(n, dtype=A.dtype)
    for k in range(1, n + 1):
        coefficients.append(-np.trace(A @ M) / k)
        M = A @ M + coefficients[-1] * np.eye(n)
    return np.array(coefficients)
