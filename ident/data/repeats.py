"""Repeats of one experiment, at one amplitude or several: how they scatter, and what the amplitude changes.

Records whose excitation (the reference of a closed loop, else the input) has the same course are repeats of
one experiment, and the size of the excitation is its amplitude. `repeats_of` sorts records into experiments
and estimates a frequency response from each record, without a model. The response of a linear arm does not
depend on the amplitude, so `Repeats.amplitude_effects` compares the largest with the smallest amplitude, band
by band, by Dempster's test of two samples of many variables (Annals of Mathematical Statistics 29(4), 1958).
Assumed: repeats differ by noise and by random changes from run to run, which are independent between records.
Of a `Record` matter here input and output (T, 1), reference (T, R) or None, dt_s [s] and name; its numbers
are finite. TEST_LEVEL is 99 %, SAME 2 % (one form, one amplitude), EXCITED a hundredth of the strongest
line's power.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import f

from ident.data.arrays import ComplexArray, RealArray
from ident.data.distortion import EXCITED, SAME
from ident.data.finding import TEST_LEVEL
from ident.data.nonparametric import spectra_of
from ident.data.record import Record, in_groups

# Spectral lines on either side of the middle one of an averaging width: five lines make one estimate, as in
# `empirical_frf` for a single record. More of them smear resonances, fewer leave estimates noisier. With half
# and twice as many, the shift that is found in the loops of the tests changes by up to a tenth, and one or
# two of 60 linear loops are accused, as before.
HALF_WIDTH_LINES = 2
# Bands per decade in which amplitudes are compared: a band ends at 1.33 times the frequency at which it
# begins, about the width of a resonance with 15 % damping. Twice as many halve the frequencies that each test
# has; with half and twice as many, the shift found in the loops of the tests changes by a tenth or so.
BANDS_PER_DECADE = 8
# Frequencies that a band needs: with fewer, a mean and a slope describe the change exactly, and nothing is
# left to judge them by.
FEWEST_FREQUENCIES = 3
# Averaging widths that an experiment needs, so that one band can have `FEWEST_FREQUENCIES`.
FEWEST_WIDTHS = 3


@dataclass(frozen=True)
class AmplitudeBand:
    """How the response at the largest amplitude differs from that at the smallest, in one band.

    Sizes are root mean squares over the band as shares of the response; frequencies count by the power that
    the response has there.

    Attributes
    ----------
    from_rad_s, to_rad_s : float
        Ends of the band, rad/s.
    difference : float
        Between the means of the two amplitudes, with the noise of the means taken off; at least 0.
    chance : float
        What the noise of the means alone would make of it, by the scatter of the repeats.
    scatter : float
        Standard deviation of one repeat, mean square of both amplitudes.
    gain : float
        Mean relative change of the response over the band.
    shift : float
        Relative change of the frequencies of resonances and zeros that fits the remaining change best.
    level_share, shift_share : float
        Shares of the power of the difference that one change of gain and phase for the whole band explains,
        and that the shift explains.
    probability : float
        Of so large a difference by chance.
    """

    from_rad_s: float
    to_rad_s: float
    difference: float
    chance: float
    scatter: float
    gain: float
    shift: float
    level_share: float
    shift_share: float
    probability: float


@dataclass(frozen=True, eq=False)
class Repeats:
    """One experiment that was recorded at C amplitudes, at least twice at each.

    Attributes
    ----------
    rms : tuple of float
        C amplitudes, ascending: standard deviation of the excitation, in its units.
    names : tuple of tuple of str
        Names of the records, per amplitude.
    omega_rad_s : ndarray, shape (F,)
        Middles of the averaging widths, rad/s, ascending.
    responses : tuple of ndarray, shape (K, F) each
        Complex responses, output over input, per amplitude: one row for each of its K records.
    """

    rms: tuple[float, ...]
    names: tuple[tuple[str, ...], ...]
    omega_rad_s: RealArray
    responses: tuple[ComplexArray, ...]

    def scatter(self, amplitude: int) -> float:
        """Return the standard deviation of one repeat over the size of the response, median over frequency.

        Parameters
        ----------
        amplitude : int
            Index into `rms`; IndexError beyond.

        Notes
        -----
        No unit. A mean response of zero gives infinity or NaN there, with a warning of numpy.
        """
        repeats = self.responses[amplitude]
        deviation = repeats.std(axis=0, ddof=1)
        size = np.abs(repeats.mean(axis=0))
        return float(np.median(deviation / size))

    @property
    def amplitude_effects(self) -> tuple[AmplitudeBand, ...]:
        """Bands in which the response differs between amplitudes by more than chance.

        The level of 99 % holds for all bands together, as each is tested at its share of the error
        (Bonferroni). Bands are eighths of a decade. Empty with one amplitude.
        """
        # The first and the last frequency belong to the bands in spite of rounding, far below 1e-9.
        low = self.omega_rad_s[0] * (1 - 1e-9)
        high = self.omega_rad_s[-1] * (1 + 1e-9)
        n_bands = max(round(BANDS_PER_DECADE * np.log10(high / low)), 1)
        edges = np.geomspace(low, high, n_bands + 1).tolist()

        bands = []
        for low_rad_s, high_rad_s in pairwise(edges):
            band = self.across_amplitudes(low_rad_s, high_rad_s)
            if band is not None:
                bands.append(band)
        largest_probability = (1 - TEST_LEVEL) / max(len(bands), 1)
        return tuple(band for band in bands if band.probability < largest_probability)

    def across_amplitudes(self, low_rad_s: float, high_rad_s: float) -> AmplitudeBand | None:
        """Compare the responses at the largest and the smallest amplitude in the band low <= omega < high.

        Parameters
        ----------
        low_rad_s, high_rad_s : float
            Ends of the band, rad/s; exchanged or NaN they hold no frequency.

        Returns
        -------
        AmplitudeBand or None
            None with one amplitude, or with fewer than three frequencies in the band.

        Notes
        -----
        Dempster's test: the power of the difference over that of its scatter follows F(2 r, 2 r n). n are the
        complex degrees of freedom of the repeats of both amplitudes (Welch's), r is the number of
        independent errors among the frequencies of the band (`_independent_errors`).
        Neglected: amplitudes between the largest and the smallest; changes of second order.
        """
        in_band = (self.omega_rad_s >= low_rad_s) & (self.omega_rad_s < high_rad_s)
        if len(self.rms) < 2 or np.count_nonzero(in_band) < FEWEST_FREQUENCIES:
            return None
        smallest = self.responses[0][:, in_band]
        largest = self.responses[-1][:, in_band]

        # Relative change of the mean response; frequencies count by the power of the response.
        mean_at_smallest = smallest.mean(axis=0)
        mean_at_largest = largest.mean(axis=0)
        middle = 0.5 * (mean_at_smallest + mean_at_largest)
        change = (mean_at_largest - mean_at_smallest) / middle
        middle_power = np.abs(middle) ** 2
        weight = middle_power / np.sum(middle_power)

        # Weighted deviations of the repeats from their mean, and the variance of one repeat in all of them.
        deviations = []
        variances = []
        for responses, mean in ((smallest, mean_at_smallest), (largest, mean_at_largest)):
            deviation = (responses - mean) / middle * np.sqrt(weight)
            deviations.append(deviation)
            variances.append(float(np.sum(np.abs(deviation) ** 2)) / (len(responses) - 1))

        # Noise of the difference of the two means, and its degrees of freedom.
        n_repeats = np.array([len(smallest), len(largest)])
        variances_of_means = np.array(variances) / n_repeats
        noise = float(variances_of_means.sum())
        freedom = noise**2 / float(np.sum(variances_of_means**2 / (n_repeats - 1)))
        n_independent = _independent_errors(np.vstack(deviations), int(n_repeats.sum()) - 2)
        power = float(weight @ np.abs(change) ** 2)
        probability = f.sf(power / noise, 2 * n_independent, 2 * n_independent * freedom)

        # What a shift of all frequencies by a common factor 1 + s does: G(w / (1 + s)) is G (1 + s slope),
        # with slope = -d ln G / d ln w. A constant slope cannot be told from a change of the whole band.
        log_response = np.log(np.abs(middle)) + 1j * np.unwrap(np.angle(middle))
        slope = -np.gradient(log_response, np.log(self.omega_rad_s[in_band]))
        slope -= weight @ slope
        slope_power = float(weight @ np.abs(slope) ** 2)
        shift = float(weight @ (change * slope.conj()).real) / slope_power
        level = complex(weight @ change)

        # By chance the difference may be smaller than its noise.
        power_beyond_noise = max(power - noise, np.finfo(np.float64).tiny)
        difference = float(np.sqrt(max(power - noise, 0.0)))
        return AmplitudeBand(
            low_rad_s,
            high_rad_s,
            difference=difference,
            chance=float(np.sqrt(noise)),
            scatter=float(np.sqrt(np.mean(variances))),
            gain=level.real,
            shift=shift,
            level_share=abs(level) ** 2 / power_beyond_noise,
            shift_share=shift**2 * slope_power / power_beyond_noise,
            probability=float(probability),
        )


def _independent_errors(deviations: ComplexArray, freedom: int) -> float:
    """Return how many independent errors neighbouring frequencies have among them, between 1 and F.

    Deviations that are all zero have F; freedom 1 divides by zero, which two amplitudes of two records
    exclude.

    Parameters
    ----------
    deviations : ndarray, shape (K, F)
        Complex deviations of K repeats from their means, at F frequencies.
    freedom : int
        n, complex degrees of freedom of the deviations: K less the means that were taken off; at least 2.

    Notes
    -----
    tr(S)^2 / tr(S^2), S the covariance (F, F) between frequencies. Of the sample covariance, tr(S_hat^2) is
    larger than tr(S^2) by tr(S)^2 / n in the mean, which few repeats make large; it is taken off. Traces of
    the (K, K) matrix of inner products are those of S_hat, and it is smaller.
    """
    inner = deviations @ deviations.conj().T / freedom
    trace = float(np.trace(inner).real)
    trace_of_square = float(np.sum(np.abs(inner) ** 2))
    unbiased = freedom**2 / (freedom**2 - 1) * (trace_of_square - trace**2 / freedom)
    n_frequencies = deviations.shape[1]
    if unbiased <= 0:
        return float(n_frequencies)
    return float(np.clip(trace**2 / unbiased, 1.0, n_frequencies))


def repeats_of(records: Sequence[Record]) -> tuple[Repeats, ...]:
    """Return every experiment among records that has an amplitude with two records or more.

    Empty for no records.

    Parameters
    ----------
    records : sequence of Record
        One input and one output each. Their excitation is the reference where there is one, else the input;
        records whose excitation stands still are left out, and so are amplitudes with a single record.

    Returns
    -------
    tuple of Repeats

    Raises
    ------
    ValueError
        A record has several inputs or outputs.
    """
    for record in records:
        record.refuse_several()

    # Each record with its excitation (T,) about its mean.
    excited = []
    for record in records:
        columns = record.input if record.reference is None else record.reference
        excitation = columns[:, 0]
        if np.ptp(excitation) > 0:
            excited.append((record, np.asarray(excitation - excitation.mean())))

    experiments = []
    for group in in_groups(excited, _alike):
        experiment = _experiment(group)
        if experiment is not None:
            experiments.append(experiment)
    return tuple(experiments)


def _alike(first: tuple[Record, RealArray], second: tuple[Record, RealArray]) -> bool:
    """Whether two records, each with its excitation (T,) about its mean, were excited alike but for the size.

    They have one length, one sampling time, and courses that differ by less than 2 % (`SAME`) in root mean
    square once their sizes are divided out. Excitations that stand still, whose norm is zero, were left out
    before.
    """
    first_record, first_course = first
    second_record, second_course = second
    if first_course.size != second_course.size or first_record.dt_s != second_record.dt_s:
        return False
    first_form = first_course / np.linalg.norm(first_course)
    second_form = second_course / np.linalg.norm(second_course)
    return bool(np.linalg.norm(first_form - second_form) < SAME)


def _experiment(group: Sequence[tuple[Record, RealArray]]) -> Repeats | None:
    """Return the responses of records that were excited alike, sorted by amplitude.

    group: records, each with its excitation (T,) about its mean. None where no amplitude has two records,
    where the excitation has fewer lines than three averaging widths, or where the input stands still at one.
    At least one record, as `repeats_of` groups them.
    """
    # Records within 2 % of the smallest one of an amplitude belong to it.
    sized = [(float(np.std(course)), record) for record, course in group]
    sized.sort(key=lambda pair: pair[0])
    amplitudes: list[list[tuple[float, Record]]] = []
    for size, record in sized:
        if amplitudes and size < (1 + SAME) * amplitudes[-1][0][0]:
            amplitudes[-1].append((size, record))
        else:
            amplitudes.append([(size, record)])
    repeated = [amplitude for amplitude in amplitudes if len(amplitude) > 1]
    if not repeated:
        return None

    # Lines that are excited, in averaging widths side by side: (F, 5) indices.
    records = [record for amplitude in repeated for _, record in amplitude]
    spectra = spectra_of(records, periodic=False)
    power = np.mean(np.abs(spectra.instrument) ** 2, axis=0)
    excited_lines = np.flatnonzero(power > EXCITED * power.max())
    width = 2 * HALF_WIDTH_LINES + 1
    n_widths = excited_lines.size // width
    if n_widths < FEWEST_WIDTHS:
        return None
    lines = excited_lines[: n_widths * width].reshape(n_widths, width)

    # Responses (R, F) of the records, as `empirical_frf` makes them: by the reference in a closed loop.
    instrument = spectra.instrument[:, lines].conj()
    input_power = np.sum(spectra.input[:, lines] * instrument, axis=2)
    if np.any(input_power == 0):
        return None
    response = np.sum(spectra.output[:, lines] * instrument, axis=2) / input_power
    # The rows of the response are in the order of the amplitudes.
    rms = []
    names = []
    for amplitude in repeated:
        rms.append(float(np.mean([size for size, _ in amplitude])))
        names.append(tuple(record.name for _, record in amplitude))
    ends = np.cumsum([len(amplitude) for amplitude in repeated])[:-1]
    return Repeats(
        rms=tuple(rms),
        names=tuple(names),
        omega_rad_s=spectra.omega_rad_s[lines].mean(axis=1),
        responses=tuple(np.split(response, ends)),
    )
