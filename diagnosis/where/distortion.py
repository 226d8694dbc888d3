"""Records with repeated periods: frequency response against the model, distortion, what does not repeat.

What comes back in every period is the machine's answer to the input: linear at excited lines, distortion at
the others (of an odd input even at even lines). What changes from period to period is noise, drift,
disturbance or transient. After Pintelon and Schoukens, System Identification.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.signal import detrend
from scipy.stats import chi2, f as fisher

from diagnosis.machine.case import Case, Experiment
from diagnosis.machine.machine_protocol import Real
from diagnosis.where.findings import FrequencyResponseBand, LineGroup, PeriodicFinding, sensors_of
from diagnosis.where.where_energy import band_edges_Hz
from ident.data.distortion import period_of

ComplexArray = npt.NDArray[np.complex128]
_SHORTEST = 32  # samples of a period
# Lines with less than this share of the largest one are rounding of the log, not excitation.
_EXCITED = 1e-3
_LEAST_LINES = 4  # the mean power of fewer scatters by more than half of it, 1 / sqrt(4)


def periodic_findings(case: Case, residuals: Mapping[str, Real], level: float) -> tuple[PeriodicFinding, ...]:
    """One per experiment whose input repeats; together they raise a false alarm with the chance `level`."""
    periods = [(x, period_of(x.voltage_V)) for x in case.experiments if not x.closed_loop]
    # A shorter period has too few lines: several of them count as one.
    whole = [(x, p * -(-_SHORTEST // p)) for x, p in periods if p is not None]
    periodic = [(x, p) for x, p in whole if 2 * p <= x.voltage_V.size]
    return tuple(_finding(case, x, residuals[x.name], p, level / len(periodic)) for x, p in periodic)


def _finding(case: Case, x: Experiment, e: Real, period: int, level: float) -> PeriodicFinding:
    dt, count = case.rig.sampling.dt_s, x.voltage_V.size // period
    # Orthonormal lines 1 .. below Nyquist: a mean square modulus of 1 is white noise of unit variance.
    lines = np.arange(1, (period + 1) // 2)
    # A drift is a ramp in every period, yet no answer.
    spectra = _lines(detrend(e, axis=0), period, count, lines)
    model = _lines((x.output - e * case.noise) / case.noise, period, count, lines)[-1]
    drive = np.abs(np.fft.rfft(x.voltage_V[:period])[lines])
    excited = drive > _EXCITED * drive.max()
    separable = bool(np.all(lines[excited] % 2 == 1))
    # Distortion of a low order ends at a few times the highest excited line.
    near = lines <= 3 * lines[excited].max()
    groups = {
        "not excited, odd": ~excited & near & (lines % 2 == 1),
        "not excited, even": ~excited & near & (lines % 2 == 0),
    }
    if not separable:
        groups = {"not excited": ~excited & near}
    groups = {name: chosen for name, chosen in groups.items() if np.count_nonzero(chosen) >= _LEAST_LINES}
    edges, frequency = band_edges_Hz(period * dt, dt), lines / (period * dt)
    banded = [(low, high, excited & (frequency >= low) & (frequency < high)) for low, high in pairwise(edges)]
    banded = [(low, high, chosen) for low, high, chosen in banded if np.count_nonzero(chosen) >= _LEAST_LINES]
    sensors = sensors_of(case)
    tests = len(sensors) * (len(groups) + len(banded))
    bands, shown = [], []
    for s, sensor in enumerate(sensors):
        # Mean over the periods (L,) and summed squares of what is left (L,).
        mean = spectra[:, :, s].mean(axis=0)
        rest = np.sum(np.abs(spectra[:, :, s] - mean) ** 2, axis=0)
        for low, high, chosen in banded:
            p_value = _p_value(mean, rest, chosen, count)
            error = float(np.sqrt(np.sum(np.abs(mean[chosen]) ** 2)))
            size = float(np.sqrt(np.sum(np.abs(model[chosen, s]) ** 2)))
            radius = np.sqrt(chi2.ppf(0.95, 2) / (2 * count))
            bands.append(
                FrequencyResponseBand(
                    sensor,
                    low,
                    high,
                    int(np.count_nonzero(chosen)),
                    error / float(np.sqrt(np.count_nonzero(chosen)) * radius),
                    error / size if size > 0 else np.inf,
                    p_value,
                    bool(p_value < level / tests),
                )
            )
        for name, chosen in groups.items():
            p_value = _p_value(mean, rest, chosen, count)
            shown.append(
                LineGroup(
                    sensor,
                    name,
                    int(np.count_nonzero(chosen)),
                    float(np.sqrt(max(float(np.mean(np.abs(mean[chosen]) ** 2)) - 1 / count, 0.0))),
                    p_value,
                    bool(p_value < level / tests),
                )
            )
    return PeriodicFinding(x.name, period, count, tuple(bands), tuple(shown), separable)


def _lines(signal: Real, period: int, count: int, lines: npt.NDArray[np.int64]) -> ComplexArray:
    """(M, L, Y) orthonormal spectra of the last whole periods of a signal (T, Y)."""
    last = signal[signal.shape[0] - count * period :].reshape(count, period, -1)
    return np.asarray(np.fft.rfft(last, axis=1)[:, lines] / np.sqrt(period))


def _p_value(mean: ComplexArray, rest: Real, chosen: npt.NDArray[np.bool_], count: int) -> float:
    """Chance of the repeated part from the stated noise or from what the periods show: the larger one."""
    n = int(np.count_nonzero(chosen))
    repeated = 2 * count * float(np.sum(np.abs(mean[chosen]) ** 2))
    varying, freedom = 2 * float(np.sum(rest[chosen])), 2 * n * (count - 1)
    by_stated = float(chi2.sf(repeated, 2 * n))
    by_periods = float(fisher.sf((repeated / (2 * n)) / max(varying / freedom, 1e-300), 2 * n, freedom))
    return max(by_stated, by_periods)
