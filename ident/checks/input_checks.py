"""What the records themselves say about a fit: unusable ones are refused, doubtful ones get advice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import detrend
from scipy.special import chdtri

from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.checks.early_checks import FEWEST_LINES, STILL_INPUT, STILL_OUTPUT, clipped, refuse_hopeless
from ident.data.arrays import ComplexArray, RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.record import Record
from ident.fit.least_squares import Regression
from ident.fit.problem import residual_colour
from ident.fit.refinement import pole_system

# An input is there at a frequency with this share of the density of an input spread evenly up to Nyquist ...
_WEAK_INPUT = 1e-2
# ... or if the response over a third of that frequency can be told to 30 %: power of the model over the rest,
# times the spectral lines there; never below a share of its largest density, where windows leak.
_TOLD = 10.0
_LEAKAGE = 1e-6  # -60 dB: side lobes of a Hann window from its seventh line on
# A rate of decay within this factor either way (95 %) is known; beyond, the record does not tell it.
_KNOWN_WITHIN = 2.0
# Real poles with time constants above this share of the record count as slow; others have their own advice.
_SLOW = 0.5
# A straight line has to be this much of a residual's power, and this improbable, to be called a drift.
_DRIFT_SHARE = 0.2
_DRIFT_LEVEL = 1e-5  # one false alarm in 100 000 records
# A line serves as well as a slow pole if it leaves at most this much more.
_AS_WELL = 1.05
# Inputs are one signal if a combination of them, each scaled to unit length, has less of the power.
_SAME_INPUT = 1e-12
# Inputs are alike in a band where a combination of them, each of unit power there, has less of it ...
_ALIKE_INPUT = 1e-2
# ... by lines whose power is worth `FEWEST_LINES` an input (independent inputs then have ten times as much in
# a combination), within an octave. An input rests at lines with less than _LEAKAGE of its mean density.
_CELLS = 12  # of a twelfth of an octave
_LEAST_CELLS = 4  # poles bridge a band of less than a third of an octave
# Deviations from an operating point this many times larger are lost beside it.
_LARGE_OFFSET = 10.0


def refuse_unusable(records: Sequence[Record], data: Regression, order: int) -> None:
    """Raise ValueError for an output without variation, inputs that cannot be told apart, or too few samples
    for `order` poles; names the record.

    A single input varies in every record, each of several in one of them at least.
    """
    names = records[0].input_names
    if len(names) == 1:
        refuse_hopeless(records, [STILL_INPUT])
    refuse_hopeless(records, [STILL_OUTPUT])
    for i, name in enumerate(names):
        if all(np.ptp(record.input[:, i]) == 0 for record in records):
            raise ValueError(
                f"{records[0].label}: input column '{name}' is constant in every record; "
                "expected a signal that varies in at least one"
            )
    if least_independence(data) <= _SAME_INPUT:
        raise ValueError(
            f"{records[0].label}: the inputs {list(names)} are linearly dependent, so their channels cannot "
            "be distinguished; expected independent signals"
        )
    needed = data.n_parameters(order)
    if not data.n_samples > needed:
        labels = records[0].label if len(records) == 1 else f"{len(records)} records"
        raise ValueError(
            f"{labels}: {data.n_samples} samples are too few for order {order}, which has {needed} unknowns; "
            f"expected at least {needed + 1}"
        )


def least_independence(data: Regression) -> float:
    """Least power of a unit combination of the inputs, each of unit length: 1 uncorrelated, 0 dependent."""
    if data.n_inputs == 1:
        return 1.0
    rows = data.u / np.linalg.norm(data.u, axis=1, keepdims=True)
    return float(np.linalg.eigvalsh(rows @ rows.T)[0])


def alike_inputs(records: Sequence[Record]) -> list[Finding]:
    """Where several inputs move in fewer directions than there are inputs: which inputs, the rank of their
    spectra, summed over all records, and the widest band of each such group."""
    names, dt_s = records[0].input_names, records[0].dt_s
    each = [detrend(one.input, axis=0) * np.hanning(len(one.input))[:, None] for one in records]
    if len(names) == 1:
        return []
    lines = np.concatenate([np.fft.rfft(moved, axis=0)[1:] / np.sqrt(len(moved)) for moved in each])
    omega = np.concatenate([2 * np.pi * np.fft.rfftfreq(len(moved), dt_s)[1:] for moved in each])
    lines /= np.sqrt(np.mean(np.abs(lines) ** 2, axis=0))
    cell = np.floor(_CELLS * np.log2(omega / omega.min()) + 1e-9).astype(int)  # of a twelfth of an octave
    power, n_cells = np.sum(np.abs(lines) ** 2, axis=1), int(cell.max()) + 1
    sums = np.zeros((n_cells, len(names), len(names)), dtype=np.complex128)
    np.add.at(sums, cell, lines[:, :, None] * lines[:, None, :].conj())
    count, first, second = (np.bincount(cell, power**k, n_cells) for k in range(3))
    groups: dict[tuple[tuple[str, ...], int], tuple[int, int]] = {}
    start, band, group = 0, (0, 0), None
    for stop in range(1, n_cells + 1):
        start = max(start, stop - _CELLS)
        here = slice(start, stop)
        if first[here].sum() ** 2 < FEWEST_LINES * len(names) * second[here].sum():
            continue
        found = _dependent(sums[here].sum(axis=0) / count[here].sum())
        band = (band[0] if found == group and band[1] == start else start, stop)
        group, start = found, stop
        if group is not None:
            key = tuple(names[i] for i in group[0]), group[1]
            groups[key] = max(groups.get(key, (0, 0)), band, key=lambda ends: ends[1] - ends[0])
    return [
        finding(
            FindingKind.ALIKE_INPUTS, inputs=str(list(inputs)), rank=rank, count=len(names),
            low_rad_s=omega[cell == low].min(), high_rad_s=omega[cell < high].max(),
        )
        for (inputs, rank), (low, high) in groups.items()
        if high - low >= _LEAST_CELLS
    ]  # fmt: skip


def _dependent(spectrum: ComplexArray) -> tuple[tuple[int, ...], int] | None:
    """Inputs that rest or depend on one another by their spectral matrix (U, U), and its rank; None for full
    rank, or where every input rests."""
    size = np.diag(spectrum).real
    moved = np.flatnonzero(size > _LEAKAGE)
    unit = spectrum[np.ix_(moved, moved)] / np.sqrt(np.outer(size[moved], size[moved]))
    values, vectors = np.linalg.eigh(unit)
    rank = int(np.sum(values > _ALIKE_INPUT))
    if rank in (0, size.size):
        return None
    share = np.zeros(size.size)
    share[moved] = np.sum(np.abs(vectors[:, : moved.size - rank]) ** 2, axis=1)
    involved = (size <= _LEAKAGE) | (share > 0.05 * max(share.max(), 1e-300))
    return tuple(int(i) for i in np.flatnonzero(involved)), rank


def advice(
    records: Sequence[Record],
    data: Regression,
    model: GobfModel,
    residuals: Sequence[RealArray],
    fixed: Poles,
) -> list[Finding]:
    """One finding per doubt about the records behind a fitted model; residuals (T,); `fixed` poles come
    first."""
    limit = excitation_limit_rad_s(records, model, residuals)
    return [
        *few_samples(data, model.order),
        *_unknown_rates(data, model, fixed),
        *([finding(FindingKind.WEAK_INPUT, limit_rad_s=limit)] if limit < 0.6 * np.pi / data.dt_s else []),
        *clipped(records),
        *_drifting(records, data, model, residuals, fixed),
        *(
            finding(
                FindingKind.FAR_FROM_ZERO,
                record=record.label,
                input=record.input_names[0],
                mean=record.input.mean(),
                std=record.input.std(),
            )
            for record in ([] if data.structure.estimate_initial_state else records)
            if abs(record.input.mean()) > _LARGE_OFFSET * record.input.std()
        ),
    ]


def few_samples(data: Regression, order: int) -> list[Finding]:
    """Below ten samples per unknown the choice of the poles is itself uncertain."""
    needed = data.n_parameters(order)
    if data.n_samples >= 10 * needed:
        return []
    return [finding(FindingKind.FEW_SAMPLES, n_samples=data.n_samples, unknowns=needed)]


def _unknown_rates(data: Regression, model: GobfModel, fixed: Poles) -> list[Finding]:
    """Poles whose decay the records do not tell, by the Gauss-Newton covariance and the noise around them."""
    poles, dt_s = model.poles, model.dt_s
    n_real, n_pairs = fixed.counts
    here = data.linearise(*poles.writable())
    normal, _ = pole_system(here, poles, fixed)
    if normal.size == 0 or not data.n_samples > data.n_parameters(poles.order):
        return []
    size = np.diag(normal)
    # Poles that coincide leave an unknown without a size, up to rounding.
    scale = np.sqrt(np.maximum(size, max(1e-30 * float(size.max()), 1e-300)))
    inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    noise = here.rss / (data.n_samples - data.n_parameters(poles.order))
    deviation = np.sqrt(noise * np.maximum(np.diag(inverse), 0.0)) / scale
    # Unknowns of the polish: 1 - a of the real poles, then decay and angle per sample of each pair.
    n_free = poles.real.size - n_real
    still = 1.01e-3 / data.longest  # slower ones have come to the bound, which pole_warnings speaks of
    seconds = data.longest * dt_s
    residual = data.residual(poles)
    found = []
    for rate, spread in zip(1 - poles.real[n_real:], deviation[:n_free], strict=True):
        slow = still < rate < 1 / (_SLOW * data.longest)
        if slow and not _is_known(residual, data, rate / dt_s, spread / rate):
            found.append(
                finding(FindingKind.UNKNOWN_TIME_CONSTANT, time_constant_s=dt_s / rate, longest_s=seconds)
            )
    omegas = poles.omega_rad_s(dt_s)[n_pairs:]
    rates = -np.log(np.abs(poles.pairs[n_pairs:]))
    for omega, rate, spread in zip(omegas, rates, deviation[n_free::2], strict=True):
        if rate > still and not _is_known(residual, data, omega, spread / rate):
            found.append(finding(FindingKind.UNKNOWN_DAMPING, omega_rad_s=omega, longest_s=seconds))
    return found


def _is_known(residual: RealArray, data: Regression, omega_rad_s: float, deviation: float) -> bool:
    """Whether a relative deviation, computed for white noise, is small enough with the residual's colour."""
    allowed = float(np.log(_KNOWN_WITHIN)) / 1.96
    if deviation < allowed / 5:  # no colour seen so far makes more of it
        return True
    segment = int(min(256, np.min(np.diff(data.starts))))
    density = np.mean([_spectrum(residual[here], segment) for here in data.segments], axis=0)
    omega = np.linspace(0, np.pi / data.dt_s, density.size)
    there = float(np.interp(omega_rad_s, omega, _smooth(density, 3)))
    return bool(deviation * np.sqrt(there / max(float(density.mean()), 1e-300)) <= allowed)


def _drifting(
    records: Sequence[Record],
    data: Regression,
    model: GobfModel,
    residuals: Sequence[RealArray],
    fixed: Poles,
) -> list[Finding]:
    # A machine that integrates also integrates friction and offsets: its output walks away without any fault.
    if model.integrators:
        return []
    slow = np.flatnonzero(1 - model.poles.real < 1 / (_SLOW * data.longest))
    if slow.size:
        return [
            finding(
                FindingKind.SLOW_POLE_IS_DRIFT,
                time_constant_s=data.dt_s / (1 - model.poles.real[i]),
                output=model.output_name,
            )
            for i in slow[slow >= fixed.real.size]
            if _is_a_line(data, model.poles, int(i))
        ]
    found = []
    for record, residual in zip(records, residuals, strict=True):
        if residual.size < 50:
            continue
        line = np.linspace(-1.0, 1.0, residual.size)
        centred = residual - residual.mean()
        slope = float(line @ centred / (line @ line))
        power, rest = float(centred @ centred), centred - slope * line
        if not power > 0:
            continue
        share = 1 - float(rest @ rest) / power
        worth = residual_colour(rest, np.array([0, residual.size])).effective_samples
        if share > _DRIFT_SHARE and -worth * np.log1p(-share) > chdtri(1, _DRIFT_LEVEL):
            found.append(
                finding(
                    FindingKind.DRIFT,
                    record=record.label,
                    output=record.output_names[0],
                    drift=2 * slope,
                    share=share,
                )
            )
    return found


def _is_a_line(data: Regression, poles: Poles, index: int) -> bool:
    """Whether a straight line on each record serves as well as the slow real pole `index`."""
    degree = data.polynomials.shape[0]
    lines = [
        np.polynomial.legendre.legvander(np.linspace(-1, 1, n), max(degree, 1)) for n in np.diff(data.starts)
    ]
    with_lines = replace(data, polynomials=np.ascontiguousarray(np.concatenate(lines).T))
    without = poles.without_real(index)
    if not data.n_samples > with_lines.n_parameters(without.order):
        return False
    return with_lines.linearise(*without.writable()).rss <= _AS_WELL * data.linearise(*poles.writable()).rss


def excitation_limit_rad_s(
    records: Sequence[Record], model: GobfModel | None = None, residuals: Sequence[RealArray] = ()
) -> float:
    """Highest frequency [rad/s] at which the input of any record is there: with a hundredth of the density of
    an evenly spread input of the same power, or where the response can be told to 30 %."""
    highest = 0.0
    for index, record in enumerate(records):
        u = record.input[:, 0]
        segment = int(min(u.size, max(64, u.size // 8)))
        frequency = 2 * np.pi * np.fft.rfftfreq(segment, record.dt_s).astype(np.float64)
        density = _spectrum(u, segment)
        present = density >= _WEAK_INPUT * density.mean()
        if model is not None and residuals[index].size >= segment:
            noise = _spectrum(residuals[index], segment)
            gain = np.abs(model.frequency_response(frequency[1:]))
            lines = np.maximum(record.n_samples * record.dt_s * frequency[1:] / (6 * np.pi), 1.0)
            seen = lines * gain**2 * density[1:] >= _TOLD * _smooth(noise)[1:]
            present[1:] |= seen & (density[1:] >= _LEAKAGE * density.max())
        highest = max(highest, float(frequency[np.flatnonzero(present)[-1]]))
    return highest


def _spectrum(x: RealArray, segment: int) -> RealArray:
    """Welch's mean periodogram over half-overlapping stretches under a Hann window, unscaled, (segment // 2 +
    1,). scipy.signal.welch takes ten times as long on short records, a tenth of a whole fit."""
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(segment) / segment)
    pieces = np.lib.stride_tricks.sliding_window_view(x, segment)[:: segment - segment // 2]
    lines = np.abs(np.fft.rfft((pieces - pieces.mean(axis=1, keepdims=True)) * window)) ** 2
    density = lines.mean(axis=0)
    density[1 : (segment + 1) // 2] *= 2  # one-sided: every line but those at 0 and at the Nyquist frequency
    return np.asarray(density)


def _smooth(density: RealArray, width: int = 11) -> RealArray:
    """Mean over neighbouring lines: a noise spectrum of few averages has holes that are chance."""
    window = np.ones(min(width, density.size))
    return np.asarray(
        np.convolve(density, window, "same") / np.convolve(np.ones(density.size), window, "same")
    )
