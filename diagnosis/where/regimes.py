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
_SHIFTS = 4999  # p-values down to 2e-4; seven axes of two sensors at 1 % ask each for 7e-4
_LEAST_SAMPLES = 60  # a mean of squares of white noise is then known to a fifth, sqrt(2 / 60)
_REVERSAL_S = 0.03  # three samples at 100 Hz, and a short part of any motion of an arm
# A regime whose gap differs by less is beyond chance, but nothing to tell anybody.
_LEAST_RATIO = 1.25


@dataclass(frozen=True, eq=False)
class Motion:
    """Regime variables of one experiment, all (T,), from the model; the tip's only where it is measured."""

    angle_rad: Real
    speed_rad_s: Real
    deflection_m: Real | None
    position_m: Real | None
    command_V: Real
    time_s: Real
    near_reversal: npt.NDArray[np.bool_]


def motions(case: Case, residuals: Mapping[str, Real]) -> dict[str, Motion]:
    """What the model did in every experiment that has residuals.

    Raises ValueError if an experiment of the case has no residuals, or they are not (T, Y) and finite.
    """
    dt = case.rig.sampling.dt_s
    reach = case.rig.hub.radius_m + case.rig.link.length_m
    found = {}
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
        angle, tip = modelled["hub_angle_rad"], modelled.get("tip_m")
        speed = np.gradient(angle, dt)
        found[experiment.name] = Motion(
            angle,
            speed,
            None if tip is None else tip - reach * angle,
            tip,
            experiment.voltage_V,
            np.arange(angle.size) * dt,
            _near_reversal(speed, dt),
        )
    return found


def _near_reversal(speed: Real, dt_s: float) -> npt.NDArray[np.bool_]:
    """Samples within 30 ms of a change of sign of the hub speed between stretches that really move."""
    sign = np.where(np.abs(speed) > 1e-3 * max(float(np.max(np.abs(speed))), 1e-12), np.sign(speed), 0.0)
    index = np.flatnonzero(sign)
    near = np.zeros(speed.size, dtype=bool)
    width = max(round(_REVERSAL_S / dt_s), 1)
    for before, after in pairwise(index):
        if sign[before] != sign[after]:
            near[max(before - width + 1, 0) : after + width] = True
    return near


@dataclass(frozen=True, eq=False)
class RegimeAxis:
    """A regime variable cut into bins: label per sample (-1 outside every bin) and experiment."""

    name: str
    unit: str
    titles: tuple[str, ...]
    edges: tuple[tuple[float, float], ...]
    labels: Mapping[str, Integer]


def regime_axes(moved: Mapping[str, Motion], bins: int = 5) -> tuple[RegimeAxis, ...]:
    """Axes whose bins hold at least 60 samples each: bins of equal sample count, time in equal stretches."""
    names = list(moved)

    def of(attribute: str, size: bool = False) -> dict[str, Real]:
        values = {name: getattr(moved[name], attribute) for name in names}
        values = {name: v for name, v in values.items() if v is not None}
        return {name: np.abs(v) for name, v in values.items()} if size else values

    axes = [
        _directions("speed_sign", "rad/s", ("backwards", "forwards"), of("speed_rad_s")),
        _quantiles("speed_size", "rad/s", of("speed_rad_s", True), bins),
        RegimeAxis(
            "reversal",
            "",
            ("away from reversals", "near reversals"),
            ((0.0, 1.0), (1.0, 2.0)),
            {name: moved[name].near_reversal.astype(np.int64) for name in names},
        ),
        _quantiles("angle", "rad", of("angle_rad"), bins),
        _quantiles("deflection", "m", of("deflection_m"), bins),
        _quantiles("command_size", "V", of("command_V", True), bins),
        _stretches(of("time_s"), bins + 1),
    ]
    return tuple(axis for axis in axes if axis is not None and _enough(axis))


def axes_of_output(
    case: CaseOfMachine, residuals: Mapping[str, Real], dt_s: float, k: int, bins: int = 5
) -> tuple[RegimeAxis, ...]:
    """Of any machine, for residuals (T, Y) of its k-th output: its value, rate and direction as simulated,
    size and direction of every input, time in the record. Rows that are missing are in no bin."""
    output, every = case.machine.output_names[k], {e.name: e for e in case.experiments}
    value = {name: e.output[:, k] - residuals[name][:, k] * case.noise[k] for name, e in every.items()}
    rate = {name: np.asarray(np.gradient(v, dt_s)) for name, v in value.items()}
    axes = [
        _quantiles(f"value of {output}", "", value, bins, f"where {output} is"),
        _directions(f"direction of {output}", "", (f"where {output} falls", f"where {output} rises"), rate),
        _quantiles(
            f"rate of {output}",
            "per s",
            {name: np.abs(v) for name, v in rate.items()},
            bins,
            f"where {output} changes by",
        ),
        _stretches({name: np.asarray(np.arange(len(v)) * dt_s) for name, v in value.items()}, bins + 1),
    ]
    for j, called in enumerate(
        case.machine.input_names or [f"input {j + 1}" for j in range(case.experiments[0].input.shape[1])]
    ):
        u = {name: e.input[:, j] for name, e in every.items()}
        signs = f"where {called} < 0", f"where {called} > 0"
        axes += [
            _directions(f"sign of {called}", "", signs, u),
            _quantiles(
                f"size of {called}",
                "",
                {name: np.abs(v) for name, v in u.items()},
                bins,
                f"where {called} has a size of",
            ),
        ]
    for axis in (axis for axis in axes if axis is not None):
        for name, e in every.items():
            axis.labels[name][list(getattr(e, "missing", ()))] = -1
    return tuple(axis for axis in axes if axis is not None and _enough(axis))


def _directions(
    name: str, unit: str, titles: tuple[str, str], values: Mapping[str, Real]
) -> RegimeAxis | None:
    """Below zero and above; a hundredth of the largest value is neither. None without values."""
    largest = max(float(np.max(np.abs(v))) for v in values.values())
    still = 0.01 * largest
    labels = {n: np.where(v > still, 1, np.where(v < -still, 0, -1)) for n, v in values.items()}
    return RegimeAxis(name, unit, titles, ((-largest, -still), (still, largest)), labels) if largest else None


def _enough(axis: RegimeAxis) -> bool:
    counts = np.zeros(len(axis.titles), dtype=int)
    for labels in axis.labels.values():
        counts += np.bincount(labels[labels >= 0], minlength=counts.size)
    return len(axis.titles) >= 2 and bool(np.all(counts >= _LEAST_SAMPLES))


def _quantiles(
    name: str, unit: str, values: Mapping[str, Real], bins: int, words: str = "at"
) -> RegimeAxis | None:
    """Bins of about equal count over all experiments; None without values or if all are equal.

    Many equal values (a binary voltage) make fewer bins, none of them with less than half the mean count.
    """
    if not values:
        return None
    everything = np.concatenate(list(values.values()))
    span = float(np.ptp(everything))
    inner: list[float] = []
    last = float(np.min(everything))
    for q in np.linspace(0, 1, bins + 1)[1:-1]:
        cut = float(np.quantile(everything, q))
        # A cut on a value many samples share goes above it: the bin below keeps them together.
        cut = float(np.nextafter(cut + 1e-9 * span, np.inf))
        below = np.count_nonzero((everything >= last) & (everything < cut))
        if min(below, np.count_nonzero(everything >= cut)) >= everything.size / (2 * bins):
            inner.append(cut)
            last = cut
    if not inner:
        return None
    edges = tuple(pairwise((float(np.min(everything)), *inner, float(np.max(everything)))))
    labels = {name: np.searchsorted(inner, v, side="right") for name, v in values.items()}
    titles = tuple(f"{words} {a:.3g} to {b:.3g} {unit}".rstrip() for a, b in edges)
    return RegimeAxis(name, unit, titles, edges, labels)


def _stretches(time: Mapping[str, Real], bins: int) -> RegimeAxis:
    edges = np.linspace(0.0, max(float(t[-1]) for t in time.values()) * (1 + 1e-9), bins + 1)
    labels = {name: np.searchsorted(edges[1:-1], t, side="right") for name, t in time.items()}
    pairs = tuple((float(a), float(b)) for a, b in pairwise(edges))
    titles = tuple(f"{a:.2g} to {b:.2g} s after the start" for a, b in pairs)
    return RegimeAxis("time", "s", titles, pairs, labels)


def regime_findings(
    residuals: Mapping[str, Real],
    sensors: Sequence[str],
    axes: Sequence[RegimeAxis],
    level: float,
    rng: np.random.Generator,
) -> tuple[RegimeFinding, ...]:
    """One finding per axis and sensor; all of them together raise a false alarm with the chance `level`."""
    each, found = level / max(len(axes) * len(sensors), 1), list[RegimeFinding]()
    if each * (_SHIFTS + 1) <= 1:  # of so many questions no answer is beyond chance
        return ()
    for axis in axes:
        sums, counts = _shifted_energy(residuals, axis, rng)
        found += [_finding(axis, sensor, sums[:, s], counts, each) for s, sensor in enumerate(sensors)]
    return tuple(found)


def _shifted_energy(
    residuals: Mapping[str, Real], axis: RegimeAxis, rng: np.random.Generator
) -> tuple[Real, Integer]:
    """Energy (1 + shifts, sensor, bin), row 0 as recorded, and samples (bin,).

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
        sums += np.moveaxis(correlation[:, :, np.concatenate([[0], rng.integers(0, T, _SHIFTS)])], 2, 0)
    return sums, counts


def _finding(axis: RegimeAxis, sensor: str, sums: Real, counts: Integer, level: float) -> RegimeFinding:
    mean = sums / counts
    centre, spread = mean.mean(axis=0), mean.std(axis=0)
    usable = spread > 1e-9 * max(float(centre.max()), 1e-12)
    if not np.any(usable):
        p_value, contrast = 1.0, 0.0
    else:
        score = np.max(np.abs(mean[:, usable] - centre[usable]) / spread[usable], axis=1)
        # The recorded order counts among the shifts (Phipson and Smyth 2010), and so do ties within rounding.
        p_value = float(np.mean(score >= score[0] * (1 - 1e-9)))
        contrast = float(score[0])
    low, high = np.quantile(mean, (0.025, 0.975), axis=0)
    found = bool(p_value < level)
    bins = tuple(
        RegimeBin(title, edge[0], edge[1], int(n), float(value), (float(a), float(b)))
        for title, edge, n, value, a, b in zip(
            axis.titles, axis.edges, counts, mean[0], low, high, strict=True
        )
    )
    peak = _peak(axis, mean[0], centre, spread) if found else None
    return RegimeFinding(axis.name, axis.unit, sensor, bins, p_value, found, peak, contrast)


def _peak(axis: RegimeAxis, mean: Real, centre: Real, spread: Real) -> RegimePeak | None:
    excess = (mean - centre) / np.where(spread > 0, spread, np.inf)
    top = int(np.argmax(excess)) if excess.max() >= -excess.min() else int(np.argmin(excess))
    # Ratios of rms beyond the noise, which is what a person sees in a plot.
    here, usual = (float(np.sqrt(max(v - 1.0, 0.0))) for v in (mean[top], centre[top]))
    if max(here, usual) < _LEAST_RATIO * min(here, usual):
        return None
    return RegimePeak(axis.titles[top], here, usual)
