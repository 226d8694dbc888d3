"""Dry friction and the arm behind it from logs of a loop: any start, and arms that drift.

An observer follows the log (`ident.friction.observer`), for a free run would drift. The friction f of this
motion is known then, and

    y = G (u - f - bias) + v

is linear in the arm with the recorded input. The observer whitens v (the direct method, Ljung, System
Identification, 2nd ed., section 13.4: no bias in a loop if the noise model is right). Arm and friction in
turns, first with the fewest poles, until neither moves.

Neglected: a level that depends on position or load; what the sensor's noise does to the friction itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.stats import chi2

from ident.basis.functions import nuisance_columns, regressor
from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.basis.structure import answered, driving_input, stabilised
from ident.checks.early_checks import refuse_few_lines
from ident.checks.plausible_modes import LARGEST_DAMPING
from ident.checks.validation import fit_in_windows
from ident.coloured_noise import long_arx_filter, prewhitened
from ident.data.arrays import RealArray
from ident.data.distortion import period_of
from ident.data.finding import FindingKind, finding
from ident.data.record import Record
from ident.fit.least_squares import fit as linear_fit
from ident.fit.regression import prepare
from ident.friction.arm import FrictionLaw
from ident.friction.gauss_newton import (
    LENGTHS,
    STD_LOG,
    FrictionFit,
    LostError,
    driven_by_law,
    law_of,
    least_squares,
    parameters_of,
    started,
    with_covariance,
)
from ident.friction.inverse_dynamics import (
    highest_Hz,
    presliding_of,
    rms_speed,
    speed_classes,
    with_measured_direction,
)
from ident.friction.observer import NEARBY, ObserverFilter, observed, prediction_errors
from ident.friction.spring import Spring
from ident.identification import Identification
from ident.one_input import identify, untested_model
from ident.response_uncertainty import NOISE_ORDERS
from ident.search.order_selection import Progress
from ident.search.pole_search import PoleSearch
from ident.uncertainty.autoregression import fit_autoregression
from ident.uncertainty.embedding_algebra import RANK, by_class, sandwiched
from ident.uncertainty.pole_intervals import laurent_rows
from ident.unstable import find_unstable

# Rounds of friction and poles in turns, at most. Chosen; they end where nothing moves.
ROUNDS = 6
# Rounds where delays are compared. Chosen: fewer, for many delays are tried.
_FEW_ROUNDS = 2
# Longest dead time of a drive that is tried, in samples. Chosen.
_LONGEST_DELAY = 20
# A level that moves by less than this share in a round stays. Chosen.
_STAYS = 5e-3
# One that moves by more leaves poles in doubt, and they are searched for anew. Chosen.
_MOVES = 0.05
# So do prediction errors that fall to this share in a round: a belt's start had 1.6 times its friction, one
# step mended the arm and not the level, and another structure won (docs/decisions.md).
_FALLS_TO = 0.5
# Lags of the position by which a command is tested to follow it. Chosen.
_CAUSES = 8
# Residual, as a share of the command's deviation, that counts as rounding. Chosen: five digits.
_ROUNDING = 1e-5
# Probability of the tests below which chance is ruled out: one log in a million is taken for a loop, or its
# free run for a wrong one. At one in a hundred good free runs were given up.
BY_CHANCE = 1e-6
# Levels of a binary or staircase command, at most. Chosen.
_FEW_LEVELS = 16
# Largest step of the level, as a share of it: the inverse dynamics that it begins with are right to a third.
_LARGEST_STEP = 0.3
# The same in units of the smallest level, so that a level of nearly nothing can grow. Chosen.
_LARGEST_STEP_OF_LEAST = 10
# Largest step of logarithms (a factor of e) and of the drive's lag (a sample): the linearised law holds no
# further.
_LARGEST_LOG_STEP = 1
# Factors by which the friction as a whole is tried larger and smaller, coarse ones first. Chosen.
_SIZES = (1.1, 1 / 1.1, 1.02, 1 / 1.02)
# How dead time and lag of the drive are changed, samples each: later, a lag in place of dead time, a first
# lag, dead time in place of a lag.
_SHIFTS = ((1, 0.0), (-1, 1.0), (0, 0.5), (1, -1.0))
# Lowest further pair, as a share of the first mode: friction that is left over looks like slow poles. Chosen.
_LOWEST_PAIR = 0.4
# Highest pair, in units of the frequency up to which the position is above its noise. Chosen: a mode at its
# very end still has poles.
_ABOVE_NOISE = 1.2
# Speeds of Stribeck friction that are begun with, in units of the rms speed. Chosen, factors of three.
_FALLS = (0.03, 0.1, 0.3)
# Its excess at the start, as a share of the level. Chosen.
_EXCESS = 0.1
# Share of the level that begins at the load, where a spring shows. Chosen: nothing says which has more.
_SHARE_AT_LOAD = 0.5
# Steps of a new shape of friction before the arm is fitted anew. Chosen; they end where errors fall no more.
_STEPS = 6
# Errors of the fewest poles, as a multiple of the other structure's, above which a structure is given up. An
# arm that a weight throws over was right at 1.02 of an integrator's, and ended at .79 of them.
_WORSE_AT_FIRST = 1.5
# What a pole or a parameter costs, in log n. Chosen: twice the Bayesian criterion's, so that only clear gains
# count.
_COST = 2
# Change of the bias from which the mean error's slope is taken, as a share of the rms command. Chosen: the
# error is linear in it.
_BIAS_STEP = 5e-3
# Largest move of a pole, as a share of its distance from the unit circle: it stays inside.
_LARGEST_POLE_MOVE = 0.5
# Part (one in so many) of a record behind which errors count for the bias: the observer has found its state.
_START = 20


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
    for late in range(1, 2 * _LONGEST_DELAY + 1):
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
    return bool(rows.size * np.log(ratio) > _COST * np.log(rows.size))


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


@dataclass(frozen=True, eq=False)
class _Logs:
    """Records without their references, and the scales of what is fitted to them.

    presliding: expected deflection, units of the position; least_level: smallest level, input_rms: both units
    of the input; centre: mean of the positions.
    """

    records: tuple[Record, ...]
    presliding: float
    least_level: float
    input_rms: float
    centre: float

    @classmethod
    def of(cls, records: Sequence[Record]) -> _Logs:
        """Logs of records with one input, and the shaft's position as the one output."""
        input_rms = float(np.sqrt(np.mean([np.mean(record.input**2) for record in records])))
        plain = tuple(replace(record, reference=None, reference_names=()) for record in records)
        centre = float(np.mean([np.mean(record.output) for record in records]))
        # A level of a millionth is none: only logarithms and shares of it need a number.
        return cls(plain, presliding_of(records), 1e-6 * input_rms, input_rms, centre)

    def errors(self, fit: FrictionFit) -> float:
        """Sum of squares of a fit's prediction errors, output units squared; inf where it is lost."""
        return prediction_errors(fit, self.records)

    def worth(self, fit: FrictionFit) -> float:
        """Errors of a fit, larger by what its poles and parameters of the friction cost; least is best."""
        n = sum(record.n_samples for record in self.records)
        n_parameters = fit.model.order
        if np.isfinite(fit.law.fall):
            n_parameters += 2
        if fit.spring is not None:
            n_parameters += 1
        if fit.lag > 0:
            n_parameters += 1
        return self.errors(fit) * float(1 + n_parameters * _COST * np.log(n) / n)


def fit_friction_in_loop(
    records: Sequence[Record], options: IdentOptions, *, progress: Progress | None = None
) -> FrictionFit:
    """Law of the friction and the arm behind it from logs of a loop.

    Parameters
    ----------
    records : sequence of Record
        One input, and the position of the shaft that the friction acts on; from any start.
    options : IdentOptions
        Of the search for the arm's poles; a delay that is not stated is sought, and so are integrators.
    progress : callable, optional
        Called with a share of the work (0 to 1) and a message.

    Returns
    -------
    FrictionFit
        With an observer. What parts of the logs differ in widens all widths; what speeds differ in, those
        that it moves.

    Raises
    ------
    ValueError
        As `identify`, or the logs excite few frequencies. `LostError`, a ValueError, where no observer
        follows them.
    """
    report = progress or (lambda fraction, message: None)
    refuse_few_lines(records)
    logs = _Logs.of(records)

    # Each structure with the fewest poles; those that are far behind are not completed.
    report(0.0, "friction: level and a simple arm in turns")
    starts = _of_structure(logs, _above_noise(logs.records, options))
    best_worth = min(logs.worth(fit) for _, fit in starts)
    starts = [start for start in starts if logs.worth(start[1]) <= _WORSE_AT_FIRST * best_worth]

    def report_part(place: int, share: float, message: str) -> None:
        """Report a share of the work on one of the structures as one of the whole."""
        report((place + share) / len(starts), message)

    ends = []
    for place, (structure_options, start) in enumerate(starts):
        with suppress(LostError):
            ends.append(_completed(logs, structure_options, start, partial(report_part, place)))
    if not ends:
        raise LostError
    fit = min(ends, key=logs.worth)

    # Widths: by what parts of the logs differ in, then by what speeds differ in.
    whiten = ObserverFilter.of(fit)
    wider_factor = np.sqrt(heterogeneity(fit, logs.records, whiten)) * fit.covariance_factor
    blocks, targets = _equations(fit, logs.records, whiten)
    solution = least_squares(blocks, targets, np.zeros((0, blocks[0].shape[1] + 1)))
    record_scores = []
    for record, block, target in zip(logs.records, blocks, targets, strict=True):
        residual = target - block @ solution.change
        record_scores.append(by_class(residual, speed_classes(record)).T @ block)
    n_rows = sum(target.size for target in targets)
    scores = sum(record_scores) @ fit.covariance_factor * n_rows / solution.residual_rss
    return replace(fit, covariance_factor=sandwiched(wider_factor, scores))


def _completed(logs: _Logs, options: IdentOptions, fit: FrictionFit, report: Progress) -> FrictionFit:
    """A whole fit from that with the fewest poles: dead time and lag of the drive, the law of the friction,
    as many poles as the data ask for.

    Raises LostError where no observer follows.
    """
    left_open = options.delay_left_to_data
    report(0.2, "friction: dead time, lag of the drive, law")
    shifted = _with_shift(logs, fit, options, left_open=left_open)
    simple = _with_law(logs, shifted, options)
    if simple.spring is None:
        # A shift may have taken the place of a spring: look for one without it, too.
        simple = min(simple, _with_law(logs, fit, options), key=logs.worth)
    if simple is not shifted:
        simple = _with_shift(logs, simple, options, left_open=left_open)

    # As many poles as the data ask for, where they are worth it.
    delay = {"input_delay_samples": simple.arm.structure.input_delay_samples}
    with suppress(LostError):
        all_poles = _without_slow_pairs(simple, options.model_copy(update=delay))
        simple = min(simple, _in_turns(logs, simple, all_poles), key=logs.worth)
    return _with_law(logs, simple, options)


def _with_shift(logs: _Logs, fit: FrictionFit, options: IdentOptions, *, left_open: bool) -> FrictionFit:
    """A fit with the dead time and the lag of the drive, in place of a part of it, that predict best.

    The dead time changes only where it is left open. A change that helps is tried once more; the search ends
    when all of them have failed in a row.
    """
    seen = {(fit.arm.structure.input_delay_samples, round(2 * fit.lag))}
    moves = deque(_SHIFTS)
    n_failed = 0
    while n_failed < len(moves):
        later, slower = moves[0]
        delay = fit.arm.structure.input_delay_samples + later
        lag = max(fit.lag + slower, 0.0)
        place = (delay, round(2 * lag))
        may_shift = later == 0 or (left_open and 0 <= delay <= _LONGEST_DELAY)
        candidate = fit
        if place not in seen and may_shift:
            structure = replace(fit.arm.structure, input_delay_samples=delay)
            candidate = replace(fit, arm=replace(fit.arm, structure=structure), lag=lag)
            with suppress(LostError):
                candidate = _in_turns(logs, candidate, _of_order(fit, options, delay), _FEW_ROUNDS)
        seen.add(place)
        if logs.worth(candidate) < logs.worth(fit):
            fit = candidate
            n_failed = 0
        else:
            moves.rotate(-1)
            n_failed += 1
    return min(fit, _in_turns(logs, fit, _of_order(fit, options)), key=logs.errors)


def _of_order(fit: FrictionFit, options: IdentOptions, delay: int | None = None) -> IdentOptions:
    """Options that state the structure and the number of poles of a fit, and its dead time or another one.

    `delay` is in samples.
    """
    structure = fit.arm.structure
    options = options.model_copy(update={"integrators": structure.integrators})
    if structure.unstable.order:
        options = options.with_unstable(structure.unstable)
    # Poles that come with integrators and unstable poles are not searched for.
    n_real, n_pairs = fit.model.poles.counts
    n_fixed_real, n_fixed_pairs = options.fixed().counts
    stated = {
        "n_real": n_real - n_fixed_real,
        "n_pairs": n_pairs - n_fixed_pairs,
        "input_delay_samples": structure.input_delay_samples if delay is None else delay,
    }
    return options.model_copy(update=stated)


def _with_law(logs: _Logs, fit: FrictionFit, options: IdentOptions) -> FrictionFit:
    """A fit with friction at the load, behind the first spring, and with friction that falls with speed, each
    where that is worth it."""
    if not fit.significant:
        return fit
    spring = Spring.of(fit.model)
    if spring is not None and fit.spring is None:
        at_load = _SHARE_AT_LOAD * fit.law.level
        law = replace(fit.law, level=fit.law.level - at_load)
        start = replace(fit, spring=spring, beyond=at_load, law=law)
        fit = _kept_if_better(logs, fit, [start], _of_order(fit, options))
    if not np.isfinite(fit.law.fall):
        speed = rms_speed(logs.records)
        level = fit.law.level
        excess = _EXCESS * level
        starts = []
        for fall in _FALLS:
            law = replace(fit.law, level=level - excess, excess=excess, fall=fall * speed)
            starts.append(replace(fit, law=law))
        fit = _kept_if_better(logs, fit, starts, _of_order(fit, options))
    with suppress(ValueError):
        fit = _along_valley(logs, fit, options)
    return fit


def _kept_if_better(
    logs: _Logs, fit: FrictionFit, starts: Sequence[FrictionFit], options: IdentOptions
) -> FrictionFit:
    """The fit that follows from the best of some starts, or `fit` where their parameters are not worth it.

    What no observer follows explains nothing better.
    """
    with suppress(ValueError):
        best = min(starts, key=logs.errors)
        errors = np.inf
        steps_left = _STEPS
        # Each behind the observer that follows what was found before.
        while steps_left and logs.errors(best) < errors:
            errors = logs.errors(best)
            steps_left -= 1
            best = _stepped(logs, observed(best, logs.records))
        candidates = [fit]
        for candidate in (best, _in_turns(logs, best, options)):
            # An excess that has gone to nothing is none.
            if np.isinf(candidate.law.fall) or candidate.law.excess:
                candidates.append(candidate)
        return min(candidates, key=logs.worth)
    return fit


def _of_structure(logs: _Logs, options: IdentOptions) -> list[tuple[IdentOptions, FrictionFit]]:
    """Options with each structure that is possible, each with its fit of the fewest poles.

    Where the integrators are not stated: one of them, or a weight that throws the arm over. Raises LostError
    where no observer follows any.
    """
    stated = options.states("integrators", "unstable_poles")
    fits = list[tuple[IdentOptions, FrictionFit]]()
    if stated:
        with suppress(LostError):
            stated_fit = _simple(logs, options)
            if stated_fit is not None:
                fits.append(stated_fit)
    else:
        for integrators in (1, 0):
            with suppress(LostError):
                changed = options.model_copy(update={"integrators": integrators})
                simple = _simple(logs, changed, thrown_over=integrators == 0)
                if simple is not None:
                    fits.append(simple)
    if not fits:
        raise LostError
    return fits


def _simple(
    logs: _Logs, options: IdentOptions, *, thrown_over: bool = False
) -> tuple[IdentOptions, FrictionFit] | None:
    """Options with the unstable poles that show, and the fit with the fewest poles, arm and law in turns.

    With `thrown_over` None where no unstable pole shows.
    """
    level, used = with_measured_direction(
        logs.records, logs.presliding, options.input_delay_samples, stiff=not options.integrators
    )
    level = max(level, logs.least_level)
    bias = 0.0
    unstable_sought = not options.integrators and not options.unstable_poles
    for _ in range(2):
        if unstable_sought:
            options = options.with_unstable(find_unstable(used, options))
        if thrown_over and not options.unstable_poles:
            return None

        # One real pole and one pair, one more where a spring or weight holds: more are led by a wrong level.
        n_pairs = options.n_pairs
        if n_pairs is None:
            held_by_spring = not options.integrators and not options.fixed().order
            n_pairs = min(2 if held_by_spring else 1, options.max_pairs)
        n_real = min(1, options.max_real) if options.n_real is None else options.n_real
        few = options.model_copy(update={"n_real": n_real, "n_pairs": n_pairs})

        model = untested_model([prewhitened(r, long_arx_filter(used, few)) for r in used], _moving(few))

        start = started(model, few.structure(), FrictionLaw(level, logs.presliding))
        fit = _in_turns(logs, replace(start, centre=logs.centre, bias=bias), few)
        if not (unstable_sought and options.unstable_poles):
            break
        # Once more with a better friction, which the growth depends on.
        level = fit.level
        bias = fit.bias
        used = [fit.forced(record) for record in logs.records]
    return options, fit


def _moving(options: IdentOptions) -> IdentOptions:
    """Options for records that were cut by a filter: they start in motion."""
    return options.model_copy(update={"estimate_initial_state": True})


def _above_noise(records: Sequence[Record], options: IdentOptions) -> IdentOptions:
    """Options with pairs no higher than the position rises above its noise, and real poles no slower than a
    record tells, unless their limits are stated."""
    longest_s = max(record.n_samples * record.dt_s for record in records)
    update: dict[str, float | str] = {"noise": "white"}
    if options.omega_max_rad_s is None:
        update["omega_max_rad_s"] = 2 * np.pi * _ABOVE_NOISE * highest_Hz(records)
    if options.decay_min_per_s is None:
        update["decay_min_per_s"] = 1 / longest_s
    return options.model_copy(update=update)


def _without_slow_pairs(fit: FrictionFit, options: IdentOptions) -> IdentOptions:
    """Options with no pair far below the first mode of a fit, and one real pole: friction that is left looks
    like slow ones.

    With friction at the load, whose zero is known, no pair below the middle between it and the mode.
    """
    update: dict[str, float | int] = {"max_real": min(options.max_real, 1)}
    poles = fit.model.poles
    is_mode = poles.zeta() < LARGEST_DAMPING
    modes_rad_s = poles.omega_rad_s(fit.model.dt_s)[is_mode]
    if modes_rad_s.size:
        lowest_rad_s = _LOWEST_PAIR * float(modes_rad_s.min())
        spring = fit.spring if fit.arm.structure.integrators else None
        if spring is not None and spring.omega_rad_s < modes_rad_s.max():
            is_above = modes_rad_s > spring.omega_rad_s
            lowest_rad_s = float(np.sqrt(spring.omega_rad_s * modes_rad_s[is_above].min()))
        update["omega_min_rad_s"] = max(lowest_rad_s, options.omega_min_rad_s or 0.0)
    return options.model_copy(update=update)


def _in_turns(logs: _Logs, fit: FrictionFit, options: IdentOptions, rounds: int = ROUNDS) -> FrictionFit:
    """A fit after arm and law were improved in turns, at most so many rounds.

    The poles are searched for once more where level or errors have moved. Raises LostError where no observer
    follows.
    """
    search = True
    moving = _moving(options)
    for k in range(rounds):
        fit = observed(fit, logs.records)
        errors = logs.errors(fit)

        # The arm: poles from a search, poles near the present ones, or the better of both.
        candidates = list[FrictionFit]()
        if search:
            anew = _on(fit, untested_model(_white(logs, fit), moving))
            candidates.append(observed(replace(anew, correction=None, ratio=0.0), logs.records))
        if k > 0 or fit.model.poles.counts == (options.n_real, options.n_pairs):
            candidates.append(_with_near_poles(logs, fit, moving))
        fit = min(candidates, key=logs.errors)

        # The law, together with the arm.
        level = fit.level
        fit = _stepped(logs, fit)
        moved = abs(fit.level - level) / max(fit.level, level)
        fell_to = logs.errors(fit) / errors
        search = moved > _MOVES or fell_to < _FALLS_TO
        if k > 0 and moved < _STAYS and not search:
            break
    return fit


def _white(logs: _Logs, fit: FrictionFit) -> list[Record]:
    """The logs with the force on the linear arm as their input, whitened by the observer of a fit."""
    whiten = ObserverFilter.of(fit)
    return [whiten.filtered(fit.forced(record)) for record in logs.records]


def _with_near_poles(logs: _Logs, fit: FrictionFit, options: IdentOptions) -> FrictionFit:
    """A fit with the arm anew behind its friction, on poles near those it has."""
    data = prepare(_white(logs, fit), options.structure())
    poles = PoleSearch(data, options).descend(fit.model.poles, "friction").poles
    linear = linear_fit(data, poles)
    model = replace(fit.model, poles=poles, coefficients=np.ravel(linear.coefficients))
    return observed(_on(fit, model), logs.records)


def _along_valley(logs: _Logs, fit: FrictionFit, options: IdentOptions) -> FrictionFit:
    """A fit with larger or smaller friction as a whole, as long as it predicts better with the arm anew.

    Where friction and slow poles trade, single steps creep. Raises ValueError where no observer follows.
    """
    moving = _moving(_of_order(fit, options))
    for size in _SIZES:
        is_better = True
        # With more friction than the largest command nothing moves, however well that predicts.
        while is_better and fit.level < max(np.abs(record.input).max() for record in logs.records):
            law = replace(fit.law, level=size * fit.law.level, excess=size * fit.law.excess)
            scaled = replace(fit, law=law, beyond=size * fit.beyond)
            candidate = _with_near_poles(logs, scaled, moving)
            is_better = logs.errors(candidate) < logs.errors(fit)
            if is_better:
                fit = candidate
    return _stepped(logs, fit)


def _on(fit: FrictionFit, model: GobfModel) -> FrictionFit:
    """A fit with its law and observer on another model of the arm; a spring is read off that model anew."""
    spring = fit.spring
    if spring is not None:
        spring = Spring.of(model) or spring
    return replace(
        started(model, fit.arm.structure, fit.law),
        spring=spring,
        correction=fit.correction,
        ratio=fit.ratio,
        bias=fit.bias,
        beyond=fit.beyond,
        centre=fit.centre,
        lag=fit.lag,
    )


def _on_moved_poles(logs: _Logs, fit: FrictionFit) -> FrictionFit:
    """A fit with its poles where its coefficients on the doubled ones have moved them, at most half of their
    way to the unit circle, and the arm anew on them.

    Raises ValueError where no observer follows.
    """
    doubled = fit.arm.poles.doubled()

    def moved(pole: complex) -> complex:
        """Where a pole (in z) has moved: by the ratio of its double to its simple coefficient."""
        simple, double = (rows @ fit.coefficients for rows in laurent_rows(doubled, pole))
        change = complex(double / simple) if simple else 0j
        largest = _LARGEST_POLE_MOVE * (1 - abs(pole))
        return complex(pole + change * min(1.0, largest / max(abs(change), largest)))

    # Mirror images of unstable poles are part of the structure, poles at or below zero delays: they stay.
    poles = fit.model.poles
    images = fit.arm.structure.unstable.values
    real = []
    for pole in poles.real.tolist():
        stays = np.any(images == pole) or pole <= 0
        real.append(pole if stays else moved(pole).real)
    pairs = []
    for pole in poles.pairs.tolist():
        pairs.append(pole if np.any(images == pole) else moved(pole))
    poles = Poles(np.array(real), np.array(pairs, np.complex128))

    data = prepare(_white(logs, fit), replace(fit.arm.structure, estimate_initial_state=True))
    model = replace(fit.model, poles=poles, coefficients=np.ravel(linear_fit(data, poles).coefficients))
    # Its own observer is near enough for one step.
    return observed(_on(fit, model), logs.records, nearby=NEARBY[1:2])


def _stepped(logs: _Logs, fit: FrictionFit) -> FrictionFit:
    """A fit after one Gauss-Newton step in arm, with its poles, law, lag and bias, or without the arm, as far
    as it lowers the prediction errors; with its covariance.

    Unknowns, in this order: coefficients (P,), law (Q,), lag of the drive where there is one, bias of an
    integrating arm, level beyond a spring where there is one (`driven_by_law`).
    """
    errors = logs.errors(fit)
    blocks, targets = _equations(fit, logs.records, ObserverFilter.of(fit))
    n_coefficients = fit.coefficients.size
    parameters = parameters_of(fit.law)
    n_parameters = parameters.size
    integrating = fit.arm.structure.integrators > 0
    has_lag = fit.lag > 0
    at_lag = n_parameters
    at_bias = n_parameters + 1 if has_lag else n_parameters
    n_rows = sum(target.size for target in targets)
    noise = float(np.sqrt(sum(target @ target for target in targets) / n_rows))

    # Known beforehand: logarithms of the law to their deviation, a bias within the command's rms.
    expected = parameters_of(replace(fit.law, presliding=logs.presliding))
    known = np.zeros((n_parameters // 2 + 1, blocks[0].shape[1] + 1))
    for row, place in enumerate(range(1, n_parameters, 2)):
        known[row, n_coefficients + place] = noise / STD_LOG
        known[row, -1] = noise / STD_LOG * (expected - parameters)[place]
    if integrating:
        known[-1, n_coefficients + at_bias] = noise / logs.input_rms
        known[-1, -1] = -noise / logs.input_rms * fit.bias
    change = least_squares(blocks, targets, known).change

    # Logarithms move by a factor of e at most, levels by a share: the linearised friction holds no further.
    step = change[n_coefficients:]
    step[1:n_parameters:2] = np.clip(step[1:n_parameters:2], -_LARGEST_LOG_STEP, _LARGEST_LOG_STEP)
    largest = max(_LARGEST_STEP * fit.level, _LARGEST_STEP_OF_LEAST * logs.least_level)
    step[0] = np.clip(step[0], -largest, largest)
    if fit.spring is not None:
        # A load that stands tells no level: without an end its step has none.
        step[-1] = np.clip(step[-1], -largest, largest)

    # With the arm first, ever shorter; then without it. The first that predicts better is taken.
    trials = [(1.0, length) for length in LENGTHS]
    trials += [(0.0, length) for length in LENGTHS[:2]]
    for arm_share, length in trials:
        law = law_of(parameters + length * step[:n_parameters])
        lag = 0.0
        if has_lag:
            lag_step = float(np.clip(step[at_lag], -_LARGEST_LOG_STEP, _LARGEST_LOG_STEP))
            lag = max(fit.lag + length * lag_step, 0.0)
        candidate = replace(
            fit,
            law=replace(law, level=max(law.level, logs.least_level)),
            lag=lag,
            bias=fit.bias + length * float(step[at_bias]) if integrating else fit.bias,
            beyond=0.0 if fit.spring is None else max(fit.beyond + length * float(step[-1]), 0.0),
            coefficients=fit.coefficients + arm_share * length * change[:n_coefficients],
        )
        if arm_share:
            # Poles taken twice follow more than moved ones do: a wrong friction among it.
            try:
                candidate = _on_moved_poles(logs, candidate)
            except ValueError:  # no observer follows, or one that runs away
                continue
        if logs.errors(candidate) < errors:
            fit = candidate
            break
    return with_covariance(_with_steady_bias(logs, fit), blocks, targets, noise)


def _with_steady_bias(logs: _Logs, fit: FrictionFit) -> FrictionFit:
    """A fit with the constant force that leaves predictions no mean error, where that makes them better: an
    integrating arm drifts with any other."""

    def errors_of(candidate: FrictionFit) -> RealArray:
        """Prediction errors of all logs, output units, without the start of each."""
        parts = []
        for record in logs.records:
            errors = candidate.observed_position(record) - candidate.motion(record)[0]
            parts.append(errors[errors.size // _START :])
        return np.concatenate(parts)

    # The mean error is a straight line of the bias: two points give its zero.
    size = _BIAS_STEP * logs.input_rms
    before = np.mean(errors_of(fit))
    after = np.mean(errors_of(replace(fit, bias=fit.bias + size)))
    if not np.isfinite(after) or after == before:
        return fit
    steady = replace(fit, bias=fit.bias - float(size * before / (after - before)))
    return min(fit, steady, key=lambda candidate: float(np.sum(errors_of(candidate) ** 2)))


def identify_behind(
    found: FrictionFit,
    records: Sequence[Record],
    options: IdentOptions | None = None,
    progress: Progress | None = None,
) -> Identification:
    """The arm behind the friction of logs of a loop.

    Parameters
    ----------
    found : FrictionFit
        Of these logs, with an observer.
    records : sequence of Record
        With the friction taken off.
    options : IdentOptions, optional
        Of the search for poles; their number is that of the fit of the friction.
    progress : callable, optional
        Called with a share of the work (0 to 1) and a message.

    Returns
    -------
    Identification
        Of records whitened by the observer; residuals and fit are over windows (`fit_in_windows`).
    """
    options = _moving(_above_noise(records, options or IdentOptions()))
    options = _of_order(found, _without_slow_pairs(found, options))
    if found.lag > 0:
        # The drive's lag is one more real pole between command and position.
        options = options.model_copy(update={"n_real": (options.n_real or 0) + 1})
    whiten = ObserverFilter.of(found)
    behind = identify([whiten.filtered(record) for record in records], options, progress=progress)
    fits = [fit_in_windows(behind.model, record) for record in records]
    residuals = tuple(fit.residual for fit in fits)
    rss = float(sum(residual @ residual for residual in residuals))
    return replace(
        behind,
        residuals=residuals,
        fit_percent=np.array([fit.fit_percent for fit in fits]),
        rss=rss,
        noise_std=float(np.sqrt(rss / sum(residual.size for residual in residuals))),
        noise_filter=fit_autoregression(residuals, NOISE_ORDERS[-1]).a_polynomial,
    )


def _equations(
    fit: FrictionFit, records: Sequence[Record], whiten: Callable[[RealArray], RealArray]
) -> tuple[list[RealArray], list[RealArray]]:
    """Whitened equations of a Gauss-Newton step behind an observer, record by record.

    Derivatives (M, P + Q') of y - G (u - f - bias) with respect to the coefficients of the doubled poles and
    to the columns of `driven_by_law`, and what the fit leaves (M,), output units behind the filter. What the
    start of the record may be (free responses, an offset) is taken off both. `whiten` filters rows (T, ...)
    and drops those in which it settles. Raises LostError where something is not finite.
    """
    structure = fit.arm.structure
    delay = structure.input_delay_samples
    blocks = []
    targets = []
    for record in records:
        forced = fit.forced(record)
        driven = driving_input(forced.input[:, 0], structure.integrators, delay)
        basis = regressor(fit.arm.poles.doubled(), driven)
        position = answered(stabilised(record.output[:, 0], structure.unstable), delay)
        by_law = answered(driven_by_law(fit, record), delay)
        rows = whiten(np.column_stack([basis, by_law, position - basis @ fit.coefficients]))

        # Orthonormal columns of what the start may be; those below rounding say what the others say.
        n_powers = max(1, structure.integrators)
        nuisance = whiten(nuisance_columns(fit.model.poles, driven.size, n_powers, True))
        with np.errstate(over="ignore"):  # of an observer that does not follow
            length = np.linalg.norm(nuisance, axis=0)
        if not np.all(np.isfinite(length)):
            raise LostError
        is_used = length > 0
        u, sizes, _ = np.linalg.svd(nuisance[:, is_used] / length[is_used], full_matrices=False)
        counts = sizes > RANK * sizes.max(initial=0.0)
        u = u[:, counts]
        rows = rows - u @ (u.T @ rows)
        if not np.all(np.isfinite(rows)):
            raise LostError
        blocks.append(rows[:, :-1])
        targets.append(rows[:, -1])
    return blocks, targets


def heterogeneity(
    found: FrictionFit, records: Sequence[Record], whiten: Callable[[RealArray], RealArray]
) -> float:
    """How much more the parts of the records differ in arm and friction than their noise makes them.

    Parameters
    ----------
    found : FrictionFit
        With an observer.
    records : sequence of Record
        Each is parted in two halves.
    whiten : callable
        Filter of rows (T, ...) that makes the residuals white.

    Returns
    -------
    float
        Chow's F (Econometrica 28(3), 1960), not below 1: a factor of variances.
    """
    halves = []
    for record in records:
        middle = record.n_samples // 2
        halves.append(record.slice(0, middle))
        halves.append(record.slice(middle, record.n_samples))
    blocks, targets = _equations(found, halves, whiten)
    nothing_known = np.zeros((0, blocks[0].shape[1] + 1))
    together = least_squares(blocks, targets, nothing_known)
    singles = []
    for block, target in zip(blocks, targets, strict=True):
        singles.append(least_squares([block], [target], nothing_known))

    rank_together = _rank(together.triangle)
    rank_of_singles = sum(_rank(single.triangle) for single in singles)
    rss_of_singles = sum(single.residual_rss for single in singles)
    n_rows = sum(target.size for target in targets)
    numerator_freedom = max(rank_of_singles - rank_together, 1)
    denominator_freedom = n_rows - rank_of_singles
    difference = (together.residual_rss - rss_of_singles) / numerator_freedom
    return max(1.0, float(difference / (rss_of_singles / denominator_freedom)))


def _rank(triangle: RealArray) -> int:
    """Number of directions of a triangle (P, P) above rounding, its columns at unit length."""
    length = np.linalg.norm(triangle, axis=0)
    return int(np.linalg.matrix_rank(triangle / np.where(length > 0, length, 1.0), tol=RANK))
