"""Filters, convolutions and trends of sampled signals.

`scipy.signal` has them all and loads statistics, interpolation and geometry with itself, which takes longer
than to identify a model. What every identification and diagnosis needs of it stands here, with the same
rounding; whoever needs more of it (filter design, zeros and poles) imports it in the function that does.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt
import scipy.fft
import scipy.linalg

from ident.data.arrays import COMPILED, RealArray


def through_filter(
    numerator: npt.ArrayLike, denominator: npt.ArrayLike, signals: RealArray, before: float = 0.0
) -> RealArray:
    """Return signals behind a filter in z, as `scipy.signal.lfilter` along the first axis.

    Parameters
    ----------
    numerator, denominator : array_like
        Real coefficients of z^0, z^-1, ...; the first of the denominator is not zero.
    signals : (T,) or (T, n) array
        Each column by itself. From a NaN on all is NaN, for a denominator of one number the next rows only.
    before : float
        State of a filter of first order before the first sample, in the unit of what comes out.

    Returns
    -------
    (T,) or (T, n) array
        In direct form II transposed, which is what rounding follows.
    """
    b = np.atleast_1d(np.asarray(numerator, dtype=np.float64))
    a = np.atleast_1d(np.asarray(denominator, dtype=np.float64))
    columns = signals.reshape(len(signals), -1)
    behind = np.empty(columns.shape)
    if a.size == 1:
        for column in range(columns.shape[1]):
            behind[:, column] = np.convolve(b / a[0], columns[:, column])[: len(signals)]
        return behind.reshape(signals.shape)
    order = max(a.size, b.size) - 1
    b = np.concatenate([b, np.zeros(order + 1 - b.size)]) / a[0]
    a = np.concatenate([a, np.zeros(order + 1 - a.size)]) / a[0]
    for column in range(columns.shape[1]):
        signal = np.array(columns[:, column], dtype=np.float64)
        behind[:, column] = _behind(b, a, signal, np.full(order, before))
    return behind.reshape(signals.shape)


@numba.njit(**COMPILED)
def _behind(b: RealArray, a: RealArray, signal: RealArray, state: RealArray) -> RealArray:
    """Signal (T,) behind a filter of order n from state (n,), overwritten; b, a (n + 1,), a[0] = 1."""
    behind = np.empty_like(signal)
    last = state.size - 1
    for k in range(signal.size):
        behind[k] = state[0] + b[0] * signal[k]
        for i in range(last):
            state[i] = state[i + 1] + signal[k] * b[i + 1] - behind[k] * a[i + 1]
        state[last] = signal[k] * b[last + 1] - behind[k] * a[last + 1]
    return behind


def convolved(first: RealArray, second: RealArray) -> RealArray:
    """Return the whole convolution (T + N - 1,) of two signals (T,) and (N,), by fast Fourier transforms."""
    length = first.size + second.size - 1
    padded = scipy.fft.next_fast_len(length, real=True)
    product = scipy.fft.rfft(first, padded) * scipy.fft.rfft(second, padded)
    return np.asarray(scipy.fft.irfft(product, padded)[:length])


def without_line(signals: RealArray) -> RealArray:
    """Return signals (T,) or (T, n) less the straight line that fits each column best, T >= 1 rows."""
    times = np.arange(1, len(signals) + 1) / len(signals)
    line = np.column_stack([times, np.ones(len(signals))])
    return np.asarray(signals - line @ scipy.linalg.lstsq(line, signals)[0])
