"""What makes logs hopeless or doubtful, told by their columns alone in a fraction of a second.

`early_checks` lists them in the order in which they speak. They need numpy and nothing else, so that a
command refuses hopeless logs before it loads what identifies: that takes seconds. Each is a function of the
records of one channel (one input, one output, of one sampling time; at least one record) that returns its
complaint, one line with file, column, what is expected and what mends it, or "" where it has none. A refusal
is certain. What may be meant is a doubt (`early_doubts`), and the identification goes on.

Whether an output answers to its input is asked by three tests without a model, of coherence, prediction and
correlation, each with its reference at its function.

A `Record` has an input (T, U), an output (T, Y), where it was logged a reference (T, R), finite samples of no
more than 1e100, T at least 1, names of its columns and a sampling time dt_s: it could not be made otherwise.
Checks of one channel look at the first input and the first output only. An empty list of records is refused
nowhere here: each check fails on it, or has nothing to say.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ident.data.arrays import RealArray, clipped_share
from ident.data.finding import WHITE_LAGS, Finding, FindingKind, finding
from ident.data.record import Record
from ident.data.wrapping import spikes_in, wraps_at

# Samples of which the longest record needs more, and rows away from one reading or after the input's start:
# 50. Every model's residuals are tested over WHITE_LAGS = 25 lags, and such a test needs more than two
# samples a lag: with fewer no identification ends, whatever the order of its model.
FEWEST_SAMPLES = 2 * WHITE_LAGS

# The same of a log of a loop: 96. What its noise does in the command comes back, so that it is described by
# an autoregression of up to 32 coefficients (`NOISE_ORDERS`), fitted on the rows that have 32 before them;
# that needs two equations a coefficient.
FEWEST_IN_LOOP = 96

# Relative to its motion: a column that differs by no more from a multiple of another one is its copy. Text
# logs have six digits or more, of which rounding leaves 2e-6 of a motion about a level of its own size; the
# best servo follows its reference ten times worse, say 1e-4.
_COPY_ERROR = 1e-5
# Rows by which a copy may be late: as a value that went over a bus or through a buffer. Chosen: a tenth of a
# second at 500 Hz; twice as many take twice as long, 0.1 s for a log of 100 000 rows.
_LATEST_COPY = 50

# Relative to its changes: a command that a law of the output leaves no more of is that law's. A command of
# five digits keeps 1e-4 of changes a tenth of its size; what moves it by more tells of the machine.
_LAW_ERROR = 1e-3

# Readings of an output that takes fewer different values are doubted: so few steps of a sensor hide what a
# light mode does. As in `clipped_share`, which takes a signal of fewer levels for one of few levels by
# design.
_FEW_READINGS = 10

# Rows over which half of the readings are held at least, for a sensor that holds them: of one row none is.
_FEWEST_HELD = 2
# Changes of up to so many times the smallest one are a step of an encoder: between one step and two.
_STEPS_OF_ONE = 1.5

# Share of samples (half): a command of a loop that stands at its ends more often than not follows no linear
# law there.
_MOSTLY = 0.5

# Frequencies, as the participation ratio of the command's spectrum, that tell a machine from its loop. A Hann
# window makes 1.5 of one line, 2 of a sine; an integrator that hunts in stiction has 3.3, logs of 45 machines
# 8 and more.
FEWEST_LINES = 6.0

# Probability that two signals which have nothing in common pass for a cause and its answer, in each of the
# tests that `_answers` makes. Chosen: errors on that side cost time only, as the identification finds that
# nothing is explained.
_BY_CHANCE = 1e-3
# Its standard normal deviate, one-sided, for the chi-square limit: without SciPy there is no function for it.
_BY_CHANCE_DEVIATE = 3.09

# Parts into which the coherence test cuts a record: few for slow answers, many for weak ones. Chosen, by
# factors of four.
_PARTS = (8, 32, 128)
# Samples of a part at least: shorter ones have too few lines. A record that has no room for the fewest parts
# is not tested. Chosen.
_SHORTEST_PART = 32
# Share of the largest power of the cause: lines with less (-90 dB) hold rounding only, of a log of five
# digits or so. Chosen.
_NO_POWER = 1e-9

# Samples over which the prediction test averages: from one up to a sixty-fourth of the sampling rate, for
# machines that are far slower than their log. Chosen, by factors of four.
_AVERAGED = (1, 4, 16, 64)
# Earlier values of the output in a prediction: ten pairs of poles for what it does by itself. Chosen.
_OWN_PAST = 20
# Values of the cause in a prediction: as many as show its action over a few samples; later ones are seen at
# coarser averages, each four times as long. Chosen.
_PAST_OF_CAUSE = 10
# Moves of a cause (participation ratio): of fewer, ten lags have no variance that their own squares tell.
# Chosen: two for each lag.
_FEWEST_EVENTS = 20.0
# Share of the largest eigenvalue of their covariance: lags of a slow cause with less variance of their own
# are one and the same: the root of it, 1e-4, is what a log of four digits tells of their difference. Chosen.
_SAME_LAGS = 1e-8
# Samples of each average that the prediction test uses at most: 20 000 rows of 31 columns cost 20 ms.
_MOST_AVERAGES = 20_000
# Share of an output's samples by which an answer may come late: what overlaps less, a quarter, tells nothing.
# Chosen.
_LATEST = 0.75
# Samples that the correlation test uses at most, to end in a fraction of a second.
_MOST_CORRELATED = 200_000
# Share of the output's power: what is predicted better (1e-9 of its size) is rounding, of which no test
# holds.
_EXACT = 1e-18


@dataclass(frozen=True)
class EarlyCheck:
    """A check that can refuse logs.

    Attributes
    ----------
    name : str
        What it asks for, as in "the output moves".
    complaint : callable
        Of the records of one channel, one at least: one line, or "" where there is nothing to complain of.
    """

    name: str
    complaint: Callable[[Sequence[Record]], str]


def refuse_hopeless(records: Sequence[Record], checks: Sequence[EarlyCheck]) -> None:
    """Nothing, where no check has a complaint.

    Parameters
    ----------
    records : sequence of Record
        Of one channel, to identify from: one input and one output each, which is not checked.
    checks : sequence of EarlyCheck
        In the order in which they speak: `early_checks`.

    Raises
    ------
    ValueError
        The first complaint, one line: file, column, what is expected, what mends it.
    """
    for check in checks:
        complaint = check.complaint(records)
        if complaint:
            raise ValueError(complaint)


def early_doubts(records: Sequence[Record]) -> list[Finding]:
    """Findings SATURATED, REFERENCE_STILL, READINGS_HELD, then FEW_READINGS, on records that can be used but
    hardly are what was meant.

    A command of a loop that mostly stands at its ends, a reference that stands still, an output that a sensor
    holds, an output of few readings; one input and one output each (not checked). Empty where nothing is
    doubted.
    """
    return [
        *saturated(records),
        *still_references(records),
        *held_readings(records),
        *few_readings(records),
    ]


def too_few_samples(records: Sequence[Record], order: int = 0, *, in_loop: bool = False) -> str:
    """The complaint that no record has more than `FEWEST_SAMPLES` rows, `FEWEST_IN_LOOP` of a loop, or "".

    order: of the model, where it is stated (else 0); it stands in the complaint and decides nothing. in_loop:
    the logs were made in a loop. ValueError of `max` without records.
    """
    longest = max(records, key=lambda record: record.n_samples)
    fewest = FEWEST_IN_LOOP if in_loop else FEWEST_SAMPLES
    if longest.n_samples > fewest:
        return ""
    asked = ""
    if order:
        asked = f" for order {order}"
    elif in_loop:
        asked = " to tell a machine from the loop around it"
    return (
        f"{longest.label}: {longest.n_samples} samples are too few{asked}; expected more than "
        f"{fewest} in one log, better some thousand: record longer, or log faster"
    )


def still_input(records: Sequence[Record]) -> str:
    """The complaint about the first record none of whose inputs moves, or ""; any number of columns."""
    for record in records:
        if not np.ptp(record.input, axis=0).any():
            return _constant(record, "input", record.input_names[0], float(record.input[0, 0]))
    return ""


def still_output(records: Sequence[Record]) -> str:
    """The complaint about the first record one of whose outputs is constant, or ""; any number of columns."""
    for record in records:
        for index, name in enumerate(record.output_names):
            if not np.ptp(record.output[:, index]) > 0:
                return _constant(record, "output", name, float(record.output[0, index]))
    return ""


def _constant(record: Record, role: str, name: str, value: float) -> str:
    """The complaint that a column `name` stands at a value, in its units.

    role: "input" or "output", also the name of the option; that the column stands still is not checked.
    """
    return (
        f"{record.label}: {role} column '{name}' is constant ({value:.6g}); expected a signal that moves: "
        f"leave this log out, or name another column with --{role} NAME ({role})"
    )


def late_command(records: Sequence[Record]) -> str:
    """The complaint that in every record the input first moves when hardly a sample is left, or "".

    Hardly: `FEWEST_SAMPLES` or fewer from the first row whose input differs from that of row 0. An input that
    never moves counts as moving at once: `still_input` speaks of it.
    """
    samples_left = []
    for record in records:
        moved = record.input[:, 0] != record.input[0, 0]
        first_move = int(np.argmax(moved))
        samples_left.append(record.n_samples - first_move)
    longest = int(np.argmax(samples_left))
    if samples_left[longest] > FEWEST_SAMPLES:
        return ""
    record = records[longest]
    return (
        f"{record.label}: input column '{record.input_names[0]}' first moves {samples_left[longest]} samples "
        f"before the end, too late to show an answer; expected more than {FEWEST_SAMPLES} samples from "
        "there: record longer"
    )


def two_readings(records: Sequence[Record]) -> str:
    """The complaint that the output takes two values at most in all records together, or "".

    One value alone is complained of with that value twice, where `still_output` has not spoken before.
    """
    values = np.unique(np.concatenate([np.unique(record.output[:, 0]) for record in records]))
    if values.size > 2:
        return ""
    name = records[0].output_names[0]
    return (
        f"{records[0].label}: output column '{name}' takes two values only, {values[0]:.9g} and "
        f"{values[-1]:.9g}; expected a measured motion: move by more than a step of the sensor, log more "
        "digits, or name another column with --output NAME (output)"
    )


def resting_output(records: Sequence[Record]) -> str:
    """The complaint that in every record the output leaves one reading for hardly a sample, or "".

    Hardly: for `FEWEST_SAMPLES` rows or fewer, as a sensor at its end or a machine that sticks. The complaint
    is about the last record.
    """
    for record in records:
        output = record.output[:, 0]
        values, counts = np.unique(output, return_counts=True)
        away = record.n_samples - int(counts.max())
        if away > FEWEST_SAMPLES:
            return ""
    name = record.output_names[0]
    return (
        f"{record.label}: output column '{name}' stands at {values[np.argmax(counts)]:.6g} in all but {away} "
        f"of {record.n_samples} samples, as a sensor at its end or a machine that sticks; expected more than "
        f"{FEWEST_SAMPLES} others: drive it harder, within the sensor's range, or name another column with "
        "--output NAME (output)"
    )


def copied_column(records: Sequence[Record]) -> str:
    """The complaint that the output is the input or a reference again, times a number, or ""; also some rows
    later.

    About the first such record; a column that stands still is nobody's copy.
    """
    for record in records:
        output = record.output[:, 0]
        other_columns = [("input", record.input[:, 0], record.input_names[0])]
        if record.reference is not None:
            other_columns += [
                ("reference", signal, name)
                for signal, name in zip(record.reference.T, record.reference_names, strict=True)
            ]
        for role, signal, name in other_columns:
            late = _copied_after(output, signal)
            if late is not None:
                when = "sample by sample"
                if late:
                    when = "a row later" if late == 1 else f"{late} rows later"
                return (
                    f"{record.label}: output column '{record.output_names[0]}' is the {role} column '{name}' "
                    f"again, {when}, so no machine shows in it; name the measured column with "
                    "--output NAME (output)"
                )
    return ""


def _copied_after(signal: RealArray, other: RealArray) -> int | None:
    """Rows, up to `_LATEST_COPY`, after which a signal (T,) is another one (T,) times a number; None where it
    is no copy.

    The rows that are compared move: others are copies of anything.
    """
    for late in range(min(_LATEST_COPY, signal.size // 2) + 1):
        later = signal[late:]
        if np.ptp(later) > 0 and _is_copy(later, other[: other.size - late]):
            return late
    return None


def _is_copy(signal: RealArray, other: RealArray) -> bool:
    """Whether a signal (T,) is another one (T,) times a number, beside a constant.

    False where the other one stands still, or where its power is beyond the range of doubles.
    """
    moved = signal - signal.mean()
    moved_other = other - other.mean()
    power = float(moved_other @ moved_other)
    if not 0 < power < np.inf:
        return False
    difference = moved - (moved @ moved_other) / power * moved_other
    return float(np.linalg.norm(difference)) <= _COPY_ERROR * float(np.linalg.norm(moved))


def few_lines(records: Sequence[Record]) -> str:
    """The complaint that records of a loop excite no band, or "".

    Their input is concentrated at few frequencies, as of a sine or a limit cycle, or their references all
    stand still: an arm cannot be told from its loop then. Records are cut to the shortest, of one sampling
    time; of inputs that all stand still nothing is said here (`still_input`).

    Notes
    -----
    The number of lines is the participation ratio (sum P)^2 / sum P^2 of the input's spectra, each scaled to
    unit power.
    """
    dt_s = records[0].dt_s
    shortest = min(record.n_samples for record in records)
    power = np.zeros(shortest // 2)
    for record in records:
        windowed = _without_line(record.input[:shortest, 0]) * np.hanning(shortest)
        # Without the line at zero.
        spectrum = np.fft.rfft(windowed)[1 : power.size + 1]
        periodogram = np.abs(spectrum) ** 2
        power += periodogram / max(float(periodogram.sum()), np.finfo(np.float64).tiny)
    count = power.sum() ** 2 / (power @ power)
    references = [record.reference for record in records if record.reference is not None]
    line = 1 + int(power.argmax())
    command = f"the command '{records[0].input_names[0]}'"
    stuck = saturated(records)
    if references and not any(np.any(np.ptp(reference, axis=0)) for reference in references):
        why = f"the reference '{records[0].reference_names[0]}' of these logs stands still"
    elif count >= FEWEST_LINES:
        return ""
    elif stuck:
        # What the limits leave of a command has few frequencies whatever the reference asks for.
        values = stuck[0].values
        return (
            f"{values['record']}: {command} stands at {values['low']:.6g} or {values['high']:.6g}, the ends "
            f"of its range, in {100 * float(values['share']):.3g} % of the samples, and turns too seldom to "
            "tell a machine from its loop: record the loop with a smaller reference"
        )
    elif line < FEWEST_LINES:
        # So few lines lie below that no band could have shown beside it.
        times = "time" if line == 1 else "times"
        return (
            f"{records[0].label}: {command} swings hardly more than {line} {times} in "
            f"{shortest * dt_s:.3g} s ({shortest} samples), too few to tell a machine from its loop: "
            "record longer, with a reference that moves more often (flexlink excite --closed-loop LOG...)"
        )
    else:
        largest_Hz = line / (shortest * dt_s)
        why = f"{command} is concentrated near {largest_Hz:.3g} Hz, as of a sine or a limit cycle"
    return (
        f"{records[0].label}: {why}: too little to tell a machine from its loop; record logs that excite "
        "a band: flexlink excite --closed-loop LOG..."
    )


def undriven_loop(records: Sequence[Record]) -> str:
    """The complaint that a loop's reference stands still and its command is the controller's alone, or "".

    Such a command follows from the output, so that it tells the controller and not the machine (Soderstrom,
    Gustavsson and Ljung, Int. J. Control 21(2), 1975). Said where in every record the reference stands still,
    as recorded or as the reader left it out (REFERENCE_STILL), and changes of the command are those of a law
    of `_PAST_OF_CAUSE` values of the output but for rounding. A command that something else moves, or a
    limit cuts, is no such law: nothing is said of it. IndexError without records.
    """
    names = []
    for record in records:
        if record.reference is None:
            still = [note for note in record.doubts if note.kind is FindingKind.REFERENCE_STILL]
        else:
            still = still_references([record])
        if not still or not _is_law_of_output(record.input[:, 0], record.output[:, 0]):
            return ""
        names.append(str(still[0].values["name"]))
    return (
        f"{records[0].label}: the reference '{names[0]}' stands still, and the command "
        f"'{records[0].input_names[0]}' is what the controller makes of '{records[0].output_names[0]}' "
        "alone: that tells the controller, not the machine. Record with a reference that moves: "
        "flexlink excite --closed-loop LOG..."
    )


def _is_law_of_output(command: RealArray, output: RealArray) -> bool:
    """Whether changes of a command (T,) are a linear law of an output (T,), now and before, but for
    `_COPY_ERROR`.

    Changes: a controller with an integrator is one, too. False for fewer rows than two a coefficient, and for
    a command that its own past tells as well: a step or a few sines, that nothing has to follow.
    """
    changes = np.diff(command)[:_MOST_AVERAGES]
    motion = _averages(output, 1, output.size)[: _MOST_AVERAGES + 1]
    n_equations = changes.size - _OWN_PAST
    if n_equations < 4 * _PAST_OF_CAUSE:
        return False
    lags = range(_PAST_OF_CAUSE)
    # What an integrator adds while the output stays beside the reference is constant.
    steady = np.ones(n_equations)
    past_of_output = [motion[1 + _OWN_PAST - lag : motion.size - lag] for lag in lags]
    of_output = np.column_stack([steady, *past_of_output])
    of_itself = np.column_stack(
        [changes[_OWN_PAST - lag : changes.size - lag] for lag in range(1, _PAST_OF_CAUSE + 1)]
    )
    target = changes[_OWN_PAST:]
    unexplained = []
    for rows in (of_output, of_itself):
        solution = np.linalg.lstsq(rows, target, rcond=None)[0]
        unexplained.append(float(np.linalg.norm(target - rows @ solution)))
    size = float(np.linalg.norm(target))
    return unexplained[0] <= _LAW_ERROR * size and unexplained[0] <= 0.1 * unexplained[1]


def _without_line(signal: RealArray) -> RealArray:
    """A signal (T,) without its straight line of least squares; zeros for one sample or two."""
    line = np.linspace(-1.0, 1.0, signal.size)
    centred = signal - signal.mean()
    power = max(float(line @ line), np.finfo(np.float64).tiny)
    slope = (line @ centred) / power
    return np.asarray(centred - slope * line)


def refuse_few_lines(records: Sequence[Record]) -> None:
    """Nothing, where the records of a loop excite a band; else raises ValueError with the complaint of
    `few_lines`.

    Without records IndexError.
    """
    refuse_hopeless(records, [FEW_LINES])


def no_answer(records: Sequence[Record]) -> str:
    """The complaint that in no record the output has anything to do with what moves the machine, or "".

    Notes
    -----
    In open loop that is the input. In a loop noise of a sensor comes back in the input, so that only the
    reference and earlier inputs count. Nothing is said where a reference stands still, where a record is
    short, or where readings wrap or jump as those of a sensor without a value: other checks speak of those.
    Signals that stand still were complained of before. IndexError without records.
    """
    for record in records:
        command = record.input[:, 0]
        output = record.output[:, 0]
        if output.size < min(_PARTS) * _SHORTEST_PART:
            return ""
        if spikes_in(command).size or spikes_in(output).size or wraps_at(output):
            return ""
        if record.reference is None:
            if _answers(output, command):
                return ""
            continue
        references = record.reference.T
        if any(np.ptp(reference) == 0 for reference in references):
            return ""
        if any(_answers(output, reference) for reference in references):
            return ""
        if _predicts(output, command, from_lag=1):
            return ""
    record = records[0]
    return (
        f"{record.label}: output column '{record.output_names[0]}' does not answer to the input column "
        f"'{record.input_names[0]}'; expected the motion that it causes: check wiring and machine, or "
        "name other columns with --input NAME --output NAME (input, output)"
    )


def _answers(output: RealArray, cause: RealArray) -> bool:
    """Whether an output (T,) shows more of a cause (T,) than chance would.

    The coherence sees what lasts, as a few sines; the prediction what happens once, as a step; the
    correlation what comes late. Both move, and have `_SHORTEST_PART` rows for each of 8 parts: `no_answer`
    has seen to it.
    """
    if _is_coherent(output, cause):
        return True
    if _predicts(output, cause, from_lag=0):
        return True
    return _correlates(output, cause)


def _correlates(output: RealArray, cause: RealArray) -> bool:
    """Whether what is new in an output (T,) is correlated with what was new in a cause (T,), at any lag >= 0.

    False where nothing new is common, as of a cause that stands still. Signals of 20 samples or fewer are not
    refused, and fail in NumPy.

    Notes
    -----
    Both are whitened by autoregressions of their own (Haugh, J. Am. Stat. Assoc. 71(354), 1976). Their
    product at a lag has mean zero where they are unrelated, and the sum of its squares is the variance of its
    sum (White, Econometrica 48(4), 1980), also where both move only now and then, as commands that are held.
    """
    n = min(output.size, _MOST_CORRELATED)
    answer = _innovations(output[:n])
    driven = _innovations(cause[:n])
    lags = np.arange(int(_LATEST * answer.size))
    products = _sums_of_products(answer, driven)[lags]
    squares = _sums_of_products(answer**2, driven**2)[lags]
    # Without a square of any size there is nothing but rounding.
    has_power = squares > _NO_POWER * squares.max()
    if not has_power.any():
        return False
    deviates = np.abs(products[has_power]) / np.sqrt(squares[has_power])
    # Probability of the largest deviate at one lag, two-sided, times the number of lags (Bonferroni).
    at_one_lag = math.erfc(float(deviates.max()) / math.sqrt(2))
    return lags.size * at_one_lag < _BY_CHANCE


def _sums_of_products(later: RealArray, earlier: RealArray) -> RealArray:
    """Sum of later[k + lag] earlier[k] of two signals (T,) at lags 0 to T - 1, (T,); lengths are equal."""
    n = later.size
    # Zeros behind the signals: no product wraps around.
    spectrum = np.fft.rfft(later, 2 * n) * np.fft.rfft(earlier, 2 * n).conj()
    return np.asarray(np.fft.irfft(spectrum, 2 * n)[:n])


def _innovations(signal: RealArray) -> RealArray:
    """What an autoregression of 20 lags does not predict of a signal (T,), (T - 20,), in its own size.

    The coefficients come from the first 20 000 rows, by least squares. Own size: the largest distance of the
    signal from its mean is one. T is more than 20; a signal that stands still leaves zeros.
    """
    centred = _averages(signal, 1, signal.size)
    fitted = centred[: _MOST_AVERAGES + _OWN_PAST]
    past = [fitted[_OWN_PAST - lag : fitted.size - lag] for lag in range(1, _OWN_PAST + 1)]
    coefficients = np.linalg.lstsq(np.column_stack(past), fitted[_OWN_PAST:], rcond=None)[0]
    prediction_error_filter = np.append(1.0, -coefficients)
    return np.asarray(np.convolve(centred, prediction_error_filter, "valid"))


def _is_coherent(output: RealArray, cause: RealArray) -> bool:
    """Whether two signals (T,) are more coherent at some frequency than noise would be, over parts of some
    lengths.

    False for signals of fewer than 8 parts of `_SHORTEST_PART` samples, and for one that stands still.

    Notes
    -----
    For K independent parts of independent signals, P(coherence > x) = (1 - x)^(K - 1) at one line (Carter,
    Proc. IEEE 75(2), 1987). Hann windows that overlap by half are worth K = 18 k^2 / (19 k - 1) parts of k.
    """
    for parts in _PARTS:
        size = output.size // parts
        if size < _SHORTEST_PART:
            return False
        window = np.hanning(size)
        spectra = []
        for signal in (output, cause):
            pieces = np.lib.stride_tricks.sliding_window_view(signal, size)[:: size // 2]
            centred = pieces - pieces.mean(axis=1, keepdims=True)
            spectra.append(np.fft.rfft(centred * window)[:, 1:])
        answer, driven = spectra
        power_answer = np.sum(np.abs(answer) ** 2, axis=0)
        power_driven = np.sum(np.abs(driven) ** 2, axis=0)
        common = np.abs(np.sum(answer * driven.conj(), axis=0)) ** 2
        is_driven = power_driven > _NO_POWER * power_driven.max()
        is_moving = power_answer > 0
        lines = is_driven & is_moving
        if not lines.any():
            continue
        coherence = common[lines] / (power_answer[lines] * power_driven[lines])
        n_pieces = answer.shape[0]
        # Carter's numbers for a Hann window and half overlap (see Notes).
        worth = 18 * n_pieces**2 / (19 * n_pieces - 1)
        largest = min(float(coherence.max()), 1.0)
        # Probability at one line, times the number of lines (Bonferroni).
        by_chance = coherence.size * (1 - largest) ** (worth - 1)
        if by_chance < _BY_CHANCE:
            return True
    return False


def _predicts(output: RealArray, cause: RealArray, from_lag: int) -> bool:
    """Whether an output (T,) is predicted better from its own past with a cause (T,) than without.

    False where there are fewer than two rows for each coefficient; True for an output that its past predicts
    but for rounding, of which no test holds.

    Notes
    -----
    Granger, Econometrica 37(3), 1969, at several rates. from_lag: 0 where the cause may act within the
    sample. What the cause adds to the output's autoregression is tested by its scores, with the variance that
    their own squares have (White, Econometrica 48(4), 1980): two signals that are held over the same samples
    are not related for that. Of a cause that moves a few times only, as a step, no such variance is known:
    there it is the likelihood ratio.
    """
    limit = _chi_square_limit(_PAST_OF_CAUSE)
    for averaged in _AVERAGED:
        n = min(output.size // averaged, _MOST_AVERAGES)
        n_equations = n - _OWN_PAST
        # Two equations for each coefficient at least: of fewer a test holds nothing.
        if n_equations < 2 * (_OWN_PAST + _PAST_OF_CAUSE):
            return False
        y = _averages(output, averaged, n)
        c = _averages(cause, averaged, n)
        past_of_output = [y[_OWN_PAST - lag : n - lag] for lag in range(1, _OWN_PAST + 1)]
        explained = np.linalg.qr(np.column_stack([np.ones(n_equations), *past_of_output]))[0]
        lags = range(from_lag, from_lag + _PAST_OF_CAUSE)
        past_of_cause = np.column_stack([c[_OWN_PAST - lag : n - lag] for lag in lags])

        # What the output's own past leaves of both.
        residual = y[_OWN_PAST:] - explained @ (explained.T @ y[_OWN_PAST:])
        added = past_of_cause - explained @ (explained.T @ past_of_cause)
        if not residual @ residual > _EXACT * float(y @ y):
            return True
        if _events(c) < _FEWEST_EVENTS:
            # Likelihood ratio n ln(J without the cause / J with it).
            solution = np.linalg.lstsq(added, residual, rcond=None)[0]
            left = residual - added @ solution
            power_left = max(float(left @ left), _EXACT)
            statistic = n_equations * np.log(float(residual @ residual) / power_left)
        else:
            # Score s of each lag, with the variance V that its own terms have: s^T V^-1 s.
            products = added * residual[:, None]
            size = np.maximum(np.linalg.norm(products, axis=0), np.finfo(np.float64).tiny)
            score = products.sum(axis=0) / size
            variance = (products / size).T @ (products / size)
            inverse = np.linalg.pinv(variance, rcond=_SAME_LAGS, hermitian=True)
            statistic = float(score @ inverse @ score)
        if statistic > limit:
            return True
    return False


def _chi_square_limit(degrees_of_freedom: int) -> float:
    """The value that a chi-square exceeds with probability `_BY_CHANCE` (Wilson and Hilferty, PNAS 17, 1931).

    Right to a per cent; degrees of freedom of zero divide by zero.
    """
    part = 2 / (9 * degrees_of_freedom)
    return float(degrees_of_freedom * (1 - part + _BY_CHANCE_DEVIATE * np.sqrt(part)) ** 3)


def _events(cause: RealArray) -> float:
    """How often a signal (T,) moves anew: the participation ratio of what its past does not predict.

    0 for one that stands still; T is more than 20.
    """
    power = _innovations(cause) ** 2
    sum_of_squares = max(float(power @ power), np.finfo(np.float64).tiny)
    return float(power.sum() ** 2 / sum_of_squares)


def _averages(signal: RealArray, averaged: int, n: int) -> RealArray:
    """The first n averages of a signal (T,) over so many samples, (n,), around zero and of unit size.

    Unit size: the largest is one; zeros for a signal that stands still. T is at least n `averaged`
    (ValueError of NumPy).
    """
    means = signal[: n * averaged].reshape(n, averaged).mean(axis=1)
    centred = means - means.mean()
    size = max(float(np.abs(centred).max()), np.finfo(np.float64).tiny)
    return np.asarray(centred / size)


def saturated(records: Sequence[Record]) -> list[Finding]:
    """Findings SATURATED, on every record of a loop (with a reference) whose input mostly stands at its ends.

    Mostly: more than `_MOSTLY` of its samples, at its least or largest value; the share is told with both
    values. Empty where there is none.
    """
    findings = []
    for record in records:
        command = record.input[:, 0]
        if record.reference is None or np.ptp(command) == 0:
            continue  # in open loop a command of two levels is a good one
        low = float(command.min())
        high = float(command.max())
        at_low = command == low
        at_high = command == high
        share = float(np.mean(at_low | at_high))
        if share > _MOSTLY:
            findings.append(
                finding(
                    FindingKind.SATURATED,
                    record=record.label,
                    name=record.input_names[0],
                    share=share,
                    low=low,
                    high=high,
                )
            )
    return findings


def still_references(records: Sequence[Record]) -> list[Finding]:
    """Findings REFERENCE_STILL, on every record whose references all stand still; often empty.

    A loop is opened by its reference only where that moves in every record.
    """
    findings = []
    for record in records:
        if record.reference is not None and not np.any(np.ptp(record.reference, axis=0)):
            findings.append(
                finding(
                    FindingKind.REFERENCE_STILL,
                    record=record.label,
                    name=record.reference_names[0],
                    value=float(record.reference[0, 0]),
                )
            )
    return findings


def held_readings(records: Sequence[Record]) -> list[Finding]:
    """Findings READINGS_HELD, on every record whose output is a sensor's last reading, held over varying
    numbers of rows.

    Attributes of each: `fewest` and `most` rows (of nine holds in ten), `from_rad_s`: above it nothing is
    told, the inverse of the longest of these holds, where a hold alone turns the phase by a radian. Empty
    where there is none.

    Notes
    -----
    A coarse encoder repeats its readings, too, but then moves on by one of its steps; what a sensor held
    meanwhile jumps by several of them, or has no steps. A reading that is held over one and the same number
    of rows is a logger's, which the reader takes as a coarser log.
    """
    findings = []
    for record in records:
        output = record.output[:, 0]
        changes = np.flatnonzero(np.diff(output))
        rows = np.diff(changes)
        if rows.size < FEWEST_SAMPLES:
            continue
        fewest, usual, most = (int(np.percentile(rows, share)) for share in (5, 50, 95))
        jumps = np.abs(np.diff(output)[changes])
        # The step of a coarse encoder is the size of most of its changes; rounding is no step.
        steps = np.count_nonzero(jumps < _STEPS_OF_ONE * jumps.min())
        if usual >= _FEWEST_HELD and most > fewest and steps < _MOSTLY * jumps.size:
            findings.append(
                finding(
                    FindingKind.READINGS_HELD,
                    record=record.label,
                    name=record.output_names[0],
                    fewest=fewest,
                    most=most,
                    from_rad_s=1 / (most * record.dt_s),
                )
            )
    return findings


def few_readings(records: Sequence[Record]) -> list[Finding]:
    """Findings FEW_READINGS, on every record whose output takes fewer than `_FEW_READINGS` values; often
    empty."""
    findings = []
    for record in records:
        count = np.unique(record.output[:, 0]).size
        if count < _FEW_READINGS:
            findings.append(
                finding(
                    FindingKind.FEW_READINGS, record=record.label, name=record.output_names[0], count=count
                )
            )
    return findings


def clipped(records: Sequence[Record]) -> list[Finding]:
    """Findings CLIPPED, on every input or output that stands suspiciously often at an end of its range.

    Of each record the first input and the first output; `share`: of its samples (`clipped_share`). Empty
    where none does; signals of fewer than ten levels are not judged.
    """
    findings = []
    for record in records:
        # An input at the amplifier's known limit is no doubt, nor are means of a binary one.
        limit_is_known = record.cut or (record.repair is not None and record.repair.own_s)
        for kind, signal, names in (
            ("input", record.input, record.input_names),
            ("output", record.output, record.output_names),
        ):
            if kind == "input" and limit_is_known:
                continue
            share = clipped_share(signal[:, 0])
            if share > 0:
                findings.append(
                    finding(FindingKind.CLIPPED, record=record.label, signal=kind, name=names[0], share=share)
                )
    return findings


STILL_INPUT = EarlyCheck("the input moves", still_input)
STILL_OUTPUT = EarlyCheck("the output moves", still_output)
FEW_LINES = EarlyCheck("the command of a loop excites a band", few_lines)


def early_checks(order: int = 0, *, loop: bool = False) -> list[EarlyCheck]:
    """The checks of one channel, in the order in which they speak.

    Parameters
    ----------
    order : int
        Of the model, where it is stated; else 0. Only for words.
    loop : bool
        The logs were made in a closed loop that is to be opened: their command has to excite a band.

    Returns
    -------
    list of EarlyCheck
        Nine, or ten with the one of a loop.
    """
    checks = [
        EarlyCheck(
            "more samples than a residual test needs", partial(too_few_samples, order=order, in_loop=loop)
        ),
        STILL_INPUT,
        STILL_OUTPUT,
        EarlyCheck("the command moves before the end", late_command),
        EarlyCheck("more than one step of the sensor", two_readings),
        EarlyCheck("the output leaves its place", resting_output),
        # Before copies: of a P controller alone the command is the output's copy.
        EarlyCheck("something moves a loop", undriven_loop),
        EarlyCheck("the output is no other column again", copied_column),
        EarlyCheck("the output answers", no_answer),
    ]
    if loop:
        checks.append(FEW_LINES)
    return checks
