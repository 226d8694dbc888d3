"""Which of two signals leads, and whether a command moves a signal, by their numbers alone.

Without scipy, which a log that is refused should not wait for.
"""

from __future__ import annotations

import numpy as np

from ident.data.arrays import RealArray

# Least correlation of two signals, or of their changes, of which one follows the other.
_FOLLOWS = 0.5
# Ratio of the sizes of an output and its reference: a loop that rings doubles a step.
_ALIKE_SIZES = 2.0
# Samples of the past that predict the next one: dead times and two modes of a machine are within.
_LAGS = 8
# F statistic of the command's past: 1 where it says nothing, 2.5 at the 1 % level for 8 and many degrees of
# freedom. A set point's own periods, and a machine half hidden in noise, lie at 7 and 20.
_MOVED_F = 10.0
# Share of its power that a signal's own past leaves; below it is computed (a sum of sines), not measured.
_COMPUTED = 1e-12


def leads(first: RealArray, second: RealArray) -> bool | None:
    """Whether the first signal (T,) leads the second, by the largest correlation of their changes; None where
    they have no such lag."""
    lag, correlation = _best_lag(np.diff(first), np.diff(second))
    if lag == 0 or correlation <= _FOLLOWS:
        return None
    return lag > 0


def follows(reference: RealArray, output: RealArray) -> bool:
    """Whether an output (T,) is its reference (T,), in size and, later or at once, in shape."""
    lag, correlation = _best_lag(reference, output)
    sizes = np.std(reference), np.std(output)
    return lag >= 0 and correlation > _FOLLOWS and max(sizes) < _ALIKE_SIZES * min(sizes)


def _best_lag(first: RealArray, second: RealArray) -> tuple[int, float]:
    """By how many samples the second signal (T,) is later than the first where they correlate best, and that
    correlation."""
    one = first - np.mean(first)
    other = second - np.mean(second)
    size = np.linalg.norm(one) * np.linalg.norm(other)
    # Padded, so that no end meets a start.
    spectra = [np.fft.rfft(signal, 2 * one.size) for signal in (one, other)]
    correlation = np.fft.irfft(spectra[0].conj() * spectra[1]) / max(size, np.finfo(float).tiny)
    lag = int(np.argmax(correlation))
    best = float(correlation[lag])
    return (lag - 2 * one.size if lag > one.size else lag), best


def is_moved_by(signal: RealArray, command: RealArray) -> bool:
    """Whether a command (T,) moves a signal (T,).

    Notes
    -----
    Granger's test: two linear predictions of the signal by least squares, from its own last samples, and from
    those and the last ones of the command; the F statistic compares their residuals. A measured position
    passes in open and in closed loop. A set point does not: the command follows it, not the other way round.
    """
    rows = signal.size - _LAGS
    unknowns = 2 * _LAGS + 1
    if rows < 3 * unknowns:
        return False
    centred = signal - np.mean(signal)
    past = [centred[_LAGS - lag : -lag] for lag in range(1, _LAGS + 1)]
    commands = [(command - np.mean(command))[_LAGS - lag : -lag] for lag in range(1, _LAGS + 1)]
    power = float(np.sum(centred[_LAGS:] ** 2))
    by_itself = _residual(centred[_LAGS:], [np.ones(rows), *past])
    with_command = _residual(centred[_LAGS:], [np.ones(rows), *past, *commands])
    if not by_itself > _COMPUTED * power:
        return False
    statistic = (by_itself - with_command) / _LAGS * (rows - unknowns)
    return bool(statistic > _MOVED_F * with_command)


def _residual(target: RealArray, regressors: list[RealArray]) -> float:
    """Sum of squares that the best combination of regressors, (T,) each, leaves of the target (T,)."""
    matrix = np.column_stack(regressors)
    coefficients = np.linalg.lstsq(matrix, target, rcond=None)[0]
    return float(np.sum((target - matrix @ coefficients) ** 2))
