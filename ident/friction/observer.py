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

import numpy as np
from scipy.signal import sosfilt, zpk2sos

from ident.data.arrays import ComplexArray, RealArray
from ident.data.record import Record
from ident.friction.arm import SteppedArm
from ident.friction.gauss_newton import FrictionFit, LostError
from ident.friction.inverse_dynamics import noise_of

# Ratios of force to noise of the position that are tried first, in units of rms command per noise: from an
# observer slower than the arm to one of the last two samples. Chosen; eleven in five decades, factors of 3.2.
_RATIOS = np.geomspace(1e-5, 1, 11)
# Share of the force's variance that each state takes by itself, so that equal poles have a filter, too.
# Chosen: far above rounding, far below the force.
_OWN_SHARE = 1e-9
# Smallest weight of a state, as a share of the largest, by which states are scaled. Chosen: it only keeps a
# state that the force does not reach from a division by zero.
_SMALLEST_WEIGHT = 1e-12
# Doublings of the time over which a covariance is told, at most: 2^50 samples are longer than any arm's
# memory.
_MOST_DOUBLINGS = 50
# Change of the covariance in a doubling, as a share of it, at which it is steady. Rounding of doubles.
_STEADY = 1e-13
# An observer that has forgotten its start to this has settled. Chosen.
_FORGOTTEN = 1e-3
# Largest slowest pole of an observer for which the settling is computed: at 1 its logarithm is zero.
_SLOWEST_POLE = 1 - 1e-9
# Prediction errors count behind this part (one in so many) of a record, where the observer has found the
# state. Chosen.
_START = 20


def correction_of(arm: SteppedArm, coefficients: RealArray, ratio: float) -> ComplexArray:
    """Gain (N,) of the steady Kalman filter of an arm.

    Parameters
    ----------
    arm : SteppedArm
        Its N complex states; those of poles taken a second time are not corrected (0).
    coefficients : ndarray, shape (P,)
        Of the arm on its doubled poles.
    ratio : float
        Standard deviation of a white force at the input, beside white noise of unit variance on the position.

    Returns
    -------
    ndarray of complex, shape (N,)
        States per unit of prediction error of the position.

    Raises
    ------
    ValueError
        The Riccati equation has no solution.
    """
    a, b, c = _real_form(arm, coefficients)
    # States in units of what the force moves them by: the Riccati equation is solved accurately then.
    size = np.maximum(np.abs(b), _SMALLEST_WEIGHT * np.abs(b).max())
    a = a * (size / size[:, None])
    b = b / size
    c = c * size
    noise = ratio**2 * (np.outer(b, b) + _OWN_SHARE * np.eye(b.size))
    p = _steady_covariance(a, c, noise)
    gain = size * (p @ c) / (c @ p @ c + 1)

    # Real parts come first, then the imaginary parts of states that swing.
    first = ~arm.chain
    n_first = np.sum(first)
    correction = np.zeros(arm.rates.size, np.complex128)
    correction[first] = gain[:n_first]
    correction[first & arm.swings] += 1j * gain[n_first:]
    return correction


def _steady_covariance(a: RealArray, c: RealArray, noise: RealArray) -> RealArray:
    """Steady covariance P (M, M) of what a Kalman filter predicts of the states.

    Parameters
    ----------
    a : ndarray, shape (M, M)
        Transition of the states.
    c : ndarray, shape (M,)
        Of the states onto the measured position, whose noise has variance 1.
    noise : ndarray, shape (M, M)
        Covariance of what drives the states in a sample.

    Returns
    -------
    ndarray, shape (M, M)
        P = a (P - P c c' P / (c' P c + 1)) a' + noise.

    Raises
    ------
    ValueError
        The doublings do not end.

    Notes
    -----
    Structured doubling: after k rounds covariance and transition are those over 2^k samples (Chu, Fan, Lin
    and Wang, International Journal of Control 77(8), 2004). Near cancelling states, where an ordered Schur
    form has no finite solution, it still has one.
    """
    transition = a.T
    gain = np.outer(c, c)
    covariance = noise
    unit = np.eye(c.size)
    for _ in range(_MOST_DOUBLINGS):
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                solved = np.linalg.solve(unit + gain @ covariance, np.hstack([transition, gain]))
            except np.linalg.LinAlgError:
                break
            onward = solved[:, : c.size]
            added = transition.T @ covariance @ onward
            gain = gain + transition @ solved[:, c.size :] @ transition.T
            transition = transition @ onward
        if not np.all(np.isfinite(added)):
            break
        covariance = covariance + 0.5 * (added + added.T)
        if np.abs(added).max() <= _STEADY * np.abs(covariance).max():
            return covariance
    raise ValueError("no steady observer follows this arm")


def _real_form(arm: SteppedArm, coefficients: RealArray) -> tuple[RealArray, RealArray, RealArray]:
    """A (M, M), B (M,) and C (M,) of the sampled arm with each pole once and M real states.

    B is per unit of a force held over a sample; C gives the position in output units.
    """
    transition = arm.over(arm.dt_s)[:-1]
    out = arm.parts((arm.weights @ coefficients).conj())
    # The last column belongs to the held effort.
    a = transition[np.ix_(arm.once, np.append(arm.once, False))]
    b = transition[arm.once, -1]
    return a, b, out[arm.once]


@dataclass(frozen=True, eq=False)
class ObserverFilter:
    """Whitening filter H^-1 of y = G u + H e, where the observer of a fit predicts y.

    Attributes
    ----------
    sections : ndarray, shape (S, 6)
        Second-order sections.
    settled : int
        Samples after which the filter has forgotten its start.
    """

    sections: RealArray
    settled: int

    @classmethod
    def of(cls, fit: FrictionFit) -> ObserverFilter:
        """Whitening filter of a fit with an observer: zeros at the arm's poles, poles at the observer's."""
        assert fit.correction is not None
        arm = fit.arm
        a, _, c = _real_form(arm, fit.coefficients)
        gain = arm.parts(fit.correction)[arm.once]
        observer_poles = np.linalg.eigvals(a - np.outer(a @ gain, c)).astype(np.complex128)
        arm_poles = np.linalg.eigvals(a).astype(np.complex128)
        slowest = min(float(np.max(np.abs(observer_poles))), _SLOWEST_POLE)
        settled = int(np.ceil(np.log(_FORGOTTEN) / np.log(slowest)))
        sections = np.asarray(zpk2sos(arm_poles, observer_poles, 1.0))  # type: ignore[arg-type]
        return cls(sections, settled)

    def __call__(self, signal: RealArray) -> RealArray:
        """A signal (T, ...) through the filter, without the rows in which it settles, at most half."""
        filtered = sosfilt(self.sections, signal - signal[:1], axis=0)
        return np.asarray(filtered[min(self.settled, len(signal) // 2) :])

    def filtered(self, record: Record) -> Record:
        """A record with input and output through the filter, shorter by what settles, without reference."""
        return replace(
            record, input=self(record.input), output=self(record.output), reference=None, reference_names=()
        )


def command_per_noise(records: Sequence[Record]) -> float:
    """Rms command over the noise of the position, units of the input per output unit: a force that no command
    exceeds beside that noise is the largest `FrictionFit.ratio` which means anything."""
    noise = np.sqrt(np.mean([noise_of(record.output[:, 0]) ** 2 for record in records]))
    rms = np.sqrt(np.mean([np.mean(record.input**2) for record in records]))
    return float(rms / noise)


def observed(fit: FrictionFit, records: Sequence[Record]) -> FrictionFit:
    """A fit with the observer that predicts its records best, among some ratios of force to noise.

    Parameters
    ----------
    fit : FrictionFit
    records : sequence of Record

    Returns
    -------
    FrictionFit
        A start: the ratio is a parameter of the descent that follows (`ident.friction.descent`).

    Raises
    ------
    LostError
        No observer follows the records.
    """
    best = None
    least_errors = np.inf
    for ratio in _RATIOS * command_per_noise(records):
        with suppress(ValueError):
            correction = correction_of(fit.arm, fit.coefficients, float(ratio))
            candidate = replace(fit, correction=correction, ratio=float(ratio))
            errors = 0.0
            with np.errstate(over="ignore", invalid="ignore"):
                for record in records:
                    residual = candidate.residual(record)
                    errors += float(np.sum(residual[residual.size // _START :] ** 2))
            # The first one stands even where its errors are infinite: the fit may still step out of there.
            if best is None or errors < least_errors:
                best = candidate
                least_errors = errors if np.isfinite(errors) else np.inf
    if best is None:
        raise LostError
    return best
