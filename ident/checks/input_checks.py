"""What the records themselves say about a fit: unusable ones are refused, doubtful ones get advice.

`refuse_unusable` runs before a fit: records without motion, inputs that are copies of one another, or fewer
samples than unknowns end it. `alike_inputs` looks for bands in which several inputs move together, by the
rank of their spectral matrix. `advice` runs after a fit and lists the doubts: few samples, decays that the
records do not tell (Gauss-Newton covariance), an input without power at high frequency, clipped signals,
drift, and an operating point far from zero. Densities are Welch's (IEEE Trans. Audio Electroacoustics 15(2),
1967). Noise is taken as stationary; each doubt becomes a `Finding`, whose sentence is written elsewhere.

A `Record` has an input (T, U), an output (T, Y), finite samples and its sampling time dt_s. `Regression`
holds records made ready for a fit: inputs u (U, N) and output y (N,) of all K records, `starts` (K + 1,) of
each of them, samples of the `longest`. `Poles` has real poles and of each pair the upper one, fixed ones
first of each type.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

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

# Share of the density of an input of the same power spread evenly up to Nyquist (-20 dB): with so much an
# input is there at a frequency, whatever the noise. Chosen; doubled or halved, no test of the advice moves.
PRESENT_DENSITY = 1e-2
# Power of the response over that of the noise, averaged over a third of a frequency: an input is there, too,
# where this is reached. The response is then known to 1 / sqrt(10), about 30 %. Doubled or halved, no test of
# the advice moves.
TOLD_POWER_RATIO = 10.0
# That average is taken over a band as wide as its frequency divided by this number: in a third of a frequency
# the response of all but a mode changes little. Chosen.
TOLD_BAND_PARTS = 3
# Share of the largest density (-60 dB) below which power may be leakage: the side lobes of a Hann window are
# lower from its seventh line on. Ten times as much takes the weak input of a good sensor for none.
LEAKAGE = 1e-6
# Share of the Nyquist frequency: an input that ends below it is called weak. Above it a sampled model has few
# samples a period anyway, and hardly any machine is driven there. Chosen.
WEAK_BELOW_NYQUIST = 0.6
# Stretches that a density is averaged over: an eighth of the record each, half overlapping, so fifteen, which
# scatter by a third. Chosen.
STRETCHES = 8
# Samples of a stretch at least: below, a density has too few lines to show where an input ends. Chosen: 32
# lines, 3 % of the Nyquist frequency apart.
SHORTEST_STRETCH = 64
# Lines over which the density of noise is smoothed: the mean of few stretches has holes that are chance.
# Chosen.
SMOOTHED_LINES = 11

# Factor either way (95 %) within which a rate of decay counts as known; beyond, the record does not tell it.
# Chosen: a damping ratio that may be half or twice as large changes the peak of a mode by 6 dB.
KNOWN_WITHIN = 2.0
# Quantile of the standard normal distribution for 95 % on two sides.
TWO_SIDED_95 = 1.96
# Largest factor by which the colour of a residual has made a deviation wider than white noise would, so far:
# deviations below the limit by this factor are not looked at (saves time).
COLOUR_FACTOR = 5
# Samples of a stretch of the residual at most: enough lines (128) to tell the noise around a pole from its
# mean. Chosen.
LONGEST_RESIDUAL_STRETCH = 256
# Lines around a pole over which the density of the residual is averaged: the pole's own and one to each side,
# as many as a Hann window mixes.
LINES_AROUND_POLE = 3
# Distance of a real pole from one, or decay of a pair, over the whole longest record: what is slower stands
# at the bound of a refinement (`ident.fit.refinement.Bounds`: 1e-3), of which `pole_warnings` speaks. The 1 %
# is for rounding.
STILL_DECAY = 1.01e-3
# Real poles with time constants above this share of the longest record count as slow: the record shows no
# more than two of them. Only slow ones are doubted. Chosen; doubled or halved, no test of the advice moves.
SLOW_SHARE = 0.5
# Share of their largest diagonal entry that unknowns of no effect get in a normal matrix: a square root of it
# is the rounding of doubles (1e-15), as of poles that coincide.
NO_SIZE = 1e-30
# Share of the largest eigenvalue below which a scaled normal matrix is singular: rounding of products.
SINGULAR = 1e-12

# Share of a residual's power that a straight line has to have to be called a drift. Chosen; doubled or
# halved, no test of the advice moves.
DRIFT_SHARE = 0.2
# Probability that noise has so much of a line: one false alarm in 100 000 records. Chosen.
DRIFT_BY_CHANCE = 1e-5
# Samples of a residual in which a drift is looked for: of fewer the colour is not known, as its
# autocorrelation is taken to a tenth of them.
SHORTEST_DRIFT = 50
# A straight line serves as well as a slow pole if it leaves at most this factor more. Chosen; at 1.1 or 1.025
# no test of the advice moves.
AS_WELL = 1.05
# Mean of an input over its deviation: from here on an operating point is called far from zero, as its
# constant response is a hundred times the power of what is fitted. Chosen; doubled or halved, no test of the
# advice moves.
LARGE_OFFSET = 10.0
# Samples for each unknown below which the choice of the poles is itself uncertain. A rule of thumb; it gives
# advice alone.
SAMPLES_PER_UNKNOWN = 10

# Share of the power of unit inputs that a combination of them has to have to tell them apart over a whole
# record: beyond rounding of their products.
SAME_INPUT = 1e-12
# Share of the mean power that a combination of inputs, each of unit power in a band, has if they are alike
# there. Independent inputs have ten times as much by chance where `FEWEST_LINES` lines an input count.
# Doubled or halved, no test of such bands moves.
ALIKE_POWER = 1e-2
# Share of the largest part in the dependent combinations from which on an input counts as one of the alike.
# Chosen: what noise mixes into them is smaller.
ALIKE_PART = 0.05
# Cells an octave into which frequencies are sorted: bands are told to a twelfth of an octave. Doubled,
# independent inputs are called alike in their tests, likely as a window closes with fewer lines to spare;
# halved, a dependent band is missed.
CELLS_PER_OCTAVE = 12
# Cells that a band of alike inputs has at least, a third of an octave: poles bridge a smaller one. Doubled or
# halved, no test of such bands moves.
FEWEST_CELLS = 4
# Rounding of logarithms: a line exactly on the edge of a cell belongs to the upper one.
CELL_ROUNDING = 1e-9
# Keeps ratios of powers finite where a power is zero: near the smallest double.
TINY = 1e-300


def refuse_unusable(records: Sequence[Record], data: Regression, order: int) -> None:
    """Nothing, where records can be fitted; else raises an error of one line that names the record.

    Parameters
    ----------
    records : sequence of Record
        One output each. A single input has to move in every record, each of several in one of them at least.
    data : Regression
        The records made ready for a fit: inputs u (U, N), and how many unknowns a fit has.
    order : int
        Number of poles that the samples have to be enough for.

    Raises
    ------
    ValueError
        An input or the output is constant, a combination of inputs is zero, or there are no more samples than
        unknowns. IndexError without records, which `prepare` has refused before.
    """
    names = records[0].input_names
    if len(names) == 1:
        refuse_hopeless(records, [STILL_INPUT])
    refuse_hopeless(records, [STILL_OUTPUT])
    for index, name in enumerate(names):
        if all(np.ptp(record.input[:, index]) == 0 for record in records):
            raise ValueError(
                f"{records[0].label}: input column '{name}' is constant in every record; "
                "expected a signal that varies in at least one"
            )
    if least_independence(data) <= SAME_INPUT:
        raise ValueError(
            f"{records[0].label}: the inputs {list(names)} are linearly dependent, so their channels cannot "
            "be distinguished; expected independent signals"
        )
    unknowns = data.n_parameters(order)
    if not data.n_samples > unknowns:
        label = records[0].label
        if len(records) > 1:
            label = f"{len(records)} records"
        raise ValueError(
            f"{label}: {data.n_samples} samples are too few for order {order}, which has {unknowns} "
            f"unknowns; expected at least {unknowns + 1}"
        )


def least_independence(data: Regression) -> float:
    """Least power of a combination of unit length of the inputs, each of unit length over all records.

    The least eigenvalue of their correlation matrix (U, U): 1 for uncorrelated inputs, 0 for dependent ones.
    A single input has 1. data : Regression: its inputs u (U, N); one of zeros divides by zero, and
    `refuse_unusable` has refused it before.
    """
    if data.n_inputs == 1:
        return 1.0
    rows = data.u / np.linalg.norm(data.u, axis=1, keepdims=True)
    return float(np.linalg.eigvalsh(rows @ rows.T)[0])


class Dependence(NamedTuple):
    """Inputs that rest or depend on one another in a band, and how many directions all inputs move in.

    inputs : their indices, ascending; rank : the number of directions, from 1 to one less than there are
    inputs.
    """

    inputs: tuple[int, ...]
    rank: int


class CellBand(NamedTuple):
    """A band of frequency cells, from `start` up to but without `stop`."""

    start: int
    stop: int

    @property
    def width(self) -> int:
        """Number of cells; 0 for a band that does not exist yet."""
        return self.stop - self.start


def alike_inputs(records: Sequence[Record]) -> list[Finding]:
    """Findings ALIKE_INPUTS: bands in which several inputs move in fewer directions than there are inputs.

    Parameters
    ----------
    records : sequence of Record
        With the same U inputs each, of one sampling time.

    Returns
    -------
    list of Finding
        One for each group of inputs and rank: their names, the rank of their spectral matrix summed over all
        records, and the widest such band in rad/s. Empty for a single input, and where the inputs are
        independent. IndexError without records; an input that stands still in all of them gives nan, and
        `refuse_unusable` has refused it before.

    Notes
    -----
    Neighbouring cells of a twelfth of an octave are gathered until their lines count as many as the rank
    needs, an octave at most; each such window gets a rank, and adjoining windows with the same answer are one
    band. Lines count by their participation ratio (sum P)^2 / sum P^2, P the power of all inputs at a line.
    """
    names = records[0].input_names
    n_inputs = len(names)
    if n_inputs == 1:
        return []
    # Spectra of all records under a Hann window, one line after the other, without the line at zero.
    spectra = []
    frequencies = []
    for record in records:
        n = len(record.input)
        windowed = detrend(record.input, axis=0) * np.hanning(n)[:, None]
        spectra.append(np.fft.rfft(windowed, axis=0)[1:] / np.sqrt(n))
        frequencies.append(2 * np.pi * np.fft.rfftfreq(n, records[0].dt_s)[1:])
    lines = np.concatenate(spectra)
    omega = np.concatenate(frequencies)
    lines /= np.sqrt(np.mean(np.abs(lines) ** 2, axis=0))

    # Sums over the lines of each cell: spectral matrix (U, U), number, power and squared power of lines.
    octaves = np.log2(omega / omega.min())
    cell = np.floor(CELLS_PER_OCTAVE * octaves + CELL_ROUNDING).astype(int)
    n_cells = int(cell.max()) + 1
    power = np.sum(np.abs(lines) ** 2, axis=1)
    products = np.zeros((n_cells, n_inputs, n_inputs), dtype=np.complex128)
    np.add.at(products, cell, lines[:, :, None] * lines[:, None, :].conj())
    count = np.bincount(cell, np.ones_like(power), n_cells)
    power_sum = np.bincount(cell, power, n_cells)
    square_sum = np.bincount(cell, power**2, n_cells)

    widest: dict[Dependence, CellBand] = {}
    window_start = 0
    band = CellBand(0, 0)
    dependence: Dependence | None = None
    for stop in range(1, n_cells + 1):
        window_start = max(window_start, stop - CELLS_PER_OCTAVE)
        window = slice(window_start, stop)
        enough = FEWEST_LINES * n_inputs * square_sum[window].sum()
        if power_sum[window].sum() ** 2 < enough:
            continue
        window_dependence = _dependence(products[window].sum(axis=0) / count[window].sum())
        if window_dependence == dependence and band.stop == window_start:
            band = CellBand(band.start, stop)
        else:
            band = CellBand(window_start, stop)
        dependence = window_dependence
        window_start = stop
        if dependence is not None:
            known = widest.get(dependence, CellBand(0, 0))
            widest[dependence] = max(known, band, key=lambda cells: cells.width)

    findings = []
    for group, cells in widest.items():
        if cells.width < FEWEST_CELLS:
            continue
        group_names = [names[index] for index in group.inputs]
        findings.append(
            finding(
                FindingKind.ALIKE_INPUTS,
                inputs=str(group_names),
                rank=group.rank,
                count=n_inputs,
                low_rad_s=omega[cell == cells.start].min(),
                high_rad_s=omega[cell < cells.stop].max(),
            )
        )
    return findings


def _dependence(spectrum: ComplexArray) -> Dependence | None:
    """Inputs that rest or depend on one another by their spectral matrix (U, U), with its rank.

    The matrix is the mean over the lines of a band, each input of unit mean density over all frequencies.
    None for full rank, or where every input rests. nan raises LinAlgError: `alike_inputs` has none.
    """
    density = np.diag(spectrum).real
    moving = np.flatnonzero(density > LEAKAGE)
    size = density[moving]
    unit = spectrum[np.ix_(moving, moving)] / np.sqrt(np.outer(size, size))
    values, vectors = np.linalg.eigh(unit)
    rank = int(np.sum(values > ALIKE_POWER))
    if rank in (0, density.size):
        return None
    # Combinations without power: an input that has a part in one of them depends on the others.
    powerless = vectors[:, : moving.size - rank]
    part = np.zeros(density.size)
    part[moving] = np.sum(np.abs(powerless) ** 2, axis=1)
    resting = density <= LEAKAGE
    depending = part > ALIKE_PART * max(part.max(), TINY)
    involved = np.flatnonzero(resting | depending)
    return Dependence(tuple(int(index) for index in involved), rank)


def advice(
    records: Sequence[Record],
    data: Regression,
    model: GobfModel,
    residuals: Sequence[RealArray],
    fixed: Poles,
) -> list[Finding]:
    """Findings, one for each doubt about the records behind a fitted model; empty where there is none.

    Parameters
    ----------
    records : sequence of Record
        One input and one output each, as fitted.
    data : Regression
        The same records made ready for a fit: its cost and residual at given poles.
    model : GobfModel
        The fitted model: poles, integrators, frequency response.
    residuals : sequence of (T,) array
        What the model leaves of each record, in units of the output.
    fixed : Poles
        Poles that were stated as known; they come first of each type in the model.

    Returns
    -------
    list of Finding
        In this order: few samples, decays that are not known, a weak input, clipped signals, drift, and
        operating points far from zero. Nothing is raised for records that `refuse_unusable` has passed; that
        records, data and residuals belong together is not checked, but for their number (ValueError).
    """
    findings = few_samples(data, model.order)
    findings += _unknown_rates(data, model, fixed)
    limit_rad_s = excitation_limit_rad_s(records, model, residuals)
    if limit_rad_s < WEAK_BELOW_NYQUIST * np.pi / data.dt_s:
        findings.append(finding(FindingKind.WEAK_INPUT, limit_rad_s=limit_rad_s))
    findings += clipped(records)
    findings += _drifting(records, data, model, residuals, fixed)
    # An unknown initial state has a constant of its own, which takes up any operating point.
    if not data.structure.estimate_initial_state:
        findings += _far_from_zero(records)
    return findings


def few_samples(data: Regression, order: int) -> list[Finding]:
    """Finding FEW_SAMPLES where records have fewer than ten samples for each unknown of a fit; else empty.

    data : Regression: number of samples over all records, and of unknowns with `order` poles. The order, 0 or
    more, is not checked.
    """
    unknowns = data.n_parameters(order)
    if data.n_samples >= SAMPLES_PER_UNKNOWN * unknowns:
        return []
    return [finding(FindingKind.FEW_SAMPLES, n_samples=data.n_samples, unknowns=unknowns)]


def _far_from_zero(records: Sequence[Record]) -> list[Finding]:
    """Findings FAR_FROM_ZERO on every record whose input has a mean of more than `LARGE_OFFSET` times its
    deviation.

    Both in units of the input; one input each. Empty where there is none.
    """
    findings = []
    for record in records:
        mean = record.input.mean()
        deviation = record.input.std()
        if abs(mean) > LARGE_OFFSET * deviation:
            findings.append(
                finding(
                    FindingKind.FAR_FROM_ZERO,
                    record=record.label,
                    input=record.input_names[0],
                    mean=mean,
                    std=deviation,
                )
            )
    return findings


def _unknown_rates(data: Regression, model: GobfModel, fixed: Poles) -> list[Finding]:
    """Findings on searched poles whose decay the records do not tell to a factor of two.

    UNKNOWN_TIME_CONSTANT for slow real poles, UNKNOWN_DAMPING for pairs. The deviation of each decay follows
    from the Gauss-Newton covariance sigma^2 (S^T S)^-1 of the free poles, sigma^2 the mean power of the
    residual, made wider by the noise around the pole (`_is_known`). `fixed`: stated poles, first of each
    type, which are not judged. Empty where nothing was searched or there are no samples to spare.
    `model` : the fit of `data`, not checked.
    """
    poles = model.poles
    n_fixed_real, n_fixed_pairs = fixed.counts
    here = data.linearise(*poles.writable())
    normal, _ = pole_system(here, poles, fixed)
    n_spare = data.n_samples - data.n_parameters(poles.order)
    if normal.size == 0 or n_spare <= 0:
        return []

    # Standard deviation of each unknown of the refinement: 1 - a of the free real poles, then decay and angle
    # per sample of each free pair.
    diagonal = np.diag(normal)
    # Poles that coincide leave an unknown without a size, up to rounding.
    least_size = max(NO_SIZE * float(diagonal.max()), TINY)
    scale = np.sqrt(np.maximum(diagonal, least_size))
    inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=SINGULAR, hermitian=True)
    noise_variance = here.rss / n_spare
    deviation = np.sqrt(noise_variance * np.maximum(np.diag(inverse), 0.0)) / scale

    residual = data.residual(poles)
    longest_s = data.longest * model.dt_s
    still = STILL_DECAY / data.longest
    slow = 1 / (SLOW_SHARE * data.longest)
    findings = []
    real_decays = 1 - poles.real[n_fixed_real:]
    n_real = real_decays.size
    for decay, spread in zip(real_decays, deviation[:n_real], strict=True):
        if not still < decay < slow:
            continue
        if not _is_known(residual, data, decay / model.dt_s, spread / decay):
            findings.append(
                finding(
                    FindingKind.UNKNOWN_TIME_CONSTANT,
                    time_constant_s=model.dt_s / decay,
                    longest_s=longest_s,
                )
            )
    omegas = poles.omega_rad_s(model.dt_s)[n_fixed_pairs:]
    pair_decays = -np.log(np.abs(poles.pairs[n_fixed_pairs:]))
    # Decays of the pairs are every second one of what follows the real poles.
    for omega, decay, spread in zip(omegas, pair_decays, deviation[n_real::2], strict=True):
        if decay > still and not _is_known(residual, data, omega, spread / decay):
            findings.append(finding(FindingKind.UNKNOWN_DAMPING, omega_rad_s=omega, longest_s=longest_s))
    return findings


def _is_known(residual: RealArray, data: Regression, omega_rad_s: float, deviation: float) -> bool:
    """Whether a decay is known within a factor of two (95 %), with the colour of the residual (N,).

    deviation: relative standard deviation of the decay, computed for white noise. What counts for a pole is
    the noise around its own frequency omega [rad/s]: the deviation grows with the root of the residual's
    density there over its mean. data : Regression: where each record begins in the residual. False for a
    deviation of nan; a frequency above Nyquist counts as Nyquist.
    """
    # The logarithm of the decay is taken as normal.
    allowed = float(np.log(KNOWN_WITHIN)) / TWO_SIDED_95
    if deviation < allowed / COLOUR_FACTOR:
        return True
    segment = int(min(LONGEST_RESIDUAL_STRETCH, np.min(np.diff(data.starts))))
    density = np.mean([_spectrum(residual[rows], segment) for rows in data.segments], axis=0)
    omega = np.linspace(0, np.pi / data.dt_s, density.size)
    around_pole = float(np.interp(omega_rad_s, omega, _smooth(density, LINES_AROUND_POLE)))
    mean_density = max(float(density.mean()), TINY)
    return bool(deviation * np.sqrt(around_pole / mean_density) <= allowed)


def _drifting(
    records: Sequence[Record],
    data: Regression,
    model: GobfModel,
    residuals: Sequence[RealArray],
    fixed: Poles,
) -> list[Finding]:
    """Findings on a drift of the output: taken up by a slow pole, or left in the residuals.

    SLOW_POLE_IS_DRIFT for each searched real pole, slower than half the longest record, that a straight line
    replaces. Without slow poles DRIFT for each record whose residual (T,) has a significant straight line:
    total drift in units of the output, and the line's share of the power. Empty for a model with integrators:
    such a machine also integrates friction and offsets, and walks away without any fault of the records.
    `fixed`: stated poles, first of each type, which are not judged. Residuals of fewer than `SHORTEST_DRIFT`
    samples are passed over; of another number than records they are a ValueError.
    """
    if model.integrators:
        return []
    decays = 1 - model.poles.real
    slow = np.flatnonzero(decays < 1 / (SLOW_SHARE * data.longest))
    if slow.size:
        searched_slow = [int(index) for index in slow if index >= fixed.real.size]
        return [
            finding(
                FindingKind.SLOW_POLE_IS_DRIFT,
                time_constant_s=data.dt_s / decays[index],
                output=model.output_name,
            )
            for index in searched_slow
            if _is_a_line(data, model.poles, index)
        ]

    findings = []
    for record, residual in zip(records, residuals, strict=True):
        if residual.size < SHORTEST_DRIFT:
            continue
        # Least squares of a line from -1 to 1, beside the mean.
        line = np.linspace(-1.0, 1.0, residual.size)
        centred = residual - residual.mean()
        slope = float(line @ centred / (line @ line))
        without_line = centred - slope * line
        power = float(centred @ centred)
        if not power > 0:
            continue
        share = 1 - float(without_line @ without_line) / power
        # Likelihood ratio Ne ln(1 / (1 - share)), Ne the independent samples that the rest is worth.
        worth = residual_colour(without_line, np.array([0, residual.size])).effective_samples
        likelihood_ratio = -worth * np.log1p(-share)
        if share > DRIFT_SHARE and likelihood_ratio > chdtri(1, DRIFT_BY_CHANCE):
            findings.append(
                finding(
                    FindingKind.DRIFT,
                    record=record.label,
                    output=record.output_names[0],
                    drift=2 * slope,
                    share=share,
                )
            )
    return findings


def _is_a_line(data: Regression, poles: Poles, index: int) -> bool:
    """Whether a straight line on each record serves as well as the slow real pole with this index.

    Two fits of the same data: with the poles, and with one pole less and Legendre columns up to degree 1 (or
    those that integrators leave free). False where there are too few samples for the lines. IndexError for an
    index beyond the real poles.
    """
    degree = max(data.polynomials.shape[0], 1)
    columns = []
    for n_rows in np.diff(data.starts):
        columns.append(np.polynomial.legendre.legvander(np.linspace(-1, 1, n_rows), degree))
    with_lines = replace(data, polynomials=np.ascontiguousarray(np.concatenate(columns).T))
    without_pole = poles.without_real(index)
    if not data.n_samples > with_lines.n_parameters(without_pole.order):
        return False
    rss_with_lines = with_lines.linearise(*without_pole.writable()).rss
    rss_with_pole = data.linearise(*poles.writable()).rss
    return rss_with_lines <= AS_WELL * rss_with_pole


def excitation_limit_rad_s(
    records: Sequence[Record], model: GobfModel | None = None, residuals: Sequence[RealArray] = ()
) -> float:
    """Highest frequency, rad/s, at which the input of any record is there.

    Parameters
    ----------
    records : sequence of Record
        One input each.
    model : GobfModel, optional
        Model fitted to the records: its frequency response tells what an input makes of the output.
    residuals : sequence of (T,) array
        With a model: what it leaves of each record.

    Returns
    -------
    float
        0 without records. Of an input that stands still it means nothing: `refuse_unusable` has refused that.
        With a model, a record without a residual is an IndexError.

    Notes
    -----
    An input is there at a line with a hundredth of the density of an evenly spread input of the same power.
    With a model also where the response can be told to 30 %: where n |G|^2 S_u >= 10 S_e, n the spectral
    lines of the record within a third of the frequency, S_u and S_e the densities of input and residual; not
    at lines that may be leakage of the window.
    """
    highest_rad_s = 0.0
    for index, record in enumerate(records):
        u = record.input[:, 0]
        segment = int(min(u.size, max(SHORTEST_STRETCH, u.size // STRETCHES)))
        omega = 2 * np.pi * np.fft.rfftfreq(segment, record.dt_s).astype(np.float64)
        density = _spectrum(u, segment)
        present = density >= PRESENT_DENSITY * density.mean()
        if model is not None and residuals[index].size >= segment:
            # The line at zero is left out: there a model with integrators has no response.
            noise = _smooth(_spectrum(residuals[index], segment))[1:]
            gain = np.abs(model.frequency_response(omega[1:]))
            # Lines of the record are 2 pi / duration apart.
            duration_s = record.n_samples * record.dt_s
            n_lines = np.maximum(duration_s * omega[1:] / (2 * np.pi * TOLD_BAND_PARTS), 1.0)
            above_noise = n_lines * gain**2 * density[1:] >= TOLD_POWER_RATIO * noise
            no_leakage = density[1:] >= LEAKAGE * density.max()
            present[1:] |= above_noise & no_leakage
        last = np.flatnonzero(present)[-1]
        highest_rad_s = max(highest_rad_s, float(omega[last]))
    return highest_rad_s


def _spectrum(signal: RealArray, segment: int) -> RealArray:
    """Power density (segment // 2 + 1,) of a signal (T,), T >= segment, unscaled, at lines from 0 to Nyquist.

    Welch's mean of periodograms over half-overlapping stretches of `segment` samples under a Hann window, the
    mean of each stretch taken off. scipy.signal.welch takes ten times as long on short records, which is a
    tenth of a whole fit. A shorter signal is a ValueError of NumPy.
    """
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(segment) / segment)
    step = segment - segment // 2
    stretches = np.lib.stride_tricks.sliding_window_view(signal, segment)[::step]
    centred = stretches - stretches.mean(axis=1, keepdims=True)
    periodograms = np.abs(np.fft.rfft(centred * window)) ** 2
    density = periodograms.mean(axis=0)
    # One-sided: every line but those at zero and at the Nyquist frequency stands for two.
    density[1 : (segment + 1) // 2] *= 2
    return np.asarray(density)


def _smooth(density: RealArray, width: int = SMOOTHED_LINES) -> RealArray:
    """Mean (F,) of a density (F,), F at least 1, over `width` neighbouring lines, over fewer at the ends."""
    window = np.ones(min(width, density.size))
    total = np.convolve(density, window, "same")
    count = np.convolve(np.ones(density.size), window, "same")
    return np.asarray(total / count)
