"""The control law that made the logs of a loop, read off its records, and whether it repeats what was logged.

A linear controller that runs once a row makes its command of its own past, the reference and the output:

    u_k = -a_1 u_{k-1} - .. - a_n u_{k-n} + b_0 r_k + .. + b_n r_{k-n} + c_0 y_k + .. + c_n y_{k-n} .

Least squares finds the coefficients. What they leave is the rounding of the log, if the controller ran at
the log's step; a controller that ran faster used rows that were never logged, and leaves more. Where every
signal is smooth from row to row, the rows in between can be guessed, and neither can be told.
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
# A row whose command stands within this share of the largest one is at the limit, where no linear law holds.
LIMIT_SHARE = 0.999
# Residual over what the rounding of the columns leaves of a true law, up to which the law is the one that
# ran. Five simulated drives have 1.00 +- .01, a drive that logs every second sample has 9.
MOST_OF_ROUNDING = 1.5
# A controller twice as fast would have left more than rounding does: at least as much again. Less could be an
# error of the extrapolation, which is right to a third on simulated drives.
LEAST_EXCESS = 1.0
# Of that excess the law may show this share: half of it is as near to none as to all.
SHOWN_SHARE = 0.5
# Rows of all records together that are used: the residual is known to 1 % then.
MOST_ROWS = 16_000
# Decimal places that are looked for in a column: what logs have; more are those of numbers of 64 bits.
MOST_DECIMALS = 9
# Multiples of a step up to which a column may have been scaled: of 24 bits, the most of any converter.
MOST_COUNTS = 2**24
# Significant digits that are looked for: "%.4g" to "%.10g".
SIGNIFICANT_DIGITS = range(4, 11)


@dataclass(frozen=True, eq=False)
class RecordedLaw:
    """A linear law that was read off the records of a loop.

    Attributes
    ----------
    own : ndarray, shape (n + 1,)
        1, a_1 .. a_n: denominator in z, highest power first.
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
        """Whether the law leaves of the command no more than the rounding of the log."""
        return self.residual <= MOST_OF_ROUNDING * self.rounding

    @property
    def on_error(self) -> tuple[RealArray, RealArray] | None:
        """Numerator and denominator in z, highest power first, of K in u = K (r - y).

        None where reference and output enter differently.
        """
        size = np.linalg.norm(self.of_reference)
        if np.linalg.norm(self.of_reference + self.of_output) > 1e-6 * size:
            return None
        return self.of_reference, self.own

    @property
    def acts_at_once(self) -> bool:
        """Whether the command of a row depends on the output of the same row."""
        largest = float(np.max(np.abs(self.of_output)))
        return bool(abs(self.of_output[0]) > 1e-3 * largest)


def law_of(records: Sequence[Record]) -> RecordedLaw | None:
    """The simplest law that explains the command of SISO records as well as any of a few states.

    Parameters
    ----------
    records : sequence of Record
        One input, one output, one reference column each; one sampling time.

    Returns
    -------
    RecordedLaw or None
        None where a record has no reference, or the records are too short to tell a law.

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

    Its log would look as every second row of this one does, but for a factor that the steps from every second
    to every fourth and eighth row show: the errors of guessing the rows in between grow with a power of the
    step, and with a higher one where the signals are smooth over a step. Steps of the reference may fall on
    every fourth row, which leaves little to guess there, so even and odd rows are judged by themselves, and
    the smaller answer counts. A reference that the controller got as it was written has no rounding error,
    though it has decimals, so what this law leaves beyond that of the other two columns may be an excess.
    """
    least = np.inf
    for parity in range(2):
        second = columns.least_residual(structure, 2, parity)
        fourth = columns.least_residual(structure, 4, parity)
        eighth = columns.least_residual(structure, 8, parity)
        if second is None or fourth is None or eighth is None:
            return False
        falls = max(fourth, law.rounding) / second
        fell_before = max(eighth, law.rounding) / max(fourth, law.rounding)
        least = min(least, second / (falls * max(falls / fell_before, 1.0)))
    certain_rounding = columns.rounding(law.own, np.zeros_like(law.of_reference), law.of_output)
    shown = np.sqrt(max(law.residual**2 - certain_rounding**2, 0.0))
    return bool(least >= LEAST_EXCESS * law.rounding and shown <= SHOWN_SHARE * least)


@dataclass(frozen=True)
class _Structure:
    """Form of a law: of the error, or of reference and output; its states; whether one is an integrator."""

    of_error: bool
    n_states: int
    integrates: bool


# Simplest first.
STRUCTURES = tuple(
    _Structure(of_error, n_states, integrates)
    for of_error in (True, False)
    for n_states in range(1, MOST_STATES + 1)
    for integrates in (True, False)
)


@dataclass(frozen=True, eq=False)
class _Columns:
    """Command, reference and output of some records, and the steps of their decimals."""

    signals: tuple[tuple[RealArray, RealArray, RealArray], ...]
    command_step: float
    reference_step: float
    output_step: float
    largest: float
    dt_s: float

    @classmethod
    def of(cls, records: Sequence[Record]) -> _Columns:
        signals = []
        for record in records:
            rows = slice(0, MOST_ROWS // len(records))
            reference = np.asarray(record.reference)[rows, 0]
            signals.append((record.input[rows, 0], reference, record.output[rows, 0]))
        commands, references, outputs = zip(*signals, strict=True)
        return cls(
            tuple(signals),
            # Of the command its own steps count, whether they come from the log or from a converter.
            command_step=float(np.sqrt(np.mean([_decimal_step(command) ** 2 for command in commands]))),
            reference_step=_rounding_step(references),
            output_step=_rounding_step(outputs),
            largest=max(float(np.max(np.abs(command))) for command in commands),
            dt_s=records[0].dt_s,
        )

    def least_residual(self, structure: _Structure, thinned: int, parity: int) -> float | None:
        """Of the laws of every `thinned`-th even or odd row, the least residual; None: too few rows."""
        laws = [self.fitted(structure, thinned, start) for start in range(parity, thinned, 2)]
        return min((law.residual for law in laws if law is not None), default=None)

    def fitted(self, structure: _Structure, thinned: int = 1, start: int = 0) -> RecordedLaw | None:
        """The law of a structure, by least squares over every row, or every `thinned`-th one from `start`.

        None where there are too few rows.
        """
        limit = LIMIT_SHARE * self.largest
        parts = []
        for command, reference, output in self.signals:
            if command.size <= thinned * (structure.n_states + 2):
                continue
            every = slice(start, None, thinned)
            parts.append(_regression(command[every], reference[every], output[every], structure, limit))
        if not parts:
            return None
        rows = np.concatenate([part[0] for part in parts])
        target = np.concatenate([part[1] for part in parts])
        if len(rows) < MOST_STATES * rows.shape[1]:
            return None
        # Of columns that stand at zero, as those of a reference that nobody moved, the law has nothing.
        length = np.linalg.norm(rows, axis=0)
        length[length == 0] = 1.0
        solved = np.linalg.lstsq(rows / length, target, rcond=None)[0] / length

        # From coefficients of the columns to those of the law.
        n_own = structure.n_states - 1 if structure.integrates else structure.n_states
        own = np.append(1.0, -solved[:n_own])
        if structure.integrates:
            own = np.convolve(own, [1.0, -1.0])
        of_reference = solved[n_own : n_own + structure.n_states + 1]
        of_output = -of_reference if structure.of_error else solved[n_own + structure.n_states + 1 :]
        return RecordedLaw(
            own,
            of_reference,
            of_output,
            residual=float(np.std(target - rows @ solved)),
            rounding=self.rounding(own, of_reference, of_output),
            dt_s=self.dt_s * thinned,
            tells_period=False,
        )

    def rounding(self, own: RealArray, of_reference: RealArray, of_output: RealArray) -> float:
        """Root mean square of what the decimals of the columns leave of an exact law."""
        variance = (
            own @ own * self.command_step**2
            + of_reference @ of_reference * self.reference_step**2
            + of_output @ of_output * self.output_step**2
        ) / 12
        # Sums of doubles are themselves rounded, a few times per term.
        of_doubles = 100 * np.finfo(np.float64).eps * self.largest
        return float(np.sqrt(variance)) + of_doubles


def _regression(
    command: RealArray,
    reference: RealArray,
    output: RealArray,
    structure: _Structure,
    limit: float,
) -> tuple[RealArray, RealArray]:
    """Rows (M, P) and target (M,): newest sample of each signal first, rows at the limit left out."""
    windows = [
        sliding_window_view(signal, structure.n_states + 1)[:, ::-1]
        for signal in (command, reference, output)
    ]
    inside = np.all(np.abs(windows[0]) < limit, axis=1)
    own, of_reference, of_output = (window[inside] for window in windows)
    if structure.integrates:
        # With its pole at z = 1 the law makes the change of the command.
        own = own[:, :-1] - own[:, 1:]
    driving = [of_reference - of_output] if structure.of_error else [of_reference, of_output]
    return np.hstack([own[:, 1:], *driving]), own[:, 0]


def _rounding_step(signals: Sequence[RealArray]) -> float:
    """Step of the rounding errors of a column, in the mean over its rows; 0 where its values are exact.

    Steps of a reference are written in full where a chirp is rounded, so the finest step of all records
    counts. Multiples of a step that is no power of ten (an encoder of 3 micrometres written with three
    decimals of a millimetre) were not rounded by the log. A value that stands has one rounding error, which
    a law with integral action does not see.
    """
    finest = min(_decimal_step(signal) for signal in signals)
    if finest == 0.0:
        return 0.0
    multiples = np.unique(np.concatenate([np.asarray(signal / finest) for signal in signals]))
    counts = np.round(multiples)
    # What is no multiple has a step that differs from value to value (significant digits).
    if np.all(np.abs(multiples - counts) < 1e-3):
        steps = counts.astype(np.int64)
        if np.gcd.reduce(steps - steps[0]) > 1:
            return 0.0
    moving = np.concatenate([np.diff(signal) != 0 for signal in signals])
    return finest * float(np.sqrt(np.mean(moving)))


def _decimal_step(signal: RealArray) -> float:
    """Step to which a column was rounded, in the mean over its values; 0 where there is none.

    A power of ten; or the smallest difference, where all values are multiples of it, as of decimals that were
    scaled to another unit; or that of so many significant digits, or of a number of 32 bits, at each value.
    """
    values = np.unique(signal)
    eps = np.finfo(np.float64).eps
    for decimals in range(MOST_DECIMALS + 1):
        scaled = values * 10.0**decimals
        if np.all(np.abs(scaled - np.round(scaled)) <= 1e-6 + 4 * eps * np.abs(scaled)):
            return float(10.0**-decimals)

    if values.size > 1:
        least = float(np.min(np.diff(values)))
        counts = values / least
        # Counts beyond this are not told from neighbours by doubles that were multiplied once.
        if np.max(np.abs(counts)) < MOST_COUNTS and np.all(np.abs(counts - np.round(counts)) < 1e-3):
            return least

    size = np.abs(values[values != 0])
    exponent = np.floor(np.log10(size))
    for digits in SIGNIFICANT_DIGITS:
        step = 10.0 ** (exponent + 1 - digits)
        if np.all(np.abs(size / step - np.round(size / step)) <= 1e-6 + 4 * eps * size / step):
            return float(np.sqrt(np.mean(step**2)))
    if np.array_equal(values, values.astype(np.float32)):
        return float(np.sqrt(np.mean(np.spacing(size.astype(np.float32)).astype(np.float64) ** 2)))
    return 0.0
