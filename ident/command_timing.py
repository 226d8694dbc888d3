"""What the command of a log does between two rows, and what that makes of the records and of the ellipses.

A model of records takes the command as held from row to row. A drive that controls faster than it logs holds
its command for its own period Tc and logs every T / Tc-th value; with w the frequency, such a command moves
the arm as

    H(Tc) / H(T) = 1 / S(w),    S(w) = (1 - e^{-jwT}) / (N (1 - e^{-jwTc})),   N = T / Tc,

times the logged command held for T would (H(h) = (1 - e^{-jwh}) / (jwh): zero-order hold; S is the mean over
the N commands of a step). The logged command is filtered with 1 / S, and everything after it may take it as
held from row to row. A drive that logs the mean of the N commands adds a second factor 1 / S.

Neglected: what the command has above the Nyquist frequency of the log, which the rows do not show.
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
from ident.response_coefficients import coefficients_of

# Rows before and after one that its equivalent command is made of. With four on each side the filter is
# within .1 % of 1 / S up to 1 rad of w T, and within .5 % up to half the Nyquist frequency.
ROWS_BESIDE = 4
# Highest frequency times step up to which the filter is fitted, rad: above it most logs hold noise alone.
FITTED_UP_TO_RAD = 2.0
# Highest frequency times step at which an ellipse is fitted, rad: the Nyquist frequency but for rounding.
HIGHEST_ANGLE_RAD = 3.14
# Taps by which an ellipse follows a phase that grows with frequency.
TAPS = 8
# Ellipses of noise and timing add as variances, but an interval of the timing has ends that are as likely as
# its middle: with 1.5 times its half width the sum of both is held while the noise is up to .6 of it.
BEYOND_ENDS = 1.5
# Share of its largest value below which a response counts as zero: rounding of doubles. That of an arm which
# integrates falls by ten decades between its slowest motion and the Nyquist frequency.
SMALLEST_RESPONSE = 1e-14
# Ellipses are at least so wide along the gain, as a share of their width along the phase: twice the error
# with which the basis follows a fraction of a step.
GAIN_OF_PHASE = 0.1
# Of the gaps between changes of a command that repeats, this share is a multiple of its period, and of the
# changes this share keeps to one phase: the rest are commands that happen to stay.
NEARLY_ALL = 0.99
# Gaps between changes of a command from which its period is read.
FEWEST_GAPS = 10
# A stated period agrees with whole rows within this share.
SAME_PERIOD = 1e-3


class TimingSource(Enum):
    """How the period of the controller is known."""

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
        """1 / S, or its square where averaged, at w T (F,), 0 < w T <= pi."""
        step = -np.expm1(-1j * angle_rad)
        if self.share > 0:
            mean = self.share * step / -np.expm1(-1j * angle_rad * self.share)
        else:
            mean = step / (1j * angle_rad)
        return np.asarray(mean ** (-2 if self.averaged else -1), dtype=np.complex128)


# A command that is held from row to row.
HELD = Hold(1.0)


@dataclass(frozen=True)
class CommandTiming:
    """What the command does between two rows, as far as it is known.

    Attributes
    ----------
    source : TimingSource
    row_step_s : float
        Step of the rows, s.
    period_s : float or None
        Period of the controller that made the log, s; None: not known.
    taken : Hold
        What the records are corrected for.
    possible : tuple of Hold
        What the ellipses have to hold; empty where the period is known.
    middle : Hold
        Of what is possible: what the ellipses are about.
    rows_per_command : int
        Rows that were logged for each command; above 1 only the rows at which it changes are used.
    first_row : tuple of int
        First of these rows, per record.
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
        return not self.possible

    @property
    def offered_dt_s(self) -> float:
        """The known period, s, where a new controller may have it; else the step of the rows in use."""
        used_step_s = self.row_step_s * self.rows_per_command
        if self.period_s is None:
            return used_step_s
        parts = used_step_s / self.period_s
        return self.period_s if abs(parts - round(parts)) <= SAME_PERIOD * parts else used_step_s

    @property
    def acts_at_once(self) -> bool:
        """The rows tell that the command of a row was made of the output of the same row."""
        return self.law is not None and self.law.tells_period and self.law.acts_at_once


def timing_of(
    records: Sequence[Record],
    *,
    in_loop: bool,
    stated_period_s: float | None = None,
    averaged: bool = False,
) -> CommandTiming:
    """What the command of SISO records does between two rows.

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

    Raises
    ------
    ValueError
        The log contradicts the stated period, or the mean of commands was logged in open loop and their
        period is not stated.
    """
    step_s = records[0].dt_s
    rows_per_command = rows_per_command_of(records)
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
    if not in_loop:
        if averaged:
            raise ValueError(
                f"{records[0].label}: a mean of commands over {step_s:.6g} s needs the period of each: add "
                "--controller-period SECONDS (controller_period_s)"
            )
        return CommandTiming(TimingSource.OPEN_LOOP, step_s, None)
    if rows_per_command > 1:
        found = CommandTiming(TimingSource.REPEATS, step_s, rows_per_command * step_s)
        of_controller = _with_rows(found, records, rows_per_command)
        # Without a law it may be an experiment in open loop that was taken for a loop: then every row counts,
        # and held from row to row is what the rows say.
        return found if of_controller.law is None else of_controller

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
    possible = (HELD, Hold(0.0))
    return CommandTiming(TimingSource.UNKNOWN, step_s, None, possible=possible, middle=Hold(0.5), law=law)


def rows_per_command_of(records: Sequence[Record]) -> int:
    """Rows after which the command of records changes while the output goes on.

    Parameters
    ----------
    records : sequence of Record
        As logged, of one sampling time. Those whose command hardly changes tell nothing.

    Returns
    -------
    int
        1 where it changes from row to row, or where the changes do not keep to one phase: rows were lost, or
        two clocks drift apart. Held from row to row is then what the rows say.
    """
    gaps = _usual_gaps(records)
    least = min(gaps, default=1)
    for record in records:
        changes = _changes(record)
        if changes.size and np.mean(changes % least == _phase(changes, least)) <= NEARLY_ALL:
            return 1
    return least


def _usual_gaps(records: Sequence[Record]) -> list[int]:
    """Rows after which the command changes, of each record where it changes often; 1 where gaps differ."""
    usual_gaps = []
    for record in records:
        gaps = np.diff(_changes(record))
        if gaps.size < FEWEST_GAPS:
            continue
        usual = int(np.median(gaps))
        if np.mean(gaps % usual == 0) <= NEARLY_ALL:
            usual = 1
        usual_gaps.append(usual)
    return usual_gaps


def _changes(record: Record) -> IntArray:
    """Rows (N,) whose command is another than that of the row before."""
    return 1 + np.flatnonzero(np.any(np.diff(record.input, axis=0) != 0, axis=1))


def _phase(changes: IntArray, rows: int) -> int:
    """First row of a record, of `rows`, at which its command usually changes."""
    return int(np.bincount(changes % rows, minlength=rows).argmax())


def _with_rows(timing: CommandTiming, records: Sequence[Record], rows: int) -> CommandTiming:
    """The timing with the rows that are used, of which the command stands for so many, and with their law."""
    first = tuple(_phase(_changes(record), rows) for record in records)
    used = [_every(record, start, rows) for record, start in zip(records, first, strict=True)]
    law = law_of(used)
    if law is not None and not law.repeats_command:
        law = None
    return replace(timing, rows_per_command=rows, first_row=first, law=law)


def _every(record: Record, start: int, rows: int) -> Record:
    thinned = record.each(lambda signal: signal[start::rows])
    return replace(thinned, dt_s=record.dt_s * rows)


def _refuse_contradiction(record: Record, period_s: float, usual_gap: int) -> None:
    """Raise ValueError where the log shows that the stated period is not that of its controller."""
    step_s = record.dt_s
    option = "controller_period_s, --controller-period"
    share = step_s / period_s
    if share > 2 and abs(share - round(share)) > SAME_PERIOD * share:
        raise ValueError(
            f"{record.label}: a controller every {period_s:.6g} s does not meet the rows every "
            f"{step_s:.6g} s: expected a whole part of the log's step, such as "
            f"{step_s / round(share):.6g} ({option})"
        )
    longest = usual_gap * step_s
    if period_s > longest * (1 + SAME_PERIOD):
        raise ValueError(
            f"{record.label}: the command changes every {longest:.6g} s, more often than a controller every "
            f"{period_s:.6g} s could: expected at most {longest:.6g} ({option})"
        )


def _refuse_law_at_rows(record: Record, period_s: float, used_step_s: float, law: RecordedLaw | None) -> None:
    """Raise ValueError where the rows show the law that made them, and a faster one would have left more."""
    if law is not None and law.tells_period:
        raise ValueError(
            f"{record.label}: a linear law makes every command from rows {used_step_s:.6g} s apart, which no "
            f"controller every {period_s:.6g} s would: expected {used_step_s:.6g} (controller_period_s, "
            "--controller-period)"
        )


def with_equivalent_command(records: Sequence[Record], timing: CommandTiming) -> list[Record]:
    """The records with a command that, held from row to row, moves the arm as the one that was logged did.

    Parameters
    ----------
    records : sequence of Record
        As logged, of the sampling time of the timing; those that `timing_of` saw first.
    timing : CommandTiming

    Returns
    -------
    list of Record
        With the rows at which the command changes, where it stands for several; filtered with 1 / S
        (module's docstring) where the controller was faster than the log. A note says what is not known.
    """
    changed = []
    for place, record in enumerate(records):
        if timing.rows_per_command > 1:
            start = timing.first_row[place] if place < len(timing.first_row) else 0
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
    """Commands (T, U) filtered with 1 / S forwards and backwards in time; the ends are repeated."""
    angle = np.linspace(0.0, FITTED_UP_TO_RAD, 400)[1:]
    lags = np.arange(-ROWS_BESIDE, ROWS_BESIDE + 1)
    # Where the motion is large, at low frequency, the filter has to be exact; a constant stays one.
    rows = np.exp(1j * np.outer(angle, lags)) - 1
    taps = coefficients_of(rows, (hold.response(angle) - 1)[:, None], 1 / angle)[:, 0]
    taps[ROWS_BESIDE] = 1 - (taps.sum() - taps[ROWS_BESIDE])
    padded = np.pad(command, ((ROWS_BESIDE, ROWS_BESIDE), (0, 0)), mode="edge")
    columns = [np.convolve(column, taps[::-1], mode="valid") for column in padded.T]
    return np.column_stack(columns)


def with_unknown_timing(posterior: ResponsePosterior, timing: CommandTiming) -> ResponsePosterior:
    """The posterior with ellipses that hold the response whatever the command did between two rows.

    Parameters
    ----------
    posterior : ResponsePosterior
        Of records whose command was taken as held from row to row.
    timing : CommandTiming

    Returns
    -------
    ResponsePosterior
        About the response of `timing.middle`, with two more directions of its covariance, along the phase and
        along the gain. Each is as wide as the largest difference between the middle and what is possible,
        times `BEYOND_ENDS`. The posterior itself where the timing is known.

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
    n_linear = 4 * (posterior.fir_length + TAPS) + 200
    angle = np.union1d(
        np.geomspace(1e-5, HIGHEST_ANGLE_RAD, 500), np.linspace(0.0, HIGHEST_ANGLE_RAD, n_linear)[1:]
    )
    omega = angle / posterior.dt_s
    middle = 1 / timing.middle.response(angle)
    ratios = [1 / hold.response(angle) / middle for hold in timing.possible]
    phase = np.max([np.abs(ratio.imag) for ratio in ratios], axis=0)
    gain = np.max([np.abs(ratio.real - 1) for ratio in ratios], axis=0)
    # The basis follows S to a twentieth of the phase, in both directions.
    gain = np.maximum(gain, GAIN_OF_PHASE * phase)

    # Taps stand behind the basis and before what unstable poles add, which stays as it is.
    n_stable = posterior.mean.size - posterior.unstable.order
    more = max(TAPS - posterior.fir_length, 0)
    wider = replace(
        posterior,
        mean=np.insert(posterior.mean, [n_stable] * more, 0.0),
        covariance_factor=np.insert(posterior.covariance_factor, [n_stable] * more, 0.0, axis=0),
        fir_length=posterior.fir_length + more,
    )
    rows = wider.frequency_rows(omega)[:, : n_stable + more]
    centre = posterior.centre(omega)
    # A response may be zero somewhere, where no share of it is an error.
    size = np.maximum(np.abs(centre), SMALLEST_RESPONSE * np.max(np.abs(centre)))

    # Errors count as a share of what they are held against, and less above the data.
    above = 1 / (1 + (angle / FITTED_UP_TO_RAD) ** 4)
    late = middle[:, None] * rows
    mean = coefficients_of(rows, late @ wider.mean[: n_stable + more, None], above / (phase * size))
    factor = coefficients_of(rows, late @ wider.covariance_factor[: n_stable + more], above / size)
    ends = BEYOND_ENDS / chi2_radius(LEVEL) * middle * centre
    along_phase = coefficients_of(rows, (1j * phase * ends)[:, None], above / (phase * size))
    along_gain = coefficients_of(rows, (gain * ends)[:, None], above / (gain * size))
    nothing = np.zeros((posterior.unstable.order, 2))
    return replace(
        wider,
        mean=np.append(mean[:, 0], posterior.mean[n_stable:]),
        covariance_factor=np.hstack(
            [
                np.vstack([factor, posterior.covariance_factor[n_stable:]]),
                np.vstack([np.hstack([along_phase, along_gain]), nothing]),
            ]
        ),
    )
