"""The nominal machine of a workshop case: linear, fast, fitted to records in its stated values.

States what a case's answer says about sizes: how much of a gap the stated values can imitate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.signal import lfilter

from validation.blind.rigs import Rig
from validation.blind.truth import Background, Real, Truth, state_matrix

# Share of the motion that a sample is weighted by, beside its noise: what a model misses is no noise.
_SHARE = 0.05
# Samples of what a model misses that tell no more than one, so that tolerances still count.
_PER_ONE = 25.0
# Tolerances beyond which no value is believed.
_FARTHEST = 4.0
# Step of the differences by which the fit finds its slopes, in deviations of the parameters.
_STEP = 1e-4
# Relative change of the cost at which the fit ends.
_ENOUGH = 1e-3
# Evaluations of the fit at most.
_MOST = 15


@dataclass(frozen=True, eq=False)
class Log:
    """A record as the fit sees it: voltage (B + T,), B rows of it before the first, and outputs (T, n)."""

    voltage_V: Real
    output: Real
    held_out: bool


class Linear:
    """A rig without effects, linearised, at its sampling period."""

    def __init__(self, rig: Mapping[str, Mapping[str, float]], acceleration: bool) -> None:
        truth = Truth(rig, (), Background())
        M, K, C = truth.linear()
        size = M.shape[0]
        motor = rig["motor"]
        A = state_matrix(M, K, C)
        b = np.zeros(2 * size)
        b[size:] = np.linalg.solve(M, np.eye(size)[0]) * (
            motor["gear_ratio"] * motor["torque_constant_Nm_A"] / motor["resistance_ohm"]
        )
        hub = np.eye(2 * size)[0]
        tip = np.append(truth.shapes[-1], np.zeros(size))
        rows = [hub, tip]
        self.direct = np.zeros(2)
        if acceleration:
            # Twice differentiated: the tip's row sees positions only.
            rows[1] = (tip @ A) @ A
            self.direct[1] = (tip @ A) @ b
        self.dt_s = dt = truth.dt_s
        self.whole = int(np.floor(truth.transport_delay_s / dt + 1e-12))
        late = truth.transport_delay_s - self.whole * dt
        self.values, vectors = np.linalg.eig(A)
        self.inverse = np.linalg.inv(vectors)
        self.seen = np.array(rows) @ vectors
        # In the last part of a period the newer voltage acts.
        self.older = self.inverse @ (expm(A * (dt - late)) @ _held(A, b, late))
        self.newer = self.inverse @ _held(A, b, dt - late)

    def responses(self, log: Log) -> tuple[Real, Real]:
        """Forced response (T, n) to the voltage from rest, and (T, n, S) to initial states and offset.

        The last of the S is the encoder's zero. n: hub angle, then the tip's position or acceleration.
        """
        T, n = log.output.shape
        B = log.voltage_V.size - T
        padded = np.concatenate([np.full(self.whole + 1, log.voltage_V[0]), log.voltage_V])
        newer = padded[B + 1 : B + 1 + T]
        older = padded[B : B + T]
        seen = self.seen[:n]
        forced = older[:, None] * self.direct[None, :n]
        poles = np.exp(self.values * self.dt_s)
        # Of a conjugate pair one pole is enough.
        for i in np.flatnonzero(poles.imag >= 0).tolist():
            pole = poles[i]
            sides = 2 if poles[i].imag > 0 else 1
            drive = self.older[i] * older + self.newer[i] * newer
            state = np.asarray(lfilter([0.0, 1.0], [1.0, -pole], drive.astype(np.complex128)))
            forced += sides * np.real(state[:, None] * seen[None, :, i])
        # One of each pair of poles, counted twice.
        half = poles.imag >= 0
        powers = np.exp(np.outer(np.arange(T) * self.dt_s, self.values[half]))
        weights = np.where(self.values[half].imag > 0, 2.0, 1.0)
        free = [np.real((powers * (weights * row[half])) @ self.inverse[half]) for row in seen]
        zero = np.zeros((T, n, 1))
        zero[:, 0, 0] = 1.0
        return forced, np.concatenate([np.stack(free, axis=1), zero], axis=2)


def _held(A: Real, b: Real, over_s: float) -> Real:
    """State after a unit input held over this time."""
    size = b.size
    block = np.zeros((size + 1, size + 1))
    block[:size, :size] = A
    block[:size, size] = b
    return np.asarray(expm(block * over_s)[:size, size])


class Nominal:
    """Fits rigs to logs; weights (n,) per output are one over what a sample is worth."""

    def __init__(self, tolerances: Mapping[str, float], logs: Sequence[Log], acceleration: bool, noise: Real):
        self.keys = list(tolerances)
        self.spread = np.array([tolerances[key] for key in self.keys])
        self.prior = self.spread / np.sqrt(_PER_ONE)
        self.logs = logs
        self.acceleration = acceleration
        motion = np.array([np.std(log.output, axis=0) for log in logs])
        self.weights = 1 / np.hypot(noise, _SHARE * np.sqrt(np.mean(motion**2, axis=0)))

    def at(self, rig: Rig, deviations: Real) -> Rig:
        """Stated values times exp(deviation)."""
        moved: Rig = {section: dict(values) for section, values in rig.items()}
        for key, d in zip(self.keys, deviations, strict=True):
            section, name = key.split(".")
            moved[section][name] *= float(np.exp(d))
        return moved

    def residuals(self, rig: Rig, deviations: Real, only_fitted: bool = False) -> list[Real]:
        """(T, n) per record with its initial state and encoder offset fitted."""
        linear = Linear(self.at(rig, deviations), self.acceleration)
        residuals = []
        for log in self.logs:
            if not (only_fitted and log.held_out):
                forced, free = linear.responses(log)
                residuals.append(self.without_start(log.output - forced, free))
        return residuals

    def without_start(self, gap: Real, free: Real) -> Real:
        """gap (T, n) with what initial states and offset explain taken out, in the weighted sense."""
        w = self.weights[None, :]
        columns = (free * w[:, :, None]).reshape(gap.size, -1)
        target = (gap * w).ravel()
        scale = np.linalg.norm(columns, axis=0) + 1e-300
        solution = np.linalg.lstsq(columns / scale, target, rcond=1e-9)[0]
        return np.asarray((target - (columns / scale) @ solution).reshape(gap.shape) / w)

    def refit(self, rig: Rig) -> list[Real]:
        """Residuals (T, n) per record with the stated values fitted to the estimation records, within what
        their tolerances make of them."""
        zero = np.zeros(len(self.keys))

        def stacked(at: Real) -> Real:
            parts = [(r * self.weights).ravel() for r in self.residuals(rig, at, only_fitted=True)]
            return np.concatenate([*parts, at / self.prior])

        def slopes(at: Real) -> Real:
            now = stacked(at)
            return np.column_stack([(stacked(at + _STEP * e) - now) / _STEP for e in np.eye(at.size)])

        bound = _FARTHEST * self.spread
        p = least_squares(
            stacked, zero, slopes, bounds=(-bound, bound), x_scale=self.spread, ftol=_ENOUGH, max_nfev=_MOST
        ).x
        return self.residuals(rig, p)

    def linear_refit(self, rig: Rig, gaps: Sequence[Real]) -> list[Real]:
        """Gaps (T, n) to another model near the rig, with what small changes of its values explain taken out.

        The slopes are those of the linear machine. Fitted on the estimation records.
        """
        zero = np.zeros(len(self.keys))
        forced: list[list[Real]] = []
        for p in (zero, *(_STEP * np.eye(zero.size))):
            linear = Linear(self.at(rig, p), self.acceleration)
            forced.append([linear.responses(log)[0] for log in self.logs])
        linear = Linear(rig, self.acceleration)
        free = [linear.responses(log)[1] for log in self.logs]
        left = [self.without_start(gap, f) for gap, f in zip(gaps, free, strict=True)]
        slopes = [
            [self.without_start((moved[k] - forced[0][k]) / _STEP, free[k]) for moved in forced[1:]]
            for k in range(len(self.logs))
        ]
        fitted = [k for k, log in enumerate(self.logs) if not log.held_out]
        J = np.concatenate(
            [np.column_stack([(s * self.weights).ravel() for s in slopes[k]]) for k in fitted]
            + [np.diag(1 / self.prior)]
        )
        target = np.concatenate([*((left[k] * self.weights).ravel() for k in fitted), zero])
        deviations = np.linalg.lstsq(J, target, rcond=None)[0]
        return [
            gap - sum((d * s for d, s in zip(deviations, slope, strict=True)), np.zeros_like(gap))
            for gap, slope in zip(left, slopes, strict=True)
        ]
