"""Empirical frequency responses and coherence, straight from records: the picture a model is held against.

`empirical_frf` divides averaged products of discrete Fourier transforms and takes the covariance from what
the ratio leaves of the same lines; `coherence` says which share of the output's power is linear in the input.
Both average over neighbouring spectral lines and over records (Ljung, System Identification, 2nd ed.,
sections 6.3 and 6.4). Assumed: the response hardly changes over an averaging width, and the noise is
independent from line to line. `spectra_of` makes the transforms, also for `repeats`. Of a `Record` matter
here input and output (T, 1), reference (T, R) or None, and dt_s [s]; its numbers are finite. The default
level of 0.95 is convention: 1 in 20 outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import detrend

from ident.data.arrays import ComplexArray, IntArray, RealArray
from ident.data.ellipses import circular_widening
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record import Record

# Lines over which `over_lines` averages a power spectrum. The power of white noise in one line has a relative
# standard deviation of 1, its mean over 25 lines one of a fifth; of 50, one of a seventh. Odd, so that a line
# has as many neighbours on either side.
SMOOTHED_LINES = 25
# Lines on either side of the middle one where the caller states none, and too few records for one line each:
# five lines, of which four degrees of freedom are left. More smear resonances; chosen.
USUAL_HALF_WIDTH_LINES = 2
# Terms (lines times records) from which a ratio and its variance are estimated: one parameter is fitted, so
# that two degrees of freedom are left. From this many records on a single line each is enough.
FEWEST_TERMS = 3


def empirical_frf(
    records: Record | Sequence[Record],
    *,
    omega_min_rad_s: float | None = None,
    omega_max_rad_s: float | None = None,
    half_width_lines: int | None = None,
    periodic: bool = False,
    level: float = 0.95,
) -> FrequencyUncertainty:
    """Estimate the frequency response by averaged ratios of Fourier transforms, with its covariance.

    Parameters
    ----------
    records : Record or sequence of Record
        One input and one output each, of equal length and sampling time.
    omega_min_rad_s, omega_max_rad_s : float, optional
        Band, rad/s; by default from the first line to the Nyquist frequency pi / dt.
    half_width_lines : int, optional
        h: lines on either side of the middle one of an averaging width. Default: 0 for three or more records,
        else 2.
    periodic : bool
        The records are whole periods in steady state. Else a straight line is taken off every signal.
    level : float
        Confidence level of the ellipses; ValueError outside of 0 to 1.

    Returns
    -------
    FrequencyUncertainty
        One frequency for each averaging width, the mean of its lines; circles, in units of output per input.

    Raises
    ------
    ValueError
        The records do not fit together, leave fewer than three spectral lines per estimate, or do not excite
        a frequency.

    Notes
    -----
    G = sum(Y conj(W)) / sum(U conj(W)) over 2 h + 1 neighbouring lines and all records, W the transform of
    the reference if every record has exactly one (unbiased in a loop), else of the input. The covariance is
    circular, from the residuals Y - G U of the same lines, widened to the quantile of F(2, 2 (n - 1)) at
    `level` for n independent terms. Records with one instrument repeat distortion: a line of all of them
    together is one term, unless h = 0, where distortion stays unseen.

    Examples
    --------
    >>> measured = flexlink.empirical_frf(example_record(), omega_max_rad_s=50.0)
    >>> measured.centre.shape == measured.omega_rad_s.shape
    True
    """
    records = (records,) if isinstance(records, Record) else records
    spectra = spectra_of(records, periodic)
    width = 2 * _half_width(half_width_lines, len(records)) + 1
    groups = _groups(spectra, width, omega_min_rad_s, omega_max_rad_s)
    centre, variance = _local_ratio(spectra, groups, level)

    # A circular complex error shares its variance between real and imaginary part.
    covariance = np.zeros((centre.size, 2, 2))
    covariance[:, 0, 0] = 0.5 * variance
    covariance[:, 1, 1] = 0.5 * variance
    return FrequencyUncertainty(
        spectra.omega_rad_s[groups].mean(axis=1),
        centre,
        covariance,
        records[0].dt_s,
        level,
        "empirical, by reference" if spectra.by_reference else "empirical",
    )


def coherence(
    records: Sequence[Record], *, half_width_lines: int | None = None
) -> tuple[RealArray, RealArray]:
    """Return frequencies and the magnitude-squared coherence of input and output, 0 to 1.

    Parameters
    ----------
    records : sequence of Record
        One input and one output each, of equal length and sampling time.
    half_width_lines : int, optional
        Lines on either side of the middle one of an averaging width, as in `empirical_frf`.

    Returns
    -------
    omega_rad_s : ndarray, shape (F,)
        Means of the averaging widths, rad/s.
    value : ndarray, shape (F,)
        abs(sum(Y conj(U)))^2 / (sum(abs(U)^2) sum(abs(Y)^2)), 0 where a signal stands still. 1 minus it is
        the share of the output's power that no linear response to this input explains: noise, another input,
        or nonlinearity.

    Raises
    ------
    ValueError
        Records that do not fit together (`spectra_of`), a half width that is negative or leaves fewer than
        three terms, or fewer lines than one averaging width.
    """
    spectra = spectra_of(records, periodic=False)
    width = 2 * _half_width(half_width_lines, len(records)) + 1
    groups = _groups(spectra, width, None, None)
    u = spectra.input[:, groups]
    y = spectra.output[:, groups]

    # Sums over records (axis 0) and the lines of a width (axis 2).
    cross_power = np.abs(np.sum(y * u.conj(), axis=(0, 2))) ** 2
    input_power = np.sum(np.abs(u) ** 2, axis=(0, 2))
    output_power = np.sum(np.abs(y) ** 2, axis=(0, 2))
    power = input_power * output_power
    value = np.divide(cross_power, power, out=np.zeros_like(cross_power), where=power > 0)
    omega_rad_s = spectra.omega_rad_s[groups].mean(axis=1)
    # Rounding may lift a value of 1.
    return omega_rad_s, np.minimum(value, 1.0)


@dataclass(frozen=True, eq=False)
class Spectra:
    """Discrete Fourier transforms of R records at F lines, the line at zero left out.

    Attributes
    ----------
    omega_rad_s : ndarray, shape (F,)
        Frequencies of the lines, rad/s.
    input, output : ndarray, shape (R, F)
        Complex transforms, in units of the signals times samples.
    instrument : ndarray, shape (R, F)
        Of the reference where every record has exactly one column of it, else of the input.
    by_reference : bool
        Whether the instrument is the reference.
    """

    omega_rad_s: RealArray
    input: ComplexArray
    output: ComplexArray
    instrument: ComplexArray
    by_reference: bool


def spectra_of(records: Sequence[Record], periodic: bool) -> Spectra:
    """Return the discrete Fourier transforms of records of one length.

    Parameters
    ----------
    records : sequence of Record
        One input and one output each, and at least two samples, as one has no line.
    periodic : bool
        The records are whole periods in steady state; not checked. Else a straight line is taken off every
        signal, so that drift does not leak into the lines.

    Returns
    -------
    Spectra

    Raises
    ------
    ValueError
        No record, several inputs or outputs, or another length or sampling time than that of the first.
    """
    if not records:
        raise ValueError("need at least one record")
    first = records[0]
    for record in records:
        record.refuse_several()
        if record.n_samples != first.n_samples or record.dt_s != first.dt_s:
            raise ValueError(
                f"{record.label}: {record.n_samples} samples at {record.dt_s} s, but {first.label} has "
                f"{first.n_samples} at {first.dt_s} s; they must be alike"
            )

    def transform(signals: list[RealArray]) -> ComplexArray:
        """Return the transforms (R, F) of R signals, (T,) each, without the line at zero.

        F = T // 2 lines; signals of one length, which is checked above.
        """
        stacked = np.stack(signals)
        if not periodic:
            stacked = detrend(stacked, axis=1, type="linear")
        lines = np.fft.rfft(stacked, axis=1)[:, 1:]
        return np.asarray(lines, dtype=np.complex128)

    input_spectra = transform([record.input[:, 0] for record in records])
    output_spectra = transform([record.output[:, 0] for record in records])
    references = [record.reference for record in records]
    by_reference = all(reference is not None and reference.shape[1] == 1 for reference in references)
    if by_reference:
        instrument = transform([reference[:, 0] for reference in references if reference is not None])
    else:
        instrument = input_spectra
    # Line k of T samples has k periods in T dt.
    line_numbers = np.arange(1, input_spectra.shape[1] + 1)
    return Spectra(
        omega_rad_s=2 * np.pi * line_numbers / (first.n_samples * first.dt_s),
        input=input_spectra,
        output=output_spectra,
        instrument=instrument,
        by_reference=by_reference,
    )


def _half_width(half_width_lines: int | None, n_records: int) -> int:
    """Return the lines on either side of the middle one of an averaging width: the stated number, else 0 for
    three or more records and 2 for fewer.

    Raises ValueError where it is negative, or leaves fewer than three terms (lines times records) for an
    estimate.
    """
    # Three records give three terms in a single line; fewer need neighbouring lines.
    if half_width_lines is not None:
        half_width = half_width_lines
    elif n_records >= FEWEST_TERMS:
        half_width = 0
    else:
        half_width = USUAL_HALF_WIDTH_LINES
    if half_width < 0:
        raise ValueError(f"half_width_lines must not be negative; got {half_width}")
    if n_records * (2 * half_width + 1) < FEWEST_TERMS:
        raise ValueError(
            "an estimate with covariance needs at least three lines: more records or half_width_lines >= 1"
        )
    return half_width


def _groups(
    spectra: Spectra, width: int, omega_min_rad_s: float | None, omega_max_rad_s: float | None
) -> IntArray:
    """Return the line indices (F, width) of averaging widths that lie side by side in a band.

    width: lines in each; omega_min_rad_s, omega_max_rad_s: ends of the band, rad/s, None where it is open.
    Lines at the upper end that do not fill a width are left out. Raises ValueError where not one fits. Ends
    that are exchanged or NaN hold no line.
    """
    low = 0.0 if omega_min_rad_s is None else omega_min_rad_s
    high = np.inf if omega_max_rad_s is None else omega_max_rad_s
    lines = np.flatnonzero((spectra.omega_rad_s >= low) & (spectra.omega_rad_s <= high))
    n_widths = lines.size // width
    if n_widths == 0:
        raise ValueError(f"no averaging width of {width} lines fits between {low:.6g} and {high:.6g} rad/s")
    return lines[: n_widths * width].reshape(n_widths, width)


def _local_ratio(spectra: Spectra, groups: IntArray, level: float) -> tuple[ComplexArray, RealArray]:
    """Return the response (F,) at each averaging width and its variance E abs(G_hat - G)^2 (F,).

    groups: line indices (F, width), width times records at least `FEWEST_TERMS`; not checked. The variance is
    widened so that a chi-square ellipse at `level` holds the response at that level in spite of few terms.
    Raises ValueError where a width is not excited.
    """
    u = spectra.input[:, groups]
    y = spectra.output[:, groups]
    w = spectra.instrument[:, groups]
    input_power = np.sum(u * w.conj(), axis=(0, 2))
    if np.any(input_power == 0):
        not_excited = int(np.argmax(input_power == 0))
        omega = spectra.omega_rad_s[groups[not_excited, 0]]
        raise ValueError(f"the records do not excite omega = {omega:.6g} rad/s")
    centre = np.sum(y * w.conj(), axis=(0, 2)) / input_power

    # Terms (R, F, width) whose sum over records and lines is the error of the ratio's numerator. Records
    # with one instrument have the same distortion in a line: over them it is added, not averaged away.
    terms = (y - centre[:, None] * u) * w.conj()
    # One instrument but for rounding of logs with six digits and more; beside lines that hardly count (1e-9
    # of the largest) nothing is compared.
    several_lines = terms.shape[2] > 1
    smallest_difference = 1e-9 * float(np.abs(w).max())
    if several_lines and np.allclose(w, w[:1], rtol=1e-6, atol=smallest_difference):
        terms = terms.sum(axis=0, keepdims=True)

    # One complex parameter was fitted per group, hence n - 1.
    n_terms = terms.shape[0] * terms.shape[2]
    error_power = np.sum(np.abs(terms) ** 2, axis=(0, 2)) * n_terms / (n_terms - 1)
    variance = circular_widening(n_terms - 1, level) * error_power / np.abs(input_power) ** 2
    return centre, variance


def over_lines(power: RealArray) -> RealArray:
    """Return the mean of every line of a power spectrum (F,) and its 24 neighbours, (F,).

    Lines beyond the ends count as zero, so that the mean falls off within 12 lines of them. Of fewer than 25
    lines the mean is over as many as there are. ValueError of NumPy for none.
    """
    width = min(SMOOTHED_LINES, power.size)
    return np.convolve(power, np.full(width, 1 / width), "same")
