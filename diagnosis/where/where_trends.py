"""How the gap grows with time and input amplitude, what all records share, what is linear in the voltage.

Residuals (T, Y) here are (measured - model) / noise of a flexible link, by experiment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations, product

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

# Draws of the bootstrap: ends of a 95 % interval are then known to 6 % of a standard deviation.
_DRAWS = 2000
# Length of a block: a swing of a slow arm, 2 Hz. Shorter blocks would be alike and make an interval too
# narrow; of twice the length a record of a few seconds has too few.
_BLOCK_S = 0.5
# Ratio of two inputs' sizes below which they say nothing about growth: the exponent's error grows with the
# inverse of its logarithm, at 1.3 four times that of the gaps' ratio. Chosen.
_LEAST_RATIO = 1.3
# Standard deviations of noise by which the gap of a record has to exceed it before its growth is looked at.
# Chosen; the exponent is then known to an eighth over the logarithm of the inputs' ratio.
_CLEAR_OF_NOISE = 4.0
# Part of the gap below which a drawn gap is not taken, for its logarithm.
_LEAST_DRAWN = 1e-3
# Added to the exponent's interval on either side: another sequence of the same size excites the gap
# differently. Chosen; doubled, "saturating" is said of no exponent above a half.
_OTHER_SEQUENCE = 0.25
# Exponents of growth: below a half the gap is closer to a constant than to a proportion.
_HALF_WAY = 0.5
# Width of an exponent's interval from which on it says nothing: it then holds a constant and a proportion.
_SAYS_NOTHING = 1.2
# Experiments with different inputs in which what is the same whatever the input is looked for: with fewer,
# chance leaves a third of a gap in their mean. Chosen.
_LEAST_EXPERIMENTS = 4
# And the most of them: all 2^7 choices of signs are tried.
_MOST_EXPERIMENTS = 8
# Inputs more alike than this correlation share a quarter of their energy.
_LARGEST_CORRELATION = 0.5
# Share of the gap from which on it is mostly the same in all experiments.
_LEAST_SHARE = 0.5
# Standard deviations by which the gap of all experiments exceeds noise before shares of it are taken.
_CLEAR_OF_CHANCE = 3.0
# Lines of a common part that its peak is not looked for in: offset, drift, and the swing into a disturbance.
_SLOW_LINES = 3
# Held-out gap energy has to stand this many standard deviations clear before a share of it means anything.
# Chosen; at five the energy is known to a fifth.
_CLEAR = 5.0
# Standard deviations of a 95 % interval.
_Z95 = 1.96
# Poles besides the machine's own: dynamics that are missing in it, from a slow to a fast real pole, and two
# samples of delay. Chosen: a lag of 50, 10 or 2 samples, of those that drives and filters have.
_FREE_POLES = (0.98, 0.9, 0.6, 0.0, 0.0)
# Distance of a pole from the unit circle within which it is an integrator up to rounding.
_INTEGRATOR = 1e-7
# Imaginary part below which a pole is real up to rounding.
_REAL = 1e-12


def drift_findings(case: Case, residuals: Mapping[str, Real], level: float) -> tuple[DriftFinding, ...]:
    """Slope of every sensor's residual over time, with an offset of its own in every experiment.

    Slopes b_i of n experiments with information w_i = sum (t - mean t)^2: b = sum w b_i / sum w, and
    b / sqrt(sum w_i (b_i - b)^2 / ((n - 1) sum w)) is Student with n - 1 degrees of freedom if all scatter
    alike, whatever the colour of the residuals.

    Returns
    -------
    tuple of DriftFinding
        One per sensor; with fewer than three experiments without an interval, and never found.
    """
    dt = case.rig.sampling.dt_s
    information_of_each = []
    slope_of_each = []
    time_energy = 0.0
    for e in residuals.values():
        time = np.arange(e.shape[0]) * dt
        time_energy += float(time @ time)
        time -= time.mean()
        information_of_each.append(float(time @ time))
        slope_of_each.append(time @ e / information_of_each[-1])
    information = np.array(information_of_each)
    slopes = np.array(slope_of_each)  # (n, Y), noise deviations per second
    mean = information @ slopes / information.sum()

    findings = []
    for s, output in enumerate(case.outputs):
        sensor, unit = SENSORS[output]
        noise = float(case.noise[s])
        rate = float(mean[s] * noise)
        gap = sum(float(np.sum(e[:, s] ** 2)) - e.shape[0] for e in residuals.values())
        share = float(min(mean[s] ** 2 * time_energy / gap, 1.0)) if gap > 0 else 0.0
        freedom = information.size - 1
        if freedom < 2:
            findings.append(DriftFinding(sensor, unit, rate, share, None, 1.0, found=False))
            continue
        scatter = information @ (slopes[:, s] - mean[s]) ** 2
        error = float(np.sqrt(scatter / (freedom * information.sum()))) * noise
        p_value = float(2 * student.sf(abs(rate) / error, freedom)) if error > 0 else 1.0
        half = float(student.ppf(0.975, freedom)) * error
        beyond_chance = bool(p_value < level / len(case.outputs))
        interval = (rate - half, rate + half)
        findings.append(DriftFinding(sensor, unit, rate, share, interval, p_value, beyond_chance))
    return tuple(findings)


def amplitude_finding(
    case: Case, residuals: Mapping[str, Real], level: float, rng: np.random.Generator
) -> AmplitudeFinding | None:
    """Exponent of the gap over the input amplitude, from two experiments of one kind.

    With gaps g (RMS) at inputs of the sizes a: log(g_2 / g_1) / log(a_2 / a_1). Intervals by resampling
    half-second blocks of both; they do not know that another sequence excites the gap differently, so a
    quarter is added on either side before anything but proportion is claimed.

    Returns
    -------
    AmplitudeFinding or None
        None without two such experiments whose sizes differ, each of two blocks at least, or when either of
        them shows no gap beyond noise.
    """
    ratio = 0.0
    pair: tuple[Experiment, ...] = ()
    for low, high in permutations(case.experiments, 2):
        if low.closed_loop or high.closed_loop or low.kind != high.kind or not np.any(low.voltage_V):
            continue
        sizes = pooled_rms(high.voltage_V) / pooled_rms(low.voltage_V)
        if sizes > ratio:
            ratio = sizes
            pair = (low, high)
    if ratio < _LEAST_RATIO:
        return None

    outputs = len(case.outputs)
    block = max(round(_BLOCK_S / case.rig.sampling.dt_s), 1)
    gaps = []  # mean energy of a sample beyond noise
    drawn_gaps = []  # (draws,) the same of blocks drawn with replacement
    for experiment in pair:
        energy = np.sum(np.square(residuals[experiment.name]), axis=1)
        blocks = energy[: energy.size // block * block].reshape(-1, block).mean(axis=1)
        if blocks.size < 2:
            return None
        index = rng.integers(0, blocks.size, (_DRAWS, blocks.size))
        gap = float(energy.mean()) - outputs
        # sum of Y T squares of unit variance: variance 2 Y T, of the mean over T samples 2 Y / T
        if gap < _CLEAR_OF_NOISE * np.sqrt(2.0 * outputs / energy.size):
            return None
        gaps.append(gap)
        drawn_gaps.append(np.maximum(blocks[index].mean(axis=1) - outputs, _LEAST_DRAWN * gap))

    log_ratio = np.log(ratio)
    exponents = 0.5 * np.log(drawn_gaps[1] / drawn_gaps[0]) / log_ratio
    low_end, high_end = np.quantile(exponents, (level / 2, 1 - level / 2))
    growth = _growth((float(low_end) - _OTHER_SEQUENCE, float(high_end) + _OTHER_SEQUENCE))
    low_95, high_95 = np.quantile(exponents, (0.025, 0.975))
    return AmplitudeFinding(
        experiments=(pair[0].name, pair[1].name),
        voltage_ratio=ratio,
        gap_ratio=float(np.sqrt(gaps[1] / gaps[0])),
        exponent=float(0.5 * np.log(gaps[1] / gaps[0]) / log_ratio),
        interval=(float(low_95), float(high_95)),
        growth=growth,
        found=growth in ("offset", "saturating", "faster"),
    )


def _growth(interval: Interval) -> Growth:
    """What an interval of the exponent allows to say."""
    low, high = interval
    if high < _HALF_WAY:
        return "offset"
    if high < 1.0:
        return "saturating"
    if low > 1.0:
        return "faster"
    return "linear" if high - low < _SAYS_NOTHING else "undecided"


def common_findings(case: Case, residuals: Mapping[str, Real], level: float) -> tuple[CommonFinding, ...]:
    """The part of every sensor's gap that is the same in all experiments, whatever the input.

    For a gap that comes from the input the mean over n experiments with different inputs holds about 1/n of
    the energy; for one that comes with the clock it holds all.

    Found asks for more energy in the mean than noise leaves there (chi-square, exact), for half of the gap,
    and that no other choice of signs of the experiments gives as much.

    Returns
    -------
    tuple of CommonFinding
        One per sensor; empty with fewer than four experiments whose inputs differ.
    """
    chosen = _different_inputs(case.experiments)
    if len(chosen) < _LEAST_EXPERIMENTS:
        return ()
    n = len(chosen)
    dt = case.rig.sampling.dt_s
    length = min(experiment.voltage_V.size for experiment in chosen)
    e = np.stack([residuals[experiment.name][:length] for experiment in chosen])  # (n, T, Y)
    # The first sign is fixed: turning all of them changes nothing.
    signs = np.array([(1.0, *other_signs) for other_signs in product((1.0, -1.0), repeat=n - 1)])
    findings = []
    for s, sensor in enumerate(sensors_of(case)):
        # Energy of the mean, over all choices of signs, from the products of the experiments.
        products = e[:, :, s] @ e[:, :, s].T
        energy = np.einsum("ki,ij,kj->k", signs, products, signs) / n
        p_value = float(chi2.sf(energy[0], length))
        gap = float(np.trace(products)) - n * length
        shares = np.zeros(energy.size)
        if gap > _CLEAR_OF_CHANCE * np.sqrt(2.0 * n * length):
            # The mean's noise can make it more than the gap, or less than nothing.
            shares = np.clip((energy - length) / gap, 0.0, 1.0)
        share = float(shares[0])
        by_chance = float(np.max(shares[1:]))
        beyond_noise = p_value < level / len(case.outputs)

        power = np.abs(np.fft.rfft(e[:, :, s].mean(axis=0))) ** 2
        power[1:] *= 2.0  # both signs of a frequency; an offset has one
        top = int(np.argmax(power[_SLOW_LINES:])) + _SLOW_LINES
        findings.append(
            CommonFinding(
                sensor=sensor,
                experiments=n,
                share=share,
                share_by_chance=by_chance,
                peak_Hz=float(top / (length * dt)),
                peak_share=float(power[top - 1 : top + 2].sum() / power.sum()),
                p_value=p_value,
                found=bool(beyond_noise and share >= _LEAST_SHARE and share > by_chance),
            )
        )
    return tuple(findings)


def _different_inputs(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Experiments whose voltages hardly resemble each other, longest first, at most eight."""
    chosen: list[Experiment] = []
    for experiment in sorted(experiments, key=lambda e: -e.voltage_V.size):
        alike = (_correlation(experiment.voltage_V, other.voltage_V) for other in chosen)
        if all(abs(correlation) < _LARGEST_CORRELATION for correlation in alike):
            chosen.append(experiment)
    return chosen[:_MOST_EXPERIMENTS]


def _correlation(a: Real, b: Real) -> float:
    """Cosine of two voltages over their common length; resting inputs resemble each other."""
    length = min(a.size, b.size)
    a, b = a[:length], b[:length]
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0 else 1.0


def linear_correction(case: Case, residuals: Mapping[str, Real]) -> LinearCorrection | None:
    """Share of the gap that any linear correction of the model, from voltage to sensors, takes away.

    Fitted to the residuals of the estimation records and judged on the held-out ones, on basis functions with
    the nominal poles taken twice (the change of a response with its poles to first order), one and two
    integrators, and free real poles for what the nominal model lacks.

    Returns
    -------
    LinearCorrection or None
        None if the gap of the estimation or of the held-out records is too small to take shares of.
    """
    for records in (case.estimation, case.held_out):
        whole = Energy.of(residuals[record.name] for record in records)
        if not whole.gap > _CLEAR * np.sqrt(2.0 * whole.count):
            return None

    z = np.exp(linear_arm(case.rig).poles() * case.rig.sampling.dt_s)
    # The integrator of the hub enters as summed input: a pole inside the circle cannot stand for it.
    inside = z[np.abs(z) < 1 - _INTEGRATOR]
    real = inside.real[np.abs(inside.imag) < _REAL]
    pairs = inside[inside.imag >= _REAL]
    poles = Poles(np.concatenate([np.repeat(real, 2), _FREE_POLES]), np.repeat(pairs, 2))

    columns = np.vstack([_columns(poles, record.voltage_V) for record in case.estimation])
    targets = np.vstack([residuals[record.name] for record in case.estimation])
    scale = np.sqrt(np.mean(columns**2, axis=0))
    scale[scale == 0] = 1.0
    coefficients, *_ = np.linalg.lstsq(columns / scale, targets, rcond=1e-8)

    gap = 0.0
    taken = 0.0
    predicted_energy = 0.0
    for record in case.held_out:
        e = residuals[record.name]
        prediction = _columns(poles, record.voltage_V) / scale @ coefficients
        gap += float(np.sum(e**2)) - e.size
        taken += float(np.sum(e**2) - np.sum((e - prediction) ** 2))
        predicted_energy += float(np.sum(prediction**2))
    # e = gap + noise: the energy taken, 2 e.p - p.p, moves with the noise by 2 |p|.
    half = _Z95 * 2 * np.sqrt(predicted_energy) / gap
    share, low, high = np.clip(taken / gap + np.array([0.0, -half, half]), 0.0, 1.0)
    return LinearCorrection(float(share), (float(low), float(high)))


def _columns(poles: Poles, voltage: Real) -> Real:
    """(T, B + 2): basis functions driven by the voltage, and the voltage summed once and twice."""
    once = np.concatenate([[0.0], np.cumsum(voltage)[:-1]])
    twice = np.concatenate([[0.0], np.cumsum(once)[:-1]])
    return np.column_stack([regressor(poles, voltage), once, twice])
