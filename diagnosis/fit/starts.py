"""Where a fit of one more effect starts: grids, or linear least squares over frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg import cho_factor, cho_solve
from scipy.signal import czt

from diagnosis.fit.descent import Fit, follow_linearly
from diagnosis.fit.records import FittedStart, RecordsToFit
from diagnosis.machine.machine_protocol import Real
from plant.effects.search_space import Candidate

# Zeros that no other output tells are tried all around where a torque depends on the true one.
_ZEROS_AROUND = 6
_CYCLES = np.concatenate([np.arange(1.0, 12, 0.25), np.arange(12, 80.5, 1.0)])
_HIGHEST_HZ, _LINES_PER_PERIOD, _LINES_AT_ONCE = 60.0, 0.4, 16
_APART = 0.3  # of a logarithm (35 %), or radians (17 degrees): nearer starts count as one
# Frequencies of long records, of which there are as many as samples: how many of them are fitted, the lowest
# in any case.
MOST_LINES, BEST_LINES, SLOW_LINES = 6000, 1000, 200


@dataclass(frozen=True, eq=False)
class StartPoint:
    """To descend from beside a fit: loss once all else has followed, coordinates, deviations, start.

    size: largest RMS, over records and outputs, of what the effect changes of their coefficients;
    change (N,): this itself, or nothing where it is found anew beside others.
    """

    loss: float
    coordinates: Real
    deviations: Real
    start: FittedStart
    size: float = 0.0
    change: npt.NDArray[np.float32] | None = None

    def far_from(self, other: StartPoint) -> bool:
        moved = np.max(np.abs(self.coordinates - other.coordinates))
        turned = np.max(np.abs(self.start.zeros - other.start.zeros), initial=0.0)
        return bool(moved > _APART or turned > _APART)


def point_of(end: Fit) -> StartPoint:
    return StartPoint(end.loss, end.coordinates, end.deviations, end.start)


def points_of(records: RecordsToFit, around: Fit, candidate: Candidate, every: int = 1) -> list[StartPoint]:
    """Every start of a candidate beside a fit, or one in several of its grid, best first."""
    found = _harmonic(records, around, candidate) if candidate.kind.harmonic else []
    if not found:
        found = [
            point
            for x in candidate.starts[::every]
            for start in _turned(records, around.start, candidate)
            if (point := point_at(records, around, candidate, np.array(x), start)) is not None
        ]
    return sorted(found, key=lambda point: point.loss)


def beside(
    records: RecordsToFit, around: Fit, candidate: Candidate, points: Sequence[StartPoint]
) -> list[StartPoint]:
    """The same points beside the effects of another fit, best first."""
    found = []
    for point in points:
        start = around.start
        if np.any(np.abs(point.start.zeros - start.zeros) > _APART):
            start = _with_zeros(records, start, point.start.zeros)
        tried = point_at(records, around, candidate, point.coordinates, start)
        if tried is not None:
            found.append(tried)
    return sorted(found, key=lambda point: point.loss)


def point_at(
    records: RecordsToFit, around: Fit, candidate: Candidate, x: Real, start: FittedStart
) -> StartPoint | None:
    e = records.coefficients(around.deviations, (*around.effects, candidate.effect_at(x)), start)
    if not np.all(np.isfinite(e)):
        return None
    loss, deviations = follow_linearly(records, around, e, start)
    change = e - around.residual_coefficients
    return StartPoint(loss, x, deviations, start, records.largest_rms(change), change.astype(np.float32))


def superposed(records: RecordsToFit, parent: Fit, points: Sequence[StartPoint]) -> list[StartPoint]:
    """The same points beside the effects of another fit, changes simply added, best first: no simulation. A
    second effect large enough for superposition to fail shows all the same."""
    found = []
    for point in points:
        if point.change is not None:
            loss, deviations = follow_linearly(
                records, parent, parent.residual_coefficients + point.change, parent.start
            )
            found.append(replace(point, loss=loss, deviations=deviations))
    return sorted(found, key=lambda point: point.loss)


def _turned(records: RecordsToFit, start: FittedStart, candidate: Candidate) -> list[FittedStart]:
    if records.case.machine.unknown_start.zero_seen or not candidate.kind.absolute_angle:
        return [start]
    turns = np.arange(_ZEROS_AROUND) * 2 * np.pi / _ZEROS_AROUND - np.pi
    first = np.eye(start.zeros.size)[0]
    return [_with_zeros(records, start, start.zeros + turn * first) for turn in turns]


def _with_zeros(records: RecordsToFit, start: FittedStart, zeros: Real) -> FittedStart:
    return start.with_zeros(zeros, records.case.machine.unknown_start.state_per_zero)


def _harmonic(records: RecordsToFit, around: Fit, candidate: Candidate) -> list[StartPoint]:
    """Amplitude and phase by linear least squares at each frequency: the torque acts on a linear arm."""
    machine = records.nominal.at(around.deviations)
    periodic = candidate.kind.harmonic == "time"
    longest = max(len(e.output) for e in records.experiments)
    known = machine.torque_response(longest)
    if known is None:
        return []
    response, dt_s = known
    size = next_fast_len(2 * longest, real=True)
    # For points to descend from single precision will do, and takes half the time.
    transfer, weights = rfft(response.astype(np.float32), size, axis=0), around.weights
    normal = around.normal_equations(records)
    H, g = normal.hessian, normal.gradient(around.start, around.residual_coefficients)
    factor = cho_factor(H + np.diag(1e-9 * np.diag(H) + 1e-12))
    shared = np.column_stack([around.jacobian, around.start_columns.zeros])
    k, S = shared.shape[1], around.start.states.shape[1]
    time_s = (np.arange(longest) + 0.5) * dt_s
    low, high = candidate.axes[1].low, candidate.axes[1].high
    lines = (
        np.arange(low, min(_HIGHEST_HZ, 0.45 / dt_s), _LINES_PER_PERIOD / (longest * dt_s))
        if periodic
        else _CYCLES
    )
    zero = around.start.zeros[0] if around.start.zeros.size else 0.0
    lengths = [len(e.output) for e in records.experiments]

    def moved(angle: Real) -> Real:
        torque = np.stack([np.sin(angle), np.cos(angle)], axis=1, dtype=np.float32, casting="same_kind")
        return np.asarray(irfft(rfft(torque, size)[..., None] * transfer, size, axis=2))

    def columns_of(moved: Real) -> Real:
        return -records.likelihood.linearised(moved).reshape(2 * len(moved), -1).T.astype(np.float64)

    found, lines = [], lines[(lines >= low) & (lines <= high)]
    if periodic and lines.size > MOST_LINES:
        lines = _loudest(records, around, lines, response, dt_s)
    for first in range(0, lines.size, _LINES_AT_ONCE):
        some = lines[first : first + _LINES_AT_ONCE]
        if periodic:
            # The same in all records, as far as each goes.
            whole = moved(2 * np.pi * some[:, None] * time_s)
            of_length = {T: columns_of(whole[:, :, :T]) for T in {*lengths}}
            parts = [of_length[T] for T in lengths]
        else:
            angles = [some[:, None] * (e.output[:, 0] - zero) for e in records.experiments]
            parts = [columns_of(moved(angle)[:, :, : angle.shape[1]]) for angle in angles]
        columns = np.concatenate(parts)
        weighted, cross = columns * weights[:, None], np.empty((g.size, columns.shape[1]))
        cross[:k] = shared.T @ weighted
        for r, (part, own) in enumerate(zip(records.record_slices, around.start_columns.states, strict=True)):
            cross[k + r * S : k + (r + 1) * S] = own.T @ weighted[part]
        solved = cho_solve(factor, cross)
        inner = _of_pairs(columns, weighted) - _of_pairs(cross, solved)
        slopes = (weighted.T @ around.residual_coefficients - solved.T @ g).reshape(-1, 2)
        tiny = 1e-12 * np.trace(inner, axis1=1, axis2=2)[:, None, None] * np.eye(2)
        ab = -np.linalg.solve(inner + tiny, slopes[:, :, None])[:, :, 0]
        amplitudes = np.clip(np.hypot(*ab.T), candidate.axes[0].low, candidate.axes[0].high)
        coordinates = np.column_stack([np.log(amplitudes), some, np.arctan2(ab[:, 1], ab[:, 0])])
        losses = around.loss + 0.5 * np.sum(slopes * ab, axis=1)
        changes = np.einsum("nlk,lk->ln", columns.reshape(len(columns), -1, 2), ab)
        found += [
            StartPoint(float(loss), x, around.deviations, around.start, records.largest_rms(change))
            for loss, x, change in zip(losses, coordinates, changes, strict=True)
        ]
    return found


def _loudest(records: RecordsToFit, around: Fit, lines: Real, response: Real, dt_s: float) -> Real:
    """Those of evenly spaced frequencies [Hz] at which a torque would take most from what is left, its
    response (T, Y to a pulse) taken to be settled, and the lowest, at which it is not."""
    T, noise = len(response), records.case.noise
    size = next_fast_len(2 * T, real=True)
    transfer, correlation = rfft(response / noise, size, axis=0), np.zeros(T)
    for part in records.residuals_from(around.residual_coefficients):
        correlation += irfft(np.sum(rfft(part / noise, size, axis=0) * transfer.conj(), axis=1), size)[:T]
    turn = 2j * np.pi * dt_s
    found = np.abs(
        czt(correlation, len(lines), np.exp(-turn * (lines[1] - lines[0])), np.exp(turn * lines[0]))
    )
    gain = found**2 / np.interp(lines, np.fft.rfftfreq(size, dt_s), np.sum(np.abs(transfer) ** 2, axis=1))
    gain[:SLOW_LINES] = np.inf
    return np.asarray(lines[np.sort(np.argsort(gain)[-BEST_LINES:])])


def _of_pairs(one: Real, other: Real) -> Real:
    """(L, 2, 2) products of the columns (N, 2 L) of each line."""
    pairs, others = (part.T.reshape(part.shape[1] // 2, 2, len(part)) for part in (one, other))
    return np.asarray(pairs @ others.transpose(0, 2, 1))
