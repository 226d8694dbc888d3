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
from typing import Any

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

# Rounds of friction and poles in turns, fewer to compare delays; the longest of these, in samples.
ROUNDS, _FEW_ROUNDS, _LONGEST_DELAY = 6, 2, 20
# A level that moves by less than the first share stays; by more than the second, or with errors that fall to
# the third, the order is chosen anew.
_STAYS, _MOVES, _FALLS_TO = 5e-3, 0.05, 0.5
# Lags by which a command follows; a residual that is rounding; one log in a million is taken for a loop,
# or its free run for a wrong one.
_CAUSES, _NOTHING, BY_CHANCE = 8, 1e-5, 1e-6
_FEW_LEVELS = 16  # of a binary or staircase signal, at most
# Largest step of the level, as a share of it; parts of a step that are tried.
_LARGEST_STEP = 0.3
# Factors by which the friction as a whole is tried larger and smaller, coarse ones first.
_SIZES = (1.1, 1 / 1.1, 1.02, 1 / 1.02)
# How dead time and lag of the drive are changed, samples each: later, a lag in place of dead time, a first
# lag, dead time in place of a lag.
_SHIFTS = ((1, 0.0), (-1, 1.0), (0, 0.5), (1, -1.0))
# Lowest further pair, as a share of the first mode: friction that is left over looks like slow poles.
_LOWEST_PAIR, _ABOVE_NOISE = 0.4, 1.2
# Stribeck friction begins with this excess and one of these speeds, in units of the rms speed.
_FALLS, _EXCESS, _STEPS = (0.03, 0.1, 0.3), 0.1, 6
# Errors of the fewest poles, as a multiple of the other structure's, above which a structure is given up. An
# arm that a weight throws over was right at 1.02 of an integrator's, and ended at .79 of them.
_WORSE_AT_FIRST = 1.5


def recorded_in_loop(records: Sequence[Record]) -> bool:
    """Whether the command follows the position: a reference was recorded, or in some record the command's
    prediction from its own past becomes better with that of the position (Granger, Econometrica 37(3), 1969).
    """
    if any(record.reference is not None for record in records):
        return True
    return any(_follows(record, 0, len(records)) for record in records)


def with_commands_in_time(records: Sequence[Record]) -> list[Record]:
    """The records, their command as much earlier as it was logged late; said in their notes.

    A command of few levels, or one that repeats, was made by no controller from a measured position. Where
    the position tells of it all the same, it is taken earlier until that ends. Neglected: relays.
    """
    n = len(records)
    if not all(
        record.reference is None
        and record.input.shape[1] == 1
        and (np.unique(record.input).size <= _FEW_LEVELS or period_of(record.input[:, 0]) is not None)
        and _follows(record, 0, n)
        for record in records
    ):
        return list(records)
    for late in range(1, 2 * _LONGEST_DELAY + 1):
        if not any(_follows(record, late + more, n) for more in range(_CAUSES) for record in records):
            while all(_answers_at_once(record, late) for record in records):
                late += 1
            note = finding(FindingKind.LATE_COMMAND, name=records[0].input_names[0], samples=late)
            return [
                replace(
                    record.slice(0, record.n_samples - late),
                    input=record.input[late:],
                    notes=(*record.notes, note),
                )
                for record in records
            ]
    return list(records)


def _follows(record: Record, late: int, among: int) -> bool:
    """Whether the command, taken so many samples earlier, is told by the position, of one of so many logs."""
    u, y = record.input[late:, 0], record.output[: record.n_samples - late, 0]
    return bool(chi2.sf(_told_by_position(u, y), _CAUSES) * among < BY_CHANCE)


def _answers_at_once(record: Record, late: int) -> bool:
    """Whether the position still answers to a command of the same sample, taken so many samples earlier."""
    y, u = record.output[:, 0], record.input[:, 0]
    rows, lags = np.arange(2 * _CAUSES, y.size - late)[:, None], np.arange(1, 2 * _CAUSES + 1)
    past = np.hstack([y[rows - lags], u[rows - lags + late]])
    left = [_unexplained(y[rows[:, 0]], part) for part in (past, np.hstack([past, u[rows + late]]))]
    return bool(rows.size * np.log(left[0] / left[1]) > 2 * np.log(rows.size))


def _told_by_position(u: RealArray, y: RealArray) -> float:
    """Chi-square, of `_CAUSES` numbers, by which the position's past tells more of a command than its own
    past."""
    n = _CAUSES
    if u.size < 8 * n:
        return 0.0
    rows, lags = np.arange(3 * n, u.size)[:, None], np.arange(1, n + 1)
    own = u[rows - np.arange(1, 3 * n + 1)]
    ways = own, np.hstack([own[:, : 2 * n], y[rows - lags + 1] - y.mean()])
    left = [_unexplained(u[3 * n :], columns) for columns in ways]
    return float(max(rows.size - 3 * n - 1, 0) * np.log(left[0] / left[1]))


def _unexplained(wanted: RealArray, columns: RealArray) -> float:
    """Sum of squares that a constant and these columns (T, N) leave, at least that of rounding."""
    columns = np.column_stack([np.ones(wanted.size), columns])
    size = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(size > 0, size, 1.0)
    rest = wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=1e-10)[0]
    return max(float(rest @ rest), float((_NOTHING * np.std(wanted)) ** 2 * rest.size))


@dataclass(frozen=True, eq=False)
class _Logs:
    """Records without their references; presliding: expected deflection, in units of the position; least:
    smallest level, rms: of the input; centre: of the positions."""

    records: tuple[Record, ...]
    presliding: float
    least: float
    rms: float
    centre: float

    @classmethod
    def of(cls, records: Sequence[Record]) -> _Logs:
        rms = float(np.sqrt(np.mean([np.mean(record.input**2) for record in records])))
        plain = tuple(replace(record, reference=None, reference_names=()) for record in records)
        centre = float(np.mean([np.mean(record.output) for record in records]))
        return cls(plain, presliding_of(records), 1e-6 * rms, rms, centre)

    def errors(self, found: FrictionFit) -> float:
        return prediction_errors(found, self.records)

    def worth(self, found: FrictionFit) -> float:
        """Errors, larger by what the number of poles and of parameters of the friction costs."""
        n, law = sum(record.n_samples for record in self.records), 2 * int(np.isfinite(found.law.fall))
        count = found.model.order + law + int(found.spring is not None) + int(found.lag > 0)
        return self.errors(found) * float(1 + count * 2 * np.log(n) / n)


def fit_friction_in_loop(
    records: Sequence[Record], options: IdentOptions, *, progress: Progress | None = None
) -> FrictionFit:
    """Law of the friction and the arm behind it from logs of a loop.

    records: one input, and the position of the shaft that the friction acts on. options: of the search for
    the arm's poles; a delay that is not stated is sought. Raises ValueError as `identify`, where the logs
    excite few frequencies, or no observer follows them. What parts of the logs differ in widens all widths;
    what speeds differ in, those that it moves.
    """
    report = progress or (lambda fraction, message: None)
    refuse_few_lines(records)
    logs = _Logs.of(records)
    report(0.0, "friction: level and a simple arm in turns")
    starts = _of_structure(logs, _above_noise(logs.records, options))
    best, ends = min(logs.worth(found) for _, found in starts), list[FrictionFit]()
    starts = [start for start in starts if logs.worth(start[1]) <= _WORSE_AT_FIRST * best]
    for k, start in enumerate(starts):
        with suppress(LostError):
            ends.append(
                _completed(
                    logs, *start, partial(lambda k, done, what: report((k + done) / len(starts), what), k)
                )
            )
    if not ends:
        raise LostError
    found = min(ends, key=logs.worth)
    whiten = ObserverFilter.of(found)
    wider = np.sqrt(heterogeneity(found, logs.records, whiten)) * found.covariance_factor
    blocks, targets = _equations(found, logs.records, whiten)
    change, *_, rest = least_squares(blocks, targets, np.zeros((0, blocks[0].shape[1] + 1)))
    scores = sum(
        by_class(target - block @ change, speed_classes(record)).T @ block
        for record, block, target in zip(logs.records, blocks, targets, strict=True)
    )
    scores = scores @ found.covariance_factor * sum(target.size for target in targets) / rest
    return replace(found, covariance_factor=sandwiched(wider, scores))


def _completed(logs: _Logs, options: IdentOptions, found: FrictionFit, report: Progress) -> FrictionFit:
    """From the fit with the fewest poles: dead time and lag of the drive, the law of the friction, as many
    poles as the data ask for. Raises LostError."""
    left_open = options.delay_left_to_data
    report(0.2, "friction: dead time, lag of the drive, law")
    shifted = _with_shift(logs, found, options, left_open=left_open)
    simple = _with_law(logs, shifted, options)
    if simple.spring is None:  # a shift may stand for it
        simple = min(simple, _with_law(logs, found, options), key=logs.worth)
    if simple is not shifted:
        simple = _with_shift(logs, simple, options, left_open=left_open)
    delay = {"input_delay_samples": simple.arm.structure.input_delay_samples}
    with suppress(LostError):  # with as many poles as the data ask for, where they are worth it
        more = _in_turns(logs, simple, _beyond(simple, options.model_copy(update=delay)))
        simple = min(simple, more, key=logs.worth)
    return _with_law(logs, simple, options)


def _with_shift(logs: _Logs, found: FrictionFit, options: IdentOptions, *, left_open: bool) -> FrictionFit:
    """The same with the dead time and the lag of the drive, in place of a part of it, that predict best;
    left_open: the dead time is."""
    seen, moves, failed = {(found.arm.structure.input_delay_samples, round(2 * found.lag))}, deque(_SHIFTS), 0
    while failed < len(moves):
        later, slower = moves[0]
        delay, lag = found.arm.structure.input_delay_samples + later, max(found.lag + slower, 0.0)
        place, one = (delay, round(2 * lag)), found
        if place not in seen and (not later or (left_open and 0 <= delay <= _LONGEST_DELAY)):
            with suppress(LostError):
                structure = replace(found.arm.structure, input_delay_samples=delay)
                one = replace(found, arm=replace(found.arm, structure=structure), lag=lag)
                one = _in_turns(logs, one, _of_order(found, options, delay), _FEW_ROUNDS)
        seen.add(place)
        if logs.worth(one) < logs.worth(found):  # and once more the same way
            found, failed = one, 0
        else:
            moves.rotate(-1)
            failed += 1
    return min(found, _in_turns(logs, found, _of_order(found, options)), key=logs.errors)


def _of_order(found: FrictionFit, options: IdentOptions, delay: int | None = None) -> IdentOptions:
    """The options with the structure and the number of poles of a fit, but for another dead time."""
    structure = found.arm.structure
    options = options.model_copy(update={"integrators": structure.integrators})
    if structure.unstable.order:
        options = options.with_unstable(structure.unstable)
    n_real, n_pairs = (
        all_ - known for all_, known in zip(found.model.poles.counts, options.fixed().counts, strict=True)
    )
    delay = structure.input_delay_samples if delay is None else delay
    return options.model_copy(update={"n_real": n_real, "n_pairs": n_pairs, "input_delay_samples": delay})


def _with_law(logs: _Logs, found: FrictionFit, options: IdentOptions) -> FrictionFit:
    """The same with friction at the load, behind the first spring, and with friction that falls with speed,
    where that is worth it."""
    if not found.significant:
        return found
    spring, half = Spring.of(found.model), 0.5 * found.law.level
    if spring is not None and found.spring is None:
        starts = [replace(found, spring=spring, beyond=half, law=replace(found.law, level=half))]
        found = _kept_if_better(logs, found, starts, _of_order(found, options))
    if not np.isfinite(found.law.fall):
        speed, excess, level = rms_speed(logs.records), _EXCESS * found.law.level, found.law.level
        laws = [replace(found.law, level=level - excess, excess=excess, fall=f * speed) for f in _FALLS]
        starts = [replace(found, law=law) for law in laws]
        found = _kept_if_better(logs, found, starts, _of_order(found, options))
    with suppress(ValueError):
        found = _along_valley(logs, found, options)
    return found


def _kept_if_better(
    logs: _Logs, found: FrictionFit, starts: Sequence[FrictionFit], options: IdentOptions
) -> FrictionFit:
    """What follows from the best of these starts, where its parameters are worth it. What no observer follows
    explains nothing better."""
    with suppress(ValueError):
        best = min(starts, key=logs.errors)
        errors, left = np.inf, _STEPS
        # Each behind the observer that follows what was found before.
        while left and logs.errors(best) < errors:
            errors, left = logs.errors(best), left - 1
            best = _stepped(logs, observed(best, logs.records))
        # An excess that has gone to nothing is none.
        ends = (e for e in (best, _in_turns(logs, best, options)) if np.isinf(e.law.fall) or e.law.excess)
        return min((found, *ends), key=logs.worth)
    return found


def _of_structure(logs: _Logs, options: IdentOptions) -> list[tuple[IdentOptions, FrictionFit]]:
    """The options with each structure that is possible, and the fit with the fewest poles: where the
    integrators are not stated, one of them, or a weight that throws the arm over."""
    stated = options.states("integrators", "unstable_poles")
    tried = list[tuple[IdentOptions, FrictionFit]]()
    for integrators in (1, 0):
        with suppress(LostError):
            one = options if stated else options.model_copy(update={"integrators": integrators})
            found = _simple(logs, one, thrown_over=not (integrators or stated))
            tried += [found] if found else []
        if stated:
            break
    if not tried:
        raise LostError
    return tried


def _simple(
    logs: _Logs, options: IdentOptions, *, thrown_over: bool = False
) -> tuple[IdentOptions, FrictionFit] | None:
    """The options with the unstable poles that show, and level and arm in turns; thrown_over: None without
    any."""
    level, used = with_measured_direction(
        logs.records, logs.presliding, options.input_delay_samples, stiff=not options.integrators
    )
    level = max(level, logs.least)
    sought, bias = not (options.integrators or options.unstable_poles), 0.0
    for _ in range(2):
        if sought:
            options = options.with_unstable(find_unstable(used, options))
        if thrown_over and not options.unstable_poles:
            return None
        # One real pole and one pair, one more where a spring or weight holds: more are led by a wrong level.
        pairs = 1 + int(not options.integrators and not options.fixed().order)
        given = (
            ("n_real", options.n_real, min(1, options.max_real)),
            ("n_pairs", options.n_pairs, min(pairs, options.max_pairs)),
        )
        few = options.model_copy(update={key: most if known is None else known for key, known, most in given})
        model = untested_model([prewhitened(r, long_arx_filter(used, few)) for r in used], _moving(few))
        start = started(model, few.structure(), FrictionLaw(level, logs.presliding))
        found = _in_turns(logs, replace(start, centre=logs.centre, bias=bias), few)
        if not (sought and options.unstable_poles):
            break
        # Once more with a better friction, which the growth depends on.
        level, bias, used = found.level, found.bias, [found.forced(record) for record in logs.records]
    return options, found


def _moving(options: IdentOptions) -> IdentOptions:
    """For records that were cut by a filter: they start in motion."""
    return options.model_copy(update={"estimate_initial_state": True})


def _above_noise(records: Sequence[Record], options: IdentOptions) -> IdentOptions:
    """Pairs no higher than the position rises above its noise, real poles no slower than a record tells."""
    longest_s = max(record.n_samples * record.dt_s for record in records)
    highest_rad_s = 2 * np.pi * _ABOVE_NOISE * highest_Hz(records)
    told = {"omega_max_rad_s": highest_rad_s, "decay_min_per_s": 1 / longest_s}
    left_open = {key: value for key, value in told.items() if getattr(options, key) is None}
    return options.model_copy(update={"noise": "white", **left_open})


def _beyond(found: FrictionFit, options: IdentOptions) -> IdentOptions:
    """No pair far below the first mode, and one real pole: friction that is left looks like slow ones. With
    friction at the load, whose zero is known, no pair below the middle between it and the mode."""
    poles = found.model.poles
    update: dict[str, float | int] = {"max_real": min(options.max_real, 1)}
    modes = poles.omega_rad_s(found.model.dt_s)[poles.zeta() < LARGEST_DAMPING]
    if modes.size:
        least = _LOWEST_PAIR * float(modes.min())
        spring = found.spring if found.arm.structure.integrators else None
        if spring is not None and spring.omega_rad_s < modes.max():
            least = float(np.sqrt(spring.omega_rad_s * modes[modes > spring.omega_rad_s].min()))
        update["omega_min_rad_s"] = max(least, options.omega_min_rad_s or 0.0)
    return options.model_copy(update=update)


def _in_turns(logs: _Logs, found: FrictionFit, options: IdentOptions, rounds: int = ROUNDS) -> FrictionFit:
    """Arm and law in turns; the poles are searched for once more where level or errors have moved."""
    search, inside = True, _moving(options)
    for k in range(rounds):
        found, tried = observed(found, logs.records), list[FrictionFit]()
        errors = logs.errors(found)
        if search:
            anew = _on(found, untested_model(_white(logs, found), inside))
            tried = [observed(replace(anew, correction=None, ratio=0.0), logs.records)]
        if k or found.model.poles.counts == (options.n_real, options.n_pairs):
            tried.append(_with_near_poles(logs, found, inside))
        found = min(tried, key=logs.errors)
        level, found = found.level, _stepped(logs, found)
        moved, fell = abs(found.level - level) / max(found.level, level), logs.errors(found) / errors
        search = moved > _MOVES or fell < _FALLS_TO
        if k and moved < _STAYS and not search:
            break
    return found


def _white(logs: _Logs, found: FrictionFit) -> list[Record]:
    whiten = ObserverFilter.of(found)
    return [whiten.filtered(found.forced(record)) for record in logs.records]


def _with_near_poles(logs: _Logs, found: FrictionFit, options: IdentOptions) -> FrictionFit:
    """The fit with the arm anew behind its friction, on poles near those it has."""
    there = PoleSearch(prepare(_white(logs, found), options.structure()), options)
    linear = linear_fit(there.data, poles := there.descend(found.model.poles, "friction").poles)
    model = replace(found.model, poles=poles, coefficients=np.ravel(linear.coefficients))
    return observed(_on(found, model), logs.records)


def _along_valley(logs: _Logs, found: FrictionFit, options: IdentOptions) -> FrictionFit:
    """The same with more or less friction as a whole, as long as it predicts better with the arm anew: where
    friction and slow poles trade, single steps creep."""
    inside = _moving(_of_order(found, options))
    for size in _SIZES:
        better = True
        # With more friction than the largest command nothing moves, however well that predicts.
        while better and found.level < max(np.abs(record.input).max() for record in logs.records):
            law = replace(found.law, level=size * found.law.level, excess=size * found.law.excess)
            tried = _with_near_poles(logs, replace(found, law=law, beyond=size * found.beyond), inside)
            better = logs.errors(tried) < logs.errors(found)
            found = tried if better else found
    return _stepped(logs, found)


def _on(found: FrictionFit, model: GobfModel) -> FrictionFit:
    """The fit on another model of the arm."""
    spring = found.spring and (Spring.of(model) or found.spring)
    kept: dict[str, Any] = {
        key: getattr(found, key) for key in ("correction", "ratio", "bias", "beyond", "centre", "lag")
    }
    return replace(started(model, found.arm.structure, found.law), spring=spring, **kept)


def _on_moved_poles(logs: _Logs, found: FrictionFit) -> FrictionFit:
    """The fit with its poles where its coefficients on the doubled ones have moved them, at most half of
    their way to the unit circle, and the arm anew on them."""

    def moved(pole: complex) -> complex:
        simple, double = (rows @ found.coefficients for rows in laurent_rows(found.arm.poles.doubled(), pole))
        change, most = complex(double / simple) if simple else 0j, 0.5 * (1 - abs(pole))
        return complex(pole + change * min(1.0, most / max(abs(change), most)))

    poles, images = found.model.poles, found.arm.structure.unstable.values
    real = [pole if np.any(images == pole) or pole <= 0 else moved(pole).real for pole in poles.real.tolist()]
    pairs = [pole if np.any(images == pole) else moved(pole) for pole in poles.pairs.tolist()]
    poles = Poles(np.array(real), np.array(pairs, np.complex128))
    data = prepare(_white(logs, found), replace(found.arm.structure, estimate_initial_state=True))
    model = replace(found.model, poles=poles, coefficients=np.ravel(linear_fit(data, poles).coefficients))
    return observed(_on(found, model), logs.records, nearby=NEARBY[1:2])


def _stepped(logs: _Logs, found: FrictionFit) -> FrictionFit:
    """One Gauss-Newton step in arm, with its poles, law, lag and bias, or without the arm, as far as it
    lowers the prediction errors."""
    errors = logs.errors(found)
    blocks, targets = _equations(found, logs.records, ObserverFilter.of(found))
    p, theta = found.coefficients.size, parameters_of(found.law)
    q = theta.size
    noise = float(np.sqrt(sum(t @ t for t in targets) / sum(t.size for t in targets)))
    expected = parameters_of(replace(found.law, presliding=logs.presliding))
    known = np.zeros((q // 2 + 1, blocks[0].shape[1] + 1))
    for i, at in enumerate(range(1, q, 2)):
        known[i, p + at], known[i, -1] = noise / STD_LOG, noise / STD_LOG * (expected - theta)[at]
    integrating, at_bias = found.arm.structure.integrators > 0, q + int(found.lag > 0)
    if integrating:
        known[-1, p + at_bias], known[-1, -1] = noise / logs.rms, -noise / logs.rms * found.bias
    change = least_squares(blocks, targets, known)[0]
    step = change[p:]
    step[1:q:2] = np.clip(step[1:q:2], -1, 1)
    largest = max(_LARGEST_STEP * found.level, 10 * logs.least)
    # A load that stands tells no level: without an end its step has none.
    step[[0, -1 if found.spring else 0]] = np.clip(step[[0, -1 if found.spring else 0]], -largest, largest)
    for arm, length in (*((1.0, length) for length in LENGTHS), *((0.0, length) for length in LENGTHS[:2])):
        law = law_of(theta + length * step[:q])
        tried = replace(
            found,
            law=replace(law, level=max(law.level, logs.least)),
            lag=max(found.lag + length * float(np.clip(step[q], -1, 1)), 0.0) if found.lag else 0.0,
            bias=found.bias + length * float(step[at_bias]) if integrating else found.bias,
            beyond=max(found.beyond + length * float(step[-1]), 0.0) if found.spring else 0.0,
            coefficients=found.coefficients + arm * length * change[:p],
        )
        # Poles taken twice follow more than moved ones do: a wrong friction among it.
        try:
            tried = _on_moved_poles(logs, tried) if arm else tried
        except ValueError:  # no observer follows, or one that runs away
            continue
        if logs.errors(tried) < errors:
            found = tried
            break
    return with_covariance(_held(logs, found), blocks, targets, noise)


def _held(logs: _Logs, found: FrictionFit) -> FrictionFit:
    """The same with the constant force that leaves predictions no mean error, where that makes them better:
    an integrating arm drifts with any other."""

    def left(one: FrictionFit) -> RealArray:
        errors = [one.observed_position(record) - one.motion(record)[0] for record in logs.records]
        return np.concatenate([part[part.size // 20 :] for part in errors])

    size = _STAYS * logs.rms
    before, after = (np.mean(left(one)) for one in (found, replace(found, bias=found.bias + size)))
    if not np.isfinite(after) or after == before:
        return found
    tried = replace(found, bias=found.bias - float(size * before / (after - before)))
    return min(found, tried, key=lambda one: float(np.sum(left(one) ** 2)))


def identify_behind(
    found: FrictionFit,
    records: Sequence[Record],
    options: IdentOptions | None = None,
    progress: Progress | None = None,
) -> Identification:
    """The arm behind the friction of logs of a loop: poles of the number that the fit of the friction has, on
    records with the friction taken off, whitened by its observer. Residuals and fit are over windows
    (`fit_in_windows`)."""
    options = _of_order(found, _beyond(found, _moving(_above_noise(records, options or IdentOptions()))))
    options = options.model_copy(update={"n_real": (options.n_real or 0) + int(found.lag > 0)})
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
    found: FrictionFit, records: Sequence[Record], whiten: Callable[[RealArray], RealArray]
) -> tuple[list[RealArray], list[RealArray]]:
    """Of every record the derivatives of y - G (u - f - bias), whitened, with respect to the coefficients of
    the doubled poles, the law and the bias of an integrating arm; and what it leaves. What the start of the
    record may be (free responses, an offset) is taken off both."""
    blocks, targets, structure = [], [], found.arm.structure
    for record in records:
        less = found.forced(record)
        driven = driving_input(less.input[:, 0], structure.integrators, structure.input_delay_samples)
        basis = regressor(found.arm.poles.doubled(), driven)
        position = answered(
            stabilised(record.output[:, 0], structure.unstable), structure.input_delay_samples
        )
        by_law = answered(driven_by_law(found, record), structure.input_delay_samples)
        rows = whiten(np.column_stack([basis, by_law, position - basis @ found.coefficients]))
        nuisance = whiten(
            nuisance_columns(found.model.poles, driven.size, max(1, structure.integrators), True)
        )
        with np.errstate(over="ignore"):  # of an observer that does not follow
            length = np.linalg.norm(nuisance, axis=0)
        if not np.all(np.isfinite(length)):
            raise LostError
        u, d, _ = np.linalg.svd(nuisance[:, length > 0] / length[length > 0], full_matrices=False)
        u = u[:, d > RANK * d.max(initial=0.0)]
        rows = rows - u @ (u.T @ rows)
        if not np.all(np.isfinite(rows)):
            raise LostError
        blocks.append(rows[:, :-1])
        targets.append(rows[:, -1])
    return blocks, targets


def heterogeneity(
    found: FrictionFit, records: Sequence[Record], whiten: Callable[[RealArray], RealArray]
) -> float:
    """How much more the parts of the records differ in arm and friction than their noise makes them (Chow's
    F, Econometrica 28(3), 1960; not below 1): halves of records, whitened."""
    middle = [record.n_samples // 2 for record in records]
    parts = [
        record.slice(*ends)
        for record, half in zip(records, middle, strict=True)
        for ends in ((0, half), (half, record.n_samples))
    ]
    blocks, targets = _equations(found, parts, whiten)
    nothing = np.zeros((0, blocks[0].shape[1] + 1))
    together = least_squares(blocks, targets, nothing)
    alone = [least_squares([b], [t], nothing) for b, t in zip(blocks, targets, strict=True)]
    sizes = [(one[1], np.linalg.norm(one[1], axis=0)) for one in (together, *alone)]
    rank = [int(np.linalg.matrix_rank(r / np.where(n > 0, n, 1.0), tol=RANK)) for r, n in sizes]
    left = sum(one[3] for one in alone)
    freedom = max(sum(rank[1:]) - rank[0], 1), sum(t.size for t in targets) - sum(rank[1:])
    return max(1.0, float((together[3] - left) / freedom[0] / (left / freedom[1])))
