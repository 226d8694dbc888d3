"""What a model misses in windows of a record, each from the state that fits it best (multiple shooting).

A machine that integrates makes an angle of a thousandth of the torque missing, and a free run says little but
that. In windows of a few times its slowest stable mode no drift grows. What a state at the start of a window
does is linear in it: what pulses of the inputs leave behind spans it, of any simulation.

Neglected: effects that depend on a state that has drifted act along the free run; states that no input moves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.fft import dct, idct

from diagnosis.machine.machine_protocol import CaseOfMachine, Real

# Height of a pulse, in standard deviations of its input: small enough for a linear answer, large beside
# rounding. (What each of these constants does to an answer: `python -m benchmarks.frozen_answers --change`.)
_PULSE_HEIGHT = 0.1
# Quarters of a record at which pulses begin: about three states of a machine that is not linear.
_PULSE_QUARTERS = (0, 1, 2)
# Share of the largest response that a machine which forgets its inputs has left after three quarters of a
# record. More is no matter of a free run that starts anew.
_FORGOTTEN = 0.1
# A window lasts so many times as long as the slowest stable mode: e^-3 = 5 % of it is left at the end.
_SLOWEST_MODE_TIMES = 3.0
# Samples of a window for every state at its start: fewer, and the starts would explain most of a window.
_SAMPLES_PER_STATE = 4
# A window is long enough if the motion in it is so many times the noise; else it grows by `_GROWTH`.
_MOTION_OVER_NOISE = 10.0
# Factor by which windows grow until they show enough motion.
_GROWTH = 1.5
# Fewest windows of the longest record: with one or two the free run says the same.
_FEWEST_WINDOWS = 3
# A direction of the responses counts as a state where it is above this share of the largest: what is below is
# rounding and what is not linear.
_SMALLEST_DIRECTION = 1e-3
# Most states that are taken: six modes.
_MOST_STATES = 12
# Places along a response from which on it is looked at, in a geometric series: they differ by the states.
_SHIFTS = 24
# Turns or rates below this are those of a mode that does not move at all, rad a sample.
_SLOWEST_RATE = 1e-12


class WindowGroup(NamedTuple):
    """Windows of one length after each other: their rows in the record, number, and samples of each."""

    rows: slice
    windows: int
    length: int


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of records, and what a state at the start of one does in it.

    Attributes
    ----------
    samples : int
        Usual length of a window.
    responses : (L, Y, S) array
        Outputs over noise after each of S states at the start, L >= samples.
    noise : (Y,) array
        Noise standard deviations in the outputs' units.
    """

    samples: int
    responses: Real
    noise: Real
    # Length of a window -> orthonormal basis (length Y, S) of what its start does.
    _spans: dict[int, Real] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, case: CaseOfMachine) -> Windows | None:
        """Windows of a case as its nominal machine moves.

        None for a machine that forgets its inputs within a record, and for records that hold too few windows.
        """
        longest = max(len(experiment.output) for experiment in case.experiments)
        after_pulses = _after_pulses(case)
        largest = max((float(np.max(np.abs(response))) for response in after_pulses), default=0.0)
        late = 3 * longest // 4
        remembered = max(
            (float(np.max(np.abs(response[late:]), initial=0.0)) for response in after_pulses), default=0.0
        )
        if not remembered > _FORGOTTEN * largest:
            return None
        responses = _responses_of_states(after_pulses, longest // _FEWEST_WINDOWS + 1)
        samples = max(_slowest_mode_samples(responses), _SAMPLES_PER_STATE * responses.shape[2])
        while _FEWEST_WINDOWS * samples <= longest:
            windows = cls(samples, responses, case.noise)
            mean_squares = np.array([windows.motion(e.output) / len(e.output) for e in case.estimation])
            if np.any(np.sqrt(mean_squares) > _MOTION_OVER_NOISE * case.noise):
                return windows
            samples = int(np.ceil(_GROWTH * samples))
        return None

    def window_groups(self, samples: int) -> list[WindowGroup]:
        """Windows of a record of so many samples, in one or two groups of one length each.

        They are about `samples` long, and none is longer than what states are known to do.
        """
        fewest = -(-samples // len(self.responses))
        count = max(samples // self.samples, fewest)
        length, longer = divmod(samples, count)
        border = longer * (length + 1)
        groups = [
            WindowGroup(slice(0, border), longer, length + 1),
            WindowGroup(slice(border, samples), count - longer, length),
        ]
        return [group for group in groups if group.windows]

    def to_coefficients(self, signals: Real) -> Real:
        """(..., T, Y) cosine transforms of windows of signals (..., T, Y), less what their starts do.

        The first window starts as its record does, so that nothing is taken off it.
        """

        def change(part: Real, is_first: bool) -> Real:
            return self._without_starts(part, int(is_first))

        return self._each_window(signals, change)

    def motion(self, output: Real) -> Real:
        """(Y,) energy of outputs (T, Y) in windows, less what their starts do."""

        def change(part: Real, is_first: bool) -> Real:
            return self._without_starts(part, 0)

        return np.asarray(np.sum(self._each_window(output, change) ** 2, axis=0))

    def to_residuals(self, coefficients: Real) -> Real:
        """(..., T, Y) signals of the coefficients (..., T, Y), without what starts of windows do."""

        def change(part: Real, is_first: bool) -> Real:
            return np.asarray(idct(part, axis=-2, norm="ortho"))

        return self._each_window(coefficients, change)

    def _without_starts(self, part: Real, kept: int) -> Real:
        """Cosine transforms of windows (..., windows, length, Y), all but the first `kept` of them projected
        on what no state at their start does; outputs are weighed by their noise there."""
        length, outputs = part.shape[-2:]
        if length not in self._spans:
            responses = self.responses[:length].reshape(length * outputs, -1)
            self._spans[length] = np.linalg.qr(responses)[0]
        span = self._spans[length]
        flat = (part / self.noise).reshape(*part.shape[:-2], length * outputs)
        of_starts = flat @ span
        of_starts[..., :kept, :] = 0.0
        projected = (flat - of_starts @ span.T).reshape(part.shape) * self.noise
        return np.asarray(dct(projected, axis=-2, norm="ortho"))

    def _each_window(self, signals: Real, change: Callable[[Real, bool], Real]) -> Real:
        """Signals (..., T, Y) with every group of windows (..., windows, length, Y) replaced by its change,
        which is told whether the first window of the record is among them."""
        changed = np.empty(signals.shape)
        samples, outputs = signals.shape[-2:]
        for rows, windows, length in self.window_groups(samples):
            part = signals[..., rows, :].reshape(*signals.shape[:-2], windows, length, outputs)
            is_first = rows.start == 0
            changed[..., rows, :] = change(part, is_first).reshape(*signals.shape[:-2], -1, outputs)
        return changed


def _after_pulses(case: CaseOfMachine) -> list[Real]:
    """What pulses of the inputs leave behind, simulated with the nominal machine.

    Returns
    -------
    list of (., Y) arrays
        Changes of the outputs over their noise from the sample after the pulse to the end of the longest
        estimation record; one for every input that moves and every quarter. A pulse that does nothing, or
        makes the simulation run away, is left out.
    """
    record = max(case.estimation, key=lambda experiment: len(experiment.output))
    unknown = case.machine.unknown_start
    simulate = case.machine.simulator(())
    states = unknown.guess(record)
    zeros = np.zeros(unknown.zero_spread.size)
    start = (states, zeros) if states.size or zeros.size else ()
    undisturbed = simulate(record.input, *start)
    changes = []
    for column, height in enumerate(_PULSE_HEIGHT * np.std(record.input, axis=0)):
        if not height > 0:
            continue
        for quarter in _PULSE_QUARTERS:
            row = quarter * len(record.input) // 4
            pushed = np.array(record.input)
            pushed[row, column] += height
            change = ((simulate(pushed, *start) - undisturbed) / case.noise)[row + 1 :]
            if np.all(np.isfinite(change)) and np.any(change):
                changes.append(change)
    return changes


def _responses_of_states(after_pulses: list[Real], samples: int) -> Real:
    """(samples, Y, S) orthonormal outputs over noise that states at the start make.

    They are the directions in which pieces of the responses (., Y), each from a later place on, differ; at
    most `_MOST_STATES` of them. At least one response must be as long as `samples`.
    """
    pieces = []
    for response in after_pulses:
        places = np.geomspace(1, max(len(response) - samples, 1), _SHIFTS).astype(int) - 1
        for first in np.unique(places):
            piece = response[first : first + samples]
            if len(piece) == samples and np.any(piece):
                pieces.append(piece.ravel() / np.linalg.norm(piece))
    directions, sizes, _ = np.linalg.svd(np.array(pieces).T, full_matrices=False)
    count = min(int(np.sum(sizes > _SMALLEST_DIRECTION * sizes[0])), _MOST_STATES)
    return np.asarray(directions[:, :count].reshape(samples, -1, count))


def _slowest_mode_samples(responses: Real) -> int:
    """`_SLOWEST_MODE_TIMES` times the slowest mode of responses (L, Y, S) that ends within them, samples.

    The time of a mode is its period, or the time constant of one that does not turn; at least one sample.
    """
    longest, _, states = responses.shape
    before = responses[:-1].reshape(-1, states)
    after = responses[1:].reshape(-1, states)
    transition = np.linalg.lstsq(before, after, rcond=None)[0]
    modes = np.linalg.eigvals(transition).astype(np.complex128)
    modes = modes[np.abs(modes) > 0]
    rates = np.abs(np.log(modes))
    turns = np.abs(np.angle(modes))
    periods = 2 * np.pi / np.maximum(turns, _SLOWEST_RATE)
    time_constants = 1 / np.maximum(rates, _SLOWEST_RATE)
    times = np.where(turns > 0, periods, time_constants)
    ends_within = _SLOWEST_MODE_TIMES * times <= longest
    slowest = np.max(times[ends_within], initial=1.0)
    return int(np.ceil(_SLOWEST_MODE_TIMES * slowest))
