"""Empirical frequency responses straight from records, and coherence: the picture a model is held against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import detrend

from ident.data.arrays import ComplexArray, IntArray, RealArray
from ident.data.ellipses import circular_widening
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record import Record

_LINES = 25  # power of white noise, averaged over so many lines, scatters by a fifth


def empirical_frf(
    records: Record | Sequence[Record],
    *,
    omega_min_rad_s: float | None = None,
    omega_max_rad_s: float | None = None,
    half_width_lines: int | None = None,
    periodic: bool = False,
    level: float = 0.95,
) -> FrequencyUncertainty:
    """Frequency response by averaged ratios of discrete Fourier transforms, with its covariance.

    G = sum(Y conj(W)) / sum(U conj(W)) over 2 half_width_lines + 1 neighbouring lines and all records, W the
    reference if every record has exactly one (unbiased in a loop), else the input. The covariance is
    circular, from the residuals Y - G U of the same lines, widened to the quantile of F(2, 2 (n - 1)) at
    `level` for n independent terms. Records with the same instrument repeat distortion: a line of all
    together is one term, unless half_width_lines = 0, where distortion stays unseen.

    records: SISO, equal length and sampling time. half_width_lines: default 0 for three or more records, else
    2. One frequency per averaging width, from omega_min_rad_s to omega_max_rad_s (pi/dt). periodic: whole
    periods in steady state; else a straight line is taken off every signal. Raises ValueError when the
    records do not fit together or leave fewer than three spectral lines per estimate.
    """
    records = (records,) if isinstance(records, Record) else records
    spectra = spectra_of(records, periodic)
    width = 2 * _half_width(half_width_lines, len(records)) + 1
    groups = _groups(spectra, width, omega_min_rad_s, omega_max_rad_s)
    centre, variance = _local_ratio(spectra, groups, level)
    covariance = np.zeros((centre.size, 2, 2))
    covariance[:, 0, 0] = covariance[:, 1, 1] = 0.5 * variance
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
    """omega (F,) and the magnitude-squared coherence (F,) of input and output, 0..1.

    Averaged over the same lines and records as `empirical_frf`. 1 minus it is the share of the output's power
    that no linear response to this input explains: noise, another input, or nonlinearity.
    """
    spectra = spectra_of(records, periodic=False)
    groups = _groups(spectra, 2 * _half_width(half_width_lines, len(records)) + 1, None, None)
    u, y = spectra.input[:, groups], spectra.output[:, groups]
    cross = np.abs(np.sum(y * u.conj(), axis=(0, 2))) ** 2
    power = np.sum(np.abs(u) ** 2, axis=(0, 2)) * np.sum(np.abs(y) ** 2, axis=(0, 2))
    value = np.divide(cross, power, out=np.zeros_like(cross), where=power > 0)
    return spectra.omega_rad_s[groups].mean(axis=1), np.minimum(value, 1.0)


@dataclass(frozen=True, eq=False)
class Spectra:
    """(R, F) transforms of all records at omega (F,), the line at zero left out."""

    omega_rad_s: RealArray
    input: ComplexArray
    output: ComplexArray
    instrument: ComplexArray
    by_reference: bool


def spectra_of(records: Sequence[Record], periodic: bool) -> Spectra:
    """Transforms of SISO records of one length, as `empirical_frf` takes them; else ValueError."""
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
    references = [record.reference for record in records]
    by_reference = all(reference is not None and reference.shape[1] == 1 for reference in references)

    def transform(signals: list[RealArray]) -> ComplexArray:
        stacked = np.stack(signals)
        if not periodic:
            stacked = detrend(stacked, axis=1, type="linear")
        return np.asarray(np.fft.rfft(stacked, axis=1)[:, 1:], dtype=np.complex128)

    u = transform([record.input[:, 0] for record in records])
    return Spectra(
        omega_rad_s=2 * np.pi * np.arange(1, u.shape[1] + 1) / (first.n_samples * first.dt_s),
        input=u,
        output=transform([record.output[:, 0] for record in records]),
        instrument=transform([r[:, 0] for r in references if r is not None]) if by_reference else u,
        by_reference=by_reference,
    )


def _half_width(half_width_lines: int | None, n_records: int) -> int:
    half = (0 if n_records >= 3 else 2) if half_width_lines is None else half_width_lines
    if half < 0:
        raise ValueError(f"half_width_lines must not be negative; got {half}")
    if n_records * (2 * half + 1) < 3:
        raise ValueError(
            "an estimate with covariance needs at least three lines: more records or half_width_lines >= 1"
        )
    return half


def _groups(spectra: Spectra, width: int, omega_min: float | None, omega_max: float | None) -> IntArray:
    """(F, width) line indices of non-overlapping averaging widths inside the band."""
    low = 0.0 if omega_min is None else omega_min
    high = np.inf if omega_max is None else omega_max
    inside = np.flatnonzero((spectra.omega_rad_s >= low) & (spectra.omega_rad_s <= high))
    count = inside.size // width
    if count == 0:
        raise ValueError(f"no averaging width of {width} lines fits between {low:.6g} and {high:.6g} rad/s")
    return inside[: count * width].reshape(count, width)


def _local_ratio(spectra: Spectra, groups: IntArray, level: float) -> tuple[ComplexArray, RealArray]:
    """Centre (F,) and widened variance E|G_hat - G|^2 (F,)."""
    u, y, w = spectra.input[:, groups], spectra.output[:, groups], spectra.instrument[:, groups]
    denominator = np.sum(u * w.conj(), axis=(0, 2))
    if np.any(denominator == 0):
        at = spectra.omega_rad_s[groups[int(np.argmax(denominator == 0)), 0]]
        raise ValueError(f"the records do not excite omega = {at:.6g} rad/s")
    centre = np.sum(y * w.conj(), axis=(0, 2)) / denominator
    terms = (y - centre[:, None] * u) * w.conj()
    if terms.shape[2] > 1 and np.allclose(w, w[:1], rtol=1e-6, atol=1e-9 * float(np.abs(w).max())):
        terms = terms.sum(axis=0, keepdims=True)
    n_terms = terms.shape[0] * terms.shape[2]
    # One complex parameter was fitted per group, hence n - 1.
    power = np.sum(np.abs(terms) ** 2, axis=(0, 2)) * n_terms / (n_terms - 1)
    return centre, circular_widening(n_terms - 1, level) * power / np.abs(denominator) ** 2


def over_lines(power: RealArray) -> RealArray:
    """Mean of every line of a spectrum and its neighbours."""
    return np.convolve(power, np.full(_LINES, 1 / _LINES), "same")
