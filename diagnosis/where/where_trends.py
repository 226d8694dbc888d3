"""How the gap grows with time and input amplitude, what all records share, what is linear in the voltage."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations, product
from operator import itemgetter

import numpy as np
from scipy.stats import chi2, t as student

from diagnosis.fit.residual import pooled_rms
from diagnosis.machine.case import Case, Experiment
from diagnosis.machine.machine_protocol import Real
from diagnosis.where.findings import (
    SENSORS,
    AmplitudeFinding,
    CommonFinding,
    DriftFinding,
    Growth,
    Interval,
    LinearCorrection,
    sensors_of,
)
from diagnosis.where.where_energy import Energy
from ident.basis.functions import regressor
from ident.basis.poles import Poles
from plant.modal import linear_arm

_DRAWS = 2000  # ends of a 95 % interval are then known to 6 % of a standard deviation
_BLOCK_S = 0.5  # a swing of a slow arm, 2 Hz: shorter blocks would be alike
# Two inputs closer in size than this say nothing about growth.
_LEAST_RATIO = 1.3
# What is the same whatever the input is looked for in so many experiments with different inputs.
_LEAST_EXPERIMENTS, _MOST_EXPERIMENTS = 4, 8
_LARGEST_CORRELATION = 0.5  # inputs more alike share a quarter of their energy
_LEAST_SHARE = 0.5  # of the gap: less is not what it mostly is
# Held-out gap energy has to stand this many standard deviations clear before a share of it means anything.
_CLEAR = 5.0
_Z95 = 1.96  # standard deviations of a 95 % interval
# Besides the machine's own poles: dynamics that are missing in it, from a slow to a fast real pole.
_FREE_POLES = (0.98, 0.9, 0.6, 0.0, 0.0)


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
    for s, (sensor, unit) in enumerate(SENSORS[output] for output in case.outputs):
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
        beyond = bool(p_value < level / len(case.outputs))
        found.append(DriftFinding(sensor, unit, rate, share, (rate - half, rate + half), p_value, beyond))
    return tuple(found)


def amplitude_finding(
    case: Case, residuals: Mapping[str, Real], level: float, rng: np.random.Generator
) -> AmplitudeFinding | None:
    """Exponent of the gap over the input amplitude, from two experiments of one kind.

    Intervals by resampling half-second blocks of both; they do not know that another sequence excites the gap
    differently, so a quarter is added on either side before anything but proportion is claimed. None without
    two such experiments, each of two blocks at least, or when either of them shows no gap beyond noise.
    """
    pairs = [
        (pooled_rms(high.voltage_V) / pooled_rms(low.voltage_V), low, high)
        for low, high in permutations(case.experiments, 2)
        if not (low.closed_loop or high.closed_loop) and low.kind == high.kind and np.any(low.voltage_V)
    ]
    ratio, *pair = max(pairs, key=itemgetter(0), default=(0.0,))
    if ratio < _LEAST_RATIO:
        return None
    gaps, draws = [], []
    for experiment in pair:
        energy = np.sum(np.square(residuals[experiment.name]), axis=1)
        length = max(round(_BLOCK_S / case.rig.sampling.dt_s), 1)
        blocks = energy[: energy.size // length * length].reshape(-1, length).mean(axis=1)
        if blocks.size < 2:
            return None
        index = rng.integers(0, blocks.size, (_DRAWS, blocks.size))
        gaps.append(float(energy.mean()) - len(case.outputs))
        draws.append(blocks[index].mean(axis=1) - len(case.outputs))
        # sum of Y T squares of unit variance: variance 2 Y T, of the mean over T samples 2 Y / T
        if gaps[-1] < 4 * np.sqrt(2.0 * len(case.outputs) / energy.size):
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


def common_findings(case: Case, residuals: Mapping[str, Real], level: float) -> tuple[CommonFinding, ...]:
    """One per sensor; empty with fewer than four experiments whose inputs differ.

    For a gap that comes from the input the mean over n experiments with different inputs holds about 1/n of
    the energy; for one that comes with the clock it holds all.

    Found asks for more energy in the mean than noise leaves there (chi-square, exact), for half of the gap,
    and that no other choice of signs of the experiments gives as much.
    """
    # Those whose voltages hardly resemble each other, longest first.
    chosen: list[Experiment] = []
    for x in sorted(case.experiments, key=lambda x: -x.voltage_V.size):
        alike = (_correlation(x.voltage_V, other.voltage_V) for other in chosen)
        if all(abs(c) < _LARGEST_CORRELATION for c in alike):
            chosen.append(x)
    chosen = chosen[:_MOST_EXPERIMENTS]
    if len(chosen) < _LEAST_EXPERIMENTS:
        return ()
    length = min(x.voltage_V.size for x in chosen)
    e = np.stack([residuals[x.name][:length] for x in chosen])  # (n, T, Y)
    n, dt = len(chosen), case.rig.sampling.dt_s
    # The first sign is fixed: turning all of them changes nothing.
    signs = np.array([(1.0, *rest) for rest in product((1.0, -1.0), repeat=n - 1)])
    found = []
    for s, sensor in enumerate(sensors_of(case)):
        # Energy of the mean, over all choices of signs, from the products of the experiments.
        products = e[:, :, s] @ e[:, :, s].T
        energy = np.einsum("ki,ij,kj->k", signs, products, signs) / n
        gap = float(np.trace(products)) - n * length
        p_value = float(chi2.sf(energy[0], length))
        share = (energy - length) / gap if gap > 3 * np.sqrt(2.0 * n * length) else np.zeros(energy.size)
        chance = float(np.max(share[1:]))
        yes = bool(
            p_value < level / len(case.outputs) and share[0] >= _LEAST_SHARE and share[0] > max(chance, 0.0)
        )
        # The strongest line, and the share of the whole energy within one line of it. Offset and the two
        # slowest lines are left out: drifts lie there, and the swing into a disturbance.
        power = np.abs(np.fft.rfft(e[:, :, s].mean(axis=0))) ** 2
        power[1:] *= 2.0  # both signs of a frequency; an offset has one
        top = int(np.argmax(power[3:])) + 3
        peak_Hz = float(top / (e.shape[1] * dt))
        peak_share = float(power[top - 1 : top + 2].sum() / power.sum())
        found.append(
            CommonFinding(sensor, n, float(share[0]), max(chance, 0.0), peak_Hz, peak_share, p_value, yes)
        )
    return tuple(found)


def _correlation(a: Real, b: Real) -> float:
    """Cosine of two voltages over their common length; resting inputs resemble each other."""
    length = min(a.size, b.size)
    a, b = a[:length], b[:length]
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0 else 1.0


def linear_correction(case: Case, residuals: Mapping[str, Real]) -> LinearCorrection | None:
    """Does any linear correction of the model, from voltage to sensors, take the gap away?

    Fitted to the residuals of the estimation records and judged on the held-out ones, on basis functions with
    the nominal poles taken twice (the change of a response with its poles to first order), one and two
    integrators, and free real poles for what the nominal model lacks. None if the gap of the estimation or of
    the held-out records is too small to take shares of.
    """
    for records in (case.estimation, case.held_out):
        whole = Energy.of(residuals[x.name] for x in records)
        if not whole.gap > _CLEAR * np.sqrt(2.0 * whole.count):
            return None
    z = np.exp(linear_arm(case.rig).poles() * case.rig.sampling.dt_s)
    # The integrator of the hub enters as summed input: a pole inside the circle cannot stand for it.
    inside = z[np.abs(z) < 1 - 1e-7]
    real, pairs = inside.real[np.abs(inside.imag) < 1e-12], inside[inside.imag >= 1e-12]
    poles = Poles(np.concatenate([np.repeat(real, 2), _FREE_POLES]), np.repeat(pairs, 2))
    estimation = [(_columns(poles, x.voltage_V), residuals[x.name]) for x in case.estimation]
    X = np.vstack([columns for columns, _ in estimation])
    scale = np.sqrt(np.mean(X**2, axis=0))
    scale[scale == 0] = 1.0
    theta, *_ = np.linalg.lstsq(X / scale, np.vstack([e for _, e in estimation]), rcond=1e-8)
    gap, taken, moved = 0.0, 0.0, 0.0
    for experiment in case.held_out:
        e = residuals[experiment.name]
        prediction = _columns(poles, experiment.voltage_V) / scale @ theta
        gap += float(np.sum(e**2)) - e.size
        taken += float(np.sum(e**2) - np.sum((e - prediction) ** 2))
        moved += float(np.sum(prediction**2))
    share = taken / gap
    # e = gap + noise: the energy taken, 2 e.p - p.p, moves with the noise by 2 |p|.
    half = _Z95 * 2 * np.sqrt(moved) / gap
    return LinearCorrection(share, (float(share - half), float(share + half)))


def _columns(poles: Poles, voltage: Real) -> Real:
    """(T, B + 2): basis functions driven by the voltage, and the voltage summed once and twice."""
    once = np.concatenate([[0.0], np.cumsum(voltage)[:-1]])
    return np.column_stack([regressor(poles, voltage), once, np.concatenate([[0.0], np.cumsum(once)[:-1]])])
