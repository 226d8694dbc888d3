"""What a model misses in windows of a record, each from the state that fits it best (multiple shooting).

A machine that integrates makes an angle of a thousandth of the torque missing, and a free run says little but
that. In windows of a few times its slowest stable mode no drift grows. What a state at the start of a window
does is linear in it: what pulses of the inputs leave behind spans it, of any simulation.

Neglected: effects that depend on a state that has drifted act along the free run; states that no input moves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.fft import dct, idct

from diagnosis.machine.machine_protocol import CaseOfMachine, Real

# Deviations of an input that a pulse is high, and quarters of a record that pulses begin.
_PULSE, _QUARTERS = 0.1, (0, 1, 2)
# Of the largest response, what a machine that forgets has left after three quarters of a record.
_FORGOTTEN = 0.1
# Length of a window: times of the slowest stable mode, samples per state, motion over noise.
_TIMES, _SAMPLES_PER_STATE, _OVER_NOISE = 3.0, 4, 10.0
# Fewest windows of the longest record.
_FEWEST = 3
# States are directions of the responses above a share of the largest; shifts of a response that show them.
_DIRECTION, _MOST_STATES, _SHIFTS = 1e-3, 12, 24


@dataclass(frozen=True, eq=False)
class Windows:
    """samples : usual length of a window. responses : (>= samples, Y, S) outputs over noise (Y,) after
    states at its start."""

    samples: int
    responses: Real
    noise: Real
    _spans: dict[int, Real] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, case: CaseOfMachine) -> Windows | None:
        """None for a machine that forgets its inputs within a record, and for records that hold too few."""
        longest, moved = max(len(e.output) for e in case.experiments), _after_pulses(case)
        largest = max((float(np.max(np.abs(h))) for h in moved), default=0.0)
        kept = max((float(np.max(np.abs(h[3 * longest // 4 :]), initial=0.0)) for h in moved), default=0.0)
        if not kept > _FORGOTTEN * largest:
            return None
        responses = _of_states(moved, longest // _FEWEST + 1)
        samples = max(_slowest_samples(responses), _SAMPLES_PER_STATE * responses.shape[2])
        while _FEWEST * samples <= longest:
            found = cls(samples, responses, case.noise)
            energies = np.array([found.motion(e.output) / len(e.output) for e in case.estimation])
            if np.any(np.sqrt(energies) > _OVER_NOISE * case.noise):
                return found
            samples = int(np.ceil(1.5 * samples))
        return None

    def window_groups(self, samples: int) -> list[tuple[slice, int, int]]:
        """Of a record: rows of windows of one length, their number and length."""
        # Of about this length, and none longer than what states are known to do.
        count = max(samples // self.samples, -(-samples // len(self.responses)))
        length, longer = divmod(samples, count)
        first = longer * (length + 1)
        found = [(slice(0, first), longer, length + 1), (slice(first, samples), count - longer, length)]
        return [part for part in found if part[1]]

    def to_coefficients(self, signals: Real) -> Real:
        """(..., T, Y) -> the same shape: cosine transforms of windows less what their starts do; the first
        window starts as its record."""
        return self._each(signals, lambda part, first: self._freed(part, int(first)))

    def motion(self, output: Real) -> Real:
        """(Y,) energy of (T, Y) in windows."""
        return np.asarray(np.sum(self._each(output, lambda part, first: self._freed(part, 0)) ** 2, axis=0))

    def _freed(self, part: Real, kept: int) -> Real:
        """(..., windows, length, Y), all but the first of them less what their starts do, transformed."""
        length, Y = part.shape[-2:]
        if length not in self._spans:
            self._spans[length] = np.linalg.qr(self.responses[:length].reshape(length * Y, -1))[0]
        span, flat = self._spans[length], (part / self.noise).reshape(*part.shape[:-2], length * Y)
        own = flat @ span
        own[..., :kept, :] = 0.0
        return np.asarray(dct((flat - own @ span.T).reshape(part.shape) * self.noise, axis=-2, norm="ortho"))

    def to_residuals(self, seen: Real) -> Real:
        """The inverse, without what starts do."""
        return self._each(seen, lambda part, first: np.asarray(idct(part, axis=-2, norm="ortho")))

    def _each(self, signals: Real, change: Callable[[Real, bool], Real]) -> Real:
        found, (T, Y) = np.empty(signals.shape), signals.shape[-2:]
        for rows, count, length in self.window_groups(T):
            part = signals[..., rows, :].reshape(*signals.shape[:-2], count, length, Y)
            found[..., rows, :] = change(part, rows.start == 0).reshape(*signals.shape[:-2], -1, Y)
        return found


def _after_pulses(case: CaseOfMachine) -> list[Real]:
    """(., Y) outputs over noise after a pulse of every input that moves, in several parts of the longest
    record, of the stated machine."""
    record = max(case.estimation, key=lambda e: len(e.output))
    unknown, simulate = case.machine.unknown_start, case.machine.simulator(())
    states, zeros = unknown.guess(record), np.zeros(unknown.zero_spread.size)
    begun = (states, zeros) if states.size or zeros.size else ()
    undisturbed, found = simulate(record.input, *begun), []
    for column, size in enumerate(_PULSE * np.std(record.input, axis=0)):
        for quarter in _QUARTERS if size > 0 else ():
            pushed, row = np.array(record.input), quarter * len(record.input) // 4
            pushed[row, column] += size
            moved = ((simulate(pushed, *begun) - undisturbed) / case.noise)[row + 1 :]
            if np.all(np.isfinite(moved)) and np.any(moved):
                found.append(moved)
    return found


def _of_states(moved: list[Real], samples: int) -> Real:
    """(samples, Y, S) what states do, the directions in which responses later in their course differ."""
    columns = []
    for h in moved:
        for first in np.unique(np.geomspace(1, max(len(h) - samples, 1), _SHIFTS).astype(int)) - 1:
            piece = h[first : first + samples]
            if len(piece) == samples and np.any(piece):
                columns.append(piece.ravel() / np.linalg.norm(piece))
    directions, sizes, _ = np.linalg.svd(np.array(columns).T, full_matrices=False)
    count = min(int(np.sum(sizes > _DIRECTION * sizes[0])), _MOST_STATES)
    return np.asarray(directions[:, :count].reshape(samples, -1, count))


def _slowest_samples(responses: Real) -> int:
    """Some times of the slowest mode that ends within them: period, or time constant of a real one."""
    L, _, S = responses.shape
    now, after = responses[:-1].reshape(-1, S), responses[1:].reshape(-1, S)
    modes = np.linalg.eigvals(np.linalg.lstsq(now, after, rcond=None)[0]).astype(np.complex128)
    rates = np.abs(np.log(modes[np.abs(modes) > 0]))
    turns = np.abs(np.angle(modes[np.abs(modes) > 0]))
    times = np.where(turns > 0, 2 * np.pi / np.maximum(turns, 1e-12), 1 / np.maximum(rates, 1e-12))
    return int(np.ceil(_TIMES * np.max(times[_TIMES * times <= L], initial=1.0)))
