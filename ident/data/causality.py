"""Which of two signals leads, and whether a command moves a signal, by their numbers alone.

A log whose columns are not named clearly is sorted into command, reference and output by what its signals
do. `leads` finds the lag at which the changes of two signals correlate best. `is_moved_by` asks whether the
past of a command improves the prediction of a signal from its own past, `is_loop` asks it of all three
signals of a loop (C. W. J. Granger, Econometrica 37(3), 1969). Assumed: linear dependence over at most eight
samples. Without scipy, which a log that is refused should not wait for.
"""

from __future__ import annotations

import numpy as np

from ident.data.arrays import RealArray

# Least correlation of the changes of two signals of which one follows the other: a quarter of the power of
# either is then the other's. The largest over all lags of two noises of a thousand samples is about .09.
LEAST_CORRELATION = 0.5
# Samples of the past that predict the next one: dead times and two modes of a machine are within. With 16,
# six of 21 pairs of signals of the tests no longer count as moved, being half hidden in noise; with 4, two.
LAGS = 8
# F statistic of what a cause adds, from which on it tells something: 1 where it says nothing, 2.5 at the 1 %
# level for 8 and many degrees of freedom. Set points lie at 7 and less, machines half hidden in noise at 20.
LEAST_F = 10.0
# A set point that is smooth is predicted by its own past but for its corners, of which a command that answers
# to it tells something: by this factor less than of the output. Half and double leave the tests as they are.
FAR_LESS = 20.0
# Share of its power that a signal's own past leaves; below it is computed (a sum of sines), not measured:
# rounding of doubles leaves 1e-32, and some decades more where regressors are nearly dependent; a sensor of
# 20 bits leaves 1e-12. Chosen between.
COMPUTED_SHARE = 1e-14
# Samples for each unknown of a prediction, at least; with fewer nothing is said. Chosen: with as many samples
# as unknowns anything is predicted.
ROWS_PER_UNKNOWN = 3


def leads(first: RealArray, second: RealArray) -> bool | None:
    """Return whether the first signal leads the second, by the largest correlation of their changes.

    A signal that stands still leads nothing: None.

    Parameters
    ----------
    first, second : ndarray, shape (T,)
        Finite, of one length, two samples at least; not checked (numpy's ValueError for fewer).

    Returns
    -------
    bool or None
        None where they change at the same time, or where no lag correlates them well (`LEAST_CORRELATION`).
    """
    lag, correlation = _best_lag(np.diff(first), np.diff(second))
    if lag == 0 or correlation <= LEAST_CORRELATION:
        return None
    return lag > 0


def _best_lag(first: RealArray, second: RealArray) -> tuple[int, float]:
    """Return by how many samples the second signal (T,) is later than the first (T,) where they correlate
    best, and that correlation, at most 1.

    Negative where the second is earlier; (0, 0.0) where a signal stands still. One length, not checked.
    """
    first_about_mean = first - np.mean(first)
    second_about_mean = second - np.mean(second)
    size = np.linalg.norm(first_about_mean) * np.linalg.norm(second_about_mean)

    # By Fourier transforms of twice the length, padded with zeros so that no end meets a start.
    n_padded = 2 * first.size
    first_spectrum = np.fft.rfft(first_about_mean, n_padded)
    second_spectrum = np.fft.rfft(second_about_mean, n_padded)
    correlation = np.fft.irfft(first_spectrum.conj() * second_spectrum) / max(size, np.finfo(float).tiny)
    place = int(np.argmax(correlation))
    # The upper half holds negative lags.
    lag = place - n_padded if place > first.size else place
    return lag, float(correlation[place])


def is_moved_by(signal: RealArray, command: RealArray) -> bool:
    """Whether a command (T,) moves a signal (T,), as it does a measured position in any loop.

    False where there are too few samples to say (fewer than 59), or the signal is computed. Finite, of one
    length; not checked.
    """
    return _tells(command, signal) > LEAST_F


def is_loop(reference: RealArray, output: RealArray, command: RealArray) -> bool:
    """Whether three signals, (T,) each, are those of a closed loop.

    The command moves the output and, far less, the reference; and it answers to the reference. Of two
    measured positions in open loop the command answers to neither. False with too few samples. Finite, of one
    length; not checked.
    """
    moved_output = _tells(command, output)
    if not moved_output > LEAST_F:
        return False
    moved_reference = _tells(command, reference)
    if not moved_reference < max(LEAST_F, moved_output / FAR_LESS):
        return False
    return _tells(reference, command, beside=output) > LEAST_F


def _tells(cause: RealArray, signal: RealArray, beside: RealArray | None = None) -> float:
    """Return how much a cause (T,) tells of the next sample of a signal (T,): 1 where it tells nothing.

    beside: another signal (T,) whose samples are known as well. Where it is given, the samples of it and of
    the cause at the time of the predicted sample count, too: a controller answers at once. Signals of one
    length, finite; not checked.

    Notes
    -----
    Granger's test: the signal is predicted by least squares from its own last samples, and from those and
    the cause; the F statistic compares the sums of squares R0 and R1 that these leave:
    F = (R0 - R1) / m * (n - p) / R1, with m regressors added, n samples and p unknowns in all. 0 where too
    few samples are there, or the signal is computed (a sum of sines) so that its own past leaves nothing.
    """
    known = _past(signal, first_lag=1)
    if beside is None:
        added = _past(cause, first_lag=1)
    else:
        known = [*known, *_past(beside, first_lag=0)]
        added = _past(cause, first_lag=0)
    n_rows = signal.size - LAGS
    n_unknowns = 1 + len(known) + len(added)
    if n_rows < ROWS_PER_UNKNOWN * n_unknowns:
        return 0.0

    target = (signal - np.mean(signal))[LAGS:]
    constant = np.ones(n_rows)
    without_cause = _residual(target, [constant, *known])
    with_cause = _residual(target, [constant, *known, *added])
    if not without_cause > COMPUTED_SHARE * float(np.sum(target**2)):
        return 0.0
    gain_per_regressor = (without_cause - with_cause) / len(added)
    return gain_per_regressor * (n_rows - n_unknowns) / max(with_cause, np.finfo(float).tiny)


def _past(signal: RealArray, first_lag: int) -> list[RealArray]:
    """Return a signal (T,) about its mean, delayed by each lag from the first one up to `LAGS`, (T - LAGS,)
    each: cut to the samples that have all lags.

    T more than `LAGS`, else empty arrays; the caller has counted the rows.
    """
    about_mean = signal - np.mean(signal)
    return [about_mean[LAGS - lag : about_mean.size - lag] for lag in range(first_lag, LAGS + 1)]


def _residual(target: RealArray, regressors: list[RealArray]) -> float:
    """Return the sum of squares that the best combination of regressors, (T,) each, leaves of the target
    (T,).

    At least one regressor, which may be dependent on others; NaN makes numpy raise LinAlgError or gives NaN.
    """
    matrix = np.column_stack(regressors)
    coefficients = np.linalg.lstsq(matrix, target, rcond=None)[0]
    return float(np.sum((target - matrix @ coefficients) ** 2))
