"""Whether a command follows the position, as in a loop, and by how much such a command was logged late.

A command that a controller made is told by the past of the position beside its own (Granger, Econometrica
37(3), 1969). One that no controller made is told by the position only where it was logged late.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from ident.data.arrays import RealArray
from ident.data.distortion import period_of
from ident.data.finding import FindingKind, finding
from ident.data.record import Record

# Latest command that is looked for, in samples: a bus and a logger with twenty samples each. Chosen.
_LATEST = 40
# Lags of the position by which a command is tested to follow it. Chosen.
_CAUSES = 8
# Residual, as a share of the command's deviation, that counts as rounding. Chosen: five digits.
_ROUNDING = 1e-5
# Probability below which chance is ruled out: one log in a million is taken for a loop. At one in a hundred
# good free runs were given up.
BY_CHANCE = 1e-6
# Levels of a binary or staircase command, at most. Chosen.
_FEW_LEVELS = 16


def recorded_in_loop(records: Sequence[Record]) -> bool:
    """Whether the command follows the position.

    Parameters
    ----------
    records : sequence of Record
        One input, and the position as the one output.

    Returns
    -------
    bool
        A reference was recorded, or in some record the command's prediction from its own past becomes better
        with that of the position (Granger, Econometrica 37(3), 1969).
    """
    if any(record.reference is not None for record in records):
        return True
    return any(_follows(record, 0, len(records)) for record in records)


def with_commands_in_time(records: Sequence[Record]) -> list[Record]:
    """The records, their command as much earlier as it was logged late; said in their notes.

    Parameters
    ----------
    records : sequence of Record

    Returns
    -------
    list of Record
        Unchanged unless all of them have one input of few levels, or one that repeats, and no reference; such
        a command was made by no controller from a measured position. Where the position tells of it all the
        same, it is taken earlier until that ends, and the records are shorter by as much.

    Notes
    -----
    Neglected: relays.
    """
    n_records = len(records)
    if not all(_seems_late(record, n_records) for record in records):
        return list(records)
    for late in range(1, _LATEST + 1):
        later_ones = range(late, late + _CAUSES)
        if any(_follows(record, samples, n_records) for samples in later_ones for record in records):
            continue
        # The test of the past ends a sample early where the arm answers within a sample.
        while all(_answers_at_once(record, late) for record in records):
            late += 1
        note = finding(FindingKind.LATE_COMMAND, name=records[0].input_names[0], samples=late)
        in_time = []
        for record in records:
            shorter = record.slice(0, record.n_samples - late)
            in_time.append(replace(shorter, input=record.input[late:], notes=(*record.notes, note)))
        return in_time
    return list(records)


def _seems_late(record: Record, n_records: int) -> bool:
    """Whether a command that no controller made (few levels, or it repeats) is told by the position."""
    if record.reference is not None or record.input.shape[1] != 1:
        return False
    few_levels = np.unique(record.input).size <= _FEW_LEVELS
    if not few_levels and period_of(record.input[:, 0]) is None:
        return False
    return _follows(record, 0, n_records)


def _follows(record: Record, late: int, n_records: int) -> bool:
    """Whether the position tells the command, taken `late` samples earlier, in one of `n_records` logs."""
    command = record.input[late:, 0]
    position = record.output[: record.n_samples - late, 0]
    probability = chi2.sf(_told_by_position(command, position), _CAUSES)
    return bool(probability * n_records < BY_CHANCE)


def _answers_at_once(record: Record, late: int) -> bool:
    """Whether the position still answers to a command of the same sample, taken `late` samples earlier."""
    position = record.output[:, 0]
    command = record.input[:, 0]
    rows = np.arange(2 * _CAUSES, position.size - late)[:, None]
    lags = np.arange(1, 2 * _CAUSES + 1)
    past = np.hstack([position[rows - lags], command[rows - lags + late]])
    past_and_now = np.hstack([past, command[rows + late]])
    target = position[rows[:, 0]]
    ratio = _unexplained(target, past) / _unexplained(target, past_and_now)
    # One number more: a chi-square of one degree of freedom.
    return bool(chi2.sf(rows.size * np.log(ratio), 1) < BY_CHANCE)


def _told_by_position(command: RealArray, position: RealArray) -> float:
    """Chi-square, of `_CAUSES` numbers, of what a command (T,) owes to the past of a position (T,).

    The command is predicted by three times as many samples of its own past, or by twice as many and as many
    of the position: as many columns, so that more of them explain nothing. 0 for a record that is too short.
    """
    n = _CAUSES
    if command.size < 8 * n:
        return 0.0
    rows = np.arange(3 * n, command.size)[:, None]
    lags = np.arange(1, n + 1)
    own_past = command[rows - np.arange(1, 3 * n + 1)]
    with_position = np.hstack([own_past[:, : 2 * n], position[rows - lags + 1] - position.mean()])
    target = command[3 * n :]
    ratio = _unexplained(target, own_past) / _unexplained(target, with_position)
    degrees_of_freedom = max(rows.size - 3 * n - 1, 0)
    return float(degrees_of_freedom * np.log(ratio))


def _unexplained(wanted: RealArray, columns: RealArray) -> float:
    """Sum of squares that a constant and columns (T, N) leave of a signal (T,), at least that of rounding."""
    columns = np.column_stack([np.ones(wanted.size), columns])
    size = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(size > 0, size, 1.0)
    residual = wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=1e-10)[0]
    rounding = float((_ROUNDING * np.std(wanted)) ** 2 * residual.size)
    return max(float(residual @ residual), rounding)
