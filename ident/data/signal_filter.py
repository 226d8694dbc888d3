"""Fitting inside a frequency band: the same filter on input and output leaves the model, and removes the
rest."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np

from ident.data.arrays import RealArray
from ident.data.record import Record


def band_limited(
    record: Record,
    low_rad_s: float | None = None,
    high_rad_s: float | None = None,
    *,
    filter_order: int = 2,
    skip_s: float = 0.0,
) -> Record:
    """Filter input, output and reference with one Butterworth filter; drop the first `skip_s` seconds.

    A fit of the result is weighted to the band; None leaves a side open. The filter starts with its steady
    state for the first sample, so that a lightly damped plant not at rest needs an unknown initial state in
    the fit. Raises ValueError if the band is empty or leaves (0, pi/dt), both sides are None, or nothing is
    left after `skip_s`.
    """
    import scipy.signal  # half a second that logs which are refused do not need

    low, high = low_rad_s, high_rad_s
    edges = band_edges(record.dt_s, low, high)
    skip = round(skip_s / record.dt_s)
    if not 0 <= skip < record.n_samples:
        raise ValueError(f"{record.label}: skip_s = {skip_s} leaves nothing of {record.n_samples} samples")
    kind: Literal["bandpass", "lowpass", "highpass"] = (
        "lowpass" if low is None else "highpass" if high is None else "bandpass"
    )
    sections = scipy.signal.butter(
        filter_order, edges if len(edges) == 2 else edges[0], kind, output="sos", fs=2 * np.pi / record.dt_s
    )
    settled = scipy.signal.sosfilt_zi(sections)

    def filtered(signal: RealArray) -> RealArray:
        columns = [scipy.signal.sosfilt(sections, x, zi=settled * x[0])[0] for x in signal.T]
        return np.column_stack(columns)[skip:]

    return record.each(filtered)


def band_edges(dt_s: float, low_rad_s: float | None, high_rad_s: float | None) -> list[float]:
    """The one or two edges [rad/s] that a band has. Raises ValueError if both are None, or the band is empty
    or leaves (0, pi/dt_s)."""
    if low_rad_s is None and high_rad_s is None:
        raise ValueError("a band needs a lower or an upper frequency")
    nyquist = np.pi / dt_s
    edges = [edge for edge in (low_rad_s, high_rad_s) if edge is not None]
    if not all(a < b for a, b in pairwise([0.0, *edges, nyquist])):
        raise ValueError(
            f"the band must lie in (0, {nyquist:.6g}) rad/s, lower below upper; got {low_rad_s} to "
            f"{high_rad_s}"
        )
    return edges


def settling_time_s(dt_s: float, low_rad_s: float, high_rad_s: float) -> float:
    """Time after which the start of `band_limited` (order 2) has died down to e^-5: before, it looks like
    a mode at the edge."""
    import scipy.signal

    _, poles, _ = scipy.signal.butter(
        2, [low_rad_s, high_rad_s], "bandpass", output="zpk", fs=2 * np.pi / dt_s
    )
    return float(-5 * dt_s / np.log(np.abs(poles).max()))


def increments(record: Record) -> Record:
    """The record through 1 - q^-1, one sample shorter: the same response, slow noise whitened. ValueError for
    one sample."""
    if record.n_samples < 2:
        raise ValueError(f"{record.label}: differences need at least two samples")
    return record.each(lambda signal: np.diff(signal, axis=0))
