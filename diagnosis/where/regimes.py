"""Residual energy by regime: direction and size of hub speed, reversals, angle, deflection, command, time.

Regime variables are those of the model, which do not depend on the noise whose energy is sorted by them. The
test is by circular shifts in time of the energy against the regime, inside every experiment: exact when there
is only noise, and it keeps the colour of a gap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from diagnosis.where.findings import RegimeBin, RegimeFinding, RegimePeak

Integer = npt.NDArray[np.int64]
Booleans = npt.NDArray[np.bool_]

# Circular shifts: p-values down to 2e-4; seven axes of two sensors at 1 % ask each for 7e-4. So many shifts
# answer 49 questions at 1 %, twice as many 99, in twice the time.
_SHIFTS = 4999
# Samples of a bin: a mean of squares of white noise is then known to a fifth, sqrt(2 / 60).
_LEAST_SAMPLES = 60
# Near a reversal: three samples at 100 Hz, and a short part of any motion of an arm. Chosen; doubled, the
# bin holds more motion that is none.
_REVERSAL_S = 0.03
# Part of the largest speed below which a sign is rounding. Ten times as much makes a slow swing no reversal.
_MOVES = 1e-3
# A regime whose gap differs by less than this ratio is beyond chance, but nothing to tell anybody. Chosen;
# doubled (1.5), a page names only what doubles the energy.
_LEAST_RATIO = 1.25
# Bins of a variable: five parts of the data are each large enough for a peak. Chosen; with ten, short records
# lack the samples.
_BINS = 5
# Part of the largest value of a signal that counts as neither sign: a tenth of what moves slowly. Chosen.
_STILL = 0.01
# Part of a variable's span by which a cut lies above a value that many samples share: rounding, and no more.
_ABOVE = 1e-9
# Relative differences of scores that count as a tie: rounding of the FFT.
_TIE = 1e-9
# Spread of a bin's energy, over the largest mean, below which it does not vary: rounding of the FFT.
_NO_SPREAD = 1e-9
# Below this a speed or an energy is zero, whatever its unit: it keeps a ratio finite.
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class Motion:
    """Regime variables of one experiment, all (T,), from the model.

    deflection_m : of the tip from the straight link; None where the tip is not measured.
    near_reversal : within 30 ms of a change of the hub's direction.
    """

    angle_rad: Real
    speed_rad_s: Real
    deflection_m: Real | None
    command_V: Real
    time_s: Real
    near_reversal: npt.NDArray[np.bool_]


def motions(case: Case, residuals: Mapping[str, Real]) -> dict[str, Motion]:
    """What the model did in every experiment, from residuals (T, Y) over the noise.

    Raises
    ------
    ValueError
        An experiment of the case has no residuals, or they are not (T, Y) and finite.
    """
    dt = case.rig.sampling.dt_s
    reach = case.rig.hub.radius_m + case.rig.link.length_m
    motion_by_name = {}
    for experiment in case.experiments:
        if experiment.name not in residuals:
            raise ValueError(f"case {case.name}: no residuals of experiment {experiment.name}")
        e = np.asarray(residuals[experiment.name], dtype=np.float64)
        if e.shape != experiment.output.shape or not np.all(np.isfinite(e)):
            raise ValueError(
                f"case {case.name}: residuals of {experiment.name} must be finite and "
                f"{experiment.output.shape}; got {e.shape}"
            )
        modelled = dict(zip(case.outputs, (experiment.output - e * case.noise).T, strict=True))
        angle = modelled["hub_angle_rad"]
        tip = modelled.get("tip_m")
        speed = np.gradient(angle, dt)
        motion_by_name[experiment.name] = Motion(
            angle_rad=angle,
            speed_rad_s=speed,
            deflection_m=None if tip is None else tip - reach * angle,
            command_V=experiment.voltage_V,
            time_s=np.arange(angle.size) * dt,
            near_reversal=_near_reversal(speed, dt),
        )
    return motion_by_name


def _near_reversal(speed: Real, dt_s: float) -> Booleans:
    """(T,) samples within 30 ms of a change of sign of a speed (T,) between stretches that really move."""
    moves = np.abs(speed) > _MOVES * max(float(np.max(np.abs(speed))), _TINY)
    sign = np.where(moves, np.sign(speed), 0.0)
    near = np.zeros(speed.size, dtype=bool)
    width = max(round(_REVERSAL_S / dt_s), 1)
    for before, after in pairwise(np.flatnonzero(sign)):
        if sign[before] != sign[after]:
            near[max(before - width + 1, 0) : after + width] = True
    return near


@dataclass(frozen=True, eq=False)
class RegimeAxis:
    """A regime variable cut into K bins.

    titles, edges : of every bin, in words and (low, high) in the unit.
    labels : experiment -> (T,) bin of every sample, -1 outside every bin.
    """

    name: str
    unit: str
    titles: tuple[str, ...]
    edges: tuple[tuple[float, float], ...]
    labels: Mapping[str, Integer]


def regime_axes(motion_by_name: Mapping[str, Motion], bins: int = _BINS) -> tuple[RegimeAxis, ...]:
    """Axes of a flexible link whose bins hold at least 60 samples each.

    Bins of an axis have about equal sample counts, those of the time equal length. An axis without values (a
    deflection that nobody measures), or with fewer samples in a bin, is left out.
    """
    speed = {name: motion.speed_rad_s for name, motion in motion_by_name.items()}
    angle = {name: motion.angle_rad for name, motion in motion_by_name.items()}
    command = {name: motion.command_V for name, motion in motion_by_name.items()}
    time = {name: motion.time_s for name, motion in motion_by_name.items()}
    deflection = {
        name: motion.deflection_m
        for name, motion in motion_by_name.items()
        if motion.deflection_m is not None
    }
    reversals = RegimeAxis(
        name="reversal",
        unit="",
        titles=("away from reversals", "near reversals"),
        edges=((0.0, 1.0), (1.0, 2.0)),
        labels={name: motion.near_reversal.astype(np.int64) for name, motion in motion_by_name.items()},
    )
    axes = [
        _directions("speed_sign", "rad/s", ("backwards", "forwards"), speed),
        _quantiles("speed_size", "rad/s", _sizes(speed), bins),
        reversals,
        _quantiles("angle", "rad", angle, bins),
        _quantiles("deflection", "m", deflection, bins),
        _quantiles("command_size", "V", _sizes(command), bins),
        _stretches(time, bins + 1),
    ]
    return tuple(axis for axis in axes if axis is not None and _enough(axis))


def axes_of_output(
    case: CaseOfMachine, residuals: Mapping[str, Real], dt_s: float, k: int, bins: int = _BINS
) -> tuple[RegimeAxis, ...]:
    """Axes of any machine, for the residuals of its k-th output.

    The output's value, rate and direction as simulated; size and direction of every input; time in the
    record. Rows that are missing are in no bin.

    Parameters
    ----------
    case : CaseOfMachine
    residuals : experiment -> (T, Y) array
        (measured - model) / noise.
    dt_s : float
        Sampling period [s].
    """
    output = case.machine.output_names[k]
    experiments = {experiment.name: experiment for experiment in case.experiments}
    value = {
        name: experiment.output[:, k] - residuals[name][:, k] * case.noise[k]
        for name, experiment in experiments.items()
    }
    rate = {name: np.asarray(np.gradient(v, dt_s)) for name, v in value.items()}
    time = {name: np.asarray(np.arange(len(v)) * dt_s) for name, v in value.items()}
    falls_or_rises = (f"where {output} falls", f"where {output} rises")
    possible_axes = [
        _quantiles(f"value of {output}", "", value, bins, f"where {output} is"),
        _directions(f"direction of {output}", "", falls_or_rises, rate),
        _quantiles(f"rate of {output}", "per s", _sizes(rate), bins, f"where {output} changes by"),
        _stretches(time, bins + 1),
    ]
    columns = case.experiments[0].input.shape[1]
    input_names = case.machine.input_names or [f"input {j + 1}" for j in range(columns)]
    for j, name in enumerate(input_names):
        command = {record: experiment.input[:, j] for record, experiment in experiments.items()}
        signs = (f"where {name} < 0", f"where {name} > 0")
        size_words = f"where {name} has a size of"
        possible_axes.append(_directions(f"sign of {name}", "", signs, command))
        possible_axes.append(_quantiles(f"size of {name}", "", _sizes(command), bins, size_words))

    axes = [axis for axis in possible_axes if axis is not None]
    for axis in axes:
        for name, experiment in experiments.items():
            axis.labels[name][list(getattr(experiment, "missing", ()))] = -1
    return tuple(axis for axis in axes if _enough(axis))


def _sizes(values: Mapping[str, Real]) -> dict[str, Real]:
    """Experiment -> (T,) absolute values."""
    return {name: np.abs(v) for name, v in values.items()}


def _directions(
    name: str, unit: str, titles: tuple[str, str], values: Mapping[str, Real]
) -> RegimeAxis | None:
    """Bins below zero and above, of values (T,); a hundredth of the largest is neither.

    None where all values are zero.
    """
    largest = max(float(np.max(np.abs(v))) for v in values.values())
    if largest == 0:
        return None
    still = _STILL * largest
    labels = {record: np.where(v > still, 1, np.where(v < -still, 0, -1)) for record, v in values.items()}
    return RegimeAxis(name, unit, titles, ((-largest, -still), (still, largest)), labels)


def _enough(axis: RegimeAxis) -> bool:
    """Whether an axis has two bins at least, each with 60 samples."""
    counts = np.zeros(len(axis.titles), dtype=int)
    for labels in axis.labels.values():
        counts += np.bincount(labels[labels >= 0], minlength=counts.size)
    return len(axis.titles) >= 2 and bool(np.all(counts >= _LEAST_SAMPLES))


def _quantiles(
    name: str, unit: str, values: Mapping[str, Real], bins: int, words: str = "at"
) -> RegimeAxis | None:
    """Bins of about equal count over all experiments; None without values or if all are equal.

    Many equal values (a binary voltage) make fewer bins, none of them with less than half the mean count.

    values : experiment -> (T,). words : what stands before a bin's edges in its title.
    """
    if not values:
        return None
    everything = np.concatenate(list(values.values()))
    span = float(np.ptp(everything))
    cuts: list[float] = []
    last = float(np.min(everything))
    for q in np.linspace(0, 1, bins + 1)[1:-1]:
        cut = float(np.quantile(everything, q))
        # A cut on a value many samples share goes above it: the bin below keeps them together.
        cut = float(np.nextafter(cut + _ABOVE * span, np.inf))
        below = np.count_nonzero((everything >= last) & (everything < cut))
        above = np.count_nonzero(everything >= cut)
        if min(below, above) >= everything.size / (2 * bins):
            cuts.append(cut)
            last = cut
    if not cuts:
        return None
    edges = tuple(pairwise((float(np.min(everything)), *cuts, float(np.max(everything)))))
    labels = {record: np.searchsorted(cuts, v, side="right") for record, v in values.items()}
    titles = tuple(f"{words} {low:.3g} to {high:.3g} {unit}".rstrip() for low, high in edges)
    return RegimeAxis(name, unit, titles, edges, labels)


def _stretches(time: Mapping[str, Real], bins: int) -> RegimeAxis:
    """Equal stretches of the time (T,) since the start, to the end of the longest record."""
    longest = max(float(t[-1]) for t in time.values())
    # The last sample belongs to the last stretch.
    cuts = np.linspace(0.0, longest * (1 + _ABOVE), bins + 1)
    labels = {name: np.searchsorted(cuts[1:-1], t, side="right") for name, t in time.items()}
    edges = tuple((float(low), float(high)) for low, high in pairwise(cuts))
    titles = tuple(f"{low:.2g} to {high:.2g} s after the start" for low, high in edges)
    return RegimeAxis("time", "s", titles, edges, labels)


def regime_findings(
    residuals: Mapping[str, Real],
    sensors: Sequence[str],
    axes: Sequence[RegimeAxis],
    level: float,
    rng: np.random.Generator,
) -> tuple[RegimeFinding, ...]:
    """One finding per axis and sensor; all of them together raise a false alarm with the chance `level`.

    Parameters
    ----------
    residuals : experiment -> (T, Y) array
    sensors : sequence of str, length Y
    axes : sequence of RegimeAxis
        With labels of the same experiments.
    level : float
    rng : numpy Generator
        Of the shifts.

    Returns
    -------
    tuple of RegimeFinding
        Empty where so many questions are asked that no number of shifts answers one beyond chance.
    """
    each = level / max(len(axes) * len(sensors), 1)
    if each * (_SHIFTS + 1) <= 1:
        return ()
    findings: list[RegimeFinding] = []
    for axis in axes:
        sums, counts = _shifted_energy(residuals, axis, rng)
        for s, sensor in enumerate(sensors):
            findings.append(_finding(axis, sensor, sums[:, s], counts, each))
    return tuple(findings)


def _shifted_energy(
    residuals: Mapping[str, Real], axis: RegimeAxis, rng: np.random.Generator
) -> tuple[Real, Integer]:
    """Energy (1 + shifts, Y, K) by bin, row 0 as recorded, and samples (K,) of every bin.

    All circular shifts of one experiment are one correlation by FFT; experiments shift independently.
    """
    K = len(axis.titles)
    sums = np.zeros((_SHIFTS + 1, next(iter(residuals.values())).shape[1], K))
    counts = np.zeros(K, dtype=np.int64)
    for name, labels in axis.labels.items():
        T = labels.size
        inside = (labels[None, :] == np.arange(K)[:, None]).astype(np.float64)
        counts += inside.sum(axis=1).astype(np.int64)
        energy = np.fft.rfft(np.square(residuals[name]).T, axis=1)
        # correlation[s, b, k] = sum_t inside[b, t] energy[s, t + k]
        correlation = np.fft.irfft(np.conj(np.fft.rfft(inside, axis=1))[None] * energy[:, None], T, axis=2)
        shifts = np.concatenate([[0], rng.integers(0, T, _SHIFTS)])
        sums += np.moveaxis(correlation[:, :, shifts], 2, 0)
    return sums, counts


def _finding(axis: RegimeAxis, sensor: str, sums: Real, counts: Integer, level: float) -> RegimeFinding:
    """The finding of one axis and sensor, from energies (1 + shifts, K) and samples (K,) of the bins."""
    mean = sums / counts
    centre = mean.mean(axis=0)
    spread = mean.std(axis=0)
    usable = spread > _NO_SPREAD * max(float(centre.max()), _TINY)
    # Where no shift changes anything, nothing can depend on the axis.
    p_value = 1.0
    contrast = 0.0
    if np.any(usable):
        score = np.max(np.abs(mean[:, usable] - centre[usable]) / spread[usable], axis=1)
        # The recorded order counts among the shifts (Phipson and Smyth 2010), and so do ties within rounding.
        p_value = float(np.mean(score >= score[0] * (1 - _TIE)))
        contrast = float(score[0])
    low, high = np.quantile(mean, (0.025, 0.975), axis=0)
    bins = tuple(
        RegimeBin(
            label=axis.titles[k],
            low=axis.edges[k][0],
            high=axis.edges[k][1],
            samples=int(counts[k]),
            energy=float(mean[0, k]),
            interval=(float(low[k]), float(high[k])),
        )
        for k in range(len(axis.titles))
    )
    beyond_chance = bool(p_value < level)
    peak = _peak(axis, mean[0], centre, spread) if beyond_chance else None
    return RegimeFinding(axis.name, axis.unit, sensor, bins, p_value, beyond_chance, peak, contrast)


def _peak(axis: RegimeAxis, mean: Real, centre: Real, spread: Real) -> RegimePeak | None:
    """The bin that stands out most, above or below; None where its gap is about the usual one.

    mean, centre, spread : (K,) energy as recorded, and mean and standard deviation over the shifts.
    """
    excess = (mean - centre) / np.where(spread > 0, spread, np.inf)
    highest = int(np.argmax(excess))
    lowest = int(np.argmin(excess))
    top = highest if excess[highest] >= -excess[lowest] else lowest
    # Ratios of rms beyond the noise, which is what a person sees in a plot.
    gap_rms = float(np.sqrt(max(mean[top] - 1.0, 0.0)))
    usual = float(np.sqrt(max(centre[top] - 1.0, 0.0)))
    if max(gap_rms, usual) < _LEAST_RATIO * min(gap_rms, usual):
        return None
    return RegimePeak(axis.titles[top], gap_rms, usual)
