"""Response, noise and nonlinear distortion of periodic records, frequency by frequency and without a model.

The robust method of Pintelon and Schoukens (System Identification: A Frequency Domain Approach, 2nd ed., ch.
4) on M realisations of a random-phase signal, P whole periods each. The mean of G = Y / U over realisations
is the best linear approximation at this amplitude and spectrum. What else the output holds is told apart by
where it repeats:

- between the periods of a realisation there is noise, M (P - 1) complex degrees of freedom a line;
- between realisations there is noise / P and stochastic distortion, M - 1 degrees of freedom;
- at lines without excitation there is noise / P and distortion, M degrees of freedom: its even part at even
  lines, as long as only odd lines are excited.

What lies before the last whole periods is dropped as transient. The mean advance of an integrating output
from a period to the next is taken off as a straight line, which adds a tenth of the noise power at the first
line for P = 2, falling with the line's square. The input is taken as known.

`distortion_of` finds the period of each record (`period_of`), takes the spectra of its whole periods, puts
records of one amplitude into a group and makes a `Distortion` of each group. Its `LineLevels` say the powers
line by line, and `LineLevels.within` one number with its interval for a band. Of a `Record` matter here input
and output (T, 1), dt_s [s] and name; its numbers are finite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from ident.data.arrays import BoolArray, ComplexArray, RealArray
from ident.data.ellipses import circular_widening
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record import Record, in_groups

# Power in which a signal may differ from itself a period later, as a share of its own: 40 dB below it, as of
# an input as it was commanded, or well measured. Doubled or halved, no test of distortion moves.
_REPEATS_WITHIN_POWER = 1e-4
# Share of its power in which a signal has to have differed from itself at a shorter lag before a lag counts
# as its period. Signals without any relation differ by 1 in the mean; a slow one differs by less at all lags
# below its shortest motion.
_HAS_DIFFERED_POWER = 0.5
# Power of a line, over that of the strongest one, above which it counts as excited: 20 dB below. Lines of a
# multisine have one power, or a few times more at some; leakage and dither lie far below. Doubled or halved,
# no test of distortion moves.
EXCITED = 1e-2
# Power of a line, over that of the strongest one, below which it counts as without excitation: 40 dB below,
# so that what the arm makes of it is small beside distortion. Lines between the two count as neither. Doubled
# or halved, no test of distortion moves.
_SILENT = 1e-4
# Relative difference in root mean square up to which two records are of one amplitude, and up to which two
# inputs are of one realisation: chosen above the noise of a measured input, below any step of amplitude that
# is made on purpose. Doubled or halved, no test of distortion moves.
SAME = 0.02
# Harmonics to each side over which the power of the noise is averaged, fewer next to zero: with 21 of them
# it is known to 22 % with one degree of freedom a line. Doubled or halved, no test of distortion moves.
_SMOOTHING_HARMONICS = 10
# Rounds of weights and distortion in turns: more of them move it by less than 2 % of its interval. It is no
# test of convergence: none is made.
_ROUNDS = 6
# Smallest power that is expected, as a share of the largest one in the band: keeps the weights finite where
# neither noise nor distortion is, as in exact simulations.
_SMALLEST_POWER_SHARE = 1e-12
# Gain that is added before its logarithm is taken: that of a line at which nothing came is finite. Near the
# smallest double, so that it changes no other gain.
_SMALLEST_GAIN = 1e-300
# Share by which the first band begins below the lowest line, and the last one ends above the highest, so
# that rounding leaves no line out.
_BAND_EDGE_SHARE = 1e-9


@dataclass(frozen=True, eq=False)
class LineLevels:
    """Power of what is no response to the input, at some lines of one amplitude.

    Attributes
    ----------
    omega_rad_s : ndarray, shape (K,)
        Frequencies of the lines.
    of_each : ndarray, shape (M, K)
        Power in the mean of each realisation's periods, in units of |G|^2: noise / P and distortion.
    freedom : int
        Complex degrees of freedom a line of the mean of `of_each` over realisations.
    noise : ndarray, shape (K,), or None
        Share of the noise in it, in units of |G|^2; None with one period, which does not show it.
    noise_freedom : int
        Complex degrees of freedom a line with which the noise is known.
    gain : ndarray, shape (K,)
        |G| at the lines.

    Notes
    -----
    Arrays are locked against writing. Shapes and numbers are not checked: `distortion_of` makes them of
    records that are.
    """

    omega_rad_s: RealArray
    of_each: RealArray
    freedom: int
    noise: RealArray | None
    noise_freedom: int
    gain: RealArray

    def __post_init__(self) -> None:
        """Lock the arrays against writing. Nothing is checked."""
        for entry in fields(self):
            array = getattr(self, entry.name)
            if isinstance(array, np.ndarray):
                array.setflags(write=False)

    @property
    def power(self) -> RealArray:
        """Mean (K,) of `of_each` over the realisations, in units of |G|^2. At least one realisation."""
        return np.asarray(self.of_each.mean(axis=0))

    def within(self, low_rad_s: float, high_rad_s: float, level: float = 0.95) -> BandLevel | None:
        """Distortion over gain between two frequencies, taken as one number there, with its interval.

        Parameters
        ----------
        low_rad_s, high_rad_s : float
            Ends of the band; a line at the upper one is outside.
        level : float
            Probability with which the interval holds the distortion; the default of 0.95 is convention. Not
            checked: outside of 0 to 1 the ends are NaN or infinite.

        Returns
        -------
        BandLevel or None
            None where the band has no line with a gain (also a band whose ends are exchanged or NaN), or no
            degree of freedom.

        Notes
        -----
        Powers p_k are taken as chi-square around d + n_k, with d the distortion and n_k the noise. Most
        likely is then the mean of p_k - n_k with weights 1 / (d + n_k)^2, found by turns. The interval has
        the degrees of freedom of the weighted sum (Satterthwaite), or of its scatter between realisations
        where that is wider. Neglected: that the weights are estimated from the same powers.
        """
        from_low = self.omega_rad_s >= low_rad_s
        below_high = self.omega_rad_s < high_rad_s
        has_gain = self.gain > 0
        used = from_low & below_high & has_gain
        if not used.any() or not self.freedom:
            return None
        squared_gain = self.gain[used] ** 2
        relative_of_each = self.of_each[:, used] / squared_gain
        relative_power = relative_of_each.mean(axis=0)
        noise = np.zeros_like(relative_power)
        if self.noise is not None:
            noise = self.noise[used] / squared_gain

        # Weights and the distortion that they give, by turns.
        distortion = 0.0
        smallest = _SMALLEST_POWER_SHARE * relative_power.max() + np.finfo(np.float64).tiny
        for _ in range(_ROUNDS):
            expected = np.maximum(distortion + noise, smallest)
            precision = expected**-2
            weight = precision / np.sum(precision)
            distortion = max(float(weight @ (relative_power - noise)), 0.0)

        # Variance of the weighted sum: as chi-square powers have it, or as realisations scatter.
        total = float(weight @ relative_power)
        of_noise = float(weight @ noise)
        expected_parts = weight * expected
        variance = np.sum(expected_parts**2) / self.freedom
        n_realisations = len(relative_of_each)
        if n_realisations > 1:
            scatter = np.var(relative_of_each @ weight, ddof=1) / n_realisations
            variance = max(variance, scatter)
        if self.noise is not None:
            noise_parts = weight * noise
            variance += np.sum(noise_parts**2) / self.noise_freedom

        # Interval of a chi-square variable with this mean and variance, less the noise.
        freedom = 2 * (weight @ expected) ** 2 / variance
        tail = 0.5 * (1 - level)
        upper_quantile = chi2.ppf(1 - tail, freedom)
        lower_quantile = chi2.ppf(tail, freedom)
        low = freedom * total / upper_quantile - of_noise
        # Where less than the noise came, no less is promised than where just the noise comes.
        high = freedom * max(total, of_noise) / lower_quantile - of_noise
        middle = total - of_noise
        distortion_level, low_level, high_level = np.sqrt(np.maximum([middle, low, high], 0.0))
        return BandLevel(
            low_rad_s,
            high_rad_s,
            distortion=float(distortion_level),
            interval=(float(low_level), float(high_level)),
            noise=float(np.sqrt(of_noise)),
        )


@dataclass(frozen=True)
class BandLevel:
    """Distortion and noise of a band, root mean square over the gain (both without a unit).

    Attributes
    ----------
    from_rad_s, to_rad_s : float
        Ends of the band.
    distortion : float
        Most likely level of the distortion; 0 where no more than the noise came.
    interval : tuple of float
        Lower and upper end of the distortion at the level that was asked for.
    noise : float
        Level of the noise in a mean of periods; 0 where one period does not show it.
    """

    from_rad_s: float
    to_rad_s: float
    distortion: float
    interval: tuple[float, float]
    noise: float

    @property
    def significant(self) -> bool:
        """Whether the interval of the distortion begins above zero. False where an end is NaN."""
        return self.interval[0] > 0


@dataclass(frozen=True, eq=False)
class Distortion:
    """Response, noise and distortion of one channel at one amplitude of the input.

    Attributes
    ----------
    rms : float
        Root mean square of the input, in its unit; the mean over the records.
    names : tuple of str
        The records.
    dt_s : float
        Sampling time.
    period_samples : int
        Samples of a period.
    realisations : int
        M, inputs of different phases.
    periods : int
        P, whole periods of the realisation that has fewest.
    omega_rad_s : ndarray, shape (F,)
        Excited lines.
    gain : ndarray, shape (F,)
        Best linear approximation there, output per input.
    noise_std : ndarray, shape (F,), or None
        Standard deviation of G in one period; None with one period.
    excited : LineLevels or None
        Scatter between realisations at the excited lines; None with one realisation.
    odd, even : LineLevels or None
        Powers at odd and at even lines without excitation; None where there are none.
    drift : float
        Largest mean advance of the output from a period to the next, taken off, in its unit.
    """

    rms: float
    names: tuple[str, ...]
    dt_s: float
    period_samples: int
    realisations: int
    periods: int
    omega_rad_s: RealArray
    gain: ComplexArray
    noise_std: RealArray | None
    excited: LineLevels | None
    odd: LineLevels | None
    even: LineLevels | None
    drift: float

    def response(self, level: float = 0.95) -> FrequencyUncertainty | None:
        """Best linear approximation with ellipses of its scatter between realisations.

        Parameters
        ----------
        level : float
            Probability with which an ellipse holds the response at its line; the default of 0.95 is
            convention. ValueError outside of 0 to 1, of `circular_widening`.

        Returns
        -------
        FrequencyUncertainty or None
            Circles at the F excited lines; None with one realisation.

        Notes
        -----
        They are widened to the quantile of F(2, 2 (M - 1)), because realisations are few.
        """
        if self.excited is None:
            return None
        variance_of_mean = self.excited.power / self.realisations
        widening = circular_widening(self.realisations - 1, level)
        # A circular complex variable has half of its variance in the real part, half in the imaginary one.
        half_widening = 0.5 * widening
        covariance = half_widening * variance_of_mean[:, None, None] * np.eye(2)
        return FrequencyUncertainty(
            self.omega_rad_s, self.gain, covariance, self.dt_s, level, "empirical, whole periods"
        )

    @cached_property
    def bands_rad_s(self) -> tuple[tuple[float, float], ...]:
        """Bands of about half a decade, as (from, to), from the lowest excited line up to the highest.

        In rad/s, side by side; one band where there is one line only. At least one line, which
        `distortion_of` has.
        """
        low = self.omega_rad_s[0] * (1 - _BAND_EDGE_SHARE)
        high = self.omega_rad_s[-1] * (1 + _BAND_EDGE_SHARE)
        # Two bands a decade, at least one. Chosen: a table of them stays short.
        n_bands = max(round(2 * np.log10(high / low)), 1)
        edges = np.geomspace(low, high, n_bands + 1)
        return tuple(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


def period_of(signal: RealArray) -> int | None:
    """Samples after which a signal repeats, at least once in full; None where it does not.

    Parameters
    ----------
    signal : ndarray, shape (T,)
        One signal, in any unit, at least one sample. Not checked: with a NaN no lag compares, and the answer
        is None.

    Returns
    -------
    int or None
        Shortest lag up to T / 2 at which the signal differs from itself by less than the share
        `_REPEATS_WITHIN_POWER` of its power. None, too, for a signal that stands still.

    Notes
    -----
    With x the signal without its mean, and sums over the samples that both have at a lag L,

        sum (x_k - x_{k+L})^2 / sum (x_k^2 + x_{k+L}^2) = 1 - 2 sum x_k x_{k+L} / sum (x_k^2 + x_{k+L}^2) .

    The correlation at all lags is one FFT.
    """
    n_samples = signal.size
    centred = signal - signal.mean()
    n_lags = n_samples // 2 + 1
    lags = np.arange(n_lags)

    # Sums of products at each lag; padded to twice the length, so that no end meets a start.
    spectrum = np.fft.rfft(centred, 2 * n_samples)
    correlation = np.fft.irfft(np.abs(spectrum) ** 2, 2 * n_samples)[:n_lags]

    # Sums of squares of the samples that have a partner: all but the first L, and all but the last L.
    energy_before = np.concatenate([[0.0], np.cumsum(centred**2)])
    energy_of_later = energy_before[n_samples] - energy_before[lags]
    energy_of_earlier = energy_before[n_samples - lags]
    energy_of_pairs = energy_of_later + energy_of_earlier
    # Without energy there is nothing to compare: such a lag counts as one that differs.
    difference = 1 - 2 * correlation / np.where(energy_of_pairs > 0, energy_of_pairs, np.inf)

    # A smooth signal resembles itself at short lags: the period comes after it has once differed.
    differing_lags = np.flatnonzero(difference > _HAS_DIFFERED_POWER)
    if not differing_lags.size:
        return None
    first_differing = differing_lags[0]
    repeating = np.flatnonzero(difference[first_differing:] < _REPEATS_WITHIN_POWER)
    if not repeating.size:
        return None
    return int(first_differing + repeating[0])


def distortion_of(records: Sequence[Record], *, period_samples: int | None = None) -> tuple[Distortion, ...]:
    """Levels of noise and distortion at every amplitude among records, lowest amplitude first.

    Without a record: empty. The output of a record may not hold NaN, which `Record` refuses.

    Parameters
    ----------
    records : sequence of Record
        With one input and one output each. Realisations of one amplitude share period and lines; records of
        the same input are further periods of one realisation.
    period_samples : int, optional
        Period that the user states, at least 1; else that of each input is found, and records without one are
        left out.

    Returns
    -------
    tuple of Distortion
        One for each amplitude; empty where no record is periodic.

    Raises
    ------
    ValueError
        A record is shorter than the stated period or does not repeat after it, periods differ between
        records, an output stands still, or a record has several inputs or outputs.
    """
    steady_records: list[_Steady] = []
    for record in records:
        record.refuse_several()
        period = _period(record, period_samples)
        if period is None:
            continue
        steady_records.append(_Steady.of(record, period))
        first = steady_records[0]
        if period != first.period:
            raise ValueError(
                f"{record.label}: its input repeats after {period} samples, that of "
                f"{first.record.label} after {first.period}; analyse them one by one"
            )
    amplitudes = [_levels(group) for group in in_groups(steady_records, _Steady.alike)]
    return tuple(sorted(amplitudes, key=lambda distortion: distortion.rms))


def _period(record: Record, stated: int | None) -> int | None:
    """Samples of a period of a record's only input; None where it has none and none is stated.

    Raises ValueError where the record is shorter than the stated period, or its input differs from itself a
    period later by more than `_REPEATS_WITHIN_POWER` of its power. A record of just one period cannot
    contradict it. stated: positive; not checked.
    """
    command = record.input[:, 0]
    if stated is None:
        return period_of(command)
    if record.n_samples < stated:
        raise ValueError(f"{record.label}: {record.n_samples} samples are no period of {stated}")
    later = command[stated:]
    change = later - command[:-stated]
    # Two periods that have nothing in common differ by twice the power of one.
    allowed = 2 * _REPEATS_WITHIN_POWER * np.sum((later - command.mean()) ** 2)
    if np.sum(change**2) > allowed:
        raise ValueError(f"{record.label}: the input does not repeat after {stated} samples")
    return stated


@dataclass(frozen=True, eq=False)
class _Steady:
    """Spectra of the whole periods of a record, at the harmonics 1 to H (H: half a period's samples).

    input (H,): mean over the periods, as `numpy.fft.rfft` has it. output (P, H): of each period, without the
    straight line. excited, silent (H,): which harmonics the input excites, and which not at all. drift: the
    output's mean advance from a period to the next, in its unit. period: in samples.
    """

    record: Record
    period: int
    input: ComplexArray
    output: ComplexArray
    excited: BoolArray
    silent: BoolArray
    drift: float

    @classmethod
    def of(cls, record: Record, period: int) -> _Steady:
        """Spectra of the last whole periods of a record, each of `period` samples.

        Raises ValueError where the output stands still there. period: from 1 to the record's samples, not
        checked; at least one period is left. An input that stands still gives NaN shares of power, so that no
        line is excited; `period_of` leaves it out.
        """
        n_samples = record.n_samples
        n_periods = n_samples // period
        if n_periods * period == n_samples and n_periods > 1:
            # Nothing else lies before the whole periods: the first one is the transient.
            n_periods -= 1
        begin = n_samples - n_periods * period
        inputs = record.input[begin:, 0].reshape(n_periods, period)
        outputs = record.output[begin:, 0].reshape(n_periods, period)
        if not np.ptp(outputs) > 0:
            raise ValueError(
                f"{record.label}: output column '{record.output_names[0]}' stands still at "
                f"{outputs[0, 0]:.6g}; expected a response to the input"
            )

        # The output of an integrating arm goes on from period to period: as a line that is no part of them.
        advance = 0.0
        if n_periods > 1:
            advance = float((outputs[-1].mean() - outputs[0].mean()) / (n_periods - 1))
        samples = np.arange(n_periods * period).reshape(n_periods, period)
        line = advance * samples / period
        # The mean of a period says nothing of the response: harmonics from 1 on.
        input_spectrum = np.fft.rfft(inputs, axis=1)[:, 1:].mean(axis=0)
        output_spectra = np.fft.rfft(outputs - line, axis=1)[:, 1:]
        input_power = np.abs(input_spectrum) ** 2
        relative_power = input_power / np.max(input_power)
        return cls(
            record,
            period,
            input=input_spectrum,
            output=output_spectra,
            excited=relative_power > EXCITED,
            silent=relative_power < _SILENT,
            drift=advance,
        )

    @property
    def rms(self) -> float:
        """Root mean square of the input about its mean, in its unit (Parseval; a line at half the sampling
        frequency, if there is one, counts twice).

        Of the mean over the whole periods, so that noise of a measured input averages away.
        """
        energy = 2 * np.sum(np.abs(self.input) ** 2)
        return float(np.sqrt(energy) / self.period)

    def alike(self, other: _Steady) -> bool:
        """Whether two records have one period, the same excited lines and, within `SAME`, one amplitude.

        The other's rms must not be zero; `period_of` leaves such inputs out.
        """
        if self.period != other.period:
            return False
        if not np.array_equal(self.excited, other.excited):
            return False
        return abs(self.rms / other.rms - 1) < SAME

    def has_input_of(self, other: _Steady) -> bool:
        """Whether the inputs of two records of one period agree within `SAME`: one realisation.

        Periods are not compared: numpy raises ValueError for spectra of different length.
        """
        difference = np.linalg.norm(self.input - other.input)
        return bool(difference < SAME * np.linalg.norm(self.input))


def _levels(group: Sequence[_Steady]) -> Distortion:
    """Levels of the records of one amplitude, period and set of lines.

    Of F excited lines among H harmonics; M realisations, each with its records' periods together. group: at
    least one, alike by `_Steady.alike`, with one excited line at least; not checked, as `distortion_of`
    groups them.
    """
    first = group[0]
    realisations = in_groups(group, _Steady.has_input_of)
    outputs = [np.vstack([steady.output for steady in same]) for same in realisations]
    inputs = np.stack([same[0].input for same in realisations])
    means = np.stack([output.mean(axis=0) for output in outputs])
    n_realisations = len(outputs)
    harmonics = np.arange(1, inputs.shape[1] + 1)
    omega_rad_s = 2 * np.pi * harmonics / (first.period * first.record.dt_s)

    # Power of the noise in one period (H,), from what differs between the periods of a realisation.
    noise_freedom = sum(output.shape[0] - 1 for output in outputs)
    noise = None
    if noise_freedom:
        squares = np.zeros(harmonics.size)
        for output, mean in zip(outputs, means, strict=True):
            squares += np.sum(np.abs(output - mean) ** 2, axis=0)
        # Moving mean over harmonics, narrower next to zero, where drift makes noise steep.
        running_sum = np.concatenate([[0.0], np.cumsum(squares / noise_freedom)])
        index = np.arange(running_sum.size - 1)
        to_nearer_end = np.minimum(index, index[::-1])
        reach = np.minimum(to_nearer_end, _SMOOTHING_HARMONICS)
        noise = (running_sum[index + reach + 1] - running_sum[index - reach]) / (2 * reach + 1)
    # The mean of P periods has 1 / P of the noise.
    share_in_mean = float(np.mean([1 / output.shape[0] for output in outputs]))

    # Best linear approximation at the excited lines.
    lines = np.flatnonzero(first.excited)
    responses = means[:, lines] / inputs[:, lines]
    gain = responses.mean(axis=0)
    input_power = np.mean(np.abs(inputs[:, lines]) ** 2, axis=0)

    # What differs between realisations there: noise and distortion.
    scatter = None
    if n_realisations > 1:
        scatter = LineLevels(
            omega_rad_s[lines],
            # The mean was taken off, which takes one of M degrees of freedom.
            of_each=np.abs(responses - gain) ** 2 * n_realisations / (n_realisations - 1),
            freedom=n_realisations - 1,
            noise=None if noise is None else share_in_mean * noise[lines] / input_power,
            noise_freedom=noise_freedom,
            gain=np.abs(gain),
        )

    # What comes at lines between them, as if these had the excitation and the gain of their neighbours.
    above_lowest = harmonics > harmonics[lines[0]]
    below_highest = harmonics < harmonics[lines[-1]]
    between = first.silent & above_lowest & below_highest
    remainders = harmonics % 2
    log_omega = np.log(omega_rad_s[lines])
    silent_levels: list[LineLevels | None] = []
    for remainder in (0, 1):
        has_parity = remainders == remainder
        silent_lines = np.flatnonzero(between & has_parity)
        if not silent_lines.size:
            silent_levels.append(None)
            continue
        at_log_omega = np.log(omega_rad_s[silent_lines])
        power_there = np.exp(np.interp(at_log_omega, log_omega, np.log(input_power)))
        log_gain_there = np.interp(at_log_omega, log_omega, np.log(np.abs(gain) + _SMALLEST_GAIN))
        levels = LineLevels(
            omega_rad_s[silent_lines],
            of_each=np.abs(means[:, silent_lines]) ** 2 / power_there,
            freedom=n_realisations,
            noise=None if noise is None else share_in_mean * noise[silent_lines] / power_there,
            noise_freedom=noise_freedom,
            gain=np.exp(log_gain_there),
        )
        silent_levels.append(levels)
    even_levels, odd_levels = silent_levels

    return Distortion(
        rms=float(np.mean([steady.rms for steady in group])),
        names=tuple(steady.record.name for steady in group),
        dt_s=first.record.dt_s,
        period_samples=first.period,
        realisations=n_realisations,
        periods=min(output.shape[0] for output in outputs),
        omega_rad_s=omega_rad_s[lines],
        gain=gain,
        noise_std=None if noise is None else np.sqrt(noise[lines] / input_power),
        excited=scatter,
        odd=odd_levels,
        even=even_levels,
        drift=max((steady.drift for steady in group), key=abs),
    )
