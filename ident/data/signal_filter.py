"""Fitting inside a frequency band: one filter on input and output leaves the model and removes the rest.

A linear plant and a linear filter commute, so that a record whose signals all went through one filter has the
same response; noise, drift and dynamics outside of the band count less in a fit of it (Ljung, System
Identification, 2nd ed., section 14.4). `band_limited` applies a Butterworth filter, `increments` takes
differences, which whitens slow noise. `band_edges` checks a band, `settling_time_s` says how long the
filter's own start is seen. Assumed: that start is skipped, or the fit has an unknown initial state. Of a
`Record` matter here its signals (T, .), finite, and dt_s [s].
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np

from ident.data.arrays import RealArray
from ident.data.record import Record

# Time constants of the filter's slowest pole after which its start is gone: to e^-5, .7 %. Chosen: below the
# noise of most records; doubled, twice the time is lost.
SETTLED_TIME_CONSTANTS = 5


def band_limited(
    record: Record,
    low_rad_s: float | None = None,
    high_rad_s: float | None = None,
    *,
    filter_order: int = 2,
    skip_s: float = 0.0,
) -> Record:
    """Return the record with input, output and reference through one Butterworth filter.

    Parameters
    ----------
    record : Record
        Any number of inputs and outputs.
    low_rad_s, high_rad_s : float, optional
        Edges of the band, rad/s (3 dB); None leaves a side open.
    filter_order : int
        Of a low-pass or high-pass filter; a band-pass filter has twice as many poles. 2 by default: 40 dB a
        decade, while it settles soon. Not checked: 0 is no filter, and very high orders are inaccurate.
    skip_s : float
        Time that is left out at the start, s, rounded to samples; `settling_time_s` says how much is needed.

    Returns
    -------
    Record
        T less the skipped samples, names and units as before. A fit of it is weighted to the band.

    Raises
    ------
    ValueError
        The band is empty or leaves (0, pi/dt), both sides are None, or nothing is left after `skip_s`.

    Notes
    -----
    The filter starts with its steady state for the first sample, so that a lightly damped plant not at rest
    needs an unknown initial state in the fit.

    Examples
    --------
    >>> flexlink.band_limited(example_record(), 1.0, 100.0, skip_s=1.0).output.shape
    (1900, 1)
    """
    import scipy.signal  # half a second that logs which are refused do not need

    edges = band_edges(record.dt_s, low_rad_s, high_rad_s)
    n_skipped = round(skip_s / record.dt_s)
    if not 0 <= n_skipped < record.n_samples:
        raise ValueError(f"{record.label}: skip_s = {skip_s} leaves nothing of {record.n_samples} samples")

    kind: Literal["bandpass", "lowpass", "highpass"]
    if low_rad_s is None:
        kind = "lowpass"
    elif high_rad_s is None:
        kind = "highpass"
    else:
        kind = "bandpass"
    corner = edges if len(edges) == 2 else edges[0]
    sampling_rad_s = 2 * np.pi / record.dt_s
    sections = scipy.signal.butter(filter_order, corner, kind, output="sos", fs=sampling_rad_s)
    # The filter's state once a constant input of 1 has settled; it scales with the input.
    steady_state_of_one = scipy.signal.sosfilt_zi(sections)

    def filtered(signals: RealArray) -> RealArray:
        """Return filtered signals, columns of (T, C), without the samples that are skipped.

        (T - n_skipped, C) in the units of the signals; finite, as of a record, with one column at least.
        """
        columns = []
        for signal in signals.T:
            column, _ = scipy.signal.sosfilt(sections, signal, zi=steady_state_of_one * signal[0])
            columns.append(column)
        return np.column_stack(columns)[n_skipped:]

    return record.each(filtered)


def band_edges(dt_s: float, low_rad_s: float | None, high_rad_s: float | None) -> list[float]:
    """Return the one or two edges, rad/s, that a band has, lower first.

    Parameters
    ----------
    dt_s : float
        Sampling time, s, positive; not checked.
    low_rad_s, high_rad_s : float or None
        None where the side is open.

    Raises
    ------
    ValueError
        Both sides are None, or the band is empty or leaves (0, pi/dt_s).
    """
    if low_rad_s is None and high_rad_s is None:
        raise ValueError("a band needs a lower or an upper frequency")
    nyquist = np.pi / dt_s
    edges = [edge for edge in (low_rad_s, high_rad_s) if edge is not None]
    ascending = [0.0, *edges, nyquist]
    # Each edge above the one before is all that a band needs. NaN compares as false, and is refused.
    if not all(lower < upper for lower, upper in pairwise(ascending)):
        raise ValueError(
            f"the band must lie in (0, {nyquist:.6g}) rad/s, lower below upper; got {low_rad_s} to "
            f"{high_rad_s}"
        )
    return edges


def settling_time_s(dt_s: float, low_rad_s: float, high_rad_s: float) -> float:
    """Return the time, s, after which the start of `band_limited` (order 2) has died down to e^-5.

    Parameters
    ----------
    dt_s : float
        Sampling time, s.
    low_rad_s, high_rad_s : float
        Edges of the band, rad/s, as `band_edges` accepts them; scipy raises ValueError for others.

    Notes
    -----
    By the slowest pole of the filter. Before, its start looks like a mode at the edge of the band.
    """
    import scipy.signal  # as above

    _, poles, _ = scipy.signal.butter(
        2, [low_rad_s, high_rad_s], "bandpass", output="zpk", fs=2 * np.pi / dt_s
    )
    # A mode with a pole of modulus r falls by r each sample.
    log_radius = np.log(np.abs(poles).max())
    return float(-SETTLED_TIME_CONSTANTS * dt_s / log_radius)


def increments(record: Record) -> Record:
    """Return the record through 1 - q^-1, one sample shorter: the same response, slow noise whitened.

    Raises ValueError for a record of one sample.
    """
    if record.n_samples < 2:
        raise ValueError(f"{record.label}: differences need at least two samples")
    return record.each(lambda signal: np.diff(signal, axis=0))
