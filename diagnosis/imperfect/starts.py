"""Where a fit of one more effect starts: grids, or linear least squares over frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import dct, next_fast_len
from scipy.linalg import cho_factor, cho_solve

from diagnosis.imperfect.descent import Descent, follow
from diagnosis.imperfect.records import Records, Start
from diagnosis.machine.machine_protocol import Real
from plant.effects.search_space import Candidate

# Zeros that no other output tells are tried all around where a torque depends on the true one.
_ZEROS_AROUND = 6
_CYCLES = np.concatenate([np.arange(1.0, 12, 0.25), np.arange(12, 80.5, 1.0)])
_HIGHEST_HZ, _LINES_PER_PERIOD = 60.0, 0.4
_APART = 0.3


@dataclass(frozen=True, eq=False)
class Point:
    """To descend from beside a fit: loss once all else has followed, coordinates, deviations, start."""

    loss: float
    coordinates: Real
    deviations: Real
    start: Start

    def far_from(self, other: Point) -> bool:
        moved = np.max(np.abs(self.coordinates - other.coordinates))
        turned = np.max(np.abs(self.start.zeros - other.start.zeros), initial=0.0)
        return bool(moved > _APART or turned > _APART)


def points_of(records: Records, around: Descent, candidate: Candidate, every: int = 1) -> list[Point]:
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


def beside(records: Records, around: Descent, candidate: Candidate, points: Sequence[Point]) -> list[Point]:
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


def point_at(records: Records, around: Descent, candidate: Candidate, x: Real, start: Start) -> Point | None:
    effects = (*around.effects, candidate.effect_at(x))
    e = records.coefficients(around.deviations, effects, start)
    if not np.all(np.isfinite(e)):
        return None
    loss, deviations = follow(records, around, e, start)
    return Point(loss, x, deviations, start)


def _turned(records: Records, start: Start, candidate: Candidate) -> list[Start]:
    if records.case.machine.unknown_start.zero_seen or not candidate.kind.absolute_angle:
        return [start]
    turns = np.arange(_ZEROS_AROUND) * 2 * np.pi / _ZEROS_AROUND - np.pi
    first = np.eye(start.zeros.size)[0]
    return [_with_zeros(records, start, start.zeros + turn * first) for turn in turns]


def _with_zeros(records: Records, start: Start, zeros: Real) -> Start:
    return start.with_zeros(zeros, records.case.machine.unknown_start.state_per_zero)


def _harmonic(records: Records, around: Descent, candidate: Candidate) -> list[Point]:
    """Amplitude and phase by linear least squares at each frequency: the torque acts on a linear arm."""
    machine = records.nominal.at(around.deviations)
    periodic = candidate.kind.harmonic == "time"
    longest = max(len(e.output) for e in records.experiments)
    known = machine.torque_response(longest)
    if known is None:
        return []
    response, dt_s = known
    size = next_fast_len(2 * longest, real=True)
    transfer = np.fft.rfft(response, size, axis=0)
    weights = records.levels.weights(around.left)
    normal = around.normal(records)
    H, g = normal.hessian, normal.gradient(around.start, around.left)
    factor = cho_factor(H + np.diag(1e-9 * np.diag(H) + 1e-12))
    shared = np.column_stack([around.jacobian, around.columns.zeros])
    k, S = shared.shape[1], around.start.states.shape[1]
    time_s = (np.arange(longest) + 0.5) * dt_s
    low, high = candidate.axes[1].low, candidate.axes[1].high
    lines = (
        np.arange(low, min(_HIGHEST_HZ, 0.45 / dt_s), _LINES_PER_PERIOD / (longest * dt_s))
        if periodic
        else _CYCLES
    )
    zero = around.start.zeros[0] if around.start.zeros.size else 0.0

    def moved(angle: Real) -> Real:
        torque = np.stack([np.sin(angle), np.cos(angle)])
        return np.fft.irfft(np.fft.rfft(torque, size)[:, :, None] * transfer, size, axis=1)

    def column_pair(moved: Real) -> Real:
        return -dct(moved, axis=1, norm="ortho").reshape(2, -1).T

    found = []
    for line in lines[(lines >= low) & (lines <= high)]:
        if periodic:
            # The same in all records, as far as each goes.
            whole = moved(2 * np.pi * line * time_s)
            of_length = {T: column_pair(whole[:, :T]) for T in {len(e.output) for e in records.experiments}}
            pairs = [of_length[len(e.output)] for e in records.experiments]
        else:
            angles = [line * (e.output[:, 0] - zero) for e in records.experiments]
            pairs = [column_pair(moved(angle)[:, : angle.size]) for angle in angles]
        columns = np.concatenate(pairs)
        weighted = columns * weights[:, None]
        cross = np.empty((g.size, 2))
        cross[:k] = shared.T @ weighted
        for r, (part, own) in enumerate(zip(records.parts, around.columns.states, strict=True)):
            cross[k + r * S : k + (r + 1) * S] = own.T @ weighted[part]
        inner = columns.T @ weighted - cross.T @ cho_solve(factor, cross)
        slope = weighted.T @ around.left - cross.T @ cho_solve(factor, g)
        ab = -np.linalg.solve(inner + 1e-12 * np.trace(inner) * np.eye(2), slope)
        amplitude = float(np.clip(np.hypot(*ab), candidate.axes[0].low, candidate.axes[0].high))
        x = np.array([np.log(amplitude), line, np.arctan2(ab[1], ab[0])])
        found.append(Point(around.loss + 0.5 * float(slope @ ab), x, around.deviations, around.start))
    return found
