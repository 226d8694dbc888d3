"""Is anything left in the residuals that white noise would not leave, and how much?

Residuals of a true model are white with variance one. Here their variance may be 1 + s_b in every band b of
frequency of every output, most s_b being zero: a gap of a quarter of the noise is plain where it fills one
octave of many, long before the energy of all samples together shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.machine.machine_protocol import Real

# A band holds something with this probability before its residuals are seen.
_ACTIVE = 0.15
_OCTAVES = 8  # down to 1/512 of the sampling rate; below it offset and drift stand together
# What a band may hold beyond the noise: from so many standard deviations of its energy to far beyond.
_VISIBLE, _LARGEST = 2.5, 1e4
_GRID = 1500  # points over some six decades of size: 250 a decade


@dataclass(frozen=True)
class Discrepancy:
    """What is left over: log evidence gained by allowing it, and its size.

    log_gain : log Bayes factor of "any band may hold something" against white noise.
    log_gain_some : the same, given that at least one band does.
    size : root mean square of it in noise deviations, over all samples.
    """

    log_gain: float
    log_gain_some: float
    size: float


def discrepancy(residuals: Real, segments: Sequence[int], outputs: int = 2) -> Discrepancy:
    """Bands of all records and outputs judged together.

    residuals : (N,). Whitened, record after record, sample by sample.
    segments : samples of each record; N is `outputs` times their sum.

    Raises ValueError if the residuals are not as many as the segments say.
    """
    if residuals.size != outputs * sum(segments):
        raise ValueError(
            f"segments of {sum(segments)} samples of {outputs} outputs for {residuals.size} residuals"
        )
    energy = np.zeros((outputs, _OCTAVES + 1))
    freedom, at = np.zeros_like(energy), 0
    for T in segments:
        e = residuals[at : at + outputs * T].reshape(T, outputs)
        at += outputs * T
        # |R_k|^2 with the weight that makes the sum over all lines the sum of squares; degrees of freedom
        # are one for the mean and the highest line of an even record, two for all others.
        lines = np.fft.rfft(e, axis=0)
        dof = np.full(lines.shape[0], 2.0)
        dof[0] = 1.0
        if T % 2 == 0:
            dof[-1] = 1.0
        power = np.abs(lines) ** 2 * dof[:, None] / T
        # Octave below half the sampling rate of each line; the last holds all below.
        with np.errstate(divide="ignore"):
            octave = np.floor(-np.log2(2 * np.arange(lines.shape[0]) / T))
        band = np.clip(octave, 0, _OCTAVES).astype(np.int64)
        for b in range(_OCTAVES + 1):
            energy[:, b] += power[band == b].sum(axis=0)
            freedom[:, b] += dof[band == b].sum()
    used = freedom.ravel() > 0
    n, S = freedom.ravel()[used], energy.ravel()[used]
    factor = np.array([_log_factor(*pair) for pair in zip(n, S, strict=True)])
    log_gain = float(np.sum(np.logaddexp(np.log1p(-_ACTIVE), np.log(_ACTIVE) + factor)))
    nothing = n.size * float(np.log1p(-_ACTIVE))
    some = log_gain + np.log1p(-np.exp(min(nothing - log_gain, -1e-12))) - np.log1p(-np.exp(nothing))
    held = np.where(factor > 0, np.maximum(S / n - 1, 0.0), 0.0)
    return Discrepancy(log_gain, float(some), float(np.sqrt(np.sum(n * held) / np.sum(n))))


def _log_factor(n: float, S: float) -> float:
    """log of the mean over log s of the likelihood of variance 1 + s over that of variance 1, chi-square."""
    s = np.geomspace(_VISIBLE * np.sqrt(2 / n), _LARGEST, _GRID)
    gain = -0.5 * n * np.log1p(s) + 0.5 * S * s / (1 + s)
    top = float(np.max(gain))
    return top + float(np.log(np.mean(np.exp(gain - top))))
