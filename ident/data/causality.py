"""Which of two signals leads, and whether a command moves a signal, by their numbers alone.

Without scipy, which a log that is refused should not wait for.
"""

from __future__ import annotations

import numpy as np

from ident.data.arrays import RealArray

# Least correlation of the changes of two signals of which one follows the other.
_FOLLOWS = 0.5
# Samples of the past that predict the next one: dead times and two modes of a machine are within.
_LAGS = 8
# F statistic of what a cause adds: 1 where it says nothing, 2.5 at the 1 % level for 8 and many degrees of
# freedom. Set points lie at 7 and less, machines half hidden in noise at 20.
_LEAST_F = 10.0
# A set point that is smooth is predicted by its own past but for its corners, of which a command that answers
# to it tells something: by this factor less than of the output.
_FAR_LESS = 20.0
# Share of its power that a signal's own past leaves; below it is computed (a sum of sines), not measured.
_COMPUTED = 1e-14


def leads(first: RealArray, second: RealArray) -> bool | None:
    """Whether the first signal (T,) leads the second, by the largest correlation of their changes; None where
    they have no such lag."""
    lag, correlation = _best_lag(np.diff(first), np.diff(second))
    if lag == 0 or correlation <= _FOLLOWS:
        return None
    return lag > 0


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
    """Whether a command (T,) moves a signal (T,), as it does a measured position in any loop."""
    return _tells(command, signal) > _LEAST_F


def is_loop(reference: RealArray, output: RealArray, command: RealArray) -> bool:
    """Whether three signals, (T,) each, are those of a closed loop.

    The command moves the output and, far less, the reference; and it answers to the reference. Of two
    measured positions in open loop the command answers to neither.
    """
    moved_output = _tells(command, output)
    moved_reference = _tells(command, reference)
    if not moved_output > _LEAST_F or not moved_reference < max(_LEAST_F, moved_output / _FAR_LESS):
        return False
    return _tells(reference, command, beside=output) > _LEAST_F


def _tells(cause: RealArray, signal: RealArray, beside: RealArray | None = None) -> float:
    """How much a cause (T,) tells of the next sample of a signal (T,): 1 where it tells nothing.

    beside: another signal whose samples are known as well. Where it is given, the samples of both at the same
    time count, too: a controller answers at once.

    Notes
    -----
    Granger's test: the signal is predicted by least squares from its own last samples, and from those and
    the cause; the F statistic compares the residuals. 0 where too few samples are there, or the signal is
    computed (a sum of sines) so that its own past leaves nothing.
    """
    own = _past(signal, 1)
    if beside is None:
        known = own
        added = _past(cause, 1)
    else:
        known = [*own, *_past(beside, 0)]
        added = _past(cause, 0)
    rows = signal.size - _LAGS
    unknowns = 1 + len(known) + len(added)
    if rows < 3 * unknowns:
        return 0.0
    target = (signal - np.mean(signal))[_LAGS:]
    without = _residual(target, [np.ones(rows), *known])
    with_cause = _residual(target, [np.ones(rows), *known, *added])
    if not without > _COMPUTED * float(np.sum(target**2)):
        return 0.0
    return (without - with_cause) / len(added) * (rows - unknowns) / max(with_cause, np.finfo(float).tiny)


def _past(signal: RealArray, first_lag: int) -> list[RealArray]:
    """A signal (T,) delayed by each lag from the first one on, cut to the samples that have all of them."""
    centred = signal - np.mean(signal)
    return [centred[_LAGS - lag : centred.size - lag] for lag in range(first_lag, _LAGS + 1)]


def _residual(target: RealArray, regressors: list[RealArray]) -> float:
    """Sum of squares that the best combination of regressors, (T,) each, leaves of the target (T,)."""
    matrix = np.column_stack(regressors)
    coefficients = np.linalg.lstsq(matrix, target, rcond=None)[0]
    return float(np.sum((target - matrix @ coefficients) ** 2))
