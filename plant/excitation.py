"""Excitation signals: voltages (T,) for experiments.

Random binary sequences (`prbs`), sums of sines on chosen lines (`multisine_lines`, `multisine`), a sweep
(`log_chirp`) and pulses (`doublet`, `bang_bang`). All take the sampling period in seconds or lengths in
samples, and refuse what they cannot make with a ValueError. Random phases, lines and start states come from a
`numpy.random.Generator` that the caller passes in.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

Real = npt.NDArray[np.float64]
Integer = npt.NDArray[np.int64]
Grid = Literal["full", "odd", "odd_random"]

# Rounding of a frequency on a line, or of a time on a sample, as a share of their spacing: within it the one
# is meant as the other. Far above 1e-16 times the number of samples.
_ROUNDING = 1e-9


def prbs(
    register_length: int,
    hold_samples: int,
    amplitude_V: float,
    n_samples: int,
    start: np.random.Generator | int | npt.ArrayLike | None = None,
) -> Real:
    """Pseudo-random binary sequence +-amplitude of maximum length, every value held for hold_samples.

    The period is (2^register_length - 1) * hold_samples; the sequence s of one period (unheld, unit
    amplitude) has the circular autocorrelation sum_k s_k s_(k+l) = -1 for every l but 0.

    Parameters
    ----------
    register_length : int
        Bits of the shift register, 2 to 20 (a period of a million values).
    hold_samples, n_samples : int
        Samples that a value is held for, and samples of the signal.
    amplitude_V : float
        Voltages are + and - this.
    start : optional
        Register at the start: bits (register_length,) that are not all zero, or a generator (or the seed of
        one) that draws them (the first bit is then set to 1); None starts with all ones.

    Returns
    -------
    (n_samples,)
        Voltages, V.

    Raises
    ------
    ValueError
        A register length outside 2..20, a hold or length below 1, a bad amplitude or register.

    Examples
    --------
    >>> flexlink.prbs(register_length=3, hold_samples=1, amplitude_V=2.0, n_samples=7)
    array([ 2.,  2.,  2., -2.,  2., -2., -2.])
    """
    if not 2 <= register_length <= 20:
        raise ValueError(f"register_length must be 2..20; got {register_length}")
    if not (hold_samples >= 1 and n_samples >= 1):
        raise ValueError(f"need hold_samples >= 1 and n_samples >= 1; got {hold_samples} and {n_samples}")
    _check_positive(amplitude_V=amplitude_V)
    if start is None:
        register = np.ones(register_length, dtype=np.int8)
    elif isinstance(start, (int, np.random.Generator)):
        register = np.random.default_rng(start).integers(0, 2, register_length).astype(np.int8)
        register[0] = 1
    else:
        register = np.array(start, dtype=np.int8)
    is_binary = np.all(np.isin(register, (0, 1)))
    if register.shape != (register_length,) or not is_binary or not register.any():
        raise ValueError(
            f"the register needs {register_length} bits that are not all zero; got {register.tolist()}"
        )
    from scipy.signal import max_len_seq  # here: every command would wait for it

    n_values = -(-n_samples // hold_samples)
    bits, _ = max_len_seq(register_length, state=register, length=n_values)
    held_bits = np.repeat(bits, hold_samples)[:n_samples]
    signs = np.where(held_bits == 1, 1.0, -1.0)
    return amplitude_V * signs


def multisine_lines(
    period_samples: int,
    dt_s: float,
    band_Hz: tuple[float, float],
    grid: Grid = "full",
    rng: np.random.Generator | None = None,
) -> Integer:
    """Harmonics (of the frequency 1 / (period_samples * dt_s)) a multisine excites, ascending.

    "full" takes every harmonic in the band, "odd" the odd ones, "odd_random" the odd ones less one drawn from
    every group of four: even and odd distortions of a nonlinear machine then appear at lines that are not
    excited.

    Parameters
    ----------
    period_samples : int
        Samples of a period.
    dt_s : float
        Sampling period.
    band_Hz : pair of float
        Lowest and highest frequency, both included.
    grid : str
        Which harmonics of the band, see above.
    rng : numpy.random.Generator, optional
        Draws the lines that "odd_random" leaves out.

    Returns
    -------
    (H,) of int
        A line h has the frequency h / (period_samples * dt_s).

    Raises
    ------
    ValueError
        No line is left, the band is not 0 < low < high < Nyquist, or "odd_random" comes without a generator.
    """
    if period_samples < 2:
        raise ValueError(f"period_samples must be at least 2; got {period_samples}")
    _check_positive(dt_s=dt_s)
    low, high = band_Hz
    if not 0 < low < high < 0.5 / dt_s:
        raise ValueError(f"need 0 < low < high < {0.5 / dt_s} Hz (Nyquist); got {band_Hz}")
    if grid not in ("full", "odd", "odd_random"):
        raise ValueError(f"grid must be full, odd or odd_random; got {grid!r}")
    spacing = 1.0 / (period_samples * dt_s)
    # A band edge that is a line within rounding is meant as one.
    lowest_line = np.ceil(low / spacing - _ROUNDING)
    highest_line = np.floor(high / spacing + _ROUNDING)
    lines = np.arange(lowest_line, highest_line + 1).astype(np.int64)
    if grid != "full":
        is_odd = lines % 2 == 1
        lines = lines[is_odd]
    if grid == "odd_random":
        if rng is None:
            raise ValueError("grid odd_random draws lines and needs rng")
        groups = np.arange(lines.size // 4) * 4
        left_out = rng.integers(0, 4, groups.size)
        # The lowest line stays: it alone shows the band's edge.
        left_out[:1] = np.maximum(left_out[:1], 1)
        lines = np.delete(lines, groups + left_out)
    if lines.size == 0:
        raise ValueError(f"no {grid} line in {band_Hz} Hz with a line spacing of {spacing:.4g} Hz")
    return lines


def multisine(
    lines: npt.ArrayLike,
    period_samples: int,
    rms_V: float,
    rng: np.random.Generator,
    *,
    periods: int = 1,
    draws: int = 1,
    lead_in_samples: int = 0,
) -> Real:
    """Multisine of equal amplitudes with uniform random phases.

    Parameters
    ----------
    lines : (H,) of int
        Harmonics, from `multisine_lines`; 1 and up, below period_samples / 2.
    period_samples : int
        Samples of a period.
    rms_V : float
        Root mean square.
    rng : numpy.random.Generator
        Draws the phases.
    periods : int
        Whole periods.
    draws : int
        Number of phase draws, of which the one with the lowest crest factor is kept; 1 leaves the phases
        uniform.
    lead_in_samples : int
        Samples before the whole periods, of the same periodic signal: a machine that starts at rest is in
        steady state behind them.

    Returns
    -------
    (lead_in_samples + period_samples * periods,)
        Voltages, V.

    Raises
    ------
    ValueError
        Lines that are none or stand twice, or a number that is out of its range.

    Examples
    --------
    >>> voltage = flexlink.multisine(range(1, 100), 1000, 2.0, default_rng(1), periods=2)
    >>> voltage.shape, float(voltage.std().round(6))
    ((2000,), 2.0)
    """
    harmonics = np.asarray(lines, dtype=np.int64)
    if harmonics.ndim != 1 or harmonics.size == 0 or np.unique(harmonics).size != harmonics.size:
        raise ValueError("lines must be distinct harmonics, shape (H,)")
    if not (harmonics.min() >= 1 and 2 * harmonics.max() < period_samples):
        raise ValueError(
            f"lines must lie in 1..{(period_samples - 1) // 2}; got {harmonics.min()}..{harmonics.max()}"
        )
    _check_positive(rms_V=rms_V)
    if not (periods >= 1 and draws >= 1 and lead_in_samples >= 0):
        raise ValueError(
            f"need periods >= 1, draws >= 1, lead_in_samples >= 0; got {periods}, {draws}, {lead_in_samples}"
        )
    best = np.zeros(0)
    for _ in range(draws):
        spectrum = np.zeros(period_samples // 2 + 1, dtype=np.complex128)
        spectrum[harmonics] = np.exp(2j * np.pi * rng.random(harmonics.size))
        period = np.fft.irfft(spectrum, period_samples)
        if best.size == 0 or crest_factor(period) < crest_factor(best):
            best = period
    best *= rms_V / np.sqrt(np.mean(best**2))
    # The lead-in is the end of a period before the first.
    samples = np.arange(-lead_in_samples, periods * period_samples)
    return best[samples % period_samples]


def crest_factor(signal: Real) -> float:
    """Peak of a signal (T,) over its root mean square."""
    peak = np.max(np.abs(signal))
    rms = np.sqrt(np.mean(np.square(signal)))
    return float(peak / rms)


def log_chirp(start_Hz: float, stop_Hz: float, amplitude_V: float, n_samples: int, dt_s: float) -> Real:
    """Sine (T,) whose frequency grows by the same factor every second, from start to stop over the record.

    Its phase is 2 pi f0 T / ln(f1 / f0) ((f1 / f0)^(t / T) - 1), with start f0, stop f1 and duration T.
    Raises ValueError where a frequency is not between 0 and Nyquist, both are equal, or a size is not
    positive.
    """
    _check_positive(dt_s=dt_s, amplitude_V=amplitude_V, n_samples=n_samples)
    nyquist_Hz = 0.5 / dt_s
    if not (0 < start_Hz < nyquist_Hz and 0 < stop_Hz < nyquist_Hz and start_Hz != stop_Hz):
        raise ValueError(
            f"need different frequencies between 0 and {nyquist_Hz} Hz (Nyquist); "
            f"got {start_Hz} and {stop_Hz}"
        )
    rate = np.log(stop_Hz / start_Hz) / (n_samples * dt_s)
    time = np.arange(n_samples) * dt_s
    phase = 2 * np.pi * start_Hz * np.expm1(rate * time) / rate
    return np.asarray(amplitude_V * np.sin(phase))


def doublet(amplitude_V: float, start_s: float, pulse_s: float, n_samples: int, dt_s: float) -> Real:
    """Voltage (T,) of +amplitude for one pulse, -amplitude for the next, zero before and after.

    The first pulse begins at start_s; each lasts pulse_s. Raises ValueError where the start is negative or
    another number is not positive.
    """
    _check_positive(amplitude_V=amplitude_V, pulse_s=pulse_s, dt_s=dt_s, n_samples=n_samples)
    if not start_s >= 0:
        raise ValueError(f"start_s must not be negative; got {start_s}")
    # Against rounding: switching times that are multiples of dt_s fall on them.
    time_s = np.arange(n_samples) * dt_s
    pulse = np.floor((time_s - start_s) / pulse_s + _ROUNDING)
    voltage = np.zeros(time_s.size)
    is_first = pulse == 0
    is_second = pulse == 1
    voltage[is_first] = amplitude_V
    voltage[is_second] = -amplitude_V
    return voltage


def bang_bang(amplitude_V: float, start_s: float, slew_s: float, n_samples: int, dt_s: float) -> Real:
    """Voltage (T,) of a slew: from start_s +amplitude for half of slew_s, then -amplitude for the rest."""
    _check_positive(slew_s=slew_s)
    return doublet(amplitude_V, start_s, slew_s / 2, n_samples, dt_s)


def _check_positive(**values: float) -> None:
    """Raise ValueError, with its name, for the first of these values that is not positive and finite."""
    for name, value in values.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{name} must be positive and finite; got {value}")
