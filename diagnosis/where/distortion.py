"""Records with repeated periods: frequency response against the model, distortion, what does not repeat.

What comes back in every period is the machine's answer to the input: linear at excited lines, distortion at
the others (of an odd input even at even lines). What changes from period to period is noise, drift,
disturbance or transient.

Neglected: the transient of the first period is only taken off as far as it is a ramp; a distortion of even
and odd order at one line is told apart by lines, not by phase.

Source: R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012,
chapters 2 and 4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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
Booleans = npt.NDArray[np.bool_]

# Samples of a period. A shorter one has fewer than 16 lines below Nyquist: several of its repetitions count
# as one period. Chosen; doubled, inputs that repeat every 32 to 63 samples have half as many periods.
_SHORTEST_PERIOD = 32
# Lines with less than this share of the largest one are rounding of the log, not excitation: a log of three
# digits rounds at 1e-3. Doubled, lines of a multisine at 1/500 of the largest would count as distortion.
_EXCITED = 1e-3
# The mean power of fewer lines scatters by more than half of it, 1 / sqrt(4).
_LEAST_LINES = 4
# Lines above this many times the highest excited one are not looked at: quadratic and cubic distortion end
# there. Doubled, lines of noise alone dilute the distortion.
_HIGHEST_ORDER = 3
# Energies below this are zero: it keeps a ratio finite, and no spectrum of noise over its own comes near.
_NO_ENERGY = 1e-300


@dataclass(frozen=True, eq=False)
class _Period:
    """Spectra of the whole periods of one record, over the noise; L lines below Nyquist, M periods.

    error : (M, L, Y) of measured - model. model : (L, Y) of the model's last period. excited : (L,) whether
    the input has the line. frequency_Hz, lines : (L,).
    """

    error: ComplexArray
    model: ComplexArray
    excited: Booleans
    frequency_Hz: Real
    lines: npt.NDArray[np.int64]


def periodic_findings(case: Case, residuals: Mapping[str, Real], level: float) -> tuple[PeriodicFinding, ...]:
    """What every record with a periodic input says: response at excited lines, distortion at the others.

    Parameters
    ----------
    case : Case
        Of a flexible link. Records in closed loop are passed over: their input answers the output.
    residuals : record -> (T, Y) array
        (measured - model) / noise.
    level : float
        Chance that any finding of all records together is made from noise alone.

    Returns
    -------
    tuple of PeriodicFinding
        One per record whose input repeats at least once; empty where none does.

    Raises
    ------
    KeyError
        A periodic record has no residuals.
    """
    periods: list[tuple[Experiment, int]] = []
    for experiment in case.experiments:
        period = None if experiment.closed_loop else period_of(experiment.voltage_V)
        if period is None:
            continue
        repetitions = -(-_SHORTEST_PERIOD // period)
        if 2 * period * repetitions <= experiment.voltage_V.size:
            periods.append((experiment, period * repetitions))
    return tuple(
        _finding(case, experiment, residuals[experiment.name], period, level / len(periods))
        for experiment, period in periods
    )


def _finding(case: Case, experiment: Experiment, e: Real, period: int, level: float) -> PeriodicFinding:
    """The finding of one record with residuals e (T, Y) and a period in samples, at its own level."""
    dt = case.rig.sampling.dt_s
    count = experiment.voltage_V.size // period
    spectra = _spectra(case, experiment, e, period)
    separable = bool(np.all(spectra.lines[spectra.excited] % 2 == 1))

    groups = _line_groups(spectra, separable)
    bands = []
    for low, high in pairwise(band_edges_Hz(period * dt, dt)):
        inside = spectra.excited & (spectra.frequency_Hz >= low) & (spectra.frequency_Hz < high)
        if np.count_nonzero(inside) >= _LEAST_LINES:
            bands.append((low, high, inside))
    sensors = sensors_of(case)
    tests = len(sensors) * (len(groups) + len(bands))

    response, distortion = [], []
    for s, sensor in enumerate(sensors):
        # What comes back in every period (L,), and the energy of what does not (L,).
        mean = spectra.error[:, :, s].mean(axis=0)
        varying = np.sum(np.abs(spectra.error[:, :, s] - mean) ** 2, axis=0)
        for low, high, inside in bands:
            p_value = _p_value(mean, varying, inside, count)
            error = float(np.sqrt(np.sum(np.abs(mean[inside]) ** 2)))
            size = float(np.sqrt(np.sum(np.abs(spectra.model[inside, s]) ** 2)))
            # Noise of a mean over the periods has a variance of 1 / (2 count) in each part of a line.
            radius = np.sqrt(chi2.ppf(0.95, 2) / (2 * count))
            response.append(
                FrequencyResponseBand(
                    sensor=sensor,
                    low_Hz=low,
                    high_Hz=high,
                    lines=int(np.count_nonzero(inside)),
                    distance=error / float(np.sqrt(np.count_nonzero(inside)) * radius),
                    relative_error=error / size if size > 0 else np.inf,
                    p_value=p_value,
                    found=bool(p_value < level / tests),
                )
            )
        for name, inside in groups.items():
            p_value = _p_value(mean, varying, inside, count)
            # The mean over the periods still holds 1 / count of the noise.
            repeated = float(np.mean(np.abs(mean[inside]) ** 2)) - 1 / count
            distortion.append(
                LineGroup(
                    sensor=sensor,
                    group=name,
                    lines=int(np.count_nonzero(inside)),
                    repeated_rms=float(np.sqrt(max(repeated, 0.0))),
                    p_value=p_value,
                    found=bool(p_value < level / tests),
                )
            )
    return PeriodicFinding(experiment.name, period, count, tuple(response), tuple(distortion), separable)


def _spectra(case: Case, experiment: Experiment, e: Real, period: int) -> _Period:
    """Spectra of the record's residuals e (T, Y) and of its model."""
    dt = case.rig.sampling.dt_s
    count = experiment.voltage_V.size // period
    # Orthonormal lines 1 .. below Nyquist: a mean square modulus of 1 is white noise of unit variance.
    lines = np.arange(1, (period + 1) // 2)
    # A drift is a ramp in every period, yet no answer to the input.
    error = _lines(detrend(e, axis=0), period, count, lines)
    modelled = (experiment.output - e * case.noise) / case.noise
    drive = np.abs(np.fft.rfft(experiment.voltage_V[:period])[lines])
    return _Period(
        error=error,
        model=_lines(modelled, period, count, lines)[-1],
        excited=drive > _EXCITED * drive.max(),
        frequency_Hz=lines / (period * dt),
        lines=lines,
    )


def _line_groups(spectra: _Period, separable: bool) -> dict[str, Booleans]:
    """Name -> (L,) lines that the input does not have, near those that it has; groups of four lines at least.

    separable : only odd lines are excited, so that even distortion is at even lines and odd at odd ones.
    """
    near = spectra.lines <= _HIGHEST_ORDER * spectra.lines[spectra.excited].max()
    quiet = ~spectra.excited & near
    if separable:
        odd = spectra.lines % 2 == 1
        groups = {"not excited, odd": quiet & odd, "not excited, even": quiet & ~odd}
    else:
        groups = {"not excited": quiet}
    return {name: lines for name, lines in groups.items() if np.count_nonzero(lines) >= _LEAST_LINES}


def _lines(signal: Real, period: int, count: int, lines: npt.NDArray[np.int64]) -> ComplexArray:
    """(M, L, Y) orthonormal spectra of the last whole periods of a signal (T, Y)."""
    last = signal[signal.shape[0] - count * period :].reshape(count, period, -1)
    return np.asarray(np.fft.rfft(last, axis=1)[:, lines] / np.sqrt(period))


def _p_value(mean: ComplexArray, varying: Real, inside: Booleans, count: int) -> float:
    """Chance of the repeated part of some lines: the larger one of two.

    From the stated noise: 2 count sum |mean|^2 is chi-square with 2 n degrees of freedom of n lines. From
    what the periods show: its ratio to the energy that varies is Fisher's F with 2 n and 2 n (count - 1).

    mean : (L,) over `count` periods. varying : (L,) summed squares about it. inside : (L,) the lines.
    """
    n = int(np.count_nonzero(inside))
    repeated = 2 * count * float(np.sum(np.abs(mean[inside]) ** 2))
    between = 2 * float(np.sum(varying[inside]))
    freedom = 2 * n * (count - 1)
    by_stated = float(chi2.sf(repeated, 2 * n))
    ratio = (repeated / (2 * n)) / max(between / freedom, _NO_ENERGY)
    by_periods = float(fisher.sf(ratio, 2 * n, freedom))
    return max(by_stated, by_periods)
