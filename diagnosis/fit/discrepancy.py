"""Is anything left in the residuals that white noise would not leave, and how much?

Residuals of a true model are white with variance one. Here their variance may be 1 + s_b in every band b of
frequency of every output, most s_b being zero: a gap of a quarter of the noise is plain where it fills one
octave of many, long before the energy of all samples together shows it.

What the constants do to an answer: `python -m benchmarks.frozen_answers --only exact --change`. Doubled one
by one, all but the number of octaves leave every answer of three cases where it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.machine.machine_protocol import Real

# A band holds something with this probability before its residuals are seen: one or two of the nine bands of
# an output.
_ACTIVE = 0.15
# Octaves below half the sampling rate that are bands by themselves, down to 1/512 of the sampling rate; below
# them offset and drift stand together, a handful of lines. With four of them an unlisted drag is named for
# what it looks like.
_OCTAVES = 8
# Smallest variance that a band may hold beyond the noise, in standard deviations of its mean energy under
# noise alone: less is not told from it.
_VISIBLE = 2.5
# Largest such variance over that of the noise, a hundred noise deviations: above it every answer is unknown.
_LARGEST = 1e4
# Points over some six decades of variance, 250 a decade: the integrand changes little between two.
_GRID = 1500
# Least difference of logarithms that is subtracted from one, so that no logarithm is that of zero.
_SMALLEST_LOG = 1e-12


@dataclass(frozen=True)
class Discrepancy:
    """What is left over beside white noise.

    Attributes
    ----------
    log_gain : float
        log Bayes factor of "any band may hold something" against white noise.
    log_gain_some : float
        log Bayes factor of "at least one band holds something" against white noise.
    size : float
        Root mean square of it in noise deviations, over all samples.
    """

    log_gain: float
    log_gain_some: float
    size: float


def discrepancy(residuals: Real, segments: Sequence[int], outputs: int = 2) -> Discrepancy:
    """Bands of all records and outputs judged together.

    Parameters
    ----------
    residuals : (N,) array
        In noise deviations, record after record, sample by sample, all outputs.
    segments : sequence of int
        Samples of each record; N is `outputs` times their sum.
    outputs : int
        Outputs of every sample.

    Raises
    ------
    ValueError
        If the residuals are not as many as the segments say.
    """
    if residuals.size != outputs * sum(segments):
        raise ValueError(
            f"segments of {sum(segments)} samples of {outputs} outputs for {residuals.size} residuals"
        )
    # Energy and degrees of freedom of every band, over all records.
    energy = np.zeros((outputs, _OCTAVES + 1))
    freedom = np.zeros_like(energy)
    first = 0
    for samples in segments:
        last = first + outputs * samples
        record = residuals[first:last].reshape(samples, outputs)
        first = last
        # |R_k|^2 with the weight that makes the sum over all lines the sum of squares; degrees of freedom
        # are one for the mean and the highest line of an even record, two for all others.
        lines = np.fft.rfft(record, axis=0)
        line_freedom = np.full(lines.shape[0], 2.0)
        line_freedom[0] = 1.0
        if samples % 2 == 0:
            line_freedom[-1] = 1.0
        power = np.abs(lines) ** 2 * line_freedom[:, None] / samples
        # Octave below half the sampling rate of each line; the last holds all below.
        with np.errstate(divide="ignore"):
            octave = np.floor(-np.log2(2 * np.arange(lines.shape[0]) / samples))
        band = np.clip(octave, 0, _OCTAVES).astype(np.int64)
        for b in range(_OCTAVES + 1):
            energy[:, b] += power[band == b].sum(axis=0)
            freedom[:, b] += line_freedom[band == b].sum()

    # Short records leave the lowest bands empty.
    used = freedom.ravel() > 0
    n = freedom.ravel()[used]
    S = energy.ravel()[used]
    log_factors = np.array([_log_factor(*band) for band in zip(n, S, strict=True)])

    # Every band is active or not, independently: its likelihood is (1 - a) + a factor.
    log_gain = float(np.sum(np.logaddexp(np.log1p(-_ACTIVE), np.log(_ACTIVE) + log_factors)))
    # The same without the case that no band is active, over the prior probability of that.
    log_none = n.size * float(np.log1p(-_ACTIVE))
    log_share_some = np.log1p(-np.exp(min(log_none - log_gain, -_SMALLEST_LOG)))
    log_gain_some = log_gain + log_share_some - np.log1p(-np.exp(log_none))
    # What a band holds beyond the noise counts where it is likelier than not.
    variances = np.where(log_factors > 0, np.maximum(S / n - 1, 0.0), 0.0)
    size = float(np.sqrt(np.sum(n * variances) / np.sum(n)))
    return Discrepancy(log_gain, float(log_gain_some), size)


def _log_factor(n: float, S: float) -> float:
    """log Bayes factor of a band that holds something: mean over log s of the likelihood of variance 1 + s.

    Its energy S is (1 + s) times a chi-square of n degrees of freedom; s lies anywhere between what is
    visible and `_LARGEST`, in its logarithm.
    """
    s = np.geomspace(_VISIBLE * np.sqrt(2 / n), _LARGEST, _GRID)
    log_ratios = -0.5 * n * np.log1p(s) + 0.5 * S * s / (1 + s)
    largest = float(np.max(log_ratios))
    return largest + float(np.log(np.mean(np.exp(log_ratios - largest))))
