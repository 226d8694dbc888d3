"""Where a fit of one more effect starts: grids, or linear least squares over frequencies.

Letters of the shapes: N coefficients of all records, P nominal values, A coordinates of a candidate, L lines
(frequencies in time, or cycles per turn of the hub), K complex bins of a transform.
"""

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

# Zeros that no other output tells are tried at so many angles around a turn where a torque depends on the
# true one: every 60 degrees, from which a descent reaches any angle between.
_ZEROS_AROUND = 6
# Cycles of a torque per turn of the hub that are tried: quarters below 12, where a swing of a turn or two
# tells them apart, whole numbers (slots, teeth) above. Those outside a candidate's range are left out.
_CYCLES = np.concatenate([np.arange(1.0, 12, 0.25), np.arange(12, 80.5, 1.0)])
# Highest frequency of a torque over time, Hz: that of the mains, with a margin. Doubled, no answer of three
# exact cases moved (`python -m benchmarks.frozen_answers --change`).
_HIGHEST_HZ = 60.0
# Highest frequency over the sampling rate: a little below Nyquist, where a held input is hardly one.
_HIGHEST_SHARE = 0.45
# Distance of two frequencies in lines of the longest record: the gain is a squared sinc of it, and at 0.2
# lines off the best it has lost an eighth. Doubled, none of these moved.
_LINE_SPACING = 0.4
# Lines whose responses are transformed together: memory for their columns, nothing else.
_LINES_AT_ONCE = 16
# Starts nearer than this in every coordinate count as one: of a logarithm (35 %), or radians (17 degrees).
# Doubled, no answer of six cases moved.
_APART = 0.3
# Frequencies of a long record are as many as its samples. Where they are more than this a cheap gain chooses
# which of them are fitted. Chosen: time alone depends on it.
MOST_LINES = 6000
# How many are fitted then: peaks of the cheap gain are those of the fit, and each is five of them wide, so
# that these are the two hundred highest.
BEST_LINES = 1000
# The lowest ones are fitted in any case: there the response is not settled, as the cheap gain takes it to be.
SLOW_LINES = 200
# Added to a diagonal, relative to it, so that nothing is divided by zero: far above rounding of double
# precision, far below what a record tells.
_RIDGE = 1e-9
# The same where a whole diagonal entry is zero, absolute.
_SMALLEST_CURVATURE = 1e-12
# The same for the two parts of a sine, relative to their curvature.
_RIDGE_OF_PARTS = 1e-12


@dataclass(frozen=True, eq=False)
class StartPoint:
    """Where a candidate may be descended from beside a fit.

    Attributes
    ----------
    loss : float
        -log posterior density there, once everything else has followed linearly.
    coordinates : (A,) array
        Of the candidate alone.
    deviations : (P,) array
        Where the nominal values go.
    start : FittedStart
        Of all records.
    size : float
        Largest RMS, over records and outputs, of what the effect changes of their coefficients.
    change : (N,) array or None
        This change itself; None where the point is found anew beside others.
    """

    loss: float
    coordinates: Real
    deviations: Real
    start: FittedStart
    size: float = 0.0
    change: npt.NDArray[np.float32] | None = None

    def far_from(self, other: StartPoint) -> bool:
        """Whether a descent from the other point would probably end elsewhere."""
        moved = np.max(np.abs(self.coordinates - other.coordinates))
        turned = np.max(np.abs(self.start.zeros - other.start.zeros), initial=0.0)
        return bool(moved > _APART or turned > _APART)


def by_loss(point: StartPoint) -> float:
    """The point's loss, by which points are sorted."""
    return point.loss


def point_of(fit: Fit) -> StartPoint:
    """The end of a fit of one effect as a start; its change is not known."""
    return StartPoint(fit.loss, fit.coordinates, fit.deviations, fit.start)


def points_of(records: RecordsToFit, around: Fit, candidate: Candidate, every: int = 1) -> list[StartPoint]:
    """Starts of a candidate beside a fit, best first.

    Parameters
    ----------
    records : RecordsToFit
        Simulates, once for every start of a grid.
    around : Fit
        Effects, nominal values and starts beside which the candidate acts.
    candidate : Candidate
        Of a harmonic torque on a linear arm amplitude and phase are solved for at every line; of everything
        else its own grid is tried.
    every : int
        Every so many points of a grid are tried.

    Returns
    -------
    list of StartPoint
        Empty where no simulation is finite.
    """
    points = []
    if candidate.kind.harmonic:
        points = _harmonic_points(records, around, candidate)
    if not points:
        for coordinates in candidate.starts[::every]:
            for start in _turned_starts(records, around.start, candidate):
                point = point_at(records, around, candidate, np.array(coordinates), start)
                if point is not None:
                    points.append(point)
    return sorted(points, key=by_loss)


def beside(
    records: RecordsToFit, around: Fit, candidate: Candidate, points: Sequence[StartPoint]
) -> list[StartPoint]:
    """The coordinates of some points, simulated beside the effects of another fit, best first.

    A point keeps zeros of its own where they are far from the fit's; one that runs away is left out.
    """
    simulated = []
    for point in points:
        start = around.start
        if np.any(np.abs(point.start.zeros - start.zeros) > _APART):
            start = _with_zeros(records, start, point.start.zeros)
        moved = point_at(records, around, candidate, point.coordinates, start)
        if moved is not None:
            simulated.append(moved)
    return sorted(simulated, key=by_loss)


def point_at(
    records: RecordsToFit, around: Fit, candidate: Candidate, x: Real, start: FittedStart
) -> StartPoint | None:
    """A start of a candidate at coordinates x (A,) beside a fit; None where a coefficient is not finite."""
    effects = (*around.effects, candidate.effect_at(x))
    e = records.coefficients(around.deviations, effects, start)
    if not np.all(np.isfinite(e)):
        return None
    loss, deviations = follow_linearly(records, around, e, start)
    change = e - around.residual_coefficients
    return StartPoint(loss, x, deviations, start, records.largest_rms(change), change.astype(np.float32))


def superposed(records: RecordsToFit, parent: Fit, points: Sequence[StartPoint]) -> list[StartPoint]:
    """Points beside the effects of another fit, their changes simply added, best first: no simulation.

    Loss and deviations are those beside the other fit; start, size and change stay as they were. A second
    effect large enough for superposition to fail shows all the same. Points whose change is not known are
    left out.
    """
    moved = []
    for point in points:
        if point.change is not None:
            e = parent.residual_coefficients + point.change
            loss, deviations = follow_linearly(records, parent, e, parent.start)
            moved.append(replace(point, loss=loss, deviations=deviations))
    return sorted(moved, key=by_loss)


def _turned_starts(records: RecordsToFit, start: FittedStart, candidate: Candidate) -> list[FittedStart]:
    """The start, or it with the first zero at angles all around where nothing but the candidate tells it."""
    if records.case.machine.unknown_start.zero_seen or not candidate.kind.absolute_angle:
        return [start]
    turns = np.arange(_ZEROS_AROUND) * 2 * np.pi / _ZEROS_AROUND - np.pi
    first = np.eye(start.zeros.size)[0]
    return [_with_zeros(records, start, start.zeros + turn * first) for turn in turns]


def _with_zeros(records: RecordsToFit, start: FittedStart, zeros: Real) -> FittedStart:
    """The measured start read with other zeros (Z,)."""
    return start.with_zeros(zeros, records.case.machine.unknown_start.state_per_zero)


def _harmonic_points(records: RecordsToFit, around: Fit, candidate: Candidate) -> list[StartPoint]:
    """Amplitude and phase of a sine torque by linear least squares at each line.

    The torque acts on a linear arm: its response is a convolution, and all that `around` holds follows
    linearly. Neglected: that the torque over the angle changes the angle.

    Returns
    -------
    list of StartPoint
        Coordinates log amplitude, line, phase; in no order. Empty for a machine without a hub.
    """
    machine = records.nominal.at(around.deviations)
    periodic = candidate.kind.harmonic == "time"
    longest = max(len(e.output) for e in records.experiments)
    torque_response = machine.torque_response(longest)
    if torque_response is None:
        return []
    response, dt_s = torque_response

    # Circular convolutions as long as two records are linear ones. For points to descend from single
    # precision will do, and takes half the time.
    size = next_fast_len(2 * longest, real=True)
    transfer = rfft(response.astype(np.float32), size, axis=0)

    def response_to(angle: Real) -> Real:
        """(L, 2, T', Y) outputs under torques sin and cos of the angles (L, T), T' >= T."""
        torque = np.stack([np.sin(angle), np.cos(angle)], axis=1, dtype=np.float32, casting="same_kind")
        return np.asarray(irfft(rfft(torque, size)[..., None] * transfer, size, axis=2))

    def columns_of(outputs: Real) -> Real:
        """(T Y, 2 L) changes of the coefficients of a record by outputs (L, 2, T, Y)."""
        change = -records.likelihood.linearised(outputs)
        return change.reshape(2 * len(outputs), -1).T.astype(np.float64)

    # Normal equations of everything that the fit holds, to be followed at every line.
    weights = around.weights
    normal = around.normal_equations(records)
    H = normal.hessian
    g = normal.gradient(around.start, around.residual_coefficients)
    factor = cho_factor(H + np.diag(_RIDGE * np.diag(H) + _SMALLEST_CURVATURE))
    n_shared = normal.shared.shape[1]
    n_states = around.start.states.shape[1]

    amplitude_axis = candidate.axes[0]
    line_axis = candidate.axes[1]
    if periodic:
        highest_Hz = min(_HIGHEST_HZ, _HIGHEST_SHARE / dt_s)
        lines = np.arange(line_axis.low, highest_Hz, _LINE_SPACING / (longest * dt_s))
    else:
        lines = _CYCLES
    lines = lines[(lines >= line_axis.low) & (lines <= line_axis.high)]
    if periodic and lines.size > MOST_LINES:
        lines = _loudest_lines(records, around, lines, response, dt_s)
    # A held torque acts as it is in the middle of its sample.
    time_s = (np.arange(longest) + 0.5) * dt_s
    zero = around.start.zeros[0] if around.start.zeros.size else 0.0
    lengths = [len(e.output) for e in records.experiments]

    points = []
    for first in range(0, lines.size, _LINES_AT_ONCE):
        some_lines = lines[first : first + _LINES_AT_ONCE]
        if periodic:
            # The torque is that of the time in all records, as far as each goes.
            outputs = response_to(2 * np.pi * some_lines[:, None] * time_s)
            of_length = {samples: columns_of(outputs[:, :, :samples]) for samples in {*lengths}}
            by_record = [of_length[samples] for samples in lengths]
        else:
            angles = [some_lines[:, None] * (e.output[:, 0] - zero) for e in records.experiments]
            by_record = [columns_of(response_to(angle)[:, :, : angle.shape[1]]) for angle in angles]
        columns = np.concatenate(by_record)
        weighted = columns * weights[:, None]

        # Schur complement: curvature (L, 2, 2) and slope (L, 2) by both parts of the torque, once all else
        # has followed.
        cross = np.empty((g.size, columns.shape[1]))
        cross[:n_shared] = normal.shared.T @ weighted
        for r, part in enumerate(records.record_slices):
            rows = slice(n_shared + r * n_states, n_shared + (r + 1) * n_states)
            cross[rows] = around.start_columns.states[r].T @ weighted[part]
        followed = cho_solve(factor, cross)
        curvature = _products_of_pairs(columns, weighted) - _products_of_pairs(cross, followed)
        slopes = (weighted.T @ around.residual_coefficients - followed.T @ g).reshape(-1, 2)
        tiny = _RIDGE_OF_PARTS * np.trace(curvature, axis1=1, axis2=2)[:, None, None] * np.eye(2)
        sine_cosine = -np.linalg.solve(curvature + tiny, slopes[:, :, None])[:, :, 0]

        amplitudes = np.clip(np.hypot(*sine_cosine.T), amplitude_axis.low, amplitude_axis.high)
        phases = np.arctan2(sine_cosine[:, 1], sine_cosine[:, 0])
        coordinates = np.column_stack([np.log(amplitudes), some_lines, phases])
        losses = around.loss + 0.5 * np.sum(slopes * sine_cosine, axis=1)
        changes = np.einsum("nlk,lk->ln", columns.reshape(len(columns), -1, 2), sine_cosine)
        for loss, x, change in zip(losses, coordinates, changes, strict=True):
            size_of_change = records.largest_rms(change)
            points.append(StartPoint(float(loss), x, around.deviations, around.start, size_of_change))
    return points


def _loudest_lines(records: RecordsToFit, around: Fit, lines: Real, response: Real, dt_s: float) -> Real:
    """The lines of evenly spaced ones at which a torque would take most from what is left.

    The response to a sine is taken to be settled, so that the gain is |correlation|^2 over |transfer|^2, by a
    chirp z transform over the lines.

    Parameters
    ----------
    records, around
        As for `points_of`.
    lines : (L,) array
        Frequencies in Hz, evenly spaced.
    response : (T, Y) array
        Outputs after a torque of one over the first sample.
    dt_s : float
        Sampling period.

    Returns
    -------
    (L',) array
        `BEST_LINES` of the lines in their order, among them the `SLOW_LINES` lowest.
    """
    samples = len(response)
    noise = records.case.noise
    size = next_fast_len(2 * samples, real=True)
    transfer = rfft(response / noise, size, axis=0)
    correlation = np.zeros(samples)
    for left in records.residuals_from(around.residual_coefficients):
        products = rfft(left / noise, size, axis=0) * transfer.conj()
        correlation += irfft(np.sum(products, axis=1), size)[:samples]
    turn = 2j * np.pi * dt_s
    spacing_Hz = lines[1] - lines[0]
    at_lines = np.abs(czt(correlation, len(lines), np.exp(-turn * spacing_Hz), np.exp(turn * lines[0])))
    transfer_energy = np.sum(np.abs(transfer) ** 2, axis=1)
    gain = at_lines**2 / np.interp(lines, np.fft.rfftfreq(size, dt_s), transfer_energy)
    gain[:SLOW_LINES] = np.inf
    loudest = np.argsort(gain)[-BEST_LINES:]
    return np.asarray(lines[np.sort(loudest)])


def _products_of_pairs(left: Real, right: Real) -> Real:
    """(L, 2, 2) inner products of the two columns of each line in (N, 2 L) with those in another (N, 2 L)."""
    left_pairs = left.T.reshape(left.shape[1] // 2, 2, len(left))
    right_pairs = right.T.reshape(right.shape[1] // 2, 2, len(right))
    return np.asarray(left_pairs @ right_pairs.transpose(0, 2, 1))
