"""An observer that follows the log of an arm with friction, and what it makes of signals of the arm.

At every sample the states of the simulated arm are corrected by what the measured position is off the
predicted one: a steady Kalman filter (Anderson and Moore, Optimal Filtering, section 4.4) for a white force
at the input, as large as makes prediction errors least, beside white noise of the position. A linear arm's
prediction errors are H^-1 (y - G u): the whitening filter of everything fitted behind the friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.signal import sosfilt, zpk2sos

from ident.data.arrays import ComplexArray, RealArray
from ident.data.record import Record
from ident.friction.arm import SteppedArm
from ident.friction.gauss_newton import FrictionFit, LostError
from ident.friction.inverse_dynamics import noise_of

# Force over the position's noise: from an observer slower than the arm to one of the last two samples.
_RATIOS = np.geomspace(1e-4, 10, 11)
NEARBY = np.array([0.5, 1.0, 2.0])
# Share of the force that each state takes by itself, so that equal poles have a filter, too.
_OWN = 1e-9
# An observer that has forgotten its start to this has settled.
_FORGOTTEN = 1e-3
# Prediction errors count behind this part of a record, where the observer has found the state.
_START = 20


def correction_of(arm: SteppedArm, coefficients: RealArray, ratio: float) -> ComplexArray:
    """(N,) gain of the steady Kalman filter for white noise of unit variance on the position and a white
    force of standard deviation `ratio` at the input. Raises ValueError or LinAlgError where there is none."""
    a, b, c = _real_form(arm, coefficients)
    size = np.maximum(np.abs(b), 1e-12 * np.abs(b).max())
    a, b, c = a * (size / size[:, None]), b / size, c * size
    noise = ratio**2 * (np.outer(b, b) + _OWN * np.eye(b.size))
    p = solve_discrete_are(a.T, c[:, None], noise, np.ones((1, 1)))
    gain, found = size * (p @ c) / (c @ p @ c + 1), np.zeros(arm.rates.size, np.complex128)
    found[~arm.chain] = gain[: np.sum(~arm.chain)]
    found[~arm.chain & (arm.rates.imag != 0)] += 1j * gain[np.sum(~arm.chain) :]
    return found


def _real_form(arm: SteppedArm, coefficients: RealArray) -> tuple[RealArray, RealArray, RealArray]:
    """A, B, C of the sampled arm with each pole once and real states."""
    whole, out = arm.over(arm.dt_s)[:-1], arm.parts((arm.weights @ coefficients).conj())
    return whole[np.ix_(arm.once, np.append(arm.once, False))], whole[arm.once, -1], out[arm.once]


@dataclass(frozen=True, eq=False)
class ObserverFilter:
    """H^-1 of y = G u + H e in second-order sections, and samples after which it has forgotten its start."""

    sections: RealArray
    settled: int

    @classmethod
    def of(cls, found: FrictionFit) -> ObserverFilter:
        """That of a fit with an observer."""
        assert found.correction is not None
        arm = found.arm
        a, _, c = _real_form(arm, found.coefficients)
        gain = arm.parts(found.correction)[arm.once]
        inner = np.linalg.eigvals(a - np.outer(a @ gain, c)).astype(np.complex128)
        zeros = np.linalg.eigvals(a).astype(np.complex128)
        slowest = min(float(np.max(np.abs(inner))), 1 - 1e-9)
        return cls(np.asarray(zpk2sos(zeros, inner, 1.0)), int(np.ceil(np.log(_FORGOTTEN) / np.log(slowest))))  # type: ignore[arg-type]

    def __call__(self, signal: RealArray) -> RealArray:
        """A signal of the position (T, ...) through the filter, without the rows in which it settles, at most
        half."""
        filtered = sosfilt(self.sections, signal - signal[:1], axis=0)
        return np.asarray(filtered[min(self.settled, len(signal) // 2) :])

    def filtered(self, record: Record) -> Record:
        """Input and output through the filter."""
        return replace(
            record, input=self(record.input), output=self(record.output), reference=None, reference_names=()
        )


@lru_cache(maxsize=64)
def prediction_errors(found: FrictionFit, records: tuple[Record, ...]) -> float:
    """Sum of squares of the prediction errors, without the start of each record; infinite where it is
    lost."""
    with np.errstate(over="ignore", invalid="ignore"):
        parts = [found.residual(record) for record in records]
        total = sum(float(np.sum(part[part.size // _START :] ** 2)) for part in parts)
    return total if np.isfinite(total) else np.inf


def observed(found: FrictionFit, records: Sequence[Record], nearby: RealArray = NEARBY) -> FrictionFit:
    """The fit with the observer that predicts best, near the one it has: nearby, its force as a share of that
    one's. Raises LostError where none follows."""
    noise = np.sqrt(np.mean([noise_of(record.output[:, 0]) ** 2 for record in records]))
    rms = np.sqrt(np.mean([np.mean(record.input**2) for record in records]))
    tried = list[tuple[float, FrictionFit]]()
    for ratio in _RATIOS * rms / noise if found.correction is None else found.ratio * nearby:
        with suppress(ValueError, np.linalg.LinAlgError):
            correction = correction_of(found.arm, found.coefficients, float(ratio))
            one = replace(found, correction=correction, ratio=float(ratio))
            tried.append((prediction_errors(one, tuple(records)), one))
    if not tried:
        raise LostError
    return min(tried, key=lambda one: one[0])[1]
