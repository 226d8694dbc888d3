"""How the gap grows: with time since the start, and with the amplitude of the input."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.stats import t as student

from diagnosis.machine.case import Case, Experiment
from diagnosis.machine.machine_protocol import Real
from diagnosis.where.findings import SENSORS, AmplitudeFinding, DriftFinding, Growth, Interval

_UNITS = ("rad/s", "m/s")
_DRAWS = 2000
_BLOCK_S = 0.5
# Two inputs closer in size than this say nothing about growth.
_LEAST_RATIO = 1.3


def drift_findings(case: Case, residuals: Mapping[str, Real], level: float) -> tuple[DriftFinding, ...]:
    """Slope of every sensor's residual over time, with an offset of its own in every experiment.

    Slopes b_i of n experiments with information w_i = sum (t - mean t)^2: b = sum w b_i / sum w, and
    b / sqrt(sum w_i (b_i - b)^2 / ((n - 1) sum w)) is Student with n - 1 degrees of freedom if all scatter
    alike, whatever the colour of the residuals.
    """
    dt = case.rig.sampling.dt_s
    weights, slopes, squares = [], [], 0.0
    for e in residuals.values():
        time = np.arange(e.shape[0]) * dt
        squares += float(time @ time)
        time -= time.mean()
        weights.append(float(time @ time))
        slopes.append(time @ e / weights[-1])
    w, b = np.array(weights), np.array(slopes)
    mean = w @ b / w.sum()
    found = []
    for s, (sensor, unit) in enumerate(zip(SENSORS, _UNITS, strict=True)):
        scale = float(case.noise[s])
        rate = float(mean[s] * scale)
        gap = sum(float(np.sum(e[:, s] ** 2)) - e.shape[0] for e in residuals.values())
        share = float(min(mean[s] ** 2 * squares / gap, 1.0)) if gap > 0 else 0.0
        if w.size < 3:
            found.append(DriftFinding(sensor, unit, rate, share, None, 1.0, False))
            continue
        error = float(np.sqrt(w @ (b[:, s] - mean[s]) ** 2 / ((w.size - 1) * w.sum()))) * scale
        p_value = float(2 * student.sf(abs(rate) / error, w.size - 1)) if error > 0 else 1.0
        half = float(student.ppf(0.975, w.size - 1)) * error
        beyond = bool(p_value < level / len(SENSORS))
        found.append(DriftFinding(sensor, unit, rate, share, (rate - half, rate + half), p_value, beyond))
    return tuple(found)


def amplitude_pair(case: Case) -> tuple[Experiment, Experiment] | None:
    """Weakest and strongest open-loop experiment of one kind, if they differ enough."""
    best: tuple[float, Experiment, Experiment] | None = None
    for low in case.experiments:
        for high in case.experiments:
            if low.closed_loop or high.closed_loop or low.kind != high.kind or _rms(low) == 0:
                continue
            ratio = _rms(high) / _rms(low)
            if ratio >= _LEAST_RATIO and (best is None or ratio > best[0]):
                best = ratio, low, high
    return None if best is None else best[1:]


def _rms(experiment: Experiment) -> float:
    return float(np.sqrt(np.mean(experiment.voltage_V**2)))


def amplitude_finding(
    case: Case, residuals: Mapping[str, Real], level: float, rng: np.random.Generator
) -> AmplitudeFinding | None:
    """Exponent of the gap over the input amplitude, from two experiments of one kind.

    Intervals by resampling half-second blocks of both; they do not know that another sequence excites the gap
    differently, so a quarter is added on either side before anything but proportion is claimed. None without
    two such experiments or when either of them shows no gap beyond noise.
    """
    pair = amplitude_pair(case)
    if pair is None:
        return None
    ratio = _rms(pair[1]) / _rms(pair[0])
    gaps, draws = [], []
    for experiment in pair:
        energy = np.sum(np.square(residuals[experiment.name]), axis=1)
        length = max(round(_BLOCK_S / case.rig.sampling.dt_s), 1)
        blocks = energy[: energy.size // length * length].reshape(-1, length).mean(axis=1)
        index = rng.integers(0, blocks.size, (_DRAWS, blocks.size))
        gaps.append(float(energy.mean()) - len(SENSORS))
        draws.append(blocks[index].mean(axis=1) - len(SENSORS))
        # sum of 2 T squares of unit variance: variance 4 T, of the mean over T samples 4 / T
        if gaps[-1] < 4 * np.sqrt(4.0 / energy.size):
            return None
    low, high = (np.maximum(d, 1e-3 * g) for d, g in zip(draws, gaps, strict=True))
    log_ratio = np.log(ratio)
    exponent = float(0.5 * np.log(gaps[1] / gaps[0]) / log_ratio)
    spread = 0.5 * np.log(high / low) / log_ratio
    interval = tuple(float(v) for v in np.quantile(spread, (level / 2, 1 - level / 2)))
    growth = _growth((interval[0] - 0.25, interval[1] + 0.25))
    gap_ratio = float(np.sqrt(gaps[1] / gaps[0]))
    ninety_five = tuple(float(v) for v in np.quantile(spread, (0.025, 0.975)))
    return AmplitudeFinding(
        (pair[0].name, pair[1].name),
        ratio,
        gap_ratio,
        exponent,
        (ninety_five[0], ninety_five[1]),
        growth,
        growth in ("offset", "saturating", "faster"),
    )


def _growth(interval: Interval) -> Growth:
    low, high = interval
    if high < 0.5:
        return "offset"
    if high < 1.0:
        return "saturating"
    if low > 1.0:
        return "faster"
    return "linear" if high - low < 1.2 else "undecided"
