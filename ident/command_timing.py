"""Tell what the command of a log does between two rows, and correct records and ellipses for it.

A model of records takes the command as held from row to row. A drive that controls faster than it logs holds
its command for its own period Tc and logs every T / Tc-th value; with w the frequency, such a command moves
the arm as

    H(Tc) / H(T) = 1 / S(w),    S(w) = (1 - e^{-jwT}) / (N (1 - e^{-jwTc})),   N = T / Tc,

times the logged command held for T would (H(h) = (1 - e^{-jwh}) / (jwh): zero-order hold; S is the mean over
the N commands of a step). The logged command is filtered with 1 / S, and everything after it may take it as
held from row to row. A drive that logs the mean of the N commands adds a second factor 1 / S.

`timing_of` reads the period of the controller from what was stated, from a command that repeats, or from a
law that made every command (`ident.recorded_law`). `with_equivalent_command` corrects the records for what is
known, `with_unknown_timing` widens the ellipses for what is not.

Neglected: what the command has above the Nyquist frequency of the log, which the rows do not show.

A `Record` has an input (T, U) (the command), an output (T, Y), where it was logged a reference, finite
samples, at least one row, and its step dt_s. `RecordedLaw` is a linear law of a controller: `repeats_command`
says that it explains the command but for rounding, `tells_period` that a faster controller would have left
more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import ComplexArray, IntArray, RealArray
from ident.data.ellipses import LEVEL, chi2_radius
from ident.data.finding import FindingKind, finding
from ident.data.record import Record
from ident.recorded_law import RecordedLaw, law_of
from ident.response_coefficients import coefficients_of, slow_angles

# Rows before and after one that its equivalent command is made of. With four on each side the filter is
# within .1 % of 1 / S up to 1 rad of w T, and within .5 % up to half the Nyquist frequency.
ROWS_BESIDE = 4
# Highest frequency times step up to which the filter is fitted, rad: above it most logs hold noise alone.
FITTED_UP_TO_RAD = 2.0
# Highest frequency times step at which an ellipse is fitted, rad: the Nyquist frequency but for rounding.
HIGHEST_ANGLE_RAD = 3.14
# Taps by which an ellipse follows a phase that grows with frequency, beside the basis. Chosen: about as many
# as the filter of a command has.
TAPS = 8
# Frequencies at which the filter of the command is fitted: forty for each of its taps, so that the fit is one
# of the curve and not of its points. Chosen.
FILTER_POINTS = 400
# Frequencies of a linear grid beside those for the taps. Chosen: enough without any tap.
EVEN_POINTS = 200
# Further ones of that grid for each tap: the last tap, which turns round half as often as there are taps up
# to the Nyquist frequency, then has eight of them in each of its turns.
EVEN_POINTS_PER_TAP = 4
# Ellipses of noise and timing add as variances, but an interval of the timing has ends that are as likely as
# its middle: with 1.5 times its half width the sum of both is held while the noise is up to .6 of it.
BEYOND_ENDS = 1.5
# Share of its largest value below which a response counts as zero: rounding of doubles. That of an arm which
# integrates falls by ten decades between its slowest motion and the Nyquist frequency.
SMALLEST_RESPONSE = 1e-14
# Ellipses are at least so wide along the gain, as a share of their width along the phase: twice the error
# with which the basis follows a fraction of a step.
GAIN_OF_PHASE = 0.1
# Of the gaps between changes of a command that repeats, more than this share is a multiple of its period, and
# of the changes more than this share keeps to one phase: the rest are rows that were lost. Chosen.
NEARLY_ALL = 0.99
# Gaps between changes of a command from which its period is read, at least. Chosen: fewer, as of a command of
# a few steps, may share a divisor by chance.
FEWEST_GAPS = 10
# Up to so many commands in a step a stated period need not be a whole part of it. Chosen; with 1, so that
# every period is checked, no test of the timing moves.
MOST_UNCHECKED = 2
# A stated period agrees with whole rows within this share: periods are stated with three digits or more.
SAME_PERIOD = 1e-3


class TimingSource(Enum):
    """How the period of the controller is known.

    STATED : somebody gave it
    LAW : a linear law made every command from the rows, and a faster one would have shown
    REPEATS : the command changes every few rows only
    OPEN_LOOP : there is no controller; the command is taken as held from row to row
    UNKNOWN : the period is not known; several holds are possible
    """

    STATED = "stated"
    LAW = "law"
    REPEATS = "repeats"
    OPEN_LOOP = "open loop"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Hold:
    """One possibility of what the command did between two rows.

    Attributes
    ----------
    share : float
        Period of the controller over the step of the log; 0: it changed all the time.
    averaged : bool
        The log holds the mean of the commands since the row before, not the last one.
    """

    share: float
    averaged: bool = False

    def response(self, angle_rad: RealArray) -> ComplexArray:
        """Response (F,) of the command's own hold over that of a hold for the whole step: 1 / S.

        `angle_rad` : w T (F,), 0 < w T <= pi. The square of 1 / S where averaged. Angles are not checked: nan
        at zero. A share below zero counts as zero.
        """
        step = -np.expm1(-1j * angle_rad)
        if self.share > 0:
            mean = self.share * step / -np.expm1(-1j * angle_rad * self.share)
        else:
            # The limit of many commands in a step: their sum becomes an integral.
            mean = step / (1j * angle_rad)
        power = -1
        if self.averaged:
            power = -2
        return np.asarray(mean**power, dtype=np.complex128)


# A command that is held from row to row: the period of the controller is the whole step of the log.
HELD = Hold(1.0)


@dataclass(frozen=True)
class CommandTiming:
    """What the command does between two rows, as far as it is known. Nothing is checked: `timing_of` makes
    it.

    Attributes
    ----------
    source : TimingSource
        How the period is known.
    row_step_s : float
        Step of the rows, s.
    period_s : float or None
        Period of the controller that made the log, s; None: not known.
    taken : Hold
        What the records are corrected for.
    possible : tuple of Hold
        What the ellipses have to hold; empty where the period is known.
    middle : Hold
        The hold at whose response the ellipses have their centres.
    rows_per_command : int
        Rows that were logged for each command; above 1 only the rows at which it changes are used.
    first_row : tuple of int
        First of these rows, for each record that `timing_of` was given, in their order; empty where every row
        is used.
    law : RecordedLaw or None
        Read off the records; None where there is none, or where it does not repeat the command.
    """

    source: TimingSource
    row_step_s: float
    period_s: float | None
    taken: Hold = HELD
    possible: tuple[Hold, ...] = ()
    middle: Hold = HELD
    rows_per_command: int = 1
    first_row: tuple[int, ...] = ()
    law: RecordedLaw | None = None

    @property
    def known(self) -> bool:
        """Whether there is one possibility only, which the records are corrected for: `possible` is empty."""
        return not self.possible

    @property
    def offered_dt_s(self) -> float:
        """Period, s, that a new controller may have.

        The known one where it is a whole part of the step of the rows in use, to `SAME_PERIOD`; else that
        step. Never zero for a timing of `timing_of`.
        """
        used_step_s = self.row_step_s * self.rows_per_command
        if self.period_s is None:
            return used_step_s
        # A period of zero, which nobody can state (`timing_of`), would divide by zero.
        parts = used_step_s / self.period_s
        is_whole = abs(parts - round(parts)) <= SAME_PERIOD * parts
        return self.period_s if is_whole else used_step_s

    @property
    def acts_at_once(self) -> bool:
        """Whether the rows tell that the command of a row was made of the output of the same row.

        False without a law, and for a law that does not tell its period.
        """
        return self.law is not None and self.law.tells_period and self.law.acts_at_once


def timing_of(
    records: Sequence[Record],
    *,
    in_loop: bool,
    stated_period_s: float | None = None,
    averaged: bool = False,
) -> CommandTiming:
    """Timing of the command of records with one input and one output, as far as it is known.

    Parameters
    ----------
    records : sequence of Record
        As logged, of one sampling time.
    in_loop : bool
        The records were made in closed loop. In open loop a command is taken as held from row to row.
    stated_period_s : float, optional
        Period of the controller that made the records, s.
    averaged : bool
        The drive logs the mean of its commands over each step.

    Returns
    -------
    CommandTiming
        By the first of: the stated period, open loop, a command that repeats, a law; else UNKNOWN.

    Raises
    ------
    ValueError
        The log contradicts the stated period, or the mean of commands was logged in open loop and their
        period is not stated. Not checked: that there are records (IndexError without), that their steps
        agree, and that the stated period is above zero (the options of a case refuse others).
    """
    step_s = records[0].dt_s
    rows_per_command = rows_per_command_of(records)

    # Somebody stated the period.
    if stated_period_s is not None:
        usual_gap = min(_usual_gaps(records), default=1)
        _refuse_contradiction(records[0], stated_period_s, usual_gap)
        # In a loop the position of a row at which the command stands was never seen by the controller.
        # Without a law it may be an experiment in open loop, of which every row counts; unless the controller
        # is faster than the command changes in the log, so that it is the logger that repeats.
        stated = CommandTiming(TimingSource.STATED, step_s, stated_period_s)
        if in_loop:
            of_controller = _with_rows(stated, records, rows_per_command)
            logger_repeats = stated_period_s < rows_per_command * step_s * (1 - SAME_PERIOD)
            if of_controller.law is not None or logger_repeats:
                stated = of_controller
        used_step_s = stated.rows_per_command * step_s
        if stated_period_s < used_step_s * (1 - SAME_PERIOD):
            _refuse_law_at_rows(records[0], stated_period_s, used_step_s, stated.law)
            # A law of rows between which the command changed is not the one that ran.
            return replace(stated, taken=Hold(stated_period_s / used_step_s, averaged), law=None)
        return stated

    # An experiment in open loop: nobody computed the command from the rows.
    if not in_loop:
        if averaged:
            raise ValueError(
                f"{records[0].label}: a mean of commands over {step_s:.6g} s needs the period of each: add "
                "--controller-period SECONDS (controller_period_s)"
            )
        return CommandTiming(TimingSource.OPEN_LOOP, step_s, None)

    # The command repeats: it changes every few rows, while the output goes on.
    if rows_per_command > 1:
        every_row = CommandTiming(TimingSource.REPEATS, step_s, rows_per_command * step_s)
        of_controller = _with_rows(every_row, records, rows_per_command)
        # Without a law it may be an experiment in open loop that was taken for a loop: then every row counts,
        # and held from row to row is what the rows say.
        return every_row if of_controller.law is None else of_controller

    # A law that made every command from the rows, and would have left more had it run faster.
    law = law_of(records)
    if law is None or not law.repeats_command:
        # Logs of several controllers have a law each, and none in common.
        laws = [law_of([record]) for record in records]
        if all(each is not None and each.repeats_command and each.tells_period for each in laws):
            return CommandTiming(TimingSource.LAW, step_s, step_s)
        # It may have changed all the time, and the log may hold its mean over a step, or the output may have
        # been read later in the step than the command: delays of up to a step, which a hold does not have.
        delays = (HELD, Hold(0.0), Hold(0.0, averaged=True))
        return CommandTiming(TimingSource.UNKNOWN, step_s, None, possible=delays, middle=Hold(0.0))
    if law.tells_period:
        return CommandTiming(TimingSource.LAW, step_s, step_s, law=law)
    # Held from row to row, or changed all the time; the middle is half of both: two commands in a step.
    possible = (HELD, Hold(0.0))
    return CommandTiming(TimingSource.UNKNOWN, step_s, None, possible=possible, middle=Hold(0.5), law=law)


def rows_per_command_of(records: Sequence[Record]) -> int:
    """Number of rows after which the command of records changes while the output goes on.

    Parameters
    ----------
    records : sequence of Record
        As logged, of one sampling time. Those whose command hardly changes tell nothing.

    Returns
    -------
    int
        1 where it changes from row to row, or where the changes do not keep to one phase: rows were lost, or
        two clocks drift apart. Held from row to row is then what the rows say. 1 also without records, and
        where all commands stand still.
    """
    gaps = _usual_gaps(records)
    smallest_gap = min(gaps, default=1)
    for record in records:
        changes = _changes(record)
        if not changes.size:
            continue
        is_in_phase = changes % smallest_gap == _phase(changes, smallest_gap)
        if np.mean(is_in_phase) <= NEARLY_ALL:
            return 1
    return smallest_gap


def _usual_gaps(records: Sequence[Record]) -> list[int]:
    """Usual number of rows between changes of the command, of each record where it changes often.

    1 where the gaps are no multiples of one number. Records with fewer than `FEWEST_GAPS` gaps are left out,
    so that the list may be empty.
    """
    usual_gaps = []
    for record in records:
        gaps = np.diff(_changes(record))
        if gaps.size < FEWEST_GAPS:
            continue
        usual = int(np.median(gaps))
        is_multiple = gaps % usual == 0
        if np.mean(is_multiple) <= NEARLY_ALL:
            usual = 1
        usual_gaps.append(usual)
    return usual_gaps


def _changes(record: Record) -> IntArray:
    """Indices (N,) of the rows whose command is another than that of the row before; empty where it stands
    still."""
    is_new = np.any(np.diff(record.input, axis=0) != 0, axis=1)
    return 1 + np.flatnonzero(is_new)


def _phase(changes: IntArray, rows: int) -> int:
    """Index 0 .. rows - 1 at which a command that stands for `rows` rows usually changes.

    `changes` (N,) : indices of the rows at which it changed; 0 where it never did. `rows` is at least 1.
    """
    return int(np.bincount(changes % rows, minlength=rows).argmax())


def _with_rows(timing: CommandTiming, records: Sequence[Record], rows: int) -> CommandTiming:
    """Timing with the rows that are used and with their law, of a command that stands for `rows` rows, at
    least 1.

    The law is None where the rows that are used show none that repeats the command.
    """
    first = tuple(_phase(_changes(record), rows) for record in records)
    used = [_every(record, start, rows) for record, start in zip(records, first, strict=True)]
    law = law_of(used)
    if law is not None and not law.repeats_command:
        law = None
    return replace(timing, rows_per_command=rows, first_row=first, law=law)


def _every(record: Record, start: int, rows: int) -> Record:
    """Record of every `rows`-th row, from the row `start` on, with `rows` times the step.

    Raises ValueError (`Record`) where there is no row from `start` on.
    """
    thinned = record.each(lambda signal: signal[start::rows])
    return replace(thinned, dt_s=record.dt_s * rows)


def _refuse_contradiction(record: Record, period_s: float, usual_gap: int) -> None:
    """Raise ValueError where the log shows that the stated period is not that of its controller.

    The period is no whole part of the log's step though it is shorter than half of it, or it is longer than
    `usual_gap` rows, after which the command usually changes. `period_s` above zero is not checked.
    """
    step_s = record.dt_s
    option = "controller_period_s, --controller-period"
    commands_per_step = step_s / period_s
    off_whole = abs(commands_per_step - round(commands_per_step))
    if commands_per_step > MOST_UNCHECKED and off_whole > SAME_PERIOD * commands_per_step:
        nearest_s = step_s / round(commands_per_step)
        raise ValueError(
            f"{record.label}: a controller every {period_s:.6g} s does not meet the rows every "
            f"{step_s:.6g} s: expected a whole part of the log's step, such as {nearest_s:.6g} ({option})"
        )
    longest_s = usual_gap * step_s
    if period_s > longest_s * (1 + SAME_PERIOD):
        raise ValueError(
            f"{record.label}: the command changes every {longest_s:.6g} s, more often than a controller "
            f"every {period_s:.6g} s could: expected at most {longest_s:.6g} ({option})"
        )


def _refuse_law_at_rows(record: Record, period_s: float, used_step_s: float, law: RecordedLaw | None) -> None:
    """Raise ValueError where the rows show the law that made them, and a faster one would have left more.

    `used_step_s` : step of the rows of which the law was read, s; `period_s` : the stated, shorter one.
    Without a law, or with one that does not tell its period, nothing is raised.
    """
    if law is not None and law.tells_period:
        raise ValueError(
            f"{record.label}: a linear law makes every command from rows {used_step_s:.6g} s apart, which no "
            f"controller every {period_s:.6g} s would: expected {used_step_s:.6g} (controller_period_s, "
            "--controller-period)"
        )


def with_equivalent_command(records: Sequence[Record], timing: CommandTiming) -> list[Record]:
    """Records with a command that, held from row to row, moves the arm as the one that was logged did.

    Parameters
    ----------
    records : sequence of Record
        As logged, of the sampling time of the timing (not checked). The list begins with the records that
        `timing_of` was given, in their order; further ones, as of a validation, may follow.
    timing : CommandTiming
        What the command does: rows to use, and the hold to correct for.

    Returns
    -------
    list of Record
        With the rows at which the command changes, where it stands for several; filtered with 1 / S (module's
        docstring) where the controller was faster than the log. Where the timing is not known, the first
        record alone gets a note CONTROLLER_PERIOD: the step of the rows, whether a law repeats the command,
        and whether there is a reference.

    Raises
    ------
    ValueError
        A record has no row from its first used one on (`Record`). IndexError without records, where the
        timing is not known.
    """
    changed = []
    for index, record in enumerate(records):
        if timing.rows_per_command > 1:
            if index < len(timing.first_row):
                start = timing.first_row[index]
            else:
                # A record that the timing has not seen, as of a validation, has a phase of its own.
                start = _phase(_changes(record), timing.rows_per_command)
            record = _every(record, start, timing.rows_per_command)
        if timing.taken != HELD:
            record = replace(record, input=filtered(record.input, timing.taken))
        changed.append(record)
    if not timing.known:
        note = finding(
            FindingKind.CONTROLLER_PERIOD,
            step_s=timing.row_step_s,
            repeats=timing.law is not None,
            reference=records[0].reference is not None,
        )
        changed[0] = replace(changed[0], notes=(*changed[0].notes, note))
    return changed


def filtered(command: RealArray, hold: Hold) -> RealArray:
    """Commands (T, U) filtered with the response 1 / S of a hold, which looks forwards and backwards in time.

    `command` (T, U) : as logged; its first and last values are repeated before and after. At least one row;
    nan would spread to `ROWS_BESIDE` rows around it. (T, U) comes out.
    """
    angle = np.linspace(0.0, FITTED_UP_TO_RAD, FILTER_POINTS)[1:]
    lags = np.arange(-ROWS_BESIDE, ROWS_BESIDE + 1)
    # Where the motion is large, at low frequency, the filter has to be exact; a constant stays one.
    rows = np.exp(1j * np.outer(angle, lags)) - 1
    wanted = hold.response(angle) - 1
    taps = coefficients_of(rows, wanted[:, None], 1 / angle)[:, 0]
    sum_beside = taps.sum() - taps[ROWS_BESIDE]
    taps[ROWS_BESIDE] = 1 - sum_beside
    padded = np.pad(command, ((ROWS_BESIDE, ROWS_BESIDE), (0, 0)), mode="edge")
    columns = [np.convolve(column, taps[::-1], mode="valid") for column in padded.T]
    return np.column_stack(columns)


def with_unknown_timing(posterior: ResponsePosterior, timing: CommandTiming) -> ResponsePosterior:
    """Posterior with ellipses that hold the response whatever the command did between two rows.

    Parameters
    ----------
    posterior : ResponsePosterior
        Of records whose command was taken as held from row to row: mean (P,) and covariance factor (P, P') of
        coefficients (poles, taps, unstable poles last), dt_s.
    timing : CommandTiming
        Its `possible` holds and their `middle`.

    Returns
    -------
    ResponsePosterior
        About the response of `timing.middle`, with two more directions of its covariance, along the phase and
        along the gain. Each is as wide as the largest difference between the middle and what is possible,
        times `BEYOND_ENDS`. The posterior itself where the timing is known, or where its mean is zero. That
        the timing is of the posterior's records is not checked.

    Notes
    -----
    What is possible has the response S times the one that was identified, to first order in what its rows do
    not show. S and the differences are fitted by the basis functions and a few taps, relative to the
    response, up to the Nyquist frequency of the rows. The filter stands behind the identification, not
    before it: dry friction is told from a command that leads the motion, and a filtered one may come too
    early.
    """
    if timing.known or not np.any(posterior.mean):
        return posterior

    # Slow motions, and points between which no tap of the kernel turns round.
    slow = slow_angles(posterior.poles, HIGHEST_ANGLE_RAD)
    n_even = EVEN_POINTS_PER_TAP * (posterior.fir_length + TAPS) + EVEN_POINTS
    even = np.linspace(0.0, HIGHEST_ANGLE_RAD, n_even)[1:]
    angle = np.union1d(slow, even)
    omega = angle / posterior.dt_s

    # S of the middle, and the largest differences of what is possible from it along phase and gain, (F,).
    middle = 1 / timing.middle.response(angle)
    ratios = [1 / hold.response(angle) / middle for hold in timing.possible]
    phase = np.max([np.abs(ratio.imag) for ratio in ratios], axis=0)
    gain = np.max([np.abs(ratio.real - 1) for ratio in ratios], axis=0)
    # The basis follows S to a twentieth of the phase, in both directions.
    gain = np.maximum(gain, GAIN_OF_PHASE * phase)

    # Taps stand behind the basis and before what unstable poles add, which stays as it is.
    n_stable = posterior.mean.size - posterior.unstable.order
    n_added = max(TAPS - posterior.fir_length, 0)
    n_fitted = n_stable + n_added
    wider = replace(
        posterior,
        mean=np.insert(posterior.mean, [n_stable] * n_added, 0.0),
        covariance_factor=np.insert(posterior.covariance_factor, [n_stable] * n_added, 0.0, axis=0),
        fir_length=posterior.fir_length + n_added,
    )
    rows = wider.frequency_rows(omega)[:, :n_fitted]
    centre = posterior.centre(omega)
    # A response may be zero somewhere, where no share of it is an error.
    size = np.maximum(np.abs(centre), SMALLEST_RESPONSE * np.max(np.abs(centre)))

    # Errors count as a share of what they are held against, and less above the data: the fourth power,
    # chosen, leaves a twentieth of the weight at twice the frequency.
    count = 1 / (1 + (angle / FITTED_UP_TO_RAD) ** 4)
    through_middle = middle[:, None] * rows
    mean_response = through_middle @ wider.mean[:n_fitted, None]
    factor_response = through_middle @ wider.covariance_factor[:n_fitted]
    mean = coefficients_of(rows, mean_response, count / (phase * size))
    factor = coefficients_of(rows, factor_response, count / size)
    # A column of the factor is one standard deviation: the ellipse of the level is chi2_radius of them.
    end = BEYOND_ENDS / chi2_radius(LEVEL) * middle * centre
    along_phase = coefficients_of(rows, (1j * phase * end)[:, None], count / (phase * size))
    along_gain = coefficients_of(rows, (gain * end)[:, None], count / (gain * size))
    widening = np.hstack([along_phase, along_gain])
    nothing = np.zeros((posterior.unstable.order, 2))
    known_columns = np.vstack([factor, posterior.covariance_factor[n_stable:]])
    added_columns = np.vstack([widening, nothing])
    return replace(
        wider,
        mean=np.append(mean[:, 0], posterior.mean[n_stable:]),
        covariance_factor=np.hstack([known_columns, added_columns]),
    )
