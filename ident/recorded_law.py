"""Read the control law that made the logs of a loop off its records, and whether it repeats what was logged.

A linear controller that runs once a row makes its command of its own past, the reference and the output:

    u_k = -a_1 u_{k-1} - .. - a_n u_{k-n} + b_0 r_k + .. + b_n r_{k-n} + c_0 y_k + .. + c_n y_{k-n} .

Least squares finds the coefficients. What they leave is the rounding of the log, if the controller ran at
the log's step; a controller that ran faster used rows that were never logged, and leaves more. Where every
signal is smooth from row to row, the rows in between can be guessed, and neither can be told.

`law_of` tries laws of rising complexity. What rounding leaves of each is computed from the steps to which the
columns were written (`_decimal_step`), and whether a faster controller would have left more is seen by taking
rows away (`_tells_period`).

A `Record` has an input (T, U) (the command), an output (T, Y), where it was logged a reference (T, R), finite
samples, and the step of its rows dt_s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ident.data.arrays import RealArray
from ident.data.record import Record

# States of a law that are tried: integral action, a filtered derivative, and a second-order filter. The
# controllers of drives have no more; a law of higher order explains any smooth command by its own past.
MOST_STATES = 4
# Rows for each coefficient of a law, at least: with fewer, least squares explains part of the rounding, and
# the residual is no measure of it. With four it explains a quarter of the power at most, which
# `MOST_OF_ROUNDING` allows for.
ROWS_PER_COEFFICIENT = 4
# A row whose command is above this share of the largest one is at the limit, where no linear law holds.
# Chosen: a log of three digits rounds by as much.
LIMIT_SHARE = 0.999
# Residual over what the rounding of the columns leaves of a true law, up to which the law is the one that
# ran. Five simulated drives have 1.00 +- .01, a drive that logs every second sample has 9; chosen near the
# first.
MOST_OF_ROUNDING = 1.5
# A controller twice as fast would have left more than rounding does: at least as much again. Less could be an
# error of the extrapolation, which is right to a third on simulated drives.
LEAST_EXCESS = 1.0
# Of that excess the law may show this share: half of it is as near to none as to all.
SHOWN_SHARE = 0.5
# Rows of all records together that are used: the residual is known to 1 % then (1 / sqrt(2 N) is .6 %).
MOST_ROWS = 16_000
# Decimal places that are looked for in a column: what logs have; more are those of numbers of 64 bits.
MOST_DECIMALS = 9
# Multiples of a step up to which a column may have been scaled: of 24 bits, the most of any converter.
MOST_COUNTS = 2**24
# Significant digits that are looked for: "%.4g" to "%.10g". Of fewer a column has few values; more are those
# of numbers of 64 bits.
SIGNIFICANT_DIGITS = range(4, 11)
# Reference and output enter alike, as their difference, if their coefficients cancel to this share: those of
# least squares on rounded columns are known to 1e-3 or so, those of a law of the error are equal.
CANCELS_SHARE = 1e-6
# The output of a row counts for its command if its coefficient is above this share of the largest: those of
# least squares on rounded columns are known to 1e-3 or so.
ACTS_SHARE = 1e-3
# Values are multiples of a step if they are so near to whole numbers of it, in steps, and a few roundings of
# doubles: decimals that were read from text are right to half a unit of the last place.
DECIMAL_SLACK = 1e-6
# The same for decimals that were scaled to another unit: the step is a difference of two of them, which has
# fewer right digits. Chosen: of `MOST_COUNTS` counts the last ones then need a step known to 1e-10.
SCALED_SLACK = 1e-3
# Roundings of doubles in the sums of a law: up to seven in each of its up to fifteen terms.
DOUBLE_ROUNDINGS = 100


@dataclass(frozen=True, eq=False)
class RecordedLaw:
    """A linear law that was read off the records of a loop.

    Attributes
    ----------
    own : ndarray, shape (n + 1,)
        1, a_1 .. a_n, by which the command's own past counts: denominator in z, highest power first.
    of_reference, of_output : ndarray, shape (n + 1,)
        b_0 .. b_n and c_0 .. c_n, in units of the input per unit of the output.
    residual : float
        Root mean square of the command less the law's, in units of the input.
    rounding : float
        What the decimals of the columns leave of a law that is exact, in units of the input.
    dt_s : float
        Step of the rows, s.
    tells_period : bool
        The law repeats the command, and a controller of half the period would not have.
    """

    own: RealArray
    of_reference: RealArray
    of_output: RealArray
    residual: float
    rounding: float
    dt_s: float
    tells_period: bool

    @property
    def repeats_command(self) -> bool:
        """Whether the law leaves of the command no more than `MOST_OF_ROUNDING` times the rounding of the
        log.

        False for a residual of nan.
        """
        return self.residual <= MOST_OF_ROUNDING * self.rounding

    @property
    def on_error(self) -> tuple[RealArray, RealArray] | None:
        """Numerator and denominator in z (n + 1,), highest power first, of K in u = K (r - y).

        None where reference and output enter differently; of a law without either, K = 0.
        """
        size = np.linalg.norm(self.of_reference)
        difference = np.linalg.norm(self.of_reference + self.of_output)
        if difference > CANCELS_SHARE * size:
            return None
        return self.of_reference, self.own

    @property
    def acts_at_once(self) -> bool:
        """Whether the command of a row depends on the output of the same row; False without any output in
        it."""
        largest = float(np.max(np.abs(self.of_output)))
        return bool(abs(self.of_output[0]) > ACTS_SHARE * largest)


def law_of(records: Sequence[Record]) -> RecordedLaw | None:
    """Simplest law that explains the command of SISO records as well as any of a few states.

    Parameters
    ----------
    records : sequence of Record
        One input, one output, one reference column each; one sampling time.

    Returns
    -------
    RecordedLaw or None
        The first structure that repeats the command; where none does, the law with the least residual. None
        where there is no record, where one has no reference column, or several, or the records are too short
        to tell a law. Of inputs and outputs the first column is taken: that there is one, and one sampling
        time, is not checked.

    Notes
    -----
    Laws of the error r - y come before laws of r and y by themselves, few states before many, integrating
    ones before others. Rows at the command's limit are left out. Neglected: laws that are not linear, and
    feed-forward from columns that were not logged.
    """
    if not records or any(record.reference is None or record.reference.shape[1] != 1 for record in records):
        return None
    columns = _Columns.of(records)
    best = None
    for structure in STRUCTURES:
        law = columns.fitted(structure)
        if law is None:
            continue
        if law.repeats_command:
            return replace(law, tells_period=_tells_period(columns, structure, law))
        if best is None or law.residual < best.residual:
            best = law
    return best


def _tells_period(columns: _Columns, structure: _Structure, law: RecordedLaw) -> bool:
    """Whether a law of half the period would have left more than this one, which repeats the command.

    The log of such a law would look as every second row of this one does, but for a factor that the steps
    from every second to every fourth and eighth row show: the errors of guessing the rows in between grow
    with a power of the step, and with a higher one where the signals are smooth over a step. Steps of the
    reference may fall on every fourth row, which leaves little to guess there, so even and odd rows are
    judged by themselves, and the smaller answer counts. A reference that the controller got as it was written
    has no rounding error, though it has decimals, so what this law leaves beyond that of the other two
    columns may be an excess. False where there are too few rows. `columns` : of the records behind the `law`,
    which is of this `structure`.
    """
    least_excess = np.inf
    for parity in range(2):
        # Rows twice, four and eight times as far apart: three steps show a power, and whether it grows.
        second = columns.least_residual(structure, 2, parity)
        fourth = columns.least_residual(structure, 4, parity)
        eighth = columns.least_residual(structure, 8, parity)
        if second is None or fourth is None or eighth is None:
            return False
        if second == 0:
            # A law without memory repeats itself at any rows: a faster one would have left nothing, too.
            return False
        # What half a step would leave: by the fall from fourth to second rows, and by its growth since the
        # fall from eighth to fourth ones.
        fall = max(fourth, law.rounding) / second
        fall_before = max(eighth, law.rounding) / max(fourth, law.rounding)
        growth_of_fall = max(fall / fall_before, 1.0)
        least_excess = min(least_excess, second / (fall * growth_of_fall))
    # Without the rounding of the reference, which the controller may have got as it was.
    certain_rounding = columns.rounding(law.own, np.zeros_like(law.of_reference), law.of_output)
    shown_excess = np.sqrt(max(law.residual**2 - certain_rounding**2, 0.0))
    would_show = least_excess >= LEAST_EXCESS * law.rounding
    does_not_show = shown_excess <= SHOWN_SHARE * least_excess
    return bool(would_show and does_not_show)


@dataclass(frozen=True)
class _Structure:
    """Form of a law.

    of_error : it makes the command of r - y, not of reference and output by themselves
    n_states : rows of the past that it uses
    integrates : one state is an integrator, a pole at z = 1
    """

    of_error: bool
    n_states: int
    integrates: bool


# Laws that are tried, simplest first.
STRUCTURES = tuple(
    _Structure(of_error, n_states, integrates)
    for of_error in (True, False)
    for n_states in range(1, MOST_STATES + 1)
    for integrates in (True, False)
)


@dataclass(frozen=True, eq=False)
class _Columns:
    """Command, reference and output of some records, and the steps of their decimals.

    signals : of each record, the three columns (T,) as logged
    command_step, reference_step, output_step : step to which each column was rounded, in its units; 0: not
        rounded. Root mean square over records (command) or rows (others)
    largest : size of the largest command, input units
    dt_s : step of the rows, s
    """

    signals: tuple[tuple[RealArray, RealArray, RealArray], ...]
    command_step: float
    reference_step: float
    output_step: float
    largest: float
    dt_s: float

    @classmethod
    def of(cls, records: Sequence[Record]) -> _Columns:
        """Columns of records with one input, reference and output each, `MOST_ROWS` rows of all together.

        Without records it divides by zero: `law_of` has seen to it.
        """
        signals = []
        for record in records:
            rows = slice(0, MOST_ROWS // len(records))
            reference = np.asarray(record.reference)[rows, 0]
            signals.append((record.input[rows, 0], reference, record.output[rows, 0]))
        commands, references, outputs = zip(*signals, strict=True)
        # Of the command its own steps count, whether they come from the log or from a converter.
        squared_steps = [_decimal_step(command) ** 2 for command in commands]
        return cls(
            tuple(signals),
            command_step=float(np.sqrt(np.mean(squared_steps))),
            reference_step=_rounding_step(references),
            output_step=_rounding_step(outputs),
            largest=max(float(np.max(np.abs(command))) for command in commands),
            dt_s=records[0].dt_s,
        )

    def least_residual(self, structure: _Structure, thinned: int, parity: int) -> float | None:
        """Least residual, input units, of the laws of every `thinned`-th even (`parity` 0) or odd (1) row.

        None where there are too few rows. `thinned` : 2 or more.
        """
        residuals = []
        for start in range(parity, thinned, 2):
            law = self.fitted(structure, thinned, start)
            if law is not None:
                residuals.append(law.residual)
        return min(residuals, default=None)

    def fitted(self, structure: _Structure, thinned: int = 1, start: int = 0) -> RecordedLaw | None:
        """Law of a structure, by least squares over every row, or every `thinned`-th one from `start`.

        None where there are too few rows. Its `tells_period` is False: nobody has asked yet.
        """
        limit = LIMIT_SHARE * self.largest
        row_parts = []
        target_parts = []
        for command, reference, output in self.signals:
            # Two windows of past rows have to fit in.
            if command.size <= thinned * (structure.n_states + 2):
                continue
            every = slice(start, None, thinned)
            rows, target = _regression(command[every], reference[every], output[every], structure, limit)
            row_parts.append(rows)
            target_parts.append(target)
        if not row_parts:
            return None
        rows = np.concatenate(row_parts)
        target = np.concatenate(target_parts)
        if len(rows) < ROWS_PER_COEFFICIENT * rows.shape[1]:
            return None
        # A column that stands at zero, as that of a reference that nobody moved, gets a coefficient of zero.
        length = np.linalg.norm(rows, axis=0)
        is_zero = length == 0
        length[is_zero] = 1.0
        solution = np.linalg.lstsq(rows / length, target, rcond=None)[0] / length

        # From coefficients of the columns to those of the law.
        n_past = structure.n_states
        if structure.integrates:
            n_past -= 1
        n_driving = structure.n_states + 1
        of_command = np.append(1.0, -solution[:n_past])
        if structure.integrates:
            of_command = np.convolve(of_command, [1.0, -1.0])
        of_reference = solution[n_past : n_past + n_driving]
        of_output = solution[n_past + n_driving :]
        if structure.of_error:
            of_output = -of_reference
        return RecordedLaw(
            of_command,
            of_reference,
            of_output,
            residual=float(np.std(target - rows @ solution)),
            rounding=self.rounding(of_command, of_reference, of_output),
            dt_s=self.dt_s * thinned,
            tells_period=False,
        )

    def rounding(self, of_command: RealArray, of_reference: RealArray, of_output: RealArray) -> float:
        """Root mean square, input units, of what the decimals of the columns leave of an exact law.

        `of_command`, `of_reference`, `of_output` (n + 1,) : coefficients by which the rows of each column
        count (`RecordedLaw`), not checked. Errors of rounding are independent and uniform over a step: their
        variance is a twelfth (12) of its square.
        """
        variance = (
            of_command @ of_command * self.command_step**2
            + of_reference @ of_reference * self.reference_step**2
            + of_output @ of_output * self.output_step**2
        ) / 12
        # Sums of doubles are themselves rounded, a few times per term.
        of_doubles = DOUBLE_ROUNDINGS * np.finfo(np.float64).eps * self.largest
        return float(np.sqrt(variance)) + of_doubles


def _regression(
    command: RealArray,
    reference: RealArray,
    output: RealArray,
    structure: _Structure,
    limit: float,
) -> tuple[RealArray, RealArray]:
    """Regression of a law: rows (M, P) of past commands and driving signals, and target (M,).

    `command`, `reference`, `output` (T,) : columns of one record. Newest sample of each signal first; rows of
    which a command is at the `limit`, in units of the input, are left out, so that M may be 0. Raises
    ValueError where a column has fewer rows than the law has states, and one: the caller has longer ones.
    """
    n_samples = structure.n_states + 1
    commands = sliding_window_view(command, n_samples)[:, ::-1]
    references = sliding_window_view(reference, n_samples)[:, ::-1]
    outputs = sliding_window_view(output, n_samples)[:, ::-1]
    is_inside = np.all(np.abs(commands) < limit, axis=1)
    commands = commands[is_inside]
    references = references[is_inside]
    outputs = outputs[is_inside]
    if structure.integrates:
        # With its pole at z = 1 the law makes the change of the command.
        commands = commands[:, :-1] - commands[:, 1:]
    driving = [references, outputs]
    if structure.of_error:
        driving = [references - outputs]
    return np.hstack([commands[:, 1:], *driving]), commands[:, 0]


def _rounding_step(signals: Sequence[RealArray]) -> float:
    """Step of the rounding errors of a column, in root mean square over its rows; 0 where values are exact.

    `signals` : the column (T,) of each record. Steps of a reference are written in full where a chirp is
    rounded, so the finest step of all records counts. Multiples of a step that is no power of ten (an encoder
    of 3 micrometres written with three decimals of a millimetre) were not rounded by the log. A value that
    stands has one rounding error, which a law with integral action does not see. Raises ValueError without
    signals.
    """
    finest = min(_decimal_step(signal) for signal in signals)
    if finest == 0.0:
        return 0.0
    in_steps = np.concatenate([np.asarray(signal / finest) for signal in signals])
    multiples = np.unique(in_steps)
    counts = np.round(multiples)
    # What is no multiple has a step that differs from value to value (significant digits).
    if np.all(np.abs(multiples - counts) < SCALED_SLACK):
        steps = counts.astype(np.int64)
        if np.gcd.reduce(steps - steps[0]) > 1:
            return 0.0
    is_moving = np.concatenate([np.diff(signal) != 0 for signal in signals])
    moving_share = np.mean(is_moving)
    return finest * float(np.sqrt(moving_share))


def _decimal_step(signal: RealArray) -> float:
    """Step to which a column (T,) was rounded, in its units, in root mean square; 0 where there is none.

    A power of ten; or the smallest difference, where all values are multiples of it, as of decimals that were
    scaled to another unit; or that of so many significant digits, or of a number of 32 bits, at each value. A
    column of zeros counts as whole numbers: 1. Finite numbers, one at least: not checked.
    """
    values = np.unique(signal)
    eps = np.finfo(np.float64).eps

    # Decimals as they were written: the largest power of ten of which every value is a multiple.
    for decimals in range(MOST_DECIMALS + 1):
        scaled = values * 10.0**decimals
        # Four roundings: of the text, of the power of ten, of their product, and one to spare.
        slack = DECIMAL_SLACK + 4 * eps * np.abs(scaled)
        if np.all(np.abs(scaled - np.round(scaled)) <= slack):
            return float(10.0**-decimals)

    # Decimals that were scaled to another unit: multiples of the smallest difference.
    if values.size > 1:
        smallest_difference = float(np.min(np.diff(values)))
        counts = values / smallest_difference
        # Counts beyond this are not told from neighbours by doubles that were multiplied once.
        are_told_apart = np.max(np.abs(counts)) < MOST_COUNTS
        if are_told_apart and np.all(np.abs(counts - np.round(counts)) < SCALED_SLACK):
            return smallest_difference

    # Significant digits: a power of ten for each value, by its size.
    is_nonzero = values != 0
    size = np.abs(values[is_nonzero])
    exponent = np.floor(np.log10(size))
    # Four roundings are allowed for, as above.
    for digits in SIGNIFICANT_DIGITS:
        step = 10.0 ** (exponent + 1 - digits)
        counts = size / step
        slack = DECIMAL_SLACK + 4 * eps * size / step
        if np.all(np.abs(counts - np.round(counts)) <= slack):
            return float(np.sqrt(np.mean(step**2)))

    # Numbers of 32 bits: the distance to the next one, for each value.
    if np.array_equal(values, values.astype(np.float32)):
        distance = np.spacing(size.astype(np.float32)).astype(np.float64)
        return float(np.sqrt(np.mean(distance**2)))
    return 0.0
