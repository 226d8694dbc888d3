"""Hypotheses about a machine whose simulation is less accurate than its sensors.

Even the right effects leave something of a real machine over, of a size that is only roughly known, and it is
coloured: neighbouring samples, and passes of the same motion, repeat one error. If every sample counted, ever
more effects would be believed that merely follow it. Here N samples count as N / c independent values (c:
correlation length) with variance 1 + delta^2; delta is the model error, half-normal with the scale S that the
machine states. An unknown cause leaves more than S.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from diagnosis.fit.fit import Fit, log_evidence
from diagnosis.fit.nominal import prior_cost
from diagnosis.machine.machine_protocol import Real

# An unknown cause leaves from one to this many times what the machine's simulation may leave.
_UNKNOWN_REACH = 100.0


def log_evidence_with_model_error(fit: Fit) -> tuple[float, float]:
    """log evidence of exactly the fitted effects, and of them with something unknown besides."""
    allowed, n = fit.weighing.model_error, fit.residuals.size / fit.weighing.correlation_samples
    rss = _squares(fit)
    delta = _level(fit)
    exactly = _evidence(fit, delta) - 0.5 * n * np.log1p(delta**2) - 0.5 * (delta / allowed) ** 2
    delta = float(np.clip(np.sqrt(max(rss / n - 1, 0.0)), allowed, _UNKNOWN_REACH * allowed))
    # log-uniform size: width of the likelihood in log delta over the range (Laplace).
    width = 1 / np.sqrt(max(2 * n * (delta**2 / (1 + delta**2)) ** 2, 1.0))
    besides = _evidence(fit, delta) - 0.5 * n * np.log1p(delta**2)
    besides += np.log(width * np.sqrt(2 * np.pi) / np.log(_UNKNOWN_REACH))
    return float(exactly), float(besides)


def at_its_own_level(fit: Fit) -> Fit:
    """The fit with residuals weighed by the model error it shows, in place of the one allowed."""
    return _weighed(fit, _level(fit))


def _squares(fit: Fit) -> float:
    """Sum of squares of the independent values, in noise deviations."""
    return float(fit.residuals @ fit.residuals) * (1 + fit.weighing.model_error**2)


def _level(fit: Fit) -> float:
    """Most probable model error."""
    allowed, rss = fit.weighing.model_error, _squares(fit)
    n = fit.residuals.size / fit.weighing.correlation_samples

    def loss(delta: float) -> float:
        variance = 1 + delta**2
        return float(0.5 * n * np.log(variance) + 0.5 * rss / variance + 0.5 * (delta / allowed) ** 2)

    return float(minimize_scalar(loss, bounds=(0.0, 5 * allowed), method="bounded").x)


def _weighed(fit: Fit, delta: float) -> Fit:
    """The fit with the residuals' variance c (1 + delta^2)."""
    scale = np.sqrt((1 + delta**2) / (1 + fit.weighing.model_error**2))
    e = fit.residuals / scale
    cost = float(e @ e) + prior_cost(fit.deviations)
    return replace(fit, residuals=e, jacobian=fit.jacobian / scale, cost=cost)


def _evidence(fit: Fit, delta: float) -> float:
    """log evidence without the normalising constant of the residuals."""
    return log_evidence(_weighed(fit, delta))


def correlation_length(residuals: Real) -> float:
    """Samples per independent value of a series (T,): 1 + 2 (sum of its autocorrelation up to zero)."""
    e = residuals - np.mean(residuals)
    size = 1 << int(2 * e.size - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(e, size)) ** 2
    rho = np.fft.irfft(spectrum, size)[: e.size]
    if not rho[0] > 0:
        return 1.0
    rho = rho / rho[0]
    negative = np.flatnonzero(rho <= 0)
    return float(1 + 2 * np.sum(rho[1 : negative[0] if negative.size else rho.size]))
